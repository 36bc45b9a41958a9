"""A filter of blocks: nodes that estimate different parts of the state tell each other their
estimates, and what they read of each other.

A message has the sender's estimate, which blocks it is about, and the sender's readings of this
instant that also depend on a block of the receiver. Such a reading, ``z = H_i x_i + H_j x_j + v``,
is for receiver i an observation of x_i with the noise ``H_j (x_j - xhat_j) + v``. Blocks that both
estimate are observed by the sender's estimate of them. How errors of both correlate is not known:
``rule`` says what is assumed.

Li and Nashashibi, "Cooperative multi-vehicle localization using split covariance intersection
filter", IEEE ITS Magazine 5(2), 2013; Julier and Uhlmann, "A non-divergent estimation algorithm in
the presence of unknown correlations", ACC 1997.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, PairReading, Reading
from netkf.algorithms.models import first_root
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.fields import field, one_of
from netkf.core.places import Place
from netkf.linalg.arrays import FloatArray, symmetric

NAIVE, CI, SPLIT = "naive", "ci", "split"
MARGIN = 1e-6
"""Weights of covariance intersection are in [MARGIN, 1 - MARGIN]."""


class BlockState(NamedTuple):
    """Estimate ``xhat`` (n,) of the ``blocks``, its covariance P (n, n), the part ``dependent``
    (n, n) of P that may correlate with errors of other nodes, the ``model``, whether the node is
    ``alone`` in estimating its blocks, and the readings ``pairs`` of this instant.
    """

    xhat: FloatArray
    P: FloatArray
    dependent: FloatArray
    model: Any
    blocks: tuple[Place, ...]
    alone: bool
    pairs: tuple[PairReading, ...] = ()


class BlockEstimate(NamedTuple):
    """What a node sends: its estimate, see BlockState, and its readings of pairs."""

    xhat: FloatArray
    P: FloatArray
    dependent: FloatArray
    blocks: tuple[Place, ...]
    pairs: tuple[PairReading, ...]


class Observation(NamedTuple):
    """``z = H x + e + f + v``: z (p,), H (p, n), the covariance ``dependent`` (p, p) of e, which
    may correlate with the node's error in any way, and those of f and v, which do not: ``told``
    (p, p) of the sender's error f, which the sender goes on having, and ``noise`` (p, p) of v,
    which nobody else has.
    """

    z: FloatArray
    H: FloatArray
    dependent: FloatArray
    told: FloatArray
    noise: FloatArray


@built_in("block-intersection")
@dataclass(frozen=True, eq=False)
class BlockIntersection(Filter):
    """Each node estimates blocks of its own with its readings, with what others read of it, and
    with what they know of blocks that both estimate.

    rule  what is assumed of errors of different nodes: "split" (default), that those parts are
          independent of all others which a node has told nobody (split covariance intersection,
          Li and Nashashibi 2013); "ci", nothing (covariance intersection); "naive", that they are
          all independent, which is wrong and makes P too small

    With "split" and "ci" P is at least the covariance of the error. The weight is that with the
    least trace of P. A message that took time is used for nothing: its readings are of another
    instant.
    """

    rule: str = field(one_of(SPLIT, CI, NAIVE), default=SPLIT)

    timing = Timing(clocks=("directions", "nodes", "readings"))
    needs = Needs(one_way=True, samples=True, blocks=True)

    @property
    def analysis(self) -> Analysis:
        """That P is no smaller than the covariance of the error, unless the rule is naive."""
        design = ("", "") if self.rule == NAIVE else ("larger", "larger")
        return Analysis(P_by_design=design, affine=True)

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> BlockState:
        """Return the state at time 0. Errors are independent then, but for ``rule`` "ci"."""
        places = node.blocks or (Place("plant", None, 0, len(mean)),)
        P, alone = np.array(cov, dtype=np.float64), node.alone
        dependent = self._dependent(P, P if alone else np.zeros_like(P))
        return BlockState(np.array(mean), P, dependent, model, places, alone)

    def _dependent(self, P: FloatArray, independent: FloatArray) -> FloatArray:
        """Return the dependent part (n, n) of an error with covariance P (n, n), of which a part is
        ``independent`` (n, n).
        """
        if self.rule == NAIVE:
            return np.zeros_like(P)
        return P.copy() if self.rule == CI else symmetric(P - independent)

    def predict(self, state: BlockState, gap: float) -> BlockState:
        """Return the state ``gap`` seconds later. The plant's noise is independent of others, if
        nobody else estimates the same blocks.
        """
        Phi = state.model.transition(state.xhat, gap)
        xhat, root = state.model.predict(state.xhat, first_root(state.P), gap)
        P = symmetric(root @ root.T)
        independent = P - Phi @ state.dependent @ Phi.T
        if not state.alone:
            independent = Phi @ (state.P - state.dependent) @ Phi.T
        dependent = self._dependent(P, independent)
        return state._replace(xhat=xhat, P=P, dependent=dependent, pairs=())

    def update(self, state: BlockState, reading: Reading) -> BlockState:
        """Return the state after the readings of its own states; those of pairs are kept for the
        messages of this instant.
        """
        state = state._replace(pairs=reading.pairs)
        if not len(reading.y):
            return state
        none = np.zeros_like(reading.R)
        return self._fused(state, Observation(reading.y, reading.H, none, none, reading.R))

    def emit(self, state: BlockState, exchange: Exchange) -> tuple[BlockState, BlockEstimate]:
        """Return the estimate as a message. What a node has told may be in errors of others from
        now on.
        """
        payload = BlockEstimate(state.xhat, state.P, state.dependent, state.blocks, state.pairs)
        dependent = self._dependent(state.P, np.zeros_like(state.P))
        return state._replace(dependent=dependent), payload

    def absorb(
        self, state: BlockState, messages: Sequence[Message], exchange: Exchange
    ) -> BlockState:
        """Return the state after all messages of this instant, one after the other by sender."""
        for message in messages:
            if message.age > 0.0:
                continue
            for observation in self._observations(state, message.payload):
                state = self._fused(state, observation)
        return state

    def _observations(self, state: BlockState, told: BlockEstimate) -> Iterator[Observation]:
        """Yield what a message says of the node's states."""
        own = {(place.name, place.node): place for place in state.blocks}
        known = {(place.name, place.node): place for place in told.blocks}
        common = [key for key in own if key in known]
        if common:
            mine, theirs = (
                np.concatenate([np.arange(p.first, p.first + p.n) for p in places])
                for places in ([own[key] for key in common], [known[key] for key in common])
            )
            chosen, H = np.ix_(theirs, theirs), np.eye(len(state.xhat))[mine]
            yield self._told(told.xhat[theirs], H, told.P[chosen], told.dependent[chosen])
        for pair in told.pairs:
            name, owner = pair.other
            place = own.get((name, owner if owner >= 0 else None))
            # A block that the sender estimates too has been told.
            if place is None or (place.name, place.node) in known:
                continue
            entries = slice(place.first, place.first + place.n)
            z, H_theirs, H_mine = pair.H(told.xhat, state.xhat[entries])
            H = np.zeros((len(z), len(state.xhat)))
            H[:, entries] = H_mine
            P, dependent = (H_theirs @ C @ H_theirs.T for C in (told.P, told.dependent))
            seen = self._told(z - H_theirs @ told.xhat, H, P, dependent)
            yield seen._replace(noise=pair.R)

    def _told(
        self, z: FloatArray, H: FloatArray, P: FloatArray, dependent: FloatArray
    ) -> Observation:
        """Return an observation whose error is the sender's, with covariance P (p, p)."""
        return Observation(z, H, dependent, P - dependent, np.zeros_like(P))

    def _fused(self, state: BlockState, seen: Observation) -> BlockState:
        """Return the state after an observation: a Kalman update with both dependent parts
        enlarged, by 1 / w and 1 / (1 - w) (Li and Nashashibi 2013).
        """
        own, noise = state.P - state.dependent, seen.told + seen.noise

        def weighted(w: float, v: float) -> tuple[FloatArray, FloatArray, FloatArray]:
            P, C = state.dependent / w + own, seen.dependent / v + noise
            S = seen.H @ P @ seen.H.T + C
            # Singular where both know something for certain.
            K = P @ seen.H.T @ np.linalg.pinv(S, hermitian=True)
            return P, C, np.asarray(K)

        def trace_after(w: float) -> float:
            P, _, K = weighted(w, 1.0 - w)
            return float(np.trace(P - K @ seen.H @ P))

        P, C, K = weighted(1.0, 1.0)
        # Where one has no dependent part there is nothing to weigh.
        if seen.dependent.any() and state.dependent.any():
            bounds = (MARGIN, 1.0 - MARGIN)
            found = minimize_scalar(trace_after, bounds=bounds, options={"xatol": 1e-10})
            w = min((found.x, *bounds), key=trace_after)
            # The limit of w = 1: what was heard is not used.
            if trace_after(w) >= float(np.trace(state.P)):
                return state
            P, C, K = weighted(w, 1.0 - w)
        stays = np.eye(len(P)) - K @ seen.H
        after = symmetric(stays @ P @ stays.T + K @ C @ K.T)
        independent = stays @ own @ stays.T + K @ seen.noise @ K.T
        return state._replace(
            xhat=state.xhat + K @ (seen.z - seen.H @ state.xhat),
            P=after,
            dependent=self._dependent(after, independent),
        )

    def estimate(self, state: BlockState) -> tuple[FloatArray, FloatArray]:
        """Return xhat (n,) and P (n, n)."""
        return state.xhat, state.P

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state, or a message, with ``offset`` (n,) added to the estimate."""
        return state._replace(xhat=state.xhat + offset)
