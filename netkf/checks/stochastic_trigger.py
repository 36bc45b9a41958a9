"""Promises about the stochastic event trigger: how often nodes send, and what silence says."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from netkf.checks.clocked import PROMISES, REACH
from netkf.checks.evidence import Finding, Promise, find_unknown
from netkf.checks.exact import summarise_exactly, with_promised_filter
from netkf.checks.kalman_consensus import EquationChecks
from netkf.checks.laws import find_largest
from netkf.checks.samples import ReplicaSummary, RunSamples
from netkf.checks.statistics import deviation_interval, student_interval
from netkf.checks.track_fusion import EXACT
from netkf.scenario.scenario import Scenario
from netkf.theory.stochastic_trigger.errors import all_hear_all
from netkf.theory.stochastic_trigger.rates import expected_sends
from netkf.trace.run import Run

RATE_TOLERANCE = 0.05  # of the share of slots with a message


@dataclass(frozen=True, eq=False)
class TriggerSummary(ReplicaSummary):
    """Adds how often nodes sent and how often they should have, given the past, ``sends`` (2,)."""

    sends: np.ndarray


def check_rate(samples: RunSamples, level: float) -> Finding:
    """Compare how often nodes sent with the sum of their probabilities: differences have mean 0
    whatever happened before, and runs are independent.
    """
    sent, expected = samples.runs.sends.T
    total = float(expected.mean())
    if not total > 0.0:
        return find_unknown("no node has a slot in which it decides", RATE_TOLERANCE)
    difference = (sent - expected) / total
    spread = float(difference.std(ddof=1)) / np.sqrt(len(difference))
    found = student_interval(1.0 + float(difference.mean()), spread, len(difference), level)
    apart = deviation_interval(1.0, found)
    text = f"messages sent over those expected given the past, {sent.sum():,.0f} sent"
    return find_largest([(apart, "all nodes and slots")], RATE_TOLERANCE, text)


NEEDS = ("the filters know", "every node hears", "the filters start", REACH)
SILENCE = dataclasses.replace(EXACT, source="Han et al. 2015, Theorem 2", needs=NEEDS)
RATE = Promise(
    "nodes send with probability 1 - det(I + Pi Y)^-1/2",
    "Han et al. 2015",
    ("the filters know", "every node hears", "the filters start"),
    check_rate,
)


class TriggerChecks(EquationChecks):
    """Equations, the covariance of silent slots and the rate, where silence is no loss."""

    summary_type = TriggerSummary

    def summarise(self, scenario: Scenario, run: Run) -> TriggerSummary:
        """Return the summary of a run whose samples are at ``check_times``."""
        sends = np.full(2, np.nan)
        if all_hear_all(scenario):
            sends[:] = expected_sends(with_promised_filter(scenario), run)
        return TriggerSummary(**vars(summarise_exactly(scenario, run)), sends=sends)

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario; the equations too are about sure messages."""
        equations = [
            dataclasses.replace(one, needs=(*one.needs, "every node hears", "the filters know"))
            for one in PROMISES
        ]
        return (*equations[:1], SILENCE, RATE, *equations[1:])


CHECKS = TriggerChecks()
