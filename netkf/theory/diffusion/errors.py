"""The errors of the diffusion filter along the messages of a run."""

from __future__ import annotations

from collections.abc import Sequence

from netkf.algorithms.diffusion import DiffusionFilter
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.rules import Estimates, Rule, Sent
from netkf.theory.common.stacked_errors import Errors
from netkf.theory.numerics.moves import intersected
from netkf.trace.run import Run


class Diffuses(Estimates):
    """D (8), (9) with the weights of what arrived."""

    def combined(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """The shares sum to 1."""
        algorithm = self.scenario.filter.algorithm
        assert isinstance(algorithm, DiffusionFilter)
        own, heard = algorithm.share(self.scenario.own_weights[node], weights)
        return intersected([own, *heard], roots)


def rule(scenario: Scenario, errors: Errors, run: Run, messages: Sequence[Sent]) -> Rule:
    """The moves of this filter along the messages of a run."""
    return Diffuses(scenario, errors)
