"""Kernels of split covariance intersection of an estimate with an observation of some components.

``z = H x + e + f + v``: e, of covariance ``dependent``, may correlate with the node's own error in
any way, f (``told``) and v (``noise``) do not. With the dependent parts of both enlarged, by 1 / w
and 1 / (1 - w), the update is that of a Kalman filter (Li and Nashashibi 2013). The trace of P
after it has the derivative ``tr(K D_z K') / (1 - w)^2 - tr((I - K H) D (I - K H)') / w^2``, since K
is the best gain: regula falsi finds the w where it changes its sign.
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
MARGIN, MAX_STEPS, PRECISE = 1e-6, 60, 1e-12
"""Weights are in [MARGIN, 1 - MARGIN], found in so many steps at most, to about this."""
FAR = 50.0
"""A balance where one side is nothing."""
SMALLEST = 1e-14
"""Share of a pivot that is rounding."""
NO_GAIN = 1e-12
"""Share of the trace of P that an observation must at least take away."""


class Fusion(Struct):
    """An estimate of at most w states, of which ``n`` count, and an observation of at most p rows.

    x, P, dependent : (w,), (w, w) twice, the estimate, its covariance, and the part of it that may
                      correlate with the errors of others
    z, H, told, noise : (p,), (p, w) and (p, p) twice
    heard : (p, p), the dependent part of the error of z
    wide, C, S, K, T, stays, after, part, row : scratch, (w, w), (p, p) twice, (w, p) twice, (w, w)
        three times and (w,) or (p,)
    """

    n: int
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
    row: FloatArray


def fusion_of(n: int, p: int) -> Fusion:
    """Return room for an estimate of ``n`` states and observations of ``p`` rows."""
    square, rows = (n, n), (p, p)
    shapes: dict[str, tuple[int, ...]] = {
        **{"x": (n,), "z": (p,), "H": (p, n), "row": (max(n, p),)},
        **dict.fromkeys(("P", "dependent", "wide", "stays", "after", "part"), square),
        **dict.fromkeys(("told", "noise", "heard", "C", "S"), rows),
        **dict.fromkeys(("K", "T"), (n, p)),
    }
    return Fusion(n=n, **{name: np.zeros(shape) for name, shape in shapes.items()})


@kernel
def multiply_in_place(A: FloatArray, k: int, T: FloatArray, column: FloatArray, q: int) -> None:
    """Multiply ``A[k]`` by ``T`` (n, n) from the left in lane ``q``; ``column`` (n,) is scratch."""
    n = len(T)
    for j in range(n):
        for i in range(n):
            column[i] = 0.0
            for c in range(n):
                column[i] += T[i, c] * A[k, c, j, q]
        for i in range(n):
            A[k, i, j, q] = column[i]


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
    n = f.n
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
    n = f.n
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
def _set_row(f: Fusion, A: FloatArray, M: FloatArray, i: int, inner: int) -> float:
    """Write row ``i`` of ``A M`` into ``row``; return its product with that of A (rows, inner)."""
    size = 0.0
    for d in range(inner):
        total = 0.0
        for c in range(inner):
            total += A[i, c] * M[c, d]
        f.row[d] = total
        size += total * A[i, d]
    return size


@kernel
def _set_product(
    f: Fusion, A: FloatArray, M: FloatArray, rows: int, inner: int, out: FloatArray
) -> float:
    """Add ``A M A'``, with A (rows, inner), to ``out``; return its trace."""
    trace = 0.0
    for i in range(rows):
        size = _set_row(f, A, M, i, inner)
        out[i, i] += size
        trace += size
        for j in range(i):
            total = 0.0
            for d in range(inner):
                total += f.row[d] * A[j, d]
            out[i, j] += total
            out[j, i] += total
    return trace


@kernel
def _slopes(f: Fusion, count: int, w: float) -> tuple[float, float]:
    """Return by how much the trace of P falls, and by how much it grows, with w."""
    _set_gain(f, count, w, 1.0 - w)
    falls = grows = 0.0
    for i in range(f.n):
        falls += _set_row(f, f.stays, f.dependent, i, f.n)
        grows += _set_row(f, f.K, f.heard, i, count)
    return falls / (w * w), grows / ((1.0 - w) * (1.0 - w))


@kernel
def _balance(f: Fusion, count: int, s: float) -> float:
    """Return the logarithm of the ratio of both slopes at the weight with logit ``s``."""
    falls, grows = _slopes(f, count, 1.0 / (1.0 + math.exp(-s)))
    if falls > 0.0 and grows > 0.0:
        return min(FAR, max(-FAR, math.log(falls / grows)))
    return FAR if falls > grows else -FAR


@kernel
def _best_weight(f: Fusion, count: int) -> float:
    falls, grows = _slopes(f, count, 0.5)
    # Rounding would decide between two estimates with one covariance.
    if abs(falls - grows) <= EQUAL * (falls + grows):
        return 0.5
    end = math.log((1.0 - MARGIN) / MARGIN)
    a, b = (0.0, end) if falls > grows else (-end, 0.0)
    at_a, at_b = _balance(f, count, a), _balance(f, count, b)
    if at_a <= 0.0 or at_b >= 0.0:
        return MARGIN if at_a <= 0.0 else 1.0 - MARGIN
    s = value = 0.0
    for _ in range(MAX_STEPS):
        s, former = (a * at_b - b * at_a) / (at_b - at_a), value
        value = _balance(f, count, s)
        if abs(value) <= PRECISE or b - a <= PRECISE:
            break
        # Illinois: an end that stays twice counts half.
        if value > 0.0:
            a, at_a, at_b = s, value, at_b * (0.5 if former > 0.0 else 1.0)
        else:
            b, at_b, at_a = s, value, at_a * (0.5 if former < 0.0 else 1.0)
    return 1.0 / (1.0 + math.exp(-s))


@kernel
def _move_mean(f: Fusion, count: int) -> None:
    for c in range(count):
        for j in range(f.n):
            f.z[c] -= f.H[c, j] * f.x[j]
    for i in range(f.n):
        for c in range(count):
            f.x[i] += f.K[i, c] * f.z[c]


@kernel
def fuse(f: Fusion, count: int, rule: int) -> bool:
    """Use an observation of ``count`` rows, by a ``rule``, for x, P and the dependent part of P,
    with the gain K; return False if it says nothing.
    """
    n, own, heard = f.n, False, False
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
    trace, before = _set_product(f, f.stays, f.wide, n, n, f.after), 0.0
    trace += _set_product(f, f.K, f.C, n, count, f.after)
    for i in range(n):
        before += f.P[i, i]
    # The limit of w = 1: what was heard is not used.
    if own and heard and not trace < (1.0 - NO_GAIN) * before:
        return False
    _move_mean(f, count)
    for i in range(n):
        for j in range(n):
            f.P[i, j] -= f.dependent[i, j]
    # The independent part that is left.
    f.part[:] = 0.0
    _set_product(f, f.stays, f.P, n, n, f.part)
    _set_product(f, f.K, f.noise, n, count, f.part)
    for i in range(n):
        for j in range(n):
            f.P[i, j] = f.after[i, j]
            f.dependent[i, j] = f.after[i, j] - f.part[i, j] if rule == SPLIT else 0.0
            if rule == CI:
                f.dependent[i, j] = f.after[i, j]
    return True
