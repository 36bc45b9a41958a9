"""Replicas in blocks: what a worker does, and the tree in which results meet.

The result of all runs is that of the binary tree over the numbers of the replicas: node (level, k)
holds replicas k 2^level up to (k + 1) 2^level. A block is a node of that tree and workers merge
inside it with the same tree, so the bits do not depend on the size of the blocks, on who did
which, or on the order in which they came back.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from netkf.core.errors import EngineError
from netkf.engines.compiled.lots import together
from netkf.runs.failures import explain_failure
from netkf.scenario.plugins import in_words
from netkf.scenario.registry import forget_other
from netkf.scenario.scenario import Scenario

Task = Callable[[Scenario, int, int], Any]
Merge = Callable[[Any, Any], Any]


def tree(leaf: Callable[[int], Any], merge: Merge, first: int, stop: int, size: int) -> Any:
    """Of the ``size`` = 2^level leaves from ``first`` on that lie before ``stop``."""
    if size == 1:
        return leaf(first)
    half = size // 2
    left = tree(leaf, merge, first, stop, half)
    if first + half >= stop:
        return left
    return merge(left, tree(leaf, merge, first + half, stop, half))


class Grove:
    """Takes the results of blocks in any order and merges neighbours as soon as both are there, so
    that about as many wait as the logarithm of all.
    """

    def __init__(self, merge: Merge) -> None:
        self._merge = merge
        self._waiting: dict[tuple[int, int], Any] = {}

    def add(self, block: int, value: Any) -> None:
        """The result of a block; every block comes once."""
        level, k = 0, block
        while (level, k ^ 1) in self._waiting:
            other = self._waiting.pop((level, k ^ 1))
            value = self._merge(other, value) if k & 1 else self._merge(value, other)
            level, k = level + 1, k >> 1
        self._waiting[level, k] = value

    def result(self) -> Any:
        """Of all blocks; those at the end that have no neighbour join from right to left."""
        values = [value for _, value in sorted(self._waiting.items(), key=_first_block)]
        whole = values.pop()
        while values:
            whole = self._merge(values.pop(), whole)
        return whole


def _first_block(item: tuple[tuple[int, int], Any]) -> int:
    (level, k), _ = item
    return k << level


class Job(NamedTuple):
    """A block as it travels: the pickled scenario with its digest and where its modules are, what
    to do with each replica, and with which: the block of ``size`` that begins at ``start``, and
    nothing from ``stop`` on, counted from replica ``first``.
    """

    digest: str
    payload: bytes
    modules: tuple[tuple[str, str], ...]
    task: Task
    merge: Merge
    seed: int
    first: int
    start: int
    stop: int
    size: int


def work(job: Job) -> Any:
    """Do a block in a worker."""
    return block_result(unpacked(job), job)


def block_result(scenario: Scenario, job: Job) -> Any:
    """The merged result of a block; raises EngineError that names a plugged-in class."""
    first, stop = job.first + job.start, job.first + min(job.start + job.size, job.stop)
    try:
        with together(scenario, job.seed, first, stop):
            return tree(
                lambda place: job.task(scenario, job.seed, job.first + place),
                job.merge,
                job.start,
                job.stop,
                job.size,
            )
    except Exception as error:
        reason = explain_failure(scenario, error)
        if reason is error:
            raise
        raise reason from error


KEPT = 4
_scenarios: dict[str, Scenario] = {}


def unpacked(job: Job) -> Scenario:
    """The scenario of a job, with its caches kept from one block to the next."""
    scenario = _scenarios.get(job.digest)
    if scenario is None:
        while len(_scenarios) >= KEPT:
            _scenarios.pop(next(iter(_scenarios)), None)
        scenario = _scenarios.setdefault(job.digest, _unpickled(job))
    return scenario


def _unpickled(job: Job) -> Scenario:
    for name, folder in job.modules:
        forget_other(name, Path(folder))
        if folder not in sys.path:
            sys.path.insert(0, folder)
    try:
        scenario: Scenario = pickle.loads(job.payload)
    except (AttributeError, ImportError) as error:
        words = f"a class of the scenario cannot be imported by a worker ({in_words(error)})"
        remedy = "put it into a module that can be imported there, or use workers=1"
        raise EngineError(f"{words}; {remedy}") from error
    return scenario
