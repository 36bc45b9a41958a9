"""Kernels of Gaussian belief propagation: sums of evidence about the state, kept apart by sender.

A node sends a neighbour all its evidence but that which came from there: it would count twice.

Evidence is an information pair as a root (Z, z), n by n + 1, see ``kernels.information``: Z is
lower triangular, and z is relative to a centre c (n,), ``Z (x - c) = z + v`` with cov(v) = I. In a
block of runs filter ``h`` holds the evidence of its own readings, ``own[h]`` (H, n, n + 1, L), and
for each direction m of ``SlotLinks`` the evidence that its sender sent last, ``received[m]``
(W, n, n + 1, L), both relative to its own centre. A ``part`` is one such array (n, n + 1, L).

Evidence is about the coordinates e of a state ``x = W e`` (``modes.ModeFrame``), in which the
information about decaying modes does not grow; W (n, n) is the identity where nothing is kept. The
estimate is an x, the centre of evidence as an e.

In a slot, one time step, nodes read, exchange messages in E steps and predict, in the order of the
filter. ``links`` lists the W directed links by receiver: those to filter h have the numbers
``links.first[h]`` to ``links.first[h + 1]`` - 1; ``up`` (B, S, E, W, L) flags the messages that
arrive.

``lanes`` is ONE for a single run or MANY for a block of L runs side by side: ``load``, ``store``
and ``select`` handle the L numbers of an entry as one SIMD value (``netkf.linalg.lanes``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from netkf.algorithms.kernels.intersection import merge_lanes
from netkf.algorithms.kernels.slots import SlotLinks
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, Lanes, any_lane, load, load_flags, select, spread, store


class BeliefScratch(NamedTuple):
    """Evidence (n, n + 1, L) that H nodes send over W directed links in L runs, and scratch.

    all : (H, n, n + 1, L), sum of all evidence of each node
    others : (W, n, n + 1, L), for each directed link the evidence of its receiver without that of
             its sender: the message on the opposite link
    suffix : (D + 1, n, n + 1, L), entry k is the sum of the evidence received on links k to D - 1
             of the D links to one node
    total, work : (n, n + 1, L), scratch
    root, step : of a new belief, in coordinates e: root (1, 1, n, n, L) of its covariance, and its
                 difference (1, 1, n, L) to the former centre
    origin : (1, n, L), zeros
    """

    all: FloatArray
    others: FloatArray
    suffix: FloatArray
    total: FloatArray
    work: FloatArray
    root: FloatArray
    step: FloatArray
    origin: FloatArray


@kernel
def clear_part(lanes: Lanes, part: FloatArray) -> None:
    """Set the evidence ``part`` (n, n + 1, L), a root [Z, z] of information, to no information:
    zeros on and below the diagonal and in the last column, the only entries that are ever read.

    Axes: L runs side by side.
    """
    n = len(part)
    for i in range(n):
        for j in range(i + 1):
            store(lanes, part, i, j, 0.0)
        store(lanes, part, i, n, 0.0)


@kernel
def copy_part(lanes: Lanes, source: FloatArray, target: FloatArray) -> None:
    """Copy the evidence ``source`` (n, n + 1, L), a root [Z, z] of information with Z lower
    triangular, into ``target`` of the same shape; entries above the diagonal, which are never read,
    are left alone.

    Axes: L runs side by side.
    """
    n = len(source)
    for i in range(n):
        for j in range(i + 1):
            store(lanes, target, i, j, load(lanes, source, i, j))
        store(lanes, target, i, n, load(lanes, source, i, n))


@kernel
def add_part(lanes: Lanes, total: FloatArray, part: FloatArray, work: FloatArray) -> None:
    """Add the independent evidence ``part`` (n, n + 1, L) to ``total`` of the same shape, in place:
    both are roots [Z, z], and the information Z' Z adds up. ``work`` is scratch of that shape.

    Axes: L runs side by side.
    """
    copy_part(lanes, part, work)
    merge_lanes(lanes, total, work)


@kernel
def recentre_part(
    lanes: Lanes, part: FloatArray, before: FloatArray, after: FloatArray, out: FloatArray
) -> None:
    """Move the centre c that the evidence ``part`` (n, n + 1, L), [Z, z] with
    ``Z (x - c) = z + noise``, is relative to from ``before`` (n, L) to ``after`` (n, L): write the
    result into ``out``, which may be ``part`` itself.

    Axes: L runs side by side.
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
def add_reading_to_part(
    lanes: Lanes,
    part: FloatArray,
    y: FloatArray,
    H: FloatArray,
    index: tuple[int, int, int],
    rows: int,
    xhat: FloatArray,
    W: FloatArray,
    work: FloatArray,
) -> None:
    """Add a whitened reading of ``rows`` rows to the evidence ``part`` (n, n + 1, L), a root [Z, z]
    of information, in place: the rows ``[H W, y - H xhat]``, relative to ``xhat[h]`` of ``xhat``
    (H, n, L), for coordinates e of the state ``x = W e``, with W (n, n).

    The reading is that at ``index`` [b, s, h], block, slot and node, of y (B, S, H, p, L) and H
    (B, S, H, p, n, L); ``work`` (n, n + 1, L) is scratch. Axes: B blocks of L runs, S slots, H
    nodes.
    """
    b, s, h = index
    n = len(part)
    # A fixed H is stored for one block and one slot only.
    d, t = min(b, H.shape[0] - 1), min(s, H.shape[1] - 1)
    for k in range(rows):
        # Merge one row, as the last row of a lower triangular root.
        clear_part(lanes, work)
        innovation = load(lanes, y, b, s, h, k)
        for j in range(n):
            innovation -= load(lanes, H, d, t, h, k, j) * load(lanes, xhat, h, j)
            entry = spread(lanes, 0.0)
            for i in range(n):
                entry += load(lanes, H, d, t, h, k, i) * W[i, j]
            store(lanes, work, n - 1, j, entry)
        store(lanes, work, n - 1, n, innovation)
        merge_lanes(lanes, part, work)


@kernel
def set_growing(
    lanes: Lanes, centre: FloatArray, xhat: FloatArray, inverse: FloatArray, growing: int
) -> None:
    """Set the first ``growing`` entries of the centre e of evidence, ``centre`` (n, L), to those of
    the estimate ``xhat`` (n, L), ``inverse xhat`` with ``inverse`` (n, n): they are of the present,
    and the others of time 0 (``algorithms.modes``).

    Axes: L runs side by side.
    """
    for i in range(growing):
        total = spread(lanes, 0.0)
        for j in range(len(inverse)):
            total += inverse[i, j] * load(lanes, xhat, j)
        store(lanes, centre, i, total)


@kernel
def predict_part(
    lanes: Lanes, part: FloatArray, back: FloatArray, total: FloatArray, work: FloatArray
) -> None:
    """Predict the evidence ``part`` (n, n + 1, L), a root [Z, z] of information, in place to a
    later state of a plant without noise: ``Z <- Z back``, where ``back`` (n, n) is the inverse
    transition, made triangular again. The caller predicts the centre. ``total`` and ``work`` are
    scratch of the shape of ``part``.

    Axes: L runs side by side.
    """
    # Z (x - c) = Z back (x+ - c+) for x+ - c+ = back^-1 (x - c); Z back is not triangular, so its
    # rows are merged one by one into a triangular root.
    n = len(part)
    clear_part(lanes, total)
    for k in range(n):
        # Merge row k of [Z back, z], as the last row of a lower triangular root.
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
def predict_part_single(
    part: FloatArray, back: FloatArray, total: FloatArray, work: FloatArray
) -> None:
    """Turn the evidence ``part`` (n, n + 1, 1) of one run, a root [Z, z] of information about some
    e, in place into that about the e' of ``e = back e'``: ``Z <- Z back``. ``total`` and ``work``
    (n, n + 1, 1) are scratch.
    """
    predict_part(ONE, part, back, total, work)


@kernel
def write_prior(lanes: Lanes, root: FloatArray, b: int, h: int, part: FloatArray) -> None:
    """Write the prior of filter ``h`` of block ``b`` as evidence into ``part`` (n, n + 1, L): Z =
    S^-1 of the regular lower triangular root S = ``root[b, h]`` (n, n, L), and z = 0 relative to
    its own mean.

    Axes: L runs side by side.
    """
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
    """Write the prior of filter ``h`` as evidence [S^-1, 0] into ``part`` (n, n + 1, 1), for one
    run: S is its lower triangular root in ``roots`` (1, H, n, n, 1).

    Axes: H nodes.
    """
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
    """Sum the evidence of node ``h``, its own and that received on directions ``first`` to ``last``
    - 1, pieces of independent information as roots [Z, z] (n, n + 1, L): write all of it into
    ``scratch.all[h]``, and all but that of direction m into ``scratch.others[m]``.

    ``own`` (H, n, n + 1, L) is evidence by node, ``received`` (W, n, n + 1, L) by direction. Axes:
    W directed links, H nodes, L runs side by side.
    """
    D = last - first  # number of incoming links
    # The sum without direction k is a prefix sum plus a suffix sum: nothing is subtracted.
    clear_part(lanes, scratch.suffix[D])
    for k in range(D - 1, 0, -1):
        copy_part(lanes, scratch.suffix[k + 1], scratch.suffix[k])
        add_part(lanes, scratch.suffix[k], received[first + k], scratch.work)
    copy_part(lanes, own[h], scratch.all[h])
    for k in range(D):
        copy_part(lanes, scratch.all[h], scratch.others[first + k])
        add_part(lanes, scratch.others[first + k], scratch.suffix[k + 1], scratch.work)
        add_part(lanes, scratch.all[h], received[first + k], scratch.work)


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
    """Replace the evidence ``received[m]`` of ``received`` (W, n, n + 1, L) for each direction m to
    node ``h`` whose message arrives: ``up`` (B, S, E, W, L) at ``index`` [b, s, e], block, slot and
    step of the exchanges.

    The message is ``scratch.all`` of the sender or, if it hears node h itself, ``scratch.others``;
    it is moved to the centre of node h. ``centre`` (H, n, L) are those of all nodes. Axes: B
    blocks of L runs, S slots, E exchange steps, W directed links, H nodes.
    """
    b, s, e = index
    n = received.shape[1]
    for m in range(links.first[h], links.first[h + 1]):
        arrived, sender = load_flags(lanes, up, b, s, e, links.direction[m]), links.sender[m]
        if not any_lane(arrived):
            continue
        # The sender leaves out the evidence of the receiver, which would otherwise come back and
        # count twice; in a directed graph it may not hear the receiver at all.
        source = scratch.all[sender]
        for k in range(links.first[sender], links.first[sender + 1]):
            if links.sender[k] == h:
                source = scratch.others[k]
        recentre_part(lanes, source, centre[sender], centre[h], scratch.work)
        for i in range(n):
            for j in range(n + 1):
                if j <= i or j == n:
                    former, replacement = (
                        load(lanes, received, m, i, j),
                        load(lanes, scratch.work, i, j),
                    )
                    store(lanes, received, m, i, j, select(arrived, replacement, former))
