"""The hybrid Kalman-Bucy filter of Tanwani (CDC 2021), which is paper H here: (4), (7), (9).

Between messages a node runs the Kalman-Bucy filter (4); messages reset estimate and covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

from netkf.algorithms.filter import Filter
from netkf.algorithms.kernels.neighbours import combine_convex
from netkf.algorithms.records import Kernels
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Timing, Weights
from netkf.core.fields import field, number


@built_in("hybrid")
@dataclass(frozen=True, eq=False)
class Hybrid(Filter):
    """A Kalman-Bucy filter on the node's own readings whose estimate and covariance are reset to
    convex combinations, with weight ``epsilon`` for each neighbour heard.

    ``epsilon`` is the off-diagonal entry of ``Pi = I - epsilon L``, L the graph's Laplacian,
    Tanwani, H (5): 0 < epsilon <= 1/max degree. A delayed message is predicted to its
    arrival first.
    """

    epsilon: float = field(number(above=0.0, high=1.0))

    analysis = Analysis(paper="hybrid", P_by_design=("", "larger"))
    timing = Timing(schedule=None)
    kernels = Kernels(absorb=combine_convex, unrolled=True)

    @property
    def link_weights(self) -> Weights:
        """The weight ``epsilon`` for each link; with more than ``1 / epsilon`` neighbours the
        node's own weight would be negative.
        """
        # A little more, so that rounding of 1 / epsilon excludes no whole number.
        return Weights(lambda _, __: self.epsilon, largest_degree=(1.0 + 1e-12) / self.epsilon)

    shift = Filter.shift  # affine: the weights sum to one
