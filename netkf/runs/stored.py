"""Runs that are read back from their directories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.linalg.arrays import FloatArray, from_upper
from netkf.network.graphs import name_rows
from netkf.runs import documents
from netkf.runs.parquet_files import column_names, read_numbers, read_texts
from netkf.runs.summary import PromisedTraces, promise_traces
from netkf.runs.tables import COLUMNS
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES, EVENT, state_columns

if TYPE_CHECKING:
    import pandas as pd

_OPTIONAL = ("rms_error_se?", "mean_sq_error?", "mean_sq_error_se?", "mean_trace_se?", "bound_se?")
AVERAGES_FORM: dict[str, Any] = dict.fromkeys(
    (*COLUMNS, *_OPTIONAL, "mean_nees_se?"), documents.NUMBER
)
"""Forms of JSON values, see documents.require_form."""
MESSAGES = ("sent", "delivered", "lost")
SUMMARY_FORM: dict[str, Any] = {
    "nodes": [{"node": documents.COUNT, **AVERAGES_FORM}],
    "overall": AVERAGES_FORM,
    **dict.fromkeys(("limit", "central", "rounding_from?"), documents.NUMBER),
    "bound": documents.TEXT,
    "notes": documents.TEXTS,
    "messages": {**dict.fromkeys(MESSAGES, documents.NUMBER), "in_flight?": documents.NUMBER},
    "messages_se?": {f"{name}?": documents.NUMBER for name in MESSAGES},
}
MANIFEST_FORM: dict[str, Any] = {
    "name": documents.TEXT,
    "status": documents.TEXT,
    "seed": documents.COUNT,
    "replica?": documents.COUNT,
    "engine?": documents.TEXT,
    "events?": documents.COUNT,
    "fingerprint?": documents.TEXT,
    "runs": {"wanted": documents.COUNT, "done": documents.COUNT},
    "simpy?": {},
    "versions?": {},
    "error?": documents.TEXT,
}
TABLE_FILES = ("states.parquet", "events.parquet")


class WithPromises:
    """Mixin of results that are read back: what theory promises at their sample times (T,)."""

    scenario: Any
    times: FloatArray

    @cached_property
    def promised(self) -> PromisedTraces:
        """The traces that theory promises at the sample times: bound, limit, centralised filter."""
        return promise_traces(self.scenario, self.times)

    @property
    def bound(self) -> FloatArray | None:
        """Traces (T, N) of the bound H(12) at the sample times; None if it does not apply."""
        return self.promised.bound


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StoredRun(WithPromises, Run):
    """A run that is read back from ``directory``, with its ``manifest`` and ``summary``.

    ``error`` is the difference of the stored x and xhat, which loses digits if both are large;
    ``sq_error``, ``nees`` and ``states`` are as the run wrote them, and ``stored`` is the table of
    state samples. A run without tables (``--trace none``) has no samples and no events.
    """

    directory: Path
    manifest: dict[str, Any]
    summary: dict[str, Any]
    stored: pd.DataFrame = field(repr=False)

    @cached_property
    def states(self) -> pd.DataFrame:
        """The table of state samples as the run wrote it."""
        return self.stored.copy()

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the events, as the run wrote it; an ensemble writes that of its first run."""
        if self.replica == int(self.manifest.get("replica", 0)):
            return str(self.manifest.get("fingerprint", ""))
        return super().fingerprint

    @cached_property
    def sq_error(self) -> FloatArray:
        """Squared errors (T, N) as the run wrote them; nan without ground truth."""
        return self._column("sq_error")

    @cached_property
    def nees(self) -> FloatArray:
        """NEES (T, N) as the run wrote it; nan where it is unknown."""
        return self._column("nees")

    def _column(self, name: str) -> FloatArray:
        """Return a column of the state samples as an array (T, N), nan if the table lacks it."""
        shape = len(self.times), len(self.nodes)
        if name not in self.stored:
            return np.full(shape, np.nan)
        return self.stored[name].to_numpy(dtype=np.float64).reshape(shape)


def read_checked_document(directory: Path, name: str, form: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON document ``name`` of a directory; raises DamagedError without the keys and
    types of ``form``, or if its seal (a digest of its other entries) does not fit.
    """
    with documents.add_file_name(name):
        document = documents.read_document(directory / name)
        documents.require_form(document, dict(form))
        if documents.SEAL in document:
            documents.check_seal(document)
    return document


def read_run(
    directory: Path, scenario: Scenario, manifest: dict[str, Any], replica: int | None = None
) -> StoredRun:
    """Return the run in a directory, or one recorded ``replica`` of an ensemble; the ``manifest``
    has MANIFEST_FORM. Raises DamagedError.
    """
    documents.check_files(directory, manifest, [*TABLE_FILES, "summary.json"])
    summary = read_checked_document(directory, "summary.json", SUMMARY_FORM)
    name_rows(summary["nodes"])
    # In the directory of an ensemble the manifest and the summary are about all of its runs.
    is_single_run = replica is None
    if replica is None:
        replica = int(manifest.get("replica", 0))
    states, arrays = _read_states(directory / "states.parquet", scenario, replica)
    log = _read_events(directory / "events.parquet", scenario, replica)
    conserved = summary.get("conserved", {}) if is_single_run else {}
    documents.require_form(conserved, {}, "conserved")
    for name, entry in conserved.items():
        documents.require_form(
            entry, {"exact": documents.NUMBER, "total": documents.NUMBER}, f"conserved.{name}"
        )
    ended = "diverged" if (log["kind"] == CODES["diverged"]).any() else "complete"
    return StoredRun(
        **arrays,
        nodes=scenario.nodes,
        log=log,
        seed=int(manifest["seed"]),
        replica=replica,
        engine=str(manifest.get("engine", "")),
        status=str(manifest["status"]) if is_single_run else ended,
        sums={name: (entry["exact"], entry["total"]) for name, entry in conserved.items()},
        truth_known=scenario.plant.truth_known,
        stats=dict(manifest.get("simpy", {})) if is_single_run else {},
        scenario=scenario,
        directory=directory,
        manifest=manifest,
        summary=summary,
        stored=states,
    )


def _read_states(
    path: Path, scenario: Scenario, replica: int
) -> tuple[pd.DataFrame, dict[str, Any]]:
    import pandas as pd

    n, N = scenario.width, len(scenario.nodes)
    names = state_columns(n)
    if not scenario.plant.truth_known:
        names = names[:-2]  # without sq_error and nees
    if path.exists():
        if column_names(path) != names:
            raise documents.DamagedError(f"{path.name} does not have the columns of this scenario")
        table = read_numbers(path, names, replica, allow_empty=True)
    else:
        table = pd.DataFrame({name: np.empty(0) for name in names})
    T = len(table) // N  # the table has a row for each time and node
    times = table["t"].to_numpy(dtype=np.float64)[::N]
    has_all_rows = (
        len(table) == T * N
        and np.array_equal(table["node"], np.tile(scenario.nodes, T))
        and np.array_equal(table["t"], np.repeat(times, N))
        and (np.diff(times) > 0).all()
    )
    if not has_all_rows:
        raise documents.DamagedError(f"{path.name} does not have a row for each time and node")
    # After run, t and node: x, xhat and the upper triangle of P, row by row.
    values = table[names[3:]].to_numpy(dtype=np.float64).reshape(T, N, len(names) - 3)
    seen, xhat = values[:, :, :n], values[:, :, n : 2 * n]
    P = from_upper(values[:, :, 2 * n : 2 * n + n * (n + 1) // 2], n)
    x = seen[:, 0]
    if scenario.views is not None:
        # Blocks that nobody estimates are not stored.
        x = np.full((T, scenario.plant.n), np.nan)
        for k, view in enumerate(scenario.views):
            x[:, view] = seen[:, k, : len(view)]
    with np.errstate(invalid="ignore"):  # a run that diverged ends with infinite numbers
        error = seen - xhat
    return table, {"times": times, "x": x, "xhat": xhat, "P": P, "error": error}


def _read_events(path: Path, scenario: Scenario, replica: int) -> np.ndarray:
    """Return the E events of a replica as EVENT rows (E,), in order of time."""
    if not path.exists():
        return np.empty(0, dtype=EVENT)
    columns = [name for name in EVENT.names or () if name != "kind"]
    table = read_numbers(path, columns, replica, allow_empty=True)
    kinds = read_texts(path, "kind", replica)
    codes = kinds.cat.categories.map(CODES)
    if codes.hasnans:
        raise documents.DamagedError(f"{path.name} has events of an unknown kind")
    rows = np.empty(len(table), dtype=EVENT)
    for name in columns:
        if EVENT[name].kind == "i" and table[name].dtype.kind != "i":
            raise documents.DamagedError(f"{path.name} has no column {name} of integers")
        rows[name] = table[name]
    rows["kind"] = np.asarray(codes, dtype=np.uint8)[kinds.cat.codes]
    nodes = [-1, *scenario.nodes]  # -1: the event has no node, or no peer
    if not (np.isin(rows["node"], nodes).all() and np.isin(rows["peer"], nodes).all()):
        raise documents.DamagedError(
            f"{path.name} has events of nodes that the scenario does not have"
        )
    if not np.isfinite(rows["t"]).all() or (np.diff(rows["t"]) < 0.0).any():
        raise documents.DamagedError(f"{path.name} has events out of order")
    return rows
