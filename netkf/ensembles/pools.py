"""Where blocks are done: this process, processes of our own, any executor, a Dask scheduler."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import suppress
from typing import Any

from netkf.core.errors import EngineError, ScenarioError
from netkf.core.fields import integer
from netkf.engines.base import Engine
from netkf.engines.compiled.engine import CompiledEngine
from netkf.engines.compiled.lots import guessed_seconds
from netkf.ensembles.blocks import Job, block_result, work
from netkf.ensembles.process_start import context, main_hidden, one_blas_thread
from netkf.scenario.scenario import Scenario

AHEAD = 1024
"""Most blocks that are handed out and not yet back."""

STARTING = 0.6
"""Seconds until processes of our own do something."""

PATIENCE = 10
"""Seconds to wait for a scheduler."""


class Pool(ABC):
    """Does blocks. ``width`` is how many at a time, as far as one can know; ``ahead`` is how many
    may be handed out before the first is back.
    """

    width: int = 1
    ahead: int = AHEAD

    @abstractmethod
    def submit(self, job: Job) -> Future[Any]:
        """Hand out a block."""

    def renew(self) -> bool:
        """Replace workers that died; False where that is not ours to do."""
        return False

    def close(self, at_once: bool) -> None:  # noqa: B027 - most have nothing of their own
        """Give back what is ours; ``at_once`` without waiting for blocks that are being done."""


class Here(Pool):
    """In this process, one block at a time, with the scenario and the caches that it has."""

    ahead = 1

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    def submit(self, job: Job) -> Future[Any]:
        """Done before it returns."""
        future: Future[Any] = Future()
        try:
            future.set_result(block_result(self._scenario, job))
        except Exception as error:
            future.set_exception(error)
        return future


class Given(Pool):
    """An executor of the user's, which stays open."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self.width = getattr(executor, "_max_workers", None) or cores()

    def submit(self, job: Job) -> Future[Any]:
        """As the executor does it."""
        return self._executor.submit(work, job)


class Cluster(Pool):
    """The workers of a Dask scheduler, which does the blocks of lost workers again."""

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError:
            words = "a Dask scheduler needs the extra cluster; pip install 'netkf[cluster]'"
            raise EngineError(words) from None
        connect: Any = distributed.Client
        try:
            self._client = connect(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise ScenarioError(
                "scheduler",
                f"cannot be reached ({type(error).__name__})",
                address,
                'start one with "dask scheduler" and give its address, tcp://HOST:PORT',
            ) from None
        self._executor = self._client.get_executor(retries=3)
        self.width = max(1, sum(self._client.nthreads().values()))

    def submit(self, job: Job) -> Future[Any]:
        """As the scheduler places it."""
        future: Future[Any] = self._executor.submit(work, job)
        return future

    def close(self, at_once: bool) -> None:
        """Leave the scheduler."""
        self._executor.shutdown(wait=False)
        self._client.close()


class Processes(Pool):
    """Worker processes of our own, each with one BLAS thread and without the user's script."""

    def __init__(self, workers: int) -> None:
        self.width = workers
        self._renewed = 0
        self._open()

    def _open(self) -> None:
        self._executor = ProcessPoolExecutor(self.width, context(), initializer=_prepare)

    def submit(self, job: Job) -> Future[Any]:
        """Workers are started as they are needed."""
        with one_blas_thread(), main_hidden(b"__main__" not in job.payload):
            return self._executor.submit(work, job)

    def renew(self) -> bool:
        """New processes, three times."""
        self._renewed += 1
        self.close(at_once=True)
        self._open()
        return self._renewed <= 3

    def close(self, at_once: bool) -> None:
        """End the processes."""
        processes = list((getattr(self._executor, "_processes", None) or {}).values())
        self._executor.shutdown(wait=not at_once, cancel_futures=True)
        if at_once:
            for process in processes:
                with suppress(OSError, ValueError):
                    process.kill()


def cores() -> int:
    """Processor cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def make_pool(
    scenario: Scenario,
    blocks: int,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
) -> Pool:
    """The pool that was asked for; by default as many processes of our own as there are cores.

    Raises ScenarioError where two were asked for, or where one is of the wrong kind.
    """
    asked = {"workers": workers, "executor": executor, "scheduler": scheduler}
    given = [name for name, value in asked.items() if value is not None]
    if len(given) > 1:
        words = f"cannot go together with {given[1]}"
        raise ScenarioError(given[0], words, asked[given[0]], "give one of them")
    if executor is not None:
        if not hasattr(executor, "submit"):
            remedy = "give a ThreadPoolExecutor, a ProcessPoolExecutor, or one like them"
            raise ScenarioError(
                "executor", "must be a concurrent.futures.Executor", executor, remedy
            )
        return Given(executor)
    if scheduler is not None:
        return Cluster(scheduler)
    count = cores() if workers is None else integer(low=1)("workers", workers)
    count = min(count, blocks)
    return Here(scenario) if count == 1 else Processes(count)


def workers_for(
    scenario: Scenario,
    runs: int,
    engine: Engine,
    workers: int | None,
    executor: Executor | None,
    scheduler: str | None,
) -> int | None:
    """``workers``; 1 where nothing was asked for and all is done here before processes, once they
    have started, would have done it.
    """
    if any(asked is not None for asked in (workers, executor, scheduler)):
        return workers
    if not isinstance(engine, CompiledEngine) or scenario.slotted:
        return None
    seconds = guessed_seconds(scenario, runs)
    return 1 if seconds < STARTING + seconds / cores() else None


def _prepare() -> None:
    """In a worker: the parent deals with Ctrl-C, and a worker without a parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
