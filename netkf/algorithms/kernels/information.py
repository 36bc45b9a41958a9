"""Kernels of consensus on information (CI, HCMCI, ICF): weighted sums of information pairs, carried
as roots.

An information pair (Omega, q), with Omega = P^-1 and q = P^-1 x for an estimate x, is stored as a
root (Z, z), n by n + 1, with ``Omega = Z' Z`` and ``q = Omega c + Z' z``. Z is lower triangular,
and z is relative to a centre c (n,), the estimate of the node that holds the pair, so that
differences of near states lose no digits. Omega may be singular, as that of a single reading is.
Pairs add up by ``merge_lanes``, which triangularises one root on top of the other.

Stacks ``parts`` (2, K, H, n, n + 1, L) hold K pairs of each of H nodes, before and after a step of
the exchanges: one pair (prediction and reading together) or two (apart), as the filter has it. Its
``shares`` and ``counts`` are the multiples with which pairs begin and are summed up in the end: ICF
begins with the reading and 1/N of the prediction, and counts their mean over N nodes N times.

In a slot, one time step, nodes read, exchange messages in E steps and predict, in the order of the
filter. ``links`` lists the W directed links by receiver: those to filter h have the numbers
``links.first[h]`` to ``links.first[h + 1]`` - 1; ``up`` (B, S, E, W, L) flags the messages that
arrive.

``lanes`` is ONE for a single run or MANY for a block of L runs side by side: ``load``, ``store``
and ``select`` handle the L numbers of an entry as one SIMD value (``netkf.linalg.lanes``).
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.intersection import finish_lanes, merge_lanes
from netkf.algorithms.kernels.slots import SlotLinks
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


@kernel(inlined=True)
def write_information(
    lanes: Lanes, out: FloatArray, share: float, inverse: FloatArray, h: int
) -> None:
    """Write the root [Z, z] of ``share`` times the information ``P^-1 = Z' Z`` of node ``h`` into
    ``out`` (n, n + 1, L), relative to the node's estimate, so that z = 0; ``inverse[h]`` of
    ``inverse`` (H, n, n, L) is S^-1 for P = S S'.

    Axes: H nodes, L runs side by side.
    """
    # P^-1 = S^-T S^-1, whose root is the inverse of S, lower triangular like S.
    n, factor = len(out), share**0.5
    for i in range(n):
        for j in range(i + 1):
            store(lanes, out, i, j, factor * load(lanes, inverse, h, i, j))
        # Relative to itself an estimate has the mean 0.
        store(lanes, out, i, n, 0.0)


@kernel(inlined=True)
def add_reading_pair(
    lanes: Lanes,
    total: FloatArray,
    share: float,
    y: FloatArray,
    H: FloatArray,
    index: tuple[int, int, int],
    rows: int,
    centre: FloatArray,
    work: FloatArray,
) -> None:
    """Add ``share`` times the information pair ``(H' H, H' y)`` of a whitened reading to the root
    [Z, z] of information in ``total`` (n, n + 1, L), in place, relative to ``centre[h]`` of
    ``centre`` (H, n, L).

    The reading has ``rows`` rows at ``index`` [b, s, h], block, slot and node, of y (B, S, H, p, L)
    and H (B, S, H, p, n, L); ``work`` (n, n + 1, L) is scratch. Axes: B blocks of L runs, S slots,
    H nodes.
    """
    b, s, h = index
    n, factor = len(total), share**0.5
    # A fixed H is stored for one block and one slot only.
    d, t = min(b, H.shape[0] - 1), min(s, H.shape[1] - 1)
    for k in range(rows):
        # Merge a row [H, y - H c], as the last row of a lower triangular root.
        for i in range(n - 1):
            for j in range(i + 1):
                store(lanes, work, i, j, 0.0)
            store(lanes, work, i, n, 0.0)
        innovation = load(lanes, y, b, s, h, k)
        for j in range(n):
            entry = load(lanes, H, d, t, h, k, j)
            innovation -= entry * load(lanes, centre, h, j)
            store(lanes, work, n - 1, j, factor * entry)
        store(lanes, work, n - 1, n, factor * innovation)
        merge_lanes(lanes, total, work)


@kernel(inlined=True)
def weigh_part(
    lanes: Lanes,
    out: FloatArray,
    weight: Any,
    parts: FloatArray,
    index: tuple[int, int, int],
    centre: FloatArray,
    h: int,
) -> None:
    """Write the root [Z, z] of ``weight`` (L,) times the information pair ``parts[t, k, sender]``
    of ``parts`` (2, K, H, n, n + 1, L) into ``out`` (n, n + 1, L), relative to ``centre[h]``
    instead of ``centre[sender]``, (n, L); ``index`` is [t, k, sender]: copy t, pair k of that node.

    Axes: H nodes, K information pairs, L runs side by side.
    """
    t, k, sender = index
    n, factor = len(out), root_of(weight)
    for i in range(n):
        mean = load(lanes, parts, t, k, sender, i, n)
        for j in range(i + 1):
            entry = load(lanes, parts, t, k, sender, i, j)
            # Z (x - c_h) = Z (x - c_j) + Z (c_j - c_h).
            mean += entry * (load(lanes, centre, sender, j) - load(lanes, centre, h, j))
            store(lanes, out, i, j, factor * entry)
        store(lanes, out, i, n, factor * mean)


@kernel(inlined=True)
def store_part(
    lanes: Lanes, parts: FloatArray, index: tuple[int, int, int], total: FloatArray
) -> None:
    """Copy the root ``total`` (n, n + 1, L) of an information pair into ``parts[t, k, h]``, pair k
    of node h in copy t; ``index`` is [t, k, h]. Zeros above the diagonal are not copied.

    Axes: L runs side by side.
    """
    t, k, h = index
    n = len(total)
    for i in range(n):
        for j in range(i + 1):
            store(lanes, parts, t, k, h, i, j, load(lanes, total, i, j))
        store(lanes, parts, t, k, h, i, n, load(lanes, total, i, n))


@kernel
def begin_part(
    lanes: Lanes,
    parts: FloatArray,
    k: int,
    shares: FloatArray,
    inverse: FloatArray,
    y: FloatArray,
    H: FloatArray,
    index: tuple[int, int, int],
    rows: int,
    centre: FloatArray,
    total: FloatArray,
    work: FloatArray,
) -> None:
    """Write the initial information pair ``k`` of node h, before any consensus step, as a root [Z,
    z] into ``parts[0, k, h]`` of ``parts`` (2, K, H, n, n + 1, L): ``shares[k, 0]`` times the
    information of its prediction plus ``shares[k, 1]`` times that of its reading, ``shares``
    (K, 2).

    ``index`` is [b, s, h], block, slot and node; ``inverse`` (H, n, n, L) holds the inverse roots
    of the predictions and ``centre`` (H, n, L) their means. The reading has ``rows`` whitened rows
    of y (B, S, H, p, L) and H (B, S, H, p, n, L). ``total`` and ``work`` (n, n + 1, L) are scratch.
    Axes: B blocks of L runs, S slots, H nodes, K information pairs.
    """
    write_information(lanes, total, shares[k, 0], inverse, index[2])
    if shares[k, 1] > 0.0:
        add_reading_pair(lanes, total, shares[k, 1], y, H, index, rows, centre, work)
    store_part(lanes, parts, (0, k, index[2]), total)


@kernel
def mix_parts(
    lanes: Lanes,
    parts: FloatArray,
    step: int,
    h: int,
    links: SlotLinks,
    up: Any,
    index: tuple[int, int, int],
    centre: FloatArray,
    total: FloatArray,
    work: FloatArray,
) -> None:
    """Do consensus step number ``step`` of node ``h``: replace each of its K information pairs by
    the convex combination of it and those that arrive. The weights of messages that do not arrive
    go to the own pair.

    ``parts`` (2, K, H, n, n + 1, L) holds two copies of all pairs, as roots [Z, z] relative to the
    means ``centre`` (H, n, L) of H nodes: copy ``step`` modulo 2 is read, the other one is written
    at node h. ``up`` (B, S, E, W, L) at ``index`` [b, s, e] (block, slot, step of the exchanges)
    flags the messages that arrive; ``total`` and ``work`` (n, n + 1, L) are scratch. Axes: B blocks
    of L runs, S slots, E exchange steps, W directed links.
    """
    b, s, e = index
    # Two copies alternate: all nodes read from copy t and write to copy 1 - t.
    t = step % 2
    received_weight = spread(lanes, 0.0)
    for m in range(links.first[h], links.first[h + 1]):
        arrived = load_flags(lanes, up, b, s, e, links.direction[m])
        received_weight += select(arrived, links.weight[m], 0.0)
    # Rounding may leave the own weight a little below 0, which has no root.
    own = 1.0 - received_weight
    own = select(own > 0.0, own, 0.0)
    for k in range(parts.shape[1]):
        weigh_part(lanes, total, own, parts, (t, k, h), centre, h)
        for m in range(links.first[h], links.first[h + 1]):
            arrived = load_flags(lanes, up, b, s, e, links.direction[m])
            # A weight of 0 adds no information.
            if links.weight[m] > 0.0 and any_lane(arrived):
                weight = select(arrived, links.weight[m], 0.0)
                weigh_part(lanes, work, weight, parts, (t, k, links.sender[m]), centre, h)
                merge_lanes(lanes, total, work)
        store_part(lanes, parts, (1 - t, k, h), total)


@kernel
def write_estimate(
    lanes: Lanes,
    root: FloatArray,
    xhat: FloatArray,
    b: int,
    h: int,
    parts: FloatArray,
    t: int,
    counts: FloatArray,
    inverse: FloatArray,
    centre: FloatArray,
    total: FloatArray,
    work: FloatArray,
) -> None:
    """Write ``xhat[b, h]`` (n, L) and ``root[b, h]`` (n, n, L) of filter ``h`` of block ``b`` from
    a sum of information: ``counts[K]`` times that of its prediction plus ``counts[k]`` times each
    of its K pairs after the consensus steps, copy ``t`` of ``parts`` (2, K, H, n, n + 1, L).

    ``inverse`` (H, n, n, L) holds the inverse roots of the predictions and ``centre`` (H, n, L)
    their means; ``total`` and ``work`` (n, n + 1, L) are scratch. Axes: H nodes, L runs side by
    side.
    """
    K = parts.shape[1]
    write_information(lanes, total, float(counts[K]), inverse, h)
    for k in range(K):
        weigh_part(lanes, work, spread(lanes, counts[k]), parts, (t, k, h), centre, h)
        merge_lanes(lanes, total, work)
    # False: no lane keeps its former estimate.
    finish_lanes(lanes, root[b], xhat[b], h, centre, total, work, False)
