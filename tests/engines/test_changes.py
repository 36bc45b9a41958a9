"""Plants that change at stated times: both engines against the textbook recursions, in which the
matrices of the piece that holds stand for those of the plant.
"""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

import netkf
from netkf.algorithms.traits import Timing
from netkf.core.errors import ScenarioError
from netkf.engines.compiled.engine import CompiledEngine
from netkf.parts import Filter, Filtering
from netkf.scenario.reading import from_table

ENGINES = ("simpy", "compiled")
H, R = np.array([[1.0, 0.3]]), np.array([[0.4]])
F = [np.array([[1.0, 0.4], [-0.1, 0.9]]), np.array([[0.7, -0.5], [0.6, 0.8]]), 0.95 * np.eye(2)]
Q = [np.array([[0.2, 0.05], [0.05, 0.1]]), np.array([[0.05, 0.0], [0.0, 0.6]]), np.eye(2)]
CHANGES = (6, 13)  # slots
SCHEDULE = [
    {"from": 3.0, "F": F[1].tolist(), "Q": Q[1].tolist()},
    {"from": 6.5, "F": F[2].tolist(), "Q": Q[2].tolist()},
]


def slots(kind, folder=None, horizon=10.0, **changes):
    """Three nodes on a line, a slot each half second, with recorded readings if in a ``folder``."""
    sensor = {"H": H.tolist(), "R": R.tolist(), "nodes": [0, 1, 2]}
    plant = {"kind": "linear", "cov": np.eye(2).tolist(), "F": F[0].tolist(), "Q": Q[0].tolist()}
    if folder is not None:
        sensor |= {"kind": "recorded", "path": "readings.csv"}
        plant["kind"] = "unknown"
    table = {
        "format": 1,
        "name": "changes",
        "horizon": horizon,
        "probe": 0.5,
        "plant": {**plant, "period": 0.5, "schedule": SCHEDULE, **changes.pop("plant", {})},
        "sensors": [sensor],
        "network": {
            "graph": {"kind": "path", "nodes": 3},
            "activation": {"kind": "broadcast"},
            **changes.pop("network", {}),
        },
        "filter": {"kind": kind, **changes.pop("filter", {})},
    }
    return from_table({**table, **changes}, folder or Path())


def record(folder, instants, seed=3):
    """Readings of all nodes at ``instants``, and their table in the folder."""
    y = np.random.default_rng(seed).normal(size=(len(instants), 3))
    rows = [f"{t!r},{i},{float(y[k, i])!r}" for k, t in enumerate(instants) for i in range(3)]
    (folder / "readings.csv").write_text("\n".join(["t,node,y0", *rows]) + "\n")
    return y


def piece(slot):
    """The matrices by which slot ``slot`` is predicted to the next one."""
    k = int(np.searchsorted(CHANGES, slot, side="right"))
    return F[k], Q[k]


def predict(x, P, slot):
    Fk, Qk = piece(slot)
    return Fk @ x, Fk @ P @ Fk.T + Qk


def update(x, P, y):
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + K @ (y - H @ x), (np.eye(2) - K @ H) @ P


def agree(run, node, k, x, P, tolerance=1e-9):
    np.testing.assert_allclose(run.xhat[k, node], x, rtol=tolerance, atol=tolerance)
    np.testing.assert_allclose(run.P[k, node], P, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("engine", ENGINES)
def test_in_slots_local_filters_follow_the_changes(tmp_path, engine):
    y = record(tmp_path, [0.5 * k for k in range(20)])
    run = netkf.simulate(slots("local", tmp_path), engine=engine)
    for node in range(3):
        x, P = np.zeros(2), np.eye(2)
        for k in range(1, 20):
            x, P = update(*predict(x, P, k - 1), y[k, node : node + 1])
            agree(run, node, k, x, P)


@pytest.mark.parametrize("engine", ENGINES)
def test_filters_that_are_predictions_follow_the_changes(tmp_path, engine):
    # Of the intermittent filter the state of slot k is its prediction from slot k - 1.
    y = record(tmp_path, [0.5 * k for k in range(20)])
    run = netkf.simulate(slots("intermittent", tmp_path), engine=engine)
    for node, heard in enumerate([(0, 1), (0, 1, 2), (1, 2)]):
        x, P = np.zeros(2), np.eye(2)
        for k in range(20):
            agree(run, node, k, x, P)
            for j in heard:
                x, P = update(x, P, y[k, j : j + 1])
            x, P = predict(x, P, k)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_kalman_consensus_filter_follows_the_changes(tmp_path, engine):
    y = record(tmp_path, [0.5 * k for k in range(20)])
    filtering = {"epsilon": 0.3, "share_readings": False}
    run = netkf.simulate(slots("kcf", tmp_path, filter=filtering), engine=engine)
    states = [(np.zeros(2), np.eye(2)) for _ in range(3)]
    for k in range(1, 20):
        priors = [predict(x, P, k - 1) for x, P in states]
        states = []
        for i, (x, P) in enumerate(priors):
            new, updated = update(x, P, y[k, i : i + 1])
            near = [priors[j][0] - x for j in (i - 1, i + 1) if 0 <= j < 3]
            term = 0.3 / (1.0 + np.linalg.norm(P)) * P @ np.sum(near, axis=0)
            states.append((new + term, updated))
            agree(run, i, k, *states[-1])


@pytest.mark.parametrize("engine", ENGINES)
def test_covariance_intersection_in_slots_follows_the_changes(tmp_path, engine):
    y = record(tmp_path, [0.5 * k for k in range(20)])
    run = netkf.simulate(slots("diffusion", tmp_path), engine=engine)
    weights = np.array([[2.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 1.0, 2.0]]) / 3.0
    states = [(np.zeros(2), np.eye(2)) for _ in range(3)]
    # Of this filter, too, the state of slot k is the prediction from slot k - 1.
    for k in range(1, 20):
        sent = [predict(*update(*s, y[k - 1, i : i + 1]), k - 1) for i, s in enumerate(states)]
        inverses = [np.linalg.inv(P) for _, P in sent]
        states = []
        for i in range(3):
            P = np.linalg.inv(sum(w * Y for w, Y in zip(weights[i], inverses, strict=True)))
            z = sum(w * Y @ x for w, Y, (x, _) in zip(weights[i], inverses, sent, strict=True))
            states.append((P @ z, P))
            agree(run, i, k, *states[-1])


def test_filters_that_do_not_know_keep_the_first_matrices(tmp_path):
    record(tmp_path, [0.5 * k for k in range(20)])
    unaware = slots("diffusion", tmp_path, filter={"model": {"schedule": False}})
    unchanged = slots("diffusion", tmp_path, plant={"schedule": []})
    for engine in ENGINES:
        runs = [netkf.simulate(s, engine=engine) for s in (unaware, unchanged)]
        np.testing.assert_array_equal(runs[0].P, runs[1].P)
        np.testing.assert_array_equal(runs[0].xhat, runs[1].xhat)


SLOT_FILTERS = {
    "central": {},
    "local": {},
    "intermittent": {},
    "kcf": {},
    "diffusion": {},
    "diffusion-kalman": {},
    "icf": {},
    "hcmci": {},
    "one-bit": {},
    "push-sum": {"gamma": 3, "delta": 4.0},
    "push-sum running": {"gamma": 4, "delta": 4.0, "running_sums": True},
    "event-triggered ci": {"trigger": "consensus"},
    "event-triggered": {"trigger": "stochastic", "Y": 1.0, "inner": {"kind": "intermittent"}},
    "belief-propagation": {"memory": "slot"},
    "track-fusion ici": {"rule": "ici"},
    "track-fusion cross": {"rule": "cross-covariance"},
    "constant-gain": {"gain": [[0.4], [0.2]]},
    "consensus-innovations": {},
}


def make_of(name):
    kind, filtering = name.split()[0], dict(SLOT_FILTERS[name])
    return slots(kind, filter=filtering)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOT_FILTERS)
def test_both_engines_agree_in_slots(name):
    s = make_of(name)
    a, b = (netkf.simulate(s, engine=engine) for engine in ENGINES)
    assert a.events.equals(b.events)
    np.testing.assert_array_equal(a.x, b.x)
    np.testing.assert_allclose(a.P, b.P, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(a.xhat, b.xhat, rtol=1e-10, atol=1e-12)


A = [np.array([[0.0, 1.0], [-0.3, -0.1]]), np.array([[-0.5, -2.0], [2.0, 0.1]]), -0.2 * np.eye(2)]
B = [np.array([[0.1], [0.7]]), np.array([[0.3, 0.0], [0.1, 0.5]]), np.array([[0.6], [0.0]])]
TIMES = (2.3, 4.1)
CLOCKED = [{"from": t, "A": A[k + 1].tolist(), "B": B[k + 1].tolist()} for k, t in enumerate(TIMES)]


def clocks(kind, folder=None, **changes):
    """Three nodes on a line in continuous time."""
    sensor = {"H": H.tolist(), "R": R.tolist(), "nodes": [0, 1, 2]}
    plant = {"kind": "diffusion", "cov": np.eye(2).tolist(), "A": A[0].tolist(), "B": B[0].tolist()}
    if folder is not None:
        sensor |= {"kind": "recorded", "path": "readings.csv"}
        plant["kind"] = "unknown"
    else:
        sensor |= changes.pop("sensor", {"sampling": {"kind": "poisson", "rate": 2.0}})
    table = {
        "format": 1,
        "name": "changes",
        "horizon": 6.0,
        "probe": 0.5,
        "plant": {**plant, "schedule": CLOCKED, **changes.pop("plant", {})},
        "sensors": [sensor],
        "network": {
            "graph": {"kind": "path", "nodes": 3},
            "activation": {"kind": "poisson", "at": "nodes", "rate": 2.0},
            **changes.pop("network", {}),
        },
        "filter": {"kind": kind, **changes.pop("filter", {})},
    }
    return from_table({**table, **changes}, folder or Path())


def flow(x, P, start, end):
    """Van Loan over each piece between ``start`` and ``end``."""
    edges = [start, *(t for t in TIMES if start < t < end), end]
    for a, b in itertools.pairwise(edges):
        k = int(np.searchsorted(TIMES, a, side="right"))
        block = expm(np.block([[-A[k], B[k] @ B[k].T], [np.zeros((2, 2)), A[k].T]]) * (b - a))
        Phi = block[2:, 2:].T
        x, P = Phi @ x, Phi @ P @ Phi.T + Phi @ block[:2, 2:]
    return x, P


@pytest.mark.parametrize("engine", ENGINES)
def test_under_clocks_local_filters_follow_the_changes(tmp_path, engine):
    instants = [0.2, 1.7, 2.3, 2.9, 5.5]
    y = record(tmp_path, instants)
    run = netkf.simulate(clocks("local", tmp_path), engine=engine)
    for node in range(3):
        x, P, now = np.zeros(2), np.eye(2), 0.0
        for k, t in enumerate(run.times.tolist()):
            for j, instant in enumerate(instants):
                if now < instant <= t:
                    x, P = update(*flow(x, P, now, instant), y[j, node : node + 1])
                    now = instant
            agree(run, node, k, *flow(x, P, now, t))


@pytest.mark.parametrize("engine", ENGINES)
def test_constant_gains_of_samples_follow_the_changes(engine):
    """P by Joseph's form at the samples, and Van Loan over each piece between them."""
    L = np.array([[0.4], [0.2]])
    sampling = {"kind": "periodic", "period": 0.7}
    options = {"sensor": {"sampling": sampling}, "filter": {"gain": L.tolist()}}
    silent = {"activation": {"kind": "poisson", "at": "nodes", "rate": 1e-9}}
    run = netkf.simulate(clocks("constant-gain", network=silent, **options), engine=engine)
    P, now, kept = np.eye(2), 0.0, np.eye(2) - L @ H
    instants = [round(0.7 * k, 10) for k in range(1, 9)]
    for t in sorted({*instants, *run.times.tolist()}):
        P, now = flow(np.zeros(2), P, now, t)[1], t
        if t in instants:
            P = kept @ P @ kept.T + L @ R @ L.T
        if t in run.times:
            found = run.P[run.times.tolist().index(t)]
            np.testing.assert_allclose(found, np.broadcast_to(P, found.shape), rtol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_constant_gains_of_increments_follow_the_changes(engine):
    """P by Van Loan over each piece with A - L H."""
    L = np.array([[0.4], [0.2]])
    silent = {"activation": {"kind": "poisson", "at": "nodes", "rate": 1e-9}}
    options = {"sensor": {"sampling": "continuous"}, "filter": {"gain": L.tolist()}}
    run = netkf.simulate(clocks("constant-gain", network=silent, **options), engine=engine)
    P, edges = np.eye(2), sorted({*TIMES, *run.times.tolist()})
    for a, b in itertools.pairwise(edges):
        k = int(np.searchsorted(TIMES, a, side="right"))
        closed, noise = A[k] - L @ H, B[k] @ B[k].T + L @ R @ L.T
        block = expm(np.block([[-closed, noise], [np.zeros((2, 2)), closed.T]]) * (b - a))
        Phi = block[2:, 2:].T
        P = Phi @ P @ Phi.T + Phi @ block[:2, 2:]
        if b in run.times:
            found = run.P[run.times.tolist().index(b)]
            np.testing.assert_allclose(found, np.broadcast_to(P, found.shape), rtol=1e-9)


@pytest.mark.parametrize("engine", ENGINES)
def test_gains_of_a_whole_network_follow_the_changes(engine):
    """P of consensus + innovations is the covariance of the error, which the plant's pieces say."""
    scenario = slots("consensus-innovations")
    run = netkf.simulate(scenario, engine=engine)
    exact = netkf.theory.error_covariance(scenario, run)
    np.testing.assert_allclose(run.P, exact, rtol=1e-8, atol=1e-12)
    unaware = scenario.replace({"filter.model": {"schedule": False}})
    assert abs(netkf.simulate(unaware).P - run.P).max() > 0.1


@pytest.mark.parametrize("engine", ENGINES)
def test_late_readings_are_used_exactly_across_changes(tmp_path, engine):
    # Messages take 1.1 s, and all changes lie between a reading and its arrival.
    instants = [0.3, 1.9, 2.1, 3.9, 4.05]
    y = record(tmp_path, instants)
    network = {
        "activation": {"kind": "readings"},
        "channel": {"delay": {"kind": "constant", "seconds": 1.1}},
    }
    run = netkf.simulate(clocks("intermittent", tmp_path, network=network), engine=engine)
    for node, heard in enumerate([(0, 1), (0, 1, 2), (1, 2)]):
        for k, t in enumerate(run.times.tolist()):
            x, P, now = np.zeros(2), np.eye(2), 0.0
            for j, instant in enumerate(instants):
                used = [i for i in heard if instant + 1.1 * (i != node) <= t]
                if used:
                    x, P = flow(x, P, now, instant)
                    now = instant
                for i in used:
                    x, P = update(x, P, y[j, i : i + 1])
            agree(run, node, k, *flow(x, P, now, t))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("delay", [0.0, 0.7])
@pytest.mark.parametrize("kind", ["hybrid", "gossip", "covariance-intersection"])
def test_messages_under_way_are_predicted_over_changes(tmp_path, kind, delay, engine):
    instants = [0.3, 1.9, 2.1, 3.9, 4.05]
    y = record(tmp_path, instants)
    channel = {"delay": {"kind": "constant", "seconds": delay}} if delay else {}
    at = "links" if kind == "gossip" else "nodes"
    activation = {"kind": "poisson", "at": at, "rate": 2.0}
    options = {} if kind == "gossip" else {"epsilon": 0.3}
    network = {"activation": activation, "channel": channel}
    s = clocks(kind, tmp_path, network=network, filter=options)
    run = netkf.simulate(s, engine=engine)
    states, sent, inbox = [(np.zeros(2), np.eye(2), 0.0) for _ in range(3)], {}, {}

    def move(i, t):
        x, P, now = states[i]
        states[i] = (*flow(x, P, now, t), t)
        return states[i][:2]

    rows, k, used = list(run.events.itertuples()), 0, set()
    for t in run.times.tolist():
        while k < len(rows) and rows[k].t <= t:
            e = rows[k]
            k += 1
            if e.kind == "sense":
                j = instants.index(e.t)
                states[e.node] = (*update(*move(e.node, e.t), y[j, e.node : e.node + 1]), e.t)
            elif e.kind == "send":
                sent[e.node, e.peer, e.message] = (*move(e.node, e.t), e.t)
            elif e.kind == "deliver":
                inbox.setdefault(e.node, {})[e.peer] = sent[e.peer, e.node, e.message]
            elif e.kind == "absorb":
                own = move(e.node, e.t)
                messages = [inbox[e.node][peer] for peer in sorted(inbox[e.node])]
                heard = [flow(x, P, start, e.t) for x, P, start in messages]
                del inbox[e.node]
                states[e.node] = (*combine(kind, own, heard), e.t)
        for i in range(3):
            agree(run, i, used.add(t) or len(used) - 1, *move(i, t))


def combine(kind, own, heard):
    if kind == "gossip":
        return heard[-1]
    weights = [1.0 - 0.3 * len(heard), *[0.3] * len(heard)]
    terms = list(zip(weights, [own, *heard], strict=True))
    if kind == "hybrid":
        return sum(w * x for w, (x, _) in terms), sum(w * P for w, (_, P) in terms)
    P = np.linalg.inv(sum(w * np.linalg.inv(P) for w, (_, P) in terms))
    return P @ sum(w * np.linalg.inv(Pj) @ x for w, (x, Pj) in terms), P


CLOCK_FILTERS = {
    "central": {},
    "local": {},
    "hybrid": {"epsilon": 0.3},
    "gossip": {},
    "covariance-intersection": {"epsilon": 0.3},
    "diffusion": {},
    "kcf": {},
    "intermittent": {},
    "track-fusion": {"rule": "ici"},
    "constant-gain": {"gain": [[0.4], [0.2]]},
}
SAMPLES_ONLY = ("kcf", "intermittent")
INCREMENTS = {"sampling": "continuous"}
DELAYS = {"none": {"kind": "none"}, "random": {"kind": "exponential", "mean": 0.4}}
CASES = [
    (kind, sensor, delay)
    for kind in CLOCK_FILTERS
    for sensor in ("samples", "increments")
    for delay in DELAYS
    if sensor == "samples" or kind not in SAMPLES_ONLY
]


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("kind", "sensor", "delay"), CASES)
def test_both_engines_agree_under_clocks(kind, sensor, delay):
    at = {"intermittent": "readings", "gossip": "links"}.get(kind, "nodes")
    activation = {"kind": at} if at == "readings" else {"kind": "poisson", "at": at, "rate": 2.0}
    network = {"activation": activation, "channel": {"delay": DELAYS[delay]}}
    own = {"sensor": INCREMENTS} if sensor == "increments" else {}
    s = clocks(kind, filter=CLOCK_FILTERS[kind], network=network, **own)
    a, b = (netkf.simulate(s, engine=engine) for engine in ENGINES)
    assert a.events.equals(b.events)
    np.testing.assert_allclose(a.x, b.x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(a.P, b.P, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(a.xhat, b.xhat, rtol=1e-9, atol=1e-11)


GAINS = [np.array([[0.5], [0.0]]), np.array([[0.0], [2.0]])]


@pytest.mark.parametrize("engine", ENGINES)
def test_known_inputs_drive_each_piece_in_slots(tmp_path, engine):
    y = record(tmp_path, [0.5 * k for k in range(20)])
    schedule = [SCHEDULE[0], {**SCHEDULE[1], "G": GAINS[1].tolist()}]
    u = {"kind": "sine", "G": GAINS[0].tolist(), "amplitude": 3.0, "frequency": 0.21}
    plant = {"schedule": schedule, "input": u}
    run = netkf.simulate(slots("local", tmp_path, plant=plant), engine=engine)
    x, P = np.zeros(2), np.eye(2)
    for k in range(1, 20):
        x, P = predict(x, P, k - 1)
        G = GAINS[k - 1 >= CHANGES[1]]
        x = x + G[:, 0] * 3.0 * np.sin(2.0 * np.pi * 0.21 * 0.5 * (k - 1))
        x, P = update(x, P, y[k, :1])
        agree(run, 0, k, x, P)


@pytest.mark.parametrize("engine", ENGINES)
def test_known_inputs_drive_each_piece_under_clocks(tmp_path, engine):
    instants = [0.2, 1.7, 2.3, 2.9, 5.5]
    y = record(tmp_path, instants)
    schedule = [CLOCKED[0], {**CLOCKED[1], "G": GAINS[1].tolist()}]
    u = {"kind": "constant", "G": GAINS[0].tolist(), "value": 1.5}
    plant = {"schedule": schedule, "input": u}
    run = netkf.simulate(clocks("local", tmp_path, plant=plant), engine=engine)

    def driven(x, P, start, end):
        for a, b in itertools.pairwise([start, *(t for t in TIMES if start < t < end), end]):
            k = int(np.searchsorted(TIMES, a, side="right"))
            block = np.zeros((3, 3))
            block[:2, :2], block[:2, 2] = A[k], 1.5 * GAINS[k == 2][:, 0]
            x = (expm(block * (b - a)) @ [*x, 1.0])[:2]
            P = flow(x, P, a, b)[1]
        return x, P

    x, P, now = np.zeros(2), np.eye(2), 0.0
    for k, t in enumerate(run.times.tolist()):
        for j, instant in enumerate(instants):
            if now < instant <= t:
                x, P = update(*driven(x, P, now, instant), y[j, :1])
                now = instant
        agree(run, 0, k, *driven(x, P, now, t))


@pytest.mark.parametrize("sensor", ["samples", "increments"])
@pytest.mark.parametrize("unaware", [False, True])
def test_a_known_input_changes_no_error(sensor, unaware):
    own = {"sensor": INCREMENTS} if sensor == "increments" else {}
    u = {"kind": "sine", "G": [[0.5], [1.0]], "amplitude": 2.0, "frequency": 0.4}
    schedule = [CLOCKED[0], {**CLOCKED[1], "G": [[0.0], [2.0]]}]
    model = {"model": {"schedule": False}} if unaware else {}
    plain, driven = (
        clocks("hybrid", plant=plant, filter={"epsilon": 0.3, **model}, **own)
        for plant in ({}, {"schedule": schedule, "input": u})
    )
    runs = [netkf.simulate(s, engine="compiled") for s in (plain, driven)]
    assert runs[0].events.equals(runs[1].events)
    np.testing.assert_array_equal(runs[0].P, runs[1].P)
    if unaware:
        # What filters do not know of the plant is an error that the input drives, too.
        simpy = netkf.simulate(driven, engine="simpy")
        np.testing.assert_allclose(simpy.xhat, runs[1].xhat, rtol=1e-9, atol=1e-10)
        assert np.abs(runs[0].error - runs[1].error).max() > 0.1
    else:
        np.testing.assert_array_equal(runs[0].error, runs[1].error)
        assert np.abs(runs[0].x - runs[1].x).max() > 0.5


@dataclasses.dataclass(frozen=True, eq=False)
class PlainHybrid(Filter):
    """The hybrid filter in plain Python, by what its model says."""

    timing = Timing(schedule=None, clocks=("nodes",))

    def absorb(self, state, messages, exchange):
        """Combine what arrives, predicted to now."""
        x, P = 0.0 * state.xhat, 0.0 * state.root
        own = 1.0 - sum(message.weight for message in messages)
        terms = [(own, state.xhat, state.root)]
        for message in messages:
            payload = message.payload
            terms.append(
                (message.weight, *state.model.extrapolate(payload.xhat, payload.root, message.age))
            )
        for weight, xhat, root in terms:
            x, P = x + weight * xhat, P + weight * root @ root.T
        return state._replace(xhat=x, root=np.linalg.cholesky(P))


@pytest.mark.parametrize("sensor", ["samples", "increments"])
def test_models_of_filters_in_python_follow_the_changes(sensor):
    own = {"sensor": INCREMENTS} if sensor == "increments" else {}
    delay = {"channel": {"delay": {"kind": "constant", "seconds": 0.7}}}
    built_in = clocks("hybrid", filter={"epsilon": 1 / 3}, network=delay, **own)
    own_class = dataclasses.replace(built_in, filter=Filtering(algorithm=PlainHybrid()))
    a, b = (netkf.simulate(s, engine="simpy") for s in (built_in, own_class))
    assert a.events.equals(b.events)
    np.testing.assert_allclose(a.P, b.P, rtol=1e-8)
    np.testing.assert_allclose(a.xhat, b.xhat, rtol=1e-8, atol=1e-9)


@dataclasses.dataclass(frozen=True, eq=False)
class PlainLocal(Filter):
    """A filter in plain Python that sends nothing."""

    timing = Timing(talks=False)


def test_models_of_filters_in_python_follow_the_changes_in_slots():
    built_in = slots("local")
    a = netkf.simulate(built_in, engine="simpy")
    b = netkf.simulate(dataclasses.replace(built_in, filter=Filtering(algorithm=PlainLocal())))
    np.testing.assert_allclose(a.P, b.P, rtol=1e-9)
    np.testing.assert_allclose(a.xhat, b.xhat, rtol=1e-9, atol=1e-10)


def test_blocks_of_the_state_change_each_for_itself():
    table = {
        "format": 1,
        "name": "blocks",
        "horizon": 6.0,
        "probe": 0.5,
        "plants": [
            {
                "name": "target",
                "A": [[0.0]],
                "B": [[1.0]],
                "schedule": [{"from": 2.0, "A": [[-1.0]]}, {"from": 4.0, "B": [[3.0]]}],
            },
            {
                "name": "field",
                "A": [[-0.5]],
                "B": [[0.4]],
                "schedule": [{"from": 4.0, "A": [[0.2]]}],
            },
        ],
        "sensors": [
            {
                "of": name,
                "nodes": [0],
                "H": [[1.0]],
                "R": [[0.1]],
                "sampling": {"kind": "periodic", "period": 0.5},
            }
            for name in ("target", "field")
        ],
        "network": {"graph": {"kind": "path", "nodes": 2}},
        "filter": {"kind": "local", "cov": np.eye(2).tolist()},
    }
    s = from_table(table, Path())
    expected = [([0.0, -0.5], [1.0, 0.4]), ([-1.0, -0.5], [1.0, 0.4]), ([-1.0, 0.2], [3.0, 0.4])]
    assert s.plant.changes.tolist() == [2.0, 4.0]
    for one, (a, b) in zip(s.plant.pieces, expected, strict=True):
        np.testing.assert_array_equal(one.A, np.diag(a))
        np.testing.assert_array_equal(one.B, np.diag(b))
    runs = [netkf.simulate(s, engine=engine) for engine in ENGINES]
    np.testing.assert_allclose(runs[0].P, runs[1].P, rtol=1e-9)


@pytest.mark.parametrize("make", [slots, clocks])
def test_pieces_that_are_equal_are_one_plant(tmp_path, make):
    record(tmp_path, [0.5 * k for k in range(12)])
    matrices = {"F": F[0].tolist(), "Q": Q[0].tolist()}
    if make is clocks:
        matrices = {"A": A[0].tolist(), "B": B[0].tolist()}
    equal = {"schedule": [{"from": t, **matrices} for t in (1.0, 3.5)]}
    kind = "diffusion" if make is slots else "hybrid"
    options = {} if make is slots else {"epsilon": 0.3}
    a, b = (
        netkf.simulate(make(kind, tmp_path, plant=plant, filter=options, horizon=6.0))
        for plant in (equal, {"schedule": []})
    )
    assert a.events.equals(b.events)
    np.testing.assert_allclose(a.P, b.P, rtol=1e-11)
    np.testing.assert_allclose(a.xhat, b.xhat, rtol=1e-10, atol=1e-12)


REFUSED = {
    "push-sum": {"gamma": 3, "delta": 4.0, "asymptotic": True},
    "belief-propagation": {"memory": "all"},
}


@pytest.mark.parametrize("kind", REFUSED)
def test_filters_that_compute_before_a_run_refuse(kind):
    plant = {"Q": np.zeros((2, 2)).tolist()} if kind == "belief-propagation" else {}
    with pytest.raises(
        ScenarioError, match=r"plant.schedule: cannot be followed .*schedule = false"
    ):
        slots(kind, filter=REFUSED[kind], plant=plant)
    assert slots(kind, filter={**REFUSED[kind], "model": {"schedule": False}}, plant=plant)


UNDER_CLOCKS = {
    "push-sum": {"sampling": {"kind": "poisson", "rate": 2.0}},
    "belief-propagation": {"sampling": {"kind": "poisson", "rate": 2.0}},
}
REASONS = {
    "push-sum": "totals keep information under way in parts by the rates at which modes decay",
    "belief-propagation": "evidence that lasts is kept in coordinates of the modes of one plant",
}


@pytest.mark.parametrize("kind", UNDER_CLOCKS)
def test_filters_that_compute_before_a_run_refuse_under_clocks(kind):
    with pytest.raises(ScenarioError, match=r"plant.schedule: cannot be followed by the") as caught:
        clocks(kind, sensor=UNDER_CLOCKS[kind])
    assert REASONS[kind] in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_schedule_in_milliseconds_has_the_same_events():
    scale, network = 1000.0, {"activation": {"kind": "periodic", "at": "nodes", "period": 0.3}}
    sampling = {"kind": "periodic", "period": 0.45}
    s = clocks("hybrid", filter={"epsilon": 0.3}, network=network, sensor={"sampling": sampling})
    schedule = [
        {"from": scale * t, "A": (A[k + 1] / scale).tolist(), "B": (B[k + 1] / scale**0.5).tolist()}
        for k, t in enumerate(TIMES)
    ]
    plant = {"A": (A[0] / scale).tolist(), "B": (B[0] / scale**0.5).tolist(), "schedule": schedule}
    ms = clocks(
        "hybrid",
        filter={"epsilon": 0.3},
        network={"activation": {"kind": "periodic", "at": "nodes", "period": 300.0}},
        sensor={"sampling": {"kind": "periodic", "period": 450.0}},
        plant=plant,
        horizon=6000.0,
        probe=500.0,
    )
    a, b = netkf.simulate(s), netkf.simulate(ms)
    np.testing.assert_allclose(a.events["t"] * scale, b.events["t"], rtol=1e-12)
    assert a.events["kind"].equals(b.events["kind"])
    np.testing.assert_allclose(a.P, b.P, rtol=1e-9)


@pytest.mark.parametrize("case", ["slots", "samples", "increments", "unaware"])
def test_runs_of_a_batch_are_those_of_runs_alone(case):
    loss = {"channel": {"loss": {"kind": "bernoulli", "delivery": 0.6}}}
    model = {"model": {"schedule": case != "unaware"}}
    own = {} if case == "samples" else {"sensor": INCREMENTS}
    options = {"epsilon": 0.3, **model}
    s = (
        slots("diffusion", network=loss)
        if case == "slots"
        else clocks("hybrid", filter=options, **own)
    )
    errors = np.concatenate([batch.error for batch in CompiledEngine().run_many(s, 3, range(9))])
    for replica in (0, 8):
        run = netkf.simulate(s, seed=3, replica=replica, engine="compiled")
        np.testing.assert_array_equal(run.error, errors[replica])
