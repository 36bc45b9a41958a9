"""The compiled event loop of one run in continuous time.

``event_loop`` finds the next event, predicts the nodes that take part in it, and calls its handler;
events are ordered by (time, rank, entity) as in ``engines.base``. It returns a request when Python
has something to do: draw more random numbers, record rows or samples, enlarge a buffer, move the
origin. All state is in one struct, so that the next call goes on where it stopped.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.root_flow import propagate_root
from netkf.algorithms.kernels.root_update import (
    add_root,
    add_to_intersection,
    begin_intersection,
    end_intersection,
    scale_root,
)
from netkf.core.instants import snapped
from netkf.engines.compiled.combination_state import (
    CombinationState,
    add_consensus,
    fuse_inbox,
    keep_prediction,
    predict_with_gain,
    sample_with_gain,
    send_prediction,
    use_readings_heard,
)
from netkf.engines.compiled.increments import predict_with_increments
from netkf.engines.compiled.instant_updates import copy_state, use_instant
from netkf.engines.compiled.message_queue import pop, push, put, release, sort_indices, take
from netkf.engines.compiled.state import (
    AFTER_READINGS,
    CONVEX,
    GAINS,
    INTERSECTION,
    LINKS,
    NODES,
    PREDICTIONS,
    SHARES,
    SWAP,
    Simulation,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.trace.schema import CODES

SENSE, TICK, SEND, DELIVER, LOST, LATE, ABSORB, TRANSMIT = (
    CODES[kind]
    for kind in ("sense", "tick", "send", "deliver", "lost", "late", "absorb", "transmit")
)
(GO_ON, WANT_TICKS, WANT_STEPS, WANT_MESSAGES, WANT_ROWS, WANT_SAMPLES, WANT_REBASE,
 WANT_PAST, DONE) = range(9)  # fmt: skip
"""Requests of the loop to Python: the next window of ticks, the next steps of the path, a larger
pool of messages, space for rows, for samples; a move of the origin; a longer past; DONE: the run
has reached the horizon. GO_ON: no request.
"""
ON_REBASE, ON_SENSE, ON_SAMPLE, ON_TICK, ON_DELIVER, ON_ABSORB, ON_PROBE = range(7)
"""Kinds of events, in the order in which those of one instant happen."""
NEVER = math.inf


@kernel
def event_loop(
    state: Simulation,
    combination: CombinationState | None,
) -> int:
    """Simulate the run ``state`` until the loop needs something from Python; return the request
    (WANT_... or DONE), after which Python calls the loop again.
    ``combination`` (see CombinationState) holds the extra state that some filters need, None for
    the others.
    """
    while True:
        # Check first that the event has everything it needs: if not, nothing has changed, and the
        # next call finds the same event again.
        event, now = next_event(state)
        request = find_shortage(state, now)
        if request != GO_ON:
            return request
        seek_piece(state, now)
        # Participants are predicted first.
        lost = event == ON_TICK and is_lost(state)
        predict_participants(state, combination, event, lost, now)
        if event == ON_TICK:
            on_tick(state, combination, now)
            # Absorptions come next, unless there are other events at this instant.
            if ends_instant(state, now):
                absorb_messages(state, combination, now)
        elif event == ON_ABSORB:
            on_absorb(state, combination, now)
        elif event == ON_SENSE:
            on_sense(state, now)
        elif event == ON_SAMPLE:
            on_sample(state, combination, now)
        elif event == ON_DELIVER:
            on_deliver(state, now)
        elif event == ON_REBASE:
            # Python moves the origin and goes to the next frame.
            return WANT_REBASE
        # The sample is stored, but there is no space for another one.
        elif not on_probe(state):
            return WANT_SAMPLES


@kernel
def seek_piece(state: Simulation, now: float) -> None:
    """Move ``state.piece`` on to the piece of the path in which ``now``, the time of the next event
    in seconds, lies.
    """
    while state.path.stop[state.piece] < now:
        state.piece += 1


@kernel
def find_shortage(state: Simulation, now: float) -> int:
    """Return the request for what an event at ``now`` (seconds) needs and lacks (WANT_...,
    DONE), or GO_ON if the event can happen; nothing is changed.
    """
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
    """Return the next event (ON_...) of the run ``state`` and its time in seconds, NEVER if none is
    left. Events of one instant happen in the order of these kinds: moves of the origin, readings of
    increments, samples of sensors, ticks, deliveries, absorptions, stored samples.
    """
    # ``<`` keeps the earlier event of the list at equal times: the order of ranks.
    event, now = ON_REBASE, next_of(state.frames, state.frame_at)
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
def predict_participants(
    state: Simulation, combination: CombinationState | None, event: int, lost: bool, now: float
) -> None:
    """Predict all nodes that take part in an ``event`` (ON_...) to ``now`` (seconds), in
    ``state.xhat``, ``root`` and ``now``. ``lost``: all messages of a tick are lost, so that its
    nodes need no prediction unless they read increments.
    """
    for k in range(count_participants(state, event)):
        h = participant(state, event, k)
        # The sender of a message that is lost needs no prediction, unless it reads increments.
        if not lost or state.nodes[h].sensors > state.nodes[h].sensor:
            predict_node(state, combination, h, now)


@kernel
def count_participants(state: Simulation, event: int) -> int:
    """Return the number of nodes that are predicted to the time of an ``event`` (ON_...) before it
    happens: none, one, both ends of a link, or all. ``participant`` says which.
    """
    count = 1
    # Samples and moves of the origin concern the states of all nodes at one time.
    if event in (ON_REBASE, ON_PROBE):
        count = len(state.nodes)
    # A delivery changes an inbox only: the receiver is predicted when it absorbs.
    elif event == ON_DELIVER:
        count = 0
    elif event == ON_TICK and state.clock_kind == LINKS:
        # Both ends of a link.
        count = 2
    return count


@kernel
def participant(state: Simulation, event: int, k: int) -> int:
    """Return the index in ``state.nodes`` of participant number ``k`` (from 0) of the next event,
    of kind ``event`` (ON_...): a node that is predicted to the event's time before it happens. For
    the first ON_ABSORB of an instant sorts ``state.waiting``.
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
    if event == ON_SENSE:
        return int(state.sensing.index[state.wake_at])
    if event == ON_SAMPLE:
        return int(state.instants.index[state.instant_at])
    # Moves of the origin and stored samples concern all nodes.
    return k


@kernel
def max_readings(state: Simulation, event: int) -> int:
    """Return the largest number of readings that the next event, of kind ``event`` (ON_...), uses:
    so many free entries the past of a node needs before it.
    """
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
    """Record an event of kind number ``kind`` (trace.schema.CODES) at ``t`` (seconds), whose age is
    nan: append a row to ``state.rows``, or, if rows are not ``traced``, count it in
    ``state.counts``. ``node`` and ``peer`` are ids of nodes, ``message`` a number on its link; -1:
    none.
    """
    record_event_with_age(state, t, kind, node, peer, message, np.nan)


@kernel
def record_event_with_age(
    state: Simulation, t: float, kind: int, node: int, peer: int, message: int, age: float
) -> None:
    """Record an event of kind number ``kind`` (trace.schema.CODES) at ``t`` (seconds): append a row
    to ``state.rows``, or, if rows are not ``traced``, count it in ``state.counts``. ``node`` and
    ``peer`` are ids of nodes, ``message`` a number on its link (-1: none), ``age`` seconds since it
    was sent.
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
def predict_node(
    state: Simulation, combination: CombinationState | None, h: int, time: float
) -> None:
    """Predict node ``h`` (index in ``state.nodes``) from ``state.now[h]`` to ``time`` (seconds),
    using its increments, unless it is there already. Changes ``state.xhat[h]``, ``root[h]`` and
    ``now[h]``, and in ``combination`` (None for most filters) the prediction that consensus on
    predictions sends.
    """
    node, now = state.nodes[h], state.now[h]
    # ``not <`` also returns for a time that is nan.
    if not now < time:
        return
    state.now[h] = time
    # With increment sensors the gap is divided into measurement intervals.
    if combination is not None and combination.kind == GAINS and node.sensors > node.sensor:
        predict_with_gain(state, combination, h, now, time)
    elif node.sensors > node.sensor:
        predict_with_increments(state, state.run, h, h, state.piece, now, time)
    else:
        # One step of the Riccati flow, exact for a gap of any length.
        gap = time - now
        propagate_root(state.table, node.model, state.root, state.xhat, h, gap, state.flow_scratch)
    if combination is not None and combination.kind == PREDICTIONS:
        keep_prediction(state, combination, h)


@kernel
def on_sense(state: Simulation, now: float) -> None:
    """Record that the next node with increment sensors has used its increments up to ``now``
    (seconds), a point of the sensing grid at which all such nodes read; the caller has predicted
    it. Advances ``state.wake_at``, and after the last node ``state.grid_at``.
    """
    sensing = state.sensing
    record_event(state, now, SENSE, sensing.node[state.wake_at], -1, -1)
    state.wake_at += 1
    # At each point of the grid all nodes with increment sensors read, one event for each.
    if state.wake_at == len(sensing.index):
        state.wake_at = 0
        state.grid_at += 1


@kernel
def on_sample(
    state: Simulation,
    combination: CombinationState | None,
    now: float,
) -> None:
    """Update a node with all its samples of the next instant, ``now`` (seconds), and advance
    ``state.instant_at``. Changes the row of ``state.xhat`` and ``state.root`` of that node, its
    newest ``reading``, and what ``combination`` (None if unused) holds of
    it.
    """
    instants, instant = state.instants, state.instant_at
    h, last_node = instants.index[instant], -1
    for s in range(instants.first[instant], instants.first[instant + 1]):
        # A pooled filter reads several nodes at an instant: one row for each.
        if instants.node[s] != last_node:
            last_node = instants.node[s]
            record_event(state, now, SENSE, last_node, -1, -1)
    if combination is not None and combination.kind == GAINS:
        sample_with_gain(state, combination, h, instant)
    else:
        use_instant(state, instant, state.root, state.xhat, h, 1.0)
    # The newest sample, which a filter of readings sends after this event.
    state.nodes[h].reading = instant
    state.instant_at += 1


@kernel
def on_tick(state: Simulation, combination: CombinationState | None, now: float) -> None:
    """Handle the next tick of a clock at ``now`` (seconds), or a transmission after a sample: send
    one message on each directed link of its entity (a link, a directed link or a node with a
    clock), and advance ``state.tick_at``. ``combination``, None if unused, has the
    contents of messages for some filters.
    """
    ticks, nodes, k = state.ticks, state.nodes, state.tick_at
    entity = state.entities[ticks.entity[k]]
    i, j = entity.sender, entity.other
    # A transmission after a sample has no tick of its own.
    if state.clock_kind != AFTER_READINGS:
        record_event(state, now, TICK, nodes[i].id, nodes[j].id if j >= 0 else -1, -1)
    state.tick_at += 1
    # A node's clock makes one transmission, which each receiver hears or loses.
    if state.clock_kind >= NODES:
        record_event(state, now, TRANSMIT, nodes[i].id, -1, nodes[i].sent)
        nodes[i].sent += 1
    # Outcomes of a tick lie one after the other in the order of its directed links.
    first = state.first_delay + ticks.first_outcome[k] - entity.first
    for m in range(entity.first, entity.after):
        send(state, combination, state.outgoing[m], ticks.delay[first + m], now)


@kernel
def send(
    state: Simulation,
    combination: CombinationState | None,
    w: int,
    delay: float,
    now: float,
) -> None:
    """Send one message on directed link ``w`` (index in ``state.directions``) at ``now`` (seconds):
    record it, copy what it carries from its sender into a free message of ``state.pool``, and
    deliver it at once or put it on the heap. ``delay`` (seconds) is LOST or nan if it is lost.
    ``combination``: None if unused.
    """
    direction, pool = state.directions[w], state.pool
    number, h = direction.messages, direction.sender
    # A lost message has a number too: recorded losses refer to it.
    direction.messages += 1
    sender_id, receiver_id = state.nodes[h].id, state.nodes[direction.receiver].id
    record_event(state, now, SEND, sender_id, receiver_id, number)
    # ``not >=`` catches both LOST, which is negative, and nan.
    if not delay >= 0.0:
        record_event(state, now, LOST, sender_id, receiver_id, number)
        return
    delay = snapped(delay, state.per_second)
    arrival = snapped(now + delay, state.per_second)
    # The horizon is half open: a message that arrives after it leaves no event.
    if delay > 0.0 and not arrival < state.horizon:
        return
    m = take(state)
    message = pool[m]
    message.direction, message.number, message.sent = w, number, now
    if combination is not None and combination.kind == PREDICTIONS:
        send_prediction(state, combination, m, h)
    else:
        # A copy: the sender's estimate changes while the message is under way.
        copy_state(state.size, state.pool_x, state.pool_root, m, state.xhat, state.root, h)
    if delay == 0.0:
        arrive(state, m, now)
        return
    # ``order`` breaks ties between messages of one link that arrive at the same time.
    message.arrival, message.order = arrival, state.order
    state.order += 1
    push(pool, state.heap, state.in_flight, m)
    state.in_flight += 1


@kernel
def is_lost(state: Simulation) -> bool:
    """Return True if all messages of the next tick (number ``state.tick_at``) are lost: then nodes
    without increment sensors need no prediction for it.
    """
    ticks = state.ticks
    entity = state.entities[ticks.entity[state.tick_at]]
    first = state.first_delay + ticks.first_outcome[state.tick_at]
    any_arrives = False
    for m in range(entity.after - entity.first):
        any_arrives = any_arrives or ticks.delay[first + m] >= 0.0
    return not any_arrives


@kernel
def ends_instant(state: Simulation, now: float) -> bool:
    """Return True if no tick or delivery at ``now`` (seconds) is left, so that absorptions come
    next.
    """
    arriving = state.in_flight > 0 and state.pool[state.heap[0]].arrival <= now
    return not arriving and next_tick(state) > now


@kernel
def absorb_messages(
    state: Simulation,
    combination: CombinationState | None,
    now: float,
) -> None:
    """Let all nodes in ``state.waiting``, which have messages of this instant ``now`` (seconds),
    absorb these: predict each node, update its estimate in ``state.xhat`` and ``root``, and empty
    its inbox. ``combination``: extra state of the filter, None if unused.
    """
    sort_indices(state.waiting, state.receivers)
    while state.receivers > 0:
        predict_node(state, combination, state.waiting[state.absorbing], now)
        on_absorb(state, combination, now)


@kernel
def on_deliver(state: Simulation, now: float) -> None:
    """Take the message that arrives next, at ``now`` (seconds), from the heap and put it into the
    inbox of its receiver, or drop it if it is too old.
    """
    m = pop(state.pool, state.heap, state.in_flight)
    state.in_flight -= 1
    arrive(state, m, now)


@kernel
def arrive(state: Simulation, m: int, now: float) -> None:
    """Put message ``m`` (index in ``state.pool``), which arrives at ``now`` (seconds), into the
    inbox of its receiver and list that in ``state.waiting``; or drop it if it is older than
    ``state.age_limit``.
    """
    message = state.pool[m]
    direction = state.directions[message.direction]
    sender_id, receiver_id = state.nodes[direction.sender].id, state.nodes[direction.receiver].id
    age = snapped(now - message.sent, state.per_second)
    # ``not <=`` also rejects an age that is nan.
    if not age <= state.age_limit:
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
def on_absorb(
    state: Simulation,
    combination: CombinationState | None,
    now: float,
) -> None:
    """Let the next node, ``state.waiting[state.absorbing]``, absorb all messages of this instant
    ``now`` (seconds), in the order of senders: combine its estimate with theirs in the way of its
    filter. Changes its estimate in ``state.xhat`` and ``root``, empties its inbox, and advances
    ``absorbing``. ``combination``: extra state of the filter, None if
    unused.
    """
    pool, h = state.pool, state.waiting[state.absorbing]
    node, oldest = state.nodes[h], 0.0
    # The age of the oldest message goes into the trace.
    m = node.inbox
    while m != -1:
        oldest, m = max(oldest, now - pool[m].sent), pool[m].next
    oldest = snapped(oldest, state.per_second)
    if combination is not None:
        combine_with_state(state, combination, h, now)
    else:
        combine(state, h, now)
    # Messages return to the pool only now, since handlers read them through the inbox.
    m = node.inbox
    while m != -1:
        following = pool[m].next
        release(state, m)
        m = following
    node.inbox = -1
    record_event_with_age(state, now, ABSORB, node.id, -1, -1, oldest)
    state.absorbing += 1
    # All messages of this instant are absorbed.
    if state.absorbing == state.receivers:
        state.absorbing = state.receivers = 0


@kernel
def combine_with_state(
    state: Simulation, combination: CombinationState, h: int, now: float
) -> None:
    """Combine node ``h`` (index in ``state.nodes``) with its inbox at ``now`` (seconds), for
    filters that need the extra arrays of a CombinationState: consensus on predictions, constant
    gains, and fusion with the best weight. Changes ``state.xhat[h]`` and
    ``root[h]``.
    """
    if combination.kind == PREDICTIONS:
        use_readings_heard(state, h, now)
    received_weight = predict_payloads(state, h, now)
    if combination.kind == PREDICTIONS:
        add_consensus(state, combination, h)
    elif combination.kind == GAINS:
        combine_convex(state, h, max(0.0, 1.0 - received_weight))
    else:
        fuse_inbox(state, combination, h)


@kernel
def predict_payloads(state: Simulation, h: int, now: float) -> float:
    """Predict the estimates that messages in the inbox of node ``h`` (index) carry from when they
    were sent to ``now`` (seconds), without readings, in ``state.pool_x`` and ``pool_root``. Return
    the sum of the weights of all these messages; the node's own weight is 1 minus it.
    """
    # The last model of the table has no sensors: prediction alone, as readings since then are
    # unknown here.
    pool, directions, model = state.pool, state.directions, len(state.table.unit) - 1
    m, received_weight = state.nodes[h].inbox, 0.0
    while m != -1:
        age = now - pool[m].sent
        # SWAP uses the last message of the inbox only.
        if age > 0.0 and (state.combination_kind != SWAP or pool[m].next == -1):
            propagate_root(
                state.table, model, state.pool_root, state.pool_x, m, age, state.flow_scratch
            )
        received_weight += directions[pool[m].direction].weight
        m = pool[m].next
    return received_weight


@kernel
def combine(state: Simulation, h: int, now: float) -> None:
    """Combine node ``h`` (index in ``state.nodes``) with the estimates in its inbox, predicted to
    ``now`` (seconds), in the way of the filter's ``combination_kind``: a convex combination,
    covariance intersection, shares (covariance intersection with renormalised weights) or a swap.
    Changes ``state.xhat[h]`` and ``root[h]``.
    """
    received_weight = predict_payloads(state, h, now)
    if state.combination_kind == CONVEX:
        # The weights of messages that do not arrive go to the own one, so that weights sum to 1.
        combine_convex(state, h, max(0.0, 1.0 - received_weight))
    elif state.combination_kind == INTERSECTION:
        intersect(state, h, max(0.0, 1.0 - received_weight), 1.0)
    elif state.combination_kind == SHARES:
        own, total = state.nodes[h].own, state.nodes[h].own + received_weight
        # "keep-own", or weights that are all 0: the own weight is 1 minus the others.
        if state.keep_own == 1 or total == 0.0:
            own, total = max(0.0, 1.0 - received_weight), 1.0
        # With weight 1 the node keeps its estimate to the last bit.
        if own / total != 1.0:
            intersect(state, h, own / total, total)
    elif state.combination_kind == SWAP:
        # Gossip: the estimate of the peer replaces the own one.
        last = state.nodes[h].last
        copy_state(state.size, state.xhat, state.root, h, state.pool_x, state.pool_root, last)


@kernel
def combine_convex(state: Simulation, h: int, own: float) -> None:
    """Combine node ``h`` (index) with its inbox by paper H (7) and (9): x = w x + sum w_j x_j and P
    = w P + sum w_j P_j, with the own weight w = ``own`` and the weight w_j of each directed link.
    Changes ``state.xhat[h]`` and ``root[h]``, the root of P.
    """
    # w P first, then + w_j P_j for each message.
    xhat, root, pool, directions = state.xhat, state.root, state.pool, state.directions
    scale_root(state.size, root, xhat, h, own)
    m = state.nodes[h].inbox
    while m != -1:
        weight = directions[pool[m].direction].weight
        add_root(root, xhat, h, weight, state.pool_root, state.pool_x, m, state.update_scratch)
        m = pool[m].next


@kernel
def intersect(state: Simulation, h: int, own: float, total: float) -> None:
    """Combine node ``h`` (index) with its inbox by covariance intersection, paper D (8) and (9):
    P^-1 = w P^-1 + sum w_j P_j^-1, with the own weight w = ``own`` and the weight w_j of each
    directed link divided by ``total``. Changes ``state.xhat[h]`` and ``root[h]``, the root of P.
    """
    xhat, root, pool, directions = state.xhat, state.root, state.pool, state.directions
    scratch = state.update_scratch
    # Means are relative to the own estimate: differences of near states lose no digits.
    begin_intersection(scratch)
    add_to_intersection(own, root, xhat, h, xhat, h, scratch)
    m = state.nodes[h].inbox
    while m != -1:
        weight = directions[pool[m].direction].weight / total
        add_to_intersection(weight, state.pool_root, state.pool_x, m, xhat, h, scratch)
        m = pool[m].next
    end_intersection(root, xhat, h, xhat, h, scratch)


@kernel
def on_probe(state: Simulation) -> bool:
    """Store a sample of all nodes in ``state.buffer`` at a time at which the scenario asks for
    one. Return False if there is no space for another one.
    """
    store_sample(state, state.run, 0, state.samples)
    return count_sample(state)


@kernel
def store_sample(state: Simulation, run: int, first: int, k: int) -> None:
    """Store the estimates and covariances ``P = S S'`` of the N nodes of a run, which are in the
    rows ``first`` to ``first`` + N - 1 of ``state.xhat`` and ``root`` (S), as sample ``k`` of run
    number ``run``, in ``buffer.xhat[run, k]`` (N, n) and ``buffer.P[run, k]`` (N, n, n).
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
    """Count the sample just stored: write to ``state.buffer`` the numbers of events so far, the
    next row and the piece of the path that the sample lies in, and advance ``probe_at`` and
    ``samples``. Return False if there is no space for another one.
    """
    # A run that diverges at this sample ends with these counts and rows.
    buffer, run, k = state.buffer, state.run, state.samples
    for kind in range(len(state.counts)):
        buffer.counts[run, k, kind] = state.counts[kind]
    buffer.rows[run, k], buffer.piece[run, k] = state.row, state.piece
    state.probe_at += 1
    state.samples += 1
    return bool(state.samples < buffer.rows.shape[1])
