"""Values of the runs of one filter, and paired differences of two filters on the same runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from netkf.engines.base import Engine
from netkf.ensembles.replicas import form_of
from netkf.ensembles.statistics import run_values
from netkf.laws.intervals import interval_of_squares
from netkf.linalg.arrays import FloatArray
from netkf.runs.curves import ErrorCurve, squares_over_time
from netkf.runs.quantities import NETWORK, NetworkSink, with_network
from netkf.runs.simulate import simulate
from netkf.runs.summary import promise_traces
from netkf.scenario.scenario import Scenario
from netkf.studies.metrics import join_batches, mean_over_runs

JUDGED = ("rms_error", "worst_instant", "nees_ratio")
"""Quantities whose differences have intervals."""
MAX_SAMPLES, MAX_CURVES = 200, 20_000_000
"""Samples of a curve of errors over time, and numbers of all runs' curves of a filter."""
ROUNDING = 1e-9
"""Relative difference up to which two filters count as equal."""


class FilterValues(NamedTuple):
    """Values of R runs, averages over the samples after time 0 (R,) each.

    square   : squared error, mean of all nodes
    nees     : e' P^-1 e, mean of all nodes
    samples  : (R, K) quantities ``runs.quantities.sample_names``, of all nodes (not averages)
    diverged : True if the run ended early
    curves   : (R, K) squared error at K samples, mean of all nodes
    """

    square: FloatArray
    nees: FloatArray
    samples: FloatArray
    diverged: np.ndarray
    curves: FloatArray = np.empty((0, 0))


VALUES = form_of(FilterValues)
"""How plans store them."""


def curve_rows(scenario: Scenario, runs: int) -> np.ndarray:
    """Return the indices (K,) of the samples of curves of so many runs, evenly spaced."""
    total = len(scenario.times)
    count = min(total, MAX_SAMPLES, max(2, MAX_CURVES // runs))
    return np.unique(np.linspace(0, total - 1, count).astype(int))


def mean_curve(label: str, scenario: Scenario, curves: FloatArray) -> ErrorCurve:
    """Return the mean over runs of ``curves`` (R, K), its standard error, and what theory gives."""
    runs, times = len(curves), scenario.times[curve_rows(scenario, len(curves))]
    error = curves.std(axis=0, ddof=1) / math.sqrt(runs) if runs > 1 else None
    promised = promise_traces(scenario, times)
    square, central, bound = curves.mean(axis=0), promised.central, promised.mean_bound
    return ErrorCurve(label, times, square, error, runs, central, bound, scenario.unit)


def block_values(
    scenario: Scenario, seed: int, replicas: range, engine: Engine, rows: np.ndarray
) -> FilterValues:
    """Return values of ``replicas``, curves at the samples ``rows``; for ``replicate_blocks``."""
    parts = []
    for batch in engine.run_many(scenario, seed, replicas):
        values = run_values(batch, scenario)
        # (R,): squared error and NEES, means over time and nodes.
        square, _, nees = values.averages[:, -1].T
        curves = squares_over_time(batch, rows)
        quantities = values.quantities[:, -1]
        parts.append(FilterValues(square, nees, quantities, values.diverged > 0, curves))
    return join_batches(*parts)


def count_traffic(scenario: Scenario, seed: int, engine: Engine) -> dict[str, float]:
    """Simulate replica 0 and return the quantities NETWORK of all its nodes together."""
    wanted = with_network(scenario)
    sink = NetworkSink(wanted, seed, 0)
    run = simulate(wanted, seed, 0, engine, [sink])
    return dict(zip(NETWORK, sink.values(run.status == "complete")[-1].tolist(), strict=True))


class Quantity(NamedTuple):
    """A mean over runs with its standard error, and its difference from that of the first filter.

    ``low`` and ``high`` are the interval of the difference, ``real`` is True if it excludes 0; nan
    and False without a difference.
    """

    value: float
    se: float
    difference: float = math.nan
    low: float = math.nan
    high: float = math.nan
    real: bool = False


def estimate_quantities(
    values: FilterValues, first: FilterValues | None, n: float, names: Sequence[str], level: float
) -> dict[str, Quantity]:
    """Return ``rms_error``, ``nees_ratio`` and the quantities of samples, ``names``, of a filter of
    n states, with paired differences from the ``first``; intervals of JUDGED miss with ``level``.
    """
    quantities = {}
    base = _influences(first, n, names) if first is not None else {}
    for name, (value, influence) in _influences(values, n, names).items():
        runs = len(influence)
        quantity = Quantity(value, mean_over_runs(influence).error)
        if name in base and not (values.diverged.any() or first is None or first.diverged.any()):
            base_value, influence_difference = base[name][0], influence - base[name][1]
            width = _width(influence_difference, level) if name in JUDGED else math.nan
            gap = value - base_value
            # The interval excludes 0, and the difference is not mere rounding, by which two forms
            # of one algorithm differ.
            real = runs > 1 and abs(gap) > max(width, ROUNDING * abs(value))
            quantity = quantity._replace(
                difference=gap, low=gap - width, high=gap + width, real=bool(real)
            )
        quantities[name] = quantity
    return quantities


def _influences(
    values: FilterValues, n: float, names: Sequence[str]
) -> dict[str, tuple[float, FloatArray]]:
    """Return each quantity with its influence values (R,), whose mean has its error."""
    # Delta method: differences of two filters have the error of differences of influences.
    rms = math.sqrt(float(values.square.mean()))
    # d sqrt(m) = dm / (2 sqrt(m))
    square = values.square / (2.0 * rms) if rms > 0.0 else values.square
    means = {"nees_ratio": values.nees / n, **dict(zip(names, values.samples.T, strict=True))}
    return {"rms_error": (rms, square)} | {
        name: (float(column.mean()), column) for name, column in means.items()
    }


def _width(values: FloatArray, level: float) -> float:
    """Return half of Student's interval for the mean of ``values`` (R,); nan for one value."""
    if len(values) < 2:
        return math.nan
    quantile = float(scipy.special.stdtrit(len(values) - 1, 1.0 - level / 2.0))
    return quantile * mean_over_runs(values).error


def credibility(values: FilterValues, n: float, level: float) -> str:
    """Return "overconfident", "conservative" or "consistent", as the interval of NEES / n lies
    above, below or around 1; "-" if NEES is unknown, or of one run.
    """
    ratios = values.nees / n
    if len(ratios) < 2 or not np.isfinite(ratios).all():
        return "-"
    low, high = interval_of_squares(ratios, level)
    if low > 1.0:
        return "overconfident"
    return "conservative" if high < 1.0 else "consistent"
