"""What a check leaves in a directory, so that runs can be added later.

``results.npz`` holds the summaries of all replicas as plain arrays, which execute nothing when they
are read; ``verdict.json`` the verdict and what it belongs to.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from netkf.checks.check import ReplicaResult, Verdict, find_checks, with_check_times
from netkf.checks.evidence import Evidence
from netkf.checks.parts.samples import PART_TYPES, PartSummary
from netkf.checks.report import verdict_json, verdict_text
from netkf.core.errors import ScenarioError
from netkf.core.interrupts import defer_signals
from netkf.ensembles.resume import remove_unfinished
from netkf.runs.documents import (
    DamagedError,
    check_files,
    check_seal,
    file_digests,
    read_document,
    write_sealed,
)
from netkf.runs.files import (
    BLOCKS,
    copied_names,
    only_own,
    scenario_digest,
    write_atomically,
    write_scenario,
    write_text,
    writing,
)
from netkf.runs.provenance import machine, versions
from netkf.scenario.scenario import Scenario

RESULTS, VERDICT, PICTURE = "results.npz", "verdict.json", "verdict.png"
FILES = (RESULTS, "verdict.csv", "verdict.txt", PICTURE)
"""Files that a check writes before the verdict itself."""
NUMBERS = ("margin", "low", "high", "tolerance", "seen", "expected", "off", "detectable")
"""Numbers of a row, which may be nan or infinite."""


def save_verdict(directory: Path, scenario: Scenario, verdict: Verdict, text: str = "") -> None:
    """Write scenario.toml, verdict.json, verdict.csv, verdict.txt and results.npz."""
    with defer_signals():  # the verdict has the digest of the results
        _save_verdict(directory, scenario, verdict, text or verdict_text(verdict, scenario.claim))


def _save_verdict(directory: Path, scenario: Scenario, verdict: Verdict, text: str) -> None:
    """Write scenario, results, table, text and JSON of a verdict into a directory."""
    if not (directory / "scenario.toml").exists():
        write_scenario(directory, scenario)
    results = io.BytesIO()
    columns: dict[str, Any] = _result_columns(verdict.results)
    np.savez_compressed(results, **columns)
    with write_atomically(directory / RESULTS) as part:
        part.write_bytes(results.getbuffer())
    with write_atomically(directory / "verdict.csv") as part:
        verdict.table.to_csv(part, index=False)
    write_text(directory / "verdict.txt", text + "\n")
    # A picture of fewer runs is none of this verdict.
    with writing(directory / PICTURE):
        (directory / PICTURE).unlink(missing_ok=True)
    document = verdict_json(verdict)
    document |= {
        "digest": scenario_digest(scenario),
        "versions": versions(),
        "looks": verdict.looks,
        "spent": verdict.spent,
        "infinite": _restore_infinite(verdict),
        "machine": machine(),
        "files": file_digests(directory, [RESULTS, "scenario.toml"]),
    }
    write_sealed(directory / VERDICT, document)


def clear_unfinished(directory: Path, scenario: Scenario) -> bool:
    """Remove the files of a check that was stopped while it wrote its first verdict; return True if
    the directory holds no verdict.

    Raises ScenarioError if the files are of a check of another scenario.
    """
    if not directory.is_dir() or not any(directory.iterdir()):
        return True
    # Files of a run are not in the list: those of a finished run must not be removed.
    names = ["scenario.toml", *FILES, *copied_names(scenario)]
    if (directory / BLOCKS).exists() or not only_own(directory, [*names, f"{VERDICT}.part"]):
        return False
    remove_unfinished(directory, scenario, [*names, f"{VERDICT}.part"])
    return True


def load_verdict(directory: Path, scenario: Scenario, seed: int) -> Verdict:
    """Return the verdict in a directory, to which runs can be added.

    Raises ScenarioError if there is none, or one of another scenario, seed or version.
    """
    remedy = "give a directory that netkf check --out has written"
    try:
        found = read_document(directory / VERDICT)
        same = {
            "scenario": (found["digest"], scenario_digest(scenario)),
            "seed": (found["seed"], seed),
            "versions": (found["versions"], versions()),
            "machine": (found["machine"], machine()),
        }
        check_seal(found)
        check_files(directory, found)
        looks, spent = int(found["looks"]), float(found["spent"])
        rows = _read_rows(found)
        results = _read_results(directory / RESULTS, scenario)
        count, confidence = int(found["runs"]), float(found["confidence"])
    except Exception as error:  # whatever is in the files, which may be anybody's
        reason = str(error) if isinstance(error, DamagedError) else type(error).__name__
        problem = f"has no verdict that can be read: {reason}"
        raise ScenarioError("--resume", problem, str(directory), remedy) from None
    for name, (kept, wanted) in same.items():
        if kept != wanted:
            problem = f"{directory} holds a verdict of another {name.removesuffix('s')}"
            raise ScenarioError("--resume", problem, kept, "start a new directory")
    if len(results) != count:
        problem = f"{directory} holds {len(results)} results of {count} runs"
        raise ScenarioError("--resume", problem, str(directory), "start a new directory")
    return Verdict(scenario.name, count, seed, confidence, rows, tuple(results), looks, spent)


def _restore_infinite(verdict: Verdict) -> list[tuple[int, str, bool]]:
    """Return which numbers of which rows are infinite, and if they are positive: in JSON they are
    null, as those that do not exist.
    """
    values = (
        (k, name, getattr(row, name)) for k, row in enumerate(verdict.rows) for name in NUMBERS
    )
    return [(k, name, bool(value > 0.0)) for k, name, value in values if np.isinf(value)]


def _read_rows(found: dict[str, Any]) -> tuple[Evidence, ...]:
    """Return the rows of a document."""
    rows = [dict(row) for row in found["rows"]]
    for row in rows:
        row |= {name: np.nan for name in NUMBERS if row[name] is None}
    for k, name, positive in found.get("infinite", ()):
        rows[k][str(name)] = np.inf if positive else -np.inf
    return tuple(Evidence(**row) for row in rows)


def _result_columns(results: tuple[ReplicaResult, ...]) -> dict[str, np.ndarray]:
    """Return all results as arrays with a first axis over the replicas."""
    columns = {
        "difference": np.array([one.difference for one in results]),
        "expected": np.array([one.expected for one in results]),
        "diverged": np.array([one.diverged for one in results]),
    }
    whole = [one for one in results if one.summary is not None]
    if not whole:
        return columns
    for name in vars(whole[0].summary):
        columns[f"summary.{name}"] = np.array([getattr(one.summary, name) for one in whole])
    for part, first in zip(PartSummary._fields, whole[0].parts or (), strict=False):
        for name in first._fields if first is not None else ():
            values = [getattr(getattr(one.parts, part), name) for one in whole]
            columns[f"{part}.{name}"] = np.array(values)
    return columns


def _read_results(path: Path, scenario: Scenario) -> list[ReplicaResult]:
    """Return the results that :func:`save_verdict` wrote, in order."""
    with np.load(path, allow_pickle=False) as file:
        columns = {name: file[name] for name in file.files}
    chosen = with_check_times(scenario)
    summary_type = find_checks(chosen).summary_type
    results, index = [], 0
    for k, diverged in enumerate(columns["diverged"].tolist()):
        difference, expected = float(columns["difference"][k]), bool(columns["expected"][k])
        if diverged:
            results.append(ReplicaResult(None, difference, expected))
            continue
        at = {name: values[index] for name, values in columns.items() if "." in name}
        summary = summary_type(**_select_fields(at, "summary"))
        parts = {
            part: cls(**_select_fields(at, part)) if _select_fields(at, part) else None
            for part, cls in PART_TYPES.items()
        }
        results.append(ReplicaResult(summary, difference, expected, PartSummary(**parts)))
        index += 1
    return results


def _select_fields(values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Return the values whose names begin with ``prefix`` and a dot, without these."""
    return {
        name.split(".", 1)[1]: value
        for name, value in values.items()
        if name.split(".", 1)[0] == prefix
    }
