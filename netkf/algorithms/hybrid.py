"""The hybrid Kalman-Bucy filter of Tanwani (CDC 2021), H (4), (7), (9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from netkf.algorithms.flow import FlowFilter, FlowState, Payload, predict
from netkf.core.arrays import FloatArray
from netkf.core.compiling import compilable
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
            xhat, P = reset(xhat, P, weight, *predict(state.model, payload, age))
        return state._replace(xhat=xhat, P=P)

    def weight(self, degree: int, peer_degree: int) -> float:
        """``epsilon`` on every link."""
        return self.epsilon

    def largest_degree(self) -> float:
        """``1 / epsilon``: beyond it a node's own weight would be negative."""
        return (1.0 + 1e-12) / self.epsilon


@compilable
def reset(
    xhat: FloatArray, P: FloatArray, weight: float, other: FloatArray, other_P: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A partial sum of H (7) and (9) with one more neighbour in it."""
    return xhat + weight * other, P + weight * other_P
