"""Ensembles that any number of commands simulate, at any time and on any machine, through files.

A plan is the directory of an ensemble that was stopped before its first run: ``netkf plan`` writes
it, ``netkf work`` adds blocks of runs without a result, and ``netkf merge`` turns them into what
``netkf run --runs`` would have written. Workers share nothing but the directory.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from netkf.core.errors import ScenarioError
from netkf.core.fields import integer, one_of
from netkf.ensembles.block_files import RunIdentity
from netkf.ensembles.checkpoints import BlockCheckpoints
from netkf.ensembles.directory import (
    TRACES,
    DirectoryWriter,
    EnsembleOptions,
    FinishedEnsemble,
    identify_runs,
    write_files,
)
from netkf.ensembles.pools import LocalPool, PoolOptions, make_pool
from netkf.ensembles.replicas import BlockStore, Progress, missing_ranges, replicate_blocks
from netkf.ensembles.resume import read_manifest
from netkf.ensembles.statistics import block_statistics
from netkf.runs.documents import FINAL_STATUSES, DamagedError, check_seal, read_document
from netkf.runs.failures import InterruptedRunError, explain_failures
from netkf.runs.files import check_sources, create_output_directory, scenario_digest
from netkf.runs.provenance import machine, versions
from netkf.runs.simulate import choose_engine
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario

PIECES = 8
"""Parts begin at multiples of a power of two of about so many to a part: fewer files in the end."""


@dataclass(frozen=True)
class Part:
    """Part ``index`` of ``count``, counted modulo ``count``: parts may begin at 0 or at 1."""

    index: int
    count: int

    def of(self, runs: int) -> range:
        """Return the replicas of this part of ``runs`` runs; it may be empty."""
        unit = 1 << (max(1, runs // (PIECES * self.count)).bit_length() - 1)

        def bound(index: int) -> int:
            return runs if index == self.count else index * runs // self.count // unit * unit

        index = self.index % self.count
        return range(bound(index), bound(index + 1))


@dataclass(frozen=True)
class ArrayVariables:
    """Environment variables of a batch system's arrays of jobs; empty where it has none."""

    index: str
    first: str = ""
    last: str = ""
    step: str = ""
    count: str = ""


ARRAYS = (
    ArrayVariables(
        "SLURM_ARRAY_TASK_ID",
        "SLURM_ARRAY_TASK_MIN",
        "SLURM_ARRAY_TASK_MAX",
        "SLURM_ARRAY_TASK_STEP",
        "SLURM_ARRAY_TASK_COUNT",
    ),
    ArrayVariables("PBS_ARRAY_INDEX"),
    ArrayVariables("SGE_TASK_ID", "SGE_TASK_FIRST", "SGE_TASK_LAST", "SGE_TASK_STEPSIZE"),
    ArrayVariables("LSB_JOBINDEX", last="LSB_JOBINDEX_END", step="LSB_JOBINDEX_STEP"),
)


def part_of_array(tasks: int, environment: Mapping[str, str] = os.environ) -> Part:
    """Return the part of this job of an array by the variables of SLURM, PBS, Grid Engine or LSF;
    without such variables the whole.

    Where the system does not tell the number of jobs, or its indices have gaps, as when some jobs
    of an array are submitted again, the array is that of ``tasks`` jobs for which the plan is.
    """

    def read(name: str, default: int) -> int:
        text = environment.get(name, "")
        return int(text) if text.isdecimal() else default

    for names in ARRAYS:
        index = read(names.index, -1)
        # Grid Engine writes "undefined" and LSF 0 for a job that is in no array.
        if index < 0 or (index == 0 and names.index == "LSB_JOBINDEX"):
            continue
        first, step = read(names.first, 1), max(1, read(names.step, 1))
        regular = (read(names.last, -1) - first) // step + 1
        count = read(names.count, regular)
        if count < 1 or count != regular:
            return Part(index, tasks)
        return Part((index - first) // step, count)
    return Part(0, 1)


class Plan(NamedTuple):
    """A planned ensemble: its directory, its scenario, the identity of its blocks, the number of
    jobs it was made for, and whether it has been merged.
    """

    directory: Path
    scenario: Scenario
    identity: RunIdentity
    tasks: int
    is_merged: bool


def plan_ensemble(
    scenario: Scenario,
    runs: int,
    out: Path | None = None,
    options: EnsembleOptions = EnsembleOptions(),  # noqa: B008 - it is immutable
    tasks: int = 1,
) -> Path:
    """Write the directory of an ensemble of ``runs`` runs, none of them simulated, and return its
    path; ``tasks`` is the number of jobs of an array for which it is.

    Raises ScenarioError and EngineError before anything is written, and WriteError.
    """
    runs = integer(low=1)("runs", runs)
    one_of(*TRACES)("trace", options.trace)
    engine = choose_engine(options.engine, scenario, announce=False)
    check_sources(scenario)
    identity = identify_runs(scenario, runs, options.trace, engine.name)
    directory = create_output_directory(out, scenario.name)
    DirectoryWriter(scenario, directory, identity, tasks).begin(None)
    return directory


def open_plan(directory: Path, trust: bool = False) -> Plan:
    """Return the plan in a directory; raises ScenarioError if there is none, it was changed, or it
    needs other versions than those here, with which the last digits would be others.
    """
    remedy = "give a directory that netkf plan wrote"
    try:
        manifest = read_manifest(directory, "DIR")
        check_seal(manifest)
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
    identity = RunIdentity(
        scenario=manifest["scenario"],
        seed=manifest["seed"],
        runs=manifest["runs"]["wanted"],
        trace=manifest.get("trace", "first"),
        engine=manifest["engine"],
    )
    return Plan(directory, scenario, identity, manifest.get("tasks", 1), is_merged)


class WorkDone(NamedTuple):
    """What a worker did: its replicas, and the numbers of runs that it simulated and that are left
    of them.
    """

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

    Results are merged before they are written. Several workers on one part do its work twice and no
    harm. Raises InterruptedRunError (a KeyboardInterrupt) when interrupted: what was finished is
    written then. Raises EngineError if a plugged-in class fails, and WriteError.
    """
    replicas, identity, scenario = part.of(plan.identity.runs), plan.identity, plan.scenario
    deadline = float("inf") if seconds is None else time.monotonic() + seconds
    if plan.is_merged or not replicas:
        return WorkDone(replicas, 0, 0)
    blocks = BlockCheckpoints(plan.directory, scenario)
    known, _ = blocks.find(identity, any_installation=True, within=replicas)
    wanted = sum(map(len, missing_ranges(known, replicas)))
    simulated, slowest, begun = 0, 0.0, time.monotonic()

    def add(node: tuple[int, int], statistics: Any, cpu_seconds: float) -> None:
        nonlocal simulated, slowest, begun
        blocks.add(node, statistics, identity, cpu_seconds)
        simulated += identity.runs_of(node)
        slowest, begun = max(slowest, time.monotonic() - begun), time.monotonic()
        if progress is not None:
            progress(simulated, wanted)

    store = BlockStore(
        dict.fromkeys(known, _nothing),
        add,
        identity.max_block,
        replicas,
        # The next block may take as long as the slowest, and none helps that was merged already.
        lambda: time.monotonic() + slowest > deadline or _was_merged(plan.directory),
    )
    engine = choose_engine(identity.engine, scenario, announce=bool(wanted))
    task = partial(block_statistics, engine=engine, traces=identity.traces)
    try:
        with explain_failures(scenario), make_pool(max(1, wanted), pool) as workers:
            replicate_blocks(
                task, _merge_nothing, scenario, identity.runs, pool=workers, store=store
            )
    except KeyboardInterrupt:
        remedy = f"; go on with netkf work {plan.directory}"
        raise InterruptedRunError(plan.directory, remedy) from None
    finally:
        if not _was_merged(plan.directory):
            blocks.write(identity)
    return WorkDone(replicas, simulated, wanted - simulated)


def _nothing() -> None:
    """Stand for the result of a stored block, which a worker does not need."""


def _merge_nothing(a: None, b: None) -> None:
    """Merge two of them."""


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

    The files are those of ``netkf run --runs`` on the machine of the workers, to the last bit. With
    ``mixed`` results may come from machines of different kinds, whose last digits may differ: the
    manifest then lists them. ``finish`` writes further files; ``note`` is called with lines about
    files that are not used. Raises ScenarioError for results of other versions, or of different
    machines unless they may be mixed, and WriteError.
    """
    started = time.perf_counter()
    writer = DirectoryWriter(plan.scenario, plan.directory, plan.identity, plan.tasks)
    writer.find_blocks(note, any_installation=True)
    missing = list(missing_ranges(writer.known, range(plan.identity.runs)))
    if missing:
        return missing
    made_by = writer.blocks.installations
    if any(installation["versions"] != versions() for installation in made_by):
        rule = "holds results of other versions, whose last digits may differ"
        raise ScenarioError("DIR", rule, str(plan.directory), "remove its blocks, and work again")
    machines = [installation["machine"] for installation in made_by]
    if len(machines) > 1 and not mixed:
        kinds = ", ".join(sorted(str(one.get("processor")) for one in machines))
        rule = "holds results of machines of different kinds, whose last digits may differ"
        raise ScenarioError("DIR", rule, kinds, "give --mixed to merge them, and the manifest says")
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
