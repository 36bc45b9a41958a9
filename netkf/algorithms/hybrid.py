"""The hybrid Kalman-Bucy filter of Tanwani (CDC 2021), H (4), (7), (9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from netkf.algorithms.flow import FlowFilter, FlowState, Payload, predict
from netkf.core.arrays import FloatArray
from netkf.core.compiling import compilable_as, in_place
from netkf.core.fields import number, setting


@dataclass(frozen=True, eq=False)
class Hybrid(FlowFilter):
    """Convex resets of estimate and covariance with weight ``epsilon`` for each active neighbour.

    ``epsilon`` is the off-diagonal entry of ``Pi = I - epsilon L``, H (5): 0 < epsilon <= 1/max
    degree. A message that took its time is predicted to its arrival first.
    """

    epsilon: float = setting(number(above=0.0, high=1.0))

    def absorb(
        self, state: FlowState, messages: Sequence[tuple[float, Payload, float]]
    ) -> FlowState:
        """H (7) and (9): all right-hand sides are values from before the reset."""
        own = 1.0 - sum(weight for weight, _, _ in messages)
        xhat, P = own * state.xhat, own * state.P
        for weight, payload, age in messages:
            other, other_P = predict(state.model, payload, age)
            add_neighbour(xhat[None], P[None], 0, weight, other[None], other_P[None], 0)
        return state._replace(xhat=xhat, P=P)

    def weight(self, degree: int, peer_degree: int) -> float:
        """``epsilon`` on every link."""
        return self.epsilon

    def largest_degree(self) -> float:
        """``1 / epsilon``: beyond it a node's own weight would be negative."""
        return (1.0 + 1e-12) / self.epsilon


@in_place
def _add_loops(
    xhat: FloatArray,
    P: FloatArray,
    k: int,
    weight: float,
    other: FloatArray,
    other_P: FloatArray,
    m: int,
) -> None:
    for i in range(xhat.shape[1]):
        xhat[k, i] += weight * other[m, i]
        for j in range(xhat.shape[1]):
            P[k, i, j] += weight * other_P[m, i, j]


@compilable_as(_add_loops)
def add_neighbour(
    xhat: FloatArray,
    P: FloatArray,
    k: int,
    weight: float,
    other: FloatArray,
    other_P: FloatArray,
    m: int,
) -> None:
    """Put one more neighbour, place ``m`` of (M, n) and (M, n, n), into the partial sums of H (7)
    and (9) at place ``k`` of (K, n) and (K, n, n).
    """
    xhat[k] += weight * other[m]
    P[k] += weight * other_P[m]
