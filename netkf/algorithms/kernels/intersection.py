"""Kernels of covariance intersection, paper D (8) and (9) (Xie, Gan and Liu), on lanes.

``P^-1 = sum w_j P_j^-1`` and ``P^-1 x = sum w_j P_j^-1 x_j``: ``invert_lanes`` and
``write_information_root`` make the terms, ``merge_lanes`` adds them, and ``finish_lanes`` writes P
and x. Information is carried as a root too, ``P^-1 = Z' Z``. Diffusion, consensus on information,
event-triggered consensus and belief propagation use these kernels.
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.square_root import NEGLIGIBLE
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, magnitude, root_of, select, spread, store, with_sign
from netkf.linalg.structs import Size

SINGULAR = 2.0**-25
"""Least pivot of a root that is inverted, relative to the length of its row: the square root of
2^-50, at which a pivot of the covariance itself would be rounding.
"""
TINY = 1e-200  # what NEGLIGIBLE is for a pivot of 0, yet above underflow


@kernel(inlined=True, fused=True)
def invert_lanes(lanes: Lanes, size: Size, out: FloatArray, k: int, S: FloatArray, m: int) -> None:
    """Write the inverse of the lower triangular ``S[m]`` (n, n, L) into ``out[k]``.

    Pivots are raised to SINGULAR (2^-25) times the length of their row: soon after a start from
    P = 0 some are rounding. That makes P no smaller.
    """
    # The floor grows with the whole root, so that a zero row is not inverted on its own scale.
    n, smallest = len(size), spread(lanes, TINY)
    for i in range(n):
        for j in range(i + 1):
            entry = load(lanes, S, m, i, j)
            smallest += NEGLIGIBLE * entry * entry
    for i in range(n):
        row = smallest
        for j in range(i + 1):
            entry = load(lanes, S, m, i, j)
            row += entry * entry
        diagonal, floor = load(lanes, S, m, i, i), SINGULAR * root_of(row)
        length = magnitude(diagonal)
        inverse = 1.0 / with_sign(select(length > floor, length, floor), diagonal)
        # Forward substitution, row i of S^-1.
        for j in range(i):
            value = spread(lanes, 0.0)
            for q in range(j, i):
                value -= load(lanes, S, m, i, q) * load(lanes, out, k, q, j)
            store(lanes, out, k, i, j, value * inverse)
        store(lanes, out, k, i, i, inverse)


@kernel(inlined=True, fused=True)
def write_information_root(
    lanes: Lanes,
    size: Size,
    out: FloatArray,
    weight: Any,
    inverse: FloatArray,
    x: FloatArray,
    m: int,
    centre: FloatArray,
    h: int,
) -> None:
    """Write ``sqrt(weight) [Z, Z (x[m] - centre[h])]`` into ``out`` (n, n + 1, L): a root of
    ``weight`` (L,) times the information of the estimate ``x[m]`` (n, L), relative to ``centre[h]``
    (n, L), with the inverse Z = ``inverse[m]`` (n, n, L) of its root.
    """
    n, factor = len(size), root_of(weight)
    for i in range(n):
        mean = spread(lanes, 0.0)
        # sqrt(w) S^-1, a root of w P^-1.
        for j in range(i + 1):
            entry = factor * load(lanes, inverse, m, i, j)
            store(lanes, out, i, j, entry)
            mean += entry * (load(lanes, x, m, j) - load(lanes, centre, h, j))
        store(lanes, out, i, n, mean)


@kernel(inlined=True, fused=True)
def merge_lanes(lanes: Lanes, size: Size, total: FloatArray, whitened: FloatArray) -> None:
    """Replace ``total`` (n, n + 1, L), a root [Z, z] of information (Z lower triangular,
    information Z' Z, z = Z times the mean), by a root of the sum of it and ``whitened``
    (n, n + 1, L), which is overwritten.
    """
    # Reflections from the left zero the columns of ``whitened`` from the last one on, so that both
    # stay lower triangular.
    n = len(size)
    for j in range(n - 1, -1, -1):
        pivot, below = load(lanes, total, j, j), spread(lanes, 0.0)
        for r in range(j, n):
            entry = load(lanes, whitened, r, j)
            below += entry * entry
        # Lanes whose column is zero already do not change.
        idle = below <= NEGLIGIBLE * pivot * pivot + TINY
        length = root_of(pivot * pivot + below)
        # pivot - length without cancellation: pivots of ``total`` are never negative. Of both
        # divisions neither waits for the other.
        head = pivot + length
        first = select(idle, 0.0, -below / head)
        scale = select(idle, 0.0, head / (length * below))  # 2 / (first^2 + below)
        store(lanes, total, j, j, select(idle, pivot, length))
        # Reflect the columns left of j and, in the place of column j itself, that of the means.
        for column in range(j + 1):
            c = n if column == j else column
            inner = first * load(lanes, total, j, c)
            for r in range(j, n):
                inner += load(lanes, whitened, r, j) * load(lanes, whitened, r, c)
            inner *= scale
            store(lanes, total, j, c, load(lanes, total, j, c) - inner * first)
            for r in range(j, n):
                entry = load(lanes, whitened, r, c) - inner * load(lanes, whitened, r, j)
                store(lanes, whitened, r, c, entry)


@kernel(inlined=True, fused=True)
def finish_lanes(
    lanes: Lanes,
    size: Size,
    root: FloatArray,
    xhat: FloatArray,
    h: int,
    centre: FloatArray,
    total: FloatArray,
    whitened: FloatArray,
    unchanged: Any,
) -> None:
    """Write the estimate of the information ``total`` (n, n + 1, L), [Z, z] relative to
    ``centre[h]`` (n, L): Z^-1 into ``root[h]`` (n, n, L) and ``centre + Z^-1 z`` into ``xhat[h]``
    (n, L), which may be the centre itself.

    ``unchanged`` lanes (L,) keep their estimate; ``whitened`` (n, n + 1, L) is scratch.
    """
    # S = Z^-1: the total is lower triangular, so P = Z^-1 Z^-T has the lower root Z^-1.
    n = len(size)
    for i in range(n):
        inverse = 1.0 / load(lanes, total, i, i)
        for j in range(i):
            value = spread(lanes, 0.0)
            for r in range(j, i):
                value -= load(lanes, total, i, r) * load(lanes, whitened, r, j)
            store(lanes, whitened, i, j, value * inverse)
        store(lanes, whitened, i, i, inverse)
    # x = centre + Z^-1 (Z (x - centre)).
    for i in range(n):
        mean = load(lanes, centre, h, i)
        for j in range(i + 1):
            entry = load(lanes, whitened, i, j)
            mean += entry * load(lanes, total, j, n)
            store(lanes, root, h, i, j, select(unchanged, load(lanes, root, h, i, j), entry))
        store(lanes, xhat, h, i, select(unchanged, load(lanes, xhat, h, i), mean))
