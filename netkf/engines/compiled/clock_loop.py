"""The one event loop of all filters under clocks, composed of the verbs of a filter.

``clock_loop`` makes it for a filter's kernels. It finds the next event, predicts the nodes that
take part in it, and calls its handler; events are ordered by (time, rank, entity) as in
``engines.base``. It returns a request when Python has something to do (``events``).
"""

from __future__ import annotations

from functools import cache
from typing import Any

from netkf.algorithms.kernels.run import ClockRun, interval_end
from netkf.algorithms.records import Kernels
from netkf.core.instants import snapped
from netkf.engines.base import LONGER, MIN_GAP_SHARE
from netkf.engines.compiled.batch_arrays import BatchArrays, begin, finish, reset_messages
from netkf.engines.compiled.events import (
    ABSORB,
    DONE,
    GO_ON,
    LOST,
    ON_ABSORB,
    ON_DELIVER,
    ON_REBASE,
    ON_SAMPLE,
    ON_SENSE,
    ON_TICK,
    SEND,
    SENSE,
    TICK,
    TRANSMIT,
    WANT_MESSAGES,
    WANT_PAST,
    WANT_REBASE,
    WANT_SAMPLES,
    arrive,
    count_participants,
    count_sample,
    ends_instant,
    find_shortage,
    is_lost,
    max_readings,
    next_event,
    on_deliver,
    on_sense,
    participant,
    record_event,
    record_event_with_age,
    seek_piece,
    store_sample,
)
from netkf.engines.compiled.increments import fill_readings
from netkf.engines.compiled.message_queue import push, release, sort_indices, take
from netkf.engines.compiled.state import AFTER_READINGS, NODES, Instants, Simulation
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import copy_arrays, copy_row
from netkf.linalg.structs import struct_at

OWN = 0
"""The reading of ``update`` in the tables of a run; those of messages follow."""


@cache
def clock_loop(kernels: Kernels) -> Any:
    """Return the event loop for a filter's kernels, ``loop(state, record, run)``, which returns a
    request (``events``).
    """
    predict_node = prediction_of(kernels)
    on_tick = ticking_of(kernels)
    on_absorb = absorption_of(kernels)
    on_sample = sampling_of(kernels)
    counts_sends, remembers = kernels.counts_sends, kernels.remembers
    observe = kernels.observe

    @kernel
    def predict_participants(
        state: Simulation, record: Any, run: ClockRun, event: int, now: float
    ) -> None:
        """Predict the nodes that take part in an event to ``now`` (seconds)."""
        # The sender of a message that is lost needs no prediction, unless it reads increments.
        lost = event == ON_TICK and not counts_sends and is_lost(state)
        for k in range(count_participants(state, event)):
            h = participant(state, event, k)
            if not lost or state.nodes[h].sensors > state.nodes[h].sensor:
                predict_node(state, record, run, h, now)

    @kernel
    def on_probe(state: Simulation, record: Any, run: ClockRun) -> bool:
        """Store a sample of all nodes; return False if there is no space for another one."""
        for h in range(len(state.nodes)):
            observe(record, h, run)
        store_sample(state, state.run, 0, state.samples)
        return count_sample(state)

    @kernel
    def shortage(state: Simulation, record: Any, event: int, now: float) -> int:
        """Return the request for what an event lacks, as ``find_shortage``."""
        request = int(find_shortage(state, now))
        if remembers and request == GO_ON and lacks_past(state, record, event):
            return WANT_PAST
        return request

    @kernel
    def loop(state: Simulation, record: Any, run: ClockRun) -> int:
        """Simulate the run ``state`` until the loop needs something from Python."""
        while True:
            # Check first that the event has everything it needs: if not, nothing has changed, and
            # the next call finds the same event again.
            event, now = next_event(state)
            request = shortage(state, record, event, now)
            if request != GO_ON:
                return request
            seek_piece(state, now)
            run.now = now
            predict_participants(state, record, run, event, now)
            if event == ON_TICK:
                on_tick(state, record, run, now)
                # Absorptions come next, unless there are other events at this instant.
                if not remembers and state.receivers > 0 and ends_instant(state, now):
                    sort_indices(state.waiting, state.receivers)
                    while state.receivers > 0:
                        predict_node(state, record, run, state.waiting[state.absorbing], now)
                        on_absorb(state, record, run, now)
            elif event == ON_ABSORB:
                on_absorb(state, record, run, now)
            elif event == ON_SENSE:
                on_sense(state, now)
            elif event == ON_SAMPLE:
                on_sample(state, record, run, now)
            elif event == ON_DELIVER:
                on_deliver(state, now)
            elif event == ON_REBASE:
                # Python moves the origin and goes to the next frame.
                return WANT_REBASE
            elif not on_probe(state, record, run):
                return WANT_SAMPLES

    return loop


def prediction_of(kernels: Kernels) -> Any:
    """Return the kernel that predicts a node to a time, using its increments."""
    predict, update, interval = kernels.predict, kernels.update, kernels.interval

    @kernel
    def predict_node(state: Simulation, record: Any, run: ClockRun, h: int, time: float) -> None:
        """Predict node ``h`` to ``time`` (seconds) unless it is there already."""
        node, now, model, least = state.nodes[h], state.now[h], run.model, 0.0
        # ``not <`` also returns for a time that is nan.
        if not now < time:
            return
        state.now[h] = time
        if node.sensors == node.sensor:
            run.gap = time - now
            predict(record, h, run)
            return
        moments = model.moments[: model.gains.moments[node.model]]
        while now < time:
            end, length = time, interval(record, h, run)
            if length < time - now:
                # A lower bound that is set once per gap: a diverging P would make intervals ever
                # shorter.
                if least == 0.0:
                    least = MIN_GAP_SHARE * (time - now)
                end = interval_end(now, time, max(length, least))
            least *= LONGER
            # The increments of a gap are an observation at its end.
            run.gap = end - now
            predict(record, h, run)
            fill_readings(state, state.run, h, state.piece, now, end, moments)
            model.increments = 1
            update(record, h, run)
            model.increments = 0
            now = end

    return predict_node


def sampling_of(kernels: Kernels) -> Any:
    """Return the kernel that updates a node with all its samples of an instant."""
    update = kernels.update

    @kernel
    def on_sample(state: Simulation, record: Any, run: ClockRun, now: float) -> None:
        """Update a node with its samples of the next instant, ``now`` (seconds)."""
        instants, instant = state.instants, state.instant_at
        h, last_node = instants.index[instant], -1
        for s in range(instants.first[instant], instants.first[instant + 1]):
            # A pooled filter reads several nodes at an instant: one row for each.
            if instants.node[s] != last_node:
                last_node = instants.node[s]
                record_event(state, now, SENSE, last_node, -1, -1)
        whiten_instant(state, run, OWN, instant)
        run.reading = OWN
        update(record, h, run)
        state.nodes[h].reading = instant
        state.instant_at += 1

    return on_sample


def ticking_of(kernels: Kernels) -> Any:
    """Return the kernel of the ticks of clocks, and of transmissions after samples."""
    emit, decides, addressed = kernels.emit, kernels.decides, kernels.addressed
    sends_readings, counts_sends = kernels.sends_readings, kernels.counts_sends

    @kernel
    def send_all(
        state: Simulation, record: Any, run: ClockRun, h: int, links: tuple[int, int, int],
        now: float,
    ) -> None:  # fmt: skip
        """Let node ``h`` send one payload on the directed links ``outgoing[first:after]``, whose
        outcomes begin at ``delay[outcome]``; ``links`` = (first, after, outcome).
        """
        first, after, outcome = links
        ticks, broadcast, m = state.ticks, state.clock_kind >= NODES, take(state)
        arrives = counts_sends or decides
        for k in range(after - first):
            arrives = arrives or ticks.delay[outcome + k] >= 0.0
        run.sends[0] = 1
        if arrives and not addressed:
            emit(record, h, m, run)
        if decides and run.sends[0] == 0:
            release(state, m)
            return
        if broadcast:
            record_event(state, now, TRANSMIT, state.nodes[h].id, -1, state.nodes[h].sent)
            state.nodes[h].sent += 1
        # The reading of this instant goes with the message.
        tag, used = -1, False
        if sends_readings:
            reading = state.nodes[h].reading
            if reading >= 0 and state.instants.t[reading] == now:
                tag = reading
        for k in range(first, after):
            w = state.outgoing[k]
            delay = snapped(ticks.delay[outcome + k - first], state.per_second)
            if is_sent(state, w, delay, now):
                copy = m
                if used:
                    copy = take(state)
                    if not addressed:
                        copy_row(record.payload, copy, m)
                used = True
                if addressed:
                    run.receiver = run.opposite[state.incoming[w]]
                    emit(record, h, copy, run)
                dispatch(state, w, copy, tag, delay, now)
        if not used:
            release(state, m)

    @kernel
    def on_tick(state: Simulation, record: Any, run: ClockRun, now: float) -> None:
        """Handle the next tick of a clock at ``now`` (seconds), or a transmission after a sample:
        send on each directed link of its entity.
        """
        ticks, nodes, k = state.ticks, state.nodes, state.tick_at
        entity = state.entities[ticks.entity[k]]
        i, j = entity.sender, entity.other
        # A transmission after a sample has no tick of its own.
        if state.clock_kind != AFTER_READINGS:
            record_event(state, now, TICK, nodes[i].id, nodes[j].id if j >= 0 else -1, -1)
        state.tick_at += 1
        outcome = state.first_delay + ticks.first_outcome[k]
        if state.clock_kind >= NODES:
            send_all(state, record, run, i, (entity.first, entity.after, outcome), now)
            return
        # Each end of a link sends a payload of its own.
        for w in range(entity.first, entity.after):
            h = state.directions[state.outgoing[w]].sender
            send_all(state, record, run, h, (w, w + 1, outcome + w - entity.first), now)

    return on_tick


def absorption_of(kernels: Kernels) -> Any:
    """Return the kernel by which a node absorbs the messages of an instant."""
    absorb, sends_readings = kernels.absorb, kernels.sends_readings

    @kernel
    def on_absorb(state: Simulation, record: Any, run: ClockRun, now: float) -> None:
        """Let the next node absorb all messages of this instant ``now`` (seconds), in the order of
        senders.
        """
        pool, h = state.pool, state.waiting[state.absorbing]
        node, oldest, count = state.nodes[h], 0.0, 0
        m = node.inbox
        while m != -1:
            message = pool[m]
            age = snapped(now - message.sent, state.per_second)
            oldest = max(oldest, age)
            w = message.direction
            run.message[count], run.link[count] = m, state.incoming[w]
            run.message_weight[count], run.age[count] = state.directions[w].weight, age
            if sends_readings:
                run.heard[count] = -1
                if message.tag >= 0:
                    whiten_instant(state, run, count + 1, message.tag)
                    run.heard[count] = count + 1
                if len(run.pairs.row) > 0:
                    whiten_pairs(state, run, count + 1, message.tag)
            count, m = count + 1, message.next
        run.count = count
        absorb(record, h, run)
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

    return on_absorb


@kernel
def lacks_past(state: Simulation, record: Any, event: int) -> bool:
    """Return True if an event may add more past events to a node than there is room for."""
    if event not in (ON_SAMPLE, ON_ABSORB):
        return False
    h = participant(state, event, 0)
    return bool(record.kept[h, 0] + max_readings(state, event) > record.room)


@kernel
def whiten_instant(state: Simulation, run: ClockRun, r: int, instant: int) -> None:
    """Write all samples of an ``instant`` (index in ``state.instants``) as reading ``r`` of the
    run, multiplied by the inverse of the root of R, so that the noise of each row has variance 1.
    """
    instants, row = state.instants, 0
    for s in range(instants.first[instant], instants.first[instant + 1]):
        # Readings of pairs are for others.
        if instants.block[s] == -1:
            whiten_sample(instants, run, r, s, row, len(run.size))
            row += instants.rows[instants.sensor[s]]
    run.rows[r] = row


@kernel(inlined=True)
def whiten_sample(
    instants: Instants, run: ClockRun, r: int, s: int, row: int, columns: int
) -> None:
    """Write sample ``s``, whitened, as the rows of reading ``r`` from ``row`` on."""
    sensor, matrix = instants.sensor[s], instants.matrix[s]
    for i in range(instants.rows[sensor]):
        scale = 1.0 / instants.root[sensor, i, i]
        y = instants.y[s, i]
        for k in range(i):
            y -= instants.root[sensor, i, k] * run.y[r, row + k, 0]
        run.y[r, row + i, 0] = y * scale
        for j in range(columns):
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
            whiten_sample(instants, run, r, s, row, instants.H.shape[2])
            rows = instants.rows[instants.sensor[s]]
            pairs.block[0, last], pairs.row[last], pairs.length[last] = instants.block[s], row, rows
            row, last = row + rows, last + 1
    pairs.first[r + 1] = last


@kernel
def is_sent(state: Simulation, w: int, delay: float, now: float) -> bool:
    """Record that a message is sent on directed link ``w``, and whether it is lost, which a
    ``delay`` that is negative or nan says; return True if it will arrive.
    """
    direction = state.directions[w]
    number = direction.messages
    # A lost message has a number too: recorded losses refer to it.
    direction.messages += 1
    sender_id = state.nodes[direction.sender].id
    receiver_id = state.nodes[direction.receiver].id
    record_event(state, now, SEND, sender_id, receiver_id, number)
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


@cache
def batch_loop(kernels: Kernels) -> Any:
    """Return the kernel of a batch of runs, ``simulate(state, record, start, run, batch_memory,
    first, resumed)``: it simulates them from number ``first`` on, each from the record ``start``,
    and returns the number of the run that needs a larger pool of messages, or the number of runs.
    """
    loop = clock_loop(kernels)

    @kernel
    def simulate(
        state: Simulation, record: Any, start: Any, run: ClockRun, batch_memory: Any,
        first: int, resumed: bool,
    ) -> int:  # fmt: skip
        """Simulate the runs of a batch; ``resumed``: the first goes on where it stopped."""
        batch, r = struct_at(batch_memory, BatchArrays), first
        while r < len(batch.lengths):
            if not resumed:
                state.first_run = r
                copy_arrays(record, start)
                for h in range(len(batch.nodes)):
                    state.nodes[h] = batch.nodes[h]
                    state.now[h] = 0.0
                reset_messages(state)
                begin(state, batch, r)
            resumed, request = False, -1
            while request != DONE:
                request = loop(state, record, run)
                if request == WANT_MESSAGES:
                    return r
            finish(state, batch, r)
            r += 1
        return r

    return simulate


@cache
def shift_loop(kernels: Kernels) -> Any:
    """Return the kernel that moves the origin of all nodes of a run by ``-run.offset``."""
    shift = kernels.shift

    @kernel
    def shift_all(record: Any, run: ClockRun) -> None:
        """Shift every node."""
        for h in range(len(record.xhat)):
            shift(record, h, run)

    return shift_all
