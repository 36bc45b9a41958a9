"""Predictions and combinations of filters in SIMD lanes, for messages that take no time.

Then the events and their times do not depend on estimates. So ``agenda`` goes through the events of
several runs first and queues visits: a visit predicts one node to a time, or predicts two nodes and
combines their estimates. The level of a visit is one more than those of earlier visits of the same
nodes. So visits of one level have no node in common: the nodes, of any run, are predicted and
combined eight at a time in the lanes of vector registers (linalg/lanes.py). Lanes do not mix: a
visit gives the same bits whichever visits share its registers.

A prediction that takes several steps (a long gap, a wide covariance) does not fit into a lane; the
scalar kernels of the event loop do it.
"""

from __future__ import annotations

import numpy as np

from netkf.algorithms.kernels.root_flow import (
    OCTAVES,
    cell_of,
    cholesky_in_lanes,
    condition_root,
    information_rate,
    offset_of_F,
    predict_root_lanes,
    propagate_mean,
    propagate_root,
    takes_one_step,
    trace_of_root,
    use_moments,
    width_of,
)
from netkf.engines.compiled.events import store_sample
from netkf.engines.compiled.increments import next_interval, noise_index, predict_over_interval
from netkf.engines.compiled.lane_readings import (
    LaneReadings,
    begin_reading,
    empty_readings,
    end_readings,
    load_model,
    read_alone,
)
from netkf.engines.compiled.lane_series import NEAR, LaneSeries, max_moments
from netkf.engines.compiled.pair_exchange import PairExchange, receive, send_both
from netkf.engines.compiled.state import Filters, Simulation
from netkf.linalg.addresses import NOTHING
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, gather, load, prefetch, scatter, store, turn, with_spare
from netkf.linalg.local import local_lanes_matrix, local_lanes_vector
from netkf.linalg.series import fill_row
from netkf.linalg.structs import Struct

MAX_VISITS = 1 << 14
"""Length of the queue of visits, so that it fits the processor's cache."""

NO_NODE, ALL_NODES, NOT_HEARD, HAS_SENSORS = -1, -2, -1, -1
"""Values in place of an index, see VISIT and Visits."""
UNOBSERVED, SENSING = 0, 1
"""Both kinds of lanes: of nodes without increment sensors, and of nodes with them."""

_NUMBERS = ("next", "first", "second", "to_first", "to_second", "run", "piece")
VISIT = np.dtype([*((name, np.int32) for name in _NUMBERS), ("time", np.float64)], align=True)
"""A visit: the nodes at the places ``first`` and ``second`` (indices in the state arrays) are
predicted to ``time``, which lies in ``piece`` of the path of their ``run``.

Then each receives the other's estimate over the directed link ``to_first`` or ``to_second``, unless
that is NOT_HEARD. ``second`` is NO_NODE if only one node is predicted, and ALL_NODES for a sample:
the nodes of the run, from ``first`` on, are stored as sample number ``piece``. ``next`` is the next
visit of the same level, or -1.
"""


INTERVAL = np.dtype(
    [*((name, np.int64) for name in ("place", "visit")), ("now", float), ("least", float)]
)
"""The next measurement interval of the node at ``place``, which has been predicted up to ``now``
(seconds) on its way to the time of ``visit``; ``least`` is the lower bound of its length, see
``next_interval``.
"""


LANE = np.dtype(
    [*((name, np.int64) for name in ("visit", "model")), ("now", float), ("end", float)]
)
"""The prediction in a lane, by ``model`` from ``now`` to ``end`` (seconds), on the way to
``visit``.
"""


class Visits(Struct):
    """Queued visits and the arrays that processing them needs. F places, C records, M models, W
    directed links, L lanes, K distinct weights, W' columns and E values of a series, n states,
    readings of q moments.

    The queue:

    records : (C,) of VISIT, of which ``count`` are used
    level : (F,), level of the last visit of each place
    first : (C + 2,), first visit of each level, or -1; ``top`` is the highest level
    pairs : (C,), visits of a level that combine two nodes
    intervals : (2^k >= F,) of INTERVAL, a ring buffer of the entries ``first_interval`` to
                ``after_intervals`` - 1
    model : (F,), model of each place, HAS_SENSORS if the node reads increments
    longest : (M,), longest gap in seconds that one step of a model spans
    weight_row : (W,), which of the distinct weights of ``exchange`` each directed link has

    The lanes, of nodes without increment sensors (index UNOBSERVED, ``waiting`` of them are in use)
    and with them (SENSING):

    lanes, places : (2, L), the predictions, and the places of their nodes
    unobserved, sensing : power series in the gap
    unobserved_rows, sensing_rows : (L, W'), their values at each lane's gap
    columns, values, gains : (W', L), (E, L) and (3 n q, L), the same transposed, by value
    readings : arrays for the readings of sensing nodes
    receiver_places : (2, L), places of the first and second nodes that receive, else NO_NODE
    x, moved : (n, L), means
    S, old_S, V, T : (n, n, L), roots and scratch
    exchange : what the nodes of a pair do with each other's messages
    process : the address of ``process_visits``
    """

    records: np.ndarray
    level: IntArray
    first: IntArray
    pairs: IntArray
    intervals: np.ndarray
    model: IntArray
    longest: FloatArray
    weight_row: IntArray
    lanes: np.ndarray
    places: IntArray
    receiver_places: IntArray
    unobserved: LaneSeries
    sensing: LaneSeries
    unobserved_rows: FloatArray
    sensing_rows: FloatArray
    readings: LaneReadings
    columns: FloatArray
    values: FloatArray
    gains: FloatArray
    x: FloatArray
    S: FloatArray
    old_S: FloatArray
    V: FloatArray
    T: FloatArray
    moved: FloatArray
    exchange: PairExchange
    process: int
    waiting: int
    count: int
    top: int
    first_interval: int
    after_intervals: int


def empty_visits(
    filters: Filters,
    weights: FloatArray,
    places: int,
    series: tuple[LaneSeries, LaneSeries],
    exchange: PairExchange,
) -> Visits:
    """Return an empty queue of visits (predictions of one node, or of two that then combine) with
    the arrays to process them, for filters that begin as ``filters``. It has F = ``places`` places,
    rows of the state arrays: N for each of the runs simulated together. ``weights`` (W,) are those
    of W directed links, ``series`` the power series of nodes without increment sensors and with
    them; ``exchange`` is how pairs combine.
    """
    n, capacity = filters.xhat.shape[1], max(MAX_VISITS, 4 * places)
    weight_row = np.searchsorted(exchange.weights, weights).astype(np.int64)
    table = filters.table
    (unobserved, sensing), q = series, max_moments(filters)
    shapes = {
        "gains": (3 * n * q, LANES),
        **dict.fromkeys(("x", "moved"), (n, LANES)),
        **dict.fromkeys(("S", "old_S", "V", "T"), (n, n, LANES)),
    }
    for name, lane_table in (("unobserved", unobserved), ("sensing", sensing)):
        shapes[f"{name}_rows"] = (LANES, lane_table.series.shape[3])
    width = max(unobserved.series.shape[3], sensing.series.shape[3])
    shapes |= {"columns": (width, LANES), "values": (n * (n + 1) + 2 * n * n, LANES)}
    nodes = filters.nodes
    model = np.where(nodes["sensors"] > nodes["sensor"], HAS_SENSORS, nodes["model"])
    return Visits(
        records=np.zeros(capacity, dtype=VISIT),
        level=np.zeros(places, dtype=np.int64),
        first=np.full(capacity + 2, -1, dtype=np.int64),
        pairs=np.zeros(capacity, dtype=np.int64),
        model=np.tile(model, places // len(nodes)),
        longest=table.unit * 2.0 ** table.sizes[:, OCTAVES],
        weight_row=weight_row,
        readings=empty_readings(filters),
        exchange=exchange,
        lanes=np.zeros((2, LANES), dtype=LANE),
        places=np.zeros((2, LANES), dtype=np.int64),
        receiver_places=np.zeros((2, LANES), dtype=np.int64),
        unobserved=unobserved,
        sensing=sensing,
        **{name: with_spare(shape) for name, shape in shapes.items()},
        intervals=np.zeros(1 << (places - 1).bit_length(), dtype=INTERVAL),
        process=NOTHING,
        waiting=0,
        count=0,
        top=0,
        first_interval=0,
        after_intervals=0,
    )


# The queue, which ``agenda`` fills.


@kernel
def append_visit(
    state: Simulation, visits: Visits, level: int, time: float, first: int, second: int
) -> int:
    """Add a visit, the prediction to ``time`` (seconds) of the nodes at the places ``first`` and
    ``second`` (rows of ``state.xhat``; NO_NODE or ALL_NODES: see VISIT), to ``visits.records`` and
    to the list of ``level``; return its index. Visits of one level have no node in common and are
    computed side by side, by level. Run and piece are the present ones of ``state``.
    """
    v = visits.count
    visits.count = v + 1
    visit = visits.records[v]
    visit.first, visit.second, visit.time = first, second, time
    visit.to_first = visit.to_second = NOT_HEARD
    visit.run, visit.piece = state.run, state.piece
    # Visits of a level are independent of each other: their order in the list does not matter.
    visit.next = visits.first[level]
    visits.first[level] = v
    visits.top = max(visits.top, level)
    return v


@kernel
def queue_visit(state: Simulation, visits: Visits, time: float, place: int) -> None:
    """Queue the prediction of the node at ``place`` (row of ``state.xhat``) to ``time`` (seconds),
    a visit of one node: one level above the node's last visit, since levels are computed one after
    another; raises ``visits.level[place]``.
    """
    level = visits.level[place] + 1
    visits.level[place] = level
    append_visit(state, visits, level, time, place, NO_NODE)


@kernel
def queue_sample(state: Simulation, visits: Visits, first: int) -> None:
    """Queue sample number ``state.samples`` of all N nodes of the present run, at the places
    ``first`` to ``first`` + N - 1 of ``state.xhat``.

    A visit is a job at one or two nodes that waits in the queue. Visits of one level are computed
    side by side, level after level: the sample is one level above all visits of these nodes.
    """
    level = 0
    for h in range(len(state.nodes)):
        level = max(level, visits.level[first + h])
    level += 1
    for h in range(len(state.nodes)):
        visits.level[first + h] = level
    v = append_visit(state, visits, level, 0.0, first, ALL_NODES)
    # Samples have no piece of the path; the field holds their number.
    visits.records[v].piece = state.samples


# Processing, level by level.


@kernel
def process_visits(state: Simulation, _: int, visits: Visits) -> None:
    """Process all queued visits and empty the queue: a visit predicts one node to a time, or two
    nodes that then combine their estimates, or stores a sample. Visits of one level have no node in
    common and are computed side by side, level after level. Changes ``state.xhat``, ``root`` and
    ``now`` of the nodes visited, and stores samples in ``state.buffer``.
    """
    for level in range(1, visits.top + 1):
        process_level(state, visits, visits.first[level])
        visits.first[level] = -1
    visits.count = visits.top = 0
    for place in range(len(visits.level)):
        visits.level[place] = 0


@kernel
def process_level(state: Simulation, visits: Visits, first: int) -> None:
    """Process the visits of one level, which have no node in common, a linked list in
    ``visits.records`` that begins with index ``first``: predict all their nodes, as many side by
    side as there are SIMD lanes, then combine pairs of nodes, or store samples.
    """
    v, pairs = first, 0
    while v != -1:
        visit = visits.records[v]
        if visit.second == ALL_NODES:
            store_sample(state, visit.run, visit.first, visit.piece)
        else:
            queue_prediction(state, visits, v, visit.first)
            if visit.second != NO_NODE:
                queue_prediction(state, visits, v, visit.second)
                visits.pairs[pairs] = v
                pairs += 1
        v = visit.next
    # Both ends of a link are predicted before either combines.
    predict_unobserved(state, visits)
    process_intervals(state, visits)
    for k in range(0, pairs, LANES):
        combine_pairs(state, visits, k, min(LANES, pairs - k))


@kernel
def queue_prediction(state: Simulation, visits: Visits, v: int, place: int) -> None:
    """Queue the node at ``place`` (row of ``state.xhat``) for its prediction to the time of visit
    ``v`` (index in ``visits.records``) in a SIMD lane, with other nodes in the other lanes; or
    predict it at once if the gap is too long for one step. Sets ``state.now[place]``; predicts the
    nodes in all lanes once these are full.
    """
    visit, now = visits.records[v], state.now[place]
    # A node may have several visits at one time: it is predicted with the first of them.
    if not now < visit.time:
        return
    state.now[place] = visit.time
    m, gap = visits.model[place], visit.time - now
    if m == HAS_SENSORS:
        queue_interval(state, visits, place, v, now, 0.0)
        return
    # Without sensors one step is exact for any P if the gap lies inside the cells of the table.
    if not gap < visits.longest[m]:
        propagate_root(state.table, m, state.root, state.xhat, place, gap, state.flow_scratch)
        return
    lane = visits.waiting
    visits.waiting = lane + 1
    assign_lane(visits, UNOBSERVED, lane, place, v, m, now, visit.time)
    if lane + 1 == LANES:
        predict_unobserved(state, visits)


@kernel
def node_at(state: Simulation, run: int, place: int) -> int:
    """Return the index (0 to N - 1) in ``state.nodes`` of the node at ``place`` (row of
    ``state.xhat``), which belongs to run number ``run``: the nodes of the runs that are simulated
    together lie one run after the other in ``state.xhat``.
    """
    return place - (run - state.first_run) * len(state.nodes)


@kernel(inlined=True)
def ring_index(visits: Visits, number: int) -> int:
    """Return the index in the ring buffer ``visits.intervals``, whose length is a power of two, of
    interval ``number``, counted from the first one ever queued.
    """
    return number & (len(visits.intervals) - 1)


@kernel
def queue_interval(
    state: Simulation, visits: Visits, place: int, v: int, now: float, least: float
) -> None:
    """Queue the next measurement interval (over which increments are used in one update) of the
    sensing node at ``place`` (row of ``state.xhat``), which has been predicted up to ``now``
    (seconds) on its way to the time of visit ``v`` (index in ``visits.records``); ``least`` is the
    lower bound of the interval's length in seconds.
    """
    # Visits of one level are processed together, and a node has one of them at most: the ring
    # buffer has space for all.
    interval = visits.intervals[ring_index(visits, visits.after_intervals)]
    interval.place, interval.visit, interval.now, interval.least = place, v, now, least
    visits.after_intervals += 1
    prefetch_path_and_noise(state, visits, v, place)


@kernel
def prefetch_path_and_noise(state: Simulation, visits: Visits, v: int, place: int) -> None:
    """Prefetch into the processor's cache what the node at ``place`` (row of ``state.xhat``) will
    soon read for visit ``v`` (index in ``visits.records``): the path of the true state in the
    visit's piece, and the noise of the node's sensor.
    """
    # Each run has its own path and noise, far from each other: waiting for them took 4 % of a run.
    path, visit = state.path, visits.records[v]
    run, piece = visit.run, visit.piece
    s = state.nodes[node_at(state, run, place)].sensor
    prefetch(path.x_start, run, piece)
    prefetch(path.cubic, run, piece)
    prefetch(state.sensing.noise, noise_index(state.sensing, run, s, path.step[piece]))


@kernel
def process_intervals(state: Simulation, visits: Visits) -> None:
    """Predict all sensing nodes in the queue ``visits.intervals`` up to the times of their visits,
    using their increments, L at a time in SIMD lanes; empties the queue. Changes ``state``.
    """
    while visits.first_interval < visits.after_intervals:
        # begin_interval() adds the next interval of a node behind the others, so the queue ends
        # only when all nodes have reached the times of their visits.
        count = min(LANES, visits.after_intervals - visits.first_interval)
        for q in range(count):
            interval = visits.intervals[ring_index(visits, visits.first_interval + q)]
            visits.places[SENSING, q] = interval.place
        gather_states(state, visits.places[SENSING], count, visits.x, visits.S)
        fill_rates(state, visits, count)
        for q in range(count):
            begin_interval(state, visits, q)
        predict_sensing(state, visits, count)


@kernel
def fill_rates(state: Simulation, visits: Visits, count: int) -> None:
    """Compute the rate of information trace(P G) in 1/s, G being the information rate of the
    sensors, and trace(P) of the nodes in the first ``count`` lanes, on which the lengths of their
    measurement intervals depend: into ``rate`` and ``trace`` (1, L), L lanes, of
    ``visits.readings``. The nodes are those of the next intervals in the ring buffer.
    """
    size, readings = state.size, visits.readings
    for q in range(count):
        interval = visits.intervals[ring_index(visits, visits.first_interval + q)]
        h = node_at(state, visits.records[interval.visit].run, interval.place)
        load_model(readings, q, state.nodes[h].model, state.table.whitened_H)
    # Both for all lanes at once, before the length of each lane's interval is chosen.
    store(MANY, readings.rate, 0, information_rate(MANY, size, readings.whitened_H, visits.S))
    store(MANY, readings.trace, 0, trace_of_root(MANY, size, visits.S))


@kernel
def begin_interval(state: Simulation, visits: Visits, q: int) -> None:
    """Take the next measurement interval from the ring buffer, whose node is in SIMD lane ``q``,
    and decide how long it is: assign its prediction to the lane, or predict the node at once by
    scalar kernels if P is too wide for one step. Queues the rest of the gap, if any.
    """
    interval = visits.intervals[ring_index(visits, visits.first_interval)]
    readings = visits.readings
    place, now, v = interval.place, interval.now, interval.visit
    visits.first_interval += 1
    visit = visits.records[v]
    h = node_at(state, visit.run, place)
    m, time = state.nodes[h].model, visit.time
    end, least = next_interval(readings.rate[0, q], now, time, interval.least)
    if takes_one_step(state.table, m, end - now, readings.trace[0, q]):
        assign_lane(visits, SENSING, q, place, v, m, now, end)
    else:
        visits.places[SENSING, q] = NO_NODE
        predict_over_interval(state, visit.run, h, place, visit.piece, now, end)
    # The rest of the gap is queued: its next interval depends on the covariance after this one.
    if end < time:
        queue_interval(state, visits, place, v, end, least)


@kernel(inlined=True)
def assign_lane(
    visits: Visits, kind: int, q: int, place: int, v: int, m: int, now: float, end: float
) -> None:
    """Assign lane ``q`` to the prediction of a node from ``now`` to ``end`` (seconds), which leads
    towards the time of its visit.

    kind  : UNOBSERVED for the lanes of nodes without increment sensors, SENSING for those with them
    place : index of the node in ``state.xhat`` and ``state.root``
    v     : index of the visit in ``visits.records``
    m     : row of the node's model in the FlowTable ``state.table``
    """
    lane = visits.lanes[kind, q]
    lane.visit, lane.model, lane.now, lane.end = v, m, now, end
    visits.places[kind, q] = place


@kernel
def read_increments_in_lanes(state: Simulation, visits: Visits, count: int) -> None:
    """Write the moments of the increments that the nodes in the first ``count`` SENSING lanes
    (those of nodes with increment sensors) read, each over the interval of its lane, into
    ``visits.readings.moments`` (q, L), q moments in L lanes; lanes of NO_NODE read nothing.
    """
    places, readings = visits.places[SENSING], visits.readings
    # Lanes without a node take no noise.
    for q in range(LANES):
        readings.noise_row[q] = NO_NODE
    for q in range(count):
        if places[q] == NO_NODE:
            continue
        lane = visits.lanes[SENSING, q]
        visit = visits.records[lane.visit]
        h = node_at(state, visit.run, places[q])
        if readings.alone:
            read_alone(state, readings, visit.run, h, visit.piece, lane.now, lane.end, q)
        else:
            begin_reading(state, readings, visit.run, h, visit.piece, lane.now, lane.end, q)
    if not readings.alone:
        end_readings(state, readings)


@kernel
def gather_states(
    state: Simulation, places: IntArray, count: int, x: FloatArray, S: FloatArray
) -> None:
    """Copy the estimates and roots of the nodes at the first ``count`` of the ``places`` (L,), rows
    of ``state.xhat``, into the L SIMD lanes of ``x`` (n, L) and ``S`` (n, n, L), where they are
    computed side by side; the other places become NO_NODE.
    """
    n = len(state.size)
    for q in range(count, LANES):
        places[q] = NO_NODE
    for first in range(0, n, LANES):
        gather(MANY, state.xhat, places, first, x)
    for first in range(0, n * n, LANES):
        gather(MANY, state.root, places, first, S)


@kernel
def scatter_states(state: Simulation, places: IntArray, x: FloatArray, S: FloatArray) -> None:
    """Copy the estimates ``x`` (n, L) and roots ``S`` (n, n, L) of the nodes in L SIMD lanes back
    to rows ``places`` (L,) of ``state.xhat`` and ``state.root``, except lanes with NO_NODE.
    """
    # The last argument is the number of entries left, of which one call copies L at most.
    n = len(state.size)
    for first in range(0, n, LANES):
        scatter(MANY, x, first, state.xhat, places, n - first)
    for first in range(0, n * n, LANES):
        scatter(MANY, S, first, state.root, places, n * n - first)


@kernel
def predict_unobserved(state: Simulation, visits: Visits) -> None:
    """Predict the ``visits.waiting`` queued nodes without increment sensors, at most L, side by
    side over the gaps of their UNOBSERVED lanes, and empty these. Changes ``state``.
    """
    n, count, places = len(state.size), visits.waiting, visits.places[UNOBSERVED]
    if count == 0:
        return
    visits.waiting = 0
    # Work of single lanes is in short loops over lanes, whose turns a processor overlaps.
    for q in range(count):
        evaluate_series(visits, UNOBSERVED, q, visits.unobserved, visits.unobserved_rows)
    gather_states(state, places, count, visits.x, visits.S)
    transpose_rows(visits.unobserved_rows, visits.columns)
    copy_columns(visits.columns, visits.unobserved.column, 0, width_of(n, False), visits.values)
    predict_lanes(state, visits, False)
    scatter_states(state, places, visits.x, visits.S)


@kernel
def predict_sensing(state: Simulation, visits: Visits, count: int) -> None:
    """Predict the nodes in the first ``count`` SENSING lanes (those of nodes with increment
    sensors) over the gaps of their lanes, and correct them by their readings. Their states are in
    ``visits.x`` and ``S``; the results are written to ``state.xhat`` and ``root``.
    """
    places = visits.places[SENSING]
    for q in range(count):
        if places[q] != NO_NODE:
            evaluate_series(visits, SENSING, q, visits.sensing, visits.sensing_rows)
    read_increments_in_lanes(state, visits, count)
    transpose_rows(visits.sensing_rows, visits.columns)
    width = width_of(len(state.size), True)
    copy_columns(visits.columns, visits.sensing.column, 0, width, visits.values)
    copy_columns(visits.columns, visits.sensing.column, width, len(visits.gains), visits.gains)
    predict_lanes(state, visits, True)
    # P includes the readings of the gap already (F and G_g); now they correct the estimate.
    use_moments(MANY, state.size, visits.S, visits.x, visits.gains, visits.readings.moments)
    scatter_states(state, places, visits.x, visits.S)


@kernel
def evaluate_series(
    visits: Visits, kind: int, q: int, series: LaneSeries, rows: FloatArray
) -> None:
    """Evaluate the power series from which the node in lane ``q`` of ``kind`` (UNOBSERVED or
    SENSING: without or with increment sensors) is predicted: that of its model in ``series``, at
    the lane's gap. Write the W' values into ``rows[q]`` of ``rows`` (L, W'), one for each lane.
    """
    lane = visits.lanes[kind, q]
    row = series.row[lane.model]
    cell, since = cell_of(series.unit[row], lane.end - lane.now)
    # The first cells, near a gap of 0, need more terms than the others.
    terms = series.series.shape[2] if cell < NEAR else series.far_terms
    fill_row(rows, q, series.series, terms, row, cell, since)


@kernel
def transpose_rows(rows: FloatArray, out: FloatArray) -> None:
    """Write the transpose of ``rows`` (L, W'), a row for each lane, into ``out`` (W', L)."""
    for j in range(0, rows.shape[1], LANES):
        turn(MANY, rows, j, out)


@kernel
def copy_columns(
    columns: FloatArray, index: IntArray, first: int, count: int, out: FloatArray
) -> None:
    """Copy the values of a power series, evaluated in L lanes with equal ones stored once, to where
    a kernel expects each of them: row e of ``out`` (count, L) comes from row ``index[first + e]``
    of ``columns`` (W', L), the W' distinct values.
    """
    for e in range(count):
        store(MANY, out, e, load(MANY, columns, index[first + e]))


@kernel(fused=True)
def predict_lanes(state: Simulation, visits: Visits, reads: bool) -> None:
    """Predict the states ``visits.x`` (n, L) and roots ``visits.S`` (n, n, L) of L nodes, in place,
    by the matrices in the E rows of ``visits.values`` (E, L): x = exp(A g) x and P = Q_g + F P (I +
    G_g P)^-1 F', with G_g = 0 and F = exp(A g) unless ``reads``.
    """
    size, n, values = state.size, len(state.size), visits.values
    S = local_lanes_matrix(size, MANY, visits.old_S)
    V = local_lanes_matrix(size, MANY, visits.V)
    T = local_lanes_matrix(size, MANY, visits.T)
    # Local arrays of a size known at compile time stay in registers.
    for i in range(n):
        for j in range(i + 1):
            store(MANY, S, i, j, load(MANY, visits.S, i, j))
    # S <- root of P (I + G_g P)^-1.
    if reads:
        condition_root(MANY, size, S, values, V)
    # x <- exp(A g) x, then the root of F P F' + Q_g with Q_g = T T'.
    moved = local_lanes_vector(size, MANY, visits.moved)
    propagate_mean(MANY, size, visits.x, values, moved)
    cholesky_in_lanes(MANY, size, T, values)
    predict_root_lanes(MANY, size, S, values, offset_of_F(n, reads), V, T)
    for i in range(n):
        for j in range(i + 1):
            store(MANY, visits.S, i, j, load(MANY, S, i, j))


@kernel
def combine_pairs(state: Simulation, visits: Visits, k: int, count: int) -> None:
    """Combine the two nodes of each of the visits ``visits.pairs[k:k + count]`` (visits of two
    nodes that exchange estimates), one visit in each of at most L lanes; the nodes that receive the
    other's estimate change in ``state.xhat`` and ``root``.
    """
    exchange, places, receivers = visits.exchange, visits.places, visits.receiver_places
    for q in range(LANES):
        receivers[0, q] = receivers[1, q] = NO_NODE
    for q in range(count):
        visit = visits.records[visits.pairs[k + q]]
        places[0, q], places[1, q] = visit.first, visit.second
        if visit.to_first != NOT_HEARD:
            receivers[0, q] = visit.first
            exchange.weight_row[0, q] = visits.weight_row[visit.to_first]
        if visit.to_second != NOT_HEARD:
            receivers[1, q] = visit.second
            exchange.weight_row[1, q] = visits.weight_row[visit.to_second]
    # Both send what they knew before.
    for side in range(2):
        gather_states(state, places[side], count, exchange.xhat[side], exchange.root[side])
    send_both(exchange)
    for side in range(2):
        if receive(exchange, side, receivers[side]):
            scatter_states(state, receivers[side], exchange.xhat[side], exchange.root[side])
