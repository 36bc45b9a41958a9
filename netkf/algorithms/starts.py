"""Checks of the first estimates in a scenario, for filters whose nodes compute how the errors of
other nodes correlate with theirs, which is known only if all start alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError


def require_common_start(scenario: Any, why: str, other: str) -> None:
    """Raise ScenarioError unless all nodes of a ``netkf.Scenario`` start with the same mean and the
    same covariance. ``why``, the reason, ends the rule in the message; ``other`` names a filter
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
