"""The gossip interactive Kalman filter of Kar and Moura, G (10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from netkf.algorithms.filter import Exchange, Filter, Message, State
from netkf.algorithms.kernels.slots import (
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotReadings,
    SlotRoom,
    SlotSamples,
    predict,
    rebase,
    show,
    use_reading,
)
from netkf.algorithms.registry import built_in
from netkf.linalg.compiling import kernel


@kernel
def gossip_slots(
    nodes: SlotNodes,
    readings: SlotReadings,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    room: SlotRoom,
) -> None:
    """Carry gossip filters through the slots of a plan, G (10)."""
    H = len(nodes.rows)
    for s in range(plan.up.shape[1]):
        for r in range(plan.up.shape[0]):
            show(nodes, plan, samples, r, s)
            rebase(nodes, readings, r, s)
            if plan.exchanged[s]:
                swap_pairs(nodes, plan, links, room, r, s)
            if plan.sensed[s]:
                for h in range(H):
                    use_reading(nodes, r * H + h, readings, r, s, h, room.update)
        if plan.sensed[s]:
            predict(nodes, room)


@kernel(inlined=True)
def swap_pairs(
    nodes: SlotNodes, plan: SlotPlan, links: SlotLinks, room: SlotRoom, r: int, s: int
) -> None:
    """Put what each node hears in place of its own pair, of several the last sender's."""
    H, n = len(nodes.rows), nodes.xhat.shape[1]
    for write in (False, True):  # all payloads are from before the exchange
        for h in range(H):
            source = -1
            for m in range(links.first[h], links.first[h + 1]):
                if plan.up[r, s, 0, links.way[m]] == 1:
                    source = links.sender[m]
            if source < 0:
                continue
            for i in range(n):
                if write:
                    nodes.xhat[r * H + h, i] = room.xhat[h, i]
                else:
                    room.xhat[h, i] = nodes.xhat[r * H + source, i]
                for j in range(i + 1):
                    if write:
                        nodes.root[r * H + h, i, j] = room.root[h, i, j]
                    else:
                        room.root[h, i, j] = nodes.root[r * H + source, i, j]


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
    first_slot: ClassVar[int] = 1
    pairwise: ClassVar[bool] = True
    slot_kernel = staticmethod(gossip_slots)

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        """Replace the node's pair by the partner's, predicted to now."""
        if not messages:
            return state
        _, _, pair, age = messages[-1]
        xhat, root = state.model.extrapolate(pair.xhat, pair.root, age)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine
