"""Small networks on which matchings are checked."""

from __future__ import annotations

from netkf.network.graphs import Complete, Cycle, Grid, Star, Topology


def _renumber(topology: Topology, ids: tuple[int, ...]) -> Topology:
    new_ids = dict(zip(topology.nodes, ids, strict=True))
    links = tuple((new_ids[i], new_ids[j]) for i, j in topology.links)
    return Topology(nodes=ids, links=links)


def small_networks() -> tuple[Topology, ...]:
    """Return networks of 4 to 6 nodes: a cycle, a star, a complete graph with gaps in its node ids,
    and a grid.
    """
    return (
        Cycle(nodes=6).build(seed=0),
        Star(nodes=5).build(seed=0),
        _renumber(Complete(nodes=4).build(seed=0), (1, 4, 5, 9)),
        Grid(rows=2, columns=3).build(seed=0),
    )


def is_edge_transitive(topology: Topology) -> bool:
    """Return True for cycles, complete graphs and stars, whose links are all equivalent by
    symmetry.
    """
    count, degrees = len(topology.nodes), sorted(topology.degrees.values())
    if len(topology.components) > 1 or count < 2:
        return False
    is_cycle = degrees == [2] * count
    is_complete = len(topology.links) == count * (count - 1) // 2
    is_star = degrees == [*[1] * (count - 1), count - 1]
    return is_cycle or is_complete or is_star
