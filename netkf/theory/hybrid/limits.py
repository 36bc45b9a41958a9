"""What the filters come to when links tick ever faster, and the filter that has everything."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.scenario.registry import name_of, spoken
from netkf.scenario.sampling import sampled_sensors
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.coupled import Coupled, informations, left_weights, promised
from netkf.theory.hybrid.samples import PoissonSamples, by_readings, jumps, poisson_samples
from netkf.theory.hybrid.steady import steady_state
from netkf.theory.intermittent.riccati import filtered_covariance
from netkf.theory.numerics.matrices import algebraic_riccati, lyapunov


def limit_covariance(scenario: Scenario) -> FloatArray:
    """(n, n): S of H(13), to which H(12) comes as the rates grow (H Theorem 3).

    Where the two directions of links arrive at different rates the nodes' information is weighted
    by the left null vector of the coupling instead of 1/N (derived). Sensors that sample by Poisson
    clocks enter as they do in (*) of docs/poisson_samples.md. Raises TheoryError where S
    does not exist.
    """
    A, Q = scenario.belief
    algorithm = scenario.filter.algorithm
    if algorithm.talks and scenario.hosted.combination != "convex":
        raise TheoryError(f"H(13) is about the hybrid filter, not about {spoken(algorithm)}")
    if algorithm.talks and (own := overridden(algorithm)):
        name = spoken(algorithm)
        if ":" in name_of("filter", algorithm):
            name = f"{type(algorithm).__name__}, which defines {own[0]} itself"
        raise TheoryError(f"H(13) is about the hybrid filter, not about {name}")
    if by_readings(scenario) and algorithm.talks:
        raise TheoryError("S is the limit of fast links, and nodes transmit when they sample")
    w = left_weights(scenario)
    G = np.tensordot(w, informations(scenario), 1)
    if not sampled_sensors(scenario):
        return algebraic_riccati(A, Q, G)
    promised(scenario)
    if jumps(scenario):
        raise TheoryError("samples at known times lead to a cycle, not to a limit S")
    S = steady_state(_one(scenario, A, Q, G, w))
    if S is None:
        raise TheoryError("S does not exist: the sensors sample too rarely for it")
    return np.asarray(S[0])


def _one(scenario: Scenario, A: FloatArray, Q: FloatArray, G: FloatArray, w: FloatArray) -> Coupled:
    """The equation of all nodes with one covariance: each sensor counts by its node's weight."""
    groups = []
    for group in poisson_samples(scenario):
        silent = scipy.sparse.csr_array((1, len(group.nodes)))
        nodes, rate = np.zeros(len(group.nodes), dtype=int), group.rate * w[group.nodes]
        groups.append(PoissonSamples(nodes, group.H, group.R, rate, silent))
    start = np.asarray(scenario.start(scenario.nodes[0])[1])[None]
    nothing, eye = scipy.sparse.csr_array((1, 1)), np.eye(len(A))
    return Coupled(A, Q, G[None], nothing, eye, 0.0 * eye, 0.0, start, tuple(groups))


def true_limit_covariance(scenario: Scenario) -> FloatArray:
    """(n, n): the limit, as the rates grow, of the true covariance of x - xhat_i (derived).

    All nodes then share one estimate with the gains of S; it averages the sensors' noises, which S
    does not know: 0 = (A - S Gw) X + X (A - S Gw)' + Q + S (sum w_i^2 G_i) S. A filter's own R and
    Q may differ from the truth, its A may not. Raises TheoryError where the limit does not exist.
    """
    A, _ = scenario.belief
    if sampled_sensors(scenario):
        raise TheoryError("sampled sensors: P stays random, and the errors have no known limit")
    if not np.array_equal(A, scenario.truth.A):
        raise TheoryError("the filters' A differs from the plant's: the error follows the state")
    S, w = limit_covariance(scenario), left_weights(scenario)
    closed = A - S @ np.tensordot(w, informations(scenario), 1)
    noise = scenario.truth.Q.copy()
    for weight, node in zip(w, scenario.nodes, strict=True):
        H, R = scenario.observation(node)
        gain = S @ np.linalg.solve(scenario.observation(node, believed=True)[1], H).T
        noise += weight**2 * gain @ R @ gain.T
    return lyapunov(closed, noise)


def central_covariance(scenario: Scenario) -> FloatArray:
    """(n, n): steady covariance of the Kalman-Bucy filter that reads all sensors and knows the
    true model; in slots that of the Kalman filter, after its reading. Raises TheoryError where it
    does not exist, and in slots for filters whose samples are predictions: it is none.
    """
    if scenario.slotted:
        return _slot_central(scenario)
    if sampled_sensors(scenario):
        raise TheoryError(
            "sampled sensors: the central covariance goes up and down with the samples"
        )
    G = np.zeros((scenario.plant.n, scenario.plant.n))
    for node in scenario.sensing:
        H, R = scenario.observation(node)
        G += H.T @ np.linalg.solve(R, H)
    return algebraic_riccati(scenario.truth.A, scenario.truth.Q, G)


def _slot_central(scenario: Scenario) -> FloatArray:
    plant = scenario.slot_plant
    if scenario.hosted.predicts:
        raise TheoryError("the filter's samples are predictions, the central filter's are not")
    if any(sensor.varying for sensor in scenario.sensors):
        raise TheoryError("H differs from slot to slot: there is no steady covariance")
    truth = [scenario.observation(node) for node in scenario.sensing]
    H = np.concatenate([np.zeros((0, plant.n)), *(H for H, _ in truth)])
    return filtered_covariance(plant.F, plant.Q, H, block_diagonal([R for _, R in truth]))
