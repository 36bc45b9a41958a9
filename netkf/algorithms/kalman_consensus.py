"""The Kalman-consensus filter: Olfati-Saber, "Kalman-consensus filter: optimality, stability, and
performance", CDC 2009, Algorithm 1 (first proposed in CDC 2007, Algorithm 3).

With predictions xbar_j, the readings heard and a consensus term give ``xhat = xbar + M (y - S xbar)
+ gamma P sum_j (xbar_j - xbar)``: y and S are sums of H' R^-1 y and H' R^-1 H over these readings,
P is the covariance of xbar, M = (P^-1 + S)^-1, and gamma = epsilon / (1 + |P|).

Kernels simulate L runs at once (lanes, the last axis) in B blocks, with the structs of
``kernels.slots``: ``nodes`` (estimates and roots of H filters), ``readings`` (whitened, so that
noise has variance 1), ``plan`` (the events of S slots), ``links``, ``samples`` (output) and
``scratch``. Estimates are relative to an origin near the true state, which moves in some slots
(``rebase``, ``shift``), so that large states cost no digits. A kernel ``*_single`` runs one node
in one run, for the SimPy engine: both engines round alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.neighbours import (
    add_to_estimate,
    fuse_readings,
    scale_by_covariance,
    sum_differences,
)
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
from netkf.core.fields import boolean, field, number
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE


class KcfState(NamedTuple):
    """The state of a node.

    xhat, root : estimate (n,) and root (n, n) of P
    model : of the plant and the node's sensors
    prior, prior_root : prediction (n,) of this instant and its root (n, n), before any reading
    reading : the node's own reading of this instant, or None
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    prior: FloatArray
    prior_root: FloatArray
    reading: Reading | None = None

    @property
    def P(self) -> FloatArray:
        """The covariance ``root root'`` (n, n) of the estimate."""
        return self.root @ self.root.T


class Shared(NamedTuple):
    """A payload: the sender's prediction ``xhat`` (n,) and its reading of this instant."""

    xhat: FloatArray
    reading: Reading | None


class KcfArrays(NamedTuple):
    """The settings of all filters: ``epsilon``, the strength of the consensus term, and whether
    nodes ``share`` their readings.
    """

    epsilon: float
    share: bool


@kernel
def kcf_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: KcfArrays,
) -> None:
    """Simulate H Kalman-consensus filters over the S slots of a plan, in B blocks of L runs:
    changes ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L) in place, and writes
    ``samples`` in the slots that have one; ``arrays`` holds the settings.

    With prediction x and its covariance P, a slot's readings first update x, and then the consensus
    term epsilon / (1 + |P|) P sum_j (x_j - x), computed from predictions alone, is added.
    """
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.sensed[s]:
                predict_all(nodes, scratch, b)
                # Consensus is on predictions and their covariances: before any reading is used. The
                # sum has no weights (False).
                for h in range(len(nodes.rows)):
                    sum_differences(
                        scratch.lanes, nodes.xhat, b, h, links, plan.up, s, 0, False, scratch.xhat
                    )
                    scale_by_covariance(
                        scratch.lanes, nodes.root, b, h, arrays.epsilon, scratch.xhat, scratch.row
                    )
                # The terms are in scratch.xhat, so that estimates may change one after the other.
                for h in range(len(nodes.rows)):
                    fuse_readings(nodes, readings, plan, links, scratch, arrays.share, b, s, h)
                    add_to_estimate(scratch.lanes, nodes.xhat, b, h, scratch.xhat)
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            rebase(nodes, readings, scratch, b, s)


@kernel
def consensus_term_single(
    x: FloatArray,
    links: SlotLinks,
    up: Any,
    root: FloatArray,
    epsilon: float,
    term: FloatArray,
    work: FloatArray,
) -> None:
    """Write the consensus term ``epsilon / (1 + |P|) P sum_j (x_j - x_0)`` of one node in one run
    into ``term`` (1, n, 1).

    x (1, H, n, 1) holds its own prediction x_0 and those of its senders, ``up`` (1, 1, 1, W, 1)
    flags their messages, and P has the root ``root`` (1, 1, n, n, 1); ``work`` (n, 1) is scratch.
    Axes: W directed links, H nodes.
    """
    sum_differences(ONE, x, 0, 0, links, up, 0, 0, False, term)
    scale_by_covariance(ONE, root, 0, 0, epsilon, term, work)


@built_in("kcf")
@dataclass(frozen=True, eq=False)
class Kcf(Filter):
    """Kalman update with the node's own and its neighbours' readings, plus a consensus term on
    predictions, ``epsilon / (1 + |P|) P sum_j (xbar_j - xbar)``, Algorithm 1.

    epsilon         the strength of the consensus term
    share_readings  whether nodes send their readings beside their predictions (Algorithm 1); if
                    not, the update is with the node's own alone

    P counts the readings and leaves the consensus term out: it is no bound on the error. Under
    clocks a reading is used only by nodes that receive it without delay.
    """

    epsilon: float = field(number(low=0.0), default=0.1)
    share_readings: bool = field(boolean, default=True)

    paper: ClassVar[str] = "kalman_consensus"
    combination: ClassVar[str] = "predictions"
    schedule: ClassVar[tuple[str, ...] | None] = ("predict", "sense", "exchange")
    clocks: ClassVar[tuple[str, ...]] = ("directions", "nodes", "readings")
    one_way: ClassVar[bool] = True
    needs_samples: ClassVar[bool] = True
    slot_kernel = staticmethod(kcf_slots)
    unrolled: ClassVar[bool] = True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[KcfArrays]:
        """Return the settings that the compiled ``slot_kernel`` needs: epsilon, and whether
        readings are shared, the same for all nodes and runs.
        """
        return (KcfArrays(self.epsilon, self.share_readings),)

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the size of a message about n states in numbers of 64 bits: (u, U, xbar) with
        u = H' R^-1 y and U = H' R^-1 H, or xbar alone from a node without ``rows`` of readings or
        if readings are not shared.
        """
        return 2 * n + n * (n + 1) // 2 if rows and self.share_readings else n

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> KcfState:
        """Return the state at time 0, a prediction with ``mean`` (n,) and ``cov`` (n, n)."""
        root = first_root(cov)
        return KcfState(mean, root, model, mean, root)

    def predict(self, state: KcfState, gap: float) -> KcfState:
        """Return the state ``gap`` seconds later, a prediction without a reading: one of an earlier
        instant is not sent any more.
        """
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        return KcfState(xhat, root, state.model, xhat, root)

    def update(self, state: KcfState, reading: Reading) -> KcfState:
        """Return the state after the node's own reading, which is kept to be sent."""
        if not len(reading.y):
            return state
        xhat, root = sample_update(state.xhat, state.root, reading.y, reading.H, reading.R)
        return state._replace(xhat=xhat, root=root, reading=reading)

    def emit(self, state: KcfState, exchange: Exchange) -> tuple[KcfState, Shared]:
        """Return the state, unchanged, and the payload: the prediction, and unless readings are not
        shared the reading, which stands for u and U in the message (u, U, xbar) of Algorithm 1.
        """
        return state, Shared(state.prior, state.reading if self.share_readings else None)

    def absorb(self, state: KcfState, messages: Sequence[Message], exchange: Exchange) -> KcfState:
        """Return the state after an update with all readings heard, with the consensus term on
        predictions added.
        """
        if not messages:
            return state
        xhat, root = state.xhat, state.root
        for message in messages:
            reading = message.payload.reading
            # A late reading belongs to another instant.
            if reading is not None and (exchange.slot >= 0 or message.age <= 0.0):
                xhat, root = sample_update(xhat, root, reading.y, reading.H, reading.R)
        # Only the means are needed, since the gain of the consensus term is the node's own P: any
        # root serves as second argument.
        predictions = [
            state.model.extrapolate(message.payload.xhat, state.root, message.age)[0]
            for message in messages
        ]
        term = consensus_term(state.prior, state.prior_root, predictions, self.epsilon)
        return state._replace(xhat=xhat + term, root=root)

    def shift(self, state: KcfState, offset: FloatArray) -> KcfState:
        """Return the state with ``offset`` (n,) added to estimate and prediction, for a move of the
        origin: the consensus term is made of differences.
        """
        return state._replace(xhat=state.xhat + offset, prior=state.prior + offset)


def consensus_term(
    prior: FloatArray, root: FloatArray, predictions: Sequence[FloatArray], epsilon: float
) -> FloatArray:
    """Return ``gamma P sum_j (xbar_j - xbar)`` (n,) with ``gamma = epsilon / (1 + |P|)``, for the
    ``predictions`` xbar_j (n,) that a node received; its own is ``prior`` (n,) with the lower
    triangular ``root`` (n, n) of P.
    """
    # The kernel of slots on a star: the node itself, and one link from each sender.
    n, x = len(prior), np.stack([prior, *predictions])[None, :, :, None]
    links, up = star_of([1.0] * len(predictions))
    term, S = np.empty((1, n, 1)), np.ascontiguousarray(root).reshape(1, 1, n, n, 1)
    consensus_term_single(x, links, up, S, epsilon, term, np.empty((n, 1)))
    return term.reshape(n)
