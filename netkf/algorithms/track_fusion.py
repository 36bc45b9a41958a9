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
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import copy_vector
from netkf.algorithms.kernels.pair_fusion import fuse_pair
from netkf.algorithms.kernels.run import (
    carry,
    copy_estimate,
    predict_estimate,
    shift_vector,
    update_estimate,
)
from netkf.algorithms.kernels.tracks import (
    combine_tracks,
    predict_joint,
    track_scratch,
    update_joint,
)
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.fields import field, one_of
from netkf.linalg.arrays import FloatArray, square_root
from netkf.linalg.compiling import kernel
from netkf.linalg.small import copy_matrix

TRACE, DETERMINANT = "trace", "determinant"
COMBINATIONS, MAX_DIRECTION_BITS = 32, 62
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


def pair_fusion_record(filtering: PairFusion, _infos: Any, models: Sequence[Any]) -> Record:
    """Return the rule, and scratch for one fusion at a time."""
    n = len(models[0].information)
    scratch = {"work": (2 * n + 2, n), "x": (n,), "S": (n, n), "other_x": (n,)}
    scratch |= {"other_S": (n, n)}
    return Record(
        payload={"xhat": (n,), "root": (n, n)},
        settings={
            "inverse": filtering.inverse,
            "trace": filtering.minimise == TRACE,
            **{name: np.zeros(shape) for name, shape in scratch.items()},
        },
    )


@dataclass(frozen=True, eq=False)
class PairFusion(Filter):
    """A node fuses its estimate with each one that it hears, one after the other in the order of
    the senders' ids, with the weight that minimises the trace of P or its determinant.

    minimise  "trace" or "determinant" of P after each fusion
    """

    minimise: str = field(one_of(TRACE, DETERMINANT), default=TRACE)

    analysis = Analysis(paper="track_fusion")
    needs = Needs(one_way=True, inverts=True)
    inverse: ClassVar[bool] = False
    kernels = Kernels(absorb=fuse_heard, record=pair_fusion_record)

    shift = Filter.shift  # affine: the gains of both estimates sum to I, and only P decides them


@built_in("track-fusion", rule="ci")
@dataclass(frozen=True, eq=False)
class OptimisedIntersection(PairFusion):
    """Covariance intersection with the best weight, ``P^-1 = w P_a^-1 + (1 - w) P_b^-1``, Julier
    and Uhlmann 1997: P is never below the covariance of the error, however tracks are correlated.
    """

    analysis = replace(
        PairFusion.analysis, source="Julier and Uhlmann 1997", P_by_design=("larger", "larger")
    )


@built_in("track-fusion", rule="ici")
@dataclass(frozen=True, eq=False)
class InverseIntersection(PairFusion):
    """Inverse covariance intersection, Noack et al. 2017: ``P^-1 = P_a^-1 + P_b^-1 - M^-1`` with
    ``M = w P_a + (1 - w) P_b``, never larger than what covariance intersection gives.

    P bounds the error of one fusion of tracks that share a part of their information and are
    independent besides. For a network that fuses over and over no bound is proved.
    """

    analysis = replace(PairFusion.analysis, source="Noack et al. 2017")
    inverse: ClassVar[bool] = True


@kernel
def report_track(record: Any, h: int, run: Any) -> None:
    """Report the own track of node ``h``."""
    x, root = record.track_x, record.track_root
    copy_estimate(run, record.xhat, record.root, h, x, root, h, True)


@kernel
def predict_track(record: Any, h: int, run: Any) -> None:
    """Predict the own track, which is reported until tracks arrive."""
    predict_estimate(run.model, run, record.track_x, record.track_root, h, h)
    report_track(record, h, run)


@kernel
def update_track(record: Any, h: int, run: Any) -> None:
    """Update the own track with the reading of node ``h``."""
    update_estimate(run.model, run, record.track_x, record.track_root, h, h)
    report_track(record, h, run)


@kernel
def emit_track(record: Any, h: int, m: int, run: Any) -> None:
    """Send the own track; all nodes know the sensors."""
    copy_vector(run.lanes, run.size, record.payload.xhat, m, record.track_x, h, True)


@kernel
def combine_heard(record: Any, h: int, run: Any) -> None:
    """Report the best combination of the own track with those that arrive, run by run."""
    n, x, payload = len(run.size), record.track_x, record.payload
    degree = run.first[h + 1] - run.first[h]
    for q in range(len(run.lanes)):
        count, key = 0, 0
        record.tracks[0] = record.own[h]
        for k in range(run.count):
            if run.arrived[k, q] == 1:
                count += 1
                w = run.link[k]
                record.tracks[count], record.messages[count] = record.heard[w], run.message[k]
                # A bit for each incoming link on which a track arrives.
                key += 1 << min(w - run.first[h], MAX_DIRECTION_BITS)
        if count == 0:
            continue
        k = combination_of(record, h, key, count, degree)
        # Rank 0: all tracks are the same, and the own one stays to the last bit.
        if record.rank[h, k] == 0:
            continue
        # xhat = x_h + sum_a G_a (x_a - x_h): the gains are those of differences to the own track.
        for a in range(count):
            for j in range(n):
                difference = payload.xhat[record.messages[1 + a], j, q] - x[h, j, q]
                for i in range(n):
                    record.xhat[h, i, q] += record.gain[h, k, i, a * n + j] * difference
        for i in range(n):
            for j in range(i + 1):
                record.root[h, i, j, q] = record.combined[h, k, i, j]


@kernel
def combination_of(record: Any, h: int, key: int, count: int, degree: int) -> int:
    """Return the index in the cache of node ``h`` of the combination of its track with ``count``
    others, the first ``count + 1`` of ``record.tracks``: all runs in which it hears the same nodes
    share one. ``key`` has a bit for each of its ``degree`` links on which a track arrived.
    """
    # A hash of the key; a combination with the same hash is overwritten.
    k = (key ^ (key >> 6) ^ (key >> 12)) % record.key.shape[1]
    # With more links than bits a key is not unique: always compute.
    if degree > MAX_DIRECTION_BITS or record.key[h, k] != key:
        record.key[h, k] = key
        for a in range(count + 1):
            for b in range(count + 1):
                pair = pair_of(record, record.tracks[a], record.tracks[b])
                copy_matrix(record.block[a, b], record.joint[pair])
        record.rank[h, k] = combine_tracks(
            record.block, count, record.scratch, record.gain[h, k], record.combined[h, k]
        )
    return int(k)


@kernel
def pair_of(record: Any, i: int, j: int) -> int:
    """Return the index in ``record.pairs`` (K, 2) of the pair (i, j), which is among them."""
    # Bisection: pairs of track i are sorted by the second track.
    low, high = record.pairs_of[i], record.pairs_of[i + 1] - 1
    while low < high:
        middle = (low + high) // 2
        if record.pairs[middle, 1] < j:
            low = middle + 1
        else:
            high = middle
    return int(low)


@kernel
def shift_tracks(record: Any, h: int, run: Any) -> None:
    """Move track and combination: tracks enter by their differences."""
    shift_vector(run, record.xhat, h)
    shift_vector(run, record.track_x, h)


def bar_shalom_campo_record(_: Any, infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
    """Return tracks of nodes and messages, the pairs of tracks that some node may combine, room
    for their covariances, which are the same in all runs, and for combinations.
    """
    network, n, H = infos[0].network, len(models[0].information), len(infos)
    assert network is not None
    places = [info.place for info in infos]
    others = {j for place in places for j in network.heard[place]}.difference(places)
    index = {place: k for k, place in enumerate([*places, *sorted(others)])}
    heard = [[index[j] for j in network.heard[place]] for place in places]
    pairs = combined_pairs(len(index), heard)
    degree = max(1, *map(len, heard))
    information = network.information[list(index)]
    return Record(
        node={"track_x": (n,), "track_root": (n, n), "start": (n, n)},
        payload={"xhat": (n,)},
        settings={
            "own": np.arange(H),
            "heard": np.array([j for some in heard for j in some] + [0]),
            "pairs": pairs,
            "pairs_of": np.searchsorted(pairs[:, 0], np.arange(len(index) + 1)),
            "joint": np.zeros((len(pairs), n, n)),
            # Number of the slot that they belong to.
            "joint_slot": np.full(1, -1),
            # Rows of unit noise with the information of the sensors.
            "sensors": np.ascontiguousarray(np.stack([square_root(one).T for one in information])),
            "rows": np.where(information.any(axis=(1, 2)), n, 0),
            "closed": np.zeros((len(index), n, n)),
            **{name: np.zeros(degree + 1, dtype=np.int64) for name in ("tracks", "messages")},
            "block": np.zeros((degree + 1, degree + 1, n, n)),
            "scratch": track_scratch(degree, n),
            # -1: a free entry.
            "key": np.full((H, COMBINATIONS), -1),
            "rank": np.zeros((H, COMBINATIONS), dtype=np.int64),
            "gain": np.zeros((H, COMBINATIONS, n, degree * n)),
            "combined": np.zeros((H, COMBINATIONS, n, n)),
        },
    )


def begin_bar_shalom_campo(_: Any, node: Mapping[str, np.ndarray], _info: Any, _model: Any) -> None:
    """Begin the track with the first estimate, and keep its covariance."""
    node["track_x"][:], node["track_root"][:] = node["xhat"], node["root"]
    node["start"][:] = node["root"] @ node["root"].T


def prepare_bar_shalom_campo(
    _: Any, record: Any, _infos: Sequence[NodeInfo], models: Sequence[Any], first: int, _count: int
) -> None:
    """Compute the covariances of tracks in slot ``first``."""
    joint, slot = record.joint, record.joint_slot
    if slot[0] == first:
        return
    # All tracks start with one common error.
    if slot[0] < 0 or slot[0] > first:
        joint[:], slot[0] = record.start[0, ..., 0], 0
    F, Q = (np.array(part, order="C") for part in (models[0].F, models[0].Q))
    work = np.empty(F.shape)
    while slot[0] < first:
        predict_joint(joint, F, Q, work)
        update_joint(joint, record.pairs, record.sensors, record.rows, record.closed, work)
        slot[0] += 1
    record.key[:] = -1


@built_in("track-fusion", rule="cross-covariance")
@dataclass(frozen=True, eq=False)
class BarShalomCampo(Filter):
    """Every node runs a Kalman filter on its own readings, sends this track, and reports the best
    linear combination of it and the tracks heard in this slot, Bar-Shalom and Campo 1986.

    Messages carry the sender's sensors, from which the receiver computes the cross-covariances of
    the tracks: the common process noise and the common start correlate them. What is reported does
    not enter the tracks. Of more than two tracks it is the combination with the least covariance.
    """

    analysis = Analysis(
        paper="track_fusion",
        source="Bar-Shalom and Campo 1986",
        P_by_design=("equal", ""),
        payload_numbers=lambda n, *_: n,
    )
    timing = Timing(clocks=())
    needs = Needs(
        one_way=True, fixed_sensors=True, linear_plant=True, every_reading=True, awake=True,
        common_start=True, memory="whose cross-covariances are those of tracks that began together",
        network=True,
    )  # fmt: skip
    kernels = Kernels(
        predict=predict_track, update=update_track, emit=emit_track, absorb=combine_heard,
        shift=shift_tracks, slotwise=True, record=bar_shalom_campo_record,
        begin=begin_bar_shalom_campo, prepare=prepare_bar_shalom_campo,
    )  # fmt: skip

    shift = Filter.shift  # affine: tracks enter by their differences


def combined_pairs(count: int, heard: Sequence[Sequence[int]]) -> np.ndarray:
    """Return the pairs (K, 2) of indices of ``count`` tracks that some node may combine, in lexical
    order: both orders of each pair, and each track with itself; node h hears ``heard[h]``.
    """
    groups = [np.array([h, *others]) for h, others in enumerate(heard)]
    groups += [np.array([k]) for k in range(count)]
    # The pair (i, j) as one number, which sorts and removes duplicates quickly.
    codes = [np.add.outer(count * one, one).reshape(-1) for one in groups]
    pairs = np.divmod(np.unique(np.concatenate(codes)), count)
    return np.ascontiguousarray(np.stack(pairs, axis=1))


def best_combination(
    joint: FloatArray, tracks: Sequence[int], own_root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the optimal gain (n, k n) of the differences of k tracks to the own one, and the lower
    triangular root (n, n) of its covariance: ``own_root`` (n, n) if all tracks are the same.

    ``joint`` (m, m, n, n) is the joint covariance of the errors of all tracks; ``tracks`` are the
    indices of the own one and of the k others.
    """
    # The kernel wants the covariances of these tracks alone, the own one first.
    n, k = joint.shape[2], len(tracks) - 1
    gain, root = np.zeros((n, k * n)), np.zeros((n, n))
    block = np.ascontiguousarray(joint[np.ix_(tracks, tracks)])
    rank = combine_tracks(block, k, track_scratch(k, n), gain, root)
    return gain, root if rank else own_root
