"""The Python face: what users touch first."""

import dataclasses
import json
import pickle

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf import theory
from netkf.ensembles.blocks import pack_scenario
from netkf.runs.run import run_to_directory


def test_directories_to_compare_are_a_list():
    with pytest.raises(netkf.ScenarioError, match=r"one list: netkf.compare\(\[one, other\]\)"):
        netkf.compare("one", "other")


def test_all_parts_can_be_taken_at_once():
    names = {}
    exec("from netkf.parts import *", names)
    assert {"Scenario", "Hybrid", "Poisson", "setting", "kinds"} <= names.keys()


def test_a_scenario_can_be_built_from_public_parts(ring):
    parts = netkf.parts
    built = netkf.Scenario(
        name="poisson-ring",
        claim=ring.claim,
        horizon=20.0,
        probe=0.5,
        seed=1,
        plant=parts.Diffusion(
            A=[[0.0, 1.0], [-1.0, 0.1]], B=[[0.0], [1.0]], mean=[0.0, 0.0], cov=np.eye(2)
        ),
        sensors=[parts.LinearSensor(nodes=[0, 3], H=[[1.0, 0.0]], R=[[0.25]])],
        network=netkf.Network(
            graph=parts.Cycle(6),
            activation=parts.Poisson(rate=2.0),
            channel=parts.Channel(loss=parts.Bernoulli(0.7)),
        ),
        filter=netkf.Filtering(parts.Hybrid(0.3), cov=np.eye(2)),
    )
    assert built == ring
    assert netkf.simulate(built).fingerprint == netkf.simulate(ring).fingerprint


def test_every_kind_has_a_name_of_its_own_among_the_parts():
    classes = {cls for names in netkf.parts.kinds().values() for cls in names.values()}
    for cls in classes:
        assert getattr(netkf.parts, cls.__name__) is cls
        assert cls.__name__ in dir(netkf.parts)
    with pytest.raises(AttributeError, match="no attribute 'Radar'"):
        _ = netkf.parts.Radar


def test_runs_and_scenarios_show_themselves_in_a_line(ring):
    run = netkf.simulate(ring)
    assert repr(run) == (
        "<netkf.Run: complete, 41 samples of 0 .. 20 s, 6 nodes, 2 states, "
        f"{len(run.log):,} events, seed 1, replica 0>"
    )
    assert repr(ring) == (
        "<netkf.Scenario 'poisson-ring': Diffusion of 2 states, Cycle of 6 nodes and 6 links, "
        "2 with sensors, Hybrid filters, 20 s, seed 1>"
    )


def test_what_is_not_loaded_is_refused(ring):
    with pytest.raises(netkf.ScenarioError, match=r"takes a netkf.Scenario; got 'a.toml'; load"):
        netkf.simulate("a.toml")
    with pytest.raises(TypeError, match="takes runs or their event tables, got 'a'"):
        netkf.first_difference("a", "b")
    run = netkf.simulate(ring.replace({"horizon": 1.0}))
    with pytest.raises(netkf.TheoryError, match=r"must be a netkf.Run.* got a DataFrame"):
        netkf.theory.error_covariance(ring, run.events)


def test_a_saved_run_is_what_netkf_run_writes(ring, tmp_path):
    written = run_to_directory(ring, tmp_path / "written").directory
    saved = netkf.save(netkf.simulate(ring), ring, tmp_path / "saved")
    assert {file.name for file in written.iterdir()} == {file.name for file in saved.iterdir()}
    for file in written.iterdir():
        if file.suffix == ".parquet":
            pd.testing.assert_frame_equal(pd.read_parquet(file), pd.read_parquet(saved / file.name))
        else:
            assert file.read_bytes() == (saved / file.name).read_bytes(), file.name
    with pytest.raises(netkf.ScenarioError, match="new or empty directory"):
        netkf.save(netkf.simulate(ring), ring, saved)
    for change in ({"network.graph.nodes": 5}, {"filter.epsilon": 0.11}):
        other = ring.replace(change)
        with pytest.raises(netkf.ScenarioError, match="their keys or files differ"):
            netkf.save(netkf.simulate(ring), other, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_saved_run_of_another_seed_keeps_its_random_graph(build, tmp_path):
    scenario = build(
        seed=3,
        network={
            "graph": {"kind": "geometric", "nodes": 8, "radius": 0.5, "connected": True},
            "activation": {"kind": "poisson", "rate": 2.0},
        },
        filter={"kind": "hybrid", "epsilon": 0.1},
    )
    run = netkf.simulate(scenario, seed=9, replica=2)
    folder = netkf.save(run, scenario, tmp_path / "saved")
    again = netkf.load(folder / "scenario.toml")
    assert again.topology.links == scenario.topology.links
    assert netkf.first_difference(netkf.simulate(again, replica=2), run) is None
    manifest = json.loads((folder / "manifest.json").read_text())
    assert (manifest["seed"], manifest["replica"], manifest["status"]) == (9, 2, "complete")
    # The directory's scenario has the seed of the run.
    copy = netkf.save(netkf.open(folder), scenario, tmp_path / "copy")
    assert (copy / "scenario.toml").read_bytes() == (folder / "scenario.toml").read_bytes()


def test_numbers_stand_for_matrices_of_one_entry():
    theory = netkf.theory
    scalar = theory.steady_covariance(1.2, 1.0, 1.0, 0.5)
    assert scalar == theory.steady_covariance([[1.2]], [[1.0]], [[1.0]], [[0.5]])
    assert theory.lyapunov_step(2.0, 1.2, 1.0).item() == pytest.approx(1.2**2 * 2.0 + 1.0)
    # dP = 1 - P^2 from 0 is tanh
    assert theory.riccati_flow(0.0, 0.0, 1.0, 1.0, 0.7).item() == pytest.approx(np.tanh(0.7))
    with pytest.raises(netkf.TheoryError, match="Q must be a 2 x 2 matrix"):
        theory.lyapunov_step(np.eye(2), np.eye(2), 1.0)


def test_the_theory_shows_its_public_names_only():
    assert dir(netkf.theory) == sorted(netkf.theory.__all__)


@pytest.mark.parametrize("value", [None, "scenarios/poisson_ring.toml", 3])
def test_theory_of_what_is_no_scenario_is_refused(value):
    names = "covariance_bound steady_covariance_bound limit_covariance push_sum_limits assumptions"
    for name in names.split():
        with pytest.raises(netkf.ScenarioError, match=rf"theory\.{name} takes a netkf.Scenario"):
            getattr(netkf.theory, name)(value)


def test_theory_can_be_sent_to_other_processes():
    for name in netkf.theory.__all__:
        function = getattr(netkf.theory, name)
        assert pickle.loads(pickle.dumps(function)) is function


def test_parts_stand_for_tables_in_replace(ring):
    parts = netkf.parts
    cases = [
        ({"filter": parts.Hybrid(0.2)}, {"filter": {"kind": "hybrid", "epsilon": 0.2}}),
        ({"network.graph": parts.PathGraph(6)}, {"network.graph": {"kind": "path", "nodes": 6}}),
        (
            {"network.channel": parts.Channel(loss=parts.Bernoulli(0.5))},
            {"network.channel": {"loss": {"kind": "bernoulli", "delivery": 0.5}}},
        ),
        (
            {"network.channel.delay": parts.ConstantDelay(0.1)},
            {"network.channel.delay": {"kind": "constant", "seconds": 0.1}},
        ),
        (
            {"network.activation": parts.Poisson(rate=3.0)},
            {"network.activation": {"kind": "poisson", "rate": 3.0}},
        ),
        (
            {"sensors.0.sampling": parts.Periodic(period=0.1)},
            {"sensors.0.sampling": {"kind": "periodic", "period": 0.1}},
        ),
        (
            {"filter": netkf.Filtering(parts.Central(), cov=2.0 * np.eye(2))},
            {"filter": {"kind": "central", "cov": [[2.0, 0.0], [0.0, 2.0]]}},
        ),
        (
            {"filter": parts.Hybrid(0.2), "filter.epsilon": 0.25},
            {"filter": {"kind": "hybrid", "epsilon": 0.25}},
        ),
    ]
    for given, table in cases:
        assert ring.replace(given) == ring.replace(table)
    with pytest.raises(netkf.ScenarioError, match=r"network.graph.kind: .*; got 'hybrid'"):
        ring.replace({"network.graph": parts.Hybrid(0.2)})


def test_a_sweep_takes_parts(ring):
    filters = [netkf.parts.Hybrid(0.3), netkf.parts.Local()]
    table = netkf.sweep(ring.replace({"horizon": 1.0}), {"filter": filters})
    assert table["filter"].tolist() == [
        '{ kind = "hybrid", epsilon = 0.3 }',
        '{ kind = "local" }',
    ]


def test_classes_that_nobody_can_import_are_refused_in_one_line(ring, tmp_path):
    class Mine(netkf.parts.Hybrid):
        pass

    scenario = dataclasses.replace(ring, horizon=1.0, filter=netkf.Filtering(Mine(0.3)))
    run = netkf.simulate(scenario)
    with pytest.raises(netkf.ScenarioError, match=r"cannot name the class Mine .*; put it into a"):
        netkf.save(run, scenario, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(
        netkf.EngineError, match=r"workers cannot import the class Mine .*workers=1"
    ):
        pack_scenario(scenario)


def test_results_show_themselves_in_a_line_and_as_a_table(ring):
    short = ring.replace({"horizon": 2.0, "name": "<b>ring</b>"})
    shown = {
        "run": netkf.simulate(short),
        "ensemble": netkf.monte_carlo(short, 10, workers=1),
        "verdict": netkf.check(short, 20, workers=1),
        "consistency": netkf.consistency(short, 10, workers=1),
        "size": netkf.size(short, "network.activation.rate", 1.0, 50.0, "worst_trace<=4"),
    }
    for name, result in shown.items():
        line = str(result)
        assert line == repr(result)
        assert len(line) < 200
        assert line.startswith("<netkf")
        page = result._repr_html_()
        assert "<b>ring" not in page
        assert page.count("<tr>") + page.count("<tr ") > len(short.nodes) or name == "size"
        assert not [attribute for attribute in dir(result) if attribute.startswith("_")]
    assert "20 runs" in str(shown["verdict"])
    run, table = shown["run"], shown["run"]._notebook_table()
    after = run.times > 0.0
    rms = np.sqrt(((run.x[after, None] - run.xhat[after]) ** 2).sum(axis=2).mean(axis=0))
    np.testing.assert_allclose(table["RMS error"], rms)


def test_completion_offers_public_names_only():
    for module in (netkf, netkf.parts, netkf.theory, netkf.testing):
        private = {"annotations", "Any", "TYPE_CHECKING", "importlib", "np"}
        assert not private & set(dir(module))
        assert all(hasattr(module, name) for name in dir(module))


@pytest.mark.parametrize("odd", [None, "x", 1j, [1.0], np.eye(2)])
def test_arguments_of_a_wrong_kind_are_one_line(odd, ring):
    run, planar = netkf.simulate(ring), netkf.load("scenarios/push_sum_planar.toml")
    calls = {
        "run": lambda: netkf.innovations(odd),
        "run: must": lambda: netkf.held_out_errors(odd),
        "netkf.Scenario": lambda: netkf.save(odd, odd, "saved"),
        "directory": lambda: netkf.save(odd, ring, 1),
        "changes": lambda: ring.replace(odd),
        "runs": lambda: netkf.monte_carlo(ring, odd),
        "kind": lambda: run.count(odd),
        "figure": lambda: run.plot(odd),
        "name": lambda: run.block(odd, 0),
        "trust": lambda: netkf.load("scenarios/poisson_ring.toml", trust=odd),
        "stacked": lambda: theory.error_covariance(ring, run, stacked=odd),
        "moment": lambda: theory.exact_minimum_gamma(planar, odd),
        "engine": lambda: netkf.simulate(ring, engine=np.eye(2)),
        "--vary": lambda: netkf.sweep(ring, odd),
        "low": lambda: netkf.size(ring, "filter.epsilon", odd, 0.2, "worst_rms<=1"),
        "--vary: ": lambda: netkf.size(ring, odd, 0.1, 0.2, "worst_rms<=1"),
    }
    for name, call in calls.items():
        with pytest.raises(netkf.NetkfError, match=name) as caught:
            call()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "kind",
    [
        pd.DataFrame,
        lambda value: np.array(value, dtype=np.float32 if isinstance(value[0][0], float) else int),
        lambda value: np.repeat(value, 2, axis=0)[::2],
        lambda value: np.array(value, dtype=object),
        lambda value: [np.array(row) for row in value],
        lambda value: np.array(value, dtype=float),
        lambda value: [[np.array(number) for number in row] for row in value],
    ],
    ids=["pandas", "float32", "strided", "objects", "rows", "floats", "no dimensions"],
)
def test_arrays_of_every_kind_are_lists(kind, ring):
    matrices = {
        "plant.A": [[0.0, 1.0], [-1.0, 0.125]],
        "sensors[0].R": [[0.25]],
        "filter.cov": [[1.0, 0.0], [0.0, 1.0]],
        "network.activation.rates": [[0, 1, 3.0], [1, 2, 4.0]],
        "network.graph": [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 0]],
        "sensors[0].nodes": [[0, 3]],
        "probe": [[1.0, 2.5, 3.0]],
    }

    def made(convert):
        values = {key: convert(value) for key, value in matrices.items()}
        columns = ("sensors[0].nodes", "probe")
        first = {key: getattr(values[key], "iloc", values[key])[0] for key in columns}
        edges = {"network.graph": {"kind": "edges", "edges": values["network.graph"]}}
        return ring.replace({**values, **first, **edges})

    plain, other = made(list), made(kind)
    assert plain == other
    assert netkf.simulate(plain).fingerprint == netkf.simulate(other).fingerprint
    numbers = {"network.activation.rate": 2.0, "network.channel.symmetric": False, "seed": 3}
    arrays = {key: np.array(value) for key, value in numbers.items()}
    assert plain.replace(arrays) == plain.replace(numbers)
    for flags in (np.array([[True]]), [[np.True_]], pd.DataFrame([[True]])):
        with pytest.raises(netkf.ScenarioError, match="R"):
            ring.replace({"sensors[0].R": flags})


def test_numbers_too_large_are_one_line(ring):
    drawn, large = netkf.load("scenarios/diffusion_regression.toml"), 10**30
    calls = {
        "runs: must": lambda: netkf.monte_carlo(ring, large),
        "runs: must be": lambda: netkf.check(ring, large),
        "runs: must be an": lambda: netkf.sweep(ring, {"filter.epsilon": [0.1]}, runs=large),
        "runs must": lambda: theory.information_level(drawn, runs=large),
        "overflows": lambda: theory.constant_gain_bound(ring, 1e308),
        "nan": lambda: theory.disconnection_probability([(1, np.nan), (0, 1)], 0.5),
    }
    for words, call in calls.items():
        with pytest.raises(netkf.NetkfError, match=words):
            call()


def test_what_is_no_scenario_is_answered_by_a_call_that_is_right(ring, tmp_path):
    run = netkf.simulate(ring.replace({"horizon": 1.0}), engine="simpy")
    calls = {
        "netkf.simulate(netkf.load(path))": lambda: netkf.simulate("a.toml"),
        "netkf.log_likelihood(netkf.load(path))": lambda: netkf.log_likelihood("a.toml"),
        "netkf.fit_noise(netkf.load(path))": lambda: netkf.fit_noise("a.toml"),
        "netkf.save(run, netkf.load(path), directory)": lambda: netkf.save(ring, run, tmp_path),
        "netkf.theory.error_covariance(netkf.load(path), run)": lambda: theory.error_covariance(
            run, ring
        ),
        "netkf.theory.covariance_bound(netkf.load(path), times)": lambda: theory.covariance_bound(
            [1.0], ring
        ),
    }
    for words, call in calls.items():
        with pytest.raises(netkf.ScenarioError) as caught:
            call()
        assert str(caught.value).endswith(f"load it first: {words}")
    netkf.save(run, run.scenario, tmp_path / "kept")
    with pytest.raises(netkf.ScenarioError, match="directory: must be a new or empty directory"):
        netkf.save(run, run.scenario, tmp_path / "kept")
