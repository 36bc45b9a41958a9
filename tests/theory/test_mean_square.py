"""Exact steady mean squares: every outcome enumerated, closed forms, and simulation."""

import itertools
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy.integrate import quad

import netkf
from netkf import parts, theory
from netkf.engines.compiled.engine import CompiledEngine
from netkf.network.losses import Transmission
from netkf.theory import mean_square
from netkf.theory.common import delayed_jumps
from netkf.theory.promises import compute_promises, promises_text
from tests.algorithms.test_literature import ROTATION, discretised, scenario_of

GAIN = [[0.4], [0.15]]
CONSTANT = {"kind": "constant-gain", "gain": GAIN}
KCF = {"kind": "kcf", "epsilon": 0.7, "share_readings": False}
SENSOR = {"nodes": [0], "H": [[1.0, 0.2]], "R": [[0.3]]}
PATH = {"kind": "edges", "edges": [[0, 1], [1, 2]]}
PLANT = {
    "kind": "linear",
    "F": [[0.9, 0.2], [-0.2, 0.9]],  # it decays: blind nodes that hear nothing have an error
    "Q": [[0.2, 0.05], [0.05, 0.1]],
    "cov": [[1.0, 0.0], [0.0, 1.0]],
    "period": 1.0,
}
BERNOULLI = {"loss": {"kind": "bernoulli", "delivery": 0.6}}
BURSTS = {"kind": "gilbert-elliott", "to_bad": 0.2, "to_good": 0.3}
BURSTS |= {"deliver_good": 0.9, "deliver_bad": 0.1}
CHANNELS = {
    "lossless": {},
    "losses": {**BERNOULLI, "symmetric": False},
    "losses of both": BERNOULLI,
    "bursts": {"loss": BURSTS},
    "bursts each way": {"loss": BURSTS, "symmetric": False},
    "late": {**BERNOULLI, "delay": {"kind": "constant", "seconds": 0.7}},
}


def slots(algorithm, folder, channel, **more):
    network = {"graph": PATH, "activation": {"kind": "broadcast"}, "channel": channel}
    settings = {"plant": PLANT, "sensors": [SENSOR], "network": network}
    return scenario_of(algorithm, folder, **{**settings, **more})


def outcomes(scenario):
    """All states of all chains and arrivals: (probability of a step, state, ways that are up)."""
    channel = scenario.network.channel
    links = [(0, 1), (1, 2)]
    ways = links if channel.symmetric else [way for i, j in links for way in ((i, j), (j, i))]
    late = (channel.delay.fixed or 0.0) > 0.5
    bursts = type(channel.loss).__name__ == "GilbertElliott"

    def both(up):
        heard = set()
        for way, arrives in zip(ways, up, strict=True):
            if arrives and not late:
                heard |= {way, way[::-1]} if channel.symmetric else {way}
        return heard

    states = list(itertools.product((0, 1), repeat=len(ways))) if bursts else [()]
    for after in states:
        p = (
            [(0.9, 0.1)[bad] for bad in after]
            if bursts
            else [channel.loss.mean_delivery(Transmission(way)) for way in ways]
        )
        for up in itertools.product((0, 1), repeat=len(ways)):
            chance = math.prod(q if u else 1.0 - q for q, u in zip(p, up, strict=True))
            yield after, chance, both(up)


def transition(before, after):
    step = ((0.8, 0.2), (0.3, 0.7))
    return math.prod(step[a][b] for a, b in zip(before, after, strict=True))


def kalman_steady(F, Q, H, R):
    P = np.eye(len(F))
    for _ in range(400):
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        P = F @ (np.eye(len(F)) - K @ H) @ P @ F.T + Q
    return P


@cache
def slot_matrices(paper, heard):
    """e+ = A e + G w + K v of one slot of three nodes, written out for one outcome."""
    F, Q = np.array(PLANT["F"]), np.array(PLANT["Q"])
    H, R, n, N = np.array(SENSOR["H"]), np.array(SENSOR["R"]), 2, 3
    one, eye = np.kron(np.ones((N, 1)), np.eye(n)), np.eye(n)
    closed, gain = np.eye(N * n), np.zeros((N * n, 1))
    term = [np.zeros((n, n))] * N
    if paper == "constant_gain":
        L = np.array(GAIN)
    else:
        nothing = np.zeros((0, n)), np.zeros((0, 0))
        steady = [kalman_steady(F, Q, *pair) for pair in ((H, R), nothing, nothing)]
        L = steady[0] @ H.T @ np.linalg.inv(H @ steady[0] @ H.T + R)
        term = [0.7 / (1.0 + np.linalg.norm(P)) * P for P in steady]
    closed[:n, :n], gain[:n] = eye - L @ H, L
    mix, pull = np.eye(N * n), np.zeros((N * n, N * n))
    for j, i in heard:
        a, b = slice(i * n, i * n + n), slice(j * n, j * n + n)
        weight = 1.0 / 3.0 * eye  # Metropolis: node 1 has two neighbours
        mix[a, b] += weight
        mix[a, a] -= weight
        pull[a, b] += term[i]
        pull[a, a] -= term[i]
    ahead = np.kron(np.eye(N), F)
    if paper == "constant_gain":
        return mix @ closed @ ahead, mix @ closed @ one, -mix @ gain
    return (closed + pull) @ ahead, (closed + pull) @ one, -gain


def enumerated(scenario):
    """The solution of vec X_s' = sum p (A (x) A) vec X_s + p pi_s vec(G Q G' + K R K')."""
    Q, R = np.array(PLANT["Q"]), np.array(SENSOR["R"])
    found = list(outcomes(scenario))
    states = sorted({after for after, _, _ in found})
    S, M = len(states), 6
    whole, right = np.zeros((S, M * M, S, M * M)), np.zeros((S, M * M))
    stationary = [math.prod((0.6, 0.4)[bad] for bad in state) for state in states]
    for after, chance, heard in found:
        A, G, K = slot_matrices(scenario.filter.algorithm.analysis.paper, frozenset(heard))
        double, added = np.kron(A, A), (G @ Q @ G.T + K @ R @ K.T).ravel()
        for s, before in enumerate(states):
            p = chance * transition(before, after)
            whole[states.index(after), :, s] += p * double
            right[states.index(after)] += p * stationary[s] * added
    flat = whole.reshape(S * M * M, S * M * M)
    X = np.linalg.solve(np.eye(len(flat)) - flat, right.ravel())
    radius = np.abs(np.linalg.eigvals(flat)).max()
    X = X.reshape(S, M, M).sum(axis=0)
    return [X[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(3)], radius


@pytest.mark.one_in(3)
@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("algorithm", [CONSTANT, KCF], ids=["constant-gain", "kcf"])
def test_every_outcome_enumerated(algorithm, channel, tmp_path):
    scenario = slots(algorithm, tmp_path, CHANNELS[channel])
    X, radius = enumerated(scenario)
    np.testing.assert_allclose(theory.steady_error_covariance(scenario), X, rtol=1e-9, atol=1e-11)
    assert theory.mean_square_radius(scenario) == pytest.approx(radius, rel=1e-7)


def test_readings_of_neighbours_where_nothing_is_lost(tmp_path):
    """Gains settle: the exact covariances of one run after many slots."""
    algorithm = {"kind": "kcf", "epsilon": 0.4}
    scenario = slots(algorithm, tmp_path, {}, horizon=301.0, probe=[300.0])
    run = netkf.simulate(scenario)
    expected = theory.error_covariance(scenario, run)[0]
    np.testing.assert_allclose(theory.steady_error_covariance(scenario), expected, rtol=1e-8)
    lossy = slots(algorithm, tmp_path, BERNOULLI)
    with pytest.raises(netkf.TheoryError, match="gains follow the readings that arrive"):
        theory.steady_error_covariance(lossy)


def test_silent_filters_have_their_riccati_equations(tmp_path):
    sensor = {**SENSOR, "nodes": [0, 1, 2]}
    for kind in ("local", "central"):
        scenario = slots({"kind": kind}, tmp_path, {}, sensors=[sensor])
        count = 1 if kind == "local" else 3
        H, R = np.tile(SENSOR["H"], (count, 1)), SENSOR["R"][0][0] * np.eye(count)
        P = kalman_steady(np.array(PLANT["F"]), np.array(PLANT["Q"]), H, R)
        filtered = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H)
        found = theory.steady_error_covariance(scenario)
        np.testing.assert_allclose(found, [filtered] * 3, rtol=1e-9)


# Under clocks.

ONE_WAY = {"kind": "edges", "edges": [[0, 1]], "directed": True}


def scalar(folder, growth, rate, at="directions", samples=None, **channel):
    """Node 0 reads, node 1 hears it: dx = growth x dt + dw."""
    plant = {"kind": "diffusion", "A": [[growth]], "B": [[1.0]], "cov": [[1.0]]}
    plant |= {} if samples else {"sensing_period": 0.05}
    sensor = {"nodes": [0], "H": [[1.0]], "R": [[0.5]]}
    sensor |= {"sampling": {"kind": "poisson", "rate": samples}} if samples else {}
    network = {
        "graph": ONE_WAY,
        "activation": {"kind": "poisson", "rate": rate, "at": at},
        "channel": channel,
    }
    algorithm = {"kind": "constant-gain", "gain": [[1.3 if samples is None else 0.6]]}
    settings = {"plant": plant, "sensors": [sensor], "network": network, "horizon": 5.0}
    return scenario_of(algorithm, folder, n=1, **{**settings, "probe": 1.0})


@pytest.mark.parametrize("samples", [None, 3.0])
def test_one_node_hears_another(samples, tmp_path):
    """Three linear equations for the second moments of two scalar errors."""
    a, rate, p, w = 0.2, 2.0, 0.7, 0.5
    scenario = scalar(tmp_path, a, rate, samples=samples, loss={"kind": "bernoulli", "delivery": p})
    lam = rate * p
    if samples is None:
        # d X00 = 2 (a - L) X00 + 1 + L^2 R, d X01 = (2 a - L) X01 + 1 + lam w (X00 - X01)
        L, R = 1.3, 0.5
        X00 = (1.0 + L * L * R) / (2.0 * (L - a))
        X01 = (1.0 + lam * w * X00) / (L - 2.0 * a + lam * w)
    else:
        L, R, s = 0.6, 0.5, samples
        X00 = (1.0 + s * L * L * R) / (s * (1.0 - (1.0 - L) ** 2) - 2.0 * a)
        X01 = (1.0 + lam * w * X00) / (s * L - 2.0 * a + lam * w)
    # d X11 = 2 a X11 + 1 + lam ((1 - w)^2 X11 + 2 w (1 - w) X01 + w^2 X00 - X11)
    right = 1.0 + lam * (2.0 * w * (1.0 - w) * X01 + w * w * X00)
    X11 = right / (lam * (1.0 - (1.0 - w) ** 2) - 2.0 * a)
    found = theory.steady_error_covariance(scenario)
    np.testing.assert_allclose(found[:, 0, 0], [X00, X11], rtol=1e-10)


def test_the_threshold_of_a_blind_node(tmp_path):
    """Finite if and only if lambda > 2 a / (w (2 - w))."""
    a, w = 0.3, 0.5
    threshold = 2.0 * a / (w * (2.0 - w))
    for factor, stable in ((0.98, False), (1.02, True)):
        scenario = scalar(tmp_path, a, factor * threshold)
        assert (theory.mean_square_radius(scenario) < 1.0) == stable
    found = theory.steady_error_covariance(scenario)
    assert found[1, 0, 0] > 20.0
    with pytest.raises(netkf.TheoryError, match="no steady mean square"):
        theory.steady_error_covariance(scalar(tmp_path, a, 0.98 * threshold))


def test_bursts_of_one_link_under_a_clock(tmp_path):
    """Four unknowns for each state: the generator written out."""
    a, rate, w, L, R = -0.1, 1.5, 0.5, 1.3, 0.5
    scenario = scalar(tmp_path, a, rate, loss=BURSTS)
    B = np.array([[a - L, 0.0], [0.0, a]])
    flow = np.kron(B, np.eye(2)) + np.kron(np.eye(2), B)
    J = np.array([[1.0, 0.0], [w, 1.0 - w]])
    jump, step, arrives = np.kron(J, J), ((0.8, 0.2), (0.3, 0.7)), (0.9, 0.1)
    whole = np.zeros((2, 4, 2, 4))
    for before in range(2):
        whole[before, :, before] += flow - rate * np.eye(4)
        for after in range(2):
            p = arrives[after]
            whole[after, :, before] += (
                rate * step[before][after] * (p * jump + (1.0 - p) * np.eye(4))
            )
    noise = np.array([[1.0 + L * L * R, 1.0], [1.0, 1.0]]).ravel()
    right = np.concatenate([0.6 * noise, 0.4 * noise])
    X = np.linalg.solve(whole.reshape(8, 8), -right).reshape(2, 2, 2).sum(axis=0)
    found = theory.steady_error_covariance(scenario)
    np.testing.assert_allclose(found[:, 0, 0], np.diag(X), rtol=1e-10)


NETWORK = {"kind": "edges", "edges": [[0, 1], [1, 2], [2, 3], [0, 2]]}


@pytest.mark.parametrize("channel", ["losses", "losses of both"])
@pytest.mark.parametrize("at", ["links", "directions", "nodes"])
def test_clocks_at_links_directions_and_nodes(at, channel, tmp_path):
    """The generator of four scalar errors, from every outcome of every tick."""
    a, rate, p, L, R, s = 0.05, 2.0, 0.6, 0.5, 0.3, 2.0
    plant = {"kind": "diffusion", "A": [[a]], "B": [[0.7]], "cov": [[1.0]]}
    sampling = {"kind": "poisson", "rate": s}
    sensor = {"nodes": [0, 2], "H": [[1.0]], "R": [[R]], "sampling": sampling}
    network = {
        "graph": NETWORK,
        "activation": {"kind": "poisson", "rate": rate, "at": at},
        "channel": CHANNELS[channel],
    }
    algorithm = {"kind": "constant-gain", "gain": [[L]]}
    settings = {"plant": plant, "sensors": [sensor], "network": network, "horizon": 5.0}
    scenario = scenario_of(algorithm, tmp_path, n=1, **{**settings, "probe": 1.0})
    directions, N = scenario.topology.directions, 4
    ticks = {
        "links": [((i, j), (j, i)) for i, j in scenario.topology.links],
        "directions": [(way,) for way in directions],
        "nodes": [tuple(way for way in directions if way[0] == k) for k in range(N)],
    }[at]
    together = at == "links" and channel == "losses of both"
    whole = 2.0 * a * np.eye(N * N)
    noise = 0.49 * np.ones((N, N))
    for ways in ticks:
        for up in itertools.product((0, 1), repeat=1 if together else len(ways)):
            J = np.eye(N)
            for (j, i), arrives in zip(ways, up * len(ways) if together else up, strict=True):
                weight = arrives * scenario.weight(i, j)
                J[i, j] += weight
                J[i, i] -= weight
            chance = math.prod(p if u else 1.0 - p for u in up)
            whole += rate * chance * (np.kron(J, J) - np.eye(N * N))
    for k in (0, 2):
        J = np.eye(N)
        J[k, k] = 1.0 - L
        whole += s * (np.kron(J, J) - np.eye(N * N))
        noise[k, k] += s * L * L * R
    X = np.linalg.solve(whole, -noise.ravel()).reshape(N, N)
    found = theory.steady_error_covariance(scenario)
    np.testing.assert_allclose(found[:, 0, 0], np.diag(X), rtol=1e-9)


# Messages that take time.


def delayed_scalar(a, rate, p, delay, L=1.3, R=0.5, w=0.5):
    """E[e0 e0] and E[e1 e1] where node 1 hears node 0, after ``delay`` seconds, by quadrature of
    E[e(t) r_s(t)], r_s being the error of node 0's estimate of s seconds ago, predicted to t.
    """
    heard, k, h = rate * p * w, 2.0 * a - L, 2.0 * a - rate * p * w
    X00 = (1.0 + L * L * R) / (2.0 * (L - a))

    def added(s):
        return (math.exp(2.0 * a * s) - 1.0) / (2.0 * a)

    def own(s):  # E[e0 r_s]
        return math.exp(k * s) * X00 + (math.exp(k * s) - 1.0) / k

    def slope(s):  # E[m r_s], m being sent before: both are predicted from then on
        return 1.0 + heard * (math.exp(2.0 * a * s) * own(delay - s) + added(s))

    X01 = (1.0 + heard * own(delay)) / (L - 2.0 * a + heard)
    more, _ = quad(lambda s: math.exp(h * (delay - s)) * slope(s), 0.0, delay, epsabs=1e-13)
    across, sent = math.exp(h * delay) * X01 + more, math.exp(2.0 * a * delay) * X00 + added(delay)
    jumps = rate * p * (2.0 * w * (1.0 - w) * across + w * w * sent)
    return X00, (1.0 + jumps) / (rate * p * (1.0 - (1.0 - w) ** 2) - 2.0 * a)


@pytest.mark.parametrize("delay", [1e-6, 0.3, 4.0])
def test_a_node_that_hears_another_late(delay, tmp_path):
    a, rate, p = 0.2, 2.0, 0.7
    late = {"kind": "constant", "seconds": delay}
    scenario = scalar(tmp_path, a, rate, loss={"kind": "bernoulli", "delivery": p}, delay=late)
    found = theory.steady_error_covariance(scenario)
    np.testing.assert_allclose(found[:, 0, 0], delayed_scalar(a, rate, p, delay), rtol=1e-9)


def test_delays_do_not_move_the_threshold_of_a_node_that_nobody_needs(tmp_path):
    """What it hears is bounded: lambda > 2 a / (w (2 - w)) as without delay."""
    a, w = 0.3, 0.5
    threshold, late = 2.0 * a / (w * (2.0 - w)), {"kind": "constant", "seconds": 0.7}
    for factor in (0.98, 1.02):
        scenario = scalar(tmp_path, a, factor * threshold, delay=late)
        radius = theory.mean_square_radius(scenario)
        assert (radius < 1.0) == (factor > 1.0)
        # The proof that needs no radius says the same.
        assert mean_square.linear_errors(scenario).is_bounded == (factor > 1.0)
        if factor < 1.0:  # the mean is stable all the same
            with pytest.raises(netkf.TheoryError, match="no steady mean square"):
                theory.steady_error_covariance(scenario)


def late_network(folder, at, channel, delay, edges=None, horizon=5.0, probe=1.0):
    """Four nodes of a plant that turns, two of which take samples; or other ones."""
    growth, graph = -0.1, NETWORK if edges is None else {"kind": "edges", "edges": edges}
    plant = {
        "kind": "diffusion",
        "A": [[growth, 1.0], [-1.0, growth]],
        "B": [[0.5, 0.1], [0.0, 0.7]],
    }
    plant |= {"cov": [[1.0, 0.0], [0.0, 1.0]]}
    sampling = {"kind": "poisson", "rate": 2.0}
    nodes = [0, 2] if edges is None else [0]
    sensor = {"nodes": nodes, "H": [[1.0, 0.3]], "R": [[0.3]], "sampling": sampling}
    channel = {**CHANNELS[channel], "delay": {"kind": "constant", "seconds": delay}}
    network = {"graph": graph, "channel": channel}
    network["activation"] = {"kind": "poisson", "rate": 1.5, "at": at}
    algorithm = {"kind": "constant-gain", "gain": [[0.5], [0.1]]}
    return scenario_of(
        algorithm, folder, plant=plant, sensors=[sensor], network=network, horizon=horizon,
        probe=probe,
    )  # fmt: skip


@pytest.mark.one_in(3)
@pytest.mark.parametrize("channel", ["losses", "losses of both"])
@pytest.mark.parametrize("at", ["links", "directions", "nodes"])
def test_a_short_delay_is_nearly_none(at, channel, tmp_path):
    none = theory.steady_error_covariance(late_network(tmp_path, at, channel, 0.0))
    short = theory.steady_error_covariance(late_network(tmp_path, at, channel, 1e-7))
    np.testing.assert_allclose(short, none, rtol=2e-6, atol=1e-9)


def test_large_and_small_problems_are_solved_alike(tmp_path, monkeypatch):
    """By elimination and by iteration, and with half as many points again."""
    scenario = late_network(tmp_path, "links", "losses", 0.8, edges=[[0, 1]])
    small = theory.steady_error_covariance(scenario)
    for name, value in (("MAX_DENSE", 0), ("MAX_DENSE_MEAN", 0), ("MIN_POINTS", 18)):
        monkeypatch.setattr(delayed_jumps, name, value)
        again = theory.steady_error_covariance(scenario.replace({"name": name}))
        np.testing.assert_allclose(again, small, rtol=1e-10)


def test_nodes_of_a_ring_that_are_alike_have_one_mean_square(tmp_path):
    """100 errors: the problem has no symmetry in it but that of the network."""
    ring = {"kind": "cycle", "nodes": 50}
    scenario = late_network(tmp_path, "links", "losses", 0.8, edges=[[0, 1]])
    changes = {"network.graph": ring, "sensors.0.nodes": list(range(50))}
    found = theory.steady_error_covariance(scenario.replace(changes))
    np.testing.assert_allclose(found, np.broadcast_to(found[0], found.shape), rtol=1e-9)
    # Of three nodes each hears two others, as here, but what they say is more alike.
    changes = {"network.graph.nodes": 3, "sensors.0.nodes": [0, 1, 2]}
    few = theory.steady_error_covariance(scenario.replace({"network.graph": ring}).replace(changes))
    assert np.trace(found[0]) < np.trace(few[0]) < 1.1 * np.trace(found[0])


def late_averages(folder, at, channel, horizon):
    """Exact traces, those of exact covariances given the events averaged over a run, and their
    standard errors, of means of 40 parts.
    """
    scenario = late_network(folder, at, channel, 0.4, horizon=horizon, probe=0.5)
    expected = np.trace(theory.steady_error_covariance(scenario), axis1=1, axis2=2)
    given = theory.error_covariance(scenario, netkf.simulate(scenario, seed=5))
    traces = np.trace(given, axis1=2, axis2=3)[100:]
    parts = traces[: len(traces) // 40 * 40].reshape(40, -1, traces.shape[1]).mean(axis=1)
    return expected, parts.mean(axis=0), parts.std(axis=0, ddof=1) / math.sqrt(40)


@pytest.mark.slow
def test_a_run_with_delays_has_these_mean_squares(tmp_path):
    """Without delays they would be smaller by 8 to 14 %."""
    expected, mean, deviation = late_averages(tmp_path, "links", "losses", 1200.0)
    assert (deviation < 0.015 * expected).all()
    assert np.abs((mean - expected) / deviation).max() < 4.5
    none = theory.steady_error_covariance(late_network(tmp_path, "links", "losses", 0.0))
    assert (np.trace(none, axis1=1, axis2=2) < 0.93 * expected).all()


@pytest.mark.slow
@pytest.mark.parametrize("channel", ["losses", "losses of both"])
@pytest.mark.parametrize("at", ["links", "directions", "nodes"])
def test_hundred_thousand_events_with_delays(at, channel, tmp_path):
    expected, mean, deviation = late_averages(tmp_path, at, channel, 3000.0)
    assert (deviation < 0.01 * expected).all()
    assert np.abs((mean - expected) / deviation).max() < 4.5


EACH = {"kind": "periodic", "period": 0.5}


@pytest.mark.parametrize("channel", ["lossless", "losses", "losses of both"])
def test_periodic_clocks_with_samples_at_their_ticks_are_slots(channel, tmp_path):
    """Over the exact discretisation of the plant."""
    A, B = np.array(ROTATION["A"]), np.array(ROTATION["B"])
    F, Q = discretised(A, B @ B.T, 0.5)
    plant = {"kind": "linear", "F": F.tolist(), "Q": Q.tolist(), "period": 0.5}
    plant["cov"] = ROTATION["cov"]
    chosen = {**CHANNELS, "lossless": {}}[channel]
    symmetric = chosen.get("symmetric", True)
    network = {"graph": PATH, "channel": chosen}
    clock = {**EACH, "at": "links" if symmetric else "nodes"}
    over, times = {"plant": ROTATION, "probe": 1.0}, {"horizon": 5.0}
    sampled = scenario_of(
        CONSTANT, tmp_path, sensors=[{**SENSOR, "sampling": EACH}],
        network={**network, "activation": clock}, **over, **times,
    )  # fmt: skip
    slotted = scenario_of(
        CONSTANT, tmp_path, sensors=[SENSOR], plant=plant, probe=1.0,
        network={**network, "activation": {"kind": "broadcast"}}, **times,
    )  # fmt: skip
    expected = theory.steady_error_covariance(slotted)
    np.testing.assert_allclose(theory.steady_error_covariance(sampled), expected, rtol=1e-9)
    radius = theory.mean_square_radius(slotted)
    assert theory.mean_square_radius(sampled) == pytest.approx(radius, rel=1e-9)


@pytest.mark.slow
def test_messages_that_take_time_under_periodic_clocks(tmp_path):
    """Against the errors of a long run without losses, which follow from its events alone."""
    sensor = {**SENSOR, "sampling": EACH}
    network = {"graph": PATH, "activation": {**EACH, "at": "links"}}
    network["channel"] = {"delay": {"kind": "constant", "seconds": 0.125}}
    times = {"horizon": 60.0, "probe": [58.0, 58.625]}
    scenario = scenario_of(
        CONSTANT, tmp_path, plant=ROTATION, sensors=[sensor], network=network, **times
    )
    exact = theory.error_covariance(scenario, netkf.simulate(scenario, engine="simpy"))[1]
    np.testing.assert_allclose(theory.steady_error_covariance(scenario), exact, rtol=1e-7)
    late = scenario.replace({"network.channel.delay": {"kind": "constant", "seconds": 0.5}})
    with pytest.raises(netkf.TheoryError, match="where it is below the period"):
        theory.steady_error_covariance(late)


def test_increments_between_periodic_ticks(tmp_path):
    """One node reads without pause, another hears it every T seconds: closed forms of a scalar."""
    a, L, R, T, w = 0.2, 1.3, 0.5, 0.8, 0.5
    scenario = scalar(tmp_path, a, 1.0)
    activation = {"kind": "periodic", "period": T, "at": "directions"}
    scenario = scenario.replace({"network.activation": activation})
    d = a - L
    X00 = (1.0 + L * L * R) / (-2.0 * d)
    # Over a gap: X01 -> e^{(d + a) T} X01 + q01 and X11 -> e^{2 a T} X11 + q11, then the reset.
    f01, f11 = math.exp((d + a) * T), math.exp(2.0 * a * T)
    q01, q11 = (f01 - 1.0) / (d + a), (f11 - 1.0) / (2.0 * a)
    X01 = ((1.0 - w) * q01 + w * X00) / (1.0 - (1.0 - w) * f01)
    before = f01 * X01 + q01
    right = (1.0 - w) ** 2 * q11 + 2.0 * w * (1.0 - w) * before + w * w * X00
    X11 = right / (1.0 - (1.0 - w) ** 2 * f11)
    found = theory.steady_error_covariance(scenario)
    np.testing.assert_allclose(found[:, 0, 0], [X00, X11], rtol=1e-10)


@dataclass(frozen=True, eq=False)
class OwnBursts(parts.Loss):
    """The bursts above, by what a user's class states of them."""

    stateful = True
    chain = parts.Chain(BURSTS["to_bad"], BURSTS["to_good"], 0.9, 0.1)

    def next_state(self, link, bad, random):
        return bool(random.random() < (0.4 if bad is None else 0.7 if bad else 0.2))

    def delivery_probability(self, sent):
        return 0.1 if sent.bad else 0.9


@dataclass(frozen=True, eq=False)
class OwnTicks(parts.LinkClock):
    gaps = parts.Lattice(0.5, 0.5)

    def ticks(self, entity, origin, index, now, random, count):
        return 0.5 * np.arange(index + 1, index + 1 + count)

    def mean_rate(self, entity):
        return 2.0


def test_what_users_classes_state_is_what_built_in_ones_have(tmp_path):
    bursty = slots(CONSTANT, tmp_path, CHANNELS["bursts"])
    network = {"graph": PATH, "activation": {**EACH, "at": "nodes"}}
    sampled = {**SENSOR, "sampling": EACH}
    ticking = scenario_of(CONSTANT, tmp_path, plant=ROTATION, sensors=[sampled], network=network)
    clocks = {"network.activation": OwnTicks(at="nodes"), "sensors[0].sampling": OwnTicks()}
    for scenario, own in ((bursty, {"network.channel.loss": OwnBursts()}), (ticking, clocks)):
        expected = theory.steady_error_covariance(scenario)
        found = theory.steady_error_covariance(scenario.replace(own))
        np.testing.assert_allclose(found, expected, rtol=1e-12)


# Refusals, and what netkf theory prints.


def test_what_has_no_constant_gains_is_refused_with_the_reason(tmp_path):
    periodic = {"kind": "periodic", "period": 1.0}
    activation = {"kind": "poisson", "rate": 1.0, "at": "nodes"}
    clocked = {
        "plant": ROTATION,
        "network": {"graph": PATH, "activation": activation},
        "sensors": [{**SENSOR, "sampling": periodic}],
    }
    apart = {"graph": PATH, "activation": {**EACH, "at": "nodes"}}
    bursts = {"graph": {"kind": "complete", "nodes": 6}, "activation": {"kind": "broadcast"}}
    bursts |= {"channel": {"loss": BURSTS}}
    late = {"kind": "constant", "seconds": 0.1}
    cases = [
        (slots({"kind": "hcmci"}, tmp_path, {}), "whose gains follow what happens"),
        (scenario_of(CONSTANT, tmp_path, **clocked), "does not sample by a Poisson clock"),
        (slots(CONSTANT, tmp_path, {}, network=bursts), "2^15 joint states"),
        (
            slots({**CONSTANT, "model": {"F": [[0.9, 0.0], [0.0, 0.9]]}}, tmp_path, {}),
            "the filters' plant is not the true one",
        ),
        (
            slots(CONSTANT, tmp_path, {"delay": {"kind": "exponential", "mean": 0.1}}),
            "known for no delay or a fixed one",
        ),
        (
            scenario_of(CONSTANT, tmp_path, **{**clocked, "network": apart}),
            "do not sample at the ticks",
        ),
        (scalar(tmp_path, 0.1, 5.0, loss=BURSTS, delay=late), "take no time"),
        (scalar(tmp_path, 0.1, 5000.0, delay=late), "give a shorter delay or lower rates"),
    ]
    for scenario, words in cases:
        with pytest.raises(netkf.TheoryError) as caught:
            theory.steady_error_covariance(scenario)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)


def test_netkf_theory_prints_it(tmp_path):
    scenario = slots(CONSTANT, tmp_path, CHANNELS["losses"])
    found = compute_promises(scenario)
    traces = np.trace(theory.steady_error_covariance(scenario), axis1=1, axis2=2)
    np.testing.assert_allclose(found["steady_error"]["trace"], traces)
    assert "trace of the steady error covariance, exact: mean " in promises_text(scenario, found)
    grown = {**PLANT, "F": [[1.2, 0.2], [-0.2, 1.2]]}
    unstable = slots(CONSTANT, tmp_path, CHANNELS["losses"], plant=grown)
    words = promises_text(unstable, compute_promises(unstable))
    assert "no steady mean square: its radius is 1." in words


def test_two_hundred_errors_take_seconds(tmp_path):
    network = {
        "graph": {"kind": "grid", "rows": 10, "columns": 10},
        "activation": {"kind": "broadcast"},
        "channel": BERNOULLI,
    }
    sensors = [{**SENSOR, "nodes": list(range(0, 100, 3))}]
    scenario = slots(CONSTANT, tmp_path, {}, network=network, sensors=sensors)
    found = theory.steady_error_covariance(scenario)
    # Nodes of a grid that is symmetric but for its sensors: the last one has a sensor.
    assert found.shape == (100, 2, 2)
    assert np.linalg.eigvalsh(found).min() > 0.0


# Simulation.


def simulated(scenario, runs, seed=3):
    """Squared errors (runs, N) of the last sample."""
    batches = CompiledEngine().run_many(scenario, seed, range(runs))
    e = np.concatenate([batch.error[:, -1] for batch in batches])
    return (e**2).sum(axis=-1)


def drawn(seed, folder):
    """A random scenario in slots: plant, sensors, gains, graph and channel."""
    random = np.random.default_rng([17, seed])
    n, N = int(random.integers(1, 4)), int(random.integers(3, 7))
    F, root = random.standard_normal((2, n, n))
    F *= random.uniform(0.8, 1.02) / np.abs(np.linalg.eigvals(F)).max()
    H, R = random.standard_normal((1, n)), [[float(random.uniform(0.1, 1.0))]]
    P = np.eye(n)
    for _ in range(200):
        P = F @ (P - P @ H.T @ H @ P / (H @ P @ H.T + R)) @ F.T + root @ root.T
    gain = P @ H.T / (H @ P @ H.T + R) * random.uniform(0.7, 1.1)
    plant = {**PLANT, "F": F.tolist(), "Q": (root @ root.T).tolist()}
    plant["cov"] = np.eye(n).tolist()
    channel = dict(list(CHANNELS.values())[seed % 4])
    network = {
        "graph": {"kind": "path" if seed % 2 else "cycle", "nodes": N},
        "activation": {"kind": "broadcast"},
        "channel": channel,
    }
    sensors = [{"nodes": list(range(0, N, 2)), "H": H.tolist(), "R": R}]
    algorithm = {"kind": "constant-gain", "gain": gain.tolist()}
    return scenario_of(
        algorithm, folder, plant=plant, sensors=sensors, network=network,
        horizon=151.0, probe=[150.0],
    )  # fmt: skip


def compare(seeds, runs, folder):
    """z of the mean squared error of each node, for scenarios with light tails."""
    found = []
    for seed in seeds:
        scenario = drawn(seed, folder)
        radius = theory.mean_square_radius(scenario)
        # Near 1 the fourth moments are infinite, and 150 slots too few.
        if radius > 0.88:
            continue
        traces = np.trace(theory.steady_error_covariance(scenario), axis1=1, axis2=2)
        squares = simulated(scenario, runs)
        deviation = squares.std(axis=0) / math.sqrt(runs)
        assert (deviation < 0.05 * math.sqrt(2000 / runs) * traces).all()
        found.extend(((squares.mean(axis=0) - traces) / deviation).tolist())
    return np.array(found)


def test_simulations_have_these_mean_squares(tmp_path):
    """Errors of 10 % would be five standard errors at every node."""
    z = compare(range(6), 2000, tmp_path)
    assert len(z) >= 12
    assert np.abs(z).max() < 4.5


@pytest.mark.slow
def test_thirty_scenarios_against_many_runs(tmp_path):
    z = compare(range(31), 100_000, tmp_path)
    assert len(z) >= 100
    assert np.abs(z).max() < 5.0


@pytest.mark.parametrize(("growth", "known"), [(0.9, True), (1.0, False), (1.1, False)])
def test_tracks_of_blind_nodes_have_a_steady_mean_square_if_the_plant_decays(
    tmp_path, growth, known
):
    plant = {"kind": "linear", "F": [[growth]], "Q": [[0.1]], "cov": [[1.0]], "period": 1.0}
    sensors = [{"nodes": [0], "H": [[1.0]], "R": [[1.0]]}]
    tracks = {"kind": "track-fusion", "rule": "cross-covariance"}
    scenario = slots(tracks, tmp_path, {}, plant=plant, sensors=sensors)
    if known:
        found = theory.steady_error_covariance(scenario)
        np.testing.assert_allclose(found[2], 0.1 / (1.0 - growth**2), rtol=1e-9)
        return
    with pytest.raises(netkf.TheoryError, match="not below 1, and errors grow in the mean square"):
        theory.steady_error_covariance(scenario)
    assert "no steady mean square" in promises_text(scenario, compute_promises(scenario))
