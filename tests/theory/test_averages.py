"""R Proposition 25 and R (29), against the exact scalar law and against all words of arrivals."""

import itertools

import numpy as np
import pytest

from netkf import theory
from netkf.core.errors import TheoryError
from tests.reference import switched_riccati

SCALAR = ([[2.0**0.5]], [[1.0]], [[1.0]], [[1.0]])
PLANAR = ([[1.1, 0.3], [0.0, 0.9]], np.diag([0.5, 0.2]), [[1.0, 0.0]], [[0.4]])


@pytest.mark.parametrize("delivery", [0.75, 0.3])
def test_the_average_of_an_indicator_over_one_path_is_its_probability(delivery):
    """Also below the critical probability, 0.5, where P has no mean."""
    law = theory.scalar_law(*SCALAR, delivery)
    for level in (0.4, 0.9):
        edge = float(law.quantile(level)) * (1.0 + 1e-9)
        found = theory.path_average(lambda P, e=edge: P[:, 0, 0] <= e, *SCALAR, delivery, 40_000, 3)
        assert abs(found.mean - float(law.cdf(edge))) < 4.0 * found.error < 0.05


def test_the_average_of_the_covariance_is_its_mean():
    """R (140) with h(P) = P at g = 0.9, where it has a mean and a variance: 2.881815."""
    found = theory.path_average(lambda P: P[:, 0, 0], *SCALAR, 0.9, 200_000, 5)
    assert abs(found.mean - 2.881815) < 4.0 * found.error < 0.05
    assert theory.path_average(lambda P: P[:, 0, 0], *SCALAR, 0.9, 200_000, 5) == found


def test_a_path_follows_the_equation_from_its_start():
    """Every reading arrives, so that the path is f_1 again and again, from P_0 on."""
    F, Q, H, R = map(np.array, PLANAR)
    expected, P = [], np.diag([2.0, 3.0])
    for _ in range(50):
        expected.append(np.trace(P))
        P = switched_riccati(P, [0], F, Q, [(H, R)])
    found = theory.path_average(
        lambda P: np.trace(P, axis1=1, axis2=2), F, Q, H, R, 1.0, 50, 0, np.diag([2.0, 3.0])
    )
    assert found.mean == pytest.approx(np.mean(expected), rel=1e-12)


def test_pieces_of_a_long_path_join(monkeypatch):
    from netkf.theory.intermittent import averages

    whole = theory.path_average(lambda P: P[:, 0, 0], *SCALAR, 0.75, 500, 1)
    monkeypatch.setattr(averages, "MAX_ENTRIES", 7)
    assert theory.path_average(lambda P: P[:, 0, 0], *SCALAR, 0.75, 500, 1) == whole


def test_wrong_arguments_of_a_path():
    for delivery in (0.0, 1.5):
        with pytest.raises(TheoryError, match="delivery"):
            theory.path_average(lambda P: P[:, 0, 0], *SCALAR, delivery, 100, 1)
    with pytest.raises(TheoryError, match="one number"):
        theory.path_average(lambda P: P, *SCALAR, 0.5, 100, 1)


@pytest.mark.parametrize("system", [SCALAR, PLANAR], ids=["scalar", "planar"])
@pytest.mark.parametrize("g", [0.2, 0.7])
def test_the_bounds_enclose_the_exact_mean(system, g):
    """The exact mean is over all 2^t words of arrivals."""
    F, Q, H, R = map(np.array, system)
    start = 1.5 * np.eye(len(F))
    bounds = theory.mean_covariance_bounds(F, Q, H, R, g, 8, start)
    for t in range(1, 9):
        mean = 0.0
        for word in itertools.product((0, 1), repeat=t):
            share = np.prod([g if arrived else 1.0 - g for arrived in word])
            mean = mean + share * switched_riccati(start, word, F, Q, [(H[:0], R[:0, :0]), (H, R)])
        size = 1e-12 * np.trace(mean)
        assert np.linalg.eigvalsh(mean - bounds.lower[t]).min() >= -size
        assert np.linalg.eigvalsh(bounds.upper[t] - mean).min() >= -size
    # the bounds mean something: they meet where all or no readings arrive
    sure = theory.mean_covariance_bounds(F, Q, H, R, 1.0, 4, start)
    expected = switched_riccati(start, [0] * 4, F, Q, [(H, R)])
    np.testing.assert_allclose(sure.upper[4], expected, rtol=1e-12)


def test_the_mean_diverges_up_to_the_critical_probability():
    """R (29): at g = 1/2 and below for F = sqrt 2; the lower bound is a geometric sum there."""
    slow = 1.4**200 + (1.4**200 - 1.0) / 0.4
    for g, expected in ((0.5, 1.0 + 200.0), (0.3, slow), (0.75, 2.0)):
        bounds = theory.mean_covariance_bounds(*SCALAR, g, 200, [[1.0]])
        assert bounds.lower[200, 0, 0] == pytest.approx(expected, rel=1e-9)
    assert bounds.upper[200, 0, 0] < 4.5  # above the critical probability the mean is 4.266
