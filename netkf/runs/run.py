"""``netkf run``: one run from a scenario to a directory with everything that happened."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable
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
from netkf.runs.failures import explain_failure
from netkf.runs.files import (
    ParquetSink,
    check_sources,
    new_directory,
    write_json,
    write_scenario,
)
from netkf.runs.provenance import machine, versions
from netkf.runs.simulate import choose_engine
from netkf.runs.summary import Promise, SummarySink, conserved, promise, summarise
from netkf.runs.transmissions import SentPerLink
from netkf.scenario.plugins import in_words
from netkf.scenario.scenario import Scenario
from netkf.scenario.usage import record_usage
from netkf.trace.recorder import Recorder
from netkf.trace.run import Run


@dataclass(frozen=True, eq=False)
class CompletedRun:
    """What ``run_to_directory`` leaves: the directory, its summary, and what a picture needs."""

    directory: Path
    status: str
    summary: dict[str, Any]
    samples: SummarySink
    promised: Promise
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

    ``trace`` is full, first (the same for a single run) or none (no tables). ``finish`` adds what
    else belongs to the directory, before the manifest says that it is complete. A run that is
    interrupted or fails keeps what it had: the files are finished, the manifest says
    ``interrupted``, or ``failed`` with the error. Raises ScenarioError and EngineError before
    anything is written, InterruptedRunError (a KeyboardInterrupt) when interrupted, and EngineError
    where a plugged-in class fails.
    """
    replica = integer(low=0)("replica", replica)
    chosen = choose_engine(engine, scenario)
    check_sources(scenario)
    directory = new_directory(out, scenario.name)
    write_scenario(directory, scenario)
    samples, tables = SummarySink(), ParquetSink(directory, scenario, replica, trace != "none")
    links = _link_counts(scenario)
    recorder = Recorder([samples, tables, *links])
    manifest = Manifest(directory, scenario.name, scenario.seed, replica, chosen.name)
    # Written at once, so that a run that is killed outright says that it did not finish.
    manifest.write("interrupted", {})
    began, compiled, done = time.perf_counter(), compiling.seconds_spent(), False
    try:
        status = chosen.run(scenario, Streams(scenario.seed, replica), recorder, progress)
        compiled = compiling.seconds_spent() - compiled
        seconds, done = time.perf_counter() - began - compiled, status == "complete"
        tables.close()
        promised = promise(scenario, np.array(samples.times))
        counts = recorder.count, recorder.sums, _records(scenario, status, links)
        summary = _summary(directory, scenario, samples, promised, *counts)
        finished = CompletedRun(
            directory, status, summary, samples, promised, recorder.total, seconds, chosen.name
        )
        if finish is not None:
            finish(finished)
    except BaseException as error:
        status = "failed" if isinstance(error, Exception) else "interrupted"
        for finished_off in (recorder.flush, tables.close):
            with contextlib.suppress(Exception):  # a full disk fails again, and ``error`` says so
                finished_off()
        if not (directory / "summary.json").exists():
            nothing = Promise(None, np.nan, np.nan, f"not computed: the run {ENDS[status]}")
            with contextlib.suppress(OSError):
                _summary(directory, scenario, samples, nothing, recorder.count, recorder.sums)
        manifest.write(status, _totals(recorder), done, error)
        reason = explain_failure(scenario, error, directory)
        if reason is error:
            raise
        raise reason from error
    manifest.write(status, _totals(recorder), done)
    return finished


def save(run: Run, scenario: Scenario, directory: str | Path) -> Path:
    """Write a run that is in memory as ``netkf run`` would have: scenario.toml, manifest.json, the
    Parquet tables and summary.json; returns the directory, which must be new or empty.

    The scenario.toml carries the run's seed; running it again gives the same files for replica 0.
    Raises ScenarioError where the run is of another scenario.
    """
    if run.nodes != scenario.nodes or run.x.shape[1] != scenario.plant.n:
        rule = "must be a run of this scenario: its nodes or its state differ"
        raise ScenarioError("run", rule, run, "save it with the scenario it was simulated from")
    check_sources(scenario)
    folder = new_directory(Path(directory), scenario.name)
    write_scenario(folder, scenario, run.seed)
    manifest = Manifest(folder, scenario.name, run.seed, run.replica, run.engine)
    manifest.write("interrupted", {})
    samples, tables = SummarySink(), ParquetSink(folder, scenario, run.replica, True)
    links = _link_counts(scenario)
    for sink in (samples, tables, *links):
        sink.events(run.log)
        sink.exact_errors = run.exact_errors
        sink.states(run.times, run.x, run.xhat, run.P, run.error)
    tables.close()
    counts = run.count, run.sums, _records(scenario, run.status, links)
    _summary(folder, scenario, samples, promise(scenario, run.times), *counts)
    totals: dict[str, Any] = {"events": len(run.log), "fingerprint": run.fingerprint}
    totals |= {"simpy": run.stats} if run.stats else {}
    manifest.write(run.status, totals, run.status == "complete")
    return folder


def _link_counts(scenario: Scenario) -> list[SentPerLink]:
    """What counts the messages of each link, if a record of losses or delays needs it."""
    channel = scenario.network.channel
    by_message = isinstance(channel.loss, RecordedLoss) or isinstance(channel.delay, RecordedDelay)
    return [SentPerLink()] if by_message else []


def _records(scenario: Scenario, status: str, links: list[SentPerLink]) -> dict[str, Any]:
    """What the run used of its records; nothing of a run that did not reach the horizon."""
    if status != "complete":
        return {}
    return record_usage(scenario, links[0].sent if links else {})


def _totals(recorder: Recorder) -> dict[str, Any]:
    totals: dict[str, Any] = {"events": recorder.total, "fingerprint": recorder.fingerprint}
    return totals | ({"simpy": recorder.stats} if recorder.stats else {})


ENDS = {"failed": "failed", "interrupted": "was interrupted"}


def _summary(
    directory: Path,
    scenario: Scenario,
    samples: SummarySink,
    promised: Promise,
    count: Callable[[str], int],
    sums: dict[str, tuple[float, float]],
    records: dict[str, Any] | None = None,
) -> dict[str, Any]:
    messages = {
        "sent": count("send"),
        "delivered": count("deliver"),
        "lost": count("lost") + count("late"),
    }
    summary = summarise(scenario, samples, promised, messages)
    if sums:
        summary["conserved"] = conserved(sums)
    if records:
        summary["records"] = records
    write_json(directory / "summary.json", summary)
    return summary


@dataclass(frozen=True, eq=False)
class Manifest:
    """``manifest.json`` of a directory of one run, or of ``wanted`` runs from ``replica`` on."""

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
    ) -> None:
        """Say how the run stands."""
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
            manifest["error"] = in_words(error)
            manifest["traceback"] = traceback.format_exception(error)
        write_json(self.directory / "manifest.json", manifest)
