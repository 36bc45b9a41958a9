"""``replicate``: something done with many replicas of a scenario, wherever there are workers."""

from __future__ import annotations

import hashlib
import operator
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from functools import partial
from pathlib import Path
from typing import Any

from netkf.core.errors import EngineError, ScenarioError
from netkf.core.fields import integer
from netkf.ensembles.blocks import Grove, Job, Merge, Task
from netkf.ensembles.pools import Here, Pool, make_pool
from netkf.scenario.plugins import in_words, plugged_in
from netkf.scenario.scenario import Scenario

LARGEST_BLOCK = 64
MOST_BLOCKS = 4096
ROUNDS = 16

Progress = Callable[[int, int], None]
"""Called with the runs done and wanted."""


def replicate(
    task: Task,
    scenario: Scenario,
    runs: int,
    seed: int | None = None,
    *,
    merge: Merge | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    pool: Pool | None = None,
    progress: Progress | None = None,
    first: int = 0,
    block: int | None = None,
    known: Mapping[int, Callable[[], Any]] | None = None,
    received: Callable[[int, Any], Any] | None = None,
) -> Any:
    """``task(scenario, seed, replica)`` for the replicas ``first`` .. ``first + runs - 1``.

    Without ``merge`` the results come as a list in the order of replicas. With ``merge(a, b)``,
    which joins the results of neighbours (a before b) into one of the same kind, they are merged in
    the binary tree over replicas, and only the whole is returned: equal to the last bit for every
    number of workers, size of block and order of completion. ``task`` and ``merge`` are functions
    of a module, or partials of such, that workers can import; what they return must pickle.

    By default the work is done by processes of our own, ``workers`` of them (as many as there are
    cores; 1 is this process), else by any ``executor`` of concurrent.futures, or by the Dask
    ``scheduler`` at an address; a ``pool`` of make_pool stands for all three, and is closed at the
    end. ``seed`` defaults to the scenario's.

    ``block`` is the number of replicas handed out together, a power of two. Blocks are numbered
    from 0; those that are ``known`` are not done again but called for, and ``received(number,
    result)`` sees each of the others when it comes and returns what to merge.

    Raises ScenarioError for arguments that are wrong, EngineError where workers die again and again
    or a plugged-in class fails, and what ``task`` raises.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "must be a netkf.Scenario", scenario, "netkf.load(path) gives one")
    seed = scenario.seed if seed is None else integer(low=0)("seed", seed)
    runs, first = integer(low=1)("runs", runs), integer(low=0)("first", first)
    if merge is None:
        task, merge = partial(_listed, task), operator.add
    if pool is None:
        pool = make_pool(scenario, -(-runs // (block or 1)), workers, executor, scheduler)
    size = block or block_size(runs, pool.width)
    ended = False
    try:
        job = Job(*_travelling(scenario, pool), task, merge, seed, first, 0, runs, size)
        whole = _gathered(pool, job, known or {}, received or _as_it_came, progress or _quiet)
        ended = True
    finally:
        pool.close(at_once=not ended)
    return whole


def block_size(runs: int, width: int) -> int:
    """A power of two that leaves every worker several blocks, so that all end together."""
    size = 1
    while size < LARGEST_BLOCK and 2 * size * width * ROUNDS <= runs:
        size *= 2
    while size * MOST_BLOCKS < runs:
        size *= 2
    return size


def _listed(task: Task, scenario: Scenario, seed: int, replica: int) -> list[Any]:
    """For addition to join the results."""
    return [task(scenario, seed, replica)]


def _as_it_came(number: int, result: Any) -> Any:  # noqa: ARG001
    return result


def _quiet(done: int, wanted: int) -> None:
    """No progress."""


def _gathered(
    pool: Pool,
    job: Job,
    known: Mapping[int, Callable[[], Any]],
    received: Callable[[int, Any], Any],
    progress: Progress,
) -> Any:
    """Hand out the blocks that are not known, and merge all as they come."""
    grove, done = Grove(job.merge), 0
    everything = range(-(-job.stop // job.size))

    def take(number: int, result: Any) -> None:
        nonlocal done
        grove.add(number, result)
        done += min(job.size, job.stop - number * job.size)
        progress(done, job.stop)

    for number in everything:
        if number in known:
            take(number, known[number]())
    missing = (number for number in everything if number not in known)
    for number, result in _completed(pool, job, missing):
        take(number, received(number, result))
    return grove.result()


def _completed(pool: Pool, job: Job, numbers: Iterator[int]) -> Iterator[tuple[int, Any]]:
    """Numbers and results of blocks as they complete; those of workers that die are redone."""
    waiting: dict[Future[Any], int] = {}
    again: list[int] = []
    try:
        while True:
            broken: BrokenExecutor | None = None
            try:
                for number in _next(again, numbers, pool.ahead - len(waiting)):
                    again.append(number)
                    waiting[pool.submit(job._replace(start=number * job.size))] = again.pop()
            except BrokenExecutor as error:
                broken = error
            if not waiting and broken is None:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                number = waiting.pop(future)
                try:
                    result = future.result()
                except BrokenExecutor as error:
                    again.append(number)
                    broken = error
                    continue
                yield number, result
            if broken is not None:
                again += waiting.values()
                waiting.clear()
                _renew(pool, broken)
    finally:
        for future in waiting:
            future.cancel()


def _next(again: list[int], numbers: Iterator[int], count: int) -> Iterator[int]:
    for _ in range(count):
        number = again.pop() if again else next(numbers, None)
        if number is None:
            return
        yield number


def _renew(pool: Pool, error: BrokenExecutor) -> None:
    if not pool.renew():
        words = "workers ended again and again before their runs were done; perhaps the memory is"
        raise EngineError(
            f"{words} too small, or a class of the scenario ends the process"
        ) from error


def _travelling(scenario: Scenario, pool: Pool) -> tuple[str, bytes, tuple[tuple[str, str], ...]]:
    """Digest, pickle and modules of a scenario; nothing where it stays in this process."""
    if isinstance(pool, Here):
        return "", b"", ()
    try:
        payload = pickle.dumps(scenario, protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        words = f"the scenario cannot be sent to workers ({in_words(error)})"
        remedy = "classes and functions must be those of modules; or use workers=1"
        raise EngineError(f"{words}; {remedy}") from None
    return hashlib.sha256(payload).hexdigest(), payload, tuple(sorted(_modules(scenario)))


def _modules(scenario: Scenario) -> set[tuple[str, str]]:
    """The module of each plugged-in class, with the folder that it can be imported from."""
    found = set()
    for part in plugged_in(scenario):
        name = type(part).__module__
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is not None and name != "__main__":
            place = Path(file).resolve()
            up = name.count(".") + (place.name == "__init__.py")
            found.add((name, str(place.parents[up])))
    return found
