"""When a node of the push-sum filter stops learning: P step 2.3 and a safe form of it.

Loops in Python too: the same rounding stops a node in the same slot, compiled or not.
"""

from __future__ import annotations

import math

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import compilable

RULES = ("never", "safe", "paper")
NEVER, SAFE, PAPER = range(3)


@compilable
def stops(
    rule: int,
    tolerance: float,
    mass: FloatArray,
    before: FloatArray,
    whole: bool,
    information: FloatArray,
    number: float,
    former: FloatArray,
    former_number: float,
) -> bool:
    """Whether a node stops by ``rule`` (its place in RULES) when its mass (2 + n n,) has become
    ``mass`` from what it was ``before``, and what it makes of it ``information`` (n, n) and
    ``number`` from the ``former`` ones; ``whole``: all links of the node were up.
    """
    if rule == PAPER:
        n = len(information)
        seen = bool(np.any(mass[2:] != 0.0))
        return seen and within((mass[2:] - before[2:]).reshape(n, n), tolerance)
    if rule == SAFE and whole and mass[0] > 0.0:
        return settled(information, number, former, former_number, tolerance)
    return False


@compilable
def within(D: FloatArray, bound: float) -> bool:
    """Whether the spectral norm of a symmetric matrix (n, n) is less than ``bound``: whether
    ``bound I - D`` and ``bound I + D`` have positive pivots only.
    """
    n = len(D)
    for k in range(n):
        if not abs(D[k, k]) < bound:
            return False
    for sign in (-1.0, 1.0):
        work = sign * D
        for k in range(n):
            work[k, k] += bound
        for k in range(n):
            if not work[k, k] > 0.0:
                return False
            for i in range(k + 1, n):
                factor = work[i, k] / work[k, k]
                for j in range(k + 1, i + 1):
                    work[i, j] -= factor * work[j, k]
    return True


@compilable
def settled(
    information: FloatArray,
    number: float,
    former: FloatArray,
    former_number: float,
    tolerance: float,
) -> bool:
    """Whether G^(i) (n, n; Frobenius norm) and N^(i) moved by less than ``tolerance``, relative to
    what they are, from the ``former`` ones.
    """
    if not abs(number - former_number) < tolerance * number:
        return False
    moved = size = 0.0
    for i in range(len(information)):
        for j in range(len(information)):
            step = information[i, j] - former[i, j]
            moved += step * step
            size += information[i, j] * information[i, j]
    return math.sqrt(moved) <= tolerance * math.sqrt(size)
