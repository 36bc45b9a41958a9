"""Where and when messages were lost, and the errors of compared filters, as SVG."""

from __future__ import annotations

import math

import numpy as np

from netkf.core.printable import shorten
from netkf.figures.names import SERIES
from netkf.linalg.arrays import FloatArray
from netkf.report.markup import paragraph, text
from netkf.runs.outcomes import (
    Downtime,
    Outcomes,
    delivery_matrix,
    downtimes,
    fate_matrix,
    outcomes_of,
)
from netkf.runs.tables import format_number
from netkf.studies.compare_filters import ComparedFilter
from netkf.studies.opening import StoredComparison
from netkf.trace.messages import join_messages
from netkf.trace.run import Run

MAX_NODES = 24
"""Nodes up to which matrices are shown."""
CELL, MARGIN = 34, 42
LETTER, LETTERS = 7, 24
"""Pixels: the cell of a matrix, the least room for labels, a letter; and the longest label."""
WIDTH, HEIGHT, WINDOWS = 620, 110, 60
"""Pixels of losses over time, and the parts of the time."""
DARKEST = 0.55
"""Opacity of a cell of 1, over which its number can still be read."""


def outcome_figures(run: Run | None, label: str) -> str:
    """Return pictures of a run's losses; empty if nothing was lost."""
    if run is None or run.scenario is None or not len(run.log):
        return ""
    outcomes, size = outcomes_of(join_messages(run.log), run.nodes), len(run.nodes)
    down = downtimes(run.scenario, run.seed, run.replica)
    if outcomes.heard.all():
        return ""
    parts = [f"<h3>{text(label)}</h3>", _losses_over_time(run, outcomes, down)]
    if size <= MAX_NODES:
        names = [str(node) for node in run.nodes]
        lost, fates = 1.0 - delivery_matrix(outcomes, size), fate_matrix(outcomes, size)
        parts.append(_matrix(lost, names, "Share lost, from the sender (row) to the receiver"))
        if run.scenario.has_broadcasts and np.isfinite(fates).any():
            caption = "Shared fate: correlation of the outcomes of one broadcast at two hearers"
            parts.append(_matrix(fates, names, caption))
    return "".join(parts)


def _box(width: int, height: int, caption: str, content: str) -> str:
    """Return an SVG picture in a box of its own scroll bar, with its caption."""
    return (
        f'<div class="scroll" role="group" tabindex="0" aria-label="{text(caption)}">'
        f'<svg width="{width}" height="{height}" role="img" aria-label="{text(caption)}" '
        f'fill="currentColor" stroke="none" font-size="11">{content}</svg></div>'
        f"{paragraph(caption, 'note')}"
    )


def _matrix(values: FloatArray, names: list[str], caption: str) -> str:
    """Return a matrix (N, N), the darker a cell the farther its value is from 0; nan is empty."""
    cells = []
    names = [shorten(name, LETTERS) for name in names]
    margin = max(MARGIN, 12 + LETTER * max(map(len, names)))
    for k, name in enumerate(names):
        middle = margin + CELL * k + CELL // 2
        place, turn = (f"{middle} {margin - 8}", "middle"), ""
        if margin > MARGIN:  # names that are wider than a cell stand upright
            place, turn = (f"{middle + 4} {margin - 8}", "start"), "rotate(-90)"
        cells.append(
            f'<text transform="translate({place[0]}) {turn}" text-anchor="{place[1]}">'
            f"{text(name)}</text>"
            f'<text x="{margin - 8}" y="{middle + 4}" text-anchor="end">{text(name)}</text>'
        )
    for i, j in np.argwhere(np.isfinite(values)).tolist():
        value, x, y = float(values[i, j]), margin + CELL * j, margin + CELL * i
        opacity = DARKEST * min(abs(value), 1.0)
        cells.append(
            f'<rect x="{x}" y="{y}" width="{CELL - 1}" height="{CELL - 1}" '
            f'fill-opacity="{opacity:.3f}"/><text x="{x + CELL // 2}" y="{y + CELL // 2 + 4}" '
            f'text-anchor="middle">{value:.2f}</text>'
        )
    side = margin + CELL * len(names)
    return _box(side, side, caption, "".join(cells))


def _losses_over_time(run: Run, outcomes: Outcomes, down: list[Downtime]) -> str:
    """Return bars of the share lost over time, shaded where nodes were down."""
    horizon = float(run.scenario.horizon)
    bins = np.minimum((outcomes.sent / horizon * WINDOWS).astype(int), WINDOWS - 1)
    sent, lost = (np.bincount(bins, w, WINDOWS) for w in (None, ~outcomes.heard))
    scale, step = (WIDTH - MARGIN) / horizon, (WIDTH - MARGIN) / WINDOWS
    shades = [
        f'<rect x="{MARGIN + scale * one.begin:.2f}" y="0" height="{HEIGHT}" fill-opacity="0.13" '
        f'width="{scale * (min(one.end, horizon) - one.begin):.2f}"/>'
        for one in down
    ]
    bars = [
        f'<rect x="{MARGIN + step * k:.2f}" y="{HEIGHT * (1.0 - lost[k] / sent[k]):.2f}" '
        f'width="{step - 1.0:.2f}" height="{HEIGHT * lost[k] / sent[k]:.2f}" fill-opacity="0.7"/>'
        for k in np.flatnonzero(sent).tolist()
    ]
    axis = "".join(
        f'<text x="{MARGIN - 8}" y="{y}" text-anchor="end">{name}</text>'
        for y, name in ((11, "1"), (HEIGHT, "0"))
    )
    ends = "".join(
        f'<text x="{x}" y="{HEIGHT + 14}" text-anchor="{anchor}">{time}</text>'
        for x, anchor, time in ((MARGIN, "start", "0 s"), (WIDTH, "end", f"{horizon:g} s"))
    )
    line = f'<rect x="{MARGIN}" y="{HEIGHT}" width="{WIDTH - MARGIN}" height="1"/>'
    caption = f"Share of the messages lost, in parts of {horizon / WINDOWS:.5g} s"
    caption += "; shaded: a node was down" if down else ""
    return _box(WIDTH, HEIGHT + 20, caption, "".join([*shades, *bars, axis, line, ends]))


FILTERS_WIDTH, ROW_HEIGHT, LABEL_WIDTH, NUMBER_WIDTH = 620, 26, 190, 130
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
    scale = (FILTERS_WIDTH - LABEL_WIDTH - NUMBER_WIDTH) / axis_end if min(ends) > 0 else 0.0
    lines = "".join(_draw_row(row, k, scale, colours[row.filter]) for k, row in enumerate(rows))
    height = ROW_HEIGHT * len(rows) + 8
    label = (
        f"RMS error of {len(rows)} filters over {comparison.runs:,} runs of each on the same "
        "draws; bars: two standard errors, the axis begins at 0. The table says which differences "
        "are certain"
    )
    picture = (
        f'<svg id="filters-figure" width="{FILTERS_WIDTH}" height="{height}" role="img" '
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
    axis_end, high = FILTERS_WIDTH - NUMBER_WIDTH, _bar_end(row)
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
