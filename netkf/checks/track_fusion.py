"""Promises about track fusion: P of covariance intersection bounds the covariance of the error, and
P of tracks with known cross-covariances is that covariance.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.checks.clocked import PROMISES, REACH, UPPER_BOUND
from netkf.checks.evidence import Finding, Promise, find_identity, find_unknown
from netkf.checks.exact import max_replayed, with_promised_filter
from netkf.checks.kalman_consensus import EquationChecks
from netkf.checks.points import check_slots, sampled_indices
from netkf.checks.rounding import compare_identities
from netkf.checks.samples import RunSamples, with_departure
from netkf.scenario.scenario import Scenario
from netkf.theory.track_fusion.steady_errors import tracks_in_slots

EXACT_TOLERANCE = 1e-8  # relative to the trace: rounding
START_FACTOR, STEADY_TOLERANCE = 10.0, 1e-3
"""Safety factor on the effect of the start, radius^slots times its size; and the relative effect
below which P counts as steady.
"""


def check_exact_covariance(samples: RunSamples, level: float) -> Finding:
    """Check that P of the runs is Sigma, the exact covariance of the error given the events of the
    run, up to rounding; both are (R, K, N, n, n).

    No interval is estimated, so that ``level`` is not used.
    """
    max_runs = max_replayed(samples.scenario)
    P, Sigma = samples.runs.P[:max_runs], samples.runs.Sigma[:max_runs]
    known = np.isfinite(Sigma).all(axis=(-1, -2))
    if not known.any():
        return find_unknown("no exact covariance could be computed")
    size = np.where(known, np.trace(Sigma, axis1=-2, axis2=-1), 0.0)
    gap = np.nan_to_num(np.abs(P - Sigma).max(axis=(-1, -2)), nan=1e300, posinf=1e300) * known
    # Size of the values, of the terms whose rounding errors they inherit, and relative tolerance.
    limits = size, samples.largest_terms(samples.runs.replayed[:max_runs]), EXACT_TOLERANCE
    message = f"largest entry of P - Sigma relative to trace(Sigma) in {known.sum():,} covariances"
    return with_departure(compare_identities(gap, *limits, message), samples, gap, limits)


EXACT = Promise(
    "P is the covariance of the error, given the events",
    "Bar-Shalom and Campo 1986",
    ("the filters know", "the filters start", REACH),
    check_exact_covariance,
    exact=True,
)


def check_steady(samples: RunSamples, level: float) -> Finding:
    """Compare P at the end of the runs with that of steady tracks: the Kalman filters of the nodes
    (tracks) in their steady state, fused by their exact cross-covariances.

    While the initial P may still matter, the finding is ``early`` (undecided) and has the horizon
    that suffices. No interval is estimated, so that ``level`` is not used.
    """
    radius, steady = tracks_in_slots(samples.scenario)
    expected = steady[sampled_indices(samples.scenario)]
    # The effect of the start shrinks by the spectral radius in each slot.
    remaining = radius ** check_slots(samples.scenario)[-1]
    gap = np.abs(samples.runs.P[:, -1] - expected).max(axis=(-1, -2))
    size = np.trace(expected, axis1=-2, axis2=-1)
    terms = samples.first_trace + float(np.trace(steady, axis1=-2, axis2=-1).max())
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
    ("the filters know", "no message is lost"),
    check_steady,
    exact=True,
)
BY_DESIGN = {"larger": (UPPER_BOUND,), "equal": (EXACT, STEADY)}
"""Promises about P, by how it compares with the covariance of the error."""


class FusionChecks(EquationChecks):
    """Promises about the equations, and about P as bound or covariance of the error."""

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario: those about the filter's equations."""
        in_slots, under_clocks = with_promised_filter(scenario).node_filter.analysis.P_by_design
        about_errors = BY_DESIGN.get(in_slots if scenario.slotted else under_clocks, ())
        # This is the order of rows in the report.
        return (*PROMISES[:1], *about_errors, *PROMISES[1:])


CHECKS = FusionChecks()
