"""The mean square errors of several filters or runs over time, in one figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.printable import list_some, shorten
from netkf.figures import style
from netkf.figures.figure_data import FigureData, reduce_result
from netkf.figures.names import SERIES
from netkf.linalg.arrays import FloatArray
from netkf.runs.curves import ErrorCurve
from netkf.runs.summary import NORMAL_QUANTILE

MAX_CURVES = 24
"""Curves that a figure shows; markers tell those apart whose lines look alike."""
MAX_LABEL, MAX_ORIGINS = 40, 3
BOUND = (0, (1, 1.5))
"""Dashes of bounds."""
NO_TRUTH = "None of them has a ground truth, so that their errors are unknown."


def errors_figure(curves: Sequence[ErrorCurve], origin: str = "") -> style.Picture:
    """Draw mean square errors ``curves`` over time; ``origin`` begins the caption."""
    # A curve has the look of its place, whichever of the others have errors.
    placed = [(k, c) for k, c in enumerate(curves) if np.isfinite(c.square).any()]
    known = [c for _, c in placed]
    with style.style_context():
        if not known:
            return style.message_figure("No error to show", NO_TRUTH, [origin])
        figure = style.new_figure(7.4, 4.6)
        axes = figure.add_subplot()
        for k, curve in placed[:MAX_CURVES]:
            _draw_curve(axes, curve, k)
        central = {curve.central for curve in curves if math.isfinite(curve.central)}
        if len(central) == 1:
            label = "centralised filter, trace of P by theory"
            axes.axhline(*central, color=style.MUTED, lw=0.9, ls=(0, (1, 2)), label=label)
        bounds = _draw_bounds(axes, placed[:MAX_CURVES])
        drawn = np.concatenate([*map(_high, known), *(c.square for c in known), *bounds])
        levels = [float(np.nanmedian(curve.square)) for curve in known[:MAX_CURVES]]
        style.set_scale(axes, np.append(drawn, list(central)), levels)
        axes.set(xlabel=style.SECONDS, ylabel=f"mean square error, squared {_unit(known)}")
        style.draw_legend(axes)
        sentences = [origin, "Mean over all nodes."]
        if any(curve.se is not None for curve in known):
            sentences.append("Bands: 95% intervals of the means over runs, or wider.")
        if len(known) > 1 and any(curve.se is None for curve in known):
            sentences.append("Differences of single runs may be chance.")
        if len(known) > MAX_CURVES:
            sentences.append(f"The first {MAX_CURVES} of {len(known)}.")
        missing = [shorten(c.label, MAX_LABEL) for c in curves if c not in known]
        if missing:
            sentences.append(f"Without errors: {list_some(missing, 6)}.")
        return style.finish_figure(figure, _headline(known), [" ".join(filter(None, sentences))])


def _draw_curve(axes: Any, curve: ErrorCurve, k: int) -> None:
    looks, again = SERIES[k % len(SERIES)], k // len(SERIES)
    label = style.label_text(curve.label, MAX_LABEL)
    square = np.minimum(curve.square, style.MAX_DRAWN)
    marks: dict[str, Any] = {"marker": SERIES[again].marker, "ms": 3.5} if again else {}
    marks |= {"markevery": max(1, len(square) // 12)} if again else {}
    alone = {"marker": looks.marker, "ms": 4} if len(square) == 1 else {}
    axes.plot(
        curve.times, square, color=looks.colour, ls=looks.dashes, label=label, **marks | alone
    )
    if curve.se is not None:
        low, high = np.maximum(square - NORMAL_QUANTILE * curve.se, 0.0), _high(curve)
        axes.fill_between(curve.times, low, high, color=looks.colour, alpha=0.15, lw=0)


def _draw_bounds(axes: Any, placed: Sequence[tuple[int, ErrorCurve]]) -> list[FloatArray]:
    """Draw the bounds of those numbered curves that have one, and return them."""
    bounds = []
    for k, curve in placed:
        if curve.bound is not None:
            bounds.append(np.minimum(curve.bound, style.MAX_DRAWN))
            colour = SERIES[k % len(SERIES)].colour
            axes.plot(curve.times, bounds[-1], color=colour, ls=BOUND, lw=0.9)
    if bounds:
        label = "in its colour: bound on the mean trace of P"
        axes.plot([], [], color=style.MUTED, ls=BOUND, lw=0.9, label=label)
    return bounds


def _unit(curves: Sequence[ErrorCurve]) -> str:
    units = {curve.unit for curve in curves}
    return style.label_text(units.pop() if len(units) == 1 else "units of the state")


def _high(curve: ErrorCurve) -> FloatArray:
    """Return the upper ends (T,) of a curve's intervals, or the curve itself."""
    width = 0.0 if curve.se is None else NORMAL_QUANTILE * curve.se
    return np.minimum(curve.square + width, style.MAX_DRAWN)


def _headline(curves: Sequence[ErrorCurve]) -> str:
    means, ends = [], {float(curve.times[-1]) for curve in curves}
    when = "after time 0" if len(ends) == 1 else f"up to {min(ends):g} s"
    for curve in curves:
        after = curve.square[(curve.times > 0.0) & (curve.times <= min(ends))]
        mean = float(after.mean()) if len(after) else math.nan  # nan where a run diverged
        means.append((mean if math.isfinite(mean) else math.inf, shorten(curve.label, MAX_LABEL)))
    (best, name), (worst, last) = min(means), max(means)
    if not math.isfinite(best):
        return "Mean square errors over time"
    sentence = f"{name} has the smallest mean square error {when}, {best:.3g}"
    if len(means) == 1:
        return f"{name}: mean square error {best:.3g} after time 0"
    return f"{sentence}; {last} {worst:.3g}" if math.isfinite(worst) else sentence


def curves_of(results: Sequence[Any] | Mapping[str, Any]) -> tuple[tuple[ErrorCurve, ...], str]:
    """Return the curves of results by label, or by what tells them apart: filters, scenarios or
    numbers; and a sentence on the runs. Raises ScenarioError.
    """
    labels = [str(label) for label in results] if isinstance(results, Mapping) else []
    found = list(results.values() if isinstance(results, Mapping) else results)
    if not found:
        raise ScenarioError("", "plot needs a run or an ensemble", results, "name at least one")
    data = [reduce_result(result) for result in found]
    named = zip(labels or _labels(data), data, strict=True)
    origins = list(dict.fromkeys(f"{one.scenario.name}: {one.count_text}" for one in data))
    more = f"; and {len(origins) - MAX_ORIGINS} more" if len(origins) > MAX_ORIGINS else ""
    return tuple(_curve(*pair) for pair in named), f"{'; '.join(origins[:MAX_ORIGINS])}{more}."


def _labels(data: Sequence[FigureData]) -> list[str]:
    choices = (
        [type(one.scenario.filter.algorithm).__name__ for one in data],
        [one.scenario.name for one in data],
    )
    numbered = [f"{k + 1}: {one.scenario.name}" for k, one in enumerate(data)]
    return next((names for names in choices if len(set(names)) == len(names)), numbered)


def _curve(label: str, data: FigureData) -> ErrorCurve:
    # A node's standard errors bound those of the mean of all nodes, which are dependent.
    se = None if data.se_error is None else data.se_error.mean(axis=1)
    square, promised, unit = data.sq_error.mean(axis=1), data.promised, data.scenario.unit
    central, bound = promised.central, promised.mean_bound
    return ErrorCurve(label, data.times, square, se, data.runs, central, bound, unit)
