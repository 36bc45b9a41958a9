"""The diffusion filter: reference cases, lost messages, regressors, baselines, special cases."""

import json
import math

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import netkf
from netkf import theory
from netkf.rng.streams import Streams
from netkf.scenario.reading import from_table
from netkf.scenario.writing import as_table
from netkf.theory.diffusion.information import normalised_outer
from tests.cases import FOLDER
from tests.conftest import SCENARIOS
from tests.engines.linearity import engine_covariance

CASES = json.loads((FOLDER / "diffusion.json").read_text())["cases"]


def recorded_tables(case, folder):
    """The readings, regressors and links of a case as files, and the tables that name them."""
    n, m, W = case["n"], case["m"], np.array(case["W"])
    names = ",".join(f"phi{k}" for k in range(m))
    rows = [
        ",".join(map(repr, (float(k), i, case["y"][k][i], *case["phi"][k][i])))
        for k in range(len(case["y"]))
        for i in range(n)
    ]
    (folder / "readings.csv").write_text(f"t,node,y0,{names}\n" + "\n".join(rows) + "\n")
    links = [[s, r] for s in range(n) for r in range(n) if s != r and W[s, r] > 0.0]
    activation = {"kind": "broadcast"}
    if case["up"] is not None:
        up = [f"{k},0,0,{s},{r}" for k, U in enumerate(case["up"]) for s, r in links if U[s][r]]
        (folder / "up.csv").write_text("slot,phase,step,node,peer\n" + "\n".join(up) + "\n")
        activation = {"kind": "recorded", "path": "up.csv"}
    graph = {"kind": "edges", "edges": links, "nodes": n, "directed": True}
    R = [[case["r"][0]]]
    return {
        "format": 1,
        "name": case["name"],
        "horizon": float(len(case["y"])),
        "probe": 1.0,
        "plant": {"kind": "unknown", "F": np.eye(m).tolist(), "Q": case["Q"], "period": 1.0},
        "sensors": [{"kind": "recorded", "path": "readings.csv", "R": R}],
        "network": {"graph": graph, "activation": activation},
        "filter": {
            "kind": "diffusion",
            "weights": case["W"],
            "mean": case["theta0"],
            "cov": case["P0"],
        },
    }


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_cases(case, tmp_path):
    run = netkf.simulate(from_table(recorded_tables(case, tmp_path), tmp_path))
    out = case["out"]
    np.testing.assert_allclose(run.xhat, out["theta"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.P[-1], out["P_final"], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(np.trace(run.P, axis1=2, axis2=3), out["trP"], rtol=1e-9)
    if case["up"] is not None:  # what the record does not list was sent and lost
        links = (np.array(case["W"]) > 0.0) & ~np.eye(case["n"], dtype=bool)
        up = np.array(case["up"])[:, links]
        assert run.count("lost") == up.size - up.sum()


def readings_of(run, scenario):
    """(T, N) the readings and (T, N, n) the regressors of a run with one scalar sensor a node."""
    streams = Streams(run.seed, run.replica)
    paths = [scenario.slot_path(streams, i, scenario.placed_sensors[i][0]) for i in scenario.nodes]
    seen, rows = [], []
    for k, x in enumerate(run.x):
        rows.append([path.matrix(k)[0] for path in paths])
        seen.append([path.reading(k, x)[0] for path in paths])
    return np.array(seen), np.array(rows)


def section_vi(**changes):
    return netkf.load(SCENARIOS / "diffusion_regression.toml").replace(
        {"horizon": 40.0, "probe": 1.0, **{k.replace("__", "."): v for k, v in changes.items()}}
    )


def adapted(x, P, F, Q, phi, r, y):
    """D (6), (7) with a general F, written plainly."""
    L = P @ phi / (r + phi @ P @ phi)
    after = P - np.outer(L, phi @ P)
    return F @ (x + L * (y - phi @ x)), F @ after @ F.T + Q


@pytest.mark.parametrize("on_loss", ["renormalise", "keep-own"])
def test_lost_messages_against_algorithm_1_written_plainly(on_loss):
    """A turning plant, delivery 0.6 on a digraph with links both ways between two nodes."""
    F = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.0], [0.0, 0.1, 1.0]])
    W = np.array([[0.5, 0.3, 0.0], [0.25, 0.3, 0.6], [0.25, 0.4, 0.4]])
    scenario = section_vi(
        plant__F=F.tolist(),
        network__graph__edges=[[0, 1], [1, 0], [1, 2], [2, 0], [2, 1]],
        network__channel={"loss": {"kind": "bernoulli", "delivery": 0.6}},
        filter__weights=W.tolist(),
        filter__on_loss=on_loss,
    )
    run = netkf.simulate(scenario)
    y, phi = readings_of(run, scenario)
    events = run.events[run.events.kind == "deliver"]
    x, P = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))
    fates = set()
    for k in range(40):
        np.testing.assert_allclose(run.xhat[k], x, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(run.P[k], P, rtol=1e-8, atol=1e-12)
        made = [adapted(x[i], P[i], F, 0.1 * np.eye(3), phi[k, i], 0.1, y[k, i]) for i in range(3)]
        here = events[np.floor(events.t) == k]
        arrived = set(zip(here.peer, here.node, strict=True))
        fates.add(((0, 1) in arrived, (1, 0) in arrived))
        x, P = np.zeros((3, 3)), np.zeros((3, 3, 3))
        for i in range(3):
            w = {s: W[s, i] for s in range(3) if s == i or (s, i) in arrived}
            if on_loss == "renormalise":
                w = {s: value / sum(w.values()) for s, value in w.items()}
            else:
                w[i] = 1.0 - sum(value for s, value in w.items() if s != i)
            P[i] = np.linalg.inv(sum(v * np.linalg.inv(made[s][1]) for s, v in w.items()))
            x[i] = P[i] @ sum(v * np.linalg.solve(made[s][1], made[s][0]) for s, v in w.items())
    assert len(fates) == 4  # the two links between 0 and 1 are two links
    assert run.count("lost") + run.count("deliver") == run.count("send") == 5 * 40
    numbers = run.events[run.events.kind == "send"].groupby(["node", "peer"]).message
    assert (numbers.max() == 39).all()


def test_messages_go_along_the_links_only():
    events = netkf.simulate(section_vi()).events
    sent = events[events.kind == "send"]
    assert set(zip(sent.node, sent.peer, strict=True)) == {(0, 1), (1, 2), (2, 0)}


def test_links_that_fail_for_sure_in_one_direction(tmp_path):
    """A measured table on a digraph, and a record on a graph whose links work both ways."""
    rows = "sender,receiver,delivery_probability\n0,1,1.0\n1,0,0.0\n1,2,1.0\n2,0,1.0\n"
    (tmp_path / "links.csv").write_text(rows)
    (tmp_path / "up.csv").write_text("slot,phase,step,node,peer\n0,0,0,1,0\n1,0,0,1,2\n")
    table = as_table(section_vi(filter__weights="metropolis", horizon=4.0))
    table["network"] = {
        "graph": {"kind": "csv", "path": "links.csv", "directed": True},
        "activation": {"kind": "broadcast"},
        "channel": {"loss": {"kind": "per-link"}},
    }
    events = netkf.simulate(from_table(table, tmp_path)).events
    lost = events[events.kind == "lost"]
    assert set(zip(lost.node, lost.peer, strict=True)) == {(1, 0)}
    assert len(lost) == 4
    table["network"] = {
        "graph": {"kind": "path", "nodes": 3},
        "activation": {"kind": "recorded", "path": "up.csv"},
    }
    events = netkf.simulate(from_table(table, tmp_path)).events
    got = events[events.kind == "deliver"]
    pairs = sorted(zip(np.floor(got.t), got.peer, got.node, strict=True))
    assert pairs == [(0, 0, 1), (0, 1, 0), (1, 1, 2), (1, 2, 1)]


def test_readings_travel_one_way_too():
    """On 0 -> 1 -> 2 node 0 is alone and node 1 never hears node 2."""
    network = {
        "graph": {"kind": "edges", "edges": [[0, 1], [1, 2]], "directed": True},
        "activation": {"kind": "broadcast"},
    }
    fixed = [
        {"nodes": [i], "H": [[float(k == i) for k in range(3)]], "R": [[1.0]]} for i in range(3)
    ]
    start = {"mean": [0.0] * 3, "cov": np.eye(3).tolist()}
    changes = {"network": network, "sensors": fixed, "filter": {"kind": "intermittent", **start}}
    scenario = section_vi(**changes)
    trace = np.diagonal(netkf.simulate(scenario).P[-1], axis1=1, axis2=2)
    seen = trace < 1.0 + 0.09 * 40 - 1e-9
    assert seen.tolist() == [[True, False, False], [True, True, False], [False, True, True]]
    rows = theory.assumptions(scenario).set_index("assumption")
    assert "not at nodes 0, 1, 2" in rows.evidence["(F, H) is detectable at every node"]
    moved = scenario.replace({"network.graph.edges": [[0, 2], [1, 2]]})
    rows = theory.assumptions(moved).set_index("assumption")
    assert "not at nodes 0, 1" in rows.evidence["(F, H) is detectable at every node"]
    assert "2" not in rows.evidence["(F, H) is detectable at every node"].split("nodes")[1]


def test_truth_and_regressors_do_not_depend_on_filter_and_network():
    base = netkf.simulate(section_vi())
    start = {"mean": [0.0] * 3, "cov": np.eye(3).tolist()}
    for changes in (
        {"filter": {"kind": "local", **start}},
        {"filter": {"kind": "central", **start}},
        {"filter__weights": "metropolis"},
        {"network__channel": {"loss": {"kind": "bernoulli", "delivery": 0.2}}},
    ):
        scenario = section_vi(**changes)
        run = netkf.simulate(scenario)
        np.testing.assert_array_equal(run.x, base.x)
        for ours, theirs in zip(
            readings_of(run, scenario), readings_of(base, section_vi()), strict=True
        ):
            np.testing.assert_array_equal(ours, theirs)


def test_regressors_have_the_law_that_is_printed():
    """(x, 0, 0), (0, x, 0) with x <- x / 2 + xi; z (0, 1, 1), z = .8 x before, x <- .8 x + xi."""
    scenario = section_vi(horizon=4000.0)
    streams = Streams(3)
    paths = [scenario.slot_path(streams, i, scenario.placed_sensors[i][0]) for i in range(3)]
    phi = np.array([[path.matrix(k)[0] for path in paths] for k in range(4000)])
    np.testing.assert_array_equal(phi[0], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    assert phi[1, 2].tolist() == [0.0, 0.8, 0.8]
    assert not phi[:, 0, 1:].any()
    assert not phi[:, 1, ::2].any()
    np.testing.assert_array_equal(phi[:, 2, 1], phi[:, 2, 2])
    for series, a, scale in (
        (phi[:, 0, 0], 0.5, 1.0),
        (phi[:, 1, 1], 0.5, 1.0),
        (phi[:, 2, 1], 0.8, 0.8),
    ):
        xi = (series[2:] - a * series[1:-1]) / scale
        assert xi.std() == pytest.approx(0.3, abs=4.5 * 0.3 / np.sqrt(2 * 4000))
        assert np.corrcoef(xi[1:], xi[:-1])[0, 1] == pytest.approx(0.0, abs=4.5 / np.sqrt(4000))
    assert np.corrcoef(phi[:, 0, 0], phi[:, 1, 1])[0, 1] == pytest.approx(0.0, abs=0.12)


def test_local_and_central_use_the_regressors_of_the_slot():
    """The textbook filter with H_k: predict, then update, from slot 1 on."""
    start = {"mean": [0.0] * 3, "cov": np.eye(3).tolist()}
    local, central = (section_vi(filter={"kind": kind, **start}) for kind in ("local", "central"))
    alone, shared = netkf.simulate(local), netkf.simulate(central)
    y, phi = readings_of(alone, local)
    groups = [*([i] for i in range(3)), [0, 1, 2]]
    x, P = np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))
    for k in range(1, 41):
        for g, nodes in enumerate(groups):
            H, ahead = phi[k, nodes], P[g] + 0.09 * np.eye(3)
            K = ahead @ H.T @ np.linalg.inv(H @ ahead @ H.T + 0.09 * np.eye(len(nodes)))
            x[g], P[g] = x[g] + K @ (y[k, nodes] - H @ x[g]), ahead - K @ H @ ahead
        np.testing.assert_allclose(alone.xhat[k], x[:3], rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(alone.P[k], P[:3], rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(shared.xhat[k], [x[3]] * 3, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(shared.P[k], [P[3]] * 3, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_exact_error_covariance_of_the_cases(case, tmp_path):
    truth, table = case["exact_error"], recorded_tables(case, tmp_path)
    m = case["m"]
    Q = (truth["Qtrue_diag"] * np.eye(m)).tolist()
    table["plant"] = {"kind": "linear", "F": np.eye(m).tolist(), "Q": Q, "period": 1.0}
    table["sensors"][0]["R"] = [[truth["rtrue"]]]
    table["filter"]["model"] = {"Q": case["Q"], "R": [[case["r"][0]]]}
    scenario = from_table(table, tmp_path)
    exact = theory.error_covariance(scenario, netkf.simulate(scenario))
    traces = np.trace(exact, axis1=2, axis2=3)
    np.testing.assert_allclose(traces, truth["trace_per_sensor"], rtol=1e-9, atol=1e-12)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["diffusion", "local", "central", "intermittent", "gossip"])
def test_exact_error_covariance_against_the_engine_draw_by_draw(kind, tmp_path):
    """With losses, late messages, a blind node and filters that have a wrong F and R."""
    table = {
        "format": 1,
        "name": "small",
        "horizon": 5.0,
        "probe": 1.0,
        "plant": {
            "kind": "linear",
            "F": [[1.0, 0.3], [-0.2, 0.9]],
            "Q": [[0.2, 0.1], [0.1, 0.3]],
            "cov": [[1.0, 0.2], [0.2, 2.0]],
            "period": 1.0,
        },
        "sensors": [
            {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.5]]},
            {"nodes": [1], "H": [[0.3, 1.0]], "R": [[0.2]]},
        ],
        "network": {
            "graph": {"kind": "path", "nodes": 3},
            "activation": {"kind": "broadcast", "phase": 0.5},
            "channel": {
                "loss": {"kind": "bernoulli", "delivery": 0.8},
                "delay": {"kind": "uniform", "low": 0.0, "high": 0.8},
                "symmetric": False,
            },
        },
        "filter": {"kind": kind, "model": {"F": [[1.0, 0.2], [-0.2, 1.0]], "R": [[0.4]]}},
    }
    if kind == "gossip":
        table["network"]["activation"] = {"kind": "matching", "protocol": "maximal", "phase": 0.5}
    scenario = from_table(table, tmp_path)
    by_draws, run = engine_covariance(scenario)
    exact = theory.error_covariance(scenario, run)
    np.testing.assert_allclose(by_draws, exact, rtol=1e-8, atol=1e-10)
    if kind in ("diffusion", "intermittent"):
        assert min(run.count(event) for event in ("deliver", "lost", "late")) > 0


def test_the_filter_is_conservative_where_its_model_is():
    """Cov(x - xhat_i) <= P_i at every slot in which it held at first (from the truth's start)."""
    scenario = section_vi(filter__mean=[1.0, 1.0, 1.0])
    run = netkf.simulate(scenario)
    gap = run.P - theory.error_covariance(scenario, run)
    assert np.linalg.eigvalsh(gap)[..., 0].min() > 0.0


@pytest.mark.parametrize("seed", range(3))
def test_the_normalised_outer_product_of_gaussians(seed):
    """Against half a million draws, and against one-dimensional quadrature."""
    rng = np.random.default_rng(seed)
    root, mean = rng.standard_normal((3, 2)), rng.standard_normal(3)
    phi = mean + rng.standard_normal((500_000, 2)) @ root.T
    outer = phi[:, :, None] * phi[:, None, :] / (1.0 + (phi * phi).sum(axis=1))[:, None, None]
    error = outer.std(axis=0) / np.sqrt(len(phi))
    got = normalised_outer(mean[None], root @ root.T)[0]
    assert (np.abs(outer.mean(axis=0) - got) <= 5.0 * error + 1e-12).all()

    def density(x):
        return x * x / (1.0 + x * x) * np.exp(-((x - mean[0]) ** 2) / 0.18) / np.sqrt(0.18 * np.pi)

    line = scipy.integrate.quad(density, mean[0] - 6.0, mean[0] + 6.0, epsabs=1e-13)[0]
    assert normalised_outer(mean[None, :1], np.array([[0.09]]))[0, 0, 0] == pytest.approx(
        line, abs=1e-12
    )


def test_regressors_beyond_the_range_of_numbers_have_no_level():
    scenario = netkf.load(SCENARIOS / "diffusion_regression.toml", {"horizon": 8.0, "probe": 1.0})
    growing = np.asarray(scenario.sensors[0].A) * 1e15
    with pytest.raises(netkf.TheoryError, match="beyond the range of numbers"):
        netkf.theory.information_level(scenario.replace({"sensors.0.A": growing.tolist()}))


@pytest.mark.parametrize("size", [1.0, 1e3, 1e6, 1e10, 1e100])
def test_the_normalised_outer_product_holds_for_regressors_in_any_unit(size):
    fixed = normalised_outer(np.array([[size]]), np.zeros((1, 1))).item()
    assert fixed == pytest.approx(1.0 / (1.0 + size**-2), rel=1e-13)
    # 1 - E[1 / (1 + (size z)^2)], z standard normal, is an error function.
    s = 1.0 / size
    expected = 1.0 - np.sqrt(np.pi / 2.0) * s * scipy.special.erfcx(s / np.sqrt(2.0))
    drawn = normalised_outer(np.zeros((1, 1)), np.array([[size**2]])).item()
    assert drawn == pytest.approx(expected, rel=1e-11)


@pytest.mark.slow
def test_information_level_of_section_vi():
    """D (19) for every past; numbers measured independently. No sensor alone excites."""
    scenario = section_vi()
    for window, level in ((1, 0.0), (2, 0.00365), (3, 0.00568), (10, 0.00963)):
        table = theory.information_level(scenario, 100, 1, window=window).set_index("node")
        assert table.level[-1] == pytest.approx(level, abs=6e-6)
        assert (table.loc[[0, 1, 2], ["level", "low", "high", "mean"]] == 0.0).all(axis=None)
        assert table.mean_low[-1] > table.level[-1]
    assert theory.information_level(scenario).window[0] == 2
    with pytest.raises(netkf.TheoryError, match="runs must be at least 2"):
        theory.information_level(scenario, runs=1)


def test_information_level_of_fixed_rows_is_a_formula(build):
    """Rows e_1 and 2 e_2: h (1/2, 4/5) / (2 (h + 1)) on the diagonal; each alone sees one axis."""
    scenario = build(
        plant={"kind": "linear", "F": np.eye(2), "Q": np.eye(2), "period": 1.0},
        sensors=[
            {"nodes": [0], "H": [[1.0, 0.0]], "R": [[1.0]]},
            {"nodes": [1], "H": [[0.0, 2.0]], "R": [[1.0]]},
        ],
        probe=1.0,
        network={"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        filter={"kind": "diffusion"},
    )
    table = theory.information_level(scenario)
    assert table.window.tolist() == [1, 1, 1]
    assert table.level.tolist() == pytest.approx([0.125, 0.0, 0.0], rel=1e-12)
    table = theory.information_level(scenario, window=3)
    assert table[["level", "mean"]].iloc[0].tolist() == pytest.approx([0.1875, 0.1875], rel=1e-12)


def test_the_mean_information_level_is_an_integral_over_the_laws_of_regressors(build):
    """s = 3 in slot 0, then s <- 0.8 s + xi: phi = 2 s is normal j slots after each of three."""
    sensor = {"kind": "regressor", "nodes": [0], "A": [[0.8]], "B": [[1.0]], "C": [[2.0]]}
    scenario = build(
        plant={"kind": "linear", "F": [[1.0]], "Q": [[1.0]], "period": 1.0},
        sensors=[{**sensor, "R": [[1.0]], "start": [3.0], "xi_cov": [[0.3]]}],
        horizon=3.0,
        probe=1.0,
        network={"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
        filter={"kind": "diffusion"},
    )

    def excitation(slot):
        mean, deviation = 2.0 * 3.0 * 0.8**slot, 2.0 * math.sqrt(0.3 * (1.0 - 0.64**slot) / 0.36)
        phi = scipy.stats.norm(mean, deviation)
        return phi.expect(lambda x: x * x / (1.0 + x * x), epsabs=1e-12)

    expected = np.mean([excitation(k + 1) + excitation(k + 2) for k in range(3)]) / 3.0
    row = theory.information_level(scenario, 4000, 2, window=2).iloc[0]
    assert row["mean_high"] - row["mean_low"] < 0.02 * expected
    # Twice the interval of 99 %: five deviations.
    assert abs(row["mean"] - expected) < row["mean_high"] - row["mean_low"]


def test_theory_that_needs_a_fixed_H_says_so():
    scenario = section_vi()
    with pytest.raises(netkf.TheoryError, match="node 0 has a regressor sensor, whose H is random"):
        scenario.observation_matrices(0)
    network = {
        "graph": {"kind": "cycle", "nodes": 3},
        "activation": {"kind": "matching", "protocol": "maximal"},
    }
    gossip = section_vi(network=network, filter={"kind": "gossip", "cov": np.eye(3).tolist()})
    assert netkf.simulate(gossip).status == "complete"
    with pytest.raises(netkf.TheoryError, match="whose H is random"):
        theory.detecting_walk(gossip)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delivery", "level"), [(0.9, 1.51), (0.7, 1.62), (0.5, 1.81), (0.3, 2.19)]
)
def test_plateaus_under_losses(delivery, level):
    """Weights renormalised; exact given regressors and losses; P never below it."""
    channel = {"loss": {"kind": "bernoulli", "delivery": delivery}}
    scenario = section_vi(horizon=2000.0, network__channel=channel, filter__mean=[1.0] * 3)
    runs = [netkf.simulate(scenario, replica=r) for r in range(4)]
    exact = [theory.error_covariance(scenario, run) for run in runs]
    means = [np.trace(e[100:], axis1=2, axis2=3).mean() for e in exact]
    assert np.mean(means) == pytest.approx(level, rel=0.03)
    for run, e in zip(runs, exact, strict=True):
        assert np.linalg.eigvalsh(run.P - e).min() > 0.0


@pytest.mark.slow
def test_plateaus_of_section_vi():
    """Exact given the regressors, over 6 runs: 1.457, 1.461, 1.453; trace of P 2.20."""
    scenario = section_vi(horizon=2000.0)
    runs = [netkf.simulate(scenario, replica=r) for r in range(6)]
    exact = [np.trace(theory.error_covariance(scenario, run), axis1=2, axis2=3) for run in runs]
    plateau = np.mean([e[100:].mean(axis=0) for e in exact], axis=0)
    np.testing.assert_allclose(plateau, [1.457, 1.461, 1.453], atol=0.02)
    trace = np.mean([np.trace(run.P[100:], axis1=2, axis2=3).mean() for run in runs])
    assert trace == pytest.approx(2.20, abs=0.03)
