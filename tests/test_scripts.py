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


def test_nodes_use_as_much_of_the_bound_as_the_page_says(tmp_path):
    page = (ROOT / "analysis" / "README.md").read_text(encoding="utf-8")
    assert "85 to 98 % at 1, 90 to 95 % at 2" in page
    for rate in ("1", "10"):
        change = ["--set", f"network.activation.rate={rate}", "--out", str(tmp_path / rate)]
        ring = str(SCENARIOS / "poisson_ring.toml")
        assert main(["run", ring, "--workers", "1", "--no-plot", "--runs", "100", *change]) == 0
    table = script("analysis", "hybrid_bound").main([str(tmp_path / rate) for rate in ("1", "10")])
    least, most = table["least"], table["most"]
    # The standard error of a mean over these runs and times is 1 %.
    assert least.tolist() == pytest.approx([0.85, 0.987], abs=0.03)
    assert most.tolist() == pytest.approx([0.976, 0.99], abs=0.03)


def test_laws_of_tokens_are_read_from_a_directory(kept, tmp_path):
    sensors, tokens = script("analysis", "weak_consensus").main(
        [str(kept / "gossip"), "--out", str(tmp_path / "laws.png")]
    )
    assert tokens < sensors  # tokens share one law, fixed sensors do not
    assert (tmp_path / "laws.png").stat().st_size > 10_000


def test_the_figures_of_the_intermittent_paper_are_drawn(tmp_path):
    out = tmp_path / "drawn.png"
    arguments = ["--samples", "200", "--out", str(out)]
    masses, counted = script("analysis", "intermittent_figures").main(arguments)
    assert masses == pytest.approx([0.6, 0.24, 0.096], abs=1e-9)
    # Five standard deviations of a share of 200 samples.
    assert np.abs(np.array(masses) - counted).max() < 5.0 * math.sqrt(0.24 / 200)
    assert out.stat().st_size > 10_000


@pytest.mark.slow
def test_the_figures_of_the_push_sum_paper_are_drawn(tmp_path, monkeypatch):
    figures = script("analysis", "push_sum_figures")
    monkeypatch.setattr(figures, "DELIVERIES", (0.8, 1.0))
    monkeypatch.setattr(figures, "SIMULATED", (1, 3))
    monkeypatch.setattr(figures, "GRID", [0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
    out = tmp_path / "drawn.png"
    curves, measured, central = figures.main(["--runs", "3", "--workers", "1", "--out", str(out)])
    radius = {cell: found for cell, (found, _) in curves.items()}
    error = {cell: found for cell, (_, found) in curves.items()}
    # What the script says at its end.
    assert radius[1, 0.7] < 1.0 < radius[1, 0.6]
    assert radius[2, 0.5] < 1.0 < figures.exact((2, 0.5, "held"))[0]
    assert all(error[gamma, 1.0] > error[gamma, 0.9] for gamma in range(2, 7))
    within = {cell for cell, found in error.items() if found <= 1.1 * central}
    assert {gamma for gamma, _ in within} == {3, 4, 5, 6}
    mean, _ = measured[3, 0.8]
    assert mean == pytest.approx(error[3, 0.8], rel=0.2)
    assert out.stat().st_size > 10_000


@pytest.mark.slow
def test_what_the_push_sum_paper_reports_holds_as_the_table_says(tmp_path):
    arguments = ["--cells", "2", "--gammas", "1", "--deltas", "4.01", "--draws", "fresh"]
    stability = script("analysis", "push_sum_stability")
    found = stability.main([*arguments, "--out", str(tmp_path / "drawn.png")])
    assert found["tau I_2", 4.01, "fresh"] == (True, True, True, False, True, True, True)
    assert not found["I_2", 4.01, "fresh"][0]
    assert (tmp_path / "drawn.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_figure_of_the_diffusion_paper_is_drawn(tmp_path):
    out = tmp_path / "drawn.png"
    arguments = ["--slots", "300", "--runs", "3", "--exact", "3", "--workers", "1"]
    squared, exact, traces = script("analysis", "diffusion_figure").main(
        [*arguments, "--out", str(out)]
    )
    assert squared.shape == traces.shape == (3, 3, 4, 3)  # runs, ways, times, sensors
    alone, together, central = exact.mean(axis=(0, 3))
    assert alone[1] < alone[2] < alone[3]
    assert alone[3] > 10.0 * together[3]
    assert 1.0 < together[2:].mean() / central[2:].mean() < 1.4
    assert 1.3 < traces[:, 1, 2:].mean() / together[2:].mean() < 1.7
    assert out.stat().st_size > 10_000


def test_filters_are_compared_in_tables(capsys, monkeypatch):
    compared = script("analysis", "filters_compared")
    page = (ROOT / "docs" / "filters_compared.md").read_text(encoding="utf-8")
    networks = [netkf.load(compared.FOLDER / f"{name}.toml") for name in compared.NETWORKS]
    names = list(compared.filters_of(networks[0]))
    assert all(page.count(f"| {name} |") == 2 for name in names)
    kept, all_filters = ("central", "HCMCI, 3 steps", "hybrid", "local"), compared.filters_of
    monkeypatch.setattr(
        compared, "filters_of", lambda scenario: {k: all_filters(scenario)[k] for k in kept}
    )
    ((found, horizon),) = compared.main(["2", "--networks", "ring_loss", "--horizon", "2"])
    lines = capsys.readouterr().out.splitlines()
    assert (horizon, len(found.rows), len(lines)) == (2.0, 4, 13)
    assert lines[2].startswith("| central | 1.00 (")
    assert lines[4] == "| hybrid | - |"  # in slots


def test_push_sum_and_hybrid_filters_meet_the_same_truth(capsys):
    arguments = ["--runs", "3", "--rates", "4", "--workers", "1"]
    better, nees = script("analysis", "push_sum_continuous").main(arguments)
    ((rate, gain, _),) = better["hybrid"]
    assert (rate, gain > 0.0) == (4.0, True)
    assert nees["push-sum", 4.0].mean() > 1.5 * 2  # its P is too small
    assert nees["hybrid", 4.0].mean() < 1.5 * 2
    assert "better at" in capsys.readouterr().out


def test_the_tables_of_the_library_are_those_of_its_raw_record(tmp_path):
    library = script("analysis", "ulb_library")
    library.main(["--prepare", "--folder", str(tmp_path)])
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    kept = SCENARIOS / "data" / "ulb_library"
    assert set(made) == {
        "temperatures.csv",
        "held_out.csv",
        "first.csv",
        "pairs.csv",
        "broadcasts.csv",
        "missed.csv",
    }
    assert made == {name: (kept / name).read_bytes() for name in made}


def test_errors_at_motes_that_are_never_read_are_those_that_pages_name(monkeypatch):
    library = script("analysis", "ulb_library")
    chosen = ("diffusion, the scenario's", "covariance intersection", "all readings")
    monkeypatch.setattr(library, "FILTERS", {name: library.FILTERS[name] for name in chosen})
    found = {name: round(float(error), 3) for name, error in library.main([]).items()}
    assert found == {
        "last value heard": 0.187,
        "mean of the others": 0.178,
        "mean + first offset": 0.084,
        "diffusion, the scenario's": 0.097,
        "covariance intersection": 0.116,
        "all readings": 0.095,
    }


@pytest.mark.slow
def test_with_a_walking_offset_for_each_mote_filters_are_nearer_than_the_plain_mean():
    found = script("analysis", "ulb_library").offsets(fit=False)
    assert {name: round(float(error), 3) for name, error in found.items()} == {
        "diffusion": 0.079,
        "all readings": 0.087,
    }


DRAWINGS = {
    "benchmarks": [],
    "diffusion": ["--runs", "2"],
    "gallery": ["--runs", "2", "--points", "3"],
    "gossip": ["--samples", "100"],
    "hybrid": ["--runs", "2", "--rates", "8"],
    "ieee14": ["--runs", "1"],
    "intermittent": [],
    "networks": ["--runs", "2"],
    "push_sum": ["--gains", "2"],
}


def test_every_script_of_the_pages_is_run():
    names = {path.stem for path in (ROOT / "docs" / "figures").glob("*.py")}
    assert names == {*DRAWINGS, "look", "moving_network"}


@pytest.mark.parametrize("name", DRAWINGS)
@pytest.mark.slow
def test_the_drawings_of_the_pages_are_drawn(tmp_path, monkeypatch, name):
    folder = ROOT / "docs" / "figures"
    monkeypatch.syspath_prepend(str(folder))
    script("docs/figures", name).main([*DRAWINGS[name], "--out", str(tmp_path)])
    drawn = {path.name for path in tmp_path.iterdir()}
    assert drawn == {path.name for path in folder.glob(f"{name}_*.svg")}
    if not DRAWINGS[name]:  # nothing was left out, so that it is the same drawing
        for path in tmp_path.iterdir():
            assert path.read_text().count("<path") == (folder / path.name).read_text().count(
                "<path"
            )


def test_the_network_moves(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "figures"))
    out = tmp_path / "moving.gif"
    script("docs/figures", "moving_network").main(["--end", "0.3", "--out", str(out)])
    assert out.read_bytes().startswith(b"GIF89a")
