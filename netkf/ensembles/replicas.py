"""``replicate``: apply a task to many replicas of a scenario on a pool of workers."""

from __future__ import annotations

import contextlib
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Future
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

from netkf.core.errors import EngineError, NetkfError, ScenarioError
from netkf.core.fields import integer, require_runs
from netkf.ensembles.blocks import BlockResult, BlockTask, Job, Task, each_replica
from netkf.ensembles.merge_tree import Merge, MergeTree
from netkf.ensembles.pool import Pool
from netkf.ensembles.pools import ANYWHERE, PoolOptions, make_pool
from netkf.linalg.lanes import LANES
from netkf.scenario.scenario import Scenario

Progress = Callable[[int, int], None]
"""Called with the number of runs done and the number of all runs."""


Node = tuple[int, int]
"""The replicas start, ... of a node of the binary tree: ``size`` of them, a power of two, of which
``start`` is a multiple; those from the number of runs on do not exist.
"""


class BlockStore(NamedTuple):
    """Results of blocks of replicas that are kept, and which others are wanted.

    known    : functions that return the results of nodes that need not be simulated, by node
    received : function of (node, result, CPU seconds) that is called with each other block as it
               completes, and returns the result to merge
    largest  : largest number of replicas in a block
    wanted   : replicas that are to be simulated (default: all); if some are missing at the end,
               there is no result
    time_is_up : function that is asked before each block if no further one should begin
    merge    : merges the results, by default as those of the task are merged
    """

    known: Mapping[Node, Callable[[], Any]] = MappingProxyType({})
    received: Callable[[Node, Any, float], Any] = lambda _, result, _seconds: result
    largest: int = 1 << 62
    wanted: range | None = None
    time_is_up: Callable[[], bool] = lambda: False
    merge: Merge | None = None


class Form(NamedTuple):
    """How the results of blocks are stored: functions that turn one, a list of runs or a named
    tuple of arrays with a row for each run, into arrays by name and back.
    """

    pack: Callable[[Any], dict[str, Any]]
    unpack: Callable[[Mapping[str, Any]], Any]


def form_of(kind: Any) -> Form:
    """Return the form of results that are named tuples of arrays of this ``kind``."""
    return Form(
        lambda value: value._asdict(), lambda arrays: kind(*(arrays[k] for k in kind._fields))
    )


class Gap(NamedTuple):
    """The ``missing`` replicas of an ensemble of ``runs`` runs, the ``number``-th of a plan."""

    number: int
    runs: int
    missing: list[range]


class MissingRunsError(NetkfError):
    """Ensembles of a plan lack results, which other workers may have under way."""

    def __init__(self, gaps: list[Gap]) -> None:
        self.gaps = gaps
        super().__init__("runs of a plan have no result yet")


def results_of(calls: Iterable[Callable[[], Any]]) -> Iterator[Any]:
    """Yield the results of ``calls`` of ``replicate_blocks``, one after another. On a plan each
    does its share of the work before a MissingRunsError of all is raised.
    """
    gaps: list[Gap] = []
    for call in calls:
        try:
            result = call()
        except MissingRunsError as error:
            gaps += error.gaps
        else:
            if not gaps:
                yield result
    if gaps:
        raise MissingRunsError(gaps)


def replicate(
    task: Task, scenario: Scenario, runs: int, seed: int | None = None, **options: Any
) -> list[Any]:
    """Call ``task(scenario, seed, replica)`` for ``runs`` replicas (runs that differ in their
    random numbers), in worker processes if that pays; return its results in the order of replicas.

    ``options`` are those of ``replicate_blocks``, such as ``first``, the number of the first
    replica (default: 0), and ``pool``.
    """
    block_task = partial(each_replica, partial(_as_list, task), operator.add)
    results: list[Any] = replicate_blocks(block_task, operator.add, scenario, runs, seed, **options)
    return results


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
    store: BlockStore = BlockStore(),  # noqa: B008 - it is immutable
    form: Form | None = None,
) -> Any:
    """Return ``task(scenario, seed, replicas)`` for blocks of the replicas ``first`` .. ``first +
    runs - 1``, merged by ``merge(a, b)``, which joins the results of neighbours (a before b) into
    one of the same kind.

    Results are merged in the binary tree over replicas, inside blocks by the task itself. ``task``
    and ``merge`` are functions of a module, or partials of such, that workers can import; their
    results must pickle.

    seed     : defaults to the scenario's
    pool     : a pool of make_pool, or options for one that is closed at the end
    progress : called after each block
    together : smallest number of replicas in a block run in this process, a power of two; by
               default as many as SIMD lanes for a scenario in slots, whose runs are simulated in
               lanes, else 1
    store    : results of some blocks that are known, and what is done with those of others
    form     : how a plan stores results, if the pool is that of a plan

    Raises ScenarioError for wrong arguments, EngineError if workers die again and again or a
    plugged-in class fails, MissingRunsError on a plan, and whatever ``task`` raises.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError("", "must be a netkf.Scenario", scenario, "netkf.load(path) gives one")
    seed = scenario.seed if seed is None else integer(low=0)("seed", seed)
    runs, first = require_runs(runs), integer(low=0)("first", first)
    runs_done = 0
    job = Job(scenario, task, seed, first, start=0, stop=runs, size=1)

    def take(block: Job, result: Any) -> None:
        nonlocal runs_done
        # A block of 2^level replicas, the k-th of this size, is the node (level, k) of the tree.
        tree.add(block.start // block.size, result, block.size.bit_length() - 1)
        runs_done += len(block.replicas)
        if progress is not None:
            progress(runs_done, runs)

    with contextlib.ExitStack() as stack:
        if isinstance(pool, PoolOptions):
            pool = stack.enter_context(make_pool(runs, pool))
        if pool.plan is not None and form is not None:
            store = stack.enter_context(pool.plan.store(job, merge, form))
        tree = MergeTree(store.merge or merge)
        pool.begin(scenario)
        for start, size in sorted(store.known):
            take(job._replace(start=start, size=size), store.known[start, size]())
        for block, done in _complete_blocks(pool, _make_blocks(pool, job, together, store)):
            take(block, store.received((block.start, block.size), done.value, done.seconds))
    return tree.result() if runs_done == runs else None


def missing_ranges(known: Iterable[Node], wanted: range) -> Iterator[range]:
    """Yield the ranges of replicas of ``wanted`` that are in no ``known`` node, in order."""
    first = wanted.start
    for start, size in sorted(known):
        if start > first and first < wanted.stop:
            yield range(first, min(start, wanted.stop))
        first = max(first, start + size)
    if first < wanted.stop:
        yield range(first, wanted.stop)


def _as_list(task: Task, scenario: Scenario, seed: int, replica: int) -> list[Any]:
    return [task(scenario, seed, replica)]


def _make_blocks(pool: Pool, job: Job, together: int | None, store: BlockStore) -> Iterator[Job]:
    """Yield the blocks of replicas of ``job`` that are to be simulated, in order, each as a Job."""
    # Runs in slots are simulated in SIMD lanes: fewer runs than lanes take as long.
    slotted = isinstance(job.scenario, Scenario) and job.scenario.slotted
    min_size = together or (LANES if slotted else 1)
    wanted = range(job.stop) if store.wanted is None else store.wanted
    gaps = list(missing_ranges(store.known, wanted))
    left = sum(map(len, gaps))
    for gap in gaps:
        start = gap.start
        while start < gap.stop:
            if store.time_is_up():
                return
            size = pool.next_size(left)
            if pool.ahead == 1:  # blocks run one at a time, in this process
                size = max(size, min_size)
            if start:
                # A block must be a node of the tree: ``start`` must be a multiple of its size. The
                # largest power of two that divides ``start`` is ``start & -start``.
                size = min(size, start & -start)
            if gap.stop < job.stop:  # it may reach beyond the last run only
                size = min(size, 1 << ((gap.stop - start).bit_length() - 1))
            size = min(size, store.largest, 1 << (job.stop - start - 1).bit_length())
            block = job._replace(start=start, size=size)
            yield block
            start += block.size
            left -= len(block.replicas)


def _complete_blocks(pool: Pool, blocks: Iterator[Job]) -> Iterator[tuple[Job, BlockResult]]:
    """Submit ``blocks`` of replicas to the pool, as many at a time as it allows."""
    waiting: dict[Future[BlockResult], Job] = {}
    try:
        while True:
            while len(waiting) < pool.ahead and (block := next(blocks, None)) is not None:
                waiting[pool.submit(block)] = block
            if not waiting:
                return
            for future in pool.wait(waiting):
                block, done = waiting.pop(future), future.result()
                pool.note_duration(block, done.seconds)
                yield block, done
    except BrokenExecutor as error:
        message = "workers ended again and again before their runs were done; perhaps the memory is"
        why = f"{message} too small, or a class of the scenario ends the process"
        raise EngineError(why) from error
    except CancelledError:
        raise EngineError("the executor was shut down before its runs were done") from None
    finally:
        for future in waiting:
            future.cancel()
