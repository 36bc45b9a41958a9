"""Who can hear whom: the graph kinds of a scenario and the topology that each of them builds."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.core.csv_files import read_columns, read_header, whole
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    SourceFile,
    boolean,
    field,
    integer,
    number,
    positive,
    probability,
    row,
    several,
    source_file,
)

if TYPE_CHECKING:
    import networkx

Link = tuple[int, int]
MOST_TRIES = 1000
MOST_NODES, MOST_LINKS = 1_000_000, 10_000_000


@dataclass(frozen=True, eq=False)
class Topology:
    """Nodes and links of one network.

    nodes     : ids in increasing order
    links     : sorted pairs, (i, j) with i < j unless ``directed`` (then from i to j)
    delivery  : measured probability that a message from i reaches j, where the graph has them
    positions : (x, y) of each node, where the graph has them
    notes     : one line each about what was left out
    left_out  : nodes that the graph names and does not have
    """

    nodes: tuple[int, ...]
    links: tuple[Link, ...]
    directed: bool = False
    delivery: dict[Link, float] | None = None
    positions: dict[int, tuple[float, float]] | None = None
    notes: tuple[str, ...] = ()
    left_out: frozenset[int] = frozenset()

    @cached_property
    def index(self) -> dict[int, int]:
        """Place of each node id in ``nodes``."""
        return {node: k for k, node in enumerate(self.nodes)}

    @cached_property
    def degrees(self) -> dict[int, int]:
        """Number of links at each node (incoming ones where the graph is directed)."""
        degrees = dict.fromkeys(self.nodes, 0)
        for i, j in self.links:
            degrees[j] += 1
            if not self.directed:
                degrees[i] += 1
        return degrees

    @cached_property
    def laplacian_radius(self) -> float:
        """rho(L), the largest eigenvalue of the Laplacian of all links."""
        from netkf.network.spectra import laplacian_radius

        return laplacian_radius(self)

    @cached_property
    def directions(self) -> tuple[Link, ...]:
        """(sender, receiver) of all messages that can be sent: both ways unless directed."""
        back = () if self.directed else tuple((j, i) for i, j in self.links)
        return tuple(sorted((*self.links, *back)))

    @cached_property
    def _receivers(self) -> dict[int, tuple[int, ...]]:
        return self._ends(0)

    @cached_property
    def _senders(self) -> dict[int, tuple[int, ...]]:
        return self._ends(1)

    def _ends(self, end: int) -> dict[int, tuple[int, ...]]:
        found: dict[int, list[int]] = {node: [] for node in self.nodes}
        for direction in self.directions:
            found[direction[end]].append(direction[1 - end])
        return {node: tuple(sorted(others)) for node, others in found.items()}

    def receivers(self, node: int) -> tuple[int, ...]:
        """Ids of the nodes that may hear ``node``, in increasing order."""
        return self._receivers[node]

    def senders(self, node: int) -> tuple[int, ...]:
        """Ids of the nodes that ``node`` may hear, in increasing order."""
        return self._senders[node]

    @cached_property
    def components(self) -> list[set[int]]:
        """The connected parts (weakly connected where the graph is directed), largest first."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        ends = np.array([(self.index[i], self.index[j]) for i, j in self.links]).reshape(-1, 2)
        ones, size = np.ones(len(ends)), len(self.nodes)
        _, labels = connected_components(coo_array((ones, tuple(ends.T)), shape=(size, size)))
        order = np.argsort(labels, kind="stable")
        parts = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
        found = [{self.nodes[k] for k in part.tolist()} for part in parts]
        return sorted(found, key=len, reverse=True)


def demand_links(source: SourceFile, pairs: Iterable[Link], topology: Topology) -> None:
    """Raise ScenarioError where a file names a pair that is no link of the graph."""
    links = set(topology.links)
    if not topology.directed:
        links |= {(j, i) for i, j in links}
    strange = sorted(set(pairs) - links)
    if strange:
        words = f"{source.name}: every pair must be a link of the graph"
        raise ScenarioError("path", words, list(strange[0]), "add the link or remove the rows")


def demand_nodes(source: SourceFile, nodes: Iterable[int], topology: Topology) -> None:
    """Raise ScenarioError if a file names a node that the graph does not have."""
    strange = sorted(set(nodes) - topology.index.keys())
    if strange:
        words = f"{source.name} names a node that the graph does not have"
        raise ScenarioError("path", words, strange[0], "mend the row or the graph")


@dataclass(frozen=True, eq=False)
class Graph(Component):
    """The contract of a graph kind; ``seed`` is the root seed for the random ones."""

    @abstractmethod
    def build(self, seed: int) -> Topology:
        """The nodes and links; raises ScenarioError where there are none to build."""


def _topology(nodes: Iterable[int], links: Iterable[Link], **more: Any) -> Topology:
    pairs = {(min(link), max(link)) for link in links}
    return Topology(tuple(sorted(nodes)), tuple(sorted(pairs)), **more)


def _from_networkx(graph: networkx.Graph[Any], **more: Any) -> Topology:
    return _topology(graph.nodes, graph.edges, **more)


_count = integer(low=1, high=MOST_NODES)
_node = integer(low=0, high=2**53)


def _bounded(nodes: int, links: int) -> None:
    if nodes > MOST_NODES or links > MOST_LINKS:
        words = f"must have at most {MOST_NODES:,} nodes and {MOST_LINKS:,} links"
        raise ScenarioError("", words, f"{nodes:,} nodes, {links:,} links", "make it smaller")


@dataclass(frozen=True, eq=False)
class Cycle(Graph):
    """``nodes`` in a ring."""

    nodes: int = field(integer(low=3, high=MOST_NODES))

    def build(self, seed: int) -> Topology:
        """Links (k, k + 1) and (0, nodes - 1)."""
        return _topology(range(self.nodes), [(k, (k + 1) % self.nodes) for k in range(self.nodes)])


@dataclass(frozen=True, eq=False)
class PathGraph(Graph):
    """``nodes`` in a row."""

    nodes: int = field(_count)

    def build(self, seed: int) -> Topology:
        """Links (k, k + 1)."""
        return _topology(range(self.nodes), [(k, k + 1) for k in range(self.nodes - 1)])


@dataclass(frozen=True, eq=False)
class Complete(Graph):
    """Every pair of ``nodes`` is linked."""

    nodes: int = field(_count)

    def build(self, seed: int) -> Topology:
        """All pairs."""
        _bounded(self.nodes, self.nodes * (self.nodes - 1) // 2)
        pairs = [(i, j) for i in range(self.nodes) for j in range(i + 1, self.nodes)]
        return _topology(range(self.nodes), pairs)


@dataclass(frozen=True, eq=False)
class Star(Graph):
    """``nodes`` in all, node 0 in the middle."""

    nodes: int = field(_count)

    def build(self, seed: int) -> Topology:
        """Links (0, k)."""
        return _topology(range(self.nodes), [(0, k) for k in range(1, self.nodes)])


@dataclass(frozen=True, eq=False)
class Grid(Graph):
    """``rows`` by ``columns``; node ids run along the rows."""

    rows: int = field(_count)
    columns: int = field(_count)

    def build(self, seed: int) -> Topology:
        """Links to the right and below; positions on the lattice."""
        _bounded(self.rows * self.columns, 2 * self.rows * self.columns)
        ids = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        right = zip(ids[:, :-1].ravel().tolist(), ids[:, 1:].ravel().tolist(), strict=True)
        below = zip(ids[:-1].ravel().tolist(), ids[1:].ravel().tolist(), strict=True)
        places = {int(ids[r, c]): (float(c), -float(r)) for r, c in np.ndindex(*ids.shape)}
        return _topology(ids.ravel().tolist(), [*right, *below], positions=places)


@dataclass(frozen=True, eq=False)
class RandomGraph(Graph):
    """Random kinds: ``seed`` of their own (default: the root seed); with ``connected`` they are
    drawn again, with the next seed, until they are connected.
    """

    seed: int | None = field(integer(low=0), default=None)
    connected: bool = field(boolean, default=False)

    def _draw(
        self, seed: int, make: Callable[[np.random.RandomState], networkx.Graph[Any]]
    ) -> networkx.Graph[Any]:
        import networkx

        first = seed if self.seed is None else self.seed
        for attempt in range(MOST_TRIES if self.connected else 1):
            # networkx takes legacy generators only for its older functions.
            state = np.random.RandomState((first + attempt) % 2**32)
            graph = make(state)
            if not self.connected or networkx.is_connected(graph):
                return graph
        raise ScenarioError(
            "connected",
            f"none of {MOST_TRIES} graphs drawn was connected",
            self.connected,
            "make links more likely",
        )


@dataclass(frozen=True, eq=False)
class Regular(RandomGraph):
    """``nodes`` with ``degree`` random links each."""

    nodes: int = field(_count)
    degree: int = field(integer(low=0))

    def build(self, seed: int) -> Topology:
        """networkx.random_regular_graph; above half the nodes, the complement of one."""
        import networkx

        N, degree = self.nodes, self.degree
        if degree >= N or degree * N % 2:
            raise ScenarioError(
                "",
                "a regular graph needs degree below nodes and degree * nodes even",
                f"degree {degree}, nodes {N}",
                "change one of them",
            )
        _bounded(N, degree * N // 2)

        def make(state: np.random.RandomState) -> networkx.Graph[Any]:
            if 2 * degree < N:
                sparse: networkx.Graph[Any] = networkx.random_regular_graph(degree, N, state)
                return sparse
            rest = networkx.random_regular_graph(N - 1 - degree, N, state)
            drawn: networkx.Graph[Any] = networkx.complement(rest)
            return drawn

        return _from_networkx(self._draw(seed, make))


@dataclass(frozen=True, eq=False)
class ErdosRenyi(RandomGraph):
    """``nodes`` of which each pair is linked with probability ``p``."""

    nodes: int = field(_count)
    p: float = field(probability)

    def build(self, seed: int) -> Topology:
        """networkx.fast_gnp_random_graph."""
        import networkx

        _bounded(self.nodes, int(0.5 * self.p * self.nodes * (self.nodes - 1)))
        return _from_networkx(
            self._draw(seed, lambda s: networkx.fast_gnp_random_graph(self.nodes, self.p, s))
        )


@dataclass(frozen=True, eq=False)
class Geometric(RandomGraph):
    """``nodes`` at random places of the unit square, linked when closer than ``radius``."""

    nodes: int = field(_count)
    radius: float = field(positive)

    def build(self, seed: int) -> Topology:
        """networkx.random_geometric_graph, with its positions."""
        import networkx

        def make(state: np.random.RandomState) -> networkx.Graph[Any]:
            places = {k: tuple(p) for k, p in enumerate(state.random_sample((self.nodes, 2)))}
            return networkx.random_geometric_graph(self.nodes, self.radius, pos=places)

        graph = self._draw(seed, make)
        places = {k: (float(x), float(y)) for k, (x, y) in graph.nodes(data="pos")}
        return _from_networkx(graph, positions=places)


@dataclass(frozen=True, eq=False)
class Edges(Graph):
    """Links written out; ``nodes = N`` names the nodes 0 .. N - 1, else the links do."""

    edges: tuple[Link, ...] = field(
        several(row(_node, _node, what="a pair of node ids"), "pairs of node ids", least=0)
    )
    nodes: int | None = field(_count, default=None)
    directed: bool = field(boolean, default=False)

    def build(self, seed: int) -> Topology:
        """The links as given."""
        named = {node for edge in self.edges for node in edge}
        if self.nodes is not None:
            for k, edge in enumerate(self.edges):
                for node in edge:
                    if not 0 <= node < self.nodes:
                        raise ScenarioError(
                            f"edges[{k}]",
                            f"node ids must be 0 .. {self.nodes - 1}",
                            list(edge),
                            "mend the pair or raise nodes",
                        )
        for k, (i, j) in enumerate(self.edges):
            if i == j:
                raise ScenarioError(
                    f"edges[{k}]", "a link must join two nodes", [i, j], "leave it out"
                )
        nodes = named if self.nodes is None else range(self.nodes)
        if not nodes:
            raise ScenarioError("edges", "must name at least one node", [], "add nodes = N")
        if self.directed:
            return Topology(tuple(sorted(nodes)), tuple(sorted(set(self.edges))), directed=True)
        return _topology(nodes, self.edges)


@dataclass(frozen=True, eq=False)
class CsvGraph(Graph):
    """Links from a table ``sender,receiver`` with an optional ``delivery_probability``.

    ``minimum`` keeps a link only if it reaches that probability, in both directions where the
    graph is undirected; nodes left without a link are left out, and a note says so. A table of an
    undirected graph that lists every link once means each row both ways; one that lists some links
    both ways and others once leaves probabilities open, and is refused unless ``minimum`` drops
    those others. ``positions`` is a table whose first three columns are node, x and y.
    """

    path: SourceFile = field(source_file)
    minimum: float | None = field(number(low=0.0, high=1.0), default=None)
    directed: bool = field(boolean, default=False)
    positions: SourceFile | None = field(source_file, default=None)

    def build(self, seed: int) -> Topology:
        """The links of the table."""
        delivery, measured = self._delivery()
        nodes = {node for link in delivery for node in link}
        if not self.directed and not any((j, i) in delivery for i, j in delivery):
            delivery.update({(j, i): p for (i, j), p in list(delivery.items())})
        least = 0.0 if self.minimum is None else self.minimum
        if self.minimum is not None and not measured:
            raise ScenarioError(
                "minimum",
                "needs a column delivery_probability in the table",
                self.minimum,
                "add the column or leave minimum out",
            )
        links = {
            (i, j)
            for (i, j), p in delivery.items()
            if p >= least and (self.directed or delivery.get((j, i), 0.0) >= least)
        }
        if not links:
            raise ScenarioError(
                "path" if self.minimum is None else "minimum",
                "no link of the table is left",
                self.minimum,
                "lower minimum or add rows",
            )
        kept = {node for link in links for node in link}
        one_way = [] if self.directed else sorted(p for p in delivery if p[::-1] not in delivery)
        if measured and links.intersection(one_way):
            raise ScenarioError(
                "path",
                f"{self.path.name}: some links are listed in both directions and others in one, so "
                "the probability of the other direction is not known",
                _listed(one_way),
                "list every link twice, or every link once (then the row counts both ways), or set "
                "directed = true",
            )
        notes = (*_left_out(nodes - kept, least), *_one_way(one_way if measured else []))
        more: dict[str, Any] = {"notes": notes, "positions": self._positions(kept)}
        more["left_out"] = frozenset(nodes - kept)
        if measured:
            pairs = links if self.directed else links | {(j, i) for i, j in links}
            more["delivery"] = {pair: delivery.get(pair, 0.0) for pair in sorted(pairs)}
        if self.directed:
            return Topology(tuple(sorted(kept)), tuple(sorted(links)), directed=True, **more)
        return _topology(kept, links, **more)

    def _delivery(self) -> tuple[dict[Link, float], bool]:
        table = read_columns(self.path, ("sender", "receiver"), ("delivery_probability",))
        senders = whole(self.path, "sender", table["sender"])
        receivers = whole(self.path, "receiver", table["receiver"])
        measured = "delivery_probability" in table
        values = table["delivery_probability"].tolist() if measured else [1.0] * len(senders)
        for i, j, p in zip(senders, receivers, values, strict=True):
            if i == j or not 0.0 <= p <= 1.0:
                raise ScenarioError(
                    "path",
                    f"{self.path.name}: rows must join two nodes with a probability",
                    [i, j, p],
                    "mend the row",
                )
        pairs = list(zip(senders, receivers, strict=True))
        twice = next((pair for pair, count in Counter(pairs).items() if count > 1), None)
        if twice is not None:
            words = f"{self.path.name}: each direction must be listed once"
            raise ScenarioError("path", words, list(twice), "remove the other rows")
        return dict(zip(pairs, values, strict=True)), measured

    def _positions(self, nodes: set[int]) -> dict[int, tuple[float, float]] | None:
        if self.positions is None:
            return None
        source = self.positions
        try:
            names = tuple(read_header(source)[:3])
            if len(names) < 3:
                words = f"{source.name} must have the columns node, x, y"
                raise ScenarioError("", words, list(names), "add what is missing")
            table = read_columns(source, names)
            ids = whole(source, names[0], table[names[0]])
        except ScenarioError as error:
            raise ScenarioError("positions", error.rule, error.value, error.remedy) from None
        x, y = table[names[1]].tolist(), table[names[2]].tolist()
        places = dict(zip(ids, zip(x, y, strict=True), strict=True))
        missing = sorted(nodes - places.keys())
        if missing:
            raise ScenarioError(
                "positions",
                f"{self.positions.name} must place every node",
                missing,
                "add their rows",
            )
        return {node: places[node] for node in sorted(nodes)}


def _left_out(nodes: set[int], minimum: float) -> tuple[str, ...]:
    if not nodes:
        return ()
    listed = ", ".join(map(str, sorted(nodes)))
    one = len(nodes) == 1
    return (f"node{'' if one else 's'} {listed} left out: no link reaches the minimum {minimum:g}",)


def _one_way(pairs: list[Link]) -> tuple[str, ...]:
    if not pairs:
        return ()
    return (f"links listed in one direction only left out: {_listed(pairs)}",)


def _listed(pairs: list[Link], most: int = 3) -> str:
    shown = ", ".join(f"{i} to {j}" for i, j in pairs[:most])
    return shown if len(pairs) <= most else f"{shown} and {len(pairs) - most} more"
