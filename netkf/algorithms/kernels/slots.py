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


LANES = 8
"""Covariances that are predicted side by side."""


class Lanes(NamedTuple):
    """Scratch of a prediction: ``root``, ``moved`` and ``noise`` (n, n, LANES), others (LANES,)."""

    root: FloatArray
    moved: FloatArray
    noise: FloatArray
    total: FloatArray
    sign: FloatArray
    pivot: FloatArray
    scale: FloatArray


class SlotRoom(NamedTuple):
    """Scratch: of a sample and of combinations, ``vectors`` (2, n), ``moved`` (n, n), of a
    prediction, and copies of the estimates (H, n) and roots (H, n, n) that are sent.
    """

    update: UpdateScratch
    vectors: FloatArray
    moved: FloatArray
    lanes: Lanes
    xhat: FloatArray
    root: FloatArray


def slot_room(H: int, n: int) -> SlotRoom:
    """Scratch for H filters of n states."""
    wide = [np.zeros((n, n, LANES)) for _ in range(3)]
    lanes = Lanes(*wide, *np.zeros((4, LANES)))
    vectors, moved = np.zeros((2, n)), np.zeros((n, n))
    sent = np.zeros((H, n)), np.zeros((H, n, n))
    return SlotRoom(update_scratch(n, 1), vectors, moved, lanes, *sent)


def whitened(y: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A reading y (p,) and its H (p, n) times ``L^-1``, with ``L L' = R``."""
    # One solve for y and H together.
    made = np.linalg.solve(np.linalg.cholesky(R), np.column_stack([y, H]))
    return np.ascontiguousarray(made[:, 0]), np.ascontiguousarray(made[:, 1:])


@kernel(inlined=True)
def show(nodes: SlotNodes, plan: SlotPlan, samples: SlotSamples, r: int, s: int) -> None:
    """Fill in the sample of slot ``s``, where it is one."""
    k, H, n = plan.sample[s], len(nodes.rows), nodes.xhat.shape[1]
    if k < 0:
        return
    for h in range(H):
        place = r * H + h
        for i in range(n):
            samples.xhat[r, k, h, i] = nodes.xhat[place, i]
            # P = S S', lower triangle and its mirror image, because samples hold covariances.
            for j in range(i + 1):
                total = 0.0
                for m in range(j + 1):
                    total += nodes.root[place, i, m] * nodes.root[place, j, m]
                samples.P[r, k, h, i, j] = samples.P[r, k, h, j, i] = total


@kernel(inlined=True)
def rebase(nodes: SlotNodes, readings: SlotReadings, r: int, s: int) -> None:
    """Count estimates from the state of slot ``s``, where a frame of coordinates begins."""
    # Only the mean moves: a covariance does not depend on the origin.
    if readings.rebased[s]:
        H = len(nodes.rows)
        for h in range(H):
            for i in range(nodes.xhat.shape[1]):
                nodes.xhat[r * H + h, i] -= readings.local[r, s, i]


@kernel(inlined=True)
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
    # H that is fixed has one run and one slot, and r % 1 = 0 finds it.
    rH, sH = r % readings.H.shape[0], s % readings.H.shape[1]
    for row in range(nodes.rows[h]):
        # Scalar update with unit noise: h S and the innovation y - h x with all earlier rows used.
        innovation = readings.y[r, s, h, row]
        for j in range(n):
            total = 0.0
            for i in range(j, n):
                total += readings.H[rH, sH, h, row, i] * nodes.root[place, i, j]
            room.HS[0, j] = total
            innovation -= readings.H[rH, sH, h, row, j] * nodes.xhat[place, j]
        # ``size`` is the standard deviation of the innovation, so the gain is gains / size.
        size = rotate_out(room.size, nodes.root, place, room.HS, 0, room.gains, 1.0)
        for i in range(n):
            nodes.xhat[place, i] += room.gains[0, i] * (innovation / size)


@kernel(inlined=True)
def predict_mean(nodes: SlotNodes, place: int, room: SlotRoom) -> None:
    """Move the estimate of a place to the next slot, ``F xhat``."""
    n = nodes.xhat.shape[1]
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += nodes.F[i, j] * nodes.xhat[place, j]
        room.vectors[0, i] = total
    # F xhat needs all of the old xhat, hence the copy.
    for i in range(n):
        nodes.xhat[place, i] = room.vectors[0, i]


@kernel
def predict(nodes: SlotNodes, room: SlotRoom) -> None:
    """Move all places to the next slot: ``F xhat`` and ``F P F' + Q``."""
    for place in range(len(nodes.xhat)):
        predict_mean(nodes, place, room)
    # Filters of all runs share F and Q, so their covariances are predicted LANES at a time.
    for first in range(0, len(nodes.root), LANES):
        predict_roots(nodes.root, first, nodes.F, nodes.root_Q, room.lanes)


@kernel(inlined=True)
def predict_roots(  # noqa: PLR0912 - loops side by side
    root: FloatArray, first: int, F: FloatArray, root_Q: FloatArray, lanes: Lanes
) -> None:
    """Make LANES places of root (K, n, n) from ``first`` on the lower triangular roots of
    ``F S S' F' + Q``; S and ``root_Q`` (n, n) are lower triangular.

    All are worked on side by side, which the processor does with one instruction for several.
    """
    n, count = root.shape[1], min(LANES, len(root) - first)
    S, moved, noise, total = lanes.root, lanes.moved, lanes.noise, lanes.total
    for i in range(n):
        # Lanes are the last axis: contiguous, so that one load fills a vector register.
        for j in range(i + 1):
            for q in range(count):
                S[i, j, q] = root[first + q, i, j]
    for i in range(n):
        # All LANES are computed even if fewer are used: a constant length compiles to vector code,
        # and the surplus is not stored.
        for j in range(n):
            for q in range(LANES):
                moved[i, j, q] = 0.0
            # F S; S is lower triangular, so the sum begins at m = j.
            for m in range(j, n):
                for q in range(LANES):
                    moved[i, j, q] += F[i, m] * S[m, j, q]
        # A fresh root of Q per lane: the reflections use it up.
        for j in range(i + 1):
            for q in range(LANES):
                noise[i, j, q] = root_Q[i, j]
    # Reflect row by row, as root_flow.transform() does, which leaves a lower triangular root.
    for i in range(n):
        reflect_row(i, n, lanes)
        for r in range(i + 1, n):
            for q in range(LANES):
                total[q] = lanes.pivot[q] * moved[r, i, q]
            for j in range(i + 1, n):
                for q in range(LANES):
                    total[q] += moved[i, j, q] * moved[r, j, q]
            for j in range(i + 1):
                for q in range(LANES):
                    total[q] += noise[i, j, q] * noise[r, j, q]
            # Columns are flipped so that the diagonal stays nonnegative.
            for q in range(LANES):
                total[q] *= lanes.scale[q]
                S[r, i, q] = lanes.sign[q] * (total[q] * lanes.pivot[q] - moved[r, i, q])
            for j in range(i + 1, n):
                for q in range(LANES):
                    moved[r, j, q] -= total[q] * moved[i, j, q]
            for j in range(i + 1):
                for q in range(LANES):
                    noise[r, j, q] -= total[q] * noise[i, j, q]
    for i in range(n):
        for j in range(i + 1):
            for q in range(count):
                root[first + q, i, j] = S[i, j, q]


@kernel(inlined=True)
def reflect_row(i: int, n: int, lanes: Lanes) -> None:
    """Find the reflection from the right that empties row ``i`` of [F S, root_Q] beyond its
    diagonal: the row with ``pivot`` on the diagonal, times ``scale``.
    """
    # The columns of root_Q right of i are still zero here. Signs are those that cancel nothing.
    moved, noise, total = lanes.moved, lanes.noise, lanes.total
    for q in range(LANES):
        total[q] = 0.0
    for j in range(i + 1, n):
        for q in range(LANES):
            total[q] += moved[i, j, q] * moved[i, j, q]
    for j in range(i + 1):
        for q in range(LANES):
            total[q] += noise[i, j, q] * noise[i, j, q]
    for q in range(LANES):
        pivot = moved[i, i, q]
        length = math.sqrt(pivot * pivot + total[q])
        # pivot and its length with one sign: nothing cancels.
        lanes.sign[q] = math.copysign(1.0, pivot)
        lanes.pivot[q] = pivot + lanes.sign[q] * length
        # TINY keeps a row of zeros from dividing by zero: its reflection then only flips a column.
        lanes.scale[q] = 1.0 / (length * (length + abs(pivot)) + TINY)
        lanes.root[i, i, q] = length


def predicted_root(root: FloatArray, F: FloatArray, root_Q: FloatArray) -> FloatArray:
    """The lower triangular root (n, n) of ``F S S' F' + Q``, of lower triangular roots."""
    nodes = SlotNodes(np.zeros((1, len(F))), root[None].copy(), F, root_Q, np.zeros(1, np.int64))
    predict(nodes, slot_room(1, len(F)))
    return np.asarray(nodes.root[0])
