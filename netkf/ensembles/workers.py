"""Worker processes, each connected by one pipe in either direction.

There are no shared queues, locks or threads. If a worker is killed, even while it sends a result,
its pipe is closed and this process reads end-of-file. In the pools of concurrent.futures and loky
workers share one pipe for results, which stays open when one of them dies: killed in the middle of
a result, it leaves the command waiting for ever.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Collection
from concurrent.futures import BrokenExecutor, Future
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from netkf.core.errors import EngineError
from netkf.ensembles.blocks import Job, PackedScenario, work
from netkf.ensembles.pool import RemotePool
from netkf.ensembles.process_start import (
    block_signals,
    hide_main_module,
    limit_blas_threads,
    process_context,
    start_server,
)

MAX_ATTEMPTS = 4
"""Number of workers that may die during one job before it is given up."""
GRACE = 2.0
"""Seconds that idle workers get to end by themselves before they are killed."""


class _Task(NamedTuple):
    """A submitted job, its future, and the number of workers that died during it."""

    job: Job
    future: Future[Any]
    deaths: int = 0


class _Worker:
    """A worker process with its two pipes, and the task it works on (None if idle)."""

    def __init__(self, hide_main: bool) -> None:
        receiver, self._jobs = multiprocessing.Pipe(duplex=False)
        self.results, sender = multiprocessing.Pipe(duplex=False)
        self.task: _Task | None = None
        self._known = ""  # digest of the last scenario that was sent
        self._process = process_context().Process(target=_serve, args=(receiver, sender))
        try:
            start_server()
            with limit_blas_threads(), block_signals(), hide_main_module(hide_main):
                self._process.start()
        except BaseException:
            self.end()
            self.join(0.0)
            raise
        finally:
            # Only the worker keeps these ends: its death must close them.
            receiver.close()
            sender.close()

    def send(self, task: _Task) -> None:
        """Send a task to this idle worker; raises OSError if the process is dead."""
        self.task, job = task, task.job
        if isinstance(job.scenario, PackedScenario):
            digest = job.scenario.digest
            if digest == self._known:
                job = job._replace(scenario=PackedScenario(digest, b"", ()))
            self._known = digest
        self._jobs.send_bytes(pickle.dumps(job, pickle.HIGHEST_PROTOCOL))

    def receive(self) -> Any:
        """Return the result of the task, or raise what it raised; OSError or EOFError if dead."""
        result, raised, traceback_text = pickle.loads(self.results.recv_bytes())
        if raised is None:
            return pickle.loads(result)
        raise pickle.loads(raised) from _RemoteError(traceback_text)

    def end(self) -> None:
        """Close the pipes, upon which an idle worker ends."""
        for pipe in (self._jobs, self.results):
            with suppress(OSError):
                pipe.close()

    def join(self, seconds: float) -> None:
        """Wait up to ``seconds`` for the process to end, then kill it."""
        if self._process.pid is None:
            return
        self._process.join(seconds)
        if self._process.is_alive():
            with suppress(OSError, ValueError):
                self._process.kill()
            self._process.join(GRACE)


class _RemoteError(Exception):
    """Carries the traceback of a worker as the cause of an exception raised here."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class ProcessPool(RemotePool):
    """Own worker processes, each with one BLAS thread and without the user's script as __main__."""

    def __init__(self, workers: int) -> None:
        super().__init__()
        self.width = workers
        self._workers: list[_Worker] = []
        self._waiting: deque[_Task] = deque()

    def _send(self, job: Job) -> Future[Any]:
        future: Future[Any] = Future()
        self._waiting.append(_Task(job, future))
        self._hand_out()
        return future

    def wait(self, futures: Collection[Future[Any]]) -> list[Future[Any]]:
        """Wait until one of the ``futures`` of submitted jobs is done; return all that are.

        Meanwhile results are received, and idle workers get further jobs.
        """
        while True:
            done = [future for future in futures if future.done()]
            if done:
                return done
            self._hand_out()
            busy = {worker.results: worker for worker in self._workers if worker.task is not None}
            for ready in multiprocessing.connection.wait(list(busy)):
                self._receive_result(busy[ready])  # type: ignore[index]

    def close(self, at_once: bool) -> None:
        """End all workers; idle ones get GRACE seconds to end unless ``at_once``, others none."""
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.end()
        for worker in workers:
            worker.join(0.0 if at_once or worker.task is not None else GRACE)

    def _hand_out(self) -> None:
        while self._waiting:
            worker = next((one for one in self._workers if one.task is None), None)
            if worker is None and len(self._workers) >= self.width:
                return
            task = self._waiting.popleft()
            # The future of a task whose worker died is running already.
            if not task.future.running() and not task.future.set_running_or_notify_cancel():
                continue  # it was cancelled
            if worker is None:
                # Without a class of the user's script (__main__) workers need not run it again.
                packed = task.job.scenario
                hide = isinstance(packed, PackedScenario) and b"__main__" not in packed.payload
                worker = _Worker(hide)
                self._workers.append(worker)
            try:
                worker.send(task)
            except OSError:
                self._discard_worker(worker)

    def _receive_result(self, worker: _Worker) -> None:
        assert worker.task is not None
        future = worker.task.future
        try:
            result = worker.receive()
        except (EOFError, OSError) as error:
            # An OSError of the task itself comes with the traceback of the worker.
            if not isinstance(error.__cause__, _RemoteError):
                self._discard_worker(worker)
                return
            worker.task = None
            future.set_exception(error)
        except Exception as error:
            worker.task = None
            future.set_exception(error)
        else:
            worker.task = None
            self._hand_out()  # before this process is busy with the result
            future.set_result(result)

    def _discard_worker(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        worker.end()
        worker.join(0.0)
        assert worker.task is not None
        task = worker.task._replace(deaths=worker.task.deaths + 1)
        if task.deaths < MAX_ATTEMPTS:
            self._waiting.appendleft(task)
        else:
            task.future.set_exception(BrokenExecutor(f"{task.deaths} workers died"))


def _serve(jobs: Connection, results: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when workers end
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            results.send_bytes(_run_job(jobs.recv_bytes()))


def _run_job(message: bytes) -> bytes:
    try:
        answer: tuple[bytes | None, bytes | None, str]
        answer = pickle.dumps(work(pickle.loads(message)), pickle.HIGHEST_PROTOCOL), None, ""
    except Exception as error:
        answer = None, _pickled_error(error), "".join(traceback.format_exception(error))
    return pickle.dumps(answer, pickle.HIGHEST_PROTOCOL)


def _pickled_error(error: Exception) -> bytes:
    try:
        payload = pickle.dumps(error, pickle.HIGHEST_PROTOCOL)
        pickle.loads(payload)
    except Exception:
        message = f"a worker failed with {type(error).__name__}: {error}"
        return pickle.dumps(EngineError(message), pickle.HIGHEST_PROTOCOL)
    return payload


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
