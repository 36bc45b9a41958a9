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


POWER = 0.9
"""Probability with which an error of the size that a row calls detectable is found."""


class Interval(NamedTuple):
    """An estimate and an interval that misses the truth with at most the stated probability.

    ``detectable``: the distance of the truth from its expected value at which the interval leaves
    the expected value out with probability POWER. An interval for a distance knows the two values
    that are apart, ``seen`` and ``expected``. ``again``: the two limits around another value with a
    factor of that many times the samples; by default their distance shrinks as 1 / sqrt(factor).
    """

    value: float
    low: float
    high: float
    detectable: float = math.nan
    seen: float = math.nan
    expected: float = math.nan
    again: Callable[[float, float], tuple[float, float]] | None = None

    def limits(self, value: float, factor: float) -> tuple[float, float]:
        """Return the limits around ``value`` with ``factor`` times the samples."""
        if self.again is not None:
            return self.again(value, factor)
        root = math.sqrt(factor)
        return value - (self.value - self.low) / root, value + (self.high - self.value) / root

    def expected_high(self, factor: float) -> float:
        """Return the upper limit expected with ``factor`` times the samples, if the distance found
        is sampling error.
        """
        # Sampling error shrinks as 1 / sqrt(samples); a value of 0 or below is kept.
        value = self.value / math.sqrt(factor) if self.value > 0.0 else self.value
        return self.limits(value, factor)[1]


def detectable_shift(deviation: float, level: float) -> float:
    """Return the shift that a two-sided test at ``level`` finds with probability POWER, where the
    estimate is about normal with this standard deviation.
    """
    return deviation * float(_normal_quantile(1.0 - level / 2.0) + _normal_quantile(POWER))


def student_interval(value: float, deviation: float, count: int, level: float) -> Interval:
    """Return Student's interval for an estimate whose standard deviation comes from ``count``
    independent values.
    """

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another mean and ``factor`` times the samples."""
        quantile = -float(scipy.special.stdtrit(factor * count - 1.0, level / 2.0))
        reach = deviation / math.sqrt(factor) * quantile
        return value - reach, value + reach

    low, high = limits(value, 1.0)
    return Interval(value, low, high, detectable_shift(deviation, level), again=limits)


def _normal_quantile(probability: float) -> float:
    """Return the quantile of the standard normal law."""
    return float(scipy.special.ndtri(probability))


def probability_interval(successes: int, trials: int, level: float) -> Interval:
    """Return the interval of Clopper and Pearson, exact for independent trials."""
    low = high = detectable = math.nan

    def limits(share: float, factor: float) -> tuple[float, float]:
        """Return both ends for another share and ``factor`` times the trials (Clopper-Pearson)."""
        hits = min(max(share, 0.0), 1.0) * trials * factor
        missed = trials * factor - hits
        low = float(scipy.special.betaincinv(hits, missed + 1, level / 2)) if hits else 0.0
        high = float(scipy.special.betaincinv(hits + 1, missed, 1 - level / 2)) if missed else 1.0
        return low, high

    if trials:
        low, high = limits(successes / trials, 1.0)
        # At least one half of a trial on either side: a fraction of 0 or 1 has a spread too.
        p = (successes + 0.5) / (trials + 1.0)
        detectable = detectable_shift(math.sqrt(p * (1.0 - p) / trials), level)
    return Interval(successes / max(trials, 1), low, high, detectable, again=limits)


def affine(found: Interval, scale: float, shift: float) -> Interval:
    """Return the interval of ``scale`` times a quantity plus ``shift``; the scale is positive."""

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another value and ``factor`` times the samples."""
        low, high = found.limits((value - shift) / scale, factor)
        return scale * low + shift, scale * high + shift

    value, low, high = (scale * end + shift for end in found[:3])
    return Interval(value, low, high, scale * found.detectable, again=limits)


def with_drawn(found: Interval, drawn: Callable[[float], float]) -> Interval:
    """Return the interval of samples that do not grow with the runs: a factor on the runs is one of
    ``drawn(factor)`` on them.
    """

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for ``factor`` times the runs, of which fewer may be drawn."""
        more = drawn(factor)
        # The value has been taken for one that shrinks with the runs.
        return found.limits(value * math.sqrt(factor / more), more)

    return found._replace(again=limits)


def deviation_interval(expected: float, found: Interval) -> Interval:
    """Return an interval for the distance of a quantity from its expected value."""
    inside = found.low <= expected <= found.high
    ends = abs(found.low - expected), abs(found.high - expected)
    low = 0.0 if inside else min(ends)
    apart = abs(found.value - expected)
    side = math.copysign(1.0, found.value - expected)

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return 0 and the largest distance for another value and ``factor`` times the samples."""
        ends = found.limits(expected + side * value, factor)
        return 0.0, max(abs(end - expected) for end in ends)

    return Interval(apart, low, max(ends), found.detectable, found.value, expected, limits)


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


def law_distance(
    one: FloatArray, other: FloatArray, level: float, rounding: float = 0.0
) -> Interval:
    """Return an interval for the largest difference between the distribution functions behind two
    samples (S,) and (S',), which may depend on each other; further runs add to the first one.

    Values that differ by less than ``rounding``, or in the last of DIGITS digits, count as equal.
    """
    gaps = np.abs(_ecdf_gaps(one, other, rounding))
    return _band_interval(gaps, len(one), len(other), level, grow=False)


def law_excess(one: FloatArray, other: FloatArray, level: float, rounding: float = 0.0) -> Interval:
    """Return an interval for the largest ``P(other > x) - P(one > x)`` over all x; see
    :func:`law_distance` for ``rounding``. Further runs add to both samples.
    """
    gaps = _ecdf_gaps(one, other, rounding)
    return _band_interval(gaps, len(one), len(other), level, grow=True)


def _ecdf_gaps(one: FloatArray, other: FloatArray, rounding: float) -> FloatArray:
    """Return the difference of two empirical distribution functions above each distinct value."""
    a, b = np.sort(one), np.sort(other)
    points = np.sort(np.concatenate([a, b]))
    # Neighbours that only rounding parts are one value: the gap is that above the last of them.
    with np.errstate(invalid="ignore"):
        apart = np.diff(points) > np.maximum(rounding, 10.0 ** (1 - DIGITS) * np.abs(points[1:]))
    points = points[np.append(apart, True)]
    ranks = [np.searchsorted(sample, points, "right") / len(sample) for sample in (a, b)]
    return np.asarray(ranks[0] - ranks[1])


def _band_interval(gaps: FloatArray, a: int, b: int, level: float, grow: bool) -> Interval:
    """Return the interval of the largest difference of two distribution functions of a and b
    samples.
    """
    value = max(0.0, float(gaps.max()))
    widths = band_width(a, level / 2.0), band_width(b, level / 2.0)
    width = sum(widths)

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another distance and ``factor`` times the samples."""
        first, second = widths[0] / math.sqrt(factor), widths[1]
        reach = first + (second / math.sqrt(factor) if grow else second)
        return value - reach, value + reach

    # At one point the difference of the two has at most this deviation.
    spread = 0.5 * math.sqrt(1.0 / a + 1.0 / b)
    detectable = min(1.0, width + _normal_quantile(POWER) * spread)
    ends = max(0.0, value - width), min(1.0, value + width)
    return Interval(value, *ends, detectable, again=limits)


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
    spread = 0.5 / math.sqrt(len(values))
    detectable = min(1.0, width + _normal_quantile(POWER) * spread)
    return band_around(value, width, detectable)


def band_around(value: float, width: float, detectable: float = math.nan) -> Interval:
    """Return the interval for a difference of probabilities that is off by at most ``width``."""

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another distance and ``factor`` times the samples."""
        reach = width / math.sqrt(factor)
        return value - reach, value + reach

    ends = max(0.0, value - width), min(1.0, value + width)
    return Interval(value, *ends, detectable, again=limits)


def scale_interval(total: float, freedom: float, level: float) -> Interval:
    """Return an interval for c if ``total`` is c times a chi-square variable with ``freedom``
    degrees of freedom.
    """

    def quantiles(freedom: float) -> tuple[float, float]:
        """Return the upper and lower quantile of chi-square."""
        tails = 1.0 - level / 2.0, level / 2.0
        upper, lower = (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, p)) for p in tails)
        return upper, lower

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another variance and ``factor`` times the samples."""
        more = factor * freedom
        upper, lower = quantiles(more)
        return value * more / upper, value * more / lower

    upper, lower = quantiles(freedom)
    # c times a chi-square variable leaves the interval with probability POWER.
    up = upper / (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, 1.0 - POWER)))
    down = lower / (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, POWER)))
    detectable = max(up - 1.0, 1.0 - down)
    return Interval(total / freedom, total / upper, total / lower, detectable, again=limits)


def quadratic_interval(total: float, weights: FloatArray, level: float) -> Interval:
    """Return an interval for c if ``total`` is c times a sum of squares of independent standard
    Gaussian numbers with ``weights`` (K,), at least 0.

    Its ends are quantiles of the sum by the saddle-point formula of Lugannani and Rice, whose
    relative error in the tails is a few per cent for any weights; it is exact where all are equal,
    since the sum is then taken for the chi-square variable that it is.
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
    """Return the value that the sum of :func:`quadratic_interval` exceeds (``upper``), or stays
    below, with probability ``tail``.
    """
    # K'(s) = sum w / (1 - 2 s w) grows with s, which therefore stands for the value in the search.
    far = 0.5 / float(weights.max())
    wanted = math.log(tail)
    low, high = (0.0, far) if upper else (-1e12 * far, 0.0)
    for _ in range(200):
        if upper:
            middle = 0.5 * (low + high)
        else:  # over many orders of magnitude
            middle = -math.sqrt(max(-low, 1e-300) * max(-high, 1e-12 * far))
        inside = _log_tail(weights, middle) > wanted
        if inside == upper:
            low = middle
        else:
            high = middle
        if abs(high - low) <= 1e-10 * max(abs(high), abs(low)):
            break
    return float((weights / (1.0 - 2.0 * low * weights)).sum())


def _log_tail(weights: FloatArray, s: float) -> float:
    """Return the logarithm of the probability beyond K'(s), above it for s > 0 and below for
    s < 0, by Lugannani and Rice.
    """
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
    """Return an interval for the largest eigenvalue of the mean of symmetric samples (R, n, n) with
    a variance: all directions at once, by Scheffe's method for the n (n + 1) / 2 entries, with
    Student's law of a mean of R samples for each.
    """
    count, n = len(samples), samples.shape[-1]
    mean = samples.mean(axis=0)
    values, vectors = np.linalg.eigh(mean)
    entries = n * (n + 1) // 2
    # Hotelling's T squared allows for variances that are estimated from few samples.
    freedom = max(count - entries, 1)
    ratio = float(scipy.special.fdtri(entries, freedom, 1.0 - level))
    reach = math.sqrt(entries * (count - 1) / freedom * ratio / count)
    # Any direction bounds the largest eigenvalue from below, here the eigenvectors of the mean.
    along = np.einsum("ia,rij,ja->ra", vectors, samples, vectors).std(axis=0, ddof=1)
    low = float((values - reach * along).max())
    # From above it takes the direction in which the samples vary most.
    flat = samples.reshape(count, -1)
    covariance = np.atleast_2d(np.cov(flat, rowvar=False))
    widest = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
    spread = float(along[-1]) / math.sqrt(count)
    detectable = reach * float(along.max()) + _normal_quantile(POWER) * spread
    return Interval(float(values[-1]), low, float(values[-1]) + reach * widest, detectable)


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
