"""``netkf run --runs``: many runs from a scenario to a directory, block by block."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from netkf.core.errors import WriteError
from netkf.core.fields import one_of, require_runs
from netkf.core.interrupts import writing_at_last
from netkf.engines.base import Engine
from netkf.ensembles.block_files import RunIdentity
from netkf.ensembles.checkpoints import BlockCheckpoints
from netkf.ensembles.monte_carlo import Ensemble, ensemble_of, ensemble_table
from netkf.ensembles.pool import Pool
from netkf.ensembles.pools import ANYWHERE, PoolOptions, make_pool
from netkf.ensembles.replicas import BlockStore, Node, Progress, replicate_blocks
from netkf.ensembles.resume import is_finished
from netkf.ensembles.statistics import RunStatistics, block_statistics, merge
from netkf.ensembles.summary import summarise_ensemble
from netkf.runs import files
from netkf.runs.failures import InterruptedRunError, explain_failure
from netkf.runs.parquet_files import ParquetSink, write_table
from netkf.runs.run import Manifest
from netkf.runs.simulate import choose_engine
from netkf.runs.summary import PromisedTraces, promise_traces
from netkf.scenario.scenario import Scenario
from netkf.trace.run import StateSamples

TRACES = ("full", "first", "none")
NOTE_SECONDS = 1.0
"""Least number of seconds between two updates of the number of finished runs in the manifest."""


@dataclass(frozen=True, eq=False)
class FinishedEnsemble:
    """The result of ``runs_to_directory``: the directory, its summary, and the data for pictures.

    ``simulated`` is the number of runs that were not resumed from blocks, ``seconds`` the
    wall-clock time until their results were written, without pictures.
    """

    directory: Path
    status: str
    summary: dict[str, Any]
    ensemble: Ensemble
    promised: PromisedTraces
    simulated: int
    seconds: float


@dataclass(frozen=True)
class EnsembleOptions:
    """How the runs of a directory are simulated.

    engine : name of the engine
    trace  : which runs store events and states, one of TRACES
    resume : continue the runs of a directory that were stopped
    pool   : where runs are simulated
    """

    engine: str = "auto"
    trace: str = "first"
    resume: bool = False
    pool: PoolOptions = ANYWHERE


DEFAULTS = EnsembleOptions()


def runs_to_directory(
    scenario: Scenario,
    runs: int,
    out: Path | None = None,
    options: EnsembleOptions = DEFAULTS,
    *,
    progress: Progress | None = None,
    finish: Callable[[FinishedEnsemble], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> FinishedEnsemble | None:
    """Simulate replicas 0 .. runs - 1 and write scenario.toml, manifest.json, ensemble.parquet,
    summary.json and traces; return the ensemble, or None if ``out`` was complete before.

    Blocks of runs are stored as they complete, and are not simulated again on resuming: all files
    are bit-identical to those without interruption. ``note`` is called with a line about blocks
    that are damaged or of another run. ``finish`` writes further files, before the manifest states
    that the directory is complete.

    Raises ScenarioError and EngineError before anything is written; later WriteError, EngineError
    if a plugged-in class fails, and InterruptedRunError (a KeyboardInterrupt) when interrupted.
    """
    started = time.perf_counter()
    runs = require_runs(runs)
    one_of(*TRACES)("trace", options.trace)
    engine_used = choose_engine(options.engine, scenario, announce=False)
    files.check_sources(scenario)
    with make_pool(runs, options.pool) as pool:
        writer = _open_directory(scenario, runs, out, options, engine_used.name)
        if writer is None:
            return None
        try:
            writer.begin(note)
            engine_used.announce(scenario)
            statistics = writer.simulate(engine_used, pool, progress)
            pool.close(at_once=False)  # its memory is not needed any more
            finished = write_files(writer, statistics, started)
            if finish is not None:
                finish(finished)
            writer.end(finished.status, statistics)
        except BaseException as error:
            reason = writer.stop(error)
            if reason is error:
                raise
            raise reason from error
    writer.blocks.remove()
    return finished


def identify_runs(scenario: Scenario, runs: int, trace: str, engine: str) -> RunIdentity:
    """Return the identity of the blocks of ``runs`` runs of a scenario."""
    return RunIdentity(files.scenario_digest(scenario), scenario.seed, runs, trace, engine)


def _open_directory(
    scenario: Scenario, runs: int, out: Path | None, options: EnsembleOptions, engine: str
) -> DirectoryWriter | None:
    """Return the writer of a directory for the results of ``runs`` runs, None if it has them."""
    plan = identify_runs(scenario, runs, options.trace, engine)
    finished = is_finished(out, scenario, plan) if options.resume else None
    if finished is None:
        return DirectoryWriter(scenario, files.create_output_directory(out, scenario.name), plan)
    assert out is not None
    if finished:
        BlockCheckpoints(out, scenario).remove()
        return None
    return DirectoryWriter(scenario, out, plan)


def write_files(
    writer: DirectoryWriter, statistics: RunStatistics, started: float
) -> FinishedEnsemble:
    """Write all files but the manifest; ``started`` is a value of the performance counter."""
    directory, scenario, plan = writer.directory, writer.scenario, writer.plan
    ensemble = ensemble_of(scenario, statistics, plan.seed, plan.engine)
    write_table(directory / "ensemble.parquet", ensemble_table(ensemble))
    if plan.trace != "none":
        with ParquetSink(directory, scenario) as tables:
            for replica, log, *arrays in writer.blocks.traces():
                tables.add(replica, log, StateSamples(*arrays))
    promised = promise_traces(scenario, scenario.times)
    summary = summarise_ensemble(scenario, statistics, promised)
    files.write_json(directory / "summary.json", summary)
    status, seconds = "diverged" if ensemble.diverged else "complete", time.perf_counter() - started
    results = summary, ensemble, promised, writer.simulated
    return FinishedEnsemble(directory, status, *results, seconds)


class DirectoryWriter:
    """Writes the blocks of an ensemble to its directory, and updates the manifest.

    ``known`` are the nodes that are stored; ``tasks`` the jobs of its plan, 0 without one.
    """

    def __init__(
        self, scenario: Scenario, directory: Path, plan: RunIdentity, tasks: int = 0
    ) -> None:
        self.known: list[Node] = []
        self._tasks = tasks
        self.scenario, self.directory, self.plan = scenario, directory, plan
        self.blocks = BlockCheckpoints(directory, scenario)
        self._manifest = Manifest.of(scenario, directory, plan.engine, runs=plan.runs)
        self._done = self.simulated = 0
        self._last_note = 0.0
        self._ended = False

    def begin(self, note: Callable[[str], None] | None) -> None:
        """Write the manifest and the scenario, and find the stored blocks of a resumed run."""
        # The manifest comes first: if the process is killed, it states that the run is unfinished.
        self.note()
        files.write_scenario(self.directory, self.scenario)
        self.find_blocks(note)
        if self.known:
            self.note()

    def find_blocks(
        self, note: Callable[[str], None] | None, any_installation: bool = False
    ) -> None:
        """Find the stored blocks; ``note`` is called with lines for the user about others."""
        self.known, lines = self.blocks.find(self.plan, any_installation)
        self._done = sum(map(self.plan.runs_of, self.known))
        if note is not None:
            for line in lines:
                note(line)

    def simulate(self, engine: Engine, pool: Pool, progress: Progress | None) -> RunStatistics:
        """Return the statistics of all runs: stored blocks are read, others simulated."""
        plan = self.plan
        known = {node: partial(self.blocks.load, node) for node in self.known}
        store = BlockStore(known, self._add, plan.max_block)
        task = partial(block_statistics, engine=engine, traces=plan.traces)
        with writing_at_last(partial(self.blocks.write, plan)):
            statistics: RunStatistics = replicate_blocks(
                task, merge, self.scenario, plan.runs, pool=pool, progress=progress, store=store
            )
        return statistics

    def _add(self, node: Node, statistics: RunStatistics, seconds: float) -> RunStatistics:
        """Keep the statistics of a block; return them without traces, which fill the memory."""
        without_traces = self.blocks.add(node, statistics, self.plan, seconds)
        self._done += self.plan.runs_of(node)
        self.simulated += self.plan.runs_of(node)
        if time.monotonic() - self._last_note >= NOTE_SECONDS:
            self.note()  # writes the number of runs done to the manifest
        return without_traces

    def note(self, status: str = "interrupted", error: BaseException | None = None) -> None:
        """Write status and progress to the manifest, unless the final manifest is written."""
        if not self._ended:
            entries = self._identity_entries(**{"tasks": self._tasks} if self._tasks else {})
            self._manifest.write(status, entries, self._done, error)
            self._last_note = time.monotonic()

    def stop(self, error: BaseException) -> BaseException:
        """Write the status after ``error`` to the manifest; return the exception to raise."""
        with contextlib.suppress(WriteError):  # as that of a full disk, which is told already
            self.blocks.write(self.plan)
        self.note("failed" if isinstance(error, Exception) else "interrupted", error)
        if isinstance(error, KeyboardInterrupt):
            remedy = f"; go on with --resume --out {self.directory}"
            return InterruptedRunError(self.directory, remedy)
        return explain_failure(self.scenario, error, self.directory)

    def end(
        self, status: str, statistics: RunStatistics, machines: Sequence[dict[str, Any]] = ()
    ) -> None:
        """Write the final manifest, after which ``note`` writes nothing any more; ``machines`` are
        those that simulated the runs if it was not this one.
        """
        events, diverged = statistics.totals.tolist()
        entries = self._identity_entries(diverged=diverged, events=events)
        entries["fingerprint"] = statistics.fingerprint
        if machines:
            entries["machine"] = machines[0]
        if len(machines) > 1:
            entries["machines"] = list(machines)
        self._manifest.write(
            status, entries, self.plan.runs, names=files.run_file_names(self.scenario)
        )
        self._ended = True

    def _identity_entries(self, **others: Any) -> dict[str, Any]:
        return {"scenario": self.plan.scenario, "trace": self.plan.trace, **others}
