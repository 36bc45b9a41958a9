"""Limits of the filters for ever faster links, and the covariance of the central filter."""

from __future__ import annotations

import numpy as np

from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.scenario.registry import kind_name, name_of
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import require_every_reading
from netkf.theory.hybrid.coupled import (
    CoupledRiccati,
    increment_informations,
    left_weights,
    require_bound,
)
from netkf.theory.hybrid.dense import full_matrix
from netkf.theory.hybrid.samples import (
    PoissonSamples,
    poisson_samples,
    sample_jumps,
    transmits_at_samples,
)
from netkf.theory.hybrid.steady import steady_state
from netkf.theory.intermittent.riccati import filtered_covariance
from netkf.theory.numerics.matrices import algebraic_riccati, lyapunov


def limit_covariance(scenario: Scenario) -> FloatArray:
    """Return S (n, n), the limit as the link rates grow of the steady bound H(12) on the mean of
    each filter's P: the solution of the Riccati equation H(13) with the mean information of all
    nodes (H Theorem 3 of the hybrid paper).

    If the two directions of links have different rates of arrival, the nodes' information is
    weighted by the left null vector of the coupling instead of 1/N (derived). Sensors that sample
    by Poisson clocks enter as in (*) of docs/poisson_samples.md. Raises TheoryError if S does not
    exist.
    """
    A, Q = scenario.belief
    _require_limit(scenario)
    w = left_weights(scenario)
    G = np.tensordot(w, increment_informations(scenario), 1)
    if not scenario.sampled_sensors:
        return algebraic_riccati(A, Q, G)
    require_bound(scenario)
    if sample_jumps(scenario):
        raise TheoryError("samples at known times lead to a cycle, not to a limit S")
    # With Poisson samples S obeys H(12) of one node instead of an algebraic Riccati equation.
    S = steady_state(_shared_equation(scenario, A, Q, G, w))
    if S is None:
        raise TheoryError("S does not exist: the sensors sample too rarely for it")
    return np.asarray(S[0])


def _require_limit(scenario: Scenario) -> None:
    algorithm = scenario.filter.algorithm
    if not algorithm.timing.talks:
        return
    kernels = scenario.node_filter.kernels
    if kernels is None or not kernels.is_convex:
        raise TheoryError(
            f"Tanwani's H(13) is about the hybrid filter, not about {kind_name(algorithm)}"
        )
    if overridden_names := overridden(algorithm):
        name = kind_name(algorithm)
        if ":" in name_of("filter", algorithm):
            name = f"{type(algorithm).__name__}, which defines {overridden_names[0]} itself"
        raise TheoryError(f"Tanwani's H(13) is about the hybrid filter, not about {name}")
    if transmits_at_samples(scenario):
        raise TheoryError("S is the limit of fast links, and nodes transmit when they sample")


def _shared_equation(
    scenario: Scenario, A: FloatArray, Q: FloatArray, G: FloatArray, w: FloatArray
) -> CoupledRiccati:
    """Return H(12) of N nodes with one covariance, as in the limit of fast links, as one node."""
    # G (n, n) is the information per second of all increments, each with its node's weight w.
    groups = []
    for group in poisson_samples(scenario):
        silent = full_matrix(1, len(group.nodes))
        nodes, rate = np.zeros(len(group.nodes), dtype=int), group.rate * w[group.nodes]
        groups.append(PoissonSamples(nodes, group.H, group.R, rate, silent))
    start = np.asarray(scenario.initial_estimate(scenario.nodes[0])[1])[None]
    # No messages, so that nothing is predicted over a delay: T = I, q = 0.
    eye, none = np.eye(len(A)), full_matrix(1, 1)
    return CoupledRiccati(
        A,
        Q,
        G[None],
        coupling=none,
        T=eye,
        q=0.0 * eye,
        delay=0.0,
        start=start,
        samples=tuple(groups),
    )


def true_limit_covariance(scenario: Scenario) -> FloatArray:
    """Return the limit (n, n), as the link rates grow, of the true covariance of x - xhat_i.

    Derived: all nodes then share one estimate with the gains of S, which averages the sensors'
    noises; S does not include that. 0 = (A - S Gw) X + X (A - S Gw)' + Q + S (sum w_i^2 G_i) S. The
    filters' R and Q may differ from the truth, their A may not. Raises TheoryError if the limit
    does not exist.
    """
    A, _ = scenario.belief
    if scenario.sampled_sensors:
        raise TheoryError("sampled sensors: P stays random, and the errors have no known limit")
    if not np.array_equal(A, scenario.diffusion.A):
        raise TheoryError("the filters' A differs from the plant's: the error follows the state")
    S, w = limit_covariance(scenario), left_weights(scenario)
    # All nodes have the error e with de = (A - S Gw) e dt + B dw - sum_i w_i S H_i' R_i^-1 dv_i.
    closed = A - S @ np.tensordot(w, increment_informations(scenario), 1)
    noise = (
        scenario.diffusion.Q.copy()
    )  # plus the true noise of each sensor through the gains w_i S
    for weight, node in zip(w, scenario.nodes, strict=True):
        H, R = scenario.observation_matrices(node)
        gain = S @ np.linalg.solve(scenario.observation_matrices(node, believed=True)[1], H).T
        noise += weight**2 * gain @ R @ gain.T
    return lyapunov(closed, noise)


def central_covariance(scenario: Scenario) -> FloatArray:
    """Return the steady covariance (n, n) of the central filter.

    It reads all sensors and knows the true model: the Kalman-Bucy filter, in slots the Kalman
    filter after its update. Raises TheoryError if it does not exist, and in slots for filters whose
    samples are predictions, which are not comparable.
    """
    if scenario.slotted:
        return _central_slot_covariance(scenario)
    if scenario.sampled_sensors:
        raise TheoryError(
            "no steady value: with sampled sensors it goes up and down with the samples"
        )
    require_every_reading(scenario)
    G = np.zeros((scenario.plant.n, scenario.plant.n))
    for node in scenario.sensing_nodes:
        H, R = scenario.observation_matrices(node)
        G += H.T @ np.linalg.solve(R, H)
    return algebraic_riccati(scenario.diffusion.A, scenario.diffusion.Q, G)


def _central_slot_covariance(scenario: Scenario) -> FloatArray:
    """Return the steady covariance (n, n) of the central filter in slots, after the reading."""
    plant = scenario.linear_plant
    if scenario.node_filter.timing.predicts:
        raise TheoryError("the filter's samples are predictions, the central filter's are not")
    if any(sensor.varying for sensor in scenario.sensors):
        raise TheoryError("H differs from slot to slot: there is no steady covariance")
    require_every_reading(scenario)
    truth = [scenario.observation_matrices(node) for node in scenario.sensing_nodes]
    H = np.concatenate([np.zeros((0, plant.n)), *(H for H, _ in truth)])
    return filtered_covariance(plant.F, plant.Q, H, block_diagonal([R for _, R in truth]))
