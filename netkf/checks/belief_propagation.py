"""Promises about belief propagation: on trees P is the covariance of the error."""

from __future__ import annotations

import dataclasses

from netkf.checks.clocked import PROMISES, REACH
from netkf.checks.evidence import Promise
from netkf.checks.kalman_consensus import EquationChecks
from netkf.checks.track_fusion import EXACT
from netkf.scenario.scenario import Scenario

ON_TREES = dataclasses.replace(
    EXACT,
    source="Weiss and Freeman 2001, derived",
    needs=("the filters know", "the graph has no loops", "the filters start", REACH),
)


class BeliefChecks(EquationChecks):
    """Equations, and P on trees."""

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return (*PROMISES[:1], ON_TREES, *PROMISES[1:])


CHECKS = BeliefChecks()
