"""Limits of paper P steps 2 and 3, and bounds on the consensus gain of the push-sum filter."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.registry import built_in_filters, overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.network.graphs import Topology
from netkf.scenario.scenario import Scenario
from netkf.theory.common.requirements import scenario_of_estimates, topology_of
from netkf.theory.intermittent.riccati import filtered_covariance


class PushSumLimits(NamedTuple):
    """Limits of what push-sum averages (step 2 of the push-sum paper: each node's masses C~, n~ and
    w) and of what nodes compute from it (step 3), in the order of the nodes.

    mass      : (N, n, n) of C~, a node's share of the information of all sensors, paper P (16)
    number    : (N,) of n~, a node's share of the number of nodes, paper P (17)
    weight    : (N,) of w, a node's share of a total of 1, paper P (18)
    G         : (n, n) of every G^(i), the sum of all H_i' R_i^-1 H_i, paper P (10)
    N         : of every N^(i), paper P (11)
    P         : (n, n) of every P^(i): P_inf of P (12), the filtered covariance of the Kalman filter
                that gets all readings
    gains     : K^(i) = N P_inf H_i' R_i^-1, (n, p_i) each, paper P (13)
    """

    mass: FloatArray
    number: FloatArray
    weight: FloatArray
    G: FloatArray
    N: int
    P: FloatArray
    gains: tuple[FloatArray, ...]


def push_sum_limits(scenario: Scenario) -> PushSumLimits:
    """Return the limits, by node, of the push-sum masses and of the gains (n, p) that follow from
    them: of P Theorem 1 of the push-sum paper, and of its Theorem 2 (in probability) for failing
    links.

    Theorem 2 needs links that fail in both directions together. F, Q, H and R are those that the
    filters assume. Raises TheoryError if the graph is not connected or P_inf does not exist, for
    sensors whose H varies, and for scenarios without the push-sum filter.
    """
    push_sum_filter(scenario)
    scenario = scenario_of_estimates(scenario)
    if any(sensor.varying for sensor in scenario.sensors):
        raise TheoryError(
            "the sensors' H differs from slot to slot: their information has no limit"
        )
    component_count = len(scenario.topology.components)
    if component_count > 1:
        raise TheoryError(f"the graph must be connected, it has {component_count} parts")
    models, degrees = scenario.slot_models, scenario.topology.degrees
    # A node splits its mass into degree + 1 shares, one for each neighbour and one for itself, so
    # that the stationary weight is proportional to that, P (18).
    share = np.array([degrees[node] + 1.0 for node in scenario.nodes])
    share /= share.sum()
    # H_i' R_i^-1, whose products with H_i sum to G, P (10)
    weighted_H = [np.linalg.solve(m.R, m.H).T for m in models]
    G = symmetric(np.sum([e @ m.H for e, m in zip(weighted_H, models, strict=True)], axis=0))
    pooled, N = scenario.pooled_slot_model, len(models)
    P = filtered_covariance(pooled.F, pooled.Q, pooled.H, pooled.R)
    # P (13)
    gains = tuple(N * P @ e for e in weighted_H)
    return PushSumLimits(share[:, None, None] * G, share * N, share, G, N, P, gains)


def push_sum_filter(scenario: Scenario) -> Any:
    """Return the filter; TheoryError unless it is push-sum with all equations as built in."""
    algorithm: Any = scenario.filter.algorithm
    name, built_in = type(algorithm).__name__, built_in_filters()["push-sum"]
    if not isinstance(algorithm, built_in):
        raise TheoryError(f"this is about the push-sum filter, and the scenario's is {name}")
    overridden_names = overridden(algorithm, built_in)
    if overridden_names:
        raise TheoryError(
            f"this is about the push-sum filter, and {name} defines {overridden_names[0]} itself"
        )
    return algorithm


class GainBound(NamedTuple):
    """Three lower bounds on the consensus gain delta, the sharpest first.

    radius : rho(L) of the Laplacian; P Theorems 3 to 6 need delta above it, and averaging contracts
             for delta above half of it
    local  : largest sum over a link of its ends' degrees, at least rho(L); nodes can find it alone
    nodes  : N, at least rho(L)
    """

    radius: float
    local: int
    nodes: int


def consensus_gain_bound(graph: Scenario | Topology) -> GainBound:
    """Return three lower bounds on the consensus gain delta of averaging steps z <- (I - L / delta)
    z: the spectral radius rho(L) of the graph's Laplacian, and two upper bounds on it.

    The largest degree of a node, or that plus one as in the push-sum paper, lies *below* rho(L) on
    every graph with a link. Raises TheoryError for directed graphs.
    """
    topology = topology_of(graph)
    if topology.directed:
        raise TheoryError("the graph must be undirected")
    N, degrees = len(topology.nodes), topology.degrees
    local = max((degrees[i] + degrees[j] for i, j in topology.links), default=0)
    return GainBound(topology.laplacian_radius, local, N)
