"""Linear equations of H(12) made linear: ``op_P(X) = -right`` for all nodes together.

Few unknowns are eliminated, and many where the network has small cuts (rings, rows, narrow grids).
Elsewhere elimination fills in (1000 nodes of a random graph would take minutes), so many unknowns
are found by GMRES, each node's own block inverted beforehand; what does not converge is eliminated
after all if that is possible at all.
"""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse.linalg

from netkf.linalg.arrays import FloatArray
from netkf.theory.hybrid.packed import Linear, Packed

FEW_UNKNOWNS = 2000
ROUNDS, GAIN = 4, 1e-7  # each round solves for what the one before has left
PRECISE = 1e-14
RESTART, RESTARTS = 60, 3


def solved(packed: Packed, P: FloatArray, right: FloatArray) -> FloatArray:
    """(N, m): rows X of the equation for gains of P (N, n, n), ``right`` (N, m); nan where it is
    singular.
    """
    linear = packed.linear(P)
    few = right.size <= FEW_UNKNOWNS or packed.eliminates_cheaply
    with np.errstate(all="ignore"):
        X = None if few else _iterated(linear, right)
        return _eliminated(linear, right) if X is None else X


def _eliminated(linear: Linear, right: FloatArray) -> FloatArray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.sparse.linalg.MatrixRankWarning)
        X = scipy.sparse.linalg.spsolve(linear.matrix(), -right.reshape(-1))
    return np.asarray(X).reshape(right.shape)


def _iterated(linear: Linear, right: FloatArray) -> FloatArray | None:
    """None where it does not converge."""
    blocks = linear.blocks
    try:
        inverse = np.linalg.inv(blocks)
    except np.linalg.LinAlgError:
        return None

    def applied(x: FloatArray) -> FloatArray:
        X = x.reshape(right.shape)
        return np.asarray(np.einsum("ik,ikl->il", X, blocks) + linear.arriving(X)).reshape(-1)

    def alone(x: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ik,ikl->il", x.reshape(right.shape), inverse)).reshape(-1)

    shape = (right.size, right.size)
    operator = scipy.sparse.linalg.LinearOperator(shape, matvec=applied, dtype=np.float64)
    own = scipy.sparse.linalg.LinearOperator(shape, matvec=alone, dtype=np.float64)
    x, left, size = np.zeros(right.size), -right.reshape(-1), float(np.linalg.norm(right))
    for _ in range(ROUNDS):
        step, failed = scipy.sparse.linalg.gmres(
            operator, left, rtol=GAIN, M=own, restart=RESTART, maxiter=RESTARTS
        )
        if failed or not np.isfinite(step).all():
            return None
        x = x + step
        left = -right.reshape(-1) - applied(x)
        if np.linalg.norm(left) <= PRECISE * size:
            break
    return np.asarray(x).reshape(right.shape)
