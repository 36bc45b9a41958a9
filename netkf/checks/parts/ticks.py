"""Counts of ticks in one run: of the clocks of the network, and of those of sampled sensors.

The distribution function of a clock's gaps maps each gap to a uniform number (the probability
integral transform), whatever the clock and the length of the run. So gaps of all clocks and runs
can be counted in the same few cells.
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.checks.parts.moments import CELLS, correlation_interval, count_cells
from netkf.checks.parts.sources import stated_part
from netkf.checks.statistics import Interval
from netkf.core.clock import Entity, generate_ticks
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock, OnReadings, Periodic, Renewal
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

WINDOWS, MAX_WINDOWED = 8, 600
"""Windows of a run in which ticks and losses are counted, up to so many clocks or directions."""


class TickCounts(NamedTuple):
    """Counts of the ticks of E clocks in one run.

    ticks    : (W, E) ticks in each of W equal windows of the run
    cells    : (CELLS, 1) numbers of gaps between ticks, transformed by their stated distribution
               function to uniform numbers, in equal parts of [0, 1)
    products : (3,) over pairs of neighbouring gaps, as standard normal numbers u and v: the sum of
               u v, the sum of (u^2 + v^2) / 2, and the number of pairs
    off      : () largest distance in seconds of a tick from the times of a deterministic clock
    """

    ticks: np.ndarray
    cells: FloatArray
    products: FloatArray
    off: FloatArray


class ClockGroup(NamedTuple):
    """E clocks of a scenario: the entity (node or link) of each, the clock object whose law it
    states, and a label.
    """

    entities: tuple[Entity, ...]
    stated: tuple[Any, ...]
    labels: tuple[str, ...]


@lru_cache(maxsize=8)
def network_clocks(scenario: Scenario) -> ClockGroup:
    """Return the clocks of the network that are compared with their stated laws, one for each node
    or link; empty if no messages are sent or no clock decides when.
    """
    clock = scenario.network.activation
    silent = not scenario.filter.algorithm.talks
    if silent or not isinstance(clock, LinkClock) or isinstance(clock, OnReadings):
        return ClockGroup((), (), ())
    entities = tuple(clock.entities(scenario.topology))
    stated = (stated_part(clock, "activation"),) * len(entities)
    labels = tuple(f"clock {'-'.join(map(str, entity))}" for entity in entities)
    return ClockGroup(entities, stated, labels)


@lru_cache(maxsize=8)
def sampling_clocks(scenario: Scenario) -> ClockGroup:
    """Return the clocks at which sensors sample; empty unless every sampled sensor has one."""
    entities, stated, labels = [], [], []
    for node, placed_sensors in scenario.sampled_sensors.items():
        for placed_sensor in placed_sensors:
            clock = getattr(scenario.sensors[placed_sensor.entry], "sampling", None)
            if clock is None:
                return ClockGroup((), (), ())
            entities.append((node, placed_sensor.ordinal))
            stated.append(stated_part(clock, "sampling"))
            sensor_label = f"sensor {placed_sensor.ordinal} of " if len(placed_sensors) > 1 else ""
            labels.append(f"the clock of {sensor_label}node {node}")
    return ClockGroup(tuple(entities), tuple(stated), tuple(labels))


def count_ticks(scenario: Scenario, run: Run) -> TickCounts | None:
    """Return the counts by which the E clocks of the network are compared with their stated laws,
    from the ticks of a run in W windows (equal parts) of it; None without clocks.
    """
    group = network_clocks(scenario)
    if not group.entities:
        return None
    clock: Any = scenario.network.activation
    index = {entity: k for k, entity in enumerate(group.entities)}
    rows = run.log[run.log["kind"] == CODES["tick"]]
    columns = ("node",) if clock.at == "nodes" else ("node", "peer")
    ids = list(zip(*(rows[name].tolist() for name in columns), strict=True))
    if clock.at == "links":
        # Both nodes share the clock of a link, whose entity has the smaller id first.
        ids = [tuple(sorted(pair)) for pair in ids]
    clock_of_tick = np.array([index[entity] for entity in ids], dtype=np.int64)
    return _count_in_windows(group, rows["t"], clock_of_tick, scenario.horizon)


def count_samples(scenario: Scenario, streams: Streams) -> TickCounts | None:
    """Return the counts by which the sampling clocks of E sensors are compared with their stated
    laws, from the times at which they sample in a run, in W windows (equal parts) of it; None
    without clocks. The times are drawn again from the run's ``streams``.
    """
    group = sampling_clocks(scenario)
    if not group.entities:
        return None
    times = scenario.sample_times(streams)
    times_of_clock = [times[entity] for entity in group.entities]
    clock_of_tick = np.repeat(np.arange(len(times_of_clock)), [len(t) for t in times_of_clock])
    return _count_in_windows(group, np.concatenate(times_of_clock), clock_of_tick, scenario.horizon)


def count_drawn_ticks(scenario: Scenario, seed: int, replica: int) -> np.ndarray:
    """Return how often each of E clocks of the network ticks in one ``replica`` of the runs of
    ``seed``, (E,), drawn from the clocks' streams without simulating anything else.
    """
    clock: Any = scenario.network.activation
    streams = Streams(seed, replica)
    ticks = [
        generate_ticks(
            clock,
            entity,
            partial(streams.generator, "phase", *entity),
            streams.generator("clock", *entity),
            scenario.horizon,
        )
        for entity in network_clocks(scenario).entities
    ]
    return np.array([len(times) for times in ticks])


def draw_samples(scenario: Scenario, seed: int, replica: int) -> np.ndarray:
    """Return how often each of E sensors samples in one ``replica`` of the runs of ``seed``, (E,),
    drawn from the sensors' streams without simulating anything else.
    """
    times = scenario.sample_times(Streams(seed, replica))
    return np.array([len(times[entity]) for entity in sampling_clocks(scenario).entities])


def count_by_window(
    scenario: Scenario, times: np.ndarray, indices: np.ndarray, size: int
) -> np.ndarray:
    """Return how often each of ``size`` indices occurs in each of W windows of a run, (W, size).

    ``times`` (K,) in seconds and ``indices`` (K,) are those of K events.
    """
    return _by_window(times, indices, size, scenario.horizon)


def _by_window(times: np.ndarray, indices: np.ndarray, size: int, horizon: float) -> np.ndarray:
    """Return how often each of ``size`` indices occurs in each of W equal parts of [0, ``horizon``]
    (seconds), (W, size), from the ``times`` (K,) and ``indices`` (K,) of K events.

    Counts of different windows are independent, as those of different runs are, so that
    correlations between clocks can be detected in fewer runs.
    """
    windows = WINDOWS if size <= MAX_WINDOWED else 1
    flat_index = np.minimum((times * (windows / horizon)).astype(np.int64), windows - 1)
    counts = np.bincount(flat_index * size + indices, minlength=windows * size)
    return counts.reshape(windows, size)


def _count_in_windows(
    group: ClockGroup, times: np.ndarray, clock_of_tick: np.ndarray, horizon: float
) -> TickCounts:
    """Return the counts by which the clocks of ``group`` are compared with their stated laws, from
    the ``times`` (K,) in seconds of the K ticks of a run of ``horizon`` seconds, and the indices
    ``clock_of_tick`` (K,) of their clocks in the group.
    """
    size = len(group.entities)
    windows = _by_window(times, clock_of_tick, size, horizon)
    order = np.lexsort((times, clock_of_tick))
    sorted_times, sorted_clocks = times[order], clock_of_tick[order]
    is_first = np.ones(len(sorted_times), dtype=bool)
    is_first[1:] = sorted_clocks[1:] != sorted_clocks[:-1]
    # The number of each tick among those of its clock.
    ticks_of_clock = np.bincount(sorted_clocks, minlength=size)
    first_row = np.concatenate([[0], np.cumsum(ticks_of_clock)])
    number = np.arange(len(sorted_times)) - first_row[sorted_clocks]
    # Under the null hypothesis the gaps, transformed by their stated law, are uniform in [0, 1).
    uniform, largest_error = np.full(len(sorted_times), np.nan), 0.0
    for clock in dict.fromkeys(group.stated):  # clocks of one law share one object
        rows = np.array([stated is clock for stated in group.stated])[sorted_clocks]
        ticks = TickSample(
            sorted_times[rows], number[rows], ticks_of_clock[sorted_clocks[rows]], is_first[rows]
        )
        uniform[rows] = _as_uniform(clock, ticks, horizon)
        largest_error = max(largest_error, distance_from_lattice(clock, ticks))
    present = np.isfinite(uniform)
    cells = count_cells(np.where(present, uniform, 0.0)[:, None], present[:, None])
    products = correlate_neighbours(uniform, is_first)
    return TickCounts(windows, cells, products, np.array(largest_error))


class TickSample(NamedTuple):
    """K ticks of one run, clock by clock and in order of time.

    times  : (K,) seconds
    number : (K,) index of the tick on its clock, from 0
    total  : (K,) number of ticks of its clock in the run
    first  : (K,) bool, the tick is the first of its clock
    """

    times: np.ndarray
    number: np.ndarray
    total: np.ndarray
    first: np.ndarray

    @property
    def before(self) -> np.ndarray:
        """Time (K,) in seconds of the tick before on the same clock, 0 before the first."""
        before = np.concatenate([[0.0], self.times[:-1]])[: len(self.times)]
        return np.where(self.first, 0.0, before)


def _as_uniform(clock: Any, ticks: TickSample, horizon: float) -> np.ndarray:
    """Return the gap before each of K ticks as a number (K,) that is uniform in [0, 1) and
    independent of those before it under the stated law; nan where no law is known.

    The end of a run, at ``horizon`` seconds, censors long gaps, which the transform must allow for.
    Given the number of ticks in a run, those of a Poisson clock are independent uniform times: with
    m ticks still to come in the remaining time, a gap exceeds a share v of it with probability (1 -
    v)^m. For other renewal clocks the law of a gap is conditioned on its end being before that of
    the run.
    """
    gaps, remaining = ticks.times - ticks.before, horizon - ticks.before
    if clock.memoryless:
        return np.asarray(-np.expm1((ticks.total - ticks.number) * np.log1p(-gaps / remaining)))
    if type(clock) is Renewal:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(gap_law(clock, gaps) / gap_law(clock, remaining))
    if type(clock) is Periodic and clock.jitter > 0.0 and not isinstance(clock.phase, str):
        share = (ticks.times - _lattice_times(clock, ticks.number)) / clock.jitter
        # The last tick is left out: jitter could have moved it beyond the end of the run.
        return np.where(ticks.number < ticks.total - 1, np.clip(share, 0.0, 1.0), np.nan)
    if type(clock) is Periodic and isinstance(clock.phase, str) and clock.period <= horizon:
        phases = np.clip(ticks.times / clock.period, 0.0, 1.0)
        return np.where(ticks.first & (clock.jitter == 0.0), phases, np.nan)
    return np.full(len(gaps), np.nan)


def gap_law(clock: Any, gaps: np.ndarray) -> np.ndarray:
    """Return P(gap <= ``gaps``) (K,) of a renewal clock, ``gaps`` in seconds; nan where gaps are
    constant or their law is unknown.
    """
    # By exact type: a class with statements of its own has a law of its own.
    if type(clock) is not Renewal:
        return np.full(len(gaps), np.nan)
    shape, mean = clock.shape or 1.0, 1.0 / clock.mean_rate(())
    if clock.distribution == "gamma":
        return np.asarray(scipy.special.gammainc(shape, shape * gaps / mean))
    if clock.distribution == "weibull":
        scale = mean / scipy.special.gamma(1.0 + 1.0 / shape)
        return np.asarray(-np.expm1(-((gaps / scale) ** shape)))
    if clock.distribution == "uniform" and clock.high != clock.low:
        assert clock.low is not None
        assert clock.high is not None
        return np.clip((gaps - clock.low) / (clock.high - clock.low), 0.0, 1.0)
    return np.full(len(gaps), np.nan)


def relative_variance(clock: Any) -> float:
    """Return the squared coefficient of variation of a clock's gaps (variance over squared mean) by
    its stated law; nan if that is unknown.
    """
    if ticks_on_lattice(clock):
        return 0.0
    if type(clock) is not Renewal:
        return math.nan
    shape = clock.shape or 1.0
    if clock.distribution == "gamma":
        return 1.0 / shape
    if clock.distribution == "weibull":
        first, second = (math.gamma(1.0 + k / shape) for k in (1.0, 2.0))
        return second / first**2 - 1.0
    assert clock.low is not None
    assert clock.high is not None
    return (clock.high - clock.low) ** 2 / (3.0 * (clock.high + clock.low) ** 2)


def _lattice_times(clock: Any, number: np.ndarray) -> np.ndarray:
    """Return the times (K,) in seconds at which a clock of constant gaps makes the ticks with
    indices ``number`` (K,), without jitter and random phase.
    """
    if isinstance(clock, Renewal):
        return np.asarray((number + 1) / clock.mean_rate(()))
    phase = 0.0 if isinstance(clock.phase, str) else clock.phase
    # With phase 0 the first tick is at one period, since there is none at time 0.
    return np.asarray(phase + clock.period * (number + (clock.phase == 0.0)))


def ticks_on_lattice(clock: Any) -> bool:
    """Return True if the times of all ticks are stated, up to one random phase and jitter."""
    # By exact type: a class with statements of its own has a law of its own.
    constant = type(clock) is Renewal and clock.distribution == "constant"
    return constant or type(clock) is Periodic


def distance_from_lattice(clock: Any, ticks: TickSample) -> float:
    """Return the largest distance in seconds of one of the K ticks of a clock's law from its
    allowed times; 0 for clocks whose ticks are not at multiples of a period.

    A tick may be late by the clock's jitter. All ticks of a clock with a random phase may also be
    shifted by one common time of at most a period: the lateness of its ticks may then differ among
    them by the jitter, and that of the first tick be at most period and jitter.
    """
    if not ticks_on_lattice(clock) or not len(ticks.times):
        return 0.0
    late = ticks.times - _lattice_times(clock, ticks.number)
    jitter = getattr(clock, "jitter", 0.0)
    if isinstance(getattr(clock, "phase", None), str):  # a random phase for each clock
        starts = np.flatnonzero(ticks.first)
        spread = np.maximum.reduceat(late, starts) - np.minimum.reduceat(late, starts)
        excess = late[starts] - (clock.period + jitter)
        return float(max(spread.max() - jitter, excess.max(), 0.0))
    return float(max(-late.min(), late.max() - jitter, 0.0))


def correlate_neighbours(uniform: np.ndarray, first: np.ndarray) -> FloatArray:
    """Return the sums (3,) from which :func:`correlation_of_neighbours` tests that successive gaps
    (or delays) are independent: over neighbours u, v of a series ``uniform`` (K,) of uniform
    numbers, made normal, those of u v and of (u^2 + v^2) / 2, and their number.

    Numbers that are nan, and the pairs of a number marked as ``first`` (K,) of its clock with the
    one before it, are left out.
    """
    normal = scipy.special.ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12))
    pairs = ~first[1:] & np.isfinite(normal[1:]) & np.isfinite(normal[:-1])
    u, v = normal[1:][pairs], normal[:-1][pairs]
    return np.array([u @ v, 0.5 * (u @ u + v @ v), float(len(u))])


def correlation_of_neighbours(products: FloatArray, level: float) -> Interval | None:
    """Return an interval for the correlation of neighbouring numbers from the ``products`` (R, 3)
    of R runs, see :func:`correlate_neighbours`; None for fewer than 10 CELLS pairs.

    The interval misses the truth with at most the probability ``level``.
    """
    total, squares, pairs = products.sum(axis=0)
    if pairs < 10 * CELLS:
        return None
    return correlation_interval(float(total / squares), pairs, level)
