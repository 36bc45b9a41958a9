"""What the statistics of an ensemble need of each run of a batch, computed for all runs at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
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
    samples = np.zeros((runs, count, filters, n * (n + 1) + 1))
    reduced = Reduced(
        samples, np.zeros((runs, count)), np.zeros((runs, filters, 3)), np.full(runs, np.inf)
    )
    nees, regular = np.empty((runs, count, filters)), np.ones(runs, dtype=np.bool_)
    scratch = np.empty((n, n)), np.empty((n, 1))
    fill_nees_of_runs(batch.error, batch.P, kept, nees, regular, *scratch)
    for r in np.flatnonzero(~regular):
        # Some P is exactly singular: those that are singular up to rounding are left out as well.
        nees[r, : kept[r]] = errors(batch.error[r, : kept[r]], batch.P[r, : kept[r]])[1]
    given = batch.times, batch.x, batch.P, batch.error, nees, batch.lengths, batch.diverged
    fill_reduced(*given, batch.exact_errors, *reduced)
    return reduced


@kernel
def fill_nees_of_runs(
    error: FloatArray,
    P: FloatArray,
    kept: np.ndarray,
    nees: FloatArray,
    regular: np.ndarray,
    factor: FloatArray,
    solved: FloatArray,
) -> None:
    """Write NEES (R, T, F) of the ``kept`` samples (R,) of each run, and whether all its P are
    regular (R,); see ``fill_nees``.
    """
    for r in range(len(kept)):
        for t in range(kept[r]):
            if not fill_nees(error[r, t], P[r, t], nees[r, t], factor, solved):
                regular[r] = False


@kernel
def fill_reduced(
    times: FloatArray,
    x: FloatArray,
    P: FloatArray,
    error: FloatArray,
    nees: FloatArray,
    lengths: np.ndarray,
    diverged: np.ndarray,
    exact: bool,
    samples: FloatArray,
    size: FloatArray,
    averages: FloatArray,
    rounding_from: FloatArray,
) -> None:
    """Fill the arrays of Reduced from those of a RunBatch and its NEES (R, T, F)."""
    for r in range(len(lengths)):
        kept = lengths[r] - 1 if diverged[r] else lengths[r]
        for t in range(kept):
            size[r, t] = 1.0
            fill_sample(P[r, t], error[r, t], nees[r, t], samples[r, t])
        for t in range(lengths[r]):
            if is_blurred(x[r, t], P[r, t], error[r, t], exact):
                rounding_from[r] = times[t]
                break
        average_samples(
            times, samples[r], P.shape[4], kept, diverged[r], rounding_from[r], averages[r]
        )


@kernel
def fill_sample(P: FloatArray, error: FloatArray, nees: FloatArray, out: FloatArray) -> None:
    """Write the columns (F, 2 u + 1) of one sample: P (F, n, n), error (F, n), NEES (F,)."""
    n = error.shape[1]
    half = n * (n + 1) // 2
    for f in range(len(nees)):
        column = 0
        for i in range(n):
            for j in range(i, n):
                out[f, column] = P[f, i, j]
                out[f, half + column] = error[f, i] * error[f, j]
                column += 1
        out[f, 2 * half] = nees[f]


@kernel
def is_blurred(x: FloatArray, P: FloatArray, error: FloatArray, exact: bool) -> bool:
    """The rule of ``trace.run.rounding_from`` for one sample: x (n,), P (F, n, n), error (F, n)."""
    filters, n = error.shape
    largest, least, square = 0.0, np.inf, 0.0
    given, broken = False, False
    for f in range(filters):
        for i in range(n):
            value = abs(error[f, i]) if exact else abs(x[i])
            broken = broken or np.isnan(value) or np.isnan(P[f, i, i])
            largest, least = max(largest, value), min(least, P[f, i, i])
            square += error[f, i] * error[f, i]
            for j in range(n):
                given = given or not np.isnan(P[f, i, j])
    if not given:
        # The filter gives no covariance: the errors themselves show their size.
        broken, least = np.isnan(square) or np.isnan(largest), square / (filters * n)
    deviation = np.sqrt(max(least, 0.0)) / BLUR
    return not broken and deviation > 0.0 and ROUNDING * largest > deviation


@kernel
def average_samples(
    times: FloatArray,
    samples: FloatArray,
    n: int,
    kept: int,
    diverged: bool,
    rounding_from: float,
    out: FloatArray,
) -> None:
    """Write the averages (F, 3) of one run over its first ``kept`` samples (T, F, 2 u + 1), by the
    rule of ``runs.summary.averaged_samples``.
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
    for f in range(len(out)):
        square, trace, nees = 0.0, 0.0, 0.0
        for t in range(first, kept):
            column = 0
            for i in range(n):
                if t < last:
                    trace += samples[t, f, column]
                if t < clear:
                    square += samples[t, f, half + column]
                column += n - i
            if t < clear:
                nees += samples[t, f, 2 * half]
        out[f, 0] = square / (clear - first)
        out[f, 1] = trace / (last - first)
        out[f, 2] = nees / (clear - first)
