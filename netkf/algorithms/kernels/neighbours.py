"""Kernels by which filters use the messages of neighbours: readings, the consensus term of the
Kalman consensus filter (KCF), convex combinations of paper H (Tanwani 2021).

Diffusion, KCF, intermittent, constant-gain and track-fusion filters share them.
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.run import carry, use_reading
from netkf.algorithms.kernels.square_root import absorb_columns
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import load, load_flags, root_of, select, spread, store
from netkf.linalg.local import local_lanes_matrix


@kernel(inlined=True)
def received_weight(run: Any) -> Any:
    """Return the sum (L,) of the weights of all messages in the inbox that have arrived."""
    total = spread(run.lanes, 0.0)
    for k in range(run.count):
        total += select(load_flags(run.lanes, run.arrived, k), run.message_weight[k], 0.0)
    return total


@kernel
def combine_convex(record: Any, h: int, run: Any) -> None:
    """Replace the estimate of node ``h`` by the convex combination with those heard, paper H (7)
    and (9), with the weights of lost messages in its own: ``x = sum w_j x_j``, ``P = sum w_j P_j``.
    """
    lanes, n, root, payload = run.lanes, len(run.size), record.root, record.payload
    theirs = local_lanes_matrix(run.size, lanes, run.noise)
    # Rounding may leave the own weight a little below 0, which has no root.
    own = 1.0 - received_weight(run)
    factor = root_of(select(own > 0.0, own, 0.0))
    for i in range(n):
        store(lanes, run.moved_mean, i, 0.0)
        for j in range(i + 1):
            store(lanes, root, h, i, j, factor * load(lanes, root, h, i, j))
    for k in range(run.count):
        m = run.message[k]
        carry(run.model, run, payload.xhat, payload.root, m, run.age[k])
        weight = select(load_flags(lanes, run.arrived, k), run.message_weight[k], 0.0)
        factor = root_of(weight)
        # P + w P_j = A A' with A = [S, sqrt(w) S_j].
        for i in range(n):
            for j in range(i + 1):
                store(lanes, theirs, i, j, factor * load(lanes, payload.root, m, i, j))
            difference = load(lanes, payload.xhat, m, i) - load(lanes, record.xhat, h, i)
            store(lanes, run.moved_mean, i, load(lanes, run.moved_mean, i) + weight * difference)
        absorb_columns(lanes, run.size, root[h], theirs)
    for i in range(n):
        mean = load(lanes, record.xhat, h, i) + load(lanes, run.moved_mean, i)
        store(lanes, record.xhat, h, i, mean)


@kernel
def use_readings_heard(record: Any, h: int, run: Any) -> None:
    """Update node ``h`` by the readings heard in turn, which is one update of independent noise."""
    for k in range(run.count):
        if run.heard[k] >= 0:
            arrived = load_flags(run.lanes, run.arrived, k)
            use_reading(run, record.xhat, record.root, h, run.heard[k], arrived)
