"""Squared errors and normalised squared errors (NEES) of estimates."""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray, is_definite
from netkf.linalg.compiling import kernel
from netkf.linalg.small import solve_inplace


def errors(e: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the squared error ``e' e`` (...) and NEES ``e' P^-1 e`` (...) of errors e (..., n) and
    covariances P (..., n, n); NEES is nan where P is nan or exactly singular. If some P is exactly
    singular, it is also nan where others are singular up to rounding.
    """
    n, shape = e.shape[-1], e.shape[:-1]
    flat, nees = np.ascontiguousarray(e).reshape(-1, n), np.empty(shape)
    with np.errstate(all="ignore"):
        square = (e * e).sum(axis=-1)
        matrices = np.ascontiguousarray(P).reshape(-1, n, n)
        if not fill_nees(flat, matrices, nees.reshape(-1), np.empty((n, n)), np.empty((n, 1))):
            nees.reshape(-1)[~_is_regular(matrices)] = np.nan
    return np.asarray(square), nees


@kernel
def fill_nees(
    e: FloatArray, P: FloatArray, out: FloatArray, factor: FloatArray, solved: FloatArray
) -> bool:
    """Write the normalised squared errors (NEES) ``e' P^-1 e`` into ``out`` (K,), of K errors e (K,
    n) and covariances P (K, n, n), nan where P is exactly singular; return False if some finite P
    is exactly singular.

    The caller then tests the ranks of all P, which takes longer. ``factor`` (n, n) and ``solved``
    (n, 1) are scratch.
    """
    regular, n = True, e.shape[1]
    for k in range(len(e)):
        finite = True
        for i in range(n):
            solved[i, 0] = e[k, i]
            finite = finite and np.isfinite(e[k, i])
            for j in range(n):
                factor[i, j] = P[k, i, j]
                finite = finite and np.isfinite(P[k, i, j])
        solve_inplace(factor, solved, n)  # solved = P^-1 e
        out[k] = 0.0
        for i in range(n):
            out[k] += e[k, i] * solved[i, 0]
        if finite and np.isnan(solved[0, 0]):
            regular = False
    return regular


def _is_regular(P: FloatArray) -> np.ndarray:
    """Return a mask (K,) of finite P (K, n, n) of full rank up to rounding."""
    regular = np.asarray(np.isfinite(P).all(axis=(1, 2)))
    regular[regular] = is_definite(P[regular])
    return regular
