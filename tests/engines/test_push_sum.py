"""The push-sum filter: reference cases through scenario files, mass, stop rules, link draws."""

import json

import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from netkf.runs.run import run_to_directory
from netkf.scenario.writing import to_toml
from tests.cases import FOLDER
from tests.conftest import SCENARIOS
from tests.engines.agreement import assert_agree

PLANAR = SCENARIOS / "push_sum_planar.toml"
CASES = json.loads((FOLDER / "push_sum.json").read_text())["cases"]


def written(case, folder):
    """The scenario file of a case, with its links and readings in tables; a slot a second."""
    rows = ["slot,phase,step,node,peer"]
    for t, (beta, steps) in enumerate(zip(case["beta"], case["beta_c"], strict=True)):
        fates = [(0, 0, beta), *((1, h, up) for h, up in enumerate(steps))]
        for phase, step, up in fates:
            links = [link for link, b in zip(case["edges"], up, strict=True) if b]
            rows += [f"{t + 1},{phase},{step},{i},{j}" for i, j in links]
            rows += [f"{t + 1},{phase},{step},{j},{i}" for i, j in links]
    (folder / "links.csv").write_text("\n".join(rows) + "\n")
    p = max(case["q"])
    rows = [",".join(["t", "node", *(f"y{k}" for k in range(p))])]
    for t, readings in enumerate(case["y"]):
        for node, y in enumerate(readings):
            if y:
                rows.append(
                    ",".join([f"{t + 1}.0", str(node), *map(repr, y), *[""] * (p - len(y))])
                )
    (folder / "readings.csv").write_text("\n".join(rows) + "\n")
    recorded = {"kind": "recorded", "path": "readings.csv"}
    table = {
        "format": 1,
        "name": case["name"],
        "horizon": float(len(case["y"])),
        "probe": 1.0,
        "plant": {"kind": "unknown", "F": case["A"], "Q": case["Q"], "period": 1.0},
        "sensors": [
            {**recorded, "nodes": [node], "H": H, "R": case["R"][node]}
            for node, H in enumerate(case["C"])
            if H
        ],
        "network": {
            "graph": {"kind": "edges", "edges": case["edges"]},
            "activation": {"kind": "recorded", "path": "links.csv"},
        },
        "filter": {
            "kind": "push-sum",
            "gamma": case["gamma"],
            "delta": case["delta"],
            "leader": case["leader"],
            "asymptotic": case["asymptotic_gains"],
            "stop": "paper",
            "tolerance": case["eps"],
            "mean": case["x0"],
            "cov": case["P0"],
        },
    }
    (folder / "case.toml").write_text(to_toml(table))
    return folder / "case.toml"


@pytest.mark.parametrize("engine", ["processes", "compiled"])
@pytest.mark.parametrize("case", CASES, ids=lambda c: c["name"])
def test_reference_cases(case, engine, tmp_path):
    run = netkf.simulate(netkf.load(written(case, tmp_path)), engine=engine)
    expected = np.array(case["out"]["xhat"])
    assert run.xhat.shape == expected.shape
    size = np.abs(expected).max(axis=-1, keepdims=True)
    assert (np.abs(run.xhat - expected) <= 1e-12 * size).all()
    P = np.array(case["out"]["P_final"])
    size = np.abs(P).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(run.P[-1] - P) <= 1e-12 * size).all()
    stops = run.events[run.events.kind == "stop"]
    first = np.array(case["out"]["stop"]).argmax(axis=0)
    wanted = {(node, float(k)) for node, k in enumerate(first) if k}
    assert {(r.node, np.floor(r.t)) for r in stops.itertuples()} == wanted


@pytest.fixture
def planar():
    return netkf.load(PLANAR).replace({"horizon": 10.0})


def fates(run, scenario, symmetric=True):
    """(slot, phase, step) -> set of links (or directions) whose messages arrived."""
    period, length = scenario.plant.period, scenario.phase_length
    gamma = scenario.filter.algorithm.gamma
    sent, arrived = {}, {}
    for row in run.events[run.events.kind.isin(["send", "deliver"])].itertuples():
        slot = int(row.t / period + 1e-9)
        step = round((row.t - slot * period - length) / length * gamma) if row.phase else 0
        link = (row.node, row.peer) if row.kind == "send" else (row.peer, row.node)
        link = tuple(sorted(link)) if symmetric else link
        sent.setdefault((slot, row.phase, step), set())
        if row.kind == "deliver":
            arrived.setdefault((slot, row.phase, step), set()).add(link)
    return {key: frozenset(arrived.get(key, ())) for key in sent}


def test_steps_share_the_time_of_their_phase(planar):
    """Slot 1 on: the mass at the start of a slot, gamma steps after the reading."""
    run = netkf.simulate(planar.replace({"network.channel.loss": {"kind": "none"}}))
    rounds = run.events[run.events.kind == "round"]
    starts = [(t, phase) for t, phase in zip(rounds.t, rounds.phase, strict=True) if t < 0.75]
    quarter = 0.25 * 0.25
    within = [(0.0, 0), *((quarter * (1.0 + h / 3.0), 1) for h in range(3))]
    expected = [(0.25 * k + t, phase) for k in (1, 2) for t, phase in within]
    np.testing.assert_allclose(starts, expected, rtol=0, atol=1e-12)
    sends = run.events[run.events.kind == "send"]
    assert len(sends) == 39 * 4 * 2 * len(planar.topology.links)
    assert run.events.t.max() < planar.horizon


def test_fresh_links_fail_anew_in_each_step_and_held_ones_once_a_slot(planar):
    for links in ("fresh", "held"):
        scenario = planar.replace({"filter.links": links, "horizon": 50.0})
        found = fates(netkf.simulate(scenario), scenario)
        slots = range(1, 200)
        steps = np.array([[found[k, 1, h] == found[k, 1, 0] for h in range(3)] for k in slots])
        mass = np.array([found[k, 0, 0] == found[k, 1, 0] for k in slots])
        assert steps.all() == (links == "held")
        assert steps[:, 1:].mean() < 0.1 or links == "held"
        assert mass.mean() < 0.1  # the mass has a draw of its own
        share = np.mean([len(found[k, 1, 2]) / 17 for k in slots])
        assert share == pytest.approx(0.7, abs=0.04)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_hearers_that_share_a_fate_hold_it_for_all_steps_of_a_slot(planar, engine):
    loss = {"kind": "shared", "delivery": 0.7, "share": 1.0}
    changes = {"filter.links": "held", "network.channel.loss": loss, "horizon": 5.0}
    scenario = planar.replace({**changes, "network.channel.symmetric": False})
    found = fates(netkf.simulate(scenario, engine=engine), scenario, symmetric=False)
    for slot in range(1, 20):
        assert found[slot, 1, 0] == found[slot, 1, 1] == found[slot, 1, 2] != found[slot, 0, 0]


def test_the_record_of_a_run_gives_the_run_again(planar, tmp_path):
    run = netkf.simulate(planar)
    rows = ["slot,phase,step,node,peer"]
    for (slot, phase, step), up in sorted(fates(run, planar).items()):
        rows += [f"{slot},{phase},{step},{i},{j}" for i, j in sorted(up)]
    # the sample at the horizon is of slot 40, whose events are beyond the half-open horizon
    (tmp_path / "links.csv").write_text("\n".join(rows) + "\n")
    text = PLANAR.read_text().replace("horizon = 112.5", "horizon = 10.0")
    text = text.replace('{ kind = "broadcast" }', '{ kind = "recorded", path = "links.csv" }')
    text = text.replace('{ kind = "bernoulli", delivery = 0.7 }', '{ kind = "none" }')
    (tmp_path / "replay.toml").write_text(text)
    again = netkf.simulate(netkf.load(tmp_path / "replay.toml"))
    np.testing.assert_array_equal(again.x, run.x)
    np.testing.assert_array_equal(again.xhat[:-1], run.xhat[:-1])
    np.testing.assert_array_equal(again.P[:-1], run.P[:-1])


def test_on_a_complete_network_without_loss_it_is_the_centralised_filter(planar):
    """With delta = N one averaging step is the mean; one round of mass is exact."""
    complete = planar.replace(
        {
            "network.graph": {"kind": "complete", "nodes": 10},
            "network.channel.loss": {"kind": "none"},
            "filter.delta": 10.0,
            "filter.gamma": 1,
        }
    )
    central = netkf.simulate(complete.replace({"filter": {"kind": "central"}}))
    for asymptotic in (False, True):
        run = netkf.simulate(complete.replace({"filter.asymptotic": asymptotic}))
        if not asymptotic:
            np.testing.assert_allclose(run.xhat, central.xhat, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(run.P, central.P, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(run.P[-1], central.P[-1], rtol=1e-3, atol=1e-6)
    assert run.count("send") == 39 * 90  # the limits are known, so no mass is exchanged


def test_a_node_by_itself_is_the_local_filter(planar):
    both = [{"nodes": [0], "H": np.eye(2, 4), "R": 0.01 * np.eye(2)}]
    graph = {"kind": "edges", "edges": [], "nodes": 1}
    alone = planar.replace({"network.graph": graph, "sensors": both})
    run = netkf.simulate(alone)
    local = netkf.simulate(alone.replace({"filter": {"kind": "local"}}))
    np.testing.assert_allclose(run.xhat, local.xhat, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(run.P, local.P, rtol=1e-9, atol=1e-15)


def test_a_run_whose_estimates_or_covariances_overflow_says_so(planar):
    """Nobody hears anything, so P of a growing plant grows; with gamma = 1 estimates may alone."""
    growing = planar.replace(
        {
            "plant.F": 8.0 * np.eye(4),
            "horizon": 100.0,
            "probe": 10.0,
            "sensors": [{"nodes": [0], "H": np.eye(4), "R": np.eye(4)}],
        }
    )
    for changes in ({"network.channel.loss.delivery": 0.0}, {"filter.asymptotic": True}):
        run = assert_agree(growing.replace({"filter.gamma": 1, **changes}))
        assert run.status == "diverged"
        # The sample is taken after the exchanges of its slot, and noticed then.
        assert run.events["kind"].iloc[-1] == "diverged"
        assert run.events["t"].is_monotonic_increasing
        assert np.isfinite(run.P[-1]).all() == ("filter.asymptotic" in changes)


def test_all_filters_meet_the_same_truth(planar):
    base = netkf.simulate(planar)
    for changes in (
        {"filter": {"kind": "local"}},
        {"filter": {"kind": "central"}},
        {"filter.gamma": 1},
        {"filter.links": "held"},
        {"network.channel.loss.delivery": 0.4},
        {"network.channel.symmetric": False},
    ):
        np.testing.assert_array_equal(netkf.simulate(planar.replace(changes)).x, base.x)
    errors = {}
    for name in ("local", "central"):
        run = netkf.simulate(planar.replace({"filter": {"kind": name}}))
        errors[name] = ((run.x[:, None] - run.xhat) ** 2)[20:].sum(axis=-1).mean()
    own = ((base.x[:, None] - base.xhat) ** 2)[20:].sum(axis=-1).mean()
    assert errors["central"] < own < errors["local"]


def test_the_network_of_a_run_does_not_depend_on_gains_or_stop_rules(planar):
    base = fates(netkf.simulate(planar), planar)
    for changes in ({"filter.stop": "safe"}, {"filter.leader": 7}, {"plant.Q": np.eye(4)}):
        changed = planar.replace(changes)
        assert fates(netkf.simulate(changed), changed) == base
    gains = netkf.simulate(planar.replace({"filter.asymptotic": True}))
    wanted = {key: up for key, up in base.items() if key[1] == 1}
    assert fates(gains, planar) == wanted


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("changes", "conserved"),
    [
        ({}, True),
        ({"filter.stop": "paper"}, True),
        ({"filter.stop": "safe"}, True),
        ({"network.channel.delay": {"kind": "uniform", "low": 0.0, "high": 0.1}}, True),
        ({"network.channel.symmetric": False}, False),
        (
            {
                "network.channel.symmetric": False,
                "network.channel.loss": {"kind": "none"},
                "network.channel.delay": {"kind": "uniform", "low": 0.0, "high": 0.1},
            },
            False,
        ),
    ],
)
def test_mass_that_drifts_is_reported(planar, changes, conserved, tmp_path, capsys):
    scenario = planar.replace({"horizon": 30.0, **changes})
    done = run_to_directory(scenario, tmp_path / "out")
    mass = json.loads((tmp_path / "out" / "summary.json").read_text())["conserved"]
    assert mass["weight"]["exact"] == 1.0
    assert mass["number"]["exact"] == 10.0
    worst = max(abs(part["drift"]) for part in mass.values())
    assert worst <= 1e-14 if conserved else worst > 1e-3
    assert mass["number"]["total"] == pytest.approx(10.0 * (1.0 + mass["number"]["drift"]))
    messages = done.summary["messages"]
    assert messages["in_flight"] == 0
    assert messages["lost"] > 0


def test_the_table_of_a_run_shows_the_mass(tmp_path, capsys):
    common = ["run", str(PLANAR), "--no-plot", "--trace", "none", "--set", "horizon=10.0"]
    assert main([*common, "--out", str(tmp_path / "a")]) == 0
    printed = capsys.readouterr()
    assert "mass: weight 1 of 1 (" in printed.out
    assert "drifting" not in printed.out
    assert "below rho(L) = 6.68003" in printed.err
    changes = ["--set", "network.channel.symmetric=false", "--set", "filter.delta=7.0"]
    assert main([*common, *changes, "--out", str(tmp_path / "b")]) == 0
    printed = capsys.readouterr()
    assert "drifting: directions of a link do not fail together" in printed.out
    assert printed.err == ""


def test_late_messages_count_as_lost_links(planar):
    """A delay shorter than the mass phase and longer than a step of averaging."""
    late = planar.replace(
        {
            "network.channel.loss": {"kind": "none"},
            "network.channel.delay": {"kind": "constant", "seconds": 0.03},
        }
    )
    run = netkf.simulate(late)
    kinds = run.events.groupby(["kind", "phase"], observed=True).size()
    links = 2 * len(planar.topology.links)
    assert kinds["deliver", 0] == 39 * links  # 62.5 ms
    assert kinds["late", 1] == 39 * 3 * links  # 20.8 ms a step
    assert ("deliver", 1) not in kinds
    # nothing was averaged: nodes without a sensor only predict
    F = planar.plant.F
    np.testing.assert_allclose(run.xhat[2, 0], F @ run.xhat[1, 0], atol=1e-15)


def test_a_sample_at_the_horizon_is_filtered_and_makes_no_events(planar):
    long = netkf.simulate(planar.replace({"horizon": 20.0, "probe": [10.0]}))
    short = netkf.simulate(planar.replace({"probe": [10.0]}))
    np.testing.assert_array_equal(short.xhat, long.xhat)
    assert short.events.t.max() < 10.0
    both = long.events[long.events.t < 10.0].reset_index(drop=True)
    assert netkf.first_difference(both, short.events) is None
