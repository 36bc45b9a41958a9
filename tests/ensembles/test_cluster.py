"""An ensemble on a real Dask scheduler with worker processes on loopback."""

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time

import pytest

import netkf
from netkf.cli.main import main
from netkf.core.errors import EngineError
from netkf.ensembles import plans, pools
from netkf.ensembles.parts import Part
from netkf.ensembles.pools import DaskPool, PoolOptions
from tests.conftest import SCENARIOS
from tests.ensembles.test_ensembles import assert_same_bits

pytest.importorskip("distributed")

RING = str(SCENARIOS / "poisson_ring.toml")


def begin(stack, module, *arguments):
    command = [sys.executable, "-m", f"distributed.cli.{module}", *arguments, "--no-dashboard"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = stack.enter_context(subprocess.Popen(command, **quiet))
    stack.callback(process.kill)
    return process


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """The address of a scheduler, two worker processes, and the scheduler itself: for tests that
    leave a worker, in their order, and last for that which kills the scheduler.
    """
    tmp_path = tmp_path_factory.mktemp("cluster")
    file = tmp_path / "scheduler.json"
    with contextlib.ExitStack() as stack:
        local = ["--host", "127.0.0.1", "--port", "0"]
        scheduler = begin(stack, "dask_scheduler", *local, "--scheduler-file", str(file))
        started = time.monotonic()
        while not file.exists() or not file.read_text():
            assert time.monotonic() - started < 60.0
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        one = ["--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path)]
        workers = [begin(stack, "dask_worker", address, *one) for _ in range(2)]
        yield address, workers, scheduler


def test_workers_with_other_versions_are_refused_in_one_line(ring, cluster, monkeypatch):
    short = ring.replace({"horizon": 1.0})
    here = {**pools.versions(), "numpy": "0.1"}
    monkeypatch.setattr(pools, "versions", lambda: here)
    with pytest.raises(EngineError, match=r"numpy [\d.]+ instead of 0\.1; install") as refused:
        netkf.monte_carlo(short, 4, scheduler=cluster[0])
    assert str(refused.value).isprintable()


def test_a_cluster_that_loses_a_worker_gives_the_same_bits(ring, cluster):
    short = ring.replace({"horizon": 2.0})
    address, workers, _ = cluster
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


def silent(connection):
    threading.Event().wait(60.0)


def closes(connection):
    connection.close()


def is_a_web_server(connection):
    connection.recv(100)
    connection.sendall(b"HTTP/1.1 400 Bad Request\r\nContent-Length: 0\r\n\r\n")


def sends_noise(connection):
    with contextlib.suppress(OSError):
        while True:
            connection.sendall(b"\0" * 8192)


@pytest.fixture
def listen():
    """Start a server that treats every connection in the same way."""
    with contextlib.ExitStack() as stack:

        def begin(treat):
            server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))

            def accept():
                with contextlib.suppress(OSError):
                    while True:
                        connection, _ = server.accept()
                        threading.Thread(target=treat, args=(connection,), daemon=True).start()

            threading.Thread(target=accept, daemon=True).start()
            return f"tcp://127.0.0.1:{server.getsockname()[1]}"

        yield begin


@pytest.mark.one_in(2)
@pytest.mark.parametrize("treat", [silent, closes, is_a_web_server, sends_noise])
def test_what_is_no_scheduler_is_told_in_one_line(ring, monkeypatch, listen, treat):
    monkeypatch.setattr("netkf.ensembles.pools.PATIENCE", 2)
    address, began = listen(treat), time.monotonic()
    before = threading.active_count()
    with pytest.raises(netkf.ScenarioError, match="no Dask scheduler answers there"):
        DaskPool(address)
    assert time.monotonic() - began < 8.0
    others = {"silent", "closes", "is_a_web_server", "sends_noise"}
    mine = [one for one in threading.enumerate() if not any(o in one.name for o in others)]
    assert len(mine) <= before


@pytest.mark.parametrize(
    "address", ["", "a b", "tcp://\x1b[31m:1", "x" * 5000, None, 3, "tcp://\0"]
)
def test_what_is_no_address_is_refused_at_once(ring, address):
    with pytest.raises(netkf.ScenarioError, match="must be an address") as error:
        DaskPool(address)
    assert str(error.value).isprintable()


def test_a_plan_of_a_study_is_worked_on_there(cluster, tmp_path, capsys):
    study = ["sweep", RING, "--vary", "filter.epsilon=0.2,0.5", "--runs", "5", "--no-plot"]
    study += ["--set", "horizon=1.0"]
    assert main([*study, "--plan", str(tmp_path / "plan"), "--out", str(tmp_path / "there")]) == 0
    assert main(["work", str(tmp_path / "plan"), "--scheduler", cluster[0]]) == 0
    assert "all of" in capsys.readouterr().out
    assert main(["merge", str(tmp_path / "plan")]) == 0
    assert main([*study, "--workers", "1", "--out", str(tmp_path / "here")]) == 0
    there, here = (tmp_path / name / "sweep.csv" for name in ("there", "here"))
    assert there.read_bytes() == here.read_bytes()


def test_a_scheduler_that_dies_is_told_in_one_line_and_a_plan_outlives_it(cluster, tmp_path):
    address, _, scheduler = cluster
    scenario, runs = netkf.load(RING, {"horizon": 1.0}), 400
    folder = plans.plan_ensemble(scenario, runs, tmp_path / "plan")
    plan, all_runs = plans.open_plan(folder), Part(0, 1)

    def kill(done, wanted):
        if done >= 16:
            scheduler.kill()

    with pytest.raises(netkf.EngineError, match="does not answer any more"):
        plans.work_on_plan(plan, all_runs, pool=PoolOptions(scheduler=address), progress=kill)
    done = plans.work_on_plan(plan, all_runs)
    # What it had sent is kept.
    assert 0 < done.simulated < runs
    merged = plans.merge_plan(plan)
    assert_same_bits(merged.ensemble, netkf.monte_carlo(scenario, runs, workers=1))


@pytest.mark.slow
def test_the_extra_is_named_where_distributed_is_missing(ring, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(netkf.EngineError, match=r"pip install 'netkf\[cluster\]'"):
        netkf.monte_carlo(ring, 2, scheduler="tcp://127.0.0.1:9")
