"""Promises about the clocks of the network and of sensors, from the counts of many runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.checks.evidence import Finding, Promise, find_identity
from netkf.checks.laws import find_largest
from netkf.checks.parts.moments import (
    CELLS,
    compare_cells,
    correlation_interval,
    with_best,
)
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
from netkf.checks.statistics import (
    POWER,
    Interval,
    detectable_shift,
    deviation_interval,
    scale_interval,
    student_interval,
    with_drawn,
)
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario

RATE_TOLERANCE, DISPERSION_TOLERANCE = 0.05, 0.25
FIRST_TICK, SPREAD = 1.0, 2.0
"""Ticks by which a clock that is not memoryless may be off its rate in a run, because it has begun
with it; and factor on what the spread of its counts says of that, where its law is not known.
"""
WANTED_RATE = 0.02
"""Error of the rate of one clock that should be found."""
ENOUGH_TICKS, MAX_DRAWN, MAX_DRAWN_TICKS, DRAWN_PER_RUN = 80_000, 20_000, 3e6, 4
"""Ticks of one clock in which that error shows; the most times that a clock is drawn for a replica
beyond those of the runs, in all and for each run, and the most ticks of all of them.
"""
MAX_CLOCKS = 60
"""Clocks of which all pairs are compared."""
LATTICE_TOLERANCE = 1e-9
"""Seconds, for each second of the run, by which rounding may move a tick."""


class ClockSamples(NamedTuple):
    """Clocks of one kind, the counts of their ticks in all runs, and how more are drawn."""

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
    """Return the samples of the network's clocks."""
    scenario = samples.scenario
    return ClockSamples(
        scenario, samples.seed, network_clocks(scenario), samples.ticks, count_drawn_ticks
    )


def _sampling_clocks(samples: PartSamples) -> ClockSamples:
    """Return the samples of the sensors' clocks."""
    scenario = samples.scenario
    group = sampling_clocks(scenario)
    return ClockSamples(scenario, samples.seed, group, samples.sampling, draw_samples)


Group = Callable[[PartSamples], ClockSamples]


@lru_cache(maxsize=4)
def _drawn_counts(
    draw: Callable[[Scenario, int, int], np.ndarray],
    scenario: Scenario,
    seed: int,
    first: int,
    count: int,
) -> np.ndarray:
    """Return the ticks (count, E) of all clocks in the replicas from ``first`` on."""
    return np.array([draw(scenario, seed, first + k) for k in range(count)])


def _counts_of_each(clocks: ClockSamples) -> np.ndarray:
    """Return the ticks (R', E) of each clock in the runs, and in as many further replicas, of which
    only the clocks are drawn, as it takes to find that one rate is off by WANTED_RATE.
    """
    counts = clocks.counts.ticks.sum(axis=1)
    runs = len(counts)
    wanted = _number_drawn(clocks, runs)
    if not wanted:
        return np.asarray(counts)
    more = _drawn_counts(clocks.draw, clocks.scenario, clocks.seed, runs, wanted)
    return np.concatenate([counts, more])


def _number_drawn(clocks: ClockSamples, runs: float) -> int:
    """Return the number of replicas of which the clocks are drawn beside those of the runs."""
    rates = clocks.rates * clocks.scenario.horizon
    wanted = min(
        math.ceil(ENOUGH_TICKS / rates.min() - runs),
        int(DRAWN_PER_RUN * runs),
        int(MAX_DRAWN / len(rates)),
        int(MAX_DRAWN_TICKS / rates.sum()),
    )
    return int(max(wanted, 0))


def _check_rates(group: Group, samples: PartSamples, level: float) -> Finding:
    """Compare the ticks of all runs with the rates: all clocks together, also in parts of the run,
    and one by one.
    """
    clocks = group(samples)
    windows, each = clocks.counts.ticks, _counts_of_each(clocks)
    expected, poisson = clocks.rates * clocks.scenario.horizon, clocks.poisson
    total = windows.sum(axis=(1, 2))
    begun = _ticks_of_start(clocks, each)
    intervals = [
        (
            _count_interval(total, float(expected.sum()), level / 3.0, poisson, begun.sum()),
            "all clocks together",
        )
    ]
    if poisson:
        intervals += _rates_by_window(windows, float(expected.sum()), level / 3.0)
    share = level / (3.0 * len(expected))
    runs = len(windows)

    def drawn(factor: float) -> float:
        """Return the factor on the times that a clock is drawn, for a factor on the runs."""
        return (factor * runs + _number_drawn(clocks, factor * runs)) / len(each)

    singles = [
        with_drawn(_count_interval(each[:, k], float(expected[k]), share, poisson, begun[k]), drawn)
        for k in range(len(expected))
    ]
    intervals += zip(singles, clocks.group.labels, strict=True)
    message = f"{total.sum():,.0f} ticks, relative difference from the rates,"
    finding = with_best(intervals, RATE_TOLERANCE, message)
    note = _limit_of_one_clock(clocks, each, singles, level)
    return finding._replace(message=finding.message + note)


def _ticks_of_start(clocks: ClockSamples, counts: np.ndarray) -> FloatArray:
    """Return by how many ticks (E,) the mean count of each clock in a run may be off its rate.

    A renewal process that begins with a run has between rate T - 1 and rate T + c^2 ticks in T
    seconds, c the standard deviation of its gaps over their mean (Lorden 1970). Of other clocks c^2
    is known from the spread of their counts (R, E) alone.
    """
    spread = SPREAD * counts.var(axis=0, ddof=1) / np.maximum(counts.mean(axis=0), 1e-300)
    known = np.array([relative_variance(stated) for stated in clocks.group.stated])
    return np.asarray(np.maximum(np.where(np.isnan(known), spread, known), FIRST_TICK))


def _rates_by_window(windows: np.ndarray, mean: float, level: float) -> list[tuple[Interval, str]]:
    """Return how far the ticks (R, W, E) of all clocks are from the rates in each window."""
    parts = windows.sum(axis=2)
    count = parts.shape[1]
    return [
        (
            _count_interval(parts[:, k], mean / count, level / count, True, 0.0),
            f"all clocks in part {k + 1} of {count} of the run",
        )
        for k in range(count if count > 1 else 0)
    ]


def _limit_of_one_clock(
    clocks: ClockSamples, each: np.ndarray, singles: list[Interval], level: float
) -> str:
    """Return what no test could find at one clock, where that is more than WANTED_RATE.

    The estimate of a rate from N ticks of a Poisson process has at least the relative standard
    deviation 1 / sqrt(N), by the bound of Cramer and Rao.
    """
    worst = max(range(len(singles)), key=lambda k: singles[k].detectable)
    if singles[worst].detectable <= WANTED_RATE or not clocks.poisson:
        return ""
    ticks = float(clocks.rates[worst]) * clocks.scenario.horizon * len(each)
    quantiles = scipy.special.ndtri(1.0 - level) + scipy.special.ndtri(POWER)
    least = float(quantiles) / math.sqrt(ticks)
    return (
        f"; of one clock, no test at this level finds less than {least:.2g} in {ticks:,.0f} ticks"
    )


def _count_interval(
    values: np.ndarray, mean: float, level: float, poisson: bool, first_ticks: float
) -> Interval:
    """Return an interval for how far counts (R,) are from ``mean`` in a run, relative to it.

    Sums of Poisson counts are Poisson, with exact limits; other clocks are judged by the spread of
    their counts, and a difference of ``first_ticks`` says nothing.
    """
    total, runs = float(values.sum()), len(values)
    whole = runs * mean
    if poisson:
        return deviation_interval(1.0, _poisson_interval(total, whole, level))
    slack = first_ticks / mean
    spread = math.sqrt(max(float(values.var(ddof=1)), 0.25) * runs)
    apart = deviation_interval(1.0, student_interval(total / whole, spread / whole, runs, level))

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another value and ``factor`` times the runs."""
        low, high = apart.limits(value, factor)
        return max(0.0, low - slack), max(0.0, high - slack)

    value, low, high = (max(0.0, end - slack) for end in apart[:3])
    found = apart._replace(value=value, low=low, high=high, again=limits)
    return found._replace(detectable=apart.detectable + slack)


def _poisson_interval(total: float, mean: float, level: float) -> Interval:
    """Return an interval for the mean of a Poisson number of which ``total`` was seen, relative to
    ``mean``.
    """

    def limits(ratio: float, factor: float) -> tuple[float, float]:
        """Return both ends for another ratio and ``factor`` times the runs."""
        seen, expected = ratio * mean * factor, mean * factor
        low = float(scipy.special.gammaincinv(seen, level / 2.0)) if seen else 0.0
        high = float(scipy.special.gammaincinv(seen + 1.0, 1.0 - level / 2.0))
        return low / expected, high / expected

    detectable = detectable_shift(1.0 / math.sqrt(mean), level)
    return Interval(total / mean, *limits(total / mean, 1.0), detectable, again=limits)


def _check_gaps(group: Group, samples: PartSamples, level: float) -> Finding:
    """Compare gaps with the law of their clock, cell by cell, and with the gap before."""
    counts = group(samples).counts
    found = compare_cells(counts.cells.sum(axis=0), ["all clocks"], level / 2.0, "gaps")
    products = counts.products.sum(axis=0)
    if products[2] < 10 * CELLS:
        return found
    related = correlation_interval(float(products[0] / products[1]), products[2], level / 2.0)
    apart = deviation_interval(0.0, related)
    if apart.low > 0.0 and not found.margin[2] < 0.0:
        label = "neighbouring gaps"
        return find_largest([(apart, label)], found.tolerance, "largest correlation")
    text = f"; correlation of neighbouring gaps {related.value:.2g}"
    return found._replace(message=f"{found.message}{text}, {apart.detectable:.2g} would be seen")


def _check_lattice(group: Group, samples: PartSamples, level: float) -> Finding:
    """Compare ticks of clocks without randomness with where they should be."""
    counts, horizon = group(samples).counts, samples.scenario.horizon
    off, ticks = float(counts.off.max()), counts.ticks.sum()
    message = f"{ticks:,.0f} ticks, times in units of the length of a run"
    return find_identity(off / horizon, LATTICE_TOLERANCE, message)


def _clocks_apart(group: Group, samples: PartSamples, level: float) -> Finding:
    """Compare the spread of all ticks of a run with that of independent Poisson clocks."""
    clocks = group(samples)
    ticks = clocks.counts.ticks
    counts = ticks.reshape(-1, ticks.shape[2])
    mean = float((clocks.rates * samples.scenario.horizon).sum()) / ticks.shape[1]
    values = counts.sum(axis=1) - mean
    # A squared Poisson count has a little more spread than a squared normal one.
    freedom = len(values) / (1.0 + 0.5 / mean)
    ratio = scale_interval(freedom * float((values**2).mean()) / mean, freedom, level / 2.0)
    apart = deviation_interval(1.0, ratio)
    intervals = [(apart, "variance of all ticks at once over that of independent clocks")]
    pairs = largest_correlation(counts - counts.mean(axis=0), level / 2.0)
    if pairs is not None:
        value, (a, b) = pairs
        labels = clocks.group.labels
        intervals.append((value, f"correlation of {labels[a]} and {labels[b]}"))
    return find_largest(intervals, DISPERSION_TOLERANCE, "largest difference")


def largest_correlation(
    values: FloatArray, level: float
) -> tuple[Interval, tuple[int, int]] | None:
    """Return an interval for the largest correlation of two columns of values (K, L) of mean 0, by
    the spread of their products over the K independent rows.
    """
    some = values[:, :MAX_CLOCKS]
    kept = np.flatnonzero(some.var(axis=0) > 0.0)
    runs = len(some)
    if len(kept) < 2 or runs < 100:
        return None
    z = some[:, kept] / some[:, kept].std(axis=0)
    related = z.T @ z / runs
    upper = np.triu_indices(len(kept), 1)
    worst = int(np.argmax(np.abs(related[upper])))
    a, b = int(upper[0][worst]), int(upper[1][worst])
    products = z[:, a] * z[:, b]
    spread = max(float(products.std(ddof=1)), 1.0) / math.sqrt(runs)
    found = student_interval(float(related[upper][worst]), spread, runs, level / len(upper[0]))
    return deviation_interval(0.0, found), (int(kept[a]), int(kept[b]))


def _promises(clocks: ClockSamples, group: Group, sentences: dict[str, str]) -> list[Promise]:
    """Return the promises about one group of clocks, with a sentence for each test."""
    rows: list[tuple[str, Callable[..., Finding], bool]] = [("rates", _check_rates, False)]
    if clocks.poisson:
        rows += [("exponential", _check_gaps, False), ("apart", _clocks_apart, False)]
    elif all(ticks_on_lattice(stated) for stated in clocks.group.stated):
        rows.append(("lattice", _check_lattice, True))
    if not clocks.poisson and clocks.counts.cells.any():
        rows.append(("law", _check_gaps, False))
    return [
        Promise(sentences[name], "the scenario", (), partial(test, group), exact)
        for name, test, exact in rows
    ]


NETWORK_SENTENCES = {
    "rates": "clocks tick at the rates of the scenario",
    "exponential": "gaps between ticks are exponential, and independent of those before",
    "apart": "clocks tick independently of each other",
    "lattice": "clocks tick at the times of the scenario",
    "law": "ticks follow the law of their clocks, and do not depend on those before",
}
SAMPLING_SENTENCES = {
    "rates": "sensors sample at the rates of the scenario",
    "exponential": "gaps between samples are exponential, and independent of those before",
    "apart": "sensors sample independently of each other",
    "lattice": "sensors sample at the times of the scenario",
    "law": "samples follow the law of their clocks, and do not depend on those before",
}


def clock_promises(samples: PartSamples) -> list[Promise]:
    """Return the promises about clocks that have a stated law and were seen in the runs."""
    found: list[Promise] = []
    for counts, group, sentences in (
        (samples.ticks, _network_clocks, NETWORK_SENTENCES),
        (samples.sampling, _sampling_clocks, SAMPLING_SENTENCES),
    ):
        if counts is not None:
            clocks = group(samples)
            if np.isfinite(clocks.rates).all():
                found += _promises(clocks, group, sentences)
    return found
