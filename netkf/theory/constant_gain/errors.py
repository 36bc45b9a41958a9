"""Exact errors of the filter with constant gains along the messages of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, EstimateExchangeRule, SentMessage
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.theory.numerics.prediction import triangular_root
from netkf.theory.numerics.updates import average_covariances
from netkf.trace.run import Run


class ConstantGainRule(EstimateExchangeRule):
    """Updates with the given gains, and the resets H (7), (9)."""

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Move the error of each estimator to ``(I - L H) e - L v``, with its gain L (n, p);
        changes its root of P with it. Called by the replay at every time of readings.
        """
        algorithm: Any = self.scenario.filter.algorithm
        errors = self.errors
        columns = errors.reading_noises(observations)
        for estimator, observation in observations.items():
            L = algorithm.gain_of(estimator)
            closed = np.eye(errors.n) - L @ observation.H
            noise = L @ np.linalg.cholesky(observation.R)
            root = triangular_root(
                np.concatenate([closed @ errors.roots[estimator], noise], axis=1)
            )
            errors.multiply(estimator, closed, root)
            errors.stack.add(estimator, columns[estimator], -L @ observation.root)

    def combine(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the new root (n, n) of P and the factors (J, n, n) of the J errors, by averaging
        covariances.

        ``roots`` are J roots (n, n) of P: that of the ``node`` first, then those of the messages,
        whose ``weights`` are J - 1 numbers; the node's own estimate has the weight 1 - sum of
        ``weights``. Called by the replay for every receiver at every arrival.
        """
        return average_covariances([1.0 - sum(weights), *weights], roots)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the filter with constant gains uses the readings and messages of a
    run. The replay of the run, which computes its exact errors from its events, calls the rule at
    each event; it changes ``errors``, the stacked errors of all nodes. Raises TheoryError for
    sensors that give increments.

    All filters' rules are made by a function with these arguments; ``messages``, those of the run
    that arrived, are not used here.
    """
    if not scenario.slotted and any(scenario.increment_sensors.values()):
        raise TheoryError("the exact errors with constant gains are known for sampled sensors")
    return ConstantGainRule(scenario, errors)
