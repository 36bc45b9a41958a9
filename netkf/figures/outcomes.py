"""The figures ``matrix``, ``fate``, ``losses`` of outcomes of messages, ``envelope`` of a fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np

from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.panels import select_evenly, shade_downtimes
from netkf.figures.style import (
    INK,
    LOST,
    SECONDS,
    SEQUENTIAL,
    SKY,
    Picture,
    draw_legend,
    finish_figure,
    label_text,
    new_figure,
)
from netkf.linalg.arrays import FloatArray
from netkf.runs.outcomes import Outcomes, delivery_matrix, fate_matrix, loss_windows, outcomes_of

MAX_NUMBERS = 14
"""Nodes up to which numbers fit into the cells of a matrix."""
MAX_TICKS, MAX_LETTERS = 30, 75
"""Labels of a matrix, and the letters of them all that fit beside each other."""
WINDOWS, MAX_ROWS = 60, 60
"""Parts of the time, and directions whose rows can still be told apart."""


def _require_outcomes(data: FigureData) -> Outcomes:
    outcomes = outcomes_of(data.joined, data.nodes)
    if not len(outcomes.sent):
        raise UnavailableError("No message was delivered or lost.")
    return outcomes


def matrix_figure(data: FigureData) -> Picture:
    """Draw the share delivered of each sender to each receiver; raises UnavailableError."""
    outcomes = _require_outcomes(data)
    shares = delivery_matrix(outcomes, len(data.nodes))
    used = np.isfinite(shares)
    low = np.unravel_index(int(np.nanargmin(shares)), shares.shape)
    headline = f"{outcomes.heard.mean():.1%} of {len(outcomes.heard):,} messages arrived"
    if shares[used].min() < shares[used].max():
        ends = f"node {data.nodes[low[0]]} to node {data.nodes[low[1]]}"
        headline += f"; the worst link is that from {ends}, {shares[low]:.0%}"
    axes, figure = _draw_matrix(data.nodes, shares, (0.0, 1.0), SEQUENTIAL, "share delivered")
    axes.set(xlabel="receiver", ylabel="sender")
    note = "Rows are senders, columns receivers; white: nothing was sent."
    return finish_figure(figure, data.title(headline), data.caption(note))


def fate_figure(data: FigureData) -> Picture:
    """Draw correlations of outcomes of hearers of one broadcast; raises UnavailableError."""
    fates = fate_matrix(_require_outcomes(data), len(data.nodes))
    if not (data.scenario.has_broadcasts and np.isfinite(fates).any()):
        reason = "No two nodes could hear the same transmission, or they lost all or nothing."
        raise UnavailableError(reason)
    mean = float(np.nanmean(fates))
    headline = f"Outcomes of one broadcast at two hearers correlate by {mean:.2f} on average"
    axes, figure = _draw_matrix(data.nodes, fates, (-1.0, 1.0), "RdBu_r", "correlation of outcomes")
    axes.set(xlabel="hearer", ylabel="hearer")
    note = (
        "Outcomes of one transmission at two of its hearers, about the mean of each link, all "
        "senders together; white: no common broadcast, or no loss."
    )
    return finish_figure(figure, data.title(headline), data.caption(note))


def _ticks(count: int) -> np.ndarray:
    """Return which of so many rows have a label: at most MAX_TICKS, equally far apart."""
    return np.arange(0, count, -(-count // MAX_TICKS))


def _draw_matrix(
    nodes: Sequence[int], values: FloatArray, span: tuple[float, float], colours: str, label: str
) -> tuple[Any, Picture]:
    """Draw ``values`` (N, N) of pairs of nodes in colours from ``span[0]`` to ``span[1]``."""
    figure = new_figure(6.4, 5.8)
    axes = figure.add_subplot()
    cmap = mpl.colormaps[colours].with_extremes(bad="white")
    image = axes.imshow(values, vmin=span[0], vmax=span[1], cmap=cmap, interpolation="nearest")
    places = _ticks(len(nodes))
    names = [label_text(nodes[k]) for k in places.tolist()]
    is_tight = len(names) > MAX_NUMBERS or len(names) * max(map(len, names)) > MAX_LETTERS
    axes.set_xticks(places, names, fontsize=6.5, rotation=90 if is_tight else 0)
    axes.set_yticks(places, names, fontsize=6.5)
    axes.tick_params(length=0)
    if len(nodes) <= MAX_NUMBERS:
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                share = (value - span[0]) / (span[1] - span[0])
                red, green, blue, _ = cmap(float(share))
                dark = 0.3 * red + 0.59 * green + 0.11 * blue < 0.5
                style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 6.5}
                axes.text(j, i, f"{value:.2f}", color="white" if dark else INK, **style)
    figure.colorbar(image, ax=axes, shrink=0.85, label=label).outline.set_linewidth(0.5)
    return axes, figure


def losses_figure(data: FigureData) -> Picture:
    """Draw the share lost over time, in all and by direction; raises UnavailableError."""
    outcomes = _require_outcomes(data)
    edges = np.linspace(0.0, data.scenario.horizon, WINDOWS + 1)
    links, shares = loss_windows(outcomes, len(data.nodes), edges)
    bins = np.clip(np.searchsorted(edges, outcomes.sent, side="right") - 1, 0, WINDOWS - 1)
    sent, lost = (np.bincount(bins, w, WINDOWS) for w in (None, ~outcomes.heard))
    rows = select_evenly(np.arange(len(links)), MAX_ROWS)
    figure = new_figure(8.4, min(9.0, 4.2 + 0.1 * len(rows)))
    heights = [1.0, max(1.0, min(2.6, 0.06 * len(rows)))]
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=heights)
    used = np.flatnonzero(sent)
    centres = 0.5 * (edges[1:] + edges[:-1])
    style: dict[str, Any] = {"color": INK, "marker": ".", "label": "all messages"}
    upper.plot(centres[used], lost[used] / sent[used], **style)
    upper.set_ylim(-0.03, 1.03)
    upper.set_ylabel("share lost")
    shade_downtimes(upper, data)
    draw_legend(upper)
    cmap = mpl.colormaps[SEQUENTIAL].with_extremes(bad="white")
    image = lower.pcolormesh(
        edges, np.arange(len(rows) + 1), shares[rows], vmin=0.0, vmax=1.0, cmap=cmap
    )
    pairs = (map(label_text, (data.nodes[k] for k in links[row])) for row in rows.tolist())
    names = [f"{sender} to {receiver}" for sender, receiver in pairs]
    ticks = _ticks(len(rows))
    lower.set_yticks(ticks + 0.5, [names[k] for k in ticks.tolist()], fontsize=5.5)
    lower.invert_yaxis()
    lower.set(xlabel=SECONDS, ylabel="sender to receiver")
    lower.set_xlim(0.0, float(edges[-1]))
    bar = figure.colorbar(image, ax=[upper, lower], shrink=0.6, label="share lost")
    bar.outline.set_linewidth(0.5)
    worst = used[int(np.argmax(lost[used] / sent[used]))]
    headline = f"{(~outcomes.heard).mean():.1%} of the messages were lost"
    if lost[worst]:
        window = f"{edges[worst]:.6g} and {edges[worst + 1]:.6g} s"
        headline += f"; at worst {lost[worst] / sent[worst]:.0%}, between {window}"
    note = f"In parts of {edges[1]:.5g} s, by the time of sending; white: nothing was sent."
    return finish_figure(figure, data.title(headline), data.caption(note))


COLUMNS = 3
"""Panels beside each other."""


def envelope_figure(table: Any) -> Picture:
    """Draw each quantity's range by law, and the replay; raises UnavailableError without runs."""
    if not len(table):
        raise UnavailableError("The laws were not run: netkf fit without --no-runs does so.")
    quantities, laws = list(table["quantity"].unique()), list(table["law"].unique())
    rows = math.ceil(len(quantities) / COLUMNS)
    figure = new_figure(9.0, 1.4 + rows * (1.0 + 0.24 * len(laws)))
    panels = figure.subplots(rows, COLUMNS, sharey=True, squeeze=False).ravel()
    for axes, quantity in zip(panels, quantities, strict=False):
        own = table[table["quantity"] == quantity].set_index("law").reindex(laws)
        places = np.arange(len(laws))
        axes.hlines(places, own["low"], own["high"], color=SKY, lw=5.0, label="range of the law")
        axes.plot(own["median"], places, "|", color=INK, ms=8, label="its median run")
        replay = float(own["replay"].iloc[0])
        axes.axvline(replay, color=INK, ls="--", lw=1.2, label="replay")
        outside = places[~own["inside"].astype(bool)]
        # The legend, which is that of the first panel, has it where any panel has.
        label = "_" if table["inside"].all() else "replay outside"
        style: dict[str, Any] = {"color": LOST, "ls": "", "mew": 1.6, "label": label}
        axes.plot(np.full(len(outside), replay), outside, "x", **style)
        axes.set_yticks(places, laws)
        axes.margins(x=0.12)
        if own[["low", "high", "replay"]].stack().nunique() == 1:
            axes.set_xlim(replay - 0.1, replay + 0.1)  # an axis over nothing has no scale
        axes.locator_params(axis="x", nbins=4)
        axes.set_ylim(len(laws) - 0.4, -0.6)
        axes.set_xlabel(quantity)
    for axes in panels[len(quantities) :]:
        axes.axis("off")
    draw_legend(panels[0])
    fails = [law for law in laws if not table[table["law"] == law]["inside"].all()]
    headline = f"The replay lies in the envelope of all {len(laws)} laws"
    if fails:
        headline = f"The replay lies outside the envelope of {', '.join(fails)}"
    runs = int(table["runs"].iloc[0])
    note = (
        f"{runs:,} runs of each law, with parameters drawn from their posterior; all ranges of a "
    )
    note += "law hold together."
    return finish_figure(figure, headline, [note])
