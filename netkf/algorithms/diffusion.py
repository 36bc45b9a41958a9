"""The diffusion filter of Xie, Gan and Liu, which is paper D here: each node updates with its own
readings, then combines its estimate with the neighbours' by covariance intersection.

``diffusion_slots`` simulates many runs in the compiled engine, in place of the methods of
``DiffusionFilter``; the types of its arguments are described in ``kernels.slots``. A root [Z, z]
(n, n + 1) of information stands for ``Z' Z = P^-1`` and the mean ``Z^-1 z`` relative to a centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo
from netkf.algorithms.kernels.intersection import (
    finish_lanes,
    invert_lanes,
    merge_lanes,
    whiten,
)
from netkf.algorithms.kernels.root_update import intersect_roots
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
from netkf.algorithms.models import first_root
from netkf.algorithms.pairs import pairs_now
from netkf.algorithms.registry import built_in
from netkf.algorithms.weights import METROPOLIS, check_columns
from netkf.core.fields import either, field, has_depth, one_of, square
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, Lanes, any_lane, load, load_flags, select, spread, store


class DiffusionState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of its covariance
    model : of the plant and the node's sensors
    own : weight that the node gives to its own estimate when all messages arrive
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    own: float

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class DiffusionWeights(NamedTuple):
    """The weights ``own`` (H,) that H filters give to their own estimates when all messages arrive;
    ``keep_own``: whether the weights of lost messages are added to them.
    """

    own: FloatArray
    keep_own: bool


@kernel(inlined=True)
def applied_weights(lanes: Lanes, own: float, received: Any, keep_own: bool) -> tuple[Any, Any]:
    """Return the own weight (L,) that is applied and the divisor (L,) of the other weights, so that
    all of them sum to 1, see ``DiffusionFilter.on_loss``.

    ``own`` is the nominal own weight of a filter, ``received`` (L,) the sum of those of the
    messages that arrived in each of L runs; ``keep_own``: lost weights go to the own one.
    """
    total, remainder = own + received, 1.0 - received
    # Rounding may bring the sum of the others above 1.
    remainder = select(remainder > 0.0, remainder, 0.0)
    # "keep-own", or weights that are all 0: the own weight is 1 minus the others.
    is_zero = total == 0.0
    divisor = select(is_zero, spread(lanes, 1.0), total)
    if keep_own:
        return remainder, spread(lanes, 1.0)
    return select(is_zero, remainder, own / divisor), divisor


@kernel
def applied_weights_single(own: float, received: float, keep_own: bool) -> tuple[float, float]:
    """Return the own weight that is applied and the divisor of the other weights, so that all of
    them sum to 1, for one filter in one run with the nominal weight ``own`` and the sum
    ``received`` of those of the messages that arrived; ``keep_own``: lost weights go to the own
    one.
    """
    weights: tuple[float, float] = applied_weights(ONE, own, received, keep_own)
    return weights


@kernel
def diffusion_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    weights: DiffusionWeights,
) -> None:
    """Simulate H diffusion filters over the S slots of a plan, paper D (6)-(9), in B blocks of L
    runs: in each slot they read, predict and combine, with the own ``weights`` (H,) and those of
    the links.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place and writes
    ``samples``, of the predictions with which slots begin.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            # Samples show predictions: before the reading of the slot.
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            # Keep the estimates relative to an origin near the true state.
            rebase(nodes, readings, scratch, b, s)
            if plan.sensed[s]:
                read_all(nodes, readings, scratch, b, s)
                predict_all(nodes, scratch, b)
            if plan.exchanged[s]:
                # Messages: copies of all estimates from before the exchange, and the inverses of
                # their roots, computed once for each sender.
                for h in range(len(nodes.rows)):
                    for i in range(nodes.xhat.shape[2]):
                        store(
                            scratch.lanes,
                            scratch.xhat,
                            h,
                            i,
                            load(scratch.lanes, nodes.xhat, b, h, i),
                        )
                    invert_lanes(scratch.lanes, scratch.root, h, nodes.root[b], h)
                for h in range(len(nodes.rows)):
                    combine_senders(nodes, plan, links, scratch, weights, b, s, h)


@kernel
def combine_senders(
    nodes: SlotNodes,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    weights: DiffusionWeights,
    b: int,
    s: int,
    h: int,
) -> None:
    """Combine filter ``h`` of block ``b`` with the messages that arrive in slot ``s``, by
    covariance intersection, paper D (8) and (9): changes ``nodes.xhat[b, h]`` (n, L) and
    ``nodes.root[b, h]`` (n, n, L).

    ``weights`` holds the own weights (H,), ``links`` those of messages. The messages are in
    ``scratch``: the estimates ``xhat`` (H, n, L) and the inverses of the roots, ``root``
    (H, n, n, L). Axes: H filters, L runs side by side.
    """
    lanes, received = scratch.lanes, spread(scratch.lanes, 0.0)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        received += select(arrived, links.weight[m], 0.0)
    own, divisor = applied_weights(lanes, weights.own[h], received, weights.keep_own)
    # With own weight 1 the estimate stays to the last bit.
    if not any_lane(own != 1.0):
        return
    # sum w_j P_j^-1 as a root [Z, z] relative to the own estimate: the own term first, then the
    # others are merged into it.
    whiten(lanes, scratch.total, own, scratch.root, scratch.xhat, h, scratch.xhat, h)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        # A weight of 0 adds no information.
        if links.weight[m] > 0.0 and any_lane(arrived):
            weight = select(arrived, links.weight[m] / divisor, 0.0)
            j, x = links.sender[m], scratch.xhat
            whiten(lanes, scratch.whitened, weight, scratch.root, x, j, x, h)
            merge_lanes(lanes, scratch.total, scratch.whitened)
    # P = (sum w_j P_j^-1)^-1, paper D (8), and the mean P sum w_j P_j^-1 x_j, (9); in lanes with
    # own weight 1 nothing changes.
    finish_lanes(
        lanes,
        nodes.root[b],
        nodes.xhat[b],
        h,
        scratch.xhat,
        scratch.total,
        scratch.whitened,
        own == 1.0,
    )


@built_in("diffusion")
@dataclass(frozen=True, eq=False)
class DiffusionFilter(Filter):
    """Xie, Gan and Liu, D Algorithm 1, (6)-(9), with any F in place of the identity; samples in
    slots are predictions.

    Under clocks a node combines its estimate with those that it heard at one instant; those of
    delayed messages are predicted to now first.

    weights entry [l][i] is the weight node i gives to what node l sends, in the order of node ids:
            columns sum to 1, and paper D's theorems need rows that sum to 1 too; or "metropolis",
            1 / (1 + the larger number of incoming links) for each link and the rest for the node
    on_loss what becomes of the weight of a message that did not come (its row in the trace is
            "lost" or "late"): "renormalise" divides the weights of those that came, the own one
            included, by their sum; "keep-own" adds it to the own one

    Either way the weights sum to 1 and P stays at least the covariance of the error; a node that
    heard nothing keeps its estimate.
    """

    weights: str | FloatArray = field(
        either(one_of(METROPOLIS), square, has_depth(1)), default=METROPOLIS
    )
    on_loss: str = field(one_of("renormalise", "keep-own"), default="renormalise")

    paper: ClassVar[str] = "diffusion"
    combination: ClassVar[str] = "shares"
    P_by_design: ClassVar[tuple[str, str]] = ("larger", "larger")
    schedule: ClassVar[tuple[str, ...]] = ("sense", "predict", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ("directions", "nodes", "readings")
    predicts: ClassVar[bool] = True
    one_way: ClassVar[bool] = True
    inverts: ClassVar[bool] = True
    slot_kernel = staticmethod(diffusion_slots)
    unrolled: ClassVar[bool] = True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[DiffusionWeights]:
        """Return the last argument of ``diffusion_slots``: the own weights (H,) of the H nodes that
        ``infos`` describes, and the rule for lost messages.
        """
        own = np.array([info.own_weight for info in infos], dtype=np.float64)
        return (DiffusionWeights(own, self.on_loss == "keep-own"),)

    def __post_init__(self) -> None:
        """Raise ScenarioError if a weight is negative or a column does not sum to 1."""
        super().__post_init__()
        if not isinstance(self.weights, str):
            check_columns(self.weights)

    @property
    def pair_weights(self) -> FloatArray | None:
        """The matrix (N, N) of weights, entry [l, i] for messages from node l to node i; None for
        Metropolis weights, which the method ``weight`` gives.
        """
        return None if isinstance(self.weights, str) else self.weights

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> DiffusionState:
        """Return the first state of a node, with estimate ``mean`` (n,) and covariance ``cov``
        (n, n) and the weight of its own estimate from ``node``.
        """
        return DiffusionState(mean, first_root(cov), model, node.own_weight)

    def absorb(
        self, state: DiffusionState, messages: Sequence[Message], exchange: Exchange
    ) -> DiffusionState:
        """Return the state after covariance intersection of the node's estimate with those of all
        messages, paper D (8) and (9).
        """
        own, shares = self.share(state.own, [message.weight for message in messages])
        # Nothing to combine, or all weight is the node's own.
        if own == 1.0 or not messages:
            return state
        means, roots = pairs_now(state, messages)
        xhat, root = intersect_roots(np.array([own, *shares]), means, roots)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine: the weights sum to one

    def share(self, own: float, arrived: list[float]) -> tuple[float, list[float]]:
        """Return the own weight and those of the messages that arrived, which sum to 1, from the
        nominal ones ``own`` and ``arrived``, one for each message: the rule ``on_loss``, applied.
        """
        # fsum: the sum must not depend on the order of messages.
        own_weight, divisor = applied_weights_single(
            own, math.fsum(arrived), self.on_loss == "keep-own"
        )
        return own_weight, [weight / divisor for weight in arrived]
