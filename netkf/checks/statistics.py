"""Intervals that hold at a stated level whatever the number of samples.

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
FEWEST = 5.0


class Interval(NamedTuple):
    """An estimate and an interval that misses the truth with at most the stated probability."""

    value: float
    low: float
    high: float


def share(successes: int, trials: int, level: float) -> Interval:
    """Of a probability, by Clopper and Pearson: exact for independent trials."""
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


def off_by(chance: float, seen: Interval) -> Interval:
    """Of the distance between a probability and what it should be."""
    inside = seen.low <= chance <= seen.high
    ends = abs(seen.low - chance), abs(seen.high - chance)
    return Interval(abs(seen.value - chance), 0.0 if inside else min(ends), max(ends))


def band(samples: int, level: float) -> float:
    """Half width of a band around an empirical distribution function that holds the true one with
    probability 1 - level (Dvoretzky, Kiefer and Wolfowitz with Massart's constant).
    """
    return math.sqrt(math.log(2.0 / level) / (2.0 * samples))


def rounded(values: FloatArray) -> FloatArray:
    """To 9 significant digits, so that rounding errors make no difference of laws."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 10.0 ** (DIGITS - 1 - np.floor(np.log10(np.abs(values))))
        return np.asarray(np.where(np.isfinite(scale), np.round(values * scale) / scale, values))


def distance(one: FloatArray, other: FloatArray, level: float) -> Interval:
    """Of the largest difference between the distribution functions behind two samples, which may
    depend on each other.
    """
    return _between(np.abs(_gaps(one, other)), len(one), len(other), level)


def excess(one: FloatArray, other: FloatArray, level: float) -> Interval:
    """Of the largest probability by which the second exceeds some level more often."""
    return _between(_gaps(one, other), len(one), len(other), level)


def _gaps(one: FloatArray, other: FloatArray) -> FloatArray:
    a, b = np.sort(rounded(one)), np.sort(rounded(other))
    points = np.concatenate([a, b])
    ranks = [np.searchsorted(sample, points, "right") / len(sample) for sample in (a, b)]
    return np.asarray(ranks[0] - ranks[1])


def _between(gaps: FloatArray, a: int, b: int, level: float) -> Interval:
    value = max(0.0, float(gaps.max()))
    width = band(a, level / 2.0) + band(b, level / 2.0)
    return Interval(value, max(0.0, value - width), min(1.0, value + width))


def distance_to(
    cdf: Callable[[FloatArray], FloatArray], values: FloatArray, level: float
) -> Interval:
    """Of the largest difference between the law behind a sample and a given one."""
    points = np.unique(rounded(values))
    slack = 10.0 ** (1 - DIGITS) * np.maximum(np.abs(points), 1e-300)
    ranks = np.searchsorted(np.sort(rounded(values)), points, "right") / len(values)
    before = np.searchsorted(np.sort(rounded(values)), points, "left") / len(values)
    # A point stands for an interval of rounding: the law's mass may be at either end of it.
    above = np.maximum(ranks - cdf(points + slack), 0.0)
    below = np.maximum(cdf(points - slack) - before, 0.0)
    value = float(max(above.max(), below.max()))
    width = band(len(values), level)
    return Interval(value, max(0.0, value - width), min(1.0, value + width))


def mean_ratio(total: float, freedom: float, level: float) -> Interval:
    """Of ``c`` where ``total`` is c times a chi-square variable of that many degrees of freedom."""
    upper = 2.0 * float(scipy.special.gammaincinv(freedom / 2.0, 1.0 - level / 2.0))
    lower = 2.0 * float(scipy.special.gammaincinv(freedom / 2.0, level / 2.0))
    return Interval(total / freedom, total / upper, total / lower)


def mean_of(values: FloatArray, level: float) -> Interval:
    """Of the mean of positive values with a variance: their sum is taken for a scaled chi-square
    variable, whose skewness a normal one lacks, with at most one degree of freedom for each value,
    because a small sample does not show its tail.
    """
    mean, variance = float(values.mean()), float(values.var(ddof=1)) if len(values) > 1 else 0.0
    if variance <= 0.0 or not mean > 0.0:
        return Interval(mean, mean, mean)
    freedom = len(values) * min(1.0, 2.0 * mean * mean / variance)
    ratio = mean_ratio(freedom, freedom, level)
    return Interval(mean, mean * ratio.low, mean * ratio.high)


def spread(samples: FloatArray, level: float) -> Interval:
    """Of the largest eigenvalue of the mean of symmetric (R, n, n) samples with a variance: all
    directions at once, by Scheffe's method for the n (n + 1) / 2 entries.
    """
    count, n = len(samples), samples.shape[-1]
    mean = samples.mean(axis=0)
    values, vectors = np.linalg.eigh(mean)
    entries = n * (n + 1) // 2
    reach = math.sqrt(2.0 * float(scipy.special.gammainccinv(entries / 2.0, level)) / count)
    along = np.einsum("ia,rij,ja->ra", vectors, samples, vectors).std(axis=0, ddof=1)
    low = float((values - reach * along).max())
    flat = samples.reshape(count, -1)
    covariance = np.atleast_2d(np.cov(flat, rowvar=False))
    widest = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
    return Interval(float(values[-1]), low, float(values[-1]) + reach * widest)


def chi_square(counts: np.ndarray, chances: FloatArray) -> tuple[float, int]:
    """(p-value, cells) of Pearson's test; rare cells at the end are taken together."""
    expected = chances * counts.sum()
    kept = max(1, int((expected >= FEWEST).sum()))
    expected = np.append(expected[: kept - 1], counts.sum() - expected[: kept - 1].sum())
    seen = np.append(counts[: kept - 1], counts[kept - 1 :].sum())
    if len(seen) < 2:
        return 1.0, len(seen)
    statistic = float(((seen - expected) ** 2 / expected).sum())
    return float(scipy.special.gammaincc((len(seen) - 1) / 2.0, statistic / 2.0)), len(seen)
