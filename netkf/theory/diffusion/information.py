"""The cooperative information condition of D: how much the regressors to come will excite.

Given the states s of the regressors at the start of a window, phi is Gaussian in each of its slots,
and ``E[phi phi' / (1 + |phi|^2)]`` is one integral over u > 0 of the Gaussian moments of
``phi phi' exp(-u |phi|^2)`` times exp(-u). In log u the trapezoidal rule gives it to rounding, so
that only the pasts are sampled.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.optimize

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, square_root, symmetric
from netkf.plants.regressors import RegressorSensor
from netkf.plants.sensors import LinearSensor
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.numerics.matrices import as_whole

if TYPE_CHECKING:
    import pandas as pd

_STEP = 0.25
_U = np.exp(np.arange(-40.0, 4.0, _STEP))
_WEIGHTS = _STEP * _U * np.exp(-_U)
NOTHING = 1e-12  # an eigenvalue that small, relative to the trace, is 0
MAX_SEARCHED = 30  # numbers in a past that the search for the worst one can handle
MAX_TRIES = 300
QUANTILE = 2.576
MAX_REGRESSORS = 500  # sensors whose H varies
TOGETHER = 20  # sensors of one kind whose pasts are looked at in one array
ACCURACY = 1e-9
"""Relative error of the integral, with room to spare."""


def information_level(
    scenario: Scenario, runs: int = 400, seed: int = 0, window: int | None = None
) -> pd.DataFrame:
    """The conditional least eigenvalue lambda_k of D (19), and of D (5) for each sensor alone.

    A row for the network (node -1) and for each sensor, with the columns

    window           h in slots; by default the shortest of up to 2 n for which the network's level
                     is positive, else 2 n
    level, low, high the least lambda_k over the past, on which it depends through the regressors'
                     states: over ``runs`` pasts from their law at random slots of the horizon, the
                     one in which all states are 0, and what a search within the range of these
                     found; the interval is that of the integral at that past. D (19) holds where
                     it is positive
    mean, mean_low, mean_high   lambda_k in the mean over the pasts drawn, with its 99 % interval

    As printed, h terms are divided by h + 1. Raises TheoryError for sensors that are records.
    """
    import pandas as pd

    runs, seed = as_whole("runs", runs, 2), as_whole("seed", seed, 0)
    window = None if window is None else as_whole("window", window, 1)
    sources = _sources(scenario)
    past = _pasts(scenario, sources, runs, Streams(seed).generator("past"))
    whole = (-1, sources, past)
    if window is None:
        longest = 2 * scenario.plant.n
        window = next((h for h in range(1, longest) if _row(*whole, h)[2] > 0.0), longest)
    rows = [_row(*whole, window)]
    rows += _each_alone(sources, past, window)
    names = ["node", "window", "level", "low", "high", "mean", "mean_low", "mean_high"]
    return pd.DataFrame(rows, columns=names)


Row = tuple[int, int, float, float, float, float, float, float]
"""node, window, level, low, high, mean, mean_low, mean_high."""


class _Source(NamedTuple):
    """One scalar reading: the node and phi = C s with s <- A s + noise of covariance ``drive``."""

    node: int
    A: FloatArray
    C: FloatArray
    start: FloatArray
    drive: FloatArray


def few_regressors(scenario: Scenario) -> bool:
    """Whether the levels take seconds: pasts are drawn for each sensor whose H varies."""
    varying = [k for k, sensor in enumerate(scenario.sensors) if sensor.varying]
    placed = itertools.chain.from_iterable(scenario.placed.values())
    return sum(place.entry in varying for place in placed) <= MAX_REGRESSORS


def _sources(scenario: Scenario) -> list[_Source]:
    found = []
    for node in scenario.sensing:
        for place in scenario.placed[node]:
            sensor = scenario.sensors[place.entry]
            if isinstance(sensor, RegressorSensor):
                drive = sensor.B @ sensor.xi_cov @ sensor.B.T
                found.append(_Source(node, sensor.A, sensor.C, sensor.start, drive))
            elif isinstance(sensor, LinearSensor):
                still = (np.ones(1), np.zeros((0, 0)))
                found += [_Source(node, np.eye(1), row[:, None], *still) for row in sensor.H]
            else:
                raise TheoryError(f"the sensor of node {node} is a record, which has no law")
    if not found:
        raise TheoryError("no node has a sensor")
    return found


def _pasts(
    scenario: Scenario, sources: list[_Source], runs: int, random: np.random.Generator
) -> list[FloatArray]:
    """For each source (runs, m) states at random slots, the same slots for all."""
    last = max(1, int(scenario.horizon / scenario.slot_plant.period))
    slots = random.integers(last, size=runs)
    return [_law(source, slots, random) for source in sources]


def _law(source: _Source, slots: np.ndarray, random: np.random.Generator) -> FloatArray:
    drawn = random.standard_normal((len(slots), len(source.start)))
    if not source.drive.size:
        return np.ones((len(slots), 1))
    states, mean, cov = np.empty_like(drawn), source.start, np.zeros_like(source.A)
    for slot in range(int(slots.max()) + 1):
        here = slots == slot
        if here.any():
            states[here] = mean + drawn[here] @ square_root(cov).T
        mean, cov = source.A @ mean, source.A @ cov @ source.A.T + source.drive
    return states


def _each_alone(sources: list[_Source], past: list[FloatArray], window: int) -> list[Row]:
    """A row for each sensor; fixed sensors of one kind share theirs."""
    rows: list[Row | None] = [None] * len(sources)
    for group in _alike(sources):
        for k in group:
            same = rows[group[0]] if not sources[k].drive.size else None
            found = same or _row(sources[k].node, [sources[k]], [past[k]], window)
            rows[k] = (sources[k].node, *found[1:])
    return [row for row in rows if row is not None]


def _row(node: int, sources: list[_Source], past: list[FloatArray], window: int) -> Row:
    values = _levels(sources, past, window)
    mean = float(values.mean())
    error = QUANTILE * float(values.std(ddof=1)) / np.sqrt(len(values))
    level = _least(sources, past, values, window)
    interval = level * (1.0 - ACCURACY), level * (1.0 + ACCURACY)
    return node, window, level, *interval, mean, mean - error, mean + error


def _least(
    sources: list[_Source], past: list[FloatArray], values: FloatArray, window: int
) -> float:
    best = int(np.argmin(values))
    starts = [[p[best] for p in past], [np.zeros_like(s.start) for s in sources]]
    for k, source in enumerate(sources):
        if not source.drive.size:  # what is fixed is no past
            starts[1][k] = source.start
    moving = [k for k, source in enumerate(sources) if source.drive.size]
    found = [float(values[best])]
    low = [np.minimum(past[k].min(axis=0), 0.0) for k in moving]
    high = [np.maximum(past[k].max(axis=0), 0.0) for k in moving]
    bounds = list(zip(np.concatenate([[], *low]), np.concatenate([[], *high]), strict=True))
    sizes = np.cumsum([0, *(len(sources[k].start) for k in moving)])
    for start in starts:

        def level(x: FloatArray, start: list[FloatArray] = start) -> float:
            states = [s[None] for s in start]
            for place, k in enumerate(moving):
                states[k] = x[None, sizes[place] : sizes[place + 1]]
            return float(_levels(sources, states, window)[0])

        x = np.concatenate([np.zeros(0), *(start[k] for k in moving)])
        found.append(level(x))
        if 0 < len(x) <= MAX_SEARCHED and found[-1] > 0.0:
            search = scipy.optimize.minimize(
                level, x, method="Nelder-Mead", bounds=bounds, options={"maxfev": MAX_TRIES}
            )
            found.append(float(search.fun))
    return min(found)


def _levels(sources: list[_Source], past: list[FloatArray], window: int) -> FloatArray:
    """lambda_k (k,) for each of k pasts."""
    n = len(sources[0].C)
    total = np.zeros((len(past[0]), n, n))
    for group in _alike(sources):
        source, fixed = sources[group[0]], not sources[group[0]].drive.size
        for start in range(0, 1 if fixed else len(group), TOGETHER):
            # Fixed sensors of one kind have one past, which counts as often as there are sensors.
            some = group[:1] if fixed else group[start : start + TOGETHER]
            states = np.concatenate([past[k][:1] if fixed else past[k] for k in some])
            found = _excited(source, states, window).reshape(len(some), -1, n, n)
            total = total + found.sum(axis=0) * (len(group) if fixed else 1)
    values = np.linalg.eigvalsh(symmetric(total))
    least = values[:, 0] / (len(sources) * (window + 1))
    return np.where(values[:, 0] > NOTHING * values.sum(axis=1), least, 0.0)


def _alike(sources: list[_Source]) -> list[list[int]]:
    """Places of the sources of each kind; sources of one kind differ in their pasts only."""
    groups: dict[tuple[bytes, ...], list[int]] = {}
    for k, source in enumerate(sources):
        key = tuple(part.tobytes() for part in (source.A, source.C, source.drive))
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def _excited(source: _Source, states: FloatArray, window: int) -> FloatArray:
    """(k, n, n): the sum of the normalised outer products over a window, for each of k pasts."""
    mean, cov, n = states, np.zeros_like(source.A), len(source.C)
    total = np.zeros((len(states), n, n))
    for _ in range(window):
        mean = mean @ source.A.T
        cov = source.A @ cov @ source.A.T + (source.drive if source.drive.size else 0.0)
        total = total + normalised_outer(mean @ source.C.T, source.C @ cov @ source.C.T)
    return total


def normalised_outer(mean: FloatArray, cov: FloatArray) -> FloatArray:
    """(k, n, n): ``E[phi phi' / (1 + |phi|^2)]`` for phi Gaussian with k means (k, n) and one
    covariance (n, n).
    """
    spread, axes = np.linalg.eigh(cov)
    spread = np.maximum(spread, 0.0)
    m = mean @ axes
    D = 1.0 + 2.0 * _U[:, None] * spread
    decay = np.exp(-_U * np.einsum("ka,ua->ku", m * m, 1.0 / D))
    weights = _WEIGHTS / np.sqrt(D.prod(axis=1)) * decay
    shrunk = np.einsum("ku,ua,ub->kab", weights, 1.0 / D, 1.0 / D) * m[:, :, None] * m[:, None, :]
    places = np.arange(len(cov))
    shrunk[:, places, places] += np.einsum("ku,ua->ka", weights, spread / D)
    return np.asarray(axes @ shrunk @ axes.T)
