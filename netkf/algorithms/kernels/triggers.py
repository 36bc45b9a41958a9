"""Event triggers in kernels: how much news a reading brings, and whether a copy is near enough.

Filter ``h`` of a block has index ``[b, h]`` of stacks with lanes (``netkf.linalg.lanes``):
estimates (B, H, n, L), lower triangular roots (B, H, n, n, L).
"""

from __future__ import annotations

import math
from typing import Any

from netkf.algorithms.kernels.slots import ReadingBlock
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, magnitude, select, spread, store

NO_READING = -1.0  # z' Y z is never negative, so that this cannot be the news of a reading


@kernel
def silence_probability(news: float) -> float:
    """Return ``exp(-z' Y z / 2)`` for the ``news`` z' Y z of a reading, Han et al. (2015); 0 for
    NO_READING.
    """
    return math.exp(-0.5 * news) if news >= 0.0 else 0.0


@kernel
def weigh_news(
    lanes: Lanes,
    x: FloatArray,
    readings: ReadingBlock,
    index: tuple[int, int, int],
    rows: int,
    Y: FloatArray,
    z: FloatArray,
) -> Any:
    """Return ``z' Y z`` with the innovation z = y - H x of the whitened reading of so many ``rows``
    at ``index`` [b, s, h] and x (B, H, n, L); Y (H, p, p) is for whitened rows. NO_READING where
    there is none. ``z`` (p, L) is scratch.
    """
    b, s, h = index
    # H that is fixed has one block and one slot.
    d, t = min(b, readings.H.shape[0] - 1), min(s, readings.H.shape[1] - 1)
    news = size = spread(lanes, 0.0)
    for k in range(rows):
        innovation = load(lanes, readings.y, b, s, h, k)
        size += magnitude(innovation)
        for i in range(x.shape[2]):
            weight = load(lanes, readings.H, d, t, h, k, i)
            size += magnitude(weight)
            innovation -= weight * load(lanes, x, b, h, i)
        store(lanes, z, k, innovation)
    for k in range(rows):
        for j in range(rows):
            news += Y[h, k, j] * load(lanes, z, k) * load(lanes, z, j)
    # Rows that a recorded sensor lacks are zeros.
    return select(size > 0.0, select(news > 0.0, news, 0.0), NO_READING)


@kernel
def is_near(
    lanes: Lanes,
    x: FloatArray,
    root: FloatArray,
    copies_x: FloatArray,
    copies_root: FloatArray,
    index: tuple[int, int, int],
    bounds: tuple[float, float],
    ratio: FloatArray,
    work: FloatArray,
) -> Any:
    """Return the flags of ``|S^-1 (x - xbar)|^2 < alpha``, ``P < (1 + delta) Pbar`` and
    ``Pbar < (1 + delta) P`` with ``bounds`` alpha and 1 + delta.

    x and the root S of P are those of ``index`` [b, h, k], xbar and the root of Pbar the copy at
    ``[b, k]``; ``ratio`` (n, n + 1, L) and ``work`` (n, n, L) are scratch.
    """
    (b, h, k), n = index, x.shape[2]
    distance = spread(lanes, 0.0)
    # S^-1 [Sbar, x - xbar] by forward substitution; both roots are lower triangular.
    for i in range(n):
        inverse = 1.0 / load(lanes, root, b, h, i, i)
        gap = load(lanes, x, b, h, i) - load(lanes, copies_x, b, k, i)
        for j in range(i + 1):
            value = load(lanes, copies_root, b, k, i, j)
            for m in range(j, i):
                value -= load(lanes, root, b, h, i, m) * load(lanes, ratio, m, j)
            store(lanes, ratio, i, j, value * inverse)
        for m in range(i):
            gap -= load(lanes, root, b, h, i, m) * load(lanes, ratio, m, n)
        gap *= inverse
        store(lanes, ratio, i, n, gap)
        distance += gap * gap
    near = select(distance < bounds[0], 1.0, 0.0)
    # P^-1 Pbar has the eigenvalues of M M', the product of the ratio and its transpose.
    for sign in (-1.0, 1.0):
        for i in range(n):
            for j in range(i + 1):
                total = spread(lanes, 0.0)
                for m in range(j + 1):
                    total += load(lanes, ratio, i, m) * load(lanes, ratio, j, m)
                # (1 + delta) M M' - I and (1 + delta) I - M M'.
                entry = bounds[1] * total if sign < 0.0 else -total
                if i == j:
                    entry += -1.0 if sign < 0.0 else bounds[1]
                store(lanes, work, i, j, entry)
        near = select(is_positive(lanes, work), near, 0.0)
    return near > 0.0


@kernel(inlined=True)
def is_positive(lanes: Lanes, work: FloatArray) -> Any:
    """Return the flags of the symmetric matrices (n, n, L), given by their lower triangles, that
    are positive definite; works in place.
    """
    n, least = len(work), spread(lanes, math.inf)
    for k in range(n):
        pivot = load(lanes, work, k, k)
        # Once a pivot is not positive those that follow mean nothing.
        least = select(pivot < least, pivot, least)
        for i in range(k + 1, n):
            factor = load(lanes, work, i, k) / pivot
            for j in range(k + 1, i + 1):
                entry = load(lanes, work, i, j) - factor * load(lanes, work, j, k)
                store(lanes, work, i, j, entry)
    return least > 0.0
