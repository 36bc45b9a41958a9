"""Worker processes: one that dies at any moment is replaced, an interrupt waits for none."""

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import netkf
from netkf.ensembles.blocks import Job, pack_scenario
from netkf.ensembles.pools import PoolOptions, ProcessPool
from netkf.ensembles.replicas import replicate
from tests.conftest import SCENARIOS

LARGE = 1 << 26
"""Bytes that no pipe takes at once."""


def dies_while_it_writes(scenario, seed, replicas):
    """The first worker is killed in the middle of its result."""
    mark = Path(scenario.claim)
    if not mark.exists():
        mark.touch()
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return b"x" * LARGE


def test_a_worker_killed_while_it_writes_is_replaced(ring, tmp_path):
    mark = tmp_path / "mark"
    pool = ProcessPool(1)
    future = pool.submit(
        Job(ring.replace({"claim": str(mark)}), dies_while_it_writes, 1, 0, 0, 1, 1)
    )
    while not mark.exists():
        time.sleep(0.01)
    time.sleep(0.6)  # nobody reads meanwhile: the worker dies with most of its result unwritten
    assert pool.wait([future]) == [future]
    assert len(future.result().value) == LARGE
    pool.close(at_once=False)


def sleeps(scenario, seed, replica):
    Path(scenario.claim, str(replica)).touch()
    time.sleep(60.0)


def test_workers_are_killed_at_once(ring, tmp_path):
    began, killed = time.monotonic(), []

    def interrupt():
        while len(list(tmp_path.iterdir())) < 2 and time.monotonic() - began < 30.0:
            time.sleep(0.01)
        killed.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        replicate(sleeps, ring.replace({"claim": str(tmp_path)}), 2, pool=PoolOptions(2))
    assert len(list(tmp_path.iterdir())) == 2
    assert time.monotonic() - killed[0] < 10.0


class TwoArgumentsError(Exception):
    """One that pickles and cannot be read back."""

    def __init__(self, one, two):
        super().__init__(one)


ERRORS = {"plain": OSError(2, "gone"), "odd": TwoArgumentsError("a", "b")}


def fails(scenario, seed, replica):
    raise ERRORS[scenario.claim]


@pytest.mark.parametrize(
    ("claim", "kind"), [("plain", FileNotFoundError), ("odd", netkf.EngineError)]
)
def test_what_a_task_raises_comes_with_its_traceback(ring, claim, kind):
    with pytest.raises(kind) as failed:
        replicate(fails, ring.replace({"claim": claim}), 2, pool=PoolOptions(2))
    assert "in fails" in str(failed.value.__cause__)


COMMAND = [sys.executable, "-m", "netkf"]
# More runs than the command can finish, however late the test sees its first block.
RING = str(SCENARIOS / "poisson_ring.toml")
RUN = ["run", RING, "--runs", "9999", "--trace", "full", "--no-plot"]


@pytest.mark.parametrize(
    ("number", "group"),
    [
        pytest.param(signal.SIGTERM, False, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, True, marks=pytest.mark.slow),
        (signal.SIGINT, True),
    ],
)
def test_an_interrupted_command_ends(tmp_path, number, group):
    """Ctrl-C reaches all processes of a terminal, and what ends a job those of the job."""
    command = [*COMMAND, *RUN, "--workers", "2", "--out", str(tmp_path / "out")]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, cwd=Path.cwd()
    )
    while not list((tmp_path / "out").glob("blocks/*.npz")) and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.3)
    (os.killpg if group else os.kill)(process.pid, number)
    _, printed = process.communicate(timeout=10)
    assert process.returncode == 130
    (line,) = (line for line in printed.splitlines() if "netkf: compiling " not in line)
    assert line.startswith("netkf: interrupted; what was finished is kept")
    began = time.monotonic()
    while group_exists(process.pid):
        assert time.monotonic() - began < 5.0
        time.sleep(0.05)


def group_exists(number):
    try:
        os.killpg(number, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("module", ["own_losses", "own_losses.inner"])
def test_workers_find_packages_in_the_folder_above_the_outermost(
    ring, module, tmp_path, monkeypatch
):
    package = tmp_path / "own_losses"
    package.mkdir()
    text = "import netkf.parts\n\nclass Mine(netkf.parts.Bernoulli):\n    pass\n"
    for name in ("__init__.py", "inner.py"):
        (package / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    mine = importlib.import_module(module).Mine(delivery=0.5)
    packed = pack_scenario(ring.replace({"network.channel.loss": mine}))
    assert packed.modules == ((module, str(tmp_path)),)
    for name in ("own_losses", "own_losses.inner"):
        sys.modules.pop(name, None)
