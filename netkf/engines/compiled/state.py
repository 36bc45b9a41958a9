"""The state of the event loop: a run as plain arrays in a few named groups.

Numbers that belong to one node, message or directed link are fields of a record, so that they have
names in compiled code too. No type depends on the size of a scenario: one compiled loop fits all.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.gains import Gains, stack_gains
from netkf.algorithms.kernels.root_flow import FlowScratch, FlowTable, flow_scratch, stack_tables
from netkf.algorithms.models import FlowModel, RateModel, first_roots
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.quantiser import Quantiser
from netkf.engines.compiled.senders import senders_of
from netkf.linalg.arrays import FloatArray, IntArray, enlarged
from netkf.linalg.structs import Size, Struct
from netkf.plants.laws import course_width
from netkf.scenario.scenario import Scenario


def _record_type(integers: str, floats: str = "") -> np.dtype:
    # int64 fields first, then float64 ones: every field is aligned without padding.
    fields = [(name, np.int64) for name in integers.split()]
    return np.dtype([*fields, *((name, np.float64) for name in floats.split())])


NODE = _record_type("model id sensor sensors inbox last sent reading down", "offset pace")
"""One filter.

model : index of its model
id : id in the trace, -1 if pooled
sensor, sensors : its increment sensors are those with indices ``sensor`` to ``sensors`` - 1
inbox, last : first and last message of its inbox, -1: none
sent : number of transmissions so far
reading : index of the instant of its newest sample
down : 1 while it neither senses, sends nor hears
offset, pace : at time t its clock shows ``offset + pace t``, seconds
"""

DIRECTED_LINK = _record_type("sender receiver messages", "weight")
"""A directed link: indices of sender and receiver, number of messages so far, their weight."""

ENTITY = _record_type("sender other first after")
"""An entity with a clock: a link, a directed link or a node.

sender, other : the node that sends, and the other end of a link, else -1
first, after : it sends on the directed links ``Simulation.outgoing[first:after]``
"""

MESSAGE = _record_type("direction number next order tag", "sent arrival")
"""A message under way or in an inbox.

direction, number : directed link, and number on it
next : next message in the same inbox, or among the free ones
order : number of the message on the heap, which orders simultaneous arrivals
tag : instant of the reading that is sent
sent, arrival : seconds
"""

NOBODY = -2  # the number of a block that nobody estimates
LINKS, DIRECTIONS, NODES, AFTER_READINGS = range(4)
"""The values of ``Senders.at`` in the order of traits.CLOCKS. From NODES on nodes broadcast: one
transmission to all receivers.
"""


class Scratch(Struct):
    """Scratch arrays; p is the largest number of increment rows of a node.

    moments : (2 p,), of a reading
    early, cut : (2, p), noise of the first part of a divided step, and the normals that divide it
    state_moments, total : (2, n), moments of x over an interval, and their sum over pieces
    values : values of the longest series at a gap
    """

    moments: FloatArray
    early: FloatArray
    cut: FloatArray
    state_moments: FloatArray
    total: FloatArray
    values: FloatArray


class Sensing(Struct):
    """S increment sensors of R runs.

    rows, kind : (S,), number of rows; sensors of one kind have the same H and R
    H, root : (S, p, n) and the root of R (S, p, p)
    noise, steps : (R S steps, 2, p), run by run and sensor by sensor, the moments of the noise of
                   each of ``steps`` steps as far as it is not read yet: a reading of a part of a
                   step takes its share of the noise away
    cuts : (R S, 4), streams of normals that divide the noise of a step
    height, width, inside : numpy's ziggurat table for these
    index, node : (K,), index and id of the nodes with increment sensors, which read at each point
                  of the grid, in order
    """

    rows: IntArray
    kind: IntArray
    H: FloatArray
    root: FloatArray
    noise: FloatArray
    steps: int
    cuts: np.ndarray
    height: FloatArray
    width: FloatArray
    inside: np.ndarray
    index: IntArray
    node: IntArray


class Instants(Struct):
    """K instants at which a node has samples, S samples in all.

    t, index : (K,), time and index of the node
    first : (K + 1,), samples of instant k begin at ``first[k]``
    node, y : (S,) and (S, p), of each sample
    sensor, matrix : (S,), index of its noise and of its H
    block : (S,), number of the block that it is also about and that its node does not estimate, -1:
            none, NOBODY: one that nobody estimates
    rows, root : (L,) and the root of R (L, p, p), by sensor
    H : (M, p, n), by matrix, of the states of a filter, then of such a block
    scale : (S,), by which the gate of a node multiplied each sample once it was whitened, 0 if it
            ignores it; empty without a gate
    nonlinear : ``nonlinear_samples.NonlinearTable``
    """

    t: FloatArray
    index: IntArray
    first: IntArray
    node: IntArray
    y: FloatArray
    sensor: IntArray
    matrix: IntArray
    block: IntArray
    rows: IntArray
    root: FloatArray
    H: FloatArray
    scale: FloatArray
    nonlinear: Any


class PathBlock(Struct):
    """Some steps of the sensing grid of R runs, cut into K pieces where a state is sampled.

    end : end of the last step, seconds
    start, stop : (K,), times at which pieces begin and end
    x_start, x_stop, moments, cubic : (R, K, n), (R, K, n), (R, K, 2, n) and (R, K, 3, n), the state
                                      at both ends, its moments, and a cubic of the path
    step, last : (K,), number of the step that a piece belongs to, and the time at which that ends
    grid : times at which increment sensors are read
    table : ``course_table`` of the plant's laws
    course, known : (G, C, D, W) and (G, C), a cache for the G runs that are simulated together: the
                    polynomials of x in C pieces, and the numbers of these; piece k is in entry k
                    modulo C

    If nothing senses increments there is one piece, which ends at infinity.
    """

    end: float
    start: FloatArray
    stop: FloatArray
    x_start: FloatArray
    x_stop: FloatArray
    moments: FloatArray
    cubic: FloatArray
    step: IntArray
    last: FloatArray
    grid: FloatArray
    table: FloatArray
    course: FloatArray
    known: np.ndarray


class TickArrays(Struct):
    """The K ticks of a window of time, or those of several runs one after the other.

    end : seconds; from here on ticks are not drawn yet
    t, entity : (K,), time in seconds, and index of the entity whose clock ticks
    first_outcome : (K,), the outcomes of tick k begin at ``delay[first_outcome[k]]``, one for each
                    directed link of its entity
    delay : seconds that each message takes, negative or nan if it is lost
    arrival_bits : (K,), if no message takes time: bit m is 1 if message m of a tick arrives
    owner, link : where nodes move, ``moving_links.MovingLinks``; the window is the whole run then
    """

    end: float
    t: FloatArray
    entity: IntArray
    first_outcome: IntArray
    delay: FloatArray
    arrival_bits: IntArray
    owner: IntArray
    link: IntArray


class SampleBuffer(Struct):
    """Space for B samples of all N nodes in R runs.

    Python takes many at a time, since a call of the loop costs more than a sample.

    xhat, P : (R, B, N, n) and (R, B, N, n, n)
    rows, counts : rows (R, B) of events, or events by kind (R, B, len(KINDS)), before each sample
    """

    xhat: FloatArray
    P: FloatArray
    rows: IntArray
    counts: IntArray


class Simulation(Struct):
    """The state of the event loop: R runs, of which G are simulated together.

    Filters

    size, nodes : n as a type (linalg.structs), and NODE records (N,)
    plant : likewise the number of states of the plant, of which filters may estimate a part
    xhat, root : (G N, n) and (G N, n, n)
    now : time (G N,) in seconds, by the node's clock, that each estimate refers to
    table, gains : tables of all models, the last without sensors, for messages under way
    clock_kind : kind of its clocks, LINKS, DIRECTIONS, NODES or AFTER_READINGS

    Links and messages

    entities, directions : ENTITY records (E,) and DIRECTED_LINK records (W,)
    outgoing : indices of directed links, those of each entity together
    pool : MESSAGE records (C,)
    first_free, free_count : first free message of the pool, and number of free ones
    most_messages : largest number of messages that one event may send
    incoming : (W,), number of each directed link among all links sorted by receiver and sender
    newest_only : 1 if of several messages of one sender at one instant the newest counts
    heap, in_flight, order : heap (C,) of messages under way, number of these, and of all that were
                             ever put there
    waiting, receivers : nodes (N,) with messages in their inbox, and number of these
    absorbing, inbox_time : how many of them have absorbed, and the instant (seconds)
    age_limit : messages older than this, in seconds, are late

    Events to come; ``..._at`` is the index of the next one

    instants, instant_at : samples of nodes
    sensing, grid_at, wake_at : increment sensors, point of the sensing grid, node that reads there
    path, piece : path of the plant, and its present piece
    ticks, tick_at, ticks_stop, first_delay : ticks, where those of this run end, and where their
                                              outcomes begin
    link_at : the next change of a link, of those in ``ticks``
    frames, frame_at : times (F,) at which frames begin
    lives, waking, life_at : times (K,) at which nodes go up or down, and the index of each if it
                             reads increments while it is up, else -1
    quantiser, clipped : how payloads are quantised, and how many numbers of the message that is
                         being sent were clipped
    probes, probe_at : times (T,) of samples
    run, first_run : number of the present run, and of the first one
    horizon, per_second : seconds, and ticks of the time grid in a second (core.instants)

    Results

    buffer, samples : space for samples, and number of samples in it
    traced, rows, row : whether rows of events are written, the rows, and the next one
    most_rows : largest number of rows that one event may need
    counts : number of events of each kind (len(KINDS),)

    Scratch

    scratch, flow_scratch : arrays for computations.
    """

    size: Size
    plant: Size
    nodes: np.ndarray
    xhat: FloatArray
    root: FloatArray
    now: FloatArray
    table: FlowTable
    gains: Gains
    entities: np.ndarray
    outgoing: IntArray
    directions: np.ndarray
    incoming: IntArray
    pool: np.ndarray
    heap: IntArray
    waiting: IntArray
    instants: Instants
    sensing: Sensing
    path: PathBlock
    ticks: TickArrays
    frames: FloatArray
    lives: FloatArray
    waking: IntArray
    quantiser: Quantiser
    probes: FloatArray
    buffer: SampleBuffer
    rows: np.ndarray
    counts: IntArray
    scratch: Scratch
    flow_scratch: FlowScratch
    clock_kind: int
    newest_only: int
    traced: int
    run: int
    first_run: int
    ticks_stop: int
    first_delay: int
    frame_at: int
    life_at: int
    piece: int
    grid_at: int
    wake_at: int
    instant_at: int
    tick_at: int
    link_at: int
    probe_at: int
    row: int
    most_rows: int
    most_messages: int
    first_free: int
    free_count: int
    in_flight: int
    order: int
    receivers: int
    absorbing: int
    clipped: int
    samples: int
    horizon: float
    per_second: float
    age_limit: float
    inbox_time: float


class Filters(NamedTuple):
    """The filters at time 0: NODE records ``nodes`` (N,), estimates ``xhat`` (N, n), roots of their
    covariances ``root`` (N, n, n), and the tables of all models for prediction and for gains.
    """

    nodes: np.ndarray
    xhat: FloatArray
    root: FloatArray
    table: FlowTable
    gains: Gains


@once_per_scenario
def filters_at_start(scenario: Scenario) -> Filters:
    """Return all N filters at time 0, or the one that reads all sensors if they are pooled."""
    # A pooled filter is one node with the id -1, which belongs to no node of the network.
    ids, pooled = scenario.nodes, scenario.node_filter.timing.pooled
    all_pieces = wide_models(scenario)
    models = all_pieces[0]
    # Nodes that share a model share its table, in each piece of the plant.
    pieces = [list({id(m): m for m in piece}.values()) for piece in all_pieces]
    index = {id(model): k for k, model in enumerate(pieces[0])}
    filtering_nodes = ids[:1] if pooled else ids
    starts = [scenario.initial_estimate(node) for node in filtering_nodes]
    counts = [len(scenario.increment_sensors.get(node, ())) for node in ids]
    # Increment sensors of all nodes in one list: each has those up to ``sensors``.
    after = np.array([sum(counts)] if pooled else np.cumsum(counts), dtype=np.int64)
    nodes = np.zeros(len(starts), dtype=NODE)
    nodes["model"] = [index[id(model)] for model in models]
    nodes["id"] = [-1] if pooled else ids
    # ``sensor`` of the first node stays 0.
    nodes["sensors"], nodes["sensor"][1:] = after, after[:-1]
    nodes["inbox"] = nodes["reading"] = -1
    nodes["pace"] = 1.0
    # One table for each distinct model; those of models that are not linear are not used.
    table, gains = _stack_model_tables([[_linear(m) for m in piece] for piece in pieces])
    n = len(models[0].information)
    starts = [(enlarged(mean, n), enlarged(cov, n, n)) for mean, cov in starts]
    xhat = np.stack([mean for mean, _ in starts])
    return Filters(nodes, xhat, first_roots([cov for _, cov in starts]), table, gains)


@once_per_scenario
def wide_models(scenario: Scenario) -> list[Sequence[FlowModel]]:
    """Return the models of all filters, of each piece of the plant: all with as many states as the
    widest estimates, of which nothing drives those that are added. Equal ones are one object.
    """
    if scenario.views is None or scenario.node_filter.timing.pooled:
        return list(scenario.model_pieces)
    known: dict[Any, list[FlowModel]] = {}
    w, columns = scenario.model_width, []
    for models in zip(*scenario.model_pieces, strict=True):
        parts = [(m.A, m.Q, m.H, m.R) for m in models]
        key = tuple((M.shape, M.tobytes()) for part in parts for M in part)
        if key not in known:
            known[key] = [
                dataclasses.replace(
                    m, A=enlarged(m.A, w, w), Q=enlarged(m.Q, w, w), H=enlarged(m.H, len(m.H), w)
                )
                for m in models
            ]
        columns.append(known[key])
    return list(zip(*columns, strict=True))


def _linear(model: FlowModel) -> FlowModel:
    if not isinstance(model, RateModel):
        return model
    n = len(model.Q)
    nothing = np.zeros((n, n)), np.zeros((n, n)), np.zeros((0, n)), np.zeros((0, 0))
    return FlowModel(*nothing, model.horizon, model.interval)


def _stack_model_tables(pieces: list[list[FlowModel]]) -> tuple[FlowTable, Gains]:
    """Return the tables of the M models of each piece and of one without sensors, and of gains."""
    # The last model of a piece has no sensors: it predicts messages under way.
    flows = [[*(model.flow for model in models), models[0].unobserved_flow] for models in pieces]
    gains = [model.gains for models in pieces for model in (*models, models[0])]
    # Without changes the gains of the last model are left out: they are not used.
    gains = gains if len(pieces) > 1 else gains[:-1]
    return stack_tables([flow for piece in flows for flow in piece]), stack_gains(gains)


@once_per_scenario
def entity_records(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return the records of entities (E,) and directed links (W,) before a run."""
    senders, index = senders_of(scenario), scenario.topology.index
    entities = np.zeros(len(senders.entities), dtype=ENTITY)
    # (i, j) of a link or direction, (i, -1) of a node. The ids become indices below.
    ends = np.array([(*e, -1)[:2] for e in senders.entities], dtype=np.int64).reshape(-1, 2)
    index_of = np.vectorize(lambda node: index.get(node, -1), otypes=[np.int64])
    if len(ends):
        entities["sender"], entities["other"] = index_of(ends[:, 0]), index_of(ends[:, 1])
    # The -1 above only fills the array and must not be taken for the id of a node.
    if senders.at != "links":
        entities["other"][:] = [index[e[1]] if len(e) > 1 else -1 for e in senders.entities]
    entities["first"], entities["after"] = senders.first[:-1], senders.first[1:]
    directions = np.zeros(len(senders.directions), dtype=DIRECTED_LINK)
    directions["sender"] = [index[i] for i, _ in senders.directions]
    directions["receiver"] = [index[j] for _, j in senders.directions]
    directions["weight"] = [scenario.weight(j, i) for i, j in senders.directions]
    return entities, directions


def scratch_arrays(
    table: FlowTable, gains: Gains, unrolled: bool, n: int
) -> tuple[Scratch, FlowScratch]:
    """Return scratch for models of a plant of ``n`` states; ``unrolled``: of types that know n."""
    max_moments, width = int(gains.moments.max()), gains.series.shape[2]
    scratch = Scratch(
        moments=np.zeros(max_moments),
        # Two moments for each row.
        early=np.zeros((2, max_moments // 2)),
        cut=np.zeros((2, max_moments // 2)),
        state_moments=np.zeros((2, n)),
        total=np.zeros((2, n)),
        # fill_state_moments() needs two rows of a course.
        values=np.zeros(max(width, 2 * course_width(n))),
    )
    return scratch, flow_scratch(table, unrolled)


def empty_pool(capacity: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a pool of ``capacity`` messages, all free, and the heap of those under way."""
    pool = np.zeros(capacity, dtype=MESSAGE)
    pool["next"] = np.arange(1, capacity + 1)
    return pool, np.zeros(capacity, np.int64)


def add_messages(state: Simulation, at_least: int) -> None:
    """Enlarge the pool of messages: to twice as many, or by ``at_least`` if these are more."""
    # Doubling keeps the cost of copies proportional to the messages.
    capacity = len(state.pool)
    added = max(capacity, at_least)
    pool, heap = empty_pool(added)
    pool["next"] = np.arange(capacity + 1, capacity + added + 1)
    # The new messages come first in the list of free ones.
    pool["next"][-1], state.first_free = state.first_free, capacity
    state.free_count += added
    state.pool = np.concatenate([state.pool, pool])
    state.heap = np.concatenate([state.heap, heap])
