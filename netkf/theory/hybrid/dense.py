"""Small problems of H(12) with full matrices: to import scipy.sparse and scipy.linalg takes longer.

The results are those of the sparse and of scipy's solvers, to rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.spectra import growth_rate
from netkf.theory.numerics.matrices import algebraic_riccati, undetectable_mode

MAX_UNKNOWNS = 600
"""Packed numbers of all nodes up to which their coupling is a full matrix."""
MAX_STATES = 6
"""States up to which a Lyapunov equation is solved as one of n^2 unknowns."""
RESIDUAL, NEWTON_STEPS = 1e-13, 4  # of a Riccati equation, relative to its terms


SparseOrFull = Any
"""A scipy.sparse.csr_array, or a FullMatrix."""


class FullMatrix(np.ndarray):
    """A full matrix where otherwise a sparse one stands, with the attributes of both in use."""

    @property
    def nnz(self) -> int:
        """The number of entries that are not 0."""
        return int(np.count_nonzero(self))

    def toarray(self) -> FloatArray:
        """Return the matrix as an ordinary array."""
        return np.asarray(self)


def full_matrix(rows: int, columns: int) -> FullMatrix:
    """Return zeros (rows, columns)."""
    return np.zeros((rows, columns)).view(FullMatrix)


def solve_or_nan(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution of a linear equation, nan if the ``matrix`` is singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full(right.shape, np.nan)


def steady_riccati(A: FloatArray, Q: FloatArray, G: FloatArray) -> FloatArray:
    """Return what ``algebraic_riccati`` returns; raises TheoryError."""
    if len(A) > MAX_STATES or undetectable_mode(A, G) is not None:
        return algebraic_riccati(A, Q, G)
    try:
        return _riccati_by_eigenvectors(A, Q, G)
    except (np.linalg.LinAlgError, TheoryError):
        return algebraic_riccati(A, Q, G)


def _riccati_by_eigenvectors(A: FloatArray, Q: FloatArray, G: FloatArray) -> FloatArray:
    """Return S of ``0 = A S + S A' + Q - S G S``; raises TheoryError unless it is accurate."""
    # S = V U^-1 for the stable eigenvectors (U, V) of the Hamiltonian matrix, and then Newton's
    # method (Kleinman): 0 = (A - S G) S+ + S+ (A - S G)' + Q + S G S.
    n = len(A)
    values, vectors = np.linalg.eig(np.block([[A.T, -G], [-Q, -A]]))
    U, V = vectors[:n, values.real < 0.0], vectors[n:, values.real < 0.0]
    S = symmetric(
        np.asarray(np.linalg.solve(U.T, V.T).real, dtype=np.float64)
    )  # LinAlgError unless there are n of them
    for _ in range(NEWTON_STEPS):
        closed, eye = A - S @ G, np.eye(n)
        lyapunov = np.kron(closed, eye) + np.kron(eye, closed)
        following = np.linalg.solve(lyapunov, -(Q + S @ G @ S).reshape(-1))
        S = symmetric(np.asarray(following, dtype=np.float64).reshape(n, n))
        terms = A @ S, Q, S @ G @ S
        residual = np.abs(terms[0] + terms[0].T + Q - terms[2]).max()
        if residual <= RESIDUAL * sum(np.abs(term).max() for term in terms):
            break
    else:
        raise TheoryError("the Riccati equation is not solved")
    if not growth_rate(A - S @ G) < 0.0:
        raise TheoryError("the solution found does not stabilise the filter")
    return S
