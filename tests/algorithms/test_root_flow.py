"""The Riccati flow on roots against arithmetic with 200 digits, and against itself."""

from functools import cache

import numpy as np
import pytest
import scipy

from netkf.algorithms.kernels.riccati import flow_covariance, move_covariances
from netkf.algorithms.kernels.root_flow import (
    flow_root,
    flow_scratch,
    flow_table,
    information_rate,
    propagate_root,
    stack_tables,
)
from netkf.algorithms.kernels.square_root import lower_root
from netkf.algorithms.models import sample_update
from netkf.linalg.lanes import ONE
from tests import reference
from tests.algorithms.test_estimates import distance, wide_root

LONGEST = 100.0


def chain(n):
    return np.diag(np.ones(n - 1), 1)


def system(kind, noise, n, random):
    A = random.normal(size=(n, n)) / np.sqrt(n)
    A = {"random": A, "zero": 0.0 * A, "chain": chain(n), "unstable": A + 0.3 * np.eye(n)}[kind]
    rank = {"full": n, "rank one": 1, "none": 0}[noise]
    B = random.normal(size=(n, rank))
    return A, B @ B.T


class Exact:
    """What the flow should be."""

    def __init__(self, A, Q, H, R):
        with reference.precisely():
            self.A, self.Q = reference.exactly(A, Q)
            self.blind = 0 * self.A
            self.G = self.blind
            if len(H):
                h, r = reference.exactly(H, R)
                self.G = h.T @ reference.solve(r, h)
        self.triple = cache(self._triple)

    def _triple(self, gap, reads=True):
        return reference.flow_triple(self.A, self.Q, self.G if reads else self.blind, gap)

    def flow(self, P, x, gap, reads=True):
        with reference.precisely():
            return reference.flow(P, x, self.triple(gap, reads))


def allowed(size):
    return 1e-9 if size <= 1e10 else 1e-6


CASES = [
    (kind, noise, n, R, size)
    for k, (kind, noise, n) in enumerate(
        (kind, noise, n)
        for kind in ("random", "zero", "chain", "unstable")
        for noise in ("full", "rank one", "none")
        for n in (1, 2, 3, 5, 8)
    )
    for R, size in [(10.0 ** ((5 * k) % 16 - 9), 10.0 ** ((7 * k) % 19 - 6))]
    if n in (1, 3, 8)
]


@pytest.mark.one_in(8)
@pytest.mark.parametrize(("kind", "noise", "n", "R", "size"), CASES)
def test_single_gaps(kind, noise, n, R, size):
    random = np.random.default_rng(n)
    A, Q = system(kind, noise, n, random)
    p = 1 + n // 3
    H, R, x = random.normal(size=(p, n)), R * (np.eye(p) + 0.3), random.normal(size=n)
    table, exact = flow_table(A, Q, H, R, LONGEST), Exact(A, Q, H, R)
    for root in (np.sqrt(size) * np.eye(n), wide_root(random, n, size)):
        S, mean = reference.exactly(root, x)
        with reference.precisely():
            P = S @ S.T
        for gap in (1e-6, 0.3, 10.0 if kind == "unstable" else LONGEST):
            made, moved = flow_root(table, root, x, gap)
            expected, moved_exactly = exact.flow(P, mean, gap)
            assert distance(made, expected) < allowed(size), gap
            moved_exactly = reference.rounded(moved_exactly)
            assert np.linalg.norm(moved - moved_exactly) < 1e-10 * np.linalg.norm(moved_exactly)


@pytest.mark.parametrize(
    ("kind", "noise", "n", "R", "size", "sample"),
    [
        ("random", "full", 4, 1e-3, 1e8, 1e-9),
        ("random", "rank one", 6, 1e-9, 1e10, 1e-3),
        ("zero", "none", 3, 1.0, 1e12, 1e-6),
        ("zero", "rank one", 8, 1e-6, 1e10, 1e-8),
        ("chain", "rank one", 5, 1e6, 1e12, 1e-3),
        ("chain", "none", 8, 1e-3, 1e10, 1e-6),
        ("unstable", "full", 5, 1e-9, 1e12, 1e6),
        ("unstable", "none", 4, 1e3, 1e-6, 1e-9),
    ],
)
@pytest.mark.slow
def test_many_short_gaps_mixed_with_samples(kind, noise, n, R, size, sample):
    random = np.random.default_rng(n)
    A, Q = system(kind, noise, n, random)
    H, R = random.normal(size=(1, n)), np.array([[R]])
    C, cov = random.normal(size=(2, n)), sample * np.array([[1.0, 0.3], [0.3, 0.5]])
    root_R = np.linalg.cholesky(cov)
    seeing, blind = flow_table(A, Q, H, R, 10.0), flow_table(A, Q, H[:0], R[:0, :0], 10.0)
    exact = Exact(A, Q, H, R)
    root, x = wide_root(random, n, size), random.normal(size=n)
    c, r, S, mean = reference.exactly(C, root_R, root, x)
    with reference.precisely():
        P, r = S @ S.T, r @ r.T
    worst = far = 0.0
    for k, gap in enumerate(random.choice([1e-6, 1e-3, 0.017, 0.1], size=150)):
        if k % 5 == 4:
            y = C @ x + root_R @ random.normal(size=2)
            x, root = sample_update(x, root, y, C, cov)
            with reference.precisely():
                P, mean = reference.sample_update(P, mean, reference.exactly(y), c, r)
        else:
            reads = bool(k % 5)
            root, x = flow_root(seeing if reads else blind, root, x, gap)
            P, mean = exact.flow(P, mean, gap, reads)
        worst = max(worst, distance(root, P))
        off = x - reference.rounded(mean)
        # Rounding tells a fraction e of a wide variance, and so sqrt(e) of its spread.
        spread = np.linalg.norm(np.tril(root))
        far = max(far, np.linalg.norm(off) / (np.linalg.norm(x) + spread))
    assert worst < allowed(size)
    assert far < np.sqrt(allowed(size))


@pytest.mark.parametrize("size", [1e8, 1e10, 1e12])
@pytest.mark.parametrize("row", [[1.0, 0.5, 0.3], [1.0, 0.5, 0.3, 0.2]])
def test_wide_first_covariances_of_states_that_stand_still(size, row):
    """A = B = 0: information adds up, P^-1 = P0^-1 + t H' R^-1 H, and nothing is seen beside H."""
    n, R = len(row), 1e-3
    zero, H = np.zeros((n, n)), np.array([row])
    table = flow_table(zero, zero, H, np.array([[R]]), 10.0)
    root, x = np.sqrt(size) * np.eye(n), np.zeros(n)
    for steps in range(1, 501):
        root, x = flow_root(table, root, x, 0.01)
        seen = steps * 0.01 * size * (H @ H.T)[0, 0] / R
        P = size * np.eye(n) - size * (H.T @ H) / (H @ H.T)[0, 0] * seen / (1.0 + seen)
        assert distance(root, P) < 1e-12
    along = np.linalg.norm(np.tril(root).T @ H[0]) ** 2
    assert along == pytest.approx(
        (H @ H.T)[0, 0] * R / (5.0 * (H @ H.T)[0, 0] + R / size), rel=1e-9
    )


@pytest.mark.parametrize("p", [0, 1, 3])
@pytest.mark.parametrize("kind", ["random", "chain", "unstable"])
def test_a_gap_is_the_sum_of_its_parts(kind, p):
    random = np.random.default_rng(p)
    A, Q = system(kind, "rank one", 4, random)
    H, R = random.normal(size=(p, 4)), 0.01 * np.eye(p)
    # The whole gap takes several of the longest steps that are tabulated.
    table = flow_table(A, Q, H, R, 0.1)
    root, x = wide_root(random, 4, 1e4), random.normal(size=4)
    for parts in ([0.5, 1e-5, 0.49999], random.dirichlet(np.ones(40)), [1.0 / 7] * 7):
        whole, moved = flow_root(table, root, x, float(sum(parts)))
        pieces, mean = root, x
        for gap in parts:
            pieces, mean = flow_root(table, pieces, mean, float(gap))
        assert distance(pieces, np.tril(whole) @ np.tril(whole).T) < 1e-12
        assert mean == pytest.approx(moved, rel=1e-12)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("gap", [1e-4, 0.02, 0.7, 13.0])
@pytest.mark.parametrize("p", [0, 1, 2])
def test_agrees_with_the_flow_of_covariances_at_ordinary_scales(p, gap):
    random = np.random.default_rng(3)
    for n in range(1, 7):
        A, Q = system("random", "full", n, random)
        A -= np.eye(n)
        H, R = random.normal(size=(p, n)), np.eye(p) + 0.1
        G = H.T @ np.linalg.solve(R, H)
        root, x = np.linalg.cholesky(np.eye(n) + 0.5), random.normal(size=n)
        P = move_covariances(flow_covariance(A, Q, G, gap), root @ root.T)
        mean = scipy.linalg.expm(A * gap) @ x
        made, moved = flow_root(flow_table(A, Q, H, R, LONGEST), root, x, gap)
        assert distance(made, P) < 1e-11
        assert moved == pytest.approx(mean, rel=1e-11, abs=1e-11 * np.abs(mean).max())


def test_models_side_by_side_are_what_they_are_alone():
    random = np.random.default_rng(8)
    A, Q = system("random", "rank one", 3, random)
    models = [(Q, p) for p in (0, 1, 2, 5)] + [(0.0 * Q, 1)]
    tables = [
        flow_table(A, q, random.normal(size=(p, 3)), (1.0 + p) * np.eye(p), LONGEST)
        for q, p in models
    ]
    stack = stack_tables(tables)
    scratch = flow_scratch(stack)
    roots = np.stack([wide_root(random, 3, 5.0, 10.0) for _ in tables])
    means = random.normal(size=(len(tables), 3))
    for gap in (0.01, 0.4, 7.0):
        for m, table in enumerate(tables):
            alone = flow_root(table, roots[m], means[m], gap)
            propagate_root(stack, m, roots, means, m, gap, scratch)
            assert np.array_equal(np.tril(roots[m]), np.tril(alone[0]))
            assert np.array_equal(means[m], alone[1])
            P = np.tril(roots[m]) @ np.tril(roots[m]).T
            G = table.whitened_H[0].T @ table.whitened_H[0]
            rate = information_rate(ONE, scratch.size, stack.whitened_H[m], roots[m])
            assert rate == pytest.approx((P * G).sum(), rel=1e-12)


def test_what_is_known_exactly_stays_so_without_noise():
    zero = np.zeros((2, 2))
    table = flow_table(chain(2), zero, np.array([[1.0, 0.0]]), np.eye(1), 10.0)
    root, x = flow_root(table, zero, np.array([1.0, 2.0]), 3.7)
    assert not np.tril(root).any()
    assert x == pytest.approx([8.4, 2.0], rel=1e-14)


def test_roots_of_any_kind_are_made_triangular():
    random = np.random.default_rng(2)
    for shape in ((3, 3), (3, 7), (3, 1)):
        root = random.normal(size=shape)
        made = lower_root(root)
        assert np.array_equal(made, np.tril(made))
        assert np.diag(made).min() >= 0.0
        assert np.allclose(made @ made.T, root @ root.T, rtol=1e-13, atol=1e-14)
