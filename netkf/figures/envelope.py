"""The figure ``envelope``: the replay of a log among runs of the laws that were fitted to it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.figures.figure_data import UnavailableError
from netkf.figures.style import INK, LOST, SKY, Picture, draw_legend, finish_figure, new_figure

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
        style: dict[str, Any] = {"color": LOST, "ls": "", "mew": 1.6, "label": "replay outside"}
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
