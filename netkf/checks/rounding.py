"""Bounds on rounding errors, for rows that compare two computations of the same values."""

from __future__ import annotations

import numpy as np

from netkf.checks.evidence import Finding, find_identity
from netkf.linalg.arrays import ArrayLike, FloatArray

EPS = float(np.finfo(np.float64).eps)  # 2.2e-16
OPERATIONS = 1e3
"""Number of relative errors EPS that may accumulate in one computed entry."""


def allowed_deviation(size: FloatArray, terms: ArrayLike, base: float) -> FloatArray:
    """Return the largest deviations that rounding explains, in the shape of ``size``.

    ``size`` are the sizes of the compared results, ``terms`` (a shape that broadcasts) those of the
    largest quantities that they were computed from, and ``base`` is the share of ``size`` that is
    allowed in any case.
    """
    largest = np.maximum(np.broadcast_to(terms, np.shape(size)), size)
    return np.asarray(np.maximum(base * np.asarray(size), OPERATIONS * EPS * largest))


def first_wrong(gap: FloatArray, size: FloatArray, terms: ArrayLike, base: float) -> int | None:
    """Return the index of the first run whose deviations ``gap`` (R, ...) exceed what rounding
    explains, so that it can be replayed; None if there is none.

    ``size`` (R, ...) and ``terms`` are the sizes of the results and of the largest quantities that
    they were computed from, ``base`` the share of ``size`` that is allowed in any case.
    """
    wrong = ~(np.asarray(gap) <= allowed_deviation(size, terms, base))
    runs = np.flatnonzero(wrong.reshape(len(wrong), -1).any(axis=1))
    return int(runs[0]) if len(runs) else None


def compare_identities(
    gap: FloatArray, size: FloatArray, terms: ArrayLike, base: float, message: str
) -> Finding:
    """Return the finding on many pairs of values that should be equal up to rounding, such as
    covariances and their replay: the pair with the largest deviation relative to what rounding
    explains decides.

    gap   : absolute deviations (R, ...); nan or infinite ones exceed every finite one
    size  : sizes (at least 0) of the compared results, such as traces of covariances, in the shape
            of ``gap``
    terms : sizes of the largest quantities that the results were computed from, in a shape that
            broadcasts: a small difference of large terms has the rounding errors, EPS relative, of
            the large terms
    base  : share of ``size`` that is allowed in any case
    """
    deviations = np.nan_to_num(np.abs(np.asarray(gap, dtype=np.float64)), nan=np.inf).reshape(-1)
    scale = np.broadcast_to(size, np.shape(gap)).reshape(-1)
    largest = np.maximum(np.broadcast_to(terms, np.shape(gap)).reshape(-1), scale)
    if not len(deviations):
        return find_identity(0.0, base, message)
    limit = allowed_deviation(scale, largest, base)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(deviations > 0.0, deviations / limit, 0.0)
    worst_index = int(np.argmax(relative))
    # Relative to the size of the result or, if that is 0, of the terms.
    unit = float(scale[worst_index] or largest[worst_index] or 1.0)
    return find_identity(
        float(deviations[worst_index]) / unit, float(limit[worst_index]) / unit, message
    )


def largest_terms(P: FloatArray, start: FloatArray, information: float = 0.0) -> FloatArray:
    """Return the size (R, K, N) of the largest terms from which covariances P (R, K, N, n, n) were
    computed.

    They are the largest trace so far at any node, ``start`` (N, n, n) included, since messages
    carry one node's covariance to another; and P^2 times ``information``, the norm of H' R^-1 H of
    all readings at one instant: P = (P_before^-1 + information)^-1 inherits the rounding errors of
    the sum.
    """
    traces = np.nan_to_num(np.trace(P, axis1=-2, axis2=-1), nan=0.0, posinf=0.0)
    first = float(np.trace(start, axis1=-2, axis2=-1).max())
    until = np.maximum.accumulate(traces.max(axis=2, initial=first), axis=1)
    return np.asarray(np.maximum(until[..., None], information * traces**2))
