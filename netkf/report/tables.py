"""Tables of a page: verdicts, summaries, comparisons, sweeps, versions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from netkf.report.directories import Source
from netkf.report.markup import bullets, paragraph, table
from netkf.runs.summary import CONFIDENCE, nees_bounds
from netkf.runs.tables import COLUMNS, format_number, standard_error
from netkf.studies.compare import Comparison, Entry

MAX_ROWS = 2_000
"""Rows of a table on a page; what is left out is counted."""
ORDER = ("broken", "undecided", "holds", "not promised")
INTERVAL = 2.0
"""Standard errors on each side of an interval in a curve."""


def verdict_table(source: Source) -> str:
    """Return the rows of a verdict, broken ones first."""
    verdict = source.verdict or {}
    rows = sorted(verdict.get("rows", []), key=_rank)
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
    return table(caption, header, cells, "words")


def _rank(row: dict[str, Any]) -> int:
    return ORDER.index(row["verdict"]) if row["verdict"] in ORDER else len(ORDER)


def summary_section(source: Source) -> str:
    """Return the table that ends ``netkf run``, with its notes."""
    summary = source.summary
    if summary is None:
        return paragraph("This directory has no summary: the run ended before it was written")
    rows = [[str(row["node"]), *_cells(row)] for row in summary["nodes"]]
    shown = rows[:MAX_ROWS]
    if len(rows) > MAX_ROWS:
        shown.append([f"({len(rows) - MAX_ROWS:,} more)", *[""] * len(COLUMNS)])
    shown.append(["all", *_cells(summary["overall"])])
    runs = f"averages over {source.runs:,} runs, +- one standard error" if source.runs > 1 else ""
    caption = f"Averages over time{'; ' + runs if runs else ''}: {source.label}"
    messages = summary["messages"]
    counts = ", ".join(
        f"{_count(messages[name])} {label}"
        for name, label in (
            ("sent", "sent"),
            ("delivered", "delivered"),
            ("lost", "lost or late"),
            ("in_flight", "on their way at the end"),
        )
        if messages.get(name) is not None
    )
    notes = [f"messages: {counts}", *_bound_notes(source), *summary.get("notes", [])]
    return table(caption, ["node", *COLUMNS.values()], shown) + bullets(notes)


def _cells(row: dict[str, Any]) -> list[str]:
    return [
        format_number(row[key]) + standard_error(row.get(f"{key}_se")) for key in COLUMNS
    ]


def _bound_notes(source: Source) -> list[str]:
    summary = source.summary or {}
    found = [] if any(row["bound"] for row in summary["nodes"]) else [f"bound: {summary['bound']}"]
    if source.promised is not None:
        label = source.promised.limit_label
        traces = {label: summary["limit"], "centralised filter": summary["central"]}
        known = [f"{name} {format_number(value)}" for name, value in traces.items() if value]
        found += [f"traces to compare: {', '.join(known)}"] if known else []
        found += source.promised.notes
    return found


def _count(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,.1f}"


def comparison_section(comparison: Comparison) -> str:
    """Return the differences of two directories; certain ones are marked in words."""
    rows = []
    for quantity, node, entries in comparison.rows:
        one, other = entries[0], entries[1]
        where = quantity if node < 0 else f"{quantity} of node {node}"
        rows.append([where, _value(one), _value(other), *_difference(other)])
    names = [f"{letter}: {label}" for letter, label in zip("AB", comparison.directories, strict=True)]
    header = ["quantity", *names, "B - A", "interval", "certain?"]
    count = sum(entries[1].real is True for _, _, entries in comparison.rows)
    certain = (
        f"{count} differences are certain: their intervals, which hold together with probability "
        f"{comparison.confidence:.6g}, leave out 0"
        if min(comparison.runs) > 1
        else "One run says nothing about certainty: compare ensembles (netkf run --runs 100) to "
        "see which differences are certain"
    )
    return paragraph(certain) + table("Differences of B from A", header, rows)


def _value(entry: Entry) -> str:
    return format_number(entry.value) + standard_error(entry.se)


def _difference(entry: Entry) -> list[str]:
    if entry.difference is None:
        return ["-", "-", "-"]
    interval = "-"
    if entry.low is not None:
        interval = f"{format_number(entry.low)} .. {format_number(entry.high)}"
    mark = {True: "\u25c6 certain", False: "no", None: "one run"}[entry.real]
    return [format_number(entry.difference), interval, mark]


def sweep_table(source: Source) -> str:
    """Return the points of a sweep."""
    if source.sweep is None or not len(source.sweep):
        return paragraph("No point of the sweep is finished yet")
    names = [str(name) for name in source.sweep.columns if not str(name).endswith("_se")]
    rows = []
    for record in source.sweep.to_dict("records")[:MAX_ROWS]:
        rows.append([_cell(record[name], record.get(f"{name}_se")) for name in names])
    return table("Points of the sweep, +- one standard error", names, rows)


def _cell(value: Any, error: Any) -> str:
    if isinstance(value, (int, np.integer)):
        return f"{int(value):,}"
    if isinstance(value, (float, np.floating)):
        return format_number(float(value)) + standard_error(None if error is None else float(error))
    return str(value)


def versions_table(source: Source) -> str:
    """Return the versions that the results depend on, and what else the manifest says."""
    manifest = source.manifest
    rows = [(name, value) for name, value in manifest.get("versions", {}).items()]
    for key in ("seed", "replica", "engine", "status", "events", "fingerprint"):
        if key in manifest:
            rows.append((key, manifest[key]))
    return table("Versions and identity of the run", ("what", "value"), rows, "words")


def ensemble_curves(source: Source) -> dict[str, Any] | None:
    """Return curves of an ensemble with their intervals for the page: for each node the mean of
    trace P, the mean squared error and the mean NEES, as lists over times; None without a table.

    The standard error of a trace is at most the sum of those of its diagonal, which is used.
    """
    found = source.ensemble
    if found is None or not len(found):
        return None
    names = list(found.columns)
    times = sorted(set(found["t"].tolist()))
    bound = source.promised.bound if source.promised is not None else None
    curves: dict[str, Any] = {"nodes": {}, "times": times}
    for k, (node, rows) in enumerate(found.groupby("node")):
        if len(rows) != len(times):
            return None
        entry: dict[str, Any] = {}
        if bound is not None and bound.shape[0] == len(times):
            entry["bound"] = finite(bound[:, k])
        for letter, name in (("P", "trace"), ("E", "square")):
            diagonal = [c for c in names if _is_diagonal(c, letter)]
            mean = rows[diagonal].sum(axis=1, skipna=False).to_numpy()
            error = rows[[f"{c}_se" for c in diagonal]].sum(axis=1, skipna=False).to_numpy()
            entry[name] = _with_interval(mean, error)
        entry["nees"] = _with_interval(rows["nees"].to_numpy(), rows["nees_se"].to_numpy())
        curves["nodes"][str(node)] = entry
    if source.scenario is not None:
        curves["nees_interval"] = list(nees_bounds(source.scenario.plant.n, source.runs))
    return curves


def difference_curves(one: Source, other: Source) -> dict[str, Any] | None:
    """Return the difference of mean squared errors of two ensembles, for each node a list of means
    and of both ends of their intervals over time; None if their nodes or times differ.

    The intervals are Welch's, and hold together for all nodes and times (Bonferroni). The standard
    error of a sum is at most the sum of the standard errors, which is used.
    """
    pair = [source.ensemble for source in (one, other)]
    if any(table is None or not len(table) for table in pair):
        return None
    first, second = (_squares(table) for table in pair if table is not None)
    if not first.index.equals(second.index):
        return None
    gap = (second["mean"] - first["mean"]).to_numpy()
    error = np.hypot(first["se"], second["se"]).to_numpy()
    freedom = min(one.runs, other.runs) - 1
    level = (1.0 - CONFIDENCE) / (2.0 * max(1, len(gap)))
    wide = stdtrit(freedom, 1.0 - level) * error if freedom > 0 else np.full(len(gap), np.nan)
    curves: dict[str, Any] = {"confidence": CONFIDENCE, "nodes": {}}
    nodes = first.index.get_level_values("node").to_numpy()
    curves["times"] = sorted(set(first.index.get_level_values("t").tolist()))
    for node in np.unique(nodes).tolist():
        rows = nodes == node
        columns = (gap[rows], (gap - wide)[rows], (gap + wide)[rows])
        curves["nodes"][str(node)] = [finite(column) for column in columns]
    return curves


def _squares(found: pd.DataFrame) -> pd.DataFrame:
    """Return the mean squared errors with their standard errors, by node and time."""
    diagonal = [str(name) for name in found.columns if _is_diagonal(str(name), "E")]
    columns = {
        "node": found["node"],
        "t": found["t"],
        "mean": found[diagonal].sum(axis=1, skipna=False),
        "se": found[[f"{name}_se" for name in diagonal]].sum(axis=1, skipna=False),
    }
    return pd.DataFrame(columns).set_index(["node", "t"]).sort_index()


def averages(source: Source) -> list[dict[str, Any]] | None:
    """Return the averages of each node as in summary.json, None without a summary."""
    if source.summary is None or source.kind in ("sweep", "verdict"):
        return None
    names = ["node", *COLUMNS, *(f"{name}_se" for name in COLUMNS)]
    return [{name: row[name] for name in names if name in row} for row in source.summary["nodes"]]


def _is_diagonal(name: str, letter: str) -> bool:
    digits = name[1:]
    half = digits.split("_") if "_" in digits else [digits[: len(digits) // 2]] * 2
    if not name.startswith(letter) or not all(part.isdecimal() for part in half):
        return False
    return half[0] == half[1] and (("_" in digits) or digits == half[0] * 2)


def _with_interval(mean: Any, error: Any) -> list[list[float | None]]:
    """Return mean, lower and upper end as JSON values."""
    wide = INTERVAL * np.asarray(error, dtype=float)
    return [finite(column) for column in (np.asarray(mean, dtype=float), mean - wide, mean + wide)]


def finite(values: Any) -> list[float | None]:
    """Return numbers as JSON values, None where they are not finite."""
    return [value if math.isfinite(value) else None for value in np.asarray(values).tolist()]


def sweep_curves(source: Source) -> dict[str, Any] | None:
    """Return the results of a sweep over its first varied key if that has numbers, else None."""
    found, keys = source.sweep, list(source.manifest.get("vary", {}))
    if found is None or not len(found) or not keys or keys[0] not in found:
        return None
    if not np.issubdtype(found[keys[0]].to_numpy().dtype, np.number):
        return None
    series = []
    groups = found.groupby(keys[1:], sort=False) if len(keys) > 1 else [((), found)]
    for where, rows in groups:
        rows = rows.sort_values(keys[0])
        values = where if isinstance(where, tuple) else (where,)
        label = ", ".join(f"{k} = {v}" for k, v in zip(keys[1:], values, strict=True))
        mean, error = rows["worst_rms"].to_numpy(), rows["worst_rms_se"].to_numpy()
        points = rows[keys[0]].astype(float).tolist()
        series.append(
            {"label": label or "worst node", "x": points, "y": _with_interval(mean, error)}
        )
    return {"key": keys[0], "series": series}
