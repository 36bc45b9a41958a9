"""The event loop: what happens in one run, event after event, compiled.

``event_loop`` finds the next event and calls its handler; the order is (time, rank, entity) as
``engines.base`` says. It stops and says why where Python has something to do: draw more, pass rows
on, show samples, move the origin. All state is in arrays, so that it goes on where it stopped.

A handler first brings to the present whoever takes part. That may stop half way for more draws; it
is done again then, and changes nothing that was done before.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.root_flow import move_root
from netkf.algorithms.kernels.root_update import (
    add_root,
    add_to_intersection,
    begin_intersection,
    end_intersection,
    scale_root,
)
from netkf.engines.compiled.increments import PathBlock, predict_with_increments
from netkf.engines.compiled.late_readings import (
    History,
    copy_state,
    use_instant,
    use_late_reading,
    use_reading,
)
from netkf.engines.compiled.message_queue import pop, push, put, release, sort_places, take
from netkf.engines.compiled.running_totals import (
    Totals,
    add_reading,
    hear,
    offer_round,
)
from netkf.engines.compiled.schedule import Window
from netkf.engines.compiled.state import (
    AFTER_READINGS,
    CONVEX,
    INTERSECTION,
    LINKS,
    NODES,
    READINGS,
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
(GO_ON, WANT_TICKS, WANT_STEPS, WANT_CUTS, WANT_MESSAGES, WANT_ROWS, WANT_SHOWN, WANT_REBASE,
 WANT_PAST, DONE) = range(10)  # fmt: skip
"""Why the loop stopped: it needs the next window of ticks, the next steps of the path, normals for
cuts, a larger pool of messages, room for rows, for samples; the origin moves; a longer history.
"""
NEVER = math.inf


@kernel
def event_loop(  # noqa: PLR0912 - a branch for each kind of event
    state: Simulation,
    window: Window,
    path: PathBlock,
    totals: Totals | None,
    history: History | None,
) -> int:
    """Go on until something is wanted; see the words above."""
    run = state.run[0]
    while True:
        if run.row + run.most_rows > len(state.rows):
            return WANT_ROWS
        if run.free_count < run.most_messages:
            return WANT_MESSAGES
        rebase = next_of(state.frames, run.frame_at)
        sense = next_of(path.grid, run.grid_at)
        sample = next_of(state.instants.t, run.instant_at)
        tick = next_of(window.t, run.tick_at)
        probe = next_of(state.probes, run.probe_at)
        deliver = state.pool[state.heap[0]].arrival if run.flying > 0 else NEVER
        absorb = run.mail_time if run.waiting > 0 else NEVER
        now = min(rebase, sense, sample, tick, deliver, absorb, probe)
        if now >= window.end and window.end < NEVER:
            return WANT_TICKS
        if now > path.end and path.end < run.horizon:
            return WANT_STEPS
        if now == NEVER:
            return DONE
        while path.stop[run.piece] < now:
            run.piece += 1
        if rebase == now:
            wanted = on_rebase(state, path, now)
        elif sense == now:
            wanted = on_sense(state, path, now)
        elif sample == now:
            wanted = on_sample(state, path, totals, history, now)
        elif tick == now:
            wanted = on_tick(state, window, path, totals, now)
        elif deliver == now:
            wanted = on_deliver(state, now)
        elif absorb == now:
            wanted = on_absorb(state, path, totals, history, now)
        else:
            wanted = on_probe(state, path, totals, now)
        if wanted != GO_ON:
            return wanted


@kernel
def next_of(times: FloatArray, k: int) -> float:
    """``times[k]``, or never."""
    return float(times[k]) if k < len(times) else NEVER


@kernel
def note(
    run: np.ndarray,
    rows: np.ndarray,
    t: float,
    kind: int,
    node: int,
    peer: int,
    message: int,
    age: float,
) -> None:
    """Write one row of the trace."""
    row = rows[run[0].row]
    row.t, row.kind, row.node, row.peer = t, kind, node, peer
    row.message, row.phase, row.age = message, -1, age
    run[0].row += 1


@kernel
def predict(state: Simulation, path: PathBlock, h: int, time: float) -> bool:
    """Bring node ``h`` to ``time``; False where it needs more normals for cuts first."""
    node = state.nodes[h]
    if not node.now < time:
        return True
    if node.sensors > node.sensor:
        return predict_with_increments(state, path, h, time)
    gap = time - node.now
    move_root(state.table, node.model, state.root, state.xhat, h, gap, state.flow_room)
    node.now = time
    return True


@kernel
def predict_all(state: Simulation, path: PathBlock, time: float) -> bool:
    """Bring all nodes to ``time``."""
    for h in range(len(state.nodes)):  # noqa: SIM110 - compiled functions know no generators
        if not predict(state, path, h, time):
            return False
    return True


@kernel
def on_rebase(state: Simulation, path: PathBlock, now: float) -> int:
    """The origin of the coordinates moves: Python does that."""
    return WANT_REBASE if predict_all(state, path, now) else WANT_CUTS


@kernel
def on_sense(state: Simulation, path: PathBlock, now: float) -> int:
    """A node uses its increments up to a point of the sensing grid."""
    run, sensing = state.run[0], state.sensing
    if not predict(state, path, sensing.host[run.wake_at], now):
        return WANT_CUTS
    note(state.run, state.rows, now, SENSE, sensing.node[run.wake_at], -1, -1, np.nan)
    run.wake_at += 1
    if run.wake_at == len(sensing.host):
        run.wake_at = 0
        run.grid_at += 1
    return GO_ON


@kernel
def on_sample(
    state: Simulation,
    path: PathBlock,
    totals: Totals | None,
    history: History | None,
    now: float,
) -> int:
    """A node uses all its samples of an instant."""
    run, given = state.run[0], state.instants
    instant = run.instant_at
    h = given.host[instant]
    if history is not None and history.free[1] < 1:
        return WANT_PAST
    if not predict(state, path, h, now):
        return WANT_CUTS
    sensed = -1
    for s in range(given.first[instant], given.first[instant + 1]):
        if given.node[s] != sensed:  # of a pooled filter several nodes, in order
            sensed = given.node[s]
            note(state.run, state.rows, now, SENSE, sensed, -1, -1, np.nan)
    if totals is not None:
        add_reading(state, totals, h, instant)
    elif history is not None:
        use_reading(state, history, h, instant)
    else:
        use_instant(state, instant, state.root, state.xhat, h, 1.0)
    state.nodes[h].reading = instant
    run.instant_at += 1
    return GO_ON


@kernel
def on_tick(
    state: Simulation, window: Window, path: PathBlock, totals: Totals | None, now: float
) -> int:
    """A clock ticks, or a node has used a sample: who transmits sends to each receiver."""
    run, nodes = state.run[0], state.nodes
    entity = state.entities[window.entity[run.tick_at]]
    i, j = entity.sender, entity.other
    if not predict(state, path, i, now):
        return WANT_CUTS
    # Both ends of a link decide what they send before either hears the other.
    if run.at == LINKS and not predict(state, path, j, now):
        return WANT_CUTS
    if run.at != AFTER_READINGS:
        note(
            state.run, state.rows, now, TICK, nodes[i].id, nodes[j].id if j >= 0 else -1, -1, np.nan
        )
    sends = True
    if totals is not None:
        sends = offer_round(state, totals, i, now)
    if run.at >= NODES and sends:
        note(state.run, state.rows, now, TRANSMIT, nodes[i].id, -1, nodes[i].sent, np.nan)
        nodes[i].sent += 1
    first = window.at[run.tick_at] - entity.first
    if sends:
        for k in range(entity.first, entity.after):
            send(state, totals, state.hearing[k], window.delay[first + k], now)
    run.tick_at += 1
    return GO_ON


@kernel
def send(state: Simulation, totals: Totals | None, w: int, delay: float, now: float) -> None:
    """Send one message on a directed link; ``delay`` is LOST or nan where it is lost."""
    run, way, pool = state.run[0], state.ways[w], state.pool
    number, h = way.messages, way.sender
    way.messages += 1
    one, other = state.nodes[h].id, state.nodes[way.receiver].id
    note(state.run, state.rows, now, SEND, one, other, number, np.nan)
    if not delay >= 0.0:
        note(state.run, state.rows, now, LOST, one, other, number, np.nan)
        return
    if delay > 0.0 and not now + delay < run.horizon:
        return
    m = take(state.run, pool)
    message = pool[m]
    message.way, message.number, message.sent = w, number, now
    if totals is not None:
        message.tag = totals.rounds[h] - 1
        for k in range(totals.sent.shape[1]):
            totals.offered[m, k] = totals.sent[h, k]
    elif run.kind == READINGS:
        message.tag = state.nodes[h].reading
    else:
        copy_state(state.pool_x, state.pool_root, m, state.xhat, state.root, h)
    if delay == 0.0:
        arrive(state, m, now)
        return
    message.arrival, message.order = now + delay, run.order
    run.order += 1
    push(pool, state.heap, run.flying, m)
    run.flying += 1


@kernel
def on_deliver(state: Simulation, now: float) -> int:
    """The next message arrives."""
    run = state.run[0]
    m = pop(state.pool, state.heap, run.flying)
    run.flying -= 1
    arrive(state, m, now)
    return GO_ON


@kernel
def arrive(state: Simulation, m: int, now: float) -> None:
    """A message is put into the inbox of its receiver, unless it is too late."""
    run, message = state.run[0], state.pool[m]
    way = state.ways[message.way]
    one, other = state.nodes[way.sender].id, state.nodes[way.receiver].id
    age = now - message.sent
    if not age <= run.age_limit:
        note(state.run, state.rows, now, LATE, other, one, message.number, age)
        release(state.run, state.pool, m)
        return
    note(state.run, state.rows, now, DELIVER, other, one, message.number, age)
    if state.nodes[way.receiver].inbox == -1:
        state.waiting[run.waiting] = way.receiver
        run.waiting += 1
        run.mail_time = now
    newest_only = run.kind != READINGS
    put(state.run, state.nodes, state.ways, state.pool, way.receiver, m, newest_only)


@kernel
def on_absorb(
    state: Simulation,
    path: PathBlock,
    totals: Totals | None,
    history: History | None,
    now: float,
) -> int:
    """A node uses all that arrived at this instant, in the order of senders."""
    run, pool = state.run[0], state.pool
    if run.absorbing == 0:
        sort_places(state.waiting, run.waiting)
    h = state.waiting[run.absorbing]
    node = state.nodes[h]
    count, oldest, m = 0, 0.0, node.inbox
    while m != -1:
        count, oldest, m = count + 1, max(oldest, now - pool[m].sent), pool[m].next
    if history is not None and history.free[1] < count:
        return WANT_PAST
    if not predict(state, path, h, now):
        return WANT_CUTS
    if totals is not None:
        hear(state, totals, h, now)
    elif history is not None:
        use_mail(state, history, h, now)
    else:
        combine(state, h, now)
    m = node.inbox
    while m != -1:
        following = pool[m].next
        release(state.run, pool, m)
        m = following
    node.inbox = -1
    note(state.run, state.rows, now, ABSORB, node.id, -1, -1, oldest)
    run.absorbing += 1
    if run.absorbing == run.waiting:
        run.absorbing = run.waiting = 0
    return GO_ON


@kernel
def use_mail(state: Simulation, history: History, h: int, now: float) -> None:
    """Readings of other nodes."""
    m = state.nodes[h].inbox
    while m != -1:
        message = state.pool[m]
        if now - message.sent <= 0.0:
            use_reading(state, history, h, message.tag)
        else:
            use_late_reading(state, history, h, message.tag, now)
        m = message.next


@kernel
def combine(state: Simulation, h: int, now: float) -> None:
    """Estimates of other nodes, predicted to now without readings where they took time."""
    run, pool, ways, model = state.run[0], state.pool, state.ways, len(state.table.unit) - 1
    m, heard = state.nodes[h].inbox, 0.0
    while m != -1:
        age = now - pool[m].sent
        if age > 0.0 and (run.kind != SWAP or pool[m].next == -1):
            move_root(state.table, model, state.pool_root, state.pool_x, m, age, state.flow_room)
        heard += ways[pool[m].way].weight
        m = pool[m].next
    if run.kind == CONVEX:
        combine_convex(state, h, max(0.0, 1.0 - heard))
    elif run.kind == INTERSECTION:
        intersect(state, h, max(0.0, 1.0 - heard), 1.0)
    elif run.kind == SHARES:
        own, total = state.nodes[h].own, state.nodes[h].own + heard
        if run.keep_own == 1 or total == 0.0:
            own, total = max(0.0, 1.0 - heard), 1.0
        if own / total != 1.0:
            intersect(state, h, own / total, total)
    elif run.kind == SWAP:
        last = state.nodes[h].last
        copy_state(state.xhat, state.root, h, state.pool_x, state.pool_root, last)


@kernel
def combine_convex(state: Simulation, h: int, own: float) -> None:
    """H (7) and (9): what others sent is a copy, so that sums may grow in their place."""
    xhat, root, pool, ways = state.xhat, state.root, state.pool, state.ways
    scale_root(root, xhat, h, own)
    m = state.nodes[h].inbox
    while m != -1:
        weight = ways[pool[m].way].weight
        add_root(root, xhat, h, weight, state.pool_root, state.pool_x, m, state.update_room)
        m = pool[m].next


@kernel
def intersect(state: Simulation, h: int, own: float, total: float) -> None:
    """D (8) and (9), with weights over their ``total``."""
    xhat, root, room, pool, ways = state.xhat, state.root, state.update_room, state.pool, state.ways
    begin_intersection(room)
    add_to_intersection(own, root, xhat, h, xhat, h, room)
    m = state.nodes[h].inbox
    while m != -1:
        weight = ways[pool[m].way].weight / total
        add_to_intersection(weight, state.pool_root, state.pool_x, m, xhat, h, room)
        m = pool[m].next
    end_intersection(root, xhat, h, xhat, h, room)


@kernel
def on_probe(state: Simulation, path: PathBlock, totals: Totals | None, now: float) -> int:
    """All nodes are shown."""
    if not predict_all(state, path, now):
        return WANT_CUTS
    run, shown, root, n = state.run[0], state.shown, state.root, state.xhat.shape[1]
    taken = run.shown
    for h in range(len(state.nodes)):
        for i in range(n):
            shown.xhat[taken, h, i] = state.xhat[h, i]
            for j in range(i + 1):
                total = 0.0
                for r in range(j + 1):
                    total += root[h, i, r] * root[h, j, r]
                shown.P[taken, h, i, j] = shown.P[taken, h, j, i] = total
    if totals is not None:
        count = len(state.nodes)
        for h in range(count):
            shown.terms[taken, h] = totals.weight[h]
            shown.terms[taken, count + h] = totals.sent[h, 0]
        for w in range(len(state.ways)):
            shown.terms[taken, 2 * count + w] = totals.heard[w, 0]
    shown.rows[taken], shown.piece[taken] = run.row, run.piece
    run.probe_at += 1
    run.shown += 1
    return WANT_SHOWN if run.shown == len(shown.rows) else GO_ON
