"""Graphs in the formats that networkx reads, and graphs of networkx itself."""

from __future__ import annotations

import dataclasses
import io
import math
import numbers
import sys
from abc import abstractmethod
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from netkf.core.csv_files import read_content
from netkf.core.errors import ScenarioError
from netkf.core.fields import Rule, SourceFile, boolean, field, number, source_file
from netkf.core.repeated_rows import count_rows
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Edges, Graph, Link, LinkTable, Topology, assign_ids

if TYPE_CHECKING:
    import networkx

PROBABILITY = "delivery_probability"
"""The attribute of an edge that is the probability that its messages arrive."""


@dataclass(frozen=True, eq=False)
class GraphFile(Graph):
    """The contract of a graph that networkx reads from a file, with ids or names of nodes.

    Links are directed if the file says so. Edges may have an attribute ``delivery_probability``;
    ``minimum`` and ``positions`` are those of CsvGraph.
    """

    may_name_nodes: ClassVar[bool] = True

    path: SourceFile = field(source_file)
    minimum: float | None = field(number(low=0.0, high=1.0), default=None)
    positions: SourceFile | None = field(source_file, default=None)

    @abstractmethod
    def read(self, content: bytes) -> networkx.Graph[Any]:
        """Return the graph in the ``content`` of a file; may raise whatever networkx raises."""

    def build(self, seed: int) -> Topology:
        """Return the links of the file that reach the minimum."""
        content = read_content(self.path)
        try:
            graph = self.read(content)
        except Exception as error:  # of many kinds, also from parsers below networkx
            rule = f"{self.path.name} cannot be read by networkx"
            reason = f"{type(error).__name__}: {error}"
            raise ScenarioError("path", rule, reason, "correct the file or the kind") from None
        try:
            table = _read_links(graph, self.path.name)
        except ScenarioError as error:
            rule = f"{self.path.name}: {error.rule}"
            raise ScenarioError("path", rule, error.value, error.remedy) from None
        topology = table.topology(self.minimum, self.positions)
        points = _positions(graph.nodes.values())
        if points is None or self.positions is not None:
            return topology
        ids = assign_ids(graph.nodes).values()
        places = dict(zip(ids, map(tuple, points.tolist()), strict=True))
        return dataclasses.replace(topology, positions={k: places[k] for k in topology.nodes})


@dataclass(frozen=True, eq=False)
class GraphmlGraph(GraphFile):
    """A graph from a GraphML file."""

    def read(self, content: bytes) -> networkx.Graph[Any]:
        """Return the graph of a GraphML document."""
        import networkx

        graph: networkx.Graph[Any] = networkx.read_graphml(io.BytesIO(content))
        return graph


@dataclass(frozen=True, eq=False)
class GmlGraph(GraphFile):
    """A graph from a GML file; nodes are known by their labels, or without these by their ids."""

    def read(self, content: bytes) -> networkx.Graph[Any]:
        """Return the graph of a GML document."""
        import networkx

        text = content.decode("utf-8-sig")
        label = "label" if "label" in text else "id"
        try:
            graph: networkx.Graph[Any] = networkx.parse_gml(text, label=label)
        except networkx.NetworkXError:
            # Some nodes have no label, or several have one.
            graph = networkx.parse_gml(text, label="id")
        return graph


@dataclass(frozen=True, eq=False)
class EdgelistGraph(GraphFile):
    """A graph from an edge list of networkx: two nodes a line, then maybe attributes, as in
    ``lab roof {"delivery_probability": 0.9}``. The file does not say if links are ``directed``.
    """

    directed: bool = field(boolean, default=False)

    def read(self, content: bytes) -> networkx.Graph[Any]:
        """Return the graph of an edge list."""
        import networkx

        # A graph with parallel edges, so that a link that is listed again is seen.
        blank: networkx.Graph[Any]
        blank = networkx.MultiDiGraph() if self.directed else networkx.MultiGraph()
        lines = content.decode("utf-8-sig").splitlines()
        graph: networkx.Graph[Any] = networkx.parse_edgelist(lines, create_using=blank)
        listed = sum(bool(line.split("#")[0].strip()) for line in lines)
        if graph.number_of_edges() != listed:
            # networkx passes over lines that have no two nodes.
            raise ValueError(f"{listed - graph.number_of_edges()} lines without two nodes")
        return graph


def _read_links(graph: networkx.Graph[Any], path: str) -> LinkTable:
    ids = assign_ids(graph.nodes)
    counts = Counter(str(label).strip() for label in ids)
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise ScenarioError("", "two nodes have one name", twice[0], "rename one of them")
    directed = graph.is_directed()
    edges: list[tuple[Any, Any, Any]] = list(graph.edges(data=PROBABILITY))
    has_probabilities = any(p is not None for *_, p in edges)
    pairs: list[Link] = []
    probability: dict[Link, float] = {}
    for first, second, value in edges:
        ends, p = [str(first), str(second)], 1.0 if value is None else value
        if first == second:
            raise ScenarioError("", "a link must join two nodes", ends, "correct the edge")
        is_number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if has_probabilities and not (is_number and 0.0 <= float(value) <= 1.0):
            rule = f"every edge must have a {PROBABILITY} from 0 to 1, or none"
            raise ScenarioError("", rule, [*ends, value], "correct the edge")
        link = ids[first], ids[second]
        link = link if directed else (min(link), max(link))
        pairs.append(link)
        if probability.setdefault(link, float(p)) != p:
            rule = "two edges say different things of one link"
            got = [*ends, probability[link], p]
            raise ScenarioError("", rule, got, "correct one of the two edges")
    alone = frozenset(ids.values()) - {node for link in pairs for node in link}
    names = {str(label): k for label, k in ids.items() if str(k) != str(label)}
    use = count_rows(path, pairs, probability.__contains__)
    return LinkTable(use, probability, has_probabilities, directed, alone, names)


def from_networkx(graph: networkx.Graph[Any]) -> Edges:
    """Return nodes and links of a networkx graph, its ``delivery_probability``, and places by
    ``pos``, or ``x`` and ``y``; integers are ids, texts names. Raises ScenarioError.
    """
    table = _read_links(graph, "graph")
    labels = {k: name for name, k in table.names.items()}
    nodes = tuple(labels.get(k, k) for k in assign_ids(graph.nodes).values())
    edges: Any = tuple((labels.get(i, i), labels.get(j, j)) for i, j in table.probability)
    probabilities = np.array(list(table.probability.values()))
    return Edges(
        edges=edges,
        nodes=nodes,
        directed=table.directed,
        delivery=probabilities if table.has_probabilities else None,
        positions=_positions(graph.nodes.values()),
    )


def _positions(attributes: Iterable[dict[str, Any]]) -> FloatArray | None:
    """Return (x, y) (N, 2) of each node from its attributes, None unless all nodes have a place."""
    points = []
    for node in attributes:
        point = node.get("pos", (node.get("x"), node.get("y")))
        try:
            x, y = map(float, point)
        except (TypeError, ValueError):
            return None
        if not (math.isfinite(x) and math.isfinite(y)):
            return None
        points.append([x, y])
    return np.array(points) if points else None


def as_graph(value: Any) -> Any:
    """Return a networkx graph as Edges, and other values as they are."""
    # networkx takes a second to import: who has a graph of it has imported it. A thread may be at
    # it just now: then the module has no Graph yet.
    kind = getattr(sys.modules.get("networkx"), "Graph", None)
    return from_networkx(value) if kind is not None and isinstance(value, kind) else value


def _convert_graph(value: Any) -> Graph:
    graph = as_graph(value)
    if not isinstance(graph, Graph):
        raise TypeError
    return graph


graph_rule = Rule("must be a graph", _convert_graph, 'write a table { kind = "...", ... }')
"""The rule for the graph of a network, which may be a graph of networkx."""
