"""What filters do with readings and with what they hear, for roots of P and for errors: each move
of an estimate is ``e+ = sum W_j e_j - K v``, and the functions here give W, K and the root of P.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.theory.numerics.gaps import lower_root


class Seen(NamedTuple):
    """Readings at one instant: ``H`` (p, n), ``R`` (p, p) as believed, and a ``root`` (p, p) of
    what it really is.
    """

    H: FloatArray
    R: FloatArray
    root: FloatArray


def together(readings: list[Seen], n: int) -> Seen:
    """As one."""
    if len(readings) == 1:
        return readings[0]
    H = np.concatenate([np.zeros((0, n)), *(seen.H for seen in readings)])
    R, root = (block_diagonal([seen[k] for seen in readings]) for k in (1, 2))
    return Seen(H, R, root)


def kalman(root: FloatArray, seen: Seen) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``I - K H``, K and the new root, by one triangular root of [[R^1/2, H S], [0, S]]."""
    p, n = seen.H.shape
    if not p:
        return np.eye(n), np.zeros((n, 0)), root
    whole = np.zeros((p + n, p + n))
    whole[:p, :p], whole[:p, p:], whole[p:, p:] = np.linalg.cholesky(seen.R), seen.H @ root, root
    L = lower_root(whole)
    K = np.linalg.solve(L[:p, :p].T, L[p:, :p].T).T
    return np.eye(n) - K @ seen.H, np.asarray(K, dtype=np.float64), L[p:, p:]


def convex(weights: list[float], roots: list[FloatArray]) -> tuple[FloatArray, list[FloatArray]]:
    """H (7), (9): the root of ``sum w P`` and what each error is multiplied by."""
    scaled = [np.sqrt(max(w, 0.0)) * S for w, S in zip(weights, roots, strict=True)]
    eye = np.eye(len(roots[0]))
    return lower_root(np.concatenate(scaled, axis=1)), [w * eye for w in weights]


def intersected(
    weights: list[float], roots: list[FloatArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """D (8), (9): covariance intersection, ``P^-1 = sum w P_j^-1`` and ``w P P_j^-1``."""
    used = [max(w, 0.0) for w in weights]
    inverses = [np.linalg.inv(S) for S in roots]
    stacked = np.concatenate([np.sqrt(w) * V for w, V in zip(used, inverses, strict=True)])
    root = np.linalg.inv(np.linalg.qr(stacked, mode="r"))
    P = root @ root.T
    return lower_root(root), [w * P @ V.T @ V for w, V in zip(used, inverses, strict=True)]


def informed(root: FloatArray, U: FloatArray) -> FloatArray:
    """A root of ``(P^-1 + U)^-1`` for a positive semidefinite U (n, n)."""
    inner = np.eye(len(root)) + root.T @ (0.5 * (U + U.T)) @ root
    values, vectors = np.linalg.eigh(inner)
    return np.asarray(root @ (vectors / np.sqrt(np.maximum(values, 1.0))))
