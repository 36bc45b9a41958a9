"""When a node of the push-sum filter freezes its network estimate, the information G^(i) of all
sensors and the number N^(i) of nodes: step 2.3 of paper P (Battilotti, Cacace and d'Angelo 2023),
and a safe form.

The rule of the paper also fires when all links of a node fail in one step, and then freezes a wrong
estimate. Both engines call these kernels, so that rounding is the same and a node stops in the same
slot.
"""

from __future__ import annotations

import math

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct

RULES = ("never", "safe", "paper")
NEVER, SAFE, PAPER = range(3)


class MassStep(Struct):
    """How the mass and the network estimate of one node changed in a step, for n states.

    before, mass : (2 + n n,), its mass before the step and after it: weight, number of nodes and
                   information (n, n) by rows
    former, information : (n, n), G^(i) of paper P (6), before and after
    former_number, number : (1,), N^(i), before and after
    work : (n, n), scratch
    """

    before: FloatArray
    mass: FloatArray
    former: FloatArray
    information: FloatArray
    former_number: FloatArray
    number: FloatArray
    work: FloatArray


@kernel
def has_stopped(rule: int, tolerance: float, step: MassStep, all_up: bool) -> bool:
    """Return True if a node stops after this ``step`` by ``rule``, an index in RULES. NEVER: it
    does not. PAPER: if it has information, whose change has a spectral norm below ``tolerance``.
    SAFE: if its network estimate changed by at most ``tolerance`` (relative) while all its links
    were up (``all_up``) and its weight is positive.
    """
    if rule == PAPER:
        # P step 2.3 waits until information has reached the node, since a mass of zero does not
        # change either.
        has_mass = False
        for i in range(2, len(step.mass)):
            has_mass = has_mass or step.mass[i] != 0.0
        return has_mass and moved_within(step.before, step.mass, tolerance, step.work)
    # SAFE trusts a step only if all links were up: in an outage estimates do not change either.
    if rule == SAFE and all_up and step.mass[0] > 0.0:
        return has_converged(
            step.former, step.information, step.former_number[0], step.number[0], tolerance
        )
    return False


@kernel
def moved_within(before: FloatArray, mass: FloatArray, bound: float, work: FloatArray) -> bool:
    """Return True if the change D (n, n) of the information, entries 2 and on of the masses
    ``before`` and ``mass`` (2 + n n,), has a spectral norm below ``bound``: both ``bound I - D``
    and ``bound I + D`` are positive definite. ``work`` (n, n) is scratch.
    """
    n = len(work)
    # |D_ii| < bound is necessary and cheap to test first. ``not <`` rejects nan.
    for i in range(n):
        index = 2 + i * n + i
        if not abs(mass[index] - before[index]) < bound:
            return False
    for sign in (-1.0, 1.0):
        for i in range(n):
            for j in range(n):
                index = 2 + i * n + j
                work[i, j] = sign * (mass[index] - before[index])
            work[i, i] += bound
        if not has_positive_pivots(work):
            return False
    return True


@kernel
def has_positive_pivots(work: FloatArray) -> bool:
    """Return True if the symmetric ``work`` (n, n) is positive definite: if its elimination meets
    positive pivots only. Overwrites ``work``, of which only the lower triangle is used.
    """
    n = len(work)
    for k in range(n):
        # ``not >`` rejects nan.
        if not work[k, k] > 0.0:
            return False
        for i in range(k + 1, n):
            # LDL' elimination of the lower triangle. By Sylvester's law of inertia the pivots D
            # have the signs of the eigenvalues.
            factor = work[i, k] / work[k, k]
            for j in range(k + 1, i + 1):
                work[i, j] -= factor * work[j, k]
    return True


@kernel
def has_converged(
    former: FloatArray,
    information: FloatArray,
    former_number: float,
    number: float,
    tolerance: float,
) -> bool:
    """Return True if a node's network estimate changed by at most ``tolerance`` (relative) in a
    step: the number of nodes N^(i) from ``former_number`` to ``number``, and the information G^(i)
    (n, n) from ``former`` to ``information``, in the Frobenius norm.
    """
    # ``not <`` rejects nan.
    if not abs(number - former_number) < tolerance * number:
        return False
    change = square = 0.0
    for i in range(len(information)):
        for j in range(len(information)):
            difference = information[i, j] - former[i, j]
            change += difference * difference
            square += information[i, j] * information[i, j]
    # <=, so that an information of 0 that stays 0 has converged.
    return math.sqrt(change) <= tolerance * math.sqrt(square)
