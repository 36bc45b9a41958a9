"""What would have reduced the worst error of a run: missing messages, and all readings at once."""

from __future__ import annotations

import dataclasses
import math
import shlex

import numpy as np

from netkf.algorithms.baselines import Central
from netkf.checks.innovations import with_filter
from netkf.core.errors import NetkfError
from netkf.core.printable import count_phrase
from netkf.network.clocks import LinkClock
from netkf.report.directories import ReportSource, WorstSample
from netkf.report.markup import bullets, paragraph, table_box
from netkf.runs.simulate import simulate
from netkf.runs.tables import format_number
from netkf.studies.explanation import Why, relative_change
from netkf.studies.why import why
from netkf.trace.nees import traces

SAME_NUMBERS = 1e-4
"""Relative difference below which numbers of four digits look the same."""
MAX_EVENTS = 60_000
"""Events until the worst sample up to which a page replays a run, which takes a second or two."""
REPLAYED_EVENTS, MIN_REPLAYS, MAX_REPLAYS = 300_000, 5, 60
"""Events that the replays of a page may have together, and the limits of the number of replays."""


def explain_worst(source: ReportSource) -> Why | str | None:
    """Explain the worst sample after the start-up, or return the reason for none, or None."""
    run = source.run
    if source.worst is None or run is None or source.kind != "run":
        return None
    worst = source.worst.explained
    if len(run.nodes) == 1 or not run.count("send"):
        return None
    events = int(np.searchsorted(run.log["t"], worst.time, side="right"))
    if events > MAX_EVENTS:
        command = _why_command(source, worst)
        return f"the {events:,} events until then take too long to replay here; {command} does it"
    replays = max(MIN_REPLAYS, min(MAX_REPLAYS, REPLAYED_EVENTS // max(1, events)))
    try:
        return why(run, worst.node, worst.time, replays=replays)
    except NetkfError as error:
        return str(error)


def _why_command(source: ReportSource, worst: WorstSample) -> str:
    command = ["netkf", "why", source.label, "--node", str(worst.node)]
    return f"{shlex.join(command)} --at {worst.time:.10g}"


def describe_mending(explanation: Why) -> str:
    """Return a sentence on the worst sample had no message been missing, by replays."""
    # The first replay is the run as it was, the last one has no message missing.
    actual, best = explanation.what_ifs[0], explanation.what_ifs[-1]
    same_trace = math.isnan(actual.trace) or math.isclose(
        actual.trace, best.trace, rel_tol=SAME_NUMBERS
    )
    if same_trace and not abs(best.error - actual.error) > SAME_NUMBERS * actual.error:
        return "Messages would not have mended it: a replay in which none is missing is no better"
    error = _describe_change("error", actual.error, best.error)
    is_less = best.error < actual.error if same_trace else best.trace < actual.trace
    if same_trace:
        change = f"{error} at the same trace P, {format_number(actual.trace)}"
    else:
        change = _describe_change("trace P", actual.trace, best.trace)
        change += f" and {error}" if math.isfinite(best.error) else ""
        change += _describe_smallest_set(explanation)
    if is_less:
        return f"To mend it: with no message missing, a replay gives {change}"
    return f"With no message missing it would be no better: a replay gives {change}"


def describe_central(source: ReportSource, explanation: Why) -> str | None:
    """Return sentences on the price of the network: the worst sample beside that of the centralised
    filter on truth and readings of the run; None without messages, or if it cannot run.
    """
    run = source.run
    if source.worst is None or run is None or not run.scenario.filter.algorithm.timing.talks:
        return None
    filtering = dataclasses.replace(run.scenario.filter, algorithm=Central())
    try:
        central_run = simulate(with_filter(run.scenario, filtering), run.seed, run.replica, "simpy")
    except NetkfError:
        return None
    row = int(np.searchsorted(run.times, source.worst.explained.time))
    if row >= len(central_run.times):  # the centralised filter diverged before
        return None
    node = run.nodes.index(source.worst.explained.node)
    error = math.sqrt(central_run.sq_error[row, node]) if run.truth_known else math.nan
    trace, best = float(traces(central_run.P[row, node])), explanation.what_ifs[-1]
    numbers = [f"trace P {format_number(trace)}"] if math.isfinite(trace) else []
    numbers += [f"error {format_number(error)}"] if math.isfinite(error) else []
    sentence = (
        "With all readings at once: the centralised filter, on the same truth and readings, had "
        f"{' and '.join(numbers)} then"
    )
    if not trace < best.trace * (1.0 - SAME_NUMBERS):
        return f"{sentence}. Its trace P is no less than that of this node with no message missing"
    clock = source.scenario.network.activation
    has_rate = isinstance(clock, LinkClock) and hasattr(clock, "rate")
    advice = "netkf size finds the rate that would suffice, and " if has_rate else ""
    return (
        f"{sentence}. The rest of trace P {format_number(best.trace)} is the price of rare "
        "exchanges and of the way nodes combine the information that they receive: "
        f"{advice}netkf compare-filters finds filters that lose less"
    )


def _describe_change(name: str, before: float, after: float) -> str:
    """Return text such as ``error 1.5 in place of 2 (-25.0 %)``."""
    change = f"{name} {format_number(after)} in place of {format_number(before)}"
    return f"{change} ({relative_change(after, before)})" if before > 0.0 else change


def _describe_smallest_set(explanation: Why) -> str:
    smallest = explanation.smallest
    if smallest is None or smallest.messages == ():
        return ""
    messages = smallest.best if smallest.messages is None else smallest.messages
    if not messages:
        return f"; none of the {smallest.considered:,} messages tried one by one helps"
    trace = smallest.best_trace if smallest.messages is None else smallest.trace
    count = count_phrase(len(messages), "message")
    return (
        f"; {count} alone, of {smallest.candidates:,} that could have mattered, would have brought "
        f"trace P to {format_number(trace)}"
    )


def mending_section(source: ReportSource, explanation: Why | str) -> str:
    """Return the replays of the worst sample as HTML, or the reason why there are none."""
    if isinstance(explanation, str) or source.worst is None:
        return paragraph(f"The worst sample is not explained here: {explanation}", "note")
    rows = [
        (
            what_if.label,
            "all" if what_if.messages is None else len(what_if.messages),
            format_number(what_if.trace),
            "" if k == 0 else relative_change(what_if.trace, explanation.trace),
            format_number(what_if.error),
        )
        for k, what_if in enumerate(explanation.what_ifs)
    ]
    at = f"Node {explanation.node} at {explanation.at:.10g} s"
    caption = f"{at}, replayed with messages that did not arrive"
    replays = table_box(caption, ("replayed with", "messages", "trace P", "change", "error"), rows)
    command = _why_command(source, source.worst.explained)
    note = f"All numbers are from replays of the run, none is estimated. For more: {command}"
    return bullets(explanation.sentences()) + replays + paragraph(note, "note")
