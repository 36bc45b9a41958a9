"""The figures ``network``, nodes coloured by their errors and by the messages that they sent, and
``plane``, paths of nodes whose plants say their coordinates, and their estimates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, MaxNLocator

from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.layout import Positions, get_positions
from netkf.figures.names import SERIES
from netkf.figures.style import (
    INK,
    MUTED,
    SEQUENTIAL,
    Picture,
    draw_legend,
    finish_figure,
    label_text,
    new_figure,
)
from netkf.linalg.arrays import FloatArray
from netkf.plants.blocks import Block
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

MAX_LINKS = 20_000
MAX_LABELLED_NODES = 60
MAX_ASPECT = 2.2
"""Ratio of width to height above which the panels of a network are drawn below each other."""


def network_figure(data: FigureData) -> Picture:
    """Draw the network once for each known quantity of the nodes, which their colours show."""
    positions = get_positions(data.scenario, data.run)
    quantities = _colour_quantities(data)
    xy = np.array(list(positions.values()), dtype=np.float64)
    # Ratio of width to height.
    spread = np.ptp(xy, axis=0) if len(xy) else (1.0, 1.0)
    aspect = float(np.clip(spread[0] / spread[1] if spread[1] > 0.0 else 8.0, 1.0, 8.0))
    is_wide = aspect > MAX_ASPECT
    columns = 1 if is_wide else len(quantities)
    rows = len(quantities) // columns
    if len(quantities) == 1 and not is_wide:
        width, height = 6.0, 5.2
    elif columns == 1:
        width, height = 7.4, 1.4 + 6.6 / aspect * rows
    else:
        width, height = 3.7 * columns, 4.4
    figure = new_figure(width, min(max(height, 2.6), 12.0))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (label, values) in zip(panels, quantities.items(), strict=True):
        draw_network(axes, data, values, label, positions)
    # Below the names of the lowest nodes, which may hang over the rim of the panel.
    panels[0].legend(loc="upper left", bbox_to_anchor=(0.0, 0.0), ncols=2, borderaxespad=1.8)
    return finish_figure(
        figure, data.title(_make_headline(data)), data.caption(*explain_network(data))
    )


def error_label(data: FigureData) -> tuple[str, str]:
    """Return the key and the label of the nodes' errors, or of trace P without ground truth."""
    if data.shows_errors:
        return "rms_error", f"RMS error, {data.unit}"
    return "mean_trace", f"mean trace P, squared {data.unit}"


def node_values(data: FigureData, key: str) -> dict[int, float]:
    """Return the entry ``key`` of the averages of each node, nan if it is unknown."""
    values = ((row["node"], row.get(key)) for row in data.node_averages)
    return {node: math.nan if value is None else float(value) for node, value in values}


def _colour_quantities(data: FigureData) -> dict[str, dict[int, float]]:
    key, label = error_label(data)
    quantities = {label: node_values(data, key)}
    if data.runs == 1 and any("sent" in row for row in data.node_averages):
        quantities["messages sent, all hearers counted"] = node_values(data, "sent")
        sizes = node_values(data, "bytes")
        if not all(map(math.isnan, sizes.values())):  # the scenario may not ask for them
            label = "kilobytes transmitted, broadcasts once"
            quantities[label] = {node: size / 1000.0 for node, size in sizes.items()}
    return quantities


def explain_network(data: FigureData) -> list[str]:
    """Return sentences on what a network that is drawn shows."""
    sentences = []
    if data.delivered:
        sentences.append("Links are as wide as the messages that they delivered.")
    if data.scenario.positions.moving:
        sentences.append("Nodes are where they begin.")
    if len(data.scenario.topology.links) > MAX_LINKS:
        sentences.append(f"{MAX_LINKS:,} links are drawn.")
    return sentences


def _make_headline(data: FigureData) -> str:
    key, _ = error_label(data)
    values = {n: v for n, v in node_values(data, key).items() if math.isfinite(v)}
    quantity = "RMS error" if data.shows_errors else "mean trace of P"
    if not values:
        return f"The {quantity} of the nodes is not known"
    worst, best = max(values, key=lambda n: values[n]), min(values, key=lambda n: values[n])
    if len(values) == 1:
        return f"The only node, {worst}, has the {quantity} {values[worst]:.3g}"
    return (
        f"Node {worst} has the largest {quantity}, {values[worst]:.3g}, "
        f"and node {best} the smallest, {values[best]:.3g}"
    )


def draw_network(
    axes: Any,
    data: FigureData,
    values: Mapping[int, float],
    label: str,
    positions: Positions | None = None,
) -> None:
    """Draw links by what they delivered, and nodes by ``values`` (squares: with a sensor)."""
    if positions is None:
        positions = get_positions(data.scenario, data.run)
    _draw_links(axes, data, positions)
    dots = _draw_nodes(axes, data, positions, values)
    # Labels are placed, in points, just outside the marker, whose side or diameter is sqrt(area),
    # at the rim of the network on the side away from its middle, where no links are.
    distance = 1.0 + 0.5 * math.sqrt(_dot_area(data))
    middle = [sum(axis) / len(positions) for axis in zip(*positions.values(), strict=True)]
    rim = 0.9 * max(math.dist(place, middle) for place in positions.values())
    for node in data.nodes if len(data.nodes) <= MAX_LABELLED_NODES else ():
        at_rim = math.dist(positions[node], middle) >= rim
        left, below = (
            at_rim and p < m - 1e-9 for p, m in zip(positions[node], middle, strict=True)
        )
        style: dict[str, Any] = {"fontsize": 6.5, "color": INK, "zorder": 3}
        style["path_effects"] = [withStroke(linewidth=1.5, foreground="white", alpha=0.8)]
        style |= {"ha": "right" if left else "left", "va": "top" if below else "baseline"}
        offset = (-distance if left else distance, -distance if below else distance)
        axes.annotate(
            label_text(node), positions[node], offset, textcoords="offset points", **style
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.13)
    axes.axis("off")
    if dots is not None:
        bar = axes.figure.colorbar(
            dots, ax=axes, location="bottom", shrink=0.8, aspect=30, pad=0.06, label=label
        )
        bar.outline.set_linewidth(0.5)
        bar.ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
        finite = {value for value in values.values() if math.isfinite(value)}
        if len(finite) > 1:
            whole = all(map(float.is_integer, finite))
            bar.ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10], integer=whole))
        else:  # a scale without length has one tick
            bar.set_ticks([*finite], labels=[f"{value:.4g}" for value in finite])


def _dot_area(data: FigureData) -> float:
    """Return a node's marker area in square points, smaller in large networks."""
    return max(10.0, min(80.0, 3000.0 / len(data.nodes)))


def _draw_links(axes: Any, data: FigureData, positions: Positions) -> None:
    pairs = sorted({(min(i, j), max(i, j)) for i, j in data.scenario.topology.links})
    if len(pairs) > MAX_LINKS:
        pairs = [pairs[k] for k in np.linspace(0, len(pairs) - 1, MAX_LINKS).astype(int).tolist()]
    if not pairs:
        return
    counts = np.array([data.delivered.get(pair, 0) for pair in pairs], dtype=float)
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
    axes: Any, data: FigureData, positions: Positions, values: Mapping[int, float]
) -> Any:
    """Draw the nodes by ``values``, white where nan; return what the colour bar shows, or None."""
    finite = [value for value in values.values() if math.isfinite(value)]
    # Of both groups: a bar widens the scale of what it shows where all values are one.
    scale = mpl.colors.Normalize(*((min(finite), max(finite)) if finite else (0.0, 1.0)))
    dots = None
    for group, marker, label in (
        (~data.has_sensor, "o", "without a sensor"),
        (data.has_sensor, "s", "with a sensor"),
    ):
        nodes = [data.nodes[k] for k in np.flatnonzero(group)]
        if not nodes:
            continue
        xy = np.array([positions[n] for n in nodes])
        dots = axes.scatter(
            *xy.T,
            c=[values.get(n, math.nan) for n in nodes],
            marker=marker,
            cmap=mpl.colormaps[SEQUENTIAL].with_extremes(bad="white"),
            norm=scale,
            s=_dot_area(data),
            edgecolors=INK,
            linewidths=0.5,
            zorder=2,
            plotnonfinite=True,
            clip_on=False,  # an equal aspect may leave a marker at the rim no room
        )
        # The legend is about shapes: a colour in it would be that of the first node.
        legend: dict[str, Any] = {"mfc": "white", "mec": INK, "mew": 0.5, "label": label}
        axes.plot([], [], marker, ms=math.sqrt(_dot_area(data)), **legend)
    return dots if finite else None


LEVEL = 0.95
SQUARE = -2.0 * math.log(1.0 - LEVEL)
"""Squared distance, in units of P, within which a share LEVEL of plane Gaussian errors is."""
ELLIPSES = 6  # of each node
_ANGLES = np.linspace(0.0, 2.0 * math.pi, 60)
CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


class _Path(NamedTuple):
    """True positions x and the node's own estimates xhat (T, 2), and their P (T, 2, 2)."""

    node: int
    x: FloatArray
    xhat: FloatArray
    P: FloatArray


def plane_figure(data: FigureData) -> Picture:
    """Draw the path of each node and its estimate of it, with ellipses of P at some instants."""
    if data.run is None:
        reason = "Only single runs have paths: draw one of them, netkf.open(DIR).replica(0)."
        raise UnavailableError(reason)
    data.require_samples()
    paths = _paths(data.run)
    if not paths:
        reason = "No node estimates coordinates of its own: those that a plant of [[plants]] names"
        raise UnavailableError(f"{reason} by position = [0, 1].")
    names = landmark_names(data.scenario)
    landmarks = np.reshape([*names], (-1, 2))
    points = np.concatenate([*(path.xhat for path in paths), landmarks])
    width, height = np.ptp(points[np.isfinite(points).all(axis=1)], axis=0)
    # Of one scale along both axes.
    figure = new_figure(6.6, 1.7 + float(np.clip(5.9 * height / max(width, 1e-9), 2.5, 7.0)))
    axes: Any = figure.subplots()
    label = "landmark" if len(landmarks) else ""
    axes.scatter(*landmarks.T, marker="+", s=45, linewidths=1.2, color=INK, zorder=4, label=label)
    for place, name in list(names.items())[:MAX_LABELLED_NODES]:
        axes.annotate(
            label_text(name), place, (3, 3), textcoords="offset points", fontsize=6, color=MUTED
        )
    labels = ["true path", "estimate of the node", f"{LEVEL:.0%} of errors, by P"]
    for k, path in enumerate(paths):
        _draw_path(axes, path, SERIES[k % len(SERIES)].colour, labels if k == 0 else [""] * 3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    xlabel, ylabel = (_axis_label(data.scenario, d) for d in (0, 1))
    axes.set(xlabel=xlabel, ylabel=ylabel)
    draw_legend(axes, 2)
    return finish_figure(
        figure, data.title(_headline(data, paths)), data.caption(_coverage(data, paths))
    )


def _placed_blocks(scenario: Scenario) -> list[tuple[Block, list[int]]]:
    """Return the blocks that say where their nodes are in the plane, and the entries that do."""
    return [(b, [*b.position]) for b in scenario.plants if b.position and len(b.position) == 2]


def _axis_label(scenario: Scenario, d: int) -> str:
    """Return the name and unit of coordinate ``d``, where all blocks agree on them."""
    labels = {block.plant.labels[entries[d]] for block, entries in _placed_blocks(scenario)}
    label = label_text(labels.pop() if len(labels) == 1 else "", 40)
    number = "second coordinate" if d else "first coordinate"
    return f"{number} {label}".strip() if label[:1] in ("", "(") else label


def _paths(run: Run) -> list[_Path]:
    scenario, paths = run.scenario, []
    for block, chosen in _placed_blocks(scenario):
        for node in block.nodes or ():
            own = scenario.estimated[scenario.topology.index[node]]
            if any((one.name, one.node) == (block.name, node) for one in own):
                pose = run.block(block.name, node)
                xy = pose.x[:, chosen], pose.xhat[:, chosen]
                paths.append(_Path(node, *xy, pose.P[:, chosen][:, :, chosen]))
    return paths


def landmark_names(scenario: Any) -> dict[tuple[float, float], str]:
    """Return the names, by place, of what robots look at: the ids in tables of readings, if any."""
    names = {}
    for sensor in scenario.sensors:
        if getattr(sensor, "heading", None) is not None and not isinstance(sensor.positions, str):
            has_ids = sensor.record is not None and sensor.record.has_anchors
            for k, place in zip(sensor.places, np.asarray(sensor.positions).tolist(), strict=True):
                names[tuple(place)] = str(k) if has_ids else ""
    return names


def _draw_path(axes: Any, path: _Path, colour: str, labels: Sequence[str]) -> None:
    true, estimate, ellipse = labels
    axes.plot(*path.x.T, color=colour, linewidth=1.2, label=true)
    dotted = {"linestyle": (0, (1, 1.4)), "linewidth": 1.2}
    axes.plot(*path.xhat.T, color=colour, **dotted, zorder=3, label=estimate)
    for k in np.unique(np.linspace(0, len(path.xhat) - 1, ELLIPSES).astype(int)):
        sizes, directions = np.linalg.eigh(np.nan_to_num(path.P[k]))
        ring = CIRCLE * np.sqrt(SQUARE * np.maximum(sizes, 0.0)) @ directions.T
        axes.fill(*(path.xhat[k] + ring).T, color=colour, alpha=0.25, linewidth=0.6, label=ellipse)
        ellipse = ""
    end = path.xhat[-1]
    axes.scatter(*end, s=90, color="white", edgecolors=colour, zorder=5)
    axes.text(*end, str(path.node), fontsize=6.5, ha="center", va="center", zorder=6)


def _headline(data: FigureData, paths: list[_Path]) -> str:
    if not data.shows_errors:
        return "Where nodes believe to be"
    known = [p for p in paths if np.isfinite(p.x).all(axis=1).any()]
    errors = {p.node: math.sqrt(np.nanmean(np.sum((p.x - p.xhat) ** 2, axis=1))) for p in known}
    if not errors:
        return "Where nodes believe to be"
    worst, best = max(errors, key=lambda k: errors[k]), min(errors, key=lambda k: errors[k])
    best_text = f"{errors[best]:.3g} (node {best}) to " if len(errors) > 1 else ""
    return f"RMS error of positions: {best_text}{errors[worst]:.3g} (node {worst})"


def _coverage(data: FigureData, paths: list[_Path]) -> str:
    if not data.shows_errors:
        return ""
    squares = [
        e @ np.linalg.pinv(P, hermitian=True) @ e
        for path in paths
        for e, P in zip((path.x - path.xhat)[1:], path.P[1:], strict=True)
        if np.isfinite(P).all() and np.isfinite(e).all()
    ]
    if not squares:
        return ""
    inside = np.mean(np.array(squares) <= SQUARE)
    return f"{inside:.0%} of the sampled positions are where P says that {LEVEL:.0%} are."
