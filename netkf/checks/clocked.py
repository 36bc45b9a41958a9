"""Gossip, intermittent observations and push-sum under clocks, against their equations.

Their papers are about slots; statements that are exact given the events hold in continuous time
too, and these are checked here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from netkf.algorithms.traits import nothing_conserved
from netkf.checks.evidence import Assumption, Finding, Promise
from netkf.checks.exact import (
    check_bias,
    check_error_covariance,
    check_expected_nees,
    check_upper_bound,
    few_errors,
    summarise_exactly,
    with_promised_filter,
)
from netkf.checks.laws import exact_start
from netkf.checks.paper import PaperChecks
from netkf.checks.rounding import compare_identities, first_wrong
from netkf.checks.samples import ReplicaSummary, RunSamples, check_replay
from netkf.network.clocks import LinkClock
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

MASS_TOLERANCE = 1e-9  # drift of the total, relative: rounding of many exchanges


@dataclass(frozen=True, eq=False)
class ClockedSummary(ReplicaSummary):
    """Adds ``drift``: the largest relative drift of the sums over all nodes that exchanges should
    conserve; 0 for filters without such sums.
    """

    drift: float


def _mass_conserved(samples: RunSamples, level: float) -> Finding:
    """Check that exchanges conserve mass."""
    drift, scenario = np.abs(samples.runs.drift), samples.scenario
    message = f"drift of the total weight in {samples.count} runs"
    # Running totals grow with every broadcast, and their rounding remains in their differences.
    clock, rate = scenario.network.activation, 0.0
    if isinstance(clock, LinkClock):
        rate = sum(clock.mean_rate(entity) for entity in clock.entities(scenario.topology))
    terms = 1.0 + scenario.horizon * float(np.nan_to_num(rate))
    # Size of the compared values, of the terms whose rounding errors they inherit, and relative
    # tolerance; the drift is relative already.
    limits = np.ones_like(drift), terms, MASS_TOLERANCE
    finding = compare_identities(drift, *limits, message)
    return finding._replace(replica=first_wrong(drift, *limits))


# What promises need: parts of names or sources in the table of assumptions, see ``Promise.needs``.
REACH, START = "exact errors are within reach", "the filters start"
PROMISES = (
    Promise(
        "P follows the equations along the events of each run",
        "derived",
        (REACH,),
        check_replay,
        exact=True,
    ),
    Promise(
        "errors have the covariance that the equations give them",
        "derived",
        (REACH,),
        check_error_covariance,
    ),
    Promise(
        "errors have no bias that the equations do not give them", "derived", (REACH,), check_bias
    ),
    Promise("NEES has the mean that exact errors say", "derived", (REACH,), check_expected_nees),
)
MASS_CONSERVED = Promise("mass is conserved", "P (67), derived", (), _mass_conserved, exact=True)
UPPER_BOUND = Promise(
    "P is at least the covariance of the error, given the events",
    "derived",
    ("the filters know", START, REACH),
    check_upper_bound,
    exact=True,
)


class ClockedChecks(PaperChecks):
    """Promises about the equations of slot filters under clocks."""

    summary_type = ClockedSummary

    def summarise(self, scenario: Scenario, run: Run) -> ClockedSummary:
        """Return what the tests need of one ``run``, which was sampled at ``probe_times``."""
        drift = [abs(total - start) / abs(start) for start, total in run.sums.values()]
        fields = vars(summarise_exactly(scenario, run))
        return ClockedSummary(**fields, drift=max(drift, default=0.0))

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests."""
        return [exact_start(scenario), few_errors(scenario)]

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the statements about a scenario's filter that are tested."""
        analysis = with_promised_filter(scenario).node_filter.analysis
        mass = () if analysis.conserved is nothing_conserved else (MASS_CONSERVED,)
        in_slots, in_continuous_time = analysis.P_by_design
        is_below = (in_slots if scenario.slotted else in_continuous_time) == "smaller"
        bound = () if is_below else (UPPER_BOUND,)
        return (*mass, *PROMISES[:1], *bound, *PROMISES[1:])


CHECKS = ClockedChecks()
