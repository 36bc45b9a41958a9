"""Weights that a scenario gives for pairs of nodes, for diffusion filters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from netkf.algorithms.filter import Filter
from netkf.algorithms.traits import Weights
from netkf.core.errors import ScenarioError
from netkf.core.fields import either, field, has_depth, one_of, square
from netkf.linalg.arrays import FloatArray

METROPOLIS = "metropolis"
"""The value in scenario files for weights 1 / (1 + larger degree of both ends) instead of a matrix.
"""


def _check_columns(weights: FloatArray) -> None:
    """Raise ScenarioError unless ``weights`` (N, N) are not negative and columns sum to 1."""
    if (weights < 0.0).any():
        # Weights come from files: the message names the entry.
        where = np.argwhere(weights < 0.0)[0].tolist()
        raise ScenarioError(
            "weights[{}][{}]".format(*where),
            "must not be negative",
            float(weights[tuple(where)]),
            "give weights from 0 to 1",
        )
    sums = weights.sum(axis=0)
    wrong = np.flatnonzero(np.abs(sums - 1.0) > 1e-9)
    if wrong.size:
        raise ScenarioError(
            "weights",
            f"column {wrong[0]}, what node number {wrong[0]} gives, must sum to 1",
            float(sums[wrong[0]]),
            "write the weights that a node gives below each other",
        )


@dataclass(frozen=True, eq=False)
class WeightedFilter(Filter):
    """A filter with a matrix of weights, or Metropolis weights."""

    weights: str | FloatArray = field(
        either(one_of(METROPOLIS), square, has_depth(1)), default=METROPOLIS
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.weights, str):
            _check_columns(self.weights)

    @property
    def link_weights(self) -> Weights:
        """The matrix of weights, or Metropolis weights."""
        return Weights(matrix=None if isinstance(self.weights, str) else self.weights)
