"""The scripts beside the scenarios and those of analysis/ do what their first lines say."""

import ast
import importlib.util
import math

import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from tests.conftest import ROOT, SCENARIOS

SCRIPTS = sorted([*SCENARIOS.glob("*.py"), *(ROOT / "analysis").glob("*.py")])


def script(folder, name):
    spec = importlib.util.spec_from_file_location(name, ROOT / folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_scripts_use_public_names_only(path):
    public = {"netkf", "netkf.parts", "netkf.testing", "netkf.theory"}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) else []
        assert {name for name in names if name.partition(".")[0] == "netkf"} <= public
        assert not (isinstance(node, ast.Attribute) and node.attr.startswith("_"))


def test_more_frequent_ticks_lower_covariances_below_their_bound():
    table = script("scenarios", "rates").main(rates=(1.0, 8.0), runs=3)
    assert list(table["network.activation.rate"]) == [1.0, 8.0]
    assert table["mean_trace"].iloc[0] > table["mean_trace"].iloc[1] > table["central"].iloc[1]


def test_filters_on_the_same_noise_are_in_their_order():
    table = script("scenarios", "same_noise").main(runs=4).table.set_index("filter")
    errors = table["rms_error"]
    assert errors["central"] < errors["covariance-intersection"] < errors["hybrid"]
    assert errors["hybrid"] < errors["local"]


def test_messages_fade_with_the_distance():
    fading = script("scenarios", "fading")
    table = fading.main(reaches=(0.2, 0.8))
    for row in table.itertuples():
        scenario = fading.network(row.reach)
        links, loss = scenario.topology.links, scenario.network.channel.loss
        mean = np.mean([math.exp(-((distance(loss.places, *link) / row.reach) ** 2))
                        for link in links])  # fmt: skip
        assert row.delivered == pytest.approx(mean, abs=0.08)
    assert table["trace P"].iloc[1] < table["trace P"].iloc[0]


def distance(places, i, j):
    return math.dist(places[i], places[j])


def test_the_worst_moment_is_that_of_the_largest_covariance():
    found = script("scenarios", "worst_moment").main(seed=3, replays=1)
    run = netkf.simulate(netkf.load(SCENARIOS / "poisson_ring.toml"), seed=3)
    traces = run.P.trace(axis1=2, axis2=3)[len(run.times) // 3 :]
    assert found.trace == pytest.approx(traces.max(), rel=1e-9)


def test_the_pattern_of_tests_passes_and_can_fail():
    pattern = script("scenarios", "test_pattern")
    assert netkf.testing.scenario_files(SCENARIOS) == pattern.FILES
    pattern.RUNS = 10
    pattern.test_no_promise_is_broken(SCENARIOS / "intermittent_scalar.toml")
    pattern.test_a_run_ends_and_is_the_same_again(SCENARIOS / "intermittent_scalar.toml")
    pattern.test_the_mean_covariance_stays_below_the_bound(5.0, 0.9)
    pattern.test_errors_are_not_larger_than_a_requirement("central")
    pattern.FOLDER = SCENARIOS / "absent"
    with pytest.raises(netkf.ScenarioError):
        pattern.test_errors_are_not_larger_than_a_requirement("central")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Run directories for the scripts of analysis/, as small as they may be."""
    folder = tmp_path_factory.mktemp("kept")
    many = ["--workers", "1", "--no-plot", "--runs"]
    ring, gossip = (str(SCENARIOS / f"{name}.toml") for name in ("poisson_ring", "gossip_ring"))
    short = ["--set", "horizon=30", "--set", "probe=30", "--trace", "full"]
    assert main(["run", gossip, *many, "40", *short, "--out", str(folder / "gossip")]) == 0
    rate = ["--set", "horizon=8", "--set", "network.activation.rate=4"]
    assert main(["run", ring, *many, "10", *rate, "--out", str(folder / "ring")]) == 0
    return folder


def test_hybrid_bounds_are_read_from_directories(kept, capsys):
    (row,) = script("analysis", "hybrid_bound").main([str(kept / "ring")]).to_dict("records")
    changes = {"horizon": 8.0, "network.activation.rate": 4.0}
    scenario = netkf.load(SCENARIOS / "poisson_ring.toml", changes)
    ensemble = netkf.monte_carlo(scenario, runs=10, workers=1)
    worst = scenario.nodes.index(row["worst node"])
    assert row["mean"] == pytest.approx(np.trace(ensemble.mean_P[-1, worst]), rel=1e-12)
    bound = netkf.theory.covariance_bound(scenario, [8.0])[0, worst]
    assert row["bound"] == pytest.approx(np.trace(bound), rel=1e-9)
    assert (row["rate"], row["runs"]) == (4.0, 10)
    assert "no mean is above its bound" in capsys.readouterr().out


def test_laws_of_tokens_are_read_from_a_directory(kept, tmp_path):
    sensors, tokens = script("analysis", "weak_consensus").main(
        [str(kept / "gossip"), "--out", str(tmp_path / "laws.png")]
    )
    assert tokens < sensors  # tokens share one law, fixed sensors do not
    assert (tmp_path / "laws.png").stat().st_size > 10_000
