"""Sweeps, sizing and comparisons: against formulas, single runs and simulations of one's own."""

import json
import shutil
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats

import netkf
from netkf.cli.main import main
from netkf.core.errors import ScenarioError, TheoryError
from netkf.ensembles.pools import PoolOptions
from netkf.runs.simulate import choose_engine
from netkf.scenario.reading import from_table
from netkf.studies.compare import compare
from netkf.studies.metrics import (
    RunMetrics,
    all_nodes,
    block_metrics,
    bound_traces,
    central_traces,
    expected_errors_known,
    expected_metrics,
    is_one_truth,
    join_batches,
)
from netkf.studies.parameter_grid import parse_grid, parse_interval, table_column
from netkf.studies.search import size
from netkf.studies.sweep import plan_sweep, sweep, sweep_to_directory
from netkf.studies.tables import format_answer, format_sweep
from netkf.studies.targets import Target, parse_target, quantity_by_simulation
from tests.conftest import SCENARIOS

RING = str(SCENARIOS / "poisson_ring.toml")
RATE = "network.activation.rate"
SCALAR = {
    "plant": {"kind": "linear", "F": [[1.1]], "Q": [[1.0]], "period": 1.0, "cov": [[2.0]]},
    "sensors": [{"nodes": [0, 1], "H": [[1.0]], "R": [[0.5]]}],
    "network": {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}},
    "horizon": 12.0,
    "probe": 1.0,
}


@pytest.fixture
def short(ring):
    return ring.replace({"horizon": 3.0})


def scalar_traces(slots, predicts, R=0.5):
    """The textbook recursion of one state with one reading a slot."""
    P, found = 2.0, []
    for _ in range(slots):
        if predicts:
            P = 1.1**2 * (P - P * P / (P + R)) + 1.0
        else:
            P = 1.1**2 * P + 1.0
            P = P - P * P / (P + R)
        found.append(P)
    return np.mean(found)


# Grids


def test_graphs_of_networkx_are_told_apart_by_their_links(short):
    networkx = pytest.importorskip("networkx")
    graphs = [networkx.cycle_graph(6), networkx.path_graph(6)]
    found = sweep(short, {"network.graph": graphs}, runs=2, workers=1)["network.graph"]
    assert [text.count("], [") for text in found] == [5, 4]
    with pytest.raises(ScenarioError, match=r"network\.graph.*a link must join two nodes"):
        sweep(short, {"network.graph": [networkx.Graph([(0, 0)])]})


def test_grids_are_lists_ranges_tables_and_words():
    texts = ["a.b=1,2.5", 'f={kind="local"},{kind="hybrid", epsilon=0.3}', "w=metropolis,fast"]
    texts += ["n=1:5:3", "x=0:1:5", "R=[[1.0]],[[2.0, 3.0]]", 's="a,b",c']
    grid = parse_grid(texts)
    assert grid == {
        "a.b": [1, 2.5],
        "f": [{"kind": "local"}, {"kind": "hybrid", "epsilon": 0.3}],
        "w": ["metropolis", "fast"],
        "n": [1, 3, 5],
        "x": [0.0, 0.25, 0.5, 0.75, 1.0],
        "R": [[[1.0]], [[2.0, 3.0]]],
        "s": ["a,b", "c"],
    }
    assert isinstance(grid["n"][0], int)
    assert parse_interval("k.p=1:20") == ("k.p", 1, 20)
    assert parse_interval("k=0.5:2") == ("k", 0.5, 2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sweep", RING, "--vary", "rate"], "--vary: must be KEY.PATH=VALUE"),
        (["sweep", RING, "--vary", f"{RATE}=1,2", "--vary", f"{RATE}=3"], "is varied twice"),
        (["sweep", RING, "--vary", f"{RATE}=1,2,1.0"], f"{RATE} has one value 2 times; got '1.0'"),
        (
            ["sweep", RING, "--set", f"{RATE}=1", "--vary", f"{RATE}=1,2"],
            f"{RATE} replaces what --set or --seed gives for {RATE}",
        ),
        (
            ["sweep", RING, "--seed", "1", "--vary", "seed=1,2"],
            "seed replaces what --set or --seed",
        ),
        (["sweep", RING, "--vary", f"{RATE}=1,-2"], f"at {RATE} = -2: {RATE}: must be a finite"),
        (["sweep", RING, "--vary", "network.activation.rat=1"], "is not a key here"),
        (
            [
                "sweep",
                RING,
                "--vary",
                f"{RATE}=1,2",
                "--vary",
                'network.activation={kind="poisson"}',
            ],
            f"network.activation replaces the values of {RATE}",
        ),
        (
            ["sweep", RING, "--vary", "sensors.0.R=1", "--vary", "sensors[0].R=2"],
            "give all values in one list",
        ),
        (["sweep", RING, "--vary", f"{RATE}=1:5:1"], "must be START:STOP:COUNT"),
        (["sweep", RING, "--vary", f"{RATE}=a:b:3"], "must be START:STOP:COUNT"),
        (["sweep", RING, "--vary", f"{RATE}=1:2:9999", "--vary", "horizon=1:2:9"], "is a grid of"),
        (["sweep", RING, "--vary", f"{RATE}=[1,"], "is not valid TOML"),
        (["sweep", RING, "--vary", f"{RATE}={'1,' * 60_000}"], "must have at most 100,000 char"),
        (["size", RING, "--vary", f"{RATE}=1", "--target", "mean_rms<=1"], "must be LOW:HIGH"),
        (["size", RING, "--vary", f"{RATE}=5:1", "--target", "mean_rms<=1"], "lower to a higher"),
        (["size", RING, "--vary", f"{RATE}=1:nan", "--target", "mean_rms<=1"], "must be LOW:HIGH"),
        (["size", RING, "--vary", f"{RATE}=-1:2", "--target", "mean_rms<=1"], "above 0"),
        (["size", RING, "--vary", "name=1:2", "--target", "mean_rms<=1"], "must be a number in"),
        (["size", RING, "--vary", "plant.C=1:2", "--target", "mean_rms<=1"], "is not a key of"),
        (
            ["size", RING, "--vary", "network.graph.nodes=4.5:8", "--target", "mean_rms<=1"],
            "LOW:HIGH must be integers",
        ),
        (["size", RING, "--vary", f"{RATE}=1:2", "--target", "rms<=1"], "--target: must be QUANT"),
        (["size", RING, "--vary", f"{RATE}=1:2", "--target", "mean_rms<=-1"], "above 0"),
        (["size", RING, "--vary", f"{RATE}=1:2", "--target", "quantile_101<=1"], "--target: must"),
        (["size", RING, "--vary", f"{RATE}=1:2", "--target", "mean_rms>=1"], "--target: must be"),
        (
            [
                "size",
                RING,
                "--vary",
                f"{RATE}=1:2",
                "--vary",
                "seed=1:2",
                "--target",
                "mean_rms<=1",
            ],
            "is given more than once",
        ),
        (
            ["size", RING, "--vary", f"{RATE}=1:2", "--target", "mean_rms<=1", "--runs", "3"],
            "--runs: must be an integer of at least 32",
        ),
        (
            ["size", RING, "--vary", f"{RATE}=1:2", "--target", "mean_rms<=1", "--confidence", "2"],
            "--confidence: must be a finite number",
        ),
        (["compare", "nowhere"], "nowhere: cannot be opened: it does not exist"),
        (["compare", str(SCENARIOS)], "is not the directory of a run"),
    ],
)
def test_mistakes_are_refused_in_one_line_and_nothing_is_written(
    arguments, words, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("netkf: ")
    assert printed.err.count("\n") == 1
    assert words in printed.err
    assert list(tmp_path.iterdir()) == []


# Sweeps


def test_a_row_is_what_single_runs_say(short):
    table = sweep(short, {RATE: [1.0, 6.0]}, runs=3, workers=1)
    assert table[RATE].tolist() == [1.0, 6.0]
    for rate, row in zip(table[RATE], table.to_dict("records"), strict=True):
        scenario = short.replace({RATE: rate})
        runs = [netkf.simulate(scenario, replica=k) for k in range(3)]
        square = np.array(
            [((r.x[1:, None] - r.xhat[1:]) ** 2).sum(axis=2).mean(axis=0) for r in runs]
        )
        trace = np.array([np.trace(r.P[1:], axis1=2, axis2=3).mean(axis=0) for r in runs])
        node = square.mean(axis=0).argmax()
        assert row["worst_rms"] == pytest.approx(np.sqrt(square.mean(axis=0).max()))
        error = square[:, node].std(ddof=1) / np.sqrt(3) / (2.0 * row["worst_rms"])
        assert row["worst_rms_se"] == pytest.approx(error)
        assert row["mean_rms"] == pytest.approx(np.sqrt(square.mean()))
        assert row["mean_trace"] == pytest.approx(trace.mean())
        assert row["worst_trace"] == pytest.approx(trace.mean(axis=0).max())
        assert row["sent"] == pytest.approx(np.mean([r.count("send") for r in runs]))
        bound = netkf.theory.covariance_bound(scenario, scenario.times)[1:]
        assert row["bound"] == pytest.approx(np.trace(bound, axis1=2, axis2=3).mean())
        assert row["status"] == "complete"


def test_places_meet_the_same_truth_and_workers_change_nothing(short):
    """With a filter that does not talk the network makes no difference: equal to the last bit."""
    grid = {RATE: [1.0, 6.0], "filter": [{"kind": "local"}, {"kind": "hybrid", "epsilon": 0.3}]}
    one = sweep(short, grid, runs=4, workers=1)
    assert one["worst_rms"][0] == one["worst_rms"][2]
    assert one["worst_rms"][1] != one["worst_rms"][3]
    assert one["filter"][0] == '{ kind = "local" }'
    pd.testing.assert_frame_equal(sweep(short, grid, runs=4, workers=2), one)


def test_the_command_writes_table_picture_and_manifest(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["sweep", RING, "--set", "horizon=2.0", "--vary", f"{RATE}=1.0,4.0", "--runs", "2"]
    assert main([*arguments, "--out", str(out), "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert "network.activation.rate" in printed
    assert "2 points of 2 runs" in printed
    names = {"scenario.toml", "manifest.json", "sweep.parquet", "sweep.csv", "sweep.png"}
    assert {p.name for p in out.iterdir()} == names
    table = pd.read_parquet(out / "sweep.parquet")
    pd.testing.assert_frame_equal(pd.read_csv(out / "sweep.csv"), table)
    expected = sweep(netkf.load(RING, {"horizon": 2.0}), {RATE: [1.0, 4.0]}, runs=2, workers=1)
    pd.testing.assert_frame_equal(table, expected)
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["status"] == "complete"
    assert manifest["vary"] == {RATE: [1.0, 4.0]}
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert main([*arguments, "--out", str(out)]) == 2


SAMPLED = {
    "format": 1,
    "name": "sampled",
    "plant": {"kind": "diffusion", "A": [[-0.2]], "B": [[1.0]], "cov": [[1.0]]},
    "sensors": [
        {
            "nodes": [0],
            "H": [[1.0]],
            "R": [[0.1]],
            "sampling": {"kind": "periodic", "period": 0.5},
        }
    ],
    "network": {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "poisson", "rate": 1.0},
    },
    "filter": {"kind": "local"},
    "horizon": 4.0,
    "probe": 1.0,
}
POISSON = {"kind": "poisson", "rate": 2.0}


@pytest.mark.parametrize(
    ("factor", "one"),
    [(1.0, True), (1.0 + 1e-12, True), (1.0 - 1e-12, True), (1.0 + 1e-6, False), (-1.0, False)],
)
def test_rounding_leaves_one_truth(factor, one):
    x = np.array([[1.0, -2.0, 0.0], [np.inf, np.nan, 3.0], [1e-300, 0.0, 0.0]])
    assert is_one_truth(x, factor * x) == is_one_truth(factor * x, x) == one


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("key", "values", "moved"),
    [
        ("sensors.0.sampling.period", [0.5, 1.0, 0.3], ()),
        ("sensors.0.sampling", [POISSON, {"kind": "periodic", "period": 1.0}], ()),
        ("probe", [1.0, 0.25], ()),
        ("sensors.0.nodes", [[0], [0, 1]], ()),
        ("horizon", [4.0, 3.0], ()),
        ("plant.B", [[[1.0]], [[2.0]], [[1.5]]], (1, 2)),
        ("plant.schedule", [[{"from": t, "A": [[-2.0]]}] for t in (30.0, 25.0, 39.0)], (1, 2)),
        ("filter.model.input", [True, False], ()),
        ("sensors.0.sampling", [POISSON, "continuous"], (1,)),
    ],
)
def test_sweeps_meet_one_truth_or_say_another(key, values, moved):
    """Rows keep their truth whatever is sampled; what moves it is marked in the status."""
    scenario = from_table(SAMPLED, Path())
    if key in ("plant.schedule", "filter.model.input"):
        driven = {"kind": "sine", "G": [[1.0]], "amplitude": 3.0, "frequency": 0.2}
        scenario = scenario.replace({"horizon": 40.0, "plant.input": driven})
    table = sweep(scenario, {key: values}, workers=1, engine="simpy")
    assert [k for k, status in enumerate(table.status) if "another truth" in status] == [*moved]
    runs = [netkf.simulate(scenario.replace({key: value}), engine="simpy") for value in values]
    for k, run in enumerate(runs):
        _, here, there = np.intersect1d(runs[0].times, run.times, return_indices=True)
        assert np.allclose(runs[0].x[here], run.x[there], rtol=0, atol=1e-12) != (k in moved)


def test_values_of_several_types_share_a_column(tmp_path):
    """Numbers beside lists, TOML's times, and numbers of many digits can be stored."""
    scenario = from_table(SAMPLED, Path())
    grid = {"probe": [1.0, [2.0, 3.0]], "time.origin": [datetime(2020, 1, 1), 5.0]}
    plan = plan_sweep(scenario, grid, engine="simpy")
    table = sweep_to_directory(plan, tmp_path / "out", PoolOptions(1)).table
    stored = pd.read_parquet(tmp_path / "out" / "sweep.parquet")
    assert list(stored["probe"]) == list(table["probe"]) == ["1.0"] * 2 + ["[2.0, 3.0]"] * 2
    assert list(stored["time.origin"]) == ["2020-01-01T00:00:00", "5.0"] * 2
    assert table_column([1, 10**25]) == ["1", f"1{'0' * 25}"]
    assert table_column([True, 2]) == ["true", "2"]
    flags = sweep(scenario, {"network.channel.symmetric": [True, False]}, engine="simpy")
    assert [
        line.split()[0]
        for line in format_sweep(flags, ("network.channel.symmetric",)).split("\n")[2:]
    ] == ["true", "false"]


def test_the_centralised_filter_follows_changes_of_the_plant():
    """Its trace beside that of the scalar Riccati equation, whose A changes at 1 s."""
    changed = {"plant.schedule": [{"from": 1.0, "A": [[0.5]]}], "sensors.0.sampling": "continuous"}
    scenario = from_table(SAMPLED, Path()).replace(changed)

    def slope(t, P):
        return (-0.4 if t <= 1.0 else 1.0) * P + 1.0 - 10.0 * P**2

    before = scipy.integrate.solve_ivp(slope, (0.0, 1.0), [1.0], rtol=1e-9).y[0, -1]
    after = scipy.integrate.solve_ivp(slope, (1.0, 4.0), [before], rtol=1e-9, t_eval=[2, 3, 4])
    assert central_traces(scenario) == pytest.approx(np.mean([before, *after.y[0]]), rel=1e-5)


def test_json_of_a_sweep_is_one_document(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["sweep", RING, "--set", "horizon=1.0", "--vary", f"{RATE}=1.0,4.0", "--json"]
    assert main([*arguments, "--workers", "1", "--no-plot"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert [row[RATE] for row in found["rows"]] == [1.0, 4.0]
    assert found["rows"][0]["mean_rms_se"] is None
    assert (tmp_path / "runs" / "poisson-ring-sweep-1" / "sweep.csv").exists()


def test_an_interrupted_sweep_keeps_its_rows(short, tmp_path):
    def impatient(done, wanted):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep_to_directory(
            plan_sweep(short, {RATE: [1.0, 2.0]}),
            tmp_path / "o",
            PoolOptions(1),
            progress=impatient,
        )
    manifest = json.loads((tmp_path / "o" / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    assert manifest["runs"] == {"wanted": 2, "done": 1}
    assert len(pd.read_csv(tmp_path / "o" / "sweep.csv")) == 1


def test_references_are_the_textbook_recursion(build):
    """Both nodes read the state with R = 0.5: together that is one reading with R = 0.25."""
    for kind, predicts in (("local", False), ("central", False), ("gossip", True)):
        changes = {**SCALAR, "filter": {"kind": kind}}
        if kind == "gossip":
            matching = {"kind": "matching", "protocol": "maximal"}
            changes["network"] = {**SCALAR["network"], "activation": matching}
        scenario = build(**changes)
        assert central_traces(scenario) == pytest.approx(scalar_traces(12, predicts, R=0.25))
        if kind == "gossip":
            with pytest.raises(TheoryError):
                bound_traces(scenario)
            continue
        R = 0.25 if kind == "central" else 0.5
        np.testing.assert_allclose(bound_traces(scenario), scalar_traces(12, False, R))


# Sizing


@pytest.mark.parametrize("quantity", ["mean_trace", "worst_rms"])
def test_theory_finds_the_root_of_the_recursion(build, quantity):
    """A filter by itself is exact: the answer is that of the plain recursion to four digits."""
    scenario = build(**SCALAR, filter={"kind": "local"})
    limit = 0.7 if quantity == "mean_trace" else 0.7**0.5
    found = size(scenario, "sensors.0.R.0.0", 0.1, 5.0, f"{quantity}<={limit!r}")
    root = scipy.optimize.brentq(lambda R: scalar_traces(12, False, R) - 0.7, 0.1, 5.0)
    assert found.by == "theory"
    assert found.quantity == "exact: the covariance of filters that do not talk"
    assert found.grows
    assert found.value <= root < found.misses < 1.002 * found.value


def test_samples_at_random_times_make_theory_a_bound(build):
    """P is random then, and below the bound on its mean on average: no value is missed by it."""
    sampled = {"nodes": [0], "H": [[1.0]], "R": [[0.1]], "sampling": {"kind": "poisson", "rate": 1}}
    plant = {"kind": "diffusion", "A": [[0.2]], "B": [[1.0]], "cov": [[1.0]]}
    network = {"graph": {"kind": "path", "nodes": 1}}
    scenario = build(plant=plant, sensors=[sampled], network=network, filter={"kind": "local"})
    found = size(scenario, "sensors.0.sampling.rate", 0.5, 5.0, "worst_trace<=1", by="theory")
    assert {probe.by for probe in found.probes} == {"bound"}
    assert "missed" not in {probe.target for probe in found.probes}
    assert size(scenario, "sensors.0.R.0.0", 0.1, 1.0, "mean_rms<=1", runs=32).by == "both"
    with pytest.raises(TheoryError, match="sample at random times"):
        size(scenario, "sensors.0.R.0.0", 0.1, 1.0, "within_central<=2", runs=32)


def test_a_bound_by_theory_is_kept_in_a_simulation_of_its_own(short):
    found = size(short, RATE, 0.5, 50.0, "mean_trace<=3.0", by="theory")
    assert found
    assert found.by == "theory"
    assert "H(12)" in found.quantity
    assert not found.grows
    assert found.misses < found.value < 1.002 * found.misses
    bound = [
        bound_traces(short.replace({RATE: rate})).mean() for rate in (found.value, found.misses)
    ]
    assert bound[0] <= 3.0 < bound[1]
    ensemble = netkf.monte_carlo(short.replace({RATE: found.value}), runs=40, seed=77, workers=1)
    mean, error = ensemble.average[-1, 1], ensemble.se_average[-1, 1]
    assert mean - 4.0 * error <= 3.0


def test_a_bound_is_called_a_bound(short):
    """At the value below, the bound is above the limit: that is not said to miss it."""
    found = size(short, RATE, 0.5, 50.0, "mean_trace<=3.0", by="theory")
    assert {p.by for p in found.probes} == {"bound"}
    assert {p.target for p in found.probes} == {"reached", "not shown"}
    assert all(p.low == 0.0 for p in found.probes)
    text = format_answer(found)
    assert "for which the bound shows mean_trace <= 3" in text
    assert "misses" not in text
    assert "proves nothing" in found.sure


@pytest.mark.slow
def test_where_the_bound_says_no_it_is_simulated(short):
    """The bound on worst_rms asks for far more than simulation says is needed."""
    target = "worst_rms<=1.7"
    bound = size(short, RATE, 0.5, 50.0, target, by="theory")
    found = size(short, RATE, 0.5, 50.0, target, runs=64, workers=1)
    assert found.by == "both"
    assert found.value < bound.value
    for probe in found.probes:
        assert (probe.by == "bound") == (probe.runs == 0)
        assert probe.by == "simulation" or probe.target == "reached"
    # a simulation of its own agrees with both decisions
    for value, word in ((found.value, "reached"), (min(p.value for p in found.probes), "missed")):
        assert next(p for p in found.probes if p.value == value).target == word
        own = netkf.monte_carlo(short.replace({RATE: value}), runs=300, seed=88, workers=1)
        square, error = own.average[:-1, 0], own.se_average[:-1, 0]
        worst = int(np.argmax(square))
        assert (square[worst] - 4.0 * error[worst] <= 2.89) or word == "missed"
        assert (square[worst] + 4.0 * error[worst] > 2.89) or word == "reached"


@pytest.mark.slow
def test_a_target_under_burst_losses_takes_a_handful_of_runs(ring):
    """Eight nodes of a grid: 600 runs with squared errors leave this undecided."""
    made = ring.replace(
        {
            "network.graph": {"kind": "grid", "rows": 2, "columns": 4},
            "sensors.0.nodes": [0, 7],
            "network.channel.loss": {"kind": "gilbert-elliott", "to_bad": 0.1, "to_good": 0.3},
            "filter.epsilon": 0.25,
            "horizon": 3.0,
        }
    )
    found = size(made, RATE, 2.0, 12.0, "worst_rms<=1.8", runs=64, workers=1)
    assert found
    assert found.by == "simulation"
    assert sum(probe.runs for probe in found.probes if probe.target != "undecided") < 300
    own = netkf.monte_carlo(made.replace({RATE: found.value}), runs=600, seed=4, workers=1)
    square, error = own.average[:-1, 0], own.se_average[:-1, 0]
    worst = int(np.argmax(square))
    assert square[worst] - 4.0 * error[worst] <= 1.8**2 < square[worst] + 4.0 * error[worst]


def test_a_range_that_is_too_small_gets_another(short):
    low = size(short, RATE, 20.0, 40.0, "mean_trace<=3.0", by="theory")
    assert low.value == 20.0
    assert low.advice == f"next range: --vary {RATE}=2:20"
    none = size(short, RATE, 1.0, 2.0, "mean_trace<=3.0", by="theory")
    assert none.value is None
    span = none.advice.removeprefix(f"next range: --vary {RATE}=")
    further = size(short, RATE, *map(float, span.split(":")), "mean_trace<=3.0", by="theory")
    assert further
    never = size(short, RATE, 1.0, 2.0, "mean_trace<=0.1", by="theory")
    assert "hardly changes" in never.advice
    loss = "network.channel.loss.delivery"
    full = size(short, loss, 0.5, 1.0, "mean_trace<=2.45", by="theory")
    assert not full
    assert "cannot be" in full.advice or "hardly changes" in full.advice


def test_a_value_too_close_to_the_limit_is_given_up(short):
    """The limit is the estimate of a quarter of the runs, so that no number of runs decides."""
    made = short.replace({"horizon": 1.0})
    ensemble = netkf.monte_carlo(made.replace({RATE: 5.0}), runs=100, workers=1)
    limit = float(ensemble.average[-1, 1])
    target = f"mean_trace<={limit!r}"
    found = size(made, RATE, 1.0, 5.0, target, by="simulation", runs=400, workers=1)
    close = next(p for p in found.probes if p.value == 5.0)
    assert close.target == "undecided"
    assert close.runs < 400
    assert "would tell" in found.advice or "too close" in found.advice
    assert found.table["by"].eq("simulation").all()


def test_a_search_tells_its_progress_to_a_terminal_alone(short, capsys):
    lines: list[str] = []
    size(short, RATE, 0.5, 50.0, "mean_trace<=2.5", by="simulation", runs=64, progress=lines.append)
    assert any("simulating" in line for line in lines)
    assert any("after 32 of at most 64 runs" in line for line in lines)
    arguments = ["size", RING, "--set", "horizon=2.0", "--vary", f"{RATE}=0.5:50", "--runs", "64"]
    main([*arguments, "--target", "mean_trace<=2.5", "--by", "simulation"])
    assert "simulating" not in capsys.readouterr().err


def test_simulation_brackets_what_a_long_simulation_says(build):
    scenario = build(**SCALAR, filter={"kind": "intermittent"})
    scenario = scenario.replace({"network.channel.loss": {"kind": "bernoulli", "delivery": 0.5}})
    key = "network.channel.loss.delivery"
    found = size(scenario, key, 0.05, 0.95, "worst_trace<=1.37", runs=128, workers=1)
    assert found.by == "simulation"
    assert found
    assert not found.grows
    assert found.misses < found.value
    assert all(p.low <= p.quantity <= p.high for p in found.probes)
    check = netkf.monte_carlo(scenario.replace({key: found.value}), runs=120, seed=99, workers=1)
    assert check.average[:-1, 1].max() - 4.0 * check.se_average[:-1, 1].max() <= 1.37
    missed = [p.value for p in found.probes if p.target == "missed"]
    check = netkf.monte_carlo(scenario.replace({key: max(missed)}), runs=120, seed=99, workers=1)
    assert check.average[:-1, 1].max() + 4.0 * check.se_average[:-1, 1].max() > 1.37


def test_exact_errors_given_the_events_have_the_mean_of_squared_ones(build):
    """And so little spread that the first batch decides what 200 runs would not."""
    network = {"graph": {"kind": "path", "nodes": 2}}
    network["activation"] = {"kind": "matching", "protocol": "one-edge", "lazy": 0.5}
    network["channel"] = {"loss": {"kind": "bernoulli", "delivery": 0.5}}
    sensors = [{"nodes": [0], "H": [[1.0]], "R": [[0.5]]}]
    changes = {**SCALAR, "network": network, "sensors": sensors, "filter": {"kind": "gossip"}}
    scenario = build(**changes)
    assert expected_errors_known(scenario)
    engine = choose_engine("auto", scenario)
    exact = join_batches(*(expected_metrics(scenario, 0, k, engine) for k in range(60)))
    plain = block_metrics(scenario, 0, range(60), engine)
    one, other = (all_nodes(found.mean_square) for found in (exact, plain))
    assert abs(one.value - other.value) < 4.0 * np.hypot(one.error, other.error)
    assert one.error < 0.7 * other.error
    assert all_nodes(exact.trace) == pytest.approx(all_nodes(plain.trace), rel=1e-12)
    # Where runs are cheap, thousands of them cost less than the covariances of a few.
    for most, said in ((32, True), (None, False)):
        key = "network.channel.loss.delivery"
        found = size(scenario, key, 0.1, 1.0, "worst_rms<=2.4", runs=most, workers=1)
        assert ("exact expected squared error" in found.quantity) == said
    assert 1000 < found.table["runs"].max() <= 10_000


def test_integers_are_searched_as_integers(ring):
    found = size(ring.replace({"horizon": 2.0}), "network.graph.nodes", 4, 40, "worst_trace<=3.5")
    assert all(isinstance(probe.value, int) for probe in found.probes)
    if found and found.misses is not None:
        assert abs(found.value - found.misses) == 1


def test_all_of_the_range_and_none_of_it(short):
    every = size(short, RATE, 1.0, 2.0, "mean_trace<=100")
    assert every.value == 1.0
    assert every.misses is None
    none = size(short, RATE, 1.0, 2.0, "mean_trace<=0.1")
    assert not none
    assert len(none.table) == 3


def test_a_target_that_only_the_middle_reaches(build):
    """P of a plant with x[k+1] = F x[k] + w[k] is large for large F of either sign."""
    scenario = build(**SCALAR, filter={"kind": "local"}).replace({"horizon": 3.0})
    P, found_P = 2.0, []
    for _ in range(3):
        P = 0.9**2 * P + 1.0
        P = P - P * P / (P + 0.5)
        found_P.append(P)
    target = f"mean_trace<={np.mean(found_P):.12g}"  # so that F from -0.9 to 0.9 reaches it
    found = size(scenario, "plant.F.0.0", -1.5, 1.3, target)
    assert found.by == "theory"
    assert abs(found.value) == pytest.approx(0.9, abs=2e-4)
    assert abs(found.misses) == pytest.approx(0.9, abs=2e-4)
    assert "NOT monotone" in found.sure
    assert "reaches" in format_answer(found)
    every = size(scenario, "sensors.0.H.0.0", -2.0, -1.0, "mean_trace<=9", by="theory")
    assert every.advice == "next range: --vary sensors.0.H.0.0=-1:-0.1"


def test_theory_that_does_not_tell_is_refused_or_replaced(short):
    renewal = {"kind": "renewal", "distribution": "gamma", "shape": 4.0, "mean": 0.5}
    other = short.replace({"network.activation": renewal})
    with pytest.raises(TheoryError, match="not promised"):
        size(other, "network.activation.mean", 0.1, 1.0, "mean_trace<=3.0", by="theory")
    wrong = short.replace({"filter.model": {"R": [[0.5]]}})
    with pytest.raises(TheoryError, match="model differs"):
        size(wrong, RATE, 0.5, 5.0, "worst_rms<=3.0", by="theory")
    # P is that of the model, whatever is true.
    believed = short.replace({"sensors.0.R": [[0.5]]})
    told, expected = (
        size(one, RATE, 0.5, 5.0, "mean_trace<=3.0", by="theory").probes
        for one in (wrong, believed)
    )
    assert [p.quantity for p in told] == pytest.approx([p.quantity for p in expected], rel=1e-9)
    sure = short.replace({"filter.cov": [[0.1, 0.0], [0.0, 0.1]]})
    with pytest.raises(TheoryError, match="below the covariance of the first error"):
        size(sure, RATE, 0.5, 5.0, "worst_rms<=3.0", by="theory")


def test_a_quantity_that_is_not_monotone_is_told(monkeypatch, short):
    values = {1.0: 5.0, 4.0: 1.0, 2.0: 6.0}

    def made_up(scenario, target):
        return values.get(scenario.network.activation.rate, 0.9), "made up"

    monkeypatch.setattr("netkf.studies.search.quantity_by_theory", made_up)
    found = size(short, RATE, 1.0, 4.0, "mean_trace<=2", by="theory")
    assert "NOT monotone between 1 and 2" in found.sure


def test_the_command_says_the_value_or_that_there_is_none(capsys):
    arguments = ["size", RING, "--set", "horizon=2.0", "--vary", f"{RATE}=0.5:50"]
    assert main([*arguments, "--target", "mean_trace<=2.5"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "is the smallest that reaches mean_trace <= 2.5" in printed.out
    assert main([*arguments, "--target", "mean_trace<=0.01", "--json"]) == 1
    printed = capsys.readouterr()
    assert printed.err == (f"netkf: no value of {RATE} in 0.5 .. 50 reaches mean_trace <= 0.01\n")
    found = json.loads(printed.out, parse_constant=pytest.fail)
    assert found["value"] is None
    assert len(found["probes"]) == 3


def test_intervals_hold_as_often_as_they_say():
    """Of the largest of three means of skewed variables whose true values are known."""
    random, misses, level = np.random.default_rng(5), 0, 0.1
    for _ in range(300):
        square = random.gamma(4.0, 0.25, size=(64, 3)) * [1.0, 1.0, 0.8]
        figures = RunMetrics(
            square, square, np.zeros((64, 5)), np.zeros((64, 1)), np.full((64, 1), np.inf)
        )
        interval = quantity_by_simulation(figures, Target("worst_rms", 1.0), level, None)
        misses += not interval.low <= 1.0 <= interval.high
    assert misses <= scipy.stats.binom.ppf(0.999, 300, level)
    assert parse_target(" worst_rms <= 0.5 ") == Target("worst_rms", 0.5)


def test_a_run_that_diverges_has_errors_without_end():
    square = np.ones((20, 2))
    diverged = np.zeros((20, 1))
    figures = RunMetrics(square, square, np.zeros((20, 5)), diverged, np.full((20, 1), np.inf))
    assert quantity_by_simulation(figures, Target("worst_rms", 2.0), 0.05, None).high == 1.0
    diverged[3] = 1
    interval = quantity_by_simulation(figures, Target("worst_rms", 2.0), 0.05, None)
    assert interval.low == interval.high == np.inf


def test_errors_of_a_truth_that_nobody_knows_are_no_target(tmp_path):
    readings = "".join(f"{k}.0,0,{k}.5\n" for k in range(7))
    (tmp_path / "r.csv").write_text(f"t,node,y0\n{readings}")
    plant = {"kind": "unknown", "F": [[1.0]], "Q": [[1.0]], "period": 1.0, "cov": [[1.0]]}
    sensor = {"kind": "recorded", "nodes": [0], "path": "r.csv", "H": [[1.0]], "R": [[0.5]]}
    table = {"format": 1, "name": "real", **SCALAR, "plant": plant, "sensors": [sensor]}
    table |= {"network": {"graph": {"kind": "path", "nodes": 2}}, "filter": {"kind": "local"}}
    scenario = from_table({**table, "horizon": 6.0}, tmp_path)
    with pytest.raises(ScenarioError, match="there is no ground truth"):
        size(scenario, "horizon", 2.0, 6.0, "worst_rms<=5")
    table = sweep(scenario, {"horizon": [3.0, 6.0]}, workers=1)
    assert table["worst_rms"].isna().all()
    assert (table["mean_trace"] > 0.0).all()


@pytest.mark.slow
def test_decisions_are_right_as_often_as_they_say(build):
    """Filters that do not talk: the exact mean square error at every value is their P."""
    scenario = build(filter={"kind": "local"}, horizon=2.0)
    key, limit, wrong, answers = "sensors.0.R.0.0", 0.87, 0, 0
    exact = {}
    for seed in range(20):
        found = size(
            scenario,
            key,
            0.05,
            5.0,
            f"mean_rms<={limit}",
            by="simulation",
            runs=128,
            seed=seed,
            confidence=0.9,
            workers=1,
        )
        answers += found.value is not None
        for probe in found.probes:
            if probe.value not in exact:
                exact[probe.value] = (
                    bound_traces(scenario.replace({key: probe.value})).mean() ** 0.5
                )
            wrong += (probe.target == "reached") and exact[probe.value] > limit
            wrong += (probe.target == "missed") and exact[probe.value] <= limit
    assert wrong <= 5  # of 20 searches, each right as a whole with probability 0.9
    assert answers >= 5


def test_a_search_says_what_the_centralised_filter_has_and_which_key_helps():
    scenario = netkf.load(RING)
    found = netkf.size(scenario, RATE, 0.5, 50.0, "worst_rms<=1.8", by="theory")
    plant, sensor = scenario.plant, scenario.sensors[0]
    G = len(sensor.nodes) * sensor.H.T @ np.linalg.inv(sensor.R) @ sensor.H

    def flow(_, flat):
        P = flat.reshape(2, 2)
        return (plant.A @ P + P @ plant.A.T + plant.B @ plant.B.T - P @ G @ P).ravel()

    times = scenario.times
    P = scipy.integrate.solve_ivp(
        flow, (0.0, times[-1]), plant.start_cov.ravel(), t_eval=times, rtol=1e-10, atol=1e-12
    ).y
    error = np.sqrt((P[0] + P[3])[1:].mean())
    assert found.central.startswith(f"at {RATE} = {found.value:g} a centralised filter has RMS")
    assert f"RMS error {error:.4g} there" in found.central
    # The key that is named first helps most of those that the scenario has.
    at = scenario.replace({RATE: found.value})
    worst = {
        key: bound_traces(at.replace({key: value})).max()
        for key, value in (
            ("network.channel.loss.delivery", 0.77),
            ("filter.epsilon", 0.33),
            ("sensors.0.R", [[0.25 / 1.1]]),
        )
    }
    # Arrivals count by the product of delivery and epsilon, so that these two are one up to digits.
    first = found.central.partition("fall most with ")[2].partition(" = ")[0]
    assert worst[first] <= (1.0 + 1e-9) * min(worst.values())
    hopeless = netkf.size(scenario, RATE, 10.0, 20.0, f"worst_rms<={0.9 * error}", by="theory")
    assert not hopeless
    assert "no exchange of messages reaches the limit" in hopeless.central
    assert hopeless.advice == ""


# Comparisons


@pytest.fixture(scope="module")
def ensembles(tmp_path_factory):
    """Four directories: slow and fast links, fast ones without states, and one single run."""
    folder = tmp_path_factory.mktemp("runs")
    common = ["--set", "horizon=3.0", "--no-plot", "--workers", "1"]
    for name, rate, more in (
        ("slow", 1.0, ["--runs", "8", "--trace", "full"]),
        ("fast", 8.0, ["--runs", "8", "--trace", "full"]),
        ("bare", 8.0, ["--runs", "8", "--trace", "none"]),
        ("single", 8.0, []),
    ):
        arguments = ["run", RING, "--set", f"{RATE}={rate}", "--out", str(folder / name)]
        assert main([*arguments, *common, *more]) == 0
    return folder


def rows_of(found):
    return {(row.quantity, row.node): row.entries for row in found.rows}


def test_pairs_are_compared_run_by_run(ensembles):
    found = compare([ensembles / "slow", ensembles / "fast"], confidence=0.9)
    entry = rows_of(found)["mean_trace", -1][1]
    slow, fast = (pd.read_parquet(ensembles / n / "states.parquet") for n in ("slow", "fast"))
    traces = [
        s[s.t > 0.0].assign(trace=lambda d: d.P00 + d.P11).groupby("run")["trace"].mean()
        for s in (slow, fast)
    ]
    gaps = traces[1] - traces[0]
    judged = 6 + 4 + 6  # with the worst instant and three quantiles
    low, high = scipy.stats.ttest_1samp(gaps, 0.0).confidence_interval(1.0 - 0.1 / judged)
    assert entry.method == "paired"
    assert (entry.low, entry.high) == pytest.approx((low, high))
    assert entry.real
    assert entry.difference == pytest.approx(gaps.mean())


def test_ensembles_of_a_known_start_are_compared_run_by_run(tmp_path):
    """P(0) = 0 has no NEES: the directories were called damaged."""
    for name, rate in (("slow", 1.0), ("fast", 8.0)):
        sets = [f"{RATE}={rate}", "horizon=1.0", "filter.cov=[[0.0, 0.0], [0.0, 0.0]]"]
        sets += ["plant.cov=[[0.0, 0.0], [0.0, 0.0]]"]
        options = [part for text in sets for part in ("--set", text)]
        out = ["--out", str(tmp_path / name), "--no-plot", "--workers", "1"]
        assert main(["run", RING, *options, "--runs", "3", "--trace", "full", *out]) == 0
    found = rows_of(compare([tmp_path / "slow", tmp_path / "fast"]))
    assert found["mean_nees", -1][1].method == "paired"


def test_others_are_compared_by_their_standard_errors(ensembles):
    found = rows_of(compare([ensembles / "slow", ensembles / "bare"], confidence=0.9))
    one, two = found["rms_error", 2]
    assert two.method == "Welch"
    test = scipy.stats.ttest_ind_from_stats(
        two.value, two.se * np.sqrt(8), 8, one.value, one.se * np.sqrt(8), 8, equal_var=False
    )
    assert two.real == (test.pvalue < 0.1 / 16)
    assert found["sent", -1][1].real
    summaries = [
        json.loads((ensembles / name / "summary.json").read_text())["overall"]
        for name in ("slow", "bare")
    ]
    for name in ("worst_instant", "quantile_99"):
        a, b = ((s[name], s[f"{name}_se"] * np.sqrt(8), 8) for s in summaries)
        test = scipy.stats.ttest_ind_from_stats(*b, *a, equal_var=False)
        assert found[name, -1][1].real == (test.pvalue < 0.1 / 16)


def test_a_comparison_begins_with_the_keys_that_differ(ensembles, tmp_path, capsys):
    directories = [str(ensembles / name) for name in ("slow", "fast")]
    found = compare(directories)
    assert found.settings == ((RATE, ("1.0", "8.0")),)
    assert main(["compare", *directories]) == 0
    printed = capsys.readouterr().out
    assert printed.index(RATE) < printed.index("rms_error")
    assert compare(directories[:1] * 2).settings == ()
    other = ["--set", "sensors.0.R=[[0.5]]", "--set", "filter={kind='local'}", "--seed", "3"]
    out = str(tmp_path / "other")
    assert main(["run", RING, *other, "--set", "horizon=3.0", "--no-plot", "--out", out]) == 0
    keys = {row.key: row.values for row in compare([ensembles / "single", out]).settings}
    assert keys["sensors.0.R"] == ("[[0.25]]", "[[0.5]]")
    assert keys["filter.epsilon"] == ("0.3", "-")
    assert (keys["seed"], keys["filter.kind"]) == (("1", "3"), ('"hybrid"', '"local"'))
    assert "claim" not in keys


def test_equal_ensembles_and_single_runs_are_not_marked(ensembles):
    same = compare([ensembles / "fast", ensembles / "bare"])
    assert not any(entry.real for row in same.rows for entry in row.entries)
    single = rows_of(compare([ensembles / "fast", ensembles / "single"]))
    assert single["mean_trace", -1][1].method == "one run"
    assert single["mean_trace", -1][1].real is None


def test_the_command_compares(ensembles, capsys):
    directories = [str(ensembles / name) for name in ("slow", "fast", "single")]
    assert main(["compare", *directories]) == 0
    printed = capsys.readouterr().out
    assert "* differs from (1) for certain" in printed
    assert "they may be chance" in printed
    assert main(["compare", *directories, "--json"]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert found["runs"] == [8, 8, 1]
    assert len(found["rows"][0]["entries"]) == 3


def test_unfinished_and_spoilt_directories_are_refused(ensembles, tmp_path, capsys):
    folder = Path(shutil.copytree(ensembles / "single", tmp_path / "copy"))
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**manifest, "status": "interrupted"}))
    with pytest.raises(ScenarioError, match="did not finish"):
        compare([folder])
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "summary.json").write_text('{"nodes": 3}')
    with pytest.raises(ScenarioError, match=r"summary.json needs a list at nodes"):
        compare([folder])
    (folder / "summary.json").write_text("{")
    assert main(["compare", str(folder)]) == 2
    assert "summary.json cannot be read (JSONDecodeError)" in capsys.readouterr().err
