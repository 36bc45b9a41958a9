"""The one event loop of all filters under clocks, which calls the verbs of a filter by address.

It finds the next event, predicts the nodes that take part in it, and calls its handler; events are
ordered by (time, rank, entity) as in ``engines.base``. It returns a request when Python has
something to do (``events``).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.kernels import run as standard
from netkf.algorithms.kernels.gates import pass_gate, scale_rows
from netkf.algorithms.kernels.rates import RateTables
from netkf.algorithms.kernels.run import ALL, ClockRun, interval_end
from netkf.algorithms.records import Kernels
from netkf.core.instants import snapped
from netkf.engines.base import LONGER, MIN_GAP_SHARE
from netkf.engines.compiled.batch_arrays import BatchArrays, begin_run, finish, reset_messages
from netkf.engines.compiled.events import (
    ABSORB,
    CLIP,
    DONE,
    GO_ON,
    LOST,
    NONE_SENT,
    ON_ABSORB,
    ON_DELIVER,
    ON_LIFE,
    ON_REBASE,
    ON_SAMPLE,
    ON_SENSE,
    ON_TICK,
    REFUSE,
    SEND,
    SENSE,
    SOME_ARRIVE,
    TICK,
    TRANSMIT,
    WANT_LIFE,
    WANT_MESSAGES,
    WANT_PAST,
    WANT_REBASE,
    WANT_SAMPLES,
    arrive,
    count_participants,
    count_sample,
    ends_instant,
    find_shortage,
    local_time,
    max_readings,
    next_event,
    next_reached,
    on_sense_or_deliver,
    participant,
    reached,
    record_event,
    record_event_with_age,
    record_links,
    seek_piece,
    skip_if_down,
    stamped_age,
    store_sample,
)
from netkf.engines.compiled.increments import fill_readings
from netkf.engines.compiled.message_queue import push, release, sort_indices, take_free
from netkf.engines.compiled.nonlinear_samples import (
    linearise_instant,
    no_table,
    set_linear,
    set_pair,
)
from netkf.engines.compiled.outcomes import OUT_OF_RANGE
from netkf.engines.compiled.quantiser import clear_payloads, quantise_payloads
from netkf.engines.compiled.state import AFTER_READINGS, NODES, Instants, Simulation
from netkf.linalg.addresses import NOTHING, address_of, call_at, call_at_two, number_at
from netkf.linalg.arrays import IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import copy_arrays, copy_row, struct_like
from netkf.linalg.structs import Struct, struct_at

FLAGS = ("decides", "sends_readings", "remembers", "counts_sends", "addressed")
"""Names of properties of kernels that the loop asks for."""
OWN = 0
"""The reading of ``update`` in the tables of a run; those of messages follow."""


class ClockVerbs(Struct):
    """Addresses of a filter's verbs, and what ``records.Kernels`` says of them as 0 or 1.

    copy : copies a payload to another one
    restart : copies all arrays of a record that is given in place of a run
    translate : makes of a message of another node what the receiver reads in it
    linearise : makes linear readings of the samples of an instant that are not
    gate : lets a reading pass the gate, where there is one
    whole_gaps : whether a prediction over a gap is not that over its parts
    models : (N, words), the struct of each node's model, (0, 0) if that of the run is all's
    kept, room : of a filter that remembers, see ``records.Record``
    """

    predict: int
    update: int
    emit: int
    absorb: int
    observe: int
    interval: int
    copy: int
    restart: int
    translate: int
    linearise: int
    gate: int
    whole_gaps: int
    decides: int
    sends_readings: int
    remembers: int
    counts_sends: int
    addressed: int
    room: int
    kept: IntArray
    models: IntArray


NO_MODELS: IntArray = np.zeros((0, 0), dtype=np.int64)


@kernel
def copy_payload(record: Any, to: int, m: int, _run: Any) -> None:
    """Copy payload ``m`` of a record."""
    copy_row(record.payload, to, m)


@kernel
def restart(record: Any, _h: int, start: Any) -> None:
    """Make all arrays of a record those of ``start``."""
    copy_arrays(record, start)


def clock_verbs(
    kernels: Kernels, record: Any, run: Any, increments: bool, linear: bool, models: IntArray
) -> ClockVerbs:
    """Return the verbs of a filter for its record and its run; ``increments``: some nodes read;
    ``linear``: all samples are. Of a run with other than ClockTables nodes may have own ``models``.
    """
    observes = kernels.observe is not standard.observe
    return ClockVerbs(
        predict=address_of(kernels.predict, record, run),
        update=address_of(kernels.update, record, run),
        emit=address_of(kernels.emit, record, run, 2),
        absorb=address_of(kernels.absorb, record, run),
        observe=address_of(kernels.observe, record, run) if observes else NOTHING,
        interval=address_of(kernels.interval, record, run, number=True) if increments else NOTHING,
        copy=address_of(copy_payload, record, run, 2),
        restart=address_of(restart, record, record),
        translate=address_of(standard.read_common, record, run, 2) if len(run.common) else NOTHING,
        linearise=NOTHING if linear else address_of(linearise_instant, record, no_table(), 2),
        gate=address_of(pass_gate, record, run, 2) if run.gate.active else NOTHING,
        whole_gaps=isinstance(run.model, RateTables),
        **{name: getattr(kernels, name) for name in FLAGS},
        room=record.room if kernels.remembers else 0,
        kept=record.kept if kernels.remembers else np.zeros((0, 1), dtype=np.int64),
        models=models,
    )


@kernel
def clock_loop(state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs) -> int:
    """Simulate the run ``state`` until the loop needs something from Python."""
    while True:
        # Check first that the event has everything it needs: if not, nothing has changed, and
        # the next call finds the same event again.
        event, now = next_event(state)
        request = find_shortage(state, now)
        if request == GO_ON and verbs.remembers == 1 and lacks_past(state, verbs, event):
            request = WANT_PAST
        if request != GO_ON:
            return request
        seek_piece(state, now)
        if skip_if_down(state, event):
            continue
        predict_participants(state, record, run, verbs, event, now)
        if event == ON_TICK:
            on_tick(state, record, run, verbs, now)
            # Absorptions come next, unless there are other events at this instant: those of all its
            # ticks, which need more space than one event.
            if verbs.remembers == 0 and state.receivers > 0 and ends_instant(state, now):
                sort_indices(state.waiting, state.receivers)
                while state.receivers > 0 and find_shortage(state, now) == GO_ON:
                    predict_node(state, record, run, verbs, state.waiting[state.absorbing], now)
                    on_absorb(state, record, run, verbs, now)
        elif event == ON_ABSORB:
            on_absorb(state, record, run, verbs, now)
        elif event in (ON_SENSE, ON_DELIVER):
            on_sense_or_deliver(state, event, now)
        elif event == ON_SAMPLE:
            on_sample(state, record, run, verbs, now)
        elif event in (ON_REBASE, ON_LIFE):
            # Python moves the origin or the node, and goes to the next frame or life.
            return WANT_LIFE if event == ON_LIFE else WANT_REBASE
        elif not on_probe(state, record, run, verbs):
            return WANT_SAMPLES


@kernel
def predict_participants(
    state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, event: int, now: float
) -> None:
    """Predict the nodes that take part in an event to ``now`` (seconds)."""
    lost = False
    if event == ON_TICK:
        becomes = next_reached(state)
        if becomes == NONE_SENT and state.clock_kind < NODES:
            return
        # The sender of a message that is lost needs no prediction, unless it reads increments.
        lost = becomes != SOME_ARRIVE and verbs.counts_sends + verbs.whole_gaps == 0
    for k in range(count_participants(state, event)):
        h = participant(state, event, k)
        if event == ON_TICK and state.nodes[h].down == 1:
            continue
        if not lost or state.nodes[h].sensors > state.nodes[h].sensor:
            predict_node(state, record, run, verbs, h, now)


@kernel
def on_probe(state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs) -> bool:
    """Store a sample of all nodes; return False if there is no space for another one."""
    for h in range(len(state.nodes) if verbs.observe != NOTHING else 0):
        choose_model(state, run, verbs, h)
        call_at(verbs.observe, record, h, run)
    record_links(state, -1 - state.probe_at, state.probes[state.probe_at])
    store_sample(state, state.run, 0, state.samples)
    return count_sample(state)


@kernel
def predict_node(
    state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, h: int, time: float
) -> None:
    """Predict node ``h`` to ``time`` (seconds) unless it is there already, using its increments;
    what passes for it is time by its clock.
    """
    time = local_time(state, h, time)
    node, now, model, least = state.nodes[h], state.now[h], run.model, 0.0
    # ``not <`` also returns for a time that is nan.
    if not now < time:
        return
    state.now[h] = time
    choose_model(state, run, verbs, h)
    if node.sensors == node.sensor:
        run.gap = time - now
        call_at(verbs.predict, record, h, run)
        return
    moments = model.moments[: model.gains.moments[node.model]]
    while now < time:
        end, length = time, number_at(verbs.interval, record, h, run)
        if length < time - now:
            # A lower bound that is set once per gap: a diverging P would make intervals ever
            # shorter.
            if least == 0.0:
                least = MIN_GAP_SHARE * (time - now)
            end = interval_end(now, time, max(length, least))
        least *= LONGER
        # The increments of a gap are an observation at its end.
        run.gap = end - now
        call_at(verbs.predict, record, h, run)
        # A node that is down does not use them: what others read must not depend on it.
        fill_readings(state, state.run, h, state.piece, now, end, moments)
        if node.down == 0:
            model.increments = 1
            call_at(verbs.update, record, h, run)
            model.increments = 0
        now = end


@kernel(inlined=True)
def choose_model(state: Simulation, run: ClockRun, verbs: ClockVerbs, h: int) -> None:
    """Make the time of node ``h`` that of the run, and its model where nodes have own ones."""
    run.now = state.now[h]
    if len(verbs.models) > 0:
        run.model = struct_like(run.model, verbs.models[h])


@kernel
def on_sample(state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, now: float) -> None:
    """Update a node with its samples of the next instant, ``now`` (seconds)."""
    instants, instant = state.instants, state.instant_at
    h, last_node = instants.index[instant], -1
    for s in range(instants.first[instant], instants.first[instant + 1]):
        # A pooled filter reads several nodes at an instant: one row for each that is up.
        if instants.node[s] >= 0 and instants.node[s] != last_node:
            last_node = instants.node[s]
            record_event(state, now, SENSE, last_node, -1, -1)
    if verbs.linearise != NOTHING:
        call_at_two(verbs.linearise, record, h, instant, instants.nonlinear)
    whiten_instant(state, run, OWN, instant)
    run.reading = OWN
    if verbs.gate != NOTHING:
        pass_instant(state, record, run, verbs, h, now)
    if len(run.pairs.row) > 0:
        whiten_pairs(state, run, OWN, instant)
    choose_model(state, run, verbs, h)
    call_at(verbs.update, record, h, run)
    state.nodes[h].reading = instant
    state.instant_at += 1


@kernel
def pass_instant(
    state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, h: int, now: float
) -> None:
    """Let the samples of the next instant, ``now`` (seconds), pass the gate of node ``h``."""
    instants, gate, instant, row, count = state.instants, run.gate, state.instant_at, 0, 0
    for s in range(instants.first[instant], instants.first[instant + 1]):
        if instants.block[s] == -1:
            gate.row[count], gate.length[count] = row, instants.rows[instants.sensor[s]]
            row, count = row + gate.length[count], count + 1
    gate.first[1] = count
    call_at_two(verbs.gate, record, h, 0, run)
    count, refused = 0, False
    for s in range(instants.first[instant], instants.first[instant + 1]):
        if instants.block[s] == -1:
            instants.scale[s] = gate.scale[count, 0]
            if instants.scale[s] != 1.0:
                refused = True
                record_event(state, now, REFUSE, instants.node[s], -1, -1)
            count += 1
    if refused:
        # Without the samples that are ignored.
        whiten_instant(state, run, OWN, instant)


@kernel
def on_tick(state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, now: float) -> None:
    """Handle the next tick of a clock at ``now`` (seconds), or a transmission after a sample:
    send on each directed link of its entity.
    """
    ticks, nodes, k = state.ticks, state.nodes, state.tick_at
    entity = state.entities[ticks.entity[k]]
    i, j = entity.sender, entity.other
    # A transmission after a sample has no tick of its own.
    if state.clock_kind != AFTER_READINGS:
        record_event(state, now, TICK, nodes[i].id, nodes[j].id if j >= 0 else -1, -1)
    record_links(state, k, now)
    state.tick_at += 1
    outcome = state.first_delay + ticks.first_outcome[k]
    if state.clock_kind >= NODES:
        send_all(state, record, run, verbs, i, (entity.first, entity.after, outcome), now)
        return
    # Each end of a link sends a payload of its own.
    for w in range(entity.first, entity.after):
        h = state.directions[state.outgoing[w]].sender
        if state.nodes[h].down == 0:
            send_all(state, record, run, verbs, h, (w, w + 1, outcome + w - entity.first), now)


@kernel
def send_all(
    state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, h: int,
    links: tuple[int, int, int], now: float,
) -> None:  # fmt: skip
    """Let node ``h`` send one payload on the directed links ``outgoing[first:after]``, whose
    outcomes begin at ``delay[outcome]``; ``links`` = (first, after, outcome).
    """
    first, after, outcome = links
    ticks, broadcast = state.ticks, state.clock_kind >= NODES
    becomes = reached(state, first, after, outcome)
    if becomes == NONE_SENT and not broadcast:
        return
    m = take_free(state)
    arrives = becomes == SOME_ARRIVE or verbs.counts_sends == 1 or verbs.decides == 1
    run.sends[0] = 1
    choose_model(state, run, verbs, h)
    few_bits, payload, count = len(state.quantiser.fields) > 0, m, 1
    if few_bits and verbs.addressed == 1:
        # All its messages at once, behind those under way, as each takes dither.
        payload, count = len(run.message), run.first[h + 1] - run.first[h] + 1
        run.receiver = ALL
    if arrives and (few_bits or verbs.addressed == 0):
        clear_payloads(state.quantiser, payload, count)
        call_at_two(verbs.emit, record, h, payload, run)
    if run.sends[0] == 0:
        release(state, m)
        return
    if becomes != NONE_SENT:
        state.clipped = quantise_payloads(state.quantiser, h, payload, count, 0)
    if broadcast:
        record_event(state, now, TRANSMIT, state.nodes[h].id, -1, state.nodes[h].sent)
        state.nodes[h].sent += 1
    tag, used = -1 if verbs.sends_readings == 0 else reading_at(state, h, now), False
    for k in range(first, after):
        w = state.outgoing[k]
        delay = snapped(ticks.delay[outcome + k - first], state.per_second)
        if send_on_link(state, w, delay, now):
            copy = m
            if used:
                copy = take_free(state)
                if verbs.addressed == 0:
                    call_at_two(verbs.copy, record, copy, m, run)
            used = True
            if verbs.addressed == 1:
                address_message(state, record, run, verbs, (h, w), copy, payload)
            dispatch(state, w, copy, tag, delay, now)
    if not used:
        release(state, m)


@kernel
def address_message(
    state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, of: tuple[int, int],
    m: int, payload: int,
) -> None:  # fmt: skip
    """Let node ``h`` write payload ``m`` for the receiver of directed link ``w``, ``of`` both, or
    copy it from those emitted from ``payload`` on, if that is not the same place.
    """
    h, w = of
    run.receiver = run.opposite[state.incoming[w]]
    if len(state.quantiser.fields) == 0:
        call_at_two(verbs.emit, record, h, m, run)
        return
    first, last = run.first[h], run.first[h + 1]
    link = run.receiver if run.receiver >= 0 else last
    call_at_two(verbs.copy, record, m, payload + link - first, run)


@kernel
def reading_at(state: Simulation, h: int, now: float) -> int:
    """Return the instant of the reading of ``h`` that goes with its message ``now``, or -1."""
    reading = state.nodes[h].reading
    return int(reading) if reading >= 0 and state.instants.t[reading] == now else -1


@kernel
def on_absorb(state: Simulation, record: Any, run: ClockRun, verbs: ClockVerbs, now: float) -> None:
    """Let the next node absorb all messages of the instant ``now`` (s), in order of senders."""
    pool, h = state.pool, state.waiting[state.absorbing]
    node, oldest, count = state.nodes[h], 0.0, 0
    if len(run.pairs.row) > 0:
        # The reading of this instant, of which messages may bring another part.
        own = reading_at(state, h, now)
        run.reading, run.rows[OWN] = OWN, 0
        if own >= 0:
            whiten_instant(state, run, OWN, own)
        whiten_pairs(state, run, OWN, own)
    m = node.inbox
    while m != -1:
        message = pool[m]
        age = stamped_age(state, m, now)
        oldest = max(oldest, age)
        w = message.direction
        run.message[count], run.link[count] = m, state.incoming[w]
        run.message_weight[count], run.age[count] = state.directions[w].weight, age
        if verbs.sends_readings == 1:
            run.heard[count] = -1
            if message.tag >= 0:
                whiten_instant(state, run, count + 1, message.tag)
                run.heard[count] = count + 1
            if len(run.pairs.row) > 0:
                whiten_pairs(state, run, count + 1, message.tag)
        count, m = count + 1, message.next
    run.count = count
    choose_model(state, run, verbs, h)
    for k in range(count if verbs.translate != NOTHING else 0):
        # Behind all messages under way.
        call_at_two(verbs.emit, record, h, len(run.message) + k, run)
        call_at_two(verbs.translate, record, len(run.message) + k, k, run)
    call_at(verbs.absorb, record, h, run)
    # Messages return to the pool only now, since their payloads were read.
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
def lacks_past(state: Simulation, verbs: ClockVerbs, event: int) -> bool:
    """Return True if an event may add more past events to a node than there is room for."""
    if event not in (ON_SAMPLE, ON_ABSORB):
        return False
    h = participant(state, event, 0)
    return bool(verbs.kept[h, 0] + max_readings(state, event) > verbs.room)


@kernel
def whiten_instant(state: Simulation, run: ClockRun, r: int, instant: int) -> None:
    """Write all samples of an ``instant`` (index in ``state.instants``) as reading ``r`` of the
    run, multiplied by the inverse of the root of R, so that the noise of each row has variance 1.
    """
    instants, row = state.instants, 0
    gated = len(instants.scale) > 0
    for s in range(instants.first[instant], instants.first[instant + 1]):
        # Readings of pairs are for others.
        if instants.block[s] == -1 and not (gated and instants.scale[s] == 0.0):
            whiten_sample(instants, run, r, s, row, len(run.size))
            if gated and instants.scale[s] != 1.0:
                place = r, row, instants.rows[instants.sensor[s]]
                scale_rows(run, place, 0, instants.scale[s])
            row += instants.rows[instants.sensor[s]]
    run.rows[r] = row


@kernel(inlined=True)
def whiten_sample(instants: Instants, run: ClockRun, r: int, s: int, row: int, width: int) -> None:
    """Write sample ``s``, whitened, as the rows of reading ``r`` from ``row`` on."""
    sensor, matrix = instants.sensor[s], instants.matrix[s]
    for i in range(instants.rows[sensor]):
        scale = 1.0 / instants.root[sensor, i, i]
        y = instants.y[s, i]
        for k in range(i):
            y -= instants.root[sensor, i, k] * run.y[r, row + k, 0]
        run.y[r, row + i, 0] = y * scale
        for j in range(width):
            entry = instants.H[matrix, i, j]
            for k in range(i):
                entry -= instants.root[sensor, i, k] * run.H[r, row + k, j, 0]
            run.H[r, row + i, j, 0] = entry * scale


@kernel
def whiten_pairs(state: Simulation, run: ClockRun, r: int, instant: int) -> None:
    """Write the readings of pairs of an ``instant`` behind the rows of reading ``r``; those of an
    inbox are written in order, and an ``instant`` of -1 has none.
    """
    instants, pairs, row, last = state.instants, run.pairs, run.rows[r], run.pairs.first[r]
    pairs.first[r + 1] = last
    if instant < 0:
        return
    for s in range(instants.first[instant], instants.first[instant + 1]):
        if instants.block[s] >= 0:
            rows = instants.rows[instants.sensor[s]]
            if len(instants.nonlinear.sensor) > 0 and instants.nonlinear.sensor[s] >= 0:
                for i in range(rows):
                    run.y[r, row + i, 0] = instants.y[s, i]
                set_pair(pairs, last, instants.nonlinear, s)
            else:
                whiten_sample(instants, run, r, s, row, instants.H.shape[2])
                set_linear(pairs, last)
            pairs.block[0, last], pairs.row[last], pairs.length[last] = instants.block[s], row, rows
            row, last = row + rows, last + 1
    pairs.first[r + 1] = last


@kernel
def send_on_link(state: Simulation, w: int, delay: float, now: float) -> bool:
    """Record that a message is sent on directed link ``w``, unless it is OUT_OF_RANGE, and whether
    it is lost, which a ``delay`` that is negative or nan says; return True if it will arrive.
    """
    direction = state.directions[w]
    number = direction.messages
    if delay == OUT_OF_RANGE:
        return False
    # A lost message has a number too: recorded losses refer to it.
    direction.messages += 1
    sender_id = state.nodes[direction.sender].id
    receiver_id = state.nodes[direction.receiver].id
    record_event(state, now, SEND, sender_id, receiver_id, number)
    if state.clipped > 0:
        record_event(state, now, CLIP, sender_id, -1, state.clipped)
        state.clipped = 0
    # ``not >=`` catches both LOST, which is negative, and nan.
    if not delay >= 0.0:
        record_event(state, now, LOST, sender_id, receiver_id, number)
        return False
    # The horizon is half open: a message that arrives after it leaves no event.
    arrival = snapped(now + delay, state.per_second)
    return not (delay > 0.0 and not arrival < state.horizon)


@kernel
def dispatch(state: Simulation, w: int, m: int, tag: int, delay: float, now: float) -> None:
    """Deliver message ``m``, sent on directed link ``w`` at ``now``, at once, or put it on the heap
    for ``delay`` seconds; ``tag`` is the instant of the reading that it brings, or -1.
    """
    message = state.pool[m]
    message.direction, message.number = w, state.directions[w].messages - 1
    message.sent, message.tag = now, tag
    if delay == 0.0:
        arrive(state, m, now)
        return
    # ``order`` breaks ties between messages of one link that arrive at the same time.
    message.arrival = snapped(now + delay, state.per_second)
    message.order = state.order
    state.order += 1
    push(state.pool, state.heap, state.in_flight, m)
    state.in_flight += 1


@kernel
def batch_loop(
    state: Simulation, record: Any, start: Any, run: ClockRun, verbs: ClockVerbs,
    batch_memory: Any, first: int, after: int, resumed: bool,
) -> int:  # fmt: skip
    """Simulate the runs of a batch from number ``first`` to ``after`` - 1, each from the record
    ``start``; return the number of the run that needs a larger pool of messages, or ``after``.
    ``resumed``: the first goes on where it stopped.
    """
    batch, r = struct_at(batch_memory, BatchArrays), first
    while r < after:
        if not resumed:
            state.first_run = r
            call_at(verbs.restart, record, 0, start)
            for h in range(len(batch.nodes)):
                state.nodes[h] = batch.nodes[h]
                state.now[h] = 0.0
            reset_messages(state)
            begin_run(state, batch, r)
        resumed, request = False, -1
        while request != DONE:
            request = clock_loop(state, record, run, verbs)
            if request == WANT_MESSAGES:
                return r
        finish(state, batch, r)
        r += 1
    return r
