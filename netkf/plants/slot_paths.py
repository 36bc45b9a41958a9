"""Kernels that draw the states and the readings of a plant in slots for many runs at once.

Runs are side by side in B blocks of L lanes (``netkf.linalg.lanes``): L runs are the last axis of
arrays, and one instruction handles them all. Each draws from separate streams, so that a run has
the same bits alone and in a batch. Arrays ``states`` of integers are the states of these streams,
one a row; ``ziggurat`` has the tables for normal numbers.

On an unstable plant the state may be *local*: relative to an origin that is moved to the state
every so many slots, the *rebase*. The interval between two rebases is a *frame* (``truth``).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.functions import call_function
from netkf.linalg.lanes import Lanes, load, spread, store
from netkf.linalg.small import count_until
from netkf.rng.draws import Ziggurat
from netkf.rng.numbers import next_normal


class Path(NamedTuple):
    """``x[k+1] = F x[k] + root z[k]`` in R runs, z standard normal: F (n, n), root (n, q).

    frame   slots from one frame to the next; 0: no frames
    x       (B, n, L) state of the next slot, local to the present frame
    origin  (B, n, L) absolute position of the origin of that frame in that slot
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
    stride: int,
    runs: int,
    ziggurat: Ziggurat,
    normals: FloatArray,
    count: int,
) -> None:
    """Fill ``normals`` (>= count, L) with the next ``count`` standard normals of L streams: lane q,
    below the number ``runs`` of runs left, takes row ``first + q * stride`` of ``states``.
    """
    # Lanes in the inner loop: numbers of different streams do not wait for each other.
    for j in range(count):
        for q in range(min(runs, len(lanes))):
            normals[j, q] = next_normal(states, first + q * stride, ziggurat)


@kernel
def draw_starts(
    lanes: Lanes,
    states: np.ndarray,
    ziggurat: Ziggurat,
    mean: FloatArray,
    root: FloatArray,
    scratch: FloatArray,
    x: FloatArray,
) -> None:
    """Write x(0) = mean + root z of R runs into ``x`` (B, n, L), z from ``states`` (R, WIDTH);
    ``mean`` (n,), ``root`` (n, q), ``scratch`` (q, L).
    """
    for b in range(len(x)):
        first, count = b * len(lanes), root.shape[1]
        draw_normals(lanes, states, first, 1, len(states) - first, ziggurat, scratch, count)
        for i in range(len(mean)):
            noise = spread(lanes, 0.0)
            for j in range(count):
                noise += root[i, j] * load(lanes, scratch, j)
            store(lanes, x, b, i, mean[i] + noise)


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
    """Write the states of block ``b`` in slot number ``slot`` into ``local[b, s]``, in the frame
    before a rebase, and, with frames, ``absolute[b, s]``; move ``path`` to the next slot.
    ``normals`` (q, L) drive the step; ``moved`` (n, L) is scratch.
    """
    n = len(path.F)
    # Before a rebase: the errors of this slot are still in coordinates of the old frame.
    for i in range(n):
        x = load(lanes, path.x, b, i)
        store(lanes, local, b, s, i, x)
        if path.frame > 0:
            store(lanes, absolute, b, s, i, x + load(lanes, path.origin, b, i))
    # Rebase: origin <- origin + x, x <- 0. Slot 0 begins the first frame, whose origin is 0.
    if path.frame > 0 and slot > 0 and slot % path.frame == 0:
        for i in range(n):
            origin = load(lanes, path.origin, b, i) + load(lanes, path.x, b, i)
            store(lanes, path.origin, b, i, origin)
            store(lanes, path.x, b, i, 0.0)
    # x <- F x + root z, in local coordinates.
    for i in range(n):
        total, noise = spread(lanes, 0.0), spread(lanes, 0.0)
        for j in range(n):
            total += path.F[i, j] * load(lanes, path.x, b, j)
        for j in range(path.root.shape[1]):
            noise += path.root[i, j] * load(lanes, normals, j)
        store(lanes, moved, i, total + noise)
    for i in range(n):
        store(lanes, path.x, b, i, load(lanes, moved, i))
    # origin <- F origin: it moves with the plant, without noise.
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
    ziggurat: Ziggurat,
    slot: int,
    work: FloatArray,
    local: FloatArray,
    absolute: FloatArray,
) -> None:
    """Write the states of R runs in S slots from number ``slot`` on into ``local`` and, with
    frames, ``absolute``, both (B, S, n, L); move ``path`` behind these slots. ``states`` (R,
    WIDTH), ``work`` (2, max(n, q), L).
    """
    for b in range(local.shape[0]):
        first = b * len(lanes)
        for s in range(local.shape[1]):
            draw_normals(
                lanes, states, first, 1, len(states) - first, ziggurat, work[0], path.root.shape[1]
            )
            move_path(lanes, path, b, s, slot + s, work[0], local, absolute, work[1])


class MapPaths(NamedTuple):
    """``x[k+1] = f(x[k], u[k], t_k) + S z[k]`` in R runs, z standard normal.

    f            address of the map (``linalg.functions``)
    u            (S, m) the input of all slots
    period       seconds of a slot
    roots        (P, n, q) roots S, of which the next one holds from each of the slots ``changes``
                 (P - 1,) on
    x            (B, n, L) state of the next slot
    given, moved (n,) scratch
    """

    f: int
    u: FloatArray
    period: float
    roots: FloatArray
    changes: IntArray
    x: FloatArray
    given: FloatArray
    moved: FloatArray


@kernel
def draw_map_paths(
    lanes: Lanes,
    path: MapPaths,
    states: np.ndarray,
    ziggurat: Ziggurat,
    slot: int,
    scratch: FloatArray,
    out: FloatArray,
) -> None:
    """Write the states of R runs in S slots from number ``slot`` on into ``out`` (B, S, n, L); move
    ``path`` behind these slots. ``states`` (R, WIDTH), ``scratch`` (q, L).
    """
    n, columns = path.x.shape[1], path.roots.shape[2]
    for b in range(out.shape[0]):
        first = b * len(lanes)
        runs = min(len(lanes), len(states) - first)
        for s in range(out.shape[1]):
            piece = count_until(path.changes, slot + s)
            draw_normals(lanes, states, first, 1, runs, ziggurat, scratch, columns)
            t, u = (slot + s) * path.period, path.u[slot + s]
            for i in range(n):
                store(lanes, out, b, s, i, load(lanes, path.x, b, i))
            for q in range(runs):
                for i in range(n):
                    path.given[i] = path.x[b, i, q]
                call_function(path.f, path.given, u, t, path.period, path.moved)
                for i in range(n):
                    noise = 0.0
                    for j in range(columns):
                        noise += path.roots[piece, i, j] * scratch[j, q]
                    path.x[b, i, q] = path.moved[i] + noise


class SlotSensors(NamedTuple):
    """M sensors whose readings are drawn from the model; p is the most rows of one of them.

    estimator (M,) index of the filter that uses the readings of the sensor, that of its node or the
              one that all nodes share
    row, rows (M,) first row and number of rows of the sensor in the stacked reading of that filter
    H         (M, p, n) whitened observation matrix: L_b^-1 times that of the sensor, where the
              filter assumes the noise covariance R = L_b L_b'; for a random H, of one row,
              H[m, 0, 0] is L_b^-1
    noise     (M, p, p) root of the covariance of the whitened noise: L_b^-1 L with the true
              R = L L'
    driven    (M,) index d of the sensor's regressor if H is random, else -1
    C         (D, n, k) the random row of regressor d is C[d] s with its state s (k,)
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
    ziggurat: Ziggurat,
    x: FloatArray,
    regressors: FloatArray,
    scratch: FloatArray,
    y: FloatArray,
    H: FloatArray,
) -> None:
    """Write the readings ``y`` (B, S, N, p, L) of all M sensors, and ``H`` (B, S, N, p, n, L) where
    it is random, at the states ``x`` (B, S, n, L) and ``regressors`` (D, B, S, k, L). Run r draws
    the noise of sensor m from row r M + m of ``states``; ``scratch`` (p, L).
    """
    count = len(sensors.estimator)
    for b in range(x.shape[0] if count > 0 else 0):
        # Runs left: the last block may have more lanes than runs.
        runs, first = len(states) // count - b * len(lanes), b * len(lanes) * count
        for s in range(x.shape[1]):
            for m in range(count):
                # All normals of a reading before its rows, in the order in which a single run
                # draws them.
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
    """Write row ``i`` of the reading of sensor ``m`` in slot ``s`` of block ``b``, see
    ``draw_readings``; ``normals`` (p, L) are those of the reading.
    """
    estimator, row, d = sensors.estimator[m], sensors.row[m] + i, sensors.driven[m]
    # total = (noise factor) z, row i
    total = spread(lanes, 0.0)
    for j in range(sensors.rows[m]):
        total += sensors.noise[m, i, j] * load(lanes, normals, j)
    # y = H x + total
    for j in range(x.shape[2]):
        weight = spread(lanes, sensors.H[m, i, j])
        if d >= 0:
            # H[j] = (C s)[j] times the whitening factor L_b^-1
            weight = spread(lanes, 0.0)
            for k in range(sensors.C.shape[2]):
                weight += sensors.C[d, j, k] * load(lanes, regressors, d, b, s, k)
            weight *= sensors.H[m, i, 0]
            store(lanes, H, b, s, estimator, row, j, weight)
        total += weight * load(lanes, x, b, s, j)
    store(lanes, y, b, s, estimator, row, total)
