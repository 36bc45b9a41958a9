"""The picture of a run, and the panels that it shares with the picture of an ensemble."""

from __future__ import annotations

import math
from textwrap import fill
from typing import Any

import matplotlib as mpl
import networkx
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Topology
from netkf.runs.files import write_atomically
from netkf.runs.labels import covariance_bias
from netkf.runs.run import CompletedRun
from netkf.runs.summary import CONFIDENCE, NO_COVARIANCE, PromisedTraces, nees_bounds
from netkf.scenario.scenario import Scenario

SENSING, RELAY, PROMISE, DARK, EXACT = "#c1440e", "#3b6ea5", "#222222", "#555555", "#2e8b57"
MAX_LINES = 60
"""Curves of single nodes in one panel; of larger networks an even selection is drawn."""
MAX_LINKS, MAX_KAMADA_KAWAI, PIVOTS = 20_000, 150, 50
MAX_LABELLED_NODES = 60
LONGEST_LEGEND = 72
"""Characters of a legend that fit in one row."""
NO_TRUTH = "no ground truth: errors are unavailable"
Positions = dict[int, tuple[float, float]]


def run_picture(scenario: Scenario, completed: CompletedRun) -> None:
    """Write ``run.png``: errors, square roots of trace P over time beside the bound and the limits,
    NEES, and the network with the activity of its links.
    """
    with mpl.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        rows = 3 if scenario.plant.truth_known else 2
        figure = Figure(figsize=(11.0, 1.0 + 2.7 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(rows, 2, width_ratios=[1.15, 1.0])
        draw_above = _draw_errors if scenario.plant.truth_known else _draw_estimates
        draw_above(figure.add_subplot(grid[0, 0]), scenario, completed)
        _draw_covariances(figure.add_subplot(grid[1, 0]), scenario, completed)
        if scenario.plant.truth_known:
            samples = completed.samples
            axes = figure.add_subplot(grid[2, 0])
            draw_nees(axes, np.array(samples.times), samples.nees, scenario)
        _draw_network(figure, figure.add_subplot(grid[:, 1]), scenario, completed)
        title = scenario.name if not scenario.claim else f"{scenario.name}: {scenario.claim}"
        figure.suptitle(fill(title, 130), fontsize=10, x=0.01, ha="left")
        with write_atomically(completed.directory / "run.png") as part:
            figure.savefig(part, dpi=130, format="png")


def select_evenly(indices: np.ndarray) -> np.ndarray:
    """Return at most MAX_LINES of the indices, evenly spaced."""
    if len(indices) <= MAX_LINES:
        return indices
    return np.asarray(indices[np.linspace(0, len(indices) - 1, MAX_LINES).astype(int)])


def draw_lines(axes: Any, times: FloatArray, values: FloatArray, scenario: Scenario) -> None:
    """Draw the columns of ``values`` (T, N) over ``times`` (T,), sensing nodes on top."""
    sensing = np.array([node in scenario.placed for node in scenario.nodes])
    width = 1.1 if len(scenario.nodes) <= 12 else 0.5
    for group, colour, order in ((~sensing, RELAY, 1), (sensing, SENSING, 2)):
        indices = select_evenly(np.flatnonzero(group))
        # One collection is far faster than a line for each node.
        lines = LineCollection(
            [np.column_stack([times, values[:, k]]) for k in indices],
            colors=colour,
            linewidths=width,
            alpha=0.6,
            zorder=order,
        )
        axes.add_collection(lines)
    axes.autoscale()


def draw_legend(axes: Any) -> None:
    """Draw the legend of all labelled curves above the axes, where it hides none of them."""
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
    """Choose a logarithmic scale if the largest value is more than 100 times the median."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    if positive.size and positive.max() > 100.0 * np.median(positive):
        axes.set_yscale("log")
        axes.set_ylim(positive.min() * 0.7, positive.max() * 1.5)
    elif positive.size:
        axes.set_ylim(0.0, positive.max() * 1.06)


def mark_unavailable(axes: Any, message: str) -> None:
    """Replace a panel without data by a message."""
    axes.text(0.0, 0.5, message, color=DARK)
    axes.axis("off")


def _draw_errors(axes: Any, scenario: Scenario, completed: CompletedRun) -> None:
    times = np.array(completed.samples.times)
    error = np.sqrt(np.array(completed.samples.sq_error))
    draw_lines(axes, times, error, scenario)
    rms = np.sqrt((error**2).mean(axis=1))
    axes.plot(times, rms, color=PROMISE, lw=1.6, label="root mean square of all", zorder=3)
    axes.plot([], [], color=SENSING, label="nodes with a sensor")
    axes.plot([], [], color=RELAY, label="nodes without")
    set_scale(axes, error)
    axes.set(ylabel="error |x - xhat|", xlabel="simulated seconds")
    draw_legend(axes)


def _draw_estimates(axes: Any, scenario: Scenario, completed: CompletedRun) -> None:
    """Draw estimates instead of errors: without ground truth only agreement can be seen."""
    times, first = np.array(completed.samples.times), np.array(completed.samples.first)
    draw_lines(axes, times, first, scenario)
    axes.plot([], [], color=SENSING, label="nodes with a sensor")
    axes.plot([], [], color=RELAY, label="nodes without; no ground truth")
    axes.set(ylabel="estimate, first component", xlabel="simulated seconds")
    draw_legend(axes)


def _draw_covariances(axes: Any, scenario: Scenario, completed: CompletedRun) -> None:
    if not completed.samples.covariance_given:
        mark_unavailable(axes, f"{NO_COVARIANCE}: trace P is unavailable")
        return
    times, promised = np.array(completed.samples.times), completed.promised
    root = np.sqrt(np.maximum(np.array(completed.samples.trace), 0.0))
    draw_lines(axes, times, root, scenario)
    draw_promises(axes, times, promised)
    shown = root if promised.bound is None else np.concatenate([root, np.sqrt(promised.bound)])
    set_scale(axes, shown)
    axes.set(ylabel="square root of trace P", xlabel="simulated seconds")
    draw_legend(axes)


def draw_nees(axes: Any, times: FloatArray, nees: Any, scenario: Scenario, runs: int = 1) -> None:
    """Draw NEES (T, N), a mean over ``runs`` runs, and the interval that holds it if P is exact."""
    values = np.array(nees)
    if not np.isfinite(values).any():
        mark_unavailable(axes, "NEES is unavailable: it needs an error and a regular P")
        return
    draw_lines(axes, times, values, scenario)
    axes.plot(times, values.mean(axis=1), color=PROMISE, lw=1.6, label="mean of all", zorder=3)
    low, high = nees_bounds(scenario.plant.n, runs)
    axes.axhspan(low, high, color=EXACT, alpha=0.15, label=f"{CONFIDENCE:.0%} where P is exact")
    design = covariance_bias(scenario)
    label = f"n = {scenario.plant.n}" + (f", P is {design} by design" if design else "")
    axes.axhline(scenario.plant.n, color=EXACT, lw=1.1, label=label)
    set_scale(axes, np.append(values, high))
    axes.set(ylabel="NEES" if runs == 1 else "mean NEES", xlabel="simulated seconds")
    draw_legend(axes)


def draw_promises(axes: Any, times: FloatArray, promised: PromisedTraces) -> None:
    """Draw the bound over ``times`` (T,) and the limits, as square roots of traces."""
    if promised.bound is not None:
        bound = np.sqrt(promised.bound)
        look = {"color": PROMISE, "lw": 1.3, "zorder": 3}
        axes.plot(times, bound.max(axis=1), ls="--", label="bound H(12): largest", **look)
        axes.plot(times, bound.min(axis=1), ls=":", label="and smallest", **look)
    for value, label, style in (
        (promised.limit, promised.limit_label, "-."),
        (promised.central, "centralised filter", "-"),
    ):
        if math.isfinite(value):
            axes.axhline(math.sqrt(value), color=EXACT, ls=style, lw=1.1, label=label)


def _draw_network(figure: Figure, axes: Any, scenario: Scenario, completed: CompletedRun) -> None:
    """Draw nodes coloured by their error (trace of P without ground truth), and links."""
    positions = scenario.topology.positions or _layout(scenario)
    _draw_links(axes, scenario, positions, completed.samples.delivered)
    key = "rms_error" if scenario.plant.truth_known else "mean_trace"
    shades = {row["node"]: row[key] for row in completed.summary["nodes"]}
    dots = _draw_nodes(axes, scenario, positions, shades)
    if len(scenario.nodes) <= MAX_LABELLED_NODES:
        for node in scenario.nodes:
            style = {"fontsize": 7, "color": DARK, "zorder": 3}
            offset = {"xytext": (4, 4), "textcoords": "offset points"}
            axes.annotate(str(node), positions[node], **offset, **style)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.axis("off")
    axes.legend(frameon=False, fontsize=8, loc="lower center", ncols=2, bbox_to_anchor=(0.5, -0.04))
    axes.set_title(_network_title(scenario, completed.summary["messages"]), fontsize=9)
    label = "RMS error" if scenario.plant.truth_known else "mean trace P"
    figure.colorbar(dots, ax=axes, shrink=0.5, label=label, pad=0.01)


def _draw_links(
    axes: Any, scenario: Scenario, positions: Positions, delivered: dict[tuple[int, int], int]
) -> None:
    """Draw each link as wide as the number of messages that it delivered."""
    pairs = _spread(sorted({(min(i, j), max(i, j)) for i, j in scenario.topology.links}))
    if not pairs:
        return
    counts = np.array([delivered.get(pair, 0) for pair in pairs], dtype=float)
    lines = LineCollection(
        [(positions[i], positions[j]) for i, j in pairs],
        linewidths=0.3 + 2.2 * counts / max(float(counts.max()), 1.0),
        colors=DARK,
        alpha=0.45,
        zorder=1,
    )
    axes.add_collection(lines)


def _spread(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return at most MAX_LINKS of the pairs, evenly chosen."""
    if len(pairs) <= MAX_LINKS:
        return pairs
    return [pairs[k] for k in np.linspace(0, len(pairs) - 1, MAX_LINKS).astype(int).tolist()]


def _draw_nodes(
    axes: Any, scenario: Scenario, positions: Positions, shades: dict[int, float]
) -> Any:
    """Draw the nodes, squares with a sensor and circles without; return what a colour bar needs."""
    finite = [value for value in shades.values() if math.isfinite(value)] or [0.0, 1.0]
    dots = None
    for sensing, marker, label in ((False, "o", "relays"), (True, "s", "has a sensor")):
        nodes = [n for n in scenario.nodes if (n in scenario.placed) == sensing]
        if not nodes:
            continue
        xy = np.array([positions[n] for n in nodes])
        dots = axes.scatter(
            xy[:, 0],
            xy[:, 1],
            c=[shades[n] for n in nodes],
            marker=marker,
            cmap="viridis_r",
            vmin=min(finite),
            vmax=max(finite),
            s=max(12.0, min(90.0, 4000.0 / len(scenario.nodes))),
            edgecolors=PROMISE,
            linewidths=0.5,
            zorder=2,
            label=label,
        )
    return dots


def _network_title(scenario: Scenario, messages: dict[str, Any]) -> str:
    sent = f"{messages['sent']:,} messages"
    if messages["transmissions"] < messages["sent"]:
        sent += f" in {messages['transmissions']:,} transmissions"
    links = "links" if len(scenario.topology.links) <= MAX_LINKS else f"{MAX_LINKS:,} links"
    return f"{links} as wide as they delivered; {sent}, {messages['lost']:,} lost"


def _layout(scenario: Scenario) -> Positions:
    """Return positions of the nodes for a topology that has none of its own."""
    topology = scenario.topology
    if len(topology.nodes) > MAX_KAMADA_KAWAI:  # it needs the paths between all pairs of nodes
        return _pivot_layout(topology)
    graph: networkx.Graph[int] = networkx.Graph()
    graph.add_nodes_from(topology.nodes)  # in their order, which is that around a circle
    graph.add_edges_from(topology.links)
    degrees = set(topology.degrees.values())
    if len(topology.nodes) <= 30 and degrees <= {0, 2}:
        placed: dict[int, Any] = networkx.circular_layout(graph)
    else:
        placed = networkx.kamada_kawai_layout(graph)
    return {node: (float(x), float(y)) for node, (x, y) in placed.items()}


def _pivot_layout(topology: Topology) -> Positions:
    """Return the two principal axes of the distances to a few nodes (Pivot MDS: Brandes and Pich,
    Graph Drawing 2006), which takes one search of the network per pivot.
    """
    pairs = [(topology.index[i], topology.index[j]) for i, j in topology.links]
    ends = np.array(pairs, dtype=np.int32)  # the only indices that scipy 1.13 searches graphs with
    size, (rows, columns) = len(topology.nodes), ends.reshape(-1, 2).T
    adjacency = scipy.sparse.csr_array((np.ones(len(ends)), (rows, columns)), shape=(size, size))
    pivots = np.linspace(0, size - 1, PIVOTS).astype(int)
    distances = scipy.sparse.csgraph.dijkstra(
        adjacency, directed=False, unweighted=True, indices=pivots
    )
    reached = np.isfinite(distances)
    distances[~reached] = 1.5 * max(float(distances[reached].max()), 1.0)
    squares = distances.T**2
    centred = squares - squares.mean(axis=0) - squares.mean(axis=1)[:, None] + squares.mean()
    _, axes = np.linalg.eigh(centred.T @ centred)
    xy = centred @ axes[:, :-3:-1]
    xy = xy / max(float(np.abs(xy).max()), 1e-300)
    return {node: (float(x), float(y)) for node, (x, y) in zip(topology.nodes, xy, strict=True)}
