"""The assumptions of D about a scenario, with evidence; those of the theorems are sufficient."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import RECORDED_CHANNEL, UNKNOWN_LAW, AssumptionRow, is_recorded
from netkf.theory.common.plant_assumptions import start_rows
from netkf.theory.diffusion.information import (
    MAX_REGRESSORS,
    few_regressors,
    information_level,
)

MAX_NODES = 2000  # of a network whose diameter is computed, from the distances of all pairs


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """(assumption, source, holds, evidence) of each assumption."""
    return [
        *_weights(scenario),
        *_plant(scenario),
        _information(scenario),
        _arrivals(scenario),
        *start_rows(scenario, "P_i consistent from the start; D does without"),
    ]


def weight_matrix(scenario: Scenario) -> FloatArray:
    """(N, N): the weights of D (8), see :func:`sparse_weights`."""
    return np.asarray(sparse_weights(scenario).toarray())


def sparse_weights(scenario: Scenario) -> scipy.sparse.csr_array:
    """(N, N) sparse: [l, i] is the weight node i gives to what l sends when all arrives, D (8)."""
    index, own = scenario.topology.index, scenario.own_weights
    size, ways = len(scenario.nodes), scenario.topology.directions
    rows = [*range(size), *(index[sender] for sender, _ in ways)]
    columns = [*range(size), *(index[receiver] for _, receiver in ways)]
    values = [own[node] for node in scenario.nodes]
    values += [scenario.weight(receiver, sender) for sender, receiver in ways]
    matrix = scipy.sparse.coo_array((values, (rows, columns)), shape=(size, size))
    return scipy.sparse.csr_array(matrix)


def _weights(scenario: Scenario) -> list[AssumptionRow]:
    W = sparse_weights(scenario)
    W.eliminate_zeros()
    unbalanced = float(np.abs(W.sum(axis=1) - 1.0).max())
    parts, _ = scipy.sparse.csgraph.connected_components(W, connection="strong")
    joined: bool | None = parts == 1
    words = "some node never hears of another one; each part runs by itself"
    if joined:
        joined, words = _mixes(W)
    return [
        (
            "the weights are balanced (rows and columns sum to 1)",
            "D Assumption 3.1",
            unbalanced <= 1e-9,
            f"rows are off by up to {unbalanced:.3g}; columns always sum to 1, which is all that "
            "consistency needs",
        ),
        ("the digraph is strongly connected", "D Assumption 3.1", joined, words),
    ]


def _mixes(W: scipy.sparse.csr_array) -> tuple[bool | None, str]:
    """Whether W to the power of the diameter is positive, in a strongly connected network."""
    if len(W.indptr) - 1 > MAX_NODES:
        positive = bool((W.diagonal() > 0.0).all())  # sufficient: every node keeps a share
        words = f"the diameter is not computed beyond {MAX_NODES:,} nodes"
        return (True, f"{words}; all nodes give themselves a weight") if positive else (None, words)
    distances = scipy.sparse.csgraph.shortest_path(W, method="D", unweighted=True)
    diameter = int(distances.max())
    least = float(np.linalg.matrix_power(W.toarray(), max(diameter, 1)).min())
    words = f"diameter {diameter}; least entry of the weights to that power {least:.3g}"
    if not least > 0.0:
        words += ": D Remark 3.3 needs weights of one's own"
    return least > 0.0, words


def _plant(scenario: Scenario) -> list[AssumptionRow]:
    plant = scenario.slot_plant
    F, Q = scenario.slot_belief
    least = float(np.linalg.eigvalsh(Q)[0])
    walks = bool(np.array_equal(plant.F, np.eye(plant.n)) and np.array_equal(F, plant.F))
    same = scenario.filters_know_the_truth
    return [
        (
            "the parameter is a random walk: F = I",
            "D (2)",
            walks if scenario.plant.is_random else None,
            UNKNOWN_LAW
            if not scenario.plant.is_random
            else "increments and noises are Gaussian and independent, so bounded in every L_p, as "
            "D (29) asks"
            if walks
            else "with another F the filter predicts by it; D's theorems are not about that",
        ),
        (
            "the filters' Q and r are positive definite",
            "D Algorithm 1",
            least > 0.0,
            f"least eigenvalue of Q {least:.3g}; they are the true ones"
            if same
            else f"least eigenvalue of Q {least:.3g}; {UNKNOWN_LAW}"
            if not scenario.is_random
            else f"least eigenvalue of Q {least:.3g}; they differ from the true ones, as D allows: "
            "stable all the same, but P need not be the errors' covariance",
        ),
    ]


def _information(scenario: Scenario) -> AssumptionRow:
    name = "the sensors together excite every direction (sufficient)"
    if not few_regressors(scenario):
        words = f"not looked at beyond {MAX_REGRESSORS} sensors whose H varies"
        return (name, "D Assumption 3.2", None, words)
    try:
        table = information_level(scenario)
    except TheoryError as error:
        return (name, "D Assumption 3.2", None, f"not decided: {error}")
    whole, alone = table.iloc[0], table.iloc[1:]
    enough = int((alone["level"] > 0.0).sum())
    words = (
        f"least level of D (19) over the pasts looked at {whole['level']:.3g}, in the mean "
        f"{whole['mean']:.3g}, with windows of {int(whole['window'])}; "
        f"{enough} of {len(alone)} sensors would do alone"
    )
    if whole["level"] == 0.0 and whole["mean"] > 0.0:
        words += "; some pasts tell nothing of the next window: the mean decides, not looked into"
    return (name, "D Assumption 3.2", bool(whole["level"] > 0.0), words)


def _arrivals(scenario: Scenario) -> AssumptionRow:
    channel = scenario.network.channel
    rates = [
        channel.loss.mean_delivery(link, scenario.table_probability(link))
        for link in scenario.topology.directions
    ]
    fixed = channel.delay.fixed
    in_time = fixed is not None and fixed < scenario.phase_length
    if is_recorded(channel):
        return ("every message arrives", "D (8)", None, RECORDED_CHANNEL)
    whole = in_time and all(rate == 1.0 for rate in rates)
    policy = getattr(scenario.filter.algorithm, "on_loss", "")
    words = f"a message may be lost or late; weights then change ({policy}): P stays consistent"
    if not whole:
        words += ", but D's theorems are about fixed weights"
    return ("every message arrives", "D (8)", whole, "every one in time" if whole else words)
