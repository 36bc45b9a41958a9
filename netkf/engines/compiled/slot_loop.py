"""The one loop of all filters in slots, which calls the verbs of a filter by address.

It simulates S slots of B blocks of L runs in one call, from the draws of a :class:`SlotPlan`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.kernels import run as standard
from netkf.algorithms.kernels.gates import pass_gate
from netkf.algorithms.kernels.nonlinear_rows import linearise_rows
from netkf.algorithms.kernels.run import SlotRun
from netkf.algorithms.records import Kernels
from netkf.engines.compiled.quantiser import Quantiser, clear_payloads, quantise_payloads
from netkf.linalg.addresses import NOTHING, AnyStruct, address_of, call_at, call_at_two, viewed_as
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import struct_like
from netkf.linalg.lanes import (
    Lanes,
    any_lane,
    load,
    load_flags,
    scatter,
    spread,
    store,
    store_flags,
)
from netkf.linalg.structs import Struct

PREDICT, SENSE, EXCHANGE = range(3)
WHOLE = -1
"""A call begins with a slot, and ends with one."""


class SlotPlan(Struct):
    """What happens in S slots of B blocks of L runs, with E steps of the exchanges in each slot, W
    directed links and H filters.

    first : number of the first slot
    stages, phases, steps : (G,) kinds of the stages of a slot, in order (PREDICT, SENSE or
        EXCHANGE), and for exchanges the number of their phase and the repetitions
    predicts : samples show the predictions with which slots begin
    sensed, exchanged : (S,), whether nodes read and predict, and whether they exchange
    sample : (S,), index of the slot's sample, -1: none
    rebased : (S,), whether the origin moves to the state of the slot
    up : (B, S, E, W, L), 1 if a message arrives on a directed link in a step of the exchanges
    direction : (W,), index in the axis W of ``up`` of each link by receiver
    sent : (B, S, E, H, L), 1 if a node is asked for a message, and where kernels decide 0 where it
        sends nothing; empty if all nodes are asked, and send
    uniform : (B, S, E, H, L), uniform numbers for these decisions; empty unless randomised
    refused : (B, S, G, L), 1 where a gate refuses a part of a reading; empty without one
    quantiser : how messages are quantised, see ``quantiser``
    speaks : (B, S, E, H, L), 1 if a node has links to send on, where messages are of few bits
    clipped : (B, S, E, H, L), how many numbers of its message are clipped, if they are
    varies : whether H differs from block to block and slot to slot
    models : (H, words), the struct of each filter's model, (0, words) if ``run.model`` is all's
    start, end : the slots that a call simulates, of those of the plan
    begin, stop : a call may simulate a part of one slot: from the arrival of the messages of step
        ``begin`` to the sending of those of step ``stop``; WHOLE: from its begin, to its end
    """

    first: int
    stages: IntArray
    phases: IntArray
    steps: IntArray
    predicts: int
    sensed: np.ndarray
    exchanged: np.ndarray
    sample: IntArray
    rebased: np.ndarray
    up: np.ndarray
    direction: IntArray
    sent: np.ndarray
    uniform: FloatArray
    refused: np.ndarray
    quantiser: Quantiser
    speaks: np.ndarray
    clipped: np.ndarray
    varies: int
    models: IntArray
    begin: int
    stop: int
    start: int
    end: int


class SlotSamples(Struct):
    """T samples of R runs that the loop writes, and the true states of S slots that they need.

    x, xhat, P : (R, T, n), (R, T, H w) and (R, T, H w w) in the coordinates of the plant, with all
                 filters of at most w states side by side
    error : (R, T, H w), x - xhat
    absolute, local : (B, S, n, L), true states in all slots, in the coordinates of the plant and
                      relative to the moving origin that estimates refer to
    framed : whether the origin moves; otherwise both are the same
    total : (B, L), sum of all samples of xhat and P so far: finite if all of them are
    sampled_xhat, sampled_error, sampled_P : (>= K H w, L), (>= K H w, L) and (>= K H w w, L), last
                                             samples of a block, at most K = ``room``
    first, held : the number of the first of these, and how many there are
    runs : (L,), the run of each lane, -1 if it is idle
    entries : (H, w), the entries of the state that each filter estimates, and any beyond; (0, 0)
              if all estimate all
    """

    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray
    absolute: FloatArray
    local: FloatArray
    framed: int
    total: FloatArray
    sampled_xhat: FloatArray
    sampled_error: FloatArray
    sampled_P: FloatArray
    room: int
    first: int
    held: int
    runs: np.ndarray
    entries: np.ndarray


class SlotVerbs(Struct):
    """Addresses of a filter's verbs, and what ``records.Kernels`` says of them as 0 or 1.

    linearise : of ``linearise_rows``, where readings are not linear
    gate : of ``pass_gate``, where there is one
    translate : of ``read_common``
    """

    predict: int
    update: int
    emit: int
    absorb: int
    observe: int
    shift: int
    linearise: int
    gate: int
    translate: int
    decides: int
    addressed: int


class AnySlotRun(Struct):
    """A SlotRun, or what stands for one, whatever its size and its model."""

    __annotations__ = SlotRun.__annotations__


def any_slot_run(run: Struct) -> Any:
    """Return a SlotRun, or what stands for one, as an AnySlotRun."""
    return viewed_as(AnySlotRun, run, size=(np.dtype(np.float64), 1), model=AnyStruct)


def slot_verbs(kernels: Kernels, record: Any, run: Any, talks: bool, linear: bool) -> SlotVerbs:
    """Return the verbs of a filter for its record and its run: whether nodes send messages, and all
    readings are ``linear``. ``shift`` comes when the origin moves.
    """
    observes = kernels.observe is not standard.observe
    writes = talks and kernels.emit is not standard.emit_nothing
    return SlotVerbs(
        predict=address_of(kernels.predict, record, run),
        update=address_of(kernels.update, record, run),
        emit=address_of(kernels.emit, record, run, 2) if writes else NOTHING,
        absorb=address_of(kernels.absorb, record, run) if talks else NOTHING,
        observe=address_of(kernels.observe, record, run) if observes else NOTHING,
        shift=NOTHING,
        linearise=NOTHING if linear else address_of(linearise_rows, record, any_slot_run(run), 2),
        gate=address_of(pass_gate, record, any_slot_run(run), 2) if run.gate.active else NOTHING,
        translate=address_of(standard.read_common, record, run, 2) if len(run.common) else NOTHING,
        decides=kernels.decides,
        addressed=kernels.addressed,
    )


@kernel
def slot_loop(
    record: Any, memories: np.ndarray, run: AnySlotRun, plan: SlotPlan, samples: SlotSamples,
    verbs: SlotVerbs,
) -> None:  # fmt: skip
    """Simulate the slots of a ``plan``: ``memories`` (B, words) hold the record of each block, of
    which ``record`` is the first.
    """
    nodes, slots = len(record.xhat), plan.up.shape[1]
    for b in range(len(memories)):
        block = struct_like(record, memories[b])
        for s in range(plan.start, plan.end):
            run.slot, run.pairs.slot = plan.first + s, s
            run.first_y = (b * slots + s) * nodes
            run.first_H = run.first_y if plan.varies == 1 else 0
            if plan.predicts == 1 and plan.begin == WHOLE:
                sample_slot(block, run, plan, samples, verbs, b, s)
            simulate_slot(block, run, plan, verbs, b, s)
            if plan.predicts == 0 and plan.stop == WHOLE:
                sample_slot(block, run, plan, samples, verbs, b, s)
        write_held_samples(run.lanes, samples, b)


@kernel
def simulate_slot(
    record: Any, run: AnySlotRun, plan: SlotPlan, verbs: SlotVerbs, b: int, s: int
) -> None:
    """Go through the stages of slot ``s`` of block ``b``."""
    e, begun = 0, plan.begin == WHOLE
    for g in range(len(plan.stages)):
        if plan.stages[g] == EXCHANGE:
            run.phase = plan.phases[g]
            for step in range(plan.steps[g]):
                begun |= e == plan.begin
                if plan.exchanged[s] and begun:
                    run.step = step
                    exchange(record, run, plan, verbs, b, s, e)
                    if e == plan.stop:
                        return
                e += 1
        elif plan.sensed[s] and begun:
            for h in range(len(record.xhat)):
                use_model_of_run(run, plan, h)
                if plan.stages[g] == PREDICT:
                    call_at(verbs.predict, record, h, run)
                else:
                    run.reading = h
                    if verbs.linearise != NOTHING:
                        call_at_two(verbs.linearise, record, h, s, run)
                    if verbs.gate != NOTHING:
                        call_at_two(verbs.gate, record, h, h, run)
                        note_refusals(run, plan, b, s, h)
                    call_at(verbs.update, record, h, run)


@kernel
def note_refusals(run: AnySlotRun, plan: SlotPlan, b: int, s: int, h: int) -> None:
    """Set ``plan.refused`` where the gate of filter ``h`` has refused a part of its reading."""
    gate = run.gate
    for g in range(gate.first[h], gate.first[h + 1]):
        for q in range(gate.active):
            plan.refused[b, s, g, q] = gate.scale[g, q] != 1.0


@kernel
def exchange(
    record: Any, run: AnySlotRun, plan: SlotPlan, verbs: SlotVerbs, b: int, s: int, e: int
) -> None:
    """Let all nodes send and absorb in step ``e`` of the exchanges of slot ``s``."""
    nodes, lanes, decides = len(record.xhat), run.lanes, verbs.decides == 1
    if e != plan.begin and verbs.emit != NOTHING:
        # All messages are made before any arrives.
        for h in range(nodes):
            if plan.sent.shape[0] > 0:
                asked = load_flags(lanes, plan.sent, b, s, e, h)
                if not any_lane(asked):
                    continue
                store_flags(lanes, run.sends, asked)
            if plan.uniform.shape[0] > 0:
                store(lanes, run.uniform, load(lanes, plan.uniform, b, s, e, h))
            run.reading = h
            use_model_of_run(run, plan, h)
            m, count = h, 1
            if verbs.addressed == 1:
                # One for each of its links, and one more.
                m, count = h + run.first[h], run.first[h + 1] - run.first[h] + 1
            clear_payloads(plan.quantiser, m, count)
            call_at_two(verbs.emit, record, h, m, run)
            if decides:
                store_flags(lanes, plan.sent, b, s, e, h, load_flags(lanes, run.sends))
            if plan.speaks.shape[0] > 0:
                quantise_messages(plan, b, s, e, h, nodes, (m, count))
        if decides:
            drop_silent(run, plan, b, s, e)
    if e != plan.stop:
        for h in range(nodes):
            run.reading = h
            use_model_of_run(run, plan, h)
            fill_inbox(run, plan, b, s, e, h, verbs.addressed == 1)
            # What is read of other blocks lies behind the messages of all nodes.
            for k in range(run.count if verbs.translate != NOTHING else 0):
                call_at_two(verbs.emit, record, h, nodes + k, run)
                call_at_two(verbs.translate, record, nodes + k, k, run)
            call_at(verbs.absorb, record, h, run)


@kernel
def quantise_messages(
    plan: SlotPlan, b: int, s: int, e: int, h: int, nodes: int, sent: tuple[int, int]
) -> None:
    """Quantise what ``h`` has ``sent``, (first payload, count), in all lanes that send it."""
    lanes = plan.speaks.shape[4]
    for q in range(lanes):
        silent = len(plan.sent) > 0 and plan.sent[b, s, e, h, q] == 0
        if plan.speaks[b, s, e, h, q] == 1 and not silent:
            stream = (b * lanes + q) * nodes + h
            clipped = quantise_payloads(plan.quantiser, stream, sent[0], sent[1], q)
            plan.clipped[b, s, e, h, q] = clipped


@kernel
def sample_slot(
    record: Any, run: AnySlotRun, plan: SlotPlan, samples: SlotSamples, verbs: SlotVerbs,
    b: int, s: int,
) -> None:  # fmt: skip
    """Take the sample of slot ``s``, if it has one, and move the origin, if it moves there."""
    if plan.sample[s] >= 0:
        for h in range(len(record.xhat) if verbs.observe != NOTHING else 0):
            call_at(verbs.observe, record, h, run)
        write_slot_sample(record.xhat, record.root, run, plan, samples, b, s)
    if plan.rebased[s]:
        # The true state becomes the origin.
        for i in range(len(run.size)):
            store(run.lanes, run.offset, i, -load(run.lanes, samples.local, b, s, i))
        for h in range(len(record.xhat)):
            call_at(verbs.shift, record, h, run)


@kernel(inlined=True)
def use_model_of_run(run: AnySlotRun, plan: SlotPlan, h: int) -> None:
    """Make the model of filter ``h`` that of the run, if it is not that of all."""
    if len(plan.models) > 0:
        run.model = struct_like(run.model, plan.models[h])


@kernel
def fill_inbox(
    run: AnySlotRun, plan: SlotPlan, b: int, s: int, e: int, h: int, addressed: bool
) -> None:
    """Write the messages that node ``h`` hears in step ``e`` of slot ``s`` into the inbox."""
    count, lanes = 0, run.lanes
    up, direction, sender, weight = plan.up, plan.direction, run.sender, run.weight
    for m in range(run.first[h], run.first[h + 1]):
        arrived = load_flags(lanes, up, b, s, e, direction[m])
        # Skip idle links: in a single run a matching uses few.
        if any_lane(arrived):
            store_flags(lanes, run.arrived, count, arrived)
            # Messages and readings have the number of their sender.
            run.message[count], run.link[count], run.heard[count] = sender[m], m, sender[m]
            run.message_weight[count] = weight[m]
            if addressed:
                # Each node j has a payload for each link to it, and one more.
                j, turned = sender[m], run.opposite[m]
                run.message[count] = j + (turned if turned >= 0 else run.first[j + 1])
            count += 1
    run.count = count


@kernel
def drop_silent(run: AnySlotRun, plan: SlotPlan, b: int, s: int, e: int) -> None:
    """Set ``plan.up`` to 0 for the messages of nodes that send nothing in step ``e``."""
    for m in range(len(run.sender)):
        for q in range(plan.up.shape[4]):
            if plan.sent[b, s, e, run.sender[m], q] == 0:
                plan.up[b, s, e, plan.direction[m], q] = 0


@kernel
def write_slot_sample(
    xhat: FloatArray, root: FloatArray, run: AnySlotRun, plan: SlotPlan, samples: SlotSamples,
    b: int, s: int,
) -> None:  # fmt: skip
    """Write the sample of slot ``s`` of block ``b``: ``xhat`` (H, n, L), ``root`` (H, n, n, L)."""
    k, lanes, entries = plan.sample[s], run.lanes, samples.entries
    n, count = len(run.size), len(xhat)
    all_local, all_absolute = samples.local, samples.absolute
    means, errors, covariances = samples.sampled_xhat, samples.sampled_error, samples.sampled_P
    sum_of_all = load(lanes, samples.total, b)
    framed, first = samples.framed, samples.held * count
    for f in range(first, first + count):
        h = f - first
        for i in range(n):
            entry = entries[h, i] if len(entries) > 0 else i
            x = load(lanes, xhat, h, i)
            # Relative to the moving origin: a difference of large absolute states loses digits.
            local = load(lanes, all_local, b, s, entry)
            store(lanes, errors, f * n + i, local - x)
            if framed:
                x += load(lanes, all_absolute, b, s, entry) - local
            store(lanes, means, f * n + i, x)
            sum_of_all += x
            # P = S S' and its mirror image, because samples hold covariances.
            for j in range(i + 1):
                total = spread(lanes, 0.0)
                for m in range(j + 1):
                    total += load(lanes, root, h, i, m) * load(lanes, root, h, j, m)
                store(lanes, covariances, (f * n + i) * n + j, total)
                store(lanes, covariances, (f * n + j) * n + i, total)
                sum_of_all += total
    store(lanes, samples.total, b, sum_of_all)
    for q in range(min(len(lanes), len(samples.x) - b * len(lanes))):
        for i in range(all_absolute.shape[2]):
            samples.x[b * len(lanes) + q, k, i] = all_absolute[b, s, i, q]
    if samples.held == 0:
        samples.first = k
    samples.held += 1
    if samples.held == samples.room:
        write_held_samples(lanes, samples, b)


@kernel
def write_held_samples(lanes: Lanes, samples: SlotSamples, b: int) -> None:
    """Write the samples of block ``b`` that are held: many fill the registers that transpose."""
    if samples.held == 0:
        return
    for q in range(len(lanes)):
        # The last block may have more lanes than there are runs left.
        r = b * len(lanes) + q
        samples.runs[q] = r if r < len(samples.x) else -1
    scatter_samples(lanes, samples.sampled_xhat, samples.xhat, samples)
    scatter_samples(lanes, samples.sampled_error, samples.error, samples)
    scatter_samples(lanes, samples.sampled_P, samples.P, samples)
    samples.held = 0


@kernel
def scatter_samples(
    lanes: Lanes, values: FloatArray, out: FloatArray, samples: SlotSamples
) -> None:
    """Write held ``values`` (>= K C, L) into ``out`` (R, T, C)."""
    count = samples.held * out.shape[2]
    behind = out[:, samples.first :]
    for c in range(0, count, len(lanes)):
        scatter(lanes, values, c, behind, samples.runs, min(count - c, len(lanes)))
