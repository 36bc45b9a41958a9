"""What would have mended the worst sample of a run: replays in which missing messages came."""

from __future__ import annotations

import math

import numpy as np

from netkf.core.errors import NetkfError
from netkf.report.claims import Worst, after_start_up, node_most_off
from netkf.report.directories import Opened
from netkf.report.markup import bullets, paragraph, table_box
from netkf.runs.tables import format_number
from netkf.studies.explanation import Explanation
from netkf.studies.why import why
from netkf.studies.why_text import relative_change, sentences

SAME = 1e-4
"""Relative difference of numbers that look the same with four digits."""
MAX_EVENTS = 60_000
"""Events until the worst instant up to which a page replays a run, a second or two."""
REPLAYED_EVENTS, LEAST, MOST = 300_000, 5, 60
"""Events of all replays of a page together, and the replays of a search at least and at most."""


def explain_worst(source: Opened) -> Explanation | str | None:
    """Return why the worst sample of a single run after the start-up was what it was, by replays;
    or the reason why it cannot be said here, or None where there is nothing to explain.
    """
    worst, run = _explained(source), source.run
    if worst is None or run is None or source.kind != "run":
        return None
    if len(run.nodes) == 1 or not run.count("send"):
        return None
    events = int(np.searchsorted(run.log["t"], worst.time, side="right"))
    if events > MAX_EVENTS:
        return f"{events:,} events until then are many to replay; {_command(source, worst)} does it"
    replays = max(LEAST, min(MOST, REPLAYED_EVENTS // max(1, events)))
    try:
        return why(run, worst.node, worst.time, replays=replays)
    except NetkfError as error:
        return str(error)


def _explained(source: Opened) -> Worst | None:
    worst = node_most_off(source)
    return None if worst is None else after_start_up(source, worst)[0]


def _command(source: Opened, worst: Worst) -> str:
    return f"netkf why {source.label} --node {worst.node} --at {worst.time:.10g}"


def mending_claim(found: Explanation) -> str:
    """Return a sentence that says what it would have taken."""
    was, best = found.what_ifs[0], found.what_ifs[-1]
    same = math.isclose(was.trace, best.trace, rel_tol=SAME) or math.isnan(was.trace)
    if same and not abs(best.error - was.error) > SAME * was.error:
        return "Messages would not have mended it: a replay in which none is missing is no better"
    change = f"trace P {format_number(best.trace)} in place of {format_number(was.trace)}"
    if math.isfinite(best.error):
        change += f" and error {format_number(best.error)} in place of {format_number(was.error)}"
    some = ""
    if found.smallest is not None and found.smallest.messages:
        count = len(found.smallest.messages)
        many = f"{count} message{'s' if count > 1 else ''}"
        some = f"; {many} alone would have brought trace P to {format_number(found.smallest.trace)}"
    return f"To mend it: with no message missing, a replay gives {change}{some}"


def mending_section(source: Opened, found: Explanation | str) -> str:
    """Return the answer of ``netkf why`` about the worst sample: sentences, and a row a replay."""
    worst = _explained(source)
    if isinstance(found, str) or worst is None:
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
    more = f"By replays of the run, nothing is guessed: {_command(source, worst)} says more"
    return bullets(sentences(found)) + replays + paragraph(more, "note")
