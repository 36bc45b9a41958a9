"""Dynamics that are not linear in continuous time: order of the truth, filters against ODEs."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest
import scipy.integrate

import netkf
from netkf.kernels import kernel
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import Periodic
from netkf.plants.curves import NonlinearDiffusion
from netkf.plants.nonlinear import NonlinearSensor
from netkf.rng.streams import Streams
from netkf.scenario.reading import from_table
from tests.engines.agreement import assert_agree

ROWS = [(0.0, 1.0, 0.0), (0.55, 1.0, 0.8), (1.3, 1.5, -0.4)]
B = np.diag([0.03, 0.02, 0.05])


def u_at(t):
    return next(np.array(row[1:]) for row in reversed(ROWS) if row[0] <= t)


def unicycle(_, m, u):
    return np.array([u[0] * math.cos(m[2]), u[0] * math.sin(m[2]), u[1]])


def slope(m, u):
    J = np.zeros((3, 3))
    J[0, 2], J[1, 2] = -u[0] * math.sin(m[2]), u[0] * math.cos(m[2])
    return J


def integrate(m, P, start, end):
    """Mean and covariance of an extended Kalman filter from start to end, by scipy."""

    def rate(_, z, u):
        J, P = slope(z[:3], u), z[3:].reshape(3, 3)
        return np.concatenate([unicycle(0, z[:3], u), (J @ P + P @ J.T + B @ B.T).ravel()])

    z, t = np.concatenate([m, P.ravel()]), start
    while t < end:
        stop = min([end, *(row[0] for row in ROWS if row[0] > t)])
        solved = scipy.integrate.solve_ivp(
            rate, (t, stop), z, args=(u_at(t),), rtol=1e-11, atol=1e-13, method="DOP853"
        )
        z, t = solved.y[:, -1], stop
    return z[:3], z[3:].reshape(3, 3)


def table(**changes):
    made = {
        "format": 1,
        "name": "curve",
        "horizon": 2.0,
        "probe": 0.25,
        "plant": {
            "kind": "nonlinear",
            "f": "unicycle",
            "step": 0.02,
            "B": B.tolist(),
            "mean": [0.0, 0.0, 0.4],
            "cov": np.diag([0.1, 0.1, 0.05]).tolist(),
            "input": {"kind": "recorded", "path": "u.csv"},
        },
        "sensors": [
            {
                "kind": "range",
                "nodes": [0],
                "positions": [[-1.0, 2.0]],
                "R": [[0.04]],
                "sampling": {"kind": "periodic", "period": 0.31},
            }
        ],
        "network": {"graph": {"kind": "path", "nodes": 2}},
        "filter": {"kind": "local"},
    }
    return made | changes


@pytest.fixture
def folder(tmp_path):
    lines = [",".join(map(repr, row)) for row in ROWS]
    (tmp_path / "u.csv").write_text("t,u0,u1\n" + "\n".join(lines) + "\n")
    return tmp_path


def sight(m):
    d = m[:2] - [-1.0, 2.0]
    return math.hypot(*d), np.array([[d[0], d[1], 0.0]]) / math.hypot(*d)


def test_filters_integrate_mean_and_covariance(folder):
    """Node 0 has readings, which the run records in its truth and noise; node 1 has none."""
    readings = [(0.31 * k, 2.0 + 0.1 * k) for k in range(1, 7)]
    rows = [f"{t!r},0,{y!r}" for t, y in readings]
    (folder / "y.csv").write_text("t,node,y0\n" + "\n".join(rows) + "\n")
    sensor = {"kind": "range", "path": "y.csv", "positions": [[-1.0, 2.0]], "R": [[0.04]]}
    run = netkf.simulate(from_table(table(sensors=[sensor]), folder))
    m, P = np.array([0.0, 0.0, 0.4]), np.diag([0.1, 0.1, 0.05])
    states, time = {0.0: (m, P)}, 0.0
    for at, y in sorted([*readings, *((t, None) for t in run.times.tolist())]):
        m, P = integrate(m, P, time, at)
        time = at
        if y is None:
            states[at] = m, P
            continue
        expected, H = sight(m)
        K = P @ H.T / (H @ P @ H.T + 0.04)
        m, P = m + K[:, 0] * (y - expected), P - K @ H @ P
    for k, t in enumerate(run.times.tolist()):
        np.testing.assert_allclose(run.xhat[k, 0], states[t][0], atol=1e-9)
        np.testing.assert_allclose(run.P[k, 0], states[t][1], atol=1e-9)
    m, P = integrate(np.array([0.0, 0.0, 0.4]), np.diag([0.1, 0.1, 0.05]), 0.0, 2.0)
    np.testing.assert_allclose(run.xhat[-1, 1], m, atol=1e-9)
    np.testing.assert_allclose(run.P[-1, 1], P, atol=1e-9)


def test_late_messages_are_predicted_by_f_with_the_input_of_their_time(folder):
    """A node that takes the estimates of another one as they are, 0.3 s old, has its prediction."""
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "periodic", "period": 0.4, "at": "directions"},
        "channel": {"delay": {"kind": "constant", "seconds": 0.3}},
    }
    changes = {"kind": "hybrid", "epsilon": 1.0, "mean": [[0.0, 0.0, 0.4], [1.0, 1.0, 0.0]]}
    sensor = {
        "nodes": [0],
        "H": [[1.0, 0, 0]],
        "R": [[1.0]],
        "sampling": {"kind": "periodic", "period": 9.0},
    }
    for method, tolerance in (("ekf", 1e-9), ("ckf", 1e-4)):
        filtering = changes | {"linearise": method}
        scenario = from_table(table(network=network, sensors=[sensor], filter=filtering), folder)
        run = netkf.simulate(scenario.replace({"probe": [0.65, 0.75, 1.2, 1.6]}))
        # Swapped with every message: what began at node 0 is at node 1 from 0.7 s on, and back.
        starts = np.array([[0.0, 0.0, 0.4], [1.0, 1.0, 0.0]])
        for k, (time, swapped) in enumerate([(0.65, 0), (0.75, 1), (1.2, 0), (1.6, 1)]):
            for node in (0, 1):
                origin = starts[node ^ swapped]
                m, P = integrate(origin, np.diag([0.1, 0.1, 0.05]), 0.0, time)
                np.testing.assert_allclose(run.P[k, node], P, atol=max(tolerance, 1e-9) * 300)
                if method == "ekf":
                    np.testing.assert_allclose(run.xhat[k, node], m, atol=tolerance)


@pytest.mark.parametrize("method", ["ukf", "ckf"])
def test_sigma_points_of_a_singular_covariance_are_those_of_one_close_by(folder, method):
    P, runs = np.array([[0.5, 0, 0.2], [0, 0, 0], [0.2, 0, 0.3]]), []
    for rest in (0.0, 1e-13):
        plant = table()["plant"] | {"cov": (P + rest * np.eye(3)).tolist()}
        filtering = {"kind": "local", "linearise": method}
        scenario = from_table(table(plant=plant, horizon=0.5, filter=filtering), folder)
        runs.append(netkf.simulate(scenario))
    np.testing.assert_allclose(runs[0].xhat[:, 1], runs[1].xhat[:, 1], atol=1e-9)
    np.testing.assert_allclose(runs[0].P[:, 1], runs[1].P[:, 1], atol=1e-9)


@pytest.mark.parametrize("method", ["ekf", "ukf", "ckf"])
def test_a_linear_f_is_the_diffusion(folder, method):
    class Linear:
        A = np.array([[0.0, 1.0], [-1.0, -0.3]])

        def f(self, x, u, t):
            return self.A @ x

        def jacobian(self, x, u, t):
            return self.A

    noise = [[0.0], [0.5]]
    sensor = {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.1]], "path": "z.csv", "kind": "recorded"}
    lines = [f"{0.17 * k!r},0,{math.sin(k)!r}" for k in range(1, 11)]
    (folder / "z.csv").write_text("t,node,y0\n" + "\n".join(lines) + "\n")
    # The noise changes between two steps.
    schedule = [{"from": 0.633, "B": [[0.2], [0.1]]}, {"from": 1.4, "B": [[0.0], [1.5]]}]
    plant = {"B": noise, "mean": [0.1, 0.2], "cov": np.eye(2).tolist(), "schedule": schedule}
    linear = {"kind": "diffusion", "A": Linear.A.tolist(), **plant}
    curved = {"kind": "nonlinear", "f": Linear(), "step": 0.01, **plant}
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "poisson", "rate": 3.0},
        "channel": {"delay": {"kind": "constant", "seconds": 0.05}},
    }
    filtering = {"kind": "hybrid", "epsilon": 0.4, "linearise": method}
    one, other = (
        netkf.simulate(
            from_table(table(plant=p, sensors=[sensor], network=network, filter=filtering), folder),
            engine="simpy",
        )
        for p in (linear, curved)
    )
    assert one.events.equals(other.events)
    np.testing.assert_allclose(other.xhat, one.xhat, atol=1e-8)
    np.testing.assert_allclose(other.P, one.P, atol=1e-8)


class Duffing:
    """A driven oscillator with a cubic spring."""

    def f(self, x, u, t):
        return np.array([x[1], x[0] - x[0] ** 3 - 0.2 * x[1] + 0.5 * math.cos(t)])

    def jacobian(self, x, u, t):
        return np.array([[0.0, 1.0], [1.0 - 3.0 * x[0] ** 2, -0.2]])


def coarser(noise: FloatArray) -> FloatArray:
    """The two moments of noise over pairs of steps, from those (K, 2, q) over each."""
    first, last = noise[::2], noise[1::2]
    plain = first[:, 0] + last[:, 0]
    tilted = 0.5 * (first[:, 1] + last[:, 1] + last[:, 0] - first[:, 0])
    return np.stack([plain, tilted], axis=1)


@pytest.mark.slow
def test_the_truth_is_of_order_three_halves_in_the_path():
    """Errors of the path at one time against steps that are 64 times shorter, for equal noise."""
    random, finest, levels = np.random.default_rng(1), 2.0**-10, range(7)
    plant = NonlinearDiffusion(f=Duffing(), B=[[0.0], [0.4]], step=1.0)
    errors = np.zeros((40, len(levels)))
    for run in range(40):
        steps = int(1.0 / finest)
        noise = random.standard_normal((steps, 2, 1)) * np.sqrt([[finest], [finest / 3.0]])
        ends = []
        for level in levels:
            h, x = finest * 2.0**level, np.array([0.5, 0.0])
            for k, one in enumerate(noise):
                x = plant.move(x, k * h, h, one)
            ends.append(x)
            noise = coarser(noise)
        errors[run] = [np.linalg.norm(x - ends[0]) for x in ends]
    rms = np.sqrt((errors[:, 3:] ** 2).mean(axis=0))
    orders = np.log2(rms[1:] / rms[:-1])
    assert (orders > 1.35).all(), orders
    assert orders.mean() < 2.2
    # Without noise the method is of order 2.
    still = NonlinearDiffusion(f=Duffing(), B=[[0.0], [0.0]], step=1.0)
    ends = []
    for count in (16, 32, 64, 4096):
        x = np.array([0.5, 0.0])
        for k in range(count):
            x = still.move(x, k / count, 1.0 / count, np.zeros((2, 1)))
        ends.append(x)
    gaps = [float(np.linalg.norm(x - ends[-1])) for x in ends[:-1]]
    assert 1.8 < math.log2(gaps[0] / gaps[1]) < 2.3
    assert 1.8 < math.log2(gaps[1] / gaps[2]) < 2.3


def test_states_do_not_depend_on_what_else_is_asked_for():
    plant = NonlinearDiffusion(f=Duffing(), B=[[0.1], [0.4]], step=0.1, cov=np.eye(2))
    times = np.array([0.05, 0.1, 0.13, 0.17, 0.4, 0.77])

    def states(sampled, probes):
        streams = Streams(3, 0)
        path = plant.curve(
            streams.generator("plant"),
            (sampled, streams.generator("samples")),
            (probes, streams.generator("probe")),
        )
        return {t: path.absolute(t) for t in (0.0, *sampled.tolist(), *probes.tolist())}

    alone = states(times, np.empty(0))
    with_probes = states(times, np.array([0.02, 0.1, 0.15, 0.3, 0.6]))
    for t in alone:
        np.testing.assert_array_equal(alone[t], with_probes[t])
    # At the ends of steps nothing else matters.
    grid = states(np.empty(0), np.array([0.1, 0.4]))
    np.testing.assert_array_equal(grid[0.4], alone[0.4])


@pytest.mark.slow
def test_noise_inside_steps_has_its_law(folder):
    """x(t) - x(0) of a Wiener process with steps of 1 s, at times inside the first two."""

    class Still:
        def f(self, x, u, t):
            return np.zeros(1)

        def jacobian(self, x, u, t):
            return np.zeros((1, 1))

    plant = NonlinearDiffusion(f=Still(), B=[[2.0]], step=1.0)
    sampled, probes = np.array([0.3, 0.8, 1.6]), np.array([0.1, 0.5, 1.0, 1.9])
    times = np.sort([*sampled, *probes])
    drawn = np.zeros((4000, len(times)))
    for run in range(len(drawn)):
        streams = Streams(9, run)
        plain, *inside = (streams.generator(name) for name in ("plant", "samples", "probe"))
        path = plant.curve(plain, (sampled, inside[0]), (probes, inside[1]))
        drawn[run] = [path.absolute(t)[0] for t in times.tolist()]
    increments = np.diff(drawn, axis=1, prepend=0.0) / np.sqrt(4.0 * np.diff(times, prepend=0.0))
    covariance = increments.T @ increments / len(drawn)
    np.testing.assert_allclose(covariance, np.eye(len(times)), atol=0.11)


class Still:
    def f(self, x, u, t):
        return np.zeros(1)

    def jacobian(self, x, u, t):
        return np.zeros((1, 1))


def test_noise_that_changes_has_the_law_of_each_piece():
    """The change is inside a step, a sample before it and one after it."""
    schedule = [{"from": 0.35, "B": [[3.0]]}]
    plant = NonlinearDiffusion(f=Still(), B=[[1.0]], step=0.1, schedule=schedule)
    times, drawn = np.array([0.33, 0.38, 0.8]), np.zeros((2000, 3))
    for run in range(len(drawn)):
        streams = Streams(run, 0)
        plain, *inside = (streams.generator(name) for name in ("plant", "samples", "probe"))
        path = plant.curve(plain, (times, inside[0]), (np.empty(0), inside[1]))
        drawn[run] = [path.absolute(t)[0] for t in times.tolist()]
    variances = np.array([0.33, 0.02 + 9.0 * 0.03, 9.0 * 0.42])
    increments = np.diff(drawn, axis=1, prepend=0.0) / np.sqrt(variances)
    np.testing.assert_allclose(increments.T @ increments / 2000, np.eye(3), atol=0.16)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"plant.step": -1.0}, "plant.step: must be a finite number above 0"),
        ({"plant.B": [[0.1, 0.0]]}, "plant.B: must have 3 rows, for x, y and heading"),
        ({"plant.A": [[1.0]]}, "plant.A: is not a key here"),
        ({"plant.Q": [[1.0]]}, "plant.Q: is not a key here"),
        (
            {"plant.schedule": [{"from": 1.0, "B": [[1.0], [0.0], [0.0]]}]},
            "plant.schedule[0].B: must be 3 x 3, not 3 x 1",
        ),
        (
            {"sensors": [{"nodes": [0], "H": [[1.0, 0.0, 0.0]], "R": [[1.0]]}]},
            "sensors[0].sampling: must be a clock, since increments of a nonlinear state",
        ),
        ({"filter": {"kind": "push-sum"}}, "filter.kind: must be a filter that uses dynamics in"),
        ({"plant.input": {"kind": "constant", "value": [1.0]}}, "plant.input: must have 2 comp"),
    ],
)
def test_mistakes_are_refused_in_one_line(folder, change, words):
    scenario = from_table(table(), folder)
    if "filter" in change:
        change = change | {"network.activation": {"kind": "poisson", "rate": 1.0, "at": "nodes"}}
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario.replace(change)
    assert words in str(caught.value)


TICKING = {"kind": "periodic", "period": 0.31}
DISTANCE = {
    "kind": "range", "nodes": [0], "positions": [[-1.0, 2.0]], "R": [[0.04]], "sampling": TICKING,
}  # fmt: skip
DIRECTION = {
    "kind": "range-bearing", "nodes": [0, 1], "positions": [[-1.0, 2.0], [2.0, -1.0]],
    "R": [[0.04, 0.01], [0.01, 0.02]], "sampling": TICKING,
}  # fmt: skip
ENTRY = {"nodes": [0], "H": [[1.0, 0.0, 0.0]], "R": [[0.3]], "sampling": TICKING}
LATE = {
    "graph": {"kind": "path", "nodes": 2},
    "activation": {"kind": "poisson", "rate": 4.0},
    "channel": {
        "loss": {"kind": "bernoulli", "delivery": 0.7},
        "delay": {"kind": "exponential", "mean": 0.1},
    },
}
ASKED = LATE | {"activation": {"kind": "readings"}}
MOVER = {
    "kind": "diffusion", "A": [[0.0, 1.0, 0.0], [0.0, -0.1, 0.0], [0.0, 0.0, -0.2]],
    "B": np.eye(3).tolist(), "cov": np.eye(3).tolist(),
    "input": {"kind": "sine", "G": [[0.0], [1.0], [1.0]], "amplitude": 2.0, "frequency": 0.5},
}  # fmt: skip


@kernel
def swing(x, u, t, out):
    out[0], out[1], out[2] = x[1], -math.sin(x[0]), math.cos(t) - x[2]


@kernel
def swing_jacobian(x, u, t, out):
    out[:] = 0.0
    out[0, 1], out[1, 0], out[2, 2] = 1.0, -math.cos(x[0]), -1.0


class Swing:
    kernels = (swing, swing_jacobian)


@dataclass(frozen=True, eq=False)
class Cubes(NonlinearSensor):
    """A user's sensor of two values, which fails on a node beyond 1."""

    def h(self, x, node):
        if node > 1:
            raise ValueError("no such node")
        return np.array([x[0] ** 3 + node, x[1] * x[2]])

    def jacobian(self, x, node):
        return np.array([[3.0 * x[0] ** 2, 0.0, 0.0], [0.0, x[2], x[1]]])


CUBES = Cubes(nodes=(0, 1), R=[[0.1, 0.05], [0.05, 0.2]], sampling=Periodic(period=0.2))
SWING = {"kind": "nonlinear", "f": Swing(), "step": 0.02, "B": (0.1 * np.eye(3)).tolist()}
COMPILED = {
    "several readings of an instant": {"sensors": [DISTANCE, DIRECTION, ENTRY], "network": LATE},
    "a linear plant with an input": {
        "sensors": [ENTRY, DIRECTION], "network": LATE, "plant": MOVER,
    },
    "readings that are sent": {
        "sensors": [DIRECTION | {"heading": 2}, ENTRY], "network": ASKED,
        "filter": {"kind": "intermittent"},
    },
    "kernels and sensors of users": {
        "plant": SWING, "network": LATE, "sensors": [DISTANCE], "custom": (CUBES,),
    },
    "noise that changes": {
        "sensors": [DISTANCE], "network": LATE,
        "plant": table()["plant"] | {
            "schedule": [{"from": 0.613, "B": np.diag([0.3, 0.2, 0.5]).tolist()}],
        },
    },
    "one filter of all nodes": {"sensors": [DIRECTION, DISTANCE], "filter": {"kind": "central"}},
}  # fmt: skip


@pytest.mark.one_in(5)
@pytest.mark.parametrize("method", ["ekf", "ukf", "ckf"])
@pytest.mark.parametrize("case", COMPILED)
def test_both_engines_agree(folder, case, method):
    """Where messages are late or lost, and predictions over parts of gaps are not those over the
    whole ones.
    """
    changes = {"filter": {"kind": "hybrid", "epsilon": 0.3}} | COMPILED[case]
    own = changes.pop("custom", ())
    changes["filter"] |= {"linearise": method}
    scenario = from_table(table(**changes), folder)
    if own:
        scenario = dataclasses.replace(scenario, sensors=scenario.sensors + own)
    run = assert_agree(scenario)
    assert run.status == "complete"
    if case == "several readings of an instant" and method == "ekf":
        batches = [
            netkf.monte_carlo(scenario, 2, workers=1, engine=engine)
            for engine in ("compiled", "simpy")
        ]
        np.testing.assert_allclose(batches[0].mean_P, batches[1].mean_P, rtol=1e-9)


class Unsloped(Cubes):
    """Readings are drawn without the Jacobian: only filters ask for it."""

    def h(self, x, node):
        return super().h(x, 0)

    def jacobian(self, x, node):
        raise ValueError("no such node")


@pytest.mark.parametrize(("cls", "verb"), [(Cubes, "h"), (Unsloped, "jacobian")])
def test_an_error_of_a_sensor_ends_the_run(folder, cls, verb):
    network = LATE | {"graph": {"kind": "path", "nodes": 3}}
    scenario = from_table(table(plant=SWING, network=network, sensors=[DISTANCE]), folder)
    own = cls(nodes=(2,), R=CUBES.R, sampling=CUBES.sampling)
    scenario = dataclasses.replace(scenario, sensors=(own,))
    with pytest.raises(netkf.EngineError, match=f"{cls.__name__} failed in {verb}: ValueError: no"):
        netkf.simulate(scenario, engine="compiled")
