"""Updates of estimates by readings and by messages, for square roots of P and for errors.

Every update has the form ``e+ = sum_j W_j e_j - K v``: the functions return W, K and a square root
of the new P.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, as_kernel_array, block_diagonal
from netkf.theory.numerics.roots import (
    add_information,
    average_roots,
    intersect_with_factors,
    update_root,
)


class Observation(NamedTuple):
    """Readings at one instant.

    H    : (p, n)
    R    : (p, p) noise covariance that the filter assumes
    root : (p, p) a square root of the true noise covariance
    """

    H: FloatArray
    R: FloatArray
    root: FloatArray


def stack_observations(observations: list[Observation], n: int) -> Observation:
    """Join ``observations`` of a state (n,) with independent noises into one: H (p, n) stacked, R
    and root (p, p) block diagonal, for p readings together.
    """
    if len(observations) == 1:
        return observations[0]
    H = np.concatenate([np.zeros((0, n)), *(observation.H for observation in observations)])
    R, root = (block_diagonal([observation[k] for observation in observations]) for k in (1, 2))
    return Observation(H, R, root)


def update_covariance_root(
    root: FloatArray, observation: Observation
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``I - K H`` (n, n), the Kalman gain K (n, p) and the root (n, n) of P after a reading.

    ``root`` (n, n) is that of P before the reading. By one orthogonal triangularisation of [[R^1/2,
    H S], [0, S]], so that no subtraction loses digits.
    """
    p, n = observation.H.shape
    if not p:
        return np.eye(n), np.zeros((n, 0)), root
    return update_root(root, *(as_kernel_array(part) for part in observation[:2]))


def average_covariances(
    weights: list[float], roots: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the reset of the hybrid paper, H (7) and (9), in which a node averages J estimates and
    their P_j: the root (n, n) of ``sum_j w_j P_j``, and the factors (J, n, n) by which the new
    error combines the J errors.

    ``weights`` are J numbers that add up to 1, ``roots`` J roots (n, n) of the P_j. The estimate is
    the convex combination, so that each error is multiplied by its weight.
    """
    weight_array = np.array(weights, dtype=float)
    return average_roots(weight_array, np.stack(roots)), weight_array[:, None, None] * np.eye(
        len(roots[0])
    )


def intersect_covariances(
    weights: list[float], roots: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance intersection of J estimates, D (8) and (9) of the diffusion paper: the
    root (n, n) of the new P, and the factors (J, n, n) by which the new error combines the errors.

    ``weights`` are J numbers that add up to 1, ``roots`` J roots (n, n) of the P_j.
    ``P^-1 = sum_j w_j P_j^-1``; error j is multiplied by ``w_j P P_j^-1``.
    """
    result: tuple[FloatArray, FloatArray] = intersect_with_factors(
        np.array(weights, dtype=float), np.stack(roots)
    )
    return result


def add_information_to_root(root: FloatArray, U: FloatArray) -> FloatArray:
    """Return a root (n, n) of ``(P^-1 + U)^-1`` for ``root`` (n, n) of P and a positive
    semidefinite information matrix U (n, n).
    """
    result: FloatArray = add_information(root, U)
    return result
