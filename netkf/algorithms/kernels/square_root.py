"""Covariance recursions in square-root form, which survive covariances of 1e14 and far beyond.

For ``P = S S'`` one orthogonal triangularisation of ``[[H S, root(R), 0], [F S, 0, root(Q)]]``
gives the innovation's root, the gain and the root of the next covariance: nothing is subtracted, so
nothing cancels after an outage, where covariance forms lose eps * P (Kailath, Sayed and Hassibi,
Linear Estimation, section 12.3).

numpy works on stacks of them, and a compiler on one after the other: each stands here twice.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import compilable, compilable_as
from netkf.linalg.small import product, solution


@compilable
def reflect(work: FloatArray, i: int, rows: int, columns: int) -> None:
    """Householder's reflection of the first ``columns`` that leaves row ``i`` nothing right of its
    diagonal, in place, for the rows from ``i`` up to ``rows``. What is right of the diagonal in row
    ``i`` itself is rubbish then, to be taken for zeros.
    """
    size = 0.0
    for j in range(i, columns):
        size += work[i, j] * work[i, j]
    if size == 0.0:
        return
    pivot = -math.copysign(math.sqrt(size), work[i, i])
    scale = size - work[i, i] * pivot
    work[i, i] -= pivot
    for r in range(i + 1, rows):
        total = 0.0
        for j in range(i, columns):
            total += work[i, j] * work[r, j]
        total /= scale
        for j in range(i, columns):
            work[r, j] -= total * work[i, j]
    work[i, i] = pivot


def _triangular_loops(array: FloatArray) -> FloatArray:
    work = array.copy()
    rows, columns = work.shape
    for i in range(rows):
        reflect(work, i, rows, columns)
        for j in range(i + 1, rows):
            work[i, j] = 0.0
    return work[:, :rows].copy()


@compilable_as(_triangular_loops)
def lower_triangular(array: FloatArray) -> FloatArray:
    """L (..., r, r), lower triangular with ``L L' = array array'`` for stacks of (r, c), c >= r."""
    return np.asarray(np.swapaxes(np.linalg.qr(np.swapaxes(array, -1, -2), mode="r"), -1, -2))


def _predict_loops(S: FloatArray, F: FloatArray, root_Q: FloatArray) -> FloatArray:
    n = len(F)
    work = np.empty((n, 2 * n))
    work[:, :n] = product(F, S)
    work[:, n:] = root_Q
    return lower_triangular(work)


@compilable_as(_predict_loops)
def predict_root(S: FloatArray, F: FloatArray, root_Q: FloatArray) -> FloatArray:
    """Root of ``F P F' + Q`` (..., n, n)."""
    moved = F @ S
    noise = np.broadcast_to(root_Q, moved.shape[:-2] + root_Q.shape)
    return lower_triangular(np.concatenate([moved, noise], axis=-1))


def _update_loops(
    S: FloatArray, F: FloatArray, root_Q: FloatArray, H: FloatArray, root_R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    p, n = H.shape
    work = np.zeros((p + n, 2 * n + p))
    work[:p, :n], work[:p, n : n + p] = product(H, S), root_R
    work[p:, :n], work[p:, n + p :] = product(F, S), root_Q
    L = lower_triangular(work)
    gain = solution(L[:p, :p].T, L[p:, :p].T).T
    return L[p:, p:].copy(), gain.copy()


@compilable_as(_update_loops)
def update_root(
    S: FloatArray, F: FloatArray, root_Q: FloatArray, H: FloatArray, root_R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Roots and gains of a measurement update followed by a prediction, for a stack of S.

    Returns the root of ``f_1(P) = F P F' + Q - F P H' (H P H' + R)^-1 H P F'`` (..., n, n) and the
    predictor's gain ``F P H' (H P H' + R)^-1`` (..., n, p), R (15)-(18).
    """
    p, n = H.shape
    seen, moved = H @ S, F @ S
    lead = moved.shape[:-2]
    # Large columns first: Householder's reflections then keep the small ones to full precision.
    noise_R, noise_Q = (
        np.broadcast_to(root_R, (*lead, p, p)),
        np.broadcast_to(root_Q, (*lead, n, n)),
    )
    top = np.concatenate([seen, noise_R, np.zeros((*lead, p, n))], axis=-1)
    bottom = np.concatenate([moved, np.zeros((*lead, n, p)), noise_Q], axis=-1)
    L = lower_triangular(np.concatenate([top, bottom], axis=-2))
    innovation, cross, root = L[..., :p, :p], L[..., p:, :p], L[..., p:, p:]
    gain = np.linalg.solve(np.swapaxes(innovation, -1, -2), np.swapaxes(cross, -1, -2))
    return root, np.swapaxes(gain, -1, -2)
