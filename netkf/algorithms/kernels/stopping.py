"""When a node of the push-sum filter freezes its network estimate: P step 2.3 and a safe form.

Both engines call these kernels, so that rounding is the same and a node stops in the same slot.
"""

from __future__ import annotations

import math

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel

RULES = ("never", "safe", "paper")
NEVER, SAFE, PAPER = range(3)


@kernel
def has_stopped(
    rule: int,
    tolerance: float,
    mass: FloatArray,
    k: int,
    before: FloatArray,
    all_up: bool,
    information: FloatArray,
    number: FloatArray,
    former: FloatArray,
    former_number: FloatArray,
    work: FloatArray,
) -> bool:
    """Return True if a node stops by ``rule`` (its index in RULES) with this ``tolerance``.

    In this step its mass (2 + n n,) changed from ``before`` to ``mass[k]``, and its estimates of
    the network, P (6), from ``former[k]`` (n, n) and ``former_number[k]`` to ``information[0]`` and
    ``number[0]``. ``all_up``: all links of the node were up. ``work`` (n, n) is scratch.
    """
    if rule == PAPER:
        # P step 2.3 waits until information has reached the node, since a mass of zero does not
        # change either.
        has_mass = False
        for i in range(2, mass.shape[1]):
            has_mass = has_mass or mass[k, i] != 0.0
        return has_mass and moved_within(mass, k, before, tolerance, work)
    # SAFE trusts a step only if all links were up: in an outage estimates do not change either.
    if rule == SAFE and all_up and mass[k, 0] > 0.0:
        return has_converged(information, number[0], former, k, former_number[k], tolerance)
    return False


@kernel
def moved_within(
    mass: FloatArray, k: int, before: FloatArray, bound: float, work: FloatArray
) -> bool:
    """Return True if the change D of the information, from ``before`` to ``mass[k]``, has a
    spectral norm below ``bound``: both ``bound I - D`` and ``bound I + D`` are positive definite.
    """
    n = len(work)
    # |D_ii| < bound is necessary and cheap to test first. ``not <`` rejects nan.
    for i in range(n):
        index = 2 + i * n + i
        if not abs(mass[k, index] - before[index]) < bound:
            return False
    for sign in (-1.0, 1.0):
        for i in range(n):
            for j in range(n):
                index = 2 + i * n + j
                work[i, j] = sign * (mass[k, index] - before[index])
            work[i, i] += bound
        if not has_positive_pivots(work):
            return False
    return True


@kernel
def has_positive_pivots(work: FloatArray) -> bool:
    """Return True if elimination of the symmetric ``work`` (n, n) meets positive pivots only; it
    works in place.
    """
    n = len(work)
    for k in range(n):
        if not work[k, k] > 0.0:
            return False
        for i in range(k + 1, n):
            # LDL' elimination of the lower triangle; by Sylvester's law the pivots carry the
            # inertia.
            factor = work[i, k] / work[k, k]
            for j in range(k + 1, i + 1):
                work[i, j] -= factor * work[j, k]
    return True


@kernel
def has_converged(
    information: FloatArray,
    number: float,
    former: FloatArray,
    k: int,
    former_number: float,
    tolerance: float,
) -> bool:
    """Return True if N^(i) and G^(i) changed by less than ``tolerance``, relative to their present
    values: from ``former_number`` to ``number``, and from ``former[k]`` to ``information[0]`` (n,
    n) in the Frobenius norm.
    """
    if not abs(number - former_number) < tolerance * number:
        return False
    n = information.shape[1]
    change = size = 0.0
    for i in range(n):
        for j in range(n):
            step = information[0, i, j] - former[k, i, j]
            change += step * step
            # The Frobenius norm of the new G, by which the step is scaled.
            size += information[0, i, j] * information[0, i, j]
    return math.sqrt(change) <= tolerance * math.sqrt(size)
