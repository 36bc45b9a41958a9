"""Counts of the ticks of clocks in one run: of the network's, and of those at which sensors sample.

What a clock states about its gaps makes each of them a uniform number, whatever the clock and
however short the run, so that ticks of all clocks and runs add up in a few cells.
"""

from __future__ import annotations

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.checks.parts.moments import count_cells
from netkf.checks.parts.sources import stated_part
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
    """Of E clocks: ``ticks`` (W, E) in the windows of one run; how many gaps, as uniform numbers,
    fall into each of the ``cells`` (CELLS, 1); ``products`` (3,): sums of u u' and of u^2 over
    neighbouring gaps, and their number, where u is a gap as a standard normal number; ``off`` (),
    the seconds by which a tick is furthest from where a clock without randomness ticks.
    """

    ticks: np.ndarray
    cells: FloatArray
    products: FloatArray
    off: FloatArray


class ClockGroup(NamedTuple):
    """Clocks of one kind of a scenario: who has one, what each states, and their labels."""

    entities: tuple[Entity, ...]
    stated: tuple[Any, ...]
    labels: tuple[str, ...]


@lru_cache(maxsize=8)
def network_clocks(scenario: Scenario) -> ClockGroup:
    """Return the clocks of the network; none where no clock is drawn."""
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
    """Return the clocks at which sensors sample; none where a sensor has no such clock."""
    entities, stated, labels = [], [], []
    for node, placed_sensors in scenario.sampled_sensors.items():
        for placed_sensor in placed_sensors:
            clock = getattr(scenario.sensors[placed_sensor.entry], "sampling", None)
            if clock is None:
                return ClockGroup((), (), ())
            entities.append((node, placed_sensor.ordinal))
            stated.append(stated_part(clock, "sampling"))
            several = f"sensor {placed_sensor.ordinal} of " if len(placed_sensors) > 1 else ""
            labels.append(f"the clock of {several}node {node}")
    return ClockGroup(tuple(entities), tuple(stated), tuple(labels))


def count_ticks(scenario: Scenario, run: Run) -> TickCounts | None:
    """Return the counts of a run's ticks in the network; None without clocks."""
    group = network_clocks(scenario)
    if not group.entities:
        return None
    clock: Any = scenario.network.activation
    index = {entity: k for k, entity in enumerate(group.entities)}
    rows = run.log[run.log["kind"] == CODES["tick"]]
    columns = ("node",) if clock.at == "nodes" else ("node", "peer")
    ids = zip(*(rows[name].tolist() for name in columns), strict=True)
    ordered = clock.at == "links"
    which = np.array([index[tuple(sorted(e)) if ordered else e] for e in ids], dtype=np.int64)
    return _count_in_windows(group, rows["t"], which, scenario.horizon)


def count_samples(scenario: Scenario, streams: Streams) -> TickCounts | None:
    """Return the counts of the times at which sensors sample in a run; None without clocks."""
    group = sampling_clocks(scenario)
    if not group.entities:
        return None
    times = scenario.sample_times(streams)
    found = [times[entity] for entity in group.entities]
    which = np.repeat(np.arange(len(found)), [len(t) for t in found])
    return _count_in_windows(group, np.concatenate(found), which, scenario.horizon)


def count_drawn_ticks(scenario: Scenario, seed: int, replica: int) -> np.ndarray:
    """Return how often each clock of the network ticks in a replica, (E,), from its stream."""
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
    """Return how often each sensor samples in a replica, (E,), from its stream."""
    times = scenario.sample_times(Streams(seed, replica))
    return np.array([len(times[entity]) for entity in sampling_clocks(scenario).entities])


def count_by_window(
    scenario: Scenario, times: np.ndarray, which: np.ndarray, size: int
) -> np.ndarray:
    """Return how often each of ``size`` indices occurs in each of the windows, (W, size)."""
    return _by_window(times, which, size, scenario.horizon)


def _by_window(times: np.ndarray, which: np.ndarray, size: int, horizon: float) -> np.ndarray:
    """Return the counts of :func:`count_by_window`.

    Windows are equal parts of the run. Counts of different windows are independent as those of
    different runs are, so that correlations between clocks show in fewer runs.
    """
    windows = WINDOWS if size <= MAX_WINDOWED else 1
    index = np.minimum((times * (windows / horizon)).astype(np.int64), windows - 1)
    counts = np.bincount(index * size + which, minlength=windows * size)
    return counts.reshape(windows, size)


def _count_in_windows(
    group: ClockGroup, times: np.ndarray, which: np.ndarray, horizon: float
) -> TickCounts:
    """Return the counts of ticks at ``times`` (K,) of the clocks ``which`` (K,)."""
    size = len(group.entities)
    windows = _by_window(times, which, size, horizon)
    order = np.lexsort((times, which))
    t, e = times[order], which[order]
    first = np.ones(len(t), dtype=bool)
    first[1:] = e[1:] != e[:-1]
    total = np.bincount(e, minlength=size)
    number = np.arange(len(t)) - np.concatenate([[0], np.cumsum(total)])[e]
    uniform, off = np.full(len(t), np.nan), 0.0
    for clock in dict.fromkeys(group.stated):
        mine = np.array([one is clock for one in group.stated])[e]
        ticks = TickSample(t[mine], number[mine], total[e[mine]], first[mine])
        uniform[mine] = _as_uniform(clock, ticks, horizon)
        off = max(off, distance_from_lattice(clock, ticks))
    known = np.isfinite(uniform)
    cells = count_cells(np.where(known, uniform, 0.0)[:, None], known[:, None])
    return TickCounts(windows, cells, correlate_neighbours(uniform, first), np.array(off))


class TickSample(NamedTuple):
    """Times (K,) of ticks, clock by clock, the number of each on its clock from 0, how many its
    clock has in all, and whether it is the first.
    """

    times: np.ndarray
    number: np.ndarray
    total: np.ndarray
    first: np.ndarray

    @property
    def before(self) -> np.ndarray:
        """Time of the tick before, 0 before the first."""
        before = np.concatenate([[0.0], self.times[:-1]])[: len(self.times)]
        return np.where(self.first, 0.0, before)


def _as_uniform(clock: Any, ticks: TickSample, horizon: float) -> np.ndarray:
    """Return a number for each tick that is uniform in [0, 1), and independent of those before it,
    if the clock keeps its law; nan where it has no law that is known here.

    Runs that end hide long gaps. Given how many ticks a Poisson clock has in a run, they lie there
    like independent uniform times: with m of them still to come in the rest of the run, a gap is
    longer than a share v of that rest with probability (1 - v)^m. Of other clocks with independent
    gaps, a gap that was seen is one of those that end before the run does.
    """
    gaps, rest = ticks.times - ticks.before, horizon - ticks.before
    if clock.memoryless:
        return np.asarray(-np.expm1((ticks.total - ticks.number) * np.log1p(-gaps / rest)))
    if type(clock) is Renewal:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(gap_law(clock, gaps) / gap_law(clock, rest))
    if type(clock) is Periodic and clock.jitter > 0.0 and not isinstance(clock.phase, str):
        share = (ticks.times - _lattice_times(clock, ticks.number)) / clock.jitter
        # Those before the end of the run only: the last tick may be beyond it.
        return np.where(ticks.number < ticks.total - 1, np.clip(share, 0.0, 1.0), np.nan)
    if type(clock) is Periodic and isinstance(clock.phase, str) and clock.period <= horizon:
        phases = np.clip(ticks.times / clock.period, 0.0, 1.0)
        return np.where(ticks.first & (clock.jitter == 0.0), phases, np.nan)
    return np.full(len(gaps), np.nan)


def gap_law(clock: Any, gaps: np.ndarray) -> np.ndarray:
    """Return the probability that a gap is at most as long as ``gaps`` (K,); nan where gaps vary by
    nothing, or the law is not known.
    """
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
    """Return the variance of gaps over the square of their mean; nan if their law is not known."""
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
    """Return the times (K,) of ticks number ``number`` (K,) without jitter and random phase."""
    if isinstance(clock, Renewal):
        return np.asarray((number + 1) / clock.mean_rate(()))
    phase = 0.0 if isinstance(clock.phase, str) else clock.phase
    return np.asarray(phase + clock.period * (number + (clock.phase == 0.0)))


def ticks_on_lattice(clock: Any) -> bool:
    """Return True if a clock ticks at times that it states, up to one phase and a jitter."""
    # By exact type: a class with statements of its own has a law of its own.
    constant = type(clock) is Renewal and clock.distribution == "constant"
    return constant or type(clock) is Periodic


def distance_from_lattice(clock: Any, ticks: TickSample) -> float:
    """Return the largest distance in seconds of a tick from where it may be, 0 without a lattice.

    Clocks with a random phase may all be early or late by one time.
    """
    if not ticks_on_lattice(clock) or not len(ticks.times):
        return 0.0
    late = ticks.times - _lattice_times(clock, ticks.number)
    jitter = getattr(clock, "jitter", 0.0)
    if isinstance(getattr(clock, "phase", None), str):
        starts = np.flatnonzero(ticks.first)
        spread = np.maximum.reduceat(late, starts) - np.minimum.reduceat(late, starts)
        beyond = late[starts] - (clock.period + jitter)
        return float(max(spread.max() - jitter, beyond.max(), 0.0))
    return float(max(-late.min(), late.max() - jitter, 0.0))


def correlate_neighbours(uniform: np.ndarray, first: np.ndarray) -> FloatArray:
    """Return the ``products`` (3,) of :class:`TickCounts` of a series ``uniform`` (K,), in which
    the ``first`` ones (K,) have none before them; nan where a number is missing.
    """
    normal = scipy.special.ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12))
    pairs = ~first[1:] & np.isfinite(normal[1:]) & np.isfinite(normal[:-1])
    u, v = normal[1:][pairs], normal[:-1][pairs]
    return np.array([u @ v, 0.5 * (u @ u + v @ v), float(len(u))])
