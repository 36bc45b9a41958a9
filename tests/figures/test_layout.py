"""Positions of nodes, against those that networkx finds for the same energy by another method."""

import networkx
import numpy as np
import pytest

from netkf.figures import layout
from netkf.network.graphs import Topology

GRAPHS = {
    "path": networkx.path_graph(12),
    "star": networkx.star_graph(8),
    "grid": networkx.convert_node_labels_to_integers(networkx.grid_2d_graph(4, 6)),
    "random": networkx.connected_watts_strogatz_graph(30, 4, 0.2, seed=1),
    "ring": networkx.cycle_graph(40),
    "full": networkx.complete_graph(7),
}


def layout_of(graph):
    return layout.compute_layout(Topology(tuple(graph.nodes), tuple(graph.edges)))


@pytest.mark.parametrize("name", GRAPHS)
def test_positions_have_about_the_least_energy_of_kamada_and_kawai(name):
    graph = GRAPHS[name]
    lengths = dict(networkx.all_pairs_shortest_path_length(graph))
    d = np.array([[lengths[i][j] or 1 for j in graph] for i in graph], dtype=float)

    def energy(points):
        X = np.array([points[node] for node in graph])
        ratio = np.linalg.norm(X[:, None] - X, axis=2) / d
        ratio *= ratio.sum() / (ratio**2).sum()  # of the best scale
        return ((ratio - 1.0) ** 2).sum() - len(d)  # of each node with itself it is 1

    found = energy(layout_of(graph))
    assert found <= 1.1 * energy(networkx.kamada_kawai_layout(graph)) + 1e-3


def test_nodes_without_a_path_are_beyond_all_others():
    graph = networkx.path_graph(4)
    graph.add_node(4)
    points = layout_of(graph)
    X = np.array([points[node] for node in graph])
    lengths = np.linalg.norm(X[:, None] - X, axis=2)
    assert np.isfinite(X).all()
    assert lengths[4, :4].min() > lengths[0, 1]
