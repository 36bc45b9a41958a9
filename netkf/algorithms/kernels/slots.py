"""Filters in slots, compiled: what the kernels of all of them share.

A filter's kernel (``Filter.slot_kernel``) carries H filters through S slots of R runs in one call.
It is given :class:`SlotNodes` (the state), :class:`ReadingBlock` and :class:`SlotPlan` (what was
drawn for these slots), :class:`SlotLinks` (who hears whom), :class:`SlotSamples` (what it fills in)
and :class:`SlotScratch` (scratch), and works in place.

Runs are side by side in blocks of L lanes (``netkf.linalg.lanes``): what belongs to filter ``h`` of
run ``b L + q`` is ``[b, ..., h, ..., q]``, and kernels compute all lanes of a filter at once. Where
R is no multiple of L, the last lanes of the last block are idle: they hold harmless numbers and are
not sampled.

Readings are whitened: with ``R = L L'`` as the filters believe it, ``L^-1 y`` and ``L^-1 H`` stand
for y and H, so that the noise of each row has variance 1 and rows are used one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    MANY,
    ONE,
    Lanes,
    aligned,
    load,
    magnitude,
    root_of,
    scatter,
    select,
    spread,
    store,
    with_sign,
)
from netkf.linalg.local import local_lanes_matrix, local_lanes_vector
from netkf.linalg.structs import Size, sized

TINY = 1e-200  # far below any length that counts, yet above underflow


class SlotNodes(NamedTuple):
    """The filters of B blocks of runs, and the model that all of them believe.

    xhat, root : (B, H, n, L) and lower triangular (B, H, n, n, L)
    F, root_Q : (n, n), the root lower triangular
    rows : number of rows (H,) that each filter reads
    """

    xhat: FloatArray
    root: FloatArray
    F: FloatArray
    root_Q: FloatArray
    rows: np.ndarray


class ReadingBlock(NamedTuple):
    """Readings of S slots, whitened.

    y : (B, S, H, p, L)
    H : (B, S, H, p, n, L), or (1, 1, H, p, n, L) if it is fixed
    local : the true state (B, S, n, L) in the coordinates of the estimates
    rebased : slots (S,) in which the origin of these moves
    """

    y: FloatArray
    H: FloatArray
    local: FloatArray
    rebased: np.ndarray


WHOLE, SENDING, ARRIVING = range(3)
"""Parts of a slot that a call of a kernel does."""


class SlotPlan(NamedTuple):
    """Number of the ``first`` of S slots; whether nodes read and predict (``sensed``), whether they
    exchange, which sample a slot is or -1 (S, each); ``up`` (B, S, E, W, L): whether a message
    arrives on a direction in each of the E steps of the exchanges of a slot.

    The rest is for filters whose nodes may be silent (``Filter.decides_in_slots``). ``sent``
    (B, S, E, H, L) is 1 where a node is asked for a message; their kernel writes 0 where it sends
    none, and takes those out of ``up`` (``drop_silent``). ``uniform`` (B, S, E, H, L): the number
    that a ``randomised`` filter is given when it is asked. Of other filters both are empty.

    Where messages are made one by one, who sends must be known before anything arrives. A kernel is
    then called twice for each slot, and does the ``part`` up to what is sent, SENDING, without
    ``up``, and the rest, ARRIVING; else the WHOLE slot.
    """

    first: int
    sensed: np.ndarray
    exchanged: np.ndarray
    sample: np.ndarray
    up: np.ndarray
    sent: np.ndarray
    uniform: FloatArray
    part: int


class SlotLinks(NamedTuple):
    """Directed links by receiver: filter h hears those from ``first[h]`` up to ``first[h + 1]``.

    first : (H + 1,)
    sender : index (W,) of the sender
    direction : index (W,) in ``up``
    weight : (W,) that the receiver gives
    """

    first: np.ndarray
    sender: np.ndarray
    direction: np.ndarray
    weight: FloatArray


class SlotSamples(NamedTuple):
    """States x (R, T, n), xhat (R, T, H n) and P (R, T, H n n) in the coordinates of the plant, and
    errors (R, T, H n), all filters side by side; the slot in which each filter stopped learning for
    good, ``stopped`` (B, H, L), and what it holds of K conserved sums at the last sample,
    ``conserved`` (B, H, K, L).

    Of the slots, the states ``absolute`` and ``local`` (B, S, n, L), the latter in the coordinates
    of the estimates, which are the plant's unless they are ``framed``. ``total`` (B, L): the sum of
    all that was shown of xhat and P so far, finite where all of it is.
    """

    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    error: FloatArray
    stopped: np.ndarray
    conserved: FloatArray
    absolute: FloatArray
    local: FloatArray
    framed: bool
    total: FloatArray


class SlotScratch(NamedTuple):
    """The ``size`` n of states, the ``lanes``, and scratch: ``row``, ``gains`` and ``moved_mean``
    (n, L) of a reading and a mean, ``moved`` and ``noise`` (n, n, L) of a prediction, ``whitened``
    and ``total`` (n, n + 1, L) of an intersection, and copies of what is sent, (H, n, L) and (H, n,
    n, L). Of a sample ``sampled_xhat`` and ``sampled_error`` (>= H n, L), ``sampled_P`` (>= H n n,
    L) and the ``sample_rows`` (L,) of its runs.
    """

    size: Size
    lanes: Lanes
    row: FloatArray
    gains: FloatArray
    moved_mean: FloatArray
    moved: FloatArray
    noise: FloatArray
    whitened: FloatArray
    total: FloatArray
    xhat: FloatArray
    root: FloatArray
    sampled_xhat: FloatArray
    sampled_error: FloatArray
    sampled_P: FloatArray
    sample_rows: np.ndarray


def slot_scratch(H: int, n: int, lanes: Lanes = MANY) -> SlotScratch:
    """Return scratch for H filters of n states."""
    L = len(lanes)
    shapes: list[tuple[int, ...]] = [*[(n, L)] * 3, *[(n, n, L)] * 2, *[(n, n + 1, L)] * 2]
    shapes += [(H, n, L), (H, n, n, L)]
    # L entries are moved at a time, which goes beyond the last one.
    shapes += [(H * n + L, L), (H * n + L, L), (H * n * n + L, L)]
    scratch: list[Any] = [aligned(shape) for shape in shapes]
    # Code of its own for each small n pays off for batches of runs alone, and not for one state.
    size = sized(n) if n > 1 and lanes == MANY else np.zeros(n)
    return SlotScratch._make([size, lanes, *scratch, np.zeros(L, dtype=np.int64)])


def whiten_reading(y: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a reading y (p,) and its H (p, n) times ``L^-1``, with ``L L' = R``."""
    # One solve for y and H together.
    made = np.linalg.solve(np.linalg.cholesky(R), np.column_stack([y, H]))
    return np.ascontiguousarray(made[:, 0]), np.ascontiguousarray(made[:, 1:])


def block_of_reading(y: FloatArray, H: FloatArray) -> ReadingBlock:
    """Return a whitened reading y (p,), H (p, n) as that of one filter in one slot, one lane."""
    n = H.shape[1]
    return ReadingBlock(
        np.ascontiguousarray(y).reshape(1, 1, 1, -1, 1),
        np.ascontiguousarray(H).reshape(1, 1, 1, -1, n, 1),
        np.zeros((1, 1, n, 1)),
        np.zeros(1, dtype=bool),
    )


def star_of(weights: Sequence[float]) -> tuple[SlotLinks, np.ndarray]:
    """Return the links of one receiver, index 0, that hears senders 1, 2, ... with
    these ``weights``, and messages (1, 1, 1, W, 1) that all arrive.
    """
    count = len(weights)
    indices = np.arange(count)
    links = SlotLinks(
        np.array([0, count]), indices + 1, indices, np.array(weights, dtype=np.float64)
    )
    return links, np.ones((1, 1, 1, count, 1), dtype=np.uint8)


@kernel
def show(
    nodes: SlotNodes, plan: SlotPlan, samples: SlotSamples, scratch: SlotScratch, b: int, s: int
) -> None:
    """Fill in the samples of a block in slot ``s``, where it is one."""
    k, lanes = plan.sample[s], scratch.lanes
    if k < 0:
        return
    n, first = nodes.xhat.shape[2], b * len(lanes)
    sum_of_all = load(lanes, samples.total, b)
    for h in range(len(nodes.rows)):
        for i in range(n):
            x = load(lanes, nodes.xhat, b, h, i)
            # In the coordinates of the estimates: a difference of large states loses digits.
            local = load(lanes, samples.local, b, s, i)
            store(lanes, scratch.sampled_error, h * n + i, local - x)
            if samples.framed:
                x += load(lanes, samples.absolute, b, s, i) - local
            store(lanes, scratch.sampled_xhat, h * n + i, x)
            sum_of_all += x
            # P = S S', lower triangle and its mirror image, because samples hold covariances.
            for j in range(i + 1):
                total = spread(lanes, 0.0)
                for m in range(j + 1):
                    total += load(lanes, nodes.root, b, h, i, m) * load(
                        lanes, nodes.root, b, h, j, m
                    )
                store(lanes, scratch.sampled_P, (h * n + i) * n + j, total)
                store(lanes, scratch.sampled_P, (h * n + j) * n + i, total)
                sum_of_all += total
    store(lanes, samples.total, b, sum_of_all)
    for q in range(len(lanes)):
        # The last block may have more lanes than runs are left.
        used = first + q < len(samples.x)
        scratch.sample_rows[q] = first + q if used else -1
        for i in range(n if used else 0):
            samples.x[first + q, k, i] = samples.absolute[b, s, i, q]
    hand_out(lanes, scratch.sampled_xhat, samples.xhat[:, k], scratch.sample_rows)
    hand_out(lanes, scratch.sampled_error, samples.error[:, k], scratch.sample_rows)
    hand_out(lanes, scratch.sampled_P, samples.P[:, k], scratch.sample_rows)


@kernel
def hand_out(lanes: Lanes, lines: FloatArray, samples: FloatArray, indices: np.ndarray) -> None:
    """Write the first C ``lines`` (>= C, L) of a block into the ``samples`` (R, C) of its runs."""
    count = samples.shape[1]
    for c in range(0, count, len(lanes)):
        scatter(lanes, lines, c, samples, indices, min(count - c, len(lanes)))


@kernel
def drop_silent(plan: SlotPlan, links: SlotLinks, b: int, s: int, e: int) -> None:
    """Take the messages of nodes that send none in a step out of ``up``."""
    for m in range(len(links.sender)):
        for q in range(plan.up.shape[4]):
            if plan.sent[b, s, e, links.sender[m], q] == 0:
                plan.up[b, s, e, links.direction[m], q] = 0


@kernel
def rebase(nodes: SlotNodes, readings: ReadingBlock, scratch: SlotScratch, b: int, s: int) -> None:
    """Count estimates from the state of slot ``s``, where a frame of coordinates begins."""
    # Only the mean moves: a covariance does not depend on the origin.
    if readings.rebased[s]:
        for h in range(len(nodes.rows)):
            for i in range(nodes.xhat.shape[2]):
                x = load(scratch.lanes, nodes.xhat, b, h, i)
                origin = load(scratch.lanes, readings.local, b, s, i)
                store(scratch.lanes, nodes.xhat, b, h, i, x - origin)


@kernel
def read_all(
    nodes: SlotNodes, readings: ReadingBlock, scratch: SlotScratch, b: int, s: int
) -> None:
    """Update all filters of a block with their own readings of slot ``s``."""
    for h in range(len(nodes.rows)):
        update_by_reading(nodes, readings, scratch, b, s, h, h, True)


@kernel(inlined=True)
def update_by_reading(
    nodes: SlotNodes,
    readings: ReadingBlock,
    scratch: SlotScratch,
    b: int,
    s: int,
    h: int,
    sender: int,
    arrived: Any,
) -> None:
    """Update filter ``h`` of a block with the reading of filter ``sender`` in slot ``s``, in the
    lanes where it has ``arrived``.
    """
    lanes, size, n = scratch.lanes, scratch.size, len(scratch.size)
    row = local_lanes_vector(size, lanes, scratch.row)
    gains = local_lanes_vector(size, lanes, scratch.gains)
    # H that is fixed has one block and one slot.
    c, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    for k in range(nodes.rows[sender]):
        # Scalar update with unit noise: h S and the innovation y - h x with all earlier rows used.
        innovation = load(lanes, readings.y, b, s, sender, k)
        for j in range(n):
            total = spread(lanes, 0.0)
            for i in range(j, n):
                weight = load(lanes, readings.H, c, t, sender, k, i)
                total += weight * load(lanes, nodes.root, b, h, i, j)
            # A row of zeros changes nothing.
            store(lanes, row, j, select(arrived, total, 0.0))
            weight = load(lanes, readings.H, c, t, sender, k, j)
            innovation -= weight * load(lanes, nodes.xhat, b, h, j)
        step = innovation * rotate_lanes(lanes, size, nodes.root, b, h, row, gains)
        for i in range(n):
            x = load(lanes, nodes.xhat, b, h, i)
            store(lanes, nodes.xhat, b, h, i, x + load(lanes, gains, i) * step)


@kernel(inlined=True)
def rotate_lanes(
    lanes: Lanes,
    size: Size,
    root: FloatArray,
    b: int,
    h: int,
    row: FloatArray,
    gains: FloatArray,
) -> Any:
    """Use the scalar observation with ``h S = row`` (n, L) and unit noise; the gain is ``gains``
    (n, L) times the value that is returned, 1 over the standard deviation of the innovation.

    These are the rotations of ``root_update.rotate_out``; an entry of 0 turns nothing.
    """
    n = len(size)
    for i in range(n):
        store(lanes, gains, i, 0.0)
    # [1, h S; 0, S] times rotations that empty h S from its end, so that S stays triangular.
    pivot = square = over_pivot = spread(lanes, 1.0)
    for j in range(n - 1, -1, -1):
        entry = load(lanes, row, j)
        square += entry * entry
        whole = root_of(square)
        inverse = 1.0 / whole
        # Exactly 1 for an entry of 0, so that not even rounding touches the root.
        idle = entry == 0.0
        c, s = select(idle, 1.0, pivot * inverse), entry * inverse
        pivot, over_pivot = select(idle, pivot, whole), select(idle, over_pivot, inverse)
        # Rotate column j of [h S; S] into the column of the gain.
        for i in range(j, n):
            old, gain = load(lanes, root, b, h, i, j), load(lanes, gains, i)
            store(lanes, root, b, h, i, j, c * old - s * gain)
            store(lanes, gains, i, s * old + c * gain)
    return over_pivot


@kernel
def predict_all(nodes: SlotNodes, scratch: SlotScratch, b: int) -> None:
    """Move all filters of a block to the next slot: ``F xhat`` and ``F P F' + Q``."""
    for h in range(len(nodes.rows)):
        predict_mean(nodes, scratch, b, h)
        move_root(scratch, nodes.root, b, h, nodes.F, nodes.root_Q)


@kernel(inlined=True)
def predict_mean(nodes: SlotNodes, scratch: SlotScratch, b: int, h: int) -> None:
    """Move the estimate of a filter to the next slot, ``F xhat``."""
    transform_mean(scratch, nodes.xhat, b, h, nodes.F)


@kernel(inlined=True)
def transform_mean(scratch: SlotScratch, x: FloatArray, b: int, h: int, F: FloatArray) -> None:
    """Multiply estimate [b, h] of ``x`` (B, H, n, L) by F."""
    lanes, n = scratch.lanes, len(scratch.size)
    moved_mean = local_lanes_vector(scratch.size, lanes, scratch.moved_mean)
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(n):
            total += F[i, j] * load(lanes, x, b, h, j)
        store(lanes, moved_mean, i, total)
    # F xhat needs all of the old xhat, hence the copy.
    for i in range(n):
        store(lanes, x, b, h, i, load(lanes, moved_mean, i))


@kernel(inlined=True)
def move_root(
    scratch: SlotScratch, root: FloatArray, b: int, h: int, F: FloatArray, root_Q: FloatArray
) -> None:
    """Apply ``predict_root`` with ``scratch``."""
    predict_root(scratch.lanes, scratch.size, root, b, h, F, root_Q, scratch.moved, scratch.noise)


@kernel(inlined=True)
def predict_root(
    lanes: Lanes,
    size: Size,
    root: FloatArray,
    b: int,
    h: int,
    F: FloatArray,
    root_Q: FloatArray,
    moved_scratch: FloatArray,
    noise_scratch: FloatArray,
) -> None:
    """Make the lower triangular root S of filter ``h`` of a block that of ``F S S' F' + Q``;
    ``root_Q`` (n, n) is lower triangular; ``moved_scratch`` and ``noise_scratch`` (n, n, L) are
    scratch of a large n.
    """
    n = len(size)
    moved = local_lanes_matrix(size, lanes, moved_scratch)
    noise = local_lanes_matrix(size, lanes, noise_scratch)
    for i in range(n):
        # F S; S is lower triangular, so the sum begins at m = j.
        for j in range(n):
            total = spread(lanes, 0.0)
            for m in range(j, n):
                total += F[i, m] * load(lanes, root, b, h, m, j)
            store(lanes, moved, i, j, total)
        # A fresh root of Q per lane: the reflections use it up.
        for j in range(i + 1):
            store(lanes, noise, i, j, root_Q[i, j])
    # Reflect [F S, root_Q] from the right, row by row, which leaves a lower triangular root.
    for i in range(n):
        write_root_column(lanes, size, root, b, h, i, moved, noise)


@kernel(inlined=True)
def write_root_column(
    lanes: Lanes,
    size: Size,
    root: FloatArray,
    b: int,
    h: int,
    i: int,
    moved: FloatArray,
    noise: FloatArray,
) -> None:
    """Write column ``i`` of the triangular root of ``[moved, noise]``: the reflection that empties
    row ``i`` beyond its diagonal, applied to the rows below.
    """
    # The columns of root_Q right of i are still zero here.
    n, pivot, beyond = len(size), load(lanes, moved, i, i), spread(lanes, 0.0)
    for j in range(i + 1, n):
        entry = load(lanes, moved, i, j)
        beyond += entry * entry
    for j in range(i + 1):
        entry = load(lanes, noise, i, j)
        beyond += entry * entry
    length = root_of(pivot * pivot + beyond)
    # pivot and its length with one sign: nothing cancels.
    sign = with_sign(spread(lanes, 1.0), pivot)
    head = pivot + sign * length
    # Columns are flipped so that the diagonal stays nonnegative.
    store(lanes, root, b, h, i, i, length)
    if i == n - 1:
        return
    # TINY keeps a row of zeros from dividing by zero: its reflection then only flips a column.
    scale = 1.0 / (length * (length + magnitude(pivot)) + TINY)
    for r in range(i + 1, n):
        first = load(lanes, moved, r, i)
        total = head * first
        for j in range(i + 1, n):
            total += load(lanes, moved, i, j) * load(lanes, moved, r, j)
        for j in range(i + 1):
            total += load(lanes, noise, i, j) * load(lanes, noise, r, j)
        total *= scale
        store(lanes, root, b, h, r, i, sign * (total * head - first))
        for j in range(i + 1, n):
            entry = load(lanes, moved, r, j) - total * load(lanes, moved, i, j)
            store(lanes, moved, r, j, entry)
        for j in range(i + 1):
            entry = load(lanes, noise, r, j) - total * load(lanes, noise, i, j)
            store(lanes, noise, r, j, entry)


@kernel
def predict_root_single(
    root: FloatArray, F: FloatArray, root_Q: FloatArray, moved: FloatArray, noise: FloatArray
) -> None:
    """Apply ``predict_root`` to one filter with one lane, root (1, 1, n, n, 1)."""
    predict_root(ONE, F[0], root, 0, 0, F, root_Q, moved, noise)


def predict_root_alone(root: FloatArray, F: FloatArray, root_Q: FloatArray) -> FloatArray:
    """Return the lower triangular root (n, n) of ``F S S' F' + Q``, of lower triangular roots."""
    n = len(F)
    moved = np.array(root).reshape(1, 1, n, n, 1)
    predict_root_single(moved, F, root_Q, np.empty((n, n, 1)), np.empty((n, n, 1)))
    return np.asarray(moved.reshape(n, n))
