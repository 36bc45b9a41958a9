"""Track fusion: estimates of several nodes become one, whether their correlation is known or not.

* Covariance intersection with the best weight: Julier and Uhlmann, "A non-divergent estimation
  algorithm in the presence of unknown correlations", ACC 1997.
* Inverse covariance intersection: Noack, Sijs, Reinhardt and Hanebeck, "Decentralized data fusion
  with inverse covariance intersection", Automatica 79, 2017.
* With known cross-covariances: Bar-Shalom and Campo, "The effect of the common process noise on the
  two-sensor fused-track covariance", IEEE Trans. Aerospace and Electronic Systems 22, 1986.

A track is a node's estimate. By the first two rules (``PairFusion``) nodes fuse estimates in place
of their own. By the third (``BarShalomCampo``) each node's own track is a Kalman filter on its own
readings; fused estimates are only reported. Its joint covariance holds E[e_i e_j'] (n, n) of the
errors of all pairs of tracks.

Kernels simulate L runs at once (lanes, the last axis) in B blocks, with the structs of
``kernels.slots``: ``nodes`` (estimates and roots of H filters), ``readings`` (whitened, so that
noise has variance 1), ``plan`` (the events of S slots), ``links``, ``samples`` (output) and
``scratch``. Estimates are relative to an origin near the true state, which moves in some slots
(``rebase``, ``shift``), so that large states cost no digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, Reading
from netkf.algorithms.kernels.pair_fusion import fuse_pair
from netkf.algorithms.kernels.run import carry
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
    whiten_reading,
)
from netkf.algorithms.kernels.tracks import (
    TrackScratch,
    combine_tracks,
    predict_joint,
    track_scratch,
    update_joint,
)
from netkf.algorithms.models import SlotModel, first_root
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.core.fields import field, one_of
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import blocks_of, in_lanes, load, store
from netkf.linalg.small import copy_matrix

TRACE, DETERMINANT = "trace", "determinant"
INTERSECTION = 'rule = "ci"'  # the filter that error messages recommend
COMBINATIONS, MAX_DIRECTION_BITS = 64, 62
"""Combinations of tracks in the cache of a node, and incoming links that have a bit of their own in
its keys.
"""


@kernel
def fuse_heard(record: Any, h: int, run: Any) -> None:
    """Fuse the estimate of node ``h`` with each one that it hears, one after the other, by the rule
    of the record. Weights of links are not used: the covariances decide.
    """
    payload = record.payload
    for k in range(run.count):
        m = run.message[k]
        carry(run.model, run, payload.xhat, payload.root, m, run.age[k])
        # Run by run: the best weight is found by iterations that differ from run to run.
        for q in range(len(run.lanes)):
            if run.arrived[k, q] == 1:
                copy_track(record.x, record.S, record.xhat, record.root, h, q)
                copy_track(record.other_x, record.other_S, payload.xhat, payload.root, m, q)
                fuse_pair(
                    record.x, record.S, record.other_x, record.other_S, record.inverse,
                    record.trace, record.work,
                )  # fmt: skip
                for i in range(len(run.size)):
                    record.xhat[h, i, q] = record.x[i]
                    for j in range(i + 1):
                        record.root[h, i, j, q] = record.S[i, j]


@kernel(inlined=True)
def copy_track(
    x: FloatArray, root: FloatArray, means: FloatArray, roots: FloatArray, h: int, q: int
) -> None:
    """Copy estimate ``h`` in lane ``q`` of ``means`` (H, n, L) and lower triangular ``roots``
    (H, n, n, L) to x (n,) and ``root`` (n, n).
    """
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

    minimise: str = field(one_of(TRACE, DETERMINANT), default=TRACE)

    paper: ClassVar[str] = "track_fusion"
    clocks: ClassVar[tuple[str, ...]] = ("links", "directions", "nodes", "readings")
    one_way: ClassVar[bool] = True
    inverts: ClassVar[bool] = True
    inverse: ClassVar[bool] = False
    kernels = Kernels(absorb=fuse_heard, unrolled=False)

    def record(self, infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
        """Return the rule, and scratch for one fusion at a time."""
        n = len(models[0].information)
        scratch = {"work": (2 * n + 2, n), "x": (n,), "S": (n, n), "other_x": (n,)}
        scratch |= {"other_S": (n, n)}
        return Record(
            payload={"xhat": (n,), "root": (n, n)},
            settings={
                "inverse": self.inverse,
                "trace": self.minimise == TRACE,
                **{name: np.zeros(shape) for name, shape in scratch.items()},
            },
        )

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
    """A payload: the sender's own track ``xhat`` (n,), and the whitened H (p, n) of its sensors."""

    xhat: FloatArray
    H: FloatArray


class TrackState(NamedTuple):
    """The state of a node of ``BarShalomCampo``.

    xhat, root : the node's own track (n,) and its root (n, n)
    model : of the plant and the node's sensors
    fused, fused_root : the reported estimate (n,) and its root (n, n)
    slot : number of the slot
    senders, sensors : ids of the m nodes whose sensors it knows, first -1 for itself, then those it
                       has heard, and the whitened H of each
    joint : (m, m, n, n), covariances E[e_i e_j'] of the errors of their tracks
    start : covariance (n, n) of the error with which all tracks began
    """

    xhat: FloatArray
    root: FloatArray
    model: Any
    fused: FloatArray
    fused_root: FloatArray
    slot: int
    senders: tuple[int, ...]
    sensors: tuple[FloatArray, ...]
    joint: FloatArray
    start: FloatArray

    @property
    def P(self) -> FloatArray:
        """The covariance ``fused_root fused_root'`` (n, n) of the reported estimate."""
        return self.fused_root @ self.fused_root.T


class CombinationCache(NamedTuple):
    """Combinations that were computed for one node in one slot, C at most: all runs in which it
    hears the same nodes share one.

    key : (C,), a number with a bit for each incoming link on which a track arrived; -1: free entry
    rank : (C,), rank of the differences of the tracks; 0: all tracks are the same
    gain : (C, n, k n), gains of the differences of up to k tracks to the own one
    root : (C, n, n), root of the covariance of the combination
    """

    key: np.ndarray
    rank: np.ndarray
    gain: FloatArray
    root: FloatArray


class TrackArrays(NamedTuple):
    """What ``track_slots`` keeps of all H nodes for B blocks of L runs.

    xhat, root : own tracks (B, H, n, L) and their roots (B, H, n, n, L)
    Q, H : process noise covariance (n, n) and whitened sensors (H, p, n)
    joint, pairs : covariances E[e_i e_j'] (K, n, n), the same in all runs, of the pairs (i, j),
                   (K, 2), of tracks that some node may combine
    first : (H + 1,), pairs (i, .) begin at ``first[i]``
    closed : (H, n, n), scratch, I - K_i H_i of each node
    tracks, block : scratch, indices (D + 1,) of the tracks to combine, the own one first, and their
                    joint covariance (D + 1, D + 1, n, n), for at most D senders
    scratch, cache : for combinations
    """

    xhat: FloatArray
    root: FloatArray
    Q: FloatArray
    H: FloatArray
    joint: FloatArray
    pairs: np.ndarray
    first: np.ndarray
    closed: FloatArray
    tracks: np.ndarray
    block: FloatArray
    scratch: TrackScratch
    cache: CombinationCache


@kernel
def track_slots(
    nodes: SlotNodes,
    readings: ReadingBlock,
    plan: SlotPlan,
    links: SlotLinks,
    samples: SlotSamples,
    scratch: SlotScratch,
    arrays: TrackArrays,
) -> None:
    """Simulate H filters that combine tracks over the S slots of a plan, in B blocks of L runs: in
    each slot the own tracks predict and read, and each node combines its own with those it hears.

    Changes the tracks and their covariances ``joint`` in ``arrays``, writes the reported estimates
    into ``nodes.xhat`` (B, H, n, L) and ``nodes.root`` (B, H, n, n, L), and ``samples``.
    """
    # The own tracks as nodes of a Kalman filter; ``nodes`` are the reported estimates.
    tracks = SlotNodes(arrays.xhat, arrays.root, nodes.F, nodes.root_Q, nodes.rows)
    work = arrays.scratch.work
    # Slot by slot: the covariances of tracks are the same in all runs.
    for s in range(plan.up.shape[1]):
        if plan.sensed[s]:
            predict_joint(arrays.joint, nodes.F, arrays.Q, work)
            update_joint(
                arrays.joint, arrays.pairs, arrays.H, nodes.rows, arrays.closed, work
            )  # fmt: skip
            for b in range(plan.up.shape[0]):
                predict_all(tracks, scratch, b)
                read_all(tracks, readings, scratch, b, s)
                copy_tracks(nodes, tracks, scratch, b)
            # Runs in which a node hears the same nodes share the combination of this slot.
            for h in range(len(nodes.rows)):
                for k in range(len(arrays.cache.key)):
                    arrays.cache.key[k] = -1
                for b in range(plan.up.shape[0]):
                    for q in range(len(scratch.lanes)):
                        combine_received(nodes, plan, links, arrays, (b, s, h, q))
        for b in range(plan.up.shape[0]):
            store_sample_of_slot(nodes, plan, samples, scratch, b, s)
            rebase(nodes, readings, scratch, b, s)
            rebase(tracks, readings, scratch, b, s)


@kernel
def copy_tracks(nodes: SlotNodes, tracks: SlotNodes, scratch: SlotScratch, b: int) -> None:
    """Copy the own tracks of all H nodes of block ``b`` to ``nodes.xhat[b]`` (H, n, L) and
    ``nodes.root[b]`` (H, n, n, L), the estimates that they report.

    Axes: L runs side by side.
    """
    for h in range(len(nodes.rows)):
        for i in range(nodes.xhat.shape[2]):
            store(scratch.lanes, nodes.xhat, b, h, i, load(scratch.lanes, tracks.xhat, b, h, i))
            for j in range(i + 1):
                entry = load(scratch.lanes, tracks.root, b, h, i, j)
                store(scratch.lanes, nodes.root, b, h, i, j, entry)


@kernel
def combine_received(
    nodes: SlotNodes,
    plan: SlotPlan,
    links: SlotLinks,
    arrays: TrackArrays,
    index: tuple[int, int, int, int],
) -> None:
    """Replace the reported estimate of filter h of block b in lane q (one run) by the combination
    of its track with those that arrive in slot s, all of them in ``arrays``; ``index`` is [b, s, h,
    q]. Changes ``nodes.xhat[b, h, :, q]`` (n,) and ``nodes.root[b, h, :, :, q]`` (n, n).
    """
    b, s, h, q = index
    n, count, key = nodes.xhat.shape[2], 0, 0
    arrays.tracks[0] = h
    for m in range(links.first[h], links.first[h + 1]):
        if plan.up[b, s, 0, links.direction[m], q]:
            count += 1
            arrays.tracks[count] = links.sender[m]
            # The key of the combination has a bit for each incoming link on which a track arrives.
            key += 1 << min(m - links.first[h], MAX_DIRECTION_BITS)
    if count == 0:
        return
    k = combination_of(arrays, key, count, links.first[h + 1] - links.first[h])
    gain, root = arrays.cache.gain[k], arrays.cache.root[k]
    # Rank 0: all tracks are the same, and the own one stays to the last bit.
    if arrays.cache.rank[k] == 0:
        return
    # xhat = x_h + sum_a G_a (x_a - x_h): the gains are those of differences to the own track.
    for a in range(count):
        for j in range(n):
            difference = arrays.xhat[b, arrays.tracks[1 + a], j, q] - arrays.xhat[b, h, j, q]
            for i in range(n):
                nodes.xhat[b, h, i, q] += gain[i, a * n + j] * difference
    for i in range(n):
        for j in range(i + 1):
            nodes.root[b, h, i, j, q] = root[i, j]


@kernel
def combination_of(arrays: TrackArrays, key: int, count: int, degree: int) -> int:
    """Return the index in ``arrays.cache`` of the combination of the own track with ``count``
    others, the first ``count + 1`` indices in ``arrays.tracks``; compute it if the cache lacks it.
    ``key`` has a bit for each of the node's ``degree`` incoming links on which a track arrived.
    """
    cache = arrays.cache
    # A hash of the key; a combination with the same hash is overwritten.
    k = (key ^ (key >> 6) ^ (key >> 12)) % len(cache.key)
    # With more links than bits a key is not unique: always compute.
    if degree > MAX_DIRECTION_BITS or cache.key[k] != key:
        cache.key[k] = key
        for a in range(count + 1):
            for b in range(count + 1):
                pair = pair_of(arrays, arrays.tracks[a], arrays.tracks[b])
                copy_matrix(arrays.block[a, b], arrays.joint[pair])
        cache.rank[k] = combine_tracks(
            arrays.block, count, arrays.scratch, cache.gain[k], cache.root[k]
        )
    return k


@kernel
def pair_of(arrays: TrackArrays, i: int, j: int) -> int:
    """Return the index in ``arrays.pairs`` (K, 2) of the pair (i, j) of tracks, which is among
    them.

    Axes: K pairs of tracks.
    """
    # Bisection: pairs of track i are sorted by the second track.
    low, high = arrays.first[i], arrays.first[i + 1] - 1
    while low < high:
        middle = (low + high) // 2
        if arrays.pairs[middle, 1] < j:
            low = middle + 1
        else:
            high = middle
    return int(low)


@built_in("track-fusion", rule="cross-covariance")
@dataclass(frozen=True, eq=False)
class BarShalomCampo(Filter):
    """Every node runs a Kalman filter on its own readings, sends this track, and reports the best
    linear combination of it and the tracks heard in this slot, Bar-Shalom and Campo 1986.

    Messages carry the sender's sensors, from which the receiver computes the cross-covariances of
    the tracks: the common process noise and the common start correlate them. What is reported does
    not enter the tracks. Of more than two tracks it is the combination with the least covariance.
    """

    paper: ClassVar[str] = "track_fusion"
    combination: ClassVar[str] = "tracks"
    clocks: ClassVar[tuple[str, ...]] = ()
    one_way: ClassVar[bool] = True
    fixed_sensors: ClassVar[bool] = True
    every_reading: ClassVar[bool] = True
    common_start: ClassVar[bool] = True
    needs_network: ClassVar[bool] = True  # for the compiled slots alone
    slot_kernel = staticmethod(track_slots)
    unrolled: ClassVar[bool] = True

    def slot_arrays(
        self, states: Sequence[Any], infos: Sequence[NodeInfo], runs: int
    ) -> tuple[TrackArrays]:
        """Return the arrays of the compiled ``slot_kernel`` for ``runs`` runs of H nodes that start
        in these ``states`` and hear the nodes in ``infos``: the tracks with their covariances, and
        scratch. A tuple of one, since kernels take any number of such arguments.
        """
        H, n, start = len(states), len(states[0].xhat), states[0].start
        max_degree = max(info.degree for info in infos)
        xhat, root = (
            in_lanes(np.stack([getattr(state, name) for state in states]), blocks_of(runs))
            for name in ("xhat", "root")
        )
        # Scratch of the kernel for the combinations of one slot; key -1: a free entry.
        cache = CombinationCache(
            key=np.full(COMBINATIONS, -1),
            rank=np.zeros(COMBINATIONS, dtype=np.int64),
            gain=np.zeros((COMBINATIONS, n, max(max_degree, 1) * n)),
            root=np.zeros((COMBINATIONS, n, n)),
        )
        sensors, _ = stacked_sensors([state.sensors[0] for state in states])
        # Pairs (i, j) of tracks that some node may combine, ordered by i: those of i begin at
        # first[i]. All tracks start with one common error, whose covariance is ``start``.
        pairs = combined_pairs(infos)
        first = np.searchsorted(pairs[:, 0], np.arange(H + 1))
        return (
            TrackArrays(
                xhat=xhat,
                root=root,
                Q=np.array(states[0].model.Q),
                H=sensors,
                joint=np.tile(start, (len(pairs), 1, 1)),
                pairs=pairs,
                first=first,
                closed=np.zeros((H, n, n)),
                tracks=np.zeros(max_degree + 1, dtype=np.int64),
                block=np.zeros((max_degree + 1, max_degree + 1, n, n)),
                scratch=track_scratch(max_degree, n),
                cache=cache,
            ),
        )

    def carried_estimates(self, reported: FloatArray, arrays: tuple[Any, ...]) -> FloatArray:
        """Return the own tracks (B, H, n, L) in ``arrays``, from ``slot_arrays``, with which nodes
        go on, instead of the combinations that are ``reported`` (B, H, n, L): B blocks of L runs, H
        nodes. A trigger refers to them.
        """
        tracks: TrackArrays = arrays[0]
        return tracks.xhat

    def payload_numbers(self, n: int, rows: int, phase: int) -> int:
        """Return the size of a message in numbers of 64 bits: n, a track; sensors do not change and
        are not counted.
        """
        return n

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> TrackState:
        """Return the first state of a node, whose own track, with estimate ``mean`` (n,) and
        covariance ``cov`` (n, n), is also reported.
        """
        root, joint = first_root(cov), np.array(cov)[None, None]
        sensors = (whitened_sensors(model),)
        return TrackState(
            xhat=mean,
            root=root,
            model=model,
            fused=mean,
            fused_root=root,
            slot=0,
            senders=(-1,),
            sensors=sensors,
            joint=joint,
            start=joint[0, 0],
        )

    def predict(self, state: TrackState, gap: float) -> TrackState:
        """Return the state ``gap`` seconds, a slot, later: own track and joint covariance are
        predicted, and the own track is reported until tracks arrive.
        """
        xhat, root = state.model.predict(state.xhat, state.root, gap)
        joint = predicted_joint(state.joint, state.model)
        return state._replace(
            xhat=xhat, root=root, fused=xhat, fused_root=root, joint=joint, slot=state.slot + 1
        )

    def update(self, state: TrackState, reading: Reading) -> TrackState:
        """Return the state with the own track updated by the reading, and the covariances of all
        known tracks as if each had used a reading of its sensors.
        """
        tracked: TrackState = super().update(state, reading)
        joint = updated_joint(state.joint, state.sensors)
        return tracked._replace(joint=joint, fused=tracked.xhat, fused_root=tracked.root)

    def emit(self, state: TrackState, exchange: Exchange) -> tuple[TrackState, Track]:
        """Return the state, unchanged, and the payload: the own track with its sensors."""
        return state, Track(state.xhat, state.sensors[0])

    def absorb(
        self, state: TrackState, messages: Sequence[Message], exchange: Exchange
    ) -> TrackState:
        """Return the state that reports the best combination of the own track and those heard."""
        if not messages:
            return state
        state = add_senders(state, messages)
        tracks = [0, *(state.senders.index(message.sender) for message in messages)]
        differences = np.concatenate([message.payload.xhat - state.xhat for message in messages])
        gain, root = best_combination(state.joint, tracks, state.root)
        return state._replace(fused=state.xhat + gain @ differences, fused_root=root)

    def estimate(self, state: TrackState) -> tuple[FloatArray, FloatArray]:
        """Return the combination that is reported, (n,), and its covariance (n, n)."""
        return state.fused, state.P

    def shift(self, state: TrackState, offset: FloatArray) -> TrackState:
        """Return the state with ``offset`` (n,) added to the track and to the combination, for a
        move of the origin: tracks enter by their differences.
        """
        return state._replace(xhat=state.xhat + offset, fused=state.fused + offset)


def whitened_sensors(model: SlotModel) -> FloatArray:
    """Return the whitened H (p, n) of a node's sensors, ``L^-1 H`` with ``L L' = R``, whose noise
    has variance 1 in each row.
    """
    H: FloatArray = np.asarray(model.H, dtype=np.float64)
    return whiten_reading(np.zeros(len(H)), H, model.R)[1] if len(H) else H


def stacked_sensors(sensors: Sequence[FloatArray]) -> tuple[FloatArray, np.ndarray]:
    """Return the whitened ``sensors`` of m nodes, (p_i, n) each, as one array (m, p, n) with zeros
    below, and the number of rows (m,) of each, for kernels.
    """
    rows = np.array([len(H) for H in sensors])
    stack = np.zeros((len(sensors), max(int(rows.max()), 1), sensors[0].shape[1]))
    for k, H in enumerate(sensors):
        stack[k, : len(H)] = H
    return stack, rows


def combined_pairs(infos: Sequence[NodeInfo]) -> np.ndarray:
    """Return the pairs (K, 2) of indices of tracks that some of the N nodes in ``infos`` may
    combine, in lexical order: both orders of each pair, and each track with itself.

    Axes: K pairs of tracks.
    """
    network, N = infos[0].network, len(infos)
    assert network is not None
    tracks = [np.array([h, *heard]) for h, heard in enumerate(network.heard)]
    # The pair (i, j) as one number, i N + j, which sorts and removes duplicates quickly.
    codes = np.unique(np.concatenate([np.add.outer(N * one, one).reshape(-1) for one in tracks]))
    return np.ascontiguousarray(np.stack(np.divmod(codes, N), axis=1))


def predicted_joint(joint: FloatArray, model: SlotModel) -> FloatArray:
    """Return the covariances (m, m, n, n) of the errors of m tracks one slot later, from ``joint``
    of the same shape: all of them have the same process noise.
    """
    predicted, F, Q = (np.array(part, order="C") for part in (joint, model.F, model.Q))
    predict_joint(predicted.reshape(-1, *F.shape), F, Q, np.empty(F.shape))
    return predicted


def updated_joint(joint: FloatArray, sensors: Sequence[FloatArray]) -> FloatArray:
    """Return the covariances (m, m, n, n) of the errors of m tracks, from ``joint`` of the same
    shape, after each has used a reading of its own whitened ``sensors`` (p_i, n), ``P_ij+ = (I -
    K_i H_i) P_ij (I - K_j H_j)'``.
    """
    updated, (H, rows) = np.array(joint, order="C"), stacked_sensors(sensors)
    m, n = len(H), H.shape[2]
    pairs = np.ascontiguousarray(np.indices((m, m)).reshape(2, -1).T)
    work = np.empty((m, n, n)), np.empty((n, n))
    update_joint(updated.reshape(-1, n, n), pairs, H, rows, *work)
    return updated


def add_senders(state: TrackState, messages: Sequence[Message]) -> TrackState:
    """Return the state extended by the new senders of ``messages``: their ids, their sensors, and
    the joint covariance (m, m, n, n) of the errors of all m tracks that are known then.
    """
    new_messages = [message for message in messages if message.sender not in state.senders]
    if not new_messages:
        return state
    senders = (*state.senders, *(message.sender for message in new_messages))
    sensors = (*state.sensors, *(message.payload.H for message in new_messages))
    # The joint covariance does not depend on data: recompute it from slot 0 with the new tracks.
    joint = np.tile(state.start, (len(senders), len(senders), 1, 1))
    for _ in range(state.slot):
        joint = updated_joint(predicted_joint(joint, state.model), sensors)
    return state._replace(senders=senders, sensors=sensors, joint=joint)


def best_combination(
    joint: FloatArray, tracks: Sequence[int], own_root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the optimal gain (n, k n) of the differences of k tracks to the own one, and the lower
    triangular root (n, n) of the covariance of the combination: ``own_root`` (n, n) if all tracks
    are the same.

    ``joint`` (m, m, n, n) is the joint covariance of the errors of all tracks; ``tracks`` are the
    indices of the own one and of the k others.
    """
    # The kernel wants the covariances of these tracks alone, the own one first.
    n, k = joint.shape[2], len(tracks) - 1
    gain, root = np.zeros((n, k * n)), np.zeros((n, n))
    block = np.ascontiguousarray(joint[np.ix_(tracks, tracks)])
    rank = combine_tracks(block, k, track_scratch(k, n), gain, root)
    return gain, root if rank else own_root
