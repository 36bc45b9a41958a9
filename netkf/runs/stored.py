"""A run that is read back from its directory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.runs.documents import (
    COUNT,
    NUMBER,
    SEAL,
    TEXT,
    DamagedError,
    check_files,
    check_seal,
    damage_in,
    read_document,
    require,
)
from netkf.runs.parquet_files import column_names, read_numbers, read_texts
from netkf.runs.summary import PromisedTraces, promise_traces
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES, EVENT, state_columns

if TYPE_CHECKING:
    import pandas as pd

AVERAGE: dict[str, Any] = {
    f"{name}{end}": NUMBER
    for name in ("rms_error", "mean_trace", "mean_nees", "bound?", "ratio?")
    for end in ("", "_se?")
    if not (end and name.endswith("?"))
}
SUMMARY: dict[str, Any] = {
    "nodes": [{"node": COUNT, **AVERAGE}],
    "overall": AVERAGE,
    "messages": {"sent": NUMBER, "delivered": NUMBER, "lost": NUMBER},
    "rounding_from?": NUMBER,
}
MANIFEST: dict[str, Any] = {
    "name": TEXT,
    "status": TEXT,
    "seed": COUNT,
    "replica?": COUNT,
    "engine?": TEXT,
    "events?": COUNT,
    "fingerprint?": TEXT,
    "runs": {"wanted": COUNT, "done": COUNT},
    "simpy?": {},
}
TABLES = ("states.parquet", "events.parquet")


class WithPromises:
    """What theory promises about results that are read back: they know their scenario and times."""

    scenario: Any
    times: FloatArray

    @cached_property
    def promised(self) -> PromisedTraces:
        """Return what theory promises at the sample times: bound, limit, centralised filter."""
        return promise_traces(self.scenario, self.times)

    @property
    def bound(self) -> FloatArray | None:
        """Return traces (T, N) of the bound H(12) at the samples, None if it does not apply."""
        return self.promised.bound


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StoredRun(WithPromises, Run):
    """A run that is read back from ``directory``, with its ``manifest`` and ``summary``.

    ``error`` is the difference of the stored x and xhat, so that it has lost digits where both are
    large; ``sq_error``, ``nees`` and ``states`` are those that were written and have lost none.
    Without tables (``--trace none``) it has no samples and no events.
    """

    directory: Path
    manifest: dict[str, Any]
    summary: dict[str, Any]
    stored: pd.DataFrame = field(repr=False)

    @cached_property
    def states(self) -> pd.DataFrame:
        """Return the table of state samples as it was written."""
        return self.stored

    @cached_property
    def sq_error(self) -> FloatArray:
        """Return the squared errors (T, N) as they were written, nan without known truth."""
        return self._column("sq_error")

    @cached_property
    def nees(self) -> FloatArray:
        """Return the NEES (T, N) as it was written, nan where it is unknown."""
        return self._column("nees")

    def _column(self, name: str) -> FloatArray:
        """Return one column of the samples (T, N), nan if the file does not have it."""
        shape = len(self.times), len(self.nodes)
        if name not in self.stored:
            return np.full(shape, np.nan)
        return self.stored[name].to_numpy(dtype=np.float64).reshape(shape)


def read_form(directory: Path, name: str, form: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON document of a directory that has a form; raises DamagedError."""
    with damage_in(name):
        document = read_document(directory / name)
        require(document, dict(form))
        if SEAL in document:
            check_seal(document)
    return document


def read_run(
    directory: Path, scenario: Scenario, manifest: dict[str, Any], replica: int | None = None
) -> StoredRun:
    """Return the run in a directory, or one ``replica`` of an ensemble that kept its trace.

    ``manifest`` has passed MANIFEST. Raises DamagedError for files that are not as netkf writes
    them.
    """
    check_files(directory, manifest, [*TABLES, "summary.json"])
    summary = read_form(directory, "summary.json", SUMMARY)
    single = replica is None
    number = int(manifest.get("replica", 0)) if replica is None else replica
    states, arrays = _read_states(directory / "states.parquet", scenario, number)
    log = _read_events(directory / "events.parquet", scenario, number)
    conserved = summary.get("conserved", {}) if single else {}
    return StoredRun(
        **arrays,
        nodes=scenario.nodes,
        log=log,
        seed=int(manifest["seed"]),
        replica=number,
        engine=str(manifest.get("engine", "")),
        status=str(manifest["status"]) if single else _read_status(log),
        fingerprint=str(manifest.get("fingerprint", "")) if single or number == 0 else "",
        sums=_read_sums(conserved),
        truth_known=scenario.plant.truth_known,
        stats=dict(manifest.get("simpy", {})) if single else {},
        scenario=scenario,
        directory=directory,
        manifest=manifest,
        summary=summary,
        stored=states,
    )


def _read_status(log: np.ndarray) -> str:
    """Return "diverged" or "complete"."""
    return "diverged" if (log["kind"] == CODES["diverged"]).any() else "complete"


def _read_sums(conserved: Any) -> dict[str, tuple[float, float]]:
    """Return the conserved sums of a manifest; raises DamagedError."""
    form = {"exact": NUMBER, "total": NUMBER}
    require(conserved, {}, "conserved")
    for name, found in conserved.items():
        require(found, form, f"conserved.{name}")
    return {name: (found["exact"], found["total"]) for name, found in conserved.items()}


def _read_states(
    path: Path, scenario: Scenario, replica: int
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Return the table of samples of a replica, and the arrays of a Run that stand in it."""
    import pandas as pd

    n, N = scenario.plant.n, len(scenario.nodes)
    names = state_columns(n)
    if not scenario.plant.truth_known:
        names = names[:-2]
    if path.exists():
        if column_names(path) != names:
            raise DamagedError(f"{path.name} does not have the columns of this scenario")
        table = read_numbers(path, names, replica, missing=True)
    else:
        table = pd.DataFrame({name: np.empty(0) for name in names})
    T = len(table) // N
    times = table["t"].to_numpy(dtype=np.float64)[::N]
    whole = len(table) == T * N and np.array_equal(table["node"], np.tile(scenario.nodes, T))
    if not (
        whole and np.array_equal(table["t"], np.repeat(times, N)) and (np.diff(times) > 0).all()
    ):
        raise DamagedError(f"{path.name} does not have a row for each time and node")
    values = table[names[3:]].to_numpy(dtype=np.float64).reshape(T, N, len(names) - 3)
    x, xhat = values[:, 0, :n], values[:, :, n : 2 * n]
    i, j = np.triu_indices(n)
    P = np.empty((T, N, n, n))
    P[:, :, i, j] = P[:, :, j, i] = values[:, :, 2 * n : 2 * n + len(i)]
    return table, {"times": times, "x": x, "xhat": xhat, "P": P, "error": x[:, None] - xhat}


def _read_events(path: Path, scenario: Scenario, replica: int) -> np.ndarray:
    """Return the events of a replica as EVENT rows; none without the file."""
    if not path.exists():
        return np.empty(0, dtype=EVENT)
    columns = [name for name in EVENT.names or () if name != "kind"]
    table = read_numbers(path, columns, replica, missing=True)
    kinds = read_texts(path, "kind", replica)
    codes = kinds.cat.categories.map(CODES)
    if codes.hasnans:
        raise DamagedError(f"{path.name} has events of an unknown kind")
    rows = np.empty(len(table), dtype=EVENT)
    for name in columns:
        whole = EVENT[name].kind == "i"
        if whole and table[name].dtype.kind != "i":
            raise DamagedError(f"{path.name} has no column {name} of integers")
        rows[name] = table[name]
    rows["kind"] = np.asarray(codes, dtype=np.uint8)[kinds.cat.codes]
    known = [-1, *scenario.nodes]
    if not (np.isin(rows["node"], known).all() and np.isin(rows["peer"], known).all()):
        raise DamagedError(f"{path.name} has events of nodes that the scenario does not have")
    if not np.isfinite(rows["t"]).all() or (np.diff(rows["t"]) < 0.0).any():
        raise DamagedError(f"{path.name} has events out of order")
    return rows
