"""The flow of the Riccati equation dP = A P + P A' + Q - P G P over gaps of any length.

P is the covariance of a Kalman-Bucy filter between messages, for a plant ``dx = A x dt + noise`` of
covariance Q per second and sensors that give the information ``G = H' R^-1 H`` per second. The
theory of paper H (Tanwani 2021) uses these covariances; filters carry roots of P.

The flow is the linear-fractional action of ``exp(M gap)`` with the Hamiltonian ``M = [[-A', G], [Q,
A]]``: if ``[X; Y] = exp(M gap) [I; P]`` then ``P(gap) = Y X^-1``. One exponential over a long gap
loses every digit. So a gap is halved until ``|M| gap <= 1``, and the flow over it is the triple
``(F, G, Q)`` with ``P -> Q + F P (I + G P)^-1 F'``, which is doubled by formulas that only add
positive terms (Davison and Maki 1973; Anderson 1978).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, symmetric
from netkf.linalg.spectra import balance, balanced_norm

WIDE = np.longdouble  # extended precision where the machine has it
WIDE_TERMS = 27  # of an exponential in it, for a norm of at most 1


GROWTH, MAX_PARTS = 4.0, 4096
"""A plant grows by at most e^GROWTH in a part of a gap, of which there are at most so many: G of
what no noise drives grows by the square of that, and swallows the digits of other modes.
"""


class RiccatiFlow(NamedTuple):
    """The flow over one gap, in extended precision: so many ``parts`` of it, each with matrices
    (n, n) of ``P -> Q + F P (I + G P)^-1 F'``.
    """

    parts: int
    F: FloatArray
    G: FloatArray
    Q: FloatArray


def exponential_series(M: FloatArray, terms: int) -> FloatArray:
    """Return the series (terms, n, n) with ``exp(M g) = sum_k g^k series[k]``, as precise as M."""
    series = np.empty((terms, *M.shape), dtype=M.dtype)
    series[0] = np.eye(len(M))
    for k in range(1, terms):
        # (M g)^k / k! from the term before it.
        series[k] = series[k - 1] @ M / k
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


def state_units(A: FloatArray, Q: FloatArray, G: FloatArray) -> FloatArray:
    """Return units (n,) of the components of the state, powers of 2, in which the entries of the
    Hamiltonian of A, Q and G (n, n) are of about the same size.
    """
    n = len(A)
    scale = balance(hamiltonian(A, Q, G)[0])[1]
    # Rows of P, and of its inverse above them, take units that are each other's inverse. Products
    # of two stay in the range of numbers.
    powers = 0.5 * (np.log2(scale[n:]) - np.log2(scale[:n]))
    return np.asarray(2.0 ** np.clip(np.round(powers), -240, 240))


def change_units(
    units: FloatArray, A: FloatArray, Q: FloatArray, H: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A and Q (n, n) and H (p, n) for a state in other ``units`` (n,)."""
    return A * units / units[:, None], Q / (units * units[:, None]), H * units


def flow_covariance(A: FloatArray, Q: FloatArray, G: FloatArray, gap: float) -> RiccatiFlow:
    """Return the flow of ``dP = A P + P A' + Q - P G P`` over ``gap`` >= 0 seconds; ``A, Q, G`` are
    (n, n). Entries are nan or infinite where an unstable plant overflows.
    """
    growth = float(np.linalg.eigvals(A).real.max()) * gap
    parts = int(min(max(math.ceil(growth / GROWTH), 1), MAX_PARTS))
    gap = gap / parts
    M, scale = hamiltonian(A, Q, G)
    norm = balanced_norm(M)
    # By powers of two, so that halving is exact. Doubling also doubles the relative error: after
    # 2^14 parts a triple in double precision would have lost 1e-12.
    doublings = max(0, math.frexp(norm * gap)[1])
    F, G, Q = flow_triple(wide_exponential(M, gap / 2.0**doublings))
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(doublings):
            # Symmetry would drift by rounding, and doubling would amplify the drift.
            G, Q = symmetric(G), symmetric(Q)
            # Two equal gaps in a row: V = (I + G Q)^-1 joins the noise of the first with the
            # information of the second. G and Q are symmetric, so that V' = (I + Q G)^-1.
            V = wide_inverse(np.eye(len(A)) + G @ Q)
            F, G, Q = F @ V.T @ F, G + F.T @ V @ G @ F, Q + F @ Q @ V @ F.T
    # Undo the scaling of hamiltonian().
    return RiccatiFlow(parts, F, G / scale, Q * scale)


def move_covariances(flow: RiccatiFlow, P: FloatArray) -> FloatArray:
    """Return the covariances (..., n, n) at the end of the gap of a ``flow`` that begins at P."""
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(flow.parts):
            # P (I + G P)^-1 = (I + P G)^-1 P
            middle = wide_inverse(np.eye(len(flow.G)) + P @ flow.G) @ P
            P = symmetric(flow.Q + flow.F @ middle @ flow.F.T).astype(np.float64)
            if not np.isfinite(P).all():
                break
        return P


def wide_exponential(M: FloatArray, gap: float) -> FloatArray:
    """Return exp(M gap) (n, n) in extended precision, for ``|M| gap`` of at most 1, M (n, n)."""
    series = exponential_series(M.astype(WIDE), WIDE_TERMS)
    return np.asarray(np.tensordot(WIDE(gap) ** np.arange(WIDE_TERMS), series, 1))


def flow_triple(E: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return F, G and Q (n, n) of the flow over a gap, from E = exp(M gap) (2 n, 2 n) with the
    Hamiltonian M: ``F = E11^-T``, ``G = E11^-1 E12`` and ``Q = E21 E11^-1``.
    """
    n = len(E) // 2
    inverse = wide_inverse(E[:n, :n])
    return inverse.T, inverse @ E[:n, n:], E[n:, :n] @ inverse


def wide_inverse(matrices: FloatArray) -> FloatArray:
    """Return the inverses (..., n, n) of ``matrices`` (..., n, n) in their precision, by Newton's
    iteration from double precision; nan where one is singular or not finite.
    """
    try:
        inverse = np.linalg.inv(matrices.astype(np.float64)).astype(matrices.dtype)
    except np.linalg.LinAlgError:
        return np.full_like(matrices, np.nan)
    # X <- X (2 I - M X) doubles the correct digits: twice takes double precision to extended.
    for _ in range(2):
        inverse = inverse @ (2.0 * np.eye(matrices.shape[-1]) - matrices @ inverse)
    return np.asarray(inverse)
