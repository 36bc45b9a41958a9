"""The picture of a verdict: the deviation and the detectable error of each promise."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from netkf.checks.check import Verdict
from netkf.checks.evidence import BROKEN, HOLDS, Evidence
from netkf.figures import style

MAX_LABEL_LENGTH = 72
FURTHEST = 3.0
"""Tolerances at which the axis ends."""


MARKS = {HOLDS: (style.EXACT, "o", "holds"), BROKEN: (style.LOST, "X", "BROKEN")}
OTHER = style.MUTED, "s", "undecided"
"""Colours, markers and names of verdicts."""


def verdict_picture(path: Path, verdict: Verdict, claim: str) -> bool:
    """Write the picture and return True, False if no row has an interval. Rows show it in units of
    what they tolerate, with a mark at the error that is found with probability 0.9.
    """
    rows = [row for row in verdict.rows if row.low < row.high and row.tolerance > 0.0]
    if not rows:
        return False
    with style.style_context():
        figure = style.new_figure(8.8, 1.7 + 0.27 * len(rows))
        axes = figure.add_subplot()
        for height, row in enumerate(reversed(rows)):
            _draw_row(axes, height, row)
        for colour, marker, label in dict.fromkeys(MARKS.get(row.verdict, OTHER) for row in rows):
            axes.plot([], [], color=colour, marker=marker, label=label)
        axes.plot([], [], "|", color=style.INK, label="would have been seen")
        axes.axvline(1.0, color=style.INK, lw=0.8, ls=":", label="tolerated")
        axes.set_yticks(
            range(len(rows)),
            [textwrap.shorten(r.promise, MAX_LABEL_LENGTH, placeholder=" ...") for r in rows[::-1]],
            fontsize=7.5,
            parse_math=False,
        )
        axes.set_xlim(0.0, FURTHEST)
        axes.set_ylim(-0.7, len(rows) - 0.3)
        axes.set_xlabel("distance from the promise / what is tolerated")
        style.draw_legend(axes)
        note = f"{verdict.scenario}: {verdict.runs:,} runs. Intervals hold together with "
        note += f"probability {verdict.confidence:.6g}."
        title, broken = claim or verdict.scenario, sum(row.verdict == BROKEN for row in rows)
        if broken:
            title = f"{broken} of {len(rows)} promises with an interval are broken: {title}"
        style.finish_figure(figure, title, [note])
    style.write_figure(figure, path)
    return True


def _draw_row(axes: Any, height: int, row: Evidence) -> None:
    # The interval low, high of a row is of the margin, which is minus the distance.
    (colour, marker, _), unit = MARKS.get(row.verdict, OTHER), row.tolerance
    low, high = max(0.0, -row.high) / unit, min(max(0.0, -row.low) / unit, 2.0 * FURTHEST)
    axes.plot([low, high], [height, height], color=colour, lw=3.0, solid_capstyle="butt")
    looks = {"marker": marker, "color": colour, "ms": 4.5, "mec": style.INK, "mew": 0.5}
    axes.plot([min(row.off / unit, FURTHEST)], [height], **looks)
    if np.isfinite(row.detectable):
        axes.plot([min(row.detectable / unit, FURTHEST)], [height], "|", color=style.INK, ms=9)
