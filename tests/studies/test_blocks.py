"""Every command on nodes that estimate blocks, of different number, of the state."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from netkf.studies.metrics import central_traces
from tests.algorithms.test_block_intersection import ROBOTS, load

COMMANDS = {
    "theory": ["theory", "{file}"],
    "consistency": ["consistency", "{file}", "--runs", "12", "--set", "seed=3", "--json"],
    "sweep": ["sweep", "{file}", "--vary", "seed=1,2", "--runs", "2", "--no-plot", "--json"],
    "size": [
        *("size", "{file}", "--vary", "horizon=1.0:2.0", "--target", "within_central<=9"),
        *("--runs", "40", "--json"),
    ],
    "compare-filters": [
        *("compare-filters", "{file}", "--filters", "block-intersection,central", "--runs", "2"),
        "--json",
    ],
    "why": ["why", "{run}", "--json"],
    "compare": ["compare", "{run}", "{many}", "--json"],
    "plot": ["plot", "{run}", "--figure", "overview,nees,ratios,nis", "--out", "{out}/plot"],
    "plot of many": ["plot", "{many}", "--figure", "error,nees", "--out", "{out}/many"],
    "report": ["report", "{run}", "--out", "{out}/page.html"],
    "report of many": ["report", "{many}", "--out", "{out}/page.html"],
}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("blocks")
    text = ROBOTS.replace('estimates = "own"', 'estimates = "own+neighbours"')
    (folder / "robots.toml").write_text(text.replace("horizon = 12.0", "horizon = 4.0"))
    found = {"file": folder / "robots.toml", "out": folder}
    for name, options in {"run": [], "many": ["--runs", "2", "--trace", "full"]}.items():
        found[name] = folder / name
        command = ["run", str(found["file"]), "--no-plot", "--out", str(found[name]), *options]
        assert main(command) == 0
    return found


@pytest.mark.one_in(5)
@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_takes_nodes_with_states_of_different_size(
    places: dict[str, Path], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status = main([part.format(**places) for part in COMMANDS[name]])
    seen = capsys.readouterr()
    assert (status, "Traceback" in seen.err) == (0, False), seen.err
    if name == "report":
        # NEES of each block, beside that of a node.
        assert '[1,"pose@3"]' in (places["out"] / "page.html").read_text().replace(" ", "")
    if "--json" not in COMMANDS[name]:
        return
    document = json.loads(seen.out)
    if name == "compare-filters":
        assert all(row["worst_instant"] > 0.0 for row in document["rows"])


def test_ratios_are_by_the_number_of_states_of_each_node(tmp_path: Path) -> None:
    changes = {"filter__kind": "central", "filter__estimates": "own+neighbours"}
    scenario = load(ROBOTS, tmp_path, horizon=40.0, **changes)
    assert scenario.sizes.tolist() == [2, 3, 2]
    compared = netkf.compare_filters(scenario, ["central"], runs=4)
    # P is exact: NEES / n is 1 on average.
    (row,) = compared.rows
    assert abs(row.quantities["nees_ratio"].value - 1.0) < 0.3
    run = netkf.simulate(scenario)
    after = run.times > 0.0
    traces = [np.trace(run.P[after, k, :n, :n], axis1=1, axis2=2) for k, n in enumerate((2, 3, 2))]
    np.testing.assert_allclose(central_traces(scenario), np.mean(traces, axis=1), rtol=1e-9)
    ensemble = netkf.monte_carlo(scenario, runs=2)
    assert np.isfinite(ensemble.mean_nees[1:]).all()


def test_nodes_are_held_to_the_central_filter_of_what_they_estimate(tmp_path: Path) -> None:
    """The central filter itself is within 1 of it, whatever nodes estimate."""
    scenario = load(ROBOTS, tmp_path, horizon=4.0, filter__kind="central")
    assert np.ptp(central_traces(scenario)) > 0.1 * central_traces(scenario).max()
    largest = math.sqrt(central_traces(scenario).max())
    for by in (None, "simulation"):
        sized = netkf.size(scenario, "seed", 1, 9, "within_central<=1.1", by, runs=32)
        assert (sized.value, sized.probes[0].quantity) == (1, pytest.approx(1.0)), by
    # That the worst node of the central filter misses a limit says that any exchange would.
    sized = netkf.size(scenario, "seed", 1, 9, f"worst_rms<={0.99 * largest}", "simulation", 32)
    assert sized.value is None
    assert sized.central.endswith("no exchange of messages reaches the limit, better readings may")


def test_a_target_beside_a_central_filter_without_law_is_refused_at_its_key() -> None:
    robots = netkf.load("scenarios/blocks/cooperative_localisation.toml")
    with pytest.raises(netkf.TheoryError, match=r"--target: .* not linear; ask for worst_rms"):
        netkf.size(robots, "seed", 1, 9, "within_central<=2")
