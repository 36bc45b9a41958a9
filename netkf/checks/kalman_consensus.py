"""Equations of the Kalman-consensus filter, whose P is no bound on its error."""

from __future__ import annotations

from netkf.checks.clocked import PROMISES
from netkf.checks.evidence import Assumption, Promise
from netkf.checks.exact import few_errors
from netkf.checks.laws import exact_start
from netkf.checks.paper import PaperChecks
from netkf.scenario.scenario import Scenario


class EquationChecks(PaperChecks):
    """Equations of a filter, in slots and under clocks."""

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests."""
        return [exact_start(scenario), few_errors(scenario)]

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return PROMISES


CHECKS = EquationChecks()
