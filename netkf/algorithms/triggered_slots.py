"""Stochastic triggers around filters that are simulated in slots by a ``slot_kernel``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter
from netkf.algorithms.kernels.slots import (
    ARRIVING,
    SENDING,
    WHOLE,
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    drop_silent,
    transform_mean,
)
from netkf.algorithms.kernels.triggers import NO_READING, silence_probability
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    LANES,
    Lanes,
    aligned,
    blocks_of,
    load,
    magnitude,
    select,
    spread,
    store,
)

NOWHERE = np.zeros(1, dtype=bool)
"""Flags (1,) of a plan of one slot: what they flag does not happen in it."""


@kernel
def weigh_news(
    lanes: Lanes,
    x: FloatArray,
    readings: ReadingBlock,
    index: tuple[int, int, int],
    rows: int,
    Y: FloatArray,
    z: FloatArray,
) -> Any:
    """Return the news ``z' Y z`` (L,) of the whitened reading with ``rows`` rows at ``index`` [b,
    s, h], block, slot and filter, with its innovation z = y - H x and the trigger's weights Y;
    NO_READING in lanes without a reading.

    x (B, H, n, L) are the estimates, Y = ``Y[h]`` of (H, p, p) is for whitened rows, ``z`` (p, L)
    is scratch. Axes: B blocks of runs, H filters.
    """
    b, s, h = index
    # A fixed H is stored for one block and one slot only.
    d, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    news = magnitudes = spread(lanes, 0.0)
    for k in range(rows):
        innovation = load(lanes, readings.y, b, s, h, k)
        magnitudes += magnitude(innovation)
        for i in range(x.shape[2]):
            weight = load(lanes, readings.H, d, t, h, k, i)
            magnitudes += magnitude(weight)
            innovation -= weight * load(lanes, x, b, h, i)
        store(lanes, z, k, innovation)
    for k in range(rows):
        for j in range(rows):
            news += Y[h, k, j] * load(lanes, z, k) * load(lanes, z, j)
    # Rounding below 0 counts as 0. A slot in which a recorded sensor has no row holds zeros in y
    # and H: no reading.
    return select(magnitudes > 0.0, select(news > 0.0, news, 0.0), NO_READING)


class TriggerArrays(NamedTuple):
    """Decisions of H nodes of ``TriggeredMessages`` for B blocks of L runs.

    trigger : (H, p, p), Y for whitened rows
    news : (B, H, L), z' Y z of the last reading
    undecided : (B, H, L), 1 until it is decided whether the node sends after this reading
    silent : (B, H, L), 1 if it sends nothing until the next reading
    has_sent : (B, H, L), 1 once the node has sent after a reading
    x, z : scratch, predictions (B, H, n, L) and an innovation (p, L)
    """

    trigger: FloatArray
    news: FloatArray
    undecided: np.ndarray
    silent: np.ndarray
    has_sent: np.ndarray
    x: FloatArray
    z: FloatArray


def trigger_arrays(models: Sequence[Any], trigger: FloatArray, runs: int) -> TriggerArrays:
    """Return the arrays of H nodes with these ``models`` in ``runs`` runs, before they have read
    anything; ``trigger`` (H, p, p) is Y for whitened rows.
    """
    shape = blocks_of(runs), len(models)
    return TriggerArrays(
        trigger,
        np.full((*shape, LANES), NO_READING),
        undecided=np.ones((*shape, LANES), dtype=np.uint8),
        silent=np.zeros((*shape, LANES), dtype=np.uint8),
        has_sent=np.zeros((*shape, LANES), dtype=np.uint8),
        x=aligned((*shape, len(models[0].F), LANES)),
        z=aligned((trigger.shape[1], LANES)),
    )


class TriggerPlan(NamedTuple):
    """The order of events in the slots of a wrapped filter: news are computed outside of its
    kernel, and need the prediction that the kernel will have at the reading.

    first : index of the first exchange step after the reading
    predict_first : whether estimates are predicted before the reading
    rebase_first : whether the origin of estimates moves (``rebase``) before the reading, as in
                   filters that sample their predictions; else it moves at the end of the slot
    split : whether an exchange before the reading changes estimates; the kernel is then called
            twice a slot, up to the reading and from it on
    """

    first: int
    predict_first: bool
    rebase_first: bool
    split: bool


def trigger_plan(inner: Filter) -> TriggerPlan | None:
    """Return the order of events in the slots of the filter ``inner``; None if its innovations
    cannot be computed outside of its kernel.
    """
    schedule = inner.schedule or ()
    before = schedule[: schedule.index("sense")]
    # The number of exchanges before the reading, and whether they change estimates.
    early = before.count("exchange")
    moves = any(inner.moves_estimates(phase) for phase in range(early))
    # If exchanges change estimates before the reading, the kernel is called twice a slot: for the
    # exchanges alone, then for the rest. Its plan cannot leave out only the exchanges before the
    # reading, nor separate a prediction from the reading.
    if moves and (early < schedule.count("exchange") or "predict" in before):
        return None
    first = sum(inner.exchange_steps(phase) for phase in range(early))
    return TriggerPlan(first, "predict" in before, inner.predicts, moves)


@kernel
def decide_senders(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: TriggerArrays,
    order: TriggerPlan,
    s: int,
) -> None:
    """Decide which nodes send in slot ``s``, in all B blocks: in exchange steps before the reading
    by the news of the slot before, then by those of this one; ``order`` says which come before.

    Writes 0 into ``plan.sent[:, s]`` (B, E, H, L) and ``plan.up[:, s]`` (B, E, W, L) for messages
    that are not sent, and stores news and decisions in ``arrays``. Axes: E exchange steps, W
    directed links, H filters, L runs side by side.
    """
    for b in range(plan.sent.shape[0]):
        # Exchanges before the reading: the decisions after the reading of the slot before hold.
        for e in range(order.first):
            decide_step(plan, arrays, b, s, e)
        if plan.sensed[s] and not order.split:
            store_news(
                nodes, readings, arrays, scratch, b, s, order.predict_first, order.rebase_first
            )
        for e in range(order.first, plan.sent.shape[2]):
            decide_step(plan, arrays, b, s, e)
        for e in range(plan.sent.shape[2]):
            drop_silent(plan, links, b, s, e)


@kernel
def decide_step(plan: SlotPlan, arrays: TriggerArrays, b: int, s: int, e: int) -> None:
    """Decide which of the nodes of block ``b`` that are asked in step ``e`` of slot ``s`` send: a
    decision holds until the next reading. Writes 0 into ``plan.sent[b, s, e]`` (H, L) for silent
    ones, and new decisions into ``arrays``.

    Axes: H filters, L runs side by side.
    """
    for h in range(plan.sent.shape[3]):
        for q in range(plan.sent.shape[4]):
            if plan.sent[b, s, e, h, q] == 0:
                continue
            if arrays.undecided[b, h, q] == 1:
                # After its first reading a node always sends, and without a reading (negative
                # news) too.
                news, u = arrays.news[b, h, q], plan.uniform[b, s, e, h, q]
                silent = arrays.has_sent[b, h, q] == 1 and u < silence_probability(news)
                arrays.undecided[b, h, q], arrays.silent[b, h, q] = 0, silent
                if news >= 0.0:
                    arrays.has_sent[b, h, q] = 1
            if arrays.silent[b, h, q] == 1:
                plan.sent[b, s, e, h, q] = 0


@kernel
def store_news(
    nodes: SlotNodes,
    readings: ReadingBlock,
    arrays: TriggerArrays,
    scratch: SlotScratch,
    b: int,
    s: int,
    predict_first: bool,
    rebase_first: bool,
) -> None:
    """Store the news ``z' Y z`` of the readings of all H nodes of block ``b`` in slot ``s`` in
    ``arrays.news[b]`` (H, L), and mark each node as undecided, so that it decides anew whether to
    send.

    The innovation z = y - H x needs the estimate x at the reading, while ``nodes.xhat`` (unchanged)
    is that before the filter's kernel has simulated the slot. So do in a copy, ``arrays.x``, what
    the kernel does before the reading: move the origin that estimates are relative to
    (``rebase_first``), and predict (``predict_first``). Axes: L runs side by side.
    """
    lanes = scratch.lanes
    for h in range(len(nodes.rows)):
        for i in range(nodes.xhat.shape[2]):
            x = load(lanes, nodes.xhat, b, h, i)
            if rebase_first and readings.rebased[s]:
                # As ``rebase`` does: the true state of this slot becomes the origin.
                x -= load(lanes, readings.local, b, s, i)
            store(lanes, arrays.x, b, h, i, x)
        if predict_first:
            transform_mean(scratch, arrays.x, b, h, nodes.F)
        news = weigh_news(
            lanes, arrays.x, readings, (b, s, h), nodes.rows[h], arrays.trigger, arrays.z
        )
        store(lanes, arrays.news, b, h, news)
        for q in range(len(lanes)):
            arrays.undecided[b, h, q], arrays.silent[b, h, q] = 1, 0


@kernel
def store_news_of_slot(
    nodes: SlotNodes, readings: ReadingBlock, arrays: TriggerArrays, scratch: SlotScratch
) -> None:
    """Store the news ``z' Y z`` of the readings of all nodes and blocks of one slot in
    ``arrays.news`` (B, H, L), and mark the nodes as undecided. All that precedes the reading in
    the slot is done: ``nodes.xhat`` holds the predictions.

    Axes: B blocks of L runs, H filters.
    """
    for b in range(nodes.xhat.shape[0]):
        store_news(nodes, readings, arrays, scratch, b, 0, False, False)


class TriggeredSlots:
    """The ``slot_kernel`` of ``TriggeredMessages``, called like any other: in each slot it decides
    which nodes send, and runs the kernel of the ``inner`` filter with their messages.
    """

    def __init__(self, inner: Filter, order: TriggerPlan) -> None:
        """Take the wrapped filter, which has a kernel, and its ``trigger_plan``."""
        self._inner = inner
        self._kernel = inner.slot_kernel
        self._order = order
        self._decides = inner.decides_in_slots()
        # The engine looks for the compiled code of a kernel by its name.
        self.__name__ = self._kernel.__name__

    def __call__(
        self,
        nodes: SlotNodes,
        readings: ReadingBlock,
        plan: SlotPlan,
        links: SlotLinks,
        samples: SlotSamples,
        scratch: SlotScratch,
        arrays: TriggerArrays,
        states: Sequence[Any],
        *more: Any,
    ) -> None:
        """Simulate the filters over the S slots of a plan in place: changes ``nodes``, the
        decisions in ``arrays``, ``plan.sent`` and ``plan.up``, and writes ``samples``. ``states``
        are those in which nodes start, ``more`` the arrays of the inner filter's kernel.

        ``plan.part`` says whether only the decisions are wanted (SENDING), only what follows from
        the messages that arrive (ARRIVING), or both. ``plan.sent`` flags the nodes that are asked
        for a message, and then those that send one. If the order of a slot is ``split``, news
        refer to the estimates between the exchange and the reading: the inner kernel is called
        once for the exchange, then for the reading and all that follows.
        """
        # Innovations refer to the estimates with which nodes go on, not to those they report.
        carried_nodes = nodes._replace(xhat=self._inner.carried_estimates(nodes.xhat, more))
        for s in range(plan.up.shape[1]):
            asked = plan.sent[:, s : s + 1].copy()
            if plan.part != ARRIVING:
                decide_senders(
                    carried_nodes, readings, plan, links, scratch, arrays, self._order, s
                )
            # The trigger alone decides who sends: the inner kernel runs when messages have arrived.
            if plan.part == SENDING and not self._decides:
                continue
            slot_readings, slot_plan, slot_samples = single_slot(readings, plan, samples, s)
            if self._decides:
                # The filter decides on all that are asked; below, a message needs both decisions.
                slot_plan = slot_plan._replace(sent=asked, part=plan.part)
            arguments = (
                links,
                slot_samples,
                scratch,
                *self._inner.slot_gains(states, more, plan.first + s, 1),
            )
            if self._order.split:
                self._kernel(nodes, slot_readings, slot_plan._replace(sensed=NOWHERE), *arguments)
                if plan.sensed[s]:
                    store_news_of_slot(carried_nodes, slot_readings, arrays, scratch)
                # The first call has written the sample and moved the origin: not again.
                slot_readings, no_sample = slot_readings._replace(rebased=NOWHERE), np.full(1, -1)
                slot_plan = slot_plan._replace(exchanged=NOWHERE, sample=no_sample)
            self._kernel(nodes, slot_readings, slot_plan, *arguments)
            if self._decides:
                plan.sent[:, s : s + 1] &= slot_plan.sent
                plan.up[:, s : s + 1] = slot_plan.up


def single_slot(
    readings: ReadingBlock, plan: SlotPlan, samples: SlotSamples, s: int
) -> tuple[ReadingBlock, SlotPlan, SlotSamples]:
    """Return ``readings``, ``plan`` and ``samples`` of slot ``s`` alone, with S = 1, for
    ``TriggeredSlots``, which calls a kernel slot by slot. The plan's ``sent`` and ``uniform`` are
    empty, for filters that do not decide who sends.
    """
    at = slice(s, s + 1)

    def at_slot(values: Any) -> Any:
        """Return the values (B, 1, ...) of slot ``s`` from those of all slots (B, S, ...)."""
        return np.ascontiguousarray(values[:, at])

    # A fixed H has one slot already.
    local, fixed = at_slot(readings.local), readings.H.shape[1] == 1
    H = readings.H if fixed else at_slot(readings.H)
    alone = ReadingBlock(at_slot(readings.y), H, local, readings.rebased[at])
    nothing = np.zeros((0,) * 5, dtype=np.uint8), np.zeros((0,) * 5)
    slot_plan = SlotPlan(
        plan.first + s, plan.sensed[at], plan.exchanged[at], plan.sample[at],
        at_slot(plan.up), *nothing, WHOLE,
    )  # fmt: skip
    slot_samples = samples._replace(
        absolute=at_slot(samples.absolute), local=at_slot(samples.local)
    )
    return alone, slot_plan, slot_samples
