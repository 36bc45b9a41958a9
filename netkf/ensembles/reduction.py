"""What the statistics of an ensemble need of each run of a batch, computed for all runs at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, Lanes, aligned, any_lane, load, select, spread, store
from netkf.trace.batch import RunBatch
from netkf.trace.nees import errors, fill_nees
from netkf.trace.run import BLUR, ROUNDING


class Reduced(NamedTuple):
    """Values of R runs, each independent of the others in its batch.

    ``samples`` (R, T, F, 2 u + 1): upper triangles of P and of e e' with the error e, then NEES;
    0 where a run has no sample, and ``size`` (R, T) is 0 there, else 1. ``averages`` (R, F, 3):
    mean square error, mean trace of P and mean NEES over the samples after time 0, nan where there
    is none. ``rounding_from`` (R,): the first sample time at which rounding blurs the errors, inf
    where none.
    """

    samples: FloatArray
    size: FloatArray
    averages: FloatArray
    rounding_from: FloatArray


def reduce_batch(batch: RunBatch) -> Reduced:
    """Values of all runs of a batch; the last sample of a run that diverged is left out."""
    runs, count, filters, n = batch.error.shape
    kept = batch.lengths - batch.diverged
    samples = np.empty((runs, count, filters, n * (n + 1) + 1))
    reduced = Reduced(
        samples, np.zeros((runs, count)), np.zeros((runs, filters, 3)), np.full(runs, np.inf)
    )
    regular = np.ones(runs, dtype=np.bool_)
    room = NeesRoom(
        aligned((n, LANES)), aligned((n, n, LANES)), aligned((LANES,)), np.empty((n, n)),
        np.empty((n, 1)), np.empty(1),
    )  # fmt: skip
    # Times and filters as one axis: samples of a run lie one after the other.
    flat = [v.reshape(runs, count * filters, *v.shape[3:]) for v in (batch.error, batch.P, samples)]
    fill_samples(MANY, flat[0], flat[1], kept * filters, flat[2], regular, room)
    for r in np.flatnonzero(~regular):
        # Some P is exactly singular: those that are singular up to rounding are left out as well.
        samples[r, : kept[r], :, -1] = errors(batch.error[r, : kept[r]], batch.P[r, : kept[r]])[1]
    given = batch.times, batch.x, batch.P, batch.error, batch.lengths, batch.diverged
    fill_reduced(*given, batch.exact_errors, *reduced)
    return reduced


class NeesRoom(NamedTuple):
    """Scratch: the error (n, L), P and its factor (n, n, L) and NEES (L,) of L samples, of one
    sample ``factor`` (n, n), ``solved`` (n, 1) and NEES ``alone`` (1,).
    """

    error: FloatArray
    P: FloatArray
    nees: FloatArray
    factor: FloatArray
    solved: FloatArray
    alone: FloatArray


@kernel
def fill_samples(
    lanes: Lanes,
    error: FloatArray,
    P: FloatArray,
    kept: np.ndarray,
    samples: FloatArray,
    regular: np.ndarray,
    room: NeesRoom,
) -> None:
    """Write the samples (R, K, 2 u + 1) of K errors (R, K, n) and P (R, K, n, n) of each run, zeros
    behind those that are ``kept`` (R,), and whether all its P are regular (R,); see ``fill_nees``.
    """
    last = samples.shape[2] - 1
    for r in range(len(kept)):
        # L samples at a time, over times and filters alike.
        for first in range(0, kept[r], len(lanes)):
            count = min(len(lanes), kept[r] - first)
            for q in range(count):
                fill_sample(error, P, r, first + q, q, samples, room)
            fine = nees_of_lanes(lanes, room)
            for q in range(count):
                samples[r, first + q, last] = room.nees[q]
            # Singular or broken: sample by sample, with a choice of pivots.
            if not fine:
                for k in range(first, first + count):
                    one, matrix = error[r, k : k + 1], P[r, k : k + 1]
                    if not fill_nees(one, matrix, room.alone, room.factor, room.solved):
                        regular[r] = False
                    samples[r, k, last] = room.alone[0]
        for k in range(kept[r], samples.shape[1]):
            for column in range(last + 1):
                samples[r, k, column] = 0.0


@kernel(inlined=True)
def fill_sample(
    error: FloatArray, P: FloatArray, r: int, k: int, q: int, out: FloatArray, room: NeesRoom
) -> None:
    """Write the columns of sample ``k`` of run ``r`` but NEES, and put it into lane ``q``."""
    n = error.shape[2]
    half, column = n * (n + 1) // 2, 0
    for i in range(n):
        e = error[r, k, i]
        room.error[i, q] = e
        for j in range(i, n):
            entry = P[r, k, i, j]
            room.P[j, i, q] = out[r, k, column] = entry
            out[r, k, half + column] = e * error[r, k, j]
            column += 1


@kernel(inlined=True)
def nees_of_lanes(lanes: Lanes, room: NeesRoom) -> bool:
    """Write ``e' P^-1 e`` of L errors; return False if a P is not positive definite, or nan."""
    # P = L D L', and e' P^-1 e = z' D^-1 z with L z = e; P becomes L, and the error z.
    n, total, fine = len(room.error), spread(lanes, 0.0), True
    for k in range(n):
        pivot, z = load(lanes, room.P, k, k), load(lanes, room.error, k)
        fine = fine and not any_lane(select(pivot > 0.0, 0.0, 1.0) > 0.0)
        inverse = 1.0 / pivot
        total += z * z * inverse
        for i in range(k + 1, n):
            factor = load(lanes, room.P, i, k) * inverse
            for j in range(k + 1, i + 1):
                entry = load(lanes, room.P, i, j) - factor * load(lanes, room.P, j, k)
                store(lanes, room.P, i, j, entry)
            store(lanes, room.error, i, load(lanes, room.error, i) - factor * z)
    store(lanes, room.nees, total)
    return fine


@kernel
def fill_reduced(
    times: FloatArray,
    x: FloatArray,
    P: FloatArray,
    error: FloatArray,
    lengths: np.ndarray,
    diverged: np.ndarray,
    exact: bool,
    samples: FloatArray,
    size: FloatArray,
    averages: FloatArray,
    rounding_from: FloatArray,
) -> None:
    """Fill the arrays of Reduced from those of a RunBatch and its samples."""
    n = P.shape[4]
    for r in range(len(lengths)):
        kept = lengths[r] - 1 if diverged[r] else lengths[r]
        for t in range(kept):
            size[r, t] = 1.0
        for t in range(lengths[r]):
            if not is_clear(x, P, error, r, t, exact) and is_blurred(x, P, error, r, t, exact):
                rounding_from[r] = times[t]
                break
        average_samples(times, samples, r, n, kept, diverged[r], rounding_from[r], averages)


@kernel(inlined=True)
def is_clear(x: FloatArray, P: FloatArray, error: FloatArray, r: int, t: int, exact: bool) -> bool:
    """Return True if sample ``t`` of run ``r`` is surely not blurred, which squares tell without a
    root; arrays as in ``is_blurred``.
    """
    filters, n = error.shape[2:]
    largest, least = 0.0, np.inf
    # A nan is no number here: what is blurred is not decided by it either.
    for f in range(filters):
        for i in range(n):
            variance = P[r, t, f, i, i]
            least = variance if variance < least else least
    for f in range(filters if exact else 1):
        for i in range(n):
            value = abs(error[r, t, f, i]) if exact else abs(x[r, t, i])
            largest = value if value > largest else largest
    bound = ROUNDING * BLUR * largest
    return bool(least < np.inf and bound * bound < 0.5 * least)


@kernel
def is_blurred(
    x: FloatArray, P: FloatArray, error: FloatArray, r: int, t: int, exact: bool
) -> bool:
    """The rule of ``trace.run.rounding_from`` for sample ``t`` of run ``r``: x (n,), P (F, n, n),
    error (F, n).
    """
    filters, n = error.shape[2:]
    largest, least, square = 0.0, np.inf, 0.0
    given, broken = False, False
    for f in range(filters):
        for i in range(n):
            value = abs(error[r, t, f, i]) if exact else abs(x[r, t, i])
            broken = broken or np.isnan(value) or np.isnan(P[r, t, f, i, i])
            largest, least = max(largest, value), min(least, P[r, t, f, i, i])
            if not given:
                square += error[r, t, f, i] * error[r, t, f, i]
                for j in range(n):
                    given = given or not np.isnan(P[r, t, f, i, j])
    if not given:
        # The filter gives no covariance: the errors themselves show their size.
        broken, least = np.isnan(square) or np.isnan(largest), square / (filters * n)
    deviation = np.sqrt(max(least, 0.0)) / BLUR
    return not broken and deviation > 0.0 and ROUNDING * largest > deviation


@kernel
def average_samples(
    times: FloatArray,
    samples: FloatArray,
    r: int,
    n: int,
    kept: int,
    diverged: bool,
    rounding_from: float,
    out: FloatArray,
) -> None:
    """Write the averages (F, 3) of run ``r`` over its first ``kept`` samples (T, F, 2 u + 1), by
    the rule of ``runs.summary.averaged_samples``.
    """
    half = n * (n + 1) // 2
    first = 0
    while first < kept and not times[first] > 0.0:
        first += 1
    first = 0 if first == kept else first  # no sample after time 0: all that there are
    clear = first
    while clear < kept and times[clear] < rounding_from:
        clear += 1
    # Covariances have all their digits, but those of a run that diverges outgrow all bounds.
    last = clear if diverged and clear > first else kept
    for t in range(first, kept):
        for f in range(out.shape[1]):
            column, square, trace = 0, 0.0, 0.0
            for i in range(n):
                trace += samples[r, t, f, column]
                square += samples[r, t, f, half + column]
                column += n - i
            if t < last:
                out[r, f, 1] += trace
            if t < clear:
                out[r, f, 0] += square
                out[r, f, 2] += samples[r, t, f, 2 * half]
    for f in range(out.shape[1]):
        out[r, f, 0] /= clear - first
        out[r, f, 1] /= last - first
        out[r, f, 2] /= clear - first
