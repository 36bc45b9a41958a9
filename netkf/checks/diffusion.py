"""Promises of D about the diffusion filter."""

from __future__ import annotations

import contextlib
import dataclasses
from typing import Any

import numpy as np

from netkf.checks.equations import error_promises
from netkf.checks.evidence import (
    COMPUTED,
    Assumption,
    Finding,
    Promise,
    error_test,
    find_nothing,
    find_unknown,
)
from netkf.checks.exact import (
    MIN_REPLAYED,
    check_expected_nees,
    check_upper_bound,
    few_errors,
    max_replayed,
    summarise_exactly,
    with_promised_filter,
)
from netkf.checks.laws import LAW_TOLERANCE, Pair, compare_growth
from netkf.checks.paper import PaperChecks, usual_assumptions
from netkf.checks.samples import (
    ReplicaSummary,
    RunSamples,
    check_growth,
    check_replay,
    sampled_indices,
)
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.theory import error_covariance, information_level, tracking_level
from netkf.theory.common.evidence import TRUE_MODEL
from netkf.theory.diffusion.information import MAX_REGRESSORS, few_regressors
from netkf.trace.run import Run

ALONE = MIN_REPLAYED
"""Number of runs repeated without cooperation (each sensor's filter by itself, on the same
readings); few suffice to compare exact mean squares.
"""
PASTS = 400
"""Number of drawn pasts of the regressors from which the excitation, D (19), is estimated."""
DRAWS = 20
"""Number of errors drawn from each exact covariance."""


def _sensors_excite(samples: RunSamples, level: float) -> Finding:
    levels = information_level(samples.scenario, PASTS, samples.seed)
    network = levels[levels["node"] == -1].iloc[0]  # the row of all sensors together
    best_sensor = float(levels.loc[levels["node"] != -1, "level"].max())
    message = (
        f"computed, not simulated: least level over the pasts looked at {network['level']:.3g} "
        f"with windows of {int(network['window'])} slots; the best sensor alone {best_sensor:.3g}"
    )
    if not network["low"] > 0.0:  # what is computed about a scenario cannot break a promise
        return find_unknown(message)
    ends = float(network["level"]), float(network["low"]), float(network["high"])
    return Finding(ends, 0.0, message)


def _cooperation_helps(samples: RunSamples, level: float) -> Finding:
    Sigma, Sigma_alone = samples.runs.Sigma[:ALONE, -1], samples.runs.alone[:ALONE]
    cooperative = np.trace(Sigma, axis1=-2, axis2=-1).mean(axis=0)
    separate = np.trace(Sigma_alone, axis1=-2, axis2=-1).mean(axis=0)
    margin = 1.0 - float(cooperative.max() / separate.max())
    message = (
        f"exact mean-square errors at the end {cooperative.min():.4g} .. {cooperative.max():.4g} "
        f"together and {separate.min():.4g} .. {separate.max():.4g} alone"
    )
    return Finding((margin, margin, margin), 0.0, message, early=margin < 0.0)


@error_test
def _errors_bounded(samples: RunSamples, level: float) -> Finding:
    e, Sigma = samples.runs.e[:, -2:], samples.runs.Sigma[: max_replayed(samples.scenario), -2:]
    if np.isnan(e).all():
        return find_nothing(LAW_TOLERANCE)
    square = e[..., :, None] * e[..., None, :]  # (R, 2, N, n, n): at half time and the end
    random = Streams(samples.seed).generator("tracking errors")
    pairs, expected = [], []
    for i, node in enumerate(samples.nodes):
        pairs.append(Pair(f"node {node}", square[:, 0, i], square[:, 1, i]))
        half, end = (_draw_squares(Sigma[:, k, i], random) for k in (0, 1))
        expected.append((half, end) if np.isfinite(Sigma[:, :, i]).all() else None)
    finding = compare_growth(pairs, expected, level)
    message = finding.message.replace("P(P > ", "P(e^2 > ")
    # The level of noise on which the paper's bound on the errors depends, where it has a law.
    with contextlib.suppress(TheoryError):
        sigma = tracking_level(samples.scenario).sigma
        message += f"; sigma_p of D (29) is {sigma:.3g} for p = 2"
    return finding._replace(message=message)


def _draw_squares(Sigma: FloatArray, random: np.random.Generator) -> FloatArray:
    """Return e e' (DRAWS R, n, n) of Gaussian errors with the variances of ``Sigma`` (R, n, n)."""
    deviations = np.sqrt(np.maximum(np.diagonal(Sigma, axis1=1, axis2=2), 0.0))
    e = random.standard_normal((DRAWS, *deviations.shape)) * deviations
    e = e.reshape(-1, deviations.shape[1])
    return np.asarray(e[:, :, None] * e[:, None, :])


# What promises need: parts of names or sources in the table of assumptions, see ``Promise.needs``.
STABLE = ("D Assumption 3.1", "D Assumption 3.2")
REACH = "exact errors are within reach"
PROMISES = (
    Promise(
        "P follows Algorithm 1: adapt, then combine by covariance intersection",
        "D (6)-(9)",
        (REACH,),
        check_replay,
        exact=True,
    ),
    Promise(
        "P is at least the covariance of the error",
        "D Algorithm 1, derived",
        ("the filters know", "P_i(0) >=", REACH),
        check_upper_bound,
        exact=True,
    ),
    *error_promises("D (6)-(9), derived"),
    Promise(
        "NEES has the mean that exact errors say, at most n",
        "derived",
        ("the filters know", "the filters start", "P_i(0) >=", REACH),
        check_expected_nees,
    ),
    Promise(
        "the sensors together excite every direction",
        "D (19)",
        ("D Assumption 3.2",),
        _sensors_excite,
        exact=True,
        group=COMPUTED,
    ),
    Promise(
        "P is stochastically bounded: its law does not grow any more",
        "D Lemma 4.1, Corollary 4.1",
        STABLE,
        check_growth,
    ),
    Promise(
        "tracking errors stay bounded: their law does not grow any more",
        "D Theorem 4.2",
        STABLE,
        _errors_bounded,
    ),
    Promise(
        "neighbours help: the worst node does better than the worst one alone",
        "D Fig. 1",
        (*STABLE, "no sensor would do alone", REACH),
        _cooperation_helps,
        exact=True,
    ),
)


def _summarise(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return the summary with ``alone`` (N, n, n), exact covariances at the end, each alone."""
    summary, sampled = summarise_exactly(scenario, run), sampled_indices(scenario)
    summary.alone = np.full(summary.P[0].shape, np.nan)
    if run.replica < ALONE and few_errors(scenario).holds:
        # Without weights for others, sampled at the last time only.
        promised: Any = with_promised_filter(scenario).filter.algorithm
        algorithm = dataclasses.replace(promised, weights=np.eye(len(scenario.nodes)))
        chosen = dataclasses.replace(scenario.filter, algorithm=algorithm)
        silent = dataclasses.replace(scenario, filter=chosen, probe=scenario.times[-1:])
        last = error_covariance(silent, simulate(silent, run.seed, run.replica))[-1]
        summary.alone = last[sampled]
    return summary


def _assumptions(scenario: Scenario) -> list[Assumption]:
    models_agree = scenario.filters_know_the_truth
    try:
        _require_few_regressors(scenario)
        # The excitation by each sensor alone, D (5); node -1 is the network of all sensors.
        levels = information_level(scenario, runs=100, seed=0)
        highest = float(levels.loc[levels["node"] != -1, "level"].max())
        needs_others = highest <= 0.0
        evidence = f"the best sensor alone has level {highest:.3g} of D (5)"
    except TheoryError as error:
        needs_others, evidence = False, str(error)
    model = "same F, Q and R" if models_agree else "filter.model differs from the truth"
    return [
        Assumption(TRUE_MODEL, "D Algorithm 1", models_agree, model),
        *usual_assumptions(scenario),
        Assumption("no sensor would do alone", "D VI", needs_others, evidence),
    ]


def _promises(scenario: Scenario) -> tuple[Promise, ...]:
    try:
        _require_few_regressors(scenario)
        information_level(scenario, runs=2, seed=0)
    except TheoryError:
        return tuple(p for p in PROMISES if p.source != "D (19)")
    return PROMISES


def _require_few_regressors(scenario: Scenario) -> None:
    """Raise TheoryError if computing the excitation by all sensors would take minutes."""
    if not few_regressors(scenario):
        raise TheoryError(f"not looked at beyond {MAX_REGRESSORS} sensors whose H varies")


CHECKS = PaperChecks(_promises, _assumptions, _summarise)
