"""The Kalman filter with intermittent observations, paper R (15)-(18) (Kar, Sinopoli and Moura):
a node uses the readings that arrive, its own and its neighbours'.

In slots the state is a prediction: after the readings of a slot it is predicted to the next one.
Under clocks a message takes time, and its reading may be late. It is used exactly, as if it had
come in time: the node goes back to before the reading, and repeats all that came after it.

The origin of coordinates moves now and then to near the true state, so that large states cost no
digits (``shift``, ``rebase``). A move is an event of the past too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import update_by_row
from netkf.algorithms.kernels.information import clear_part
from netkf.algorithms.kernels.intersection import merge_lanes
from netkf.algorithms.kernels.neighbours import use_readings_heard
from netkf.algorithms.kernels.run import (
    copy_estimate,
    emit_nothing,
    predict_estimate,
    shift_vector,
    use_reading,
)
from netkf.algorithms.models import SlotModel
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.core.fields import field, of_time, one_of, positive
from netkf.linalg.compiling import kernel

SLACK = 1.0 + 1e-6
"""Factor by which the past that is remembered is longer than needed, since ages are rounded."""
ROUNDING = 1e-9
MOVE = -1
"""In place of a number of rows: the event is a move of the origin."""


@kernel
def keep_payload(record: Any, m: int, run: Any) -> None:
    """Do nothing: a reading keeps the coordinates of its time."""


# Under clocks.


@kernel
def predict(record: Any, h: int, run: Any) -> None:
    """Predict the estimate of node ``h``, and keep its time."""
    predict_estimate(run.model, run, record.xhat, record.root, h, h)
    record.time[h, 0] += run.gap


@kernel
def send_origin(record: Any, h: int, m: int, _run: Any) -> None:
    """Send how often the origin has moved, beside the reading of this instant."""
    record.payload.moves[m, 0] = record.moves[h, 0]


@kernel
def update(record: Any, h: int, run: Any) -> None:
    """Use the node's own reading, and remember it."""
    use_and_remember(record, h, run, run.reading)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Use the readings that arrive, each as if it had come at the time when it was taken."""
    for k in range(run.count):
        if run.heard[k] < 0:
            continue
        if run.age[k] > 0.0:
            use_late(record, h, run, k)
        else:
            use_and_remember(record, h, run, run.heard[k])


@kernel
def shift(record: Any, h: int, run: Any) -> None:
    """Move the estimate with the origin. The past keeps the coordinates of its time, and the move
    becomes its newest event, which is repeated after a late reading.
    """
    shift_vector(run, record.xhat, h)
    if record.lag <= 0.0:
        return
    e = record.kept[h, 0]
    record.moves[h, 0] += 1.0
    record.past_time[h, e, 0], record.past_moves[h, e, 0] = record.time[h, 0], record.moves[h, 0]
    record.past_rows[h, e, 0] = MOVE
    for i in range(len(run.size)):
        record.past_y[h, e, i, 0] = run.offset[i, 0]
    store_state(record, h, run, e)
    record.kept[h, 0] = e + 1


@kernel
def use_and_remember(record: Any, h: int, run: Any, r: int) -> None:
    """Update node ``h`` with reading ``r`` of the present instant, its newest event then."""
    # A reading without rows changes nothing.
    if run.rows[r] == 0:
        return
    use_reading(run, record.xhat, record.root, h, r, True)
    if record.lag <= 0.0:
        return
    forget_events(record, h, run)
    e = record.kept[h, 0]
    record.past_time[h, e, 0], record.past_moves[h, e, 0] = record.time[h, 0], record.moves[h, 0]
    store_reading(record, h, run, e, r)
    store_state(record, h, run, e)
    record.kept[h, 0] = e + 1


@kernel
def use_late(record: Any, h: int, run: Any, k: int) -> None:
    """Go back to before the reading of message ``k``, use it, and repeat all later events."""
    r = run.heard[k]
    if run.rows[r] == 0:
        return
    forget_events(record, h, run)
    time, moves = record.time[h, 0] - run.age[k], record.payload.moves[run.message[k], 0]
    last = record.kept[h, 0]
    # It was taken before this node began again, which is more than a rounding of its age.
    if time < record.past_time[h, 0, 0] - ROUNDING * run.age[k]:
        return
    # The order of events at one time is that of moves, and does not matter for readings. A reading
    # of the time of a move comes after it, however its age is rounded.
    e = last
    while e > 1 and (
        record.past_moves[h, e - 1, 0] > moves
        or (
            record.past_moves[h, e - 1, 0] == moves
            and record.past_time[h, e - 1, 0] > time
            and record.past_rows[h, e - 1, 0] != MOVE
        )
    ):
        copy_event(record, h, run, e, e - 1)
        e -= 1
    record.past_time[h, e, 0], record.past_moves[h, e, 0] = time, moves
    store_reading(record, h, run, e, r)
    record.kept[h, 0] = last + 1
    repeat(record, h, run, e)


@kernel
def repeat(record: Any, h: int, run: Any, first: int) -> None:
    """Repeat the past events of node ``h`` from number ``first`` on, then predict to now."""
    x, root, past_x, past_root = record.xhat, record.root, record.past_x[h], record.past_root[h]
    y, H, gap, now = record.past_y[h], record.past_H[h], run.gap, run.now
    # Events have times since the start, at which the clock of the node may have shown another.
    last, start = record.kept[h, 0], now - record.time[h, 0]
    copy_estimate(run, x, root, h, past_x, past_root, first - 1, True)
    for e in range(first, last):
        run.now = start + record.past_time[h, e, 0]
        run.gap = record.past_time[h, e, 0] - record.past_time[h, e - 1, 0]
        if run.gap > 0.0:
            predict_estimate(run.model, run, x, root, h, h)
        for i in range(record.past_rows[h, e, 0]):
            scratch = run.row, run.gains
            update_by_row(run.lanes, run.size, x, root, h, y, H, (e, e, i), True, scratch)
        if record.past_rows[h, e, 0] == MOVE:
            for i in range(len(run.size)):
                x[h, i, 0] += y[e, i, 0]
        store_state(record, h, run, e)
    run.now, run.gap = now, record.time[h, 0] - record.past_time[h, last - 1, 0]
    if run.gap > 0.0:
        predict_estimate(run.model, run, x, root, h, h)
    run.gap = gap


@kernel
def store_state(record: Any, h: int, run: Any, e: int) -> None:
    """Store the estimate of node ``h`` as that right after its event ``e``."""
    past_x, past_root = record.past_x[h], record.past_root[h]
    copy_estimate(run, past_x, past_root, e, record.xhat, record.root, h, True)


@kernel
def store_reading(record: Any, h: int, run: Any, e: int, r: int) -> None:
    """Store reading ``r`` as event ``e`` of node ``h``, in at most n rows."""
    n, rows, y, H = len(run.size), run.rows[r], record.past_y, record.past_H
    first, matrix = run.first_y + r, run.first_H + run.matrix[r]
    record.past_rows[h, e, 0] = min(rows, n)
    if rows <= n:
        for i in range(rows):
            y[h, e, i, 0] = run.y[first, i, 0]
            for j in range(n):
                H[h, e, i, j, 0] = run.H[matrix, i, j, 0]
        return
    # More rows than states: the root [Z, z] of their information has the same.
    total, row = run.total, run.whitened
    clear_part(run.lanes, total)
    for k in range(rows):
        clear_part(run.lanes, row)
        for j in range(n):
            row[n - 1, j, 0] = run.H[matrix, k, j, 0]
        row[n - 1, n, 0] = run.y[first, k, 0]
        merge_lanes(run.lanes, run.size, total, row)
    for i in range(n):
        y[h, e, i, 0] = total[i, n, 0]
        for j in range(n):
            H[h, e, i, j, 0] = total[i, j, 0] if j <= i else 0.0


@kernel
def copy_event(record: Any, h: int, run: Any, to: int, e: int) -> None:
    """Copy event ``e`` of node ``h``, without its state, to number ``to``."""
    record.past_time[h, to, 0] = record.past_time[h, e, 0]
    record.past_moves[h, to, 0] = record.past_moves[h, e, 0]
    record.past_rows[h, to, 0] = record.past_rows[h, e, 0]
    for i in range(len(run.size)):
        record.past_y[h, to, i, 0] = record.past_y[h, e, i, 0]
        for j in range(len(run.size)):
            record.past_H[h, to, i, j, 0] = record.past_H[h, e, i, j, 0]


@kernel
def forget_events(record: Any, h: int, run: Any) -> None:
    """Forget the events of node ``h`` that no late reading can reach any more, all but the last of
    them; once in each interval of length ``lag``, since those that stay are moved.
    """
    time, kept = record.time[h, 0], record.kept[h, 0]
    if time - record.swept[h, 0] < record.lag:
        return
    record.swept[h, 0] = time
    # A late reading of that time starts from the event before it.
    first = kept - 1
    while first > 0 and record.past_time[h, first, 0] >= time - record.lag:
        first -= 1
    x, root = record.past_x[h], record.past_root[h]
    for e in range(first, kept if first > 0 else 0):
        copy_event(record, h, run, e - first, e)
        copy_estimate(run, x, root, e - first, x, root, e, True)
    record.kept[h, 0] = kept - first


UNDER_CLOCKS = Kernels(
    predict=predict, update=update, emit=send_origin, absorb=absorb, shift=shift,
    shift_payload=keep_payload, sends_readings=True, remembers=True,
)  # fmt: skip


def reading_size(n: int, rows: int, _: int) -> int:
    """Return the numbers in a message: y, H and R of ``rows`` rows and n states."""
    return rows * (1 + n) + rows * (rows + 1) // 2


def intermittent_record(
    filtering: Intermittent, infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return what nodes keep under clocks: their time, the number of moves of the origin, the
    time when they last forgot events, and events of the past with the state after each.
    """
    if isinstance(models[0], SlotModel):
        return Record()
    n, max_delay = len(models[0].information), max(info.max_delay for info in infos)
    return Record(
        node={"time": (), "moves": (), "swept": ()},
        past={
            **{"past_time": (), "past_moves": (), "past_rows": ((), np.int64)},
            **{"past_y": (n,), "past_H": (n, n), "past_x": (n,), "past_root": (n, n)},
        },
        payload={"moves": ()},
        settings={"lag": SLACK * min(filtering.timing.max_age, max_delay)},
    )


def begin_intermittent(_: Any, node: Mapping[str, np.ndarray], _info: Any, _model: Any) -> None:
    """Make the start the first event of the past: every late reading has a state before it."""
    if "kept" in node:
        node["past_x"][0], node["past_root"][0] = node["xhat"], node["root"]
        node["kept"][...] = 1


@built_in("intermittent")
@dataclass(frozen=True, eq=False)
class Intermittent(Filter):
    """Every node sends its reading to its neighbours and uses its own and those that arrive.

    late    under clocks, readings that took time: "exact": the result is that of the filter that
            had all arrived readings in the order of their times, by going back to before the late
            one; "drop": they are not used
    window  seconds that a late reading may be old, at most; older ones are late for good. By
            default the longest time a message may take
    """

    late: str = field(one_of("exact", "drop"), default="exact")
    window: float | None = field(of_time(positive), default=None)

    analysis = Analysis(
        paper="intermittent", tells_estimates=lambda _: False, payload_numbers=reading_size
    )
    needs = Needs(one_way=True, samples=True)
    kernels = Kernels(
        emit=emit_nothing, absorb=use_readings_heard, shift_payload=keep_payload,
        sends_readings=True, under_clocks=UNDER_CLOCKS, record=intermittent_record,
        begin=begin_intermittent,
    )  # fmt: skip

    @property
    def timing(self) -> Timing:
        """Nodes with sensors send; late readings are used as far as ``late`` and ``window`` say."""
        window = math.inf if self.window is None else self.window
        return Timing(
            schedule=("sense", "exchange", "predict"),
            clocks=("readings",),
            predicts=True,
            newest_only=False,
            max_age=0.0 if self.late == "drop" else window,
            sends=lambda _, has_sensor: has_sensor,
        )

    shift = Filter.shift  # affine in the readings
