"""Schedules of Poisson clocks whose messages have one chance each and one delay: drawn and merged
in compiled code.

The clocks of a network are together as even in time as one clock of their sum of rates. So ticks
are put in order by counting: as many stretches of a window as it has ticks, of about one each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.compiling import demanded, in_place
from netkf.core.draws import Draws, Ziggurat, next_exponential, next_unit, ziggurat
from netkf.core.streams import Streams, Together
from netkf.engines.compiled.schedule import (
    LOST,
    Schedule,
    Ticks,
    Window,
    way_chances,
    way_luck,
    whole_schedules,
)
from netkf.network.channels import alike
from netkf.network.clocks import LinkClock, Poisson
from netkf.scenario.scenario import Scenario

TICKS, TICKS_A_LINK, MOST_TICKS = 1 << 15, 4, 1 << 20
"""In a window: what they take fits the processor's cache, unless there are so many links that what
one costs is to be spread over some ticks.
"""


class Drawing(NamedTuple):
    """L links of several runs: the tick that is ``coming`` (L,), ``rate`` (L,), the states of the
    streams of ``ticks`` (L, 4) and of what decides about messages forth and back ``fates`` (W L, 4)
    with W = 0 (nothing is drawn), 1 (both share it) or 2, and ``chance`` (2, L) to arrive.
    """

    coming: FloatArray
    rate: FloatArray
    ticks: np.ndarray
    fates: np.ndarray
    chance: FloatArray


@in_place
def draw_ticks(
    links: Drawing,
    first: int,
    after: int,
    end: float,
    delay: float,
    exponential: Ziggurat,
    found: Ticks,
    place: int,
) -> int:
    """Write the ticks before ``end`` of the links from ``first`` up to ``after``, as links of one
    run, from ``place`` on; returns the place after the last one: where the room ends there may be
    more.
    """
    coming, count = links.coming, len(links.coming)
    for k in range(first, after):
        while coming[k] < end:
            if place == len(found.t):
                return place
            found.t[place], found.link[place] = coming[k], k - first
            luck = 0.0
            for way in range(2):
                if way * count < len(links.fates):
                    luck = next_unit(links.fates, way * count + k)
                found.delay[place, way] = delay if luck < links.chance[way, k] else LOST
            place += 1
            gap: float = next_exponential(links.ticks, k, exponential)
            coming[k] += gap / links.rate[k]
    return place


@in_place
def put_in_time_order(
    begin: float, end: float, count: int, found: Ticks, ordered: Ticks, place: np.ndarray
) -> None:
    """Write the first ``count`` ticks, which lie in [begin, end), in the order of (time, link);
    ``place`` (count + 1,) is room to work in.
    """
    scale = count / (end - begin)
    for m in range(count + 1):
        place[m] = 0
    for m in range(count):
        place[min(int((found.t[m] - begin) * scale), count - 1) + 1] += 1
    for m in range(count):
        place[m + 1] += place[m]
    t, link, delay = ordered.t, ordered.link, ordered.delay
    for m in range(count):
        k = min(int((found.t[m] - begin) * scale), count - 1)
        to = place[k]
        place[k] += 1
        t[to], link[to] = found.t[m], found.link[m]
        delay[to, 0], delay[to, 1] = found.delay[m, 0], found.delay[m, 1]
    for m in range(1, count):
        now, which, forth, back = t[m], link[m], delay[m, 0], delay[m, 1]
        to = m
        while to > 0 and (t[to - 1] > now or (t[to - 1] == now and link[to - 1] > which)):
            t[to], link[to] = t[to - 1], link[to - 1]
            delay[to, 0], delay[to, 1] = delay[to - 1, 0], delay[to - 1, 1]
            to -= 1
        t[to], link[to], delay[to, 0], delay[to, 1] = now, which, forth, back


def is_poisson(scenario: Scenario) -> bool:
    """Whether the schedules of a scenario can be made so."""
    network = scenario.network
    return (
        scenario.filter.algorithm.talks
        and bool(scenario.topology.links)
        and type(network.activation) is Poisson
        and alike(network.channel.loss)
        and network.channel.delay.fixed is not None
    )


class PoissonSchedules:
    """The ticks of some runs of such a scenario, a window at a time."""

    def __init__(self, scenario: Scenario, streams: Streams | Together) -> None:
        clock, links, runs = scenario.network.activation, scenario.topology.links, len(streams.each)
        assert isinstance(clock, LinkClock)
        both = links, tuple((j, i) for i, j in links)
        ticks, count = Draws(streams, "clock", links), len(links) * runs
        luck = [draws.states for draws in way_luck(scenario, streams, both)]
        rates = np.array([clock.mean_rate(link) for link in links])
        self._drawing = Drawing(
            coming=ticks.exponentials(np.arange(count), np.ones(count, dtype=np.int64)),
            rate=np.tile(rates, runs),
            ticks=ticks.states,
            fates=np.concatenate([*luck, np.empty((0, 4), dtype=np.uint64)]),
            chance=np.tile(way_chances(scenario, both), runs),
        )
        self._drawing.coming[:] /= self._drawing.rate
        self._links, self._rate = len(links), float(rates.sum())
        self._delay = float(scenario.network.channel.delay.fixed or 0.0)
        self._horizon, self._length = scenario.horizon, math.inf
        if self._rate > 0.0:
            self._length = max(TICKS, min(TICKS_A_LINK * len(links), MOST_TICKS)) / self._rate
        self._end, self._found = 0.0, _room(0)

    def following(self) -> Window:
        """The next window of one run; its end is infinite where nothing comes after it."""
        begin, end = self._end, self._end + self._length
        if not begin < end < self._horizon:
            end = math.inf
        self._end = end
        return self._window(0, begin, end)

    def whole(self) -> list[Window]:
        """All ticks of each run, as one window."""
        runs = len(self._drawing.coming) // self._links
        return [self._window(run, 0.0, math.inf) for run in range(runs)]

    def _window(self, run: int, begin: float, end: float) -> Window:
        draw, put = demanded(draw_ticks), demanded(put_in_time_order)
        last = min(end, self._horizon)
        expected = self._rate * (last - begin)
        count, room = 0, int(expected + 8.0 * math.sqrt(expected)) + 8
        first = run * self._links
        some = first, first + self._links, last, self._delay, ziggurat()
        while True:
            if len(self._found.t) < room:
                larger = _room(room)
                for target, source in zip(larger, self._found, strict=True):
                    target[:count] = source[:count]
                self._found = larger
            count = draw(self._drawing, *some, self._found, count)
            if count < len(self._found.t):
                break
            room = 2 * count
        ordered = _room(count)
        put(begin, last, count, self._found, ordered, np.empty(count + 1, dtype=np.int64))
        return Window(end, *ordered)


def _room(count: int) -> Ticks:
    return Ticks(np.empty(count), np.empty(count, dtype=np.int64), np.empty((count, 2)))


def schedules(scenario: Scenario, streams: Together) -> list[Window]:
    """All ticks of each of several runs, as one window."""
    if is_poisson(scenario):
        return PoissonSchedules(scenario, streams).whole()
    return whole_schedules(scenario, streams)


def schedule(scenario: Scenario, streams: Streams) -> PoissonSchedules | Schedule:
    """The windows of one run, one after the other."""
    return (PoissonSchedules if is_poisson(scenario) else Schedule)(scenario, streams)
