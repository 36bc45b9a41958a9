"""Covariance intersection in continuous time: the combination of D (8), (9) over link clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from netkf.algorithms.filter import Exchange, Message, State
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.intersection import intersected
from netkf.algorithms.root_update import intersect_roots
from netkf.core.arrays import FloatArray
from netkf.core.compiling import compilable
from netkf.core.small import fill_square, product

SINGULAR = 1e-15  # least eigenvalue that counts, relative to the largest
TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False)
class CovarianceIntersection(Hybrid):
    """The hybrid filter with covariance intersection in place of convex resets: weight ``epsilon``
    for each active neighbour and the rest for oneself.

    P after a reset is at most the convex reset's, and the Riccati flow keeps that order, so H (12)
    bounds E[P_i] here too; and P_i stays at least the covariance of the error, H (10).
    """

    inverts: ClassVar[bool] = True

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        """D (8) and (9) with values from before the reset."""
        weights, means, roots = self._pairs(state, messages)
        xhat, root = intersect_roots(weights, means, roots)
        return state._replace(xhat=xhat, root=root)

    def shift(self, state: State, offset: FloatArray) -> State:
        """Affine: the weights sum to one."""
        return state._replace(xhat=state.xhat + offset)


@compilable
def intersected_pairs(
    weights: FloatArray, means: FloatArray, P: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """D (8) and (9) of weights (k,), estimates (k, n) and their covariances (k, n, n): ``xhat``
    (n,) and P (n, n).
    """
    roots = np.empty(P.shape)
    for m in range(len(P)):
        fill_square(roots[m], invertible_root(P[m]))
    xhat, root = intersected(weights, means, roots)
    return xhat, product(root, root.T)


@compilable
def invertible_root(P: FloatArray) -> FloatArray:
    """A root that can be inverted: soon after a start from 0 the noise has reached some
    combinations of states only to rounding. Nan where P is not finite.
    """
    if not np.isfinite(P).all():
        return np.full(P.shape, np.nan)
    n = len(P)
    scale = np.sqrt(np.maximum(np.diag(P), TINY))
    scaled = P / np.outer(scale, scale)
    if not np.isfinite(scaled).all():
        return np.full(P.shape, np.nan)
    values, vectors = np.linalg.eigh(scaled)
    floor = SINGULAR * max(values[n - 1], TINY)
    return np.asarray(scale.reshape(n, 1) * vectors * np.sqrt(np.maximum(values, floor)))
