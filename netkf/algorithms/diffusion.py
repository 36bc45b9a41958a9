"""The diffusion filter of Xie, Gan and Liu, which is paper D here: each node updates with its own
readings, then combines its estimate with the neighbours' by covariance intersection.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.algorithms.filter import Filter, NodeInfo
from netkf.algorithms.kernels.intersection import (
    finish_lanes,
    invert_lanes,
    merge_lanes,
    write_information_root,
)
from netkf.algorithms.kernels.neighbours import received_weight
from netkf.algorithms.kernels.run import carry, copy_estimate
from netkf.algorithms.records import Kernels, Record
from netkf.algorithms.registry import built_in
from netkf.algorithms.traits import Analysis, Needs, Timing
from netkf.algorithms.weights import WeightedFilter
from netkf.core.fields import field, one_of
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import any_lane, load, load_flags, select, spread
from netkf.linalg.local import local_lanes_pair


@kernel
def emit(record: Any, h: int, m: int, run: Any) -> None:
    """Send the estimate, and the inverse of its root, computed once for all receivers."""
    payload = record.payload
    copy_estimate(run, payload.xhat, payload.root, m, record.xhat, record.root, h, True)
    invert_lanes(run.lanes, run.size, payload.inverse, m, record.root, h)


@kernel
def absorb(record: Any, h: int, run: Any) -> None:
    """Combine the estimate with those heard by covariance intersection, paper D (8) and (9)."""
    lanes, payload = run.lanes, record.payload
    received = received_weight(run)
    # The weights that are applied sum to 1, see ``DiffusionFilter.on_loss``.
    own, remainder = load(lanes, record.own, h), 1.0 - received
    # Rounding may bring the sum of the others above 1.
    remainder = select(remainder > 0.0, remainder, 0.0)
    # "keep-own", or weights that are all 0: the own weight is 1 minus the others.
    total_weight = spread(lanes, 0.0) if record.keep_own == 1 else own + received
    keeps = total_weight == 0.0
    divisor = select(keeps, 1.0, total_weight)
    own = select(keeps, remainder, own / divisor)
    # With own weight 1 the estimate stays to the last bit.
    if not any_lane(own != 1.0):
        return
    # sum w_j P_j^-1 as a root [Z, z] relative to the own estimate: the own term first, then the
    # others are merged into it.
    x, root = record.xhat, record.root
    total = local_lanes_pair(run.size, lanes, run.total)
    whitened = local_lanes_pair(run.size, lanes, run.whitened)
    invert_lanes(lanes, run.size, record.inverse, h, root, h)
    write_information_root(lanes, run.size, total, own, record.inverse, x, h, x, h)
    for k in range(run.count):
        # A weight of 0 adds no information.
        if run.message_weight[k] > 0.0:
            m = run.message[k]
            # What messages of few bits tell of the root has another inverse than what was sent.
            untold = not any_lane(load(lanes, payload.inverse, m, 0, 0) != 0.0)
            if run.age[k] > 0.0:
                carry(run.model, run, payload.xhat, payload.root, m, run.age[k])
            if untold or run.age[k] > 0.0:
                invert_lanes(lanes, run.size, payload.inverse, m, payload.root, m)
            arrived = load_flags(lanes, run.arrived, k)
            weight = select(arrived, run.message_weight[k] / divisor, 0.0)
            write_information_root(
                lanes, run.size, whitened, weight, payload.inverse, payload.xhat, m, x, h
            )
            merge_lanes(lanes, run.size, total, whitened)
    finish_lanes(lanes, run.size, root, x, h, x, total, whitened, own == 1.0)


def diffusion_filter_record(
    filtering: DiffusionFilter, _infos: Sequence[NodeInfo], models: Sequence[Any]
) -> Record:
    """Return the own weights and inverses of roots of nodes, estimates in messages with the
    inverses of their roots, and the rule for lost messages.
    """
    n = len(models[0].information)
    return Record(
        node={"own": (), "inverse": (n, n)},
        payload={"xhat": (n,), "root": (n, n), "inverse": (n, n)},
        numbers={"inverse": np.full((n, n), -1)},
        settings={"keep_own": filtering.on_loss == "keep-own"},
    )


def begin_diffusion(_: Any, node: Mapping[str, np.ndarray], info: NodeInfo, _model: Any) -> None:
    """Set the weight of the node's own estimate when all messages arrive."""
    node["own"][...] = info.own_weight


@built_in("diffusion")
@dataclass(frozen=True, eq=False)
class DiffusionFilter(WeightedFilter):
    """Xie, Gan and Liu, D Algorithm 1, (6)-(9), with any F in place of the identity; samples in
    slots are predictions.

    Under clocks a node combines its estimate with those that it heard at one instant; those of
    delayed messages are predicted to now first.

    weights entry [l][i] is the weight node i gives to what node l sends, in the order of node ids:
            columns sum to 1, and paper D's theorems need rows that sum to 1 too; or "metropolis",
            1 / (1 + the larger number of incoming links) for each link and the rest for the node
    on_loss what becomes of the weight of a message that did not come (its row in the trace is
            "lost" or "late"): "renormalise" divides the weights of those that came, the own one
            included, by their sum; "keep-own" adds it to the own one

    Either way the weights sum to 1 and P stays at least the covariance of the error; a node that
    heard nothing keeps its estimate.
    """

    on_loss: str = field(one_of("renormalise", "keep-own"), default="renormalise")

    analysis = Analysis(paper="diffusion", P_by_design=("larger", "larger"))
    timing = Timing(
        schedule=("sense", "predict", "exchange"),
        clocks=("directions", "nodes", "readings"),
        predicts=True,
    )
    needs = Needs(one_way=True, inverts=True)
    kernels = Kernels(
        emit=emit, absorb=absorb, record=diffusion_filter_record, begin=begin_diffusion
    )

    shift = Filter.shift  # affine: the weights sum to one
