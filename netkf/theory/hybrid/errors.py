"""The errors of the hybrid filter and of covariance intersection along the messages of a run."""

from __future__ import annotations

from collections.abc import Sequence

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.rules import Estimates, Rule, Sent
from netkf.theory.common.stacked_errors import Errors
from netkf.theory.numerics.moves import convex, intersected
from netkf.trace.run import Run


class Resets(Estimates):
    """H (7), (9), and D (8), (9) for covariance intersection."""

    def combined(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """The weight that is left is the node's own."""
        all_weights = [1.0 - sum(weights), *weights]
        if self.scenario.hosted.combination == "intersection":
            return intersected(all_weights, roots)
        return convex(all_weights, roots)


def rule(scenario: Scenario, errors: Errors, run: Run, messages: Sequence[Sent]) -> Rule:
    """The moves of this filter along the messages of a run."""
    return Resets(scenario, errors)
