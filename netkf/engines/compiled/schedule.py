"""Schedules made beforehand: ticks of all links and fates of their messages, window by window.

Nothing here depends on an estimate. Every link draws its ticks and fates in blocks from its own
streams, as one message after the other would; a window takes what lies in a stretch of time and
merges the links.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.streams import Streams
from netkf.network.channels import Fates, chances, needed
from netkf.network.clocks import LinkClock
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


class LinkDraws:
    """Ticks of one link and the fates of what it sends, drawn as they are asked for."""

    def __init__(self, scenario: Scenario, streams: Streams, link: Link, longest: int) -> None:
        clock, channel = scenario.network.activation, scenario.network.channel
        assert isinstance(clock, LinkClock)
        self._clock, self._link, self._longest = clock, link, longest
        self._horizon = scenario.horizon
        self._random = streams.generator("clock", *link)
        self._origin = clock.origin(link, partial(_stream, streams, link, "phase"))
        self._channel = channel
        back = link[1], link[0]
        self._fates = [Fates(channel, partial(_stream, streams, link))]
        if not channel.symmetric:
            self._fates.append(Fates(channel, partial(_stream, streams, back)))
        self._ways = [(way, scenario.measured(way)) for way in (link, back)]
        self.drawn, self.last, self._count = 0, 0.0, FIRST_BLOCK
        self._ticks = [(np.empty(0), np.empty((0, 2)))]

    def until(self, end: float) -> None:
        """Draw until all ticks before ``end`` are known; ``last`` is the last one known."""
        while self.last < end:
            self._ticks.append(self.block())

    def block(self) -> tuple[FloatArray, FloatArray]:
        """Draw some more: times and delays; ``last`` is infinite after the last ones."""
        t = self._clock.ticks(
            self._link, self._origin, self.drawn, self.last, self._random, self._count
        )
        # The horizon is half open; later ticks, and there may be many, are not kept.
        kept = int(np.searchsorted(t, self._horizon, side="left"))
        delay = self._fate(kept)
        self.drawn += len(t)
        self.last = float(t[-1]) if 0 < len(t) == kept else math.inf
        self._count = min(2 * self._count, self._longest)
        return t[:kept], delay

    def _fate(self, count: int) -> FloatArray:
        drawn = [fates.draws(count) for fates in self._fates]
        out = np.empty((count, 2))
        for k, (way, measured) in enumerate(self._ways):
            luck, bad, delay = drawn[k % len(drawn)]
            chance = chances(self._channel.loss, way, self.drawn, bad, measured)
            out[:, k] = np.where(luck >= chance, LOST, delay)
        return out

    def take(self, end: float) -> tuple[FloatArray, FloatArray]:
        """Times and delays of the ticks before ``end``; they are forgotten."""
        self.until(end)
        if len(self._ticks) > 1:
            t, delay = (np.concatenate([block[k] for block in self._ticks]) for k in range(2))
        else:
            t, delay = self._ticks[0]
        cut = int(np.searchsorted(t, end, side="left"))
        self._ticks = [(t[cut:], delay[cut:])]
        return t[:cut], delay[:cut]


def link_draws(scenario: Scenario, streams: Streams) -> list[LinkDraws]:
    """What every link draws, in the order of links; nothing where the filter does not talk."""
    links = scenario.topology.links if scenario.filter.algorithm.talks else ()
    longest = min(LONGEST_BLOCK, max(FIRST_BLOCK, 4 * MOST_TICKS // max(len(links), 1)))
    channel = scenario.network.channel
    ways = [*links] if channel.symmetric else [*links, *((j, i) for i, j in links)]
    seeded = streams.seeded(("clock", *needed(channel)), ways)
    return [LinkDraws(scenario, seeded, link, longest) for link in links]


class Schedule:
    """The windows of one run, one after the other."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        self._links = link_draws(scenario, streams)
        wanted = min(max(TICKS_A_LINK * len(self._links), LEAST_TICKS), MOST_TICKS)
        self._horizon, self._end = scenario.horizon, 0.0
        for link in self._links:
            link.until(math.ulp(0.0))
        rate = sum(link.drawn / link.last for link in self._links)
        self._length = wanted / rate if rate > 0.0 else math.inf

    def following(self) -> Window:
        """The next window; its end is infinite where nothing comes after it."""
        end = self._end + self._length
        if not self._end < end < self._horizon:
            end = math.inf
        self._end = end
        taken = [link.take(end) for link in self._links]
        counts = [len(t) for t, _ in taken]
        times = np.concatenate([np.empty(0), *(t for t, _ in taken)])
        # Links follow each other, and a stable sort keeps them so where times are equal.
        order = np.argsort(times, kind="stable")
        places = np.repeat(np.arange(len(taken)), counts)
        delays = np.concatenate([np.empty((0, 2)), *(delay for _, delay in taken)])
        return Window(end, times[order], places[order], delays[order])


def _stream(streams: Streams, ends: Link, purpose: str) -> np.random.Generator:
    return streams.generator(purpose, *ends)
