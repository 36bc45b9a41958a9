"""Nodes that crash, sleep, join and leave."""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

import netkf
from netkf.network.lives import Change, Crashes, DutyCycle, Life
from netkf.theory.errors import error_law
from netkf.trace.schema import CODES
from tests.engines.agreement import assert_agree

CLOCKS = """
format = 1
name = "lives"
horizon = {horizon}
probe = 0.25
[plant]
kind = "diffusion"
A = [[-0.1, 1.0], [0.0, -0.3]]
B = [[0.2, 0.0], [0.0, 1.0]]
mean = [1.0, -2.0]
cov = [[1.0, 0.2], [0.2, 2.0]]
[[sensors]]
nodes = [0, 1, 2]
H = [[1.0, 0.0]]
R = [[0.3]]
sampling = {{ kind = "periodic", period = 0.5 }}
[network]
graph = {{ kind = "path", nodes = 3 }}
activation = {{ kind = "poisson", rate = 3.0, at = "{at}" }}
{lives}
[network.channel]
loss = {{ kind = "bernoulli", delivery = 0.8 }}
delay = {{ kind = "constant", seconds = 0.1 }}
[filter]
kind = "{filter}"
"""
CONTINUOUS = CLOCKS.replace('sampling = {{ kind = "periodic", period = 0.5 }}\n', "")
SLOTS = """
format = 1
name = "lives"
horizon = {horizon}
probe = 1.0
[plant]
kind = "linear"
period = 1.0
F = [[1.1]]
Q = [[0.4]]
cov = [[2.0]]
[[sensors]]
nodes = [0, 1, 2]
H = [[1.0]]
R = [[0.5]]
[network]
graph = {{ kind = "path", nodes = 3 }}
activation = {{ kind = "broadcast" }}
{lives}
[filter]
kind = "{filter}"
"""
TABLE = "t,node,what\n1.5,1,down\n4.5,1,up\n6,1,leave\n7.25,1,join\n0,2,down\n3,2,up\n"


@pytest.fixture
def scenario_of(tmp_path):
    def make(text, lives, files=(), horizon=10.0, at="nodes", filter_="local"):
        for name, rows in dict(files).items():
            (tmp_path / name).write_text(rows)
        path = tmp_path / "lives.toml"
        more = "epsilon = 0.4\n" if filter_ == "hybrid" else ""
        path.write_text(text.format(lives=lives, horizon=horizon, at=at, filter=filter_) + more)
        return netkf.load(path)

    return make


def recorded(memory="kept"):
    return (
        '[[network.lives]]\nkind = "recorded"\nnodes = [1, 2]\npath = "l.csv"\n'
        f'memory = "{memory}"',
        {"l.csv": TABLE},
    )


def is_down(t, node):
    intervals = {1: [(1.5, 4.5), (6.0, 7.25)], 2: [(0.0, 3.0)]}
    return any(begin <= t < end for begin, end in intervals.get(node, ()))


def expected_covariances(times, node, lost):
    """The Kalman filter of a node alone, written plainly: it predicts from sample to sample that it
    takes, and begins again where its memory is lost.
    """
    A, B = np.array([[-0.1, 1.0], [0.0, -0.3]]), np.diag([0.2, 1.0])
    prior = np.array([[1.0, 0.2], [0.2, 2.0]])
    H, R = np.array([[1.0, 0.0]]), np.array([[0.3]])

    def predict(P, gap):
        nested = np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]])
        big = scipy.linalg.expm(nested * gap)
        Phi = big[2:, 2:].T
        return Phi @ P @ Phi.T + Phi @ big[:2, 2:]

    ups = {1: [4.5, 7.25], 2: [3.0]}.get(node, []) if lost else []
    events = sorted(
        [(t, 2, "probe") for t in times]
        + [(0.5 * k, 1, "sample") for k in range(1, 20) if not is_down(0.5 * k, node)]
        + [(t, 0, "restart") for t in ups]
    )
    P, now, found = prior, 0.0, []
    for t, _, what in events:
        P, now = predict(P, t - now), t
        if what == "restart":
            P = prior
        elif what == "sample":
            P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        else:
            found.append(P)
    return np.array(found)


@pytest.mark.parametrize("memory", ["kept", "lost"])
def test_covariances_are_those_of_the_plain_recursion(scenario_of, memory):
    run = netkf.simulate(scenario_of(CLOCKS, *recorded(memory)), seed=1)
    for k in range(3):
        expected = expected_covariances(run.times.tolist(), k, memory == "lost")
        np.testing.assert_allclose(run.P[:, k], expected, rtol=1e-9)


def continuous_covariances(times, node, lost):
    """The Kalman-Bucy filter of a node alone, whose sensor gives increments while it is up."""
    A, Q = np.array([[-0.1, 1.0], [0.0, -0.3]]), np.diag([0.04, 1.0])
    prior, H = np.array([[1.0, 0.2], [0.2, 2.0]]), np.array([[1.0, 0.0]])
    changes = {1: [1.5, 4.5, 6.0, 7.25], 2: [3.0]}.get(node, [])
    P, now, found = prior, 0.0, []
    for t in sorted({*times, *changes}):
        G = (0.0 if is_down(now, node) else 1.0) * H.T @ H / 0.3
        big = scipy.linalg.expm(np.block([[A, Q], [G, -A.T]]) * (t - now))
        P, now = (big[:2, :2] @ P + big[:2, 2:]) @ np.linalg.inv(big[2:, :2] @ P + big[2:, 2:]), t
        if lost and t in changes and not is_down(t, node):
            P = prior
        if t in times:
            found.append(P)
    return np.array(found)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("memory", ["kept", "lost"])
def test_continuous_sensors_are_silent_while_their_node_is_down(scenario_of, memory, engine):
    scenario = scenario_of(CONTINUOUS, *recorded(memory))
    run = netkf.simulate(scenario, seed=1, engine=engine)
    exact = netkf.theory.error_covariance(scenario, run)
    for k in range(3):
        expected = continuous_covariances(run.times.tolist(), k, memory == "lost")
        np.testing.assert_allclose(run.P[:, k], expected, rtol=1e-9)
        if memory == "kept":  # else P begins again, and errors do not
            np.testing.assert_allclose(exact[:, k], expected, rtol=1e-8)


@pytest.mark.parametrize("memory", ["kept", "lost"])
@pytest.mark.parametrize("filter_", ["hybrid", "gossip"])
def test_engines_agree_where_continuous_sensors_fall_silent(scenario_of, filter_, memory):
    at = "links" if filter_ == "gossip" else "nodes"
    scenario = scenario_of(CONTINUOUS, *recorded(memory), at=at, filter_=filter_)
    changing = [{"from": 5.0, "A": [[-0.2, 0.3], [0.0, -0.5]]}]
    driven = {"kind": "constant", "G": [[1.0], [0.5]], "value": [0.7]}
    for changes in ({}, {"plant.schedule": changing}, {"plant.input": driven}):
        run = assert_agree(scenario.replace(changes))
        assert run.count("crash") + run.count("leave") == 2


def test_errors_where_continuous_sensors_fall_silent(scenario_of):
    """Squared errors of many runs have the mean that the exact covariances of each give them."""
    scenario = scenario_of(CONTINUOUS, *recorded(), filter_="hybrid")
    excess = []
    for replica in range(30):
        run = netkf.simulate(scenario, seed=5, replica=replica)
        exact = np.einsum("tnii->tn", netkf.theory.error_covariance(scenario, run))
        excess.append([(run.error**2).sum(axis=2).mean() - exact.mean(), exact.mean()])
    mean, size = np.mean(excess, axis=0)
    deviation = np.std(excess, axis=0)[0] / np.sqrt(len(excess))
    assert abs(mean) < 4.0 * deviation < 0.5 * size


def test_only_nodes_that_go_without_increments_may_be_down(scenario_of):
    rule = (
        r"network\.lives\[0\]\.nodes: cannot have .* they sample, with the central filter; got 1;"
    )
    with pytest.raises(netkf.ScenarioError, match=rule):
        scenario_of(CONTINUOUS, *recorded(), filter_="central")


@pytest.mark.parametrize("text", [CLOCKS, SLOTS])
@pytest.mark.parametrize(
    "keys",
    [
        'kind = "crashes"\nmean_up = 1e-9\nmean_down = 1e-9',
        'kind = "crashes"\nmean_up = 5e-324\nmean_down = 5e-324',
        'kind = "duty"\nperiod = 1e-9\nup = 5e-10',
    ],
)
def test_more_changes_than_memory_holds_are_refused(scenario_of, text, keys):
    with pytest.raises(
        netkf.ScenarioError, match=r"network\.lives\[0\]: must .* at most 10,000,000"
    ):
        scenario_of(text, f"[[network.lives]]\nnodes = [1]\n{keys}")


@pytest.mark.parametrize("at", ["nodes", "links", "directions"])
@pytest.mark.parametrize(
    ("text", "memory"), [(CLOCKS, "kept"), (CLOCKS, "lost"), (CONTINUOUS, "kept")]
)
def test_who_is_down_does_nothing(scenario_of, text, at, memory):
    scenario = scenario_of(text, *recorded(memory), at=at, filter_="hybrid")
    log = netkf.simulate(scenario, seed=3).log
    for kind in ("sense", "send", "absorb", "transmit"):
        rows = log[log["kind"] == CODES[kind]]
        assert not any(is_down(t, n) for t, n in zip(rows["t"], rows["node"], strict=True))
    delivered = log[log["kind"] == CODES["deliver"]]
    assert not any(is_down(t, n) for t, n in zip(delivered["t"], delivered["node"], strict=True))
    ticks = log[log["kind"] == CODES["tick"]]
    for t, node, peer in zip(ticks["t"], ticks["node"], ticks["peer"], strict=True):
        assert not (is_down(t, node) and (at != "links" or is_down(t, peer)))
    names = {code: kind for kind, code in CODES.items()}
    told = [
        (float(t), int(n), names[int(k)])
        for t, n, k in zip(log["t"], log["node"], log["kind"], strict=True)
        if names[int(k)] in ("crash", "restart", "join", "leave")
    ]
    assert told == [
        (1.5, 1, "crash"),
        (3.0, 2, "restart"),
        (4.5, 1, "restart"),
        (6.0, 1, "leave"),
        (7.25, 1, "join"),
    ]
    # Accounts balance: what is sent arrives, is lost, or is under way at the end.
    count = {kind: int((log["kind"] == CODES[kind]).sum()) for kind in ("send", "deliver", "lost")}
    under_way = (log["t"][log["kind"] == CODES["send"]] > 9.9).sum()
    assert count["deliver"] + count["lost"] <= count["send"]
    assert count["send"] - count["deliver"] - count["lost"] <= under_way


def laws_of_gap(gap):
    A, B = np.array([[-0.1, 1.0], [0.0, -0.3]]), np.diag([0.2, 1.0])
    big = scipy.linalg.expm(np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]]) * gap)
    Phi = big[2:, 2:].T
    return Phi, Phi @ big[:2, 2:]


def joint_moments(run, weight, lost):
    """P of each node, and the joint covariance of all errors, by time: the linear recursion of the
    true state and all errors that the events of a run without delays say, written plainly.
    """
    H, R, prior = np.array([[1.0, 0.0]]), 0.3, np.array([[1.0, 0.2], [0.2, 2.0]])
    P, joint, now = [prior] * 3, np.kron(np.ones((4, 4)), prior), 0.0
    names, heard, found = {code: kind for kind, code in CODES.items()}, {}, []
    rows = [
        (t, 0, names[k], n, p) for t, k, n, p in run.log[["t", "kind", "node", "peer"]].tolist()
    ]
    for t, _, kind, node, peer in sorted(
        [*rows, *((t, 1, "probe", 0, 0) for t in run.times.tolist())], key=lambda r: r[:2]
    ):
        if t > now:
            Phi, Q = laws_of_gap(t - now)
            P = [Phi @ one @ Phi.T + Q for one in P]
            move, now = np.kron(np.eye(4), Phi), t
            joint = move @ joint @ move.T + np.kron(np.ones((4, 4)), Q)
        D, noise = np.eye(8), np.zeros((8, 8))
        own = slice(2 * node + 2, 2 * node + 4)
        if kind == "sense":
            K = P[node] @ H.T / (H @ P[node] @ H.T + R)
            D[own, own] -= K @ H
            noise[own, own] = R * K @ K.T
            P[node] = P[node] - K @ H @ P[node]
        elif kind == "deliver":
            heard.setdefault(node, []).append(peer)
        elif kind == "absorb":
            before = list(P)
            for sender in heard.pop(node):
                D[own, own] -= weight * np.eye(2)
                D[own, 2 * sender + 2 : 2 * sender + 4] += weight * np.eye(2)
                P[node] = P[node] + weight * (before[sender] - before[node])
        elif kind in ("restart", "join") and lost:
            # The error of a mean that knows nothing is the state, less its mean.
            D[own], P[node] = 0.0, prior
            D[own, :2] = np.eye(2)
        elif kind == "probe":
            found.append((P, joint[2:, 2:]))
            continue
        joint = D @ joint @ D.T + noise
    return found


@pytest.mark.parametrize("memory", ["kept", "lost"])
def test_errors_given_the_events_are_exact(scenario_of, memory):
    lives, files = recorded(memory)
    no_delay = CLOCKS.replace('delay = {{ kind = "constant", seconds = 0.1 }}', "")
    scenario = scenario_of(no_delay, lives, files, filter_="hybrid")
    run = netkf.simulate(scenario, seed=4)
    Sigma = netkf.theory.error_covariance(scenario, run, stacked=True)
    for k, (P, joint) in enumerate(joint_moments(run, 0.4, memory == "lost")):
        np.testing.assert_allclose(run.P[k], P, rtol=1e-9)
        np.testing.assert_allclose(Sigma[k], joint, rtol=1e-9, atol=1e-12)


def moments_in_slots(run, lost):
    """P of each node and the joint covariance of all errors at the begin of each slot of nodes that
    use readings of their neighbours when they arrive: the recursion of (x, errors).
    """
    F, Q, R, prior = 1.1, 0.4, 0.5, 2.0
    P, joint = np.full(3, prior), np.full((4, 4), prior)
    names, found = {code: kind for kind, code in CODES.items()}, []
    rows = [(t, names[k], n, p) for t, k, n, p in run.log[["t", "kind", "node", "peer"]].tolist()]
    for slot in range(len(run.times)):
        for t, kind, node, _ in rows:
            if t == slot and kind in ("restart", "join") and lost:
                joint[node + 1], P[node] = joint[0], prior
                joint[:, node + 1] = joint[:, 0]
                joint[node + 1, node + 1] = joint[0, 0]
        found.append((P.copy(), joint[1:, 1:].copy()))
        # What a node uses: its own reading, and those that arrive before it goes down.
        used = [
            {n for t, kind, n, _ in rows if t == slot and kind == "sense" and n == i}
            for i in range(3)
        ]
        for k, (t, kind, node, peer) in enumerate(rows):
            down = [t2 for t2, kind2, n, _ in rows[k:] if n == node and kind2 in ("crash", "leave")]
            if t == slot and kind == "deliver" and not (down and down[0] <= slot + 0.5):
                used[node].add(peer)
        D, gains = np.diag(np.full(4, F)), np.zeros((4, 3))
        for i, readings in enumerate(used):
            if readings:
                K = P[i] / (len(readings) * P[i] + R)
                D[i + 1, i + 1] = F * (1.0 - len(readings) * K)
                gains[i + 1, list(readings)] = F * K
                P[i] = P[i] * (1.0 - len(readings) * K)
        P = F * F * P + Q
        joint = D @ joint @ D.T + R * gains @ gains.T + Q
    return found


@pytest.mark.parametrize("memory", ["kept", "lost"])
def test_errors_in_slots_given_the_events_are_exact(scenario_of, memory):
    lives, files = recorded(memory)
    lives += '\n[network.channel]\nloss = { kind = "bernoulli", delivery = 0.7 }'
    # Node 1 goes down while messages are under way, after 0.2 of a slot.
    files = {"l.csv": TABLE.replace("6,1,leave", "6.2,1,leave")}
    scenario = scenario_of(SLOTS, lives, files, filter_="intermittent")
    run = netkf.simulate(scenario, seed=4)
    Sigma = netkf.theory.error_covariance(scenario, run, stacked=True)
    for k, (P, joint) in enumerate(moments_in_slots(run, memory == "lost")):
        np.testing.assert_allclose(run.P[k, :, 0, 0], P, rtol=1e-9)
        np.testing.assert_allclose(Sigma[k], joint, rtol=1e-9, atol=1e-12)


def test_draws_of_others_do_not_depend_on_who_is_up(scenario_of):
    with_lives = netkf.simulate(scenario_of(CLOCKS, *recorded(), filter_="hybrid"), seed=3).log
    without = netkf.simulate(scenario_of(CLOCKS, "", filter_="hybrid"), seed=3, engine="simpy").log
    for kind in ("tick", "sense"):
        rows = [
            {(float(t), int(n)) for t, n in zip(log["t"], log["node"], strict=True)}
            for log in (one[one["kind"] == CODES[kind]] for one in (with_lives, without))
        ]
        assert rows[0] == {(t, n) for t, n in rows[1] if not is_down(t, n)}


@pytest.mark.parametrize("filter_", ["local", "intermittent"])
def test_slots(scenario_of, filter_):
    lives, files = recorded("lost")
    scenario = scenario_of(SLOTS, lives, files, filter_=filter_)
    log = netkf.simulate(scenario, seed=1).log
    sense = log[log["kind"] == CODES["sense"]]
    slots = {n: {float(t) for t in sense["t"][sense["node"] == n]} for n in range(3)}
    every = {float(k) for k in range(10)} & slots[0]
    for node in (1, 2):
        assert slots[node] == {t for t in every if not is_down(t, node)}


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("filter_", ["kcf", 'event-triggered"\ntrigger = "consensus'])
def test_who_is_down_in_slots_only_predicts(scenario_of, filter_, engine):
    """The silence of others tells it nothing either."""
    lives, files = recorded("kept")
    run = netkf.simulate(scenario_of(SLOTS, lives, files, filter_=filter_), engine=engine)
    down = [2, 3, 4, 6, 7]
    before = run.P[[k - 1 for k in down], 1]
    np.testing.assert_allclose(run.P[down, 1], 1.21 * before + 0.4, rtol=1e-12)


OWN = {
    "hybrid": "epsilon = 0.4\n",
    "kcf": "epsilon = 0.1\n",
    "hcmci": "steps = 2\n",
}
OWN_IN_SLOTS = {
    "constant-gain": "gain = [[0.4]]\n",
    "push-sum": "gamma = 2\ndelta = 3.0\nrunning_sums = true\n",
}
OWN_UNDER_CLOCKS = {"constant-gain": "gain = [[0.4], [0.1]]\n", "push-sum": "delta = 3.0\n"}
LOSSES = (
    'kind = "bernoulli", delivery = 0.8',
    'kind = "gilbert-elliott", mean_loss = 0.3, mean_burst = 3.0',
    'kind = "shared", delivery = 0.7, share = 0.8',
    'kind = "recorded", path = "loss.csv"',
)
DELAYS = ('kind = "none"', 'kind = "constant", seconds = 0.25', 'kind = "exponential", mean = 0.2')


def combined(folder, slots, filter_, k, plant=""):
    """Scenario number k of all: which life, loss and delay, in slots or under clocks."""
    life = (
        'kind = "crashes"\nnodes = [1, 2]\nmean_up = 3.0\nmean_down = 1.5',
        'kind = "duty"\nnodes = [0, 2]\nperiod = 3.0\nup = 2.0\nphase = 1.0',
        'kind = "recorded"\nnodes = [1, 2]\npath = "l.csv"',
    )[k % 3]
    memory = "kept" if filter_ == "push-sum" else ("lost", "kept")[k // 3 % 2]
    lives = f'[[network.lives]]\n{life}\nmemory = "{memory}"'
    (folder / "l.csv").write_text(TABLE)
    ends = [(i, j) for i, j in ((0, 1), (1, 0), (1, 2), (2, 1)) for _ in range(12)]
    rows = [f"{i},{j},{m % 12},{(m * m // 3) % 2}" for m, (i, j) in enumerate(ends)]
    (folder / "loss.csv").write_text("\n".join(["sender,receiver,message,delivered", *rows]))
    at = ("nodes", "directions", "readings", "links")[k % 4]
    clock = (
        'kind = "readings"' if at == "readings" else f'kind = "poisson", rate = 3.0, at = "{at}"'
    )
    text = (SLOTS if slots else CLOCKS).format(lives=lives, horizon=10.0, filter=filter_, at=at)
    network, own = text.partition("[network.channel]")[0], text[text.index("[filter]") :]
    if slots:
        network = network.replace(own, "")
    network = network.replace("[network]\n", plant + "[network]\n")
    network = network.replace(f'kind = "poisson", rate = 3.0, at = "{at}"', clock)
    channel = (
        f"[network.channel]\nsymmetric = false\nloss = {{ {LOSSES[k % 4]} }}\n"
        f"delay = {{ {DELAYS[k // 2 % 3]} }}\n"
    )
    path = folder / "combined.toml"
    options = OWN | (OWN_IN_SLOTS if slots else OWN_UNDER_CLOCKS)
    path.write_text(network + channel + own + options.get(filter_, ""))
    return netkf.load(path)


def assert_accounts_balance(log, horizon):
    count = {kind: log[log["kind"] == CODES[kind]] for kind in ("send", "deliver", "lost", "late")}
    ends = {
        kind: [(int(r["peer"]), int(r["node"]), int(r["message"])) for r in rows]
        if kind in ("deliver", "late")
        else [(int(r["node"]), int(r["peer"]), int(r["message"])) for r in rows]
        for kind, rows in count.items()
    }
    fates = ends["deliver"] + ends["lost"] + ends["late"]
    assert len(set(fates)) == len(fates)  # nothing arrives twice
    assert len(set(ends["send"])) == len(ends["send"])
    under_way = set(ends["send"]) - set(fates)
    assert set(fates) <= set(ends["send"])
    sent_at = {key: float(t) for key, t in zip(ends["send"], count["send"]["t"], strict=True)}
    assert all(sent_at[key] > horizon - 5.0 for key in under_way)


@pytest.mark.one_in(10)
@pytest.mark.parametrize("slots", [True, False])
@pytest.mark.parametrize(
    "filter_", ["hybrid", "constant-gain", "push-sum", "intermittent", "hcmci"]
)
def test_engines_agree_and_accounts_balance(tmp_path, slots, filter_):
    if filter_ == ("hybrid" if slots else "hcmci"):
        return
    for k in range(12):
        if filter_ in ("intermittent", "push-sum") and not slots:
            k = 4 * k + {"intermittent": 2, "push-sum": 0}[filter_]  # noqa: PLW2901 - their clocks
        scenario = combined(tmp_path, slots, filter_, k)
        assert scenario.network.lives
        one, other = (
            netkf.simulate(scenario, seed=k, engine=engine) for engine in ("simpy", "compiled")
        )
        assert one.fingerprint == other.fingerprint
        assert one.status == "complete"
        np.testing.assert_allclose(other.P, one.P, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(other.xhat, one.xhat, rtol=1e-10, atol=1e-10)
        assert_accounts_balance(one.log, scenario.horizon)


@pytest.mark.one_in(2)
@pytest.mark.parametrize(
    ("slots", "filter_", "numbers"),
    [
        (True, "push-sum", (3, 4, 5)),
        (True, "hcmci", (1, 5)),
        (False, "intermittent", (2, 6, 14)),
        (False, "push-sum", (0, 4)),
    ],
)
def test_exact_errors_know_the_covariances_of_every_filter(tmp_path, slots, filter_, numbers):
    # The errors of runs, in units of their exact joint covariance, are standard normal.
    squares, size = 0.0, 0
    for k in numbers:
        scenario = combined(tmp_path, slots, filter_, k)
        run = netkf.simulate(scenario, seed=k, engine="compiled")
        law = error_law(scenario, run)
        np.testing.assert_allclose(law.P, run.P, rtol=1e-9, atol=1e-9)
        values, vectors = np.linalg.eigh(law.covariance)
        known = values > 1e-9 * values.max()
        errors = vectors.T @ ((run.x[:, None] - run.xhat).reshape(-1) - law.mean)
        squares += float((errors[known] ** 2 / values[known]).sum())
        size += int(known.sum())
        assert np.abs(errors[~known]).max(initial=0.0) < 1e-3
    assert 1e-4 < scipy.stats.chi2(size).cdf(squares) < 1.0 - 1e-4


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("slots", [True, False])
def test_a_node_that_forgets_begins_with_its_mean_whatever_drives_the_plant(
    tmp_path, slots, engine
):
    G = "[[2.0]]" if slots else "[[2.0], [1.0]]"
    driven = f'[plant.input]\nkind = "constant"\nG = {G}\nvalue = [3.0]\n'
    # Up again at 1 + 3 k, without a sample at 4 and 10 under clocks that are not yet used.
    scenario = combined(tmp_path, slots, "intermittent" if slots else "local", 1, driven)
    if not slots:
        scenario = scenario.replace({"probe": [4.0], "sensors.0.sampling.period": 0.75})
    run = netkf.simulate(scenario, seed=1, engine=engine)
    node = 0
    at = run.times.tolist().index(4.0)
    expected = [0.0] if slots else [1.0, -2.0]
    np.testing.assert_allclose(run.xhat[at, node], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("slots", "filter_"),
    [
        (False, {"kind": "local"}),
        (False, {"kind": "hybrid", "epsilon": 0.4}),
        (False, {"kind": "belief-propagation"}),
        (True, {"kind": "local"}),
        (True, {"kind": "intermittent"}),
        (True, {"kind": "belief-propagation", "memory": "all"}),
    ],
    ids=str,
)
def test_errors_of_nodes_that_forget_a_driven_plant_are_its_course(scenario_of, slots, filter_):
    """Without noise errors are their means, in both engines: also where what is known of a mode
    that decays is kept as knowledge of time 0.
    """
    lives, files = recorded("lost")
    scenario = scenario_of(SLOTS if slots else CLOCKS, lives, files)
    n, noise = len(scenario.plant.start_mean), "Q" if slots else "B"
    zero, one = np.zeros((n, n)).tolist(), np.eye(n).tolist()
    u = {"kind": "sine", "G": np.ones((n, 1)).tolist(), "amplitude": 3.0, "frequency": 0.13}
    believed = zero if filter_["kind"] == "belief-propagation" else one
    model = {"cov": one, "model": {noise: believed, "R": [[0.3]]}}
    plant = {f"plant.{noise}": zero, "plant.cov": zero, "plant.input": u}
    plant |= {"plant.F": [[0.9]]} if slots else {}
    scenario = scenario.replace({**plant, "sensors.0.R": [[1e-22]], "filter": filter_ | model})
    run = netkf.simulate(scenario, seed=3, engine="simpy")
    mean = error_law(scenario, run).mean.reshape(run.error.shape)
    assert np.abs(mean).max() > 0.5
    for each in (run, netkf.simulate(scenario, seed=3, engine="compiled")):
        np.testing.assert_allclose(each.error, mean, atol=1e-7)


LATE = """
format = 1
name = "late"
horizon = 5.0
probe = [4.0]
[plant]
kind = "unknown"
A = [[-0.5]]
B = [[0.8]]
mean = [3.0]
cov = [[2.0]]
input = {{ kind = "constant", G = [[1.0]], value = 2.0 }}
{schedule}
[[sensors]]
kind = "recorded"
nodes = [0]
path = "y.csv"
H = [[1.0]]
R = [[0.3]]
[network]
graph = {{ kind = "path", nodes = 2 }}
activation = {{ kind = "readings" }}
channel = {{ delay = {{ kind = "constant", seconds = 0.2 }} }}
lives = [{{ kind = "recorded", nodes = [1], path = "l.csv", memory = "lost" }}]
[filter]
kind = "intermittent"
late = "{late}"
"""


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_late_readings_after_a_restart_of_a_driven_plant(tmp_path, engine):
    (tmp_path / "y.csv").write_text("t,node,y0\n1,0,2.5\n3.6,0,5.5\n")
    (tmp_path / "l.csv").write_text("t,node,what\n2,1,down\n3.2,1,up\n")
    (tmp_path / "late.toml").write_text(LATE.format(schedule="", late="exact"))
    run = netkf.simulate(netkf.load(tmp_path / "late.toml"), engine=engine)
    x, P, decay = 3.0, 2.0, np.exp(-0.5 * 0.4)
    for y in (5.5, None):  # from the restart at 3.2 to the reading, and on to 4.0
        x, P = decay * x + 4.0 * (1.0 - decay), decay**2 * P + 0.64 * (1.0 - decay**2)
        gain = 0.0 if y is None else P / (P + 0.3)
        x, P = x + gain * ((y or 0.0) - x), (1.0 - gain) * P
    np.testing.assert_allclose([run.xhat[0, 1, 0], run.P[0, 1, 0, 0]], [x, P], rtol=1e-12)
    # What repeats no past may forget, whatever changes.
    schedule = "schedule = [{ from = 2.0, A = [[-1.0]] }]"
    (tmp_path / "late.toml").write_text(LATE.format(schedule=schedule, late="drop"))
    assert netkf.load(tmp_path / "late.toml").forgetful_nodes == (1,)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("engine", ["simpy", "compiled"])
@pytest.mark.parametrize("slots", [True, False])
def test_recorded_twins_replay_to_the_bit(tmp_path, slots, engine):
    for k in (0, 2, 4):
        scenario = combined(tmp_path, slots, "hcmci" if slots else "hybrid", k)
        if k == 2 and engine == "simpy":
            radio = {"bits_per_second": 2000.0, "queue": "drop"}
            scenario = scenario.replace({"network.radio": radio})
        run = netkf.simulate(scenario, seed=k, replica=1, engine=engine)
        path = netkf.export_recorded(run, tmp_path / f"twin{k}")[-1]
        twin = netkf.load(path)
        assert twin.network.radio is None
        assert {life.__class__.__name__ for life in twin.network.lives} == {"RecordedLife"}
        replay = netkf.simulate(twin, replica=1, engine=engine)
        assert replay.fingerprint == run.fingerprint
        np.testing.assert_array_equal(replay.xhat, run.xhat)
        np.testing.assert_array_equal(replay.P, run.P)


def test_crashes_have_their_law():
    life = Crashes(nodes=(0,), mean_up=3.0, mean_down=1.0)
    changes = life.changes(0, lambda: np.random.default_rng(4), 20_000.0)
    t = np.array([0.0, *(change.time for change in changes)])
    gaps = np.diff(t)
    assert gaps[::2].mean() == pytest.approx(3.0, abs=4.5 * 3.0 / np.sqrt(len(gaps) / 2))
    assert gaps[1::2].mean() == pytest.approx(1.0, abs=4.5 * 1.0 / np.sqrt(len(gaps) / 2))
    assert [change.up for change in changes[:3]] == [False, True, False]


@pytest.mark.parametrize(
    ("phase", "expected"),
    [
        (0.0, [(2.0, False), (5.0, True), (7.0, False)]),
        (1.0, [(1.0, True), (3.0, False), (6.0, True), (8.0, False)]),
        (4.0, [(1.0, False), (4.0, True), (6.0, False), (9.0, True)]),
        (9.0, [(1.0, False), (4.0, True), (6.0, False), (9.0, True)]),
        (5.0 * 2.0**900, [(2.0, False), (5.0, True), (7.0, False)]),
    ],
)
def test_duty_cycles(phase, expected):
    life = DutyCycle(nodes=(0,), period=5.0, up=2.0, phase=phase)
    changes = life.changes(0, lambda: None, 10.0)
    assert [(change.time, change.up) for change in changes if change.time < 10.0] == expected


@pytest.mark.parametrize("memory", ["kept", "lost"])
@pytest.mark.parametrize(
    "life",
    [
        'kind = "recorded"\npath = "late.csv"',
        'kind = "recorded"\npath = "twice.csv"',
        'kind = "duty"\nperiod = 100.0\nup = 2.0\nphase = 50.0',
    ],
)
def test_a_node_that_goes_up_after_the_run_is_down_in_it(scenario_of, life, memory):
    files = {
        "late.csv": "t,node,what\n10,1,join\n",
        "twice.csv": "t,node,what\n-5,1,up\n-1,1,down\n1e6,1,up\n",
        "down.csv": "t,node,what\n0,1,down\n",
    }
    prints = set()
    for lives in (life, 'kind = "recorded"\npath = "down.csv"'):
        text = f'[[network.lives]]\nnodes = [1]\nmemory = "{memory}"\n{lives}'
        scenario = scenario_of(CLOCKS, text, files, filter_="hybrid")
        for engine in ("simpy", "compiled"):
            run = netkf.simulate(scenario, seed=2, engine=engine)
            prints.add(run.fingerprint)
            sent = run.events["kind"].isin(["sense", "send", "transmit", "absorb"])
            assert 1 not in set(run.events["node"][sent])
    assert len(prints) == 1


@dataclass(frozen=True, eq=False)
class Stated(Life):
    def changes(self, node, random, horizon):
        return Stated.value


@pytest.mark.parametrize(
    "value",
    [
        [Change(2.0, "crash"), Change(1.0, "restart")],
        [Change(1.0, "crash"), Change(2.0, "crash")],
        [Change(-1.0, "crash")],
        [Change(math.nan, "crash")],
        [Change(1.0, "down")],
        [1.0],
    ],
)
def test_a_life_of_a_user_goes_up_and_down_in_turn(scenario_of, value, monkeypatch):
    monkeypatch.setattr(Stated, "value", value, raising=False)
    scenario = scenario_of(CLOCKS, "", {}).replace({"network.lives": [Stated(nodes=[1])]})
    with pytest.raises(
        netkf.ScenarioError, match=r"Stated.changes must return Change\(time, kind\)"
    ):
        netkf.simulate(scenario)


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_a_node_ticks_at_the_instant_at_which_it_goes_up(scenario_of, engine):
    # In floats 3 times 0.1 is later than 0.3.
    life = '[[network.lives]]\nnodes = [1]\nkind = "duty"\nperiod = 0.1\nup = 0.05'
    clock = {"kind": "periodic", "period": 0.1, "at": "nodes"}
    scenario = scenario_of(CLOCKS, life, filter_="hybrid").replace({"network.activation": clock})
    events = netkf.simulate(scenario, seed=2, engine=engine).events
    assert ((events["kind"] == "tick") & (events["node"] == 1)).sum() == 99


@pytest.mark.parametrize("engine", ["simpy", "compiled"])
def test_a_node_that_is_down_when_the_next_slot_begins_does_not_begin_again(scenario_of, engine):
    life = '[[network.lives]]\nnodes = [1]\nkind = "recorded"\npath = "l.csv"\nmemory = "lost"'
    rows = "t,node,what\n0.2,1,down\n0.3,1,up\n1,1,down\n2.5,1,up\n"
    events = netkf.simulate(scenario_of(SLOTS, life, {"l.csv": rows}), engine=engine).events
    own = events[(events["node"] == 1) & (events["t"] < 4.0)]
    kinds = list(zip(own["t"], own["kind"], strict=True))
    assert [k for k in kinds if k[1] != "sense"] == [(0.2, "crash"), (3.0, "restart")]


def test_the_row_that_says_how_a_node_begins_is_used(scenario_of):
    life = '[[network.lives]]\nnodes = [1, 2]\nkind = "recorded"\npath = "l.csv"'
    rows = "t,node,what\n10,1,join\n20,1,leave\n-2,2,up\n-1,2,down\n20,2,up\n"
    scenario = scenario_of(CLOCKS, life, {"l.csv": rows}, filter_="hybrid")
    assert scenario.network.lives[0].use(10.0).used == 2


def test_no_lives_is_todays_run(scenario_of):
    # A cycle that never ends within the run: everybody is up all the time.
    life = '[[network.lives]]\nkind = "duty"\nnodes = [0, 1, 2]\nperiod = 100.0\nup = 99.0'
    prints = [
        netkf.simulate(
            scenario_of(CLOCKS, lives, filter_="hybrid"), seed=2, engine="simpy"
        ).fingerprint
        for lives in (life, "")
    ]
    assert prints[0] == prints[1]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("memory", ["kept", "lost"])
@pytest.mark.parametrize(
    ("text", "filter_"), [(CLOCKS, "hybrid"), (CONTINUOUS, "hybrid"), (SLOTS, "diffusion")]
)
def test_check_holds_a_run_to_the_promises_that_survive(scenario_of, text, filter_, memory):
    scenario = scenario_of(text, *recorded(memory), filter_=filter_)
    verdict = netkf.check(scenario, runs=20)
    assert verdict
    found = dict(verdict.table[["promise", "verdict"]].to_numpy().tolist())
    assert found["P follows the equations along the events of each run"] == "holds"
    # A node that forgets believes the covariance of time 0, and the state has moved on.
    bound = found["P is at least the covariance of the error, given the events"]
    assert bound == ("holds" if memory == "kept" else "not promised")
    rows = netkf.theory.assumptions(scenario).set_index("assumption")
    assert not rows.loc["nodes are up all the time", "holds"]
    assert ("nodes keep what they know" in rows.index) == (memory == "lost")


def test_check_names_what_leaves_nothing_to_check(scenario_of):
    scenario = scenario_of(CLOCKS, *recorded(), filter_="hybrid")
    with pytest.raises(netkf.TheoryError, match=r"nodes are down at times .* and a gate"):
        netkf.check(scenario.replace({"filter.gate": {"probability": 0.9}}), runs=10)


def test_theory_says_that_no_bound_is_promised(scenario_of):
    scenario = scenario_of(CLOCKS, *recorded(), filter_="hybrid")
    with pytest.raises(netkf.TheoryError):
        netkf.theory.covariance_bound(scenario, [1.0])


REFUSALS = {
    "word": ("t,node,what\n1,1,dwn\n", "l.csv line 2: what must be up, down, join or leave"),
    "twice": ("t,node,what\n1,1,down\n2,1,down\n", "l.csv lines 2 and 3: node 1 is down already"),
    "other node": ("t,node,what\n1,0,down\n", "has rows of nodes that are not in nodes"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(scenario_of, case):
    rows, words = REFUSALS[case]
    with pytest.raises(netkf.ScenarioError) as caught:
        scenario_of(CLOCKS, recorded()[0], {"l.csv": rows})
    assert words in str(caught.value)
    assert "network.lives[0].path" in str(caught.value)


@pytest.mark.parametrize(
    ("slots", "filter_"),
    [
        (True, 'kind = "push-sum"\ngamma = 2\ndelta = 3.0'),
        (False, 'kind = "push-sum"'),
        (True, 'kind = "track-fusion"\nrule = "cross-covariance"'),
    ],
)
def test_nodes_whose_memory_is_that_of_others_too_do_not_forget(scenario_of, slots, filter_):
    text = (SLOTS if slots else CLOCKS).replace('kind = "{filter}"', filter_)
    with pytest.raises(netkf.ScenarioError, match=r"network.lives\[0\].memory: must be kept with"):
        scenario_of(text, *recorded("lost"))
    assert scenario_of(text, *recorded("kept")).network.lives


def test_readings_that_are_counted_but_not_taken(scenario_of):
    """P of these filters counts a reading of every sensor in every slot."""
    text = SLOTS.replace('kind = "{filter}"', 'kind = "push-sum"\ngamma = 2\ndelta = 3.0')
    scenario = scenario_of(text.replace("F = [[1.1]]", "F = [[0.9]]"), *recorded("kept"))
    assert "gains and P count their readings all the same" in scenario.departures[0][1]
    with pytest.raises(netkf.TheoryError, match=r"P is too small, so nothing is promised"):
        netkf.check(scenario, runs=10)
    at_rest = scenario_of(text.replace("nodes = [0, 1, 2]\nH", "nodes = [0]\nH"), *recorded("kept"))
    assert not at_rest.departures


def test_a_node_has_one_life(scenario_of):
    life = '[[network.lives]]\nkind = "crashes"\nnodes = [1]\nmean_up = 2.0\nmean_down = 1.0\n'
    with pytest.raises(netkf.ScenarioError, match=r"network\.lives\[1\]\.nodes: must not have"):
        scenario_of(CLOCKS, life + life)
    with pytest.raises(netkf.ScenarioError, match=r"network\.lives\[0\]\.nodes.*node of the graph"):
        scenario_of(CLOCKS, life.replace("[1]", "[1, 9]"))
    scenario = scenario_of(CLOCKS, life)
    assert netkf.load(write(scenario)).network.lives == scenario.network.lives


def write(scenario):
    from netkf.scenario.writing import as_table, to_toml

    path = scenario._folder / "again.toml"
    path.write_text(to_toml(as_table(scenario)))
    return path


@pytest.mark.parametrize("filter_", ["central", "local"])
def test_ranges_of_nodes_that_are_down_are_missed_alike_by_both_engines(scenario_of, filter_):
    scenario = scenario_of(CLOCKS, *recorded(), filter_=filter_)
    places = [[4.0, 3.0], [-2.0, 1.0], [0.5, -3.0]]
    sensors = [
        # Node 1 alone reads at most of these times: whole instants are missed.
        {"nodes": [1], "sampling": {"kind": "periodic", "period": 0.3}, "positions": places[1:2]},
        {"nodes": [0, 1, 2], "sampling": {"kind": "periodic", "period": 0.5}, "positions": places},
    ]
    ranges = [{"kind": "range", "R": [[0.2]]} | sensor for sensor in sensors]
    assert_agree(scenario.replace({"sensors": ranges}))


@pytest.mark.parametrize("memory", ["kept", "lost"])
@pytest.mark.parametrize("text", [SLOTS, CLOCKS], ids=["slots", "clocks"])
def test_the_central_filter_misses_what_nodes_that_are_down_do_not_read(scenario_of, text, memory):
    scenario = scenario_of(text, *recorded(memory), filter_="central")
    run = assert_agree(scenario)
    if text is SLOTS:
        F, Q, P, H, R = 1.1 * np.eye(1), 0.4 * np.eye(1), 2.0 * np.eye(1), np.eye(1), 0.5
    else:
        A, BB = np.array([[-0.1, 1.0], [0.0, -0.3]]), np.diag([0.04, 1.0])
        both = scipy.linalg.expm(0.25 * np.block([[-A, BB], [np.zeros((2, 2)), A.T]]))
        F, P, H, R = both[2:, 2:].T, np.array([[1.0, 0.2], [0.2, 2.0]]), np.eye(1, 2), 0.3
        Q = F @ both[:2, 2:]
    for row, t in enumerate(run.times[:-1]):
        P = F @ P @ F.T + Q if row else P
        reads = row and t % (1.0 if text is SLOTS else 0.5) == 0.0
        for _ in range(sum(not is_down(t, node) for node in range(3)) if reads else 0):
            P = P - P @ H.T @ H @ P / (H @ P @ H.T + R)
        np.testing.assert_allclose(run.P[row], np.broadcast_to(P, run.P[row].shape), rtol=1e-9)
    # Filters with the right model: P is the covariance of their errors.
    exact = netkf.theory.error_covariance(scenario, run)
    np.testing.assert_allclose(exact, run.P, rtol=1e-9)
    if memory == "lost":
        assert netkf.check(scenario, runs=20)


@pytest.mark.parametrize("text", [SLOTS, CLOCKS, CONTINUOUS], ids=["slots", "clocks", "continuous"])
def test_no_theory_counts_readings_of_nodes_that_are_down(scenario_of, text, tmp_path):
    lives = '[[network.lives]]\nnodes = [0]\nkind = "duty"\nperiod = 4.0\nup = 2.0\n'
    scenario = scenario_of(text, lives)
    rows = netkf.sweep(scenario, {"seed": [1]}, runs=2, workers=1, engine="simpy")
    assert np.isnan(rows[["bound", "central"]].to_numpy()).all()
    with pytest.raises(netkf.TheoryError, match="down at times"):
        netkf.size(scenario, "network.lives.0.up", 1.0, 3.0, "worst_trace<=1", by="theory")
    run = netkf.simulate(scenario, engine="simpy")
    summary = json.loads((netkf.save(run, scenario, tmp_path / "run") / "summary.json").read_text())
    assert summary["central"] is None
    assert [node["bound"] for node in summary["nodes"]] == 3 * [None]
    for function in (netkf.theory.information_level, netkf.theory.steady_error_covariance):
        with pytest.raises(netkf.TheoryError, match="down at times"):
            function(scenario)


def test_a_sweep_takes_wrong_clocks(scenario_of):
    clocks = "[[network.clocks]]\nnodes = [0]\noffset = 0.1\n"
    swept = [
        netkf.sweep(scenario_of(CLOCKS, lines), {"seed": [1]}, workers=1, engine="simpy")
        for lines in (clocks, "")
    ]
    assert np.isnan(swept[0]["bound"]).all()  # filters believe stamps
    assert swept[0]["central"].tolist() == swept[1]["central"].tolist()
