"""Assumptions that several papers share: about the plant in slots, and about how filters start."""

from __future__ import annotations

import numpy as np

from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import Row, knowledge, of_the_truth
from netkf.theory.intermittent.riccati import unseen


def slot_plant_rows(scenario: Scenario) -> list[Row]:
    """Rows about F and Q, G S.1 and R Theorem 9."""
    plant = scenario.slot_plant
    least = float(np.linalg.eigvalsh(plant.Q)[0])
    idle = unseen(plant.F.T, plant.Q)
    words = "every mode that does not decay is driven by the noise"
    if idle is not None:
        words = f"the mode with eigenvalue {idle:.6g} is not driven"
    positive = f"least eigenvalue {least:.3g}; sufficient for the uniqueness of the limit law"
    return [
        (
            "(F, Q^1/2) is stabilisable",
            "G S.1, R Theorem 9",
            *of_the_truth(scenario, idle is None, words),
        ),
        (
            "Q is positive definite",
            "G II-A, R Theorem 9",
            *of_the_truth(scenario, least > 0.0, positive),
        ),
        knowledge(scenario, "G (10), R (15)", "same F, Q and R"),
    ]


def start_rows(scenario: Scenario, source: str) -> list[Row]:
    """A row: the first covariances of the filters are at least those of their errors."""
    plant, worst = scenario.plant, np.inf
    for node in scenario.nodes:
        mean, cov = scenario.start(node)
        offset = plant.start_mean - mean
        gap = cov - plant.start_cov - np.outer(offset, offset)
        worst = min(worst, float(np.linalg.eigvalsh(gap)[0]) / max(1.0, np.abs(cov).max()))
    return [
        (
            "P_i(0) >= E[(x(0) - xhat_i(0))(x(0) - xhat_i(0))']",
            source,
            *of_the_truth(
                scenario, worst >= -1e-12, f"least eigenvalue of the difference {worst:.3g}"
            ),
        )
    ]
