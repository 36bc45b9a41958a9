"""Errors, covariances and messages of runs of one scenario, run by run, and paired differences of
two filters on the same runs.
"""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy

from netkf.algorithms.baselines import Central
from netkf.algorithms.kernels.root_flow import whiten_observation
from netkf.algorithms.models import SlotModel
from netkf.core.errors import TheoryError
from netkf.engines.base import Engine
from netkf.ensembles.replicas import form_of
from netkf.ensembles.statistics import count_messages, run_values, simulate_batches
from netkf.laws.intervals import interval_of_squares
from netkf.linalg.arrays import FloatArray
from netkf.runs.curves import ErrorCurve, squares_over_time
from netkf.runs.quantities import NETWORK, NetworkSink, with_network
from netkf.runs.simulate import simulate
from netkf.runs.summary import promise_traces
from netkf.scenario.model import Filtering
from netkf.scenario.scenario import Scenario
from netkf.theory import covariance_bound, riccati_step
from netkf.theory.common.evidence import require_every_reading, require_linear
from netkf.theory.errors import error_squares
from netkf.theory.hybrid.samples import randomly_sampled_sensors
from netkf.trace.nees import traces
from netkf.trace.schema import KINDS

MAX_ERRORS = 24
"""Largest number of errors of all nodes whose exact covariance costs about a few runs."""
Batches = TypeVar("Batches", bound=tuple[Any, ...])
SAME = 1e-9  # of the largest state: a larger difference is more than rounding
NO_QUANTITIES = np.empty((0, 0))


class RunMetrics(NamedTuple):
    """Averages over time of R runs.

    mean_square, trace : (R, N) squared error and trace of P, averaged over the samples after time 0
    messages           : (R, 5) counts in the order of ``ensembles.statistics.MESSAGES``
    diverged           : (R, 1) 1 if the run ended early
    rounding_from      : (R, 1) time (s) from which rounding blurs errors, which are averaged over
                         the samples before it; not finite without one
    quantities         : (R, K) the quantities ``runs.quantities.ensemble_names``, of all nodes
    """

    mean_square: FloatArray
    trace: FloatArray
    messages: FloatArray
    diverged: np.ndarray
    rounding_from: FloatArray
    quantities: FloatArray = NO_QUANTITIES


METRICS = form_of(RunMetrics)
"""How plans store them."""


def block_metrics(scenario: Scenario, seed: int, replicas: range, engine: Engine) -> RunMetrics:
    """Simulate ``replicas`` of ``seed`` and return their metrics; for ``replicate_blocks``."""
    parts = []
    for batch, network in simulate_batches(scenario, seed, replicas, engine):
        values = run_values(batch, scenario, network)
        # averages (R, N + 1, 3): squared error, trace of P, NEES; the last row is of all nodes.
        square, trace, _ = np.moveaxis(values.averages[:, :-1], 2, 0)
        ends = values.diverged[:, None], values.rounding_from[:, None]
        parts.append(RunMetrics(square, trace, values.messages, *ends, values.quantities[:, -1]))
    return join_batches(*parts)


def join_batches(*parts: Batches) -> Batches:
    """Return the results of several batches, named tuples of arrays of one kind, as one."""
    kind: Any = type(parts[0])
    joined: Batches = kind(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    return joined


def expected_metrics(scenario: Scenario, seed: int, replica: int, engine: Engine) -> RunMetrics:
    """Return the metrics of one ``replica`` with squared errors replaced by their exact
    expectations given the events of the run (Rao-Blackwell), so that far fewer runs are enough.
    """
    run = simulate(scenario, seed, replica, engine)
    if run.status != "complete":
        return block_metrics(scenario, seed, range(replica, replica + 1), engine)
    square = time_average(scenario, traces(error_squares(scenario, run)))[None]
    trace = time_average(scenario, traces(run.P))[None]
    return RunMetrics(
        mean_square=square,
        trace=trace,
        messages=count_messages(np.array([[run.count(kind) for kind in KINDS]]), scenario.slotted),
        diverged=np.zeros((1, 1)),
        rounding_from=np.full((1, 1), np.inf),  # expectations do not suffer from rounding
    )


def is_small(scenario: Scenario) -> bool:
    """Return True for few errors of all nodes: their covariance costs about a run in SimPy."""
    return len(scenario.nodes) * scenario.width <= MAX_ERRORS


def expected_errors_known(scenario: Scenario) -> bool:
    """Return True if ``expected_metrics`` take about as long as a few runs."""
    if not scenario.is_random or not is_small(scenario):
        return False
    short = scenario
    if not scenario.slotted and isinstance(scenario.probe, float):
        # Whether it is known does not depend on the horizon.
        short = scenario.replace({"horizon": scenario.probe})
    try:
        error_squares(short, simulate(short))
    except TheoryError:
        return False
    return True


class MeanEstimate(NamedTuple):
    """A mean over runs with its standard error, nan for a single run."""

    value: float
    error: float


def is_one_truth(x: FloatArray, other: FloatArray) -> bool:
    """Return True if true states (K, n) are equal up to rounding, which inputs may move."""
    scale = np.fmax.reduce(np.abs(x), axis=1, keepdims=True, initial=0.0)
    with np.errstate(invalid="ignore"):  # of infinite states, which are equal
        close = (x == other) | (np.abs(x - other) <= SAME * scale) | (np.isnan(x) & np.isnan(other))
    return bool(close.all())


def mean_over_runs(values: FloatArray) -> MeanEstimate:
    """Return the mean of ``values`` (R,), one for each run, with its standard error."""
    with np.errstate(over="ignore", invalid="ignore"):
        spread = float(values.std(ddof=1)) if len(values) > 1 else math.nan
    return MeanEstimate(float(values.mean()), spread / math.sqrt(len(values)))


def worst_node(values: FloatArray) -> MeanEstimate:
    """Return the estimate of the node with the largest mean, from ``values`` (R, N)."""
    return mean_over_runs(values[:, int(np.argmax(values.mean(axis=0)))])


def all_nodes(values: FloatArray) -> MeanEstimate:
    """Return the estimate of the mean over all nodes, from ``values`` (R, N)."""
    return mean_over_runs(values.mean(axis=1))


def square_root_of(estimate: MeanEstimate) -> MeanEstimate:
    """Return the estimate of the square root, by the delta method."""
    value = math.sqrt(estimate.value)
    return MeanEstimate(value, estimate.error / (2.0 * value) if value > 0.0 else math.nan)


def time_average(scenario: Scenario, values: FloatArray) -> FloatArray:
    """Return the means (N,) of values (T, N) over the samples after time 0, as in summaries."""
    after_start = scenario.times > 0.0
    return np.asarray(values[after_start if after_start.any() else slice(None)].mean(axis=0))


def bound_traces(scenario: Scenario) -> FloatArray:
    """Return the traces (N,) of the bound on the mean of each node's P, averaged over time: H (12)
    in continuous time, P itself in slots without exchange. Raises TheoryError for others.
    """
    if not scenario.slotted:
        bound = covariance_bound(scenario, scenario.times)
        return time_average(scenario, np.trace(bound, axis1=2, axis2=3))
    if scenario.filter.algorithm.timing.talks:
        raise TheoryError("Tanwani's H(12) is about filters in continuous time")
    require_linear(scenario)
    _require_fixed_H(scenario)
    starts = [scenario.initial_estimate(node)[1] for node in scenario.nodes]
    if scenario.filter.algorithm.timing.pooled:  # one filter has the readings of all nodes
        P = _slot_covariances(scenario, 0, starts[0])
        views = [scenario.view(k) for k in range(len(starts))]
        columns = [traces(P[:, view][:, :, view]) for view in views]
    else:
        columns = [traces(_slot_covariances(scenario, k, P)) for k, P in enumerate(starts)]
    return time_average(scenario, np.stack(columns, axis=1))


def central_traces(scenario: Scenario) -> FloatArray:
    """Return the traces (N,) of P of a filter with all readings and the true model, of what each
    node estimates, averaged over time. Raises TheoryError if readings are recorded or missing,
    their times or H random.
    """
    if randomly_sampled_sensors(scenario):
        raise TheoryError("sensors sample at random times: the central filter has a bound, no P")
    require_every_reading(scenario)
    network = dataclasses.replace(scenario.network, clocks=())
    central = dataclasses.replace(scenario, filter=Filtering(algorithm=Central()), network=network)
    if scenario.slotted:
        _require_fixed_H(scenario)
        P = _slot_covariances(scenario, 0, scenario.plant.start_cov, central.model_pieces)
    else:
        P = covariance_bound(central, scenario.times)[:, 0]
    if scenario.views is None:
        return np.repeat(time_average(scenario, traces(P)[:, None]), len(scenario.nodes))
    columns = [traces(P[:, view][:, :, view]) for view in scenario.views]
    return time_average(scenario, np.stack(columns, axis=1))


def over_central(squares: FloatArray, central: FloatArray) -> FloatArray:
    """Return mean ``squares`` (..., N) over the ``central_traces`` (N,), 0 where both are 0."""
    nothing = np.where(squares > 0.0, np.inf, 0.0)
    return np.divide(squares, central, out=nothing, where=central > 0.0)


def _require_fixed_H(scenario: Scenario) -> None:
    """Raise TheoryError unless the dynamics are linear, and all readings drawn with a known H."""
    _ = scenario.linear_plant
    require_every_reading(scenario)
    if not scenario.is_random:
        raise TheoryError("the readings are recorded: their law is unknown")
    for node in scenario.sensing_nodes:
        scenario.observation_matrices(node)  # raises where H is random


def _slot_covariances(
    scenario: Scenario, entity: int, start: FloatArray, pieces: Sequence[Any] = ()
) -> FloatArray:
    """Return P (T, n, n) of a Kalman filter with the models of an ``entity``, from ``start``."""
    predicts = scenario.filter.algorithm.timing.predicts
    models: list[SlotModel] = [piece[entity] for piece in pieces or scenario.model_pieces]
    # At most n rows with the same information: a central filter may read hundreds.
    H = whiten_observation(models[0].H, models[0].R)
    R, changes = np.eye(len(H)), scenario.slot_plant.change_slots
    P, covariances = start, np.empty((max(scenario.sampled_slots) + 1, *start.shape))
    covariances[0] = start
    for slot in range(1, len(covariances)):
        piece = bisect.bisect_right(changes, slot - 1, hi=len(models) - 1)
        F, Q = models[piece].F, models[piece].Q
        if predicts:
            P = riccati_step(P, F, Q, H, R) if len(H) else F @ P @ F.T + Q
        else:
            P = F @ P @ F.T + Q
            S = H @ P @ H.T + R
            P = P - P @ H.T @ np.linalg.solve(S, H @ P) if len(H) else P
        covariances[slot] = P
    return np.asarray(covariances[np.array(scenario.sampled_slots)])


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
