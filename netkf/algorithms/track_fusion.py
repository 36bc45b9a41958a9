"""Track fusion: estimates of several nodes become one, whether their correlation is known or not.

* Covariance intersection with the best weight: Julier and Uhlmann, "A non-divergent estimation
  algorithm in the presence of unknown correlations", ACC 1997.
* Inverse covariance intersection: Noack, Sijs, Reinhardt and Hanebeck, "Decentralized data fusion
  with inverse covariance intersection", Automatica 79, 2017.
* With known cross-covariances: Bar-Shalom and Campo, "The effect of the common process noise on the
  two-sensor fused-track covariance", IEEE Trans. Aerospace and Electronic Systems 22, 1986.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading, State
from netkf.algorithms.kernels.neighbours import copy_pairs
from netkf.algorithms.kernels.pair_fusion import fuse_pair, fuse_tracks
from netkf.algorithms.kernels.root_update import lower_root
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
    show,
)
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.registry import built_in
from netkf.algorithms.starts import require_common_start
from netkf.core.errors import ScenarioError
from netkf.core.fields import choice, field
from netkf.linalg.arrays import FloatArray, square_root
from netkf.linalg.compiling import kernel

TRACE, DETERMINANT = "trace", "determinant"
INTERSECTION = 'rule = "ci"'
NEGLIGIBLE = 1e-12
"""Relative variance of differences of tracks that is rounding: these tracks are the same."""


class FusionArrays(NamedTuple):
    """How pairs are fused, and scratch: ``pair`` (2 n + 2, n), an estimate (n,) with its root
    (n, n), and those of another node.
    """

    inverse: bool
    trace: bool
    pair: FloatArray
    x: FloatArray
    root: FloatArray
    other_x: FloatArray
    other: FloatArray


@kernel
def fusion_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: FusionArrays,
) -> None:
    """Carry filters that fuse pairs of estimates through the slots of a plan."""
    for b in range(plan.up.shape[0]):
        for s in range(plan.up.shape[1]):
            if plan.sensed[s]:
                predict_all(nodes, scratch, b)
                read_all(nodes, readings, scratch, b, s)
            if plan.exchanged[s]:
                # What was sent: all estimates from before the exchange.
                copy_pairs(nodes, scratch, b)
                for h in range(len(nodes.rows)):
                    for q in range(len(scratch.lanes)):
                        fuse_heard(nodes, plan, links, scratch, arrays, (b, s, h, q))
            show(nodes, plan, samples, scratch, b, s)
            rebase(nodes, readings, scratch, b, s)


@kernel
def fuse_heard(
    nodes: SlotNodes,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    arrays: FusionArrays,
    place: tuple[int, int, int, int],
) -> None:
    """Fuse filter h of lane q, at ``place`` [b, s, h, q], with all that it hears, one by one."""
    b, s, h, q = place
    n, heard = nodes.xhat.shape[2], False
    for m in range(links.first[h], links.first[h + 1]):
        if not plan.up[b, s, 0, links.way[m], q]:
            continue
        # The weight of a link is not used: whoever is heard counts by its covariance.
        sender = links.sender[m]
        if not heard:
            copy_track(arrays.x, arrays.root, scratch.xhat, scratch.root, h, q)
            heard = True
        copy_track(arrays.other_x, arrays.other, scratch.xhat, scratch.root, sender, q)
        fuse_pair(
            arrays.x, arrays.root, arrays.other_x, arrays.other, arrays.inverse, arrays.trace,
            arrays.pair,
        )  # fmt: skip
    if heard:
        for i in range(n):
            nodes.xhat[b, h, i, q] = arrays.x[i]
            for j in range(i + 1):
                nodes.root[b, h, i, j, q] = arrays.root[i, j]


@kernel(inlined=True)
def copy_track(
    x: FloatArray, root: FloatArray, means: FloatArray, roots: FloatArray, h: int, q: int
) -> None:
    """Copy the estimate of filter h in lane q to x (n,) and ``root`` (n, n)."""
    for i in range(len(x)):
        x[i] = means[h, i, q]
        for j in range(i + 1):
            root[i, j] = roots[h, i, j, q]


@dataclass(frozen=True, eq=False)
class PairFusion(Filter):
    """A node fuses its estimate with each one that it hears, one after the other in the order of
    the senders' ids, with the weight that minimises the trace of P or its determinant.

    minimise  "trace" or "determinant" of P after each fusion
    """

    minimise: str = field(choice(TRACE, DETERMINANT), default=TRACE)

    paper: ClassVar[str] = "track_fusion"
    clocks: ClassVar[tuple[str, ...]] = ("links", "directions", "nodes", "readings")
    first_slot: ClassVar[int] = 1
    one_way: ClassVar[bool] = True
    inverts: ClassVar[bool] = True
    inverse: ClassVar[bool] = False
    slot_kernel = staticmethod(fusion_slots)

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[FusionArrays]:
        """Return the settings and scratch."""
        n = len(states[0].xhat)
        shapes = [(2 * n + 2, n), (n,), (n, n), (n,), (n, n)]
        scratch = [np.zeros(shape) for shape in shapes]
        return (FusionArrays(self.inverse, self.minimise == TRACE, *scratch),)

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        """Fuse with each estimate heard, predicted to now."""
        pair = state.xhat, state.root
        for message in messages:
            heard = message.payload
            other = state.model.extrapolate(heard.xhat, heard.root, message.age)
            pair = fuse_tracks(pair, other, self.inverse, self.minimise == TRACE)
        return state._replace(xhat=pair[0], root=pair[1])

    shift = Filter.shift  # affine: the gains of both estimates sum to I, and only P decides them


@built_in("track-fusion", rule="ci")
@dataclass(frozen=True, eq=False)
class OptimisedIntersection(PairFusion):
    """Covariance intersection with the best weight, ``P^-1 = w P_a^-1 + (1 - w) P_b^-1``, Julier
    and Uhlmann 1997: P is never below the covariance of the error, however tracks are correlated.
    """

    combination: ClassVar[str] = "best intersection"
    P_by_design: ClassVar[tuple[str, str]] = ("larger", "larger")


@built_in("track-fusion", rule="ici")
@dataclass(frozen=True, eq=False)
class InverseIntersection(PairFusion):
    """Inverse covariance intersection, Noack et al. 2017: ``P^-1 = P_a^-1 + P_b^-1 - M^-1`` with
    ``M = w P_a + (1 - w) P_b``, never larger than what covariance intersection gives.

    P bounds the error of one fusion of tracks that share a part of their information and are
    independent besides. For a network that fuses over and over no bound is proved.
    """

    combination: ClassVar[str] = "inverse intersection"
    inverse: ClassVar[bool] = True


class Track(NamedTuple):
    """A payload: the sender's own track ``xhat`` (n,), and its sensors H (p, n) and R (p, p)."""

    xhat: FloatArray
    H: FloatArray
    R: FloatArray


class TrackState(NamedTuple):
    """The node's own track ``xhat`` (n,) with ``root`` (n, n) and the model; ``fused`` (n,) and
    ``fused_root`` (n, n) of what it shows; the ``slot``, and the sensors (H, R) of the ``senders``
    it has heard of, its own first (sender -1); ``joint`` (m n, m n), the covariance of the errors
    of these m tracks; and the covariance ``start`` (n, n) that all of them began with.
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    fused: FloatArray
    fused_root: FloatArray
    slot: int
    senders: tuple[int, ...]
    sensors: tuple[tuple[FloatArray, FloatArray], ...]
    joint: FloatArray
    start: FloatArray

    @property
    def P(self) -> FloatArray:
        """``fused_root fused_root'`` (n, n)."""
        return self.fused_root @ self.fused_root.T


@built_in("track-fusion", rule="cross-covariance")
@dataclass(frozen=True, eq=False)
class BarShalomCampo(Filter):
    """Every node runs a Kalman filter on its own readings, sends this track, and shows the best
    linear combination of it and the tracks heard in this slot, Bar-Shalom and Campo 1986.

    Messages carry the sender's sensors, from which the receiver computes the cross-covariances of
    the tracks: the common process noise and the common start correlate them. What is shown does not
    enter the tracks. Of more than two tracks it is the combination with the least covariance.
    """

    paper: ClassVar[str] = "track_fusion"
    combination: ClassVar[str] = "tracks"
    clocks: ClassVar[tuple[str, ...]] = ()
    first_slot: ClassVar[int] = 1
    one_way: ClassVar[bool] = True
    fixed_sensors: ClassVar[bool] = True

    def check_scenario(self, scenario: Any) -> None:
        """Raise ScenarioError where tracks do not begin alike or H varies."""
        why = "where cross-covariances begin"
        require_common_start(scenario, why, INTERSECTION)
        for k, sensor in enumerate(scenario.sensors):
            if sensor.varying:
                raise ScenarioError(
                    f"sensors[{k}]",
                    "must have a fixed H, from which other nodes compute cross-covariances",
                    None,
                    f"use a sensor with a fixed H, or {INTERSECTION}",
                )

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the numbers of a message, a track; sensors do not change and are not counted."""
        return n

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> TrackState:
        """Return the first state of a node, which shows its own track."""
        root = first_root(cov)
        return TrackState(mean, root, model, mean, root, 0, (-1,), ((model.H, model.R),), cov, cov)

    def predict(self, state: TrackState, gap: float) -> TrackState:
        """Predict the tracks."""
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        joint = predict_joint(state.joint, state.model)
        return state._replace(
            xhat=xhat, root=root, fused=xhat, fused_root=root, joint=joint, slot=state.slot + 1
        )

    def update(self, state: TrackState, reading: Reading) -> TrackState:
        """Update the own track by the reading, and the covariances of all."""
        tracked: TrackState = super().update(state, reading)
        joint = update_joint(state.joint, state.sensors, len(state.xhat))
        return tracked._replace(joint=joint, fused=tracked.xhat, fused_root=tracked.root)

    def emit(self, state: TrackState, exchange: Exchange) -> tuple[TrackState, Track]:
        """Send the own track."""
        return state, Track(state.xhat, *state.sensors[0])

    def absorb(
        self, state: TrackState, messages: Sequence[Message], exchange: Exchange
    ) -> TrackState:
        """Combine the own track with those heard."""
        if not messages:
            return state
        state = with_senders(state, messages)
        n = len(state.xhat)
        places = [state.senders.index(message.sender) for message in messages]
        blocks = state.joint.reshape(len(state.senders), n, -1, n)
        gaps = np.concatenate([message.payload.xhat - state.xhat for message in messages])
        gain, root = best_combination(blocks, places, state.root)
        return state._replace(fused=state.xhat + gain @ gaps, fused_root=root)

    def estimate(self, state: TrackState) -> tuple[FloatArray, FloatArray]:
        """Return the combination."""
        return state.fused, state.P

    def shift(self, state: TrackState, offset: FloatArray) -> TrackState:
        """Return the state shifted by ``offset``: tracks enter by their differences."""
        return state._replace(xhat=state.xhat + offset, fused=state.fused + offset)


def predict_joint(joint: FloatArray, model: SlotModel) -> FloatArray:
    """Return the covariance (m n, m n) of the errors of m tracks one slot later: all of them have
    the same process noise.
    """
    n = len(model.F)
    m = len(joint) // n
    moved = np.einsum("ab,ibjc,dc->iajd", model.F, joint.reshape(m, n, m, n), model.F)
    return np.asarray((moved + model.Q[None, :, None, :]).reshape(m * n, m * n))


def update_joint(
    joint: FloatArray, sensors: Sequence[tuple[FloatArray, FloatArray]], n: int
) -> FloatArray:
    """Return the covariance (m n, m n) of the errors of m tracks after each has used a reading of
    its own ``sensors`` (H, R), ``P_ij+ = (I - K_i H_i) P_ij (I - K_j H_j)'``.
    """
    m, eye = len(sensors), np.eye(n)
    blocks = joint.reshape(m, n, m, n)
    closed, noise = np.zeros((m, n, n)), np.zeros((m, n, n))
    for k, (H, R) in enumerate(sensors):
        P = blocks[k, :, k]
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        closed[k], noise[k] = eye - K @ H, K @ R @ K.T
    found = np.einsum("iab,ibjc,jdc->iajd", closed, blocks, closed)
    # Noises of different nodes are independent.
    found[range(m), :, range(m)] += noise
    return np.asarray(found.reshape(m * n, m * n))


def with_senders(state: TrackState, messages: Sequence[Message]) -> TrackState:
    """Return the state that knows all senders of messages, and the covariances of their tracks."""
    new = [message for message in messages if message.sender not in state.senders]
    if not new:
        return state
    senders = (*state.senders, *(message.sender for message in new))
    sensors = (*state.sensors, *((m.payload.H, m.payload.R) for m in new))
    # Nothing of the joint covariance depends on data: it is made up for from the start on.
    joint = np.tile(state.start, (len(senders), len(senders)))
    for _ in range(state.slot):
        joint = update_joint(predict_joint(joint, state.model), sensors, len(state.xhat))
    return state._replace(senders=senders, sensors=sensors, joint=joint)


def best_combination(
    blocks: FloatArray, places: Sequence[int], own_root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the gain (n, k n) by which differences of k tracks at ``places`` to the own one, place
    0, correct it with the least covariance, and the root (n, n) of that covariance.

    ``blocks`` (m, n, m, n) are the covariances of the errors of tracks. For one other track it is
    the gain ``(P_i - P_ij) (P_i + P_j - P_ij - P_ji)^-1`` of Bar-Shalom and Campo.
    """
    m, n = blocks.shape[:2]
    # d = (e_i - e_j) for each j: rows of differences of the errors of all tracks.
    differences = np.zeros((len(places), n, m, n))
    for k, place in enumerate(places):
        differences[k, :, 0] += np.eye(n)
        differences[k, :, place] -= np.eye(n)
    rows, joint = differences.reshape(len(places) * n, m * n), blocks.reshape(m * n, m * n)
    cross, spread = joint[:n] @ rows.T, rows @ joint @ rows.T
    values, vectors = np.linalg.eigh(spread)
    # Tracks that are the same, such as those of two blind nodes, leave nothing to choose.
    used = values > NEGLIGIBLE * max(float(values[-1]), float(np.trace(joint)))
    gain = (cross @ vectors[:, used] / values[used]) @ vectors[:, used].T
    # The covariance of e_i - G d, as a product, so that it stays positive semidefinite.
    errors = -gain @ rows
    errors[:, :n] += np.eye(n)
    root = square_root(np.asarray(errors @ joint @ errors.T)) if used.any() else own_root
    return np.asarray(gain), lower_root(root)
