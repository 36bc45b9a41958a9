"""The assumptions of H about the weights of a filter."""

from __future__ import annotations

from netkf.algorithms.hybrid import Hybrid
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import AssumptionRow


def weight_rows(scenario: Scenario) -> list[AssumptionRow]:
    """(assumption, source, holds, evidence): Pi = I - epsilon L is doubly stochastic, H (5)."""
    algorithm = scenario.filter.algorithm
    assert isinstance(algorithm, Hybrid)
    epsilon = algorithm.epsilon
    most = max(scenario.topology.degrees.values())
    low = 1.0 - epsilon * most
    return [
        (
            "Pi is doubly stochastic, 0 < epsilon <= 1/max degree",
            "H (5)",
            low >= -1e-12,
            f"epsilon {epsilon:g}, largest degree {most}, least diagonal entry {low:.3g}",
        )
    ]
