"""What the live part of a page knows of a run: columns of numbers, thinned by a stated rule."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import networkx
import numpy as np
import scipy.special

from netkf.linalg.arrays import FloatArray
from netkf.report.claims import Worst, worst_node
from netkf.report.directories import Source, Trace
from netkf.report.messages import (
    Kept,
    information_age,
    keep_messages,
    traffic,
)
from netkf.report.packing import Packer
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
ELLIPSE_LEVEL = 0.95


class Budget(NamedTuple):
    """The most messages and sample values (numbers) of one run that a page holds."""

    messages: int
    values: int

    def halved(self) -> Budget:
        """Return half of it."""
        return Budget(self.messages // 2, self.values // 2)


def run_data(
    source: Source, trace: Trace, messages: np.ndarray, budget: Budget, packer: Packer
) -> dict[str, Any]:
    """Return what the views show of the trace of a source with these MESSAGE rows; columns go to
    ``packer``.
    """
    worst = worst_node(source)
    times = sample_indices(trace, budget.values)
    end = source.scenario.horizon if source.scenario is not None else _last_time(trace)
    instant = worst.time if worst is not None else end
    kept = keep_messages(messages, budget.messages, instant)
    horizon = float(end)
    return {
        "label": source.label,
        "name": source.name,
        "status": source.status,
        "replica": trace.replica,
        "horizon": horizon,
        "truth": trace.truth_known,
        "broadcasts": _broadcasts(trace),
        "n": trace.x.shape[1],
        "nodes": list(trace.nodes),
        "sensors": _sensors(source, trace),
        "positions": positions(source, trace),
        "knowledge": source.knowledge,
        "period": _period(source),
        "axes": _axes(source, trace.x.shape[1]),
        "links": _links(source, messages),
        "worst": _worst_data(worst),
        "scale": _scales(),
        "samples": _sample_columns(source, trace, times, messages, packer),
        "messages": _message_columns(kept, trace, packer),
        "senses": _event_columns(trace, ("sense",), budget.messages // 2, packer),
        "marks": _event_columns(trace, MARKS, MAX_MARKS, packer),
        "traffic": traffic(messages, horizon, BINS),
        "totals": {
            "events": sum(trace.kinds.values()),
            "kinds": {kind: count for kind, count in trace.kinds.items() if count},
            "messages": len(messages),
            "samples": len(trace.times),
        },
        "limits": _limits(source),
    }


def thinning_rules(source: Source, data: dict[str, Any]) -> list[str]:
    """Return sentences that say what the page leaves out of a run; none if it has everything."""
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
    for name, label in (("senses", "sensor readings"), ("marks", "other events of nodes")):
        if data[name]["step"] > 1:
            rules.append(
                f"of {data[name]['total']:,} {label} the page holds every {data[name]['step']}th"
            )
    return rules


def sample_indices(trace: Trace, values: int) -> np.ndarray:
    """Return the indices of the samples to keep, so that there are at most about ``values``
    numbers: every k-th, the last one, and the worst instant of each node.
    """
    n, count = trace.x.shape[1], len(trace.nodes)
    each = count * (n + n * (n + 1) // 2 + 4) + n + 1
    most = max(2, values // max(1, each))
    total = len(trace.times)
    if total <= most:
        return np.arange(total)
    step = -(-total // max(1, most - 1))
    chosen = {*range(0, total, step), total - 1}
    if trace.truth_known:
        error = np.where(np.isfinite(trace.sq_error), trace.sq_error, -1.0)
        chosen |= set(error.argmax(axis=0).tolist())
    return np.array(sorted(chosen))


def positions(source: Source, trace: Trace) -> list[list[float]]:
    """Return a place (x, y) between 0 and 1 for each node, y downwards: the scenario's positions to
    scale, or a layout by the links.
    """
    given = source.scenario.topology.positions if source.scenario is not None else None
    if given is None or any(node not in given for node in trace.nodes):
        given = _layout(source, trace)
    places = np.array([given[node] for node in trace.nodes], dtype=float).reshape(-1, 2)
    if not len(places) or not np.isfinite(places).all():
        return [[0.5, 0.5] for _ in trace.nodes]
    low, high = places.min(axis=0), places.max(axis=0)
    size = max(float((high - low).max()), 1e-12)
    places = (places - 0.5 * (low + high)) / size
    return [[round(0.5 + x, 5), round(0.5 - y, 5)] for x, y in places.tolist()]


def _layout(source: Source, trace: Trace) -> dict[int, tuple[float, float]]:
    graph = networkx.Graph()
    graph.add_nodes_from(trace.nodes)
    if source.scenario is not None:
        graph.add_edges_from(source.scenario.topology.links)
    else:
        sends = trace.log[trace.log["kind"] == CODES["send"]]
        pairs = np.unique(np.stack([sends["node"], sends["peer"]], axis=1), axis=0)
        graph.add_edges_from(pairs.tolist())
    few = len(graph) <= MAX_KAMADA_KAWAI and networkx.is_connected(graph) if graph else False
    if few:
        return dict(networkx.kamada_kawai_layout(graph))
    return dict(networkx.spring_layout(graph, seed=1, iterations=30))


def _period(source: Source) -> float:
    """Return the seconds of a slot, 0 under clocks."""
    scenario = source.scenario
    return float(scenario.plant.period) if scenario is not None and scenario.slotted else 0.0


def _axes(source: Source, n: int) -> list[int]:
    """Return the two components of the state to show first: those that sensors see, if two are."""
    seen: list[int] = []
    for sensor in source.scenario.sensors if source.scenario is not None else ():
        H = getattr(sensor, "H", None)
        if H is not None:
            seen += np.flatnonzero(np.any(np.asarray(H) != 0.0, axis=0)).tolist()
    first = sorted(set(seen))[:2] if len(set(seen)) >= 2 else [0, min(1, n - 1)]
    return [int(k) for k in first]


def _links(source: Source, messages: np.ndarray) -> list[list[int]]:
    """Return directed links [sender, receiver], at most MAX_LINKS of them."""
    # The topology lists what may be used; without a scenario there is only what was used.
    if source.scenario is not None:
        pairs = [(int(i), int(j)) for i, j in source.scenario.topology.directions]
    else:
        pairs = [(int(i), int(j)) for i, j in np.unique(messages[["sender", "receiver"]]).tolist()]
    return [list(pair) for pair in pairs[:MAX_LINKS]]


def _sensors(source: Source, trace: Trace) -> list[int]:
    """Return the nodes that take readings."""
    if source.scenario is not None:
        return [node for node in trace.nodes if node in source.scenario.placed]
    return np.unique(trace.log["node"][trace.log["kind"] == CODES["sense"]]).tolist()


def _broadcasts(trace: Trace) -> bool:
    """Return True if the messages of one node at one instant are one transmission."""
    in_slots = bool((trace.log["phase"][trace.log["kind"] == CODES["send"]] >= 0).any())
    return in_slots or trace.kinds["transmit"] > 0


def _last_time(trace: Trace) -> float:
    ends = [float(trace.times[-1])] if len(trace.times) else [0.0]
    if len(trace.log):
        ends.append(float(trace.log["t"][-1]))
    return max(ends)


def _worst_data(worst: Worst | None) -> dict[str, Any] | None:
    return None if worst is None else worst._asdict()


def _scales() -> dict[str, float]:
    """Return the half axes of 95 % ellipses and intervals, in standard deviations."""
    return {
        "ellipse": math.sqrt(float(scipy.special.chdtri(2, 1.0 - ELLIPSE_LEVEL))),
        "interval": float(scipy.special.ndtri(0.5 + 0.5 * ELLIPSE_LEVEL)),
    }


def _limits(source: Source) -> dict[str, Any]:
    """Return the horizontal lines of curves: limits of the bound and the interval of NEES."""
    found: dict[str, Any] = {}
    if source.promised is not None:
        for name, value in (
            (source.promised.limit_label, source.promised.limit),
            ("centralised filter", source.promised.central),
        ):
            if math.isfinite(value):
                found[name] = value
    return found


def _sample_columns(
    source: Source, trace: Trace, chosen: np.ndarray, messages: np.ndarray, packer: Packer
) -> dict[str, Any]:
    n = trace.x.shape[1]
    i, j = np.triu_indices(n)
    total = len(trace.times)
    times = trace.times[chosen]
    ages = information_age(messages, trace.nodes, times, source.cuts(times))
    columns = {
        "t": packer.add(times, "f8"),
        "xhat": packer.add(trace.xhat[chosen], "f8"),
        "P": packer.add(trace.P[chosen][..., i, j], "f8"),
        "age": packer.add(ages, "f8"),
    }
    if trace.truth_known:
        columns["x"] = packer.add(trace.x[chosen], "f8")
        columns["sq_error"] = packer.add(trace.sq_error[chosen], "f8")
        columns["nees"] = packer.add(trace.nees[chosen], "f8")
    bound = source.promised.bound if source.promised is not None else None
    if bound is not None and bound.shape == (total, len(trace.nodes)):
        columns["bound"] = packer.add(bound[chosen], "f8")
    low, high = nees_bounds(n)
    step = 1 if len(chosen) == total else int(chosen[1] - chosen[0]) if len(chosen) > 1 else 1
    step = max(step, 2) if len(chosen) < total else 1
    return {"columns": columns, "count": len(chosen), "step": step, "nees_interval": [low, high]}


def _message_columns(kept: Kept, trace: Trace, packer: Packer) -> dict[str, Any]:
    messages = kept.messages
    nodes = np.array(trace.nodes)
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
    trace: Trace, kinds: tuple[str, ...], most: int, packer: Packer
) -> dict[str, Any]:
    """Return the events of some kinds, every k-th if there are more than ``most``."""
    codes = [CODES[kind] for kind in kinds]
    rows = trace.log[np.isin(trace.log["kind"], codes)]
    step = max(1, -(-len(rows) // max(1, most)))
    kept = rows[::step]
    columns = {
        "t": packer.add(kept["t"], "f8"),
        "node": packer.add(np.searchsorted(np.array(trace.nodes), kept["node"]), "u2"),
        "kind": packer.add(kept["kind"], "u1"),
    }
    names = {CODES[kind]: kind for kind in kinds}
    return {"columns": columns, "step": step, "total": len(rows), "names": names}
