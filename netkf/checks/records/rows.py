"""Promises about what is recorded of runs: looked at in the first replicas, and exactly."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

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
from netkf.checks.records.files import FilesUnknownError, files_fault
from netkf.checks.records.states import sample_fault, start_fault, twin_fault, with_start
from netkf.engines.base import Engine
from netkf.engines.simpy.engine import SimpyEngine
from netkf.runs.simulate import simulate
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

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


def _find_fault(
    name: str, looked: int, what: str, audits: Sequence[Audit], level: float
) -> Finding:
    """Return the finding on one entry of the audits: broken if it names a fault in any run."""
    entries = [(k, getattr(audit, name)) for k, audit in enumerate(audits) if audit.looked[looked]]
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
