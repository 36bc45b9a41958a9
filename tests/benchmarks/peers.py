"""The same jobs with other people's tools: filterpy and Stone Soup objects in a heapq loop, scipy's
solve_ivp on the stacked bound (12), a plain numpy loop for the random Riccati equation.

Part of ``python -m tests.benchmarks.compiled``; tests/benchmarks/test_peers.py holds the results of
each pair against each other.
"""

import datetime
import heapq
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.integrate
import scipy.linalg
import scipy.sparse.linalg

import netkf
from netkf.theory.hybrid.coupled import coupled
from netkf.theory.hybrid.packed import Packed
from tests.benchmarks.engine import RING

EPOCH = datetime.datetime(2000, 1, 1)


class Tick(NamedTuple):
    t: float
    link: tuple[int, int]
    delivered: bool


def planar(nodes=1000, rate=2.0):
    """Two independent axes of poisson_ring's plant (n = 4) on a random graph of degree 8; as there
    every third node has a sensor, of both positions.
    """
    A, B = (np.kron(np.eye(2), M).tolist() for M in ([[0.0, 1.0], [-1.0, 0.1]], [[0.0], [1.0]]))
    H, R = np.kron(np.eye(2), [[1.0, 0.0]]).tolist(), [[0.25, 0.0], [0.0, 0.25]]
    eye = np.eye(4).tolist()
    graph = {"kind": "regular", "nodes": nodes, "degree": 8, "seed": 1, "connected": True}
    return netkf.load(RING).replace(
        {
            "plant": {"kind": "diffusion", "A": A, "B": B, "mean": [0.0] * 4, "cov": eye},
            "sensors": [{"nodes": list(range(0, nodes, 3)), "H": H, "R": R}],
            "network.graph": graph,
            "network.activation.rate": rate,
            "filter.epsilon": 0.1,
            "filter.cov": eye,
        }
    )


def clocks(case, most):
    """The first ``most`` ticks of Poisson clocks, from a heap of the next tick of each link."""
    random = np.random.default_rng(1)
    mean, delivery = 1.0 / case.network.activation.rate, case.network.channel.loss.delivery
    heap = [(random.exponential(mean), link) for link in case.topology.links]
    heapq.heapify(heap)
    for _ in range(most):
        t, link = heap[0]
        yield Tick(t, link, random.random() < delivery)
        heapq.heapreplace(heap, (t + random.exponential(mean), link))


def discrete(truth, gap):
    """F and Q of a gap of seconds (Van Loan)."""
    n = len(truth.A)
    M = scipy.linalg.expm(np.block([[-truth.A, truth.Q], [np.zeros((n, n)), truth.A.T]]) * gap)
    F = M[n:, n:].T
    return F, F @ M[:n, n:]


def sensors(case):
    """node -> (H, R) of those that have a sensor."""
    return {node: case.observation(node) for node in case.sensing}


def filterpy_job(case, ticks):
    """Number of ticks, states and covariances, with one KalmanFilter a node."""
    from filterpy.kalman import KalmanFilter

    n, epsilon, seen = case.plant.n, case.filter.algorithm.epsilon, sensors(case)
    random, now, nodes = np.random.default_rng(2), dict.fromkeys(case.nodes, 0.0), {}
    for node in case.nodes:
        nodes[node] = KalmanFilter(dim_x=n, dim_z=len(seen[node][1]) if node in seen else 1)
        nodes[node].P = np.array(case.start(node)[1])
    made = 0
    for made, (t, (i, j), delivered) in enumerate(ticks, start=1):  # noqa: B007 - counted
        for h in (i, j):
            gap, now[h] = t - now[h], t
            F, Q = discrete(case.truth, gap)
            nodes[h].predict(F=F, Q=Q)
            if h in seen:
                H, R = seen[h]
                nodes[h].update(random.normal(size=(len(R), 1)), R=R / gap, H=H)
        if delivered:
            a, b = nodes[i], nodes[j]
            mean, cov = epsilon * (b.x - a.x), epsilon * (b.P - a.P)
            a.x, a.P, b.x, b.P = a.x + mean, a.P + cov, b.x - mean, b.P - cov
    every = [nodes[node] for node in case.nodes]
    return made, np.array([k.x[:, 0] for k in every]), np.array([k.P for k in every])


def stone_soup_job(case, ticks):
    """The same with Stone Soup's states, predictor and updater."""
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import LinearGaussianTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    n, epsilon, seen = case.plant.n, case.filter.algorithm.epsilon, sensors(case)

    class Plant(LinearGaussianTransitionModel):
        gap = (None, None, None)

        ndim_state = n

        def _discrete(self, time_interval):
            gap = time_interval.total_seconds()
            if self.gap[0] != gap:
                self.gap = (gap, *discrete(case.truth, gap))
            return self.gap

        def matrix(self, time_interval, **_):
            return self._discrete(time_interval)[1]

        def covar(self, time_interval, **_):
            return self._discrete(time_interval)[2]

    random, nodes = np.random.default_rng(2), {}
    predictor, updater = KalmanPredictor(Plant()), KalmanUpdater(None)
    for node in case.nodes:
        cov = np.array(case.start(node)[1])
        nodes[node] = GaussianState(np.zeros((n, 1)), cov, timestamp=EPOCH)
    made = 0
    for made, (t, (i, j), delivered) in enumerate(ticks, start=1):  # noqa: B007 - counted
        moment = EPOCH + datetime.timedelta(seconds=t)
        for h in (i, j):
            before = nodes[h].timestamp
            nodes[h] = predictor.predict(nodes[h], timestamp=moment)
            if h in seen:
                H, R = seen[h]
                gap = (moment - before).total_seconds()
                model = LinearGaussian(n, list(range(len(R))), R / gap)
                model.matrix = lambda H=H, **_: H
                reading = Detection(
                    random.normal(size=(len(R), 1)), timestamp=moment, measurement_model=model
                )
                nodes[h] = updater.update(SingleHypothesis(nodes[h], reading))
        if delivered:
            a, b = nodes[i], nodes[j]
            mean = epsilon * (b.state_vector - a.state_vector)
            cov = epsilon * (b.covar - a.covar)
            nodes[i] = GaussianState(a.state_vector + mean, a.covar + cov, timestamp=moment)
            nodes[j] = GaussianState(b.state_vector - mean, b.covar - cov, timestamp=moment)
    every = [nodes[node] for node in case.nodes]
    means = np.array([np.asarray(k.state_vector, dtype=float)[:, 0] for k in every])
    return made, means, np.array([np.asarray(k.covar) for k in every])


class StackedBound:
    """H(12) as one system of N n n equations, its right-hand side in numpy and one CSR product."""

    def __init__(self, case):
        self._equations = e = coupled(case)
        self._leaving = np.asarray(e.coupling.sum(axis=1)).reshape(-1, 1, 1)
        self.start = e.start.reshape(-1)
        self.evaluations = 0

    def slope(self, _, y):
        self.evaluations += 1
        e = self._equations
        P = y.reshape(e.start.shape)
        drift = e.A @ P
        arriving = (e.coupling @ P.reshape(len(P), -1)).reshape(P.shape)
        change = drift + np.swapaxes(drift, 1, 2) + e.Q - P @ e.G @ P
        return (change + arriving - self._leaving * P).reshape(-1)

    def solved(self, times):
        """(T, N, n, n) by scipy's best explicit method, as precise as netkf promises to be."""
        found = scipy.integrate.solve_ivp(
            self.slope, (0.0, times[-1]), self.start, "DOP853", times, rtol=1e-10, atol=1e-13
        )
        return found.y.T.reshape(len(times), *self._equations.start.shape)


def time_constant(case):
    """Seconds: of the slowest mode of H(12) made linear at its steady state."""
    packed = Packed(coupled(case))
    blocks = packed.linear(netkf.theory.steady_covariance_bound(case))

    def applied(x):
        X = x.reshape(packed.start.shape)
        return (np.einsum("ik,ikl->il", X, blocks) + packed.arriving(X)).reshape(-1)

    size = packed.start.size
    operator = scipy.sparse.linalg.LinearOperator((size, size), applied, dtype=float)
    slowest = scipy.sparse.linalg.eigs(
        operator, 1, which="LR", v0=np.ones(size), return_eigenvectors=False, tol=1e-4
    )
    return float(-1.0 / slowest[0].real)


def plain_chains(roots, words, F, Q, H, R):
    """(K, n, n): the random Riccati equation along each row of ``words``, written plainly."""
    ends = []
    for root, word in zip(roots, words, strict=True):
        P = root @ root.T
        for arrived in word:
            following = F @ P @ F.T + Q
            if arrived:
                gain = np.linalg.solve(H @ P @ H.T + R, H @ P @ F.T)
                following -= F @ P @ H.T @ gain
            P = following
        ends.append(P)
    return np.array(ends)


def random_system(n=4):
    """F with a growing mode, Q, H, R."""
    random = np.random.default_rng(4)
    F = random.normal(size=(n, n))
    F *= 1.05 / np.abs(np.linalg.eigvals(F)).max()
    return F, np.eye(n), random.normal(size=(2, n)), np.eye(2)


def ticks_of(run):
    """The ticks of a run of netkf, and whether the swap came through, for links without delay."""
    log = run.events
    kinds = log.kind.astype(str).to_numpy()
    places = np.flatnonzero(kinds == "tick")
    for k, (a, b) in enumerate(pairwise([*places, len(log)])):
        row = log.iloc[places[k]]
        yield Tick(float(row.t), (int(row.node), int(row.peer)), "absorb" in kinds[a:b])
