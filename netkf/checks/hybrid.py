"""What H promises of filters that reset at the ticks of links, held against runs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from netkf.checks.evidence import Finding, Promise, Row
from netkf.checks.exact import (
    Exact,
    as_computed,
    exact,
    expected_nees,
    not_too_small,
    stand_in,
    within_reach,
)
from netkf.checks.laws import exact_start, worst
from netkf.checks.mode_sequences import watched_places
from netkf.checks.samples import Seen, replay, times
from netkf.checks.statistics import Interval, spread
from netkf.core.errors import ScenarioError, TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory import covariance_bound, limit_covariance, steady_covariance_bound
from netkf.theory.hybrid.coupled import coupling, reason_without_bound
from netkf.theory.hybrid.second_moments import second_moment_rate
from netkf.theory.numerics.matrices import undetectable_mode
from netkf.trace.run import Run

SLOTS_ONLY = False

BOUND, SLOPE = 0.1, 0.3  # tolerances: relative excess over the bound, exponent of the distance to S
SETTLED, LONGEST = 0.01, 1e5
MAX_DENSE = 200  # nodes up to which all eigenvalues of the coupling are computed

Witness = Exact


def witness(scenario: Scenario, run: Run) -> Exact:
    """Reduce a run whose samples are at ``times``."""
    return exact(scenario, run)


@dataclass(frozen=True)
class Observed(Seen):
    """Witnesses of many runs, stacked, with what they are held against."""

    @cached_property
    def bound(self) -> FloatArray:
        """(K, N, n, n) of H (12) at the watched nodes."""
        whole = covariance_bound(stand_in(self.scenario), np.array(times(self.scenario)))
        return whole[:, watched_places(self.scenario)]


def rows(scenario: Scenario) -> list[Row]:
    """What the tests need beyond the assumptions of the paper."""
    promised = stand_in(scenario)
    why = reason_without_bound(promised)
    return [
        Row("H(12) speaks about the scenario", "H (12)", why is None, why or "it does"),
        exact_start(scenario),
        within_reach(scenario),
        _variance(promised),
    ]


def _variance(scenario: Scenario) -> Row:
    name, source = "the covariance has a variance", "derived"
    blind = [
        node
        for node, model in zip(scenario.nodes, scenario.models, strict=True)
        if undetectable_mode(model.A, model.H.T @ np.linalg.solve(model.R, model.H)) is not None
    ]
    if not blind:
        return Row(name, source, True, "every node detects the state by itself, so P is bounded")
    void = (
        f"node {blind[0]} is blind to a mode that grows, and without a variance no interval holds"
    )
    try:
        rate = second_moment_rate(scenario)
    except TheoryError as error:
        return Row(name, source, None, f"not decided: {error}; {void}")
    words = f"second moments change at rate {rate:.3g} per second"
    return Row(name, source, rate < 0.0, words if rate < 0.0 else f"{words}; {void}")


def bounded(seen: Observed, level: float) -> Finding:
    """E[P_i(t)] <= calP_i(t), in all directions at once; both are scaled by calP."""
    _, times_, nodes = seen.runs.P.shape[:3]
    share = level / (times_ * nodes)
    found = []
    for k in range(times_):
        for i in range(nodes):
            values, vectors = np.linalg.eigh(seen.bound[k, i])
            if not values[0] > 1e-12 * values[-1]:
                continue
            white = vectors / np.sqrt(values)
            ratio = spread(white.T @ seen.runs.P[:, k, i] @ white, share)
            # A reset that so few runs have not shown may take P to 0; it is as rare as this.
            unseen = min(1.0, math.log(1.0 / share) / len(seen.runs.P))
            ratio = ratio._replace(low=ratio.low * (1.0 - unseen))
            excess = Interval(*(value - 1.0 for value in ratio))
            found.append((excess, f"at {seen.places[k * nodes + i]}"))
    if not found:
        return Finding((0.0, 0.0, 0.0), BOUND, "the bound is singular everywhere")
    return worst(found, BOUND, "largest excess of the mean of P over the bound, relative,")


def steady(seen: Observed, level: float) -> Finding:
    """H (12) settles: the bound after ever longer times against the steady solution."""
    promised = stand_in(seen.scenario)
    steady_bound, apart, factor = steady_covariance_bound(promised), np.inf, 1.0
    while apart > SETTLED and factor < LONGEST:
        factor *= 10.0
        late = covariance_bound(promised, np.array([factor * seen.scenario.horizon]))[0]
        apart = float(np.abs(late - steady_bound).max() / np.abs(steady_bound).max())
    words = (
        f"computed, not simulated: the bound at {factor:g} horizons differs from its steady state "
        f"by {apart:.1e} of the largest entry"
    )
    margin = SETTLED - apart
    return Finding((margin, margin, margin), 0.0, words, early=margin < 0.0)


def approach(seen: Observed, level: float) -> Finding:
    """The distance of the steady bound to S falls as one over the rate, once links are fast."""
    promised = stand_in(seen.scenario)
    S, first = limit_covariance(promised), _fast(promised)
    apart = []
    for factor in (first, 10.0 * first):
        bound = steady_covariance_bound(_faster(promised, factor))
        apart.append(float(np.linalg.norm(bound - S, axis=(1, 2)).max()))
    if apart[-1] <= 1e-9 * float(np.linalg.norm(S)):
        return Finding((0.0, 0.0, 0.0), SLOPE, "computed, not simulated: every node has S at once")
    slope = float(np.log10(apart[1] / apart[0]))
    margin = -abs(slope + 1.0)
    words = (
        f"computed, not simulated: with rates {first:.3g} and {10.0 * first:.3g} times larger the "
        f"distance is {apart[0]:.3g} and {apart[1]:.3g}, exponent {slope:.3f}"
    )
    return Finding((margin, margin, min(0.0, SLOPE + margin)), SLOPE, words)


def _fast(scenario: Scenario) -> float:
    """A factor of the rates that makes mixing a hundred times faster than anything else."""
    S, slowest = limit_covariance(scenario), _slowest_mixing(coupling(scenario))
    models = {id(model): model for model in scenario.models}.values()  # nodes share them
    speeds = [
        np.linalg.norm(m.A, 2)
        + np.linalg.norm(S, 2) * np.linalg.norm(m.H.T @ np.linalg.solve(m.R, m.H), 2)
        for m in models
    ]
    return max(1.0, 100.0 * float(max(speeds)) / slowest)


def _slowest_mixing(mixing: scipy.sparse.csr_array) -> float:
    """Second smallest real part (1/s) of the eigenvalues of the Laplacian of the coupling."""
    leaving = np.asarray(mixing.sum(axis=1)).reshape(-1)
    laplacian = scipy.sparse.csc_array(scipy.sparse.diags_array(leaving) - mixing)
    if laplacian.shape[0] <= MAX_DENSE:
        return float(np.sort(np.linalg.eigvals(laplacian.toarray()).real)[1])
    largest = float(leaving.max())
    try:  # closest to a point just below 0
        values = scipy.sparse.linalg.eigs(
            laplacian, k=2, sigma=-1e-6 * largest, return_eigenvectors=False, tol=1e-8
        )
    except (scipy.sparse.linalg.ArpackError, RuntimeError) as error:
        raise TheoryError(f"how fast the network mixes was not found: {error}") from None
    return float(np.sort(values.real)[1])


@lru_cache(maxsize=8)
def _faster(scenario: Scenario, factor: float) -> Scenario:
    """Return the scenario with links that tick so many times as often, the same for each call."""
    clock = scenario.network.activation
    rate = getattr(clock, "rate", None)
    rates = getattr(clock, "rates", None)
    if rate is None:
        raise TheoryError("the clocks have no rate to raise")
    changes = {"network.activation.rate": factor * rate}
    if rates:
        listed = [[*row[:-1], factor * row[-1]] for row in rates]
        changes["network.activation.rates"] = listed
    try:
        return scenario.replace(changes)
    except ScenarioError as error:
        raise TheoryError(f"links cannot tick so fast: {error}") from None


EVENTS = ("the filters know", "the filters start", "P_i(0) >=", "exact errors are within reach")
PROMISES = (
    Promise(
        "P follows the equations: flow between ticks, resets with values from before",
        "H (4b), (7), (9)",
        ("exact errors are within reach",),
        replay,
        exact=True,
    ),
    Promise(
        "P is at least the covariance of the error, given the ticks",
        "H (10)",
        ("the filters know", "P_i(0) >=", "exact errors are within reach"),
        not_too_small,
        exact=True,
    ),
    Promise(
        "errors have the covariance that the equations give them",
        "H (4a), (7), derived",
        ("the filters start", "exact errors are within reach"),
        as_computed,
    ),
    Promise(
        "NEES has the mean that exact errors say, at most n",
        "H (10), derived",
        (*EVENTS, "exact errors are within reach"),
        expected_nees,
    ),
    Promise(
        "the mean of P stays below the coupled Riccati bound",
        "H Theorem 2, (12); derived, samples",
        ("H(12) speaks", "the covariance has a variance"),
        bounded,
    ),
)
COMPUTED = (
    Promise("the bound settles", "H Proposition 4", ("H(12) speaks",), steady, exact=True),
    Promise(
        "the steady bound approaches S as one over the rate of the links",
        "H Theorem 3, (13)",
        ("H(12) speaks",),
        approach,
        exact=True,
    ),
)


def promises(scenario: Scenario) -> tuple[Promise, ...]:
    """Those of the scenario; limits where they exist."""
    listed, promised = list(PROMISES), stand_in(scenario)
    for promise, needed in zip(COMPUTED, (_settles, _limits), strict=True):
        try:
            needed(promised)
        except TheoryError:
            continue
        listed.append(promise)
    return tuple(listed)


def _settles(scenario: Scenario) -> None:
    steady_covariance_bound(scenario)


def _limits(scenario: Scenario) -> None:
    if len(scenario.nodes) == 1 or scenario.network.channel.delay.fixed != 0.0:
        raise TheoryError("S is the limit for links that take no time")
    steady_covariance_bound(_faster(scenario, 10.0 * _fast(scenario)))
