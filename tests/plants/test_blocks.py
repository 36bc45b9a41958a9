"""Blocks of the state: `[[plants]]`, sensors that name a block, and relative readings.

The truth is the stacked system, written here by hand: a scenario of blocks must be the same as one
of the whole state, to the bit, and the central filter must be the textbook's.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import parse_toml
from netkf.scenario.writing import as_table, resolve_defaults, to_toml

ROBOTS = """
format = 1
name = "three robots"
horizon = 10.0
probe = 0.5
seed = 3
[[plants]]
name = "pose"
nodes = [1, 2, 3]
A = [[0.0]]
B = [[0.5]]
cov = [[1.0]]
[[sensors]]
nodes = [1]
of = "pose"
H = [[1.0]]
R = [[0.1]]
sampling = { kind = "periodic", period = 1.0 }
[[sensors]]
kind = "relative"
of = "pose"
R = [[0.2]]
sampling = { kind = "periodic", period = 0.5 }
[network]
graph = { kind = "edges", edges = [[1, 2], [2, 3]] }
[filter]
kind = "central"
"""
STACKED = """
[plant]
kind = "diffusion"
A = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
B = [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]]
cov = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
"""
AREAS = """
format = 1
name = "areas"
horizon = 20.0
probe = 1.0
[[plants]]
name = "field"
F = [[0.9]]
Q = [[0.2]]
period = 1.0
cov = [[1.0]]
[[plants]]
name = "area"
nodes = [1]
F = [[0.8, 0.1], [0.0, 0.7]]
Q = [[0.1, 0.0], [0.0, 0.1]]
period = 1.0
coupling = [{ from = [2], A = [[0.2], [0.1]] }, { from = "field", A = [[0.3], [0.0]] }]
[[plants]]
name = "border"
nodes = [2]
F = [[0.5]]
Q = [[0.3]]
period = 1.0
coupling = [{ from = [1], A = [[0.0, 0.4]] }]
[[sensors]]
of = "area"
nodes = [1]
H = [[1.0, 0.0]]
R = [[0.1]]
[[sensors]]
of = "field"
nodes = [1, 2]
H = [[2.0]]
R = [[0.5]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "broadcast" }
[filter]
kind = "kcf"
"""


def load(text: str, folder: Path, changes: dict[str, Any] | None = None) -> netkf.Scenario:
    path = folder / "scenario.toml"
    path.write_text(text)
    return netkf.load(path, changes)


def kalman_covariance(
    steps: list[tuple[float, list[np.ndarray], list[float]]], P: np.ndarray, Q: np.ndarray
) -> list[np.ndarray]:
    """Return P after each (time, rows of H, variances), by the textbook's update, F = I."""
    result, now = [], 0.0
    for time, rows, variances in steps:
        P, now = P + Q * (time - now), time
        H, R = np.array(rows), np.diag(variances)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        P = P - K @ H @ P
        result.append(P)
    return result


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_central_filter_of_blocks_solves_the_stacked_riccati_equation(
    tmp_path: Path, engine: str
) -> None:
    run = netkf.simulate(load(ROBOTS, tmp_path), engine=engine)
    e = np.eye(3)
    pairs = [e[1] - e[0], e[0] - e[1], e[2] - e[1], e[1] - e[2]]
    steps = []
    for k in range(1, 20):
        own = [e[0]] if k % 2 == 0 else []
        steps.append((0.5 * k, own + pairs, [0.1] * len(own) + [0.2] * 4))
    expected = kalman_covariance(steps, np.eye(3), 0.25 * np.eye(3))
    np.testing.assert_allclose(run.P[1:20, 0], expected, rtol=1e-9)
    block = run.block("pose", 2)
    assert block.P.shape == (21, 1, 1)
    np.testing.assert_array_equal(block.xhat[:, 0], run.xhat[:, 1, 1])
    np.testing.assert_array_equal(block.error, block.x - block.xhat)
    np.testing.assert_array_equal(run.block("pose", 3, by=1).xhat[:, 0], run.xhat[:, 0, 2])


@pytest.mark.parametrize(
    ("filtering", "engine"),
    [
        # Loops over three states are compiled for this test alone.
        pytest.param('kind = "hybrid"\nepsilon = 0.3', "compiled", marks=pytest.mark.slow),
        ('kind = "hybrid"\nepsilon = 0.3', "simpy"),
        ('kind = "covariance-intersection"\nepsilon = 0.3', "simpy"),
        ('kind = "gossip"', "simpy"),
    ],
)
def test_blocks_are_the_plant_of_all_states_to_the_bit(
    tmp_path: Path, filtering: str, engine: str
) -> None:
    blocks = ROBOTS.replace('kind = "central"', filtering)
    clock = 'activation = { kind = "poisson", rate = 5.0 }\n[filter]'
    blocks = blocks.replace("[filter]", clock)
    first, rest = blocks.split("[[plants]]")
    whole = parse_toml(first + STACKED + "[network]" + rest.partition("[network]")[2])
    H = np.array([[-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 1.0, -1.0]])
    half = {"kind": "periodic", "period": 0.5}
    whole["sensors"] = [
        {"nodes": [1], "H": [[1.0, 0.0, 0.0]], "R": [[0.1]], "sampling": half | {"period": 1.0}},
        *(
            {"nodes": [node], "H": [row.tolist()], "R": [[0.2]], "sampling": half}
            for node, row in zip([1, 2, 2, 3], H, strict=True)
        ),
    ]
    scenarios = (load(text, tmp_path) for text in (blocks, to_toml(whole)))
    runs = [netkf.simulate(scenario, engine=engine) for scenario in scenarios]
    assert runs[0].fingerprint == runs[1].fingerprint
    for name in ("x", "xhat", "P", "error"):
        np.testing.assert_array_equal(getattr(runs[0], name), getattr(runs[1], name))


def test_coupled_blocks_are_stacked(tmp_path: Path) -> None:
    scenario = load(AREAS, tmp_path)
    F = [[0.9, 0, 0, 0], [0.3, 0.8, 0.1, 0.2], [0, 0, 0.7, 0.1], [0, 0, 0.4, 0.5]]
    np.testing.assert_array_equal(scenario.slot_plant.F, F)
    np.testing.assert_array_equal(scenario.slot_plant.Q, np.diag([0.2, 0.1, 0.1, 0.3]))
    matrices = [sensor.H.tolist() for sensor in scenario.sensors]
    assert matrices == [[[0.0, 1.0, 0.0, 0.0]], [[2.0, 0.0, 0.0, 0.0]]]
    one, other = (netkf.simulate(scenario, engine=engine) for engine in ("simpy", "compiled"))
    assert one.fingerprint == other.fingerprint
    np.testing.assert_allclose(one.P, other.P, rtol=1e-10)
    assert one.block("field", 2).xhat.shape == (21, 1)
    assert one.block("area", 1).P.shape == (21, 2, 2)


@pytest.mark.parametrize("text", [ROBOTS, AREAS])
def test_blocks_are_written_as_they_were_given(tmp_path: Path, text: str) -> None:
    scenario = load(text, tmp_path)
    for table in (as_table(scenario), resolve_defaults(scenario)):
        again = load(to_toml(table), tmp_path)
        assert again.layout.places == scenario.layout.places
        assert netkf.simulate(again).fingerprint == netkf.simulate(scenario).fingerprint
    assert [block["name"] for block in as_table(scenario)["plants"]] == [
        block.name for block in scenario.plants
    ]
    changed = scenario.replace({"sensors.1.R": [[0.7]]})
    assert changed.declared_sensors[1].R == [[0.7]]
    assert changed.sensors[-1].R == [[0.7]]


PAIRS = """t,node,to,y0
0.5,1,2,1.5
0.5,2,3,-0.5
1.0,2,1,-1.25
1.0,2,3,
1.5,3,2,0.75
"""


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_recorded_relative_readings(tmp_path: Path, engine: str) -> None:
    (tmp_path / "pairs.csv").write_text(PAIRS)
    text = ROBOTS.replace('sampling = { kind = "periodic", period = 0.5 }', 'path = "pairs.csv"')
    scenario = load(text, tmp_path, {"horizon": 2.0, "plants.0.mean": [0.5]})
    run = netkf.simulate(scenario, engine=engine)
    e, P, xhat = np.eye(3), np.eye(3), np.full(3, 0.5)
    rows = {0.5: [(1, 2, 1.5), (2, 3, -0.5)], 1.0: [(2, 1, -1.25)], 1.5: [(3, 2, 0.75)]}
    for k, (time, readings) in enumerate(rows.items()):
        P = P + 0.125 * np.eye(3)
        if time != 1.0:  # the absolute reading of then is drawn
            H = np.array([e[j - 1] - e[i - 1] for i, j, _ in readings])
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.2 * np.eye(len(H)))
            xhat = xhat + K @ (np.array([y for *_, y in readings]) - H @ xhat)
            P = P - K @ H @ P
        if k == 0:
            np.testing.assert_allclose(run.xhat[1, 0], xhat, atol=1e-12)
            np.testing.assert_allclose(run.P[1, 0], P, atol=1e-12)
    assert run.count("sense") == 2 + 2 + 1  # nodes 1 and 2, 1 and 2 again, 3


PLANAR = """
format = 1
name = "planar"
horizon = 3.0
probe = 1.0
[[plants]]
name = "pose"
nodes = [1, 2]
F = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
Q = [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]]
period = 1.0
cov = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.1]]
[[sensors]]
kind = "relative-range-bearing"
to = [[1, 2]]
path = "sights.csv"
heading = 2
R = [[0.04, 0.0], [0.0, 0.01]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
[filter]
kind = "central"
mean = [0.0, 0.0, 0.3, 3.0, 4.0, 0.0]
"""


def test_range_and_bearing_to_another_node_are_used_as_by_a_plain_ekf(tmp_path: Path) -> None:
    (tmp_path / "sights.csv").write_text("t,node,to,y0,y1\n1,1,2,5.2,0.7\n2,1,2,4.9,0.55\n")
    scenario = load(PLANAR.replace("to = [[1, 2]]\n", ""), tmp_path)
    run = netkf.simulate(scenario)
    xhat, P = np.array([0.0, 0.0, 0.3, 3.0, 4.0, 0.0]), np.diag([1.0, 1.0, 0.1] * 2)
    R = np.diag([0.04, 0.01])
    for slot, y in enumerate([(5.2, 0.7), (4.9, 0.55)], 1):
        P = P + 0.01 * np.eye(6)
        dx, dy = xhat[3] - xhat[0], xhat[4] - xhat[1]
        r2 = dx * dx + dy * dy
        r = math.sqrt(r2)
        H = np.array(
            [
                [-dx / r, -dy / r, 0.0, dx / r, dy / r, 0.0],
                [dy / r2, -dx / r2, -1.0, -dy / r2, dx / r2, 0.0],
            ]
        )
        expected = np.array([r, math.atan2(dy, dx) - xhat[2]])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        xhat, P = xhat + K @ (np.array(y) - expected), P - K @ H @ P
        np.testing.assert_allclose(run.xhat[slot, 0], xhat, atol=1e-12)
        np.testing.assert_allclose(run.P[slot, 0], P, atol=1e-12)


def test_couplings_by_name_are_those_of_the_own_node_and_add_up(tmp_path: Path) -> None:
    drift = """[[plants]]
name = "drift"
nodes = [1, 2]
F = [[0.9]]
Q = [[0.01]]
period = 1.0
cov = [[1.0]]
coupling = [{ from = "pose", A = [[0.2, 0.0, 0.0]] }, { from = [1], A = [[0.1]] },
            { from = "pose", A = [[0.05, 0.0, 0.0]] }]
"""
    text = PLANAR.replace("[[sensors]]", drift + "[[sensors]]").replace(
        "mean = [0.0", "mean = [0.0, 0.0, 0.0"
    )
    (tmp_path / "sights.csv").write_text("t,node,to,y0,y1\n1,1,2,5.2,0.7\n")
    text = text.replace("to = [[1, 2]]\n", 'of = "pose"\n')
    expected = np.diag([1.0] * 6 + [0.9] * 2)
    expected[6, 0] = expected[7, 3] = 0.25
    expected[7, 6] = 0.1
    np.testing.assert_allclose(load(text, tmp_path).plant.F, expected, rtol=1e-15)


@pytest.mark.parametrize("recorded", [False, True])
def test_each_reader_looks_from_its_own_heading_at_the_other_that_is_named(
    tmp_path: Path, recorded: bool
) -> None:
    pairs = [(2, 1), (2, 3), (3, 1)]
    table = "t,node,to,y0,y1\n" + "".join(f"1,{i},{j},1,1\n" for i, j in pairs)
    (tmp_path / "sights.csv").write_text(table)
    text = PLANAR.replace("[1, 2]\nF", "[1, 2, 3]\nF").replace("[[1, 2]] }", "[[1, 2], [2, 3]] }")
    text = text.replace("3.0, 4.0, 0.0]", "3.0, 4.0, 0.0, 1.0, 1.0, 0.0]")
    drawn = text.replace("to = [[1, 2]]", f"to = {[list(pair) for pair in pairs]}")
    drawn = drawn.replace('path = "sights.csv"\n', "")
    told = text.replace("to = [[1, 2]]\n", "")
    x = np.random.default_rng(4).normal(size=9)
    pose, found = x.reshape(3, 3), []
    for sensor in load(told if recorded else drawn, tmp_path).sensors:
        (i,) = sensor.nodes
        for j in [j for reader, j in pairs if reader == i] if recorded else [pairs[len(found)][1]]:
            found.append((i, j))
            dx, dy = pose[j - 1, :2] - pose[i - 1, :2]
            expected = [math.hypot(dx, dy), math.atan2(dy, dx) - pose[i - 1, 2]]
            np.testing.assert_allclose(sensor.h(x, j if recorded else i), expected, rtol=1e-12)
    assert found == pairs


def test_heading_of_a_sensor_of_places(tmp_path: Path) -> None:
    sensor = netkf.parts.RangeBearingSensor(
        nodes=(1,), R=np.eye(2), positions=np.array([[2.0, 1.0]]), heading=2
    )
    x, step = np.array([0.5, -0.25, 0.3]), 1e-6
    y = sensor.h(x, 1)
    np.testing.assert_allclose(y, [math.hypot(1.5, 1.25), math.atan2(1.25, 1.5) - 0.3])
    columns = [(sensor.h(x + d, 1) - sensor.h(x - d, 1)) / (2 * step) for d in step * np.eye(3)]
    np.testing.assert_allclose(sensor.jacobian(x, 1), np.array(columns).T, atol=1e-8)


@pytest.mark.parametrize(
    ("keys", "unused"),
    [
        ({"kind": "block-intersection"}, "node 1 of 3, node 3 of 1"),
        ({"kind": "block-belief-propagation"}, "node 1 of 3, node 3 of 1"),
        ({"kind": "block-intersection", "estimates": "all"}, ""),
        ({"kind": "partition"}, ""),
        ({"kind": "central"}, ""),
    ],
)
def test_readings_of_pairs_that_reach_nobody_are_noted(
    tmp_path: Path, keys: dict[str, object], unused: str
) -> None:
    pairs = 'kind = "relative"\nto = [[1, 3], [1, 2], [3, 1]]'
    text = ROBOTS.replace('kind = "relative"', pairs)
    filtering = {"estimates": "own"} | keys
    changes = {"filter": filtering, "network.activation": {"kind": "readings"}}
    notes = load(text, tmp_path).replace(changes).notes
    line = f"sensors[1]: readings by {unused} are not used: nobody who hears the reader"
    assert any(note.startswith(line) for note in notes) == bool(unused)


@pytest.mark.parametrize(
    ("old", "new", "key", "rule"),
    [
        ('of = "pose"\nH', 'of = "prose"\nH', "sensors[0].of", "must be the name of one of"),
        ('of = "pose"\nH = [[1.0]]', 'of = "pose"\nH = [[1.0, 2.0]]', "sensors[0].H", "1 columns"),
        ("nodes = [1, 2, 3]", "nodes = [1, 2]", "sensors[1].to", None),
        ("nodes = [1, 2, 3]", "nodes = [1, 3]", "sensors[1].to", "must be others to read"),
        ("nodes = [1, 2, 3]", "nodes = [1, 2, 4]", "plants[0].nodes[2]", "node of the graph"),
        ("nodes = [1, 2, 3]", "nodes = [1, 2, 2]", "plants[0].nodes", "two blocks"),
        (
            "cov =",
            "means = [[1.0], [2.0]]\ncov =",
            "plants[0].means",
            "got [[1.0], [2.0]]; correct",
        ),
        (
            "cov =",
            "mean = [0.0]\nmeans = [[1.0], [2.0], [3.0]]\ncov =",
            "plants[0].means",
            "in place of mean",
        ),
        ("A = [[0.0]]", "A = [[0.0]]\nF = [[1.0]]", "plants[0].A", "not a key"),
        ("B = [[0.5]]", "B = [[0.5], [1.0]]", "plants[0].B", "1 x 1"),
        ("cov =", "coupling = [{ from = 'x', A = [[1.0]] }]\ncov =", "plants[0].coupling[0].f", ""),
        (
            "cov =",
            "coupling = [{ from = [1], A = [[1, 2]] }]\ncov =",
            "plants[0].coupling[0].A",
            "1",
        ),
        (
            "nodes = [1, 2, 3]",
            "nodes = [1]\ncoupling = [{ from = [1], A = [[1.0]] }]",
            "plants[0].coupling[0].from",
            "must be other nodes",
        ),
        (
            "R = [[0.2]]",
            "R = [[0.2]]\nnodes = [1]\nto = [[1, 2], [2, 3]]",
            "sensors[1].to[1]",
            "must begin with one of the nodes",
        ),
        ('"pose"\nR', '"poses"\nR', "sensors[1].of", "got 'poses'; did you mean \"pose\"?"),
        (
            "R = [[0.2]]",
            "R = [[0.2]]\nnodes = [2, 4]",
            "sensors[1].nodes[1]",
            "'pose' of their own",
        ),
        ("R = [[0.2]]", "R = [[0.2]]\nnodes = [2, 2]", "sensors[1].nodes", "each node once"),
        (
            "R = [[0.2]]",
            "R = [[0.2]]\nto = [[1, 2], [2, 1], [1, 2]]",
            "sensors[1].to[2]",
            "must be another pair; got [1, 2]",
        ),
        ("[network]", "[plant]\nkind = 'diffusion'\n[network]", "plant", "beside [[plants]]"),
        ("[[plants]]\n", "[[plants]]\nkind = 'recorded'\npath = 'x.csv'\n", "plants[0]", None),
    ],
)
def test_mistakes_in_blocks_are_named(
    tmp_path: Path, old: str, new: str, key: str, rule: str | None
) -> None:
    assert old in ROBOTS
    text = ROBOTS.replace(old, new, 1)
    if rule is None and key.endswith("to"):
        assert len(load(text, tmp_path).sensors) == 3  # node 3 has no pose: it is not read
        return
    with pytest.raises(netkf.ScenarioError) as caught:
        load(text, tmp_path)
    assert caught.value.key.startswith(key)
    assert (rule or "") in str(caught.value)


def test_sensors_of_blocks_need_blocks(tmp_path: Path) -> None:
    first, rest = ROBOTS.split("[[plants]]")
    text = first + STACKED + rest[rest.index("[[sensors]]") :]
    with pytest.raises(netkf.ScenarioError, match=r"sensors\[0\].of: means nothing without"):
        load(text, tmp_path)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_each_block_has_its_own_input(tmp_path: Path, engine: str) -> None:
    (tmp_path / "u.csv").write_text("t,u0\n0.5,2\n3,-1\n")
    recorded = 'input = { kind = "recorded", G = [[0.5]], path = "u.csv" }\n'
    sine = 'input = { kind = "sine", G = [[1.0]], amplitude = 1.0, frequency = 0.2 }\n'
    third = '[[plants]]\nname = "pose"\nnodes = [3]\nA = [[0.0]]\nB = [[0.5]]\ncov = [[1.0]]\n'
    without = ROBOTS.replace("[1, 2, 3]", "[1, 2]").replace("[[sensors]]", third + "[[sensors]]", 1)
    driven = without.replace(third, recorded + third + sine)
    one, other = (netkf.simulate(load(text, tmp_path), engine=engine) for text in (driven, without))
    t = one.times
    held = np.where(t < 3.0, np.maximum(t - 0.5, 0.0), 2.5 - 0.5 * (t - 3.0))
    wave = (1.0 - np.cos(0.4 * math.pi * t)) / (0.4 * math.pi)
    expected = np.stack([held, held, wave], axis=1)
    np.testing.assert_allclose(one.x - other.x, expected, atol=1e-12)
    np.testing.assert_array_equal(one.error, other.error)
    np.testing.assert_array_equal(one.P, other.P)
    assert one.fingerprint == other.fingerprint


UNICYCLES = """
format = 1
name = "unicycles"
horizon = 4.0
probe = 1.0
[[plants]]
name = "pose"
nodes = [1]
f = "unicycle"
input = { kind = "constant", value = [0.5, 0.2] }
Q = [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.004]]
period = 1.0
mean = [0.0, 0.0, 0.3]
cov = [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.05]]
[[plants]]
name = "pose"
nodes = [2]
F = [[1.0, 0.0], [0.0, 0.9]]
Q = [[0.02, 0.0], [0.0, 0.02]]
period = 1.0
mean = [3.0, 4.0]
cov = [[0.2, 0.0], [0.0, 0.2]]
input = { kind = "constant", value = [0.3], G = [[1.0], [0.0]] }
[[sensors]]
kind = "relative-range-bearing"
path = "sights.csv"
heading = 2
R = [[0.04, 0.0], [0.0, 0.01]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "broadcast" }
[filter]
kind = "central"
"""


def arc(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unicycle over a second with v = .5 and w = .2, and its Jacobian, by the textbook."""
    v, w, h = 0.5, 0.2, x[2]
    dx = v / w * (math.sin(h + w) - math.sin(h))
    dy = v / w * (math.cos(h) - math.cos(h + w))
    return x + np.array([dx, dy, w]), np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])


@pytest.mark.one_in(2)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_blocks_need_not_be_linear(tmp_path: Path, engine: str) -> None:
    (tmp_path / "sights.csv").write_text("t,node,to,y0,y1\n1,1,2,4.9,0.5\n2,1,2,4.8,0.4\n")
    run = netkf.simulate(load(UNICYCLES, tmp_path), engine=engine)
    xhat = np.array([0.0, 0.0, 0.3, 3.0, 4.0])
    P, Q = np.diag([0.1, 0.1, 0.05, 0.2, 0.2]), np.diag([0.01, 0.01, 0.004, 0.02, 0.02])
    for slot, y in enumerate([(4.9, 0.5), (4.8, 0.4), None], 1):
        moved, J = arc(xhat[:3])
        F = np.zeros((5, 5))
        F[:3, :3], F[3, 3], F[4, 4] = J, 1.0, 0.9
        xhat = np.array([*moved, xhat[3] + 0.3, 0.9 * xhat[4]])
        P = F @ P @ F.T + Q
        if y is not None:
            dx, dy = xhat[3] - xhat[0], xhat[4] - xhat[1]
            r = math.hypot(dx, dy)
            H = np.array(
                [
                    [-dx / r, -dy / r, 0.0, dx / r, dy / r],
                    [dy / r**2, -dx / r**2, -1.0, -dy / r**2, dx / r**2],
                ]
            )
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag([0.04, 0.01]))
            xhat = xhat + K @ (np.array(y) - [r, math.atan2(dy, dx) - xhat[2]])
            P = P - K @ H @ P
        np.testing.assert_allclose(run.xhat[slot, 0], xhat, atol=1e-11)
        np.testing.assert_allclose(run.P[slot, 0], P, atol=1e-11)


def test_nodes_move_their_own_blocks_by_their_own_dynamics(tmp_path: Path) -> None:
    (tmp_path / "sights.csv").write_text("t,node,to,y0,y1\n1,1,2,4.9,0.5\n")
    own = {"filter": {"kind": "block-intersection", "estimates": "own"}}
    scenario = load(UNICYCLES, tmp_path, own)
    run = netkf.simulate(scenario)
    xhat, P = np.array([0.0, 0.0, 0.3]), np.diag([0.1, 0.1, 0.05])
    for slot in range(1, 4):
        xhat, J = arc(xhat)
        P = J @ P @ J.T + np.diag([0.01, 0.01, 0.004])
        np.testing.assert_allclose(run.xhat[slot, 0], xhat, atol=1e-12)
        np.testing.assert_allclose(run.P[slot, 0], P, atol=1e-12)
    # Node 2 has two states; what node 1 saw of it was used once.
    assert np.isnan(run.xhat[:, 1, 2]).all()
    assert np.trace(run.P[1, 1, :2, :2]) < 0.2 + 0.162 + 0.04
    drawn = load(UNICYCLES.replace('path = "sights.csv"', "to = [[1, 2]]"), tmp_path, own)
    assert len(netkf.consistency(drawn, runs=10, workers=1).rows) == 2
    with pytest.raises(netkf.ScenarioError, match=r"plants\[0\].coupling\[0\].A: must be 3 x 2"):
        load(UNICYCLES, tmp_path, {"plants.0.coupling": [{"from": [2], "A": [[1.0]]}]})
    with pytest.raises(netkf.ScenarioError, match=r"plants\[0\].input: must have 2 components"):
        load(UNICYCLES, tmp_path, {"plants.0.input": {"kind": "constant", "value": [1.0]}})
