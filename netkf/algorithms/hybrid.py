"""The hybrid Kalman-Bucy filter of Tanwani (CDC 2021), paper H (4), (7), (9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from netkf.algorithms.filter import Exchange, Filter, Message, State
from netkf.algorithms.kernels.root_update import combine_roots
from netkf.algorithms.pairs import weighted_pairs
from netkf.algorithms.registry import built_in
from netkf.core.fields import field, number
from netkf.linalg.arrays import FloatArray


@built_in("hybrid")
@dataclass(frozen=True, eq=False)
class Hybrid(Filter):
    """Convex resets of estimate and covariance with weight ``epsilon`` for each neighbour heard.

    ``epsilon`` is the off-diagonal entry of ``Pi = I - epsilon L``, H (5): 0 < epsilon <= 1/max
    degree. A message that took its time is predicted to its arrival first.
    """

    epsilon: float = field(number(above=0.0, high=1.0))

    paper: ClassVar[str] = "hybrid"
    combination: ClassVar[str] = "convex"
    P_by_design: ClassVar[tuple[str, str]] = ("", "larger")
    schedule: ClassVar[tuple[str, ...] | None] = None

    def absorb(self, state: State, messages: Sequence[Message], exchange: Exchange) -> State:
        """Return the state after a reset by paper H (7) and (9): the convex combination of the
        node's estimate and covariance with those of all messages, all values from before the reset.
        """
        weights, means, roots = self._pairs(state, messages)
        xhat, root = combine_roots(weights, means, roots)
        return state._replace(xhat=xhat, root=root)

    def _pairs(
        self, state: State, messages: Sequence[Message]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return weights (k,), estimates (k, n) and roots (k, n, n) of the node itself, first, and
        of its k - 1 messages, predicted to now.
        """
        return weighted_pairs(state, messages)

    def weight(self, degree: int, peer_degree: int) -> float:
        """Return ``epsilon``, the weight of every link, whatever the degrees of the nodes at its
        ends.
        """
        return self.epsilon

    def largest_degree(self) -> float:
        """Return ``1 / epsilon``; with more neighbours the node's own weight would be negative."""
        return (1.0 + 1e-12) / self.epsilon

    shift = Filter.shift  # affine: the weights sum to one
