"""Textbook formulas, plain and slow, that kernels are tested against.

Arrays may hold doubles or decimals (dtype object, see ``exactly``); the formulas are the same, and
what they round does not matter in ``precisely()``: 200 digits, because a plant that grows by 1e43
over a gap costs 87 of them.
"""

from decimal import Decimal, localcontext

import numpy as np

DIGITS = 200


def precisely():
    """The context in which decimals keep DIGITS digits."""
    return localcontext(prec=DIGITS)


def exactly(*arrays):
    """The same numbers as decimals."""
    made = tuple(_decimals(np.asarray(array, dtype=np.float64)) for array in arrays)
    return made if len(made) > 1 else made[0]


def _decimals(array):
    out = np.empty(array.shape, dtype=object)
    for place, value in np.ndenumerate(array):
        out[place] = Decimal(float(value))
    return out


def rounded(array):
    """Doubles again."""
    return np.asarray(array, dtype=np.float64)


def identity(n, like):
    """The unit matrix, of numbers as in ``like``."""
    return np.eye(n, dtype=int) + 0 * like.flat[0]


def solve(left, right):
    """``left^-1 right`` by Gauss with the largest pivot of each column."""
    left, right, n = left.copy(), right.copy(), len(left)
    for k in range(n):
        best = max(range(k, n), key=lambda i: abs(left[i, k]))
        left[[k, best]], right[[k, best]] = left[[best, k]], right[[best, k]]
        for i in range(k + 1, n):
            factor = left[i, k] / left[k, k]
            left[i, k:] = left[i, k:] - factor * left[k, k:]
            right[i] = right[i] - factor * right[k]
    for i in range(n - 1, -1, -1):
        right[i] = (right[i] - left[i, i + 1 :] @ right[i + 1 :]) / left[i, i]
    return right


def exponential(M, terms=36):
    """exp(M) where no column of M sums to more than 2^-16 in size."""
    total = term = identity(len(M), M)
    for k in range(1, terms):
        term = term @ M / k
        total = total + term
    return total


def flow_triple(A, Q, G, gap):
    """exp(A g), F, G_g and Q_g with ``P(g) = Q_g + F P (I + G_g P)^-1 F'``, by the Hamiltonian over
    a small share of the gap and by doubling (Anderson 1978).
    """
    n, halves = len(A), 0
    M = np.concatenate([np.concatenate([-A.T, G], axis=1), np.concatenate([Q, A], axis=1)])
    size = float(max(abs(M).sum(axis=0))) * gap
    while size > 2.0**-16:
        size, halves = 0.5 * size, halves + 1
    step = (Decimal(gap) if A.dtype == object else gap) / 2**halves
    H, E, eye = exponential(M * step), exponential(A * step), identity(n, A)
    inverse = solve(H[:n, :n], eye)
    F, G, Q = inverse.T, inverse @ H[:n, n:], H[n:, :n] @ inverse
    for _ in range(halves):
        W = solve(eye + G @ Q, eye)
        E, F, G, Q = E @ E, F @ W.T @ F, G + F.T @ W @ G @ F, Q + F @ Q @ W @ F.T
    return E, F, G, Q


def flow(P, x, triple):
    """P and x moved by the Riccati equation and by exp(A g)."""
    E, F, G, Q = triple
    moved = Q + F @ solve(identity(len(P), P) + P @ G, P) @ F.T
    return (moved + moved.T) / 2, E @ x


def sample_update(P, x, y, H, R):
    """P and x once ``y = H x + v`` is used."""
    cross = P @ H.T
    gain = solve(H @ cross + R, cross.T).T
    updated = P - gain @ cross.T
    return (updated + updated.T) / 2, x + gain @ (y - H @ x)


def convex(weights, means, covariances):
    """``sum w_j P_j`` and ``sum w_j x_j``."""
    P = sum(w * cov for w, cov in zip(weights, covariances, strict=True))
    return P, sum(w * mean for w, mean in zip(weights, means, strict=True))


def intersection(weights, means, covariances):
    """``P^-1 = sum w_j P_j^-1`` and ``x = P sum w_j P_j^-1 x_j``."""
    eye = identity(len(means[0]), covariances[0])
    inverses = [w * solve(cov, eye) for w, cov in zip(weights, covariances, strict=True)]
    P = solve(sum(inverses), eye)
    return P, P @ sum(inv @ mean for inv, mean in zip(inverses, means, strict=True))


def polynomial(series, gap):
    """``sum_k gap^k series[k]``."""
    return sum(row * gap**k for k, row in enumerate(series))


def triangular_root(array):
    """L, lower triangular with a diagonal that is not negative, and ``L L' = array array'``."""
    L = np.linalg.qr(array.T, mode="r").T
    return L * np.where(np.diag(L) < 0.0, -1.0, 1.0)


def switched_riccati(P, modes, F, Q, readings):
    """P after the slots of ``modes``: which reading (H, R) each has, H of no rows for none."""
    for m in modes:
        H, R = readings[m]
        moved = F @ P @ F.T + Q
        if len(H):
            cross = F @ P @ H.T
            moved = moved - cross @ solve(H @ P @ H.T + R, cross.T)
        P = (moved + moved.T) / 2
    return P


def moments_update(P, x, moments, U, W, C):
    """The estimate once the moments of a reading are used, with gains ``U + P W``."""
    return x + (U + P @ W) @ (moments - C @ x)
