"""Runs against their exact covariances: what the filter's equations make of a run's events, P and
the covariance of the errors, computed by theory and not by the engine.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.registry import built_in_class, overridden
from netkf.checks.evidence import Finding, Row, identity, left_out, rounded_away
from netkf.checks.laws import NEES, chi_squared, worst
from netkf.checks.mode_sequences import watched_note, watched_places
from netkf.checks.statistics import mean_ratio, off_by
from netkf.core.errors import TheoryError
from netkf.core.fields import Component
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.errors import diagonal_blocks, replayed_covariances
from netkf.trace.nees import errors
from netkf.trace.run import BLUR, Run, blurred

MOST = 1000
"""Replicas whose exact covariances are computed; the others show their errors only."""
LARGEST = 64
SAMPLED, EXACT = 0.02, 1e-8
"""Relative variances that are looked at: where readings are integrated over steps, an error of
1e-3 of the largest ones is allowed for; in slots there is none.
"""


class Exact(NamedTuple):
    """What one run says at K times of N watched nodes; nan in replicas whose exact covariances are
    not computed.

    P, e       : (K, N, n, n), (K, N, n) covariances and errors, nan where rounding blurs them
    nees       : (K, N) e' P^-1 e
    replayed   : (K, N, n, n) P as the equations have it
    Sigma      : (K, N, n, n) covariance of the errors given the events
    whole      : (K, 2) of the errors of all nodes together: their square, whitened by their
                 covariance given the events, and its degrees of freedom
    """

    P: FloatArray
    e: FloatArray
    nees: FloatArray
    replayed: FloatArray
    Sigma: FloatArray
    whole: FloatArray


def exact(scenario: Scenario, run: Run) -> Exact:
    """Reduce a run; of large networks the watched nodes are kept."""
    watched = watched_places(scenario)
    _, nees = errors(run.error, run.P)
    e = np.where(blurred(run, run.P)[..., None], np.nan, run.error)
    nees = np.where(np.isnan(e).any(axis=-1), np.nan, nees)
    P, e, nees = run.P[:, watched], e[:, watched], nees[:, watched]
    replayed = Sigma = np.full(P.shape, np.nan)
    whole = np.full((len(run.times), 2), np.nan)
    if run.replica < MOST and within_reach(scenario).holds:
        try:
            replayed, stacked = replayed_covariances(stand_in(scenario), run)
        except TheoryError:  # rows about them are not promised then
            return Exact(P, e, nees, replayed, Sigma, whole)
        Sigma = diagonal_blocks(stacked, len(scenario.nodes))
        least = EXACT if scenario.slotted else SAMPLED
        whole = whitened(run.error, stacked, least, (BLUR * run.rounding) ** 2)
        replayed, Sigma = replayed[:, watched], Sigma[:, watched]
        e = np.where(blurred(run, Sigma)[..., None], np.nan, e)
        nees = np.where(np.isnan(e).any(axis=-1), np.nan, nees)
    return Exact(P, e, nees, replayed, Sigma, whole)


def within_reach(scenario: Scenario) -> Row:
    """Whether the errors of all nodes together are few enough for their exact covariance."""
    size = len(scenario.nodes) * scenario.plant.n
    words = f"{size} errors of all nodes together, at most {LARGEST}"
    return Row("exact errors are within reach", "netkf", size <= LARGEST, words)


def all_watched(scenario: Scenario) -> Row:
    """Whether samples of every node are kept, which promises about the whole network need."""
    note = watched_note(scenario)
    return Row("every node is watched", "netkf", not note, note or "samples of all nodes are kept")


def whitened(
    e: FloatArray, stacked: FloatArray, least: float, floor: FloatArray | float = 0.0
) -> FloatArray:
    """(K, 2): ``e' Sigma^-1 e`` of all nodes together in the directions whose variance is at least
    that share of the largest and above ``floor`` (K,), which rounding reaches, and their number.
    Small ones show how far nodes disagree.
    """
    values, vectors = np.linalg.eigh(stacked)
    kept = (values > least * values[:, -1:]) & (values > np.reshape(floor, (-1, 1)))
    along = np.einsum("kab,ka->kb", vectors, e.reshape(len(e), -1))
    square = np.where(kept, along**2 / np.where(kept, values, 1.0), 0.0).sum(axis=1)
    return np.stack([square, kept.sum(axis=1)], axis=1)


def stand_in(scenario: Scenario) -> Scenario:
    """The scenario with the filter that a user's class derives from, where it defines steps of its
    own: promises are about that one.
    """
    own = promised_filter(scenario.filter.algorithm) is scenario.filter.algorithm
    return scenario if own else _replaced(scenario)


@lru_cache(maxsize=8)
def _replaced(scenario: Scenario) -> Scenario:
    """Kept, because every replica asks for it and its tables take time."""
    base = promised_filter(scenario.filter.algorithm)
    return dataclasses.replace(
        scenario, filter=dataclasses.replace(scenario.filter, algorithm=base)
    )


def promised_filter(algorithm: Any) -> Any:
    """A filter of this package: the given one, or the one that its class is derived from. Raises
    TheoryError for a class that is derived from none, of which nothing is promised.
    """
    known = built_in_class(algorithm)
    if known is not None:
        return _like(known, algorithm) if overridden(algorithm) else algorithm
    name = type(algorithm).__name__
    raise TheoryError(
        f"nothing is promised of {name}: derive it from a filter of netkf.parts to say which one "
        "it should be"
    )


def _like(kind: type[Component], algorithm: Any) -> Component:
    names = [field.name for field in dataclasses.fields(kind) if hasattr(algorithm, field.name)]
    return kind(**{name: getattr(algorithm, name) for name in names})


def not_too_small(seen: Any, level: float) -> Finding:
    """P - Sigma has no negative eigenvalue, with the exact covariance Sigma of the errors."""
    P, Sigma = seen.runs.P[:MOST], seen.runs.Sigma[:MOST]
    size = np.trace(Sigma, axis1=-2, axis2=-1)
    gap = np.nan_to_num(P - Sigma, nan=-1e300, posinf=1e300, neginf=-1e300)
    least = np.linalg.eigvalsh(gap)[..., 0] / np.maximum(size, 1e-300)
    words = f"least eigenvalue of P - Sigma relative to its trace in {least.size:,} covariances"
    return identity(float(max(0.0, -least.min())), 1e-8, words)


def as_computed(seen: Any, level: float) -> Finding:
    """Errors whitened by their exact covariance are chi-square at every node and time, and for all
    nodes together.
    """
    e, Sigma, whole = seen.runs.e[:MOST], seen.runs.Sigma[:MOST], seen.runs.whole[:MOST]
    alone = np.einsum("rkna,rkna->rkn", e, _solved(Sigma, e)).reshape(len(e), -1)
    n = seen.scenario.plant.n
    if np.isnan(e).all():
        return rounded_away(NEES)
    with np.errstate(invalid="ignore"):
        ratios = np.concatenate([alone / n, whole[..., 0] / whole[..., 1]], axis=1)
    freedom = [n * len(e)] * alone.shape[1] + whole[..., 1].sum(axis=0).tolist()
    places = [*seen.places, *(f"{moment}, all nodes" for moment in seen.moments)]
    found = chi_squared(ratios, freedom, places, level, "e' Sigma^-1 e")
    return found._replace(words=found.words + left_out(seen))


def expected_nees(seen: Any, level: float) -> Finding:
    """Given the events of its run NEES is a quadratic form of Gaussian errors with mean tr(M) and
    variance 2 tr(M^2), M = P^-1 Sigma. Sums over runs are held against these by a scaled chi-square
    variable of the same two moments, so nothing is estimated.
    """
    runs, n = seen.runs, seen.scenario.plant.n
    M = np.linalg.pinv(runs.replayed[:MOST]) @ runs.Sigma[:MOST]
    mean = np.trace(M, axis1=-2, axis2=-1)
    square = np.trace(M @ M, axis1=-2, axis2=-1)
    mean, square = (values.reshape(len(M), -1).sum(axis=0) for values in (mean, square))
    nees = runs.nees[:MOST].reshape(len(M), -1)
    kept = np.flatnonzero(np.isfinite(nees).all(axis=0) & (mean > 0.0))
    if np.isnan(runs.e[:MOST]).all():
        return rounded_away(NEES)
    if not len(kept):
        nan = float("nan")
        return Finding((nan, nan, nan), NEES, "NEES does not exist: P is singular or not finite")
    found = []
    for k in kept.tolist():
        freedom = float(mean[k] ** 2 / square[k])
        ratio = mean_ratio(freedom * nees[:, k].sum() / float(mean[k]), freedom, level / len(kept))
        found.append((off_by(1.0, ratio), f"at {seen.places[k]}"))
    words = (
        f"mean NEES {nees[:, kept].mean():.4g}, exact errors say "
        f"{mean[kept].mean() / len(M):.4g}, n is {n}; largest relative difference"
    )
    finding = worst(found, NEES, words)
    return finding._replace(words=finding.words + left_out(seen))


def _solved(Sigma: FloatArray, e: FloatArray) -> FloatArray:
    try:
        return np.asarray(np.linalg.solve(Sigma, e[..., None])[..., 0])
    except np.linalg.LinAlgError:
        return np.asarray((np.linalg.pinv(Sigma, hermitian=True) @ e[..., None])[..., 0])
