"""Checks of matrices given by users, and the algebraic equations of continuous time."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import scipy

from netkf.algorithms.kernels.riccati import change_units, move_covariances, state_units
from netkf.algorithms.kernels.riccati import flow_covariance as flow_over
from netkf.core.errors import TheoryError
from netkf.core.printable import MAX_RUNS
from netkf.linalg.arrays import (
    ArrayLike,
    FloatArray,
    is_semidefinite,
    real_numbers,
    square_root,
    symmetric,
)
from netkf.linalg.spectra import RATE, balance, growth_rate, hidden_mode, outputs_of

RESIDUAL = 1e-9  # of an equation, relative to its terms: larger ones mean a failed solver
ROUNDING, NEWTON_STEPS = 1e-13, 4  # of a Riccati equation: what ends refinement, and when it must
LARGEST = 1e100
"""Size of the largest number in a matrix: products of three of them are numbers too."""
MAX_STATES = 6
"""States up to which equations are solved by numpy alone: to import scipy.linalg takes longer."""


def arnoldi_start(size: int) -> FloatArray:
    """Return the vector (size,) with which Arnoldi's method begins: else scipy draws another in
    every call.
    """
    return np.random.default_rng(0).uniform(-1.0, 1.0, size)


def as_numbers(name: str, value: ArrayLike) -> FloatArray:
    """Return ``value`` as a float array, a number as (1, 1); a TheoryError calls it ``name``."""
    try:
        array = real_numbers(value)
    except (TypeError, ValueError, OverflowError):
        message = "must be a matrix of real numbers, rows of equal length"
        kind = f"{type(value).__name__} {getattr(value, 'dtype', '')}".rstrip()
        raise TheoryError(f"{name} {message}, got a {kind}") from None
    if array.ndim == 2 and LARGEST < np.abs(array).max(initial=0.0) < np.inf:
        raise TheoryError(f"{name} must have numbers of at most {LARGEST:g} in size")
    return array.reshape(1, 1) if array.ndim == 0 else array


def as_number(name: str, value: ArrayLike) -> float:
    """Return ``value``, one real number, as a float; else raises TheoryError."""
    array = as_numbers(name, value)
    if array.size != 1:
        raise TheoryError(f"{name} must be one number, its shape is {array.shape}")
    return float(array.reshape(()))


def as_list(name: str, value: Iterable[Any]) -> list[Any]:
    """Return ``value`` as a list; raises TheoryError if it is no sequence."""
    try:
        return list(value)
    except TypeError:
        raise TheoryError(f"{name} must be a list, got a {type(value).__name__}") from None


def as_times(value: Any) -> FloatArray:
    """Return times (T,), not negative and increasing, T > 0; else raises TheoryError."""
    times = as_numbers("times", value)
    times = times.reshape(-1) if times.size == 1 else times
    if times.ndim != 1 or not times.size or not np.isfinite(times).all():
        raise TheoryError("times must be a list of finite numbers that is not empty")
    if (np.diff(times, prepend=0.0) < 0.0).any():
        raise TheoryError("times must be increasing and not negative")
    return times


def as_integer(name: str, value: object, min_value: int, max_value: float = MAX_RUNS) -> int:
    """Return ``value``, an int in ``min_value`` .. ``max_value``; else raises TheoryError."""
    if isinstance(value, (bool, np.timedelta64)) or not isinstance(value, (int, np.integer)):
        raise TheoryError(f"{name} must be an integer, got {value!r}")
    if not min_value <= value <= max_value:
        most = f" and at most {max_value:,}" if max_value < np.inf else ""
        raise TheoryError(f"{name} must be at least {min_value}{most}, got {value!r}")
    return int(value)


def as_square(name: str, value: ArrayLike, n: int | None = None) -> FloatArray:
    """Return ``value`` as a finite (n, n) array, of any n > 0 if None; else raises TheoryError."""
    array = as_numbers(name, value)
    shape_text = "square" if n is None else f"{n} x {n}"
    if array.ndim != 2 or array.shape[0] != array.shape[1] or n not in (None, len(array)):
        raise TheoryError(f"{name} must be a {shape_text} matrix, its shape is {array.shape}")
    if not np.isfinite(array).all():
        raise TheoryError(f"{name} must be finite")
    if n is None and not array.size:
        raise TheoryError(f"{name} must not be empty, its shape is {array.shape}")
    return np.asarray(array)


def as_covariance(name: str, value: ArrayLike, n: int) -> FloatArray:
    """Return ``value`` as a symmetric semidefinite (n, n) array; else raises TheoryError."""
    array = as_square(name, value, n)
    if n == 0:
        return array
    if not np.allclose(array, array.T, rtol=1e-9, atol=1e-12 * np.abs(array).max()):
        raise TheoryError(f"{name} must be symmetric")
    if not is_semidefinite(array):
        raise TheoryError(f"{name} must be positive semidefinite")
    return symmetric(array)


def riccati_flow(P: ArrayLike, A: ArrayLike, Q: ArrayLike, G: ArrayLike, gap: float) -> FloatArray:
    """Solve dP = A P + P A' + Q - P G P from ``P`` over ``gap`` >= 0 seconds; return P(gap) (n, n).

    This is the covariance of a Kalman-Bucy filter, H (4b) of the hybrid paper. All matrices are
    (n, n); ``G = H' R^-1 H``. The relative error is about 1e-15 for any gap. Raises TheoryError for
    wrong shapes, a P, Q or G that is not positive semidefinite, a negative or infinite gap, and if
    the solution overflows.
    """
    drift = as_square("A", A)
    n = len(drift)
    start, noise, information = (
        as_covariance(name, value, n) for name, value in (("P", P), ("Q", Q), ("G", G))
    )
    gap = as_number("gap", gap)
    if not 0.0 <= gap < np.inf:
        raise TheoryError(f"gap must be finite and not negative, got {gap!r}")
    if gap == 0.0:
        return start
    end = move_covariances(flow_over(drift, noise, information, gap), start)
    if not np.isfinite(end).all():
        raise TheoryError(f"the solution overflows before {gap:g} s: an undetectable mode grows")
    return end


def algebraic_riccati(A: FloatArray, Q: FloatArray, G: FloatArray) -> FloatArray:
    """Return the stabilising solution S of ``0 = A S + S A' + Q - S G S``; TheoryError without. It
    is computed in units of states in which A, Q and G (n, n) are balanced.
    """
    hidden = undetectable_mode(A, G)
    if hidden is not None:
        raise TheoryError(
            f"(A, H) is not detectable: the mode with eigenvalue {hidden:.6g} is not seen"
        )
    units = state_units(A, Q, G)
    A, Q, G = change_units(units, A, Q, G)
    S = _stabilising(A, Q, units[:, None] * G)
    return np.asarray(S * units * units[:, None])


def _stabilising(A: FloatArray, Q: FloatArray, G: FloatArray) -> FloatArray:
    """Return the solution of ``algebraic_riccati`` of a detectable plant in balanced units."""
    if len(A) <= MAX_STATES:
        with suppress(np.linalg.LinAlgError, TheoryError):
            # S = V U^-1 for the stable eigenvectors (U, V) of the Hamiltonian matrix.
            values, vectors = np.linalg.eig(np.block([[A.T, -G], [-Q, -A]]))
            U, V = np.split(vectors[:, values.real < 0.0], 2)
            # LinAlgError unless there are n of them.
            return _refined(A, Q, G, np.linalg.solve(U.T, V.T).real)
    try:
        S: Any = scipy.linalg.solve_continuous_are(A.T, square_root(G), Q, np.eye(len(A)))
        return _refined(A, Q, G, S)
    except TheoryError:
        raise
    except (np.linalg.LinAlgError, ValueError) as error:
        # scipy answers 0 for a constant without noise, of which no Newton step exists.
        raise TheoryError(f"no stabilising solution of the Riccati equation: {error}") from None


def _refined(A: FloatArray, Q: FloatArray, G: FloatArray, S: FloatArray) -> FloatArray:
    """Return a solution of ``algebraic_riccati`` without the rounding errors of its solver."""
    for _ in range(NEWTON_STEPS):
        # Newton's method (Kleinman): 0 = (A - S G) S+ + S+ (A - S G)' + Q + S G S.
        S = _solve_lyapunov(A - S @ G, Q + S @ G @ S)
        # The solver does not report an inaccurate or a wrong solution.
        residual = np.abs(A @ S + S @ A.T + Q - S @ G @ S).max()
        size = np.abs(A @ S).max() + np.abs(Q).max() + np.abs(S @ G @ S).max()
        if residual <= ROUNDING * size:
            break
    if not residual <= RESIDUAL * size:
        raise TheoryError(f"the Riccati equation was solved to {residual:.1e} only")
    if not growth_rate(A - S @ G) < 0.0:
        raise TheoryError("the solution found does not stabilise the filter")
    return S


def lyapunov(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return X (n, n) with ``0 = A X + X A' + Q``; raises TheoryError for an unstable A."""
    if not growth_rate(A) < 0.0:
        raise TheoryError("the error dynamics are not stable, their covariance has no limit")
    A, units = balance(A)
    Q = Q / units / units[:, None]
    X = _solve_lyapunov(A, Q)
    residual = np.abs(A @ X + X @ A.T + Q).max()
    if not residual <= RESIDUAL * (np.abs(A @ X).max() + np.abs(Q).max()):
        raise TheoryError(f"the Lyapunov equation was solved to {residual:.1e} only")
    return np.asarray(X * units * units[:, None])


def _solve_lyapunov(A: FloatArray, Q: FloatArray) -> FloatArray:
    """Return symmetric X (n, n) with ``A X + X A' = -Q`` for A and Q (n, n)."""
    n, eye = len(A), np.eye(len(A))
    if n > MAX_STATES:
        X = scipy.linalg.solve_continuous_lyapunov(A, -Q)
    else:
        X = np.linalg.solve(np.kron(A, eye) + np.kron(eye, A), -Q.reshape(-1)).reshape(n, n)
    return symmetric(np.asarray(X, dtype=np.float64))


def undetectable_mode(A: FloatArray, G: FloatArray) -> complex | None:
    """Return an eigenvalue of A (n, n) in the right half plane that G hides, or None."""
    return hidden_mode(A, outputs_of(G), RATE)


def unobservable_mode(A: FloatArray, G: FloatArray) -> complex | None:
    """Return an eigenvalue of A (n, n) that the semidefinite G (n, n) hides (PBH), or None."""
    return hidden_mode(A, outputs_of(G))
