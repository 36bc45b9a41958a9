"""Positions of the nodes of a network on a plane."""

from __future__ import annotations

from typing import Any

import networkx
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph

from netkf.network.graphs import Topology

# Above so many nodes distances to some pivots replace those between all pairs.
MAX_KAMADA_KAWAI, PIVOTS = 150, 50
Positions = dict[int, tuple[float, float]]


def positions_of(topology: Topology) -> Positions:
    """Return the positions of the nodes: those of the network, or computed ones."""
    return topology.positions or _layout(topology)


def _layout(topology: Topology) -> Positions:
    """Return positions of the nodes for a topology that has none of its own."""
    if len(topology.nodes) > MAX_KAMADA_KAWAI:  # it needs the paths between all pairs of nodes
        return _pivot_layout(topology)
    graph: networkx.Graph[int] = networkx.Graph()
    graph.add_nodes_from(topology.nodes)  # in their order, which is that around a circle
    graph.add_edges_from(topology.links)
    degrees = set(topology.degrees.values())
    if len(topology.nodes) <= 30 and degrees <= {0, 2}:
        placed: dict[int, Any] = networkx.circular_layout(graph)
    else:
        placed = networkx.kamada_kawai_layout(graph)
    return {node: (float(x), float(y)) for node, (x, y) in placed.items()}


def _pivot_layout(topology: Topology) -> Positions:
    """Return the two principal axes of the distances to a few nodes (Pivot MDS: Brandes and Pich,
    Graph Drawing 2006), which takes one search of the network per pivot.
    """
    pairs = [(topology.index[i], topology.index[j]) for i, j in topology.links]
    ends = np.array(pairs, dtype=np.int32)  # the only indices that scipy 1.13 searches graphs with
    size, (rows, columns) = len(topology.nodes), ends.reshape(-1, 2).T
    adjacency = scipy.sparse.csr_array((np.ones(len(ends)), (rows, columns)), shape=(size, size))
    pivots = np.linspace(0, size - 1, PIVOTS).astype(int)
    distances = scipy.sparse.csgraph.dijkstra(
        adjacency, directed=False, unweighted=True, indices=pivots
    )
    reached = np.isfinite(distances)
    distances[~reached] = 1.5 * max(float(distances[reached].max()), 1.0)
    squares = distances.T**2
    centred = squares - squares.mean(axis=0) - squares.mean(axis=1)[:, None] + squares.mean()
    _, axes = np.linalg.eigh(centred.T @ centred)
    xy = centred @ axes[:, :-3:-1]
    xy = xy / max(float(np.abs(xy).max()), 1e-300)
    return {node: (float(x), float(y)) for node, (x, y) in zip(topology.nodes, xy, strict=True)}
