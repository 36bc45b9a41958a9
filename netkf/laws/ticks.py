"""Ticks of clocks against the rates and the laws of gaps that the clocks state, and waiting times
(gaps between ticks, delays of messages) that the end of a run cuts off.

The distribution function of a law maps waiting times to ranks, which are uniform in [0, 1] whatever
the law, so that those of all clocks, links and runs can be counted in the same few cells.

A waiting time is looked at only if it begins so early that the run shows whether it exceeds a
``cut``; one that does, or is still unfinished at the end, is of unknown length beyond the cut. So
the shares of waiting times below the cut are those of the stated law itself, not of what the end of
the run leaves of it. Whether one is looked at depends on the past only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from netkf.core.clock import Entity
from netkf.core.laws import EXPONENTIAL, Lattice, WaitingLaw
from netkf.laws.intervals import (
    NO_COMPARISON,
    POWER,
    Interval,
    LawComparison,
    correlation_interval,
    detectable_shift_of_student,
    deviation_interval,
    poisson_interval,
    probability_interval,
    scale_interval,
    student_interval,
)
from netkf.linalg.arrays import FloatArray

CELLS = 16
"""Number of cells of equal probability."""
MIN_SEEN = 10 * CELLS
"""Values, or pairs of them, from which laws and correlations of ranks are tested."""


class Ranks(NamedTuple):
    """Waiting times as numbers that are uniform in [0, 1] under the stated law.

    rank  : (K,) P(waiting time <= this one); nan if it is not looked at
    known : (K,) number of the CELLS equal parts of [0, 1], from the lowest on, that a run can show;
            a rank beyond them is only known to be so
    """

    rank: FloatArray
    known: np.ndarray

    @property
    def is_beyond(self) -> np.ndarray:
        """Mask (K,) of the ranks that are only known to lie beyond the ``known`` parts."""
        return np.asarray(CELLS * self.rank >= self.known)


def censored_ranks(
    law: WaitingLaw, begin: FloatArray, duration: FloatArray, horizon: FloatArray | float
) -> Ranks:
    """Return the ranks of K waiting times, which ``begin`` (K,) and last a ``duration`` (K,), inf
    for those unfinished at the ``horizon``, under their ``law``.
    """
    # A cut of at most half of the run leaves waiting times to look at.
    known = np.floor(CELLS * law.cdf(np.broadcast_to(0.5 * horizon, begin.shape)) + 1e-9)
    known = np.clip(known, 0.0, CELLS - 1.0)
    cut = law.quantile(np.arange(CELLS) / CELLS)[np.nan_to_num(known).astype(np.int64)]
    short = duration <= cut
    rank = np.where(short, law.cdf(np.where(short, duration, 0.0)), 1.0)
    # Rounding must not move a rank over the cut.
    rank = np.where(short, np.minimum(rank, known / CELLS - 1e-12), rank)
    return Ranks(np.where((known > 0.0) & (begin < horizon - cut), rank, np.nan), known)


def count_ranks(ranks: Ranks) -> FloatArray:
    """Return how many ranks are, and could be, in each of CELLS parts of [0, 1], (CELLS, 2)."""
    looked_at = np.isfinite(ranks.rank)
    rank, known = ranks.rank[looked_at], ranks.known[looked_at].astype(np.int64)
    cells = np.minimum((CELLS * rank).astype(np.int64), CELLS - 1)
    # With all parts but the last known, a rank beyond them is in the last.
    seen = (cells < known) | (known >= CELLS - 1)
    hits = np.bincount(cells[seen], minlength=CELLS)
    visible = np.bincount(np.where(known >= CELLS - 1, CELLS, known), minlength=CELLS + 1)
    trials = visible[::-1].cumsum()[::-1][1:]
    return np.stack([hits, trials], axis=1).astype(np.float64)


def fill_in(ranks: Ranks) -> FloatArray:
    """Return the ranks (K,), with the mean of what is beyond the known parts where they are."""
    beyond = 0.5 * (ranks.known / CELLS + 1.0)
    return np.asarray(np.where(ranks.is_beyond, beyond, ranks.rank))


def correlate_neighbours(ranks: Ranks, first: np.ndarray) -> FloatArray:
    """Return sums (3,) over neighbouring ranks u, v, made normal: of u v, (u^2 + v^2) / 2, and 1.

    Pairs with nan, or with the ``first`` (K,) of a series, are left out; a rank beyond the known
    parts counts as the mean of what is beyond.
    """
    limits = np.clip(np.arange(CELLS + 1) / CELLS, 1e-12, 1.0 - 1e-12)
    density = np.exp(-0.5 * scipy.special.ndtri(limits) ** 2) / math.sqrt(2.0 * math.pi)
    means = density / (1.0 - limits)
    seen = scipy.special.ndtri(np.clip(ranks.rank, 1e-12, 1.0 - 1e-12))
    normal = np.where(ranks.is_beyond, means[np.nan_to_num(ranks.known).astype(np.int64)], seen)
    pairs = ~first[1:] & np.isfinite(normal[1:]) & np.isfinite(normal[:-1])
    u, v = normal[1:][pairs], normal[:-1][pairs]
    return np.array([u @ v, 0.5 * (u @ u + v @ v), float(len(u))])


def neighbour_correlation(products: FloatArray, level: float) -> Interval | None:
    """Return the interval of the correlation of neighbours, None for few pairs."""
    total, squares, pairs = products.sum(axis=0)
    if pairs < MIN_SEEN:
        return None
    return correlation_interval(float(total / squares), pairs, level)


def compare_shares(cells: FloatArray, level: float, noun: str) -> LawComparison:
    """Compare waiting times with their law: how many are in cells of equal probability, and could
    be, (CELLS, 2), without cells that few runs can show.
    """
    visible = [k for k, trials in enumerate(cells[:, 1].tolist()) if trials >= MIN_SEEN]
    if not visible:
        return NO_COMPARISON
    distances = [
        (cell_interval(cells[k, 0], cells[k, 1], level / len(visible)), cell_label(k))
        for k in visible
    ]
    text = f"{cells[0, 1]:,.0f} {noun}, largest difference of a share from 1/{CELLS}"
    if len(visible) < CELLS:
        text += f" (runs are too short to show ranks above {(visible[-1] + 1) / CELLS:.2f})"
    return LawComparison(distances, text)


def cell_interval(count: float, total: float, level: float) -> Interval:
    """Return the interval of the distance between a cell's share and its probability."""
    return deviation_interval(1.0 / CELLS, probability_interval(int(count), int(total), level))


def cell_label(k: int) -> str:
    """Return the range of ranks of cell ``k``, from 0 to CELLS - 1, as text."""
    return f"rank {k / CELLS:.2f} to {(k + 1) / CELLS:.2f}"


WINDOWS, MAX_WINDOWED = 8, 600
"""Windows of a run in which ticks and losses are counted, up to so many clocks or directions."""
SHARES = np.append(np.sort(np.arange(1, WINDOWS) * 0.6180339887498949 % 1.0), 1.0)
"""Shares of a run in which ticks are counted too: ticks in groups that are as long as a part of the
run look like single ones in equal windows.
"""
FIRST_TICK, SPREAD = 1.0, 2.0
"""Slack, in ticks of one run, for the transient of a renewal clock that starts with the run; and
safety factor on the dispersion index of its counts, which replaces c^2 of an unknown gap law.
"""
MAX_CLOCKS, MIN_EVENTS = 60, 20
"""Columns of counts of which all pairs are compared, and events (ticks, losses) in each of them."""


class ClockGroup(NamedTuple):
    """E clocks: the entity (node or link) of each, its stated rate (E,) in ticks per second, nan if
    unknown, its law (:attr:`Clock.gaps`), one object for clocks of one law, and its label.
    """

    entities: tuple[Entity, ...]
    rates: FloatArray
    gaps: tuple[WaitingLaw | Lattice | None, ...]
    labels: tuple[str, ...]

    @property
    def poisson(self) -> bool:
        """True if all clocks are Poisson processes."""
        return all(law is EXPONENTIAL for law in self.gaps)

    @property
    def on_lattice(self) -> bool:
        """True if the times of all ticks are stated, up to random phases and jitter."""
        return all(isinstance(law, Lattice) for law in self.gaps)

    @property
    def spreads(self) -> FloatArray:
        """The variances (E,) of gaps over squared means, nan if unknown."""
        known = (getattr(law, "spread", 0.0 if law else math.nan) for law in self.gaps)
        return np.array(list(known))


class TickCounts(NamedTuple):
    """Counts of the ticks of E clocks in one run; of R runs with a first axis of that length.

    ticks    : (W, E) ticks in each of W equal windows of the run
    cells    : (CELLS, 2) numbers of ranks of gaps in equal parts of [0, 1), and of those looked at
    products : (3,) sums over neighbouring gaps (:func:`correlate_neighbours`)
    off      : () largest distance in seconds of a tick from the times of a deterministic clock
    path     : (S, E) ticks in each of the first SHARES of the run, of many clocks only in all of it
    """

    ticks: np.ndarray
    cells: FloatArray
    products: FloatArray
    off: FloatArray
    path: np.ndarray


class TickSeries(NamedTuple):
    """K ticks, clock by clock and in order of time: times (K,) in seconds, inf for the tick after
    the last of a clock; number (K,) of each on its clock, from 0; total (K,) ticks of its clock.
    """

    times: FloatArray
    number: np.ndarray
    total: np.ndarray

    @property
    def before(self) -> FloatArray:
        """Times (K,) of the tick before on the same clock, 0 before the first."""
        return np.where(self.number == 0, 0.0, np.concatenate([[0.0], self.times[:-1]]))


def count_by_window(times: FloatArray, index: np.ndarray, size: int, horizon: float) -> np.ndarray:
    """Return how often each of ``size`` indices occurs in W equal parts of a run, (W, size)."""
    windows = WINDOWS if size <= MAX_WINDOWED else 1
    flat_index = np.minimum((times * (windows / horizon)).astype(np.int64), windows - 1)
    counts = np.bincount(flat_index * size + index, minlength=windows * size)
    return counts.reshape(windows, size)


def count_ticks(
    group: ClockGroup, times: FloatArray, owners: np.ndarray, horizon: float
) -> TickCounts:
    """Return the counts of the ticks at ``times`` (K,) of the clocks ``owners`` (K,) of a group."""
    size = len(group.entities)
    windows = count_by_window(times, owners, size, horizon)
    shares = SHARES if size <= MAX_WINDOWED else SHARES[-1:]
    part = np.searchsorted(shares[:-1], times / horizon, side="right")
    in_parts = np.bincount(part * size + owners, minlength=len(shares) * size)
    path = np.cumsum(in_parts.reshape(-1, size), axis=0)
    # After its last tick each clock has a gap that the run does not finish.
    times = np.concatenate([times, np.full(size, np.inf)])
    owners = np.concatenate([owners, np.arange(size)])
    order = np.lexsort((times, owners))
    times, owners = times[order], owners[order]
    total = np.bincount(owners, minlength=size)
    number = np.arange(len(times)) - np.concatenate([[0], np.cumsum(total)])[owners]
    series = TickSeries(times, number, total[owners] - 1)
    ranks = Ranks(np.full(len(times), np.nan), np.zeros(len(times)))
    off = 0.0
    for law in {id(law): law for law in group.gaps}.values():
        rows = np.array([other is law for other in group.gaps])[owners]
        ticks, rates = TickSeries(*(column[rows] for column in series)), group.rates[owners[rows]]
        if isinstance(law, Lattice):
            ranks.rank[rows], ranks.known[rows] = _lattice_ranks(law, ticks, horizon), CELLS
            off = max(off, _distance_from_lattice(law, ticks))
        elif law is not None:
            begin, gaps = ticks.before * rates, (ticks.times - ticks.before) * rates
            ranks.rank[rows], ranks.known[rows] = censored_ranks(law, begin, gaps, horizon * rates)
    products = correlate_neighbours(ranks, number == 0)
    return TickCounts(windows, count_ranks(ranks), products, np.array(off), path)


def _lattice_ranks(law: Lattice, ticks: TickSeries, horizon: float) -> FloatArray:
    """Return independent uniform numbers (K,) that K ticks show, nan for ticks that show none."""
    uniform, jitter = np.full(len(ticks.times), np.nan), law.jitter
    # The last tick is left out: jitter could have moved it beyond the end of the run.
    inner = (ticks.number < ticks.total - 1) & (jitter > 0.0)
    if not law.random_phase:
        late = ticks.times[inner] - (law.first + law.period * ticks.number[inner])
        uniform[inner] = np.clip(late / (jitter or 1.0), 0.0, 1.0)
        return uniform
    first = ticks.number == 0
    if law.period + jitter <= horizon:  # the first tick is never beyond the end
        uniform[first] = _sum_of_uniforms(ticks.times[first], law.period, jitter)
    # Ticks 1 and 2, 3 and 4, ...
    second = np.flatnonzero(inner & ~first & (ticks.number % 2 == 0))
    if len(second):
        share = np.clip((ticks.times[second] - ticks.before[second] - law.period) / jitter, -1, 1)
        uniform[second] = 0.5 + share - 0.5 * share * np.abs(share)
    return uniform


def _sum_of_uniforms(times: FloatArray, period: float, jitter: float) -> FloatArray:
    """Return P(phase + delay <= ``times``) (K,), uniform up to ``period`` and ``jitter`` or 0."""
    if jitter == 0.0:
        return np.clip(times / period, 0.0, 1.0)
    squares = [np.maximum(times - end, 0.0) ** 2 for end in (0.0, period, jitter, period + jitter)]
    area = squares[0] - squares[1] - squares[2] + squares[3]
    return np.asarray(np.clip(area / (2.0 * period * jitter), 0.0, 1.0))


def _distance_from_lattice(law: Lattice, ticks: TickSeries) -> float:
    ticks = TickSeries(*(column[np.isfinite(ticks.times)] for column in ticks))
    if not len(ticks.times):
        return 0.0
    late = ticks.times - (law.first + law.period * ticks.number)
    if not law.random_phase:
        return float(max(-late.min(), late.max() - law.jitter, 0.0))
    starts = np.flatnonzero(ticks.number == 0)
    spread = np.maximum.reduceat(late, starts) - np.minimum.reduceat(late, starts)
    early, excess = -late[starts], late[starts] - (law.period + law.jitter)
    return float(max(spread.max() - law.jitter, early.max(), excess.max(), 0.0))


def slack_of_start(group: ClockGroup, counts: np.ndarray, paths: np.ndarray) -> FloatArray:
    """Return by how many ticks (E,) mean counts in a run of T seconds may differ from rate T though
    the rate is right: a renewal process has between rate T - 1 and rate T + c^2, c the coefficient
    of variation of its gaps (Lorden 1970). An unknown c^2 is the dispersion index of ``counts`` (R,
    E), or, where ticks come in groups, how far means of ``paths`` (R, S, E) stray from a line.
    """
    from_counts = SPREAD * counts.var(axis=0, ddof=1) / np.maximum(counts.mean(axis=0), 1e-300)
    path = paths.mean(axis=0)
    strays = path - SHARES[-len(path) :, None] * path[-1]
    unknown = np.maximum(from_counts, SPREAD * np.ptp(strays, axis=0))
    slack = np.where(np.isnan(group.spreads), unknown, group.spreads)
    return np.asarray(np.maximum(slack, FIRST_TICK))


def rates_of_all(
    group: ClockGroup, windows: np.ndarray, slack: float, horizon: float, level: float
) -> list[tuple[Interval, str]]:
    """Return labelled intervals of the relative error of the total rate, in the whole run at
    ``level`` and, of Poisson clocks, in each of its ``windows`` (R, W, E) at ``level`` together.
    """
    mean, count, total = float(group.rates.sum()) * horizon, windows.shape[1], windows.sum(axis=2)
    whole = count_interval(total.sum(axis=1), mean, level, group.poisson, slack)
    parts = [
        # Poisson counts are right from the start of a run on: no slack for a transient.
        (
            count_interval(total[:, k], mean / count, level / count, True, 0.0),
            f"all clocks in part {k + 1} of {count} of the run",
        )
        for k in range(count if group.poisson and count > 1 else 0)
    ]
    return [(whole, "all clocks together"), *parts]


def rates_of_each(
    group: ClockGroup, counts: np.ndarray, slack: FloatArray, horizon: float, level: float
) -> list[Interval]:
    """Return intervals, together at ``level``, of relative errors of rates of E clocks."""
    expected, single = group.rates * horizon, level / len(group.rates)
    poisson = group.poisson
    return [
        count_interval(counts[:, k], float(mean), single, poisson, float(slack[k]))
        for k, mean in enumerate(expected)
    ]


def smallest_error(ticks: float, level: float) -> float:
    """Return the relative error of the rate of a Poisson process below which no test at ``level``
    finds it with probability POWER in so many ``ticks``, by the Cramer-Rao bound 1 / sqrt(ticks).
    """
    quantiles = scipy.special.ndtri(1.0 - level) + scipy.special.ndtri(POWER)
    return float(quantiles) / math.sqrt(ticks)


def count_interval(
    values: np.ndarray, mean: float, level: float, poisson: bool, slack: float
) -> Interval:
    """Return an interval for |E(count) / mean - 1| from ``values`` (R,) of R runs: exact for
    ``poisson`` counts, else Student's, less the ``slack`` of the start of a run in ticks.
    """
    total, runs = float(values.sum()), len(values)
    expected_total = runs * mean
    if poisson:
        return deviation_interval(1.0, poisson_interval(total, expected_total, level))
    relative_slack = slack / mean
    # Few integer counts may be all equal: at least the variance of two values with equal odds.
    spread = math.sqrt(max(float(values.var(ddof=1)), 0.25) * runs)
    distance = deviation_interval(
        1.0, student_interval(total / expected_total, spread / expected_total, runs, level)
    )

    def limits(value: float, factor: float) -> tuple[float, float]:
        low, high = distance.limits(value, factor)
        return max(0.0, low - relative_slack), max(0.0, high - relative_slack)

    value, low, high = (max(0.0, end - relative_slack) for end in distance[:3])
    detectable = distance.detectable + relative_slack
    return distance._replace(value=value, low=low, high=high, detectable=detectable, again=limits)


def compare_gaps(counts: TickCounts, level: float) -> tuple[LawComparison, LawComparison]:
    """Compare gaps of R runs with their law, and correlations with 0, each at half of ``level``."""
    shares = compare_shares(counts.cells.sum(axis=0), level / 2.0, "gaps")
    correlation = neighbour_correlation(counts.products, level / 2.0)
    if correlation is None:
        return shares, NO_COMPARISON
    distance = deviation_interval(0.0, correlation)
    return shares, LawComparison([(distance, "neighbouring gaps")], "largest correlation")


def compare_clocks(
    group: ClockGroup, windows: np.ndarray, horizon: float, level: float
) -> LawComparison:
    """Compare Poisson clocks with independent ones, from their ticks ``windows`` (R, W, E) in R
    runs of ``horizon`` seconds: the total count of a window is Poisson, so that its variance equals
    its mean, and no two clocks have correlated counts; each test gets half of ``level``.
    """
    counts = windows.reshape(-1, windows.shape[2])  # (windows of all runs, clocks)
    mean = float(group.rates.sum()) * horizon / windows.shape[1]
    values = counts.sum(axis=1) - mean
    # (x - m)^2 of a Poisson x with mean m has the variance 2 m^2 + m instead of 2 m^2 as for a
    # normal one: the sum is treated as chi-square with correspondingly fewer degrees of freedom.
    freedom = len(values) / (1.0 + 0.5 / mean)
    ratio = scale_interval(freedom * float((values**2).mean()) / mean, freedom, level / 2.0)
    label = "variance of all ticks at once over that of independent clocks"
    distances = [(deviation_interval(1.0, ratio), label)]
    means = counts.mean(axis=0)  # also the variances of Poisson counts
    pairs = largest_correlation(counts - means, np.broadcast_to(means, counts.shape), level / 2.0)
    if pairs is not None:
        correlation, (a, b) = pairs
        distances.append((correlation, f"correlation of {group.labels[a]} and {group.labels[b]}"))
    return LawComparison(distances, "largest difference")


def largest_correlation(
    values: FloatArray, variances: FloatArray, level: float
) -> tuple[Interval, tuple[int, int]] | None:
    """Return an interval for the largest |correlation| of two columns of ``values`` (K, L), of mean
    0 and ``variances`` (K, L) in independent rows, and the indices of the two.

    Products of two columns in units of their expected deviations (those that were seen would be far
    too small where events are rare) are averaged by Student's interval, with Bonferroni's
    correction for all pairs with variances in one row. None without such a pair of columns of
    MIN_EVENTS expected events, or with fewer than 100 rows.
    """
    frequent = np.flatnonzero(variances[:, :MAX_CLOCKS].sum(axis=0) >= MIN_EVENTS)
    if len(frequent) < 2 or len(values) < 100:
        return None
    x, variance = values[:, frequent], variances[:, frequent]
    deviation = np.sqrt(variance)
    apart = deviation.T @ deviation
    # Links of a matching that are never up together have no products.
    first, second = np.nonzero(np.triu(apart, 1))
    if not len(first):
        return None
    largest = int(np.argmax(np.abs((x.T @ x)[first, second] / apart[first, second])))
    a, b = int(first[largest]), int(second[largest])
    interval = correlation_of_columns(
        x[:, a] * x[:, b], variance[:, a] * variance[:, b], level / len(first)
    )
    return deviation_interval(0.0, interval), (int(frequent[a]), int(frequent[b]))


def correlation_of_columns(products: FloatArray, variances: FloatArray, level: float) -> Interval:
    """Return Student's interval for a correlation from K ``products`` of values of mean 0, with
    ``variances`` (K,) without correlation.

    Rare events that coincide are a Poisson variable: of a correlation r its mean exceeds that
    without, lambda, by r times ``scale``, and its deviation is that of the sum.
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
