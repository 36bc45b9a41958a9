"""Tables of a page: verdicts, summaries, comparisons, sweeps, versions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import stdtrit

from netkf.linalg.arrays import FloatArray
from netkf.report.directories import Opened
from netkf.report.markup import bullets, paragraph, table_box
from netkf.runs.files import to_json_value
from netkf.runs.summary import CONFIDENCE, nees_bounds
from netkf.runs.tables import COLUMNS, format_number, format_standard_error
from netkf.studies.compare import Comparison, Entry
from netkf.studies.compare_filters import QUANTITIES
from netkf.studies.filter_values import Quantity
from netkf.studies.stored import StoredComparison

MAX_ROWS = 2_000
"""Rows of a table on a page; what is left out is counted."""
ORDER = ("broken", "undecided", "holds", "not promised")
INTERVAL = 2.0
"""Standard errors on each side of an interval in a curve."""


def verdict_table(source: Opened) -> str:
    """Return the rows of a verdict, broken ones first."""
    verdict = source.verdict or {}
    rows = sorted(verdict.get("rows", []), key=_verdict_rank)
    cells = [
        (
            f"{row['verdict'].upper() if row['verdict'] == 'broken' else row['verdict']}",
            row["promise"],
            row["source"],
            format_number(row["seen"]),
            format_number(row["expected"]),
            format_number(row["off"]),
            format_number(row["detectable"]),
            row["evidence"] or row["assumptions"],
        )
        for row in rows
    ]
    caption = f"Promises held against {verdict.get('runs', 0):,} runs by netkf check"
    header = ("verdict", "promise", "source", "seen", "expected", "off by", "would see", "evidence")
    return table_box(caption, header, cells, "words")


def _verdict_rank(row: dict[str, Any]) -> int:
    """Return a key that sorts rows by verdict."""
    return ORDER.index(row["verdict"]) if row["verdict"] in ORDER else len(ORDER)


def summary_section(source: Opened) -> str:
    """Return the table that ends ``netkf run``, with its notes."""
    summary = source.summary
    if not summary:
        return paragraph("There is no summary: the runs ended before it was written")
    rows = [[str(row["node"]), *_cells(row)] for row in summary["nodes"]]
    listed = rows[:MAX_ROWS]
    if len(rows) > MAX_ROWS:
        listed.append([f"({len(rows) - MAX_ROWS:,} more)", *[""] * len(COLUMNS)])
    listed.append(["all", *_cells(summary["overall"])])
    runs = f"averages over {source.runs:,} runs, +- one standard error" if source.runs > 1 else ""
    caption = f"Averages over time{'; ' + runs if runs else ''}: {source.label}"
    messages = summary["messages"]
    counts = ", ".join(
        f"{_format_count(messages[name])} {label}"
        for name, label in (
            ("sent", "sent"),
            ("delivered", "delivered"),
            ("lost", "lost or late"),
            ("in_flight", "on their way at the end"),
        )
        if messages.get(name) is not None
    )
    notes = [f"messages: {counts}", *_bound_notes(source), *summary.get("notes", [])]
    return table_box(caption, ["node", *COLUMNS.values()], listed) + bullets(notes)


def _cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of a row of the summary."""
    return [
        format_number(row[key]) + format_standard_error(row.get(f"{key}_se")) for key in COLUMNS
    ]


def _bound_notes(source: Opened) -> list[str]:
    """Return the notes on bound and limits."""
    summary = source.summary
    found = [] if any(row["bound"] for row in summary["nodes"]) else [f"bound: {summary['bound']}"]
    if source.promised is not None:
        label = source.promised.limit_label
        traces = {label: summary["limit"], "centralised filter": summary["central"]}
        known = [f"{name} {format_number(value)}" for name, value in traces.items() if value]
        found += [f"traces to compare: {', '.join(known)}"] if known else []
        found += [_limit_note(label)] if summary["limit"] else []
        found += source.promised.notes
    return found


def _limit_note(label: str) -> str:
    """Return a sentence that defines the limit of the bound, and says why it is not the centralised
    covariance.
    """
    weights = "1/N" if label.startswith("limit S") else "their weights"
    return (
        f"{label}: what the bound of every node tends to as links tick ever faster. It solves the "
        f"Riccati equation with {weights} of the information of all N nodes' readings, because "
        "nodes average covariances as if they shared one error; the centralised filter uses all of "
        "it. Errors tend to less than this limit: the filters do better than they claim"
    )


def _format_count(value: Any) -> str:
    """Return a count as text."""
    return f"{value:,}" if isinstance(value, int) else f"{value:,.1f}"


def comparison_section(comparison: Comparison) -> str:
    """Return the differences of two directories; certain ones are marked in words."""
    rows = []
    for quantity, node, entries in comparison.rows:
        one, other = entries[0], entries[1]
        where = quantity if node < 0 else f"{quantity} of node {node}"
        rows.append([where, _format_value(one), _format_value(other), *_difference_cells(other)])
    names = [
        f"{letter}: {label}" for letter, label in zip("AB", comparison.directories, strict=True)
    ]
    header = ["quantity", *names, "B - A", "interval", "certain?"]
    count = sum(entries[1].real is True for _, _, entries in comparison.rows)
    certain = (
        f"{count} differences are certain: their intervals, which hold together with probability "
        f"{comparison.confidence:.6g}, leave out 0"
        if min(comparison.runs) > 1
        else "One run says nothing about certainty: compare ensembles (netkf run --runs 100) to "
        "see which differences are certain"
    )
    return paragraph(certain) + table_box("Differences of B from A", header, rows)


def _format_value(entry: Entry) -> str:
    """Return a value with its standard error as text."""
    return format_number(entry.value) + format_standard_error(entry.se)


def _difference_cells(entry: Entry) -> list[str]:
    """Return the cells of a difference: value, interval, mark."""
    if entry.difference is None:
        return ["-", "-", "-"]
    interval = "-"
    if entry.low is not None:
        interval = f"{format_number(entry.low)} .. {format_number(entry.high)}"
    mark = {True: "\u25c6 certain", False: "no", None: "one run"}[entry.real]
    return [format_number(entry.difference), interval, mark]


def filters_table(found: StoredComparison) -> str:
    """Return the filters of a comparison, with their differences from the first one."""
    header = ["filter"]
    for name in ("RMS error", "worst instant", "NEES / n"):
        header += [name, f"difference from {found.first}", "certain?"]
    header += ["consistency", "transmissions", "kB"]
    rows = [
        [
            row.filter,
            *(cell for name in QUANTITIES for cell in _quantity_cells(row.quantities[name])),
            row.consistency,
            f"{row.transmissions:,.0f}",
            f"{row.bytes / 1000.0:,.6g}",
        ]
        for row in found.rows
        if row.ran
    ]
    caption = f"{found.runs:,} runs of each filter on the same draws, +- one standard error"
    notes = [
        f"All marks are right together with probability {found.confidence:.6g}; differences are "
        "taken run by run",
        "Worst instant: the largest error of any node at any sample; traffic is of replica 0",
    ]
    ahead = [row.filter for row in found.rows if row.ran and row.predicts]
    if ahead and len(ahead) < len(rows):
        notes.append(f"Samples of {', '.join(ahead)} are predictions, the others are filtered")
    return table_box(caption, header, rows) + bullets(notes)


def _quantity_cells(found: Quantity) -> list[str]:
    """Return the cells of a quantity: value, difference, mark."""
    value = format_number(found.value) + format_standard_error(found.se)
    if not math.isfinite(found.difference):
        return [value, "-", "-"]
    interval = f"{format_number(found.low)} .. {format_number(found.high)}"
    difference = f"{format_number(found.difference)} ({interval})"
    return [value, difference, "\u25c6 certain" if found.real else "no"]


def sweep_table(source: Opened) -> str:
    """Return the points of a sweep."""
    assert source.sweep is not None
    found = source.sweep.table
    if not len(found):
        return paragraph("No point of the sweep is finished yet")
    names = [str(name) for name in found.columns if not str(name).endswith("_se")]
    rows = [
        [_format_cell(record[name], record.get(f"{name}_se")) for name in names]
        for record in found.to_dict("records")[:MAX_ROWS]
    ]
    return table_box("Points of the sweep, +- one standard error", names, rows)


def _format_cell(value: Any, error: Any) -> str:
    """Return a value of a sweep with its standard error as text."""
    if isinstance(value, (int, np.integer)):
        return f"{int(value):,}"
    if isinstance(value, (float, np.floating)):
        return format_number(float(value)) + format_standard_error(
            None if error is None else float(error)
        )
    return str(value)


def versions_table(source: Opened) -> str:
    """Return the versions that the results depend on, and what else the manifest says."""
    manifest = source.manifest
    rows = [(name, value) for name, value in manifest.get("versions", {}).items()]
    keys = ("seed", "replica", "engine", "status", "events", "fingerprint")
    rows += [(key, manifest[key]) for key in keys if key in manifest]
    return table_box("Versions and identity of the run", ("what", "value"), rows, "words")


def ensemble_curves(source: Opened) -> dict[str, Any] | None:
    """Return curves of an ensemble with their intervals for the page: for each node the mean of
    trace P, the mean squared error and the mean NEES, as lists over times; None for single runs.

    The standard error of a trace is at most the sum of those of its diagonal, which is used.
    """
    found = source.ensemble
    if found is None:
        return None
    trace, trace_se = _matrix_traces(found.mean_P), _matrix_traces(found.se_P)
    square, square_se = _matrix_traces(found.mean_error), _matrix_traces(found.se_error)
    nodes: dict[str, Any] = {}
    for k, node in enumerate(found.nodes):
        nodes[str(node)] = {
            "trace": _with_interval(trace[:, k], trace_se[:, k]),
            "square": _with_interval(square[:, k], square_se[:, k]),
            "nees": _with_interval(found.mean_nees[:, k], found.se_nees[:, k]),
        }
        if found.bound is not None:
            nodes[str(node)]["bound"] = to_json_value(found.bound[:, k].tolist())
    interval = list(nees_bounds(source.scenario.plant.n, max(1, source.runs)))
    return {"times": found.times.tolist(), "nodes": nodes, "nees_interval": interval}


def difference_curves(one: Opened, other: Opened) -> dict[str, Any] | None:
    """Return the difference of mean squared errors of two ensembles, for each node a list of means
    and of both ends of their intervals over time; None if their nodes or times differ.

    The intervals are Welch's, and hold together for all nodes and times (Bonferroni). The standard
    error of a sum is at most the sum of the standard errors, which is used.
    """
    first, second = one.ensemble, other.ensemble
    if first is None or second is None or first.nodes != second.nodes:
        return None
    freedom = min(one.runs, other.runs) - 1
    if not np.array_equal(first.times, second.times) or freedom < 1:
        return None
    gap = _matrix_traces(second.mean_error) - _matrix_traces(first.mean_error)
    error = np.hypot(_matrix_traces(first.se_error), _matrix_traces(second.se_error))
    level = (1.0 - CONFIDENCE) / (2.0 * gap.size)
    wide = float(stdtrit(freedom, 1.0 - level)) * error
    nodes = {
        str(node): [to_json_value(part[:, k].tolist()) for part in (gap, gap - wide, gap + wide)]
        for k, node in enumerate(first.nodes)
    }
    return {"confidence": CONFIDENCE, "times": first.times.tolist(), "nodes": nodes}


def _matrix_traces(matrices: FloatArray) -> FloatArray:
    """Return the traces (T, N) of matrices (T, N, n, n)."""
    return np.asarray(np.trace(matrices, axis1=2, axis2=3))


def averages(source: Opened) -> list[dict[str, Any]] | None:
    """Return the averages of each node as in summary.json, None without a summary."""
    if not source.summary:
        return None
    names = ["node", *COLUMNS, *(f"{name}_se" for name in COLUMNS)]
    return [{name: row[name] for name in names if name in row} for row in source.summary["nodes"]]


def _with_interval(mean: Any, error: Any) -> list[list[float | None]]:
    """Return mean, lower and upper end as JSON values."""
    wide = INTERVAL * np.asarray(error, dtype=float)
    return [
        to_json_value(column.tolist())
        for column in (np.asarray(mean, dtype=float), mean - wide, mean + wide)
    ]


def sweep_curves(source: Opened) -> dict[str, Any] | None:
    """Return the results of a sweep over its first varied key if that has numbers, else None."""
    if source.sweep is None or not len(source.sweep.table):
        return None
    found, keys = source.sweep.table, list(source.sweep.keys)
    if not np.issubdtype(found[keys[0]].to_numpy().dtype, np.number):
        return None
    series = []
    groups = found.groupby(keys[1:], sort=False) if len(keys) > 1 else [((), found)]
    for where, points in groups:
        rows = points.sort_values(keys[0])
        values = tuple(where)
        label = ", ".join(f"{k} = {v}" for k, v in zip(keys[1:], values, strict=True))
        mean, error = rows["worst_rms"].to_numpy(), rows["worst_rms_se"].to_numpy()
        x = rows[keys[0]].astype(float).tolist()
        series.append({"label": label or "worst node", "x": x, "y": _with_interval(mean, error)})
    return {"key": keys[0], "series": series}
