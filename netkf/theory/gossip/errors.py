"""Exact errors of the gossip filter along the messages of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.error_rules import ErrorRule, EstimateExchangeRule, SentMessage
from netkf.theory.common.stacked_errors import StackedErrors
from netkf.trace.run import Run


class SwapRule(EstimateExchangeRule):
    """The swap G (10): the last pair (xhat, P) to arrive replaces the node's own."""

    def combine(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Return how a node combines its estimate with messages: the root (n, n) of P of the last
        message, and the factors (J, n, n) of the J errors: the identity for the last one, zero for
        all others.

        ``roots`` are J roots (n, n) of P: that of the ``node`` first, then those of the messages,
        whose ``weights`` have no meaning here. Called by the replay for every receiver at every
        arrival.
        """
        n, others = self.errors.n, len(roots) - 1
        return roots[-1], np.concatenate([np.zeros((others, n, n)), np.eye(n)[None]])


def error_rule(
    scenario: Scenario, errors: StackedErrors, run: Run, messages: Sequence[SentMessage]
) -> ErrorRule:
    """Return the rule by which the gossip filter uses the readings and messages of a run. The
    replay of the run, which computes its exact errors from its events, calls the rule at each
    event; it changes ``errors``, the stacked errors of all nodes.

    ``messages`` are those of the run that arrived (none in slots, where the rule gets them slot by
    slot).
    """
    return SwapRule(scenario, errors)
