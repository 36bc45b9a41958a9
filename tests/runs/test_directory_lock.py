"""Two commands never write into one directory at a time."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import networkx
import pytest

import netkf
from netkf.cli.main import main
from netkf.logs.importing import write_folder
from netkf.runs.files import lock_directory

RING = str(Path(__file__).parents[2] / "scenarios" / "poisson_ring.toml")
HOLD = """
import sys, time
from pathlib import Path
from netkf.runs.files import lock_directory
with lock_directory(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Return a directory that another process has locked, and that process."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield tmp_path / "out", process
        process.kill()


COMMANDS = [
    ["run", RING, "--set", "horizon=1.0"],
    ["run", RING, "--set", "horizon=1.0", "--resume"],
    ["run", RING, "--set", "horizon=1.0", "--runs", "2", "--workers", "1", "--resume"],
    ["check", RING, "--set", "horizon=1.0", "--runs", "10", "--workers", "1"],
    ["sweep", RING, "--set", "horizon=1.0", "--vary", "filter.epsilon=0.1,0.2"],
]


def test_folders_of_imports_and_exports_are_written_by_one_command(holder):
    """Two imports at once passed the check that nothing is overwritten together."""
    out, _ = holder
    with pytest.raises(netkf.ScenarioError, match="another netkf command writes there"):
        write_folder(out, {"outcomes.csv": "t\n"})
    assert not list(out.iterdir())


def test_the_second_command_on_a_directory_ends_with_one_line(holder, capsys):
    out, process = holder
    for command in COMMANDS:
        assert main([*command, "--no-plot", "--out", str(out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("netkf: --out: is in use: another netkf command writes there")
        assert not any(out.iterdir())
    # The operating system gives back the lock of a process that was killed outright.
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert main([*COMMANDS[1], "--no-plot", "--out", str(out)]) == 0
    assert (out / "summary.json").exists()


def test_a_directory_is_made_and_removed_again_if_nothing_was_written(tmp_path):
    with lock_directory(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b").is_dir()
    assert not (tmp_path / "a" / "b").exists()
    (tmp_path / "file").touch()
    with (
        pytest.raises(netkf.ScenarioError, match="--plan: cannot be made"),
        lock_directory(tmp_path / "file", option="--plan"),
    ):
        pass


def test_an_interrupted_check_says_what_is_kept(tmp_path, monkeypatch, capsys):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    check, out = COMMANDS[3], str(tmp_path / "out")
    assert main([*check, "--no-plot", "--out", out]) in (0, 1)
    before = (tmp_path / "out" / "verdict.json").read_bytes()
    capsys.readouterr()
    monkeypatch.setattr("netkf.cli.check.check", interrupt)
    more = ["--runs", "12", "--workers", "1", "--no-plot"]
    assert main([*check[:4], *more, "--resume", "--out", out]) == 130
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("netkf: interrupted; new runs are kept with their verdict only; ")
    assert line.endswith("has the verdict on 10 runs")
    assert (tmp_path / "out" / "verdict.json").read_bytes() == before
    assert main([*check, "--no-plot", "--out", str(tmp_path / "new")]) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_file_system_without_locks_is_noted(tmp_path, monkeypatch, capsys):
    def refuse(opened):
        raise OSError(os.strerror(95))

    monkeypatch.setattr("netkf.runs.files._lock_file", refuse)
    with lock_directory(tmp_path):
        pass
    assert "one command at a time" in capsys.readouterr().err


def test_two_processes_that_hold_no_lock_write_one_file_whole(tmp_path, monkeypatch):
    run = netkf.simulate(netkf.load(RING, {"horizon": 1.0}))
    out, write = tmp_path / "out.graphml", networkx.write_graphml

    def overtaken(graph, path):
        Path(path).write_text("half")
        monkeypatch.setattr(networkx, "write_graphml", write)
        monkeypatch.setattr(os, "getpid", lambda: -1)
        netkf.export_graphml(run, tmp_path)
        (tmp_path / "network.graphml").rename(out)
        assert Path(path).read_text() == "half"
        write(graph, path)

    monkeypatch.setattr(networkx, "write_graphml", overtaken)
    netkf.export_graphml(run, tmp_path)
    assert (tmp_path / "network.graphml").read_bytes() == out.read_bytes()
    assert len(list(tmp_path.iterdir())) == 2
