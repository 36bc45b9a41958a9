"""Assumptions under which P of consensus on information is no smaller than the covariance of the
error.

With weights that sum to one, ``sum_j a_ij P_j^-1`` of consistent pairs is consistent whatever their
correlation (Julier and Uhlmann, ACC 1997). Readings have independent noises, and count rightly as
long as none counts more than once: with A the weights of all steps together and omega the novelty
weight, omega a_ij <= 1 (derived; at omega = N that needs all a_ij = 1/N).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow
from netkf.theory.common.plant_assumptions import model_and_start_rows
from netkf.theory.common.random_links import nothing_is_lost

SOURCE = "Battistelli and Chisci 2014"
ONCE = "no reading counts more than once"
TOLERANCE = 1e-12  # of a count: rounding of products of weights


def slot_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the assumptions about model, weights of readings and first covariances as rows."""
    once: AssumptionRow = (ONCE, "derived", *_judge_counts(scenario))
    return model_and_start_rows(scenario, SOURCE, once)


def _judge_counts(scenario: Scenario) -> tuple[bool, str]:
    weights, delay = step_weights(scenario), scenario.network.channel.delay.fixed
    steps = scenario.node_filter.timing.steps(0)
    # A node that hears nothing counts its own reading in full, whatever the weights.
    _, silent = effective_weights(scenario, [])
    # Each of the steps has its share of the phase; at the end of it a message may be late.
    in_time = delay is not None and (delay == 0.0 or steps * delay < scenario.phase_length)
    lossless = in_time and nothing_is_lost(scenario)
    if not lossless:
        max_count = float(silent.max())
        evidence = f"a node counts a reading up to {max_count:.4g} times: its own, in slots in "
        return max_count <= 1.0 + TOLERANCE, f"{evidence}which it hears nothing"
    _, counts = effective_weights(scenario, [weights] * steps)
    max_count = float(np.max(counts))
    return max_count <= 1.0 + TOLERANCE, f"a node counts a reading up to {max_count:.4g} times"


def step_weights(scenario: Scenario) -> FloatArray:
    """Return the weights (N, N) that nodes (rows) give to the messages of others (columns)."""
    index = scenario.topology.index
    weights = np.zeros((len(index), len(index)))
    for sender, receiver in scenario.topology.directions:
        weights[index[receiver], index[sender]] = scenario.weight(receiver, sender)
    return weights


def effective_weights(
    scenario: Scenario, weights: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return how often i counts prediction and reading of j, (N, N) each, by ``weights``."""
    algorithm: Any = scenario.node_filter
    N = len(scenario.nodes)
    mixing = np.eye(N)
    for heard in weights:
        # A node gives the weight of lost messages to its own pair.
        mixing = (heard + np.diag(np.maximum(1.0 - heard.sum(axis=1), 0.0))) @ mixing
    # A node averages K pairs, each a multiple (``shares``) of the information of its prediction and
    # of its reading. The estimate is the sum of these pairs and of the node's own prediction, each
    # times its entry of ``counts``.
    shares, counts = algorithm.recipe(N)
    times = counts[:-1] @ shares
    return times[0] * mixing + counts[-1] * np.eye(N), times[1] * mixing
