"""Runs against their exact covariances: theory computes from the events of a run what P and the
covariance of the errors must be, without the engine.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any

import numpy as np

from netkf.algorithms.registry import built_in_class, overridden
from netkf.checks.evidence import Assumption, Finding, find_nothing, find_unknown
from netkf.checks.laws import NEES_TOLERANCE, compare_chi_square, find_largest
from netkf.checks.points import sampled_indices
from netkf.checks.rounding import compare_identities
from netkf.checks.samples import ReplicaSummary, RunSamples
from netkf.checks.statistics import deviation_interval, quadratic_interval
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.errors import diagonal_blocks, replayed_covariances
from netkf.trace.nees import errors
from netkf.trace.run import BLUR, Run, blurred

MAX_REPLAYED = 1000
"""Replicas whose exact covariances are computed; the others show their errors only."""
MAX_ERRORS = 64
"""Errors of all nodes together for which the exact covariance (64, 64) is cheap."""
LEAST_VARIANCE_INTEGRATED, LEAST_VARIANCE = 0.02, 1e-8
"""Relative variances below which a direction is left out. Readings that are integrated over steps
may be off by 1e-3 of the largest variance; in slots nothing is.
"""
BOUND_TOLERANCE = 1e-8


def summarise_exactly(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return the summary of a run at the sampled nodes, with exact covariances if the errors of all
    nodes are few enough.
    """
    sampled = sampled_indices(scenario)
    _, nees = errors(run.error, run.P)
    e = np.where(blurred(run, run.P)[..., None], np.nan, run.error)
    nees = np.where(np.isnan(e).any(axis=-1), np.nan, nees)
    P, e, nees = run.P[:, sampled], e[:, sampled], nees[:, sampled]
    replayed = Sigma = np.full(P.shape, np.nan)
    whole = np.full((len(run.times), 2), np.nan)
    if run.replica < MAX_REPLAYED and few_errors(scenario).holds:
        try:
            replayed, stacked = replayed_covariances(with_promised_filter(scenario), run)
        except TheoryError:  # an assumption says so, and rows that need them are not promised
            return ReplicaSummary(P, e, nees, replayed, Sigma, whole)
        Sigma = diagonal_blocks(stacked, len(scenario.nodes))
        lost = blurred(run, Sigma)[:, sampled]
        e = np.where(lost[..., None], np.nan, e)
        nees = np.where(np.isnan(e).any(axis=-1), np.nan, nees)
        least = LEAST_VARIANCE if scenario.slotted else LEAST_VARIANCE_INTEGRATED
        whole = whiten_errors(run.error, stacked, least, (BLUR * run.rounding) ** 2)
        replayed, Sigma = replayed[:, sampled], Sigma[:, sampled]
    return ReplicaSummary(P, e, nees, replayed, Sigma, whole)


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
    values, vectors = np.linalg.eigh(stacked)
    used = (values > least * values[:, -1:]) & (values > np.reshape(floor, (-1, 1)))
    along = np.einsum("kab,ka->kb", vectors, e.reshape(len(e), -1))
    square = np.where(used, along**2 / np.where(used, values, 1.0), 0.0).sum(axis=1)
    return np.stack([square, used.sum(axis=1)], axis=1)


def with_promised_filter(scenario: Scenario) -> Scenario:
    """Return the scenario with the filter that its promises are about.

    For a user's class that defines steps of its own this is the built-in class it derives from.
    """
    own = promised_filter(scenario.filter.algorithm) is scenario.filter.algorithm
    return scenario if own else _replace_filter(scenario)


@lru_cache(maxsize=8)
def _replace_filter(scenario: Scenario) -> Scenario:
    """Return the scenario with the built-in filter; cached, since its tables take time and every
    replica asks for it.
    """
    base = promised_filter(scenario.filter.algorithm)
    filtering = dataclasses.replace(scenario.filter, algorithm=base)
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
    if not overridden(algorithm):
        return algorithm
    parameters = [field.name for field in dataclasses.fields(known) if field.init]
    return known(**{name: getattr(algorithm, name) for name in parameters})


def check_upper_bound(samples: RunSamples, level: float) -> Finding:
    """Check that P - Sigma has no negative eigenvalue; Sigma is the exact covariance of errors."""
    P, Sigma = samples.runs.P[:MAX_REPLAYED], samples.runs.Sigma[:MAX_REPLAYED]
    size = np.trace(Sigma, axis1=-2, axis2=-1)
    gap = np.nan_to_num(P - Sigma, nan=-1e300, posinf=1e300, neginf=-1e300)
    below = np.maximum(-np.linalg.eigvalsh(gap)[..., 0], 0.0)
    message = f"least eigenvalue of P - Sigma relative to its trace in {below.size:,} covariances"
    terms = samples.largest_terms(samples.runs.replayed[:MAX_REPLAYED])
    return compare_identities(below, size, terms, BOUND_TOLERANCE, message)


def check_error_covariance(samples: RunSamples, level: float) -> Finding:
    """Test that errors whitened by their exact covariance are chi-square at every node and time,
    and for all nodes together.
    """
    runs = samples.runs
    e, Sigma, whole = runs.e[:MAX_REPLAYED], runs.Sigma[:MAX_REPLAYED], runs.whole[:MAX_REPLAYED]
    alone = np.einsum("rkna,rkna->rkn", e, _solve_errors(Sigma, e)).reshape(len(e), -1)
    n = samples.scenario.plant.n
    if np.isnan(e).all():
        return find_nothing(NEES_TOLERANCE)
    with np.errstate(invalid="ignore"):
        ratios = np.concatenate([alone / n, whole[..., 0] / whole[..., 1]], axis=1)
    freedom = [n * len(e)] * alone.shape[1] + whole[..., 1].sum(axis=0).tolist()
    labels = [*samples.point_labels, *(f"{time}, all nodes" for time in samples.time_labels)]
    found = compare_chi_square(ratios, freedom, labels, level, "e' Sigma^-1 e")
    return found._replace(message=found.message + samples.blurred_note)


def check_expected_nees(samples: RunSamples, level: float) -> Finding:
    """Compare the mean NEES with its expected value given the events of each run.

    NEES is then a quadratic form of Gaussian errors, whose weights are the eigenvalues of
    P^-1 Sigma, and so is its sum over runs: nothing is estimated.
    """
    runs, n = samples.runs, samples.scenario.plant.n
    P, Sigma = runs.replayed[:MAX_REPLAYED], runs.Sigma[:MAX_REPLAYED]
    weights = np.linalg.eigvals(np.linalg.pinv(P) @ Sigma).real
    weights = np.maximum(weights, 0.0).reshape(len(P), -1, n)
    mean = weights.sum(axis=(0, 2))
    nees = runs.nees[:MAX_REPLAYED].reshape(len(P), -1)
    known = np.flatnonzero(np.isfinite(nees).all(axis=0) & (mean > 0.0))
    if np.isnan(runs.e[:MAX_REPLAYED]).all():
        return find_nothing(NEES_TOLERANCE)
    if not len(known):
        return find_unknown("NEES does not exist: P is singular or not finite", NEES_TOLERANCE)
    found = []
    for k in known.tolist():
        total, share = float(nees[:, k].sum()), level / len(known)
        ratio = quadratic_interval(total, weights[:, k].ravel(), share)
        found.append((deviation_interval(1.0, ratio), f"at {samples.point_labels[k]}"))
    message = (
        f"mean NEES {nees[:, known].mean():.4g}, exact errors say "
        f"{mean[known].mean() / len(P):.4g}, n is {n}; largest relative difference"
    )
    finding = find_largest(found, NEES_TOLERANCE, message)
    return finding._replace(message=finding.message + samples.blurred_note)


def _solve_errors(Sigma: FloatArray, e: FloatArray) -> FloatArray:
    """Return Sigma^-1 e (..., n), by the pseudoinverse if a covariance is singular."""
    try:
        return np.asarray(np.linalg.solve(Sigma, e[..., None])[..., 0])
    except np.linalg.LinAlgError:
        return np.asarray((np.linalg.pinv(Sigma, hermitian=True) @ e[..., None])[..., 0])
