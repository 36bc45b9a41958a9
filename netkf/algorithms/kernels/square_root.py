"""Lower triangular roots S of covariances ``P = S S'``: nothing is subtracted, so that nothing
cancels after an outage, where covariance forms lose eps * P (Kailath, Sayed and Hassibi, Linear
Estimation, section 12.3). ``reflect`` and ``reflect_row`` are Householder reflections of columns,
that is from the right, which leave [A, B] [A, B]' as it is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, magnitude, root_of, select, spread, store
from netkf.linalg.structs import Size

NEGLIGIBLE = 1e-40  # share of a squared pivot that changes neither it nor the rows below it
TINY = 1e-300  # below any squared length of a row that counts, yet above underflow


def lower_triangular(array: FloatArray) -> FloatArray:
    """Return lower triangular L (..., r, r), ``L L' = array array'``, of matrices (r, c >= r)."""
    return np.asarray(np.swapaxes(np.linalg.qr(np.swapaxes(array, -1, -2), mode="r"), -1, -2))


def lower_root(root: FloatArray) -> FloatArray:
    """Return lower triangular S (n, n), diagonal >= 0, with ``S S' = root root'`` of (n, c)."""
    n, columns = root.shape
    # QR of the transpose needs at least as many columns as rows.
    wide = np.concatenate([root, np.zeros((n, max(n - columns, 0)))], axis=1)
    L = np.tril(lower_triangular(wide))
    # Column signs are free in S S'; a nonnegative diagonal makes the root unique.
    return np.asarray(L * np.where(np.diag(L) < 0.0, -1.0, 1.0))


@kernel
def reflect(work: FloatArray, i: int, c: int, rows: int, columns: int) -> None:
    """Apply, from the right and in place, the Householder reflection of the columns ``c`` to
    ``columns`` - 1 of ``work`` (>= rows, >= columns) that zeroes row ``i`` right of column ``c``,
    to the rows ``i`` to ``rows`` - 1. In row ``i`` read the entries right of that column as zeros.
    """
    square = 0.0
    for j in range(c, columns):
        square += work[i, j] * work[i, j]
    # A zero row is triangular already.
    if square == 0.0:
        return
    # The sign opposite to the pivot's, so that the difference below does not cancel.
    pivot = -math.copysign(math.sqrt(square), work[i, c])
    # With v = row i - pivot e_c, scale = v'v / 2 and the reflection is I - v v' / scale.
    scale = square - work[i, c] * pivot
    work[i, c] -= pivot
    for r in range(i + 1, rows):
        total = 0.0
        for j in range(c, columns):
            total += work[i, j] * work[r, j]
        total /= scale
        for j in range(c, columns):
            work[r, j] -= total * work[i, j]
    work[i, c] = pivot


@kernel(inlined=True, fused=True)
def reflect_row(
    lanes: Lanes, size: Size, i: int, end: int, W: FloatArray, T: FloatArray, square: Any, on: Any
) -> None:
    """Apply the Householder reflection from the right that zeroes row ``i`` of [W, T] except its
    diagonal entry, which becomes nonnegative, to the rows from ``i`` on, in place, in the lanes
    that are ``on`` (flags (L,) of runs side by side).

    W and T are (n, n, L), T lower triangular. Row ``i`` has the squared length ``square`` (L,);
    in ``W`` its entries are in columns ``i`` to ``end`` - 1, right of its diagonal as they were.
    """
    # With v = row i + signed e_i the reflection is I - v v' / (length head).
    n, pivot = len(size), load(lanes, W, i, i)
    length = root_of(select(on, square, 1.0))
    # The sign that does not cancel in pivot + signed; the column is flipped so that its diagonal is
    # nonnegative.
    signed = select(pivot >= 0.0, length, -length)
    head = magnitude(pivot + signed)
    scale = select(on, 1.0 / (length * head), 0.0)  # 2 / v' v
    inverse = scale * head  # 1 / length
    store(lanes, W, i, i, select(on, length, pivot))
    for r in range(i + 1, n):
        first = load(lanes, W, r, i)
        # Two sums, neither of which waits for the other.
        inner, of_noise = pivot * first, spread(lanes, 0.0)
        for j in range(i + 1, end):
            inner += load(lanes, W, i, j) * load(lanes, W, r, j)
        for j in range(i + 1):
            of_noise += load(lanes, T, i, j) * load(lanes, T, r, j)
        inner += of_noise
        share = (inner + signed * first) * scale  # v' (row r) 2 / v' v
        # Entry (r, i) is the part of row r along row i: row i becomes (length, 0, ..., 0), and the
        # product of both rows is kept.
        store(lanes, W, r, i, select(on, inner * inverse, first))
        for j in range(i + 1, end):
            store(lanes, W, r, j, load(lanes, W, r, j) - share * load(lanes, W, i, j))
        for j in range(i + 1):
            store(lanes, T, r, j, load(lanes, T, r, j) - share * load(lanes, T, i, j))


@kernel(inlined=True, fused=True)
def triangularise(lanes: Lanes, size: Size, S: FloatArray, wide: FloatArray, T: FloatArray) -> None:
    """Write the lower triangular root, with a nonnegative diagonal, of ``[wide, T] [wide, T]'``
    into S, (n, n, L) each; T is lower triangular, and both are overwritten.
    """
    n = len(size)
    for i in range(n):
        # Two sums, neither of which waits for the other.
        square = of_noise = spread(lanes, 0.0)
        for j in range(i, n):
            square += load(lanes, wide, i, j) * load(lanes, wide, i, j)
        # T is lower triangular: its columns beyond i are 0 in row i.
        for j in range(i + 1):
            of_noise += load(lanes, T, i, j) * load(lanes, T, i, j)
        square += of_noise
        # A zero row needs no reflection.
        reflect_row(lanes, size, i, n, wide, T, square, square > TINY)
        for j in range(i + 1):
            store(lanes, S, i, j, load(lanes, wide, i, j))


@kernel(inlined=True, fused=True)
def absorb_columns(lanes: Lanes, size: Size, S: FloatArray, wide: FloatArray) -> None:
    """Replace S (n, n, L) by the lower triangular root of ``S S' + wide wide'`` in each of L lanes
    (runs side by side); both are lower triangular, and ``wide`` (n, n, L) is overwritten.
    """
    # [S, wide] is made lower triangular from the right, row by row.
    for i in range(len(size)):
        pivot, below = load(lanes, S, i, i), spread(lanes, 0.0)
        for j in range(i + 1):
            below += load(lanes, wide, i, j) * load(lanes, wide, i, j)
        square = pivot * pivot
        # Reflect column i of S and the columns of ``wide`` that are not 0 in row i.
        active = below > NEGLIGIBLE * square + TINY
        reflect_row(lanes, size, i, i + 1, S, wide, square + below, active)
