"""Prediction in continuous time of a state that need not be linear, dx = f(x, u(t), t) dt + dw.

The mean m, its transition Phi and the covariance W that noise adds are integrated by the classical
Runge-Kutta method in steps of at most ``step``, which end where the input or Q jumps::

    m' = f(m, u, t),    Phi' = J Phi,    W' = J W + W J' + Q,    J the Jacobian of f at m.

An extended Kalman filter has P <- Phi P Phi' + W after each step. Sigma points (``maps``) are
integrated one by one, and W is added to the covariance of the moved points.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.algorithms.kernels.maps import set_point, settle_root, weigh_points, write_root
from netkf.algorithms.kernels.run import (
    SlotRun,
    carry,
    carry_mean,
    predict_estimate,
    transition,
    update_estimate,
    update_in_slot,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import call_function
from netkf.linalg.small import count_until
from netkf.linalg.structs import Struct

DIFFERENCE = 1e-5
"""Steps of differences, as shares of states above 1: errors of rounding and of curvature are alike.
"""
STAGES = 4


class RateTables(Struct):
    """The dynamics that all nodes believe, for one run.

    f, jacobian : addresses (``linalg.functions``) of the rate of change and its Jacobian
    step : the longest step of the integration in seconds
    distance, weight, center : ``maps.Spread``
    times, values : (J,) and (J, m), the input is ``values[j]`` from ``times[j]`` on, 0 before
    sine : (3, m), amplitudes, rad/s and radians of the components that are sines, nan of others
    Q : (P, n, n), covariances of w over a second, of which the next one holds from each of the
        ``changes`` (P - 1,) on, in seconds, and the number ``piece`` of the present one
    u, slope, J, state, stage, rates, points, work, mean, root : scratch, (m,), (n,), (n, n),
        (n + 2 n n,) twice, (4, n + 2 n n), (2 n + 1, n), (n, 3 n + 1), (1, n, 1) and (1, n, n, 1);
        estimates may have room for more states than these n
    """

    f: int
    jacobian: int
    step: float
    distance: float
    weight: float
    center: float
    times: FloatArray
    values: FloatArray
    sine: FloatArray
    Q: FloatArray
    changes: FloatArray
    piece: int
    u: FloatArray
    slope: FloatArray
    J: FloatArray
    state: FloatArray
    stage: FloatArray
    rates: FloatArray
    points: FloatArray
    work: FloatArray
    mean: FloatArray
    root: FloatArray


class RateRun(Struct):
    """The surroundings of a node of one run under clocks whose model is a RateTables: a SlotRun."""

    __annotations__ = SlotRun.__annotations__


@kernel
def _rate_of(
    model: RateTables, n: int, size: int, time: float, middle: float, state: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Write the rates of the first ``size`` numbers of ``state`` = (m, Phi, W) into ``out``."""
    last = count_until(model.times, middle) - 1
    for k in range(len(model.u)):
        model.u[k] = model.values[last, k] if last >= 0 else 0.0
        if last >= 0 and not math.isnan(model.sine[0, k]):
            angle = model.sine[1, k] * time + model.sine[2, k]
            model.u[k] = model.sine[0, k] * math.sin(angle)
    call_function(model.f, state[:n], model.u, time, 0.0, model.slope)
    for i in range(n):
        out[i] = model.slope[i]
    if size == n:
        return
    call_function(model.jacobian, state[:n], model.u, time, 0.0, model.J)
    J, second = model.J, n + n * n
    for i in range(n):
        for j in range(n):
            moved, driven = 0.0, model.Q[model.piece, i, j]
            for m in range(n):
                moved += J[i, m] * state[n + m * n + j]
                driven += J[i, m] * state[second + m * n + j] + J[j, m] * state[second + i * n + m]
            out[n + i * n + j], out[second + i * n + j] = moved, driven


@kernel
def _step(model: RateTables, n: int, size: int, time: float, length: float) -> None:
    """Integrate the first ``size`` numbers of ``model.state`` over ``length`` seconds."""
    state, stage, rates, middle = model.state, model.stage, model.rates, time + 0.5 * length
    for s in range(STAGES):
        share = 0.0 if s == 0 else (1.0 if s == STAGES - 1 else 0.5)
        for i in range(size):
            before = rates[s - 1, i] if s > 0 else 0.0
            stage[i] = state[i] + share * length * before
        _rate_of(model, n, size, time + share * length, middle, stage, rates[s])
    for i in range(size):
        total = rates[0, i] + 2.0 * (rates[1, i] + rates[2, i]) + rates[3, i]
        state[i] += length / 6.0 * total


@kernel
def move_by_rate(
    model: RateTables, x: FloatArray, root: FloatArray, k: int, end: float, gap: float
) -> None:
    """Predict ``x[k]`` (n, 1) and ``root[k]`` (n, n, 1) over ``gap`` seconds, up to ``end``."""
    time, n = end - gap, len(model.slope)
    while time < end:
        stop, later = end, count_until(model.times, time)
        if later < len(model.times) and model.times[later] < stop:
            stop = model.times[later]
        model.piece = count_until(model.changes, time)
        if model.piece < len(model.changes) and model.changes[model.piece] < stop:
            stop = model.changes[model.piece]
        # Steps of equal length up to a jump of the input or of Q.
        count = max(1, math.ceil((stop - time) / model.step - 1e-9))
        length = (stop - time) / count
        for m in range(count):
            _move(model, x, root, k, time + m * length, length, n)
        time = stop


@kernel
def _move(
    model: RateTables, x: FloatArray, root: FloatArray, k: int, time: float, length: float, n: int
) -> None:
    state, work, points = model.state, model.work, model.points
    size, second = n + 2 * n * n, n + n * n
    if model.distance > 0.0:
        settle_root(root, k, 0, n)
    for r in range(2 * n + 1 if model.distance > 0.0 else 0):
        set_point(x, root, k, 0, model.distance, r, model.slope)
        for i in range(n):
            state[i] = model.slope[i]
        _step(model, n, n, time, length)
        for i in range(n):
            points[r, i] = state[i]
    for i in range(n):
        state[i] = x[k, i, 0]
        for j in range(n):
            state[n + i * n + j] = 1.0 if i == j else 0.0
            state[second + i * n + j] = 0.0
    _step(model, n, size, time, length)
    if model.distance > 0.0:
        weigh_points(points, model.weight, model.center, x[k], 0, work)
    else:
        for i in range(n):
            for j in range(2 * n + 1):
                total = 0.0
                for m in range(j, n):
                    total += state[n + i * n + m] * root[k, m, j, 0]
                work[i, j] = total
            x[k, i, 0] = state[i]
    _write_noise_root(model, n, second)
    write_root(work, root[k], 0)


@kernel
def _write_noise_root(model: RateTables, n: int, first: int) -> None:
    """Write a root of W, ``model.state[first:]``, into the last n columns of the work."""
    state, work, column = model.state, model.work, 2 * n + 1
    for j in range(n):
        for i in range(n):
            work[i, column + j] = 0.0
        pivot = state[first + j * n + j]
        for m in range(j):
            pivot -= work[j, column + m] * work[j, column + m]
        if pivot <= 1e-14 * state[first + j * n + j]:
            continue
        for i in range(j, n):
            total = 0.5 * (state[first + i * n + j] + state[first + j * n + i])
            for m in range(j):
                total -= work[i, column + m] * work[j, column + m]
            work[i, column + j] = total / math.sqrt(pivot)


@predict_estimate.register(RateTables)
@kernel
def predict_by_rate(
    model: RateTables, run: Any, x: FloatArray, root: FloatArray, k: int, _h: int
) -> None:
    """Predict estimate ``k`` over ``run.gap`` to ``run.now``."""
    move_by_rate(model, x, root, k, run.now, run.gap)


@carry.register(RateTables)
@kernel
def _carry_by_rate(
    model: RateTables, run: Any, x: FloatArray, root: FloatArray, m: int, age: float
) -> None:
    if age > 0.0:
        move_by_rate(model, x, root, m, run.now, age)


@carry_mean.register(RateTables)
@kernel
def _carry_mean_by_rate(model: RateTables, run: Any, x: FloatArray, m: int, age: float) -> None:
    n = len(model.slope)
    for i in range(n):
        model.mean[0, i, 0] = x[m, i, 0]
        for j in range(n):
            # A root of zero: the mean of an extended filter does not depend on it.
            model.root[0, i, j, 0] = 0.0
    if age > 0.0:
        move_by_rate(model, model.mean, model.root, 0, run.now, age)
    for i in range(n):
        x[m, i, 0] = model.mean[0, i, 0]


@transition.register(RateTables)
@kernel
def _transition_by_rate(
    model: RateTables, run: Any, x: FloatArray, k: int, out: FloatArray
) -> None:
    n = len(model.slope)
    out[:] = 0.0
    for c in range(n):
        # Central differences of means.
        step = DIFFERENCE * max(1.0, abs(x[k, c, 0]))
        for side in range(2):
            for i in range(n):
                model.mean[0, i, 0] = x[k, i, 0]
                for j in range(n):
                    model.root[0, i, j, 0] = 0.0
            model.mean[0, c, 0] += step if side == 0 else -step
            move_by_rate(model, model.mean, model.root, 0, run.now, run.gap)
            for i in range(n):
                before = out[i, c, 0] if side == 1 else 0.0
                out[i, c, 0] = before + (0.5 - side) / step * model.mean[0, i, 0]


update_estimate.register(RateTables)(update_in_slot)


def scratch_of_rates(n: int, m: int) -> dict[str, Any]:
    """Return the scratch arrays of RateTables by name."""
    shapes: dict[str, tuple[int, ...]] = {
        "u": (m,), "slope": (n,), "J": (n, n), "state": (n + 2 * n * n,),
        "stage": (n + 2 * n * n,), "rates": (STAGES, n + 2 * n * n), "points": (2 * n + 1, n),
        "work": (n, 3 * n + 1), "mean": (1, n, 1), "root": (1, n, n, 1),
    }  # fmt: skip
    return {name: np.zeros(shape) for name, shape in shapes.items()}
