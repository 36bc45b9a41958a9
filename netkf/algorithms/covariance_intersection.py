"""Covariance intersection in continuous time: the combination of Xie, Gan and Liu, paper D (8) and
(9), in the hybrid filter of Tanwani, paper H.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from netkf.algorithms.diffusion import DiffusionFilter, diffusion_filter_record
from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.hybrid import Hybrid
from netkf.algorithms.records import Record, begin_estimate
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Needs


def intersection_record(_: Any, infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
    """Return the record of the diffusion filter with ``on_loss = "keep-own"``, by which the weight
    of all that arrives decides the own one.
    """
    record = diffusion_filter_record(DiffusionFilter(on_loss="keep-own"), infos, models)
    return replace(record, transient=("own", "inverse"))


@built_in("covariance-intersection")
@dataclass(frozen=True, eq=False)
class CovarianceIntersection(Hybrid):
    """The hybrid filter with covariance intersection in place of convex resets: weight ``epsilon``
    for each neighbour heard and the rest for the node itself.

    P after a reset is at most that of the convex reset, and the Riccati equation keeps that order,
    so the bound of paper H (12) on E[P_i] holds here too; and P_i stays at least the covariance of
    the error, paper H (10).
    """

    needs = Needs(inverts=True)
    kernels = replace(
        DiffusionFilter.kernels, record=intersection_record, begin=begin_estimate, unrolled=True
    )

    shift = Filter.shift  # affine: the weights sum to one
