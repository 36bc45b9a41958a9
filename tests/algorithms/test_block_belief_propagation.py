"""Belief propagation over blocks: on a tree the posterior of the readings that have arrived, by a
plain solution for all states of all nodes together.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import netkf
from netkf.algorithms.block_belief_propagation import BlockBeliefPropagation
from netkf.core.errors import ScenarioError
from netkf.scenario.model import Filtering
from netkf.scenario.reading import from_table
from netkf.trace.schema import KINDS
from tests.algorithms.plain_paths import PlainPaths
from tests.algorithms.test_block_intersection import BELIEF, CLOCKED, ROBOTS, load

EDGES = [[1, 2], [2, 3], [2, 4], [4, 5]]
NEIGHBOURS = {
    node: [b if a == node else a for a, b in EDGES if node in (a, b)] for node in range(1, 6)
}
READINGS, N = 9, 5
Key = tuple[int, int, int]
"""A reading: its number, the node that reads, and the node that is read."""
LOSSY = {"loss": {"kind": "bernoulli", "delivery": 0.6}, "symmetric": False}
DELAYED = LOSSY | {"delay": {"kind": "exponential", "mean": 0.6}}
SLOTS = 1.0, 0.9, 0.2, []
CHANGING = 1.0, 0.9, 0.2, [{"from": 4.0, "F": [[0.6]]}]
CLOCKS = 0.5, np.exp(-0.05), 0.25 * (1.0 - np.exp(-0.1)) / 0.2, []
"""Seconds from reading to reading; transition and noise from one to the next; and changes."""


def posterior(
    known: set[Key], y: dict[Key, float], laws: list[tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance of all nodes now, by one solution for all instants, with F and Q
    from each to the next; entry (k, i) of the state is k * N + i - 1.
    """
    C = np.eye(1)
    for F, Q in laws:
        row = F * C[-1]
        C = np.block([[C, row[:, None]], [row, F * row[-1] + Q]])
    C = np.kron(C, np.eye(N))
    H, R = np.zeros((len(known), len(C))), np.zeros(len(known))
    for row, (k, i, j) in enumerate(sorted(known)):
        H[row, k * N + j - 1] += 1.0
        if i != j:
            H[row, k * N + i - 1] -= 1.0
        R[row] = 0.1 if i == j else 0.3
    K = C @ H.T @ np.linalg.inv(H @ C @ H.T + np.diag(R))
    x = K @ np.array([y[key] for key in sorted(known)])
    return x[-N:], np.diag(C - K @ H @ C)[-N:]


def known_to_all(run: netkf.Run, y: dict[Key, float], period: float) -> dict[float, list[set[Key]]]:
    """Return the readings in the beliefs of all nodes at each sample, from the events of a run: a
    message has those of its sender's side of a link, with those of the pair up to its sending.
    """

    def own(i: int, t: float) -> set[Key]:
        return {key for key in y if key[1] == key[2] == i and period * key[0] <= t}

    told: dict[tuple[int, int], tuple[float, set[Key]]] = {}
    sent, inbox, found = {}, list[tuple[int, int, int]](), {}
    rows = run.log[["t", "kind", "node", "peer", "message"]].tolist()
    # A sample of a slot is of its end.
    end = 0.99 if run.times[1] == 1.0 else 0.0
    samples = [(t + end, len(KINDS), 0, 0, 0) for t in run.times]
    for t, code, node, peer, number in sorted(rows + samples, key=lambda row: row[0]):
        kind = KINDS[code] if code < len(KINDS) else "sample"
        if kind == "send":
            side = [told[node, k][1] for k in NEIGHBOURS[node] if k != peer and (node, k) in told]
            pair = {key for key in y if {*key[1:]} == {node, peer} and period * key[0] <= t}
            sent[node, peer, number] = t, own(node, t).union(pair, *side)
        elif kind == "deliver":
            inbox.append((peer, node, number))
        elif kind == "absorb":
            for message in [one for one in inbox if one[1] == node]:
                inbox.remove(message)
                link, content = (node, message[0]), sent[message]
                # One that was overtaken is not used.
                if link not in told or told[link][0] <= content[0]:
                    told[link] = content
        elif kind == "sample":
            heard = {
                i: [told[i, j][1] for j in NEIGHBOURS[i] if (i, j) in told] for i in NEIGHBOURS
            }
            found[round(t - end, 6)] = [own(i, t).union(*heard[i]) for i in NEIGHBOURS]
    return found


@pytest.mark.parametrize(
    ("text", "law", "steps", "channel"),
    [
        (ROBOTS, SLOTS, 1, LOSSY),
        (ROBOTS, SLOTS, 2, LOSSY),
        (CLOCKED, CLOCKS, 1, DELAYED),
        (ROBOTS, CHANGING, 1, LOSSY),
    ],
    ids=["slots", "two steps", "late and overtaken", "a plant that changes"],
)
def test_on_trees_it_is_the_posterior_of_what_has_arrived(
    tmp_path: Path,
    text: str,
    law: tuple[float, float, float, list[dict[str, object]]],
    steps: int,
    channel: dict[str, object],
) -> None:
    random, (period, F, Q, schedule) = np.random.default_rng(1), law
    laws = [(F, Q)] * 4 + [(0.6 if schedule else F, Q)] * READINGS
    keys = [(k, i, j) for k in range(1, READINGS + 1) for i in NEIGHBOURS for j in NEIGHBOURS[i]]
    keys += [(k, 1, 1) for k in range(1, READINGS + 1)]
    y = {key: float(random.normal()) for key in keys}
    pairs = [f"{period * k},{i},{j},{y[k, i, j]}" for k, i, j in y if i != j]
    own = [f"{period * k},{i},{y[k, i, j]}" for k, i, j in y if i == j]
    (tmp_path / "pairs.csv").write_text("t,node,to,y0\n" + "\n".join(pairs) + "\n")
    (tmp_path / "own.csv").write_text("t,node,y0\n" + "\n".join(own) + "\n")
    text = text.replace('of = "pose"\nnodes = [1]', 'kind = "recorded"\npath = "own.csv"')
    text = text.replace('kind = "relative"', 'kind = "relative"\npath = "pairs.csv"')
    text = "\n".join(line for line in text.split("\n") if not line.startswith("sampling"))
    changes = {
        "plants__0__nodes": list(NEIGHBOURS),
        "plants__0__schedule": schedule,
        "network__graph": {"kind": "edges", "edges": EDGES},
        "network__channel": channel,
        "horizon": period * (READINGS + 1),
        "probe": period,
        "filter": BELIEF | {"estimates": "own", "steps": steps},
    }
    run = netkf.simulate(load(text, tmp_path, **changes))
    known = known_to_all(run, y, period)
    # The last sample has events beyond the horizon, which are not recorded.
    for k, t in enumerate(run.times[:-1]):
        for i in range(N if k else 0):
            x, P = posterior(known[round(t, 6)][i], y, laws[:k])
            np.testing.assert_allclose(run.xhat[k, i, 0], x[i], atol=1e-10)
            np.testing.assert_allclose(run.P[k, i, 0, 0], P[i], rtol=1e-9)
    assert run.count("lost") > 10


@pytest.mark.one_in(2)
@pytest.mark.parametrize("text", [ROBOTS, CLOCKED], ids=["slots", "clocks"])
def test_p_is_right_where_nodes_forget_and_too_small_on_loops(tmp_path: Path, text: str) -> None:
    short = BELIEF | {"estimates": "own", "window": 2}
    shares = []
    for edges in ([[1, 2], [2, 3]], [[1, 2], [2, 3], [3, 1]]):
        changes = {"network__channel": LOSSY, "filter": short}
        scenario = load(text, tmp_path, network__graph={"kind": "edges", "edges": edges}, **changes)
        run = netkf.simulate(scenario)
        shares.append(netkf.theory.error_covariance(scenario, run) / run.P)
    np.testing.assert_allclose(shares[0], 1.0, rtol=1e-9)
    assert shares[1].min() > 1.0 - 1e-9
    assert shares[1].max() > 1.05


def test_who_is_read_and_reads_nobody_uses_it_at_that_instant(tmp_path: Path) -> None:
    text = CLOCKED.replace('kind = "relative"', 'kind = "relative"\nto = [[1, 2]]')
    keys = {"filter": BELIEF | {"estimates": "own"}, "plants__0__nodes": [1, 2]}
    graph = {"network__graph": {"kind": "edges", "edges": [[1, 2]]}}
    run = netkf.simulate(load(text, tmp_path, horizon=0.75, probe=0.5, **keys, **graph))
    P = np.exp(-0.1) + 0.25 * (1.0 - np.exp(-0.1)) / 0.2
    np.testing.assert_allclose(run.P[1, 1], 1.0 / (1.0 / P + 1.0 / (P + 0.3)), rtol=1e-12)


def test_no_message_makes_p_larger_though_windows_are_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, absorb = list[float](), BlockBeliefPropagation.absorb

    def watched(self: Any, state: Any, *arguments: Any) -> Any:
        after = absorb(self, state, *arguments)
        found.append(np.trace(after.P) / np.trace(state.P))
        return after

    monkeypatch.setattr(BlockBeliefPropagation, "absorb", watched)
    # Most messages bring no reading of an instant that windows reach.
    clock = {"kind": "poisson", "rate": 5.0, "at": "nodes"}
    keys = {"filter": BELIEF | {"estimates": "own", "window": 2}, "network__activation": clock}
    netkf.simulate(load(CLOCKED, tmp_path, **keys), engine="simpy")
    assert len(found) > 30
    assert max(found) < 1.0 + 1e-8


def test_a_message_has_two_means_and_a_triangle(tmp_path: Path) -> None:
    scenario = load(ROBOTS, tmp_path, filter=BELIEF | {"estimates": "own", "window": 4})
    assert scenario.message_size(1, -1) == 8.0 * (4 + 4 + 10)


@pytest.mark.slow
def test_check_knows_that_p_is_right_on_trees_alone(tmp_path: Path) -> None:
    promise = "P is the covariance of the error, given the events"
    for edges, verdict in (([[1, 2]], "holds"), ([[1, 2], [2, 3], [3, 1]], "not promised")):
        graph = {"kind": "edges", "edges": edges, "nodes": [1, 2, 3]}
        keys = {"filter": BELIEF | {"estimates": "own"}, "network__graph": graph, "horizon": 5.0}
        scenario = load(ROBOTS, tmp_path, **keys)
        table = netkf.check(scenario, 10, confidence=0.999, workers=1).table.set_index("promise")
        assert table.loc[promise, "verdict"] == verdict
        assert "broken" not in set(table["verdict"])


def test_loops_are_noted(tmp_path: Path) -> None:
    graph = {"kind": "edges", "edges": [[1, 2], [2, 3], [3, 1]]}
    belief = {"filter": BELIEF | {"estimates": "own"}}
    noted = load(ROBOTS, tmp_path, network__graph=graph, **belief).notes
    assert any("loops" in note and "P is too small" in note for note in noted)
    assert not any("loops" in note for note in load(ROBOTS, tmp_path, **belief).notes)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_late_readings_count_at_instants_of_the_receiver_and_a_note_says_so(
    tmp_path: Path, engine: str
) -> None:
    place = {"of": "pose", "nodes": [1], "H": [[1.0]], "R": [[0.1]]}
    place["sampling"] = {"kind": "periodic", "period": 1.0}
    delay = {"delay": {"kind": "constant", "seconds": 0.05}}
    lost = {"loss": {"kind": "bernoulli", "delivery": 0.0}}

    def last_P(phases: tuple[float, float], channel: dict[str, object]) -> float:
        sees = [
            {
                **{"kind": "relative", "of": "pose", "nodes": [i], "to": [[i, j]], "R": [[0.3]]},
                "sampling": {"kind": "periodic", "period": 0.5, "phase": phase},
            }
            for i, j, phase in zip((1, 2), (2, 1), phases, strict=True)
        ]
        keys: dict[str, object] = {"sensors": [place, *sees], "network__channel": channel}
        belief = {"filter": BELIEF | {"estimates": "own"}}
        scenario = load(CLOCKED, tmp_path, **keys, **belief)
        noted = any("that took time it uses readings of instants" in n for n in scenario.notes)
        assert noted == (channel is delay)
        return float(netkf.simulate(scenario, engine=engine).P[-1, 1, 0, 0])

    assert last_P((0.0, 0.0), delay) < 0.6 * last_P((0.0, 0.0), lost)
    assert last_P((0.1, 0.3), delay) == pytest.approx(last_P((0.1, 0.3), lost), rel=1e-9)
    assert last_P((0.1, 0.3), {}) < 0.6 * last_P((0.1, 0.3), lost)


def test_bearings_of_nodes_that_are_nearly_at_one_place(tmp_path: Path) -> None:
    """Their derivatives are so large that squares of them leave nothing of R."""
    table = {
        "format": 1, "name": "one place", "horizon": 6.0, "probe": 0.5, "seed": 3,
        "plants": [{
            "name": "pose", "nodes": [1, 2, 3], "kind": "nonlinear", "f": "unicycle", "step": 0.05,
            "B": np.diag([0.1, 0.1, 0.03]).tolist(), "cov": np.diag([0.3, 0.3, 0.02]).tolist(),
            "means": [[0.0, 0.0, 0.3], [1e-9, 1e-9, 0.3], [2e-9, 0.0, 0.3]],
            "input": {"kind": "constant", "value": [0.0, 0.5]},
        }],
        "sensors": [{
            "kind": "relative-bearing", "of": "pose", "R": [[0.05]],
            "sampling": {"kind": "periodic", "period": 0.5, "phase": 1e-6},
        }],
        "network": {
            "graph": {"kind": "edges", "edges": [[1, 2], [2, 3]]},
            "activation": {"kind": "poisson", "rate": 4.0},
        },
        "filter": BELIEF | {"estimates": "own"},
    }  # fmt: skip
    run = netkf.simulate(from_table(table, tmp_path))
    assert run.status == "complete"
    assert np.linalg.eigvalsh(run.P).min() > -1e-12


CURVED: dict[str, dict[str, Any]] = {
    "slots": {"Q": np.diag([0.02, 0.02, 0.005]).tolist(), "period": 0.5},
    "clocks": {"B": np.diag([0.1, 0.1, 0.05]).tolist(), "step": 0.05},
}
MEANS = [[0.0, 0.0, 0.3], [3.0, 1.0, -1.0], [-2.0, 2.0, 0.5], [1.0, -3.0, 2.0]]
ONE_WAY = {"kind": "edges", "edges": [[1, 2], [2, 1], [2, 3], [3, 2], [3, 4]], "directed": True}


def robots(law: str, folder: Path) -> netkf.Scenario:
    """Four that see each other, in a row of which the last answers nobody."""
    clocks, channel = {"kind": "broadcast"}, LOSSY
    plant = {"kind": "nonlinear", "f": "unicycle", **CURVED[law]}
    sensors: list[dict[str, Any]] = [
        {"kind": "relative-range-bearing", "heading": 2, "R": [[0.1, 0.02], [0.02, 0.05]]},
        {"kind": "relative-range", "R": [[0.2]]},
        {"nodes": [1], "H": np.eye(2, 3).tolist(), "R": [[0.2, 0.05], [0.05, 0.3]]},
    ]
    if law == "clocks":
        sensors = [one | {"sampling": {"kind": "poisson", "rate": 1.5}} for one in sensors]
        clocks, channel = {"kind": "poisson", "rate": 2.0, "at": "nodes"}, DELAYED
    table = {
        "format": 1, "name": "robots", "horizon": 5.0, "probe": 0.5, "seed": 3,
        "plants": [plant | {
            "name": "pose", "nodes": [1, 2, 3, 4], "cov": np.diag([0.3, 0.3, 0.02]).tolist(),
            "means": MEANS, "input": {"kind": "constant", "value": [1.0, 0.4]},
        }],
        "sensors": [{"of": "pose", **one} for one in sensors],
        "network": {"graph": ONE_WAY, "activation": clocks, "channel": channel},
        "filter": {"kind": "block-belief-propagation", "window": 60, "estimates": "own"},
    }  # fmt: skip
    return from_table(table, folder)


@pytest.mark.parametrize("law", CURVED)
def test_robots_that_see_each_other_follow_plain_python(tmp_path: Path, law: str) -> None:
    """What is linearised again and again, of messages that are lost, late and overtaken."""
    scenario = robots(law, tmp_path)
    plain = scenario.replace({"filter": Filtering(PlainPaths(), estimates="own")})
    expected = netkf.simulate(plain)
    for engine in ("simpy", "compiled"):
        run = netkf.simulate(scenario, engine=engine)
        np.testing.assert_allclose(run.xhat, expected.xhat, atol=1e-9)
        np.testing.assert_allclose(run.P, expected.P, atol=1e-10)


def test_windows_that_do_not_fit_into_memory_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"filter\.window: is too long: .* got 1000; write a"):
        robots("clocks", tmp_path).replace({"filter.window": 1000})
    # No slot is remembered twice.
    assert netkf.simulate(robots("slots", tmp_path).replace({"filter.window": 1000})).P.size


def test_messages_that_have_readings_are_not_quantised(tmp_path: Path) -> None:
    few: dict[str, Any] = {"network__quantise": {"bits": 8, "range": 20.0}}
    with pytest.raises(ScenarioError, match=r"quantise: cannot be with .* have readings .* got 8"):
        load(ROBOTS, tmp_path, filter=BELIEF | {"estimates": "own"}, **few)
