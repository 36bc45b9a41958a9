"""Covariance recursions in square-root form, which survive covariances of 1e14 and far beyond.

For ``P = S S'`` one orthogonal triangularisation of ``[[H S, root(R), 0], [F S, 0, root(Q)]]``
gives the innovation's root, the gain and the root of the next covariance: nothing is subtracted, so
nothing cancels after an outage, where covariance forms lose eps * P (Kailath, Sayed and Hassibi,
Linear Estimation, section 12.3).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, magnitude, root_of, select, store
from netkf.linalg.structs import Size


def lower_triangular(array: FloatArray) -> FloatArray:
    """Return L (..., r, r), lower triangular with ``L L' = array array'`` (..., r, c), c >= r."""
    return np.asarray(np.swapaxes(np.linalg.qr(np.swapaxes(array, -1, -2), mode="r"), -1, -2))


@kernel
def reflect(work: FloatArray, i: int, rows: int, columns: int) -> None:
    """Apply Householder's reflection of the first ``columns`` that leaves row ``i`` nothing right
    of its diagonal, in place, for the rows from ``i`` up to ``rows``. What is right of the diagonal
    in row ``i`` itself is rubbish then, to be taken for zeros.
    """
    size = 0.0
    for j in range(i, columns):
        size += work[i, j] * work[i, j]
    # A zero row is triangular already.
    if size == 0.0:
        return
    # The sign opposite to the pivot's, so that the difference below does not cancel.
    pivot = -math.copysign(math.sqrt(size), work[i, i])
    # Half the squared length of the reflection's vector: v v' / scale is its projector times two.
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


@kernel(inlined=True, fused=True)
def reflect_row(
    lanes: Lanes,
    size: Size,
    i: int,
    end: int,
    wide: FloatArray,
    T: FloatArray,
    square: Any,
    active: Any,
) -> None:
    """Apply the reflection from the right that leaves row ``i`` of [wide, T] its diagonal alone, to
    the rows from ``i`` on, in the lanes that are ``active``; row ``i`` has the length squared
    ``square``, and in ``wide`` entries from column ``i`` up to ``end``; T is lower triangular, and
    both are (n, n, L). Entry (i, i) becomes nonnegative.
    """
    n, pivot = len(size), load(lanes, wide, i, i)
    length = root_of(select(active, square, 1.0))
    # The sign that does not cancel in pivot + signed; the column is flipped so that its diagonal is
    # nonnegative.
    signed = select(pivot >= 0.0, length, -length)
    head = magnitude(pivot + signed)
    scale = select(active, 1.0 / (length * head), 0.0)
    inverse = scale * head
    store(lanes, wide, i, i, select(active, length, pivot))
    for r in range(i + 1, n):
        first = load(lanes, wide, r, i)
        inner = pivot * first
        for j in range(i + 1, end):
            inner += load(lanes, wide, i, j) * load(lanes, wide, r, j)
        for j in range(i + 1):
            inner += load(lanes, T, i, j) * load(lanes, T, r, j)
        share = (inner + signed * first) * scale
        # The part of row r along row i: the reflection turns row i into its length.
        store(lanes, wide, r, i, select(active, inner * inverse, first))
        for j in range(i + 1, end):
            store(lanes, wide, r, j, load(lanes, wide, r, j) - share * load(lanes, wide, i, j))
        for j in range(i + 1):
            store(lanes, T, r, j, load(lanes, T, r, j) - share * load(lanes, T, i, j))


@kernel
def step_root(
    roots: FloatArray,
    chain: int,
    m: int,
    F: FloatArray,
    root_Q: FloatArray,
    H: FloatArray,
    root_R: FloatArray,
    rows: np.ndarray,
    work: FloatArray,
) -> None:
    """Move one root by ``f_m``: update with reading ``m`` and predict."""
    n, p = len(F), rows[m]
    # [[H S, root_R, 0], [F S, 0, root_Q]]
    for i in range(p + n):
        for j in range(n):
            total = 0.0
            for k in range(j, n):
                total += (H[m, i, k] if i < p else F[i - p, k]) * roots[chain, k, j]
            work[i, j] = total
        for j in range(p):
            work[i, n + j] = root_R[m, i, j] if i < p else 0.0
        for j in range(n):
            work[i, n + p + j] = root_Q[i - p, j] if i >= p else 0.0
    # Householder's reflections of the columns make it lower triangular, row by row; right of the
    # end there are zeros, because root_Q is lower triangular.
    for i in range(p + n):
        reflect(work, i, p + n, n + p + max(0, i - p + 1))
    # The post-array is [[C, 0], [K C, S+]]: its lower right block is the root of f_m(P).
    for i in range(n):
        for j in range(i + 1):
            roots[chain, i, j] = work[p + i, p + j]
