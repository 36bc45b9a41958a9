"""Prediction over one slot by a map x[k+1] = f(x[k], u[k], t_k) + w that need not be linear.

``Spread.distance`` says how: 0 is the extended Kalman filter, P <- J P J' + Q with the Jacobian J
of f at the estimate. Otherwise 2 n + 1 sigma points, xhat and xhat +- distance times the columns of
the root of P, are moved by f, and mean and covariance are weighted sums of them: the unscented
filter (Julier and Uhlmann 2004, Proc. IEEE 92) and the cubature filter (Arasaratnam and Haykin
2009, IEEE TAC 54). The root of the covariance is triangularised from weighted deviations.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from netkf.algorithms.kernels.run import (
    SlotRun,
    carry,
    carry_in_slot,
    carry_mean,
    carry_mean_in_slot,
    predict_estimate,
    transition,
    update_estimate,
    update_in_slot,
)
from netkf.algorithms.kernels.square_root import reflect, triangularise
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import call_function
from netkf.linalg.lanes import Lanes, load, spread, store
from netkf.linalg.small import count_until
from netkf.linalg.structs import Size, Struct

METHODS = ("ekf", "ukf", "ckf")
"""How functions that are not linear are used: linearised, or by unscented or cubature points."""

ROUNDING = 1e-14
"""Share of a row of a root below which its pivot is rounding: the state follows from others."""


class Spread(NamedTuple):
    """Sigma points of n states and their weights.

    distance : of the points from the estimate, in columns of the root of P; 0: linearise
    weight : of each of the 2 n points; the mean gives what is left to the estimate itself
    center : of the deviation of the estimate itself, in the covariance
    """

    distance: float
    weight: float
    center: float


def spread_of(method: str, n: int) -> Spread:
    """Return the sigma points of one of METHODS for n states.

    "ukf" has alpha = 1, beta = 2 and kappa = 0: no weight is negative, and mean and variance of a
    quadratic function of one variable are exact.
    """
    if method == "ekf":
        return Spread(0.0, 0.0, 0.0)
    return Spread(math.sqrt(n), 0.5 / n, 2.0 if method == "ukf" else 0.0)


class MapTables(Struct):
    """The map of a slot that all nodes believe.

    f, jacobian : addresses (``linalg.functions``) of the map and its Jacobian
    u : (S, m), the input of slots 0 to S - 1
    roots : (P, n, n), lower triangular roots of Q, of which the next one holds from each of the
            slots ``changes`` (P - 1,) on
    period, delay : seconds of a slot, and 1 where slots begin with the prediction from the one
        before, else 0
    active : runs side by side that there are, at most L
    distance, weight, center : ``Spread``
    x, moved, J, J_lanes, points, work : scratch, (n,), (n,), (n, n), (n, n, L), (2 n + 1, n) and
        (n, 3 n + 1); roots and J_lanes are larger where a node's record has room for more states
        than it estimates
    """

    f: int
    jacobian: int
    delay: int
    active: int
    period: float
    distance: float
    weight: float
    center: float
    u: FloatArray
    roots: FloatArray
    changes: IntArray
    x: FloatArray
    moved: FloatArray
    J: FloatArray
    J_lanes: FloatArray
    points: FloatArray
    work: FloatArray


class MapRun(Struct):
    """The surroundings of nodes in slots whose model is a map, L runs side by side: a SlotRun."""

    __annotations__ = SlotRun.__annotations__


class SingleMapRun(Struct):
    """The same for one node in one run, for the SimPy engine."""

    __annotations__ = SlotRun.__annotations__


@predict_estimate.register(MapTables)
@kernel
def predict_by_map(
    model: MapTables, run: Any, x: FloatArray, root: FloatArray, k: int, _h: int
) -> None:
    """Predict estimate ``k`` by one slot."""
    slot = run.slot - model.delay
    move_estimate(model, run.size, run.lanes, x, root, k, slot, (run.moved, run.noise))


@kernel
def move_estimate(
    model: MapTables,
    size: Size,
    lanes: Lanes,
    x: FloatArray,
    root: FloatArray,
    k: int,
    slot: int,
    scratch: tuple[FloatArray, FloatArray],
) -> None:
    """Predict estimate ``k`` from ``slot`` to the next; ``scratch`` are two arrays (n, n, L)."""
    slot, root_Q = min(slot, len(model.u) - 1), model.roots[count_until(model.changes, slot)]
    if model.distance > 0.0:
        for q in range(model.active):
            _move_points(model, x, root, k, q, slot, root_Q)
        return
    n, own, (moved, noise) = len(size), len(model.x), scratch
    for q in range(model.active):
        for i in range(own):
            model.x[i] = x[k, i, q]
        t = slot * model.period
        call_function(model.jacobian, model.x, model.u[slot], t, model.period, model.J)
        call_function(model.f, model.x, model.u[slot], t, model.period, model.moved)
        for i in range(own):
            x[k, i, q] = model.moved[i]
            for j in range(own):
                model.J_lanes[i, j, q] = model.J[i, j]
    # The root of [J S, root_Q], as transform_root forms it of a matrix that all runs share.
    for i in range(n):
        for j in range(n):
            total = spread(lanes, 0.0)
            for m in range(j, n):
                total += load(lanes, model.J_lanes, i, m) * load(lanes, root, k, m, j)
            store(lanes, moved, i, j, total)
        for j in range(i + 1):
            store(lanes, noise, i, j, root_Q[i, j])
    triangularise(lanes, size, root[k], moved, noise)


@kernel
def _move_points(
    model: MapTables, x: FloatArray, root: FloatArray, k: int, q: int, slot: int, root_Q: FloatArray
) -> None:
    n, points, work = len(model.x), model.points, model.work
    settle_root(root, k, q, n)
    for r in range(2 * n + 1):
        set_point(x, root, k, q, model.distance, r, model.x)
        call_function(
            model.f, model.x, model.u[slot], slot * model.period, model.period, model.moved
        )
        for i in range(n):
            points[r, i] = model.moved[i]
    weigh_points(points, model.weight, model.center, x[k], q, work)
    for i in range(n):
        for j in range(n):
            work[i, 2 * n + 1 + j] = root_Q[i, j]
    write_root(work, root[k], q)


@kernel
def weigh_points(
    points: FloatArray, weight: float, center: float, x: FloatArray, q: int, work: FloatArray
) -> None:
    """Write the mean of moved sigma ``points`` (2 n + 1, n) into lane ``q`` of ``x`` (n, L), and a
    root of their covariance into the first 2 n + 1 columns of ``work``.
    """
    count, n = points.shape
    for i in range(n):
        # Weights sum to 1: relative to the middle point nothing large cancels.
        mean = 0.0
        for r in range(1, count):
            mean += weight * (points[r, i] - points[0, i])
        mean += points[0, i]
        work[i, 0] = math.sqrt(center) * (points[0, i] - mean)
        for r in range(1, count):
            work[i, r] = math.sqrt(weight) * (points[r, i] - mean)
        x[i, q] = mean


@kernel
def write_root(work: FloatArray, root: FloatArray, q: int) -> None:
    """Write the lower triangular root of ``work work'`` into lane ``q`` of ``root`` (n, n, L), with
    a nonnegative diagonal; ``work`` (n, c) is overwritten.
    """
    n, columns = work.shape
    for i in range(n):
        reflect(work, i, i, n, columns)
    for j in range(n):
        # Signs of columns are free: a nonnegative diagonal makes the root unique.
        sign = -1.0 if work[j, j] < 0.0 else 1.0
        for i in range(j, n):
            root[i, j, q] = sign * work[i, j]


@kernel
def settle_root(root: FloatArray, k: int, q: int, n: int) -> None:
    """Make columns of the first ``n`` states of ``root[k]`` without a pivot 0, by rotations with
    later ones: sigma points are those of the Cholesky factor also where P is singular.
    """
    for j in range(n):
        square = 0.0
        for m in range(j + 1):
            square += root[k, j, m, q] * root[k, j, m, q]
        if root[k, j, j, q] > ROUNDING * math.sqrt(square):
            continue
        root[k, j, j, q] = 0.0
        for i in range(j + 1, n):
            pivot, other = root[k, i, i, q], root[k, i, j, q]
            length = math.hypot(pivot, other)
            for r in range(i, n if other != 0.0 else i):
                a, b = root[k, r, i, q], root[k, r, j, q]
                root[k, r, i, q] = (pivot * a + other * b) / length
                root[k, r, j, q] = (pivot * b - other * a) / length


@kernel
def set_point(
    x: FloatArray, root: FloatArray, k: int, q: int, distance: float, r: int, out: FloatArray
) -> None:
    """Write sigma point ``r`` of estimate ``k`` in lane ``q`` into ``out`` (n,): number 0 is the
    estimate, then come two for each column of the root, in both directions.
    """
    n, column = len(out), (r - 1) // 2
    step = distance if r % 2 == 1 else -distance
    for i in range(n):
        out[i] = x[k, i, q]
        if r > 0 and i >= column:
            out[i] += step * root[k, i, column, q]


@transition.register(MapTables)
@kernel
def _transition_of_map(model: MapTables, run: Any, x: FloatArray, k: int, out: FloatArray) -> None:
    own, slot = len(model.x), min(run.slot - model.delay, len(model.u) - 1)
    for i in range(len(run.size)):
        for j in range(len(run.size)):
            store(run.lanes, out, i, j, 0.0)
    for q in range(model.active):
        for i in range(own):
            model.x[i] = x[k, i, q]
        t = slot * model.period
        call_function(model.jacobian, model.x, model.u[slot], t, model.period, model.J)
        for i in range(own):
            for j in range(own):
                out[i, j, q] = model.J[i, j]


carry.register(MapTables)(carry_in_slot)
carry_mean.register(MapTables)(carry_mean_in_slot)
update_estimate.register(MapTables)(update_in_slot)
