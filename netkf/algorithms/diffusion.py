"""The diffusion filter of Xie, Gan and Liu: adapt, then combine by covariance intersection, D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo
from netkf.algorithms.kernels.root_update import intersect_roots
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.core.errors import ScenarioError
from netkf.core.fields import choice, either, field, nested, square
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import compilable

METROPOLIS = "metropolis"


class DiffusionState(NamedTuple):
    """``xhat`` (n,), ``root`` (n, n) of its covariance, the model, and the weight that the node
    gives to itself when all messages arrive.
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    own: float

    @property
    def P(self) -> FloatArray:
        """``root root'`` (n, n)."""
        return self.root @ self.root.T


@built_in("diffusion")
@dataclass(frozen=True, eq=False)
class DiffusionFilter(Filter):
    """D Algorithm 1, (6)-(9), with any F in place of D's identity; slots show predictions.

    Under clocks a node combines what it heard at one instant, predicted to now where it took time.

    weights entry [l][i] is the weight node i gives to what node l sends, in the order of node ids:
            columns sum to 1, and D's theorems want the rows to (balanced); or "metropolis",
            1 / (1 + the larger number of incoming links) for each link and the rest for oneself
    on_loss what becomes of the weight of a message that did not come (its row in the trace is
            "lost" or "late"): "renormalise" divides the weights of what came, the own one
            included, by their sum; "keep-own" adds it to the own one

    Either way the weights sum to 1 and P stays consistent; a node that heard nothing predicts.
    """

    weights: str | FloatArray = field(
        either(choice(METROPOLIS), square, nested(1)), default=METROPOLIS
    )
    on_loss: str = field(choice("renormalise", "keep-own"), default="renormalise")

    paper: ClassVar[str] = "diffusion"
    combination: ClassVar[str] = "shares"
    P_by_design: ClassVar[tuple[str, str]] = ("larger", "larger")
    schedule: ClassVar[tuple[str, ...]] = ("sense", "predict", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ("directions", "nodes", "readings")
    predicts: ClassVar[bool] = True
    one_way: ClassVar[bool] = True
    inverts: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.weights, str):
            return
        if (self.weights < 0.0).any():
            where = np.argwhere(self.weights < 0.0)[0].tolist()
            raise ScenarioError(
                "weights[{}][{}]".format(*where),
                "must not be negative",
                float(self.weights[tuple(where)]),
                "give weights from 0 to 1",
            )
        sums = self.weights.sum(axis=0)
        wrong = np.flatnonzero(np.abs(sums - 1.0) > 1e-9)
        if wrong.size:
            raise ScenarioError(
                "weights",
                f"column {wrong[0]}, what node number {wrong[0]} gives, must sum to 1",
                float(sums[wrong[0]]),
                "write the weights that a node gives below each other",
            )

    @property
    def pair_weights(self) -> FloatArray | None:
        """``weights`` where they are a matrix."""
        return None if isinstance(self.weights, str) else self.weights

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> DiffusionState:
        """The node knows its own weight."""
        return DiffusionState(mean, first_root(cov), model, node.own_weight)

    def absorb(
        self, state: DiffusionState, messages: Sequence[Message], exchange: Exchange
    ) -> DiffusionState:
        """Combine, D (8) and (9)."""
        own, heard = self.share(state.own, [message.weight for message in messages])
        if own == 1.0 or not messages:
            return state
        pairs = [(state.xhat, state.root)]
        for message in messages:
            pair = message.payload
            pairs.append(state.model.extrapolate(pair.xhat, pair.root, message.age))
        means, roots = (np.stack(part) for part in zip(*pairs, strict=True))
        xhat, root = intersect_roots(np.array([own, *heard]), means, roots)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine: the weights sum to one

    def share(self, own: float, arrived: list[float]) -> tuple[float, list[float]]:
        """The own weight and those of the messages that arrived, which sum to 1, from the nominal
        ones.
        """
        kept, heard = shares(own, np.array(arrived), self.on_loss == "keep-own")
        return float(kept), heard.tolist()


@compilable
def shares(own: float, arrived: FloatArray, keep_own: bool) -> tuple[float, FloatArray]:
    """The weights that sum to 1 from the nominal ones, see ``DiffusionFilter.on_loss``."""
    heard = arrived.sum()
    total = own + heard
    if keep_own or total == 0.0:
        return max(0.0, 1.0 - heard), arrived
    return own / total, arrived / total
