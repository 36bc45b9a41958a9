"""The state and the readings of a plant in slots as kernels, slot after slot from given normals.

Runs are side by side in B blocks of L lanes (``netkf.linalg.lanes``); each draws from streams of
its own, so that it is the same alone and in a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, spread, store
from netkf.rng.numbers import NormalZiggurat, next_normal


class Path(NamedTuple):
    """``x[k+1] = F x[k] + root z[k]`` in R runs: F (n, n), root (n, q), the state x (B, n, L) of
    the next slot and the absolute position of its ``origin`` (B, n, L), which moves to the state
    every ``frame`` slots (0: never).
    """

    F: FloatArray
    root: FloatArray
    frame: int
    x: FloatArray
    origin: FloatArray


@kernel(inlined=True)
def draw_normals(
    lanes: Lanes,
    states: np.ndarray,
    first: int,
    every: int,
    runs: int,
    ziggurat: NormalZiggurat,
    normals: FloatArray,
    count: int,
) -> None:
    """Fill ``normals`` (>= count, L) with the next numbers of the streams ``first``,
    ``first + every``, ... of so many ``runs``; idle lanes keep what they have.
    """
    # Lane by lane: one number does not wait for another there.
    for j in range(count):
        for q in range(min(runs, len(lanes))):
            normals[j, q] = next_normal(states, first + q * every, ziggurat)


@kernel
def draw_starts(
    lanes: Lanes,
    states: np.ndarray,
    ziggurat: NormalZiggurat,
    mean: FloatArray,
    root: FloatArray,
    scratch: FloatArray,
    x: FloatArray,
) -> None:
    """Fill x (B, n, L) with ``mean + root z`` for the first normals z (q,) of each of the streams
    ``states`` (R, >= 4); ``scratch`` (q, L) is scratch.
    """
    for b in range(len(x)):
        first, count = b * len(lanes), root.shape[1]
        draw_normals(lanes, states, first, 1, len(states) - first, ziggurat, scratch, count)
        for i in range(len(mean)):
            total = spread(lanes, mean[i])
            for j in range(count):
                total += root[i, j] * load(lanes, scratch, j)
            store(lanes, x, b, i, total)


@kernel
def move_path(
    lanes: Lanes,
    path: Path,
    b: int,
    s: int,
    slot: int,
    normals: FloatArray,
    local: FloatArray,
    absolute: FloatArray,
    moved: FloatArray,
) -> None:
    """Write the states of block ``b`` in ``slot`` into ``local[b, s]`` and ``absolute[b, s]``
    (n, L), in the coordinates of the frame that ends there and in those of the plant, and move on
    with ``normals`` (q, L); ``moved`` (n, L) is scratch.
    """
    n = len(path.F)
    # The state of this slot is written before the origin moves: it ends the frame.
    for i in range(n):
        x = load(lanes, path.x, b, i)
        store(lanes, local, b, s, i, x)
        if path.frame > 0:
            store(lanes, absolute, b, s, i, x + load(lanes, path.origin, b, i))
    # Slot 0 begins the first frame: its origin is already where it should be.
    if path.frame > 0 and slot > 0 and slot % path.frame == 0:
        for i in range(n):
            origin = load(lanes, path.origin, b, i) + load(lanes, path.x, b, i)
            store(lanes, path.origin, b, i, origin)
            store(lanes, path.x, b, i, 0.0)
    # x <- F x + root z, in local coordinates.
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(n):
            total += path.F[i, j] * load(lanes, path.x, b, j)
        for j in range(path.root.shape[1]):
            total += path.root[i, j] * load(lanes, normals, j)
        store(lanes, moved, i, total)
    for i in range(n):
        store(lanes, path.x, b, i, load(lanes, moved, i))
    # The origin moves with the plant, without noise.
    if path.frame > 0:
        for i in range(n):
            total = spread(lanes, 0.0)
            for j in range(n):
                total += path.F[i, j] * load(lanes, path.origin, b, j)
            store(lanes, moved, i, total)
        for i in range(n):
            store(lanes, path.origin, b, i, load(lanes, moved, i))


@kernel
def draw_paths(
    lanes: Lanes,
    path: Path,
    states: np.ndarray,
    ziggurat: NormalZiggurat,
    slot: int,
    scratch: FloatArray,
    local: FloatArray,
    absolute: FloatArray,
) -> None:
    """Fill ``local`` and, with frames, ``absolute`` (B, S, n, L) from ``slot`` on with the next
    numbers of the streams ``states`` (R, >= 4); ``scratch`` (2, max(n, q), L) is scratch.
    """
    for b in range(local.shape[0]):
        first = b * len(lanes)
        for s in range(local.shape[1]):
            draw_normals(
                lanes,
                states,
                first,
                1,
                len(states) - first,
                ziggurat,
                scratch[0],
                path.root.shape[1],
            )
            move_path(lanes, path, b, s, slot + s, scratch[0], local, absolute, scratch[1])


class SlotSensors(NamedTuple):
    """M drawn sensors: which filter reads each (``estimator``) and its first ``row`` and number of
    ``rows`` in that filter's reading (M, each), H (M, p, n) and factor of the noise (M, p, p).

    Where H is random, ``driven`` (M,) is the index of the sensor's regressor ``C s`` with C
    (D, n, k), else -1.
    """

    estimator: np.ndarray
    row: np.ndarray
    rows: np.ndarray
    H: FloatArray
    noise: FloatArray
    driven: np.ndarray
    C: FloatArray


@kernel
def draw_readings(
    lanes: Lanes,
    sensors: SlotSensors,
    states: np.ndarray,
    ziggurat: NormalZiggurat,
    x: FloatArray,
    regressors: FloatArray,
    scratch: FloatArray,
    y: FloatArray,
    H: FloatArray,
) -> None:
    """Fill the readings y (B, S, estimators, p, L), and H (B, S, estimators, p, n, L) where it is
    random, from the states x (B, S, n, L) and ``regressors`` (D, B, S, k, L), with the next numbers
    of the streams ``states`` (R M, >= 4); ``scratch`` (p, L) is scratch.
    """
    count = len(sensors.estimator)
    for b in range(x.shape[0] if count > 0 else 0):
        runs, first = len(states) // count - b * len(lanes), b * len(lanes) * count
        for s in range(x.shape[1]):
            for m in range(count):
                # All normals of a sensor's reading before its rows, in the order that a single run
                # takes them.
                draw_normals(
                    lanes, states, first + m, count, runs, ziggurat, scratch, sensors.rows[m]
                )
                for i in range(sensors.rows[m]):
                    read_row(lanes, sensors, b, s, m, i, x, regressors, scratch, y, H)


@kernel(inlined=True)
def read_row(
    lanes: Lanes,
    sensors: SlotSensors,
    b: int,
    s: int,
    m: int,
    i: int,
    x: FloatArray,
    regressors: FloatArray,
    normals: FloatArray,
    y: FloatArray,
    H: FloatArray,
) -> None:
    """Write row ``i`` of the reading of sensor ``m``, and of its H if that is random."""
    estimator, row, d = sensors.estimator[m], sensors.row[m] + i, sensors.driven[m]
    total = spread(lanes, 0.0)
    for j in range(sensors.rows[m]):
        total += sensors.noise[m, i, j] * load(lanes, normals, j)
    # Whitened reading: y = H x + noise with the weights of this row.
    for j in range(x.shape[2]):
        weight = spread(lanes, sensors.H[m, i, j])
        if d >= 0:  # sensors.H holds the whitening factor of the one row then
            weight = spread(lanes, 0.0)
            # The random row is C s, whitened.
            for k in range(sensors.C.shape[2]):
                weight += sensors.C[d, j, k] * load(lanes, regressors, d, b, s, k)
            weight *= sensors.H[m, i, 0]
            store(lanes, H, b, s, estimator, row, j, weight)
        total += weight * load(lanes, x, b, s, j)
    store(lanes, y, b, s, estimator, row, total)
