"""Jacobi's method for the eigenvalues and eigenvectors of small symmetric matrices."""

from __future__ import annotations

import math

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel

SWEEPS = 30  # at most; convergence takes far fewer
ROUNDING = 2.0**-54  # relative size of an entry that is too small to change the diagonal


@kernel
def diagonalise(a: FloatArray, vectors: FloatArray) -> None:
    """Leave the eigenvalues of a symmetric ``a`` (n, n) on its diagonal, zeros elsewhere, and write
    its eigenvectors into the columns of ``vectors`` (n, n). Cyclic sweeps (Golub, Van Loan, 8.5).
    """
    n = len(a)
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    # Cyclic sweeps converge quadratically: few are needed.
    for _ in range(SWEEPS):
        turned = False
        for p in range(n):
            for q in range(p + 1, n):
                # An entry too small to change the diagonal is set to 0. The criterion is relative
                # to both diagonal entries, so that small eigenvalues are accurate too.
                if abs(a[p, q]) <= ROUNDING * math.sqrt(abs(a[p, p]) * abs(a[q, q])):
                    a[p, q] = a[q, p] = 0.0
                else:
                    turned = True
                    jacobi_rotate(a, vectors, p, q)
        if not turned:
            return


@kernel
def jacobi_rotate(a: FloatArray, vectors: FloatArray, p: int, q: int) -> None:
    """Apply the Jacobi rotation a <- J' a J, V <- V J in the plane (p, q) that makes a[p, q] 0, to
    the symmetric ``a`` (n, n) and V = ``vectors`` (n, n) in place.
    """
    # tilt = cot(2 angle); t = tan(angle), the smaller of both solutions: |t| <= 1. An infinite tilt
    # is an angle of 0.
    n, tilt = len(a), (a[q, q] - a[p, p]) / (2.0 * a[p, q])
    t = math.copysign(1.0, tilt) / (abs(tilt) + math.sqrt(1.0 + tilt * tilt))
    # Cosine and sine from the tangent: square roots have the same bits on every CPU.
    c = 1.0 / math.sqrt(1.0 + t * t)
    s = t * c
    for k in range(n):
        first, second = a[p, k], a[q, k]
        a[p, k], a[q, k] = c * first - s * second, s * first + c * second
    # Then the columns, and those of V.
    for k in range(n):
        first, second = a[k, p], a[k, q]
        a[k, p], a[k, q] = c * first - s * second, s * first + c * second
        first, second = vectors[k, p], vectors[k, q]
        vectors[k, p], vectors[k, q] = c * first - s * second, s * first + c * second
    a[p, q] = a[q, p] = 0.0
