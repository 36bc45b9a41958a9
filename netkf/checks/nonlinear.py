"""Scenarios whose readings are not linear: their clocks, channels, noises and records are judged.

Gains, P and errors follow the data, so that no paper promises anything about them.
"""

from __future__ import annotations

from netkf.checks.evidence import Assumption, Finding, Promise, find_unknown
from netkf.checks.paper import PaperChecks
from netkf.checks.samples import RunSamples
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import NONLINEAR

LINEAR = "readings are linear in the state"


def _unknown(samples: RunSamples, level: float) -> Finding:
    """Return that nothing is compared: the assumption of the promise fails before it is tested."""
    return find_unknown(NONLINEAR)


class NonlinearChecks(PaperChecks):
    """One row that says why the papers promise nothing; the parts are judged as everywhere."""

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumption that fails."""
        return [Assumption(LINEAR, "all papers", False, NONLINEAR)]

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promise that papers make of filters with linear readings."""
        return (Promise("P and errors follow the equations", "all papers", (LINEAR,), _unknown),)


CHECKS = NonlinearChecks()
