"""The gossip interactive Kalman filter of Kar and Moura, G (10)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from netkf.algorithms.filter import Exchange, Filter, Message, State
from netkf.algorithms.registry import built_in


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

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        """Replace the node's pair by the partner's, predicted to now."""
        if not messages:
            return state
        _, _, pair, age = messages[-1]
        xhat, root = state.model.extrapolate(pair.xhat, pair.root, age)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine
