"""Every graph kind builds what its name says."""

import networkx
import numpy as np
import pytest

import netkf
from netkf.core.errors import ScenarioError
from netkf.network import graphs
from tests.conftest import SCENARIOS


def test_regular_shapes():
    assert graphs.Cycle(5).build(0).links == ((0, 1), (0, 4), (1, 2), (2, 3), (3, 4))
    assert graphs.PathGraph(4).build(0).links == ((0, 1), (1, 2), (2, 3))
    assert graphs.Star(4).build(0).links == ((0, 1), (0, 2), (0, 3))
    assert len(graphs.Complete(6).build(0).links) == 15
    grid = graphs.Grid(2, 3).build(0)
    assert grid.links == ((0, 1), (0, 3), (1, 2), (1, 4), (2, 5), (3, 4), (4, 5))
    assert grid.positions[5] == (2.0, -1.0)
    assert grid.degrees == {0: 2, 1: 3, 2: 2, 3: 2, 4: 3, 5: 2}


def test_random_graphs_follow_their_seed():
    for graph in (
        graphs.Regular(nodes=20, degree=3),
        graphs.ErdosRenyi(nodes=20, p=0.3),
        graphs.Geometric(nodes=20, radius=0.4),
    ):
        assert graph.build(1).links == graph.build(1).links
        assert graph.build(1).links != graph.build(2).links
        own = type(graph)(**{**vars(graph), "seed": 1})
        assert own.build(7).links == graph.build(1).links
    assert set(graphs.Regular(nodes=20, degree=3).build(1).degrees.values()) == {3}
    near = graphs.Geometric(nodes=20, radius=0.4).build(3)
    for i in near.nodes:
        for j in range(i):
            apart = np.hypot(*np.subtract(near.positions[i], near.positions[j]))
            assert ((j, i) in near.links) == (apart <= 0.4)


def test_connected_draws_until_it_is():
    sparse = graphs.ErdosRenyi(nodes=12, p=0.2, connected=True)
    for seed in range(20):
        assert len(sparse.build(seed).components) == 1
    with pytest.raises(ScenarioError, match="none of 1000 graphs drawn was connected"):
        graphs.ErdosRenyi(nodes=12, p=0.01, connected=True).build(0)


def test_edges_keep_their_ids():
    topology = graphs.Edges(edges=[[7, 3], [3, 2], [3, 7]]).build(0)
    assert topology.nodes == (2, 3, 7)
    assert topology.links == ((2, 3), (3, 7))
    lonely = graphs.Edges(edges=[[0, 1]], nodes=3).build(0)
    assert [len(part) for part in lonely.components] == [2, 1]


def test_csv_rows_listed_once_count_both_ways(tmp_path):
    (tmp_path / "g.csv").write_text("sender,receiver,delivery_probability\n1,2,0.5\n2,3,0.7\n")
    graph = graphs.CsvGraph(path=str(tmp_path / "g.csv"))
    topology = graph.build(0)
    assert topology.delivery == {(1, 2): 0.5, (2, 1): 0.5, (2, 3): 0.7, (3, 2): 0.7}


def test_csv_minimum_holds_in_both_directions(tmp_path):
    rows = "1,2,0.5\n2,1,0.2\n2,3,0.7\n3,2,0.3\n3,4,0.9\n"
    (tmp_path / "g.csv").write_text("sender,receiver,delivery_probability\n" + rows)
    topology = graphs.CsvGraph(path=str(tmp_path / "g.csv"), minimum=0.25).build(0)
    assert topology.links == ((2, 3),)
    assert topology.notes == (
        "nodes 1, 4 left out: no link reaches the minimum 0.25",
        "links listed in one direction only left out: 3 to 4",
    )
    directed = graphs.CsvGraph(path=str(tmp_path / "g.csv"), minimum=0.25, directed=True).build(0)
    assert directed.links == ((1, 2), (2, 3), (3, 2), (3, 4))


def test_a_probability_that_a_table_leaves_open_is_not_made_up(tmp_path):
    path = tmp_path / "g.csv"
    path.write_text("sender,receiver,delivery_probability\n1,2,0.5\n2,1,0.2\n2,3,0.7\n3,4,0.9\n")
    for least in (None, 0.0):
        with pytest.raises(ScenarioError, match=r"others in one.*2 to 3, 3 to 4.*directed = "):
            graphs.CsvGraph(path=str(path), minimum=least).build(0)
    assert graphs.CsvGraph(path=str(path), directed=True).build(0).delivery[3, 4] == 0.9
    # Without probabilities nothing is left open.
    path.write_text("sender,receiver\n1,2\n2,1\n2,3\n")
    assert graphs.CsvGraph(path=str(path)).build(0).links == ((1, 2), (2, 3))


@pytest.mark.parametrize("header", ["node,x,y", "y,node,x", "mote,x_m,y_m", "node,x,y,z"])
def test_a_table_of_places_is_read_by_its_names_or_else_in_their_order(tmp_path, header):
    links, places = tmp_path / "links.csv", tmp_path / "places.csv"
    links.write_text("sender,receiver\n0,1\n")
    columns = {"y": [3, 4], "z": [9, 9], "node": [0, 1], "x": [1, 0]}
    columns |= {"mote": columns["node"], "x_m": columns["x"], "y_m": columns["y"]}
    rows = zip(*(columns[name] for name in header.split(",")), strict=True)
    text = "".join(",".join(map(str, row)) + "\n" for row in rows)
    places.write_text(f"{header}\n{text}")
    topology = graphs.CsvGraph(path=str(links), positions=str(places)).build(0)
    assert topology.positions == {0: (1.0, 3.0), 1: (0.0, 4.0)}


def test_intel_lab_network():
    topology = netkf.load(SCENARIOS / "intel_lab.toml").topology
    assert (len(topology.nodes), len(topology.links)) == (53, 202)
    assert 5 not in topology.nodes
    assert topology.notes == ("node 5 left out: no link reaches the minimum 0.25",)
    assert max(topology.degrees.values()) == 12
    assert networkx.is_connected(networkx.Graph(topology.links))
    assert all(
        min(topology.delivery[i, j], topology.delivery[j, i]) >= 0.25 for i, j in topology.links
    )
    assert topology.positions[16] == (1.5, 2.0)


def test_what_is_listed_has_the_limits_of_what_is_drawn():
    with pytest.raises(ScenarioError, match="must have at most 200,000 nodes"):
        graphs.Edges(edges=[(k, k + 1) for k in range(200_000)]).build(0)
