"""Exact errors of the diffusion Kalman filter along the messages of a run."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

from netkf.algorithms.diffusion_kalman import READINGS
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors, Term
from netkf.trace.run import Run


class DiffusionKalmanRule(ErrorRule):
    """Incremental update with the readings of the neighbourhood, then the convex combination of
    estimates, which leaves P as it is.
    """

    def __init__(self, scenario: Scenario, errors: StackedErrors) -> None:
        super().__init__(scenario, errors)
        self._observations: EstimatorObservations = {}
        self._columns: dict[int, slice] = {}

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update by the nodes' own readings of the slot ``time``, and keep them for their
        neighbours. Called by the replay at every time of readings.
        """
        self._observations, self._columns = observations, self.errors.reading_noises(observations)
        for estimator, observation in observations.items():
            self.errors.update(estimator, observation, self._columns[estimator])

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Use the readings that arrived (``phase`` READINGS), or combine the estimates (the other
        phase); changes errors and, with readings, roots of P of the receivers. Called by the replay
        for each exchange of a slot.
        """
        if phase == READINGS:
            for message in messages:
                observation, columns = (
                    self._observations[message.sender],
                    self._columns[message.sender],
                )
                self.errors.update(message.receiver, observation, columns)
            return
        nodes, eye = self.scenario.nodes, np.eye(self.errors.n)
        weights: dict[int, dict[int, float]] = {}
        for message in messages:
            weight = self.scenario.weight(nodes[message.receiver], nodes[message.sender])
            weights.setdefault(message.receiver, {})[message.sender] = weight
        changes: dict[Hashable, tuple[FloatArray, Sequence[Term]]] = {}
        for estimator, heard in weights.items():
            # The weight of what did not come stays with the node.
            terms: list[Term] = [(estimator, (1.0 - sum(heard.values())) * eye)]
            terms += [(sender, weight * eye) for sender, weight in heard.items()]
            changes[estimator] = self.errors.roots[estimator], terms
        self.errors.combine(changes)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the diffusion Kalman filter uses the readings and messages of a run.
    The replay of the run, which computes its exact errors from its events, calls the rule at each
    event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    return DiffusionKalmanRule(scenario, errors)
