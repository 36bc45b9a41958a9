"""Networks on which losses, clocks and matchings are looked at link by link."""

from __future__ import annotations

from netkf.network.graphs import Complete, Cycle, Grid, Star, Topology


def _renumbered(topology: Topology, ids: tuple[int, ...]) -> Topology:
    """Return the same graph with other node ids, in increasing order."""
    new = dict(zip(topology.nodes, ids, strict=True))
    return Topology(nodes=ids, links=tuple((new[i], new[j]) for i, j in topology.links))


def small_networks() -> tuple[Topology, ...]:
    """Return networks of a few nodes: a cycle, a star, a complete graph with gaps in its ids, and a
    grid.
    """
    return (
        Cycle(nodes=6).build(seed=0),
        Star(nodes=5).build(seed=0),
        _renumbered(Complete(nodes=4).build(seed=0), (1, 4, 5, 9)),
        Grid(rows=2, columns=3).build(seed=0),
    )


def edge_transitive(topology: Topology) -> bool:
    """Return True for cycles, complete graphs and stars: no link differs from another there."""
    count, degrees = len(topology.nodes), sorted(topology.degrees.values())
    if len(topology.components) > 1 or count < 2:
        return False
    cycle = degrees == [2] * count
    complete = len(topology.links) == count * (count - 1) // 2
    return cycle or complete or degrees == [*[1] * (count - 1), count - 1]
