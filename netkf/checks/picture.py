"""The picture of a verdict: how far off each promise is, and what would have been seen."""

from __future__ import annotations

import textwrap
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from netkf.checks.check import Verdict
from netkf.checks.evidence import BROKEN, HOLDS, Evidence
from netkf.runs.files import write_atomically

COLOURS = {HOLDS: "#3b6ea5", BROKEN: "#c1440e"}
OTHER = "#777777"
LONGEST_LABEL = 72
FURTHEST = 3.0
"""Tolerances at which the axis ends."""


def verdict_picture(path: Path, verdict: Verdict, claim: str) -> bool:
    """Write the picture and return True; return False if no row has an interval.

    Every row that was decided by an interval shows it in units of what it tolerates, with a mark at
    the error that would have been seen with probability 0.9.
    """
    rows = [row for row in verdict.rows if row.low < row.high and row.tolerance > 0.0]
    if not rows:
        return False
    with mpl.rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(8.4, 1.1 + 0.27 * len(rows)), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        for place, row in enumerate(reversed(rows)):
            _draw_row(axes, place, row)
        axes.axvline(1.0, color="#222222", linewidth=0.8, linestyle=":")
        axes.set_yticks(range(len(rows)), [_label(row) for row in reversed(rows)])
        axes.set_xlim(0.0, FURTHEST)
        axes.set_xlabel("distance from the promise / what is tolerated; | would have been seen")
        title = textwrap.fill(claim or verdict.scenario, 100)
        note = f"{verdict.runs:,} runs, {verdict.confidence:.6g} for all intervals together"
        figure.suptitle(f"{title}\n{note}", x=0.01, horizontalalignment="left", fontsize=9)
        with write_atomically(path) as part:
            figure.savefig(part, dpi=130, format="png")
    return True


def _draw_row(axes: mpl.axes.Axes, place: int, row: Evidence) -> None:
    """Draw the interval of a row at height ``place``."""
    colour, unit = COLOURS.get(row.verdict, OTHER), row.tolerance
    low, high = max(0.0, -row.high) / unit, min(max(0.0, -row.low) / unit, 2.0 * FURTHEST)
    axes.plot([low, high], [place, place], color=colour, linewidth=3.0, solid_capstyle="butt")
    axes.plot([min(row.off / unit, FURTHEST)], [place], "o", color=colour, markersize=4)
    if np.isfinite(row.detectable):
        seen = min(row.detectable / unit, FURTHEST)
        axes.plot([seen], [place], "|", color="#222222", markersize=9)


def _label(row: Evidence) -> str:
    return textwrap.shorten(row.promise, LONGEST_LABEL, placeholder=" ...")
