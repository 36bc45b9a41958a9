"""Inputs and true states of blocks from tables whose column ``node`` says whose row it is."""

import math

import numpy as np
import pytest

import netkf
from netkf.core.errors import ScenarioError
from netkf.figures.layout import get_positions
from netkf.scenario.reading import from_table
from netkf.scenario.usage import record_usage

START = {1: [0.0, 0.0, 3.0], 2: [3.0, 4.0, -1.0]}
ODOMETRY = """t,node,u0,u1
0,1,1.0,0.4
0,2,0.5,-0.2
1,2,0.8,0.3
2,1,0.6,-0.1
2,3,9.0,9.0
"""
# Headings as a tracker gives them, in (-pi, pi]; that of robot 1 passes pi.
TRUTH = """t,node,x0,x1,x2
0,1,0.0,0.0,3.0
0,2,3.0,4.0,-1.0
2,2,3.5,3.0,-1.5
1,1,-1.0,0.2,-3.1
2,1,-2.0,0.1,-2.9
"""


def team(folder, time=None, **plant):
    """Two unicycles, of which the first sees a landmark and the second."""
    time = time or {"period": 0.5, "Q": np.diag([1e-3, 1e-3, 4e-4]).tolist()}
    block = {
        "name": "pose",
        "f": "unicycle",
        "cov": np.diag([0.1, 0.1, 0.02]).tolist(),
        **time,
        **plant,
    }
    sampling = {} if "period" in time else {"sampling": {"kind": "periodic", "period": 0.5}}
    sensor = {"of": "pose", "heading": 2, "R": [[0.01, 0.0], [0.0, 0.01]], **sampling}
    clocked = {"kind": "periodic", "period": 1.0, "at": "nodes"}
    (folder / "odometry.csv").write_text(ODOMETRY)
    (folder / "truth.csv").write_text(TRUTH)
    return {
        "format": 1,
        "name": "team",
        "horizon": 2.0,
        "probe": 0.5,
        "plants": [{**block, "nodes": [k], "mean": START[k]} for k in START],
        "sensors": [
            {"kind": "range-bearing", "nodes": [1], "positions": [[2.0, 2.0]], **sensor},
            {"kind": "relative-range-bearing", "to": [[1, 2]], **sensor},
        ],
        "network": {
            "graph": {"kind": "edges", "edges": [[1, 2]]},
            "activation": clocked if sampling else {"kind": "broadcast"},
        },
        "filter": {"kind": "central"},
    }


RECORDED = {"kind": "recorded", "path": "odometry.csv"}
FLOW = {"B": np.diag([0.1, 0.1, 0.05]).tolist(), "step": 0.1}


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("time", [None, FLOW])
def test_each_block_is_driven_by_the_rows_of_its_node(tmp_path, time, engine):
    scenario = from_table(team(tmp_path, time, input=RECORDED), tmp_path)
    one = netkf.simulate(scenario, engine=engine)
    apart = team(tmp_path, time)
    for node, block in enumerate(apart["plants"], 1):
        rows = [line.split(",") for line in ODOMETRY.splitlines()[1:]]
        lines = ["t,u0,u1", *(f"{t},{u},{w}" for t, i, u, w in rows if i == str(node))]
        (tmp_path / f"{node}.csv").write_text("\n".join(lines) + "\n")
        block["input"] = {"kind": "recorded", "path": f"{node}.csv"}
    other = netkf.simulate(from_table(apart, tmp_path), engine=engine)
    np.testing.assert_array_equal(one.xhat, other.xhat)
    np.testing.assert_array_equal(one.x, other.x)
    # Of an entry the rows of its own nodes are counted: 2 hold before the horizon.
    assert scenario.plant.input.inputs[1].at(1.5).tolist() == [0.8, 0.3]


def test_a_plant_of_several_nodes_takes_rows_by_node_and_own_estimates_follow(tmp_path):
    table = team(tmp_path, FLOW, input=RECORDED)
    table["filter"] = {"kind": "local", "estimates": "own"}
    table["sensors"] = [table["sensors"][0] | {"nodes": [1, 2], "positions": [[2, 2], [2, 2]]}]
    apart = netkf.simulate(from_table(table, tmp_path), engine="simpy")
    table["plants"] = [table["plants"][0] | {"nodes": [1, 2], "mean": [1.0, 2.0, 0.5]}]
    run = netkf.simulate(from_table(table, tmp_path), engine="simpy")
    moved = run.block("pose", 2).xhat[1] - run.block("pose", 2).xhat[0]
    other = run.block("pose", 1).xhat[1] - run.block("pose", 1).xhat[0]
    assert abs(moved - other).max() > 0.05
    # A view steps where its own input jumps: without readings its mean is the arc.
    alone = {**table, "sensors": [table["sensors"][0] | {"nodes": [1], "positions": [[9, 9]]}]}
    xhat = netkf.simulate(from_table(alone, tmp_path), engine="simpy").block("pose", 2).xhat
    h, x = 0.5, np.array([1.0, 2.0])
    for v, w in ((0.5, -0.2), (0.8, 0.3)):
        turn = [math.sin(h + w) - math.sin(h), math.cos(h) - math.cos(h + w)]
        x, h = x + v / w * np.array(turn), h + w
    np.testing.assert_allclose(xhat[-1], [*x, h], atol=1e-6)
    assert apart.xhat.shape == (5, 2, 3)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("time", [None, FLOW])
def test_recorded_states_of_blocks_count_whole_turns(tmp_path, time, engine):
    truth = {"kind": "recorded", "path": "truth.csv", "interpolate": "linear"}
    scenario = from_table(team(tmp_path, time, input=RECORDED, **truth), tmp_path)
    run = netkf.simulate(scenario, engine=engine)
    first = [
        [0.0, 0.0, 3.0],
        [-0.5, 0.1, (3.0 + 2.0 * math.pi - 3.1) / 2.0],
        [-1.0, 0.2, 2.0 * math.pi - 3.1],
        [-1.5, 0.15, 2.0 * math.pi - 3.0],
        [-2.0, 0.1, 2.0 * math.pi - 2.9],
    ]
    second = np.linspace([3.0, 4.0, -1.0], [3.5, 3.0, -1.5], 5)
    np.testing.assert_allclose(run.x, np.hstack([first, second]), rtol=0, atol=1e-12)
    # The readings are of the recorded states, and the filter keeps close to them.
    assert abs(run.x[-1] - run.xhat[-1, 0])[:3].max() < 0.5
    assert scenario.notes == ()
    uses = record_usage(scenario, sent=None)
    # The row of a node without a block counts once, where the table is named first.
    assert {key: use["unused"] for key, use in uses.items()} == {
        "plants[0]": 0, "plants[1]": 0, "plants[0].input": 2, "plants[1].input": 0,
    }  # fmt: skip
    assert uses["plants[0].input"]["rows"] + uses["plants[1].input"]["rows"] == 5


def test_recorded_linear_blocks_are_one_recorded_plant(tmp_path):
    (tmp_path / "walk.csv").write_text("t,node,x0\n0,1,1\n0,2,5\n1,1,2\n1,2,6\n2,1,3\n2,2,8\n")
    walk = {"kind": "recorded", "path": "walk.csv", "name": "walk", "nodes": [1, 2]}
    for keys in ({"F": [[1.0]], "Q": [[1.0]], "period": 1.0}, {"A": [[0.0]], "B": [[1.0]]}):
        sampling = {} if "F" in keys else {"sampling": {"kind": "periodic", "period": 1.0}}
        table = {
            **team(tmp_path),
            "plants": [{**walk, **keys, "cov": [[1.0]]}],
            "sensors": [{"of": "walk", "nodes": [1], "H": [[1.0]], "R": [[0.1]], **sampling}],
            "probe": 1.0,
        }
        if sampling:
            table["network"] = team(tmp_path, FLOW)["network"]
        for engine in ("simpy", "compiled"):
            run = netkf.simulate(from_table(table, tmp_path), engine=engine)
            assert run.x.tolist() == [[1.0, 5.0], [2.0, 6.0], [3.0, 8.0]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"plants.1.nodes": [4]}, r"plants\[1\].input.path: odometry.csv has no row of node 4"),
        ({"plants.1.path": "truth.csv"}, r"plants\[1\].path: truth.csv has no state for the probe"),
        ({"plants.1.unknown": True}, r"sensors\[1\].kind: must be recorded where the plant's"),
        ({"plants.1.unknown": True, "plants.1.path": "truth.csv"}, r"plants\[1\].path: means not"),
        ({"plants.1.interpolate": "hold"}, r"plants\[1\].interpolate: means nothing without path"),
        (
            {"plants": [{"name": "team", "A": [[0.0]], "B": [[1.0]], "input": RECORDED}]},
            r"plants\[0\].input.path: odometry.csv has a column node",
        ),
    ],
)
def test_tables_by_node_are_refused_where_they_do_not_fit(tmp_path, change, message):
    table = team(tmp_path, FLOW, input=RECORDED)
    table["network"]["graph"]["edges"] = [[1, 2], [2, 4]]
    scenario = from_table(table, tmp_path)
    with pytest.raises(ScenarioError, match=message):
        scenario.replace(change)


@pytest.mark.parametrize(
    ("kind", "rows", "message"),
    [
        (
            "relative-range",
            "1,1,2,5\n2,1,7,5\n",
            r"sensors\[0\].path: seen.csv line 3: must be nod",
        ),
        (
            "relative-range",
            "1,1,2,5\n2,1,1,5\n",
            r"path: seen.csv line 3: must be two nodes; got 1",
        ),
        ("range", "1,1,9,5\n2,7,9,5\n", r"of: must be a block that node 7 of seen.csv line 3 has"),
        ("range", "1,1,9,5\n", r"must be 1 rows of 2.*; got '2 x 2'; add or remove some$"),
    ],
)
def test_a_row_of_a_node_without_a_block_is_refused_with_its_line(tmp_path, kind, rows, message):
    table = team(tmp_path, FLOW, input=RECORDED)
    (tmp_path / "seen.csv").write_text(f"t,node,to,y0\n{rows}")
    places = {"positions": [[0.0, 1.0]] * 2} if kind == "range" else {}
    table["sensors"] = [{"kind": kind, "of": "pose", "path": "seen.csv", "R": [[1.0]], **places}]
    with pytest.raises(ScenarioError, match=message):
        from_table(table, tmp_path)
    (tmp_path / "seen.csv").write_text("t,node,seen,y0\n1,1,4,5\n")
    if kind == "range":
        with pytest.raises(ScenarioError, match="name what was seen in a column to of seen"):
            from_table(table, tmp_path)


def test_a_plant_of_all_has_no_rows_by_node(tmp_path):
    (tmp_path / "truth.csv").write_text(TRUTH)
    plant = {"kind": "recorded", "f": "unicycle", "path": "truth.csv", **FLOW, "input": RECORDED}
    table = {**team(tmp_path, FLOW), "plant": plant, "sensors": []}
    del table["plants"]
    with pytest.raises(ScenarioError, match=r"plant.input.path: odometry.csv has a column node"):
        from_table(table, tmp_path)
    plant["input"] = {"kind": "constant", "value": [1.0, 0.1]}
    with pytest.raises(ScenarioError, match=r"plant.path: truth.csv has a column node"):
        from_table(table, tmp_path)


def mixed(folder, slots):
    """Three walks with a known input: the first drawn, the second recorded, of the third only
    readings are known.
    """
    (folder / "walk.csv").write_text(
        "t,node,x0\n" + "".join(f"{t},2,{5 + t * t}\n" for t in range(6))
    )
    (folder / "seen.csv").write_text("t,node,y0\n1,3,2.5\n3,3,1.0\n")
    u = {"kind": "recorded", "path": "u.csv", "G": [[0.5]]}
    (folder / "u.csv").write_text("t,u0\n0,1\n2,-1\n")
    keys = {"F": [[0.9]], "Q": [[1.0]], "period": 1.0} if slots else {"A": [[-0.1]], "B": [[1.0]]}
    block = {"name": "a", "cov": [[2.0]], "input": u, **keys}
    clock = {} if slots else {"sampling": {"kind": "periodic", "period": 0.5}}
    whole = {} if slots else {"sampling": {"kind": "periodic", "period": 1.0}}
    H = {"of": "a", "H": [[1.0]], "R": [[0.1]]}
    ticks = {"kind": "periodic", "period": 1.0, "at": "nodes"}
    return {
        "format": 1,
        "name": "mixed",
        "horizon": 5.0,
        "probe": 1.0,
        "plants": [
            {**block, "nodes": [1]},
            {**block, "nodes": [2], "kind": "recorded", "path": "walk.csv"},
            {**block, "nodes": [3], "kind": "unknown"},
        ],
        "sensors": [
            # Of the recorded one there are states at whole seconds only.
            {**H, "nodes": [1], **clock},
            {**H, "nodes": [2], **whole},
            {**H, "kind": "recorded", "path": "seen.csv"},
            {"kind": "relative", "of": "a", "to": [[1, 2]], "R": [[0.2]], **whole},
        ],
        "network": {
            "graph": {"kind": "edges", "edges": [[1, 2], [2, 3]]},
            "activation": {"kind": "broadcast"} if slots else ticks,
        },
        "filter": {"kind": "block-intersection", "estimates": "own"},
    }


@pytest.mark.parametrize("slots", [True, False])
def test_each_block_is_drawn_recorded_or_unknown_by_itself(tmp_path, slots):
    table = mixed(tmp_path, slots)
    scenario = from_table(table, tmp_path)
    simpy, compiled = (netkf.simulate(scenario, engine=one) for one in ("simpy", "compiled"))
    drawn = mixed(tmp_path, slots)
    drawn["plants"] = [{**p, "kind": "linear" if slots else "diffusion"} for p in drawn["plants"]]
    del drawn["plants"][1]["path"], drawn["sensors"][2]
    first = netkf.simulate(from_table(drawn, tmp_path), engine="simpy").x[:, 0]
    for run in (simpy, compiled):
        # What is drawn does not know of the others.
        np.testing.assert_allclose(run.x[:, 0], first, rtol=0, atol=1e-12)
        assert run.x[:, 1].tolist() == [5.0, 6.0, 9.0, 14.0, 21.0, 30.0]
        assert np.isnan(run.x[:, 2]).all()
        assert np.isnan(run.error[:, 2]).all()
        assert np.isfinite(run.error[:, :2]).all()
        assert abs(run.error[1:, 1]).max() < 1.5 if slots else run.status == "complete"
        np.testing.assert_allclose(run.xhat, simpy.xhat, rtol=0, atol=1e-10)
        np.testing.assert_allclose(run.P, simpy.P, rtol=0, atol=1e-10)
    # A plain Kalman filter of the readings of the third, which nobody else reads.
    F, Q = (0.9, 1.0) if slots else (math.exp(-0.1), 5.0 * (1.0 - math.exp(-0.2)))
    b = 0.5 if slots else 5.0 * (1.0 - F)
    x, P, path = 0.0, 2.0, [0.0]
    for t in range(1, 6):
        x, P = F * x + b * (1.0 if t <= 2 else -1.0), F * P * F + Q
        if (y := {1: 2.5, 3: 1.0}.get(t)) is not None and (slots or t < 5):
            gain = P / (P + 0.1)
            x, P = x + gain * (y - x), (1.0 - gain) * P
        path.append(x)
    np.testing.assert_allclose(simpy.block("a", 3).xhat[:, 0], path, rtol=0, atol=1e-9)
    uses = record_usage(scenario, sent=None)
    assert uses["plants[1]"]["unused"] == 0
    # Several runs, in files too: averages of what is known.
    ensemble = netkf.monte_carlo(scenario, runs=3, workers=1)
    assert np.isnan(ensemble.mean_error[:, 2]).all()
    assert np.isfinite(ensemble.mean_error[:, :2]).all()
    table["plants"][0]["coupling"] = [{"from": [2], "A": [[0.1]]}]
    with pytest.raises(ScenarioError, match="must be drawn as this block is"):
        from_table(table, tmp_path)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("slots", [True, False])
def test_blocks_that_are_drawn_are_judged_and_others_named(tmp_path, slots):
    table = mixed(tmp_path, slots)
    heard = from_table(table, tmp_path)
    del table["sensors"][3]
    table["filter"] = {"kind": "local", "estimates": "own"}
    alone = from_table(table, tmp_path)
    left_out = "not judged: a@2 is recorded, a@3 is unknown, so that errors have no known law"
    for scenario, expected in ((alone, [1.0]), (heard, [math.nan])):
        found = netkf.consistency(scenario, runs=10, workers=1)
        assert found.table["block"].tolist() == ["a@1"]
        np.testing.assert_allclose(found.table["expected"], expected)
        assert "BROKEN" not in found.rows[0].verdict
        assert found.notes == (left_out,)
    # A filter that trusts its readings too much is found.
    narrow = alone.replace({"filter.model": {"R": [[0.005]]}}) if slots else alone
    verdict = netkf.consistency(narrow, runs=10, workers=1).rows[0].verdict
    assert "overconfident" in verdict if slots else verdict == "consistent"
    if slots:
        rows = netkf.check(alone, runs=10, workers=1).table.set_index("promise")
        assert "broken" not in set(rows["verdict"])
        assert (
            rows.loc["P follows the equations along the events of each run", "verdict"] == "holds"
        )
        reason = rows.loc["errors of all blocks have a known law", "evidence"]
        assert reason == "a@2 is recorded, a@3 is unknown"
        with pytest.raises(netkf.TheoryError, match="no law to check"):
            netkf.check(heard, runs=10, workers=1)
    recorded = {"plants": [{**plant, "kind": "unknown"} for plant in table["plants"]]}
    recorded["plants"][1].pop("path")
    recorded["sensors"] = [table["sensors"][2]]
    # A block with a law that no node estimates does not help.
    shared = {
        key: table["plants"][0][key] for key in ({"F", "Q", "period"} if slots else {"A", "B"})
    }
    beside = {**recorded, "plants": [*recorded["plants"], {**shared, "name": "shared"}]}
    for changes in (recorded, beside):
        with pytest.raises(ScenarioError, match="law of the errors is unknown"):
            netkf.consistency(alone.replace(changes), runs=10, workers=1)


SEEN = """t,node,to,y0,R0
2026-03-01T12:00:01Z,1,7,4.0,0.04
2026-03-01T12:00:01Z,1,8,3.0,0.09
2026-03-01T12:00:01.5Z,1,7,,
2026-03-01T12:00:01.5Z,2,8,2.0,0.01
2026-03-01T12:00:02Z,1,8,2.5,0.04
"""
MARKS = {7: np.array([3.0, 2.0]), 8: np.array([1.0, -1.0])}


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_ranges_with_noise_of_their_own_and_an_origin_are_those_of_a_plain_ekf(tmp_path, engine):
    """Two ranges at one instant, one without a value, stamps as times of a day."""
    table = team(tmp_path, input={"kind": "constant", "value": [1.0, 0.4]})
    (tmp_path / "seen.csv").write_text(SEEN)
    places = [MARKS[7].tolist(), MARKS[8].tolist()]
    sensor = {"kind": "range", "of": "pose", "path": "seen.csv", "R": [[1.0]], "positions": places}
    table |= {"sensors": [sensor], "time": {"origin": "2026-03-01T12:00:00Z"}}
    run = netkf.simulate(from_table(table, tmp_path), engine=engine)
    rows = {1: {2: [(7, 4.0, 0.04), (8, 3.0, 0.09)], 4: [(8, 2.5, 0.04)]}, 2: {3: [(8, 2.0, 0.01)]}}
    own = table | {"filter": {"kind": "local", "estimates": "own"}}
    alone = netkf.simulate(from_table(own, tmp_path), engine="simpy")
    for node, first in ((1, 0), (2, 3)):
        x, P = _ekf(START[node], rows[node])
        np.testing.assert_allclose(run.xhat[-1, 0, first : first + 3], x, rtol=1e-9)
        np.testing.assert_allclose(run.P[-1, 0, first:, first:][:3, :3], P, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(alone.block("pose", node).xhat[-1], x, rtol=1e-8)


def _ekf(start, rows, v=1.0, w=0.4, T=0.5):
    x, P = np.array(start), np.diag([0.1, 0.1, 0.02])
    for k in range(1, 5):
        dx = v / w * (math.sin(x[2] + w * T) - math.sin(x[2]))
        dy = v / w * (math.cos(x[2]) - math.cos(x[2] + w * T))
        J = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        x, P = x + np.array([dx, dy, w * T]), J @ P @ J.T + np.diag([1e-3, 1e-3, 4e-4])
        seen = rows.get(k, [])
        if not seen:
            continue
        d = [x[:2] - MARKS[to] for to, _, _ in seen]
        r = np.array([math.hypot(*one) for one in d])
        H = np.array([[*(one / length), 0.0] for one, length in zip(d, r, strict=True)])
        S = H @ P @ H.T + np.diag([R for _, _, R in seen])
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ (np.array([y for _, y, _ in seen]) - r), P - K @ H @ P
    return x, P


LOSS = {"kind": "distance", "delivery": {"kind": "logistic", "half": 6.0, "width": 1.0}}
TICKS = {"kind": "poisson", "rate": 9.0, "at": "nodes"}
HOLES = "t,node,x0,x1,x2\n0,1,0,0,3\n0,2,3,4,-1\n1,1,0,0,3\n1,2,3,4,-1\n"


@pytest.mark.parametrize("time", [None, pytest.param(FLOW, marks=pytest.mark.slow)])
def test_positions_are_asked_for_whenever_messages_are_sent(tmp_path, time):
    table = team(tmp_path, time, position=[0, 1], input=RECORDED)
    table["network"]["channel"] = {"loss": LOSS}
    table["network"]["activation"] = TICKS if time else {"kind": "broadcast"}
    table["filter"] = {"kind": "block-intersection", "estimates": "own"}
    run = netkf.simulate(from_table(table, tmp_path))
    assert run.count("deliver") > 0
    for plant in table["plants"]:
        plant |= {"kind": "recorded", "path": "truth.csv", "interpolate": "linear"}
    run = netkf.simulate(from_table(table, tmp_path))
    assert run.count("deliver") > 0
    # Readings are recorded and only two states are shown: messages need the others.
    (tmp_path / "truth.csv").write_text(HOLES)
    (tmp_path / "seen.csv").write_text(SEEN.replace("2026-03-01T12:00:0", "").replace("Z", ""))
    for plant in table["plants"]:
        del plant["interpolate"]
    places = [MARKS[7].tolist(), MARKS[8].tolist()]
    table["sensors"] = [{"kind": "range", "of": "pose", "path": "seen.csv", "positions": places}]
    what = "a tick of the network" if time else "slot 1"
    with pytest.raises(ScenarioError, match=f"truth.csv has no state for {what}"):
        from_table({**table, "probe": 1.0, "horizon": 1.5}, tmp_path)


def test_the_map_has_nodes_where_they_are(tmp_path):
    table = team(tmp_path, input=RECORDED, position=[0, 1])
    scenario = from_table(table, tmp_path)
    assert get_positions(scenario) == {1: (0.0, 0.0), 2: (3.0, 4.0)}
    run = netkf.simulate(scenario, engine="simpy")
    first = {1: tuple(run.x[0, :2].tolist()), 2: tuple(run.x[0, 3:5].tolist())}
    assert get_positions(scenario, run) == first
    # Of nodes that no plant places a table says so.
    (tmp_path / "places.csv").write_text("node,x,y\n1,7,1\n2,5,5\n")
    table = team(tmp_path, input=RECORDED)
    table["network"]["positions"] = "places.csv"
    assert get_positions(from_table(table, tmp_path)) == {1: (7.0, 1.0), 2: (5.0, 5.0)}
    del table["network"]["positions"]
    places = get_positions(from_table(table, tmp_path))
    assert math.dist(places[1], places[2]) == pytest.approx(2.0)


def test_recorded_readings_of_own_places_need_no_anchors(tmp_path):
    """Without a column ``to`` a node that estimates its own block reads where its sensor stands."""
    drive = {"kind": "constant", "value": [0.5, 0.2]}
    table = team(tmp_path, input=drive)
    rows = "t,node,y0,y1\n0.5,1,2.9,-2.1\n1.0,1,3.1,-2.3\n1.5,1,3.6,-2.6\n"
    (tmp_path / "seen.csv").write_text(rows)
    (tmp_path / "anchored.csv").write_text(rows.replace("y0", "to,y0").replace(",1,", ",1,7,"))
    table |= {"network": {"graph": table["network"]["graph"]}, "sensors": table["sensors"][:1]}
    table["filter"] = {"kind": "local", "estimates": "own"}
    runs = []
    for path in ("seen.csv", "anchored.csv"):
        table["sensors"][0]["path"] = path
        runs.append(netkf.simulate(from_table(table, tmp_path), engine="simpy"))
    np.testing.assert_array_equal(runs[0].xhat, runs[1].xhat)
    start = from_table({**table, "sensors": []}, tmp_path)
    assert np.nanmax(np.abs(netkf.simulate(start, engine="simpy").xhat - runs[0].xhat)) > 0.05
