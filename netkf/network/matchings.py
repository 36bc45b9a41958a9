"""Activation in slots: random matchings with their exact mean, broadcasts and records.

Entry (i, j) of the mean matching ``Abar`` is the probability that i and j are paired in a slot;
entry (i, i) that i is not paired, paper G section II. It is exact: a formula or a recursion.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np

from netkf.core.contracts import is_netkf_class
from netkf.core.csv_files import Columns, read_columns, read_header
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    SourceFile,
    field,
    number,
    of_time,
    one_of,
    positive,
    source_file,
)
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Link, Topology, demand_links

MAX_EDGES = 20  # beyond it the recursions over sets of edges take too long


@dataclass(frozen=True, eq=False)
class SlotActivation(Component):
    """The contract of activation in slots, which selects the links of each exchange.

    ``phase`` is the length of one exchange in seconds, which its steps share: each lasts phase /
    steps. The inbox of a step closes at its end; what arrives just then is in time. By default half
    of the period is shared evenly among the exchanges of a slot.
    """

    phase: float | None = field(of_time(positive), default=None)

    @abstractmethod
    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the fields do not fit the graph."""


PROTOCOLS = ("one-edge", "node-wakeup", "maximal", "uniform-maximal", "independent")


@dataclass(frozen=True, eq=False)
class Matching(SlotActivation):
    """A random matching in each slot, drawn by ``protocol``.

    one-edge        one link, uniformly; with probability ``lazy`` none
    node-wakeup     one node, uniformly, and one of its neighbours, uniformly
    maximal         links in random order, each taken if both ends are free (greedy)
    uniform-maximal one of all maximal matchings, uniformly
    independent     each link with probability ``p`` by itself; links that meet are all dropped
    """

    protocol: str = field(one_of(*PROTOCOLS))
    lazy: float | None = field(number(low=0.0, below=1.0), default=None)
    p: float | None = field(number(above=0.0, high=1.0), default=None)

    def __post_init__(self) -> None:
        """Check the fields; raises ScenarioError for a missing parameter or another protocol's."""
        super().__post_init__()
        for name, owner in (("lazy", "one-edge"), ("p", "independent")):
            if getattr(self, name) is not None and self.protocol != owner:
                raise ScenarioError(
                    name, f"means nothing for {self.protocol}", getattr(self, name), "remove it"
                )
        if self.protocol == "independent" and self.p is None:
            raise ScenarioError("p", "is missing for independent", None, "add p = ...")

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if maximal matchings must be listed and there are too many links."""
        if self.protocol == "uniform-maximal" and len(topology.links) > MAX_EDGES:
            raise ScenarioError(
                "protocol",
                f"uniform-maximal needs a graph of at most {MAX_EDGES} links",
                f"{len(topology.links)} links",
                'use "maximal"',
            )

    def draw(self, topology: Topology, random: np.random.Generator) -> list[Link]:
        """Draw the matching of one slot by the protocol, the pairs (i, j), i < j, of nodes that
        exchange, none in two pairs. Both engines call it, or take the same numbers from ``random``.
        """
        links = topology.links
        if not links:
            return []
        draws = {
            "one-edge": self._one_edge,
            "node-wakeup": _node_wakeup,
            "maximal": _random_greedy,
            "uniform-maximal": _uniform_maximal,
            "independent": self._independent,
        }
        return draws[self.protocol](topology, random)

    def _one_edge(self, topology: Topology, random: np.random.Generator) -> list[Link]:
        """Return one uniform link, or none with probability ``lazy``; both numbers are drawn."""
        lazy = random.random() < (self.lazy or 0.0)
        edge = topology.links[int(random.integers(len(topology.links)))]
        return [] if lazy else [edge]

    def _independent(self, topology: Topology, random: np.random.Generator) -> list[Link]:
        """Return the links drawn with probability p that share no node with another drawn link."""
        uniform = random.random(len(topology.links))
        up = [link for link, u in zip(topology.links, uniform, strict=True) if u < (self.p or 0.0)]
        # Number of drawn links at each node: a link alone at both ends is kept.
        busy = Counter(node for link in up for node in link)
        return [link for link in up if busy[link[0]] == busy[link[1]] == 1]

    def mean(self, topology: Topology) -> FloatArray:
        """Return the exact mean ``Abar`` (N, N) of the permutation matrix of a matching, which
        swaps the states of paired nodes, in the order of the nodes.

        Raises ScenarioError if the graph has too many links to compute it.
        """
        probabilities = self._pairing_probabilities(topology)
        mean = np.zeros((len(topology.nodes),) * 2)
        for (i, j), value in probabilities.items():
            a, b = topology.index[i], topology.index[j]
            mean[a, b] = mean[b, a] = value
        # On the diagonal: the node is in no pair.
        mean[np.diag_indices(len(mean))] = 1.0 - mean.sum(axis=1)
        return mean

    def _pairing_probabilities(self, topology: Topology) -> dict[Link, float]:
        links, degrees = topology.links, topology.degrees
        if self.protocol == "one-edge":
            return dict.fromkeys(links, (1.0 - (self.lazy or 0.0)) / max(len(links), 1))
        if self.protocol == "node-wakeup":
            size = len(topology.nodes)
            # One end wakes up, and draws the other end among its neighbours.
            return {(i, j): (1.0 / degrees[i] + 1.0 / degrees[j]) / size for i, j in links}
        if self.protocol == "independent":
            p = self.p or 0.0
            # The link is drawn, and none of the other links at both of its ends.
            return {(i, j): p * (1.0 - p) ** (degrees[i] + degrees[j] - 2) for i, j in links}
        if len(links) > MAX_EDGES:
            raise ScenarioError(
                "network.activation.protocol",
                f"has an exact mean for at most {MAX_EDGES} links only",
                f"{len(links)} links",
                "use one-edge, node-wakeup or independent",
            )
        if self.protocol == "uniform-maximal":
            matchings = maximal_matchings(links)
            return {link: sum(link in m for m in matchings) / len(matchings) for link in links}
        return dict(zip(links, _greedy_probabilities(links), strict=True))


def _node_wakeup(topology: Topology, random: np.random.Generator) -> list[Link]:
    """Return the link of a uniform node and a uniform neighbour; none without neighbours."""
    node = topology.nodes[int(random.integers(len(topology.nodes)))]
    uniform = random.random()
    peers = sorted({j if i == node else i for i, j in topology.links if node in (i, j)})
    if not peers:
        return []
    peer = peers[int(uniform * len(peers))]
    return [(min(node, peer), max(node, peer))]


def _random_greedy(topology: Topology, random: np.random.Generator) -> list[Link]:
    """Return the maximal matching that takes links in a random order."""
    links = topology.links
    return _choose_greedily([links[k] for k in random.permutation(len(links)).tolist()])


def _uniform_maximal(topology: Topology, random: np.random.Generator) -> list[Link]:
    matchings = maximal_matchings(topology.links)
    return list(matchings[int(random.integers(len(matchings)))])


def _choose_greedily(links: list[Link]) -> list[Link]:
    """Return the matching that takes each of ``links`` in turn if both ends are still free."""
    matched: set[int] = set()
    chosen = []
    for i, j in links:
        if i not in matched and j not in matched:
            matched.add(i)
            matched.add(j)
            chosen.append((i, j))
    return chosen


@lru_cache(maxsize=8)
def maximal_matchings(links: tuple[Link, ...]) -> tuple[tuple[Link, ...], ...]:
    """Return all maximal matchings of a graph, each sorted, in sorted order."""
    matchings: set[tuple[Link, ...]] = set()

    def extend(chosen: tuple[Link, ...], free: tuple[Link, ...]) -> None:
        if not free:
            matchings.add(tuple(sorted(chosen)))
            return
        first = free[0]
        # A maximal matching holds the first free link or one that meets it.
        for link in free:
            if set(link) & set(first):
                extend((*chosen, link), tuple(o for o in free if not set(o) & set(link)))

    extend((), links)
    return tuple(sorted(matchings))


def _greedy_probabilities(links: tuple[Link, ...]) -> tuple[float, ...]:
    n = len(links)
    meets = [sum(1 << b for b in range(n) if set(links[a]) & set(links[b])) for a in range(n)]

    @cache
    def probabilities(free: int) -> tuple[float, ...]:
        """Return p(free) = mean over a in ``free`` (a bit mask) of (1 at a) + p(free without a)."""
        candidates = [a for a in range(n) if free >> a & 1]
        total = [0.0] * n
        for a in candidates:
            total[a] += 1.0
            for b, value in enumerate(probabilities(free & ~meets[a])):
                total[b] += value
        return tuple(value / max(len(candidates), 1) for value in total)

    return probabilities((1 << n) - 1)


@dataclass(frozen=True, eq=False)
class Broadcast(SlotActivation):
    """Broadcasts: in each step of an exchange every node sends to every neighbour."""

    def check(self, topology: Topology) -> None:
        """Accept any graph."""


RowKey = tuple[int, int, int, Link]
"""Slot, phase, step and link of a row of recorded exchanges."""


@dataclass(frozen=True, eq=False)
class RecordedSlots(SlotActivation):
    """Exchanges read from a table.

    Columns ``slot,node,peer`` are the pairs of matchings. Columns ``slot,phase,step,node,peer`` are
    the links of broadcasts that were up, from node to peer, and in both directions if the graph is
    undirected.
    """

    path: SourceFile = field(source_file)

    _reads = "_pairs"

    @property
    def matching(self) -> bool:
        """True if the table lists the pairs of matchings."""
        return "phase" not in read_header(self.path)

    @cached_property
    def _table(self) -> Columns:
        exchange = () if self.matching else ("phase", "step")
        return read_columns(self.path, ("slot", *exchange, "node", "peer"))

    @cached_property
    def row_keys(self) -> list[RowKey]:
        """The key of each row, in the order of the table; equal ones are one link that is up."""
        table = self._table
        columns = {name: table.integers(name) for name in table}
        zeros = [0] * len(table.lines)
        phases, steps = (columns.get(name, zeros) for name in ("phase", "step"))
        links: Iterable[Link] = zip(columns["node"], columns["peer"], strict=True)
        if self.matching:
            # A pair has no direction, and may be listed from either end.
            links = ((min(link), max(link)) for link in links)
        return list(zip(columns["slot"], phases, steps, links, strict=True))

    @cached_property
    def _pairs(self) -> dict[tuple[int, int, int], list[Link]]:
        """Pairs of node ids by (slot, phase, step), in the order of the table."""
        pairs: dict[tuple[int, int, int], dict[Link, int]] = {}
        matching = self.matching
        lines = self._table.lines.tolist()
        for (slot, phase, step, link), line in zip(self.row_keys, lines, strict=True):
            listed = pairs.setdefault((slot, phase, step), {})
            if matching and link not in listed:
                self._demand_free(slot, link, line, listed)
            listed.setdefault(link, line)
        return {key: list(listed) for key, listed in pairs.items()}

    def _demand_free(self, slot: int, link: Link, line: int, listed: dict[Link, int]) -> None:
        other = next((line for pair, line in listed.items() if set(pair) & set(link)), None)
        if other is None and link[0] != link[1]:
            return
        where = f"line {line}" if other is None else f"lines {other} and {line}"
        rule = f"{self.path.name} {where}: a node may be paired once a slot"
        raise ScenarioError("path", rule, [slot, *link], "correct the row")

    @property
    def recorded(self) -> tuple[tuple[int, int, int], ...]:
        """The (slot, phase, step) that have rows in the table."""
        return tuple(self._pairs)

    def pairs(self, slot: int, phase: int, step: int = 0) -> list[Link]:
        """Return the pairs of node ids of one step of the exchange number ``phase`` of a slot, in
        the order of the table; for broadcasts the listed directions (sender, receiver).
        """
        return self._pairs.get((slot, phase, step), [])

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless every recorded pair is a link."""
        demand_links(self._table, topology, "node", "peer")


def _checked(activation: Matching, given: Any, topology: Topology) -> list[Link]:
    """Return the pairs that a user's class drew; raises ScenarioError if they are no matching."""
    pairs: list[Any] = [tuple(pair) for pair in given]
    nodes = [node for pair in pairs for node in pair]
    if len(set(nodes)) < len(nodes) or not set(pairs) <= set(topology.links):
        name = f"{type(activation).__name__}.draw"
        rule = f"{name} must return links (i, j) of the graph, i < j, with no node twice"
        raise ScenarioError("network.activation", rule, pairs, "correct draw of the class")
    return pairs


def used_links(
    activation: object,
    topology: Topology,
    random: np.random.Generator,
    step: tuple[int, int, int],
    pairwise: bool,
) -> tuple[list[Link], set[Link] | None]:
    """Return the links used in a ``step``, (slot, phase, repeat), and their directions that are up
    (None: all); matchings are drawn from ``random``.
    """
    if isinstance(activation, Matching):
        pairs = activation.draw(topology, random)
        is_own = not is_netkf_class(type(activation))
        return _checked(activation, pairs, topology) if is_own else pairs, None
    if not isinstance(activation, RecordedSlots):
        return list(topology.links), None
    listed = activation.pairs(*step)
    if pairwise:
        return listed, None
    # A recorded list names links once: in an undirected graph both directions are up.
    up = set(listed)
    return list(topology.links), up if topology.directed else up | {(j, i) for i, j in listed}
