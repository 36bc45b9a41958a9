"""The picture of a run. The only module that knows matplotlib."""

from __future__ import annotations

import math
from textwrap import fill
from typing import Any

import matplotlib as mpl
import networkx
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from netkf.linalg.arrays import FloatArray
from netkf.runs.files import written_beside
from netkf.runs.labels import by_design
from netkf.runs.run import CompletedRun
from netkf.runs.summary import CONFIDENCE, NO_COVARIANCE, Promise, nees_bounds
from netkf.scenario.scenario import Scenario

SENSING, RELAY, PROMISE, DARK = "#c1440e", "#3b6ea5", "#222222", "#555555"
MOST_LINES = 60
LONGEST_LEGEND = 72
NO_TRUTH = "no ground truth: errors are unavailable"


def run_picture(scenario: Scenario, finished: CompletedRun) -> None:
    """Write ``run.png``: errors, square roots of trace P over time against the bound and the
    limits, NEES, and the network with its link activity.
    """
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        rows = 3 if scenario.plant.shown else 2
        figure = Figure(figsize=(11.0, 1.0 + 2.7 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(rows, 2, width_ratios=[1.15, 1.0])
        _errors(figure.add_subplot(grid[0, 0]), scenario, finished)
        _covariances(figure.add_subplot(grid[1, 0]), scenario, finished)
        if scenario.plant.shown:
            samples = finished.samples
            draw_nees(
                figure.add_subplot(grid[2, 0]), np.array(samples.times), samples.nees, scenario
            )
        _network(figure, figure.add_subplot(grid[:, 1]), scenario, finished)
        title = scenario.name if not scenario.claim else f"{scenario.name}: {scenario.claim}"
        figure.suptitle(fill(title, 130), fontsize=10, x=0.01, ha="left")
        with written_beside(finished.directory / "run.png") as part:
            figure.savefig(part, dpi=130, format="png")


def evenly_spaced(places: np.ndarray) -> np.ndarray:
    """At most MOST_LINES of them."""
    if len(places) <= MOST_LINES:
        return places
    return np.asarray(places[np.linspace(0, len(places) - 1, MOST_LINES).astype(int)])


def draw_lines(axes: Any, times: FloatArray, values: FloatArray, scenario: Scenario) -> None:
    """A thin line a node, sensing nodes on top; at most MOST_LINES evenly chosen ones."""
    sensing = np.array([node in scenario.placed for node in scenario.nodes])
    for group, colour, order in ((~sensing, RELAY, 1), (sensing, SENSING, 2)):
        places = evenly_spaced(np.flatnonzero(group))
        segments = [np.column_stack([times, values[:, k]]) for k in places]
        width = 1.1 if len(scenario.nodes) <= 12 else 0.5
        axes.add_collection(
            LineCollection(segments, colors=colour, linewidths=width, alpha=0.6, zorder=order)
        )
    axes.autoscale()


def draw_legend(axes: Any) -> None:
    """Draw the legend of what has a label, beside the axes where it would hide curves."""
    labels = axes.get_legend_handles_labels()[1]
    if not labels:
        return
    axes.legend(
        frameon=False,
        fontsize=7.5,
        loc="lower left",
        bbox_to_anchor=(0.0, 0.98),
        ncols=4 if sum(map(len, labels)) < LONGEST_LEGEND else 2,
        columnspacing=1.2,
        handlelength=1.6,
        borderaxespad=0.2,
    )


def set_scale(axes: Any, values: FloatArray) -> None:
    """Logarithmic where the values span more than a factor of 100."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    if positive.size and positive.max() > 100.0 * np.median(positive):
        axes.set_yscale("log")
        axes.set_ylim(positive.min() * 0.7, positive.max() * 1.5)
    elif positive.size:
        axes.set_ylim(0.0, positive.max() * 1.06)


def _errors(axes: Any, scenario: Scenario, finished: CompletedRun) -> None:
    if not scenario.plant.shown:
        _estimates(axes, scenario, finished)
        return
    times = np.array(finished.samples.times)
    error = np.sqrt(np.array(finished.samples.sq_error))
    draw_lines(axes, times, error, scenario)
    axes.plot(
        times,
        np.sqrt((error**2).mean(axis=1)),
        color=PROMISE,
        lw=1.6,
        label="root mean square of all",
        zorder=3,
    )
    axes.plot([], [], color=SENSING, label="nodes with a sensor")
    axes.plot([], [], color=RELAY, label="nodes without")
    set_scale(axes, error)
    axes.set(ylabel="error |x - xhat|", xlabel="simulated seconds")
    draw_legend(axes)


def mark_unavailable(axes: Any, words: str) -> None:
    """A panel without data."""
    axes.text(0.0, 0.5, words, color=DARK)
    axes.axis("off")


def _estimates(axes: Any, scenario: Scenario, finished: CompletedRun) -> None:
    """Without a truth there are no errors, but nodes that agree or do not."""
    times, first = np.array(finished.samples.times), np.array(finished.samples.first)
    draw_lines(axes, times, first, scenario)
    axes.plot([], [], color=SENSING, label="nodes with a sensor")
    axes.plot([], [], color=RELAY, label="nodes without; no ground truth")
    axes.set(ylabel="estimate, first component", xlabel="simulated seconds")
    draw_legend(axes)


def _covariances(axes: Any, scenario: Scenario, finished: CompletedRun) -> None:
    if not finished.samples.covariance_given:
        mark_unavailable(axes, f"{NO_COVARIANCE}: trace P is unavailable")
        return
    times, promised = np.array(finished.samples.times), finished.promised
    root = np.sqrt(np.maximum(np.array(finished.samples.trace), 0.0))
    draw_lines(axes, times, root, scenario)
    draw_promises(axes, times, promised)
    shown = root if promised.bound is None else np.concatenate([root, np.sqrt(promised.bound)])
    set_scale(axes, shown)
    axes.set(ylabel="square root of trace P", xlabel="simulated seconds")
    draw_legend(axes)


def draw_nees(axes: Any, times: FloatArray, nees: Any, scenario: Scenario, runs: int = 1) -> None:
    """NEES of every node, (T, N), a mean over the runs, and where it lies when P is exact."""
    values = np.array(nees)
    if not np.isfinite(values).any():
        mark_unavailable(axes, "NEES is unavailable: it needs an error and a regular P")
        return
    draw_lines(axes, times, values, scenario)
    axes.plot(times, values.mean(axis=1), color=PROMISE, lw=1.6, label="mean of all", zorder=3)
    words = f"{CONFIDENCE:.0%} where P is exact"
    low, high = nees_bounds(scenario.plant.n, runs)
    axes.axhspan(low, high, color="#2e8b57", alpha=0.15, label=words)
    design = by_design(scenario)
    label = f"n = {scenario.plant.n}" + (f", P is {design} by design" if design else "")
    axes.axhline(scenario.plant.n, color="#2e8b57", lw=1.1, label=label)
    set_scale(axes, np.append(values, high))
    axes.set(ylabel="NEES" if runs == 1 else "mean NEES", xlabel="simulated seconds")
    draw_legend(axes)


def draw_promises(axes: Any, times: FloatArray, promised: Promise) -> None:
    """Draw the bound over time and the limits, as square roots of traces."""
    if promised.bound is not None:
        bound = np.sqrt(promised.bound)
        axes.plot(
            times,
            bound.max(axis=1),
            color=PROMISE,
            ls="--",
            lw=1.3,
            label="bound H(12): largest",
            zorder=3,
        )
        axes.plot(
            times,
            bound.min(axis=1),
            color=PROMISE,
            ls=":",
            lw=1.3,
            label="and smallest",
            zorder=3,
        )
    for value, words, style in (
        (promised.limit, promised.limit_words, "-."),
        (promised.central, "centralised filter", "-"),
    ):
        if math.isfinite(value):
            axes.axhline(math.sqrt(value), color="#2e8b57", ls=style, lw=1.1, label=words)


def _network(figure: Figure, axes: Any, scenario: Scenario, finished: CompletedRun) -> None:
    topology = scenario.topology
    places = topology.positions or _layout(scenario)
    delivered = finished.samples.delivered
    pairs = sorted({(min(i, j), max(i, j)) for i, j in topology.links})
    counts = np.array([delivered.get(pair, 0) for pair in pairs], dtype=float)
    if len(counts):
        share = counts / max(float(counts.max()), 1.0)
        axes.add_collection(
            LineCollection(
                [(places[i], places[j]) for i, j in pairs],
                linewidths=0.3 + 2.2 * share,
                colors=DARK,
                alpha=0.45,
                zorder=1,
            )
        )
    key = "rms_error" if scenario.plant.shown else "mean_trace"
    shade = {row["node"]: row[key] for row in finished.summary["nodes"]}
    for sensing, marker, words in ((False, "o", "relays"), (True, "s", "has a sensor")):
        nodes = [n for n in scenario.nodes if (n in scenario.placed) == sensing]
        if not nodes:
            continue
        xy = np.array([places[n] for n in nodes])
        values = [shade[n] for n in scenario.nodes if math.isfinite(shade[n])] or [0.0, 1.0]
        dots = axes.scatter(
            xy[:, 0],
            xy[:, 1],
            c=[shade[n] for n in nodes],
            marker=marker,
            cmap="viridis_r",
            vmin=min(values),
            vmax=max(values),
            s=max(12.0, min(90.0, 4000.0 / len(scenario.nodes))),
            edgecolors=PROMISE,
            linewidths=0.5,
            zorder=2,
            label=words,
        )
    if len(scenario.nodes) <= 60:
        for node in scenario.nodes:
            axes.annotate(
                str(node),
                places[node],
                xytext=(4, 4),
                textcoords="offset points",
                fontsize=7,
                color=DARK,
                zorder=3,
            )
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.axis("off")
    axes.legend(frameon=False, fontsize=8, loc="lower center", ncols=2, bbox_to_anchor=(0.5, -0.04))
    total = finished.summary["messages"]
    words = f"{total['sent']:,} messages"
    if total["transmissions"] < total["sent"]:
        words += f" in {total['transmissions']:,} transmissions"
    words = f"links as wide as they delivered; {words}, {total['lost']:,} lost"
    axes.set_title(words, fontsize=9)
    label = "RMS error" if scenario.plant.shown else "mean trace P"
    figure.colorbar(dots, ax=axes, shrink=0.5, label=label, pad=0.01)


def _layout(scenario: Scenario) -> dict[int, tuple[float, float]]:
    topology = scenario.topology
    graph: networkx.Graph[int] = networkx.Graph()
    graph.add_nodes_from(topology.nodes)  # in their order, which is that around a circle
    graph.add_edges_from(topology.links)
    degrees = set(topology.degrees.values())
    if len(topology.nodes) <= 30 and degrees <= {0, 2}:
        placed: dict[int, Any] = networkx.circular_layout(graph)
    elif len(topology.nodes) <= 150:
        placed = networkx.kamada_kawai_layout(graph)
    else:
        placed = networkx.spring_layout(graph, seed=0, iterations=30)
    return {node: (float(x), float(y)) for node, (x, y) in placed.items()}
