"""Promises about track fusion: P of covariance intersection bounds the covariance of the error, and
P of tracks with known cross-covariances is that covariance.
"""

from __future__ import annotations

import numpy as np

from netkf.checks.clocked import PROMISES, REACH, UPPER_BOUND
from netkf.checks.evidence import Finding, Promise
from netkf.checks.exact import most_replayed, with_promised_filter
from netkf.checks.kalman_consensus import EquationChecks
from netkf.checks.rounding import compare_identities
from netkf.checks.samples import RunSamples
from netkf.scenario.scenario import Scenario

EXACT_TOLERANCE = 1e-8


def check_exact_covariance(samples: RunSamples, level: float) -> Finding:
    """Compare P with the exact covariance of the error."""
    most = most_replayed(samples.scenario)
    P, Sigma = samples.runs.P[:most], samples.runs.Sigma[:most]
    size = np.trace(Sigma, axis1=-2, axis2=-1)
    gap = np.nan_to_num(np.abs(P - Sigma).max(axis=(-1, -2)), nan=1e300, posinf=1e300)
    terms = samples.largest_terms(samples.runs.replayed[:most])
    message = f"largest entry of P - Sigma relative to its trace in {gap.size:,} covariances"
    return compare_identities(gap, size, terms, EXACT_TOLERANCE, message)


EXACT = Promise(
    "P is the covariance of the error, given the events",
    "Bar-Shalom and Campo 1986",
    ("the filters know", "the filters start", REACH),
    check_exact_covariance,
    exact=True,
)
BY_COMBINATION = {"best intersection": (UPPER_BOUND,), "tracks": (EXACT,)}


class FusionChecks(EquationChecks):
    """Equations, and what P says of the error."""

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario; of inverse intersection only the equations, since
        its authors promise P for one fusion of tracks and not for a network.
        """
        more = BY_COMBINATION.get(with_promised_filter(scenario).hosted.combination, ())
        return (*PROMISES[:1], *more, *PROMISES[1:])


CHECKS = FusionChecks()
