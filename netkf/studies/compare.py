"""``netkf.compare``: finished runs and ensembles side by side, with their differences."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path, number
from netkf.core.notebook import NotebookTable
from netkf.core.printable import list_some, shorten
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import name_rows
from netkf.runs import documents
from netkf.runs.parquet_files import column_names, read_numbers
from netkf.runs.quantities import quantities_in
from netkf.runs.stored import MANIFEST_FORM, MESSAGES, SUMMARY_FORM, read_checked_document
from netkf.runs.tables import in_unit
from netkf.scenario.writing import toml_text
from netkf.studies.metrics import is_one_truth, mean_over_runs

AVERAGES = ("rms_error", "mean_trace", "mean_nees")
TRACES = ("bound", "limit", "central")
PLANT = re.compile(r"plant\.|plants\.\d+\.")
"""Beginnings of the keys of plants."""
LABELS = {
    "rms_error": "RMS error",
    "mean_nees": "mean NEES",
    "mean_trace": "mean trace P",
    "worst_instant": "largest error at any sample",
    "time_above": "share of samples above the level",
    "mean_age": "mean age of readings (s)",
    "worst_age": "largest age of readings (s)",
    "time_connected": "share of the time connected",
    "joules": "energy (J)",
    "limit": "limit of trace P",
    "central": "trace P, centralised filter",
    "bound": "bound on trace P",
}
"""Quantities in words; others are called by their names."""
TITLES = ("name", "claim")
"""Keys of scenarios that change no run."""
DIAGONAL = re.compile(r"P(\d+)_?\1$")
"""Columns of the diagonal of P: P11, or P1_1 where there are more than ten states."""


def quantity_label(name: str) -> str:
    """Return a quantity of summaries in words."""
    if name.startswith("quantile_"):
        return f"{name.removeprefix('quantile_')} % quantile of errors"
    return LABELS.get(name, f"messages {name}" if name in MESSAGES else name)


class Entry(NamedTuple):
    """A quantity of one directory.

    value, se   : the value and its standard error, None if unknown
    difference, low, high : difference from the first directory with its interval
    real        : True if the interval excludes 0, None without an interval
    method      : how the interval was computed, or why there is none
    """

    value: float | None
    se: float | None
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    real: bool | None = None
    method: str = ""


class ComparedRow(NamedTuple):
    """A quantity of one ``node``, or of all (-1), in every directory."""

    quantity: str
    node: int
    entries: tuple[Entry, ...]


class ComparedSetting(NamedTuple):
    """A differing ``key`` of scenarios, its value in each as TOML, "-" where it is not a key."""

    key: str
    values: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RunDirectory:
    """The directory of a finished run or ensemble: its manifest, its summary, and the keys of its
    scenario with all defaults, as TOML by path.
    """

    directory: Path
    manifest: dict[str, Any]
    summary: dict[str, Any]
    settings: dict[str, str]

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.manifest["runs"]["done"] or 1)

    def value(self, quantity: str, node: int) -> tuple[float | None, float | None]:
        """Return a ``quantity`` at ``node`` (-1: all) and its standard error, or None."""
        if quantity in MESSAGES:
            table, errors = self.summary["messages"], self.summary.get("messages_se", {})
            return table.get(quantity), errors.get(quantity)
        table = self.summary["overall"]
        if node >= 0:
            table = next(row for row in self.summary["nodes"] if row["node"] == node)
        value = self.summary[quantity] if quantity in ("limit", "central") else table.get(quantity)
        return value, table.get(f"{quantity}_se")

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node ids."""
        return tuple(row["node"] for row in self.summary["nodes"])

    @cached_property
    def samples(self) -> pd.DataFrame | None:
        """Samples after time 0 by run, t (s) and node; None if not all were kept: sq_error, nees,
        mean_trace (trace of P), the diagonal of P, and x0, x1, ... Raises ScenarioError.
        """
        file = self.directory / "states.parquet"
        if not file.exists() or self.runs < 2:
            return None
        with damage_named(self.directory):
            documents.check_files(self.directory, self.manifest, [file.name])
            names = column_names(file)
            if "sq_error" not in names:
                return None
            traces = [name for name in names if DIAGONAL.match(name)]
            truth = [name for name in names if name[:1] == "x" and name[1:].isdecimal()]
            states = read_numbers(file, ["run", "t", "node", "sq_error"])
            # A node may estimate fewer states than others, and a singular P has no NEES.
            states = states.join(read_numbers(file, ["nees", *traces, *truth], allow_empty=True))
        complete = states["run"].nunique() == self.runs
        states["mean_trace"] = states[traces].sum(axis=1, min_count=1)
        return states[states["t"] > 0.0] if complete else None

    @property
    def rounding_from(self) -> float:
        """Time from which rounding blurs the errors, inf if it does not."""
        stored = self.summary.get("rounding_from")
        return math.inf if stored is None else float(stored)

    def by_run(self, quantity: str, node: int, end: float) -> pd.Series[float] | None:
        """Return averages over time by run of a ``quantity`` (of ``rms_error`` the square) at
        ``node``, -1 for all; of errors and NEES before ``end`` (s). None without states.
        """
        columns = {"rms_error": "sq_error", "mean_trace": "mean_trace", "mean_nees": "nees"}
        if self.samples is None or quantity not in columns:
            return None
        chosen = self.samples if node < 0 else self.samples[self.samples["node"] == node]
        if quantity != "mean_trace":
            chosen = chosen[chosen["t"] < end]
        return chosen.groupby("run")[columns[quantity]].mean()


def read_directory(directory: Path) -> RunDirectory:
    """Read the directory of a finished, unchanged run or ensemble; raises ScenarioError."""
    where = shorten(directory)
    if not directory.is_dir():
        raise ScenarioError(where, "is not a directory", None, "name run directories")
    with damage_named(directory):
        with documents.add_file_name("manifest.json"):
            manifest = documents.read_document(directory / "manifest.json")
            documents.require_form(manifest, MANIFEST_FORM)
        # That of a sweep has no summary.
        if manifest["status"] not in documents.FINAL_STATUSES and "vary" not in manifest:
            rule = f"holds a run that did not finish ({shorten(manifest['status'], 30)})"
            raise ScenarioError(where, rule, None, "finish it with netkf run --resume")
        read_checked_document(directory, "manifest.json", MANIFEST_FORM)  # its seal
        summary = read_checked_document(directory, "summary.json", SUMMARY_FORM)
        name_rows(summary["nodes"])
        for row in (*summary["nodes"], summary["overall"]):
            numbers = [key for name in quantities_in(row) for key in (name, f"{name}_se")]
            documents.require_form(row, {f"{key}?": documents.NUMBER for key in numbers})
        documents.check_files(directory, manifest, ["scenario.toml", "summary.json"])
        try:
            tables = tomllib.loads((directory / "scenario.toml").read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise documents.DamagedError(f"scenario.toml: {error}") from None
    tables |= {key: manifest[key] for key in ("seed", "replica") if key in manifest}
    return RunDirectory(directory, manifest, summary, dict(_leaves(tables, "")))


def _leaves(value: Any, path: str) -> Iterator[tuple[str, str]]:
    """Yield paths of keys below ``path`` with values as TOML; lists of tables are numbered."""
    if isinstance(value, list) and value and all(isinstance(entry, dict) for entry in value):
        value = {str(k): entry for k, entry in enumerate(value)}
    if not isinstance(value, dict):
        yield path, toml_text(value)
        return
    for key, entry in value.items():
        yield from _leaves(entry, f"{path}.{key}" if path else key)


def _differing_settings(runs: Sequence[RunDirectory]) -> tuple[ComparedSetting, ...]:
    keys = dict.fromkeys(key for run in runs for key in run.settings if key not in TITLES)
    rows = (ComparedSetting(k, tuple(run.settings.get(k, "-") for run in runs)) for k in keys)
    return tuple(row for row in rows if len(set(row.values)) > 1)


@contextmanager
def damage_named(directory: Path) -> Iterator[None]:
    """Turn a DamagedError into a ScenarioError that names the directory."""
    try:
        yield
    except documents.DamagedError as error:
        rule = f"is not the directory of a run: {error}"
        raise ScenarioError(shorten(directory), rule, None, "name what netkf run left") from None


@dataclass(frozen=True)
class Comparison(NotebookTable):
    """Quantities of several directories side by side.

    All marks of certain differences are right with probability ``confidence``. ``notes`` are those
    of the summaries, on what their averages leave out; ``settings`` the keys in which the scenarios
    differ; ``units`` those of all states of each, empty where they have none or several.
    """

    directories: tuple[str, ...]
    names: tuple[str, ...]
    runs: tuple[int, ...]
    confidence: float
    rows: tuple[ComparedRow, ...]
    notes: tuple[tuple[str, ...], ...] = ()
    settings: tuple[ComparedSetting, ...] = ()
    units: tuple[str, ...] = ()

    def __repr__(self) -> str:
        real = sum(any(entry.real for entry in row.entries) for row in self.rows)
        names = list_some(self.directories, 3)
        return f"<netkf comparison of {names}: {real} of {len(self.rows)} rows differ for certain>"

    def remarks(self) -> list[str]:
        """Return sentences on what the values of the directories mean beside each other."""
        keys = [key for key, _ in self.settings]
        units = list(dict.fromkeys(unit for unit in self.units if unit))
        found = []
        if len(units) > 1:
            found.append(f"errors are in {', '.join(units)}: they do not compare")
        elif units:
            found.append(f"errors are in {units[0]}, traces of P in{in_unit(units[0], 2)}")
        if any(PLANT.match(key) and not key.endswith((".units", ".states")) for key in keys):
            found.append("the plants differ, and so the states whose errors these are")
        elif keys and {*keys} <= {"seed", "replica"}:
            found.append("only the draws differ: these are runs of one scenario")
        if "horizon" in keys:
            found.append("the horizons differ, and so the times over which these are means")
        return found

    @property
    def table(self) -> pd.DataFrame:
        """A row per quantity and node, -1 for all nodes, with the value of every directory;
        ``differs`` names those directories that differ from the first for certain.
        """
        rows = []
        for quantity, node, entries in self.rows:
            named = list(zip(self.directories, entries, strict=True))
            values = {name: entry.value for name, entry in named}
            real = ", ".join(name for name, entry in named if entry.real)
            rows.append({"quantity": quantity, "node": node, **values, "differs": real})
        return pd.DataFrame(rows)

    def document(self) -> dict[str, Any]:
        """Return the comparison as plain JSON values, as ``netkf compare --json`` prints it."""
        rows = [
            {"quantity": q, "node": node, "entries": [entry._asdict() for entry in entries]}
            for q, node, entries in self.rows
        ]
        settings = [setting._asdict() for setting in self.settings]
        return {**vars(self), "rows": rows, "settings": settings}


def compare(directories: Sequence[str | Path], confidence: float = 0.95) -> Comparison:
    """Compare the summaries of finished runs and ensembles with the first one.

    If two ensembles have the same seed and the same truth, and both kept the states of all runs
    (``--trace full``), differences are taken run by run; else by the standard errors of both
    (Welch). The intervals of all rows and directories hold together with probability
    ``confidence`` (Bonferroni). A difference from a single run has no interval. Raises
    ScenarioError for a directory that is not that of a finished run.
    """
    if isinstance(directories, (str, Path)) or not isinstance(directories, Sequence):
        remedy = "give all of them in one list: netkf.compare([one, other])"
        raise ScenarioError("directories", "must be a list", directories, remedy)
    if not directories:
        raise ScenarioError("compare", "needs run directories", None, "name at least one")
    runs = [read_directory(as_path("directories", directory)) for directory in directories]
    confidence = number(above=0.0, below=1.0)("--confidence", confidence)
    first = runs[0]
    more = dict.fromkeys(q for run in runs for q in quantities_in(run.summary["overall"]))
    known = [q for q in more if any(run.value(q, -1)[0] is not None for run in runs)]
    quantities = [(q, -1) for q in (*AVERAGES, *known, *MESSAGES)]
    if all(run.nodes == first.nodes for run in runs):
        quantities += [("rms_error", node) for node in first.nodes]
    level = (1.0 - confidence) / (len(quantities) * max(1, len(runs) - 1))
    rows = [
        ComparedRow(q, node, tuple(_compare_quantity(first, run, q, node, level) for run in runs))
        for q, node in quantities
    ]
    rows += [ComparedRow(q, -1, tuple(Entry(*run.value(q, -1)) for run in runs)) for q in TRACES]
    return Comparison(
        directories=tuple(str(run.directory) for run in runs),
        names=tuple(str(run.manifest.get("name", "")) for run in runs),
        runs=tuple(run.runs for run in runs),
        confidence=confidence,
        rows=tuple(rows),
        notes=tuple(tuple(run.summary.get("notes", ())) for run in runs),
        settings=_differing_settings(runs),
        units=tuple(_common_unit(run.settings) for run in runs),
    )


def _common_unit(settings: dict[str, str]) -> str:
    plants = [m[0] for m in map(PLANT.match, settings) if m]
    texts = {settings.get(f"{plant}units", "['']") for plant in plants}
    units = {unit for text in texts for unit in tomllib.loads(f"units = {text}")["units"]}
    return str(units.pop()) if len(units) == 1 else ""


def _compare_quantity(
    first: RunDirectory, other: RunDirectory, quantity: str, node: int, level: float
) -> Entry:
    """Return a ``quantity`` at ``node`` (-1: all) and its difference from the ``first`` one."""
    entry, base = Entry(*other.value(quantity, node)), Entry(*first.value(quantity, node))
    if other is first or entry.value is None:
        return entry
    # Run by run if both had the same truth, which is more accurate, else as independent runs.
    paired = _paired_differences(first, other, quantity, node)
    if paired is not None:
        method = "paired" if quantity != "rms_error" else "paired by mean squares"
        return _with_interval(entry, *mean_over_runs(paired), len(paired) - 1, level, method)
    if base.value is None:
        return entry
    difference = entry.value - base.value
    squares = [math.nan if one.se is None else one.se * one.se for one in (base, entry)]
    if not math.isfinite(sum(squares)) or min(first.runs, other.runs) < 2:
        return entry._replace(difference=difference, method="one run")
    # Welch's interval.
    parts = [s * s / (one.runs - 1) for s, one in zip(squares, (first, other), strict=True)]
    degrees = min(first.runs, other.runs) - 1.0
    if sum(parts) > 0.0:
        degrees = sum(squares) ** 2 / sum(parts)
    return _with_interval(entry, difference, math.sqrt(sum(squares)), degrees, level, "Welch")


def _with_interval(
    entry: Entry, difference: float, error: float, freedom: float, level: float, method: str
) -> Entry:
    width = float(scipy.special.stdtrit(freedom, 1.0 - level / 2.0)) * error
    low, high = difference - width, difference + width
    real = math.isfinite(width) and math.isfinite(difference) and (low > 0.0 or high < 0.0)
    return entry._replace(difference=difference, low=low, high=high, real=real, method=method)


def _paired_differences(
    first: RunDirectory, other: RunDirectory, quantity: str, node: int
) -> FloatArray | None:
    """Return the differences (R,) of R runs, None without states of several or one truth."""
    end = min(first.rounding_from, other.rounding_from)  # errors are mostly rounding after it
    base_values, values = (finished.by_run(quantity, node, end) for finished in (first, other))
    if base_values is None or values is None or not _same_truth(first, other):
        return None
    differences = np.asarray((values - base_values).dropna(), dtype=np.float64)
    return differences if len(differences) > 1 else None


def _same_truth(first: RunDirectory, other: RunDirectory) -> bool:
    a, b = first.samples, other.samples
    # The same seed is not enough: keys of the plant may differ.
    if a is None or b is None or first.manifest["seed"] != other.manifest["seed"]:
        return False
    # Of each node: it may estimate a part of the state.
    keys = ["run", "t", "node"]
    columns = [*keys, *(c for c in a.columns if c.startswith("x") and c[1:].isdecimal())]
    if not set(columns) <= set(b.columns):
        return False
    states = [s[columns].set_index(keys) for s in (a, b)]
    shared = states[0].index.intersection(states[1].index)
    x, other_x = (s.loc[shared].to_numpy(dtype=np.float64) for s in states)
    return bool(len(shared)) and is_one_truth(x, other_x)
