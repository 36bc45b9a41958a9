"""Push-sum in kernels: mass that is shared and mixed, what a node learns from it, averaging.

A mass is (2 + n n,): the weight w, the number of nodes n~ and the information C~ of P (3)-(5). The
order of every sum is fixed, since the rounding of the mass decides in which slot a node stops.
"""

from __future__ import annotations

import math

from netkf.algorithms.kernels.root_update import UpdateScratch, rotate_out
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel


@kernel
def split_mass(mass: FloatArray, k: int, degree: int, share: FloatArray, h: int) -> None:
    """Write into ``share[h]`` what the node of place ``k`` and ``degree`` sends to each of its
    neighbours: its mass over degree + 1.
    """
    # P (3)-(5) with equal weights 1 / (degree + 1); the quotient is formed once, so all neighbours
    # are sent the same bits.
    for i in range(mass.shape[1]):
        share[h, i] = mass[k, i] / (degree + 1)


@kernel
def keep_share(mass: FloatArray, k: int, share: FloatArray, h: int, times: int) -> None:
    """Add to the mass of place ``k``, which is what it received, its own share: once for itself and
    once for each link of the node that failed, ``times`` in all; P (3)-(5) as they conserve sums.
    """
    # A share that could not be sent stays here: the network's sums of w, n~ and C~ stay conserved.
    for i in range(mass.shape[1]):
        mass[k, i] = times * share[h, i] + mass[k, i]


@kernel
def learn_network(
    mass: FloatArray, k: int, alone: FloatArray, h: int, information: FloatArray, number: FloatArray
) -> None:
    """P (6): write C~ / w and n~ / w of place ``k`` into ``information`` (1, n, n) and ``number``
    (1,), or what the node knows of itself, ``alone[h]``, while its weight is exactly 0.
    """
    # P (6): G = C~ / w and N = n~ / w.
    n, weight = information.shape[1], mass[k, 0]
    for i in range(n):
        # Only one triangle is computed; mirroring it makes G symmetric bit for bit.
        for j in range(i + 1):
            value = alone[h, i, j]
            if weight != 0.0:
                # The mean of both triangles, because C~ is symmetric only up to the rounding of its
                # sums.
                upper, lower = mass[k, 2 + i * n + j] / weight, mass[k, 2 + j * n + i] / weight
                value = 0.5 * (upper + lower)
            information[0, i, j] = information[0, j, i] = value
    number[0] = 1.0 if weight == 0.0 else mass[k, 1] / weight


@kernel(inlined=True)
def correct_root(
    root: FloatArray,
    k: int,
    information: FloatArray,
    m: int,
    rest: FloatArray,
    room: UpdateScratch,
) -> None:
    """Make place ``k`` the root of ``(P^-1 + G)^-1 = P (I + G P)^-1``, P (7), for the information G
    of place ``m`` (n, n); ``rest`` (n, n) is scratch.
    """
    # G = sum v v' by Cholesky with the largest pivot first, and each v' is a row that is observed
    # with noise of variance 1: nothing is inverted, and P may be singular.
    n, largest = root.shape[1], 0.0
    # The whole diagonal gives the scale of G, against which a later pivot counts as rounding.
    for i in range(n):
        largest = max(largest, information[m, i, i])
        for j in range(n):
            rest[i, j] = information[m, i, j]
    for _ in range(n):
        # Largest remaining diagonal entry: diagonal pivoting reveals the rank of G.
        best = 0
        for i in range(1, n):
            if rest[i, i] > rest[best, best]:
                best = i
        pivot = rest[best, best]
        # The rest is rounding of G: G has no further rank to use. ``not >`` also ends on nan.
        if not pivot > ROUNDING * n * largest:
            return
        size = math.sqrt(pivot)
        # v' S, with v' = rest[best] / sqrt(pivot) the next row of the Cholesky factor.
        for j in range(n):
            total = 0.0
            for i in range(j, n):
                total += rest[best, i] / size * root[k, i, j]
            room.HS[0, j] = total
        # P <- P - P v v' P / (1 + v' P v) on the root. The state is not corrected here: P (8) does
        # that.
        rotate_out(room.size, root, k, room.HS, 0, room.gains, 1.0)
        # Deflate, rest -= v v'. The gain of the rotation is spent, so its row holds v.
        for i in range(n):
            room.gains[0, i] = rest[best, i] / size
        for i in range(n):
            for j in range(n):
                rest[i, j] -= room.gains[0, i] * room.gains[0, j]


ROUNDING = 2.0**-52


@kernel(inlined=True)
def add_gain(
    x: FloatArray,
    root: FloatArray,
    k: int,
    number: float,
    y: FloatArray,
    H: FloatArray,
    rows: int,
    room: FloatArray,
) -> None:
    """P (8): add ``number`` times ``S S' H' (y - H x)`` to place ``k`` of x (K, n), for a whitened
    reading of so many ``rows``; ``room`` (2, n) is scratch.
    """
    n = x.shape[1]
    # H' (y - H x); the noise is white with variance 1, so no R^-1 appears.
    for i in range(n):
        room[0, i] = 0.0
    for row in range(rows):
        innovation = y[row]
        for i in range(n):
            innovation -= H[row, i] * x[k, i]
        for i in range(n):
            room[0, i] += H[row, i] * innovation
    # S' times that, then S times it: P itself is never formed.
    for j in range(n):
        total = 0.0
        for i in range(j, n):
            total += root[k, i, j] * room[0, i]
        room[1, j] = total
    for i in range(n):
        total = 0.0
        for j in range(i + 1):
            total += root[k, i, j] * room[1, j]
        x[k, i] += number * total
