"""Kernels for square roots of covariances, and the stack of errors that they move."""

import numpy as np
import pytest
import scipy.linalg

from netkf.theory.numerics.prediction import Predictor, triangular_root
from netkf.theory.numerics.stack import GaussianStack
from netkf.theory.numerics.updates import (
    Observation,
    add_information_to_root,
    average_covariances,
    intersect_covariances,
    update_covariance_root,
)

SIZES = (1, 2, 3, 5)


def roots(n, count, seed=0):
    return list(np.random.default_rng(seed + n).standard_normal((count, n, n)))


def square(root):
    return root @ root.T


@pytest.mark.parametrize("shape", [(3, 1), (3, 3), (2, 7), (1, 4), (3, 0)])
def test_triangular_roots_have_the_square_of_their_parts(shape):
    parts = np.random.default_rng(2).standard_normal(shape)
    parts[:, -1:] *= 1e9  # columns of any size
    root = triangular_root(parts)
    assert np.array_equal(root, np.tril(root))
    assert np.allclose(square(root), square(parts), rtol=1e-14, atol=0.0)


def test_the_root_of_nothing_is_nothing():
    assert not triangular_root(np.zeros((3, 5))).any()


@pytest.mark.parametrize("n", SIZES)
def test_updates_are_those_of_a_kalman_filter(n):
    random = np.random.default_rng(n)
    (root,), H = roots(n, 1), random.standard_normal((2, n))
    R = square(random.standard_normal((2, 2))) + np.eye(2)
    R.flags.writeable = False  # as those of a scenario
    closed, K, after = update_covariance_root(root, Observation(H, R, np.eye(2)))
    P = square(root)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    assert np.allclose(K, gain, atol=1e-12)
    assert np.allclose(closed, np.eye(n) - gain @ H, atol=1e-12)
    assert np.allclose(square(after), P - gain @ H @ P, atol=1e-12)


@pytest.mark.parametrize("n", SIZES)
def test_means_of_covariances_and_of_information(n):
    parts, weights = roots(n, 3), [0.2, 0.3, 0.5]
    covariances = [square(part) for part in parts]
    root, factors = average_covariances(weights, parts)
    expected = sum(w * P for w, P in zip(weights, covariances, strict=True))
    assert np.allclose(square(root), expected, rtol=1e-12)
    assert np.allclose(factors, np.multiply.outer(weights, np.eye(n)))
    root, factors = intersect_covariances(weights, parts)
    inverses = [np.linalg.inv(P) for P in covariances]
    P = np.linalg.inv(sum(w * V for w, V in zip(weights, inverses, strict=True)))
    assert np.allclose(square(root), P, rtol=1e-8, atol=1e-8 * np.abs(P).max())
    expected = [w * P @ V for w, V in zip(weights, inverses, strict=True)]
    assert np.allclose(factors, expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("n", SIZES)
def test_information_adds_up(n):
    (root, other), (U,) = roots(n, 2), [square(roots(n, 1, 7)[0])]
    after = square(add_information_to_root(root, U))
    assert np.allclose(np.linalg.inv(after), np.linalg.inv(square(root)) + U, rtol=1e-8)
    singular = other.copy()
    singular[:, 0] = 0.0  # an estimate that is certain in some direction
    P = square(singular)
    expected = P @ np.linalg.inv(np.eye(n) + U @ P)
    assert np.allclose(square(add_information_to_root(singular, U)), expected, atol=1e-10)


@pytest.mark.parametrize("gap", [1e-6, 0.3, 20.0])
def test_predictions_are_those_of_van_loan(gap):
    A, B = np.array([[0.0, 1.0], [-1.0, -0.1]]), np.array([[0.0], [1.0]])
    step = Predictor(A, B, A, B)(gap)
    big = np.zeros((4, 4))
    big[:2, :2], big[:2, 2:], big[2:, 2:] = -A, B @ B.T, A.T
    F = scipy.linalg.expm(big * gap)[2:, 2:].T
    Q = F @ scipy.linalg.expm(big * gap)[:2, 2:]
    assert np.allclose(step.error, F, rtol=1e-12, atol=1e-14)
    assert np.allclose(square(step.error_noise), Q, rtol=1e-9, atol=1e-12 * Q.max())
    assert np.array_equal(step.error_noise, step.root)


def test_settled_forms_stay_valid_while_inputs_are_reduced():
    # Random walks x and y with some common noise: C(s, t) = C(s, s) for s < t.
    n, stack, random = 2, GaussianStack(2), np.random.default_rng(3)
    stack.put("x", np.zeros((n, 0)))
    stack.put("y", np.zeros((n, 0)))
    kept, covariances, total = [], [], np.zeros((4, 4))
    for step in range(200):
        parts = random.standard_normal((2, n, 3))
        columns = stack.inputs(3)
        for name, part in zip("xy", parts, strict=True):
            stack.add(name, columns, part)
        total += square(parts.reshape(4, 3))
        if step % 40 == 7:
            kept.append(stack.freeze(["y", "x"]).reshape(4, -1))
            covariances.append(total[np.ix_([2, 3, 0, 1], [2, 3, 0, 1])])
    assert np.allclose(stack.covariance(["x", "y"]), total, rtol=1e-12)
    for i, one in enumerate(kept):
        for j, other in enumerate(kept):
            width = min(one.shape[1], other.shape[1])
            found = one[:, :width] @ other[:, :width].T
            assert np.allclose(found, covariances[min(i, j)], rtol=1e-10, atol=1e-10)


def test_names_move_copies_stay_and_places_are_clean():
    stack = GaussianStack(1)
    columns = stack.inputs(2)
    stack.put("a", np.zeros((1, 0)))
    stack.add("a", columns, np.array([[1.0, 2.0]]))
    stack.matrices[stack.index("a")] = 3.0
    stack.copy("a", "b")
    stack.rename("a", "c")
    assert sorted(stack.names) == ["b", "c"]
    assert "a" not in stack
    stack.put("c", np.array([[5.0]]))
    assert stack.form("b").tolist() == [[1.0, 2.0]]
    assert stack.form("c").tolist() == [[5.0, 0.0]]
    assert stack.matrices[stack.index("b")].item() == 3.0
    stack.drop(["b"])
    stack.put("d", np.zeros((1, 0)))
    assert not stack.form("d").any()
    assert np.array_equal(stack.mix(["c", "d"], np.array([[[2.0]], [[1.0]]])), [[10.0, 0.0]])
