"""Products and solutions of small matrices, as loops: at n = 2 to 16 BLAS costs more to call.

All are kernels: other kernels and Python call them alike.
"""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Size


@kernel(allocates=True)
def matmul(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the product ``a b`` (r, c) of ``a`` (r, m) and ``b`` (m, c), as a new array."""
    return add_matmul(np.zeros((a.shape[0], b.shape[1])), a, b)


@kernel(allocates=True)
def add_matmul(c: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return ``c + a b`` (r, s) of ``c`` (r, s), ``a`` (r, m) and ``b`` (m, s), as a new array."""
    out = np.empty(c.shape)
    for i in range(c.shape[0]):
        for j in range(c.shape[1]):
            total = c[i, j]
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total
    return out


@kernel
def count_until(changes: np.ndarray, value: float) -> int:
    """Return how many of increasing ``changes`` (C,) are at most ``value``."""
    low, high = 0, len(changes)
    while low < high:
        middle = (low + high) // 2
        if changes[middle] <= value:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def solve_inplace(L: FloatArray, out: FloatArray, n: int) -> None:
    """Replace the first ``n`` rows of ``out`` (>= n, c) by ``L^-1 out``, by Gaussian elimination
    with partial pivoting as in LAPACK; they become nan if L is singular.

    L is a matrix (n, n), the first rows and columns of the argument, and is overwritten.
    """
    columns = out.shape[1]
    for k in range(n):
        pivot = largest_pivot(L, k, n)
        # Only an exact zero is singular: a tiny pivot means an ill-conditioned matrix.
        if L[pivot, k] == 0.0:
            out[:n] = np.nan
            return
        if pivot != k:
            swap_rows(L, k, pivot, k, n)
            swap_rows(out, k, pivot, 0, columns)
        # Forward elimination of column k, in L and in the right-hand side alike.
        for i in range(k + 1, n):
            factor = L[i, k] / L[k, k]
            for j in range(k + 1, n):
                L[i, j] -= factor * L[k, j]
            for j in range(columns):
                out[i, j] -= factor * out[k, j]
    # Back substitution.
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for j in range(columns):
                out[i, j] -= L[i, k] * out[k, j]
        for j in range(columns):
            out[i, j] /= L[i, i]


@kernel
def largest_pivot(L: FloatArray, k: int, n: int) -> int:
    """Return the row from ``k`` to ``n`` - 1 with the largest absolute entry in column ``k``."""
    pivot = k
    for i in range(k + 1, n):
        if abs(L[i, k]) > abs(L[pivot, k]):
            pivot = i
    return pivot


@kernel
def swap_rows(a: FloatArray, i: int, k: int, first: int, last: int) -> None:
    """Swap rows ``i`` and ``k`` of ``a`` (r, c) in place, from column ``first`` to ``last`` - 1."""
    for j in range(first, last):
        a[i, j], a[k, j] = a[k, j], a[i, j]


@kernel
def copy_matrix(target: FloatArray, source: FloatArray) -> None:
    """Copy ``source`` (r, c) into ``target`` (>= r, >= c)."""
    # ``target[:] = source`` would compile broadcasting and its errors: seconds of compile time.
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@kernel
def multiply_square(size: Size, out: FloatArray, a: FloatArray, b: FloatArray) -> None:
    """Write ``a b`` into another array ``out``, all (n, n); ``size`` has length n."""
    n = len(size)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for r in range(n):
                total += a[i, r] * b[r, j]
            out[i, j] = total
