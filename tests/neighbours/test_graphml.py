"""Networks as GraphML, read by networkx and by netkf itself."""

import networkx
import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from netkf.neighbours.graphml import carried_network
from tests.conftest import SCENARIOS


def test_links_have_what_they_carried(run, tmp_path):
    netkf.save(run, run.scenario, tmp_path)
    (path,) = netkf.export_graphml(run, tmp_path)
    graph = networkx.read_graphml(path)
    assert not graph.is_directed()
    assert set(graph.nodes) == {"gate", "roof", "lab"}
    assert set(map(frozenset, graph.edges)) == {
        frozenset(["gate", "roof"]),
        frozenset(["roof", "lab"]),
    }
    assert graph.nodes["lab"] == {"sensors": 1, "x": 3.0, "y": 4.0}
    assert graph.nodes["roof"]["sensors"] == 0
    names = {str(node): int(node) for node in run.nodes}
    events = run.events
    for *ends, link in graph.edges(data=True):
        i, j = sorted(names[end] for end in ends)
        for back, (a, b) in {"": (i, j), "_back": (j, i)}.items():
            sent = events[(events.kind == "send") & (events.node == a) & (events.peer == b)]
            came = events[(events.kind == "deliver") & (events.node == b) & (events.peer == a)]
            assert link[f"sent{back}"] == len(sent) > 10
            assert link[f"delivered{back}"] == len(came) > 0
            assert link[f"mean_age{back}"] == pytest.approx(came.age.mean(), rel=1e-12)
    table = {"kind": "graphml", "path": path.name}
    again = netkf.load(tmp_path / "scenario.toml", {"network.graph": table})
    assert again.topology.links == run.scenario.topology.links
    assert again.topology.names == run.scenario.topology.names
    assert again.topology.positions == run.scenario.topology.positions


def test_a_file_has_the_places_of_its_nodes(run, tmp_path):
    """As the same graph does that is given in Python; netkf's own files lost them."""
    graph = networkx.cycle_graph(["gate", "roof", "lab"])
    networkx.set_node_attributes(graph, {"gate": 0.5, "roof": 1.5, "lab": -2.0}, "x")
    networkx.set_node_attributes(graph, {"gate": 0.0, "roof": 3.0, "lab": 1.0}, "y")
    netkf.save(run, run.scenario, tmp_path / "run")
    networkx.write_graphml(graph, tmp_path / "run" / "places.graphml")
    networkx.write_gml(graph, tmp_path / "run" / "places.gml")
    tables = [{"kind": end, "path": f"places.{end}"} for end in ("graphml", "gml")]
    file = tmp_path / "run" / "scenario.toml"
    given, *read = (
        netkf.load(file, {"network.lives": [], "network.graph": one}).topology.positions
        for one in (graph, *tables)
    )
    assert given is not None
    assert read == [given, given]


def test_directions_of_a_table_are_links_of_their_own(run):
    nodes, edges = ["gate", "roof", "lab"], [("gate", "roof", 0.9), ("roof", "lab", 0.5)]
    graph = networkx.DiGraph()
    graph.add_nodes_from(nodes)
    graph.add_weighted_edges_from(edges, weight="delivery_probability")
    graph.add_weighted_edges_from([(b, a, 0.8) for a, b, _ in edges], "delivery_probability")
    changes = {
        "network.graph": graph,
        "network.lives": [],
        "network.activation.at": "directions",
        "network.channel.loss": {"kind": "per-link"},
    }
    scenario = run.scenario.replace(changes)
    found = carried_network(netkf.simulate(scenario, engine="simpy"))
    assert found.is_directed()
    for a, b, p in graph.edges(data="delivery_probability"):
        assert found.edges[a, b]["delivery_probability"] == p
    table = networkx.to_numpy_array(found, nodelist=nodes, weight="delivery_probability")
    np.testing.assert_array_equal(
        table, networkx.to_numpy_array(graph, nodelist=nodes, weight="delivery_probability")
    )


def test_the_command_writes_into_the_run(run, tmp_path, capsys):
    netkf.save(run, run.scenario, tmp_path / "run")
    assert main(["export", str(tmp_path / "run"), "--to", "graphml"]) == 0
    path = tmp_path / "run" / "network.graphml"
    assert len(networkx.read_graphml(path)) == 3
    assert netkf.open(tmp_path / "run").fingerprint == run.fingerprint
    for words, wrong in {
        ("--to", "graphml"): "exists already",
        ("--to", "log"): "--out: is missing",
        ("--to", "graphml", "--window", "1:2"): "is for --to perfetto",
        ("--to", "perfetto", "--window", "1-2"): "must be FROM:TO in seconds",
        ("--to", "perfetto", "--window", "50:60"): "has nothing in it",
        ("--to", "perfetto", "--window=-3:6"): "must be",
    }.items():
        capsys.readouterr()
        assert main(["export", str(tmp_path / "run"), *words]) == 2
        error = capsys.readouterr().err
        assert wrong in error
        assert error.count("\n") == 1
    with pytest.raises(netkf.ScenarioError, match="must be a run with its scenario"):
        netkf.export_graphml(None, tmp_path / "x")


def test_what_tells_of_events_needs_the_trace_of_the_run(tmp_path, capsys):
    out = str(tmp_path / "run")
    options = ["--set", "horizon=2.0", "--engine", "simpy", "--no-plot", "--trace", "none"]
    assert main(["run", str(SCENARIOS / "poisson_ring.toml"), "--out", out, *options]) == 0
    for form in ("log", "recorded", "graphml", "perfetto"):
        assert main(["export", out, "--to", form, "--out", str(tmp_path / form)]) == 2
        assert "run: has no events and samples" in capsys.readouterr().err
        assert not (tmp_path / form).exists()
