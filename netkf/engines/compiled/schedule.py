"""Schedules computed before a run: ticks of all clocks and outcomes of their messages, by windows.

Nothing here depends on an estimate. Every clock draws its ticks, and every directed link its
outcomes, in blocks from streams of its own; the numbers are those that the SimPy engine draws
message by message. A window merges the ticks of all clocks in an interval of time. Operations are
vectorised over entities, since there may be hundreds of thousands with a few ticks each.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from netkf.core.clock import ClockPosition, next_ticks
from netkf.engines.compiled.outcomes import outcomes_of
from netkf.engines.compiled.senders import Senders, senders_of
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario

# Ticks drawn at once for an entity, doubling each time: slow clocks draw few that are not used.
FIRST_BLOCK, MAX_BLOCK_SLOTS = 8, 1024
TICKS_PER_ENTITY = 256  # ticks of an entity in a window, which share its fixed cost
MAX_WINDOW_TICKS, MIN_WINDOW_TICKS = 1 << 20, 1 << 12  # limits for all entities together


class Window(NamedTuple):
    """All ticks before ``end``, in the order of (time, entity).

    end : seconds
    t, entity : (K,), time (seconds) of each tick and index of its entity in Senders
    first_outcome, delay : the outcomes of tick k begin at ``delay[first_outcome[k]]``, in the order
                           of its directed links: delay in seconds, or LOST
    arrival_bits : (K,), in place of ``delay`` if no message takes time: a bit for each message of
                   the tick that arrives
    """

    end: float
    t: FloatArray
    entity: np.ndarray
    first_outcome: np.ndarray
    delay: FloatArray
    arrival_bits: np.ndarray | None = None


class Ticks(NamedTuple):
    """K ticks: times ``t`` (K,) in seconds, index of the ``entity`` (K,) whose clock ticks, and the
    outcomes ``delay`` (D,) of all their messages, tick after tick: seconds, or LOST.
    """

    t: FloatArray
    entity: np.ndarray
    delay: FloatArray

    def select(self, indices: np.ndarray, sizes: np.ndarray) -> Ticks:
        """Return the M ticks with these ``indices`` (M,) in this order, each with its outcomes
        (delays in seconds, or LOST). A tick of entity e of E (a link, direction or node with a
        clock) has ``sizes[e]`` outcomes (E,), one for each message.
        """
        # Indices of the outcomes of these ticks, tick after tick in their new order.
        sent = sizes[self.entity]
        first, count = (np.cumsum(sent) - sent)[indices], sent[indices]
        begin = np.cumsum(count) - count
        outcomes = np.repeat(first - begin, count) + np.arange(int(count.sum()))
        return Ticks(self.t[indices], self.entity[indices], self.delay[outcomes])

    def window(self, end: float, sizes: np.ndarray) -> Window:
        """Return these ticks, which must be in the order of time, as a window up to ``end``
        (seconds), in which the event loop takes them; a tick of entity e of E has ``sizes[e]``
        outcomes (E,), one for each message.
        """
        sent = sizes[self.entity]
        return Window(end, self.t, self.entity, np.cumsum(sent) - sent, self.delay)


class TickSource:
    """Draws the ticks of E entities, those of all runs one run after the other, block by block.

    ``last`` (E,) are the times in seconds of the last ticks so far, infinite once the horizon is
    passed, and ``drawn`` (E,) the numbers of ticks so far.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
    ) -> None:
        """Make the generators of all E entities (links, directions or nodes with a clock), and the
        origins from which their ticks are counted.
        """
        clock, runs, entities = (
            scenario.network.activation,
            streams.runs,
            senders.entities,
        )
        assert isinstance(clock, LinkClock) or not entities
        self._clock, self._entities, self._horizon = clock, entities * runs, scenario.horizon
        self._snap = scenario.time_grid.snap
        count = len(self._entities)
        self.last, self.drawn = np.zeros(count), np.zeros(count, dtype=np.int64)
        if isinstance(clock, LinkClock):
            self._random = [
                one.generator("clock", *entity)
                for one in streams.per_replica
                for entity in entities
            ]
            self._origins = np.array(
                [
                    clock.origin(entity, partial(one.generator, "phase", *entity))
                    for one in streams.per_replica
                    for entity in entities
                ]
            )

    def more(self, indices: np.ndarray, counts: np.ndarray) -> tuple[FloatArray, np.ndarray]:
        """Draw the next ``counts`` (M,) ticks of M entities (links, directions or nodes with a
        clock) with the ``indices`` (M,); return the times (K,) in seconds of those before the
        horizon, entity by entity, and how many each entity has, (M,). Advances ``last`` and
        ``drawn``.
        """
        blocks = [self._ticks(k, count) for k, count in zip(indices, counts, strict=True)]
        sizes = np.array([len(t) for t in blocks])
        # Rows of different lengths are padded with infinity.
        times = np.full((len(indices), max(sizes.max(), 1)), np.inf)
        for row, t in zip(times, blocks, strict=True):
            row[: len(t)] = t
        # Clocks go on from their own times, and the ticks are the instants nearest to them. The
        # horizon is half open.
        instants = self._snap(times)
        before_horizon = instants < self._horizon
        numbers = before_horizon.sum(axis=1)
        self.drawn[indices] += sizes
        # An entity has ended if some of its ticks lie beyond the horizon.
        ended = (sizes == 0) | (numbers < sizes)
        self.last[indices] = np.where(ended, np.inf, times[np.arange(len(indices)), sizes - 1])
        return instants[before_horizon], numbers

    def _ticks(self, k: int, count: int) -> FloatArray:
        """Return the times of the next ``count`` ticks of entity ``k``, from a user's clock."""
        assert isinstance(self._clock, LinkClock)
        origin, index, now = float(self._origins[k]), int(self.drawn[k]), float(self.last[k])
        entity, random = self._entities[k], self._random[k]
        position = ClockPosition(origin, index, now)
        return next_ticks(self._clock, entity, position, random, int(count))


class EntityDraws:
    """Draws ticks and outcomes of E entities on demand. Entities are those of all runs, run by run;
    none if the filter sends no messages.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
    ) -> None:
        """Make the random streams of ticks and outcomes of all entities (links, directions or nodes
        with a clock); the length of the blocks that are drawn depends on their number.
        """
        self.count = len(senders.entities) * streams.runs
        self._clocks = TickSource(scenario, streams, senders)
        self._outcomes = outcomes_of(scenario, streams, senders)
        self.sizes = self._outcomes.sizes
        # Longer blocks cost less for each tick; the limit is the memory for all entities together.
        self._max_block = min(
            MAX_BLOCK_SLOTS, max(FIRST_BLOCK, 4 * MAX_WINDOW_TICKS // max(self.count, 1))
        )
        self._block = np.full(self.count, FIRST_BLOCK)

    @property
    def last(self) -> FloatArray:
        """(E,) time of the last tick drawn of each entity; infinite after the horizon."""
        return self._clocks.last

    @property
    def rate(self) -> float:
        """Ticks per second of all entities, estimated from the ticks so far."""
        return float((self._clocks.drawn / self.last).sum())

    def more(self, indices: np.ndarray) -> Ticks:
        """Draw and return the next block of ticks of M entities with the ``indices`` (M,), in
        ascending order, with the outcomes of their messages (delays in seconds, or LOST): entity by
        entity.
        """
        first = self._clocks.drawn[indices]
        t, counts = self._clocks.more(indices, self._block[indices])
        # Blocks double: an entity with few ticks draws few.
        self._block[indices] = np.minimum(2 * self._block[indices], self._max_block)
        return Ticks(t, np.repeat(indices, counts), self._outcomes.of(indices, counts, first))


def _concatenate(parts: list[Ticks]) -> Ticks:
    """Return the ticks of all ``parts``, one part after the other."""
    return Ticks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


class Schedule:
    """The windows of one run, for clocks and channels of any kind."""

    def __init__(
        self, scenario: Scenario, streams: Streams, senders: Senders | None = None
    ) -> None:
        """Draw the first ticks of each entity (a link, direction or node with a clock), whose rate
        decides the length of all windows; ``senders`` defaults to those of the scenario.
        """
        senders = senders_of(scenario) if senders is None else senders
        self._draws = draws = EntityDraws(scenario, streams, senders)
        window_ticks = min(max(TICKS_PER_ENTITY * draws.count, MIN_WINDOW_TICKS), MAX_WINDOW_TICKS)
        self._horizon, self._end, self._grid = scenario.horizon, 0.0, scenario.time_grid
        self._waiting = draws.more(np.arange(draws.count)) if draws.count else NO_TICKS
        # The rate of the first blocks decides the length of all windows.
        self._length = window_ticks / draws.rate if draws.rate > 0.0 else math.inf

    def following(self) -> Window:
        """Return the next window, all ticks of the run in the next interval of time in the order of
        (time, entity); the last one ends at infinity.
        """
        end, draws = self._grid.instant(self._end + self._length), self._draws
        # The last window has no end, so that the loop asks for no other.
        if not self._end < end < self._horizon:
            end = math.inf
        self._end = end
        parts = [self._waiting]
        # Draw until the last tick of each entity is beyond ``end``.
        while len(late := np.flatnonzero(draws.last < end)):
            parts.append(draws.more(late))
        ticks = _concatenate(parts)
        in_window = ticks.t < end
        # Ticks beyond the end belong to later windows.
        self._waiting = ticks.select(np.flatnonzero(~in_window), draws.sizes)
        order = np.flatnonzero(in_window)
        # Sort by time alone, which is faster; only if there are ties, by (time, entity).
        order = order[np.argsort(ticks.t[order])]
        if (np.diff(ticks.t[order]) == 0.0).any():
            order = order[np.lexsort((ticks.entity[order], ticks.t[order]))]
        return ticks.select(order, draws.sizes).window(end, draws.sizes)


class ReadingsSchedule:
    """The windows of one run in which nodes transmit after their samples: at times ``t`` (K,) in
    seconds, in order, the node with the index ``index`` (K,).
    """

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        senders: Senders,
        t: FloatArray,
        index: np.ndarray,
    ) -> None:
        """Take the times ``t`` (K,) in seconds of all transmissions, which nodes make after their
        samples, and the index ``index`` (K,) of each sending node, and make the streams of their
        outcomes (delays or losses).
        """
        self._outcomes = outcomes_of(scenario, streams, senders)
        self._t, self._index, self._begin = t, index, 0
        self._sent = np.zeros(len(senders.entities), dtype=np.int64)

    def following(self) -> Window:
        """Return the next window of transmissions, each a tick of the sending node; the last one
        ends at infinity.
        """
        begin, sizes = self._begin, self._outcomes.sizes
        # As many instants as send about MAX_WINDOW_TICKS messages; a node without receivers counts
        # as one message.
        sent = np.cumsum(np.maximum(sizes[self._index[begin:]], 1))
        stop = begin + int(np.searchsorted(sent, MAX_WINDOW_TICKS))
        while 0 < stop < len(self._t) and self._t[stop] == self._t[stop - 1]:
            # All transmissions of an instant are in one window.
            stop += 1
        self._begin = stop
        t, index = self._t[begin:stop], self._index[begin:stop]
        # Draw outcomes entity by entity, then restore the order of time.
        indices, counts = np.unique(index, return_counts=True)
        delay = self._outcomes.of(indices, counts, self._sent[indices])
        self._sent[indices] += counts
        by_entity = np.argsort(index, kind="stable")
        ticks = Ticks(t[by_entity], index[by_entity], delay)
        inverse = np.empty(len(index), dtype=np.int64)
        inverse[by_entity] = np.arange(len(index))
        end = float(self._t[stop]) if stop < len(self._t) else math.inf
        return ticks.select(inverse, sizes).window(end, sizes)


def all_windows(scenario: Scenario, streams: ReplicaStreams) -> list[Window]:
    """Return all ticks of R runs up to the horizon, drawn together, in one window for each run."""
    senders, runs = senders_of(scenario), streams.runs
    draws = EntityDraws(scenario, streams, senders)
    if not draws.count:
        return [NO_TICKS.window(math.inf, draws.sizes)] * runs
    parts = [NO_TICKS]
    # Draw until the horizon: the last tick of each entity is then infinite.
    while len(late := np.flatnonzero(draws.last < math.inf)):
        parts.append(draws.more(late))
    ticks, count = _concatenate(parts), draws.count // runs
    run, entity = np.divmod(ticks.entity, count)
    # By run, then by (time, entity), as within one run.
    order = np.lexsort((entity, ticks.t, run))
    ticks = ticks.select(order, draws.sizes)
    cuts = np.concatenate([[0], np.cumsum(np.bincount(run, minlength=runs))])
    windows = []
    for k in range(runs):
        run_ticks = ticks.select(np.arange(cuts[k], cuts[k + 1]), draws.sizes)
        # Entities are numbered within the run again.
        run_ticks = run_ticks._replace(entity=run_ticks.entity - k * count)
        windows.append(run_ticks.window(math.inf, draws.sizes))
    return windows


NO_TICKS = Ticks(np.empty(0), np.empty(0, dtype=np.int64), np.empty(0))
