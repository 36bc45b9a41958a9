"""The gate of ``algorithms.gates`` in front of the readings of a node, in kernels.

A reading has a part for each sensor, of whitened rows. Those of a part that is refused are
multiplied by 0, which tells nothing, or by less than 1, which is a larger R.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from netkf.algorithms.gates import Gate
from netkf.algorithms.kernels.run import Estimates
from netkf.algorithms.kernels.square_root import reflect
from netkf.linalg.addresses import reads_only
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct

MOST_STEPS, CLOSE = 100, 1e-15
"""Most steps of Newton's method, which takes a few, and the share of a factor that ends it."""


class GateTables(Struct):
    """A gate, and the parts of readings that it looks at.

    limits : (P + 1,), the largest normalised innovation squared of so many numbers that is taken
    inflates : 1 if R of a part that is refused is multiplied, 0 if the part is ignored
    active : runs side by side that there are, at most L
    own : (H,), how many states of each node are of its own blocks: others pass
    first : (K + 1,), the parts of list k are ``first[k]`` to ``first[k + 1]`` - 1
    row, length : (G,), first row and number of rows of each part
    scale : (G, L), by which its rows were multiplied
    G, z, L, out : scratch (P, n), (P,), (P, P + n) and (P,)
    """

    limits: FloatArray
    inflates: int
    active: int
    own: IntArray
    first: IntArray
    row: IntArray
    length: IntArray
    scale: FloatArray
    G: FloatArray
    z: FloatArray
    L: FloatArray
    out: FloatArray


def gate_tables(
    gate: Gate,
    n: int,
    runs: tuple[int, int],
    parts: Sequence[Sequence[Sequence[int]]],
    own: IntArray,
) -> GateTables:
    """Return the tables of a gate for estimates of n states, ``own`` (H,) of them of the own blocks
    of each node: ``runs`` = (L, active), and for each list of parts the (row, length) of each.
    """
    every = np.array([part for some in parts for part in some], dtype=np.int64).reshape(-1, 2)
    most = int(every[:, 1].max(initial=0))
    return GateTables(
        limits=np.array([math.inf, *(gate.limit(p) for p in range(1, most + 1))]),
        inflates=gate.then == "inflate",
        active=runs[1],
        own=own,
        first=np.cumsum([0, *map(len, parts)], dtype=np.int64),
        row=every[:, 0].copy(),
        length=every[:, 1].copy(),
        scale=np.ones((len(every), runs[0])),
        G=np.zeros((most, n)),
        z=np.zeros(most),
        L=np.zeros((most, most + n)),
        out=np.zeros(most),
    )


def own_sizes(infos: Sequence[Any], n: int, pooled: bool) -> IntArray:
    """Return how many of n states each node owns: all without blocks, or of a ``pooled`` filter."""
    return np.array([n if pooled else info.own_states(n) for info in infos], dtype=np.int64)


@cache
def no_gate() -> GateTables:
    """Return the tables of a run without a gate."""
    return gate_tables(Gate(probability=0.5), 0, (1, 0), [], np.zeros(0, dtype=np.int64))


@kernel
def pass_gate(record: Any, h: int, k: int, run: Any) -> None:
    """Let reading ``run.reading`` pass the gate of node ``h``, part by part of list ``k``: write
    the scale of each, 1 if it is taken, and multiply its rows by it.
    """
    gate = run.gate
    for g in range(gate.first[k], gate.first[k + 1]):
        for q in range(gate.active):
            gate.scale[g, q] = _scale_of_part(record, h, g, q, run)
            if gate.scale[g, q] != 1.0:
                place = run.reading, gate.row[g], gate.length[g]
                scale_rows(run, place, q, gate.scale[g, q])


reads_only(Estimates, pass_gate)


@kernel
def scale_rows(run: Any, place: tuple[int, int, int], q: int, scale: float) -> None:
    """Multiply rows of a reading by a number in lane ``q``: ``place`` = (reading, row, length)."""
    r, row, length = place
    y, H = run.first_y + r, run.first_H + run.matrix[r]
    for i in range(row, row + length):
        run.y[y, i, q] *= scale
        for j in range(run.H.shape[2]):
            run.H[H, i, j, q] *= scale


@kernel
def _scale_of_part(record: Any, h: int, g: int, q: int, run: Any) -> float:
    gate, n, p, x, root = run.gate, len(run.size), 0, record.xhat, record.root
    y, H = run.first_y + run.reading, run.first_H + run.matrix[run.reading]
    # The innovation z and G = H S of the root S of P. Rows of zeros are values that are missing.
    for i in range(gate.row[g], gate.row[g] + gate.length[g]):
        z, is_read = run.y[y, i, q], run.y[y, i, q] != 0.0
        for j in range(n):
            z -= run.H[H, i, j, q] * x[h, j, q]
            is_read |= run.H[H, i, j, q] != 0.0
            if j >= gate.own[h] and run.H[H, i, j, q] != 0.0:
                return 1.0
            total = 0.0
            for m in range(j, n):
                total += run.H[H, i, m, q] * root[h, m, j, q]
            gate.G[p, j] = total
        gate.z[p] = z
        p += is_read
    limit, factor = gate.limits[p], 1.0
    distance, slope = _distance(gate, p, n, factor)
    # ``not >`` also takes what is nan: then the filter itself has diverged.
    if not distance > limit:
        return 1.0
    if gate.inflates == 0:
        return 0.0
    # 1 / distance is a concave function of the factor, so that steps never go too far.
    for _ in range(MOST_STEPS):
        step = distance * (distance / limit - 1.0) / slope
        factor += step
        if not step > CLOSE * factor:
            break
        distance, slope = _distance(gate, p, n, factor)
    return 1.0 / math.sqrt(factor)


@kernel
def _distance(gate: GateTables, p: int, n: int, factor: float) -> tuple[float, float]:
    """Return z' S^-1 z with S = G G' + factor 1, and minus its derivative by the factor."""
    L, out = gate.L, gate.out
    # S = L L' may be singular to rounding where P is very much larger than R, L is not.
    for i in range(p):
        out[i] = gate.z[i]
        for k in range(p):
            L[i, k] = math.sqrt(factor) if i == k else 0.0
        for j in range(n):
            L[i, p + j] = gate.G[i, j]
    for i in range(p):
        reflect(L, i, i, p, p + n)
    distance = slope = 0.0
    for i in range(p):
        for k in range(i):
            out[i] -= L[i, k] * out[k]
        out[i] /= L[i, i]
        distance += out[i] * out[i]
    for i in range(p - 1, -1, -1):
        for k in range(i + 1, p):
            out[i] -= L[k, i] * out[k]
        out[i] /= L[i, i]
        slope += out[i] * out[i]
    return distance, slope
