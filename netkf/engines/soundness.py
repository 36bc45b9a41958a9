"""The test of estimates and covariances that ends a run as diverged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from netkf.linalg.arrays import FloatArray

BoolArray = NDArray[np.bool_]


def stack_estimates(
    pairs: Sequence[tuple[FloatArray, FloatArray | None]],
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Stack ``pairs``, the results (xhat (n,), P (n, n) or None) of ``estimate`` of N filters.

    Returns xhat (N, n), P (N, n, n), nan for a filter without covariance, and a mask (N,) of these
    filters.
    """
    xhat = np.array([mean for mean, _ in pairs])
    without = np.array([cov is None for _, cov in pairs])
    none = np.full((xhat.shape[1],) * 2, np.nan)
    P = np.array([none if cov is None else cov for _, cov in pairs])
    return xhat, P, without


INDEFINITE = 1e-9
"""The tolerated negative eigenvalue, as a share of the largest; rounding errors are far smaller."""


def sound_mask(xhat: FloatArray, P: FloatArray, without: BoolArray | bool = False) -> BoolArray:
    """Return a mask (...) of sound pairs of estimates ``xhat`` (..., n) and covariances ``P``
    (..., n, n).

    Both must be finite, and the covariance positive semidefinite; a filter ``without`` covariance
    (mask (...), or False for none) needs only a finite estimate. Estimates are in the coordinates
    that the filters compute in. A run continues while all pairs are sound.
    """
    finite = np.isfinite(xhat).all(axis=-1)
    whole = np.asarray(np.isfinite(P).all(axis=(-1, -2)))
    semidefinite = _semidefinite(np.where(whole[..., None, None], P, 0.0))
    return np.asarray(finite & ((whole & semidefinite) | np.asarray(without)))


def _semidefinite(P: FloatArray) -> BoolArray:
    """Return a mask (...) of the symmetric matrices ``P`` (..., n, n) that are positive
    semidefinite up to rounding: no eigenvalue is below minus the share INDEFINITE of the largest
    one.
    """
    # A Cholesky factor of P plus a little is much cheaper than its eigenvalues, and nearly always
    # exists.
    size = np.abs(np.diagonal(P, axis1=-2, axis2=-1)).max(axis=-1, initial=0.0)
    little = (0.5 * INDEFINITE * size + np.finfo(float).tiny)[..., None, None]
    try:
        np.linalg.cholesky(P + little * np.eye(P.shape[-1]))
    except np.linalg.LinAlgError:
        values = np.linalg.eigvalsh(P)
        return np.asarray(values[..., 0] >= -INDEFINITE * np.abs(values).max(axis=-1))
    return np.ones(P.shape[:-2], dtype=bool)
