"""Events of runs whose messages take no time, before any filter moves: see ``visits``.

The order of events, their rows and what stops the loop are those of ``event_loop``. Ticks are those
of Poisson clocks, no two of which are at one time: all that is sent at a time is absorbed before
anything else happens.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from netkf.engines.compiled.batch_loop import BatchArrays, begin, finish, no_batch, reset_filters
from netkf.engines.compiled.event_loop import (
    ABSORB,
    DELIVER,
    DONE,
    GO_ON,
    LOST,
    NEVER,
    ON_PROBE,
    ON_SENSE,
    ON_TICK,
    SEND,
    TICK,
    TRANSMIT,
    WANT_REBASE,
    WANT_SHOWN,
    next_event,
    next_of,
    next_tick,
    note,
    note_age,
    note_sample,
    on_sense,
    wanted_first,
)
from netkf.engines.compiled.message_queue import sort_places
from netkf.engines.compiled.schedule import delay_is_zero
from netkf.engines.compiled.senders import senders_of
from netkf.engines.compiled.state import LINKS, NODES, Simulation
from netkf.engines.compiled.visits import (
    MOST_VISITS,
    Visits,
    add_visit,
    make_visits,
    show_later,
    visit_one,
)
from netkf.linalg.arrays import IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import struct_at
from netkf.network.clocks import Poisson
from netkf.scenario.scenario import Scenario

PAUSE, FULL = -1, -2
"""Why the agenda stopped, beside WANT_...: the time it goes to, or no space for visits."""

MOST_WAYS = 62
"""Directed links that one clock sends on, each of which is a bit."""

MOST_PLACES = 200
"""Filters that are simulated together, unless one run has more."""

_POSITIONS = (
    "tick_at",
    "ticks_stop",
    "delays",
    "piece",
    "grid_at",
    "wake_at",
    "probe_at",
    "samples",
)
PROGRESS = np.dtype([(name, np.int64) for name in _POSITIONS])
"""Where one of several runs stands, see Simulation."""


def is_immediate(scenario: Scenario) -> bool:
    """Return True if a scenario's runs can be simulated so: convex combinations of messages that
    take no time, by Poisson clocks, and no samples.
    """
    hosted, network = scenario.hosted, scenario.network
    return (
        hosted.combination == "convex"
        and hosted.talks
        and not scenario.sampled_sensors
        and type(network.activation) is Poisson
        and delay_is_zero(network.channel)
        and getattr(hosted, "max_age", math.inf) >= 0.0
        and int(np.diff(senders_of(scenario).first).max(initial=0)) <= MOST_WAYS
    )


def together(nodes: int, runs: int) -> int:
    """Return how many of several runs are simulated together."""
    return max(1, min(runs, MOST_PLACES // nodes))


def pause_of(state: Simulation, ticks: int, count: int) -> float:
    """Return after how many seconds ``count`` runs of so many ``ticks`` make their visits."""
    nodes = len(state.nodes)
    each = ticks + len(state.path.grid) * len(state.sensing.host) + nodes * len(state.probes)
    # Some visits less than there is space for.
    return state.horizon * 0.7 * MOST_VISITS / max(1.0, count * each)


def simulate_together(state: Simulation, visits: Visits, batch: BatchArrays, group: int) -> None:
    """Simulate all runs of a batch, ``group`` of them at a time."""
    ticks = int(batch.first[-1]) // len(batch.lengths)
    pause, progress = pause_of(state, ticks, group), np.zeros(group, dtype=PROGRESS)
    simulate_agenda(state, visits.memory, batch.memory, progress, pause)


def advance_alone(state: Simulation, visits: Visits) -> int:
    """Simulate one run until it needs something from Python; returns what (WANT_... or DONE)."""
    return int(simulate_agenda(state, visits.memory, no_batch().memory, _no_progress(), math.inf))


@cache
def _no_progress() -> np.ndarray:
    return np.zeros(0, dtype=PROGRESS)


@kernel
def simulate_agenda(
    state: Simulation,
    visits_memory: IntArray,
    batch_memory: IntArray,
    progress: np.ndarray,
    pause: float,
) -> int:
    """Simulate a batch, as many runs together as there is ``progress`` for, which make their visits
    every ``pause`` seconds; without any, one run until it needs something from Python.
    """
    visits = struct_at(visits_memory, Visits)
    if len(progress) == 0:
        if state.tick_at == 0:
            fill_heard(state, 0, state.ticks_stop, 0)
        wanted = follow(state, visits, NEVER)
        make_visits(state, visits)
        return wanted
    batch = struct_at(batch_memory, BatchArrays)
    runs = len(batch.lengths)
    for run in range(0 if batch.heard else runs):
        fill_heard(state, batch.first[run], batch.first[run + 1], batch.first_delay[run])
    for first in range(0, runs, len(progress)):
        simulate_group(
            state, visits, batch, progress[: min(len(progress), runs - first)], first, pause
        )
    return DONE


@kernel
def simulate_group(
    state: Simulation,
    visits: Visits,
    batch: BatchArrays,
    progress: np.ndarray,
    first: int,
    pause: float,
) -> None:
    """Simulate the runs from ``first`` on that there is progress for."""
    state.first_run = first
    for k in range(len(progress)):
        reset_filters(state, batch, k * len(state.nodes))
        begin(state, batch, first + k)
        suspend(state, batch, progress, k)
    until, going = pause, True
    while going:
        going = False
        for k in range(len(progress)):
            resume(state, batch, progress, k)
            going = follow(state, visits, until) != DONE or going
            suspend(state, batch, progress, k)
        make_visits(state, visits)
        until += pause
    for k in range(len(progress)):
        resume(state, batch, progress, k)
        finish(state, batch, first + k)


@kernel
def suspend(state: Simulation, batch: BatchArrays, progress: np.ndarray, k: int) -> None:
    """Keep where a run stands."""
    mine = progress[k]
    mine.tick_at, mine.ticks_stop, mine.delays = state.tick_at, state.ticks_stop, state.delays
    mine.piece, mine.grid_at, mine.wake_at = state.piece, state.grid_at, state.wake_at
    mine.probe_at, mine.samples = state.probe_at, state.samples
    for kind in range(len(state.counts)):
        batch.counts[state.run, kind] = state.counts[kind]


@kernel
def resume(state: Simulation, batch: BatchArrays, progress: np.ndarray, k: int) -> None:
    """Go on with a run."""
    mine = progress[k]
    state.tick_at, state.ticks_stop, state.delays = mine.tick_at, mine.ticks_stop, mine.delays
    state.piece, state.grid_at, state.wake_at = mine.piece, mine.grid_at, mine.wake_at
    state.probe_at, state.samples = mine.probe_at, mine.samples
    state.run = state.first_run + k
    for kind in range(len(state.counts)):
        state.counts[kind] = batch.counts[state.run, kind]


@kernel
def follow(state: Simulation, visits: Visits, until: float) -> int:
    """Follow the agenda of a run up to a time; makes visits where there are too many."""
    wanted = FULL
    # A batch has space for all of its samples: it stops behind the last one only.
    while wanted == FULL or (wanted == WANT_SHOWN and until < NEVER):
        wanted = agenda(state, visits, until)
        if wanted == FULL:
            make_visits(state, visits)
    return wanted


@kernel
def agenda(state: Simulation, visits: Visits, until: float) -> int:
    """Go through the events of a run before a time and leave visits; returns why it stops."""
    nodes = len(state.nodes)
    first, most = (state.run - state.first_run) * nodes, nodes + 2 + state.most_messages
    while True:
        event, now = next_event(state)
        wanted = wanted_first(state, None, event, now)
        if wanted != GO_ON:
            return wanted
        if now >= until:
            return PAUSE
        if visits.count + most > len(visits.records):
            return FULL
        while state.path.stop[state.piece] < now:
            state.piece += 1
        if event == ON_TICK:
            on_ticks_at_once(state, visits, first, min(until, next_but_ticks(state)))
        elif event == ON_SENSE:
            visit_one(state, visits, now, first + state.sensing.host[state.wake_at])
            on_sense(state, now)
        else:
            for h in range(nodes):
                visit_one(state, visits, now, first + h)
            if event != ON_PROBE:
                return WANT_REBASE
            show_later(state, visits, first)
            if not note_sample(state):
                return WANT_SHOWN


@kernel
def next_but_ticks(state: Simulation) -> float:
    """Time of the next event that is no tick, or of the end of a piece of the path or a window."""
    path, ticks = state.path, state.ticks
    event = min(next_of(state.frames, state.frame_at), next_of(path.grid, state.grid_at))
    event = min(event, next_of(state.probes, state.probe_at))
    return float(min(event, path.stop[state.piece], ticks.end))


@kernel
def on_ticks_at_once(state: Simulation, visits: Visits, first: int, until: float) -> None:
    """All ticks before ``until``, one at least, as long as there is space for what they leave."""
    ticks, space = state.ticks, len(visits.records) - 2 - state.most_messages
    on_tick_at_once(state, visits, first, ticks.t[state.tick_at])
    # Rows of a trace may need more space: they are looked at one tick at a time.
    while not state.traced and next_tick(state) < until and visits.count < space:
        on_tick_at_once(state, visits, first, ticks.t[state.tick_at])


@kernel
def on_tick_at_once(state: Simulation, visits: Visits, first: int, now: float) -> None:
    """A clock ticks, and what is sent arrives and is absorbed."""
    ticks, nodes, k = state.ticks, state.nodes, state.tick_at
    entity, heard = state.entities[ticks.entity[k]], ticks.heard[k]
    state.tick_at += 1
    if state.traced:
        note_tick(state, entity.sender, entity.other, entity.first, entity.after, heard, now)
    else:
        count_tick(state, entity.after - entity.first, heard)
    if heard != 0:
        add_pairs(state, visits, k, first, now)
        return
    # The sender of a message that is lost needs no prediction, unless it reads increments.
    if nodes[entity.sender].sensors > nodes[entity.sender].sensor:
        visit_one(state, visits, now, first + entity.sender)
    if state.at == LINKS and nodes[entity.other].sensors > nodes[entity.other].sensor:
        visit_one(state, visits, now, first + entity.other)


@kernel
def count_tick(state: Simulation, sent: int, heard: int) -> None:
    """Count what ``note_tick`` notes."""
    arrived = 0
    while heard != 0:
        arrived, heard = arrived + 1, heard & (heard - 1)
    counts = state.counts
    counts[TICK] += 1
    counts[TRANSMIT] += state.at >= NODES
    counts[SEND] += sent
    counts[LOST] += sent - arrived
    counts[DELIVER] += arrived
    counts[ABSORB] += arrived


@kernel
def note_tick(
    state: Simulation, i: int, j: int, begin: int, after: int, heard: int, now: float
) -> None:
    """Note a tick of node i (and j), its messages on the links ``hearing`` from ``begin`` up to
    ``after``, of which some are ``heard``, and who absorbs them.
    """
    nodes, receivers = state.nodes, 0
    note(state, now, TICK, nodes[i].id, nodes[j].id if j >= 0 else -1, -1)
    # A node's clock makes one transmission, which each receiver hears or loses.
    if state.at >= NODES:
        note(state, now, TRANSMIT, nodes[i].id, -1, nodes[i].sent)
        nodes[i].sent += 1
    for m in range(begin, after):
        way = state.ways[state.hearing[m]]
        number, one, other = way.messages, nodes[way.sender].id, nodes[way.receiver].id
        way.messages += 1
        note(state, now, SEND, one, other, number)
        if (heard >> (m - begin)) & 1:
            note_age(state, now, DELIVER, other, one, number, 0.0)
            state.waiting[receivers] = way.receiver
            receivers += 1
        else:
            note(state, now, LOST, one, other, number)
    sort_places(state.waiting, receivers)
    for m in range(receivers):
        note_age(state, now, ABSORB, nodes[state.waiting[m]].id, -1, -1, 0.0)


@kernel
def add_pairs(state: Simulation, visits: Visits, k: int, first: int, now: float) -> None:
    """Add the visits of a tick of which something is heard: of both ends of a link together, and
    else of the sender with each that hears it.
    """
    heard, ways, hearing = state.ticks.heard[k], state.ways, state.hearing
    entity = state.entities[state.ticks.entity[k]]
    sender, begin = first + entity.sender, entity.first
    if state.at == LINKS:
        # Both ends are predicted, whoever hears.
        other = first + entity.other
        level = max(visits.level[sender], visits.level[other]) + 1
        visits.level[sender] = visits.level[other] = level
        v = add_visit(state, visits, level, now, sender, other)
        for m in range(entity.after - begin):
            if (heard >> m) & 1:
                hear(
                    visits,
                    v,
                    ways[hearing[begin + m]].receiver + first == sender,
                    hearing[begin + m],
                )
        return
    level = visits.level[sender]
    for m in range(entity.after - begin):
        if (heard >> m) & 1:
            level = max(level, visits.level[first + ways[hearing[begin + m]].receiver])
    level += 1
    visits.level[sender] = level
    for m in range(entity.after - begin):
        if (heard >> m) & 1:
            receiver = first + ways[hearing[begin + m]].receiver
            visits.level[receiver] = level
            v = add_visit(state, visits, level, now, sender, receiver)
            hear(visits, v, False, hearing[begin + m])


@kernel
def hear(visits: Visits, v: int, first: bool, way: int) -> None:
    """The ``first`` node of a visit, or the second, hears the other on a directed link."""
    if first:
        visits.records[v].to_first = way
    else:
        visits.records[v].to_second = way


@kernel
def fill_heard(state: Simulation, first: int, after: int, delays: int) -> None:
    """Find out which messages of the ticks from ``first`` up to ``after`` arrive; their outcomes
    are those from ``delays`` on.
    """
    ticks, entities = state.ticks, state.entities
    for k in range(first, after):
        entity = entities[ticks.entity[k]]
        begin, bits = delays + ticks.at[k], 0
        for m in range(entity.after - entity.first):
            # ``>=`` is false for LOST, which is negative, and for nan.
            if ticks.delay[begin + m] >= 0.0:
                bits |= 1 << m
        ticks.heard[k] = bits
