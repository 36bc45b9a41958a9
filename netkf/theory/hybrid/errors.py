"""Exact errors of the hybrid filter and of covariance intersection along the messages of a run."""

from __future__ import annotations

from collections.abc import Sequence

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, EstimateExchangeRule, SentMessage
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.theory.numerics.updates import average_covariances, intersect_covariances
from netkf.trace.run import Run


class ResetRule(EstimateExchangeRule):
    """The reset of a node's estimate by messages: a weighted mean of estimates and of P, H (7), (9)
    of the hybrid paper, or covariance intersection, D (8), (9) of the diffusion paper.
    """

    def combine(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return the new root (n, n) of P and the factors (J, n, n) of the J errors, by averaging
        or intersection of covariances.

        ``roots`` are J roots (n, n) of P: that of the ``node`` first, then those of the messages,
        whose ``weights`` are J - 1 numbers; the node's own estimate has the weight 1 - sum of
        ``weights``. Called by the replay for every receiver at every arrival.
        """
        all_weights = [1.0 - sum(weights), *weights]
        if self.scenario.node_filter.combination == "intersection":
            return intersect_covariances(all_weights, roots)
        return average_covariances(all_weights, roots)


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the hybrid filter, or covariance intersection, uses the readings and
    messages of a run. The replay of the run, which computes its exact errors from its events, calls
    the rule at each event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    return ResetRule(scenario, errors)
