"""The exact covariance of all errors of one run, given when its messages arrived.

Given the events, covariances P_i and gains are deterministic and the errors e_i = x - xhat_i are
linear in the noises, so their joint covariance Sigma follows without any simulation. Over a gap,
with ``[X; Y](s) = exp(M_i s) [I; P_i]``, the symplectic structure gives ``Phi_i(g, s) =
X(g)^-T X(s)^T`` and ``Phi_i(g, s) L_i(s) = X(g)^-T Y(s)^T H_i' R_i^-1``: both are entire functions
of s, which eight Gauss-Legendre nodes integrate to machine precision while |M_i| g <= 1. A message
on its way is one more error, that of a filter without readings.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.linalg

from netkf.algorithms.baselines import Local
from netkf.algorithms.covariance_intersection import CovarianceIntersection
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.models import FlowModel
from netkf.algorithms.push_sum import PushSum
from netkf.algorithms.riccati import hamiltonians
from netkf.core.arrays import FloatArray, symmetric
from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.theory.coupled import own_steps
from netkf.theory.push_sum_errors import stacked_push_sum_errors
from netkf.theory.slot_errors import stacked_slot_errors
from netkf.trace.run import Run
from netkf.trace.schema import CODES

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


def error_covariance(scenario: Scenario, run: Run, stacked: bool = False) -> FloatArray:
    """(T, N, n, n): covariance of x - xhat_i at ``run.times``, given the run's events and its
    regressors.

    With ``stacked``, (T, N n, N n): the errors of all nodes together. H (10) says that each block
    stays below P_i, which this shows without Monte Carlo. With delays, losses and models that
    differ from the truth; where states or readings are recorded, as if they had the law that the
    scenario gives them. Raises TheoryError for a user's subclass that does more than choose its
    weights, and for the push-sum filter with frozen or asymptotic gains.
    """
    whole, _ = _replayed(scenario, run)
    return whole if stacked else diagonal_blocks(whole, len(scenario.nodes))


def diagonal_blocks(stacked: FloatArray, nodes: int) -> FloatArray:
    """(T, N, n, n) of (T, N n, N n)."""
    n = stacked.shape[-1] // nodes
    blocks = stacked.reshape(len(stacked), nodes, n, nodes, n)
    return np.ascontiguousarray(np.einsum("tiaib->tiab", blocks))


def replayed_covariances(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    """(T, N, n, n): P_i as the filter's equations make it of the run's events, computed here and
    not by the engine; (T, N n, N n): the covariance of all x - xhat_i together, as
    :func:`error_covariance`.
    """
    whole, P = _replayed(scenario, run)
    return P, whole


def _replayed(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    """(T, N n, N n) and (T, N, n, n)."""
    if not isinstance(run, Run):
        raise TheoryError(
            f"run must be a netkf.Run, as netkf.simulate returns it, got a {type(run).__name__}"
        )
    if run.nodes != scenario.nodes or run.x.shape[1] != scenario.plant.n:
        raise TheoryError("the run is of another scenario: its nodes or its state differ")
    flow = not scenario.slotted
    if isinstance(scenario.filter.algorithm, PushSum):
        own_kind(scenario.filter.algorithm, PushSum)
        whole, P = stacked_push_sum_errors(scenario, run)
    else:
        whole, P = _stacked_errors(scenario, run) if flow else stacked_slot_errors(scenario, run)
    nodes, n = len(scenario.nodes), scenario.plant.n
    if whole.shape[-1] < nodes * n:
        whole, P = np.tile(whole, (1, nodes, nodes)), np.tile(P, (1, nodes, 1, 1))
    return whole, P


def own_kind(algorithm: object, known: type) -> None:
    """Raise TheoryError where a user's subclass defines steps itself."""
    own = own_steps(algorithm, known)
    if own:
        words = f"{type(algorithm).__name__} defines {own[0]} itself"
        raise TheoryError(f"the exact error covariance is not known: {words}")


def _stacked_errors(scenario: Scenario, run: Run) -> tuple[FloatArray, FloatArray]:
    algorithm, n = scenario.filter.algorithm, scenario.plant.n
    if algorithm.talks and not isinstance(algorithm, Hybrid):
        raise TheoryError(f"no exact error covariance for {type(algorithm).__name__}")
    intersects = isinstance(algorithm, CovarianceIntersection)
    known = CovarianceIntersection if intersects else Hybrid if algorithm.talks else Local
    own_kind(algorithm, known)
    errors = _Errors(scenario)
    hosts = errors.hosts
    whole = np.empty((len(run.times), hosts * n, hosts * n))
    P = np.empty((len(run.times), hosts, n, n))
    moments = iter(_instants(scenario, run))
    following = next(moments, None)
    for k, time in enumerate(run.times.tolist()):
        while following is not None and following.time <= time:
            errors.happen(following)
            following = next(moments, None)
        errors.advance(time)
        whole[k], P[k] = errors.of_hosts(), errors.covariances()
    return whole, P


class _Instant(NamedTuple):
    """What happens at one time: snapshots to keep, as (sender, key), and for each receiver the
    senders' weights with the key of the snapshot, None where the message took no time.
    """

    time: float
    snapshots: list[tuple[int, tuple[int, int, int]]]
    resets: dict[int, dict[int, tuple[float, tuple[int, int, int] | None]]]
    arrived: list[tuple[int, int, int]]


def _instants(scenario: Scenario, run: Run) -> Iterator[_Instant]:
    index = scenario.topology.index
    log = run.log[np.isin(run.log["kind"], [CODES["send"], CODES["deliver"]])]
    delivered = log[log["kind"] == CODES["deliver"]]
    late = {
        (int(r["peer"]), int(r["node"]), int(r["message"])) for r in delivered[delivered["age"] > 0]
    }
    edges = np.flatnonzero(np.diff(log["t"])) + 1
    for rows in np.split(log, edges):
        if not len(rows):
            continue
        snapshots: list[tuple[int, tuple[int, int, int]]] = []
        resets: dict[int, dict[int, tuple[float, tuple[int, int, int] | None]]] = {}
        ages: dict[tuple[int, int], float] = {}
        arrived: list[tuple[int, int, int]] = []
        for row in rows:
            node, peer, message = int(row["node"]), int(row["peer"]), int(row["message"])
            if row["kind"] == CODES["send"]:
                if (node, peer, message) in late:
                    snapshots.append((index[node], (node, peer, message)))
                continue
            key, age = (peer, node, message), float(row["age"])
            if key in late:
                arrived.append(key)
            if age <= ages.get((node, peer), np.inf):
                ages[node, peer] = age
                weight = scenario.weight(node, peer)
                inbox = resets.setdefault(index[node], {})
                inbox[index[peer]] = (weight, key if key in late else None)
        yield _Instant(float(rows["t"][0]), snapshots, resets, arrived)


class _Errors:
    """Stacked errors with their covariance, moved through time. Block 0 is the state itself where
    the filters' A differs from the plant's, since the errors then follow it.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._n, self._plant = scenario.plant.n, scenario.truth
        self._intersects = isinstance(scenario.filter.algorithm, CovarianceIntersection)
        pooled = scenario.filter.algorithm.pooled
        self._models = [scenario.pooled_model] if pooled else list(scenario.models)
        first = scenario.models[0]
        empty = np.zeros((0, self._n))
        self._blind = FlowModel(
            first.A, first.Q, empty, np.zeros((0, 0)), first.horizon, first.interval
        )
        self.hosts = len(self._models)
        starts = [scenario.start(node)[1] for node in scenario.nodes][: self.hosts]
        self._P = np.stack(starts)
        self._difference = self._plant.A - first.A
        self._follows = bool(self._difference.any())
        self._noise = [self._true_noise(scenario, k, pooled) for k in range(self.hosts)]
        blocks = self.hosts + self._follows
        self._sigma: FloatArray = np.tile(self._plant.start_cov, (blocks, blocks))
        self._time = 0.0
        self._messages: list[tuple[int, int, int]] = []

    def _true_noise(self, scenario: Scenario, host: int, pooled: bool) -> FloatArray:
        """(n, p): ``H' R^-1 root(R true)``, so that L dv is P times this times white noise."""
        nodes = scenario.sensing if pooled else (scenario.nodes[host],)
        roots = [np.linalg.cholesky(scenario.observation(node)[1]) for node in nodes]
        parts = [
            np.linalg.solve(
                scenario.observation(node, believed=True)[1], scenario.observation(node)[0]
            ).T
            @ root
            for node, root in zip(nodes, roots, strict=True)
        ]
        return np.concatenate([np.zeros((self._n, 0)), *parts], axis=1)

    def of_hosts(self) -> FloatArray:
        """The covariance of the errors of the nodes."""
        first = self._n * self._follows
        last = first + self.hosts * self._n
        return np.asarray(self._sigma[first:last, first:last])

    def covariances(self) -> FloatArray:
        """P of the nodes."""
        return self._P[: self.hosts]

    def happen(self, instant: _Instant) -> None:
        """Advance to an instant, keep what is sent, reset what receives."""
        self.advance(instant.time)
        first, n = int(self._follows), self._n
        for sender, key in instant.snapshots:
            rows = slice((first + sender) * n, (first + sender + 1) * n)
            pick = np.zeros((n, len(self._sigma)))
            pick[:, rows] = np.eye(n)
            self._mix(np.concatenate([np.eye(len(self._sigma)), pick]))
            self._messages.append(key)
            self._P = np.concatenate([self._P, self._P[sender : sender + 1]])
        if instant.resets:
            weights = np.eye(len(self._P))
            for node, inbox in instant.resets.items():
                for sender, (weight, sent) in inbox.items():
                    place = sender if sent is None else self.hosts + self._messages.index(sent)
                    weights[node, place] += weight
                    weights[node, node] -= weight
            whole = np.eye(len(self._sigma))
            whole[first * n :, first * n :] = self._mixing(weights)
            self._mix(whole)
        self._drop(instant.arrived)

    def _mixing(self, weights: FloatArray) -> FloatArray:
        """What a reset makes of the errors, from the weights (B, B); P is reset too."""
        n = self._n
        if not self._intersects:
            self._P = np.tensordot(weights, self._P, 1)
            return np.asarray(np.kron(weights, np.eye(n)), dtype=np.float64)
        shares = weights[:, :, None, None] * np.linalg.inv(self._P)
        self._P = np.linalg.inv(shares.sum(axis=1))
        return np.asarray((self._P[:, None] @ shares).swapaxes(1, 2).reshape(len(weights) * n, -1))

    def _mix(self, matrix: FloatArray) -> None:
        self._sigma = matrix @ self._sigma @ matrix.T

    def _drop(self, keys: list[tuple[int, int, int]]) -> None:
        places = [self.hosts + self._messages.index(key) for key in keys]
        if not places:
            return
        kept = np.setdiff1d(np.arange(len(self._P)), places)
        self._P = self._P[kept]
        self._messages = [key for key in self._messages if key not in keys]
        blocks = np.concatenate([np.arange(self._follows), kept + self._follows])
        entries = (blocks[:, None] * self._n + np.arange(self._n)).reshape(-1)
        self._sigma = self._sigma[np.ix_(entries, entries)]

    def advance(self, time: float) -> None:
        """Move all errors to ``time``."""
        gap = time - self._time
        if gap <= 0.0:
            return
        models = {id(m): m for m in (*self._models, self._blind)}.values()
        unit = min(model.riccati.unit for model in models)
        if self._follows:
            unit = min(unit, 1.0 / max(float(np.abs(self._plant.A).sum(axis=0).max()), 1e-300))
        steps = int(np.ceil(gap / unit))
        for _ in range(steps):
            self._step(gap / steps)
        self._time = time

    def _groups(self) -> list[tuple[FlowModel, list[int]]]:
        groups: dict[int, tuple[FlowModel, list[int]]] = {}
        everyone = [*self._models, *[self._blind] * len(self._messages)]
        for k, model in enumerate(everyone):
            groups.setdefault(id(model), (model, []))[1].append(k)
        return list(groups.values())

    def _step(self, gap: float) -> None:
        n, count, first = self._n, len(self._P), int(self._follows)
        times, weights = _NODES * gap, _WEIGHTS * gap
        m = self._plant.B.shape[1]
        transition = np.zeros((count, n, n))
        driven = np.zeros((first + count, n, len(times) * m))
        follow = np.zeros((count, n, n))
        own = np.zeros((count, n, n))
        states = [_expm(self._plant.A, s) for s in (*times, gap)] if first else []
        for model, members in self._groups():
            P = self._P[members]
            X, Y = _flows(model, P, np.append(times, gap))
            X_end, Y_end = np.swapaxes(X[-1], 1, 2), np.swapaxes(Y[-1], 1, 2)
            self._P[members] = symmetric(np.swapaxes(np.linalg.solve(X_end, Y_end), 1, 2))
            inverse = np.linalg.inv(X_end)
            transition[members] = inverse
            phi = inverse @ np.swapaxes(X[:-1], 2, 3)
            response = phi @ self._plant.B
            if first:
                for k, (s, w) in enumerate(zip(times, weights, strict=True)):
                    follow[members] += w * phi[k] @ self._difference @ states[k]
                    response[k] += self._followed(model, P, inverse, s, gap)
            response *= np.sqrt(weights)[:, None, None, None]
            rows = response.transpose(1, 2, 0, 3).reshape(len(members), n, -1)
            driven[np.array(members) + first] = rows
            for place, i in enumerate(members):
                if i < self.hosts and self._noise[i].shape[1]:
                    gain = inverse[place] @ np.swapaxes(Y[:-1, place], 1, 2) @ self._noise[i]
                    own[i] += np.einsum("s,sap,sbp->ab", weights, gain, gain)
        if first:
            for k, (s, w) in enumerate(zip(times, weights, strict=True)):
                driven[0, :, k * m : (k + 1) * m] = (
                    np.sqrt(w) * _expm(self._plant.A, gap - s) @ self._plant.B
                )
        self._move(transition, follow, states[-1] if first else None, driven, own)

    def _followed(
        self, model: FlowModel, P: FloatArray, inverse: FloatArray, s: float, gap: float
    ) -> FloatArray:
        """What noise at time s adds to the errors through the state that they follow."""
        total = np.zeros((len(P), self._n, self._plant.B.shape[1]))
        places = s + _NODES * (gap - s)
        X, _ = _flows(model, P, places)
        for r, w, phi in zip(places, _WEIGHTS, inverse @ np.swapaxes(X, 2, 3), strict=True):
            total += (
                w * (gap - s) * phi @ self._difference @ _expm(self._plant.A, r - s) @ self._plant.B
            )
        return total

    def _move(
        self,
        transition: FloatArray,
        follow: FloatArray,
        state: FloatArray | None,
        driven: FloatArray,
        own: FloatArray,
    ) -> None:
        n, first = self._n, int(self._follows)
        blocks = len(driven)
        sigma = self._sigma.reshape(blocks, n, blocks * n)
        moved = np.empty_like(sigma)
        moved[first:] = transition @ sigma[first:]
        if state is not None:
            moved[first:] += follow @ sigma[0]
            moved[0] = state @ sigma[0]
        half = moved.reshape(blocks * n, blocks * n).T.reshape(blocks, n, blocks * n)
        both = np.empty_like(half)
        both[first:] = transition @ half[first:]
        if state is not None:
            both[first:] += follow @ half[0]
            both[0] = state @ half[0]
        noise = driven.reshape(blocks * n, -1)
        result = both.reshape(blocks * n, blocks * n) + noise @ noise.T
        for i, block in enumerate(own):
            rows = slice((first + i) * n, (first + i + 1) * n)
            result[rows, rows] += block
        self._sigma = symmetric(result)


def _flows(model: FlowModel, P: FloatArray, gaps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X and Y (g, k, n, n) of a stack of covariances (k, n, n) over each gap (g,)."""
    n = len(model.A)
    E = hamiltonians(model.riccati, gaps)[:, None]
    return E[..., :n, :n] + E[..., :n, n:] @ P, E[..., n:, :n] + E[..., n:, n:] @ P


def _expm(A: FloatArray, gap: float) -> FloatArray:
    return np.asarray(scipy.linalg.expm(A * gap))
