"""Promises about event-triggered consensus on information: P is no smaller than the errors are."""

from __future__ import annotations

import math

import numpy as np

from netkf.checks.evidence import Finding, Promise, error_test, find_nothing
from netkf.checks.laws import NEES_TOLERANCE, exact_start
from netkf.checks.paper import PaperChecks
from netkf.checks.samples import RunSamples
from netkf.laws.intervals import student_interval


@error_test
def check_nees_bound(samples: RunSamples, level: float) -> Finding:
    """Test that the mean of NEES / n is at most 1, by Student's interval: events depend on data."""
    n, nees = samples.scenario.plant.n, samples.runs.nees.reshape(samples.count, -1)
    finite = np.flatnonzero(np.isfinite(nees).all(axis=0))
    if not len(finite):
        return find_nothing(NEES_TOLERANCE)
    ratios, single_level = nees[:, finite] / n, level / len(finite)
    means, spreads = ratios.mean(axis=0), ratios.std(axis=0, ddof=1) / math.sqrt(samples.count)
    # The point reported: that with the largest mean plus two standard errors.
    k = int(np.argmax(means + 2.0 * spreads))
    intervals = [
        student_interval(float(mean), float(spread), samples.count, single_level)
        for mean, spread in zip(means, spreads, strict=True)
    ]
    highest = max(interval.high for interval in intervals)
    # The promise is broken if the lower limit of some point is above 1.
    lowest = max(interval.low for interval in intervals)
    label = samples.point_labels[int(finite[k])]
    message = f"NEES / n, at most 1, the largest of {len(finite)} points at {label}"
    message += samples.blurred_note
    margin = 1.0 - float(means[k]), 1.0 - highest, 1.0 - lowest
    detectable = max(interval.detectable for interval in intervals)
    finding = Finding(margin, NEES_TOLERANCE, message, detectable=detectable)
    return finding._replace(seen=float(means[k]), expected=1.0)


BOUND = Promise(
    "P is at least the second moment of the error: the mean NEES is at most n",
    "Battistelli et al. 2018, derived",
    ("the filters know", "no message is lost", "the filters start"),
    check_nees_bound,
)
CHECKS = PaperChecks(lambda _: (BOUND,), lambda scenario: [exact_start(scenario)], slots_only=True)
