"""The ticks of all clocks of some runs and the outcomes of their messages, window by window.

Nothing here depends on an estimate. Ticks are drawn entity by entity, each from its own stream, for
a window of time after another, and then sorted. Those of random gaps are about evenly spread over a
window, so that they are sorted by counting: a window is divided into as many bins as it has ticks,
of about one tick each. Others may crowd, and are merged. The ticks of a user's clock, those before
a user's channel, and transmissions after samples are listed up to the horizon before a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from netkf.core.instants import snapped
from netkf.engines.compiled.life_tables import NO_LIVES, LifeTable, links_of_lives
from netkf.engines.compiled.moving_links import MovingLinks, moving_links
from netkf.engines.compiled.outcomes import (
    ChannelStreams,
    channel_streams,
    delivery_table,
    demand_probabilities,
    draw_outcomes,
    draws_in_kernels,
    list_outcomes,
)
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.senders import Senders, senders_of
from netkf.engines.compiled.state import Instants, TickArrays
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.network.clocks import LinkClock, Periodic, Poisson, RecordedClock, Renewal
from netkf.network.losses import Transmission, law_in_kernels
from netkf.rng.draws import Ziggurat, fill_units, next_exponential, next_unit, ziggurat
from netkf.rng.numbers import next_gamma, normal_ziggurat
from netkf.rng.streams import Streams
from netkf.scenario.positions import ticks_of
from netkf.scenario.scenario import Scenario

TICKS, MIN_TICKS_PER_ENTITY, MAX_WINDOW_TICKS = 1 << 15, 4, 1 << 20
"""Ticks in a window: TICKS, whose arrays fit the processor's cache, or, if these are more,
MIN_TICKS_PER_ENTITY for each entity, since each has a fixed cost in a window; at most
MAX_WINDOW_TICKS.
"""
EXPONENTIAL_GAPS, UNIFORM_GAPS, GAMMA_GAPS, WEIBULL_GAPS, LATTICE, LISTED = range(6)
"""Kinds of clocks: random gaps; times that follow from the number of the tick, but for a jitter;
and times that were drawn in Python.
"""
CROWDING_SHAPE = 100.0
"""Gaps of larger shapes are so regular that the ticks of all entities crowd."""
NOTHING_SENT: IntArray = np.zeros(0, dtype=np.int64)
NO_LINKS = MovingLinks([], [], NOTHING_SENT, np.zeros((0, 3), dtype=np.int64))


class Clocks(NamedTuple):
    """The clocks of R runs, E entities in all; ``first`` and ``outgoing`` are those of a run.

    kind : EXPONENTIAL_GAPS, ... or LISTED
    next_tick, number : (E,), time of the next tick, seconds, not on the grid yet, and its number,
                        in ``listed`` if that is where it comes from
    scale : (E,), what draws of exponential or gamma gaps are divided by, or the time from which a
            lattice is counted
    low, width : uniform gaps and jitters are ``low + width u``; ``low`` is the period of a lattice,
                 the shape of gamma gaps or one over that of Weibull gaps; ``width`` their factor
    crowds : whether ticks may be unevenly spread over time
    streams : (E, WIDTH), states of the random streams
    first, outgoing : entity e of a run sends on the directions ``outgoing[first[e]:first[e + 1]]``
    per_second : ticks of the time grid in a second (core.instants)
    listed : the times of the ticks, entity after entity, of each with infinity behind them
    """

    kind: int
    next_tick: FloatArray
    number: IntArray
    scale: FloatArray
    low: float
    width: float
    crowds: bool
    streams: np.ndarray
    first: IntArray
    outgoing: IntArray
    per_second: float
    listed: FloatArray


class TickBuffer(NamedTuple):
    """Space for K ticks.

    t, entity : (K,), time in seconds, and index of the entity whose clock ticks
    first_outcome : (K,), the outcomes of tick k begin at ``delay[first_outcome[k]]``; with ``bits``
                    this number itself has a bit for each message that arrives
    delay : (D,), outcomes of all messages, tick after tick: seconds, or LOST; empty with ``bits``
    """

    t: FloatArray
    entity: np.ndarray
    first_outcome: np.ndarray
    delay: FloatArray


@kernel
def draw_ticks(
    clocks: Clocks,
    channels: ChannelStreams,
    run: int,
    end: float,
    buffer: TickBuffer,
    counts: IntArray,
) -> bool:
    """Append the ticks of run number ``run`` before ``end`` (seconds), entity by entity, with their
    outcomes to ``buffer``; ``counts`` (2,) are the numbers of both in it. Return False if the
    buffer is full before; a call with a larger one then goes on.
    """
    for e in range(len(clocks.first) - 1):
        first, after = clocks.first[e], clocks.first[e + 1]
        k, max_outcomes = run * (len(clocks.first) - 1) + e, len(buffer.delay) - (after - first)
        now, m = clocks.next_tick[k], counts[0]
        instant = snapped(now, clocks.per_second)
        while instant < end:
            # Check the space before a tick is drawn: after an enlargement drawing goes on with
            # this tick.
            if m == len(buffer.t) or counts[1] > max_outcomes:
                clocks.next_tick[k], counts[0] = now, m
                return False
            buffer.t[m], buffer.entity[m] = instant, e
            buffer.first_outcome[m] = draw_outcomes(
                channels, run, clocks.outgoing, first, after, instant, buffer.delay, counts
            )
            m += 1
            # The next tick is drawn now: it may lie in the next window.
            now = tick_after(clocks, k, now, channels.exponential, channels.normal)
            instant = snapped(now, clocks.per_second)
        clocks.next_tick[k], counts[0] = now, m
    return True


@kernel(inlined=True)
def tick_after(
    clocks: Clocks, k: int, now: float, exponential: Ziggurat, normal: Ziggurat
) -> float:
    """Return the time of the tick of entity ``k`` after that at ``now`` (seconds), off the grid."""
    if clocks.kind == EXPONENTIAL_GAPS:
        return float(now + next_exponential(clocks.streams, k, exponential) / clocks.scale[k])
    if clocks.kind == UNIFORM_GAPS:
        return now + (clocks.low + clocks.width * next_unit(clocks.streams, k))
    if clocks.kind == GAMMA_GAPS:
        drawn = next_gamma(clocks.streams, k, clocks.low, exponential, normal)
        return float(now + drawn / clocks.scale[k] * clocks.width)
    if clocks.kind == WEIBULL_GAPS:
        drawn = next_exponential(clocks.streams, k, exponential)
        return now + math.pow(drawn, clocks.low) * clocks.width
    number = clocks.number[k]
    clocks.number[k] = number + 1
    if clocks.kind == LISTED:
        return float(clocks.listed[number])
    time: float = clocks.scale[k] + clocks.low * number
    if clocks.width > 0.0:
        time += clocks.width * next_unit(clocks.streams, k)
    return time


@kernel
def start_clocks(clocks: Clocks, exponential: Ziggurat, normal: Ziggurat) -> None:
    """Draw the first tick of each entity."""
    for k in range(len(clocks.next_tick)):
        clocks.next_tick[k] = tick_after(clocks, k, 0.0, exponential, normal)


class Sorting(NamedTuple):
    """Scratch to sort K ticks: position of the next tick of each bin, ``place`` (K + 1,), and the
    index of the tick at each position, ``source`` (K,). Int32 halves their size in the cache.
    """

    place: np.ndarray
    source: np.ndarray


def _sorting(ticks: int) -> Sorting:
    return Sorting(np.empty(ticks + 1, dtype=np.int32), np.empty(ticks, dtype=np.int32))


@kernel
def merge_in_time_order(
    count: int, buffer: TickBuffer, ordered: TickBuffer, sorting: Sorting
) -> None:
    """Sort the first ``count`` ticks of ``buffer`` by (time, entity) into ``ordered``: merge
    neighbouring runs of increasing times, at first those of entities.
    """
    t, source, merged = buffer.t, sorting.source, sorting.place
    for k in range(count):
        source[k] = k
    runs = count
    while runs > 1:
        runs, begin = 0, 0
        while begin < count:
            middle = end_of_run(t, source, begin, count)
            end = end_of_run(t, source, middle, count)
            i, j = begin, middle
            for k in range(begin, end):
                # At equal times the earlier run, that of smaller entities, comes first.
                if j == end or (i < middle and t[source[i]] <= t[source[j]]):
                    merged[k], i = source[i], i + 1
                else:
                    merged[k], j = source[j], j + 1
            runs, begin = runs + 1, end
        for k in range(count):
            source[k] = merged[k]
    for k in range(count):
        m = source[k]
        ordered.t[k], ordered.entity[k] = t[m], buffer.entity[m]
        ordered.first_outcome[k] = buffer.first_outcome[m]


@kernel(inlined=True)
def end_of_run(t: FloatArray, source: IntArray, begin: int, count: int) -> int:
    """Return where the run of times that do not decrease ends that begins at ``begin``."""
    k = min(begin + 1, count)
    while k < count and t[source[k - 1]] <= t[source[k]]:
        k += 1
    return k


@kernel
def put_in_time_order(
    begin: float, end: float, count: int, buffer: TickBuffer, ordered: TickBuffer, sorting: Sorting
) -> None:
    """Sort the first ``count`` ticks, evenly spread over [begin, end) s, into ``ordered``."""
    # Ticks are evenly spread, hence about one in each of ``count`` equal bins.
    place, source, scale = sorting.place, sorting.source, count / (end - begin)
    # Counting sort by bin: count, sum up, and place.
    for m in range(count + 1):
        place[m] = 0
    for m in range(count):
        place[bin_of(buffer.t[m], begin, scale, count) + 1] += 1
    for m in range(count):
        place[m + 1] += place[m]
    for m in range(count):
        # place[k] is where the next tick of bin k goes.
        k = bin_of(buffer.t[m], begin, scale, count)
        source[place[k]] = m
        place[k] += 1
    # Insertion sort orders ticks inside bins, in linear time on average, since few share one.
    # It is by (time, entity): ties keep the order of entities.
    t, entity, outcome = ordered.t, ordered.entity, ordered.first_outcome
    for position in range(count):
        m, k = source[position], position
        time, e = buffer.t[m], buffer.entity[m]
        while k > 0 and (t[k - 1] > time or (t[k - 1] == time and entity[k - 1] > e)):
            t[k], entity[k], outcome[k] = t[k - 1], entity[k - 1], outcome[k - 1]
            k -= 1
        t[k], entity[k], outcome[k] = time, e, buffer.first_outcome[m]


@kernel(inlined=True)
def bin_of(time: float, begin: float, scale: float, count: int) -> int:
    """Return the index of the bin that ``time`` lies in, of ``count`` bins from ``begin`` on."""
    return min(int((time - begin) * scale), count - 1)


class AllTicks(NamedTuple):
    """The K ticks of R runs, one run after the other, as in a TickBuffer.

    t, entity, first_outcome : (K,); ticks ``first[r]`` to ``first[r + 1]`` - 1 are those of run r,
                               whose ``first_outcome`` counts from ``first_delay[r]``
    delay : (D,), outcomes of all runs: seconds, or LOST
    first, first_delay : (R + 1,)
    bits : whether ``first_outcome`` holds arrival bits instead
    """

    t: FloatArray
    entity: np.ndarray
    first_outcome: np.ndarray
    delay: FloatArray
    first: np.ndarray
    first_delay: np.ndarray
    bits: bool = False


@kernel
def draw_all_ticks(
    clocks: Clocks,
    channels: ChannelStreams,
    horizon: float,
    buffer: TickBuffer,
    counts: IntArray,
    sorting: Sorting,
    ticks: AllTicks,
) -> bool:
    """Draw the ticks of all R runs up to the ``horizon`` into ``ticks``, run after run, each
    sorted. Return False if an array is too small: the caller starts again with more space.
    """
    for run in range(len(ticks.first) - 1):
        counts[0] = counts[1] = 0
        if not draw_ticks(clocks, channels, run, horizon, buffer, counts):
            return False
        first, begin = ticks.first[run], ticks.first_delay[run]
        last, end = first + counts[0], begin + counts[1]
        # The arrays are too small for this run: the caller starts again with more space.
        if last > len(ticks.t) or end > len(ticks.delay):
            return False
        ordered = TickBuffer(
            ticks.t[first:last],
            ticks.entity[first:last],
            ticks.first_outcome[first:last],
            buffer.delay,
        )
        if clocks.crowds:
            merge_in_time_order(counts[0], buffer, ordered, sorting)
        else:
            put_in_time_order(0.0, horizon, counts[0], buffer, ordered, sorting)
        # ``first_outcome`` counts within the run, so that outcomes are copied as they are.
        for k in range(counts[1]):
            ticks.delay[begin + k] = buffer.delay[k]
        ticks.first[run + 1], ticks.first_delay[run + 1] = last, end
    return True


def is_kernel_clock(clock: object) -> bool:
    """Return True if kernels can draw the ticks of a clock."""
    # By exact type: a subclass may override the law.
    return type(clock) in (Poisson, Periodic, Renewal)


def ticks_apart(clock: object) -> bool:
    """Return True if two entities tick at one time with probability 0 only, and so do not."""
    if type(clock) is RecordedClock:
        # The replay of a log is then computed as its run was, to the bit.
        return clock.all_apart
    if type(clock) is Periodic:
        return clock.phase == "random" or clock.jitter > 0.05 * clock.period
    if type(clock) is Renewal:
        spread = (clock.high or 0.0) - (clock.low or 0.0)
        # Gaps of a smaller shape are often shorter than one tick of the time grid.
        random = clock.shape is not None and 1.0 <= clock.shape <= CROWDING_SHAPE
        return random or spread > 0.05 * clock.mean_gap
    return type(clock) is Poisson


def _list_ticks(
    scenario: Scenario,
    streams: Streams,
    senders: Senders,
    instants: Instants | None,
    lives: LifeTable,
) -> list[FloatArray] | None:
    """Return the ticks (K,) of each entity and run (R E), in s; None where kernels draw them."""
    network = scenario.network
    if senders.at == "readings":
        assert instants is not None
        listed = [instants.t[instants.index == node] for node in range(len(senders.entities))]
        # Who is down takes no sample, after which to transmit.
        return [t[~lives.is_down(h, t)] for h, t in enumerate(listed)]
    # Python lists the ticks of a user's clock, and of nodes that move.
    in_kernels = is_kernel_clock(network.activation) and draws_in_kernels(network)
    if senders.entities and in_kernels and not (scenario.links_move or network.clocks):
        return None
    if not isinstance(network.activation, LinkClock):
        return []
    # A tick that rounding brings to the horizon is none: whatever counts ticks counts these.
    return [
        scenario.time_grid.before(scenario.horizon, ticks_of(scenario, one, entity))
        for one in streams.per_replica
        for entity in senders.entities
    ]


def _listed_clocks(clocks: Clocks, listed: list[FloatArray]) -> Clocks:
    """Return the ``clocks`` with the times of all of their ticks."""
    times = np.concatenate([np.empty(0), *(np.append(t, np.inf) for t in listed)])
    number = np.cumsum([0, *(len(t) + 1 for t in listed)], dtype=np.int64)[:-1]
    return clocks._replace(kind=LISTED, crowds=True, number=number, listed=times)


def clocks_of(
    clock: object,
    entities: Sequence[tuple[int, ...]],
    rates: FloatArray,
    streams: Streams,
    purposes: tuple[str, str],
    per_second: float,
) -> Clocks:
    """Return the clocks of E ``entities`` in all runs, before their first ticks, which send on
    nothing; ``rates`` (E,): their ticks per second, ``purposes`` of streams for ticks and phases.
    """
    count = len(entities) * streams.runs
    kind, low, width, number = EXPONENTIAL_GAPS, 0.0, 0.0, np.zeros(count, dtype=np.int64)
    scale, shape = np.tile(rates, streams.runs), getattr(clock, "shape", None) or 0.0
    if isinstance(clock, Periodic):
        kind, low, width = LATTICE, clock.period, clock.jitter
        if isinstance(clock.phase, str):
            fill_units(streams.states(purposes[1], entities), scale)
            scale *= clock.period
        else:
            scale = np.full(count, clock.phase)
        # With phase 0 the lattice point at time 0 is no tick.
        number = (scale == 0.0).astype(np.int64)
    elif isinstance(clock, Renewal) and clock.distribution == "uniform":
        assert clock.low is not None
        assert clock.high is not None
        kind, low, width = UNIFORM_GAPS, clock.low, clock.high - clock.low
    elif isinstance(clock, Renewal) and clock.distribution == "gamma":
        divisor, width = clock.gamma_scale
        kind, low, scale = GAMMA_GAPS, shape, np.full(count, divisor)
    elif isinstance(clock, Renewal) and clock.distribution == "weibull":
        kind, low, width = WEIBULL_GAPS, 1.0 / shape, clock.weibull_scale
    elif isinstance(clock, Renewal):
        kind, low, number, scale = LATTICE, clock.mean_gap, number + 1, np.zeros(count)
    return Clocks(
        kind=kind,
        next_tick=np.zeros(count),
        number=number,
        scale=scale,
        low=low,
        width=width,
        crowds=kind == LATTICE or shape > CROWDING_SHAPE,
        streams=streams.states(purposes[0], entities),
        first=NOTHING_SENT,
        outgoing=NOTHING_SENT,
        per_second=per_second,
        listed=np.empty(0),
    )


@kernel
def draw_instants(
    clocks: Clocks,
    horizon: float,
    exponential: Ziggurat,
    normal: Ziggurat,
    t: FloatArray,
    entity: IntArray,
) -> int:
    """Write the ticks of all clocks before the ``horizon`` (seconds), clock by clock, into ``t``
    (K,), and their indices into ``entity``; return their number, -1 if there is no space for them.
    """
    count = 0
    for k in range(len(clocks.next_tick)):
        now = tick_after(clocks, k, 0.0, exponential, normal)
        instant = snapped(now, clocks.per_second)
        while instant < horizon:
            if count == len(t):
                return -1
            t[count], entity[count] = instant, k
            count += 1
            now = tick_after(clocks, k, now, exponential, normal)
            instant = snapped(now, clocks.per_second)
    return count


@once_per_scenario
def _rates(scenario: Scenario) -> FloatArray:
    """Return the ticks per second (E,) of each entity: link, direction or node with a clock."""
    clock, senders = scenario.network.activation, senders_of(scenario)
    assert isinstance(clock, LinkClock)
    return np.array([clock.mean_rate(entity) for entity in senders.entities])


@once_per_scenario
def _law_of_messages(scenario: Scenario) -> tuple[FloatArray, list[Transmission]]:
    """Return the deliveries (2, W) of a loss, by state, and the first messages of a KernelLoss."""
    directions, loss = senders_of(scenario).directions, scenario.network.channel.loss
    if law_in_kernels(loss):
        return np.ones((2, len(directions))), [scenario.transmission(w) for w in directions]
    return delivery_table(scenario, loss, directions), []


class Schedule:
    """The ticks of some runs of a scenario, and which of their messages arrive: window by window,
    or all at once. ``bits``: the outcomes of a tick are one integer with a bit for each of its
    messages, 1 if it arrives, instead of a delay for each; only if no message takes time. Where
    nodes transmit after their samples, these are those of ``instants``; where they move, they are
    where the ``truth`` of the run says. The ``lives`` are those of a single run.
    """

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        bits: bool = False,
        instants: Instants | None = None,
        truth: Any = None,
        lives: LifeTable = NO_LIVES,
    ) -> None:
        senders, channel = senders_of(scenario), scenario.network.channel
        self._runs, sizes = streams.runs, np.diff(senders.first)
        listed = _list_ticks(scenario, streams, senders, instants, lives)
        if listed is None:
            rates = _rates(scenario)
        else:
            numbers = np.array([len(t) for t in listed], dtype=np.int64).reshape(self._runs, -1)
            rates = numbers.mean(axis=0) / scenario.horizon
        self._moving: MovingLinks | None = None
        if scenario.links_move and listed is not None:
            self._moving = moving_links(scenario, senders, listed, truth, lives.is_down)
        delivery, outcomes = np.ones((2, len(senders.directions))), []
        first: list[Transmission] = []
        if draws_in_kernels(scenario.network) and self._moving is None:
            delivery, first = _law_of_messages(scenario)
        elif listed is not None:
            heard = self._moving
            if scenario.network.lives and heard is None:
                heard = links_of_lives(senders, listed, lives, scenario.topology.index)
            outcomes = list_outcomes(scenario, streams, senders, listed, heard)
        # The laws of a user's clock are its own.
        clock = scenario.network.activation if listed is None else None
        purposes = "clock", "phase"
        clocks = clocks_of(
            clock, senders.entities, rates, streams, purposes, scenario.time_grid.per_second
        )._replace(first=senders.first, outgoing=senders.outgoing)
        self._clocks = clocks if listed is None else _listed_clocks(clocks, listed)
        self._channels = channel_streams(channel, streams, senders, delivery, bits, outcomes, first)
        self._demand = partial(
            demand_probabilities, channel.loss, self._channels, senders.directions
        )
        start_clocks(self._clocks, ziggurat(), normal_ziggurat())
        self._rate = float(rates.sum())
        # Mean number of messages for each tick.
        self._sends = float(rates @ sizes) / self._rate if self._rate > 0.0 else 0.0
        self._max_sends = int(sizes.max(initial=0))
        self._horizon, self._length = scenario.horizon, math.inf
        self._instant = scenario.time_grid.instant
        # Ticks are numbered through the run where links are looked at.
        if self._rate > 0.0 and self._moving is None:
            entities = len(senders.entities)
            # A window of some thousand ticks, more of them where there are many links.
            self._length = (
                max(TICKS, min(MIN_TICKS_PER_ENTITY * entities, MAX_WINDOW_TICKS)) / self._rate
            )
        self._end, self._buffer = 0.0, _empty_buffer(0, 0)

    def following(self) -> TickArrays:
        """Return a run's next window, sorted by (time, entity); the last ends at infinity."""
        begin, end = self._end, self._instant(self._end + self._length)
        # The last window has no end, so that the loop asks for no other.
        if not begin < end < self._horizon:
            end = math.inf
        self._end = end
        last, counts = min(end, self._horizon), np.zeros(2, dtype=np.int64)
        # Space for the mean plus eight standard deviations of a Poisson count is nearly always
        # enough.
        ticks = _space_for_count(self._rate * (last - begin), 8.0)
        sends = int(self._sends * ticks) + self._max_sends
        while True:
            self._enlarge_buffer(ticks, sends)
            if draw_ticks(self._clocks, self._channels, 0, last, self._buffer, counts):
                break
            # The ticks so far stay in the buffer: the kernel continues where it stopped.
            ticks, sends = 2 * ticks, 2 * sends
        self._demand()
        count = int(counts[0])
        ordered = _empty_buffer(count, 0)._replace(delay=self._buffer.delay[: counts[1]].copy())
        if self._clocks.crowds:
            merge_in_time_order(count, self._buffer, ordered, _sorting(count))
        else:
            put_in_time_order(begin, last, count, self._buffer, ordered, _sorting(count))
        moving = self._moving or NO_LINKS
        return TickArrays(
            **ordered._asdict(),
            end=end,
            arrival_bits=np.zeros(count, dtype=np.int64),
            owner=moving.owner,
            link=moving.link,
        )

    def all(self) -> AllTicks:
        """Return all ticks of all R runs up to the horizon, one run after the other."""
        clocks, channels = self._clocks, self._channels
        states: list[np.ndarray] = [clocks.next_tick, clocks.number, clocks.streams]
        states += [channels.loss, channels.state, channels.delay, channels.bad, channels.following]
        states += [channels.delivery_laws.sent]
        # Copies of the streams: an attempt that runs out of space starts again from them.
        copies = [state.copy() for state in states]
        # Space for the mean plus eight standard deviations of a Poisson count; in the rare case of
        # more ticks the loop tries again with more space.
        expected, spread = self._rate * self._horizon, 8.0
        while True:
            max_ticks = _space_for_count(expected, spread)
            total = _space_for_count(self._runs * expected, spread) + max_ticks
            first, first_delay = (np.zeros(self._runs + 1, dtype=np.int64) for _ in range(2))
            buffer = self._space(max_ticks)
            ticks = AllTicks(*self._space(total), first, first_delay, self._channels.bits)
            scratch = buffer, np.zeros(2, dtype=np.int64), _sorting(max_ticks)
            if draw_all_ticks(clocks, channels, self._horizon, *scratch, ticks):
                self._demand()
                return ticks
            spread *= 2.0
            for state, copy in zip(states, copies, strict=True):
                state[:] = copy

    def _space(self, ticks: int) -> TickBuffer:
        sends = 0.0 if self._channels.bits else self._sends
        return _empty_buffer(ticks, int(sends * ticks) + self._max_sends)

    def _enlarge_buffer(self, ticks: int, sends: int) -> None:
        if len(self._buffer.t) >= ticks and len(self._buffer.delay) >= sends:
            return
        larger = _empty_buffer(ticks, sends)
        for target, source in zip(larger, self._buffer, strict=True):
            size = min(len(source), len(target))
            target[:size] = source[:size]
        self._buffer = larger


def _space_for_count(expected: float, deviations: float) -> int:
    return int(expected + deviations * math.sqrt(expected)) + 8


def _empty_buffer(ticks: int, sends: int) -> TickBuffer:
    entity, first_outcome = (np.empty(ticks, dtype=np.int64) for _ in range(2))
    return TickBuffer(np.empty(ticks), entity, first_outcome, np.empty(sends))
