"""``netkf.open``: read what a command wrote back from its directory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from netkf.core.errors import ScenarioError
from netkf.core.fields import as_path
from netkf.core.notebook import NotebookTable
from netkf.core.printable import shorten
from netkf.ensembles.stored import StoredEnsemble, read_ensemble
from netkf.runs.documents import TEXT, DamagedError, check_files, require_form
from netkf.runs.parquet_files import column_names, is_numeric_column, read_numbers, read_texts
from netkf.runs.stored import MANIFEST_FORM, StoredRun, read_checked_document, read_run
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario
from netkf.studies.stored import StoredComparison, StoredVerdict, read_comparison, read_verdict
from netkf.trace.run import plot_by_name

if TYPE_CHECKING:
    import pandas as pd

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
    name = shorten(directory)
    try:
        if not (folder / "manifest.json").exists() and (folder / "verdict.json").exists():
            return read_verdict(folder, trust)
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
