"""Schedules of Poisson clocks whose messages have one chance each and one delay: drawn and merged
in compiled code.

The clocks of a network are together as even in time as one clock of their sum of rates. So ticks
are put in order by counting: as many bins of a window as it has ticks, of about one each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.engines.compiled.kept import once_per_scenario
from netkf.engines.compiled.schedule import (
    LOST,
    Schedule,
    Window,
    delivery_chances,
    has_table_law,
    whole_schedules,
)
from netkf.engines.compiled.senders import Senders, senders_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.network.clocks import LinkClock, Poisson
from netkf.rng.draws import StreamBatch, Ziggurat, exponential_of, next_unit, ziggurat
from netkf.rng.streams import ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario

TICKS, TICKS_A_LINK, MAX_WINDOW_TICKS = 1 << 15, 4, 1 << 20
"""In a window: what they take fits the processor's cache, unless there are so many links that what
one costs is to be spread over some ticks.
"""


class Drawing(NamedTuple):
    """The clocks of R runs, E entities in all, and the law of their messages.

    coming  : (E,) time of the next tick, seconds
    rate    : (E,) ticks per second
    ticks   : (E, 4) states of the random streams of ticks
    losses  : (S, 4) states of the streams that decide about losses, ``streams`` of them in each
              run; S = 0: no message is lost
    first, hearing : entity e of a run sends on the directions ``hearing[first[e]:first[e + 1]]``
    source  : (W,) stream of each direction
    chance  : (W,) probability that a message arrives
    bits    : whether only the bits of messages that arrive are drawn, without outcomes
    """

    coming: FloatArray
    rate: FloatArray
    ticks: np.ndarray
    losses: np.ndarray
    streams: int
    first: np.ndarray
    hearing: np.ndarray
    source: np.ndarray
    chance: FloatArray
    bits: bool


class Found(NamedTuple):
    """Ticks as they are found: ``t, entity`` (K,), and where in ``delay`` their outcomes begin, or
    a bit for each of them.
    """

    t: FloatArray
    entity: np.ndarray
    at: np.ndarray
    delay: FloatArray


@kernel
def draw_ticks(
    drawing: Drawing,
    run: int,
    end: float,
    delay: float,
    exponential: Ziggurat,
    found: Found,
    used: np.ndarray,
) -> bool:
    """Write the ticks before ``end`` of a run behind those that are there; ``used`` (2,) counts
    them and their outcomes. False where the room ended first.
    """
    # Entity by entity, each from its own stream; the order of time is made afterwards.
    for e in range(len(drawing.first) - 1):
        if not draw_ticks_of(drawing, run, e, end, delay, exponential, found, used):
            return False
    return True


@kernel
def draw_ticks_of(
    drawing: Drawing,
    run: int,
    e: int,
    end: float,
    delay: float,
    exponential: Ziggurat,
    found: Found,
    used: np.ndarray,
) -> bool:
    """``draw_ticks`` of one entity."""
    states, first, after = drawing.ticks, drawing.first[e], drawing.first[e + 1]
    k = run * (len(drawing.first) - 1) + e
    now, rate, high, low = drawing.coming[k], drawing.rate[k], states[k, 0], states[k, 1]
    m, room, ended = used[0], len(found.delay) - (after - first), True
    while now < end:
        # The room is checked before a tick is written, so that a stop leaves the streams where they
        # are for this tick.
        if m == len(found.t) or used[1] > room:
            ended = False
            break
        found.t[m], found.entity[m] = now, e
        found.at[m] = draw_outcomes(drawing, run, first, after, delay, found, used)
        m += 1
        # The next tick is drawn now: it may lie in the next window.
        gap, high, low = exponential_of(states, k, high, low, exponential)
        now += gap / rate
    drawing.coming[k], states[k, 0], states[k, 1], used[0] = now, high, low, m
    return ended


@kernel(inlined=True)
def draw_outcomes(
    drawing: Drawing,
    run: int,
    first: int,
    after: int,
    delay: float,
    found: Found,
    used: np.ndarray,
) -> int:
    """Draw which messages of a tick arrive, on the directions ``hearing[first:after]``;
    return where their outcomes begin, or a bit for each.
    """
    at, uniform, drawn = 0 if drawing.bits else used[1], 0.0, -1
    # One uniform number for each source of outcomes: directions that share a source follow one
    # another.
    for m in range(first, after):
        w = drawing.hearing[m]
        if drawing.streams > 0 and drawing.source[w] != drawn:
            drawn = drawing.source[w]
            # The number is below 1, so that a link with probability 1 never loses.
            uniform = next_unit(drawing.losses, run * drawing.streams + drawn)
        arrives = uniform < drawing.chance[w]
        if drawing.bits:
            at |= np.int64(arrives) << (m - first)
        else:
            found.delay[used[1]] = delay if arrives else LOST
            used[1] += 1
    return at


class Sorting(NamedTuple):
    """Scratch to put K ticks in order: where the next tick of a bin goes, ``place`` (K + 1,),
    and which tick goes where, ``source`` (K,). Short integers stay in the cache.
    """

    place: np.ndarray
    source: np.ndarray


def _sorting(ticks: int) -> Sorting:
    return Sorting(np.empty(ticks + 1, dtype=np.int32), np.empty(ticks, dtype=np.int32))


@kernel
def put_in_time_order(
    begin: float, end: float, count: int, found: Found, ordered: Found, sorting: Sorting
) -> None:
    """Write the first ``count`` ticks, which lie in [begin, end), by (time, entity)."""
    # Ticks are evenly spread, hence about one in each of ``count`` equal bins.
    place, source, scale = sorting.place, sorting.source, count / (end - begin)
    # Counting sort by bin: count, sum up, and place.
    for m in range(count + 1):
        place[m] = 0
    for m in range(count):
        place[bin_of(found.t[m], begin, scale, count) + 1] += 1
    for m in range(count):
        place[m + 1] += place[m]
    for m in range(count):
        # place[k] is where the next tick of bin k goes.
        k = bin_of(found.t[m], begin, scale, count)
        source[place[k]] = m
        place[k] += 1
    # Insertion sort mends the order inside bins, in linear time on average, as few share one.
    # It is by (time, entity): ties keep the order of entities.
    t, entity, at = ordered.t, ordered.entity, ordered.at
    for to in range(count):
        m, k = source[to], to
        now, which = found.t[m], found.entity[m]
        while k > 0 and (t[k - 1] > now or (t[k - 1] == now and entity[k - 1] > which)):
            t[k], entity[k], at[k] = t[k - 1], entity[k - 1], at[k - 1]
            k -= 1
        t[k], entity[k], at[k] = now, which, found.at[m]


@kernel(inlined=True)
def bin_of(time: float, begin: float, scale: float, count: int) -> int:
    """Return which of ``count`` bins a time lies in, ``scale`` of them in a second."""
    return min(int((time - begin) * scale), count - 1)


class AllTicks(NamedTuple):
    """The ticks of R runs one after the other, those of run r from ``first[r]`` up to ``first[r +
    1]``, as in a Window; ``at`` counts from the first outcome of the run, which is ``delay`` at
    ``first_delay[r]``; with ``bits`` it says which messages arrive.
    """

    t: FloatArray
    entity: np.ndarray
    at: np.ndarray
    delay: FloatArray
    first: np.ndarray
    first_delay: np.ndarray
    bits: bool = False


@kernel
def draw_all_ticks(
    drawing: Drawing,
    horizon: float,
    delay: float,
    exponential: Ziggurat,
    found: Found,
    used: np.ndarray,
    sorting: Sorting,
    ticks: AllTicks,
) -> bool:
    """Draw the ticks of all runs up to the horizon, in the order of (time, entity); ``found``,
    ``used`` (2,) and ``sorting`` are scratch. False where some array is too small.
    """
    for run in range(len(ticks.first) - 1):
        used[0] = used[1] = 0
        if not draw_ticks(drawing, run, horizon, delay, exponential, found, used):
            return False
        first, begin = ticks.first[run], ticks.first_delay[run]
        last, end = first + used[0], begin + used[1]
        # The arrays are too small for this run: the caller starts again with more space.
        if last > len(ticks.t) or end > len(ticks.delay):
            return False
        ordered = Found(
            ticks.t[first:last], ticks.entity[first:last], ticks.at[first:last], found.delay
        )
        put_in_time_order(0.0, horizon, used[0], found, ordered, sorting)
        # ``at`` counts within the run, so that outcomes are copied without a change.
        for k in range(used[1]):
            ticks.delay[begin + k] = found.delay[k]
        ticks.first[run + 1], ticks.first_delay[run + 1] = last, end
    return True


def is_poisson(scenario: Scenario) -> bool:
    """Return True if kernels can draw the schedules of a scenario."""
    network = scenario.network
    talks = scenario.hosted.talks and bool(scenario.topology.links)
    return talks and type(network.activation) is Poisson and has_table_law(network.channel)


@once_per_scenario
def _rates_and_chances(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Ticks per second of each entity (E,), and the delivery probability of each direction (W,)."""
    clock, senders = scenario.network.activation, senders_of(scenario)
    assert isinstance(clock, LinkClock)
    rates = np.array([clock.mean_rate(entity) for entity in senders.entities])
    return rates, delivery_chances(scenario, senders.directions)


class PoissonSchedules:
    """The ticks of some runs of such a scenario, a window at a time."""

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams | ReplicaStreams,
        senders: Senders | None = None,
        bits: bool = False,
    ) -> None:
        runs = streams.runs
        senders = senders_of(scenario) if senders is None else senders
        ticks, count = StreamBatch(streams, "clock", senders.entities), len(senders.entities) * runs
        # No states where nothing is random: draw_ticks() then draws no number.
        losses: np.ndarray = np.empty((0, 4), dtype=np.uint64)
        if not scenario.network.channel.loss.deterministic:
            losses = StreamBatch(streams, "loss", senders.sources).states
        rates, chances = _rates_and_chances(scenario)
        self._drawing = Drawing(
            coming=ticks.exponentials(np.arange(count), np.ones(count, dtype=np.int64)),
            rate=np.tile(rates, runs),
            ticks=ticks.states,
            losses=losses,
            streams=len(losses) // runs,
            first=senders.first,
            hearing=senders.hearing,
            source=senders.source,
            chance=chances,
            bits=bits,
        )
        # The first tick of each entity, unit exponentials over its rate.
        self._drawing.coming[:] /= self._drawing.rate
        self._runs, self._rate = runs, float(rates.sum())
        # Mean number of messages for each tick.
        self._sends = float(rates @ np.diff(senders.first)) / self._rate
        self._most = int(np.diff(senders.first).max())
        self._delay = float(scenario.network.channel.delay.fixed or 0.0)
        self._horizon, self._length = scenario.horizon, math.inf
        if self._rate > 0.0:
            entities = len(senders.entities)
            # A window of some thousand ticks, more of them where there are many links.
            self._length = max(TICKS, min(TICKS_A_LINK * entities, MAX_WINDOW_TICKS)) / self._rate
        self._end, self._found = 0.0, _room(0, 0)

    def following(self) -> Window:
        """The next window of one run; its end is infinite where nothing comes after it."""
        begin, end = self._end, self._end + self._length
        # The last window has no end, so that the loop asks for no other.
        if not begin < end < self._horizon:
            end = math.inf
        self._end = end
        return self._window(0, begin, end)

    def whole(self) -> AllTicks:
        """All ticks of all runs."""
        states = self._drawing.coming, self._drawing.ticks, self._drawing.losses
        # Streams as they are now: a try without enough space begins with them again.
        begun = [state.copy() for state in states]
        # A Poisson count exceeds its mean by eight standard deviations with a negligible chance,
        # and even then the loop only tries again.
        expected, spread = self._rate * self._horizon, 8.0
        while True:
            most = int(expected + spread * math.sqrt(expected)) + 8
            total = int(self._runs * expected + spread * math.sqrt(self._runs * expected)) + most
            found, ticks = self._space(most), self._space_for_all(total)
            scratch = found, np.zeros(2, dtype=np.int64), _sorting(most)
            given = self._drawing, self._horizon, self._delay, ziggurat()
            if draw_all_ticks(*given, *scratch, ticks):
                return ticks
            spread *= 2.0
            for state, before in zip(states, begun, strict=True):
                state[:] = before

    def _space(self, ticks: int) -> Found:
        sends = 0.0 if self._drawing.bits else self._sends
        return _room(ticks, int(sends * ticks) + self._most)

    def _space_for_all(self, ticks: int) -> AllTicks:
        t, entity, at, delay = self._space(ticks)
        first, first_delay = (np.zeros(self._runs + 1, dtype=np.int64) for _ in range(2))
        return AllTicks(t, entity, at, delay, first, first_delay, self._drawing.bits)

    def _window(self, run: int, begin: float, end: float) -> Window:
        last, used = min(end, self._horizon), np.zeros(2, dtype=np.int64)
        expected = self._rate * (last - begin)
        ticks = int(expected + 8.0 * math.sqrt(expected)) + 8
        # The same bound for one window.
        sends = int(self._sends * ticks) + self._most
        while True:
            self._make_room(ticks, sends, used)
            if draw_ticks(self._drawing, run, last, self._delay, ziggurat(), self._found, used):
                break
            # What was found so far stays: drawing goes on where it stopped.
            ticks, sends = 2 * ticks, 2 * sends
        count = int(used[0])
        ordered = _room(count, 0)._replace(delay=self._found.delay[: used[1]].copy())
        put_in_time_order(begin, last, count, self._found, ordered, _sorting(count))
        return Window(end, *ordered)

    def _make_room(self, ticks: int, sends: int, used: np.ndarray) -> None:
        # The room only grows.
        if len(self._found.t) >= ticks and len(self._found.delay) >= sends:
            return
        larger = _room(ticks, sends)
        for target, source in zip(larger, self._found, strict=True):
            kept = min(len(source), len(target))
            target[:kept] = source[:kept]
        self._found = larger


def _room(ticks: int, sends: int) -> Found:
    entity, at = (np.empty(ticks, dtype=np.int64) for _ in range(2))
    return Found(np.empty(ticks), entity, at, np.empty(sends))


def all_ticks(scenario: Scenario, streams: ReplicaStreams, bits: bool = False) -> AllTicks:
    """All ticks of several runs; where clocks are Poisson and no message takes time, with ``bits``
    for outcomes if they are wanted.
    """
    if is_poisson(scenario):
        return PoissonSchedules(scenario, streams, bits=bits).whole()
    # Any other clock or channel: windows made in Python, joined run after run.
    windows = whole_schedules(scenario, streams)
    first, first_delay = (
        np.cumsum([0, *(len(getattr(window, name)) for window in windows)])
        for name in ("t", "delay")
    )
    t, entity, at, delay = (
        np.concatenate([getattr(window, name) for window in windows])
        for name in ("t", "entity", "at", "delay")
    )
    return AllTicks(t, entity, at, delay, first, first_delay)


def window_of(ticks: AllTicks, run: int) -> Window:
    """All ticks of one run."""
    mine, sent = (slice(*first[run : run + 2]) for first in (ticks.first, ticks.first_delay))
    return Window(math.inf, ticks.t[mine], ticks.entity[mine], ticks.at[mine], ticks.delay[sent])


def schedule(
    scenario: Scenario, streams: Streams, senders: Senders | None = None
) -> PoissonSchedules | Schedule:
    """The windows of one run, one after the other."""
    made = PoissonSchedules if is_poisson(scenario) else Schedule
    return made(scenario, streams, senders)
