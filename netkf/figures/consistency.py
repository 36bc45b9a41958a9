"""The figures ``nees``, ``nis`` and ``whiteness``: do the errors fit the covariances?"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import NetkfError
from netkf.figures.panels import draw_nees
from netkf.figures.style import (
    EXACT,
    INK,
    SECONDS,
    SENSING,
    SKY,
    Picture,
    draw_legend,
    finish_figure,
    new_figure,
    set_scale,
)
from netkf.figures.subject import LEVEL, Subject, UnavailableError
from netkf.linalg.arrays import FloatArray
from netkf.runs.innovations import (
    MIN_READINGS,
    Innovations,
    autocorrelations,
    chi_square_interval,
)
from netkf.runs.summary import CONFIDENCE, nees_bounds

BINS = 40  # of time, few enough that each has many readings


def nees_figure(subject: Subject) -> Picture:
    """Draw NEES over time with the interval that holds it if P is exact."""
    subject.require_samples()
    subject.require_truth()
    subject.require_covariance()
    n = subject.scenario.plant.n
    low, high = nees_bounds(n, subject.runs)
    values = subject.nees[subject.used]
    values = values[np.isfinite(values)]
    if not values.size:
        raise UnavailableError("NEES is unavailable: it needs an error and a regular P.")
    figure = new_figure(7.4, 4.2)
    draw_nees(figure.add_subplot(), subject)
    inside = float(((values >= low) & (values <= high)).mean())
    over = f" over {subject.runs:,} runs" if subject.runs > 1 else ""
    note = f"Band: chi-square with {subject.runs * n:,} degrees of freedom{over}."
    finish_figure(
        figure,
        subject.claim(_nees_claim(inside, float(values.mean()), n)),
        subject.caption(note, notes="nees"),
    )
    return figure


def _nees_claim(inside: float, mean: float, n: int) -> str:
    """Return the claim of the figure of NEES."""
    claim = f"{inside:.0%} of the samples lie in the {CONFIDENCE:.0%} band of NEES"
    return f"{claim}; their mean is {mean:.3g} where exact covariances give {n}"


def innovations_of(subject: Subject) -> Innovations:
    """Return the innovations of a run; raises UnavailableError if there are none."""
    if subject.run is None:
        raise UnavailableError(
            "Innovations are those of single runs: draw netkf.open(DIR).replica(0)."
        )
    if subject.status in ("interrupted", "failed"):
        raise UnavailableError(
            f"The run was {subject.status}, so that its readings are not replayed."
        )
    try:
        return subject.innovations
    except NetkfError as error:
        raise UnavailableError(f"There are no innovations to draw: {error}.") from None


def nis_figure(subject: Subject) -> Picture:
    """Draw the NIS of the readings over time with the interval of its means."""
    found = innovations_of(subject)
    figure = new_figure(7.4, 4.2)
    share, mean = draw_nis(figure.add_subplot(), found)
    claim = f"NIS per row of a reading is {mean:.3g} where exact covariances give 1; "
    claim += f"{share:.0%} of {len(found.nis):,} readings lie in their {CONFIDENCE:.0%} interval"
    note = "Dots: single readings; line: means of bins, with the interval of each if P is exact."
    finish_figure(figure, subject.claim(claim), subject.caption(note))
    return figure


def draw_nis(axes: Any, found: Innovations) -> tuple[float, float]:
    """Draw NIS over its degrees of freedom; return the share of readings in their interval and the
    mean.
    """
    known = np.isfinite(found.nis)
    times, nis = found.times[known], found.nis[known]
    rows = found.rows[known].astype(np.float64)
    chosen = np.linspace(0, len(nis) - 1, min(len(nis), 4000)).astype(int)
    style = {"ls": "", "marker": ".", "ms": 2.5, "color": SKY, "alpha": 0.7}
    axes.plot(times[chosen], (nis / rows)[chosen], label="readings", **style)
    edges = np.linspace(0.0, max(float(times.max()), 1e-12), BINS + 1)
    which = np.clip(np.digitize(times, edges[1:-1]), 0, BINS - 1)
    sums, freedom = (
        np.asarray(np.bincount(which, weights=v, minlength=BINS), dtype=np.float64)
        for v in (nis, rows)
    )
    full = freedom > 0.0
    centres = 0.5 * (edges[1:] + edges[:-1])[full]
    low, high = chi_square_interval(freedom[full], CONFIDENCE)
    axes.fill_between(
        centres,
        low,
        high,
        color=EXACT,
        alpha=0.25,
        lw=0,
        label=f"{CONFIDENCE:.0%} of means if P is exact",
    )
    axes.plot(centres, sums[full] / freedom[full], color=INK, lw=1.6, label="mean of each bin")
    axes.axhline(1.0, color=EXACT, ls="-.", lw=1.1, label="expected")
    set_scale(axes, np.concatenate([nis / rows, high]))
    if axes.get_yscale() == "log":
        axes.set_ylim(bottom=max(axes.get_ylim()[0], 1e-3))
    axes.set(ylabel="NIS / rows of a reading", xlabel=SECONDS)
    draw_legend(axes)
    ends = chi_square_interval(rows, CONFIDENCE)
    share = float(((nis / rows >= ends[0]) & (nis / rows <= ends[1])).mean())
    return share, float(nis.sum() / rows.sum())


def whiteness_figure(subject: Subject) -> Picture:
    """Draw the autocorrelation of the whitened innovations: the mean node and the worst one."""
    curves, counts = autocorrelations(innovations_of(subject))
    if not curves:
        raise UnavailableError(f"No node has {MIN_READINGS} readings of one kind.")
    smallest, lags = min(counts.values()), len(next(iter(curves.values())))
    band = LEVEL / np.sqrt(smallest)
    outside = sum(
        int((np.abs(c) > LEVEL / np.sqrt(counts[node])).sum()) for node, c in curves.items()
    )
    worst = max(curves, key=lambda node: float(np.abs(curves[node]).max()))
    figure = new_figure(7.4, 4.2)
    axes = figure.add_subplot()
    _draw_correlations(axes, curves, worst, band, lags)
    share = outside / (lags * len(curves))
    white = "as white noise would" if share <= 0.1 else "so innovations are not white"
    claim = f"{share:.0%} of autocorrelations are outside their 95% band, {white}"
    note = f"Band: 1.96 / root of {smallest:,}, the fewest readings of a node. Lags count readings."
    finish_figure(figure, subject.claim(claim), subject.caption(note))
    return figure


def _draw_correlations(
    axes: Any, curves: dict[int, FloatArray], worst: int, band: float, lags: int
) -> None:
    """Draw the autocorrelations of innovations (lags,) of the nodes, by lag."""
    positions = np.arange(1, lags + 1)
    axes.axhspan(-band, band, color=EXACT, alpha=0.2, lw=0, label="95% if white")
    axes.axhline(0.0, color=EXACT, lw=0.8)
    whole = np.array(list(curves.values()))
    if len(curves) > 1:
        axes.fill_between(
            positions,
            whole.min(axis=0),
            whole.max(axis=0),
            color=SKY,
            alpha=0.35,
            lw=0,
            label="range of all nodes",
        )
        axes.plot(positions, whole.mean(axis=0), "-o", color=INK, ms=3.5, label="mean of all nodes")
    name = "all readings" if worst < 0 else f"node {worst}"
    label = f"{name}, the largest" if len(curves) > 1 else name
    axes.plot(positions, curves[worst], "--s", color=SENSING, ms=3.5, label=label)
    axes.set(xlabel="lag, readings of the node", ylabel="autocorrelation of innovations")
    axes.xaxis.get_major_locator().set_params(integer=True)
    top = max(1.3 * float(np.abs(whole).max()), 2.0 * band)
    axes.set_ylim(-top, top)
    draw_legend(axes)
