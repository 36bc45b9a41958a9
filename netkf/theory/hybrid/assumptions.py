"""Assumption of H on the weights of the reset."""

from __future__ import annotations

from typing import Any

from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow


def weight_rows(scenario: Scenario) -> list[AssumptionRow]:
    """Return the row: Pi = I - epsilon L is doubly stochastic, paper H (5)."""
    algorithm: Any = scenario.filter.algorithm
    epsilon = algorithm.epsilon
    degree = max(scenario.topology.degrees.values())
    diagonal = 1.0 - epsilon * degree
    return [
        (
            "Pi is doubly stochastic, 0 < epsilon <= 1/max degree",
            "H (5)",
            diagonal >= -1e-12,
            f"epsilon {epsilon:g}, largest degree {degree}, least diagonal entry {diagonal:.3g}",
        )
    ]
