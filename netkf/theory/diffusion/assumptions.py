"""Assumptions of D on a scenario, with evidence; those of the theorems are sufficient."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import is_definite
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import (
    UNKNOWN_LAW,
    AssumptionRow,
    lacks_channel_law,
    no_channel_law,
)
from netkf.theory.common.plant_assumptions import start_rows
from netkf.theory.common.random_links import all_messages_arrive
from netkf.theory.diffusion.information import MAX_REGRESSORS, few_regressors, information_level

MAX_NODES = 2000  # of a network whose diameter is computed, from the distances of all pairs


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions of the diffusion paper as rows of the table."""
    return [
        *_weight_rows(scenario),
        *_plant_rows(scenario),
        _information_row(scenario),
        _arrival_row(scenario),
        *start_rows(scenario, "P_i consistent from the start; D does without"),
    ]


def sparse_weights(scenario: Scenario) -> scipy.sparse.csr_array:
    """Return the weights W (N, N), sparse, D (8): node i gives W[l, i] to the estimate of l."""
    index, own_weights = scenario.topology.index, scenario.own_weights
    size, directions = len(scenario.nodes), scenario.topology.directions
    rows = [*range(size), *(index[sender] for sender, _ in directions)]
    columns = [*range(size), *(index[receiver] for _, receiver in directions)]
    # Columns sum to 1: a node divides one unit of weight among itself and its neighbours.
    values = [own_weights[node] for node in scenario.nodes]
    values += [scenario.weight(receiver, sender) for sender, receiver in directions]
    matrix = scipy.sparse.coo_array((values, (rows, columns)), shape=(size, size))
    return scipy.sparse.csr_array(matrix)


def _weight_rows(scenario: Scenario) -> list[AssumptionRow]:
    W = sparse_weights(scenario)
    W.eliminate_zeros()
    unbalanced = float(np.abs(W.sum(axis=1) - 1.0).max())
    component_count, _ = scipy.sparse.csgraph.connected_components(W, connection="strong")
    connected: bool | None = component_count == 1
    evidence = "some node never hears of another one; each part runs by itself"
    if connected:
        connected, evidence = _judge_mixing(W)
    return [
        (
            "the weights are balanced (rows and columns sum to 1)",
            "D Assumption 3.1",
            unbalanced <= 1e-9,
            f"rows are off by up to {unbalanced:.3g}; columns always sum to 1, which is all that "
            "consistency needs",
        ),
        ("the digraph is strongly connected", "D Assumption 3.1", connected, evidence),
    ]


def _judge_mixing(W: scipy.sparse.csr_array) -> tuple[bool | None, str]:
    """Return whether some power of W (N, N) is positive (None: not known), and why."""
    if len(W.indptr) - 1 > MAX_NODES:
        positive = bool((W.diagonal() > 0.0).all())  # sufficient: every node keeps a share
        share = "; all nodes give themselves a weight" if positive else ""
        evidence = f"the diameter is not computed beyond {MAX_NODES:,} nodes{share}"
        return positive or None, evidence
    # scipy 1.13 searches graphs with 32-bit indices only.
    indices, indptr = W.indices.astype(np.int32), W.indptr.astype(np.int32)
    graph = scipy.sparse.csr_array((W.data, indices, indptr), shape=W.shape)
    distances = scipy.sparse.csgraph.shortest_path(graph, method="D", unweighted=True)
    # D needs W^l > 0 for some l; with positive own weights the diameter suffices.
    diameter = int(distances.max())
    smallest = float(np.linalg.matrix_power(W.toarray(), max(diameter, 1)).min())
    evidence = f"diameter {diameter}; least entry of the weights to that power {smallest:.3g}"
    if not smallest > 0.0:
        evidence += ": D Remark 3.3 needs positive own weights"
    return smallest > 0.0, evidence


def _plant_rows(scenario: Scenario) -> list[AssumptionRow]:
    plant = scenario.linear_plant
    F, Q = scenario.slot_belief
    smallest = float(np.linalg.eigvalsh(Q)[0])
    random_walk = bool(np.array_equal(plant.F, np.eye(plant.n)) and np.array_equal(F, plant.F))
    same = scenario.filters_know_the_truth
    return [
        (
            "the parameter is a random walk: F = I",
            "D (2)",
            random_walk if scenario.plant.is_random else None,
            UNKNOWN_LAW
            if not scenario.plant.is_random
            else "increments and noises are Gaussian and independent, so bounded in every L_p, as "
            "D (29) asks"
            if random_walk
            else "with another F the filter predicts by it; D's theorems are not about that",
        ),
        (
            "the filters' Q and r are positive definite",
            "D Algorithm 1",
            bool(is_definite(Q)),
            f"least eigenvalue of Q {smallest:.3g}; they are the true ones"
            if same
            else f"least eigenvalue of Q {smallest:.3g}; {UNKNOWN_LAW}"
            if not scenario.is_random
            else f"least eigenvalue of Q {smallest:.3g}; they differ from the true ones, as D "
            "allows: stable all the same, but P need not be the errors' covariance",
        ),
    ]


def _information_row(scenario: Scenario) -> AssumptionRow:
    name = "the sensors together excite every direction (sufficient)"
    if not few_regressors(scenario):
        evidence = f"not computed beyond {MAX_REGRESSORS} sensors whose H varies"
        return (name, "D Assumption 3.2", None, evidence)
    try:
        table = information_level(scenario)
    except TheoryError as error:
        return (name, "D Assumption 3.2", None, f"not decided: {error}")
    network, sensors = table.iloc[0], table.iloc[1:]
    sufficient_count = int((sensors["level"] > 0.0).sum())
    evidence = (
        f"least level of D (19) over the pasts examined {network['level']:.3g}, in the mean "
        f"{network['mean']:.3g}, with windows of {int(network['window'])}; "
        f"{sufficient_count} of {len(sensors)} sensors would do alone"
    )
    if network["level"] == 0.0 and network["mean"] > 0.0:
        evidence += "; some pasts say nothing about the next window: "
        evidence += "the mean decides, which is not examined"
    return (name, "D Assumption 3.2", bool(network["level"] > 0.0), evidence)


def _arrival_row(scenario: Scenario) -> AssumptionRow:
    name, source = "every message arrives", "D (8)"
    if lacks_channel_law(scenario):
        return name, source, None, no_channel_law(scenario)
    if all_messages_arrive(scenario):
        return name, source, True, "every one in time"
    algorithm: Any = scenario.filter.algorithm
    evidence = (
        f"a message may be lost or late; weights then change ({algorithm.on_loss}): P stays "
        "consistent, but D's theorems are about fixed weights"
    )
    return name, source, False, evidence
