"""Filters in slots: reference cases, identities along runs, late messages, special cases."""

import json

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.engines.compiled.slot_loop import slot_loop
from netkf.scenario.reading import from_table
from netkf.trace.schema import CODES
from tests.cases import FOLDER
from tests.conftest import SCENARIOS

GOSSIP = json.loads((FOLDER / "gossip.json").read_text())
INTERMITTENT = json.loads((FOLDER / "intermittent.json").read_text())


def slotted(folder, slots, F, Q, cov, sensors, network, kind, **more):
    plant = {"kind": "linear", "F": F, "Q": Q, "period": 1.0, "cov": cov}
    table = {
        "format": 1,
        "name": "slots",
        "horizon": float(slots),
        "probe": 1.0,
        "plant": plant,
        "sensors": sensors,
        "network": network,
        "filter": {"kind": kind},
        **more,
    }
    return from_table(table, folder)


@pytest.mark.parametrize("case", GOSSIP["cases"], ids=lambda c: c["id"])
def test_gossip_cases_and_the_token_identity(case, tmp_path):
    """G (10), and G (19) read rightly: P_n(t+1) = f_{p_n(t)}(P_n(t)) = Phat_{p_n(t)}(t+1)."""
    N, slots = case["N"], len(case["nb"])
    pairs = {
        (t, *sorted((n, m))) for t, nb in enumerate(case["nb"]) for n, m in enumerate(nb) if n != m
    }
    rows = "".join(f"{t},{i},{j}\n" for t, i, j in sorted(pairs))
    (tmp_path / "pairs.csv").write_text("slot,node,peer\n" + rows)
    graph = {"kind": "complete", "nodes": N}
    network = {"graph": graph, "activation": {"kind": "recorded", "path": "pairs.csv"}}
    sensors = [{"nodes": [n], "H": case["C"][n], "R": case["R"][n]} for n in range(N)]
    scenario = slotted(
        tmp_path, slots, case["F"], case["Q"], case["P0"], sensors, network, "gossip"
    )
    run = netkf.simulate(scenario)
    expected = np.array(case["Phat"])
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(run.P - expected) <= 1e-12 * size).all()
    # tokens from the swaps in the trace
    swaps = run.log[run.log["kind"] == CODES["swap"]]
    position = np.arange(N)
    for t in range(slots):
        came_from = np.arange(N)
        here = swaps[np.floor(swaps["t"]) == t]
        came_from[here["node"]] = here["peer"]
        position = np.argsort(came_from)[position]
        assert position.tolist() == case["p"][t]


@pytest.mark.parametrize("case", INTERMITTENT["cases"], ids=lambda c: c["id"])
def test_intermittent_cases(case, tmp_path):
    arrived = "".join(f"{t},0,0,0,1\n" for t, gamma in enumerate(case["gammas"]) if gamma)
    (tmp_path / "up.csv").write_text("slot,phase,step,node,peer\n" + arrived)
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "recorded", "path": "up.csv"},
    }
    sensors = [{"nodes": [0], "H": case["C"], "R": case["R"]}]
    scenario = slotted(
        tmp_path,
        len(case["gammas"]),
        case["A"],
        case["Q"],
        case["P0"],
        sensors,
        network,
        "intermittent",
    )
    run = netkf.simulate(scenario)
    expected = np.array(case["P"])
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(run.P[:, 1] - expected) <= 1e-12 * size).all()
    # what the record does not list was sent and lost
    assert run.count("send") == len(case["gammas"])
    assert run.count("lost") == len(case["gammas"]) - sum(case["gammas"])


def kalman(F, Q, H, R, mean, cov, y):
    """Textbook: predict, then update, in covariance form; filtered estimates from slot 1 on."""
    x, P, out = mean, cov, [(mean, cov)]
    for k in range(1, len(y)):
        x, P = F @ x, F @ P @ F.T + Q
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (y[k] - H @ x), P - K @ H @ P
        out.append((x, P))
    return out


def test_local_and_central_are_the_textbook_filter(tmp_path):
    F, Q = np.array([[1.0, 0.3], [-0.2, 0.95]]), np.diag([0.1, 0.2])
    sensors = [
        {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.5]]},
        {"nodes": [1], "H": [[0.5, 1.0]], "R": [[0.7]]},
    ]
    network = {"graph": {"kind": "path", "nodes": 3}}
    runs = {
        kind: netkf.simulate(slotted(tmp_path, 20, F, Q, np.eye(2), sensors, network, kind))
        for kind in ("local", "central")
    }
    np.testing.assert_array_equal(runs["local"].x, runs["central"].x)
    readings = readings_of(runs["central"].x, sensors)
    H, R = np.array([[1.0, 0.0], [0.5, 1.0]]), np.diag([0.5, 0.7])
    expected = kalman(F, Q, H, R, np.zeros(2), np.eye(2), readings)
    for k, (x, P) in enumerate(expected):
        for node in range(3):
            np.testing.assert_allclose(runs["central"].xhat[k, node], x, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(runs["central"].P[k, node], P, rtol=1e-10)
    alone = kalman(F, Q, H[:1], R[:1, :1], np.zeros(2), np.eye(2), readings[:, :1])
    np.testing.assert_allclose(runs["local"].xhat[20, 0], alone[20][0], rtol=1e-9)
    blind = np.linalg.matrix_power(F, 20) @ np.zeros(2)
    np.testing.assert_allclose(runs["local"].xhat[20, 2], blind, atol=1e-12)


def readings_of(x, sensors):
    """The readings that the engine made, from the same streams."""
    from netkf.plants.linear import SlotReadings
    from netkf.rng.streams import Streams

    paths = [
        SlotReadings(
            np.array(s["H"]), np.array(s["R"]), Streams(0).generator("noise", s["nodes"][0], 0)
        )
        for s in sensors
    ]
    return np.array([[path.reading(k, x[k])[0] for path in paths] for k in range(len(x))])


def test_a_complete_network_without_loss_is_the_centralised_predictor(tmp_path):
    F, Q = np.array([[1.1, 0.3], [0.0, 0.9]]), np.diag([0.1, 0.2])
    sensors = [{"nodes": [k], "H": [[1.0, float(k)]], "R": [[0.5]]} for k in range(3)]
    network = {"graph": {"kind": "complete", "nodes": 3}, "activation": {"kind": "broadcast"}}
    run = netkf.simulate(slotted(tmp_path, 30, F, Q, np.eye(2), sensors, network, "intermittent"))
    for node in (1, 2):
        np.testing.assert_allclose(run.xhat[:, node], run.xhat[:, 0], rtol=1e-7, atol=1e-9)
    H = np.array([[1.0, k] for k in range(3)])
    star = theory.steady_covariance(F, Q, H, 0.5 * np.eye(3))
    np.testing.assert_allclose(run.P[-1], np.broadcast_to(star, (3, 2, 2)), rtol=1e-6)


def test_what_arrives_after_the_inbox_closed_is_late_and_lost(tmp_path):
    """Uniform delays of 0 .. 0.6 s against a phase of 0.3 s: half of the messages are late."""
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "broadcast", "phase": 0.3},
        "channel": {"delay": {"kind": "uniform", "low": 0.0, "high": 0.6}},
    }
    sensors = [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}]
    run = netkf.simulate(
        slotted(tmp_path, 800, [[0.9]], [[1.0]], [[1.0]], sensors, network, "intermittent")
    )
    events = run.events
    late, got = events[events.kind == "late"], events[events.kind == "deliver"]
    assert len(late) + len(got) == 800
    assert len(late) == pytest.approx(400, abs=60)
    assert got.age.max() <= 0.3 < late.age.min()
    # each delivered reading was used in the slot it belongs to, each late one was not
    used = set(np.floor(got.t).astype(int))
    step = {True: theory.riccati_step, False: None}
    for k in range(60):
        expected = (
            step[True](run.P[k, 1], [[0.9]], [[1.0]], [[1.0]], [[1.0]])
            if k in used
            else theory.lyapunov_step(run.P[k, 1], [[0.9]], [[1.0]])
        )
        np.testing.assert_allclose(run.P[k + 1, 1], expected, rtol=1e-12)


@pytest.mark.parametrize("kind", ["hcmci", "intermittent"])
@pytest.mark.parametrize("horizon", [2.2, 2.5])
def test_a_horizon_within_an_exchange_lets_it_end(kind, horizon, tmp_path):
    """What arrives as the inbox closes, after the horizon, is in the sample and in the trace."""
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "broadcast"},
        "channel": {"delay": {"kind": "constant", "seconds": 0.5}},
    }
    sensors = [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}]
    arguments = ([[0.9]], [[1.0]], [[1.0]], sensors, network, kind)
    whole = slotted(tmp_path, 3, *arguments)
    cut = whole.replace({"horizon": horizon, "probe": [0.0, 1.0, 2.0]})
    runs = [netkf.simulate(cut, engine=engine) for engine in ("simpy", "compiled")]
    assert netkf.first_difference(*runs) is None
    expected = netkf.simulate(whole)
    assert (runs[0].events.kind == "absorb").sum() == (runs[0].events.kind == "deliver").sum()
    np.testing.assert_allclose(runs[0].P, expected.P[:3], rtol=1e-12)
    exact = [theory.error_covariance(*pair) for pair in ((cut, runs[0]), (whole, expected))]
    np.testing.assert_allclose(exact[0], exact[1][:3], rtol=1e-12)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_what_comes_while_a_later_exchange_is_open_is_late(tmp_path, engine):
    """Node 1 hears node 0 after 0.1 s and node 2 after 0.2 s, and is heard a slot later."""
    delays = {(0, 1): 0.1, (2, 1): 0.2, (1, 0): 1.1, (1, 2): 1.2}
    rows = [f"{i},{j},{k},{t}" for (i, j), t in delays.items() for k in range(9)]
    (tmp_path / "delays.csv").write_text("\n".join(["sender,receiver,message,seconds", *rows]))
    network = {
        "graph": {"kind": "path", "nodes": 3},
        "activation": {"kind": "broadcast", "phase": 0.3},
        "channel": {"delay": {"kind": "recorded", "path": "delays.csv"}, "symmetric": False},
    }
    sensors = [{"nodes": [0, 1, 2], "H": [[1.0]], "R": [[1.0]]}]
    scenario = slotted(tmp_path, 8, [[0.9]], [[1.0]], [[1.0]], sensors, network, "kcf")
    events = netkf.simulate(scenario, engine=engine).events
    came = events[events.kind.isin(["deliver", "late"])]
    assert {
        (k, i, round(t % 1.0, 9)) for k, i, t in zip(came.kind, came.node, came.t, strict=True)
    } == {("deliver", 1, 0.1), ("deliver", 1, 0.2), ("late", 0, 0.1), ("late", 2, 0.2)}
    absorbed = events[events.kind == "absorb"]
    assert set(absorbed.node) == {1}
    np.testing.assert_allclose(absorbed.age, 0.2)


@pytest.mark.parametrize("slots", [3, 6, 7, 12])
def test_a_horizon_that_is_a_product_of_floats_has_no_slot_too_many(slots, tmp_path):
    """3 * 0.1 is 0.30000000000000004: slot 3 begins at the horizon, not before."""
    plant = {"kind": "linear", "F": [[0.9]], "Q": [[1.0]], "period": 0.1, "cov": [[1.0]]}
    network = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}}
    scenario = slotted(
        tmp_path,
        slots,
        [[0.9]],
        [[1.0]],
        [[1.0]],
        [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}],
        network,
        "intermittent",
        plant=plant,
        horizon=slots * 0.1,
        probe=0.1,
    )
    for engine in ("processes", "compiled"):
        run = netkf.simulate(scenario, engine=engine)
        assert run.count("sense") == slots
        assert len(run.times) == slots + 1


def test_symmetric_loss_swaps_or_not_and_directions_copy():
    """With symmetric loss tokens stay a permutation; per direction some pair is copied."""
    scenario = netkf.load(SCENARIOS / "gossip_copies.toml")
    for symmetric in (True, False):
        run = netkf.simulate(scenario.replace({"network.channel.symmetric": symmetric}))
        swaps = run.events[run.events.kind == "swap"]
        both = swaps.groupby(["t"]).apply(
            lambda g: set(zip(g.node, g.peer)) == set(zip(g.peer, g.node)),  # noqa: B905
            include_groups=False,
        )
        assert both.all() == symmetric


def test_errors_are_as_large_as_the_filters_say(tmp_path):
    """NEES of gossip over 200 runs: each node's mean within 4.5 standard errors of n = 2."""
    F, Q = np.array([[1.0, 0.2], [-0.2, 1.0]]), np.diag([0.3, 0.3])
    sensors = [
        {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.5]]},
        {"nodes": [2], "H": [[0.0, 1.0]], "R": [[0.5]]},
    ]
    network = {
        "graph": {"kind": "path", "nodes": 3},
        "activation": {"kind": "matching", "protocol": "one-edge", "lazy": 0.2},
    }
    scenario = slotted(tmp_path, 25, F, Q, np.eye(2), sensors, network, "gossip")
    runs = [netkf.simulate(scenario, replica=r) for r in range(200)]
    e = np.array([run.x[-1] - run.xhat[-1] for run in runs])
    inverse = np.linalg.inv([run.P[-1] for run in runs])
    nees = np.einsum("rni,rnij,rnj->rn", e, inverse, e)
    error = nees.std(axis=0, ddof=1) / np.sqrt(len(runs))
    assert (np.abs(nees.mean(axis=0) - 2.0) <= 4.5 * error).all()


def test_truth_and_readings_do_not_depend_on_the_network():
    scenario = netkf.load(SCENARIOS / "gossip_ring.toml").replace({"horizon": 40.0})
    base = netkf.simulate(scenario)
    for changes in (
        {"network.activation": {"kind": "matching", "protocol": "one-edge"}},
        {"filter.kind": "local"},
        {"filter.kind": "central"},
    ):
        np.testing.assert_array_equal(netkf.simulate(scenario.replace(changes)).x, base.x)
    again = netkf.simulate(scenario)
    assert again.fingerprint == base.fingerprint
    np.testing.assert_array_equal(again.xhat, base.xhat)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"filter": {"kind": "hybrid", "epsilon": 0.2}}, "belongs to plants in continuous time"),
        ({"network.activation": {"kind": "poisson", "rate": 1.0}}, "continuous time"),
        ({"network.activation": {"kind": "broadcast"}}, "must be a matching for the gossip filter"),
        ({"filter.kind": "intermittent"}, "must be a broadcast for the intermittent filter"),
        ({"probe": 0.7}, "must be multiples of the plant's period 1; got 0.7"),
        ({"network.activation.phase": 1.0}, "room within the period 1; got 1.0"),
        ({"network.activation.protocol": "best"}, 'must be one of "one-edge"'),
        ({"network.activation.lazy": 0.5}, "means nothing for maximal"),
        ({"filter.model": {"A": [[1.0]]}}, "this plant is in slots"),
        ({"plant.Q": [[1.0]]}, "must be 4 x 4, not 1 x 1"),
    ],
)
def test_parts_that_do_not_go_together_are_refused(changes, words):
    scenario = netkf.load(SCENARIOS / "gossip_ring.toml")
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario.replace(changes)
    assert words in str(caught.value)


def test_the_loop_of_slots_is_compiled_once_for_all_filters():
    """Whatever the number of states."""
    for file in ("gossip_ring.toml", "intermittent_scalar.toml"):
        scenario = netkf.load(SCENARIOS / file, {"horizon": 8.0})
        netkf.simulate(scenario, engine="compiled")
    assert len(slot_loop._python_dispatcher.signatures) == 1
