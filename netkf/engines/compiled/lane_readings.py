"""Readings of nodes side by side, one in each lane.

The formulas are those of ``increments``, of as many nodes at a time as there are lanes. What a lane
does alone is to find its piece of the path, add up its series and draw its normals.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.engines.compiled.increments import (
    draw_cut,
    fill_moments,
    fill_readings,
    find_course,
    noise_index,
    piece_of,
)
from netkf.engines.compiled.state import Filters, Sensing, Simulation
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, gather, load, scatter, turn, with_spare
from netkf.linalg.structs import Struct
from netkf.plants.laws import course_width
from netkf.plants.paths import fill_integrals, fill_moments_between
from netkf.plants.sensors import divide, fill_reading


class LaneReadings(Struct):
    """Readings of L nodes, one in each lane: q moments of p rows, of n states.

    moments : (q, L), what is read
    model, whitened_H : (L,) and (q, n, L), model of each node in FlowTable, and its R^-1/2 H
    kind, H, root : (L,), (1, p, n, L) and (1, p, p, L), kind of sensor with H and the root of R
    rate, trace : (1, L), trace(P G) in 1/s and trace(P)
    first, share : (1, L), where the reading begins in its piece of the path and how much of the
                   piece it takes, as shares of the piece
    gap, remaining : (1, L), seconds of the reading, and from its start to the end of the step
    rows, integrals : (L, 2 W) and (2 W, L), both integrals of the path by lane, and by entry
    x : (2, n, L), moments of the path over the reading
    noise_row, noise : (L,) and (2, p, L), row of Sensing.noise that the reading takes its share of,
                       and that row
    early, normals : (2, p, L), the share, and the standard normal numbers that divide the row
    alone : 1 if some node has several sensors: then each lane is read by the scalar kernels
    """

    moments: FloatArray
    model: IntArray
    whitened_H: FloatArray
    kind: IntArray
    H: FloatArray
    root: FloatArray
    rate: FloatArray
    trace: FloatArray
    gap: FloatArray
    remaining: FloatArray
    first: FloatArray
    share: FloatArray
    rows: FloatArray
    integrals: FloatArray
    x: FloatArray
    noise_row: IntArray
    noise: FloatArray
    early: FloatArray
    normals: FloatArray
    alone: int


def empty_readings(filters: Filters) -> LaneReadings:
    """Return arrays for the readings of L nodes side by side, one in each SIMD lane, with space for
    the largest number of moments q of these filters: two for each row of increments.
    """
    n, q = filters.xhat.shape[1], int(filters.gains.moments.max())
    p, width = q // 2, 2 * course_width(n)
    names = ("rate", "trace", "gap", "remaining", "first", "share")
    shapes = {
        "moments": (q, LANES),
        "whitened_H": (*filters.table.whitened_H.shape[1:], LANES),
        "H": (1, p, n, LANES),
        "root": (1, p, p, LANES),
        **dict.fromkeys(names, (1, LANES)),
        "rows": (LANES, width),
        "integrals": (width, LANES),
        "x": (2, n, LANES),
        **dict.fromkeys(("noise", "early", "normals"), (2, p, LANES)),
    }
    # A lane has space for one sensor: a node with several of them does not fit.
    several = (filters.nodes["sensors"] - filters.nodes["sensor"]).max() > 1
    # -1: nothing is loaded in a lane yet.
    unknown: dict[str, Any] = {
        name: np.full(LANES, -1, dtype=np.int64) for name in ("model", "kind", "noise_row")
    }
    return LaneReadings(
        **{name: with_spare(shape) for name, shape in shapes.items()}, **unknown, alone=int(several)
    )


@kernel
def load_model(readings: LaneReadings, q: int, m: int, whitened_H: FloatArray) -> None:
    """Copy R^-1/2 H of model number ``m`` from ``whitened_H`` (M, q, n) of M models into lane ``q``
    of ``readings.whitened_H``, unless the lane still holds it from an earlier reading.
    """
    if readings.model[q] == m:
        return
    readings.model[q] = m
    for r in range(whitened_H.shape[1]):
        for i in range(whitened_H.shape[2]):
            readings.whitened_H[r, i, q] = whitened_H[m, r, i]


@kernel
def load_sensor(readings: LaneReadings, q: int, sensing: Sensing, s: int) -> None:
    """Copy H and the root of R of sensor ``s`` (0 to S - 1) into lane ``q`` of ``readings.H`` and
    ``readings.root``, unless the lane still holds those of an equal sensor (H and R).
    """
    if readings.kind[q] == sensing.kind[s]:
        return
    readings.kind[q] = sensing.kind[s]
    for i in range(sensing.H.shape[1]):
        for j in range(sensing.H.shape[2]):
            readings.H[0, i, j, q] = sensing.H[s, i, j]
        for j in range(sensing.root.shape[2]):
            readings.root[0, i, j, q] = sensing.root[s, i, j]
        # Rows that a sensor does not have draw nothing.
        readings.normals[0, i, q] = readings.normals[1, i, q] = 0.0


@kernel
def read_alone(
    state: Simulation, r: LaneReadings, run: int, h: int, piece: int, now: float, end: float, q: int
) -> None:
    """Write the readings of one node, in lane ``q`` of ``r.moments`` (q, L), by the scalar
    kernels: for networks in which some node has several sensors, which lanes do not handle. The
    readings are the two moments of each row of increments of node ``h`` (index) of run number
    ``run`` over [now, end] (s); ``piece`` is that of the path in the step of ``end``.
    """
    count = state.gains.moments[state.nodes[h].model]
    found, moments = state.scratch.moments[:count], r.moments
    fill_readings(state, run, h, piece, now, end, found)
    half, rows = len(moments) // 2, count // 2
    for i in range(half):
        # Nodes with fewer rows read zeros, with gains of 0.
        moments[i, q] = found[i] if i < rows else 0.0
        moments[half + i, q] = found[rows + i] if i < rows else 0.0


@kernel
def begin_reading(
    state: Simulation, r: LaneReadings, run: int, h: int, piece: int, now: float, end: float, q: int
) -> None:
    """Prepare the reading of node ``h`` (index) of run number ``run``, which has one sensor, over
    [now, end] (seconds) in lane ``q``: draw its normals and integrate the path of the true state.
    ``piece`` is the index of a piece of the path in the step of the sensing grid that ``end`` lies
    in. ``end_readings`` then computes all lanes at once from what is written to ``r``.
    """
    path, sensing, s = state.path, state.sensing, state.nodes[h].sensor
    load_sensor(r, q, sensing, s)
    r.noise_row[q] = noise_index(sensing, run, s, path.step[piece])
    last, normals = path.last[piece], state.scratch.cut
    r.gap[0, q], r.remaining[0, q] = end - now, last - now
    # The whole rest needs none: what a lane has is multiplied by 0.
    if end < last:
        draw_cut(sensing, run, s, normals)
        for i in range(sensing.rows[s]):
            r.normals[0, i, q], r.normals[1, i, q] = normals[0, i], normals[1, i]
    k = piece_of(path, piece, end)
    start, stop = path.start[k], path.stop[k]
    # A whole piece: its moments are drawn already, no polynomial is needed.
    if now == start and end == stop:
        set_moments(r, q, path.moments[run, k])
        return
    # Several pieces, or parts of them.
    if now < start:
        fill_moments(state, run, piece, now, end)
        set_moments(r, q, state.scratch.state_moments)
        return
    # Inside one piece: integrate the polynomial of x there (its course) up to both ends.
    first, share = (now - start) / (stop - start), (end - now) / (stop - start)
    r.first[0, q], r.share[0, q] = first, share
    course = path.course[run - state.first_run, find_course(state, run, k)]
    fill_integrals(r.rows[q], course, first, first + share)


@kernel
def set_moments(readings: LaneReadings, q: int, moments: FloatArray) -> None:
    """Write known moments of x into lane ``q``, for a reading that takes a whole piece of the path
    or several: ``readings.rows``, ``first`` and ``share`` get values from which ``end_readings``,
    which expects integrals of a polynomial over a part of a piece, computes just these ``moments``
    (2, n), the integrals of x and of x times the Legendre polynomial P_1.
    """
    rows, n = readings.rows, moments.shape[1]
    half = rows.shape[1] // 2
    # ``rows`` holds, for the start and for the end of the reading, the integral of x and that of u
    # x, u from 0 to 1 over the piece: P_1 is 2 u - 1, hence half the sum of both moments.
    readings.first[0, q], readings.share[0, q] = 0.0, 1.0
    for i in range(n):
        rows[q, i] = rows[q, n + i] = 0.0
        rows[q, half + i] = moments[0, i]
        rows[q, half + n + i] = 0.5 * (moments[0, i] + moments[1, i])


@kernel
def end_readings(state: Simulation, readings: LaneReadings) -> None:
    """Write the moments of the readings of all L lanes, which ``begin_reading`` has prepared, into
    ``readings.moments`` (q, L), and take the noise that they use away from ``state.sensing.noise``.

    A reading is H times the integral of x plus noise, with weights 1 and P_1 (Legendre) over its
    interval: its two moments. A lane holds one node; L of them are computed side by side.
    """
    r, size, p = readings, state.size, readings.noise.shape[1]
    # The integrals of x: one row for each lane is turned into one column for each lane.
    for j in range(0, r.rows.shape[1], LANES):
        turn(MANY, r.rows, j, r.integrals)
    first, share = load(MANY, r.first, 0), load(MANY, r.share, 0)
    fill_moments_between(MANY, size, r.x, r.integrals, r.rows.shape[1] // 2, first, share)
    # The noise of each sensor's step is divided where the reading ends; the next one gets the rest.
    step_noise = state.sensing.noise
    for j in range(0, 2 * p, LANES):
        gather(MANY, step_noise, r.noise_row, j, r.noise)
    remaining = load(MANY, r.remaining, 0)
    share_of_noise = load(MANY, r.gap, 0) / remaining
    divide(MANY, r.early, r.noise, r.normals, share_of_noise, remaining)
    for j in range(0, 2 * p, LANES):
        scatter(MANY, r.noise, j, step_noise, r.noise_row, 2 * p - j)
    fill_reading(MANY, size, r.moments, 0, p, r.x, r.H, r.early, r.root, 0)
