"""Positions of the nodes of a network on a plane."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Topology

MAX_KAMADA_KAWAI, PIVOTS = 150, 50
"""Nodes up to which the layout of Kamada and Kawai is computed, from distances between all pairs of
nodes; for larger networks only distances to so many pivots are.
"""
MAX_STEPS = 300  # of a search for positions
MAX_RING = 30
"""Nodes of a ring up to which it is drawn as a circle."""
Positions = dict[int, tuple[float, float]]
"""Coordinates (x, y) by node id, y upwards."""


def get_positions(scenario: Any, run: Any = None) -> Positions:
    """Return where nodes begin by the scenario or in a ``run``, else computed positions."""
    places, x = scenario.positions, scenario.plant.start_mean
    if run is not None and len(run.x):
        x = np.where(np.isfinite(run.x[0]), run.x[0], x)
    if not all(map(places.has, scenario.nodes)):
        return compute_layout(scenario.topology)
    points = {node: places.at(node, 0.0, x) for node in scenario.nodes}
    if len({*points.values()}) < len(points) or any(len(xy) < 2 for xy in points.values()):
        return compute_layout(scenario.topology)
    return {node: (xy[0], xy[1]) for node, xy in points.items()}


def compute_layout(topology: Topology) -> Positions:
    """Return positions: rings as a circle, small networks by Kamada and Kawai, large by pivots."""
    if len(topology.nodes) > MAX_KAMADA_KAWAI:
        return _pivot_layout(topology)
    nodes, degrees = topology.nodes, set(topology.degrees.values())
    if len(nodes) <= MAX_RING and degrees <= {0, 2}:
        # The order of the nodes is that around the circle.
        angles = 2.0 * np.pi * np.arange(len(nodes)) / len(nodes)
        circle = zip(nodes, np.cos(angles).tolist(), np.sin(angles).tolist(), strict=True)
        return {node: (x, y) for node, x, y in circle}
    X = _spring_layout(_hops(topology))
    return {node: (float(x), float(y)) for node, (x, y) in zip(nodes, X, strict=True)}


def _hops(topology: Topology) -> FloatArray:
    """Return the distances (N, N) in links; nodes without a path are beyond all others."""
    size = len(topology.nodes)
    links = np.eye(size, dtype=np.float32)
    a, b = topology.ends.T
    links[a, b] = links[b, a] = 1.0
    distances, reached = np.zeros((size, size)), np.eye(size, dtype=bool)
    for _ in range(size):
        distances[~reached] += 1.0
        reached = reached.astype(np.float32) @ links > 0.0
    distances[~reached] = 1.5 * max(float(distances[reached].max()), 1.0)
    return distances


def _spring_layout(distances: FloatArray) -> FloatArray:
    """Return positions (N, 2) of low stress, ``sum (|x_i - x_j| / d_ij - 1)^2``."""
    size = len(distances)
    angles, centre = 2.0 * np.pi * np.arange(size) / size, np.eye(size) - 1.0 / size
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    values, vectors = np.linalg.eigh(-0.5 * centre @ distances**2 @ centre)
    scaled = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    (stress, X), (other, Y) = (_lower_stress(start, distances) for start in (circle, scaled))
    # Complete graphs and rings look best as circles.
    X = Y if other < 0.9 * stress else X
    return np.asarray(X / np.abs(X).max())


def _lower_stress(X: FloatArray, distances: FloatArray) -> tuple[float, FloatArray]:
    """Return the stress and positions (N, 2) after steps that lower the stress of X."""
    # The energy of Kamada and Kawai (1989) by majorisation (Gansner, Koren and North 2004).
    size, stress = len(X), np.inf
    weights = (distances + np.eye(size)) ** -2.0 - np.eye(size)
    inverse = np.linalg.inv(np.diag(weights.sum(axis=1)) - weights + 1.0 / size)
    for _ in range(MAX_STEPS):
        lengths = np.sqrt(((X[:, None] - X) ** 2).sum(axis=2))
        previous, stress = stress, float((weights * (lengths - distances) ** 2).sum())
        if stress <= 1e-4 or previous - stress <= 1e-6 * stress:
            break
        pull = weights * distances / np.maximum(lengths, 1e-9)
        X = inverse @ (pull.sum(axis=1)[:, None] * X - pull @ X)
    return stress, X


def _pivot_layout(topology: Topology) -> Positions:
    """Return positions by Pivot MDS (Brandes and Pich, Graph Drawing 2006), for large networks."""
    # scipy 1.13 searches only graphs with 32-bit indices.
    ends = topology.ends.astype(np.int32)
    size, (rows, columns) = len(topology.nodes), ends.T
    adjacency = scipy.sparse.csr_array((np.ones(len(ends)), (rows, columns)), shape=(size, size))
    pivots = np.linspace(0, size - 1, PIVOTS).astype(int)
    distances = scipy.sparse.csgraph.dijkstra(
        adjacency, directed=False, unweighted=True, indices=pivots
    )
    # Nodes without a path to a pivot are drawn beyond all others.
    is_reached = np.isfinite(distances)
    distances[~is_reached] = 1.5 * max(float(distances[is_reached].max()), 1.0)
    # Double centring of the squared distances (N, PIVOTS), then the two leading singular vectors.
    squares = distances.T**2
    centred = squares - squares.mean(axis=0) - squares.mean(axis=1)[:, None] + squares.mean()
    _, axes = np.linalg.eigh(centred.T @ centred)
    xy = centred @ axes[:, :-3:-1]
    xy = xy / max(float(np.abs(xy).max()), 1e-300)
    return {node: (float(x), float(y)) for node, (x, y) in zip(topology.nodes, xy, strict=True)}
