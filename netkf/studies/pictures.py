"""The pictures of a sweep and of a comparison of filters that were just made."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from netkf.core.printable import shorten
from netkf.figures import style
from netkf.figures.catalogue import plot
from netkf.figures.figure_data import UnavailableError
from netkf.figures.stability import sweep_figure
from netkf.scenario.scenario import Scenario
from netkf.studies.compare_filters import ComparedFilter, FilterComparison
from netkf.studies.sweep import CompletedSweep

MAX_LABEL = 34
PANELS = ("rms_error", "RMS error"), ("worst_instant", "worst instant"), ("nees_ratio", "NEES / n")


def sweep_picture(scenario: Scenario, completed: CompletedSweep) -> bool:
    """Write ``sweep.png`` and return True; False if more than two keys were varied."""
    try:
        with style.style_context():
            figure = sweep_figure(scenario, completed.table, completed.keys, "complete")
    except UnavailableError:
        return False
    style.write_figure(figure, completed.directory / "sweep.png")
    return True


def filter_picture(scenario: Scenario, comparison: FilterComparison, directory: Path) -> None:
    """Write ``filters.png`` (errors, consistency, traffic) and ``errors.png`` (over time)."""
    rows = [row for row in comparison.rows if row.ran]
    with style.style_context():
        figure = style.new_figure(9.6, 1.7 + 0.34 * len(rows))
        panels = figure.subplots(1, len(PANELS) + 1, sharey=True)
        for axes, (name, label) in zip(panels, PANELS, strict=False):
            unit = scenario.common_unit if name != "nees_ratio" else ""
            _draw_quantity(
                axes, rows, name, label + (f", {style.label_text(unit)}" if unit else "")
            )
        kilobytes = [row.bytes / 1000.0 for row in rows]
        panels[-1].barh(range(len(rows)), kilobytes, height=0.5, color=style.MUTED)
        panels[-1].set_xlabel("kB sent in a run")
        labels = [shorten(row.filter, MAX_LABEL) for row in rows]
        panels[0].set_yticks(range(len(rows)), labels, parse_math=False)
        panels[0].invert_yaxis()
        runs = f"{comparison.runs:,} runs on the same draws; bars: two standard errors."
        finite = [row for row in rows if math.isfinite(row.rms_error.value)]
        title = "No filter has a finite error"
        if finite:
            best = min(finite, key=lambda row: row.rms_error.value)
            error = f"{best.rms_error.value:.3g}"
            title = f"{shorten(best.filter, MAX_LABEL)} has the smallest RMS error, {error}"
        style.finish_figure(figure, title, [f"{scenario.name}: {runs}"])
    style.write_figure(figure, directory / "filters.png")
    if comparison.curves:
        style.write_figure(plot(comparison), directory / "errors.png")


def _draw_quantity(axes: Any, rows: list[ComparedFilter], name: str, label: str) -> None:
    values = [row.quantities[name].value for row in rows]
    bars = [2.0 * row.quantities[name].se for row in rows]
    bars = [bar if math.isfinite(bar) else 0.0 for bar in bars]
    axes.errorbar(
        values, range(len(rows)), xerr=bars, ls="", marker="o", ms=4, capsize=2, color=style.BLUE
    )
    axes.set_xlabel(label)
    positive = [value for value in values if math.isfinite(value) and value > 0.0]
    if positive and max(positive) > style.LOG_RATIO * min(positive):
        axes.set_xscale("log")
    elif name != "nees_ratio":
        axes.set_xlim(left=0.0)
    if name == "nees_ratio":
        axes.axvline(1.0, color=style.MUTED, lw=0.8, ls="--")
