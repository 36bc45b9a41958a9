"""The picture of a comparison of filters."""

from __future__ import annotations

import math
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from netkf.core.printable import shorten
from netkf.runs.files import write_atomically
from netkf.scenario.scenario import Scenario
from netkf.studies.compare_filters import ComparedFilter, CompletedComparison

MAIN, GREY = "#3b6ea5", "#777777"
LONGEST_LABEL = 34
PANELS = (
    ("rms_error", "RMS error"),
    ("worst_instant", "worst instant"),
    ("nees_ratio", "NEES / n"),
)


def filter_picture(scenario: Scenario, completed: CompletedComparison) -> None:
    """Write ``filters.png``: errors, consistency and traffic of the filters that ran, side by
    side; bars are two standard errors.
    """
    rows = [row for row in completed.comparison.rows if row.ran]
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(9.6, 1.3 + 0.34 * len(rows)), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(1, len(PANELS) + 1, sharey=True)
        for axes, (name, label) in zip(panels, PANELS, strict=False):
            _draw_quantity(axes, rows, name, label)
        _draw_traffic(panels[-1], rows)
        labels = [shorten(row.filter, LONGEST_LABEL) for row in rows]
        panels[0].set_yticks(range(len(rows)), labels)
        panels[0].invert_yaxis()
        words = f"{completed.comparison.runs:,} runs on the same draws; bars: two standard errors"
        figure.suptitle(f"{scenario.name}: {words}", fontsize=10, x=0.01, ha="left")
        with write_atomically(completed.directory / "filters.png") as part:
            figure.savefig(part, dpi=130, format="png")


def _draw_quantity(axes: Any, rows: list[ComparedFilter], name: str, label: str) -> None:
    values = [row.quantities[name].value for row in rows]
    bars = [2.0 * row.quantities[name].se for row in rows]
    bars = [bar if math.isfinite(bar) else 0.0 for bar in bars]
    axes.errorbar(
        values, range(len(rows)), xerr=bars, ls="", marker="o", ms=4, capsize=2, color=MAIN
    )
    axes.set_xlabel(label)
    shown = [value for value in values if math.isfinite(value) and value > 0.0]
    if shown and max(shown) > 20.0 * min(shown):
        axes.set_xscale("log")
    elif name != "nees_ratio":
        axes.set_xlim(left=0.0)
    if name == "nees_ratio":
        axes.axvline(1.0, color=GREY, lw=0.8, ls="--")


def _draw_traffic(axes: Any, rows: list[ComparedFilter]) -> None:
    axes.barh(range(len(rows)), [row.bytes / 1000.0 for row in rows], height=0.5, color=GREY)
    axes.set_xlabel("kB sent in a run")
