"""Tables of sweeps, searches and comparisons for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from netkf.core.printable import count_phrase, shorten
from netkf.runs.tables import (
    format_error,
    format_number,
    format_table,
    format_with_error,
    shorten_rows,
)
from netkf.studies.compare import Comparison
from netkf.studies.compare_filters import ComparedFilter, FilterComparison
from netkf.studies.consistency import Consistency
from netkf.studies.metrics import JUDGED, Quantity
from netkf.studies.search import Sizing

if TYPE_CHECKING:
    import pandas as pd

PROMISED = ("bound", "central")
COLUMNS = ("worst_rms", "mean_rms", "mean_trace", *PROMISED)
MORE_COLUMNS = ("worst_instant", "time_above", "mean_age", "time_connected", "joules")
"""Columns of those sweeps that have them."""
FILTER_COLUMNS = {"time_above": "time above", "mean_age": "age", "joules": "J"}
"""Headers of columns of those comparisons of filters that have them."""
MAX_ROWS = 40  # rows that fit onto a screen
MAX_LENGTH = 30  # characters of a cell


def format_sweep(lines: pd.DataFrame, keys: Sequence[str]) -> str:
    """Return the table of a sweep; what theory gives for no point has no column."""
    columns = [name for name in COLUMNS if name not in PROMISED or lines[name].notna().any()]
    columns += [name for name in MORE_COLUMNS if name in lines and lines[name].notna().any()]
    header = [*keys, *(name.replace("_", " ") for name in columns), "messages", "status"]
    rows = [
        [
            *(_format_short(row[key]) for key in keys),
            *(format_with_error(row[name], row.get(f"{name}_se")) for name in columns),
            f"{row['sent']:,.6g}",
            row["status"],
        ]
        for row in lines.to_dict("records")
    ]
    return format_table(header, shorten_rows(rows, MAX_ROWS))


def _format_short(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    text = text.lower() if isinstance(value, (bool, np.bool_)) else text  # as in TOML
    return text if len(text) <= MAX_LENGTH else f"{text[: MAX_LENGTH - 3]}..."


def format_sizing(sizing: Sizing) -> str:
    """Return the values that were tried, the answer, how certain it is, and what to do next."""
    header = [sizing.key, sizing.target.quantity, "at least", "at most", "runs", "target", "by"]
    rows = [
        [
            f"{p.value:g}",
            *map(format_number, (p.quantity, p.low, p.high)),
            *(str(p.runs), p.target, p.by),
        ]
        for p in sorted(sizing.probes)
    ]
    if sizing.by == "theory":  # no runs, no intervals
        header = [header[0], f"{sizing.target.quantity} ({sizing.probes[0].by})", header[-2]]
        rows = [[f"{p.value:g}", f"{p.quantity:.7g}", p.target] for p in sorted(sizing.probes)]
    lines = [format_table(header, rows), "", format_answer(sizing)]
    lines += [f"{sizing.target.quantity}: {sizing.quantity}", f"sure: {sizing.sure}"]
    return "\n".join([*lines, *filter(None, (sizing.central, sizing.advice))])


def format_answer(sizing: Sizing) -> str:
    """Return the answer of a search for a value of a key that reaches a target, as one sentence."""
    values = [probe.value for probe in sizing.probes]
    span = f"{min(values):g} .. {max(values):g}"
    if sizing.value is None:
        undecided = any(probe.target in ("undecided", "not shown") for probe in sizing.probes)
        verb = "was shown to reach" if undecided else "reaches"
        return f"no value of {sizing.key} in {span} {verb} {sizing.target}"
    extreme = "largest" if sizing.grows else "smallest"
    if sizing.misses is None:
        return f"{sizing.key} = {sizing.value:g}: all of {span} reaches {sizing.target}"
    found = f"{sizing.key} = {sizing.value:g} is the {extreme}"
    miss = next(probe for probe in sizing.probes if probe.value == sizing.misses)
    if miss.target == "not shown":
        above = f"at {sizing.misses:g} the bound is above the limit, the quantity may not be"
        return f"{found} for which the bound shows {sizing.target}; {above}"
    verb = "misses it" if miss.target == "missed" else "was not shown to"
    return f"{found} that reaches {sizing.target}; {sizing.misses:g} {verb}"


def format_consistency(consistency: Consistency, full: bool = True) -> str:
    """Return a row per node or block and a legend; unless ``full``, a large network has those whose
    P is inconsistent, and the first and last of the others.
    """
    of_blocks = bool(consistency.rows[0].block)
    header = ["node", *["block"] * of_blocks]
    header += ["NEES", "expected", "inside", "NIS", "expected", "verdict"]
    listed = list(consistency.rows)
    if not full and len(listed) > MAX_ROWS:
        listed = sorted(listed, key=lambda row: not row.verdict.startswith("BROKEN"))
    rows = [
        [
            str(row.node),
            *[row.block] * of_blocks,
            format_number(row.nees) + format_error(row.width),
            format_number(row.expected),
            f"{row.inside:.0%}" if math.isfinite(row.inside) else "-",
            format_number(row.nis),
            format_number(row.expected_nis),
            row.verdict,
        ]
        for row in listed
    ]
    level, rows_are = f"{consistency.confidence:g}", "blocks" if of_blocks else "nodes"
    all_sizes = sorted({row.n for row in consistency.rows})
    sizes = ", ".join(map(str, all_sizes))
    of_largest = f"; for n = {all_sizes[-1]}, others by theirs" if len(all_sizes) > 1 else ""
    ends = f"{consistency.low:.4g} .. {consistency.high:.4g}"
    scaled = f"{consistency.low / consistency.n:.4g} .. {consistency.high / consistency.n:.4g}"
    lines = [
        format_table(header, rows if full else shorten_rows(rows, MAX_ROWS)),
        "",
        f"{consistency.runs:,} runs, n = {sizes}; +-: half width of the interval on the "
        f"difference from the expected NEES, all {rows_are} together at confidence {level}",
        f"inside: samples whose mean over the runs lies in {ends} (ANEES {scaled}), the "
        f"chi-square bounds at {level} where P is exact{of_largest}",
    ]
    lines += [*filter(None, [consistency.states]), *(f"note: {n}" for n in consistency.notes)]
    return "\n".join(lines)


def format_filters(comparison: FilterComparison) -> str:
    """Return one row per filter, the reasons of those that cannot run, and a legend."""
    header = ["filter", "RMS error", "difference", "worst instant", "difference", "NEES / n"]
    header += ["difference", "consistency", "transmissions", "kB"]
    ran = [row for row in comparison.rows if row.ran]
    more = [name for name in FILTER_COLUMNS if any(_is_known(row, name) for row in ran)]
    header += [FILTER_COLUMNS[name] for name in more]
    rows = [
        [
            shorten(row.filter),
            *(cell for name in JUDGED for cell in _format_quantity(row.quantities[name])),
            row.consistency,
            f"{row.transmissions:,.0f}",
            f"{row.bytes / 1000.0:,.6g}",
            *(
                format_number(row.traffic[name])
                if name in row.traffic
                else format_with_error(row.quantities[name].value, row.quantities[name].se)
                for name in more
            ),
        ]
        for row in ran
    ]
    legend = _filter_legend(comparison, ran, "mean_age" in more)
    return "\n".join([format_table(header, rows, left_columns=1), "", *legend])


def _filter_legend(
    comparison: FilterComparison, ran: list[ComparedFilter], has_ages: bool
) -> list[str]:
    noted = [row for row in comparison.rows if row.status != "complete"]
    lines = [f"{shorten(row.filter)}: {row.status}" for row in noted]
    runs = f"{count_phrase(comparison.runs, 'run')} of each on the same draws"
    lines.append(f"{runs}; +-: one standard error; differences from {shorten(ran[0].filter)}, run")
    lines.append(
        "by run, +- half of their intervals; *: 0 is outside, all marks together at confidence "
        f"{comparison.confidence:g}"
    )
    if comparison.runs > 1 and any(
        row.consistency == "-" and math.isfinite(row.quantities["nees_ratio"].value) for row in ran
    ):
        lines.append("consistency: -, where all runs have the one state or readings of a record")
    known = any(math.isfinite(row.rms_error.value) for row in ran)
    what = "largest error" if known else "truth unknown, largest root of trace P"
    lines.append(f"worst instant: {what} of any node at any sample; traffic of replica 0")
    if has_ages:
        lines.append("age: of the newest reading of each sensor, mean over time and nodes, s")
    predicting = [shorten(row.filter) for row in ran if row.predicts]
    if predicting and len(predicting) < len(ran):
        lines.append(
            f"note: samples of {', '.join(predicting)} are predictions, the others are filtered"
        )
    others = [shorten(row.filter) for row in ran if not row.same_losses]
    if others:
        lines.append(
            f"note: {', '.join(others)}: other exchanges than those of {shorten(ran[0].filter)}, "
            "and so other losses and delays of the same law"
        )
    return lines


def _is_known(row: ComparedFilter, name: str) -> bool:
    return math.isfinite(row.traffic[name]) if name in row.traffic else name in row.quantities


def _format_quantity(cells: Quantity) -> tuple[str, str]:
    difference = "-"
    if math.isfinite(cells.difference):
        difference = f"{cells.difference:+.4g}"
        difference += format_error(0.5 * (cells.high - cells.low), digits=2)
        difference += "*" if cells.real else ""
    return format_with_error(cells.value, cells.se), difference


def format_comparison(comparison: Comparison) -> str:
    """Return finished runs side by side, significant differences starred."""
    numbered = [f"({k + 1})" for k in range(len(comparison.directories))]
    lines = [
        f"{mark} {shorten(directory)}: {shorten(name)}, {count_phrase(runs, 'run')}"
        for mark, directory, name, runs in zip(
            numbered, comparison.directories, comparison.names, comparison.runs, strict=True
        )
    ]
    lines += _setting_lines(comparison, numbered)
    rows = [
        [
            row.quantity if row.node < 0 else f"{row.quantity} of node {row.node}",
            *(format_with_error(e.value, e.se) + (" *" if e.real else "  ") for e in row.entries),
        ]
        for row in comparison.rows
    ]
    if len(rows) > MAX_ROWS:
        rows = [*rows[: MAX_ROWS - 3], _rest_row(len(rows) - MAX_ROWS, numbered), *rows[-3:]]
    lines += ["", format_table(["", *numbered], rows, left_columns=1)]
    return "\n".join([*lines, *_remark_lines(comparison, numbered)])


def _remark_lines(comparison: Comparison, numbered: list[str]) -> list[str]:
    """Return the notes, and what the stars mean, each after an empty line."""
    notes = [f"note: {remark}" for remark in comparison.remarks()]
    for mark, texts in zip(numbered, comparison.notes, strict=True):
        notes += [f"note: {mark} {shorten(note, 500)}" for note in texts]
    lines = ["", *notes] if notes else []
    methods = {e.method for row in comparison.rows for e in row.entries if e.method}
    intervals = ", ".join(sorted(methods - {"one run"}))
    if intervals:
        together = f"all marks together at confidence {comparison.confidence:g} ({intervals})"
        lines += ["", f"* differs from (1) for certain; {together}"]
    if "one run" in methods:
        lines += ["", "differences of single runs are not marked: they may be chance"]
    return lines


def _setting_lines(comparison: Comparison, numbered: list[str]) -> list[str]:
    """Return the table of the keys in which scenarios differ, after an empty line."""
    differing = [
        [shorten(key, 60), *(shorten(value, MAX_LENGTH) for value in values)]
        for key, values in comparison.settings
    ]
    most = MAX_ROWS // 2
    if len(differing) > most:
        differing[most:] = [_rest_row(len(differing) - most, numbered)]
    if differing:
        return ["", format_table(["key that differs", *numbered], differing, left_columns=1)]
    return ["", "the scenarios have the same keys"] if len(numbered) > 1 else []


def _rest_row(count: int, numbered: list[str]) -> list[str]:
    return [f"({count} more; --json has all)", *[""] * len(numbered)]
