"""Tables of a page as HTML, and the data of curves that show the same numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import stdtrit

from netkf.core.printable import shorten
from netkf.report.directories import ReportSource, spread_curves
from netkf.report.markup import bullets, paragraph, table_box
from netkf.runs.files import to_json_value
from netkf.runs.summary import CONFIDENCE, nees_bounds
from netkf.runs.tables import (
    COLUMNS,
    columns_of,
    format_count,
    format_number,
    format_with_error,
    has_bound,
)
from netkf.studies.compare import Comparison, Entry, quantity_label
from netkf.studies.metrics import JUDGED, Quantity
from netkf.studies.opening import StoredComparison
from netkf.trace.nees import traces

MAX_ROWS = 2_000
"""Rows of a table on a page."""
HEADLINE = ("rms_error", "worst_instant", "mean_trace", "mean_nees", "transmissions", "lost")
"""Quantities with which a page of two runs begins."""
VERDICT_ORDER = ("broken", "undecided", "holds", "not promised")
INTERVAL_WIDTH = 2.0
"""Standard errors on each side of an interval in a curve."""


def verdict_table(source: ReportSource) -> str:
    """Return the verdict of ``netkf check`` as a table of promises, broken ones first."""
    verdict = source.verdict or {}
    rank = {verdict: k for k, verdict in enumerate(VERDICT_ORDER)}
    rows = sorted(verdict.get("rows", []), key=lambda row: rank.get(row["verdict"], len(rank)))
    cells = [
        (
            "BROKEN" if row["verdict"] == "broken" else row["verdict"],
            row["promise"],
            row["source"],
            # measured and promised value, their distance, and the error that would have been seen
            format_number(row["seen"]),
            format_number(row["expected"]),
            format_number(row["off"]),
            format_number(row["detectable"]),
            row["evidence"] or row["assumptions"],
        )
        for row in rows
    ]
    caption = f"Promises tested on {verdict.get('runs', 0):,} runs by netkf check"
    header = ("verdict", "promise", "source", "seen", "expected", "off by", "would see", "evidence")
    return table_box(caption, header, cells, "words")


def summary_section(source: ReportSource) -> str:
    """Return the averages of each node, with notes on messages and bounds, as HTML."""
    summary = source.summary
    if not summary:
        return paragraph("There is no summary: the runs ended before it was written")
    columns = columns_of(summary, source.scenario.common_unit)
    # The first cell is the id of a node, or "all".
    rows = [
        [row.get("node", "all"), *(format_with_error(row[k], row.get(f"{k}_se")) for k in columns)]
        for row in (*summary["nodes"], summary["overall"])
    ]
    *rows, overall = rows
    listed = rows[:MAX_ROWS]
    if len(rows) > MAX_ROWS:
        listed.append([f"({len(rows) - MAX_ROWS:,} more)", *[""] * len(columns)])
    listed.append(overall)
    runs = f"averages over {source.runs:,} runs, +- one standard error" if source.runs > 1 else ""
    caption = f"Averages over time{'; ' + runs if runs else ''}: {source.label}"
    messages = summary["messages"]
    counts = ", ".join(
        f"{format_count(messages[name])} {label}"
        for name, label in (
            ("sent", "sent"),
            ("delivered", "delivered"),
            ("lost", "lost or late"),
            ("in_flight", "on their way at the end"),
        )
        if messages.get(name) is not None
    )
    states = [source.scenario.states_note] if source.scenario.states_note else []
    notes = [*states, f"messages: {counts}", *_bound_notes(source), *summary.get("notes", [])]
    return table_box(caption, ["node", *columns.values()], listed) + bullets(notes)


def _bound_notes(source: ReportSource) -> list[str]:
    summary, promised = source.summary, source.promised
    concerned = promised is None or promised.limit_label  # the hybrid paper is about the filter
    notes = [f"bound: {summary['bound']}"] if concerned and not has_bound(summary) else []
    if promised is not None:
        label = promised.limit_label
        limits = {label: summary["limit"], "centralised filter": summary["central"]}
        known = [f"{name} {format_number(value)}" for name, value in limits.items() if value]
        notes += [f"traces to compare: {', '.join(known)}"] if known else []
        if summary["limit"]:
            weights = "1/N" if label.startswith("limit S") else "their weights"
            notes.append(
                f"{label}: what the bound of every node tends to as links tick ever faster. It "
                f"solves the Riccati equation with {weights} of the information of all N nodes' "
                "readings, because nodes average covariances as if they shared one error; the "
                "centralised filter uses all of it. Errors tend to less than this limit: the "
                "filters do better than they claim"
            )
        notes += promised.notes
    return notes


def differences_table(comparison: Comparison) -> str:
    """Return the keys in which two directories, A and B, differ, and their averages, as HTML."""
    rows = [[key, *(shorten(value) for value in values)] for key, values in comparison.settings]
    for quantity, node, entries in comparison.rows:
        if node < 0 and quantity in HEADLINE and entries[0].value is not None:
            values = [format_with_error(entry.value, entry.se) for entry in entries]
            rows.append([quantity_label(quantity), *values])
    caption = "Keys that differ, and errors" if comparison.settings else "The same keys; errors"
    return table_box(caption, ["", *_lettered(comparison)], rows)


def _lettered(comparison: Comparison) -> list[str]:
    return [f"{k}: {label}" for k, label in zip("AB", comparison.directories, strict=True)]


def comparison_section(comparison: Comparison) -> str:
    """Return the differences of two directories, A and B, as HTML."""
    rows = []
    for quantity, node, (first, second) in comparison.rows:  # node -1: all nodes
        label = quantity_label(quantity) + ("" if node < 0 else f" of node {node}")
        values = [format_with_error(entry.value, entry.se) for entry in (first, second)]
        rows.append([label, *values, *_difference_cells(second)])
    header = ["quantity", *_lettered(comparison), "B - A", "interval", "certain?"]
    if min(comparison.runs) > 1:
        count = sum(entries[1].real is True for _, _, entries in comparison.rows)
        sentence = (
            f"{count} differences are certain: their intervals, which hold together with "
            f"probability {comparison.confidence:.6g}, exclude 0"
        )
    else:
        sentence = (
            "Single runs have no intervals: compare ensembles (netkf run --runs 100) to see which "
            "differences are certain"
        )
    return paragraph(sentence) + table_box("Differences of B from A", header, rows)


def _difference_cells(entry: Entry) -> list[str]:
    if entry.difference is None:
        return ["-", "-", "-"]
    interval = "-"
    if entry.low is not None:
        interval = f"{format_number(entry.low)} .. {format_number(entry.high)}"
    mark = {True: "\u25c6 certain", False: "no", None: "one run"}[entry.real]
    return [format_number(entry.difference), interval, mark]


def filters_table(comparison: StoredComparison) -> str:
    """Return the filters, with their differences from the first one, as HTML."""
    header = ["filter"]
    for name in ("RMS error", "worst instant", "NEES / n"):
        header += [name, f"difference from {comparison.first}", "certain?"]
    header += ["consistency", "transmissions", "kB"]
    rows = [
        [
            row.filter,
            *(cell for name in JUDGED for cell in _quantity_cells(row.quantities[name])),
            row.consistency,
            f"{row.transmissions:,.0f}",
            f"{row.bytes / 1000.0:,.6g}",
        ]
        for row in comparison.rows
        if row.ran
    ]
    caption = f"{comparison.runs:,} runs of each filter on the same draws, +- one standard error"
    notes = [
        f"All marks are right together with probability {comparison.confidence:.6g}; differences "
        "are taken run by run",
        "Worst instant: the largest error of any node at any sample; traffic is of replica 0",
    ]
    predictors = [row.filter for row in comparison.rows if row.ran and row.predicts]
    if predictors and len(predictors) < len(rows):
        notes.append(f"Samples of {', '.join(predictors)} are predictions, the others are filtered")
    return table_box(caption, header, rows) + bullets(notes)


def _quantity_cells(quantity: Quantity) -> list[str]:
    value = format_with_error(quantity.value, quantity.se)
    if not math.isfinite(quantity.difference):
        return [value, "-", "-"]
    interval = f"{format_number(quantity.low)} .. {format_number(quantity.high)}"
    difference = f"{format_number(quantity.difference)} ({interval})"
    return [value, difference, "\u25c6 certain" if quantity.real else "no"]


def sweep_table(source: ReportSource) -> str:
    """Return the first MAX_ROWS points of a sweep as HTML."""
    assert source.sweep is not None
    points = source.sweep.table
    if not len(points):
        return paragraph("No point of the sweep is finished yet")
    names = [str(name) for name in points.columns if not str(name).endswith("_se")]
    rows = [
        [_format_cell(record[name], record.get(f"{name}_se")) for name in names]
        for record in points.to_dict("records")[:MAX_ROWS]
    ]
    return table_box("Points of the sweep, +- one standard error", names, rows)


def _format_cell(value: Any, error: Any) -> str:
    if isinstance(value, (int, np.integer)):
        return f"{int(value):,}"
    if isinstance(value, (float, np.floating)):
        return format_with_error(float(value), None if error is None else float(error))
    return str(value)


def versions_table(source: ReportSource) -> str:
    """Return a table of the versions, the seed and the status in the manifest of a source."""
    manifest = source.manifest
    rows = [*manifest.get("versions", {}).items()]
    keys = ("seed", "replica", "engine", "status", "events", "fingerprint")
    rows += [(key, manifest[key]) for key in keys if key in manifest]
    return table_box("Versions and identity of the run", ("what", "value"), rows, "words")


def ensemble_curves(source: ReportSource) -> dict[str, Any] | None:
    """Return an ensemble's curves with intervals as JSON values; None for single runs."""
    ensemble = source.ensemble
    if ensemble is None:
        return None
    # The standard error of a trace is at most the sum of the standard errors of the diagonal.
    trace, trace_se = traces(ensemble.mean_P), traces(ensemble.se_P)
    square, square_se = traces(ensemble.mean_error), traces(ensemble.se_error)
    nodes: dict[str, Any] = {}
    sizes = source.scenario.sizes.tolist()
    for k, node in enumerate(ensemble.nodes):
        nodes[str(node)] = {
            "nees_interval": list(nees_bounds(sizes[k], max(1, source.runs))),
            "trace": _interval_curves(trace[:, k], trace_se[:, k]),
            "square": _interval_curves(square[:, k], square_se[:, k]),
            "nees": _interval_curves(ensemble.mean_nees[:, k], ensemble.se_nees[:, k]),
        }
        if ensemble.bound is not None:
            nodes[str(node)]["bound"] = to_json_value(ensemble.bound[:, k].tolist())
    spread = spread_curves(source.replicas, ensemble.nodes)
    return {"times": ensemble.times.tolist(), "nodes": nodes, "spread": spread}


def difference_curves(source_a: ReportSource, source_b: ReportSource) -> dict[str, Any] | None:
    """Return mean squared errors of B minus A over time, by node with limits of Welch's intervals,
    which hold together; None unless both are ensembles with the same nodes and times.
    """
    first, second = source_a.ensemble, source_b.ensemble
    if first is None or second is None or first.nodes != second.nodes:
        return None
    # Welch's degrees of freedom are at least those of the smaller ensemble.
    freedom = min(source_a.runs, source_b.runs) - 1
    if not np.array_equal(first.times, second.times) or freedom < 1:
        return None
    difference = traces(second.mean_error) - traces(first.mean_error)
    # The standard error of a trace is at most the sum of the standard errors of the diagonal.
    error = np.hypot(traces(first.se_error), traces(second.se_error))
    level = (1.0 - CONFIDENCE) / (2.0 * difference.size)
    half_width = float(stdtrit(freedom, 1.0 - level)) * error
    curves = (difference, difference - half_width, difference + half_width)
    nodes = {
        str(node): [to_json_value(curve[:, k].tolist()) for curve in curves]
        for k, node in enumerate(first.nodes)
    }
    return {"confidence": CONFIDENCE, "times": first.times.tolist(), "nodes": nodes}


def averages(source: ReportSource) -> list[dict[str, Any]] | None:
    """Return name and averages of each node, as in summary.json; None without a summary."""
    if not source.summary:
        return None
    names = ["node", *COLUMNS, *(f"{name}_se" for name in COLUMNS)]
    return [
        {"name": str(row["node"])} | {name: row[name] for name in names if name in row}
        for row in source.summary["nodes"]
    ]


def _interval_curves(mean: Any, error: Any) -> list[list[float | None]]:
    """Return mean (T,) and limits as lists, None where not finite."""
    half_width = INTERVAL_WIDTH * np.asarray(error, dtype=float)
    curves = (np.asarray(mean, dtype=float), mean - half_width, mean + half_width)
    return [to_json_value(curve.tolist()) for curve in curves]


def filter_curves(source: ReportSource) -> dict[str, Any] | None:
    """Return mean square errors and bounds of compared filters as JSON values; None without."""
    comparison = source.filters
    known = [c for c in comparison.curves if np.isfinite(c.square).any()] if comparison else []
    if comparison is None or not known:
        return None
    names = [row.filter for row in comparison.rows if row.ran]
    curves = [
        {
            "label": curve.label,
            "row": names.index(curve.label),
            "x": curve.times.tolist(),
            "y": _interval_curves(curve.square, np.zeros(1) if curve.se is None else curve.se),
            "bound": None if curve.bound is None else to_json_value(curve.bound.tolist()),
        }
        for curve in known
    ]
    central = {curve.central for curve in known}
    limit = central.pop() if len(central) == 1 else math.nan
    return {"curves": curves, "runs": comparison.runs, "central": to_json_value(limit)}


def sweep_curves(source: ReportSource) -> dict[str, Any] | None:
    """Return the worst RMS error over the first key as JSON values, a curve for each value of the
    others; None without a finished point, or if the first key has no numbers.
    """
    if source.sweep is None or not len(source.sweep.table):
        return None
    table, keys = source.sweep.table, list(source.sweep.keys)
    first_key, other_keys = keys[0], keys[1:]
    if not np.issubdtype(table[first_key].to_numpy().dtype, np.number):
        return None
    series = []
    groups = table.groupby(other_keys, sort=False) if other_keys else [((), table)]
    for values, points in groups:
        rows = points.sort_values(first_key)
        settings = zip(other_keys, tuple(values), strict=True)
        label = ", ".join(f"{key} = {value}" for key, value in settings)
        mean, error = rows["worst_rms"].to_numpy(), rows["worst_rms_se"].to_numpy()
        x = rows[first_key].astype(float).tolist()
        series.append({"label": label or "worst node", "x": x, "y": _interval_curves(mean, error)})
    return {"key": first_key, "series": series}
