"""``netkf.open``: read what a command wrote back from its directory."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.core.notebook import NotebookTable
from netkf.core.printable import one_line, shorten
from netkf.ensembles.stored import StoredEnsemble, read_ensemble
from netkf.runs.curves import ErrorCurve
from netkf.runs.documents import COUNT, NUMBER, TEXT, TEXTS, DamagedError, check_files, require_form
from netkf.runs.parquet_files import (
    column_names,
    is_numeric_column,
    read_flags,
    read_numbers,
    read_texts,
)
from netkf.runs.quantities import NETWORK, sample_names
from netkf.runs.stored import MANIFEST_FORM, StoredRun, read_checked_document, read_run
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario
from netkf.studies.compare_filters import CURVES, ComparedFilter, FilterComparison
from netkf.studies.metrics import Quantity
from netkf.trace.run import plot_by_name

if TYPE_CHECKING:
    import pandas as pd

VERDICT_ROW: dict[str, Any] = {
    **dict.fromkeys(("promise", "source", "verdict", "evidence", "assumptions"), TEXT),
    **dict.fromkeys(("seen", "expected", "off", "detectable", "low", "high"), NUMBER),
}
VERDICT: dict[str, Any] = {
    "scenario": TEXT,
    "runs": COUNT,
    "seed?": COUNT,
    "confidence": NUMBER,
    "rows": [VERDICT_ROW],
    "versions?": {},
}
COMPARISON: dict[str, Any] = {"filters": TEXTS, "confidence": NUMBER}
"""What the manifest of a comparison has beside that of a run."""
TEXT_COLUMNS = ("filter", "consistency", "status")
FILTERS = "filters.parquet"
PARTS = ("se", "difference", "low", "high", "real")
"""Parts of a quantity beside its value, each in a column of its own."""


@dataclass(frozen=True, repr=False)
class StoredComparison(FilterComparison):
    """A comparison of filters that is read back from ``directory``; ``base`` is the scenario that
    all of them ran in, with its own filter.
    """

    directory: Path
    manifest: dict[str, Any]
    base: Scenario


def read_comparison(directory: Path, base: Scenario, manifest: dict[str, Any]) -> StoredComparison:
    """Return the comparison in a directory whose ``manifest`` has the keys of those of runs;
    ``base`` is the scenario that the filters ran in. Raises DamagedError.
    """
    require_form(manifest, COMPARISON)
    _require_confidence(manifest)
    has_curves = CURVES in manifest["files"]
    check_files(directory, manifest, [FILTERS, *([CURVES] if has_curves else [])])
    path = directory / FILTERS
    quantities = ("rms_error", "nees_ratio", *sample_names(base))
    parts = [f"{key}_{part}" for key in quantities for part in PARTS[:-1]]
    numbers = read_numbers(path, [*quantities, *parts, *NETWORK], allow_empty=True)
    columns: dict[str, Any] = {str(name): values.tolist() for name, values in numbers.items()}
    flags = (*(f"{key}_real" for key in quantities), "predicts", "same_losses")
    columns |= {name: read_flags(path, name).tolist() for name in flags}
    columns |= {name: read_texts(path, name).astype(str).tolist() for name in TEXT_COLUMNS}
    rows = [
        _read_filter({name: values[k] for name, values in columns.items()}, quantities)
        for k in range(len(numbers))
    ]
    if [row.filter for row in rows] != manifest["filters"] or not any(row.ran for row in rows):
        raise DamagedError(f"{FILTERS} does not have the filters of the manifest")
    return StoredComparison(
        scenario=base.name,
        runs=manifest["runs"]["done"],
        seed=manifest["seed"],
        confidence=manifest["confidence"],
        rows=tuple(rows),
        curves=_read_curves(directory / CURVES, manifest["runs"]["done"], base)
        if has_curves
        else (),
        directory=directory,
        manifest=manifest,
        base=base,
    )


def _read_curves(path: Path, runs: int, base: Scenario) -> tuple[ErrorCurve, ...]:
    names = ["t", "mse", "mse_se", "bound", "central"]
    numbers = read_numbers(path, names, allow_empty=True)
    curves = []
    for label, table in numbers.groupby(read_texts(path, "filter").astype(str), sort=False):
        times, square, se, bound, central = (table[name].to_numpy() for name in names)
        known = bound if np.isfinite(bound).all() else None
        curves.append(ErrorCurve(str(label), times, square, se, runs, central[0], known, base.unit))
    return tuple(curves)


def _read_filter(row: dict[str, Any], names: tuple[str, ...]) -> ComparedFilter:
    quantities = {k: Quantity(row[k], *(row[f"{k}_{part}"] for part in PARTS)) for k in names}
    ran = math.isfinite(row["transmissions"])
    return ComparedFilter(
        filter=row["filter"],
        # Traffic is nan only for filters that cannot run. Consistency does not tell them apart: it
        # is "-" for all filters if there is a single run.
        quantities=quantities if ran else {},
        consistency=row["consistency"],
        traffic={name: row[name] for name in NETWORK} if ran else {},
        status=row["status"],
        predicts=row["predicts"],
        same_losses=row["same_losses"],
    )


def _require_confidence(document: dict[str, Any]) -> None:
    """Raise DamagedError if the confidence is null, which other numbers may be."""
    if document["confidence"] is None:
        raise DamagedError("needs a number at confidence")


@dataclass(frozen=True, eq=False)
class StoredVerdict(NotebookTable):
    """A verdict of ``netkf check`` that is read back from ``directory``; true if no promise is
    broken. ``document`` is the contents of verdict.json.
    """

    directory: Path
    scenario: Scenario
    document: dict[str, Any]

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.document["runs"])

    @property
    def seed(self) -> int | None:
        """The root seed, None if it was not written."""
        return self.document.get("seed")

    @property
    def confidence(self) -> float:
        """All intervals of all rows hold together with at least this probability."""
        return float(self.document["confidence"])

    @property
    def table(self) -> pd.DataFrame:
        """One row per promise, as in the table of ``netkf.check``."""
        import pandas as pd

        return pd.DataFrame(self.document["rows"])

    def __bool__(self) -> bool:
        return all(row["verdict"] != "broken" for row in self.document["rows"])

    def __repr__(self) -> str:
        counts = Counter(row["verdict"] for row in self.document["rows"])
        verdicts = one_line(", ".join(f"{count} {name}" for name, count in sorted(counts.items())))
        return (
            f"<netkf verdict on {self.scenario.name!r}: {verdicts or 'no row'}; {self.runs:,} runs>"
        )


MEANS = ("worst_rms", "mean_rms", "mean_trace", "worst_trace")
RESULTS = (*MEANS, *(f"{name}_se" for name in MEANS), "bound", "central")
"""Columns of numbers that every sweep has beside its keys: means with standard errors, bounds."""


@dataclass(frozen=True, eq=False)
class StoredSweep(NotebookTable):
    """A sweep that is read back from ``directory``.

    ``scenario`` is the base scenario, ``keys`` the paths of its keys that were varied, ``table``
    has a row for each point as ``netkf.sweep`` returns it: fewer than were wanted if ``status`` is
    interrupted or failed.
    """

    directory: Path
    scenario: Scenario
    keys: tuple[str, ...]
    table: pd.DataFrame
    status: str
    manifest: dict[str, Any]

    def plot(self, figure: str = "stability") -> Any:
        """Return a figure of the sweep as a matplotlib Figure; there is ``stability`` only."""
        return plot_by_name(self, figure)

    def __repr__(self) -> str:
        points = f"{len(self.table)} points of {', '.join(self.keys)}"
        return f"<netkf sweep of {self.scenario.name!r}: {self.status}, {points}>"


Stored = StoredRun | StoredEnsemble | StoredSweep | StoredComparison | StoredVerdict
"""What ``netkf.open`` returns."""


def open(directory: str | Path, *, trust: bool = False) -> Stored:
    """Return the results in a directory that ``netkf run``, ``netkf run --runs``, ``netkf sweep``,
    ``netkf.save``, ``netkf compare-filters`` or ``netkf check`` wrote.

    They are those that ``netkf.simulate``, ``netkf.monte_carlo``, ``netkf.sweep``,
    ``netkf.compare_filters`` and ``netkf.check`` return, with the scenario, the manifest and the
    summary; of an interrupted run those that were written. If a directory has a run and a verdict,
    the run is returned.

    Files are read without trust: with ``trust`` classes of modules in the directory, or in the
    current folder, that its scenario names are imported, which executes them.

    Raises ScenarioError for whatever is not as netkf writes it.
    """
    folder = as_path("directory", directory, "name what netkf run or netkf sweep left")
    # Traces are read later, when the current folder may be another.
    name, folder = shorten(directory), folder.absolute()
    try:
        if not (folder / "manifest.json").exists() and (folder / "verdict.json").exists():
            document = read_checked_document(folder, "verdict.json", VERDICT)
            _require_confidence(document)
            check_files(folder, document, ["scenario.toml"])
            return StoredVerdict(folder, load(folder / "scenario.toml", trust=trust), document)
        if not folder.is_dir():
            raise DamagedError("it is no directory" if folder.exists() else "it does not exist")
        manifest = read_checked_document(folder, "manifest.json", MANIFEST_FORM)
        check_files(folder, manifest, ["scenario.toml"])
        scenario = load(folder / "scenario.toml", trust=trust)
        # The manifest tells what wrote the directory: only sweeps have ``vary``, and so on.
        if "vary" in manifest:
            return _read_sweep(folder, scenario, manifest)
        if "filters" in manifest:
            return read_comparison(folder, scenario, manifest)
        if manifest["runs"]["wanted"] > 1:
            return read_ensemble(folder, scenario, manifest)
        return read_run(folder, scenario, manifest)
    except DamagedError as error:
        remedy = "name a directory that netkf run, sweep, check or compare-filters left"
        raise ScenarioError(name, f"cannot be opened: {error}", None, remedy) from None


def _read_sweep(folder: Path, scenario: Scenario, manifest: dict[str, Any]) -> StoredSweep:
    """Return the sweep in a directory; one interrupted at once has a table without rows."""
    import pandas as pd

    require_form(manifest["vary"], {}, "vary")
    if not all(isinstance(values, list) for values in manifest["vary"].values()):
        raise DamagedError("manifest.json needs lists at vary")
    keys = tuple(manifest["vary"])
    path = folder / "sweep.parquet"
    table = _read_table(path, keys) if path.exists() else pd.DataFrame(columns=[*keys, *RESULTS])
    require_form(manifest["status"], TEXT, "status")
    return StoredSweep(folder, scenario, keys, table, manifest["status"], manifest)


def _read_table(path: Path, keys: tuple[str, ...]) -> pd.DataFrame:
    import pandas as pd

    names = column_names(path)
    for name in (*keys, "runs", *RESULTS, "status"):
        if names.count(name) != 1:
            raise DamagedError(f"{path.name} has no column {name}")
    numeric = [name for name in names if is_numeric_column(path, name)]
    # Values of keys may be texts; a column of a later version is one of numbers too.
    texts = set(names) - {*numeric, *keys, "status"}
    if texts:
        listed = ", ".join(sorted(texts))
        raise DamagedError(f"{path.name} has texts in columns of numbers: {listed}")
    columns: dict[str, Any] = dict(read_numbers(path, numeric, allow_empty=True))
    if any((columns[name] < 0).any() for name in numeric if name.endswith("_se")):
        raise DamagedError(f"{path.name} has negative standard errors")
    columns |= {n: read_texts(path, n).astype(str) for n in names if n not in numeric}
    return pd.DataFrame({name: columns[name] for name in names})
