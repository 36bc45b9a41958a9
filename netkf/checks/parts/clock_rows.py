"""Promises about the clocks of the network and of sensors, from the counts of many runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.checks.evidence import CLOCKS, SAMPLING, Finding, Promise, find_identity
from netkf.checks.laws import find_largest
from netkf.checks.parts.moments import MIN_EVENTS, compare_shares, with_best
from netkf.checks.parts.samples import PartSamples
from netkf.checks.parts.ticks import (
    ClockGroup,
    count_drawn_ticks,
    draw_samples,
    network_clocks,
    relative_variance,
    sampling_clocks,
    ticks_on_lattice,
)
from netkf.checks.parts.waiting import correlation_of_neighbours
from netkf.checks.statistics import (
    POWER,
    Interval,
    detectable_shift_of_student,
    deviation_interval,
    scale_interval,
    student_interval,
    with_drawn,
)
from netkf.linalg.arrays import FloatArray
from netkf.network.contacts import Contacts
from netkf.scenario.scenario import Scenario

RATE_TOLERANCE, DISPERSION_TOLERANCE = 0.05, 0.25
"""Tolerated relative error of a rate; and of the variance of Poisson counts, or correlation of two
clocks.
"""
FIRST_TICK, SPREAD = 1.0, 2.0
"""Slack, in ticks of one run, for the transient of a renewal clock that starts with the run; and
safety factor on the dispersion index of its counts, which replaces c^2 of an unknown gap law.
"""
WANTED_RATE = 0.02
"""Relative error of the rate of one clock that the test should detect."""
ENOUGH_TICKS, MAX_DRAWN, MAX_DRAWN_TICKS, DRAWN_PER_RUN = 80_000, 20_000, 3e6, 4
"""Ticks of one clock that reveal an error of WANTED_RATE. Limits on the extra replicas in which
only the clocks are drawn: clocks times replicas, ticks of all clocks, and replicas for each run.
"""
MAX_CLOCKS = 60
"""Columns of counts of which all pairs are compared."""
LATTICE_TOLERANCE = 1e-9
"""Seconds, for each second of the run, by which rounding may move a tick."""


class ClockSamples(NamedTuple):
    """The tick counts of one group of clocks in R runs.

    counts : TickCounts with a first axis of length R
    draw   : function of (scenario, seed, replica) that returns the ticks (E,) of all clocks in a
             replica of which nothing else is simulated
    """

    scenario: Scenario
    seed: int
    group: ClockGroup
    counts: Any
    draw: Callable[[Scenario, int, int], np.ndarray]

    @property
    def rates(self) -> FloatArray:
        """The stated rates (E,) of all clocks in ticks per second; nan if unknown."""
        pairs = zip(self.group.stated, self.group.entities, strict=True)
        return np.array([stated.mean_rate(entity) for stated, entity in pairs])

    @property
    def poisson(self) -> bool:
        """True if all clocks are Poisson processes."""
        return all(stated.memoryless for stated in self.group.stated)


def _network_clocks(samples: PartSamples) -> ClockSamples:
    """Return the tick counts of the network's clocks in all runs, as tests of clocks get them."""
    scenario = samples.scenario
    return ClockSamples(
        scenario, samples.seed, network_clocks(scenario), samples.ticks, count_drawn_ticks
    )


def _sampling_clocks(samples: PartSamples) -> ClockSamples:
    """Return the counts of the sensors' sampling times in all runs, as tests of clocks get them."""
    scenario = samples.scenario
    group = sampling_clocks(scenario)
    return ClockSamples(scenario, samples.seed, group, samples.sampling, draw_samples)


Group = Callable[[PartSamples], ClockSamples]
"""Selects the clocks that a test is about: those of the network, or those of the sensors."""


@lru_cache(maxsize=4)
def _drawn_counts(
    draw: Callable[[Scenario, int, int], np.ndarray],
    scenario: Scenario,
    seed: int,
    first: int,
    count: int,
) -> np.ndarray:
    """Return the numbers of ticks (``count``, E) of all E clocks in ``count`` replicas from number
    ``first`` on; cached.

    ``draw`` returns the ticks (E,) of one replica, given the scenario, the seed and its number.
    """
    return np.array([draw(scenario, seed, first + k) for k in range(count)])


def _counts_of_each(clocks: ClockSamples) -> np.ndarray:
    """Return the ticks (R', E) of each of E clocks in the R runs and in R' - R further replicas.

    Clocks are cheap to draw without the rest of a run. There are as many further replicas as a rate
    that is off by WANTED_RATE takes to be detected, within the limits of :func:`_number_drawn`.
    """
    counts = clocks.counts.ticks.sum(axis=1)
    runs = len(counts)
    further_replicas = _number_drawn(clocks, runs)
    if not further_replicas:
        return np.asarray(counts)
    further_counts = _drawn_counts(
        clocks.draw, clocks.scenario, clocks.seed, runs, further_replicas
    )
    return np.concatenate([counts, further_counts])


def _number_drawn(clocks: ClockSamples, runs: float) -> int:
    """Return the number of further replicas, beside ``runs`` simulated runs, in which only the
    clocks are drawn (at little cost), so that a rate of one clock that is off by WANTED_RATE would
    be detected, within the limits of MAX_DRAWN, MAX_DRAWN_TICKS and DRAWN_PER_RUN.
    """
    ticks_per_run = clocks.rates * clocks.scenario.horizon
    further_replicas = min(
        math.ceil(ENOUGH_TICKS / ticks_per_run.min() - runs),
        int(DRAWN_PER_RUN * runs),
        int(MAX_DRAWN / len(ticks_per_run)),
        int(MAX_DRAWN_TICKS / ticks_per_run.sum()),
    )
    return int(max(further_replicas, 0))


def _check_rates(group: Group, samples: PartSamples, level: float) -> Finding:
    """Test the null hypothesis that clocks tick at their stated rates; ``group`` selects the clocks
    of the network or those of the sensors from the samples.

    Compared with rate times horizon are the total ticks, for Poisson clocks also those in each
    window of the run, and the ticks of each clock; each of the three groups gets level / 3, shared
    by Bonferroni within the group.
    """
    clocks = group(samples)
    windows, counts = clocks.counts.ticks, _counts_of_each(clocks)
    expected, poisson = clocks.rates * clocks.scenario.horizon, clocks.poisson
    total = windows.sum(axis=(1, 2))
    start_slack = _ticks_of_start(clocks, counts)
    intervals = [
        (
            _count_interval(total, float(expected.sum()), level / 3.0, poisson, start_slack.sum()),
            "all clocks together",
        )
    ]
    if poisson:
        intervals += _rates_by_window(windows, float(expected.sum()), level / 3.0)
    single_level = level / (3.0 * len(expected))
    runs = len(windows)

    def sample_factor(factor: float) -> float:
        """Return the factor on the number of counts of a clock for a factor on the runs."""
        return (factor * runs + _number_drawn(clocks, factor * runs)) / len(counts)

    singles = [
        with_drawn(
            _count_interval(
                counts[:, k], float(expected[k]), single_level, poisson, start_slack[k]
            ),
            sample_factor,
        )
        for k in range(len(expected))
    ]
    intervals += zip(singles, clocks.group.labels, strict=True)
    message = f"{total.sum():,.0f} ticks, relative difference from the rates,"
    finding = with_best(intervals, RATE_TOLERANCE, message)
    note = _limit_of_one_clock(clocks, counts, singles, level)
    return finding._replace(message=finding.message + note)


def _ticks_of_start(clocks: ClockSamples, counts: np.ndarray) -> FloatArray:
    """Return the slack (E,) in ticks by which the mean count of each clock in a run of T seconds
    may differ from rate T although its rate is right.

    A renewal process that starts with the run has a mean number of ticks between rate T - 1 and
    rate T + c^2 in T seconds, with c the coefficient of variation of its gaps (Lorden 1970). Where
    the law of the gaps is unknown, c^2 is estimated by the dispersion index (variance over mean) of
    the ``counts`` (R, E), which tends to c^2 for long runs.
    """
    from_counts = SPREAD * counts.var(axis=0, ddof=1) / np.maximum(counts.mean(axis=0), 1e-300)
    stated_variance = np.array([relative_variance(stated) for stated in clocks.group.stated])
    return np.asarray(
        np.maximum(np.where(np.isnan(stated_variance), from_counts, stated_variance), FIRST_TICK)
    )


def _rates_by_window(windows: np.ndarray, mean: float, level: float) -> list[tuple[Interval, str]]:
    """Return labelled intervals for the relative error of the total rate of Poisson clocks in each
    of W windows (equal parts) of the run.

    ``windows`` (R, W, E) are the ticks of E clocks in R runs and ``mean`` is the stated mean total
    of a run; no intervals if there is only one window, since that is the whole run. The probability
    that any of them misses the truth is at most ``level``.
    """
    window_ticks = windows.sum(axis=2)
    count = window_ticks.shape[1]
    return [
        (
            # Poisson counts are right from the start of a run on: no slack for a transient.
            _count_interval(
                window_ticks[:, k], mean / count, level / count, poisson=True, first_ticks=0.0
            ),
            f"all clocks in part {k + 1} of {count} of the run",
        )
        for k in range(count if count > 1 else 0)
    ]


def _limit_of_one_clock(
    clocks: ClockSamples, counts: np.ndarray, singles: list[Interval], level: float
) -> str:
    """Return a note on the smallest detectable rate error of one clock, empty if that is at most
    WANTED_RATE.

    ``counts`` (R, E) are the ticks of E clocks in R runs, ``singles`` their E intervals. The note
    tells a reader that more ticks are needed, not a better test: by the Cramer-Rao bound an
    estimate of a rate from N ticks of a Poisson process has at least the relative standard
    deviation 1 / sqrt(N).
    """
    least_precise = max(range(len(singles)), key=lambda k: singles[k].detectable)
    if singles[least_precise].detectable <= WANTED_RATE or not clocks.poisson:
        return ""
    ticks = float(clocks.rates[least_precise]) * clocks.scenario.horizon * len(counts)
    quantiles = scipy.special.ndtri(1.0 - level) + scipy.special.ndtri(POWER)
    smallest_error = float(quantiles) / math.sqrt(ticks)
    return (
        f"; of one clock, no test at this level finds less than {smallest_error:.2g} in "
        f"{ticks:,.0f} ticks"
    )


def _count_interval(
    values: np.ndarray, mean: float, level: float, poisson: bool, first_ticks: float
) -> Interval:
    """Return an interval for |E(count) / mean - 1|, from the counts ``values`` (R,) of R runs, that
    misses with probability ``level``.

    Sums of ``poisson`` counts are Poisson and have exact limits. For other clocks Student's
    interval uses the spread of the counts, and ``first_ticks``, the slack for the transient at the
    start of a run, is subtracted from the distance.
    """
    total, runs = float(values.sum()), len(values)
    expected_total = runs * mean
    if poisson:
        return deviation_interval(1.0, _poisson_interval(total, expected_total, level))
    relative_slack = first_ticks / mean
    # Few integer counts may be all equal: at least the variance of two values with equal odds.
    spread = math.sqrt(max(float(values.var(ddof=1)), 0.25) * runs)
    distance = deviation_interval(
        1.0, student_interval(total / expected_total, spread / expected_total, runs, level)
    )

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another value and ``factor`` times the runs."""
        low, high = distance.limits(value, factor)
        return max(0.0, low - relative_slack), max(0.0, high - relative_slack)

    value, low, high = (max(0.0, end - relative_slack) for end in distance[:3])
    reduced = distance._replace(value=value, low=low, high=high, again=limits)
    return reduced._replace(detectable=distance.detectable + relative_slack)


def _poisson_interval(total: float, mean: float, level: float) -> Interval:
    """Return the exact (Garwood 1936) interval for the mean of a Poisson variable, in units of
    ``mean``, from one observation ``total``.

    The interval misses the truth with at most the probability ``level``.
    """

    def limits(ratio: float, factor: float) -> tuple[float, float]:
        """Return the limits for another ratio and ``factor`` times the runs."""
        count, expected = ratio * mean * factor, mean * factor
        low = float(scipy.special.gammaincinv(count, level / 2.0)) if count else 0.0
        high = float(scipy.special.gammaincinv(count + 1.0, 1.0 - level / 2.0))
        return low / expected, high / expected

    detectable = _poisson_shift(mean, level)
    return Interval(total / mean, *limits(total / mean, 1.0), detectable, again=limits)


def _poisson_shift(mean: float, level: float) -> float:
    """Return the relative error of the ``mean`` of a Poisson variable that Garwood's test at
    ``level`` detects with probability POWER in one observation: the larger one of both directions,
    of those in which an error can be so large that it is detected.
    """
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


def _check_gaps(group: Group, samples: PartSamples, level: float) -> Finding:
    """Test the null hypothesis that gaps between ticks follow the stated law and are independent;
    ``group`` selects the clocks of the network or those of the sensors from the samples.

    Under it the gaps, which their stated distribution function transforms to uniform numbers, fill
    CELLS cells of equal probability evenly, and neighbouring gaps, transformed further to normal
    numbers, have correlation 0; each test gets half of the level.
    """
    counts = group(samples).counts
    finding = compare_shares(counts.cells.sum(axis=0), level / 2.0, "gaps")
    correlation = correlation_of_neighbours(counts.products, level / 2.0)
    if correlation is None:
        return finding
    distance = deviation_interval(0.0, correlation)
    # The correlation is reported if it is significant, and the law of single gaps is not wrong.
    if distance.low > 0.0 and not finding.margin[2] < 0.0:
        label = "neighbouring gaps"
        return find_largest([(distance, label)], finding.tolerance, "largest correlation")
    text = f"; correlation of neighbouring gaps {correlation.value:.2g}"
    return finding._replace(
        message=f"{finding.message}{text}, {distance.detectable:.2g} is detectable"
    )


def _check_lattice(group: Group, samples: PartSamples, level: float) -> Finding:
    """Compare the times of ticks of deterministic clocks with the stated times; ``group`` selects
    the clocks of the network or those of the sensors from the samples.

    No interval is estimated, so that ``level`` is not used.
    """
    counts, horizon = group(samples).counts, samples.scenario.horizon
    largest_error, ticks = float(counts.off.max()), counts.ticks.sum()
    message = f"{ticks:,.0f} ticks, times in units of the length of a run"
    return find_identity(largest_error / horizon, LATTICE_TOLERANCE, message)


def _clocks_apart(group: Group, samples: PartSamples, level: float) -> Finding:
    """Test the null hypothesis that the clocks are independent Poisson processes; ``group`` selects
    the clocks of the network or those of the sensors from the samples.

    Under it the total count of a window is Poisson, so that its variance equals its mean, and no
    two clocks have correlated counts; each test gets half of the level.
    """
    clocks = group(samples)
    ticks = clocks.counts.ticks
    counts = ticks.reshape(-1, ticks.shape[2])  # (windows of all runs, clocks)
    mean = float((clocks.rates * samples.scenario.horizon).sum()) / ticks.shape[1]
    values = counts.sum(axis=1) - mean
    # (x - m)^2 of a Poisson x with mean m has the variance 2 m^2 + m instead of 2 m^2 as for a
    # normal one: the sum is treated as chi-square with correspondingly fewer degrees of freedom.
    freedom = len(values) / (1.0 + 0.5 / mean)
    ratio = scale_interval(freedom * float((values**2).mean()) / mean, freedom, level / 2.0)
    distance = deviation_interval(1.0, ratio)
    intervals = [(distance, "variance of all ticks at once over that of independent clocks")]
    means = counts.mean(axis=0)  # also the variances of Poisson counts
    pairs = largest_correlation(counts - means, np.broadcast_to(means, counts.shape), level / 2.0)
    if pairs is not None:
        correlation, (a, b) = pairs
        labels = clocks.group.labels
        intervals.append((correlation, f"correlation of {labels[a]} and {labels[b]}"))
    return find_largest(intervals, DISPERSION_TOLERANCE, "largest difference")


def largest_correlation(
    values: FloatArray, variances: FloatArray, level: float
) -> tuple[Interval, tuple[int, int]] | None:
    """Return an interval for the largest |correlation| of two columns of ``values`` (K, L), such as
    the counts of two clocks, and the indices of the two.

    Values have mean 0, the expected ``variances`` (K, L), and independent rows. The products of two
    columns, in units of their expected deviations (those that were seen would be far too small
    where events are rare), are averaged by Student's interval, with Bonferroni's correction for all
    pairs. None with fewer than two columns of MIN_EVENTS expected events, or 100 rows. The interval
    misses the truth with at most the probability ``level``.
    """
    frequent = np.flatnonzero(variances[:, :MAX_CLOCKS].sum(axis=0) >= MIN_EVENTS)
    if len(frequent) < 2 or len(values) < 100:
        return None
    x, variance = values[:, frequent], variances[:, frequent]
    deviation = np.sqrt(variance)
    correlations = x.T @ x / (deviation.T @ deviation)
    upper = np.triu_indices(len(frequent), 1)
    largest = int(np.argmax(np.abs(correlations[upper])))
    a, b = int(upper[0][largest]), int(upper[1][largest])
    interval = _correlation_of_columns(
        x[:, a] * x[:, b], variance[:, a] * variance[:, b], level / len(upper[0])
    )
    return deviation_interval(0.0, interval), (int(frequent[a]), int(frequent[b]))


def _correlation_of_columns(products: FloatArray, variances: FloatArray, level: float) -> Interval:
    """Return Student's interval for a correlation from K ``products`` (K,) of independent values
    of mean 0, and the ``variances`` (K,) of these products without correlation.

    Rare events that coincide are counted as a Poisson variable: of a correlation r its mean exceeds
    that without correlation, lambda, by r times ``scale``, and its deviation is that of the sum.
    """
    scale, expected = float(np.sqrt(variances).sum()), float(variances.sum())
    # The effective number of rows, those of small variances counting less.
    rows = expected**2 / float((variances**2).sum())
    spread = math.sqrt(max(float(products @ products), expected))
    interval = student_interval(float(products.sum()) / scale, spread / scale, rows, level)
    quantile = detectable_shift_of_student(rows, level)
    root = 0.5 * (quantile + math.sqrt(quantile**2 + 4.0 * expected))
    detectable = (root**2 - expected) / scale
    return interval._replace(detectable=detectable if detectable <= 1.0 else math.nan)


def _promises(
    clocks: ClockSamples, group: Group, sentences: dict[str, str], about: str
) -> list[Promise]:
    """Return the promises about the ``clocks`` that ``group`` selects from the samples: which tests
    apply depends on whether they are Poisson, deterministic or of another known law. ``sentences``
    has the statement of each promise by a short name, ``about`` names the group of these rows.
    """
    # Rows (name, test, whether it is exact, that is uses none of the level).
    rows: list[tuple[str, Callable[..., Finding], bool]] = [("rates", _check_rates, False)]
    if clocks.poisson:
        rows += [("exponential", _check_gaps, False), ("apart", _clocks_apart, False)]
    elif all(ticks_on_lattice(stated) for stated in clocks.group.stated):
        rows.insert(0, ("lattice", _check_lattice, True))
    if not clocks.poisson and clocks.counts.cells.any():
        rows.append(("law", _check_gaps, False))
    return [
        Promise(sentences[name], "the scenario", (), partial(test, group), exact, about)
        for name, test, exact in rows
    ]


NETWORK_SENTENCES = {
    "rates": "clocks tick at the rates of the scenario",
    "exponential": "gaps between ticks are exponential, and independent of those before",
    "apart": "clocks tick independently of each other",
    "lattice": "clocks tick at the times of the scenario",
    "law": "ticks follow the law of their clocks, and do not depend on those before",
}
CONTACT_SENTENCE = "links tick in their contacts only"
SAMPLING_SENTENCES = {
    "rates": "sensors sample at the rates of the scenario",
    "exponential": "gaps between samples are exponential, and independent of those before",
    "apart": "sensors sample independently of each other",
    "lattice": "sensors sample at the times of the scenario",
    "law": "samples follow the law of their clocks, and do not depend on those before",
}


def clock_promises(samples: PartSamples) -> list[Promise]:
    """Return the promises about the clocks of the network and those of the sensors, if their rates
    are stated and the runs have ticks of them.
    """
    promises: list[Promise] = []
    for counts, group, sentences, about in (
        (samples.ticks, _network_clocks, NETWORK_SENTENCES, CLOCKS),
        (samples.sampling, _sampling_clocks, SAMPLING_SENTENCES, SAMPLING),
    ):
        if counts is not None:
            clocks = group(samples)
            in_contacts = isinstance(samples.scenario.network.activation, Contacts)
            if in_contacts and group is _network_clocks:
                test = partial(_check_lattice, group)
                promises.append(Promise(CONTACT_SENTENCE, "the scenario", (), test, True))
            if np.isfinite(clocks.rates).all():
                promises += _promises(clocks, group, sentences, about)
    return promises
