"""Tracks of several nodes in kernels: how their errors are correlated, and their best combination.

The covariances ``P_ij = E[e_i e_j']`` of the errors of tracks, each of which uses the readings of
its own sensors, are ``joint`` (K, n, n) for K ``pairs`` of tracks (K, 2): the common process noise
and the common start correlate them (Bar-Shalom and Campo 1986). Each is computed from itself and
the own covariances of the two tracks alone, so that its bits do not depend on which other pairs are
there; pairs of a track with itself are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel

NEGLIGIBLE = 1e-12
"""Variance of a difference of tracks, relative to those of its terms, that is rounding."""


class TrackScratch(NamedTuple):
    """Scratch for k tracks beside a node's own one.

    spread, factor : (k n, k n), covariance of their differences to it, and its factor
    cross, parts : (n, k n), covariance of the own error with both
    sizes, order : (k n,), pivots
    weights : (n, (k + 1) n), of all errors
    work : (n, n)
    """

    spread: FloatArray
    factor: FloatArray
    cross: FloatArray
    parts: FloatArray
    sizes: FloatArray
    order: np.ndarray
    weights: FloatArray
    work: FloatArray


def track_scratch(k: int, n: int) -> TrackScratch:
    """Return scratch for at most k tracks of n states."""
    K = max(k, 1) * n
    shapes = [(K, K), (K, K), (n, K), (n, K), (K,), (n, K + n), (n, n)]
    spread, factor, cross, parts, sizes, weights, work = (np.zeros(shape) for shape in shapes)
    order = np.zeros(K, dtype=np.int64)
    return TrackScratch(spread, factor, cross, parts, sizes, order, weights, work)


@kernel
def predict_joint(joint: FloatArray, F: FloatArray, Q: FloatArray, work: FloatArray) -> None:
    """Move all tracks to the next slot, ``F P_ij F' + Q``; ``work`` (n, n) is scratch."""
    for k in range(len(joint)):
        multiply_both(F, joint[k], F, work)
        for a in range(len(Q)):
            for c in range(len(Q)):
                joint[k, a, c] += Q[a, c]


@kernel(inlined=True)
def multiply_both(left: FloatArray, P: FloatArray, right: FloatArray, work: FloatArray) -> None:
    """Make P (n, n) ``left P right'``; ``work`` (n, n) is scratch."""
    n = len(P)
    for a in range(n):
        for c in range(n):
            total = 0.0
            for m in range(n):
                total += left[a, m] * P[m, c]
            work[a, c] = total
    for a in range(n):
        for c in range(n):
            total = 0.0
            for m in range(n):
                total += work[a, m] * right[c, m]
            P[a, c] = total


@kernel
def update_joint(
    joint: FloatArray,
    pairs: np.ndarray,
    H: FloatArray,
    rows: np.ndarray,
    closed: FloatArray,
    work: FloatArray,
) -> None:
    """Let each of m tracks use a reading of its own sensors, ``P_ij+ = C_i P_ij C_j'``, with
    ``C_i = I - K_i H_i`` written into ``closed`` (m, n, n).

    ``H`` (m, p, n) are whitened and have so many ``rows`` (m,); ``work`` (n, n) is scratch.
    """
    for k in range(len(joint)):
        i, j = pairs[k, 0], pairs[k, 1]
        if i == j:
            close_track(joint[k], H[i], rows[i], closed[i], work)
    for k in range(len(joint)):
        i, j = pairs[k, 0], pairs[k, 1]
        # Noises of different nodes are independent. Blind nodes close nothing.
        if i != j and rows[i] + rows[j] > 0:
            multiply_both(closed[i], joint[k], closed[j], work)


@kernel
def close_track(
    P: FloatArray, H: FloatArray, rows: int, closed: FloatArray, work: FloatArray
) -> None:
    """Update P (n, n) by a reading of whitened ``rows`` H (p, n); write ``I - K H`` into ``closed``
    (n, n).
    """
    n = len(P)
    for i in range(n):
        for j in range(n):
            closed[i, j] = 1.0 if i == j else 0.0
    for r in range(rows):
        close_row(P, H[r], closed, work[0])


@kernel
def close_row(P: FloatArray, h: FloatArray, closed: FloatArray, k: FloatArray) -> None:
    """Update P by one whitened row h (n,), and multiply ``closed`` by ``I - k h``; ``k`` (n,) is
    scratch for the gain ``P h' / (h P h' + 1)``.
    """
    n, size = len(P), 1.0
    for i in range(n):
        k[i] = 0.0
        for j in range(n):
            k[i] += P[i, j] * h[j]
        size += h[i] * k[i]
    for i in range(n):
        k[i] /= size
    # (I - k h) from the left of both.
    for j in range(n):
        Ph = known = 0.0
        for i in range(n):
            Ph += h[i] * P[i, j]
            known += h[i] * closed[i, j]
        for i in range(n):
            P[i, j] -= k[i] * Ph
            closed[i, j] -= k[i] * known
    # P (I - k h)' + k k', row by row, and the symmetric part of it.
    for i in range(n):
        Ph = -k[i]
        for j in range(n):
            Ph += P[i, j] * h[j]
        for j in range(n):
            P[i, j] -= Ph * k[j]
            if j < i:
                P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@kernel
def combine_tracks(
    joint: FloatArray, count: int, scratch: TrackScratch, gain: FloatArray, root: FloatArray
) -> int:
    """Write the gain (n, >= k n) by which the differences of ``count`` = k tracks to the own one
    correct it with the least covariance, and the lower triangular ``root`` (n, n) of that; return
    the number of differences that were used. If it is 0 all tracks are the same.

    ``joint`` (>= k + 1, >= k + 1, n, n) has the covariances of the own track, index 0, and the
    others. For one other it is ``(P_i - P_ij) (P_i + P_j - P_ij - P_ji)^-1`` of Bar-Shalom and
    Campo.
    """
    n = len(root)
    spread_tracks(joint, count, scratch)
    used = factor_differences(n, count * n, scratch)
    for q in range(count * n):
        for i in range(n):
            gain[i, q] = 0.0
    # e_i is sum_t parts_t u_t, with d = factor u: the gain solves gain factor = parts.
    for t in range(used - 1, -1, -1):
        q = scratch.order[t]
        for i in range(n):
            total = scratch.parts[i, t]
            for later in range(t + 1, used):
                index = scratch.order[later]
                total -= gain[i, index] * scratch.factor[index, t]
            gain[i, q] = total / scratch.factor[q, t]
    write_combined_root(joint, count, gain, scratch, root)
    return used


@kernel
def spread_tracks(joint: FloatArray, count: int, scratch: TrackScratch) -> None:
    """Write the covariance of the differences ``d_a = e_own - e_a`` into ``spread``, and that of
    e_own with them into ``cross``.
    """
    n = joint.shape[2]
    for a in range(count):
        for i in range(n):
            scratch.sizes[a * n + i] = joint[0, 0, i, i] + joint[1 + a, 1 + a, i, i]
            for j in range(n):
                scratch.cross[i, a * n + j] = joint[0, 0, i, j] - joint[0, 1 + a, i, j]
                for b in range(count):
                    first = joint[0, 0, i, j] - joint[0, 1 + b, i, j]
                    second = joint[1 + a, 0, i, j] - joint[1 + a, 1 + b, i, j]
                    scratch.spread[a * n + i, b * n + j] = first - second


@kernel
def factor_differences(n: int, K: int, scratch: TrackScratch) -> int:
    """Factor the covariance of the differences, ``spread`` (K, K) = factor factor', by Cholesky
    with pivoting, and return its numerical rank t.

    The differences are ``d = factor u`` with white u (t,): ``parts`` (n, t) becomes the covariance
    of the own error with u, and ``order`` (t,) the pivots. ``spread`` and ``cross`` are lost.
    """
    spread, factor = scratch.spread, scratch.factor
    for t in range(K):
        # The pivot is the largest variance relative to the terms that it is the difference of: of
        # equal tracks, such as those of two nodes without a sensor, only rounding remains.
        q = -1
        best = NEGLIGIBLE
        for index in range(K):
            if spread[index, index] > best * scratch.sizes[index]:
                q = index
                best = spread[index, index] / scratch.sizes[index]
        if q < 0:
            return t
        scratch.order[t] = q
        pivot = math.sqrt(spread[q, q])
        for index in range(K):
            factor[index, t] = spread[index, q] / pivot
        for i in range(n):
            scratch.parts[i, t] = scratch.cross[i, q] / pivot
        # The conditional covariances, given the pivot.
        for index in range(K):
            for other in range(K):
                spread[index, other] -= factor[index, t] * factor[other, t]
            for i in range(n):
                scratch.cross[i, index] -= scratch.parts[i, t] * factor[index, t]
        # Exactly 0, not rounding: a pivot is not chosen twice.
        spread[q, q] = 0.0
    return K


@kernel
def write_combined_root(
    joint: FloatArray, count: int, gain: FloatArray, scratch: TrackScratch, root: FloatArray
) -> None:
    """Write the root of the covariance of ``e_own - gain d``, as a product of errors, so that it
    stays positive semidefinite for any gain.
    """
    n, weights, P = len(root), scratch.weights, scratch.work
    for i in range(n):
        for j in range(n):
            weights[i, j], P[i, j] = 1.0 if i == j else 0.0, 0.0
            for a in range(count):
                weights[i, (a + 1) * n + j] = gain[i, a * n + j]
                weights[i, j] -= gain[i, a * n + j]
    for a in range(count + 1):
        for j in range(n):
            for i in range(n):
                # Row i of the weights times the column of error j of track a.
                total = 0.0
                for b in range(count + 1):
                    for k in range(n):
                        total += weights[i, b * n + k] * joint[b, a, k, j]
                for c in range(i + 1):
                    P[i, c] += total * weights[c, a * n + j]
    fill_cholesky(P, root)


@kernel
def fill_cholesky(P: FloatArray, root: FloatArray) -> None:
    """Write the lower triangular root (n, n) of P, of which the lower triangle is read; where P is
    singular columns of zeros.
    """
    n = len(P)
    for j in range(n):
        size = P[j, j]
        for k in range(j):
            size -= root[j, k] * root[j, k]
        # Nothing but rounding is left where P is singular.
        pivot = math.sqrt(size) if size > 0.0 else 0.0
        root[j, j] = pivot
        for i in range(j + 1, n):
            total = P[i, j]
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total / pivot if pivot > 0.0 else 0.0
            root[j, i] = 0.0
