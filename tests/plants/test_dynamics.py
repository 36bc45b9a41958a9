"""Dynamics that are not linear, against integration, high precision and plain recursions."""

import math
import subprocess
import sys
from pathlib import Path

import mpmath
import numpy as np
import pytest
import scipy.integrate

import netkf
from netkf.plants import motion
from netkf.plants.dynamics import MOTIONS, functions_of
from netkf.scenario.reading import from_table

ENGINES = ("simpy", "compiled")
START = {
    "unicycle": np.array([0.3, -0.2, 0.7]),
    "coordinated-turn": np.array([1.0, -2.0, 0.8, -0.4, 0.6]),
}
TURNS = (0.9, -2.3, 1e-3, 3e-6, 0.0)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("w", TURNS)
@pytest.mark.parametrize("name", MOTIONS)
def test_flows_are_those_of_the_rates(name, w):
    x, u = START[name].copy(), np.array([1.3, w])[: MOTIONS[name].m]
    if name == "coordinated-turn":
        x[4] = w
    n, period = len(x), 0.8
    flow, jacobian = functions_of(name, n, len(u), in_slots=True)
    rate, _ = functions_of(name, n, len(u), in_slots=False)
    solved = scipy.integrate.solve_ivp(
        lambda _, y: rate(y, u, 0.0, 0.0), (0.0, period), x, rtol=1e-12, atol=1e-13
    )
    np.testing.assert_allclose(flow(x, u, 0.0, period), solved.y[:, -1], atol=1e-11)
    step = 1e-6
    for function, slope in ((flow, jacobian), functions_of(name, n, len(u), in_slots=False)):
        columns = [
            (function(x + d, u, 0.0, period) - function(x - d, u, 0.0, period)) / (2.0 * step)
            for d in step * np.eye(n)
        ]
        np.testing.assert_allclose(slope(x, u, 0.0, period), np.array(columns).T, atol=1e-8)


@pytest.mark.parametrize("a", [0.0, 1e-9, 1e-5, 9.9e-5, 1.01e-4, 1e-2, 0.2499, 0.2501, 2.0, -0.1])
def test_small_turns_keep_their_digits(a):
    """Against 50 digits; the formulas with 1 / w lose half of the digits of a double."""
    period, v, h = 0.5, 1.7, 0.4
    w = a / period
    with mpmath.workdps(50):
        ma, mp, mv, mh = mpmath.mpf(w) * mpmath.mpf(period), *map(mpmath.mpf, (period, v, h))
        along, aside = mp, mpmath.mpf(0)
        if a:
            along, aside = mp * mpmath.sin(ma) / ma, mp * (1 - mpmath.cos(ma)) / ma
        x = mv * (along * mpmath.cos(mh) - aside * mpmath.sin(mh))
        y = mv * (along * mpmath.sin(mh) + aside * mpmath.cos(mh))
        slopes = [mpmath.mpf(0), mp * mp / 2]
        if a:
            slopes = [
                mp * mp * (ma * mpmath.cos(ma) - mpmath.sin(ma)) / ma**2,
                mp * mp * (ma * mpmath.sin(ma) - 1 + mpmath.cos(ma)) / ma**2,
            ]
        expected = [float(x), float(y)], [float(along), float(aside)], [float(s) for s in slopes]
    out = np.zeros(3)
    motion.move_unicycle(np.array([0.0, 0.0, h]), np.array([v, w]), 0.0, period, out)
    found = out[:2], motion.turn_integrals(w, period), motion.turn_slopes(w, period)
    for got, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=2e-13, atol=1e-300)


ANCHORS = [[-2.0, -1.0], [3.0, 2.0]]
R_SEEN = np.diag([0.04, 0.01])
Q_UNICYCLE = np.diag([1e-3, 1e-3, 4e-4])
U_ROWS = "t,u0,u1\n0,1,0\n0.5,1.2,0.9\n1.5,0.8,-0.6\n2.3,1.5,1e-7\n"


def u_at(t):
    rows = [(0.0, 1.0, 0.0), (0.5, 1.2, 0.9), (1.5, 0.8, -0.6), (2.3, 1.5, 1e-7)]
    return next(np.array(row[1:]) for row in reversed(rows) if row[0] <= t + 1e-12)


def arc(x, u, T):
    """The unicycle over T seconds, written plainly, and its Jacobian."""
    v, w = u
    h = x[2]
    if abs(w * T) < 1e-6:
        dx, dy = v * T * math.cos(h + w * T / 2), v * T * math.sin(h + w * T / 2)
    else:
        dx = v / w * (math.sin(h + w * T) - math.sin(h))
        dy = v / w * (math.cos(h) - math.cos(h + w * T))
    J = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    return x + np.array([dx, dy, w * T]), J


def sight(x, anchor):
    """Range and bearing of the unicycle from an anchor, and the Jacobian."""
    d = x[:2] - anchor
    r2 = d @ d
    r = math.sqrt(r2)
    H = np.array([[d[0] / r, d[1] / r, 0.0], [-d[1] / r2, d[0] / r2, 0.0]])
    return np.array([r, math.atan2(d[1], d[0])]), H


def wrapped(innovation):
    innovation[-1] = (innovation[-1] + math.pi) % (2 * math.pi) - math.pi
    return innovation


@pytest.fixture
def pair(tmp_path):
    """Two nodes that see a unicycle; what they read is recorded, with rows and values missing."""
    random = np.random.default_rng(5)
    x, lines, readings = np.array([0.1, -0.1, 2.9]), ["t,node,y0,y1"], {}
    for k in range(1, 31):
        x = arc(x, u_at(0.1 * (k - 1)), 0.1)[0] + 0.02 * random.standard_normal(3)
        for node in (0, 1):
            y = sight(x, ANCHORS[node])[0] + np.array([0.2, 0.1]) * random.standard_normal(2)
            y[1] = (y[1] + math.pi) % (2 * math.pi) - math.pi
            y[random.random(2) < 0.1] = np.nan
            if np.isfinite(y).any():
                readings[k, node] = y
                lines.append(
                    f"{k / 10!r},{node}," + ",".join("" if v != v else repr(float(v)) for v in y)
                )
    (tmp_path / "sights.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "u.csv").write_text(U_ROWS)
    table = {
        "format": 1,
        "name": "unicycle",
        "horizon": 3.0,
        "probe": 0.1,
        "plant": {
            "kind": "nonlinear",
            "f": "unicycle",
            "period": 0.1,
            "Q": Q_UNICYCLE.tolist(),
            "mean": [0.0, 0.0, 3.0],
            "cov": np.diag([0.1, 0.1, 0.05]).tolist(),
            "input": {"kind": "recorded", "path": "u.csv"},
        },
        "sensors": [
            {
                "kind": "range-bearing",
                "path": "sights.csv",
                "positions": ANCHORS,
                "R": R_SEEN.tolist(),
            }
        ],
        "network": {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        "filter": {"kind": "local"},
    }
    return from_table(table, tmp_path), readings


def plain_ekf(readings, nodes, slots=30):
    """Yield xhat and P of an extended Kalman filter on the readings of these nodes."""
    x, P = np.array([0.0, 0.0, 3.0]), np.diag([0.1, 0.1, 0.05])
    yield x, P
    for k in range(1, slots + 1):
        x, J = arc(x, u_at(0.1 * (k - 1)), 0.1)
        P = J @ P @ J.T + Q_UNICYCLE
        parts = [(readings[k, i], *sight(x, ANCHORS[i])) for i in nodes if (k, i) in readings]
        if parts:
            y = np.concatenate([p[0] for p in parts])
            H = np.concatenate([p[2] for p in parts])
            there = np.isfinite(y)
            v = np.concatenate([wrapped(p[0] - p[1]) for p in parts])[there]
            H, R = H[there], np.kron(np.eye(len(parts)), R_SEEN)[np.ix_(there, there)]
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            x, P = x + K @ v, (np.eye(3) - K @ H) @ P
        yield x, P


@pytest.mark.parametrize("engine", ENGINES)
def test_unicycle_with_ranges_and_bearings_is_a_plain_ekf(pair, engine):
    scenario, readings = pair
    run = netkf.simulate(scenario, engine=engine)
    for i, expected in enumerate([plain_ekf(readings, [0]), plain_ekf(readings, [1])]):
        for k, (x, P) in enumerate(expected):
            np.testing.assert_allclose(run.xhat[k, i], x, atol=1e-10)
            np.testing.assert_allclose(run.P[k, i], P, atol=1e-10)
    central = netkf.simulate(scenario.replace({"filter": {"kind": "central"}}), engine=engine)
    for k, (x, P) in enumerate(plain_ekf(readings, [0, 1])):
        np.testing.assert_allclose(central.xhat[k, 0], x, atol=1e-10)
        np.testing.assert_allclose(central.P[k, 0], P, atol=1e-10)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["hcmci", "intermittent"])
def test_networks_of_filters_are_the_same_in_both_engines(pair, kind):
    scenario, _ = pair
    changes = {
        "filter": {"kind": kind} | ({"steps": 2} if kind == "hcmci" else {}),
        "network.channel": {"loss": {"kind": "bernoulli", "delivery": 0.6}},
    }
    scenario = scenario.replace(changes)
    for method in ("ekf", "ckf"):
        one, other = (
            netkf.simulate(scenario.replace({"filter.linearise": method}), engine=e)
            for e in ENGINES
        )
        assert one.events.equals(other.events)
        np.testing.assert_allclose(one.xhat, other.xhat, atol=1e-10)
        np.testing.assert_allclose(one.P, other.P, atol=1e-10)


def test_rows_keep_the_order_of_the_sensors(pair):
    """The bits of the one-bit filter are of one row after the other."""
    scenario, _ = pair
    near = {"kind": "range", "nodes": [0], "positions": ANCHORS[:1], "R": [[0.04]]}
    straight = {"nodes": [0], "H": [[1.0, 0.0, 0.0]], "R": [[0.1]]}
    changes = {"sensors": [near, straight, near], "filter": {"kind": "one-bit", "linearise": "ckf"}}
    one, other = (netkf.simulate(scenario.replace(changes), engine=e) for e in ENGINES)
    np.testing.assert_allclose(one.xhat, other.xhat, atol=1e-10)


def sigma_points(x, P, method):
    """Points and weights of mean and covariance, as the papers have them."""
    n = len(x)
    S = np.linalg.cholesky(P)
    if method == "ckf":
        points = [x + math.sqrt(n) * s for s in (*S.T, *-S.T)]
        return points, np.full(2 * n, 0.5 / n), np.full(2 * n, 0.5 / n)
    alpha, beta, kappa = 1.0, 2.0, 0.0
    lam = alpha**2 * (n + kappa) - n
    points = [x, *(x + math.sqrt(n + lam) * s for s in (*S.T, *-S.T))]
    mean = np.full(2 * n + 1, 0.5 / (n + lam))
    mean[0] = lam / (n + lam)
    cov = mean.copy()
    cov[0] += 1.0 - alpha**2 + beta
    return points, mean, cov


def moments(points, wm, wc, function, wrap=lambda d: d):
    """Mean, covariance, and the deviations of a function of sigma points."""
    values = np.array([function(p) for p in points])
    # Angles are averaged as differences from the first.
    near = values[0] + np.array([wrap(v - values[0]) for v in values])
    mean = wm @ near
    deviations = np.array([wrap(v - mean) for v in near])
    return mean, (wc[:, None] * deviations).T @ deviations, deviations


@pytest.mark.parametrize("method", ["ukf", "ckf"])
@pytest.mark.parametrize("engine", ENGINES)
def test_sigma_points_are_those_of_the_papers(pair, method, engine):
    scenario, readings = pair
    run = netkf.simulate(scenario.replace({"filter.linearise": method}), engine=engine)
    x, P = np.array([0.0, 0.0, 3.0]), np.diag([0.1, 0.1, 0.05])
    for k in range(1, 31):
        u = u_at(0.1 * (k - 1))
        x, P, _ = moments(*sigma_points(x, P, method), lambda p, u=u: arc(p, u, 0.1)[0])
        P = P + Q_UNICYCLE
        if (k, 0) in readings:
            y = readings[k, 0]
            there = np.isfinite(y)
            points, wm, wc = sigma_points(x, P, method)
            turn = wrapped if there[1] else (lambda d: d)
            mean, S, deviations = moments(
                points, wm, wc, lambda p, t=there: sight(p, ANCHORS[0])[0][t], turn
            )
            S += R_SEEN[np.ix_(there, there)]
            cross = (wc[:, None] * (np.array(points) - x)).T @ deviations
            K = cross @ np.linalg.inv(S)
            x, P = x + K @ turn(y[there] - mean), P - K @ S @ K.T
        np.testing.assert_allclose(run.xhat[k, 0], x, atol=1e-10)
        np.testing.assert_allclose(run.P[k, 0], P, atol=1e-10)


@pytest.mark.parametrize("method", ["ukf", "ckf"])
def test_sigma_points_of_a_singular_covariance(tmp_path, method):
    """Those of the Cholesky factor, where a state is known and others follow it."""
    F, R, anchor = np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0], [-0.1, 0.3, 1.0]]), 0.01, [-0.3, 0.1]
    rows = "".join(f"{k}.0,0,{1.0 + 0.1 * k}\n" for k in range(1, 5))
    (tmp_path / "y.csv").write_text(f"t,node,y0\n{rows}")
    mean, P = np.array([1.0, 0.5, 0.3]), np.array([[0.5, 0, 0.2], [0, 0, 0], [0.2, 0, 0.3]])
    plant = {"kind": "linear", "F": F.tolist(), "Q": np.zeros((3, 3)).tolist(), "period": 1.0}
    sensor = {"kind": "range", "path": "y.csv", "positions": [anchor], "states": [1, 2]}
    table = {
        "format": 1, "name": "known", "horizon": 5.0, "probe": 1.0,
        "plant": plant | {"mean": mean.tolist(), "cov": P.tolist()},
        "sensors": [sensor | {"R": [[R]]}],
        "network": {"graph": {"kind": "edges", "edges": [], "nodes": 1}},
        "filter": {"kind": "local", "linearise": method},
    }  # fmt: skip
    runs = [netkf.simulate(from_table(table, tmp_path), engine=engine) for engine in ENGINES]
    for k in range(1, 5):
        mean, P = F @ mean, F @ P @ F.T
        points, wm, wc = sigma_points(mean, P + 1e-14 * np.eye(3), method)
        expected, S, deviations = moments(
            points, wm, wc, lambda p: np.array([math.hypot(*(p[1:] - anchor))])
        )
        cross = (wc[:, None] * (np.array(points) - mean)).T @ deviations
        K = cross / (S + R)
        mean, P = mean + K @ (1.0 + 0.1 * k - expected), P - K @ (S + R) @ K.T
        for run in runs:
            np.testing.assert_allclose(run.xhat[k, 0], mean, atol=1e-9)
            np.testing.assert_allclose(run.P[k, 0], P, atol=1e-9)


MODULE = """
import math
import numpy as np
from netkf.kernels import kernel

F = np.array([[1.0, 0.1], [-0.02, 0.97]])


class Linear:
    def f(self, x, u, t):
        return F @ x

    def jacobian(self, x, u, t):
        return F


class Swing:
    def f(self, x, u, t):
        return np.array([x[0] + 0.1 * x[1], x[1] - 0.1 * math.sin(x[0]) + 0.1 * u[0] * math.cos(t)])

    def jacobian(self, x, u, t):
        return np.array([[1.0, 0.1], [-0.1 * math.cos(x[0]), 1.0]])


@kernel
def swing(x, u, t, out):
    out[0] = x[0] + 0.1 * x[1]
    out[1] = x[1] - 0.1 * math.sin(x[0]) + 0.1 * u[0] * math.cos(t)


@kernel
def swing_jacobian(x, u, t, out):
    out[0, 0], out[0, 1] = 1.0, 0.1
    out[1, 0], out[1, 1] = -0.1 * math.cos(x[0]), 1.0


class KernelSwing:
    kernels = (swing, swing_jacobian)


class Late(Swing):
    def f(self, x, u, t):
        if t > 1.0:
            raise ValueError("t is beyond the table")
        return super().f(x, u, t)


class Flat(Swing):
    def f(self, x, u, t):
        return super().f(x, u, t)[:1]


class Imaginary(Swing):
    def f(self, x, u, t):
        return super().f(x, u, t) + 1j


class Half:
    def f(self, x, u, t):
        return x
"""


@pytest.fixture
def custom(tmp_path):
    """A scenario with a user's dynamics beside it, in files."""
    (tmp_path / "swings.py").write_text(MODULE)
    (tmp_path / "swing.toml").write_text(
        """
format = 1
name = "swing"
horizon = 2.0
probe = 0.1
seed = 3
[plant]
kind = "nonlinear"
f = "swings:Swing"
period = 0.1
Q = [[1e-4, 0.0], [0.0, 1e-3]]
mean = [0.4, 1.0]
cov = [[0.1, 0.0], [0.0, 0.1]]
input = { kind = "sine", amplitude = 0.5, frequency = 0.7 }
[[sensors]]
nodes = [0, 2]
H = [[1.0, 0.0]]
R = [[0.05]]
[network]
graph = { kind = "path", nodes = 3 }
activation = { kind = "broadcast" }
channel = { loss = { kind = "bernoulli", delivery = 0.7 } }
[filter]
kind = "diffusion"
"""
    )
    return tmp_path / "swing.toml"


LINEAR = {
    "plant": {
        "kind": "linear",
        "F": [[1.0, 0.1], [-0.02, 0.97]],
        "Q": [[1e-4, 0.0], [0.0, 1e-3]],
        "period": 0.1,
        "mean": [0.4, 1.0],
        "cov": [[0.1, 0.0], [0.0, 0.1]],
    }
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("engine", ENGINES)
def test_a_linear_f_is_the_linear_plant(custom, engine):
    """To the bit with the extended Kalman filter, else to rounding; both engines call Python. The
    noise changes twice.
    """
    swing = netkf.load(custom)
    noises = [[[0.01, 0.005], [0.005, 0.04]], [[0.0, 0.0], [0.0, 1e-3]]]
    schedule = [{"from": 0.5 * k + 0.5, "Q": Q} for k, Q in enumerate(noises)]
    plant = {**LINEAR["plant"], "schedule": schedule}
    linear = netkf.simulate(swing.replace({"plant": plant}), engine=engine)
    nonlinear = {**plant, "kind": "nonlinear", "f": "swings:Linear"}
    del nonlinear["F"]
    scenario = swing.replace({"plant": nonlinear})
    for method, tolerance in (("ekf", 0.0), ("ukf", 1e-13), ("ckf", 1e-13)):
        run = netkf.simulate(scenario.replace({"filter.linearise": method}), engine=engine)
        np.testing.assert_array_equal(run.x, linear.x)
        np.testing.assert_allclose(run.xhat, linear.xhat, rtol=0.0, atol=tolerance)
        np.testing.assert_allclose(run.P, linear.P, rtol=0.0, atol=tolerance)
    # Filters that do not know it believe the first noise.
    del nonlinear["schedule"]
    unaware = netkf.simulate(scenario.replace({"filter.model.schedule": False}), engine=engine)
    steady = netkf.simulate(scenario.replace({"plant": nonlinear}), engine=engine)
    np.testing.assert_array_equal(unaware.x, linear.x)
    np.testing.assert_array_equal(unaware.P, steady.P)
    assert not scenario.replace({"filter.model.schedule": False}).filters_know_the_truth
    assert scenario.filters_know_the_truth


def test_a_users_f_moves_the_first_block(custom):
    """Before its module is imported too, when it is not known yet whether there are slots."""
    alone = netkf.load(custom)
    text = custom.read_text().replace("[plant]", '[[plants]]\nname = "swing"')
    custom.write_text(text.replace("swings:Swing", "others:Swing"))
    (custom.parent / "others.py").write_text(MODULE)
    run, alone = netkf.simulate(netkf.load(custom)), netkf.simulate(alone)
    np.testing.assert_array_equal(run.xhat, alone.xhat)


def test_a_users_f_runs_as_python_and_as_kernel(custom):
    python = netkf.load(custom)
    kernels = netkf.load(custom, {"plant.f": "swings:KernelSwing"})
    runs = [netkf.simulate(s, engine=e) for s in (python, kernels) for e in ENGINES]
    for run in runs[1:]:
        assert run.events.equals(runs[0].events)
        for name in ("x", "xhat", "P"):
            np.testing.assert_allclose(getattr(run, name), getattr(runs[0], name), atol=1e-12)
    u = python.plant.input.values(0.1 * np.arange(20))
    x = runs[0].x
    noise = [x[k + 1] - python.plant.f.part.f(x[k], u[k], 0.1 * k) for k in range(20)]
    assert 0.3 < np.mean(np.square(noise) / [1e-4, 1e-3]) < 2.0
    assert netkf.simulate(python, engine="compiled").status == "complete"


def run_netkf(file, *arguments):
    command = [sys.executable, "-m", "netkf", *arguments]
    return subprocess.run(
        command, cwd=Path(file).parent, capture_output=True, text=True, check=False, timeout=120
    )


@pytest.mark.slow
def test_modules_need_trust_and_travel_with_the_run(custom):
    refused = run_netkf(custom, "run", custom.name)
    assert refused.returncode == 2
    assert len(refused.stderr.splitlines()) == 1
    assert "plant.f: names a class of a module" in refused.stderr
    assert "--trust" in refused.stderr
    done = run_netkf(custom, "run", custom.name, "--trust", "--out", "one")
    assert done.returncode == 0, done.stderr
    assert (custom.parent / "one" / "swings.py").is_file()
    again = run_netkf(custom, "run", "one/scenario.toml", "--trust", "--out", "two")
    assert again.returncode == 0, again.stderr
    states = [(custom.parent / name / "states.parquet").read_bytes() for name in ("one", "two")]
    assert states[0] == states[1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"plant.f": "bicycle"}, 'plant.f: must be one of "unicycle", "coordinated-turn"'),
        ({"plant.f": "swings:Half"}, "plant.f: must have a method jacobian(x, u, t)"),
        ({"plant.f": "swings:Nobody"}, "plant.f: could not be imported"),
        ({"plant.f": "swings:Imaginary"}, "plant.f: f failed at plant.mean (TypeError: no real n"),
        ({"plant.f": "swings:Flat"}, "plant.f: f failed at plant.mean (ValueError: returned shape"),
        ({"plant.f": "unicycle"}, "plant.Q: must have 3 rows, for x, y and heading"),
        ({"plant.f": "coordinated-turn"}, "plant.Q: must have 5 rows"),
        ({"plant.input": {"kind": "constant", "value": 1.0, "G": [[1.0], [0.0]]}}, "plant.input.G"),
        ({"plant.Q": [[1.0, 2.0], [2.0, 1.0]]}, "plant.Q: must be positive semidefinite"),
        ({"plant.mean": [1.0]}, "plant.mean: must be 2, not 1"),
        ({"plant.schedule": [{"from": 0.5, "Q": [[1.0]]}]}, "schedule[0].Q: must be 2 x 2, not"),
        ({"plant.schedule": [{"from": 0.5, "F": [[1.0]]}]}, "schedule[0].F: is not a key here"),
        ({"plant.schedule": [{"from": 0.55, "Q": np.eye(2).tolist()}]}, "schedule[0].from: must"),
        ({"filter.linearise": "iekf"}, 'filter.linearise: must be one of "ekf", "ukf", "ckf"'),
        ({"filter.model": {"F": [[1.0, 0.0], [0.0, 1.0]]}}, "filter.model.F: means nothing"),
        (
            {"filter": {"kind": "push-sum", "gamma": 2, "delta": 5.0}},
            "filter.kind: must be a filter that uses dynamics in predictions only; the push-sum",
        ),
    ],
)
def test_mistakes_are_refused_in_one_line(custom, changes, words):
    with pytest.raises(netkf.ScenarioError) as caught:
        netkf.load(custom, changes)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("plant", "words"),
    [
        ({"f": "unicycle", "n": 3}, "plant.input: is missing: it must have 2 components"),
        (
            {"f": "unicycle", "n": 3, "input": {"kind": "constant", "value": 1.0}},
            "plant.input: must have 2 components for",
        ),
        (
            {"f": "coordinated-turn", "n": 5, "input": {"kind": "constant", "value": 1.0}},
            'plant.input: means nothing with "coordinated-turn"',
        ),
    ],
)
def test_inputs_fit_the_motion(custom, plant, words):
    n = plant.pop("n")
    table = {"kind": "nonlinear", "period": 0.1, "Q": np.eye(n).tolist(), **plant}
    sensors = [{"nodes": [0], "H": np.eye(n)[:1].tolist(), "R": [[1.0]]}]
    with pytest.raises(netkf.ScenarioError) as caught:
        netkf.load(custom, {"plant": table, "sensors": sensors})
    assert words in str(caught.value)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("engine", ENGINES)
def test_an_error_of_a_users_f_names_its_line(custom, engine):
    scenario = netkf.load(custom, {"plant.f": "swings:Late"})
    with pytest.raises(Exception, match="t is beyond the table"):
        netkf.simulate(scenario, engine=engine)
    done = run_netkf(
        custom, "run", custom.name, "--trust", "--set", "plant.f=swings:Late", "--engine", engine
    )
    assert "Late failed in f: ValueError: t is beyond the table; swings.py, line" in done.stderr


def test_what_linear_theory_cannot_promise_is_said(custom):
    scenario = netkf.load(custom)
    table = netkf.theory.assumptions(scenario)
    assert table.iloc[0].tolist()[:3] == ["dynamics are linear in the state", "all papers", False]
    run = netkf.simulate(scenario)
    with pytest.raises(netkf.TheoryError, match="dynamics are not linear"):
        netkf.theory.error_covariance(scenario, run)
    with pytest.raises(netkf.TheoryError, match="dynamics are not linear"):
        netkf.theory.central_covariance(scenario)
    found = netkf.consistency(scenario, 10, workers=1)
    assert all("the expected NEES is unknown" in row.verdict for row in found.rows)
    verdict = netkf.check(scenario, runs=10, workers=1)
    first = verdict.table[verdict.table["promise"] == "P and errors follow the equations"]
    assert first["verdict"].tolist() == ["not promised"]
    assert bool(verdict)


class Pendulum:
    def f(self, x, u, t):
        return np.array([x[0] + 0.1 * x[1], x[1] - 0.1 * math.sin(x[0])])

    def jacobian(self, x, u, t):
        return np.array([[1.0, 0.1], [-0.1 * math.cos(x[0]), 1.0]])


class WrongSlope(Pendulum):
    def jacobian(self, x, u, t):
        return np.array([[1.0, 0.1], [-0.1, 1.0]])


class NoSlope(Pendulum):
    def jacobian(self, x, u, t):
        return np.array([[1.0, 0.1], [math.nan, 1.0]])


class Forgetful(Pendulum):
    def __init__(self):
        self.calls = 0

    def f(self, x, u, t):
        self.calls += 1
        return super().f(x, u, t) + 1e-9 * self.calls


class Weighted(Pendulum):
    def __init__(self, weight=1.0):
        self.weight, self.calls = weight, 0

    def f(self, x, u, t):
        self.calls += 1
        return self.weight * super().f(x, u, t)


def test_an_object_stays_and_what_its_class_alone_does_not_give_is_not_saved(custom, tmp_path):
    scenario = netkf.load(custom, {"plant.f": Weighted(0.5)})
    for same in (scenario.replace({"seed": 5}), scenario.replace({"plant.states": ["a", "b"]})):
        assert same.plant.f.part.weight == 0.5
    with pytest.raises(netkf.ScenarioError, match="was made with arguments"):
        netkf.save(netkf.simulate(scenario), scenario, tmp_path / "out")
    scenario = scenario.replace({"plant.f": Weighted()})
    assert netkf.save(netkf.simulate(scenario), scenario, tmp_path / "out").is_dir()


def test_check_plant_holds_f_to_its_word():
    def plant(f):
        settings = {"Q": np.diag([1e-4, 1e-3]), "period": 0.1, "cov": 0.1 * np.eye(2)}
        return netkf.parts.NonlinearPlant(f=f, **settings)

    netkf.testing.check_plant(plant(Pendulum))
    netkf.testing.check_plant(plant(Pendulum()))
    for cls, words in (
        (WrongSlope, "WrongSlope.jacobian: must be the derivatives of f; got entry [1, 0] off by"),
        (NoSlope, "NoSlope.jacobian: must be finite"),
        (Forgetful, "Forgetful.f: must be the same for equal x, u and t"),
    ):
        with pytest.raises(AssertionError) as caught:
            netkf.testing.check_plant(plant(cls))
        assert words in str(caught.value)
    u = netkf.parts.ConstantInput(value=[1.0, 0.5])
    netkf.testing.check_plant(
        netkf.parts.NonlinearPlant(f="unicycle", Q=0.01 * np.eye(3), period=0.1, input=u)
    )
    netkf.testing.check_plant(
        netkf.parts.NonlinearDiffusion(f="unicycle", B=0.1 * np.eye(3), step=0.05, input=u)
    )
    with pytest.raises(AssertionError, match="must be the derivatives of f"):
        netkf.testing.check_plant(
            netkf.parts.NonlinearDiffusion(f=WrongSlope, B=np.eye(2), step=0.1)
        )


class Strength(netkf.parts.NonlinearSensor):
    """The logarithm of the distance from the node, and a direction that is an angle."""

    def h(self, x, node):
        d = x[:2] - ANCHORS[node]
        return np.array([math.log1p(d @ d), math.atan2(d[1], d[0])])

    def jacobian(self, x, node):
        d = x[:2] - ANCHORS[node]
        r2 = d @ d
        J = np.zeros((2, 3))
        J[0, :2], J[1, :2] = 2.0 * d / (1.0 + r2), np.array([-d[1], d[0]]) / r2
        return J

    def difference(self, y, expected):
        return wrapped(y - expected)


@pytest.mark.parametrize("method", ["ekf", "ukf"])
def test_a_users_sensor_is_read_alike_by_both_engines(pair, method):
    scenario, _ = pair
    sensor = Strength(nodes=(0, 1), R=R_SEEN)
    changes = {"sensors": [sensor], "filter": {"kind": "central", "linearise": method}}
    runs = [netkf.simulate(scenario.replace(changes), engine=engine) for engine in ENGINES]
    for name in ("x", "xhat", "P"):
        np.testing.assert_allclose(getattr(runs[0], name), getattr(runs[1], name), atol=1e-10)
    assert np.abs(runs[0].error[10:]).max() < 1.0


class Climb:
    """A motion, and below a sensor, that fails for states above 1/2, or below."""

    def __init__(self, fails):
        self.fails = fails

    def f(self, x, u, t):
        return x + 0.2 + in_range(x, self.fails)

    def jacobian(self, x, u, t):
        return np.eye(1)


class Shown(netkf.parts.NonlinearSensor):
    fails = None

    def h(self, x, node):
        return x + in_range(x, Shown.fails)

    def jacobian(self, x, node):
        return np.eye(1)


def in_range(x, fails):
    if fails is not None and (x[0] > 0.5) == (fails == "truth"):
        raise ValueError("out of range")
    return 0.0


@pytest.mark.parametrize("fails", ["truth", "filter"])
@pytest.mark.parametrize("name", ["f", "h"])
def test_errors_at_the_truth_or_at_estimates_alone_end_the_run(name, fails, tmp_path, monkeypatch):
    """The truth comes to be above 1/2, or is there; the estimate, which is sure, stays below."""
    monkeypatch.setattr(Shown, "fails", fails if name == "h" else None)
    f = Climb(fails if name == "f" else None)
    table = {
        "format": 1, "name": "climb", "horizon": 5.0, "probe": 1.0,
        "plant": {
            "kind": "nonlinear", "f": f, "period": 1.0, "Q": [[1e-12]],
            "mean": [float(fails != "truth")], "cov": [[1e-12]],
        },
        "sensors": [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}],
        "network": {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        "filter": {"kind": "local", "mean": [-5.0]},
    }  # fmt: skip
    scenario = from_table(table, tmp_path).replace({"sensors": [Shown(nodes=(0,), R=[[1.0]])]})
    for engine in ENGINES:
        with pytest.raises(netkf.NetkfError, match=f"failed in {name}: ValueError: out of range"):
            netkf.simulate(scenario, engine=engine)
