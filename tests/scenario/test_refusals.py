"""Every mistake in a scenario is refused in one line, before anything runs or is written."""

import json
import signal
import tomllib

import pytest

import netkf
from netkf.cli.main import main
from tests.conftest import SCENARIOS

LIMIT = 5  # seconds; a refusal that takes longer is a mistake too
LONGEST_LINE = 1000

RING = "sender,receiver\n0,1\n1,2\n2,3\n3,4\n4,5\n5,0\n"
FILES = {
    "ring.csv": RING,
    "measured.csv": "sender,receiver,delivery_probability\n0,1,0.9\n1,0,0.9\n3,0,0.9\n1,3,0.1\n",
    "island.csv": "sender,receiver,delivery_probability\n0,3,0.9\n3,7,0.1\n",
    "empty.csv": "",
    "header.csv": "sender,receiver\n",
    "renamed.csv": "from,to\n0,1\n",
    "row.csv": "sender,receiver\n0,1\n2\n",
    "word.csv": "sender,receiver\n0,1\nzero,1\n",
    "hole.csv": "sender,receiver,delivery_probability\n0,1,\n",
    "nan.csv": "sender,receiver,delivery_probability\n0,1,nan\n",
    "half.csv": "sender,receiver\n0,1.5\n",
    "loop.csv": "sender,receiver,delivery_probability\n0,1,1.0\n2,2,1.0\n",
    "sure.csv": "sender,receiver,delivery_probability\n0,1,1.5\n",
    "twice.csv": "sender,receiver,delivery_probability\n0,3,0.9\n0,3,0.2\n",
    "latin.csv": b"sender,receiver,caf\xe9\n0,1,2\n",
    "nul.csv": b"sender,receiver\n0,\x001\n",
    "wide.csv": "sender,receiver\n0," + "1" * 200_000 + "\n",
    "minus.csv": "sender,receiver\n-1,0\n0,3\n",
    "far.csv": "sender,receiver\n0,3\n3,1e30\n",
    "places.csv": "node,x,y\n0,0.0,0.0\n1,1.0,0.0\n",
    "no_y.csv": "node,x\n0,0.0\n",
    "latin_places.csv": b"node,x,y\xe9\n0,0,0\n",
    "flag.csv": "sender,receiver,message,delivered\n0,1,0,1\n0,1,1,2\n",
    "minus_message.csv": "sender,receiver,message,delivered\n0,1,-1,0\n",
    "half_message.csv": "sender,receiver,message,delivered\n0,1,0.5,0\n",
    "no_flag.csv": "sender,receiver,message\n0,1,0\n",
    "far_loss.csv": "sender,receiver,message,delivered\n0,2,0,0\n",
    "disputed.csv": "sender,receiver,message,delivered\n0,1,0,0\n0,1,0,1\n",
    "far_clock.csv": "t,node,peer\n0.5,0,1\n0.7,0,2\n",
    "zero.csv": "t,node,peer\n0.0,0,1\n",
    "before.csv": "t,node,peer\n-0.5,0,1\n",
    "never.csv": "t,node,peer\ninf,0,1\n",
    "no_time.csv": "node,peer\n0,1\n",
    "half_node.csv": "t,node,peer\n0.5,0.5,1\n",
    "latin_clock.csv": b"t,node,peer,\xe9\n0.5,0,1,0\n",
    "refusal_syntax.py": "def broken(:\n",
    "refusal_name.py": "print(nothing)\n",
    "refusal_exit.py": "raise SystemExit(5)\n",
    "refusal_lines.py": "raise ImportError('one\\ntwo')\n",
    "refusal_things.py": "class Plain:\n    pass\n\n\nnumber = 5\n",
}
OUTSIDE = "outside.csv"


def flat(table, prefix=""):
    """Key paths with values as TOML text; the only sensor is ``sensors``."""
    paths = {}
    for key, value in table.items():
        if key == "sensors":
            paths |= flat(value[0], "sensors.")
        elif isinstance(value, dict):
            paths |= flat(value, f"{prefix}{key}.")
        else:
            paths[f"{prefix}{key}"] = json.dumps(value)
    return paths


def written(paths):
    """TOML text of such paths."""
    sensor = {key: value for key, value in paths.items() if key.startswith("sensors.")}
    lines = [f"{key} = {value}" for key, value in paths.items() if key not in sensor]
    if sensor:
        lines.append("[[sensors]]")
        lines += [f"{key.removeprefix('sensors.')} = {value}" for key, value in sensor.items()]
    return "\n".join(lines) + "\n"


def changed(change):
    """The bytes of poisson_ring.toml with a change: a mapping from key paths to new TOML text
    (None takes the key or the whole table away), or else the whole text or bytes.
    """
    if isinstance(change, bytes):
        return change
    if isinstance(change, str):
        return change.encode()
    table = tomllib.loads((SCENARIOS / "poisson_ring.toml").read_text(encoding="utf-8"))
    paths = flat(table | {"horizon": 2.0})
    for path, value in change.items():
        for key in [key for key in paths if f"{key}.".startswith(f"{path}.")]:
            del paths[key]
        if value is not None:
            paths[path] = value
    return written(paths).encode()


def graph(kind, settings=""):
    return {"network.graph": f'{{ kind = "{kind}", {settings}'.rstrip(", ") + " }"}


def listed(path, settings=""):
    """A graph from a table."""
    return graph("csv", f'path = "{path}", {settings}')


def clock(kind, settings=""):
    return {"network.activation": f'{{ kind = "{kind}", {settings}'.rstrip(", ") + " }"}


def loss(kind, settings=""):
    return {"network.channel.loss": f'{{ kind = "{kind}", {settings}'.rstrip(", ") + " }"}


def delay(kind, settings=""):
    return {"network.channel.delay": f'{{ kind = "{kind}", {settings}'.rstrip(", ") + " }"}


# (id, change, expected key path, expected fragment of the rule or the value got)

TOP = [
    ("format-missing", {"format": None}, "format", "is missing"),
    ("format-2", {"format": "2"}, "format", "must be 1; got 2"),
    ("format-text", {"format": '"1"'}, "format", "integer; got '1'"),
    ("format-true", {"format": "true"}, "format", "integer; got True"),
    ("name-missing", {"name": None}, "name", "is missing"),
    ("name-number", {"name": "5"}, "name", "got 5"),
    ("name-empty", {"name": '""'}, "name", "not empty; got ''"),
    ("claim-number", {"claim": "5"}, "claim", "one line of text; got 5"),
    ("claim-list", {"claim": '["a", "b"]'}, "claim", "one line of text; got ['a', 'b']"),
    ("claim-lines", {"claim": r'"one\ntwo"'}, "claim", r"one line of text; got 'one\ntwo'"),
    ("horizon-missing", {"horizon": None}, "horizon", "is missing"),
    ("horizon-zero", {"horizon": "0"}, "horizon", "above 0; got 0"),
    ("horizon-negative", {"horizon": "-2.0"}, "horizon", "above 0; got -2.0"),
    ("horizon-inf", {"horizon": "inf"}, "horizon", "finite number above 0; got inf"),
    ("horizon-nan", {"horizon": "nan"}, "horizon", "finite number above 0; got nan"),
    ("horizon-text", {"horizon": '"2"'}, "horizon", "above 0; got '2'"),
    ("horizon-true", {"horizon": "true"}, "horizon", "above 0; got True"),
    ("horizon-list", {"horizon": "[2.0]"}, "horizon", "above 0; got [2.0]"),
    ("horizon-table", {"horizon": "{}"}, "horizon", "above 0; got {}"),
    ("horizon-date", {"horizon": "2020-01-01"}, "horizon", "above 0; got "),
    ("horizon-huge", {"horizon": f"1{'0' * 400}"}, "horizon", "above 0; got 1000"),
    ("probe-missing", {"probe": None}, "probe", "is missing"),
    ("probe-zero", {"probe": "0.0"}, "probe", "above 0"),
    ("probe-negative", {"probe": "-0.5"}, "probe", "above 0"),
    ("probe-nan", {"probe": "nan"}, "probe", "finite number"),
    ("probe-text", {"probe": '"often"'}, "probe", "got 'often'"),
    ("probe-true", {"probe": "true"}, "probe", "got True"),
    ("probe-long", {"probe": "2.5"}, "probe", "at most the horizon 2; got 2.5"),
    ("probe-fine", {"probe": "1e-9"}, "probe", "samples; got 1e-09"),
    ("probe-empty", {"probe": "[]"}, "probe", "list of times; got []"),
    ("probe-beyond", {"probe": "[0.5, 2.5]"}, "probe", "times must lie in [0, 2]; got 2.5"),
    ("probe-early", {"probe": "[-0.5, 1.0]"}, "probe", "times must lie in [0, 2]; got -0.5"),
    ("probe-unsorted", {"probe": "[1.0, 0.5]"}, "probe", "increasing; got [1.0, 0.5]"),
    ("probe-twice", {"probe": "[0.5, 0.5]"}, "probe", "increasing; got [0.5, 0.5]"),
    ("probe-list-nan", {"probe": "[0.5, nan]"}, "probe", "finite numbers; got [0.5, nan]"),
    ("probe-list-text", {"probe": '[0.5, "1"]'}, "probe", "got [0.5, '1']"),
    ("probe-rows", {"probe": "[[0.5], [1.0]]"}, "probe", "list of times; got [[0.5]"),
    ("seed-negative", {"seed": "-1"}, "seed", "at least 0; got -1"),
    ("seed-fraction", {"seed": "1.5"}, "seed", "integer of at least 0; got 1.5"),
    ("seed-true", {"seed": "true"}, "seed", "integer of at least 0; got True"),
    ("seed-text", {"seed": '"one"'}, "seed", "integer of at least 0; got 'one'"),
    (
        "of-channel",
        {"network.loss": '{ kind = "none" }'},
        "network.loss",
        "is a key of channel; keys",
    ),
    ("unknown", {"sede": "2"}, "sede", "is not a key here; got 2"),
    ("unknown-table", {"sensor": "{ H = 1 }"}, "sensor", "is not a key here; got {'H': 1}"),
    ("unknown-lines", {r'"a\nb"': "2"}, r"a\nb", "is not a key here; got 2"),
    ("unknown-long", {"a" * 9999: "2"}, "aaaa", "is not a key here; got 2"),
]

PLANT = [
    ("plant-missing", {"plant": None}, "plant", "is missing"),
    ("plant-text", {"plant": '"diffusion"'}, "plant", "must be a table; got 'diffusion'"),
    ("plant-list", {"plant": '[{ kind = "diffusion" }]'}, "plant", "must be a table; got [{"),
    (
        "plant-of-blocks",
        {"plant.position": "[0]"},
        "plant.position",
        "an entry of [[plants]], beside",
    ),
    ("plant-kind-missing", {"plant.kind": None}, "plant.kind", "is missing"),
    ("plant-kind", {"plant.kind": '"difusion"'}, "plant.kind", "got 'difusion'"),
    ("plant-kind-number", {"plant.kind": "7"}, "plant.kind", "got 7"),
    ("plant-unknown", {"plant.C": "[[1.0]]"}, "plant.C", "is not a key here; got [[1.0]]"),
    ("A-missing", {"plant.A": None}, "plant.A", "is missing"),
    ("A-wide", {"plant.A": "[[0.0, 1.0]]"}, "plant.A", "square matrix, not 1 x 2; got [[0.0"),
    ("A-flat", {"plant.A": "[0.0, 1.0]"}, "plant.A", "matrix; got [0.0, 1.0]"),
    ("A-number", {"plant.A": "1.0"}, "plant.A", "matrix; got 1.0"),
    ("A-ragged", {"plant.A": "[[0.0, 1.0], [1.0]]"}, "plant.A", "got [[0.0, 1.0], [1.0]]"),
    ("A-empty", {"plant.A": "[]"}, "plant.A", "matrix; got []"),
    ("A-empty-row", {"plant.A": "[[]]"}, "plant.A", "matrix; got [[]]"),
    ("A-cube", {"plant.A": "[[[0.0]]]"}, "plant.A", "matrix; got [[[0.0]]]"),
    ("A-nan", {"plant.A": "[[nan, 1.0], [0.0, 0.0]]"}, "plant.A", "finite numbers; got [[nan"),
    ("A-inf", {"plant.A": "[[inf, 1.0], [0.0, 0.0]]"}, "plant.A", "finite numbers; got [[inf"),
    ("A-text", {"plant.A": '[["0", 1.0], [0.0, 0.0]]'}, "plant.A", "finite numbers; got [['0'"),
    ("A-true", {"plant.A": "[[true, 1.0], [0.0, 0.0]]"}, "plant.A", "finite numbers; got [[True"),
    ("A-string", {"plant.A": '"[[0.0]]"'}, "plant.A", "finite numbers; got '[[0.0]]'"),
    ("A-huge", {"plant.A": "[[1e308, 1e308], [1e308, 1e308]]"}, "plant.A", "got [[1e+308"),
    ("B-missing", {"plant.B": None}, "plant.B", "is missing"),
    ("B-rows", {"plant.B": "[[1.0]]"}, "plant.B", "2 x any, not 1 x 1, because plant.A has 2 rows"),
    ("B-flat", {"plant.B": "[0.0, 1.0]"}, "plant.B", "matrix; got [0.0, 1.0]"),
    ("B-huge", {"plant.B": "[[0.0], [1e200]]"}, "plant.B", "got [[0.0], [1e+200]]"),
    ("mean-short", {"plant.mean": "[0.0]"}, "plant.mean", "must be 2, not 1, because"),
    ("mean-rows", {"plant.mean": "[[0.0, 0.0]]"}, "plant.mean", "vector; got [[0.0, 0.0]]"),
    ("mean-nan", {"plant.mean": "[0.0, nan]"}, "plant.mean", "finite numbers; got [0.0, nan]"),
    ("mean-text", {"plant.mean": '"zero"'}, "plant.mean", "finite numbers; got 'zero'"),
    ("cov-shape", {"plant.cov": "[[1.0]]"}, "plant.cov", "must be 2 x 2, not 1 x 1, because"),
    ("cov-wide", {"plant.cov": "[[1.0, 0.0]]"}, "plant.cov", "square matrix, not 1 x 2"),
    ("cov-number", {"plant.cov": "1.0"}, "plant.cov", "matrix; got 1.0"),
    ("cov-nan", {"plant.cov": "[[1.0, 0.0], [0.0, nan]]"}, "plant.cov", "finite numbers; got"),
    (
        "cov-indefinite",
        {"plant.cov": "[[1.0, 2.0], [2.0, 1.0]]"},
        "plant.cov",
        "positive semidefinite (least eigenvalue -1); got [[1.0, 2.0], [2.0, 1.0]]",
    ),
    (
        "cov-asymmetric",
        {"plant.cov": "[[1.0, 0.5], [0.0, 1.0]]"},
        "plant.cov",
        "symmetric matrix; got [[1.0, 0.5]",
    ),
    (
        "cov-asymmetric-huge",
        {"plant.cov": "[[1e308, -1e308], [1e308, 1e308]]"},
        "plant.cov",
        "got [[1e+308, -1e+308]",
    ),
    ("step-zero", {"plant.sensing_period": "0"}, "plant.sensing_period", "above 0; got 0"),
    ("step-text", {"plant.sensing_period": '"a"'}, "plant.sensing_period", "above 0; got 'a'"),
    (
        "step-long",
        {"plant.sensing_period": "1.0", "sensors.R": "[[0.001]]"},
        "plant.sensing_period",
        "too long for the readings of the most precise node; got 1.0",
    ),
    ("step-short", {"plant.sensing_period": "1e-12"}, "plant.sensing_period", "got 1e-12"),
]

SECOND = '[{ nodes = [0], H = [[1.0, 0.0]], R = [[1.0]] }, { kind = "linear", nodes = [1] }]'
BOTH = {"sensors.H": "[[1.0, 0.0], [0.0, 1.0]]"}
SENSORS = [
    ("sensors-table", {"sensors": "{ nodes = [0] }"}, "sensors", "list of tables; got {"),
    ("sensors-text", {"sensors": '"all"'}, "sensors", "must be a list of tables; got 'all'"),
    ("sensors-number", {"sensors": "[5]"}, "sensors[0]", "must be a table; got 5"),
    ("sensor-kind", {"sensors.kind": '"radar"'}, "sensors[0].kind", "got 'radar'"),
    ("sensor-unknown", {"sensors.r": "1.0"}, "sensors[0].r", "is not a key here; got 1.0"),
    ("sensor-nodes-missing", {"sensors.nodes": None}, "sensors[0].nodes", "is missing"),
    ("sensor-H-missing", {"sensors.H": None}, "sensors[0].H", "is missing"),
    ("sensor-R-missing", {"sensors.R": None}, "sensors[0].R", "is missing"),
    ("second-sensor", {"sensors": SECOND}, "sensors[1].H", "is missing"),
    ("node-unknown", {"sensors.nodes": "[0, 6]"}, "sensors[0].nodes[1]", "of the graph; got 6"),
    (
        "node-left-out",
        listed("island.csv", "minimum = 0.5") | {"sensors.nodes": "[7]"},
        "sensors[0].nodes[0]",
        "got 7; none of its links reaches network.graph.minimum",
    ),
    ("node-negative", {"sensors.nodes": "[-1]"}, "sensors[0].nodes[0]", "of the graph; got -1"),
    ("node-twice", {"sensors.nodes": "[3, 3]"}, "sensors[0].nodes", "node once; got [3, 3]"),
    (
        "nodes-number",
        {"sensors.nodes": "0"},
        "sensors[0].nodes",
        "not empty; got 0",
    ),
    (
        "nodes-text",
        {"sensors.nodes": '"all"'},
        "sensors[0].nodes",
        "not empty; got 'all'",
    ),
    (
        "nodes-empty",
        {"sensors.nodes": "[]"},
        "sensors[0].nodes",
        "not empty; got []",
    ),
    ("nodes-fraction", {"sensors.nodes": "[0, 3.0]"}, "sensors[0].nodes[1]", "integer; got 3.0"),
    ("nodes-true", {"sensors.nodes": "[true]"}, "sensors[0].nodes[0]", "integer; got True"),
    ("nodes-texts", {"sensors.nodes": '["0"]'}, "sensors[0].nodes[0]", "integer; got '0'"),
    ("H-columns", {"sensors.H": "[[1.0]]"}, "sensors[0].H", "any x 2, not 1 x 1, because"),
    ("H-flat", {"sensors.H": "[1.0, 0.0]"}, "sensors[0].H", "matrix; got [1.0, 0.0]"),
    ("H-nan", {"sensors.H": "[[nan, 0.0]]"}, "sensors[0].H", "finite numbers; got [[nan"),
    ("H-empty", {"sensors.H": "[]"}, "sensors[0].H", "matrix; got []"),
    ("H-huge", {"sensors.H": "[[1e200, 0.0]]"}, "sensors[0].H", "got [[1e+200, 0.0]]"),
    ("R-number", {"sensors.R": "0.25"}, "sensors[0].R", "matrix; got 0.25"),
    ("R-shape", {"sensors.R": "[[1.0, 0.0], [0.0, 1.0]]"}, "sensors[0].R", "1 x 1, not 2 x 2"),
    ("R-zero", {"sensors.R": "[[0.0]]"}, "sensors[0].R", "positive definite (least eigenvalue 0)"),
    ("R-negative", {"sensors.R": "[[-0.25]]"}, "sensors[0].R", "(least eigenvalue -0.25); got [["),
    (
        "R-singular",
        BOTH | {"sensors.R": "[[1.0, 1.0], [1.0, 1.0]]"},
        "sensors[0].R",
        "definite",
    ),
    (
        "R-asymmetric",
        BOTH | {"sensors.R": "[[1.0, 0.1], [0.0, 1.0]]"},
        "sensors[0].R",
        "symmetric",
    ),
    ("R-tiny", {"sensors.R": "[[1e-320]]"}, "sensors[0].R", "got [[1e-320]]"),
]

G = "network.graph"
GRAPHS = [
    ("network-missing", {"network": None}, "network", "is missing"),
    ("network-text", {"network": '"cycle"'}, "network", "must be a table; got 'cycle'"),
    ("network-list", {"network": "[{}]"}, "network", "must be a table; got [{}]"),
    ("network-unknown", {"network.chanel": "{}"}, "network.chanel", "is not a key here; got {}"),
    ("graph-missing", {G: None}, G, "is missing"),
    ("graph-text", {G: '"cycle"'}, G, "must be a table; got 'cycle'"),
    ("graph-kind-missing", {f"{G}.kind": None}, f"{G}.kind", "is missing"),
    ("graph-kind", graph("ring", "nodes = 6"), f"{G}.kind", "got 'ring'"),
    ("graph-unknown", {f"{G}.n": "6"}, f"{G}.n", "is not a key here; got 6"),
    ("cycle-missing", graph("cycle"), f"{G}.nodes", "is missing"),
    ("cycle-two", graph("cycle", "nodes = 2"), f"{G}.nodes", "at most 200,000; got 2"),
    (
        "cycle-float",
        graph("cycle", "nodes = 6.0"),
        f"{G}.nodes",
        "at most 200,000; got 6.0",
    ),
    ("cycle-true", graph("cycle", "nodes = true"), f"{G}.nodes", "at most 200,000; got True"),
    ("cycle-text", graph("cycle", 'nodes = "6"'), f"{G}.nodes", "at most 200,000; got '6'"),
    ("path-none", graph("path", "nodes = 0"), f"{G}.nodes", "at most 200,000; got 0"),
    ("star-huge", graph("star", f"nodes = 1{'0' * 30}"), f"{G}.nodes", "got 1000"),
    ("complete-huge", graph("complete", "nodes = 100000"), G, "got '100,000 nodes"),
    ("grid-rows", graph("grid", "rows = 0, columns = 3"), f"{G}.rows", "at most 200,000; got 0"),
    ("grid-columns", graph("grid", "rows = 2"), f"{G}.columns", "is missing"),
    ("grid-huge", graph("grid", "rows = 10000, columns = 10000"), G, "got"),
    ("regular-odd", graph("regular", "nodes = 5, degree = 3"), G, "got"),
    ("regular-full", graph("regular", "nodes = 6, degree = 6"), G, "got"),
    ("regular-minus", graph("regular", "nodes = 6, degree = -2"), f"{G}.degree", "0; got -2"),
    ("regular-slow", graph("regular", "nodes = 100, degree = 97"), "filter.epsilon", "1 / 97"),
    ("erdos-p", graph("erdos-renyi", "nodes = 6, p = 1.5"), f"{G}.p", "at most 1; got 1.5"),
    (
        "erdos-seed",
        graph("erdos-renyi", "nodes = 6, p = 0.9, seed = -1"),
        f"{G}.seed",
        "at least 0; got -1",
    ),
    (
        "erdos-connected",
        graph("erdos-renyi", "nodes = 6, p = 0.9, connected = 1"),
        f"{G}.connected",
        "true or false; got 1",
    ),
    (
        "erdos-never",
        graph("erdos-renyi", "nodes = 6, p = 0.0, connected = true"),
        f"{G}.connected",
        "none of 1000 graphs drawn was connected",
    ),
    ("erdos-apart", graph("erdos-renyi", "nodes = 6, p = 0.0"), G, "must be connected"),
    ("geometric", graph("geometric", "nodes = 6, radius = 0.0"), f"{G}.radius", "above 0; got 0.0"),
    ("edges-missing", graph("edges"), f"{G}.edges", "is missing"),
    ("edges-empty", graph("edges", "edges = []"), f"{G}.edges", "at least one node; got []"),
    ("edges-number", graph("edges", "edges = 5"), f"{G}.edges", "list of pairs"),
    ("edges-triple", graph("edges", "edges = [[0, 1, 2]]"), f"{G}.edges[0]", "got [0, 1, 2]"),
    ("edges-text", graph("edges", 'edges = ["0-3"]'), f"{G}.edges[0]", "node ids; got '0-3'"),
    ("edges-half", graph("edges", "edges = [[0, 3], [0, 1.5]]"), f"{G}.edges[1][1]", "got 1.5"),
    ("edges-true", graph("edges", "edges = [[0, true]]"), f"{G}.edges[0][1]", "got True"),
    ("edges-loop", graph("edges", "edges = [[0, 3], [3, 3]]"), f"{G}.edges[1]", "got [3, 3]"),
    ("edges-outside", graph("edges", "edges = [[0, 3]], nodes = 3"), f"{G}.edges[0]", "0 .. 2"),
    ("edges-minus", graph("edges", "edges = [[0, 3], [0, -1]]"), f"{G}.edges[1][1]", "got -1"),
    ("edges-far", graph("edges", f"edges = [[0, 3], [0, 1{'0' * 20}]]"), f"{G}.edges[1][1]", "got"),
    ("edges-apart", graph("edges", "edges = [[0, 3], [1, 2]]"), G, "must be connected"),
    (
        "edges-directed",
        graph("edges", "edges = [[0, 3]], directed = true"),
        f"{G}.directed",
        "must be false for the hybrid filter",
    ),
    (
        "edges-directed-text",
        graph("edges", 'edges = [[0, 3]], directed = "no"'),
        f"{G}.directed",
        "true or false; got 'no'",
    ),
    ("csv-path-missing", graph("csv"), f"{G}.path", "is missing"),
    ("csv-path-number", graph("csv", "path = 5"), f"{G}.path", "path of a file; got 5"),
    ("csv-path-empty", listed(""), f"{G}.path", "got ''"),
    ("csv-absent", listed("absent.csv"), f"{G}.path", "got 'absent.csv'"),
    ("csv-folder", listed("folder"), f"{G}.path", "got 'folder'"),
    ("csv-outside", listed("../outside.csv"), f"{G}.path", "got '../outside.csv'"),
    ("csv-absolute", listed("/etc/passwd"), f"{G}.path", "must stay inside the folder"),
    ("csv-around", listed("folder/../../outside.csv"), f"{G}.path", "must stay inside the folder"),
    ("csv-back", listed("../scenarios/ring.csv"), f"{G}.path", "must stay inside the folder"),
    ("csv-link", listed("link.csv"), f"{G}.path", "must stay inside the folder"),
    ("csv-circle", listed("circle.csv"), f"{G}.path", "got 'circle.csv'"),
    ("csv-nul-path", listed(r"a\u0000b"), f"{G}.path", r"got 'a\x00b'"),
    ("csv-long-path", listed("a" * 300), f"{G}.path", "got 'aaa"),
    ("csv-empty", listed("empty.csv"), f"{G}.path", "empty.csv must have the columns"),
    ("csv-header", listed("header.csv"), f"{G}.path", "no link of the table is left"),
    ("csv-columns", listed("renamed.csv"), f"{G}.path", "got ['from', 'to']"),
    ("csv-row", listed("row.csv"), f"{G}.path", "row.csv line 3 must have 2 entries; got ['2']"),
    ("csv-word", listed("word.csv"), "sensors[0].nodes[1]", "node ids here are 0, 1, zero"),
    ("csv-hole", listed("hole.csv"), f"{G}.path", "hole.csv line 2: delivery_probability must"),
    ("csv-nan", listed("nan.csv"), f"{G}.path", "finite number; got 'nan'"),
    (
        "csv-half",
        listed("half.csv"),
        f"{G}.path",
        "from 0 to 2^53; got 1.5",
    ),
    ("csv-loop", listed("loop.csv"), f"{G}.path", "join two nodes with a probability; got [2, 2"),
    ("csv-sure", listed("sure.csv"), f"{G}.path", "with a probability; got [0, 1, 1.5]"),
    ("csv-twice", listed("twice.csv"), f"{G}.path", "twice.csv"),
    ("csv-latin", listed("latin.csv"), f"{G}.path", "latin.csv"),
    ("csv-nul", listed("nul.csv"), f"{G}.path", "nul.csv"),
    ("csv-wide", listed("wide.csv"), f"{G}.path", "wide.csv"),
    ("csv-minus", listed("minus.csv"), f"{G}.path", "minus.csv"),
    ("csv-far", listed("far.csv"), f"{G}.path", "far.csv"),
    ("csv-itself", listed("mistake.toml"), f"{G}.path", "must have the columns"),
    ("csv-directed", listed("measured.csv", "directed = true"), f"{G}.directed", "must be false"),
    ("csv-text", listed("measured.csv", 'minimum = "a"'), f"{G}.minimum", "at most 1; got 'a'"),
    ("csv-high", listed("measured.csv", "minimum = 1.5"), f"{G}.minimum", "at most 1; got 1.5"),
    ("csv-none", listed("measured.csv", "minimum = 0.95"), f"{G}.minimum", "no link of the table"),
    ("csv-unmeasured", listed("ring.csv", "minimum = 0.5"), f"{G}.minimum", "table; got 0.5"),
    (
        "csv-left-out",
        listed("island.csv", "minimum = 0.5") | {"sensors.nodes": "[7]"},
        "sensors[0].nodes[0]",
        "node of the graph; got 7",
    ),
    (
        "places-few",
        listed("ring.csv", 'positions = "places.csv"'),
        f"{G}.positions",
        "places.csv must place every node; got [2, 3, 4, 5]",
    ),
    ("places-absent", listed("ring.csv", 'positions = "no.csv"'), f"{G}.positions", "got 'no.csv'"),
    ("places-no-y", listed("ring.csv", 'positions = "no_y.csv"'), f"{G}.positions", "node, x, y"),
    (
        "places-latin",
        listed("ring.csv", 'positions = "latin_places.csv"'),
        f"{G}.positions",
        "latin_places.csv",
    ),
]

C = "network.activation"
UNIFORM = 'distribution = "uniform"'
GAMMA, WEIBULL = 'distribution = "gamma"', 'distribution = "weibull"'
CONSTANT = 'distribution = "constant"'
CLOCKS = [
    ("clock-missing", {C: None}, C, "is missing"),
    ("clock-text", {C: '"poisson"'}, C, "must be a table; got 'poisson'"),
    ("clock-kind-missing", {f"{C}.kind": None}, f"{C}.kind", "is missing"),
    ("clock-kind", {f"{C}.kind": '"Poisson"'}, f"{C}.kind", "got 'Poisson'"),
    ("clock-kind-list", {f"{C}.kind": '["poisson"]'}, f"{C}.kind", "got ['poisson']"),
    ("clock-unknown", {f"{C}.lambda": "2.0"}, f"{C}.lambda", "is not a key here; got 2.0"),
    ("rate-missing", {f"{C}.rate": None}, f"{C}.rate", "is missing"),
    ("rate-negative", {f"{C}.rate": "-2.0"}, f"{C}.rate", "1e+09; got -2.0"),
    ("rate-zero", {f"{C}.rate": "0"}, f"{C}.rate", "1e+09; got 0"),
    ("rate-nan", {f"{C}.rate": "nan"}, f"{C}.rate", "1e+09; got nan"),
    ("rate-text", {f"{C}.rate": '"2"'}, f"{C}.rate", "1e+09; got '2'"),
    ("rate-true", {f"{C}.rate": "true"}, f"{C}.rate", "1e+09; got True"),
    ("rate-list", {f"{C}.rate": "[2.0]"}, f"{C}.rate", "1e+09; got [2.0]"),
    ("rate-huge", {f"{C}.rate": "1e300"}, f"{C}.rate", "got 1e+300"),
    ("rates-number", {f"{C}.rates": "5"}, f"{C}.rates", "triples [i, j, rate]; got 5"),
    ("rates-pair", {f"{C}.rates": "[[0, 1]]"}, f"{C}.rates[0]", "[i, j, rate]; got [0, 1]"),
    ("rates-flat", {f"{C}.rates": "[0, 1, 2.0]"}, f"{C}.rates[0]", "[i, j, rate]; got 0"),
    ("rates-zero", {f"{C}.rates": "[[0, 1, 0.0]]"}, f"{C}.rates[0][2]", "1e+09; got 0.0"),
    ("rates-link", {f"{C}.rates": "[[0, 1, 1.0], [0, 2, 1.0]]"}, f"{C}.rates[1]", "got [0, 2"),
    ("rates-twice", {f"{C}.rates": "[[0, 1, 1.0], [1, 0, 2.0]]"}, f"{C}.rates[1]", "got [1, 0"),
    ("rates-bare", clock("poisson", "rates = [[0, 1, 1.0]]"), f"{C}.rate", "is missing"),
    ("gaps-missing", clock("renewal", "mean = 1.0"), f"{C}.distribution", "is missing"),
    (
        "gaps-unknown",
        clock("renewal", 'distribution = "normal", mean = 1.0'),
        f"{C}.distribution",
        'must be one of "gamma", "weibull", "uniform", "constant"; got \'normal\'',
    ),
    ("gaps-shape", clock("renewal", f"{GAMMA}, mean = 1.0"), f"{C}.shape", "is missing"),
    (
        "gaps-both",
        clock("renewal", f"{GAMMA}, shape = 2.0, mean = 1.0, rate = 1.0"),
        f"{C}.mean",
        "must be given; got ['mean', 'rate']",
    ),
    ("gaps-neither", clock("renewal", CONSTANT), f"{C}.mean", "must be given"),
    (
        "gaps-strange",
        clock("renewal", f"{CONSTANT}, mean = 1.0, shape = 2.0"),
        f"{C}.shape",
        "means nothing for constant gaps; got 2.0",
    ),
    ("gaps-low", clock("renewal", f"{UNIFORM}, high = 1.0"), f"{C}.low", "is missing"),
    (
        "gaps-order",
        clock("renewal", f"{UNIFORM}, low = 2.0, high = 1.0"),
        f"{C}.high",
        "at least low; got 1.0",
    ),
    ("gaps-tiny", clock("renewal", f"{CONSTANT}, mean = 1e-13"), f"{C}.mean", "got 1e-13"),
    (
        "weibull-wild",
        clock("renewal", f"{WEIBULL}, mean = 1.0, shape = 0.001"),
        f"{C}.shape",
        "got 0.001",
    ),
    ("period-missing", clock("periodic"), f"{C}.period", "is missing"),
    ("period-negative", clock("periodic", "period = -1.0"), f"{C}.period", "1e-09; got -1.0"),
    ("period-tiny", clock("periodic", "period = 1e-13"), f"{C}.period", "got 1e-13"),
    ("phase-late", clock("periodic", "period = 1.0, phase = 1.0"), f"{C}.phase", "got 1.0"),
    ("phase-text", clock("periodic", 'period = 1.0, phase = "any"'), f"{C}.phase", "got 'any'"),
    ("jitter-long", clock("periodic", "period = 1.0, jitter = 1.5"), f"{C}.jitter", "got 1.5"),
    ("ticks-missing", clock("recorded"), f"{C}.path", "is missing"),
    ("ticks-absent", clock("recorded", 'path = "no.csv"'), f"{C}.path", "got 'no.csv'"),
    ("ticks-outside", clock("recorded", 'path = "../outside.csv"'), f"{C}.path", "stay inside"),
    ("ticks-link", clock("recorded", 'path = "far_clock.csv"'), f"{C}.path", "got [0, 2]"),
    ("ticks-zero", clock("recorded", 'path = "zero.csv"'), f"{C}.path", "above 0, nothing is sent"),
    ("ticks-early", clock("recorded", 'path = "before.csv"'), f"{C}.path", "got -0.5"),
    ("ticks-inf", clock("recorded", 'path = "never.csv"'), f"{C}.path", "never.csv line 2: t must"),
    ("ticks-columns", clock("recorded", 'path = "no_time.csv"'), f"{C}.path", "columns t, node"),
    ("ticks-node", clock("recorded", 'path = "half_node.csv"'), f"{C}.path", "2^53; got 0.5"),
    ("ticks-latin", clock("recorded", 'path = "latin_clock.csv"'), f"{C}.path", "latin_clock.csv"),
]

N = "network.channel"
L = f"{N}.loss"
D = f"{N}.delay"
CHANNELS = [
    ("channel-text", {N: '"perfect"'}, N, "must be a table; got 'perfect'"),
    ("channel-unknown", {f"{N}.los": "{}"}, f"{N}.los", "is not a key here; got {}"),
    ("channel-kind", {f"{N}.kind": '"none"'}, f"{N}.kind", "is not a key here; got 'none'"),
    ("symmetric-text", {f"{N}.symmetric": '"a"'}, f"{N}.symmetric", "true or false; got 'a'"),
    ("symmetric-1", {f"{N}.symmetric": "1"}, f"{N}.symmetric", "true or false; got 1"),
    ("loss-number", {L: "0.3"}, L, "must be a table; got 0.3"),
    ("loss-kind-missing", {f"{L}.kind": None}, f"{L}.kind", "is missing"),
    ("loss-kind", {f"{L}.kind": '"drop"'}, f"{L}.kind", "got 'drop'"),
    ("loss-unknown", {f"{L}.kind": '"none"'}, f"{L}.delivery", "is not a key here; got 0.7"),
    ("delivery-missing", {f"{L}.delivery": None}, f"{L}.delivery", "is missing"),
    ("delivery-high", {f"{L}.delivery": "1.2"}, f"{L}.delivery", "at most 1; got 1.2"),
    ("delivery-negative", {f"{L}.delivery": "-0.1"}, f"{L}.delivery", "at most 1; got -0.1"),
    ("delivery-nan", {f"{L}.delivery": "nan"}, f"{L}.delivery", "at most 1; got nan"),
    ("delivery-text", {f"{L}.delivery": '"0.7"'}, f"{L}.delivery", "at most 1; got '0.7'"),
    ("delivery-true", {f"{L}.delivery": "true"}, f"{L}.delivery", "at most 1; got True"),
    ("per-link", loss("per-link"), f"{L}.kind", "delivery probabilities; got 'per-link'"),
    ("gilbert-half", loss("gilbert-elliott", "to_bad = 0.1"), f"{L}.to_good", "is missing"),
    ("gilbert-none", loss("gilbert-elliott"), f"{L}.to_bad", "is missing"),
    (
        "gilbert-stuck",
        loss("gilbert-elliott", "to_bad = 0.1, to_good = 0"),
        f"{L}.to_good",
        "above 0 and at most 1; got 0",
    ),
    (
        "gilbert-both",
        loss("gilbert-elliott", "to_bad = 0.1, mean_loss = 0.2, mean_burst = 2.0"),
        f"{L}.to_bad",
        "cannot stand beside mean_loss and mean_burst; got 0.1",
    ),
    ("gilbert-burst", loss("gilbert-elliott", "mean_loss = 0.2"), f"{L}.mean_burst", "is missing"),
    (
        "gilbert-short",
        loss("gilbert-elliott", "mean_loss = 0.9, mean_burst = 1.0"),
        f"{L}.mean_burst",
        "too short for that mean_loss; got 1.0; lengthen the bursts to at least 9,",
    ),
    (
        "gilbert-all",
        loss("gilbert-elliott", "mean_loss = 1.0, mean_burst = 2.0"),
        f"{L}.mean_loss",
        "below 1; got 1.0",
    ),
    ("lost-missing", loss("recorded"), f"{L}.path", "is missing"),
    ("lost-absent", loss("recorded", 'path = "no.csv"'), f"{L}.path", "got 'no.csv'"),
    ("lost-outside", loss("recorded", 'path = "../outside.csv"'), f"{L}.path", "stay inside"),
    ("lost-flag", loss("recorded", 'path = "flag.csv"'), f"{L}.path", "got [0, 1, 1, 2]"),
    ("lost-minus", loss("recorded", 'path = "minus_message.csv"'), f"{L}.path", "got -1.0"),
    ("lost-half", loss("recorded", 'path = "half_message.csv"'), f"{L}.path", "got 0.5"),
    (
        "lost-columns",
        loss("recorded", 'path = "no_flag.csv"'),
        f"{L}.path",
        "must have the columns",
    ),
    ("lost-link", loss("recorded", 'path = "far_loss.csv"'), f"{L}.path", "got [0, 2]"),
    ("lost-disputed", loss("recorded", 'path = "disputed.csv"'), f"{L}.path", "disputed.csv"),
    ("delay-text", {D: '"none"'}, D, "must be a table; got 'none'"),
    ("delay-kind", delay("gamma"), f"{D}.kind", "got 'gamma'"),
    ("delay-missing", delay("constant"), f"{D}.seconds", "is missing"),
    ("delay-negative", delay("constant", "seconds = -0.1"), f"{D}.seconds", "at least 0; got -0.1"),
    ("delay-inf", delay("constant", "seconds = inf"), f"{D}.seconds", "at least 0; got inf"),
    ("delay-mean", delay("exponential", "mean = 0.0"), f"{D}.mean", "above 0; got 0.0"),
    ("delay-order", delay("uniform", "low = 0.2, high = 0.1"), f"{D}.high", "at least low; got"),
    ("delay-sigma", delay("lognormal", "mean = 0.1, sigma = -1"), f"{D}.sigma", "got -1"),
    ("delay-unknown", delay("exponential", "mean = 0.1, rate = 10"), f"{D}.rate", "not a key here"),
]

ROW, ID = "[0.0, 0.0]", "[[1.0, 0.0], [0.0, 1.0]]"
FILTERS = [
    ("filter-missing", {"filter": None}, "filter", "is missing"),
    ("filter-text", {"filter": '"hybrid"'}, "filter", "must be a table; got 'hybrid'"),
    ("filter-kind-missing", {"filter.kind": None}, "filter.kind", "is missing"),
    ("filter-kind", {"filter.kind": '"kalman"'}, "filter.kind", "got 'kalman'"),
    ("filter-unknown", {"filter.gamma": "3"}, "filter.gamma", "is not a key here; got 3"),
    ("filter-local", {"filter.kind": '"local"'}, "filter.epsilon", "is not a key here; got 0.3"),
    ("epsilon-missing", {"filter.epsilon": None}, "filter.epsilon", "is missing"),
    ("epsilon-zero", {"filter.epsilon": "0.0"}, "filter.epsilon", "above 0 and at most 1; got 0.0"),
    ("epsilon-1.5", {"filter.epsilon": "1.5"}, "filter.epsilon", "above 0 and at most 1; got 1.5"),
    ("epsilon-degree", {"filter.epsilon": "0.6"}, "filter.epsilon", "has 2 links; got 0.6"),
    ("epsilon-text", {"filter.epsilon": '"a"'}, "filter.epsilon", "at most 1; got 'a'"),
    ("start-short", {"filter.mean": "[0.0]"}, "filter.mean", "must be 2, not 1, because"),
    ("start-nan", {"filter.mean": "[0.0, nan]"}, "filter.mean", "finite numbers; got [0.0, nan]"),
    ("start-mixed", {"filter.mean": '[0.0, "a"]'}, "filter.mean", "got [0.0, 'a']"),
    ("start-number", {"filter.mean": "0.0"}, "filter.mean", "got 0.0"),
    (
        "start-list",
        {"filter.mean": f"[{ROW}, {ROW}]"},
        "filter.mean",
        "of 6 nodes; got '2 entries'",
    ),
    (
        "start-entry",
        {"filter.mean": f"[{f'{ROW}, ' * 5}[0.0]]"},
        "filter.mean[5]",
        "must be 2, not 1, because",
    ),
    (
        "start-entry-nan",
        {"filter.mean": f"[{f'{ROW}, ' * 5}[0.0, nan]]"},
        "filter.mean[5]",
        "finite numbers; got [0.0, nan]",
    ),
    (
        "spread-indefinite",
        {"filter.cov": "[[1.0, 0.0], [0.0, -1.0]]"},
        "filter.cov",
        "semidefinite (least eigenvalue -1); got [[1.0, 0.0], [0.0, -1.0]]",
    ),
    (
        "spread-asymmetric",
        {"filter.cov": "[[1.0, 0.5], [0.0, 1.0]]"},
        "filter.cov",
        "symmetric matrix; got [[1.0, 0.5]",
    ),
    ("spread-nan", {"filter.cov": "[[1.0, nan], [nan, 1.0]]"}, "filter.cov", "finite numbers; got"),
    ("spread-shape", {"filter.cov": "[[1.0]]"}, "filter.cov", "must be 2 x 2, not 1 x 1, because"),
    ("spread-wide", {"filter.cov": "[[1.0, 0.0]]"}, "filter.cov", "square matrix, not 1 x 2"),
    ("spread-flat", {"filter.cov": "[1.0, 1.0]"}, "filter.cov", "got [1.0, 1.0]"),
    ("spread-list", {"filter.cov": f"[{ID}]"}, "filter.cov", "of 6 nodes; got '1 entries'"),
    (
        "spread-entry",
        {"filter.cov": f"[{ID}, [[-1.0, 0.0], [0.0, 1.0]]]"},
        "filter.cov[1]",
        "semidefinite (least eigenvalue -1); got [[-1.0",
    ),
    (
        "central-list",
        {"filter": f'{{ kind = "central", mean = [{", ".join([ROW] * 6)}] }}'},
        "filter.mean",
        "filter that all nodes share; got '6 entries'",
    ),
    ("model-text", {"filter.model": '"same"'}, "filter.model", "must be a table; got 'same'"),
    (
        "model-unknown",
        {"filter.model.Q": "[[1.0]]"},
        "filter.model.Q",
        "this plant is in continuous time (diffusion); got",
    ),
    ("model-A-shape", {"filter.model.A": "[[1.0]]"}, "filter.model.A", "2 x 2, not 1 x 1, because"),
    ("model-A-wide", {"filter.model.A": "[[1.0, 2.0]]"}, "filter.model.A", "matrix, not 1 x 2"),
    ("model-B-shape", {"filter.model.B": "[[1.0]]"}, "filter.model.B", "2 x any, not 1 x 1"),
    ("model-R-zero", {"filter.model.R": "[[0.0]]"}, "filter.model.R", "(least eigenvalue 0); got"),
    (
        "model-R-negative",
        {"filter.model.R": "[[-1.0]]"},
        "filter.model.R",
        "positive definite (least eigenvalue -1); got [[-1.0]]",
    ),
    ("model-R-shape", {"filter.model.R": ID}, "filter.model.R", "1 x 1, not 2 x 2, because"),
    (
        "model-R-list",
        {"filter.model.R": "[[[1.0]], [[1.0]]]"},
        "filter.model.R",
        "one entry for each of 1 [[sensors]]; got '2 entries'",
    ),
    (
        "model-R-entry",
        {"filter.model.R": "[[[-1.0]]]"},
        "filter.model.R[0]",
        "positive definite (least eigenvalue -1); got [[-1.0]]",
    ),
]


def custom(kind):
    return {"filter": f'{{ kind = "{kind}" }}'}


CLASSES = [
    ("import-module", custom("no_such_module:Filter"), "filter.kind", "could not be imported"),
    ("import-class", custom("refusal_things:Absent"), "filter.kind", "could not be imported"),
    ("import-no-module", custom(":Filter"), "filter.kind", "could not be imported"),
    ("import-no-class", custom("refusal_things:"), "filter.kind", "could not be imported"),
    ("import-relative", custom(".refusal_things:Plain"), "filter.kind", "could not be imported"),
    ("import-syntax", custom("refusal_syntax:Filter"), "filter.kind", "could not be imported"),
    ("import-name", custom("refusal_name:Filter"), "filter.kind", "could not be imported"),
    ("import-exit", custom("refusal_exit:Filter"), "filter.kind", "could not be imported"),
    ("import-lines", custom("refusal_lines:Filter"), "filter.kind", "could not be imported"),
    ("import-long", custom("a" * 9999 + ":Filter"), "filter.kind", "could not be imported"),
    (
        "class-plain",
        custom("refusal_things:Plain"),
        "filter.kind",
        "subclass of netkf's Filter",
    ),
    ("class-number", custom("refusal_things:number"), "filter.kind", "subclass of netkf's Filter"),
    ("class-family", custom("netkf.network.losses:NoLoss"), "filter.kind", "subclass of netkf's"),
    ("class-graph", graph("refusal_things:Plain"), f"{G}.kind", "subclass of netkf's Graph"),
    ("class-clock", clock("refusal_things:Plain"), f"{C}.kind", "subclass of netkf's LinkClock"),
    ("class-loss", loss("refusal_things:Plain"), f"{L}.kind", "subclass of netkf's Loss"),
    ("class-delay", delay("refusal_things:Plain"), f"{D}.kind", "subclass of netkf's Delay"),
    ("abstract-filter", custom("netkf.algorithms.filter:Filter"), "filter.kind", "filter:Filter'"),
    ("abstract-graph", graph("netkf.network.graphs:Graph"), f"{G}.kind", "graphs:Graph'"),
    ("abstract-clock", clock("netkf.network.clocks:LinkClock"), f"{C}.kind", "clocks:LinkClock'"),
    ("abstract-loss", loss("netkf.network.losses:Loss"), f"{L}.kind", "losses:Loss'"),
    ("abstract-delay", delay("netkf.network.delays:Delay"), f"{D}.kind", "delays:Delay'"),
]

INVALID = "is not valid TOML"
WHOLE = [
    ("empty", "", "format", "is missing"),
    ("syntax-value", "format = 1\nname = \n", None, f"{INVALID}: Invalid value (at line 2, column"),
    ("syntax-bracket", "format = 1\n[plant\n", None, INVALID),
    ("syntax-words", "what is this\n", None, INVALID),
    ("syntax-quote", 'name = "poisson\nformat = 1\n', None, INVALID),
    ("key-twice", "format = 1\nformat = 1\n", None, INVALID),
    ("table-twice", "[plant]\n[plant]\n", None, INVALID),
    ("digits", {"seed": "1" * 5000}, None, INVALID),
    ("deep", {"probe": "[" * 5000 + "]" * 5000}, None, INVALID),
    ("binary", bytes(range(32)), None, INVALID),
    ("latin-1", "format = 1 # é\n".encode("latin-1"), None, "is not UTF-8 text"),
    ("utf-16", "format = 1\n".encode("utf-16"), None, "is not UTF-8 text"),
]

TABLE = [*TOP, *PLANT, *SENSORS, *GRAPHS, *CLOCKS, *CHANNELS, *FILTERS, *CLASSES, *WHOLE]


def rows(table):
    return [pytest.param(*row, id=name) for name, *row in table]


@pytest.fixture(autouse=True)
def in_time():
    """Fails what does not come to an end."""

    def stop(number, frame):
        pytest.fail(f"took more than {LIMIT} s")

    # Of processor time: others may use the machine too.
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, LIMIT)
    yield
    signal.setitimer(signal.ITIMER_PROF, 0)
    signal.signal(signal.SIGPROF, before)


@pytest.fixture
def write(tmp_path):
    """Writes a changed scenario into a folder with all the files that it may name."""
    folder = tmp_path / "scenarios"
    (folder / "folder").mkdir(parents=True)
    (tmp_path / OUTSIDE).write_text(RING)
    (folder / "link.csv").symlink_to(tmp_path / OUTSIDE)
    (folder / "circle.csv").symlink_to("circle.csv")
    for name, content in FILES.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())

    def make(change):
        path = folder / "mistake.toml"
        path.write_bytes(changed(change))
        return path

    return make


@pytest.fixture
def refusal(tmp_path, capsys):
    """Runs a command line that must be refused and returns the line it prints."""

    def line_of(*arguments):
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as stop:  # argparse leaves this way
            status = stop.code
        out, err = capsys.readouterr()
        assert status == 2, f"status {status}, said {out + err}"
        assert out == ""
        assert err.endswith("\n")
        assert len(err.splitlines()) == 1, f"several lines: {err}"
        assert len(err) < LONGEST_LINE + len(str(tmp_path)), "a dump, not a message"
        assert err.startswith("netkf")
        assert not (tmp_path / "out").exists()
        return err.rstrip()

    return line_of


def says_what_to_do(line):
    parts = line.split("; ")
    return len(parts) > 1 and len(parts[-1]) > 3 and not parts[-1].startswith("got ")


def test_the_table_is_of_distinct_mistakes():
    ids = [name for name, *_ in TABLE]
    assert len(ids) == len(set(ids)) >= 70


def test_the_unchanged_scenario_is_no_mistake(write):
    assert netkf.load(write({})).name == "poisson-ring"


@pytest.mark.one_in(10)
@pytest.mark.parametrize(("change", "key", "fragment"), rows(TABLE))
def test_a_mistake_is_refused_in_one_line(change, key, fragment, write, refusal, tmp_path):
    path = write(change)
    line = refusal("run", path, "--trust", "--out", tmp_path / "out", "--no-plot")
    where = f"{path}: " if key is None else f"{path}: {key}"
    assert where in line
    if key is not None and "aaaa" not in key:
        assert f"{where}: " in line
    assert fragment in line
    assert says_what_to_do(line)


SETTINGS = [
    ("no-value", "horizon", "--set", "KEY.PATH=VALUE; got 'horizon'"),
    ("no-key", "=5", "--set", "KEY.PATH=VALUE; got '=5'"),
    ("nothing", "horizon=", "--set", "KEY.PATH=VALUE; got 'horizon='"),
    ("open-list", "probe=[0.5,", "--set", "value of probe is not valid TOML; got '[0.5,'"),
    ("open-table", "plant={", "--set", "value of plant is not valid TOML; got '{'"),
    ("open-quote", 'name="a', "--set", "value of name is not valid TOML; got '\"a'"),
    ("digits", f"seed={'1' * 5000}", "--set", "seed is not valid TOML; got '111"),
    ("deep", f"probe={'[' * 5000}{']' * 5000}", "--set", "probe is not valid TOML; got '[[["),
    ("two-lines", "probe=0.5\nseed=3", "--set", "probe is not valid TOML; got"),
    ("word", "horizon=soon", "horizon", "above 0; got 'soon'"),
    ("nan", "horizon=nan", "horizon", "finite number above 0; got nan"),
    ("format", "format=2", "format", "must be 1; got 2"),
    ("unknown", "sede=2", "sede", "is not a key here; got 2"),
    ("unknown-deep", "network.channel.lost.kind=none", "network.channel.lost", "is not a key here"),
    ("dots", "plant..A=1", "plant..A", "is not a key path"),
    ("dot", ".=1", ".", "is not a key path"),
    ("into-number", "horizon.low=1", "horizon.low", "is not a key path"),
    ("into-list", "plant.A.x=1", "plant.A.x", "has no entry 'x' in a list of 2"),
    ("no-entry", "sensors.5.R=[[1.0]]", "sensors.5.R", "has no entry '5' in a list of 1"),
    ("minus-entry", "sensors.-1.R=1", "sensors.-1.R", "has no entry '-1' in a list of 1"),
    ("odd-digit", "sensors.².R=1", "sensors.².R", "has no entry '²' in a list of 1"),
    ("entry", "sensors[0].R=[[-1.0]]", "sensors[0].R", "(least eigenvalue -1); got [[-1.0]]"),
    ("delivery", f"{L}.delivery=2", f"{L}.delivery", "at most 1; got 2"),
    ("kind", "filter.kind=kalman", "filter.kind", "got 'kalman'"),
    ("huge-id", f"sensors.0.nodes=[{10**400}]", "sensors[0].nodes[0]", "from 0 to 2^53"),
    ("huge-frame", f"network.radio={{frame_bytes={10**400}}}", "network.radio.frame_bytes", "most"),
    (
        "never-linked",
        'network.graph={kind="erdos-renyi",nodes=6,p=1e-300,connected=true}',
        "network.graph.connected",
        "none of 1000 graphs drawn was connected",
    ),
    ("table", "plant=5", "plant", "must be a table; got 5"),
    ("lines", "a\nb=1", r"a\nb", "is not a key here; got 1"),
]


@pytest.mark.parametrize(("setting", "key", "fragment"), rows(SETTINGS))
def test_a_wrong_setting_is_refused_in_one_line(setting, key, fragment, write, refusal, tmp_path):
    path = write({})
    line = refusal("run", path, "--set", setting, "--out", tmp_path / "out", "--no-plot")
    assert f"{path}: {key}: " in line or f"netkf: {key}: " in line
    assert fragment in line
    assert says_what_to_do(line)


@pytest.mark.parametrize(
    ("settings", "note"),
    [
        (["horizon=1.0", "horizon=2.0"], "horizon replaces horizon"),
        (["sensors[0].R=[[1.0]]", "sensors.0.R=[[2.0]]"], "sensors.0.R replaces sensors[0].R"),
        (["filter.epsilon=0.1", 'filter={kind="local"}'], "filter replaces filter.epsilon"),
        (['filter={kind="hybrid"}', "filter.epsilon=0.1"], None),
    ],
)
def test_a_setting_that_replaces_an_earlier_one_is_noted(settings, note, write, capsys):
    path = write({})
    assert main(["theory", str(path), *(w for one in settings for w in ("--set", one))]) == 0
    error = capsys.readouterr().err
    assert (f"note: --set {note}, set before it" in error) if note else ("replaces" not in error)


@pytest.mark.parametrize("command", ["run", "theory"])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("absent.toml", id="absent"),
        pytest.param("absent/absent.toml", id="absent-folder"),
        pytest.param("a" * 300, id="long"),
        pytest.param("folder", id="folder"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(command, name, tmp_path, refusal):
    (tmp_path / "folder").mkdir()
    line = refusal(command, tmp_path / name)
    assert str(tmp_path / name) in line
    assert "cannot be read" in line
    assert says_what_to_do(line)


def test_theory_refuses_the_same_file_with_the_same_line(write, refusal):
    path = write({f"{C}.rate": "-1.0"})
    assert refusal("theory", path, "--json") == refusal("run", path)


USAGE = [
    ("nothing", [], "COMMAND"),
    ("command", ["walk"], "walk"),
    ("option", ["run", "{file}", "--speed", "5"], "--speed"),
    ("no-file", ["run"], "scenario"),
    ("two-files", ["run", "{file}", "more.toml"], "more.toml"),
    ("seed-negative", ["run", "{file}", "--seed", "-1"], "integer of at most 30 digits, got '-1'"),
    ("seed-word", ["run", "{file}", "--seed", "x"], "integer of at most 30 digits, got 'x'"),
    ("seed-float", ["run", "{file}", "--seed", "1.0"], "integer of at most 30 digits, got '1.0'"),
    ("seed-empty", ["run", "{file}", "--seed", ""], "integer of at most 30 digits, got ''"),
    ("seed-long", ["run", "{file}", "--seed", "1" * 5000], "--seed"),
    ("seed-nothing", ["run", "{file}", "--seed"], "--seed"),
    ("engine", ["run", "{file}", "--engine", "foo"], "invalid choice: 'foo'"),
    ("trace", ["run", "{file}", "--trace", "some"], "invalid choice: 'some'"),
    ("near", ["reprot", "x"], 'did you mean "report"?'),
    ("engine-near", ["run", "{file}", "--engine", "compile"], 'did you mean "compiled"?'),
    ("long", ["why", "x", "--node", "9" * 5000], " ... "),
    ("dots", ["theory", "{file}", "--set", f"filter={{a{'.b' * 49_000} = 1}}"], "not valid TOML"),
    ("long-set", ["theory", "{file}", "--set", f"probe={'1' * 100_000}"], "at most 100,000 char"),
    ("why-half", ["why", ".", "--node", "3"], "takes --node and --at together"),
    ("set-nothing", ["run", "{file}", "--set"], "--set"),
    ("theory-out", ["theory", "{file}", "--out", "x"], "--out"),
]


@pytest.mark.parametrize(("arguments", "fragment"), rows(USAGE))
def test_a_wrong_command_line_is_refused_in_one_line(arguments, fragment, write, refusal, tmp_path):
    path = str(write({}))
    given = [path if argument == "{file}" else argument for argument in arguments]
    if arguments[:1] == ["run"]:
        given[1:1] = ["--out", str(tmp_path / "out")]
    line = refusal(*given)
    assert fragment in line
    assert says_what_to_do(line)


@pytest.mark.parametrize(
    "out",
    [
        pytest.param("full", id="not-empty"),
        pytest.param("file", id="file"),
        pytest.param("file/below", id="below-a-file"),
        pytest.param("a" * 300, id="long"),
        pytest.param("a\0b", id="nul"),
    ],
)
def test_a_directory_that_cannot_be_used_is_refused(out, write, refusal, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept.txt").write_text("kept")
    (tmp_path / "file").write_text("kept")
    line = refusal("run", write({}), "--out", tmp_path / out, "--no-plot")
    assert "--out: " in line
    assert says_what_to_do(line)
    assert (tmp_path / "full" / "kept.txt").read_text() == "kept"
    assert (tmp_path / "file").read_text() == "kept"


def test_a_note_does_not_stand_beside_a_refusal(write, refusal, tmp_path):
    path = write(listed("island.csv", "minimum = 0.5") | {"sensors.nodes": "[0]"})
    refusal("run", path, "--scheduler", "tcp://localhost:1", "--out", tmp_path / "out")


# A graph that is connected or not as the seed will have it.
DRAWN = graph("erdos-renyi", "nodes = 4, p = 0.5") | {"sensors.nodes": "[0]"}
DRAWN |= {"filter.epsilon": "0.2"}


def seeds(write):
    """One seed with a connected graph, one without."""
    good, bad = None, None
    for seed in range(100):
        try:
            netkf.load(write(DRAWN | {"seed": str(seed)}))
            good = seed
        except netkf.ScenarioError:
            bad = seed
        if good is not None and bad is not None:
            return good, bad
    raise AssertionError("all graphs alike")


def test_a_seed_that_breaks_the_scenario_is_refused_with_the_file(write, refusal, tmp_path):
    good, bad = seeds(write)
    path = write(DRAWN | {"seed": str(good)})
    line = refusal("run", path, "--seed", bad, "--out", tmp_path / "out")
    assert f"{path}: {G}: must be connected" in line


def test_a_seed_of_the_command_line_mends_the_scenario(write, tmp_path, capsys):
    good, bad = seeds(write)
    path = write(DRAWN | {"seed": str(bad)})
    signal.setitimer(signal.ITIMER_PROF, 120)  # a first run compiles
    out = tmp_path / "out"
    assert main(["run", str(path), "--seed", str(good), "--out", str(out), "--no-plot"]) == 0
    assert capsys.readouterr().err == ""


# Unusual but right: refusing these would be a mistake of netkf's.
RIGHT = [
    ("precise", {"sensors.R": "[[1e-8]]"}),
    ("loud", {"sensors.H": "[[1000.0, 0.0]]"}),
    ("rough", {"plant.B": "[[0.0], [1000.0]]"}),
    ("millimetres", {"plant.A": "[[0.0, 1000.0], [0.0, 0.0]]"}),
    ("one-node", graph("path", "nodes = 1") | {"sensors.nodes": "[0]"}),
    ("no-sensor", {"sensors": None}),
    ("no-noise", {"plant.B": "[[0.0], [0.0]]"}),
    ("cov-singular", {"plant.cov": "[[1.0, 1.0], [1.0, 1.0]]"}),
    ("cov-zero", {"filter.cov": "[[0.0, 0.0], [0.0, 0.0]]"}),
    ("integers", {"plant.A": "[[0, 1], [-1, 0]]", "horizon": "2"}),
    ("kind-by-path", graph("netkf.network.graphs:Cycle", "nodes = 6")),
    ("epsilon-edge", {"filter.epsilon": "0.5"}),
    ("epsilon-third", graph("star", "nodes = 4") | {"filter.epsilon": "0.3333333333333333"}),
    ("table-by-path", listed("folder/../ring.csv")),
]


@pytest.mark.parametrize("change", rows(RIGHT))
def test_what_is_right_is_not_refused(change, write):
    assert netkf.load(write(change)).plant.n == 2


def test_two_folders_may_use_one_name_for_their_modules(tmp_path):
    loaded = {}
    for nodes in (4, 5):
        folder = tmp_path / str(nodes)
        folder.mkdir()
        (folder / "refusal_twin.py").write_text(
            "from netkf.network.graphs import Cycle\n\n\n"
            f"class Ring(Cycle):\n    origin = {nodes}\n"
        )
        path = folder / "twin.toml"
        path.write_bytes(changed(graph("refusal_twin:Ring", f"nodes = {nodes}")))
        loaded[nodes] = netkf.load(path)
    for nodes, scenario in loaded.items():
        assert scenario.network.graph.origin == nodes
        assert scenario.replace({"horizon": 1.0}).network.graph.origin == nodes


def test_load_raises_an_error_with_its_parts(write):
    path = write({f"{L}.delivery": "1.2"})
    with pytest.raises(netkf.ScenarioError) as caught:
        netkf.load(path)
    error = caught.value
    assert error.file == str(path)
    assert error.key == "network.channel.loss.delivery"
    assert error.rule == "must be a finite number at least 0 and at most 1"
    assert error.value == 1.2
    assert error.remedy
    for part in (error.file, error.key, error.rule, "got 1.2", error.remedy):
        assert part in str(error)
    assert isinstance(error, netkf.NetkfError)
    assert isinstance(error, ValueError)


def test_load_names_the_path_of_a_file_as_it_was_written(write):
    with pytest.raises(netkf.ScenarioError) as caught:
        netkf.load(write(listed("absent.csv")))
    assert str(getattr(caught.value.value, "name", caught.value.value)) == "absent.csv"


def test_load_raises_for_an_absent_file(tmp_path):
    with pytest.raises(netkf.ScenarioError, match="cannot be read") as caught:
        netkf.load(tmp_path / "absent.toml")
    assert caught.value.file == str(tmp_path / "absent.toml")
    assert caught.value.remedy


REPLACEMENTS = [
    ("value", {"network.activation.rate": -1.0}, "network.activation.rate", "got -1.0"),
    ("unknown", {"network.activation.pace": 1.0}, "network.activation.pace", "is not a key here"),
    ("unknown-table", {"networks.graph": 1.0}, "networks", "is not a key here"),
    ("no-entry", {"sensors.1.R": [[1.0]]}, "sensors.1.R", "has no entry '1'"),
    ("entry", {"sensors[0].R": [[0.0]]}, "sensors[0].R", "positive definite"),
    ("dots", {"plant..A": 1.0}, "plant..A", "is not a key path"),
    ("empty", {"": 1.0}, "", "is not a key path"),
    ("into-number", {"horizon.x": 1.0}, "horizon.x", "is not a key path"),
    ("together", {"horizon": 0.2}, "probe", "at most the horizon 0.2"),
    ("shape", {"plant.A": [[1.0]]}, "plant.B", "must be 1 x any, not 2 x 1"),
    ("format", {"format": 2}, "format", "must be 1; got 2"),
    ("nothing", {"filter.epsilon": None}, "filter.epsilon", "finite number"),
]


@pytest.mark.parametrize(("changes", "key", "fragment"), rows(REPLACEMENTS))
def test_replace_raises_with_the_key(ring, changes, key, fragment):
    with pytest.raises(netkf.ScenarioError) as caught:
        ring.replace(changes)
    assert caught.value.key == key
    assert fragment in str(caught.value)
    assert caught.value.remedy
    assert len(str(caught.value).splitlines()) == 1


def test_replace_leaves_the_scenario_alone(ring):
    before = ring.replace({})
    with pytest.raises(netkf.ScenarioError):
        ring.replace({"horizon": 1.0, "network.activation.rate": -1.0})
    assert ring == before


HINTS = [
    ("key", "filter.epsillon=0.2", 'did you mean "epsilon"? keys are'),
    ("table", "network.chanel.symmetric=true", 'did you mean "channel"? keys are'),
    ("kind", "network.graph.kind=cyclic", 'did you mean "cycle"? choose one'),
    ("number", "plant.cov=0.5", "must be a matrix; got 0.5; write [[0.5]]"),
    ("vector", "plant.mean=0.5", "must be a vector; got 0.5; write [0.5]"),
    ("nothing", "name=", "give a value; an empty text is written name='\"\"'"),
    (
        "left-over",
        "network.activation.kind=periodic",
        "network.activation.rate: is left over from the former kind of network.activation; "
        "got 2.0; set the whole table, --set 'network.activation={ kind = ",
    ),
]


@pytest.mark.parametrize(("change", "words"), rows(HINTS))
def test_a_refusal_points_to_what_was_meant(change, words, refusal, tmp_path):
    ring = SCENARIOS / "poisson_ring.toml"
    assert words in refusal("run", ring, "--set", change, "--out", tmp_path / "out")


def test_a_kind_that_is_replaced_as_a_whole_leaves_nothing_over(ring):
    with pytest.raises(netkf.ScenarioError, match="left over from the former kind"):
        ring.replace({"network.activation.kind": "periodic"})
    clock = {"kind": "periodic", "period": 0.5}
    assert ring.replace({"network.activation": clock}).network.activation.period == 0.5
    # A key that the change itself gives is a mistake of its own.
    changes = {"network.activation.kind": "periodic", "network.activation.rate": 3.0}
    with pytest.raises(netkf.ScenarioError, match=r"rate: is not a key here; got 3\.0"):
        ring.replace(changes)
