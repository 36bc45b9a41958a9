"""The exact covariance of all errors of one run, given when its messages arrived.

Given the events, covariances P_i and gains are deterministic, and the errors e_i = x - xhat_i are
linear in the noises. Their joint covariance Sigma therefore follows without simulation, from the
filter's own verbs (theory/common/slot_columns.py, theory/common/clock_columns.py).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.filter import compiled_kernels, takes_columns
from netkf.algorithms.registry import built_in_class, overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.model import ALL_READ, RIGHT_CLOCKS
from netkf.scenario.preconditions import filter_name
from netkf.scenario.scenario import Scenario
from netkf.theory.common.arrivals import with_last_exchanges
from netkf.theory.common.block_columns import ClockBlocks, SlotBlocks
from netkf.theory.common.blocks import (
    SeenErrors,
    have_one_view,
    run_of_view,
    scenario_of_all,
    scenario_of_view,
)
from netkf.theory.common.clock_columns import ClockColumns
from netkf.theory.common.columns import ErrorColumns, has_columns
from netkf.theory.common.evidence import CONSISTENCY, LIVES, require_linear
from netkf.theory.common.slot_columns import SlotColumns
from netkf.theory.folders import theory_of
from netkf.trace.run import Run

IGNORED = np.errstate(over="ignore", invalid="ignore")
"""Errors of a filter that is unstable grow until they overflow: who asks finds inf or nan."""


class ErrorLaw(NamedTuple):
    """The Gaussian law of the errors of M estimators at T times given the events of a run.

    ``mean`` (T M n,) and ``covariance`` (T M n, T M n) of all errors together, ``P`` (T, M, n, n),
    where nodes that estimate blocks have n states, others than their own being 0 and 1 in P.
    """

    mean: FloatArray
    covariance: FloatArray
    P: FloatArray


def error_covariance(scenario: Scenario, run: Run, stacked: bool = False) -> FloatArray:
    """Return the covariance (T, N, n, n) of x - xhat_i at ``run.times``, given the run's events.

    With ``stacked``, (T, N n, N n): the errors of all nodes together. Where nodes estimate some
    blocks of the state n is the number of states of the node with most, entries of others beyond
    theirs are nan as in ``Run.P``, and left out of the stacked ones. Paper H (10) says that each
    block stays below P_i, which this shows without Monte Carlo. Regressors are those of the run;
    delays, losses and filter models that differ from the truth are included; recorded states and
    readings are treated as if they had the law that the scenario gives them. Raises TheoryError for
    filters that are not affine and for those whose verbs are plain Python, also where a user's
    subclass overrides one.
    """
    if not stacked:
        return _estimated_blocks(scenario, run, about_mean=True)
    joint = _moments(scenario, run, about_mean=True, stacked=True)
    if scenario.views is None:
        return joint
    known = scenario.is_estimated.ravel()
    return joint[:, known][:, :, known]


def error_squares(scenario: Scenario, run: Run) -> FloatArray:
    """Return E[(x - xhat_i)(x - xhat_i)'] (T, N, n, n) given the events: :func:`error_covariance`
    and the square of the mean error. Raises its errors.
    """
    return _estimated_blocks(scenario, run, about_mean=False)


@IGNORED
def error_law(scenario: Scenario, run: Run) -> ErrorLaw:
    """Return the joint Gaussian law of errors at all ``run.times`` given the events, with their
    mean, and P_i by the filter's equations; a pooled filter counts once. Raises the same errors.
    """
    errors, P = _errors_of(scenario, run), []
    for _ in errors.replay():
        errors.keep()
        P.append(errors.covariances())
    return ErrorLaw(*errors.law(), np.array(P))


def diagonal_blocks(stacked: FloatArray, nodes: int) -> FloatArray:
    """Return the blocks (T, N, n, n) on the diagonals of T stacked covariances (T, N n, N n)."""
    n = stacked.shape[-1] // nodes
    # Entry (t, i, a, j, b) is the covariance of entry a of e_i and entry b of e_j.
    blocks = stacked.reshape(len(stacked), nodes, n, nodes, n)
    return np.ascontiguousarray(np.einsum("tiaib->tiab", blocks))


def _estimated_blocks(scenario: Scenario, run: Run, about_mean: bool) -> FloatArray:
    """Return moments (T, N, n, n) of each node's error, nan beyond the states that it has."""
    known, blocks = scenario.is_estimated, _moments(scenario, run, about_mean, stacked=False)
    return np.where(known[:, :, None] & known[:, None, :], blocks, np.nan)


@IGNORED
def _moments(scenario: Scenario, run: Run, about_mean: bool, stacked: bool) -> FloatArray:
    """Return ``ErrorColumns.moments`` of all nodes at each of ``run.times``."""
    errors = _errors_of(scenario, run)
    # The generator stops at each sample, when the errors have their values of that time.
    moments = np.array([errors.moments(about_mean, stacked) for _ in errors.replay()])
    # A pooled filter is replayed once; all nodes share its estimate, and so its error.
    copies = len(scenario.nodes) // errors.estimators
    return np.tile(moments, (1, copies, copies) if stacked else (1, copies, 1, 1))


def _errors_of(scenario: Scenario, run: Run) -> ErrorColumns:
    """Return the errors at time 0 of all estimators (the filters of the nodes, or a pooled one)."""
    if not isinstance(run, Run):
        raise TheoryError(
            f"run must be a netkf.Run, as netkf.simulate returns it, got a {type(run).__name__}"
        )
    if run.nodes != scenario.nodes or run.x.shape[1] != scenario.plant.n:
        raise TheoryError("the run is of another scenario: its nodes or its state differ")
    require_errors(scenario)
    if scenario.slotted:
        run = with_last_exchanges(scenario, run)
    of_kernels = SlotColumns if scenario.slotted else ClockColumns
    if scenario.model_views is not scenario.views and has_columns(scenario):
        return SeenErrors(of_kernels(scenario, run), scenario)
    reads_kernels = scenario.node_filter.kernels is not None and scenario.common_entries
    if takes_columns(scenario.node_filter) and not reads_kernels:
        return (SlotBlocks if scenario.slotted else ClockBlocks)(scenario, run)
    if not scenario.node_filter.timing.talks and scenario.views is not None:
        return SeenErrors(_errors_of(scenario_of_all(scenario), run), scenario)
    if have_one_view(scenario):
        return _errors_of(scenario_of_view(scenario), run_of_view(scenario, run))
    if scenario.views is not None:
        name = filter_name(scenario)
        raise TheoryError(f"no exact error covariance for the {name} of different blocks")
    if has_columns(scenario):
        return of_kernels(scenario, run)
    require_known_filter(scenario)
    make = theory_of(scenario).error_columns
    if make is None:
        raise TheoryError(f"no exact error covariance for the {filter_name(scenario)}")
    return make(scenario, run)


def require_errors(scenario: Scenario) -> None:
    """Raise TheoryError if events do not give the covariance of errors, of whatever filter."""
    require_linear(scenario, accepted=(RIGHT_CLOCKS, ALL_READ))
    in_python = takes_columns(scenario.node_filter) or not has_columns(scenario)
    reasons = [evidence for _, evidence in scenario.departures]
    if scenario.network.lives and (scenario.slotted or scenario.forgetful_nodes):
        reasons.append(LIVES)
    if reasons and (in_python or scenario.views is not None):
        rule = "exact errors are known of filters whose verbs are affine kernels of one state"
        raise TheoryError(f"{reasons[0]}: {rule}; {CONSISTENCY}")
    if scenario.has_mistimed_increments and scenario.has_mistimed_models:
        rule = "exact errors of increments with wrong clocks are known without inputs and changes"
        raise TheoryError(f"{rule} that filters know; {CONSISTENCY}")
    if scenario.links_follow_state and scenario.node_filter.timing.talks:
        raise TheoryError("the true state says who hears whom: events tell of it")
    kernels = compiled_kernels(scenario.node_filter, clocked=True)
    is_kalman = kernels.is_kalman if kernels else not takes_columns(scenario.node_filter)
    if not scenario.slotted and scenario.increment_sensors and not is_kalman:
        raise TheoryError("the exact errors of this filter are known for sampled sensors")


def require_known_filter(scenario: Scenario) -> None:
    """Raise TheoryError if the equations of the scenario's filter are not known here."""
    algorithm = scenario.filter.algorithm
    name = type(algorithm).__name__
    require_linear(scenario)
    if built_in_class(algorithm) is None:
        rule = "one that is affine says so by shift and Analysis(affine=True), or by kernels"
        raise TheoryError(f"no exact error covariance for {name}: {rule}")
    overridden_names = overridden(algorithm)
    if overridden_names:
        raise TheoryError(
            f"the exact error covariance is not known: {name} defines {overridden_names[0]} itself"
        )
