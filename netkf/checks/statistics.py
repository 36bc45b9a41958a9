"""Intervals that hold at a stated level for every number of samples.

All samples are independent replicas, one value each. Covariances enter through indicators and
ranks, never through means: their means need not exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.linalg.arrays import FloatArray

DIGITS = 9
"""Significant digits to which covariances are compared."""
MIN_EXPECTED = 5.0
"""Expected count of a cell below which Pearson's statistic is not chi-square."""


class Interval(NamedTuple):
    """An estimate and an interval that misses the truth with at most the stated probability."""

    value: float
    low: float
    high: float


def probability_interval(successes: int, trials: int, level: float) -> Interval:
    """Return the interval of Clopper and Pearson, exact for independent trials."""
    low = high = math.nan
    if trials:
        missed = trials - successes
        low = (
            float(scipy.special.betaincinv(successes, missed + 1, level / 2)) if successes else 0.0
        )
        high = (
            float(scipy.special.betaincinv(successes + 1, missed, 1 - level / 2)) if missed else 1.0
        )
    return Interval(successes / max(trials, 1), low, high)


def deviation_interval(expected: float, found: Interval) -> Interval:
    """Return an interval for the distance of a quantity from its expected value."""
    inside = found.low <= expected <= found.high
    ends = abs(found.low - expected), abs(found.high - expected)
    return Interval(abs(found.value - expected), 0.0 if inside else min(ends), max(ends))


def band_width(samples: int, level: float) -> float:
    """Return the half width of a band around an empirical distribution function that contains the
    true one with probability 1 - level (Dvoretzky, Kiefer and Wolfowitz; Massart's constant).
    """
    return math.sqrt(math.log(2.0 / level) / (2.0 * samples))


def round_digits(values: FloatArray) -> FloatArray:
    """Round to 9 significant digits, so that rounding errors make no difference between laws."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 10.0 ** (DIGITS - 1 - np.floor(np.log10(np.abs(values))))
        return np.asarray(np.where(np.isfinite(scale), np.round(values * scale) / scale, values))


def law_distance(one: FloatArray, other: FloatArray, level: float) -> Interval:
    """Return an interval for the largest difference between the distribution functions behind two
    samples (S,) and (S',), which may depend on each other.
    """
    return _band_interval(np.abs(_ecdf_gaps(one, other)), len(one), len(other), level)


def law_excess(one: FloatArray, other: FloatArray, level: float) -> Interval:
    """Return an interval for the largest ``P(other > x) - P(one > x)`` over all x."""
    return _band_interval(_ecdf_gaps(one, other), len(one), len(other), level)


def _ecdf_gaps(one: FloatArray, other: FloatArray) -> FloatArray:
    a, b = np.sort(round_digits(one)), np.sort(round_digits(other))
    points = np.concatenate([a, b])
    ranks = [np.searchsorted(sample, points, "right") / len(sample) for sample in (a, b)]
    return np.asarray(ranks[0] - ranks[1])


def _band_interval(gaps: FloatArray, a: int, b: int, level: float) -> Interval:
    value = max(0.0, float(gaps.max()))
    width = band_width(a, level / 2.0) + band_width(b, level / 2.0)
    return Interval(value, max(0.0, value - width), min(1.0, value + width))


def distance_to_law(
    cdf: Callable[[FloatArray], FloatArray], values: FloatArray, level: float
) -> Interval:
    """Return an interval for the largest difference between ``cdf`` and the distribution function
    behind a sample (S,).
    """
    points = np.unique(round_digits(values))
    slack = 10.0 ** (1 - DIGITS) * np.maximum(np.abs(points), 1e-300)
    ranks = np.searchsorted(np.sort(round_digits(values)), points, "right") / len(values)
    before = np.searchsorted(np.sort(round_digits(values)), points, "left") / len(values)
    # A point stands for an interval of rounding: the law's mass may be at either end of it.
    above = np.maximum(ranks - cdf(points + slack), 0.0)
    below = np.maximum(cdf(points - slack) - before, 0.0)
    value = float(max(above.max(), below.max()))
    width = band_width(len(values), level)
    return Interval(value, max(0.0, value - width), min(1.0, value + width))


def scale_interval(total: float, freedom: float, level: float) -> Interval:
    """Return an interval for c if ``total`` is c times a chi-square variable with ``freedom``
    degrees of freedom.
    """
    upper = 2.0 * float(scipy.special.gammaincinv(freedom / 2.0, 1.0 - level / 2.0))
    lower = 2.0 * float(scipy.special.gammaincinv(freedom / 2.0, level / 2.0))
    return Interval(total / freedom, total / upper, total / lower)


def mean_interval(values: FloatArray, level: float) -> Interval:
    """Return an interval for the mean of positive values (R,) with a variance.

    Their sum is taken for a scaled chi-square variable, since a normal one has no skewness, with at
    most one degree of freedom per value, since a small sample does not show its tail.
    """
    mean, variance = float(values.mean()), float(values.var(ddof=1)) if len(values) > 1 else 0.0
    if variance <= 0.0 or not mean > 0.0:
        return Interval(mean, mean, mean)
    freedom = len(values) * min(1.0, 2.0 * mean * mean / variance)
    ratio = scale_interval(freedom, freedom, level)
    return Interval(mean, mean * ratio.low, mean * ratio.high)


def eigenvalue_interval(samples: FloatArray, level: float) -> Interval:
    """Return an interval for the largest eigenvalue of the mean of symmetric samples (R, n, n) with
    a variance: all directions at once, by Scheffe's method for the n (n + 1) / 2 entries.
    """
    count, n = len(samples), samples.shape[-1]
    mean = samples.mean(axis=0)
    values, vectors = np.linalg.eigh(mean)
    entries = n * (n + 1) // 2
    reach = math.sqrt(2.0 * float(scipy.special.gammainccinv(entries / 2.0, level)) / count)
    # Any direction bounds the largest eigenvalue from below, here the eigenvectors of the mean.
    along = np.einsum("ia,rij,ja->ra", vectors, samples, vectors).std(axis=0, ddof=1)
    low = float((values - reach * along).max())
    # From above it takes the direction in which the samples vary most.
    flat = samples.reshape(count, -1)
    covariance = np.atleast_2d(np.cov(flat, rowvar=False))
    widest = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
    return Interval(float(values[-1]), low, float(values[-1]) + reach * widest)


def pearson_test(counts: np.ndarray, probabilities: FloatArray) -> tuple[float, int]:
    """Return the p-value of Pearson's test and its number of cells; rare cells at the end are
    pooled.
    """
    expected = probabilities * counts.sum()
    kept = max(1, int((expected >= MIN_EXPECTED).sum()))
    expected = np.append(expected[: kept - 1], counts.sum() - expected[: kept - 1].sum())
    pooled = np.append(counts[: kept - 1], counts[kept - 1 :].sum())
    if len(pooled) < 2:
        return 1.0, len(pooled)
    statistic = float(((pooled - expected) ** 2 / expected).sum())
    p = float(scipy.special.gammaincc((len(pooled) - 1) / 2.0, statistic / 2.0))
    return p, len(pooled)
