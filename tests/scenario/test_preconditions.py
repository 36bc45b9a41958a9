"""What filters need of sensors, start and network: all filters against all that may be missing.

Each pair is refused in one line before anything runs, or it runs and P is the covariance of the
error. That is computed here without netkf's theory: estimates are linear in the readings, so runs
with one reading of 1 each give the weights of all readings, and the law of states and readings is
a matter of plain matrices.
"""

import itertools

import numpy as np
import pytest

import netkf
from netkf.algorithms.registry import default_timing
from netkf.parts import kinds
from netkf.scenario.reading import from_table

OWN = {
    "belief-propagation": {},
    "constant-gain": {"gain": [[0.3], [0.2]]},
    "covariance-intersection": {"epsilon": 0.3},
    "event-triggered trigger=stochastic": {"inner": {"kind": "intermittent"}, "Y": 1.0},
    "hcmci": {"consensus": "information"},
    "hybrid": {"epsilon": 0.3},
    "icf": {"steps": 1},
    "kcf": {"epsilon": 0.1},
    "push-sum": {"gamma": 2, "delta": 4.5},
}
OF_OWN_BLOCKS = ("block-belief-propagation", "block-cross-covariances")
FILTERS = {
    name: {"kind": kind, **dict(c.split("=") for c in choice), **OWN.get(name, {})}
    for name in kinds()["filter"]
    for kind, *choice in [name.split(" ")]
    if name not in OF_OWN_BLOCKS
}
INNER = {
    f"trigger around {name}": {
        "kind": "event-triggered", "trigger": "stochastic", "Y": 1.0, "inner": table
    }
    for name, table in FILTERS.items()
    if name in ("consensus-innovations", "constant-gain", "diffusion", "kcf", "one-bit", "push-sum")
    or name.startswith("track-fusion")
}  # fmt: skip
ALL = {**FILTERS, **INNER}

SLOTS = 3
F, Q, R = np.array([[0.9, 0.4], [-0.2, 0.8]]), 0.1 * np.eye(2), 0.2
H = {0: [1.0, 0.0], 2: [0.5, 1.0]}
PATH = {"kind": "path", "nodes": 4}
TRIANGLE = {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 0], [0, 3]], "directed": True}


class Case:
    """A scenario with one circumstance that some filters cannot bear."""

    def __init__(self, plant=(), graph=PATH, skip=(), phi=False, sensors=None, **filter):
        self.plant, self.graph, self.phi, self.sensors, self.filter = (
            dict(plant), graph, phi, sensors, filter
        )  # fmt: skip
        self.rows = [
            (slot, node) for slot in range(SLOTS + 1) for node in (0, 2) if (slot, node) not in skip
        ]

    def row_of(self, slot, node):
        """H of a reading."""
        return [1.0 + slot, 1.0 - slot] if self.phi else H[node]

    def plant_table(self):
        continuous = {
            "kind": "diffusion",
            "A": [[-0.1, 0.4], [-0.2, -0.2]],
            "B": np.eye(2).tolist(),
        }
        slots = {"kind": "unknown", "F": F.tolist(), "Q": Q.tolist(), "period": 1.0}
        start = {"mean": [0.0, 0.0], "cov": [[1.0, 0.0], [0.0, 1.0]]}
        return {**slots, **start, **self.plant}, {**continuous, **start}

    def scenario(self, table, folder, ones=()):
        """The scenario of a filter ``table`` in slots, whose readings are 0 except those at the
        indices ``ones``, which are 1.
        """
        plant, _ = self.plant_table()
        sensors = self.sensors
        if sensors is None:
            name = f"{len(list(folder.iterdir()))}.csv"
            lines = ["t,node,y0" + (",phi0,phi1" if self.phi else "")]
            for k, (slot, node) in enumerate(self.rows):
                row = self.row_of(slot, node) if self.phi else []
                lines.append(",".join(map(str, [float(slot), node, float(k in ones), *row])))
            (folder / name).write_text("\n".join(lines) + "\n")
            recorded = {"kind": "recorded", "path": name, "R": [[R]]}
            sensors = [
                {**recorded, "nodes": [node], **({} if self.phi else {"H": [H[node]]})}
                for node in H
                if any(node == other for _, other in self.rows)
            ]
        else:
            plant["kind"] = "linear"
        inner = table.get("inner", table)
        pairs = inner["kind"] == "gossip"
        activation = {"kind": "matching", "protocol": "maximal"} if pairs else {"kind": "broadcast"}
        tables = {
            "format": 1, "name": "cross", "horizon": SLOTS + 0.5, "probe": 1.0, "plant": plant,
            "sensors": sensors, "network": {"graph": self.graph, "activation": activation},
            "filter": {**table, **self.filter},
        }  # fmt: skip
        return from_table(tables, folder)

    def covariance(self, weights, slots):
        """Covariance (n, n) of x - sum_k w_k y_k in slot ``slots``, with weights (n, K)."""
        plant, _ = self.plant_table()
        M, noise, start = (np.array(plant[name]) for name in ("F", "Q", "cov"))
        # x_k = M^k x_0 + sum_j M^(k - j) w_j, all from independent blocks (x_0, w_1, ..., w_slots).
        power = [np.linalg.matrix_power(M, k) for k in range(slots + 1)]
        states = [
            np.hstack([power[k], *(power[k - j] if j <= k else 0 * M for j in range(1, slots + 1))])
            for k in range(slots + 1)
        ]
        error = states[slots].copy()
        for k, (slot, node) in enumerate(self.rows):
            if weights[:, k].any():
                error -= np.outer(weights[:, k], np.array(self.row_of(slot, node)) @ states[slot])
        law = np.kron(np.eye(slots + 1), noise)
        law[:2, :2] = start
        return error @ law @ error.T + R * weights @ weights.T


CASES = {
    "all is there": Case(),
    "missing rows": Case(skip={(1, 0), (2, 2)}),
    "columns phi": Case(phi=True),
    "columns phi, missing rows": Case(phi=True, skip={(1, 0), (2, 2)}),
    "a directed graph": Case(graph=TRIANGLE),
    "another cov at each node": Case(cov=[(k * np.eye(2)).tolist() for k in (1, 2, 3, 4)]),
    "another mean at each node": Case(mean=[[0.0, 0.0]] * 3 + [[1.0, 0.0]]),
    "a singular cov": Case(
        plant={"F": [[1.0, 0.0], [0.0, 1.0]], "Q": [[0.1, 0.1], [0.1, 0.1]],
               "cov": [[1.0, 1.0], [1.0, 1.0]]}
    ),
    "one node": Case(
        graph={"kind": "edges", "edges": [], "nodes": 1}, skip={(k, 2) for k in range(SLOTS + 1)}
    ),
    "no sensor": Case(sensors=[]),
    "bearings": Case(
        sensors=[{"kind": "bearing", "nodes": [0], "R": [[0.01]], "positions": [[3.0, 1.0]]}]
    ),
    "regressors": Case(
        sensors=[{
            "kind": "regressor", "nodes": [0, 2], "A": [[0.5]], "B": [[1.0]], "C": [[1.0], [0.5]],
            "start": [1.0], "xi_cov": [[1.0]], "R": [[0.2]],
        }]
    ),
}  # fmt: skip

ONLY_CLOCKS = {"hybrid", "covariance-intersection"}
FIXED = {"consensus-innovations", "constant-gain", "push-sum", "track-fusion rule=cross-covariance",
         "event-triggered trigger=stochastic"}  # fmt: skip
SENT_ONLY = {"one-bit", "event-triggered trigger=stochastic"}
COMMON = {"consensus-innovations", "track-fusion rule=cross-covariance"}
INVERTING = {"belief-propagation", "diffusion", "event-triggered trigger=consensus", "hcmci", "icf",
             "track-fusion rule=ci", "track-fusion rule=ici"}  # fmt: skip
UNDIRECTED = {"gossip", "icf", "push-sum"}
REFUSED = {
    "missing rows": FIXED,
    "columns phi": FIXED,
    "columns phi, missing rows": FIXED,
    "bearings": FIXED,
    "regressors": FIXED,
    "a directed graph": UNDIRECTED,
    "another cov at each node": COMMON | {"central"},
    "another mean at each node": COMMON | {"central"},
    "a singular cov": INVERTING,
    "one node": SENT_ONLY,
}


def wrapped(name):
    return name.removeprefix("trigger around ")


def is_refused(name, case):
    return wrapped(name) in ONLY_CLOCKS | REFUSED.get(case, set())


@pytest.mark.one_in(12)
@pytest.mark.parametrize("case", CASES)
def test_every_filter_is_refused_in_one_line_or_runs(case, tmp_path):
    for name, table in ALL.items():
        if is_refused(name, case):
            with pytest.raises(netkf.ScenarioError) as caught:
                CASES[case].scenario(table, tmp_path)
            text = str(caught.value)
            assert "\n" not in text
            assert "; " in text
            kind = table["kind"]
            assert kind in text or "filter that all nodes share" in text, (name, text)
            assert wrapped(name).split(" ")[0] in text or kind == "central", (name, text)
        else:
            run = netkf.simulate(CASES[case].scenario(table, tmp_path), engine="simpy")
            assert np.isfinite(run.xhat).all(), name
            assert np.isfinite(run.P).all(), name


EXACT = {"central", "consensus-innovations", "gossip", "intermittent", "local",
         "track-fusion rule=cross-covariance"}  # fmt: skip
"""Filters whose P is the covariance of the error where no message is lost."""
LARGER = {"constant-gain", "diffusion", "hcmci", "track-fusion rule=ci"}
LINEAR = ["all is there", "missing rows", "columns phi", "columns phi, missing rows",
          "a directed graph", "a singular cov", "one node"]  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("case", LINEAR)
def test_P_is_the_covariance_of_the_error(case, tmp_path):
    one = CASES[case]
    for name in sorted(EXACT | LARGER):
        if is_refused(name, case):
            continue
        runs = [
            netkf.simulate(one.scenario(FILTERS[name], tmp_path, ones), engine="simpy")
            for ones in [(), *([k] for k in range(len(one.rows)))]
        ]
        assert not runs[0].xhat.any()
        weights = np.stack([run.xhat for run in runs[1:]], axis=-1)
        for t, i in itertools.product(range(1, SLOTS + 1), range(len(runs[0].nodes))):
            true, P = one.covariance(weights[t, i], t), runs[0].P[t, i]
            if name in EXACT:
                np.testing.assert_allclose(P, true, rtol=1e-8, atol=1e-10, err_msg=name)
            else:
                assert np.linalg.eigvalsh(P - true)[0] > -1e-10, name
        assert weights[-1].any(), name


CLOCKS = {
    **{at: {"kind": "poisson", "rate": 2.0, "at": at} for at in ("links", "directions", "nodes")},
    "readings": {"kind": "readings"},
}
SAMPLED = {"nodes": [0, 2], "H": [[1.0, 0.0]], "R": [[0.2]],
           "sampling": {"kind": "periodic", "period": 0.5}}  # fmt: skip
RECORDED = {"kind": "recorded", "path": "phi.csv", "R": [[0.2]]}
LINE = {"kind": "edges", "edges": [[0, 1], [1, 2]], "directed": True}
CONTINUOUS = {
    "all is there": {},
    "columns phi": {"sensors": [RECORDED]},
    "bearings": {"sensors": [{"kind": "bearing", "nodes": [0], "R": [[0.01]],
                              "positions": [[3.0, 1.0]], "sampling": SAMPLED["sampling"]}]},
    "a singular cov": {"plant": {"A": [[0.0, 0.0], [0.0, 0.0]], "B": [[1.0], [1.0]],
                                 "cov": [[1.0, 1.0], [1.0, 1.0]]}},
    "a directed line": {"graph": LINE},
    "one node": {"graph": {"kind": "edges", "edges": [], "nodes": 1},
                 "sensors": [{**SAMPLED, "nodes": [0]}]},
    "no sensor": {"sensors": []},
}  # fmt: skip
REFUSED_UNDER_CLOCKS = {
    "columns phi": {"constant-gain", "push-sum"},
    "bearings": {"constant-gain", "push-sum"},
    "a singular cov": {"covariance-intersection", "diffusion", "hcmci", "push-sum",
                       "track-fusion rule=ci", "track-fusion rule=ici"},
    "a directed line": {"gossip", "push-sum"},
}  # fmt: skip


@pytest.mark.parametrize("kind", OF_OWN_BLOCKS)
def test_filters_of_own_blocks_refuse_one_plant_for_all_nodes(kind, tmp_path):
    rule = f"filter.estimates: must give each block to one node alone for the {kind}"
    with pytest.raises(netkf.ScenarioError, match=rule):
        CASES["all is there"].scenario({"kind": kind}, tmp_path)


@pytest.mark.one_in(9)
@pytest.mark.parametrize("case", CONTINUOUS)
def test_every_filter_under_clocks_is_refused_in_one_line_or_runs(case, tmp_path):
    lines = ["t,node,y0,phi0,phi1", *(f"{0.3 * k},{k % 3},0.5,1.0,{k}" for k in range(1, 9))]
    (tmp_path / "phi.csv").write_text("\n".join(lines) + "\n")
    change = CONTINUOUS[case]
    plant = {"kind": "diffusion", "A": [[-0.1, 0.4], [-0.2, -0.2]], "B": [[0.3, 0.0], [0.0, 0.3]],
             "cov": [[1.0, 0.0], [0.0, 1.0]], **change.get("plant", {})}  # fmt: skip
    ran = 0
    for (name, table), (at, clock) in itertools.product(FILTERS.items(), CLOCKS.items()):
        timing = default_timing(kinds()["filter"][name])
        if timing is None:  # that of the filter which a trigger wraps: in slots only
            assert name == "event-triggered trigger=stochastic"
            continue
        memory = name == "belief-propagation"  # needs a plant without noise
        if memory or at not in (timing.clocks if timing.talks else ("links",)):
            continue
        if at == "readings" and case == "no sensor":
            continue
        graph = change.get("graph", PATH)
        if graph is LINE and at == "links":
            continue
        tables = {
            "format": 1, "name": "cross", "horizon": 1.0, "probe": 0.5, "plant": plant,
            "sensors": change.get("sensors", [SAMPLED]), "filter": table,
            "network": {"graph": graph, "activation": clock},
        }  # fmt: skip
        if name in REFUSED_UNDER_CLOCKS.get(case, set()):
            with pytest.raises(netkf.ScenarioError, match=f"the {table['kind']}"):
                from_table(tables, tmp_path)
        else:
            run = netkf.simulate(from_table(tables, tmp_path), engine="simpy")
            assert np.isfinite(run.xhat).all(), (name, at)
            assert np.isfinite(run.P).all(), (name, at)
            ran += 1
    assert ran > 10


@pytest.mark.parametrize(("weight", "nees"), [({}, 4.0), ({"novelty_weight": 2.0}, 2.0)])
def test_readings_that_count_for_nodes_of_other_parts_are_noted(build, weight, nees):
    """Two pairs of nodes, with readings that count for four of them, or for two."""
    sensors = [{"nodes": [0, 1, 2, 3], "H": np.eye(2).tolist(), "R": (R * np.eye(2)).tolist()}]
    scenario = build(
        horizon=6.0,
        probe=1.0,
        plant={"kind": "linear", "period": 1.0, "F": np.eye(2).tolist(), "Q": Q.tolist()},
        sensors=sensors,
        network={
            "graph": {"kind": "edges", "nodes": 4, "edges": [[0, 1], [2, 3]]},
            "activation": {"kind": "broadcast"},
        },
        filter={"kind": "hcmci", "steps": 8, **weight},
    )
    assert any("the graph has 2 parts" in note for note in scenario.notes) == (not weight)
    found = netkf.monte_carlo(scenario, 400, workers=1).mean_nees[-1]
    np.testing.assert_allclose(found, nees, rtol=0.25)
