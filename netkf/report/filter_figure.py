"""The figure of a comparison of filters: errors with their intervals, as SVG without a script."""

from __future__ import annotations

import math

from netkf.core.printable import shorten
from netkf.report.markup import paragraph, text
from netkf.runs.tables import format_number
from netkf.studies.compare_filters import ComparedFilter
from netkf.studies.stored import StoredComparison

WIDTH, ROW, LABELS, VALUES = 620, 26, 190, 130
"""Pixels: the whole figure, the height of a filter, the columns of labels and of numbers."""
MAX_LABEL = 26


def filters_figure(found: StoredComparison) -> str:
    """Return the RMS error of each filter with a bar of two standard errors; empty without any."""
    rows = [
        row for row in found.rows if row.ran and math.isfinite(row.quantities["rms_error"].value)
    ]
    if not rows:
        return ""
    ends = [_bar(row) for row in rows]
    # The error of one that runs away leaves nothing to see of the others.
    scale = (WIDTH - LABELS - VALUES) / min(max(ends), 10.0 * min(ends)) if min(ends) > 0 else 0.0
    lines = "".join(_row(row, k, scale) for k, row in enumerate(rows))
    height = ROW * len(rows) + 8
    label = (
        f"RMS error of {len(rows)} filters over {found.runs:,} runs of each on the same draws; "
        "bars: two standard errors, the axis begins at 0. Which differences are certain stands in "
        "the table"
    )
    picture = (
        f'<svg id="filters-figure" width="{WIDTH}" height="{height}" role="img" '
        f'aria-label="{text(label)}" fill="currentColor" stroke="none" font-size="13">'
        f'<line x1="{LABELS}" x2="{LABELS}" y1="0" y2="{height}" stroke="currentColor"/>'
        f"{lines}</svg>"
    )
    return (
        f'<div class="scroll" role="group" tabindex="0">{picture}</div>{paragraph(label, "note")}'
    )


def _bar(row: ComparedFilter) -> float:
    """Return the upper end of the bar of a filter."""
    found = row.quantities["rms_error"]
    return found.value + (2.0 * found.se if math.isfinite(found.se) else 0.0)


def _row(row: ComparedFilter, k: int, scale: float) -> str:
    """Return label, bar, dot and number of a filter."""
    found, y = row.quantities["rms_error"], ROW * k + ROW // 2 + 4
    most, high = WIDTH - VALUES, _bar(row)
    low = max(0.0, 2.0 * found.value - high)
    x, left, right = (min(most, LABELS + scale * value) for value in (found.value, low, high))
    outside = LABELS + scale * found.value > most
    number = format_number(found.value) + (" (off the axis)" if outside else "")
    return (
        f'<text x="{LABELS - 8}" y="{y + 4}" text-anchor="end">'
        f"{text(shorten(row.filter, MAX_LABEL))}</text>"
        f'<line x1="{left:.2f}" x2="{right:.2f}" y1="{y}" y2="{y}" stroke="currentColor" '
        f'stroke-width="2"/><circle cx="{x:.2f}" cy="{y}" r="4"/>'
        f'<text x="{most + 8}" y="{y + 4}">{text(number)}</text>'
    )
