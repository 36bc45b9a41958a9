"""Targets for sizing, by theory and by simulation."""

from __future__ import annotations

import math
import re
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.core.errors import ScenarioError, TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import RunMetrics, bound_traces, central_trace
from netkf.theory import assumptions

QUANTITIES = {
    "worst_rms": "RMS error of the node with the largest",
    "mean_rms": "RMS error of all nodes together",
    "worst_trace": "mean trace of P of the node with the largest",
    "mean_trace": "mean trace of P of all nodes",
    "within_central": "RMS error of the node with the largest over that of a centralised filter",
}
"""What may be asked for; all are averages over the samples after time 0."""


class Target(NamedTuple):
    """A quantity that should be at most ``limit``."""

    quantity: str
    limit: float

    def __str__(self) -> str:
        return f"{self.quantity} <= {self.limit:g}"

    @property
    def of_errors(self) -> bool:
        """Whether it is about errors, else about covariances."""
        return not self.quantity.endswith("_trace")

    @property
    def of_worst(self) -> bool:
        """Whether it is about the worst node, else about all together."""
        return not self.quantity.startswith("mean_")


class Interval(NamedTuple):
    """An estimate of a quantity, and between what it lies."""

    value: float
    low: float
    high: float


def parse_target(text: Any) -> Target:
    """``worst_rms<=0.5`` as a target; raises ScenarioError at --target."""
    found = re.fullmatch(r"\s*(\w+)\s*<=\s*(\S+)\s*", text) if isinstance(text, str) else None
    listed = ", ".join(QUANTITIES)
    if found is None or found[1] not in QUANTITIES:
        words = f"must be QUANTITY<=LIMIT with a quantity of {listed}"
        raise ScenarioError("--target", words, text, "write worst_rms<=0.5")
    try:
        limit = float(found[2])
    except ValueError:
        limit = math.nan
    if not (math.isfinite(limit) and limit > 0.0):
        raise ScenarioError("--target", "limit must be a number above 0", found[2], "mend it")
    return Target(found[1], limit)


def by_theory(scenario: Scenario, target: Target) -> tuple[float, str]:
    """An upper bound on the quantity, or the quantity itself, and words that say which. Raises
    TheoryError where theory does not tell.
    """
    traces, algorithm = bound_traces(scenario), scenario.filter.algorithm
    words = "exact: the covariance of filters that do not talk"
    if algorithm.talks:
        words = "an upper bound: the trace of H(12), which E[P_i] stays below"
    if target.of_errors:
        words += _errors_obey(scenario)
    value = float(traces.max() if target.of_worst else traces.mean())
    if target.quantity == "within_central":
        value /= central_trace(scenario)
    return math.sqrt(value) if target.of_errors else value, words


def _errors_obey(scenario: Scenario) -> str:
    """Words about errors and P; raises TheoryError where P says nothing about the errors."""
    if not scenario.filters_know_the_truth:
        raise TheoryError("the filters' model differs from the truth: P need not bound the errors")
    rows = assumptions(scenario)
    start = rows[rows["assumption"].str.startswith("P_i(0) >= ")]
    if not start["holds"].all():
        raise TheoryError("P_i(0) is below the covariance of the first error: P need not bound it")
    same = all(
        np.array_equal(P, scenario.plant.start_cov) and np.array_equal(x, scenario.plant.start_mean)
        for x, P in map(scenario.start, scenario.nodes)
    )
    exact = same and not scenario.filter.algorithm.talks
    return "" if exact else "; P_i in turn bounds the covariance of the error, H (10)"


def by_simulation(
    found: RunMetrics, target: Target, level: float, central: float | None
) -> Interval:
    """The quantity with an interval that misses with probability ``level``: Student's, at once for
    all nodes where it is about the worst; ``central`` is the trace to divide by.
    """
    values = found.mean_square if target.of_errors else found.trace
    if (np.isnan(values) & ~(found.diverged > 0)).any():
        return Interval(math.nan, -math.inf, math.inf)  # rounding has left no errors to judge by
    values = np.where(found.diverged > 0, np.inf, values)
    columns = values if target.of_worst else values.mean(axis=1, keepdims=True)
    runs, count = columns.shape
    with np.errstate(over="ignore", invalid="ignore"):
        mean = columns.mean(axis=0)
        error = columns.std(axis=0, ddof=1) / math.sqrt(runs)
    width = float(scipy.special.stdtrit(runs - 1, 1.0 - level / (2.0 * count))) * error
    ends = np.array([mean.max(), (mean - width).max(), (mean + width).max()])
    if central is not None:
        ends /= central
    ends = np.sqrt(np.maximum(ends, 0.0)) if target.of_errors else ends
    return Interval(*map(float, _or_infinite(ends)))


def _or_infinite(ends: FloatArray) -> FloatArray:
    """A run that diverged has errors without end."""
    return np.where(np.isnan(ends), np.inf, ends)
