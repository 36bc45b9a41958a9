"""What the push-sum filter refuses and what it notes, before anything runs."""

import networkx
import numpy as np
import pytest

import netkf
from netkf.network.spectra import MAX_DENSE
from tests.conftest import SCENARIOS

PLANAR = SCENARIOS / "push_sum_planar.toml"
TWO_PARTS = {"kind": "edges", "edges": [[0, 1], [2, 3], [4, 9]], "nodes": 10}
CYCLE = {"kind": "cycle", "nodes": 10}
DIRECTED = {"kind": "edges", "edges": [[4, 9], [9, 4]], "directed": True}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"filter.gamma": 0}, "filter.gamma: must be an integer of at least 1"),
        ({"filter.gamma": 1.5}, "filter.gamma: must be an integer of at least 1"),
        ({"filter.gamma": 10**6}, "and at most 100,000; got 1000000"),
        ({"filter.gamma": True}, "filter.gamma: must be an integer"),
        ({"filter.delta": 0.0}, "filter.delta: must be a finite number above 0"),
        ({"filter.delta": float("inf")}, "filter.delta: must be a finite number above 0"),
        ({"filter.delta": 3.34}, "filter.delta: must be above rho(L) / 2 = 3.34001"),
        ({"filter.delta": "large"}, "filter.delta: must be a finite number above 0"),
        ({"filter.leader": 10}, "filter.leader: must be a node of the graph; got 10"),
        ({"filter.leader": -1}, "filter.leader: must be an integer of at least 0"),
        ({"filter.asymptotic": 1}, "filter.asymptotic: must be true or false"),
        ({"filter.links": "stale"}, 'filter.links: must be one of "fresh", "held"'),
        ({"filter.stop": "soon"}, 'filter.stop: must be one of "never", "safe", "paper"'),
        ({"filter.tolerance": -1e-6}, "filter.tolerance: must be a finite number at least 0"),
        ({"filter.tolerance": float("nan")}, "filter.tolerance: must be a finite number"),
        ({"filter.steps": 3}, "filter.steps: is not a key here"),
        ({"filter": {"kind": "push-sum", "gamma": 1}}, "filter.delta: is missing"),
        ({"filter": {"kind": "push-sum", "delta": 7.0}}, "filter.gamma: is missing"),
        (
            {"network.activation": {"kind": "matching", "protocol": "maximal"}},
            "must be a broadcast for the push-sum filter",
        ),
        ({"network.activation": {"kind": "poisson", "rate": 1.0}}, "in continuous time"),
        ({"network": {"graph": CYCLE}}, "is missing, and the push-sum filter talks"),
        ({"network.activation.phase": 0.125}, "must leave 2 exchange(s) room within the period"),
        ({"network.graph": TWO_PARTS}, "must be connected for the push-sum filter"),
        ({"network.graph": DIRECTED}, "must be false for the push-sum filter"),
        (
            {"filter.asymptotic": True, "sensors": [], "plant.F": 1.1 * np.eye(4)},
            "filter.asymptotic: needs a steady covariance",
        ),
    ],
)
def test_mistakes_are_refused_in_one_line(changes, words):
    with pytest.raises(netkf.ScenarioError) as caught:
        netkf.load(PLANAR, changes)
    line = str(caught.value)
    assert words in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("1,2,0,0,3", "up.csv: the filter has no such step, only 1 in phase 0 and 3 in phase 1"),
        ("1,1,3,0,3", "got 'slot 1, phase 1, step 3'"),
        ("1,0,1,0,3", "got 'slot 1, phase 0, step 1'"),
        ("1,0,0,0,1", "up.csv"),  # not a link
        ("1,0,0,0,x", "peer must name a node of the graph"),
        ("1,0,0.5,0,3", "step must hold integers"),
        ("-1,0,0,0,3", "slot must hold integers"),
        ("1,0,0,0", "line 2 must have 5 entries"),
    ],
)
def test_records_of_other_steps_or_links_are_refused(row, words, tmp_path):
    (tmp_path / "up.csv").write_text(f"slot,phase,step,node,peer\n{row}\n")
    text = PLANAR.read_text()
    text = text.replace('{ kind = "broadcast" }', '{ kind = "recorded", path = "up.csv" }')
    (tmp_path / "run.toml").write_text(text)
    with pytest.raises(netkf.ScenarioError, match=r"network\.activation") as caught:
        netkf.load(tmp_path / "run.toml")
    assert words in str(caught.value)


def test_delta_is_noted_below_rho_and_refused_at_half_of_it():
    scenario = netkf.load(PLANAR)
    assert "filter.delta = 4.01 is below rho(L) = 6.68003" in scenario.notes[0]
    radius = scenario.topology.laplacian_radius
    for share, notes in ((0.5 + 1e-9, 1), (1.0 - 1e-9, 1), (1.0, 0), (1.5, 0)):
        assert len(scenario.replace({"filter.delta": share * radius}).notes) == notes
    with pytest.raises(netkf.ScenarioError):
        scenario.replace({"filter.delta": 0.5 * radius})
    assert scenario.replace({"filter": {"kind": "central"}}).notes == ()


@pytest.mark.parametrize("size", [12, MAX_DENSE + 100])
def test_rho_is_the_largest_eigenvalue_of_the_laplacian(size):
    graph = {"kind": "regular", "nodes": size, "degree": 3, "seed": 2}
    scenario = netkf.load(PLANAR, {"network.graph": graph, "filter.delta": 7.0})
    L = networkx.laplacian_matrix(networkx.Graph(scenario.topology.links)).toarray()
    expected = np.linalg.eigvalsh(L.astype(float))[-1]
    assert scenario.topology.laplacian_radius == pytest.approx(expected, rel=1e-9)


def test_a_rho_that_is_an_integer_is_one_to_the_bit_in_any_order_of_nodes():
    for graph in (netkf.parts.Complete(7), netkf.parts.Star(7), netkf.parts.Cycle(10)):
        links, order = graph.build(0).links, np.random.default_rng(1).permutation(10).tolist()
        for ids in (range(10), order):
            edges = [(ids[i], ids[j]) for i, j in links]
            assert netkf.parts.Edges(edges).build(0).laplacian_radius in (4.0, 7.0)
