"""Filters in slots, compiled: what the kernels of all of them share.

A filter's kernel (``Filter.slot_kernel``) carries H filters through S slots of R runs in one call.
It is given :class:`SlotNodes` (the state), :class:`SlotReadings` and :class:`SlotPlan` (what was
drawn for these slots), :class:`SlotLinks` (who hears whom), :class:`SlotSamples` (what it fills in)
and :class:`SlotRoom` (scratch), and works in place: filter ``h`` of run ``r`` is place ``r H + h``.

Readings are whitened: with ``R = L L'`` as the filters believe it, ``L^-1 y`` and ``L^-1 H`` stand
for y and H, so that the noise of each row has variance 1 and rows are used one after the other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.root_update import (
    NEGLIGIBLE,
    TINY,
    UpdateScratch,
    rotate_out,
    update_scratch,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel


class SlotNodes(NamedTuple):
    """xhat (R H, n) and lower triangular root (R H, n, n); F and root of Q (n, n, lower triangular)
    that all filters believe; how many rows each filter reads, ``rows`` (H,).
    """

    xhat: FloatArray
    root: FloatArray
    F: FloatArray
    root_Q: FloatArray
    rows: np.ndarray


class SlotReadings(NamedTuple):
    """Whitened readings y (R, S, H, p) and H (R, S, H, p, n), or (1, 1, H, p, n) if it is fixed;
    the truth ``local`` (R, S, n) in the coordinates of the estimates, whose origin moves there in
    slots that are ``rebased`` (S,).
    """

    y: FloatArray
    H: FloatArray
    local: FloatArray
    rebased: np.ndarray


class SlotPlan(NamedTuple):
    """Number of the ``first`` of S slots; whether nodes read and predict (``sensed``), whether they
    exchange, which sample a slot is or -1 (S, each); ``up`` (R, S, E, W): whether a message arrives
    on a direction in each of the E steps of the exchanges of a slot.
    """

    first: int
    sensed: np.ndarray
    exchanged: np.ndarray
    sample: np.ndarray
    up: np.ndarray


class SlotLinks(NamedTuple):
    """The directions that filter h may hear are those from ``first[h]`` (H + 1,) to
    ``first[h + 1]``, by ``sender`` (W,), with their place in ``up`` (``way``) and their ``weight``.
    """

    first: np.ndarray
    sender: np.ndarray
    way: np.ndarray
    weight: FloatArray


class SlotSamples(NamedTuple):
    """xhat (R, T, H, n) and P (R, T, H, n, n); the slot in which each filter stopped learning for
    good, ``stopped`` (R, H), and what it holds of conserved sums at the last sample, (R, H, K).
    """

    xhat: FloatArray
    P: FloatArray
    stopped: np.ndarray
    conserved: FloatArray


class SlotRoom(NamedTuple):
    """Scratch: of a sample and of combinations, ``vectors`` (2, n), of a prediction (n, n) twice,
    and copies of the estimates (H, n) and roots (H, n, n) that are sent.
    """

    update: UpdateScratch
    vectors: FloatArray
    moved: FloatArray
    noise: FloatArray
    xhat: FloatArray
    root: FloatArray


def slot_room(H: int, n: int) -> SlotRoom:
    """Scratch for H filters of n states."""
    shapes = ((2, n), (n, n), (n, n), (H, n), (H, n, n))
    return SlotRoom(update_scratch(n, 1), *(np.zeros(shape) for shape in shapes))


def whitened(y: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A reading y (p,) and its H (p, n) times ``L^-1``, with ``L L' = R``."""
    made = np.linalg.solve(np.linalg.cholesky(R), np.column_stack([y, H]))
    return np.ascontiguousarray(made[:, 0]), np.ascontiguousarray(made[:, 1:])


@kernel
def show(nodes: SlotNodes, plan: SlotPlan, samples: SlotSamples, r: int, s: int) -> None:
    """Fill in the sample of slot ``s``, where it is one."""
    k, H, n = plan.sample[s], len(nodes.rows), nodes.xhat.shape[1]
    if k < 0:
        return
    for h in range(H):
        place = r * H + h
        for i in range(n):
            samples.xhat[r, k, h, i] = nodes.xhat[place, i]
            for j in range(i + 1):
                total = 0.0
                for m in range(j + 1):
                    total += nodes.root[place, i, m] * nodes.root[place, j, m]
                samples.P[r, k, h, i, j] = samples.P[r, k, h, j, i] = total


@kernel
def rebase(nodes: SlotNodes, readings: SlotReadings, r: int, s: int) -> None:
    """Count estimates from the state of slot ``s``, where a frame of coordinates begins."""
    if readings.rebased[s]:
        H = len(nodes.rows)
        for h in range(H):
            for i in range(nodes.xhat.shape[1]):
                nodes.xhat[r * H + h, i] -= readings.local[r, s, i]


@kernel
def use_reading(
    nodes: SlotNodes,
    place: int,
    readings: SlotReadings,
    r: int,
    s: int,
    h: int,
    room: UpdateScratch,
) -> None:
    """Update a place with the reading of filter ``h`` in slot ``s`` of run ``r``."""
    n = nodes.xhat.shape[1]
    rH, sH = r % readings.H.shape[0], s % readings.H.shape[1]
    for row in range(nodes.rows[h]):
        innovation = readings.y[r, s, h, row]
        for j in range(n):
            total = 0.0
            for i in range(j, n):
                total += readings.H[rH, sH, h, row, i] * nodes.root[place, i, j]
            room.HS[0, j] = total
            innovation -= readings.H[rH, sH, h, row, j] * nodes.xhat[place, j]
        size = rotate_out(nodes.root, place, room.HS, 0, room.gains, 1.0)
        for i in range(n):
            nodes.xhat[place, i] += room.gains[0, i] * (innovation / size)


@kernel
def predict(nodes: SlotNodes, place: int, room: SlotRoom) -> None:
    """Move a place to the next slot: ``F xhat`` and ``F P F' + Q``."""
    predict_mean(nodes, place, room)
    predict_root(nodes.root, place, nodes.F, nodes.root_Q, room.moved, room.noise)


@kernel
def predict_mean(nodes: SlotNodes, place: int, room: SlotRoom) -> None:
    """Move the estimate of a place to the next slot, ``F xhat``."""
    n = nodes.xhat.shape[1]
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += nodes.F[i, j] * nodes.xhat[place, j]
        room.vectors[0, i] = total
    for i in range(n):
        nodes.xhat[place, i] = room.vectors[0, i]


@kernel
def predict_root(  # noqa: PLR0912 - one elimination, written as loops
    root: FloatArray,
    k: int,
    F: FloatArray,
    root_Q: FloatArray,
    moved: FloatArray,
    noise: FloatArray,
) -> None:
    """Make place ``k`` of root (K, n, n) the lower triangular root of ``F S S' F' + Q``; S and
    ``root_Q`` (n, n) are lower triangular, ``moved`` and ``noise`` (n, n) are scratch.
    """
    n = root.shape[1]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for m in range(j, n):
                total += F[i, m] * root[k, m, j]
            moved[i, j] = total
        for j in range(i + 1):
            noise[i, j] = root_Q[i, j]
    # Reflections from the right empty row i of [F S, root_Q] beyond its diagonal; the columns of
    # root_Q right of i are still zero then.
    for i in range(n):
        rest, pivot = 0.0, moved[i, i]
        for j in range(i + 1, n):
            rest += moved[i, j] * moved[i, j]
        for j in range(i + 1):
            rest += noise[i, j] * noise[i, j]
        if rest <= NEGLIGIBLE * pivot * pivot + TINY:
            sign = math.copysign(1.0, pivot)
            for r in range(i, n):
                root[k, r, i] = sign * moved[r, i]
            continue
        length = math.sqrt(pivot * pivot + rest)
        first = -rest / (pivot + length) if pivot > 0.0 else pivot - length
        scale = -1.0 / (length * first)
        root[k, i, i] = length
        for r in range(i + 1, n):
            total = first * moved[r, i]
            for j in range(i + 1, n):
                total += moved[i, j] * moved[r, j]
            for j in range(i + 1):
                total += noise[i, j] * noise[r, j]
            total *= scale
            root[k, r, i] = moved[r, i] - total * first
            for j in range(i + 1, n):
                moved[r, j] -= total * moved[i, j]
            for j in range(i + 1):
                noise[r, j] -= total * noise[i, j]


def predicted_root(root: FloatArray, F: FloatArray, root_Q: FloatArray) -> FloatArray:
    """The lower triangular root (n, n) of ``F S S' F' + Q``, of lower triangular roots."""
    result, (moved, noise) = root[None].copy(), np.empty((2, *root.shape))
    predict_root(result, 0, F, root_Q, moved, noise)
    return np.asarray(result[0])
