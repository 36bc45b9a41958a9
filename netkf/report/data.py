"""What the live part of a page knows of a run: columns of numbers, thinned by a stated rule."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import networkx
import numpy as np
import scipy.special

from netkf.report.directories import Opened
from netkf.report.innovations import innovation_columns
from netkf.report.messages import (
    Kept,
    information_age,
    keep_messages,
    traffic,
)
from netkf.report.packing import Packer
from netkf.report.worst import Worst
from netkf.runs.innovations import Innovations
from netkf.runs.stored import StoredRun
from netkf.runs.summary import nees_bounds
from netkf.trace.schema import CODES

BINS = 60
"""Parts of a run over which traffic is counted."""
MAX_KAMADA_KAWAI = 150
"""Nodes up to which links are drawn about equally long; above, a spring layout is faster."""
MAX_LINKS = 20_000
MAX_MARKS = 5_000
MARKS = ("stop", "crash", "restart", "diverged", "swap")
"""Events of nodes that views mark beside samples and messages."""
ELLIPSE_LEVEL = 0.95  # probability within the ellipses and intervals that are drawn


class Budget(NamedTuple):
    """The most messages and sample values (numbers) of one run that a page holds."""

    messages: int
    values: int

    def halve(self) -> Budget:
        """Return half of it."""
        return Budget(self.messages // 2, self.values // 2)


def run_data(
    source: Opened,
    run: StoredRun,
    messages: np.ndarray,
    readings: Innovations | str | None,
    budget: Budget,
    packer: Packer,
) -> dict[str, Any]:
    """Return what the views show of the trace of a source with these MESSAGE rows and innovations
    of its ``readings``; columns go to ``packer``.
    """
    worst = None if source.worst is None else source.worst.explained
    horizon = float(source.scenario.horizon)
    instant = worst.time if worst is not None else horizon
    times = sample_indices(run, budget.values, instant)
    kept = keep_messages(messages, budget.messages, instant)
    return {
        "label": source.label,
        "name": source.scenario.name,
        "status": source.status,
        "replica": run.replica,
        "horizon": horizon,
        "truth": run.truth_known,
        "broadcasts": _is_broadcast(run),
        "n": run.x.shape[1],
        "nodes": list(run.nodes),
        "sensors": [node for node in run.nodes if node in source.scenario.placed_sensors],
        "positions": positions(source, run),
        "knowledge": source.knowledge,
        "flow": _flow_kind(source),
        "continuous": sorted(source.scenario.increment_sensors),
        "period": source.period,
        "axes": _state_axes(source, run, worst),
        "links": [list(pair) for pair in source.scenario.topology.directions[:MAX_LINKS]],
        "worst": _worst_data(worst),
        "scale": _interval_scales(),
        "samples": _sample_columns(source, run, times, messages, packer),
        "messages": _message_columns(kept, run, packer),
        "senses": _event_columns(run, ("sense",), budget.messages // 2, packer),
        "marks": _event_columns(run, MARKS, MAX_MARKS, packer),
        "innovations": innovation_columns(readings, run.nodes, budget.messages // 4, packer),
        "traffic": traffic(messages, horizon, BINS),
        "totals": {
            "events": len(run.log),
            "messages": len(messages),
            "samples": len(run.times),
            "links": len(source.scenario.topology.directions),
        },
        "limits": _drawing_limits(source),
    }


def thinning_rules(data: dict[str, Any]) -> list[str]:
    """Return sentences on the parts of a run that the page leaves out, if any."""
    rules = []
    messages, totals = data["messages"], data["totals"]
    if messages["step"] > 1:
        rules.append(
            f"of {totals['messages']:,} messages the page holds {messages['count']:,}: all sent "
            f"from {messages['start']:.6g} to {messages['end']:.6g} s, and outside of that every "
            f"{messages['step']}th of each directed link by its number. Totals, traffic and ages "
            "of information are of all messages"
        )
    if data["samples"]["step"] > 1:
        rules.append(
            f"of {totals['samples']:,} sample times the page holds {data['samples']['count']:,}: "
            f"every {data['samples']['step']}th, the last, and the worst instant of each node. "
            "Averages are of all samples"
        )
    if totals["links"] > len(data["links"]):
        rules.append(
            f"of {totals['links']:,} directed links the first {len(data['links']):,} are drawn"
        )
    for name, label in (
        ("senses", "sensor readings"),
        ("marks", "other events of nodes"),
        ("innovations", "innovations"),
    ):
        part = data[name]
        if part is not None and part["step"] > 1:
            rules.append(f"of {part['total']:,} {label} the page holds every {part['step']}th")
    return rules


def sample_indices(run: StoredRun, values: int, instant: float) -> np.ndarray:
    """Return the indices of the samples to keep, so that there are at most about ``values``
    numbers: every k-th, the last one, that at ``instant``, and the worst instant of each node.
    """
    n, count = run.x.shape[1], len(run.nodes)
    each = count * (n + n * (n + 1) // 2 + 4) + n + 1
    most = max(2, values // max(1, each))
    total = len(run.times)
    if total <= most:
        return np.arange(total)
    step = -(-total // max(1, most - 1))
    at_instant = min(int(np.searchsorted(run.times, instant)), total - 1)
    chosen = {*range(0, total, step), at_instant, total - 1}
    if run.truth_known:
        error = np.where(np.isfinite(run.sq_error), run.sq_error, -1.0)
        chosen |= set(error.argmax(axis=0).tolist())
    return np.array(sorted(chosen))


def positions(source: Opened, run: StoredRun) -> list[list[float]]:
    """Return a place (x, y) between 0 and 1 for each node, y downwards: the scenario's positions to
    scale, or a layout by the links.
    """
    given: Mapping[int, Any] | None = source.scenario.topology.positions
    if given is None or any(node not in given for node in run.nodes):
        given = _make_layout(source, run)
    points = np.array([given[node] for node in run.nodes], dtype=float).reshape(-1, 2)
    if not len(points) or not np.isfinite(points).all():
        return [[0.5, 0.5] for _ in run.nodes]
    low, high = points.min(axis=0), points.max(axis=0)
    size = max(float((high - low).max()), 1e-12)
    points = (points - 0.5 * (low + high)) / size
    return [[round(0.5 + x, 5), round(0.5 - y, 5)] for x, y in points.tolist()]


def _make_layout(source: Opened, run: StoredRun) -> dict[int, Any]:
    """Return coordinates for the nodes of a graph that has none of its own."""
    graph: networkx.Graph[int] = networkx.Graph()
    graph.add_nodes_from(run.nodes)
    graph.add_edges_from(source.scenario.topology.links)
    few = len(graph) <= MAX_KAMADA_KAWAI and networkx.is_connected(graph) if graph else False
    if few:
        return networkx.kamada_kawai_layout(graph)
    return networkx.spring_layout(graph, seed=1, iterations=30)


def _flow_kind(source: Opened) -> str:
    """Return how information flows: nodes ``combine`` what they hear, ``swap`` it for their own,
    send ``readings`` that nobody passes on, or one filter has the readings of all (``pooled``).
    """
    node_filter = source.scenario.node_filter
    if node_filter.pooled:
        return "pooled"
    return node_filter.combination if node_filter.combination in ("swap", "readings") else "combine"


def _state_axes(source: Opened, run: StoredRun, worst: Worst | None) -> list[int]:
    """Return the two components of the state to show first: the two that sensors see if one of
    them was furthest off at the worst instant, else those that were furthest off.
    """
    n = run.x.shape[1]
    observed_states: set[int] = set()
    for sensor in source.scenario.sensors:
        H = getattr(sensor, "H", None)
        if H is not None:
            observed_states |= set(np.flatnonzero(np.any(np.asarray(H) != 0.0, axis=0)).tolist())
    first = sorted(observed_states)[:2] if len(observed_states) >= 2 else [0, min(1, n - 1)]
    if worst is None or not worst.by_error:
        return first
    k, column = int(np.searchsorted(run.times, worst.time)), run.nodes.index(worst.node)
    off = np.argsort(-np.abs(run.error[k, column]), kind="stable").tolist()
    return first if off[0] in first else sorted(off[:2])


def _is_broadcast(run: StoredRun) -> bool:
    """Return True if the messages of one node at one instant are one transmission."""
    in_slots = bool((run.log["phase"][run.log["kind"] == CODES["send"]] >= 0).any())
    return in_slots or run.count("transmit") > 0


def _worst_data(worst: Worst | None) -> dict[str, Any] | None:
    """Return the worst sample as an entry of the page's data."""
    return None if worst is None else worst._asdict()


def _interval_scales() -> dict[str, float]:
    """Return the half axes of 95 % ellipses and intervals, in standard deviations."""
    return {
        "ellipse": math.sqrt(float(scipy.special.chdtri(2, 1.0 - ELLIPSE_LEVEL))),
        "interval": float(scipy.special.ndtri(0.5 + 0.5 * ELLIPSE_LEVEL)),
    }


def _drawing_limits(source: Opened) -> dict[str, Any]:
    """Return the horizontal lines of curves: limits of the bound and the interval of NEES."""
    promised = source.promised
    if promised is None:
        return {}
    known = {promised.limit_label: promised.limit, "centralised filter": promised.central}
    return {name: value for name, value in known.items() if math.isfinite(value)}


def _sample_columns(
    source: Opened, run: StoredRun, chosen: np.ndarray, messages: np.ndarray, packer: Packer
) -> dict[str, Any]:
    """Return the ``chosen`` samples as packed columns."""
    n = run.x.shape[1]
    i, j = np.triu_indices(n)
    total = len(run.times)
    times = run.times[chosen]
    ages = information_age(messages, run.nodes, times, source.cuts(times))
    columns = {
        "t": packer.add(times, "f8"),
        "xhat": packer.add(run.xhat[chosen], "f8"),
        "P": packer.add(run.P[chosen][..., i, j], "f8"),
        "age": packer.add(ages, "f8"),
    }
    if run.truth_known:
        columns["x"] = packer.add(run.x[chosen], "f8")
        columns["sq_error"] = packer.add(run.sq_error[chosen], "f8")
        columns["nees"] = packer.add(run.nees[chosen], "f8")
    bound = source.promised.bound if source.promised is not None else None
    if bound is not None and bound.shape == (total, len(run.nodes)):
        columns["bound"] = packer.add(bound[chosen], "f8")
    low, high = nees_bounds(n)
    step = 1 if len(chosen) == total else int(chosen[1] - chosen[0]) if len(chosen) > 1 else 1
    step = max(step, 2) if len(chosen) < total else 1
    return {"columns": columns, "count": len(chosen), "step": step, "nees_interval": [low, high]}


def _message_columns(kept: Kept, run: StoredRun, packer: Packer) -> dict[str, Any]:
    """Return the messages as packed columns."""
    messages = kept.messages
    nodes = np.array(run.nodes)
    ended = np.where(np.isnan(messages["ended"]), np.inf, messages["ended"])
    columns = {
        "sent": packer.add(messages["sent"], "f8"),
        # Most messages take no time: zeros cost nothing.
        "travel": packer.add(np.where(ended == messages["sent"], 0.0, ended), "f8"),
        "age": packer.add(np.nan_to_num(messages["age"], nan=0.0), "f8"),
        "sender": packer.add(np.searchsorted(nodes, messages["sender"]), "u2"),
        "receiver": packer.add(np.searchsorted(nodes, messages["receiver"]), "u2"),
        "number": packer.add(np.diff(messages["number"], prepend=0) & 0xFFFFFFFF, "u4"),
        "phase": packer.add(np.clip(messages["phase"], -1, 32767), "i2"),
        "outcome": packer.add(messages["outcome"], "u1"),
    }
    bounded = kept.step > 1
    return {
        "columns": columns,
        "count": len(messages),
        "step": kept.step,
        "start": kept.start if bounded else None,
        "end": kept.end if bounded else None,
    }


def _event_columns(
    run: StoredRun, kinds: tuple[str, ...], most: int, packer: Packer
) -> dict[str, Any]:
    """Return the events of some kinds, every k-th if there are more than ``most``."""
    codes = [CODES[kind] for kind in kinds]
    rows = run.log[np.isin(run.log["kind"], codes)]
    step = max(1, -(-len(rows) // max(1, most)))
    kept = rows[::step]
    columns = {
        "t": packer.add(kept["t"], "f8"),
        "node": packer.add(np.searchsorted(np.array(run.nodes), kept["node"]), "u2"),
        "kind": packer.add(kept["kind"], "u1"),
    }
    names = {CODES[kind]: kind for kind in kinds}
    return {"columns": columns, "step": step, "total": len(rows), "names": names}
