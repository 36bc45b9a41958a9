"""Updates of estimates by readings and by messages, for square roots of P and for errors.

Every update has the form ``e+ = sum_j W_j e_j - K v``: the functions return W, K and a square root
of the new P.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.theory.numerics.prediction import triangular_root


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
    """Join observations of a state (n,) with independent noises into one."""
    if len(observations) == 1:
        return observations[0]
    H = np.concatenate([np.zeros((0, n)), *(one.H for one in observations)])
    R, root = (block_diagonal([one[k] for one in observations]) for k in (1, 2))
    return Observation(H, R, root)


def update_covariance_root(
    root: FloatArray, observation: Observation
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``I - K H`` (n, n), the Kalman gain K (n, p) and the root (n, n) of P after a reading.

    One orthogonal triangularisation of [[R^1/2, H S], [0, S]], so that no subtraction loses digits.
    """
    p, n = observation.H.shape
    if not p:
        return np.eye(n), np.zeros((n, 0)), root
    array = np.zeros((p + n, p + n))
    array[:p, :p] = np.linalg.cholesky(observation.R)
    array[:p, p:], array[p:, p:] = observation.H @ root, root
    # L = [[V^1/2, 0], [K V^1/2, P+^1/2]] with the innovation covariance V = H P H' + R.
    L = triangular_root(array)
    K = np.linalg.solve(L[:p, :p].T, L[p:, :p].T).T
    return np.eye(n) - K @ observation.H, np.asarray(K, dtype=np.float64), L[p:, p:]


def average_covariances(
    weights: list[float], roots: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the root (n, n) of ``sum_j w_j P_j`` and the factors (n, n) of the errors, H (7), (9).

    The estimate is the convex combination, so that each error is multiplied by its weight.
    """
    # sum w P = [w^1/2 S, ...] [w^1/2 S, ...]', a triangular root of which has n columns
    scaled = [np.sqrt(max(w, 0.0)) * S for w, S in zip(weights, roots, strict=True)]
    eye = np.eye(len(roots[0]))
    return triangular_root(np.concatenate(scaled, axis=1)), [w * eye for w in weights]


def intersect_covariances(
    weights: list[float], roots: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the root (n, n) of P and the factors (n, n) of covariance intersection, D (8), (9).

    ``P^-1 = sum_j w_j P_j^-1``; error j is multiplied by ``w_j P P_j^-1``.
    """
    # Weights that rounding left below zero would have no square root.
    used = [max(w, 0.0) for w in weights]
    inverses = [np.linalg.inv(S) for S in roots]
    stacked = np.concatenate([np.sqrt(w) * V for w, V in zip(used, inverses, strict=True)])
    root = np.linalg.inv(np.linalg.qr(stacked, mode="r"))
    P = root @ root.T
    return triangular_root(root), [w * P @ V.T @ V for w, V in zip(used, inverses, strict=True)]


def add_information_to_root(root: FloatArray, U: FloatArray) -> FloatArray:
    """Return a root (n, n) of ``(P^-1 + U)^-1`` for a positive semidefinite U (n, n)."""
    # (P^-1 + U)^-1 = S (I + S' U S)^-1 S' with P = S S'; P itself is never inverted.
    inner = np.eye(len(root)) + root.T @ (0.5 * (U + U.T)) @ root
    values, vectors = np.linalg.eigh(inner)
    # All eigenvalues are at least 1 but for rounding.
    return np.asarray(root @ (vectors / np.sqrt(np.maximum(values, 1.0))))
