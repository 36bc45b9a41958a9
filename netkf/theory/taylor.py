"""H(12) without delay by Taylor series: the right-hand side is quadratic, so coefficients of any
order cost about one evaluation each (Moore 1966; Barton, Willers and Zahar 1971).
"""

from __future__ import annotations

import numpy as np

from netkf.core.arrays import FloatArray
from netkf.core.errors import TheoryError
from netkf.theory.packed import Packed

ORDER = 28
LAST_TERM = 1e-12  # of the series, relative to the largest entry of the matrix
DEFECT = 1e-10  # of a step: its length times what the derivative misses the slope by, relative
FLOOR = 1e-13  # times the scale of the problem: what no matrix need be more precise than
SHORTER, MOST_TRIES = 0.7, 40


class StiffError(Exception):
    """Steps would be so short that an implicit method is cheaper."""


def followed(packed: Packed, times: FloatArray, scale: float, most: int, limit: float) -> FloatArray:
    """(T, N, m): the solution at ``times`` (increasing), from ``packed.start`` at 0.

    Each step is accepted when its last terms are negligible and its polynomial obeys the equation
    at its end; ``scale`` is the size of a covariance that matters. Raises StiffError after ``most``
    coefficients or where steps come to nothing, and TheoryError beyond ``limit``.
    """
    Y, now = packed.start, 0.0
    out = np.empty((len(times), *Y.shape))
    done = int(np.searchsorted(times, 0.0, side="right"))
    out[:done] = Y
    slope = packed.slope(Y)
    span = float(np.abs(Y).max() + scale) / max(float(np.abs(slope).max()), 1e-300)
    orders = 0
    while done < len(times):
        orders += ORDER
        if orders > most:
            raise StiffError
        left = float(times[-1]) - now
        series = packed.series(Y, min(span, left), ORDER)
        span = min(span, left)
        sizes = np.abs(Y).max(axis=1) + FLOOR * scale
        step = min(_reach(series, sizes), left / span)
        for _ in range(MOST_TRIES):
            end = _value(series, step)
            slope = packed.slope(end)
            missed = np.abs(_derivative(series, step) - span * slope).max(axis=1)
            if (step * missed <= DEFECT * (np.abs(end).max(axis=1) + FLOOR * scale)).all():
                break
            step *= SHORTER
        else:
            raise StiffError
        following = float(times[-1]) if step * span >= left else now + step * span
        while done < len(times) and times[done] <= following:
            out[done] = _value(series, min((float(times[done]) - now) / span, step))
            done += 1
        Y, now, span = end, following, step * span
        if not np.abs(Y).max() < limit:
            raise TheoryError(f"H(12) grows beyond {limit:g} before {now:g} s")
    return out


def _reach(series: FloatArray, sizes: FloatArray) -> float:
    """Where the last two terms come to LAST_TERM."""
    reach = np.inf
    for k in (ORDER - 1, ORDER):
        share = float((np.abs(series[k]).max(axis=1) / sizes).max())
        if share > 0.0:
            reach = min(reach, (LAST_TERM / share) ** (1.0 / k))
    return reach if np.isfinite(reach) else 1.0


def _value(series: FloatArray, s: float) -> FloatArray:
    powers = s ** np.arange(len(series))
    return np.asarray(np.tensordot(powers, series, 1))


def _derivative(series: FloatArray, s: float) -> FloatArray:
    orders = np.arange(1, len(series))
    return np.asarray(np.tensordot(orders * s ** (orders - 1.0), series[1:], 1))
