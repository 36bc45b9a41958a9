"""Plans: what workers leave in a directory, in any order and however they end, is one ensemble."""

import datetime
import errno
import itertools
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import netkf
from netkf.cli.commands import parse_duration
from netkf.cli.main import main
from netkf.ensembles import block_files, checkpoints, parts, plans
from netkf.ensembles.checkpoints import BlockCheckpoints
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.parts import Part, part_of_array
from netkf.ensembles.plans import open_plan, work_on_plan
from netkf.ensembles.pools import PoolOptions
from netkf.runs import provenance
from tests.conftest import SCENARIOS

RING = str(SCENARIOS / "poisson_ring.toml")
RUNS = 21
LINE = [RING, "--set", "horizon=1.0", "--runs", str(RUNS)]


def files(folder):
    return {f.relative_to(folder): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What one command writes."""
    folder = tmp_path_factory.mktemp("plans") / "whole"
    scenario = netkf.load(RING, {"horizon": 1.0})
    runs_to_directory(scenario, RUNS, folder, EnsembleOptions(pool=PoolOptions(1)))
    return files(folder)


@pytest.fixture
def plan(tmp_path, capsys):
    assert main(["plan", *LINE, "--out", str(tmp_path / "plan"), "--tasks", "5"]) == 0
    assert "21 runs for 5 jobs, none of them simulated" in capsys.readouterr().out
    return tmp_path / "plan"


def work(folder, *arguments):
    return main(["work", str(folder), *arguments])


def merge(folder, *arguments):
    return main(["merge", str(folder), "--no-plot", *arguments])


def test_shuffled_workers_are_one_run(plan, whole, capsys):
    order = list(range(1, 6))
    random.Random(3).shuffle(order)
    for k in order[:-1]:
        assert work(plan, "--part", f"{k}/5") == 0
    assert merge(plan) == 1
    gap = Part(order[-1], 5).of(RUNS)
    assert f"runs have no result: {gap[0]}-{gap[-1]}\n" in capsys.readouterr().out
    assert work(plan, "--part", f"{order[0]}/5") == 0  # requeued, though it was finished
    assert "nothing left to do" in capsys.readouterr().out
    assert work(plan) == 0
    assert merge(plan) == 0
    assert files(plan) == whole
    for again in (work, merge):
        assert again(plan) == 0
        assert "nothing left to do" in capsys.readouterr().out
    assert files(plan) == whole


def test_a_block_that_another_worker_merges_meanwhile(plan, whole, monkeypatch, capsys):
    assert work(plan) == 0
    load = BlockCheckpoints.load

    def load_late(self, node):
        for file in (plan / "blocks").glob("*.npz"):
            file.rename(file.with_suffix(".away"))
        return load(self, node)

    with monkeypatch.context() as patch:
        patch.setattr(BlockCheckpoints, "load", load_late)
        assert merge(plan) == 2
    error = capsys.readouterr().err
    assert "another worker may have merged it: give the same command again" in error
    assert "--resume" not in error
    for file in (plan / "blocks").glob("*.away"):
        file.rename(file.with_suffix(".npz"))
    assert merge(plan) == 0
    assert files(plan) == whole


@pytest.mark.parametrize("ended", [(0, 2), (4,)])
def test_jobs_that_merge_lists_are_submitted_again(ended, plan, whole, monkeypatch, capsys):
    for part in ended:
        assert work(plan, "--part", f"{part}/5") == 0
    assert merge(plan) == 1
    listed = re.search(r"these of its 5 jobs again: --array=([\d,-]+)\n", capsys.readouterr().out)
    ranges = [one.split("-") for one in listed[1].split(",")]
    jobs = [job for one in ranges for job in range(int(one[0]), int(one[-1]) + 1)]
    assert jobs == [job for job in range(5) if job not in ended]
    array = {"MIN": jobs[0], "MAX": jobs[-1], "COUNT": len(jobs), "STEP": 1}
    for name, value in array.items():
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", str(value))
    for job in jobs:
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(job))
        assert work(plan) == 0
    assert merge(plan) == 0
    assert files(plan) == whole


def test_parts_cover_all_runs_once_from_0_or_from_1():
    for runs, count in itertools.product((1, 2, 21, 64, 1000), (1, 2, 3, 7, 64)):
        for first in (0, 1):
            parts = [Part(k, count).of(runs) for k in range(first, count + first)]
            covered = sorted(replica for part in parts for replica in part)
            assert covered == list(range(runs))
        longest = max(map(len, parts))
        assert longest <= -(-runs // count) * 1.25 + 1  # parts are about equal


@pytest.mark.parametrize(
    ("variables", "part"),
    [
        ({}, Part(0, 1)),
        ({"SLURM_ARRAY_TASK_ID": "12", "MIN": "10", "MAX": "13", "COUNT": "4"}, Part(12, 4)),
        ({"SLURM_ARRAY_TASK_ID": "6", "MIN": "2", "MAX": "8", "STEP": "2"}, Part(4, 4)),
        # Three jobs of the plan's five that are submitted again.
        ({"SLURM_ARRAY_TASK_ID": "4", "MIN": "1", "MAX": "4", "COUNT": "3"}, Part(4, 5)),
        ({"SLURM_ARRAY_TASK_ID": "4", "MIN": "3", "MAX": "4", "COUNT": "2"}, Part(4, 5)),
        ({"SLURM_ARRAY_TASK_ID": "2", "MIN": "2", "MAX": "2", "COUNT": "1"}, Part(2, 5)),
        ({"PBS_ARRAY_INDEX": "3"}, Part(3, 5)),
        ({"SGE_TASK_ID": "undefined"}, Part(0, 1)),
        ({"SGE_TASK_ID": "3", "SGE_TASK_FIRST": "1", "SGE_TASK_LAST": "9"}, Part(3, 9)),
        ({"LSB_JOBINDEX": "0", "LSB_JOBINDEX_END": "9"}, Part(0, 1)),
        ({"LSB_JOBINDEX": "9", "LSB_JOBINDEX_END": "9", "LSB_JOBINDEX_STEP": "1"}, Part(9, 9)),
    ],
)
def test_arrays_of_batch_systems_tell_the_part(variables, part):
    short = ("MIN", "MAX", "STEP", "COUNT")
    names = {name: f"SLURM_ARRAY_TASK_{name}" if name in short else name for name in variables}
    environment = {names[name]: value for name, value in variables.items()}
    assert part_of_array(5, environment) == part


@pytest.mark.parametrize("first", [0, 1])
def test_a_job_that_is_submitted_again_alone_has_its_part_of_before(first):
    def part_of(job, jobs):
        array = {"ID": job, "MIN": jobs[0], "MAX": jobs[-1], "COUNT": len(jobs), "STEP": 1}
        return part_of_array(
            5, {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in array.items()}
        )

    jobs = range(first, first + 5)
    for job in jobs[2:]:
        assert part_of(job, [job]).of(RUNS) == part_of(job, jobs).of(RUNS)


def test_time_and_interrupts_keep_what_was_finished(plan, whole, monkeypatch, capsys):
    ticks = itertools.count()
    with monkeypatch.context() as patch:  # a second for each look at the clock
        patch.setattr(parts.time, "monotonic", lambda: float(next(ticks)))
        assert work(plan, "--for", "12s") == 1
    assert "are left: run it again" in capsys.readouterr().out

    def stop(done, wanted):
        raise KeyboardInterrupt

    opened = open_plan(plan)
    before = len(list((plan / "blocks").iterdir()))
    with pytest.raises(KeyboardInterrupt, match="go on with netkf work"):
        work_on_plan(opened, Part(0, 1), progress=stop)
    assert len(list((plan / "blocks").iterdir())) > before
    assert work(plan) == 0
    assert merge(plan) == 0
    assert files(plan) == whole


def test_two_workers_on_one_block_do_no_harm(plan, whole, monkeypatch):
    """The second begins before the first has written, with blocks of another size."""
    opened, inside = open_plan(plan), []

    def other(done, wanted):
        if not inside:
            inside.append(work_on_plan(opened, Part(0, 2), pool=PoolOptions(1)).simulated)

    assert work_on_plan(opened, Part(0, 1), progress=other).simulated == RUNS
    assert inside == [len(Part(0, 2).of(RUNS))]
    assert merge(plan) == 0
    assert files(plan) == whole


def test_damaged_blocks_are_missing_until_they_are_done_again(plan, whole, capsys):
    assert work(plan, "--part", "1/2") == 0
    assert work(plan, "--part", "2/2") == 0
    largest = max((plan / "blocks").iterdir(), key=lambda file: int(file.stem.split("-")[1]))
    damaged = bytearray(largest.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    largest.write_bytes(damaged)
    (plan / "blocks" / "notes.npz").write_bytes(b"")
    (plan / "blocks" / "000000008-8.npz.node-1.part").write_bytes(b"half")
    assert merge(plan) == 1
    printed = capsys.readouterr()
    assert f"{largest.name} was changed since it was written" in printed.err
    assert "have no result" in printed.out
    assert work(plan) == 0
    assert merge(plan) == 0
    assert files(plan) == whole


def test_other_versions_are_refused_and_other_machines_only_mixed_if_asked(
    plan, whole, monkeypatch, capsys
):
    assert work(plan, "--part", "1/2") == 0
    other = {**provenance.machine(), "processor": "another"}
    with monkeypatch.context() as patch:
        patch.setattr(block_files, "machine", lambda: other)
        assert work(plan) == 0
    capsys.readouterr()
    assert merge(plan) == 2
    error = capsys.readouterr().err
    assert "machines of different kinds" in error
    assert "another" in error
    assert len(error.splitlines()) == 1
    mixed = shutil.copytree(plan, plan.with_name("mixed"))
    assert merge(mixed, "--mixed") == 0
    manifest = json.loads((mixed / "manifest.json").read_text())
    assert other in manifest["machines"]
    assert files(mixed).keys() == whole.keys()
    capsys.readouterr()

    newer = {**provenance.versions(), "numpy": "99.0"}
    monkeypatch.setattr(plans, "versions", lambda: newer)
    for again in (work, merge):
        assert again(plan) == 2
        error = capsys.readouterr().err
        assert "numpy 99.0 instead of" in error
        assert len(error.splitlines()) == 1
    # Of what is merged nothing is computed again.
    assert plans.open_plan(mixed).is_merged


def test_what_is_no_plan_is_refused_in_one_line(plan, tmp_path, capsys):
    changed = shutil.copytree(plan, tmp_path / "changed")
    text = (changed / "scenario.toml").read_text()
    (changed / "scenario.toml").write_text(text.replace("horizon = 1.0", "horizon = 2.0"))
    lost = shutil.copytree(plan, tmp_path / "lost")
    (lost / "scenario.toml").unlink()
    sealed = shutil.copytree(plan, tmp_path / "sealed")
    manifest = (sealed / "manifest.json").read_text()
    (sealed / "manifest.json").write_text(manifest.replace('"wanted": 21', '"wanted": 22'))
    for folder in (tmp_path / "none", changed, lost, sealed):
        for command in (work, merge):
            before = files(folder)
            assert command(folder) == 2
            error = capsys.readouterr().err
            assert f"/{folder.name}" in error  # long paths are cut
            assert len(error.splitlines()) == 1
            assert files(folder) == before
    assert main(["plan", *LINE, "--out", str(plan)]) == 2
    assert "must be a new or empty directory" in capsys.readouterr().err
    for bad in (["--part", "5/4"], ["--part", "x"]):
        with pytest.raises(SystemExit):
            main(["work", str(plan), *bad])
        assert len(capsys.readouterr().err.splitlines()) == 1
    run = netkf.simulate(netkf.load(RING, {"horizon": 1.0}), engine="simpy")
    assert work(netkf.save(run, run.scenario, tmp_path / "single")) == 2
    assert "it is the directory of a single run" in capsys.readouterr().err


def test_blocks_that_may_not_be_read_are_not_missing(plan, monkeypatch, capsys):
    def refuse(folder):
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    assert work(plan, "--part", "1/5") == 0
    monkeypatch.setattr(Path, "iterdir", refuse)
    capsys.readouterr()
    for command in (work, merge):
        assert command(plan) == 2
        assert "Permission denied" in capsys.readouterr().err


def test_a_full_disk_keeps_what_was_written(plan, whole, monkeypatch, capsys):
    assert work(plan, "--part", "1/2") == 0
    before = files(plan)

    def full(self, data):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(type(plan), "write_bytes", full)
        assert work(plan) == 2
    error = capsys.readouterr().err
    assert "No space left on device" in error
    assert len(error.splitlines()) == 1
    assert files(plan) == before
    assert work(plan) == 0
    assert merge(plan) == 0
    assert files(plan) == whole


def test_a_stopped_run_and_a_plan_are_the_same(plan, whole, tmp_path, capsys):
    """Workers go on with ``netkf run``, and ``--resume`` with a plan."""
    assert work(plan, "--part", "2/3") == 0
    assert main(["run", *LINE, "--out", str(plan), "--resume", "--no-plot", "--workers", "1"]) == 0
    assert files(plan) == whole

    def stop(done, wanted):
        if done >= 3:
            raise KeyboardInterrupt

    options = EnsembleOptions(pool=PoolOptions(1))
    with pytest.raises(KeyboardInterrupt):
        runs_to_directory(
            netkf.load(RING, {"horizon": 1.0}), RUNS, tmp_path / "cut", options, progress=stop
        )
    assert work(tmp_path / "cut") == 0
    assert merge(tmp_path / "cut") == 0
    assert files(tmp_path / "cut") == whole


def test_traces_of_all_runs_come_through(tmp_path):
    line = [*LINE, "--trace", "full"]
    assert main(["plan", *line, "--out", str(tmp_path / "plan")]) == 0
    for part in ("2/2", "1/2"):
        assert work(tmp_path / "plan", "--part", part) == 0
    assert merge(tmp_path / "plan") == 0
    one = ["--workers", "1", "--no-plot", "--out", str(tmp_path / "one")]
    assert main(["run", *line, *one]) == 0
    assert files(tmp_path / "plan") == files(tmp_path / "one")


def test_a_worker_writes_bytes_for_runs_not_for_blocks(tmp_path, monkeypatch):
    """A part that is a node of the tree over runs is one file, however many blocks it had."""
    assert (
        main(["plan", RING, "--set", "horizon=1.0", "--runs", "64", "--out", str(tmp_path / "p")])
        == 0
    )
    blocks = []
    add = checkpoints.BlockCheckpoints.add
    monkeypatch.setattr(
        checkpoints.BlockCheckpoints, "add", lambda *given: (blocks.append(given[1]), add(*given))
    )
    for part in ("1/2", "2/2"):
        assert work(tmp_path / "p", "--part", part) == 0
    assert len(blocks) > 4
    assert len(list((tmp_path / "p" / "blocks").iterdir())) == 2


# The forms that sbatch(1) gives for --time, and hours, minutes and seconds with their letters.
DURATIONS = {
    "50m": {"minutes": 50},
    "1h30m": {"hours": 1, "minutes": 30},
    "12s": {"seconds": 12},
    "0s": {},
    "90": {"minutes": 90},
    "90:05": {"minutes": 90, "seconds": 5},
    "01:00:00": {"hours": 1},
    "48:00:30": {"hours": 48, "seconds": 30},
    "2-0": {"days": 2},
    "1-12:30": {"days": 1, "hours": 12, "minutes": 30},
    "7-00:00:01": {"days": 7, "seconds": 1},
}
NO_DURATIONS = ["", "m", "1.5", "1m30", "1h:30", "1-", "-5", "1:60", "1:60:00", "1-24", "1:2:3:4"]
NO_DURATIONS += ["0", "00:00:00", "UNLIMITED", "1:2:3-4", "x" * 5000]


def test_durations_have_letters_or_the_forms_of_slurm(plan, capsys):
    for text, expected in DURATIONS.items():
        assert parse_duration(text) == datetime.timedelta(**expected).total_seconds(), text
    for text in NO_DURATIONS:
        with pytest.raises(SystemExit):
            main(["work", str(plan), f"--for={text}"])
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1
        assert "such as 50m or 1h30m, or a time limit of SLURM, not 0: MINUTES, " in error


def test_a_job_has_time_beside_its_start_and_end(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["plan", *LINE, "--out", str(tmp_path / "plan"), "--slurm", "--time", "2m"])
    assert "--time: must be longer than the 2 minutes in which a job" in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()


def test_slurm_script(tmp_path, capsys):
    line = ["--out", str(tmp_path / "my plan"), "--tasks", "8", "--slurm", "--time", "01:30:00"]
    assert main(["plan", *LINE, *line]) == 0
    script, said = capsys.readouterr()
    for words in ("--array=0-7", "--signal=TERM@", "--requeue", "--time=01:30:00", "--for 88m"):
        assert words in script
    # Commands and options that are to be copied have paths as a shell reads them.
    (log,) = (text for text in script.split("\n") if text.startswith("#SBATCH --output"))
    assert shlex.split(log, comments=False)[1:] == [f"--output={tmp_path / 'my plan'}-%A_%a.log"]
    assert f"each: {shlex.join(['netkf', 'work', str(tmp_path / 'my plan')])};" in said
    assert main(["merge", str(tmp_path / "my plan")]) == 1
    assert f"go on with netkf work '{tmp_path / 'my plan'}', or" in capsys.readouterr().out
    shell = shutil.which("bash")
    # sbatch --array=0-1 submits two of the eight again.
    srun, job = 'srun() { printf "%s\\n" "$@"; }\n', {**os.environ, "SLURM_ARRAY_TASK_ID": "1"}
    piped = {"input": srun + script, "text": True, "capture_output": True}
    done = subprocess.run([shell], check=False, env=job, **piped)
    assert done.stdout.split("\n")[:3] == ["netkf", "work", str(tmp_path / "my plan")]
    assert done.stdout.endswith("--part\n1/8\n")
    assert (done.returncode, done.stderr) == (0, "")


def test_commands_that_a_plan_of_own_classes_names_trust_them(tmp_path, monkeypatch, capsys):
    source = "from netkf.parts import Hybrid\n\n\nclass Own(Hybrid):\n    pass\n"
    (tmp_path / "own.py").write_text(source)
    shutil.copy(RING, tmp_path)
    monkeypatch.chdir(tmp_path)
    line = ["plan", "poisson_ring.toml", "--trust", "--set", 'filter.kind="own:Own"', "--runs", "2"]
    assert main([*line, "--set", "horizon=1.0", "--out", "plan"]) == 0
    each, end = re.search(
        r"each: netkf (.*); in the end: netkf (.*)\n", capsys.readouterr().out
    ).groups()
    assert main(shlex.split(end)) == 1
    assert f"go on with netkf {each}, or" in capsys.readouterr().out
    assert main(shlex.split(each)) == 0
    assert main([*shlex.split(end), "--no-plot"]) == 0


def test_no_plan_is_made_of_what_could_not_run(tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        main(
            [
                "plan",
                RING,
                "--runs",
                "4",
                "--engine",
                "compiled",
                "--set",
                "filter.kind=none",
                "--out",
                str(out),
            ]
        )
        == 2
    )
    assert not out.exists()


COMMAND = [sys.executable, "-c", "import sys, netkf.cli.main; sys.exit(netkf.cli.main.main())"]
QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


@pytest.mark.slow
def test_64_workers_killed_at_random_and_repeated(tmp_path):
    """As SLURM does it: in any order, several at a time, killed, terminated and requeued."""
    draw, out = random.Random(1), tmp_path / "plan"
    line = [RING, "--set", "horizon=4.0", "--runs", "1000"]
    assert main(["plan", *line, "--out", str(out), "--tasks", "64"]) == 0
    assert main(["work", str(out), "--part", "0/64"]) == 0  # its kernels are on disk then
    began = time.monotonic()
    subprocess.run([*COMMAND, "work", str(out), "--part", "1/64"], check=True, **QUIET)
    job = time.monotonic() - began
    # For each part the moments, in seconds after its start, at which its jobs are stopped, most of
    # them before their end: four run at a time. Each ends in the end, however slow the machine is.
    kills = {part: [draw.uniform(0.0, job) for _ in range(draw.randrange(3))] for part in range(64)}
    queue, running, ended = [*range(64)], {}, {signal.SIGKILL: 0, signal.SIGTERM: 0}
    draw.shuffle(queue)
    while queue or running:
        while queue and len(running) < 4:
            part = queue.pop()
            names = {"ID": part, "MIN": 0, "MAX": 63, "COUNT": 64}
            array = {f"SLURM_ARRAY_TASK_{name}": str(value) for name, value in names.items()}
            process = subprocess.Popen(
                [*COMMAND, "work", str(out)], env={**os.environ, **array}, **QUIET
            )
            running[part] = process, time.monotonic()
        time.sleep(0.05)
        for part, (process, began) in list(running.items()):
            if process.poll() is not None:
                del running[part]
                # Requeued, now and then without need.
                if process.returncode != 0 or draw.random() < 0.1:
                    queue.insert(0, part)
            elif kills[part] and time.monotonic() - began > kills[part][-1]:
                kills[part].pop()
                how = draw.choice(list(ended))
                process.send_signal(how)
                ended[how] += 1
                stopped = time.monotonic()
                process.wait(30)
                assert time.monotonic() - stopped < 10.0, f"{how!r} of part {part}"
    assert min(ended.values()) > 5, f"too few jobs were stopped: {ended}"
    assert merge(out) == 0
    one = ["--workers", "1", "--no-plot", "--out", str(tmp_path / "one")]
    assert main(["run", *line, *one]) == 0
    assert files(out) == files(tmp_path / "one")


@pytest.mark.slow
def test_a_long_compiled_run_is_dropped_in_time(tmp_path):
    """Its block has no file, and no half of one; tests/test_process.py has the short twin."""
    out = tmp_path / "plan"
    line = [RING, "--set", "horizon=4000000.0", "--set", "probe=[0.0]", "--runs", "2"]
    assert main(["plan", *line, "--out", str(out)]) == 0
    with subprocess.Popen([*COMMAND, "work", str(out)], **QUIET) as process:
        time.sleep(20.0)
        process.send_signal(signal.SIGTERM)
        began = time.monotonic()
        assert process.wait(30) == 130
        assert time.monotonic() - began < 10.0
    assert {file.name for file in out.rglob("*")} <= {"scenario.toml", "manifest.json", "blocks"}
