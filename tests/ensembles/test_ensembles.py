"""Ensembles: the same bits wherever and however the runs are done, and the right moments."""

import dataclasses
import itertools
import json
import os
import queue
import random
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor

import numpy as np
import pandas as pd
import pytest

import netkf
from netkf.cli.main import main
from netkf.engines.simpy.engine import SimpyEngine
from netkf.ensembles import pools
from netkf.ensembles.directory import EnsembleOptions, runs_to_directory
from netkf.ensembles.merge_tree import MergeTree, aligned_pieces
from netkf.ensembles.moments import merge_moments, moments_of
from netkf.ensembles.pools import PoolOptions
from netkf.ensembles.replicas import replicate
from tests.conftest import SAVING, SCENARIOS

FIELDS = (
    "runs mean_P se_P mean_error se_error mean_nees se_nees average se_average".split()  # noqa: SIM905
)


@pytest.fixture
def short(ring):
    return ring.replace({"horizon": 1.0})


def assert_same_bits(one, other):
    for name in FIELDS:
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes(), name
    assert (one.messages, one.fingerprint) == (other.messages, other.fingerprint)


def test_times_of_an_ensemble_are_its_own(short, tmp_path):
    ensemble = netkf.monte_carlo(short, 2)
    runs_to_directory(short, 2, tmp_path / "out", EnsembleOptions())
    for found in (ensemble, netkf.open(tmp_path / "out")):
        found.times[:] /= 60.0
        assert found.scenario.times[-1] == 1.0


class Backwards(Executor):
    """Does what it got last first, and does not tell its number of workers."""

    def __init__(self):
        self.waiting = queue.LifoQueue()
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def submit(self, function, /, *arguments):
        future = Future()
        self.waiting.put((id(future), future, function, arguments))
        return future

    def serve(self):
        while (got := self.waiting.get()) is not None:
            time.sleep(0.002)  # others come meanwhile
            got[1].set_result(got[2](*got[3]))

    def shutdown(self, wait=True, *, cancel_futures=False):
        self.waiting.put(None)
        self.thread.join()


def test_bits_do_not_depend_on_who_does_what_and_when(short):
    alone = netkf.monte_carlo(short, 12, workers=1)
    with Backwards() as backwards:
        assert_same_bits(netkf.monte_carlo(short, 12, workers=3, executor=backwards), alone)
    with ThreadPoolExecutor(2) as threads:
        assert_same_bits(netkf.monte_carlo(short, 12, executor=threads), alone)
    for workers in (2, 3):
        assert_same_bits(netkf.monte_carlo(short, 12, workers=workers), alone)
    assert alone.fingerprint == netkf.simulate(short).fingerprint


def test_an_executor_that_does_not_tell_its_workers_gets_as_many_blocks_as_it_has():
    class Counts(Executor):
        """Knows neither its number of workers nor its work."""

        submitted = 0

        def submit(self, function, /, *arguments):
            self.submitted += 1
            future = Future()
            if self.submitted == 2000:  # two blocks for each of them, before any has a result
                future.set_exception(RuntimeError("enough"))
            return future

    counts, scenario = Counts(), netkf.load(SCENARIOS / "poisson_ring.toml", {"horizon": 1.0})
    with pytest.raises(RuntimeError, match="enough"):
        netkf.monte_carlo(scenario, 100_000, workers=1000, executor=counts)
    assert counts.submitted == 2000


def test_an_executor_that_is_shut_down_meanwhile_is_told_in_one_line(short):
    class Ends(Executor):
        """Is shut down by another thread: its futures are cancelled, and nobody hears of it."""

        def submit(self, function, /, *arguments):
            future = Future()
            threading.Timer(0.05, future.cancel).start()
            return future

    with pytest.raises(netkf.EngineError, match="the executor was shut down before"):
        netkf.monte_carlo(short, 12, executor=Ends())


def test_moments_are_those_of_the_stored_runs(short):
    ensemble = netkf.monte_carlo(short, 7, workers=1)
    runs = [netkf.simulate(short, replica=k) for k in range(7)]
    P = np.array([run.P for run in runs])
    e = np.array([run.x[:, None] - run.xhat for run in runs])
    E = e[..., :, None] * e[..., None, :]
    nees = np.array([run.states.nees.to_numpy().reshape(run.P.shape[:2]) for run in runs])
    for mean, error, values in (
        (ensemble.mean_P, ensemble.se_P, P),
        (ensemble.mean_error, ensemble.se_error, E),
        (ensemble.mean_nees, ensemble.se_nees, nees),
    ):
        np.testing.assert_allclose(mean, values.mean(axis=0), rtol=1e-12, atol=1e-13)
        spread = values.std(axis=0, ddof=1) / np.sqrt(7)
        np.testing.assert_allclose(error, spread, rtol=1e-9, atol=1e-12)
    square = (e**2).sum(axis=-1)[:, 1:].mean(axis=1)
    np.testing.assert_allclose(ensemble.average[:-1, 0], square.mean(axis=0), rtol=1e-12)
    overall = square.mean(axis=1)
    assert ensemble.se_average[-1, 0] == pytest.approx(overall.std(ddof=1) / np.sqrt(7))
    assert ensemble.messages["sent"] == sum(run.count("send") for run in runs)
    assert ensemble.messages["lost"] == sum(run.count("lost") for run in runs)
    assert (ensemble.runs == 7).all()
    table = ensemble.table
    assert table.P01_se[5] == ensemble.se_P.reshape(-1, 2, 2)[5, 0, 1]
    assert table.E11.to_numpy().tobytes() == ensemble.mean_error[..., 1, 1].tobytes()


def test_a_million_values_lose_no_digits():
    """1e9 + k / 1024, where a sum of squares would have no digit left: the tree over 2^20 values
    that repeat after 2^10 has equal halves from there on.
    """
    values = 1e9 + np.arange(1024).reshape(-1, 1, 1) / 1024
    found = moments_of(values, np.ones((1024, 1)))
    for _ in range(10):
        found = merge_moments(found, found)
    assert found.size[0] == 2**20
    assert found.mean[0, 0] == 1e9 + 1023 / 2048
    assert found.M2[0, 0] == pytest.approx(2**20 * (1024**2 - 1) / 12 / 1024**2, rel=1e-13)


def joined(a, b):
    """Words that show the shape of the tree."""
    return f"({a}{b})"


def tree_of(first, stop):
    """The tree over replicas, replica after replica."""
    tree = MergeTree(joined)
    for k in range(first, stop):
        tree.add(k, str(k))
    return tree.result()


@pytest.mark.parametrize("runs", [1, 2, 5, 13, 16])
@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_blocks_in_any_order_are_one_tree(runs, level):
    size = 1 << level
    for seed in range(3):
        blocks = [*range(-(-runs // size))]
        random.Random(seed).shuffle(blocks)
        tree = MergeTree(joined)
        for k in blocks:
            tree.add(k, tree_of(k * size, min((k + 1) * size, runs)), level)
        assert tree.result() == tree_of(0, runs)


@pytest.mark.parametrize("cuts", [[0, 13], [0, 1, 13], [0, 5, 6, 11, 13], [0, 3, 8, 13]])
def test_pieces_of_any_batches_are_one_tree(cuts):
    tree = MergeTree(joined)
    for first, stop in itertools.pairwise(cuts):
        for level, k in aligned_pieces(first, stop):
            tree.add(k, tree_of(k << level, (k + 1) << level), level)
    assert tree.result() == tree_of(0, 13)


@pytest.mark.parametrize("count", [2, 3, 7, 8])
def test_moments_of_many_are_those_merged_one_by_one(count):
    """To the last bit, with values that some observations lack."""
    random = np.random.default_rng(count)
    size = (random.random((count, 2)) < 0.7).astype(float)
    values = np.where(size[..., None] > 0.0, random.normal(size=(count, 2, 3)), 0.0)
    tree = MergeTree(merge_moments)
    for k in range(count):
        tree.add(k, moments_of(values[k : k + 1].copy(), size[k : k + 1].copy()))
    for one, other in zip(tree.result(), moments_of(values, size), strict=True):
        np.testing.assert_array_equal(one, other)


def replica_number(scenario, seed, replica):
    return replica, seed, scenario.name


def test_results_that_are_not_merged_come_in_order(short):
    found = replicate(
        replica_number, short, 9, seed=4, pool=PoolOptions(executor=Backwards()), first=5
    )
    assert found == [(5 + k, 4, short.name) for k in range(9)]


def test_a_run_that_diverges_counts_until_then(build):
    plant = {"kind": "diffusion", "A": [[2.0]], "B": [[1.0]], "cov": [[1.0]]}
    scenario = build(horizon=600.0, probe=50.0, plant=plant, filter={"kind": "local"})
    ensemble = netkf.monte_carlo(scenario, 2, workers=1)
    run = netkf.simulate(scenario)
    assert ensemble.diverged == 2
    assert ensemble.runs.tolist() == [2] * (len(run.times) - 1) + [0] * (14 - len(run.times))
    assert np.isfinite(ensemble.mean_P[ensemble.runs == 2]).all()
    assert np.isnan(ensemble.mean_P[ensemble.runs == 0]).all()


def dies_once(scenario, seed, replica):
    """The first worker that comes to replica 3 ends."""
    mark = scenario.claim
    if replica == 3 and not os.path.exists(mark):
        open(mark, "w").close()
        os._exit(1)
    return replica


def dies(scenario, seed, replica):
    os._exit(1)


def test_a_worker_that_dies_is_replaced_and_its_runs_are_done_once(short, tmp_path):
    scenario = short.replace({"claim": str(tmp_path / "mark")})
    assert replicate(dies_once, scenario, 8, pool=PoolOptions(2)) == list(range(8))
    assert (tmp_path / "mark").exists()


@pytest.mark.slow
def test_workers_that_die_again_and_again_end_in_one_line(short):
    with pytest.raises(netkf.EngineError, match="workers ended again and again"):
        replicate(dies, short, 2, pool=PoolOptions(2))


SCRIPT = """
import netkf
scenario = netkf.load({path!r}).replace({{"horizon": 1.0}})
print("begun")
print(netkf.monte_carlo(scenario, 4, workers=2).fingerprint)
"""


def test_a_script_without_a_main_guard_runs_once(short, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(path=str(SCENARIOS / "poisson_ring.toml")))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["begun", netkf.simulate(short).fingerprint]


WORKER = """
def facts(scenario, seed, replica):
    import os, sys
    threads = {os.environ.get(name) for name in ("OMP_NUM_THREADS", "BLIS_NUM_THREADS")}
    return "matplotlib" in sys.modules, "pandas" in sys.modules, threads
"""


def test_workers_know_no_pictures_and_have_one_blas_thread(short, tmp_path, monkeypatch):
    (tmp_path / "facts_of_workers.py").write_text(WORKER)
    monkeypatch.syspath_prepend(tmp_path)
    import facts_of_workers

    found = replicate(facts_of_workers.facts, short, 2, pool=PoolOptions(2))
    # The tests set the first of the two themselves.
    assert found == [(False, False, {"1"})] * 2


FAILING = """
from netkf.algorithms.hybrid import Hybrid


class Bad(Hybrid):
    def absorb(self, state, messages, exchange):
        return 1 / 0


class Fine(Hybrid):
    def absorb(self, state, messages, exchange):
        return super().absorb(state, messages, exchange)
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_a_users_class_travels_and_its_failure_is_one_line(tmp_path, workers):
    (tmp_path / f"filters_{workers}.py").write_text(FAILING)
    text = (SCENARIOS / "poisson_ring.toml").read_text().replace("20.0", "1.0")
    for name in ("Bad", "Fine"):
        kind = f'"filters_{workers}:{name}"'
        (tmp_path / f"{name}.toml").write_text(text.replace('"hybrid"', kind))
    words = rf"filters_{workers}:Bad failed in absorb: ZeroDivisionError"
    with pytest.raises(netkf.EngineError, match=words):
        netkf.monte_carlo(netkf.load(tmp_path / "Bad.toml"), 2, workers=workers)
    fine = netkf.monte_carlo(netkf.load(tmp_path / "Fine.toml"), 2, workers=workers)
    plain = netkf.load(SCENARIOS / "poisson_ring.toml").replace({"horizon": 1.0})
    assert_same_bits(fine, netkf.monte_carlo(plain, 2, workers=1, engine=SimpyEngine()))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"runs": 0}, "runs: must be an integer of at least 1; got 0"),
        ({"runs": 2, "workers": 0}, "workers: must be an integer of at least 1; got 0"),
        ({"runs": 2, "seed": -1}, "seed: must be an integer of at least 0; got -1"),
        (
            {"runs": 2, "workers": 2, "scheduler": "tcp://127.0.0.1:1"},
            "workers: cannot go together with scheduler; got 2",
        ),
        ({"runs": 2, "executor": "mine"}, "executor: must be a concurrent.futures.Executor"),
        ({"runs": 2, "executor": Executor}, "executor: must be a concurrent.futures.Executor"),
        ({"runs": 2, "executor": Executor(), "workers": 0}, "workers: must be an integer of"),
    ],
)
def test_what_cannot_be_is_refused(short, arguments, words):
    with pytest.raises(netkf.ScenarioError, match=words):
        netkf.monte_carlo(short, **arguments)


def files(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def run(tmp_path, name, *arguments):
    ring = str(SCENARIOS / "poisson_ring.toml")
    out = ["--out", str(tmp_path / name), "--set", "horizon=1.0", "--no-plot"]
    return main(["run", ring, *out, "--workers", "1", *arguments])


def test_a_directory_of_many_runs(tmp_path, short, capsys):
    assert run(tmp_path, "full", "--runs", "5", "--trace", "full") == 0
    assert run(tmp_path, "first", "--runs", "5") == 0
    printed = capsys.readouterr()
    assert "averages over 5 runs" in printed.out
    assert printed.err == ""
    full, first = tmp_path / "full", tmp_path / "first"
    states, events = (pd.read_parquet(full / f"{n}.parquet") for n in ("states", "events"))
    for k in range(5):
        mine = netkf.simulate(short, replica=k)
        again = states[states.run == k].reset_index(drop=True)
        pd.testing.assert_frame_equal(again, mine.states)
        assert netkf.first_difference(events[events.run == k], mine) is None
    assert set(pd.read_parquet(first / "states.parquet").run) == {0}
    ensemble = netkf.monte_carlo(short, 5, workers=1)
    pd.testing.assert_frame_equal(pd.read_parquet(full / "ensemble.parquet"), ensemble.table)
    manifest = json.loads((full / "manifest.json").read_text())
    assert manifest["runs"] == {"wanted": 5, "done": 5}
    assert (manifest["status"], manifest["fingerprint"]) == ("complete", ensemble.fingerprint)
    summary = json.loads((full / "summary.json").read_text())
    after = states[states.t > 0.0]
    assert summary["overall"]["rms_error"] == pytest.approx(np.sqrt(after.sq_error.mean()))
    assert summary["overall"]["mean_trace"] == pytest.approx((after.P00 + after.P11).mean())
    bound = np.trace(netkf.theory.covariance_bound(short, short.times)[1:], axis1=2, axis2=3)
    assert summary["overall"]["bound"] == pytest.approx(bound.mean())
    assert summary["messages"]["sent"] == pytest.approx((events.kind == "send").sum() / 5)
    assert not (full / "blocks").exists()


@pytest.mark.parametrize("trace", ["full", "none"])
def test_a_stopped_ensemble_goes_on_where_it_was(short, tmp_path, trace, capsys):
    def stop(done, wanted):
        if done >= 7:
            raise KeyboardInterrupt

    options = EnsembleOptions(trace=trace, pool=PoolOptions(1))
    again = dataclasses.replace(options, resume=True)
    runs_to_directory(short, 18, tmp_path / "whole", options)
    with pytest.raises(KeyboardInterrupt, match="go on with --resume"):
        runs_to_directory(short, 18, tmp_path / "cut", options, progress=stop)
    manifest = json.loads((tmp_path / "cut" / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    assert 7 <= manifest["runs"]["done"] < 18
    done = runs_to_directory(short, 18, tmp_path / "cut", again)
    assert done.simulated == 18 - manifest["runs"]["done"]
    assert files(tmp_path / "cut") == files(tmp_path / "whole")
    assert runs_to_directory(short, 18, tmp_path / "cut", again) is None


def test_what_cannot_be_resumed_is_refused(tmp_path, capsys):
    assert run(tmp_path, "out", "--runs", "4") == 0
    assert run(tmp_path, "out", "--runs", "4", "--resume") == 0
    assert "nothing left to do" in capsys.readouterr().out
    for arguments, words in (
        (["--runs", "4", "--resume", "--seed", "9"], "holds a run of another scenario"),
        (["--runs", "5", "--resume"], "begun with another number of runs"),
        (["--runs", "4", "--resume", "--trace", "none"], "holds a run of another trace"),
        (["--runs", "4"], "must be a new or empty directory"),
        (["--resume"], "begun with several runs"),
    ):
        assert run(tmp_path, "out", *arguments) == 2
        error = capsys.readouterr().err
        assert words in error
        assert len(error.splitlines()) == 1
    ring = str(SCENARIOS / "poisson_ring.toml")
    assert main(["run", ring, "--runs", "4", "--resume"]) == 2
    assert "needs the directory" in capsys.readouterr().err
    assert main(["run", ring, "--scheduler", "tcp://x:1"]) == 2
    assert "add --runs R" in capsys.readouterr().err


def test_a_single_run_that_was_killed_is_done_again(tmp_path, capsys):
    assert run(tmp_path, "whole") == 0
    assert run(tmp_path, "cut") == 0
    manifest = tmp_path / "cut" / "manifest.json"
    manifest.write_text(manifest.read_text().replace("complete", "interrupted"))
    (tmp_path / "cut" / "states.parquet").unlink()
    (tmp_path / "cut" / "notes.txt").touch()
    kept = files(tmp_path / "cut")
    assert run(tmp_path, "cut", "--resume") == 2
    assert "notes.txt'; move it away" in capsys.readouterr().err
    assert files(tmp_path / "cut") == kept  # a refusal removes nothing
    (tmp_path / "cut" / "notes.txt").unlink()
    assert run(tmp_path, "cut", "--resume") == 0
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


class NoProcesses:
    def __init__(self, workers):
        raise AssertionError(f"{workers} processes were started")


def test_processes_start_only_where_they_are_worth_it(ring, monkeypatch):
    monkeypatch.setattr(pools, "ProcessPool", NoProcesses)
    monkeypatch.setattr(pools, "cores", lambda: 2)
    monkeypatch.setattr(pools, "SAVING", SAVING)
    short = ring.replace({"horizon": 2.0})
    # More than the first block.
    here = netkf.monte_carlo(short, 2600)
    assert here.runs.max() == 2600
    with pytest.raises(AssertionError, match="2 processes were started"):
        netkf.monte_carlo(short, 2600, workers=2)
    for name in ("WARM", "SAVING"):
        monkeypatch.setattr(pools, name, 0.0)
    with pytest.raises(AssertionError, match="2 processes were started"):
        netkf.monte_carlo(short, 2600)


@pytest.mark.slow
def test_bits_do_not_depend_on_when_processes_start(short, monkeypatch):
    """After so many blocks in this process."""
    alone = netkf.monte_carlo(short, 2600, workers=1)
    monkeypatch.setattr(pools, "cores", lambda: 2)
    for done in (0, 1, 3):
        blocks = []

        def worth_processes(*_, done=done, blocks=blocks):
            blocks.append(0)
            return len(blocks) > done

        monkeypatch.setattr(pools.AdaptivePool, "_worth_processes", worth_processes)
        assert_same_bits(netkf.monte_carlo(short, 2600), alone)
        assert len(blocks) == done + 1


def begin(out, *arguments):
    ring = str(SCENARIOS / "poisson_ring.toml")
    command = [sys.executable, "-c", "import sys, netkf.cli.main; sys.exit(netkf.cli.main.main())"]
    line = ["run", ring, "--set", "horizon=4.0", "--out", str(out), "--no-plot", *arguments]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen([*command, *line], **quiet)


def kill_until_done(out, times, longest, *arguments):
    """Kill a run at random moments of its life that many times, then let it end."""
    moments = random.Random(1)
    for _ in range(times):
        with begin(out, *arguments) as process:
            started = time.monotonic()
            while not (out / "manifest.json").exists() and process.poll() is None:
                time.sleep(0.01)
                assert time.monotonic() - started < 60.0
            time.sleep(moments.uniform(0.0, longest))
            process.send_signal(signal.SIGKILL)
    with begin(out, *arguments) as process:
        assert process.wait(120) == 0


def test_kills_lose_nothing_and_count_nothing_twice(tmp_path):
    arguments = ["--runs", "24", "--trace", "full", "--resume", "--workers", "1"]
    kill_until_done(tmp_path / "cut", 3, 1.0, *arguments)
    with begin(tmp_path / "whole", *arguments) as process:
        assert process.wait(120) == 0
    assert files(tmp_path / "cut") == files(tmp_path / "whole")


@pytest.mark.slow
def test_many_kills_with_workers(tmp_path):
    arguments = ["--runs", "200", "--trace", "full", "--resume", "--workers", "2"]
    kill_until_done(tmp_path / "cut", 30, 3.0, *arguments)
    with begin(tmp_path / "whole", *arguments) as process:
        assert process.wait(300) == 0
    assert files(tmp_path / "cut") == files(tmp_path / "whole")
