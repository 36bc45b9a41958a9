"""Nodes that estimate blocks of their own: readings of pairs, covariance intersection of three
kinds, and samples of nodes with states of different size.

The truth is not ours: plain scalar recursions in information form, the Kalman filter of all blocks,
and the errors of many runs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

import netkf
from netkf.scenario.writing import as_table, to_toml
from tests.conftest import with_slow

RULES = ["split", "ci", "naive"]
ROBOTS = """
format = 1
name = "robots on a line"
horizon = 12.0
probe = 1.0
seed = 5
[[plants]]
name = "pose"
nodes = [1, 2, 3]
F = [[0.9]]
Q = [[0.2]]
period = 1.0
cov = [[1.0]]
[[sensors]]
of = "pose"
nodes = [1]
H = [[1.0]]
R = [[0.1]]
[[sensors]]
kind = "relative"
of = "pose"
R = [[0.3]]
[network]
graph = { kind = "edges", edges = [[1, 2], [2, 3]] }
activation = { kind = "broadcast" }
[filter]
kind = "block-intersection"
estimates = "own"
"""
CLOCKED = ROBOTS.replace("F = [[0.9]]\nQ = [[0.2]]\nperiod = 1.0", "A = [[-0.1]]\nB = [[0.5]]")
CLOCKED = CLOCKED.replace(
    "R = [[0.1]]", "R = [[0.1]]\nsampling = { kind = 'periodic', period = 1.0 }"
)
CLOCKED = CLOCKED.replace(
    "R = [[0.3]]", "R = [[0.3]]\nsampling = { kind = 'periodic', period = 0.5 }"
)
CLOCKED = CLOCKED.replace('"broadcast"', '"readings"')


def load(text: str, folder: Path, **changes: object) -> netkf.Scenario:
    path = folder / "scenario.toml"
    path.write_text(text)
    return netkf.load(path, {key.replace("__", "."): value for key, value in changes.items()})


class Scalar:
    """A scalar estimate with the variance P = told + own in information form."""

    def __init__(self, rule: str) -> None:
        self.rule, self.x, self.told, self.own = rule, 0.0, 0.0, 1.0
        self._join()

    @property
    def P(self) -> float:
        return self.told + self.own

    def _join(self) -> None:
        if self.rule == "ci":
            self.told, self.own = self.P, 0.0
        if self.rule == "naive":
            self.told, self.own = 0.0, self.P

    def predict(self) -> None:
        self.x, self.told, self.own = 0.9 * self.x, 0.81 * self.told, 0.81 * self.own + 0.2
        self._join()

    def use(self, z: float, dependent: float, heard: float, noise: float) -> None:
        """Use z = x + e, with parts of var(e) that are unknown to correlate, kept by the sender and
        nobody else's.
        """

        def parts(w: float, v: float) -> tuple[float, float]:
            return self.told / w + self.own, dependent / v + heard + noise

        def variance(w: float) -> float:
            P, C = parts(w, 1.0 - w)
            return 1.0 / (1.0 / P + 1.0 / C)

        P, C = parts(1.0, 1.0)
        if self.told and dependent:
            w = minimize_scalar(variance, bounds=(1e-6, 1 - 1e-6), options={"xatol": 1e-11}).x
            w = min((w, 1e-6, 1 - 1e-6), key=variance)
            if variance(w) >= self.P:
                return
            P, C = parts(w, 1.0 - w)
        K = P / (P + C)
        after = P * C / (P + C)
        self.x += K * (z - self.x)
        own = (1.0 - K) ** 2 * self.own + K**2 * noise
        self.told, self.own = after - own, own
        self._join()


@pytest.mark.parametrize("rule", RULES)
def test_own_states_follow_a_scalar_recursion(tmp_path: Path, rule: str) -> None:
    readings = {
        (1, None): [0.4, -0.2, 0.3, 0.1, -0.5],
        (1, 2): [0.7, 0.2, -0.1, 0.3, 0.9],
        (2, 1): [-0.6, -0.4, 0.2, 0.1, -0.8],
        (2, 3): [1.1, 0.8, 1.3, 0.6, 0.2],
        (3, 2): [-0.9, -1.2, -1.0, -0.7, -0.1],
    }
    pairs = [f"{k + 1},{i},{j},{y[k]}" for (i, j), y in readings.items() if j for k in range(5)]
    (tmp_path / "pairs.csv").write_text("t,node,to,y0\n" + "\n".join(pairs) + "\n")
    own = [f"{k + 1},1,{y}" for k, y in enumerate(readings[1, None])]
    (tmp_path / "own.csv").write_text("t,node,y0\n" + "\n".join(own) + "\n")
    text = ROBOTS.replace('of = "pose"\nnodes = [1]', 'kind = "recorded"\npath = "own.csv"')
    text = text.replace('kind = "relative"', 'kind = "relative"\npath = "pairs.csv"')
    scenario = load(text, tmp_path, horizon=6.0, filter__rule=rule)
    run = netkf.simulate(scenario)
    nodes = {node: Scalar(rule) for node in (1, 2, 3)}
    for k in range(5):
        for node in nodes.values():
            node.predict()
        nodes[1].use(readings[1, None][k], 0.0, 0.0, 0.1)
        sent = {i: (node.x, node.told, node.own) for i, node in nodes.items()}
        for node in nodes.values():
            node.told, node.own = node.P, 0.0
            node._join()
        for j, node in nodes.items():
            for i in sorted(nodes):
                if (i, j) in readings:
                    x, told, unsent = sent[i]
                    node.use(readings[i, j][k] + x, told, unsent, 0.3)
        expected = [(node.x, node.P) for node in nodes.values()]
        seen = np.stack([run.xhat[k + 1, :, 0], run.P[k + 1, :, 0, 0]], axis=1)
        np.testing.assert_allclose(seen, expected, rtol=1e-7)


@pytest.mark.parametrize("text", [ROBOTS, CLOCKED])
def test_a_first_message_is_used_as_the_central_filter_would(tmp_path: Path, text: str) -> None:
    text = text.replace("R = [[0.3]]", "R = [[0.3]]\nto = [[1, 2]]").replace(
        "period = 0.5", "period = 1.0"
    )
    own = netkf.simulate(load(text, tmp_path))
    all_blocks = netkf.simulate(load(text, tmp_path, filter={"kind": "central"}))
    # Node 1 does not hear of the reading that it took, which is about node 2 alone.
    assert own.P[1, 1, 0, 0] == pytest.approx(all_blocks.P[1, 0, 1, 1], rel=1e-12)
    assert own.block("pose", 2).xhat[1, 0] == pytest.approx(all_blocks.xhat[1, 0, 1], rel=1e-9)
    assert own.P[1, 0, 0, 0] > all_blocks.P[1, 0, 0, 0]


TWO = {"plants__0__nodes": [1, 2], "network__graph": {"kind": "edges", "edges": [[1, 2]]}}
KEPT = {"kind": "block-cross-covariances"}
BELIEF = {"kind": "block-belief-propagation", "window": 40}
BLOCK_FILTERS = {
    **{
        f"{rule} {estimates}": ({"rule": rule, "estimates": estimates}, {}, "above")
        for rule in ("split", "ci")
        for estimates in ("own", "own+neighbours", "pose")
    },
    # Of three nodes nothing is promised, see test_block_cross_covariances.
    "cross-covariances of two": (KEPT, TWO, "equal"),
    "belief propagation of two": (BELIEF, TWO, "equal"),
    "belief propagation as wide as the tree": (BELIEF | {"steps": 2}, {}, "equal in slots"),
    "belief propagation step by step": (BELIEF, {}, "above"),
    "belief propagation that forgets": (BELIEF | {"window": 2}, {}, "above"),
}
"""Settings of filters of blocks, changes of a scenario, and how P is to that of all blocks."""


@pytest.mark.one_in(10)
@pytest.mark.parametrize("name", with_slow(BLOCK_FILTERS, {"cross-covariances of two"}))
@pytest.mark.parametrize("text", [ROBOTS, CLOCKED], ids=["slots", "clocks"])
def test_no_block_filter_is_below_the_stacked_kalman_filter(
    tmp_path: Path, name: str, text: str
) -> None:
    settings, changes, relation = BLOCK_FILTERS[name]
    keys: dict[str, object] = {"kind": "block-intersection", "estimates": "own"} | settings
    if keys["estimates"] == "pose":
        keys["estimates"] = ["pose"]
    scenario = load(text, tmp_path, **changes, filter=keys)
    run = netkf.simulate(scenario)
    central = netkf.simulate(load(text, tmp_path, **changes, filter={"kind": "central"}))
    equal = relation == "equal" or (relation == "equal in slots" and text is ROBOTS)
    assert scenario.views is not None
    difference = 0.0
    for k, view in enumerate(scenario.views):
        n = len(view)
        above = run.P[:, k, :n, :n] - central.P[:, 0][:, view][:, :, view]
        assert np.linalg.eigvalsh(above).min() > -1e-12
        difference = max(difference, float(np.abs(above).max()))
        if equal:
            np.testing.assert_allclose(run.xhat[:, k, :n], central.xhat[:, 0, view], atol=1e-9)
        np.testing.assert_array_equal(run.x[:, view] - run.xhat[:, k, :n], run.error[:, k, :n])
        assert np.isnan(run.xhat[:, k, n:]).all()
    assert (difference < 1e-9) == equal


@pytest.mark.slow
@pytest.mark.parametrize("estimates", ["own", "own+neighbours"])
def test_only_the_naive_update_is_overconfident(tmp_path: Path, estimates: str) -> None:
    # Where covariances are split, runs take much longer; a P like the naive one is found by twelve.
    level, filters = 1e-4, [({"rule": rule}, 40 if rule == "naive" else 12) for rule in RULES]
    # In a row of three nodes P of cross-covariances is off by a few percent.
    filters += [(KEPT, 12)] if estimates == "own" else []
    for settings, runs in filters:
        # Little noise of the plant: the same errors go round for long.
        keys = {"kind": "block-intersection", "estimates": estimates} | settings
        changes = {"plants__0__F": [[1.0]], "plants__0__Q": [[0.01]], "filter": keys}
        scenario = load(ROBOTS, tmp_path, **changes)
        assert scenario.views is not None
        ensemble = netkf.monte_carlo(scenario, runs, workers=1)
        n = np.array([len(view) for view in scenario.views])
        # Of all nodes at the last sample, each at a share of the level: the errors of one node at
        # one time are independent over the runs. A naive P is too small by a third and more.
        upper = chi2.ppf(1.0 - level / len(n), runs * n) / runs
        too_small = (ensemble.mean_nees[-1] > upper).any()
        assert too_small == (settings.get("rule") == "naive"), (settings, ensemble)


def test_a_node_that_forgets_does_not_take_its_past_for_news(tmp_path: Path) -> None:
    # At rest, so that mean and cov are the law of x when a node begins again.
    lives = "".join(f"{k}.2,1,down\n{k}.4,1,up\n" for k in range(2, 10))
    (tmp_path / "lives.csv").write_text("t,node,what\n" + lives)
    life = {"kind": "recorded", "nodes": [1], "path": "lives.csv", "memory": "lost"}
    text = ROBOTS.replace("[[0.9]]", "[[0.995]]").replace("[[0.2]]", f"[[{1.0 - 0.995**2}]]")
    text = text.replace("[[0.1]]", "[[3.0]]").replace("[[0.3]]", "[[0.01]]")
    scenario = load(text, tmp_path, network__lives=[life])
    runs = 60
    ensemble = netkf.monte_carlo(scenario, runs, workers=1)
    # Each at 1e-6; the squared errors of nodes that are told old news as new ones are four times P.
    assert (ensemble.mean_nees < chi2.ppf(1.0 - 1e-6, runs) / runs).all()


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("text", [ROBOTS, CLOCKED], ids=["slots", "clocks"])
def test_all_that_a_message_tells_is_used_at_once(tmp_path: Path, text: str, rule: str) -> None:
    """The sender's error is in each of its readings of the receiver, and in its estimates."""
    changes = {"filter__kind": "block-intersection", "filter__rule": rule}
    one = load(text, tmp_path, **changes)
    relative = as_table(one)["sensors"][1]
    both = {"H": [[1.0], [1.0]], "R": [[0.3, 0.0], [0.0, 0.05]]}
    parts = [{"H": [[1.0]], "R": [[R]]} for R in (0.3, 0.05)]
    stacked, parted = (
        one.replace({"sensors": [as_table(one)["sensors"][0], *({**relative, **p} for p in some)]})
        for some in ([both], parts)
    )
    run = netkf.simulate(parted)
    np.testing.assert_allclose(run.P, netkf.simulate(stacked).P, rtol=1e-9)
    gap = np.linalg.eigvalsh(run.P - netkf.theory.error_covariance(parted, run))
    assert (gap >= -1e-9).all() or rule == "naive"


def test_tables_have_the_blocks_of_each_node(tmp_path: Path) -> None:
    scenario = load(ROBOTS, tmp_path, filter__estimates="own+neighbours")
    run = netkf.simulate(scenario)
    assert run.xhat.shape == (13, 3, 3)
    states = run.states[run.states.t == 12.0].set_index("node")
    assert states.loc[1, ["x0", "x1"]].tolist() == run.x[-1, [0, 1]].tolist()
    assert states.loc[3, ["x0", "x1"]].tolist() == run.x[-1, [2, 1]].tolist()
    assert states.loc[3, ["x2", "xhat2", "P22"]].isna().all()
    # NEES of the two states that the node has, by hand.
    e, P = run.error[-1, 2, :2], run.P[-1, 2, :2, :2]
    assert states.loc[3, "nees"] == pytest.approx(e @ np.linalg.solve(P, e))
    assert states.loc[3, "sq_error"] == pytest.approx(e @ e)
    block = run.block("pose", 2, by=3)
    np.testing.assert_array_equal(block.xhat[:, 0], run.xhat[:, 2, 1])
    np.testing.assert_array_equal(block.x[:, 0], run.x[:, 1])
    with pytest.raises(netkf.ScenarioError, match="must estimate block 'pose'"):
        run.block("pose", 3, by=1)
    stored = netkf.open(netkf.save(run, scenario, tmp_path / "out"))
    for name in ("x", "xhat", "P", "nees"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(run, name))
    again = load(to_toml(as_table(scenario)), tmp_path)
    assert netkf.simulate(again).fingerprint == run.fingerprint


def test_shared_blocks_are_estimated_by_any_filter(tmp_path: Path) -> None:
    target = '[[plants]]\nname = "target"\nF = [[0.95]]\nQ = [[0.1]]\nperiod = 1.0\ncov = [[2.0]]\n'
    sensor = '[[sensors]]\nof = "target"\nnodes = [1, 3]\nH = [[1.0]]\nR = [[0.2]]\n'
    text = ROBOTS.replace("[[sensors]]", target + sensor + "[[sensors]]", 1)
    begin, end = text.index('[[sensors]]\nof = "pose"'), text.index("[network]")
    text = text[:begin] + text[end:]
    with pytest.raises(netkf.ScenarioError, match=r'estimates = \["pose", "target"\] or "all"'):
        load(text, tmp_path, filter={"kind": "block-intersection", "estimates": "own"})
    one_each = {"kind": "block-cross-covariances", "estimates": "own"}
    with pytest.raises(
        netkf.ScenarioError, match=r'or write kind = "diffusion", estimates = "all"'
    ):
        load(text, tmp_path, filter=one_each)
    # What is advised helps: the neighbours' blocks are not the shared one.
    near = {"kind": "local", "estimates": "own+neighbours"}
    with pytest.raises(netkf.ScenarioError, match=r'write filter.estimates = \["pose", "target"\]'):
        load(text, tmp_path, filter=near)
    shared = {"filter": {"kind": "kcf", "estimates": "shared"}}
    run = netkf.simulate(load(text, tmp_path, **shared))
    alone = text[: text.index("[[plants]]")] + text[text.index(target) :]
    whole = netkf.simulate(load(alone, tmp_path, filter={"kind": "kcf"}), engine="simpy")
    np.testing.assert_allclose(run.P, whole.P, rtol=1e-12)
    assert run.xhat.shape == whole.xhat.shape


@pytest.mark.parametrize(
    ("changes", "key", "rule"),
    [
        ({"filter": {"kind": "hybrid", "epsilon": 0.2, "estimates": "own"}}, "filter", ""),
        ({"filter": {"kind": "kcf", "estimates": "own"}}, "filter.estimates", "say no blocks"),
        ({"filter": {"kind": "local", "estimates": "own"}}, "sensors[1]", "must read blocks"),
        ({"filter__estimates": "shared"}, "filter.estimates", "node 1 has none"),
        ({"filter__estimates": "ours"}, "filter.estimates", 'must be "all", "own"'),
        ({"filter__estimates": ["poses"]}, "filter.estimates", "name of one of"),
        ({"plants__0__nodes": [1, 2]}, "filter.estimates", "node 3 has none"),
        (
            {"plants__0__coupling": [{"from": [2], "A": [[0.1]]}]},
            "filter.estimates",
            "must contain all that drives",
        ),
    ],
)
def test_mistakes_about_blocks_are_named(
    tmp_path: Path, changes: dict[str, object], key: str, rule: str
) -> None:
    with pytest.raises(netkf.ScenarioError) as caught:
        load(ROBOTS, tmp_path, **changes)
    assert caught.value.key.startswith(key)
    assert rule in str(caught.value)


PLANAR = """
format = 1
name = "planar"
horizon = 4.0
probe = 1.0
[[plants]]
name = "position"
nodes = [1, 2]
F = [[1.0, 0.0], [0.0, 1.0]]
Q = [[0.1, 0.0], [0.0, 0.1]]
period = 1.0
cov = [[0.2, 0.0], [0.0, 0.2]]
[[sensors]]
kind = "relative-range-bearing"
path = "sights.csv"
R = [[0.04, 0.0], [0.0, 0.01]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "broadcast" }
[filter]
kind = "block-intersection"
estimates = "own"
mean = [0.0, 0.0, 3.0, 4.0]
"""


@pytest.mark.slow
@pytest.mark.parametrize("settings", [KEPT, BELIEF])
def test_ranges_and_bearings_of_pairs_are_those_of_the_extended_kalman_filter(
    tmp_path: Path, settings: dict[str, object]
) -> None:
    (tmp_path / "sights.csv").write_text("t,node,to,y0,y1\n1,1,2,5.2,0.95\n2,2,1,5.3,-2.1\n")
    mean = [0.0, 0.0, 3.0, 4.0]
    own = settings | {"estimates": "own", "mean": mean}
    run = netkf.simulate(load(PLANAR, tmp_path, filter=own))
    stacked = netkf.simulate(load(PLANAR, tmp_path, filter={"kind": "central", "mean": mean}))
    # Beliefs are linearised anew, at what is known now.
    last = 1 if settings is BELIEF else 4
    for k, entries in enumerate((slice(0, 2), slice(2, 4))):
        xhat, P = stacked.xhat[:, 0, entries], stacked.P[:, 0, entries, entries]
        np.testing.assert_allclose(run.xhat[: last + 1, k], xhat[: last + 1], atol=1e-9)
        np.testing.assert_allclose(run.P[: last + 1, k], P[: last + 1], atol=1e-9)


def test_ranges_and_bearings_of_pairs_are_linearised_at_both_estimates(tmp_path: Path) -> None:
    (tmp_path / "sights.csv").write_text("t,node,to,y0,y1\n1,1,2,5.2,0.95\n3,1,2,5.1,0.9\n")
    run = netkf.simulate(load(PLANAR, tmp_path))
    x, P = np.array([3.0, 4.0]), 0.2
    one = 0.2  # the variance of node 1, which hears nothing it can use
    P, one = P + 0.1, one + 0.1
    d = x
    r = np.hypot(*d)
    H = np.array([d / r, [-d[1] / r**2, d[0] / r**2]])
    R = np.diag([0.04, 0.01])
    # Nothing has been told before: the Kalman update with node 1's error in the noise.
    S = H @ (P * np.eye(2)) @ H.T + R + H @ (one * np.eye(2)) @ H.T
    K = P * H.T @ np.linalg.inv(S)
    after = P * np.eye(2) - K @ H * P
    expected = x + K @ (np.array([5.2, 0.95]) - [r, np.arctan2(d[1], d[0])])
    np.testing.assert_allclose(run.xhat[1, 1], expected, rtol=1e-12)
    np.testing.assert_allclose(run.P[1, 1], after, rtol=1e-10)
    np.testing.assert_allclose(run.P[1, 0], one * np.eye(2), rtol=1e-12)
    np.testing.assert_allclose(run.P[2, 1], after + 0.1 * np.eye(2), rtol=1e-10)
    assert np.trace(run.P[3, 1]) <= np.trace(run.P[2, 1]) + 0.2 + 1e-12


LATE = {"network__channel": {"delay": {"kind": "constant", "seconds": 0.3}}}


@pytest.mark.parametrize("rule", ["split", "ci"])
def test_what_is_late_is_predicted_to_now(tmp_path: Path, rule: str) -> None:
    # A target of both, of which the first reads: of two estimates the better one is taken.
    text = CLOCKED.replace('name = "pose"\nnodes = [1, 2, 3]', 'name = "pose"')
    text = text.replace('[[sensors]]\nof = "pose"\nkind = "relative"', "")
    start = text.index('[[sensors]]\nkind = "relative"')
    text = text[:start] + text[text.index("[network]") :]
    scenario = load(text, tmp_path, **LATE, filter__estimates="all", filter__rule=rule, probe=1.5)
    runs = [netkf.simulate(scenario, engine=engine) for engine in ("simpy", "compiled")]

    def predicted(P: float, gap: float) -> float:
        F = np.exp(-0.2 * gap)
        return float(F * P + 0.25 * (1.0 - F) / 0.2)

    first = predicted(1.0, 1.0)
    first -= first**2 / (first + 0.1)
    for run in runs:
        seen = run.P[1, :2, 0, 0]
        np.testing.assert_allclose(seen, predicted(first, 0.5), rtol=1e-5)
        np.testing.assert_allclose(run.xhat[1, 1], run.xhat[1, 0], rtol=1e-4)
    np.testing.assert_allclose(runs[1].P, runs[0].P, rtol=0, atol=1e-10)


def test_late_estimates_of_neighbours_are_used_and_none_is_below_the_truth(tmp_path: Path) -> None:
    keys = {"filter__estimates": "own+neighbours", "horizon": 6.0} | LATE
    scenario = load(CLOCKED, tmp_path, **keys)
    runs = [netkf.simulate(scenario, engine=engine) for engine in ("simpy", "compiled")]
    np.testing.assert_allclose(runs[1].xhat, runs[0].xhat, rtol=0, atol=1e-10)
    np.testing.assert_allclose(runs[1].P, runs[0].P, rtol=0, atol=1e-10)
    lost = load(
        CLOCKED, tmp_path, **keys, network__channel__loss={"kind": "bernoulli", "delivery": 0.0}
    )
    alone, central = (
        netkf.simulate(one, engine="simpy")
        for one in (lost, load(CLOCKED, tmp_path, **keys | {"filter": {"kind": "central"}}))
    )
    exact = netkf.theory.error_covariance(scenario, runs[0])
    assert scenario.views is not None
    for k, view in enumerate(scenario.views):
        n = len(view)
        P = runs[0].P[:, k, :n, :n]
        for least in (exact[:, k, :n, :n], central.P[:, 0][:, view][:, :, view]):
            assert np.linalg.eigvalsh(P - least).min() > -1e-9
        assert np.trace(P[-1]) < np.trace(alone.P[-1, k, :n, :n]) * (0.9 if k == 2 else 1.0)


def test_the_naive_rule_says_that_P_is_too_small(tmp_path: Path) -> None:
    (note,) = load(ROBOTS, tmp_path, filter__rule="naive").notes
    assert "P is overconfident" in note
    assert load(ROBOTS, tmp_path).notes == ()
