"""Updates and combinations on roots against textbook formulas in 200 digits."""

import numpy as np
import pytest

from netkf.algorithms.kernels.root_update import (
    combine_roots,
    intersect_roots,
    lower_root,
    update_with_sample,
)
from tests import reference


def distance(root, P):
    """Relative, in Frobenius' norm; nothing above the diagonal of a root counts."""
    L, P = np.tril(root), reference.rounded(P)
    return np.linalg.norm(L @ L.T - P) / np.linalg.norm(P)


def wide_root(random, n, size, condition=1e6):
    turn = np.linalg.qr(random.normal(size=(n, n)))[0]
    return lower_root(turn * np.sqrt(size * np.geomspace(1.0, 1.0 / condition, n)))


@pytest.mark.parametrize("noise", [1e-9, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e8, 1e12])
def test_samples_are_used_right_at_every_scale(size, noise):
    random = np.random.default_rng(int(np.log10(size / noise)) + 100)
    for n in range(1, 9):
        for p in (1, min(3, n)):
            root, x = wide_root(random, n, size), random.normal(size=n)
            H, spread = random.normal(size=(p, n)), random.normal(size=(p, p))
            R = noise * (spread @ spread.T + np.eye(p))
            root_R, y = np.linalg.cholesky(R), random.normal(size=p)
            before = [part.copy() for part in (root, x, y, root_R)]
            made, moved, _ = update_with_sample(root, x, y, H, root_R)
            for part, kept in zip((root, x, y, root_R), before, strict=True):
                assert np.array_equal(part, kept)
            with reference.precisely():
                S, C, *rest = reference.exactly(root, root_R, x, y, H)
                P, mean = reference.sample_update(S @ S.T, *rest, C @ C.T)
            assert distance(made, P) < (1e-9 if size <= 1e10 else 1e-6)
            mean = reference.rounded(mean)
            assert np.linalg.norm(moved - mean) < 1e-8 * np.linalg.norm(mean)


def test_normalised_innovations_are_those_of_the_textbook():
    random = np.random.default_rng(1)
    root, x = wide_root(random, 4, 3.0, 10.0), random.normal(size=4)
    H, y = random.normal(size=(3, 4)), random.normal(size=3)
    R = np.eye(3) + 0.3
    _, _, innovation = update_with_sample(root, x, y, H, np.linalg.cholesky(R))
    S = H @ root @ root.T @ H.T + R
    expected = np.linalg.solve(np.linalg.cholesky(S), y - H @ x)
    assert innovation == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("weights", [(1.0,), (0.4, 0.6), (0.25, 0.5, 0.25), (0.0, 1.0)])
def test_convex_combinations(weights):
    random = np.random.default_rng(len(weights))
    for n in range(1, 9):
        sizes = 10.0 ** random.integers(-6, 13, size=len(weights))
        roots = np.stack([wide_root(random, n, size) for size in sizes])
        means = random.normal(size=(len(weights), n))
        x, root = combine_roots(np.array(weights), means, roots)
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
        x, root = intersect_roots(np.array(weights), means, roots)
        with reference.precisely():
            w, m, S = reference.exactly(weights, means, roots)
            P, mean = reference.intersection(w, m, [part @ part.T for part in S])
        assert distance(root, P) < 1e-10
        assert x == pytest.approx(reference.rounded(mean), rel=1e-7, abs=1e-8)


def test_what_intersects_with_itself_stays():
    random = np.random.default_rng(5)
    root, x = wide_root(random, 5, 1e8, 1e4), random.normal(size=5)
    parts = np.stack([x, x]), np.stack([root, root])
    mean, made = intersect_roots(np.array([0.3, 0.7]), *parts)
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
    x, made = intersect_roots(weights, means, np.stack([root, other]))
    assert np.isfinite(made).all()
    assert np.isfinite(x).all()
    P, convex = made @ made.T, 0.5 * (root @ root.T + other @ other.T)
    assert np.linalg.eigvalsh(convex - P)[0] > -1e-9
    assert np.linalg.eigvalsh(P)[0] > -1e-12
