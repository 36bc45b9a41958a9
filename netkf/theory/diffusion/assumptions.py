"""The assumptions of D about a scenario, with evidence; those of the theorems are sufficient."""

from __future__ import annotations

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import RECORDED_CHANNEL, UNKNOWN_LAW, AssumptionRow, is_recorded
from netkf.theory.common.plant_assumptions import start_rows
from netkf.theory.diffusion.information import information_level

MAX_NODES = 500


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
    """(N, N): entry [l, i] is the weight node i gives to what l sends when all arrives, D (8)."""
    index, own = scenario.topology.index, scenario.own_weights
    matrix = np.diag([own[node] for node in scenario.nodes])
    for sender, receiver in scenario.topology.directions:
        matrix[index[sender], index[receiver]] = scenario.weight(receiver, sender)
    return matrix


def _weights(scenario: Scenario) -> list[AssumptionRow]:
    W = weight_matrix(scenario)
    unbalanced = float(np.abs(W.sum(axis=1) - 1.0).max())
    diameter = _diameter(W > 0.0)
    joined = diameter is not None
    words = "some node never hears of another one; each part runs by itself"
    positive = True
    if diameter is not None:
        least = float(np.linalg.matrix_power(W, max(diameter, 1)).min())
        positive = least > 0.0
        words = f"diameter {diameter}; least entry of the weights to that power {least:.3g}"
        if not positive:
            words += ": D Remark 3.3 needs weights of one's own"
    return [
        (
            "the weights are balanced (rows and columns sum to 1)",
            "D Assumption 3.1",
            unbalanced <= 1e-9,
            f"rows are off by up to {unbalanced:.3g}; columns always sum to 1, which is all that "
            "consistency needs",
        ),
        ("the digraph is strongly connected", "D Assumption 3.1", joined and positive, words),
    ]


def _diameter(arcs: np.ndarray) -> int | None:
    """The longest distance between two nodes; None where there is no way between some two."""
    size = len(arcs)
    reached = np.eye(size, dtype=bool)
    step = arcs | reached
    for length in range(size):
        if reached.all():
            return length
        further = (reached.astype(np.float32) @ step.astype(np.float32)) > 0.0
        if (further == reached).all():
            return None
        reached = further
    return size if reached.all() else None


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
    if len(scenario.sensing) > MAX_NODES:
        return (name, "D Assumption 3.2", None, f"not looked at beyond {MAX_NODES} sensors")
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
