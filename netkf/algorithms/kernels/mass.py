"""Kernels of the push-sum filter (paper P: Battilotti, Cacace and d'Angelo 2023): mixing of mass,
the quotients of P (6), the update (7) and (8), and the averaging (9).

Push-sum computes sums over the network: nodes pass on shares of their mass, whose totals never
change, and the quotient of two totals is the same at all nodes in the end. A mass (2 + n n,) holds
the weight w, the number of nodes n~ and the information C~ of paper P (3)-(5). The order of every
sum is fixed, since the rounding of masses decides in which slot a node stops (``stopping``).

Node ``h`` of block ``b`` has index ``[b, h]`` of stacks with lanes (``netkf.linalg.lanes``): masses
(B, H, m, L), roots (B, H, n, n, L).

In a slot, one time step, nodes read, exchange messages in E steps and predict, in the order of the
filter. ``links`` lists the W directed links by receiver: those to filter h have the numbers
``links.first[h]`` to ``links.first[h + 1]`` - 1; ``up`` (B, S, E, W, L) flags the messages that
arrive.

``lanes`` is ONE for a single run or MANY for a block of L runs side by side: ``load``, ``store``
and ``select`` handle the L numbers of an entry as one SIMD value (``netkf.linalg.lanes``).
"""

from __future__ import annotations

from typing import Any

from netkf.algorithms.kernels.slots import SlotLinks, SlotScratch, rotate_lanes
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, any_lane, load, load_flags, root_of, select, spread, store


@kernel(inlined=True)
def split_mass(
    lanes: Lanes, mass: FloatArray, b: int, h: int, degree: int, share: FloatArray
) -> None:
    """Write into ``share[h]`` (m, L) the message of node ``h`` of block ``b`` to each of its
    ``degree`` neighbours: its mass, m = 2 + n n numbers (weight, number of nodes and information)
    of ``mass`` (B, H, m, L), over degree + 1.

    Axes: B blocks of L runs, H nodes.
    """
    # P (3)-(5) with equal weights 1 / (degree + 1); the degree counts links that fail, too, since a
    # node cannot know which will. One quotient for all: all neighbours receive the same bits.
    for i in range(mass.shape[2]):
        store(lanes, share, h, i, load(lanes, mass, b, h, i) / (degree + 1))


@kernel(inlined=True)
def keep_share(
    lanes: Lanes, mass: FloatArray, b: int, h: int, share: FloatArray, times: Any, unchanged: Any
) -> None:
    """Add ``times`` (L,) times its own ``share[h]`` (m, L) to the mass that node ``h`` of block
    ``b`` received, ``mass[b, h]`` of ``mass`` (B, H, m, L), m = 2 + n n, in place, paper P (3)-(5),
    except in lanes with the flag ``unchanged`` (L,), where ``mass[b, h]`` stays as it is.

    ``times`` is 1 for the node itself plus 1 for each of its links that failed. Axes: B blocks of L
    runs, H nodes.
    """
    # A share that could not be sent stays here, so that the sums of w, n~ and C~ over the network
    # are conserved.
    for i in range(mass.shape[2]):
        received = load(lanes, mass, b, h, i)
        mixed = times * load(lanes, share, h, i) + received
        store(lanes, mass, b, h, i, select(unchanged, received, mixed))


@kernel(inlined=True)
def learn_network(
    lanes: Lanes,
    mass: FloatArray,
    b: int,
    h: int,
    alone: FloatArray,
    information: FloatArray,
    number: FloatArray,
) -> None:
    """Write the information of all sensors G = C~ / w and the number of nodes N = n~ / w as node
    ``h`` of block ``b`` estimates them, paper P (6), into ``information`` (n, n, L) and ``number``
    (1, L). While its weight w is exactly 0, these are its own information ``alone[h]`` of ``alone``
    (H, n, n) and 1.

    ``mass`` (B, H, 2 + n n, L) holds the shares of each node in three sums over the network: the
    weight w, the number of nodes n~, and the n n entries of the information C~.

    Axes: B blocks of L runs, H nodes.
    """
    # w is 0 until the first mass from the leader arrives, which begins with all the weight.
    n, weight = information.shape[0], load(lanes, mass, b, h, 0)
    is_empty = weight == 0.0
    for i in range(n):
        # One triangle is computed and mirrored: G is symmetric bit for bit.
        for j in range(i + 1):
            # The mean of both triangles, since C~ is symmetric only up to rounding. Where w is 0
            # these are nan or infinite: kernels do not raise, and ``select`` discards them.
            upper = load(lanes, mass, b, h, 2 + i * n + j) / weight
            lower = load(lanes, mass, b, h, 2 + j * n + i) / weight
            value = select(is_empty, alone[h, i, j], 0.5 * (upper + lower))
            store(lanes, information, i, j, value)
            store(lanes, information, j, i, value)
    store(lanes, number, 0, select(is_empty, 1.0, load(lanes, mass, b, h, 1) / weight))


@kernel(inlined=True)
def correct_root(
    root: FloatArray,
    b: int,
    h: int,
    information: FloatArray,
    remainder: FloatArray,
    scratch: SlotScratch,
) -> None:
    """Replace ``root[b, h]`` (n, n, L) of filter ``h`` of block ``b`` by the root of
    ``(P^-1 + G)^-1 = P (I + G P)^-1``, paper P (7), with the information G = ``information[b, h]``
    of ``information`` (B, H, n, n, L); ``remainder`` (n, n, L) is scratch.

    Axes: B blocks of L runs, H nodes.
    """
    # G = sum v v' by Cholesky with the largest pivot first. Each v' is used as an observation with
    # noise of variance 1: nothing is inverted, and P may be singular.
    lanes, n, v = scratch.lanes, root.shape[2], scratch.moved_mean
    largest = spread(lanes, 0.0)
    # The largest diagonal entry is the scale of G: pivots far below it are rounding.
    for i in range(n):
        diagonal = load(lanes, information, b, h, i, i)
        largest = select(diagonal > largest, diagonal, largest)
        for j in range(n):
            store(lanes, remainder, i, j, load(lanes, information, b, h, i, j))
    for _ in range(n):
        pivot = largest_row(lanes, remainder, v)
        # The remainder is rounding of G: G has no further rank to use. ``>`` also ends on nan.
        useful = pivot > ROUNDING * n * largest
        if not any_lane(useful):
            return
        # v' = remainder[largest] / sqrt(pivot), the next row of the Cholesky factor; zeros, which
        # change nothing, in lanes whose remainder is rounding.
        scale = select(useful, root_of(pivot), 1.0)
        for i in range(n):
            store(lanes, v, i, select(useful, load(lanes, v, i) / scale, 0.0))
        for j in range(n):
            total = spread(lanes, 0.0)
            for i in range(j, n):
                total += load(lanes, v, i) * load(lanes, root, b, h, i, j)
            store(lanes, scratch.row, j, total)
        # P <- P - P v v' P / (1 + v' P v) on the root. P (8) corrects the estimate, see add_gain.
        rotate_lanes(lanes, scratch.size, root, b, h, scratch.row, scratch.gains)
        # Deflate, remainder -= v v'.
        for i in range(n):
            for j in range(n):
                entry = load(lanes, remainder, i, j) - load(lanes, v, i) * load(lanes, v, j)
                store(lanes, remainder, i, j, entry)


@kernel(inlined=True)
def largest_row(lanes: Lanes, remainder: FloatArray, v: FloatArray) -> Any:
    """Write the row of ``remainder`` (n, n, L) with the largest diagonal entry into ``v`` (n, L),
    lane by lane; return that entry (L,).
    """
    # For correct_root: pivoting by the diagonal reveals the rank of G.
    n, pivot = len(remainder), load(lanes, remainder, 0, 0)
    for j in range(n):
        store(lanes, v, j, load(lanes, remainder, 0, j))
    for i in range(1, n):
        diagonal = load(lanes, remainder, i, i)
        larger = diagonal > pivot
        pivot = select(larger, diagonal, pivot)
        for j in range(n):
            store(lanes, v, j, select(larger, load(lanes, remainder, i, j), load(lanes, v, j)))
    return pivot


ROUNDING = 2.0**-52  # spacing of floating-point numbers at 1, relative size of pivots that are 0


@kernel(inlined=True)
def add_gain(
    lanes: Lanes,
    x: FloatArray,
    root: FloatArray,
    b: int,
    h: int,
    number: Any,
    y: FloatArray,
    s: int,
    H: FloatArray,
    rows: int,
    projected: FloatArray,
    root_projected: FloatArray,
) -> None:
    """Correct the estimate ``x[b, h]`` (n, L) of filter ``h`` of block ``b`` in place, paper P (8):
    ``x += number S S' H' (y - H x)`` with the root S = ``root[b, h]`` (n, n, L) and the ``number``
    (L,) of nodes that it knows of.

    The reading of slot ``s`` has ``rows`` whitened rows ``y[b, s, h]`` of y (B, S, H, p, L) and H
    (B, S, H, p, n, L); ``projected`` and ``root_projected`` (n, L) are scratch. Axes: B blocks of L
    runs, S slots, H nodes.
    """
    n = x.shape[2]
    # A fixed H is stored for one block and one slot only.
    d, t = min(b, H.shape[0] - 1), min(s, H.shape[1] - 1)
    # H' (y - H x); the noise is white with variance 1, so no R^-1 appears.
    for i in range(n):
        store(lanes, projected, i, 0.0)
    for row in range(rows):
        innovation = load(lanes, y, b, s, h, row)
        for i in range(n):
            innovation -= load(lanes, H, d, t, h, row, i) * load(lanes, x, b, h, i)
        for i in range(n):
            weight = load(lanes, H, d, t, h, row, i)
            store(lanes, projected, i, load(lanes, projected, i) + weight * innovation)
    # P projected = S (S' projected): P itself is never formed.
    for j in range(n):
        total = spread(lanes, 0.0)
        for i in range(j, n):
            total += load(lanes, root, b, h, i, j) * load(lanes, projected, i)
        store(lanes, root_projected, j, total)
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(i + 1):
            total += load(lanes, root, b, h, i, j) * load(lanes, root_projected, j)
        store(lanes, x, b, h, i, load(lanes, x, b, h, i) + number * total)


@kernel
def average(
    lanes: Lanes,
    z: FloatArray,
    b: int,
    links: SlotLinks,
    up: Any,
    s: int,
    step: int,
    averaged: FloatArray,
    factor: float,
) -> None:
    """Do one averaging step of all nodes of block ``b`` in place, P (9): ``z_i += factor sum_j (z_j
    - z_i)`` over the estimates z_j that arrive, with ``factor`` = 1 / delta; ``z`` is (B, H, n, L).

    ``up`` (B, S, E, W, L) flags the messages that arrive in step ``step`` of the exchanges of slot
    ``s``; ``averaged`` (H, n, L) is scratch. Axes: B blocks of L runs, S slots, E exchange steps, W
    directed links, H nodes.
    """
    H, n = len(links.first) - 1, z.shape[2]
    # All differences before any estimate moves: the step is simultaneous. It is a consensus step,
    # which contracts differences if delta exceeds half the largest eigenvalue of the Laplacian.
    for h in range(H):
        for i in range(n):
            own, total = load(lanes, z, b, h, i), spread(lanes, 0.0)
            for m in range(links.first[h], links.first[h + 1]):
                arrived = load_flags(lanes, up, b, s, step, links.direction[m])
                difference = load(lanes, z, b, links.sender[m], i) - own
                total += select(arrived, difference, 0.0)
            store(lanes, averaged, h, i, own + factor * total)
    for h in range(H):
        for i in range(n):
            store(lanes, z, b, h, i, load(lanes, averaged, h, i))
