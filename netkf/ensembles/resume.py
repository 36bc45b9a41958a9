"""Conditions for resuming the runs in a directory: same scenario, options and installation."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from netkf.core.errors import ScenarioError
from netkf.ensembles.block_files import RunIdentity
from netkf.runs import documents
from netkf.runs.files import BLOCKS_FOLDER, other_files, remove_files, run_file_names
from netkf.runs.provenance import machine, versions
from netkf.scenario.plugins import find_module_files
from netkf.scenario.scenario import Scenario
from netkf.scenario.tables import source_files
from netkf.scenario.writing import resolve_defaults, to_toml

MANIFEST = {
    "name": documents.TEXT,
    "status": documents.TEXT,
    "engine": documents.TEXT,
    "seed": documents.COUNT,
    "replica": documents.COUNT,
    "runs": {"wanted": documents.COUNT, "done": documents.COUNT},
    "versions": {},
    "machine?": {},
    "scenario?": documents.TEXT,
    "trace?": documents.TEXT,
    "tasks?": documents.COUNT,
    "arguments?": documents.TEXTS,
}
"""The form of a manifest that runs are resumed from."""


def is_finished(out: Path | None, scenario: Scenario, plan: RunIdentity) -> bool | None:
    """Return True if the directory ``out`` has all results, False if it has those that a stopped
    command left there, and None if it is new or empty.

    ``plan`` is what the command would run now. Raises ScenarioError unless the directory holds a
    run of this plan and installation only, whose files were not changed since.
    """
    if out is None:
        remedy = "add --out DIR with the directory of the run that was stopped"
        raise ScenarioError("--resume", "needs the directory of the runs", None, remedy)
    if not (out / "manifest.json").exists():
        if not out.is_dir() or not any(out.iterdir()):
            return None
        _require_own_files(out, [*run_file_names(scenario), BLOCKS_FOLDER])
        # Stopped before the manifest was written. Each block names its run: blocks of other runs
        # are removed when they are read.
        _check_scenario(out, scenario)
        return False
    manifest = read_manifest(out)
    if manifest["runs"]["wanted"] != plan.runs:
        rule, value = "the run was begun with another number of runs", manifest["runs"]["wanted"]
        raise ScenarioError("--resume", rule, value, "give the same --runs")
    # Another version or machine may round differently: the merged results would not be those of
    # any command without interruption.
    requirements = {
        "scenario": (plan.scenario, "give the same scenario, seed and settings"),
        "trace": (plan.trace, "give the same --trace"),
        "engine": (plan.engine, "give the same --engine"),
        "versions": (versions(), "go on with the versions that it was begun with"),
        "machine": (machine(), "go on where it was begun, or start in a new directory"),
    }
    for key, (planned, remedy) in requirements.items():
        if manifest.get(key) != planned:
            rule = f"{out} holds a run of another {key.removesuffix('s')}"
            stored = manifest.get(key)
            if isinstance(stored, dict) and isinstance(planned, dict):
                names = [k for k in {**stored, **planned} if stored.get(k) != planned.get(k)]
                stored = {name: stored.get(name) for name in names}
            raise ScenarioError("--resume", rule, stored, remedy)
    remedy = "remove it: each block is checked by a digest of its own"
    _require(out / "manifest.json", lambda: documents.check_seal(manifest), remedy)
    _check_scenario(out, scenario)
    finished = manifest["status"] in documents.FINAL_STATUSES
    if finished:
        _require(out, lambda: documents.check_files(out, manifest), "start in a new directory")
    return finished


def clear_unfinished_runs(
    directory: Path, scenario: Scenario, replica: int = 0, note: Callable[[str], None] | None = None
) -> bool:
    """Remove the files of a single run, number ``replica``, that was stopped, so that ``--resume``
    can do it again; return False if it is finished and stays.

    The files of a finished run that were changed since are removed too, and ``note`` is called with
    a line about them. Raises ScenarioError if the directory holds another run.
    """
    if not (directory / "manifest.json").exists():
        if directory.is_dir() and any(directory.iterdir()):
            remove_unfinished(directory, scenario, run_file_names(scenario))
        return True
    manifest = read_manifest(directory)
    if manifest["replica"] != replica:
        rule, remedy = f"{directory} holds another replica", "give the same --replica"
        raise ScenarioError("--resume", rule, manifest["replica"], remedy)
    if manifest["runs"]["wanted"] != 1:
        remedy = "give the same --runs"
        raise ScenarioError("--resume", "the run was begun with several runs", 1, remedy)
    _check_scenario(directory, scenario)
    if manifest["status"] in documents.FINAL_STATUSES:
        try:
            documents.check_seal(manifest)
            documents.check_files(directory, manifest)
        except documents.DamagedError as error:
            if note is not None:
                note(f"the run in {directory} is done again: its record {error}")
        else:
            return False
    remove_unfinished(directory, scenario, run_file_names(scenario))
    return True


def remove_unfinished(directory: Path, scenario: Scenario, names: Collection[str]) -> None:
    """Remove the files ``names`` that a stopped command left in ``directory``.

    Raises ScenarioError, with nothing removed, if they are of another scenario or the only copies
    of what this one reads, or if there are other files, beside which nothing is written.
    """
    _require_own_files(directory, names)
    _check_scenario(directory, scenario)
    files = [source.full for source in source_files(scenario)]
    files += [file for file in find_module_files(scenario).values() if file is not None]
    for file in files:
        if Path(file).resolve().is_relative_to(directory.resolve()):
            rule = f"{file} is in the directory whose run is done again"
            remedy = "copy the scenario with its files to another folder, and run that"
            raise ScenarioError("--resume", rule, None, remedy)
    remove_files(directory, names)


def _require_own_files(directory: Path, names: Collection[str]) -> None:
    others = other_files(directory, names)
    if others:
        rule, found = f"{directory} holds what is not of the run", ", ".join(others[:3])
        raise ScenarioError("--resume", rule, found, "move it away, or give a new directory")


def _check_scenario(directory: Path, scenario: Scenario) -> None:
    path, text = directory / "scenario.toml", to_toml(resolve_defaults(scenario))
    if not path.exists():
        return
    with contextlib.suppress(OSError, ValueError):
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            return
    rule = f"{directory} holds a run of another scenario, or its scenario.toml was changed"
    remedy = "give the same scenario, seed and settings, or move scenario.toml away"
    raise ScenarioError("--resume", rule, scenario.name, remedy)


def _require(path: Path, check: Callable[[], None], remedy: str) -> None:
    """Call ``check`` of ``path``; its DamagedError becomes a ScenarioError with ``remedy``."""
    try:
        check()
    except documents.DamagedError as error:
        raise ScenarioError("--resume", f"{path}: {error}", None, remedy) from None


def read_manifest(directory: Path, option: str = "--resume") -> dict[str, Any]:
    """Return manifest.json of a directory that runs are to be resumed in; raises ScenarioError
    about an ``option`` if it is missing or damaged.
    """
    try:
        manifest = documents.read_document(directory / "manifest.json")
        documents.require_form(manifest, MANIFEST)
    except documents.DamagedError as error:
        rule = f"must be a directory that netkf run or plan left: manifest.json {error}"
        raise ScenarioError(option, rule, str(directory), "give another directory") from None
    return manifest
