"""The probability that failing links cut a network in two: p_d of P Assumption 3.

Links are taken in an order in which few nodes are open, that is, touched by links before and after.
What matters of the links before is only which open nodes they join, so the probability of each such
partition is carried from link to link; a part that closes away from the rest is a cut. Exact, and
quick while few nodes are open at a time, however many links there are.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import networkx
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.special

from netkf.core.errors import TheoryError
from netkf.network.graphs import Topology
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario

MAX_PARTITIONS = 120_000
MAX_ROOTS = 12
MAX_OPEN = 40  # nodes open at a time, from which on partitions are far too many
SAMPLES, MIN_SAMPLES, NODE_SAMPLES = 200_000, 2_000, 2e7
BATCH = 2_000_000  # link draws
CONFIDENCE = 0.99

Edge = tuple[Any, Any]


class Probability(float):
    """A probability that says how well it is known.

    low, high : equal to it where ``exact``, else an interval of 99 % confidence by simulation
    exact     : whether it was computed, not estimated
    """

    low: float
    high: float
    exact: bool

    def __new__(cls, value: float, low: float, high: float, exact: bool) -> Probability:
        """The value with its interval."""
        made = super().__new__(cls, value)
        made.low, made.high, made.exact = low, high, exact
        return made

    def __repr__(self) -> str:
        if self.exact:
            return f"{float(self)!r} (exact)"
        return f"{float(self)!r} ({CONFIDENCE:.0%} within {self.low:.6g} .. {self.high:.6g})"

    def __reduce__(self) -> tuple[Any, ...]:
        return Probability, (float(self), self.low, self.high, self.exact)


def disconnection_probability(
    graph: networkx.Graph[Any] | Topology | Scenario | Iterable[Edge],
    delivery: float | Mapping[Edge, float] | None = None,
    seed: int = 0,
    samples: int | None = None,
) -> Probability:
    """The probability that the links which are up leave the network unconnected, p_d.

    ``graph``: undirected; a networkx graph, a Topology, pairs of nodes or a Scenario.
    ``delivery``: the probability that a link is up, one for all or one for each pair; by default
    that of the scenario's channel. Links fail independently, in both directions together.

    A float with ``low``, ``high`` and ``exact``: exact while at most 120,000 partitions of open
    nodes occur (any graph of ten nodes, grids ten wide), else the estimate of ``samples`` draws
    (default: 200,000, and fewer in networks of more than 100 nodes, so that it takes seconds).
    Raises TheoryError for directed graphs, and for links without a probability or with one outside
    [0, 1].
    """
    if isinstance(graph, Scenario) and delivery is None:
        return _of_scenario(graph, seed, samples)
    return _computed(*_network(graph, delivery), seed, samples)


@lru_cache(maxsize=8)
def _of_scenario(scenario: Scenario, seed: int, samples: int | None) -> Probability:
    """Kept, because assumptions and promises both ask for it."""
    return _computed(*_network(scenario, None), seed, samples)


def _computed(
    nodes: int, chances: dict[tuple[int, int], float], seed: int, samples: int | None
) -> Probability:
    """Exact where that is within reach, else simulated."""
    neighbours: list[dict[int, float]] = [{} for _ in range(nodes)]
    for (i, j), p in chances.items():
        if p > 0.0:
            neighbours[i][j] = neighbours[j][i] = p
    if not _reaches_all(neighbours):
        return Probability(1.0, 1.0, 1.0, True)
    order = _order(neighbours)
    cut = None if order is None else _cut(neighbours, order)
    if cut is not None:
        return Probability(cut, cut, cut, True)
    if samples is None:
        samples = int(np.clip(NODE_SAMPLES / nodes, MIN_SAMPLES, SAMPLES))
    return _simulated(nodes, chances, seed, samples)


def _network(
    graph: Any, delivery: float | Mapping[Edge, float] | None
) -> tuple[int, dict[tuple[int, int], float]]:
    """The number of nodes and the probability of each link between two of their places."""
    if isinstance(graph, Scenario):
        if delivery is None:
            delivery = _of_channel(graph)
        graph = graph.topology
    directed = graph.is_directed() if isinstance(graph, networkx.Graph) else False
    if isinstance(graph, Topology):
        names, links, directed = list(graph.nodes), list(graph.links), graph.directed
    elif isinstance(graph, networkx.Graph):
        names, links = list(graph.nodes), [(i, j) for i, j in graph.edges()]
    else:
        links = [(i, j) for i, j in graph]
        names = list(dict.fromkeys(node for link in links for node in link))
    if directed:
        raise TheoryError("the graph must be undirected")
    if not names:
        raise TheoryError("the graph must have a node")
    place = {name: k for k, name in enumerate(names)}
    found = {}
    for link in links:
        i, j = sorted(place[end] for end in link)
        if i != j:
            found[i, j] = _chance(link, delivery)
    return len(names), found


def _chance(link: Edge, delivery: float | Mapping[Edge, float] | None) -> float:
    p: Any = None
    if isinstance(delivery, Mapping):
        p = delivery.get(link, delivery.get(link[::-1]))
    elif delivery is not None:
        p = delivery
    if p is None:
        raise TheoryError(f"delivery must be given for link {link}")
    try:
        chance = float(p)
    except (TypeError, ValueError):
        words = "delivery must be a number, or a mapping from links to numbers"
        raise TheoryError(f"{words}, got {p!r}") from None
    if not 0.0 <= chance <= 1.0:
        raise TheoryError(f"delivery must lie in [0, 1], got {p!r} for link {link}")
    return chance


def _of_channel(scenario: Scenario) -> dict[Edge, float]:
    """The probability that a link is up in both directions, where these fail together."""
    channel, chances = scenario.network.channel, {}
    for i, j in scenario.topology.links:
        one, other = (
            channel.loss.mean_delivery(way, scenario.table_probability(way))
            for way in ((i, j), (j, i))
        )
        if math.isnan(one + other):
            raise TheoryError("the channel is a record, not a law: give delivery")
        if one != other or (not channel.symmetric and 0.0 < one < 1.0):
            raise TheoryError("the two directions of a link fail apart: give delivery")
        chances[i, j] = one
    return chances


def _reaches_all(neighbours: list[dict[int, float]]) -> bool:
    seen, waiting = {0}, [0]
    while waiting:
        for node in neighbours[waiting.pop()].keys() - seen:
            seen.add(node)
            waiting.append(node)
    return len(seen) == len(neighbours)


def _order(neighbours: list[dict[int, float]]) -> list[int] | None:
    """All nodes, so that few are open at a time: greedy, from several first nodes; None where too
    many are open in every order found.
    """
    nodes = range(len(neighbours))
    fewest = sorted(nodes, key=lambda node: len(neighbours[node]))[:MAX_ROOTS]
    found = [_greedy(neighbours, root) for root in fewest]
    return min((one for one in found if one is not None), default=(0.0, None))[1]


def _greedy(neighbours: list[dict[int, float]], root: int) -> tuple[float, list[int]] | None:
    """A guess of how many partitions there will be, and the order that was found; None as soon as
    more than MAX_OPEN nodes are open.

    Next comes the node that closes most open ones and then opens fewest further ones.
    """
    waiting = [set(links) for links in neighbours]
    effort, order, opened, taken = 0.0, [], set[int](), set[int]()
    candidates = {root}
    while candidates:
        ranked = []
        for node in candidates:
            near = neighbours[node].keys()
            closed = sum(len(waiting[other]) == 1 for other in near & opened)
            stays = int(not near <= taken)
            ranked.append((stays - closed, len(near - taken - candidates), node))
        node = min(ranked)[-1]
        order.append(node)
        taken.add(node)
        opened.add(node)
        for other in neighbours[node]:
            waiting[other].discard(node)
        opened = {k for k in opened if waiting[k]}
        if len(opened) > MAX_OPEN:
            return None
        candidates = (candidates | neighbours[node].keys()) - taken
        effort += 3.0 ** len(opened)
    return effort, order


def _cut(neighbours: list[dict[int, float]], order: list[int]) -> float | None:
    """The probability of a cut; None where too many partitions occur.

    A partition is the tuple of the labels of the open nodes, numbered as they first appear.
    """
    place = {node: k for k, node in enumerate(order)}
    last = [max((place[k] for k in links), default=0) for links in neighbours]
    open_: list[int] = []
    states: dict[tuple[int, ...], float] = {(): 1.0}
    cuts = []
    for k, node in enumerate(order):
        open_.append(node)
        states = {(*labels, len(labels)): p for labels, p in states.items()}
        for other in [x for x in open_ if x in neighbours[node]]:
            states = _joined(states, open_.index(other), neighbours[node][other])
            if len(states) > MAX_PARTITIONS:
                return None
        keep = [x for x, other in enumerate(open_) if max(last[other], place[other]) > k]
        if k + 1 < len(order):
            states, lost = _closed(states, keep)
            cuts.append(lost)
            open_ = [open_[x] for x in keep]
    cuts.append(math.fsum(p for labels, p in states.items() if max(labels) > 0))
    return math.fsum(cuts)


def _joined(
    states: dict[tuple[int, ...], float], place: int, up: float
) -> dict[tuple[int, ...], float]:
    """Partitions after the link between the open node at ``place`` and the last one."""
    found: defaultdict[tuple[int, ...], float] = defaultdict(float)
    for labels, p in states.items():
        one, other = labels[place], labels[-1]
        if one == other:
            found[labels] += p
            continue
        if up < 1.0:
            found[labels] += p * (1.0 - up)
        found[_numbered([one if x == other else x for x in labels])] += p * up
    return dict(found)


def _closed(
    states: dict[tuple[int, ...], float], keep: list[int]
) -> tuple[dict[tuple[int, ...], float], float]:
    """Partitions of the nodes that stay open, and the probability that some part had none."""
    found: defaultdict[tuple[int, ...], float] = defaultdict(float)
    lost = []
    for labels, p in states.items():
        rest = [labels[k] for k in keep]
        if len(set(rest)) < len(set(labels)):
            lost.append(p)
        else:
            found[_numbered(rest)] += p
    return dict(found), math.fsum(lost)


def _numbered(labels: list[int]) -> tuple[int, ...]:
    names: dict[int, int] = {}
    return tuple([names.setdefault(x, len(names)) for x in labels])


def _simulated(
    nodes: int, chances: dict[tuple[int, int], float], seed: int, samples: int
) -> Probability:
    """The share of cut networks among draws, with its Clopper-Pearson interval."""
    ends, up = np.array(list(chances)), np.array(list(chances.values()))
    random, cut, done = Streams(seed).generator("links"), 0, 0
    while done < samples:
        count = min(samples - done, max(1, BATCH // len(ends)))
        which, link = np.nonzero(random.random((count, len(ends))) < up)
        rows, columns = (which * nodes + ends[link, end] for end in (0, 1))
        matrix = scipy.sparse.coo_array(
            (np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count * nodes,) * 2
        )
        _, label = scipy.sparse.csgraph.connected_components(matrix, directed=False)
        parts = label.reshape(count, nodes)
        cut += int((parts != parts[:, :1]).any(axis=1).sum())
        done += count
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = scipy.special.betaincinv(cut, samples - cut + 1, tail) if cut else 0.0
    high = scipy.special.betaincinv(cut + 1, samples - cut, 1.0 - tail) if cut < samples else 1.0
    return Probability(cut / samples, float(low), float(high), False)
