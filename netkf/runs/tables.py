"""Tables for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from netkf.scenario.usage import usage_notes

MOST_NODES = 30
DRIFTED = 1e-9  # far above rounding


def number(value: float | None) -> str:
    """Four significant digits; a dash where there is no number."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.4g}"


def table(header: list[str], rows: list[list[str]], left: int = 0) -> str:
    """Aligned columns, the first ``left`` to the left and the others to the right."""
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]
    lines = [
        "  ".join(
            cell.ljust(w) if k < left else cell.rjust(w)
            for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in [header, *rows]
    ]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])


def summary_table(
    summary: dict[str, Any], limit: str = "limit S of H(13)", notes: Sequence[str] = ()
) -> str:
    """The table that ends a run: nodes (the worst and the best where there are many), all of them
    together, what ``notes`` say about the promise, and the messages; ``limit`` names the limit.
    """
    nodes = sorted(summary["nodes"], key=lambda row: row["node"])
    shown, left_out = nodes, 0
    if len(nodes) > MOST_NODES:
        ranked = sorted(nodes, key=lambda row: -_key(row["rms_error"]))
        half = MOST_NODES // 2
        chosen = {row["node"] for row in (*ranked[:half], *ranked[-half:])}
        shown = [row for row in nodes if row["node"] in chosen]
        left_out = len(nodes) - len(shown)
    rows = [_cells(str(row["node"]), row) for row in shown]
    if left_out:
        rows.append([f"({left_out} more)", *[""] * 5])
    rows.append(_cells("all", summary["overall"]))
    header = ["node", "RMS error", "mean trace P", "bound", "ratio", "NEES"]
    sent = summary["messages"]
    lines = [table(header, rows), ""]
    if left_out:
        lines.insert(
            1,
            f"the {MOST_NODES // 2} nodes with the largest and the "
            f"{MOST_NODES // 2} with the smallest RMS error; all are in summary.json",
        )
    if all(row["bound"] is None for row in nodes):
        lines.append(f"bound: {summary['bound']}")
    lines += [f"note: {note}" for note in (*summary["notes"], *notes)]
    references = [
        f"{words} {number(value)}"
        for words, value in (
            (limit, summary["limit"]),
            ("centralised filter", summary["central"]),
        )
        if value is not None and math.isfinite(value)
    ]
    if references:
        lines.append("traces to compare: " + ", ".join(references))
    if math.isfinite(summary.get("nees", {}).get("inside", math.nan)):
        found = summary["nees"]
        lines.append(
            f"NEES of one sample, mean over the runs: {found['confidence']:.0%} in "
            f"{number(found['low'])} .. {number(found['high'])} where P is exact, here "
            f"{found['inside']:.0%}"
        )
    if "conserved" in summary:
        lines.append("mass: " + _conserved(summary["conserved"]))
    lines.append(
        f"messages: {_count(sent['sent'])} sent{_transmissions(sent)}, "
        f"{_count(sent['delivered'])} delivered, {_count(sent['lost'])} lost"
        + (f", {_count(sent['in_flight'])} on their way at the end" if sent["in_flight"] else "")
    )
    lines += [f"note: {note}" for note in usage_notes(summary.get("records", {}))]
    return "\n".join(lines)


def _transmissions(sent: dict[str, Any]) -> str:
    """Where a message that is broadcast is sent to several and transmitted once."""
    count = sent.get("transmissions")
    return "" if count is None or count == sent["sent"] else f" in {_count(count)} transmissions"


def _conserved(found: dict[str, Any]) -> str:
    words = [
        f"{name} {number(sums['total'])} of {number(sums['exact'])} ({sums['drift']:+.1e})"
        for name, sums in found.items()
    ]
    worst = max(abs(sums["drift"]) for sums in found.values())
    lost = ", drifting: directions of a link do not fail together" if worst > DRIFTED else ""
    return ", ".join(words) + lost


def _key(value: float | None) -> float:
    return math.inf if value is None or not math.isfinite(value) else value


def _cells(name: str, row: dict[str, Any]) -> list[str]:
    keys = ("rms_error", "mean_trace", "bound", "ratio", "mean_nees")
    return [name, *(number(row[key]) + _give_or_take(row.get(f"{key}_se")) for key in keys)]


def _give_or_take(error: float | None) -> str:
    known = error is not None and math.isfinite(error)
    return f" +- {error:.1g}" if known else ""


def _count(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,.1f}"
