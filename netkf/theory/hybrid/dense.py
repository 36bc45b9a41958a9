"""Small problems of H(12) with full matrices: to import scipy.sparse and scipy.linalg takes longer.

The results are those of the sparse and of scipy's solvers, to rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from netkf.linalg.arrays import FloatArray

MAX_UNKNOWNS = 600
"""Packed numbers of all nodes up to which their coupling is a full matrix."""

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


def matrix_of(values: Any, places: Any, size: int, full: bool) -> SparseOrFull:
    """Return a matrix (size, size) of ``values`` at ``places`` (rows, columns), 0 elsewhere."""
    if not full:
        sparse = scipy.sparse.csr_array((values, places), shape=(size, size), dtype=float)
        sparse.eliminate_zeros()
        return sparse
    matrix = full_matrix(size, size)
    matrix[places] = values
    return matrix


def full_matrix(rows: int, columns: int) -> FullMatrix:
    """Return zeros (rows, columns)."""
    return np.zeros((rows, columns)).view(FullMatrix)


def solve_or_nan(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution of a linear equation, nan if the ``matrix`` is singular."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.full(right.shape, np.nan)
