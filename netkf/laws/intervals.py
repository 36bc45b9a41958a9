"""Confidence intervals that hold at a stated level for every number of samples.

All samples are independent. A level is the probability with which an interval may miss the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from netkf.linalg.arrays import FloatArray

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
        """Return the upper limit expected with ``factor`` times the samples if the truth is 0."""
        # Sampling error shrinks as 1 / sqrt(samples); a value of 0 or below is kept.
        value = self.value / math.sqrt(factor) if self.value > 0.0 else self.value
        return self.limits(value, factor)[1]


class LawComparison(NamedTuple):
    """Distances from what is stated, which should all be 0.

    distances : interval and label of each; together they miss with at most the level of the test
    text      : what the values are, and how many
    overall   : number of distances at the beginning that are over all values together; they are
                reported unless one of a part of the values is significant
    """

    distances: list[tuple[Interval, str]]
    text: str
    overall: int = 0

    @property
    def worst(self) -> tuple[Interval, str] | None:
        """The significant distance with the largest lower limit and its label; None without one."""
        found = [item for item in self.distances if item[0].low > 0.0]
        return max(found, key=lambda item: item[0].low, default=None)


NO_COMPARISON = LawComparison([], "too few values in these runs")
"""The comparison of a test that has too few values to say anything."""


def detectable_shift(deviation: float, level: float) -> float:
    """Return the shift of a normal estimate that a two-sided test detects with POWER."""
    return deviation * float(scipy.special.ndtri(1.0 - level / 2.0) + scipy.special.ndtri(POWER))


def detectable_shift_of_student(count: float, level: float) -> float:
    """Return the shift, in deviations of an estimate, that Student's test of ``count`` values
    detects with POWER: the noncentrality at which the quantile 1 - POWER is the critical value.
    """
    freedom = max(count - 1.0, 1.0)
    critical = -float(scipy.special.stdtrit(freedom, level / 2.0))
    return noncentrality(freedom, critical)


@lru_cache(maxsize=1024)
def noncentrality(freedom: float, critical: float) -> float:
    """Return the noncentrality at which a t variable exceeds ``critical`` with POWER."""
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


def normal_interval(value: float, deviation: float, level: float) -> Interval:
    """Return the interval of a normal estimate ``value`` with a known standard ``deviation``."""
    reach = -deviation * float(scipy.special.ndtri(level / 2.0))
    return Interval(value, value - reach, value + reach, detectable_shift(deviation, level))


def excess_interval(
    expected: float, excess: FloatArray, total: float, min_variance: float, level: float
) -> Interval:
    """Return the interval of the distance of a share of ``total`` events from the ``expected`` one,
    from how many more than expected there were in each of R runs, ``excess`` (R,). Rare events may
    vary too little by chance: the sum has at least ``min_variance``, and that of one event.
    """
    runs = len(excess)
    spread = math.sqrt(max(float(excess.var(ddof=1)) * runs, min_variance, 1.0)) / total
    estimate = expected + float(excess.sum()) / total
    return deviation_interval(expected, student_interval(estimate, spread, runs, level))


def student_interval(value: float, deviation: float, count: float, level: float) -> Interval:
    """Return Student's interval of ``value``, with a ``deviation`` of ``count`` values."""

    def limits(value: float, factor: float) -> tuple[float, float]:
        quantile = -float(scipy.special.stdtrit(factor * count - 1.0, level / 2.0))
        reach = deviation / math.sqrt(factor) * quantile
        return value - reach, value + reach

    low, high = limits(value, 1.0)
    detectable = deviation * detectable_shift_of_student(count, level)
    return Interval(value, low, high, detectable, again=limits)


def interval_of_squares(values: FloatArray, level: float) -> tuple[float, float]:
    """Return an interval for the mean of sums of squares of Gaussian numbers, such as NEES, from
    ``values`` (R,) of runs, which are too skewed for Student's.

    Their cube roots are nearly normal, with mean ``m - v / m`` and variance v where m^3 is the mean
    (Wilson and Hilferty, PNAS 17, 1931). The factor below makes it hold from 10 runs on for sums of
    one degree of freedom too, by simulation.
    """
    count, roots = len(values), np.cbrt(values)
    centre, variance = float(roots.mean()), float(roots.var(ddof=1))
    if not centre > 0.0:
        return 0.0, math.inf
    spread = math.sqrt(variance / count + 2.0 * variance**2 / (count - 1))
    reach = spread * (1.0 + 4.0 * variance / centre**2)
    reach *= -float(scipy.special.stdtrit(count - 1.0, level / 2.0))
    ends = np.array([centre - reach, centre + reach])
    low, high = (((ends + np.sqrt(ends**2 + 4.0 * variance)) / 2.0) ** 3).tolist()
    return low, high


def probability_interval(successes: int, trials: int, level: float) -> Interval:
    """Return the interval of Clopper and Pearson (1934) for a probability of success."""
    low = high = detectable = math.nan

    def limits(share: float, factor: float) -> tuple[float, float]:
        hits = min(max(share, 0.0), 1.0) * trials * factor
        missed = trials * factor - hits
        low = float(scipy.special.betaincinv(hits, missed + 1, level / 2)) if hits else 0.0
        high = float(scipy.special.betaincinv(hits + 1, missed, 1 - level / 2)) if missed else 1.0
        return low, high

    if trials:
        low, high = limits(successes / trials, 1.0)
        # Half a success and half a failure are added: a fraction of 0 or 1 has a variance too.
        p = (successes + 0.5) / (trials + 1.0)
        # Of the rarer outcome: q rises where p > 1/2 falls.
        rises = [_binomial_rise(q, trials, level) for q in (p, 1.0 - p)]
        detectable = float(np.fmax.reduce(rises))
    return Interval(successes / max(trials, 1), low, high, detectable, again=limits)


def _binomial_rise(p: float, trials: int, level: float) -> float:
    """Return by how much a probability must exceed ``p`` to be found; nan if it never is."""
    # The least number of successes that has at most the probability level / 2.
    many = min(trials, 1 + math.ceil(scipy.special.bdtrik(1.0 - 0.5 * level, trials, p)))
    while many > 1 and scipy.special.betainc(many - 1, trials - many + 2, p) <= 0.5 * level:
        many -= 1
    while many <= trials and scipy.special.betainc(many, trials - many + 1, p) > 0.5 * level:
        many += 1
    if many > trials:
        return math.nan
    return float(scipy.special.betaincinv(many, trials - many + 1, POWER)) - p


def with_drawn(interval: Interval, sample_factor: Callable[[float], float]) -> Interval:
    """Return ``interval`` whose forecast for ``factor`` times the runs is that of
    ``sample_factor(factor)`` times the samples.
    """

    def limits(value: float, factor: float) -> tuple[float, float]:
        actual = sample_factor(factor)
        # The caller has divided the value by sqrt(factor); it shrinks by sqrt(actual) only.
        return interval.limits(value * math.sqrt(factor / actual), actual)

    return interval._replace(again=limits)


def deviation_interval(expected: float, seen: Interval) -> Interval:
    """Return the interval of |quantity - expected| from the one ``seen`` of the quantity."""
    covers = seen.low <= expected <= seen.high
    ends = abs(seen.low - expected), abs(seen.high - expected)
    low = 0.0 if covers else min(ends)
    distance = abs(seen.value - expected)
    # A forecast keeps the estimate on the same side of the expected value, only nearer to it.
    side = math.copysign(1.0, seen.value - expected)

    def limits(value: float, factor: float) -> tuple[float, float]:
        ends = seen.limits(expected + side * value, factor)
        return 0.0, max(abs(end - expected) for end in ends)

    return Interval(
        distance, low, max(ends), seen.detectable, seen=seen.value, expected=expected, again=limits
    )


def scale_interval(total: float, freedom: float, level: float) -> Interval:
    """Return the interval of c if ``total`` is c times a chi-square variable."""

    def quantiles(freedom: float) -> tuple[float, float]:
        tails = 1.0 - level / 2.0, level / 2.0
        upper, lower = (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, p)) for p in tails)
        return upper, lower

    def limits(value: float, factor: float) -> tuple[float, float]:
        total_freedom = factor * freedom
        upper, lower = quantiles(total_freedom)
        return value * total_freedom / upper, value * total_freedom / lower

    upper, lower = quantiles(freedom)
    # The c above (and below) 1 at which the interval excludes 1 with probability POWER.
    up = upper / (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, 1.0 - POWER)))
    down = lower / (2.0 * float(scipy.special.gammaincinv(freedom / 2.0, POWER)))
    detectable = max(up - 1.0, 1.0 - down)
    return Interval(total / freedom, total / upper, total / lower, detectable, again=limits)


def correlation_interval(value: float, count: float, level: float) -> Interval:
    """Return the interval of a correlation ``value`` of ``count`` normal pairs by Fisher's
    transformation: atanh of it has the variance 1 / (count - 3).
    """
    spread = 1.0 / math.sqrt(max(count - 3.0, 1.0))
    reach = -spread * float(scipy.special.ndtri(level / 2.0))

    def limits(value: float, factor: float) -> tuple[float, float]:
        centre = math.atanh(min(max(value, -1.0 + 1e-12), 1.0 - 1e-12))
        wide = reach / math.sqrt(factor)
        return math.tanh(centre - wide), math.tanh(centre + wide)

    detectable = math.tanh(detectable_shift(spread, level))
    return Interval(value, *limits(value, 1.0), detectable, again=limits)


def poisson_interval(total: float, mean: float, level: float) -> Interval:
    """Return Garwood's interval (1936) of a Poisson mean in units of ``mean``."""

    def limits(ratio: float, factor: float) -> tuple[float, float]:
        count, expected = ratio * mean * factor, mean * factor
        low = float(scipy.special.gammaincinv(count, level / 2.0)) if count else 0.0
        high = float(scipy.special.gammaincinv(count + 1.0, 1.0 - level / 2.0))
        return low / expected, high / expected

    detectable = _poisson_shift(mean, level)
    return Interval(total / mean, *limits(total / mean, 1.0), detectable, again=limits)


def _poisson_shift(mean: float, level: float) -> float:
    # The least count that has at most the probability level / 2, and the largest such one.
    many = math.ceil(scipy.special.pdtrik(1.0 - 0.5 * level, mean)) + 1
    few = math.floor(scipy.special.pdtrik(0.5 * level, mean)) - 1
    while scipy.special.gammainc(many - 1, mean) <= 0.5 * level and many > 1:
        many -= 1
    while scipy.special.gammainc(many, mean) > 0.5 * level:
        many += 1
    up = float(scipy.special.gammaincinv(many, POWER)) / mean - 1.0
    while few >= 0 and scipy.special.gammaincc(few + 1, mean) > 0.5 * level:
        few -= 1
    if few < 0:
        return up
    return max(up, 1.0 - float(scipy.special.gammaincinv(few + 1, 1.0 - POWER)) / mean)
