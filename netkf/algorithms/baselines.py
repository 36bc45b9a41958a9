"""The two baselines of every comparison: no communication, and all readings at one place."""

from __future__ import annotations

from dataclasses import dataclass, replace

from netkf.algorithms.filter import Filter
from netkf.algorithms.records import Kernels
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Timing


@built_in("local")
@dataclass(frozen=True, eq=False)
class Local(Filter):
    """Every node runs a Kalman(-Bucy) filter on its own readings and never talks; samples in slots
    are filtered.
    """

    timing = Timing(schedule=("predict", "sense"), clocks=(), talks=False)
    kernels = Kernels()

    shift = Filter.shift  # affine in the readings


@built_in("central")
@dataclass(frozen=True, eq=False)
class Central(Local):
    """One Kalman(-Bucy) filter reads all sensors without delay or loss; its estimate is recorded
    for every node.
    """

    timing = replace(Local.timing, pooled=True)
