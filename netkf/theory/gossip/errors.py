"""The errors of the gossip filter along the messages of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.rules import Estimates, Rule, Sent
from netkf.theory.common.stacked_errors import Errors
from netkf.trace.run import Run


class Swaps(Estimates):
    """G (10): what came last takes the place of the own pair."""

    def combined(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """One matrix is the identity."""
        n, others = self.errors.n, len(roots) - 1
        return roots[-1], [np.zeros((n, n))] * others + [np.eye(n)]


def rule(scenario: Scenario, errors: Errors, run: Run, messages: Sequence[Sent]) -> Rule:
    """The moves of this filter along the messages of a run."""
    return Swaps(scenario, errors)
