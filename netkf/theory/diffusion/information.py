"""The cooperative information condition of D, and the level of noise in its Theorem 4.2.

Given the states s of the regressors at the start of a window, phi is Gaussian in each of its slots,
and ``E[phi phi' / (1 + |phi|^2)]`` is one integral over u > 0 of the Gaussian moments of
``phi phi' exp(-u |phi|^2)`` times exp(-u). In log u the trapezoidal rule computes it to rounding
errors, so that only the pasts are sampled.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root, symmetric
from netkf.plants.regressors import RegressorSensor
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import require_every_reading
from netkf.theory.numerics.matrices import as_integer, as_number

if TYPE_CHECKING:
    import pandas as pd

OVERFLOW = 1e100  # of means and covariances of regressors
STEP, LOWER, UPPER = 0.25, -40.0, 4.0
"""Trapezoidal rule in log u for the integral of f(u) exp(-u) over u > 0. Outside of these limits
lies less than rounding: u exp(-u) is 4e-18 at the lower one and 1e-17 at the upper one. Where
|phi| is large f falls from u = 1 / |phi|^2 on, and the lower one is so much lower.
"""
EIGENVALUE_TOLERANCE = 1e-12  # relative to the trace; smaller eigenvalues count as 0
MAX_SEARCHED = 30  # entries of a past up to which the worst one is searched for
MAX_EVALUATIONS = 300  # of the level, by one search from one start
QUANTILE = 2.576  # of the standard normal law, for 99 % intervals
MAX_REGRESSORS = 500  # sensors whose H varies
MAX_STACKED = 20  # sensors of one kind whose pasts are evaluated in one array
INTEGRAL_TOLERANCE = 1e-9  # safe bound on the relative error of the integral


def information_level(
    scenario: Scenario, runs: int = 400, seed: int = 0, window: int | None = None
) -> pd.DataFrame:
    """Return the conditional least eigenvalue lambda_k of paper D (19), and of paper D (5) for each
    sensor.

    A table with a row for the network (node -1) and for each sensor, and the columns

    window           h in slots; by default the shortest of up to 2 n for which the network's level
                     is positive, else 2 n
    level, low, high the least lambda_k over pasts, that is over states of the regressors:
                     ``runs`` pasts drawn from their law at random slots of the horizon, the one in
                     which all states are 0, and the result of a search within the range of these;
                     the interval is that of the integral at that past. Paper D (19) holds if it is
                     positive
    mean, mean_low, mean_high   mean of lambda_k over the pasts drawn, with its 99 % interval

    As printed in D, h terms are divided by h + 1. Raises TheoryError for recorded sensors, and for
    nodes that are down at times.
    """
    import pandas as pd

    require_every_reading(scenario)
    runs, seed = as_integer("runs", runs, 2), as_integer("seed", seed, 0, np.inf)
    window = None if window is None else as_integer("window", window, 1)
    sources = _make_sources(scenario)
    # States of each source (runs, m) at random slots, the same for all.
    random, last = Streams(seed).generator("past"), scenario.horizon / scenario.slot_plant.period
    slots = random.integers(max(1, int(last)), size=runs)
    past = [_draw_states(source, slots, random) for source in sources]
    network = (-1, sources, past)
    if window is None:
        longest = 2 * scenario.plant.n
        window = next((h for h in range(1, longest) if _make_row(*network, h)[2] > 0.0), longest)
    # Each sensor alone; fixed regressors of one kind share the numbers of the first.
    alone: dict[int, LevelRow] = {}
    for group in _group_by_kind(sources):
        for k in group:
            shared_row = alone.get(group[0]) if not sources[k].drive.size else None
            sensor_row = shared_row or _make_row(sources[k].node, [sources[k]], [past[k]], window)
            alone[k] = (sources[k].node, *sensor_row[1:])
    rows = [_make_row(*network, window), *(alone[k] for k in range(len(sources)))]
    names = ["node", "window", "level", "low", "high", "mean", "mean_low", "mean_high"]
    return pd.DataFrame(rows, columns=names)


LevelRow = tuple[int, int, float, float, float, float, float, float]
"""node, window, level, low, high, mean, mean_low, mean_high."""


class _Source(NamedTuple):
    """A scalar reading of a node: phi = C s with s <- A s + noise of covariance ``drive``.

    A (m, m), C (n, m), start (m,) and drive (m, m), which is empty for a fixed regressor.
    """

    node: int
    A: FloatArray
    C: FloatArray
    start: FloatArray
    drive: FloatArray


def few_regressors(scenario: Scenario) -> bool:
    """Return True if the levels take seconds: pasts are drawn for each sensor whose H varies."""
    varying = [k for k, sensor in enumerate(scenario.sensors) if sensor.varying]
    placed = itertools.chain.from_iterable(scenario.placed_sensors.values())
    return sum(placed_sensor.entry in varying for placed_sensor in placed) <= MAX_REGRESSORS


def _make_sources(scenario: Scenario) -> list[_Source]:
    """Return the scalar readings of all nodes; raises TheoryError for recorded sensors."""
    sources = []
    for node in scenario.sensing_nodes:
        for placed_sensor in scenario.placed_sensors[node]:
            sensor = scenario.sensors[placed_sensor.entry]
            if isinstance(sensor, RegressorSensor):
                drive = sensor.B @ sensor.xi_cov @ sensor.B.T
                sources.append(_Source(node, sensor.A, sensor.C, sensor.start, drive))
            elif sensor.is_random and not sensor.varying:
                # A fixed row H is a regressor with the constant state 1 and no noise.
                fixed, H = (np.ones(1), np.zeros((0, 0))), sensor.matrix_of(scenario.plant.n)
                sources += [_Source(node, np.eye(1), row[:, None], *fixed) for row in H]
            else:
                what = "is a record" if sensor.record is not None else "has an H that varies"
                raise TheoryError(f"the sensor of node {node} {what}, which has no law")
    if not sources:
        raise TheoryError("no node has a sensor")
    return sources


def _draw_states(source: _Source, slots: np.ndarray, random: np.random.Generator) -> FloatArray:
    """Return states (K, m) of a ``source`` at ``slots`` (K,) from its law; 1 if fixed."""
    normals = random.standard_normal((len(slots), len(source.start)))
    if not source.drive.size:
        return np.ones((len(slots), 1))
    states, mean, cov = np.empty_like(normals), source.start, np.zeros_like(source.A)
    for slot in range(int(slots.max()) + 1):
        chosen = slots == slot
        if not np.isfinite(cov).all():
            raise TheoryError(f"the state of a regressor sensor overflows up to slot {slot}")
        if chosen.any():
            states[chosen] = mean + normals[chosen] @ square_root(cov).T
        with np.errstate(over="ignore", invalid="ignore"):
            mean, cov = source.A @ mean, source.A @ cov @ source.A.T + source.drive
    return states


def _make_row(node: int, sources: list[_Source], past: list[FloatArray], window: int) -> LevelRow:
    values = _levels(sources, past, window)
    mean = float(values.mean())
    error = QUANTILE * float(values.std(ddof=1)) / np.sqrt(len(values))
    level = _search_least(sources, past, values, window)
    interval = level * (1.0 - INTEGRAL_TOLERANCE), level * (1.0 + INTEGRAL_TOLERANCE)
    return node, window, level, *interval, mean, mean - error, mean + error


def _search_least(
    sources: list[_Source], past: list[FloatArray], values: FloatArray, window: int
) -> float:
    """Return the least level lambda_k found: by drawing, at states 0, and by a search from both."""
    # The least level may be attained far from all pasts drawn.
    lowest = int(np.argmin(values))
    # A fixed regressor has no state that could differ.
    resting = [np.zeros_like(s.start) if s.drive.size else s.start for s in sources]
    levels = [float(values[lowest])]
    for start in ([p[lowest] for p in past], resting):
        levels += _search(sources, past, start, window)
    return min(levels)


def _search(
    sources: list[_Source], past: list[FloatArray], start: list[FloatArray], window: int
) -> list[float]:
    """Return the level at the past ``start`` and the least one from it by Nelder and Mead."""
    moving = [k for k, source in enumerate(sources) if source.drive.size]
    low = [np.minimum(past[k].min(axis=0), 0.0) for k in moving]
    high = [np.maximum(past[k].max(axis=0), 0.0) for k in moving]
    bounds = list(zip(np.concatenate([[], *low]), np.concatenate([[], *high]), strict=True))
    ends = np.cumsum([0, *(len(sources[k].start) for k in moving)])

    def level(x: FloatArray) -> float:
        """Return the level at the past ``x``, the states of all varying sources side by side."""
        # _levels takes many pasts at once: here it is one.
        states = [s[None] for s in start]
        for index, k in enumerate(moving):
            states[k] = x[None, ends[index] : ends[index + 1]]
        return float(_levels(sources, states, window)[0])

    x = np.concatenate([np.zeros(0), *(start[k] for k in moving)])
    levels = [level(x)]
    if 0 < len(x) <= MAX_SEARCHED and levels[0] > 0.0:
        # It takes 0.3 s to import.
        import scipy.optimize

        search = scipy.optimize.minimize(
            level, x, method="Nelder-Mead", bounds=bounds, options={"maxfev": MAX_EVALUATIONS}
        )
        levels.append(float(search.fun))
    return levels


def _levels(sources: list[_Source], past: list[FloatArray], window: int) -> FloatArray:
    """Return the levels lambda_k (K,), D (19), for K pasts; 0 below rounding."""
    n = len(sources[0].C)
    total = np.zeros((len(past[0]), n, n))
    for group in _group_by_kind(sources):
        source, fixed = sources[group[0]], not sources[group[0]].drive.size
        for start in range(0, 1 if fixed else len(group), MAX_STACKED):
            # Fixed sensors of one kind have one past, which counts as often as there are sensors.
            stacked = group[:1] if fixed else group[start : start + MAX_STACKED]
            states = np.concatenate([past[k][:1] if fixed else past[k] for k in stacked])
            excitation = _window_excitation(source, states, window).reshape(len(stacked), -1, n, n)
            total = total + excitation.sum(axis=0) * (len(group) if fixed else 1)
    values = np.linalg.eigvalsh(symmetric(total))
    # D (19): the mean over sensors, and h terms over h + 1.
    smallest = values[:, 0] / (len(sources) * (window + 1))
    return np.where(values[:, 0] > EIGENVALUE_TOLERANCE * values.sum(axis=1), smallest, 0.0)


def _group_by_kind(sources: list[_Source]) -> list[list[int]]:
    groups: dict[tuple[bytes, ...], list[int]] = {}
    for k, source in enumerate(sources):
        key = tuple(part.tobytes() for part in (source.A, source.C, source.drive))
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def _window_excitation(source: _Source, states: FloatArray, window: int) -> FloatArray:
    """Return sums (K, n, n) of ``E[phi phi' / (1 + |phi|^2)]`` over the ``window``."""
    mean, cov, n = states, np.zeros_like(source.A), len(source.C)
    total = np.zeros((len(states), n, n))
    for _ in range(window):  # mean and covariance of s in each slot
        with np.errstate(over="ignore", invalid="ignore"):
            mean = mean @ source.A.T
            cov = source.A @ cov @ source.A.T + (source.drive if source.drive.size else 0.0)
        if not max(np.abs(mean).max(initial=0.0), np.abs(cov).max(initial=0.0)) < OVERFLOW:
            raise TheoryError("regressors grow beyond the range of numbers")
        total = total + normalised_outer(mean @ source.C.T, source.C @ cov @ source.C.T)
    return total


def normalised_outer(mean: FloatArray, cov: FloatArray) -> FloatArray:
    """Return ``E[phi phi' / (1 + |phi|^2)]`` (K, n, n), phi of ``mean`` (K, n) and ``cov``."""
    spread, axes = np.linalg.eigh(cov)
    spread = np.maximum(spread, 0.0)
    # In the axes of the covariance the entries of phi are independent.
    m = mean @ axes
    size = np.log1p((m * m).sum(axis=1).max(initial=0.0) + spread.sum())
    u = np.exp(np.arange(LOWER - np.ceil(size), UPPER, STEP))
    # In the axes of cov, exp(-u |phi|^2) divides means and variances by D.
    D = 1.0 + 2.0 * u[:, None] * spread
    decay = np.exp(-u * np.einsum("ka,ua->ku", m * m, 1.0 / D))
    weights = STEP * u * np.exp(-u) / np.sqrt(D.prod(axis=1)) * decay
    shrunk = np.einsum("ku,ua,ub->kab", weights, 1.0 / D, 1.0 / D) * m[:, :, None] * m[:, None, :]
    indices = np.arange(len(cov))
    shrunk[:, indices, indices] += np.einsum("ku,ua->ka", weights, spread / D)
    return np.asarray(axes @ shrunk @ axes.T)


class TrackingLevel(NamedTuple):
    """The level of noise in paper D Theorem 4.2.

    sigma, low, high : sigma_p of paper D (29), with its 99 % interval
    shape            : ``sigma_p log^(1 + beta/2)(e + 1 / sigma_p)``, the bound on
                       limsup |error|_Lp without its constant c, which D does not give
    """

    sigma: float
    low: float
    high: float
    shape: float


def tracking_level(
    scenario: Scenario, p: float = 2.0, beta: float = 2.5, samples: int = 100_000, seed: int = 0
) -> TrackingLevel:
    """Return the level of noise sigma_p, D (29) of the diffusion paper, for the true noises of a
    scenario, and the shape of the bound on tracking errors that it gives.

    ``xi_k = |V_k| + |Delta_{k+1}|`` with the noises of all sensors and the parameter's increment,
    once for each node, and ``sigma_p = | xi log^beta(e + xi) |_Lp``. Gaussian noises have all
    moments, so that paper D Theorem 4.2 holds for every p >= 1 and beta > 2 if its other
    assumptions do: the errors stay bounded in L_p, and go to 0 with the noises (D Remark 4.1). From
    ``samples`` draws. Raises TheoryError for plants and sensors without a law and wrong arguments.
    """
    p, beta = as_number("p", p), as_number("beta", beta)
    if not p >= 1.0 or not beta > 2.0:
        raise TheoryError(f"D (29) needs p >= 1 and beta > 2, got {p!r} and {beta!r}")
    samples, seed = as_integer("samples", samples, 100), as_integer("seed", seed, 0, np.inf)
    xi = _draw_noises(scenario, samples, Streams(seed).generator("noises"))
    with np.errstate(over="ignore"):
        values = xi * np.log(math.e + xi) ** beta
    largest = float(values.max()) or 1.0
    if not math.isfinite(largest):
        raise TheoryError(f"xi log^beta(e + xi) of D (29) is beyond floating point for {beta!r}")
    powers = (values / largest) ** p  # of numbers up to 1, which do not overflow
    mean, error = float(powers.mean()), QUANTILE * float(powers.std(ddof=1)) / math.sqrt(samples)
    low, high = (largest * end ** (1.0 / p) for end in (max(mean - error, 0.0), mean + error))
    sigma = largest * mean ** (1.0 / p)
    shape = sigma * math.log(math.e + 1.0 / sigma) ** (1.0 + beta / 2.0) if sigma > 0.0 else 0.0
    return TrackingLevel(sigma, low, high, shape)


def _draw_noises(scenario: Scenario, samples: int, random: np.random.Generator) -> FloatArray:
    """Return draws (samples,) of xi, D (29); raises TheoryError if a noise is recorded."""
    if not scenario.slotted or not scenario.is_random:
        raise TheoryError("D (29) needs noises in slots with a law, not a record")
    squares = np.zeros(samples)
    for node in scenario.sensing_nodes:
        for placed_sensor in scenario.placed_sensors[node]:
            root = square_root(scenario.noise_covariance(placed_sensor.entry, believed=False))
            squares += ((random.standard_normal((samples, len(root))) @ root.T) ** 2).sum(axis=1)
    root = square_root(scenario.slot_plant.Q)
    increment = random.standard_normal((samples, len(root))) @ root.T
    # Delta stacks one copy of the increment for each node, D III-A.
    increment_norm = math.sqrt(len(scenario.nodes)) * np.linalg.norm(increment, axis=1)
    return np.asarray(np.sqrt(squares) + increment_norm)
