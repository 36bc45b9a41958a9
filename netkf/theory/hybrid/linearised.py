"""Linear equations ``op_P(X) = -right``, with H(12) linearised at P, for all nodes together.

Few unknowns are eliminated, and many if the network has small cuts (rings, rows, narrow grids).
In other networks the fill-in is large (1000 nodes of a random graph would take minutes): GMRES
solves for many unknowns, preconditioned by each node's own block and by that of all nodes together
(fast links make all nodes change together, slowly), and elimination only if GMRES does not
converge and the unknowns are not too many for it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.theory.hybrid.dense import solve_or_nan
from netkf.theory.hybrid.packed import MAX_PACKED, LinearisedRiccati

MAX_CONDITION = 1e13
"""A map whose slowest time constant is longer, in units of the fastest, is singular but for
rounding."""
FEW_UNKNOWNS = 2000  # elimination of a full matrix of that size takes a second
MAX_ELIMINATED = 6000  # unknowns of a network without small cuts, whose fill-in is nearly full
ROUNDS, ROUND_TOLERANCE = 4, 1e-7  # each round reduces the residual by this factor
RESIDUAL_TOLERANCE = 1e-14  # relative to the right-hand side
RESTART, RESTARTS = 60, 3  # of GMRES
Rows = Callable[[FloatArray], FloatArray]


def solve_map(
    linear: LinearisedRiccati, right: FloatArray, tolerance: float = RESIDUAL_TOLERANCE
) -> FloatArray:
    """Return X (N, m) with ``linear(X) = -right`` to a relative ``tolerance``, nan if singular;
    raises TheoryError for too many unknowns.
    """
    eliminates = right.size <= FEW_UNKNOWNS or linear.packed.eliminates_cheaply
    with np.errstate(all="ignore"):
        X = None if eliminates else _solve_by_gmres(linear, right, tolerance)
        if X is None and not eliminates and right.size > MAX_ELIMINATED:
            raise TheoryError(
                f"not computed: GMRES did not converge for {right.size:,} unknowns, and the "
                "network has no small cuts to eliminate them by"
            )
        if X is not None:
            return X
        if linear.packed.is_full:
            return solve_or_nan(linear.full_matrix(), -right.reshape(-1)).reshape(right.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.sparse.linalg.MatrixRankWarning)
            # A singular map yields nan, which the caller takes as unstable.
            X = scipy.sparse.linalg.spsolve(linear.matrix(), -right.reshape(-1))
    return np.asarray(X).reshape(right.shape)


def is_stable(linear: LinearisedRiccati) -> bool:
    """Return True if solutions of ``dX/dt = linear(X)`` vanish, if and only if X for -I is positive
    definite; raises TheoryError for too many unknowns.
    """
    packed = linear.packed
    P = packed.equations.start
    right = packed.pack(np.broadcast_to(np.eye(P.shape[-1]), P.shape))
    X = packed.unpack(solve_map(linear, right, 0.1 / float(np.linalg.norm(right))))
    if not np.isfinite(X).all():
        return False
    values = np.linalg.eigvalsh(X)
    # Of a singular map, such as that of a plant without damping that nobody observes, X is the
    # inverse of a rounding error, of either sign.
    slowest = values.max() * 2.0 * float(np.abs(linear.drifts).max())
    return bool(values.min() > 0.0 and slowest < MAX_CONDITION)


def _solve_by_gmres(
    linear: LinearisedRiccati, right: FloatArray, tolerance: float
) -> FloatArray | None:
    """Return X (N, m) of ``L(X) = -right`` by refined GMRES; None if it diverges."""
    try:
        roughly_inverse = _rough_inverse(linear)
    except np.linalg.LinAlgError:
        return None

    def as_operator(rows: Rows) -> scipy.sparse.linalg.LinearOperator:
        """Return the operator on vectors (N m,) that ``rows`` is on rows (N, m)."""
        return scipy.sparse.linalg.LinearOperator(
            (right.size, right.size),
            matvec=lambda x: rows(x.reshape(right.shape)).reshape(-1),
            dtype=np.float64,
        )

    operator, preconditioner = as_operator(linear.change), as_operator(roughly_inverse)
    # Iterative refinement: each round solves for the residual that the last one left.
    x, residual, size = np.zeros(right.size), -right.reshape(-1), float(np.linalg.norm(right))
    for _ in range(ROUNDS):
        step, failed = scipy.sparse.linalg.gmres(
            operator,
            residual,
            rtol=max(ROUND_TOLERANCE, tolerance),
            M=preconditioner,
            restart=RESTART,
            maxiter=RESTARTS,
        )
        if failed or not np.isfinite(step).all():
            return None
        x = x + step
        residual = -right.reshape(-1) - operator @ x
        if np.linalg.norm(residual) <= tolerance * size:
            break
    return np.asarray(x).reshape(right.shape)


def _rough_inverse(linear: LinearisedRiccati) -> Rows:
    """Return roughly ``L^-1`` of rows X (N, m), or LinAlgError."""
    packed, n = linear.packed, linear.drifts.shape[1]
    if n <= MAX_PACKED:
        shared, inverse = linear.shared_map(), np.linalg.inv(linear.blocks)
        coarse = np.linalg.inv(shared.mean(axis=0))
        # What is left of a shared row c after each node alone: c - (c L) L_i^-1.
        rest = np.eye(packed.m) - shared @ inverse

        def solve(X: FloatArray) -> FloatArray:
            alone, common = np.einsum("ik,ikl->il", X, inverse), X.mean(axis=0) @ coarse
            return np.asarray(alone + np.einsum("k,ikl->il", common, rest))

        return solve
    # m^3 operations are too many: Lyapunov equations take n^3. They leave out what samples add to
    # drifts, and what the prediction over a delay changes.
    kinds, kind = np.unique(linear.drifts.reshape(-1, n * n), axis=0, return_inverse=True)
    kind = kind.reshape(-1)  # numpy 2.0 gives (N, 1)
    solvers = [_lyapunov_solver(F.reshape(n, n)) for F in kinds]
    arriving = sum(float(rates.sum()) for rates, _, _ in linear.heard) / len(linear.drifts)
    solve_shared = _lyapunov_solver(linear.drifts.mean(axis=0) + 0.5 * arriving * np.eye(n))

    def solve_wide(X: FloatArray) -> FloatArray:
        shared = np.tile(packed.pack(solve_shared(packed.unpack(X.mean(axis=0)))), (len(X), 1))
        rest = packed.unpack(X - linear.change(shared))
        alone = [solvers[k](R) for k, R in zip(kind, rest, strict=True)]
        return np.asarray(shared + packed.pack(np.stack(alone)))

    return solve_wide


def _lyapunov_solver(F: FloatArray) -> Rows:
    """Return the function of R (n, n) that solves ``F X + X F' = R`` (Bartels and Stewart 1972)."""
    T, U = scipy.linalg.schur(F)

    def solve(R: FloatArray) -> FloatArray:
        X, scale, _ = scipy.linalg.lapack.dtrsyl(T, T, U.T @ R @ U, tranb="T")
        return np.asarray(U @ X @ U.T / scale)

    return solve
