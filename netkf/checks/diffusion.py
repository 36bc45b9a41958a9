"""What D promises of the diffusion filter, held against runs."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from netkf.algorithms.diffusion import DiffusionFilter
from netkf.checks.evidence import Finding, Promise, Row
from netkf.checks.exact import (
    MOST,
    as_computed,
    exact,
    expected_nees,
    not_too_small,
    stand_in,
    within_reach,
)
from netkf.checks.laws import exact_start
from netkf.checks.mode_sequences import watched_places
from netkf.checks.samples import Seen, bounded, replay
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.theory import error_covariance, information_level
from netkf.theory.diffusion.information import MAX_REGRESSORS, few_regressors
from netkf.trace.run import Run

SLOTS_ONLY = False


class Witness(NamedTuple):
    """What one run says at K slots: as :class:`Exact`, and ``alone`` (N, n, n), the exact
    covariance of the errors at the end of filters that do not cooperate.
    """

    P: FloatArray
    e: FloatArray
    nees: FloatArray
    replayed: FloatArray
    Sigma: FloatArray
    whole: FloatArray
    alone: FloatArray


def witness(scenario: Scenario, run: Run) -> Witness:
    """Reduce a run whose samples are those of ``look_at``."""
    watched = watched_places(scenario)
    alone = np.full(run.P[0, watched].shape, np.nan)
    if run.replica < MOST and within_reach(scenario).holds:
        silent = _silent(scenario)
        alone = error_covariance(silent, simulate(silent, run.seed, run.replica))[-1][watched]
    return Witness(*exact(scenario, run), alone)


def _silent(scenario: Scenario) -> Scenario:
    """The same filters with no weight for what they hear."""
    promised = stand_in(scenario).filter.algorithm
    assert isinstance(promised, DiffusionFilter)
    algorithm = dataclasses.replace(promised, weights=np.eye(len(scenario.nodes)))
    chosen = dataclasses.replace(scenario.filter, algorithm=algorithm)
    return dataclasses.replace(scenario, filter=chosen, probe=scenario.times[-1:])


Observed = Seen


def rows(scenario: Scenario) -> list[Row]:
    """What the tests need beyond the paper's own assumptions."""
    same = scenario.filters_know_the_truth
    try:
        _demand_few_regressors(scenario)
        levels = information_level(scenario, 100, 0)
        best = float(levels.loc[levels["node"] != -1, "level"].max())
        lost, why = best <= 0.0, f"the best sensor alone has level {best:.3g} of D (5)"
    except TheoryError as error:
        lost, why = False, str(error)
    words = "same F, Q and R" if same else "filter.model differs from the truth"
    return [
        Row("the filters know the plant and the sensors", "D Algorithm 1", same, words),
        exact_start(scenario),
        within_reach(scenario),
        Row("no sensor would do alone", "D VI", lost, why),
    ]


def excited(seen: Seen, level: float) -> Finding:
    """The level of D (19)."""
    table = information_level(seen.scenario, 400, seen.seed)
    network = table[table["node"] == -1].iloc[0]
    alone = float(table.loc[table["node"] != -1, "level"].max())
    words = (
        f"computed, not simulated: least level over the pasts looked at {network['level']:.3g} "
        f"with windows of {int(network['window'])} slots; the best sensor alone {alone:.3g}"
    )
    low = float(network["low"])
    return Finding((float(network["level"]), low, float(network["high"])), 0.0, words)


def cooperation(seen: Seen, level: float) -> Finding:
    """Exact mean squares at the end, with and without the neighbours, on the same truth."""
    together = np.trace(seen.runs.Sigma[:MOST, -1], axis1=-2, axis2=-1).mean(axis=0)
    alone = np.trace(seen.runs.alone[:MOST], axis1=-2, axis2=-1).mean(axis=0)
    margin = 1.0 - float(together.max() / alone.max())
    words = (
        f"exact mean-square errors at the end {together.min():.4g} .. {together.max():.4g} "
        f"together and {alone.min():.4g} .. {alone.max():.4g} alone"
    )
    return Finding((margin, margin, margin), 0.0, words, early=margin < 0.0)


STABLE = ("D Assumption 3.1", "D Assumption 3.2")
PROMISES = (
    Promise(
        "P follows Algorithm 1: adapt, then combine by covariance intersection",
        "D (6)-(9)",
        ("exact errors are within reach",),
        replay,
        exact=True,
    ),
    Promise(
        "P is at least the covariance of the error",
        "D Algorithm 1, derived",
        ("the filters know", "P_i(0) >=", "exact errors are within reach"),
        not_too_small,
        exact=True,
    ),
    Promise(
        "errors have the covariance that the equations give them",
        "D (6)-(9), derived",
        ("the filters start", "exact errors are within reach"),
        as_computed,
    ),
    Promise(
        "NEES has the mean that exact errors say, at most n",
        "derived",
        ("the filters know", "the filters start", "P_i(0) >=", "exact errors are within reach"),
        expected_nees,
    ),
    Promise(
        "the sensors together excite every direction",
        "D (19)",
        ("D Assumption 3.2",),
        excited,
        exact=True,
    ),
    Promise(
        "P is stochastically bounded: its law does not grow any more",
        "D Theorem 4.1, 4.2",
        STABLE,
        bounded,
    ),
    Promise(
        "neighbours help: the worst node does better than the worst one alone",
        "D Fig. 1",
        (*STABLE, "no sensor would do alone", "exact errors are within reach"),
        cooperation,
        exact=True,
    ),
)


def promises(scenario: Scenario) -> tuple[Promise, ...]:
    """Those of the scenario; the level of (19) where it can be looked at."""
    try:
        _demand_few_regressors(scenario)
        information_level(scenario, 2, 0)
    except TheoryError:
        return tuple(p for p in PROMISES if p.source != "D (19)")
    return PROMISES


def _demand_few_regressors(scenario: Scenario) -> None:
    """Raise TheoryError where the levels of all sensors would take minutes."""
    if not few_regressors(scenario):
        raise TheoryError(f"not looked at beyond {MAX_REGRESSORS} sensors whose H varies")
