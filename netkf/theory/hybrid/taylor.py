"""H(12) without delay by Taylor series: the right-hand side is quadratic, so coefficients of any
order cost about one evaluation each (Moore 1966; Barton, Willers and Zahar 1971).
"""

from __future__ import annotations

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.theory.hybrid.packed import Packed

ORDER = 28
LAST_TERM = 1e-11  # of the series, relative to the largest entry of the matrix
DEFECT = 1e-10  # of a step: its length times what the derivative misses the slope by, relative
FLOOR = 1e-13  # times the scale of the problem: what no matrix need be more precise than
SHORTER, MAX_TRIES = 0.7, 40


class StiffError(Exception):
    """Steps would be so short that an implicit method is cheaper."""


def followed(
    packed: Packed, times: FloatArray, scale: float, most: int, limit: float
) -> FloatArray:
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
        span = min(span, left)
        series = packed.series(Y, span, ORDER)
        step = min(_reach(series, np.abs(Y).max(axis=1) + FLOOR * scale), left / span)
        for _ in range(MAX_TRIES):
            last = step * span >= left
            following = float(times[-1]) if last else now + step * span
            until = int(np.searchsorted(times, following, side="right"))
            places = np.append((times[done:until] - now) / span, step)
            found = _values(series, places)
            end, derivative = found[-2:]
            missed = np.abs(derivative - span * packed.slope(end)).max(axis=1)
            if (step * missed <= DEFECT * (np.abs(end).max(axis=1) + FLOOR * scale)).all():
                break
            step *= SHORTER
        else:
            raise StiffError
        out[done:until] = found[:-2]
        Y, now, span, done = end, following, step * span, until
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


def _values(series: FloatArray, places: FloatArray) -> FloatArray:
    """(K + 1, N, m): the polynomial at K places, and its derivative at the last of them."""
    orders = np.arange(len(series))
    weights = np.empty((len(places) + 1, len(series)))
    weights[:-1] = places[:, None] ** orders
    weights[-1, 0] = 0.0
    weights[-1, 1:] = orders[1:] * weights[-2, :-1]
    return np.asarray(np.tensordot(weights, series, 1))
