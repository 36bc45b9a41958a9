"""``netkf run``: simulate a scenario once and write a directory with its results."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import integer
from netkf.engines.base import Engine, Progress, silent
from netkf.linalg import compiling
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.rng.streams import Streams
from netkf.runs.documents import file_digests, write_sealed
from netkf.runs.failures import explain_failure
from netkf.runs.files import (
    check_sources,
    new_directory,
    own_names,
    write_json,
    write_scenario,
)
from netkf.runs.parquet_files import ParquetSink
from netkf.runs.provenance import machine, versions
from netkf.runs.simulate import choose_engine
from netkf.runs.summary import (
    PromisedTraces,
    SummarySink,
    conserved_sums,
    promise_traces,
    summarise,
)
from netkf.runs.transmissions import SentPerLink
from netkf.scenario.plugins import describe_error
from netkf.scenario.scenario import Scenario
from netkf.scenario.usage import record_usage
from netkf.trace.recorder import Recorder, Sink
from netkf.trace.run import Run

ENDINGS = {"failed": "failed", "interrupted": "was interrupted"}


@dataclass(frozen=True, eq=False)
class CompletedRun:
    """A run that was written to ``directory``, with its summary and the samples for a picture.

    events: number of events; seconds: wall-clock time of the simulation without compiling.
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
    """Run once, as ``replica`` of an ensemble, and write scenario.toml, manifest.json, the Parquet
    tables and summary.json.

    ``trace`` is full, first (the same for a single run) or none (no tables). ``finish`` adds its
    files to the directory before the manifest says that the run is complete. A run that is
    interrupted or fails keeps its results until then: the files are finished, the manifest says
    ``interrupted``, or ``failed`` with the error.

    Raises ScenarioError and EngineError before anything is written, InterruptedRunError (a
    KeyboardInterrupt) when interrupted, and EngineError if a user's class fails.
    """
    replica = integer(low=0)("replica", replica)
    chosen = choose_engine(engine, scenario)
    output = _create_output(scenario, out, scenario.seed, replica, chosen.name, trace != "none")
    recorder = Recorder(output.sinks)
    done = False
    try:
        status, seconds = _simulate(chosen, scenario, replica, recorder, progress)
        done = status == "complete"
        output.tables.close()
        promised = promise_traces(scenario, np.array(output.samples.times))
        summary = output.write_summary(promised, recorder.count, recorder.sums, status)
        completed = CompletedRun(
            output.directory,
            status,
            summary,
            output.samples,
            promised,
            recorder.total,
            seconds,
            chosen.name,
        )
        if finish is not None:
            finish(completed)
    except BaseException as error:
        _keep_partial_results(output, recorder, done, error)
        explained = explain_failure(scenario, error, output.directory)
        if explained is error:
            raise
        raise explained from error
    output.manifest.write(status, _event_totals(recorder), done, names=own_names(scenario))
    return completed


def save(run: Run, scenario: Scenario, directory: str | Path) -> Path:
    """Write a run that is in memory as ``netkf run`` would have: scenario.toml, manifest.json, the
    Parquet tables and summary.json; return the directory, which must be new or empty.

    The scenario.toml carries the run's seed; running it again gives the same files for replica 0.
    Raises ScenarioError if the run belongs to another scenario.
    """
    if run.nodes != scenario.nodes or run.x.shape[1] != scenario.plant.n:
        rule = "must be a run of this scenario: its nodes or its state differ"
        raise ScenarioError("run", rule, run, "save it with the scenario it was simulated from")
    output = _create_output(scenario, Path(directory), run.seed, run.replica, run.engine, True)
    for sink in output.sinks:
        sink.events(run.log)
        sink.exact_errors = run.exact_errors
        sink.states(run.times, run.x, run.xhat, run.P, run.error)
    output.tables.close()
    output.write_summary(promise_traces(scenario, run.times), run.count, run.sums, run.status)
    totals: dict[str, Any] = {"events": len(run.log), "fingerprint": run.fingerprint}
    totals |= {"simpy": run.stats} if run.stats else {}
    done = run.status == "complete"
    output.manifest.write(run.status, totals, done, names=own_names(scenario))
    return output.directory


@dataclass(frozen=True, eq=False)
class _Output:
    """The directory of a run with the sinks that fill it; ``links`` is empty or counts the messages
    of each link, which only records of losses or delays need.
    """

    directory: Path
    scenario: Scenario
    samples: SummarySink
    tables: ParquetSink
    links: list[SentPerLink]
    manifest: Manifest

    @property
    def sinks(self) -> list[Sink]:
        """All sinks, to record a run with."""
        return [self.samples, self.tables, *self.links]

    def write_summary(
        self,
        promised: PromisedTraces,
        count: Callable[[str], int],
        sums: dict[str, tuple[float, float]],
        status: str,
    ) -> dict[str, Any]:
        """Write and return summary.json; ``count`` gives the number of events of a kind."""
        messages = {
            "sent": count("send"),
            "delivered": count("deliver"),
            "lost": count("lost") + count("late"),
        }
        summary = summarise(self.scenario, self.samples, promised, messages)
        if sums:
            summary["conserved"] = conserved_sums(sums)
        # A run that ended early says nothing about how much of a record it would have used.
        if status == "complete":
            usage = record_usage(self.scenario, self.links[0].sent if self.links else {})
            summary |= {"records": usage} if usage else {}
        write_json(self.directory / "summary.json", summary)
        return summary


def _create_output(
    scenario: Scenario, out: Path | None, seed: int, replica: int, engine: str, tables: bool
) -> _Output:
    """Create the run directory with its scenario and a manifest; ``tables`` asks for Parquet files.

    Raises ScenarioError if the directory is not empty or a file of the scenario is in the way.
    """
    check_sources(scenario)
    directory = new_directory(out, scenario.name)
    channel = scenario.network.channel
    by_message = isinstance(channel.loss, RecordedLoss) or isinstance(channel.delay, RecordedDelay)
    manifest = Manifest(directory, scenario.name, seed, replica, engine)
    # Written first, so that a run that is killed outright says that it did not finish.
    manifest.write("interrupted", {})
    write_scenario(directory, scenario, seed)
    return _Output(
        directory,
        scenario,
        SummarySink(),
        ParquetSink(directory, scenario, replica, tables),
        [SentPerLink()] if by_message else [],
        manifest,
    )


def _simulate(
    engine: Engine, scenario: Scenario, replica: int, recorder: Recorder, progress: Progress
) -> tuple[str, float]:
    """Return the status of a run and its wall-clock seconds, those spent compiling left out."""
    began, compiled = time.perf_counter(), compiling.seconds_spent()
    status = engine.run(scenario, Streams(scenario.seed, replica), recorder, progress)
    compiled = compiling.seconds_spent() - compiled
    return status, time.perf_counter() - began - compiled


def _keep_partial_results(
    output: _Output, recorder: Recorder, done: bool, error: BaseException
) -> None:
    """Finish the files of a run that stopped with ``error`` and write the error to its manifest."""
    status = "failed" if isinstance(error, Exception) else "interrupted"
    for finish in (recorder.flush, output.tables.close):
        with contextlib.suppress(Exception):  # a full disk fails again, and ``error`` says so
            finish()
    if not (output.directory / "summary.json").exists():
        unknown = PromisedTraces(None, np.nan, np.nan, f"not computed: the run {ENDINGS[status]}")
        with contextlib.suppress(OSError):
            output.write_summary(unknown, recorder.count, recorder.sums, status)
    output.manifest.write(status, _event_totals(recorder), done, error)


def _event_totals(recorder: Recorder) -> dict[str, Any]:
    """Return number and fingerprint of the events for the manifest."""
    totals: dict[str, Any] = {"events": recorder.total, "fingerprint": recorder.fingerprint}
    return totals | ({"simpy": recorder.stats} if recorder.stats else {})


@dataclass(frozen=True, eq=False)
class Manifest:
    """The manifest.json of a directory of one run, or of ``wanted`` runs from ``replica`` on."""

    directory: Path
    name: str
    seed: int
    replica: int
    engine: str
    wanted: int = 1

    def write(
        self,
        status: str,
        totals: dict[str, Any],
        done: int = 0,
        error: BaseException | None = None,
        names: Iterable[str] = (),
    ) -> None:
        """Write manifest.json with the status, the totals, the number of runs that are done, the
        digests of the files with these ``names``, and its own digest.
        """
        manifest: dict[str, Any] = {
            "name": self.name,
            "versions": versions(),
            "machine": machine(),
            "seed": self.seed,
            "replica": self.replica,
            "runs": {"wanted": self.wanted, "done": int(done)},
            "engine": self.engine,
            "status": status,
            **totals,
        }
        if status == "failed" and error is not None:
            manifest["error"] = describe_error(error)
            manifest["traceback"] = traceback.format_exception(error)
        others = [name for name in names if name != "manifest.json"]
        if others:
            manifest["files"] = file_digests(self.directory, others)
        write_sealed(self.directory / "manifest.json", manifest)
