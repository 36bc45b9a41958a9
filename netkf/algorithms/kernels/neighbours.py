"""Kernels by which filters use the messages of neighbours: readings, the consensus term of the
Kalman consensus filter (KCF), convex combinations of paper H (Tanwani 2021).

Diffusion, KCF, intermittent, constant-gain and track-fusion filters share them.

Filter ``h`` of a block has index ``[b, h]`` of stacks with lanes (``netkf.linalg.lanes``):
estimates (B, H, n, L), lower triangular roots (B, H, n, n, L).

In a slot, one time step, nodes read, exchange messages in E steps and predict, in the order of the
filter. ``links`` lists the W directed links by receiver: those to filter h have the numbers
``links.first[h]`` to ``links.first[h + 1]`` - 1; ``up`` (B, S, E, W, L) flags the messages that
arrive.

``lanes`` is ONE for a single run or MANY for a block of L runs side by side: ``load``, ``store``
and ``select`` handle the L numbers of an entry as one SIMD value (``netkf.linalg.lanes``).
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.estimates import triangularise
from netkf.algorithms.kernels.run import carry, use_reading
from netkf.algorithms.kernels.slots import (
    SlotLinks,
    SlotNodes,
    SlotPlan,
    SlotScratch,
    write_root_column,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    Lanes,
    any_lane,
    load,
    load_flags,
    root_of,
    select,
    spread,
    store,
)


@kernel
def scale_by_covariance(
    lanes: Lanes,
    root: FloatArray,
    b: int,
    h: int,
    epsilon: float,
    differences: FloatArray,
    work: FloatArray,
) -> None:
    """Multiply ``differences[h]`` (n, L) in place by the consensus gain of the Kalman consensus
    filter (KCF, Olfati-Saber 2009), ``epsilon / (1 + |P|) P`` with the Frobenius norm, where P has
    the root ``root[b, h]`` (n, n, L) of filter ``h`` of block ``b``; ``work`` (n, L) is scratch.

    Axes: L runs side by side.
    """
    n, square = root.shape[2], spread(lanes, 0.0)
    # |P|^2 is the sum of the squares of the entries of S S'.
    for i in range(n):
        for j in range(i + 1):
            total = spread(lanes, 0.0)
            for m in range(j + 1):
                total += load(lanes, root, b, h, i, m) * load(lanes, root, b, h, j, m)
            # An entry off the diagonal counts twice.
            square += total * total if i == j else 2.0 * total * total
    gain = epsilon / (1.0 + root_of(square))
    # P d = S (S' d) for d = differences[h]: P itself is not stored.
    for j in range(n):
        total = spread(lanes, 0.0)
        for i in range(j, n):
            total += load(lanes, root, b, h, i, j) * load(lanes, differences, h, i)
        store(lanes, work, j, total)
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(i + 1):
            total += load(lanes, root, b, h, i, j) * load(lanes, work, j)
        store(lanes, differences, h, i, gain * total)


@kernel
def copy_pairs(nodes: SlotNodes, scratch: SlotScratch, b: int) -> None:
    """Copy (xhat, root) of all H filters of block ``b`` to ``scratch.xhat`` (H, n, L) and
    ``scratch.root`` (H, n, n, L): the messages that they send. Then filters can be updated one
    after the other, all from the values before the exchange.

    Axes: L runs side by side.
    """
    for h in range(len(nodes.rows)):
        for i in range(nodes.xhat.shape[2]):
            store(scratch.lanes, scratch.xhat, h, i, load(scratch.lanes, nodes.xhat, b, h, i))
            for j in range(i + 1):
                entry = load(scratch.lanes, nodes.root, b, h, i, j)
                store(scratch.lanes, scratch.root, h, i, j, entry)


@kernel
def combine_convex_roots(
    nodes: SlotNodes,
    plan: SlotPlan,
    links: SlotLinks,
    scratch: SlotScratch,
    b: int,
    s: int,
    h: int,
) -> None:
    """Replace ``nodes.xhat[b, h]`` (n, L) and ``nodes.root[b, h]`` (n, n, L) of filter ``h`` of
    block ``b`` by the convex combination of it and those that arrive in slot ``s``, paper H (7) and
    (9), from the copies of all filters in ``scratch`` (see ``copy_pairs``).

    The weights of messages that do not arrive go to the own estimate. The slot has one step of the
    exchanges, hence ``plan.up[b, s, 0]``. Axes: L runs side by side.
    """
    lanes, n = scratch.lanes, nodes.xhat.shape[2]
    received_weight = spread(lanes, 0.0)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        received_weight += select(arrived, links.weight[m], 0.0)
    # Rounding may leave the own weight a little below 0, which has no root.
    own = 1.0 - received_weight
    factor = root_of(select(own > 0.0, own, 0.0))
    for i in range(n):
        for j in range(i + 1):
            store(lanes, nodes.root, b, h, i, j, factor * load(lanes, scratch.root, h, i, j))
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, plan.up, b, s, 0, links.direction[m])
        if not any_lane(arrived):
            continue
        sender, weight = links.sender[m], select(arrived, links.weight[m], 0.0)
        factor = root_of(weight)
        # x += w (x_j - x_h) and P + w P_j = A A' with A = [S, sqrt(w) S_j], made triangular by
        # reflections.
        for i in range(n):
            for j in range(n):
                store(lanes, scratch.moved, i, j, 0.0)
            for j in range(i + 1):
                store(lanes, scratch.moved, i, j, load(lanes, nodes.root, b, h, i, j))
                store(lanes, scratch.noise, i, j, factor * load(lanes, scratch.root, sender, i, j))
            difference = load(lanes, scratch.xhat, sender, i) - load(lanes, scratch.xhat, h, i)
            store(
                lanes, nodes.xhat, b, h, i, load(lanes, nodes.xhat, b, h, i) + weight * difference
            )
        for i in range(n):
            write_root_column(
                lanes, scratch.size, nodes.root, b, h, i, scratch.moved, scratch.noise
            )


@kernel(inlined=True)
def received_weight(run: Any) -> Any:
    """Return the sum (L,) of the weights of all messages in the inbox that have arrived."""
    total = spread(run.lanes, 0.0)
    for k in range(run.count):
        arrived = load_flags(run.lanes, run.arrived, k)
        total += select(arrived, run.message_weight[k], 0.0)
    return total


@kernel
def combine_convex(record: Any, h: int, run: Any) -> None:
    """Replace the estimate of node ``h`` by the convex combination with those heard, paper H (7)
    and (9), with the weights of messages that do not arrive in its own: ``x = sum w_j x_j`` and
    ``P = sum w_j P_j``.
    """
    lanes, n, root, payload = run.lanes, len(run.size), record.root, record.payload
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
        arrived = load_flags(lanes, run.arrived, k)
        weight = select(arrived, run.message_weight[k], 0.0)
        factor = root_of(weight)
        # P + w P_j = A A' with A = [S, sqrt(w) S_j], made triangular by reflections.
        for i in range(n):
            for j in range(n):
                store(lanes, run.moved, i, j, 0.0)
            for j in range(i + 1):
                store(lanes, run.moved, i, j, load(lanes, root, h, i, j))
                store(lanes, run.noise, i, j, factor * load(lanes, payload.root, m, i, j))
            difference = load(lanes, payload.xhat, m, i) - load(lanes, record.xhat, h, i)
            store(lanes, run.moved_mean, i, load(lanes, run.moved_mean, i) + weight * difference)
        triangularise(lanes, run.size, root, h, run.moved, run.noise)
    for i in range(n):
        mean = load(lanes, record.xhat, h, i) + load(lanes, run.moved_mean, i)
        store(lanes, record.xhat, h, i, mean)


@kernel
def use_readings_heard(record: Any, h: int, run: Any) -> None:
    """Update node ``h`` with the readings that its messages bring, one after the other: with
    independent noise that equals one update.
    """
    for k in range(run.count):
        if run.heard[k] >= 0:
            arrived = load_flags(run.lanes, run.arrived, k)
            use_reading(run, record.xhat, record.root, h, run.heard[k], arrived)
