"""Comparison of runs with exact covariances.

Given the events of a run (ticks, losses, delays) the errors are Gaussian. Theory computes their
covariance, and P, from the events alone, without the engine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import scipy

from netkf.algorithms.registry import LINK_WEIGHTS, base_filter, built_in_class, own_attributes
from netkf.checks.evidence import (
    EPS,
    OPERATIONS,
    Assumption,
    Finding,
    error_test,
    find_nothing,
    find_unknown,
    gaussian_test,
)
from netkf.checks.laws import EVERYTHING, NEES_TOLERANCE, compare_chi_square, find_largest, pool
from netkf.checks.samples import (
    ReplicaSummary,
    RunSamples,
    check_slots,
    checked_samples,
    compare_points,
    errors_at_once,
    probe_times,
    sampled_indices,
)
from netkf.checks.statistics import quadratic_interval
from netkf.core.errors import TheoryError
from netkf.laws.intervals import (
    POWER,
    Interval,
    deviation_interval,
    scale_interval,
    student_interval,
)
from netkf.laws.noise import MIN_VARIANCE_SHARE, whiten
from netkf.linalg.arrays import FloatArray, IntArray, in_own_units, in_units, row_units
from netkf.scenario.records import nodes_with_law
from netkf.scenario.scenario import Scenario
from netkf.theory.common.increments import integration_steps
from netkf.theory.errors import ErrorLaw, diagonal_blocks, error_law, require_errors
from netkf.trace.nees import BLUR, errors
from netkf.trace.run import Run, blurred_samples

MAX_REPLAYED, MIN_REPLAYED, MAX_REPLAYED_STEPS = 1000, 20, 250_000
"""Limits on the number of replicas whose exact covariances are computed (the others give errors
only), and on their total number of slots or integration steps, of a tenth of a millisecond each.
"""
ENOUGH_ERRORS, ENOUGH_RUNS = 24_000, 400
"""Number of errors that reveal a covariance that is wrong by 5 %, beyond which no more runs are
replayed; and the number of runs that tests of one node at one slot need.
"""
MAX_ERRORS = 64
"""Largest number of errors of all nodes for which the joint covariance is computed."""
MIN_VARIANCE = 1e-8
"""Relative variance below which a direction is left out, because its errors are rounding."""
EXACT_TOLERANCE, BIAS_TOLERANCE = 1e-8, 0.5
"""Difference of P from Sigma, relative to its trace, that rounding may cause in any case, and
tolerated bias in standard deviations of an error.
"""
SINGULAR = 1e-12
"""Ratio of smallest to largest eigenvalue below which a covariance counts as singular."""


def summarise_exactly(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return P, errors, NEES and the exact law of the errors given the events; nan for later
    replicas, too many errors together, or unknown equations.
    """
    at, sampled = checked_samples(scenario, run.times), sampled_indices(scenario)
    whole, known = run, nodes_with_law(scenario)
    if not known.all():
        # Without the nodes that follow what is recorded; states that are unknown round nothing.
        x, error, P = np.nan_to_num(run.x), run.error[:, known], run.P[:, known]
        run = dataclasses.replace(run, x=x, error=error, P=P)
        sampled = np.searchsorted(np.flatnonzero(known), sampled)
    times, nodes, n = run.error.shape
    e = np.where(blurred_samples(run, run.P)[..., None], np.nan, run.error)
    law = None
    is_replayed = few_errors(scenario).holds
    if is_replayed and run.replica < max_replayed(scenario):
        # Where there is none an assumption says so, and rows that need it are not promised.
        with contextlib.suppress(TheoryError):
            law = _law_of_nodes(error_law(with_promised_filter(scenario), whole), known)
    if law is None:
        by_node = {name: np.full(run.P.shape, np.nan) for name in ("replayed", "Sigma")}
        by_node["mean"] = np.full(e.shape, np.nan)
        # One weight for each error of all nodes at all sample times.
        size = times * nodes * n if not known.all() else times * errors_at_once(scenario)
        size = size if is_replayed else 0  # of no run
        shapes = {"whole": (len(at), 2), "joint": (2,), "quadratic": (1 + size,)}
        pooled = {name: np.full(shape, np.nan) for name, shape in shapes.items()}
        pooled["bias"] = np.full((n, n + 1), np.nan)
    else:
        by_node, pooled = _exact_statistics(scenario, run, law, at)
        # All nodes share one pooled filter.
        copies = nodes // law.P.shape[1]
        by_node = {name: np.repeat(part, copies, axis=1) for name, part in by_node.items()}
        blurred = blurred_samples(run, by_node["Sigma"])
        e = np.where(blurred[..., None], np.nan, e)
        if blurred[at][:, sampled].any():  # the sum over all errors is spoilt by any of them
            pooled["quadratic"] = np.full_like(pooled["quadratic"], np.nan)
    unknown = np.isnan(e).any(axis=-1) | _nearly_singular(run.P)
    by_node |= {"P": run.P, "e": e, "nees": np.where(unknown, np.nan, errors(run.error, run.P)[1])}
    kept = {name: part[at][:, sampled] for name, part in by_node.items()}
    return ReplicaSummary(**kept, **pooled)


def _law_of_nodes(law: ErrorLaw, known: np.ndarray) -> ErrorLaw:
    """Return the law of the errors of the nodes in a mask (N,), where it has all."""
    if known.all():
        return law
    times, _, n = law.P.shape[:3]
    kept = np.tile(np.repeat(known, n), times)
    return ErrorLaw(law.mean[kept], law.covariance[np.ix_(kept, kept)], law.P[:, known])


def _exact_statistics(
    scenario: Scenario, run: Run, law: ErrorLaw, at: IntArray
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Return the fields of a summary by time (T) and estimator (M), and those of all together."""
    times, M, n = law.P.shape[:3]
    size = M * n
    # The covariance (times, size, size) at each time is a diagonal block of that over all times.
    stacked = np.einsum("kakb->kab", law.covariance.reshape(times, size, times, size))
    mean = law.mean.reshape(times, M, n)
    # Errors less their exact mean are normal with mean 0.
    centred = run.error[:, :M] - mean
    floor = np.maximum((BLUR * run.rounding) ** 2, _variance_floor(scenario))
    units = row_units(np.diagonal(stacked, axis1=1, axis2=2)).reshape(-1)
    joint, bias = _pool_times(centred, law.covariance, units, float(floor.max()))
    pooled = {
        "whole": whiten_errors(centred[at], stacked[at], floor[at]),
        "joint": joint,
        "quadratic": _pool_nees(centred, run.P[:, :M], law),
        "bias": bias,
    }
    return {"replayed": law.P, "mean": mean, "Sigma": diagonal_blocks(stacked, M)}, pooled


def max_replayed(scenario: Scenario) -> int:
    """Return the number of first replicas whose exact covariances are computed, for their time."""
    per_run = len(probe_times(scenario)) * errors_at_once(scenario)
    steps, min_replicas = integration_steps(scenario), 0
    if scenario.slotted:
        steps, min_replicas = check_slots(scenario)[-1], ENOUGH_RUNS
    affordable = MAX_REPLAYED_STEPS // max(steps, 1)
    needed = max(math.ceil(ENOUGH_ERRORS / per_run), min_replicas)
    return max(MIN_REPLAYED, min(MAX_REPLAYED, needed, affordable))


def _pool_times(
    e: FloatArray, Sigma: FloatArray, units: FloatArray, floor: float
) -> tuple[FloatArray, FloatArray]:
    n = e.shape[-1]
    # Variances may differ by orders of magnitude between times and states.
    values, vectors = np.linalg.eigh(in_units(Sigma, units))
    rounding = floor * np.square(vectors / units[:, None]).sum(axis=0)
    varying = (values > MIN_VARIANCE * values[-1]) & (values > rounding)
    whitening = (vectors / np.sqrt(np.where(varying, values, np.inf))).T / units
    z = whitening @ e.reshape(-1)
    # A constant bias b shifts all errors by X b, X the stacked identities (K M n, n). The design
    # matrix of z is whitening X: D' D is the information and D' z the information vector of b.
    design = whitening.reshape(len(whitening), -1, n).sum(axis=1)
    bias = np.concatenate([design.T @ design, (design.T @ z)[:, None]], axis=1)
    return np.array([z @ z, varying.sum()]), bias


def _pool_nees(e: FloatArray, P: FloatArray, law: ErrorLaw) -> FloatArray:
    """Return the sum of the NEES of a run and the weights of its squares (1 + K M n,)."""
    if _nearly_singular(P).any() or _nearly_singular(law.P).any():
        return np.full(1 + e.size, np.nan)
    n = e.shape[-1]
    # e' D e with D = L' L is a sum of squares of standard normal numbers, weighted by the
    # eigenvalues of L C L'; here L' L = P^-1.
    L = np.linalg.inv(np.linalg.cholesky(law.P)).reshape(-1, n, n)
    blocks = law.covariance.reshape(len(L), n, len(L), n)
    # Scaled to the expected value n, so that none outweighs the others.
    expected = np.einsum("iab,ibic,iac->i", L, blocks, L, optimize=True)
    scales = np.divide(n, expected, out=np.zeros(len(L)), where=expected > 0.0)
    nees = np.einsum("kia,kia->ki", e, np.linalg.solve(P, e[..., None])[..., 0])
    total = (scales * nees.ravel()).sum()
    L = np.sqrt(scales)[:, None, None] * L
    form = np.einsum("iab,ibjc,jdc->iajd", L, blocks, L, optimize=True).reshape(e.size, e.size)
    return np.append(total, np.maximum(np.linalg.eigvalsh(form), 0.0))


def _nearly_singular(P: FloatArray) -> np.ndarray:
    """Return a mask (K, N) of covariances P (K, N, n, n) that are singular or not finite."""
    finite = np.asarray(np.isfinite(P).all(axis=(-1, -2)))
    scaled, _ = in_own_units(np.where(finite[..., None, None], P, 0.0))
    values = np.linalg.eigvalsh(scaled)
    return np.asarray(~(values[..., 0] > SINGULAR * values[..., -1]))


def _variance_floor(scenario: Scenario) -> float:
    """Return the variance below which errors of estimates are rounding."""
    information = float(np.linalg.norm(scenario.node_infos[0].information, 2))
    reading_variance = 1.0 / information if information > 0.0 else 0.0
    return (OPERATIONS * EPS) ** 2 * (reading_variance + float(np.trace(scenario.plant.start_cov)))


def few_errors(scenario: Scenario) -> Assumption:
    """Return the assumption that events give the law of errors, of at most MAX_ERRORS at a time."""
    size = len(scenario.nodes) * scenario.width
    holds, evidence = size <= MAX_ERRORS, f"{size} errors of all nodes, at most {MAX_ERRORS}"
    try:
        require_errors(scenario)
    except TheoryError as error:
        holds, evidence = False, str(error)
    return Assumption("exact errors are within reach", "netkf", holds, evidence)


def whiten_errors(e: FloatArray, stacked: FloatArray, floor: FloatArray | float) -> FloatArray:
    """Return ``e' Sigma^-1 e`` and its degrees of freedom, (K, 2), of errors less their mean ``e``
    (K, N, n) with joint covariances ``stacked`` (K, N n, N n). Directions count if their variance
    is above MIN_VARIANCE times the largest one, in units of the rows, and above that of
    rounding, ``floor`` (K,) in each row.
    """
    finite = np.asarray(np.isfinite(stacked).all(axis=(-1, -2)))
    scaled, units = in_own_units(np.where(finite[:, None, None], stacked, 0.0))
    values, vectors = np.linalg.eigh(scaled)
    rounding = np.reshape(floor, (-1, 1)) * np.square(vectors / units[..., None]).sum(axis=1)
    counted = (values > MIN_VARIANCE * values[:, -1:]) & (values > rounding)
    components = np.einsum("kab,ka->kb", vectors, e.reshape(len(e), -1) / units)
    square = np.where(counted, components**2 / np.where(counted, values, 1.0), 0.0).sum(axis=1)
    return np.stack([square, counted.sum(axis=1)], axis=1)


def with_promised_filter(scenario: Scenario) -> Scenario:
    """Return the scenario with the filter whose promises are checked, see ``promised_filter``."""
    is_promised = promised_filter(scenario.filter.algorithm) is scenario.filter.algorithm
    return scenario if is_promised else with_base_filter(scenario)


@lru_cache(maxsize=8)
def with_base_filter(scenario: Scenario) -> Scenario:
    """Return the scenario with the built-in base of a user's filter; cached with its tables."""
    algorithm: Any = scenario.filter.algorithm
    filtering = dataclasses.replace(scenario.filter, algorithm=base_filter(algorithm))
    return dataclasses.replace(scenario, filter=filtering)


def promised_filter(algorithm: Any) -> Any:
    """Return the filter whose promises are checked for ``algorithm``: itself if it is built in or
    overrides only weights of links, else that of its built-in base. Raises TheoryError without a
    base, and for ``talks = False`` where the base sends messages.
    """
    built_in, name = built_in_class(algorithm), type(algorithm).__name__
    if built_in is None:
        raise TheoryError(
            f"nothing is promised of {name}: derive it from a filter of netkf.parts to say which "
            "one it should be"
        )
    if base_filter(algorithm).timing.talks and not algorithm.timing.talks:
        raise TheoryError(
            f"nothing is promised of {name}: it declares talks = False, and what is promised of "
            f"{built_in.__name__} is about exchanges; derive it from netkf.parts.Local"
        )
    if set(own_attributes(algorithm)) <= set(LINK_WEIGHTS):
        return algorithm
    return base_filter(algorithm)


def check_upper_bound(samples: RunSamples, level: float) -> Finding:
    """Check by the least eigenvalue that P is at least Sigma, exact given the events of the run."""

    def shortfall(gap: FloatArray) -> FloatArray:
        # Covariances that are not finite count as below Sigma; eigvalsh needs finite entries.
        finite = np.nan_to_num(gap, nan=-1e300, posinf=1e300, neginf=-1e300)
        return np.asarray(np.maximum(-np.linalg.eigvalsh(finite)[..., 0], 0.0))

    return _compare_with_exact(samples, shortfall, "least eigenvalue")


def check_exact_covariance(samples: RunSamples, level: float) -> Finding:
    """Check that P is Sigma, the exact covariance given the events of the run, up to rounding."""

    def largest(gap: FloatArray) -> FloatArray:
        deviations = np.abs(gap).max(axis=(-1, -2))
        return np.asarray(np.nan_to_num(deviations, nan=1e300, posinf=1e300))

    return _compare_with_exact(samples, largest, "largest entry")


def _compare_with_exact(
    samples: RunSamples, measure: Callable[[FloatArray], FloatArray], name: str
) -> Finding:
    """Return the finding on a ``measure`` of P - Sigma (R, K, N, n, n), which should be 0."""
    max_runs = max_replayed(samples.scenario)
    P, Sigma = samples.runs.P[:max_runs], samples.runs.Sigma[:max_runs]
    known = np.isfinite(Sigma).all(axis=(-1, -2))
    if not known.any():
        return find_unknown("no exact covariance could be computed")
    P, Sigma = samples.in_units(P), samples.in_units(Sigma)
    size = np.where(known, np.trace(Sigma, axis1=-2, axis2=-1), 0.0)
    limits = size, samples.largest_terms(samples.runs.replayed[:max_runs]), EXACT_TOLERANCE
    message = (
        f"{name} of P - Sigma relative to trace(Sigma), in units of the states, in "
        f"{known.sum():,} covariances"
    )
    return compare_points(samples, measure(P - Sigma) * known, limits, message)


@gaussian_test
def check_error_covariance(samples: RunSamples, level: float) -> Finding:
    """Test that errors have their exact law given the events: e' Sigma^-1 e is chi-square at every
    point and for all nodes, with half of ``level``, and for all times (``runs.joint``).
    """
    runs, scenario = samples.runs, samples.scenario
    n, max_runs = scenario.width, max_replayed(scenario)
    Sigma, all_nodes = runs.Sigma[:max_runs], runs.whole[:max_runs]
    e = runs.e[:max_runs] - runs.mean[:max_runs]
    if np.isnan(e).all():
        return find_nothing(NEES_TOLERANCE)
    # Each node and time by itself: N = 1. Directions without variance have no degree of freedom.
    floor = _variance_floor(scenario)
    single = whiten_errors(e.reshape(-1, 1, n), Sigma.reshape(-1, n, n), floor)
    single = single.reshape(len(e), -1, 2)
    squares = np.concatenate([single, all_nodes], axis=1)
    freedom = np.nan_to_num(squares[..., 1]).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = squares[..., 0] * (len(e) / freedom)
    labels = [*samples.point_labels, *(f"{time}, all nodes" for time in samples.time_labels)]
    # Half of the level for the points, half for all of them pooled, which is far more sensitive.
    finding = compare_chi_square(ratios, freedom.tolist(), labels, level / 2.0, "e' Sigma^-1 e")
    finding = pool(finding, _compare_pooled(runs.joint[:max_runs], level / 2.0), EVERYTHING)
    return finding._replace(message=finding.message + samples.blurred_note, most_runs=max_runs)


def _compare_pooled(joint: FloatArray, level: float) -> Interval:
    total, freedom = joint[np.isfinite(joint).all(axis=1)].sum(axis=0).tolist()
    if not freedom > 0.0:
        return Interval(math.nan, 0.0, math.inf)
    return deviation_interval(1.0, scale_interval(total, freedom, level))


@error_test
def check_bias(samples: RunSamples, level: float) -> Finding:
    """Test for a constant bias of errors, by generalised least squares from ``runs.bias``."""
    # Only these runs have exact covariances.
    max_runs = max_replayed(samples.scenario)
    bias, Sigma = samples.runs.bias[:max_runs], samples.runs.Sigma[:max_runs]
    bias = bias[np.isfinite(bias).all(axis=(1, 2))]
    n = bias.shape[1]
    if not len(bias) or not np.abs(bias).any():
        return find_nothing(BIAS_TOLERANCE)
    information, vector = bias[:, :, :n].sum(axis=0), bias[:, :, n].sum(axis=0)
    # z is standard normal without a bias, and the whitened estimate of the bias is spread @ z.
    factor = whiten(information, MIN_VARIANCE_SHARE).factor
    z = factor @ vector
    covariances = Sigma.reshape(-1, n, n)
    typical = covariances[np.isfinite(covariances).all(axis=(1, 2))].mean(axis=0)
    spread = whiten(typical, MIN_VARIANCE_SHARE).factor @ factor.T
    length = _length_interval(spread, z, level)
    message = "bias that all errors share, in standard deviations of an error,"
    finding = find_largest([(length, "all nodes and times")], BIAS_TOLERANCE, message)
    return finding._replace(most_runs=max_runs)


def gaussian_radius(level: float, n: int) -> float:
    """Return the radius that a standard Gaussian vector (n,) exceeds with probability ``level``."""
    return math.sqrt(2.0 * float(scipy.special.gammainccinv(n / 2.0, level)))


def detectable_length(radius: float, n: int) -> float:
    """Return the length of a mean that makes a Gaussian (n,) exceed ``radius`` by chance POWER."""
    return math.sqrt(float(scipy.special.chndtrinc(radius**2, n, 1.0 - POWER)))


def _length_interval(spread: FloatArray, z: FloatArray, level: float) -> Interval:
    """Return an interval for |spread m|, where ``z`` (k,) is normal with mean m, covariance I."""
    reach = gaussian_radius(level, len(z))
    sizes = np.linalg.svd(spread, compute_uv=False)
    smallest = float(sizes[-1]) if len(sizes) == len(z) else 0.0
    value, max_reach = float(np.linalg.norm(spread @ z)), reach * float(sizes[0])
    # The mean is within ``reach`` of z, so that |spread m| >= (|z| - reach) smallest.
    excess = float(np.linalg.norm(z)) - reach
    low = max(value - max_reach, excess * max(smallest, 1e-9 * float(sizes[0])), 0.0)
    detectable = detectable_length(reach, len(z)) * float(sizes[0])
    low = low if excess > 0.0 else 0.0
    return Interval(value, low, value + max_reach, detectable, seen=value, expected=0.0)


@gaussian_test
def check_expected_nees(samples: RunSamples, level: float) -> Finding:
    """Test that NEES, a sum of squares of normals weighted by the eigenvalues of P^-1 Sigma, scaled
    to n, has its expected value given the events.
    """
    runs, n = samples.runs, samples.scenario.width
    max_runs = max_replayed(samples.scenario)
    P, Sigma = runs.replayed[:max_runs], runs.Sigma[:max_runs]
    # Points without exact covariances have no weight, and so are not tested.
    known = np.isfinite(P + Sigma).all(axis=(-1, -2), keepdims=True)
    P, Sigma = np.where(known, P, 0.0), np.where(known, Sigma, 0.0)
    scaled, units = in_own_units(P)
    inverse = in_units(np.asarray(np.linalg.pinv(scaled)), units)
    m = runs.mean[:max_runs]  # the exact mean of the errors
    weights = np.linalg.eigvals(inverse @ Sigma).real
    weights = np.maximum(weights, 0.0).reshape(len(P), -1, n)
    mean = weights.sum(axis=(0, 2))
    nees = runs.nees[:max_runs]
    if np.nan_to_num(m).any():
        e = runs.e[:max_runs] - m
        nees = np.einsum("rkna,rknab,rknb->rkn", e, inverse, e)
    nees = nees.reshape(len(P), -1)
    tested = np.flatnonzero(np.isfinite(nees).all(axis=0) & (mean > 0.0))
    if np.isnan(runs.e[:max_runs]).all():
        return find_nothing(NEES_TOLERANCE)
    if not len(tested):
        reason = "NEES does not exist: P is singular, or P or the errors are not finite"
        return find_unknown(reason, NEES_TOLERANCE)
    # Factors that scale each NEES to the expected value n: its expected value is the weights' sum.
    intervals, sizes = [], weights.sum(axis=2, keepdims=True)
    units = np.divide(n, sizes, out=np.zeros(sizes.shape), where=sizes > 0.0)
    for k in tested.tolist():
        total, single_level = float((units[:, k, 0] * nees[:, k]).sum()), 0.5 * level / len(tested)
        ratio = quadratic_interval(total, (units * weights)[:, k].ravel(), single_level)
        intervals.append((deviation_interval(1.0, ratio), f"at {samples.point_labels[k]}"))
    message = (
        f"mean NEES {nees[:, tested].mean():.4g}, exact errors say "
        f"{mean[tested].mean() / len(P):.4g}, n is {n}; largest relative difference"
    )
    quadratic = runs.quadratic[:max_runs]
    quadratic = quadratic[np.isfinite(quadratic).all(axis=1)]
    pooled = quadratic_interval(float(quadratic[:, 0].sum()), quadratic[:, 1:].ravel(), 0.5 * level)
    pooled = deviation_interval(1.0, pooled) if len(quadratic) else pooled
    finding = pool(
        find_largest(intervals, NEES_TOLERANCE, message), pooled, EVERYTHING, NEES_TOLERANCE
    )
    return finding._replace(message=finding.message + samples.blurred_note, most_runs=max_runs)


@gaussian_test
def check_nees(samples: RunSamples, level: float) -> Finding:
    """Test that errors are Gaussian with covariance P: the sum of NEES over R runs is chi-square
    with R n degrees of freedom at every node and time.
    """
    n, nees = samples.scenario.width, samples.runs.nees.reshape(samples.count, -1)
    if np.isnan(samples.runs.e).all():
        return find_nothing(NEES_TOLERANCE)
    freedom = [n * len(nees)] * nees.shape[1]
    finding = compare_chi_square(nees / n, freedom, samples.point_labels, level / 2.0, "NEES")
    finite = nees[:, np.isfinite(nees).all(axis=0)]
    if finite.size:
        # Points of a run add at most their deviations: they count as one of them.
        total, count = len(finite) * float(finite.mean()), float(len(finite) * n)
        pooled = deviation_interval(1.0, scale_interval(total, count, level / 2.0))
        finding = pool(finding, pooled, EVERYTHING, NEES_TOLERANCE)
    return finding._replace(message=finding.message + samples.blurred_note)


@error_test
def check_nees_bound(samples: RunSamples, level: float) -> Finding:
    """Test that the mean of NEES / n is at most 1, by Student's interval: events depend on data."""
    n, nees = samples.scenario.width, samples.runs.nees.reshape(samples.count, -1)
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
