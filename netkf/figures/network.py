"""The figure ``network``: nodes coloured by error, by traffic and by energy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.ticker import FuncFormatter

from netkf.figures.layout import Positions, positions_of
from netkf.figures.style import INK, MUTED, SEQUENTIAL, Picture, finish_figure, new_figure
from netkf.figures.subject import Subject

MAX_LINKS = 20_000
MAX_LABELLED_NODES = 60
MAX_BESIDE = 2.2
"""Networks wider than so many heights have their panels above each other."""


def network_figure(subject: Subject) -> Picture:
    """Draw the network once for each quantity of the nodes that is known."""
    positions = positions_of(subject.scenario.topology)
    quantities = _colour_quantities(subject)
    aspect = _figure_aspect(positions)
    across = 1 if aspect > MAX_BESIDE else len(quantities)
    down = len(quantities) // across
    size = (7.4, 1.4 + 6.6 / aspect * down) if across == 1 else (3.7 * across, 4.4)
    if len(quantities) == 1 and aspect <= MAX_BESIDE:
        size = (6.0, 5.2)
    figure = new_figure(size[0], min(max(size[1], 2.6), 12.0))
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, (label, shades) in zip(panels, quantities.items(), strict=True):
        draw_network(axes, subject, shades, label, positions)
    panels[0].legend(loc="upper left", bbox_to_anchor=(0.0, 0.0), ncols=2)
    finish_figure(
        figure, subject.claim(_make_claim(subject)), subject.caption(_explanation(subject))
    )
    return figure


def error_label(subject: Subject) -> tuple[str, str]:
    """Return the column of a summary that shows how well a node does, and its label."""
    if subject.shows_errors:
        return "rms_error", "RMS error, units of the state"
    return "mean_trace", "mean trace P, squared units of the state"


def shades_of(subject: Subject, key: str) -> dict[int, float]:
    """Return a column of the averages by node; nan if it is unknown."""
    values = ((row["node"], row.get(key)) for row in subject.rows)
    return {node: math.nan if value is None else float(value) for node, value in values}


def _colour_quantities(subject: Subject) -> dict[str, dict[int, float]]:
    """Return the quantities that may colour the nodes, by label and node."""
    key, label = error_label(subject)
    found = {label: shades_of(subject, key)}
    if subject.runs == 1 and any("sent" in row for row in subject.rows):
        size = _message_bytes(subject)
        found["messages sent, all hearers counted"] = shades_of(subject, "sent")
        sent = shades_of(subject, "transmissions")
        found["kilobytes transmitted"] = {n: v * size / 1000.0 for n, v in sent.items()}
    return found


def _message_bytes(subject: Subject) -> int:
    """Return the bytes of an estimate with its covariance, as float64."""
    n = subject.scenario.plant.n
    return 8 * (n + n * (n + 1) // 2)


def _explanation(subject: Subject) -> str:
    """Return the sentences on links and energy."""
    size = _message_bytes(subject)
    links = "Links are as wide as the messages that they delivered. " if subject.delivered else ""
    if len(subject.scenario.topology.links) > MAX_LINKS:
        links += f"{MAX_LINKS:,} links are drawn. "
    energy = (
        f"A transmission counts {size} bytes, an estimate with its covariance; a broadcast once."
    )
    return links + (energy if subject.runs == 1 else "")


def _make_claim(subject: Subject) -> str:
    """Return the claim of the figure: the worst and the best node."""
    key, _ = error_label(subject)
    shades = {n: v for n, v in shades_of(subject, key).items() if math.isfinite(v)}
    what = "RMS error" if subject.shows_errors else "mean trace of P"
    if not shades:
        return f"The {what} of the nodes is not known"
    worst, best = max(shades, key=lambda n: shades[n]), min(shades, key=lambda n: shades[n])
    if len(shades) == 1:
        return f"The only node, {worst}, has the {what} {shades[worst]:.3g}"
    claim = (
        f"Node {worst} has the largest {what}, {shades[worst]:.3g}, and node {best} the smallest"
    )
    return f"{claim}, {shades[best]:.3g}"


def _figure_aspect(positions: Positions) -> float:
    """Return the width of a network over its height, at least 1."""
    xy = np.array(list(positions.values()), dtype=np.float64)
    width, height = np.ptp(xy, axis=0) if len(xy) else (1.0, 1.0)
    return float(np.clip(width / height if height > 0.0 else 8.0, 1.0, 8.0))


def draw_network(
    axes: Any,
    subject: Subject,
    shades: Mapping[int, float],
    label: str,
    positions: Positions | None = None,
) -> None:
    """Draw the links as wide as they delivered, and the nodes in the colours of their ``shades``
    with a colour bar: squares with a sensor, circles without.
    """
    if positions is None:
        positions = positions_of(subject.scenario.topology)
    _draw_links(axes, subject, positions)
    dots = _draw_nodes(axes, subject, positions, shades)
    away = 1.0 + 0.5 * math.sqrt(_dot_size(subject))
    if len(subject.nodes) <= MAX_LABELLED_NODES:
        for node in subject.nodes:
            style: dict[str, Any] = {"fontsize": 6.5, "color": MUTED, "zorder": 3}
            offset: dict[str, Any] = {"xytext": (away, away), "textcoords": "offset points"}
            axes.annotate(str(node), positions[node], **offset, **style)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.13)
    axes.axis("off")
    if dots is not None:
        bar = axes.figure.colorbar(
            dots, ax=axes, location="bottom", shrink=0.8, aspect=30, pad=0.06, label=label
        )
        bar.outline.set_linewidth(0.5)
        bar.ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
        finite = {value for value in shades.values() if math.isfinite(value)}
        if len(finite) > 1:
            bar.ax.locator_params(nbins=5)
        else:  # all nodes are alike
            bar.set_ticks([*finite], labels=[f"{value:.4g}" for value in finite])


def _dot_size(subject: Subject) -> float:
    """Return the area of a node in square points."""
    return max(10.0, min(80.0, 3000.0 / len(subject.nodes)))


def _draw_links(axes: Any, subject: Subject, positions: Positions) -> None:
    """Draw links, as wide as the messages that they delivered."""
    pairs = sorted({(min(i, j), max(i, j)) for i, j in subject.scenario.topology.links})
    if len(pairs) > MAX_LINKS:
        pairs = [pairs[k] for k in np.linspace(0, len(pairs) - 1, MAX_LINKS).astype(int).tolist()]
    if not pairs:
        return
    counts = np.array([subject.delivered.get(pair, 0) for pair in pairs], dtype=float)
    axes.add_collection(
        LineCollection(
            [(positions[i], positions[j]) for i, j in pairs],
            linewidths=0.3 + 2.2 * counts / max(float(counts.max()), 1.0),
            colors=MUTED,
            alpha=0.45,
            zorder=1,
        )
    )


def _draw_nodes(
    axes: Any, subject: Subject, positions: Positions, shades: Mapping[int, float]
) -> Any:
    """Draw the nodes, white if their shade is unknown; return the mappable of the colour bar."""
    finite = [value for value in shades.values() if math.isfinite(value)]
    low, high = (min(finite), max(finite)) if finite else (0.0, 1.0)
    dots = None
    for sensing, marker, label in ((False, "o", "without a sensor"), (True, "s", "with a sensor")):
        nodes = [n for n, has in zip(subject.nodes, subject.sensing, strict=True) if has == sensing]
        if not nodes:
            continue
        xy = np.array([positions[n] for n in nodes])
        dots = axes.scatter(
            *xy.T,
            c=[shades.get(n, math.nan) for n in nodes],
            marker=marker,
            cmap=mpl.colormaps[SEQUENTIAL].with_extremes(bad="white"),
            vmin=low,
            vmax=high,
            s=_dot_size(subject),
            edgecolors=INK,
            linewidths=0.5,
            zorder=2,
            label=label,
            plotnonfinite=True,
        )
    return dots if finite else None
