"""Rows of tables that repeat each other are counted and noted; rows that contradict are refused."""

import json

import pytest

import netkf
from netkf.cli.main import main
from netkf.scenario.usage import record_usage

SENSOR = {"nodes": [0], "H": [[1.0]], "R": [[0.5]]}
CLOCKS = {
    "format": 1,
    "name": "clocks",
    "horizon": 4.0,
    "probe": 1.0,
    "plant": {"kind": "diffusion", "A": [[-0.2]], "B": [[1.0]], "cov": [[1.0]]},
    "sensors": [{**SENSOR, "sampling": {"kind": "periodic", "period": 0.5}}],
    "network": {
        "graph": {"kind": "edges", "edges": [[0, 1], [1, 2]]},
        "activation": {"kind": "poisson", "rate": 1.0},
    },
    "filter": {"kind": "hybrid", "epsilon": 0.3},
}
SLOTS = {
    **CLOCKS,
    "name": "slots",
    "plant": {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]},
    "sensors": [SENSOR],
    "filter": {"kind": "gossip"},
    "network": {
        "graph": {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 3]]},
        "activation": {"kind": "matching", "protocol": "one-edge"},
    },
}
RECORDED = {"kind": "recorded", "path": "table.csv"}
COARSE = {"time": {"resolution": 0.1}}
GRAPH = {"network.graph": {"kind": "csv", "path": "table.csv"}}
PLACES = {"network.graph": {"kind": "csv", "path": "links.csv", "positions": "table.csv"}}
LISTENING = {"network.activation": {"kind": "broadcast"}, "filter": {"kind": "diffusion"}}
TRUTH = {"plant": {**CLOCKS["plant"], "kind": "recorded", "path": "table.csv"}}
SLOT_TRUTH = {"plant": {**SLOTS["plant"], "kind": "recorded", "path": "table.csv"}}
BURSTS = {"kind": "gilbert-elliott", "mean_loss": 0.1, "mean_burst": 4.0}
HEAD_OF_INTERVALS = "from,until,sender,receiver,delivery\n"
HEAD = "sender,receiver,message,"

# Of each kind of table: the scenario, what names the table, its key, its rows, and the numbers of
# used, merged and unused rows.
REPEATED = {
    "ticks of nodes": (
        CLOCKS,
        {"network.activation": {**RECORDED, "at": "nodes"}},
        "network.activation",
        "t,node\n1,0\n1,0\n1,1\n1,0\n2,0\n4,0\n4,0\n",
        (3, 2, 2),
    ),
    "ticks of links": (  # either end may be listed first
        CLOCKS,
        {"network.activation": RECORDED},
        "network.activation",
        "t,node,peer\n1,0,1\n1,1,0\n1,1,2\n2,0,1\n",
        (3, 1, 0),
    ),
    "ticks of directions": (
        CLOCKS,
        {"network.activation": {**RECORDED, "at": "directions"}},
        "network.activation",
        "t,node,peer\n1,0,1\n1,1,0\n1,0,1\n9,0,1\n",
        (2, 1, 1),
    ),
    "ticks at one instant of the run": (  # 2.96 is 3.0 there, and 3.96 the horizon
        CLOCKS,
        {"network.activation": {**RECORDED, "at": "nodes"}, **COARSE},
        "network.activation",
        "t,node\n0.96,0\n1.04,0\n1,1\n2.96,0\n3.04,0\n3.96,0\n",
        (3, 2, 1),
    ),
    "sample times at one instant of the run": (
        CLOCKS,
        {"sensors.0.sampling": RECORDED, **COARSE},
        "sensors[0].sampling",
        "t,node\n0.04,0\n0.96,0\n1.04,0\n3.96,0\n",
        (2, 1, 1),
    ),
    "sample times": (
        CLOCKS,
        {"sensors": [{**SENSOR, "sampling": RECORDED}]},
        "sensors[0].sampling",
        "t,node\n1,0\n1,0\n2,0\n2,1\n2,1\n",
        (2, 1, 2),
    ),
    "losses": (
        CLOCKS,
        {"network.channel.loss": RECORDED},
        "network.channel.loss",
        HEAD + "delivered\n0,1,0,1\n0,1,0,1\n0,1,90,1\n0,1,90,1\n",
        (1, 1, 2),
    ),
    "delays": (
        CLOCKS,
        {"network.channel.delay": RECORDED},
        "network.channel.delay",
        HEAD + "seconds\n0,1,0,0.25\n1,0,0,0.5\n0,1,0,0.25\n",
        (2, 1, 0),
    ),
    "links": (CLOCKS, GRAPH, "network.graph", "sender,receiver\n0,1\n1,2\n0,1\n", (2, 1, 0)),
    "links with probabilities": (
        CLOCKS,
        GRAPH,
        "network.graph",
        "sender,receiver,delivery_probability\n0,1,0.5\n1,2,0.5\n0,1,0.5\n",
        (2, 1, 0),
    ),
    "positions": (
        CLOCKS,
        PLACES,
        "network.graph.positions",
        "node,x,y\n0,0,0\n1,5,0\n2,0,5\n1,5,0\n7,9,9\n",
        (3, 1, 1),
    ),
    "matchings": (
        SLOTS,
        {"network.activation": RECORDED},
        "network.activation",
        "slot,node,peer\n1,0,1\n1,1,0\n1,2,3\n2,1,2\n9,1,2\n9,1,2\n",
        (3, 1, 2),
    ),
    "broadcasts": (
        SLOTS,
        {**LISTENING, "network.activation": RECORDED},
        "network.activation",
        "slot,phase,step,node,peer\n0,0,0,0,1\n0,0,0,1,0\n0,0,0,0,1\n1,0,0,0,1\n",
        (3, 1, 0),
    ),
    "true states": (
        CLOCKS,
        TRUTH,
        "plant",
        "t,x0\n" + "".join(f"{k / 2},{k}\n" for k in range(9)) + "1,2\n0.25,7\n",
        (9, 1, 1),
    ),
    "true states in slots": (
        SLOTS,
        SLOT_TRUTH,
        "plant",
        "t,x0\n0,1\n1,2\n2,3\n3,4\n4,5\n2,3\n8,5\n8,5\n",
        (5, 1, 2),
    ),
    "lives": (  # the last row at or before 0 says how a node begins
        CLOCKS,
        {"network.lives": [{**RECORDED, "nodes": [1]}]},
        "network.lives[0]",
        "t,node,what\n-2,1,down\n-1,1,up\n1,1,down\n2,1,up\n1,1,down\n4,1,down\n",
        (3, 1, 2),
    ),
    "losses that change": (
        CLOCKS,
        {"network.channel": {"loss": {**RECORDED, "kind": "scheduled"}}},
        "network.channel.loss",
        HEAD_OF_INTERVALS + "0,1,0,1,0.5\n0,1,1,0,0.25\n0,1,0,1,0.5\n4,9,0,1,0\n",
        (2, 1, 1),
    ),
    "bursts": (
        CLOCKS,
        {"network.channel": {"loss": {**BURSTS, "path": "table.csv"}, "symmetric": False}},
        "network.channel.loss",
        "sender,receiver,mean_loss,mean_burst\n0,1,0.5,2\n1,2,0.5,3\n0,1,0.5,2\n",
        (2, 1, 0),
    ),
    "channels": (
        CLOCKS,
        {"network.channel": {"channels": {"hopping": [11, 15], "path": "table.csv"}}},
        "network.channel.channels",
        "channel,delivery\n11,0.5\n26,1\n15,0\n11,0.5\n26,1\n",
        (2, 1, 2),
    ),
}
# The last row says something else about the same thing: the lines that contradict each other.
CONTRADICTORY = {
    "losses": ("0,1,0,0\n", "lines 2 and 6: delivered must be 0 or 1, one value a message"),
    "delays": ("1,0,0,0.75\n", "lines 3 and 5: seconds must be at least 0, one value a message"),
    "links with probabilities": ("1,2,0.25\n", "lines 3 and 5: each direction must be listed once"),
    "positions": ("2,0,6\n", "lines 4 and 7: a node must have one position"),
    "matchings": ("2,2,3\n", "lines 5 and 8: a node may be paired once a slot"),
    "lives": ("2,1,leave\n", "lines 5 and 8: a node must go up or down once at a time"),
    "losses that change": ("0,1,1,0,1\n", "lines 3 and 6: a direction must have one delivery"),
    "bursts": ("1,2,0.5,4\n", "lines 3 and 5: a direction must have one chain"),
    "channels": ("15,1\n", "lines 4 and 7: a channel must have one delivery"),
    "true states": ("2,9\n", "lines 6 and 13: there may be one row a time"),
    "true states in slots": ("3,9\n", "lines 5 and 10: there may be one row a slot"),
}


@pytest.fixture
def make(tmp_path):
    (tmp_path / "links.csv").write_text("sender,receiver\n0,1\n1,2\n")

    def make(kind, more=""):
        base, changes, key, rows, counts = REPEATED[kind]
        (tmp_path / "table.csv").write_text(rows + more)
        start = netkf.scenario.reading.from_table(base, tmp_path)
        return start.replace(changes), key, counts

    return make


@pytest.mark.parametrize("kind", REPEATED)
def test_rows_that_repeat_others_are_counted_and_noted(kind, make):
    scenario, key, (used, merged, unused) = make(kind)
    sent = dict.fromkeys(scenario.topology.directions, 5)
    use = record_usage(scenario, sent)[key]
    assert (use["used"], use["merged"], use["unused"]) == (used, merged, unused)
    assert use["rows"] == used + merged + unused
    (note,) = [note for note in scenario.notes if "merged" in note]
    assert note.startswith(f"{key}: ")
    assert "(table.csv)" in note


@pytest.mark.parametrize("kind", CONTRADICTORY)
def test_rows_that_contradict_each_other_are_refused_with_both_lines(kind, make):
    row, words = CONTRADICTORY[kind]
    with pytest.raises(netkf.ScenarioError) as caught:
        make(kind, row)
    assert f"table.csv {words}" in str(caught.value)
    assert "remove" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"network.activation": {**RECORDED, "at": "nodes"}}, "network.activation"),
        ({"sensors": [{**SENSOR, "sampling": RECORDED}]}, "sensors[0].sampling"),
    ],
)
def test_rows_before_the_origin_of_a_log_are_counted(changes, key, tmp_path):
    (tmp_path / "table.csv").write_text("t,node\n98,0\n99,0\n99,0\n101,0\n102,0\n102,0\n104,0\n")
    base = {**CLOCKS, "time": {"origin": 100}}
    scenario = netkf.scenario.reading.from_table(base, tmp_path).replace(changes)
    use = record_usage(scenario, {})[key]
    assert (use["used"], use["merged"], use["unused"]) == (2, 1, 4)
    (tmp_path / "table.csv").write_text("t,node\n0,0\n1,0\n")
    with pytest.raises(netkf.ScenarioError, match=r"line 2: t must be above 0.*\[time\] origin"):
        netkf.scenario.reading.from_table(CLOCKS, tmp_path).replace(changes)


def test_of_rows_that_hold_those_are_used_that_hold_in_the_run(tmp_path):
    """At the origin another row begins, and at the horizon too."""
    base = {**CLOCKS, "time": {"origin": 100}}
    end = 100 + base["horizon"]
    rows = "".join(f"{t:g},1\n" for t in (98, 99, 100, 101, end))
    (tmp_path / "table.csv").write_text("t,u0\n" + rows)
    u = {"kind": "recorded", "path": "table.csv", "G": [[1.0]]}
    changes = {"plant.input": u}
    scenario = netkf.scenario.reading.from_table(base, tmp_path).replace(changes)
    use = record_usage(scenario, {})["plant.input"]
    assert (use["used"], use["unused"]) == (2, 3)


@pytest.mark.parametrize(
    "changes",
    [
        {"network.activation": {**RECORDED, "at": "nodes"}},
        {"sensors": [{**SENSOR, "sampling": RECORDED}]},
    ],
)
def test_an_origin_that_leaves_no_row_in_the_run_is_noted(changes, tmp_path):
    """One in milliseconds, as the rows are, is a thousand times too late: it is in seconds."""
    (tmp_path / "table.csv").write_text("t,node\n1701000,0\n1702000,0\n")
    for origin, words in {
        1700000: "end before 0, at t = -1698298.0: check",
        1690: "begin after the horizon, at t = 11.0: check",
        1700: None,
    }.items():
        base = {**CLOCKS, "time": {"origin": origin, "unit": "ms"}}
        notes = netkf.scenario.reading.from_table(base, tmp_path).replace(changes).notes
        found = [note for note in notes if note.startswith("all records")]
        assert found == [note for note in notes if words and words in note], origin


def test_a_counter_that_wraps_is_told_how_to_go_on(make):
    with pytest.raises(netkf.ScenarioError, match="if a counter of the log wraps, add its length"):
        make("losses", "0,1,0,0\n")


@pytest.mark.one_in(2)
@pytest.mark.parametrize("command", ["run", "check", "sweep", "consistency"])
def test_every_command_says_it_once(command, make, tmp_path, capsys):
    make("ticks of nodes")
    path = tmp_path / "again.toml"
    path.write_text(
        'format = 1\nname = "again"\nhorizon = 4.0\nprobe = 1.0\n[plant]\nkind = "diffusion"\n'
        "A = [[-0.2]]\nB = [[1.0]]\ncov = [[1.0]]\n"
        "[[sensors]]\nnodes = [0]\nH = [[1.0]]\nR = [[0.5]]\n"
        'sampling = { kind = "periodic", period = 0.5 }\n[network]\n'
        'graph = { kind = "path", nodes = 3 }\n'
        'activation = { kind = "recorded", at = "nodes", path = "table.csv" }\n'
        '[filter]\nkind = "hybrid"\nepsilon = 0.3\n'
    )
    more = {
        "run": ["--no-plot", "--out", str(tmp_path / "out")],
        "check": ["--runs", "10"],
        "sweep": ["--vary", "filter.epsilon=0.1,0.2", "--no-plot", "--out", str(tmp_path / "out")],
        "consistency": ["--runs", "10"],
    }
    main([command, str(path), *more[command]])
    shown = capsys.readouterr()
    lines = (shown.out + shown.err).splitlines()
    assert not [line for line in lines if line.startswith("netkf: ")], lines
    assert sum("2 of 7 rows were not used" in line for line in lines) == 1
    assert (
        sum("3 of 7 rows repeat the node and time of an earlier row" in line for line in lines) == 1
    )
    if command == "run":
        use = json.loads((tmp_path / "out" / "summary.json").read_text())["records"]
        assert use["network.activation"] == {
            "path": "table.csv",
            "rows": 7,
            "used": 3,
            "merged": 2,
            "unused": 2,
        }
