"""Worker processes of our own, each with a pipe of its own in either direction.

There are no queues, locks or threads between the processes. A worker that is killed at any moment,
even in the middle of a result, closes its pipe, and this process sees the end of it: nothing here
waits for something that a dead process has locked.
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
from netkf.ensembles.process_start import (
    context,
    main_hidden,
    one_blas_thread,
    signals_blocked,
    start_server,
)

MAX_ATTEMPTS = 4
"""Workers that may die of one job before the job is given up."""
GRACE = 2.0
"""Seconds that idle workers have to end by themselves."""


class _Task(NamedTuple):
    """A job that was handed in, its future, and how many workers have died of it."""

    job: Job
    future: Future[Any]
    deaths: int = 0


class _Worker:
    """A worker process with its two pipes and the task that it has, if any."""

    def __init__(self, hide_main: bool) -> None:
        receiver, self._jobs = multiprocessing.Pipe(duplex=False)
        self.results, sender = multiprocessing.Pipe(duplex=False)
        self.task: _Task | None = None
        self._known = ""
        self._process = context().Process(target=_serve, args=(receiver, sender))
        try:
            start_server()
            with one_blas_thread(), signals_blocked(), main_hidden(hide_main):
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
        """Hand over a task to an idle worker; raises OSError if the worker is dead."""
        self.task, job = task, task.job
        if isinstance(job.scenario, PackedScenario):
            digest = job.scenario.digest
            if digest == self._known:
                job = job._replace(scenario=PackedScenario(digest, b"", ()))
            self._known = digest
        self._jobs.send_bytes(pickle.dumps(job, pickle.HIGHEST_PROTOCOL))

    def receive(self) -> Any:
        """Return the result of the task; raises OSError or EOFError if the worker died of it, and
        otherwise what the task raised.
        """
        result, raised, where = pickle.loads(self.results.recv_bytes())
        if raised is None:
            return pickle.loads(result)
        raise pickle.loads(raised) from _RemoteError(where)

    def end(self) -> None:
        """Let an idle worker end."""
        for pipe in (self._jobs, self.results):
            with suppress(OSError):
                pipe.close()

    def join(self, seconds: float) -> None:
        """Wait for the end of the process, and kill it after ``seconds``."""
        if self._process.pid is None:
            return
        self._process.join(seconds)
        if self._process.is_alive():
            with suppress(OSError, ValueError):
                self._process.kill()
            self._process.join(GRACE)


class _RemoteError(Exception):
    """The traceback in a worker, as the cause of what this process raises."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class WorkerProcesses:
    """At most ``width`` worker processes, started as they are needed, and the tasks for them."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._workers: list[_Worker] = []
        self._waiting: deque[_Task] = deque()

    def submit(self, job: Job) -> Future[Any]:
        """Hand in a job; it is begun at once if a worker is idle."""
        future: Future[Any] = Future()
        self._waiting.append(_Task(job, future))
        self._hand_out()
        return future

    def wait(self, futures: Collection[Future[Any]]) -> list[Future[Any]]:
        """Wait until one of the futures is done; return all that are."""
        while True:
            done = [future for future in futures if future.done()]
            if done:
                return done
            self._hand_out()
            busy = {worker.results: worker for worker in self._workers if worker.task is not None}
            for ready in multiprocessing.connection.wait(list(busy)):
                self._receive_result(busy[ready])  # type: ignore[index]

    def close(self, at_once: bool) -> None:
        """End all workers, idle ones by themselves; ``at_once`` kills them, whatever they do."""
        workers, self._workers = self._workers, []
        for worker in workers:
            worker.end()
        for worker in workers:
            worker.join(0.0 if at_once or worker.task is not None else GRACE)

    def _hand_out(self) -> None:
        """Give waiting tasks to idle workers, and start workers while there are too few."""
        while self._waiting:
            worker = next((one for one in self._workers if one.task is None), None)
            if worker is None and len(self._workers) >= self._width:
                return
            task = self._waiting.popleft()
            if not task.future.running() and not task.future.set_running_or_notify_cancel():
                continue
            if worker is None:
                worker = _Worker(_may_hide_main(task.job))
                self._workers.append(worker)
            try:
                worker.send(task)
            except OSError:
                self._discard_worker(worker)

    def _receive_result(self, worker: _Worker) -> None:
        """Take the result of a worker, or take note that it died."""
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
        """Put the task of a dead worker back to the others, unless too many died of it."""
        self._workers.remove(worker)
        worker.end()
        worker.join(0.0)
        assert worker.task is not None
        task = worker.task._replace(deaths=worker.task.deaths + 1)
        if task.deaths < MAX_ATTEMPTS:
            self._waiting.appendleft(task)
        else:
            task.future.set_exception(BrokenExecutor(f"{task.deaths} workers died"))


def _may_hide_main(job: Job) -> bool:
    """Return True if workers can do without the user's script."""
    return isinstance(job.scenario, PackedScenario) and b"__main__" not in job.scenario.payload


def _serve(jobs: Connection, results: Connection) -> None:
    """Do one job after the other, in a worker process, until the pipe with the jobs is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # this end is the parent's decision
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            results.send_bytes(_run_job(jobs.recv_bytes()))


def _run_job(message: bytes) -> bytes:
    """Do a pickled job; return the pickle of (pickled result, pickled exception, traceback)."""
    try:
        answer: tuple[bytes | None, bytes | None, str]
        answer = pickle.dumps(work(pickle.loads(message)), pickle.HIGHEST_PROTOCOL), None, ""
    except Exception as error:
        answer = None, _pickled_error(error), "".join(traceback.format_exception(error))
    return pickle.dumps(answer, pickle.HIGHEST_PROTOCOL)


def _pickled_error(error: Exception) -> bytes:
    """Return the pickle of an exception, or of an EngineError in place of one that has none."""
    try:
        found = pickle.dumps(error, pickle.HIGHEST_PROTOCOL)
        pickle.loads(found)
    except Exception:
        message = f"a worker failed with {type(error).__name__}: {error}"
        return pickle.dumps(EngineError(message), pickle.HIGHEST_PROTOCOL)
    return found


def _end_with_parent() -> None:
    """End this worker when its parent has ended, even in the middle of a job."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
