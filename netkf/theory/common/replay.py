"""Replay of a run's events on the errors of its filters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.registry import overridden
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.arrivals import with_last_exchanges
from netkf.theory.common.clock_columns import ClockColumns, has_clock_columns
from netkf.theory.common.columns import ErrorColumns
from netkf.theory.common.evidence import NONLINEAR
from netkf.theory.common.papers import paper_function
from netkf.theory.common.slot_columns import SlotColumns, has_columns
from netkf.trace.run import Run


def replay_covariances(scenario: Scenario, run: Run, about_mean: bool = True) -> FloatArray:
    """Return the exact joint error covariance (T, M n, M n) of M estimators at ``run.times``, given
    the events of the run (ticks, losses, delays): the run is replayed on the errors alone. Unless
    ``about_mean``, they are second moments: filters may start elsewhere than the plant.

    An estimator is a node's filter, or (M = 1) the pooled one that all nodes share. Raises
    TheoryError for a filter whose equations are not known here.
    """
    errors = _errors_of(scenario, run)
    # The generator stops at each sample, when the errors have their values of that time.
    joint = errors.covariance if about_mean else errors.second_moments
    covariances = [joint() for _ in errors.replay()]
    size = errors.estimators * errors.n
    return np.array(covariances).reshape(-1, size, size)


class ErrorLaw(NamedTuple):
    """The Gaussian law of the errors of M estimators at T times given the events of a run.

    ``mean`` (T M n,) and ``covariance`` (T M n, T M n) of all errors together, ``P`` (T, M, n, n).
    """

    mean: FloatArray
    covariance: FloatArray
    P: FloatArray


def replay_law(scenario: Scenario, run: Run) -> ErrorLaw:
    """Return the joint Gaussian law of the errors of M estimators at all T ``run.times``, of which
    there must be some: mean (T M n,), covariance (T M n, T M n), and P (T, M, n, n) by the filter's
    equations.

    Raises TheoryError for a filter whose equations are not known here.
    """
    errors, P = _errors_of(scenario, run), []
    for _ in errors.replay():
        errors.keep()
        P.append(errors.covariances())
    return ErrorLaw(*errors.law(), np.array(P))


def _errors_of(scenario: Scenario, run: Run) -> ErrorColumns:
    """Return the errors at time 0 of all estimators of a scenario (the filters of its nodes, or one
    pooled filter), for the replay of a run; raises TheoryError for a filter whose equations are not
    known here.
    """
    if not scenario.is_linear:
        raise TheoryError(NONLINEAR)
    if scenario.slotted:
        run = with_last_exchanges(scenario, run)
        if has_columns(scenario):
            return SlotColumns(scenario, run)
    elif has_clock_columns(scenario):
        return ClockColumns(scenario, run)
    require_known_filter(scenario)
    make = paper_function(scenario, "errors", "error_columns")
    if make is None:
        name = type(scenario.filter.algorithm).__name__
        raise TheoryError(f"no exact error covariance for {name}")
    errors: ErrorColumns = make(scenario, run)
    return errors


def require_known_filter(scenario: Scenario) -> None:
    """Raise TheoryError if the equations of the scenario's filter are not known here."""
    algorithm = scenario.filter.algorithm
    name = type(algorithm).__name__
    if not scenario.is_linear:
        raise TheoryError(NONLINEAR)
    if not scenario.node_filter.analysis.combination:
        raise TheoryError(f"no exact error covariance for {name}")
    overridden_names = overridden(algorithm)
    if overridden_names:
        raise TheoryError(
            f"the exact error covariance is not known: {name} defines {overridden_names[0]} itself"
        )
