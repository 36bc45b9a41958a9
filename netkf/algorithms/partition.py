"""A filter of coupled blocks: each node estimates its own, and takes what its neighbours tell of
theirs for inputs with a covariance.

A block moves by ``x_a' = A_aa x_a + sum_b A_ab x_b + w_a``. Its owner knows estimates of all x_b,
and bounds P_b of the covariances of their errors, but not how these errors correlate. For any
weights that sum to one

    P_a' = sum_b (1 / weight_b) A_ab P_b A_ab' + Q_a

is a bound again, with b = a among them. The weights here are those with the least trace, in
proportion to the root of the trace of ``A_ab P_b A_ab'``: without coupling it is the prediction of
a Kalman filter.

Farina, Ferrari-Trecate and Scattolini, "Moving-horizon partition-based state estimation of
large-scale systems", Automatica 46(5), 2010; Khan and Moura, "Distributing the Kalman filter for
large-scale systems", IEEE Trans. Signal Processing 56(10), 2008.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo, PairReading, Reading
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs
from netkf.core.places import Key, Place
from netkf.linalg.arrays import FloatArray, symmetric

MARGIN = 1e-6
"""Weights of covariance intersection are at least this."""
ROUNDING = 2.0**-52
"""Spacing of floating-point numbers at 1: relative size of eigenvalues that are 0."""


class Start(NamedTuple):
    """What all nodes know before the first reading, predicted to the present: mean (n,) and
    covariance ``cov`` (n, n) of the whole state.
    """

    mean: FloatArray
    cov: FloatArray


class Gap(NamedTuple):
    """The time since a node last used something: the transition Phi (n, n), and Q (n, n)."""

    Phi: FloatArray
    Q: FloatArray


class PartitionState(NamedTuple):
    """What a node knows of the whole state, of n components.

    x : (n,) its estimate now
    bounds : (n, n) of its ``groups``, when it last used something: covariances of their errors are
             no larger. 0 between groups, where nothing is known
    gap : the time since then
    start : see Start
    groups : entries of what the node estimates, and then of all other blocks of each owner
    model : that of the whole state
    places : all blocks; ``blocks``: the names and owners of those that it estimates
    waits : messages may take time
    """

    x: FloatArray
    bounds: FloatArray
    gap: Gap
    start: Start
    groups: tuple[np.ndarray, ...]
    model: Any
    places: dict[Key, np.ndarray]
    blocks: tuple[Key, ...]
    waits: bool


class Told(NamedTuple):
    """What a node sends: its estimate (n',) of its ``blocks``, with the bound P (n', n'). Where a
    message may take time also all that is needed to predict them: what it knows of the ``whole``
    state, see PartitionState.
    """

    xhat: FloatArray
    P: FloatArray
    blocks: tuple[Key, ...]
    whole: tuple[FloatArray, FloatArray, tuple[np.ndarray, ...]] | None


@built_in("partition")
@dataclass(frozen=True, eq=False)
class Partition(Filter):
    """Each node estimates blocks of its own that others drive, see the module.

    Of a block that it does not estimate a node has what a neighbour told last, predicted by the
    plant, which all nodes know with its inputs and changes; while messages are lost the bound
    grows. Before it has heard of a block, and wherever the bound has become worse than that, it
    has what was known at the start, predicted. What two nodes both estimate, and a reading of one
    block of the node and one of another, is used by covariance intersection. P is never below the
    covariance of the error. Under clocks, where messages may take time, they also tell what the
    sender has of other blocks, by which the receiver predicts what it hears to the present.
    """

    needs = Needs(one_way=True, samples=True, blocks=True, coupled=True, linear_plant=True)
    analysis = Analysis(P_by_design=("larger", "larger"), affine=True)

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> PartitionState:
        """Return the state at time 0; mean and cov are of the whole state."""
        n = len(mean)
        places = {
            place.key: np.arange(n)[place.entries]
            for place in node.whole or (Place("plant", None, 0, n),)
        }
        blocks = tuple(place.key for place in node.blocks) or tuple(places)
        own = np.concatenate([places[block] for block in blocks])
        others: dict[Any, list[np.ndarray]] = {}
        for key, entries in places.items():
            if key not in blocks:
                others.setdefault(key if key[1] < 0 else key[1], []).append(entries)
        groups = (own, *(np.concatenate(parts) for parts in others.values()))
        P = np.array(cov, dtype=np.float64)
        bounds = np.zeros((n, n))
        for group in groups:
            bounds[np.ix_(group, group)] = P[np.ix_(group, group)]
        gap, start = Gap(np.eye(n), np.zeros((n, n))), Start(np.array(mean), P)
        waits = node.max_delay > 0.0
        return PartitionState(
            np.array(mean), bounds, gap, start, groups, model, places, blocks, waits
        )

    def predict(self, state: PartitionState, gap: float) -> PartitionState:
        """Return the state ``gap`` seconds later. Bounds follow from those at the last use in one
        step, so that they do not depend on how often somebody looks.
        """
        n, (before, noise), start = len(state.x), state.gap, state.start
        Phi = state.model.transition(np.zeros(n), gap)
        x, root = state.model.predict(state.x, np.zeros((n, n)), gap)
        mean, _ = state.model.predict(start.mean, root, gap)
        Q = root @ root.T
        return state._replace(
            x=x,
            gap=Gap(Phi @ before, symmetric(Phi @ noise @ Phi.T + Q)),
            start=Start(mean, symmetric(Phi @ start.cov @ Phi.T + Q)),
        )

    def _part(self, state: PartitionState, group: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """Return the estimate (k,) and bound (k, k) of a group now."""
        P = _bound_after(state.gap, state.bounds, state.groups, group)
        mean, cov = state.start
        known = cov[np.ix_(group, group)]
        return (state.x[group], P) if np.trace(P) <= np.trace(known) else (mean[group], known)

    def _present(self, state: PartitionState) -> tuple[FloatArray, FloatArray]:
        """Return estimate (n,) and bounds (n, n) of all groups now."""
        x, bounds = np.zeros_like(state.x), np.zeros_like(state.bounds)
        for group in state.groups:
            x[group], bounds[np.ix_(group, group)] = self._part(state, group)
        return x, bounds

    def _used(self, state: PartitionState, x: FloatArray, bounds: FloatArray) -> PartitionState:
        """Return the state that begins anew from an estimate (n,) and bounds (n, n)."""
        n = len(x)
        return state._replace(x=x, bounds=bounds, gap=Gap(np.eye(n), np.zeros((n, n))))

    def update(self, state: PartitionState, reading: Reading) -> PartitionState:
        """Return the state after readings of its own blocks, and of one of these and another."""
        if not len(reading.y) and not reading.pairs:
            return state
        x, bounds = self._present(state)
        own = state.groups[0]
        square = np.ix_(own, own)
        xhat, P = x[own], bounds[square]
        if len(reading.y):
            y, H, R = reading.y, reading.H, reading.R
            xhat, P = _used_as_is(xhat, P, y, H, R)
        for pair in reading.pairs:
            xhat, P = self._with_pair(xhat, P, pair, (state, x, bounds))
        x[own], bounds[square] = xhat, P
        return self._used(state, x, bounds)

    def _with_pair(
        self,
        xhat: FloatArray,
        P: FloatArray,
        pair: PairReading,
        known: tuple[PartitionState, FloatArray, FloatArray],
    ) -> tuple[FloatArray, FloatArray]:
        """Return estimate and bound after a reading of another block, of which all is ``known``."""
        state, x, bounds = known
        other = state.places[pair.other]
        z, H, H_other = pair.H(xhat, x[other])
        C = H_other @ bounds[np.ix_(other, other)] @ H_other.T
        return _intersected(xhat, P, z - H_other @ x[other], H, (C, pair.R))

    def emit(self, state: PartitionState, exchange: Exchange) -> tuple[PartitionState, Told]:
        """Return the estimate of its own blocks as a message."""
        whole = (*self._present(state), state.groups) if state.waits else None
        return state, Told(*self.estimate(state), state.blocks, whole)

    def absorb(
        self, state: PartitionState, messages: Sequence[Message], exchange: Exchange
    ) -> PartitionState:
        """Return the state after all messages of this instant, one after the other by sender."""
        if not messages:
            return state
        x, bounds = self._present(state)
        for message in messages:
            told = message.payload
            xhat, P = _predicted(state.model, told, message.age)
            entries = np.concatenate([state.places[block] for block in told.blocks])
            for group in state.groups:
                common, mine, theirs = np.intersect1d(group, entries, return_indices=True)
                if len(common):
                    square, H = np.ix_(group, group), np.eye(len(group))[mine]
                    z, C = xhat[theirs], P[np.ix_(theirs, theirs)]
                    fused = _intersected(x[group], bounds[square], z, H, (C, 0.0 * C))
                    x[group], bounds[square] = fused
        return self._used(state, x, bounds)

    def estimate(self, state: PartitionState) -> tuple[FloatArray, FloatArray]:
        """Return xhat (n',) and P (n', n') of the blocks that the node estimates."""
        return self._part(state, state.groups[0])

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state, or a message, with ``offset`` (n,) added to estimates."""
        if isinstance(state, Told):
            whole = state.whole and (state.whole[0] + offset, *state.whole[1:])
            return state._replace(xhat=state.xhat + offset, whole=whole)
        start = state.start._replace(mean=state.start.mean + offset)
        return state._replace(x=state.x + offset, start=start)


def _bound_of_sum(terms: Sequence[FloatArray]) -> FloatArray:
    """Return the bound (k, k) with the least trace of the covariance of a sum, of whose terms only
    the covariances (k, k) are known.
    """
    parts = [(float(np.sqrt(np.trace(term))), term) for term in terms if term.any()]
    total = sum(size for size, _ in parts)
    return np.asarray(sum((total / size * term for size, term in parts), np.zeros_like(terms[0])))


def _bound_after(
    gap: Gap, bounds: FloatArray, groups: Sequence[np.ndarray], group: np.ndarray
) -> FloatArray:
    """Return the bound (k, k) of a group after a gap, from ``bounds`` (n, n) of all groups."""
    terms = [
        M @ bounds[other[:, None], other] @ M.T
        for other in groups
        for M in [gap.Phi[group[:, None], other]]
    ]
    return symmetric(_bound_of_sum(terms) + gap.Q[np.ix_(group, group)])


def _predicted(model: Any, told: Told, age: float) -> tuple[FloatArray, FloatArray]:
    """Return what a message told, estimate (n',) and bound (n', n'), ``age`` seconds later."""
    if age <= 0.0 or told.whole is None:
        return told.xhat, told.P
    (x, bounds, groups), n = told.whole, len(told.whole[0])
    x, root = model.extrapolate(x, np.zeros((n, n)), age)
    gap = Gap(model.transition(np.zeros(n), age), root @ root.T)
    return x[groups[0]], _bound_after(gap, bounds, groups, groups[0])


def _used_as_is(
    x: FloatArray, P: FloatArray, z: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the Kalman update of x (k,) and P (k, k) with ``z = H x + v``, cov(v) = R."""
    # Singular where both are certain.
    K = P @ H.T @ np.linalg.pinv(H @ P @ H.T + R, hermitian=True)
    stays = np.eye(len(x)) - K @ H
    return x + K @ (z - H @ x), symmetric(stays @ P @ stays.T + K @ R @ K.T)


def _intersected(
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    H: FloatArray,
    covariances: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return x (k,) and P (k, k) after ``z = H x + e + v``, by the weight with the least trace;
    ``covariances`` (C, R) are those of e, which may correlate with the error of x, and of v, which
    does not.
    """
    C, R = covariances
    if not C.any():
        return _used_as_is(x, P, z, H, R)
    choices = [(x, P)]
    if len(z) == len(x) and not R.any():
        # All is heard: what was known may be forgotten.
        choices.append((H.T @ z, H.T @ C @ H))
        differences = np.linalg.eigvalsh(P - choices[1][1])
        if differences[0] >= 0.0 or differences[-1] <= 0.0:
            return choices[int(differences[-1] > 0.0)]
    w = _best_weight(P, H, C, R)
    choices.append(_used_as_is(x, P / w, z, H, C / (1.0 - w) + R))
    return min(choices, key=lambda choice: float(np.trace(choice[1])))


def _best_weight(P: FloatArray, H: FloatArray, C: FloatArray, R: FloatArray) -> float:
    """Return the weight w of P by which the trace, which is convex in w, becomes least."""
    sizes, vectors = np.linalg.eigh(H @ P @ H.T + C + R)
    # Of other directions nothing is known or learned; within these no sum below is singular.
    V = vectors[:, sizes > len(sizes) * ROUNDING * sizes[-1]]
    gain, size = V.T @ H @ P, float(np.trace(P))
    A, C, R = gain @ H.T @ V, V.T @ C @ V, V.T @ R @ V

    def slope(w: float) -> float:
        left = 1.0 - w
        X = np.linalg.solve(A + w / left * C + w * R, gain)
        # The derivative, times w, of the trace (size - sum(gain X)) / w.
        change = X * ((C / (left * left) + R) @ X)
        return float(change.sum() - (size - (gain * X).sum()) / w)

    least, largest = MARGIN, 1.0 - MARGIN
    if slope(least) >= 0.0:
        return least
    return largest if slope(largest) <= 0.0 else float(scipy.optimize.brentq(slope, least, largest))
