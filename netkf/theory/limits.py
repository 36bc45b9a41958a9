"""What the filters come to when links tick ever faster, and the filter that has everything."""

from __future__ import annotations

import numpy as np

from netkf.algorithms.hybrid import Hybrid
from netkf.core.arrays import FloatArray, block_diagonal
from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.theory.coupled import informations, left_weights, own_steps
from netkf.theory.intermittent import filtered_covariance
from netkf.theory.matrices import algebraic_riccati, lyapunov


def limit_covariance(scenario: Scenario) -> FloatArray:
    """(n, n): S of H(13), to which H(12) comes as the rates grow (H Theorem 3).

    Where the two directions of links arrive at different rates the nodes' information is weighted
    by the left null vector of the coupling instead of 1/N (derived). Raises TheoryError where S
    does not exist.
    """
    A, Q = scenario.belief
    algorithm = scenario.filter.algorithm
    if algorithm.talks and (not isinstance(algorithm, Hybrid) or own_steps(algorithm, Hybrid)):
        name = type(algorithm).__name__
        raise TheoryError(f"H(13) is about the hybrid filter, and {name} is another one")
    w = left_weights(scenario)
    return algebraic_riccati(A, Q, np.tensordot(w, informations(scenario), 1))


def true_limit_covariance(scenario: Scenario) -> FloatArray:
    """(n, n): the limit, as the rates grow, of the true covariance of x - xhat_i (derived).

    All nodes then share one estimate with the gains of S; it averages the sensors' noises, which S
    does not know: 0 = (A - S Gw) X + X (A - S Gw)' + Q + S (sum w_i^2 G_i) S. A filter's own R and
    Q may differ from the truth, its A may not. Raises TheoryError where the limit does not exist.
    """
    A, _ = scenario.belief
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
