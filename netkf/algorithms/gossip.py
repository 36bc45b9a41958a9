"""The gossip interactive Kalman filter of Kar and Moura, paper G (10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from netkf.algorithms.filter import Filter
from netkf.algorithms.kernels.run import carry, copy_estimate
from netkf.algorithms.records import Kernels
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Timing
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load_flags


@kernel
def swap(record: Any, h: int, run: Any) -> None:
    """Replace the estimate of node ``h`` by the one that arrives; of several, the last sender's."""
    payload = record.payload
    for k in range(run.count):
        m, arrived = run.message[k], load_flags(run.lanes, run.arrived, k)
        carry(run.model, run, payload.xhat, payload.root, m, run.age[k])
        copy_estimate(run, record.xhat, record.root, h, payload.xhat, payload.root, m, arrived)


@built_in("gossip")
@dataclass(frozen=True, eq=False)
class Gossip(Filter):
    """Paired nodes swap the pair (xhat, P) and go on with each other's; samples are predictions.

    In slots paired nodes first swap, then each updates with its own reading and predicts; nothing
    is swapped in slot 0. Under link clocks both ends of a link swap when it ticks. A node whose
    partner's message is lost keeps its own pair: if only one direction fails, one pair is copied
    and the other is gone. Of several pairs that arrive at one instant the last sender's counts.
    """

    analysis = Analysis(paper="gossip", swaps=True)
    timing = Timing(
        schedule=("exchange", "sense", "predict"), clocks=("links",), predicts=True, pairwise=True
    )
    kernels = Kernels(absorb=swap, unrolled=True)

    shift = Filter.shift  # affine in readings and messages
