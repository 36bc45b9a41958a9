"""Belief propagation in kernels: evidence about the state, by who sent it.

Evidence is a pair of information as its root (Z, z), n by n + 1, see ``kernels.information``: Z is
lower triangular, and z counts from a centre c (n,), ``Z (x - c) = z + v`` with cov(v) = I. Of a
block of runs filter ``h`` has own readings ``own[h]`` (H, n, n + 1, L), and direction m of
``SlotLinks`` has the evidence that its sender sent last, ``received[m]`` (W, n, n + 1, L), both
counted from the centre of the filter that holds them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from netkf.algorithms.kernels.intersection import merge_lanes
from netkf.algorithms.kernels.slots import SlotLinks
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, Lanes, any_lane, load, load_flags, select, spread, store


class BeliefScratch(NamedTuple):
    """Evidence (n, n + 1, L) that nodes send, and scratch.

    every : all that each of H nodes has
    others : for each of W directions, all of its receiver but what came from its sender
    behind : (D + 1,) sums from the last of D directions on
    total, work : scratch
    """

    every: FloatArray
    others: FloatArray
    behind: FloatArray
    total: FloatArray
    work: FloatArray


@kernel
def clear_part(lanes: Lanes, part: FloatArray) -> None:
    """Set evidence (n, n + 1, L) to no information: zeros."""
    n = len(part)
    for i in range(n):
        for j in range(i + 1):
            store(lanes, part, i, j, 0.0)
        store(lanes, part, i, n, 0.0)


@kernel
def copy_part(lanes: Lanes, source: FloatArray, target: FloatArray) -> None:
    """Copy evidence (n, n + 1, L)."""
    n = len(source)
    for i in range(n):
        for j in range(i + 1):
            store(lanes, target, i, j, load(lanes, source, i, j))
        store(lanes, target, i, n, load(lanes, source, i, n))


@kernel
def add_part(lanes: Lanes, total: FloatArray, part: FloatArray, work: FloatArray) -> None:
    """Add independent evidence to ``total``; ``work`` is scratch."""
    copy_part(lanes, part, work)
    merge_lanes(lanes, total, work)


@kernel
def recentre_part(
    lanes: Lanes, part: FloatArray, before: FloatArray, after: FloatArray, out: FloatArray
) -> None:
    """Write evidence that counts from ``before`` (n, L) into ``out`` as it counts from ``after``;
    both may be the same array.
    """
    n = len(part)
    for i in range(n):
        mean = load(lanes, part, i, n)
        # Z (x - c') = Z (x - c) + Z (c - c').
        for j in range(i + 1):
            entry = load(lanes, part, i, j)
            mean += entry * (load(lanes, before, j) - load(lanes, after, j))
            store(lanes, out, i, j, entry)
        store(lanes, out, i, n, mean)


@kernel
def predict_part(
    lanes: Lanes, part: FloatArray, back: FloatArray, total: FloatArray, work: FloatArray
) -> None:
    """Turn evidence into that about a later state, from which ``back`` (n, n) leads to the earlier
    one; the centre moves along. ``total`` and ``work`` are scratch.
    """
    n = len(part)
    clear_part(lanes, total)
    for k in range(n):
        # A row [Z back, z] is the last one of a lower triangular root.
        clear_part(lanes, work)
        for j in range(n):
            entry = spread(lanes, 0.0)
            for i in range(k + 1):
                entry += load(lanes, part, k, i) * back[i, j]
            store(lanes, work, n - 1, j, entry)
        store(lanes, work, n - 1, n, load(lanes, part, k, n))
        merge_lanes(lanes, total, work)
    copy_part(lanes, total, part)


@kernel
def write_prior(lanes: Lanes, root: FloatArray, b: int, h: int, part: FloatArray) -> None:
    """Write an estimate with the regular ``root[b, h]`` as evidence that counts from itself."""
    n = len(part)
    for i in range(n):
        inverse = 1.0 / load(lanes, root, b, h, i, i)
        # Forward substitution, row i of S^-1.
        for j in range(i):
            value = spread(lanes, 0.0)
            for m in range(j, i):
                value -= load(lanes, root, b, h, i, m) * load(lanes, part, m, j)
            store(lanes, part, i, j, value * inverse)
        store(lanes, part, i, i, inverse)
        store(lanes, part, i, n, 0.0)


@kernel
def write_prior_single(roots: FloatArray, h: int, part: FloatArray) -> None:
    """Apply ``write_prior`` to one of the ``roots`` (1, H, n, n, 1) with one lane."""
    write_prior(ONE, roots, 0, h, part)


@kernel
def gather_evidence(
    lanes: Lanes,
    own: FloatArray,
    received: FloatArray,
    first: int,
    last: int,
    h: int,
    scratch: BeliefScratch,
) -> None:
    """Add up what node ``h`` knows, from its own readings and what was received on directions from
    ``first`` up to ``last``: all of it into ``every[h]``, and all but what came on direction m into
    ``others[m]`` (``scratch`` is BeliefScratch).
    """
    D = last - first
    # Sums from both ends leave one out in the middle without taking it away again.
    clear_part(lanes, scratch.behind[D])
    for k in range(D - 1, 0, -1):
        copy_part(lanes, scratch.behind[k + 1], scratch.behind[k])
        add_part(lanes, scratch.behind[k], received[first + k], scratch.work)
    copy_part(lanes, own[h], scratch.every[h])
    for k in range(D):
        copy_part(lanes, scratch.every[h], scratch.others[first + k])
        add_part(lanes, scratch.others[first + k], scratch.behind[k + 1], scratch.work)
        add_part(lanes, scratch.every[h], received[first + k], scratch.work)


@kernel
def receive_evidence(
    lanes: Lanes,
    received: FloatArray,
    links: SlotLinks,
    up: Any,
    index: tuple[int, int, int],
    h: int,
    centre: FloatArray,
    scratch: BeliefScratch,
) -> None:
    """Replace the evidence from senders that node ``h`` hears, where ``up`` (at ``index`` [b, s,
    e]) says that a message arrived.
    """
    b, s, e = index
    n = received.shape[1]
    for m in range(links.first[h], links.first[h + 1]):
        arrived, sender = load_flags(lanes, up, b, s, e, links.direction[m]), links.sender[m]
        if not any_lane(arrived):
            continue
        # The sender leaves out the evidence of the receiver, which would otherwise come back and
        # count twice; in a directed graph it may not hear the receiver at all.
        source = scratch.every[sender]
        for k in range(links.first[sender], links.first[sender + 1]):
            if links.sender[k] == h:
                source = scratch.others[k]
        recentre_part(lanes, source, centre[sender], centre[h], scratch.work)
        for i in range(n):
            for j in range(n + 1):
                if j <= i or j == n:
                    before, now = load(lanes, received, m, i, j), load(lanes, scratch.work, i, j)
                    store(lanes, received, m, i, j, select(arrived, now, before))
