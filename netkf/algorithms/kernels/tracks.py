"""Kernels for track fusion: the covariance of the errors of tracks, and their best combination.

A track is the estimate of a node from its own sensors. The common process noise and the common
initial error correlate the errors e_i of tracks (Bar-Shalom and Campo 1986), so that a combination
that took them as independent would claim too small a covariance. ``joint`` (K, n, n)
holds ``P_ij = E[e_i e_j']`` for K ``pairs`` (i, j) of tracks (K, 2), among them all pairs (i, i).
P_ij is computed from itself, P_ii and P_jj alone: its bits do not depend on other pairs.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.root_flow import cholesky_in_lanes
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE
from netkf.linalg.small import multiply_square
from netkf.linalg.structs import Struct

NEGLIGIBLE = 1e-12
"""Variance of a difference of two tracks, relative to the sum of both variances, at the level of
rounding.
"""


class TrackScratch(Struct):
    """Scratch for the fusion of a node's own track with k others.

    difference_cov, factor : (k n, k n), covariance of the differences d_a = e_own - e_a of errors,
                             and its factor, d = factor u
    cross_cov, white_cov : (n, k n), covariances of e_own with d and with u
    variance_scale, order : (k n,), sum of the variances of e_own and e_a for each entry of d, and
                            the order of pivots
    weights : (n, (k + 1) n), of the errors of all tracks in the error of the combination
    work : (n (n + 1) / 2,)
    """

    difference_cov: FloatArray
    factor: FloatArray
    cross_cov: FloatArray
    white_cov: FloatArray
    variance_scale: FloatArray
    order: np.ndarray
    weights: FloatArray
    work: FloatArray


def track_scratch(k: int, n: int) -> TrackScratch:
    """Return scratch for the combination of a track of n states with at most k others."""
    K = max(k, 1) * n
    shapes: dict[str, tuple[int, ...]] = {
        **dict.fromkeys(("difference_cov", "factor"), (K, K)),
        **dict.fromkeys(("cross_cov", "white_cov"), (n, K)),
        **{"variance_scale": (K,), "weights": (n, K + n), "work": (n * (n + 1) // 2,)},
    }
    arrays = {name: np.zeros(shape) for name, shape in shapes.items()}
    return TrackScratch(**arrays, order=np.zeros(K, dtype=np.int64))


@kernel
def predict_joint(joint: FloatArray, F: FloatArray, Q: FloatArray, work: FloatArray) -> None:
    """Predict the covariances ``joint`` (K, n, n) of all K pairs of tracks in place,
    ``P_ij <- F P_ij F' + Q`` with F and Q (n, n); ``work`` (n, n) is scratch.
    """
    for k in range(len(joint)):
        multiply_both(F, joint[k], F, work)
        for a in range(len(Q)):
            for c in range(len(Q)):
                joint[k, a, c] += Q[a, c]


@kernel(inlined=True)
def multiply_both(left: FloatArray, P: FloatArray, right: FloatArray, work: FloatArray) -> None:
    """Replace P by ``left P right'``, all (n, n), with the scratch ``work`` (n, n)."""
    n = len(P)
    # work = left P, complete before P changes; then P = work right'.
    multiply_square(P[0], work, left, P)
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
    """Update the covariances ``joint`` (K, n, n) of K pairs of m tracks in place, each track by a
    reading of its own sensors: ``P_ij <- C_i P_ij C_j'`` for i != j, with ``C_i = I - K_i H_i``
    written into ``closed`` (m, n, n).

    ``pairs`` (K, 2) are the indices (i, j) of both tracks. ``H`` (m, p, n) is whitened, and
    ``rows`` (m,) of its rows count; ``work`` (n, n) is scratch.
    """
    for k in range(len(joint)):
        i, j = pairs[k, 0], pairs[k, 1]
        if i == j:
            for a in range(len(work)):
                for b in range(len(work)):
                    closed[i, a, b] = 1.0 if a == b else 0.0
            for r in range(rows[i]):
                close_row(joint[k], H[i, r], closed[i], work[0])
    for k in range(len(joint)):
        i, j = pairs[k, 0], pairs[k, 1]
        # e_i <- C_i e_i - K_i v_i: noises v_i of different nodes are independent and add nothing.
        # Without rows C_i = I.
        if i != j and rows[i] + rows[j] > 0:
            multiply_both(closed[i], joint[k], closed[j], work)


@kernel
def close_row(P: FloatArray, h: FloatArray, closed: FloatArray, k: FloatArray) -> None:
    """Update P (n, n) by one whitened row h (n,), ``P <- (I - k h) P (I - k h)' + k k'`` with the
    gain ``k = P h' / (h P h' + 1)``, and multiply ``closed`` by ``I - k h`` from the left. ``k``
    (n,) is scratch.

    This is the Joseph form: a rounding error of k changes P in second order only.
    """
    n, variance = len(P), 1.0
    for i in range(n):
        k[i] = 0.0
        for j in range(n):
            k[i] += P[i, j] * h[j]
        variance += h[i] * k[i]
    for i in range(n):
        k[i] /= variance
    # (I - k h) P and (I - k h) closed.
    for j in range(n):
        h_P = h_closed = 0.0
        for i in range(n):
            h_P += h[i] * P[i, j]
            h_closed += h[i] * closed[i, j]
        for i in range(n):
            P[i, j] -= k[i] * h_P
            closed[i, j] -= k[i] * h_closed
    # P (I - k h)' + k k' row by row: subtract (P h' - k) k'. Then the symmetric part.
    for i in range(n):
        factor = -k[i]
        for j in range(n):
            factor += P[i, j] * h[j]
        for j in range(n):
            P[i, j] -= factor * k[j]
            if j < i:
                P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@kernel
def combine_tracks(
    joint: FloatArray, count: int, scratch: TrackScratch, gain: FloatArray, root: FloatArray
) -> int:
    """Write the optimal combination of a node's own track with ``count`` = k others: the ``gain``
    (n, >= k n) of their differences to the own one, and the lower triangular ``root`` (n, n) of the
    least covariance. Return the rank of the differences; 0 means that all tracks are the same.

    ``joint`` (>= k + 1, >= k + 1, n, n) holds the covariances of the own track, index 0, and the
    others. For k = 1 the gain is ``(P_i - P_ij) (P_i + P_j - P_ij - P_ji)^-1`` of Bar-Shalom and
    Campo; for any k it is E[e_own d'] E[d d']^-1.
    """
    n = len(root)
    fill_difference_covariances(joint, count, scratch)
    rank = factor_differences(n, count * n, scratch)
    for q in range(count * n):
        for i in range(n):
            gain[i, q] = 0.0
    # With d = factor u and white u the gain solves gain factor = E[e_own u'] = white_cov, by back
    # substitution over the pivots.
    for t in range(rank - 1, -1, -1):
        q = scratch.order[t]
        for i in range(n):
            total = scratch.white_cov[i, t]
            for later in range(t + 1, rank):
                index = scratch.order[later]
                total -= gain[i, index] * scratch.factor[index, t]
            gain[i, q] = total / scratch.factor[q, t]
    write_combined_root(joint, count, gain, scratch, root)
    return rank


@kernel
def fill_difference_covariances(joint: FloatArray, count: int, scratch: TrackScratch) -> None:
    """Write into ``scratch`` the covariances of the differences ``d_a = e_own - e_a`` between the
    errors of a node's own track and of ``count`` = k others: E[d d'] into ``difference_cov`` (k n,
    k n), E[e_own d'] into ``cross_cov`` (n, k n), and the sum of both variances of each entry into
    ``variance_scale`` (k n,).

    ``joint`` (>= k + 1, >= k + 1, n, n) holds the covariances of the tracks, the own one first.
    """
    n = joint.shape[2]
    for a in range(count):
        for i in range(n):
            scratch.variance_scale[a * n + i] = joint[0, 0, i, i] + joint[1 + a, 1 + a, i, i]
            for j in range(n):
                scratch.cross_cov[i, a * n + j] = joint[0, 0, i, j] - joint[0, 1 + a, i, j]
                # E[d_a d_b'] = E[e_own d_b'] - E[e_a d_b'].
                for b in range(count):
                    first = joint[0, 0, i, j] - joint[0, 1 + b, i, j]
                    second = joint[1 + a, 0, i, j] - joint[1 + a, 1 + b, i, j]
                    scratch.difference_cov[a * n + i, b * n + j] = first - second


@kernel
def factor_differences(n: int, K: int, scratch: TrackScratch) -> int:
    """Factor ``scratch.difference_cov`` (K, K) = factor factor' by Cholesky with pivoting, for the
    K entries of the differences of all tracks; return its numerical rank t.

    The differences are ``d = factor u`` with white u (t,). Fills in ``scratch`` the ``factor``
    (K, t), ``white_cov`` (n, t) = E[e_own u'] for ``n`` states, and ``order`` (t,), the index of
    each pivot. ``difference_cov`` and ``cross_cov`` are overwritten.
    """
    difference_cov, factor = scratch.difference_cov, scratch.factor
    for t in range(K):
        # The pivot is the difference with the largest variance, relative to the variances of its
        # two tracks. For equal tracks, such as those of two nodes without a sensor, only rounding
        # remains: these are left out.
        q = -1
        largest = NEGLIGIBLE
        for index in range(K):
            if difference_cov[index, index] > largest * scratch.variance_scale[index]:
                q = index
                largest = difference_cov[index, index] / scratch.variance_scale[index]
        if q < 0:
            return t
        scratch.order[t] = q
        pivot = math.sqrt(difference_cov[q, q])
        for index in range(K):
            factor[index, t] = difference_cov[index, q] / pivot
        for i in range(n):
            scratch.white_cov[i, t] = scratch.cross_cov[i, q] / pivot
        # Covariances of what remains given the pivot: subtract the outer products.
        for index in range(K):
            for other in range(K):
                difference_cov[index, other] -= factor[index, t] * factor[other, t]
            for i in range(n):
                scratch.cross_cov[i, index] -= scratch.white_cov[i, t] * factor[index, t]
        # Exactly 0, not rounding: a pivot is not chosen twice.
        difference_cov[q, q] = 0.0
    return K


@kernel
def write_combined_root(
    joint: FloatArray, count: int, gain: FloatArray, scratch: TrackScratch, root: FloatArray
) -> None:
    """Write the lower triangular ``root`` (n, n) of cov(e_own - gain d) = W joint W', for the
    ``gain`` (n, >= k n) of the differences d to ``count`` = k other tracks, with the weights W of
    all errors. In this form it is positive semidefinite for any gain, rounding included.

    ``joint`` (>= k + 1, >= k + 1, n, n) holds the covariances of the tracks, the own one first;
    ``scratch.weights`` and ``scratch.work`` are overwritten.
    """
    n, weights, P = len(root), scratch.weights, scratch.work
    for i in range(n):
        for j in range(n):
            weights[i, j] = 1.0 if i == j else 0.0
            for a in range(count):
                weights[i, (a + 1) * n + j] = gain[i, a * n + j]
                weights[i, j] -= gain[i, a * n + j]
    for c in range(len(P)):
        P[c] = 0.0
    for a in range(count + 1):
        for j in range(n):
            for i in range(n):
                # (W joint) for row i and error j of track a; then times W', into the lower
                # triangle by rows.
                total = 0.0
                for b in range(count + 1):
                    for k in range(n):
                        total += weights[i, b * n + k] * joint[b, a, k, j]
                for c in range(i + 1):
                    P[i * (i + 1) // 2 + c] += total * weights[c, a * n + j]
    cholesky_in_lanes(ONE, P[:n], root, P)
