"""The same jobs with other people's tools: filterpy and Stone Soup objects in a loop over events,
filterpy and simdkalman on series of readings, batched numpy, scipy's solve_ivp on the stacked bound
(12), a plain numpy loop for the random Riccati equation.

Part of ``python -m tests.benchmarks``; tests/benchmarks/test_peers.py holds the results of each
pair against each other.
"""

import datetime
import heapq
import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.integrate
import scipy.linalg

from netkf.theory.hybrid.coupled import coupled_riccati
from tests.benchmarks.jobs import Results, root_of

EPOCH = datetime.datetime(2000, 1, 1)


class Event(NamedTuple):
    """What happens at a time: ``nodes`` are predicted and use what their sensors have read, then
    the two of a ``link``, if any, swap; or the states of all are kept, at a ``probe``.

    ``path`` is F and a root of Q over the time since the last event, for the true state; ``laws``
    are the gap in seconds, F and Q since the last time of each of the nodes.
    """

    t: float
    nodes: list[int]
    link: tuple[int, int] | None
    probe: bool
    path: tuple[np.ndarray, np.ndarray]
    laws: list[tuple[float, np.ndarray, np.ndarray]]


def clocks(case):
    """The ticks of Poisson clocks, from a heap of the next tick of each link: t, the link, and
    whether messages arrive.
    """
    random = np.random.default_rng(1)
    mean, delivery = 1.0 / case.network.activation.rate, case.network.channel.loss.delivery
    heap = [(random.exponential(mean), link) for link in case.topology.links]
    heapq.heapify(heap)
    while heap[0][0] < case.horizon:
        t, link = heap[0]
        yield t, link, random.random() < delivery
        heapq.heapreplace(heap, (t + random.exponential(mean), link))


def events_of(case, ticks):
    """All events of a run with these ``ticks``: as in netkf, nodes with sensors read at each point
    of the sensing grid and at each tick of theirs, other nodes are predicted when a message
    arrives, and all at probes. A list: no transition matrix is worked out while others are timed.
    """
    seen, period = sensors(case), case.diffusion.sensing_period
    grid = np.arange(1, round(case.horizon / period)) * period
    # Later entries win: a probe is a point of the grid too.
    due = {float(t): (list(seen), None, False) for t in grid if np.abs(t - case.times).min() > 1e-9}
    due |= {float(t): (case.nodes, None, True) for t in case.times}
    for t, link, delivered in ticks:
        due[t] = (link, link, False) if delivered else ([h for h in link if h in seen], None, False)
    last, before, found = dict.fromkeys(case.nodes, 0.0), 0.0, []
    for t, (touched, link, probe) in sorted(due.items()):
        nodes = [node for node in touched if last[node] < t]
        F, Q = discrete(case.diffusion, t - before)
        laws = [(t - last[node], *discrete(case.diffusion, t - last[node])) for node in nodes]
        found.append(Event(t, nodes, link, probe, (F, root_of(Q)), laws))
        last.update(dict.fromkeys(nodes, t))
        before = t
    return found


def discrete(truth, gap):
    """F and Q of a gap of seconds (Van Loan)."""
    n = len(truth.A)
    M = scipy.linalg.expm(np.block([[-truth.A, truth.Q], [np.zeros((n, n)), truth.A.T]]) * gap)
    F = M[n:, n:].T
    return F, F @ M[:n, n:]


def sensors(case):
    """node -> (H, R, a root of R) of those that have a sensor."""
    found = {}
    for node in case.sensing_nodes:
        H, R = case.observation_matrices(node)
        found[node] = H, R, np.linalg.cholesky(R)
    return found


def filterpy_job(case, events):
    """Results of a run (without the axis of runs), with one KalmanFilter a node; a reading is the
    mean over its gap, whose noise has covariance R / gap.
    """
    from filterpy.kalman import KalmanFilter

    n, epsilon, seen = case.plant.n, case.filter.algorithm.epsilon, sensors(case)
    random, nodes, kept = np.random.default_rng(2), {}, []
    for node in case.nodes:
        nodes[node] = KalmanFilter(dim_x=n, dim_z=len(seen[node][1]) if node in seen else 1)
        nodes[node].P = np.array(case.initial_estimate(node)[1])
    x = random.multivariate_normal(case.plant.start_mean, case.plant.start_cov)
    for event in events:
        F, root = event.path
        x = F @ x + root @ random.standard_normal(n)
        for h, (gap, F, Q) in zip(event.nodes, event.laws, strict=True):
            nodes[h].predict(F=F, Q=Q)
            if h in seen:
                H, R, root = seen[h]
                y = H @ x + root @ random.standard_normal(len(R)) / math.sqrt(gap)
                nodes[h].update(y[:, None], R=R / gap, H=H)
        if event.link:
            a, b = (nodes[h] for h in event.link)
            mean, cov = epsilon * (b.x - a.x), epsilon * (b.P - a.P)
            a.x, a.P, b.x, b.P = a.x + mean, a.P + cov, b.x - mean, b.P - cov
        if event.probe:
            means = np.array([nodes[h].x[:, 0] for h in case.nodes])
            kept.append((x, means, np.array([nodes[h].P for h in case.nodes])))
    return Results(*map(np.array, zip(*kept, strict=True)))


def stone_soup_job(case, events):
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
        law = None
        ndim_state = n

        def matrix(self, **_):
            return self.law[0]

        def covar(self, **_):
            return self.law[1]

    random, nodes, plant, kept = np.random.default_rng(2), {}, Plant(), []
    predictor, updater = KalmanPredictor(plant), KalmanUpdater(None)
    for node in case.nodes:
        cov = np.array(case.initial_estimate(node)[1])
        nodes[node] = GaussianState(np.zeros((n, 1)), cov, timestamp=EPOCH)
    x = random.multivariate_normal(case.plant.start_mean, case.plant.start_cov)
    for event in events:
        moment = EPOCH + datetime.timedelta(seconds=event.t)
        F, root = event.path
        x = F @ x + root @ random.standard_normal(n)
        for h, (gap, *law) in zip(event.nodes, event.laws, strict=True):
            plant.law = law
            nodes[h] = predictor.predict(nodes[h], timestamp=moment)
            if h in seen:
                H, R, root = seen[h]
                y = H @ x + root @ random.standard_normal(len(R)) / math.sqrt(gap)
                model = LinearGaussian(n, list(range(len(R))), R / gap)
                model.matrix = lambda H=H, **_: H
                reading = Detection(y[:, None], timestamp=moment, measurement_model=model)
                nodes[h] = updater.update(SingleHypothesis(nodes[h], reading))
        if event.link:
            i, j = event.link
            a, b = nodes[i], nodes[j]
            mean = epsilon * (b.state_vector - a.state_vector)
            cov = epsilon * (b.covar - a.covar)
            nodes[i] = GaussianState(a.state_vector + mean, a.covar + cov, timestamp=moment)
            nodes[j] = GaussianState(b.state_vector - mean, b.covar - cov, timestamp=moment)
        if event.probe:
            every = [nodes[h] for h in case.nodes]
            means = np.array([np.asarray(k.state_vector, dtype=float)[:, 0] for k in every])
            kept.append((x, means, np.array([np.asarray(k.covar) for k in every])))
    return Results(*map(np.array, zip(*kept, strict=True)))


def series(case, count):
    """Readings (S, K, p) of ``count`` paths of a plant in slots, slots 1 to K, by all sensors."""
    random, (F, Q) = np.random.default_rng(3), (case.plant.F, case.plant.Q)
    H, R = pooled(case)
    x = random.multivariate_normal(case.plant.start_mean, case.plant.start_cov, count)
    found = np.empty((count, len(case.times) - 1, len(H)))
    for k in range(found.shape[1]):
        x = x @ F.T + random.multivariate_normal(np.zeros(len(F)), Q, count)
        noise = random.multivariate_normal(np.zeros(len(R)), R, count)
        found[:, k] = x @ H.T + noise
    return found


def pooled(case):
    """H and R of all sensors together."""
    seen = sensors(case).values()
    return np.concatenate([H for H, *_ in seen]), scipy.linalg.block_diag(*(R for _, R, _ in seen))


def simdkalman_filter(case, readings):
    """Filtered means (S, K, n) and covariances (S, K, n, n) of all series at once."""
    import simdkalman

    H, R = pooled(case)
    model = simdkalman.KalmanFilter(case.plant.F, case.plant.Q, H, R)
    F, Q = case.plant.F, case.plant.Q
    start = F @ case.plant.start_mean, F @ case.plant.start_cov @ F.T + Q  # before a reading
    found = model.compute(
        readings, 0, *start, smoothed=False, filtered=True, observations=False
    ).filtered.states
    return found.mean, found.cov


def filterpy_filter(case, readings):
    """The same, one series after the other."""
    from filterpy.kalman import KalmanFilter

    (H, R), n = pooled(case), case.plant.n
    means = np.empty((*readings.shape[:2], n))
    covs = np.empty((*readings.shape[:2], n, n))
    for s, ys in enumerate(readings):
        f = KalmanFilter(dim_x=n, dim_z=len(H))
        f.F, f.Q, f.H, f.R = case.plant.F, case.plant.Q, H, R
        f.x, f.P = case.plant.start_mean.reshape(n, 1).copy(), case.plant.start_cov.copy()
        for k, y in enumerate(ys):
            f.predict()
            f.update(y)
            means[s, k], covs[s, k] = f.x[:, 0], f.P
    return means, covs


def batched_gossip(job, runs, seed=1):
    """x (R, T, n), xhat (R, T, N, n) and P (R, T, N, n, n) of ``runs`` runs side by side in numpy.

    ``job`` is that of the hand-written kernel, ``jobs.in_slots(case)``.
    """
    probe, (F, Q, root), (mean, cov, first), H, rows, ends, times = job
    random, (N, n) = np.random.default_rng(seed), (len(rows), len(F))
    shape, every = (runs, N), np.arange(runs)
    x = mean + random.standard_normal((runs, n)) @ first.T
    m, P = np.broadcast_to(mean, (*shape, n)).copy(), np.broadcast_to(cov, (*shape, n, n)).copy()
    seeing = np.flatnonzero(rows)
    assert (rows[seeing] == 1).all(), "one reading a slot at most"
    h = H[seeing, 0]
    kept = [], [], []
    for slot in range((times - 1) * probe + 1):
        if slot % probe == 0:
            for part, now in zip(kept, (x, m, P), strict=True):
                part.append(now.copy())
        if slot > 0:
            partner = np.tile(np.arange(N), (runs, 1))
            order = random.random((runs, len(ends))).argsort(axis=1)
            for links in order.T:  # greedy: a link in each run at once
                i, j = ends[links].T
                free = (partner[every, i] == i) & (partner[every, j] == j)
                r, i, j = every[free], i[free], j[free]
                partner[r, i], partner[r, j] = j, i
            m, P = m[every[:, None], partner], P[every[:, None], partner]
        some, y = P[:, seeing], x @ h.T + random.standard_normal((runs, len(seeing)))
        Ph = np.einsum("rkij,kj->rki", some, h)
        gain = Ph / (1.0 + np.einsum("rki,ki->rk", Ph, h))[..., None]
        innovation = y - np.einsum("rki,ki->rk", m[:, seeing], h)
        m[:, seeing] += gain * innovation[..., None]
        P[:, seeing] = some - gain[..., None] * Ph[..., None, :]
        m, P = m @ F.T, F @ P @ F.T + Q
        x = x @ F.T + random.standard_normal((runs, n)) @ root.T
    return tuple(np.stack(part, axis=1) for part in kept)


class StackedBound:
    """H(12) as one system of N n n equations, its right-hand side in numpy and one CSR product."""

    def __init__(self, case):
        self._equations = e = coupled_riccati(case)
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
        yield float(row.t), (int(row.node), int(row.peer)), "absorb" in kinds[a:b]
