"""Run directories: complete, repeatable, never half written."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli import main
from netkf.experiments.files import new_directory
from netkf.experiments.run import run_to_directory
from tests.conftest import SCENARIOS, scenario_files


@pytest.fixture
def finished(ring, tmp_path):
    return run_to_directory(ring, tmp_path / "out")


def test_a_run_directory_holds_what_the_contract_says(ring, finished):
    folder, run = finished.directory, netkf.simulate(ring)
    assert {p.name for p in folder.iterdir()} == {
        "scenario.toml",
        "manifest.json",
        "events.parquet",
        "states.parquet",
        "summary.json",
    }
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["status"] == "complete"
    assert manifest["runs"] == {"wanted": 1, "done": 1}
    assert manifest["seed"] == 1
    assert manifest["fingerprint"] == run.fingerprint
    events, states = (pd.read_parquet(folder / f"{n}.parquet") for n in ("events", "states"))
    assert netkf.first_difference(events, run) is None
    pd.testing.assert_frame_equal(states, run.states)


def test_the_resolved_scenario_gives_the_same_files(finished, tmp_path):
    again = run_to_directory(netkf.load(finished.directory / "scenario.toml"), tmp_path / "again")
    for file in finished.directory.iterdir():
        assert file.read_bytes() == (again.directory / file.name).read_bytes(), file.name


def test_files_that_a_scenario_names_travel_with_it(tmp_path):
    scenario = netkf.load(SCENARIOS / "intel_lab.toml").replace({"horizon": 0.5})
    out = run_to_directory(scenario, tmp_path / "out").directory
    assert (out / "data/intel_lab/connectivity.csv").exists()
    assert netkf.load(out / "scenario.toml").topology.links == scenario.topology.links


def test_summary_is_what_the_states_say(ring, finished):
    summary = json.loads((finished.directory / "summary.json").read_text())
    states = netkf.simulate(ring).states
    after = states[states.t > 0.0]
    bound = netkf.theory.covariance_bound(ring, ring.times)
    for k, row in enumerate(summary["nodes"]):
        mine = after[after.node == row["node"]]
        assert row["rms_error"] == pytest.approx(np.sqrt(mine.sq_error.mean()))
        assert row["mean_trace"] == pytest.approx((mine.P00 + mine.P11).mean())
        assert row["mean_nees"] == pytest.approx(mine.nees.mean())
        assert row["bound"] == pytest.approx(np.trace(bound[1:, k], axis1=1, axis2=2).mean())
    sent = summary["messages"]
    assert sent["sent"] == sent["delivered"] + sent["lost"] + sent["in_flight"]


def test_tables_are_written_in_pieces(ring, tmp_path, monkeypatch):
    monkeypatch.setattr("netkf.trace.recorder.BLOCK", 100)
    monkeypatch.setattr("netkf.experiments.files.ROWS", 50)
    import pyarrow.parquet as pq

    out = run_to_directory(ring, tmp_path / "pieces").directory
    assert pq.ParquetFile(out / "events.parquet").num_row_groups > 3
    assert pq.ParquetFile(out / "states.parquet").num_row_groups > 3
    run = netkf.simulate(ring)
    pd.testing.assert_frame_equal(pd.read_parquet(out / "states.parquet"), run.states)
    events = pd.read_parquet(out / "events.parquet")
    assert netkf.first_difference(events, run) is None
    assert events.seq.tolist() == list(range(len(events)))


def test_an_interrupted_run_keeps_what_it_had(ring, tmp_path):
    def impatient(time):
        if time >= 7.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_to_directory(ring, tmp_path / "cut", progress=impatient)
    manifest = json.loads((tmp_path / "cut" / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    assert manifest["runs"]["done"] == 0
    states = pd.read_parquet(tmp_path / "cut" / "states.parquet")
    assert states.t.max() == 7.0
    pd.testing.assert_frame_equal(states, netkf.simulate(ring).states[: len(states)])
    assert not list((tmp_path / "cut").glob("*.part"))


def test_a_diverged_run_says_so(build, tmp_path):
    plant = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
    scenario = build(horizon=600.0, probe=10.0, plant=plant, filter={"kind": "local"})
    done = run_to_directory(scenario, tmp_path / "out")
    assert done.status == "diverged"
    manifest = json.loads((done.directory / "manifest.json").read_text())
    assert manifest["status"] == "diverged"
    json.loads((done.directory / "summary.json").read_text(), parse_constant=pytest.fail)


def test_directories_are_never_overwritten(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = new_directory(None, "a/b name")
    assert first == Path("runs/a-b-name-1")
    assert new_directory(None, "a/b name") == Path("runs/a-b-name-2")
    assert new_directory(first, "x") == first  # still empty
    (first / "file").touch()
    with pytest.raises(netkf.ScenarioError, match="new or empty directory"):
        new_directory(first, "x")


@pytest.mark.parametrize("file", scenario_files(), ids=lambda f: f.stem)
def test_every_scenario_ends_in_its_expected_summary(file, tmp_path, capsys):
    """The file beside the scenario; numbers to 6 digits, counts exactly."""
    assert main(["run", str(file), "--out", str(tmp_path / "out"), "--no-plot"]) == 0
    expected = json.loads(file.with_suffix(".expected.json").read_text())
    got = json.loads((tmp_path / "out" / "summary.json").read_text())
    compare(got, expected, file.stem)


def compare(got, expected, where):
    if isinstance(expected, dict):
        assert got.keys() == expected.keys(), where
        for key, value in expected.items():
            compare(got[key], value, f"{where}.{key}")
    elif isinstance(expected, list):
        assert len(got) == len(expected), where
        for k, value in enumerate(expected):
            compare(got[k], value, f"{where}[{k}]")
    elif isinstance(expected, float):
        assert got == pytest.approx(expected, rel=1e-6), where
    else:
        assert got == expected, where
