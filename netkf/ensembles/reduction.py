"""The values of each run of a batch that ensemble statistics are made of, for all runs at once.

Runs are processed L at a time in SIMD lanes (``netkf.linalg.lanes``), and a few sample times at a
time, so that all data stay in the nearest cache: the samples of L runs are transposed into lanes,
columns (products of errors, NEES) are computed, transposed back to rows of runs, and merged into
moments by the binary tree over runs.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.ensembles.moments import Moments, merge_pair, merge_row
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    LANES,
    MANY,
    Lanes,
    aligned,
    any_lane,
    load,
    magnitude,
    scatter,
    select,
    spread,
    store,
    turn,
)
from netkf.linalg.structs import Struct
from netkf.trace.batch import RunBatch
from netkf.trace.nees import errors, fill_nees
from netkf.trace.run import BLUR, ROUNDING

NUMBERS_AT_ONCE = 512
"""Number of columns, over all samples, of a run that are processed together: 4 KiB, so that those
of L runs fit the nearest cache.
"""
MAX_SCRATCH_ENTRIES = 1 << 15
"""Largest number of entries of all P of a sample for which scratch is kept (some 10 MB)."""


class Reduced(NamedTuple):
    """Values of R runs with F filters of n states; u = n (n + 1) / 2.

    samples       : for each piece of the runs the moments (T, F (2 u + 1)) over the runs that have
                    the sample: of the upper triangles of P and of e e', e the error, and of NEES
    averages      : (R, F, 3) mean square error, mean trace of P and mean NEES over the samples
                    after time 0, nan without samples
    rounding_from : (R,) the first sample time in seconds at which rounding blurs the errors, else
                    inf
    """

    samples: list[Moments]
    averages: FloatArray
    rounding_from: FloatArray


class Batch(Struct):
    """The arrays of a RunBatch for kernels; see there for those not listed here.

    sample_counts : (R,) number of samples of each run that count
    has_nees      : (R,) bool, runs whose NEES is taken from ``known_nees`` (R, T, F)
    start         : index of the first sample in averages
    x_rows, P_rows, error_rows : the arrays x, P and error with one row for each run
    """

    times: FloatArray
    x: FloatArray
    P: FloatArray
    error: FloatArray
    lengths: np.ndarray
    diverged: np.ndarray
    exact: int
    sample_counts: np.ndarray
    has_nees: np.ndarray
    known_nees: FloatArray
    start: int
    x_rows: FloatArray
    P_rows: FloatArray
    error_rows: FloatArray


class Sums(Struct):
    """Moments of K pieces of R runs, and values of the runs.

    size : (K, T) number of runs that have the sample
    mean, M2 : (K, T, F (2 u + 1)) mean and sum of squared deviations
    averages, rounding_from : as in Reduced
    regular : (R,) bool, all P of the run can be inverted
    """

    size: FloatArray
    mean: FloatArray
    M2: FloatArray
    averages: FloatArray
    rounding_from: FloatArray
    regular: np.ndarray


class ReductionScratch(Struct):
    """Scratch for S sample times and C = F (2 u + 1) columns of L runs, with some spare memory.

    lines  : (L, S F n n) samples of L runs in the order of the batch
    error, P, x, columns : (S F n, L), (S F n n, L), (S n, L), (S C, L) the same in lanes
    totals : (F, 3, L) sums for the averages
    z, factor, nees, not_definite : (n, L), (n, n, L), (L,), (L,) of one sample: error, factor of P,
             NEES, and the number of pivots that are not positive, 0 where P is positive definite
    error_used, P_used : (L,) 1 where the sample counts in averages of errors, and of P
    rows, work, size : (L, S, C), (L, S, C), (L, S) columns of each run, their M2 and number
    node_size, mean, M2 : (D, S), (D, S, C), (D, S, C) of the nodes of the tree over runs that wait
             for a neighbour
    single_factor, single_solved, single_nees : (n, n), (n, 1), (1,) for one sample of one run
    lane_numbers : 0 .. L - 1
    times  : S
    """

    lines: FloatArray
    error: FloatArray
    P: FloatArray
    x: FloatArray
    columns: FloatArray
    totals: FloatArray
    z: FloatArray
    factor: FloatArray
    nees: FloatArray
    not_definite: FloatArray
    error_used: FloatArray
    P_used: FloatArray
    rows: FloatArray
    work: FloatArray
    size: FloatArray
    node_size: FloatArray
    mean: FloatArray
    M2: FloatArray
    single_factor: FloatArray
    single_solved: FloatArray
    single_nees: FloatArray
    lane_numbers: np.ndarray
    times: int


def reduction_scratch(filters: int, n: int, largest: int) -> ReductionScratch:
    """Return the arrays that ``reduce_runs`` overwrites, for ``filters`` filters of n states; at
    most ``largest`` runs are merged into one result.
    """
    # For each filter the upper triangles of P and of e e', and NEES.
    columns = filters * (n * (n + 1) + 1)
    times = max(1, NUMBERS_AT_ONCE // columns)
    # Transpositions move L entries at a time, possibly beyond the last column.
    wide = times + -(-LANES // columns)
    # More nodes of the binary tree over runs never wait for a neighbour at the same time.
    depth = largest.bit_length() + 1
    nodes, rows = (depth, wide, columns), (LANES, wide, columns)

    def in_lanes(numbers: int) -> FloatArray:
        return np.asarray(aligned((wide * numbers + LANES, LANES)))

    return ReductionScratch(
        lines=np.empty((LANES, wide * filters * n * n + LANES)),
        error=in_lanes(filters * n),
        P=in_lanes(filters * n * n),
        x=in_lanes(n),
        columns=in_lanes(columns),
        totals=aligned((filters, 3, LANES)),
        z=aligned((n, LANES)),
        factor=aligned((n, n, LANES)),
        nees=aligned((LANES,)),
        not_definite=aligned((LANES,)),
        error_used=aligned((LANES,)),
        P_used=aligned((LANES,)),
        rows=np.zeros(rows),
        work=np.zeros(rows),
        size=np.empty((LANES, times)),
        node_size=np.empty((depth, times)),
        mean=np.empty(nodes),
        M2=np.empty(nodes),
        single_factor=np.empty((n, n)),
        single_solved=np.empty((n, 1)),
        single_nees=np.empty(1),
        lane_numbers=np.arange(LANES),
        times=times,
    )


class _ScratchCache(threading.local):
    """The scratch arrays that a thread used for its last batch, kept for the next one."""

    def __init__(self) -> None:
        self._sizes = (0, 0, 0)
        self._scratch = reduction_scratch(1, 1, 1)

    def of(self, filters: int, n: int, largest: int) -> ReductionScratch:
        """Return the arrays that ``reduce_runs`` overwrites, for ``filters`` filters of n states;
        at most ``largest`` runs are merged into one result.

        The arrays, whose contents are left from the last use, are kept for the next call, unless P
        has more than MAX_SCRATCH_ENTRIES entries; that call gets larger ones if it needs them.
        """
        if filters * n * n > MAX_SCRATCH_ENTRIES:
            return reduction_scratch(filters, n, largest)
        if self._sizes[:2] != (filters, n) or self._sizes[2] < largest:
            self._sizes = (filters, n, largest)
            self._scratch = reduction_scratch(filters, n, largest)
        return self._scratch


_scratch_cache = _ScratchCache()


def reduce_batch(batch: RunBatch, pieces: Sequence[slice]) -> Reduced:
    """Return averages of each of the R runs of a batch, and moments of the samples over the runs of
    each of ``pieces``: adjacent slices that cover all runs, each a node of the binary tree along
    which the runs of an ensemble are merged.

    The columns of the moments are, for each filter, the upper triangles of P and of e e' (e is the
    error) and the NEES. The averages of a run are its mean square error, mean trace of P and mean
    NEES over the samples after time 0. The last sample of a run that diverged, whose numbers are
    broken, is left out.
    """
    runs, count, filters, n = batch.error.shape
    bounds = np.array([0, *(piece.stop for piece in pieces)])
    columns, largest = filters * (n * (n + 1) + 1), int(np.diff(bounds).max())
    sums = Sums(
        size=np.empty((len(pieces), count)),
        mean=np.empty((len(pieces), count, columns)),
        M2=np.empty((len(pieces), count, columns)),
        averages=np.zeros((runs, filters, 3)),
        rounding_from=np.full(runs, np.inf),
        regular=np.ones(runs, dtype=np.bool_),
    )
    arrays = _batch_arrays(batch)
    scratch = _scratch_cache.of(filters, n, largest)
    # The type of MANY tells the kernels how many runs, L, fill the SIMD lanes.
    reduce_runs(MANY, arrays, bounds, sums, scratch)
    if not sums.regular.all():
        # Some P is exactly singular. In such runs a P that is singular up to rounding is no better:
        # their NEES is computed again by errors(), which leaves both out.
        arrays.known_nees, arrays.has_nees = (
            _nees_of_irregular(arrays, sums.regular),
            ~sums.regular,
        )
        sums.averages[:], sums.rounding_from[:] = 0.0, np.inf
        reduce_runs(MANY, arrays, bounds, sums, scratch)
    samples = [Moments(*moments) for moments in zip(sums.size, sums.mean, sums.M2, strict=True)]
    return Reduced(samples, sums.averages, sums.rounding_from)


def _batch_arrays(batch: RunBatch) -> Batch:
    runs = len(batch)
    x, P, error = (np.ascontiguousarray(part) for part in (batch.x, batch.P, batch.error))
    return Batch(
        times=np.ascontiguousarray(batch.times, dtype=np.float64),
        x=x,
        P=P,
        error=error,
        lengths=batch.lengths,
        diverged=batch.diverged,
        exact=int(batch.exact_errors),
        sample_counts=batch.lengths - batch.diverged,
        has_nees=np.zeros(runs, dtype=np.bool_),
        known_nees=np.empty((0, 0, 0)),
        start=int(np.searchsorted(batch.times, 0.0, side="right")),
        x_rows=x.reshape(runs, -1),
        P_rows=P.reshape(runs, -1),
        error_rows=error.reshape(runs, -1),
    )


def _nees_of_irregular(batch: Batch, regular: np.ndarray) -> FloatArray:
    """Return NEES (R, T, F) of the runs that are not ``regular`` (R,)."""
    nees = np.empty(batch.error.shape[:3])
    for r in np.flatnonzero(~regular):
        count = batch.sample_counts[r]
        nees[r, :count] = errors(batch.error[r, :count], batch.P[r, :count])[1]
    return nees


# Compact, with all functions inlined here: unrolling loops over lanes gains nothing.
@kernel
def reduce_runs(
    lanes: Lanes, b: Batch, bounds: np.ndarray, sums: Sums, scratch: ReductionScratch
) -> None:
    """Fill ``sums`` for the R runs of the batch ``b``: averages of each run, and moments over the
    runs of each piece, merged in a binary tree. Piece k has the runs ``bounds[k]`` to
    ``bounds[k + 1] - 1``, for K pieces and ``bounds`` (K + 1,).

    Groups of L runs are computed side by side, one run in each SIMD lane; ``scratch`` is
    overwritten.
    """
    for k in range(len(bounds) - 1):
        # A few sample times of all runs of a piece at a time.
        for t in range(0, len(b.times), scratch.times):
            count, depth = min(scratch.times, len(b.times) - t), 0
            for first in range(bounds[k], bounds[k + 1], len(lanes)):
                active = min(len(lanes), bounds[k + 1] - first)
                complete = reduce_group(lanes, b, sums, scratch, first, active, t, count)
                add_node(lanes, scratch, active, count, depth, complete)
                depth += 1
                # Group 0, 1, 2, ... of a piece: each trailing 1 in the binary form of its number
                # means that two neighbouring nodes of the tree are complete and can be merged.
                number = (first - bounds[k]) // len(lanes)
                while number & 1 == 1:
                    depth = join_nodes(scratch, depth, count)
                    number >>= 1
            # Nodes left without a neighbour at the end are merged from right to left.
            while depth > 1:
                depth = join_nodes(scratch, depth, count)
            mean, M2, mean_out, M2_out = scratch.mean, scratch.M2, sums.mean, sums.M2
            for s in range(count):
                sums.size[k, t + s] = scratch.node_size[0, s]
                for c in range(mean.shape[2]):
                    mean_out[k, t + s, c], M2_out[k, t + s, c] = mean[0, s, c], M2[0, s, c]
    for r in range(len(b.sample_counts)):
        divide_averages(b, sums, r)


@kernel
def join_nodes(scratch: ReductionScratch, depth: int, count: int) -> int:
    """Merge the last two of ``depth`` nodes of the binary tree over runs that wait for a neighbour,
    at ``count`` sample times; return depth - 1, the number that waits now.

    Changes node depth - 2 of ``scratch.node_size``, ``mean`` and ``M2``.
    """
    for s in range(count):
        merge_pair(scratch.node_size, scratch.mean, scratch.M2, depth - 2, depth - 1, s, s)
    return depth - 1


@kernel
def add_node(
    lanes: Lanes, scratch: ReductionScratch, active: int, count: int, node: int, complete: bool
) -> None:
    """Merge the moments of a group of ``active`` runs, at most L, and store the result as number
    ``node`` of the nodes of the binary tree over runs that wait for a neighbour.

    Reads ``scratch.rows`` and ``size``, and sets ``node_size``, ``mean`` and ``M2`` of the node at
    ``count`` sample times. ``complete`` says that no run lacks one of these samples.
    """
    if complete and active == len(lanes):
        merge_whole(lanes, scratch, count, node)
        return
    for s in range(count):
        merge_row(scratch.size[:active], scratch.rows[:active], scratch.work[:active], s)
        scratch.node_size[node, s] = scratch.size[0, s]
        for c in range(scratch.mean.shape[2]):
            scratch.mean[node, s, c], scratch.M2[node, s, c] = (
                scratch.rows[0, s, c],
                scratch.work[0, 0, c],
            )


@kernel
def merge_whole(lanes: Lanes, scratch: ReductionScratch, count: int, node: int) -> None:
    """Merge the ``scratch.rows`` of L runs that all have the samples into means and sums of squared
    deviations M2, in a binary tree as ``merge_row`` does, but L columns at a time.

    Sets ``node_size``, ``mean`` and ``M2`` of number ``node`` of the nodes that wait for a
    neighbour, at ``count`` sample times; M2 of inner nodes is in ``scratch.work``.
    """
    rows, work, mean_of, M2_of = scratch.rows, scratch.work, scratch.mean, scratch.M2
    for s in range(count):
        scratch.node_size[node, s] = 1.0 * len(lanes)
    # c counts the columns of all samples, one sample after the other: load() and store() take the L
    # neighbours from there on, also beyond the row of the first sample.
    for c in range(0, count * rows.shape[2], len(lanes)):
        stride = 1
        while stride < len(lanes):
            # Pairs of nodes with ``stride`` runs each: each has the weight 1 / 2 in the mean.
            for a in range(0, len(lanes), 2 * stride):
                mean = load(lanes, rows, a, 0, c)
                delta = load(lanes, rows, a + stride, 0, c) - mean
                store(lanes, rows, a, 0, c, mean + 0.5 * delta)
                M2 = delta * delta * (0.5 * stride)
                if stride > 1:
                    M2 = load(lanes, work, a, 0, c) + (load(lanes, work, a + stride, 0, c) + M2)
                store(lanes, work, a, 0, c, M2)
            stride *= 2
        store(lanes, mean_of, node, 0, c, load(lanes, rows, 0, 0, c))
        store(lanes, M2_of, node, 0, c, load(lanes, work, 0, 0, c))


@kernel
def gather_samples(
    lanes: Lanes,
    samples: FloatArray,
    first: int,
    active: int,
    start: int,
    count: int,
    lines: FloatArray,
    out: FloatArray,
) -> None:
    """Transpose columns ``start`` to ``start + count`` of ``samples`` (R, columns) for the
    ``active`` runs from ``first`` on into the L lanes of ``out`` (>= count, L).

    Afterwards each run has a SIMD lane of its own. Lanes beyond the active ones repeat the last
    run; ``lines`` (L, >= count) is scratch.
    """
    for q in range(len(lanes)):
        r = first + min(q, active - 1)
        for c in range(count):
            lines[q, c] = samples[r, start + c]
    for c in range(0, count, len(lanes)):
        turn(lanes, lines, c, out)


@kernel
def reduce_group(
    lanes: Lanes,
    b: Batch,
    sums: Sums,
    scratch: ReductionScratch,
    first: int,
    active: int,
    t: int,
    count: int,
) -> bool:
    """Fill ``scratch.rows`` (P, e e' and NEES) for ``count`` samples from number ``t`` on of the
    ``active`` runs of ``b`` from ``first`` on, one run in each SIMD lane; return True if no run
    lacks one of these samples.

    Adds the samples to ``sums.averages`` of these runs, and sets ``sums.rounding_from``, the time
    from which rounding blurs their errors.
    """
    filters, n = b.error.shape[2:]
    entries, complete = filters * n, True
    sample_counts, totals, averages = b.sample_counts, scratch.totals, sums.averages
    gather_samples(
        lanes,
        b.error_rows,
        first,
        active,
        t * entries,
        count * entries,
        scratch.lines,
        scratch.error,
    )
    gather_samples(
        lanes,
        b.P_rows,
        first,
        active,
        t * entries * n,
        count * entries * n,
        scratch.lines,
        scratch.P,
    )
    if not b.exact:
        gather_samples(lanes, b.x_rows, first, active, t * n, count * n, scratch.lines, scratch.x)
    # The averages so far go into lanes, and back at the end.
    for q in range(active):
        complete = complete and t + count <= sample_counts[first + q]
        for f in range(filters):
            for a in range(3):
                totals[f, a, q] = averages[first + q, f, a]
    for s in range(count):
        mark_blurred(lanes, b, sums, scratch, first, active, t + s, s)
        mark_averaged(b, sums, scratch, first, active, t + s)
        for f in range(filters):
            reduce_sample(lanes, b, sums, scratch, first, active, t + s, s, f)
    for c in range(0, count * scratch.rows.shape[2], len(lanes)):
        scatter(lanes, scratch.columns, c, scratch.rows, scratch.lane_numbers, len(lanes))
    for q in range(active):
        for f in range(filters):
            for a in range(3):
                averages[first + q, f, a] = totals[f, a, q]
    if not complete or active < len(lanes):
        mark_missing(b, scratch, first, active, t, count)
    return complete


@kernel
def mark_missing(
    b: Batch, scratch: ReductionScratch, first: int, active: int, t: int, count: int
) -> None:
    """Set ``scratch.size`` to 1 for samples that a run has, else (it diverged and ended before) to
    0, with zeros in ``scratch.rows``, so that merging the moments of runs leaves them out.

    For ``count`` samples from number ``t`` on of the ``active`` runs from ``first`` on.
    """
    for q in range(active):
        for s in range(count):
            exists = t + s < b.sample_counts[first + q]
            scratch.size[q, s] = 1.0 if exists else 0.0
            for c in range(0 if exists else scratch.rows.shape[2]):
                scratch.rows[q, s, c] = 0.0


@kernel(inlined=True)
def reduce_sample(
    lanes: Lanes,
    b: Batch,
    sums: Sums,
    scratch: ReductionScratch,
    first: int,
    active: int,
    t: int,
    s: int,
    f: int,
) -> None:
    """Fill the columns (P, e e', NEES) of sample ``t`` for filter ``f``, and add it to the sums of
    the averages over time, in L lanes.

    The ``active`` runs from ``first`` on have one SIMD lane each; ``s`` is the number of the sample
    among those in ``scratch``. Changes ``scratch.columns`` and ``scratch.totals[f]``.
    """
    # Loaded from the struct once instead of in each step of the loops.
    error_lanes, P, columns, factor, z = (
        scratch.error,
        scratch.P,
        scratch.columns,
        scratch.factor,
        scratch.z,
    )
    n = len(z)
    filters = len(scratch.totals)
    # Columns of one sample of a filter: upper triangle of P, upper triangle of e e', NEES.
    half = n * (n + 1) // 2
    filter_index = s * filters + f
    index = filter_index * n
    index_P = filter_index * n * n
    column = filter_index * (2 * half + 1)
    last = column + 2 * half
    square = spread(lanes, 0.0)
    trace = spread(lanes, 0.0)
    for i in range(n):
        e = load(lanes, error_lanes, index + i)
        store(lanes, z, i, e)
        square += e * e
        trace += load(lanes, P, index_P + i * n + i)
        for j in range(i, n):
            entry = load(lanes, P, index_P + i * n + j)
            store(lanes, factor, j, i, entry)  # lower triangle, which is factorised below
            store(lanes, columns, column, entry)
            store(lanes, columns, half + column, e * load(lanes, error_lanes, index + j))
            column += 1
    if any_lane(nees_of_lanes(lanes, scratch)):
        # A P that is not positive definite needs pivoting, one run at a time.
        for q in range(active):
            if scratch.not_definite[q] > 0.0 and t < b.sample_counts[first + q]:
                fill_single_nees(b, sums, scratch, first + q, t, f, q)
    nees = load(lanes, scratch.nees, 0)
    store(lanes, columns, last, nees)
    error_used = load(lanes, scratch.error_used, 0) > 0.0
    P_used = load(lanes, scratch.P_used, 0) > 0.0
    add_total(lanes, scratch.totals, f, 0, select(error_used, square, 0.0))
    add_total(lanes, scratch.totals, f, 1, select(P_used, trace, 0.0))
    add_total(lanes, scratch.totals, f, 2, select(error_used, nees, 0.0))


@kernel(inlined=True)
def add_total(lanes: Lanes, totals: FloatArray, f: int, a: int, number: Any) -> None:
    """Add the value ``number`` of L lanes to ``totals[f, a]`` (L,), the sum over time for filter f
    of squared errors (a = 0), traces of P (1) or NEES (2).
    """
    store(lanes, totals, f, a, load(lanes, totals, f, a) + number)


@kernel
def fill_single_nees(
    b: Batch, sums: Sums, scratch: ReductionScratch, r: int, t: int, f: int, q: int
) -> None:
    """Write NEES of sample ``t`` of run ``r`` and filter ``f`` into ``scratch.nees[q]``, where q is
    the SIMD lane of that run, by Gaussian elimination with pivoting.

    It is for samples whose P is not positive definite, for which the factorisation without pivoting
    of all lanes fails. Sets ``sums.regular[r]`` to False if P is singular. ``reduce_batch`` then
    computes the NEES of that run by ``errors``, and starts again with it: with ``b.has_nees[r]``
    NEES is taken from ``b.known_nees``.
    """
    error, P = b.error[r, t, f : f + 1], b.P[r, t, f : f + 1]
    if not fill_nees(error, P, scratch.single_nees, scratch.single_factor, scratch.single_solved):
        sums.regular[r] = False
    scratch.nees[q] = b.known_nees[r, t, f] if b.has_nees[r] else scratch.single_nees[0]


@kernel
def mark_averaged(
    b: Batch, sums: Sums, scratch: ReductionScratch, first: int, active: int, t: int
) -> None:
    """Mark the runs in whose averages over time sample ``t`` counts, by the rule of summaries of
    single runs.

    Sets, for the ``active`` runs from ``first`` on, one in each SIMD lane, ``scratch.error_used``
    to 1 where errors count, which is after time 0 and before rounding blurs them, and
    ``scratch.P_used`` to 1 where P counts, else to 0.
    """
    # Loaded from the structs once instead of in each step of the loop.
    times, sample_counts, diverged, rounding_from = (
        b.times,
        b.sample_counts,
        b.diverged,
        sums.rounding_from,
    )
    error_used, P_used = scratch.error_used, scratch.P_used
    for q in range(active):
        r = first + q
        blurred_from = rounding_from[r]  # seconds; errors are mostly rounding from then on
        # Without samples after time 0 all samples count.
        begin = b.start if b.start < sample_counts[r] else 0
        exists = begin <= t < sample_counts[r]
        error_counts = exists and times[t] < blurred_from
        # Covariances do not suffer from rounding, but those of a diverging run grow without bound.
        ends_with_errors = diverged[r] and times[begin] < blurred_from
        P_counts = error_counts or (exists and not ends_with_errors)
        error_used[q] = 1.0 if error_counts else 0.0
        P_used[q] = 1.0 if P_counts else 0.0


@kernel
def divide_averages(b: Batch, sums: Sums, r: int) -> None:
    """Divide ``sums.averages[r]`` (F, 3), sums over the samples of run ``r`` of squared errors,
    traces of P and NEES of F filters, by the numbers of samples that ``mark_averaged`` counted.

    Sums begin at sample ``b.start``, the first after time 0, or at 0 if the run diverged before it.
    Those of squared errors and NEES end where rounding blurs the errors, those of traces of P with
    them if the run diverged.
    """
    count = b.sample_counts[r]
    first = b.start if b.start < count else 0
    error_end = first
    while error_end < count and b.times[error_end] < sums.rounding_from[r]:
        error_end += 1
    P_end = error_end if b.diverged[r] and error_end > first else count
    for f in range(sums.averages.shape[1]):
        sums.averages[r, f, 0] /= error_end - first
        sums.averages[r, f, 1] /= P_end - first
        sums.averages[r, f, 2] /= error_end - first


@kernel(inlined=True)
def nees_of_lanes(lanes: Lanes, scratch: ReductionScratch) -> Any:
    """Write NEES ``e' P^-1 e`` of L samples, one in each SIMD lane, into ``scratch.nees`` (L,), and
    return flags of the lanes whose P is not positive definite or not finite.

    ``scratch.not_definite`` (L,) counts pivots that are not positive. On entry ``scratch.factor``
    (n, n, L) is P and ``scratch.z`` (n, L) the error e; both are overwritten.
    """
    # P = G D G' with G unit lower triangular, and e' P^-1 e = z' D^-1 z with G z = e.
    schur = scratch.factor
    error = scratch.z
    n = len(error)
    total = spread(lanes, 0.0)
    not_definite = spread(lanes, 0.0)
    for k in range(n):
        pivot, z = load(lanes, schur, k, k), load(lanes, error, k)
        not_definite += select(pivot > 0.0, 0.0, 1.0)
        inverse = 1.0 / pivot
        total += z * z * inverse
        for i in range(k + 1, n):
            factor = load(lanes, schur, i, k) * inverse
            for j in range(k + 1, i + 1):
                entry = load(lanes, schur, i, j) - factor * load(lanes, schur, j, k)
                store(lanes, schur, i, j, entry)
            store(lanes, error, i, load(lanes, error, i) - factor * z)
    store(lanes, scratch.nees, 0, total)
    store(lanes, scratch.not_definite, 0, not_definite)
    return not_definite > 0.0


@kernel(inlined=True)
def mark_blurred(
    lanes: Lanes,
    b: Batch,
    sums: Sums,
    scratch: ReductionScratch,
    first: int,
    active: int,
    t: int,
    s: int,
) -> None:
    """Set ``sums.rounding_from`` to the time of sample ``t`` in those runs in which it is the first
    sample that rounding blurs: rounding errors of the state are not small compared to the standard
    deviation of the errors (see ``is_blurred``).

    The ``active`` runs from ``first`` on have one SIMD lane each; ``s`` is the number of the sample
    among those in ``scratch``.
    """
    # A fast sufficient test of all lanes by squares, without a root; is_blurred() decides about the
    # runs that it does not clear. Comparisons with nan are false, as in is_blurred().
    filters, n = b.error.shape[2:]
    error_lanes, P = scratch.error, scratch.P
    largest, min_variance = spread(lanes, 0.0), spread(lanes, np.inf)
    for f in range(s * filters, (s + 1) * filters):
        for i in range(n):
            variance = load(lanes, P, f * n * n + i * n + i)
            min_variance = select(variance < min_variance, variance, min_variance)
            if b.exact:
                size = magnitude(load(lanes, error_lanes, f * n + i))
                largest = select(size > largest, size, largest)
    # Errors computed as x - xhat are as coarse as the states x: no step if errors are exact.
    for index in range(0 if b.exact else s * n, 0 if b.exact else (s + 1) * n):
        size = magnitude(load(lanes, scratch.x, index))
        largest = select(size > largest, size, largest)
    bound = ROUNDING * BLUR * largest
    # The factor 0.5 leaves a margin for rounding of the squares.
    surely_sharp = (min_variance < np.inf) & (bound * bound < 0.5 * min_variance)
    if any_lane(select(surely_sharp, 0.0, 1.0) > 0.0):
        for r in range(first, first + active):
            decided = t >= b.lengths[r] or b.times[t] >= sums.rounding_from[r]
            if not decided and is_blurred(b, r, t):
                sums.rounding_from[r] = b.times[t]


@kernel
def is_blurred(b: Batch, r: int, t: int) -> bool:
    """Return True if rounding blurs sample ``t`` of run ``r`` of the batch ``b``: rounding errors
    of the state exceed a fraction 1 / BLUR of the smallest standard deviation.

    The rule is that of ``trace.run.rounding_from``, which decides for single runs. With ``b.exact``
    errors were not computed as x - xhat, and only their own size decides.
    """
    filters, n = b.error.shape[2:]
    largest, min_variance, square = 0.0, np.inf, 0.0
    has_covariance, is_undefined = False, False
    for f in range(filters):
        for i in range(n):
            value = abs(b.error[r, t, f, i]) if b.exact else abs(b.x[r, t, i])
            is_undefined = is_undefined or np.isnan(value) or np.isnan(b.P[r, t, f, i, i])
            largest, min_variance = max(largest, value), min(min_variance, b.P[r, t, f, i, i])
            if not has_covariance:
                square += b.error[r, t, f, i] * b.error[r, t, f, i]
                for j in range(n):
                    has_covariance = has_covariance or not np.isnan(b.P[r, t, f, i, j])
    if not has_covariance:
        # The filter gives no covariance: the errors themselves show their size.
        is_undefined, min_variance = np.isnan(square) or np.isnan(largest), square / (filters * n)
    deviation = np.sqrt(max(min_variance, 0.0)) / BLUR
    return not is_undefined and deviation > 0.0 and ROUNDING * largest > deviation
