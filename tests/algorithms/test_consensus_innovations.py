"""Consensus plus innovations: its textbook, optimal gains, P without losses, and refusals."""

import numpy as np
import pytest

import netkf
from netkf import theory
from netkf.algorithms.consensus_innovations import gain_sequence, optimal_gain
from netkf.algorithms.filter import Exchange, Reading
from netkf.theory.errors import error_law
from tests.algorithms.test_literature import (
    CENTRAL,
    GRAPH,
    heard_by_slot,
    scenario_of,
    states,
    textbook,
)
from tests.engines.linearity import engine_covariance
from tests.theory.test_replay import close

FILTER = {"kind": "consensus-innovations"}
SURE = {"graph": GRAPH, "activation": {"kind": "broadcast"}}
EXACT = "P is the covariance of the error, given the events"


def gauss_markov(e, theta, sizes):
    """``E[e t'] E[t t']^+``; what is small beside the terms that it is a difference of is 0."""
    size = np.where(sizes > 0.0, np.sqrt(sizes), 1.0)
    U, S, _ = np.linalg.svd(theta / size[:, None], full_matrices=False)
    used = S > 1e-6
    part = U[:, used] / size[:, None]
    return e @ theta.T @ part / S[used] ** 2 @ part.T


def variances(*forms):
    return sum(np.sum(form**2, axis=1) for form in forms)


def gains_by_slot(scenario, slots):
    """B, M, K and P of every node in each slot, from the joint covariance of all errors, each of
    which is a dictionary of factors of x, y and noises in the columns of one large matrix.
    """
    F, Q = scenario.plant.F, scenario.plant.Q
    N, n, eye = len(scenario.nodes), len(F), np.eye(len(F))
    info = [
        H.T @ np.linalg.inv(R) @ H for H, R in map(scenario.observation_matrices, scenario.nodes)
    ]
    G = sum(info)
    V = np.linalg.pinv(G)
    neighbours = [
        sorted({a if b == i else b for a, b in scenario.topology.links if i in (a, b)})
        for i in scenario.nodes
    ]
    L = np.linalg.cholesky(scenario.plant.cov)
    # Rows of factors of independent unit noises: e_x and e_y of each node.
    ex, ey = [L.copy() for _ in range(N)], [G @ L for _ in range(N)]
    rootQ, found = np.linalg.cholesky(Q), []
    for _ in range(slots):
        zero = np.zeros((n, n))
        ex = [np.hstack([F @ e, rootQ]) for e in ex]
        ey = [
            np.hstack([G @ F @ V @ f + G @ F @ (eye - V @ G) @ e[:, :-n], G @ rootQ])
            for e, f in zip(ex_before(ex, F), ey, strict=True)
        ]
        width = ex[0].shape[1]
        ex = [np.hstack([e, *[zero] * N]) for e in ex]
        ey = [np.hstack([f, *[zero] * N]) for f in ey]
        noise = []
        for i in range(N):
            values, vectors = np.linalg.eigh(info[i])
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            s = np.zeros((n, width + N * n))
            s[:, width + i * n : width + (i + 1) * n] = root
            noise.append(s)
        gains, new = [], []
        for i in range(N):
            theta = [ey[i] - ey[j] for j in neighbours[i]] + [info[i] @ V @ ey[i] + noise[i]]
            theta = np.vstack(theta)
            sizes = [variances(ey[i], ey[j]) for j in neighbours[i]]
            squares = (info[i] @ V) ** 2 @ variances(ey[i])
            W = gauss_markov(ey[i], theta, np.concatenate([*sizes, squares + np.diag(info[i])]))
            new.append(ey[i] - W @ theta)
            gains.append(W)
        ey = new
        K, fresh = [], []
        for e, f in zip(ex, ey, strict=True):
            d = G @ e - f
            K.append(gauss_markov(e, d, G**2 @ variances(e) + variances(f)))
            fresh.append(e - K[-1] @ d)
        ex = fresh
        found.append((gains, K, [e @ e.T for e in ex]))
        # As many columns as rows: only products of rows count.
        triangle = np.linalg.qr(np.vstack(ex + ey).T, mode="r").T
        parts = np.split(triangle, 2 * N)
        ex, ey = parts[:N], parts[N:]
    return G, V, info, neighbours, found


def ex_before(ex, F):
    """Undo the prediction of factors, so that pseudo-states are predicted from the same errors."""
    V = np.linalg.inv(F)
    return [np.hstack([V @ e[:, : -len(F)], e[:, -len(F) :]]) for e in ex]


def expected_states(scenario, run):
    G, V, info, neighbours, gains = gains_by_slot(scenario, len(run.times) - 1)
    heard = heard_by_slot(scenario, run, 1)
    F, n, N = scenario.plant.F, len(G), len(info)
    yhat, last = [np.zeros(n)] * N, [np.zeros(n)] * N

    def step(slot, x, P, readings):
        nonlocal yhat, last
        W, K, C = gains[slot - 1]
        yhat = [
            G @ F @ V @ f + G @ F @ (np.eye(n) - V @ G) @ e for e, f in zip(last, yhat, strict=True)
        ]
        up = heard.get(slot, np.zeros((1, N, N)))[0]
        new = []
        for i in range(N):
            theta = [up[i, j] * (yhat[j] - yhat[i]) for j in neighbours[i]]
            z = np.zeros(n)
            if i in readings:
                y, H, R = readings[i]
                z = H.T @ np.linalg.inv(R) @ y - info[i] @ V @ yhat[i]
            new.append(yhat[i] + W[i] @ np.concatenate([*theta, z]))
        yhat = new
        last = [one + K[i] @ (yhat[i] - G @ one) for i, one in enumerate(x)]
        return last, C

    found = list(textbook(scenario, run, step))
    return np.stack([x for x, _ in found]), np.stack([P for _, P in found])


@pytest.mark.parametrize("lossy", [False, True])
def test_the_textbook(lossy, tmp_path):
    # With four states optimal gains of nearly equal estimates have fewer digits than P has.
    for n in (1, 2, 4):
        more = {} if lossy else {"network": SURE}
        scenario = scenario_of(FILTER, tmp_path, 1, n, **more)
        run = netkf.simulate(scenario)
        xhat, P = expected_states(scenario, run)
        np.testing.assert_allclose(run.P, P, rtol=1e-10, atol=1e-10)
        digits = 1e-10 if n < 4 else 1e-8
        np.testing.assert_allclose(run.xhat, xhat, rtol=digits, atol=digits)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("lossy", [False, True])
def test_theory_follows_it_and_p_is_the_covariance_without_losses(lossy, tmp_path):
    more = {"horizon": 4.0, "probe": [0.0, 1.0, 2.0, 3.0]} | ({} if lossy else {"network": SURE})
    scenario = scenario_of(FILTER, tmp_path, 2, 3, **more)
    run = netkf.simulate(scenario)
    exact, _ = engine_covariance(scenario)
    Sigma = theory.error_covariance(scenario, run)
    close(Sigma, exact, 1e-9)
    close(error_law(scenario, run).P, run.P, 1e-9)
    gap = np.abs(np.linalg.eigvalsh(run.P - Sigma)).max()
    assert gap > 1e-3 if lossy else gap < 1e-10


def test_of_many_optimal_gains_the_one_of_least_norm_is_used():
    """Differences that depend on each other, in units of their terms; continuous in all of them."""
    random = np.random.default_rng(5)
    e, few = random.standard_normal((2, 9)), random.standard_normal((3, 9))
    mixing, terms = random.standard_normal((6, 3)), random.uniform(0.1, 50.0, 6)
    theta, unit = mixing @ few, np.sqrt(terms)
    gain = optimal_gain(e, theta, terms)
    # Any optimal gain: that of the three, which are independent. Least squares finds the shortest.
    best = e @ few.T @ np.linalg.inv(few @ few.T)
    shortest = np.linalg.lstsq((mixing / unit[:, None]).T, best.T)[0].T / unit
    np.testing.assert_allclose(gain, shortest, rtol=1e-10, atol=1e-12)
    # Other units and another order of the differences.
    factor, order = random.uniform(1e-3, 1e3, 6), random.permutation(6)
    again = optimal_gain(e, (factor[:, None] * theta)[order], (factor**2 * terms)[order])
    np.testing.assert_allclose(again, (gain / factor)[:, order], rtol=1e-9, atol=1e-12)
    # A fourth direction that becomes smaller and smaller: nothing jumps.
    more = np.outer(random.standard_normal(6), random.standard_normal(9))
    sizes = np.geomspace(1e-2, 1e-10, 4001)
    gains = np.array([optimal_gain(e, theta + size * more, terms) for size in sizes])
    jumps = np.abs(np.diff(gains, axis=0)).max(axis=(1, 2)) / np.abs(gains[1:]).max(axis=(1, 2))
    assert jumps.max() < 0.05
    np.testing.assert_allclose(gains[-1], gain, rtol=1e-6, atol=1e-8)


def test_estimates_without_some_messages_know_no_units_and_no_order(tmp_path):
    """A star whose leaves all know what the hub has told them: which of them it hears does not
    matter, but by which gains it hears those that are left does.
    """
    F, H = np.array([[0.95, 0.2], [-0.1, 0.9]]), np.array([[1.0, 0.5]])
    Q, cov = np.array([[0.2, 0.05], [0.05, 0.1]]), np.array([[2.0, 0.3], [0.3, 1.0]])
    slots = [float(k) for k in range(8)]

    def errors(unit, place, engine):
        T, V = np.diag(unit), np.diag(1.0 / unit)
        plant = {"kind": "linear", "F": T @ F @ V, "Q": T @ Q @ T, "cov": T @ cov @ T}
        plant = {k: v if k == "kind" else v.tolist() for k, v in plant.items()} | {"period": 1.0}
        links = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (3, 4)]
        # The links keep their losses: they are listed in the same order.
        ups = ["slot,phase,step,node,peer"]
        random = np.random.default_rng(2)
        for slot in slots:
            up = [link for link in links if random.random() < 0.6]
            ups += [f"{slot:.0f},0,0,{place[i]},{place[j]}" for i, j in up]
        (tmp_path / "links.csv").write_text("\n".join(ups) + "\n")
        graph = {"kind": "edges", "edges": [[place[i], place[j]] for i, j in links]}
        network = {"graph": graph, "activation": {"kind": "recorded", "path": "links.csv"}}
        sensors = [{"nodes": [place[0]], "H": (H @ V).tolist(), "R": [[0.3]]}]
        more = {"plant": plant, "sensors": sensors, "network": network, "horizon": 8.0}
        scenario = scenario_of(FILTER, tmp_path, probe=slots, **more)
        run = netkf.simulate(scenario, engine=engine)
        Sigma = theory.error_covariance(scenario, run)[:, place]
        return V @ Sigma @ V, (V @ (run.P @ V))[:, place]

    ones, same = np.ones(2), [0, 1, 2, 3, 4]
    Sigma, P = errors(ones, same, "compiled")
    assert np.abs(Sigma - P).max() > 1e-3
    for unit, place in ((np.array([3.7, 0.013]), same), (ones, [3, 0, 4, 1, 2])):
        for engine in ("compiled", "simpy"):
            other = errors(unit, place, engine)
            np.testing.assert_allclose(other[0], Sigma, rtol=1e-8, atol=1e-9)
            np.testing.assert_allclose(other[1], P, rtol=1e-8, atol=1e-9)


def test_a_pseudo_state_that_hides_a_direction(tmp_path):
    """Sensors of one coordinate of two that the plant couples: G has no inverse."""
    plant = {"kind": "linear", "F": [[1.0, 0.5], [0.0, 0.9]], "Q": [[0.1, 0.0], [0.0, 0.2]]}
    plant |= {"cov": [[1.0, 0.0], [0.0, 2.0]], "period": 1.0}
    sensors = [{"nodes": [0, 3], "H": [[1.0, 0.0]], "R": [[0.3]]}]
    more = {"plant": plant, "sensors": sensors, "network": SURE}
    scenario = scenario_of(FILTER, tmp_path, **more)
    run = netkf.simulate(scenario)
    xhat, P = expected_states(scenario, run)
    np.testing.assert_allclose(run.P, P, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(run.xhat, xhat, rtol=1e-9, atol=1e-9)
    close(theory.error_covariance(scenario, run), run.P, 1e-9)


def test_a_reading_of_which_a_row_is_missing_is_compared_with_the_rest(tmp_path):
    """Node 2 has a sensor of one row and one of two; in the slot the first has no reading."""
    scenario = scenario_of(FILTER, tmp_path, 1, 3)
    node, algorithm = 2, scenario.filter.algorithm
    model, info = scenario.slot_models[node], scenario.node_infos[node]
    state = algorithm.predict(algorithm.init(model, *scenario.initial_estimate(node), info), 1.0)
    y, H, R = np.array([0.7, -0.4]), model.H[1:], model.R[1:, 1:]
    slot = Exchange(phase=0, step=0, slot=1)
    after = algorithm.absorb(algorithm.update(state, Reading(y, H, R)), [], slot)
    cov = scenario.initial_estimate(node)[1]
    matrices, network = (model.F[None], model.Q[None], cov), info.network
    gains = gain_sequence(*matrices, network.information, network.heard, ()).at(1)[node]
    G = network.information.sum(axis=0)
    z = H.T @ np.linalg.inv(R) @ (y - H @ np.linalg.pinv(G, hermitian=True) @ state.pseudo)
    yhat = state.pseudo + gains.M @ z
    np.testing.assert_allclose(after.pseudo, yhat, rtol=1e-11)
    xhat = state.xhat + gains.K @ (yhat - G @ state.xhat)
    np.testing.assert_allclose(after.xhat, xhat, rtol=1e-11)
    # Without a reading and messages it stays.
    silent = algorithm.absorb(state, [], slot)
    np.testing.assert_array_equal(silent.pseudo, state.pseudo)


def test_better_than_gains_that_are_not_optimal_and_no_better_than_central(tmp_path):
    more = {"network": SURE, "horizon": 41.0, "probe": [40.0]}
    traces = []
    for algorithm in (CENTRAL, FILTER, {"kind": "local"}):
        scenario = scenario_of(algorithm, tmp_path, 1, **more)
        Sigma = theory.error_covariance(scenario, netkf.simulate(scenario))
        traces.append(np.trace(Sigma[0], axis1=-2, axis2=-1))
    central, ours, local = traces
    assert (central <= ours + 1e-12).all()
    assert (ours < local).all()


def test_checks_promise_p_without_losses(tmp_path):
    for more, verdict in (({"network": SURE}, "holds"), ({}, "not promised")):
        scenario = scenario_of(FILTER, tmp_path, 1, horizon=9.0, **more)
        table = netkf.check(scenario, 10, confidence=0.999, workers=1).table.set_index("promise")
        assert table.loc[EXACT, "verdict"] == verdict
        assert "broken" not in set(table["verdict"])


def test_estimates_that_start_apart_are_refused(tmp_path):
    mean = [[float(k), 0.0] for k in range(5)]
    with pytest.raises(netkf.ScenarioError, match="must be that of all nodes"):
        scenario_of({**FILTER, "mean": mean}, tmp_path)


def test_gains_settle_and_stay(tmp_path):
    """Long runs do not compute gains for ever, and P is the fixed point of the recursion."""
    scenario = scenario_of(FILTER, tmp_path, 1, network=SURE, horizon=401.0, probe=[300.0, 400.0])
    run = netkf.simulate(scenario)
    np.testing.assert_array_equal(run.P[0], run.P[1])
    _, P = states(FILTER, tmp_path, seed=1, network=SURE, horizon=402.0, probe=[100.0])
    np.testing.assert_allclose(P[0], run.P[1], rtol=1e-8)
