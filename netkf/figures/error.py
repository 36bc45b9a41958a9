"""The figures ``error``, ``quantiles`` and ``ratios``: errors over time, over nodes, and over P."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.figures.consistency import draw_nis, require_innovations
from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.style import (
    EXACT,
    FAINT,
    INK,
    RELAY,
    SECONDS,
    SENSING,
    Picture,
    draw_covariances,
    draw_errors,
    draw_legend,
    draw_message,
    finish_figure,
    label_text,
    new_figure,
    set_scale,
)
from netkf.linalg.arrays import FloatArray
from netkf.runs.summary import NORMAL_QUANTILE

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MARKED_SAMPLES = 3  # worst samples that the figure of quantiles marks
MAX_ROWS = 60  # nodes whose labels still fit beside each other


def error_figure(data: FigureData) -> Picture:
    """Draw errors and roots of trace P with its bound; without ground truth the estimates and NIS.
    Raises UnavailableError without samples.
    """
    data.require_samples()
    figure = new_figure(7.4, 6.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    draw_errors(upper, data, bound=True)
    if data.shows_errors:
        draw_covariances(lower, data)
        upper.set_xlabel("")
        sentences = ["Lines of nodes are single runs; the bound holds for the mean over runs."]
        if data.runs > 1:
            sentences = ["Bands: 95% intervals of the means (1.96 standard errors)."]
        elif data.promised.bound is None:
            sentences = [f"No bound: {data.promised.reason}."]
    else:
        sentences = [
            "There is no ground truth: readings are compared with their predictions (NIS)."
        ]
        try:
            draw_nis(lower, require_innovations(data))
        except UnavailableError as error:
            draw_message(lower, str(error))
            sentences = ["There is no ground truth."]
    return finish_figure(
        figure, data.title(bound_headline(data)), data.caption(*sentences, notes="bound")
    )


def bound_headline(data: FigureData) -> str:
    """Return the headline on traces of P and their bound, or on the range of the errors."""
    rows = [row for row in data.node_averages if _is_known(row.get("ratio"))]
    if rows and data.runs > 1:
        return _mean_headline(rows)
    if rows:
        # The bound is on the mean over runs.
        below, count = sum(row["ratio"] <= 1.0 for row in rows), len(rows)
        claim = "the node claims no more" if below else "the node claims more"
        claim = f"{below} of {count} nodes claim no more" if count > 1 else claim
        return f"In this run {claim} than the bound"
    if not data.shows_errors:
        return "Without ground truth: the estimates of the nodes and their innovations"
    values = [row["rms_error"] for row in data.node_averages if _is_known(row.get("rms_error"))]
    if not values:
        return "The errors of the nodes over time"
    if len(values) == 1:
        return f"The RMS error of the node is {values[0]:.3g}"
    return f"RMS errors of {len(values)} nodes lie between {min(values):.3g} and {max(values):.3g}"


def _mean_headline(rows: list[dict[str, Any]]) -> str:
    margins = [NORMAL_QUANTILE * _known_or_zero(row.get("ratio_se")) for row in rows]
    above = sum(row["ratio"] - m > 1.0 for row, m in zip(rows, margins, strict=True))
    below = sum(row["ratio"] + m <= 1.0 for row, m in zip(rows, margins, strict=True))
    count = len(rows)
    if below == count:
        nodes = f"All {count} nodes stay" if count > 1 else "The node stays"
        return f"{nodes} below the bound in the mean"
    if above:
        return f"{above} of {count} nodes exceed the bound in the mean"
    return f"{below} of {count} nodes stay below the bound in the mean, the others are undecided"


def _is_known(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def _known_or_zero(value: Any) -> float:
    return float(value) if _is_known(value) else 0.0


def quantiles_figure(data: FigureData) -> Picture:
    """Draw quantiles of errors (or roots of trace P) over nodes; raises UnavailableError."""
    data.require_samples()
    if data.shows_errors:
        values, label = np.sqrt(data.sq_error), "error |x - xhat|"
    else:
        data.require_covariance()
        values, label = np.sqrt(data.trace), "root of trace P"
    if data.runs > 1:
        label = f"root mean square of {label}" if data.shows_errors else label
    figure = new_figure(7.4, 4.4)
    axes = figure.add_subplot()
    finite = np.isfinite(values).any(axis=1)
    if not finite.any():
        raise UnavailableError("No sample has a finite error.")
    times, values = data.times[finite], values[finite]
    with np.errstate(invalid="ignore"):
        q05, q25, median, q75, q95 = np.nanquantile(values, QUANTILES, axis=1)
    axes.fill_between(times, q05, q95, color=RELAY, alpha=0.3, lw=0, label="90% of nodes")
    axes.fill_between(times, q25, q75, color=RELAY, alpha=0.6, lw=0, label="50% of nodes")
    axes.plot(times, median, color=INK, lw=1.6, label="median node")
    axes.plot(times, np.nanmax(values, axis=1), color=SENSING, ls="--", lw=1.1, label="worst node")
    name = "error" if data.shows_errors else "root of trace P"
    headline = _mark_worst(axes, data, times, values, name)
    set_scale(axes, values)
    axes.margins(y=0.15)
    axes.set(xlabel=SECONDS, ylabel=f"{label}, {data.unit}")
    draw_legend(axes)
    values_of = "means over the runs" if data.runs > 1 else "this run"
    caption = data.caption(f"Quantiles over the nodes of {values_of}, at each sample.")
    return finish_figure(figure, data.title(headline), caption)


def _mark_worst(
    axes: Any, data: FigureData, times: FloatArray, values: FloatArray, name: str
) -> str:
    """Mark the largest ``values`` (T, N) of the three worst nodes; return the headline."""
    rows = np.flatnonzero(np.isin(times, data.times[data.averaged]))
    rows = rows if len(rows) else np.arange(len(times))
    averaged = np.where(np.isfinite(values[rows]), values[rows], -np.inf)
    worst_nodes = np.argsort(-averaged.max(axis=0), kind="stable")[:MARKED_SAMPLES]
    headline = ""
    for rank, k in enumerate(worst_nodes.tolist()):
        row = int(rows[int(np.argmax(averaged[:, k]))])
        t, value = times[row], values[row, k]
        if not math.isfinite(value):
            continue
        axes.plot(
            [t],
            [value],
            marker=("o", "s", "^")[rank],
            ms=6,
            mfc="none",
            mec=INK,
            ls="",
            label=f"worst of node {label_text(data.nodes[k])}: {value:.3g} at {t:g} s",
        )
        of_node = f"of node {data.nodes[k]} at {t:g} s"
        headline = headline or f"The largest {name} after the start is {value:.3g}, {of_node}"
    if not headline:
        return "No error is finite"
    median = float(np.nanmedian(values[rows]))
    largest = float(np.nanmax(values[rows]))
    ratio = f"{largest / median:.3g} times the median" if median > 0.0 else f"median {median:.3g}"
    return f"{headline}, {ratio}"


def ratios_figure(data: FigureData) -> Picture:
    """Draw mean trace P over its bound, or NEES / n, of each node; raises UnavailableError."""
    rows = [row for row in data.node_averages if _is_known(row.get("ratio"))]
    key, label, reference_label = "ratio", "mean trace P / Tanwani's bound H(12)", "the bound"
    if not rows:
        data.require_truth()
        key, sizes = "mean_nees", data.scenario.sizes.tolist()
        same = f", n = {sizes[0]}" if len(set(sizes)) == 1 else ""
        label, reference_label = f"mean NEES / n{same}", "errors as P says"
        rows = [
            row | {name: row[name] / n for name in (key, f"{key}_se") if _is_known(row.get(name))}
            for row, n in zip(data.node_averages, sizes, strict=True)
            if _is_known(row.get(key))
        ]
        if not rows:
            raise UnavailableError("There are no ratios: no bound applies and NEES is unknown.")
    # Large networks: the nodes with the smallest and the largest ratios.
    rows = sorted(rows, key=lambda row: row[key])
    if len(rows) > MAX_ROWS:
        rows = [*rows[: MAX_ROWS // 2], *rows[-MAX_ROWS // 2 :]]
    figure = new_figure(7.4, min(9.0, 1.7 + 0.17 * len(rows)))
    axes = figure.add_subplot()
    _draw_ratios(axes, data, rows, key)
    axes.axvline(1.0, color=EXACT, ls="--", lw=1.2, label=reference_label)
    axes.set(xlabel=label, ylabel="node")
    draw_legend(axes)
    bars = "Bars: 95% intervals. " if data.runs > 1 else "One run has no intervals. "
    is_all = len(data.node_averages) <= MAX_ROWS
    selection = "" if is_all else f"The {MAX_ROWS // 2} smallest and largest ratios."
    if key == "ratio":
        caption = data.caption(bars, selection, notes="bound")
        return finish_figure(figure, data.title(bound_headline(data)), caption)
    ratios = [row[key] for row in rows]
    span = f"{min(ratios):.3g} to {max(ratios):.3g}" if len(ratios) > 1 else f"{ratios[0]:.3g}"
    headline = f"Squared errors are {span} times what P says; no bound applies"
    return finish_figure(figure, data.title(headline), data.caption(bars, selection, notes="nees"))


def _draw_ratios(axes: Any, data: FigureData, rows: list[dict[str, Any]], key: str) -> None:
    """Draw the entry ``key`` of each node's row, with 95% bars and a line at 1."""
    positions = np.arange(len(rows))
    values = np.array([row[key] for row in rows])
    widths = NORMAL_QUANTILE * np.array([_known_or_zero(row.get(f"{key}_se")) for row in rows])
    axes.hlines(positions, np.minimum(values, 1.0), np.maximum(values, 1.0), color=FAINT, lw=0.8)
    has_sensor = np.array([row["node"] in data.scenario.placed_sensors for row in rows])
    for group, colour, marker, label in (
        (has_sensor, SENSING, "s", "with a sensor"),
        (~has_sensor, RELAY, "o", "without a sensor"),
    ):
        if group.any():
            bars = widths[group] if data.runs > 1 else None
            style = {"fmt": marker, "color": colour, "mec": INK, "mew": 0.5, "ms": 4.5, "lw": 1.2}
            axes.errorbar(values[group], positions[group], xerr=bars, label=label, **style)
    axes.set_yticks(positions, [label_text(row["node"]) for row in rows], fontsize=6.5)
    axes.margins(x=0.08)
    axes.set_ylim(-0.7, len(rows) - 0.3)
