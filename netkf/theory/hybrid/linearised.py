"""Linear equations ``op_P(X) = -right``, with H(12) linearised at P, for all nodes together.

Few unknowns are eliminated, and many if the network has small cuts (rings, rows, narrow grids).
In other networks the fill-in is large (1000 nodes of a random graph would take minutes): GMRES
solves for many unknowns, preconditioned by each node's own block and by that of all nodes together
(fast links make all nodes change together, slowly), and elimination only if GMRES does not
converge and the unknowns are not too many for it.
"""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.theory.hybrid.packed import LinearisedRiccati

MAX_CONDITION = 1e13
"""A map whose slowest time constant is longer, in units of the fastest, is singular but for
rounding."""
FEW_UNKNOWNS = 2000  # elimination of a full matrix of that size takes a second
MAX_ELIMINATED = 6000  # unknowns of a network without small cuts, whose fill-in is nearly full
ROUNDS, ROUND_TOLERANCE = 4, 1e-7  # each round reduces the residual by this factor
RESIDUAL_TOLERANCE = 1e-14  # relative to the right-hand side
RESTART, RESTARTS = 60, 3  # of GMRES


def solve_map(
    linear: LinearisedRiccati, right: FloatArray, tolerance: float = RESIDUAL_TOLERANCE
) -> FloatArray:
    """Return X (N, m) with ``linear(X) = -right``; nan if the map is singular. The residual is at
    most ``tolerance`` times ``right`` (N, m), or rounding. Raises TheoryError for too many
    unknowns.
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
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.sparse.linalg.MatrixRankWarning)
            # A singular map yields nan, which the caller takes as unstable.
            X = scipy.sparse.linalg.spsolve(linear.matrix(), -right.reshape(-1))
    return np.asarray(X).reshape(right.shape)


def is_stable(linear: LinearisedRiccati) -> bool:
    """Return True if all solutions of ``dX/dt = linear(X)`` vanish with time: as for any generator
    of positive maps, if and only if the solution X for -I is positive definite. Raises TheoryError
    for too many unknowns.
    """
    packed = linear.packed
    P = packed.equations.start
    right = packed.pack(np.broadcast_to(np.eye(P.shape[-1]), P.shape))
    tolerance = 0.1 / float(np.linalg.norm(right))
    X = packed.unpack(solve_map(linear, right, tolerance))
    if not np.isfinite(X).all():
        return False
    values = np.linalg.eigvalsh(X)
    # Of a singular map, such as that of a plant without damping that nobody observes, X is the
    # inverse of a rounding error, of either sign.
    slowest = values.max() * float(np.abs(linear.blocks).max())
    return bool(values.min() > 0.0 and slowest < MAX_CONDITION)


def _solve_by_gmres(
    linear: LinearisedRiccati, right: FloatArray, tolerance: float
) -> FloatArray | None:
    """Return X (N, m) of ``L(X) = -right`` by refined GMRES; None if it diverges."""
    # The preconditioner solves for a change that all nodes share, then inverts each node's block.
    blocks = linear.blocks
    try:
        inverse = np.linalg.inv(blocks)
        coarse = np.linalg.inv(linear.mean_map())
    except np.linalg.LinAlgError:
        return None

    def apply(x: FloatArray) -> FloatArray:
        """Return L(x) (N m,) for a vector x (N m,)."""
        X = x.reshape(right.shape)
        return np.asarray(np.einsum("ik,ikl->il", X, blocks) + linear.arriving(X)).reshape(-1)

    def solve_alone(x: FloatArray) -> FloatArray:
        """Return the solution (N m,) of ``L(X) = x`` for each node alone, without arrivals."""
        return np.asarray(np.einsum("ik,ikl->il", x.reshape(right.shape), inverse)).reshape(-1)

    def precondition(x: FloatArray) -> FloatArray:
        """Return ``L^-1 x`` (N m,) roughly: the mean over nodes exactly, then each node alone."""
        shared = np.tile(x.reshape(right.shape).mean(axis=0) @ coarse, len(right))
        return shared + solve_alone(x - apply(shared))

    shape = (right.size, right.size)
    operator = scipy.sparse.linalg.LinearOperator(shape, matvec=apply, dtype=np.float64)
    preconditioner = scipy.sparse.linalg.LinearOperator(
        shape, matvec=precondition, dtype=np.float64
    )
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
        residual = -right.reshape(-1) - apply(x)
        if np.linalg.norm(residual) <= tolerance * size:
            break
    return np.asarray(x).reshape(right.shape)
