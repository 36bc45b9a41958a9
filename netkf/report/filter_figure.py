"""The figure of a comparison of filters: RMS errors with error bars, as SVG without a script."""

from __future__ import annotations

import math

from netkf.core.printable import shorten
from netkf.figures.names import SERIES
from netkf.report.markup import paragraph, text
from netkf.runs.tables import format_number
from netkf.studies.compare_filters import ComparedFilter
from netkf.studies.stored import StoredComparison

WIDTH, ROW_HEIGHT, LABEL_WIDTH, NUMBER_WIDTH = 620, 26, 190, 130
"""Pixels: the whole figure, the row of a filter, the columns of labels and of numbers."""
MAX_LABEL = 26
"""Characters of a filter's label."""
MAX_RATIO = 10.0
"""Ratio of the largest to the smallest bar end on the axis: larger errors are drawn at its end."""


def filters_figure(comparison: StoredComparison) -> str:
    """Return the RMS errors of filters with two standard errors as SVG; empty if none is finite."""
    ran = [row for row in comparison.rows if row.ran]
    colours = {row.filter: f"series-{k % len(SERIES)}" for k, row in enumerate(ran)}
    rows = [row for row in ran if math.isfinite(row.rms_error.value)]
    if not rows:
        return ""
    ends = [_bar_end(row) for row in rows]
    # One diverging filter would compress the bars of all others to nothing.
    axis_end = min(max(ends), MAX_RATIO * min(ends))
    scale = (WIDTH - LABEL_WIDTH - NUMBER_WIDTH) / axis_end if min(ends) > 0 else 0.0
    lines = "".join(_draw_row(row, k, scale, colours[row.filter]) for k, row in enumerate(rows))
    height = ROW_HEIGHT * len(rows) + 8
    label = (
        f"RMS error of {len(rows)} filters over {comparison.runs:,} runs of each on the same "
        "draws; bars: two standard errors, the axis begins at 0. The table says which differences "
        "are certain"
    )
    picture = (
        f'<svg id="filters-figure" width="{WIDTH}" height="{height}" role="img" '
        f'aria-label="{text(label)}" fill="currentColor" stroke="none" font-size="13">'
        f'<line x1="{LABEL_WIDTH}" x2="{LABEL_WIDTH}" y1="0" y2="{height}" stroke="currentColor"/>'
        f"{lines}</svg>"
    )
    return (
        f'<div class="scroll" role="group" tabindex="0">{picture}</div>{paragraph(label, "note")}'
    )


def _bar_end(row: ComparedFilter) -> float:
    """Return the upper end of a filter's bar: its RMS error plus two standard errors."""
    error = row.rms_error
    return error.value + (2.0 * error.se if math.isfinite(error.se) else 0.0)


def _draw_row(row: ComparedFilter, k: int, scale: float, colour: str) -> str:
    """Return label, bar, dot and number of row ``k`` as SVG; ``scale`` is pixels per unit."""
    error, y = row.rms_error.value, ROW_HEIGHT * k + ROW_HEIGHT // 2 + 4
    axis_end, high = WIDTH - NUMBER_WIDTH, _bar_end(row)
    low = max(0.0, 2.0 * error - high)  # the bar is symmetric about the error
    x, left, right = (min(axis_end, LABEL_WIDTH + scale * value) for value in (error, low, high))
    is_outside = LABEL_WIDTH + scale * error > axis_end
    number = format_number(error) + (" (off the axis)" if is_outside else "")
    return (
        f'<text x="{LABEL_WIDTH - 8}" y="{y + 4}" text-anchor="end">'
        f"{text(shorten(row.filter, MAX_LABEL))}</text>"
        f'<line x1="{left:.2f}" x2="{right:.2f}" y1="{y}" y2="{y}" stroke="currentColor" '
        f'stroke-width="2"/><circle cx="{x:.2f}" cy="{y}" r="3" stroke-width="5" fill="none" '
        f'class="swatch {colour}"/>'
        f'<text x="{axis_end + 8}" y="{y + 4}">{text(number)}</text>'
    )
