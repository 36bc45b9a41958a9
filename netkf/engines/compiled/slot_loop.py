"""The one loop of all filters in slots: stages of a slot, composed of the verbs of a filter.

``slot_loop`` makes it for a filter's kernels. It simulates S slots of B blocks of L runs in one
call; what is drawn for them is in a :class:`SlotPlan`.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.nonlinear_rows import linearise_rows, no_rows
from netkf.algorithms.kernels.run import SlotRun
from netkf.algorithms.records import Kernels
from netkf.linalg.arrays import FloatArray
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

PREDICT, SENSE, EXCHANGE = range(3)
WHOLE = -1
"""A call begins with a slot, and ends with one."""


class SlotPlan(NamedTuple):
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
        sends nothing; empty if all nodes send that are asked
    uniform : (B, S, E, H, L), uniform numbers for these decisions; empty unless randomised
    varies : whether H differs from block to block and slot to slot
    models : (H, words), the struct of each filter's model, (0, words) if ``run.model`` is all's
    start, end : the slots that a call simulates, of those of the plan
    begin, stop : a call may simulate a part of one slot: from the arrival of the messages of step
        ``begin`` to the sending of those of step ``stop``; WHOLE: from its begin, to its end
    """

    first: int
    stages: np.ndarray
    phases: np.ndarray
    steps: np.ndarray
    predicts: bool
    sensed: np.ndarray
    exchanged: np.ndarray
    sample: np.ndarray
    rebased: np.ndarray
    up: np.ndarray
    direction: np.ndarray
    sent: np.ndarray
    uniform: FloatArray
    varies: bool
    models: np.ndarray
    begin: int
    stop: int
    start: int
    end: int


class SlotSamples(NamedTuple):
    """T samples of R runs that the loop writes, and the true states of S slots that they need.

    x, xhat, P : (R, T, n), (R, T, H w) and (R, T, H w w) in the coordinates of the plant, with all
                 filters of at most w states side by side
    error : (R, T, H w), x - xhat
    absolute, local : (B, S, n, L), true states in all slots, in the coordinates of the plant and
                      relative to the moving origin that estimates refer to
    framed : whether the origin moves; otherwise both are the same
    total : (B, L), sum of all samples of xhat and P so far: finite if all of them are
    sampled_xhat, sampled_error, sampled_P : (>= H w, L), (>= H w, L) and (>= H w w, L), a sample
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
    framed: bool
    total: FloatArray
    sampled_xhat: FloatArray
    sampled_error: FloatArray
    sampled_P: FloatArray
    runs: np.ndarray
    entries: np.ndarray


def exchange_of(kernels: Kernels, choose: Any) -> Any:
    """Return the kernel of one step of an exchange, composed of ``emit`` and ``absorb``."""
    emit, absorb, decides = kernels.emit, kernels.absorb, kernels.decides
    addressed = kernels.addressed

    @kernel
    def exchange(record: Any, run: SlotRun, plan: SlotPlan, b: int, s: int, e: int) -> None:
        nodes, lanes = len(record.xhat), run.lanes
        if e != plan.begin:
            # All messages are made before any arrives.
            for h in range(nodes):
                if decides:
                    store_flags(lanes, run.sends, load_flags(lanes, plan.sent, b, s, e, h))
                    if plan.uniform.shape[0] > 0:
                        store(lanes, run.uniform, load(lanes, plan.uniform, b, s, e, h))
                run.reading = h
                choose(run, plan, h)
                emit(record, h, h + run.first[h] if addressed else h, run)
                if decides:
                    store_flags(lanes, plan.sent, b, s, e, h, load_flags(lanes, run.sends))
            if decides:
                drop_silent(run, plan, b, s, e)
        if e != plan.stop:
            for h in range(nodes):
                run.reading = h
                choose(run, plan, h)
                fill_inbox(run, plan, b, s, e, h, addressed)
                absorb(record, h, run)

    return exchange


@cache
def slot_loop(kernels: Kernels, linear: bool = True, own_models: bool = False) -> Any:
    """Return the loop of slots for a filter's kernels, ``loop(record, memories, run, plan, samples,
    rows)``: ``memories`` (B, words) hold the record of each block, ``record`` is the first; unless
    sensors are all ``linear``, ``rows`` are NonlinearRows. ``own_models``: each filter has its own.
    """
    choose = choose_model if own_models else keep_model
    linearise = no_rows if linear else linearise_rows
    predict, update = kernels.predict, kernels.update
    shift, observe = kernels.shift, kernels.observe
    exchange = exchange_of(kernels, choose)

    @kernel
    def simulate_slot(record: Any, run: SlotRun, plan: SlotPlan, rows: Any, b: int, s: int) -> None:
        nodes, e, begun = len(record.xhat), 0, plan.begin == WHOLE
        for g in range(len(plan.stages)):
            stage = plan.stages[g]
            if stage == EXCHANGE:
                run.phase = plan.phases[g]
                for step in range(plan.steps[g]):
                    begun |= e == plan.begin
                    if plan.exchanged[s] and begun:
                        run.step = step
                        exchange(record, run, plan, b, s, e)
                        if e == plan.stop:
                            return
                    e += 1
            elif plan.sensed[s] and begun:
                for h in range(nodes):
                    choose(run, plan, h)
                    if stage == PREDICT:
                        predict(record, h, run)
                    else:
                        run.reading = h
                        linearise(rows, record, h, run, s)
                        update(record, h, run)

    @kernel
    def sample_slot(
        record: Any, run: SlotRun, plan: SlotPlan, samples: SlotSamples, b: int, s: int
    ) -> None:
        if plan.sample[s] >= 0:
            for h in range(len(record.xhat)):
                observe(record, h, run)
            store_sample(record.xhat, record.root, run, plan, samples, b, s)
        if plan.rebased[s]:
            set_offset(run, samples, b, s)
            for h in range(len(record.xhat)):
                shift(record, h, run)

    @kernel
    def loop(
        record: Any,
        memories: np.ndarray,
        run: SlotRun,
        plan: SlotPlan,
        samples: SlotSamples,
        rows: Any,
    ) -> None:
        nodes, slots = len(record.xhat), plan.up.shape[1]
        for b in range(len(memories)):
            block = struct_like(record, memories[b])
            for s in range(plan.start, plan.end):
                run.slot, run.pairs.slot = plan.first + s, s
                run.first_y = (b * slots + s) * nodes
                run.first_H = run.first_y if plan.varies else 0
                if plan.predicts and plan.begin == WHOLE:
                    sample_slot(block, run, plan, samples, b, s)
                simulate_slot(block, run, plan, rows, b, s)
                if not plan.predicts and plan.stop == WHOLE:
                    sample_slot(block, run, plan, samples, b, s)

    return loop


@kernel(inlined=True)
def choose_model(run: SlotRun, plan: SlotPlan, h: int) -> None:
    """Make the model of filter ``h`` that of the run."""
    run.model = struct_like(run.model, plan.models[h])


@kernel(inlined=True)
def keep_model(run: SlotRun, plan: SlotPlan, h: int) -> None:
    """Do nothing: all filters have the model of the run."""


@kernel
def fill_inbox(
    run: SlotRun, plan: SlotPlan, b: int, s: int, e: int, h: int, addressed: bool
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
def drop_silent(run: SlotRun, plan: SlotPlan, b: int, s: int, e: int) -> None:
    """Set ``plan.up`` to 0 for the messages of nodes that send nothing in step ``e``."""
    for m in range(len(run.sender)):
        for q in range(plan.up.shape[4]):
            if plan.sent[b, s, e, run.sender[m], q] == 0:
                plan.up[b, s, e, plan.direction[m], q] = 0


@kernel
def set_offset(run: SlotRun, samples: SlotSamples, b: int, s: int) -> None:
    """Make the true state of slot ``s`` the origin: write its negative into ``run.offset``."""
    for i in range(len(run.size)):
        store(run.lanes, run.offset, i, -load(run.lanes, samples.local, b, s, i))


@kernel
def store_sample(
    xhat: FloatArray,
    root: FloatArray,
    run: SlotRun,
    plan: SlotPlan,
    samples: SlotSamples,
    b: int,
    s: int,
) -> None:
    """Write the sample of slot ``s`` of block ``b``: ``xhat`` (H, n, L), ``root`` (H, n, n, L)."""
    k, lanes = plan.sample[s], run.lanes
    n, first = len(run.size), b * len(lanes)
    sum_of_all, states = load(lanes, samples.total, b), samples.absolute.shape[2]
    for h in range(len(xhat)):
        for i in range(n):
            entry = samples.entries[h, i] if len(samples.entries) > 0 else i
            x = load(lanes, xhat, h, i)
            # Relative to the moving origin: a difference of large absolute states loses digits.
            local = load(lanes, samples.local, b, s, entry)
            store(lanes, samples.sampled_error, h * n + i, local - x)
            if samples.framed:
                x += load(lanes, samples.absolute, b, s, entry) - local
            store(lanes, samples.sampled_xhat, h * n + i, x)
            sum_of_all += x
            # P = S S' and its mirror image, because samples hold covariances.
            for j in range(i + 1):
                total = spread(lanes, 0.0)
                for m in range(j + 1):
                    total += load(lanes, root, h, i, m) * load(lanes, root, h, j, m)
                store(lanes, samples.sampled_P, (h * n + i) * n + j, total)
                store(lanes, samples.sampled_P, (h * n + j) * n + i, total)
                sum_of_all += total
    store(lanes, samples.total, b, sum_of_all)
    for q in range(len(lanes)):
        # The last block may have more lanes than there are runs left.
        used = first + q < len(samples.x)
        samples.runs[q] = first + q if used else -1
        for i in range(states if used else 0):
            samples.x[first + q, k, i] = samples.absolute[b, s, i, q]
    scatter_sample(lanes, samples.sampled_xhat, samples.xhat[:, k], samples.runs)
    scatter_sample(lanes, samples.sampled_error, samples.error[:, k], samples.runs)
    scatter_sample(lanes, samples.sampled_P, samples.P[:, k], samples.runs)


@kernel
def scatter_sample(
    lanes: Lanes, values: FloatArray, samples: FloatArray, indices: np.ndarray
) -> None:
    """Write one sample, ``values`` (>= C, L), into ``samples`` (R, C): lane q into row
    ``indices[q]``; -1: no run.
    """
    count = samples.shape[1]
    for c in range(0, count, len(lanes)):
        scatter(lanes, values, c, samples, indices, min(count - c, len(lanes)))
