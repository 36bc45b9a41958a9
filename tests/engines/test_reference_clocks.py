"""Filters under recorded clocks over a diffusion against a plain simulator written from
shared/format.md alone: one sorted agenda, textbook formulas, no reuse of anything in netkf.

Cases are drawn with everything at once: several sensors at a node, rows of H in the table, ids that
are not 0 .. N-1, readings, ticks, arrivals and samples of the state at the same instants, directed
graphs, messages out of order, losses in one direction, filters that believe in another model.
"""

import csv
import heapq
import itertools
import json
from collections import Counter
from functools import cache

import numpy as np
import pytest
import scipy.linalg

import netkf

# -- the reference ------------------------------------------------------------------------------


class Reference:
    """Runs a case; ``xhat`` (T, N, n), ``P`` (T, N, n, n) by order of ids, ``rows`` of events."""

    def __init__(self, case):
        self.case, self.kind = case, case["filter"]["kind"]
        model = case["model"]
        self.A = np.array(model.get("A", case["A"]))
        self.B = np.array(model.get("B", case["B"]))
        self.n = len(self.A)
        self.transition = cache(self._transition)
        u = case.get("input")
        self.input = None if u is None or model.get("input") is False else u
        self.response = cache(self._response)
        self.ids = sorted(case["ids"])
        options = case["filter"]
        self.start = {}
        for k, node in enumerate(self.ids):
            mean = np.array(options.get("mean", case.get("mean")))
            cov = np.array(options.get("cov", case.get("cov")))
            self.start[node] = (
                mean[k] if mean.ndim == 2 else mean,
                cov[k] if cov.ndim == 3 else cov,
            )
        self.state = {node: (0.0, *self.start[node]) for node in self.ids}
        self.known = {node: [] for node in self.ids}  # intermittent: (stamp, H, R, y)
        self.out = {node: set() for node in self.ids}
        for i, j in case["edges"]:
            self.out[i].add(j)
            if not case["directed"]:
                self.out[j].add(i)
        self.sent, self.agenda = {}, {}
        self.rows = []  # (kind, t, node, peer, message)

    def _transition(self, gap):
        n, Q = self.n, self.B @ self.B.T
        steps = int(gap * np.abs(self.A).sum()) + 1  # e^{-A g} must not grow
        E = scipy.linalg.expm(
            np.block([[-self.A, Q], [np.zeros((n, n)), self.A.T]]) * (gap / steps)
        )
        F = E[n:, n:].T
        Q = F @ E[:n, n:]
        total, spread = np.eye(n), np.zeros((n, n))
        for _ in range(steps):
            total, spread = F @ total, F @ spread @ F.T + Q
        return total, spread

    def predict(self, x, P, gap, now):
        """``now`` is the end of the gap."""
        if gap == 0.0:
            return x, P
        F, Q = self.transition(gap)
        P = F @ P @ F.T + Q
        return F @ x + self.response(now - gap, now), (P + P.T) / 2.0

    def _response(self, start, end):
        """What the input adds: the integral of e^{A (end - s)} G u(s) ds."""
        u, n, A = self.input, self.n, self.A
        if u is None:
            return np.zeros(n)
        G = np.array(u["G"])
        if u["kind"] == "sine":
            # a sin(w t + p) is the imaginary part of a e^{i p} e^{i w t}
            total = np.zeros(n, dtype=complex)
            for g, a, f, p in zip(G.T, u["amplitude"], u["frequency"], u["phase"], strict=True):
                w = 2.0 * np.pi * f
                ends = np.exp(1j * w * end) * g
                ends = ends - scipy.linalg.expm(A * (end - start)) @ g * np.exp(1j * w * start)
                total += a * np.exp(1j * p) * np.linalg.solve(1j * w * np.eye(n) - A, ends)
            return total.imag
        rows = sorted(u.get("rows", [[0.0, *u.get("value", ())]]))
        cuts = [start, *(t for t, *_ in rows if start < t < end), end]
        x = np.zeros(n)
        for first, last in itertools.pairwise(cuts):
            held = [values for t, *values in rows if t <= first]
            drive = G @ held[-1] if held else np.zeros(n)
            M = np.block([[A, drive[:, None]], [np.zeros((1, n + 1))]]) * (last - first)
            x = (scipy.linalg.expm(M) @ np.append(x, 1.0))[:n]
        return x

    @staticmethod
    def update(x, P, H, R, y):
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        M = np.eye(len(x)) - K @ H
        P = M @ P @ M.T + K @ R @ K.T
        return x + K @ (y - H @ x), (P + P.T) / 2.0

    @staticmethod
    def intersect(weighted):
        information = sum(w * np.linalg.inv(P) for w, _, P in weighted)
        vector = sum(w * np.linalg.solve(P, x) for w, x, P in weighted)
        P = np.linalg.inv(information)
        return P @ vector, (P + P.T) / 2.0

    @staticmethod
    def stack(parts):
        return (
            np.concatenate([H for H, _, _ in parts]),
            scipy.linalg.block_diag(*(R for _, R, _ in parts)),
            np.concatenate([y for _, _, y in parts]),
        )

    def at(self, node, t):
        """The estimate of a node now."""
        if self.kind != "intermittent":
            t0, x, P = self.state[node]
            x, P = self.predict(x, P, t - t0, t)
            self.state[node] = (t, x, P)
            return x, P
        x, P = self.start[node]
        last = 0.0
        for stamp in sorted({stamp for stamp, *_ in self.known[node]}):
            x, P = self.predict(x, P, stamp - last, stamp)
            parts = [rest for other, *rest in self.known[node] if other == stamp]
            x, P = self.update(x, P, *self.stack(parts))
            last = stamp
        return self.predict(x, P, t - last, t)

    def readings(self):
        """By time, then node: the parts (H, R, y)."""
        case, found = self.case, {}
        believed = case["model"].get("R")
        for k, sensor in enumerate(case["sensors"]):
            R = sensor["R"]
            if believed is not None:
                R = believed[k]
            for t, node, y, phi in sensor["rows"]:
                if node in sensor["nodes"] and t < case["horizon"]:
                    H = np.array(sensor["H"] if phi is None else [phi])
                    parts = found.setdefault(t, {}).setdefault(node, [])
                    parts.append((H, np.array(R), np.array(y)))
        return found

    def send(self, t, sender, receiver, payload):
        number = self.sent.get((sender, receiver), 0)
        self.sent[sender, receiver] = number + 1
        self.rows.append(("send", t, sender, receiver, number))
        loss, delay = self.case["loss"], self.case["delay"]
        delivered, known = self.listed(loss, sender, receiver, number)
        if not (delivered if known else loss is None or loss["after"] != "lose"):
            self.rows.append(("lost", t, sender, receiver, number))
            return
        seconds, known = self.listed(delay, sender, receiver, number)
        if not known:
            if delay is not None and delay["after"] == "lose":
                self.rows.append(("lost", t, sender, receiver, number))
                return
            seconds = 0.0
        arrival = round(t + seconds, 9)
        if arrival < self.case["horizon"]:
            if arrival > t:
                heapq.heappush(self.times, arrival)
            box = self.agenda.setdefault(arrival, [])
            box.append((receiver, sender, number, t, payload))

    @staticmethod
    def listed(record, sender, receiver, number):
        if record is None:
            return None, False
        table = {m: v for i, j, m, v in record["rows"] if (i, j) == (sender, receiver)}
        if record["after"] == "repeat" and table:
            number %= max(table) + 1
        return table.get(number), number in table

    def run(self):
        case = self.case
        samples, ticks = self.readings(), {}
        for t, *who in case["ticks"] or ():
            if t < case["horizon"]:
                ticks.setdefault(t, []).append(who)
        probes = {t: k for k, t in enumerate(case["probe"])}
        central = self.kind == "central"
        N = len(self.ids)
        self.xhat = np.empty((len(probes), N, self.n))
        self.P = np.empty((len(probes), N, self.n, self.n))
        self.times = [*{*samples, *ticks, *probes}]
        heapq.heapify(self.times)
        while self.times:
            t = heapq.heappop(self.times)
            while self.times and self.times[0] == t:
                heapq.heappop(self.times)
            self.sample(t, samples.get(t, {}))
            if self.kind not in ("local", "central"):
                self.tick(t, ticks.get(t, ()), samples.get(t, {}))
                self.absorb(t, self.agenda.pop(t, ()))
            if t in probes:
                for k, own in enumerate(self.ids):
                    node = self.ids[0] if central else own
                    self.xhat[probes[t], k], self.P[probes[t], k] = self.at(node, t)
        return self

    def sample(self, t, found):
        if self.kind == "central":
            parts = [part for node in sorted(found) for part in found[node]]
            found = {self.ids[0]: parts} if parts else {}
        for node, parts in found.items():
            if self.kind != "central":
                self.rows.append(("sense", t, node, -1, -1))
            if self.kind == "intermittent":
                self.known[node] += [(t, *part) for part in parts]
            else:
                self.state[node] = (t, *self.update(*self.at(node, t), *self.stack(parts)))

    def tick(self, t, ticks, found):
        at = self.case["at"]
        if at == "readings":
            ticks = [[node] for node in sorted(found)]
        knows = {node: self.at(node, t) for node in self.ids} if ticks else {}
        for who in ticks:
            pairs = (
                [who]
                if at in ("links", "directions")
                else [[who[0], j] for j in sorted(self.out[who[0]])]
            )
            if at == "links":
                pairs = [who, who[::-1]]
            elif at in ("nodes", "readings"):
                number = self.sent.get(who[0], 0)
                self.sent[who[0]] = number + 1
                self.rows.append(("transmit", t, who[0], -1, number))
            for i, j in pairs:
                self.send(t, i, j, found[i] if self.kind == "intermittent" else knows[i])

    def absorb(self, t, arrived):
        boxes = {}
        for receiver, sender, number, stamp, payload in arrived:
            boxes.setdefault(receiver, []).append((sender, number, stamp, payload))
        after = {}
        for node, box in boxes.items():
            if self.kind == "intermittent":
                self.hear(t, node, box)
                continue
            self.rows += [("deliver", t, node, sender, number) for sender, number, *_ in box]
            newest = {}
            for sender, _number, stamp, payload in sorted(box, key=lambda m: (m[0], m[1])):
                newest[sender] = self.predict(*payload, t - stamp, t)
            after[node] = self.combine(node, *self.at(node, t), newest)
        for node, (x, P) in after.items():
            self.state[node] = (t, x, P)

    def hear(self, t, node, box):
        options = self.case["filter"]
        window = options.get("window", np.inf)
        for sender, number, stamp, parts in box:
            late = t - stamp
            if late > window or (late > 0.0 and options.get("late") == "drop"):
                self.rows.append(("late", t, node, sender, number))
            else:
                self.rows.append(("deliver", t, node, sender, number))
                self.known[node] += [(stamp, *part) for part in parts]

    def combine(self, node, x, P, heard):
        options = self.case["filter"]
        if self.kind == "gossip":
            return heard[max(heard)]  # in the order of ids: the last one stays
        if self.kind == "diffusion":
            weight = self.weights()
            ids, own = self.ids, self.ids.index(node)
            given = {node: weight[own, own]}
            given |= {sender: weight[ids.index(sender), own] for sender in heard}
            total = sum(given.values())
            if total == 0.0:
                return x, P
            if options.get("on_loss", "renormalise") == "renormalise":
                given = {sender: w / total for sender, w in given.items()}
            else:
                given[node] += weight[:, own].sum() - total
            terms = [(w, *(heard[s] if s != node else (x, P))) for s, w in given.items()]
            return self.intersect([term for term in terms if term[0] > 0.0])
        pi = options["epsilon"]
        terms = [(pi, *state) for state in heard.values()]
        terms.append((1.0 - pi * len(heard), x, P))
        if self.kind == "covariance-intersection":
            return self.intersect([term for term in terms if term[0] > 1e-12])
        return sum(w * x for w, x, _ in terms), sum(w * P for w, _, P in terms)

    def weights(self):
        given = self.case["filter"].get("weights", "metropolis")
        if given != "metropolis":
            return np.array(given)
        N, heard = len(self.ids), dict.fromkeys(self.ids, 0)
        for node in self.ids:
            for other in self.out[node]:
                heard[other] += 1
        W = np.zeros((N, N))
        for i, node in enumerate(self.ids):
            for other in self.out[node]:
                W[i, self.ids.index(other)] = 1.0 / (1.0 + max(heard[node], heard[other]))
        return W + np.diag(1.0 - W.sum(axis=0))


# -- scenario files -----------------------------------------------------------------------------


def write(folder, name, header, rows):
    with (folder / name).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([[repr(v) if isinstance(v, float) else v for v in row] for row in rows])
    return json.dumps(name)


def scenario_file(case, folder):
    """The scenario file of a case, with its tables."""
    n = len(case["A"])
    truth = ""
    if case.get("truth"):
        path = write(folder, "truth.csv", ["t", *(f"x{k}" for k in range(n))], case["truth"])
        truth = f"path = {path}\n"
    sensors = []
    for k, sensor in enumerate(case["sensors"]):
        p = len(sensor["R"])
        phi = sensor["H"] is None
        header = ["t", "node", *(f"y{j}" for j in range(p))]
        header += [f"phi{j}" for j in range(n)] if phi else []
        rows = [[t, node, *y, *(more or ())] for t, node, y, more in sensor["rows"]]
        H = "" if phi else f"H = {json.dumps(sensor['H'])}\n"
        sensors.append(
            f'[[sensors]]\nkind = "recorded"\nnodes = {json.dumps(sensor["nodes"])}\n'
            f"path = {write(folder, f'readings{k}.csv', header, rows)}\n"
            f"{H}R = {json.dumps(sensor['R'])}\n"
        )
    activation = '{ kind = "readings" }'
    if case["at"] != "readings":
        header = ["t", "node"] if case["at"] == "nodes" else ["t", "node", "peer"]
        path = write(folder, "ticks.csv", header, case["ticks"])
        activation = f'{{ kind = "recorded", at = "{case["at"]}", path = {path} }}'
    channel = []
    for name, column in (("loss", "delivered"), ("delay", "seconds")):
        if case[name] is not None:
            header = ["sender", "receiver", "message", column]
            path = write(folder, f"{name}.csv", header, case[name]["rows"])
            after = case[name]["after"]
            channel.append(f'{name} = {{ kind = "recorded", path = {path}, after = "{after}" }}')
    driving = ""
    if case.get("input"):
        u = dict(case["input"])
        if "rows" in u:
            header = ["t", *(f"u{k}" for k in range(len(u["G"][0])))]
            write(folder, "u.csv", header, u.pop("rows"))
            u["path"] = "u.csv"
        keys = ", ".join(f"{k} = {json.dumps(v)}" for k, v in u.items())
        driving = f"input = {{ {keys} }}\n"
    own = "".join(f"{k} = {json.dumps(case[k])}\n" for k in ("mean", "cov") if k in case)
    settings = "".join(f"{k} = {json.dumps(v)}\n" for k, v in case["filter"].items())
    model = "".join(f"{k} = {json.dumps(v)}\n" for k, v in case["model"].items())
    file = folder / "case.toml"
    directed = ", directed = true" if case["directed"] else ""
    file.write_text(
        f"""
format = 1
name = "case"
horizon = {case["horizon"]}
probe = {json.dumps(case["probe"])}

[plant]
kind = "{"recorded" if truth else "unknown"}"
A = {json.dumps(case["A"])}
B = {json.dumps(case["B"])}
{own}{truth}{driving}
{"".join(sensors)}
[network]
graph = {{ kind = "edges", edges = {json.dumps(case["edges"])}{directed} }}
activation = {activation}
channel = {{ {", ".join(channel)} }}

[filter]
{settings}
{"[filter.model]" if model else ""}
{model}
"""
    )
    return file


# -- what is drawn ------------------------------------------------------------------------------

CLOCKS = {
    "hybrid": ("links", "directions", "nodes", "readings"),
    "covariance-intersection": ("links", "directions", "nodes", "readings"),
    "gossip": ("links",),
    "intermittent": ("readings",),
    "diffusion": ("directions", "nodes", "readings"),
    "local": ("links",),
    "central": ("nodes",),
}
STEP = 0.125


def positive(random, n, least=0.2):
    M = random.normal(size=(n, n)) / np.sqrt(n)
    return M @ M.T + least * np.eye(n)


def plant(random):
    n = int(random.choice([1, 2, 2, 3]))
    kind = random.choice(["any", "unstable", "defective", "zero", "stable"])
    A = random.normal(size=(n, n))
    if kind == "unstable":
        A += 0.6 * np.eye(n)
    elif kind == "stable":
        A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(n)
    elif kind == "defective":
        A = random.choice([-1.0, 0.0, 0.4]) * np.eye(n) + np.diag(np.ones(n - 1), 1)
    elif kind == "zero":
        A = np.zeros((n, n))
    growth = np.linalg.eigvals(A).real.max()
    if growth > 1.0:  # 4 s of more are for arithmetic with more digits
        A *= 1.0 / growth
    B = random.normal(size=(n, n))
    kind = random.choice(["full", "one", "zero", "wide"])
    if kind == "one":
        B = B[:, :1]
    elif kind == "zero":
        B = np.zeros((n, 1))
    elif kind == "wide":
        B = np.concatenate([B, B[:, :1]], axis=1)
    return A, B


def moments(random, horizon, share, lattice):
    """Increasing times in (0, horizon]; on the lattice, or between its points."""
    grid = STEP * np.arange(1, round(horizon / STEP) + 1)
    chosen = grid[random.random(len(grid)) < share]
    if not lattice:
        moved = random.random(len(chosen)) < 0.5
        chosen = chosen - moved * random.random(len(chosen)) * STEP * 0.99
    return [round(float(t), 9) for t in chosen]


def graph(random, ids, directed):
    """A random tree and some more links."""
    order = [int(k) for k in random.permutation(ids)]
    edges = [[order[k], order[random.integers(k)]] for k in range(1, len(order))]
    pairs = {frozenset(edge) for edge in edges}
    for i in ids:
        for j in ids:
            if i != j and frozenset((i, j)) not in pairs and random.random() < 0.2:
                pairs.add(frozenset((i, j)))
                edges.append([i, j])
    if directed:
        edges = [edge[::-1] if random.random() < 0.5 else edge for edge in edges]
        edges += [edge[::-1] for edge in edges if random.random() < 0.5]
        # a ring makes it strongly connected
        ring = [[order[k - 1], order[k]] for k in range(len(order))]
        edges += [edge for edge in ring if edge not in edges]
    return edges


def sensors(random, ids, n, horizon, lattice):
    found = []
    for _ in range(random.integers(1, 4)):
        nodes = [int(k) for k in ids if random.random() < 0.5] or [int(ids[0])]
        phi = random.random() < 0.25
        p = 1 if phi else int(random.choice([1, 2]))
        H = random.normal(size=(p, n))
        if p == 2 and random.random() < 0.2:
            H[1] = H[0]
        rows = []
        for node in ids:
            if node not in nodes and random.random() < 0.7:
                continue
            times = moments(random, horizon, random.choice([0.1, 0.5, 0.9]), lattice)
            if random.random() < 0.4:
                times = [0.0, *times]
            for t in times:
                row = random.normal(size=n).tolist() if phi else None
                rows.append([t, node, random.normal(size=p).tolist(), row])
        if not any(row[1] in nodes for row in rows):
            rows.append([STEP, nodes[0], [0.5] * p, [1.0] * n if phi else None])
        rows = [rows[k] for k in random.permutation(len(rows))]
        H = None if phi else H.tolist()
        found.append({"nodes": nodes, "H": H, "R": positive(random, p).tolist(), "rows": rows})
    return found


def records(random, directions, lattice, column):
    rows = []
    for i, j in directions:
        if random.random() < 0.15:
            continue
        scale = int(random.choice([1, 4, 12]))
        for message in range(int(random.integers(1, 30))):
            if random.random() < 0.1:
                continue
            if column == "delivered":
                value = int(random.random() < 0.7)
            else:
                value = float(STEP * random.integers(0, scale + 1))
                if not lattice and random.random() < 0.5:
                    value = round(float(random.random() * STEP * scale), 9)
                if random.random() < 0.03:
                    value = 1e3
            rows.append([i, j, message, value])
    return {"rows": rows, "after": str(random.choice(["deliver", "lose", "repeat"]))}


def slow(case, factor):
    """All gaps grow."""
    case["horizon"] *= factor
    case["probe"] = [round(t * factor, 9) for t in case["probe"]]
    for sensor in case["sensors"]:
        for row in sensor["rows"]:
            row[0] = round(row[0] * factor, 9)
    for row in case["ticks"] or ():
        row[0] = round(row[0] * factor, 9)
    for row in case["delay"]["rows"] if case["delay"] else ():
        row[3] = round(row[3] * factor, 9)
    if "window" in case["filter"]:
        case["filter"]["window"] *= factor


def draw(seed, kind=None):
    """A case."""
    random = np.random.default_rng([2026, seed])
    kind = kind or list(CLOCKS)[seed % len(CLOCKS)]
    A, B = plant(random)
    n, lattice = len(A), bool(random.random() < 0.7)
    horizon = float(random.choice([2.0, 3.0, 4.0]))
    N = int(random.integers(2, 6))
    ids = [int(k) for k in random.choice(60, size=N, replace=False)]
    at = str(random.choice(CLOCKS[kind]))
    directed = at in ("directions", "nodes", "readings") and bool(random.random() < 0.4)
    if kind in ("local", "central"):
        directed = False
    edges = graph(random, ids, directed)
    directions = [tuple(e) for e in edges]
    if not directed:
        directions += [(j, i) for i, j in directions]
    ticks = None
    if at != "readings":
        whose = {"links": edges, "directions": directions, "nodes": [[k] for k in ids]}[at]
        ticks = []
        for who in whose:
            for t in moments(random, horizon, random.choice([0.05, 0.2, 0.5]), lattice):
                flip = at == "links" and random.random() < 0.5
                ticks.append([t, *(who[::-1] if flip else who)])
        ticks.sort(key=lambda row: row[0])
        ticks = ticks or [[STEP, *whose[0]]]
    loss = records(random, directions, lattice, "delivered") if random.random() < 0.6 else None
    delay = records(random, directions, lattice, "seconds") if random.random() < 0.7 else None
    heard = {k: sum(j == k for _, j in set(directions)) for k in ids}
    options = {"kind": kind}
    if kind in ("hybrid", "covariance-intersection"):
        share = random.choice([1.0, 0.7, 0.3])
        options["epsilon"] = float(share / max(heard.values()))
    if kind == "intermittent":
        late = random.choice(["exact", "exact", "drop", ""])
        if late:
            options["late"] = str(late)
        if random.random() < 0.4 and late != "drop":
            options["window"] = float(random.choice([0.125, 0.5, 1.0]))
    if kind == "diffusion":
        options["on_loss"] = str(random.choice(["renormalise", "keep-own"]))
        if random.random() < 0.4:
            options["weights"] = "metropolis"
        else:
            order = sorted(ids)
            W = np.zeros((N, N))
            for i, j in {*directions, *((k, k) for k in ids)}:
                W[order.index(i), order.index(j)] = 0.1 + random.random()
            options["weights"] = (W / W.sum(axis=0)).tolist()
    least = 0.2 if kind in ("covariance-intersection", "diffusion") else 0.0
    many = random.random() < 0.6 and kind != "central"
    means = random.normal(size=(N, n))
    covs = [positive(random, n, least) for _ in range(N)]
    if least == 0.0 and random.random() < 0.3:
        covs = [np.zeros((n, n)) for _ in range(N)]
    options["mean"] = (means if many else means[0]).tolist()
    options["cov"] = [c.tolist() for c in covs] if many else covs[0].tolist()
    found = sensors(random, ids, n, horizon, lattice)
    model = {}
    if random.random() < 0.35:
        model["A"] = (A + 0.1 * random.normal(size=A.shape)).tolist()
    if random.random() < 0.35:
        model["B"] = random.normal(size=(n, int(random.integers(1, 3)))).tolist()
    if random.random() < 0.35:
        model["R"] = [positive(random, len(s["R"])).tolist() for s in found]
    probe = sorted({0.0, horizon, *moments(random, horizon, 0.4, lattice)})
    case = {
        "A": A.tolist(), "B": B.tolist(), "ids": ids, "edges": edges, "directed": directed,
        "at": at, "ticks": ticks, "loss": loss, "delay": delay, "horizon": horizon,
        "probe": [float(t) for t in probe], "sensors": found, "filter": options, "model": model,
    }  # fmt: skip
    if random.random() < 0.15 and not model:
        for name in ("mean", "cov"):
            case[name] = np.array(options[name] if not many else options[name][0]).tolist()
            if not many:
                del options[name]
    if np.linalg.eigvals(np.array(model.get("A", A))).real.max() < 0.1 and random.random() < 0.3:
        slow(case, 16.0)
    if random.random() < 0.3:
        case["truth"] = [[t, *random.normal(size=n).tolist()] for t in case["probe"]]
    add_input(case, np.random.default_rng([2027, seed]))
    return case


def add_input(case, random):
    """Of two cases in three; sometimes filters do not know it."""
    kind = str(random.choice(["constant", "sine", "recorded"]))
    m, n = int(random.integers(1, 3)), len(case["A"])
    case["input"] = u = {"kind": kind, "G": random.normal(size=(n, m)).tolist()}
    if kind == "constant":
        u["value"] = random.normal(size=m).tolist()
    elif kind == "sine":
        u["amplitude"], u["phase"] = random.normal(size=(2, m)).tolist()
        u["frequency"] = (2.0 * random.random(m)).tolist()
    else:
        times = moments(random, case["horizon"], 0.3, random.random() < 0.5) or [STEP]
        u["rows"] = [[t, *random.normal(size=m).tolist()] for t in times]
        u["rows"] = [u["rows"][k] for k in random.permutation(len(times))]
    if random.random() < 0.33:
        del case["input"]
    elif random.random() < 0.1:
        case["model"]["input"] = False


# -- comparing ----------------------------------------------------------------------------------


def difference(case, reference, run):
    """The largest relative difference, and what else does not agree, in words."""
    words = []
    assert run.xhat.shape == reference.xhat.shape, (run.xhat.shape, reference.xhat.shape)
    scale = 1.0 + np.abs(reference.P).max(axis=(2, 3), keepdims=True)
    off = float((np.abs(run.P - reference.P) / scale).max())
    scale = 1.0 + np.abs(reference.xhat).max(axis=2, keepdims=True)
    off = max(off, float((np.abs(run.xhat - reference.xhat) / scale).max()))
    if case.get("truth"):
        if not np.array_equal(run.x, np.array(case["truth"])[:, 1:]):
            words.append("truth")
    elif not np.isnan(run.x).all():
        words.append("x known")
    kinds = {"send", "lost", "deliver", "late", "transmit", "sense"}
    if case["filter"]["kind"] == "central":
        kinds = set()
    columns = (run.events[name].tolist() for name in ("kind", "t", "node", "peer", "message"))
    seen = Counter(row for row in zip(*columns, strict=True) if row[0] in kinds)
    wanted = Counter(row for row in reference.rows if row[0] in kinds)
    if seen != wanted:
        more, less = list((seen - wanted).elements()), list((wanted - seen).elements())
        words.append(f"rows beyond {more[:3]}, missing {less[:3]}")
    return off, words


@pytest.mark.one_in(2)
@pytest.mark.parametrize("seed", range(42))
def test_drawn_cases(seed, tmp_path):
    case = draw(seed)
    reference = Reference(case).run()
    scenario = netkf.load(scenario_file(case, tmp_path))
    for engine in ("simpy", "auto"):
        run = netkf.simulate(scenario, engine=engine)
        assert run.status == "complete"
        off, words = difference(case, reference, run)
        assert off < 1e-9
        assert not words
