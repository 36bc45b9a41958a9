"""``netkf run --runs``: many runs from a scenario to a directory, block by block."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from netkf.core.fields import integer, one_of
from netkf.ensembles.checkpoints import BlockCheckpoints, RunIdentity
from netkf.ensembles.monte_carlo import Ensemble, ensemble_of, ensemble_table
from netkf.ensembles.pool import Pool, block_size
from netkf.ensembles.pools import ANYWHERE, PoolOptions, make_pool
from netkf.ensembles.replicas import NumberedBlocks, Progress, replicate_blocks
from netkf.ensembles.resume import find_stored_blocks
from netkf.ensembles.statistics import RunStatistics, block_statistics, merge
from netkf.ensembles.summary import summarise_ensemble
from netkf.runs.failures import InterruptedRunError, explain_failure
from netkf.runs.files import (
    check_sources,
    create_output_directory,
    run_file_names,
    scenario_digest,
    write_json,
    write_scenario,
)
from netkf.runs.parquet_files import ParquetSink, write_table
from netkf.runs.provenance import installation_digest
from netkf.runs.run import Manifest
from netkf.runs.simulate import choose_engine
from netkf.runs.summary import PromisedTraces, promise_traces
from netkf.scenario.scenario import Scenario
from netkf.trace.run import StateSamples

TRACES = ("full", "first", "none")
MAX_TRACED_BLOCK = 8
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
    summary.json and the events and states of the traced runs; return the ensemble, or None if
    ``out`` was complete before.

    Blocks of runs are stored in the directory as they complete. When resuming, the stored blocks
    are not simulated again, and all files are bit-identical to those without interruption. Blocks
    that are damaged or belong to another run are simulated again, and ``note`` is called with a
    line about them. ``finish`` writes further files, before the manifest states that the directory
    is complete.

    Raises ScenarioError and EngineError before anything is written; later WriteError, EngineError
    if a plugged-in class fails, and InterruptedRunError (a KeyboardInterrupt) when interrupted.
    """
    started = time.perf_counter()
    runs = integer(low=1)("runs", runs)
    one_of(*TRACES)("trace", options.trace)
    engine_used = choose_engine(options.engine, scenario, announce=False)
    check_sources(scenario)
    with make_pool(runs, options.pool) as pool:
        writer = _open_directory(scenario, runs, out, options, engine_used.name, pool.width)
        if writer is None:
            return None
        try:
            writer.begin(note)
            engine_used.announce(scenario)
            task = partial(block_statistics, engine=engine_used, traces=writer.traces)
            statistics = writer.simulate(task, pool, progress)
            pool.close(at_once=False)  # its memory is not needed any more
            finished = _write_files(writer, statistics, started)
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


def _open_directory(
    scenario: Scenario,
    runs: int,
    out: Path | None,
    options: EnsembleOptions,
    engine: str,
    width: int,
) -> _DirectoryWriter | None:
    """Return the writer of a new directory for the results of ``runs`` runs."""
    size = block_size(runs, width)
    if options.trace == "full":
        size = min(size, MAX_TRACED_BLOCK)  # events of all runs of a block are in memory
    plan = RunIdentity(
        scenario=scenario_digest(scenario),
        seed=scenario.seed,
        runs=runs,
        trace=options.trace,
        engine=engine,
        installation=installation_digest(),
        block=size,
    )
    unfinished = find_stored_blocks(out, scenario, plan) if options.resume else None
    if unfinished is None:
        return _DirectoryWriter(scenario, create_output_directory(out, scenario.name), plan)
    if unfinished.finished:
        BlockCheckpoints(unfinished.directory, scenario).remove()
        return None
    # Blocks on disk are only of use to a plan with blocks of the same size.
    return _DirectoryWriter(scenario, unfinished.directory, replace(plan, block=unfinished.block))


def _write_files(
    writer: _DirectoryWriter, statistics: RunStatistics, started: float
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
    write_json(directory / "summary.json", summary)
    return FinishedEnsemble(
        directory,
        "diverged" if ensemble.diverged else "complete",
        summary,
        ensemble,
        promised,
        writer.simulated,
        time.perf_counter() - started,
    )


class _DirectoryWriter:
    """Writes the blocks of an ensemble to its directory, and updates the manifest."""

    def __init__(self, scenario: Scenario, directory: Path, plan: RunIdentity) -> None:
        self.scenario, self.directory, self.plan = scenario, directory, plan
        self.blocks = BlockCheckpoints(directory, scenario)
        self._manifest = Manifest(
            directory=directory,
            name=scenario.name,
            seed=scenario.seed,
            replica=0,
            engine=plan.engine,
            runs=plan.runs,
            node_names=scenario.topology.names,
            time_grid=scenario.time_grid,
        )
        self._known: list[int] = []
        self._done = self.simulated = 0
        self._last_note = 0.0
        self._ended = False

    @property
    def traces(self) -> int:
        """Number of replicas that leave a trace."""
        return {"full": self.plan.runs, "first": 1, "none": 0}[self.plan.trace]

    def begin(self, note: Callable[[str], None] | None) -> None:
        """Write the manifest and the scenario, and find the stored blocks of a resumed run."""
        # The manifest comes first: if the process is killed, it states that the run is unfinished.
        self.note()
        write_scenario(self.directory, self.scenario)
        self._known, lines = self.blocks.find(self.plan)
        if note is not None:
            for line in lines:
                note(line)
        self._done = sum(map(self._runs_in_block, self._known))
        self.note()

    def simulate(
        self, task: Callable[..., RunStatistics], pool: Pool, progress: Progress | None
    ) -> RunStatistics:
        """Return the statistics of all runs: stored blocks are read, others simulated."""
        finished_blocks = {number: partial(self.blocks.load, number) for number in self._known}
        blocks = NumberedBlocks(self.plan.block, finished_blocks, self.save_block)
        statistics: RunStatistics = replicate_blocks(
            task, merge, self.scenario, self.plan.runs, pool=pool, progress=progress, blocks=blocks
        )
        return statistics

    def _runs_in_block(self, number: int) -> int:
        return min(self.plan.block, self.plan.runs - number * self.plan.block)

    def save_block(self, number: int, statistics: RunStatistics) -> RunStatistics:
        """Store block ``number``; return its statistics without traces, which fill the memory."""
        self.blocks.save(number, statistics, self.plan)
        self._done += self._runs_in_block(number)
        self.simulated += self._runs_in_block(number)
        if time.monotonic() - self._last_note >= NOTE_SECONDS:
            self.note()  # writes the number of runs done to the manifest
        return statistics._replace(traces=())

    def note(self, status: str = "interrupted", error: BaseException | None = None) -> None:
        """Write status and progress to the manifest, unless the final manifest is written."""
        if not self._ended:
            self._manifest.write(
                status, self._identity_entries(block=self.plan.block), self._done, error
            )
            self._last_note = time.monotonic()

    def stop(self, error: BaseException) -> BaseException:
        """Write the status after ``error`` to the manifest; return the exception to raise."""
        self.note("failed" if isinstance(error, Exception) else "interrupted", error)
        if isinstance(error, KeyboardInterrupt):
            return InterruptedRunError(
                self.directory, f"; go on with --resume --out {self.directory}"
            )
        return explain_failure(self.scenario, error, self.directory)

    def end(self, status: str, statistics: RunStatistics) -> None:
        """Write the final manifest, after which ``note`` writes nothing any more."""
        entries = self._identity_entries(
            # totals: numbers of events and of diverged runs
            diverged=int(statistics.totals[1]),
            events=int(statistics.totals[0]),
        )
        entries["fingerprint"] = statistics.fingerprint
        self._manifest.write(status, entries, self.plan.runs, names=run_file_names(self.scenario))
        self._ended = True

    def _identity_entries(self, **others: Any) -> dict[str, Any]:
        return {"scenario": self.plan.scenario, "trace": self.plan.trace, **others}
