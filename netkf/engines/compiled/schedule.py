"""Schedules made beforehand: ticks of all links and fates of their messages, window by window.

Nothing here depends on an estimate. Every link draws its ticks and fates in blocks from its own
streams, as one message after the other would; a window takes what lies in a stretch of time and
merges the links. What links have in common is done for all of them at once, since there may be
hundreds of thousands of them with a few ticks each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.clock import next_ticks
from netkf.core.draws import Draws
from netkf.core.streams import Streams, Together
from netkf.network.channels import Fates, alike, chances, needed
from netkf.network.clocks import LinkClock, Poisson
from netkf.network.graphs import Link
from netkf.scenario.scenario import Scenario

FIRST_BLOCK, LONGEST_BLOCK = 8, 1024
TICKS_A_LINK = 256  # in a window, so that what a link costs is spread over them
MOST_TICKS, LEAST_TICKS = 1 << 20, 1 << 12
LOST = -1.0


class Window(NamedTuple):
    """Ticks before ``end`` in the order of (time, link): ``t`` (K,), ``link`` (K,) places in
    ``topology.links``, ``delay`` (K, 2) seconds forth and back, LOST where the message is lost.
    """

    end: float
    t: FloatArray
    link: np.ndarray
    delay: FloatArray


class Ticks(NamedTuple):
    """Some ticks of L links, those of each link together and in order of time: ``t, link`` (K,),
    ``delay`` (K, 2) as in a window.
    """

    t: FloatArray
    link: np.ndarray
    delay: FloatArray


class Clocks:
    """The ticks of all links, run by run and block by block: ``last`` (L,) are the last ones known,
    infinite after the horizon, and ``drawn`` (L,) how many were drawn.
    """

    def __init__(
        self, scenario: Scenario, streams: Streams | Together, links: tuple[Link, ...]
    ) -> None:
        clock, runs = scenario.network.activation, len(streams.each)
        assert isinstance(clock, LinkClock) or not links
        self._clock, self._links, self._horizon = clock, links * runs, scenario.horizon
        count = len(self._links)
        self.last, self.drawn = np.zeros(count), np.zeros(count, dtype=np.int64)
        self._alike = type(clock) is Poisson
        self._rates = self._origins = np.empty(0)
        if isinstance(clock, LinkClock) and self._alike:
            self._draws = Draws(streams, "clock", links)
            self._rates = np.tile([clock.mean_rate(link) for link in links], runs)
        elif isinstance(clock, LinkClock):
            self._random = streams.generators("clock", links)
            self._origins = np.array(
                [
                    clock.origin(link, partial(one.generator, "phase", *link))
                    for one in streams.each
                    for link in links
                ]
            )

    def more(self, links: np.ndarray, counts: np.ndarray) -> tuple[FloatArray, np.ndarray]:
        """So many more ticks of each of these links: the times before the horizon, one link after
        the other, and how many each has. The horizon is half open; later ticks, and there may be
        many, are not kept.
        """
        if self._alike:
            times, asked = self._exponential(links, counts), counts
        else:
            drawn = [self._ticks(k, count) for k, count in zip(links, counts, strict=True)]
            asked = np.array([len(t) for t in drawn])
            times = np.full((len(links), max(asked.max(), 1)), np.inf)
            for row, t in zip(times, drawn, strict=True):
                row[: len(t)] = t
        kept = times < self._horizon
        got = kept.sum(axis=1)
        self.drawn[links] += asked
        ended = (asked == 0) | (got < asked)
        self.last[links] = np.where(ended, np.inf, times[np.arange(len(links)), asked - 1])
        return times[kept], got

    def _exponential(self, links: np.ndarray, counts: np.ndarray) -> FloatArray:
        """As ``Poisson.ticks`` for all links at once; infinite where a link has fewer."""
        times = np.full((len(links), counts.max() + 1), np.inf)
        times[:, 0] = self.last[links]
        gaps = self._draws.exponentials(links, counts) / np.repeat(self._rates[links], counts)
        times[:, 1:][np.arange(times.shape[1] - 1) < counts[:, None]] = gaps
        return np.asarray(np.add.accumulate(times, axis=1)[:, 1:])

    def _ticks(self, k: int, count: int) -> FloatArray:
        assert isinstance(self._clock, LinkClock)
        origin, index, now = float(self._origins[k]), int(self.drawn[k]), float(self.last[k])
        link, random = self._links[k], self._random[k]
        return next_ticks(self._clock, link, origin, index, now, random, int(count))


def way_chances(scenario: Scenario, ways: Sequence[Sequence[Link]]) -> FloatArray:
    """(ways, L): the one chance that all messages of a direction have, where losses are alike."""
    loss = scenario.network.channel.loss
    return np.array(
        [[loss.chance(way, 0, False, scenario.measured(way)) for way in some] for some in ways]
    )


def way_luck(
    scenario: Scenario, streams: Streams | Together, ways: Sequence[Sequence[Link]]
) -> list[Draws]:
    """What decides about them: of both ways together where they share their fate, and nothing where
    nothing is left to decide.
    """
    channel = scenario.network.channel
    drawn = ways[:1] if channel.symmetric else ways
    return [] if channel.loss.certain else [Draws(streams, "loss", some) for some in drawn]


class Fortunes:
    """The fates of all messages, run by run, activation after activation of each link."""

    def __init__(
        self, scenario: Scenario, streams: Streams | Together, links: tuple[Link, ...]
    ) -> None:
        self._channel = channel = scenario.network.channel
        runs, both = len(streams.each), (links, tuple((j, i) for i, j in links))
        self._ways = tuple(ways * runs for ways in both)
        measured = [[scenario.measured(way) for way in ways] for ways in both]
        self._measured = np.tile(measured, runs)
        self._alike = alike(channel.loss)
        self._plain = self._alike and channel.delay.fixed is not None
        if self._alike:
            self._chances = np.tile(way_chances(scenario, both), runs)
        if self._plain:
            self._luck = way_luck(scenario, streams, both)
        else:
            self._fates = [
                [
                    Fates(channel, partial(_stream, made, way))
                    for made in (one.seeded(needed(channel), ways) for one in streams.each)
                    for way in ways
                ]
                for ways in (both[:1] if channel.symmetric else both)
            ]

    def of(self, links: np.ndarray, counts: np.ndarray, first: np.ndarray) -> FloatArray:
        """(K, 2) delays, LOST where lost, of the next ``counts`` messages of each link, which are
        numbers ``first`` and so on.
        """
        which = np.repeat(links, counts)
        drawn = self._plainly(links, counts) if self._plain else self._one_by_one(links, counts)
        out = np.empty((len(which), 2))
        for way in range(2):
            luck, bad, delay = drawn[way % len(drawn)]
            if self._alike:
                chance = self._chances[way][which]
            else:
                chance = self._chance(way, links, counts, first, bad)
            out[:, way] = np.where(luck >= chance, LOST, delay)
        return out

    def _plainly(self, links: np.ndarray, counts: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        total = int(counts.sum())
        delay = np.broadcast_to(np.float64(self._channel.delay.fixed or 0.0), (total,))
        fine, never = np.zeros(total, dtype=bool), np.zeros(total)
        drawn: list[tuple[np.ndarray, ...]]
        drawn = [(draws.units(links, counts), fine, delay) for draws in self._luck]
        return drawn or [(never, fine, delay)]

    def _one_by_one(self, links: np.ndarray, counts: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        drawn = []
        for fates in self._fates:
            parts = [fates[k].draws(n) for k, n in zip(links, counts.tolist(), strict=True)]
            columns = zip(*parts, strict=True)
            drawn.append(tuple(np.concatenate([np.empty(0), *column]) for column in columns))
        return drawn

    def _chance(
        self, way: int, links: np.ndarray, counts: np.ndarray, first: np.ndarray, bad: np.ndarray
    ) -> FloatArray:
        loss, out, done = self._channel.loss, np.empty(len(bad)), 0
        for k, count, number in zip(links, counts.tolist(), first.tolist(), strict=True):
            part = slice(done, done + count)
            measured = float(self._measured[way, k])
            out[part] = chances(loss, self._ways[way][k], number, bad[part].astype(bool), measured)
            done += count
        return out


class LinkDraws:
    """Ticks and fates of all links, drawn as they are asked for; nothing where the filter does not
    talk. Links of several runs follow one another, run by run.
    """

    def __init__(self, scenario: Scenario, streams: Streams | Together) -> None:
        links = scenario.topology.links if scenario.filter.algorithm.talks else ()
        self.count = len(links) * len(streams.each)
        self._clocks = Clocks(scenario, streams, links)
        self._fortunes = Fortunes(scenario, streams, links)
        self._longest = min(LONGEST_BLOCK, max(FIRST_BLOCK, 4 * MOST_TICKS // max(self.count, 1)))
        self._block = np.full(self.count, FIRST_BLOCK)

    @property
    def last(self) -> FloatArray:
        """(L,) the last tick known of each link; infinite where all are."""
        return self._clocks.last

    @property
    def rate(self) -> float:
        """Ticks a second of all links together, as far as they are known."""
        return float((self._clocks.drawn / self.last).sum())

    def more(self, links: np.ndarray) -> Ticks:
        """A block of ticks of each of these links (places, in order)."""
        first = self._clocks.drawn[links]
        t, counts = self._clocks.more(links, self._block[links])
        self._block[links] = np.minimum(2 * self._block[links], self._longest)
        return Ticks(t, np.repeat(links, counts), self._fortunes.of(links, counts, first))


class Schedule:
    """The windows of one run, one after the other."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        self._links = links = LinkDraws(scenario, streams)
        wanted = min(max(TICKS_A_LINK * links.count, LEAST_TICKS), MOST_TICKS)
        self._horizon, self._end = scenario.horizon, 0.0
        self._known = links.more(np.arange(links.count)) if links.count else _NOTHING
        self._length = wanted / links.rate if links.rate > 0.0 else math.inf

    def following(self) -> Window:
        """The next window; its end is infinite where nothing comes after it."""
        end = self._end + self._length
        if not self._end < end < self._horizon:
            end = math.inf
        self._end = end
        parts = [self._known]
        while len(late := np.flatnonzero(self._links.last < end)):
            parts.append(self._links.more(late))
        known = Ticks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        now = known.t < end
        self._known = Ticks(*(column[~now] for column in known))
        t, link, delay = (column[now] for column in known)
        order = np.argsort(t)
        if (np.diff(t[order]) == 0.0).any():
            order = np.lexsort((link, t))
        return Window(end, t[order], link[order], delay[order])


def whole_schedules(scenario: Scenario, streams: Together) -> list[Window]:
    """All ticks of each of several runs, as one window."""
    links, runs = LinkDraws(scenario, streams), len(streams.each)
    if not links.count:
        return [Window(math.inf, *_NOTHING)] * runs
    parts = []
    while len(late := np.flatnonzero(links.last < math.inf)):
        parts.append(links.more(late))
    t, link, delay = (np.concatenate(column) for column in zip(*parts, strict=True))
    run, link = np.divmod(link, links.count // runs)
    order = np.lexsort((link, t, run))
    cuts = np.cumsum(np.bincount(run, minlength=runs))[:-1]
    columns = (np.split(column[order], cuts) for column in (t, link, delay))
    return [Window(math.inf, *mine) for mine in zip(*columns, strict=True)]


_NOTHING = Ticks(np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 2)))


def _stream(streams: Streams, ends: Link, purpose: str) -> np.random.Generator:
    return streams.generator(purpose, *ends)
