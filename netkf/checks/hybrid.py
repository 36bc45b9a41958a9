"""Promises of H about filters that exchange estimates at the ticks of links."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy

from netkf.checks.equations import error_promises
from netkf.checks.evidence import (
    COMPUTED,
    Assumption,
    Finding,
    Promise,
    find_identity,
    find_unknown,
)
from netkf.checks.exact import check_expected_nees, check_upper_bound, with_promised_filter
from netkf.checks.laws import find_largest
from netkf.checks.paper import PaperChecks, usual_assumptions
from netkf.checks.samples import RunSamples, check_replay, check_times, sampled_indices
from netkf.checks.statistics import affine, eigenvalue_interval
from netkf.core.errors import ScenarioError, TheoryError
from netkf.laws.intervals import Interval
from netkf.linalg.arrays import FloatArray, in_own_units, in_units, row_units
from netkf.network.clocks import Poisson, Renewal
from netkf.scenario.scenario import Scenario
from netkf.theory import (
    constant_gain_bound,
    covariance_bound,
    limit_covariance,
    steady_covariance_bound,
)
from netkf.theory.hybrid.coupled import coupling, reason_without_bound
from netkf.theory.hybrid.dense import SparseOrFull
from netkf.theory.hybrid.second_moments import second_moment_rate
from netkf.theory.hybrid.steady import has_steady_state
from netkf.theory.numerics.matrices import arnoldi_start, undetectable_mode

BOUND_TOLERANCE, SLOPE_TOLERANCE = 0.1, 0.3
"""Tolerated relative excess over the bound, and error of the exponent of the distance to S."""
DISTANCE_TOLERANCE = 1e-7
"""Relative accuracy of the distance between the steady bound and S."""
STEADY_TOLERANCE, MAX_TIME = 0.01, 1e5
"""Relative distance from the steady bound that counts as reached, and largest factor on the
horizon.
"""
GAIN_TOLERANCE = 1e-6
"""Relative error of the difference of two bounds from their numerical integration."""
MAX_DENSE = 200
"""Largest number of nodes for which all eigenvalues of the coupling are computed, and the rate of
links that a steady state takes.
"""


@dataclass(frozen=True)
class HybridSamples(RunSamples):
    """Adds the bound with which the mean of P is compared."""

    @cached_property
    def bound(self) -> FloatArray:
        """The bound (K, N, n, n) on the mean of P at K times and N nodes, H (12)."""
        times = np.array(check_times(self.scenario))
        all_nodes = covariance_bound(with_promised_filter(self.scenario), times)
        return all_nodes[:, sampled_indices(self.scenario)]


def _variance_exists(scenario: Scenario) -> Assumption:
    name, source = "the covariance has a variance", "derived"
    # Nodes whose own readings leave a mode that does not decay unseen: their P may grow for long.
    hidden = {
        model: undetectable_mode(model.A, model.H.T @ np.linalg.solve(model.R, model.H))
        for model in set(scenario.models)
    }
    pairs = zip(scenario.nodes, scenario.models, strict=True)
    unobserved = [node for node, model in pairs if hidden[model] is not None]
    if not unobserved:
        evidence = "every node detects the state by itself, so P is bounded"
        return Assumption(name, source, True, evidence)
    problem = (
        f"node {unobserved[0]} is blind to a mode that grows, and without a variance no interval "
        "holds"
    )
    try:
        rate = second_moment_rate(scenario)
    except TheoryError as error:
        return Assumption(name, source, None, f"not decided: {error}; {problem}")
    evidence = f"second moments change at rate {rate:.3g} per second"
    return Assumption(
        name, source, rate < 0.0, evidence if rate < 0.0 else f"{evidence}; {problem}"
    )


def _mean_below_bound(samples: HybridSamples, level: float) -> Finding:
    """Test that the mean of P over the runs stays below its bound, H (12)."""
    P, bound = samples.runs.P, samples.bound
    _, times, nodes = P.shape[:3]
    single_level = level / (times * nodes)
    intervals = []
    for k in range(times):
        for i in range(nodes):
            excess = _relative_excess(P[:, k, i], bound[k, i], single_level)
            if excess is not None:
                intervals.append((excess, f"at {samples.point_labels[k * nodes + i]}"))
    if not intervals:
        return Finding((0.0, 0.0, 0.0), BOUND_TOLERANCE, "the bound is singular everywhere")
    message = "largest excess of the mean of P over the bound, relative,"
    return find_largest(intervals, BOUND_TOLERANCE, message)


def _relative_excess(P: FloatArray, bound: FloatArray, level: float) -> Interval | None:
    """Return an interval for the largest eigenvalue of E[P] relative to ``bound``, less 1."""
    scaled, units = in_own_units(bound)
    values, vectors = np.linalg.eigh(scaled)
    if not values[0] > 1e-12 * values[-1]:
        return None
    white = vectors / np.sqrt(values) / units[:, None]
    ratio = eigenvalue_interval(white.T @ P @ white, level)
    # An event of probability up to log(1 / level) / R may have occurred in no run. It could bring P
    # down to 0, so that the lower limit of E[P] is reduced by this share.
    unseen = min(1.0, math.log(1.0 / level) / len(P))
    excess = affine(ratio, 1.0, -1.0)
    # The reduced limit must still exceed 1.
    detectable = (1.0 + ratio.detectable) / (1.0 - unseen) - 1.0 if unseen < 1.0 else math.nan
    return excess._replace(low=ratio.low * (1.0 - unseen) - 1.0, detectable=detectable)


def _bound_settles(samples: HybridSamples, level: float) -> Finding:
    """Check that the bound on the mean of P, H (12), reaches its steady state."""
    promised = with_promised_filter(samples.scenario)
    steady_bound, distance, factor = steady_covariance_bound(promised), np.inf, 1.0
    units = row_units(np.diagonal(steady_bound, axis1=1, axis2=2).max(axis=0))
    size = np.abs(in_units(steady_bound, units)).max()
    while distance > STEADY_TOLERANCE and factor < MAX_TIME:
        factor *= 10.0
        bound = covariance_bound(promised, np.array([factor * samples.scenario.horizon]))[0]
        distance = float(np.abs(in_units(bound - steady_bound, units)).max() / size)
    message = (
        f"computed, not simulated: the bound at {factor:g} horizons differs from its steady state "
        f"by {distance:.1e} of the largest entry"
    )
    margin = STEADY_TOLERANCE - distance
    return Finding((margin, margin, margin), 0.0, message, early=margin < 0.0)


def _bound_approaches_limit(samples: HybridSamples, level: float) -> Finding:
    """Check that the steady bound approaches S as one over the rate of links, H Theorem 3."""
    promised = with_promised_filter(samples.scenario)
    # Links so fast that the distance is already in its power law.
    S, first = limit_covariance(promised), _mixing_factor(promised)
    units, distances = row_units(np.diagonal(S)), []
    for factor in (first, 10.0 * first):
        bound = steady_covariance_bound(_with_faster_links(promised, factor))
        distances.append(float(np.linalg.norm(in_units(bound - S, units), axis=(1, 2)).max()))
    size = float(np.linalg.norm(in_units(S, units)))
    if distances[-1] <= DISTANCE_TOLERANCE * size:
        message = (
            f"computed, not simulated: with rates {first:.3g} and {10.0 * first:.3g} times larger "
            f"the distance is {distances[0]:.1e} and {distances[1]:.1e}, no more than S is known to"
        )
        return Finding((0.0, 0.0, 0.0), SLOPE_TOLERANCE, message)
    slope = float(np.log10(distances[1] / distances[0]))
    # The theorem bounds the distance by a constant over the rate: faster decay is allowed.
    margin = -max(0.0, slope + 1.0)
    message = (
        f"computed, not simulated: with rates {first:.3g} and {10.0 * first:.3g} times larger the "
        f"distance is {distances[0]:.3g} and {distances[1]:.3g}, exponent {slope:.3f}"
    )
    if margin < -SLOPE_TOLERANCE:  # no run shows it, so that no filter can have broken it
        return find_unknown(f"{message}: the exponent is that of faster links", SLOPE_TOLERANCE)
    return Finding((margin, margin, 0.0), SLOPE_TOLERANCE, message)


def _constant_gains_are_worse(samples: HybridSamples, level: float) -> Finding:
    promised = with_promised_filter(samples.scenario)
    times = np.array(check_times(samples.scenario))
    time_varying, constant = covariance_bound(promised, times), constant_gain_bound(promised, times)
    units = row_units(np.diagonal(time_varying, axis1=-2, axis2=-1).max(axis=(0, 1)))
    time_varying, constant = in_units(time_varying, units), in_units(constant, units)
    size = np.trace(time_varying, axis1=-2, axis2=-1)
    smallest = np.linalg.eigvalsh(constant - time_varying)[..., 0] / np.maximum(size, 1e-300)
    trace_excess = np.trace(constant, axis1=-2, axis2=-1) / np.maximum(size, 1e-300) - 1.0
    message = (
        "computed, not simulated: constant gains have a trace larger by up to "
        f"{trace_excess.max():.2%} at the times looked at, and the same steady state"
    )
    return find_identity(float(max(0.0, -smallest.min())), GAIN_TOLERANCE, message)


def _mixing_factor(scenario: Scenario) -> float:
    S, slowest = limit_covariance(scenario), _slowest_mixing(coupling(scenario))
    models = {id(model): model for model in scenario.models}.values()  # nodes share them
    scaled, units = in_own_units(S)
    size = np.linalg.norm(scaled, 2)
    speeds = [
        np.linalg.norm(m.A * units / units[:, None], 2)
        + size * np.linalg.norm(units[:, None] * m.H.T @ np.linalg.solve(m.R, m.H * units), 2)
        for m in models
    ]
    return max(1.0, 100.0 * float(max(speeds)) / slowest)


def _slowest_mixing(mixing: SparseOrFull) -> float:
    """Return the rate (1/s) at which differences between nodes decay under exchanges alone."""
    leaving = np.asarray(mixing.sum(axis=1)).reshape(-1)
    laplacian = scipy.sparse.csc_array(scipy.sparse.diags_array(leaving) - mixing)
    if laplacian.shape[0] <= MAX_DENSE:
        return float(np.sort(np.linalg.eigvals(laplacian.toarray()).real)[1])
    largest = float(leaving.max())
    start = arnoldi_start(len(leaving))
    try:  # the eigenvalues closest to a point just below 0, where the matrix is regular
        values = scipy.sparse.linalg.eigs(
            laplacian, k=2, sigma=-1e-6 * largest, v0=start, return_eigenvectors=False, tol=1e-8
        )
    except (scipy.sparse.linalg.ArpackError, RuntimeError) as error:
        raise TheoryError(f"how fast the network mixes was not found: {error}") from None
    return float(np.sort(values.real)[1])


@lru_cache(maxsize=8)
def _with_faster_links(scenario: Scenario, factor: float) -> Scenario:
    clock = scenario.network.activation
    if not isinstance(clock, (Poisson, Renewal)) or clock.rate is None:
        raise TheoryError("the clocks have no rate to raise")
    changes: dict[str, Any] = {"network.activation.rate": factor * clock.rate}
    if isinstance(clock, Poisson) and clock.rates:
        listed = [[*row[:-1], factor * row[-1]] for row in clock.rates]
        changes["network.activation.rates"] = listed
    try:
        return scenario.replace(changes)
    except ScenarioError as error:
        raise TheoryError(f"links cannot tick so fast: {error}") from None


# What promises need: parts of names or sources in the table of assumptions, see ``Promise.needs``.
EVENTS = ("the filters know", "the filters start", "P_i(0) >=", "exact errors are within reach")
PROMISES = (
    Promise(
        "P follows the equations: flow between ticks, resets with values from before",
        "H (4b), (7), (9)",
        ("exact errors are within reach",),
        check_replay,
        exact=True,
    ),
    Promise(
        "P is at least the covariance of the error, given the ticks",
        "H (10)",
        ("the filters know", "P_i(0) >=", "exact errors are within reach"),
        check_upper_bound,
        exact=True,
    ),
    *error_promises("H (4a), (7), derived"),
    Promise(
        "NEES has the mean that exact errors say, at most n",
        "H (10), derived",
        EVENTS,
        check_expected_nees,
    ),
    Promise(
        "the mean of P stays below the coupled Riccati bound",
        "H Theorem 2, (12); derived, samples",
        ("H(12) speaks", "the covariance has a variance"),
        _mean_below_bound,
    ),
)
SETTLES = ("H(12) speaks", "H(12) has a steady state")
LIMITS = (
    Promise(
        "the bound settles", "H Proposition 4", SETTLES, _bound_settles, exact=True, group=COMPUTED
    ),
    Promise(
        "time-varying gains have a smaller bound than constant ones",
        "H Remark 1, (15)",
        SETTLES,
        _constant_gains_are_worse,
        exact=True,
        group=COMPUTED,
    ),
    Promise(
        "the steady bound approaches S as one over the rate of the links",
        "H Theorem 3, (13)",
        ("H(12) speaks",),
        _bound_approaches_limit,
        exact=True,
        group=COMPUTED,
    ),
)


def _assumptions(scenario: Scenario) -> list[Assumption]:
    promised = with_promised_filter(scenario)
    # H(12) are the coupled Riccati equations that bound the mean of P.
    reason = reason_without_bound(promised)
    speaks = "H(12) speaks about the scenario"
    return [
        Assumption(speaks, "H (12)", reason is None, reason or "it does"),
        *usual_assumptions(scenario),
        _variance_exists(promised),
        *_settling_rows(promised),
    ]


def _promises(scenario: Scenario) -> tuple[Promise, ...]:
    listed, promised = list(PROMISES), with_promised_filter(scenario)
    # One function for each of LIMITS raises TheoryError if its subject does not exist.
    requirements = has_steady_state, _require_constant_gains, _require_limit
    for promise, require in zip(LIMITS, requirements, strict=True):
        with contextlib.suppress(TheoryError):
            require(promised)
            listed.append(promise)
    return tuple(listed)


def _settling_rows(scenario: Scenario) -> list[Assumption]:
    """Return the assumption that the bound has a steady state; none if it is not decided."""
    try:
        settles = has_steady_state(scenario)
    except TheoryError:
        return []
    evidence = "links are fast enough"
    if not settles:
        # What it would take is found by a search, which takes seconds for many nodes.
        evidence = "H Proposition 4 is false here: netkf theory says why"
        if len(scenario.nodes) <= MAX_DENSE:
            try:
                steady_covariance_bound(scenario)
            except TheoryError as error:
                evidence = f"H Proposition 4 is false here: {error}"
    return [Assumption("H(12) has a steady state", "H (12), (16)", settles, evidence)]


def _require_constant_gains(scenario: Scenario) -> None:
    if not scenario.filter.algorithm.timing.talks:
        raise TheoryError("without messages the gains are those of Kalman-Bucy filters")
    if has_steady_state(scenario):
        constant_gain_bound(scenario)


def _require_limit(scenario: Scenario) -> None:
    if len(scenario.nodes) == 1 or scenario.network.channel.delay.fixed != 0.0:
        raise TheoryError("S is the limit for links that take no time")
    steady_covariance_bound(_with_faster_links(scenario, 10.0 * _mixing_factor(scenario)))


CHECKS = PaperChecks(_promises, _assumptions, collect=HybridSamples)
