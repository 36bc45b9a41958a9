"""What would have mended the worst sample of a run: replays in which missing messages came."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from netkf.algorithms.baselines import Central
from netkf.core.errors import NetkfError
from netkf.network.clocks import LinkClock
from netkf.report.directories import Opened
from netkf.report.markup import bullets, paragraph, table_box
from netkf.report.worst import Worst
from netkf.runs.innovations import with_filter
from netkf.runs.simulate import simulate
from netkf.runs.tables import format_number
from netkf.studies.explanation import Explanation
from netkf.studies.why import why
from netkf.studies.why_text import relative_change, sentences

EQUAL_NUMBERS = 1e-4
"""Relative difference of numbers that look the same with four digits."""
MAX_EVENTS = 60_000
"""Events until the worst instant up to which a page replays a run, a second or two."""
REPLAYED_EVENTS, MIN_REPLAYS, MAX_REPLAYS = 300_000, 5, 60
"""Events of all replays of a page together, and the replays of a search at least and at most."""


def explain_worst(source: Opened) -> Explanation | str | None:
    """Return why the worst sample of a single run after the start-up was what it was, by replays;
    or the reason why it cannot be said here, or None where there is nothing to explain.
    """
    run = source.run
    if source.worst is None or run is None or source.kind != "run":
        return None
    worst = source.worst.explained
    if len(run.nodes) == 1 or not run.count("send"):
        return None
    events = int(np.searchsorted(run.log["t"], worst.time, side="right"))
    if events > MAX_EVENTS:
        command = _why_command(source, worst)
        return f"{events:,} events until then are many to replay; {command} does it"
    replays = max(MIN_REPLAYS, min(MAX_REPLAYS, REPLAYED_EVENTS // max(1, events)))
    try:
        return why(run, worst.node, worst.time, replays=replays)
    except NetkfError as error:
        return str(error)


def _why_command(source: Opened, worst: Worst) -> str:
    """Return the command that explains the worst sample."""
    return f"netkf why {source.label} --node {worst.node} --at {worst.time:.10g}"


def mending_claim(found: Explanation) -> str:
    """Return a sentence on the messages that would have mended the worst sample."""
    was, best = found.what_ifs[0], found.what_ifs[-1]
    same = math.isclose(was.trace, best.trace, rel_tol=EQUAL_NUMBERS) or math.isnan(was.trace)
    if same and not abs(best.error - was.error) > EQUAL_NUMBERS * was.error:
        return "Messages would not have mended it: a replay in which none is missing is no better"
    error = _describe_change("error", was.error, best.error)
    if same:
        change = f"{error} at the same trace P, {format_number(was.trace)}"
    else:
        change = _describe_change("trace P", was.trace, best.trace)
        change += f" and {error}" if math.isfinite(best.error) else ""
        change += _describe_cost(found)
    return f"To mend it: with no message missing, a replay gives {change}"


class CentralSample(NamedTuple):
    """Trace of P and error of the centralised filter at the worst sample of a run."""

    trace: float
    error: float


def central_sample(source: Opened) -> CentralSample | None:
    """Return what the centralised filter with the same truth and readings had at the worst sample
    after the start-up; None where there is no such filter or run.
    """
    run = source.run
    if source.worst is None or run is None or not run.scenario.filter.algorithm.talks:
        return None
    filtering = dataclasses.replace(run.scenario.filter, algorithm=Central())
    try:
        scenario = with_filter(run.scenario, filtering)
        other = simulate(scenario, run.seed, run.replica, "simpy")
    except NetkfError:
        return None
    at = int(np.searchsorted(run.times, source.worst.explained.time))
    if at >= len(other.times):
        return None
    error = float(np.linalg.norm(other.x[at] - other.xhat[at, 0])) if run.truth_known else math.nan
    return CentralSample(float(np.trace(other.P[at, 0])), error)


def price_claim(source: Opened, found: Explanation, central: CentralSample) -> str:
    """Return a sentence on what even all messages would leave: the price of the network."""
    best = found.what_ifs[-1]
    had = [f"trace P {format_number(central.trace)}"] if math.isfinite(central.trace) else []
    had += [f"error {format_number(central.error)}"] if math.isfinite(central.error) else []
    said = (
        "With all readings at once: the centralised filter, on the same truth and readings, had "
        f"{' and '.join(had)} then"
    )
    if not central.trace < best.trace * (1.0 - EQUAL_NUMBERS):
        return f"{said}. Its trace P is no less than that of this node with no message missing"
    what = "how rarely nodes exchange, and of how they combine what they hear"
    clock = source.scenario.network.activation
    rates = isinstance(clock, LinkClock) and hasattr(clock, "rate")
    ask = "netkf size finds the rate that would do, " if rates else ""
    return (
        f"{said}. The rest of trace P {format_number(best.trace)} is the price of {what}: {ask}"
        "netkf compare-filters a filter that loses less"
    )


def _describe_change(name: str, was: float, now: float) -> str:
    """Return a value and its relative change as text."""
    change = f"{name} {format_number(now)} in place of {format_number(was)}"
    return f"{change} ({relative_change(now, was)})" if was > 0.0 else change


def _describe_cost(found: Explanation) -> str:
    """Return how few messages would have done it, or the best that was tried."""
    smallest = found.smallest
    if smallest is None or smallest.messages == ():
        return ""
    chosen = smallest.best if smallest.messages is None else smallest.messages
    if not chosen:
        return f"; none of the {smallest.considered:,} messages alone that were tried helps"
    value = smallest.best_trace if smallest.messages is None else smallest.trace
    count = f"{len(chosen)} message{'s' if len(chosen) > 1 else ''}"
    return (
        f"; {count} alone, of {smallest.candidates:,} that could have mattered, would have brought "
        f"trace P to {format_number(value)}"
    )


def mending_section(source: Opened, found: Explanation | str) -> str:
    """Return the answer of ``netkf why`` about the worst sample: sentences, and a row a replay."""
    if isinstance(found, str) or source.worst is None:
        return paragraph(f"The worst sample is not explained here: {found}", "note")
    rows = [
        (
            what.label,
            "all" if what.messages is None else len(what.messages),
            format_number(what.trace),
            "" if k == 0 else relative_change(what.trace, found.trace),
            format_number(what.error),
        )
        for k, what in enumerate(found.what_ifs)
    ]
    caption = f"Node {found.node} at {found.at:.10g} s, replayed with messages that did not come"
    replays = table_box(caption, ("replayed with", "messages", "trace P", "change", "error"), rows)
    command = _why_command(source, source.worst.explained)
    more = f"By replays of the run, nothing is guessed: {command} says more"
    return bullets(sentences(found)) + replays + paragraph(more, "note")
