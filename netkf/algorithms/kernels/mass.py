"""Push-sum in kernels: mass that is shared and mixed, what a node learns from it, averaging.

A mass is (2 + n n,): the weight w, the number of nodes n~ and the information C~ of P (3)-(5). The
order of every sum is fixed, since the rounding of the mass decides in which slot a node stops.

Node ``h`` of block ``b`` has index ``[b, h]`` of stacks with lanes (``netkf.linalg.lanes``): masses
(B, H, m, L), roots (B, H, n, n, L).
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
    """Write into ``share[h]`` what a node of that ``degree`` sends to each of its neighbours: its
    mass over degree + 1.
    """
    # P (3)-(5) with equal weights 1 / (degree + 1); the quotient is formed once, so all neighbours
    # are sent the same bits.
    for i in range(mass.shape[2]):
        store(lanes, share, h, i, load(lanes, mass, b, h, i) / (degree + 1))


@kernel(inlined=True)
def keep_share(
    lanes: Lanes, mass: FloatArray, b: int, h: int, share: FloatArray, times: Any, kept: Any
) -> None:
    """Add ``times`` times its own ``share`` to the mass that node ``h`` received, by P (3)-(5); the
    lanes ``kept`` are not changed.

    ``times`` is 1 for the node itself, and 1 more for each of its links that failed.
    """
    # A share that could not be sent stays here, so that the sums of w, n~ and C~ over the network
    # are conserved.
    for i in range(mass.shape[2]):
        received = load(lanes, mass, b, h, i)
        mixed = times * load(lanes, share, h, i) + received
        store(lanes, mass, b, h, i, select(kept, received, mixed))


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
    """Divide masses by the weight, P (6): write C~ / w and n~ / w of a node into ``information``
    (n, n, L) and ``number`` (1, L), or what the node knows of itself, ``alone[h]``, while its
    weight is exactly 0.
    """
    # P (6): G = C~ / w and N = n~ / w.
    n, weight = information.shape[0], load(lanes, mass, b, h, 0)
    nothing = weight == 0.0
    for i in range(n):
        # Only one triangle is computed; mirroring it makes G symmetric bit for bit.
        for j in range(i + 1):
            # The mean of both triangles, because C~ is symmetric only up to the rounding of its
            # sums.
            upper = load(lanes, mass, b, h, 2 + i * n + j) / weight
            lower = load(lanes, mass, b, h, 2 + j * n + i) / weight
            value = select(nothing, alone[h, i, j], 0.5 * (upper + lower))
            store(lanes, information, i, j, value)
            store(lanes, information, j, i, value)
    store(lanes, number, 0, select(nothing, 1.0, load(lanes, mass, b, h, 1) / weight))


@kernel(inlined=True)
def correct_root(
    root: FloatArray,
    b: int,
    h: int,
    information: FloatArray,
    rest: FloatArray,
    scratch: SlotScratch,
) -> None:
    """Make the root of a filter that of ``(P^-1 + G)^-1 = P (I + G P)^-1``, P (7), for the
    information G of its index in ``information`` (B, H, n, n, L); ``rest`` (n, n, L) is scratch.
    """
    # G = sum v v' by Cholesky with the largest pivot first, and each v' is a row that is observed
    # with noise of variance 1: nothing is inverted, and P may be singular.
    lanes, n, v = scratch.lanes, root.shape[2], scratch.moved_mean
    largest = spread(lanes, 0.0)
    # The whole diagonal gives the scale of G, against which a later pivot counts as rounding.
    for i in range(n):
        diagonal = load(lanes, information, b, h, i, i)
        largest = select(diagonal > largest, diagonal, largest)
        for j in range(n):
            store(lanes, rest, i, j, load(lanes, information, b, h, i, j))
    for _ in range(n):
        pivot = largest_row(lanes, rest, v)
        # The rest is rounding of G: G has no further rank to use. ``>`` also ends on nan.
        useful = pivot > ROUNDING * n * largest
        if not any_lane(useful):
            return
        # v', with v' = rest[best] / sqrt(pivot) the next row of the Cholesky factor, or zeros.
        scale = select(useful, root_of(pivot), 1.0)
        for i in range(n):
            store(lanes, v, i, select(useful, load(lanes, v, i) / scale, 0.0))
        for j in range(n):
            total = spread(lanes, 0.0)
            for i in range(j, n):
                total += load(lanes, v, i) * load(lanes, root, b, h, i, j)
            store(lanes, scratch.row, j, total)
        # P <- P - P v v' P / (1 + v' P v) on the root. The state is not corrected here: P (8) does
        # that.
        rotate_lanes(lanes, scratch.size, root, b, h, scratch.row, scratch.gains)
        # Deflate, rest -= v v'.
        for i in range(n):
            for j in range(n):
                entry = load(lanes, rest, i, j) - load(lanes, v, i) * load(lanes, v, j)
                store(lanes, rest, i, j, entry)


@kernel(inlined=True)
def largest_row(lanes: Lanes, rest: FloatArray, v: FloatArray) -> Any:
    """Write the row of ``rest`` (n, n, L) with the largest diagonal entry into ``v`` (n, L), lane
    by lane; return that entry.
    """
    # Diagonal pivoting reveals the rank of G.
    n, pivot = len(rest), load(lanes, rest, 0, 0)
    for j in range(n):
        store(lanes, v, j, load(lanes, rest, 0, j))
    for i in range(1, n):
        diagonal = load(lanes, rest, i, i)
        larger = diagonal > pivot
        pivot = select(larger, diagonal, pivot)
        for j in range(n):
            store(lanes, v, j, select(larger, load(lanes, rest, i, j), load(lanes, v, j)))
    return pivot


ROUNDING = 2.0**-52  # spacing of floating-point numbers at 1: smaller pivots are rounding


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
    turned: FloatArray,
) -> None:
    """Correct an estimate, P (8): ``x += number S S' H' (y - H x)`` for the whitened reading ``y[b,
    s, h]``, of ``rows`` rows, and its H; ``projected`` and ``turned`` (n, L) are scratch.
    """
    n = x.shape[2]
    # H that is fixed has one block and one slot.
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
    # S' times that, then S times it: P itself is never formed.
    for j in range(n):
        total = spread(lanes, 0.0)
        for i in range(j, n):
            total += load(lanes, root, b, h, i, j) * load(lanes, projected, i)
        store(lanes, turned, j, total)
    for i in range(n):
        total = spread(lanes, 0.0)
        for j in range(i + 1):
            total += load(lanes, root, b, h, i, j) * load(lanes, turned, j)
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
    moved: FloatArray,
    factor: float,
) -> None:
    """Do one averaging step of all nodes of a block, P (9): add ``factor`` = 1 / delta times the
    differences to the estimates that arrive to z (B, H, n, L); ``moved`` (H, n, L) is scratch.
    """
    H, n = len(links.first) - 1, z.shape[2]
    # All differences before any estimate moves: the step is simultaneous.
    for h in range(H):
        for i in range(n):
            own, total = load(lanes, z, b, h, i), spread(lanes, 0.0)
            for m in range(links.first[h], links.first[h + 1]):
                arrived = load_flags(lanes, up, b, s, step, links.direction[m])
                difference = load(lanes, z, b, links.sender[m], i) - own
                total += select(arrived, difference, 0.0)
            # P (9): z <- z + (1 / delta) sum of the differences.
            store(lanes, moved, h, i, own + factor * total)
    for h in range(H):
        for i in range(n):
            store(lanes, z, b, h, i, load(lanes, moved, h, i))
