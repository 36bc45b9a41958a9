"""The event loop for messages that take no time: it queues visits of filters, see ``visits``.

The order of events, their rows and the requests are those of ``clock_loop``. Clocks are such that
no two ticks are at one time: all messages of a tick are absorbed before the next event.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.exchanges import exchanges_estimates
from netkf.algorithms.filter import compiled_kernels
from netkf.algorithms.records import Record
from netkf.engines.compiled.batch_arrays import (
    BatchArrays,
    begin_run,
    finish,
    no_batch,
    reset_filters,
)
from netkf.engines.compiled.events import (
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
    WANT_SAMPLES,
    count_sample,
    find_shortage,
    next_event,
    next_of,
    next_tick,
    on_sense,
    record_event,
    record_event_with_age,
    seek_piece,
)
from netkf.engines.compiled.message_queue import sort_indices
from netkf.engines.compiled.outcomes import delay_is_zero
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.senders import senders_of
from netkf.engines.compiled.state import LINKS, NODES, Simulation
from netkf.engines.compiled.ticks import ticks_apart
from netkf.engines.compiled.visits import (
    MAX_VISITS,
    Visits,
    append_visit,
    process_visits,
    queue_sample,
    queue_visit,
)
from netkf.linalg.addresses import address_of, call_at
from netkf.linalg.arrays import IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import struct_at
from netkf.scenario.scenario import Scenario

PAUSE, FULL = -1, -2
"""Why ``queue_events`` stopped, besides WANT_...: it reached its time, or the queue of visits is
full.
"""

MAX_LINKS_OF_CLOCK = 62
"""Directed links that one clock may send on: each of them has an arrival bit."""

MAX_FILTERS = 200
"""Filters that are simulated together at most, unless one run has more."""

_POSITIONS = (
    "tick_at", "ticks_stop", "first_delay", "piece", "grid_at", "wake_at", "probe_at", "samples",
)  # fmt: skip
PROGRESS = np.dtype([(name, np.int64) for name in _POSITIONS])
"""The position of a run that is interrupted, see Simulation."""

NO_PROGRESS = np.zeros(0, dtype=PROGRESS)
"""No records: ``simulate_agenda`` then simulates one run."""


@once_per_scenario
def is_immediate(scenario: Scenario) -> bool:
    """Return True if filters of a scenario can be simulated in SIMD lanes, as many nodes side by
    side as a vector register holds: exchanges of estimates alone, messages without delay, clocks
    that do not tick together, and no samples. Then no event depends on an estimate.
    """
    node_filter, network = scenario.node_filter, scenario.network
    kernels = compiled_kernels(node_filter, clocked=True)
    return (
        kernels is not None
        and node_filter.timing.talks
        and scenario.views is None
        and scenario.plant.linear
        and not scenario.links_move
        and not scenario.network.lives
        and not scenario.network.clocks
        and not scenario.sampled_sensors
        and not len(scenario.followed_changes)
        and ticks_apart(network.activation)
        and delay_is_zero(network.channel)
        and not scenario.messages_queue
        and scenario.network.quantise is None
        # A negative max_age makes even messages of age 0 too old.
        and node_filter.timing.max_age >= 0.0
        # Each message of a tick has a bit of one integer.
        and int(np.diff(senders_of(scenario).first).max(initial=0)) <= MAX_LINKS_OF_CLOCK
        and exchanges_estimates(kernels, _record_of(scenario))
    )


def _record_of(scenario: Scenario) -> Record:
    kernels, infos = scenario.node_filter.kernels, scenario.node_infos
    assert kernels is not None
    # That of the filter, also where it has other verbs under clocks.
    return kernels.record_of(scenario.node_filter, infos, scenario.model_pieces[0])


def together(nodes: int, runs: int) -> int:
    """Return how many of ``runs`` runs, each with ``nodes`` filters, are simulated together, so
    that their nodes fill the SIMD lanes: as many as have MAX_FILTERS filters in all, at least 1.
    """
    return max(1, min(runs, MAX_FILTERS // nodes))


def pause_of(state: Simulation, ticks: int, count: int) -> float:
    """Return the simulated seconds between two times at which ``count`` runs, with ``ticks`` ticks
    each, process their queued visits (predictions of one node, or of two that then combine): so
    long that the visits of all these runs fill most of the queue.
    """
    nodes = len(state.nodes)
    visits_per_run = (
        ticks + len(state.path.grid) * len(state.sensing.index) + nodes * len(state.probes)
    )
    # 30 % of the queue is a reserve, since visits are not evenly spread.
    return state.horizon * 0.7 * MAX_VISITS / max(1.0, count * visits_per_run)


def simulate_together(state: Simulation, visits: Visits, batch: BatchArrays, group: int) -> None:
    """Simulate all R runs of a batch up to the horizon, ``group`` of them at a time, whose nodes
    are computed side by side in SIMD lanes; the results are in ``batch`` and the samples in
    ``state.buffer``. ``visits`` is an empty queue, scratch space for ``group`` runs.
    """
    ticks = int(batch.first[-1]) // len(batch.lengths)
    pause, progress = pause_of(state, ticks, group), np.zeros(group, dtype=PROGRESS)
    visits.process = address_of(process_visits, state, visits)
    simulate_agenda(state.general, visits.memory, batch.memory, progress, pause)


def simulate_single_run(state: Simulation, visits: Visits) -> int:
    """Simulate one run until it needs something from Python; return the request (WANT_... or DONE).
    Changes ``state``, the run; ``visits`` is an empty queue, and empty again after the call.
    """
    visits.process = address_of(process_visits, state, visits)
    none = no_batch().memory
    return int(simulate_agenda(state.general, visits.memory, none, NO_PROGRESS, math.inf))


@kernel
def simulate_agenda(
    state: Simulation,
    visits_memory: IntArray,
    batch_memory: IntArray,
    progress: np.ndarray,
    pause: float,
) -> int:
    """Simulate the R runs of a batch, G = ``len(progress)`` of them together, which process their
    visits (predictions of one node, or of two that then combine) every ``pause`` seconds of
    simulated time. If ``progress`` is empty simulate one run until it needs something from Python.
    Return the request, DONE for a batch. Compiled once for all n, ``process_visits`` for each.

    ``visits_memory`` and ``batch_memory`` are the blocks of memory (int64 words) of a Visits and a
    BatchArrays, since numba dispatches on arrays faster than on structs; ``progress`` (G,) are
    PROGRESS records, scratch space.
    """
    visits = struct_at(visits_memory, Visits)
    if len(progress) == 0:
        # A new window of ticks, whose arrival bits are not filled in yet.
        if state.tick_at == 0:
            fill_arrival_bits(state, 0, state.ticks_stop, 0)
        request = run_agenda(state, visits, NEVER)
        call_at(visits.process, state, 0, visits)
        return request
    batch = struct_at(batch_memory, BatchArrays)
    runs = len(batch.lengths)
    for run in range(0 if batch.has_bits else runs):
        fill_arrival_bits(state, batch.first[run], batch.first[run + 1], batch.first_delay[run])
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
    """Simulate together the G runs ``first`` to ``first`` + G - 1 of a batch, one for each entry of
    ``progress`` (G,), and store their results in ``batch``. Node h of the k-th of these runs is in
    row k N + h of ``state.xhat``, ``root`` and ``now``. Every ``pause`` simulated seconds the
    queued visits, predictions of one node or of two that combine, are processed for all runs.
    """
    state.first_run = first
    for k in range(len(progress)):
        reset_filters(state, batch, k * len(state.nodes))
        begin_run(state, batch, first + k)
        suspend(state, batch, progress, k)
    # Each run in turn up to the same time; then the visits of all runs together.
    pauses, frame, running = 1, next_of(state.frames, 0), True
    while running:
        # All runs stop where their origins move.
        until, running = min(pauses * pause, frame), False
        for k in range(len(progress)):
            resume(state, batch, progress, k)
            running = run_agenda(state, visits, until) != DONE or running
            suspend(state, batch, progress, k)
        # Together, so that more visits are in one level and fill the lanes.
        call_at(visits.process, state, 0, visits)
        if until < frame:
            pauses += 1
        elif frame < NEVER:
            for k in range(len(progress)):
                resume(state, batch, progress, k)
                move_origin_of_run(state, visits, k * len(state.nodes), frame)
                suspend(state, batch, progress, k)
            state.frame_at += 1
            frame = next_of(state.frames, state.frame_at)
    for k in range(len(progress)):
        resume(state, batch, progress, k)
        finish(state, batch, first + k)


@kernel
def move_origin_of_run(state: Simulation, visits: Visits, first: int, now: float) -> None:
    """Predict all nodes of the present run to ``now`` (seconds), where a frame begins, and move the
    origin of their estimates to the true state. ``first``: the run's first row in ``state.xhat``.
    """
    seek_piece(state, now)
    for h in range(len(state.nodes)):
        if visits.count == len(visits.records):
            call_at(visits.process, state, 0, visits)
        queue_visit(state, visits, now, first + h)
    call_at(visits.process, state, 0, visits)
    x = state.path.x_stop[state.run, state.piece]
    for h in range(len(state.nodes)):
        for i in range(len(x)):
            state.xhat[first + h, i] -= x[i]


@kernel
def suspend(state: Simulation, batch: BatchArrays, progress: np.ndarray, k: int) -> None:
    """Store the position of the present run ``state.run``, the indices of its next tick, sample and
    so on, in entry ``k`` of ``progress`` (G,), so that another of the G runs simulated together can
    go on; and its numbers of events in row ``state.run`` of ``batch.counts``.
    """
    position = progress[k]
    position.tick_at, position.ticks_stop = state.tick_at, state.ticks_stop
    position.first_delay = state.first_delay
    position.piece, position.grid_at, position.wake_at = state.piece, state.grid_at, state.wake_at
    position.probe_at, position.samples = state.probe_at, state.samples
    for kind in range(len(state.counts)):
        batch.counts[state.run, kind] = state.counts[kind]


@kernel
def resume(state: Simulation, batch: BatchArrays, progress: np.ndarray, k: int) -> None:
    """Make run ``state.first_run`` + ``k`` the present one: restore its position, the indices of
    its next tick, sample and so on, in ``state`` from entry ``k`` of ``progress`` (G,), for G runs
    simulated together, and its numbers of events from ``batch.counts``.
    """
    position = progress[k]
    state.tick_at, state.ticks_stop = position.tick_at, position.ticks_stop
    state.first_delay = position.first_delay
    state.piece, state.grid_at, state.wake_at = position.piece, position.grid_at, position.wake_at
    state.probe_at, state.samples = position.probe_at, position.samples
    state.run = state.first_run + k
    for kind in range(len(state.counts)):
        state.counts[kind] = batch.counts[state.run, kind]


@kernel
def run_agenda(state: Simulation, visits: Visits, until: float) -> int:
    """Go through the events of the present run before ``until`` (seconds): queue visits,
    predictions of one node or of two that then combine, and process them whenever the queue is
    full. Return why it stopped (WANT_..., DONE or PAUSE). The last visits are still queued then.
    """
    request = FULL
    # A batch has space for all of its samples: WANT_SAMPLES comes after the last one and is
    # ignored.
    while request == FULL or (request == WANT_SAMPLES and until < NEVER):
        request = queue_events(state, visits, until)
        if request == FULL:
            call_at(visits.process, state, 0, visits)
    return request


@kernel
def queue_events(state: Simulation, visits: Visits, until: float) -> int:
    """Go through the events of the present run before ``until`` (seconds) and queue visits,
    predictions of one node or of two that then combine; return why it stopped (WANT_..., DONE,
    PAUSE or FULL). Moves the positions ``tick_at``, ``grid_at``, ... of ``state`` on.
    """
    # No event queues more visits: one for each node and a sample, or one for each receiver.
    nodes = len(state.nodes)
    first, max_visits = (state.run - state.first_run) * nodes, nodes + 2 + state.most_messages
    while True:
        event, now = next_event(state)
        request = find_shortage(state, now)
        if request != GO_ON:
            return request
        if now >= until:
            return PAUSE
        if visits.count + max_visits > len(visits.records):
            return FULL
        seek_piece(state, now)
        if event == ON_TICK:
            queue_ticks(state, visits, first, min(until, end_of_ticks(state)))
        elif event == ON_SENSE:
            queue_readings(state, visits, first, now)
        else:
            # A move of the origin or a sample: all nodes are predicted to it.
            for h in range(nodes):
                queue_visit(state, visits, now, first + h)
            if event != ON_PROBE:
                return WANT_REBASE
            queue_sample(state, visits, first)
            if not count_sample(state):
                return WANT_SAMPLES


@kernel
def queue_readings(state: Simulation, visits: Visits, first: int, now: float) -> None:
    """Queue the visits, predictions of nodes with increment sensors, of the next reading at
    ``now`` (seconds), a point of the sensing grid, and of the other nodes' readings at this point
    while the queue has space. ``first`` is the row of the run's first node in ``state.xhat``.
    """
    while True:
        queue_visit(state, visits, now, first + state.sensing.index[state.wake_at])
        on_sense(state, now)
        # ``wake_at`` is 0 again after the last node. A run with rows goes node by node, since each
        # event checks the space for its rows.
        if state.traced or state.wake_at == 0 or visits.count == len(visits.records):
            return


@kernel
def end_of_ticks(state: Simulation) -> float:
    """Return the time in seconds up to which only ticks happen, so that ``queue_ticks`` need not
    look for other events: that of the next other event, or the end of the present piece of the path
    or of the window of ticks, whichever comes first.
    """
    path, ticks = state.path, state.ticks
    event = min(next_of(state.frames, state.frame_at), next_of(path.grid, state.grid_at))
    event = min(event, next_of(state.probes, state.probe_at))
    return float(min(event, path.stop[state.piece], ticks.end))


@kernel
def queue_ticks(state: Simulation, visits: Visits, first: int, until: float) -> None:
    """Queue the visits (predictions of nodes that send or receive) of the next tick, and of all
    later ticks before ``until`` (seconds) while the queue has space. ``first`` is the row of the
    run's first node in ``state.xhat``.
    """
    ticks, space = state.ticks, len(visits.records) - 2 - state.most_messages
    queue_tick(state, visits, first, ticks.t[state.tick_at])
    # A run with rows goes tick by tick, since each tick checks the space for its rows.
    while not state.traced and next_tick(state) < until and visits.count < space:
        queue_tick(state, visits, first, ticks.t[state.tick_at])


@kernel
def queue_tick(state: Simulation, visits: Visits, first: int, now: float) -> None:
    """Queue the visits (predictions of nodes that send or receive) of the next tick, at ``now``
    (seconds); record or count its messages and their absorption, and advance ``state.tick_at``.
    ``first`` is the row of the run's first node in ``state.xhat``.
    """
    ticks, nodes, k = state.ticks, state.nodes, state.tick_at
    entity, bits = state.entities[ticks.entity[k]], ticks.arrival_bits[k]
    state.tick_at += 1
    if state.traced:
        record_tick(state, entity.sender, entity.other, entity.first, entity.after, bits, now)
    else:
        count_tick(state, entity.after - entity.first, bits)
    # Some message arrives: its sender and receiver are predicted and combine.
    if bits != 0:
        queue_pairs(state, visits, k, first, now)
        return
    # All messages are lost, so nothing is combined. A node without increment sensors (``sensor`` to
    # ``sensors`` - 1) needs no visit: it can be predicted over the whole gap later. Increments are
    # used up to each transmission, as the SimPy engine does, so that both use equal intervals.
    if nodes[entity.sender].sensors > nodes[entity.sender].sensor:
        queue_visit(state, visits, now, first + entity.sender)
    # The clock of a link makes both of its ends send.
    if state.clock_kind == LINKS and nodes[entity.other].sensors > nodes[entity.other].sensor:
        queue_visit(state, visits, now, first + entity.other)


@kernel
def count_tick(state: Simulation, sent: int, bits: int) -> None:
    """Add the events that ``record_tick`` would record to ``state.counts``, for runs that store no
    rows of events: a tick, ``sent`` messages, of which as many arrive and are absorbed as the
    arrival bits ``bits`` have ones; the others are lost.
    """
    # bits & (bits - 1) clears the lowest one.
    arrived = 0
    while bits != 0:
        arrived, bits = arrived + 1, bits & (bits - 1)
    counts = state.counts
    counts[TICK] += 1
    # Only clocks of nodes make transmissions, see ``record_tick``.
    counts[TRANSMIT] += state.clock_kind >= NODES
    counts[SEND] += sent
    counts[LOST] += sent - arrived
    counts[DELIVER] += arrived
    counts[ABSORB] += arrived


@kernel
def record_tick(
    state: Simulation, i: int, j: int, begin: int, after: int, bits: int, now: float
) -> None:
    """Append to ``state.rows`` a tick at ``now`` (seconds) of node i (and j, -1: none), its
    messages on the directed links ``outgoing[begin:after]``, of which number m - ``begin`` arrives
    if that bit of ``bits`` is 1, and their absorption at ``now`` (messages take no time). Count
    these messages in ``directions`` and the transmission in ``nodes[i].sent``; i, j are indices.
    """
    nodes, receivers = state.nodes, 0
    record_event(state, now, TICK, nodes[i].id, nodes[j].id if j >= 0 else -1, -1)
    # A node's clock makes one transmission, which each receiver hears or loses.
    if state.clock_kind >= NODES:
        record_event(state, now, TRANSMIT, nodes[i].id, -1, nodes[i].sent)
        nodes[i].sent += 1
    for m in range(begin, after):
        direction = state.directions[state.outgoing[m]]
        sender_id, receiver_id = nodes[direction.sender].id, nodes[direction.receiver].id
        number = direction.messages
        direction.messages = number + 1
        record_event(state, now, SEND, sender_id, receiver_id, number)
        if (bits >> (m - begin)) & 1:
            record_event_with_age(state, now, DELIVER, receiver_id, sender_id, number, 0.0)
            state.waiting[receivers] = direction.receiver
            receivers += 1
        else:
            record_event(state, now, LOST, sender_id, receiver_id, number)
    # Receivers absorb in the order of their indices, as in the SimPy engine.
    sort_indices(state.waiting, receivers)
    for m in range(receivers):
        record_event_with_age(state, now, ABSORB, nodes[state.waiting[m]].id, -1, -1, 0.0)


@kernel
def queue_pairs(state: Simulation, visits: Visits, k: int, first: int, now: float) -> None:
    """Queue the visits of tick ``k`` (index in ``state.ticks``) at ``now`` (seconds), some messages
    of which arrive: one visit of both ends of a link, or of the sender with each receiver.

    A visit is a record of work to be done later: predict two nodes to ``now`` and combine what
    they sent each other. Visits of one level touch different nodes, so that they are computed side
    by side; a node's next visit is in a higher level. ``first`` is the row of the run's first node
    in ``state.xhat``; raises ``visits.level`` of all these nodes.
    """
    bits, directions, outgoing = state.ticks.arrival_bits[k], state.directions, state.outgoing
    entity = state.entities[state.ticks.entity[k]]
    sender, begin = first + entity.sender, entity.first
    if state.clock_kind == LINKS:
        # Both ends are predicted, whichever of them receives.
        other = first + entity.other
        level = max(visits.level[sender], visits.level[other]) + 1
        visits.level[sender] = visits.level[other] = level
        v = append_visit(state, visits, level, now, sender, other)
        for m in range(entity.after - begin):
            if (bits >> m) & 1:
                set_receiving_link(
                    visits,
                    v,
                    directions[outgoing[begin + m]].receiver + first == sender,
                    outgoing[begin + m],
                )
        return
    # All visits of a broadcast are in one level, above those of the sender and all receivers.
    level = visits.level[sender]
    for m in range(entity.after - begin):
        if (bits >> m) & 1:
            level = max(level, visits.level[first + directions[outgoing[begin + m]].receiver])
    level += 1
    visits.level[sender] = level
    for m in range(entity.after - begin):
        if (bits >> m) & 1:
            receiver = first + directions[outgoing[begin + m]].receiver
            visits.level[receiver] = level
            v = append_visit(state, visits, level, now, sender, receiver)
            set_receiving_link(visits, v, False, outgoing[begin + m])


@kernel
def set_receiving_link(visits: Visits, v: int, first: bool, direction: int) -> None:
    """Enter in visit ``v`` (index in ``visits.records``) of two nodes the index ``direction`` of a
    directed link whose message arrives: the first node receives if ``first``, else the second.
    """
    if first:
        visits.records[v].to_first = direction
    else:
        visits.records[v].to_second = direction


@kernel
def fill_arrival_bits(state: Simulation, first: int, after: int, delays: int) -> None:
    """Write ``state.ticks.arrival_bits`` of the ticks ``first`` to ``after`` - 1 of one run, in
    which visits look up what arrives: bit m is 1 if message m of a tick arrives (a tick has at most
    MAX_LINKS_OF_CLOCK messages). ``state.ticks.delay`` holds the delay of each message in seconds,
    negative or nan if it is lost; those of this run begin at index ``delays``.
    """
    ticks, entities = state.ticks, state.entities
    for k in range(first, after):
        entity = entities[ticks.entity[k]]
        begin, bits = delays + ticks.first_outcome[k], 0
        for m in range(entity.after - entity.first):
            # ``>=`` is false for LOST, which is negative, and for nan.
            if ticks.delay[begin + m] >= 0.0:
                bits |= 1 << m
        ticks.arrival_bits[k] = bits
