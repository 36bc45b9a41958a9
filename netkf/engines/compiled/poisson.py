"""Schedules of Poisson clocks, drawn and sorted in compiled code, if each directed link has a
constant delivery probability and all messages have one delay.

The ticks of all clocks together are a Poisson process, evenly spread over a window. So they are
sorted by counting: a window is divided into as many bins as it has ticks, of about one tick each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.core.instants import snapped
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.schedule import (
    LOST,
    MAX_WINDOW_TICKS,
    Schedule,
    Window,
    all_windows,
    delivery_probabilities_of,
    has_table_law,
)
from netkf.engines.compiled.senders import Senders, senders_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.network.clocks import LinkClock, Poisson
from netkf.rng.draws import StreamBatch, Ziggurat, next_exponential, next_unit, ziggurat
from netkf.rng.streams import WIDTH, ReplicaStreams, Streams
from netkf.scenario.scenario import Scenario

TICKS, MIN_TICKS_PER_ENTITY = 1 << 15, 4
"""Ticks in a window: TICKS, whose arrays fit the processor's cache, or, if these are more,
MIN_TICKS_PER_ENTITY for each entity, since each has a fixed cost in a window; at most
MAX_WINDOW_TICKS.
"""


class PoissonClocks(NamedTuple):
    """The Poisson clocks of R runs, E entities in all, and the loss model of their messages.

    next_tick : (E,), time of the next tick, seconds, not on the grid yet
    rate : (E,), ticks per second
    tick_streams : (E, WIDTH), states of the random streams of ticks
    loss_streams : (S, WIDTH), states of the random streams of losses; S = 0: no message is lost
    streams_per_run : number of loss streams of each run
    first, outgoing : entity e of a run sends on the directions ``outgoing[first[e]:first[e + 1]]``
    source : (W,), loss stream of each direction, within a run
    delivery_probability : (W,), of the messages of each direction
    bits : whether outcomes are stored as arrival bits, see TickBuffer
    per_second : ticks of the time grid in a second (core.instants)
    """

    next_tick: FloatArray
    rate: FloatArray
    tick_streams: np.ndarray
    loss_streams: np.ndarray
    streams_per_run: int
    first: np.ndarray
    outgoing: np.ndarray
    source: np.ndarray
    delivery_probability: FloatArray
    bits: bool
    per_second: float


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
    clocks: PoissonClocks,
    run: int,
    end: float,
    delay: float,
    exponential: Ziggurat,
    buffer: TickBuffer,
    counts: np.ndarray,
) -> bool:
    """Append the ticks before ``end`` (seconds) of all entities (links, directions or nodes with a
    clock) of run number ``run`` to ``buffer``, with their outcomes; messages that arrive take
    ``delay`` seconds. ``counts`` (2,) are the numbers of ticks and outcomes in the buffer; advances
    these, ``clocks.next_tick`` and the streams. Return False if the buffer is full before; a call
    with a larger one then goes on.
    """
    # Entity by entity, each from its own stream; put_in_time_order() sorts them afterwards.
    for e in range(len(clocks.first) - 1):
        if not draw_ticks_of(clocks, run, e, end, delay, exponential, buffer, counts):
            return False
    return True


@kernel
def draw_ticks_of(
    clocks: PoissonClocks,
    run: int,
    e: int,
    end: float,
    delay: float,
    exponential: Ziggurat,
    buffer: TickBuffer,
    counts: np.ndarray,
) -> bool:
    """Append the ticks before ``end`` (seconds) of entity ``e`` (index within a run of a link,
    direction or node with a clock) of run number ``run`` to ``buffer``, with their outcomes;
    messages that arrive take ``delay`` seconds. Advances ``counts`` (2,), the numbers of ticks and
    outcomes in the buffer, the entity's ``clocks.next_tick`` and its stream. Return False if the
    buffer is full before.
    """
    states, first, after = clocks.tick_streams, clocks.first[e], clocks.first[e + 1]
    # Index over all runs. ``high`` and ``low`` are the two words of the stream's state.
    k = run * (len(clocks.first) - 1) + e
    now, rate = clocks.next_tick[k], clocks.rate[k]
    m, max_outcomes, complete = counts[0], len(buffer.delay) - (after - first), True
    instant = snapped(now, clocks.per_second)
    while instant < end:
        # Check the space before a tick is drawn: after an enlargement drawing goes on with this
        # tick.
        if m == len(buffer.t) or counts[1] > max_outcomes:
            complete = False
            break
        buffer.t[m], buffer.entity[m] = instant, e
        buffer.first_outcome[m] = draw_outcomes(clocks, run, first, after, delay, buffer, counts)
        m += 1
        # The next tick is drawn now: it may lie in the next window.
        now += next_exponential(states, k, exponential) / rate
        instant = snapped(now, clocks.per_second)
    clocks.next_tick[k], counts[0] = now, m
    return complete


@kernel(inlined=True)
def draw_outcomes(
    clocks: PoissonClocks,
    run: int,
    first: int,
    after: int,
    delay: float,
    buffer: TickBuffer,
    counts: np.ndarray,
) -> int:
    """Draw which messages of a tick arrive in run number ``run``, on the directed links
    ``outgoing[first:after]``, and append their delays (``delay`` seconds or LOST) to
    ``buffer.delay`` at ``counts[1]``, which advances. Return the ``first_outcome`` of the tick:
    where its outcomes begin, or, with ``clocks.bits``, a bit for each message that arrives instead
    of outcomes.
    """
    outcome, uniform, last_source = 0 if clocks.bits else counts[1], 0.0, -1
    # One uniform number for each loss stream: directions that share a stream are neighbours.
    for m in range(first, after):
        w = clocks.outgoing[m]
        if clocks.streams_per_run > 0 and clocks.source[w] != last_source:
            last_source = clocks.source[w]
            # The uniform number is below 1, so that a link with probability 1 loses nothing.
            uniform = next_unit(clocks.loss_streams, run * clocks.streams_per_run + last_source)
        arrives = uniform < clocks.delivery_probability[w]
        if clocks.bits:
            outcome |= np.int64(arrives) << (m - first)
        else:
            buffer.delay[counts[1]] = delay if arrives else LOST
            counts[1] += 1
    return outcome


class Sorting(NamedTuple):
    """Scratch to sort K ticks: position of the next tick of each bin, ``place`` (K + 1,), and the
    index of the tick at each position, ``source`` (K,). Int32 halves their size in the cache.
    """

    place: np.ndarray
    source: np.ndarray


def _sorting(ticks: int) -> Sorting:
    """Return scratch to sort K = ``ticks`` ticks."""
    return Sorting(np.empty(ticks + 1, dtype=np.int32), np.empty(ticks, dtype=np.int32))


@kernel
def put_in_time_order(
    begin: float, end: float, count: int, buffer: TickBuffer, ordered: TickBuffer, sorting: Sorting
) -> None:
    """Sort the first ``count`` ticks of ``buffer``, which lie in [begin, end) seconds and were
    drawn entity by entity, by (time, entity), the order in which they happen: write them into
    ``ordered``. Outcomes stay where they are. ``sorting`` is scratch.
    """
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
    """Return the index (0 to ``count`` - 1) of the bin that ``time`` lies in, of ``count`` bins
    from ``begin`` (seconds) on, ``scale`` of them per second.
    """
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
    clocks: PoissonClocks,
    horizon: float,
    delay: float,
    exponential: Ziggurat,
    buffer: TickBuffer,
    counts: np.ndarray,
    sorting: Sorting,
    ticks: AllTicks,
) -> bool:
    """Draw the ticks of all R runs up to the ``horizon`` (seconds) into ``ticks``, run after run,
    sorted by (time, entity) in each run; messages that arrive take ``delay`` seconds. ``buffer``,
    ``counts`` (2,) and ``sorting`` are scratch. Advances the streams of ``clocks``. Return False if
    an array is too small: the caller restores the streams and starts again with more space.
    """
    for run in range(len(ticks.first) - 1):
        counts[0] = counts[1] = 0
        if not draw_ticks(clocks, run, horizon, delay, exponential, buffer, counts):
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
        put_in_time_order(0.0, horizon, counts[0], buffer, ordered, sorting)
        # ``first_outcome`` counts within the run, so that outcomes are copied as they are.
        for k in range(counts[1]):
            ticks.delay[begin + k] = buffer.delay[k]
        ticks.first[run + 1], ticks.first_delay[run + 1] = last, end
    return True


def is_poisson(scenario: Scenario) -> bool:
    """Return True if kernels can draw the schedules of a scenario: Poisson clocks,
    constant laws.
    """
    network = scenario.network
    talks = scenario.node_filter.talks and bool(scenario.topology.links)
    return talks and type(network.activation) is Poisson and has_table_law(network.channel)


@once_per_scenario
def _rates_and_probabilities(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Return what the ticks of all runs are drawn by: ticks per second (E,) of each of E entities,
    the links or nodes that have a clock of their own, and the delivery probability (W,) of each of
    W directed links.
    """
    clock, senders = scenario.network.activation, senders_of(scenario)
    assert isinstance(clock, LinkClock)
    rates = np.array([clock.mean_rate(entity) for entity in senders.entities])
    return rates, delivery_probabilities_of(scenario, senders.directions)


class PoissonSchedules:
    """The ticks of some runs of a scenario with Poisson clocks, and which of their messages arrive:
    window by window, or all at once.
    """

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams | ReplicaStreams,
        senders: Senders | None = None,
        bits: bool = False,
    ) -> None:
        """Seed the streams of ticks and losses of all runs, and draw the first tick of each entity
        (a node, link or direction that has a clock).

        streams : random streams of one run or of several
        senders : the entities and the directions that each sends on; by default the scenario's
        bits    : whether the outcomes of a tick are one integer with a bit for each of its
                  messages, 1 if it arrives, instead of a delay for each; only if no message takes
                  time
        """
        runs = streams.runs
        senders = senders_of(scenario) if senders is None else senders
        ticks, count = StreamBatch(streams, "clock", senders.entities), len(senders.entities) * runs
        # Without random losses no streams: draw_ticks() then draws no uniform numbers.
        losses: np.ndarray = np.empty((0, WIDTH), dtype=np.uint64)
        if not scenario.network.channel.loss.deterministic:
            losses = streams.states("loss", senders.sources)
        rates, probabilities = _rates_and_probabilities(scenario)
        self._clocks = PoissonClocks(
            next_tick=ticks.exponentials(np.arange(count), np.ones(count, dtype=np.int64)),
            rate=np.tile(rates, runs),
            tick_streams=ticks.states,
            loss_streams=losses,
            streams_per_run=len(losses) // runs,
            first=senders.first,
            outgoing=senders.outgoing,
            source=senders.source,
            delivery_probability=probabilities,
            bits=bits,
            per_second=scenario.time_grid.per_second,
        )
        # The first tick of each entity, unit exponentials over its rate.
        self._clocks.next_tick[:] /= self._clocks.rate
        self._runs, self._rate = runs, float(rates.sum())
        # Mean number of messages for each tick.
        self._sends = float(rates @ np.diff(senders.first)) / self._rate
        self._max_sends = int(np.diff(senders.first).max())
        self._delay = float(scenario.network.channel.delay.fixed or 0.0)
        self._horizon, self._length = scenario.horizon, math.inf
        self._instant = scenario.time_grid.instant
        if self._rate > 0.0:
            entities = len(senders.entities)
            # A window of some thousand ticks, more of them where there are many links.
            self._length = (
                max(TICKS, min(MIN_TICKS_PER_ENTITY * entities, MAX_WINDOW_TICKS)) / self._rate
            )
        self._end, self._buffer = 0.0, _empty_buffer(0, 0)

    def following(self) -> Window:
        """Return the next window of the ticks of one run; the last one ends at infinity."""
        begin, end = self._end, self._instant(self._end + self._length)
        # The last window has no end, so that the loop asks for no other.
        if not begin < end < self._horizon:
            end = math.inf
        self._end = end
        return self._window(0, begin, end)

    def all(self) -> AllTicks:
        """Return all ticks of all R runs up to the horizon, one run after the other, for batches of
        runs.
        """
        states = self._clocks.next_tick, self._clocks.tick_streams, self._clocks.loss_streams
        # Copies of the streams: an attempt that runs out of space starts again from them.
        copies = [state.copy() for state in states]
        # Space for the mean plus eight standard deviations of a Poisson count; in the rare case of
        # more ticks the loop tries again with more space.
        expected, spread = self._rate * self._horizon, 8.0
        while True:
            max_ticks = _space_for_count(expected, spread)
            total = _space_for_count(self._runs * expected, spread) + max_ticks
            buffer, ticks = self._space(max_ticks), self._space_for_all(total)
            scratch = buffer, np.zeros(2, dtype=np.int64), _sorting(max_ticks)
            arguments = self._clocks, self._horizon, self._delay, ziggurat()
            if draw_all_ticks(*arguments, *scratch, ticks):
                return ticks
            spread *= 2.0
            for state, copy in zip(states, copies, strict=True):
                state[:] = copy

    def _space(self, ticks: int) -> TickBuffer:
        """Return space for ``ticks`` ticks and the outcomes of about as many messages as they
        send.
        """
        sends = 0.0 if self._clocks.bits else self._sends
        return _empty_buffer(ticks, int(sends * ticks) + self._max_sends)

    def _space_for_all(self, ticks: int) -> AllTicks:
        """Return space for ``ticks`` ticks of all R runs together, and the outcomes of their
        messages.
        """
        t, entity, first_outcome, delay = self._space(ticks)
        first, first_delay = (np.zeros(self._runs + 1, dtype=np.int64) for _ in range(2))
        return AllTicks(t, entity, first_outcome, delay, first, first_delay, self._clocks.bits)

    def _window(self, run: int, begin: float, end: float) -> Window:
        """Draw and return the ticks of run number ``run`` in [begin, end) seconds, in the order of
        time. The buffer into which they are drawn is enlarged until all of them fit.
        """
        last, counts = min(end, self._horizon), np.zeros(2, dtype=np.int64)
        # Space for the mean plus eight standard deviations of a Poisson count is nearly always
        # enough.
        expected = self._rate * (last - begin)
        ticks = _space_for_count(expected, 8.0)
        sends = int(self._sends * ticks) + self._max_sends
        while True:
            self._enlarge_buffer(ticks, sends)
            if draw_ticks(self._clocks, run, last, self._delay, ziggurat(), self._buffer, counts):
                break
            # The ticks so far stay in the buffer: the kernel continues where it stopped.
            ticks, sends = 2 * ticks, 2 * sends
        count = int(counts[0])
        ordered = _empty_buffer(count, 0)._replace(delay=self._buffer.delay[: counts[1]].copy())
        put_in_time_order(begin, last, count, self._buffer, ordered, _sorting(count))
        return Window(end, *ordered)

    def _enlarge_buffer(self, ticks: int, sends: int) -> None:
        """Make the buffer large enough for ``ticks`` ticks and ``sends`` outcomes, keeping its
        contents; it never shrinks.
        """
        if len(self._buffer.t) >= ticks and len(self._buffer.delay) >= sends:
            return
        larger = _empty_buffer(ticks, sends)
        for target, source in zip(larger, self._buffer, strict=True):
            size = min(len(source), len(target))
            target[:size] = source[:size]
        self._buffer = larger


def _space_for_count(expected: float, deviations: float) -> int:
    """Return a number that a Poisson count with the mean ``expected`` hardly ever exceeds: so many
    standard ``deviations`` above the mean, and some more for small means.
    """
    return int(expected + deviations * math.sqrt(expected)) + 8


def _empty_buffer(ticks: int, sends: int) -> TickBuffer:
    """Return space for ``ticks`` ticks and ``sends`` outcomes."""
    entity, first_outcome = (np.empty(ticks, dtype=np.int64) for _ in range(2))
    return TickBuffer(np.empty(ticks), entity, first_outcome, np.empty(sends))


def all_ticks(scenario: Scenario, streams: ReplicaStreams, bits: bool = False) -> AllTicks:
    """Return all ticks of R runs up to the horizon, with their outcomes: the delay of each message,
    or LOST. ``bits``: with arrival bits (bit m is 1 if message m of a tick arrives) instead of
    outcomes, which is possible if clocks are Poisson and no message takes time.
    """
    if is_poisson(scenario):
        return PoissonSchedules(scenario, streams, bits=bits).all()
    # Any other clock or channel: windows drawn in Python, joined run after run.
    windows = all_windows(scenario, streams)
    first, first_delay = (
        np.cumsum([0, *(len(getattr(window, name)) for window in windows)])
        for name in ("t", "delay")
    )
    t, entity, first_outcome, delay = (
        np.concatenate([getattr(window, name) for window in windows])
        for name in ("t", "entity", "first_outcome", "delay")
    )
    return AllTicks(t, entity, first_outcome, delay, first, first_delay)


def window_of(ticks: AllTicks, run: int) -> Window:
    """Return all ticks of run number ``run`` (0 to R - 1) as a window without an end."""
    own, outcomes = (slice(*first[run : run + 2]) for first in (ticks.first, ticks.first_delay))
    return Window(
        end=math.inf,
        t=ticks.t[own],
        entity=ticks.entity[own],
        first_outcome=ticks.first_outcome[own],
        delay=ticks.delay[outcomes],
    )


def schedule(
    scenario: Scenario, streams: Streams, senders: Senders | None = None
) -> PoissonSchedules | Schedule:
    """Return the source of the windows of ticks of one run, drawn in compiled code if possible;
    ``senders`` defaults to those of the scenario.
    """
    cls = PoissonSchedules if is_poisson(scenario) else Schedule
    return cls(scenario, streams, senders)
