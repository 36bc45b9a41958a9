"""The gains that use the moments of a reading, against the integrals that define them."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from netkf.algorithms.filter import Estimate, Exchange, Increments, Message, NodeInfo
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.kernels.gains import gain_table, longest_interval
from netkf.algorithms.kernels.riccati import flow_covariance, move_covariances
from netkf.algorithms.kernels.root_flow import gain_update_root
from netkf.algorithms.models import FlowModel
from tests import reference

INFO = NodeInfo(0, degree=2, receivers=2, nodes=3, own_weight=0.5, information=np.eye(3))
NODES, WEIGHTS = np.polynomial.legendre.leggauss(30)


def system(seed, n=3, p=2):
    random = np.random.default_rng(seed)
    A, B, S = (random.normal(size=(n, n)) for _ in range(3))
    H, V = random.normal(size=(p, n)), random.normal(size=(p, p))
    return A, B @ B.T, H, V @ V.T + 0.1 * np.eye(p), S @ S.T


@pytest.mark.one_in(2)
@pytest.mark.parametrize("seed", range(5))
def test_gains_are_the_projections_of_the_exact_weight(seed):
    """K_j = (2j+1)/g int P_j(s) Phi(g, s) P(s) H' R^-1 ds, with Phi from the closed loop's ODE."""
    A, Q, H, R, P0 = system(seed)
    g, G = 0.05, H.T @ np.linalg.solve(R, H)
    model = FlowModel(A, Q, H, R, 1.0, g)
    flow = lambda s: move_covariances(flow_covariance(A, Q, G, s), P0)  # noqa: E731

    def change(t, Phi):
        return ((A - flow(t) @ G) @ Phi.reshape(3, 3)).reshape(-1)

    def transition(s):  # from s to g
        settings = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-12}
        found = scipy.integrate.solve_ivp(change, (s, g), np.eye(3).reshape(-1), **settings)
        return found.y[:, -1].reshape(3, 3)

    places, weights = np.polynomial.legendre.leggauss(4)
    K = np.zeros((2, 3, 2))
    for z, w in zip(places, weights, strict=True):
        s = 0.5 * g * (1 + z)
        k = transition(s) @ flow(s) @ H.T @ np.linalg.inv(R)
        K[0] += 0.5 * w * k
        K[1] += 1.5 * w * z * k
    P, x = flow(g), np.array([1.0, -2.0, 0.5])
    predicted = np.concatenate(
        [
            sum(
                0.5 * g * w * z**j * H @ scipy.linalg.expm(-A * 0.5 * g * (1 - z)) @ x
                for z, w in zip(NODES, WEIGHTS, strict=True)
            )
            for j in range(2)
        ]
    )
    moments = np.array([0.3, -0.2, 0.02, 0.05])
    expected = x + np.concatenate([K[0], K[1]], axis=1) @ (moments - predicted)
    hybrid = Hybrid(epsilon=0.5)
    state = hybrid.update(hybrid.init(model, x, P, INFO), Increments(moments, g))
    np.testing.assert_allclose(state.xhat, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("n", "p"), [(1, 1), (2, 1), (4, 2), (6, 3)])
def test_the_kernel_is_the_formula(seed, n, p):
    A, Q, H, R, P = system(seed, n, p)
    gap = 0.5 * longest_interval(A, Q, H.T @ np.linalg.solve(R, H))
    table = gain_table(A, Q, H, R, gap)
    values = reference.polynomial(table.series[:, :-1], gap)
    U, W, C = (part.reshape(-1, n) for part in np.split(values, 3))
    U, W = U.reshape(n, 2 * p), W.reshape(n, 2 * p)
    random = np.random.default_rng(seed)
    x, moments = random.normal(size=n), random.normal(size=2 * p)
    expected = reference.moments_update(P, x, moments, U, W, C)
    kept = moments.copy()
    found = gain_update_root(table, np.linalg.cholesky(P), x, moments, gap)
    np.testing.assert_array_equal(moments, kept)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_the_innovation_does_not_see_the_state():
    """A noise-free reading of a noise-free state leaves the error what the closed loop makes it."""
    A, Q, H, R, P = system(1)
    model, g = FlowModel(A, Q, H, R, 1.0, 0.1), 0.1

    def update(x):
        moments = np.concatenate(
            [
                sum(
                    0.5 * g * w * z**j * H @ scipy.linalg.expm(A * 0.5 * g * (1 + z)) @ x
                    for z, w in zip(NODES, WEIGHTS, strict=True)
                )
                for j in range(2)
            ]
        )
        hybrid = Hybrid(epsilon=0.5)
        start = hybrid.init(model, x + np.array([1.0, 0.0, 0.0]), P, INFO)
        after = hybrid.update(hybrid.predict(start, g), Increments(moments, g))
        return scipy.linalg.expm(A * g) @ x - after.xhat

    np.testing.assert_allclose(update(np.zeros(3)), update(1e6 * np.ones(3)), atol=1e-7)


def test_an_interval_that_is_too_long_is_refused():
    A, Q, H, R, _ = system(2)
    longest = longest_interval(A, Q, H.T @ np.linalg.solve(R, H))
    gain_table(A, Q, H, R, longest)
    with pytest.raises(ValueError, match="too long"):
        gain_table(A, Q, H, R, 1.01 * longest)


def test_reset_is_the_convex_combination_of_values_before_it():
    """H (7), (9) written plainly; the self weight is 1 - sum of the active ones."""
    A, Q, H, R, _ = system(3)
    model, random = FlowModel(A, Q, H, R, 1.0, 0.1), np.random.default_rng(0)
    own, one, two = (Estimate(random.normal(size=3), np.diag(random.random(3))) for _ in range(3))
    messages = [Message(1, 0.3, one, 0.0), Message(2, 0.3, two, 0.0)]
    hybrid = Hybrid(epsilon=0.3)
    state = hybrid.absorb(hybrid.init(model, own.xhat, own.P, INFO), messages, Exchange())
    np.testing.assert_allclose(state.xhat, 0.4 * own.xhat + 0.3 * one.xhat + 0.3 * two.xhat)
    np.testing.assert_allclose(state.P, 0.4 * own.P + 0.3 * one.P + 0.3 * two.P)


def test_an_old_message_is_predicted_to_its_arrival():
    A, Q, H, R, _ = system(4)
    model, age = FlowModel(A, Q, H, R, 1.0, 0.1), 0.4
    sent = Estimate(np.array([1.0, 2.0, 3.0]), np.eye(3))
    hybrid, messages = Hybrid(epsilon=1.0), [Message(1, 1.0, sent, age)]
    state = hybrid.absorb(hybrid.init(model, np.zeros(3), np.eye(3), INFO), messages, Exchange())
    E = scipy.linalg.expm(A * age)
    noise = sum(
        0.5 * age * w * (F := scipy.linalg.expm(A * 0.5 * age * (1 + z))) @ Q @ F.T
        for z, w in zip(NODES, WEIGHTS, strict=True)
    )
    np.testing.assert_allclose(state.xhat, E @ sent.xhat, rtol=1e-12)
    np.testing.assert_allclose(state.P, E @ E.T + noise, rtol=1e-11)
    np.testing.assert_array_equal(sent.root, np.eye(3))
