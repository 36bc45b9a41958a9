"""Promises about consensus on information (HCMCI, CM, CI and ICF) in slots."""

from __future__ import annotations

from typing import ClassVar

from netkf.checks.clocked import PROMISES, REACH
from netkf.checks.evidence import Assumption, Promise
from netkf.checks.exact import check_upper_bound, few_errors
from netkf.checks.laws import exact_start
from netkf.checks.paper import PaperChecks
from netkf.scenario.scenario import Scenario

CONSISTENT = Promise(
    "P is at least the covariance of the error, given the events",
    "Battistelli and Chisci 2014, derived",
    ("the filters know", "no reading counts more than once", "P_i(0) >=", REACH),
    check_upper_bound,
    exact=True,
)


class ConsensusChecks(PaperChecks):
    """Equations of the filters, and consistency where no reading counts more than once."""

    slots_only: ClassVar[bool] = True

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests."""
        return [exact_start(scenario), few_errors(scenario)]

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return (*PROMISES[:1], CONSISTENT, *PROMISES[1:])


CHECKS = ConsensusChecks()
