"""Kernels on small matrices against numpy, which says the same in one line."""

import numpy as np
import pytest

from netkf.linalg import small

CASES = [(seed, n) for seed in range(3) for n in (1, 2, 4, 7)]


def drawn(seed, *shapes):
    random = np.random.default_rng(seed)
    return [random.normal(size=shape) for shape in shapes]


def same(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("seed", "n"), CASES)
def test_products(seed, n):
    a, b, c = drawn(seed, (n, n + 2), (n + 2, n + 1), (n, n + 1))
    same(small.matmul(a, b), a @ b)
    same(small.add_matmul(c, a, b), c + a @ b)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(("seed", "n"), CASES)
def test_solutions(seed, n):
    left, right = drawn(seed, (n, n), (n, 3))
    before = left.copy(), right.copy()
    wide = np.concatenate([left, np.zeros((n, 2))], axis=1)
    small.solve_inplace(wide, right, n)
    same(right, np.linalg.solve(*before))


def test_a_singular_matrix_has_no_solution():
    out = np.eye(2)
    small.solve_inplace(np.ones((2, 2)), out, 2)
    assert np.isnan(out).all()


def test_copies():
    (a,) = drawn(1, (2, 3))
    target = np.zeros((2, 3))
    small.copy_matrix(target, a)
    assert np.array_equal(target, a)
