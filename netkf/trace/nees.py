"""Squared errors and normalised squared errors (NEES), and when rounding blurs them."""

from __future__ import annotations

import math

import numpy as np

from netkf.linalg.arrays import FloatArray, is_definite
from netkf.linalg.compiling import kernel
from netkf.linalg.small import solve_inplace
from netkf.linalg.structs import Size, sized

ROUNDING = 4.0 * np.finfo(float).eps  # rounding error of x - xhat as a share of the size of x
BLUR = 100.0
"""Errors with a standard deviation below BLUR times their rounding error are not judged."""


def errors(e: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the squared error ``e' e`` (...) and NEES ``e' P^-1 e`` (...) of errors e (..., n) and
    covariances P (..., n, n); NEES is nan where P is nan or exactly singular. If some P is exactly
    singular, it is also nan where others are singular up to rounding.
    """
    n, shape = e.shape[-1], e.shape[:-1]
    e, P = without_padding(e, P)
    with np.errstate(all="ignore"):
        square = (e * e).sum(axis=-1)
        flat = e.reshape(1, -1, n), P.reshape(1, -1, n, n)
        nees = nees_of_runs(*flat, np.array([flat[0].shape[1]]))
    return np.asarray(square), nees.reshape(shape)


def without_padding(e: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return errors e (..., n) and covariances P (..., n, n) in which states that a node does not
    estimate, nan in both beside others that it does, have the error 0 and the variance 1.
    """
    missing = np.isnan(e)
    if not missing.any():
        return e, P
    padded = missing & ~missing.all(axis=-1, keepdims=True)
    padded &= np.isnan(np.diagonal(P, axis1=-2, axis2=-1))
    outside = padded[..., :, None] | padded[..., None, :]
    return np.where(padded, 0.0, e), np.where(outside, np.eye(e.shape[-1]), P)


def traces(P: FloatArray) -> FloatArray:
    """Return the traces (...) of covariances P (..., n, n) over the states that a node estimates,
    nan where all of P is.
    """
    variances = np.diagonal(P, axis1=-2, axis2=-1)
    missing = np.isnan(variances)
    if not missing.any():
        return np.asarray(variances.sum(axis=-1))
    return np.where(missing.all(axis=-1), np.nan, np.nansum(variances, axis=-1))


def nees_of_runs(e: FloatArray, P: FloatArray, lengths: np.ndarray) -> FloatArray:
    """Return NEES (R, K) of R runs, each as :func:`errors` does, from errors e (R, K, n) and
    covariances P (R, K, n, n), of which run r has ``lengths[r]``; the others are unspecified.
    """
    n = e.shape[-1]
    e, P = np.ascontiguousarray(e), np.ascontiguousarray(P)
    nees, regular = np.empty(e.shape[:-1]), np.ones(len(e), dtype=np.bool_)
    fill_nees(sized(n), e, P, lengths, nees, regular, np.empty((n, n)), np.empty((n, 1)))
    for r in np.flatnonzero(~regular):
        kept = P[r, : lengths[r]]
        usable = np.asarray(np.isfinite(kept).all(axis=(1, 2)))
        usable[usable] = is_definite(kept[usable])
        nees[r, : lengths[r]][~usable] = np.nan
    return nees


@kernel
def fill_nees(
    size: Size,
    e: FloatArray,
    P: FloatArray,
    lengths: np.ndarray,
    out: FloatArray,
    regular: np.ndarray,
    factor: FloatArray,
    solved: FloatArray,
) -> None:
    """Write NEES into ``out`` (R, K), nan where P is exactly singular; set ``regular`` (R,) to
    False for runs with an exactly singular P. ``factor`` (n, n), ``solved`` (n, 1): scratch.
    """
    n = len(size)
    for r in range(len(e)):
        for k in range(lengths[r]):
            definite, total = True, 0.0
            for i in range(n):
                solved[i, 0] = e[r, k, i]
                for j in range(i + 1):
                    factor[i, j] = P[r, k, i, j]
            # P = G D G' with G unit lower triangular, and e' P^-1 e = z' D^-1 z with G z = e.
            for j in range(n):
                inverse, z = 1.0 / factor[j, j], solved[j, 0]
                definite = definite and factor[j, j] > 0.0
                total += z * z * inverse
                for i in range(j + 1, n):
                    share = factor[i, j] * inverse
                    for m in range(j + 1, i + 1):
                        factor[i, m] -= share * factor[m, j]
                    solved[i, 0] -= share * z
            out[r, k] = total
            if not definite and not fill_indefinite(e, P, r, k, out, factor, solved):
                regular[r] = False


@kernel
def fill_indefinite(
    e: FloatArray, P: FloatArray, r: int, k: int, out: FloatArray, L: FloatArray, solved: FloatArray
) -> bool:
    """Write NEES of sample ``k`` of run ``r``, whose P is not positive definite, by elimination
    with pivoting; return False if P is finite and exactly singular.
    """
    finite, n = True, e.shape[2]
    for i in range(n):
        solved[i, 0] = e[r, k, i]
        finite = finite and np.isfinite(e[r, k, i])
        for j in range(n):
            L[i, j] = P[r, k, i, j]
            finite = finite and np.isfinite(P[r, k, i, j])
    solve_inplace(L, solved, n)  # solved = P^-1 e
    out[r, k] = 0.0
    for i in range(n):
        out[r, k] += e[r, k, i] * solved[i, 0]
    return not (finite and np.isnan(solved[0, 0]))


def blurred_from(
    times: FloatArray,
    x: FloatArray,
    P: FloatArray,
    e: FloatArray,
    lengths: np.ndarray,
    exact: bool = False,
) -> FloatArray:
    """Return for each of R runs the first of its sample ``times`` (T,), in seconds, from which on
    errors mean little, or inf: rounding of x - xhat exceeds 1 / BLUR of their deviation.

    The rounding error is that of states x (R, T, n), with ``exact`` errors that of the errors e
    (R, T, N, n), which a node may have passed on to others. The standard deviation is the smallest
    of P (R, T, N, n, n) or, if nan, the root mean square of e. Run r has ``lengths[r]`` samples.
    """
    first = np.full(len(x), np.inf)
    e, P = without_padding(e, P)
    sizes = (e if exact else x).reshape(*x.shape[:2], -1)
    sizes, P, e = (np.ascontiguousarray(part) for part in (sizes, P, e))
    find_blurred(sized(P.shape[-1]), np.ascontiguousarray(times), sizes, P, e, lengths, first)
    return first


@kernel
def find_blurred(
    size: Size,
    times: FloatArray,
    sizes: FloatArray,
    P: FloatArray,
    e: FloatArray,
    lengths: np.ndarray,
    first: FloatArray,
) -> None:
    """Set ``first`` (R,) to the first time at which a sample is blurred, see ``blurred_from``;
    numbers as large as ``sizes`` (R, T, m) were rounded.
    """
    for r in range(len(first)):
        for t in range(lengths[r]):
            largest, variance, unknown = 0.0, np.inf, False
            for i in range(sizes.shape[2]):
                largest = max(largest, abs(sizes[r, t, i]))
                unknown = unknown or np.isnan(sizes[r, t, i])
            for f in range(P.shape[2]):
                for i in range(len(size)):
                    variance = min(variance, P[r, t, f, i, i])
                    unknown = unknown or np.isnan(P[r, t, f, i, i])
            if unknown:
                variance = variance_of_errors(P, e, r, t)
            rounding = ROUNDING * BLUR * largest
            if 0.0 < variance < rounding * rounding:
                first[r] = times[t]
                break


@kernel
def variance_of_errors(P: FloatArray, e: FloatArray, r: int, t: int) -> float:
    """Return the mean square error of sample ``t`` of run ``r`` if all of P is nan, else nan."""
    filters, n = e.shape[2:]
    total = 0.0
    for f in range(filters):
        for i in range(n):
            total += e[r, t, f, i] * e[r, t, f, i]
            for j in range(n):
                if not np.isnan(P[r, t, f, i, j]):
                    return math.nan
    return float(total / (filters * n))
