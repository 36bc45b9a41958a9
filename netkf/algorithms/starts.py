"""Checks of the first estimates of filters whose nodes know how the errors of others correlate."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError


def require_common_start(scenario: Any, why: str, other: str) -> None:
    """Raise ScenarioError unless all nodes of a ``netkf.Scenario`` start with one mean and one
    covariance. The message ends with the reason ``why`` they must, and names the ``other`` filter
    that does not need it.
    """
    starts = [scenario.initial_estimate(node) for node in scenario.nodes]
    mean, cov = starts[0]
    if all(np.array_equal(m, mean) and np.array_equal(C, cov) for m, C in starts):
        return
    raise ScenarioError(
        "filter.mean",
        f"must be that of all nodes, and cov too, {why}",
        "several",
        f"give one mean and cov, or use {other}",
    )
