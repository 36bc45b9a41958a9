"""Equations of the filter with constant gains, whose P bounds the covariance of its error."""

from __future__ import annotations

from netkf.checks.clocked import PROMISES, UPPER_BOUND
from netkf.checks.evidence import Promise
from netkf.checks.kalman_consensus import EquationChecks
from netkf.scenario.scenario import Scenario


class ConstantGainChecks(EquationChecks):
    """Equations, and H (10), which holds for any gains."""

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return (*PROMISES[:1], UPPER_BOUND, *PROMISES[1:])


CHECKS = ConstantGainChecks()
