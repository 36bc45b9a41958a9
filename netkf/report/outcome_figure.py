"""Where and when messages were lost: matrices of links and losses over time, as SVG."""

from __future__ import annotations

import numpy as np

from netkf.core.printable import shorten
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
