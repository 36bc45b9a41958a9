"""Promises about track fusion: P of covariance intersection bounds the covariance of the error, and
P of tracks with known cross-covariances is that covariance.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.checks.equations import (
    ERRORS,
    EXACT,
    FOLLOWS_EVENTS,
    KNOWN,
    NO_LOSS,
    UPPER_BOUND,
    design_of,
)
from netkf.checks.evidence import Finding, Promise, find_identity
from netkf.checks.exact import EXACT_TOLERANCE
from netkf.checks.paper import PaperChecks
from netkf.checks.samples import RunSamples, check_slots, sampled_indices
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import in_units
from netkf.theory.track_fusion.steady_errors import tracks_in_slots

START_FACTOR, STEADY_TOLERANCE = 10.0, 1e-3
"""Safety factor on the effect of the start, radius^slots times its size; and the relative effect
below which P counts as steady.
"""


def check_steady(samples: RunSamples, level: float) -> Finding:
    """Compare P at the end with that of steady tracks fused by their exact cross-covariances;
    ``early``, with the horizon that suffices, while the initial P may still matter.
    """
    radius, steady = tracks_in_slots(samples.scenario)
    if steady is None:
        raise TheoryError(f"tracks have no steady covariance: their radius is {radius:.6g}")
    expected = steady[sampled_indices(samples.scenario)]
    # The effect of the start shrinks by the spectral radius in each slot.
    remaining = radius ** check_slots(samples.scenario)[-1]
    gap = samples.in_units(np.abs(samples.runs.P[:, -1] - expected)).max(axis=(-1, -2))
    size = np.trace(samples.in_units(expected), axis1=-2, axis2=-1)
    largest = np.trace(in_units(steady, samples.units.of_nodes), axis1=-2, axis2=-1).max()
    terms = samples.first_trace + float(largest)
    allowed = EXACT_TOLERANCE + START_FACTOR * remaining * terms / float(size.min())
    message = f"P at the end of {samples.count} runs"
    finding = find_identity(float((gap / size).max()), allowed, message)
    if allowed < STEADY_TOLERANCE:
        return finding
    # The radius^slots for which the effect of the start is half of what counts as steady.
    allowed_remainder = STEADY_TOLERANCE * float(size.min()) / (2.0 * START_FACTOR * terms)
    slots = math.log(allowed_remainder) / math.log(radius)
    return finding._replace(early=True, horizon=slots * samples.scenario.slot_plant.period)


STEADY = Promise(
    "P tends to that of steady tracks, whose P12 solves a Lyapunov equation",
    "Bar-Shalom and Campo 1986",
    (KNOWN, NO_LOSS),
    check_steady,
    exact=True,
)
BY_DESIGN = {"larger": (UPPER_BOUND,), "equal": (EXACT, STEADY)}
"""Promises about P, by how it compares with the covariance of the error."""
CHECKS = PaperChecks(
    lambda scenario: (FOLLOWS_EVENTS, *BY_DESIGN.get(design_of(scenario), ()), *ERRORS)
)
