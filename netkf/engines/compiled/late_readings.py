"""Late readings in the event loop, used as if they had come in time (see algorithms/intermittent).

Each node remembers its recent events: readings and moves of the origin, each with the state after
it. A late reading is inserted at its time, and all later events are repeated.
"""

from __future__ import annotations

import numpy as np

from netkf.algorithms.kernels.root_flow import propagate_root
from netkf.algorithms.kernels.root_update import sample_root
from netkf.engines.compiled.state import Simulation
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Size, Struct

TIME_TOLERANCE = 1e-14
PAST = np.dtype(
    [("instant", np.int64), ("frame", np.int64), ("before", np.int64), ("time", np.float64)]
)


class History(Struct):
    """The past of N nodes, for late readings: a pool of P events.

    past : (P,) PAST records: index of the instant of a reading or number of a frame that begins
           (else -1), index of the event ``before`` it, and time
    x, root : state right after each event (P, n), (P, n, n)
    newest : (N,), index of the newest event of each node
    free : (2,), first free entry and number of free ones
    offsets : (F, n), shift of the estimates at the beginning of each frame
    lag : seconds for which events are remembered
    """

    past: np.ndarray
    x: FloatArray
    root: FloatArray
    newest: np.ndarray
    free: np.ndarray
    offsets: FloatArray
    lag: float


def empty_history(state: Simulation, lag: float, capacity: int) -> History:
    """Return a history of all N nodes at time 0, with ``capacity`` free entries, that remembers
    events (readings used, moves of the origin) for ``lag`` seconds, so that a reading that arrives
    late can be used at its own time.
    """
    count, n = state.xhat.shape
    capacity = count + capacity
    # The first entries are the states of all nodes at time 0, and the others are free.
    past = np.zeros(capacity, dtype=PAST)
    past["instant"] = past["frame"] = -1
    past["before"] = np.arange(1, capacity + 1)
    past["before"][:count] = -1
    x, root = np.zeros((capacity, n)), np.zeros((capacity, n, n))
    x[:count], root[:count] = state.xhat, state.root
    free = np.array([count, capacity - count], dtype=np.int64)
    offsets = np.zeros((len(state.frames), n))
    return History(
        past=past, x=x, root=root, newest=np.arange(count), free=free, offsets=offsets, lag=lag
    )


def add_past(history: History, at_least: int) -> None:
    """Enlarge the pool of events of a history in place, when it is used up: double it, or add
    ``at_least`` entries if these are more.
    """
    capacity = len(history.past)
    added = max(capacity, at_least)
    # Chain the new entries, and the former free list behind them.
    past = np.zeros(added, dtype=PAST)
    past["before"] = np.arange(capacity + 1, capacity + added + 1)
    past["before"][-1], history.free[0] = history.free[0], capacity
    history.free[1] += added
    history.past = np.concatenate([history.past, past])
    history.x = np.concatenate([history.x, np.zeros((added, *history.x.shape[1:]))])
    history.root = np.concatenate([history.root, np.zeros((added, *history.root.shape[1:]))])


@kernel
def use_instant(
    state: Simulation, instant: int, root: FloatArray, x: FloatArray, k: int, scale: float
) -> None:
    """Update one estimate, entry ``k`` of K estimates ``x`` (K, n) and of the roots of P ``root``
    (K, n, n), with all samples that a node takes at an ``instant`` (index in ``state.instants``) in
    one update, stacked in the order of sensors, with noise ``scale``^2 R.
    """
    instants, scratch, n, row = state.instants, state.scratch, x.shape[1], 0
    # All sensors of the instant in one reading: R is block diagonal, and so is its root.
    for s in range(instants.first[instant], instants.first[instant + 1]):
        sensor, matrix = instants.sensor[s], instants.matrix[s]
        p = instants.rows[sensor]
        for i in range(p):
            scratch.y[row + i] = instants.y[s, i]
            for j in range(n):
                scratch.H[row + i, j] = instants.H[matrix, i, j]
            # Zeros left of the diagonal block: an earlier instant may have left entries there.
            for j in range(row):
                scratch.root_R[row + i, j] = 0.0
            for j in range(i + 1):
                scratch.root_R[row + i, row + j] = scale * instants.root[sensor, i, j]
        row += p
    # One update with all rows, as in the SimPy engine.
    if row > 0:
        sample_root(root, x, k, scratch.y[:row], scratch.H, scratch.root_R, state.update_scratch)


@kernel
def copy_state(
    size: Size,
    x: FloatArray,
    root: FloatArray,
    k: int,
    from_x: FloatArray,
    from_root: FloatArray,
    m: int,
) -> None:
    """Copy entry ``m`` of ``from_x`` (M, n) and ``from_root`` (M, n, n), lower triangular, to entry
    ``k`` of ``x`` (K, n) and ``root`` (K, n, n).
    """
    for i in range(len(size)):
        x[k, i] = from_x[m, i]
        # Only the lower triangle of a root is ever read.
        for j in range(i + 1):
            root[k, i, j] = from_root[m, i, j]


@kernel
def allocate_past(history: History, time: float, instant: int, frame: int) -> int:
    """Take a free entry of ``history`` for an event of a node at ``time`` (seconds): the reading of
    ``instant`` (index in Instants), or the move of the origin that begins frame number ``frame``;
    the other one is -1. Return the index of the entry; its state is not set yet.
    """
    k = history.free[0]
    entry = history.past[k]
    history.free[0] = entry.before
    history.free[1] -= 1
    entry.time, entry.instant, entry.frame = time, instant, frame
    return int(k)


@kernel
def remember(
    state: Simulation, history: History, h: int, time: float, instant: int, frame: int
) -> None:
    """Add the present state of node ``h`` to ``history``, as that after an event at ``time``
    (seconds), from which later readings are repeated if one before them comes late. The event is
    the reading of ``instant`` (index in Instants), or the move of the origin that begins frame
    number ``frame``; -1 for the other one.
    """
    k = allocate_past(history, time, instant, frame)
    # The events of a node are a linked list, the newest first.
    history.past[k].before = history.newest[h]
    history.newest[h] = k
    copy_state(state.size, history.x, history.root, k, state.xhat, state.root, h)


@kernel
def forget(history: History, h: int, since: float) -> None:
    """Free the events in ``history`` of node ``h`` (index) that no late reading can reach any more:
    those from ``since`` (seconds) on stay, and one before it.
    """
    past = history.past
    k = history.newest[h]
    # The last event before ``since`` stays: a late reading starts from its state.
    while k != -1 and not past[k].time < since:
        k = past[k].before
    if k == -1:
        return
    # Cut the list behind it; the entries cut off return to the list of free ones.
    freed = past[k].before
    past[k].before = -1
    while freed != -1:
        following = past[freed].before
        past[freed].before = history.free[0]
        history.free[0] = freed
        history.free[1] += 1
        freed = following


@kernel
def use_reading(state: Simulation, history: History, h: int, instant: int) -> None:
    """Update node ``h`` with the reading of ``instant`` (index in ``state.instants``), which is the
    present one, and remember it in ``history``, in case that an earlier reading arrives later.
    Changes ``state.xhat[h]`` and ``root[h]``.
    """
    use_instant(state, instant, state.root, state.xhat, h, 1.0)
    lag, time = history.lag, state.instants.t[instant]
    # Without delays nothing need be remembered.
    if lag <= 0.0:
        return
    # Once in each interval of length lag, so that forgetting costs little.
    if time // lag > history.past[history.newest[h]].time // lag:
        forget(history, h, time - lag)
    remember(state, history, h, time, instant, -1)


@kernel
def use_late_reading(state: Simulation, history: History, h: int, instant: int, now: float) -> None:
    """Update node ``h`` with the reading of ``instant`` (index in ``state.instants``) that arrives
    late, at ``now`` (seconds): go back to the event before its time in ``history``, use it, and
    repeat all later events. Changes ``state.xhat[h]`` and ``root[h]``, and all later states in
    ``history``.
    """
    past, x, root, model = history.past, history.x, history.root, state.nodes[h].model
    time = state.instants.t[instant]
    # Go back: move the later events into the list ``later_events``, the oldest first. Times that
    # differ by rounding count as equal.
    later_events, k = -1, history.newest[h]
    while past[k].time > time + TIME_TOLERANCE * now and past[k].before != -1:
        before = past[k].before
        past[k].before = later_events
        later_events, k = k, before
    # The late reading becomes an entry of its own between them; -1: it begins no frame.
    before, k = k, allocate_past(history, time, instant, -1)
    past[k].before = before
    # Go forward again: predict from the entry before, use the reading or move the origin, and store
    # the state.
    while True:
        copy_state(state.size, x, root, k, x, root, before)
        if past[k].time > past[before].time:
            gap = past[k].time - past[before].time
            propagate_root(state.table, model, root, x, k, gap, state.flow_scratch)
        # 1.0: the noise of the reading is not scaled.
        if past[k].instant >= 0:
            use_instant(state, past[k].instant, root, x, k, 1.0)
        # A frame begins: move the origin of the estimate.
        if past[k].frame >= 0:
            for i in range(x.shape[1]):
                x[k, i] += history.offsets[past[k].frame, i]
        if later_events == -1:
            break
        before, k, later_events = k, later_events, past[later_events].before
        past[k].before = before
    history.newest[h] = k
    copy_state(state.size, state.xhat, state.root, h, x, root, k)
    # From the last event to now.
    if now > past[k].time:
        gap = now - past[k].time
        propagate_root(state.table, model, state.root, state.xhat, h, gap, state.flow_scratch)
    forget(history, h, now - history.lag)
