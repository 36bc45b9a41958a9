"""Updates and combinations of estimates whose covariances are carried as roots.

A root is lower triangular, ``P = S S'``, and only its lower triangle is read or written. Nothing
here inverts a covariance or subtracts one from another: samples are used by Givens rotations of
columns, which keep columns of very different sizes apart (a first covariance of 1e12 beside a
sensor of 1e-9), and combinations are one orthogonal elimination.

Kernels work in place on entry ``k`` of stacks, root (K, n, n) and x (K, n), for the compiled event
loop, and take their scratch from :func:`update_scratch`. Wrappers for Python take one node and
return new arrays, for the filters, so that both engines compute the same bits. ``lanes`` is ONE for
a single run or MANY for L of them as one SIMD value (``netkf.linalg.lanes``):

=================================  ============================================================
``sample_root``                    kernel: use one sample ``y = H x + v`` (p rows)
``update_with_sample``             the same for Python
``scale_root``, ``add_root``       kernels: ``sum w_j P_j`` and ``sum w_j x_j``, term by term
``combine_roots``                  the same for Python
``begin_intersection``,            kernels: covariance intersection, term by term; the last one
``add_to_intersection``,           writes the result
``end_intersection``
``intersect_roots``                the same for Python
``lower_root``                     for Python: the triangular root of any root (n, c), c >= n
=================================  ============================================================
"""

from __future__ import annotations

import math
import threading

import numpy as np

from netkf.algorithms.kernels.square_root import lower_triangular, reflect_row
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, Lanes, load, spread
from netkf.linalg.local import local_matrix
from netkf.linalg.structs import Size, Struct, sized

SINGULAR = 2.0**-25
"""Least pivot of a root that is inverted, relative to the length of its row: the square root of
2^-50, at which a pivot of the covariance itself would be rounding.
"""
NEGLIGIBLE = 1e-40  # share of a squared pivot that changes neither it nor the rows below it
TINY = 1e-200  # the same for a pivot of 0, yet above underflow


class UpdateScratch(Struct):
    """The ``size`` n of states, and scratch arrays: C (p, p), HS (p, n) and gains (p, n) of a
    sample, with p >= 1 its largest number of rows; ``S`` and ``wide`` (n, n) of convex
    combinations; ``whitened`` and ``total`` (n, n + 1), one term and the sum of an intersection, as
    [Z, z].
    """

    size: Size
    C: FloatArray
    HS: FloatArray
    gains: FloatArray
    S: FloatArray
    wide: FloatArray
    whitened: FloatArray
    total: FloatArray


def update_scratch(n: int, p: int, unrolled: bool = False) -> UpdateScratch:
    """Return scratch arrays for states of n entries and samples of at most p rows; where
    ``unrolled`` kernels are compiled for that n, if it is small.
    """
    p = max(p, 1)
    shapes = {
        **{"C": (p, p), "HS": (p, n), "gains": (p, n), "S": (n, n), "wide": (n, n)},
        **{"whitened": (n, n + 1), "total": (n, n + 1)},
    }
    # A struct sized by n makes numba compile loops of constant length; the plain one serves any n.
    cls = UpdateScratch.of_size(n) if unrolled else UpdateScratch
    size = sized(n) if unrolled else np.zeros(n)
    return cls(size=size, **{name: np.zeros(shape) for name, shape in shapes.items()})


class _Scratches(threading.local):
    """Scratch arrays of each thread, by n and p, for calls from Python."""

    def __init__(self) -> None:
        self.scratches: dict[tuple[int, int], UpdateScratch] = {}

    def of(self, n: int, p: int) -> UpdateScratch:
        """Return scratch arrays for n states and samples of p rows, made once and reused by later
        calls of the same thread.
        """
        if (n, p) not in self.scratches:
            self.scratches[n, p] = update_scratch(n, p)
        return self.scratches[n, p]


_scratches = _Scratches()


def lower_root(root: FloatArray) -> FloatArray:
    """Return the lower triangular S (n, n) with a nonnegative diagonal and ``S S' = root root'``,
    for any ``root`` (n, c).
    """
    n, columns = root.shape
    # QR of the transpose needs at least as many columns as rows.
    wide = np.concatenate([root, np.zeros((n, max(n - columns, 0)))], axis=1)
    L = np.tril(lower_triangular(wide))
    # Column signs are free in S S'; a nonnegative diagonal makes the root unique.
    return np.asarray(L * np.where(np.diag(L) < 0.0, -1.0, 1.0))


# Samples.


@kernel(inlined=True)
def rotate_out(
    size: Size, root: FloatArray, k: int, row: FloatArray, m: int, gains: FloatArray, pivot: float
) -> float:
    """Update the root S = ``root[k]`` (n, n) of stack ``root`` (K, n, n), in place, with the scalar
    observation ``h x + v``, where ``h S`` is ``row[m]`` (n,) and v has the variance ``pivot``^2.

    Return the standard deviation of the innovation; the Kalman gain is ``gains[m]`` (n,), which is
    written, divided by it. Axes: K estimates.
    """
    # Multiply [pivot, h S; 0, S] from the right by Givens rotations that zero h S from its last
    # entry on, so that S stays lower triangular.
    n = len(size)
    for i in range(n):
        gains[m, i] = 0.0
    # The square of the pivot is a plain sum: no square root has to wait for the one before.
    square = pivot * pivot
    # From the last column on: rotation j touches rows i >= j only, where S has entries.
    for j in range(n - 1, -1, -1):
        entry = row[m, j]
        if entry != 0.0:
            square += entry * entry
            length = math.sqrt(square)
            inverse = 1.0 / length
            c, s = pivot * inverse, entry * inverse
            pivot = length
            # Rotate column j of [h S; S] into the column of the gain.
            for i in range(j, n):
                old, gain = root[k, i, j], gains[m, i]
                root[k, i, j] = c * old - s * gain
                gains[m, i] = s * old + c * gain
    return pivot


@kernel
def sample_root(
    root: FloatArray,
    x: FloatArray,
    k: int,
    y: FloatArray,
    H: FloatArray,
    root_R: FloatArray,
    scratch: UpdateScratch,
) -> None:
    """Update ``x[k]`` (n,) and ``root[k]`` (n, n), entry ``k`` of stacks of K estimates, in place
    with the sample ``y = H x + v``: y (p,), H (p, n), ``root_R`` (p, p) lower triangular and
    regular.

    ``y`` is overwritten with the normalised innovation ``C^-1 (y - H x)``, C C' = H P H' + R. Its
    squares sum to the NIS; its entries are independent standard normals if the filter is
    consistent.
    """
    # Rotations from the right make [root_R, H S; 0, S] lower triangular, [C, 0; gains', S+], one
    # row of H after the other.
    p, n, size = len(y), len(scratch.size), scratch.size
    C, HS, gains = scratch.C, scratch.HS, scratch.gains
    for r in range(p):
        # rotate_rows() changes C below the diagonal, so it starts from a fresh copy of root_R.
        for m in range(r + 1):
            C[r, m] = root_R[r, m]
        predicted = 0.0
        for j in range(n):
            total = 0.0
            for i in range(j, n):
                total += H[r, i] * root[k, i, j]
            HS[r, j] = total
            # H x, for the innovation y - H x with the x before any row is used.
            predicted += H[r, j] * x[k, j]
        y[r] -= predicted
    # Row by row, C becomes the root of H P H' + R.
    for r in range(p):
        # The last row has no rows below it to rotate along.
        if r == p - 1:
            C[r, r] = rotate_out(size, root, k, HS, r, gains, C[r, r])
        else:
            rotate_rows(root, k, C, HS, gains, r, p)
        # Forward substitution: y <- C^-1 (y - H x), the normalised innovation.
        total = y[r]
        for m in range(r):
            total -= C[r, m] * y[m]
        # C[r, r] is 0 only if R is singular and row r has no variance: its gain is 0 too.
        y[r] = total / C[r, r] if C[r, r] != 0.0 else 0.0
        # x += gains' C^-1 (y - H x) = K (y - H x).
        for i in range(n):
            x[k, i] += gains[r, i] * y[r]


@kernel
def rotate_rows(
    root: FloatArray, k: int, C: FloatArray, HS: FloatArray, gains: FloatArray, r: int, p: int
) -> None:
    """Update ``root[k]`` (n, n) with row ``r`` of an observation with ``p`` rows, by the rotations
    of ``rotate_out``, and apply these to the later rows too.

    Changes in place ``root[k]``, the rows from r on of ``C`` (p, p), a root of the noise in the
    innovation, and the rows below r of ``HS`` (p, n), which is H times the root; writes
    ``gains[r]`` (n,), the unscaled gain of row r.
    """
    n = root.shape[1]
    for i in range(n):
        gains[r, i] = 0.0
    for j in range(n - 1, -1, -1):
        entry = HS[r, j]
        if entry != 0.0:
            length = math.sqrt(C[r, r] * C[r, r] + entry * entry)
            c, s = C[r, r] / length, entry / length
            C[r, r] = length
            # The rows of the observation that are used later.
            for i in range(r + 1, p):
                old, gain = HS[i, j], C[i, r]
                HS[i, j] = c * old - s * gain
                C[i, r] = s * old + c * gain
            # Column j of S and the gain; S stays lower triangular.
            for i in range(j, n):
                old, gain = root[k, i, j], gains[r, i]
                root[k, i, j] = c * old - s * gain
                gains[r, i] = s * old + c * gain


def update_with_sample(
    root: FloatArray, x: FloatArray, y: FloatArray, H: FloatArray, root_R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the root (n, n), x (n,) and the normalised innovation ``C^-1 (y - H x)`` (p,), with C
    C' = H P H' + R, after an update of ``root`` and ``x`` with the sample y (p,).

    H is (p, n) and ``root_R`` (p, p), a lower triangular root of the noise covariance. The
    arguments are not changed.
    """
    n = len(x)
    roots, means, innovation = root.reshape(1, n, n).copy(), x.reshape(1, n).copy(), y.copy()
    sample_root(roots, means, 0, innovation, H, root_R, _scratches.of(n, len(y)))
    return roots[0], means[0], innovation


# Convex combinations.


@kernel(inlined=True)
def scale_root(size: Size, root: FloatArray, x: FloatArray, k: int, weight: float) -> None:
    """Multiply the estimate ``x[k]`` (n,) and its covariance P = S S' by ``weight`` >= 0, in place:
    S = ``root[k]`` (n, n) by the root of ``weight``.
    """
    # sqrt(w) S is a root of w P.
    n, factor = len(size), math.sqrt(weight)
    for i in range(n):
        x[k, i] *= weight
        for j in range(i + 1):
            root[k, i, j] *= factor


@kernel(fused=True)
def add_root(
    root: FloatArray,
    x: FloatArray,
    k: int,
    weight: float,
    other: FloatArray,
    other_x: FloatArray,
    m: int,
    scratch: UpdateScratch,
) -> None:
    """Add to the estimate ``x[k]`` (n,) and the covariance P of ``root[k]`` (n, n), in place,
    ``weight`` >= 0 times those of entry ``m`` of ``other_x`` (M, n) and ``other`` (M, n, n): one
    term of the convex combinations of paper H (7) and (9) (Tanwani 2021). All roots are lower
    triangular; ``scale_root`` comes first, with the own weight.

    Axes: M other estimates.
    """
    size, n, factor = scratch.size, len(scratch.size), math.sqrt(weight)
    # P + w P_m = A A' with A = [S, sqrt(w) S_m], made triangular from the right.
    S, wide = local_matrix(size, scratch.S), local_matrix(size, scratch.wide)
    for i in range(n):
        x[k, i] += weight * other_x[m, i]
        for j in range(i + 1):
            S[i, j], wide[i, j] = root[k, i, j], factor * other[m, i, j]
    absorb_columns(ONE, size, S, wide)
    for i in range(n):
        for j in range(i + 1):
            root[k, i, j] = S[i, j]


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


def combine_roots(
    weights: FloatArray, means: FloatArray, roots: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return ``sum w_j x_j`` (n,) and the lower triangular root (n, n) of ``sum w_j P_j``, for
    weights (k,), means (k, n) and lower triangular roots (k, n, n) of k estimates.
    """
    x, root = means[:1].copy(), roots[:1].copy()
    scratch = _scratches.of(means.shape[1], 1)
    scale_root(scratch.size, root, x, 0, float(weights[0]))
    for m in range(1, len(weights)):
        add_root(root, x, 0, float(weights[m]), roots, means, m, scratch)
    return x[0], root[0]


# Covariance intersection, (8) and (9) of paper D (Xie, Gan and Liu): P^-1 = sum w_j P_j^-1 and
# P^-1 x = sum w_j P_j^-1 x_j. Information is a root too, P^-1 = Z' Z.


@kernel(inlined=True)
def begin_intersection(scratch: UpdateScratch) -> None:
    """Set the information in ``scratch.total`` (n, n + 1) to zero, before the terms of an
    intersection are added.
    """
    total = scratch.total
    for i in range(total.shape[0]):
        for j in range(total.shape[1]):
            total[i, j] = 0.0


@kernel
def add_to_intersection(
    weight: float,
    root: FloatArray,
    x: FloatArray,
    k: int,
    centre: FloatArray,
    m: int,
    scratch: UpdateScratch,
) -> None:
    """Add ``weight`` times the information of the estimate ``x[k]`` (n,) with the root ``root[k]``
    (n, n) to ``scratch.total`` (n, n + 1), one term of paper D (8).

    Means are relative to ``centre[m]`` (n,), any point near them that is the same for all terms of
    one intersection. Changes ``scratch.total`` and ``scratch.whitened`` only; a weight of 0 adds
    nothing.
    """
    whitened, total, n = scratch.whitened, scratch.total, x.shape[1]
    if weight <= 0.0:
        return
    # Z_k = sqrt(w) S^-1, since w P^-1 = Z' Z.
    invert_root(whitened, root, k, math.sqrt(weight))
    # The last column is Z (x - centre): differences of near states lose no digits.
    for i in range(n):
        mean = 0.0
        for j in range(i + 1):
            mean += whitened[i, j] * (x[k, j] - centre[m, j])
        whitened[i, n] = mean
    merge_information(total, whitened)


@kernel(inlined=True)
def merge_information(total: FloatArray, whitened: FloatArray) -> None:
    """Replace ``total`` (n, n + 1), a root [Z, z] of information, by a root of the sum of it and
    ``whitened`` (n, n + 1), which is overwritten. Z (n, n) is lower triangular with information Z'
    Z, and z (n,) is Z times the mean.
    """
    # Reflections from the left zero the columns of ``whitened`` from the last one on, so that both
    # stay lower triangular.
    n = len(total)
    for j in range(n - 1, -1, -1):
        below = 0.0
        for r in range(j, n):
            below += whitened[r, j] * whitened[r, j]
        pivot = total[j, j]
        if below <= NEGLIGIBLE * pivot * pivot + TINY:
            continue
        length = math.sqrt(pivot * pivot + below)
        # pivot - length without cancellation: pivots of ``total`` are never negative.
        first = -below / (pivot + length)
        total[j, j] = length
        scale = 2.0 / (first * first + below)
        # Reflect the columns left of j and, in the place of column j itself, that of the means.
        for column in range(j + 1):
            c = n if column == j else column
            inner = first * total[j, c]
            for r in range(j, n):
                inner += whitened[r, j] * whitened[r, c]
            inner *= scale
            total[j, c] -= inner * first
            for r in range(j, n):
                whitened[r, c] -= inner * whitened[r, j]


@kernel(inlined=True)
def invert_root(out: FloatArray, root: FloatArray, k: int, factor: float) -> None:
    """Write ``factor`` times the inverse of the lower triangular ``root[k]`` (n, n) into ``out``
    (n, >= n), lower triangular.

    Soon after a start from P = 0 some combinations of states have almost no noise yet, and pivots
    are rounding. They are raised to SINGULAR times the length of their row, which makes P no
    smaller.
    """
    # The floor grows with the whole root, so that a zero row is not inverted on its own scale.
    n, floor = root.shape[1], TINY
    for i in range(n):
        for j in range(i + 1):
            floor += NEGLIGIBLE * root[k, i, j] * root[k, i, j]
    for i in range(n):
        row = floor
        for j in range(i + 1):
            row += root[k, i, j] * root[k, i, j]
        pivot = max(abs(root[k, i, i]), SINGULAR * math.sqrt(row))
        if root[k, i, i] < 0.0:
            pivot = -pivot
        # Forward substitution, row i of S^-1.
        for j in range(i + 1):
            value = factor if j == i else 0.0
            for m in range(j, i):
                value -= root[k, i, m] * out[m, j]
            out[i, j] = value / pivot


@kernel(inlined=True)
def end_intersection(
    root: FloatArray, x: FloatArray, k: int, centre: FloatArray, m: int, scratch: UpdateScratch
) -> None:
    """Write the intersection that ``scratch.total`` [Z, z] holds: its mean, relative to
    ``centre[m]`` (n,), into ``x[k]`` (n,) and the lower triangular root Z^-1 of ``P = (Z' Z)^-1``
    into ``root[k]`` (n, n); nan if nothing was added.
    """
    total, whitened, n = scratch.total, scratch.whitened, x.shape[1]
    # S = Z^-1: the total is lower triangular, so P = Z^-1 Z^-T has the lower root Z^-1.
    for i in range(n):
        for j in range(i + 1):
            value = 1.0 if j == i else 0.0
            for r in range(j, i):
                value -= total[i, r] * whitened[r, j]
            whitened[i, j] = value / total[i, i]
    # x = centre + Z^-1 (Z (x - centre)).
    for i in range(n):
        mean = centre[m, i]
        for j in range(i + 1):
            root[k, i, j] = whitened[i, j]
            mean += whitened[i, j] * total[j, n]
        whitened[i, n] = mean
    # Last, since ``centre`` may be x itself.
    for i in range(n):
        x[k, i] = whitened[i, n]


def intersect_roots(
    weights: FloatArray, means: FloatArray, roots: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the estimate (n,) and lower triangular root (n, n) of the covariance intersection D
    (8) and (9), for weights (k,), means (k, n) and lower triangular roots (k, n, n) of k estimates:
    ``P^-1 = sum w_j P_j^-1`` and ``P^-1 x = sum w_j P_j^-1 x_j``.
    """
    x, root = means[:1].copy(), np.zeros_like(roots[:1])
    scratch = _scratches.of(means.shape[1], 1)
    begin_intersection(scratch)
    for m in range(len(weights)):
        add_to_intersection(float(weights[m]), roots, means, m, means, 0, scratch)
    end_intersection(root, x, 0, means, 0, scratch)
    return x[0], root[0]
