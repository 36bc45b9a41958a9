"""Tables for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from netkf.core.printable import one_line
from netkf.scenario.usage import usage_notes

MAX_NODES = 30
"""Rows of a table with one row per node; longer tables show the ends of the list."""
DRIFT_TOLERANCE = 1e-9
"""Relative drift of a conserved sum that rounding cannot explain."""
COLUMNS = {
    "rms_error": "RMS error",
    "mean_trace": "mean trace P",
    "bound": "bound",
    "ratio": "ratio",
    "mean_nees": "NEES",
}


def format_number(value: float | None) -> str:
    """Format a number with four significant digits; a dash if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.4g}"


def standard_error(error: float | None) -> str:
    """Format a standard error as `` +- 0.1``; empty if it is None or not finite."""
    known = error is not None and math.isfinite(error)
    return f" +- {error:.1g}" if known else ""


def table(header: list[str], rows: list[list[str]], left: int = 0) -> str:
    """Return aligned columns, the first ``left`` to the left and the others to the right. Cells may
    hold text from files: line breaks and control characters in them are escaped.
    """
    header, rows = [*map(one_line, header)], [[*map(one_line, row)] for row in rows]
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    lines = [
        "  ".join(
            cell.ljust(w) if k < left else cell.rjust(w)
            for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in [header, *rows]
    ]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])


def shorten_rows(rows: list[list[str]], most: int) -> list[list[str]]:
    """Return at most ``most`` rows, the first and the last, with a row that counts the rest."""
    if len(rows) <= most:
        return rows
    omitted = [f"({len(rows) - most} more)", *[""] * (len(rows[0]) - 1)]
    return [*rows[: most // 2], omitted, *rows[-most // 2 :]]


def summary_table(
    summary: dict[str, Any], limit: str = "limit S of H(13)", notes: Sequence[str] = ()
) -> str:
    """Return the table that ends a run.

    It has a row per node (the best and the worst of large networks), one for all nodes, the
    ``notes`` on the bound, the limits (``limit`` names the first), and the messages.
    """
    lines = list(_node_table(summary))
    if all(row["bound"] is None for row in summary["nodes"]):
        lines.append(f"bound: {summary['bound']}")
    lines += [f"note: {note}" for note in (*summary["notes"], *notes)]
    lines += _limit_lines(summary, limit)
    lines += _nees_lines(summary.get("nees", {}))
    if "conserved" in summary:
        lines.append("mass: " + _describe_conserved(summary["conserved"]))
    lines.append(_message_line(summary["messages"]))
    lines += [f"note: {note}" for note in usage_notes(summary.get("records", {}))]
    return "\n".join(lines)


def _node_table(summary: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the table of nodes."""
    nodes = sorted(summary["nodes"], key=lambda row: row["node"])
    listed = _best_and_worst(nodes) if len(nodes) > MAX_NODES else nodes
    omitted = len(nodes) - len(listed)
    rows = [_row_cells(str(row["node"]), row) for row in listed]
    if omitted:
        rows.append([f"({omitted} more)", *[""] * len(COLUMNS)])
    rows.append(_row_cells("all", summary["overall"]))
    yield table(["node", *COLUMNS.values()], rows)
    if omitted:
        half = MAX_NODES // 2
        yield (
            f"the {half} nodes with the largest and the {half} with the smallest RMS error; all "
            "are in summary.json"
        )
    yield ""


def _best_and_worst(nodes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with the largest and the smallest RMS errors, in their order."""
    ranked = sorted(nodes, key=lambda row: -_sort_key(row["rms_error"]))
    half = MAX_NODES // 2
    chosen = {row["node"] for row in (*ranked[:half], *ranked[-half:])}
    return [row for row in nodes if row["node"] in chosen]


def _sort_key(value: float | None) -> float:
    """Return the value, or inf for an error that is unknown: such a node is worth a look."""
    return math.inf if value is None or not math.isfinite(value) else value


def _row_cells(name: str, row: dict[str, Any]) -> list[str]:
    """Return the cells of a row."""
    return [
        name,
        *(format_number(row[key]) + standard_error(row.get(f"{key}_se")) for key in COLUMNS),
    ]


def _limit_lines(summary: dict[str, Any], limit: str) -> list[str]:
    """Return the line of limits to compare with."""
    traces = {limit: summary["limit"], "centralised filter": summary["central"]}
    known = [
        f"{label} {format_number(value)}"
        for label, value in traces.items()
        if value is not None and math.isfinite(value)
    ]
    return ["traces to compare: " + ", ".join(known)] if known else []


def _nees_lines(nees: dict[str, Any]) -> list[str]:
    """Return the line on the consistency of P."""
    if not math.isfinite(nees.get("inside", math.nan)):
        return []
    return [
        f"NEES of one sample, mean over the runs: {nees['confidence']:.0%} in "
        f"{format_number(nees['low'])} .. {format_number(nees['high'])} where P is exact, here "
        f"{nees['inside']:.0%}"
    ]


def _message_line(messages: dict[str, Any]) -> str:
    """Return the line that counts messages."""
    transmissions = messages.get("transmissions")
    if transmissions is None or math.isnan(transmissions):  # in slots they are not counted
        transmissions = messages["sent"]
    line = f"messages: {_format_count(messages['sent'])} sent"
    # A broadcast is one transmission and a message to each node in range.
    if transmissions != messages["sent"]:
        line += f" in {_format_count(transmissions)} transmissions"
    line += f", {_format_count(messages['delivered'])} delivered"
    line += f", {_format_count(messages['lost'])} lost"
    if messages["in_flight"]:
        line += f", {_format_count(messages['in_flight'])} on their way at the end"
    return line


def _describe_conserved(sums: dict[str, dict[str, float]]) -> str:
    """Return the conserved sums with their relative drift, as text."""
    totals = [
        f"{name} {format_number(found['total'])} of {format_number(found['exact'])} "
        f"({found['drift']:+.1e})"
        for name, found in sums.items()
    ]
    worst = max(abs(found["drift"]) for found in sums.values())
    drifting = ", drifting: directions of a link do not fail together"
    return ", ".join(totals) + (drifting if worst > DRIFT_TOLERANCE else "")


def _format_count(value: float) -> str:
    """Format a count, or a mean of counts with one decimal."""
    return f"{value:,}" if isinstance(value, int) else f"{value:,.1f}"
