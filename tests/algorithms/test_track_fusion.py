"""Track fusion: the textbook of each rule in both engines, exact errors, a Lyapunov equation."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

import netkf
from netkf import theory
from netkf.algorithms.kernels.pair_fusion import fuse_pair
from netkf.algorithms.track_fusion import best_combination
from netkf.engines.compiled.engine import CompiledEngine
from netkf.theory.errors import error_law
from tests.algorithms.test_literature import (
    LOSSY,
    clocked,
    heard_by_slot,
    scenario_of,
    textbook,
)
from tests.engines.linearity import engine_covariance
from tests.theory.test_replay import close

BEST = "ci"
INVERSE = "ici"
PAIRS = list(itertools.product((BEST, INVERSE), ("trace", "determinant")))
CROSS = "cross-covariance"
TRACKS = {"kind": "track-fusion", "rule": CROSS}


def fuse_tracks(first, second, inverse, trace):
    """Estimate and root of two pairs of these by the kernel."""
    x, root = (np.array(values, dtype=np.float64) for values in first)
    other_x, other = (np.ascontiguousarray(values) for values in second)
    fuse_pair(x, root, other_x, other, inverse, trace, np.empty((2 * len(x) + 2, len(x))))
    return x, root


def fused(a, b, kind, minimise):
    """Two estimates (x, P) by the formulas of the papers; the weight by Brent's method on the
    derivative of the criterion.
    """
    (x, A), (y, B) = a, b
    V, U, n = np.linalg.inv(A), np.linalg.inv(B), len(x)

    def covariance(w):
        M = np.linalg.inv(w * A + (1.0 - w) * B)
        return np.linalg.inv(V + U - M if kind == INVERSE else w * V + (1.0 - w) * U)

    def derivative(w):
        M, P = np.linalg.inv(w * A + (1.0 - w) * B), covariance(w)
        # dP = -P d(P^-1) P, and d log det P = -tr(P d(P^-1))
        change = M @ (A - B) @ M if kind == INVERSE else V - U
        return -np.trace(P @ change @ (P if minimise == "trace" else np.eye(n)))

    if np.allclose(A, B, rtol=1e-9, atol=0.0):
        w = 0.5
    elif derivative(0.0) >= 0.0 or derivative(1.0) <= 0.0:
        w = 0.0 if derivative(0.0) >= 0.0 else 1.0
    else:
        w = scipy.optimize.brentq(derivative, 0.0, 1.0, xtol=1e-16, rtol=1e-15)
    P = covariance(w)
    if kind == INVERSE:
        M = np.linalg.inv(w * A + (1.0 - w) * B)
        return P @ (V - w * M) @ x + P @ (U - (1.0 - w) * M) @ y, P
    return P @ (w * V @ x + (1.0 - w) * U @ y), P


def kalman(x, P, reading):
    y, H, R = reading
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + K @ (y - H @ x), (np.eye(len(x)) - K @ H) @ P


def expected_states(scenario, run, kind, minimise):
    heard = heard_by_slot(scenario, run, 1)

    def step(slot, x, P, readings):
        for i, reading in readings.items():
            x[i], P[i] = kalman(x[i], P[i], reading)
        sent, up = list(zip(x, P, strict=True)), heard.get(slot, np.zeros((1, len(x), len(x))))[0]
        for i in range(len(x)):
            for j in np.flatnonzero(up[i]):
                x[i], P[i] = fused((x[i], P[i]), sent[j], kind, minimise)
        return x, P

    found = list(textbook(scenario, run, step))
    return np.stack([x for x, _ in found]), np.stack([P for _, P in found])


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("kind", "minimise"), PAIRS)
def test_the_textbook(kind, minimise, tmp_path):
    for n in (1, 4):
        scenario = scenario_of(
            {"kind": "track-fusion", "rule": kind, "minimise": minimise}, tmp_path, 1, n
        )
        for engine in ("simpy", "compiled"):
            run = netkf.simulate(scenario, engine=engine)
            xhat, P = expected_states(scenario, run, kind, minimise)
            np.testing.assert_allclose(run.P, P, rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(run.xhat, xhat, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", [BEST, INVERSE, pytest.param(CROSS, marks=pytest.mark.slow)])
def test_both_engines_make_the_same_run_and_theory_follows_it(kind, tmp_path):
    settings = {"horizon": 4.0, "probe": [0.0, 1.0, 2.0, 3.0]}
    scenario = scenario_of({"kind": "track-fusion", "rule": kind}, tmp_path, 1, **settings)
    fast, slow = (netkf.simulate(scenario, engine=engine) for engine in ("auto", "simpy"))
    assert netkf.first_difference(fast, slow) is None
    np.testing.assert_allclose(fast.P, slow.P, rtol=1e-10, atol=1e-12)
    exact, _ = engine_covariance(scenario)
    close(theory.error_covariance(scenario, fast), exact, 1e-9)
    close(error_law(scenario, fast).P, fast.P, 1e-9)


def test_many_runs_side_by_side_are_the_single_ones(tmp_path):
    scenario = scenario_of({"kind": "track-fusion", "rule": BEST}, tmp_path)
    (batch,) = CompiledEngine().run_many(scenario, 7, range(11))
    for replica in (0, 10):
        run = netkf.simulate(scenario, seed=7, replica=replica, engine="compiled")
        np.testing.assert_array_equal(batch.P[replica], run.P)


@pytest.mark.parametrize("seed", range(3))
def test_known_correlations_beat_inverse_intersection_which_beats_intersection(seed):
    """Tracks with common information: P_BC <= P_ICI <= P_CI in the order of traces."""
    random, n = np.random.default_rng(seed), 3
    common, own, other = (M @ M.T + 0.2 * np.eye(n) for M in random.standard_normal((3, n, n)))
    # x_a has the information of a common estimate and of its own: P^-1 = C^-1 + E^-1.
    A, B = (np.linalg.inv(np.linalg.inv(common) + np.linalg.inv(E)) for E in (own, other))
    cross = A @ np.linalg.inv(common) @ B
    x, y = random.standard_normal((2, n))
    roots = [np.linalg.cholesky(P) for P in (A, B)]
    S_ci, S_ici = (
        fuse_tracks((x, roots[0]), (y, roots[1]), inverse, True)[1] for inverse in (False, True)
    )
    G = (A - cross) @ np.linalg.inv(A + B - cross - cross.T)
    known = A - G @ (A - cross).T
    assert np.trace(known) < np.trace(S_ici @ S_ici.T) < np.trace(S_ci @ S_ci.T)
    # And the claim of inverse intersection holds for such tracks.
    joint = np.block([[A, cross], [cross.T, B]])
    w_x = np.stack(
        [fuse_tracks((e, roots[0]), (0 * e, roots[1]), True, True)[0] for e in np.eye(n)]
    )
    K = w_x.T
    error = np.hstack([K, np.eye(n) - K])
    gap = S_ici @ S_ici.T - error @ joint @ error.T
    assert np.linalg.eigvalsh(gap)[0] > -1e-12


def test_weights_at_equal_covariances_are_one_half():
    """Nothing but rounding would decide: equal nodes must not differ between engines."""
    S = np.linalg.cholesky(np.array([[2.0, 0.3], [0.3, 1.0]]))
    x, y = np.array([1.0, 2.0]), np.array([3.0, -1.0])
    for inverse in (False, True):
        mean, root = fuse_tracks((x, S), (y, S * (1.0 + 1e-15)), inverse, True)
        np.testing.assert_allclose(mean, (x + y) / 2.0, rtol=1e-12)
        np.testing.assert_allclose(root, S, rtol=1e-12)


PAIR = {
    "graph": {"kind": "edges", "edges": [[0, 1]]},
    "activation": {"kind": "broadcast"},
}


@pytest.mark.slow
def test_two_tracks_have_the_cross_covariance_of_a_lyapunov_equation(tmp_path):
    """Bar-Shalom and Campo (1986): P12 of steady filters, and the fused covariance."""
    sensors = [
        {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.3]]},
        {"nodes": [1], "H": [[0.4, 1.0]], "R": [[0.6]]},
    ]
    times = {"horizon": 121.0, "probe": [120.0]}
    scenario = scenario_of(TRACKS, tmp_path, 3, sensors=sensors, network=PAIR, **times)
    F, Q, n = scenario.plant.F, scenario.plant.Q, 2
    closed, filtered = [], []
    for sensor in scenario.sensors:
        H, R = sensor.H, sensor.R
        M = scipy.linalg.solve_discrete_are(F.T, H.T, Q, R)
        K = M @ H.T @ np.linalg.inv(H @ M @ H.T + R)
        closed.append(np.eye(n) - K @ H)
        filtered.append(closed[-1] @ M)
    # P12 = C_1 (F P12 F' + Q) C_2', a Sylvester equation for one vector.
    C, D = closed
    P12 = np.linalg.solve(np.eye(n * n) - np.kron(C @ F, D @ F), (C @ Q @ D.T).reshape(-1)).reshape(
        n, n
    )
    A, B = filtered
    G = (A - P12) @ np.linalg.inv(A + B - P12 - P12.T)
    expected = A - G @ (A - P12).T
    run = netkf.simulate(scenario)
    np.testing.assert_allclose(run.P[0], [expected, expected], rtol=1e-9)
    steady = theory.steady_error_covariance(scenario)
    np.testing.assert_allclose(steady, [expected, expected], rtol=1e-10)
    # With probability 0.3 a node shows its own track.
    lossy = scenario_of(TRACKS, tmp_path, 3, sensors=sensors, network={**PAIR, "channel": LOSSY})
    mixed = [0.7 * expected + 0.3 * P for P in filtered]
    np.testing.assert_allclose(theory.steady_error_covariance(lossy), mixed, rtol=1e-10)
    promise = "P tends to that of steady tracks, whose P12 solves a Lyapunov equation"
    short = scenario.replace({"horizon": 91.0, "probe": [90.0]})
    for one, verdict in ((short, "holds"), (lossy, "not promised")):
        table = netkf.check(one, 10, workers=1).table.set_index("promise")
        assert table.loc[promise, "verdict"] == verdict
    # Without the common process noise tracks would be taken for independent: too sure.
    naive = np.linalg.inv(np.linalg.inv(A) + np.linalg.inv(B))
    assert np.trace(naive) < 0.97 * np.trace(expected)


def fused_tracks(scenario, run):
    """Best linear unbiased combinations ``(E' J^-1 E)^-1 E' J^-1`` of the tracks that a node has in
    a slot, with the covariance J of their errors by the recursion of the paper.
    """
    heard, F, Q = heard_by_slot(scenario, run, 1), scenario.plant.F, scenario.plant.Q
    N, n = len(scenario.nodes), len(F)
    tracks, own = [np.zeros(n)] * N, [scenario.plant.cov] * N
    P = {(i, j): scenario.plant.cov for i in range(N) for j in range(N)}

    def step(slot, x, C, readings):
        nonlocal tracks, own, P
        tracks, own = [F @ one for one in tracks], [F @ one @ F.T + Q for one in own]
        P = {pair: F @ one @ F.T + Q for pair, one in P.items()}
        closed = [np.eye(n)] * N
        for i, (y, H, R) in readings.items():
            K = own[i] @ H.T @ np.linalg.inv(H @ own[i] @ H.T + R)
            closed[i] = np.eye(n) - K @ H
            tracks[i], own[i] = tracks[i] + K @ (y - H @ tracks[i]), closed[i] @ own[i]
        P = {(i, j): closed[i] @ one @ closed[j].T for (i, j), one in P.items()}
        P |= {(i, i): own[i] for i in range(N)}
        found = []
        for i in range(N):
            near = [i, *np.flatnonzero(heard.get(slot, np.zeros((1, N, N)))[0][i]).tolist()]
            J = np.linalg.inv(np.block([[P[a, b] for b in near] for a in near]))
            E = np.tile(np.eye(n), (len(near), 1))
            best = np.linalg.inv(E.T @ J @ E)
            found.append((best @ E.T @ J @ np.concatenate([tracks[j] for j in near]), best))
        return [one for one, _ in found], [one for _, one in found]

    states = list(textbook(scenario, run, step))
    return np.stack([x for x, _ in states]), np.stack([C for _, C in states])


@pytest.mark.parametrize("network", ["several tracks", "two tracks"])
def test_estimates_of_tracks_by_the_plain_formula(network, tmp_path):
    """For two tracks it is Bar-Shalom and Campo's ``x_i + (P_i - P_ij) S^-1 (x_j - x_i)``."""
    more = {"network": {**PAIR, "channel": LOSSY}} if network == "two tracks" else {}
    sensors = [
        {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.3]]},
        {"nodes": [1], "H": [[0.4, 1.0]], "R": [[0.6]]},
    ]
    if more:
        more["sensors"] = sensors
    for seed in range(2):
        scenario = scenario_of(TRACKS, tmp_path, seed, **more)
        run = netkf.simulate(scenario)
        xhat, P = fused_tracks(scenario, run)
        assert run.count("lost") > 1
        np.testing.assert_allclose(run.P, P, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(run.xhat, xhat, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_units_of_states_do_not_decide_which_differences_count(seed):
    """Three tracks, the last two of blind nodes and so the same; states of 1e-8 beside some of 1e8,
    and a variance of differences of 1e-10 of that of the tracks.
    """
    random, n = np.random.default_rng(seed), 3
    common, own = random.standard_normal((n, 2 * n)), 1e-5 * random.standard_normal((n, 2 * n))
    zero = np.zeros((n, 2 * n))
    factors = [np.hstack(pair) for pair in ((common, own), (common, zero), (common, zero))]
    units = np.array([1e-8, 1.0, 1e8])
    for scale in (np.ones(n), units):
        scaled = [scale[:, None] * factor for factor in factors]
        joint = np.stack([[a @ b.T for b in scaled] for a in scaled])
        gain, root = best_combination(joint, [0, 1, 2], np.linalg.cholesky(joint[0, 0]))
        # What the own track adds to the common error is noise: the others have none.
        P = root @ root.T / np.outer(scale, scale)
        np.testing.assert_allclose(P, common @ common.T, rtol=1e-4, atol=1e-6)
        weights = gain[:, :n] + gain[:, n:]
        np.testing.assert_allclose(weights * scale / scale[:, None], np.eye(n), atol=0.1)
    same = best_combination(joint, [1, 2], np.eye(n))
    assert not same[0].any()
    np.testing.assert_array_equal(same[1], np.eye(n))


def test_tracks_know_their_errors_and_checks_say_so(tmp_path):
    """Messages that come late in the run, lost ones and equal tracks of blind nodes included."""
    scenario = scenario_of(TRACKS, tmp_path, 2, horizon=9.0)
    table = netkf.check(scenario, 10, confidence=0.999, workers=1).table.set_index("promise")
    assert table.loc["P is the covariance of the error, given the events", "verdict"] == "holds"
    assert table.loc["errors have the covariance that the equations give them", "verdict"] in (
        "holds",
        "undecided",
    )


@pytest.mark.parametrize(("kind", "promised"), [(BEST, True), (INVERSE, False)])
def test_intersection_never_claims_too_much(kind, promised, tmp_path):
    scenario = scenario_of({"kind": "track-fusion", "rule": kind}, tmp_path, 2, horizon=9.0)
    table = netkf.check(scenario, 10, confidence=0.999, workers=1).table.set_index("promise")
    bound = "P is at least the covariance of the error, given the events"
    assert (bound in table.index) == promised
    assert set(table["verdict"]) <= {"holds", "undecided"}


def test_inverse_intersection_is_surer_and_right_in_a_network(tmp_path):
    """No proof covers it, but its P is below that of covariance intersection, and no error is
    found to be above.
    """
    for seed in range(2):
        ours, other = (
            netkf.simulate(scenario_of({"kind": "track-fusion", "rule": kind}, tmp_path, seed, 3))
            for kind in (INVERSE, BEST)
        )
        sizes = [np.trace(run.P[-1], axis1=-2, axis2=-1) for run in (ours, other)]
        assert (sizes[0] < sizes[1] + 1e-12).all()
        scenario = scenario_of({"kind": "track-fusion", "rule": INVERSE}, tmp_path, seed, 3)
        gap = ours.P - theory.error_covariance(scenario, ours)
        assert np.linalg.eigvalsh(gap)[..., 0].min() > -1e-12


@pytest.mark.one_in(2)
@pytest.mark.parametrize("at", ["links", "nodes"])
def test_under_clocks(at, tmp_path):
    """Delayed and lost messages: P is at least the exact covariance."""
    sampling = {"kind": "poisson", "rate": 2.0}
    network = {
        "graph": {"kind": "cycle", "nodes": 4},
        "activation": {"kind": "poisson", "rate": 2.0, "at": at},
        "channel": {"delay": {"kind": "constant", "seconds": 0.3}},
    }
    scenario = clocked(
        {"kind": "track-fusion", "rule": BEST}, tmp_path, {}, sampling, probe=0.5, network=network
    )
    run = netkf.simulate(scenario)
    gap = run.P - theory.error_covariance(scenario, run)
    assert np.linalg.eigvalsh(gap)[..., 0].min() > -1e-10
    close(error_law(scenario, run).P, run.P, 1e-9)


def test_tracks_that_start_apart_are_refused(tmp_path):
    mean = [[float(k), 0.0] for k in range(5)]
    with pytest.raises(netkf.ScenarioError, match="must be that of all nodes"):
        scenario_of({**TRACKS, "mean": mean}, tmp_path)


@pytest.mark.parametrize(
    "F",
    [
        [[0.947, 0.251], [-0.049, 0.563]],
        pytest.param([[1.01, 0.2], [0.0, 0.03]], marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("rule", ["ci", "ici"])
def test_roots_that_rounding_has_made_thin_are_not_fused_as_if_they_were(rule, F, tmp_path):
    """Without plant noise the covariance of a mode that decays is below the rounding of the others:
    two estimates then seem to know more than all readings together.
    """
    plant = {"kind": "linear", "F": F, "Q": [[0.0, 0.0], [0.0, 0.0]], "period": 1.0}
    plant |= {"cov": [[1.0, 0.0], [0.0, 1.0]]}
    sensors = [{"nodes": [0], "H": [[1.0, 0.5]], "R": [[0.1]]}]
    sensors += [{"nodes": [1], "H": [[0.2, 1.0]], "R": [[0.3]]}]
    network = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "broadcast"}}
    more = {"plant": plant, "sensors": sensors, "network": network, "horizon": 401.0}
    more["probe"] = [1.0, 20.0, 60.0, 100.0, 200.0, 400.0]
    central = netkf.simulate(scenario_of({"kind": "central"}, tmp_path, **more), engine="compiled")
    scenario = scenario_of({"kind": "track-fusion", "rule": rule}, tmp_path, **more)
    for engine in ("compiled", "simpy"):
        run = netkf.simulate(scenario, engine=engine)
        assert run.status == "complete"
        ratio = np.trace(run.P, axis1=-2, axis2=-1) / np.trace(central.P, axis1=-2, axis2=-1)
        assert ratio.min() > 1.0 - 1e-9
        assert ratio.max() < 1.5
