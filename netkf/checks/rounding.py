"""How far rounding may move what exact rows compare."""

from __future__ import annotations

import numpy as np

from netkf.checks.evidence import Finding, find_identity
from netkf.linalg.arrays import ArrayLike, FloatArray

EPS = float(np.finfo(np.float64).eps)
OPERATIONS = 1e3
"""Roundings of one relative error EPS each that may add up in one computed entry."""


def allowed_deviation(size: FloatArray, terms: ArrayLike, base: float) -> FloatArray:
    """Return the deviations that rounding explains, in the shape of ``size``; on the arguments see
    :func:`compare_identities`.
    """
    largest = np.maximum(np.broadcast_to(terms, np.shape(size)), size)
    return np.asarray(np.maximum(base * np.asarray(size), OPERATIONS * EPS * largest))


def first_wrong(gap: FloatArray, size: FloatArray, terms: ArrayLike, base: float) -> int | None:
    """Return the first run whose deviations ``gap`` (R, ..) exceed what rounding explains, or None;
    on the arguments see :func:`compare_identities`.
    """
    wrong = ~(np.asarray(gap) <= allowed_deviation(size, terms, base))
    runs = np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))
    return int(runs[0]) if len(runs) else None


def compare_identities(
    gap: FloatArray, size: FloatArray, terms: ArrayLike, base: float, message: str
) -> Finding:
    """Return the finding on many identities, all arrays of one shape: the worst of them.

    gap   : absolute deviations; nan or infinite ones exceed every finite one
    size  : sizes (at least 0) of the compared results, such as traces of covariances
    terms : sizes of the largest quantities that the results were computed from, by default the
            results: each rounds by EPS of its own size, which a smaller result inherits
    base  : share of ``size`` that is allowed in any case
    """
    off = np.nan_to_num(np.abs(np.asarray(gap, dtype=np.float64)), nan=np.inf).reshape(-1)
    scale = np.broadcast_to(size, np.shape(gap)).reshape(-1)
    largest = np.maximum(np.broadcast_to(terms, np.shape(gap)).reshape(-1), scale)
    if not len(off):
        return find_identity(0.0, base, message)
    limit = allowed_deviation(scale, largest, base)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(off > 0.0, off / limit, 0.0)
    worst = int(np.argmax(share))
    # Relative to the result itself, or if that is 0 to what it was computed from.
    unit = float(scale[worst] or largest[worst] or 1.0)
    return find_identity(float(off[worst]) / unit, float(limit[worst]) / unit, message)


def largest_terms(P: FloatArray, start: FloatArray, information: float = 0.0) -> FloatArray:
    """Return the size (R, K, N) of the largest terms from which covariances P (R, K, N, n, n) were
    computed.

    They are the largest trace so far at any node, ``start`` (N, n, n) included, since messages
    carry one node's covariance to another; and P^2 times ``information``, the norm of what all
    readings of one instant say: P = (P_before^-1 + information)^-1 has the roundings of the sum.
    """
    traces = np.nan_to_num(np.trace(P, axis1=-2, axis2=-1), nan=0.0, posinf=0.0)
    first = float(np.trace(start, axis1=-2, axis2=-1).max())
    until = np.maximum.accumulate(traces.max(axis=2, initial=first), axis=1)
    return np.asarray(np.maximum(until[..., None], information * traces**2))
