"""Blocks of replicas, the units of work of a worker."""

from __future__ import annotations

import hashlib
import pickle
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from netkf.core.contracts import describe_error
from netkf.core.errors import EngineError
from netkf.ensembles.merge_tree import Merge, MergeTree
from netkf.linalg.compiling import seconds_spent
from netkf.runs.failures import explain_failure
from netkf.runs.provenance import versions
from netkf.scenario.plugins import (
    current_module,
    edited_module,
    find_unimportable_class,
    unguarded_line,
    user_components,
)
from netkf.scenario.scenario import Scenario

Task = Callable[[Scenario, int, int], Any]
"""``task(scenario, seed, replica)`` of one replica."""

BlockTask = Callable[[Scenario, int, range], Any]
"""``task(scenario, seed, replicas)`` of neighbouring replicas, merged by the tree over them."""


class PackedScenario(NamedTuple):
    """A scenario in the form that is sent to a worker.

    digest, payload : its pickle, and the SHA-256 of that
    modules : names and folders of the modules of its plugged-in classes
    versions : versions of packages that the worker must have; empty for workers of this computer
    """

    digest: str
    payload: bytes
    modules: tuple[tuple[str, str], ...]
    versions: tuple[tuple[str, str], ...] = ()


class Job(NamedTuple):
    """A block of work: ``task`` for the replicas first + start, ... up to ``size`` of them, before
    first + stop. ``start`` is a multiple of ``size``, a power of two.
    """

    scenario: Scenario | PackedScenario
    task: BlockTask
    seed: int
    first: int
    start: int
    stop: int
    size: int

    @property
    def replicas(self) -> range:
        """Numbers of the replicas."""
        last = min(self.start + self.size, self.stop)
        return range(self.first + self.start, self.first + last)


class BlockResult(NamedTuple):
    """What a block's task returned, and its CPU time in seconds without that of compiling."""

    value: Any
    seconds: float


def work(job: Job) -> BlockResult:
    """Do a block of work, in a worker or in this process; return the results of its replicas.

    Raises EngineError with the name of the class if a plugged-in class fails.
    """
    scenario = job.scenario
    # CPU time: on a busy machine the wall-clock time would make blocks small.
    started, compiled = time.thread_time(), seconds_spent()
    if isinstance(scenario, PackedScenario):
        scenario = unpack_scenario(scenario)
    try:
        value = job.task(scenario, job.seed, job.replicas)
    except Exception as error:
        reason = explain_failure(scenario, error)
        if reason is error:
            raise
        raise reason from error
    seconds = time.thread_time() - started - (seconds_spent() - compiled)
    return BlockResult(value, max(0.0, seconds))


def each_replica(task: Task, merge: Merge, scenario: Scenario, seed: int, replicas: range) -> Any:
    """Call ``task(scenario, seed, replica)`` for each of ``replicas``; return its results, merged
    into one by ``merge(a, b)`` along the binary tree over replicas (neighbours first).
    """
    tree = MergeTree(merge)
    for k, replica in enumerate(replicas):
        tree.add(k, task(scenario, seed, replica))
    return tree.result()


def pack_scenario(scenario: Scenario) -> PackedScenario:
    """Return a scenario in the form that is sent to worker processes; raises EngineError if it
    cannot be pickled, or has a class that workers cannot import.
    """
    name = find_unimportable_class(scenario)
    if name is not None:
        message = f"workers cannot import the class {name} of a notebook, a prompt or a function"
        raise EngineError(f"{message}; put it into a module (a .py file), or use workers=1")
    if (edited := edited_module(scenario)) is not None:
        message = (
            f"workers would import {edited.name}, which was edited since the scenario was loaded"
        )
        raise EngineError(f"{message}; load the scenario again, or use workers=1")
    line = unguarded_line(scenario)
    if line:
        message = f"each worker would run the script again, because of its class on line {line[0]}"
        remedy = f'put line {line[1]} under if __name__ == "__main__":, or use workers=1'
        raise EngineError(f"{message}; {remedy}")
    try:
        payload = pickle.dumps(scenario, protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        message = f"the scenario cannot be sent to workers ({describe_error(error)})"
        remedy = "classes and functions must be those of modules; or use workers=1"
        raise EngineError(f"{message}; {remedy}") from None
    digest = hashlib.sha256(payload).hexdigest()
    return PackedScenario(digest, payload, tuple(sorted(_plugged_in_modules(scenario))))


def _plugged_in_modules(scenario: Scenario) -> set[tuple[str, str]]:
    """Return (module, folder) of each class of the scenario that a user wrote."""
    modules = set()
    for part in user_components(scenario):
        name = type(part).__module__
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is not None and name != "__main__":
            path = Path(file).resolve()
            # The folder above the outermost package: the module a.b of a/b.py is two levels below.
            level = name.count(".") + (path.name == "__init__.py")
            modules.add((name, str(path.parents[level])))
    return modules


MAX_SCENARIOS = 4  # scenarios that a worker keeps unpickled: those of a sweep alternate
_scenarios: dict[str, Scenario] = {}


def unpack_scenario(packed: PackedScenario) -> Scenario:
    """Return the unpickled scenario, in a worker, which keeps the last MAX_SCENARIOS with what they
    have cached; ``packed`` may lack the pickle of one that was sent before.
    """
    scenario = _scenarios.get(packed.digest)
    if scenario is None:
        while len(_scenarios) >= MAX_SCENARIOS:
            _scenarios.pop(next(iter(_scenarios)), None)
        scenario = _scenarios.setdefault(packed.digest, _unpickle(packed))
    return scenario


def _check_versions(required_versions: tuple[tuple[str, str], ...]) -> None:
    """Raise EngineError unless this worker has the ``required_versions`` (name, version)."""
    installed = versions()
    differences = [
        (name, installed.get(name, "none"), required)
        for name, required in required_versions
        if installed.get(name) != required
    ]
    if differences:
        listed = ", ".join(f"{name} {there} instead of {here}" for name, there, here in differences)
        message = f"a worker of the scheduler has other versions than this computer: {listed}"
        raise EngineError(f"{message}; install the same there, or use --workers")


def _unpickle(packed: PackedScenario) -> Scenario:
    if packed.versions:
        _check_versions(packed.versions)
    with ExitStack() as loaded:
        for name, folder in packed.modules:
            # A worker may have imported another module of this name for an earlier scenario.
            loaded.enter_context(current_module(name, Path(folder)))
            if folder not in sys.path:
                sys.path.insert(0, folder)
        try:
            scenario: Scenario = pickle.loads(packed.payload)
        except (AttributeError, ImportError) as error:
            message = (
                f"a class of the scenario cannot be imported by a worker ({describe_error(error)})"
            )
            remedy = "put it into a module that can be imported there, or use workers=1"
            raise EngineError(f"{message}; {remedy}") from error
    return scenario
