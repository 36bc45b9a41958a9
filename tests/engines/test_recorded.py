"""Recorded truth and readings: a run that is written down and read again is the same run."""

import functools

import numpy as np
import pytest

import netkf
from netkf.plants.linear import SlotReadings
from netkf.rng.streams import Streams
from netkf.runs.run import run_to_directory
from netkf.scenario.reading import from_table

F, Q = [[1.0, 0.2], [-0.2, 1.0]], [[0.3, 0.0], [0.0, 0.3]]
SENSORS = [
    {"nodes": [0, 3], "H": [[1.0, 0.0]], "R": [[0.5]]},
    {"nodes": [2], "H": [[0.0, 1.0], [1.0, 1.0]], "R": [[0.5, 0.1], [0.1, 0.3]]},
]
FILTERS = {
    "gossip": {"kind": "matching", "protocol": "maximal"},
    "intermittent": {"kind": "broadcast"},
    "push-sum": {"kind": "broadcast"},
    "local": {"kind": "broadcast"},
    "central": {"kind": "broadcast"},
}
PERIOD, SLOTS = 0.1, 30


def scenario(folder, kind, plant, sensors=SENSORS, **more):
    filter_ = {"kind": kind, **({"gamma": 2, "delta": 4.5} if kind == "push-sum" else {})}
    table = {
        "format": 1,
        "name": "recorded",
        "horizon": SLOTS * PERIOD,
        "probe": PERIOD,
        "seed": 5,
        "plant": {"F": F, "Q": Q, "period": PERIOD, "cov": np.eye(2).tolist(), **plant},
        "sensors": sensors,
        "network": {
            "graph": {"kind": "path", "nodes": 4},
            "activation": FILTERS[kind],
            "channel": {"loss": {"kind": "bernoulli", "delivery": 0.8}},
        },
        "filter": filter_,
        **more,
    }
    return from_table(table, folder)


def readings(x, seed):
    """(slot, node, y) as the engine makes them, from the same streams."""
    for sensor in SENSORS:
        for node in sensor["nodes"]:
            noise = Streams(seed).generator("noise", node, 0)
            path = SlotReadings(np.array(sensor["H"]), np.array(sensor["R"]), noise)
            for slot, state in enumerate(x):
                yield slot, node, path.reading(slot, state)


@pytest.fixture
def recorded(tmp_path):
    """A folder with truth.csv and readings.csv of a run, and the run's truth."""
    x = netkf.simulate(scenario(tmp_path, "local", {"kind": "linear"})).x
    rows = [f"{k * PERIOD!r},{state[0]!r},{state[1]!r}" for k, state in enumerate(x.tolist())]
    (tmp_path / "truth.csv").write_text("t,x0,x1\n" + "\n".join(rows) + "\n")
    rows = []
    for slot, node, y in readings(x, 5):
        rows.append(",".join([repr(slot * PERIOD), str(node), *map(repr, y.tolist())]))
    short = [row if row.count(",") == 3 else row + "," for row in rows]
    (tmp_path / "readings.csv").write_text("t,node,y0,y1\n" + "\n".join(short) + "\n")
    return tmp_path, x


def from_files():
    return [{**sensor, "kind": "recorded", "path": "readings.csv"} for sensor in SENSORS]


@pytest.mark.parametrize("kind", FILTERS)
def test_what_was_recorded_gives_the_same_estimates(kind, recorded):
    folder, x = recorded
    make = functools.partial(scenario, folder, kind)
    base = netkf.simulate(make({"kind": "linear"}))
    np.testing.assert_array_equal(base.x, x)
    truth = {"kind": "recorded", "path": "truth.csv"}
    for plant, sensors in (
        (truth, SENSORS),
        (truth, from_files()),
        ({"kind": "linear"}, from_files()),
        ({"kind": "unknown"}, from_files()),
    ):
        run = netkf.simulate(make(plant, sensors))
        np.testing.assert_allclose(run.xhat, base.xhat, rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(run.P, base.P, rtol=1e-10, atol=1e-13)
        assert netkf.first_difference(run, base) is None
        if plant["kind"] == "unknown":
            assert np.isnan(run.x).all()
            assert not {"sq_error", "nees"} & set(run.states.columns)
        else:
            np.testing.assert_allclose(run.x, base.x, rtol=1e-9)
            np.testing.assert_allclose(run.states.sq_error, base.states.sq_error, rtol=1e-9)


def test_a_directory_of_a_run_with_records_can_be_run_again(recorded):
    folder, _ = recorded
    made = scenario(folder, "push-sum", {"kind": "recorded", "path": "truth.csv"}, from_files())
    run_to_directory(made, folder / "a")
    run_to_directory(netkf.load(folder / "a" / "scenario.toml"), folder / "b")
    for name in ("scenario.toml", "summary.json", "readings.csv", "truth.csv"):
        assert (folder / "b" / name).read_text() == (folder / "a" / name).read_text()


def test_nodes_default_to_those_of_the_table_and_other_nodes_rows_may_be_there(recorded):
    folder, _ = recorded
    lines = (folder / "readings.csv").read_text().splitlines()
    one = [line.rsplit(",", 1)[0] for line in lines if line.split(",")[1] in ("node", "0", "3")]
    (folder / "one.csv").write_text("\n".join(one) + "\n")
    named = scenario(folder, "local", {"kind": "unknown"}, from_files()[:1])
    entry = {"kind": "recorded", "path": "one.csv", "H": [[1.0, 0.0]], "R": [[0.5]]}
    unnamed = scenario(folder, "local", {"kind": "unknown"}, [entry])
    assert unnamed.sensing_nodes == (0, 3)
    np.testing.assert_array_equal(netkf.simulate(unnamed).xhat, netkf.simulate(named).xhat)


def test_filters_do_not_know_the_law_of_what_was_recorded(recorded):
    folder, _ = recorded
    assert scenario(folder, "local", {"kind": "linear"}).filters_know_the_truth
    for plant, sensors in (
        ({"kind": "recorded", "path": "truth.csv"}, SENSORS),
        ({"kind": "linear"}, from_files()),
    ):
        assert not scenario(folder, "local", plant, sensors).filters_know_the_truth


ENTRY = {**SENSORS[1], "kind": "recorded", "path": "r.csv"}
GOOD = "".join(f"{k * PERIOD:.1f},2,0.5,-0.25\n" for k in range(SLOTS + 1))


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("r.csv", "t,y0,y1\n", "r.csv must have the columns t, node, y0, y1"),
        ("r.csv", "t,node,y0\n" + GOOD, "add the column y1"),
        ("r.csv", "t,node,y0,y1\n" + GOOD.replace("0.7,2", "0.7,9"), "r.csv names a node that"),
        ("r.csv", "t,node,y0,y1\n" + GOOD.replace("0.7,2", "0.7,2.5"), "node must hold integers"),
        (
            "r.csv",
            "t,node,y0,y1\n" + GOOD.replace("0.7,2", "0.7,two"),
            "node must name a node of the graph",
        ),
        ("r.csv", "t,node,y0,y1\n" + GOOD.replace("0.7,2", "0.75,2"), "multiple of the period 0.1"),
        ("r.csv", "t,node,y0,y1\n-0.1,2,0.5,1.0\n" + GOOD, "line 2: t must be at least 0"),
        ("r.csv", "t,node,y0,y1\n" + GOOD.replace("0.7,2", "nan,2"), "t must be a finite number"),
        ("r.csv", "t,node,y0,y1\n" + GOOD + "3.1,2,inf,1.0\n", "y0 must be a finite number"),
        ("r.csv", "t,node,y0,y1\n" + GOOD + "3.1,2,1.0\n", "line 33 must have 4 entries"),
        ("r.csv", "t,node,y0,y1,y2\n3.0,2,1.0,1.0,0.3\n", "line 2: y2 has no row in H; got '0.3'"),
        ("r.csv", b"t,node,y0,y1\n\xe9", "cannot be read as a UTF-8 table"),
        ("t.csv", "t,x0\n0.0,1.0\n", "t.csv must have the columns t, x0, x1"),
        ("t.csv", "t,x0,x1\n0.0,1.0,nan\n", "x1 must be a finite number"),
        ("t.csv", "t,x0,x1\n0.0,1.0,1.0\n", "t.csv has no state for slot 1, t = 0.1"),
        ("t.csv", "t,x0,x1\n0.0,1.0,1.0\n0.0,1.0,2.0\n", "there may be one row a slot"),
        ("t.csv", "t,x0,x1\n0.05,1.0,1.0\n", "t must be a slot"),
    ],
)
def test_tables_with_mistakes_are_refused(name, text, words, tmp_path):
    content = text.encode() if isinstance(text, str) else text
    (tmp_path / name).write_bytes(content)
    plant, sensors = {"kind": "recorded", "path": "t.csv"}, SENSORS
    if name == "r.csv":
        plant, sensors = {"kind": "unknown"}, [ENTRY]
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario(tmp_path, "push-sum", plant, sensors)
    line = str(caught.value)
    assert words in line
    assert line.startswith("sensors[0].path: " if name == "r.csv" else "plant.path: ")
    assert "\n" not in line


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensors.0.kind": "recorded"}, "sensors[0].path: is missing"),
        ({"sensors.0.kind": "heard"}, 'must be one of "linear"'),
        ({"sensors.0.path": "r.csv"}, "sensors[0].path: is not a key here"),
        ({"plant.kind": "unknown"}, "sensors[0].kind: must be recorded where the plant's state"),
        ({"plant.kind": "recorded"}, "plant.path: is missing"),
        ({"plant": {"kind": "unknown", "A": [[1.0]]}}, "plant.B: is missing"),
        ({"plant": {"kind": "unknown", "F": F, "Q": Q}}, "plant.period: is missing"),
        ({"filter": {"kind": "hybrid", "epsilon": 0.3}}, "belongs to plants in continuous"),
    ],
)
def test_parts_that_do_not_go_together_are_refused(changes, words, tmp_path):
    base = scenario(tmp_path, "gossip", {"kind": "linear"})
    with pytest.raises(netkf.ScenarioError) as caught:
        base.replace(changes)
    assert words in str(caught.value)


def test_recorded_exchanges_that_no_slot_has_are_noted(tmp_path):
    (tmp_path / "pairs.csv").write_text("slot,node,peer\n0,0,1\n1,0,1\n2,1,2\n900,0,1\n")
    network = {
        "graph": {"kind": "path", "nodes": 4},
        "activation": {"kind": "recorded", "path": "pairs.csv"},
    }
    (note,) = scenario(tmp_path, "gossip", {"kind": "linear"}, network=network).notes
    assert note.startswith("pairs.csv: rows of slot 0, 900 are not used; ")
    assert note.endswith("slots 1 to 29")
    words = r"must be a broadcast .* got 'recorded \(slot,node,peer: a matching\)'"
    with pytest.raises(netkf.ScenarioError, match=words):
        scenario(tmp_path, "push-sum", {"kind": "linear"}, network=network)
