"""Pools that run blocks: this process, own worker processes, any executor, a Dask scheduler."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Collection
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from netkf.core.errors import EngineError, ScenarioError
from netkf.core.fields import integer
from netkf.core.printable import shorten
from netkf.ensembles.ask_scheduler import scheduler_answers
from netkf.ensembles.blocks import BlockResult, Job, PackedScenario, pack_scenario, work
from netkf.ensembles.pool import LOOK_SECONDS, Pool, RemotePool
from netkf.ensembles.workers import ProcessPool
from netkf.runs.provenance import versions
from netkf.scenario.scenario import Scenario

QUICK_SECONDS, MAX_BLOCK_HERE = 0.2, 1024
"""Blocks in this process double in size while they take less CPU time, up to so many runs: when
the command is stopped, the present one is lost.
"""

WARM, SAVING = 0.2, 2.0
"""Seconds of work in this process after which the total time is estimated; and the estimated saving
in seconds above which worker processes are started, about the cost of starting them.
"""
PATIENCE = 8
"""Seconds to wait for a scheduler."""
CLOSE_SECONDS = 2.0
"""Longest wait when a scheduler's connection is closed."""
MAX_ADDRESS = 1024  # characters; a longer address is refused


class LocalPool(Pool):
    """A pool that runs one block at a time in this process, with its scenario and caches."""

    ahead = 1
    quick = QUICK_SECONDS

    def submit(self, job: Job) -> Future[BlockResult]:
        """Run the block at once, in this process; return its completed future."""
        future: Future[BlockResult] = Future()
        try:
            future.set_result(work(job))
        except Exception as error:
            future.set_exception(error)
        return future

    def next_size(self, left: int) -> int:
        """Return the present size of blocks, which doubles while blocks are quick."""
        return self._size

    def note_duration(self, job: Job, seconds: float) -> None:
        """Double the size of the next blocks if ``job``, of full size, was quick."""
        # The caller may have made the block larger than asked, as a full set of SIMD lanes.
        if seconds < self.quick and len(job.replicas) >= self._size:
            self._size = min(2 * job.size, MAX_BLOCK_HERE)


class AdaptivePool(Pool):
    """A pool that runs blocks in this process until worker processes would save time for the rest.

    An ``open_ended`` pool, of one job after another, expects as much work as it has done.
    """

    def __init__(self, workers: int, open_ended: bool = False) -> None:
        self.width, self._open_ended = workers, open_ended
        self._present: Pool = LocalPool()
        self._begun, self._seconds, self._runs, self._spent = False, 0.0, 0, 0.0

    @property
    def ahead(self) -> int:
        """One block in this process, several for worker processes."""
        return self._present.ahead

    def begin(self, scenario: object) -> None:
        """Forget the times of another scenario, which say nothing about this one."""
        if scenario is not self._scenario:
            self._begun, self._seconds, self._runs = False, 0.0, 0
        super().begin(scenario)
        self._present.begin(scenario)

    def submit(self, job: Job) -> Future[BlockResult]:
        """Run the block in this process, or submit it to workers once that would save time."""
        if isinstance(self._present, LocalPool) and self._worth_processes(job):
            self._present = ProcessPool(self.width)
        return self._present.submit(job)

    def next_size(self, left: int) -> int:
        """Return the size of the next block: small here, larger for worker processes."""
        return self._present.next_size(left)

    def note_duration(self, job: Job, seconds: float) -> None:
        """Add the ``seconds`` of a block to the estimate for a run; not those that fill caches."""
        self._present.note_duration(job, seconds)
        self._spent += seconds
        if self._begun or seconds > 1.0:
            self._seconds += seconds
            self._runs += len(job.replicas)
        self._begun = True

    def _worth_processes(self, job: Job) -> bool:
        expected = 0.0  # seconds that the runs left take in this process
        if self._seconds > WARM:
            expected = self._seconds / self._runs * (job.stop - job.start)
        if self._open_ended:
            expected = max(expected, self._spent)
        return expected * (1.0 - 1.0 / self.width) > SAVING

    def wait(self, futures: Collection[Future[BlockResult]]) -> Collection[Future[BlockResult]]:
        """Wait until one of the futures is done; return all that are."""
        return self._present.wait(futures)

    def close(self, at_once: bool) -> None:
        """End the processes, if any were started."""
        self._present.close(at_once)


class ExecutorPool(RemotePool):
    """A user's concurrent.futures executor with so many ``workers``, which is not shut down."""

    def __init__(self, executor: Executor, workers: int | None = None) -> None:
        super().__init__()
        self._executor = executor
        # Executors do not tell their number of workers; those of the standard library have it here.
        self.width = workers or getattr(executor, "_max_workers", None) or cores()

    def _send(self, job: Job) -> Future[BlockResult]:
        return self._executor.submit(work, job)


class DaskPool(RemotePool):
    """The workers of a Dask scheduler, which repeats the blocks of lost workers.

    Raises ScenarioError for an address where no scheduler answers.
    """

    def __init__(self, address: str) -> None:
        super().__init__()
        is_plain = str(address) == address and address.isprintable() and " " not in address
        if not (is_plain and 0 < len(address) <= MAX_ADDRESS):
            raise ScenarioError("scheduler", "must be an address", address, "give tcp://HOST:PORT")
        try:
            import distributed
        except ImportError:
            message = "a Dask scheduler needs the extra cluster; pip install 'netkf[cluster]'"
            raise EngineError(message) from None
        # scheduler_answers() asks from another process, which cannot reach an inproc:// address.
        if not (address.startswith("inproc://") or scheduler_answers(address, PATIENCE)):
            raise _unreachable(address, "no Dask scheduler answers there")
        connect: Any = distributed.Client
        try:
            self._client = connect(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise _unreachable(address, type(error).__name__) from None
        self._executor = self._client.get_executor(retries=3)
        self._address, self._threads, self._counted = address, 1, -math.inf

    @property
    def width(self) -> int:  # type: ignore[override]
        """Number of threads of the workers that are there now, or were a moment ago."""
        now = time.monotonic()
        if now > self._counted + LOOK_SECONDS:
            with suppress(OSError):
                self._threads = max(1, sum(self._client.nthreads().values()))
            self._counted = now
        return self._threads

    def _pack(self, scenario: Scenario) -> PackedScenario:
        # Workers may join at any time, so that each checks its own versions.
        return pack_scenario(scenario)._replace(versions=tuple(versions().items()))

    def _send(self, job: Job) -> Future[BlockResult]:
        future: Future[BlockResult] = self._executor.submit(work, job)
        return future

    def wait(self, futures: Collection[Future[BlockResult]]) -> Collection[Future[BlockResult]]:
        """Wait until one of the ``futures`` of submitted blocks is done; return all that are."""
        answered = time.monotonic()
        while True:
            done = wait(futures, timeout=LOOK_SECONDS, return_when=FIRST_COMPLETED).done
            # Futures that the scheduler has lost are marked as cancelled.
            lost = [future for future in done if future.cancelled()]
            now = time.monotonic()
            if self._client.status == "running":
                answered = now
            if lost or now - answered > PATIENCE:
                message = f"the scheduler at {shorten(self._address)} does not answer any more"
                raise EngineError(f"{message}, and the runs on it are lost")
            if done:
                return done

    def close(self, at_once: bool) -> None:
        """Leave the scheduler."""
        self._executor.shutdown(wait=False)
        self._client.close(timeout=CLOSE_SECONDS)


def _unreachable(address: str, reason: str) -> ScenarioError:
    """Return the error for a scheduler at this ``address`` that does not answer."""
    remedy = 'start one with "dask scheduler" and give its address, tcp://HOST:PORT'
    return ScenarioError("scheduler", f"cannot be reached ({reason})", address, remedy)


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


@dataclass(frozen=True)
class PoolOptions:
    """Where replicas are simulated; at most one of the three may be given, but an executor may come
    with the number of its workers.

    workers   : number of processes; 1 is this process
    executor  : an executor of concurrent.futures, or a pool that is used as it is
    scheduler : address of a Dask scheduler

    By default runs are simulated in this process, and on a process per core once that saves time.
    """

    workers: int | None = None
    executor: Executor | Pool | None = None
    scheduler: str | None = None


ANYWHERE = PoolOptions()


def make_pool(blocks: int, options: PoolOptions = ANYWHERE, open_ended: bool = False) -> Pool:
    """Return the pool, in which blocks of replicas are simulated, that the options ask for: at most
    ``blocks`` worker processes, an executor, or a Dask scheduler.

    An ``open_ended`` pool is for several jobs, one after another.

    Raises ScenarioError if the options ask for two pools, or for one of the wrong kind.
    """
    workers, executor, scheduler = options.workers, options.executor, options.scheduler
    if isinstance(executor, Pool):
        return executor
    values = {"workers": workers, "executor": executor, "scheduler": scheduler}
    names = [name for name, value in values.items() if value is not None]
    if len(names) > 1 and names != ["workers", "executor"]:
        rule = f"cannot go together with {names[1]}"
        raise ScenarioError(names[0], rule, values[names[0]], "give one of them")
    count = None if workers is None else integer(low=1)("workers", workers)
    if executor is not None:
        client = getattr(executor, "scheduler", None)
        if client is not None and hasattr(executor, "scatter"):  # a Dask client has submit(), too
            address = getattr(client, "address", "tcp://HOST:PORT")
            remedy = f'give scheduler="{address}" in its place'
            raise ScenarioError("executor", "must not be a Dask client", executor, remedy)
        if isinstance(executor, type) or not hasattr(executor, "submit"):
            remedy = "give a ThreadPoolExecutor, a ProcessPoolExecutor, or one like them"
            rule = "must be a concurrent.futures.Executor"
            raise ScenarioError("executor", rule, executor, remedy)
        return ExecutorPool(executor, count)
    if scheduler is not None:
        return DaskPool(scheduler)
    count = min(count or cores(), blocks)
    if count == 1:
        return LocalPool()
    return AdaptivePool(count, open_ended) if workers is None else ProcessPool(count)
