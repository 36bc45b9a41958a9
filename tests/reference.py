"""Textbook formulas, plain and slow, that kernels are tested against.

Arrays may hold doubles or decimals (dtype object, see ``exactly``); the formulas are the same, and
what they round does not matter in ``precisely()``: 200 digits, because a plant that grows by 1e43
over a gap costs 87 of them.
"""

import math
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


def exponential(M, terms=84):
    """exp(M) where no column of M sums to more than 2^-4 in size: the power series, six terms at a
    time, which takes 19 products instead of 84.
    """
    powers = [identity(len(M), M), M]
    for _ in range(5):
        powers.append(powers[-1] @ M)
    total, one = 0 * M, powers[0].flat[0]
    for first in range(terms - 6, -1, -6):
        some = sum(powers[k] * (one / math.factorial(first + k)) for k in range(6))
        total = some + powers[6] @ total
    return total


def flow_triple(A, Q, G, gap):
    """exp(A g), F, G_g and Q_g with ``P(g) = Q_g + F P (I + G_g P)^-1 F'``, by the Hamiltonian over
    a small share of the gap and by doubling (Anderson 1978).
    """
    n, halves = len(A), 0
    M = np.concatenate([np.concatenate([-A.T, G], axis=1), np.concatenate([Q, A], axis=1)])
    size = float(max(abs(M).sum(axis=0))) * gap
    while size > 2.0**-4:
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


# Filters of the literature, one slot of all nodes: lists of x and P by node, predicted;
# ``readings`` are (y, H, R) by node; ``heard[step]`` (N, N) is 1 where the message of node j
# reached node i.


def kalman_update(x, P, y, H, R):
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + gain @ (y - H @ x), P - gain @ H @ P


def _consensus(values, weights, heard):
    """Steps of ``v_i + sum_j w_ij (v_j - v_i)`` over those heard."""
    for step in heard:
        values = [
            v + sum(weights[i, j] * step[i, j] * (u - v) for j, u in enumerate(values))
            for i, v in enumerate(values)
        ]
    return values


def _information(readings, n):
    """H' R^-1 H and H' R^-1 y of each node, zeros without a reading."""
    found = {
        i: (H.T @ np.linalg.solve(R, H), H.T @ np.linalg.solve(R, y))
        for i, (y, H, R) in readings.items()
    }
    return lambda i: found.get(i, (np.zeros((n, n)), np.zeros(n)))


def hcmci(x, P, readings, weights, heard, consensus, omega):
    """Battistelli, Chisci, Mugnai, Farina and Graziano 2015; CM and CI are the special cases."""
    n, N = len(x[0]), len(x)
    news = _information(readings, n)
    prior = [np.linalg.inv(P[i]) for i in range(N)], [np.linalg.solve(P[i], x[i]) for i in range(N)]
    novel = [news(i)[0] for i in range(N)], [news(i)[1] for i in range(N)]
    if consensus == "information":
        prior = tuple(
            [a + b for a, b in zip(*both, strict=True)] for both in zip(prior, novel, strict=True)
        )
        novel, omega = prior, 0.0
    if consensus != "measurements":
        prior = tuple(_consensus(values, weights, heard) for values in prior)
    novel = tuple(_consensus(values, weights, heard) for values in novel)
    Omega, q = (
        [a + omega * b for a, b in zip(*both, strict=True)]
        for both in zip(prior, novel, strict=True)
    )
    cov = [np.linalg.inv(one) for one in Omega]
    return [C @ one for C, one in zip(cov, q, strict=True)], cov


def icf(x, P, readings, weights, heard):
    """Kamal, Farrell and Roy-Chowdhury 2013, Algorithm 2."""
    n, N = len(x[0]), len(x)
    news = _information(readings, n)
    V = [np.linalg.inv(P[i]) / N + news(i)[0] for i in range(N)]
    v = [np.linalg.solve(P[i], x[i]) / N + news(i)[1] for i in range(N)]
    V, v = (_consensus(values, weights, heard) for values in (V, v))
    return [np.linalg.solve(*one) for one in zip(V, v, strict=True)], [
        np.linalg.inv(N * one) for one in V
    ]


def kcf(x, P, readings, heard, epsilon, share=True):
    """Olfati-Saber 2009, Algorithm 1; without sharing S and y are the node's own."""
    n, N = len(x[0]), len(x)
    news, found = _information(readings, n), []
    for i in range(N):
        around = [j for j in range(N) if heard[0][i, j]]
        used = [i, *around] if share else [i]
        S, y = sum(news(j)[0] for j in used), sum(news(j)[1] for j in used)
        M = np.linalg.inv(np.linalg.inv(P[i]) + S)
        gamma = epsilon / (np.sqrt(np.trace(P[i].T @ P[i])) + 1.0)
        pull = sum((x[j] - x[i] for j in around), np.zeros(n))
        found.append((x[i] + M @ (y - S @ x[i]) + gamma * P[i] @ pull, M))
    return [one for one, _ in found], [M for _, M in found]


def diffusion_kalman(x, P, readings, weights, heard):
    """Cattivelli and Sayed 2010, Algorithm 1; ``heard`` is of the readings and of the estimates."""
    psi, cov = [], []
    for i in range(len(x)):
        one, C = x[i], P[i]
        for j in sorted(readings):
            if j == i or heard[0][i, j]:
                one, C = kalman_update(one, C, *readings[j])
        psi.append(one)
        cov.append(C)
    return _consensus(psi, weights, heard[1:]), cov
