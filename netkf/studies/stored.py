"""Comparisons of filters and verdicts of ``netkf check``, read back from their directories."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.core.notebook import NotebookTable
from netkf.core.printable import one_line
from netkf.runs.curves import ErrorCurve
from netkf.runs.documents import COUNT, NUMBER, TEXT, TEXTS, DamagedError, check_files, require_form
from netkf.runs.parquet_files import read_flags, read_numbers, read_texts
from netkf.runs.quantities import NETWORK, sample_names
from netkf.runs.stored import read_checked_document
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario
from netkf.studies.compare_filters import CURVES, ComparedFilter, FilterComparison
from netkf.studies.filter_values import Quantity

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
        curve = ErrorCurve(str(label), times, square, se, runs, central[0], known, base.unit)
        curves.append(curve)
    return tuple(curves)


def _read_filter(row: dict[str, Any], names: tuple[str, ...]) -> ComparedFilter:
    quantities = {
        key: Quantity(row[key], *(row[f"{key}_{part}"] for part in PARTS)) for key in names
    }
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


def read_verdict(directory: Path, trust: bool = False) -> StoredVerdict:
    """Return the verdict in a directory; raises DamagedError or ScenarioError."""
    document = read_checked_document(directory, "verdict.json", VERDICT)
    _require_confidence(document)
    check_files(directory, document, ["scenario.toml"])
    return StoredVerdict(directory, load(directory / "scenario.toml", trust=trust), document)
