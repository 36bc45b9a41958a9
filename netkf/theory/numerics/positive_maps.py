"""Spectral radius and fixed points of positive maps: linear maps on symmetric matrices that keep
them positive semidefinite.

A map T maps stacks (S, M, M) of symmetric matrices, such as second moments in each of S modes, to
such stacks. Its spectral radius is its rightmost eigenvalue, with a semidefinite eigenvector X
(Krein and Rutman). Arnoldi's method computes it, and if X is positive definite, X proves it as an
upper bound (Collatz and Wielandt). If X is singular, small maps are solved by dense eigenvalues.
The radius is below 1 if and only if ``X = T(X) + Q`` has a semidefinite solution for a Q > 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray, symmetric
from netkf.linalg.spectra import growth_factor

PositiveMap = Callable[[FloatArray], FloatArray]
Shape = tuple[int, ...]

MAX_DENSE, MAX_DENSE_FALLBACK = 55, 820
"""Largest number of entries in the triangles of a stack for which T is written as a dense matrix:
always, or after an iteration has failed."""
PROOF_TOLERANCE = 1e-6  # relative difference of the radius and the upper bound that X proves
# Vectors are as large as the stack: few of them fit.
KRYLOV_VECTORS, RESTARTS = 24, 200
# Iterative refinement stops at this residual; it gains some digits a round.
RESIDUAL, MAX_ROUNDS = 1e-10, 20


def spectral_radius(T: PositiveMap, shape: Shape) -> float:
    """Return the radius of a positive map ``T`` on stacks (S, M, M); TheoryError if unproved."""
    if _count_numbers(shape) > MAX_DENSE:
        value, X = _extreme_eigenvalue(T, np.broadcast_to(np.eye(shape[-1]), shape), "LR")
        if _least_factor(T, X) <= value * (1.0 + PROOF_TOLERANCE):
            return value
        if _count_numbers(shape) > MAX_DENSE_FALLBACK:
            start = X + np.diag(np.linspace(0.5, 1.5, X.shape[-1])) * np.trace(X.sum(axis=0))
            again, _ = _extreme_eigenvalue(T, start, "LM")
            if not abs(again - value) <= 1e-8 * value:
                raise TheoryError(
                    f"the radius is not certain: searches found {value:.8g} and {again:.8g}"
                )
            return value
    return growth_factor(_dense_matrix(T, shape))


def fixed_point(T: PositiveMap, Q: FloatArray, radius: float) -> FloatArray:
    """Return the solution (S, M, M) of ``X = T(X) + Q``, T of ``radius`` below 1, by refined
    elimination or GMRES, to a residual of RESIDUAL max(1 - radius, 1e-3) relative to the standard
    deviations of row and column; else raises TheoryError.
    """
    # The error of the solution is up to 1 / (1 - radius) times the residual.
    tolerance = RESIDUAL * max(1.0 - radius, 1e-3)
    count = _count_numbers(Q.shape)
    solvers = [_by_gmres] if count > MAX_DENSE else []
    solvers += [_solve_by_elimination] if count <= max(MAX_DENSE, MAX_DENSE_FALLBACK) else []
    for solve in solvers:
        X = np.array(Q)
        for _ in range(MAX_ROUNDS):
            residual = Q + T(X) - X
            if _is_small(residual, X, tolerance):
                return symmetric(X)
            X = X + solve(T, residual)
    raise TheoryError(f"the mean squares were solved to {np.abs(residual).max():.1e} only")


def _count_numbers(shape: Shape) -> int:
    """Return the number of entries in the upper triangles of a stack of the ``shape`` (S, M, M)."""
    return shape[0] * shape[-1] * (shape[-1] + 1) // 2


def _extreme_eigenvalue(
    T: PositiveMap, start: FloatArray, which: Literal["LR", "LM"]
) -> tuple[float, FloatArray]:
    """Return the modulus of an extreme eigenvalue ("LR", "LM") of T, and its eigenvector."""
    # Arnoldi's method from ``start`` (S, M, M) > 0; (0, zeros) if it fails for a small map.
    shape = start.shape
    try:
        values, vectors = scipy.sparse.linalg.eigs(
            _linear_operator(T, shape),
            k=1,
            which=which,
            v0=start.ravel(),
            ncv=KRYLOV_VECTORS,
            tol=1e-12,
            maxiter=RESTARTS,
        )
    except scipy.sparse.linalg.ArpackError as error:
        if _count_numbers(shape) <= MAX_DENSE_FALLBACK:
            return 0.0, np.zeros(shape)  # singular: the caller turns to dense eigenvalues
        raise TheoryError(f"the mean-square radius was not found: {error}") from None
    X = symmetric(vectors[:, 0].real.reshape(shape))
    return float(abs(values[0])), X * np.sign(np.trace(X.sum(axis=0)))


def _least_factor(T: PositiveMap, X: FloatArray) -> float:
    """Return the least c with ``T(X) <= c X``, a bound on the radius; inf if X is not > 0."""
    try:
        roots = np.linalg.cholesky(X)
    except np.linalg.LinAlgError:
        return np.inf
    # L^-1 image L^-T, for X = L L'.
    half = np.linalg.solve(roots, T(X))
    scaled = np.linalg.solve(roots, np.swapaxes(half, 1, 2))
    return float(np.linalg.eigvalsh(symmetric(scaled))[:, -1].max())


def _is_small(residual: FloatArray, X: FloatArray, tolerance: float) -> bool:
    """Return True if ``residual`` is below ``tolerance`` times the deviations of X's diagonal."""
    variances = np.abs(np.diagonal(X, axis1=1, axis2=2)).sum(axis=0)
    deviations = np.sqrt(variances)
    # Small variances must be accurate too, beside large ones of other states.
    allowed = np.outer(deviations, deviations) + 1e-6 * variances.max(initial=0.0)
    return bool((np.abs(residual) <= tolerance * allowed).all())


def _triangle_indices(shape: Shape) -> tuple[IntArray, IntArray, IntArray]:
    rows, columns = np.triu_indices(shape[-1])
    matrices = np.repeat(np.arange(shape[0]), len(rows))
    return matrices, np.tile(rows, shape[0]), np.tile(columns, shape[0])


def _dense_matrix(T: PositiveMap, shape: Shape) -> FloatArray:
    """Return T as a matrix (m, m) on the entries of S upper triangles."""
    triangle, columns = _triangle_indices(shape), []
    for s, i, j in zip(*triangle, strict=True):
        unit = np.zeros(shape)
        unit[s, i, j] = unit[s, j, i] = 1.0
        columns.append(T(unit)[triangle])
    return np.stack(columns, axis=1)


def _solve_by_elimination(T: PositiveMap, right: FloatArray) -> FloatArray:
    """Return the solution (S, M, M) of ``X - T(X) = right`` by elimination."""
    s, i, j = triangle = _triangle_indices(right.shape)
    X = np.zeros_like(right)
    X[s, i, j] = X[s, j, i] = np.linalg.solve(
        np.eye(len(s)) - _dense_matrix(T, right.shape), symmetric(right)[triangle]
    )
    return X


def _by_gmres(T: PositiveMap, right: FloatArray) -> FloatArray:
    """Return the solution of ``X - T(X) = right`` to a relative residual of about 1e-8."""
    x, _ = scipy.sparse.linalg.gmres(
        _linear_operator(lambda X: X - T(X), right.shape),
        right.ravel(),
        rtol=1e-8,
        atol=0.0,
        restart=KRYLOV_VECTORS,
        maxiter=20,
    )
    return symmetric(np.asarray(x).reshape(right.shape))


def _linear_operator(apply: PositiveMap, shape: Shape) -> scipy.sparse.linalg.LinearOperator:
    """Return ``apply`` as a linear operator on vectors (S M M,) of symmetric stacks."""
    size = int(np.prod(shape))
    return scipy.sparse.linalg.LinearOperator(
        (size, size),
        matvec=lambda x: np.asarray(apply(symmetric(np.reshape(x, shape))).ravel()),
        dtype=np.float64,
    )
