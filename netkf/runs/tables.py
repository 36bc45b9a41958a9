"""Tables for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from netkf.core.printable import one_line
from netkf.scenario.usage import usage_notes

MAX_NODES = 30
"""Largest number of rows of a table of nodes; longer ones list the best and the worst nodes."""
MAX_HELD_OUT = 12
"""Nodes whose held-out readings are listed."""
DRIFT_TOLERANCE = 1e-9
"""Relative drift of a conserved sum above which rounding cannot be the cause."""
COLUMNS = {
    "rms_error": "RMS error",
    "mean_trace": "mean trace P",
    "bound": "bound",
    "ratio": "ratio",
    "mean_nees": "NEES",
}
"""Headers of the columns of averages, by the key in summary.json."""
POWERS = {"rms_error": 1, "mean_trace": 2, "bound": 2}
"""Powers of the unit of the states in columns that have one."""
BOUND_COLUMNS = ("bound", "ratio")
"""Keys of the columns that a table leaves out if no node has a bound."""


def format_number(value: float | None) -> str:
    """Return a number with four significant digits; a dash if it is None or not finite."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.4g}"


def format_with_error(value: float | None, error: float | None) -> str:
    """Return a value with its standard error, if known, as text: ``1.2 +- 0.1``."""
    return format_number(value) + format_error(error)


def format_error(error: float | None, digits: int = 1) -> str:
    """Return `` +- 0.1`` with so many significant digits, ten as 10; nothing if it is unknown."""
    known = error is not None and math.isfinite(error)
    return f" +- {float(f'{error:.{digits}g}'):g}" if known else ""


def format_table(header: list[str], rows: list[list[str]], left_columns: int = 0) -> str:
    """Return a table as text, ``left_columns`` aligned left; control characters are escaped."""
    rows = [[one_line(cell) for cell in row] for row in [header, *rows]]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [
            cell.ljust(width) if k < left_columns else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])


def shorten_rows(rows: list[list[str]], max_rows: int) -> list[list[str]]:
    """Return the first and last of more than ``max_rows`` rows, and how many were omitted."""
    if len(rows) <= max_rows:
        return rows
    omitted = [f"({len(rows) - max_rows} more)", *[""] * (len(rows[0]) - 1)]
    return [*rows[: max_rows // 2], omitted, *rows[-max_rows // 2 :]]


def summary_table(
    summary: dict[str, Any],
    limit: str = "limit S of Tanwani's H(13)",
    notes: Sequence[str] = (),
    unit: str = "",
    states: str = "",
) -> str:
    """Return the table that ``netkf run`` prints of a summary: nodes, all, ``notes``, limits
    (``limit`` names the first, if any), NEES and messages, with ``unit`` and names of ``states``.
    """
    lines = [*_node_table(summary, unit), *([states] if states else [])]
    if limit and not has_bound(summary):
        lines.append(f"bound: {summary['bound']}")
    lines += [f"note: {note}" for note in (*summary["notes"], *notes)]
    traces = {limit: summary["limit"], "centralised filter": summary["central"]}
    limits = [
        f"{label} {format_number(value)}"
        for label, value in traces.items()
        if value is not None and math.isfinite(value)
    ]
    lines += ["traces to compare: " + ", ".join(limits)] if limits else []
    nees = summary.get("nees", {})
    if math.isfinite(nees.get("inside", math.nan)):  # not for a single run
        lines.append(
            f"NEES of one sample, mean over the runs: {nees['confidence']:.0%} in "
            f"{format_number(nees['low'])} .. {format_number(nees['high'])} where P is exact, here "
            f"{nees['inside']:.0%}"
        )
    lines += _held_out_lines(summary.get("held_out", []))
    if "conserved" in summary:
        sums = summary["conserved"]
        totals = [
            f"{name} {format_number(entry['total'])} of {format_number(entry['exact'])} "
            f"({entry['drift']:+.1e})"
            for name, entry in sums.items()
        ]
        worst = max(abs(entry["drift"]) for entry in sums.values())
        drifting = ", drifting: directions of a link do not fail together"
        more = drifting if worst > DRIFT_TOLERANCE else ""
        lines.append(f"mass: {', '.join(totals)}{more}")
    lines += [*_quantity_lines(summary), _message_line(summary["messages"])]
    lines += [f"note: {note}" for note in usage_notes(summary.get("records", {}))]
    return "\n".join(lines)


def _held_out_lines(rows: list[dict[str, Any]]) -> Iterator[str]:
    for row in rows[:MAX_HELD_OUT]:
        square, noise, expected = (
            format_number(row[key]) for key in ("mean_square", "noise", "expected")
        )
        yield (
            f"held out at node {row['node']}: mean squared error {square} over {row['readings']:,} "
            f"values; H P H' + R says {expected}, of which R {noise}"
        )
    if len(rows) > MAX_HELD_OUT:
        yield f"held out at {len(rows) - MAX_HELD_OUT} more nodes: see summary.json"


def has_bound(summary: dict[str, Any]) -> bool:
    """Return True if theory gives a bound on the mean of P of any node."""
    return any(row["bound"] is not None for row in summary["nodes"])


def columns_of(summary: dict[str, Any], unit: str = "") -> dict[str, str]:
    """Return the headers of columns of averages by key, with the ``unit`` of all states."""
    left_out = () if has_bound(summary) else BOUND_COLUMNS
    return {
        key: header + in_unit(unit, POWERS.get(key, 0), ", ")
        for key, header in COLUMNS.items()
        if key not in left_out
    }


def in_unit(unit: str, power: int = 1, before: str = " ") -> str:
    """Return a unit to a power of 0, 1 or 2, as text behind a number or a word; "" without one."""
    if not unit or not power:
        return ""
    if power == 1:
        return before + unit
    return before + (f"{unit}^2" if unit.isalpha() else f"({unit})^2")


def _node_table(summary: dict[str, Any], unit: str) -> Iterator[str]:
    columns = columns_of(summary, unit)
    nodes = sorted(summary["nodes"], key=lambda row: row["node"])
    omitted, half = max(len(nodes) - MAX_NODES, 0), MAX_NODES // 2
    if omitted:
        known = any(row["rms_error"] is not None for row in nodes)
        ranking = "rms_error" if known else "mean_trace"
        # A node whose value is unknown is listed among the worst.
        values = {row["node"]: row[ranking] for row in nodes}
        worst = {node for node, v in values.items() if v is None or not math.isfinite(v)}
        nodes.sort(key=lambda row: -math.inf if row["node"] in worst else -values[row["node"]])
    rows = [_row_cells(str(row["node"]), row, columns) for row in nodes]
    rows = shorten_rows(rows, MAX_NODES)
    rows.append(_row_cells("all", summary["overall"], columns))
    yield format_table(["node", *columns.values()], rows)
    if omitted:
        yield (
            f"the {half} nodes with the largest and the {half} with the smallest "
            f"{COLUMNS[ranking]}; all are in summary.json"
        )
    yield ""


def _row_cells(name: str, row: dict[str, Any], columns: Iterable[str]) -> list[str]:
    return [name, *(format_with_error(row[key], row.get(f"{key}_se")) for key in columns)]


def _quantity_lines(summary: dict[str, Any]) -> Iterator[str]:
    """Yield a line on quantities beside means if a level or energy was stated."""
    row = summary["overall"]
    shown = {
        "time_above": "error above the level in {:.2%} of the samples",
        "time_connected": "connected {:.1%} of the time",
        "worst_age": "newest readings at most {:.6g} s old",
        "joules": "{:,.4g} J",
    }
    parts = [text.format(row[key]) for key, text in shown.items() if row.get(key) is not None]
    if row.get("time_above") is not None or row.get("joules") is not None:
        yield f"worst instant: {format_number(row['worst_instant'])}; {', '.join(parts)}"


def _message_line(messages: dict[str, Any]) -> str:
    transmissions = messages.get("transmissions")
    if transmissions is None or math.isnan(transmissions):  # in slots they are not counted
        transmissions = messages["sent"]
    line = f"messages: {format_count(messages['sent'])} sent"
    # A broadcast is one transmission and a message to each node in range.
    if transmissions != messages["sent"]:
        line += f" in {format_count(transmissions)} transmissions"
    line += f", {format_count(messages['delivered'])} delivered"
    line += f", {format_count(messages['lost'])} lost"
    if messages["in_flight"]:
        line += f", {format_count(messages['in_flight'])} on their way at the end"
    return line


def format_count(value: float) -> str:
    """Return a count as text, or a mean of counts (a float) with one decimal."""
    return f"{value:,}" if isinstance(value, int) else f"{value:,.1f}"
