"""Filters side by side, eight visits at a time, where messages take no time.

What happens, and when, does not depend on estimates then. So ``agenda`` goes through the events of
runs first and leaves visits: a node is predicted to a time, or two nodes are and combine what they
have. The level of a visit is one more than that of the visits before it of the same nodes. Visits
of one level have no node in common: their nodes, in whatever run they are, are predicted and
combined side by side in the lanes of vector registers (linalg/lanes.py). Lanes do not mix, so a
visit leaves the same bits in whatever company it is computed.

What a lane cannot do, a prediction in several steps, is made alone by the kernels of the event
loop.
"""

from __future__ import annotations

import numpy as np

from netkf.algorithms.kernels.root_flow import (
    cell_of,
    information_rate,
    is_quick,
    move_mean,
    move_root,
    place_of_flow,
    root_size,
    shrink_root,
    take_root,
    transform,
    use_moments,
    width_of,
)
from netkf.algorithms.kernels.root_update import absorb_columns
from netkf.engines.compiled.event_loop import show_all
from netkf.engines.compiled.increments import next_stretch, use_stretch
from netkf.engines.compiled.lane_readings import (
    LaneReadings,
    begin_reading,
    empty_readings,
    end_readings,
    know_model,
    read_alone,
)
from netkf.engines.compiled.lane_series import (
    LaneSeries,
    most_moments,
)
from netkf.engines.compiled.state import Filters, Simulation
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import LANES, MANY, gather, load, scatter, store, turn, with_spare
from netkf.linalg.local import local_lanes_matrix, local_lanes_vector
from netkf.linalg.series import fill_row
from netkf.linalg.structs import Struct

MOST_VISITS = 1 << 14
"""Visits that wait: their records fit the processor's cache."""

NOBODY, EVERYBODY, NOT_HEARD, SENSES, UNKNOWN = -1, -2, -1, -1, -1
BLIND, SENSING = 0, 1

_NUMBERS = ("next", "first", "second", "to_first", "to_second", "run", "piece")
VISIT = np.dtype([*((name, np.int32) for name in _NUMBERS), ("time", np.float64)], align=True)
"""The nodes at the places ``first`` and ``second`` (NOBODY: there is only one) are predicted to
``time``, which lies in the ``piece`` of the path of their ``run``, and hear each other over the
directed links ``to_first`` and ``to_second``, or NOT_HEARD. Where ``second`` is EVERYBODY all nodes
of the run, from ``first`` on, are shown as sample ``piece``. ``next`` is another visit of the same
level, or -1.
"""


STRETCH = np.dtype(
    [*((name, np.int64) for name in ("place", "visit")), ("now", float), ("least", float)]
)
"""The node at a place has come to ``now`` on its way to a visit, see ``next_stretch``."""


LANE = np.dtype(
    [*((name, np.int64) for name in ("visit", "model")), ("now", float), ("end", float)]
)
"""A prediction from ``now`` to ``end`` on the way to a visit."""


class Visits(Struct):
    """Visits that wait, and arrays to work with.

    ``records`` (C,), of which ``count`` are used; the ``level`` (F,) of each place's last visit,
    the ``first`` visit of each level (C + 2,) or -1, and the highest level, ``top``. Those of a
    level that combine, ``pairs`` (C,), and the stretches that sensing nodes still have before them,
    ``stretches`` (2^k >= F,), a ring of ``begun`` up to ``added``. ``model`` (F,) of the nodes at
    places, SENSES of those with sensors, and the ``longest`` gap (M,) that one step of a model
    spans. ``shares`` (K, 4), own weight and that of the message, and their roots: row
    ``share[w]`` (W,) is that of directed link w.

    Predictions side by side, of nodes without sensors, of which some are ``waiting`` for company,
    and with them: ``lanes`` (2, L), their ``places`` (2, L), what their series give, ``blind_rows``
    and ``sensing_rows`` (L, W), and ``readings``. Pairs side by side: the places ``hearing`` (2, L)
    of those that hear the other, and the shares of both ends ``in_lanes`` (8, L), those of the rows
    ``known`` (2, L). The same by entry, of all lanes: ``columns``
    (W, L), ``values`` (E, L) and ``gains`` (3 n q, L), states ``x`` and ``other_x`` (n, L), ``S``
    and ``other_S`` (n, n, L); V, T (n, n, L) and ``moved`` (n, L) are scratch.
    """

    records: np.ndarray
    level: IntArray
    first: IntArray
    pairs: IntArray
    stretches: np.ndarray
    model: IntArray
    longest: FloatArray
    share: IntArray
    shares: FloatArray
    lanes: np.ndarray
    places: IntArray
    hearing: IntArray
    known: IntArray
    in_lanes: FloatArray
    blind: LaneSeries
    sensing: LaneSeries
    blind_rows: FloatArray
    sensing_rows: FloatArray
    readings: LaneReadings
    columns: FloatArray
    values: FloatArray
    gains: FloatArray
    x: FloatArray
    other_x: FloatArray
    S: FloatArray
    other_S: FloatArray
    V: FloatArray
    T: FloatArray
    moved: FloatArray
    waiting: int
    count: int
    top: int
    begun: int
    added: int


def empty_visits(
    filters: Filters, weights: FloatArray, places: int, series: tuple[LaneSeries, LaneSeries]
) -> Visits:
    """No visits, of filters at so many ``places``; ``weights`` (W,) of directed links, ``series``
    of nodes without sensors and with them.
    """
    n, most = filters.xhat.shape[1], max(MOST_VISITS, 4 * places)
    distinct, share = np.unique(weights, return_inverse=True)
    own, table = np.maximum(0.0, 1.0 - distinct), filters.table
    (blind, sensing), q = series, most_moments(filters)
    shapes = {
        "gains": (3 * n * q, LANES),
        **dict.fromkeys(("x", "other_x", "moved"), (n, LANES)),
        **dict.fromkeys(("S", "other_S", "V", "T"), (n, n, LANES)),
        "in_lanes": (8, LANES),
    }
    for name, lane_table in (("blind", blind), ("sensing", sensing)):
        shapes[f"{name}_rows"] = (LANES, lane_table.series.shape[3])
    width = max(blind.series.shape[3], sensing.series.shape[3])
    shapes |= {"columns": (width, LANES), "values": (n * (n + 1) + 2 * n * n, LANES)}
    nodes = filters.nodes
    model = np.where(nodes["sensors"] > nodes["sensor"], SENSES, nodes["model"])
    return Visits(
        records=np.zeros(most, dtype=VISIT),
        level=np.zeros(places, dtype=np.int64),
        first=np.full(most + 2, -1, dtype=np.int64),
        pairs=np.zeros(most, dtype=np.int64),
        model=np.tile(model, places // len(nodes)),
        longest=table.unit * 2.0 ** table.sizes[:, 4],
        share=share.astype(np.int64).reshape(-1),
        shares=np.stack([own, distinct, np.sqrt(own), np.sqrt(distinct)], axis=1),
        readings=empty_readings(filters),
        lanes=np.zeros((2, LANES), dtype=LANE),
        places=np.zeros((2, LANES), dtype=np.int64),
        hearing=np.zeros((2, LANES), dtype=np.int64),
        known=np.full((2, LANES), UNKNOWN, dtype=np.int64),
        blind=blind,
        sensing=sensing,
        **{name: with_spare(shape) for name, shape in shapes.items()},
        stretches=np.zeros(1 << (places - 1).bit_length(), dtype=STRETCH),
        waiting=0,
        count=0,
        top=0,
        begun=0,
        added=0,
    )


# What the agenda leaves.


@kernel
def add_visit(
    state: Simulation, visits: Visits, level: int, time: float, first: int, second: int
) -> int:
    """Add a visit of nodes at places ``first`` and ``second``; returns its number."""
    v = visits.count
    visits.count = v + 1
    visit = visits.records[v]
    visit.first, visit.second, visit.time = first, second, time
    visit.to_first = visit.to_second = NOT_HEARD
    visit.run, visit.piece = state.run, state.piece
    visit.next = visits.first[level]
    visits.first[level] = v
    visits.top = max(visits.top, level)
    return v


@kernel
def visit_one(state: Simulation, visits: Visits, time: float, place: int) -> None:
    """The node at a place is predicted."""
    level = visits.level[place] + 1
    visits.level[place] = level
    add_visit(state, visits, level, time, place, NOBODY)


@kernel
def show_later(state: Simulation, visits: Visits, first: int) -> None:
    """All nodes of a run, from place ``first`` on, are shown once they have been visited."""
    level = 0
    for h in range(len(state.nodes)):
        level = max(level, visits.level[first + h])
    level += 1
    for h in range(len(state.nodes)):
        visits.level[first + h] = level
    v = add_visit(state, visits, level, 0.0, first, EVERYBODY)
    visits.records[v].piece = state.samples


# Visits, level by level.


@kernel
def make_visits(state: Simulation, visits: Visits) -> None:
    """Make all visits that wait."""
    for level in range(1, visits.top + 1):
        make_level(state, visits, visits.first[level])
        visits.first[level] = -1
    visits.count = visits.top = 0
    for place in range(len(visits.level)):
        visits.level[place] = 0


@kernel
def make_level(state: Simulation, visits: Visits, first: int) -> None:
    """Make the visits of a level, of which one is ``first``."""
    v, pairs = first, 0
    while v != -1:
        visit = visits.records[v]
        if visit.second == EVERYBODY:
            show_all(state, visit.run, visit.first, visit.piece)
        else:
            join(state, visits, v, visit.first)
            if visit.second != NOBODY:
                join(state, visits, v, visit.second)
                visits.pairs[pairs] = v
                pairs += 1
        v = visit.next
    # All of them are predicted before any combine.
    predict_blind(state, visits)
    use_stretches(state, visits)
    for k in range(0, pairs, LANES):
        combine_pairs(state, visits, k, min(LANES, pairs - k))


@kernel
def join(state: Simulation, visits: Visits, v: int, place: int) -> None:
    """Let the node at a place wait for its prediction, or make it at once where it is to be made
    alone.
    """
    visit, now = visits.records[v], state.now[place]
    # A node may have several visits at one time: it is predicted with the first of them.
    if not now < visit.time:
        return
    state.now[place] = visit.time
    m, gap = visits.model[place], visit.time - now
    if m == SENSES:
        add_stretch(visits, place, v, now, 0.0)
        return
    # Nothing is observed, so that P may be as wide as it is: one step moves it if the gap is short.
    if not gap < visits.longest[m]:
        move_root(state.table, m, state.root, state.xhat, place, gap, state.flow_scratch)
        return
    q = visits.waiting
    visits.waiting = q + 1
    use_lane(visits, BLIND, q, place, v, m, now, visit.time)
    if q + 1 == LANES:
        predict_blind(state, visits)


@kernel
def node_at(state: Simulation, run: int, place: int) -> int:
    """Return the number of the node of a run that is at a place."""
    return place - (run - state.first_run) * len(state.nodes)


@kernel(inlined=True)
def in_ring(visits: Visits, number: int) -> int:
    """Return the place of a stretch: the remainder by a power of two, without a division."""
    return number & (len(visits.stretches) - 1)


@kernel
def add_stretch(visits: Visits, place: int, v: int, now: float, least: float) -> None:
    """A node has come to ``now`` on its way to visit ``v``."""
    # A node is on its way to one visit of a level only, so the ring has space for all.
    stretch = visits.stretches[in_ring(visits, visits.added)]
    stretch.place, stretch.visit, stretch.now, stretch.least = place, v, now, least
    visits.added += 1


@kernel
def use_stretches(state: Simulation, visits: Visits) -> None:
    """Bring all sensing nodes of a level to their visits."""
    while visits.begun < visits.added:
        # What follows a stretch is added while it is used.
        count = min(LANES, visits.added - visits.begun)
        for q in range(count):
            stretch = visits.stretches[in_ring(visits, visits.begun + q)]
            visits.places[SENSING, q] = stretch.place
        take_states(state, visits.places[SENSING], count, visits.x, visits.S)
        fill_rates(state, visits, count)
        for q in range(count):
            begin_stretch(state, visits, q)
        predict_sensing(state, visits, count)


@kernel
def fill_rates(state: Simulation, visits: Visits, count: int) -> None:
    """Write trace(P G) and trace(P) of the nodes in lanes, of which so many are used."""
    size, readings = state.size, visits.readings
    for q in range(count):
        stretch = visits.stretches[in_ring(visits, visits.begun + q)]
        visit = visits.records[stretch.visit]
        h = node_at(state, visit.run, stretch.place)
        know_model(readings, q, state.nodes[h].model, state.table.seen)
    store(MANY, readings.rate, 0, information_rate(MANY, size, readings.seen, visits.S))
    store(MANY, readings.trace, 0, root_size(MANY, size, visits.S))


@kernel
def begin_stretch(state: Simulation, visits: Visits, q: int) -> None:
    """Take the next stretch, whose node is in lane q: let it use the lane, or use it at once where
    it is to be used alone.
    """
    stretch, readings = visits.stretches[in_ring(visits, visits.begun)], visits.readings
    place, now, v = stretch.place, stretch.now, stretch.visit
    visits.begun += 1
    visit = visits.records[v]
    h = node_at(state, visit.run, place)
    m, time = state.nodes[h].model, visit.time
    end, least = next_stretch(readings.rate[0, q], now, time, stretch.least)
    if is_quick(state.table, m, end - now, readings.trace[0, q]):
        use_lane(visits, SENSING, q, place, v, m, now, end)
    else:
        visits.places[SENSING, q] = NOBODY
        use_stretch(state, visit.run, h, place, visit.piece, now, end)
    if end < time:
        add_stretch(visits, place, v, end, least)


@kernel(inlined=True)
def use_lane(
    visits: Visits, kind: int, q: int, place: int, v: int, m: int, now: float, end: float
) -> None:
    """Give a node at a place, with model ``m``, lane q among those of its kind, for its prediction
    from ``now`` to ``end``.
    """
    lane = visits.lanes[kind, q]
    lane.visit, lane.model, lane.now, lane.end = v, m, now, end
    visits.places[kind, q] = place


@kernel
def read_in_lanes(state: Simulation, visits: Visits, count: int) -> None:
    """Write the moments of the readings of the nodes in lanes."""
    places, readings = visits.places[SENSING], visits.readings
    for q in range(LANES):
        readings.stream[q] = NOBODY
    for q in range(count):
        if places[q] == NOBODY:
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
def take_states(
    state: Simulation, places: IntArray, count: int, x: FloatArray, S: FloatArray
) -> None:
    """Copy the states at ``count`` places into lanes; the places of other lanes are NOBODY's."""
    n = len(state.size)
    for q in range(count, LANES):
        places[q] = NOBODY
    for first in range(0, n, LANES):
        gather(MANY, state.xhat, places, first, x)
    for first in range(0, n * n, LANES):
        gather(MANY, state.root, places, first, S)


@kernel
def put_states(state: Simulation, places: IntArray, x: FloatArray, S: FloatArray) -> None:
    """Copy them back, but not to NOBODY's place."""
    n = len(state.size)
    for first in range(0, n, LANES):
        scatter(MANY, x, first, state.xhat, places, n - first)
    for first in range(0, n * n, LANES):
        scatter(MANY, S, first, state.root, places, n * n - first)


@kernel
def predict_blind(state: Simulation, visits: Visits) -> None:
    """Predict the nodes without sensors that wait."""
    n, count, places = len(state.size), visits.waiting, visits.places[BLIND]
    if count == 0:
        return
    visits.waiting = 0
    # What lanes do alone goes from lane to lane in short loops: a processor overlaps their turns.
    for q in range(count):
        fill_lane(state, visits, BLIND, q, visits.blind, visits.blind_rows)
    take_states(state, places, count, visits.x, visits.S)
    turn_rows(visits.blind_rows, visits.columns)
    spread_columns(visits.columns, visits.blind.place, 0, width_of(n, False), visits.values)
    predict_lanes(state, visits, False)
    put_states(state, places, visits.x, visits.S)


@kernel
def predict_sensing(state: Simulation, visits: Visits, count: int) -> None:
    """Predict the nodes with sensors in lanes, whose states are there, and use their readings."""
    places = visits.places[SENSING]
    for q in range(count):
        if places[q] != NOBODY:
            fill_lane(state, visits, SENSING, q, visits.sensing, visits.sensing_rows)
    read_in_lanes(state, visits, count)
    turn_rows(visits.sensing_rows, visits.columns)
    width = width_of(len(state.size), True)
    spread_columns(visits.columns, visits.sensing.place, 0, width, visits.values)
    spread_columns(visits.columns, visits.sensing.place, width, len(visits.gains), visits.gains)
    predict_lanes(state, visits, True)
    moments = visits.readings.moments
    use_moments(MANY, state.size, visits.S, visits.x, visits.gains, moments)
    put_states(state, places, visits.x, visits.S)


@kernel
def fill_lane(
    state: Simulation, visits: Visits, kind: int, q: int, series: LaneSeries, rows: FloatArray
) -> None:
    """Write what the series of the model in a lane give for its gap into its row."""
    lane = visits.lanes[kind, q]
    cell, since = cell_of(state.table.unit[lane.model], lane.end - lane.now)
    fill_row(rows, q, series.series, series.row[lane.model], cell, since)


@kernel
def turn_rows(rows: FloatArray, out: FloatArray) -> None:
    """Write rows (L, W) as (W, L)."""
    for j in range(0, rows.shape[1], LANES):
        turn(MANY, rows, j, out)


@kernel
def spread_columns(
    columns: FloatArray, place: IntArray, first: int, count: int, out: FloatArray
) -> None:
    """Write ``count`` entries, of which the ``first`` is that of ``place``."""
    for e in range(count):
        store(MANY, out, e, load(MANY, columns, place[first + e]))


@kernel(fused=True)
def predict_lanes(state: Simulation, visits: Visits, reads: bool) -> None:
    """Move the states in ``x`` and ``S`` by what is in ``values``, with readings or without."""
    size, n, values = state.size, len(state.size), visits.values
    S, V, T = (
        local_lanes_matrix(size, MANY, visits.other_S),
        local_lanes_matrix(size, MANY, visits.V),
        local_lanes_matrix(size, MANY, visits.T),
    )
    for i in range(n):
        for j in range(i + 1):
            store(MANY, S, i, j, load(MANY, visits.S, i, j))
    if reads:
        shrink_root(MANY, size, S, values, V)
    moved = local_lanes_vector(size, MANY, visits.moved)
    move_mean(MANY, size, visits.x, values, moved)
    take_root(MANY, size, T, values)
    transform(MANY, size, S, values, place_of_flow(n, reads), V, T)
    for i in range(n):
        for j in range(i + 1):
            store(MANY, visits.S, i, j, load(MANY, S, i, j))


@kernel
def combine_pairs(state: Simulation, visits: Visits, k: int, count: int) -> None:
    """Let the nodes of ``count`` visits hear each other, from place ``k`` of ``pairs`` on."""
    records, places = visits.records, visits.places
    heard_0, heard_1 = False, False
    for q in range(count):
        visit = records[visits.pairs[k + q]]
        places[0, q], places[1, q] = visit.first, visit.second
        heard_0 = hear_in_lane(visits, 0, q, visit.to_first, visit.first) or heard_0
        heard_1 = hear_in_lane(visits, 1, q, visit.to_second, visit.second) or heard_1
    for q in range(count, LANES):
        visits.hearing[0, q] = visits.hearing[1, q] = NOBODY
    # Both are as they were before either hears the other.
    take_states(state, places[0], count, visits.x, visits.S)
    take_states(state, places[1], count, visits.other_x, visits.other_S)
    if heard_0:
        combine_lanes(state, visits, 0, visits.x, visits.S, visits.other_x, visits.other_S)
        put_states(state, visits.hearing[0], visits.moved, visits.V)
    if heard_1:
        combine_lanes(state, visits, 1, visits.other_x, visits.other_S, visits.x, visits.S)
        put_states(state, visits.hearing[1], visits.moved, visits.V)


@kernel
def hear_in_lane(visits: Visits, side: int, lane: int, way: int, place: int) -> bool:
    """Note in a lane that the node at a place hears something on a directed link, and by which
    shares; False, and nobody's lane, where nothing is heard.
    """
    if way == NOT_HEARD:
        visits.hearing[side, lane] = NOBODY
        return False
    visits.hearing[side, lane] = place
    share = visits.share[way]
    if visits.known[side, lane] != share:
        visits.known[side, lane] = share
        for k in range(4):
            visits.in_lanes[4 * side + k, lane] = visits.shares[share, k]
    return True


@kernel(fused=True)
def combine_lanes(
    state: Simulation,
    visits: Visits,
    side: int,
    x: FloatArray,
    S: FloatArray,
    other_x: FloatArray,
    other_S: FloatArray,
) -> None:
    """Write H (7) and (9) into ``moved`` and ``V``: of x and S with what they hear of others."""
    size, n, values = state.size, len(state.size), visits.in_lanes
    total, wide = local_lanes_matrix(size, MANY, visits.V), local_lanes_matrix(size, MANY, visits.T)
    own, weight = load(MANY, values, 4 * side), load(MANY, values, 4 * side + 1)
    own_root, root = load(MANY, values, 4 * side + 2), load(MANY, values, 4 * side + 3)
    for i in range(n):
        mean = own * load(MANY, x, i) + weight * load(MANY, other_x, i)
        store(MANY, visits.moved, i, mean)
        for j in range(i + 1):
            store(MANY, total, i, j, own_root * load(MANY, S, i, j))
            store(MANY, wide, i, j, root * load(MANY, other_S, i, j))
    absorb_columns(MANY, size, total, wide)
    for i in range(n):
        for j in range(i + 1):
            store(MANY, visits.V, i, j, load(MANY, total, i, j))
