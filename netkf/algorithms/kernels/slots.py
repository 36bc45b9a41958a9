"""Structs and kernels that all compiled filters in slots share.

In a slot, one time step, nodes read their sensors, exchange messages in E steps and predict, in the
order of the filter. A filter's kernel (``Filter.slot_kernel``), which the compiled engine calls,
simulates H filters over S slots of R runs in one call, in place. Its arguments are
:class:`SlotNodes` (states of the filters), :class:`ReadingBlock` and :class:`SlotPlan` (readings
and messages drawn for these slots), :class:`SlotLinks` (the network), :class:`SlotSamples` (output)
and :class:`SlotScratch`.

Runs are side by side in blocks of L lanes (``netkf.linalg.lanes``): an entry of filter ``h`` of run
``b L + q`` has the indices ``[b, ..., h, ..., q]``, and kernels compute all lanes of a filter at
once. If R is no multiple of L, the last lanes of the last block are idle: they hold harmless
numbers and are not sampled. ``s`` is the index of a slot, ``e`` of a step of its exchanges.

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

TINY = 1e-290  # below any squared length of a row that counts, yet above underflow


class SlotNodes(NamedTuple):
    """The filters of B blocks of L runs each, and the model that all of them believe.

    xhat, root : estimates (B, H, n, L) of H filters, and lower triangular roots (B, H, n, n, L) of
                 their covariances
    F, root_Q : (n, n), transition of a slot, and the lower triangular root of its noise covariance
    rows : number of rows (H,) of each filter's reading
    """

    xhat: FloatArray
    root: FloatArray
    F: FloatArray
    root_Q: FloatArray
    rows: np.ndarray


class ReadingBlock(NamedTuple):
    """Whitened readings ``y = H x + v`` of S slots in B blocks of L runs; H filters have at most p
    rows each. A recorded sensor without a reading in a slot has rows of zeros, which change
    nothing.

    y : (B, S, H, p, L)
    H : (B, S, H, p, n, L), or (1, 1, H, p, n, L) if it is fixed
    local : the true state (B, S, n, L) in the coordinates of the estimates
    rebased : flags (S,) of the slots in which the origin of these coordinates moves
    """

    y: FloatArray
    H: FloatArray
    local: FloatArray
    rebased: np.ndarray


WHOLE, SENDING, ARRIVING = range(3)
"""The part of a slot that a call of a kernel simulates, see SlotPlan."""


class SlotPlan(NamedTuple):
    """What happens in S slots of B blocks of L runs, with E steps of the exchanges in each slot, W
    directed links and H filters.

    first : number of the first slot
    sensed, exchanged : (S,), whether nodes read and predict, and whether they exchange;
        nodes do not read or predict in slot 0 if its sample shows their initial estimates
    sample : (S,), index of the slot's sample, -1: none
    up : (B, S, E, W, L), 1 if a message arrives on a directed link in a step of the exchanges
    sent : (B, S, E, H, L), 1 if a node is asked for a message
    uniform : (B, S, E, H, L), uniform number for the decision of a node that is asked
    part : WHOLE, SENDING or ARRIVING

    ``sent`` is empty unless nodes may be silent (``Filter.decides_in_slots``); then the kernel
    writes 0 where a node sends nothing, and removes these messages from ``up`` (``drop_silent``).
    ``uniform`` is empty unless the filter is ``randomised``.

    If Python makes the messages one by one, it must know who sends before anything arrives. Then a
    kernel is called twice for each slot: for the part up to sending, SENDING, without ``up``, and
    for the rest, ARRIVING. Otherwise one call simulates the WHOLE slot.
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
    """W directed links by receiver: those to filter h are ``first[h]`` to ``first[h + 1]`` - 1.

    first : (H + 1,)
    sender : index (W,) of the sending filter
    direction : index (W,) in the axis W of ``SlotPlan.up``
    weight : (W,) that the receiver gives to the sender
    """

    first: np.ndarray
    sender: np.ndarray
    direction: np.ndarray
    weight: FloatArray


class SlotSamples(NamedTuple):
    """T samples of R runs that a kernel writes, and the true states of S slots that they need.

    x, xhat, P : (R, T, n), (R, T, H n) and (R, T, H n n) in the coordinates of the plant, with all
                 filters side by side
    error : (R, T, H n), x - xhat
    stopped : (B, H, L), slot in which each filter permanently froze its network estimate
    conserved : (B, H, K, L), shares of each filter in K sums over the network that messages
                conserve (push-sum), at the last sample
    absolute, local : (B, S, n, L), true states in all slots, in the coordinates of the plant and
                      relative to the moving origin that estimates refer to
    framed : whether the origin moves; otherwise both are the same
    total : (B, L), sum of all samples of xhat and P so far: finite if all of them are
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
    """The ``size`` n of states, the ``lanes``, and scratch arrays.

    row, gains, moved_mean : (n, L), for updates by a row of a reading, and for means
    moved, noise : (n, n, L), for predictions of roots
    whitened, total : (n, n + 1, L), for intersections
    xhat, root : (H, n, L) and (H, n, n, L), copies of the states that filters send
    sampled_xhat, sampled_error, sampled_P : (>= H n, L), (>= H n, L) and (>= H n n, L), a sample
    sample_rows : (L,), the run of each lane, -1 if it is idle
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


def slot_scratch(H: int, n: int, unrolled: bool, lanes: Lanes = MANY) -> SlotScratch:
    """Return scratch for H filters of n states and L ``lanes``; ``unrolled``: of a type that knows
    n, if it is small, so that kernels are compiled for this n with their loops unrolled.
    """
    L = len(lanes)
    shapes: list[tuple[int, ...]] = [*[(n, L)] * 3, *[(n, n, L)] * 2, *[(n, n + 1, L)] * 2]
    shapes += [(H, n, L), (H, n, n, L)]
    # L entries are copied at a time, so that the last copy may go beyond the last entry.
    shapes += [(H * n + L, L), (H * n + L, L), (H * n * n + L, L)]
    scratch: list[Any] = [aligned(shape) for shape in shapes]
    # Loops over one state need no unrolling.
    size = sized(n) if unrolled and n > 1 else np.zeros(n)
    return SlotScratch._make([size, lanes, *scratch, np.zeros(L, dtype=np.int64)])


def whiten_reading(y: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the whitened reading ``L^-1 y`` (p,) and ``L^-1 H`` (p, n) of a reading y (p,) with H
    (p, n) and noise covariance ``R = L L'`` (p, p), so that the noise of its rows is white with
    variance 1.
    """
    # One solve for y and H together.
    whitened = np.linalg.solve(np.linalg.cholesky(R), np.column_stack([y, H]))
    return np.ascontiguousarray(whitened[:, 0]), np.ascontiguousarray(whitened[:, 1:])


def block_of_reading(y: FloatArray, H: FloatArray) -> ReadingBlock:
    """Return a whitened reading y (p,), H (p, n) as a block of one filter, one slot and one lane,
    so that filters in Python call the kernels of slots and get the same bits.
    """
    n = H.shape[1]
    return ReadingBlock(
        np.ascontiguousarray(y).reshape(1, 1, 1, -1, 1),
        np.ascontiguousarray(H).reshape(1, 1, 1, -1, n, 1),
        np.zeros((1, 1, n, 1)),
        np.zeros(1, dtype=bool),
    )


def star_of(weights: Sequence[float]) -> tuple[SlotLinks, np.ndarray]:
    """Return links and flags of a star: from senders 1, 2, ... to the one receiver 0, with the
    ``weights`` (one of each of W senders), and the array ``up`` (1, 1, 1, W, 1) that lets all their
    messages arrive. A filter in Python, which has only the messages that arrived, passes them to
    the kernels of slots in this way.

    Axes: W directed links.
    """
    count = len(weights)
    indices = np.arange(count)
    links = SlotLinks(
        np.array([0, count]), indices + 1, indices, np.array(weights, dtype=np.float64)
    )
    return links, np.ones((1, 1, 1, count, 1), dtype=np.uint8)


@kernel
def store_sample_of_slot(
    nodes: SlotNodes, plan: SlotPlan, samples: SlotSamples, scratch: SlotScratch, b: int, s: int
) -> None:
    """Write the sample of slot ``s``, if it has one, of the L runs of block ``b``.

    Fills ``x``, ``xhat``, ``error`` and ``P`` of ``samples`` at index ``plan.sample[s]`` of their
    axis T, for all H filters of these runs, and adds the entries of xhat and of the lower triangles
    of P to ``samples.total[b]`` (L,), by which the caller finds runs that diverged.
    """
    k, lanes = plan.sample[s], scratch.lanes
    if k < 0:
        return
    n, first = nodes.xhat.shape[2], b * len(lanes)
    sum_of_all = load(lanes, samples.total, b)
    for h in range(len(nodes.rows)):
        for i in range(n):
            x = load(lanes, nodes.xhat, b, h, i)
            # Relative to the moving origin: a difference of large absolute states loses digits.
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
        # The last block may have more lanes than there are runs left.
        used = first + q < len(samples.x)
        scratch.sample_rows[q] = first + q if used else -1
        for i in range(n if used else 0):
            samples.x[first + q, k, i] = samples.absolute[b, s, i, q]
    scatter_sample(lanes, scratch.sampled_xhat, samples.xhat[:, k], scratch.sample_rows)
    scatter_sample(lanes, scratch.sampled_error, samples.error[:, k], scratch.sample_rows)
    scatter_sample(lanes, scratch.sampled_P, samples.P[:, k], scratch.sample_rows)


@kernel
def scatter_sample(
    lanes: Lanes, values: FloatArray, samples: FloatArray, indices: np.ndarray
) -> None:
    """Write one sample of L lanes (runs side by side) into the arrays of all R runs: the first C
    rows of ``values`` (>= C, L) into ``samples`` (R, C), lane q into row ``indices[q]`` (L,); -1:
    no run.
    """
    count = samples.shape[1]
    for c in range(0, count, len(lanes)):
        scatter(lanes, values, c, samples, indices, min(count - c, len(lanes)))


@kernel
def drop_silent(plan: SlotPlan, links: SlotLinks, b: int, s: int, e: int) -> None:
    """Set ``plan.up`` (B, S, E, W, L) to 0 for the messages of nodes that send nothing in step
    ``e`` of the exchanges of slot ``s``, in each of the L runs of block ``b``: those with 0 in
    ``plan.sent`` (B, S, E, H, L).

    Axes: B blocks of runs, S slots, E exchange steps, W directed links, H filters.
    """
    for m in range(len(links.sender)):
        for q in range(plan.up.shape[4]):
            if plan.sent[b, s, e, links.sender[m], q] == 0:
                plan.up[b, s, e, links.direction[m], q] = 0


@kernel
def rebase(nodes: SlotNodes, readings: ReadingBlock, scratch: SlotScratch, b: int, s: int) -> None:
    """Move the origin that all estimates of block ``b`` refer to, if ``readings.rebased[s]``:
    subtract the true state of slot ``s``, ``readings.local[b, s]`` (n, L), from ``nodes.xhat[b]``
    (H, n, L).

    An origin near the state keeps estimates small, so that large absolute states cost no digits.
    Filters are affine in it: errors do not change. Axes: H filters, L runs side by side.
    """
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
    """Update all filters of block ``b`` with their own readings of slot ``s``: changes
    ``nodes.xhat[b]`` (H, n, L) and ``nodes.root[b]`` (H, n, n, L) for H filters in L runs side by
    side.
    """
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
    """Update filter ``h`` of block ``b`` with the whitened reading of filter ``sender`` in slot
    ``s``, in the lanes (runs) whose flag in ``arrived`` (L,) is set; True: all.

    Changes ``nodes.xhat[b, h]`` (n, L) and ``nodes.root[b, h]`` (n, n, L), row by row of the
    reading ``readings.y[b, s, sender]`` (p, L): ``x += P h' (h P h' + 1)^-1 (y - h x)``.
    """
    lanes, size, n = scratch.lanes, scratch.size, len(scratch.size)
    row = local_lanes_vector(size, lanes, scratch.row)
    gains = local_lanes_vector(size, lanes, scratch.gains)
    # A fixed H is stored for one block and one slot only.
    c, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    for k in range(nodes.rows[sender]):
        # Scalar update with unit noise by row h of H: h S, and the innovation y - h x with all
        # earlier rows used.
        innovation = load(lanes, readings.y, b, s, sender, k)
        for j in range(n):
            total = spread(lanes, 0.0)
            for i in range(j, n):
                weight = load(lanes, readings.H, c, t, sender, k, i)
                total += weight * load(lanes, nodes.root, b, h, i, j)
            # In lanes without the message a row of zeros, which changes nothing.
            store(lanes, row, j, select(arrived, total, 0.0))
            weight = load(lanes, readings.H, c, t, sender, k, j)
            innovation -= weight * load(lanes, nodes.xhat, b, h, j)
        # x += K (y - h x), with the gain K = gains / (standard deviation of the innovation).
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
    """Update ``root[b, h]`` (n, n, L), the lower triangular root S of filter ``h`` of block ``b``
    in L runs, in place with the scalar observation ``h S = row`` (n, L) of unit noise.

    Return 1 over the standard deviation of the innovation, (L,); the Kalman gain is this number
    times ``gains`` (n, L), which are written. The rotations are those of
    ``root_update.rotate_out``; an entry of 0 rotates nothing.
    """
    n = len(size)
    for i in range(n):
        store(lanes, gains, i, 0.0)
    # [1, h S; 0, S] times rotations that empty h S from its end, so that S stays triangular.
    pivot = square = over_pivot = spread(lanes, 1.0)
    for j in range(n - 1, -1, -1):
        entry = load(lanes, row, j)
        square += entry * entry
        length = root_of(square)
        inverse = 1.0 / length
        # Exactly 1 for an entry of 0, so that not even rounding touches the root.
        idle = entry == 0.0
        c, s = select(idle, 1.0, pivot * inverse), entry * inverse
        pivot, over_pivot = select(idle, pivot, length), select(idle, over_pivot, inverse)
        # Rotate column j of [h S; S] into the column of the gain.
        for i in range(j, n):
            old, gain = load(lanes, root, b, h, i, j), load(lanes, gains, i)
            store(lanes, root, b, h, i, j, c * old - s * gain)
            store(lanes, gains, i, s * old + c * gain)
    return over_pivot


@kernel
def predict_all(nodes: SlotNodes, scratch: SlotScratch, b: int) -> None:
    """Predict all H filters of block ``b`` to the next slot, in place: ``nodes.xhat[b]`` (H, n, L)
    to ``F xhat``, and ``nodes.root[b]`` (H, n, n, L) to the root of ``F P F' + Q``.

    Axes: L runs side by side.
    """
    for h in range(len(nodes.rows)):
        predict_mean(nodes, scratch, b, h)
        move_root(scratch, nodes.root, b, h, nodes.F, nodes.root_Q)


@kernel(inlined=True)
def predict_mean(nodes: SlotNodes, scratch: SlotScratch, b: int, h: int) -> None:
    """Replace ``nodes.xhat[b, h]`` (n, L), the estimate of filter ``h`` of block ``b``, by
    ``F xhat`` for the next slot.

    Axes: L runs side by side.
    """
    transform_mean(scratch, nodes.xhat, b, h, nodes.F)


@kernel(inlined=True)
def transform_mean(scratch: SlotScratch, x: FloatArray, b: int, h: int, F: FloatArray) -> None:
    """Multiply estimate ``x[b, h]`` of ``x`` (B, H, n, L), filter ``h`` of block ``b``, by F (n, n)
    in place, in all L runs of the block.

    Axes: B blocks of runs, H filters.
    """
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
    """Replace ``root[b, h]`` of ``root`` (B, H, n, n, L), the lower triangular root S of filter
    ``h`` of block ``b``, by that of ``F S S' F' + Q``, with F and ``root_Q`` (n, n); uses
    ``scratch``.

    Axes: B blocks of L runs, H filters.
    """
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
    """Replace ``root[b, h]`` of ``root`` (B, H, n, n, L), the lower triangular root S of filter
    ``h`` of block ``b`` in L runs, by that of ``F S S' F' + Q``.

    ``F`` and the lower triangular ``root_Q`` are (n, n). ``moved_scratch`` and ``noise_scratch``
    (n, n, L) are used if n is too large for registers. Axes: B blocks of runs, H filters.
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
        # A copy of the root of Q in each lane, since the reflections overwrite it.
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
    """Write column ``i`` of the triangular root of ``[moved, noise]``, both (n, n, L), into
    ``root[b, h]`` of ``root`` (B, H, n, n, L): apply the Householder reflection that zeroes row
    ``i`` right of its diagonal to the rows below, which changes ``moved`` and ``noise`` in place.

    Axes: B blocks of L runs, H filters.
    """
    # The squared length of row i; the columns of ``noise`` right of i are still zero here.
    n, pivot, square = len(size), load(lanes, moved, i, i), spread(lanes, 0.0)
    for j in range(i + 1, n):
        entry = load(lanes, moved, i, j)
        square += entry * entry
    for j in range(i + 1):
        entry = load(lanes, noise, i, j)
        square += entry * entry
    length = root_of(pivot * pivot + square)
    # head = pivot + sign(pivot) length: nothing cancels.
    sign = with_sign(spread(lanes, 1.0), pivot)
    head = pivot + sign * length
    # The sign of the column is chosen so that its diagonal is nonnegative.
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
    """Replace the lower triangular root S of one filter of one run, ``root`` (1, 1, n, n, 1), by
    that of ``F S S' F' + Q``; F and the lower triangular ``root_Q`` are (n, n), and ``moved`` and
    ``noise`` (n, n, 1) are scratch.
    """
    # F[0] (n,) serves as the size n.
    predict_root(ONE, F[0], root, 0, 0, F, root_Q, moved, noise)


def predict_root_alone(root: FloatArray, F: FloatArray, root_Q: FloatArray) -> FloatArray:
    """Return the lower triangular root (n, n) of ``F S S' F' + Q`` for the lower triangular
    ``root`` S and ``root_Q`` (n, n each), for one filter in Python: the same bits as in a block.
    """
    n = len(F)
    moved = np.array(root).reshape(1, 1, n, n, 1)
    predict_root_single(moved, F, root_Q, np.empty((n, n, 1)), np.empty((n, n, 1)))
    return np.asarray(moved.reshape(n, n))
