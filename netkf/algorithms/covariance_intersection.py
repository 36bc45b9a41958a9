"""Covariance intersection in continuous time: the combination of D (8), (9) over link clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from netkf.algorithms.flow import FlowState, Payload, predict
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.intersection import intersection
from netkf.core.arrays import FloatArray

SINGULAR = 1e-15  # least eigenvalue that counts, relative to the largest


@dataclass(frozen=True, eq=False)
class CovarianceIntersection(Hybrid):
    """The hybrid filter with covariance intersection in place of convex resets: weight ``epsilon``
    for each active neighbour and the rest for oneself.

    P after a reset is at most the convex reset's, and the Riccati flow keeps that order, so H (12)
    bounds E[P_i] here too; and P_i stays at least the covariance of the error, H (10).
    """

    inverts: ClassVar[bool] = True

    def absorb(
        self, state: FlowState, messages: Sequence[tuple[float, Payload, float]]
    ) -> FlowState:
        """D (8) and (9) with values from before the reset."""
        own = 1.0 - sum(weight for weight, _, _ in messages)
        parts = [(max(own, 0.0), state.xhat, _root(state.P))]
        for weight, payload, age in messages:
            arrived = predict(state.model, payload, age)
            parts.append((weight, arrived.xhat, _root(arrived.P)))
        xhat, root = intersection(parts)
        return state._replace(xhat=xhat, P=root @ root.T)


def _root(P: FloatArray) -> FloatArray:
    """A root that can be inverted: soon after a start from 0 the noise has reached some
    combinations of states only to rounding.
    """
    if not np.isfinite(P).all():
        return np.full_like(P, np.nan)
    scale = np.sqrt(np.maximum(np.diagonal(P), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    floor = SINGULAR * max(values[-1], np.finfo(float).tiny)
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, floor)))
