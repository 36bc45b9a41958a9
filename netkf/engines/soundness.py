"""Which estimates and covariances a run may go on with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from netkf.linalg.arrays import FloatArray

BoolArray = NDArray[np.bool_]


def stack_estimates(
    pairs: Sequence[tuple[FloatArray, FloatArray | None]],
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """What ``estimate`` of N filters returned as arrays: xhat (N, n), P (N, n, n), nan where a
    filter gives no covariance, and who is without one (N,).
    """
    xhat = np.array([mean for mean, _ in pairs])
    without = np.array([cov is None for _, cov in pairs])
    none = np.full((xhat.shape[1],) * 2, np.nan)
    P = np.array([none if cov is None else cov for _, cov in pairs])
    return xhat, P, without


INDEFINITE = 1e-9
"""The share of its largest eigenvalue by which a covariance may be negative: rounding stays far
below it.
"""


def sound(xhat: FloatArray, P: FloatArray, without: BoolArray | bool = False) -> BoolArray:
    """Whether estimates (..., n), in the coordinates that the filters compute in, are finite and
    their covariances (..., n, n) are finite and positive semidefinite, of nodes ``without`` one
    only whether estimates are finite. A run goes on while all are sound.
    """
    finite = np.isfinite(xhat).all(axis=-1)
    whole = np.asarray(np.isfinite(P).all(axis=(-1, -2)))
    semidefinite = _semidefinite(np.where(whole[..., None, None], P, 0.0))
    return np.asarray(finite & ((whole & semidefinite) | np.asarray(without)))


def _semidefinite(P: FloatArray) -> BoolArray:
    """Of symmetric (..., n, n). A Cholesky factor of P with a little added shows it at once."""
    size = np.abs(np.diagonal(P, axis1=-2, axis2=-1)).max(axis=-1, initial=0.0)
    little = (0.5 * INDEFINITE * size + np.finfo(float).tiny)[..., None, None]
    try:
        np.linalg.cholesky(P + little * np.eye(P.shape[-1]))
    except np.linalg.LinAlgError:
        values = np.linalg.eigvalsh(P)
        return np.asarray(values[..., 0] >= -INDEFINITE * np.abs(values).max(axis=-1))
    return np.ones(P.shape[:-2], dtype=bool)
