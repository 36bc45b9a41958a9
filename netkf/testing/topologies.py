"""Small networks on which matchings are checked."""

from __future__ import annotations

from itertools import combinations

from netkf.network.graphs import Cycle, Grid, Star, Topology


def small_networks() -> tuple[Topology, ...]:
    """Return networks of 4 to 6 nodes: a cycle, a star, a complete graph with gaps in its node ids,
    and a grid.
    """
    return (
        Cycle(nodes=6).build(seed=0),
        Star(nodes=5).build(seed=0),
        Topology(nodes=(1, 4, 5, 9), links=tuple(combinations((1, 4, 5, 9), 2))),
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
