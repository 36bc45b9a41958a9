"""Graphs: the topology of a network, and the kinds of graph that build one."""

from __future__ import annotations

import dataclasses
import itertools
import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from netkf.core.csv_files import Columns, read_columns, read_header
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    SourceFile,
    boolean,
    either,
    field,
    integer,
    list_of,
    matrix,
    node_id,
    number,
    positive,
    probability,
    source_file,
    tuple_of,
    vector,
)
from netkf.core.printable import NamedNode
from netkf.core.repeated_rows import RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray
from netkf.network.spectra import largest_laplacian_eigenvalue

if TYPE_CHECKING:
    import networkx

Link = tuple[int, int]
MAX_TRIES = 1000  # random graphs that are tried until one is connected
# Limits of what fits into memory with all states and messages.
MAX_NODES, MAX_LINKS = 200_000, 1_000_000
MAX_DRAWN = 400_000  # nodes and links of all graphs drawn in search of a connected one


def node_columns(node: int) -> dict[str, Any]:
    """Return a node in a row of a document: its id ``node`` and, if it has one, its ``name``."""
    return {"node": node} | ({"name": node.name} if isinstance(node, NamedNode) else {})


def name_rows(rows: Iterable[dict[str, Any]]) -> None:
    """Put named ids in the place of ``node`` in rows that have a ``name``."""
    for row in rows:
        if isinstance(row.get("name"), str):
            row["node"] = NamedNode(row["node"], row["name"])


@dataclass(frozen=True, eq=False)
class Topology:
    """The nodes and links of one network.

    nodes     : ids in increasing order
    links     : sorted pairs, (i, j) with i < j unless ``directed`` (then from i to j)
    delivery  : probability that a message from i reaches j, None if the graph has no table of them
    positions : (x, y) of each node, None if the graph has none
    notes     : one line for each group of nodes or links that were left out
    left_out  : nodes that the graph's table names but that have no link
    tables    : use of the rows of the graph's tables, by the rest of their key path
    names     : id of each node that the graph's file names by a text
    radius    : distance up to which the ends of a link hear each other, None for any
    """

    nodes: tuple[int, ...]
    links: tuple[Link, ...]
    directed: bool = False
    delivery: dict[Link, float] | None = None
    positions: dict[int, tuple[float, float]] | None = None
    notes: tuple[str, ...] = ()
    left_out: frozenset[int] = frozenset()
    tables: Mapping[str, RowUse] = dataclasses.field(default_factory=dict)
    names: Mapping[str, int] = dataclasses.field(default_factory=dict)
    radius: float | None = None

    def __post_init__(self) -> None:
        """Put named ids in the place of the ids of nodes that have names."""
        if not self.names:
            return
        named = {k: NamedNode(k, name) for name, k in self.names.items()}
        links = tuple((named.get(i, i), named.get(j, j)) for i, j in self.links)
        object.__setattr__(self, "names", {node.name: node for node in named.values()})
        object.__setattr__(self, "nodes", tuple(named.get(k, k) for k in self.nodes))
        object.__setattr__(self, "links", links)

    def named(self, node: int) -> int:
        """Return the id of a ``node`` so that it is printed as its name."""
        return self.nodes[self.index[node]]

    def find(self, name: str) -> int | None:
        """Return the id of the node with a name, which may be an id as text; None if no node has
        it.
        """
        node = self.names.get(name, _as_integer(name))
        return self.named(node) if node in self.index else None

    @cached_property
    def index(self) -> dict[int, int]:
        """The index in ``nodes`` of each node id."""
        return {node: k for k, node in enumerate(self.nodes)}

    @cached_property
    def ends(self) -> np.ndarray:
        """The indices (L, 2) in ``nodes`` of the ends of links."""
        ends = [(self.index[i], self.index[j]) for i, j in self.links]
        return np.array(ends, dtype=np.int64).reshape(-1, 2)

    @cached_property
    def degrees(self) -> dict[int, int]:
        """The number of links at each node (of incoming ones in a directed graph)."""
        heard = self.ends[:, 1] if self.directed else self.ends.reshape(-1)
        counts = np.bincount(heard, minlength=len(self.nodes))
        return dict(zip(self.nodes, counts.tolist(), strict=True))

    @cached_property
    def laplacian_radius(self) -> float:
        """The spectral radius rho(L) of the Laplacian L of all links."""
        degrees = np.array([float(self.degrees[node]) for node in self.nodes])
        return largest_laplacian_eigenvalue(degrees, self.ends)

    @cached_property
    def directions(self) -> tuple[Link, ...]:
        """The sorted pairs (sender, receiver): both directions of each link unless directed."""
        return tuple((self.nodes[i], self.nodes[j]) for i, j in self.direction_ends.tolist())

    @cached_property
    def direction_ends(self) -> np.ndarray:
        """The indices (D, 2) in ``nodes``, which are in increasing order, of ``directions``."""
        both = self.ends if self.directed else np.concatenate([self.ends, self.ends[:, ::-1]])
        return both[np.lexsort((both[:, 1], both[:, 0]))]

    @cached_property
    def _receivers(self) -> dict[int, tuple[int, ...]]:
        return self._peers(0)

    @cached_property
    def _senders(self) -> dict[int, tuple[int, ...]]:
        return self._peers(1)

    def _peers(self, end: int) -> dict[int, tuple[int, ...]]:
        """Return the peers of each node as ``end`` of directions: 0 sender, 1 receiver."""
        pairs = self.direction_ends
        pairs = pairs[np.argsort(pairs[:, end], kind="stable")]
        firsts = np.searchsorted(pairs[:, end], np.arange(len(self.nodes) + 1)).tolist()
        ids = [self.nodes[k] for k in pairs[:, 1 - end].tolist()]
        spans = itertools.pairwise(firsts)
        return {node: tuple(ids[a:b]) for node, (a, b) in zip(self.nodes, spans, strict=True)}

    def receivers(self, node: int) -> tuple[int, ...]:
        """Return the ids of the nodes that may hear ``node``, in increasing order."""
        return self._receivers[node]

    def senders(self, node: int) -> tuple[int, ...]:
        """Return the ids of the nodes that ``node`` may hear, in increasing order."""
        return self._senders[node]

    @cached_property
    def components(self) -> list[set[int]]:
        """The (weakly) connected components as sets of node ids, largest first."""
        part = list(range(len(self.nodes)))  # of each node a node before it in its component

        def first(k: int) -> int:
            while part[k] != k:
                part[k] = k = part[part[k]]
            return k

        for i, j in self.ends.tolist():
            a, b = first(i), first(j)
            part[max(a, b)] = min(a, b)
        components: dict[int, set[int]] = {}
        for k, node in enumerate(self.nodes):
            components.setdefault(first(k), set()).add(node)
        return sorted(components.values(), key=len, reverse=True)


def demand_in_graph(nodes: Sequence[int], topology: Topology) -> None:
    """Raise ScenarioError unless all ``nodes`` are in the graph."""
    for k, node in enumerate(nodes):
        if node not in topology.index:
            raise ScenarioError(f"nodes[{k}]", "must be a node of the graph", node, "remove it")


def demand_links(table: Columns, topology: Topology, sender: str, receiver: str) -> None:
    """Raise ScenarioError if a table has a pair, in these two columns, that is no link."""
    links = np.array(topology.directions).reshape(-1, 2) @ [1.0, 1.0j]
    wrong = np.flatnonzero(~np.isin(table[sender] + 1.0j * table[receiver], links))
    if wrong.size:
        row = int(wrong[0])
        rule = f"{table.where(row)}: every pair must be a link of the graph"
        pair = [table.integers(name)[row] for name in (sender, receiver)]
        raise ScenarioError("path", rule, pair, "correct the row or add the link")


def demand_nodes(table: Columns, nodes: Iterable[int]) -> None:
    """Raise ScenarioError if a table has a node that is none of the ``nodes`` (ids)."""
    wrong = np.flatnonzero(~np.isin(table["node"], list(nodes)))
    if wrong.size:
        node = table.integers("node")[wrong[0]]
        rule = f"{table.where(int(wrong[0]))} names a node that the graph does not have"
        raise ScenarioError("path", rule, node, "correct the row or the graph")


@dataclass(frozen=True, eq=False)
class Graph(Component):
    """The contract of a graph kind; ``seed`` is the root seed for the random ones."""

    may_name_nodes: ClassVar[bool] = False
    """Whether nodes may have names, texts in place of ids."""

    @abstractmethod
    def build(self, seed: int) -> Topology:
        """Return the nodes and links; ``seed`` is the root seed, for random graphs without one of
        their own. Raises ScenarioError if there are none to build.
        """


def _make_topology(nodes: Iterable[int], links: Iterable[Link], **more: Any) -> Topology:
    pairs = {(min(link), max(link)) for link in links}
    return Topology(tuple(sorted(nodes)), tuple(sorted(pairs)), **more)


def _from_networkx(graph: networkx.Graph[Any], **more: Any) -> Topology:
    return _make_topology(graph.nodes, graph.edges, **more)


_count = integer(low=1, high=MAX_NODES)
_node = node_id(low=0, high=2**53)
_node_pair = tuple_of(_node, _node, description="a pair of node ids")


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple))


def _check_size(nodes: int, links: int) -> None:
    if nodes > MAX_NODES or links > MAX_LINKS:
        rule = f"must have at most {MAX_NODES:,} nodes and {MAX_LINKS:,} links"
        raise ScenarioError("", rule, f"{nodes:,} nodes, {links:,} links", "make it smaller")


@dataclass(frozen=True, eq=False)
class Cycle(Graph):
    """A ring of ``nodes``."""

    nodes: int = field(integer(low=3, high=MAX_NODES))

    def build(self, seed: int) -> Topology:
        """Return the topology with links (k, k + 1) and (0, nodes - 1); ``seed`` is not used."""
        return _make_topology(
            range(self.nodes), [(k, (k + 1) % self.nodes) for k in range(self.nodes)]
        )


@dataclass(frozen=True, eq=False)
class PathGraph(Graph):
    """A path of ``nodes``."""

    nodes: int = field(_count)

    def build(self, seed: int) -> Topology:
        """Return the topology with links (k, k + 1); ``seed`` is not used."""
        return _make_topology(range(self.nodes), [(k, k + 1) for k in range(self.nodes - 1)])


@dataclass(frozen=True, eq=False)
class Complete(Graph):
    """The complete graph of ``nodes``."""

    nodes: int = field(_count)

    def build(self, seed: int) -> Topology:
        """Return the topology that links all pairs; ``seed`` is not used."""
        _check_size(self.nodes, self.nodes * (self.nodes - 1) // 2)
        pairs = [(i, j) for i in range(self.nodes) for j in range(i + 1, self.nodes)]
        return _make_topology(range(self.nodes), pairs)


@dataclass(frozen=True, eq=False)
class Star(Graph):
    """A star of ``nodes``, with node 0 in the middle."""

    nodes: int = field(_count)

    def build(self, seed: int) -> Topology:
        """Return the topology with links (0, k); ``seed`` is not used."""
        return _make_topology(range(self.nodes), [(0, k) for k in range(1, self.nodes)])


@dataclass(frozen=True, eq=False)
class Grid(Graph):
    """A rectangular grid of ``rows`` by ``columns``; node ids run along the rows."""

    rows: int = field(_count)
    columns: int = field(_count)

    def build(self, seed: int) -> Topology:
        """Return the topology that links neighbours in rows and columns."""
        _check_size(self.rows * self.columns, 2 * self.rows * self.columns)
        ids = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        right = zip(ids[:, :-1].ravel().tolist(), ids[:, 1:].ravel().tolist(), strict=True)
        below = zip(ids[:-1].ravel().tolist(), ids[1:].ravel().tolist(), strict=True)
        positions = {int(ids[r, c]): (float(c), -float(r)) for r, c in np.ndindex(*ids.shape)}
        return _make_topology(ids.ravel().tolist(), [*right, *below], positions=positions)


@dataclass(frozen=True, eq=False)
class RandomGraph(Graph):
    """Base class of random graphs, drawn from a ``seed`` of their own or from the root seed.

    If ``connected``, graphs are drawn with successive seeds until one is connected.
    """

    seed: int | None = field(integer(low=0), default=None)
    connected: bool = field(boolean, default=False)

    def _draw(
        self, seed: int, make: Callable[[np.random.RandomState], networkx.Graph[Any]]
    ) -> networkx.Graph[Any]:
        import networkx

        first_seed, tries, entries = seed if self.seed is None else self.seed, 0, 0
        # Limited in the number of graphs and in the nodes and edges of all of them.
        while tries < (MAX_TRIES if self.connected else 1) and entries < MAX_DRAWN:
            # networkx takes legacy generators only for its older functions.
            graph = make(np.random.RandomState((first_seed + tries) % 2**32))
            tries, entries = tries + 1, entries + len(graph) + graph.number_of_edges()
            if not self.connected or networkx.is_connected(graph):
                return graph
        raise ScenarioError(
            "connected",
            f"none of {tries} graphs drawn was connected",
            self.connected,
            "make links more likely",
        )


@dataclass(frozen=True, eq=False)
class Regular(RandomGraph):
    """A random regular graph: ``nodes`` with ``degree`` links each."""

    nodes: int = field(_count)
    degree: int = field(integer(low=0))

    def build(self, seed: int) -> Topology:
        """Return a topology from ``networkx.random_regular_graph``."""
        import networkx

        N, degree = self.nodes, self.degree
        if degree >= N or degree * N % 2:
            raise ScenarioError(
                "",
                "a regular graph needs degree below nodes and degree * nodes even",
                f"degree {degree}, nodes {N}",
                "change one of them",
            )
        _check_size(N, degree * N // 2)

        def make(state: np.random.RandomState) -> networkx.Graph[Any]:
            if 2 * degree < N:
                sparse: networkx.Graph[Any] = networkx.random_regular_graph(degree, N, state)
                return sparse
            # networkx joins free ends of links at random, which rarely succeeds for dense graphs.
            # The complement of a random regular graph is one too.
            complement = networkx.random_regular_graph(N - 1 - degree, N, state)
            dense: networkx.Graph[Any] = networkx.complement(complement)
            return dense

        return _from_networkx(self._draw(seed, make))


@dataclass(frozen=True, eq=False)
class ErdosRenyi(RandomGraph):
    """A random graph that links each pair of ``nodes`` with probability ``p``."""

    nodes: int = field(_count)
    p: float = field(probability)

    def build(self, seed: int) -> Topology:
        """Return a topology from ``networkx.fast_gnp_random_graph``."""
        import networkx

        # Refuse a graph whose expected number of links is too large before it is drawn.
        _check_size(self.nodes, int(0.5 * self.p * self.nodes * (self.nodes - 1)))
        # networkx divides by log(1 - p).
        p = self.p if 1.0 - self.p < 1.0 else 0.0
        return _from_networkx(
            self._draw(seed, lambda s: networkx.fast_gnp_random_graph(self.nodes, p, s))
        )


@dataclass(frozen=True, eq=False)
class Geometric(RandomGraph):
    """A random geometric graph: ``nodes`` in the unit square, linked when within ``radius``."""

    nodes: int = field(_count)
    radius: float = field(positive)

    def build(self, seed: int) -> Topology:
        """Return a topology from ``networkx.random_geometric_graph``."""
        import networkx

        # Refuse a graph whose expected number of links is too large before it is drawn.
        pairs = 0.5 * self.nodes * (self.nodes - 1)
        _check_size(self.nodes, int(pairs * _probability_within(min(self.radius, 1.0))))

        def make(state: np.random.RandomState) -> networkx.Graph[Any]:
            points = {k: tuple(p) for k, p in enumerate(state.random_sample((self.nodes, 2)))}
            return networkx.random_geometric_graph(self.nodes, self.radius, pos=points)

        graph = self._draw(seed, make)
        positions = {k: (float(x), float(y)) for k, (x, y) in graph.nodes(data="pos")}
        return _from_networkx(graph, positions=positions)


def _probability_within(radius: float) -> float:
    """Return the probability that two uniform points of the unit square are within ``radius``."""
    return math.pi * radius**2 - 8.0 / 3.0 * radius**3 + 0.5 * radius**4


@dataclass(frozen=True, eq=False)
class Edges(Graph):
    """A list of links between nodes, by id or by name.

    edges     pairs of nodes, from the first to the second if ``directed``
    nodes     N names the nodes 0 .. N - 1; a list names all nodes, also those without a link;
              by default they are those of the links
    delivery  probability that a message of each of the ``edges`` arrives, for ``per-link`` losses;
              in both directions unless ``directed``
    positions (x, y) of each node of the list ``nodes``
    """

    may_name_nodes: ClassVar[bool] = True

    edges: tuple[Link, ...] = field(list_of(_node_pair, "pairs of node ids", min_length=0))
    nodes: int | tuple[Any, ...] | None = field(
        either(_count, list_of(_node, "node ids"), _is_list), default=None
    )
    directed: bool = field(boolean, default=False)
    delivery: FloatArray | None = field(vector, default=None)
    positions: FloatArray | None = field(matrix, default=None)

    def build(self, seed: int) -> Topology:
        """Return the links as given; raises ScenarioError for a pair that is no link."""
        listed: Iterable[Any] = self.nodes if isinstance(self.nodes, tuple) else ()
        named = [node for edge in self.edges for node in edge]
        ids = assign_ids([*listed, *named])
        if isinstance(self.nodes, int):
            ids = {k: k for k in range(self.nodes)}
        elif self.nodes is not None:
            ids = {node: ids[node] for node in self.nodes}
        for k, edge in enumerate(self.edges):
            if self.nodes is not None and not ids.keys() >= set(edge):
                rule, remedy = "must join two of nodes", "correct the pair or add to nodes"
                if isinstance(self.nodes, int):
                    rule = f"node ids must be 0 .. {self.nodes - 1}"
                    remedy = "correct the pair or raise nodes"
                raise ScenarioError(f"edges[{k}]", rule, list(edge), remedy)
            if ids[edge[0]] == ids[edge[1]]:  # 2 and "2" are one node
                rule = "a link must join two nodes"
                raise ScenarioError(f"edges[{k}]", rule, list(edge), "correct the pair")
        if not ids:
            raise ScenarioError("edges", "must name at least one node", [], "add nodes = N")
        return self._topology(ids)

    def _topology(self, ids: dict[Any, int]) -> Topology:
        links = [(ids[i], ids[j]) for i, j in self.edges]
        delivery = self._delivery(links)
        if not self.directed:
            links = [(min(link), max(link)) for link in links]
        _check_size(len(set(ids.values())), len(set(links)))
        repeated = len(links) - len(set(links))
        notes = (f"edges: {repeated} of {len(links)} pairs are listed again",) if repeated else ()
        return Topology(
            tuple(sorted(set(ids.values()))),
            tuple(sorted(set(links))),
            directed=self.directed,
            delivery=delivery,
            positions=self._positions(ids),
            notes=notes,
            names={name: k for name, k in ids.items() if str(k) != str(name)},
        )

    def _delivery(self, links: list[Link]) -> dict[Link, float] | None:
        if self.delivery is None:
            return None
        are_probabilities = ((self.delivery >= 0.0) & (self.delivery <= 1.0)).all()
        if len(self.delivery) != len(links) or not are_probabilities:
            rule = f"must be {len(links)} probabilities, one for each of edges"
            raise ScenarioError("delivery", rule, self.delivery.tolist(), "add or correct them")
        delivery: dict[Link, float] = {}
        for k, (link, p) in enumerate(zip(links, self.delivery.tolist(), strict=True)):
            for direction in (link,) if self.directed else (link, link[::-1]):
                if delivery.setdefault(direction, p) != p:
                    rule = f"says {delivery[direction]:g} and {p:g} of one link"
                    remedy = "list each link once"
                    raise ScenarioError(f"delivery[{k}]", rule, list(self.edges[k]), remedy)
        return delivery

    def _positions(self, ids: dict[Any, int]) -> dict[int, tuple[float, float]] | None:
        if self.positions is None:
            return None
        if self.nodes is None or self.positions.shape != (len(ids), 2):
            rule = "must be one pair (x, y) for each node of nodes"
            got = "{} x {}".format(*self.positions.shape)
            raise ScenarioError("positions", rule, got, "list the nodes, and a place for each")
        points = zip(ids.values(), self.positions.tolist(), strict=True)
        return {node: (x, y) for node, (x, y) in points}


@dataclass(frozen=True, eq=False)
class RangeGraph(Graph):
    """Links between all pairs of nodes, each of which is up while its ends are at most ``radius``
    apart: over a link that is down nothing is sent.

    nodes   N names the nodes 0 .. N - 1, a list names all nodes; by default they are those of which
            a scenario says where they are
    radius  in the unit of positions
    """

    may_name_nodes: ClassVar[bool] = True

    nodes: int | tuple[Any, ...] | None = field(
        either(_count, list_of(_node, "node ids"), _is_list), default=None
    )
    radius: float = field(positive)

    def build(self, seed: int) -> Topology:
        """Return the topology that links all pairs; ``seed`` is not used. Raises ScenarioError
        without nodes.
        """
        if not self.nodes:
            remedy = "add nodes = N, or network.positions"
            raise ScenarioError("nodes", "is missing, and nothing is placed", None, remedy)
        ids = assign_ids(range(self.nodes) if isinstance(self.nodes, int) else self.nodes)
        _check_size(len(ids), len(ids) * (len(ids) - 1) // 2)
        names = {name: k for name, k in ids.items() if str(k) != str(name)}
        pairs = combinations(ids.values(), 2)
        return _make_topology(ids.values(), pairs, names=names, radius=self.radius)


def assign_ids(labels: Iterable[Any]) -> dict[Any, int]:
    """Return the ids of nodes by label: integers keep theirs, others get free ones in order."""
    ids = {label: _as_integer(label) for label in labels}
    taken = {k for k in ids.values() if k is not None}
    free = (k for k in itertools.count() if k not in taken)
    return {label: next(free) if k is None else k for label, k in ids.items()}


def _as_integer(label: Any) -> int | None:
    text = str(label)
    is_id = text.isascii() and text.isdecimal() and len(text) < 17 and str(int(text)) == text
    return int(text) if is_id and int(text) <= 2**53 else None


@dataclass(frozen=True)
class LinkTable:
    """The links of a file: the delivery ``probability`` of each listed direction, 1 without one.

    rows   : the use of the file's rows
    alone  : nodes that the file has without a link
    names  : id of each node that the file names by a text
    """

    rows: RowUse
    probability: dict[Link, float]
    has_probabilities: bool
    directed: bool
    alone: frozenset[int] = frozenset()
    names: Mapping[str, int] = dataclasses.field(default_factory=dict)

    def topology(self, minimum: float | None, positions: SourceFile | None) -> Topology:
        """Return the network of links that reach the ``minimum``, if undirected both ways, with a
        table of ``positions``; raises ScenarioError without a link.
        """
        if minimum is not None and not self.has_probabilities:
            rule = "needs a column delivery_probability in the table"
            raise ScenarioError("minimum", rule, minimum, "add the column or leave minimum out")
        delivery = self._both_ways()
        links = self._reliable(delivery, minimum or 0.0)
        if not links and not self.alone:
            key, rule = "path" if minimum is None else "minimum", "no link of the table is left"
            raise ScenarioError(key, rule, minimum, "lower minimum or add rows")
        # Pairs listed from i to j only, in a table that lists others both ways.
        one_way = [] if self.directed else sorted(p for p in delivery if p[::-1] not in delivery)
        if self.has_probabilities and links.intersection(one_way):
            raise ScenarioError(
                "path",
                f"{self.rows.path}: some links are listed in both directions and others in one, so "
                "the probability of the other direction is not known",
                _list_directions(one_way, self._label),
                "list every link twice, or every link once (then the row counts both ways), or set "
                "directed = true",
            )
        nodes = _ends(links) | self.alone
        isolated = _ends(self.probability) - nodes
        _check_size(len(nodes), len(links))
        points, place_rows = _place_nodes(positions, nodes, isolated, self.names)
        return Topology(
            tuple(sorted(nodes)),
            tuple(sorted(links if self.directed else {(min(p), max(p)) for p in links})),
            directed=self.directed,
            delivery=self._delivery(delivery, links) if self.has_probabilities else None,
            positions=points,
            notes=(
                *_isolated_note(list(map(self._label, sorted(isolated))), minimum or 0.0),
                *_one_way_note(one_way if self.has_probabilities else [], self._label),
            ),
            left_out=frozenset(isolated),
            tables={"": self.rows} | ({} if place_rows is None else {".positions": place_rows}),
            names=self.names,
        )

    def _both_ways(self) -> dict[Link, float]:
        """Return probabilities by direction; a row counts both ways unless both are listed."""
        listed = self.probability
        if self.directed or any((j, i) in listed for i, j in listed):
            return listed
        return listed | {(j, i): p for (i, j), p in listed.items()}

    def _reliable(self, delivery: dict[Link, float], minimum: float) -> set[Link]:
        """Return the links whose ``delivery`` reaches the minimum, of undirected ones both ways."""
        return {
            link
            for link, p in delivery.items()
            if p >= minimum and (self.directed or delivery.get(link[::-1], 0.0) >= minimum)
        }

    def _label(self, node: int) -> str:
        return next((name for name, k in self.names.items() if k == node), str(node))

    def _delivery(self, delivery: dict[Link, float], links: set[Link]) -> dict[Link, float]:
        """Return the delivery probability of each of ``links``, 0 where it is not listed."""
        pairs = links if self.directed else links | {(j, i) for i, j in links}
        return {pair: delivery.get(pair, 0.0) for pair in sorted(pairs)}


@dataclass(frozen=True, eq=False)
class CsvGraph(Graph):
    """A graph whose links are the rows of a table ``sender,receiver[,delivery_probability]``, with
    ids or names of nodes.

    ``minimum`` keeps a link only if it reaches that probability, in both directions if the graph
    is undirected; nodes without a link are left out, and a note names them. If the table of an
    undirected graph lists every link once, each row counts in both directions. If it lists only
    some links in both directions, the other probabilities are unknown, and the table is refused
    unless ``minimum`` drops those links. ``positions`` is a table whose first three columns are
    node, x and y.
    """

    may_name_nodes: ClassVar[bool] = True

    path: SourceFile = field(source_file)
    minimum: float | None = field(number(low=0.0, high=1.0), default=None)
    directed: bool = field(boolean, default=False)
    positions: SourceFile | None = field(source_file, default=None)

    def build(self, seed: int) -> Topology:
        """Return the links of the table that reach the minimum."""
        return self._read().topology(self.minimum, self.positions)

    def _read(self) -> LinkTable:
        columns = read_columns(
            self.path, ("sender", "receiver"), ("delivery_probability",), new_nodes=True
        )
        listed = list(zip(columns.integers("sender"), columns.integers("receiver"), strict=True))
        # Numbers below 0 stand for names.
        names = {code: name for name, code in self.path.unknown.items()}
        ids = assign_ids(names.get(node, node) for pair in listed for node in pair)
        pairs = [(ids[names.get(i, i)], ids[names.get(j, j)]) for i, j in listed]
        has_probabilities = "delivery_probability" in columns
        ones = [1.0] * len(pairs)
        values = columns["delivery_probability"].tolist() if has_probabilities else ones
        for row, ((i, j), p) in enumerate(zip(pairs, values, strict=True)):
            if i == j or not 0.0 <= p <= 1.0:
                rule = f"{columns.where(row)}: rows must join two nodes with a probability"
                ends = [names.get(node, node) for node in listed[row]]
                raise ScenarioError("path", rule, [*ends, p], "correct the row")
        rule = "each direction must be listed once, with one probability"
        first = first_rows(columns, pairs, values, rule)
        probability = {pair: values[row] for pair, row in first.items()}
        use = count_rows(self.path.name, pairs, probability.__contains__)
        texts = {name: ids[name] for name in names.values()}
        return LinkTable(use, probability, has_probabilities, self.directed, names=texts)


def _place_nodes(
    source: SourceFile | None, nodes: set[int], left_out: set[int], names: Mapping[str, int]
) -> tuple[dict[int, tuple[float, float]] | None, RowUse | None]:
    """Return the coordinates of ``nodes``, and the use of the table's rows; None without a file."""
    if source is None:
        return None, None
    try:
        points, row_nodes = _read_positions(source)
        # Nodes that the graph does not have may be placed too.
        ids = {code: names.get(name, code) for name, code in source.unknown.items()}
    except ScenarioError as error:
        # These errors name "path", which here is the key of the other table.
        raise ScenarioError("positions", error.rule, error.value, error.remedy) from None
    points = {ids.get(node, node): point for node, point in points.items()}
    row_nodes = [ids.get(node, node) for node in row_nodes]
    missing = sorted(nodes - points.keys())
    if missing:
        labels = {node: name for name, node in names.items()}
        rule = f"{source.name} must place every node"
        listed = [labels.get(node, node) for node in missing]
        raise ScenarioError("positions", rule, listed, "add their rows")
    use = count_rows(source.name, row_nodes, (nodes | left_out).__contains__)
    return {node: points[node] for node in sorted(nodes)}, use


def _read_positions(source: SourceFile) -> tuple[dict[int, tuple[float, float]], list[int]]:
    header, named = read_header(source), ("node", "x", "y")
    # Columns of other names, such as mote,x_m,y_m, come in this order.
    names = named if {*named} <= {*header} else tuple(header[:3])
    if len(names) < 3:
        rule = f"{source.name} must have the columns node, x, y"
        raise ScenarioError("path", rule, list(names), "add what is missing")
    columns = read_columns(source, names, nodes=names[:1], new_nodes=True)
    points = list(zip(columns[names[1]].tolist(), columns[names[2]].tolist(), strict=True))
    ids = columns.integers(names[0])
    first = first_rows(columns, ids, points, "a node must have one position")
    return {node: points[row] for node, row in first.items()}, ids


def _ends(links: Iterable[Link]) -> set[int]:
    return {node for link in links for node in link}


def _isolated_note(nodes: Sequence[str], minimum: float) -> tuple[str, ...]:
    if not nodes:
        return ()
    plural = "" if len(nodes) == 1 else "s"
    return (f"node{plural} {', '.join(nodes)} left out: no link reaches the minimum {minimum:g}",)


def _one_way_note(pairs: list[Link], label: Callable[[int], str]) -> tuple[str, ...]:
    if not pairs:
        return ()
    return (f"links listed in one direction only left out: {_list_directions(pairs, label)}",)


def _list_directions(pairs: list[Link], label: Callable[[int], str]) -> str:
    text = ", ".join(f"{label(i)} to {label(j)}" for i, j in pairs[:3])
    return text if len(pairs) <= 3 else f"{text} and {len(pairs) - 3} more"
