"""The Riccati flow against arbitrary-precision arithmetic and against itself."""

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import netkf
from netkf.algorithms.kernels.riccati import flow_covariance, move_covariances
from tests import reference

WALK = np.array([[0.0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
PUSH = np.diag([0.0, 0.25, 0.0, 0.25])
LEAN = np.array([[0.1, 1.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, -1.0]])
DRIVE = np.array([[1.0, 0.5, 0.0], [0.5, 1.25, 2.0], [0.0, 2.0, 4.0]])
SYSTEMS = {  # A, Q, G; the constant-velocity Hamiltonians are defective, R = 0.01 is stiff
    "walk": (WALK, PUSH, np.diag([2.5, 0, 0, 0])),
    "walk, precise": (WALK, PUSH, np.diag([100.0, 0, 0, 0])),
    "walk, blind": (WALK, PUSH, np.zeros((4, 4))),
    "unstable, precise": (LEAN, DRIVE, np.diag([100.0, 0, 0])),
    "unstable, other": (LEAN, DRIVE, np.diag([0, 0, 20.0])),
    "oscillator": (np.array([[0.0, 1], [-1, 0.1]]), np.diag([0.0, 1]), np.diag([4.0, 0])),
    "no noise, unstable": (
        np.array([[0.3, 1, 0], [0, -0.4, 1], [0, 0, -0.9]]),
        np.zeros((3, 3)),
        np.eye(3) + 0.5,
    ),
    "no noise": (np.array([[0.0, 1], [-1, -0.1]]), np.zeros((2, 2)), np.diag([4.0, 0])),
}


def exact(P, A, Q, G, gap):
    n = len(A)
    with mpmath.workdps(40 + int(25 * gap)):
        M = mpmath.matrix(np.block([[-A.T, G], [Q, A]]).tolist())
        E = mpmath.expm(M * mpmath.mpf(gap), method="taylor")
        start = mpmath.matrix(P.tolist())
        X = E[:n, :n] + E[:n, n:] * start
        Y = E[n:, :n] + E[n:, n:] * start
        return np.array((Y * X**-1).tolist(), dtype=float)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("gap", [1e-6, 1e-3, 0.7, 13.0, 100.0])
@pytest.mark.parametrize("name", SYSTEMS)
def test_flow_agrees_with_arbitrary_precision(name, gap):
    A, Q, G = SYSTEMS[name]
    for P in (np.zeros_like(A), 1.5 * np.eye(len(A)), 1e4 * np.eye(len(A))):
        truth = exact(P, A, Q, G, gap)
        got = netkf.theory.riccati_flow(P, A, Q, G, gap)
        assert np.abs(got - truth).max() <= 1e-12 * np.abs(truth).max()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("reads", [True, False])
def test_the_kernel_is_the_formula(seed, n, reads):
    random = np.random.default_rng(seed)
    A, B, C, S = (random.normal(size=(n, n)) for _ in range(4))
    Q, G, P = B @ B.T, C @ C.T * reads, S @ S.T
    for gap in (0.13, 1.7):
        with reference.precisely():
            triple = reference.flow_triple(*reference.exactly(A, Q, G), gap)
            exact, _ = reference.flow(*reference.exactly(P, np.zeros(n)), triple)
        expected = reference.rounded(exact)
        found = move_covariances(flow_covariance(A, Q, G, gap), P)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 5), st.floats(1e-4, 3.0), st.floats(1e-4, 3.0))
def test_flow_composes_over_gaps_and_keeps_covariances(seed, n, first, second):
    random = np.random.default_rng(seed)
    A = random.normal(size=(n, n))
    B, C, S = (random.normal(size=(n, 2)) for _ in range(3))
    Q, G, P = B @ B.T, C @ C.T, S @ S.T
    both, *parts = (flow_covariance(A, Q, G, gap) for gap in (first + second, first, second))
    once, twice = move_covariances(both, P), P
    for part in parts:
        twice = move_covariances(part, twice)
    scale = np.abs(once).max() + 1e-12
    assert np.abs(once - twice).max() <= 1e-10 * scale
    assert np.array_equal(once, once.T)
    assert np.linalg.eigvalsh(once)[0] >= -1e-12 * scale


def test_flows_reach_as_far_as_numbers_do():
    """What no sensor sees grows by e^60 a second: after some seconds there is nothing to invert."""
    Q = np.array([[3.5328630320484016, -1.6336333703502892], [0.0, 0.8087844954083239]])
    Q[1, 0] = Q[0, 1]
    G = np.array([[0.4484587754453364, -0.8405481755376778], [0.0, 1.5754429929442604]])
    G[1, 0] = G[0, 1]
    A = 60.0 * np.eye(2)
    assert not np.isfinite(
        move_covariances(flow_covariance(A, Q, 0.0 * G, 2000.0), np.eye(2))
    ).any()
    P = move_covariances(flow_covariance(A, Q, G, 0.05), np.eye(2))
    np.testing.assert_allclose(P, exact(np.eye(2), A, Q, G, 0.05), rtol=1e-9)


def test_flow_refuses_what_is_no_riccati_equation():
    eye = np.eye(2)
    with pytest.raises(netkf.TheoryError, match="P must be a 2 x 2 matrix"):
        netkf.theory.riccati_flow(np.eye(3), eye, eye, eye, 1.0)
    with pytest.raises(netkf.TheoryError, match="Q must be positive semidefinite"):
        netkf.theory.riccati_flow(eye, eye, -eye, eye, 1.0)
    with pytest.raises(netkf.TheoryError, match="gap must be finite and not negative, got -1"):
        netkf.theory.riccati_flow(eye, eye, eye, eye, -1.0)
    with pytest.raises(netkf.TheoryError, match="overflows"):
        netkf.theory.riccati_flow(eye, 10 * eye, eye, 0 * eye, 100.0)
