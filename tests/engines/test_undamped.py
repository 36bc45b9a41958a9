"""Plants that neither grow nor decay on paper: rotations, chains of integrators, random walks.

Their eigenvalues are on the border of stability up to rounding, which must decide nothing.
"""

from pathlib import Path

import numpy as np
import pytest
import scipy.linalg

import netkf
from netkf.algorithms.modes import rate_groups
from netkf.scenario.reading import from_table
from tests.engines.agreement import assert_agree


def chain(n):
    return np.diag(np.ones(n - 1), 1) if n > 1 else np.zeros((1, 1))


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_rates_of_modes_that_do_not_decay_are_0_in_any_unit_of_time(unit):
    axes = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    A = scipy.linalg.block_diag([[0.0, 1.0], [-1.0, 0.0]], [[-1.0]])
    rates = rate_groups(unit * axes @ A @ axes.T).rates
    assert rates.min() == 0.0
    assert rates.max() == pytest.approx(unit, rel=1e-9)


def clocked(A, B, H, kind="local"):
    n = len(A)
    filter_table = {"kind": kind, "cov": np.eye(n).tolist()}
    if kind == "hybrid":
        filter_table["epsilon"] = 0.3
    return table(
        {"kind": "diffusion", "A": A.tolist(), "B": B.tolist()}, H, 1.0, 0.25, filter_table
    )


def slotted(F, Q, H):
    plant = {"kind": "linear", "F": F.tolist(), "Q": Q.tolist(), "period": 1.0}
    filter_table = {"kind": "local", "cov": np.eye(len(F)).tolist()}
    return table(plant, H, 6.0, 1.0, filter_table)


def table(plant, H, horizon, probe, filter_table):
    return from_table(
        {
            "format": 1,
            "name": "undamped",
            "horizon": horizon,
            "probe": probe,
            "plant": plant,
            "sensors": [{"nodes": [0], "H": H.tolist(), "R": [[0.1]]}],
            "network": {
                "graph": {"kind": "path", "nodes": 2},
                "activation": {"kind": "broadcast"}
                if plant["kind"] == "linear"
                else {"kind": "poisson", "rate": 3.0},
            },
            "filter": filter_table,
        },
        Path(),
    )


def draw(random, kind):
    n = int(random.integers(1, 7))
    Q, _ = np.linalg.qr(random.standard_normal((n, n)))
    M = random.standard_normal((n, n))
    matrices = {
        "rotation": (M - M.T, Q),
        "integrators": (Q @ chain(n) @ Q.T, Q @ (np.eye(n) + chain(n)) @ Q.T),
    }
    A, F = matrices[kind]
    return A, F, random.standard_normal((n, 1)), random.standard_normal((1, n))


def kalman_bucy(A, B, H, seconds):
    """P after some seconds from P = I, by one exponential of the Hamiltonian matrix."""
    n = len(A)
    M = np.block([[A, B @ B.T], [H.T @ H / 0.1, -A.T]])
    X = scipy.linalg.expm(M * seconds) @ np.concatenate([np.eye(n), np.eye(n)])
    return X[:n] @ np.linalg.inv(X[n:])


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["rotation", "integrators"])
def test_both_engines_run_plants_without_damping(kind):
    random = np.random.default_rng(7)
    for _ in range(12):
        A, F, B, H = draw(random, kind)
        run = assert_agree(clocked(A, B, H))
        assert (run.status, run.exact_errors) == ("complete", False)
        P = kalman_bucy(A, B, H, run.times[-1])
        np.testing.assert_allclose(run.P[-1, 0], P, rtol=1e-7, atol=1e-7 * abs(P).max())
        run = assert_agree(slotted(F, B @ B.T, H))
        assert (run.status, run.exact_errors) == ("complete", False)
        # A sample is filtered, and slot 0 has no reading.
        P = np.eye(len(F))
        for _ in range(int(run.times[-1])):
            P = F @ P @ F.T + B @ B.T
            K = P @ H.T / (H @ P @ H.T + 0.1)
            P -= K @ H @ P
        np.testing.assert_allclose(run.P[-1, 0], P, rtol=1e-7, atol=1e-7 * abs(P).max())


def test_growth_that_the_horizon_is_too_short_for_needs_no_frame():
    # Int value is too large: the steps of a frame of 7e18 s.
    for rate in (1e-18, 1e-3):
        run = assert_agree(clocked(np.array([[rate]]), np.eye(1), np.eye(1)))
        assert (run.status, run.exact_errors) == ("complete", False)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["rotation", "integrators"])
def test_theory_of_plants_without_damping_does_not_depend_on_a_bit(kind):
    random = np.random.default_rng(8)
    for _ in range(10):
        A, F, B, H = draw(random, kind)
        n, unseen = len(A), np.zeros_like(H)
        blind = clocked(A, B, unseen)
        with pytest.raises(netkf.TheoryError):
            netkf.theory.steady_covariance_bound(blind)
        with pytest.raises(netkf.TheoryError, match="not detectable"):
            netkf.theory.central_covariance(blind)
        with pytest.raises(netkf.TheoryError, match="not detectable"):
            netkf.theory.steady_covariance(F, np.eye(n), unseen, np.eye(1))
        if kind == "rotation":
            # Every positive probability suffices.
            assert netkf.theory.critical_probability(F, np.eye(n)) == (0.0, 0.0)
        rows = netkf.theory.assumptions(slotted(F, B @ B.T, H))
        assert len(rows)
        steady = netkf.theory.steady_covariance(F, np.eye(n), np.eye(n), np.eye(n))
        expected = scipy.linalg.solve_discrete_are(F.T, np.eye(n), np.eye(n), np.eye(n))
        np.testing.assert_allclose(steady, expected, rtol=1e-9, atol=1e-9)


def test_a_scalar_mean_at_the_critical_probability_is_infinite():
    for F in np.sqrt([2.0, 3.0, 5.0, 7.0, 10.0]):
        law = netkf.theory.scalar_law(F, 1.0, 1.0, 1.0, 1.0 - 1.0 / F**2)
        assert law.mean() == np.inf


def test_a_constant_that_is_measured_has_no_limit():
    """Of A = 0 without noise and increments: the run ended in a traceback."""
    still = clocked(np.zeros((1, 1)), np.zeros((1, 1)), np.eye(1))
    run = netkf.simulate(still)
    with pytest.raises(netkf.TheoryError):
        netkf.theory.central_covariance(still)
    expected = 1.0 / (1.0 + run.times / float(np.asarray(still.sensors[0].R)[0, 0]))
    np.testing.assert_allclose(run.P[:, 0, 0, 0], expected, rtol=1e-12)
