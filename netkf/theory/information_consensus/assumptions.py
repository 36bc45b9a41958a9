"""Assumptions under which P of consensus on information is no smaller than the covariance of the
error.

With weights that sum to one, ``sum_j a_ij P_j^-1`` of consistent pairs is consistent whatever their
correlation (Julier and Uhlmann, ACC 1997). Readings have independent noises, and count rightly as
long as none counts more than once: with A the weights of all steps together and omega the novelty
weight, omega a_ij <= 1 (derived; at omega = N that needs all a_ij = 1/N).
"""

from __future__ import annotations

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
    steps, delay = scenario.node_filter.timing.steps(0), scenario.network.channel.delay.fixed
    # Each of the steps has its share of the phase; at the end of it a message may be late.
    in_time = delay is not None and (delay == 0.0 or steps * delay < scenario.phase_length)
    lossless = in_time and nothing_is_lost(scenario)
    # A node that hears nothing counts its own reading in full, whatever the weights.
    max_count = float(reading_counts(scenario, steps if lossless else 0).max())
    often = f"{max_count:.4g} times"
    evidence = f"a node counts a reading {'once' if often == '1 times' else f'up to {often}'}"
    if not lossless:
        evidence += ": its own, in slots in which it hears nothing"
    return max_count <= 1.0 + TOLERANCE, evidence


def reading_counts(scenario: Scenario, steps: int) -> FloatArray:
    """Return how often i counts the reading of j, (N, N), after so many steps without a loss."""
    algorithm: Any = scenario.node_filter
    index, N = scenario.topology.index, len(scenario.nodes)
    heard = np.zeros((N, N))
    for sender, receiver in scenario.topology.directions:
        heard[index[receiver], index[sender]] = scenario.weight(receiver, sender)
    # A node gives the rest of its weight to its own pair.
    mixing = heard + np.diag(np.maximum(1.0 - heard.sum(axis=1), 0.0))
    # A node averages K pairs, each a multiple (``shares``) of the information of its prediction and
    # of its reading. The estimate is the sum of these pairs and of the node's own prediction, each
    # times its entry of ``counts``.
    shares, counts = algorithm.recipe(N)
    return np.asarray((counts[:-1] @ shares)[1] * np.linalg.matrix_power(mixing, steps))
