"""The figures ``nees``, ``nis`` and ``whiteness``: are errors and innovations consistent with P?"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.checks.innovations import MIN_READINGS, Innovations, autocorrelations
from netkf.core.errors import NetkfError
from netkf.figures import style
from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.style import draw_nees
from netkf.linalg.arrays import FloatArray
from netkf.runs.summary import CONFIDENCE, NORMAL_QUANTILE, chi_square_interval, nees_bounds

BINS = 40  # of time, few enough that each has many readings
MAX_DOTS = 4000  # readings that are drawn one by one
WHITE_SHARE = 0.1
"""Largest share of autocorrelations outside their 95% band that is taken for white noise."""


def nees_figure(data: FigureData) -> style.Picture:
    """Draw NEES over time with its interval if P is exact; raises UnavailableError."""
    data.require_samples()
    data.require_truth()
    data.require_covariance()
    (n, unit), sizes = data.nees_unit, data.scenario.sizes.tolist()
    low, high = np.array([nees_bounds(size, data.runs) for size in sizes]).T
    values = data.nees[data.averaged]
    known = np.isfinite(values)
    if not known.any():
        raise UnavailableError("NEES is unavailable: it needs an error and a regular P.")
    figure = style.new_figure(7.4, 4.2)
    draw_nees(figure.add_subplot(), data)
    inside = float(((values >= low) & (values <= high))[known].mean())
    divisor = f" over {data.runs:,} runs" if data.runs > 1 else ""
    freedom = " and ".join(f"{data.runs * size:,}" for size in sorted(set(sizes)))
    degrees = "degree" if freedom == "1" else "degrees"
    note = f"Band: chi-square with {freedom} {degrees} of freedom{divisor}."
    if data.scenario.states_note:
        note += f" Errors of {data.scenario.states_note}."
    headline = f"{inside:.0%} of the samples lie in the {CONFIDENCE:.0%} band of NEES; their mean "
    mean = float((values / unit)[known].mean())
    headline += f"{'is' if len(set(sizes)) == 1 else 'over n is'} {mean:.3g} where exact "
    headline += f"covariances give {n}"
    return style.finish_figure(figure, data.title(headline), data.caption(note, notes="nees"))


def require_innovations(data: FigureData) -> Innovations:
    """Return the innovations of a run, by a replay; raises UnavailableError."""
    if data.run is None:
        raise UnavailableError(
            "Only single runs have innovations: draw netkf.open(DIR).replica(0)."
        )
    if data.status in ("interrupted", "failed"):
        raise UnavailableError(f"The run was {data.status}, so its readings are not replayed.")
    try:
        return data.innovations
    except NetkfError as error:
        raise UnavailableError(f"There are no innovations to draw: {error}.") from None


def nis_figure(data: FigureData) -> style.Picture:
    """Draw the NIS of the readings over time, with its interval; raises UnavailableError."""
    innovations = require_innovations(data)
    figure = style.new_figure(7.4, 4.2)
    share, mean = draw_nis(figure.add_subplot(), innovations)
    count = len(innovations.nis)
    headline = f"NIS per row of a reading is {mean:.3g} where exact covariances give 1; "
    headline += f"{share:.0%} of {count:,} readings lie in their {CONFIDENCE:.0%} interval"
    note = "Dots: single readings; line: means of bins, with the interval of each if P is exact."
    note += f" Readings: {read}." if (read := data.scenario.what_is_read(-1)) else ""
    return style.finish_figure(figure, data.title(headline), data.caption(note))


def draw_nis(axes: Any, innovations: Innovations) -> tuple[float, float]:
    """Draw NIS over its degrees of freedom; return the share inside its interval, and the mean."""
    finite = np.isfinite(innovations.nis)
    times, nis = innovations.times[finite], innovations.nis[finite]
    rows = innovations.rows[finite].astype(np.float64)  # degrees of freedom of each reading
    dots = np.linspace(0, len(nis) - 1, min(len(nis), MAX_DOTS)).astype(int)
    looks = {"ls": "", "marker": ".", "ms": 2.5, "color": style.SKY, "alpha": 0.7}
    axes.plot(times[dots], (nis / rows)[dots], label="readings", **looks)
    edges = np.linspace(0.0, max(float(times.max()), 1e-12), BINS + 1)
    bins = np.clip(np.digitize(times, edges[1:-1]), 0, BINS - 1)
    sums, freedom = (
        np.asarray(np.bincount(bins, weights=values, minlength=BINS), dtype=np.float64)
        for values in (nis, rows)
    )
    has_readings = freedom > 0.0
    centres = 0.5 * (edges[1:] + edges[:-1])[has_readings]
    low, high = chi_square_interval(freedom[has_readings], CONFIDENCE)
    label = f"{CONFIDENCE:.0%} of means if P is exact"
    axes.fill_between(centres, low, high, color=style.EXACT, alpha=0.25, lw=0, label=label)
    means = sums[has_readings] / freedom[has_readings]
    axes.plot(centres, means, color=style.INK, lw=1.6, label="mean of each bin")
    axes.axhline(1.0, color=style.EXACT, ls="-.", lw=1.1, label="expected")
    style.set_scale(axes, np.concatenate([nis / rows, high]))
    if axes.get_yscale() == "log":
        # Single NIS may be arbitrarily close to 0.
        axes.set_ylim(bottom=max(axes.get_ylim()[0], 1e-3))
    axes.set(ylabel="NIS / rows of a reading", xlabel=style.SECONDS)
    style.draw_legend(axes)
    low, high = chi_square_interval(rows, CONFIDENCE)
    return float(((nis / rows >= low) & (nis / rows <= high)).mean()), float(nis.sum() / rows.sum())


def whiteness_figure(data: FigureData) -> style.Picture:
    """Draw the autocorrelations of whitened innovations; raises UnavailableError."""
    innovations = require_innovations(data)
    curves, counts = autocorrelations(innovations)
    if not curves:
        raise UnavailableError(f"No node has {MIN_READINGS} readings of one kind.")
    smallest, lags = min(counts.values()), len(next(iter(curves.values())))
    # ``curves``: for each node the autocorrelations (lags,); ``counts``: its numbers of readings.
    # An autocorrelation of white noise has a standard deviation of about 1 / sqrt(count).
    band = NORMAL_QUANTILE / np.sqrt(smallest)
    outside = sum(
        int((np.abs(curve) > NORMAL_QUANTILE / np.sqrt(counts[node])).sum())
        for node, curve in curves.items()
    )
    worst = max(curves, key=lambda node: float(np.abs(curves[node]).max()))
    figure = style.new_figure(7.4, 4.2)
    axes = figure.add_subplot()
    read = data.scenario.label_of_value(worst, 0, innovations.rows[innovations.nodes == worst])
    place = data.scenario.topology.index.get(worst)
    name = "all readings" if place is None else f"node {data.nodes[place]}"
    _draw_correlations(axes, curves, (worst, f"{name}, {read}" if read else name), band, lags)
    share = outside / (lags * len(curves))
    judgement = (
        "as expected of white noise" if share <= WHITE_SHARE else "so innovations are not white"
    )
    headline = f"{share:.0%} of autocorrelations are outside their 95% band, {judgement}"
    note = f"Band: 1.96 / root of {smallest:,}, the fewest readings of a node. Lags count readings."
    return style.finish_figure(figure, data.title(headline), data.caption(note))


def _draw_correlations(
    axes: Any, curves: dict[int, FloatArray], worst: tuple[int, str], band: float, lags: int
) -> None:
    """Draw autocorrelations (lags,) by node, the ``worst`` with its name, and the ``band``."""
    positions = np.arange(1, lags + 1)
    axes.axhspan(-band, band, color=style.EXACT, alpha=0.2, lw=0, label="95% if white")
    axes.axhline(0.0, color=style.EXACT, lw=0.8)
    all_curves = np.array(list(curves.values()))
    if len(curves) > 1:
        looks: dict[str, Any] = {"color": style.SKY, "alpha": 0.35, "lw": 0}
        low, high = all_curves.min(axis=0), all_curves.max(axis=0)
        axes.fill_between(positions, low, high, **looks, label="range of all nodes")
        mean = all_curves.mean(axis=0)
        axes.plot(positions, mean, "-o", color=style.INK, ms=3.5, label="mean of all nodes")
    node, name = worst
    label = style.label_text(f"{name}, the largest" if len(curves) > 1 else name, 60)
    axes.plot(positions, curves[node], "--s", color=style.SENSING, ms=3.5, label=label)
    axes.set(xlabel="lag, readings of the node", ylabel="autocorrelation of innovations")
    axes.xaxis.get_major_locator().set_params(integer=True)
    limit = max(1.3 * float(np.abs(all_curves).max()), 2.0 * band)
    axes.set_ylim(-limit, limit)
    style.draw_legend(axes)
