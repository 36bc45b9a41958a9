"""What the replay works on: everything of a run as plain arrays, in a few named groups.

All arrays are writable and contiguous and types never change from scenario to scenario, so that
one compiled replay fits them all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.gains import GainTable
from netkf.algorithms.models import FlowModel
from netkf.core.arrays import FloatArray
from netkf.scenario.scenario import Scenario

# Places in Cursor.place.
TICK_AT, STEP_AT, GRID_AT, AWAKE, PROBE_AT, ROW, FREE, HEAP, WAITING, READY, SENT, SHOWN = range(12)
PLACES = 12


class Models(NamedTuple):
    """M models and, last, the one that predicts: their tables one after the other.

    unit (M + 1,), series (M + 1, terms, 5 n n + 1), ``blind`` (M + 1, terms, 2 n n + 1) of those
    that see nothing, jump, F, G, Q (M + 1, levels, n, n), information (M + 1, n, n); gains flat
    with a model's from ``first`` on, ``shape`` (M + 1, 3) = rows 2p of its moments, terms and width
    of its series.
    """

    unit: FloatArray
    series: FloatArray
    blind: FloatArray
    jump: FloatArray
    F: FloatArray
    G: FloatArray
    Q: FloatArray
    information: FloatArray
    gains: FloatArray
    first: np.ndarray
    shape: np.ndarray


class Hosts(NamedTuple):
    """H filters: model (H,), node id to record (H,), xhat (H, n), P (H, n, n), the time ``now``
    (H,) that they have reached, their sensors from ``sensors[h]`` to ``sensors[h + 1]``, the first
    message of their inbox (-1: none), and the ``least`` stretch (H,) of readings that they use at
    once on their way (0: they stand).
    """

    model: np.ndarray
    node: np.ndarray
    xhat: FloatArray
    P: FloatArray
    now: FloatArray
    sensors: np.ndarray
    inbox: np.ndarray
    least: FloatArray


class Sensing(NamedTuple):
    """S sensors: rows p (S,), H (S, p, n), root of R (S, p, p), the rest of the present step's
    noise (S, 2, p) and which step that is (S,); noise of the steps (S, steps, 2, p) and normals
    for cuts (S, count, 2, p), of which ``used`` (S,) are gone. ``host`` and ``node`` (K,) say who
    wakes at a grid point, in their order.
    """

    rows: np.ndarray
    H: FloatArray
    root: FloatArray
    rest: FloatArray
    step: np.ndarray
    noise: FloatArray
    normals: FloatArray
    used: np.ndarray
    host: np.ndarray
    node: np.ndarray


class Links(NamedTuple):
    """L links: hosts at both ends (L, 2), weight (L, 2) of a message forth and back, how many
    ``messages`` (L,) went each way so far; ``ways`` is 1 or 2.
    """

    ends: np.ndarray
    weight: FloatArray
    messages: np.ndarray
    ways: int


class Mail(NamedTuple):
    """A pool of C messages on their way or in an inbox, and the heap of arrivals.

    xhat (C, n), P (C, n, n), sent (C,), way (C,) = 2 link + direction, number (C,), ``next`` (C,)
    in the same inbox or in the list of free ones; heap by (time, way, order of sending); waiting
    (H,) hosts with mail.
    """

    xhat: FloatArray
    P: FloatArray
    sent: FloatArray
    way: np.ndarray
    number: np.ndarray
    next: np.ndarray
    arrival: FloatArray
    order: np.ndarray
    heap: np.ndarray
    waiting: np.ndarray


class Room(NamedTuple):
    """Room to work in, since compiled functions make no arrays: E (5 n n,), X (n + 1, n), Y (n, n)
    for the flow; moments (2 p,) and noise ``early`` (2, p) for the most rows p of any host, moments
    ``seen`` (2, n) of x, ``values`` of the longest series, ``of_x`` (n,), ``from_noise`` (2, 4).
    """

    E: FloatArray
    X: FloatArray
    Y: FloatArray
    moments: FloatArray
    early: FloatArray
    seen: FloatArray
    values: FloatArray
    of_x: FloatArray
    from_noise: FloatArray


class Parts(NamedTuple):
    """Room for what one covariance intersection combines, the own pair and D others: weight
    (D + 1,), xhat (D + 1, n), P (D + 1, n, n).
    """

    weight: FloatArray
    xhat: FloatArray
    P: FloatArray


def model_tables(models: list[FlowModel]) -> Models:
    """The tables of the models, and of prediction without readings last."""
    flows = [model.riccati for model in models] + [models[0].prediction]
    n = flows[0].n
    levels = max(len(flow.F) for flow in flows)

    def stacked(name: str) -> FloatArray:
        out = np.full((len(flows), levels, n, n), np.nan)
        for row, flow in zip(out, flows, strict=True):
            table = getattr(flow, name)
            row[: len(table)] = table
        return out

    blind = np.zeros((len(flows), *flows[-1].blind.shape))
    for row, flow in zip(blind, flows, strict=True):
        row[: len(flow.blind)] = flow.blind
    gains = [model.gains if len(model.H) else GainTable(n, 0, np.zeros((0, 0))) for model in models]
    gains.append(GainTable(n, 0, np.zeros((0, 0))))
    sizes = [gain.series.size for gain in gains]
    return Models(
        unit=np.array([flow.unit for flow in flows], dtype=np.float64),
        series=np.stack([flow.series for flow in flows]),
        blind=blind,
        jump=stacked("jump"),
        F=stacked("F"),
        G=stacked("G"),
        Q=stacked("Q"),
        information=np.stack([*(model.information for model in models), np.zeros((n, n))]),
        gains=np.concatenate([gain.series.ravel() for gain in gains]),
        first=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        shape=np.array([(gain.moments, *gain.series.shape) for gain in gains], dtype=np.int64),
    )


def host_tables(scenario: Scenario) -> tuple[Hosts, Models]:
    """The filters at time 0; where they are pooled, one stands for all."""
    nodes, pooled = scenario.nodes, scenario.filter.algorithm.pooled
    models = (scenario.pooled_model,) if pooled else scenario.models
    distinct = list({id(model): model for model in models}.values())
    place = {id(model): k for k, model in enumerate(distinct)}
    starts = [scenario.start(node) for node in (nodes[:1] if pooled else nodes)]
    counts = [len(scenario.placed.get(node, ())) for node in nodes]
    sensors = np.cumsum([0, sum(counts)] if pooled else [0, *counts])
    hosts = Hosts(
        model=np.array([place[id(model)] for model in models], dtype=np.int64),
        node=np.array([-1] if pooled else nodes, dtype=np.int64),
        xhat=np.stack([mean for mean, _ in starts]),
        P=np.stack([cov for _, cov in starts]),
        now=np.zeros(len(starts)),
        sensors=sensors.astype(np.int64),
        inbox=np.full(len(starts), -1, dtype=np.int64),
        least=np.zeros(len(starts)),
    )
    return hosts, model_tables(distinct)


def link_tables(scenario: Scenario) -> Links:
    """Both ends of all links, and what a message counts."""
    talks, topology = scenario.filter.algorithm.talks, scenario.topology
    links = topology.links if talks else ()
    index = topology.index
    weights = [(scenario.weight(j, i), scenario.weight(i, j)) for i, j in links]
    return Links(
        ends=np.array([(index[i], index[j]) for i, j in links], dtype=np.int64).reshape(-1, 2),
        weight=np.array(weights, dtype=np.float64).reshape(-1, 2),
        messages=np.zeros(len(links), dtype=np.int64),
        ways=1 if topology.directed else 2,
    )


def room_for(models: Models) -> Room:
    """Room for all that these models move."""
    n, (most, _, width) = models.F.shape[2], models.shape.max(axis=0)
    return Room(
        E=np.zeros(5 * n * n),
        X=np.zeros((n + 1, n)),
        Y=np.zeros((n, n)),
        moments=np.zeros(most),
        early=np.zeros((2, most // 2)),
        seen=np.zeros((2, n)),
        values=np.zeros(max(width, 2 * n * n)),
        of_x=np.zeros(n),
        from_noise=np.zeros((2, 4)),
    )


def room_for_parts(links: Links, hosts: Hosts) -> Parts:
    """Room for all neighbours of the node that has most."""
    size, n = hosts.xhat.shape
    most = 1 + int(np.bincount(links.ends.ravel(), minlength=size).max())
    return Parts(np.zeros(most), np.zeros((most, n)), np.zeros((most, n, n)))


def empty_mail(hosts: Hosts, capacity: int) -> Mail:
    """A pool whose messages are all free."""
    n = hosts.xhat.shape[1]
    whole = np.zeros(capacity, dtype=np.int64)
    return Mail(
        xhat=np.zeros((capacity, n)),
        P=np.zeros((capacity, n, n)),
        sent=np.zeros(capacity),
        way=whole.copy(),
        number=whole.copy(),
        next=np.arange(1, capacity + 1),
        arrival=np.zeros(capacity),
        order=whole.copy(),
        heap=whole.copy(),
        waiting=np.zeros(len(hosts.now), dtype=np.int64),
    )


def larger(mail: Mail) -> Mail:
    """Twice the pool; the new messages are free, and the first of them is the list of free ones."""
    old = len(mail.sent)
    pool = {name: part for name, part in mail._asdict().items() if name != "waiting"}
    grown = {name: np.concatenate([part, np.zeros_like(part)]) for name, part in pool.items()}
    made = mail._replace(**grown)
    made.next[old:] = np.arange(old + 1, 2 * old + 1)
    return made
