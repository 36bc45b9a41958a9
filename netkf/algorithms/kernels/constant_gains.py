"""Filters with constant gains in kernels: how increments over a gap move an estimate.

The weight e^{(A - L H)(b - s)} L of dy(s) is projected on the Legendre polynomials P_0 and P_1, of
which the moments of a reading are given (``linalg.legendre``).
"""

from __future__ import annotations

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.small import multiply_square

TERMS = 18  # of the exponential, for a norm of at most 1/2


@kernel
def fill_moments_of(
    M: FloatArray, sign: float, gap: float, first: FloatArray, second: FloatArray, work: FloatArray
) -> None:
    """Write ``int_0^g e^{M u} P_j(1 - 2 u / g) du`` (n, n) for the polynomials P_0 and P_1 into
    ``first`` and ``second``, of ``sign`` times M; ``work`` (4, n, n) is scratch.
    """
    n, norm, later = len(M), 0.0, work[3]
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(M[i, j]) * gap
        norm = max(norm, row)
    # Scaling: power series for a part of the gap, which is doubled.
    doublings, step = 0, gap
    while norm > 0.5:
        norm, step, doublings = 0.5 * norm, 0.5 * step, doublings + 1
    fill_exponential_integrals(M, sign, step, first, work)
    for _ in range(doublings):
        double_gap(step, first, work)
        step *= 2.0
    for i in range(n):
        for j in range(n):
            second[i, j] = 2.0 * later[i, j] / gap - first[i, j]


@kernel
def fill_exponential_integrals(
    M: FloatArray, sign: float, step: float, first: FloatArray, work: FloatArray
) -> None:
    """Write ``J_1 = int_0^s e^{M u} du`` into ``first``, and e^{M s} and
    ``J_2 = int_0^s (s - u) e^{M u} du`` into the first and the last of ``work``, by power series.
    """
    n, E, term, moved, later = len(M), work[0], work[1], work[2], work[3]
    for i in range(n):
        for j in range(n):
            one = 1.0 if i == j else 0.0
            E[i, j] = term[i, j] = one
            first[i, j], later[i, j] = step * one, 0.5 * step * step * one
    for k in range(1, TERMS):
        multiply_square(moved, term, M)
        for i in range(n):
            for j in range(n):
                term[i, j] = sign * moved[i, j] * step / k
                E[i, j] += term[i, j]
                first[i, j] += term[i, j] * step / (k + 1)
                later[i, j] += term[i, j] * step * step / ((k + 1) * (k + 2))


@kernel
def double_gap(step: float, first: FloatArray, work: FloatArray) -> None:
    """Make what ``fill_exponential_integrals`` wrote for a step that of two steps."""
    n, E, moved, later = len(first), work[0], work[2], work[3]
    multiply_square(moved, E, later)
    for i in range(n):
        for j in range(n):
            later[i, j] += step * first[i, j] + moved[i, j]
    multiply_square(moved, E, first)
    for i in range(n):
        for j in range(n):
            first[i, j] += moved[i, j]
    multiply_square(moved, E, E)
    for i in range(n):
        for j in range(n):
            E[i, j] = moved[i, j]


@kernel
def fill_inverse_transition(A: FloatArray, gap: float, maps: FloatArray) -> None:
    """Write ``e^{-A g}`` (n, n) into the first of ``maps`` (6, n, n); the others are scratch."""
    fill_moments_of(A, -1.0, gap, maps[4], maps[5], maps[:4])


@kernel
def correct_by_moments(
    x: FloatArray,
    k: int,
    A: FloatArray,
    closed: FloatArray,
    H: FloatArray,
    L: FloatArray,
    moments: FloatArray,
    gap: float,
    work: FloatArray,
) -> None:
    """Move the prediction ``x[k]`` (n,) at the end of a gap by the ``moments`` (2 p,) of what was
    read in it, of which these are used up, with gain L (>= n, >= p) and H (>= p, n); ``closed`` is
    A - L H, and ``work`` (6, n, n) is scratch.
    """
    n, p = len(A), len(moments) // 2
    first, second, some = work[4], work[5], work[:4]
    # Moments that the prediction says they should have: dy = H e^{A (s - b)} x(b) ds.
    fill_moments_of(A, -1.0, gap, first, second, some)
    for i in range(p):
        for j in range(n):
            for m in range(n):
                moments[i] -= H[i, j] * first[j, m] * x[k, m]
                moments[p + i] -= H[i, j] * second[j, m] * x[k, m]
    fill_moments_of(closed, 1.0, gap, first, second, some)
    for j in range(n):
        step, turn = 0.0, 0.0
        for i in range(p):
            step += L[j, i] * moments[i]
            turn += L[j, i] * moments[p + i]
        for i in range(n):
            x[k, i] += (first[i, j] * step + 3.0 * second[i, j] * turn) / gap


@kernel
def correct_by_innovation(
    x: FloatArray, k: int, H: FloatArray, L: FloatArray, y: FloatArray, moved: FloatArray
) -> None:
    """Add ``L (y - H x)`` to ``x[k]`` (n,) for a sample y (p,); ``moved`` (n,) is scratch."""
    n = x.shape[1]
    for i in range(n):
        moved[i] = x[k, i]
    for r in range(len(y)):
        innovation = y[r]
        for j in range(n):
            innovation -= H[r, j] * x[k, j]
        for i in range(n):
            moved[i] += L[i, r] * innovation
    for i in range(n):
        x[k, i] = moved[i]
