"""Nodes with names: in tables, fields, files and graphs of networkx, and in what is printed."""

import json

import networkx
import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from netkf.scenario.reading import from_table
from netkf.scenario.writing import resolve_defaults

NAMES = ("lab", "roof", "cellar")
TABLES = {
    "links.csv": "sender,receiver,delivery_probability\nlab,roof,0.9\nroof,cellar,0.8\n",
    "places.csv": "mote,x,y\nroof,0,1\nlab,0,0\ncellar,5,5\n",
    "ticks.csv": "t,node,peer\n0.5,lab,roof\n1.5,cellar,roof\n1.5,roof,cellar\n2.5,roof,lab\n",
    "lost.csv": "sender,receiver,message,delivered\nlab,roof,0,0\n",
    "late.csv": "sender,receiver,message,seconds\nroof,lab,0,0.25\n",
    "samples.csv": "t,node\n0.2,lab\n1.2,roof\n3,roof\n",
    "readings.csv": "t,node,y0\n0.2,lab,1\n1.2,roof,0.5\n3,cellar,0.4\n",
}
PLANT = {"A": [[-0.2]], "B": [[1.0]], "cov": [[1.0]]}
SENSOR = {"H": [[1.0]], "R": [[0.5]]}
SCENARIO = {
    "format": 1,
    "name": "named",
    "horizon": 4.0,
    "probe": 1.0,
    "plant": {"kind": "unknown", **PLANT},
    "sensors": [
        {"kind": "recorded", "path": "readings.csv", "nodes": ["lab", "roof"], **SENSOR},
        {"kind": "recorded", "path": "readings.csv", "nodes": ["cellar"], **SENSOR},
    ],
    "network": {
        "graph": {"kind": "csv", "path": "links.csv", "positions": "places.csv"},
        "activation": {"kind": "recorded", "at": "directions", "path": "ticks.csv"},
        "channel": {
            "loss": {"kind": "recorded", "path": "lost.csv"},
            "delay": {"kind": "recorded", "path": "late.csv"},
        },
    },
    "filter": {"kind": "hybrid", "epsilon": 0.3},
}
DRAWN = {
    "plant": {"kind": "diffusion", **PLANT},
    "sensors": [{"nodes": ["lab"], "sampling": {"kind": "periodic", "period": 0.5}, **SENSOR}],
    "network.activation": {"kind": "poisson", "rate": 2.0, "rates": [["roof", "lab", 5.0]]},
    "network.channel": {"loss": {"kind": "per-link"}},
}


def with_ids(text):
    for k, name in enumerate(NAMES):
        text = text.replace(name, str(k))
    return text


def network():
    graph = networkx.Graph()
    graph.add_edge("lab", "roof", delivery_probability=0.9)
    graph.add_edge("roof", "cellar", delivery_probability=0.8)
    return graph


@pytest.fixture
def folder(tmp_path):
    for name, text in TABLES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.fixture
def named(folder):
    return from_table(SCENARIO, folder)


def test_names_in_all_tables_and_fields_are_the_run_with_ids(named, tmp_path):
    numbered = tmp_path / "numbered"
    numbered.mkdir()
    for name, text in TABLES.items():
        (numbered / name).write_text(with_ids(text))
    same = from_table(json.loads(with_ids(json.dumps(SCENARIO))), numbered)
    runs = [netkf.simulate(scenario, engine="simpy") for scenario in (named, same)]
    assert runs[0].fingerprint == runs[1].fingerprint
    np.testing.assert_array_equal(runs[0].P, runs[1].P)
    assert named.topology.positions == same.topology.positions == {0: (0, 0), 1: (0, 1), 2: (5, 5)}
    assert dict(named.topology.names) == {"lab": 0, "roof": 1, "cellar": 2}
    assert same.topology.names == {}
    sampled = named.replace(
        {**DRAWN, "sensors.0.sampling": {"kind": "recorded", "path": "samples.csv"}}
        | {
            "sensors": [
                {
                    "nodes": ["roof"],
                    "sampling": {"kind": "recorded", "path": "samples.csv"},
                    **SENSOR,
                }
            ]
        }
    )
    assert sampled.sensors[0].sampling.ticks((1,), 0.0, 0, 0.0, None, 9).tolist() == [1.2, 3.0]


@pytest.mark.parametrize("address", ["12e4", "1_2"])
def test_addresses_that_look_like_numbers_are_names_and_messages_say_what_a_name_is(
    folder, address
):
    for name, text in TABLES.items():
        (folder / name).write_text(text.replace("lab", address))
    table = json.loads(json.dumps(SCENARIO).replace("lab", address))
    assert dict(from_table(table, folder).topology.names) == {address: 0, "roof": 1, "cellar": 2}
    for name in ("", "a\nb", "x" * 300):
        table["sensors"][0]["nodes"][0] = name
        rule = r"must be an id, or a name of at most \d+ printable characters"
        with pytest.raises(netkf.ScenarioError, match=rule):
            from_table(table, folder)


def test_names_in_a_table_of_regressors_and_of_ranges(named, folder):
    (folder / "phi.csv").write_text("t,node,y0,phi0\n1,lab,2,0.5\n2,roof,1,0.25\n")
    (folder / "far.csv").write_text("t,node,to,y0\n1,lab,roof,2\n2,roof,cellar,1\n")
    for nodes in ({}, {"nodes": ["roof", "lab"]}):
        table = {"kind": "recorded", "path": "phi.csv", "R": [[0.5]], **nodes}
        (sensor,) = named.replace({"sensors": [table]}).sensors
        assert sorted(sensor.nodes) == [0, 1]
        assert sensor.H[0, 0] in (0.5, 0.25)
    plane = {
        "kind": "unknown",
        "A": [[0.0, 0.0]] * 2,
        "B": [[1.0]] * 2,
        "cov": [[1.0, 0.0], [0.0, 1.0]],
    }
    ranges = {"kind": "range", "path": "far.csv", "R": [[0.1]]}
    scenario = named.replace({"sensors": [ranges], "plant": plane})
    assert scenario.sensors[0].nodes == (0, 1)
    assert scenario.located_sensors[0].positions.tolist() == [[0, 1], [5, 5]]


@pytest.mark.parametrize("kind", ["graphml", "gml", "edgelist", "networkx"])
def test_graphs_that_networkx_reads_are_the_table_of_links(kind, named, folder):
    graph = network()
    if kind != "networkx":
        getattr(networkx, f"write_{kind}")(graph, folder / "graph")
        graph = {"kind": kind, "path": "graph"}
    other = named.replace({"network.graph": graph})
    for what in ("nodes", "links", "directions", "delivery", "names", "directed"):
        assert getattr(other.topology, what) == getattr(named.topology, what), what
    assert other.sensors[0].nodes == (0, 1)
    again = from_table(
        json.loads(json.dumps(netkf.scenario.writing.as_table(other), default=lambda f: f.name)),
        folder,
    )
    assert again == other


@pytest.mark.parametrize("kind", ["graphml", "gml", "edgelist"])
def test_integer_ids_are_kept_also_as_text(kind, folder):
    graph = networkx.DiGraph()
    graph.add_edge(7, 3, delivery_probability=0.5)
    graph.add_edge(3, 7, delivery_probability=0.25)
    getattr(networkx, f"write_{kind}")(graph, folder / "graph")
    more = {"directed": True} if kind == "edgelist" else {}
    cls = netkf.scenario.registry.KINDS["graph"][kind]
    topology = cls(path=folder / "graph", **more).build(0)
    assert topology.nodes == (3, 7)
    assert topology.directed
    assert topology.delivery == {(3, 7): 0.25, (7, 3): 0.5}
    assert topology.names == {}


def test_names_that_are_numbers_keep_them_and_others_take_what_is_free(folder):
    (folder / "links.csv").write_text("sender,receiver\n1,lab\nlab,roof\nroof,3\n")
    topology = netkf.parts.CsvGraph(path=folder / "links.csv").build(0)
    assert topology.nodes == (0, 1, 2, 3)
    assert dict(topology.names) == {"lab": 0, "roof": 2}
    assert topology.links == ((0, 1), (0, 2), (2, 3))


def test_ids_with_zeros_before_them_are_those_of_tables(folder):
    (folder / "links.csv").write_text("sender,receiver\n01,02\n02,03\n")
    network = {
        "graph": {"kind": "csv", "path": "links.csv"},
        "activation": {"kind": "poisson", "rate": 1.0},
    }
    sensors = [DRAWN["sensors"][0] | {"nodes": ["02"]}]
    more = {"plant": DRAWN["plant"], "sensors": sensors, "network": network}
    scenario = from_table(SCENARIO | more, folder)
    assert tuple(scenario.nodes) == (1, 2, 3)
    assert tuple(scenario.sensors[0].nodes) == (2,)


def test_numbers_that_are_no_ids_are_names_where_the_graph_has_them(folder):
    """Nodes of networkx may be -1 or nan; elsewhere such a number is a mistake."""
    graph = networkx.Graph([(-1, 7), (7, "nan")])
    (folder / "ticks.csv").write_text("t,node,peer\n0.5,-1,7\n1.5,nan,7\n")
    (folder / "readings.csv").write_text("t,node,y0\n0.2,-1,1\n1.2,nan,0.5\n")
    sensors = [{"kind": "recorded", "path": "readings.csv", **SENSOR}]
    network = SCENARIO["network"] | {"graph": graph, "channel": {}}
    scenario = from_table(SCENARIO | {"sensors": sensors, "network": network}, folder)
    run = netkf.simulate(scenario, engine="simpy")
    for kind in ("sense", "tick"):
        nodes = run.events[run.events.kind == kind].node
        assert [str(scenario.topology.named(node)) for node in nodes] == ["-1", "nan"]
    network["graph"] = {"kind": "path", "nodes": 3}
    with pytest.raises(netkf.ScenarioError, match=r"line 2: node must .* got '-1'"):
        from_table(SCENARIO | {"sensors": sensors, "network": network}, folder)


def test_a_scenario_of_parts_takes_a_graph_and_names(folder):
    graph = network()
    graph.add_node("shed")
    for k, node in enumerate(graph):
        graph.nodes[node]["pos"] = (k, 2 * k)
    graph.add_edge("shed", "lab", delivery_probability=1.0)
    parts = netkf.parts
    scenario = netkf.Scenario(
        name="parts",
        horizon=2.0,
        probe=1.0,
        plant=parts.Diffusion(A=[[-0.2]], B=[[1.0]], cov=[[1.0]]),
        sensors=[parts.LinearSensor(nodes=["roof"], H=[[1.0]], R=[[0.5]])],
        network=parts.Network(
            graph=graph, activation=parts.RecordedClock(path=folder / "ticks.csv")
        ),
        filter=parts.Filtering(algorithm=parts.Hybrid(epsilon=0.2)),
    )
    assert scenario.sensors[0].nodes == (1,)
    assert scenario.topology.positions[3] == (3.0, 6.0)
    assert scenario.network.activation.row_keys[1] == ((1, 2), 1.5)
    out = folder / "out"
    netkf.save(netkf.simulate(scenario, engine="simpy"), scenario, out)
    assert 'nodes = ["roof"]' in (out / "scenario.toml").read_text()
    again = netkf.load(out / "scenario.toml")
    assert again.topology.names == scenario.topology.names
    # Another graph gives the names other ids.
    other = scenario.replace(
        {"network.graph": networkx.Graph([("roof", "cellar"), ("roof", "lab")])}
    )
    assert other.sensors[0].nodes == (0,)


def test_what_is_printed_and_written_names_the_nodes(named, folder, capsys):
    path, out = folder / "named.toml", folder / "out"
    path.write_text(
        netkf.scenario.writing.to_toml(netkf.scenario.writing.as_table(named.replace(DRAWN)))
    )
    assert main(["run", str(path), "--no-plot", "--out", str(out), "--engine", "simpy"]) == 0
    shown = capsys.readouterr().out
    assert [line.split()[0] for line in shown.splitlines()[4:7]] == list(NAMES)
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["node_names"] == {"lab": 0, "roof": 1, "cellar": 2}
    rows = json.loads((out / "summary.json").read_text())["nodes"]
    assert [(row["node"], row["name"]) for row in rows] == list(enumerate(NAMES))
    assert set(netkf.open(out).events["node"]) <= {-1, 0, 1, 2}
    assert main(["why", str(out), "--node", "cellar", "--at", "3"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("Node cellar at 3 s")
    assert "roof" in shown
    assert main(["why", str(out), "--node", "attic", "--at", "3"]) == 2
    assert "nodes: lab, roof, cellar" in capsys.readouterr().err
    assert main(["compare", str(out)]) == 0
    assert "of node roof" in capsys.readouterr().out


WRONG = {
    "unknown in a field": ({"sensors.0.nodes": ["rof"]}, {}, r'nodes\[0\]: must name.*"roof"\?'),
    "names and a graph of numbers": (
        {"network.graph": {"kind": "path", "nodes": 3}},
        {},
        "must be an integer; got 'lab'",
    ),
    "unknown in a table": (
        {},
        {"ticks.csv": "t,node,peer\n1,lab,rooof\n"},
        "line 2: peer must name",
    ),
    "no name in a table": (
        {},
        {"ticks.csv": "t,node,peer\n1,lab,\n"},
        "line 2: peer must be the id or the name of a node; got ''",
    ),
    "unknown in a key of the filter": (
        {"filter": {"kind": "push-sum", "leader": "rof"}},
        {},
        "^filter.leader: must name",
    ),
    "one link, two values": (
        {},
        {"links.csv": TABLES["links.csv"] + "lab,roof,0.5\n"},
        "lines 2 and 4",
    ),
    "no outcome of a message": (
        {},
        {"lost.csv": "sender,receiver,message,delivered\nlab,roof,0,2\n"},
        r"one value a message; got \['lab', 'roof', 0, 2\]",
    ),
    "not GraphML": ({"network.graph": {"kind": "graphml", "path": "ticks.csv"}}, {}, "networkx"),
    "not GML": ({"network.graph": {"kind": "gml", "path": "ticks.csv"}}, {}, "networkx"),
    "no edge list": (
        {"network.graph": {"kind": "edgelist", "path": "ticks.csv"}},
        {},
        "lines without two nodes",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_of_names_and_graph_files_are_one_line(name, folder):
    changes, tables, words = WRONG[name]
    for file, text in tables.items():
        (folder / file).write_text(text)
    with pytest.raises(netkf.ScenarioError, match=words) as caught:
        from_table(SCENARIO, folder).replace(changes)
    assert len(str(caught.value).splitlines()) == 1


def test_blocks_take_names_where_nodes_stand(tmp_path):
    sampling = {"kind": "periodic", "period": 0.5}
    block = {"name": "pose", "nodes": ["lab", "roof", "cellar"], **PLANT}
    absolute = {"of": "pose", "nodes": ["lab"], "sampling": sampling, **SENSOR}
    relative = {"kind": "relative", "of": "pose", "R": [[0.5]], "sampling": sampling}
    named = {
        **{key: SCENARIO[key] for key in ("format", "name", "horizon", "probe")},
        "plants": [{**block, "coupling": [{"from": ["roof"], "A": [[0.1]]}]}],
        "sensors": [absolute, {**relative, "nodes": ["lab"], "to": [["lab", "cellar"]]}],
        "network": {"graph": {"kind": "edges", "edges": [["lab", "roof"], ["roof", "cellar"]]}},
        "filter": {"kind": "central"},
    }
    scenario = from_table(named, tmp_path)
    with_numbers = from_table(json.loads(with_ids(json.dumps(named))), tmp_path)
    P = netkf.simulate(with_numbers, engine="simpy").P
    assert np.array_equal(netkf.simulate(scenario, engine="simpy").P, P)
    again = from_table(resolve_defaults(scenario), tmp_path)
    assert np.array_equal(netkf.simulate(again, engine="simpy").P, P)
    assert P[-1, 0, 2, 2] < 0.9 * P[-1, 0, 1, 1]  # the pair is read
    named["sensors"][1]["to"] = [["lab", "attic"]]
    rule = r"sensors\[1\].to\[0\]\[1\]: must name a node of the graph; got 'attic'"
    with pytest.raises(netkf.ScenarioError, match=rule):
        from_table(named, tmp_path)


def test_edges_of_a_graph_must_agree():
    graph = networkx.MultiGraph([("a", "b", {"delivery_probability": 0.5})])
    graph.add_edge("b", "a", delivery_probability=0.5)
    topology = netkf.network.graph_files.from_networkx(graph).build(0)
    assert topology.links == ((0, 1),)
    graph.add_edge("a", "b", delivery_probability=0.25)
    with pytest.raises(netkf.ScenarioError, match="two edges say different things"):
        netkf.network.graph_files.from_networkx(graph)
    with pytest.raises(netkf.ScenarioError, match="every edge must have a delivery_probability"):
        netkf.network.graph_files.from_networkx(
            networkx.Graph([("a", "b", {"delivery_probability": 0.5}), ("b", "c")])
        )
    with pytest.raises(netkf.ScenarioError, match="two nodes have one name"):
        netkf.network.graph_files.from_networkx(networkx.Graph([(1, "1")]))
    with pytest.raises(netkf.ScenarioError, match="two nodes have one name"):
        netkf.network.graph_files.from_networkx(networkx.Graph([("b", " b ")]))
    for nodes in (None, [2, "2"]):
        with pytest.raises(netkf.ScenarioError, match="a link must join two nodes"):
            netkf.parts.Edges(edges=[[2, "2"]], nodes=nodes).build(0)


def test_sensors_without_nodes_have_those_of_their_table_by_the_names_of_the_graph(folder):
    """Names of digits are numbers of nodes only where the graph has no such name."""
    (folder / "digits.csv").write_text("t,node,y0\n1.0,07,1.0\n2.0,7,2.0\n2.5,3.0,2.0\n")
    sensor = {"kind": "recorded", "path": "digits.csv", "H": [[1.0]], "R": [[1.0]]}
    for edges, nodes in (([["07", "7"], ["7", 3]], (0, 3, 7)), ([[7, 3]], (3, 7))):
        table = SCENARIO | {"sensors": [sensor]}
        table["plant"] = {"kind": "unknown", "A": [[0.0]], "B": [[1.0]], "cov": [[1.0]]}
        table["network"] = {
            "graph": {"kind": "edges", "edges": edges},
            "activation": {"kind": "poisson", "rate": 1.0},
        }
        assert from_table(table, folder).sensing_nodes == nodes
