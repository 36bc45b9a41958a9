"""What the statistics of an ensemble need of each run of a batch, computed for all runs at once.

Runs are taken L at a time, as lanes (``netkf.linalg.lanes``): their samples of some times are
turned into lanes, columns are computed, turned back and merged, all in the nearest cache.
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

TOGETHER = 512
"""Numbers of a run that are looked at together: some lines of the cache."""
MAX_SCRATCH_ENTRIES = 1 << 15
"""Entries of all P of a sample up to which scratch is kept: some 10 MB."""


class Reduced(NamedTuple):
    """Values of R runs, each independent of the others in its batch.

    ``samples``: of each piece of the runs the moments of the upper triangles of P and of e e' with
    the error e, then NEES, (T, F (2 u + 1)) for F filters, of the runs that have the sample.
    ``averages`` (R, F, 3): mean square error, mean trace of P and mean NEES over the samples after
    time 0, nan where there is none. ``rounding_from`` (R,): the first sample time at which rounding
    blurs the errors, inf where none.
    """

    samples: list[Moments]
    averages: FloatArray
    rounding_from: FloatArray


class Batch(Struct):
    """The arrays of a RunBatch for kernels, see there.

    kept : (R,), number of samples of each run that count
    known, given : runs (R,) whose NEES is given, and that NEES (R, T, F)
    start : sample with which averages begin
    x_rows, P_rows, error_rows : the same arrays with a row a run
    """

    times: FloatArray
    x: FloatArray
    P: FloatArray
    error: FloatArray
    lengths: np.ndarray
    diverged: np.ndarray
    exact: int
    kept: np.ndarray
    known: np.ndarray
    given: FloatArray
    start: int
    x_rows: FloatArray
    P_rows: FloatArray
    error_rows: FloatArray


class Sums(Struct):
    """Sums over K chunks of R runs.

    size : (K, T), number of runs
    mean, M2 : (K, T, F (2 u + 1))
    averages, rounding_from : of the runs, as in Reduced
    regular : (R,), whether all P of a run are regular
    """

    size: FloatArray
    mean: FloatArray
    M2: FloatArray
    averages: FloatArray
    rounding_from: FloatArray
    regular: np.ndarray


class ReductionScratch(Struct):
    """Scratch for S times and C = F (2 u + 1) columns of L runs, with some memory behind.

    ``lines`` (L, S F n n) as they are in a batch; in lanes ``error`` (S F n, L), ``P``
    (S F n n, L), ``x`` (S n, L), ``columns`` (S C, L) and ``totals`` (F, 3, L), the sums for the
    averages; of one sample the error ``z`` (n, L), ``factor`` of P (n, n, L), NEES and whether P is
    ``broken`` (L,), whether the sample counts as ``clear`` or as ``traced`` (L,); ``rows``
    (L, S, C) by run and their M2 ``work`` (L, S, C), ``size`` (L, S). Of nodes of the tree over
    runs, those that wait for a neighbour, ``node_size`` (D, S), ``mean`` and ``M2`` (D, S, C). Of a
    sample alone ``one`` (n, n), ``solved`` (n, 1) and NEES ``alone`` (1,). ``lane_numbers``: 0 .. L
    - 1.
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
    broken: FloatArray
    clear: FloatArray
    traced: FloatArray
    rows: FloatArray
    work: FloatArray
    size: FloatArray
    node_size: FloatArray
    mean: FloatArray
    M2: FloatArray
    one: FloatArray
    solved: FloatArray
    alone: FloatArray
    lane_numbers: np.ndarray
    times: int


def reduction_scratch(filters: int, n: int, largest: int) -> ReductionScratch:
    """Return scratch for ``filters`` filters of n states, in chunks of at most ``largest`` runs."""
    columns = filters * (n * (n + 1) + 1)
    times = max(1, TOGETHER // columns)
    # L entries are moved at a time, which goes beyond the last column.
    wide = times + -(-LANES // columns)
    depth = largest.bit_length() + 1
    nodes, rows = (depth, wide, columns), (LANES, wide, columns)

    def in_lanes(numbers: int) -> FloatArray:
        """Return aligned scratch with lanes for ``numbers`` numbers of each chunk."""
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
        broken=aligned((LANES,)),
        clear=aligned((LANES,)),
        traced=aligned((LANES,)),
        rows=np.zeros(rows),
        work=np.zeros(rows),
        size=np.empty((LANES, times)),
        node_size=np.empty((depth, times)),
        mean=np.empty(nodes),
        M2=np.empty(nodes),
        one=np.empty((n, n)),
        solved=np.empty((n, 1)),
        alone=np.empty(1),
        lane_numbers=np.arange(LANES),
        times=times,
    )


class _ScratchCache(threading.local):
    """The scratch arrays that a thread used for its last batch, kept for the next one."""

    def __init__(self) -> None:
        self._sizes = (0, 0, 0)
        self._scratch = reduction_scratch(1, 1, 1)

    def of(self, filters: int, n: int, largest: int) -> ReductionScratch:
        """Return scratch for at least these sizes (see ``reduction_scratch``), not cleared."""
        if filters * n * n > MAX_SCRATCH_ENTRIES:
            return reduction_scratch(filters, n, largest)
        if self._sizes[:2] != (filters, n) or self._sizes[2] < largest:
            self._sizes = (filters, n, largest)
            self._scratch = reduction_scratch(filters, n, largest)
        return self._scratch


_scratch_cache = _ScratchCache()


def reduce_batch(batch: RunBatch, pieces: Sequence[slice]) -> Reduced:
    """Return values of all runs of a batch, samples by ``pieces``, which are neighbours and hold
    all runs; the last sample of a run that diverged is left out.
    """
    runs, count, filters, n = batch.error.shape
    bounds = np.array([0, *(piece.stop for piece in pieces)])
    columns, most = filters * (n * (n + 1) + 1), int(np.diff(bounds).max())
    sums = Sums(
        size=np.empty((len(pieces), count)),
        mean=np.empty((len(pieces), count, columns)),
        M2=np.empty((len(pieces), count, columns)),
        averages=np.zeros((runs, filters, 3)),
        rounding_from=np.full(runs, np.inf),
        regular=np.ones(runs, dtype=np.bool_),
    )
    given = _batch_arrays(batch)
    scratch = _scratch_cache.of(filters, n, most)
    reduce_runs(MANY, given, bounds, sums, scratch)
    if not sums.regular.all():
        # Some P is exactly singular: those that are singular up to rounding are left out as well.
        given.given, given.known = _nees_of_irregular(given, sums.regular), ~sums.regular
        sums.averages[:], sums.rounding_from[:] = 0.0, np.inf
        reduce_runs(MANY, given, bounds, sums, scratch)
    samples = [Moments(*found) for found in zip(sums.size, sums.mean, sums.M2, strict=True)]
    return Reduced(samples, sums.averages, sums.rounding_from)


def _batch_arrays(batch: RunBatch) -> Batch:
    """Return the arrays of a batch."""
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
        kept=batch.lengths - batch.diverged,
        known=np.zeros(runs, dtype=np.bool_),
        given=np.empty((0, 0, 0)),
        start=int(np.searchsorted(batch.times, 0.0, side="right")),
        x_rows=x.reshape(runs, -1),
        P_rows=P.reshape(runs, -1),
        error_rows=error.reshape(runs, -1),
    )


def _nees_of_irregular(batch: Batch, regular: np.ndarray) -> FloatArray:
    """Return NEES (R, T, F) of the kept samples of the runs that are not ``regular`` (R,)."""
    nees = np.empty(batch.error.shape[:3])
    for r in np.flatnonzero(~regular):
        kept = batch.kept[r]
        nees[r, :kept] = errors(batch.error[r, :kept], batch.P[r, :kept])[1]
    return nees


# Compact with all that is inlined here: loops over lanes gain nothing from being unrolled.
@kernel(compact=True)
def reduce_runs(
    lanes: Lanes, b: Batch, bounds: np.ndarray, sums: Sums, scratch: ReductionScratch
) -> None:
    """Find the sums of R runs, of which piece k holds ``bounds[k]`` to ``bounds[k + 1]``."""
    for k in range(len(bounds) - 1):
        # Some times in all runs of a piece: what is found is merged before the next.
        for t in range(0, len(b.times), scratch.times):
            count, depth = min(scratch.times, len(b.times) - t), 0
            for first in range(bounds[k], bounds[k + 1], len(lanes)):
                active = min(len(lanes), bounds[k + 1] - first)
                whole = reduce_group(lanes, b, sums, scratch, first, active, t, count)
                add_node(lanes, scratch, active, count, depth, whole)
                depth += 1
                # A binary counter: as many nodes are complete as the number ends in ones.
                number = (first - bounds[k]) // len(lanes)
                while number & 1 == 1:
                    depth = join_nodes(scratch, depth, count)
                    number >>= 1
            # Those at the end that have no neighbour join from right to left.
            while depth > 1:
                depth = join_nodes(scratch, depth, count)
            mean, M2, mean_of, M2_of = scratch.mean, scratch.M2, sums.mean, sums.M2
            for s in range(count):
                sums.size[k, t + s] = scratch.node_size[0, s]
                for c in range(mean.shape[2]):
                    mean_of[k, t + s, c], M2_of[k, t + s, c] = mean[0, s, c], M2[0, s, c]
    for r in range(len(b.kept)):
        divide_averages(b, sums, r)


@kernel(compact=True)
def join_nodes(scratch: ReductionScratch, depth: int, count: int) -> int:
    """Merge the last two of the nodes that wait; return how many there are then."""
    for s in range(count):
        merge_pair(scratch.node_size, scratch.mean, scratch.M2, depth - 2, depth - 1, s, s)
    return depth - 1


@kernel(compact=True)
def add_node(
    lanes: Lanes, scratch: ReductionScratch, active: int, count: int, node: int, whole: bool
) -> None:
    """Merge the ``active`` rows of a group of runs in the tree over them, as a new node. They are
    ``whole`` if none lacks a sample.
    """
    if whole and active == len(lanes):
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
    """Merge L rows as ``merge_row`` does, where all sizes are equal, L columns at a time."""
    rows, work, mean_of, M2_of = scratch.rows, scratch.work, scratch.mean, scratch.M2
    for s in range(count):
        scratch.node_size[node, s] = 1.0 * len(lanes)
    for c in range(0, count * rows.shape[2], len(lanes)):
        stride = 1
        while stride < len(lanes):
            # Both have ``stride`` observations: shares of 1 / 2 in the mean.
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
    """Turn ``count`` numbers of each run from ``first`` on, those from ``start`` on of ``samples``
    (R, ...), into the lanes of ``out`` (>= count, L). Idle lanes repeat the last run.
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
    """Write the ``rows`` of ``count`` samples from ``t`` on of the ``active`` runs from ``first``
    on, and add them to the averages; return True if no run lacks one of them.
    """
    filters, n = b.error.shape[2:]
    each, whole, kept, totals, averages = filters * n, True, b.kept, scratch.totals, sums.averages
    gather_samples(
        lanes, b.error_rows, first, active, t * each, count * each, scratch.lines, scratch.error
    )
    gather_samples(
        lanes, b.P_rows, first, active, t * each * n, count * each * n, scratch.lines, scratch.P
    )
    if not b.exact:
        gather_samples(lanes, b.x_rows, first, active, t * n, count * n, scratch.lines, scratch.x)
    for q in range(active):
        whole = whole and t + count <= kept[first + q]
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
    if not whole or active < len(lanes):
        mark_missing(b, scratch, first, active, t, count)
    return whole


@kernel(compact=True)
def mark_missing(
    b: Batch, scratch: ReductionScratch, first: int, active: int, t: int, count: int
) -> None:
    """Give samples that a run has size 1, and those that it lacks size 0 and zeros."""
    for q in range(active):
        for s in range(count):
            exists = t + s < b.kept[first + q]
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
    """Fill the columns of sample ``t``, the ``s``-th of a group, of filter ``f``, and add it to the
    averages.
    """
    # Taken from the struct once, and not in each step of the loops.
    errors_of, P, columns, factor, z = (
        scratch.error,
        scratch.P,
        scratch.columns,
        scratch.factor,
        scratch.z,
    )
    n = len(z)
    filters = len(scratch.totals)
    # Columns of a sample of a filter: the upper triangles of P and of e e', and then NEES.
    half = n * (n + 1) // 2
    place = s * filters + f
    index = place * n
    index_P = place * n * n
    column = place * (2 * half + 1)
    last = column + 2 * half
    square = spread(lanes, 0.0)
    trace = spread(lanes, 0.0)
    for i in range(n):
        e = load(lanes, errors_of, index + i)
        store(lanes, z, i, e)
        square += e * e
        trace += load(lanes, P, index_P + i * n + i)
        for j in range(i, n):
            entry = load(lanes, P, index_P + i * n + j)
            store(lanes, factor, j, i, entry)
            store(lanes, columns, column, entry)
            store(lanes, columns, half + column, e * load(lanes, errors_of, index + j))
            column += 1
    if any_lane(nees_of_lanes(lanes, scratch)):
        # A singular P needs pivoting, sample by sample.
        for q in range(active):
            if scratch.broken[q] > 0.0 and t < b.kept[first + q]:
                nees_alone(b, sums, scratch, first + q, t, f, q)
    nees = load(lanes, scratch.nees, 0)
    store(lanes, columns, last, nees)
    clear, traced = load(lanes, scratch.clear, 0) > 0.0, load(lanes, scratch.traced, 0) > 0.0
    add_total(lanes, scratch.totals, f, 0, select(clear, square, 0.0))
    add_total(lanes, scratch.totals, f, 1, select(traced, trace, 0.0))
    add_total(lanes, scratch.totals, f, 2, select(clear, nees, 0.0))


@kernel(inlined=True)
def add_total(lanes: Lanes, totals: FloatArray, f: int, a: int, number: Any) -> None:
    """Add the value ``number`` of L lanes to ``totals[f, a]`` (L,): the sum over time of average a
    of filter f.
    """
    store(lanes, totals, f, a, load(lanes, totals, f, a) + number)


@kernel(compact=True)
def nees_alone(
    b: Batch, sums: Sums, scratch: ReductionScratch, r: int, t: int, f: int, q: int
) -> None:
    """Write NEES of one sample into lane ``q``, and note where its P is singular."""
    error, P = b.error[r, t, f : f + 1], b.P[r, t, f : f + 1]
    if not fill_nees(error, P, scratch.alone, scratch.one, scratch.solved):
        sums.regular[r] = False
    scratch.nees[q] = b.given[r, t, f] if b.known[r] else scratch.alone[0]


@kernel(compact=True)
def mark_averaged(
    b: Batch, sums: Sums, scratch: ReductionScratch, first: int, active: int, t: int
) -> None:
    """Mark the runs in whose averages sample ``t`` counts, by the rule of
    ``runs.summary.averaged_samples``: ``clear`` for those of errors, ``traced`` for that of P.
    """
    # Arrays are taken from the structs once, and not in each step of the loop.
    times, kept, diverged, rounding_from = b.times, b.kept, b.diverged, sums.rounding_from
    clear_runs, traced_runs = scratch.clear, scratch.traced
    for q in range(active):
        r = first + q
        blurred_from = rounding_from[r]  # seconds; errors are mostly rounding from then on
        begin = b.start if b.start < kept[r] else 0  # without samples after time 0, all count
        exists = begin <= t < kept[r]
        clear = exists and times[t] < blurred_from
        # Rounding spares covariances, but those of a run that diverges outgrow all bounds.
        traced = clear or (exists and not (diverged[r] and times[begin] < blurred_from))
        clear_runs[q] = 1.0 if clear else 0.0
        traced_runs[q] = 1.0 if traced else 0.0


@kernel(compact=True)
def divide_averages(b: Batch, sums: Sums, r: int) -> None:
    """Divide the sums of run ``r`` by the numbers of samples in them."""
    kept = b.kept[r]
    first = b.start if b.start < kept else 0
    clear = first
    while clear < kept and b.times[clear] < sums.rounding_from[r]:
        clear += 1
    last = clear if b.diverged[r] and clear > first else kept
    for f in range(sums.averages.shape[1]):
        sums.averages[r, f, 0] /= clear - first
        sums.averages[r, f, 1] /= last - first
        sums.averages[r, f, 2] /= clear - first


@kernel(inlined=True)
def nees_of_lanes(lanes: Lanes, scratch: ReductionScratch) -> Any:
    """Write NEES ``e' P^-1 e`` of L samples, one in each lane, and return the lanes whose P is not
    positive definite or not finite, which ``broken`` (L,) has as numbers.

    On entry ``factor`` is P and ``z`` the error e; both are overwritten.
    """
    # P = G D G' with G unit lower triangular, and e' P^-1 e = z' D^-1 z with G z = e.
    rest = scratch.factor
    error = scratch.z
    n = len(error)
    total = spread(lanes, 0.0)
    broken = spread(lanes, 0.0)
    for k in range(n):
        pivot, z = load(lanes, rest, k, k), load(lanes, error, k)
        broken += select(pivot > 0.0, 0.0, 1.0)
        inverse = 1.0 / pivot
        total += z * z * inverse
        for i in range(k + 1, n):
            factor = load(lanes, rest, i, k) * inverse
            for j in range(k + 1, i + 1):
                entry = load(lanes, rest, i, j) - factor * load(lanes, rest, j, k)
                store(lanes, rest, i, j, entry)
            store(lanes, error, i, load(lanes, error, i) - factor * z)
    store(lanes, scratch.nees, 0, total)
    store(lanes, scratch.broken, 0, broken)
    return broken > 0.0


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
    """Note the time of sample ``t``, the ``s``-th of a group, in the runs where it is blurred."""
    # Squares tell without a root where it is surely not. A nan is no number here: what is blurred
    # is not decided by it either.
    filters, n = b.error.shape[2:]
    errors_of, P = scratch.error, scratch.P
    largest, least = spread(lanes, 0.0), spread(lanes, np.inf)
    for f in range(s * filters, (s + 1) * filters):
        for i in range(n):
            variance = load(lanes, P, f * n * n + i * n + i)
            least = select(variance < least, variance, least)
            if b.exact:
                size = magnitude(load(lanes, errors_of, f * n + i))
                largest = select(size > largest, size, largest)
    for index in range(0 if b.exact else s * n, 0 if b.exact else (s + 1) * n):
        size = magnitude(load(lanes, scratch.x, index))
        largest = select(size > largest, size, largest)
    bound = ROUNDING * BLUR * largest
    clear = (least < np.inf) & (bound * bound < 0.5 * least)
    if any_lane(select(clear, 0.0, 1.0) > 0.0):
        for r in range(first, first + active):
            known = t >= b.lengths[r] or b.times[t] >= sums.rounding_from[r]
            if not known and is_blurred(b, r, t):
                sums.rounding_from[r] = b.times[t]


@kernel(compact=True)
def is_blurred(b: Batch, r: int, t: int) -> bool:
    """Return True if rounding blurs, by the rule of ``trace.run.rounding_from``, sample ``t`` of
    run ``r``: x (n,), P (F, n, n), error (F, n).
    """
    filters, n = b.error.shape[2:]
    largest, least, square = 0.0, np.inf, 0.0
    given, broken = False, False
    for f in range(filters):
        for i in range(n):
            value = abs(b.error[r, t, f, i]) if b.exact else abs(b.x[r, t, i])
            broken = broken or np.isnan(value) or np.isnan(b.P[r, t, f, i, i])
            largest, least = max(largest, value), min(least, b.P[r, t, f, i, i])
            if not given:
                square += b.error[r, t, f, i] * b.error[r, t, f, i]
                for j in range(n):
                    given = given or not np.isnan(b.P[r, t, f, i, j])
    if not given:
        # The filter gives no covariance: the errors themselves show their size.
        broken, least = np.isnan(square) or np.isnan(largest), square / (filters * n)
    deviation = np.sqrt(max(least, 0.0)) / BLUR
    return not broken and deviation > 0.0 and ROUNDING * largest > deviation
