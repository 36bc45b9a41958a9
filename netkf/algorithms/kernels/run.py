"""What a filter's kernels are given: the surroundings of a node, and the standard verbs.

The verbs of a filter are kernels ``predict``, ``update``, ``emit``, ``absorb`` and ``shift`` on a
*record*, a struct with one entry for each of H nodes (``algorithms.records``), for node ``h``.
Everything else is in ``run``, a :class:`SlotRun` or :class:`ClockRun`, whose fields have the same
names: the model, the links, the reading, the inbox, scratch. Engines set its numbers before each
call, so that one text of a filter serves slots and clocks, one run or L of them side by side.

=================================  ============================================================
``predict_estimate``               predict an estimate by ``run.gap`` seconds (slots: one slot)
``update_estimate``                update an estimate with the node's own reading
``use_reading``                    update an estimate with any reading
``predict_copy``                   predict an estimate of another node
``carry``, ``carry_mean``          predict what a message brings to now
``load_flags(lanes, arrived, k)``  the runs in which message k of the inbox has arrived
=================================  ============================================================
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.algorithms.kernels.estimates import (
    copy_root,
    copy_vector,
    transform_mean,
    transform_root,
    update_by_row,
)
from netkf.algorithms.kernels.gains import Gains
from netkf.algorithms.kernels.root_flow import (
    FlowScratch,
    FlowTable,
    flow_scratch,
    gain_root,
    information_rate,
    propagate_root,
)
from netkf.linalg.addresses import NOTHING, address_of, call_at, reads_only
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.generic import copy_part, drop_lane, generic
from netkf.linalg.lanes import ONE, Lanes, aligned, load, store
from netkf.linalg.structs import MAX_UNROLLED, Size, Struct, sized

MAX_RELATIVE_GAIN = 1.0
"""Largest integral of trace(P G), G = H' R^-1 H, over the increments that one update uses."""
NO_CHANGES = np.zeros(0)
ALIKE: IntArray = np.zeros((0, 0), dtype=np.int64)
"""``run.common`` where all nodes estimate the same."""
CLOSE = 1e-12
"""Share of a time by which sums of gaps may miss it."""
ALL = -2
"""``run.receiver`` where a message is for all receivers."""


class SlotModelArrays(Struct):
    """The model of a slot that all nodes believe: F (n, n) and the lower triangular root of Q."""

    F: FloatArray
    root_Q: FloatArray


class SlotRun(Struct):
    """The surroundings of H nodes in slots, L runs side by side, with W directed links.

    size, lanes : n and L as lengths (``linalg.structs``, ``linalg.lanes``)
    model : SlotModelArrays
    first, sender, weight : links to node h are ``first[h]`` to ``first[h + 1]`` - 1: the index of
                            the sender, and the weight that the receiver gives it
    opposite : the link from the receiver of each link to its sender, -1 if there is none
    y, H, rows, matrix : whitened readings: reading r has ``rows[r]`` rows ``y[first_y + r]``
                         (p, L) with ``H[first_H + matrix[r]]`` (p, n, L)
    reading : number r of the reading of ``update``
    count, message, link, message_weight, age, heard, arrived : the inbox: ``count`` messages, for
        each its number in the payloads, its link, weight and age in seconds, the number of the
        reading that the sender had at the time of sending (-1: none), and flags (L,) of the runs in
        which it has arrived
    receiver : for ``emit`` of an addressed filter, ``records.Kernels``
    sends : (L,), on entry of ``emit`` 0 where the node is down: it then leaves the record as it is;
            it writes 0 where the node sends nothing
    uniform : (L,), uniform numbers for ``emit`` of a randomised filter
    common : (W, n), for each link and component of the receiver's state which component of the
             sender's it is, -1: none; (0, 0) where messages need no translation
    pairs : those of readings that are also about blocks which their node does not estimate
    nonlinear : NonlinearRows of the readings, where they are not linear
    gate : GateTables, where readings pass a gate
    offset : (n, L), by which ``shift`` moves estimates
    gap, slot, phase, step : seconds of a prediction, numbers of slot, exchange and repetition
    now : under clocks the end of the prediction, or the time to which messages are predicted
    row, gains, moved_mean, moved, noise, whitened, total : scratch, (n, L) three times, (n, n, L)
        twice, (n, n + 1, L) twice
    """

    size: Size
    lanes: Lanes
    model: SlotModelArrays
    first: IntArray
    sender: IntArray
    opposite: IntArray
    weight: FloatArray
    y: FloatArray
    H: FloatArray
    rows: IntArray
    matrix: IntArray
    message: IntArray
    link: IntArray
    message_weight: FloatArray
    age: FloatArray
    heard: IntArray
    arrived: np.ndarray
    sends: np.ndarray
    uniform: FloatArray
    offset: FloatArray
    row: FloatArray
    gains: FloatArray
    moved_mean: FloatArray
    moved: FloatArray
    noise: FloatArray
    whitened: FloatArray
    total: FloatArray
    common: IntArray
    pairs: Any
    nonlinear: Any
    gate: Any
    reading: int
    first_y: int
    first_H: int
    count: int
    receiver: int
    slot: int
    phase: int
    step: int
    gap: float
    now: float


class SingleSlotRun(Struct):
    """The surroundings of one node in one run, for the SimPy engine: a SlotRun with L = 1."""

    __annotations__ = SlotRun.__annotations__


class ClockTables(Struct):
    """The models of H nodes under clocks. A plant that changes has several *pieces*, and each node
    a model in each.

    table : tables of all models of the first piece, the last without sensors, for messages and
            copies, then those of the next piece, and so on
    changes : (C,) times in seconds at which the next piece begins
    piece, stride : the number of the present piece, and how many models a piece has
    models : (H,), index of each node's model in the present piece
    gains, moments, increments : for nodes that read increments: the tables of their gains, the
        moments (2 p,) of the reading of ``update``, and 1 where that is one of increments
    scratch, values, mean, mean_root : scratch of predictions, of gains, and an estimate (1, n) and
        (1, n, n)
    move, gap, now : the address of what moves this estimate over so many seconds up to a time
    """

    table: FlowTable
    changes: FloatArray
    piece: int
    stride: int
    models: IntArray
    gains: Gains
    moments: FloatArray
    increments: int
    scratch: FlowScratch
    values: FloatArray
    mean: FloatArray
    mean_root: FloatArray
    move: int
    gap: float
    now: float


class ClockRun(Struct):
    """The surroundings of H nodes of one run under clocks: a SlotRun with ClockTables, in which
    ``slot``, ``phase`` and ``step`` are -1.
    """

    __annotations__ = SlotRun.__annotations__


def scratch_of(n: int, L: int) -> dict[str, FloatArray]:
    """Return the scratch arrays of a run by name, for n states and L lanes."""
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("row", "gains", "moved_mean", "offset"), (n, L)),
        **dict.fromkeys(("moved", "noise"), (n, n, L)),
        **dict.fromkeys(("whitened", "total"), (n, n + 1, L)),
    }
    return {name: aligned(shape) for name, shape in shapes.items()}


def size_of(n: int, unrolled: bool) -> Size:
    """Return the ``size`` of a run, whose type knows a small n if loops are to be ``unrolled``."""
    # Loops over one state need no unrolling.
    return sized(n) if unrolled and n > 1 else np.zeros(n)


def opposite_links(first: IntArray, sender: IntArray) -> IntArray:
    """Return for each of W links by receiver the one in the opposite direction, -1 for none."""
    receiver = np.repeat(np.arange(len(first) - 1), np.diff(first))
    ends, turned = receiver * len(first) + sender, sender * len(first) + receiver
    order = np.argsort(ends)
    place = np.searchsorted(ends[order], turned)
    place[place == len(ends)] = 0
    return np.where(ends[order[place]] == turned, order[place], -1).astype(np.int64)


def clock_tables(
    size: Size, table: FlowTable, models: IntArray, gains: Gains, changes: FloatArray = NO_CHANGES
) -> ClockTables:
    """Return the models of H nodes under clocks for a run of this ``size``, with scratch: the
    ``table`` of M models and the ``gains`` of theirs, and the index ``models`` (H,) of each node's;
    M counts the models of all pieces between the ``changes`` (C,) of the plant, in seconds.
    """
    n, unrolled = len(size), isinstance(size, tuple)
    # The types of structs in it depend on a size that is known when kernels are compiled.
    cls = ClockTables.of_size(n) if unrolled else ClockTables
    made: ClockTables = cls(
        table=table,
        changes=changes,
        piece=0,
        stride=len(table.unit) // (1 + len(changes)),
        models=models,
        gains=gains,
        moments=np.zeros(max(1, int(gains.moments.max()))),
        increments=0,
        scratch=flow_scratch(table, unrolled),
        values=np.zeros(max(1, gains.series.shape[2])),
        mean=np.zeros((1, n)),
        mean_root=np.zeros((1, n, n)),
        move=NOTHING,
        gap=0.0,
        now=0.0,
    )
    if not unrolled:
        made.move = address_of(move_mean, made, made)
    return made


@generic
def predict_estimate(model: Any, run: Any, x: FloatArray, root: FloatArray, k: int, h: int) -> None:
    """Predict estimate ``k`` of the stacks ``x`` (K, n, L) and ``root`` (K, n, n, L) by
    ``run.gap`` seconds (in slots by one slot), as node ``h`` predicts its own: the root counts the
    increments of the gap. ``model`` is ``run.model``.
    """


@generic
def predict_copy(model: Any, run: Any, x: FloatArray, root: FloatArray, k: int) -> None:
    """Predict estimate ``k`` by ``run.gap`` seconds without readings."""


@generic
def carry(model: Any, run: Any, x: FloatArray, root: FloatArray, m: int, age: float) -> None:
    """Predict estimate ``m``, of a message ``age`` seconds old, to now without readings; in slots
    messages are used in the slot in which they are sent.
    """


@generic
def carry_mean(model: Any, run: Any, x: FloatArray, m: int, age: float) -> None:
    """Predict the mean ``x[m]`` of ``x`` (K, n, L), of a message ``age`` seconds old, to now; in
    slots it stays.
    """


@generic
def update_estimate(model: Any, run: Any, x: FloatArray, root: FloatArray, k: int, h: int) -> None:
    """Update estimate ``k`` with the reading of node ``h``, ``run.reading``, or its increments."""


@generic
def transition(model: Any, run: Any, x: FloatArray, k: int, out: FloatArray) -> None:
    """Write the derivative (n, n, L) of the prediction of ``k`` over ``run.gap`` s into ``out``."""


@transition.register(SlotModelArrays)
@kernel
def _transition_of_slot(
    model: SlotModelArrays, run: Any, _x: FloatArray, _k: int, out: FloatArray
) -> None:
    n = len(run.size)
    for i in range(n):
        for j in range(n):
            store(run.lanes, out, i, j, model.F[i, j])


@transition.register(ClockTables)
@kernel
def _transition_of_gap(model: ClockTables, run: Any, _x: Any, k: int, out: FloatArray) -> None:
    n = len(run.size)
    for c in range(n):
        for i in range(n):
            model.mean[0, i] = 1.0 if i == c else 0.0
            for j in range(i + 1):
                model.mean_root[0, i, j] = 0.0
        m = model.models[k] - model.piece * model.stride
        move(model, run, m, model.mean_root, model.mean, 0, run.gap)
        for i in range(n):
            out[i, c, 0] = model.mean[0, i]


@predict_copy.register(Struct)
@kernel(inlined=True)
def _predict_without_readings(
    model: Any, run: Any, x: FloatArray, root: FloatArray, k: int
) -> None:
    predict_estimate(model, run, x, root, k, 0)


@predict_estimate.register(SlotModelArrays)
@kernel(inlined=True)
def predict_slot(
    model: SlotModelArrays, run: Any, x: FloatArray, root: FloatArray, k: int, _h: int
) -> None:
    """Predict by one slot: ``x <- F x``, ``P <- F P F' + Q``."""
    F = model.F
    transform_mean(run.lanes, run.size, x, k, F, run.moved_mean)
    transform_root(run.lanes, run.size, root, k, F, model.root_Q, (run.moved, run.noise))


@carry.register(SlotModelArrays)
@kernel(inlined=True)
def carry_in_slot(
    model: SlotModelArrays, run: Any, x: FloatArray, root: FloatArray, m: int, age: float
) -> None:
    """Do nothing: messages are used in the slot in which they are sent."""


@carry_mean.register(SlotModelArrays)
@kernel(inlined=True)
def carry_mean_in_slot(model: SlotModelArrays, run: Any, x: FloatArray, m: int, age: float) -> None:
    """Do nothing, see ``carry_in_slot``."""


@carry_mean.register(ClockTables)
@kernel
def _carry_mean_over_age(model: ClockTables, run: Any, x: FloatArray, m: int, age: float) -> None:
    if not age > 0.0:
        return
    n = x.shape[1]
    for i in range(n):
        model.mean[0, i] = x[m, i, 0]
        for j in range(i + 1):
            # A root of zero: the mean does not depend on it.
            model.mean_root[0, i, j] = 0.0
    move(model, run, model.stride - 1, model.mean_root, model.mean, 0, age)
    for i in range(n):
        x[m, i, 0] = model.mean[0, i]


@update_estimate.register(SlotModelArrays)
@kernel(inlined=True)
def update_in_slot(
    _model: SlotModelArrays, run: Any, x: FloatArray, root: FloatArray, k: int, _h: int
) -> None:
    """Update with the reading of the slot."""
    use_reading(run, x, root, k, run.reading, True)


@predict_estimate.register(ClockTables)
@kernel
def _predict_over_gap(
    model: ClockTables, run: Any, x: FloatArray, root: FloatArray, k: int, h: int
) -> None:
    m = model.models[h] - model.piece * model.stride
    move(model, run, m, drop_lane(root), drop_lane(x), k, run.gap)


@predict_copy.register(ClockTables)
@kernel
def _predict_copy_over_gap(
    model: ClockTables, run: Any, x: FloatArray, root: FloatArray, k: int
) -> None:
    carry(model, run, x, root, k, run.gap)


@carry.register(ClockTables)
@kernel
def _carry_over_age(
    model: ClockTables, run: Any, x: FloatArray, root: FloatArray, m: int, age: float
) -> None:
    if age > 0.0:
        move(model, run, model.stride - 1, drop_lane(root), drop_lane(x), m, age)


@generic
def move(model: Any, run: Any, m: int, root: FloatArray, x: FloatArray, k: int, gap: float) -> None:
    """Predict estimate ``k`` of ``x`` (K, n) and ``root`` (K, n, n) over the ``gap`` seconds up to
    ``run.now`` by model number ``m`` of each piece.
    """


@move.register(ClockTables)
@kernel
def _move_by_address(
    model: ClockTables, run: Any, m: int, root: FloatArray, x: FloatArray, k: int, gap: float
) -> None:
    # Compiling what moves an estimate takes seconds: verbs that do so share the code.
    n, mean, mean_root = x.shape[1], model.mean, model.mean_root
    for i in range(n):
        mean[0, i] = x[k, i]
        for j in range(i + 1):
            mean_root[0, i, j] = root[k, i, j]
    model.gap, model.now = gap, run.now
    call_at(model.move, model, m, model)
    for i in range(n):
        x[k, i] = mean[0, i]
        for j in range(i + 1):
            root[k, i, j] = mean_root[0, i, j]


@kernel
def move_mean(model: ClockTables, m: int, _same: ClockTables) -> None:
    """Predict the estimate ``model.mean`` over ``model.gap`` seconds up to ``model.now``."""
    move_in_pieces(model, model, m, model.mean_root, model.mean, 0, model.gap)


@kernel(inlined=True)
def move_in_pieces(
    model: ClockTables, run: Any, m: int, root: FloatArray, x: FloatArray, k: int, gap: float
) -> None:
    """Predict an estimate by ``gap`` seconds up to ``run.now``, cut where the plant changes."""
    piece, rest = model.piece, gap
    while piece > 0 and (run.now - gap) * (1.0 + CLOSE) < model.changes[piece - 1]:
        piece -= 1
    while rest > 0.0:
        length = rest
        if piece < model.piece:
            length = min(rest, model.changes[piece] - (run.now - rest))
        propagate_root(model.table, piece * model.stride + m, root, x, k, length, model.scratch)
        rest -= length
        piece += 1


for _n in range(2, MAX_UNROLLED + 1):
    move.register(ClockTables.of_size(_n))(move_in_pieces)


@update_estimate.register(ClockTables)
@kernel
def _update_under_clocks(
    model: ClockTables, run: Any, x: FloatArray, root: FloatArray, k: int, h: int
) -> None:
    if model.increments == 0:
        use_reading(run, x, root, k, run.reading, True)
        return
    m, gains = model.models[h], model.gains
    moments, estimates = model.moments[: gains.moments[m]], drop_lane(x)
    gain_root(
        run.size, moments, gains.series[m], gains.reach[m], 0, drop_lane(root), estimates, k,
        run.gap, model.values,
    )  # fmt: skip


@kernel(inlined=True)
def use_reading(run: Any, x: FloatArray, root: FloatArray, k: int, r: int, arrived: Any) -> None:
    """Update estimate ``k`` of the stacks ``x`` (K, n, L) and ``root`` (K, n, n, L) with reading
    number ``r``, row by row, in the runs with ``arrived`` (flags (L,); True: all).
    """
    y, H = run.y, run.H
    first, matrix = run.first_y + r, run.first_H + run.matrix[r]
    for i in range(run.rows[r]):
        place = first, matrix, i
        update_by_row(run.lanes, run.size, x, root, k, y, H, place, arrived, (run.row, run.gains))


@kernel(inlined=True)
def write_innovation(run: Any, x: FloatArray, out: FloatArray) -> None:
    """Write ``H' R^-1 (y - H x)`` of the reading of ``update`` into ``out`` (n, L); x is (n, L)."""
    lanes, n, r = run.lanes, len(run.size), run.reading
    first, matrix = run.first_y + r, run.first_H + run.matrix[r]
    for i in range(n):
        store(lanes, out, i, 0.0)
    # Whitened rows have R = I.
    for k in range(run.rows[r]):
        innovation = load(lanes, run.y, first, k)
        for j in range(n):
            innovation -= load(lanes, run.H, matrix, k, j) * load(lanes, x, j)
        for i in range(n):
            entry = load(lanes, run.H, matrix, k, i) * innovation
            store(lanes, out, i, load(lanes, out, i) + entry)


@kernel(inlined=True)
def copy_estimate(
    run: Any,
    x: FloatArray,
    root: FloatArray,
    k: int,
    from_x: FloatArray,
    from_root: FloatArray,
    m: int,
    flags: Any,
) -> None:
    """Copy estimate ``m`` of ``from_x`` and ``from_root`` to number ``k`` of ``x`` and ``root``, in
    the lanes with ``flags`` (True: all).
    """
    copy_vector(run.lanes, run.size, x, k, from_x, m, flags)
    copy_root(run.lanes, run.size, root, k, from_root, m, flags)


@kernel(inlined=True)
def shift_vector(run: Any, x: FloatArray, k: int) -> None:
    """Add ``run.offset`` (n, L) to ``x[k]``: the origin of coordinates has moved."""
    for i in range(len(run.size)):
        store(run.lanes, x, k, i, load(run.lanes, x, k, i) + load(run.lanes, run.offset, i))


@kernel
def shift_product(run: Any, matrix: FloatArray, rows: int, x: FloatArray, k: int) -> None:
    """Add the first ``rows`` of ``matrix`` (n, n) times ``run.offset`` (n, L) to ``x[k]``."""
    for i in range(rows):
        total = load(run.lanes, x, k, i)
        for j in range(len(run.size)):
            total += matrix[i, j] * load(run.lanes, run.offset, j)
        store(run.lanes, x, k, i, total)


# The standard verbs: those of a Kalman filter on the node's own readings, which sends estimates.


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict the estimate of node ``h`` by ``run.gap`` seconds."""
    predict_estimate(run.model, run, record.xhat, record.root, h, h)


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Update the estimate of node ``h`` with its reading."""
    update_estimate(run.model, run, record.xhat, record.root, h, h)


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Write the estimate of node ``h`` into payload ``m``."""
    payload = record.payload
    copy_estimate(run, payload.xhat, payload.root, m, record.xhat, record.root, h, True)


@kernel
def read_common(record: Any, m: int, k: int, run: Any) -> None:
    """Let message ``k`` of the inbox be payload ``m``, what the receiver would say itself, with
    what the sender says of states that both estimate.
    """
    width = len(run.size)
    for i in range(width):
        if run.common[run.link[k], i] >= 0:
            copy_part(record.payload, m, run.message[k], i, run.common[run.link[k], i], width)
    run.message[k] = m


@kernel
def emit_nothing(record: Any, h: int, m: int, run: Any) -> None:
    """Do nothing: the message is empty, or the reading of this instant that goes with it."""


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Do nothing: nothing arrives."""


@kernel
def observe(record: Any, h: int, run: Any) -> None:
    """Do nothing where a sample is taken."""


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move the estimate of node ``h`` with the origin."""
    shift_vector(run, record.xhat, h)


@kernel
def shift_prior(record: Any, h: int, run: Any) -> None:
    """Move the estimate of node ``h``, and what it was before the reading, with the origin."""
    shift_vector(run, record.xhat, h)
    shift_vector(run, record.prior, h)


@kernel
def shift_payload(record: Any, m: int, run: Any) -> None:
    """Move the estimate in payload ``m`` with the origin."""
    shift_vector(run, record.payload.xhat, m)


@kernel
def max_increment_interval(record: Any, h: int, run: Any) -> float:
    """Return the longest interval (seconds) of increments for one update: P changes on the time
    scale 1 / trace(P G), G = H' R^-1 H.
    """
    table = run.model.table
    m = run.model.models[h]
    return longest_interval(information_rate(ONE, run.size, table.whitened_H[m], record.root[h]))


@kernel
def longest_interval(rate: float) -> float:
    """Return the longest interval (s) of increments for one update, by the ``rate`` (1/s)."""
    return MAX_RELATIVE_GAIN / rate if rate > 0.0 else math.inf


@kernel
def interval_end(now: float, time: float, length: float) -> float:
    """Return the end, in seconds, of a measurement interval that begins at ``now`` and lasts
    ``length`` seconds, but ends at ``time`` at the latest; one too short to change the clock would
    repeat for ever, and ends at ``time`` instead.
    """
    end = now + length
    return end if now < end < time else time


class Estimates(Struct):
    """The first fields of all records, all that the standard verbs of a node read."""

    xhat: FloatArray
    root: FloatArray


reads_only(Estimates, predict, update, shift, max_increment_interval)
