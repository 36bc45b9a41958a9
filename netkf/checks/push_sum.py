"""Promises of P about the push-sum filter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.special

from netkf.checks.evidence import Assumption, Finding, Promise, find_identity, find_nothing
from netkf.checks.exact import (
    check_error_covariance,
    few_errors,
    summarise_exactly,
    with_promised_filter,
)
from netkf.checks.laws import exact_start, find_largest
from netkf.checks.paper import PaperChecks
from netkf.checks.points import sampled_indices
from netkf.checks.samples import ReplicaSummary, RunSamples, check_replay, relative_difference
from netkf.checks.statistics import Interval, deviation_interval, mean_interval
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory import (
    exact_minimum_gamma,
    minimum_gamma,
    push_sum_error_covariance,
    push_sum_limits,
    push_sum_radius,
)
from netkf.theory.push_sum.certified_gamma import searches_gamma
from netkf.trace.run import Run

MASS_TOLERANCE, STEADY_TOLERANCE = 1e-9, 0.01
SQUARE_TOLERANCE, BIAS_TOLERANCE = 0.3, 0.2
"""Tolerated relative difference of mean squares, and squared bias in units of the covariance."""
HEAVY_TAILS = 0.885
"""Mean-square radius from which the sample mean of squares has no useful variance."""
MAX_CERTIFIED = 20


@dataclass(frozen=True, eq=False)
class PushSumSummary(ReplicaSummary):
    """Adds ``drift`` (2,): the relative drift of the totals of weight and number."""

    drift: FloatArray


@dataclass(frozen=True)
class PushSumSamples(RunSamples):
    """Adds errors in units of their exact steady covariance."""

    @cached_property
    def whitened(self) -> FloatArray:
        """Errors (R, N, n) at the end, whitened by the exact steady covariance."""
        Sigma = push_sum_error_covariance(with_promised_filter(self.scenario))
        values, vectors = np.linalg.eigh(Sigma)
        roots = vectors / np.sqrt(values)[:, None, :]
        roots = roots[sampled_indices(self.scenario)]
        return np.asarray(np.einsum("iab,ria->rib", roots, self.runs.e[:, -1]))


def _mass_conserved(samples: PushSumSamples, level: float) -> Finding:
    """Compare the totals of weight and number at the end with 1 and N."""
    drift = float(np.nan_to_num(np.abs(samples.runs.drift), nan=np.inf).max())
    message = f"drift of the totals of weight and number in {len(samples.runs.P)} runs"
    return find_identity(drift, MASS_TOLERANCE, message)


def _at_steady_state(samples: PushSumSamples, level: float) -> Finding:
    """Compare P of every node at the end with P_inf."""
    limit = push_sum_limits(with_promised_filter(samples.scenario)).P
    last, expected = (
        float(np.nan_to_num(relative_difference(P[:, -1], limit), nan=np.inf).max())
        for P in (
            samples.runs.P,
            samples.runs.replayed[~np.isnan(samples.runs.replayed[:, -1, 0, 0, 0])],
        )
    )
    # If the equations are not there yet either, the horizon is too short for a verdict.
    early = last > STEADY_TOLERANCE and expected > STEADY_TOLERANCE
    margin = STEADY_TOLERANCE - last
    message = f"largest relative distance at the end {last:.1e}"
    return Finding((margin, margin, margin), 0.0, message, early=early)


def _unbiased(samples: PushSumSamples, level: float) -> Finding:
    """Test that the mean of the whitened errors at the end is 0, in all directions at once."""
    nodes = samples.nodes
    if not np.isfinite(samples.whitened).all():
        return find_nothing(BIAS_TOLERANCE)
    found = []
    for i, node in enumerate(nodes):
        e = samples.whitened[:, i]
        # A mean m has outer product m m' with one eigenvalue |m|^2; its sampling error is ~ 1 / R.
        mean = e.mean(axis=0)
        error = np.cov(e, rowvar=False).reshape(e.shape[1], -1) / len(e)
        reach = _gaussian_radius(level / len(nodes), e.shape[1])
        size = float(np.linalg.norm(mean))
        wide = reach * float(np.sqrt(np.linalg.eigvalsh(error)[-1]))
        distance = Interval(size**2, max(0.0, size - wide) ** 2, (size + wide) ** 2)
        found.append((distance, f"at node {node}"))
    return find_largest(
        found, BIAS_TOLERANCE, "largest squared bias, in units of the exact covariance,"
    )


def _gaussian_radius(level: float, n: int) -> float:
    """Return the radius that a standard Gaussian vector (n,) exceeds with probability ``level``."""
    return float(np.sqrt(2.0 * scipy.special.gammainccinv(n / 2.0, level)))


def _mean_square(samples: PushSumSamples, level: float) -> Finding:
    """Test that the mean square of whitened errors at the end is 1, averaged over directions."""
    nodes, n = samples.nodes, samples.scenario.plant.n
    if not np.isfinite(samples.whitened).all():
        return find_nothing(SQUARE_TOLERANCE)
    found = []
    for i, node in enumerate(nodes):
        ratio = mean_interval((samples.whitened[:, i] ** 2).sum(axis=1) / n, level / len(nodes))
        found.append((deviation_interval(1.0, ratio), f"at node {node}"))
    message = "largest relative difference of mean squares from the exact ones"
    return find_largest(found, SQUARE_TOLERANCE, message)


def _gamma_certified(samples: PushSumSamples, level: float) -> Finding:
    """Compare the gamma that Theorem 6 certifies with the exact one, which is far smaller."""
    scenario = with_promised_filter(samples.scenario)
    gamma, needed = minimum_gamma(scenario, "mean-square"), exact_minimum_gamma(scenario)
    margin = float(gamma - needed)
    message = f"computed, not simulated: Theorem 6 certifies gamma {gamma}, {needed} is enough"
    return Finding((margin, margin, margin), 0.0, message)


LAWS = ("P Assumption 2", "P Assumption 1", "P Assumption 3", "no gain is frozen")
PROMISES = (
    Promise(
        "mass is conserved",
        "P Lemma 1, (3)-(5) corrected",
        ("both directions of a link",),
        _mass_conserved,
        exact=True,
    ),
    Promise(
        "P follows steps 2 and 3 with the links that were up",
        "P (3)-(7)",
        ("mass is exchanged in every slot", "exact errors are within reach"),
        check_replay,
        exact=True,
    ),
    Promise(
        "errors have the covariance that the steps give them",
        "P (7)-(9), derived",
        (
            "mass is exchanged in every slot",
            "the filters know",
            "the filters start",
            "exact errors are within reach",
        ),
        check_error_covariance,
    ),
    Promise(
        "every node comes to the covariance P_inf",
        "P Lemmas 3, 4, Theorems 1, 2",
        (*LAWS, "mass is exchanged in every slot", "exact errors are within reach"),
        _at_steady_state,
        exact=True,
    ),
    Promise(
        "the estimates become unbiased",
        "P Theorem 5, (30)",
        (*LAWS, "P (30)", "mean squares have a variance", "the filters know"),
        _unbiased,
    ),
    Promise(
        "mean squares become the exact steady ones",
        "P Theorem 6, Lemma 10, Figs. 4, 5, derived",
        (*LAWS, "P Lemma 10", "mean squares have a variance", "the filters know"),
        _mean_square,
    ),
)
CERTIFIED = Promise(
    "the gamma that Theorem 6 certifies keeps mean squares bounded",
    "P Theorem 6, Corollaries 1, 2",
    ("P Assumption 3",),
    _gamma_certified,
    exact=True,
)


class PushSumChecks(PaperChecks):
    """Promises of P, Lemmas 1, 3, 4, 10 and Theorems 1, 2, 5, 6."""

    slots_only = True

    def summarise(self, scenario: Scenario, run: Run) -> PushSumSummary:
        """Return the summary of a run whose samples are at ``check_slots``."""
        drift = np.array([(total - exact) / exact for exact, total in run.sums.values()])
        drift = drift if len(drift) else np.full(2, np.nan)
        return PushSumSummary(**vars(summarise_exactly(scenario, run)), drift=drift)

    def collect(self, scenario: Scenario, stacked: Any, seed: int) -> PushSumSamples:
        """Return the samples that the tests take, from stacked summaries."""
        return PushSumSamples(scenario, stacked, seed)

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests beyond those of P."""
        try:
            radius = push_sum_radius(with_promised_filter(scenario))
            light = radius <= HEAVY_TAILS
            why = f"mean-square radius {radius:.4g}, light tails below {HEAVY_TAILS}"
        except TheoryError as error:
            light, why = False, str(error)
        return [
            _every_slot(scenario),
            Assumption("mean squares have a variance", "derived", light, why),
            exact_start(scenario),
            few_errors(scenario),
        ]

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario; one on the certified gamma if it exists."""
        promised = with_promised_filter(scenario)
        if not searches_gamma(promised):
            return PROMISES
        try:
            minimum_gamma(promised, "mean-square")
            exact_minimum_gamma(promised, most=MAX_CERTIFIED)
        except TheoryError:
            return PROMISES
        return (*PROMISES, CERTIFIED)


def _every_slot(scenario: Scenario) -> Assumption:
    """Return the assumption that the run follows steps 2 and 3 of P in every slot."""
    algorithm = with_promised_filter(scenario).filter.algorithm
    holds = algorithm.stop == "never" and not algorithm.asymptotic  # type: ignore[union-attr]
    why = "exchanged for ever" if holds else "gains are frozen or taken from the limit"
    if not np.array_equal(scenario.slot_belief[0], scenario.slot_plant.F):
        holds, why = False, "exchanged, but the filters' F is not the plant's"
    if any(sensor.varying for sensor in scenario.sensors):
        holds, why = False, "exchanged, but H differs from slot to slot"
    return Assumption("mass is exchanged in every slot", "P step 2", holds, why)


CHECKS = PushSumChecks()
