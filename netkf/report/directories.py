"""What a page shows of one directory, read without trust in its files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from netkf.core.errors import NetkfError, ScenarioError
from netkf.core.printable import shorten
from netkf.linalg.arrays import FloatArray
from netkf.runs.documents import (
    COUNT,
    NUMBER,
    SEAL,
    TEXT,
    TEXTS,
    DamagedError,
    check_files,
    check_seal,
    read_document,
    require,
)
from netkf.runs.parquet_files import column_names
from netkf.runs.summary import PromisedTraces, promise_traces
from netkf.scenario.reading import load
from netkf.scenario.scenario import Scenario
from netkf.studies.compare import damage_named
from netkf.trace.schema import CODES, EVENT, KINDS

MAX_EVENTS = 20_000_000
"""Events of one run that are read into memory, 50 bytes each; counts go on beyond."""
MAX_TEXT = 200_000
"""Characters of a scenario file that a page repeats."""
VALUES = ("rms_error", "mean_trace", "mean_nees", "bound", "ratio")
SLOT_ROUNDING = 1e-6
"""Share of a slot by which the time of a sample may lie before the slot begins."""
ROW: dict[str, Any] = dict.fromkeys(VALUES, NUMBER) | {f"{name}_se?": NUMBER for name in VALUES}
SUMMARY: dict[str, Any] = {
    "nodes": [{"node": COUNT, **ROW}],
    "overall": ROW,
    "limit": NUMBER,
    "central": NUMBER,
    "bound": TEXT,
    "notes": TEXTS,
    "messages": dict.fromkeys(("sent", "delivered", "lost", "in_flight"), NUMBER),
}
VERDICT_ROW: dict[str, Any] = {
    **dict.fromkeys(("promise", "source", "verdict", "evidence", "assumptions"), TEXT),
    **dict.fromkeys(("seen", "expected", "off", "detectable", "low", "high"), NUMBER),
}
VERDICT: dict[str, Any] = {
    "scenario": TEXT,
    "runs": COUNT,
    "confidence": NUMBER,
    "rows": [VERDICT_ROW],
}
MANIFEST: dict[str, Any] = {"status": TEXT, "runs": {"wanted": COUNT, "done": COUNT}}


@dataclass(frozen=True, eq=False)
class Trace:
    """Samples and events of one run.

    nodes (N,) in increasing order, times (T,), x (T, n), xhat (T, N, n), P (T, N, n, n), sq_error
    and nees (T, N), which are nan without known truth; ``log`` has the events (trace.schema.EVENT)
    and ``kinds`` the number of events of each kind, also of those that ``log`` leaves out because
    there are more than MAX_EVENTS.
    """

    replica: int
    nodes: tuple[int, ...]
    times: FloatArray
    x: FloatArray
    xhat: FloatArray
    P: FloatArray
    sq_error: FloatArray
    nees: FloatArray
    truth_known: bool
    log: np.ndarray
    kinds: dict[str, int]


@dataclass(frozen=True, eq=False)
class Source:
    """A directory as a page shows it; what it does not have is None or empty.

    label    : the directory as the user has named it
    kind     : run, ensemble, sweep or verdict
    problem  : why the scenario, and with it bounds and positions, is not available
    promised : bounds and limits at the times of the trace, or of the ensemble
    """

    label: str
    kind: str
    manifest: dict[str, Any]
    scenario_text: str
    scenario: Scenario | None = None
    problem: str = ""
    summary: dict[str, Any] | None = None
    trace: Trace | None = None
    ensemble: pd.DataFrame | None = None
    sweep: pd.DataFrame | None = None
    verdict: dict[str, Any] | None = None
    promised: PromisedTraces | None = None

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return str(self.manifest.get("name") or (self.verdict or {}).get("scenario") or self.label)

    @property
    def claim(self) -> str:
        """Claim of the scenario, empty if it is not known."""
        return self.scenario.claim if self.scenario is not None else ""

    @property
    def runs(self) -> int:
        """Number of runs that are done."""
        return int(self.manifest.get("runs", {}).get("done", 0))

    @property
    def knowledge(self) -> str:
        """What a sample at t knows: what arrived ``until`` t, ``before`` t (slots whose samples are
        predictions), or in the whole ``slot`` that begins at t (slots whose samples are filtered).
        """
        if self.scenario is None or not self.scenario.slotted:
            return "until"
        return "before" if self.scenario.hosted.predicts else "slot"

    def cuts(self, times: FloatArray) -> FloatArray:
        """Return, for samples at ``times`` (T,), the last instants (T,) that they know of."""
        kind = self.knowledge
        if kind == "until" or self.scenario is None:
            return times
        if kind == "before":
            return np.nextafter(times, -np.inf)
        period = self.scenario.plant.period
        return np.nextafter((np.floor(times / period + SLOT_ROUNDING) + 1.0) * period, -np.inf)

    @property
    def status(self) -> str:
        """Status of the manifest, such as ``complete`` or ``interrupted``."""
        return str(self.manifest.get("status", "complete"))


def read_source(directory: Path, replica: int | None = None, trust: bool = False) -> Source:
    """Return what a page shows of a directory of ``netkf run``, ``sweep`` or ``check``.

    ``replica`` chooses one of several recorded runs, by default the first. Runs that were
    interrupted or failed are read as far as they came. Raises ScenarioError if the directory is not
    one of netkf's, or if its files were changed since they were written.
    """
    where = shorten(directory)
    if not directory.is_dir():
        raise ScenarioError(where, "is not a directory", None, "name run directories")
    with damage_named(directory):
        if not (directory / "manifest.json").exists() and (directory / "verdict.json").exists():
            return _read_verdict_directory(directory, trust)
        manifest = _read_sealed(directory, "manifest.json", MANIFEST)
        source = Source(str(directory), "run", manifest, _read_text(directory / "scenario.toml"))
        check_files(directory, manifest, ["scenario.toml", "summary.json"])
        source = _with_scenario(source, directory, trust)
        if "vary" in manifest:
            return replace(source, kind="sweep", sweep=_read_table(directory / "sweep.parquet"))
        return _read_runs(source, directory, replica)


def _read_runs(source: Source, directory: Path, replica: int | None) -> Source:
    """Return the source of a run or an ensemble with its tables."""
    manifest = source.manifest
    summary = None
    if (directory / "summary.json").exists():
        summary = read_document(directory / "summary.json")
        require(summary, SUMMARY)
    check_files(directory, manifest, ["events.parquet", "states.parquet", "ensemble.parquet"])
    trace = _read_trace(directory, replica)
    table = _read_table(directory / "ensemble.parquet")
    verdict = None
    if (directory / "verdict.json").exists():
        verdict = _read_sealed(directory, "verdict.json", VERDICT)
    kind = "ensemble" if manifest["runs"]["wanted"] > 1 or table is not None else "run"
    source = replace(
        source, kind=kind, summary=summary, trace=trace, ensemble=table, verdict=verdict
    )
    return _with_bounds(source)


def _read_verdict_directory(directory: Path, trust: bool) -> Source:
    verdict = _read_sealed(directory, "verdict.json", VERDICT)
    manifest = {"name": verdict["scenario"], "seed": verdict.get("seed"), "status": "complete"}
    manifest |= {"runs": {"done": verdict["runs"], "wanted": verdict["runs"]}}
    manifest |= {"versions": verdict.get("versions", {})}
    text = _read_text(directory / "scenario.toml")
    source = Source(str(directory), "verdict", manifest, text, verdict=verdict)
    return _with_scenario(source, directory, trust)


def _read_sealed(directory: Path, name: str, form: dict[str, Any]) -> dict[str, Any]:
    try:
        document = read_document(directory / name)
        require(document, form)
        if SEAL in document:  # older versions wrote none
            check_seal(document)
    except DamagedError as error:
        raise DamagedError(f"{name} {error}") from None
    return document


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")[:MAX_TEXT]
    except (OSError, ValueError):
        return ""


def _with_scenario(source: Source, directory: Path, trust: bool) -> Source:
    """Return the source with its scenario, or with the reason why there is none: a page without
    bounds is better than none where the scenario names a class of the user.
    """
    try:
        return replace(source, scenario=load(directory / "scenario.toml", trust=trust))
    except (NetkfError, OSError) as error:
        return replace(source, problem=str(error))


def _with_bounds(source: Source) -> Source:
    times = None
    if source.trace is not None:
        times = source.trace.times
    elif source.ensemble is not None:
        times = np.unique(source.ensemble["t"].to_numpy())
    if source.scenario is None or times is None:
        return source
    return replace(source, promised=promise_traces(source.scenario, times))


def _read_table(path: Path) -> pd.DataFrame | None:
    """Return a small Parquet table with any columns, None if there is none."""
    if not path.exists():
        return None
    try:
        return pd.DataFrame(pq.read_table(path).to_pandas())
    except (OSError, ValueError, TypeError, MemoryError, pa.ArrowException) as error:
        raise DamagedError(f"{path.name} cannot be read ({type(error).__name__})") from None


def _read_trace(directory: Path, replica: int | None) -> Trace | None:
    """Return samples and events of one replica, None if the directory has no tables."""
    path = directory / "states.parquet"
    if not path.exists():
        return None
    names = column_names(path)
    n = sum(name[:1] == "x" and name[1:].isdecimal() for name in names)
    errors = [name for name in ("sq_error", "nees") if name in names]
    first = names.index("xhat0") if "xhat0" in names else 0
    wanted = ["run", "t", "node", *names[first - n : first + n]]
    upper = n * (n + 1) // 2
    wanted += [*names[first + n : first + n + upper], *errors]
    if n == 0 or len(wanted) != 3 + 2 * n + upper + len(errors):
        raise DamagedError("states.parquet lacks columns of states")
    states = _read_states(path, wanted)
    chosen = _choose_replica(states["run"], replica)
    states = states[states["run"] == chosen]
    log, kinds = _read_events(directory / "events.parquet", chosen)
    return _trace(chosen, states.to_numpy(dtype=np.float64), n, bool(errors), log, kinds)


def _read_states(path: Path, columns: list[str]) -> pd.DataFrame:
    """Return columns of numbers; empty cells, such as an unknown truth, are nan."""
    try:
        table = pq.read_table(path, columns=columns)
        return pd.DataFrame(table.to_pandas(), dtype=np.float64)
    except (OSError, ValueError, TypeError, MemoryError, pa.ArrowException) as error:
        raise DamagedError(f"{path.name} cannot be read ({type(error).__name__})") from None


def _choose_replica(runs: pd.Series[int], replica: int | None) -> int:
    found = np.unique(runs.to_numpy())
    if replica is None:
        return int(found[0]) if len(found) else 0
    if replica not in found:
        known = ", ".join(map(str, found[:10].tolist())) + (", ..." if len(found) > 10 else "")
        remedy = f"recorded are {known}; run with --trace full"
        raise ScenarioError("--replica", "is not among the recorded runs", replica, remedy)
    return replica


def _trace(
    replica: int, rows: FloatArray, n: int, errors: bool, log: np.ndarray, kinds: dict[str, int]
) -> Trace:
    """Return a trace from rows run, t, node, x, xhat, upper triangle of P, and errors."""
    nodes = np.unique(rows[:, 2]).astype(np.int64)
    count = max(1, len(nodes))
    if len(rows) % count:
        raise DamagedError("states.parquet lacks rows of some nodes")
    grid = rows.reshape(len(rows) // count, count, rows.shape[1])
    if (grid[:, :, 2] != nodes).any() or (grid[:, :, 1] != grid[:, :1, 1]).any():
        raise DamagedError("states.parquet has rows out of order")
    i, j = np.triu_indices(n)
    P = np.empty((*grid.shape[:2], n, n))
    P[..., i, j] = P[..., j, i] = grid[..., 3 + 2 * n : 3 + 2 * n + len(i)]
    unknown = np.full(grid.shape[:2], np.nan)
    return Trace(
        replica,
        tuple(nodes.tolist()),
        np.array(grid[:, 0, 1]) if len(nodes) else np.empty(0),
        np.array(grid[:, 0, 3 : 3 + n]) if len(nodes) else np.empty((0, n)),
        np.array(grid[:, :, 3 + n : 3 + 2 * n]),
        P,
        np.array(grid[:, :, -2]) if errors else unknown,
        np.array(grid[:, :, -1]) if errors else unknown,
        errors,
        log,
        kinds,
    )


def _read_events(path: Path, replica: int) -> tuple[np.ndarray, dict[str, int]]:
    """Return the events of a replica (at most MAX_EVENTS) and the number of each kind."""
    kinds = dict.fromkeys(KINDS, 0)
    blocks: list[np.ndarray] = []
    rows = 0
    if not path.exists():
        return np.empty(0, dtype=EVENT), kinds
    columns = ["run", *(name for name in EVENT.names or ())]
    try:
        with pq.ParquetFile(path) as file:
            for batch in file.iter_batches(columns=columns):
                block = _event_rows(batch, replica)
                for code, count in enumerate(np.bincount(block["kind"], minlength=len(KINDS))):
                    kinds[KINDS[code]] += int(count)
                blocks.append(block[: max(0, MAX_EVENTS - rows)])
                rows += len(blocks[-1])
    except (OSError, ValueError, TypeError, KeyError, MemoryError, pa.ArrowException) as error:
        raise DamagedError(f"{path.name} cannot be read ({type(error).__name__})") from None
    return np.concatenate(blocks) if blocks else np.empty(0, dtype=EVENT), kinds


def _event_rows(batch: Any, replica: int) -> np.ndarray:
    """Return the rows of a replica in a record batch of events.parquet as EVENT rows."""
    table = batch.to_pandas()
    table = table[table["run"] == replica]
    kinds = table["kind"].astype("category")
    codes = np.array([CODES[str(kind)] for kind in kinds.cat.categories], dtype=np.uint8)
    found = np.empty(len(table), dtype=EVENT)
    for name in EVENT.names or ():
        if name != "kind":
            found[name] = table[name].to_numpy()
    found["kind"] = codes[kinds.cat.codes.to_numpy()] if len(codes) else 0
    return found
