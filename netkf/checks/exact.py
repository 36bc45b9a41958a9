"""Runs against their exact covariances: theory computes from the events of a run what P and the
covariance of the errors must be, without the engine.
"""

from __future__ import annotations

import dataclasses
import math
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.special

from netkf.algorithms.registry import LINK_WEIGHTS, base_filter, built_in_class, own_attributes
from netkf.checks.evidence import (
    Assumption,
    Finding,
    find_nothing,
    find_unknown,
    gaussian_test,
)
from netkf.checks.laws import (
    EVERYTHING,
    NEES_TOLERANCE,
    compare_chi_square,
    find_largest,
    pool,
)
from netkf.checks.parts.moments import whitening_matrix
from netkf.checks.points import (
    check_slots,
    checked_samples,
    errors_at_once,
    probe_times,
    sampled_indices,
)
from netkf.checks.rounding import EPS, OPERATIONS, compare_identities
from netkf.checks.samples import ReplicaSummary, RunSamples, with_departure
from netkf.checks.statistics import (
    POWER,
    Interval,
    deviation_interval,
    quadratic_interval,
    scale_interval,
)
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.errors import diagonal_blocks, error_law
from netkf.theory.common.replay import ErrorLaw
from netkf.theory.common.stacked_errors import integration_steps
from netkf.trace.nees import errors
from netkf.trace.run import BLUR, Run, blurred_samples

MAX_REPLAYED, MIN_REPLAYED, MAX_REPLAYED_STEPS = 1000, 20, 250_000
"""Replicas whose exact covariances are computed, fewer (but at least 20) where there are many slots
or errors are integrated in many short steps; the others show their errors only. A step takes a
tenth of a millisecond.
"""
ENOUGH_ERRORS, ENOUGH_RUNS = 24_000, 400
"""Errors with which a covariance that is wrong by 5 % is found; more are not replayed. In slots,
where limits are promised to each node, rows about one node at one time need so many runs.
"""
MAX_ERRORS = 64
"""Errors of all nodes together for which the exact covariance (64, 64) is cheap."""
MIN_VARIANCE = 1e-8
"""Relative variance below which a direction is left out: rounding decides about its errors."""
BOUND_TOLERANCE, BIAS_TOLERANCE = 1e-8, 0.5
SINGULAR = 1e-12
"""Relative size of an eigenvalue below which a covariance has no inverse to judge by."""


def summarise_exactly(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return the summary of a run at the sampled nodes, with exact covariances if the errors of all
    nodes are few enough.
    """
    at, sampled = checked_samples(scenario, run.times), sampled_indices(scenario)
    _, nees = errors(run.error, run.P)
    e = np.where(blurred_samples(run, run.P)[..., None], np.nan, run.error)
    nees = np.where(np.isnan(e).any(axis=-1) | _nearly_singular(run.P), np.nan, nees)
    P, e, nees = run.P[at][:, sampled], e[at][:, sampled], nees[at][:, sampled]
    if run.replica < max_replayed(scenario) and few_errors(scenario).holds:
        try:
            law = error_law(with_promised_filter(scenario), run)
        except TheoryError:  # an assumption says so, and rows that need them are not promised
            return _summary_without_replay(P, e, nees, len(run.times) * errors_at_once(scenario))
        return _replayed_summary(scenario, run, law, e, nees)
    return _summary_without_replay(P, e, nees, len(run.times) * errors_at_once(scenario))


def max_replayed(scenario: Scenario) -> int:
    """Return the number of replicas whose exact covariances are computed."""
    per_run = len(probe_times(scenario)) * errors_at_once(scenario)
    steps, least = integration_steps(scenario), 0
    if scenario.slotted:
        steps, least = check_slots(scenario)[-1], ENOUGH_RUNS
    affordable = MAX_REPLAYED_STEPS // max(steps, 1)
    enough = max(math.ceil(ENOUGH_ERRORS / per_run), least)
    return max(MIN_REPLAYED, min(MAX_REPLAYED, enough, affordable))


def _summary_without_replay(
    P: FloatArray, e: FloatArray, nees: FloatArray, size: int
) -> ReplicaSummary:
    """Return a summary without exact covariances; ``size`` is the number of all errors."""
    times, n = len(P), P.shape[-1]
    unknown, pair = np.full(P.shape, np.nan), np.full(2, np.nan)
    return ReplicaSummary(
        P,
        e,
        nees,
        replayed=unknown,
        mean=np.full(e.shape, np.nan),
        Sigma=unknown,
        whole=np.tile(pair, (times, 1)),
        joint=pair,
        quadratic=np.full(1 + size, np.nan),
        bias=np.full((n, n + 1), np.nan),
    )


def _replayed_summary(
    scenario: Scenario, run: Run, law: ErrorLaw, e: FloatArray, nees: FloatArray
) -> ReplicaSummary:
    """Return the summary of a run with the exact law of its errors."""
    at, sampled = checked_samples(scenario, run.times), sampled_indices(scenario)
    nodes, times, estimators, n = (
        len(scenario.nodes),
        len(run.times),
        law.P.shape[1],
        scenario.plant.n,
    )
    size = estimators * n
    # Blocks on the diagonal: the covariance at each time.
    stacked = np.einsum("kakb->kab", law.covariance.reshape(times, size, times, size))
    mean = law.mean.reshape(times, estimators, n)
    Sigma, replayed = diagonal_blocks(stacked, estimators), law.P
    centred = run.error[:, :estimators] - mean
    floor = np.maximum((BLUR * run.rounding) ** 2, _variance_floor(scenario))
    whole = whiten_errors(centred[at], stacked[at], MIN_VARIANCE, floor[at])
    joint, bias = _pool_times(centred, law.covariance, float(floor.max()))
    quadratic = _pool_nees(centred, run.P[:, :estimators], law)
    if estimators < nodes:  # all share one pooled filter
        mean, Sigma, replayed = (np.repeat(part, nodes, axis=1) for part in (mean, Sigma, replayed))
    lost = blurred_samples(run, Sigma)[at][:, sampled]
    if lost.any():
        quadratic = np.full_like(quadratic, np.nan)
    e = np.where(lost[..., None], np.nan, e)
    nees = np.where(np.isnan(e).any(axis=-1), np.nan, nees)
    replayed, mean, Sigma = (part[at][:, sampled] for part in (replayed, mean, Sigma))
    P = run.P[at][:, sampled]
    return ReplicaSummary(P, e, nees, replayed, mean, Sigma, whole, joint, quadratic, bias)


def _pool_times(
    e: FloatArray, covariance: FloatArray, floor: float
) -> tuple[FloatArray, FloatArray]:
    """Return the squared errors of all times together with their degrees of freedom (2,), and what
    they say about a bias that all of them have, (n, n + 1).

    ``e`` is (K, M, n) less its mean, ``covariance`` (K M n, K M n); on directions that are left out
    see :func:`whiten_errors`.
    """
    size, n = e[0].size, e.shape[-1]
    # Errors of different times differ in size by far: each is compared with that of its own time.
    scale = np.repeat(np.sqrt(np.diagonal(covariance).reshape(-1, size).max(axis=1)), size)
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    used = (values > MIN_VARIANCE * values[-1]) & (values > floor / scale.min() ** 2)
    white = (vectors / np.sqrt(np.where(used, values, np.inf))).T / scale
    z = white @ e.reshape(-1)
    # A constant bias b adds white X b, with X the identities of all estimates below each other.
    design = white.reshape(len(white), -1, n).sum(axis=1)
    bias = np.concatenate([design.T @ design, (design.T @ z)[:, None]], axis=1)
    return np.array([z @ z, used.sum()]), bias


def _pool_nees(e: FloatArray, P: FloatArray, law: ErrorLaw) -> FloatArray:
    """Return the sum of ``e' P^-1 e`` over all times and estimators, each in units of its expected
    value over n, and its weights given the events, (1 + K M n,); all nan if some P has no inverse.

    ``e`` is (K, M, n) less its mean, ``P`` (K, M, n, n) that of the run; expected values and
    weights are those for the P that the events should give. In these units a node that is far too
    sure for a moment does not outweigh all others.
    """
    if _nearly_singular(P).any() or _nearly_singular(law.P).any():
        return np.full(1 + e.size, np.nan)
    n = e.shape[-1]
    # e' D e with D = L L' has the weights of the eigenvalues of L' C L.
    L = np.linalg.inv(np.linalg.cholesky(law.P)).reshape(-1, n, n)
    blocks = law.covariance.reshape(len(L), n, len(L), n)
    share = nees_shares(np.einsum("iab,ibic,idc->iad", L, blocks, L, optimize=True))
    each = np.einsum("kia,kia->ki", e, np.linalg.solve(P, e[..., None])[..., 0])
    total = (share * each.ravel()).sum()
    L = np.sqrt(share)[:, None, None] * L
    moved = np.einsum("iab,ibjc,jdc->iajd", L, blocks, L, optimize=True).reshape(e.size, e.size)
    return np.append(total, np.maximum(np.linalg.eigvalsh(moved), 0.0))


def nees_shares(whitened: FloatArray) -> FloatArray:
    """Return n over the expected NEES (K,), the traces of ``whitened`` (K, n, n); 0 where that is
    0.
    """
    expected = np.trace(whitened, axis1=-2, axis2=-1)
    return np.asarray(
        np.divide(whitened.shape[-1], expected, out=np.zeros(len(expected)), where=expected > 0)
    )


def _nearly_singular(P: FloatArray) -> np.ndarray:
    """Return (K, N) bool: rounding decides about the inverses of covariances (K, N, n, n)."""
    finite = np.asarray(np.isfinite(P).all(axis=(-1, -2)))
    values = np.linalg.eigvalsh(np.where(finite[..., None, None], P, 0.0))
    return np.asarray(~(values[..., 0] > SINGULAR * values[..., -1]))


def _variance_floor(scenario: Scenario) -> float:
    """Return the variance below which errors are rounding, from the start and the steady
    covariance.
    """
    information = float(np.linalg.norm(scenario.node_infos[0].information, 2))
    left = 1.0 / information if information > 0.0 else 0.0
    return (OPERATIONS * EPS) ** 2 * (left + float(np.trace(scenario.plant.start_cov)))


def few_errors(scenario: Scenario) -> Assumption:
    """Return the assumption that the exact covariance of all errors together can be computed."""
    size = len(scenario.nodes) * scenario.plant.n
    evidence = f"{size} errors of all nodes together, at most {MAX_ERRORS}"
    return Assumption("exact errors are within reach", "netkf", size <= MAX_ERRORS, evidence)


def whiten_errors(
    e: FloatArray, stacked: FloatArray, least: float, floor: FloatArray | float = 0.0
) -> FloatArray:
    """Return ``e' Sigma^-1 e`` of all nodes together and its degrees of freedom, (K, 2).

    ``e`` is (K, N, n) and ``stacked`` (K, N n, N n). Directions count if their variance is at least
    ``least`` times the largest one and above ``floor`` (K,), which rounding reaches. Those with
    small variances show how far the nodes disagree.
    """
    known = np.asarray(np.isfinite(stacked).all(axis=(-1, -2)))
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], stacked, 0.0))
    used = (values > least * values[:, -1:]) & (values > np.reshape(floor, (-1, 1)))
    along = np.einsum("kab,ka->kb", vectors, e.reshape(len(e), -1))
    square = np.where(used, along**2 / np.where(used, values, 1.0), 0.0).sum(axis=1)
    return np.stack([square, used.sum(axis=1)], axis=1)


def with_promised_filter(scenario: Scenario) -> Scenario:
    """Return the scenario with the filter that its promises are about.

    For a user's class that defines anything but weights anew this is the built-in class it derives
    from.
    """
    own = promised_filter(scenario.filter.algorithm) is scenario.filter.algorithm
    return scenario if own else with_base_filter(scenario)


@lru_cache(maxsize=8)
def with_base_filter(scenario: Scenario) -> Scenario:
    """Return the scenario with the built-in filter that a user's class derives from, with the same
    parameters; cached, since its tables take time and every replica asks for it.
    """
    algorithm: Any = scenario.filter.algorithm
    filtering = dataclasses.replace(scenario.filter, algorithm=base_filter(algorithm))
    return dataclasses.replace(scenario, filter=filtering)


def promised_filter(algorithm: Any) -> Any:
    """Return the built-in filter whose promises are checked: the given one, or one of the class
    that it derives from, with the same parameters.

    Raises TheoryError for a class that derives from none: nothing is promised of it; and for one
    that declares not to talk although its base does, since promises about its base are about what
    nodes hear.
    """
    known, name = built_in_class(algorithm), type(algorithm).__name__
    if known is None:
        raise TheoryError(
            f"nothing is promised of {name}: derive it from a filter of netkf.parts to say which "
            "one it should be"
        )
    if known.talks and not algorithm.talks:
        raise TheoryError(
            f"nothing is promised of {name}: it declares talks = False, and what is promised of "
            f"{known.__name__} is about exchanges; derive it from netkf.parts.Local"
        )
    if set(own_attributes(algorithm)) <= set(LINK_WEIGHTS):
        return algorithm
    return base_filter(algorithm)


def check_upper_bound(samples: RunSamples, level: float) -> Finding:
    """Check that P - Sigma has no negative eigenvalue; Sigma is the exact covariance of errors."""
    most = max_replayed(samples.scenario)
    P, Sigma = samples.runs.P[:most], samples.runs.Sigma[:most]
    size = np.trace(Sigma, axis1=-2, axis2=-1)
    gap = np.nan_to_num(P - Sigma, nan=-1e300, posinf=1e300, neginf=-1e300)
    below = np.maximum(-np.linalg.eigvalsh(gap)[..., 0], 0.0)
    message = f"least eigenvalue of P - Sigma relative to its trace in {below.size:,} covariances"
    limits = size, samples.largest_terms(samples.runs.replayed[:most]), BOUND_TOLERANCE
    found = compare_identities(below, *limits, message)
    return with_departure(found, samples, below, limits)


@gaussian_test
def check_error_covariance(samples: RunSamples, level: float) -> Finding:
    """Test that errors whitened by their exact covariance are chi-square at every node and time,
    and for all nodes together.
    """
    runs, scenario = samples.runs, samples.scenario
    n, most = scenario.plant.n, max_replayed(scenario)
    Sigma, whole = runs.Sigma[:most], runs.whole[:most]
    e = runs.e[:most] - runs.mean[:most]
    if np.isnan(e).all():
        return find_nothing(NEES_TOLERANCE)
    # Each error is whitened by itself; directions without any variance are left out of the freedom.
    alone = whiten_errors(
        e.reshape(-1, 1, n),
        Sigma.reshape(-1, n, n),
        MIN_VARIANCE,
        _variance_floor(scenario),
    ).reshape(len(e), -1, 2)
    both = np.concatenate([alone, whole], axis=1)
    freedom = np.nan_to_num(both[..., 1]).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = both[..., 0] * (len(e) / freedom)
    labels = [*samples.point_labels, *(f"{time}, all nodes" for time in samples.time_labels)]
    # A part of the level for each point, as much for all of them together, which see far less.
    found = compare_chi_square(ratios, freedom.tolist(), labels, level / 2.0, "e' Sigma^-1 e")
    pooled = _compare_pooled(runs.joint[:most], level / 2.0)
    found = pool(found, pooled, EVERYTHING)
    return found._replace(message=found.message + samples.blurred_note, most_runs=most)


def _compare_pooled(joint: FloatArray, level: float) -> Interval:
    """Return an interval for the relative difference of all errors from their covariance."""
    total, freedom = joint[np.isfinite(joint).all(axis=1)].sum(axis=0).tolist()
    if not freedom > 0.0:
        return Interval(math.nan, 0.0, math.inf)
    return deviation_interval(1.0, scale_interval(total, freedom, level))


def check_bias(samples: RunSamples, level: float) -> Finding:
    """Test that errors less their exact mean have no bias that is the same at all nodes and times,
    by generalised least squares.

    The distance is that of the bias from 0 in standard deviations of an error: those of the mean
    covariance of all nodes and times.
    """
    most = max_replayed(samples.scenario)
    bias, Sigma = samples.runs.bias[:most], samples.runs.Sigma[:most]
    bias = bias[np.isfinite(bias).all(axis=(1, 2))]
    n = bias.shape[1]
    if not len(bias) or not np.abs(bias).any():
        return find_nothing(BIAS_TOLERANCE)
    information, vector = bias[:, :, :n].sum(axis=0), bias[:, :, n].sum(axis=0)
    values, vectors = np.linalg.eigh(information)
    varying = values > 1e-10 * values[-1]
    # z is standard normal without a bias, and the bias is spread z.
    z = (vectors.T @ vector)[varying] / np.sqrt(values[varying])
    covariances = Sigma.reshape(-1, n, n)
    typical = covariances[np.isfinite(covariances).all(axis=(1, 2))].mean(axis=0)
    spread = whitening_matrix(typical) @ (vectors[:, varying] / np.sqrt(values[varying]))
    apart = _length_interval(spread, z, level)
    message = "bias that all errors share, in standard deviations of an error,"
    found = find_largest([(apart, "all nodes and times")], BIAS_TOLERANCE, message)
    return found._replace(most_runs=most)


def _length_interval(spread: FloatArray, z: FloatArray, level: float) -> Interval:
    """Return an interval for the length of ``spread`` (d, k) times the mean of Gaussian numbers z
    (k,) with variance 1, which is above 0 if and only if the mean is not 0 at this level.
    """
    reach = math.sqrt(2.0 * float(scipy.special.gammainccinv(len(z) / 2.0, level)))
    sizes = np.linalg.svd(spread, compute_uv=False)
    least = float(sizes[-1]) if len(sizes) == len(z) else 0.0
    value, wide = float(np.linalg.norm(spread @ z)), reach * float(sizes[0])
    # The mean is within ``reach`` of z.
    excess = float(np.linalg.norm(z)) - reach
    low = max(value - wide, excess * max(least, 1e-9 * float(sizes[0])), 0.0)
    find = wide + float(scipy.special.ndtri(POWER)) * float(sizes[0])
    return Interval(value, low if excess > 0.0 else 0.0, value + wide, find, value, 0.0)


@gaussian_test
def check_expected_nees(samples: RunSamples, level: float) -> Finding:
    """Compare the NEES with its expected value given the events of each run.

    NEES is then a quadratic form of Gaussian errors, whose weights are the eigenvalues of
    P^-1 Sigma, and so is its sum over runs: nothing is estimated. Errors that have a mean count
    less that mean. Sums are in units of the expected values, which may differ widely.
    """
    runs, n = samples.runs, samples.scenario.plant.n
    most = max_replayed(samples.scenario)
    P, Sigma = runs.replayed[:most], runs.Sigma[:most]
    inverse, m = np.linalg.pinv(P), runs.mean[:most]
    weights = np.linalg.eigvals(inverse @ Sigma).real
    weights = np.maximum(weights, 0.0).reshape(len(P), -1, n)
    mean = weights.sum(axis=(0, 2))
    nees = runs.nees[:most]
    if np.nan_to_num(m).any():
        e = runs.e[:most] - m
        nees = np.einsum("rkna,rknab,rknb->rkn", e, inverse, e)
    nees = nees.reshape(len(P), -1)
    known = np.flatnonzero(np.isfinite(nees).all(axis=0) & (mean > 0.0))
    if np.isnan(runs.e[:most]).all():
        return find_nothing(NEES_TOLERANCE)
    if not len(known):
        return find_unknown("NEES does not exist: P is singular or not finite", NEES_TOLERANCE)
    found, sizes = [], weights.sum(axis=2, keepdims=True)
    units = np.divide(n, sizes, out=np.zeros(sizes.shape), where=sizes > 0.0)
    for k in known.tolist():
        total, share = float((units[:, k, 0] * nees[:, k]).sum()), 0.5 * level / len(known)
        ratio = quadratic_interval(total, (units * weights)[:, k].ravel(), share)
        found.append((deviation_interval(1.0, ratio), f"at {samples.point_labels[k]}"))
    message = (
        f"mean NEES {nees[:, known].mean():.4g}, exact errors say "
        f"{mean[known].mean() / len(P):.4g}, n is {n}; largest relative difference"
    )
    together = _expected_together(runs.quadratic[:most], 0.5 * level)
    finding = pool(
        find_largest(found, NEES_TOLERANCE, message), together, EVERYTHING, NEES_TOLERANCE
    )
    return finding._replace(message=finding.message + samples.blurred_note, most_runs=most)


def _expected_together(quadratic: FloatArray, level: float) -> Interval:
    """Return an interval for the relative difference of the NEES of all times, nodes and runs from
    what is expected of it, from stacked sums with their weights (R, 1 + S).
    """
    known = quadratic[np.isfinite(quadratic).all(axis=1)]
    ratio = quadratic_interval(float(known[:, 0].sum()), known[:, 1:].ravel(), level)
    return deviation_interval(1.0, ratio) if len(known) else ratio


@gaussian_test
def check_nees(samples: RunSamples, level: float) -> Finding:
    """Test NEES / n for mean 1: given the exchanges, errors are Gaussian with covariance P."""
    n, nees = samples.scenario.plant.n, samples.runs.nees.reshape(samples.count, -1)
    if np.isnan(samples.runs.e).all():
        return find_nothing(NEES_TOLERANCE)
    freedom = [n * len(nees)] * nees.shape[1]
    found = compare_chi_square(nees / n, freedom, samples.point_labels, level / 2.0, "NEES")
    known = nees[:, np.isfinite(nees).all(axis=0)]
    if known.size:
        exactly = np.full(known.shape, float(n))
        found = pool(
            found,
            pooled_nees(known, exactly, exactly, level / 2.0),
            EVERYTHING,
            NEES_TOLERANCE,
        )
    return found._replace(message=found.message + samples.blurred_note)


def pooled_nees(nees: FloatArray, mean: FloatArray, square: FloatArray, level: float) -> Interval:
    """Return an interval for the relative difference of all NEES (R, K) together from their exact
    means (R, K); ``square`` (R, K) is half of their variances.

    The runs are independent. However the points of one run are related, the standard deviation of
    their sum is at most the sum of theirs.
    """
    spread = np.sqrt(2.0 * square).sum(axis=1)
    expected = float(mean.sum())
    freedom = 2.0 * expected**2 / float((spread**2).sum())
    ratio = scale_interval(freedom * float(nees.sum()) / expected, freedom, level)
    return deviation_interval(1.0, ratio)
