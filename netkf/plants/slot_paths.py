"""The state and the readings of a plant in slots as kernels, slot after slot from given normals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.rng.numbers import NormalZiggurat, next_normal


class Path(NamedTuple):
    """``x[k+1] = F x[k] + root z[k]`` in R runs: F (n, n), root (n, q), the state x (R, n) of the
    next slot and the absolute position of its ``origin`` (R, n), which moves to the state every
    ``frame`` slots (0: never).
    """

    F: FloatArray
    root: FloatArray
    frame: int
    x: FloatArray
    origin: FloatArray


@kernel
def draw_starts(
    states: np.ndarray, ziggurat: NormalZiggurat, mean: FloatArray, root: FloatArray, x: FloatArray
) -> None:
    """Fill x (R, n) with ``mean + root z`` for the first normals z (n,) of each stream."""
    for r in range(len(x)):
        for i in range(len(mean)):
            x[r, i] = mean[i]
        # Column by column: each normal is used when it is drawn, and none is stored.
        for j in range(root.shape[1]):
            z = next_normal(states, r, ziggurat)
            for i in range(len(mean)):
                x[r, i] += root[i, j] * z


@kernel
def move_path(
    path: Path,
    r: int,
    slot: int,
    normals: FloatArray,
    local: FloatArray,
    absolute: FloatArray,
    moved: FloatArray,
) -> None:
    """Write the state of ``slot`` into ``local`` and ``absolute`` (n,), in the coordinates of the
    frame that ends there and in those of the plant, and move run ``r`` on with ``normals`` (q,);
    ``moved`` (n,) is scratch.
    """
    n = len(path.F)
    # The state of this slot is written before the origin moves: it ends the frame.
    for i in range(n):
        local[i], absolute[i] = path.x[r, i], path.x[r, i] + path.origin[r, i]
    # Slot 0 begins the first frame: its origin is already where it should be.
    if path.frame > 0 and slot > 0 and slot % path.frame == 0:
        for i in range(n):
            path.origin[r, i] += path.x[r, i]
            path.x[r, i] = 0.0
    # x <- F x + root z, in local coordinates.
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += path.F[i, j] * path.x[r, j]
        for j in range(path.root.shape[1]):
            total += path.root[i, j] * normals[j]
        moved[i] = total
    for i in range(n):
        path.x[r, i] = moved[i]
    # The origin moves with the plant, without noise.
    if path.frame > 0:
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += path.F[i, j] * path.origin[r, j]
            moved[i] = total
        for i in range(n):
            path.origin[r, i] = moved[i]


@kernel
def draw_paths(
    path: Path,
    states: np.ndarray,
    ziggurat: NormalZiggurat,
    slot: int,
    room: FloatArray,
    local: FloatArray,
    absolute: FloatArray,
) -> None:
    """Fill ``local`` and ``absolute`` (R, S, n) from ``slot`` on with the next numbers of the
    streams ``states`` (R, >= 4); ``room`` (2, max(n, q)) is scratch.
    """
    # Run by run, each from its own stream: a run is the same alone and in a batch.
    for r in range(local.shape[0]):
        for s in range(local.shape[1]):
            for j in range(path.root.shape[1]):
                room[0, j] = next_normal(states, r, ziggurat)
            move_path(path, r, slot + s, room[0], local[r, s], absolute[r, s], room[1])


class SlotSensors(NamedTuple):
    """M drawn sensors: which filter reads each (``host``) and its first ``row`` and number of
    ``rows`` in that filter's reading (M, each), H (M, p, n) and factor of the noise (M, p, p).

    Where H is random, ``driven`` (M,) is the place of the sensor's regressor ``C s`` with C
    (D, n, k), else -1.
    """

    host: np.ndarray
    row: np.ndarray
    rows: np.ndarray
    H: FloatArray
    noise: FloatArray
    driven: np.ndarray
    C: FloatArray


@kernel
def draw_readings(
    sensors: SlotSensors,
    states: np.ndarray,
    ziggurat: NormalZiggurat,
    x: FloatArray,
    regressors: FloatArray,
    room: FloatArray,
    y: FloatArray,
    H: FloatArray,
) -> None:
    """Fill the readings y (R, S, hosts, p), and H (R, S, hosts, p, n) where it is random, from the
    states x (R, S, n) and ``regressors`` (D, R, S, k), with the next numbers of the streams
    ``states`` (R M, >= 4); ``room`` (p,) is scratch.
    """
    n, count = x.shape[2], len(sensors.host)
    for r in range(x.shape[0]):
        for s in range(x.shape[1]):
            for m in range(count):
                host, p, d = sensors.host[m], sensors.rows[m], sensors.driven[m]
                # All normals of a sensor's reading before its rows, in the order that a single run
                # takes them.
                for i in range(p):
                    room[i] = next_normal(states, r * count + m, ziggurat)
                for i in range(p):
                    row = sensors.row[m] + i
                    total = 0.0
                    for j in range(p):
                        total += sensors.noise[m, i, j] * room[j]
                    for j in range(n):
                        weight = sensors.H[m, i, j]
                        if d >= 0:  # sensors.H holds the whitening factor of the one row then
                            weight = 0.0
                            # The random row is C s, whitened.
                            for k in range(sensors.C.shape[2]):
                                weight += sensors.C[d, j, k] * regressors[d, r, s, k]
                            weight *= sensors.H[m, i, 0]
                            H[r, s, host, row, j] = weight
                        # Whitened reading: y = H x + noise with the weights of this row.
                        total += weight * x[r, s, j]
                    y[r, s, host, row] = total
