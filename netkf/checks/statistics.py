"""Confidence intervals that hold at a stated level for every number of samples.

All samples are independent replicas, one value each. A level is the probability with which an
interval may miss the truth. Laws of covariances are compared by indicators and ranks, never by
means, which need not exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.linalg.arrays import FloatArray

DIGITS = 9
"""Significant digits to which covariances are compared."""
MIN_EXPECTED = 5.0
"""Expected count of a cell below which Pearson's statistic is not chi-square."""
POWER = 0.9
"""Probability with which a deviation of the detectable size is detected."""
_MIDDLES = (np.arange(2000) + 0.5) / 2000.0  # of equal parts of [0, 1]


class Interval(NamedTuple):
    """An estimate and an interval that misses the truth with at most the stated probability.

    value, low, high : estimate and limits
    detectable : distance of the truth from its expected value at which the interval excludes the
        expected value with probability POWER
    seen, expected : of an interval for a distance, the estimate and the expected value
    again : function (value, factor) that returns the limits around another value with ``factor``
        times the samples; by default their distance shrinks as 1 / sqrt(factor)
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
    """Return the shift that a two-sided test at ``level`` detects with probability POWER, for a
    normal estimate with standard deviation ``deviation``.
    """
    return deviation * float(_normal_quantile(1.0 - level / 2.0) + _normal_quantile(POWER))


def detectable_shift_of_student(count: float, level: float) -> float:
    """Return the shift, in true standard deviations of an estimate, that Student's test at
    ``level`` with ``count`` - 1 degrees of freedom detects with probability POWER.

    It is the noncentrality at which the quantile 1 - POWER of the noncentral t law is Student's
    critical value; the other tail has a negligible part of the power.
    """
    freedom = max(count - 1.0, 1.0)
    critical = -float(scipy.special.stdtrit(freedom, level / 2.0))
    return noncentrality(freedom, critical)


@lru_cache(maxsize=1024)
def noncentrality(freedom: float, critical: float) -> float:
    """Return the noncentrality at which a t variable with ``freedom`` degrees of freedom exceeds
    ``critical`` with probability POWER.
    """
    # (z + shift) / sqrt(u / freedom) > critical, z normal and u chi-square: by quadrature over the
    # quantiles of u, since scipy's noncentral t fails for the small levels used here.
    u = scipy.special.gammaincinv(0.5 * freedom, _MIDDLES) * 2.0 / freedom
    limits = critical * np.sqrt(u)
    low, high = 0.0, float(limits.max()) + 10.0
    for _ in range(60):
        shift = 0.5 * (low + high)
        power = float(scipy.special.ndtr(shift - limits).mean())
        low, high = (low, shift) if power > POWER else (shift, high)
    return 0.5 * (low + high)


def student_interval(value: float, deviation: float, count: float, level: float) -> Interval:
    """Return Student's t interval for an estimate ``value``, whose standard ``deviation`` was
    estimated from ``count`` independent values (or an effective number of them).

    The interval misses the truth with at most the probability ``level``.
    """

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another mean and ``factor`` times the samples."""
        quantile = -float(scipy.special.stdtrit(factor * count - 1.0, level / 2.0))
        reach = deviation / math.sqrt(factor) * quantile
        return value - reach, value + reach

    low, high = limits(value, 1.0)
    detectable = deviation * detectable_shift_of_student(count, level)
    return Interval(value, low, high, detectable, again=limits)


def _normal_quantile(probability: float) -> float:
    """Return the value that a standard normal variable does not exceed with this
    ``probability``.
    """
    return float(scipy.special.ndtri(probability))


def probability_interval(successes: int, trials: int, level: float) -> Interval:
    """Return the exact interval of Clopper and Pearson (1934) for the probability of a success,
    from ``successes`` in independent ``trials``; it misses with probability ``level``.
    """
    low = high = detectable = math.nan

    def limits(share: float, factor: float) -> tuple[float, float]:
        """Return the Clopper-Pearson limits for another share and ``factor`` times the trials."""
        hits = min(max(share, 0.0), 1.0) * trials * factor
        missed = trials * factor - hits
        low = float(scipy.special.betaincinv(hits, missed + 1, level / 2)) if hits else 0.0
        high = float(scipy.special.betaincinv(hits + 1, missed, 1 - level / 2)) if missed else 1.0
        return low, high

    if trials:
        low, high = limits(successes / trials, 1.0)
        # Half a success and half a failure are added: a fraction of 0 or 1 has a variance too.
        detectable = _binomial_shift((successes + 0.5) / (trials + 1.0), trials, level)
    return Interval(successes / max(trials, 1), low, high, detectable, again=limits)


def _binomial_shift(p: float, trials: int, level: float) -> float:
    """Return the error of a probability ``p`` that an exact two-sided binomial test at ``level``
    detects with probability POWER, in ``trials``; the larger one of both directions, of those in
    which an error can be so large that it is detected.
    """
    # Of the rarer outcome: q rises where p > 1/2 falls.
    up = _binomial_rise(p, trials, level), _binomial_rise(1.0 - p, trials, level)
    possible = [shift for shift in up if math.isfinite(shift)]
    return max(possible, default=math.nan)


def _binomial_rise(p: float, trials: int, level: float) -> float:
    """Return by how much a probability must exceed ``p`` for its test to be significant with
    probability POWER; nan if no number of successes is significant.
    """
    # The least number of successes that has at most the probability level / 2: by bisection.
    low, high = 0, trials + 1
    while high - low > 1:
        middle = (low + high) // 2
        tail = float(scipy.special.betainc(middle, trials - middle + 1, p))
        low, high = (low, middle) if tail <= 0.5 * level else (middle, high)
    if high > trials:
        return math.nan
    return float(scipy.special.betaincinv(high, trials - high + 1, POWER)) - p


def affine(interval: Interval, scale: float, shift: float) -> Interval:
    """Return the interval of ``scale`` times a quantity plus ``shift``; the scale is positive."""

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another value and ``factor`` times the samples."""
        low, high = interval.limits((value - shift) / scale, factor)
        return scale * low + shift, scale * high + shift

    value, low, high = (scale * end + shift for end in interval[:3])
    return Interval(value, low, high, scale * interval.detectable, again=limits)


def with_drawn(interval: Interval, sample_factor: Callable[[float], float]) -> Interval:
    """Return ``interval`` with another forecast of its limits with more runs, for an estimate whose
    samples do not grow in proportion to the runs: ``factor`` times the runs mean
    ``sample_factor(factor)`` times the samples.
    """

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for ``factor`` times the runs, as :meth:`Interval.limits` asks."""
        actual = sample_factor(factor)
        # The caller has divided the value by sqrt(factor); it shrinks by sqrt(actual) only.
        return interval.limits(value * math.sqrt(factor / actual), actual)

    return interval._replace(again=limits)


def deviation_interval(expected: float, interval: Interval) -> Interval:
    """Return an interval for the distance |quantity - expected| from the ``interval`` of a
    quantity that should be ``expected``; it excludes 0 if and only if the given one excludes that.
    """
    covers = interval.low <= expected <= interval.high
    ends = abs(interval.low - expected), abs(interval.high - expected)
    low = 0.0 if covers else min(ends)
    distance = abs(interval.value - expected)
    # A forecast keeps the estimate on the same side of the expected value, only nearer to it.
    side = math.copysign(1.0, interval.value - expected)

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return 0 and the largest distance for another value and ``factor`` times the samples."""
        ends = interval.limits(expected + side * value, factor)
        return 0.0, max(abs(end - expected) for end in ends)

    return Interval(
        distance,
        low,
        max(ends),
        interval.detectable,
        seen=interval.value,
        expected=expected,
        again=limits,
    )


def band_width(samples: int, level: float) -> float:
    """Return the half width of a band around the empirical distribution function of ``samples``
    values that contains the true one with probability 1 - ``level`` (Dvoretzky, Kiefer and
    Wolfowitz; Massart's constant).
    """
    return math.sqrt(math.log(2.0 / level) / (2.0 * samples))


def round_digits(values: FloatArray) -> FloatArray:
    """Return ``values``, of any shape, rounded to 9 significant digits, so that rounding errors
    make no difference between laws.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 10.0 ** (DIGITS - 1 - np.floor(np.log10(np.abs(values))))
        return np.asarray(np.where(np.isfinite(scale), np.round(values * scale) / scale, values))


def law_distance(
    first: FloatArray, second: FloatArray, level: float, rounding: float = 0.0
) -> Interval:
    """Return an interval for sup |F - G| of the distribution functions F and G of two samples
    ``first`` (S,) and ``second`` (S',): the two-sample Kolmogorov-Smirnov statistic, with a band
    around each sample.

    The samples may depend on each other, since each band holds on its own. Further runs add to the
    first sample only. Values that differ by less than ``rounding``, or in the last of DIGITS
    digits, count as equal. The interval misses the truth with at most the probability ``level``.
    """
    gaps = np.abs(_ecdf_gaps(first, second, rounding))
    return _band_interval(gaps, len(first), len(second), level, grow=False)


def law_excess(
    first: FloatArray, second: FloatArray, level: float, rounding: float = 0.0
) -> Interval:
    """Return an interval for the largest ``P(second > x) - P(first > x)`` over all x, from two
    samples ``first`` (S,) and ``second`` (S',).

    Values that differ by less than ``rounding`` count as equal. Further runs add to both samples.
    The interval misses the truth with at most the probability ``level``.
    """
    gaps = _ecdf_gaps(first, second, rounding)
    return _band_interval(gaps, len(first), len(second), level, grow=True)


def _ecdf_gaps(first: FloatArray, second: FloatArray, rounding: float) -> FloatArray:
    """Return the differences (V,) of the empirical distribution functions of two samples ``first``
    (S,) and ``second`` (S',), at the V distinct values of both, as comparisons of distributions
    need them; values closer than ``rounding``, or equal to DIGITS digits, are one.
    """
    a, b = np.sort(first), np.sort(second)
    points = np.sort(np.concatenate([a, b]))
    # Neighbours that differ by rounding only are one value, represented by the largest of them.
    with np.errstate(invalid="ignore"):
        distinct = np.diff(points) > np.maximum(rounding, 10.0 ** (1 - DIGITS) * np.abs(points[1:]))
    points = points[np.append(distinct, True)]
    ranks = [np.searchsorted(sample, points, "right") / len(sample) for sample in (a, b)]
    return np.asarray(ranks[0] - ranks[1])


def _band_interval(gaps: FloatArray, a: int, b: int, level: float, grow: bool) -> Interval:
    """Return the interval of the largest of the ``gaps`` (V,) between two empirical distribution
    functions of ``a`` and ``b`` samples, from a Dvoretzky-Kiefer-Wolfowitz band around each.

    ``grow``: further runs add to the second sample too, not to the first only. The interval misses
    the truth with at most the probability ``level``.
    """
    value = max(0.0, float(gaps.max()))
    widths = band_width(a, level / 2.0), band_width(b, level / 2.0)
    width = sum(widths)

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another distance and ``factor`` times the samples."""
        first, second = widths[0] / math.sqrt(factor), widths[1]
        reach = first + (second / math.sqrt(factor) if grow else second)
        return value - reach, value + reach

    # At any one point the standard deviation of the difference is at most sqrt(1/(4a) + 1/(4b)).
    spread = 0.5 * math.sqrt(1.0 / a + 1.0 / b)
    detectable = min(1.0, width + _normal_quantile(POWER) * spread)
    ends = max(0.0, value - width), min(1.0, value + width)
    return Interval(value, *ends, detectable, again=limits)


def distance_to_law(
    cdf: Callable[[FloatArray], FloatArray], values: FloatArray, level: float
) -> Interval:
    """Return an interval for the largest difference between the exact distribution function ``cdf``
    and that of the sample ``values`` (S,): the one-sample Kolmogorov-Smirnov statistic with its DKW
    band, which misses with probability ``level``.
    """
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
    detectable = min(1.0, width + _normal_quantile(POWER) * spread)
    return band_around(value, width, detectable)


def band_around(value: float, width: float, detectable: float = math.nan) -> Interval:
    """Return the interval ``value`` +- ``width``, clipped to [0, 1], for a distance between two
    distribution functions; in forecasts for more runs the width shrinks as 1 / sqrt(runs).

    ``width`` is the half width at the level of the interval. ``detectable`` is the true distance at
    which the interval would exclude 0 with probability POWER, nan if unknown.
    """

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another distance and ``factor`` times the samples."""
        reach = width / math.sqrt(factor)
        return value - reach, value + reach

    ends = max(0.0, value - width), min(1.0, value + width)
    return Interval(value, *ends, detectable, again=limits)


def scale_interval(total: float, freedom: float, level: float) -> Interval:
    """Return the interval for c if ``total`` is c times a chi-square variable with ``freedom``
    degrees of freedom; its estimate is total / freedom.

    The interval misses the truth with at most the probability ``level``.
    """

    def quantiles(freedom: float) -> tuple[float, float]:
        """Return the quantiles of chi-square with ``freedom`` degrees, exceeded with probabilities
        level / 2 and 1 - level / 2.
        """
        tails = 1.0 - level / 2.0, level / 2.0
        upper, lower = (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, p)) for p in tails)
        return upper, lower

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another variance and ``factor`` times the samples."""
        total_freedom = factor * freedom
        upper, lower = quantiles(total_freedom)
        return value * total_freedom / upper, value * total_freedom / lower

    upper, lower = quantiles(freedom)
    # The c above (and below) 1 at which the interval excludes 1 with probability POWER.
    up = upper / (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, 1.0 - POWER)))
    down = lower / (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, POWER)))
    detectable = max(up - 1.0, 1.0 - down)
    return Interval(total / freedom, total / upper, total / lower, detectable, again=limits)


def quadratic_interval(total: float, weights: FloatArray, level: float) -> Interval:
    """Return the interval for c if ``total`` is c times sum_k weights_k z_k^2 with independent
    standard normal z_k; ``weights`` (K,) are at least 0.

    Its ends are quantiles of that sum by the saddle-point formula of Lugannani and Rice (1980),
    whose relative error in the tails is a few per cent for any weights. For equal weights the sum
    is a multiple of a chi-square variable, whose exact quantiles are used. The interval misses the
    truth with at most the probability ``level``.
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
    """Return the quantile that a sum of squares of independent standard normal numbers with
    ``weights`` (K,) exceeds (``upper``), or stays below, with probability ``tail``.
    """
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
    """Return log P(sum > K'(s)) for s > 0, log P(sum < K'(s)) for s < 0 (Lugannani and Rice 1980),
    for the sum of squares of standard normal numbers with ``weights`` (K,).

    With r = sqrt(2 (s K'(s) - K(s))) and u = |s| sqrt(K''(s)) the probability is 1 - N(r) + n(r)
    (1/u - 1/r), N and n the normal distribution and density; near s = 0, where 1/u - 1/r cancels,
    1/2.
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
    """Return an interval for the largest eigenvalue of the mean of R symmetric ``samples``
    (R, n, n).

    Scheffe's method covers all directions at once: Hotelling's T^2 bounds the mean of the n (n + 1)
    / 2 distinct entries, estimated from R samples, which must have a variance. The interval misses
    the truth with at most the probability ``level``.
    """
    count, n = len(samples), samples.shape[-1]
    mean = samples.mean(axis=0)
    values, vectors = np.linalg.eigh(mean)
    entries = n * (n + 1) // 2
    # T^2 = p (R - 1) / (R - p) F(p, R - p) for p entries; /R for the mean.
    freedom = max(count - entries, 1)
    ratio = float(scipy.special.fdtri(entries, freedom, 1.0 - level))
    reach = math.sqrt(entries * (count - 1) / freedom * ratio / count)
    # v' M v of any unit vector v bounds the largest eigenvalue from below: v are the eigenvectors.
    deviations = np.einsum("ia,rij,ja->ra", vectors, samples, vectors).std(axis=0, ddof=1)
    low = float((values - reach * deviations).max())
    # The upper limit needs every direction: the largest standard deviation of any is used.
    flat = samples.reshape(count, -1)
    covariance = np.atleast_2d(np.cov(flat, rowvar=False))
    widest = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
    # Student's statistic of the direction with the largest mean must exceed Hotelling's limit.
    spread = float(deviations.max()) / math.sqrt(count)
    shift = spread * noncentrality(max(count - 1.0, 1.0), reach * math.sqrt(count))
    # Matrices that are too large by a factor have deviations larger by that factor.
    largest = float(values[-1])
    detectable = shift / (1.0 - shift / largest) if shift < largest else math.nan
    return Interval(float(values[-1]), low, float(values[-1]) + reach * widest, detectable)


def pearson_test(counts: np.ndarray, probabilities: FloatArray) -> tuple[float, int]:
    """Return the p-value of Pearson's chi-square test and its number of cells.

    ``counts`` (C,) and ``probabilities`` (C,) are those of C cells in decreasing order of
    probability; the last cells, with expected counts below MIN_EXPECTED, are pooled with the last
    frequent one.
    """
    expected = probabilities * counts.sum()
    frequent = max(1, int((expected >= MIN_EXPECTED).sum()))
    expected = np.append(expected[: frequent - 1], counts.sum() - expected[: frequent - 1].sum())
    pooled = np.append(counts[: frequent - 1], counts[frequent - 1 :].sum())
    if len(pooled) < 2:
        return 1.0, len(pooled)
    statistic = float(((pooled - expected) ** 2 / expected).sum())
    p = float(scipy.special.gammaincc((len(pooled) - 1) / 2.0, statistic / 2.0))
    return p, len(pooled)
