"""Counts of ticks in one run: of the clocks of the network, and of those of sampled sensors.

The distribution function of a clock's gaps maps each gap to a uniform number (the probability
integral transform), whatever the clock and the length of the run. So gaps of all clocks and runs
can be counted in the same few cells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.checks.parts.moments import CELLS
from netkf.checks.parts.sources import stated_part
from netkf.checks.parts.waiting import (
    Ranks,
    WaitingLaw,
    censored_ranks,
    correlate_neighbours,
    count_ranks,
    exponential_law,
    fill_in_normal,
    uniform_law,
)
from netkf.core.clock import Entity, generate_ticks
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock, OnReadings, Periodic, Poisson, Renewal
from netkf.network.contacts import Contacts
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

WINDOWS, MAX_WINDOWED = 8, 600
"""Windows of a run in which ticks and losses are counted, up to so many clocks or directions."""


class TickCounts(NamedTuple):
    """Counts of the ticks of E clocks in one run.

    ticks    : (W, E) ticks in each of W equal windows of the run
    cells    : (CELLS, 2) numbers of gaps between ticks, transformed by their stated distribution
               function to uniform numbers, in equal parts of [0, 1), and of those looked at
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
    if isinstance(clock, Contacts):
        entities, stated = _clocks_in_contact(clock, entities, scenario.horizon)
    labels = tuple(f"clock {'-'.join(map(str, entity))}" for entity in entities)
    return ClockGroup(entities, stated, labels)


def _clocks_in_contact(
    clock: Contacts, entities: tuple[Entity, ...], horizon: float
) -> tuple[tuple[Entity, ...], tuple[Any, ...]]:
    """Return the links that are in contact before the ``horizon`` (seconds), and the law of each:
    a Poisson clock that ticks in contacts only is one in the time of its contacts; stretched to the
    length of a run it has a rate that is smaller by the share of contacts.
    """
    end = np.array([horizon])
    lengths = {entity: float(clock.time_in_contact(entity, end)[0]) for entity in entities}
    met = tuple(entity for entity in entities if lengths[entity] > 0.0)
    if type(clock.clock) is not Poisson:
        return met, (clock,) * len(met)
    rates = [clock.clock.mean_rate(entity) * lengths[entity] / horizon for entity in met]
    # Clocks of one law share one object.
    laws = {rate: Poisson(rate=rate, at=clock.at) for rate in rates}
    return met, tuple(laws[rate] for rate in rates)


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
    if isinstance(clock, Contacts):
        return _count_in_contacts(clock, group, ids, rows["t"], scenario.horizon)
    clock_of_tick = np.array([index[entity] for entity in ids], dtype=np.int64)
    return _count_in_windows(group, rows["t"], clock_of_tick, scenario.horizon)


def _count_in_contacts(
    clock: Contacts, group: ClockGroup, ids: list[Entity], times: np.ndarray, horizon: float
) -> TickCounts:
    """Return the counts of links that tick in contacts only, from the entities ``ids`` and the
    ``times`` (K,) in seconds of the K ticks of a run: in the time of contacts, stretched to the
    ``horizon``; ``off`` is the largest distance of a tick from a contact of its link.
    """
    of_entity: dict[Entity, list[int]] = {}
    for row, entity in enumerate(ids):
        of_entity.setdefault(entity, []).append(row)
    distances = (clock.distance(entity, times[rows]) for entity, rows in of_entity.items())
    off = max(distances, default=0.0)
    end, inner, owners = np.array([horizon]), [np.empty(0)], [np.empty(0, dtype=np.int64)]
    for k, entity in enumerate(group.entities):
        ticks = times[of_entity.get(entity, [])]
        met = clock.time_in_contact(entity, ticks[clock.in_contact(entity, ticks)])
        inner.append(met * (horizon / clock.time_in_contact(entity, end)[0]))
        owners.append(np.full(len(met), k))
    counts = _count_in_windows(group, np.concatenate(inner), np.concatenate(owners), horizon)
    return counts._replace(off=np.array(off))


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
    ticks = draw_ticks(scenario, network_clocks(scenario).entities, seed, replica)
    return np.array([len(times) for times in ticks])


def draw_ticks(
    scenario: Scenario, entities: Sequence[Entity], seed: int, replica: int
) -> list[FloatArray]:
    """Return the times in seconds of the ticks of each of the ``entities`` of the network's clock,
    drawn again from the streams of one ``replica`` of the runs of ``seed``.
    """
    clock: Any = scenario.network.activation
    streams = Streams(seed, replica)
    return [
        generate_ticks(
            clock,
            entity,
            partial(streams.generator, "phase", *entity),
            streams.generator("clock", *entity),
            scenario.horizon,
        )
        for entity in entities
    ]


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
    # After its last tick each clock has a gap that the run does not finish.
    times = np.concatenate([times, np.full(size, np.inf)])
    clock_of_tick = np.concatenate([clock_of_tick, np.arange(size)])
    order = np.lexsort((times, clock_of_tick))
    sorted_times, sorted_clocks = times[order], clock_of_tick[order]
    is_first = np.ones(len(sorted_times), dtype=bool)
    is_first[1:] = sorted_clocks[1:] != sorted_clocks[:-1]
    # The number of each tick among those of its clock.
    ticks_of_clock = np.bincount(sorted_clocks, minlength=size)
    first_row = np.concatenate([[0], np.cumsum(ticks_of_clock)])
    number = np.arange(len(sorted_times)) - first_row[sorted_clocks]
    # Under the null hypothesis the gaps, transformed by their stated law, are uniform in [0, 1).
    ranks = Ranks(np.full(len(sorted_times), np.nan), np.zeros(len(sorted_times)))
    largest_error = 0.0
    for clock in dict.fromkeys(group.stated):  # clocks of one law share one object
        rows = np.array([stated is clock for stated in group.stated])[sorted_clocks]
        ticks = TickSample(
            sorted_times[rows],
            number[rows],
            ticks_of_clock[sorted_clocks[rows]] - 1,
            is_first[rows],
        )
        law = stated_gaps(clock, [group.entities[k] for k in sorted_clocks[rows].tolist()])
        ranks.rank[rows], ranks.known[rows] = _rank_gaps(clock, law, ticks, horizon)
        largest_error = max(largest_error, distance_from_lattice(clock, ticks.finished()))
    products = correlate_neighbours(fill_in_normal(ranks), is_first)
    return TickCounts(windows, count_ranks(ranks), products, np.array(largest_error))


class TickSample(NamedTuple):
    """K ticks of one run, clock by clock and in order of time.

    times  : (K,) seconds; inf for the tick after the last of a clock, which the run does not reach
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

    def finished(self) -> TickSample:
        """Return the ticks that the run reaches."""
        return TickSample(*(column[np.isfinite(self.times)] for column in self))


def _rank_gaps(clock: Any, law: WaitingLaw | None, ticks: TickSample, horizon: float) -> Ranks:
    """Return the gap before each of K ticks as a number that is uniform in [0, 1) and independent
    of those before it under the stated law; nan where no law is known or the run does not show it.

    Lateness in the jitter of a periodic clock and its random phase are such numbers too.
    """
    if law is not None:
        return censored_ranks(law, ticks.before, ticks.times - ticks.before, horizon)
    uniform = lattice_ranks(clock, ticks, horizon)
    return Ranks(uniform, np.full(len(uniform), CELLS))


def lattice_ranks(clock: Any, ticks: TickSample, horizon: float) -> np.ndarray:
    """Return K independent uniform numbers (K,) that a periodic clock shows in its K ticks, nan for
    ticks that show none and for other clocks.

    With a given phase they are the shares of the jitter. With a random phase, the first tick shows
    the phase plus jitter, and pairs of neighbouring ticks after it show differences of jitter, in
    which the phase cancels.
    """
    uniform = np.full(len(ticks.times), np.nan)
    if type(clock) is not Periodic:
        return uniform
    period, jitter = clock.period, clock.jitter
    # The last tick is left out: jitter could have moved it beyond the end of the run.
    inner = (ticks.number < ticks.total - 1) & (jitter > 0.0)
    if not isinstance(clock.phase, str):
        late = ticks.times[inner] - _lattice_times(clock, ticks.number[inner])
        uniform[inner] = np.clip(late / jitter, 0.0, 1.0) if jitter > 0.0 else np.nan
        return uniform
    if period + jitter <= horizon:  # the first tick is never beyond the end
        uniform[ticks.first] = _sum_of_uniforms(ticks.times[ticks.first], period, jitter)
    # Ticks 1 and 2, 3 and 4, ...
    second = np.flatnonzero(inner & (ticks.number > 0) & (ticks.number % 2 == 0))
    if len(second):
        gaps = ticks.times[second] - ticks.times[second - 1] - period
        share = np.clip(gaps / jitter, -1.0, 1.0)
        uniform[second] = 0.5 + share - 0.5 * share * np.abs(share)
    return uniform


def _sum_of_uniforms(times: np.ndarray, period: float, jitter: float) -> np.ndarray:
    """Return P(phase + delay <= ``times``) (K,) of a phase uniform up to ``period`` and a delay
    uniform up to ``jitter``, which may be 0.
    """
    if jitter == 0.0:
        return np.clip(times / period, 0.0, 1.0)
    squares = [np.maximum(times - end, 0.0) ** 2 for end in (0.0, period, jitter, period + jitter)]
    area = squares[0] - squares[1] - squares[2] + squares[3]
    return np.asarray(np.clip(area / (2.0 * period * jitter), 0.0, 1.0))


def stated_gaps(clock: Any, entities: Sequence[Entity]) -> WaitingLaw | None:
    """Return the law of K gaps of a clock, each of the entity (node, link) in ``entities``; None
    where gaps are constant or their law is unknown.
    """
    if clock.memoryless:
        rates = {entity: clock.mean_rate(entity) for entity in set(entities)}
        return exponential_law(np.array([rates[entity] for entity in entities]))
    # By exact type: a class with statements of its own has a law of its own.
    if type(clock) is not Renewal:
        return None
    shape, mean = clock.shape or 1.0, 1.0 / clock.mean_rate(())
    if clock.distribution == "gamma":
        return WaitingLaw(
            lambda t: np.asarray(scipy.special.gammainc(shape, shape * t / mean), dtype=float),
            lambda p: np.asarray(scipy.special.gammaincinv(shape, p) * mean / shape, dtype=float),
        )
    if clock.distribution == "weibull":
        scale = mean / math.gamma(1.0 + 1.0 / shape)
        return WaitingLaw(
            lambda t: -np.expm1(-np.asarray((t / scale) ** shape, dtype=np.float64)),
            lambda p: np.asarray(scale * (-np.log1p(-p)) ** (1.0 / shape), dtype=np.float64),
        )
    if clock.distribution == "uniform" and clock.high != clock.low:
        low, width = float(clock.low or 0.0), float(clock.high or 0.0) - float(clock.low or 0.0)
        return uniform_law(low, width)
    return None


def gap_law(clock: Any, gaps: np.ndarray) -> np.ndarray:
    """Return P(gap <= ``gaps``) (K,) of a renewal clock, ``gaps`` in seconds; nan where gaps are
    constant or their law is unknown.
    """
    law = stated_gaps(clock, ()) if type(clock) is Renewal else None
    return np.full(len(gaps), np.nan) if law is None else np.asarray(law.cdf(gaps))


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
