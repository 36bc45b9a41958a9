"""Products and factors whose last bits do not depend on the loops that BLAS chooses for the CPU.

All sums are added in the order of the index, entry by entry, by operations that IEEE 754 rounds
correctly. The truth, the readings and the factors of their noise are made of these.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal, localcontext
from functools import cache

import numpy as np

from netkf.linalg.arrays import FloatArray, square_root, symmetric
from netkf.linalg.jacobi import diagonalise

MAX_REFINED_STATES = 40
"""States up to which eigenvectors are refined here; above, they are those of LAPACK."""
SAME = 0.9
"""Least cosine between an eigenvector and that of LAPACK which it stands for."""


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return ``a b`` (..., r, c) of (..., r, m) and (..., m, c)."""
    if a.shape[-1] == 0:
        shape = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
        return np.zeros((*shape, a.shape[-2], b.shape[-1]))
    # A sum begins with 0, whose sign a first term of -0 must not change.
    total: FloatArray = a[..., :, 0, None] * b[..., None, 0, :] + 0.0
    for k in range(1, a.shape[-1]):
        total += a[..., :, k, None] * b[..., None, k, :]
    return total


def apply(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return ``a x`` (..., r) of (..., r, m) and (..., m)."""
    if a.shape[-1] == 0:
        return np.zeros(np.broadcast_shapes(a.shape[:-1], (*x.shape[:-1], 1)))
    total: FloatArray = a[..., 0] * x[..., 0, None] + 0.0
    for k in range(1, a.shape[-1]):
        total += a[..., k] * x[..., k, None]
    return total


def norm(x: FloatArray) -> FloatArray:
    """Return the Euclidean norms (...) of vectors (..., m)."""
    return np.asarray(np.sqrt(product(x[..., None, :], x[..., None])[..., 0, 0]))


def cholesky(matrix: FloatArray) -> FloatArray:
    """Return the lower triangular ``L`` with ``L L' = matrix`` (n, n), positive definite."""
    L = np.array(matrix, dtype=np.float64)
    for k in range(len(L)):
        L[k, k] = np.sqrt(L[k, k])
        L[k + 1 :, k] /= L[k, k]
        L[k + 1 :, k + 1 :] -= L[k + 1 :, k, None] * L[None, k + 1 :, k]
    return np.tril(L)


def solve_lower(L: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``L^-1 right`` (..., n, c) of a lower triangular ``L`` (n, n)."""
    out = np.array(right, dtype=np.float64)
    for k in range(len(L)):
        out[..., k, :] /= L[k, k]
        out[..., k + 1 :, :] -= L[k + 1 :, k, None] * out[..., None, k, :]
    return out


def eigenvectors(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (n,), increasing, and eigenvectors (n, n) of a symmetric matrix."""
    A, V = np.ascontiguousarray(symmetric(matrix)), np.eye(len(matrix))
    # Diagonal ones, which are frequent, compile nothing.
    if np.count_nonzero(A - np.diag(A.diagonal())):
        diagonalise(A, V)
    order = np.argsort(np.diag(A), kind="stable")
    return np.diag(A)[order], V[:, order]


def _spectral(matrix: FloatArray, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return ``V f(w) V'`` of a symmetric matrix ``V diag(w) V'``."""
    values, vectors = eigenvectors(matrix)
    return symmetric(product(vectors * function(values), vectors.T))


def symmetric_root(matrix: FloatArray) -> FloatArray:
    """Return the square root that is symmetric itself: it moves little where the matrix does, while
    the vectors that :func:`noise_root` is made of may turn round.
    """
    return _spectral(matrix, lambda values: np.sqrt(np.maximum(values, 0.0)))


def pseudo_inverse(matrix: FloatArray, rcond: float) -> FloatArray:
    """Return the inverse of a symmetric matrix on the space of the eigenvalues above ``rcond``
    times the largest.
    """

    def invert(values: FloatArray) -> FloatArray:
        small = np.abs(values) <= rcond * np.abs(values).max(initial=0.0)
        return np.where(small, 0.0, 1.0 / np.where(small, 1.0, values))

    return _spectral(matrix, invert)


def noise_root(matrix: FloatArray) -> FloatArray:
    """Return the factor ``S`` (n, n) with ``S S' = matrix`` of ``square_root``, to rounding.

    The order and the signs of its columns are those of LAPACK. Where an eigenvalue is multiple and
    its vectors are no others than LAPACK's turned round, and for many states, it is
    ``square_root``.
    """
    given = square_root(matrix)
    if len(matrix) > MAX_REFINED_STATES:
        return given
    values, vectors = eigenvectors(matrix)
    lengths = np.sqrt(product(given.T, given).diagonal())
    cosines = product(vectors.T, np.divide(given, lengths, out=0.0 * given, where=lengths > 0.0))
    taken, clear = np.abs(cosines).argmax(axis=0), np.abs(cosines).max(axis=0) > SAME
    # Columns that are zero but for rounding have no direction to compare.
    void = ~clear & (lengths <= 1e-7 * lengths.max(initial=0.0))
    rest = [k for k in range(len(matrix)) if k not in taken[~void]]
    if not (clear | void).all() or len(rest) != void.sum():
        return given
    taken[void] = rest
    signs = np.where(cosines[taken, np.arange(len(matrix))] < 0.0, -1.0, 1.0)
    return np.asarray(vectors[:, taken] * (signs * np.sqrt(np.maximum(values, 0.0))[taken]))


@cache
def gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of Gauss quadrature on [0, 1], each (count,), correctly rounded."""
    nodes, weights = [], []
    with localcontext() as context:
        context.prec = 40
        for k in range(count):
            x = Decimal(float(np.cos(np.pi * (count - k - 0.25) / (count + 0.5))))
            for _ in range(8):
                value, slope = _legendre(count, x)
                x -= value / slope
            slope = _legendre(count, x)[1]
            nodes.append(float((x + 1) / 2))
            weights.append(float(1 / ((1 - x * x) * slope * slope)))
    return np.array(nodes), np.array(weights)


def _legendre(count: int, x: Decimal) -> tuple[Decimal, Decimal]:
    """Return the Legendre polynomial of degree ``count`` at x, and its derivative."""
    before, value = Decimal(1), x
    for k in range(2, count + 1):
        before, value = value, ((2 * k - 1) * x * value - (k - 1) * before) / k
    return value, count * (x * value - before) / (x * x - 1)
