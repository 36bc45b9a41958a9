"""The check of wide first covariances, which are lost in rounding of information matrices."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError, TheoryError
from netkf.linalg.arrays import square_root

NOTED_CONDITION, MAX_CONDITION = 1e9, 1e14
"""Condition of the information after the first readings from which on a note says what rounding
does, and beyond which nothing but rounding is left of the first covariance."""


def check_information(scenario: Any) -> None:
    """Raise ScenarioError if the filter of a ``netkf.Scenario``, which in slots adds information
    matrices of readings to P^-1, would lose P^-1 in their rounding.
    """
    condition = _information_condition(scenario)
    if condition > MAX_CONDITION:
        raise ScenarioError(
            "filter.cov",
            f"must be at most {MAX_CONDITION:g} times as wide as readings are precise, because the "
            "filter adds up information matrices, in whose rounding a wider one is lost",
            condition,
            "give a narrower filter.cov, or use diffusion-kalman or local, which keep it",
        )


def information_notes(scenario: Any) -> tuple[str, ...]:
    """Return a line on how much rounding moves estimates, if it is much."""
    condition = _information_condition(scenario)
    if condition <= NOTED_CONDITION:
        return ()
    share = float(np.finfo(float).eps) * condition
    return (
        f"filter.cov is {condition:.1g} times as wide as readings are precise: the filter adds up "
        f"information matrices, whose rounding moves the first estimates by up to {share:.1g} of "
        "their size",
    )


def _information_condition(scenario: Any) -> float:
    """Return the largest condition of ``I + S' G S`` over the nodes of a scenario in slots."""
    if not scenario.slotted or not scenario.plant.linear:
        return 1.0
    try:
        pairs = [scenario.observation_matrices(i, believed=True) for i in scenario.sensing_nodes]
    except TheoryError:
        return 1.0
    n = scenario.plant.n
    # Such filters estimate one state at all nodes.
    G = sum((H.T @ np.linalg.solve(R, H) for H, R in pairs), np.zeros((n, n)))
    G = scenario.estimated_part(0, G)
    F, Q = scenario.estimated_pieces[0][0]
    covs = {cov.tobytes(): cov for _, cov in map(scenario.initial_estimate, scenario.nodes)}
    largest = 1.0
    for cov in covs.values():
        S = square_root(F @ cov @ F.T + Q)
        gains = np.maximum(np.linalg.eigvalsh(S.T @ G @ S), 0.0)
        largest = max(largest, float((1.0 + gains[-1]) / (1.0 + gains[0])))
    return largest
