"""Kernels of consensus on information (CI, HCMCI, ICF): sums of information pairs, as roots.

An information pair (Omega, q), with Omega = P^-1 and q = P^-1 x for an estimate x, is stored as a
root (Z, z), n by n + 1, with ``Omega = Z' Z`` and ``q = Omega c + Z' z``. Z is lower triangular,
and z is relative to a centre c (n,), the estimate of the node that holds the pair, so that
differences of near states lose no digits. Omega may be singular, as that of a single reading is.
Pairs add up by ``merge_lanes``, which triangularises one root on top of the other. What is above
the diagonal of Z is never read.

Stacks ``parts`` (M, K, n, n + 1, L) hold K pairs of each of M nodes or messages, relative to the
estimates ``x`` (M, n, L), for L runs side by side (``netkf.linalg.lanes``).
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.intersection import merge_lanes
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load, root_of, store


@kernel(inlined=True)
def clear_part(lanes: Lanes, part: FloatArray) -> None:
    """Set the root ``part`` (n, n + 1, L) to no information."""
    n = len(part)
    for i in range(n):
        for j in range(i + 1):
            store(lanes, part, i, j, 0.0)
        store(lanes, part, i, n, 0.0)


@kernel(inlined=True)
def copy_information_root(lanes: Lanes, source: FloatArray, target: FloatArray) -> None:
    """Copy the root ``source`` (n, n + 1, L) to ``target``."""
    n = len(source)
    for i in range(n):
        for j in range(i + 1):
            store(lanes, target, i, j, load(lanes, source, i, j))
        store(lanes, target, i, n, load(lanes, source, i, n))


@kernel(inlined=True)
def add_reading_pair(
    run: Any, total: FloatArray, share: float, r: int, centre: FloatArray, h: int, work: FloatArray
) -> None:
    """Add ``share`` times the information pair ``(H' H, H' y)`` of the whitened reading number
    ``r`` to the root ``total`` (n, n + 1, L), relative to ``centre[h]`` (n, L); ``work``
    (n, n + 1, L) is scratch.
    """
    lanes, n, factor = run.lanes, len(total), share**0.5
    first, matrix = run.first_y + r, run.first_H + run.matrix[r]
    for k in range(run.rows[r]):
        # Merge a row [H, y - H c], as the last row of a lower triangular root.
        clear_part(lanes, work)
        innovation = load(lanes, run.y, first, k)
        for j in range(n):
            entry = load(lanes, run.H, matrix, k, j)
            innovation -= entry * load(lanes, centre, h, j)
            store(lanes, work, n - 1, j, factor * entry)
        store(lanes, work, n - 1, n, factor * innovation)
        merge_lanes(lanes, run.size, total, work)


@kernel(inlined=True)
def weigh_part(
    lanes: Lanes,
    out: FloatArray,
    weight: Any,
    parts: FloatArray,
    m: int,
    k: int,
    x: FloatArray,
    centre: FloatArray,
    h: int,
) -> None:
    """Write the root [Z, z] of ``weight`` (L,) times the information pair ``parts[m, k]`` into
    ``out`` (n, n + 1, L), relative to ``centre[h]`` (n, L) instead of ``x[m]`` (n, L).
    """
    n, factor = len(out), root_of(weight)
    for i in range(n):
        mean = load(lanes, parts, m, k, i, n)
        for j in range(i + 1):
            entry = load(lanes, parts, m, k, i, j)
            # Z (x - c_h) = Z (x - c_j) + Z (c_j - c_h).
            mean += entry * (load(lanes, x, m, j) - load(lanes, centre, h, j))
            store(lanes, out, i, j, factor * entry)
        store(lanes, out, i, n, factor * mean)
