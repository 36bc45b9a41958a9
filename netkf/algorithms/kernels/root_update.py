"""Updates and combinations of estimates whose covariances are carried as roots.

A root is lower triangular, ``P = S S'``, and only its lower triangle is read or written. Nothing
here inverts a covariance or subtracts one from another: samples are used by Givens rotations of
columns, which keep columns of very different sizes apart (a first covariance of 1e12 beside a
sensor of 1e-9), and combinations are one orthogonal elimination.

Kernels work in place on place ``k`` of stacks, root (K, n, n) and x (K, n), and take their scratch
from :func:`update_scratch`; wrappers for Python take one node and return new arrays:

=================================  ============================================================
``sample_root``                    kernel: use one sample ``y = H x + v`` (p rows)
``update_with_sample``             the same for Python
``scale_root``, ``add_root``       kernels: ``sum w_j P_j`` and ``sum w_j x_j``, term by term
``combine_roots``                  the same for Python
``begin_intersection``,            kernels: covariance intersection, term by term, read off at
``add_to_intersection``,           the end
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
"""Least pivot of a root that counts in an intersection, relative to the length of its row: the
square root of what a covariance would be known to.
"""
NEGLIGIBLE = 1e-40  # of the square of a pivot: what cannot move it, nor the rows below it
TINY = 1e-200


class UpdateScratch(Struct):
    """The ``size`` n of states, and scratch arrays: C (p, p), HS (p, n) and gains (p, n) of a
    sample, with p >= 1 its largest number of rows; ``S`` and ``wide`` (n, n), ``whitened``
    (n, n + 1) and ``total`` (n, n + 1) of combinations.
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
    """Of each thread, for calls from Python, by n and p."""

    def __init__(self) -> None:
        self.known: dict[tuple[int, int], UpdateScratch] = {}

    def of(self, n: int, p: int) -> UpdateScratch:
        """Return scratch arrays for n states and samples of p rows."""
        if (n, p) not in self.known:
            self.known[n, p] = update_scratch(n, p)
        return self.known[n, p]


_scratches = _Scratches()


def lower_root(root: FloatArray) -> FloatArray:
    """Return the lower triangular S (n, n) with nonnegative diagonal and ``S S' = root root'``
    (n, c).
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
    """Use the scalar observation with ``h S = row[m]`` and noise variance ``pivot``^2; the gain is
    ``gains[m]`` (n,) over the value that is returned, the standard deviation of the innovation.
    """
    # [pivot, h S; 0, S] times rotations that empty h S from its end, so that S stays triangular.
    n = len(size)
    for i in range(n):
        gains[m, i] = 0.0
    square = pivot * pivot  # summed up, so that no square root waits for another
    # From the last column on: rotation j touches rows i >= j only, where S has entries.
    for j in range(n - 1, -1, -1):
        entry = row[m, j]
        if entry != 0.0:
            square += entry * entry
            whole = math.sqrt(square)
            inverse = 1.0 / whole
            c, s = pivot * inverse, entry * inverse
            pivot = whole
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
    """Use the sample ``y = H x + v``: y (p,), H (p, n), ``root_R`` (p, p) lower triangular
    and regular.

    ``y`` is overwritten with the normalised innovation: its squares sum to the NIS, and its entries
    are independent standard normals where the filter is consistent.
    """
    # [root_R, H S; 0, S] is made lower triangular, [C, 0; gains', S+], row by row of H.
    p, n, size = len(y), len(scratch.size), scratch.size
    C, HS, gains = scratch.C, scratch.HS, scratch.gains
    for r in range(p):
        # rotate_rows() changes C below the diagonal, so it starts from a fresh copy of root_R.
        for m in range(r + 1):
            C[r, m] = root_R[r, m]
        seen = 0.0
        for j in range(n):
            total = 0.0
            for i in range(j, n):
                total += H[r, i] * root[k, i, j]
            HS[r, j] = total
            # H x, for the innovation y - H x with the x before any row is used.
            seen += H[r, j] * x[k, j]
        y[r] -= seen
    # Row by row, C becomes the root of H P H' + R.
    for r in range(p):
        # The last row has no rows below it to turn.
        if r == p - 1:
            C[r, r] = rotate_out(size, root, k, HS, r, gains, C[r, r])
        else:
            rotate_rows(root, k, C, HS, gains, r, p)
        # Forward substitution: y <- C^-1 (y - H x), the normalised innovation.
        total = y[r]
        for m in range(r):
            total -= C[r, m] * y[m]
        y[r] = total / C[r, r] if C[r, r] != 0.0 else 0.0
        # x += gains' C^-1 (y - H x) = K (y - H x).
        for i in range(n):
            x[k, i] += gains[r, i] * y[r]


@kernel
def rotate_rows(
    root: FloatArray, k: int, C: FloatArray, HS: FloatArray, gains: FloatArray, r: int, p: int
) -> None:
    """Apply ``rotate_out`` to row ``r`` of p, which turns the rows of the observation
    below it too.
    """
    n = root.shape[1]
    for i in range(n):
        gains[r, i] = 0.0
    for j in range(n - 1, -1, -1):
        size = HS[r, j]
        if size != 0.0:
            whole = math.sqrt(C[r, r] * C[r, r] + size * size)
            c, s = C[r, r] / whole, size / whole
            C[r, r] = whole
            # Rows of the observation that are still to be used turn along.
            for i in range(r + 1, p):
                old, gain = HS[i, j], C[i, r]
                HS[i, j] = c * old - s * gain
                C[i, r] = s * old + c * gain
            # Column j of S and the gain turn last; S stays lower triangular.
            for i in range(j, n):
                old, gain = root[k, i, j], gains[r, i]
                root[k, i, j] = c * old - s * gain
                gains[r, i] = s * old + c * gain


def update_with_sample(
    root: FloatArray, x: FloatArray, y: FloatArray, H: FloatArray, root_R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return root (n, n), x (n,) and normalised innovation (p,) once the sample y (p,) is used."""
    n = len(x)
    roots, means, innovation = root.reshape(1, n, n).copy(), x.reshape(1, n).copy(), y.copy()
    sample_root(roots, means, 0, innovation, H, root_R, _scratches.of(n, len(y)))
    return roots[0], means[0], innovation


# Convex combinations.


@kernel(inlined=True)
def scale_root(size: Size, root: FloatArray, x: FloatArray, k: int, weight: float) -> None:
    """Weigh place ``k`` alone: ``weight`` >= 0 times P and x."""
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
    """Add ``weight`` >= 0 times P and x of place ``m`` of ``other`` (M, n, n), ``other_x``."""
    size, n, factor = scratch.size, len(scratch.size), math.sqrt(weight)
    # [S, sqrt(w) S_m]: the convex combination of H (7), one term at a time.
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
    """Make S (n, n, L) the root of ``S S' + wide wide'``; both are lower triangular, and ``wide``
    is used up.
    """
    for i in range(len(size)):
        pivot, below = load(lanes, S, i, i), spread(lanes, 0.0)
        for j in range(i + 1):
            below += load(lanes, wide, i, j) * load(lanes, wide, i, j)
        square = pivot * pivot
        # Column i of S with the columns of ``wide`` that reach row i.
        active = below > NEGLIGIBLE * square + TINY
        reflect_row(lanes, size, i, i + 1, S, wide, square + below, active)


def combine_roots(
    weights: FloatArray, means: FloatArray, roots: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return ``sum w_j x_j`` (n,) and the root of ``sum w_j P_j`` (n, n), for weights (k,), means
    (k, n) and roots (k, n, n).
    """
    x, root = means[:1].copy(), roots[:1].copy()
    scratch = _scratches.of(means.shape[1], 1)
    scale_root(scratch.size, root, x, 0, float(weights[0]))
    for m in range(1, len(weights)):
        add_root(root, x, 0, float(weights[m]), roots, means, m, scratch)
    return x[0], root[0]


# Covariance intersection, D (8) and (9): information is a root too, P^-1 = Z' Z.


@kernel(inlined=True)
def begin_intersection(scratch: UpdateScratch) -> None:
    """Forget what was intersected before."""
    # Zero information: Z = 0.
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
    """Add ``weight`` times the information of place ``k``; means count from ``centre[m]``, which
    must be the same for all terms of one intersection.
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
    """Make ``total`` (n, n + 1) the root of both informations, means in the last column;
    ``whitened`` (n, n + 1) is used up.
    """
    # Both are lower triangular, and stay so when columns are emptied from the last one on.
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
    """Write ``factor`` times the inverse of place ``k`` into ``out`` (n, >= n), lower triangular.

    Soon after a start from 0 the noise has reached some combinations of states only to rounding:
    pivots are at least SINGULAR of their row, which makes P no smaller.
    """
    # The floor grows with the whole root, so that a zero row is not inverted on its own scale.
    n, least = root.shape[1], TINY
    for i in range(n):
        for j in range(i + 1):
            least += NEGLIGIBLE * root[k, i, j] * root[k, i, j]
    for i in range(n):
        row = least
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
    """Write the intersection into place ``k``; nan where nothing was added."""
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
    for i in range(n):  # ``centre`` may be x itself
        x[k, i] = whitened[i, n]


def intersect_roots(
    weights: FloatArray, means: FloatArray, roots: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Estimate (n,) and root (n, n) of D (8), (9), for weights (k,), means (k, n) and roots
    (k, n, n).
    """
    x, root = means[:1].copy(), np.zeros_like(roots[:1])
    scratch = _scratches.of(means.shape[1], 1)
    begin_intersection(scratch)
    for m in range(len(weights)):
        add_to_intersection(float(weights[m]), roots, means, m, means, 0, scratch)
    end_intersection(root, x, 0, means, 0, scratch)
    return x[0], root[0]
