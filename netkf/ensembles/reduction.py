"""What the statistics of an ensemble need of each run of a batch, computed for all runs at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.ensembles.moments import Moments, merge_row
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, Lanes, aligned, load, select, spread, store
from netkf.trace.batch import RunBatch
from netkf.trace.nees import errors, fill_nees
from netkf.trace.run import BLUR, ROUNDING

TOGETHER = 128
"""Numbers of a run that are looked at together: some lines of the cache."""


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


class Batch(NamedTuple):
    """The arrays of a RunBatch, with the samples of each run that are ``kept`` (R,), and NEES
    ``given`` (R, T, F) of the runs that are ``known`` (R,).
    """

    times: FloatArray
    x: FloatArray
    P: FloatArray
    error: FloatArray
    lengths: np.ndarray
    diverged: np.ndarray
    exact: bool
    kept: np.ndarray
    known: np.ndarray
    given: FloatArray


class Sums(NamedTuple):
    """What is found: ``size`` (K, T) of K pieces, their ``mean`` and ``M2`` (K, T, F (2 u + 1)), of
    the runs ``averages`` and ``rounding_from`` as in Reduced, and whether all their P are
    ``regular`` (R,).
    """

    size: FloatArray
    mean: FloatArray
    M2: FloatArray
    averages: FloatArray
    rounding_from: FloatArray
    regular: np.ndarray


class Room(NamedTuple):
    """Scratch: of L samples the error (n, L), P and its factor (n, n, L), NEES, square errors,
    traces and whether P is ``broken`` (L,); of one sample ``factor`` (n, n), ``solved`` (n, 1) and
    NEES ``alone`` (1,); of S times of the runs of a piece ``size`` (R, S), ``values``
    (R, S, F (2 u + 1)) and ``work`` (R, 1, F (2 u + 1)).
    """

    error: FloatArray
    P: FloatArray
    nees: FloatArray
    square: FloatArray
    trace: FloatArray
    broken: FloatArray
    factor: FloatArray
    solved: FloatArray
    alone: FloatArray
    size: FloatArray
    values: FloatArray
    work: FloatArray


def reduce_batch(batch: RunBatch, pieces: Sequence[slice]) -> Reduced:
    """Values of all runs of a batch, samples by ``pieces``, which are neighbours and hold all runs;
    the last sample of a run that diverged is left out.
    """
    runs, count, filters, n = batch.error.shape
    bounds = np.array([0, *(piece.stop for piece in pieces)])
    columns, most = filters * (n * (n + 1) + 1), int(np.diff(bounds).max())
    sums = Sums(
        np.empty((len(pieces), count)), np.empty((len(pieces), count, columns)),
        np.empty((len(pieces), count, columns)),
        np.zeros((runs, filters, 3)), np.full(runs, np.inf), np.ones(runs, dtype=np.bool_),
    )  # fmt: skip
    few = max(1, TOGETHER // columns)  # times
    of_lanes, of_piece = aligned((4, LANES)), np.empty((most, few, columns))
    room = Room(
        aligned((n, LANES)), aligned((n, n, LANES)), of_lanes[0], of_lanes[1], of_lanes[2],
        of_lanes[3], np.empty((n, n)), np.empty((n, 1)), np.empty(1), np.empty((most, few)),
        of_piece, np.empty((most, 1, columns)),
    )  # fmt: skip
    given = Batch(
        batch.times, batch.x, batch.P, batch.error, batch.lengths, batch.diverged,
        batch.exact_errors, batch.lengths - batch.diverged, np.zeros(runs, dtype=np.bool_),
        np.empty((0, 0, 0)),
    )  # fmt: skip
    reduce_runs(MANY, given, bounds, sums, room)
    if not sums.regular.all():
        # Some P is exactly singular: those that are singular up to rounding are left out as well.
        given = given._replace(known=~sums.regular, given=_nees_of_irregular(given, sums.regular))
        sums.averages[:], sums.rounding_from[:] = 0.0, np.inf
        reduce_runs(MANY, given, bounds, sums, room)
    samples = [Moments(*found) for found in zip(*sums[:3], strict=True)]
    return Reduced(samples, sums.averages, sums.rounding_from)


def _nees_of_irregular(batch: Batch, regular: np.ndarray) -> FloatArray:
    """NEES (R, T, F) of the kept samples of the runs that are not ``regular`` (R,)."""
    nees = np.empty(batch.error.shape[:3])
    for r in np.flatnonzero(~regular):
        kept = batch.kept[r]
        nees[r, :kept] = errors(batch.error[r, :kept], batch.P[r, :kept])[1]
    return nees


@kernel
def reduce_runs(lanes: Lanes, b: Batch, bounds: np.ndarray, sums: Sums, room: Room) -> None:
    """Find the sums of R runs, of which piece k holds ``bounds[k]`` to ``bounds[k + 1]``."""
    start = 0
    while start < len(b.times) and not b.times[start] > 0.0:
        start += 1
    for k in range(len(bounds) - 1):
        first, stop = bounds[k], bounds[k + 1]
        values, size = room.values[: stop - first], room.size[: stop - first]
        # Some times in all runs: what is found is merged before the next.
        for t in range(0, len(b.times), values.shape[1]):
            count = min(values.shape[1], len(b.times) - t)
            for r in range(first, stop):
                for s in range(count):
                    size[r - first, s] = 1.0 if t + s < b.kept[r] else 0.0
                    if t + s < b.lengths[r] and not b.times[t + s] >= sums.rounding_from[r]:
                        find_blur(b, sums, r, t + s)
            reduce_samples(lanes, b, sums, room, values[:, :count], start, first, t)
            for s in range(count):
                merge_row(size, values, room.work, s)
                sums.size[k, t + s] = size[0, s]
                for c in range(values.shape[2]):
                    sums.mean[k, t + s, c] = values[0, s, c]
                    sums.M2[k, t + s, c] = room.work[0, 0, c]
    for r in range(len(b.kept)):
        divide_averages(b, sums, start, r)


@kernel(inlined=True)
def find_blur(b: Batch, sums: Sums, r: int, t: int) -> None:
    """Note the time of sample ``t`` of run ``r`` if it is blurred."""
    if not is_clear(b, r, t) and is_blurred(b, r, t):
        sums.rounding_from[r] = b.times[t]


@kernel
def reduce_samples(
    lanes: Lanes,
    b: Batch,
    sums: Sums,
    room: Room,
    values: FloatArray,
    start: int,
    first: int,
    t: int,
) -> None:
    """Write ``values`` (R, S, F (2 u + 1)) of the samples from ``t`` on of the runs from ``first``
    on, and add them to the averages, which begin with sample ``start``.
    """
    filters, n = b.error.shape[2:]
    width, each = n * (n + 1) + 1, filters * values.shape[1]
    # L samples at a time, over runs, times and filters alike.
    samples = len(values) * each
    for place in range(0, samples, len(lanes)):
        count = min(len(lanes), samples - place)
        run, s, f = place // each, place % each // filters, place % filters
        begin = run, s, f
        for q in range(count):
            out = values[run, s, f * width : (f + 1) * width]
            fill_sample(b, first + run, t + s, f, out, room, q)
            run, s, f = next_sample(run, s, f, values.shape[1], filters)
        nees_of_lanes(lanes, room)
        run, s, f = begin
        for q in range(count):
            r = first + run
            if t + s < b.kept[r]:
                # Singular or broken: alone, with a choice of pivots.
                if room.broken[q] > 0.0:
                    nees_alone(b, sums, room, r, t + s, f, q)
                values[run, s, (f + 1) * width - 1] = room.nees[q]
                add_sample(b, sums, room, start, r, t + s, f, q)
            run, s, f = next_sample(run, s, f, values.shape[1], filters)


@kernel(inlined=True)
def next_sample(run: int, s: int, f: int, times: int, filters: int) -> tuple[int, int, int]:
    """The place after run, time and filter, the last of which moves first."""
    if f + 1 < filters:
        return run, s, f + 1
    if s + 1 < times:
        return run, s + 1, 0
    return run + 1, 0, 0


@kernel(inlined=True)
def fill_sample(b: Batch, r: int, t: int, f: int, out: FloatArray, room: Room, q: int) -> None:
    """Write the columns (2 u + 1,) of a sample but NEES, and put it into lane ``q``; zeros and
    the unit matrix where the run has no such sample.
    """
    n = b.error.shape[3]
    half, column, square, trace = n * (n + 1) // 2, 0, 0.0, 0.0
    exists = t < b.kept[r]
    if not exists:
        for c in range(2 * half + 1):
            out[c] = 0.0
    for i in range(n):
        e = b.error[r, t, f, i] if exists else 0.0
        room.error[i, q] = e
        square += e * e
        trace += b.P[r, t, f, i, i]
        for j in range(i, n):
            if exists:
                entry = b.P[r, t, f, i, j]
                room.P[j, i, q] = entry
                out[column] = entry
                out[half + column] = e * b.error[r, t, f, j]
                column += 1
            else:
                room.P[j, i, q] = 1.0 if i == j else 0.0
    room.square[q], room.trace[q] = square, trace


@kernel
def nees_alone(b: Batch, sums: Sums, room: Room, r: int, t: int, f: int, q: int) -> None:
    """Write NEES of one sample into lane ``q``, and note where its P is singular."""
    error, P = b.error[r, t, f : f + 1], b.P[r, t, f : f + 1]
    if not fill_nees(error, P, room.alone, room.factor, room.solved):
        sums.regular[r] = False
    room.nees[q] = b.given[r, t, f] if b.known[r] else room.alone[0]


@kernel(inlined=True)
def add_sample(
    b: Batch, sums: Sums, room: Room, start: int, r: int, t: int, f: int, q: int
) -> None:
    """Add the sample in lane ``q`` to the averages of run ``r``, by the rule of
    ``runs.summary.averaged_samples``.
    """
    first = start if start < b.kept[r] else 0  # no sample after time 0: all that there are
    if t < first:
        return
    from_here = sums.rounding_from[r]
    if b.times[t] < from_here:
        sums.averages[r, f, 0] += room.square[q]
        sums.averages[r, f, 2] += room.nees[q]
    # Covariances have all their digits, but those of a run that diverges outgrow all bounds.
    elif b.diverged[r] and b.times[first] < from_here:
        return
    sums.averages[r, f, 1] += room.trace[q]


@kernel
def divide_averages(b: Batch, sums: Sums, start: int, r: int) -> None:
    """Divide the sums of run ``r`` by the numbers of samples in them."""
    kept = b.kept[r]
    first = start if start < kept else 0
    clear = first
    while clear < kept and b.times[clear] < sums.rounding_from[r]:
        clear += 1
    last = clear if b.diverged[r] and clear > first else kept
    for f in range(sums.averages.shape[1]):
        sums.averages[r, f, 0] /= clear - first
        sums.averages[r, f, 1] /= last - first
        sums.averages[r, f, 2] /= clear - first


@kernel(inlined=True)
def nees_of_lanes(lanes: Lanes, room: Room) -> None:
    """Write ``e' P^-1 e`` of L errors, and which P are not positive definite, or nan."""
    # P = L D L', and e' P^-1 e = z' D^-1 z with L z = e; P becomes L, and the error z.
    n, total, broken = len(room.error), spread(lanes, 0.0), spread(lanes, 0.0)
    for k in range(n):
        pivot, z = load(lanes, room.P, k, k), load(lanes, room.error, k)
        broken += select(pivot > 0.0, 0.0, 1.0)
        inverse = 1.0 / pivot
        total += z * z * inverse
        for i in range(k + 1, n):
            factor = load(lanes, room.P, i, k) * inverse
            for j in range(k + 1, i + 1):
                entry = load(lanes, room.P, i, j) - factor * load(lanes, room.P, j, k)
                store(lanes, room.P, i, j, entry)
            store(lanes, room.error, i, load(lanes, room.error, i) - factor * z)
    store(lanes, room.nees, total)
    store(lanes, room.broken, broken)


@kernel(inlined=True)
def is_clear(b: Batch, r: int, t: int) -> bool:
    """Return True if sample ``t`` of run ``r`` is surely not blurred, which squares tell without a
    root.
    """
    filters, n = b.error.shape[2:]
    largest, least = 0.0, np.inf
    # A nan is no number here: what is blurred is not decided by it either.
    for f in range(filters):
        for i in range(n):
            variance = b.P[r, t, f, i, i]
            least = variance if variance < least else least
    for f in range(filters if b.exact else 1):
        for i in range(n):
            value = abs(b.error[r, t, f, i]) if b.exact else abs(b.x[r, t, i])
            largest = value if value > largest else largest
    bound = ROUNDING * BLUR * largest
    return bool(least < np.inf and bound * bound < 0.5 * least)


@kernel
def is_blurred(b: Batch, r: int, t: int) -> bool:
    """The rule of ``trace.run.rounding_from`` for sample ``t`` of run ``r``: x (n,), P (F, n, n),
    error (F, n).
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
