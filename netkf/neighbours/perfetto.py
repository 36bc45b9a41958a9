"""A window of a run for the Perfetto UI, as JSON of the Chrome trace event format (2016)."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import number
from netkf.runs.files import output_file, require_trace, this_process, write_atomically
from netkf.trace.messages import LOST, join_messages
from netkf.trace.nees import traces
from netkf.trace.run import Run
from netkf.trace.schema import KINDS

EVENTS = 1
"""The track of a node with its events."""
WIDEST = 500
"""Events are drawn this fraction of the window wide, or up to the next one of their node."""
Event = dict[str, Any]


def export_perfetto(
    run: Run, out: str | Path, begin: float = 0.0, end: float | None = None
) -> tuple[Path, ...]:
    """Write the events and samples of a run from ``begin`` to ``end`` (seconds, by default all) for
    Perfetto, and return the path: ``out`` or, if that is a folder, ``out``/trace.json. Open it at
    ui.perfetto.dev, or in chrome://tracing.

    Each node is a process. Its track ``events`` has a slice for each instant at which something
    happens, named after the kinds of its events; its width means nothing. Messages that arrive are
    arrows (flows) between slices; trace P and norm of error are counters. Instants are rounded to
    nanoseconds.

    Raises ScenarioError for a window in which there is nothing, and WriteError.
    """
    require_trace(run)
    last = max([0.0, *run.times[-1:].tolist(), *run.log["t"][-1:].tolist()])
    begin = number(low=0.0)("begin", begin)
    end = last if end is None else number(low=0.0)("end", end)
    log = run.log[(run.log["t"] >= begin) & (run.log["t"] <= end)]
    if begin > end or not (len(log) or ((run.times >= begin) & (run.times <= end)).any()):
        remedy = f"the run has 0 to {last:g} s"
        raise ScenarioError("window", "has nothing in it", [begin, end], remedy)
    path = output_file(out, "trace.json")
    pids = {int(node): k for k, node in enumerate(run.nodes, 1)}
    pids |= {-1: len(pids) + 1} if (log["node"] == -1).any() else {}
    events = itertools.chain(
        _names(run, pids),
        _slices(log, pids, end - begin),
        _arrows(run, pids, begin, end),
        _counters(run, pids, begin, end),
    )
    about = {"scenario": run.scenario.name, "seed": run.seed, "replica": run.replica}
    with write_atomically(path, this_process()) as part, part.open("w", encoding="utf-8") as file:
        file.write(f'{{"displayTimeUnit": "ms", "otherData": {json.dumps(about)},\n')
        file.write('"traceEvents": [\n')
        file.write(",\n".join(json.dumps(event, allow_nan=False) for event in events))
        file.write("\n]}\n")
    return (path,)


def _micro(t: float) -> float:
    """Return seconds as microseconds, rounded to nanoseconds."""
    return round(t * 1e6, 3)


def _names(run: Run, pids: dict[int, int]) -> Iterator[Event]:
    labels = {int(node): f"node {node}" for node in run.nodes}
    for node, pid in pids.items():
        process = {"ph": "M", "pid": pid, "tid": EVENTS}
        yield {**process, "name": "process_name", "args": {"name": labels.get(node, "network")}}
        yield {**process, "name": "process_sort_index", "args": {"sort_index": pid}}
        yield {**process, "name": "thread_name", "args": {"name": "events"}}


def _slices(log: np.ndarray, pids: dict[int, int], span: float) -> Iterator[Event]:
    """Yield a slice for each instant of each node, with the events of the instant in its args."""
    widest = max(_micro(span) / WIDEST, 0.001)
    for node, pid in pids.items():
        own = log[log["node"] == node]
        if not len(own):
            continue
        instants, first = np.unique(own["t"], return_index=True)
        starts = [_micro(t) for t in instants.tolist()]
        for k, events in enumerate(np.split(own, first[1:])):
            gap = starts[k + 1] - starts[k] if k + 1 < len(starts) else math.inf
            kinds = Counter(KINDS[code] for code in events["kind"].tolist())
            peers = {
                kind: events["peer"][(events["kind"] == KINDS.index(kind)) & (events["peer"] >= 0)]
                for kind in kinds
            }
            times = {kind: f" x{count}" if count > 1 else "" for kind, count in kinds.items()}
            yield {
                "ph": "X",
                "name": ", ".join(f"{kind}{times[kind]}" for kind in kinds),
                "cat": "events",
                "pid": pid,
                "tid": EVENTS,
                "ts": starts[k],
                "dur": round(max(min(widest, gap), 0.001), 3),
                "args": {kind: list(map(str, ids.tolist())) for kind, ids in peers.items()},
            }


def _arrows(run: Run, pids: dict[int, int], begin: float, end: float) -> Iterator[Event]:
    messages = join_messages(run.log)
    ended = (messages["ended"] <= end) & (messages["outcome"] != LOST)
    for k in np.flatnonzero(ended & (messages["sent"] >= begin)).tolist():
        one = messages[k]
        flow = {"name": "message", "cat": "message", "id": k + 1, "tid": EVENTS}
        sender, receiver = pids[int(one["sender"])], pids[int(one["receiver"])]
        yield {"ph": "s", **flow, "pid": sender, "ts": _micro(float(one["sent"]))}
        yield {"ph": "f", "bp": "e", **flow, "pid": receiver, "ts": _micro(float(one["ended"]))}


def _counters(run: Run, pids: dict[int, int], begin: float, end: float) -> Iterator[Event]:
    # Perfetto calls a counter by both of its names.
    values = {("trace", "P"): traces(run.P), ("norm of", "error"): np.sqrt(run.sq_error)}
    for k in np.flatnonzero((run.times >= begin) & (run.times <= end)).tolist():
        for place, node in enumerate(run.nodes):
            for (name, of), samples in values.items():
                if math.isfinite(value := float(samples[k, place])):
                    at = {"pid": pids[int(node)], "ts": _micro(float(run.times[k]))}
                    yield {"ph": "C", "name": name, **at, "args": {of: value}}
