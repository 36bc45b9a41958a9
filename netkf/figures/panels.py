"""Panels over time that figures of runs and of ensembles share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from netkf.figures.figure_data import NO_TRUTH, FigureData
from netkf.figures.style import (
    EXACT,
    INK,
    RELAY,
    SECONDS,
    SENSING,
    draw_legend,
    draw_message,
    label_text,
    set_scale,
)
from netkf.linalg.arrays import FloatArray
from netkf.runs.labels import covariance_bias
from netkf.runs.outcomes import downtimes
from netkf.runs.summary import (
    CONFIDENCE,
    NO_COVARIANCE,
    NORMAL_QUANTILE,
    PromisedTraces,
    nees_bounds,
)

MAX_LINES = 60
"""Curves of single nodes in one panel; of larger networks evenly spaced nodes are drawn."""
MAX_FREEDOM = 100  # of a chi-square variable whose quantiles are found by bisection
RMS_ERROR, ROOT_TRACE = "RMS error", "root of trace P"


def select_evenly(indices: np.ndarray, max_count: int = MAX_LINES) -> np.ndarray:
    """Return at most ``max_count`` of the ``indices`` (K,), evenly spaced, in their order."""
    if len(indices) <= max_count:
        return indices
    return np.asarray(indices[np.linspace(0, len(indices) - 1, max_count).astype(int)])


def draw_nodes(axes: Any, data: FigureData, values: FloatArray, se: FloatArray | None) -> None:
    """Draw ``values`` (T, N) by node, with 95 % intervals if their squares have errors ``se``."""
    width = 1.1 if len(data.nodes) <= 12 else 0.6
    groups = (
        (~data.has_sensor, RELAY, 1, "without a sensor"),
        (data.has_sensor, SENSING, 2, "with a sensor"),
    )
    has_both = data.has_sensor.any() and not data.has_sensor.all()
    for group, colour, order, description in groups:
        indices = select_evenly(np.flatnonzero(group))
        if not len(indices):
            continue
        # matplotlib draws one collection far faster than as many lines.
        lines = [np.column_stack([data.times, values[:, k]]) for k in indices]
        style = {"linewidths": width, "alpha": 0.75, "zorder": order}
        axes.add_collection(LineCollection(lines, colors=colour, **style))
        if se is not None:
            for k in indices:
                squares = (values[:, k] ** 2 + s * NORMAL_QUANTILE * se[:, k] for s in (-1.0, 1.0))
                low, high = (np.sqrt(np.maximum(square, 0.0)) for square in squares)
                axes.fill_between(data.times, low, high, color=colour, alpha=0.2, lw=0)
        label = "nodes" if len(indices) > 1 else "the node"
        if has_both:
            label = f"nodes {description}"
        axes.plot([], [], color=colour, lw=1.4, label=label)  # for the legend
    if len(data.times) == 1:  # a line of one sample is invisible
        axes.plot(np.repeat(data.times, len(data.nodes)), values.ravel(), ".", color=INK, ms=4)
    axes.autoscale()


def shade_downtimes(axes: Any, data: FigureData) -> None:
    """Shade the times at which a node of a run was down, darker where several were."""
    if data.run is None or not data.scenario.network.lives:
        return
    label, end = "a node down", data.scenario.horizon
    for down in downtimes(data.scenario, data.run.seed, data.run.replica):
        axes.axvspan(down.begin, min(down.end, end), color=INK, alpha=0.12, lw=0, label=label)
        label = "_"  # only one for the legend


def draw_errors(axes: Any, data: FigureData, bound: bool = False) -> None:
    """Draw errors by node and the RMS of all, and the root of the bound; else first estimates."""
    if not data.shows_errors:
        if data.first_component is None:
            draw_message(axes, NO_TRUTH)
            return
        draw_nodes(axes, data, data.first_component, se=None)
        axes.set(ylabel=f"estimate of {label_text(data.scenario.state_labels[0])}", xlabel=SECONDS)
        shade_downtimes(axes, data)
        draw_legend(axes)
        return
    error = np.sqrt(data.sq_error)
    draw_nodes(axes, data, error, data.se_error)
    rms = np.sqrt(data.sq_error.mean(axis=1))
    if len(data.nodes) > 1:
        axes.plot(data.times, rms, color=INK, lw=2.0, label="RMS of all nodes", zorder=4)
    curves = [error]
    promised = data.promised.bound
    if bound and promised is not None:
        roots = np.sqrt(promised)
        curves.append(roots)
        _draw_bound(axes, data.times, roots)
    set_scale(axes, np.concatenate(curves))
    name = "error |x - xhat|" if data.runs == 1 else RMS_ERROR
    axes.set(ylabel=f"{name}, {data.unit}", xlabel=SECONDS)
    shade_downtimes(axes, data)
    draw_legend(axes)


def draw_covariances(axes: Any, data: FigureData) -> None:
    """Draw the roots of the traces of P over time, with bound and limits, or a message."""
    if not np.isfinite(data.trace).any():
        draw_message(axes, f"{NO_COVARIANCE}: trace P is unavailable")
        return
    root = np.sqrt(np.maximum(data.trace, 0.0))
    draw_nodes(axes, data, root, data.se_trace)
    draw_promises(axes, data.times, data.promised)
    bound = data.promised.bound
    set_scale(axes, root if bound is None else np.concatenate([root, np.sqrt(bound)]))
    axes.set(ylabel=f"{ROOT_TRACE}, {data.unit}", xlabel=SECONDS)
    shade_downtimes(axes, data)
    draw_legend(axes)


def draw_promises(axes: Any, times: FloatArray, promised: PromisedTraces) -> None:
    """Draw the roots of the bound over ``times`` (T,), its limit, and the central trace."""
    if promised.bound is not None:
        _draw_bound(axes, times, np.sqrt(promised.bound))
    limits: tuple[tuple[float, str, Any], ...] = (
        (promised.limit, promised.limit_label, "-."),
        (promised.central, "centralised filter", (0, (6, 1, 1, 1, 1, 1))),
    )
    for value, label, style in limits:
        if math.isfinite(value):
            axes.axhline(math.sqrt(value), color=EXACT, ls=style, lw=1.1, label=label)


def _draw_bound(axes: Any, times: FloatArray, roots: FloatArray) -> None:
    """Draw ``roots`` (T, N) of the bounds on trace P; only largest and smallest if nodes differ."""
    same = np.allclose(roots.max(axis=1), roots.min(axis=1))
    label = "Tanwani's bound H(12)" if same else "Tanwani's bound H(12): largest"
    axes.plot(times, roots.max(axis=1), color=INK, lw=1.3, ls="--", label=label, zorder=3)
    if not same:
        axes.plot(
            times, roots.min(axis=1), color=INK, lw=1.3, ls=":", label="and smallest", zorder=3
        )


def nees_interval(n: int, runs: int) -> tuple[float, float]:
    """Return ``nees_bounds``, if it can without scipy.special, whose import takes 0.2 s."""
    freedom, tail = runs * n, 0.5 * (1.0 - CONFIDENCE)
    if freedom > MAX_FREEDOM:
        return nees_bounds(n, runs)
    ends = []
    for survival in (1.0 - tail, tail):
        low, high = 0.0, 10.0 * freedom + 20.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            is_below = _chi_square_survival(middle, freedom) > survival
            low, high = (middle, high) if is_below else (low, middle)
        ends.append(low / runs)
    return ends[0], ends[1]


def _chi_square_survival(x: float, freedom: int) -> float:
    """Return the probability that a chi-square variable exceeds x (Abramowitz, Stegun 26.4.4)."""
    y, odd = 0.5 * x, freedom % 2
    total = math.erfc(math.sqrt(y)) if odd else 0.0
    term = math.exp(-y) * (2.0 * math.sqrt(y / math.pi) if odd else 1.0)
    for k in range(freedom // 2):
        total += term
        term *= y / (k + 1.0 + 0.5 * odd)
    return total


def draw_nees(axes: Any, data: FigureData) -> None:
    """Draw NEES over time with its interval if P is exact, or a message if it is unknown."""
    values, runs, sizes = data.nees, data.runs, data.scenario.sizes
    # Nodes with states of different size are compared by NEES / n.
    n, unit = data.nees_unit
    values = values / unit
    if not np.isfinite(values).any():
        draw_message(axes, "NEES is unavailable: it needs an error and a regular P")
        return
    draw_nodes(axes, data, values, se=None)
    if len(data.nodes) > 1:
        mean = values.mean(axis=1)
        axes.plot(data.times, mean, color=INK, lw=2.0, label="mean of all nodes", zorder=4)
    ends = [
        (size, np.array(nees_interval(size, runs)) * n / size) for size in np.unique(sizes).tolist()
    ]
    for size, (low, high) in ends:
        label = f"{CONFIDENCE:.0%} if P is exact" + (f", n = {size}" if len(ends) > 1 else "")
        axes.axhspan(low, high, color=EXACT, alpha=0.15, lw=0, label=label)
    high = max(ends[0][1])
    bias = covariance_bias(data.scenario)
    label = f"n = {n}" + (f", P is {bias} by design" if bias else "")
    axes.axhline(n, color=EXACT, lw=1.1, ls="-.", label=label if len(ends) == 1 else "expected")
    set_scale(axes, np.append(values, high))
    name = "NEES" if len(ends) == 1 else "NEES / n"
    axes.set(ylabel=name if runs == 1 else f"mean {name} of {runs:,} runs", xlabel=SECONDS)
    shade_downtimes(axes, data)
    draw_legend(axes)
