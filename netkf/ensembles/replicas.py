"""``replicate``: something done with many replicas of a scenario, wherever there are workers."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Future
from functools import partial
from typing import Any, NamedTuple

from netkf.core.errors import EngineError, ScenarioError
from netkf.core.fields import integer
from netkf.ensembles.blocks import BlockTask, Job, Task, each_replica
from netkf.ensembles.merge_tree import Merge, MergeTree
from netkf.ensembles.pools import ANYWHERE, Pool, PoolOptions, make_pool
from netkf.linalg.lanes import LANES
from netkf.scenario.scenario import Scenario

Progress = Callable[[int, int], None]
"""Called with the runs done and wanted."""


class NumberedBlocks(NamedTuple):
    """Blocks of ``size`` replicas, a power of two, numbered from 0. Those that are ``known`` are
    not done again but called for; ``received(number, result)`` sees each of the others when it
    comes and returns what to merge.
    """

    size: int
    known: Mapping[int, Callable[[], Any]]
    received: Callable[[int, Any], Any]


def replicate(
    task: Task, scenario: Scenario, runs: int, seed: int | None = None, **options: Any
) -> list[Any]:
    """Return ``task(scenario, seed, replica)`` for the replicas ``first`` .. ``first + runs - 1``,
    in their order; ``options`` are those of ``replicate_blocks``.
    """
    whole = partial(each_replica, partial(_as_list, task), operator.add)
    found: list[Any] = replicate_blocks(whole, operator.add, scenario, runs, seed, **options)
    return found


def replicate_blocks(
    task: BlockTask,
    merge: Merge,
    scenario: Scenario,
    runs: int,
    seed: int | None = None,
    *,
    pool: Pool | PoolOptions = ANYWHERE,
    progress: Progress | None = None,
    first: int = 0,
    together: int | None = None,
    blocks: NumberedBlocks | None = None,
) -> Any:
    """Return ``task(scenario, seed, replicas)`` for blocks of the replicas ``first`` .. ``first +
    runs - 1``, merged by ``merge(a, b)``, which joins the results of neighbours (a before b) into
    one of the same kind.

    Results are merged in the binary tree over replicas, inside blocks by the task itself: the whole
    is equal to the last bit for every number of workers, size of block and order of completion.
    ``task`` and ``merge`` are functions of a module, or partials of such, that workers can import;
    what they return must pickle.

    The work is done by a ``pool`` of make_pool, or by one that the options describe; it is closed
    at the end. ``seed`` defaults to the scenario's.

    ``together`` replicas, a power of two, are one block at least where blocks are done here; by
    default several of a scenario in slots, where runs are side by side. The pool chooses how many
    replicas are a block, unless ``blocks`` are numbered.

    Raises ScenarioError for arguments that are wrong, EngineError where workers die again and again
    or a plugged-in class fails, and what ``task`` raises.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "must be a netkf.Scenario", scenario, "netkf.load(path) gives one")
    seed = scenario.seed if seed is None else integer(low=0)("seed", seed)
    runs, first = integer(low=1)("runs", runs), integer(low=0)("first", first)
    blocks = blocks or CHOSEN_BY_POOL
    if isinstance(pool, PoolOptions):
        pool = make_pool(-(-runs // (blocks.size or 1)), pool)
    ended = False
    try:
        job = Job(scenario, task, seed, first, 0, runs, blocks.size)
        whole = _gather(pool, job, together, merge, blocks, progress or _report_nothing)
        ended = True
    finally:
        pool.close(at_once=not ended)
    return whole


def _as_list(task: Task, scenario: Scenario, seed: int, replica: int) -> list[Any]:
    """Return the result of a block unchanged."""
    """Return the result of one replica, for addition to join."""
    return [task(scenario, seed, replica)]


def _as_it_came(number: int, result: Any) -> Any:  # noqa: ARG001
    """Return the result of a block unchanged."""
    return result


CHOSEN_BY_POOL = NumberedBlocks(0, {}, _as_it_came)


def _report_nothing(done: int, wanted: int) -> None:
    """Report no progress."""


def _gather(
    pool: Pool,
    job: Job,
    together: int | None,
    merge: Merge,
    blocks: NumberedBlocks,
    progress: Progress,
) -> Any:
    """Hand out the blocks that are not known, and merge all as they come."""
    tree, done, known = MergeTree(merge), 0, blocks.known

    def take(block: Job, result: Any) -> None:
        """Add the result of a block to the tree and report progress."""
        nonlocal done
        tree.add(block.start // block.size, result, block.size.bit_length() - 1)
        done += len(block.replicas)
        progress(done, job.stop)

    for number in sorted(known):
        take(job._replace(start=number * job.size), known[number]())
    for block, result in _complete_blocks(pool, _make_blocks(pool, job, together, known)):
        take(block, blocks.received(block.start // block.size, result))
    return tree.result()


def _make_blocks(
    pool: Pool, job: Job, together: int | None, known: Mapping[int, Callable[[], Any]]
) -> Iterator[Job]:
    """Yield the blocks that are not known yet, in order; the pool chooses sizes as it is asked."""
    if job.size:
        for number in range(-(-job.stop // job.size)):
            if number not in known:
                yield job._replace(start=number * job.size)
        return
    # Runs in slots are side by side in lanes: fewer of them take as long.
    slotted = isinstance(job.scenario, Scenario) and job.scenario.slotted
    start, least = 0, together or (LANES if slotted else 1)
    while start < job.stop:
        size = pool.next_size(job.stop - start, job.stop)
        if pool.ahead == 1:
            size = max(size, least)
        if start:
            size = min(size, start & -start)  # a block is a node of the tree
        yield job._replace(start=start, size=size)
        start += size


def _complete_blocks(pool: Pool, blocks: Iterator[Job]) -> Iterator[tuple[Job, Any]]:
    """Yield blocks and their results as they complete.

    Raises EngineError if workers die again and again, or are lost.
    """
    waiting: dict[Future[Any], Job] = {}
    try:
        while True:
            while len(waiting) < pool.ahead and (block := next(blocks, None)) is not None:
                waiting[pool.submit(block)] = block
            if not waiting:
                return
            for future in pool.wait(waiting):
                yield waiting.pop(future), future.result()
    except BrokenExecutor as error:
        message = "workers ended again and again before their runs were done; perhaps the memory is"
        raise EngineError(
            f"{message} too small, or a class of the scenario ends the process"
        ) from error
    finally:
        for future in waiting:
            future.cancel()
