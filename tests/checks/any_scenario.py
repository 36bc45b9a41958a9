"""Healthy scenarios of all filters, clocks, losses and delays, recorded ones too, drawn at random.

Wider than ``healthy``, with the parts that reports of false accusations were about: directed
graphs, starts of each node, tables of links, losses and samples, and tiny and short scenarios.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from netkf.algorithms.registry import built_in_filters, default_timing, split_choice
from netkf.core.errors import NetkfError
from netkf.scenario.reading import from_table
from netkf.scenario.scenario import Scenario
from tests.checks.healthy import ATTEMPTS, _draw_plant, _draw_sensors, _is, _size

Table = dict[str, Any]
NODE_FILTERS = ("diffusion", "kcf", "push-sum")


def draw_any(number: int, folder: Path) -> Scenario:
    """Return the healthy scenario of a number; tables that netkf refuses are drawn again."""
    random = np.random.default_rng([number, 13])
    # Of blocks of the state nothing is promised that could be checked.
    names = [n for n in built_in_filters() if not n.startswith("block-") and n != "partition"]
    for _ in range(10 * ATTEMPTS):
        table = _draw_table(random, names[number % len(names)], folder)
        try:
            return from_table(table, folder)
        except NetkfError:
            continue
    raise AssertionError(f"no scenario for number {number}")


def _draw_table(random: np.random.Generator, name: str, folder: Path) -> Table:
    cls, (kind, choice) = built_in_filters()[name], split_choice(name)
    timing = default_timing(cls)
    flows = kind in ("hybrid", "covariance-intersection")
    clocks = flows or (
        (bool(timing and timing.clocks) or kind in ("central", "local")) and _is(random, 0.35)
    )
    n = int(random.integers(1, 3))
    nodes = 1 if _is(random, 0.05) else int(random.integers(2, 6))
    horizon = float(random.choice([1, 2, 5] if clocks else [3, 5, 12, 24, 40]))
    table: Table = {
        "format": 1,
        "name": f"{name} of {nodes} in {horizon:g}",
        "horizon": horizon,
        "probe": horizon,
        "plant": _draw_plant(random, n, not clocks),
        "sensors": _draw_sensors(random, n, nodes, clocks and (not flows or _is(random, 0.3))),
    }
    if not clocks and _is(random, 0.1):
        table["sensors"][0] = {
            "nodes": table["sensors"][0]["nodes"], "kind": "regressor", "A": [[0.5]],
            "B": [[1.0]], "C": random.normal(size=(n, 1)).tolist(), "R": [[0.4]],
            "start": [0.0], "xi_cov": [[1.0]],
        }  # fmt: skip
    directed = kind not in ("gossip", "push-sum") and nodes > 1 and _is(random, 0.25)
    if nodes > 1 or _is(random, 0.5):
        table["network"] = _draw_network(random, kind, nodes, directed, clocks, folder, horizon)
    table["filter"] = {"kind": kind, **choice, **_draw_filter(random, kind, choice, n, nodes)}
    return table


def _draw_graph(random: np.random.Generator, nodes: int, directed: bool, folder: Path) -> Table:
    if nodes == 1:
        return {"kind": "edges", "edges": [], "nodes": 1}
    if not directed and _is(random, 0.7):
        shape = str(random.choice(["path", "complete", "star", "cycle"])) if nodes > 2 else "path"
        return {"kind": shape, "nodes": nodes}
    ring = [[k, (k + 1) % nodes] for k in range(nodes if nodes > 2 else 1)]
    extra = [[j, i] for i, j in ring if directed and _is(random, 0.4)]
    if _is(random, 0.5):
        rows = [f"{i},{j},{random.uniform(0.3, 1.0):.2f}" for i, j in [*ring, *extra]]
        header = "sender,receiver,delivery_probability"
        (folder / "links.csv").write_text("\n".join([header, *rows]) + "\n")
        return {"kind": "csv", "path": "links.csv", "directed": directed}
    return {"kind": "edges", "edges": [*ring, *extra], "directed": directed, "nodes": nodes}


def _draw_loss(random: np.random.Generator, graph: Table, folder: Path) -> Table:
    chosen = random.random()
    if graph["kind"] == "csv":
        return {"kind": "per-link"}
    if chosen < 0.35:
        delivery = 1.0 - _size(random, -4, -1) if _is(random, 0.4) else random.uniform(0.05, 0.99)
        return {"kind": "bernoulli", "delivery": float(delivery)}
    if chosen < 0.55:
        loss, burst = float(random.uniform(0.02, 0.6)), float(random.uniform(1.0, 5.0))
        return {"kind": "gilbert-elliott", "mean_loss": loss, "mean_burst": burst}
    if chosen < 0.65 and graph["kind"] == "edges" and graph["edges"]:
        pairs = [(i, j) for i, j in graph["edges"]]
        pairs += [] if graph.get("directed") else [(j, i) for i, j in pairs]
        rows = [f"{i},{j},{k},{int(_is(random, 0.6))}" for i, j in pairs for k in range(8)]
        header = "sender,receiver,message,delivered"
        (folder / "losses.csv").write_text("\n".join([header, *rows]) + "\n")
        after = str(random.choice(["deliver", "lose", "repeat"]))
        return {"kind": "recorded", "path": "losses.csv", "after": after}
    return {"kind": "none"}


def _draw_delay(random: np.random.Generator, clocks: bool) -> Table:
    if _is(random, 0.5 if clocks else 0.8):
        return {"kind": "none"}
    size = _size(random, -2.5, 0.3)
    return [
        {"kind": "constant", "seconds": size},
        {"kind": "exponential", "mean": size},
        {"kind": "uniform", "low": 0.2 * size, "high": size},
        {"kind": "lognormal", "mean": size, "sigma": 0.7},
    ][int(random.integers(4))]


def _draw_network(
    random: np.random.Generator,
    kind: str,
    nodes: int,
    directed: bool,
    clocks: bool,
    folder: Path,
    horizon: float,
) -> Table:
    graph = _draw_graph(random, nodes, directed, folder)
    channel = {"loss": _draw_loss(random, graph, folder), "delay": _draw_delay(random, clocks)}
    if directed or _is(random, 0.4):
        channel["symmetric"] = False
    network: Table = {"graph": graph, "channel": channel}
    if kind in ("central", "local"):
        return {"graph": graph}
    if clocks:
        network["activation"] = _draw_clock(random, kind, directed, nodes, horizon, folder)
    elif kind == "gossip":
        protocols = ["one-edge", "node-wakeup", "maximal", "uniform-maximal", "independent"]
        protocol = str(random.choice(protocols))
        network["activation"] = {"kind": "matching", "protocol": protocol}
        if protocol == "independent":
            network["activation"]["p"] = float(random.uniform(0.05, 0.9))
    elif graph["kind"] == "edges" and graph["edges"] and _is(random, 0.25):
        rows = [
            f"{slot},{phase},{step},{i},{j}"
            for slot in range(int(horizon))
            for phase in range(1)
            for step in range(1)
            for i, j in graph["edges"]
            if _is(random, 0.7)
        ]
        (folder / "up.csv").write_text("\n".join(["slot,phase,step,node,peer", *rows]) + "\n")
        network["activation"] = {"kind": "recorded", "path": "up.csv"}
    else:
        network["activation"] = {"kind": "broadcast"}
    return network


def _draw_clock(
    random: np.random.Generator, kind: str, directed: bool, nodes: int, horizon: float, folder: Path
) -> Table:
    if kind == "intermittent" or (kind not in ("gossip", "push-sum") and _is(random, 0.15)):
        return {"kind": "readings"}
    at = "links"
    if kind in NODE_FILTERS:
        at = "nodes"
    elif kind != "gossip":
        at = str(random.choice(["directions", "nodes"] if directed else
                               ["links", "directions", "nodes"]))  # fmt: skip
    rate = _size(random, -1.0, 1.0)
    clock: Table = {"kind": "poisson", "rate": rate}
    chosen = random.random()
    if chosen < 0.15:
        clock = {"kind": "renewal", "distribution": "gamma", "shape": 2.0, "rate": rate}
    elif chosen < 0.25:
        clock = {"kind": "renewal", "distribution": "weibull", "shape": 0.7, "mean": 1.0 / rate}
    elif chosen < 0.35:
        clock = {"kind": "renewal", "distribution": "uniform", "low": 0.1, "high": 0.8}
    elif chosen < 0.55:
        clock = {"kind": "periodic", "period": 1.0 / rate}
        clock["phase"] = "random" if _is(random, 0.5) else 0.0
        clock["jitter"] = 0.2 / rate if _is(random, 0.5) else 0.0
    elif chosen < 0.65 and at == "nodes":
        times = np.sort(random.uniform(0.0, horizon, 12))
        rows = [f"{t:.6f},{random.integers(nodes)}" for t in times]
        (folder / "ticks.csv").write_text("\n".join(["t,node", *rows]) + "\n")
        clock = {"kind": "recorded", "path": "ticks.csv"}
    return {**clock, "at": at}


def _draw_filter(
    random: np.random.Generator, kind: str, choice: Table, n: int, nodes: int
) -> Table:
    chosen: Table = {}
    if kind in ("hybrid", "covariance-intersection", "kcf"):
        chosen["epsilon"] = float(random.uniform(0.05, 0.9 / max(nodes, 2)))
    if kind == "push-sum":
        chosen |= {"gamma": int(random.integers(1, 4)), "delta": nodes + 0.1}
        if _is(random, 0.3):
            chosen["running_sums"] = True
    if kind in ("hcmci", "icf"):
        chosen["steps"] = int(random.integers(1, 4))
    if kind == "hcmci" and _is(random, 0.5):
        chosen["consensus"] = str(random.choice(["information", "measurements"]))
    if kind == "event-triggered":
        stochastic = choice.get("trigger") == "stochastic"
        chosen["inner"] = {"kind": "intermittent" if stochastic else "hcmci"}
        if not stochastic:
            chosen["inner"] |= {"steps": 1, "consensus": "information"}
        chosen |= {"Y": _size(random, -1, 1)} if stochastic else {"thresholds": [0.5, 0.5]}
    if kind == "constant-gain":
        chosen["gain"] = (0.3 * random.normal(size=(n, 1))).tolist()
    if _is(random, 0.15):
        chosen["cov"] = [(_size(random, -1, 2) * np.eye(n)).tolist() for _ in range(nodes)]
    elif _is(random, 0.15):
        chosen["cov"] = (_size(random, -1, 4) * np.eye(n)).tolist()
    if _is(random, 0.15):
        chosen["mean"] = (_size(random, -1, 1) * random.normal(size=n)).tolist()
    return chosen
