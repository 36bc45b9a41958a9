"""Scenarios in continuous time drawn from a seed: every filter under every clock that it has, with
sensors, losses, delays and graphs of all kinds.
"""

import numpy as np

from netkf.scenario.reading import from_table

FILTERS = {
    "hybrid": ("links", "directions", "nodes", "readings"),
    "covariance-intersection": ("links", "directions", "nodes", "readings"),
    "gossip": ("links",),
    "diffusion": ("directions", "nodes", "readings"),
    "intermittent": ("readings",),
    "push-sum": ("nodes",),
    "local": (None,),
    "central": (None,),
}
"""Kinds of filters, and what may make their nodes transmit."""

ANYHOW = ("links", "directions", "nodes", "readings")
LITERATURE = {
    "track-fusion ci": ANYHOW,
    "track-fusion ici": ANYHOW,
    "constant-gain": ANYHOW,
    "kcf": ("directions", "nodes", "readings"),
    "belief-propagation": ANYHOW,
}
"""Those of the literature, drawn by themselves."""


class Draw:
    """Values of a scenario from a generator; files go to a folder."""

    def __init__(self, seed, folder):
        self.random, self.folder, self.files = np.random.default_rng([20261122, seed]), folder, 0

    def one(self, *choices):
        return choices[self.random.integers(len(choices))]

    def chance(self, probability):
        return bool(self.random.random() < probability)

    def number(self, low, high, digits=2):
        return round(float(self.random.uniform(low, high)), digits)

    def table(self, header, rows):
        self.files += 1
        path = self.folder / f"table{self.files}.csv"
        lines = [header, *(",".join(map(repr, row)) for row in rows)]
        path.write_text("\n".join(lines) + "\n")
        return path.name


def drawn_table(seed, folder, sizes, filters=FILTERS):
    """The table of the scenario of a seed, with as many states as one of ``sizes``; all kinds of
    ``filters`` come in turn.
    """
    draw = Draw(seed, folder)
    kind = list(filters)[seed % len(filters)]
    at = filters[kind][seed // len(filters) % len(filters[kind])]
    n, nodes = int(draw.one(*sizes)), int(draw.random.integers(2, 6))
    horizon = draw.number(3.0, 6.0, 1)
    links, graph = _graph(draw, nodes, at)
    probe, plant = _probe(draw, horizon), _plant(draw, n)
    if kind == "belief-propagation":
        # No noise, and no modes that decay much faster than others: of those kept evidence soon
        # has no digits.
        A = np.array(plant["A"])
        plant |= {"A": (0.5 * (A - A.T) + 0.2 * np.eye(n) * A[0, 0]).tolist(), "B": [[0.0]] * n}
    sensors = _sensors(draw, n, nodes, horizon, kind, at)
    return {
        "format": 1,
        "name": f"drawn-{seed}",
        "seed": seed,
        "horizon": horizon,
        "probe": probe,
        "plant": plant,
        "sensors": sensors,
        "network": {
            "graph": graph,
            "activation": _activation(draw, nodes, links, horizon, at),
            "channel": {
                "loss": _loss(draw, links, graph["kind"] == "csv"),
                "delay": _delay(draw, links),
                "symmetric": draw.chance(0.5),
            },
        },
        "filter": _filter(draw, kind, nodes, sensors, n),
    }


def drawn_scenario(seed, folder, sizes, filters=FILTERS):
    """The scenario of a seed."""
    return from_table(drawn_table(seed, folder, sizes, filters), folder)


def _graph(draw, nodes, at):
    """Directed links (i, j), and the graph."""
    pairs = [(i, i + 1) for i in range(nodes - 1)]
    pairs += [(i, j) for i in range(nodes) for j in range(i + 2, nodes) if draw.chance(0.4)]
    if at in (None, "links") or draw.chance(0.5):
        both = sorted([*pairs, *((j, i) for i, j in pairs)])
        if not draw.chance(0.4):
            return both, {"kind": "edges", "edges": [list(p) for p in pairs]}
        rows = [(i, j, draw.number(0.3, 1.0)) for i, j in both]
        return both, {"kind": "csv", "path": _measured(draw, rows)}
    one_way = [(i, (i + 1) % nodes) for i in range(nodes)] if nodes > 2 else [(0, 1), (1, 0)]
    one_way = sorted({*one_way, *((j, i) for i, j in pairs if draw.chance(0.3))})
    rows = [(i, j, draw.number(0.3, 1.0)) for i, j in one_way]
    return one_way, {"kind": "csv", "path": _measured(draw, rows), "directed": True}


def _measured(draw, rows):
    return draw.table("sender,receiver,delivery_probability", rows)


def _probe(draw, horizon):
    if draw.chance(0.3):
        return sorted({draw.number(0.0, horizon) for _ in range(5)} | {0.0})
    return draw.one(0.25, 0.5, 0.37)


def _plant(draw, n):
    A = draw.random.normal(size=(n, n)).round(2)
    top = float(np.linalg.eigvals(A).real.max())
    growth = draw.one(-0.5, -0.1, 0.0, 0.3, 2.5)
    A = (A + (growth - top) * np.eye(n)).round(3)
    if draw.chance(0.1):
        A = np.zeros((n, n))
    B = draw.random.normal(size=(n, int(draw.random.integers(1, n + 1)))).round(2)
    plant = {"kind": "diffusion", "A": A.tolist(), "B": B.tolist(), "cov": np.eye(n).tolist()}
    plant["mean"] = draw.random.normal(size=n).round(1).tolist()
    return plant


def _sensors(draw, n, nodes, horizon, kind, at):
    samples_only = kind in ("intermittent", "push-sum", "kcf", "belief-propagation")
    if kind == "constant-gain":
        return _sensors_with_gains(draw, n, nodes, horizon, at)
    found = []
    for k in range(int(draw.random.integers(1, 4))):
        p = int(draw.random.integers(1, 3))
        some = sorted(draw.random.choice(nodes, draw.random.integers(1, nodes + 1), replace=False))
        sensor = {
            "nodes": [int(node) for node in some],
            "H": draw.random.normal(size=(p, n)).round(2).tolist(),
            "R": _covariance(draw, p),
        }
        must_sample = samples_only or (at == "readings" and k == 0)
        if must_sample or draw.chance(0.5):
            sensor = _sampled(draw, sensor, n, horizon, kind == "push-sum")
        found.append(sensor)
    return found


def _sensors_with_gains(draw, n, nodes, horizon, at):
    """One sensor that samples at a node, or up to two that give increments; a node without any."""
    found = []
    for node in range(nodes - 1):
        sampled = draw.chance(0.5) or (at == "readings" and node == 0)
        for _ in range(1 if sampled else int(draw.random.integers(1, 3))):
            p = int(draw.random.integers(1, 3))
            H = draw.random.normal(size=(p, n)).round(2).tolist()
            sensor = {"nodes": [node], "H": H, "R": _covariance(draw, p)}
            while sampled and "sampling" not in sensor:
                # Recorded readings may be missing, for which there is no gain.
                made = _sampled(draw, sensor, n, horizon, True)
                sensor = made if made.get("kind") != "recorded" else sensor
            found.append(sensor)
    return found


def _covariance(draw, p):
    root = draw.random.normal(size=(p, p))
    return (root @ root.T + 0.2 * np.eye(p)).round(3).tolist()


def _sampled(draw, sensor, n, horizon, fixed):
    period = draw.one(0.25, 0.3, 0.5)
    kinds = ("periodic", "jittered", "poisson", "renewal", "times", "recorded")
    kind = draw.one(*kinds) if fixed else draw.one(*kinds, "phi")
    instants = [(t, i) for i in sensor["nodes"] for t in np.arange(period, horizon, period)]
    instants = [(round(float(t), 3), i) for t, i in instants if draw.chance(0.7)]
    if kind in ("recorded", "phi"):
        p = 1 if kind == "phi" else len(sensor["H"])
        width = p + (n if kind == "phi" else 0)
        rows = [(t, i, *draw.random.normal(size=width).round(3).tolist()) for t, i in instants]
        rows = rows or [(period, sensor["nodes"][0], *[0.5] * width)]
        names = [f"y{j}" for j in range(p)] + [f"phi{j}" for j in range(width - p)]
        recorded = {"kind": "recorded", "path": draw.table(",".join(["t", "node", *names]), rows)}
        sensor = {**recorded, "nodes": sensor["nodes"], "R": sensor["R"], "H": sensor["H"]}
        if kind == "phi":
            sensor["R"] = [[0.5]]
            del sensor["H"]
        return sensor
    if kind == "times":
        rows = instants or [(period, sensor["nodes"][0])]
        clock = {"kind": "recorded", "path": draw.table("t,node", rows)}
    else:
        clock = {
            "periodic": {"kind": "periodic", "period": period},
            "jittered": {"kind": "periodic", "period": period, "phase": "random", "jitter": 0.1},
            "poisson": {"kind": "poisson", "rate": 2.0},
            "renewal": {"kind": "renewal", "distribution": "gamma", "shape": 2.0, "mean": 0.4},
        }[kind]
    return {**sensor, "sampling": clock}


def _activation(draw, nodes, links, horizon, at):
    if at == "readings":
        return {"kind": "readings"}
    at = at or "links"
    kind = draw.one("poisson", "poisson", "periodic", "jittered", "renewal", "recorded")
    if kind == "recorded":
        places = {"links": sorted({(min(p), max(p)) for p in links}), "directions": links}
        places = places.get(at, [(i,) for i in range(nodes)])
        rows = [
            (t, *p) for p in places for t in (0.25, 0.5, 1.1, 1.5, 2.5, 2.75) if draw.chance(0.7)
        ]
        header = "t,node" if at == "nodes" else "t,node,peer"
        return {"kind": kind, "at": at, "path": draw.table(header, rows or [(0.5, *places[0])])}
    clock = {
        "poisson": {"kind": "poisson", "rate": 3.0},
        "periodic": {"kind": "periodic", "period": draw.one(0.25, 0.5)},
        "jittered": {"kind": "periodic", "period": 0.3, "phase": "random", "jitter": 0.1},
        "renewal": {"kind": "renewal", "distribution": "uniform", "low": 0.1, "high": 0.6},
    }[kind]
    return {**clock, "at": at}


def _loss(draw, links, measured):
    kind = draw.one("none", "bernoulli", "bursts", "recorded", "per-link" if measured else "none")
    if kind == "recorded":
        rows = [(i, j, k, int(draw.chance(0.7))) for i, j in links for k in range(6)]
        path = draw.table("sender,receiver,message,delivered", rows)
        return {"kind": kind, "path": path, "after": draw.one("deliver", "lose", "repeat")}
    return {
        "none": {"kind": "none"},
        "per-link": {"kind": "per-link"},
        "bernoulli": {"kind": "bernoulli", "delivery": draw.number(0.3, 0.9)},
        "bursts": {"kind": "gilbert-elliott", "mean_loss": 0.3, "mean_burst": 2.5},
    }[kind]


def _delay(draw, links):
    kind = draw.one("none", "none", "constant", "exponential", "uniform", "recorded")
    if kind == "recorded":
        values = (0.0, 0.1, 0.25, 0.5)
        rows = [(i, j, k, draw.one(*values)) for i, j in links for k in range(6)]
        path = draw.table("sender,receiver,message,seconds", rows)
        return {"kind": kind, "path": path, "after": draw.one("deliver", "lose", "repeat")}
    return {
        "none": {"kind": "none"},
        "constant": {"kind": "constant", "seconds": 0.25},
        "exponential": {"kind": "exponential", "mean": 0.3},
        "uniform": {"kind": "uniform", "low": 0.0, "high": 0.6},
    }[kind]


def _filter(draw, kind, nodes, sensors, n):
    kind, *rule = kind.split(" ")
    chosen = {"kind": kind}
    if kind == "track-fusion":
        chosen |= {"rule": rule[0], "minimise": draw.one("trace", "determinant")}
    if kind == "kcf":
        chosen |= {"epsilon": draw.one(0.1, 0.5), "share_readings": draw.chance(0.7)}
    if kind == "constant-gain":
        rows = [sum(len(s["H"]) for s in sensors if node in s["nodes"]) for node in range(nodes)]
        chosen["gain"] = [
            (0.3 * draw.random.normal(size=(n, max(1, p)))).round(2).tolist() for p in rows
        ]
    if kind in ("hybrid", "covariance-intersection"):
        chosen["epsilon"] = draw.one(0.1, 0.2)
    if kind == "diffusion":
        chosen["on_loss"] = draw.one("renormalise", "keep-own")
    if kind == "intermittent":
        chosen["late"] = draw.one("exact", "exact", "drop")
        if chosen["late"] == "exact" and draw.chance(0.5):
            chosen["window"] = draw.one(0.2, 1.0)
    return chosen
