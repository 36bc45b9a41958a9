"""The arguments of the hand-written kernels, from a scenario: ``prepared(case, runs)`` gives a call
that makes runs, and its results.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.linalg

from netkf.network.clocks import Poisson, Renewal
from netkf.network.delays import ExponentialDelay
from netkf.network.losses import GilbertElliott
from tests.benchmarks import by_hand
from tests.benchmarks.by_hand import (
    BINS,
    GAMMA,
    INTERSECT,
    LATTICE,
    ORDER,
    POISSON,
    RESET,
    SPAN,
    STEP,
    SUMS,
    SWAP,
)


class Results(NamedTuple):
    """Of R runs: x (R, T, n), xhat (R, T, N, n), P (R, T, N, n, n)."""

    x: np.ndarray
    xhat: np.ndarray
    P: np.ndarray

    @classmethod
    def empty(cls, case, runs):
        times, nodes, n = len(case.times), len(case.nodes), case.plant.n
        shapes = (times, n), (times, nodes, n), (times, nodes, n, n)
        return cls(*(np.empty((runs, *shape)) for shape in shapes))

    @property
    def errors(self):
        """(R, T, N, n)."""
        return self.x[:, :, None] - self.xhat


def prepared(case, runs, seed=1):
    """A call that makes a number of runs, ``runs`` at once, and the results of the last ones."""
    results = Results.empty(case, runs)
    jobs = SLOT_JOBS if case.slotted else CLOCK_JOBS
    kernel, before, after = jobs[type(case.filter.algorithm).__name__](case)
    random = np.random.default_rng(seed)
    size = (0,) * case.plant.n

    def call(count=runs):
        for first in range(0, count, runs):
            some = [part[: count - first] for part in results]
            kernel(size, *before, random, *after, *some)

    return call, results


def root_of(Q):
    """L with L L' = Q, lower triangular up to the zeros of a singular Q."""
    values, vectors = np.linalg.eigh(np.array(Q))
    return np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T)[1].T.copy()


def ends_of(case):
    """(L, 2) places of nodes, in the order of their ids."""
    places = {node: k for k, node in enumerate(case.nodes)}
    return np.array([[places[i], places[j]] for i, j in case.topology.links], dtype=np.int64)


def started(case):
    """Mean and covariance of x(0) and a root of it."""
    cov = np.array(case.plant.start_cov)
    return np.array(case.plant.start_mean), cov, root_of(cov)


def whitened(case):
    """H (N, p, n) and numbers of rows (N,) of readings whose noise has variance 1."""
    sensors = {node: case.observation_matrices(node) for node in case.sensing_nodes}
    most = max(len(R) for _, R in sensors.values())
    H, rows = np.zeros((len(case.nodes), most, case.plant.n)), np.zeros(len(case.nodes), np.int64)
    for k, node in enumerate(case.nodes):
        if node in sensors:
            h, R = sensors[node]
            rows[k] = len(R)
            H[k, : len(R)] = np.linalg.solve(np.linalg.cholesky(R), h)
    return H, rows


def probe_slots(case):
    """Slots from probe to probe."""
    return round((case.times[1] - case.times[0]) / case.plant.period)


def in_slots(case):
    """What all jobs in slots share: slots between probes, plant, start, sensors, links."""
    F, Q = np.array(case.plant.F), np.array(case.plant.Q)
    plant = F, Q, root_of(Q)
    return probe_slots(case), plant, started(case), *whitened(case), ends_of(case)


def delivery(case):
    return getattr(case.network.channel.loss, "delivery", 1.0)


def gossip(case):
    return by_hand.gossip, (), in_slots(case)


def intermittent(case):
    return by_hand.intermittent, (), (*in_slots(case), delivery(case))


def push_sum(case):
    settings = case.filter.algorithm
    rest = delivery(case), settings.gamma, 1.0 / settings.delta
    return by_hand.push_sum, (), (*in_slots(case), *rest)


def senders_of(case):
    """Offsets (N + 1,), senders and weights: those of a node after each other, itself first."""
    places = {node: k for k, node in enumerate(case.nodes)}
    heard = {node: [(node, case.own_weights[node])] for node in case.nodes}
    for sender, receiver in case.topology.directions:
        heard[receiver].append((sender, case.weight(receiver, sender)))
    pairs = [pair for node in case.nodes for pair in heard[node]]
    first = np.cumsum([0, *(len(heard[node]) for node in case.nodes)])
    senders = np.array([places[sender] for sender, _ in pairs])
    return first, senders, np.array([weight for _, weight in pairs])


def regressors_of(case):
    """A, B with a root of cov(xi), C and the start of each node's."""
    owners = {node: sensor for sensor in case.sensors for node in sensor.nodes}
    sensors = [owners[node] for node in case.nodes]
    B = [sensor.B @ root_of(sensor.xi_cov) for sensor in sensors]
    rest = ([getattr(sensor, name) for sensor in sensors] for name in ("A", "C", "start"))
    A, C, start = (np.array(part) for part in rest)
    return A, np.array(B), C, start


def diffusion(case):
    entries = range(len(case.sensors))
    (R,), (believed,) = (
        {case.noise_covariance(k, believed=which).item() for k in entries}
        for which in (False, True)
    )
    plant = np.array(case.plant.F), root_of(case.plant.Q)
    _, Q = case.slot_belief
    mean, cov = case.initial_estimate(case.nodes[0])
    start = np.array(case.plant.start_mean), root_of(case.plant.start_cov), mean.copy(), cov.copy()
    model = np.array(Q), np.sqrt(believed)
    rest = np.sqrt(R), start, regressors_of(case), senders_of(case)
    return by_hand.diffusion, (), (probe_slots(case), plant, model, *rest)


def interpolated(entries):
    """Coefficients (BINS, ORDER + 1, E) of E entries as polynomials in the gap."""
    points = np.polynomial.chebyshev.chebpts1(ORDER + 1) * 0.5 * SPAN / BINS
    middles = (np.arange(BINS) + 0.5) * SPAN / BINS
    values = np.array([[entries(middle + point) for point in points] for middle in middles])
    return np.linalg.solve(np.vander(points, increasing=True), values)


def laws(A, B, H, V):
    """``interpolated`` laws of ``by_hand.flow``; law of state and both integrals over STEP."""
    n, chain, spread = len(A), *(np.zeros((3 * len(A),) * 2) for _ in range(2))
    chain[:n, :n], chain[n:, : 2 * n], spread[:n, :n] = A, np.eye(2 * n), B @ B.T

    def over(gap):
        """Transition and covariance (3 n, 3 n), Van Loan."""
        block = np.block([[-chain, spread], [np.zeros_like(chain), chain.T]])
        M = scipy.linalg.expm(block * gap)
        F = M[3 * n :, 3 * n :].T
        return F, F @ M[: 3 * n, 3 * n :]

    def entries(gap):
        F, Q = over(gap)
        # Moments of H x with 1 and 2 s / gap - 1, from both integrals.
        T = np.kron([[1.0, 0.0], [1.0, -2.0 / gap]], H)
        S0 = T @ Q[n:, n:] @ T.T + np.kron(np.diag([gap, gap / 3.0]), V)
        low, low_S0 = np.tril_indices(n), np.tril_indices(len(T))
        parts = F[:n, :n], Q[:n, :n][low], T @ F[n:, :n], Q[:n, n:] @ T.T, S0[low_S0]
        return np.concatenate([part.ravel() for part in parts])

    F, Q = over(STEP)
    return interpolated(entries), (F, root_of(Q))


def clock_of(clock):
    """Kind and parameters, of ``by_hand.tick_after``."""
    if isinstance(clock, Poisson):
        assert not clock.rates, "one rate"
        return POISSON, 1.0 / clock.rate, 0.0
    if isinstance(clock, Renewal):
        assert clock.distribution == "gamma"
        return GAMMA, clock.shape, clock.mean_gap / clock.shape
    assert clock.phase == "random"
    return LATTICE, clock.period, clock.jitter


def loss_of(case, links):
    """Deliveries (2, L) over these directed links in a good and a bad state, and the chances of
    turning bad and good.
    """
    loss = case.network.channel.loss
    table = np.array(
        [
            [
                float(loss.delivery_probability(case.transmission(link)._replace(bad=bad)))
                for link in links
            ]
            for bad in (False, True)
        ]
    )
    return table, *(loss.transitions if isinstance(loss, GilbertElliott) else (0.0, 1.0))


def pairs(case, rule):
    seen = {node: case.observation_matrices(node) for node in case.sensing_nodes}
    H, V = (np.array(part) for part in next(iter(seen.values())))
    assert all((h == H).all() and (R == V).all() for h, R in seen.values()), "one kind of sensor"
    assert case.network.channel.symmetric
    table, step_law = laws(np.array(case.plant.A), np.array(case.plant.B), H, V)
    rows = np.array([len(H) * (node in seen) for node in case.nodes])
    sensor, ends = (H, np.linalg.cholesky(V)), ends_of(case)
    clock, loss = clock_of(case.network.activation), loss_of(case, case.topology.links)
    combination = clock, loss, rule, getattr(case.filter.algorithm, "epsilon", 0.0)
    after = np.array(case.times), step_law, table, started(case), sensor, rows, ends, *combination
    return by_hand.pairs, ((0,) * 2 * len(H),), after


def gap_laws(A, B):
    """``interpolated`` F and lower triangle of Q."""
    n = len(A)
    block = np.block([[-A, B @ B.T], [np.zeros_like(A), A.T]])

    def entries(gap):
        M = scipy.linalg.expm(block * gap)
        F = M[n:, n:].T
        return np.concatenate([F.ravel(), (F @ M[:n, n:])[np.tril_indices(n)]])

    return interpolated(entries)


def fading_laws(A):
    """``interpolated`` e^(-r gap) e^(-A gap) and e^(-r gap), with r the rate of decay of A."""
    rates = -np.linalg.eigvals(A).real
    assert np.ptp(rates) < 1e-9, "one rate of decay"
    r = max(rates[0], 0.0)

    def entries(gap):
        fading = np.exp(-r * gap)
        return np.append(fading * scipy.linalg.expm(-A * gap), fading)

    return interpolated(entries)


def broadcasts(case, rule):
    places = {node: k for k, node in enumerate(case.nodes)}
    placed = [(node, sensor) for sensor in case.sensors for node in sensor.nodes if node in places]
    H = np.array([np.linalg.solve(np.linalg.cholesky(s.R), s.H) for _, s in placed])
    owners = np.array([places[node] for node, _ in placed])
    sent = sorted((places[i], places[j], (i, j)) for i, j in case.topology.directions)
    senders, receivers, directions = zip(*sent, strict=True)
    links = np.searchsorted(senders, np.arange(len(places) + 1)), np.array(receivers)
    channel, A = case.network.channel, np.array(case.plant.A)
    assert not channel.symmetric
    exponential = isinstance(channel.delay, ExponentialDelay)
    after = (
        np.array(case.times),
        gap_laws(A, np.array(case.plant.B)),
        fading_laws(A) if rule == SUMS else np.empty((0, 0, 0)),
        started(case),
        (H, owners),
        clock_of(case.sensors[0].sampling),
        clock_of(case.network.activation),
        links,
        loss_of(case, directions),
        (0.0, 0.0, channel.delay.mean)
        if exponential
        else (channel.delay.low, channel.delay.high, 0.0),
        rule,
        getattr(case.filter.algorithm, "epsilon", 0.0),
    )
    return by_hand.broadcasts, (), after


def intersection(case):
    return broadcasts(case, INTERSECT) if case.sampled_sensors else pairs(case, INTERSECT)


SLOT_JOBS = {
    "Gossip": gossip,
    "Intermittent": intermittent,
    "PushSum": push_sum,
    "DiffusionFilter": diffusion,
}
CLOCK_JOBS = {
    "CovarianceIntersection": intersection,
    "Gossip": partial(pairs, rule=SWAP),
    "Hybrid": partial(pairs, rule=RESET),
    "PushSum": partial(broadcasts, rule=SUMS),
}
