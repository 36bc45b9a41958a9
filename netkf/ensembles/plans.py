"""Ensembles that any number of commands simulate, at any time and on any machine, through files.

A plan is the directory of an ensemble that was stopped before its first run: ``netkf plan`` writes
it, ``netkf work`` adds blocks of runs without a result, and ``netkf merge`` turns them into what
``netkf run --runs`` would have written. Workers share nothing but the directory.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from netkf.core.errors import ScenarioError
from netkf.core.fields import one_of, require_runs
from netkf.ensembles.block_files import RunIdentity
from netkf.ensembles.checkpoints import BlockCheckpoints
from netkf.ensembles.directory import (
    DEFAULTS,
    TRACES,
    DirectoryWriter,
    EnsembleOptions,
    FinishedEnsemble,
    identify_runs,
    write_files,
)
from netkf.ensembles.parts import Part, Worker
from netkf.ensembles.pools import LocalPool, PoolOptions, make_pool
from netkf.ensembles.replicas import Progress, missing_ranges, replicate_blocks
from netkf.ensembles.resume import read_manifest
from netkf.ensembles.statistics import block_statistics, merge
from netkf.runs.documents import FINAL_STATUSES, DamagedError, check_seal, read_document
from netkf.runs.failures import InterruptedRunError, explain_failures
from netkf.runs.files import check_sources, create_output_directory, scenario_digest, write_scenario
from netkf.runs.provenance import machine, versions
from netkf.runs.run import Manifest
from netkf.runs.simulate import choose_engine
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario


class Plan(NamedTuple):
    """A planned ensemble or study: its directory, its scenario, the identity of its blocks, the
    number of jobs it was made for, whether it has been merged, and the command line of a study.
    """

    directory: Path
    scenario: Scenario
    identity: RunIdentity
    tasks: int
    is_merged: bool
    arguments: Sequence[str] = ()

    @property
    def work_command(self) -> str:
        """The command that works on it, as a shell reads it."""
        trust = ["--trust"] if getattr(self.scenario, "_trust", False) else []
        return shlex.join(["netkf", "work", str(self.directory), *trust])


def plan_ensemble(
    scenario: Scenario,
    runs: int,
    out: Path | None = None,
    options: EnsembleOptions = DEFAULTS,
    tasks: int = 1,
) -> Path:
    """Write the directory of an ensemble of ``runs`` runs, none of them simulated, and return its
    path; ``tasks`` is the number of jobs of an array for which it is.

    Raises ScenarioError and EngineError before anything is written, and WriteError.
    """
    runs = require_runs(runs)
    one_of(*TRACES)("trace", options.trace)
    engine = choose_engine(options.engine, scenario, announce=False)
    check_sources(scenario)
    identity = identify_runs(scenario, runs, options.trace, engine.name)
    directory = create_output_directory(out, scenario.name)
    DirectoryWriter(scenario, directory, identity, tasks).begin(None)
    return directory


def write_study(
    directory: Path, scenario: Scenario, arguments: Sequence[str], runs: int, tasks: int
) -> None:
    """Write the plan of a study: the command line ``arguments`` that does it, and a copy of its
    scenario, of whose ensembles so many ``runs`` are known.

    Raises ScenarioError if the scenario cannot be copied, and WriteError.
    """
    check_sources(scenario)
    # Keys of a study change others than those that the file has, such as defaults that follow them.
    write_scenario(directory, scenario, resolve=False)
    digest, trust = scenario_digest(scenario), getattr(scenario, "_trust", False)
    if scenario_digest(load(directory / "scenario.toml", trust=trust)) != digest:
        remedy = "put its files and classes beside it"
        raise ScenarioError("scenario", "is another one when it is copied", scenario.name, remedy)
    entries = {"scenario": digest, "tasks": tasks, "arguments": list(arguments)}
    Manifest.of(scenario, directory, "auto", runs=runs).write("planned", entries)


def open_plan(directory: Path, trust: bool = False) -> Plan:
    """Return the plan in a directory; raises ScenarioError if there is none, it was changed, or it
    needs other versions than those here, with which the last digits would be others.
    """
    remedy = "give a directory that netkf plan wrote"
    try:
        manifest = read_manifest(directory, "DIR")
        check_seal(manifest)
        if "scenario" not in manifest:
            raise DamagedError("it is the directory of a single run or of a study")
        scenario = load(directory / "scenario.toml", trust=trust)
        if scenario_digest(scenario) != manifest.get("scenario"):
            raise DamagedError("scenario.toml or its files were changed since")
    except (DamagedError, FileNotFoundError) as error:
        raise ScenarioError("DIR", f"holds no plan: {error}", str(directory), remedy) from None
    is_merged = manifest["status"] in FINAL_STATUSES
    planned, present = manifest["versions"], versions()
    if planned != present and not is_merged:
        names = [k for k in {**planned, **present} if planned.get(k) != present.get(k)]
        listed = ", ".join(f"{k} {present.get(k)} instead of {planned.get(k)}" for k in names)
        rule = "was planned with other versions, and results would differ in their last digits"
        raise ScenarioError("DIR", rule, listed, "use the same installation")
    runs, trace = manifest["runs"]["wanted"], manifest.get("trace", "first")
    digest, seed, engine = (manifest[key] for key in ("scenario", "seed", "engine"))
    identity = RunIdentity(digest, seed, runs, trace, engine)
    tasks, arguments = manifest.get("tasks", 1), manifest.get("arguments", ())
    return Plan(directory, scenario, identity, tasks, is_merged, arguments)


class WorkDone(NamedTuple):
    """The replicas of a worker, and how many of them it simulated and are left."""

    replicas: range
    simulated: int
    left: int


def work_on_plan(
    plan: Plan,
    part: Part,
    seconds: float | None = None,
    pool: PoolOptions = PoolOptions(1),  # noqa: B008 - it is immutable
    progress: Progress | None = None,
) -> WorkDone:
    """Simulate the runs of a ``part`` of a plan that have no result yet, for so many ``seconds`` at
    most, and write their results.

    Several workers on one part do its work twice and no harm. Raises InterruptedRunError (a
    KeyboardInterrupt) when interrupted, with what was finished written, EngineError if a plugged-in
    class fails, and WriteError.
    """
    replicas, identity, scenario = part.of(plan.identity.runs), plan.identity, plan.scenario
    if plan.is_merged or not replicas:
        return WorkDone(replicas, 0, 0)
    worker = Worker(part, seconds, progress)
    blocks = BlockCheckpoints(plan.directory, scenario)
    engine = choose_engine(identity.engine, scenario)
    task = partial(block_statistics, engine=engine, traces=identity.traces)
    try:
        with (
            explain_failures(scenario),
            make_pool(len(replicas), pool) as workers,
            worker.store(blocks, identity, is_over=partial(_was_merged, plan.directory)) as store,
        ):
            replicate_blocks(task, merge, scenario, identity.runs, pool=workers, store=store)
    except KeyboardInterrupt:
        raise InterruptedRunError(plan.directory, f"; go on with {plan.work_command}") from None
    return WorkDone(replicas, worker.simulated, worker.left)


def _was_merged(directory: Path) -> bool:
    """Return True if another command has merged the plan in a directory meanwhile."""
    try:
        return read_document(directory / "manifest.json").get("status") in FINAL_STATUSES
    except DamagedError:
        return False


def merge_plan(
    plan: Plan,
    mixed: bool = False,
    *,
    finish: Callable[[FinishedEnsemble], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> FinishedEnsemble | list[range]:
    """Write the files of the ensemble from the results of all workers; return it, or the ranges of
    replicas without a result, and then nothing is written.

    The files are those of ``netkf run --runs`` on the machine of the workers, to the last bit; with
    ``mixed`` the machines may be of different kinds, which the manifest lists. ``finish`` writes
    further files; ``note`` is called with lines about files that are not used. Raises ScenarioError
    as ``require_equal_installations``, and WriteError.
    """
    started = time.perf_counter()
    writer = DirectoryWriter(plan.scenario, plan.directory, plan.identity, plan.tasks)
    writer.find_blocks(note, any_installation=True)
    missing = list(missing_ranges(writer.known, range(plan.identity.runs)))
    if missing:
        return missing
    machines = require_equal_installations(writer.blocks.installations, plan.directory, mixed)
    if note is not None and machines != [machine()]:
        note("runs were simulated on another kind of machine than this: bounds of theory are of it")
    with LocalPool() as pool:
        engine = choose_engine(plan.identity.engine, plan.scenario, announce=False)
        statistics = writer.simulate(engine, pool, None)
    finished = write_files(writer, statistics, started)
    if finish is not None:
        finish(finished)
    writer.end(finished.status, statistics, machines)
    writer.blocks.remove()
    return finished


def require_equal_installations(
    installations: Sequence[dict[str, Any]], directory: Path, mixed: bool
) -> list[dict[str, Any]]:
    """Return the machines of the ``installations`` that made the results in a directory; raises
    ScenarioError for other versions than here, or different machines unless they may be mixed.
    """
    if any(installation["versions"] != versions() for installation in installations):
        rule = "holds results of other versions, whose last digits may differ"
        raise ScenarioError("DIR", rule, str(directory), "remove its blocks, and work again")
    machines = [installation["machine"] for installation in installations]
    if len(machines) > 1 and not mixed:
        kinds = ", ".join(sorted(str(one.get("processor")) for one in machines))
        rule = "holds results of machines of different kinds, whose last digits may differ"
        raise ScenarioError("DIR", rule, kinds, "give --mixed to merge them")
    return machines
