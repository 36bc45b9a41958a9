"""Covariance intersection: estimates whose errors may be correlated in any way, combined.

``P^-1 = sum w_j P_j^-1`` and ``xhat = P sum w_j P_j^-1 xhat_j`` with weights that sum to 1, D (8)
and (9). If every P_j is at least the covariance of its error, so is P, whatever the correlations;
and ``P <= sum w_j P_j``, since the inverse is operator convex.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dgesv

from netkf.core.arrays import FloatArray


def intersection(
    parts: Sequence[tuple[float, FloatArray, FloatArray]],
) -> tuple[FloatArray, FloatArray]:
    """``xhat`` (n,) and the root (n, n) of P, of parts (weight, mean (n,), root (n, n)).

    As a least-squares problem in the inverse roots, solved by one orthogonal triangularisation: no
    covariance is inverted and nothing is subtracted but the means.
    """
    n, first = len(parts[0][1]), parts[0][1]
    rows = []
    for weight, mean, root in parts:
        if weight > 0.0:
            whitened = np.sqrt(weight) * _inverse(root)
            rows.append(np.concatenate([whitened, (whitened @ (mean - first))[:, None]], axis=1))
    R = np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))
    combined = _inverse(R[:n, :n])
    return first + combined @ R[:n, n], combined


def _inverse(matrix: FloatArray) -> FloatArray:
    # LAPACK itself: what overflowed gives nan, and the run says that it diverged.
    _, _, solution, info = dgesv(matrix, np.eye(len(matrix)))
    return np.full_like(matrix, np.nan) if info else np.asarray(solution)
