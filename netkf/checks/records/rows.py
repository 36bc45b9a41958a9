"""Promises about what is recorded of runs: looked at in the first replicas, and exactly; the
directory of a run read back is held against the run in memory, by plain formulas.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.evidence import (
    ENGINES,
    EVENTS,
    FILES,
    STARTS,
    STATES,
    Finding,
    Promise,
    find_unknown,
)
from netkf.checks.records.events import event_fault
from netkf.checks.records.states import sample_fault, start_fault, twin_fault, with_start
from netkf.core.errors import NetkfError
from netkf.engines.base import Engine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.linalg.arrays import FloatArray
from netkf.runs.documents import DamagedError
from netkf.runs.run import run_to_directory, save
from netkf.runs.simulate import simulate
from netkf.runs.stored import MANIFEST_FORM, StoredRun, read_checked_document, read_run
from netkf.scenario.scenario import Scenario
from netkf.trace.nees import traces, without_padding
from netkf.trace.run import Run
from netkf.trace.schema import CODES, rows_of

FILE_TOLERANCE = 1e-9
"""Relative difference above which an average or a column is not that of the run."""


class FilesUnknownError(Exception):
    """The files of a run cannot be written or read here, with the reason."""


def files_fault(scenario: Scenario, run: Run, engine: Engine) -> str:
    """Return the first difference between ``run`` and the files that ``netkf run`` and
    ``netkf.save`` write of it; empty without one. Raises FilesUnknownError if that fails.
    """
    seeded = dataclasses.replace(scenario, seed=run.seed)
    try:
        with tempfile.TemporaryDirectory(prefix="netkf-check-") as folder:
            by_run, by_save = Path(folder) / "run", Path(folder) / "saved"
            run_to_directory(seeded, by_run, engine, replica=run.replica)
            save(run, seeded, by_save)
            return _directory_fault(run, seeded, by_run) or _directory_fault(run, seeded, by_save)
    except DamagedError as error:
        return f"the files cannot be read back: {error}"
    except (NetkfError, OSError) as error:
        raise FilesUnknownError(str(error)) from None


def _directory_fault(run: Run, scenario: Scenario, directory: Path) -> str:
    manifest = read_checked_document(directory, "manifest.json", MANIFEST_FORM)
    stored = read_run(directory, scenario, manifest)
    if scenario.views is not None:
        # Blocks that nobody estimates are not stored.
        x, kept = np.full_like(run.x, np.nan), np.unique(np.concatenate(scenario.views))
        x[:, kept] = run.x[:, kept]
        run = dataclasses.replace(run, x=x)
    return _tables_fault(run, stored) or _summary_fault(run, stored)


def _tables_fault(run: Run, stored: StoredRun) -> str:
    manifest = stored.manifest
    facts = {
        "status": (manifest["status"], run.status),
        "fingerprint": (manifest.get("fingerprint"), run.fingerprint),
        "number of events": (manifest.get("events"), len(run.log)),
        "seed": (manifest["seed"], run.seed),
        "replica": (manifest.get("replica"), run.replica),
    }
    for name, (seen, expected) in facts.items():
        if seen != expected:
            return f"manifest.json: {name} {seen}, not {expected}"
    if stored.log.tobytes() != run.log.tobytes():
        return f"events.parquet: {len(stored.log):,} events, not the {len(run.log):,} of the run"
    for name in ("times", "x", "xhat", "P"):
        if not np.array_equal(getattr(stored, name), getattr(run, name), equal_nan=True):
            return f"states.parquet: {name} is not that of the run"
    if not run.truth_known:
        return ""
    square, nees = _squares(run)
    for name, seen, expected in (
        ("sq_error", stored.sq_error, square),
        ("nees", np.where(np.isnan(nees), np.nan, stored.nees), nees),
    ):
        if not np.allclose(seen, expected, rtol=FILE_TOLERANCE, atol=0.0, equal_nan=True):
            return f"states.parquet: {name} is not that of errors and P"
    return ""


def _squares(run: Run) -> tuple[FloatArray, FloatArray]:
    """Return e' e and e' P^-1 e (T, N), nan where P is not well conditioned."""
    e, P = without_padding(run.error, run.P)
    finite = np.asarray(np.isfinite(P).all(axis=(2, 3)))
    P = np.where(finite[..., None, None], P, np.eye(P.shape[-1]))
    with np.errstate(all="ignore"):
        usable = finite & (np.linalg.cond(P) < 1e6)
        P = np.where(usable[..., None, None], P, np.eye(P.shape[-1]))
        solved = np.linalg.solve(P, e[..., None])[..., 0]
        return (e**2).sum(axis=2), np.where(usable, (e * solved).sum(axis=2), np.nan)


def _is_close(seen: float | None, expected: float) -> bool:
    """Return True if numbers are equal up to rounding; nan equals nan, and None is nan."""
    if seen is None or math.isnan(seen):
        return math.isnan(expected)
    return math.isclose(seen, expected, rel_tol=FILE_TOLERANCE)


def _summary_fault(run: Run, stored: StoredRun) -> str:
    """Return a fault of summary.json, whose counts and averages should be those of ``run``."""
    summary, kinds = stored.summary, run.log["kind"]
    count = {kind: int((kinds == code).sum()) for kind, code in CODES.items()}
    senders = Counter(run.log["node"][kinds == CODES["send"]].tolist())
    transmissions = _transmissions(run)
    expected = {
        "sent": count["send"],
        "delivered": count["deliver"],
        "lost": count["lost"] + count["late"],
        "transmissions": sum(transmissions.values()),
        "in_flight": count["send"] - count["deliver"] - count["lost"] - count["late"],
    }
    for name, value in expected.items():
        if summary["messages"].get(name) != value:
            return f"summary.json: messages.{name} {summary['messages'].get(name)}, not {value}"
    totals = {name: entry["total"] for name, entry in summary.get("conserved", {}).items()}
    if totals != {name: now for name, (_, now) in run.sums.items()}:
        return "summary.json: conserved sums are not those of the run"
    rows = {row["node"]: row for row in summary["nodes"]}
    if list(rows) != list(run.nodes):
        return "summary.json: its nodes are not those of the run"
    for node in run.nodes:
        for name, value in (("sent", senders[node]), ("transmissions", transmissions.get(node, 0))):
            if rows[node].get(name) != value:
                return f"summary.json: {name} of node {node} {rows[node].get(name)}, not {value}"
    return _averages_fault(run, summary, rows) if run.status == "complete" else ""


def _transmissions(run: Run) -> dict[int, int]:
    rows = rows_of(run.log, "send", "transmit", "round")
    sends = rows["kind"] == CODES["send"]
    broadcasts = rows["node"][rows["kind"] == CODES["transmit"]]
    if (rows["phase"][sends] >= 0).any():
        keys = rows[sends][["node", "t", "phase"]]
        broadcasts = np.unique(keys)["node"]
    elif not len(broadcasts):
        broadcasts = rows["node"][sends]
    nodes, counts = np.unique(broadcasts, return_counts=True)
    return dict(zip(nodes.tolist(), counts.tolist(), strict=True))


def _averages_fault(run: Run, summary: dict[str, Any], rows: dict[int, Any]) -> str:
    after = run.times > 0.0
    after = after if after.any() else np.ones(len(run.times), dtype=bool)
    blurred_from = summary.get("rounding_from")
    exact = after & (run.times < (np.inf if blurred_from is None else blurred_from))
    with np.errstate(all="ignore"):
        square, nees = (_mean(values[exact]) for values in _squares(run))
        trace = _mean(traces(run.P)[after])
    columns = {"rms_error": square, "mean_trace": trace, "mean_nees": nees}
    for place in (*range(len(run.nodes)), None):
        row = summary["overall"] if place is None else rows[run.nodes[place]]
        who = "all nodes" if place is None else f"node {run.nodes[place]}"
        for name, values in columns.items():
            value = float(values.mean() if place is None else values[place])
            value = math.sqrt(value) if name == "rms_error" else value
            unknown = name == "mean_nees" and math.isnan(value)
            if not unknown and not _is_close(row[name], value):
                return f"summary.json: {name} of {who} {row[name]}, not {value:.9g}"
        # Without noise, from a known start, the bound is 0.
        ratio = row["mean_trace"] / row["bound"] if row.get("bound") else None
        if ratio is not None and not _is_close(row["ratio"], ratio):
            return f"summary.json: ratio of {who} {row['ratio']}, not {ratio:.9g}"
    return ""


def _mean(values: FloatArray) -> FloatArray:
    """Return the means (N,) of ``values`` (T, N) over time; nan without a sample."""
    return values.mean(axis=0) if len(values) else np.full(values.shape[1], np.nan)


AUDITED_RUNS, AUDITED_EVENTS = 10, 20_000
"""Replicas whose record is looked at, the first ones, and events of a longer run, of which only
replica 0 is.
"""
TWIN_EVENTS, TWIN_SLOTS, MAX_TWIN_EVENTS = 4_000, 3, 200_000
"""Events of the run that is done on both engines and written to files, about: a longer one is cut
at an earlier horizon, in slots at no fewer slots than these. If it still has more events than the
last number, it is not done on the other engine, which would take a minute.
"""
UNKNOWN = "not looked at: "
"""Beginning of the entry of an audit that says why there is nothing to compare."""
ONE_ENGINE = f"{UNKNOWN}only the SimPy engine runs this scenario"


class Audit(NamedTuple):
    """What is wrong with the record of one run, one line each, empty where nothing is.

    events  : events against the rules of the record
    samples : number, status, times, true states and errors
    start   : estimates and covariances at time 0, weights of links
    engines : difference of a run on both engines
    files   : difference of its files from the run in memory
    looked  : number of runs behind the entry: 0 or 1, of ``events`` and ``samples``, then of others
    """

    events: str = ""
    samples: str = ""
    start: str = ""
    engines: str = ""
    files: str = ""
    looked: tuple[int, int] = (0, 0)


def audit_run(scenario: Scenario, run: Run, seed: int, replica: int, engine: Engine) -> Audit:
    """Return what is wrong with the record of a ``run``; of replica 0 also on both engines."""
    if replica >= AUDITED_RUNS or (replica > 0 and len(run.log) > AUDITED_EVENTS):
        return Audit()
    audit = audit_record(scenario, run, seed, replica)
    return audit if replica > 0 else _audit_twin(scenario, run, audit, engine)


def audit_record(scenario: Scenario, run: Run, seed: int, replica: int) -> Audit:
    """Return what is wrong with the events and samples of ``run``, see :func:`audit_run`."""
    faults = event_fault(scenario, run), sample_fault(scenario, run, seed, replica)
    return Audit(*faults, looked=(1, 0))


def _audit_twin(scenario: Scenario, run: Run, audit: Audit, engine: Engine) -> Audit:
    """Return the ``audit`` with that of a shorter run on both engines and in files."""
    short = with_start(scenario, _short_horizon(scenario, len(run.log)), run.log)
    again = simulate(short, run.seed, run.replica, engine)
    twin = ONE_ENGINE
    if len(again.log) > MAX_TWIN_EVENTS:
        twin = f"{UNKNOWN}{TWIN_SLOTS} slots have {len(again.log):,} events"
    elif engine.name != SimpyEngine.name:
        twin = twin_fault(short, again, simulate(short, run.seed, run.replica, SimpyEngine()))
    try:
        files = files_fault(short, again, engine)
    except FilesUnknownError as reason:
        files = f"{UNKNOWN}{reason}"
    return Audit(
        audit.events or event_fault(short, again),
        audit.samples or sample_fault(short, again, run.seed, run.replica),
        start_fault(short, again),
        twin,
        files,
        looked=(1, 1),
    )


def _short_horizon(scenario: Scenario, events: int) -> float:
    """Return a horizon in seconds of which a run has about TWIN_EVENTS events."""
    horizon = scenario.horizon * min(1.0, TWIN_EVENTS / max(events, 1))
    if not scenario.slotted or horizon == scenario.horizon:
        return horizon
    period = scenario.slot_plant.period
    return min(scenario.horizon, period * max(TWIN_SLOTS, round(horizon / period)))


def record_promises(audits: Sequence[Audit]) -> tuple[Promise, ...]:
    """Return the promises about the record of runs that ``audits`` tell something about."""
    if not any(audit.looked[0] for audit in audits):
        return ()
    one_engine = any(audit.engines == ONE_ENGINE for audit in audits)
    return tuple(row for row in PROMISES if row.group != ENGINES or not one_engine)


def _find_fault(name: str, seen: int, what: str, audits: Sequence[Audit], level: float) -> Finding:
    """Return the finding on one entry of the audits: broken if it names a fault in any run."""
    entries = [(k, getattr(audit, name)) for k, audit in enumerate(audits) if audit.looked[seen]]
    known = [(k, entry) for k, entry in entries if not entry.startswith(UNKNOWN)]
    if not known:
        return find_unknown(entries[0][1] if entries else f"{UNKNOWN}no run")
    faults = [(k, entry) for k, entry in known if entry]
    margin = -float(len(faults))
    message = f"{what} of {len(known)} {'run' if len(known) == 1 else 'runs'}"
    finding = Finding((margin, margin, margin), 0.0, message, seen=-margin, expected=0.0)
    if not faults:
        return finding
    replica, fault = faults[0]
    text = f"{message}: wrong in {len(faults)}; in run {replica} {fault}"
    return finding._replace(message=text, replica=replica, off=-margin)


PROMISES = tuple(
    Promise(statement, "the record", (), partial(_find_fault, *entry), exact=True, group=group)
    for statement, entry, group in (
        (
            "events are recorded once, in order, with their numbers",
            ("events", 0, "order, numbers, readings, ticks and ends of messages"),
            EVENTS,
        ),
        (
            "states are those that the plant draws, errors are x - xhat",
            ("samples", 0, "status, times, x drawn again, and x - xhat"),
            STATES,
        ),
        (
            "estimates, covariances and weights begin as [filter] says",
            ("start", 1, "xhat and P at time 0, and weights,"),
            STARTS,
        ),
        (
            "both engines make the same events and states",
            ("engines", 1, "events to the bit, xhat and P to rounding,"),
            ENGINES,
        ),
        (
            "files hold the run, and the summary counts it",
            ("files", 1, "tables, manifest, counts and averages"),
            FILES,
        ),
    )
)


def audit_columns(audits: Sequence[Audit]) -> dict[str, np.ndarray]:
    """Return the audits of R runs as arrays with a first axis R, by name, for storage."""
    return {f"audit.{name}": np.array([getattr(a, name) for a in audits]) for name in Audit._fields}


def read_audit(values: dict[str, np.ndarray]) -> Audit:
    """Return the audit of one run from its entries of :func:`audit_columns`, by name."""
    texts = {name: str(values[name]) for name in Audit._fields if name != "looked"}
    samples, others = np.asarray(values["looked"]).tolist()
    return Audit(**texts, looked=(int(samples), int(others)))
