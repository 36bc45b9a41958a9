"""Promises about consensus plus innovations: P is the error's covariance if nothing is lost."""

from __future__ import annotations

import dataclasses

from netkf.checks.clocked import PROMISES, REACH
from netkf.checks.evidence import Promise
from netkf.checks.kalman_consensus import EquationChecks
from netkf.checks.track_fusion import EXACT
from netkf.scenario.scenario import Scenario

WITHOUT_LOSSES = dataclasses.replace(
    EXACT,
    source="Das and Moura 2017",
    needs=("the filters know", "no message is lost", "the filters start", REACH),
)


class PseudoStateChecks(EquationChecks):
    """Equations, and P where every message arrives."""

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return (*PROMISES[:1], WITHOUT_LOSSES, *PROMISES[1:])


CHECKS = PseudoStateChecks()
