"""The figures ``error``, ``quantiles`` and ``ratios``: how large errors are, and where and when."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.figures.consistency import draw_nis, innovations_of
from netkf.figures.panels import draw_covariances, draw_errors
from netkf.figures.style import (
    EXACT,
    FAINT,
    INK,
    RELAY,
    SECONDS,
    SENSING,
    Picture,
    draw_legend,
    draw_message,
    finish_figure,
    new_figure,
    set_scale,
)
from netkf.figures.subject import LEVEL, Subject, UnavailableError
from netkf.linalg.arrays import FloatArray

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
WORST = 3  # instants that are marked
MAX_ROWS = 60  # nodes whose labels still fit beside each other


def error_figure(subject: Subject) -> Picture:
    """Draw errors beside the bound over time, and covariances beside it; without ground truth
    estimates and the NIS of the innovations.
    """
    subject.require_samples()
    figure = new_figure(7.4, 6.6)
    above, below = figure.subplots(2, 1, sharex=True)
    draw_errors(above, subject, bound=True)
    if subject.shows_errors:
        draw_covariances(below, subject)
        above.set_xlabel("")
        sentences = _interval_notes(subject)
    else:
        sentences = _draw_innovations(below, subject)
    finish_figure(
        figure, subject.claim(bound_claim(subject)), subject.caption(*sentences, notes="bound")
    )
    return figure


def _interval_notes(subject: Subject) -> list[str]:
    """Return the sentences on bands and bound."""
    if subject.runs > 1:
        return ["Bands: 95% intervals of the means (1.96 standard errors)."]
    if subject.promised.bound is None:
        return [f"No bound: {subject.promised.reason}."]
    return ["Lines of nodes are single runs; the bound holds for the mean over runs."]


def _draw_innovations(axes: Any, subject: Subject) -> list[str]:
    """Draw normalised innovations where there is no ground truth; return the sentences."""
    try:
        found = innovations_of(subject)
    except UnavailableError as error:
        draw_message(axes, str(error))
        return ["There is no ground truth."]
    draw_nis(axes, found)
    return ["There is no ground truth: readings are held against their predictions instead (NIS)."]


def bound_claim(subject: Subject) -> str:
    """Return a sentence on how many nodes stay below the bound, or what else can be said."""
    rows = [row for row in subject.rows if _is_known(row.get("ratio"))]
    if rows:
        return (_mean_claim if subject.runs > 1 else _run_claim)(rows)
    if subject.shows_errors:
        return _size_claim(subject)
    return "Without ground truth: what the nodes estimate, and what readings say about it"


def _run_claim(rows: list[dict[str, Any]]) -> str:
    """Return a sentence on one run: a bound on the mean over runs may be exceeded in it."""
    below, count = sum(row["ratio"] <= 1.0 for row in rows), len(rows)
    if count == 1:
        return f"In this run the node claims {'no more' if below else 'more'} than the bound"
    return f"In this run {below} of {count} nodes claim no more than the bound"


def _mean_claim(rows: list[dict[str, Any]]) -> str:
    """Return a sentence on the mean over runs, which counts the intervals of the ratios."""
    margins = [LEVEL * _known_or_zero(row.get("ratio_se")) for row in rows]
    above = sum(row["ratio"] - m > 1.0 for row, m in zip(rows, margins, strict=True))
    below = sum(row["ratio"] + m <= 1.0 for row, m in zip(rows, margins, strict=True))
    count = len(rows)
    if below == count:
        who = f"All {count} nodes stay" if count > 1 else "The node stays"
        return f"{who} below the bound in the mean"
    if above:
        return f"{above} of {count} nodes exceed the bound in the mean"
    return f"{below} of {count} nodes stay below the bound in the mean, the others are undecided"


def _size_claim(subject: Subject) -> str:
    """Return the claim of the figure: the range of RMS errors."""
    values = [row["rms_error"] for row in subject.rows if _is_known(row.get("rms_error"))]
    if not values:
        return "The errors of the nodes over time"
    if len(values) == 1:
        return f"The RMS error of the node is {values[0]:.3g}"
    return f"RMS errors of {len(values)} nodes lie between {min(values):.3g} and {max(values):.3g}"


def _is_known(value: Any) -> bool:
    """Return True for a finite number."""
    return value is not None and math.isfinite(value)


def _known_or_zero(value: Any) -> float:
    """Return the value, 0 if unknown."""
    return float(value) if _is_known(value) else 0.0


def quantiles_figure(subject: Subject) -> Picture:
    """Draw quantiles of the errors over the nodes at each time, and mark the worst instants."""
    subject.require_samples()
    if subject.shows_errors:
        values, label = np.sqrt(subject.sq_error), "error |x - xhat|"
    else:
        subject.require_covariance()
        values, label = np.sqrt(subject.trace), "root of trace P"
    if subject.runs > 1:
        label = f"root mean square of {label}" if subject.shows_errors else label
    figure = new_figure(7.4, 4.4)
    axes = figure.add_subplot()
    finite = np.isfinite(values).any(axis=1)
    if not finite.any():
        raise UnavailableError("No sample has a finite error.")
    times, values = subject.times[finite], values[finite]
    with np.errstate(invalid="ignore"):
        low, quarter, median, three, high = np.nanquantile(values, QUANTILES, axis=1)
    axes.fill_between(times, low, high, color=RELAY, alpha=0.3, lw=0, label="90% of nodes")
    axes.fill_between(times, quarter, three, color=RELAY, alpha=0.6, lw=0, label="50% of nodes")
    axes.plot(times, median, color=INK, lw=1.6, label="median node")
    worst = np.nanmax(values, axis=1)
    axes.plot(times, worst, color=SENSING, ls="--", lw=1.1, label="worst node")
    name = "error" if subject.shows_errors else "root of trace P"
    claim = _mark_worst(axes, subject, times, values, name)
    set_scale(axes, values)
    axes.margins(y=0.15)
    axes.set(xlabel=SECONDS, ylabel=f"{label}, units of the state")
    draw_legend(axes)
    over = "means over the runs" if subject.runs > 1 else "this run"
    caption = subject.caption(f"Quantiles over the nodes of {over}, at each sample.")
    finish_figure(figure, subject.claim(claim), caption)
    return figure


def _mark_worst(
    axes: Any, subject: Subject, times: FloatArray, values: FloatArray, name: str
) -> str:
    """Mark the worst instants, each of another node, and return a sentence on the first."""
    used = np.flatnonzero(np.isin(times, subject.times[subject.used]))
    used = used if len(used) else np.arange(len(times))
    errors = np.where(np.isfinite(values[used]), values[used], -np.inf)
    order = np.argsort(-errors.max(axis=0), kind="stable")[:WORST]
    claim = ""
    for rank, k in enumerate(order.tolist()):
        at = int(used[int(np.argmax(errors[:, k]))])
        t, value = times[at], values[at, k]
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
            label=f"worst of node {subject.nodes[k]}: {value:.3g} at {t:g} s",
        )
        of_node = f"of node {subject.nodes[k]} at {t:g} s"
        claim = claim or f"The largest {name} after the start is {value:.3g}, {of_node}"
    typical = float(np.nanmedian(values[used]))
    return f"{claim}, {value_ratio(values[used], typical)}" if claim else "No error is finite"


def value_ratio(values: FloatArray, typical: float) -> str:
    """Return how many times the ``typical`` value the largest one is, in words."""
    largest = float(np.nanmax(values))
    return f"{largest / typical:.3g} times the median" if typical > 0.0 else f"median {typical:.3g}"


def ratios_figure(subject: Subject) -> Picture:
    """Draw for each node its mean trace of P over the bound; without a bound NEES over n."""
    rows = [row for row in subject.rows if _is_known(row.get("ratio"))]
    key, label, line = "ratio", "mean trace P / mean bound H(12)", "the bound"
    if not rows:
        subject.require_truth()
        key, n = "mean_nees", subject.scenario.plant.n
        label, line = f"mean NEES / n, n = {n}", "errors as P says"
        rows = [row for row in subject.rows if _is_known(row.get(key))]
        if not rows:
            raise UnavailableError("There are no ratios: no bound applies and NEES is unknown.")
        scale = 1.0 / n
    else:
        scale = 1.0
    rows = sorted(rows, key=lambda row: row[key])
    rows = [*rows[: MAX_ROWS // 2], *rows[-MAX_ROWS // 2 :]] if len(rows) > MAX_ROWS else rows
    figure = new_figure(7.4, min(9.0, 1.7 + 0.17 * len(rows)))
    axes = figure.add_subplot()
    _draw_ratios(axes, subject, rows, key, scale)
    axes.axvline(1.0, color=EXACT, ls="--", lw=1.2, label=line)
    axes.set(xlabel=label, ylabel="node")
    draw_legend(axes)
    bars = "Bars: 95% intervals. " if subject.runs > 1 else "One run has no intervals. "
    cut = (
        f"The {MAX_ROWS // 2} smallest and largest ratios." if len(subject.rows) > MAX_ROWS else ""
    )
    claim = bound_claim(subject) if key == "ratio" else _nees_claim(rows, key, scale)
    finish_figure(
        figure,
        subject.claim(claim),
        subject.caption(bars, cut, notes="bound" if key == "ratio" else "nees"),
    )
    return figure


def _nees_claim(rows: list[dict[str, Any]], key: str, scale: float) -> str:
    """Return the claim where no bound applies: squared errors against P."""
    values = [row[key] * scale for row in rows]
    where = f"{min(values):.3g} to {max(values):.3g}" if len(values) > 1 else f"{values[0]:.3g}"
    return f"Squared errors are {where} times what P says; no bound applies"


def _draw_ratios(
    axes: Any, subject: Subject, rows: list[dict[str, Any]], key: str, scale: float
) -> None:
    """Draw the ratio of each node, with bars of 1.96 standard errors, against 1."""
    positions = np.arange(len(rows))
    values = scale * np.array([row[key] for row in rows])
    widths = scale * LEVEL * np.array([_known_or_zero(row.get(f"{key}_se")) for row in rows])
    axes.hlines(positions, np.minimum(values, 1.0), np.maximum(values, 1.0), color=FAINT, lw=0.8)
    has = np.array([row["node"] in subject.scenario.placed_sensors for row in rows])
    for group, colour, marker, label in (
        (has, SENSING, "s", "with a sensor"),
        (~has, RELAY, "o", "without a sensor"),
    ):
        if group.any():
            bars = widths[group] if subject.runs > 1 else None
            style = {"fmt": marker, "color": colour, "mec": INK, "mew": 0.5, "ms": 4.5, "lw": 1.2}
            axes.errorbar(values[group], positions[group], xerr=bars, label=label, **style)
    axes.set_yticks(positions, [str(row["node"]) for row in rows], fontsize=6.5)
    axes.margins(x=0.08)
    axes.set_ylim(-0.7, len(rows) - 0.3)
