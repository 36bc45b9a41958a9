"""The picture of an ensemble."""

from __future__ import annotations

from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from netkf.ensembles.directory import FinishedEnsemble
from netkf.linalg.arrays import FloatArray
from netkf.runs.files import write_atomically
from netkf.runs.plots import (
    NO_TRUTH,
    RELAY,
    SENSING,
    draw_legend,
    draw_lines,
    draw_nees,
    draw_promises,
    mark_unavailable,
    select_evenly,
    set_scale,
)
from netkf.runs.summary import NO_COVARIANCE
from netkf.scenario.scenario import Scenario


def ensemble_picture(scenario: Scenario, finished: FinishedEnsemble) -> None:
    """Write ``run.png``: root mean square errors and square roots of the mean trace of P over time,
    each with a band of at least two standard errors, against the bound and the limits, and NEES.
    """
    ensemble = finished.ensemble
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        rows = 3 if ensemble.shown else 2
        figure = Figure(figsize=(9.0, 1.0 + 2.7 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        above, below, *lowest = figure.subplots(rows, 1)
        if ensemble.shown:
            _bands(above, scenario, finished, ensemble.mean_error, ensemble.se_error)
            above.set(ylabel="root mean square error", xlabel="simulated seconds")
        else:
            mark_unavailable(above, NO_TRUTH)
        if np.isfinite(ensemble.mean_P).any():
            _bands(below, scenario, finished, ensemble.mean_P, ensemble.se_P)
            below.set(ylabel="square root of mean trace P", xlabel="simulated seconds")
        else:
            mark_unavailable(below, f"{NO_COVARIANCE}: trace P is unavailable")
        runs = int(ensemble.runs.max())
        if lowest:
            draw_nees(lowest[0], ensemble.times, ensemble.mean_nees, scenario, runs)
        name = f"{scenario.name}: {scenario.claim}" if scenario.claim else scenario.name
        title = f"{name} ({runs:,} runs)"
        figure.suptitle(fill(title, 105), fontsize=10, x=0.01, ha="left")
        with write_atomically(finished.directory / "run.png") as part:
            figure.savefig(part, dpi=130, format="png")


def _bands(
    axes: Any,
    scenario: Scenario,
    finished: FinishedEnsemble,
    mean: FloatArray,
    error: FloatArray,
) -> None:
    """Draw traces of (T, N, n, n) matrices with bands; the standard error of a trace is at most the
    sum of those of its terms.
    """
    times, promised = finished.ensemble.times, finished.promised
    trace = np.trace(mean, axis1=2, axis2=3)
    spread = 2.0 * np.trace(error, axis1=2, axis2=3)
    draw_lines(axes, times, np.sqrt(trace), scenario)
    sensing = [node in scenario.placed for node in scenario.nodes]
    for colour, words in ((SENSING, "with a sensor"), (RELAY, "without")):
        axes.plot([], [], color=colour, label=f"{words}, two standard errors")
    for k in select_evenly(np.arange(len(scenario.nodes))):
        ends = (np.sqrt(np.maximum(trace[:, k] + s * spread[:, k], 0.0)) for s in (-1.0, 1.0))
        colour = SENSING if sensing[k] else RELAY
        axes.fill_between(times, *ends, color=colour, alpha=0.2, lw=0)
    draw_promises(axes, times, promised)
    shown = np.sqrt(trace + spread)
    if promised.bound is not None:
        shown = np.concatenate([shown, np.sqrt(promised.bound)])
    set_scale(axes, shown)
    draw_legend(axes)
