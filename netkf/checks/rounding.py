"""Bounds on rounding errors, for rows that compare two computations of the same values."""

from __future__ import annotations

import numpy as np

from netkf.checks.evidence import Finding, find_identity
from netkf.linalg.arrays import ArrayLike, FloatArray

EPS = float(np.finfo(np.float64).eps)  # 2.2e-16
OPERATIONS = 1e3
"""Number of relative errors EPS that may accumulate in one computed entry."""


def allowed_deviation(size: FloatArray, terms: ArrayLike, base: float) -> FloatArray:
    """Return what rounding explains: ``base`` of the ``size``, or rounding of their ``terms``."""
    largest = np.maximum(np.broadcast_to(terms, np.shape(size)), size)
    return np.asarray(np.maximum(base * np.asarray(size), OPERATIONS * EPS * largest))


def compare_identities(
    gap: FloatArray, size: FloatArray, terms: ArrayLike, base: float, message: str
) -> Finding:
    """Return the finding on values of R runs that should be equal up to rounding, and the first run
    where they are not: the pair whose deviation ``gap`` (R, ...) is largest relative to
    :func:`allowed_deviation` of ``size``, ``terms``, ``base`` decides.
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
    wrong = np.flatnonzero(deviations > limit)
    return find_identity(
        float(deviations[worst_index]) / unit, float(limit[worst_index]) / unit, message
    )._replace(replica=int(wrong[0] * len(gap) // len(deviations)) if len(wrong) else None)


def largest_terms(P: FloatArray, start: FloatArray, information: float = 0.0) -> FloatArray:
    """Return the sizes (R, K, N) of the largest terms of which P was computed: traces so far,
    ``start``, and P^2 times the ``information`` H' R^-1 H.
    """
    traces = np.nan_to_num(np.trace(P, axis1=-2, axis2=-1), nan=0.0, posinf=0.0)
    first = float(np.trace(start, axis1=-2, axis2=-1).max())
    until = np.maximum.accumulate(traces.max(axis=2, initial=first), axis=1)
    return np.asarray(np.maximum(until[..., None], information * traces**2))
