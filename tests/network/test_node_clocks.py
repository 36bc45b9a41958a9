"""Clocks of nodes that are wrong: ticks, stamps, and what filters make of them."""

import bisect
import functools
import itertools

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import netkf
from netkf.core.errors import ScenarioError
from netkf.core.instants import TimeGrid
from netkf.network.clocks import Periodic, Poisson
from netkf.network.node_clocks import NodeTime, node_time
from netkf.rng.streams import Streams
from netkf.theory.errors import error_law
from netkf.trace.schema import CODES

# Without noise estimates are a linear map of x(0), which a plain recursion gives to rounding.
SCENARIO = """
format = 1
name = "clocks"
horizon = {horizon}
probe = 0.25
[plant]
kind = "diffusion"
A = [[0.2, 1.0], [-1.0, -0.1]]
B = [[0.0, 0.0], [0.0, 0.0]]
mean = [2.0, -3.0]
[[sensors]]
nodes = [0, 1, 2]
H = [[1.0, 0.0]]
R = [[1e-22]]
sampling = {{ kind = "periodic", period = 0.5 }}
[network]
graph = {{ kind = "path", nodes = 3 }}
activation = {{ kind = "periodic", period = 0.3, at = "{at}" }}
{clocks}
[network.channel]
delay = {{ kind = "constant", seconds = {delay} }}
[filter]
kind = "{filter}"
mean = [0.5, 0.0]
cov = [[1.0, 0.2], [0.2, 2.0]]
[filter.model]
B = [[0.2, 0.0], [0.0, 1.0]]
R = [[0.3]]
"""
CLOCKS = """[[network.clocks]]
nodes = [1]
offset = 0.17
drift = 0.01
[[network.clocks]]
nodes = [2]
offset = -0.08
drift = -0.02
"""
PERIODIC = {"kind": "periodic", "period": 0.5}
OFFSET, DRIFT = (0.0, 0.17, -0.08), (0.0, 0.01, -0.02)
A, BB = np.array([[0.2, 1.0], [-1.0, -0.1]]), np.diag([0.04, 1.0])
H, R = np.array([[1.0, 0.0]]), np.array([[0.3]])


@pytest.fixture
def scenario_of(tmp_path):
    def make(clocks=CLOCKS, filter_="hybrid", at="nodes", delay=0.1, horizon=6.0):
        path = tmp_path / "clocks.toml"
        text = SCENARIO.format(clocks=clocks, filter=filter_, at=at, delay=delay, horizon=horizon)
        if filter_ in ("hybrid", "covariance-intersection"):
            text = text.replace("mean = [0.5", "epsilon = 0.3\nmean = [0.5")
        path.write_text(text)
        return netkf.load(path)

    return make


def predict(x, P, gap):
    nested = np.block([[-A, BB], [np.zeros((2, 2)), A.T]])
    big = scipy.linalg.expm(nested * gap)
    F = big[2:, 2:].T
    return F @ x, F @ P @ F.T + F @ big[:2, 2:]


def local_lattice(node, period, horizon):
    """All times in (0, horizon) at which the clock of a node shows a multiple of the period, but 0
    of a clock that shows 0 at the start.
    """
    k = np.arange(-100, 1000)
    t = (k * period - OFFSET[node]) / (1.0 + DRIFT[node])
    return [float(one) for one in t if 1e-9 < one < horizon - 1e-9]


def undriven(x, P, start, gap):
    return predict(x, P, gap)


def plain_run(times, horizon, delay, move=undriven):
    """Estimates and covariances (T, 3, n) of the hybrid filter whose nodes measure time, and the
    age of messages, by their own clocks; ``move`` predicts from a time on over a gap.
    """
    truth = lambda t: move(np.array([2.0, -3.0]), np.zeros((2, 2)), 0.0, t)[0]  # noqa: E731
    shows = lambda node, t: OFFSET[node] + (1.0 + DRIFT[node]) * t  # noqa: E731
    neighbours = {0: [1], 1: [0, 2], 2: [1]}
    events = [(t, 4, "probe", 0, None) for t in times]
    for i in range(3):
        events += [(t, 0, "sample", i, None) for t in local_lattice(i, 0.5, horizon)]
        events += [(t, 1, "tick", i, None) for t in local_lattice(i, 0.3, horizon)]
    events.sort(key=lambda event: event[:2])
    state = [(np.array([0.5, 0.0]), np.array([[1.0, 0.2], [0.2, 2.0]])) for _ in range(3)]
    now, found = [shows(i, 0.0) for i in range(3)], []

    def advance(i, t):
        gap = shows(i, t) - now[i]
        if gap > 0.0:
            state[i], now[i] = move(*state[i], now[i], gap), shows(i, t)

    while events:
        t, _, what, i, more = events.pop(0)
        if what == "probe":
            for k in range(3):
                advance(k, t)
            found.append([*state])
            continue
        advance(i, t)
        x, P = state[i]
        if what == "sample":
            y = H @ truth(t)
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            state[i] = x + K @ (y - H @ x), P - K @ H @ P
        elif what == "tick":
            for j in neighbours[i]:
                arrival = (t + delay, 2, "arrive", j, (i, shows(i, t), state[i]))
                if arrival[0] < horizon:
                    bisect.insort(events, arrival, key=lambda event: event[:2])
        else:
            # All messages of one instant together; here no two coincide at a node.
            _, stamp, payload = more
            age = min(max(shows(i, t) - stamp, 0.0), shows(i, t) - shows(i, 0.0))
            told = move(*payload, shows(i, t) - age, age) if age > 0.0 else payload
            state[i] = 0.7 * x + 0.3 * told[0], 0.7 * P + 0.3 * told[1]
    xhat, P = (np.array([[one[k] for one in row] for row in found]) for k in range(2))
    return xhat, P


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("delay", [0.13, 0.0])
def test_estimates_are_those_of_the_plain_recursion(scenario_of, delay, engine):
    run = netkf.simulate(scenario_of(delay=delay), seed=1, engine=engine)
    xhat, P = plain_run(run.times.tolist(), 6.0, delay)
    np.testing.assert_allclose(run.P, P, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.xhat, xhat, rtol=1e-9, atol=1e-9)
    # Stamps are wrong by some seconds, so that errors do not fade.
    assert np.abs(run.x[-1] - run.xhat[-1]).max() > 0.05


LATER_A = np.array([[-0.3, 0.5], [-1.5, 0.0]])
JUMPS = ((0.5, 3.0), (1.1, -2.0), (2.9, 1.0))
G = np.array([1.0, -0.5])


def follow(x, P, start, gap, jumps=JUMPS, change=2.0):
    """Predict with an input that jumps and a plant that changes; nothing drives before the first
    jump.
    """
    edges = [start, *sorted(e for e in (change, *(t for t, _ in jumps)) if start < e < start + gap)]
    for begin, end in itertools.pairwise([*edges, start + gap]):
        M = LATER_A if begin >= change else A
        u = next((value for t, value in reversed(jumps) if t <= begin), 0.0)
        driven = np.zeros((3, 3))
        driven[:2, :2], driven[:2, 2] = M, G * u
        nested = np.block([[-M, BB], [np.zeros((2, 2)), M.T]])
        F = scipy.linalg.expm(M * (end - begin))
        Q = F @ scipy.linalg.expm(nested * (end - begin))[:2, 2:]
        x = (scipy.linalg.expm(driven * (end - begin)) @ np.append(x, 1.0))[:2]
        P = F @ P @ F.T + Q
    return x, P


DRIVEN = {
    "plant.input": {"kind": "recorded", "path": "u.csv", "G": G[:, None].tolist()},
    "plant.schedule": [{"from": 2.0, "A": LATER_A.tolist()}],
}


@pytest.mark.parametrize("keys", [("plant.input",), ("plant.schedule",), tuple(DRIVEN)])
@pytest.mark.parametrize("delay", [0.13, 0.0])
def test_what_filters_know_of_the_plant_is_of_local_times(scenario_of, delay, keys, tmp_path):
    """Nodes expect inputs and changes when their clocks show their times. With an offset larger
    than the delay some messages come from the future, and are taken for new.
    """
    rows = "".join(f"{t},{u}\n" for t, u in JUMPS)
    (tmp_path / "u.csv").write_text("t,u0\n" + rows)
    scenario = scenario_of(delay=delay).replace({key: DRIVEN[key] for key in keys})
    with pytest.raises(netkf.EngineError, match="clocks that know inputs or changes"):
        netkf.simulate(scenario, engine="compiled")
    run = netkf.simulate(scenario, seed=1)
    known = {"jumps": JUMPS if "plant.input" in keys else (), "change": np.inf}
    if "plant.schedule" in keys:
        known["change"] = 2.0
    xhat, P = plain_run(run.times.tolist(), 6.0, delay, functools.partial(follow, **known))
    np.testing.assert_allclose(run.P, P, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.xhat, xhat, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.error, run.x[:, None] - xhat, rtol=1e-9, atol=1e-9)
    law = error_law(scenario, run)
    np.testing.assert_allclose(law.mean.reshape(run.error.shape), run.error, atol=1e-9)
    np.testing.assert_allclose(law.P, P, rtol=1e-9, atol=1e-12)


CURVED = """import numpy as np

A = np.array({A})


class Flow:
    def f(self, x, u, t):
        return A @ x + np.array({G}) * u[0]

    def jacobian(self, x, u, t):
        return A
"""
RANGES = {"kind": "range", "positions": [[1.0, 5.0], [0.0, 7.0], [4.0, -9.0]]}
SLEEPS = [{"kind": "duty", "nodes": [1, 2], "period": 1.3, "up": 0.8, "memory": "lost"}]


RECORDED = {"kind": "recorded", "path": "u.csv"}
SINE = {"kind": "sine", "amplitude": 2.0, "frequency": 0.3, "phase": 1.0}


@pytest.mark.parametrize(
    ("kind", "at", "sensor", "lives", "u"),
    [
        ("kcf", "nodes", {"H": H.tolist()}, [], RECORDED),
        ("kcf", "nodes", {"H": H.tolist()}, [], SINE),
        ("intermittent", "readings", {"H": H.tolist()}, [], RECORDED),
        pytest.param("gossip", "links", RANGES, SLEEPS, RECORDED, marks=pytest.mark.slow),
    ],
)
def test_linear_plants_are_those_whose_f_is_linear(
    scenario_of, tmp_path, kind, at, sensor, lives, u, monkeypatch
):
    """Estimates of a plant that is not linear are counted from no response to the input; before a
    clock shows 0 there is none.
    """
    (tmp_path / "u.csv").write_text("t,u0\n" + "".join(f"{t},{u}\n" for t, u in JUMPS))
    (tmp_path / "curved.py").write_text(CURVED.format(A=A.tolist(), G=G.tolist()))
    monkeypatch.syspath_prepend(tmp_path)
    every = {"nodes": [0, 1, 2], "R": [[1e-22]], "sampling": PERIODIC}
    small = {
        "B": np.diag([1e-10, 1e-10]).tolist(),
        "mean": [2.0, -3.0],
        "cov": np.diag([1e-20] * 2),
    }
    scenario = scenario_of(delay=0.13 if kind == "kcf" else 0.4, horizon=4.0).replace(
        {
            "plant": {"kind": "diffusion", "A": A.tolist()} | small
            | {"input": u | {"G": G[:, None].tolist()}},
            "sensors": [every | sensor],
            "network.activation": {"kind": "readings"} if at == "readings"
            else {"kind": "periodic", "period": 0.3, "at": at},
            "network.lives": lives,
            "filter": {"kind": kind, "mean": [0.5, 0.0], "cov": [[1.0, 0.2], [0.2, 2.0]],
                       "model": {"B": [[0.2, 0.0], [0.0, 1.0]], "R": [[0.3]]}} | MORE.get(kind, {}),
        }
    )  # fmt: skip
    flow = {"kind": "nonlinear", "f": "curved:Flow", "step": 1e-3, **small, "input": u}
    run, other = (netkf.simulate(s) for s in (scenario, scenario.replace({"plant": flow})))
    assert len(run.log) == len(other.log)
    np.testing.assert_allclose(run.P, other.P, atol=1e-5)
    np.testing.assert_allclose(run.xhat, other.xhat, atol=1e-5)


@pytest.mark.parametrize(("size", "change"), [(0.0, 9.0), (1.0, 9.0), (0.0, 2.0)])
def test_increments_are_taken_for_those_of_the_time_that_passed_by_the_clock(
    scenario_of, size, change
):
    """dy = H x dt without noise: by a clock that shows s = offset + pace t it is H x / pace ds. A
    known input, and a change of the plant, are expected by the clock.
    """
    scenario = scenario_of(filter_="local", horizon=4.0).replace(
        {"sensors": [{"nodes": [0, 1, 2], "H": H.tolist(), "R": [[1e-22]]}]}
    )
    sine = {"kind": "sine", "amplitude": [size], "frequency": [0.7], "phase": [0.0]}
    if size:
        scenario = scenario.replace({"plant.input": sine | {"G": G[:, None].tolist()}})

    if change < 9.0:
        scenario = scenario.replace({"plant.schedule": [{"from": change, "A": LATER_A.tolist()}]})

    def law(t):
        return LATER_A if t >= change else A

    def drive(t):
        return G * size * np.sin(2.0 * np.pi * 0.7 * t) if t > 0.0 else 0.0 * G

    with pytest.raises(netkf.EngineError, match="increments at nodes whose clocks are wrong"):
        netkf.simulate(scenario, engine="compiled")
    run = netkf.simulate(scenario)
    for node, drift in enumerate(DRIFT):
        pace, offset = 1.0 + drift, OFFSET[node]

        def slope(t, y, pace=pace, offset=offset):
            x, xhat, P = y[:2], y[2:4], y[4:].reshape(2, 2)
            shown = offset + pace * t
            gain, M = P @ H.T @ np.linalg.inv(R), law(shown)
            dP = M @ P + P @ M.T + BB - gain @ R @ gain.T
            dxhat = pace * (M @ xhat + drive(shown)) + gain @ H @ (x - pace * xhat)
            return np.concatenate([law(t) @ x + drive(t), dxhat, pace * dP.ravel()])

        start = [2.0, -3.0, 0.5, 0.0, 1.0, 0.2, 0.2, 2.0]
        y = scipy.integrate.solve_ivp(
            slope, (0.0, 4.0), start, "DOP853", run.times, rtol=1e-11, atol=1e-12, max_step=0.1
        ).y.T
        np.testing.assert_allclose(run.x, y[:, :2], atol=1e-8)
        np.testing.assert_allclose(run.P[:, node], y[:, 4:].reshape(-1, 2, 2), atol=1e-8)
        # Gains of two moments of the increments; the drifts make a thousand times as much.
        np.testing.assert_allclose(run.xhat[:, node], y[:, 2:4], atol=5e-5)
    if size or change < 9.0:
        with pytest.raises(netkf.TheoryError, match="without inputs and changes that filters know"):
            netkf.theory.error_covariance(scenario, run)


def test_exact_errors_of_increments_that_are_taken_for_those_of_other_times(scenario_of):
    B, cov, var = np.array([[0.3, 0.0], [0.1, 0.5]]), np.array([[0.5, 0.1], [0.1, 0.4]]), 0.2
    scenario = scenario_of(filter_="local", horizon=4.0).replace(
        {
            "plant": {"kind": "diffusion", "A": A.tolist(), "B": B.tolist(), "cov": cov.tolist()},
            "sensors": [{"nodes": [0, 1, 2], "H": H.tolist(), "R": [[var]]}],
        }
    )
    run = netkf.simulate(scenario)
    exact = netkf.theory.error_covariance(scenario, run)
    zero, gap = np.zeros((2, 2)), np.hstack([np.eye(2), -np.eye(2)])
    for node, drift in enumerate(DRIFT):

        def slope(_, y, pace=1.0 + drift):
            """Of the covariance of x and xhat, and of P."""
            M, P = y[:16].reshape(4, 4), y[16:].reshape(2, 2)
            K = P @ H.T / R
            F = np.block([[A, zero], [K @ H, pace * (A - K @ H)]])
            noise = np.block([[B @ B.T, zero], [zero, var * K @ K.T]])
            dP = pace * (A @ P + P @ A.T + BB - K @ R @ K.T)
            return np.concatenate([(F @ M + M @ F.T + noise).ravel(), dP.ravel()])

        start = np.append(np.block([[cov, zero], [zero, zero]]), [1.0, 0.2, 0.2, 2.0])
        y = scipy.integrate.solve_ivp(
            slope, (0.0, 4.0), start, "DOP853", run.times, rtol=1e-12, atol=1e-13
        ).y.T
        covariances = gap @ y[:, :16].reshape(-1, 4, 4) @ gap.T
        np.testing.assert_allclose(exact[:, node], covariances, rtol=1e-9, atol=1e-11)


def test_ticks_and_samples_are_at_local_times(scenario_of):
    log = netkf.simulate(scenario_of(), seed=1).log
    for kind, period in (("sense", 0.5), ("tick", 0.3)):
        rows = log[log["kind"] == CODES[kind]]
        for node in range(3):
            expected = local_lattice(node, period, 6.0)
            np.testing.assert_allclose(rows["t"][rows["node"] == node], expected, atol=1e-12)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_rows_of_tables_are_of_local_times(scenario_of, tmp_path, engine):
    local = (0.1, 1.0, 2.5)
    rows = "".join(f"{t},{node}\n" for t in local for node in range(3))
    (tmp_path / "rows.csv").write_text("t,node\n" + rows)
    table = {"kind": "recorded", "path": "rows.csv"}
    changes = {"network.activation": {**table, "at": "nodes"}, "sensors.0.sampling": table}
    log = netkf.simulate(scenario_of().replace(changes), engine=engine).log
    for node, kind in itertools.product(range(3), ("sense", "tick")):
        t = log["t"][(log["kind"] == CODES[kind]) & (log["node"] == node)]
        # What the clock shows at the start has passed.
        shown = np.array([one for one in local if one > OFFSET[node]])
        np.testing.assert_allclose(t, (shown - OFFSET[node]) / (1.0 + DRIFT[node]), atol=1e-12)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_a_node_that_forgets_begins_again_at_the_time_of_its_clock(scenario_of, engine):
    """Between its going up and its next reading P is the prior, predicted by its clock."""
    life = {"nodes": [1], "kind": "duty", "period": 4.0, "up": 2.1, "phase": 3.0, "memory": "lost"}
    scenario = scenario_of(filter_="local").replace({"network.lives": [life], "probe": [3.25]})
    run = netkf.simulate(scenario, engine=engine)
    x, P = predict(np.array([0.5, 0.0]), np.array([[1.0, 0.2], [0.2, 2.0]]), 0.25 * (1 + DRIFT[1]))
    assert not any(3.0 <= t <= 3.25 for t in local_lattice(1, 0.5, 6.0))
    np.testing.assert_allclose(run.xhat[0, 1], x, atol=1e-12)
    np.testing.assert_allclose(run.P[0, 1], P, atol=1e-12)


def test_contacts_are_of_no_clock_of_a_node(scenario_of, tmp_path):
    (tmp_path / "contacts.csv").write_text("from,until,node,peer\n1,3,0,1\n2,5,1,0\n")
    contacts = {"kind": "contacts", "path": "contacts.csv", "at": "directions"}
    activation = {**contacts, "clock": {"kind": "periodic", "period": 0.3}}
    for clocks in ("", CLOCKS):
        scenario = scenario_of(clocks, at="directions").replace({"network.activation": activation})
        for engine in ("simpy", "compiled"):
            log = netkf.simulate(scenario, engine=engine).log
            ticks = log["t"][log["kind"] == CODES["tick"]]
            assert ticks.tolist() == [1.2, 1.5, 1.8, 2.1, 2.1, 2.4, 2.4, 2.7, 2.7, 3.0, 3.0,
                                      3.3, 3.6, 3.9, 4.2, 4.5, 4.8]  # fmt: skip


@pytest.mark.parametrize("at", ["nodes", "directions", "links"])
@pytest.mark.parametrize(
    "activation",
    [
        {"kind": "poisson", "rate": 3.0},
        {"kind": "renewal", "distribution": "gamma", "shape": 2.0, "mean": 0.3},
    ],
    ids=["poisson", "renewal"],
)
def test_random_clocks_are_slower_by_the_drift_of_their_node(scenario_of, at, activation):
    scenario = scenario_of(at=at).replace({"network.activation": {**activation, "at": at}})
    log = netkf.simulate(scenario, seed=4).log
    right = netkf.simulate(scenario.replace({"network.clocks": []}), seed=4).log
    for node in range(3):
        if at == "links" and node == 2:
            continue
        local, true = (
            rows["t"][(rows["kind"] == CODES["tick"]) & (rows["node"] == node)]
            for rows in (log, right)
        )
        if at == "directions" and node == 1:
            peers = [rows["peer"][(rows["kind"] == CODES["tick"]) & (rows["node"] == 1)]
                     for rows in (log, right)]  # fmt: skip
            local, true = local[peers[0] == 0], true[peers[1] == 0]
        # The gaps are drawn in local seconds, from time 0 on; a link belongs to no node.
        pace = 1.0 if at == "links" else 1.0 + DRIFT[node]
        count = min(len(local), len(true))
        assert count > 5
        np.testing.assert_allclose(local[:count], true[:count] / pace, rtol=1e-12)


@pytest.mark.parametrize("clock", [Periodic(period=0.3), Periodic(period=0.3, phase=0.1)])
@pytest.mark.parametrize("offset", [-7.4, -0.3, 0.0, 0.3, 0.45, 900.1])
def test_lattices_are_of_local_times_whatever_the_clock_shows(clock, offset):
    own, law = NodeTime(TimeGrid(), offset, 1.02), 0.1 * (clock.phase == 0.1) + 0.3 * np.arange(40)
    ahead = own.ahead(clock)
    times = own.instants(law[law > 0.0], ahead)
    shown = (np.array([own.shows(t) for t in times]) - clock.phase) / 0.3
    np.testing.assert_allclose(shown, np.rint(shown), atol=1e-8)
    assert (times > 0.0).all()
    assert times[0] < 0.6 / 1.02
    assert own.until(5.0, ahead) == pytest.approx(5.0 * 1.02 - ahead)
    assert NodeTime(TimeGrid(), offset, 1.02).ahead(Poisson(rate=1.0)) == 0.0


@pytest.mark.one_in(3)
@pytest.mark.parametrize("at", ["nodes", "directions", "links"])
@pytest.mark.parametrize(
    ("kind", "engine"),
    [("hybrid", "compiled"), ("hybrid", "simpy"), ("covariance-intersection", "simpy")],
)
def test_right_clocks_are_no_clocks(scenario_of, at, kind, engine):
    none = scenario_of(clocks="", filter_=kind, at=at)
    if engine == "simpy":
        sampled = {"nodes": [1], "H": H.tolist(), "R": [[0.3]], "sampling": PERIODIC}
        none = none.replace({"sensors": [{"nodes": [0], "H": H.tolist(), "R": [[0.3]]}, sampled]})
    right = none.replace({"network.clocks": [{"nodes": [0, 2]}]})
    run, same = (netkf.simulate(s, seed=2, engine=engine) for s in (none, right))
    assert run.log.tobytes() == same.log.tobytes()
    assert np.array_equal(run.xhat, same.xhat)
    assert np.array_equal(run.P, same.P)


EPSILON = {"epsilon": 0.3}
MORE = {
    "hybrid": EPSILON, "covariance-intersection": EPSILON, "kcf": EPSILON,
    "track-fusion": {"rule": "ci"},
}  # fmt: skip
FILTERS = [
    *[("hybrid", "nodes"), ("covariance-intersection", "readings"), ("gossip", "links")],
    *[("intermittent", "readings"), ("diffusion", "nodes"), ("push-sum", "nodes")],
    *[("kcf", "nodes"), ("track-fusion", "nodes"), ("local", "nodes")],
]


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("kind", "at"), FILTERS)
@pytest.mark.parametrize("offset", [-50.0, 0.2, 50.0])
def test_filters_take_any_stamp(scenario_of, kind, at, offset):
    activation = {"kind": "periodic", "period": 0.3, "at": at}
    scenario = scenario_of(clocks="", horizon=3.0).replace(
        {
            "filter": {"kind": kind, "cov": [[1.0, 0.2], [0.2, 2.0]]} | MORE.get(kind, {}),
            "network.activation": {"kind": "readings"} if at == "readings" else activation,
            "network.channel.delay": {"kind": "none"},
            "plant.A": [[-0.1, 1.0], [-1.0, -0.1]],
            "plant.B": [[0.2, 0.0], [0.0, 1.0]],
            "sensors": [{"nodes": [0, 1, 2], "H": [[1.0, 0.0]], "R": [[0.3]],
                         "sampling": {"kind": "periodic", "period": 0.5}}],
            "network.clocks": [{"nodes": [1], "offset": offset}],
        }
    )  # fmt: skip
    run, other = (netkf.simulate(scenario, seed=1, engine=e) for e in ("simpy", "compiled"))
    assert run.status == "complete"
    assert run.fingerprint == other.fingerprint
    np.testing.assert_allclose(other.xhat, run.xhat, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(other.P, run.P, rtol=1e-10, atol=1e-10)
    assert np.isfinite(run.xhat).all()
    assert (np.linalg.eigvalsh(run.P) > -1e-12).all()
    # True ages are in the trace, whatever stamps say.
    delivered = run.log[run.log["kind"] == CODES["deliver"]]
    assert (delivered["age"] == 0.0).all()


def test_late_readings_are_used_at_their_stamps(scenario_of):
    """Two nodes, one sends its reading with a stamp that is 0.2 s old: the other uses it as the
    filter would that had it then.
    """
    table = {
        "network.activation": {"kind": "readings"},
        "network.channel.delay": {"kind": "none"},
        "filter": {"kind": "intermittent", "mean": [0.5, 0.0], "cov": [[1.0, 0.2], [0.2, 2.0]],
                   "model": {"B": [[0.2, 0.0], [0.0, 1.0]], "R": [[0.3]]}},
        "network.graph": {"kind": "path", "nodes": 2},
        "sensors": [
            {"nodes": [1], "H": [[1.0, 0.0]], "R": [[1e-22]],
             "sampling": {"kind": "periodic", "period": 1.0, "phase": 0.7}},
            {"nodes": [0], "H": [[1.0, 0.0]], "R": [[1e-22]],
             "sampling": {"kind": "periodic", "period": 1.0}},
        ],
        "network.clocks": [{"nodes": [1], "offset": -0.2}],
    }  # fmt: skip
    run = netkf.simulate(scenario_of(clocks="").replace(table), seed=1)
    truth = lambda t: H @ scipy.linalg.expm(A * t) @ np.array([2.0, -3.0])  # noqa: E731
    # Its clock shows 0.7 + k at 0.9 + k; node 0 itself samples at 1 + k.
    readings = [(0.7 + k, 0.9 + k, truth(0.9 + k)) for k in range(6)]
    readings += [(1.0 + k, 1.0 + k, truth(1.0 + k)) for k in range(5)]
    for t, xhat, P in zip(run.times, run.xhat[:, 0], run.P[:, 0], strict=True):
        x, cov, now = np.array([0.5, 0.0]), np.array([[1.0, 0.2], [0.2, 2.0]]), 0.0
        for stamp, came, y in sorted(readings):
            if came <= t + 1e-9:
                if stamp > now:
                    (x, cov), now = predict(x, cov, stamp - now), stamp
                K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + R)
                x, cov = x + K @ (y - H @ x), cov - K @ H @ cov
        if t > now + 1e-12:
            x, cov = predict(x, cov, t - now)
        np.testing.assert_allclose(xhat, x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(P, cov, rtol=1e-9)


def test_drawn_clocks_differ_by_node_and_run_and_have_their_law(scenario_of):
    scenario = scenario_of(
        clocks="[[network.clocks]]\nnodes = [0, 1]\noffset = { sigma = 0.5 }\n"
        "drift = { sigma = 0.001 }\n"
    )
    drawn = np.array([
        [node_time(scenario, Streams(1, r), node)[1:] for node in (0, 1)] for r in range(400)
    ])  # fmt: skip
    z = (drawn - [0.0, 1.0]) / [0.5, 0.001]
    assert len(np.unique(z)) == z.size
    # Means and variances of 400 normal numbers, five deviations wide.
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=0.25)
    np.testing.assert_allclose(z.var(axis=0), 1.0, atol=0.36)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"network.clocks": [{"nodes": [7]}]}, "network.clocks[0].nodes[0]"),
        ({"network.clocks": [{"nodes": [1]}, {"nodes": [1]}]}, "network.clocks[1].nodes"),
        ({"network.clocks": [{"nodes": [1], "drift": 0.7}]}, "network.clocks[0].drift"),
        ({"network.clocks": [{"nodes": [1], "drift": {"sigma": 1.0}}]}, "clocks[0].drift.sigma"),
        ({"network.clocks": [{"nodes": [1], "offset": {"s": 1.0}}]}, "network.clocks[0].offset"),
        ({"network.clocks": {"nodes": [1]}}, "network.clocks"),
        ({"filter": {"kind": "central"}}, "network.clocks"),
        (
            {
                "plant.input": {"kind": "constant", "G": [[1.0], [0.0]], "value": [1.0]},
                "plant.schedule": [{"from": 2.0, "A": [[0.1, 0.0], [0.0, 0.1]]}],
                "sensors": [{"nodes": [0, 1], "H": [[1.0, 0.0]], "R": [[1.0]]}],
            },
            "clocks",
        ),
        ({"sensors": [{"kind": "recorded", "path": "y.csv", "H": [[1.0, 0.0]], "R": [[1.0]]}]},
         "got [2]; leave these out"),
    ],
)  # fmt: skip
def test_what_has_no_meaning_is_refused(scenario_of, changes, key, tmp_path):
    (tmp_path / "y.csv").write_text("t,node,y0\n1,0,0.5\n1,2,0.5\n")
    with pytest.raises(ScenarioError) as error:
        scenario_of().replace(changes)
    assert key in str(error.value)
    assert "\n" not in str(error.value)


def test_theory_and_check_say_that_nothing_is_promised(scenario_of):
    scenario = scenario_of()
    table = netkf.theory.assumptions(scenario)
    row = table[table["assumption"] == "clocks of nodes are right"].iloc[0]
    assert not row["holds"]
    with pytest.raises(netkf.TheoryError, match="clocks of nodes are wrong"):
        netkf.check(scenario, runs=10)


def plain_covariances(run, delay):
    """Covariances (T, 3, n, n) of the errors: the first state and each noise are a column of the
    true state and of all estimates, which move by the events of ``run``.
    """
    shows = lambda node, t: OFFSET[node] + (1.0 + DRIFT[node]) * t  # noqa: E731
    kinds = {CODES["sense"]: "sense", CODES["send"]: "send"}
    events = [(float(t), 3, "probe", 0, None) for t in run.times]
    log = run.log
    for t, code, i, j in zip(log["t"], log["kind"], log["node"], log["peer"], strict=True):
        if (what := kinds.get(int(code))) is not None:
            events.append((float(t), what == "send", what, int(i), int(j)))
    events.sort(key=lambda event: event[:2])
    root = np.linalg.cholesky(PRIOR)
    x, P = [np.zeros((2, 2)) for _ in range(3)], [PRIOR] * 3
    X, before, now, found = root, 0.0, [shows(i, 0.0) for i in range(3)], []

    def widened(new):
        nonlocal X, x
        X, x = (np.hstack([X, new]), [np.hstack([one, np.zeros(new.shape)]) for one in x])

    def advance(i, t):
        gap = shows(i, t) - now[i]
        if gap > 0.0:
            (x[i], P[i]), now[i] = predict(x[i], P[i], gap), shows(i, t)

    while events:
        t, _, what, i, more = events.pop(0)
        if t > before:
            X, Q = predict(X, np.zeros((2, 2)), t - before)
            before = t
            widened(np.linalg.cholesky(Q + 1e-30 * np.eye(2)))
        if what == "probe":
            for k in range(3):
                advance(k, t)
            errors = [X - one for one in x]
            found.append([e @ e.T for e in errors])
            continue
        advance(i, t)
        if what == "sense":
            K = P[i] @ H.T @ np.linalg.inv(H @ P[i] @ H.T + R)
            widened(np.zeros((2, 1)))
            y = H @ X
            y[:, -1] = np.sqrt(R[0, 0])
            x[i], P[i] = x[i] + K @ (y - H @ x[i]), P[i] - K @ H @ P[i]
        elif what == "send":
            arrival = (t + delay, 2, "arrive", more, (i, shows(i, t), x[i], P[i]))
            if arrival[0] < 6.0:
                bisect.insort(events, arrival, key=lambda event: event[:2])
        else:
            _, stamp, told, cov = more
            told = np.hstack([told, np.zeros((2, X.shape[1] - told.shape[1]))])
            age = min(max(shows(i, t) - stamp, 0.0), shows(i, t) - shows(i, 0.0))
            if age > 0.0:
                told, cov = predict(told, cov, age)
            x[i], P[i] = 0.7 * x[i] + 0.3 * told, 0.7 * P[i] + 0.3 * cov
    return np.array(found)


PRIOR = np.array([[1.0, 0.2], [0.2, 2.0]])


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_exact_errors_are_those_of_the_joint_moments(scenario_of, engine):
    table = {
        "plant.B": [[0.2, 0.0], [0.0, 1.0]],
        "plant.cov": PRIOR.tolist(),
        "sensors.0.R": [[0.3]],
    }
    scenario = scenario_of(delay=0.13).replace(table)
    run = netkf.simulate(scenario, seed=2, engine=engine)
    exact = netkf.theory.error_covariance(scenario, run)
    np.testing.assert_allclose(exact, plain_covariances(run, 0.13), rtol=1e-9, atol=1e-11)
    # What P misses.
    assert (exact[-1].trace(axis1=1, axis2=2) > 1.02 * run.P[-1].trace(axis1=1, axis2=2)).any()


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("kind", "at"), FILTERS)
def test_mean_errors_are_those_of_a_run_without_noise(scenario_of, kind, at, tmp_path):
    """Of filters that know an input and, but for push-sum, changes, with stamps from the future and
    nodes that begin again.
    """
    (tmp_path / "u.csv").write_text("t,u0\n" + "".join(f"{t},{u}\n" for t, u in JUMPS))
    changes = {key: DRIVEN[key] for key in DRIVEN if kind != "push-sum" or "input" in key}
    if kind != "push-sum":
        lives = {"kind": "duty", "nodes": [1], "period": 2.5, "up": 2.0}
        memory = "kept" if kind == "intermittent" else "lost"
        changes["network.lives"] = [lives | {"memory": memory}]
    clock = {"kind": "readings"} if at == "readings" else {"kind": "poisson", "rate": 2.0, "at": at}
    kept = {"mean": [0.5, 0.0], "cov": PRIOR.tolist(), "model": {"B": [[0.2, 0.0], [0.0, 1.0]]}}
    changes |= {"filter": {"kind": kind, **MORE.get(kind, {}), **kept}, "network.activation": clock}
    scenario = scenario_of(delay=0.05).replace(changes | {"filter.model.R": [[0.3]]})
    run = netkf.simulate(scenario, seed=1)
    law = error_law(scenario, run)
    np.testing.assert_allclose(law.mean.reshape(run.error.shape), run.error, atol=1e-9)
    np.testing.assert_allclose(law.P, run.P, rtol=1e-9, atol=1e-12)


def test_exact_errors_of_filters_in_python_are_not_known(scenario_of):
    scenario = scenario_of()
    one = scenario.replace({"filter": {"kind": "block-intersection"}})
    with pytest.raises(netkf.TheoryError, match="clocks of nodes are wrong"):
        netkf.theory.error_covariance(one, netkf.simulate(one, seed=1))
