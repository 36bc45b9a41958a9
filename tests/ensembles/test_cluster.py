"""An ensemble on a real Dask scheduler with worker processes on loopback."""

import contextlib
import json
import subprocess
import sys
import time

import pytest

import netkf
from tests.ensembles.test_ensembles import assert_same_bits

pytest.importorskip("distributed")


def begin(stack, module, *arguments):
    command = [sys.executable, "-m", f"distributed.cli.{module}", *arguments, "--no-dashboard"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = stack.enter_context(subprocess.Popen(command, **quiet))
    stack.callback(process.kill)
    return process


@pytest.fixture
def cluster(tmp_path):
    """The address of a scheduler, and two worker processes."""
    file = tmp_path / "scheduler.json"
    with contextlib.ExitStack() as stack:
        local = ["--host", "127.0.0.1", "--port", "0"]
        begin(stack, "dask_scheduler", *local, "--scheduler-file", str(file))
        started = time.monotonic()
        while not file.exists() or not file.read_text():
            assert time.monotonic() - started < 60.0
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        one = ["--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path)]
        yield address, [begin(stack, "dask_worker", address, *one) for _ in range(2)]


def test_a_cluster_that_loses_a_worker_gives_the_same_bits(ring, cluster):
    short = ring.replace({"horizon": 2.0})
    address, workers = cluster
    killed = []

    def kill(done, wanted):
        if done >= 16 and not killed:
            workers[0].kill()
            killed.append(done)

    ensemble = netkf.monte_carlo(short, 60, scheduler=address, progress=kill)
    assert 16 <= killed[0] < 60
    assert workers[1].poll() is None
    assert_same_bits(ensemble, netkf.monte_carlo(short, 60, workers=1))


def test_a_scheduler_that_is_not_there_is_told_in_one_line(ring, monkeypatch):
    monkeypatch.setattr("netkf.ensembles.pools.PATIENCE", 1)
    with pytest.raises(netkf.ScenarioError, match="scheduler: cannot be reached"):
        netkf.monte_carlo(ring, 2, scheduler="tcp://127.0.0.1:9")


def test_the_extra_is_named_where_distributed_is_missing(ring, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(netkf.EngineError, match=r"pip install 'netkf\[cluster\]'"):
        netkf.monte_carlo(ring, 2, scheduler="tcp://127.0.0.1:9")
