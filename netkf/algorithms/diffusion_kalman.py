"""The diffusion Kalman filter: Cattivelli and Sayed, "Diffusion strategies for distributed Kalman
filtering and smoothing", IEEE Trans. Automatic Control 55, 2010, Algorithm 1.

In each slot nodes first exchange readings and update with all that they hear (step 1: the result is
psi), then exchange psi and form weighted means (step 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.estimates import copy_vector
from netkf.algorithms.kernels.neighbours import use_readings_heard
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.algorithms.weights import WeightedFilter
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, load_flags, select, spread, store

READINGS, ESTIMATES = 0, 1
"""Numbers of the two exchanges of a slot, ``Exchange.phase``."""


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send psi; the reading of this slot goes with the message."""
    copy_vector(run.lanes, run.size, record.payload.xhat, m, record.xhat, h, True)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Use the readings heard, step 1 of Algorithm 1, or form the weighted mean of estimates, step
    2: ``xhat_i = psi_i + sum_l c_{l,i} (psi_l - psi_i)``, so that equal estimates stay to the last
    bit.
    """
    if run.phase == READINGS:
        use_readings_heard(record, h, run)
        return
    lanes, x, heard = run.lanes, record.xhat, record.payload.xhat
    for i in range(len(run.size)):
        own, total = load(lanes, x, h, i), spread(lanes, 0.0)
        for k in range(run.count):
            arrived = load_flags(lanes, run.arrived, k)
            change = run.message_weight[k] * (load(lanes, heard, run.message[k], i) - own)
            total += select(arrived, change, 0.0)
        store(lanes, x, h, i, own + total)


def diffusion_message_size(n: int, rows: int, phase: int) -> int:
    """Return how many numbers a message has: y, H and R of ``rows`` rows, or psi of n states."""
    return n if phase == ESTIMATES else rows * (1 + n) + rows * (rows + 1) // 2


def diffusion_kalman_record(_: Any, _infos: Sequence[NodeInfo], models: Sequence[Any]) -> Record:
    """Return the estimate that messages carry."""
    return Record(payload={"xhat": (len(models[0].information),)})


@built_in("diffusion-kalman")
@dataclass(frozen=True, eq=False)
class DiffusionKalman(WeightedFilter):
    """Update with the readings of the neighbourhood, then combine the neighbours' estimates.

    weights entry [l][i] is the weight c_{l,i} that node i gives to what node l sends, in the order
            of node ids: columns sum to 1; or "metropolis", 1 / (1 + max degree) for each link and
            the rest for the node itself

    The weight of an estimate that does not come stays with the node itself. P counts the readings
    that a node has used; the combination leaves it as it is, so it is no bound on the error.
    """

    analysis = Analysis(
        paper="diffusion_kalman",
        tells_estimates=lambda phase: phase != READINGS,
        payload_numbers=diffusion_message_size,
    )
    timing = Timing(
        schedule=("predict", "sense", "exchange", "exchange"),
        clocks=(),
        sends=lambda phase, has_sensor: has_sensor or phase == ESTIMATES,
    )
    needs = Needs(one_way=True)
    kernels = Kernels(emit=emit, absorb=absorb, sends_readings=True, record=diffusion_kalman_record)

    shift = Filter.shift  # affine: the weights sum to one
