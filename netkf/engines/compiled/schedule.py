"""Schedules made beforehand: ticks of all clocks and outcomes of their messages, window by window.

Nothing here depends on an estimate. Every clock draws its ticks, and every directed link its
outcomes, in blocks from its own streams, as one message after the other would; a window takes what
lies in a stretch of time and merges the clocks. What they have in common is done for all of them at
once, since there may be hundreds of thousands with a few ticks each.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from netkf.core.clock import ClockPosition, next_ticks
from netkf.engines.compiled.senders import Senders, senders_of
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import (
    Channel,
    ChannelSampler,
    checked_delay,
    delay_depends_on_message,
    delivery_probabilities,
    identical_per_link,
    stream_purposes,
)
from netkf.network.clocks import LinkClock, Poisson
from netkf.network.graphs import Link
from netkf.rng.draws import StreamBatch
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario

# Ticks drawn at once for an entity, doubling: slow clocks draw few in vain.
FIRST_BLOCK, MAX_BLOCK_SLOTS = 8, 1024
TICKS_A_LINK = 256  # in a window, so that what a clock costs is spread over them
MAX_WINDOW_TICKS, MIN_WINDOW_TICKS = 1 << 20, 1 << 12
LOST = -1.0  # no delay is negative


class Window(NamedTuple):
    """All ticks before ``end``, in the order of (time, entity).

    end : seconds
    t, entity : (K,), time and index of the entity among the senders'
    at, delay : the outcomes of tick k begin at ``delay[at[k]]``, in the order of its directed
                links: seconds or LOST
    heard : (K,), where no message takes time instead of ``delay``: a bit for each message that
            arrives
    """

    end: float
    t: FloatArray
    entity: np.ndarray
    at: np.ndarray
    delay: FloatArray
    heard: np.ndarray | None = None


class Ticks(NamedTuple):
    """Some ticks, those of each entity together and in order of time: ``t, entity`` (K,), and the
    outcomes ``delay`` of all that they send, tick after tick.
    """

    t: FloatArray
    entity: np.ndarray
    delay: FloatArray

    def chosen(self, which: np.ndarray, sizes: np.ndarray) -> Ticks:
        """Return the ticks of some indices, where a tick of entity e has ``sizes[e]`` outcomes."""
        # Outcomes lie tick after tick: the indices of those that are chosen, in their new order.
        sent = sizes[self.entity]
        first, count = (np.cumsum(sent) - sent)[which], sent[which]
        begin = np.cumsum(count) - count
        indices = np.repeat(first - begin, count) + np.arange(int(count.sum()))
        return Ticks(self.t[which], self.entity[which], self.delay[indices])

    def window(self, end: float, sizes: np.ndarray) -> Window:
        """Return ticks that are in order of time as a window up to ``end``."""
        sent = sizes[self.entity]
        return Window(end, self.t, self.entity, np.cumsum(sent) - sent, self.delay)


class TickSource:
    """The ticks of E entities in all runs, run by run and block by block: ``last`` (E,) are the
    last ones known, infinite after the horizon, and ``drawn`` (E,) how many were drawn.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
    ) -> None:
        clock, runs, entities = (
            scenario.network.activation,
            streams.runs,
            senders.entities,
        )
        assert isinstance(clock, LinkClock) or not entities
        self._clock, self._entities, self._horizon = clock, entities * runs, scenario.horizon
        count = len(self._entities)
        self.last, self.drawn = np.zeros(count), np.zeros(count, dtype=np.int64)
        # Poisson clocks are drawn for all entities at once; others one by one in Python.
        self._all_poisson = type(clock) is Poisson
        self._rates = self._origins = np.empty(0)
        if isinstance(clock, LinkClock) and self._all_poisson:
            self._draws = StreamBatch(streams, "clock", entities)
            # Entities of several runs follow one another, run by run.
            self._rates = np.tile([clock.mean_rate(entity) for entity in entities], runs)
        elif isinstance(clock, LinkClock):
            self._random = streams.generators("clock", entities)
            self._origins = np.array(
                [
                    clock.origin(entity, partial(one.generator, "phase", *entity))
                    for one in streams.per_replica
                    for entity in entities
                ]
            )

    def more(self, indices: np.ndarray, counts: np.ndarray) -> tuple[FloatArray, np.ndarray]:
        """Return the next ``counts`` ticks of some entities before the horizon, entity by entity,
        and how many each has.

        The horizon is half open; later ticks, which may be many, are dropped.
        """
        if self._all_poisson:
            times, asked = self._exponential(indices, counts), counts
        else:
            drawn = [self._ticks(k, count) for k, count in zip(indices, counts, strict=True)]
            asked = np.array([len(t) for t in drawn])
            # Rows of different lengths are padded with infinity.
            times = np.full((len(indices), max(asked.max(), 1)), np.inf)
            for row, t in zip(times, drawn, strict=True):
                row[: len(t)] = t
        # The horizon is half open.
        kept = times < self._horizon
        got = kept.sum(axis=1)
        self.drawn[indices] += asked
        # Fewer than asked for lie before the horizon: this entity has ended.
        ended = (asked == 0) | (got < asked)
        self.last[indices] = np.where(ended, np.inf, times[np.arange(len(indices)), asked - 1])
        return times[kept], got

    def _exponential(self, indices: np.ndarray, counts: np.ndarray) -> FloatArray:
        """Return the times (E, count) of the next ticks of Poisson clocks, infinite beyond the
        counts; see ``Poisson.ticks``.
        """
        times = np.full((len(indices), counts.max() + 1), np.inf)
        times[:, 0] = self.last[indices]
        # Exponential gaps over the rate, one batch for all streams.
        gaps = self._draws.exponentials(indices, counts) / np.repeat(self._rates[indices], counts)
        times[:, 1:][np.arange(times.shape[1] - 1) < counts[:, None]] = gaps
        # Accumulated from the last tick, in the same order of additions as tick by tick.
        return np.asarray(np.add.accumulate(times, axis=1)[:, 1:])

    def _ticks(self, k: int, count: int) -> FloatArray:
        """Return the next ``count`` ticks of entity ``k``, fewer if its clock ends."""
        assert isinstance(self._clock, LinkClock)
        origin, index, now = float(self._origins[k]), int(self.drawn[k]), float(self.last[k])
        entity, random = self._entities[k], self._random[k]
        position = ClockPosition(origin, index, now)
        return next_ticks(self._clock, entity, position, random, int(count))


def has_table_law(channel: Channel) -> bool:
    """Return True if each directed link has one probability and all messages one delay."""
    delay = channel.delay
    fixed = delay.fixed is not None and not delay.is_random and not delay_depends_on_message(delay)
    return fixed and identical_per_link(channel.loss)


def delay_is_zero(channel: Channel) -> bool:
    """Return True if no message takes time."""
    delay = channel.delay
    return delay.fixed == 0.0 and not delay.is_random and not delay_depends_on_message(delay)


def delivery_chances(scenario: Scenario, directions: tuple[Link, ...]) -> FloatArray:
    """Return the delivery probability (W,) of the messages of each directed link."""
    loss = scenario.network.channel.loss
    return np.array(
        [
            loss.delivery_probability(direction, 0, False, scenario.table_probability(direction))
            for direction in directions
        ]
    )


class Outcomes:
    """Outcomes of all messages, run by run, activation after activation of each entity."""

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
    ) -> None:
        self._channel = channel = scenario.network.channel
        runs = streams.runs
        self._senders, self._directions = senders, len(senders.directions)
        self._first, self._hearing = senders.first, senders.hearing
        self._count, self._sources = len(senders.entities), len(senders.sources)
        self._measured = np.array(
            [scenario.table_probability(direction) for direction in senders.directions]
        )
        self._identical, self._has_table_law = (
            identical_per_link(channel.loss),
            has_table_law(channel),
        )
        # Probabilities that depend on the link only are tabulated.
        if self._identical:
            self._probabilities = delivery_chances(scenario, senders.directions)
        # Channels with memory or random delays keep a sampler for each stream.
        if not self._has_table_law:
            self._samplers = [
                ChannelSampler(channel, partial(_stream, made, source))
                for made in (
                    one.with_seeds(stream_purposes(channel), senders.sources)
                    for one in streams.per_replica
                )
                for source in senders.sources
            ]
        elif not channel.loss.deterministic:
            # A batch of streams draws for all links at once.
            self._uniforms = StreamBatch(streams, "loss", senders.sources)
        self.sizes = np.tile(np.diff(senders.first), runs)

    def of(self, indices: np.ndarray, counts: np.ndarray, first: np.ndarray) -> FloatArray:
        """Return the outcomes of the next ``counts`` activations of each entity, whose first one
        has number ``first``, tick after tick.
        """
        runs, entity = np.divmod(indices, max(self._count, 1))
        sizes = self.sizes[indices]
        out = np.empty(int((counts * sizes).sum()))
        begin = np.cumsum(counts * sizes) - counts * sizes
        drawn: tuple[np.ndarray, ...] = ()
        # The k-th directed link of all entities that have one, so that each pass is vectorised.
        for k in range(int(sizes.max(initial=0))):
            some = sizes > k
            directions = self._hearing[self._first[entity[some]] + k]
            count = counts[some]
            # With a symmetric channel the second direction of a link takes the draws of the first.
            if not drawn or not self._senders.shared:
                sources = runs[some] * self._sources + self._senders.source[directions]
                drawn = self._draw(sources, count)
            # Place of each outcome: tick after tick, and inside a tick in the order of its links.
            step = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
            to = np.repeat(begin[some] + k, count) + step * np.repeat(sizes[some], count)
            out[to] = self._delays(directions, count, first[some], *drawn)
        return out

    def _draw(self, sources: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return for K messages uniform draws, whether the channel is in its bad state, and delays
        as drawn.
        """
        total = int(counts.sum())
        if not self._has_table_law:
            parts = [
                self._samplers[k].draws(n) for k, n in zip(sources, counts.tolist(), strict=True)
            ]
            columns = zip(*parts, strict=True)
            return tuple(np.concatenate([np.empty(0), *column]) for column in columns)
        # A broadcast view: one delay for all.
        delay = np.broadcast_to(np.float64(self._channel.delay.fixed or 0.0), (total,))
        certain = self._channel.loss.deterministic
        # 0 is below every positive probability: nothing is lost where nothing is random.
        uniform = np.zeros(total) if certain else self._uniforms.units(sources, counts)
        return uniform, np.zeros(total, dtype=bool), delay

    def _delays(
        self,
        directions: np.ndarray,
        counts: np.ndarray,
        first: np.ndarray,
        uniform: np.ndarray,
        bad: np.ndarray,
        delay: np.ndarray,
    ) -> FloatArray:
        """Return the delays (K,) of messages in seconds, LOST for lost ones."""
        if self._identical:
            probability = np.repeat(self._probabilities[directions], counts)
        else:
            probability = self._delivery_probability(directions, counts, first, bad)
        lost = uniform >= probability
        if delay_depends_on_message(self._channel.delay):
            delay = self._by_message(directions, counts, first, lost, delay)
        return np.where(lost, LOST, delay)

    def _delivery_probability(
        self, directions: np.ndarray, counts: np.ndarray, first: np.ndarray, bad: np.ndarray
    ) -> FloatArray:
        """Return the delivery probability of each message, by direction; ``bad`` (K,) is the state
        of the channel for each.
        """
        loss, out, done = self._channel.loss, np.empty(len(bad)), 0
        # Probabilities that may depend on the state of the link and on the number of the message.
        for w, count, number in zip(directions, counts.tolist(), first.tolist(), strict=True):
            part = slice(done, done + count)
            direction, measured = self._senders.directions[w], float(self._measured[w])
            out[part] = delivery_probabilities(
                loss, direction, number, bad[part].astype(bool), measured
            )
            done += count
        return out

    def _by_message(
        self,
        directions: np.ndarray,
        counts: np.ndarray,
        first: np.ndarray,
        lost: np.ndarray,
        delay: np.ndarray,
    ) -> FloatArray:
        """Return the delays of all messages that are not ``lost``, by a law that depends on the
        message.
        """
        model, out, k = self._channel.delay, np.array(delay), 0
        for w, count, number in zip(directions, counts.tolist(), first.tolist(), strict=True):
            # A delay is asked only for messages that arrive.
            for message in range(number, number + count):
                if not lost[k]:
                    direction = self._senders.directions[w]
                    out[k] = checked_delay(model, direction, message, float(delay[k]))
                k += 1
        return out


class EntityDraws:
    """Ticks and outcomes of all entities, drawn as they are asked for; nothing where the filter
    does not talk. Entities of several runs follow one another, run by run.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams | ReplicaStreams, senders: Senders
    ) -> None:
        self.count = len(senders.entities) * streams.runs
        self._clocks = TickSource(scenario, streams, senders)
        self._outcomes = Outcomes(scenario, streams, senders)
        self.sizes = self._outcomes.sizes
        # Longer blocks cost less for each tick, but must not make too many at once.
        self._longest = min(
            MAX_BLOCK_SLOTS, max(FIRST_BLOCK, 4 * MAX_WINDOW_TICKS // max(self.count, 1))
        )
        self._block = np.full(self.count, FIRST_BLOCK)

    @property
    def last(self) -> FloatArray:
        """(E,) the last tick known of each entity; infinite where all are."""
        return self._clocks.last

    @property
    def rate(self) -> float:
        """Ticks a second of all together, as far as they are known."""
        # Measured: ticks so far over the time of the last.
        return float((self._clocks.drawn / self.last).sum())

    def more(self, indices: np.ndarray) -> Ticks:
        """Return the next block of ticks of each of these entities, given in increasing order."""
        first = self._clocks.drawn[indices]
        t, counts = self._clocks.more(indices, self._block[indices])
        # Blocks double: an entity with few ticks draws few.
        self._block[indices] = np.minimum(2 * self._block[indices], self._longest)
        return Ticks(t, np.repeat(indices, counts), self._outcomes.of(indices, counts, first))


def _concatenate(parts: list[Ticks]) -> Ticks:
    """Return several lists of ticks one after the other."""
    return Ticks(*(np.concatenate(column) for column in zip(*parts, strict=True)))


class Schedule:
    """The windows of one run, one after the other."""

    def __init__(
        self, scenario: Scenario, streams: Streams, senders: Senders | None = None
    ) -> None:
        senders = senders_of(scenario) if senders is None else senders
        self._draws = draws = EntityDraws(scenario, streams, senders)
        # About so many ticks in a window.
        wanted = min(max(TICKS_A_LINK * draws.count, MIN_WINDOW_TICKS), MAX_WINDOW_TICKS)
        self._horizon, self._end = scenario.horizon, 0.0
        self._known = draws.more(np.arange(draws.count)) if draws.count else NO_TICKS
        # The rate of the first blocks decides the length of all windows.
        self._length = wanted / draws.rate if draws.rate > 0.0 else math.inf

    def following(self) -> Window:
        """Return the next window; the last one ends at infinity."""
        end, draws = self._end + self._length, self._draws
        # The last window has no end, so that the loop asks for no other.
        if not self._end < end < self._horizon:
            end = math.inf
        self._end = end
        parts = [self._known]
        # An entity's ticks are complete up to ``end`` once its last known tick is beyond it.
        while len(late := np.flatnonzero(draws.last < end)):
            parts.append(draws.more(late))
        known = _concatenate(parts)
        now = known.t < end
        # Ticks beyond the end wait for the next window.
        self._known = known.chosen(np.flatnonzero(~now), draws.sizes)
        order = np.flatnonzero(now)
        # Sorting by time alone is faster; ties are rare, and only then entities matter.
        order = order[np.argsort(known.t[order])]
        if (np.diff(known.t[order]) == 0.0).any():
            order = order[np.lexsort((known.entity[order], known.t[order]))]
        return known.chosen(order, draws.sizes).window(end, draws.sizes)


class ReadingsSchedule:
    """The windows of one run in which nodes transmit after their samples, at the times ``t`` (K,)
    and indices ``index`` (K,), in order.
    """

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        senders: Senders,
        t: FloatArray,
        index: np.ndarray,
    ) -> None:
        self._outcomes = Outcomes(scenario, streams, senders)
        self._t, self._index, self._begin = t, index, 0
        self._sent = np.zeros(len(senders.entities), dtype=np.int64)

    def following(self) -> Window:
        """Return the next window; the last one ends at infinity."""
        begin, sizes = self._begin, self._outcomes.sizes
        # As many instants as have about MAX_WINDOW_TICKS messages; a node without receivers counts
        # as one.
        sent = np.cumsum(np.maximum(sizes[self._index[begin:]], 1))
        stop = begin + int(np.searchsorted(sent, MAX_WINDOW_TICKS))
        while 0 < stop < len(self._t) and self._t[stop] == self._t[stop - 1]:
            stop += 1  # an instant is in one window
        self._begin = stop
        t, index = self._t[begin:stop], self._index[begin:stop]
        # Outcomes are drawn entity by entity, and put back into the order of time.
        indices, counts = np.unique(index, return_counts=True)
        delay = self._outcomes.of(indices, counts, self._sent[indices])
        self._sent[indices] += counts
        by_entity = np.argsort(index, kind="stable")
        ticks = Ticks(t[by_entity], index[by_entity], delay)
        back = np.empty(len(index), dtype=np.int64)
        back[by_entity] = np.arange(len(index))
        end = float(self._t[stop]) if stop < len(self._t) else math.inf
        return ticks.chosen(back, sizes).window(end, sizes)


def whole_schedules(scenario: Scenario, streams: ReplicaStreams) -> list[Window]:
    """Return all ticks of each of several runs, one window a run."""
    senders, runs = senders_of(scenario), streams.runs
    draws = EntityDraws(scenario, streams, senders)
    if not draws.count:
        return [NO_TICKS.window(math.inf, draws.sizes)] * runs
    parts = [NO_TICKS]
    # All ticks up to the horizon: an entity whose last tick is infinite has ended.
    while len(late := np.flatnonzero(draws.last < math.inf)):
        parts.append(draws.more(late))
    known, count = _concatenate(parts), draws.count // runs
    run, entity = np.divmod(known.entity, count)
    # By run, then by (time, entity), as within one run.
    order = np.lexsort((entity, known.t, run))
    known = known.chosen(order, draws.sizes)
    cuts = np.concatenate([[0], np.cumsum(np.bincount(run, minlength=runs))])
    windows = []
    for k in range(runs):
        mine = known.chosen(np.arange(cuts[k], cuts[k + 1]), draws.sizes)
        # Entities are numbered within the run again.
        mine = mine._replace(entity=mine.entity - k * count)
        windows.append(mine.window(math.inf, draws.sizes))
    return windows


NO_TICKS = Ticks(np.empty(0), np.empty(0, dtype=np.int64), np.empty(0))


def _stream(streams: Streams, ends: Link, purpose: str) -> np.random.Generator:
    """Return the random generator of a purpose for one directed link."""
    return streams.generator(purpose, *ends)
