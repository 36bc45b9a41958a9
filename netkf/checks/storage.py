"""The directory of a check, to which runs can be added later.

``results.npz`` holds the summaries of all replicas as plain arrays, so that reading a file of
unknown origin executes no code (no pickles); ``verdict.json`` holds the verdict, with digests of
the scenario and the results.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from netkf.checks.check import Verdict
from netkf.checks.evidence import Evidence
from netkf.checks.report import verdict_json, verdict_text
from netkf.checks.results import ReplicaResult, result_columns, results_of_columns
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
    copied_file_names,
    other_files,
    scenario_digest,
    write_atomically,
    write_scenario,
    write_text,
    writing_file,
)
from netkf.runs.provenance import machine, versions
from netkf.scenario.scenario import Scenario

RESULTS, VERDICT, PICTURE = "results.npz", "verdict.json", "verdict.png"
FILES = (RESULTS, "verdict.csv", "verdict.txt", PICTURE)
"""Files that a check writes before the verdict itself."""
NUMBERS = ("margin", "low", "high", "tolerance", "seen", "expected", "off", "detectable")
"""Fields of a row that may be nan or infinite, which JSON cannot express."""


def save_verdict(directory: Path, scenario: Scenario, verdict: Verdict, text: str = "") -> None:
    """Write scenario.toml, results.npz and the verdict with its ``text`` into ``directory``."""
    with defer_signals():  # an interrupt must not leave a verdict that does not match its results
        _save_verdict(directory, scenario, verdict, text or verdict_text(verdict, scenario.claim))


def _save_verdict(directory: Path, scenario: Scenario, verdict: Verdict, text: str) -> None:
    if not (directory / "scenario.toml").exists():
        write_scenario(directory, scenario)
    results = io.BytesIO()
    columns: dict[str, Any] = result_columns(verdict.results)
    np.savez_compressed(results, **columns)
    with write_atomically(directory / RESULTS) as part:
        part.write_bytes(results.getvalue())
        _require_same(part, columns)
    with write_atomically(directory / "verdict.csv") as part:
        verdict.table.to_csv(part, index=False)
    write_text(directory / "verdict.txt", text + "\n")
    # A picture of an earlier verdict with fewer runs is out of date.
    with writing_file(directory / PICTURE):
        (directory / PICTURE).unlink(missing_ok=True)
    document = verdict_json(verdict)
    values = ((k, name, getattr(r, name)) for k, r in enumerate(verdict.rows) for name in NUMBERS)
    document |= {
        "digest": scenario_digest(scenario),
        "versions": versions(),
        "looks": verdict.looks,
        "spent": verdict.spent,
        "infinite": [(k, name, bool(value > 0.0)) for k, name, value in values if np.isinf(value)],
        "machine": machine(),
        "files": file_digests(directory, [RESULTS, "scenario.toml"]),
    }
    write_sealed(directory / VERDICT, document)


def _require_same(path: Path, columns: dict[str, Any]) -> None:
    again = result_columns(_read_results(path))
    for name in sorted(columns.keys() | again.keys()):
        one, other = (np.asarray(part.get(name, ())) for part in (columns, again))
        is_real = one.dtype.kind == other.dtype.kind == "f"
        if not np.array_equal(one, other, equal_nan=is_real):
            rule = f"reads back another {name} than was written"
            raise ScenarioError(RESULTS, rule, None, "report it; the verdict is not kept")


def clear_unfinished(directory: Path, scenario: Scenario) -> bool:
    """Remove files of a check that was stopped before a verdict; return True if there is none."""
    if not directory.is_dir() or not any(directory.iterdir()):
        return True
    # Files of a run are not in the list: those of a finished run must not be removed.
    names = ["scenario.toml", *FILES, *copied_file_names(scenario)]
    names.append(f"{VERDICT}.part")
    if other_files(directory, names):
        return False
    remove_unfinished(directory, scenario, names)
    return True


def load_verdict(directory: Path, scenario: Scenario, seed: int) -> Verdict:
    """Return the verdict in a directory; raises ScenarioError for none or that of others."""
    remedy = "give a directory that netkf check --out has written"
    try:
        document = read_document(directory / VERDICT)
        same = {
            "scenario": (document["digest"], scenario_digest(scenario)),
            "seed": (document["seed"], seed),
            "versions": (document["versions"], versions()),
            "machine": (document["machine"], machine()),
        }
        check_seal(document)
        check_files(directory, document)
        looks, spent = int(document["looks"]), float(document["spent"])
        entries = [dict(row) for row in document["rows"]]
        for row in entries:
            row |= {name: np.nan for name in NUMBERS if row[name] is None}
        for k, name, positive in document.get("infinite", ()):
            entries[k][str(name)] = np.inf if positive else -np.inf
        rows = tuple(Evidence(**row) for row in entries)
        results = _read_results(directory / RESULTS)
        count, confidence = int(document["runs"]), float(document["confidence"])
    except Exception as error:  # the files may hold anything
        reason = str(error) if isinstance(error, DamagedError) else type(error).__name__
        problem = f"has no verdict that can be read: {reason}"
        raise ScenarioError("--resume", problem, str(directory), remedy) from None
    for name, (stored, present) in same.items():
        if stored != present:
            problem = f"{directory} holds a verdict of another {name.removesuffix('s')}"
            raise ScenarioError("--resume", problem, stored, "start a new directory")
    if len(results) != count:
        problem = f"{directory} holds {len(results)} results of {count} runs"
        raise ScenarioError("--resume", problem, str(directory), "start a new directory")
    return Verdict(scenario.name, count, seed, confidence, rows, tuple(results), looks, spent)


def _read_results(path: Path) -> list[ReplicaResult]:
    with np.load(path, allow_pickle=False) as file:
        return results_of_columns({name: file[name] for name in file.files})
