"""Integration of H(12) without delay by Taylor series.

The right-hand side is quadratic, so that a coefficient of any order costs about one evaluation
(Moore 1966; Barton, Willers and Zahar 1971).
"""

from __future__ import annotations

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.theory.hybrid.packed import PackedRiccati

ORDER = 28  # terms: few steps, each still far from where powers overflow
TERM_TOLERANCE = 1e-11  # of the last terms of a series, relative to the largest entry
DEFECT_TOLERANCE = 1e-10  # of a step: its length times the error of the derivative, relative
FLOOR = 1e-13  # times the scale of the problem: absolute error that is always allowed
# After so many reductions, to 1e-6, the problem is stiff.
STEP_REDUCTION, MAX_TRIES = 0.7, 40


class StiffError(Exception):
    """Raised when steps become so short that an implicit method is cheaper."""


def solve_by_taylor_series(
    packed: PackedRiccati, times: FloatArray, scale: float, max_orders: int, limit: float
) -> FloatArray:
    """Return the solution (T, N, m) of H(12) at ``times`` (s, increasing) from ``packed.start``.
    Steps are accepted if the polynomial satisfies the equation at their end; entries far below
    ``scale`` need not be accurate. Raises StiffError after ``max_orders`` coefficients, and
    TheoryError beyond ``limit``.
    """
    Y, now = packed.start, 0.0
    out = np.empty((len(times), *Y.shape))
    count = int(np.searchsorted(times, 0.0, side="right"))
    out[:count] = Y
    slope = packed.slope(Y)
    # Time is measured in spans, over which the solution changes by about its own size.
    span = float(np.abs(Y).max() + scale) / max(float(np.abs(slope).max()), 1e-300)
    orders = 0
    while count < len(times):
        orders += ORDER
        if orders > max_orders:
            raise StiffError
        remaining = float(times[-1]) - now
        span = min(span, remaining)
        # Coefficients in powers of t / span, so that they neither overflow nor underflow.
        series = packed.series(Y, span, ORDER)
        step = min(_step_length(series, np.abs(Y).max(axis=1) + FLOOR * scale), remaining / span)
        for _ in range(MAX_TRIES):  # until the polynomial satisfies the equation at the end
            last = step * span >= remaining
            following = float(times[-1]) if last else now + step * span
            until = int(np.searchsorted(times, following, side="right"))
            fractions = np.append((times[count:until] - now) / span, step)
            solution = _evaluate(series, fractions)
            end, derivative = solution[-2:]
            defect = np.abs(derivative - span * packed.slope(end)).max(axis=1)
            if (
                step * defect <= DEFECT_TOLERANCE * (np.abs(end).max(axis=1) + FLOOR * scale)
            ).all():
                break
            step *= STEP_REDUCTION
        else:
            raise StiffError
        out[count:until] = solution[:-2]
        Y, now, span, count = end, following, step * span, until
        if not np.abs(Y).max() < limit:
            raise TheoryError(f"Tanwani's H(12) grows beyond {limit:g} before {now:g} s")
    return out


def _step_length(series: FloatArray, sizes: FloatArray) -> float:
    """Return the step, in spans, at which the last terms are TERM_TOLERANCE of ``sizes``."""
    length = np.inf
    for k in (ORDER - 1, ORDER):
        # |c_k| s^k = TERM_TOLERANCE sizes
        share = float((np.abs(series[k]).max(axis=1) / sizes).max())
        if share > 0.0:
            length = min(length, (TERM_TOLERANCE / share) ** (1.0 / k))
    return length if np.isfinite(length) else 1.0


def _evaluate(series: FloatArray, fractions: FloatArray) -> FloatArray:
    """Return (K + 1, N, m): ``series`` at ``fractions`` (K,), and the derivative at the last."""
    orders = np.arange(len(series))
    weights = np.empty((len(fractions) + 1, len(series)))
    weights[:-1] = fractions[:, None] ** orders
    weights[-1, 0] = 0.0
    weights[-1, 1:] = orders[1:] * weights[-2, :-1]
    return np.asarray(np.tensordot(weights, series, 1))
