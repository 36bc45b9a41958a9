"""The diffusion Kalman filter: Cattivelli and Sayed, "Diffusion strategies for distributed Kalman
filtering and smoothing", IEEE Trans. Automatic Control 55, 2010, Algorithm 1.

In each slot nodes first exchange readings and update with all that they hear (step 1: the result is
psi), then exchange psi and form weighted means (step 2). ``diffusion_kalman_slots`` simulates many
runs in the compiled engine, in place of the methods of ``DiffusionKalman``; the types of its
arguments are described in ``kernels.slots``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.neighbours import add_to_estimate, fuse_readings, sum_differences
from netkf.algorithms.kernels.slots import (
    ReadingBlock,
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotSamples,
    SlotScratch,
    predict_all,
    rebase,
    star_of,
    store_sample_of_slot,
)
from netkf.algorithms.models import first_root, sample_update
from netkf.algorithms.registry import built_in
from netkf.algorithms.weights import METROPOLIS, check_columns
from netkf.core.fields import either, field, has_depth, one_of, square
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE

READINGS, ESTIMATES = 0, 1
"""Numbers of the two exchanges of a slot, ``Exchange.phase``."""


class DiffusionKalmanState(NamedTuple):
    """The state of a node.

    xhat : estimate (n,); between the two exchanges of a slot it is psi
    root : root (n, n) of P
    model : of the plant and the node's sensors
    reading : the node's own reading of this slot, or None
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    reading: Reading | None = None

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


@kernel
def diffusion_kalman_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
) -> None:
    """Simulate H diffusion Kalman filters over the S slots of a plan, in B blocks of L runs: in
    each slot they predict, use the readings of their neighbourhood, and combine estimates.

    Changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place and writes
    ``samples`` in the slots that have one.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.sensed[s]:
                predict_all(nodes, scratch, b)
                # Step 1, psi: update with the own reading and those that arrive in exchange 0.
                for h in range(len(nodes.rows)):
                    fuse_readings(nodes, readings, plan, links, scratch, True, b, s, h)
                # Step 2, in exchange 1: xhat_i = psi_i + sum_l c_{l,i} (psi_l - psi_i).
                # All differences before any estimate moves: the combination is simultaneous.
                for h in range(len(nodes.rows)):
                    sum_differences(
                        scratch.lanes, nodes.xhat, b, h, links, plan.up, s, 1, True, scratch.xhat
                    )
                for h in range(len(nodes.rows)):
                    add_to_estimate(scratch.lanes, nodes.xhat, b, h, scratch.xhat)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            # Keep the estimates relative to an origin near the true state.
            rebase(nodes, readings, scratch, b, s)


@kernel
def sum_differences_single(
    x: FloatArray, links: SlotLinks, up: Any, differences: FloatArray
) -> None:
    """Write into ``differences`` (1, n, 1) the weighted sum of x_j - x_0 over the estimates x_j
    that arrive at one node in one run; x (1, H, n, 1) holds its own estimate x_0 and those of its
    senders, ``links`` their weights, and ``up`` (1, 1, 1, W, 1) flags their messages.

    Axes: W directed links, H nodes. For ``combine_estimates``.
    """
    sum_differences(ONE, x, 0, 0, links, up, 0, 0, True, differences)


@built_in("diffusion-kalman")
@dataclass(frozen=True, eq=False)
class DiffusionKalman(Filter):
    """Update with the readings of the neighbourhood, then combine the neighbours' estimates.

    weights entry [l][i] is the weight c_{l,i} that node i gives to what node l sends, in the order
            of node ids: columns sum to 1; or "metropolis", 1 / (1 + max degree) for each link and
            the rest for the node itself

    The weight of an estimate that does not come stays with the node itself. P counts the readings
    that a node has used; the combination leaves it as it is, so it is no bound on the error.
    """

    weights: str | FloatArray = field(
        either(one_of(METROPOLIS), square, has_depth(1)), default=METROPOLIS
    )

    paper: ClassVar[str] = "diffusion_kalman"
    combination: ClassVar[str] = "readings, then estimates"
    schedule: ClassVar[tuple[str, ...] | None] = ("predict", "sense", "exchange", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ()
    one_way: ClassVar[bool] = True
    slot_kernel = staticmethod(diffusion_kalman_slots)
    unrolled: ClassVar[bool] = True

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

    def sends_in_slots(self, phase: int, has_sensor: bool) -> bool:
        """Return False if a node has nothing to send in exchange number ``phase`` of a slot: a
        reading in the first one, unless it ``has_sensor``. All send estimates in the second.
        """
        return has_sensor or phase == ESTIMATES

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the size of a message in numbers of 64 bits: in the exchange (``phase``) of
        readings y, H and R of ``rows`` rows, in that of estimates psi with n states.
        """
        return n if phase == ESTIMATES else rows * (1 + n) + rows * (rows + 1) // 2

    def init(
        self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo
    ) -> DiffusionKalmanState:
        """Return the state at time 0 from ``mean`` (n,) and ``cov`` (n, n)."""
        return DiffusionKalmanState(mean, first_root(cov), model)

    def update(self, state: DiffusionKalmanState, reading: Reading) -> DiffusionKalmanState:
        """Return the state after the node's own reading, which is kept to be sent."""
        if not len(reading.y):
            return state._replace(reading=None)
        xhat, root = sample_update(state.xhat, state.root, reading.y, reading.H, reading.R)
        return state._replace(xhat=xhat, root=root, reading=reading)

    def emit(
        self, state: DiffusionKalmanState, exchange: Exchange
    ) -> tuple[DiffusionKalmanState, Any]:
        """Return the state, unchanged, and the payload: in the first exchange of a slot the reading
        (None from nodes that have none), in the second psi (n,).
        """
        return state, state.xhat if exchange.phase == ESTIMATES else state.reading

    def absorb(
        self, state: DiffusionKalmanState, messages: Sequence[Message], exchange: Exchange
    ) -> DiffusionKalmanState:
        """Return the state after step 1 of Algorithm 1, the update with all readings received, or
        after step 2, the weighted combination of estimates.
        """
        if not messages:
            return state
        if exchange.phase == ESTIMATES:
            return state._replace(xhat=combine_estimates(state.xhat, messages))
        # One after the other: with independent noise that equals one update with all of them.
        xhat, root = state.xhat, state.root
        for message in messages:
            reading = message.payload
            xhat, root = sample_update(xhat, root, reading.y, reading.H, reading.R)
        return state._replace(xhat=xhat, root=root)

    shift = Filter.shift  # affine: the weights sum to one

    def shift_payload(self, payload: Any, offset: FloatArray) -> Any:
        """Return the payload of a message under way, for a move of the origin by which estimates
        change by ``offset`` (n,): readings keep the coordinates of their time.
        """
        return payload if isinstance(payload, Reading) else payload + offset


def combine_estimates(psi: FloatArray, messages: Sequence[Message]) -> FloatArray:
    """Return ``sum_l c_l psi_l`` (n,) with the weights c_l of the messages, whose payloads are the
    estimates psi_l (n,), and the rest of the weight for the node's own ``psi`` (n,).
    """
    # As differences to psi, so that equal estimates give psi to the last bit.
    n, x = len(psi), np.stack([psi, *(m.payload for m in messages)])[None, :, :, None]
    links, up = star_of([message.weight for message in messages])
    differences = np.empty((1, n, 1))
    sum_differences_single(x, links, up, differences)
    return np.asarray(psi + differences.reshape(n))
