"""Decisions by numbers that are zero on paper: stability, hidden modes, definiteness."""

import numpy as np
import pytest
import scipy

from netkf.linalg.arrays import is_definite
from netkf.linalg.spectra import (
    FACTOR,
    RATE,
    balance,
    eigenvalues,
    growth_factor,
    growth_rate,
    hidden_mode,
    outputs_of,
)

SIZES = range(1, 7)


def rotation(random, n):
    return np.linalg.qr(random.standard_normal((n, n)))[0]


def chain(n):
    """n integrators: the only eigenvalue is 0, n times, which rounding moves by eps^(1/n)."""
    return np.diag(np.ones(n - 1), 1) if n > 1 else np.zeros((1, 1))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("n", SIZES)
def test_plants_without_damping_neither_grow_nor_decay(n):
    random = np.random.default_rng(n)
    for _ in range(40):
        M, Q = random.standard_normal((n, n)), rotation(random, n)
        assert growth_rate(M - M.T) == 0.0
        assert growth_factor(Q) == 1.0
        assert growth_rate(Q @ chain(n) @ Q.T) == 0.0
        assert growth_factor(Q @ (np.eye(n) + chain(n)) @ Q.T) == 1.0
        assert not eigenvalues(Q @ chain(n) @ Q.T).any()
        # In other units of the states and of time.
        units = np.exp2(random.integers(-20, 20, n))
        assert growth_rate(1e-6 * (M - M.T) * units[:, None] / units) == 0.0


@pytest.mark.parametrize("n", SIZES)
def test_growth_and_damping_beyond_rounding_count(n):
    random = np.random.default_rng(n)
    for _ in range(10):
        M, Q = random.standard_normal((n, n)), rotation(random, n)
        A = M - M.T
        for rate in (1e-10, -1e-10, 0.05, -3.0):
            shifted = A + rate * np.eye(n)
            assert growth_rate(shifted) == pytest.approx(rate, abs=1e-13 * (1.0 + abs(A).max()))
        for factor in (1.0 + 1e-10, 1.0 - 1e-10, 1.3, 0.2):
            assert growth_factor(factor * Q) == pytest.approx(factor, abs=1e-13)


def test_slow_growth_beside_fast_modes_that_it_does_not_depend_on():
    assert growth_rate(np.array([[1e-18, 0.0], [7.0, -5.0]])) == 1e-18
    assert growth_rate(np.array([[1e-10, 1e6], [-1e-6, 0.0]])) == pytest.approx(5e-11)
    assert growth_rate(np.array([[0.05, 1.0], [0.0, 0.05]])) == 0.05
    assert growth_rate(np.diag([0.0, 1.0])) == 1.0
    assert growth_factor(np.diag([1.0, 1.0 + 1e-12])) == 1.0 + 1e-12
    assert growth_rate(np.zeros((0, 0))) == 0.0


def test_a_mode_of_a_multiple_eigenvalue_is_hidden_in_any_coordinates():
    random = np.random.default_rng(3)
    for n in (2, 3, 4):
        for _ in range(10):
            Q = rotation(random, n)
            A, first, last = Q @ chain(n) @ Q.T, Q[:, :1].T, Q[:, -1:].T
            # The first of the integrators shows all of them, the last only itself.
            assert hidden_mode(A, first, RATE) is None
            assert hidden_mode(A, last, RATE) == 0.0
            assert hidden_mode(A + np.eye(n), first, FACTOR) is None
            assert hidden_mode(A + np.eye(n), last, FACTOR) == pytest.approx(1.0)


def test_undamped_modes_count_as_those_that_do_not_decay():
    random = np.random.default_rng(4)
    for _ in range(100):
        M, Q = random.standard_normal((3, 3)), rotation(random, 3)
        assert hidden_mode(M - M.T, np.zeros((1, 3)), RATE) is not None
        assert hidden_mode(Q, np.zeros((1, 3)), FACTOR) is not None
        assert hidden_mode(M - M.T - 1e-9 * np.eye(3), np.zeros((1, 3)), RATE) is None
        assert hidden_mode(0.999 * Q, np.zeros((1, 3)), FACTOR) is None


@pytest.mark.parametrize("small", [5e-324, 1e-300, 1e-22, 1e-12, 1e-6, 0.0])
def test_a_fast_state_that_follows_a_slow_one_shows_it(small):
    # A sensor with a lag, sampled slowly: F has exp(-T / lag) beside 1 - exp(-T / lag).
    F, show, hide = np.array([[small, 1.0], [0.0, 1.0]]), np.eye(2)[:1], np.array([[1.0, -1.0]])
    for units in (np.ones(2), np.array([1.0, 1024.0])):
        scaled = F * units / units[:, None]
        assert hidden_mode(scaled, show * units, FACTOR) is None
        assert small == 1e-6 or hidden_mode(scaled, hide * units, FACTOR) == 1.0
        assert hidden_mode(scaled, 5e-324 * show, FACTOR) is None
        assert np.isfinite(balance(scaled)[1]).all()


def test_sensors_of_very_different_precision_show_modes_alike():
    A = np.zeros((2, 2))
    assert hidden_mode(A, outputs_of(np.diag([1e6, 1e-7]))) is None
    assert hidden_mode(A, outputs_of(np.diag([1e6, 0.0]))) is not None
    # A real one is printed as one.
    assert f"{hidden_mode(np.diag([-0.5, 2.0]), np.array([[1.0, 0.0]]), RATE):.6g}" == "2"
    random = np.random.default_rng(5)
    for _ in range(100):
        # One reading of a random direction: the rest of the information matrix is rounding.
        H = random.standard_normal((1, 3))
        assert hidden_mode(np.zeros((3, 3)), outputs_of(H.T @ H / 1e-6)) is not None


def test_modes_of_many_states_that_others_drive_are_those_of_the_rank_of_observability():
    random = np.random.default_rng(7)
    verdicts = []
    for _ in range(300):
        n, k = random.integers(1, 6), random.integers(1, 3)
        # Blocks that are equal, apart, or drive each other, of small integers: ranks are exact.
        A = (random.integers(-2, 3, (n, n)) * (random.random((n, n)) < 0.35)).astype(float)
        C = (random.integers(-1, 2, (k, n)) * (random.random((k, n)) < 0.5)).astype(float)
        powers = [np.linalg.matrix_power(A, i) for i in range(n)]
        seen = np.linalg.matrix_rank(np.concatenate([C @ power for power in powers]))
        verdicts.append(seen < n)
        hidden = hidden_mode(A, C)
        assert (hidden is not None) == verdicts[-1]
        if hidden is not None:
            pencil = np.concatenate([A - hidden * np.eye(n), C])
            assert np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-7
    assert 50 < sum(verdicts) < 250


def test_definite_matrices_are_told_from_singular_ones():
    random = np.random.default_rng(6)
    for n in range(2, 7):
        for _ in range(20):
            S = random.standard_normal((n, n - 1))
            assert not is_definite(S @ S.T)
            assert is_definite(S @ S.T + 1e-9 * np.eye(n))
    assert is_definite(np.diag([1e12, 1e-12]))
    assert not is_definite(np.diag([1.0, 0.0]))
    assert not is_definite(np.diag([1.0, -1.0]))


def test_matrices_are_balanced_as_lapack_does():
    random = np.random.default_rng(0)
    for _ in range(200):
        n = random.integers(1, 8)
        units = np.exp(4.0 * random.standard_normal((2, n)))
        there = random.random((n, n)) < 0.7
        A = random.standard_normal((n, n)) * np.outer(*units) * there
        balanced, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
        found = balance(A)
        np.testing.assert_array_equal(found[1], scale)
        np.testing.assert_array_equal(found[0], balanced)
    far, scale = balance(np.array([[0.0, 1e300], [1e-300, 0.0]]))
    assert np.abs(np.log2(far[far > 0.0])).max() <= 0.5
    assert (np.frexp(scale)[0] == 0.5).all()
