"""Intervals of laws of covariances, which hold at a stated level for every number of samples.

All samples are independent replicas, one value each. Laws are compared by indicators and ranks,
never by means, which need not exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy

from netkf.laws.intervals import POWER, Interval, noncentrality, scale_interval
from netkf.linalg.arrays import FloatArray

DIGITS = 9
"""Significant digits to which covariances are compared."""
MIN_EXPECTED = 5.0
"""Expected count of a cell below which Pearson's statistic is not chi-square."""


def affine(interval: Interval, scale: float, shift: float) -> Interval:
    """Return the interval of ``scale`` times a quantity plus ``shift``; the scale is positive."""

    def limits(value: float, factor: float) -> tuple[float, float]:
        low, high = interval.limits((value - shift) / scale, factor)
        return scale * low + shift, scale * high + shift

    value, low, high = (scale * end + shift for end in interval[:3])
    return Interval(value, low, high, scale * interval.detectable, again=limits)


def band_width(samples: int, level: float) -> float:
    """Return the half width of the DKW band of ``samples`` values, which misses with ``level``."""
    return math.sqrt(math.log(2.0 / level) / (2.0 * samples))


def round_digits(values: FloatArray) -> FloatArray:
    """Return ``values`` rounded to 9 significant digits, so that rounding makes no difference."""
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 10.0 ** (DIGITS - 1 - np.floor(np.log10(np.abs(values))))
        return np.asarray(np.where(np.isfinite(scale), np.round(values * scale) / scale, values))


def law_distance(
    first: FloatArray, second: FloatArray, level: float, rounding: float = 0.0
) -> Interval:
    """Return an interval for sup |F - G| of the laws of two samples (Kolmogorov-Smirnov), which may
    depend on each other; values within ``rounding`` are equal, further runs add to the first.
    """
    gaps = np.abs(_ecdf_gaps(first, second, rounding))
    return _band_interval(gaps, len(first), len(second), level, grow=False)


def law_excess(first: FloatArray, second: FloatArray, level: float) -> Interval:
    """Return an interval for the largest ``P(second > x) - P(first > x)`` of two samples."""
    gaps = _ecdf_gaps(first, second, rounding=0.0)
    return _band_interval(gaps, len(first), len(second), level, grow=True)


def _ecdf_gaps(first: FloatArray, second: FloatArray, rounding: float) -> FloatArray:
    """Return the differences (V,) of two empirical distribution functions at V values."""
    a, b = np.sort(first), np.sort(second)
    points = np.sort(np.concatenate([a, b]))
    # Neighbours that differ by rounding only are one value, represented by the largest of them.
    with np.errstate(invalid="ignore"):
        distinct = np.diff(points) > np.maximum(rounding, 10.0 ** (1 - DIGITS) * np.abs(points[1:]))
    points = points[np.append(distinct, True)]
    ranks = [np.searchsorted(sample, points, "right") / len(sample) for sample in (a, b)]
    return np.asarray(ranks[0] - ranks[1])


def _band_interval(gaps: FloatArray, a: int, b: int, level: float, grow: bool) -> Interval:
    """Return the interval of the largest of ``gaps`` (V,), with a band around each sample."""
    value = max(0.0, float(gaps.max()))
    first, second = band_width(a, level / 2.0), band_width(b, level / 2.0)
    # At any one point the standard deviation of the difference is at most sqrt(1/(4a) + 1/(4b)).
    spread = 0.5 * math.sqrt(1.0 / a + 1.0 / b)
    detectable = first + second + float(scipy.special.ndtri(POWER)) * spread
    shrinking = first + (second if grow else 0.0)
    return band_around(value, shrinking, detectable, first + second - shrinking)


def distance_to_law(
    cdf: Callable[[FloatArray], FloatArray], values: FloatArray, level: float
) -> Interval:
    """Return an interval for the distance of ``values`` (S,) from ``cdf``, by its DKW band."""
    points = np.unique(round_digits(values))
    slack = 10.0 ** (1 - DIGITS) * np.maximum(np.abs(points), 1e-300)
    ranks = np.searchsorted(np.sort(round_digits(values)), points, "right") / len(values)
    ranks_below = np.searchsorted(np.sort(round_digits(values)), points, "left") / len(values)
    # A rounded value stands for an interval: an atom of the law may lie anywhere in it.
    above = np.maximum(ranks - cdf(points + slack), 0.0)
    below = np.maximum(cdf(points - slack) - ranks_below, 0.0)
    value = float(max(above.max(), below.max()))
    width = band_width(len(values), level)
    spread = 0.5 / math.sqrt(len(values))
    return band_around(value, width, width + float(scipy.special.ndtri(POWER)) * spread)


def band_around(
    value: float, width: float, detectable: float = math.nan, fixed: float = 0.0
) -> Interval:
    """Return ``value`` +- (``width`` + ``fixed``) in [0, 1]; more runs make the width smaller."""

    def limits(value: float, factor: float) -> tuple[float, float]:
        reach = width / math.sqrt(factor) + fixed
        return value - reach, value + reach

    low, high = limits(value, 1.0)
    ends = max(0.0, low), min(1.0, high), min(detectable, 1.0)
    return Interval(value, *ends, again=limits)


def quadratic_interval(total: float, weights: FloatArray, level: float) -> Interval:
    """Return the interval of c if ``total`` is c times sum_k weights_k z_k^2 with standard normal
    z_k: Lugannani and Rice (1980), to a few per cent in the tails, exact for equal weights.
    """
    weights = weights[weights > 1e-12 * weights.max(initial=0.0)]
    if not len(weights):
        return Interval(math.nan, 0.0, math.inf)
    mean = float(weights.sum())
    if np.ptp(weights) <= 1e-9 * weights.max():
        return scale_interval(total / float(weights[0]), float(len(weights)), level)
    upper, lower = (_quadratic_quantile(weights, level / 2.0, up) for up in (True, False))
    # Quantiles in the middle are near those of a scaled chi-square variable.
    freedom = mean**2 / float((weights**2).sum())
    up, down = (
        2.0 * mean / freedom * float(scipy.special.gammaincinv(freedom / 2.0, probability))
        for probability in (1.0 - POWER, POWER)
    )
    detectable = max(upper / up - 1.0, 1.0 - lower / down)
    # With more runs: as the chi-square variable of the same spread.
    again = scale_interval(freedom, freedom, level).again
    return Interval(total / mean, total / upper, total / lower, detectable, again=again)


def _quadratic_quantile(weights: FloatArray, tail: float, upper: bool) -> float:
    """Return the quantile of a weighted sum of squares that has so much in its ``tail``."""
    # The saddle point of a value x solves K'(s) = sum w / (1 - 2 s w) = x, with K the cumulant
    # generating function. K' increases up to its pole, so that bisection over s finds the quantile.
    pole = 0.5 / float(weights.max())
    log_target = math.log(tail)
    low, high = (0.0, pole) if upper else (-1e12 * pole, 0.0)
    for _ in range(200):
        if upper:
            middle = 0.5 * (low + high)
        else:  # over many orders of magnitude
            middle = -math.sqrt(max(-low, 1e-300) * max(-high, 1e-12 * pole))
        is_above = _log_tail(weights, middle) > log_target
        if is_above == upper:
            low = middle
        else:
            high = middle
        if abs(high - low) <= 1e-10 * max(abs(high), abs(low)):
            break
    return float((weights / (1.0 - 2.0 * low * weights)).sum())


def _log_tail(weights: FloatArray, s: float) -> float:
    """Return the log of the tail of the sum at the saddle point s (Lugannani and Rice 1980)."""
    shrunk = 1.0 - 2.0 * s * weights
    value, curvature = float((weights / shrunk).sum()), float((2.0 * (weights / shrunk) ** 2).sum())
    cumulant = -0.5 * float(np.log(shrunk).sum())
    root = math.sqrt(max(2.0 * (s * value - cumulant), 0.0))
    if root < 1e-4:
        return math.log(0.5)
    slope = abs(s) * math.sqrt(curvature)
    density = math.exp(-0.5 * root * root) / math.sqrt(2.0 * math.pi)
    normal = 0.5 * math.erfc(root / math.sqrt(2.0))
    return math.log(max(normal + density * (1.0 / slope - 1.0 / root), 1e-300))


def eigenvalue_interval(samples: FloatArray, level: float) -> Interval:
    """Return an interval for the largest eigenvalue of the mean of symmetric ``samples`` (R, n, n):
    Scheffe's method with Hotelling's T^2.
    """
    count, n = len(samples), samples.shape[-1]
    values, vectors = np.linalg.eigh(samples.mean(axis=0))
    entries = n * (n + 1) // 2
    # T^2 = p (R - 1) / (R - p) F(p, R - p) for p entries; /R for the mean.
    freedom = max(count - entries, 1)
    ratio = float(scipy.special.fdtri(entries, freedom, 1.0 - level))
    reach = math.sqrt(entries * (count - 1) / freedom * ratio / count)
    # v' M v of any unit vector v bounds the largest eigenvalue from below: v are the eigenvectors.
    deviations = np.einsum("ia,rij,ja->ra", vectors, samples, vectors).std(axis=0, ddof=1)
    low = float((values - reach * deviations).max())
    # The upper limit needs every direction: the largest standard deviation of any is used.
    covariance = np.atleast_2d(np.cov(samples.reshape(count, -1), rowvar=False))
    widest = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
    # Student's statistic of the direction with the largest mean must exceed Hotelling's limit.
    spread = float(deviations.max()) / math.sqrt(count)
    shift = spread * noncentrality(max(count - 1.0, 1.0), reach * math.sqrt(count))
    # Matrices that are too large by a factor have deviations larger by that factor.
    largest = float(values[-1])
    detectable = shift / (1.0 - shift / largest) if shift < largest else math.nan
    return Interval(float(values[-1]), low, float(values[-1]) + reach * widest, detectable)


def pearson_test(counts: np.ndarray, probabilities: FloatArray) -> tuple[float, int]:
    """Return Pearson's p-value of ``counts`` (C,) and the number of cells; rare ones are pooled."""
    expected = probabilities * counts.sum()
    frequent = max(1, int((expected >= MIN_EXPECTED).sum()))
    expected = np.append(expected[: frequent - 1], counts.sum() - expected[: frequent - 1].sum())
    pooled = np.append(counts[: frequent - 1], counts[frequent - 1 :].sum())
    if len(pooled) < 2:
        return 1.0, len(pooled)
    statistic = float(((pooled - expected) ** 2 / expected).sum())
    p = float(scipy.special.gammaincc((len(pooled) - 1) / 2.0, statistic / 2.0))
    return p, len(pooled)
