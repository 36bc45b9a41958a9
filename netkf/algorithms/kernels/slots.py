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

from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.estimates import reflect_column, rotate, transform_root
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    MANY,
    ONE,
    Lanes,
    aligned,
    load,
    scatter,
    select,
    spread,
    store,
)
from netkf.linalg.local import local_lanes_vector
from netkf.linalg.structs import Size, sized


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
    return rotate(lanes, size, root[b], h, row, gains)


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
    transform_root(lanes, size, root[b], h, F, root_Q, (moved_scratch, noise_scratch))


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
    reflect_column(lanes, size, root[b], h, i, moved, noise)


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
