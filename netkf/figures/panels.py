"""Panels over time that figures of runs and of ensembles share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from netkf.figures.style import (
    EXACT,
    INK,
    RELAY,
    SECONDS,
    SENSING,
    draw_legend,
    draw_message,
    set_scale,
)
from netkf.figures.subject import LEVEL, NO_TRUTH, Subject
from netkf.linalg.arrays import FloatArray
from netkf.runs.labels import covariance_bias
from netkf.runs.summary import CONFIDENCE, NO_COVARIANCE, PromisedTraces, nees_bounds

MAX_LINES = 60
"""Curves of single nodes in one panel; of larger networks an even selection is drawn."""
RMS_ERROR = "RMS error, units of the state"
ROOT_TRACE = "root of trace P, units of the state"


def select_evenly(indices: np.ndarray, most: int = MAX_LINES) -> np.ndarray:
    """Return at most ``most`` of the indices, evenly spaced."""
    if len(indices) <= most:
        return indices
    return np.asarray(indices[np.linspace(0, len(indices) - 1, most).astype(int)])


def draw_nodes(axes: Any, subject: Subject, values: FloatArray, se: FloatArray | None) -> None:
    """Draw the columns of ``values`` (T, N), roots of mean squares, one line a node, those with a
    sensor on top; with standard errors ``se`` of the squares each has its interval.
    """
    width = 1.1 if len(subject.nodes) <= 12 else 0.6
    groups = (
        (~subject.sensing, RELAY, 1, "without a sensor"),
        (subject.sensing, SENSING, 2, "with a sensor"),
    )
    several = subject.sensing.any() and not subject.sensing.all()
    for group, colour, order, which in groups:
        indices = select_evenly(np.flatnonzero(group))
        if not len(indices):
            continue
        # One collection is far faster than a line for each node.
        lines = [np.column_stack([subject.times, values[:, k]]) for k in indices]
        style = {"linewidths": width, "alpha": 0.75, "zorder": order}
        axes.add_collection(LineCollection(lines, colors=colour, **style))
        if se is not None:
            for k in indices:
                low, high = interval_of_root(values[:, k], se[:, k])
                axes.fill_between(subject.times, low, high, color=colour, alpha=0.2, lw=0)
        label = f"nodes {which}" if several else ("nodes" if len(indices) > 1 else "the node")
        axes.plot([], [], color=colour, lw=1.4, label=label)
    if len(subject.times) == 1:  # a line of one sample is invisible
        count = len(subject.nodes)
        axes.plot(np.repeat(subject.times, count), values.ravel(), ".", color=INK, ms=4)
    axes.autoscale()


def interval_of_root(root: FloatArray, se: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the 95% interval of a root whose square has standard errors ``se``."""
    low, high = (np.maximum(root**2 + s * LEVEL * se, 0.0) for s in (-1.0, 1.0))
    return np.sqrt(low), np.sqrt(high)


def draw_errors(axes: Any, subject: Subject, bound: bool = False) -> None:
    """Draw the RMS error of each node and of all over time, with the root of the mean bound if
    ``bound``; without ground truth the estimates instead, of which only agreement can be seen.
    """
    if not subject.shows_errors:
        _draw_estimates(axes, subject)
        return
    error = np.sqrt(subject.sq_error)
    draw_nodes(axes, subject, error, subject.se_error)
    rms = np.sqrt(subject.sq_error.mean(axis=1))
    if len(subject.nodes) > 1:
        axes.plot(subject.times, rms, color=INK, lw=2.0, label="RMS of all nodes", zorder=4)
    curves = [error]
    promised = subject.promised.bound
    if bound and promised is not None:
        roots = np.sqrt(promised)
        curves.append(roots)
        _draw_bound(axes, subject.times, roots)
    set_scale(axes, np.concatenate(curves))
    axes.set(ylabel="error |x - xhat|" if subject.runs == 1 else RMS_ERROR, xlabel=SECONDS)
    draw_legend(axes)


def _draw_estimates(axes: Any, subject: Subject) -> None:
    """Draw the first component of all estimates over time."""
    if subject.first is None:
        draw_message(axes, NO_TRUTH)
        return
    draw_nodes(axes, subject, subject.first, None)
    axes.set(ylabel="estimate, first component", xlabel=SECONDS)
    draw_legend(axes)


def draw_covariances(axes: Any, subject: Subject) -> None:
    """Draw the roots of the traces of P over time, the bound and the limits."""
    if not np.isfinite(subject.trace).any():
        draw_message(axes, f"{NO_COVARIANCE}: trace P is unavailable")
        return
    root = np.sqrt(np.maximum(subject.trace, 0.0))
    draw_nodes(axes, subject, root, subject.se_trace)
    draw_promises(axes, subject.times, subject.promised)
    bound = subject.promised.bound
    set_scale(axes, root if bound is None else np.concatenate([root, np.sqrt(bound)]))
    axes.set(ylabel=ROOT_TRACE, xlabel=SECONDS)
    draw_legend(axes)


def draw_promises(axes: Any, times: FloatArray, promised: PromisedTraces) -> None:
    """Draw the bound over ``times`` (T,) and the limits, as square roots of traces."""
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
    """Draw the bounds ``roots`` (T, N), only the largest and smallest if nodes differ."""
    same = np.allclose(roots.max(axis=1), roots.min(axis=1))
    label = "bound H(12)" if same else "bound H(12): largest"
    axes.plot(times, roots.max(axis=1), color=INK, lw=1.3, ls="--", label=label, zorder=3)
    if not same:
        axes.plot(
            times, roots.min(axis=1), color=INK, lw=1.3, ls=":", label="and smallest", zorder=3
        )


def draw_nees(axes: Any, subject: Subject) -> None:
    """Draw the NEES of each node, in an ensemble its mean, and the interval that holds it with
    probability CONFIDENCE if P is exact.
    """
    values, n, runs = subject.nees, subject.scenario.plant.n, subject.runs
    if not np.isfinite(values).any():
        draw_message(axes, "NEES is unavailable: it needs an error and a regular P")
        return
    draw_nodes(axes, subject, values, None)
    if len(subject.nodes) > 1:
        mean = values.mean(axis=1)
        axes.plot(subject.times, mean, color=INK, lw=2.0, label="mean of all nodes", zorder=4)
    low, high = nees_bounds(n, runs)
    axes.axhspan(low, high, color=EXACT, alpha=0.15, lw=0, label=f"{CONFIDENCE:.0%} if P is exact")
    design = covariance_bias(subject.scenario)
    label = f"n = {n}" + (f", P is {design} by design" if design else "")
    axes.axhline(n, color=EXACT, lw=1.1, ls="-.", label=label)
    set_scale(axes, np.append(values, high))
    axes.set(ylabel="NEES" if runs == 1 else f"mean NEES of {runs:,} runs", xlabel=SECONDS)
    draw_legend(axes)
