"""H Theorem 3 and Proposition 4 in numbers, and H Remark 1, against plain solvers."""

import json

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import netkf
from netkf import theory
from netkf.core.errors import TheoryError
from netkf.theory.hybrid import linearised, steady
from netkf.theory.hybrid.second_moments import second_moment_rate
from netkf.theory.promises import compute_promises, promises_text
from tests.cases import FOLDER
from tests.conftest import SCENARIOS

CASES = {c["name"]: c for c in json.loads((FOLDER / "hybrid.json").read_text())["cases"]}


def pair(build, a=0.2, rate=3.0, H=1.0, **more):
    """Two scalar nodes, the second one blind, weight 1/2."""
    return build(
        plant={"kind": "diffusion", "A": [[a]], "B": [[1.0]], "cov": [[1.5]]},
        sensors=[{"nodes": [0], "H": [[H]], "R": [[0.5]]}],
        network={
            "graph": {"kind": "path", "nodes": 2},
            "activation": {"kind": "poisson", "rate": rate},
        },
        filter={"kind": "hybrid", "epsilon": 0.5, "cov": [[1.5]], **more},
    )


def plain_steady(a, c, G=(2.0, 0.0)):
    """The steady state of H(12) for two scalar nodes by scipy's root finder."""

    def slope(P):
        return [2 * a * P[i] + 1.0 - G[i] * P[i] ** 2 + c * (P[1 - i] - P[i]) for i in (0, 1)]

    found = scipy.optimize.root(slope, [3.0, 3.0], tol=1e-13)
    assert found.success
    assert min(found.x) > 0.0
    return found.x


@pytest.mark.parametrize("delta", [1.0, 0.1, 0.003])
def test_the_rate_for_a_distance(build, delta):
    made = pair(build)
    found = theory.link_rate_for(made, delta)
    assert found.rate == pytest.approx(3.0 * found.factor, rel=1e-12)
    S = theory.limit_covariance(made)[0, 0]
    apart = np.abs(plain_steady(0.2, 0.5 * found.rate) - S).max()
    assert apart == pytest.approx(delta, rel=1e-7)


def test_the_rate_grows_as_one_over_the_distance(build):
    """The first-order constant X of the reference: distance = |X| / rate."""
    X = max(abs(x[0][0]) for x in CASES["c02_scalar_unstable_blind"]["expected"]["first_order_X"])
    found = theory.link_rate_for(pair(build), 1e-5)
    assert found.rate == pytest.approx(X / 1e-5, rel=1e-3)


def test_rates_that_differ_have_a_factor_only(build):
    made = pair(build).replace(
        {"network.activation": {"kind": "poisson", "rate": 1.0, "rates": [[0, 1, 3.0]]}}
    )
    found = theory.link_rate_for(made, 0.1)
    assert np.isnan(found.rate)
    assert found.factor == pytest.approx(theory.link_rate_for(pair(build), 0.1).factor, rel=1e-9)


def test_nodes_that_have_the_limit_need_no_rate(build):
    made = pair(build).replace({"sensors.0.nodes": [0, 1]})
    assert theory.link_rate_for(made, 0.1).factor == 0.0
    assert theory.link_rate_threshold(made).factor == 0.0
    with pytest.raises(TheoryError, match="positive number"):
        theory.link_rate_for(made, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.1, 3.0])
def test_the_threshold_of_a_blind_node(build, rate):
    """lambda > 2 a / pi: at half of it H(12) grows without bound, which H Proposition 4 denies."""
    found = theory.link_rate_threshold(pair(build, rate=rate))
    assert found.rate == pytest.approx(2 * 0.2 / 0.5, rel=1e-5)
    slow = pair(build, rate=0.5 * found.rate)
    ends = theory.covariance_bound(slow, [20.0, 40.0, 60.0])[:, 1, 0, 0]
    # it grows by exp((2 a - pi lambda) t)
    assert ends[2] / ends[1] == pytest.approx(np.exp(20.0 * 0.2), rel=0.02)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("factored", [0, 3000])
def test_the_threshold_of_a_network_comes_from_few_linear_equations(build, monkeypatch, factored):
    """Nodes that nobody sees must average away 2 a: that is an eigenvalue of their Laplacian."""
    solved, solve_map = [], linearised.solve_map
    monkeypatch.setattr(steady, "MAX_FACTORED", factored)
    for module in (steady, linearised):
        monkeypatch.setattr(module, "solve_map", lambda *a: solved.append(1) or solve_map(*a))
    made = pair(build).replace(
        {
            "network.graph": {"kind": "regular", "nodes": 500, "degree": 4, "seed": 1},
            "sensors.0.nodes": [0, 250],
            "filter.epsilon": 0.2,
        }
    )
    laplacian = 4.0 * np.eye(500)
    for i, j in made.topology.directions:
        laplacian[i, j] -= 1.0
    blind = np.delete(np.arange(500), [0, 250])
    least = np.linalg.eigvalsh(laplacian[np.ix_(blind, blind)])[0]
    found = theory.link_rate_threshold(made)
    assert found.rate == pytest.approx(2 * 0.2 / (0.2 * least), rel=1e-3)
    assert len(solved) < 120


def test_no_rate_helps_what_no_node_sees(build):
    made = pair(build, H=0.0)
    with pytest.raises(TheoryError, match="any link rates"):
        theory.link_rate_threshold(made)


def test_constant_gains_against_a_plain_integration(ring):
    gains = [np.array([[0.9], [0.4]]) if k in (0, 3) else np.zeros((2, 0)) for k in range(6)]
    times = [0.3, 2.0, 9.0]
    found = theory.constant_gain_bound(ring, times, gains)
    A, Q, c = ring.plant.A, np.diag([0.0, 1.0]), 2.0 * 0.7 * 0.3

    def slope(t, y):
        P, out = y.reshape(6, 2, 2), []
        for i in range(6):
            sees = i in (0, 3)
            L, H = (gains[i] if sees else np.zeros((2, 1))), np.array([[1.0, 0.0]])
            closed = A - L @ H
            near = P[(i + 1) % 6] + P[i - 1] - 2 * P[i]
            out.append(closed @ P[i] + P[i] @ closed.T + 0.25 * L @ L.T + Q + c * near)
        return np.array(out).reshape(-1)

    start = np.tile(np.eye(2).reshape(-1), 6)
    solved = scipy.integrate.solve_ivp(
        slope, (0, 9), start, "DOP853", times, rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(found.reshape(3, -1), solved.y.T, rtol=1e-8, atol=1e-9)
    steady = theory.constant_gain_bound(ring, gains=gains)
    assert np.abs(slope(0.0, steady.reshape(-1))).max() < 1e-10


def test_the_same_bits_whatever_the_generator_of_numpy_is_at(ring, monkeypatch):
    from netkf.checks import hybrid
    from netkf.theory.hybrid import constant_gains
    from netkf.theory.hybrid.coupled import coupling

    for module in (constant_gains, hybrid):
        monkeypatch.setattr(module, "MAX_DENSE", 0)  # the way for large networks
    before, found = np.random.get_state(), []  # noqa: NPY002
    for _ in range(5):
        bound = theory.constant_gain_bound(ring, [50.0])
        found.append((bound.tobytes(), hybrid._slowest_mixing(coupling(ring))))
    assert len(set(found)) == 1
    assert str(np.random.get_state()) == str(before)  # noqa: NPY002


def test_time_varying_gains_are_better(ring, monkeypatch):
    """H Remark 1: the bound stays below that with any constant gains."""
    from netkf.theory.hybrid import constant_gains

    times = [0.1, 1.0, 5.0, 20.0]
    ours = theory.covariance_bound(ring, times)
    for gains in (
        None,
        [g * np.ones((2, 1))[:, : int(k in (0, 3))] for k, g in enumerate([0.6] * 6)],
    ):
        constant = theory.constant_gain_bound(ring, times, gains)
        assert np.linalg.eigvalsh(constant - ours).min() > -1e-8
        assert np.trace(constant - ours, axis1=2, axis2=3).max() > 0.01
        monkeypatch.setattr(constant_gains, "MAX_DENSE", 0)  # the way for large networks
        other = theory.constant_gain_bound(ring, times, gains)
        np.testing.assert_allclose(other, constant, rtol=1e-9, atol=1e-10)
        monkeypatch.undo()
    # those of the steady state end at the steady state of H(12)
    np.testing.assert_allclose(
        theory.constant_gain_bound(ring),
        theory.steady_covariance_bound(ring),
        rtol=1e-9,
        atol=1e-12,
    )


def test_gains_that_do_not_stabilise(build):
    made = pair(build)
    with pytest.raises(TheoryError, match="do not stabilise"):
        theory.constant_gain_bound(made, gains=[[[0.0]], np.zeros((1, 0))])
    with pytest.raises(TheoryError, match="array for each node"):
        theory.constant_gain_bound(made, gains=[[[0.0]]])
    slow = netkf.load(SCENARIOS / "delayed_links.toml")
    with pytest.raises(TheoryError, match="no delay"):
        theory.constant_gain_bound(slow)


def test_netkf_theory_prints_the_rate(ring):
    """Within 10 % of the size of S."""
    found = compute_promises(ring)
    delta = 0.1 * np.linalg.norm(theory.limit_covariance(ring))
    assert found["link_rate"]["value"] == pytest.approx(theory.link_rate_for(ring, delta).rate)
    assert "keep the steady bound within 10% of S" in promises_text(ring, found)
    # With a delay the distance from S grows with the rate in the end.
    late = ring.replace({"network.channel.delay": {"kind": "constant", "seconds": 0.05}})
    S = theory.limit_covariance(late)
    slow, fast = (
        theory.steady_covariance_bound(late.replace({"network.activation.rate": rate})) - S
        for rate in (20.0, 2000.0)
    )
    assert np.linalg.norm(fast) > np.linalg.norm(slow)
    assert "links that take no time" in compute_promises(late)["link_rate"]["reason"]


@pytest.mark.parametrize("channel", [{}, {"loss": {"kind": "bernoulli", "delivery": 0.7}}])
def test_second_moments_of_P_grow_as_those_of_a_linear_recursion(build, channel):
    """Gains of the bound; p <- W p at a tick moves E[p p'] by W (x) W, and both ends at once."""
    scenario = pair(build, a=0.3).replace({"network.channel": channel})
    rate = 3.0 * channel.get("loss", {}).get("delivery", 1.0)
    P = plain_steady(0.3, 0.5 * rate)
    between, tick = np.diag([2 * (0.3 - 2.0 * P[0]), 2 * 0.3]), np.full((2, 2), 0.5)
    eye = np.eye(2)
    moved = np.kron(between, eye) + np.kron(eye, between)
    moved += rate * (np.kron(tick, tick) - np.eye(4))
    expected = np.linalg.eigvals(moved).real.max()
    assert second_moment_rate(scenario) == pytest.approx(expected, rel=1e-8)
