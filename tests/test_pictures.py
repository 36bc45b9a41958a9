"""Commands whose pictures, or whose files, cannot be written: their answers and statuses stay."""

import json
import os
import subprocess
import sys

import pytest

from netkf.cli.main import main
from tests.conftest import SCENARIOS

RING = [str(SCENARIOS / "poisson_ring.toml"), "--set", "horizon=1.0"]
FEW = ["--runs", "10", "--workers", "1"]
COMMANDS = {
    "run": ["run", *RING],
    "run many": ["run", *RING, *FEW],
    "sweep": ["sweep", *RING, "--vary", "filter.epsilon=0.1,0.3"],
    "check": ["check", *RING, *FEW],
    "compare-filters": ["compare-filters", *RING, "--filters", "hybrid,local", *FEW],
}


def full(*_, **__):
    raise OSError(28, "No space left on device")


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", list(COMMANDS))
def test_a_picture_that_cannot_be_written_is_a_note(name, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("matplotlib.backends.backend_agg.FigureCanvasAgg.print_png", full)
    out = tmp_path / "out"
    assert main([*COMMANDS[name], "--out", str(out)]) == 0
    printed = capsys.readouterr()
    lines = [line for line in printed.err.splitlines() if "no picture" in line]
    assert len(lines) == 1
    assert lines[0].startswith(f"note: no picture: cannot write: No space left on device ({out}")
    assert f"written to {out}" in printed.out
    assert not [file for file in out.iterdir() if file.suffix in (".png", ".part")]


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("name", "writer"),
    [
        ("check", "netkf.checks.storage"),
        ("compare-filters", "netkf.studies.compare_filters"),
        ("sweep", "netkf.studies.sweep"),
    ],
)
def test_an_answer_whose_files_cannot_be_written_is_printed(
    name, writer, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(f"{writer}.write_text", full)
    assert main([*COMMANDS[name], "--json", "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert json.loads(printed.out)["rows"]
    lines = [line for line in printed.err.splitlines() if not line.startswith("note: ")]
    assert lines == ["netkf: No space left on device"]


@pytest.mark.parametrize("name", ["check", "compare-filters"])
def test_a_directory_in_use_is_refused_before_anything_runs(name, tmp_path, capsys, monkeypatch):
    def runs(*_, **__):
        raise AssertionError("it runs")

    monkeypatch.setattr("netkf.cli.check.check", runs)
    monkeypatch.setattr("netkf.cli.studies.compare_filters", runs)
    (tmp_path / "mine").write_text("")
    assert main([*COMMANDS[name], "--out", str(tmp_path)]) == 2
    assert "must be a new or empty directory" in capsys.readouterr().err


@pytest.mark.slow
def test_the_name_of_a_window_does_not_matter(tmp_path):
    words = [sys.executable, "-m", "netkf", *COMMANDS["run"], "--out", str(tmp_path / "out")]
    env = {**os.environ, "MPLBACKEND": "nonsense"}
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "run.png").exists()


def test_a_verdict_has_no_picture_of_fewer_runs(tmp_path):
    command = [*COMMANDS["check"], "--out", str(tmp_path / "out")]
    assert main(command) == 0
    assert (tmp_path / "out" / "verdict.png").exists()
    assert main([*command, "--runs", "12", "--resume", "--no-plot"]) == 0
    assert not (tmp_path / "out" / "verdict.png").exists()


def test_a_check_that_was_stopped_after_its_verdict_is_done_when_it_is_given_again(
    tmp_path, capsys
):
    out = tmp_path / "out"
    command = [*COMMANDS["check"], "--runs", "11", "--out", str(out), "--resume"]
    assert main([*command, "--no-plot"]) == 0
    first = capsys.readouterr().out
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    assert main(command) == 0
    again = capsys.readouterr()
    assert again.out == first.replace("written to", "nothing left to do in")
    assert again.err == ""
    assert (out / "verdict.png").exists()
    assert before == {name: (out / name).read_bytes() for name in before}
    assert main([*command, "--runs", "10"]) == 2
    assert "must be more: the verdict has 11 runs already" in capsys.readouterr().err
