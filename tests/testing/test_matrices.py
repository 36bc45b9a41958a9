"""assert_dominated against eigenvalues worked out by hand."""

import numpy as np
import pytest

from netkf.testing import assert_dominated


def test_what_is_dominated_passes_and_what_is_not_names_its_place():
    P = np.tile(np.eye(2), (3, 4, 1, 1))
    assert assert_dominated(P, 2.0 * np.eye(2)) is None
    assert assert_dominated(P, P) is None
    P[2, 1] = [[1.0, 1.5], [1.5, 1.0]]  # eigenvalues 2.5 and -0.5
    with pytest.raises(AssertionError) as caught:
        assert_dominated(P, np.broadcast_to(2.0 * np.eye(2), P.shape))
    text = str(caught.value)
    assert text.startswith("P[2, 1]: must stay below the bound; the least eigenvalue of bound - P")
    assert "is -0.5, one of 1 places of 12" in text


def test_smaller_diagonals_are_not_enough():
    """Entry by entry below, and yet not below as a matrix: 1.1 I - P has the eigenvalue -0.8."""
    P = np.array([[1.0, -0.9], [-0.9, 1.0]])
    with pytest.raises(AssertionError, match=r"P: must stay below the bound; .* is -0.8"):
        assert_dominated(P, [[1.1, 0.0], [0.0, 1.1]])


def test_the_tolerance_is_relative_to_the_bound():
    big = 1e6 * np.eye(2)
    assert assert_dominated(big * (1.0 + 1e-7), big, tolerance=1e-6) is None
    with pytest.raises(AssertionError):
        assert_dominated(big * (1.0 + 1e-5), big, tolerance=1e-6)


def test_what_cannot_be_compared_is_told():
    for P, bound, words in (
        (np.eye(2), np.eye(3), r"bound: must have the shape of P; got \(3, 3\) for \(2, 2\)"),
        (np.ones(3), np.eye(3), r"P: must be a square matrix or a stack of them; got \(3,\)"),
        (np.eye(2), np.full((4, 2, 2), np.nan), r"bound: must be finite; got nan or inf\[0\]"),
    ):
        with pytest.raises(AssertionError, match=words):
            assert_dominated(P, bound)


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_cholesky_on_random_matrices(seed):
    random = np.random.default_rng(seed)
    P, root = random.normal(size=(2, 3, 3))
    P = P @ P.T
    gap = root @ root.T + 1e-3 * np.eye(3)
    assert assert_dominated(P, P + gap) is None
    with pytest.raises(AssertionError):
        assert_dominated(P + gap, P)
