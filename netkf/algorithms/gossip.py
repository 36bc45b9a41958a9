"""The gossip interactive Kalman filter of Kar and Moura, paper G (10).

``gossip_slots`` simulates many runs in the compiled engine, in place of the methods of ``Gossip``;
the types of its arguments are described in ``kernels.slots``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from netkf.algorithms.filter import Exchange, Filter, Message, State
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    predict_all,
    read_all,
    rebase,
    store_sample_of_slot,
)
from netkf.algorithms.registry import built_in
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import any_lane, load, load_flags, select, store


@kernel
def gossip_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
) -> None:
    """Simulate H gossip filters over the S slots of a plan in B blocks of L runs, paper G (10): in
    each slot they swap estimates in pairs, then read and predict.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place and writes
    ``samples``, of the predictions with which slots begin.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            # Samples show predictions: before the reading of the slot.
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            # Keep the estimates relative to an origin near the true state.
            rebase(nodes, readings, scratch, b, s)
            if plan.exchanged[s]:
                swap_pairs(nodes, plan, links, scratch, b, s)
            if plan.sensed[s]:
                read_all(nodes, readings, scratch, b, s)
                predict_all(nodes, scratch, b)


@kernel
def swap_pairs(
    nodes: SlotNodes, plan: SlotPlan, links: SlotLinks, scratch: SlotScratch, b: int, s: int
) -> None:
    """Replace the estimate ``nodes.xhat[b, h]`` (n, L) and root ``nodes.root[b, h]`` (n, n, L) of
    each filter h of block ``b`` by those that arrive in slot ``s``; if several arrive, by those of
    the last sender. The estimates that are sent are copied to ``scratch`` first.

    Axes: L runs side by side.
    """
    lanes, n = scratch.lanes, len(scratch.size)
    # All payloads are from before the exchange.
    for h in range(len(nodes.rows)):
        for i in range(n):
            store(lanes, scratch.xhat, h, i, load(lanes, nodes.xhat, b, h, i))
            for j in range(i + 1):
                store(lanes, scratch.root, h, i, j, load(lanes, nodes.root, b, h, i, j))
    for h in range(len(nodes.rows)):
        for m in range(links.first[h], links.first[h + 1]):
            arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
            # Skip idle links: in a single run a matching uses few.
            if any_lane(arrived):
                copy_pair(nodes, scratch, b, h, links.sender[m], arrived)


@kernel(inlined=True)
def copy_pair(
    nodes: SlotNodes, scratch: SlotScratch, b: int, h: int, sender: int, arrived: Any
) -> None:
    """Copy the estimate and root of filter ``sender`` from ``scratch`` to ``nodes.xhat[b, h]``
    (n, L) and ``nodes.root[b, h]`` (n, n, L) of filter ``h`` of block ``b``, in the lanes (runs) in
    which the message has ``arrived`` (L,).
    """
    lanes = scratch.lanes
    for i in range(len(scratch.size)):
        own, sent = load(lanes, nodes.xhat, b, h, i), load(lanes, scratch.xhat, sender, i)
        store(lanes, nodes.xhat, b, h, i, select(arrived, sent, own))
        for j in range(i + 1):
            own, sent = load(lanes, nodes.root, b, h, i, j), load(lanes, scratch.root, sender, i, j)
            store(lanes, nodes.root, b, h, i, j, select(arrived, sent, own))


@built_in("gossip")
@dataclass(frozen=True, eq=False)
class Gossip(Filter):
    """Paired nodes swap the pair (xhat, P) and go on with each other's; samples are predictions.

    In slots paired nodes first swap, then each updates with its own reading and predicts; nothing
    is swapped in slot 0. Under link clocks both ends of a link swap when it ticks. A node whose
    partner's message is lost keeps its own pair: if only one direction fails, one pair is copied
    and the other is gone. Of several pairs that arrive at one instant the last sender's counts.
    """

    paper: ClassVar[str] = "gossip"
    combination: ClassVar[str] = "swap"
    schedule: ClassVar[tuple[str, ...]] = ("exchange", "sense", "predict")
    clocks: ClassVar[tuple[str, ...]] = ("links",)
    predicts: ClassVar[bool] = True
    pairwise: ClassVar[bool] = True
    slot_kernel = staticmethod(gossip_slots)
    unrolled: ClassVar[bool] = True

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        """Return the state with the estimate and root of the last of the messages, predicted to
        now, in place of the node's own.
        """
        if not messages:
            return state
        message = messages[-1]
        pair = message.payload
        xhat, root = state.model.extrapolate(pair.xhat, pair.root, message.age)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine in readings and messages
