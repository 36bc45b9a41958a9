"""Covariance intersection: estimates whose errors may be correlated in any way, combined.

``P^-1 = sum w_j P_j^-1`` and ``xhat = P sum w_j P_j^-1 xhat_j`` with weights that sum to 1, D (8)
and (9). If every P_j is at least the covariance of its error, so is P, whatever the correlations;
and ``P <= sum w_j P_j``, since the inverse is operator convex.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from netkf.algorithms.kernels.square_root import lower_triangular
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import compilable
from netkf.linalg.small import applied, fill, fill_square, solution


def intersection(
    parts: Sequence[tuple[float, FloatArray, FloatArray]],
) -> tuple[FloatArray, FloatArray]:
    """``xhat`` (n,) and the root (n, n) of P, of parts (weight, mean (n,), root (n, n)).

    As a least-squares problem in the inverse roots, solved by one orthogonal triangularisation: no
    covariance is inverted and nothing is subtracted but the means.
    """
    weights = np.array([weight for weight, _, _ in parts])
    means, roots = (np.stack([part[k] for part in parts]) for k in (1, 2))
    return intersected(weights, means, roots)


@compilable
def intersected(
    weights: FloatArray, means: FloatArray, roots: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The same of arrays (k,), (k, n) and (k, n, n)."""
    k, n = means.shape
    # Its rows side by side, and no assignment of arrays: that takes seconds more of compiling.
    whole, unit = np.zeros((n + 1, max(k * n, n + 1))), np.eye(n)
    for m in range(k):
        if weights[m] > 0.0:
            whitened = np.sqrt(weights[m]) * solution(roots[m], unit)
            fill_square(whole[:n, m * n : (m + 1) * n], whitened.T)
            fill(whole[n, m * n : (m + 1) * n], applied(whitened, means[m] - means[0]))
    L = lower_triangular(whole)
    # What overflowed gives nan, and the run says that it diverged.
    combined = solution(L[:n, :n].T.copy(), unit)
    return means[0] + applied(combined, L[n, :n]), combined
