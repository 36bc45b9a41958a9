"""What both event loops in continuous time share: the next event, its rows, arrivals, samples.

The loops, ``clock_loop`` and ``agenda``, find the next event, predict the nodes that take part in
it, and handle it; events are ordered by (time, rank, entity) as in ``engines.base``. A loop returns
a request when Python has something to do: draw more random numbers, record rows or samples, enlarge
a buffer, move the origin. All state is in one struct, with which the next call goes on.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.core.instants import snapped
from netkf.engines.compiled.message_queue import pop, put, release, sort_indices
from netkf.engines.compiled.outcomes import OUT_OF_RANGE
from netkf.engines.compiled.state import LINKS, Simulation
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.trace.schema import CODES

SENSE, REFUSE, TICK, SEND, DELIVER, LOST, LATE, ABSORB, TRANSMIT, LINK, CLIP = (
    CODES[kind]
    for kind in (
        *("sense", "refuse", "tick", "send", "deliver", "lost", "late", "absorb", "transmit"),
        *("link", "clip"),
    )
)
(GO_ON, WANT_TICKS, WANT_STEPS, WANT_MESSAGES, WANT_ROWS, WANT_SAMPLES, WANT_REBASE, WANT_LIFE,
 WANT_PAST, DONE) = range(10)  # fmt: skip
"""Requests of the loop to Python: the next window of ticks, the next steps of the path, a larger
pool of messages, space for rows, for samples; a move of the origin; a node that goes up or down; a
longer past; DONE: the run has reached the horizon. GO_ON: no request.
"""
ON_REBASE, ON_LIFE, ON_SENSE, ON_SAMPLE, ON_TICK, ON_DELIVER, ON_ABSORB, ON_PROBE = range(8)
"""Kinds of events, in the order in which those of one instant happen."""
NEVER = math.inf
NONE_SENT, ALL_LOST, SOME_ARRIVE = range(3)
"""What becomes of the messages of a tick: none is sent, since nobody is in range; or else."""


@kernel
def seek_piece(state: Simulation, now: float) -> None:
    """Move ``state.piece`` on to the piece of the path in which ``now`` (seconds) lies."""
    while state.path.stop[state.piece] < now:
        state.piece += 1


@kernel
def find_shortage(state: Simulation, now: float) -> int:
    """Return the request for what an event at ``now`` (seconds) lacks, or GO_ON."""
    # Space for the worst case of one event, so that no handler has to stop half-way.
    request = GO_ON
    if state.traced and state.row + state.most_rows > len(state.rows):
        request = WANT_ROWS
    elif state.free_count < state.most_messages:
        request = WANT_MESSAGES
    # From the end of the window on, a tick that is not drawn yet may come first.
    elif now >= state.ticks.end and state.ticks.end < NEVER:
        request = WANT_TICKS
    # Events after the last step need more of the path, unless it reaches the horizon.
    elif now > state.path.end and state.path.end < state.horizon:
        request = WANT_STEPS
    elif now == NEVER:
        request = DONE
    return request


@kernel
def next_event(state: Simulation) -> tuple[int, float]:
    """Return the next event (ON_...) and its time in seconds, NEVER if none is left. Those of one
    instant happen in the order of these constants.
    """
    # ``<`` keeps the earlier event of the list at equal times: the order of ranks.
    event, now = ON_REBASE, next_of(state.frames, state.frame_at)
    life = next_of(state.lives, state.life_at)
    if life < now:
        event, now = ON_LIFE, life
    sense = next_of(state.path.grid, state.grid_at)
    if sense < now:
        event, now = ON_SENSE, sense
    sample = next_of(state.instants.t, state.instant_at)
    if sample < now:
        event, now = ON_SAMPLE, sample
    tick = next_tick(state)
    if tick < now:
        event, now = ON_TICK, tick
    # The heap is ordered by arrival, so its top is the next delivery.
    deliver = state.pool[state.heap[0]].arrival if state.in_flight > 0 else NEVER
    if deliver < now:
        event, now = ON_DELIVER, deliver
    # Messages are absorbed at the instant of their arrival, after all arrivals of that instant.
    absorb = state.inbox_time if state.receivers > 0 else NEVER
    if absorb < now:
        event, now = ON_ABSORB, absorb
    probe = next_of(state.probes, state.probe_at)
    if probe < now:
        event, now = ON_PROBE, probe
    return event, now


@kernel
def next_tick(state: Simulation) -> float:
    """Return the time in seconds of the next tick of the run, or NEVER."""
    return float(state.ticks.t[state.tick_at]) if state.tick_at < state.ticks_stop else NEVER


@kernel
def next_of(times: FloatArray, k: int) -> float:
    """Return entry ``k`` of ``times`` (K,), in seconds, or NEVER if there are fewer."""
    return float(times[k]) if k < len(times) else NEVER


@kernel
def count_participants(state: Simulation, event: int) -> int:
    """Return the number of nodes that are predicted before an ``event`` (ON_...) happens."""
    count = 1
    # Samples and moves of the origin concern the states of all nodes at one time.
    if event in (ON_REBASE, ON_PROBE):
        count = len(state.nodes)
    # A delivery changes an inbox only: the receiver is predicted when it absorbs.
    elif event == ON_DELIVER or (event == ON_LIFE and state.waking[state.life_at] < 0):
        count = 0
    elif event == ON_TICK and state.clock_kind == LINKS:
        # Both ends of a link.
        count = 2
    return count


@kernel
def participant(state: Simulation, event: int, k: int) -> int:
    """Return the index of participant number ``k`` of the next event, of kind ``event`` (ON_...).
    For the first ON_ABSORB of an instant sorts ``state.waiting``.
    """
    if event == ON_TICK:
        entity = state.entities[state.ticks.entity[state.tick_at]]
        return int(entity.sender if k == 0 else entity.other)
    if event == ON_ABSORB:
        # Sorted once, before the first node absorbs: simultaneous events run in the order of
        # entities.
        if state.absorbing == 0:
            sort_indices(state.waiting, state.receivers)
        return int(state.waiting[state.absorbing])
    if event == ON_LIFE:
        return int(state.waking[state.life_at])
    if event == ON_SENSE:
        return int(state.sensing.index[state.wake_at])
    if event == ON_SAMPLE:
        return int(state.instants.index[state.instant_at])
    # Moves of the origin and stored samples concern all nodes.
    return k


@kernel
def skip_if_down(state: Simulation, event: int) -> bool:
    """Go on to the next sample or tick if the nodes of this one are down; return if they are."""
    if event not in (ON_SAMPLE, ON_TICK):
        return False
    for k in range(count_participants(state, event)):
        if state.nodes[participant(state, event, k)].down == 0:
            return False
    if event == ON_SAMPLE:
        state.instant_at += 1
    else:
        state.tick_at += 1
    return True


@kernel
def max_readings(state: Simulation, event: int) -> int:
    """Return the largest number of readings that the next event, of kind ``event``, uses."""
    if event == ON_SAMPLE:
        return 1
    count = 0
    if event == ON_ABSORB:
        # A node may absorb as many readings as it has messages.
        m = state.nodes[participant(state, event, 0)].inbox
        while m != -1:
            count, m = count + 1, state.pool[m].next
    return count


@kernel
def record_event(
    state: Simulation, t: float, kind: int, node: int, peer: int, message: int
) -> None:
    """Record an event without an age, as ``record_event_with_age``."""
    record_event_with_age(state, t, kind, node, peer, message, np.nan)


@kernel
def record_event_with_age(
    state: Simulation, t: float, kind: int, node: int, peer: int, message: int, age: float
) -> None:
    """Record an event of kind number ``kind`` at ``t`` (seconds) as a row, or count it if rows are
    not ``traced``. ``node`` and ``peer`` are ids, ``message`` a number on its link (-1: none).
    """
    if not state.traced:
        state.counts[kind] += 1
        return
    row = state.rows[state.row]
    row.t, row.kind, row.node, row.peer = t, kind, node, peer
    # -1: exchanges have phases in slots only.
    row.message, row.phase, row.age = message, -1, age
    state.row += 1


@kernel
def on_sense(state: Simulation, now: float) -> None:
    """Record that the next node has used its increments up to ``now``, a point of the grid."""
    sensing = state.sensing
    if state.nodes[sensing.index[state.wake_at]].down == 0:
        record_event(state, now, SENSE, sensing.node[state.wake_at], -1, -1)
    state.wake_at += 1
    # At each point of the grid all nodes with increment sensors read, one event for each.
    if state.wake_at == len(sensing.index):
        state.wake_at = 0
        state.grid_at += 1


@kernel
def reached(state: Simulation, first: int, after: int, outcome: int) -> int:
    """Return what becomes of the messages on the directed links ``outgoing[first:after]`` whose
    outcomes begin at ``delay[outcome]``: SOME_ARRIVE, ALL_LOST, or NONE_SENT.
    """
    found = NONE_SENT
    for m in range(after - first):
        delay = state.ticks.delay[outcome + m]
        way = state.directions[state.outgoing[first + m]]
        if state.nodes[way.sender].down == 1:
            continue  # the other end of a link sends alone
        if delay > 0.0 or (delay == 0.0 and state.nodes[way.receiver].down == 0):
            return SOME_ARRIVE
        if delay != OUT_OF_RANGE:
            found = ALL_LOST
    return found


@kernel
def next_reached(state: Simulation) -> int:
    """Return what becomes of the messages of the next tick, see ``reached``."""
    ticks = state.ticks
    entity = state.entities[ticks.entity[state.tick_at]]
    first = state.first_delay + ticks.first_outcome[state.tick_at]
    return int(reached(state, entity.first, entity.after, first))


@kernel
def record_links(state: Simulation, owner: int, now: float) -> None:
    """Record links that change at the tick with number ``owner``, or, -1 - k, at sample k."""
    ticks = state.ticks
    while state.link_at < len(ticks.owner) and ticks.owner[state.link_at] == owner:
        link = ticks.link[state.link_at]
        record_event(state, now, LINK, link[0], link[1], link[2])
        state.link_at += 1


@kernel
def ends_instant(state: Simulation, now: float) -> bool:
    """Return True if no tick or delivery at ``now`` (seconds) is left."""
    arriving = state.in_flight > 0 and state.pool[state.heap[0]].arrival <= now
    return not arriving and next_tick(state) > now


@kernel
def on_sense_or_deliver(state: Simulation, event: int, now: float) -> None:
    """Handle the next ``event`` (ON_SENSE or ON_DELIVER): at the latter take the message that
    arrives next, at ``now`` (seconds), from the heap.
    """
    if event == ON_SENSE:
        on_sense(state, now)
        return
    m = pop(state.pool, state.heap, state.in_flight)
    state.in_flight -= 1
    arrive(state, m, now)


@kernel(inlined=True)
def local_time(state: Simulation, h: int, time: float) -> float:
    """Return what the clock of node ``h`` shows at ``time``, both in seconds."""
    node = state.nodes[h]
    if node.pace == 1.0 and node.offset == 0.0:
        return time
    return snapped(node.offset + node.pace * time, state.per_second)


@kernel
def stamped_age(state: Simulation, m: int, now: float) -> float:
    """Return the age at ``now`` that the stamp of message ``m`` tells its receiver: from 0 to the
    time since the start, both by the receiver's clock.
    """
    direction, sent = state.directions[state.pool[m].direction], state.pool[m].sent
    j, per_second = direction.receiver, state.per_second
    shown = local_time(state, j, now)
    age = snapped(shown - local_time(state, direction.sender, sent), per_second)
    return min(max(age, 0.0), snapped(shown - local_time(state, j, 0.0), per_second))


@kernel
def arrive(state: Simulation, m: int, now: float) -> None:
    """Put message ``m``, which arrives at ``now`` (seconds), into the inbox of its receiver, or
    drop it if it is older than ``state.age_limit``.
    """
    message = state.pool[m]
    direction = state.directions[message.direction]
    sender_id, receiver_id = state.nodes[direction.sender].id, state.nodes[direction.receiver].id
    if state.nodes[direction.receiver].down == 1:
        record_event(state, now, LOST, sender_id, receiver_id, message.number)
        release(state, m)
        return
    age = snapped(now - message.sent, state.per_second)
    # ``not <=`` also rejects an age that is nan.
    if not stamped_age(state, m, now) <= state.age_limit:
        record_event_with_age(state, now, LATE, receiver_id, sender_id, message.number, age)
        release(state, m)
        return
    record_event_with_age(state, now, DELIVER, receiver_id, sender_id, message.number, age)
    # The first message of the instant adds its receiver to the list of nodes that absorb.
    if state.nodes[direction.receiver].inbox == -1:
        state.waiting[state.receivers] = direction.receiver
        state.receivers += 1
        state.inbox_time = now
    put(state, direction.receiver, m)


@kernel
def store_sample(state: Simulation, run: int, first: int, k: int) -> None:
    """Store the estimates and covariances ``P = S S'`` of the nodes in the rows from ``first`` on
    as sample ``k`` of run number ``run``.
    """
    xhat, P, root, n = state.buffer.xhat, state.buffer.P, state.root, len(state.size)
    for h in range(len(state.nodes)):
        entry = first + h
        for i in range(n):
            xhat[run, k, h, i] = state.xhat[entry, i]
            for j in range(i + 1):
                # With the lower triangle of S only.
                total = 0.0
                for r in range(j + 1):
                    total += root[entry, i, r] * root[entry, j, r]
                P[run, k, h, i, j] = P[run, k, h, j, i] = total


@kernel
def count_sample(state: Simulation) -> bool:
    """Count the sample just stored; return False if there is no space for another one."""
    # A run that diverges at this sample ends with these counts and rows.
    buffer, run, k = state.buffer, state.run, state.samples
    for kind in range(len(state.counts)):
        buffer.counts[run, k, kind] = state.counts[kind]
    buffer.rows[run, k] = state.row
    state.probe_at += 1
    state.samples += 1
    return bool(state.samples < buffer.rows.shape[1])
