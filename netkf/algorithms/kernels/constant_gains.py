"""Kernels of filters with constant gains L: corrections by increments over a gap, and by samples.

The increments of a sensor are ``dy = H x dt + dv``. Over a gap from a to b, of g seconds, such a
filter gives dy(s) the weight e^{(A - L H)(b - s)} L. It is projected on the Legendre polynomials
P_0 and P_1 of the gap, since a reading is given by the moments m_j = int P_j dy, j = 0 and 1
(``linalg.legendre``). With u = b - s, the time that is left, these are P_j(1 - 2 u / g).

Exponentials and their integrals are power series over a short step, doubled until it is the gap
(scaling and squaring), since a series over a long gap loses its digits.
"""

from __future__ import annotations

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.small import copy_matrix, multiply_square
from netkf.linalg.structs import Size

TERMS = 18  # of the exponential series: enough for a norm of at most 1/2
NEGLIGIBLE = 2.0**-60  # a bound of the norm of terms that change no digit


@kernel
def fill_legendre_integrals(
    M: FloatArray, sign: float, gap: float, J_1: FloatArray, second: FloatArray, work: FloatArray
) -> None:
    """Write ``int_0^g e^{sign M u} P_j(1 - 2 u / g) du`` (n, n) over a ``gap`` g in seconds for the
    Legendre polynomials P_0 (into ``J_1``) and P_1 (into ``second``), with M (n, n). ``sign`` is 1
    or, to go back in time, -1. ``work`` (4, n, n) is scratch; ``work[0]`` ends as e^{sign M g}.
    """
    n, norm, J_2 = len(M), 0.0, work[3]
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(M[i, j]) * gap
        norm = max(norm, row)
    # Scaling: power series for a part of the gap of norm at most 1/2, then doubling.
    doublings, step = 0, gap
    while norm > 0.5:
        norm, step, doublings = 0.5 * norm, 0.5 * step, doublings + 1
    fill_exponential_integrals(M, sign, step, J_1, work)
    for _ in range(doublings):
        double_gap(step, J_1, work)
        step *= 2.0
    # P_1(1 - 2 u / g) = 1 - 2 u / g = 2 (g - u) / g - 1, and J_2 = int_0^g (g - u) e^{sign M u} du.
    for i in range(n):
        for j in range(n):
            second[i, j] = 2.0 * J_2[i, j] / gap - J_1[i, j]


@kernel
def fill_exponential_integrals(
    M: FloatArray, sign: float, step: float, J_1: FloatArray, work: FloatArray
) -> None:
    """Write for a ``step`` of s seconds, by power series, ``J_1 = int_0^s e^{N u} du`` (n, n), and
    e^{N s} and ``J_2 = int_0^s (s - u) e^{N u} du`` into the first and the last of ``work``
    (4, n, n); N is ``sign`` times M (n, n). The other two of ``work`` are scratch.
    """
    n, E, term, product, J_2 = len(M), work[0], work[1], work[2], work[3]
    for i in range(n):
        for j in range(n):
            identity = 1.0 if i == j else 0.0
            E[i, j] = term[i, j] = identity
            J_1[i, j], J_2[i, j] = step * identity, 0.5 * step * step * identity
    # ``term`` is (N s)^k / k!; the integrals of its power u^k add it to J_1 and J_2.
    for k in range(1, TERMS):
        multiply_square(M, product, term, M)
        for i in range(n):
            for j in range(n):
                term[i, j] = sign * product[i, j] * step / k
                E[i, j] += term[i, j]
                J_1[i, j] += term[i, j] * step / (k + 1)
                J_2[i, j] += term[i, j] * step * step / ((k + 1) * (k + 2))


@kernel
def double_gap(step: float, J_1: FloatArray, work: FloatArray) -> None:
    """Double the step s, in seconds, of the integrals ``J_1`` (n, n) and E = ``work[0]``, J_2 =
    ``work[3]`` of ``work`` (4, n, n), in place: J_2 <- J_2 + s J_1 + E J_2, J_1 <- J_1 + E J_1 and
    E <- E E. See ``fill_exponential_integrals``, which writes them for a first step.
    """
    # int_0^2s = int_0^s + int_s^2s, and in the second one e^{M u} = E e^{M (u - s)}. In J_2 the
    # first part has the factor 2 s - u = s + (s - u). J_2 goes first, since it needs the old J_1.
    n, E, product, J_2 = len(J_1), work[0], work[2], work[3]
    multiply_square(E, product, E, J_2)
    for i in range(n):
        for j in range(n):
            J_2[i, j] += step * J_1[i, j] + product[i, j]
    multiply_square(E, product, E, J_1)
    for i in range(n):
        for j in range(n):
            J_1[i, j] += product[i, j]
    multiply_square(E, product, E, E)
    copy_matrix(E, product)


@kernel
def fill_inverse_transition(size: Size, A: FloatArray, gap: float, maps: FloatArray) -> None:
    """Write the inverse transition ``e^{-A g}`` (n, n), by which information is predicted over a
    ``gap`` of g seconds, into the first of ``maps`` (>= 3, n, n), by scaling and squaring; the
    second and third are scratch. A is (n, n), ``size`` has length n.
    """
    out, term, product = maps[0], maps[1], maps[2]
    n, norm = len(size), 0.0
    for i in range(n):
        # The largest row sum of |A| gap bounds the norm of A gap.
        row = 0.0
        for j in range(n):
            row += abs(A[i, j]) * gap
            out[i, j] = term[i, j] = 1.0 if i == j else 0.0
        norm = max(norm, row)
    # exp(-A g) = exp(-A g / 2^k)^(2^k), with a norm of at most 1/2 for the power series.
    halvings, step = 0, -gap
    while norm > 0.5:
        norm, step, halvings = 0.5 * norm, 0.5 * step, halvings + 1
    k, bound = 1, norm
    while bound > NEGLIGIBLE:
        multiply_square(size, product, term, A)
        for i in range(n):
            for j in range(n):
                term[i, j] = product[i, j] * step / k
                out[i, j] += term[i, j]
        k += 1
        bound *= norm / k
    for _ in range(halvings):
        multiply_square(size, product, out, out)
        copy_matrix(out, product)


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
    """Correct the open-loop prediction ``x[k]`` (n,) at the end of a ``gap`` in seconds, entry
    ``k`` of x (K, n), in place by the ``moments`` (2 p,) of the increments of the gap, p with P_0
    and then p with P_1; the gain L is (>= n, >= p) and H (>= p, n).

    A is (n, n) and ``closed`` (n, n) is A - L H; the moments are overwritten with the innovations;
    ``work`` (6, n, n) is scratch. Axes: K estimates.
    """
    n, p = len(A), len(moments) // 2
    first, second, integrals_work = work[4], work[5], work[:4]
    # Innovations: subtract the moments of the predicted reading, dy = H e^{A (s - b)} x(b) ds.
    fill_legendre_integrals(A, -1.0, gap, first, second, integrals_work)
    for i in range(p):
        for j in range(n):
            for m in range(n):
                moments[i] -= H[i, j] * first[j, m] * x[k, m]
                moments[p + i] -= H[i, j] * second[j, m] * x[k, m]
    fill_legendre_integrals(closed, 1.0, gap, first, second, integrals_work)
    # x += sum over j = 0, 1 of (2 j + 1) / g int e^{(A - L H) u} P_j du L m_j: the projection of
    # the weight on P_j, whose square has the integral g / (2 j + 1).
    for j in range(n):
        L_m0, L_m1 = 0.0, 0.0
        for i in range(p):
            L_m0 += L[j, i] * moments[i]
            L_m1 += L[j, i] * moments[p + i]
        for i in range(n):
            x[k, i] += (first[i, j] * L_m0 + 3.0 * second[i, j] * L_m1) / gap
