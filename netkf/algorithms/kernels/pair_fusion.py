"""Kernels of track fusion: they fuse two estimates of unknown correlation, with the optimal weight.

With ``P_a = W W'`` and ``P_b = W diag(b) W'`` both covariances are diagonal in one basis W, and so
is the fused one. The weight w minimises the trace or determinant of

* covariance intersection (Julier and Uhlmann, ACC 1997): ``P^-1 = w P_a^-1 + (1 - w) P_b^-1``;
* inverse covariance intersection (Noack, Sijs, Reinhardt and Hanebeck, Automatica 79, 2017):
  ``P^-1 = P_a^-1 + P_b^-1 - (w P_a + (1 - w) P_b)^-1``.

In that basis each entry of P and its logarithm are convex in w, so that the minimum is where the
derivative changes its sign. Bisection of the derivative finds w to full precision; a search for the
least value itself would find only half of the digits.
"""

from __future__ import annotations

import math

from netkf.algorithms.kernels.intersection import SINGULAR, TINY
from netkf.algorithms.kernels.square_root import NEGLIGIBLE, triangularise
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE

SWEEPS, BISECTIONS = 40, 60  # at most, of Jacobi rotations; and for full precision of w in [0, 1]
ORTHOGONAL = 1e-15
"""Cosine of columns that count as orthogonal."""
EQUAL = 1e-9
"""Relative difference of all variances up to which both covariances count as the same. Then w is
1/2, since rounding would decide otherwise.
"""


@kernel
def common_basis(
    own: FloatArray, other: FloatArray, U: FloatArray, W: FloatArray, b: FloatArray
) -> None:
    """Write an orthogonal U, ``W = own U`` (n, n each) and b (n,) with ``own own' = W W'`` and
    ``other other' = W diag(b) W'``: a basis in which both covariances are diagonal, with variances
    1 and b. ``own`` and ``other`` (n, n) are lower triangular roots, which are made regular: the
    diagonal of ``own`` is changed (``regular_diagonal``).
    """
    n = len(b)
    for i in range(n):
        own[i, i] = regular_diagonal(own, i)
    # T = own^-1 other, by forward substitution.
    for j in range(n):
        for i in range(n):
            value = other[i, j] if j < i else regular_diagonal(other, i) if j == i else 0.0
            for m in range(j, i):
                value -= own[i, m] * U[m, j]
            U[i, j] = value / own[i, i] if j <= i else 0.0
    # One-sided Jacobi rotations make the columns of T orthogonal: T V = U diag(b)^1/2. So T T' =
    # U diag(b) U', and P_b = own T T' own' = W diag(b) W'. T is in the memory of U.
    for _ in range(SWEEPS):
        if orthogonalise(U) <= ORTHOGONAL:
            break
    for j in range(n):
        b[j] = 0.0
        for i in range(n):
            b[j] += U[i, j] * U[i, j]
        for i in range(n):
            U[i, j] /= math.sqrt(b[j])
        for i in range(n):
            W[i, j] = 0.0
            for m in range(i + 1):
                W[i, j] += own[i, m] * U[m, j]


@kernel
def regular_diagonal(root: FloatArray, i: int) -> float:
    """Return entry ``i`` of the diagonal of a lower triangular ``root`` (n, n), in size at least
    SINGULAR (2^-25) times the length of its row: what is smaller is rounding, and two such roots
    would be thin in directions that rounding tells apart, and their fusion overconfident. P gets
    no smaller.
    """
    # As in ``intersection.invert_lanes``, the floor grows with the whole root.
    square = TINY
    for k in range(len(root)):
        share = 1.0 if k == i else NEGLIGIBLE
        for j in range(k + 1):
            square += share * root[k, j] * root[k, j]
    return math.copysign(max(abs(root[i, i]), SINGULAR * math.sqrt(square)), root[i, i])


@kernel
def orthogonalise(T: FloatArray) -> float:
    """Do one sweep of one-sided Jacobi rotations of T (n, n), regular, in place: each pair of
    columns in turn is rotated to be orthogonal.

    Return the largest |cosine| between two columns before their rotation. A later rotation spoils
    earlier pairs a little, so the caller repeats sweeps until it is at most ORTHOGONAL.
    """
    n, largest = len(T), 0.0
    for p in range(n - 1):
        for q in range(p + 1, n):
            pp = qq = pq = 0.0
            for i in range(n):
                pp += T[i, p] * T[i, p]
                qq += T[i, q] * T[i, q]
                pq += T[i, p] * T[i, q]
            cosine = abs(pq) / math.sqrt(pp * qq)
            largest = max(largest, cosine)
            if cosine <= ORTHOGONAL:
                continue
            # The Jacobi rotation that makes columns p and q orthogonal: cotangent is that of twice
            # its angle. Of the two roots the smaller tangent is taken, for which sweeps converge.
            cotangent = 0.5 * (qq - pp) / pq
            tangent = math.copysign(1.0, cotangent) / (
                abs(cotangent) + math.sqrt(1.0 + cotangent * cotangent)
            )
            c = 1.0 / math.sqrt(1.0 + tangent * tangent)
            s = c * tangent
            for i in range(n):
                first, second = T[i, p], T[i, q]
                T[i, p] = c * first - s * second
                T[i, q] = s * first + c * second
    return largest


@kernel(inlined=True)
def fused_variance(w: float, b: float, inverse: bool) -> float:
    """Return the variance of the fusion of two scalar estimates with variances 1 (weight ``w``) and
    ``b`` (weight 1 - w), by covariance intersection, the inverse one if ``inverse``.
    """
    # 1/p = 1 + 1/b - 1/m with m = w + (1 - w) b, or 1/p = w + (1 - w) / b.
    if inverse:
        mixed = w + (1.0 - w) * b
        return b * mixed / ((1.0 + b) * mixed - b)
    return b / (w * b + 1.0 - w)


@kernel
def slope(w: float, W: FloatArray, b: FloatArray, inverse: bool, trace: bool) -> float:
    """Return the derivative by ``w`` of the criterion: the trace of the fused P, or the logarithm
    of its determinant unless ``trace``.

    ``W`` (n, n) and ``b`` (n,) are those of ``common_basis``: both covariances are diagonal in the
    basis W, with variances 1 (weight w) and b (weight 1 - w). ``inverse`` chooses the fusion, see
    ``fused_variance``.
    """
    total = 0.0
    for k in range(len(b)):
        p = fused_variance(w, b[k], inverse)
        if inverse:
            # p = b m / ((1 + b) m - b) with m = w + (1 - w) b, so that dp/dm = -(p / m)^2.
            ratio = p / (w + (1.0 - w) * b[k])
            dp = -ratio * ratio * (1.0 - b[k])
        else:
            # p = b / (w b + 1 - w).
            dp = p * p * (1.0 - b[k]) / b[k]
        # trace(P) = sum |W_k|^2 p_k, log det(P) = const + sum log p_k.
        if trace:
            square = 0.0
            for i in range(len(b)):
                square += W[i, k] * W[i, k]
            total += square * dp
        else:
            total += dp / p
    return total


@kernel
def best_weight(W: FloatArray, b: FloatArray, inverse: bool, trace: bool) -> float:
    """Return the weight w in [0, 1] of the first of two estimates that minimises the trace of the
    fused P, or its determinant unless ``trace``.

    In the basis ``W`` (n, n) both covariances are diagonal, with variances 1 and ``b`` (n,).
    ``inverse``: inverse covariance intersection, else covariance intersection.
    """
    difference = 0.0
    for k in range(len(b)):
        difference = max(difference, abs(b[k] - 1.0))
    if difference <= EQUAL:
        return 0.5
    # The criterion is convex: without a change of sign in (0, 1) its minimum is at an end.
    if slope(0.0, W, b, inverse, trace) >= 0.0:
        return 0.0
    if slope(1.0, W, b, inverse, trace) <= 0.0:
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        w = 0.5 * (low + high)
        if slope(w, W, b, inverse, trace) < 0.0:
            low = w
        else:
            high = w
    return 0.5 * (low + high)


@kernel
def fuse_pair(
    x: FloatArray,
    root: FloatArray,
    other_x: FloatArray,
    other: FloatArray,
    inverse: bool,
    trace: bool,
    work: FloatArray,
) -> None:
    """Fuse an estimate x (n,) with lower triangular ``root`` (n, n), in place, with another one,
    ``other_x`` (n,) with the lower triangular root ``other`` (n, n).

    ``inverse``: inverse covariance intersection, else covariance intersection; ``trace``: the
    weight minimises the trace of P, else its determinant. ``work`` (2 n + 2, n) is scratch.
    """
    n = len(x)
    U, W, b, whitened = work[:n], work[n : 2 * n], work[2 * n], work[2 * n + 1]
    common_basis(root, other, U, W, b)
    w = best_weight(W, b, inverse, trace)
    # whitened = root^-1 (other_x - x).
    for i in range(n):
        value = other_x[i] - x[i]
        for m in range(i):
            value -= root[i, m] * whitened[m]
        whitened[i] = value / root[i, i]
    # x += W diag(gain) W^-1 (other_x - x), with W^-1 = U' root^-1; W becomes W diag(p)^1/2.
    for k in range(n):
        component = 0.0
        for i in range(n):
            component += U[i, k] * whitened[i]
        p = fused_variance(w, b[k], inverse)
        component *= other_gain(p, w, b[k], inverse)
        for i in range(n):
            x[i] += W[i, k] * component
            W[i, k] *= math.sqrt(p)
    # W diag(p)^1/2 is a root of P, to be made lower triangular; U is not needed any more.
    for i in range(n):
        for j in range(i + 1):
            U[i, j] = 0.0
    triangularise(ONE, x, root, W, U)


@kernel(inlined=True)
def other_gain(p: float, w: float, b: float, inverse: bool) -> float:
    """Return the gain (0 to 1) of the other estimate in a direction in which the variances are 1
    (own, weight ``w``), ``b`` (other, weight 1 - w) and ``p`` (fused); ``inverse`` as in
    ``fused_variance``.
    """
    # p times the information that the other one adds to 1/p: (1 - w) / b, or, of inverse
    # intersection, 1/b less its share (1 - w) of the common part 1/m, m = w + (1 - w) b.
    if inverse:
        return p * (1.0 / b - (1.0 - w) / (w + (1.0 - w) * b))
    return p * (1.0 - w) / b
