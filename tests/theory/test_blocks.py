"""Theory of nodes that estimate blocks of the state.

The truth is not ours: plain recursions of the joint second moments of all errors, with gains from
the textbook, and the Kalman filter of all blocks.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import block_diag, solve_discrete_are

import netkf
from netkf.theory import covariance_bound, error_covariance
from netkf.theory.common import block_columns
from netkf.theory.errors import error_law
from netkf.theory.promises import compute_promises, promises_text
from tests.algorithms.test_block_intersection import CLOCKED, ROBOTS, Scalar, load

LOSSY = 'channel = { loss = { kind = "bernoulli", delivery = 0.7 } }\n'
TARGET = """
format = 1
name = "a target"
probe = 1.0
horizon = 5.0
[plant]
kind = "diffusion"
A = [[-0.1, 0.2], [0.0, -0.2]]
B = [[0.1, 0.0], [0.0, 0.3]]
schedule = [{ from = 2.0, A = [[-0.1, 0.0], [0.0, -0.2]] }]
input = { kind = "constant", G = [[1.0], [0.0]], value = [0.4] }
mean = [1.0, 0.0]
cov = [[1.0, 0.2], [0.2, 1.0]]
[[sensors]]
nodes = [1]
H = [[1.0, 0.0]]
R = [[0.1]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "poisson", rate = 2.0 }
"""
FILTER = '[filter]\nkind = "hybrid"\nepsilon = 0.3\n'


class Moments:
    """Joint second moments C of the errors of three robots and, from sending on, of those that
    they have told; each robot has the gains of a scalar recursion.
    """

    def __init__(self, rule: str, F: float, Q: float) -> None:
        self.F, self.Q, self.C = F, Q, np.eye(3)
        self.nodes = {node: MovingScalar(rule, F, Q) for node in (1, 2, 3)}

    def predict(self) -> None:
        self.C = self.F**2 * self.C + self.Q * np.eye(3)
        for node in self.nodes.values():
            node.predict()

    def exchange(self, reads: bool, pairs: list[tuple[int, int]]) -> None:
        """Let the first robot read, all tell, and receivers use what ``pairs`` (i, j) say."""
        if reads:
            node = self.nodes[1]
            P = node.P
            node.use(0.0, 0.0, 0.0, 0.1)
            K = 1.0 - node.P / P
            E = np.diag([1.0 - K, 1.0, 1.0])
            self.C = E @ self.C @ E.T + np.diag([K**2 * 0.1, 0.0, 0.0])
        twice = np.tile(np.eye(3), (2, 1))
        C = twice @ self.C @ twice.T
        sent = {i: (node.told, node.own) for i, node in self.nodes.items()}
        for node in self.nodes.values():
            node.told, node.own = node.P, 0.0
            node._join()
        for i, j in sorted(pairs):
            # z = y + xhat_i = x_j - e_i + v, so that e_j <- (1 - K) e_j + K (e_i - v).
            K = self.nodes[j].gain(*sent[i], 0.3)
            E = np.eye(6)
            E[j - 1, j - 1], E[j - 1, 3 + i - 1] = 1.0 - K, K
            C = E @ C @ E.T
            C[j - 1, j - 1] += K**2 * 0.3
        self.C = C[:3, :3]


class MovingScalar(Scalar):
    """A scalar estimate with other dynamics that says by which gain it uses a reading."""

    def __init__(self, rule: str, F: float, Q: float) -> None:
        super().__init__(rule)
        self.F, self.Q = F, Q

    def predict(self) -> None:
        self.told, self.own = self.F**2 * self.told, self.F**2 * self.own + self.Q
        self._join()

    def gain(self, told: float, own: float, noise: float) -> float:
        """Use a reading of x = 0 that says 1: what it moves the estimate by is the gain."""
        self.x = 0.0
        self.use(1.0, told, own, noise)
        return self.x


def told_at(run: netkf.Run, time: float, length: float) -> list[tuple[int, int]]:
    log = run.log[(run.log["t"] >= time - 1e-9) & (run.log["t"] < time + length - 1e-9)]
    log = log[log["kind"] == netkf.trace.schema.CODES["deliver"]]
    return list(zip(log["peer"].tolist(), log["node"].tolist(), strict=True))


@pytest.mark.one_in(6)
@pytest.mark.parametrize("rule", ["split", "ci", "naive"])
@pytest.mark.parametrize("text", [ROBOTS, CLOCKED], ids=["slots", "clocks"])
def test_errors_of_own_blocks_follow_their_joint_recursion(
    tmp_path: Path, text: str, rule: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So few columns that they have to be turned into fewer.
    monkeypatch.setattr(block_columns, "SPARE", 40)
    scenario = load(text.replace("[filter]", LOSSY + "[filter]"), tmp_path, filter__rule=rule)
    run = netkf.simulate(scenario)
    joint = error_covariance(scenario, run, stacked=True)
    step, F, Q = 1.0, 0.9, 0.2
    if not scenario.slotted:
        step, F, Q = 0.5, np.exp(-0.05), 0.25 * (1.0 - np.exp(-0.1)) / 0.2
    moments = Moments(rule, F, Q)
    for k in range(round(11.0 / step) + 1):
        time = k * step
        if k:
            moments.predict()
            moments.exchange(time == round(time), told_at(run, time, step))
        if time == round(time):
            # Weights are those with the least P, which hardly depends on them.
            rtol = 1e-9 if rule == "naive" else 1e-6
            np.testing.assert_allclose(joint[round(time)], moments.C, rtol=rtol, atol=1e-9)
    bounded = run.P[:, :, 0, 0] >= np.diagonal(joint, axis1=1, axis2=2) - 1e-9
    assert bounded.all() == (rule != "naive")


@pytest.mark.parametrize("text", [ROBOTS, CLOCKED], ids=["slots", "clocks"])
def test_errors_of_local_filters_of_blocks_are_jointly_those_of_kalman_filters(
    tmp_path: Path, text: str
) -> None:
    scenario = load(text, tmp_path, filter__kind="local", filter__estimates="own+neighbours")
    run = netkf.simulate(scenario)
    joint = error_covariance(scenario, run, stacked=True)
    views = [[0, 1], [1, 0, 2], [2, 1]]
    step, F, Q = 1.0, 0.9, 0.2
    if not scenario.slotted:
        step, F, Q = 0.5, np.exp(-0.05), 0.25 * (1.0 - np.exp(-0.1)) / 0.2
    # Selects the states of all nodes, one after the other: e = S x - xhat.
    S = np.concatenate([np.eye(3)[view] for view in views])
    C, P = S @ S.T, [np.eye(len(view)) for view in views]
    for k in range(1, round(11.0 / step) + 1):
        C = F**2 * C + S @ S.T * Q
        stays, noise = [], []
        for i, view in enumerate(views):
            P[i] = F**2 * P[i] + Q * np.eye(len(view))
            rows = [[0.0] * view.index(j) + [1.0] for j in view[1:]]
            H = np.array([row + [0.0] * (len(view) - len(row)) for row in rows])
            H[:, 0] = -1.0
            R = 0.3 * np.eye(len(H))
            if i == 0 and k * step == round(k * step):
                H, R = np.vstack([np.eye(len(view))[:1], H]), block_diag(0.1, R)
            K = P[i] @ H.T @ np.linalg.inv(H @ P[i] @ H.T + R)
            E = np.eye(len(view)) - K @ H
            P[i] = E @ P[i] @ E.T + K @ R @ K.T
            stays.append(E)
            noise.append(K @ R @ K.T)
        C = block_diag(*stays) @ C @ block_diag(*stays).T + block_diag(*noise)
        if k * step == round(k * step):
            t = round(k * step)
            np.testing.assert_allclose(joint[t], C, rtol=1e-9, atol=1e-9)
    blocks = error_covariance(scenario, run)
    np.testing.assert_allclose(blocks, run.P, rtol=1e-9, atol=1e-9)
    assert np.isnan(blocks[:, 0, 2]).all()
    law = error_law(scenario, run)
    size = 3 * scenario.width
    assert law.covariance.shape == (13 * size, 13 * size)
    last = law.covariance[-size:, -size:]
    known = np.isfinite(np.diagonal(run.P[-1], axis1=1, axis2=2)).ravel()
    np.testing.assert_allclose(last[known][:, known], joint[-1], atol=1e-12)
    assert not last[~known].any()


@pytest.mark.parametrize(
    "text",
    [ROBOTS, pytest.param(CLOCKED, marks=pytest.mark.slow)],
    ids=["slots", "clocks"],
)
def test_blocks_that_change_and_whose_input_is_not_known(
    tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So few columns that they have to be turned into fewer.
    monkeypatch.setattr(block_columns, "SPARE", 40)
    changed = "F = [[1.1]]" if text == ROBOTS else "A = [[0.2]]"
    G = 'input = { kind = "constant", G = [[1.0]], value = [0.4] }\ncov = [[1.0]]'
    text = text.replace("cov = [[1.0]]", f"schedule = [{{ from = 5.0, {changed} }}]\n{G}")
    known = load(text, tmp_path, filter__rule="naive")
    scenario = known.replace({"filter.model": {"input": False}})
    run = netkf.simulate(scenario)
    law = error_law(scenario, run)
    np.testing.assert_allclose(law.P, run.P, rtol=1e-9)
    # Noises and gains are the same, so that the input adds its response to the errors.
    added = run.error - netkf.simulate(known).error
    np.testing.assert_allclose(law.mean.reshape(added.shape), added, rtol=1e-9, atol=1e-9)
    assert np.abs(added).max() > 0.1
    # On a tree P is the covariance of the error.
    exact = load(text, tmp_path, filter__kind="block-belief-propagation")
    run = netkf.simulate(exact)
    np.testing.assert_allclose(error_covariance(exact, run), run.P, rtol=1e-9)


def test_of_several_messages_that_arrive_at_once_the_newest_counts(tmp_path: Path) -> None:
    # Those sent at 0.5, 1.0 and 1.5 all arrive at 1.5, and so on.
    rows = [f"{i},{j},{k},{1.0 - 0.5 * (k % 3):g}" for i, j in ((1, 2), (2, 1), (2, 3), (3, 2))
            for k in range(24)]  # fmt: skip
    (tmp_path / "d.csv").write_text("\n".join(["sender,receiver,message,seconds", *rows]))
    scenario = load(
        CLOCKED, tmp_path, filter__estimates="own+neighbours",
        network__channel={"delay": {"kind": "recorded", "path": "d.csv"}, "symmetric": False},
        network__activation={"kind": "periodic", "period": 0.5, "at": "nodes"},
    )  # fmt: skip
    run = netkf.simulate(scenario, engine="simpy")
    known = np.isfinite(run.P)
    np.testing.assert_allclose(error_law(scenario, run).P[known], run.P[known], rtol=1e-9)


@pytest.mark.parametrize("rule", ["split", "ci"])
def test_a_reading_that_several_nodes_use_makes_their_errors_dependent(
    tmp_path: Path, rule: str
) -> None:
    text = ROBOTS.replace("nodes = [1, 2, 3]", "nodes = [1, 2, 3, 4]")
    text = text.replace("[[1, 2], [2, 3]]", "[[1, 2], [1, 3], [2, 3], [2, 4], [3, 4]]")
    text = text.replace('kind = "relative"', 'kind = "relative"\nto = [[1, 4]]')
    text = text.replace("Q = [[0.2]]", "Q = [[0.001]]").replace("cov = [[1.0]]", "cov = [[9.0]]")
    changes = {"filter__estimates": "own+neighbours", "filter__rule": rule}
    scenario = load(text, tmp_path, horizon=6.0, **changes)
    run = netkf.simulate(scenario)
    Sigma = error_covariance(scenario, run)
    for k, n in enumerate(scenario.sizes.tolist()):
        gap = run.P[:, k, :n, :n] - Sigma[:, k, :n, :n]
        assert np.linalg.eigvalsh(gap).min() > -1e-9


def test_no_filter_of_blocks_is_better_than_the_central_one(tmp_path: Path) -> None:
    scenario = load(ROBOTS, tmp_path, filter__estimates="own+neighbours")
    promises = compute_promises(scenario)
    H = np.array([[1.0, 0, 0], [-1, 1, 0], [1, -1, 0], [0, -1, 1], [0, 1, -1]])
    R = np.diag([0.1, 0.3, 0.3, 0.3, 0.3])
    P = solve_discrete_are(0.9 * np.eye(3), H.T, 0.2 * np.eye(3), R)
    P = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.solve(R, H))
    blocks = {(one["node"], one["block"]): one for one in promises["least_error"]["blocks"]}
    assert len(blocks) == 7
    for (_, block), one in blocks.items():
        k = int(block.removeprefix("pose@")) - 1
        np.testing.assert_allclose(one["value"], [[P[k, k]]], rtol=1e-9)
    assert "by design" in promises["P"]
    assert "pose@3" in promises_text(scenario, promises)
    naive = compute_promises(scenario.replace({"filter.rule": "naive"}))
    assert naive["P"].startswith("nothing is promised")
    # Between samples the least covariance is that at the end.
    clocked = load(CLOCKED, tmp_path, horizon=2.25)
    P, Q = np.eye(3), 0.25 * (1.0 - np.exp(-0.1)) / 0.2
    for k in range(1, 5):
        P = np.exp(-0.1) * P + Q * np.eye(3)
        rows = slice(k % 2, None)
        P = np.linalg.inv(np.linalg.inv(P) + H[rows].T @ np.linalg.solve(R[rows, rows], H[rows]))
    P = np.exp(-0.05) * P + 0.25 * (1.0 - np.exp(-0.05)) / 0.2 * np.eye(3)
    least = compute_promises(clocked)["least_error"]
    assert least["when"] == "at 2.25 s"
    seen = [one["value"][0][0] for one in least["blocks"]]
    np.testing.assert_allclose(seen, np.diag(P), rtol=1e-9)
    # Nodes that are down do not read; one that forgets does not know the law of its state.
    life = {"nodes": [2], "kind": "duty", "period": 1.0, "up": 0.4, "memory": "lost"}
    sensor = {"of": "pose", "nodes": [1, 2, 3], "H": [[1.0]], "R": [[0.1]]}
    sensor["sampling"] = {"kind": "periodic", "period": 0.5}
    filtering = {"kind": "local", "estimates": "own"}
    alone = clocked.replace({"filter": filtering, "sensors": [sensor]})
    assert "P is the covariance" in compute_promises(alone)["P"]
    asleep = compute_promises(alone.replace({"network.lives": [life]}))
    assert "down at times" in asleep["least_error"]["reason"]
    assert "nothing is promised" in asleep["P"]


def test_blocks_that_all_estimate_are_a_plant_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "alone.toml").write_text(TARGET + FILTER)
    robots = 'cov = [[1.0]]\nA = [[0.1]]\nB = [[0.2]]\nnodes = [1, 2]\nname = "pose"\n'
    blocks = TARGET.replace(
        '[plant]\nkind = "diffusion"', f'[[plants]]\n{robots}[[plants]]\nname = "target"'
    )
    blocks = blocks.replace("[[sensors]]", '[[sensors]]\nof = "target"')
    (tmp_path / "blocks.toml").write_text(blocks + FILTER + 'estimates = "shared"\n')
    alone, shared = (netkf.load(tmp_path / f"{name}.toml") for name in ("alone", "blocks"))
    times = np.array([1.0, 4.0])
    expected = covariance_bound(alone, times)
    np.testing.assert_allclose(covariance_bound(shared, times), expected, rtol=1e-12)
    one, other = (compute_promises(scenario) for scenario in (alone, shared))
    assert one == other


FIXED = """
format = 1
name = "a target in slots"
probe = 1.0
horizon = 6.0
[plant]
kind = "linear"
F = [[0.9, 0.2], [-0.1, 0.8]]
Q = [[0.1, 0.0], [0.0, 0.1]]
period = 1.0
cov = [[1.0, 0.0], [0.0, 1.0]]
[[sensors]]
nodes = [1, 2]
H = [[1.0, 0.5]]
R = [[0.1]]
[network]
graph = { kind = "edges", edges = [[1, 2]] }
activation = { kind = "broadcast" }
"""
IN_SLOTS = (
    'kind = "hcmci"', 'kind = "icf"', 'kind = "consensus-innovations"', 'kind = "kcf"',
    'kind = "track-fusion"\nrule = "cross-covariance"', 'kind = "belief-propagation"',
    'kind = "push-sum"\ngamma = 1\ndelta = 4.0\nleader = 1',
    'kind = "push-sum"\ngamma = 1\ndelta = 4.0\nleader = 1\nasymptotic = true',
    'kind = "constant-gain"\ngain = [[0.5], [0.1]]', 'kind = "diffusion"',
)  # fmt: skip


@pytest.mark.parametrize("filtering", IN_SLOTS)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_filters_of_a_shared_block_do_not_see_other_blocks(
    tmp_path: Path, filtering: str, engine: str
) -> None:
    """Neither does what they compute, or refuse, before there are readings: here the others know
    where they begin, and their F is 0.
    """
    (tmp_path / "alone.toml").write_text(FIXED + f"[filter]\n{filtering}\n")
    still = 'F = [[0.0]]\nQ = [[0.0]]\nperiod = 1.0\nnodes = [1, 2]\nname = "pose"\n'
    blocks = FIXED.replace(
        '[plant]\nkind = "linear"', f'[[plants]]\n{still}[[plants]]\nname = "target"'
    )
    blocks = blocks.replace("[[sensors]]", '[[sensors]]\nof = "target"')
    (tmp_path / "blocks.toml").write_text(blocks + f'[filter]\n{filtering}\nestimates = "shared"\n')
    alone, shared = (netkf.load(tmp_path / f"{name}.toml") for name in ("alone", "blocks"))
    one, other = (netkf.simulate(scenario, engine=engine) for scenario in (alone, shared))
    np.testing.assert_allclose(other.P, one.P, rtol=1e-9, atol=1e-12)
    assert compute_promises(alone)["assumptions"] == compute_promises(shared)["assumptions"]
