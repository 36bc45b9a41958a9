"""Scenarios drawn at random in which every promise must hold: all papers, slots and clocks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from netkf.core.errors import NetkfError
from netkf.scenario.reading import from_table
from netkf.scenario.scenario import Scenario

Table = dict[str, Any]
KINDS = ("hybrid", "covariance-intersection", "gossip", "intermittent", "push-sum", "diffusion")
ATTEMPTS = 30


def draw_scenario(number: int, folder: Path) -> Scenario:
    """Return the healthy scenario of a number; tables that netkf refuses are drawn again."""
    random = np.random.default_rng([number, 20])
    for _ in range(ATTEMPTS):
        try:
            return from_table(draw_table(random, KINDS[number % len(KINDS)]), folder)
        except NetkfError:
            continue
    raise AssertionError(f"no scenario for number {number}")


def draw_table(random: np.random.Generator, kind: str) -> Table:
    """Return a scenario as a table: few nodes, small states, horizons from short to long."""
    slotted = kind not in ("hybrid", "covariance-intersection") and random.random() < 0.75
    n, nodes = int(random.integers(1, 4)), int(random.integers(2, 6))
    horizon = float(
        random.choice([10, 12, 15, 20, 30, 60]) if slotted else random.choice([1, 4, 9])
    )
    sampled = not slotted and (
        kind not in ("hybrid", "covariance-intersection") or _is(random, 0.3)
    )
    return {
        "format": 1,
        "name": f"{kind} of {nodes}",
        "horizon": horizon,
        "probe": horizon,
        "plant": _draw_plant(random, n, slotted),
        "sensors": _draw_sensors(random, n, nodes, sampled),
        "network": _draw_network(random, kind, nodes, slotted),
        "filter": _draw_filter(random, kind, n, nodes, slotted),
    }


def _is(random: np.random.Generator, probability: float) -> bool:
    return bool(random.random() < probability)


def _size(random: np.random.Generator, low: float, high: float) -> float:
    """Return a number between 10^low and 10^high."""
    return float(10.0 ** random.uniform(low, high))


def _square(random: np.random.Generator, n: int, rank: int, size: float) -> list[list[float]]:
    """Return a positive semidefinite matrix (n, n) of a rank."""
    root = random.normal(size=(n, max(rank, 1))) * (rank > 0)
    product = size * (root @ root.T) + (1e-3 * size * np.eye(n) if rank == n else 0.0)
    return np.asarray(0.5 * (product + product.T)).tolist()


def _draw_start(random: np.random.Generator, n: int) -> list[list[float]]:
    """Return cov of x(0): the unit matrix, 0, of full or lower rank, or wide."""
    chosen = random.random()
    if chosen < 0.4:
        return np.eye(n).tolist()
    if chosen < 0.6:
        return np.zeros((n, n)).tolist()
    if chosen < 0.8:
        return _square(random, n, int(random.integers(1, n + 1)), _size(random, -2, 2))
    return (_size(random, 2, 8) * np.eye(n)).tolist()


def _draw_plant(random: np.random.Generator, n: int, slotted: bool) -> Table:
    matrix, cov = random.normal(size=(n, n)), _draw_start(random, n)
    rank = n if _is(random, 0.75) else int(random.integers(1, n + 1))
    size = _size(random, -3, 2)
    if slotted:
        radius = float(np.abs(np.linalg.eigvals(matrix)).max())
        F = matrix * random.choice([0.5, 0.9, 0.99, 1.0, 1.1, 1.4]) / radius
        Q = _square(random, n, rank, size)
        return {"kind": "linear", "F": F.tolist(), "Q": Q, "period": 1.0, "cov": cov}
    growth = float(np.linalg.eigvals(matrix).real.max())
    A = matrix - (growth - random.choice([-1.0, -0.1, 0.0, 0.3])) * np.eye(n)
    B = np.sqrt(size) * random.normal(size=(n, rank))
    return {"kind": "diffusion", "A": A.tolist(), "B": B.tolist(), "cov": cov}


def _draw_sensors(random: np.random.Generator, n: int, nodes: int, sampled: bool) -> list[Table]:
    places = random.permutation(nodes)[: int(random.integers(1, nodes + 1))]
    groups = np.array_split(places, int(random.integers(1, min(3, len(places) + 1))))
    sensors: list[Table] = []
    for group in groups:
        rows = int(random.integers(1, n + 1))
        H = random.normal(size=(rows, n))
        sensor = {"nodes": group.tolist(), "H": H.tolist()}
        sensor["R"] = _square(random, rows, rows, _size(random, -3, 2))
        if sampled:
            clock = {"kind": "poisson", "rate": _size(random, -0.3, 0.7)}
            if _is(random, 0.4):
                clock = {"kind": "periodic", "period": _size(random, -0.7, 0.0)}
            sensor["sampling"] = clock
        sensors.append(sensor)
    return sensors


def _draw_network(random: np.random.Generator, kind: str, nodes: int, slotted: bool) -> Table:
    shape = str(random.choice(["path", "complete", "star", "cycle"])) if nodes > 2 else "path"
    channel: Table = {}
    if _is(random, 0.7):
        channel["loss"] = {"kind": "bernoulli", "delivery": float(random.uniform(0.1, 0.99))}
    elif _is(random, 0.3):
        channel["loss"] = {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 3.0}
    if not slotted and _is(random, 0.3):
        channel["delay"] = {"kind": "constant", "seconds": _size(random, -2, -0.5)}
    if kind not in ("gossip", "push-sum") and _is(random, 0.3):
        channel["symmetric"] = False
    network: Table = {"graph": {"kind": shape, "nodes": nodes}, "channel": channel}
    if slotted and kind != "gossip":
        network["activation"] = {"kind": "broadcast"}
    elif slotted:
        protocol = str(random.choice(["one-edge", "node-wakeup", "maximal", "uniform-maximal"]))
        network["activation"] = {"kind": "matching", "protocol": protocol}
        if protocol == "one-edge" and _is(random, 0.7):
            network["activation"]["lazy"] = float(random.uniform(0.05, 0.6))
    else:
        network["activation"] = _draw_clock(random, kind)
    return network


def _draw_clock(random: np.random.Generator, kind: str) -> Table:
    if kind == "intermittent":
        return {"kind": "readings"}
    clock: Table = {"kind": "poisson", "rate": _size(random, -0.5, 1.0)}
    if _is(random, 0.25):
        clock = {"kind": "periodic", "period": _size(random, -1.0, 0.0), "phase": 0.1}
    elif _is(random, 0.2):
        clock = {"kind": "renewal", "distribution": "gamma", "shape": 2.0, "rate": 2.0}
    if kind in ("push-sum", "diffusion"):
        clock["at"] = "nodes"
    return clock


def _draw_filter(
    random: np.random.Generator, kind: str, n: int, nodes: int, slotted: bool
) -> Table:
    chosen: Table = {"kind": kind}
    if kind in ("hybrid", "covariance-intersection"):
        chosen["epsilon"] = float(random.uniform(0.05, 1.0 / nodes))
    if kind == "push-sum" and slotted:
        chosen |= {"gamma": int(random.integers(1, 5)), "delta": nodes + 0.1}
    if _is(random, 0.2):
        chosen["cov"] = (_size(random, -1, 9) * np.eye(n)).tolist()
    if _is(random, 0.15):
        chosen["mean"] = (_size(random, -1, 1) * random.normal(size=n)).tolist()
    if _is(random, 0.1):
        chosen["model"] = {"Q" if slotted else "B": (_size(random, -1, 1) * np.eye(n)).tolist()}
    return chosen
