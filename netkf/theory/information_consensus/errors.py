"""Exact errors of consensus on information along the messages of a run.

In slots the steps of a slot multiply to one matrix A of weights (N, N), rows of which sum to one.
With it a node ends at the information ``sum_j a_ij P_j^-1 + sum_j b_ij G_j`` of predictions and
readings, where ``a`` and ``b`` are A times how often the filter counts each of them.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.arrivals import arrivals_by_step
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors, Term
from netkf.theory.hybrid.errors import ResetRule
from netkf.theory.numerics.prediction import triangular_root
from netkf.trace.run import Run


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
    """Return the weights (N, N) of the predictions and those of the readings (N, N) in the
    estimates after an exchange, in which nodes average pairs (information vector and matrix).

    Entry (i, j) is the number of times that node i counts the information of node j. ``weights``
    (N, N) of each step are those of the messages that arrived in it, 0 for others.
    """
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


class ConsensusRule(ErrorRule):
    """Consensus on the pairs of predictions and of readings, in slots."""

    takes_messages = False

    def __init__(self, scenario: Scenario, errors: StackedErrors, run: Run) -> None:
        super().__init__(scenario, errors)
        self._arrivals, self._weights = arrivals_by_step(scenario, run), step_weights(scenario)
        self._steps = scenario.node_filter.exchange_steps(0)
        self._observations: EstimatorObservations = {}

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Store the readings of the slot for ``exchange``. Called by the replay at every time of
        readings.
        """
        self._observations = observations

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Update all estimates by the predictions and readings with their weights in exchange
        ``phase`` of this ``slot``; changes errors and roots of P. Called by the replay for each
        exchange of a slot.
        """
        nothing = np.zeros_like(self._weights)
        heard = [
            self._weights * self._arrivals.get((slot, phase, step), nothing)
            for step in range(self._steps)
        ]
        of_predictions, of_readings = effective_weights(self.scenario, heard)
        errors, observations = self.errors, self._observations
        columns, estimators = errors.reading_noises(observations), range(errors.estimators)
        inverses = [np.linalg.inv(errors.roots[j]) for j in estimators]
        # R^-1/2 H of each reading, whose square is its information.
        white = {j: np.linalg.solve(np.linalg.cholesky(o.R), o.H) for j, o in observations.items()}
        changes: dict[Hashable, tuple[FloatArray, Sequence[Term]]] = {}
        for i in estimators:
            a, b = of_predictions[i], of_readings[i]
            rows = [np.sqrt(a[j]) * V for j, V in enumerate(inverses)]
            rows += [np.sqrt(b[j]) * V for j, V in white.items()]
            root = triangular_root(np.linalg.inv(np.linalg.qr(np.concatenate(rows), mode="r")))
            terms = [(j, a[j] * root @ root.T @ V.T @ V) for j, V in enumerate(inverses)]
            changes[i] = root, terms
        errors.combine(changes)
        for i in estimators:
            for j, observation in observations.items():
                # e+ = P (sum_j a_ij P_j^-1 e_j - sum_j b_ij H_j' R_j^-1 v_j)
                root, information = errors.roots[i], np.linalg.solve(observation.R, observation.H).T
                gain = of_readings[i, j] * root @ root.T @ information
                errors.stack.add(i, columns[j], -gain @ observation.root)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the filter by consensus on information uses the readings and
    messages of a run. The replay of the run, which computes its exact errors from its events, calls
    the rule at each event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    if not scenario.slotted:
        return ResetRule(scenario, errors)
    return ConsensusRule(scenario, errors, run)
