"""What the push-sum filter asks of the rest of a scenario."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from netkf.algorithms.push_sum import PushSum, asymptotic_root
from netkf.core.errors import ScenarioError
from netkf.network.graphs import Topology

if TYPE_CHECKING:
    from netkf.scenario.scenario import Scenario

MOST_DENSE = 400


def check_push_sum(scenario: Scenario) -> None:
    """Raise ScenarioError where leader, delta or the sensors do not fit."""
    algorithm, nodes = scenario.filter.algorithm, scenario.nodes
    if not isinstance(algorithm, PushSum):
        return
    if algorithm.leader not in scenario.topology.index:
        ids = ", ".join(map(str, nodes)) if len(nodes) <= 8 else f"{nodes[0]} .. {nodes[-1]}"
        raise ScenarioError(
            "filter.leader",
            "must be a node of the graph",
            algorithm.leader,
            f"node ids here are {ids}",
        )
    for name in ("gamma", "delta"):
        if getattr(algorithm, name) is None:
            words = "is missing for a plant in slots"
            raise ScenarioError(f"filter.{name}", words, None, f"add {name} = ...")
    assert algorithm.delta is not None
    radius = laplacian_radius(scenario.topology)
    if algorithm.delta <= 0.5 * radius * (1.0 + 1e-12):
        raise ScenarioError(
            "filter.delta",
            f"must be above rho(L) / 2 = {0.5 * radius:.6g}, or averaging does not contract",
            algorithm.delta,
            f"give more than rho(L) = {radius:.6g}",
        )
    for k, sensor in enumerate(scenario.sensors):
        if sensor.varying:
            raise ScenarioError(
                f"sensors[{k}]",
                "must have a fixed H for the push-sum filter, which adds them up beforehand",
                None,
                "use linear sensors or another filter",
            )
    F, Q = scenario.slot_belief
    if algorithm.asymptotic and asymptotic_root(F, Q, scenario.node_infos[0].information) is None:
        raise ScenarioError(
            "filter.asymptotic",
            "needs a steady covariance of the centralised filter, and there is none",
            True,
            "add sensors, or set it to false",
        )


def push_sum_notes(scenario: Scenario) -> tuple[str, ...]:
    """One line each: delta is below rho(L); settings of slots are not used under clocks."""
    algorithm = scenario.filter.algorithm
    if not isinstance(algorithm, PushSum):
        return ()
    if not scenario.slotted:
        return _unused(algorithm)
    assert algorithm.delta is not None
    radius = laplacian_radius(scenario.topology)
    if algorithm.delta >= radius:
        return ()
    return (
        f"filter.delta = {algorithm.delta:g} is below rho(L) = {radius:.6g}: averaging contracts, "
        "but P Theorems 3, 5 and 6 ask for more than rho(L)",
    )


def _unused(algorithm: PushSum) -> tuple[str, ...]:
    given = [f for f in dataclasses.fields(algorithm) if getattr(algorithm, f.name) != f.default]
    if not given:
        return ()
    names = ", ".join(f"filter.{f.name}" for f in given)
    return (f"{names}: not used under clocks, where push-sum keeps running sums",)


def laplacian_radius(topology: Topology) -> float:
    """rho(L), the largest eigenvalue of the Laplacian of all links."""
    if not topology.links:
        return 0.0
    index, degrees = topology.index, topology.degrees
    ends = np.array([(index[i], index[j]) for i, j in topology.links])
    degree = np.array([float(degrees[node]) for node in topology.nodes])
    if len(degree) > MOST_DENSE:
        return _largest_sparse(ends, degree)
    L = np.diag(degree)
    L[ends[:, 0], ends[:, 1]] = L[ends[:, 1], ends[:, 0]] = -1.0
    return float(np.linalg.eigvalsh(L)[-1])


def _largest_sparse(ends: np.ndarray, degree: np.ndarray) -> float:
    import scipy.sparse
    import scipy.sparse.linalg

    one = np.full(len(ends), -1.0)
    half = scipy.sparse.coo_array((one, (ends[:, 0], ends[:, 1])), shape=(len(degree),) * 2)
    L = (half + half.T + scipy.sparse.diags_array(degree)).tocsr()
    start = np.random.default_rng(0).standard_normal(len(degree))
    return float(scipy.sparse.linalg.eigsh(L, k=1, v0=start, return_eigenvectors=False)[0])
