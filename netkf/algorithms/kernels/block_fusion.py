"""Kernels of split covariance intersection of an estimate with an observation of some components.

``z = H x + e + f + v``: e, of covariance ``dependent``, may correlate with the node's own error in
any way, f (``told``) and v (``noise``) do not. With the dependent parts of both enlarged, by 1 / w
and 1 / (1 - w), the update is that of a Kalman filter (Li and Nashashibi 2013). The trace of P
after it has the derivative ``tr(K D_z K') / (1 - w)^2 - tr((I - K H) D (I - K H)') / w^2``, since K
is the best gain: bisection finds the w where it changes its sign.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.algorithms.kernels.pair_fusion import EQUAL
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct

NAIVE, CI, SPLIT = range(3)
"""What is assumed of errors of different nodes, ``BlockIntersection.rule``."""
MARGIN, BISECTIONS = 1e-6, 44
"""Weights are in [MARGIN, 1 - MARGIN]; bisections for w to 1e-13."""
SMALLEST = 1e-14
"""Share of a pivot that is rounding."""
NO_GAIN = 1e-12
"""Share of the trace of P that an observation must at least take away."""


class Fusion(Struct):
    """An estimate of n states and an observation of at most p rows.

    x, P, dependent : (n,), (n, n) twice, the estimate, its covariance, and the part of it that may
                      correlate with the errors of others
    z, H, told, noise : (p,), (p, n) and (p, p) twice
    heard : (p, p), the dependent part of the error of z
    wide, C, S, K, T, stays, after, part : scratch, (n, n), (p, p) twice, (n, p) twice and (n, n)
        three times
    """

    x: FloatArray
    P: FloatArray
    dependent: FloatArray
    z: FloatArray
    H: FloatArray
    told: FloatArray
    noise: FloatArray
    heard: FloatArray
    wide: FloatArray
    C: FloatArray
    S: FloatArray
    K: FloatArray
    T: FloatArray
    stays: FloatArray
    after: FloatArray
    part: FloatArray


def fusion_of(n: int, p: int) -> Fusion:
    """Return room for an estimate of ``n`` states and observations of ``p`` rows."""
    square, rows = (n, n), (p, p)
    shapes: dict[str, tuple[int, ...]] = {
        **{"x": (n,), "z": (p,), "H": (p, n)},
        **dict.fromkeys(("P", "dependent", "wide", "stays", "after", "part"), square),
        **dict.fromkeys(("told", "noise", "heard", "C", "S"), rows),
        **dict.fromkeys(("K", "T"), (n, p)),
    }
    return Fusion(**{name: np.zeros(shape) for name, shape in shapes.items()})


@kernel
def semidefinite_root(S: FloatArray, count: int) -> None:
    """Replace the lower triangle of the first ``count`` rows and columns of ``S`` by its Cholesky
    factor; columns of pivots that are rounding become 0, as S may be singular.
    """
    for j in range(count):
        pivot = S[j, j]
        for m in range(j):
            pivot -= S[j, m] * S[j, m]
        inverse = 0.0
        if pivot > SMALLEST * S[j, j]:
            pivot = math.sqrt(pivot)
            inverse = 1.0 / pivot
        for i in range(j + 1, count):
            total = S[i, j]
            for m in range(j):
                total -= S[i, m] * S[j, m]
            S[i, j] = total * inverse
        S[j, j] = pivot if inverse > 0.0 else 0.0


@kernel
def _set_gain(f: Fusion, count: int, w: float, v: float) -> None:
    """Write the gain K for dependent parts enlarged by 1 / w and 1 / v, and I - K H."""
    n = len(f.x)
    for i in range(n):
        for j in range(n):
            f.wide[i, j] = f.P[i, j] + (1.0 / w - 1.0) * f.dependent[i, j]
        for c in range(count):
            total = 0.0
            for j in range(n):
                total += f.wide[i, j] * f.H[c, j]
            f.T[i, c] = total
    for c in range(count):
        for d in range(count):
            f.C[c, d] = f.heard[c, d] / v + f.told[c, d] + f.noise[c, d]
            total = f.C[c, d]
            for j in range(n):
                total += f.H[c, j] * f.T[j, d]
            f.S[c, d] = total
    semidefinite_root(f.S, count)
    solve_gain(f, count)


@kernel
def solve_gain(f: Fusion, count: int) -> None:
    """Write ``K = T (L L')^-1``, of the root L in S, and I - K H."""
    n = len(f.x)
    for i in range(n):
        for c in range(count):
            total = f.T[i, c]
            for d in range(c):
                total -= f.S[c, d] * f.K[i, d]
            f.K[i, c] = total / f.S[c, c] if f.S[c, c] > 0.0 else 0.0
        for c in range(count - 1, -1, -1):
            total = f.K[i, c]
            for d in range(c + 1, count):
                total -= f.S[d, c] * f.K[i, d]
            f.K[i, c] = total / f.S[c, c] if f.S[c, c] > 0.0 else 0.0
        for j in range(n):
            total = 1.0 if i == j else 0.0
            for c in range(count):
                total -= f.K[i, c] * f.H[c, j]
            f.stays[i, j] = total


@kernel
def _set_product(A: FloatArray, M: FloatArray, rows: int, inner: int, out: FloatArray) -> float:
    """Add ``A M A'``, with A (rows, inner), to ``out``; return its trace."""
    trace = 0.0
    for i in range(rows):
        for j in range(i + 1):
            total = 0.0
            for c in range(inner):
                inside = 0.0
                for d in range(inner):
                    inside += M[c, d] * A[j, d]
                total += A[i, c] * inside
            out[i, j] += total
            if i == j:
                trace += total
            else:
                out[j, i] += total
    return trace


@kernel
def _slopes(f: Fusion, count: int, w: float) -> tuple[float, float]:
    """Return by how much the trace of P falls, and by how much it grows, with w."""
    _set_gain(f, count, w, 1.0 - w)
    n = len(f.x)
    f.part[:] = 0.0
    falls = _set_product(f.stays, f.dependent, n, n, f.part) / (w * w)
    grows = _set_product(f.K, f.heard, n, count, f.part) / ((1.0 - w) * (1.0 - w))
    return falls, grows


@kernel
def _best_weight(f: Fusion, count: int) -> float:
    low, high, w = MARGIN, 1.0 - MARGIN, 0.5
    falls, grows = _slopes(f, count, w)
    # Rounding would decide between two estimates with one covariance.
    if abs(falls - grows) <= EQUAL * (falls + grows):
        return w
    for _ in range(BISECTIONS):
        if falls > grows:
            low = w
        else:
            high = w
        w = 0.5 * (low + high)
        falls, grows = _slopes(f, count, w)
    return w


@kernel
def _move_mean(f: Fusion, count: int) -> None:
    for c in range(count):
        for j in range(len(f.x)):
            f.z[c] -= f.H[c, j] * f.x[j]
    for i in range(len(f.x)):
        for c in range(count):
            f.x[i] += f.K[i, c] * f.z[c]


@kernel
def fuse(f: Fusion, count: int, rule: int) -> None:
    """Use an observation of ``count`` rows, by a ``rule``, for x, P and the dependent part of P."""
    n, own, heard = len(f.x), False, False
    for i in range(n):
        own = own or f.dependent[i, i] > 0.0
    for c in range(count):
        heard = heard or f.heard[c, c] > 0.0
    _set_gain(f, count, 1.0, 1.0)
    # Where one has no dependent part there is nothing to weigh.
    if own and heard:
        w = _best_weight(f, count)
        _set_gain(f, count, w, 1.0 - w)
    f.after[:] = 0.0
    trace, before = _set_product(f.stays, f.wide, n, n, f.after), 0.0
    trace += _set_product(f.K, f.C, n, count, f.after)
    for i in range(n):
        before += f.P[i, i]
    # The limit of w = 1: what was heard is not used.
    if own and heard and not trace < (1.0 - NO_GAIN) * before:
        return
    _move_mean(f, count)
    for i in range(n):
        for j in range(n):
            f.P[i, j] -= f.dependent[i, j]
    # The independent part that is left.
    f.part[:] = 0.0
    _set_product(f.stays, f.P, n, n, f.part)
    _set_product(f.K, f.noise, n, count, f.part)
    for i in range(n):
        for j in range(n):
            f.P[i, j] = f.after[i, j]
            f.dependent[i, j] = f.after[i, j] - f.part[i, j] if rule == SPLIT else 0.0
            if rule == CI:
                f.dependent[i, j] = f.after[i, j]
