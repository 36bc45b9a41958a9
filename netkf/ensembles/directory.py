"""``netkf run --runs``: many runs from a scenario to a directory, block by block."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from netkf.core.errors import ScenarioError
from netkf.core.fields import choice, integer
from netkf.ensembles.checkpoints import BlockCheckpoints
from netkf.ensembles.monte_carlo import Ensemble, ensemble_of, ensemble_table
from netkf.ensembles.pools import block_size, make_pool
from netkf.ensembles.replicas import Progress, replicate_blocks
from netkf.ensembles.statistics import RunStatistics, block_statistics, merge
from netkf.ensembles.summary import summarise_ensemble
from netkf.runs.failures import InterruptedRunError, explain_failure
from netkf.runs.files import (
    TraceTables,
    check_sources,
    new_directory,
    remove_own,
    scenario_digest,
    write_json,
    write_scenario,
    write_table,
)
from netkf.runs.provenance import versions
from netkf.runs.run import Manifest
from netkf.runs.simulate import choose_engine
from netkf.runs.summary import PromisedTraces, promise_traces
from netkf.scenario.scenario import Scenario
from netkf.scenario.writing import resolved, to_toml

TRACES = ("full", "first", "none")
LARGEST_TRACED = 8


@dataclass(frozen=True, eq=False)
class FinishedEnsemble:
    """What ``runs_to_directory`` leaves: the directory, its summary, and what a picture needs."""

    directory: Path
    status: str
    summary: dict[str, Any]
    ensemble: Ensemble
    promised: PromisedTraces
    simulated: int
    seconds: float


@dataclass(frozen=True, eq=False)
class _Plan:
    """What has to be the same for a run to go on where it was stopped."""

    scenario: str
    runs: int
    trace: str
    block: int

    def manifest_entries(self, ended: bool) -> dict[str, Any]:
        """Return the entries for the manifest; once the runs ended, the block size is left out."""
        block = {} if ended else {"block": self.block}
        return {"scenario": self.scenario, "trace": self.trace, **block}


def runs_to_directory(
    scenario: Scenario,
    runs: int,
    out: Path | None = None,
    engine: str = "auto",
    trace: str = "first",
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    finish: Callable[[FinishedEnsemble], None] | None = None,
) -> FinishedEnsemble | None:
    """Simulate replicas 0 .. runs - 1 and write scenario.toml, manifest.json, ensemble.parquet,
    summary.json and, for all runs (``trace`` full), the first or none, events and states.

    Blocks of runs are kept in the directory as they are done; with ``resume`` those that ``out``
    has are not done again, and the files come out the same to the last bit; None where all was
    done before. ``finish`` adds what else belongs to the directory, before the manifest says that
    it is complete. Raises
    ScenarioError and EngineError before anything is written, InterruptedRunError (a
    KeyboardInterrupt) when interrupted, and EngineError where a plugged-in class fails.
    """
    began = time.perf_counter()
    runs, trace = integer(low=1)("runs", runs), choice(*TRACES)("trace", trace)
    engine_used = choose_engine(engine, scenario)
    chosen = engine_used.name
    check_sources(scenario)
    pool = make_pool(runs, workers, executor, scheduler)
    size = block_size(runs, pool.width)
    size = min(size, LARGEST_TRACED) if trace == "full" else size
    plan = _Plan(scenario_digest(scenario), runs, trace, size)
    directory, plan = _directory(scenario, out, resume, plan, chosen)
    manifest = Manifest(directory, scenario.name, scenario.seed, 0, chosen, runs)
    blocks = BlockCheckpoints(directory)
    if resume and is_finished(directory):
        blocks.remove()
        return None
    keeper = _Keeper(manifest, blocks, plan)
    try:
        keeper.note()
        if not (directory / "scenario.toml").exists():
            write_scenario(directory, scenario)
        traces = {"full": runs, "first": 1, "none": 0}[trace]
        whole = replicate_blocks(
            partial(block_statistics, engine=engine_used, traces=traces),
            merge,
            scenario,
            runs,
            pool=pool,
            progress=progress,
            block=plan.block,
            known={number: partial(blocks.load, number) for number in keeper.before},
            received=keeper.received,
        )
        written = _write(directory, scenario, whole, chosen, trace, blocks)
        finished = FinishedEnsemble(*written, keeper.simulated, time.perf_counter() - began)
        if finish is not None:
            finish(finished)
    except BaseException as error:
        status = "failed" if isinstance(error, Exception) else "interrupted"
        keeper.note(status, error)
        reason = explain_failure(scenario, error, directory)
        if isinstance(error, KeyboardInterrupt):
            reason = InterruptedRunError(directory, f"; go on with --resume --out {directory}")
        if reason is error:
            raise
        raise reason from error
    totals = {"diverged": int(whole.totals[1]), "events": int(whole.totals[0])}
    totals["fingerprint"] = whole.fingerprint
    manifest.write(finished.status, {**plan.manifest_entries(ended=True), **totals}, runs)
    blocks.remove()
    return finished


def _write(
    directory: Path,
    scenario: Scenario,
    whole: RunStatistics,
    engine: str,
    trace: str,
    blocks: BlockCheckpoints,
) -> tuple[Path, str, dict[str, Any], Ensemble, PromisedTraces]:
    """All files but the manifest."""
    ensemble = ensemble_of(scenario, whole, scenario.seed, engine)
    write_table(directory / "ensemble.parquet", ensemble_table(ensemble))
    if trace != "none":
        tables = TraceTables(directory, scenario)
        for run in blocks.traces():
            tables.add(*run)
        tables.close()
    promised = promise_traces(scenario, scenario.times)
    summary = summarise_ensemble(scenario, whole, promised)
    write_json(directory / "summary.json", summary)
    status = "diverged" if ensemble.diverged else "complete"
    return directory, status, summary, ensemble, promised


class _Keeper:
    """Keeps blocks as they come, and the manifest up to date."""

    def __init__(self, manifest: Manifest, blocks: BlockCheckpoints, plan: _Plan) -> None:
        self._manifest, self._blocks, self._plan = manifest, blocks, plan
        self.before = blocks.numbers()
        self._done = sum(map(self._runs, self.before))
        self.simulated = 0

    def _runs(self, number: int) -> int:
        return min(self._plan.block, self._plan.runs - number * self._plan.block)

    def received(self, number: int, found: RunStatistics) -> RunStatistics:
        """Save a block; its traces stay on disk."""
        self._blocks.save(number, found)
        self._done += self._runs(number)
        self.simulated += self._runs(number)
        self.note()
        return found._replace(traces=())

    def note(self, status: str = "interrupted", error: BaseException | None = None) -> None:
        """Say how the runs stand."""
        self._manifest.write(status, self._plan.manifest_entries(ended=False), self._done, error)


def _directory(
    scenario: Scenario, out: Path | None, resume: bool, plan: _Plan, engine: str
) -> tuple[Path, _Plan]:
    """Return the directory to write to, and the plan with the block size that was begun with."""
    if not resume:
        return new_directory(out, scenario.name), plan
    if out is None:
        remedy = "add --out DIR with the directory of the run that was stopped"
        raise ScenarioError("--resume", "needs the directory to go on in", None, remedy)
    if not (out / "manifest.json").exists():
        for part in out.glob("manifest.json.part"):
            part.unlink()
        return new_directory(out, scenario.name), plan
    found = read_manifest(out)
    same = {
        "scenario": (plan.scenario, "give the same scenario, seed and settings"),
        "trace": (plan.trace, "give the same --trace"),
        "engine": (engine, "give the same --engine"),
        "versions": (versions(), "go on with the versions that it was begun with"),
    }
    if found.get("runs", {}).get("wanted") != plan.runs:
        words, value = "the run was begun with another number of runs", found.get("runs")
        raise ScenarioError("--resume", words, value, "give the same --runs")
    for key, (wanted, remedy) in same.items():
        if found.get(key) != wanted:
            words = f"{out} holds a run of another {key.removesuffix('s')}"
            raise ScenarioError("--resume", words, found.get(key), remedy)
    return out, replace(plan, block=found.get("block", plan.block))


def is_finished(directory: Path) -> bool:
    """Return True if all runs of a directory are done and written."""
    if not (directory / "manifest.json").exists():
        return False
    return read_manifest(directory).get("status") in ("complete", "diverged")


def clear_unfinished(directory: Path, scenario: Scenario, replica: int = 0) -> bool:
    """Make room for a single run that was stopped to be done again; False where it is finished.

    Raises ScenarioError where the directory holds a run of another scenario or replica.
    """
    if not (directory / "manifest.json").exists():
        return True
    kept = directory / "scenario.toml"
    words = to_toml(resolved(scenario))
    found = read_manifest(directory)
    if found.get("replica", replica) != replica:
        rule, remedy = f"{directory} holds another replica", "give the same --replica"
        raise ScenarioError("--resume", rule, found["replica"], remedy)
    if found.get("runs", {}).get("wanted") != 1:
        remedy = "give the same --runs"
        raise ScenarioError("--resume", "the run was begun with several runs", 1, remedy)
    if kept.exists() and kept.read_text(encoding="utf-8") != words:
        remedy = "give the same scenario, seed and settings"
        rule = f"{directory} holds a run of another scenario"
        raise ScenarioError("--resume", rule, scenario.name, remedy)
    if is_finished(directory):
        return False
    remove_own(directory, scenario)
    return True


def read_manifest(directory: Path) -> dict[str, Any]:
    """``manifest.json`` of a directory; raises ScenarioError where it is not one."""
    try:
        found = json.loads((directory / "manifest.json").read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError
    except (OSError, ValueError):
        words, remedy = "must be a directory that netkf run left", "give another --out"
        raise ScenarioError("--resume", words, str(directory), remedy) from None
    return found
