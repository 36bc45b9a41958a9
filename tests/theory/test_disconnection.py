"""The disconnection probability against enumeration and closed forms."""

import itertools
import json
import pickle

import networkx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import netkf
from netkf import theory
from netkf.theory.push_sum import disconnection
from tests.cases import FOLDER
from tests.theory.push_sum_systems import T1, planar

GRAPHS = json.loads((FOLDER / "push_sum.json").read_text())["graphs"]


@pytest.mark.parametrize("graph", GRAPHS, ids=lambda graph: graph["name"])
def test_reference_graphs(graph):
    for delivery, expected in graph["p_d"].items():
        found = theory.disconnection_probability(graph["edges"], float(delivery))
        assert found == pytest.approx(expected, abs=1e-12)
        assert found.exact
        assert found.low == found.high == float(found)


def test_the_planar_network():
    expected = {0.5: 0.748627, 0.6: 0.495362, 0.7: 0.248257, 0.8: 0.085520, 0.9: 0.014959}
    for delivery, value in expected.items():
        of_scenario = theory.disconnection_probability(planar(1, delivery))
        assert of_scenario == pytest.approx(value, abs=5e-7)
        assert theory.disconnection_probability(T1, delivery) == of_scenario
        topology = planar(1, delivery).topology
        assert theory.disconnection_probability(topology, delivery) == of_scenario


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 7), st.floats(0.2, 1.0), st.integers(0, 10**6))
def test_against_enumeration(nodes, density, seed):
    random = np.random.default_rng(seed)
    graph = networkx.gnp_random_graph(nodes, density, seed=seed)
    edges = list(graph.edges)[:12]
    graph = networkx.Graph(edges)
    graph.add_nodes_from(range(nodes))
    chances = dict(zip(edges, random.choice([0.0, 0.3, 0.8, 1.0], len(edges)), strict=True))
    cut = 0.0
    for up in itertools.product((0, 1), repeat=len(edges)):
        some = networkx.Graph([e for e, u in zip(edges, up, strict=True) if u])
        some.add_nodes_from(range(nodes))
        if not networkx.is_connected(some):
            pairs = zip(edges, up, strict=True)
            cut += np.prod([chances[e] if u else 1.0 - chances[e] for e, u in pairs])
    found = theory.disconnection_probability(graph, chances)
    assert found.exact
    assert found == pytest.approx(cut, abs=1e-12)


def test_closed_forms_of_large_graphs():
    p = 0.97
    ring, path = networkx.cycle_graph(300), networkx.path_graph(300)
    one_less = 300 * (1 - p) * p**299
    assert theory.disconnection_probability(ring, p) == pytest.approx(1 - p**300 - one_less)
    assert theory.disconnection_probability(path, p) == pytest.approx(1 - p**299)
    # a small probability keeps its digits: of K_8 mostly one node is cut off
    rare = theory.disconnection_probability(networkx.complete_graph(8), 0.999)
    assert rare == pytest.approx(8 * 1e-21, rel=1e-3)


def test_an_interval_where_it_is_not_exact(monkeypatch):
    exact = theory.disconnection_probability(T1, 0.7)
    monkeypatch.setattr(disconnection, "MAX_PARTITIONS", 3)
    found = theory.disconnection_probability(T1, 0.7, samples=40_000)
    assert not found.exact
    assert found.low < exact < found.high
    assert found.low < float(found) < found.high < found.low + 0.02
    assert "99%" in repr(found)
    assert "exact" in repr(exact)
    again = pickle.loads(pickle.dumps(found))
    assert (again, again.low, again.exact) == (found, found.low, False)
    assert theory.disconnection_probability(T1, 0.7, samples=40_000) == found


@pytest.mark.parametrize(
    ("graph", "delivery", "words"),
    [
        (networkx.DiGraph([(0, 1)]), 0.5, "undirected"),
        ([(0, 1)], 1.5, "must lie in"),
        ([(0, 1)], float("nan"), "must lie in"),
        ([(0, 1)], [0.5], "must be a number"),
        ([(0, 1), (1, 2)], {(1, 0): 0.5}, "must be given for link"),
        ([(0, 1)], None, "must be given"),
        ([], 0.5, "must have a node"),
        ([(0, 1), (1, 0)], {(0, 1): 0.5, (1, 0): 0.9}, "has two probabilities: 0.5 and 0.9"),
        (networkx.MultiGraph([(0, 1), (0, 1)]), 0.5, "several links in parallel"),
        (planar(1, 0.7, symmetric=False), None, "fail apart"),
    ],
)
def test_refusals(graph, delivery, words):
    with pytest.raises(netkf.TheoryError, match=words):
        theory.disconnection_probability(graph, delivery)
