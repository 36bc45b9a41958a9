"""Cooperative localisation with kept cross-covariances, beside the covariance of the errors of the
same updates, computed for all nodes together.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf.algorithms.filter import Exchange, Message, Reading
from netkf.engines.compiled.engine import CompiledEngine
from netkf.scenario.reading import from_table
from netkf.trace.schema import CODES
from tests.algorithms.test_block_intersection import CLOCKED, KEPT, ROBOTS, TWO, load
from tests.engines.test_batches import assert_alone

# Two blocks of two states that move differently; the first node knows more than the second.
F_1, F_2 = np.array([[1.0, 0.3], [0.0, 0.9]]), np.array([[0.8, 0.1], [-0.2, 1.0]])
Q_1, Q_2 = np.array([[0.05, 0.01], [0.01, 0.1]]), np.diag([0.1, 0.02])
H, R_OWN, R_PAIR = np.array([[1.0, 0.5]]), 0.2, 0.1
SLOTS = 30
PAIR = f"""
format = 1
name = "a pair"
horizon = {SLOTS + 1}.0
probe = 1.0
[[plants]]
name = "pose"
nodes = [1]
F = {F_1.tolist()}
Q = {Q_1.tolist()}
period = 1.0
cov = [[1.0, 0.0], [0.0, 1.0]]
[[plants]]
name = "pose"
nodes = [2]
F = {F_2.tolist()}
Q = {Q_2.tolist()}
period = 1.0
cov = [[1.0, 0.0], [0.0, 1.0]]
[[sensors]]
kind = "recorded"
of = "pose"
path = "own.csv"
H = {H.tolist()}
R = [[{R_OWN}]]
[[sensors]]
kind = "relative"
path = "pairs.csv"
H = {H.tolist()}
R = [[{R_PAIR}]]
[network]
graph = {{ kind = "edges", edges = [[1, 2]] }}
activation = {{ kind = "broadcast" }}
[network.channel]
symmetric = false
[network.channel.loss]
kind = "bernoulli"
delivery = 0.5
[filter]
kind = "block-cross-covariances"
estimates = "own"
"""


def heard(run: netkf.Run) -> set[tuple[int, int, int]]:
    """Return (slot, receiver, sender) of all messages that arrived."""
    log = run.log[run.log["kind"] == CODES["deliver"]]
    return {(round(t), node, peer) for t, node, peer in log[["t", "node", "peer"]].tolist()}


def test_two_nodes_know_their_covariance_whatever_is_lost(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    y = random.normal(size=(SLOTS, 4))
    # Own readings of node 1 always, of node 2 at times; each reads the other, node 2 at times.
    uses = np.ones((SLOTS, 4), dtype=bool)
    uses[:, [1, 3]] = random.random((SLOTS, 2)) < 0.6
    rows = [(k, c) for k in range(SLOTS) for c in np.flatnonzero(uses[k])]
    own = [f"{k + 1},{c + 1},{y[k, c]}" for k, c in rows if c < 2]
    pairs = [f"{k + 1},{c - 1},{4 - c},{y[k, c]}" for k, c in rows if c > 1]
    (tmp_path / "own.csv").write_text("t,node,y0\n" + "\n".join(own) + "\n")
    (tmp_path / "pairs.csv").write_text("t,node,to,y0\n" + "\n".join(pairs) + "\n")
    scenario = load(PAIR, tmp_path)
    # Side by side runs lose different messages.
    assert_alone(scenario, CompiledEngine(), 7, range(2))
    run = netkf.simulate(scenario)
    arrived = heard(run)
    F, Q = scipy.linalg.block_diag(F_1, F_2), scipy.linalg.block_diag(Q_1, Q_2)
    none = np.zeros_like(H)
    whole = np.block([[H, none], [none, H], [-H, H], [H, -H]])
    R = np.diag([R_OWN, R_OWN, R_PAIR, R_PAIR])
    x, E, alone = np.zeros(4), np.eye(4), 0
    for k in range(SLOTS):
        x, E = F @ x, F @ E @ F.T + Q
        K = np.zeros((4, 4))
        for node, other in ((1, 2), (2, 1)):
            entries = slice(2 * node - 2, 2 * node)
            listens = (k + 1, node, other) in arrived
            chosen = uses[k] & (listens | np.eye(4, dtype=bool)[node - 1])
            C = whole[chosen]
            K[entries, chosen] = (
                E[entries] @ C.T @ np.linalg.inv(C @ E @ C.T + R[chosen][:, chosen])
            )
        alone += ((k + 1, 1, 2) in arrived) != ((k + 1, 2, 1) in arrived)
        x = x + K @ (y[k] - whole @ x)
        E = (np.eye(4) - K @ whole) @ E @ (np.eye(4) - K @ whole).T + K @ R @ K.T
        for node in range(2):
            entries = slice(2 * node, 2 * node + 2)
            np.testing.assert_allclose(run.xhat[k + 1, node], x[entries], atol=1e-10)
            np.testing.assert_allclose(run.P[k + 1, node], E[entries, entries], rtol=1e-9)
    assert alone > 8


def test_a_node_without_neighbours_transmits_in_both_engines(tmp_path: Path) -> None:
    sampling = {"kind": "periodic", "period": 0.5}
    plant = {"name": "pose", "nodes": [0], "A": [[-0.1]], "B": [[1.0]], "cov": [[1.0]]}
    sensor = {"of": "pose", "nodes": [0], "H": [[1.0]], "R": [[0.1]], "sampling": sampling}
    graph = {"kind": "edges", "edges": [], "nodes": [0]}
    table = {
        **{"format": 1, "name": "alone", "horizon": 3.0, "probe": 1.0},
        **{"plants": [plant], "sensors": [sensor], "filter": KEPT | {"estimates": "own"}},
        "network": {"graph": graph, "activation": {"kind": "readings"}},
    }
    runs = [netkf.simulate(from_table(table, tmp_path), engine=e) for e in ("simpy", "compiled")]
    assert [run.count("transmit") for run in runs] == [5, 5]


def test_pairs_take_turns_and_third_nodes_are_approximated(tmp_path: Path) -> None:
    f, q, r_own, r_pair = 0.9, 0.2, 0.1, 0.15  # two readings of .3 of each pair
    own = load(ROBOTS, tmp_path, filter=KEPT | {"estimates": "own"})
    run = netkf.simulate(own)
    central = netkf.simulate(load(ROBOTS, tmp_path, filter={"kind": "central"}), engine="simpy")
    # P believed of pairs, E the covariance of the errors of the same updates.
    P, E, ratios = np.eye(3), np.eye(3), []
    for slot in range(1, 12):
        P, E = f * f * P + q * np.eye(3), f * f * E + q * np.eye(3)
        # Steps 3 and 5 of a slot; node 1 tells its own reading with the first message.
        for i, j, rows, R in (
            (0, 1, [[1.0, 0.0, 0.0], [-1.0, 1.0, 0.0]], np.diag([r_own, r_pair])),
            (1, 2, [[0.0, -1.0, 1.0]], np.diag([r_pair])),
        ):
            C, both, before = np.array(rows), [i, j], P.copy()
            K = np.zeros((3, len(C)))
            J, H_pair = P[np.ix_(both, both)], C[:, both]
            K[both] = J @ H_pair.T @ np.linalg.inv(H_pair @ J @ H_pair.T + R)
            after = J - K[both] @ H_pair @ J
            for k in both:
                factor = after[both.index(k), both.index(k)] / before[k, k]
                P[k, :] *= factor
                P[:, k] *= factor
            P[np.ix_(both, both)] = after
            stays = np.eye(3) - K @ C
            E = stays @ E @ stays.T + K @ R @ K.T
        np.testing.assert_allclose(run.P[slot, :, 0, 0], np.diag(P), rtol=1e-10)
        ratios.append(np.diag(E) / np.diag(P))
    # Close to all blocks together, but no longer equal, nor above.
    stacked = np.diagonal(central.P[1:12, 0], axis1=1, axis2=2)
    share = run.P[1:12, :, 0, 0] / stacked
    assert 0.99 < share.min() < 1.0 - 1e-3
    assert 1.01 < share.max() < 1.05
    assert 1.0 - 1e-12 < np.min(ratios) <= np.max(ratios) < 1.03


@pytest.mark.parametrize(("changes", "verdict"), [(TWO, "holds"), ({}, "not promised")])
@pytest.mark.slow
def test_check_knows_of_how_many_nodes_p_is_right(
    tmp_path: Path, changes: dict[str, object], verdict: str
) -> None:
    lossy = {"loss": {"kind": "bernoulli", "delivery": 0.6}, "symmetric": False}
    own = {"filter": KEPT | {"estimates": "own"}, "network__channel": lossy}
    scenario = load(ROBOTS, tmp_path, **changes, **own)
    run = netkf.simulate(scenario)
    share = netkf.theory.error_covariance(scenario, run) / run.P
    assert np.abs(share - 1.0).max() < (1e-9 if changes else 0.02)
    table = netkf.check(scenario, 10, confidence=0.999, workers=1).table.set_index("promise")
    assert table.loc["P is the covariance of the error, given the events", "verdict"] == verdict
    assert "broken" not in set(table["verdict"])


@pytest.mark.slow
def test_factors_that_cannot_be_inverted_are_not_used(tmp_path: Path) -> None:
    """A pair that has not heard each other for long makes contact first."""
    scenario = load(ROBOTS, tmp_path, filter=KEPT | {"estimates": "own"}, **TWO)
    filtering, at = scenario.node_filter, Exchange(time=1.0)
    nodes = []
    for k in range(2):
        start = np.zeros(1), np.eye(1)
        state = filtering.init(scenario.model_of(k), *start, scenario.node_infos[k])
        nodes.append(filtering.update(state, Reading(np.ones(1), np.eye(1), np.eye(1), 1.0)))
    lost = nodes[0]._replace(base=0.0, last=0.0, told_base=0.0, told_last=0.0)
    for first in (nodes[0], lost):
        told = filtering.emit(nodes[1], at)[1]
        after = filtering.absorb(first, [Message(2, 1.0, told, 0.0)], at)
        # Contact: factors count from now on.
        np.testing.assert_allclose(after.P, 0.5)
        assert (after.last.item(), after.when.item()) == (1.0, 1.0)
    assert (filtering.absorb(lost, [], at).base == 0.0).all()


@pytest.mark.parametrize("steps", [1, 8])
def test_covariances_turn_with_the_coordinates(tmp_path: Path, steps: int) -> None:
    """Also where a node hears several at once, which moves what it has told them."""
    T, found = np.array([[1.0, 2.0], [-0.5, 0.3]]), []
    F, Q, C = np.array([[0.9, 0.3], [-0.1, 0.8]]), np.diag([0.2, 0.1]), np.array([[1, 0.2], [0, 1]])
    for turn in (np.eye(2), T):
        back = np.linalg.inv(turn)
        cov, noise, moved = turn @ turn.T, turn @ Q @ turn.T, turn @ F @ back
        text = ROBOTS.replace("cov = [[1.0]]", f"cov = {cov.tolist()}")
        text = text.replace("[[0.9]]", str(moved.tolist())).replace("[[0.2]]", str(noise.tolist()))
        text = text.replace("H = [[1.0]]", f"H = {[back[0].tolist()]}")
        pair = f"H = {(C @ back).tolist()}\nR = [[0.3, 0.0], [0.0, 0.4]]"
        text = text.replace("R = [[0.3]]", pair)
        keys = {"filter": KEPT | {"estimates": "own", "steps": steps}}
        found.append(netkf.simulate(load(text, tmp_path, **keys)).P)
    np.testing.assert_allclose(found[1], T @ found[0] @ T.T, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("filtering", [KEPT, {"kind": "block-intersection"}])
def test_readings_of_pairs_that_took_time_are_not_used(
    tmp_path: Path, filtering: dict[str, object]
) -> None:
    late = {"delay": {"kind": "constant", "seconds": 0.1}}
    lost = {"loss": {"kind": "bernoulli", "delivery": 0.0}}
    keys = {"filter": filtering | {"estimates": "own"}}
    run, alone = (
        netkf.simulate(load(CLOCKED, tmp_path, network__channel=channel, **keys))
        for channel in (late, lost)
    )
    assert run.count("absorb") > 20
    np.testing.assert_allclose(run.P, alone.P, rtol=1e-10)


def test_links_that_go_one_way_are_refused(tmp_path: Path) -> None:
    graph = {"kind": "edges", "edges": [[1, 2], [2, 3]], "directed": True}
    changes = {"filter": KEPT | {"estimates": "own"}, "network__graph": graph}
    with pytest.raises(netkf.ScenarioError, match="must have links that go both ways"):
        load(ROBOTS, tmp_path, **changes)


@pytest.mark.parametrize("kind", ["block-cross-covariances", "block-belief-propagation"])
@pytest.mark.parametrize(
    ("estimates", "key", "rule"),
    [
        ("own+neighbours", "filter.estimates", "must give each block to one node alone"),
        ("all", "filter.estimates", "must give each block to one node alone"),
        ("own", "filter.cov", "must be zero between the blocks of node 1 and others"),
    ],
)
def test_blocks_in_common_and_first_errors_that_correlate_are_refused(
    tmp_path: Path, kind: str, estimates: str, key: str, rule: str
) -> None:
    cov = np.eye(3) + 0.1 * (estimates == "own")
    keys = {"kind": kind, "estimates": estimates, "cov": cov.tolist()}
    with pytest.raises(netkf.ScenarioError) as caught:
        load(ROBOTS, tmp_path, filter=keys)
    assert caught.value.key == key
    assert rule in str(caught.value)
