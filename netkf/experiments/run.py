"""``netkf run``: one run from a scenario to a directory with everything that happened."""

from __future__ import annotations

import platform
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import netkf
from netkf.core.streams import Streams
from netkf.engines.base import Progress, silent
from netkf.experiments.files import (
    ParquetSink,
    check_sources,
    new_directory,
    write_json,
    write_scenario,
)
from netkf.experiments.simulate import choose_engine
from netkf.experiments.summary import Promise, SummarySink, conserved, promise, summarise
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import Recorder


@dataclass(frozen=True, eq=False)
class Finished:
    """What ``run_to_directory`` leaves: the directory, its summary, and what a picture needs."""

    directory: Path
    status: str
    summary: dict[str, Any]
    samples: SummarySink
    promised: Promise
    events: int
    seconds: float


def run_to_directory(
    scenario: Scenario,
    out: Path | None = None,
    engine: str = "auto",
    trace: str = "full",
    progress: Progress = silent,
) -> Finished:
    """Run once and write scenario.toml, manifest.json, the Parquet tables and summary.json.

    ``trace`` is full, first (the same for a single run) or none (no tables). A run that is
    interrupted keeps what it had: the files are finished, the manifest says ``interrupted``, and
    KeyboardInterrupt goes on. Raises ScenarioError and EngineError before anything is written.
    """
    chosen = choose_engine(engine, scenario)
    check_sources(scenario)
    directory = new_directory(out, scenario.name)
    write_scenario(directory, scenario)
    samples, tables = SummarySink(), ParquetSink(directory, scenario, 0, trace != "none")
    recorder = Recorder([samples, tables])
    manifest = {
        "name": scenario.name,
        "versions": {
            "netkf": netkf.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "seed": scenario.seed,
        "runs": {"wanted": 1, "done": 0},
        "engine": chosen.name,
    }
    # Written at once, so that a run that is killed outright says that it did not finish.
    status, began = "interrupted", time.perf_counter()
    write_json(directory / "manifest.json", {**manifest, "status": status})
    try:
        status = chosen.run(scenario, Streams(scenario.seed, 0), recorder, progress)
    finally:
        seconds = time.perf_counter() - began
        tables.close()
        manifest["runs"] = {"wanted": 1, "done": int(status == "complete")}
        manifest |= {
            "status": status,
            "events": recorder.total,
            "fingerprint": recorder.fingerprint,
        }
        write_json(directory / "manifest.json", manifest)
    promised = promise(scenario, np.array(samples.times))
    messages = {
        "sent": recorder.count("send"),
        "delivered": recorder.count("deliver"),
        "lost": recorder.count("lost") + recorder.count("late"),
    }
    summary = summarise(scenario, samples, promised, messages)
    if recorder.sums:
        summary["conserved"] = conserved(recorder.sums)
    write_json(directory / "summary.json", summary)
    return Finished(directory, status, summary, samples, promised, recorder.total, seconds)
