"""``netkf run``: simulate a scenario once and write a directory with its results."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.contracts import describe_error
from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path, integer
from netkf.core.instants import TimeGrid
from netkf.engines.base import Engine, Progress, silent
from netkf.linalg import compiling
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.rng.streams import Streams
from netkf.runs import files
from netkf.runs.documents import file_digests, write_sealed
from netkf.runs.failures import explain_failure
from netkf.runs.outcomes import SentPerLink
from netkf.runs.parquet_files import ParquetSink
from netkf.runs.provenance import machine, versions
from netkf.runs.quantities import NetworkSink
from netkf.runs.simulate import choose_engine, require_scenario
from netkf.runs.summary import PromisedTraces, SummarySink, promise_traces, summarise
from netkf.scenario.scenario import Scenario
from netkf.scenario.usage import record_usage
from netkf.trace.recorder import Fingerprint, Recorder, Sink
from netkf.trace.run import Run

ENDINGS = {"failed": "failed", "interrupted": "was interrupted"}
"""How sentences say the status of a run with partial results."""


@dataclass(frozen=True, eq=False)
class CompletedRun:
    """A run that was written to ``directory``, with the data for a picture.

    status   : "complete" or "diverged"
    summary  : contents of summary.json
    samples  : errors and traces of P at the sample times
    promised : what theory promises at these times
    events   : number of events
    seconds  : wall-clock time of the simulation, without compiling
    engine   : name of the engine
    """

    directory: Path
    status: str
    summary: dict[str, Any]
    samples: SummarySink
    promised: PromisedTraces
    events: int
    seconds: float
    engine: str


def run_to_directory(
    scenario: Scenario,
    out: Path | None = None,
    engine: str | Engine = "auto",
    trace: str = "full",
    progress: Progress = silent,
    finish: Callable[[CompletedRun], None] | None = None,
    replica: int = 0,
) -> CompletedRun:
    """Simulate ``replica`` of a scenario into ``out`` (None: the first free runs/NAME-k).

    ``trace`` is "full", "first" (the same here) or "none" (no tables). ``finish`` may add files
    before the manifest says that the run is complete; of an interrupted or failed run the results
    until then are written, and the manifest says so.

    Raises ScenarioError and EngineError before anything is written, InterruptedRunError (a
    KeyboardInterrupt) when interrupted, and EngineError if a user's class fails.
    """
    replica = integer(low=0)("replica", replica)
    chosen_engine = choose_engine(engine, scenario, announce=False)
    name, tables = chosen_engine.name, trace != "none"
    output = _create_output(scenario, out, scenario.seed, replica, name, tables)
    choose_engine(engine, scenario)  # says that it compiles, if nothing was refused
    recorder = Recorder(output.sinks)
    is_complete = False
    try:
        start, compiled_before = time.perf_counter(), compiling.seconds_spent()
        status = chosen_engine.run(scenario, Streams(scenario.seed, replica), recorder, progress)
        seconds = time.perf_counter() - start - (compiling.seconds_spent() - compiled_before)
        is_complete = status == "complete"
        output.close_tables()
        promised = promise_traces(scenario, np.array(output.samples.times))
        summary = output.write_summary(promised, recorder.count, recorder.sums, status)
        results = summary, output.samples, promised, recorder.total
        completed = CompletedRun(output.directory, status, *results, seconds, name)
        if finish is not None:
            finish(completed)
    except BaseException as error:
        _keep_partial_results(output, recorder, is_complete, error)
        explained = explain_failure(scenario, error, output.directory)
        if explained is error:
            raise
        raise explained from error
    totals = _event_totals(recorder.total, str(output.fingerprint), recorder.stats)
    output.manifest.write(status, totals, is_complete, names=files.run_file_names(scenario))
    return completed


def save(run: Run, scenario: Scenario, directory: str | Path) -> Path:
    """Write a simulated run to a new or empty directory, as ``netkf run`` does, and return its
    path.

    The files are scenario.toml, manifest.json, the Parquet tables and summary.json. scenario.toml
    has the seed of the run, so that simulating it again gives the same files for replica 0.

    Raises ScenarioError if the run belongs to another scenario or the directory is not empty, and
    WriteError.
    """
    require_scenario(scenario, "save", ", directory", "run, ")
    directory = as_path("directory", directory)
    known = files.require_run(run)
    # A run may have another seed than its scenario, which scenario.toml of a directory then has.
    if len({files.scenario_digest(one, seed=run.seed) for one in {known, scenario}}) > 1:
        rule = "must be a run of this scenario: their keys or files differ"
        raise ScenarioError("run", rule, run, "save it with run.scenario")
    known_by = run.seed, run.replica, run.engine
    output = _create_output(scenario, directory, *known_by, tables=True, option="directory")
    for sink in output.sinks:
        sink.events(run.log)
        sink.exact_errors = run.exact_errors
        sink.states(run.times, run.x, run.xhat, run.P, run.error)
    output.close_tables()
    output.write_summary(promise_traces(scenario, run.times), run.count, run.sums, run.status)
    totals = _event_totals(len(run.log), run.fingerprint, run.stats)
    is_complete = run.status == "complete"
    output.manifest.write(run.status, totals, is_complete, names=files.run_file_names(scenario))
    return output.directory


@dataclass(frozen=True, eq=False)
class _Output:
    """A run directory with its sinks; those that are not wanted are None."""

    directory: Path
    scenario: Scenario
    samples: SummarySink
    tables: ParquetSink | None
    links: SentPerLink | None
    network: NetworkSink | None
    manifest: Manifest
    fingerprint: Fingerprint

    @property
    def sinks(self) -> list[Sink]:
        wanted = (sink for sink in (self.tables, self.links, self.network) if sink is not None)
        return [self.samples, self.fingerprint, *wanted]

    def close_tables(self) -> None:
        """Finish the Parquet tables, if the run has any; raises WriteError."""
        if self.tables is not None:
            self.tables.close()

    def write_summary(
        self,
        promised: PromisedTraces,
        count: Callable[[str], int],
        sums: dict[str, tuple[float, float]],
        status: str,
    ) -> dict[str, Any]:
        messages = {
            "sent": count("send"),
            "delivered": count("deliver"),
            "lost": count("lost") + count("late"),
        }
        network = self.network.values(status == "complete") if self.network else None
        summary = summarise(self.scenario, self.samples, promised, messages, network)
        if self.network and self.network.connectivity.changes:
            summary["connectivity"] = self.network.connectivity.entry()
        if sums:
            summary["conserved"] = {
                name: {"exact": exact, "total": total, "drift": (total - exact) / exact}
                for name, (exact, total) in sums.items()
            }
        # How much of the recorded tables (readings, losses) the run has used; a run that ended
        # early did not use all that a complete one would have.
        if status == "complete":
            usage = record_usage(self.scenario, self.links.sent.counts() if self.links else {})
            summary |= {"records": usage} if usage else {}
            if self.scenario.held_out_sensors:
                from netkf.runs.readings import errors_of_replica

                manifest = self.manifest
                summary["held_out"] = errors_of_replica(
                    self.scenario, manifest.seed, manifest.replica
                )
        files.write_json(self.directory / "summary.json", summary)
        return summary


def _create_output(
    scenario: Scenario,
    out: Path | None,
    seed: int,
    replica: int,
    engine: str,
    tables: bool,
    option: str = "--out",
) -> _Output:
    files.check_sources(scenario)
    directory = files.create_output_directory(out, scenario.name, option)
    channel = scenario.network.channel
    is_recorded = isinstance(channel.loss, RecordedLoss) or isinstance(channel.delay, RecordedDelay)
    manifest = Manifest.of(scenario, directory, engine, seed=seed, replica=replica)
    # Written first, so that the directory of a process that is killed says "interrupted".
    manifest.write("interrupted", {})
    files.write_scenario(directory, scenario, seed)
    samples = SummarySink()
    wanted = scenario.metrics.network is not False
    return _Output(
        directory=directory,
        scenario=scenario,
        samples=samples,
        tables=ParquetSink(directory, scenario, replica) if tables else None,
        links=SentPerLink() if is_recorded else None,
        network=NetworkSink(scenario, seed, replica, samples.transmissions) if wanted else None,
        manifest=manifest,
        fingerprint=Fingerprint(),
    )


def _keep_partial_results(
    output: _Output, recorder: Recorder, is_complete: bool, error: BaseException
) -> None:
    status = "failed" if isinstance(error, Exception) else "interrupted"
    for finish in (recorder.flush, output.close_tables):
        with contextlib.suppress(Exception):  # a full disk fails again, and ``error`` says so
            finish()
    if not (output.directory / "summary.json").exists():
        unknown = PromisedTraces(None, np.nan, np.nan, f"not computed: the run {ENDINGS[status]}")
        with contextlib.suppress(OSError):
            output.write_summary(unknown, recorder.count, recorder.sums, status)
    totals = _event_totals(recorder.total, str(output.fingerprint), recorder.stats)
    output.manifest.write(status, totals, is_complete, error)


def _event_totals(events: int, fingerprint: str, stats: dict[str, int]) -> dict[str, Any]:
    """Return the entries of the manifest about events; ``stats`` are counts of SimPy, if any."""
    totals: dict[str, Any] = {"events": events, "fingerprint": fingerprint}
    return totals | ({"simpy": stats} if stats else {})


@dataclass(frozen=True, eq=False)
class Manifest:
    """The manifest.json of a directory of ``runs`` runs, numbered from ``replica`` on, with their
    instants on ``time_grid``, of a network whose nodes have ``node_names``: ids by name.
    """

    directory: Path
    name: str
    seed: int
    replica: int
    engine: str
    time_grid: TimeGrid
    runs: int = 1
    node_names: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, scenario: Scenario, directory: Path, engine: str, **others: Any) -> Manifest:
        """Return the manifest of runs from replica 0 on, unless ``others`` say so."""
        given = {"seed": scenario.seed, "replica": 0, **others}
        names, grid = scenario.topology.names, scenario.time_grid
        return cls(
            directory, scenario.name, engine=engine, time_grid=grid, node_names=names, **given
        )

    def write(
        self,
        status: str,
        totals: dict[str, Any],
        completed_runs: int = 0,
        error: BaseException | None = None,
        names: Iterable[str] = (),
    ) -> None:
        """Write manifest.json: status, ``totals``, completed runs, the ``error`` of a failed run,
        and digests of files among ``names`` and of itself. Raises WriteError.
        """
        manifest: dict[str, Any] = {
            "name": self.name,
            "versions": versions(),
            "machine": machine(),
            "seed": self.seed,
            "replica": self.replica,
            "runs": {"wanted": self.runs, "done": int(completed_runs)},
            "engine": self.engine,
            "status": status,
            "time": self.time_grid.as_table(),
            **({"node_names": dict(self.node_names)} if self.node_names else {}),
            **totals,
        }
        if status == "failed" and error is not None:
            manifest["error"] = describe_error(error)
            manifest["traceback"] = traceback.format_exception(error)
        others = [name for name in names if name != "manifest.json"]
        if others:
            manifest["files"] = file_digests(self.directory, others)
        write_sealed(self.directory / "manifest.json", manifest)
