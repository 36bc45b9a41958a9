"""Promises about the stochastic event trigger: how often nodes send, and what silence says."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from netkf.checks.equations import ERRORS, EXACT, FOLLOWS_EVENTS, REACH
from netkf.checks.evidence import Finding, Promise, find_unknown
from netkf.checks.exact import summarise_exactly, with_promised_filter
from netkf.checks.laws import find_largest
from netkf.checks.paper import PaperChecks
from netkf.checks.samples import ReplicaSummary, RunSamples
from netkf.laws.intervals import deviation_interval, student_interval
from netkf.scenario.scenario import Scenario
from netkf.theory.stochastic_trigger.errors import all_hear_all, expected_sends
from netkf.trace.run import Run

RATE_TOLERANCE = 0.05  # of the share of slots with a message


def check_rate(samples: RunSamples, level: float) -> Finding:
    """Test that nodes send with their probability given the past: messages less the sum of the
    probabilities are a martingale (Student's interval over the runs).
    """
    sent, expected = samples.runs.sends.T
    total = float(expected.mean())
    if not total > 0.0:
        return find_unknown("no node has a slot in which it decides", RATE_TOLERANCE)
    difference = (sent - expected) / total
    # Rare messages may show no variance: at least that of one message, and of as many as expected.
    variance = max(float((sent - expected).var(ddof=1)), total, 1.0 / len(sent))
    spread = math.sqrt(variance / len(sent)) / total
    ratio = student_interval(1.0 + float(difference.mean()), spread, len(difference), level)
    distance = deviation_interval(1.0, ratio)
    text = f"messages sent over those expected given the past, {sent.sum():,.0f} sent"
    return find_largest([(distance, "all nodes and slots")], RATE_TOLERANCE, text)


NEEDS = ("the filters know", "every node hears", "the filters start", REACH)
SILENCE = replace(EXACT, source="Han et al. 2015, Theorem 2", needs=NEEDS)
RATE = Promise(
    "nodes send with probability 1 - det(I + Pi Y)^-1/2",
    "Han et al. 2015",
    ("the filters know", "every node hears", "the filters start"),
    check_rate,
)


def _summarise(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return the summary with ``sends`` (2,): messages, and the sum of their probabilities."""
    summary = summarise_exactly(scenario, run)
    summary.sends = np.full(2, np.nan)
    # Without losses, and if all hear all, silence is information.
    if all_hear_all(scenario):
        summary.sends[:] = expected_sends(with_promised_filter(scenario), run)
    return summary


def _promises(_: Scenario) -> tuple[Promise, ...]:
    more = "every node hears", "the filters know", "one estimate"
    follows, *errors = (replace(p, needs=(*p.needs, *more)) for p in (FOLLOWS_EVENTS, *ERRORS))
    return (follows, SILENCE, RATE, *errors)


CHECKS = PaperChecks(_promises, summarise=_summarise)
