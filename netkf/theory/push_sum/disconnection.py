"""The probability that link failures disconnect a network: p_d of paper P Assumption 3.

A transfer-matrix method over the nodes in an elimination order. A node is open while it has both
eliminated neighbours and neighbours still to come. All that matters about the links so far is how
they partition the open nodes into connected parts, so that the algorithm carries the probability of
each partition from link to link. If a part loses its last open node while others remain, the
network is disconnected. Exact, and fast as long as few nodes are open at a time.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.network.graphs import Topology
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.common.evidence import no_channel_law
from netkf.theory.numerics.matrices import as_integer

if TYPE_CHECKING:
    import networkx

MAX_PARTITIONS = 120_000  # partitions of open nodes at once: bounds time and memory
MAX_ROOTS = 12  # first nodes of an elimination order that are tried
MAX_OPEN = 40  # open nodes at a time; with more there are far too many partitions
MAX_SAMPLES, MIN_SAMPLES, NODE_SAMPLES = 200_000, 2_000, 2e7  # the last: samples times nodes
MAX_DRAWS = 2_000_000  # draws of links in one array
CONFIDENCE = 0.99  # of the interval of an estimated probability

Edge = tuple[Any, Any]


class Probability(float):
    """A probability with its accuracy.

    low, high : equal to it if ``exact``, else an interval of 99 % confidence by simulation
    exact     : True if it was computed, not estimated
    """

    low: float
    high: float
    exact: bool

    def __new__(cls, value: float, low: float, high: float, exact: bool) -> Probability:
        """Return ``value`` with its interval; ``exact``: computed, not estimated."""
        probability = super().__new__(cls, value)
        probability.low, probability.high, probability.exact = low, high, exact
        return probability

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
    """Return the probability p_d that the links which are up do not connect all nodes.

    ``graph``: undirected; a networkx graph, a Topology, pairs of nodes or a Scenario.
    ``delivery``: the probability that a link is up, one for all or one for each pair; by default
    that of the scenario's channel. Links fail independently, in both directions together.

    The result is a float with ``low``, ``high`` and ``exact``: exact if at most 120,000 partitions
    of open nodes occur (any graph of ten nodes, grids ten wide), else an estimate from ``samples``
    draws (default: 200,000, and fewer in networks of more than 100 nodes, so that it takes
    seconds). Raises TheoryError for directed graphs, and for links without a probability or with
    one outside [0, 1].
    """
    seed = as_integer("seed", seed, 0, np.inf)
    samples = None if samples is None else as_integer("samples", samples, 1)
    if isinstance(graph, Scenario) and delivery is None:
        return _scenario_probability(graph, seed, samples)
    return _probability(*_link_probabilities(graph, delivery), seed, samples)


@lru_cache(maxsize=8)
def _scenario_probability(scenario: Scenario, seed: int, samples: int | None) -> Probability:
    return _probability(*_link_probabilities(scenario, None), seed, samples)


def _probability(
    nodes: int, probabilities: dict[tuple[int, int], float], seed: int, samples: int | None
) -> Probability:
    neighbours: list[dict[int, float]] = [{} for _ in range(nodes)]
    for (i, j), p in probabilities.items():
        if p > 0.0:
            neighbours[i][j] = neighbours[j][i] = p
    pairs = np.array([(i, j) for i, links in enumerate(neighbours) for j in links], dtype=np.int64)
    pairs = pairs.reshape(-1, 2).T
    adjacency = scipy.sparse.coo_array((np.ones(pairs.shape[1]), pairs), shape=(nodes, nodes))
    if scipy.sparse.csgraph.connected_components(adjacency, directed=False)[0] > 1:
        return Probability(1.0, 1.0, 1.0, exact=True)
    # Greedy orders from several first nodes: a node is open while some neighbours are not taken.
    roots = sorted(range(nodes), key=lambda node: len(neighbours[node]))[:MAX_ROOTS]
    orders = [found for root in roots if (found := _greedy_order(neighbours, root)) is not None]
    cut = _exact_probability(neighbours, min(orders)[1]) if orders else None
    if cut is not None:
        return Probability(cut, cut, cut, exact=True)
    if samples is None:
        samples = int(np.clip(NODE_SAMPLES / nodes, MIN_SAMPLES, MAX_SAMPLES))
    return _estimate(nodes, probabilities, seed, samples)


def _link_probabilities(
    graph: Any, delivery: float | Mapping[Edge, float] | None
) -> tuple[int, dict[tuple[int, int], float]]:
    """Return the number of nodes and the probability of each link; raises TheoryError."""
    if isinstance(graph, Scenario):
        if delivery is None:
            delivery = _channel_probabilities(graph)
        graph = graph.topology
    names, links = _nodes_and_links(graph)
    index = {name: k for k, name in enumerate(names)}
    probabilities: dict[tuple[int, int], float] = {}
    for link in links:
        i, j = sorted(index[end] for end in link)
        # Self-loops connect nothing.
        if i == j:
            continue
        p = _link_probability(link, delivery)
        if probabilities.setdefault((i, j), p) != p:
            raise TheoryError(f"link {link} has two probabilities: {probabilities[i, j]} and {p}")
    return len(names), probabilities


def _nodes_and_links(graph: Any) -> tuple[list[Any], list[Edge]]:
    if isinstance(graph, Topology):
        names, links, directed = list(graph.nodes), list(graph.links), graph.directed
    else:
        names, links, directed = _read_graph(graph)
    if directed:
        raise TheoryError("the graph must be undirected")
    if not names:
        raise TheoryError("the graph must have a node")
    if any(isinstance(name, float) and math.isnan(name) for name in names):
        raise TheoryError("nan is not the name of a node, as it does not equal itself")
    return names, links


def _read_graph(graph: Any) -> tuple[list[Any], list[Edge], bool]:
    import networkx

    if isinstance(graph, networkx.Graph):
        links = [(i, j) for i, j in graph.edges()]
        if graph.is_multigraph() and graph.number_of_edges() > networkx.Graph(graph).size():
            raise TheoryError(
                "nodes have several links in parallel; give one with the probability that any of "
                "them delivers"
            )
        return list(graph.nodes), links, graph.is_directed()
    try:
        links = [(i, j) for i, j in graph]
        nodes = list(dict.fromkeys(node for link in links for node in link))
    except (TypeError, ValueError):
        message = "graph must be a graph, a scenario or pairs of nodes"
        raise TheoryError(f"{message}, got a {type(graph).__name__}") from None
    return nodes, links, False


def _link_probability(link: Edge, delivery: float | Mapping[Edge, float] | None) -> float:
    p: Any = None
    if isinstance(delivery, Mapping):
        p = delivery.get(link, delivery.get(link[::-1]))
    elif delivery is not None:
        p = delivery
    if p is None:
        raise TheoryError(f"delivery must be given for link {link}")
    try:
        probability = float(p)
    except (TypeError, ValueError):
        message = "delivery must be a number, or a mapping from links to numbers"
        raise TheoryError(f"{message}, got {p!r}") from None
    if not 0.0 <= probability <= 1.0:
        raise TheoryError(f"delivery must lie in [0, 1], got {p!r} for link {link}")
    return probability


def _channel_probabilities(scenario: Scenario) -> dict[Edge, float]:
    """Return the probability that each link is up in both directions; raises TheoryError."""
    channel, probabilities = scenario.network.channel, {}
    for i, j in scenario.topology.links:
        forward, backward = (scenario.mean_delivery(direction) for direction in ((i, j), (j, i)))
        if math.isnan(forward + backward):
            raise TheoryError(f"{no_channel_law(scenario)}: give delivery")
        if forward != backward or (not channel.symmetric and 0.0 < forward < 1.0):
            raise TheoryError("the two directions of a link fail apart: give delivery")
        probabilities[i, j] = forward
    return probabilities


def _greedy_order(neighbours: list[dict[int, float]], root: int) -> tuple[float, list[int]] | None:
    """Return the effort (number of partitions) and a greedy order from ``root``, or None."""
    # The next node closes the most open nodes, and then adds the fewest candidates.
    waiting = [set(links) for links in neighbours]  # the neighbours of each node still to come
    effort, order, opened, eliminated = 0.0, [], set[int](), set[int]()
    candidates = {root}
    while candidates:
        ranked = []
        for node in candidates:
            adjacent = neighbours[node].keys()
            closed = sum(len(waiting[neighbour]) == 1 for neighbour in adjacent & opened)
            stays = int(not adjacent <= eliminated)  # the node itself would be open
            ranked.append((stays - closed, len(adjacent - eliminated - candidates), node))
        node = min(ranked)[-1]
        order.append(node)
        eliminated.add(node)
        opened.add(node)
        for neighbour in neighbours[node]:
            waiting[neighbour].discard(node)
        opened = {k for k in opened if waiting[k]}
        if len(opened) > MAX_OPEN:
            return None
        candidates = (candidates | neighbours[node].keys()) - eliminated
        effort += 3.0 ** len(opened)  # about the number of partitions of the open nodes
    return effort, order


def _exact_probability(neighbours: list[dict[int, float]], order: list[int]) -> float | None:
    """Return the probability that the network is disconnected, None for too many partitions."""
    # Nodes are added one by one with their links to earlier ones; a node is open until all its
    # neighbours are added. A partition says which open nodes are connected so far: the labels of
    # their parts, numbered in order of appearance.
    index = {node: k for k, node in enumerate(order)}
    # A node stays open until all of its neighbours have been opened.
    last = [max(index[k] for k in (node, *links)) for node, links in enumerate(neighbours)]
    open_: list[int] = []
    states: dict[tuple[int, ...], float] = {(): 1.0}
    cuts = []
    for k, node in enumerate(order):
        open_.append(node)
        # A new node starts as a part of its own.
        states = {(*labels, len(labels)): p for labels, p in states.items()}
        for x, neighbour in enumerate(open_):
            if neighbour in neighbours[node]:
                states = _apply_link(states, x, neighbours[node][neighbour])
            if len(states) > MAX_PARTITIONS:
                return None
        if k + 1 < len(order):
            keep = [x for x, member in enumerate(open_) if last[member] > k]
            states, lost = _close_nodes(states, keep)
            cuts.append(lost)
            open_ = [open_[x] for x in keep]
    cuts.append(math.fsum(p for labels, p in states.items() if max(labels) > 0))
    return math.fsum(cuts)


def _apply_link(
    states: dict[tuple[int, ...], float], index: int, up: float
) -> dict[tuple[int, ...], float]:
    """Return the probabilities of partitions after the link between ``index`` and the last node."""
    # A partition is the tuple of the labels of the open nodes' connected parts.
    partitions: defaultdict[tuple[int, ...], float] = defaultdict(float)
    for labels, p in states.items():
        first, second = labels[index], labels[-1]
        # Both ends are connected already: the state of the link does not matter.
        if first == second:
            partitions[labels] += p
            continue
        if up < 1.0:
            partitions[labels] += p * (1.0 - up)
        partitions[_renumber([first if x == second else x for x in labels])] += p * up
    return dict(partitions)


def _close_nodes(
    states: dict[tuple[int, ...], float], keep: list[int]
) -> tuple[dict[tuple[int, ...], float], float]:
    """Return the probabilities of partitions of the nodes ``keep``, and that of a cut."""
    # A cut: a part of which no node stays open.
    partitions: defaultdict[tuple[int, ...], float] = defaultdict(float)
    lost = []
    for labels, p in states.items():
        open_labels = [labels[k] for k in keep]
        # Some part has no open node left: later links cannot reach it.
        if len(set(open_labels)) < len(set(labels)):
            lost.append(p)
        else:
            partitions[_renumber(open_labels)] += p
    return dict(partitions), math.fsum(lost)


def _renumber(labels: list[int]) -> tuple[int, ...]:
    """Return the labels numbered in order of appearance, so that equal partitions are equal."""
    names: dict[int, int] = {}
    return tuple([names.setdefault(x, len(names)) for x in labels])


def _estimate(
    nodes: int, probabilities: dict[tuple[int, int], float], seed: int, samples: int
) -> Probability:
    """Return the share of ``samples`` draws that are disconnected, with Clopper-Pearson ends."""
    edges = np.array(list(probabilities))
    edge_probabilities = np.array(list(probabilities.values()))
    random, cut, draws_done = Streams(seed).generator("links"), 0, 0
    # The links of each node, one node after the other: all are in some link.
    ends = np.argsort(edges.ravel(), kind="stable")
    first = np.searchsorted(edges.ravel()[ends], np.arange(nodes))
    while draws_done < samples:
        count = min(samples - draws_done, max(1, MAX_DRAWS // len(edges)))
        up = random.random((count, len(edges))) < edge_probabilities
        draws_done += count
        # Mostly a cut leaves a node alone, which takes less time to find.
        up = up[np.logical_or.reduceat(up[:, ends // 2], first, axis=1).all(axis=1)]
        cut, count = cut + count - len(up), len(up)
        # All draws are one graph with a copy of the nodes for each.
        draw, link = np.nonzero(up)
        rows, columns = (draw * nodes + edges[link, end] for end in (0, 1))
        matrix = scipy.sparse.coo_array(
            (np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(count * nodes,) * 2
        )
        _, label = scipy.sparse.csgraph.connected_components(matrix, directed=False)
        components = label.reshape(count, nodes)
        cut += int((components != components[:, :1]).any(axis=1).sum())
    # The bounds of Clopper and Pearson are quantiles of beta distributions.
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = scipy.special.betaincinv(cut, samples - cut + 1, tail) if cut else 0.0
    high = scipy.special.betaincinv(cut + 1, samples - cut, 1.0 - tail) if cut < samples else 1.0
    return Probability(cut / samples, float(low), float(high), exact=False)
