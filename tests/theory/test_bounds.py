"""H(12) and its steady state against closed forms and plain integrations."""

import functools
import re

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

import netkf
from netkf import theory
from netkf.theory.hybrid import bounds
from tests.conftest import SCENARIOS


def plain_bound(A, Q, G, c, P0, times):
    """H(12) written plainly, with c[i][j] the effective rate times weight of messages j -> i."""
    N, n = len(G), len(A)

    def f(t, y):
        P = y.reshape(N, n, n)
        return np.concatenate(
            [
                (
                    A @ P[i]
                    + P[i] @ A.T
                    - P[i] @ G[i] @ P[i]
                    + Q
                    + sum(c[i][j] * (P[j] - P[i]) for j in range(N))
                ).ravel()
                for i in range(N)
            ]
        )

    solved = scipy.integrate.solve_ivp(
        f, (0, times[-1]), np.concatenate([P0.ravel()] * N), "Radau", times, rtol=1e-10, atol=1e-12
    )
    return solved.y.T.reshape(len(times), N, n, n)


def test_whether_numpy_raises_at_underflow_does_not_matter():
    scenario = netkf.load(SCENARIOS / "delayed_links.toml")
    expected = theory.covariance_bound(scenario, scenario.times)
    with np.errstate(all="raise"):
        assert (theory.covariance_bound(scenario, scenario.times) == expected).all()


def test_directions_that_lose_differently_enter_as_directed_rates(build, tmp_path):
    rows = ["0,1,0.9", "1,0,0.4", "1,2,0.6", "2,1,1.0"]
    (tmp_path / "links.csv").write_text("sender,receiver,delivery_probability\n" + "\n".join(rows))
    scenario = build(
        network={
            "graph": {"kind": "csv", "path": "links.csv"},
            "activation": {"kind": "poisson", "rate": 2.0, "rates": [[1, 2, 3.0]]},
            "channel": {"loss": {"kind": "per-link"}, "symmetric": False},
        },
        filter={"kind": "hybrid", "epsilon": 0.4},
    )
    c = np.zeros((3, 3))
    c[1, 0], c[0, 1], c[2, 1], c[1, 2] = 0.9 * 0.8, 0.4 * 0.8, 0.6 * 1.2, 1.0 * 1.2
    G = [np.array([[2.0]]), np.zeros((1, 1)), np.zeros((1, 1))]
    times = [0.5, 2.0, 7.0]
    expected = plain_bound(np.array([[-0.5]]), np.eye(1), G, c, np.eye(1), times)
    np.testing.assert_allclose(theory.covariance_bound(scenario, times), expected, rtol=1e-7)
    # the limit weighs the nodes by the left null vector of the coupling
    fast = scenario.replace(
        {"network.activation": {"kind": "poisson", "rate": 4e4, "rates": [[1, 2, 6e4]]}}
    )
    np.testing.assert_allclose(
        theory.steady_covariance_bound(fast),
        np.broadcast_to(theory.limit_covariance(scenario), (3, 1, 1)),
        rtol=3e-4,
    )
    w = scipy.linalg.null_space((np.diag(c.sum(1)) - c).T)[:, 0]
    g = (w / w.sum())[0] * 2.0
    S = (-1.0 + np.sqrt(1.0 + 4.0 * g)) / (2.0 * g)
    np.testing.assert_allclose(theory.limit_covariance(scenario), [[S]], rtol=1e-12)


def test_a_fixed_delay_enters_as_the_predicted_past(build):
    """Against a fine explicit integration of the delay differential equation."""
    d, rate, eps, a = 0.3, 2.0, 0.5, -0.5
    delay = {"kind": "constant", "seconds": d}
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "poisson", "rate": rate},
        "channel": {"delay": delay},
    }
    scenario = build(network=network)
    h = 1e-4
    lag, steps = round(d / h), round(2.0 / h)
    P = np.ones((steps + 1, 2))
    G, T = np.array([2.0, 0.0]), np.exp(2 * a * d)
    q = (T - 1.0) / (2 * a)

    def slope(k, value, half):
        if k + half < lag:
            return 2 * a * value - G * value**2 + 1.0
        past = P[k - lag] if not half else 0.5 * (P[k - lag] + P[k - lag + 1])
        return 2 * a * value - G * value**2 + 1.0 + rate * eps * (T * past[::-1] + q - value)

    for k in range(steps):
        middle = P[k] + 0.5 * h * slope(k, P[k], 0)
        P[k + 1] = P[k] + h * slope(k, middle, 0.5)
    times = [0.2, 0.3, 0.6, 1.0, 2.0]
    bound = theory.covariance_bound(scenario, times)[:, :, 0, 0]
    np.testing.assert_allclose(bound, P[[round(t / h) for t in times]], rtol=2e-4)
    steady = theory.steady_covariance_bound(scenario)
    far = theory.covariance_bound(scenario, [40.0])[0]
    np.testing.assert_allclose(steady, far, rtol=1e-8)


def test_samples_and_late_messages_by_series_as_by_an_implicit_method(build, monkeypatch):
    """Jumps at instants that no multiple of the delay meets, beside what arrives by clocks."""
    sampling = {"kind": "periodic", "period": 0.31}
    sensor = {"H": [[1.0, 0.5]], "R": [[0.2]]}
    scenario = build(
        plant={"kind": "diffusion", "A": [[-0.2, 1.0], [-1.0, 0.1]], "B": [[0.3], [1.0]]},
        sensors=[{"nodes": [0], **sensor, "sampling": sampling}, {"nodes": [1], **sensor}],
        network={
            "graph": {"kind": "path", "nodes": 3},
            "activation": {"kind": "poisson", "rate": 2.0},
            "channel": {"delay": {"kind": "constant", "seconds": 0.25}},
        },
        filter={"kind": "hybrid", "epsilon": 0.4},
    )
    times = [0.1, 0.31, 0.56, 0.9, 1.24, 3.0]
    series = theory.covariance_bound(scenario, times)
    monkeypatch.setattr(bounds, "MAX_EXPLICIT_EVALUATIONS", 0)
    np.testing.assert_allclose(theory.covariance_bound(scenario, times), series, rtol=2e-7)


def test_a_precise_sensor_hears_late_of_large_covariances(build):
    """Stiff and with a delay: what is heard in the second stretch is the first one's, in closed
    form.
    """
    d, rate, eps, a, G = 0.1, 2.0, 0.5, -0.5, 1e8
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "poisson", "rate": rate},
        "channel": {"delay": {"kind": "constant", "seconds": d}},
    }
    scenario = build(network=network, sensors=[{"nodes": [0], "H": [[1.0]], "R": [[1.0 / G]]}])
    got = theory.covariance_bound(scenario, [d, 0.15])[:, :, 0, 0]
    root = np.sqrt(a * a + G)

    def first(t):  # of both nodes, before a message arrives
        seen = (a + root / np.tanh(root * t + np.arctanh(root / (G - a)))) / G
        return np.array([seen, np.exp(2 * a * t) + (np.exp(2 * a * t) - 1.0) / (2 * a)])

    np.testing.assert_allclose(got[0], first(d), rtol=1e-8)

    def slope(t, P):
        T = np.exp(2 * a * d)
        arriving = T * first(t - d)[::-1] + (T - 1.0) / (2 * a)
        return 2 * a * P + 1.0 - np.array([G, 0.0]) * P**2 + rate * eps * (arriving - P)

    solved = scipy.integrate.solve_ivp(
        slope, (d, 0.15), first(d), "Radau", rtol=1e-10, atol=1e-16, max_step=1e-3
    )
    np.testing.assert_allclose(got[1], solved.y[:, -1], rtol=1e-7)


DELAYED = {
    "what arrives late settles to the solver's noise": (
        [[-2.03, 0.47], [0.64, -0.69]],
        [[-0.66, -0.66], [1.57, -0.37]],
        [([0, 1, 2], [[1.41, 1.51], [1.98, -0.15]], 0.01), ([2], [[-0.10, -0.56]], 10.0)],
        ({"kind": "star", "nodes": 3}, 0.7, 0.36, 0.2),
    ),
    "long steps are wrong between their ends": (
        [[-0.03, 0.56, -0.08], [-0.19, 0.04, -0.36], [-0.15, 0.0, 0.14]],
        [[-0.18, -2.22, 0.55], [-1.13, -0.70, 2.0], [2.5, -0.14, -0.94]],
        [([0, 1, 2, 3], [[-0.94, 1.25, 1.31]], 0.01)],
        ({"kind": "path", "nodes": 4}, 0.097, 0.32, 0.01),
    ),
}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("case", DELAYED.values(), ids=DELAYED)
def test_precise_sensors_and_late_messages_have_a_bound(build, case):
    """Against the method of steps: over each delay what arrives is known."""
    A, B, sensors, (graph, rate, epsilon, d) = case
    n, ends = len(A), 5.0
    scenario = build(
        horizon=ends,
        plant={"kind": "diffusion", "A": A, "B": B, "cov": np.eye(n).tolist()},
        sensors=[
            {"nodes": nodes, "H": H, "R": (R * np.eye(len(H))).tolist()} for nodes, H, R in sensors
        ],
        network={
            "graph": graph,
            "activation": {"kind": "poisson", "rate": rate},
            "channel": {
                "loss": {"kind": "bernoulli", "delivery": 0.5},
                "delay": {"kind": "constant", "seconds": d},
            },
        },
        filter={"kind": "hybrid", "epsilon": epsilon},
    )
    A, Q, N = np.array(A), np.array(B) @ np.array(B).T, len(scenario.nodes)
    G, L = np.zeros((N, n, n)), np.zeros((N, N))
    for nodes, H, R in sensors:
        G[nodes] += np.array(H).T @ np.array(H) / R
    for i, j in scenario.topology.links:
        L[i, j] = L[j, i] = 0.5 * rate * epsilon
    M = scipy.linalg.expm(np.block([[A, Q], [np.zeros((n, n)), -A.T]]) * d)
    F, W = M[:n, :n], M[:n, n:] @ M[:n, :n].T
    past, P = None, np.tile(np.eye(n), (N, 1, 1))
    for k in range(round(ends / d)):

        def slope(t, y, past=past):
            P = y.reshape(N, n, n)
            out = A @ P + P @ A.T + Q - P @ G @ P
            if past is not None:
                late = F @ past(t - d).reshape(N, n, n) @ F.T + W
                out += np.tensordot(L, late, 1) - L.sum(axis=1)[:, None, None] * P
            return out.ravel()

        solved = scipy.integrate.solve_ivp(
            slope,
            (k * d, (k + 1) * d),
            P.ravel(),
            "LSODA",
            rtol=1e-9,
            atol=1e-12,
            dense_output=True,
        )
        past, P = solved.sol, solved.y[:, -1]
    bound = netkf.theory.covariance_bound(scenario, [ends])[0]
    np.testing.assert_allclose(bound, P.reshape(N, n, n), atol=1e-6 * np.abs(P).max())


@pytest.mark.slow
def test_a_short_delay_is_integrated_in_longer_stretches(build):
    """The same equation cut into stretches of one delay, and the limit of no delay."""

    def bound(seconds):
        delay = {"kind": "constant", "seconds": seconds}
        network = {
            "graph": {"kind": "path", "nodes": 2},
            "activation": {"kind": "poisson", "rate": 2.0},
            "channel": {"delay": delay},
        }
        return theory.covariance_bound(build(network=network), [0.5, 1.0, 2.5])

    none, tiny, short = bound(0.0), bound(1e-6), bound(1e-3)
    assert np.abs(tiny - none).max() < 1e-5
    # first order in the delay
    np.testing.assert_allclose((short - none) / 1e-3, (bound(2e-3) - none) / 2e-3, rtol=0.01)


@pytest.mark.parametrize(
    "network",
    [
        {},
        # of which nothing is promised to filters that talk
        {"activation": {"kind": "periodic", "period": 0.5}},
        {"channel": {"delay": {"kind": "exponential", "mean": 0.1}}},
    ],
)
def test_filters_that_do_not_talk_have_their_own_covariance_as_bound(build, network):
    base = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "poisson", "rate": 2.0}}
    build = functools.partial(build, network={**base, **network})
    local = build(filter={"kind": "local"})
    bound = theory.covariance_bound(local, local.times)
    np.testing.assert_allclose(netkf.simulate(local).P, bound, rtol=1e-8)
    central = build(filter={"kind": "central"})
    run = netkf.simulate(central)
    np.testing.assert_allclose(run.P, theory.covariance_bound(central, run.times), rtol=1e-8)
    np.testing.assert_allclose(run.P[:, 0], run.P[:, 1], rtol=0)


@pytest.mark.parametrize("sampling", [None, "periodic", "poisson"])
def test_a_filter_of_all_nodes_is_that_of_a_node_with_all_sensors(build, sampling):
    """It was solved once for each node, from readings stacked: minutes for a thousand sensors; and
    constant gains were those of each node's own sensors.
    """
    plant = {"kind": "diffusion", "A": [[0.0, 1.0], [0.0, -0.1]], "B": [[0.0], [1.0]]}
    law = {"periodic": {"period": 0.5}, "poisson": {"rate": 2.0}}.get(sampling)
    clock = {} if law is None else {"sampling": {"kind": sampling, **law}}
    rows = [{"H": [[1.0, 0.1 * k]], "R": [[1.0 + k]], **clock} for k in range(5)]
    both = []
    for kind, nodes in (("central", range(5)), ("local", [0] * 5)):
        sensors = [{"nodes": [node], **row} for node, row in zip(nodes, rows, strict=True)]
        network = {"graph": {"kind": "cycle", "nodes": 5}, "activation": {"kind": "poisson"}}
        network["activation"]["rate"] = 1.0
        made = {"plant": {**plant, "cov": np.eye(2).tolist()}, "sensors": sensors}
        both.append(build(**made, network=network, filter={"kind": kind}))
    central, local = both
    found, at_0 = theory.covariance_bound(central, central.times), np.zeros(5, dtype=int)
    np.testing.assert_allclose(found, theory.covariance_bound(local, local.times)[:, at_0], 1e-9)
    if sampling != "poisson":
        np.testing.assert_allclose(found, netkf.simulate(central).P, rtol=1e-8)
    if sampling is None:
        gains = [np.array([[0.3], [0.1]]) @ np.ones((1, 5)) / (1.0 + np.arange(5))]
        alone = [*gains, *[np.zeros((2, 0))] * 4]
        steady = theory.constant_gain_bound(central, gains=gains)
        A = central.plant.A - gains[0] @ np.concatenate([row["H"] for row in rows])
        R = np.diag(1.0 + np.arange(5))
        Q = central.plant.Q + gains[0] @ R @ gains[0].T
        plain = scipy.linalg.solve_continuous_lyapunov(A, -Q)
        np.testing.assert_allclose(steady, np.broadcast_to(plain, (5, 2, 2)), rtol=1e-9)
        constant = theory.constant_gain_bound(central, [0.5, 2.0], gains)
        other = theory.constant_gain_bound(local, [0.5, 2.0], alone)
        np.testing.assert_allclose(constant, other[:, at_0], rtol=1e-9)
    if sampling != "periodic":
        steady = theory.steady_covariance_bound(central)
        np.testing.assert_allclose(steady[0], theory.covariance_bound(central, [80.0])[0, 0], 1e-7)


@pytest.mark.parametrize(("a", "eps"), [(0.5, 0.5), (0.3, 0.2), (1.0, 1.0)])
def test_threshold_of_one_blind_node(build, a, eps):
    """lambda > 2 a / eps, whatever the noises."""
    plant = {"kind": "diffusion", "A": [[a]], "B": [[1.0]], "cov": [[1.0]]}

    def scenario(rate):
        return build(
            plant=plant,
            filter={"kind": "hybrid", "epsilon": eps},
            network={
                "graph": {"kind": "path", "nodes": 2},
                "activation": {"kind": "poisson", "rate": rate},
            },
        )

    critical = 2.0 * a / eps
    assert np.isfinite(theory.steady_covariance_bound(scenario(1.01 * critical))).all()
    with pytest.raises(netkf.TheoryError, match="is below the threshold") as caught:
        theory.steady_covariance_bound(scenario(0.99 * critical))
    assert float(str(caught.value).split()[-1]) == pytest.approx(critical, rel=1e-4)


@pytest.mark.slow
def test_threshold_where_every_node_sees_a_part(build):
    """Two growing modes, each seen by one node: the claim is decided by integrating for long."""
    plant = {
        "kind": "diffusion",
        "A": [[0.4, 0.1], [0.0, 0.2]],
        "B": [[1.0, 0.0], [0.0, 1.0]],
        "cov": [[1.0, 0.0], [0.0, 1.0]],
    }
    sensors = [
        {"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.5]]},
        {"nodes": [1], "H": [[0.0, 1.0]], "R": [[0.5]]},
    ]

    def scenario(rate):
        return build(
            plant=plant,
            sensors=sensors,
            network={
                "graph": {"kind": "path", "nodes": 3},
                "activation": {"kind": "poisson", "rate": rate},
            },
        )

    with pytest.raises(netkf.TheoryError, match="below the threshold") as caught:
        theory.steady_covariance_bound(scenario(0.5))
    critical = float(str(caught.value).split()[-1])
    steady = theory.steady_covariance_bound(scenario(1.02 * critical))
    assert np.linalg.eigvalsh(steady).min() > 0.0
    below = theory.covariance_bound(scenario(0.98 * critical), [200.0, 400.0, 800.0])
    size = below.max(axis=(1, 2, 3))
    assert size[2] / size[1] > 2.0
    assert size[1] / size[0] > 1.4


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("A", "critical"),
    [
        ([[0.5, 1.0], [0.0, 0.5]], 1.94508),
        ([[0.5, 2.0], [-2.0, 0.5]], 1.40020),
        ([[0.0, 1.0], [-1.0, 0.1]], 0.105547),
    ],
)
def test_threshold_where_a_node_sees_through_derivatives(build, A, critical):
    """References bracketed to 1e-4 in 80-digit arithmetic by a program of its own."""
    scenario = build(
        plant={
            "kind": "diffusion",
            "A": A,
            "B": [[1.0, 0.0], [0.0, 1.0]],
            "cov": [[1.0, 0.0], [0.0, 1.0]],
        },
        sensors=[{"nodes": [0], "H": [[1.0, 0.0]], "R": [[1.0]]}],
        network={
            "graph": {"kind": "path", "nodes": 2},
            "activation": {"kind": "poisson", "rate": 0.9 * critical},
        },
        filter={"kind": "hybrid", "epsilon": 1.0},
    )
    with pytest.raises(netkf.TheoryError, match="is below the threshold") as caught:
        theory.steady_covariance_bound(scenario)
    assert float(str(caught.value).split()[-1]) == pytest.approx(critical, rel=1e-4)


@pytest.mark.parametrize("units", [(1e3, 1.0, 1e-3), (1e-3, 16.0, 1e-3)])
def test_a_steady_state_does_not_depend_on_the_units_of_states(build, units):
    """A damped chain of three integrators in kilometres, metres and millimetres, and others."""
    A, B = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -0.1]], [[0.0], [0.0], [1.0]]

    def scenario(u, rate=3.0, a=0.0):
        return build(
            plant={
                "kind": "diffusion",
                "A": ((A + a * np.eye(3)) * np.outer(u, 1.0 / u)).tolist(),
                "B": (B * u[:, None]).tolist(),
                "cov": np.diag(u * u).tolist(),
            },
            sensors=[{"nodes": [0], "H": [[1.0 / u[0], 0.0, 0.0]], "R": [[1.0]]}],
            network={
                "graph": {"kind": "path", "nodes": 2},
                "activation": {"kind": "poisson", "rate": rate},
            },
            filter={"kind": "hybrid", "epsilon": 0.5},
        )

    one, u = np.ones(3), np.array(units)
    expected = theory.steady_covariance_bound(scenario(one)) * np.outer(u, u)
    found = theory.steady_covariance_bound(scenario(u))
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    with pytest.raises(netkf.TheoryError, match="is below the threshold") as caught:
        theory.steady_covariance_bound(scenario(u, 0.5, 0.3))
    with pytest.raises(netkf.TheoryError, match=re.escape(str(caught.value))):
        theory.steady_covariance_bound(scenario(one, 0.5, 0.3))


def test_two_decoupled_axes_have_the_threshold_of_one(build):
    """Four states of which each axis alone is known to have a steady state at rate 2.8."""

    def scenario(states, rate):
        rows = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
        blocks = states // 2
        sensors = [
            {"nodes": [k], "H": np.kron(np.eye(blocks), row).tolist(), "R": np.eye(blocks).tolist()}
            for k, row in enumerate(rows)
        ]
        eye = np.eye(states).tolist()
        return build(
            plant={"kind": "diffusion", "A": eye, "B": eye, "cov": eye},
            sensors=sensors,
            network={
                "graph": {"kind": "complete", "nodes": 3},
                "activation": {
                    "kind": "poisson",
                    "rates": [[0, 1, rate], [0, 2, 0.5 * rate], [1, 2, 2.0 * rate]],
                },
            },
        )

    one = theory.steady_covariance_bound(scenario(2, 2.8))
    both = theory.steady_covariance_bound(scenario(4, 2.8))
    np.testing.assert_allclose(both[:, :2, :2], one, rtol=1e-8)


def test_no_rate_helps_where_a_growing_mode_is_missed(build):
    plant = {"kind": "diffusion", "A": [[0.1, 0.0], [0.0, 0.3]], "B": [[1.0], [1.0]]}
    sensors = [{"nodes": [0], "H": [[1.0, 0.0]], "R": [[1.0]]}]
    scenario = build(
        plant=plant,
        sensors=sensors,
        filter={"kind": "hybrid", "epsilon": 0.5, "cov": [[1.0, 0.0], [0.0, 1.0]]},
    )
    with pytest.raises(netkf.TheoryError, match="faster links do not give it one"):
        theory.steady_covariance_bound(scenario)
    with pytest.raises(netkf.TheoryError, match=r"eigenvalue 0\.3"):
        theory.limit_covariance(scenario)


@pytest.mark.parametrize(
    ("network", "words"),
    [
        ({"activation": {"kind": "periodic", "period": 0.5}}, "not Poisson"),
        ({"channel": {"delay": {"kind": "exponential", "mean": 0.1}}}, "delay is random"),
        (
            {"channel": {"loss": {"kind": "gilbert-elliott", "mean_loss": 0.2, "mean_burst": 3.0}}},
            "losses depend on earlier ones",
        ),
    ],
)
def test_what_is_not_promised_is_said_in_words(build, network, words):
    base = {"graph": {"kind": "path", "nodes": 2}, "activation": {"kind": "poisson", "rate": 1.0}}
    scenario = build(network={**base, **network})
    with pytest.raises(netkf.TheoryError, match=f"not promised: .*{words}"):
        theory.covariance_bound(scenario, [1.0])
    table = theory.assumptions(scenario)
    assert table[~table.holds].evidence.str.contains("not promised").any()


def test_convergence_to_the_limit_has_slope_minus_one(ring):
    """H Theorem 3, measured."""
    S = theory.limit_covariance(ring)
    distance = []
    for rate in (100.0, 300.0, 1000.0):
        P = theory.steady_covariance_bound(ring.replace({"network.activation.rate": rate}))
        distance.append(np.linalg.norm(P - S, axis=(1, 2)).max())
    slopes = np.diff(np.log(distance)) / np.diff(np.log([100.0, 300.0, 1000.0]))
    np.testing.assert_allclose(slopes, -1.0, atol=0.03)


def test_the_true_errors_come_to_their_own_limit(build):
    """Fast links: the exact covariance of a run comes to true_limit_covariance, far below S."""
    network = {
        "graph": {"kind": "path", "nodes": 2},
        "activation": {"kind": "poisson", "rate": 400.0},
    }
    scenario = build(
        network=network,
        horizon=6.0,
        probe=[5.0, 5.5, 6.0],
        sensors=[{"nodes": [0, 1], "H": [[1.0]], "R": [[0.5]]}],
    )
    run = netkf.simulate(scenario)
    limit = theory.true_limit_covariance(scenario)[0, 0]
    assert theory.error_covariance(scenario, run)[..., 0, 0] == pytest.approx(limit, rel=0.02)
    assert limit < 0.95 * theory.limit_covariance(scenario)[0, 0]


def test_limit_of_sensors_all_alike_is_the_centralised_filter_with_more_noise(build):
    """S is a single sensor's covariance; the centralised one has N times less noise."""
    three = {
        "graph": {"kind": "complete", "nodes": 3},
        "activation": {"kind": "poisson", "rate": 1.0},
    }
    sensors = [{"nodes": [0, 1, 2], "H": [[1.0]], "R": [[0.5]]}]
    scenario = build(network=three, sensors=sensors, filter={"kind": "hybrid", "epsilon": 0.3})
    scalar = lambda g: (-1.0 + np.sqrt(1.0 + 4.0 * g)) / (2.0 * g)  # noqa: E731
    assert theory.limit_covariance(scenario)[0, 0] == pytest.approx(scalar(2.0), rel=1e-12)
    assert theory.central_covariance(scenario)[0, 0] == pytest.approx(scalar(6.0), rel=1e-12)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("symmetric", [True, False])
def test_theorem_2_by_simulation(ring, symmetric):
    """E[P_i(t)] <= bound: no mean of 300 runs lies above by 4 standard errors (72 comparisons)."""
    scenario = ring.replace({"horizon": 6.0, "probe": 1.0, "network.channel.symmetric": symmetric})
    bound = theory.covariance_bound(scenario, scenario.times)
    P = np.array([netkf.simulate(scenario, replica=r).P for r in range(300)])
    traces = np.trace(P, axis1=-2, axis2=-1)
    mean, error = traces.mean(axis=0), traces.std(axis=0, ddof=1) / np.sqrt(len(traces))
    allowed = np.trace(bound, axis1=-2, axis2=-1)
    assert (mean[1:] <= allowed[1:] + 4.0 * error[1:]).all()
    # and the bound is not idle: it lies within a fifth of the mean
    assert (mean[1:] >= 0.8 * allowed[1:]).all()


def test_assumptions_name_what_fails(build):
    scenario = build(
        plant={
            "kind": "diffusion",
            "A": [[-0.5, 0.0], [0.0, -1.0]],
            "B": [[1.0], [0.0]],
            "cov": [[1.0, 0.0], [0.0, 1.0]],
        },
        sensors=[{"nodes": [0], "H": [[1.0, 0.0]], "R": [[0.5]]}],
        filter={"kind": "hybrid", "epsilon": 0.5, "cov": [[0.5, 0.0], [0.0, 1.0]]},
    )
    table = theory.assumptions(scenario).set_index("assumption")
    assert list(table.columns) == ["source", "holds", "evidence"]
    failing = set(table.index[~table.holds])
    assert failing == {
        "(A, B) is controllable",
        "(A, H) is observable, all sensors together",
        "P_i(0) >= E[(x(0) - xhat_i(0))(x(0) - xhat_i(0))']",
    }
    assert "eigenvalue -1" in table.evidence["(A, B) is controllable"]


def test_times_that_make_no_sense_are_refused(ring):
    for times in ([], [1.0, 0.5], [-1.0], [np.nan], [np.inf]):
        with pytest.raises(netkf.TheoryError, match="times must be"):
            theory.covariance_bound(ring, times)


def test_a_constant_parameter_has_no_steady_state_that_can_be_solved_for(build):
    still = {"kind": "diffusion", "A": [[0.0]], "B": [[0.0]], "cov": [[1.0]]}
    with pytest.raises(netkf.TheoryError, match="neither driven by noise nor damped"):
        theory.steady_covariance_bound(build(plant=still))


@pytest.mark.slow
def test_a_node_that_nobody_can_follow_takes_seconds_or_is_refused(build):
    """A precise node beside one whose covariance grows by 1e13: implicit steps did not end."""
    A, B, C = np.array([[0.0, 1.0], [0.0, 6.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    scenario = build(
        horizon=8.0,
        plant={"kind": "diffusion", "A": A.tolist(), "B": B.tolist(), "cov": np.eye(2).tolist()},
        sensors=[{"nodes": [0], "H": C.tolist(), "R": [[0.25]]}],
        network={
            "graph": {"kind": "path", "nodes": 2},
            "activation": {"kind": "poisson", "rate": 1.0},
        },
        filter={"kind": "hybrid", "epsilon": 0.4},
    )
    gains = [C.T @ C / 0.25, np.zeros((2, 2))]
    coupling = 0.4

    def slope(_, y):
        P = y.reshape(2, 2, 2)
        own = [A @ p + p @ A.T + B @ B.T - p @ G @ p for p, G in zip(P, gains, strict=True)]
        return (np.array(own) + coupling * (P[::-1] - P)).ravel()

    start = np.tile(np.eye(2), (2, 1, 1)).ravel()
    plain = scipy.integrate.solve_ivp(slope, (0, 1.6), start, "LSODA", rtol=1e-9, atol=1e-7)
    found = theory.covariance_bound(scenario, [1.6])[0]
    expected = plain.y[:, -1].reshape(2, 2, 2)
    assert expected[1].max() > 1e3 * expected[0].max()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    with pytest.raises(netkf.TheoryError, match=r"cannot be integrated beyond 3\.\d+ s: covar"):
        theory.covariance_bound(scenario, [8.0])


@pytest.mark.slow
def test_a_bound_that_begins_at_0_beside_a_precise_sensor_ends(build):
    """Implicit steps ended as soon as a covariance had grown by a factor of 0, again and again."""
    scenario = build(
        horizon=40.0,
        plant={"kind": "diffusion", "A": [[-0.5]], "B": [[1.0]], "cov": [[0.0]]},
        sensors=[{"nodes": [0], "H": [[1.0]], "R": [[1e-7]]}],
    )
    times, one = [1.0, 40.0], np.ones((1, 1))
    found = theory.covariance_bound(scenario, times)
    gains = [1e7 * one, 0.0 * one]
    expected = plain_bound(-0.5 * one, one, gains, 1.0 - np.eye(2), 0.0 * one, times)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
