"""Kernels on estimates with lower triangular roots of their covariances: predict, update, copy.

Estimate ``k`` of a stack is ``x[k]`` (n, L) with ``root[k]`` (n, n, L), for L runs side by side
(``netkf.linalg.lanes``; L = 1 for a single run). Roots are never squared: a prediction is one
triangularisation of [F S, root of Q], an update by a row of a reading one of [1, h S; 0, S], so
that wide and narrow directions keep their digits. ``size`` has the length n.
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.square_root import triangularise
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, root_of, select, spread, store
from netkf.linalg.local import local_lanes_matrix, local_lanes_vector
from netkf.linalg.structs import Size


@kernel(inlined=True)
def update_by_row(
    lanes: Lanes,
    size: Size,
    x: FloatArray,
    root: FloatArray,
    k: int,
    y: FloatArray,
    H: FloatArray,
    place: tuple[int, int, int],
    arrived: Any,
    scratch: tuple[FloatArray, FloatArray],
) -> None:
    """Update estimate ``k`` with one whitened row ``y = h x + v``, v of variance 1, in the lanes
    whose flag in ``arrived`` is set (True: all): ``x += P h' (h P h' + 1)^-1 (y - h x)``.

    ``place`` = (r, m, i): the row is ``y[r, i]`` (L,) with h = ``H[m, i]`` (n, L); ``scratch`` are
    two arrays (n, L).
    """
    r, m, i = place
    row = local_lanes_vector(size, lanes, scratch[0])
    gains = local_lanes_vector(size, lanes, scratch[1])
    innovation = load(lanes, y, r, i)
    for j in range(len(size)):
        total = spread(lanes, 0.0)
        for q in range(j, len(size)):
            total += load(lanes, H, m, i, q) * load(lanes, root, k, q, j)
        # A row of zeros changes nothing.
        store(lanes, row, j, select(arrived, total, 0.0))
        innovation -= load(lanes, H, m, i, j) * load(lanes, x, k, j)
    # The gain is ``gains`` over the standard deviation of the innovation.
    step = innovation * rotate(lanes, size, root, k, row, gains)
    for j in range(len(size)):
        store(lanes, x, k, j, load(lanes, x, k, j) + load(lanes, gains, j) * step)


@kernel(inlined=True)
def rotate(
    lanes: Lanes, size: Size, root: FloatArray, k: int, row: FloatArray, gains: FloatArray
) -> Any:
    """Update ``root[k]`` = S in place with a scalar observation h of unit noise, ``row`` = h S
    (n, L), by Givens rotations; write ``gains`` (n, L) and return 1 over the standard deviation of
    the innovation: their product is the Kalman gain.
    """
    n = len(size)
    for i in range(n):
        store(lanes, gains, i, 0.0)
    # [1, h S; 0, S] times rotations that empty h S from its end, so that S stays triangular.
    pivot = square = over_pivot = spread(lanes, 1.0)
    for j in range(n - 1, -1, -1):
        entry = load(lanes, row, j)
        square += entry * entry
        length = root_of(square)
        inverse = 1.0 / length
        # Exactly 1 for an entry of 0, so that not even rounding touches the root.
        idle = entry == 0.0
        c, s = select(idle, 1.0, pivot * inverse), entry * inverse
        pivot, over_pivot = select(idle, pivot, length), select(idle, over_pivot, inverse)
        for i in range(j, n):
            old, gain = load(lanes, root, k, i, j), load(lanes, gains, i)
            store(lanes, root, k, i, j, c * old - s * gain)
            store(lanes, gains, i, s * old + c * gain)
    return over_pivot


@kernel(inlined=True)
def add_covariance_product(
    lanes: Lanes,
    size: Size,
    x: FloatArray,
    h: int,
    factor: Any,
    root: FloatArray,
    vector: FloatArray,
    scratch: FloatArray,
) -> None:
    """Add ``factor P d`` to ``x[h]``, with P = S S' of S = ``root[h]`` and d = ``vector`` (n, L);
    ``scratch`` (n, L) may be the vector itself.
    """
    # P d = S (S' d): P itself is never formed.
    for j in range(len(size)):
        total = spread(lanes, 0.0)
        for i in range(j, len(size)):
            total += load(lanes, root, h, i, j) * load(lanes, vector, i)
        store(lanes, scratch, j, total)
    for i in range(len(size)):
        total = spread(lanes, 0.0)
        for j in range(i + 1):
            total += load(lanes, root, h, i, j) * load(lanes, scratch, j)
        store(lanes, x, h, i, load(lanes, x, h, i) + factor * total)


@kernel(inlined=True)
def transform_mean(
    lanes: Lanes, size: Size, x: FloatArray, k: int, F: FloatArray, scratch: FloatArray
) -> None:
    """Replace ``x[k]`` by F x, F (n, n); ``scratch`` is (n, L)."""
    moved = local_lanes_vector(size, lanes, scratch)
    for i in range(len(size)):
        total = spread(lanes, 0.0)
        for j in range(len(size)):
            total += F[i, j] * load(lanes, x, k, j)
        store(lanes, moved, i, total)
    for i in range(len(size)):
        store(lanes, x, k, i, load(lanes, moved, i))


@kernel(inlined=True)
def transform_root(
    lanes: Lanes,
    size: Size,
    root: FloatArray,
    k: int,
    F: FloatArray,
    root_Q: FloatArray,
    scratch: tuple[FloatArray, FloatArray],
) -> None:
    """Replace ``root[k]`` = S by the root of ``F S S' F' + Q``, F and the lower triangular
    ``root_Q`` (n, n); ``scratch`` are two arrays (n, n, L).
    """
    n = len(size)
    moved = local_lanes_matrix(size, lanes, scratch[0])
    noise = local_lanes_matrix(size, lanes, scratch[1])
    for i in range(n):
        # F S; S is lower triangular, so the sum begins at m = j.
        for j in range(n):
            total = spread(lanes, 0.0)
            for m in range(j, n):
                total += F[i, m] * load(lanes, root, k, m, j)
            store(lanes, moved, i, j, total)
        for j in range(i + 1):
            store(lanes, noise, i, j, root_Q[i, j])
    triangularise(lanes, size, root[k], moved, noise)


@kernel(inlined=True)
def copy_vector(
    lanes: Lanes, size: Size, target: FloatArray, k: int, source: FloatArray, m: int, flags: Any
) -> None:
    """Copy ``source[m]`` (n, L) to ``target[k]`` in the lanes with ``flags`` (True: all)."""
    for i in range(len(size)):
        old = load(lanes, target, k, i)
        store(lanes, target, k, i, select(flags, load(lanes, source, m, i), old))


@kernel(inlined=True)
def copy_root(
    lanes: Lanes, size: Size, target: FloatArray, k: int, source: FloatArray, m: int, flags: Any
) -> None:
    """Copy the lower triangle of ``source[m]`` (n, n, L) to that of ``target[k]`` in the lanes with
    ``flags`` (True: all).
    """
    for i in range(len(size)):
        for j in range(i + 1):
            old = load(lanes, target, k, i, j)
            store(lanes, target, k, i, j, select(flags, load(lanes, source, m, i, j), old))
