"""``netkf.fit_noise`` and ``netkf.log_likelihood``: the noise of plant and sensors by likelihood.

The likelihood is that of the readings of a run, all sensors together, under the model that the
filters believe: the density of the innovations of the central Kalman filter, whose gaps between
readings are discretised exactly (Schweppe, IEEE Trans. Inf. Theory 11, 1965). Variances are fitted
as logarithms; their standard errors come from the Hessian at the maximum.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtri

from netkf.algorithms.baselines import Central
from netkf.checks.innovations import LOG_2PI, Innovations
from netkf.core.errors import ScenarioError
from netkf.core.fields import integer, number
from netkf.core.notebook import NotebookTable
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.small import add_matmul, matmul
from netkf.plants.transitions import Transitions
from netkf.runs.failures import explain_failures
from netkf.runs.readings import RunReadings, collect_readings
from netkf.runs.simulate import require_scenario
from netkf.scenario.scenario import Scenario
from netkf.trace.nees import BLUR, ROUNDING

if TYPE_CHECKING:
    import pandas as pd

RANGE, STRIDE = 30.0, 2.0
"""Largest change of the logarithm of a variance that is searched, and that of one search."""
NEGLIGIBLE = 1e-6
"""Loss of log-likelihood below which a variance is 0 as far as the readings can tell."""
UNKNOWN = 10.0
"""Standard error of the logarithm of a variance from which on it is unknown."""
STARTS = (0.0, -4.0, 4.0)
"""Changes of the logarithms of the variances of plant and sensors that are tried at first."""
LEAPS, MAX_CLIMBS = (4.0, 8.0, 12.0), 10
"""Changes of the logarithm of one variance that are tried where a climb ends."""


class Variance(NamedTuple):
    """A variance that is fitted: its name, its ``value`` in the scenario, and what it scales, a
    part Q (n, n) of the plant's noise, from ``columns`` of B or in slots a part of Q, or components
    (``rows``) of the noise of a ``[[sensors]]`` ``entry``.
    """

    name: str
    value: float
    Q: FloatArray | None = None
    columns: tuple[int, ...] = ()
    entry: int = -1
    rows: tuple[int, ...] = ()


@kernel(allocates=True)
def filter_rows(
    F: FloatArray,
    Q: FloatArray,
    laws: np.ndarray,
    first: np.ndarray,
    H: FloatArray,
    y: FloatArray,
    r: FloatArray,
    x: FloatArray,
    P: FloatArray,
    innovations: FloatArray,
    variances: FloatArray,
) -> None:
    """Run a Kalman filter from the estimate ``x`` (n, 1), ``P`` (n, n) over K instants: a
    prediction by law ``laws[k]`` of ``F`` and ``Q`` (L, n, n), then scalar readings ``y`` (M,) with
    ``H`` (M, n) and variances ``r`` (M,), from ``first[k]`` on; write innovations, variances (M,).
    """
    n = len(x)
    for k in range(len(laws)):
        law = laws[k]
        x, P = matmul(F[law], x), add_matmul(Q[law], matmul(F[law], P), F[law].T)
        for row in range(first[k], first[k + 1]):
            g, v, S = np.zeros(n), y[row], r[row]
            for i in range(n):
                for m in range(n):
                    g[i] += 0.5 * (P[i, m] + P[m, i]) * H[row, m]
                v -= H[row, i] * x[i, 0]
                S += H[row, i] * g[i]
            for i in range(n):
                x[i, 0] += g[i] * v / S
                for j in range(n):
                    P[i, j] -= g[i] * g[j] / S
            innovations[row], variances[row] = v, S


class CentralModel:
    """The central Kalman filter of a scenario over the readings of a ``replica``, as a function of
    the variances of its noises.

    times, nodes, components : (M,) seconds and ids of scalar readings, and which values of all that
                               the node reads they are
    """

    def __init__(self, scenario: Scenario, seed: int, replica: int) -> None:
        """Raises ScenarioError for a model that is not linear, or that changes, and for readings
        whose noise rounding hides, as those of unstable plants in the end.
        """
        _require_central(scenario)
        filtering = dataclasses.replace(scenario.filter, algorithm=Central(), estimates="all")
        network = dataclasses.replace(scenario.network, activation=None, radio=None)
        central = dataclasses.replace(scenario, filter=filtering, network=network)
        got = collect_readings(central, seed, replica, central.placed_sensors, all_slots=True)
        if not got.readings:
            raise ScenarioError("sensors", "give no readings", None, "add a sensor or rows")
        self._mean, self._cov = central.initial_estimate(central.nodes[0])
        self.variances = tuple(_plant_variances(central)) + tuple(_sensor_variances(central))
        self._lay_rows(central, got)
        self._lay_laws(central, got.times)
        self._stated = self.innovations(np.ones(len(self.variances)))
        # In units of the noise S is at least 1.
        largest = float(np.max(abs(self.y) / np.sqrt(np.maximum(self._stated[1], 1.0))))
        if largest * ROUNDING * BLUR > 1.0:
            rule, remedy = "give readings too large for rounding to leave", "shorten the horizon"
            raise ScenarioError("sensors", f"{rule} their noise", largest, remedy)

    def _lay_rows(self, scenario: Scenario, got: RunReadings) -> None:
        """Lay out scalar readings: those of a noise that is not diagonal are decorrelated."""
        index = {(v.entry, row): k for k, v in enumerate(self.variances) for row in v.rows}
        H, of, owners = [], [], []
        # How many values each linear sensor reads.
        rows = [len(sensor.matrix_of(scenario.plant.n)) for sensor in scenario.sensors]
        first = {
            (node, one.ordinal): sum(rows[before.entry] for before in placed[:k])
            for node, placed in scenario.placed_sensors.items()
            for k, one in enumerate(placed)
        }
        y, scales = list[float](), list[float]()
        for one in got.readings:
            diagonal = np.diag(one.R)
            entry = scenario.sensor_entries[one.placed.entry]
            is_diagonal = np.array_equal(one.R, np.diag(diagonal))
            root = np.diag(np.sqrt(diagonal)) if is_diagonal else np.linalg.cholesky(one.R)
            # Rows of unit variance.
            z, J = np.linalg.solve(root, one.y), np.linalg.solve(root, one.H)
            scales += np.diag(root).tolist()
            y += z.tolist()
            H += list(J)
            of += [index.get((entry, row), -1) for row in one.rows.tolist()]
            at = one.number, got.times[one.number], one.node
            owners += [(*at, first[one.node, one.placed.ordinal] + int(row)) for row in one.rows]
        numbers = np.array([number for number, *_ in owners])
        self.H, self.y = np.array(H), np.array(y)
        # The first row of each instant, and their number.
        self._first = np.searchsorted(numbers, np.arange(len(got.times) + 1))
        self._of, self._scales = np.array(of), np.array(scales)
        _, self.times, self.nodes, self.components = map(np.array, zip(*owners, strict=True))

    def _lay_laws(self, scenario: Scenario, times: FloatArray) -> None:
        parts = [v.Q for v in self.variances if v.Q is not None]
        if scenario.slotted:
            F, Q = scenario.slot_belief
            fixed = Q - sum(parts, np.zeros_like(Q))
            slots = np.round(times / scenario.slot_plant.period).astype(int)
            gaps, self._laws = np.unique(np.diff(slots, prepend=0), return_inverse=True)
            self._F = np.array([np.linalg.matrix_power(F, int(g)) for g in gaps])
            self._parts = np.array(
                [[_accumulate(F, part, int(g)) for part in (*parts, fixed)] for g in gaps]
            )
            return
        A, _ = scenario.belief
        gaps, self._laws = np.unique(np.diff(times, prepend=0.0), return_inverse=True)
        self._F = Transitions(A, np.zeros((len(A), 1))).transitions(gaps)
        B = believed_noise(scenario)
        roots = [
            Transitions(A, B[:, v.columns]).laws(gaps)[1] for v in self.variances if v.Q is not None
        ]
        noises = [root @ np.swapaxes(root, 1, 2) for root in roots]
        noises.append(np.zeros_like(self._F))
        self._parts = np.stack(noises, axis=1)

    def innovations(self, factors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return innovations (M,) in units of the noise, and their variances, by ``factors``."""
        weights = np.append(factors[: sum(v.Q is not None for v in self.variances)], 1.0)
        Q = np.ascontiguousarray(np.einsum("j,ljab->lab", weights, self._parts))
        r = np.append(factors, 1.0)[self._of]
        v, S = np.empty(len(self.y)), np.empty(len(self.y))
        x, P = np.array(self._mean)[:, None].copy(), np.array(self._cov)
        filter_rows(self._F, Q, self._laws, self._first, self.H, self.y, r, x, P, v, S)
        return v, S

    def value(self, factors: FloatArray) -> float:
        """Return the log-likelihood with the variances of the scenario times ``factors`` (J,)."""
        with np.errstate(all="ignore"):
            v, S = self.innovations(factors)
            total = float(self._densities(v, S).sum())
        return total if math.isfinite(total) else -math.inf

    def _densities(self, v: FloatArray, S: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * (LOG_2PI + np.log(S) + v * v / S) - np.log(self._scales))

    def as_innovations(self) -> Innovations:
        """Return the innovations of scalar readings, each given those before it."""
        v, S = self._stated
        rows = np.ones(len(v), dtype=np.int64)
        parts = v / np.sqrt(S), v * self._scales, np.sqrt(S) * self._scales
        whitened, values, deviations = (list(part[:, None]) for part in parts)
        return Innovations(
            self.times, self.nodes, rows, v * v / S, whitened, values, deviations,
            self._densities(v, S), components=list(self.components[:, None]),
        )  # fmt: skip


def _require_central(scenario: Scenario) -> None:
    plant, leave_out = scenario.plant, "leave it out"
    increments = "must take samples: increments have no density of their own"
    changes = "cannot be here: the likelihood is that of one model"
    linear = "must be linear, as the Kalman filter whose likelihood this is"
    lives = "cannot be here: the likelihood is that of all readings, also of nodes that are down"
    clocks = "cannot be here: the likelihood is that of readings with right stamps"
    unknown = "must be true: an input that the model does not have would count as noise"
    for wrong, key, rule, remedy in (
        (not plant.linear, "plant", linear, "write a linear plant that is close to it"),
        (not scenario.has_linear_sensors, "sensors", linear, "leave the others out"),
        (scenario.increment_sensors, "sensors", increments, "write sampling = { kind = ... }"),
        (len(plant.changes), "plant.schedule", changes, "take each part of the run by itself"),
        (scenario.network.lives, "network.lives", lives, leave_out),
        (scenario.network.clocks, "network.clocks", clocks, leave_out),
        (scenario.misses_input, "filter.model.input", unknown, leave_out),
    ):
        if wrong:
            raise ScenarioError(key, rule, None, remedy)


def believed_noise(scenario: Scenario) -> FloatArray:
    """Return B (n, m) that filters believe, in slots Q (n, n)."""
    model, plant = scenario.filter.model, scenario.plant
    if scenario.slotted:
        return scenario.slot_belief[1]
    B: FloatArray = plant.B if model.B is None else model.B  # type: ignore[attr-defined]
    return B


def _accumulate(F: FloatArray, Q: FloatArray, slots: int) -> FloatArray:
    total = np.zeros_like(Q)
    for _ in range(slots):
        total = F @ total @ F.T + Q
    return total


def _plant_variances(scenario: Scenario) -> Iterator[Variance]:
    """Yield the variances of columns of B, in slots the diagonal of Q or its trace, by block."""
    noise, n = believed_noise(scenario), scenario.plant.n
    groups: dict[tuple[str, str], list[tuple[FloatArray, int]]] = {}
    for place in scenario.layout.places:
        own, prefix = place.entries, f"{place.name}: " if scenario.plants else ""
        if not scenario.slotted:
            for k, j in enumerate(np.flatnonzero(noise[own].any(axis=0)).tolist()):
                column = np.where(np.isin(np.arange(n), np.arange(n)[own]), noise[:, j], 0.0)
                part = np.outer(column, column)
                groups.setdefault((prefix, f"|B[:, {k}]|^2"), []).append((part, j))
            continue
        Q = noise[own, own]
        is_diagonal = np.array_equal(Q, np.diag(np.diag(Q)))
        entries = np.flatnonzero(np.diag(Q)).tolist() if is_diagonal else [-1]
        for i in entries:
            part = np.zeros((n, n))
            part[own, own] = Q if i < 0 else np.diag(np.where(np.arange(len(Q)) == i, Q[i, i], 0.0))
            groups.setdefault((prefix, "trace Q" if i < 0 else f"Q[{i}][{i}]"), []).append(
                (part, i)
            )
    for (prefix, name), parts in groups.items():
        total = np.sum([part for part, _ in parts], axis=0)
        columns = tuple(j for _, j in parts)
        yield Variance(prefix + name, float(np.trace(total)) / len(parts), total, columns)


def _sensor_variances(scenario: Scenario) -> Iterator[Variance]:
    """Yield the diagonal of R, or its trace, of each ``[[sensors]]`` entry that states it."""
    seen = set()
    for placed in itertools.chain.from_iterable(scenario.placed_sensors.values()):
        entry, sensor = scenario.sensor_entries[placed.entry], scenario.sensors[placed.entry]
        if entry in seen or (sensor.record is not None and sensor.record.has_noise):
            continue
        seen.add(entry)
        R = scenario.noise_covariance(placed.entry, believed=True)
        key, rows = f"sensors[{entry}].R", tuple(range(len(R)))
        if np.array_equal(R, np.diag(np.diag(R))):
            for i in rows:
                yield Variance(f"{key}[{i}][{i}]", float(R[i, i]), entry=entry, rows=(i,))
        else:
            yield Variance(f"trace {key}", float(np.trace(R)), entry=entry, rows=rows)


@dataclass(frozen=True, eq=False, repr=False)
class NoiseFit(NotebookTable):
    """The variances of a scenario's noises by likelihood.

    table          : a row for each variance: ``name``, ``start`` in the scenario, ``value``, its
                     standard error ``se``, and the ends ``low``, ``high`` of its interval at
                     ``confidence``
    log_likelihood : at the maximum; ``start_log_likelihood`` with the variances of the scenario
    readings       : number of scalar readings
    changes        : the fitted matrices by key of the scenario: filter.model.B or Q, and R
    given          : the scenario without these
    """

    name: str
    table: pd.DataFrame
    log_likelihood: float
    start_log_likelihood: float
    readings: int
    confidence: float
    changes: dict[str, Any]
    given: Scenario = field(repr=False)
    notes: tuple[str, ...] = ()

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario with the changes; raises ScenarioError if its filter does not take them."""
        return self.given.replace(self.changes)

    def __repr__(self) -> str:
        values = ", ".join(f"{v.name} = {v.value:.4g}" for v in self.table.itertuples(index=False))
        gain = self.log_likelihood - self.start_log_likelihood
        return f"<netkf noise of {self.name!r}: {values}; log-likelihood +{gain:.4g}>"


@np.errstate(under="ignore")
def log_likelihood(scenario: Scenario, seed: int | None = None, replica: int = 0) -> float:
    """Return the log-likelihood of the readings of a ``replica`` after time 0, all sensors
    together, under the linear model that the filters believe, whatever the filter and the network:
    the log density of the innovations of the central Kalman filter.

    Raises ScenarioError for a model that is not linear, or that changes, for increments, and for
    readings whose noise rounding hides.
    """
    require_scenario(scenario, "log_likelihood")
    model = _central_model(scenario, seed, replica)
    return model.value(np.ones(len(model.variances)))


def _central_model(scenario: Scenario, seed: int | None, replica: int) -> CentralModel:
    seed = scenario.seed if seed is None else integer(low=0)("seed", seed)
    replica = integer(low=0)("replica", replica)
    with explain_failures(scenario):
        return CentralModel(scenario, seed, replica)


@np.errstate(under="ignore")
def fit_noise(
    scenario: Scenario, seed: int | None = None, replica: int = 0, confidence: float = 0.95
) -> NoiseFit:
    """Fit the noise of plant and sensors to the readings of a ``replica`` by the largest
    ``log_likelihood``: the variance of each column of B (in slots of each entry of a diagonal Q,
    else the size of Q), which for a random walk is its rate, and that of each component of the R of
    each ``[[sensors]]`` entry (or the size of an R that is not diagonal). What is 0 stays 0.

    ``confidence`` is that of the interval of each variance. Raises ScenarioError, see
    ``log_likelihood``.
    """
    require_scenario(scenario, "fit_noise")
    confidence = number(above=0.0, below=1.0)("confidence", confidence)
    model = _central_model(scenario, seed, replica)
    if not model.variances:
        raise ScenarioError("plant", "has no noise to fit, nor have sensors", None, "give Q or R")
    plant = sum(v.Q is not None for v in model.variances)
    count = len(model.variances)
    is_plant = np.arange(count) < plant
    # The best of a few mixtures, from which to climb.
    shifts = [np.where(is_plant, one, other) for one, other in itertools.product(STARTS, STARTS)]
    best = _climb(model.value, max(shifts, key=lambda theta: model.value(np.exp(theta))))
    leaps = np.kron(np.eye(count), np.transpose([LEAPS]))
    for _ in range(MAX_CLIMBS):
        # A variance that is far too small does not slope.
        leap = max(best + leaps, key=lambda theta: model.value(np.exp(theta)))
        if model.value(np.exp(leap)) <= model.value(np.exp(best)) + NEGLIGIBLE:
            break
        best = _climb(model.value, leap)
    factors, free = np.exp(best), np.ones(count, dtype=bool)
    top, zero = model.value(factors), list[str]()
    for k, one in enumerate(model.variances):
        others = np.arange(count) != k
        without, more = (np.where(others, factors, f) for f in (0.0, 100.0 * max(factors[k], 1.0)))
        free[k] = model.value(without) < top - NEGLIGIBLE
        if not free[k] and model.value(more) >= top - NEGLIGIBLE:
            factors[k] = 1.0  # readings say nothing of it
        elif not free[k]:
            zero.append(one.name)
            # Filters need some noise of every reading.
            factors = without if k < plant else factors
    deviations = _deviations(model.value, factors, free)
    return _make_fit(scenario, model, factors, deviations, zero, confidence)


def _climb(value: Callable[[FloatArray], float], start: FloatArray) -> FloatArray:
    """Return logarithms (J,) of factors at a maximum of ``value``, from ``start`` (J,)."""

    def loss(theta: Any) -> float:
        return -max(value(np.exp(theta)), -1e300)

    theta, gradient = start, partial(_gradient, loss)
    for _ in range(int(RANGE / STRIDE)):
        # A longer step can end where rounding leaves no likelihood, and a search ends with it.
        bounds, last = [(one - STRIDE, one + STRIDE) for one in theta], theta
        theta = minimize(loss, last, jac=gradient, method="L-BFGS-B", bounds=bounds).x
        if np.abs(theta - last).max() < 0.5 * STRIDE:
            break
    for _ in range(5):
        slope, curvature = gradient(theta), _hessian(loss, theta)
        # A variance of 0 has no curvature.
        moving = np.abs(np.diag(curvature)) > 1e-6
        step = np.zeros_like(theta)
        block = curvature[np.ix_(moving, moving)]
        if not moving.any() or np.linalg.eigvalsh(block).min() <= 0.0:
            break
        step[moving] = np.linalg.solve(block, slope[moving])
        if not loss(theta - step) <= loss(theta):
            break
        theta = theta - step
    return np.asarray(theta)


def _gradient(loss: Callable[[FloatArray], float], theta: Any) -> FloatArray:
    step = 1e-5
    shifts = step * np.eye(len(theta))
    return np.array([(loss(theta + s) - loss(theta - s)) / (2.0 * step) for s in shifts])


def _hessian(loss: Callable[[FloatArray], float], theta: FloatArray) -> FloatArray:
    step, shifts = 1e-3, 1e-3 * np.eye(len(theta))
    rows = [
        (_gradient(loss, theta + s) - _gradient(loss, theta - s)) / (2.0 * step) for s in shifts
    ]
    return 0.5 * (np.array(rows) + np.array(rows).T)


def _deviations(
    value: Callable[[FloatArray], float], factors: FloatArray, free: np.ndarray
) -> FloatArray:
    """Return standard errors (J,) of logarithms of ``free`` factors, nan if readings are silent."""

    def loss(theta: FloatArray) -> float:
        whole = factors.copy()
        whole[free] = np.exp(theta)
        return -value(whole)

    deviations = np.full(len(factors), math.nan)
    if free.any():
        values, vectors = np.linalg.eigh(_hessian(loss, np.log(factors[free])))
        # Less curvature than that is rounding.
        deviations[free] = np.sqrt((vectors**2 / np.maximum(values, UNKNOWN**-4)).sum(axis=1))
        deviations[deviations > UNKNOWN] = math.nan
    return deviations


def _make_fit(
    scenario: Scenario,
    model: CentralModel,
    factors: FloatArray,
    deviations: FloatArray,
    zero: list[str],
    confidence: float,
) -> NoiseFit:
    import pandas as pd

    reach = float(ndtri(0.5 + 0.5 * confidence)) * deviations
    starts = np.array([v.value for v in model.variances])
    values = starts * factors
    table = pd.DataFrame(
        {
            "name": [v.name for v in model.variances],
            "start": starts,
            "value": values,
            "se": values * deviations,
            "low": values * np.exp(-reach),
            "high": values * np.exp(reach),
        }
    )
    changes = _changes(scenario, model.variances, factors)
    pairs = zip(table["name"], np.isnan(deviations), strict=True)
    unknown = [name for name, is_unknown in pairs if is_unknown and name not in zero]
    said = {
        "as far as these readings tell, 0": zero,
        "these readings do not tell, by itself or apart from others": unknown,
    }
    notes = [f"{words}: {', '.join(names)}" for words, names in said.items() if names]
    try:
        scenario.replace(changes)
    except ScenarioError as error:
        notes.append(f"the scenario cannot run with the values: {error}")
    return NoiseFit(
        scenario.name,
        table,
        model.value(factors),
        model.value(np.ones(len(factors))),
        len(model.y),
        confidence,
        changes,
        scenario,
        tuple(notes),
    )


def _changes(
    scenario: Scenario, variances: tuple[Variance, ...], factors: FloatArray
) -> dict[str, Any]:
    """Return the keys of the scenario, with variances times ``factors`` (J,)."""
    noise = np.array(believed_noise(scenario))
    given: Any = scenario.filter.model.R
    R = [
        np.array(given[k] if isinstance(given, tuple) else sensor.R if given is None else given)
        for k, sensor in enumerate(scenario.declared_sensors)
    ]
    for one, factor in zip(variances, factors.tolist(), strict=True):
        if one.Q is None:
            R[one.entry][np.ix_(one.rows, one.rows)] *= factor
        elif scenario.slotted:
            noise += (factor - 1.0) * one.Q
        else:
            noise[:, one.columns] *= math.sqrt(factor)
    noise += 0.0  # no -0.0
    changes = {f"filter.model.{'Q' if scenario.slotted else 'B'}": noise.tolist()}
    entries = sorted({one.entry for one in variances if one.Q is None})
    # Of recorded readings R is what filters believe anyway.
    if given is None and not any(scenario.declared_sensors[k].is_random for k in entries):
        return changes | {f"sensors.{k}.R": R[k].tolist() for k in entries}
    return changes | {"filter.model.R": [matrix.tolist() for matrix in R]}
