"""Run directories: complete, repeatable, never half written."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.engines.simpy.engine import SimpyEngine
from netkf.runs.files import create_output_directory, write_atomically
from netkf.runs.run import run_to_directory
from tests.conftest import SCENARIOS, scenario_files, with_slow


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
    out = run_to_directory(scenario, tmp_path / "out", "simpy").directory
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


@pytest.mark.parametrize("engine", [SimpyEngine(), "compiled"], ids=str)
def test_tables_are_written_in_pieces(ring, tmp_path, monkeypatch, engine):
    monkeypatch.setattr("netkf.trace.recorder.BLOCK", 100)
    monkeypatch.setattr("netkf.engines.compiled.flow.FIRST_ROWS", 100)
    monkeypatch.setattr("netkf.engines.compiled.flow.MAX_BUFFERED_SAMPLES", 10)
    monkeypatch.setattr("netkf.runs.parquet_files.ROW_GROUP_ROWS", 50)
    import pyarrow.parquet as pq

    out = run_to_directory(ring, tmp_path / "pieces", engine=engine).directory
    assert pq.ParquetFile(out / "events.parquet").num_row_groups > 3
    assert pq.ParquetFile(out / "states.parquet").num_row_groups > 3
    run = netkf.simulate(ring, engine=engine)
    pd.testing.assert_frame_equal(pd.read_parquet(out / "states.parquet"), run.states)
    events = pd.read_parquet(out / "events.parquet")
    assert netkf.first_difference(events, run) is None
    assert events.seq.tolist() == list(range(len(events)))


@pytest.mark.parametrize("engine", [SimpyEngine(), "compiled"], ids=str)
def test_an_interrupted_run_keeps_what_it_had(ring, tmp_path, monkeypatch, engine):
    monkeypatch.setattr("netkf.engines.compiled.flow.MAX_BUFFERED_SAMPLES", 5)

    def impatient(time):
        if time >= 7.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_to_directory(ring, tmp_path / "cut", progress=impatient, engine=engine)
    manifest = json.loads((tmp_path / "cut" / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    assert manifest["runs"]["done"] == 0
    states = pd.read_parquet(tmp_path / "cut" / "states.parquet")
    assert 7.0 <= states.t.max() < 10.0
    whole = netkf.simulate(ring, engine=engine).states
    pd.testing.assert_frame_equal(states, whole[: len(states)])
    assert not list((tmp_path / "cut").glob("*.part"))
    summary = json.loads((tmp_path / "cut" / "summary.json").read_text())
    after = states[states.t > 0.0]
    assert summary["overall"]["rms_error"] == pytest.approx(np.sqrt(after.sq_error.mean()))


def test_a_diverged_run_says_so(build, tmp_path):
    plant = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
    scenario = build(horizon=600.0, probe=10.0, plant=plant, filter={"kind": "local"})
    done = run_to_directory(scenario, tmp_path / "out")
    assert done.status == "diverged"
    manifest = json.loads((done.directory / "manifest.json").read_text())
    assert manifest["status"] == "diverged"
    json.loads((done.directory / "summary.json").read_text(), parse_constant=pytest.fail)


def test_fine_nodes_of_a_diverged_run_are_not_judged_by_rounding(build, tmp_path):
    """The sensing node's error stays of order 1 while the plant grows past 1e16."""
    plant = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
    scenario = build(horizon=600.0, probe=1.0, plant=plant, filter={"kind": "local"})
    done = run_to_directory(scenario, tmp_path / "out")
    assert done.samples.diverged == [1]
    assert done.samples.rounding_from < 30.0
    seeing, blind = done.summary["nodes"]
    assert seeing["rms_error"] < 5.0
    assert blind["rms_error"] > 1e6


FAILING = """
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.traits import Weights


class Bad(Hybrid):
    def absorb(self, state, messages, exchange):
        return state._replace(xhat=1 / len(messages[1:]))


class Nan(Hybrid):
    def absorb(self, state, messages, exchange):
        return state._replace(root=state.root * float("nan"))


class Weightless(Hybrid):
    @property
    def link_weights(self):
        return Weights(lambda degree, peer_degree: 1 / (degree - 2))


class Limitless(Hybrid):
    @property
    def link_weights(self):
        return Weights(largest_degree=self.nothing)


class Picky(Hybrid):
    def __post_init__(self):
        raise ValueError("not today")
"""


@pytest.fixture
def plugged(tmp_path):
    """The ring with a filter of a user's module that lies beside it."""

    def make(name):
        text = (SCENARIOS / "poisson_ring.toml").read_text()
        (tmp_path / "failing_filters.py").write_text(FAILING)
        (tmp_path / "ring.toml").write_text(text.replace('"hybrid"', f'"failing_filters:{name}"'))
        return tmp_path / "ring.toml"

    return make


def test_a_filter_that_raises_is_named_in_one_line(plugged, tmp_path, capsys):
    assert main(["run", "--trust", str(plugged("Bad")), "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(
        "netkf: failing_filters:Bad failed in absorb: ZeroDivisionError: division by zero; "
    )
    assert len(printed.err.splitlines()) == 1
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["status"] == "failed"
    assert manifest["error"] == "ZeroDivisionError: division by zero"
    assert "in absorb" in "".join(manifest["traceback"])
    assert manifest["events"] == len(pd.read_parquet(tmp_path / "out" / "events.parquet")) > 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["messages"]["sent"] > 0


FINE = """
from netkf.algorithms.hybrid import Hybrid


class Fine(Hybrid):
    pass
"""


def test_a_module_beside_the_scenario_travels_with_the_run(tmp_path, ring, capsys):
    home = tmp_path / "home"
    home.mkdir()
    (home / "fine_filters.py").write_text(FINE)
    text = (SCENARIOS / "poisson_ring.toml").read_text().replace("20.0", "2.0")
    (home / "ring.toml").write_text(text.replace('"hybrid"', '"fine_filters:Fine"'))
    out = tmp_path / "out"
    assert main(["run", str(home / "ring.toml"), "--trust", "--out", str(out), "--no-plot"]) == 0
    assert capsys.readouterr().err == ""
    (home / "fine_filters.py").unlink()
    again = run_to_directory(netkf.load(out / "scenario.toml"), tmp_path / "again")
    assert again.summary == json.loads((out / "summary.json").read_text())


def test_a_module_that_does_not_travel_is_named(tmp_path, capsys, monkeypatch):
    package = tmp_path / "filters_of_mine"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "fine.py").write_text(FINE)
    monkeypatch.syspath_prepend(tmp_path)
    change = 'filter={kind="filters_of_mine.fine:Fine", epsilon=0.3}'
    ring = [str(SCENARIOS / "poisson_ring.toml"), "--set", "horizon=2.0", "--no-plot"]
    assert main(["run", *ring, "--trust", "--set", change, "--out", str(tmp_path / "out")]) == 0
    err = capsys.readouterr().err
    assert err.startswith("note: the run directory needs the Python module filters_of_mine.fine,")
    assert len(err.splitlines()) == 1


def test_seconds_are_those_of_the_simulation(ring, tmp_path, monkeypatch):
    """Not of compiling, which only the first run has to wait for."""
    spent = iter((5.0, 1005.0))
    monkeypatch.setattr("netkf.linalg.compiling.seconds_spent", lambda: next(spent))
    assert run_to_directory(ring, tmp_path / "out").seconds < -900.0


def test_half_a_row_group_gets_no_name(ring, tmp_path, monkeypatch):
    def full(self, table):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pyarrow.parquet.ParquetWriter.write_table", full)
    with pytest.raises(OSError, match="No space left"):
        run_to_directory(ring, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"] == "failed"
    assert not (tmp_path / "out" / "events.parquet").exists()


def test_an_error_in_a_class_of_netkf_is_not_covered_up(ring, tmp_path, monkeypatch):
    monkeypatch.setattr("netkf.algorithms.hybrid.Hybrid.absorb", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_to_directory(ring, tmp_path / "out", engine=SimpyEngine())
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"] == "failed"


def test_a_class_that_cannot_be_made_is_refused(plugged):
    with pytest.raises(netkf.ScenarioError, match=r"filter: Picky could not .*not today"):
        netkf.load(plugged("Picky"))
    words = r"toml: failing_filters:Limitless failed in link_weights: AttributeError.*; correct"
    with pytest.raises(netkf.ScenarioError, match=words):
        netkf.load(plugged("Limitless"))


@pytest.mark.parametrize("command", ["run", "theory"])
def test_a_class_that_fails_at_the_start_is_named_in_one_line(plugged, command, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")] if command == "run" else []
    assert main([command, "--trust", str(plugged("Weightless")), *out]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(
        "netkf: failing_filters:Weightless failed in link_weights: ZeroDiv"
    )
    assert len(printed.err.splitlines()) == 1


def test_a_covariance_that_is_not_a_number_is_not_called_an_overflow(plugged, tmp_path, capsys):
    file, out = str(plugged("Nan")), str(tmp_path / "out")
    assert main(["run", file, "--trust", "--out", out, "--no-plot"]) == 0
    printed = capsys.readouterr()
    assert "overflow" not in printed.out
    assert printed.err.startswith("note: diverged, the covariance of nodes 0, 1")
    assert "is not a number" in printed.err


def test_complete_is_the_last_word(ring, tmp_path):
    def look(finished):
        manifest = json.loads((finished.directory / "manifest.json").read_text())
        assert manifest["status"] == "interrupted"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="kept in"):
        run_to_directory(ring, tmp_path / "out", finish=look)
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert (manifest["status"], manifest["runs"]["done"]) == ("interrupted", 1)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["overall"]["bound"] > 0.0


def test_a_run_stopped_before_its_first_sample_has_a_summary(ring, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("netkf.engines.simpy.engine.SimpyEngine.run", stop)
    with pytest.raises(KeyboardInterrupt):
        run_to_directory(ring, tmp_path / "out", "processes")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["bound"] == "not computed: the run was interrupted"
    assert summary["overall"]["rms_error"] is None


def test_a_file_has_its_name_when_it_is_whole(tmp_path):
    file = tmp_path / "run.png"
    file.write_text("before")

    def half():
        with write_atomically(file) as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half()
    assert [path.name for path in tmp_path.iterdir()] == ["run.png"]
    assert file.read_text() == "before"
    with write_atomically(file) as part:
        part.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["run.png"]
    assert file.read_text() == "whole"


def test_directories_are_never_overwritten(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = create_output_directory(None, "a/b name")
    assert first == Path("runs/a-b-name-1")
    assert create_output_directory(None, "a/b name") == Path("runs/a-b-name-2")
    assert create_output_directory(first, "x") == first  # still empty
    (first / "file").touch()
    with pytest.raises(netkf.ScenarioError, match="new or empty directory"):
        create_output_directory(first, "x")


OTHERS = [SCENARIOS / "nonlinear" / "range_tracking.toml"]
OTHERS += sorted((SCENARIOS / "blocks").glob("*.toml"))


LONG = [SCENARIOS / "intel_lab.toml"]
"""Its event loop is compiled for nothing else."""


@pytest.mark.parametrize(
    "file", with_slow([*scenario_files(), *OTHERS], LONG), ids=lambda f: f.stem
)
def test_every_scenario_ends_in_its_expected_summary(file, tmp_path, capsys):
    """The file beside the scenario; numbers to 6 digits, counts exactly."""
    options = ["--out", str(tmp_path / "out"), "--no-plot"]
    assert main(["run", str(file), *options]) == 0
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
