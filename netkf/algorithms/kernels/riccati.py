"""The flow of the Riccati equation dP = A P + P A' + Q - P G P over gaps of any length.

P is the covariance of a Kalman-Bucy filter between messages, for a plant ``dx = A x dt + noise`` of
covariance Q per second and sensors that give the information ``G = H' R^-1 H`` per second. The
theory of paper H (Tanwani 2021) uses these covariances; filters carry roots of P, which
``root_flow`` moves.

The flow is the linear-fractional action of ``exp(M gap)`` with the Hamiltonian ``M = [[-A', G], [Q,
A]]``: if ``[X; Y] = exp(M gap) [I; P]`` then ``P(gap) = Y X^-1``. One exponential over a long gap
loses every digit, so a gap is cut into whole units, in which ``|M| unit <= 1``, and a rest. The
rest uses a Taylor series whose coefficients are tabulated; the number of whole units is written in
binary digits: the flow over ``unit * 2^k`` is tabulated as the triple ``(F, G, Q)`` with ``P -> Q +
F P (I + G P)^-1 F'``, and a triple follows from the one before it by the doubling formulas (Davison
and Maki 1973; Anderson 1978), which only add positive terms.

Without readings, ``G = 0``, the rest needs no inverse: ``P(gap) = e P e' + W`` with
``e = exp(A gap)`` and the covariance W of the noise of the gap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.compiling import kernel
from netkf.linalg.series import polynomial, with_reach
from netkf.linalg.small import add_matmul, matmul, matvec, solve, symmetrize

TAYLOR_TERMS = 19  # 1 / 19! is below double rounding when |M| unit <= 1


class RiccatiTable(NamedTuple):
    """Everything that depends on ``A, Q, G`` (n, n) and not on ``P`` or the gap.

    n      : number of states
    unit   : gap that the series covers, seconds
    series : (terms, 5 n n + 1) Taylor coefficients of the blocks of ``exp(M g)`` and of
             ``exp(A g)``, and in the last column their reach, the longest gap for which the terms
             so far suffice (linalg/series)
    unobserved : (terms, 2 n n + 1) those of ``exp(A g)`` and of W where G = 0, else no row
    transition, F, G, Q : (levels, n, n) ``exp(A g)`` and the triple for ``g = unit * 2^level``
    """

    n: int
    unit: float
    series: FloatArray
    unobserved: FloatArray
    transition: FloatArray
    F: FloatArray
    G: FloatArray
    Q: FloatArray


def exponential_series(M: FloatArray, terms: int) -> FloatArray:
    """Return the series (terms, n, n) with ``exp(M g) = sum_k g^k series[k]`` for M (n, n), in its
    precision.
    """
    series = np.empty((terms, *M.shape), dtype=M.dtype)
    series[0] = np.eye(len(M))
    for k in range(1, terms):
        # (M g)^k / k! from the term before it.
        series[k] = series[k - 1] @ M / k
    return series


def lyapunov_series(A: FloatArray, Q: FloatArray, terms: int) -> FloatArray:
    """Return the power series (terms, n, n) in g of the noise covariance W(g) with
    ``dW/dg = A W + W A' + Q`` and W(0) = 0; A and Q are (n, n).
    """
    series = np.zeros((terms, *A.shape))
    series[1] = Q
    for k in range(2, terms):
        # k W_k = A W_(k-1) + W_(k-1) A' from k = 2 on: Q is constant and enters W_1 only.
        A_W = A @ series[k - 1]
        series[k] = (A_W + A_W.T) / k
    return series


def hamiltonian(A: FloatArray, Q: FloatArray, G: FloatArray) -> tuple[FloatArray, float]:
    """Return the Hamiltonian (2 n, 2 n) ``[[-A', G s], [Q / s, A]]`` of the Riccati equation of
    ``P / s`` and the scale ``s`` that balances ``Q`` against ``G``; A, Q and G are (n, n).
    """
    size_A, size_Q, size_G = (float(np.abs(matrix).max()) for matrix in (A, Q, G))
    # A floor, so that a plant without dynamics does not divide by zero below.
    size_A = max(size_A, 1e-6)
    if size_Q > 0.0 and size_G > 0.0:
        # Equal sizes of Q / s and G s keep |M| small and with it the number of units.
        scale = (size_Q / size_G) ** 0.5
    elif size_Q > 0.0 or size_G > 0.0:  # scale the one that is not 0 to the size of A
        scale = size_Q / size_A if size_Q > 0.0 else size_A / size_G
    else:
        # Q = G = 0: any scale is right.
        scale = 1.0
    return np.block([[-A.T, G * scale], [Q / scale, A]]), scale


def riccati_table(A: FloatArray, Q: FloatArray, G: FloatArray, longest: float) -> RiccatiTable:
    """Return the table of the Riccati flow ``dP = A P + P A' + Q - P G P`` for gaps up to
    ``longest`` seconds; ``A, Q, G`` are (n, n).
    """
    n = len(A)
    M, scale = hamiltonian(A, Q, G)
    norm, abs_A, unobserved = float(np.abs(M).sum(axis=0).max()), np.abs(A), not G.any()
    if unobserved:  # W grows by A from both sides
        norm = max(norm, float(abs_A.sum(axis=0).max() + abs_A.sum(axis=1).max()))
    # A power of two, so that a whole number of units is exact.
    unit = 2.0 ** np.floor(np.log2(min(1.0 / max(norm, 1e-300), longest)))
    blocks = exponential_series(M, TAYLOR_TERMS)
    # Undo the scaling of hamiltonian(): G and Q get their units back, and kernels need no scale.
    blocks[:, :n, n:] /= scale
    blocks[:, n:, :n] *= scale
    transition = exponential_series(A, TAYLOR_TERMS)
    series, unobserved_series = (
        _side_by_side(unit, blocks, transition),
        np.zeros((0, 2 * n * n + 1)),
    )
    if unobserved:
        unobserved_series = _side_by_side(unit, transition, lyapunov_series(A, Q, TAYLOR_TERMS))
    # Binary digits of the largest number of whole units.
    levels = max(1, int(longest / unit).bit_length())
    return RiccatiTable(
        n, unit, series, unobserved_series, *_doubling_tables(M, scale, A, unit, levels)
    )


def _side_by_side(unit: float, *parts: FloatArray) -> FloatArray:
    """Return power series side by side (terms, size + 1), the reach of each row last."""
    rows = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    return with_reach(rows, unit)


def _doubling_tables(
    M: FloatArray, scale: float, A: FloatArray, unit: float, levels: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return exp(A t), F, G and Q (levels, n, n) over 1, 2, 4, ... units."""
    # Doubling also doubles the relative error, so it works in extended precision (where the
    # machine has it): after 2^14 units a table in double would have lost 1e-12.
    n, wide = len(A), np.longdouble
    # E = exp(M unit) gives the first triple: with [X; Y] = E [I; P], F = E11^-T, G = E11^-1 E12 and
    # Q = E21 E11^-1. Extended precision needs 24 terms, more than TAYLOR_TERMS.
    E = np.tensordot(wide(unit) ** np.arange(24), exponential_series(M.astype(wide), 24), 1)
    inverse = _invert_extended(E[:n, :n])
    F, G, Q = inverse.T, inverse @ E[:n, n:], E[n:, :n] @ inverse
    transition = np.tensordot(
        wide(unit) ** np.arange(24), exponential_series(A.astype(wide), 24), 1
    )
    tables = tuple(np.empty((levels, n, n)) for _ in range(4))
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable plant overflows late
        for level in range(levels):
            # Symmetry would drift by rounding, and doubling would amplify the drift.
            G, Q = symmetric(G), symmetric(Q)
            for table, value in zip(tables, (transition, F, G / scale, Q * scale), strict=True):
                table[level] = value
            # Two equal gaps in a row: V = (I + G Q)^-1 joins the noise of the first with the
            # information of the second. G and Q are symmetric, so that V' = (I + Q G)^-1.
            V = _invert_extended(np.eye(n) + G @ Q)
            transition, F, G, Q = (
                transition @ transition,
                F @ V.T @ F,
                G + F.T @ V @ G @ F,
                Q + F @ Q @ V @ F.T,
            )
    return tables  # type: ignore[return-value]


def _invert_extended(matrix: FloatArray) -> FloatArray:
    """Return the inverse of ``matrix`` in its precision by Newton's iteration, or nan."""
    if not np.isfinite(matrix).all():
        return np.full_like(matrix, np.nan)
    try:
        inverse = np.linalg.inv(matrix.astype(np.float64)).astype(matrix.dtype)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)
    # X <- X (2 I - M X) doubles the correct digits: twice takes double precision to extended.
    for _ in range(2):
        inverse = inverse @ (2.0 * np.eye(len(matrix)) - matrix @ inverse)
    return inverse


@kernel(allocates=True)
def substep(
    table: RiccatiTable, P: FloatArray, x: FloatArray, gap: float
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (n, n) after the Riccati flow of a ``table`` over ``gap`` seconds, at
    most one of its units, from P (n, n), and ``exp(A gap) x`` (n,).
    """
    n = table.n
    # G = 0, a Lyapunov equation: P <- e P e' + W, and no inverse is needed.
    if len(table.unobserved):
        values = polynomial(table.unobserved, gap)
        transition, noise = values[: n * n].reshape(n, n), values[n * n :].reshape(n, n)
        transition_P = matmul(transition, P)
        return symmetrize(add_matmul(noise, transition_P, transition.T)), matvec(transition, x)
    values = polynomial(table.series, gap)
    E, transition = values[: 4 * n * n].reshape(2 * n, 2 * n), values[4 * n * n :].reshape(n, n)
    # [X; Y] = E [I; P], and the new P is Y X^-1
    X = add_matmul(E[:n, :n], E[:n, n:], P)
    Y = add_matmul(E[n:, :n], E[n:, n:], P)
    # Y X^-1 by a linear solve with X'; P is symmetric, so the transpose of the result does not
    # matter.
    return symmetrize(solve(X.T, Y.T)), matvec(transition, x)


@kernel(allocates=True)
def propagate_riccati(
    table: RiccatiTable, P: FloatArray, x: FloatArray, gap: float
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (n, n) after the Riccati flow of a ``table`` over ``gap`` >= 0 seconds
    from P (n, n), and ``exp(A gap) x`` (n,): the covariance counts the readings of the gap, the
    estimate does not (``root_flow.gain_update_root`` corrects it by them).
    """
    P, x = P.copy(), x.copy()  # C-contiguous, so that one version of this code is compiled
    # One step for each binary digit 1 of the number of whole units, with its tabulated triple.
    units, level = int(gap / table.unit), 0
    while units >> level:
        if units >> level & 1:  # Q + F P (I + G P)^-1 F' over 2^level units
            F = table.F[level]
            # P (I + G P)^-1 = (I + P G)^-1 P.
            middle = solve(add_matmul(np.eye(table.n), P, table.G[level]), P)
            P = symmetrize(add_matmul(table.Q[level], matmul(F, middle), F.T))
            x = matvec(table.transition[level], x)
        level += 1
    # The rest, less than a unit, by the power series.
    rest = gap - units * table.unit
    if rest <= 0.0:
        return P, x
    return substep(table, P, x, rest)
