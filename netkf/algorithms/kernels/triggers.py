"""Kernels of event triggers, by which a node decides whether to send: ``weigh_news`` of the
stochastic trigger (Han et al. 2015), which sends a reading with much news, and ``is_near`` of
event-triggered consensus (Battistelli, Chisci and Selvi 2018), which sends an estimate only when it
is no longer near the copy of the last one that was sent, which sender and receivers both predict.
"""

from __future__ import annotations

import math
from typing import Any

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, magnitude, select, spread, store

NO_READING = -1.0  # not the news of any reading, since z' Y z is never negative


@kernel
def silence_probability(news: float) -> float:
    """Return the probability ``exp(-z' Y z / 2)`` that a node stays silent, for the ``news`` z' Y z
    of its reading, Han et al. (2015); 0 for NO_READING.
    """
    return math.exp(-0.5 * news) if news >= 0.0 else 0.0


@kernel
def weigh_news(
    run: Any, x: FloatArray, h: int, Y: FloatArray, z: FloatArray, news: FloatArray, k: int
) -> None:
    """Write the news ``z' Y z`` of the whitened reading of node ``h``, for its innovation
    z = y - H x[h], into ``news[k]`` (L,); NO_READING in lanes without a reading.

    x is (H, n, L), Y = ``Y[h]`` (p, p) is for whitened rows, ``z`` (1, p, L) is scratch.
    """
    lanes, rows = run.lanes, run.rows[run.reading]
    first, matrix = run.first_y + run.reading, run.first_H + run.matrix[run.reading]
    total = magnitudes = spread(lanes, 0.0)
    for r in range(rows):
        innovation = load(lanes, run.y, first, r)
        magnitudes += magnitude(innovation)
        for i in range(len(run.size)):
            weight = load(lanes, run.H, matrix, r, i)
            magnitudes += magnitude(weight)
            innovation -= weight * load(lanes, x, h, i)
        store(lanes, z, 0, r, innovation)
    for r in range(rows):
        for j in range(rows):
            total += Y[h, r, j] * load(lanes, z, 0, r) * load(lanes, z, 0, j)
    # Rounding below 0 counts as 0. A slot in which a recorded sensor has no row holds zeros in y
    # and H: no reading.
    store(lanes, news, k, select(magnitudes > 0.0, select(total > 0.0, total, 0.0), NO_READING))


@kernel
def is_near(
    run: Any,
    x: FloatArray,
    root: FloatArray,
    h: int,
    copies_x: FloatArray,
    copies_root: FloatArray,
    k: int,
    alpha: float,
    bound: float,
) -> Any:
    """Return flags (L,) of the runs in which a copy is near the estimate, so that the node need not
    send: ``|S^-1 (x - xbar)|^2 < alpha`` and ``P < bound Pbar`` and ``Pbar < bound P``, with
    x = ``x[h]``, S = ``root[h]`` of P, xbar = ``copies_x[k]``, ``copies_root[k]`` of Pbar.
    """
    lanes, n, ratio, work = run.lanes, len(run.size), run.total, run.noise
    distance = spread(lanes, 0.0)
    # S^-1 [Sbar, x - xbar] by forward substitution; both roots are lower triangular.
    for i in range(n):
        inverse = 1.0 / load(lanes, root, h, i, i)
        distance_row = load(lanes, x, h, i) - load(lanes, copies_x, k, i)
        for j in range(i + 1):
            value = load(lanes, copies_root, k, i, j)
            for m in range(j, i):
                value -= load(lanes, root, h, i, m) * load(lanes, ratio, m, j)
            store(lanes, ratio, i, j, value * inverse)
        for m in range(i):
            distance_row -= load(lanes, root, h, i, m) * load(lanes, ratio, m, n)
        distance_row *= inverse
        store(lanes, ratio, i, n, distance_row)
        distance += distance_row * distance_row
    near = select(distance < alpha, 1.0, 0.0)
    # With M = S^-1 Sbar, P^-1 Pbar has the eigenvalues of M M'. Both bounds on P mean that a matrix
    # is positive definite: bound M M' - I, then bound I - M M'.
    for sign in (-1.0, 1.0):
        for i in range(n):
            for j in range(i + 1):
                total = spread(lanes, 0.0)
                for m in range(j + 1):
                    total += load(lanes, ratio, i, m) * load(lanes, ratio, j, m)
                entry = bound * total if sign < 0.0 else -total
                if i == j:
                    entry += -1.0 if sign < 0.0 else bound
                store(lanes, work, i, j, entry)
        near = select(is_positive(lanes, work), near, 0.0)
    return near > 0.0


@kernel(inlined=True)
def is_positive(lanes: Lanes, work: FloatArray) -> Any:
    """Return which (L,) of the symmetric matrices ``work`` (n, n, L), stored as lower triangles,
    are positive definite: L D L' elimination, which overwrites them, has positive pivots only.

    Axes: L runs side by side.
    """
    n, smallest_pivot = len(work), spread(lanes, math.inf)
    for k in range(n):
        pivot = load(lanes, work, k, k)
        # A pivot that is not positive decides, and so does nan, which all after it become too.
        smallest_pivot = select(pivot >= smallest_pivot, smallest_pivot, pivot)
        for i in range(k + 1, n):
            factor = load(lanes, work, i, k) / pivot
            for j in range(k + 1, i + 1):
                entry = load(lanes, work, i, j) - factor * load(lanes, work, j, k)
                store(lanes, work, i, j, entry)
    return smallest_pivot > 0.0
