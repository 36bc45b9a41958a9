"""Kernels of filters in slots against the plain formulas, for several seeds and dimensions."""

import numpy as np
import pytest

from netkf.algorithms.kernels import slots
from netkf.algorithms.push_sum import corrected

CASES = [(seed, n) for seed in range(3) for n in (1, 2, 4, 7)]


def triangular(random, n, count=1):
    return np.stack([np.linalg.cholesky(_covariance(random, n)) for _ in range(count)])


def _covariance(random, n):
    B = random.standard_normal((n, n + 2))
    return B @ B.T


def filters(random, n, p):
    """Two filters of one run, and their whitened readings in one slot."""
    Q, F = triangular(random, n)[0], random.standard_normal((n, n))
    nodes = slots.SlotNodes(
        random.standard_normal((2, n)), triangular(random, n, 2), F, Q, np.array([p, 0])
    )
    y, H = random.standard_normal((1, 1, 2, p)), random.standard_normal((1, 1, 2, p, n))
    local, rebased = random.standard_normal((1, 1, n)), np.array([True])
    return nodes, slots.SlotReadings(y, H, local, rebased)


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_prediction(seed, n):
    random = np.random.default_rng(seed)
    nodes, _ = filters(random, n, 1)
    x, P = nodes.xhat[1].copy(), nodes.root[1] @ nodes.root[1].T
    slots.predict(nodes, slots.slot_room(2, n))
    root = np.tril(nodes.root[1])
    expected = nodes.F @ P @ nodes.F.T + nodes.root_Q @ nodes.root_Q.T
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(nodes.xhat[1], nodes.F @ x, rtol=1e-10, atol=1e-12)
    assert (np.diag(root) > 0.0).all()


def test_prediction_of_what_is_known_and_moves_by_itself():
    """Rows of zeros and signs that change."""
    F, zero = np.diag([-2.0, 1.0, 0.0]), np.zeros((3, 3))
    root = slots.predicted_root(np.diag([1.0, 0.0, 3.0]), F, zero)
    np.testing.assert_allclose(root, np.diag([2.0, 0.0, 0.0]), atol=0.0)


@pytest.mark.parametrize(("seed", "n"), CASES)
@pytest.mark.parametrize("p", [1, 3])
def test_update_with_a_whitened_reading(seed, n, p):
    random = np.random.default_rng(seed)
    nodes, readings = filters(random, n, p)
    x, P = nodes.xhat[0].copy(), nodes.root[0] @ nodes.root[0].T
    y, H = readings.y[0, 0, 0], readings.H[0, 0, 0]
    slots.use_reading(nodes, 0, readings, 0, 0, 0, slots.slot_room(2, n).update)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(p))
    root = np.tril(nodes.root[0])
    np.testing.assert_allclose(root @ root.T, P - gain @ H @ P, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(nodes.xhat[0], x + gain @ (y - H @ x), rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_whitening(seed, n):
    random = np.random.default_rng(seed)
    y, H, R = random.standard_normal(2), random.standard_normal((2, n)), _covariance(random, 2)
    white, seen = slots.whitened(y, H, R)
    np.testing.assert_allclose(seen.T @ seen, H.T @ np.linalg.inv(R) @ H, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(seen.T @ white, H.T @ np.linalg.inv(R) @ y, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_the_gain_of_push_sum(seed, n):
    """P (8)."""
    random = np.random.default_rng(seed)
    x, root = random.standard_normal(n), triangular(random, n)[0]
    y, H, R = random.standard_normal(2), random.standard_normal((2, n)), _covariance(random, 2)
    expected = x + 3.5 * root @ root.T @ H.T @ np.linalg.inv(R) @ (y - H @ x)
    found = corrected(x, root, 3.5, y, H, R)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    assert (corrected(x, root, 3.5, y[:0], H[:0], R[:0, :0]) == x).all()


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_samples_show_the_covariance_and_frames_move_estimates(seed, n):
    random = np.random.default_rng(seed)
    nodes, readings = filters(random, n, 1)
    samples = slots.SlotSamples(
        np.empty((1, 1, 2, n)),
        np.empty((1, 1, 2, n, n)),
        np.zeros((1, 2), int),
        np.zeros((1, 2, 2)),
    )
    flags = np.array([True])
    plan = slots.SlotPlan(0, flags, flags, np.array([0]), np.zeros((1, 1, 1, 0), dtype=np.uint8))
    slots.show(nodes, plan, samples, 0, 0)
    np.testing.assert_allclose(
        samples.P[0, 0], nodes.root @ nodes.root.swapaxes(1, 2), rtol=1e-10, atol=1e-12
    )
    before = nodes.xhat.copy()
    slots.rebase(nodes, readings, 0, 0)
    np.testing.assert_array_equal(samples.xhat[0, 0], before)
    np.testing.assert_array_equal(nodes.xhat, before - readings.local[0, 0])
