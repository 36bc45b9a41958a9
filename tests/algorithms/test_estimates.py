"""Predictions, updates and combinations on roots against textbook formulas in 200 digits."""

import numpy as np
import pytest

from netkf.algorithms.covariance_intersection import CovarianceIntersection
from netkf.algorithms.filter import Exchange, Message, NodeInfo, Reading
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.models import SlotModel, predict_root, sample_update, whiten_reading
from netkf.algorithms.push_sum import PushSum
from tests import reference


def distance(root, P):
    """Relative, in Frobenius' norm; nothing above the diagonal of a root counts."""
    L, P = np.tril(root), reference.rounded(P)
    return np.linalg.norm(L @ L.T - P) / np.linalg.norm(P)


def wide_root(random, n, size, condition=1e6):
    turn = np.linalg.qr(random.normal(size=(n, n)))[0]
    return lower_root(turn * np.sqrt(size * np.geomspace(1.0, 1.0 / condition, n)))


def combined(algorithm, weights, means, roots):
    """The first estimate after it has absorbed the others by a filter's kernels, in slots."""
    count, n = means.shape
    model = SlotModel(np.eye(n), np.eye(n), np.zeros((0, n)), np.zeros((0, 0)))
    now, states = Exchange(slot=1, phase=0, step=0), []
    for k in range(count):
        others = tuple(j for j in range(count) if j != k)
        info = NodeInfo(k, count - 1, count - 1, count, weights[k], np.eye(n), senders=others)
        start = algorithm.init(model, means[k], np.eye(n), info)
        states.append(start._replace(xhat=means[k], root=np.tril(roots[k])))
    payloads = [algorithm.emit(state, now)[1] for state in states]
    heard = [Message(k, weights[k], payloads[k], 0.0) for k in range(1, count)]
    state = algorithm.absorb(states[0], heard, now)
    return state.xhat, state.root


def intersect(weights, means, roots):
    return combined(CovarianceIntersection(epsilon=0.1), weights, means, roots)


@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_predictions_of_roots(n):
    random = np.random.default_rng(n)
    F, root, root_Q = (random.normal(size=(n, n)) for _ in range(3))
    made = predict_root(np.tril(root), F, np.tril(root_Q))
    S, T = F @ np.tril(root), np.tril(root_Q)
    np.testing.assert_allclose(np.tril(made) @ np.tril(made).T, S @ S.T + T @ T.T, rtol=1e-10)
    assert (np.diag(made) > 0.0).all()


def test_prediction_of_what_is_known_and_moves_by_itself():
    """Rows of zeros and signs that change."""
    F, zero = np.diag([-2.0, 1.0, 0.0]), np.zeros((3, 3))
    root = predict_root(np.diag([1.0, 0.0, 3.0]), F, zero)
    np.testing.assert_allclose(root, np.diag([2.0, 0.0, 0.0]), atol=0.0)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_whitening(n):
    random = np.random.default_rng(n)
    y, H, B = random.normal(size=2), random.normal(size=(2, n)), random.normal(size=(2, 4))
    R = B @ B.T
    white, seen = whiten_reading(y, H, R)
    np.testing.assert_allclose(seen.T @ seen, H.T @ np.linalg.inv(R) @ H, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(seen.T @ white, H.T @ np.linalg.inv(R) @ y, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_the_gain_of_push_sum(n):
    """P (8)."""
    random = np.random.default_rng(n)
    x, root = random.normal(size=n), wide_root(random, n, 1.0, 10.0)
    y, H, B = random.normal(size=2), random.normal(size=(2, n)), random.normal(size=(2, 4))
    R, filter_ = B @ B.T, PushSum(gamma=1, delta=2.0)
    model, info = SlotModel(np.eye(n), np.eye(n), H, R), NodeInfo(0, 1, 1, 2, 1.0, np.eye(n))
    state = filter_.init(model, x, root @ root.T, info)
    state = state._replace(information=np.zeros((n, n)), number=3.5)
    found = filter_.update(state, Reading(y, H, R))
    expected = x + 3.5 * root @ root.T @ H.T @ np.linalg.inv(R) @ (y - H @ x)
    np.testing.assert_allclose(found.xhat, expected, rtol=1e-10, atol=1e-12)
    nothing = filter_.update(state, Reading(y[:0], H[:0], R[:0, :0]))
    assert (nothing.xhat == x).all()


@pytest.mark.parametrize("noise", [1e-9, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e8, 1e12])
def test_samples_are_used_right_at_every_scale(size, noise):
    random = np.random.default_rng(int(np.log10(size / noise)) + 100)
    for n in range(1, 9):
        for p in (1, min(3, n)):
            root, x = wide_root(random, n, size), random.normal(size=n)
            H, spread = random.normal(size=(p, n)), random.normal(size=(p, p))
            R = noise * (spread @ spread.T + np.eye(p))
            y = random.normal(size=p)
            before = [part.copy() for part in (root, x, y, R)]
            moved, made = sample_update(x, root, y, H, R)
            for part, kept in zip((root, x, y, R), before, strict=True):
                assert np.array_equal(part, kept)
            with reference.precisely():
                S, *rest = reference.exactly(root, x, y, H, R)
                P, mean = reference.sample_update(S @ S.T, *rest)
            assert distance(made, P) < (1e-9 if size <= 1e10 else 1e-6)
            mean = reference.rounded(mean)
            assert np.linalg.norm(moved - mean) < 1e-8 * np.linalg.norm(mean)


@pytest.mark.parametrize("weights", [(1.0,), (0.4, 0.6), (0.25, 0.5, 0.25), (0.0, 1.0)])
def test_convex_combinations(weights):
    random = np.random.default_rng(len(weights))
    for n in range(1, 9):
        sizes = 10.0 ** random.integers(-6, 13, size=len(weights))
        roots = np.stack([wide_root(random, n, size) for size in sizes])
        means = random.normal(size=(len(weights), n))
        x, root = combined(Hybrid(epsilon=0.5), weights, means, roots)
        with reference.precisely():
            w, m, S = reference.exactly(weights, means, roots)
            P, mean = reference.convex(w, m, [part @ part.T for part in S])
        assert distance(root, P) < 1e-13
        assert x == pytest.approx(reference.rounded(mean), rel=1e-13, abs=1e-15)


@pytest.mark.parametrize("weights", [(1.0,), (0.4, 0.6), (0.25, 0.5, 0.25)])
def test_covariance_intersection(weights):
    random = np.random.default_rng(len(weights))
    for n in range(1, 9):
        sizes = 10.0 ** random.integers(-3, 4, size=len(weights))
        roots = np.stack([wide_root(random, n, size, 1e4) for size in sizes])
        means = random.normal(size=(len(weights), n))
        x, root = intersect(weights, means, roots)
        with reference.precisely():
            w, m, S = reference.exactly(weights, means, roots)
            P, mean = reference.intersection(w, m, [part @ part.T for part in S])
        assert distance(root, P) < 1e-10
        assert x == pytest.approx(reference.rounded(mean), rel=1e-7, abs=1e-8)


def test_what_intersects_with_itself_stays():
    random = np.random.default_rng(5)
    root, x = wide_root(random, 5, 1e8, 1e4), random.normal(size=5)
    parts = np.stack([x, x]), np.stack([root, root])
    mean, made = intersect([0.3, 0.7], *parts)
    assert distance(made, root @ root.T) < 1e-11
    assert mean == pytest.approx(x, rel=1e-12)


@pytest.mark.parametrize("known", [0, 1, 2, 3])
def test_singular_roots_can_be_intersected(known):
    """Directions without any variance, as right after a start that is known exactly."""
    random = np.random.default_rng(known)
    root = np.tril(random.normal(size=(3, 3)))
    root[:, 3 - known :] = 0.0
    other = wide_root(random, 3, 1.0, 10.0)
    weights, means = np.array([0.5, 0.5]), np.zeros((2, 3))
    x, made = intersect(weights, means, np.stack([root, other]))
    assert np.isfinite(made).all()
    assert np.isfinite(x).all()
    P, convex = made @ made.T, 0.5 * (root @ root.T + other @ other.T)
    assert np.linalg.eigvalsh(convex - P)[0] > -1e-9
    assert np.linalg.eigvalsh(P)[0] > -1e-12
