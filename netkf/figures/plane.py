"""The figure ``plane``: paths of nodes whose plants say their coordinates, and their estimates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.figures.figure_data import FigureData, UnavailableError
from netkf.figures.names import SERIES
from netkf.figures.network import MAX_LABELLED_NODES
from netkf.figures.style import INK, MUTED, Picture, finish_figure, label_text, new_figure
from netkf.linalg.arrays import FloatArray
from netkf.plants.blocks import Block
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

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
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
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
