"""Promises of P about the push-sum filter."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from netkf.checks.equations import error_promises, mass_conserved, summarise_drift
from netkf.checks.evidence import (
    COMPUTED,
    Assumption,
    Finding,
    Promise,
    error_test,
    find_nothing,
    find_unknown,
    gaussian_test,
)
from netkf.checks.exact import (
    MIN_VARIANCE,
    detectable_length,
    gaussian_radius,
    max_replayed,
    with_promised_filter,
)
from netkf.checks.laws import find_largest
from netkf.checks.paper import PaperChecks, usual_assumptions
from netkf.checks.samples import (
    REPLAY_TOLERANCE,
    RunSamples,
    check_replay,
    relative_difference,
    sampled_indices,
)
from netkf.checks.statistics import affine, quadratic_interval
from netkf.core.errors import TheoryError
from netkf.laws.intervals import Interval, deviation_interval
from netkf.linalg.arrays import FloatArray, in_own_units
from netkf.scenario.scenario import Scenario
from netkf.theory import (
    exact_minimum_gamma,
    large_gamma_limits,
    minimum_gamma,
    push_sum_covariances,
    push_sum_error_covariance,
    push_sum_limits,
    push_sum_noise,
    push_sum_radius,
)
from netkf.theory.push_sum.assumptions import HEAVY_TAIL_RADIUS
from netkf.theory.push_sum.certified_gamma import searches_gamma
from netkf.theory.push_sum.promises import MAX_STEPS as MAX_CERTIFIED

STEADY_TOLERANCE = 0.01
"""Distance from a limit, relative to its largest entry, that counts as reached."""
SQUARE_TOLERANCE, BIAS_TOLERANCE = 0.3, 0.45
"""Tolerated relative difference of mean squares, and bias in standard deviations of an error."""
MAX_STEPS = 4096
"""Averaging steps up to which errors are compared with those of the central filter."""


@dataclass(frozen=True)
class PushSumSamples(RunSamples):
    """Adds errors at the end, with their exact covariance, of the R' replicas that have one."""

    @cached_property
    def followed(self) -> np.ndarray:
        """Indices (R',) of the replicas whose exact covariances at the end are finite."""
        Sigma = self.runs.Sigma[:, -1]
        return np.flatnonzero(np.isfinite(Sigma).all(axis=(1, 2, 3)))

    @cached_property
    def standardised(self) -> FloatArray:
        """Errors (R', N, n) at the end, whitened by their exact covariance."""
        Sigma, e = self.runs.Sigma[self.followed, -1], self.runs.e[self.followed, -1]
        scaled, units = in_own_units(Sigma)
        values, vectors = np.linalg.eigh(scaled)
        # Smaller variances are rounding: they are raised, so that they do not blow up a component.
        floor = MIN_VARIANCE * values[..., -1:]
        components = np.einsum("rnab,rna->rnb", vectors, e / units)
        return np.asarray(components / np.sqrt(np.maximum(values, floor)))

    @cached_property
    def steady_root(self) -> FloatArray:
        """W (N, n, n) with W S W' = I, S the exact steady covariance of sampled nodes."""
        Sigma = push_sum_error_covariance(with_promised_filter(self.scenario))
        scaled, units = in_own_units(Sigma[sampled_indices(self.scenario)])
        values, vectors = np.linalg.eigh(scaled)
        white = vectors / units[:, :, None] / np.sqrt(values)[:, None, :]
        return np.asarray(np.swapaxes(white, 1, 2))

    @cached_property
    def ratios(self) -> tuple[FloatArray, FloatArray]:
        """Mean squares |W e|^2 / n (R', N) at the end (W is ``steady_root``), sums of squares of
        normals, weighted by eigenvalues (R', N, n) of W Sigma W' given the links that were up.
        """
        W, Sigma = self.steady_root, self.runs.Sigma[self.followed, -1]
        e = np.einsum("iab,rib->ria", W, self.runs.e[self.followed, -1])
        weights = np.linalg.eigvalsh(W @ Sigma @ np.swapaxes(W, 1, 2))
        return (e**2).mean(axis=-1), np.maximum(weights, 0.0)


def _at_steady_state(samples: PushSumSamples, level: float) -> Finding:
    limit = push_sum_limits(with_promised_filter(samples.scenario)).P
    was_replayed = ~np.isnan(samples.runs.replayed[:, -1, 0, 0, 0])
    P, replayed = samples.runs.P[was_replayed, -1], samples.runs.replayed[was_replayed, -1]
    if not len(P):
        return find_unknown("no run could be replayed")
    distance, replayed_distance = (_distance(samples, part, limit) for part in (P, replayed))
    # A distance that the equations themselves have at this time breaks no promise about the limit.
    early = distance > STEADY_TOLERANCE and distance <= replayed_distance + REPLAY_TOLERANCE
    margin = STEADY_TOLERANCE - distance
    message = f"largest relative distance at the end {distance:.1e}"
    horizon = samples.scenario.horizon * _horizon_factor(samples, limit) if early else math.nan
    return Finding((margin, margin, margin), 0.0, message, early=early, horizon=horizon)


def _distance(samples: PushSumSamples, P: FloatArray, limit: FloatArray) -> float:
    """Return the largest distance of covariances P (R, N, n, n) from their ``limit`` (n, n)."""
    return float(relative_difference(samples.in_units(P), samples.in_units(limit)).max())


def _horizon_factor(samples: PushSumSamples, limit: FloatArray) -> float:
    """Return the factor on the horizon at which P is near its ``limit`` (n, n)."""
    P = samples.runs.replayed[~np.isnan(samples.runs.replayed[:, -1, 0, 0, 0])]
    half, last = (_distance(samples, P[:, k], limit) for k in (-2, -1))
    if not 0.0 < last < half < math.inf:
        return math.nan
    # The distance falls by half / last in half the horizon; 20 % more for a decay that slows down.
    return 1.2 * (1.0 + 0.5 * math.log(last / STEADY_TOLERANCE) / math.log(half / last))


@error_test
def _no_bias(samples: PushSumSamples, level: float) -> Finding:
    if not len(samples.followed):
        return find_unknown("no run has errors that were followed exactly", BIAS_TOLERANCE)
    if not np.isfinite(samples.standardised).all():
        return find_nothing(BIAS_TOLERANCE)
    nodes, intervals = samples.nodes, []
    count, n = len(samples.followed), samples.scenario.plant.n
    max_runs = max_replayed(samples.scenario)
    radius = gaussian_radius(level / len(nodes), n) / math.sqrt(count)
    for i, node in enumerate(nodes):
        bias = float(np.linalg.norm(samples.standardised[:, i].mean(axis=0)))
        detectable = detectable_length(radius * math.sqrt(count), n) / math.sqrt(count)
        low = max(0.0, bias - radius)
        distance = Interval(bias, low, bias + radius, detectable, seen=bias, expected=0.0)
        intervals.append((distance, f"at node {node}"))
    message = "largest bias, in standard deviations of an error,"
    return find_largest(intervals, BIAS_TOLERANCE, message)._replace(most_runs=max_runs)


@gaussian_test
def _mean_square(samples: PushSumSamples, level: float) -> Finding:
    if not len(samples.followed):
        return find_unknown("no run has errors that were followed exactly", SQUARE_TOLERANCE)
    squares, weights = samples.ratios
    if not (np.isfinite(squares).all() and np.isfinite(weights).all()):
        return find_nothing(SQUARE_TOLERANCE)
    nodes, n, intervals = samples.nodes, samples.scenario.plant.n, []
    # Mean squares expected at each node for the links of these runs; 1 in the steady state.
    expected = weights.mean(axis=(0, 2))
    for i, node in enumerate(nodes):
        scale = quadratic_interval(
            float(squares[:, i].sum()) * n, weights[:, i].ravel(), level / len(nodes)
        )
        from_replay = deviation_interval(1.0, scale)
        from_limit = deviation_interval(1.0, affine(scale, float(expected[i]), 0.0))
        intervals.append((from_limit._replace(low=from_replay.low), f"at node {node}"))
    message = "largest relative difference of mean squares from the exact ones"
    max_runs = max_replayed(samples.scenario)
    finding = find_largest(intervals, SQUARE_TOLERANCE, message)._replace(most_runs=max_runs)
    # Early if already the expected mean squares are not the steady ones, unless the promise is
    # broken: the lower limits are those of the distance from what is expected.
    off_limit = float(np.abs(expected - 1.0).max())
    early = off_limit > SQUARE_TOLERANCE and not any(one.low > 0.0 for one, _ in intervals)
    return finding._replace(early=early)


def _gamma_certified(samples: PushSumSamples, level: float) -> Finding:
    scenario = with_promised_filter(samples.scenario)
    gamma, needed = minimum_gamma(scenario, "mean-square"), exact_minimum_gamma(scenario)
    margin = float(gamma - needed)
    message = f"computed, not simulated: Theorem 6 certifies gamma {gamma}, {needed} is enough"
    return Finding((margin, margin, margin), 0.0, message)


def _many_steps(samples: PushSumSamples, level: float) -> Finding:
    scenario = with_promised_filter(samples.scenario)
    limits, gamma, distance = large_gamma_limits(scenario), 1, np.inf
    noise_scale = float(np.abs(limits.noise).max())
    first_distance: float | None = None
    while distance > STEADY_TOLERANCE and gamma < MAX_STEPS:
        covariances = push_sum_covariances(scenario, [gamma])[0]
        noise = push_sum_noise(scenario, [gamma])[0]
        error_distance = _relative_distance(covariances, limits.covariance)
        distance = max(error_distance, float(np.abs(noise - limits.noise).max()) / noise_scale)
        if np.isnan(distance):
            distance = np.inf
        if first_distance is None:
            first_distance = error_distance
        gamma *= 2
    converged = distance <= STEADY_TOLERANCE
    if scenario.filters_know_the_truth:
        central = push_sum_limits(scenario).P
        distance = max(distance, _relative_distance(limits.covariance[None], central))
    message = (
        f"computed, not simulated: with gamma {gamma // 2} errors and noise are within "
        f"{distance:.1e} of their limits, the errors of the central filter; with gamma 1 within "
        f"{first_distance:.3g}"
    )
    margin = STEADY_TOLERANCE - distance
    return Finding((margin, margin, margin), 0.0, message, early=not converged)


def _relative_distance(P: FloatArray, limit: FloatArray) -> float:
    """Return the largest entry of |P - limit| over that of |limit|, of ``P`` (N, n, n)."""
    return float(np.abs(P - limit).max() / np.abs(limit).max())


# What promises need: parts of names or sources in the table of assumptions, see ``Promise.needs``.
LAWS = ("P Assumption 2", "P Assumption 1", "P Assumption 3", "no gain is frozen")
FOLLOWED = (
    "mean squares have a variance",
    "mass is exchanged in every slot",
    "the filters know",
    "the filters start",
    "exact errors are within reach",
)
PROMISES = (
    Promise(
        "P follows steps 2 and 3 with the links that were up",
        "P (3)-(7)",
        ("mass is exchanged in every slot", "exact errors are within reach"),
        check_replay,
        exact=True,
    ),
    *error_promises(
        "P (7)-(9), derived",
        ("mass is exchanged in every slot", "the filters know", "exact errors are within reach"),
        by="the steps give them",
    ),
    Promise(
        "every node comes to the covariance P_inf",
        "P (12), Theorems 1, 2",
        (*LAWS, "mass is exchanged in every slot", "exact errors are within reach"),
        _at_steady_state,
        exact=True,
    ),
    Promise(
        "the estimates become unbiased", "P Theorem 5, (30)", (*LAWS, "P (30)", *FOLLOWED), _no_bias
    ),
    Promise(
        "mean squares become the exact steady ones",
        "P Theorem 6, Lemma 10, Figs. 4, 5, derived",
        (*LAWS, "P Lemma 10", *FOLLOWED),
        _mean_square,
    ),
)
LIMIT = Promise(
    "with ever more averaging steps every node has the errors of the central filter",
    "P Theorem 4, Lemma 4",
    ("P Assumption 2", "P Assumption 1"),
    _many_steps,
    exact=True,
    group=COMPUTED,
)
CERTIFIED = Promise(
    "the gamma that Theorem 6 certifies keeps mean squares bounded", "P Theorem 6",
    ("P Assumption 3",), _gamma_certified, exact=True, group=COMPUTED,
)  # fmt: skip


def _assumptions(scenario: Scenario) -> list[Assumption]:
    try:
        # Errors have a steady mean square if the mean-square radius is below 1, and a fourth
        # moment, as a test of mean squares needs, if it is well below.
        radius = push_sum_radius(with_promised_filter(scenario))
        light = radius <= HEAVY_TAIL_RADIUS
        evidence = f"mean-square radius {radius:.4g}, light tails below {HEAVY_TAIL_RADIUS}"
    except TheoryError as error:
        light, evidence = False, str(error)
    algorithm: Any = with_promised_filter(scenario).filter.algorithm
    holds = algorithm.stop == "never" and not algorithm.asymptotic
    exchange = "exchanged for ever" if holds else "gains are frozen or taken from the limit"
    if not np.array_equal(scenario.slot_belief[0], scenario.linear_plant.F):
        holds, exchange = False, "exchanged, but the filters' F is not the plant's"
    if any(sensor.varying for sensor in scenario.sensors):
        holds, exchange = False, "exchanged, but H differs from slot to slot"
    return [
        Assumption("mass is exchanged in every slot", "P step 2", holds, exchange),
        Assumption("mean squares have a variance", "derived", light, evidence),
        *usual_assumptions(scenario),
    ]


def _promises(scenario: Scenario) -> tuple[Promise, ...]:
    promised = with_promised_filter(scenario)
    promises = (*mass_conserved(scenario, "P (67), (3)-(5) corrected"), *PROMISES)
    if not searches_gamma(promised):
        return promises
    # These functions raise TheoryError where the limit or the gamma does not exist.
    with contextlib.suppress(TheoryError):
        large_gamma_limits(promised)
        promises = (*promises, LIMIT)
    with contextlib.suppress(TheoryError):
        minimum_gamma(promised, "mean-square")
        exact_minimum_gamma(promised, most=MAX_CERTIFIED)
        promises = (*promises, CERTIFIED)
    return promises


CHECKS = PaperChecks(_promises, _assumptions, summarise_drift, PushSumSamples, slots_only=True)
