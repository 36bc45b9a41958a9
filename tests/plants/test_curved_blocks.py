"""Blocks of the state that are not linear: the filter of all blocks is a plain recursion."""

import math

import numpy as np
import pytest

import netkf
from netkf.scenario.reading import from_table
from tests.conftest import with_slow

R_SEEN = np.diag([0.04, 0.01])
Q_POSE, Q_TARGET, F_TARGET = np.diag([1e-3, 1e-3, 4e-4]), 0.02 * np.eye(2), 0.98 * np.eye(2)
STARTS = {1: [0.0, 0.0, 0.3], 2: [3.0, 4.0, -1.0]}
U = {1: np.array([1.0, 0.4]), 2: np.array([0.7, -0.3])}
G = np.array([[0.1], [0.05]])


def arc(x, u, T=0.5):
    v, w = u
    dx = v / w * (math.sin(x[2] + w * T) - math.sin(x[2]))
    dy = v / w * (math.cos(x[2]) - math.cos(x[2] + w * T))
    J = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    return x + np.array([dx, dy, w * T]), J


def sight(x):
    """What node 1 sees of node 2, from its heading, and the derivatives by the poses of both."""
    dx, dy = x[3] - x[0], x[4] - x[1]
    r2 = dx * dx + dy * dy
    r = math.sqrt(r2)
    H = np.zeros((2, 8))
    H[0, :6] = [-dx / r, -dy / r, 0.0, dx / r, dy / r, 0.0]
    H[1, :6] = [dy / r2, -dx / r2, -1.0, -dy / r2, dx / r2, 0.0]
    return np.array([r, math.atan2(dy, dx) - x[2]]), H


def poses(**plant):
    return [
        {
            "name": "pose",
            "nodes": [node],
            "kind": "nonlinear",
            "f": "unicycle",
            "mean": STARTS[node],
            "cov": np.diag([0.1, 0.1, 0.02]).tolist(),
            "input": {"kind": "constant", "value": U[node].tolist()},
            **plant,
        }
        for node in (1, 2)
    ]


@pytest.fixture
def scenario(tmp_path):
    sights = ["t,node,to,y0,y1", "0.5,1,2,5.1,0.6", "1.5,1,2,4.4,0.45", "2,1,2,4.2,0.3"]
    (tmp_path / "sights.csv").write_text("\n".join(sights) + "\n")
    (tmp_path / "target.csv").write_text("t,node,y0,y1\n1,2,0.4,0.1\n2,2,0.5,-0.2\n")
    target = {
        "name": "target",
        "F": F_TARGET.tolist(),
        "Q": Q_TARGET.tolist(),
        "period": 0.5,
        "cov": np.eye(2).tolist(),
        "input": {"kind": "sine", "amplitude": 1.0, "frequency": 0.2, "G": G.tolist()},
    }
    table = {
        "format": 1,
        "name": "team",
        "horizon": 2.5,
        "probe": 0.5,
        "plants": [*poses(period=0.5, Q=Q_POSE.tolist()), target],
        "sensors": [
            {
                "kind": "relative-range-bearing",
                "of": "pose",
                "path": "sights.csv",
                "heading": 2,
                "R": R_SEEN.tolist(),
            },
            {
                "kind": "recorded",
                "of": "target",
                "path": "target.csv",
                "H": np.eye(2).tolist(),
                "R": [[0.1, 0.0], [0.0, 0.1]],
            },
        ],
        "network": {
            "graph": {"kind": "edges", "edges": [[1, 2]]},
            "activation": {"kind": "broadcast"},
        },
        "filter": {"kind": "central"},
    }
    return from_table(table, tmp_path)


def update(x, P, v, H, R):
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + K @ v, P - K @ H @ P


TO_POSE = np.array([[0.02, 0.0], [0.01, -0.03], [0.0, 0.05]])
TO_TARGET = np.array([[0.0, 0.1, 0.2], [-0.1, 0.0, 0.0]])


def coupled(scenario):
    """Node 1 is driven by the target, and the target by it."""
    return scenario.replace(
        {
            "plants.0.coupling": [{"from": "target", "A": TO_POSE.tolist()}],
            "plants.2.coupling": [{"from": [1], "A": TO_TARGET.tolist()}],
        }
    )


@pytest.mark.parametrize("is_coupled", [False, True])
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_the_central_filter_is_a_plain_ekf_of_all_blocks(scenario, engine, is_coupled):
    if is_coupled:
        scenario = coupled(scenario)
    run = netkf.simulate(scenario, engine=engine)
    x = np.array([*STARTS[1], *STARTS[2], 0.0, 0.0])
    P = np.diag([0.1, 0.1, 0.02] * 2 + [1.0, 1.0])
    Q = np.zeros((8, 8))
    Q[:3, :3] = Q[3:6, 3:6] = Q_POSE
    Q[6:, 6:] = Q_TARGET
    seen = {1: (5.1, 0.6), 3: (4.4, 0.45), 4: (4.2, 0.3)}
    told = {2: (0.4, 0.1), 4: (0.5, -0.2)}
    for k in range(1, 6):
        J = np.zeros((8, 8))
        if is_coupled:
            J[:3, 6:], J[6:, :3] = TO_POSE, TO_TARGET
        driven = J @ x
        x[:3], J[:3, :3] = arc(x[:3], U[1])
        x[3:6], J[3:6, 3:6] = arc(x[3:6], U[2])
        x[6:] = F_TARGET @ x[6:] + G[:, 0] * math.sin(2.0 * math.pi * 0.2 * 0.5 * (k - 1))
        J[6:, 6:] = F_TARGET
        x += driven
        P = J @ P @ J.T + Q
        expected, H = sight(x)
        rows, R = np.zeros((0, 8)), np.zeros((0, 0))
        v = np.zeros(0)
        if k in seen:
            v, rows, R = np.array(seen[k]) - expected, H, R_SEEN
        if k in told:
            H = np.zeros((2, 8))
            H[:, 6:] = np.eye(2)
            v = np.concatenate([v, np.array(told[k]) - x[6:]])
            rows = np.concatenate([rows, H])
            R = np.block(
                [
                    [R, np.zeros((len(R), 2))],
                    [np.zeros((2, len(R))), 0.1 * np.eye(2)],
                ]
            )
        if len(v):
            x, P = update(x, P, v, rows, R)
        np.testing.assert_allclose(run.xhat[k, 0], x, atol=1e-10)
        np.testing.assert_allclose(run.P[k, 0], P, atol=1e-10)


def test_nodes_that_estimate_their_own_block_have_its_filter(scenario):
    """Without the readings of the other, an own block is a filter of its own."""
    changes = {
        "filter": {"kind": "local", "estimates": "own"},
        "sensors": [
            {
                "kind": "range",
                "of": "pose",
                "nodes": [1, 2],
                "positions": [[-1.0, 2.0], [1.0, 0.0]],
                "R": [[0.04]],
            }
        ],
    }
    run = netkf.simulate(scenario.replace(changes), seed=4)
    alone = scenario.replace(changes).replace({"filter": {"kind": "central"}})
    whole = netkf.simulate(alone, seed=4)
    np.testing.assert_array_equal(run.x, whole.x)
    for node, entries in ((1, slice(0, 3)), (2, slice(3, 6))):
        own = run.block("pose", node)
        np.testing.assert_allclose(own.xhat, whole.xhat[:, 0, entries], atol=1e-12)
        np.testing.assert_allclose(own.P, whole.P[:, 0, entries, entries], atol=1e-12)
    # Nothing that no theory has of them is called known.
    with pytest.raises(netkf.TheoryError, match=r"different blocks of the state$"):
        netkf.theory.covariance_bound(scenario.replace(changes), run.times)


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    "kind",
    with_slow(
        ["block-intersection", "block-cross-covariances", "block-belief-propagation"],
        {"block-cross-covariances"},
    ),
)
def test_what_others_read_of_a_pose_helps(scenario, kind):
    sensors = [
        {
            "kind": "range-bearing",
            "of": "pose",
            "nodes": [1],
            "positions": [[-1.0, 2.0]],
            "R": R_SEEN.tolist(),
        },
        {"kind": "relative-range-bearing", "of": "pose", "heading": 2, "R": R_SEEN.tolist()},
    ]
    filtering = {"kind": kind, "estimates": "own"}
    run = netkf.simulate(scenario.replace({"sensors": sensors, "filter": filtering}))
    assert run.status == "complete"
    first, last = (run.block("pose", 2).P[k, :2, :2].trace() for k in (0, -1))
    assert last < 0.7 * first


def test_blocks_in_continuous_time_are_integrated_side_by_side(scenario):
    """Two unicycles are two scenarios of one, with steps and jumps of both inputs."""
    plants = poses(step=0.02, B=(0.1 * np.eye(3)).tolist())
    plants[0]["schedule"] = [{"from": 0.7, "B": (0.4 * np.eye(3)).tolist()}]
    plants[1]["schedule"] = [{"from": t, "B": np.diag([t, 0.0, 0.1]).tolist()} for t in (0.3, 0.9)]
    plants[1]["input"] = {"kind": "sine", "amplitude": [0.8, 0.5], "frequency": 0.3, "phase": 0.5}
    changes = {
        "plants": plants,
        "sensors": [],
        "network": {"graph": {"kind": "edges", "edges": [[1, 2]]}},
        "filter": {"kind": "central"},
        "probe": 0.4,
    }
    both = netkf.simulate(scenario.replace(changes))
    for k, entries in ((0, slice(0, 3)), (1, slice(3, 6))):
        one = netkf.simulate(scenario.replace(changes | {"plants": [plants[k]]}))
        np.testing.assert_allclose(both.xhat[:, 0, entries], one.xhat[:, 0], atol=1e-10)
        np.testing.assert_allclose(both.P[:, 0, entries, entries], one.P[:, 0], atol=1e-10)


class Damped:
    """A linear f, of a block in slots or in continuous time."""

    F = np.array([[0.9, 0.2], [-0.1, 0.7]])

    def f(self, x, u, t):
        return self.F @ x

    def jacobian(self, x, u, t):
        return self.F


@pytest.mark.parametrize("kind", ["central", "diffusion"])
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_coupled_blocks_whose_f_is_linear_are_the_linear_plant(scenario, kind, engine):
    """To rounding: what blocks do to themselves is summed before what others do to them."""
    C = [[0.3, 0.0], [0.1, -0.2]]
    block = {"name": "area", "Q": [[0.2, 0.1], [0.1, 0.3]], "period": 0.5}
    runs = []
    for dynamics in ({"kind": "nonlinear", "f": Damped}, {"F": Damped.F.tolist()}):
        plants = [
            {**block, **dynamics, "nodes": [1], "coupling": [{"from": [2], "A": C}]},
            {**block, "F": [[0.5, 0.0], [0.0, 0.6]], "nodes": [2], "name": "other",
             "coupling": [{"from": [1], "A": C}]},
        ]  # fmt: skip
        sensor = {"H": [[1.0, 0.0]], "R": [[0.2]]}
        sensors = [
            {**sensor, "of": name, "nodes": [node]} for name, node in (("area", 1), ("other", 2))
        ]
        changes = {"plants": plants, "sensors": sensors, "filter": {"kind": kind}}
        runs.append(netkf.simulate(scenario.replace(changes), seed=3, engine=engine))
    for name in ("x", "xhat", "P"):
        np.testing.assert_allclose(*(getattr(run, name) for run in runs), atol=1e-12)


def areas(f):
    """A pose that drives two areas of a grid, of which each drives the other, by ``f`` of one."""
    area = {"B": [[0.3], [0.1]], "mean": [1.0, -0.5], "cov": np.eye(2).tolist()}
    C = [[0.3, 0.0], [0.1, -0.2]]
    own = {"A": (Damped.F - np.eye(2)).tolist()}
    rate = {"kind": "nonlinear", "f": Rate, "step": 0.01} if f else own
    return [
        {**area, **rate, "name": "west", "nodes": [1], "coupling": [{"from": [2], "A": C}]},
        {**area, **own, "name": "east", "nodes": [2], "coupling": [{"from": [1], "A": C}]},
    ]


class Rate(Damped):
    F = Damped.F - np.eye(2)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_coupled_blocks_in_continuous_time_are_the_linear_ones_to_the_order(scenario, engine):
    sensor = {"H": [[1.0, 0.0]], "R": [[0.2]], "sampling": {"kind": "periodic", "period": 0.25}}
    changes = {
        "sensors": [
            {**sensor, "of": name, "nodes": [node]} for name, node in (("west", 1), ("east", 2))
        ],
        "network": {"graph": {"kind": "edges", "edges": [[1, 2]]}},
        "filter": {"kind": "central"},
    }
    curved, linear = (
        netkf.simulate(scenario.replace(changes | {"plants": areas(f)}), engine=engine, seed=1)
        for f in (True, False)
    )
    np.testing.assert_allclose(curved.P, linear.P, rtol=1e-7)
    # The truth, whose noise inside steps is another, obeys the same law: so do the errors.
    assert np.abs(curved.x - curved.xhat[:, 0]).max() < 5.0 * np.sqrt(linear.P.max())


def test_estimates_have_all_that_drives_them_beside_curved_blocks_too(scenario):
    changes = {
        "filter": {"kind": "local", "estimates": "own"},
        "sensors": [
            {"kind": "range", "of": "pose", "nodes": [1, 2], "R": [[0.04]],
             "positions": [[-1.0, 2.0], [1.0, 0.0]]}
        ],
    }  # fmt: skip
    changes["plants.0.coupling"] = [{"from": "target", "A": TO_POSE.tolist()}]
    with pytest.raises(netkf.ScenarioError, match=r"must contain all that drives .* 1;") as caught:
        scenario.replace(changes)
    assert "partition" not in str(caught.value)  # it computes with F
    changes["filter"]["estimates"] = ["pose", "target"]
    run = netkf.simulate(scenario.replace(changes), seed=4)
    whole = netkf.simulate(scenario.replace(changes | {"filter": {"kind": "central"}}), seed=4)
    np.testing.assert_array_equal(run.x, whole.x)
    # What node 1 knows of its own pose and the target, nothing of node 2 helps or harms.
    own = [0, 1, 2, 6, 7]
    np.testing.assert_allclose(run.xhat[:, 0, :5], whole.xhat[:, 0, own], atol=1e-12)
    np.testing.assert_allclose(run.P[:, 0, :5, :5], whole.P[:, 0][:, own][:, :, own], atol=1e-12)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        (
            "coupling",
            [{"from": "target", "A": [[0.0] * 2] * 3}],
            "plants[0].coupling[0].A: must be 3 x 1",
        ),
        ("input", {"kind": "constant", "value": 1.0}, "plants[0].input: must have 2 components"),
        ("period", 0.25, "plants[0].period: must be the same in all entries"),
        ("f", "bicycle", "plants[0].f: must be one of"),
    ],
)
def test_mistakes_in_blocks_are_refused_in_one_line(scenario, key, value, words):
    plants = poses(period=0.5, Q=Q_POSE.tolist())
    plants[0][key] = value
    target = {"name": "target", "F": [[1.0]], "Q": [[1.0]], "period": 0.5}
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario.replace({"plants": [*plants, target]})
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("positions", [[0.0, 1.0]], "positions: must be 2 rows of 2, one for each of nodes"),
        ("heading", 2, "heading: must be a component of a state of 3, and means nothing"),
        ("heading", 3, "heading: must be a component of a state of 3, and means nothing"),
        ("R", [[1.0, 0.0], [0.0, 1.0]], "R: must be 1 x 1"),
        ("states", [0, 3], "states: must be components of block 'pose', which has 3"),
    ],
)
def test_mistakes_in_sensors_of_blocks_are_those_of_the_file(scenario, key, value, words):
    places = {"kind": "range", "of": "pose", "nodes": [1, 2], "R": [[1.0]], key: value}
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario.replace({"sensors": [{"positions": [[0.0, 1.0], [2.0, 3.0]]} | places]})
    assert str(caught.value).startswith(f"sensors[0].{words}")


CHANGES = [
    {"from": 1.0, "F": [[0.2, 0.3], [-0.5, 0.9]], "G": [[0.0], [2.0]]},
    {"from": 1.5, "Q": [[1.0, 0.0], [0.0, 2.0]], "G": [[1.0], [0.0]]},
]
DRIVE = {"kind": "sine", "amplitude": 1.0, "frequency": 0.3, "phase": 0.4, "G": [[1.0], [0.5]]}


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("model", [{}, {"schedule": False}, {"input": False}])
def test_blocks_change_beside_one_whose_f_is_linear_as_in_the_linear_plant(scenario, model, engine):
    block = {"name": "area", "Q": [[0.2, 0.1], [0.1, 0.3]], "period": 0.5, "nodes": [1]}
    changing = {**block, "F": [[0.5, 0.0], [0.0, 0.6]], "input": DRIVE, "schedule": CHANGES}
    changing |= {"name": "other", "nodes": [2], "cov": np.eye(2).tolist()}
    sensor, runs = {"H": [[1.0, 0.5]], "R": [[0.2]]}, []
    for dynamics in ({"kind": "nonlinear", "f": Damped}, {"F": Damped.F.tolist()}):
        sensors = [
            {**sensor, "of": name, "nodes": [node]} for name, node in (("area", 1), ("other", 2))
        ]
        changes = {
            "plants": [{**block, **dynamics}, changing],
            "sensors": sensors,
            "filter": {"kind": "central", "model": model},
        }
        runs.append(netkf.simulate(scenario.replace(changes), seed=3, engine=engine))
    for name in ("x", "xhat", "P"):
        np.testing.assert_allclose(*(getattr(run, name) for run in runs), atol=1e-12)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("model", [{}, {"schedule": False}])
def test_blocks_in_continuous_time_change_beside_curved_ones(scenario, tmp_path, model, engine):
    """At an instant inside steps and between readings."""
    rows = [f"{0.3 * k},{node},{math.sin(k + node)}" for k in range(1, 8) for node in (1, 2)]
    (tmp_path / "seen.csv").write_text("\n".join(["t,node,y0", *rows]) + "\n")
    drive = {"kind": "constant", "value": [0.7], "G": [[1.0], [0.5]]}
    changes = [
        {"from": 0.8137, "A": [[-0.2, 3.0], [-2.0, 0.0]], "G": [[0.0], [2.0]]},
        {"from": 1.6, "B": [[2.0], [0.5]], "A": [[0.4, 0.0], [0.0, -2.0]]},
    ]
    seen = {"kind": "recorded", "path": "seen.csv", "H": [[1.0, 0.5]], "R": [[0.2]]}
    runs = []
    for curved in (True, False):
        west, east = areas(curved)
        west = {**west, "coupling": []}
        east |= {"coupling": [], "input": drive, "schedule": changes}
        whole = {
            "plants": [west, east],
            "sensors": [{**seen, "of": "west", "nodes": [1]}, {**seen, "of": "east", "nodes": [2]}],
            "network": {"graph": {"kind": "edges", "edges": [[1, 2]]}},
            "filter": {"kind": "central", "model": model},
        }
        runs.append(netkf.simulate(scenario.replace(whole), engine=engine))
    np.testing.assert_allclose(runs[0].P, runs[1].P, rtol=1e-7)
    np.testing.assert_allclose(runs[0].xhat, runs[1].xhat, atol=1e-7)


@pytest.mark.parametrize("curved", [True, False])
@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"schedule": [{"from": 1.0, "G": [[1.0], [0.5]]}]}, "belongs to a plant with an input"),
        ({"schedule": [{"from": 1.0, "G": [[1.0, 0.0]] * 2}], "input": DRIVE}, "must be 2 x 1"),
    ],
)
def test_gains_of_changes_are_those_of_the_input(scenario, curved, keys, words):
    """A G without an input was ignored."""
    plants = poses(period=0.5, Q=Q_POSE.tolist()) if curved else []
    block = {"name": "target", "F": F_TARGET.tolist(), "Q": Q_TARGET.tolist(), "period": 0.5}
    sensors = [] if not curved else scenario.sensors[:1]
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario.replace({"plants": [*plants, {**block, **keys}], "sensors": sensors})
    assert str(caught.value).startswith(f"plants[{len(plants)}].schedule[0].G: {words}")


def test_the_derivative_of_a_prediction_is_taken_at_the_estimate(tmp_path):
    made = {
        "format": 1, "name": "arc", "horizon": 3.0, "probe": 1.0, "sensors": [],
        "plant": {
            "kind": "nonlinear", "f": "unicycle", "step": 0.01, "B": np.eye(3).tolist(),
            "input": {"kind": "constant", "value": [2.0, 0.5]},
        },
        "network": {"graph": {"kind": "path", "nodes": 2}},
        "filter": {"kind": "local"},
    }  # fmt: skip
    model = from_table(made, tmp_path).model_of(0)
    model.move_to(1.5)
    h, T, v, w = 0.7, 1.5, 2.0, 0.5
    along = v / w * (np.sin(h + w * T) - np.sin(h))
    aside = v / w * (np.cos(h) - np.cos(h + w * T))
    expected = [[1.0, 0.0, -aside], [0.0, 1.0, along], [0.0, 0.0, 1.0]]
    found = model.transition(np.array([30.0, -4.0, h]), T)
    np.testing.assert_allclose(found, expected, atol=1e-8)
