"""Products and factorisations with the same bits on every CPU, unlike those of BLAS and LAPACK.

Sums are added in the order of the index, by operations that IEEE 754 rounds correctly. True states,
readings and the factors of their noises are computed with these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from decimal import Decimal, localcontext
from functools import cache

import numpy as np

from netkf.linalg.arrays import FloatArray, spectral_root, square_root, symmetric
from netkf.linalg.jacobi import diagonalise

MAX_REFINED_STATES = 40
"""Largest n for which :func:`noise_root` computes its own eigenvectors instead of LAPACK's."""
MANY = 32
"""Length of a sum from which on terms are looked through for those that are 0."""
SAME = 0.9
"""Smallest |cosine| between an eigenvector and that of LAPACK which it is matched with."""


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the product ``a b`` (..., r, c) of ``a`` (..., r, m) and ``b`` (..., m, c)."""
    if a.shape[-1] == 0:
        shape = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
        return np.zeros((*shape, a.shape[-2], b.shape[-1]))
    if b.shape[-1] > MANY:
        return _product_of_blocks(a, b)
    # + 0.0: a sum starts with 0, so that a first term of -0 gives +0.
    total: FloatArray = a[..., :, 0, None] * b[..., None, 0, :] + 0.0
    for k in range(1, a.shape[-1]):
        total += a[..., :, k, None] * b[..., None, k, :]
    return total


def _product_of_blocks(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return ``a b``, without the terms that are 0 because an entry is 0 in all matrices."""
    shape = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    total = np.zeros((*shape, a.shape[-2], b.shape[-1]))
    rows, columns = (np.asarray(x.any(axis=tuple(range(x.ndim - 2)))) for x in (a, b))
    for k in range(a.shape[-1]):
        i, j = np.flatnonzero(rows[:, k]), np.flatnonzero(columns[k])
        if 4 * len(i) * len(j) > total.shape[-2] * total.shape[-1]:
            total += a[..., :, k, None] * b[..., None, k, :]
        elif len(i) and len(j):
            total[..., i[:, None], j] += a[..., i, k, None] * b[..., None, k, j]
    return total


def apply(a: FloatArray, x: FloatArray) -> FloatArray:
    """Return the product ``a x`` (..., r) of ``a`` (..., r, m) and vectors ``x`` (..., m)."""
    if a.shape[-1] == 0:
        return np.zeros(np.broadcast_shapes(a.shape[:-1], (*x.shape[:-1], 1)))
    if x.ndim == 1:
        # Of one vector: fewer calls of numpy. An accumulated sum has the order of the index.
        return np.asarray(np.add.accumulate(a * x, axis=-1)[..., -1] + 0.0)
    total: FloatArray = a[..., 0] * x[..., 0, None] + 0.0
    terms: Iterable[int] = range(1, a.shape[-1])
    if a.shape[-1] > MANY:
        # Terms that are 0, as those of other blocks of a plant, change no bit of a sum.
        terms = 1 + np.flatnonzero(x[..., 1:].any(axis=tuple(range(x.ndim - 1))))
    for k in terms:
        total += a[..., k] * x[..., k, None]
    return total


def norm(x: FloatArray) -> FloatArray:
    """Return the Euclidean norms (...) of vectors ``x`` (..., m)."""
    # An accumulated sum has the order of the index; that of no numbers is 0.
    return np.asarray(np.sqrt(np.add.accumulate(x * x, axis=-1)[..., -1:].sum(axis=-1)))


def cholesky(matrix: FloatArray) -> FloatArray:
    """Return lower triangular ``L`` (n, n) with ``L L' = matrix``, which is positive definite."""
    L = np.array(matrix, dtype=np.float64)
    for k in range(len(L)):
        # One outer product a step: every entry is reduced in the order of k, whatever the CPU.
        L[k, k] = np.sqrt(L[k, k])
        L[k + 1 :, k] /= L[k, k]
        L[k + 1 :, k + 1 :] -= L[k + 1 :, k, None] * L[None, k + 1 :, k]
    return np.tril(L)


def solve_lower(L: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``L^-1 right`` (..., n, c) of lower triangular ``L`` (n, n) and ``right``."""
    out = np.array(right, dtype=np.float64)
    for k in range(len(L)):
        # Forward substitution by columns, so that numpy works on whole rows at once.
        out[..., k, :] /= L[k, k]
        out[..., k + 1 :, :] -= L[k + 1 :, k, None] * out[..., None, k, :]
    return out


def eigenvectors(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (n,), increasing, and eigenvectors (columns) of symmetric ``matrix``."""
    A, V = np.ascontiguousarray(symmetric(matrix)), np.eye(len(matrix))
    # Diagonal matrices, which are frequent, need no compiled kernel.
    if np.count_nonzero(A - np.diag(A.diagonal())):
        diagonalise(A, V)
    order = np.argsort(np.diag(A), kind="stable")
    return np.diag(A)[order], V[:, order]


def _spectral(matrix: FloatArray, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return ``V f(w) V'`` (n, n) of a symmetric ``matrix`` (n, n) = ``V diag(w) V'``."""
    values, vectors = eigenvectors(matrix)
    return symmetric(product(vectors * function(values), vectors.T))


def symmetric_root(matrix: FloatArray) -> FloatArray:
    """Return the symmetric square root (n, n) of a positive semidefinite ``matrix`` (n, n).

    It is a continuous function of the matrix, unlike :func:`noise_root` with its eigenvectors.
    """
    return _spectral(matrix, lambda values: np.sqrt(np.maximum(values, 0.0)))


def pseudo_inverse(matrix: FloatArray, rcond: float) -> FloatArray:
    """Return the pseudo-inverse (n, n) of a symmetric ``matrix`` (n, n), in which eigenvalues of
    size up to ``rcond`` times the largest count as 0.
    """

    def invert(values: FloatArray) -> FloatArray:
        """Return the reciprocals (n,) of eigenvalues, 0 for those that count as 0."""
        small = np.abs(values) <= rcond * np.abs(values).max(initial=0.0)
        return np.where(small, 0.0, 1.0 / np.where(small, 1.0, values))

    return _spectral(matrix, invert)


def noise_root(matrix: FloatArray) -> FloatArray:
    """Return a factor ``S`` (n, n) with ``S S' = matrix`` (n, n), equal to ``spectral_root`` up to
    rounding but with the same bits on every CPU.

    The order and signs of its columns are those of LAPACK. Where the eigenvectors cannot be matched
    with LAPACK's (multiple eigenvalues have arbitrary ones), and for more than MAX_REFINED_STATES
    states, the result is ``spectral_root``, with the bits of LAPACK, or ``square_root`` where that
    has lost the rows of small units.
    """
    # LAPACK decides the order and the signs of columns, which do not depend on its last bits.
    lapack_root, sizes = spectral_root(matrix), matrix.diagonal()
    lost = np.abs((lapack_root**2).sum(axis=1) - sizes) > 1e-9 * sizes
    unmatched = square_root(matrix) if (lost & (sizes > 0.0)).any() else lapack_root
    if len(matrix) > MAX_REFINED_STATES:
        return unmatched
    values, vectors = eigenvectors(matrix)
    lengths = np.sqrt(product(lapack_root.T, lapack_root).diagonal())
    cosines = product(
        vectors.T, np.divide(lapack_root, lengths, out=0.0 * lapack_root, where=lengths > 0.0)
    )
    matches, is_clear = np.abs(cosines).argmax(axis=0), np.abs(cosines).max(axis=0) > SAME
    # Columns that are zero up to rounding have no direction: they get the unused eigenvectors.
    is_zero = ~is_clear & (lengths <= 1e-7 * lengths.max(initial=0.0))
    unused = [k for k in range(len(matrix)) if k not in matches[~is_zero]]
    if not (is_clear | is_zero).all() or len(unused) != is_zero.sum():
        return unmatched
    matches[is_zero] = unused
    signs = np.where(cosines[matches, np.arange(len(matrix))] < 0.0, -1.0, 1.0)
    return np.asarray(vectors[:, matches] * (signs * np.sqrt(np.maximum(values, 0.0))[matches]))


@cache
def gauss_legendre(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of Gauss-Legendre quadrature on [0, 1], each (count,), correctly
    rounded: Newton's method for the roots of the Legendre polynomial in 40 digits.
    """
    nodes, weights = [], []
    with localcontext() as context:
        context.prec = 40
        for k in range(count):
            # An asymptotic formula for root k, from which Newton's method converges quadratically.
            x = Decimal(float(np.cos(np.pi * (count - k - 0.25) / (count + 0.5))))
            for _ in range(8):
                value, slope = _legendre(count, x)
                x -= value / slope
            slope = _legendre(count, x)[1]
            nodes.append(float((x + 1) / 2))
            weights.append(float(1 / ((1 - x * x) * slope * slope)))
    return np.array(nodes), np.array(weights)


def _legendre(degree: int, x: Decimal) -> tuple[Decimal, Decimal]:
    """Return the Legendre polynomial of this ``degree`` at x, and its derivative."""
    previous, value = Decimal(1), x
    for k in range(2, degree + 1):
        # k P_k = (2 k - 1) x P_(k-1) - (k - 1) P_(k-2)
        previous, value = value, ((2 * k - 1) * x * value - (k - 1) * previous) / k
    return value, degree * (x * value - previous) / (x * x - 1)
