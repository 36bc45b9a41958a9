"""Exact errors of the diffusion filter along the messages of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, EstimateExchangeRule, SentMessage
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.theory.numerics.updates import intersect_covariances
from netkf.trace.run import Run


class DiffusionRule(EstimateExchangeRule):
    """Covariance intersection D (8), (9) with the weights of the messages that arrived."""

    def combine(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the new root (n, n) of P and the factors (J, n, n) of the J errors, by covariance
        intersection.

        ``roots`` are J roots (n, n) of P: that of the ``node`` first, then those of the messages,
        whose ``weights`` are J - 1 numbers. Weights of lost messages are shared as the filter does,
        so that the weights sum to 1. Called by the replay for every receiver at every arrival.
        """
        algorithm: Any = self.scenario.filter.algorithm
        own, received = self.scenario.own_weights[node], math.fsum(weights)
        # "keep-own", or weights that are all 0: the own weight is 1 minus the others.
        if algorithm.on_loss == "keep-own" or own + received == 0.0:
            own = max(0.0, 1.0 - received)
        return intersect_covariances([w / (own + received) for w in (own, *weights)], roots)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the diffusion filter uses the readings and messages of a run. The
    replay of the run, which computes its exact errors from its events, calls the rule at each
    event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    return DiffusionRule(scenario, errors)
