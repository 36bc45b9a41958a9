"""What is kept of a stopped ensemble is proved before it is used."""

import contextlib
import dataclasses
import io
import json
import os
import random
import shutil
import subprocess
import sys

import numpy as np
import pytest

import netkf
from netkf.cli.main import main
from netkf.core.errors import EngineError, ScenarioError, WriteError
from netkf.ensembles import block_files, pools
from netkf.ensembles.checkpoints import BlockCheckpoints
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.pools import PoolOptions
from netkf.runs import provenance
from netkf.runs.files import write_scenario
from netkf.runs.parquet_files import ParquetSink
from tests.conftest import SCENARIOS

RUNS, OPTIONS = 12, EnsembleOptions(pool=PoolOptions(1))
RING = str(SCENARIOS / "poisson_ring.toml")


def short(seed=1):
    return netkf.load(RING, {"horizon": 1.0, "seed": seed})


def files(folder):
    return {f.relative_to(folder): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A whole ensemble, and two that were stopped: ``cut``, and ``other`` with another seed."""
    folder = tmp_path_factory.mktemp("resume")

    def stop(done, wanted):
        if done >= 6:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block_files, "FIRST_WRITE", 0.0)  # every block in a file
        patch.setattr(block_files, "WRITE_SHARE", 0.0)
        patch.setattr(block_files, "_neighbour", lambda node: None)  # and none is merged
        patch.setattr(pools, "MAX_BLOCK_HERE", 1)
        runs_to_directory(short(), RUNS, folder / "whole", OPTIONS)
        for name, seed in (("cut", 1), ("other", 2)):
            with pytest.raises(KeyboardInterrupt):
                runs_to_directory(short(seed), RUNS, folder / name, OPTIONS, progress=stop)
    return folder


@pytest.fixture
def cut(made, tmp_path):
    return shutil.copytree(made / "cut", tmp_path / "cut")


def resume(folder, scenario=None):
    """Go on; return the notes and the number of runs that were simulated."""
    notes = []
    done = runs_to_directory(
        scenario or short(),
        RUNS,
        folder,
        dataclasses.replace(OPTIONS, resume=True),
        note=notes.append,
    )
    return notes, None if done is None else done.simulated


def assert_done_again(folder, made, blocks=1):
    notes, simulated = resume(folder)
    assert len(notes) == 1
    assert "done again" in notes[0]
    assert simulated == 6 + blocks
    assert files(folder) == files(made / "whole")


def seal(contents):
    """A block that says of itself that it is whole."""
    buffer = io.BytesIO(contents)
    return contents + block_files.MARK + block_files.digest_of(buffer, len(contents))


def forged(block, **changes):
    """A block with other arrays and the right digest."""
    with np.load(block) as found:
        arrays = {**{name: found[name] for name in found.files}, **changes}
    made = io.BytesIO()
    np.savez(made, **arrays)
    block.write_bytes(seal(made.getvalue()))


def as_nan(block, name):
    with np.load(block) as found:
        return np.full_like(found[name], np.nan)


def flip(block, draw):
    found = bytearray(block.read_bytes())
    found[draw.randrange(len(found))] ^= 1 << draw.randrange(8)
    block.write_bytes(found)


def as_fifo(block, draw):
    block.unlink()
    os.mkfifo(block)


def as_other_number(block, draw):
    shutil.copyfile(block.with_name("000000000-1.npz"), block)


DAMAGE = {
    "truncated": lambda block, draw: block.write_bytes(block.read_bytes()[:-100]),
    "without digest": lambda block, draw: block.write_bytes(block.read_bytes()[:-71]),
    "empty": lambda block, draw: block.write_bytes(b""),
    "fifo": as_fifo,
    "other number": as_other_number,
    "other shape": lambda block, draw: forged(block, samples_mean=np.zeros((2, 2))),
    "other type": lambda block, draw: forged(block, totals=np.array(["a", "b"])),
    "no mean": lambda block, draw: forged(block, samples_mean=as_nan(block, "samples_mean")),
    "no M2": lambda block, draw: forged(block, averages_M2=as_nan(block, "averages_M2")),
    "no messages": lambda block, draw: forged(block, messages_mean=as_nan(block, "messages_mean")),
    "no size": lambda block, draw: forged(block, samples_size=as_nan(block, "samples_size")),
    "less than nothing": lambda block, draw: forged(block, totals=np.array([-1, 0])),
    "no words": lambda block, draw: forged(block, words=np.array("[" * 100_000)),
    "no zip": lambda block, draw: block.write_bytes(seal(b"PK nothing")),
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_block_is_done_again(cut, made, how):
    DAMAGE[how](cut / "blocks" / "000000003-1.npz", random.Random(1))
    assert_done_again(cut, made)


def test_every_byte_of_a_block_is_proved(cut):
    block = cut / "blocks" / "000000003-1.npz"
    whole, draw = block.read_bytes(), random.Random(1)
    for _ in range(200):
        block.write_bytes(whole)
        flip(block, draw)
        with pytest.raises(block_files.DamagedError):
            block_files.verify(block)


def test_a_block_of_another_seed_is_done_again(cut, made):
    for number in (1, 2):
        name = f"{number:09d}-1.npz"
        shutil.copyfile(made / "other" / "blocks" / name, cut / "blocks" / name)
    assert_done_again(cut, made, blocks=2)


@pytest.mark.parametrize(
    "key", ["numpy", "scipy", "numba", "python", "netkf", "source", "features"]
)
def test_everything_that_decides_bits_decides_what_is_used(cut, monkeypatch, key):
    """Neither the manifest nor, where that was removed, the blocks of another installation."""
    before = {**provenance.versions()}, {**provenance.machine()}
    assert key in before[0] or key in before[1]
    for found in before:
        if key in found:
            found[key] = "other"
    for room in ("runs.provenance", "ensembles.resume", "ensembles.block_files"):
        monkeypatch.setattr(f"netkf.{room}.versions", lambda: before[0])
        monkeypatch.setattr(f"netkf.{room}.machine", lambda: before[1])
    with pytest.raises(ScenarioError, match=f"holds a run of another (version|machine).*{key}"):
        resume(cut)
    (cut / "manifest.json").unlink()
    notes, simulated = resume(cut)
    assert "is of another installation" in notes[0]
    assert simulated == 12


def test_blocks_do_without_a_manifest(cut, made):
    (cut / "manifest.json").unlink()
    assert resume(cut) == ([], 6)
    assert files(cut) == files(made / "whole")


def change(manifest, key, value):
    found = json.loads(manifest.read_text())
    table, _, last = key.rpartition(".")
    (found[table] if table else found)[last] = value
    manifest.write_text(json.dumps(found))


CHANGES = {
    "tasks": 2,
    "runs.done": 12,
    "runs.wanted": 13,
    "seed": 2,
    "replica": 1,
    "status": "complete",
    "scenario": "0" * 64,
    "trace": "full",
    "engine": "simpy",
    "name": "other",
    "versions": {},
    "machine": None,
    "sha256": "0" * 64,
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("key", CHANGES)
def test_a_changed_manifest_is_refused(cut, made, key):
    change(cut / "manifest.json", key, CHANGES[key])
    before = files(cut)
    with pytest.raises(ScenarioError) as error:
        resume(cut)
    assert "\n" not in str(error.value)
    assert files(cut) == before
    (cut / "manifest.json").unlink()  # the remedy
    assert resume(cut) == ([], 6)
    assert files(cut) == files(made / "whole")


@pytest.mark.parametrize(
    "text",
    ["", "null", "[]", "{}", "3", "{", '{"a": ' * 100_000, '"\\ud800"', "NaN", "1" * 10_000, "\0"],
)
def test_what_is_no_manifest_is_refused_in_one_line(cut, text, capsys):
    for out, trace in ((cut, ["--runs", "12"]), (cut, [])):
        (out / "manifest.json").write_text(text)
        line = ["run", RING, "--set", "horizon=1.0", "--out", str(out), "--resume", *trace]
        assert main(line) == 2
        printed = capsys.readouterr().err
        assert "manifest.json" in printed
        assert len(printed.splitlines()) == 1


def test_results_do_not_stay_beside_another_scenario(made, cut, tmp_path):
    whole = shutil.copytree(made / "whole", tmp_path / "whole")
    for folder in (cut, whole):
        toml = folder / "scenario.toml"
        toml.write_text(toml.read_text().replace("horizon = 1.0", "horizon = 2.0"))
        with pytest.raises(ScenarioError, match=r"scenario\.toml was changed"):
            resume(folder)
        toml.unlink()
    assert resume(cut) == ([], 6)
    assert files(cut) == files(made / "whole")


@pytest.mark.parametrize("name", ["summary.json", "ensemble.parquet", "events.parquet"])
def test_a_finished_run_that_was_changed_is_not_called_done(made, tmp_path, name):
    whole = shutil.copytree(made / "whole", tmp_path / "whole")
    assert resume(whole) == ([], None)
    with (whole / name).open("ab") as file:
        file.write(b" ")
    with pytest.raises(ScenarioError, match=f"{name} was changed since the run ended"):
        resume(whole)
    (whole / name).unlink()
    with pytest.raises(ScenarioError, match=f"{name} is missing since the run ended"):
        resume(whole)


def test_a_block_that_is_damaged_meanwhile_is_one_line(cut, made, monkeypatch):
    """After it was proved, before its traces are written."""
    load = BlockCheckpoints.load

    def damage(self, node):
        (cut / "blocks" / "000000002-1.npz").write_bytes(b"")
        return load(self, node)

    monkeypatch.setattr(BlockCheckpoints, "load", damage)
    with pytest.raises(EngineError, match="go on with --resume"):
        resume(cut)
    monkeypatch.undo()
    assert resume(cut)[0] == []
    assert files(cut) == files(made / "whole")


def test_a_trace_that_does_not_fit_is_one_line_and_done_again(cut, made):
    forged(cut / "blocks" / "000000000-1.npz", trace_0_replica=np.array(1e300))
    with pytest.raises(EngineError, match=r"000000000-1\.npz does not fit the scenario"):
        resume(cut)
    assert resume(cut) == ([], 1)
    assert files(cut) == files(made / "whole")


def test_a_single_run_that_was_changed_is_done_again(tmp_path, capsys):
    line = ["run", RING, "--set", "horizon=1.0", "--no-plot", "--out", str(tmp_path / "out")]
    assert main(line) == 0
    before = files(tmp_path / "out")
    assert main([*line, "--resume"]) == 0
    assert "nothing left to do" in capsys.readouterr().out
    for name in ("summary.json", "manifest.json"):
        path = tmp_path / "out" / name
        path.write_text(path.read_text().replace("1", "2", 1))
        assert main([*line, "--resume"]) == 0
        printed = capsys.readouterr()
        assert len(printed.err.splitlines()) == 1
        assert "is done again" in printed.err
        assert files(tmp_path / "out") == before
    # Killed before its first file was there.
    for path in (tmp_path / "out").iterdir():
        path.rename(path.with_name(f"{path.name}.part"))
    assert main([*line, "--resume"]) == 0
    assert files(tmp_path / "out") == before


def test_a_check_removes_what_a_check_left_and_nothing_else(tmp_path, capsys):
    short = ["--set", "horizon=1.0", "--no-plot"]
    out = tmp_path / "run"
    assert main(["run", RING, *short, "--out", str(out)]) == 0
    before = files(out)
    check = ["check", RING, *short, "--runs", "10", "--workers", "1", "--resume", "--out"]
    assert main([*check, str(out)]) == 2
    assert "has no verdict that can be read" in capsys.readouterr().err
    assert files(out) == before
    # Killed before its verdict was there.
    left = tmp_path / "check"
    left.mkdir()
    write_scenario(left, netkf.load(RING, {"horizon": 1.0, "probe": [0.0]}))
    (left / "results.npz.part").write_bytes(b"half")
    capsys.readouterr()
    assert main([*check, str(left), "--set", "seed=7"]) == 2
    assert "holds a run of another scenario" in capsys.readouterr().err
    assert sorted(map(str, files(left))) == ["results.npz.part", "scenario.toml"]
    assert main([*check, str(left)]) < 2
    assert (left / "verdict.json").exists()
    assert not (left / "results.npz.part").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_tables_that_are_stopped_leave_no_part(cut, made, monkeypatch, error):
    """While the traces of all runs are written, after the last block."""

    def stop(self, *trace):
        add(self, *trace)
        self._flush()
        assert list(cut.glob("*.part"))
        raise error

    add = ParquetSink.add
    monkeypatch.setattr(ParquetSink, "add", stop)
    with pytest.raises((KeyboardInterrupt, OSError)):
        resume(cut)
    assert not list(cut.glob("*.part"))
    monkeypatch.undo()
    assert resume(cut) == ([], 0)
    assert files(cut) == files(made / "whole")


def test_the_only_copy_of_a_table_is_not_removed(tmp_path, capsys):
    """``--resume`` of a single run with the scenario of its own directory."""
    out = tmp_path / "out"
    text = (SCENARIOS / "poisson_ring.toml").read_text()
    (tmp_path / "links.csv").write_text("sender,receiver\n" + "0,1\n1,0\n1,2\n2,1\n2,3\n3,2\n")
    lines = [
        'graph = { kind = "csv", path = "links.csv" }' if line.startswith("graph") else line
        for line in text.splitlines()
    ]
    (tmp_path / "x.toml").write_text("\n".join(lines))
    short = ["--set", "horizon=1.0", "--no-plot", "--out", str(out)]
    assert main(["run", str(tmp_path / "x.toml"), *short]) == 0
    (out / "summary.json").unlink()
    before = files(out)
    capsys.readouterr()
    assert main(["run", str(out / "scenario.toml"), *short, "--resume"]) == 2
    assert "links.csv is in the directory" in capsys.readouterr().err
    assert files(out) == before
    assert main(["run", str(tmp_path / "x.toml"), *short, "--resume"]) == 0


def test_contents_reach_the_disk_before_names(tmp_path, monkeypatch):
    """Of every file that is written: fsync of the file, rename, fsync of the directory."""
    calls = []

    def record(name, call):
        def recorded(*arguments):
            inode = os.fstat(arguments[0]).st_ino if name == "fsync" else str(arguments[1])
            calls.append((name, inode))
            return call(*arguments)

        return recorded

    monkeypatch.setattr(os, "fsync", record("fsync", os.fsync))
    monkeypatch.setattr(os, "replace", record("replace", os.replace))
    runs_to_directory(short(), RUNS, tmp_path / "out", OPTIONS)
    renamed = {path for name, path in calls if name == "replace"}
    kept = {str(file) for file in (tmp_path / "out").iterdir()}
    assert kept <= renamed
    for k, (name, path) in enumerate(calls):
        if name == "replace":
            assert [calls[k - 1][0], calls[k + 1][0]] == ["fsync", "fsync"]
            if path in kept - {str(tmp_path / "out" / "manifest.json")}:
                assert calls[k - 1][1] == os.stat(path).st_ino


FULL = ["run", RING, "--set", "horizon=20.0", "--no-plot", "--trace", "full", "--workers", "1"]


@contextlib.contextmanager
def small_files(size):
    """Files of this process may be limited: writing fails as on a full disk."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("runs", ["1", "5"])
def test_a_full_disk_leaves_nothing_behind(tmp_path, capsys, runs):
    # What is compiled has been kept on disk before there is no space.
    assert main([*FULL, "--runs", runs, "--out", str(tmp_path / "whole")]) == 0
    for bytes_left in (0, 300, 3000, 6000):
        capsys.readouterr()
        with small_files(bytes_left):
            status = main([*FULL, "--runs", runs, "--out", str(tmp_path / str(bytes_left))])
        error = capsys.readouterr().err
        assert status == 2
        assert error.startswith("netkf: cannot write: File too large (")
        assert len(error.splitlines()) == 1
        assert not list(tmp_path.rglob("*.part"))


def test_a_full_disk_ends_a_process_in_one_line(tmp_path):
    resource = pytest.importorskip("resource")
    done = subprocess.run(
        [sys.executable, "-m", "netkf", *FULL, "--runs", "5", "--out", str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=False,
        # No bytecode: a file that ends at the limit would be taken for a module later.
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000)),
    )
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    (line,) = [each for each in lines if not each.startswith("netkf: compiling, once")]
    assert line.startswith("netkf: cannot write: File too large (")


def test_an_error_of_writing_is_an_oserror_too(tmp_path):
    with pytest.raises(OSError, match="cannot write") as error:
        raise WriteError(OSError(28, "No space left on device"), tmp_path)
    assert error.value.errno == 28
    assert error.value.filename == str(tmp_path)
