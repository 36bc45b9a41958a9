"""The diffusion filter of Xie, Gan and Liu: adapt, then combine by covariance intersection, D."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo
from netkf.algorithms.kernels.root_update import (
    begin_intersection,
    end_intersection,
    intersect_roots,
    invert_root,
    merge_information,
)
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
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.core.errors import ScenarioError
from netkf.core.fields import choice, either, field, nested, square
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel

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


class DiffusionWeights(NamedTuple):
    """What filters give themselves when all messages arrive, ``own`` (H,), and whether they keep
    the weight of messages that do not; ``inverse`` (H, n, n) is scratch.
    """

    own: FloatArray
    keep_own: bool
    inverse: FloatArray


@kernel(inlined=True)
def effective_weights(own: float, heard: float, keep_own: bool) -> tuple[float, float]:
    """Return the own weight and the divisor of the others, so that all of them sum to 1.

    ``own`` and ``heard`` are the nominal own weight and the sum of those of the messages that
    arrived, see ``DiffusionFilter.on_loss``.
    """
    total = own + heard
    # "keep-own", or no weight at all: the own weight is what the others leave.
    if keep_own or total == 0.0:
        return max(0.0, 1.0 - heard), 1.0
    return own / total, total


@kernel
def diffusion_slots(
    nodes: SlotNodes,
    readings: SlotReadings,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    room: SlotRoom,
    weights: DiffusionWeights,
) -> None:
    """Carry diffusion filters through the slots of a plan, D (6)-(9)."""
    H = len(nodes.rows)
    for s in range(plan.up.shape[1]):
        for r in range(plan.up.shape[0]):
            # Samples show predictions: before the reading of the slot.
            show(nodes, plan, samples, r, s)
            rebase(nodes, readings, r, s)
            for h in range(H if plan.sensed[s] else 0):
                use_reading(nodes, r * H + h, readings, r, s, h, room.update)
        # All filters of all runs have used their readings by now: predict them together.
        if plan.sensed[s]:
            predict(nodes, room)
        for r in range(plan.up.shape[0]):
            if plan.exchanged[s]:
                # Copies and inverse roots of all before any is combined: everyone combines what was
                # sent.
                for h in range(H):
                    copy_estimate(nodes, r * H + h, room, h)
                    # Once for each sender, however many hear it.
                    invert_root(weights.inverse[h], nodes.root, r * H + h, 1.0)
                for h in range(H):
                    combine(nodes, plan, links, room, weights, r, s, h)


@kernel(inlined=True)
def copy_estimate(nodes: SlotNodes, place: int, room: SlotRoom, h: int) -> None:
    """Keep the estimate of a place as what filter ``h`` sends."""
    for i in range(nodes.xhat.shape[1]):
        room.xhat[h, i] = nodes.xhat[place, i]


@kernel(inlined=True)
def combine(
    nodes: SlotNodes,
    plan: SlotPlan,
    links: SlotLinks,
    room: SlotRoom,
    weights: DiffusionWeights,
    r: int,
    s: int,
    h: int,
) -> None:
    """Intersect what filter ``h`` has with what it hears, D (8) and (9)."""
    heard = 0.0
    for m in range(links.first[h], links.first[h + 1]):
        if plan.up[r, s, 0, links.way[m]] == 1:
            heard += links.weight[m]
    own, divisor = effective_weights(weights.own[h], heard, weights.keep_own)
    # Weight 1: nothing heard counts, and the estimate stays to the last bit.
    if own == 1.0:
        return
    begin_intersection(room.update)
    # The own term needs no merging: it is the first.
    whiten(room.update.total, own, weights.inverse, h, h, room)
    # A weight of 0 adds no information.
    for m in range(links.first[h], links.first[h + 1]):
        if plan.up[r, s, 0, links.way[m]] == 1 and links.weight[m] > 0.0:
            weight = links.weight[m] / divisor
            whiten(room.update.whitened, weight, weights.inverse, links.sender[m], h, room)
            merge_information(room.update.total, room.update.whitened)
    place = r * len(nodes.rows) + h
    # P = (sum w P^-1)^-1 and the mean, D (8) and (9).
    end_intersection(nodes.root, nodes.xhat, place, room.xhat, h, room.update)


@kernel(inlined=True)
def whiten(
    out: FloatArray, weight: float, inverse: FloatArray, sender: int, h: int, room: SlotRoom
) -> None:
    """Write the root of ``weight`` times the information that ``sender`` sends into ``out``
    (n, n + 1); means, in its last column, count from what filter ``h`` had.
    """
    n, size = inverse.shape[1], math.sqrt(weight)
    for i in range(n):
        mean = 0.0
        # sqrt(w) S^-1, a root of w P^-1.
        for j in range(i + 1):
            out[i, j] = size * inverse[sender, i, j]
            mean += out[i, j] * (room.xhat[sender, j] - room.xhat[h, j])
        out[i, n] = mean


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
    slot_kernel = staticmethod(diffusion_slots)

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[DiffusionWeights]:
        """The weights of the nodes."""
        own = np.array([info.own_weight for info in infos], dtype=np.float64)
        n = len(states[0].xhat)
        return (DiffusionWeights(own, self.on_loss == "keep-own", np.zeros((len(own), n, n))),)

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.weights, str):
            return
        if (self.weights < 0.0).any():
            # Weights come from files: the message names the entry.
            where = np.argwhere(self.weights < 0.0)[0].tolist()
            raise ScenarioError(
                "weights[{}][{}]".format(*where),
                "must not be negative",
                float(self.weights[tuple(where)]),
                "give weights from 0 to 1",
            )
        # Column i holds what node i gives, itself included.
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
        # Nothing to combine, or all weight at home.
        if own == 1.0 or not messages:
            return state
        pairs = [(state.xhat, state.root)]
        for message in messages:
            pair = message.payload
            # Under clocks a message may be old: predicted to now without readings.
            pairs.append(state.model.extrapolate(pair.xhat, pair.root, message.age))
        means, roots = (np.stack(part) for part in zip(*pairs, strict=True))
        xhat, root = intersect_roots(np.array([own, *heard]), means, roots)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine: the weights sum to one

    def share(self, own: float, arrived: list[float]) -> tuple[float, list[float]]:
        """The own weight and those of the messages that arrived, which sum to 1, from the nominal
        ones.
        """
        # fsum: the sum must not depend on the order of messages.
        kept, divisor = effective_weights(own, math.fsum(arrived), self.on_loss == "keep-own")
        return kept, [weight / divisor for weight in arrived]
