"""Kernels of the motions that netkf knows: unicycle and coordinated turn.

Of each there are the exact flow over a period with the input held, the rate of change in continuous
time, and the Jacobians of both with respect to the state, kernels ``(x, u, t, period, out)``. With
the turn a = w T over a period T, sums such as (sin(h + a) - sin h) / w are written as chords,
T sinc(a / 2) cos(h + a / 2), which lose no digits where a is small.
"""

from __future__ import annotations

import math

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel

SERIES = 0.25
"""Below this turn the derivatives with respect to the turn rate are series."""
TERMS = 7


@kernel
def sinc(a: float) -> float:
    """Return ``sin(a) / a``, 1 at 0; exact to rounding however small a is."""
    return math.sin(a) / a if a != 0.0 else 1.0


@kernel
def move_unicycle(x: FloatArray, u: FloatArray, _t: float, period: float, out: FloatArray) -> None:
    """Write the pose (3,), position and heading, ``period`` seconds after ``x`` (3,), with the
    speed u[0] and the turn rate u[1] held: an arc.
    """
    a = u[1] * period
    chord, heading = u[0] * period * sinc(0.5 * a), x[2] + 0.5 * a
    out[0] = x[0] + chord * math.cos(heading)
    out[1] = x[1] + chord * math.sin(heading)
    out[2] = x[2] + a


@kernel
def unicycle_jacobian(
    x: FloatArray, u: FloatArray, _t: float, period: float, out: FloatArray
) -> None:
    """Write the Jacobian (3, 3) of ``move_unicycle`` with respect to x."""
    a = u[1] * period
    chord, heading = u[0] * period * sinc(0.5 * a), x[2] + 0.5 * a
    out[:] = 0.0
    out[0, 0] = out[1, 1] = out[2, 2] = 1.0
    out[0, 2] = -chord * math.sin(heading)
    out[1, 2] = chord * math.cos(heading)


@kernel
def unicycle_rate(x: FloatArray, u: FloatArray, _t: float, _period: float, out: FloatArray) -> None:
    """Write the rate (3,) of the pose ``x`` (3,): u[0] is the speed, u[1] the turn rate."""
    out[0] = u[0] * math.cos(x[2])
    out[1] = u[0] * math.sin(x[2])
    out[2] = u[1]


@kernel
def unicycle_rate_jacobian(
    x: FloatArray, u: FloatArray, _t: float, _period: float, out: FloatArray
) -> None:
    """Write the Jacobian (3, 3) of ``unicycle_rate`` with respect to x."""
    out[:] = 0.0
    out[0, 2] = -u[0] * math.sin(x[2])
    out[1, 2] = u[0] * math.cos(x[2])


@kernel
def turn_integrals(w: float, period: float) -> tuple[float, float]:
    """Return ``sin(w T) / w`` and ``(1 - cos(w T)) / w`` for T = ``period``."""
    half = 0.5 * w * period
    of_half = sinc(half)
    return period * sinc(2.0 * half), period * half * of_half * of_half


@kernel
def turn_slopes(w: float, period: float) -> tuple[float, float]:
    """Return the derivatives with respect to w of both ``turn_integrals``."""
    a = w * period
    square = period * period
    if abs(a) > SERIES:
        with_sine = (a * math.cos(a) - math.sin(a)) / (a * a)
        with_cosine = (a * math.sin(a) - 2.0 * math.sin(0.5 * a) ** 2) / (a * a)
        return square * with_sine, square * with_cosine
    # The sums over k >= 1 of (-1)^k 2k a^(2k - 1) / (2k + 1)! and (-1)^(k + 1) (2k - 1) a^(2k - 2)
    # / (2k)!, from their last terms on, by the ratio of a term to the one before it.
    with_sine = with_cosine = 0.0
    for k in range(TERMS, 1, -1):
        with_sine = (1.0 + with_sine) * (-a * a / ((2 * k - 2) * (2 * k + 1)))
        with_cosine = (1.0 + with_cosine) * (-a * a / ((2 * k - 3) * 2 * k))
    return square * (1.0 + with_sine) * (-a / 3.0), square * (1.0 + with_cosine) * 0.5


@kernel
def move_turning(x: FloatArray, _u: FloatArray, _t: float, period: float, out: FloatArray) -> None:
    """Write position, velocity, turn rate (5,) ``period`` s after ``x`` (5,), turning as before."""
    a = x[4] * period
    along, aside = turn_integrals(x[4], period)
    c, s = math.cos(a), math.sin(a)
    out[0] = x[0] + along * x[2] - aside * x[3]
    out[1] = x[1] + aside * x[2] + along * x[3]
    out[2] = c * x[2] - s * x[3]
    out[3] = s * x[2] + c * x[3]
    out[4] = x[4]


@kernel
def turning_jacobian(
    x: FloatArray, _u: FloatArray, _t: float, period: float, out: FloatArray
) -> None:
    """Write the Jacobian (5, 5) of ``move_turning``."""
    a = x[4] * period
    along, aside = turn_integrals(x[4], period)
    along_slope, aside_slope = turn_slopes(x[4], period)
    c, s = math.cos(a), math.sin(a)
    out[:] = 0.0
    out[0, 0] = out[1, 1] = out[4, 4] = 1.0
    out[0, 2], out[0, 3] = along, -aside
    out[1, 2], out[1, 3] = aside, along
    out[2, 2], out[2, 3] = c, -s
    out[3, 2], out[3, 3] = s, c
    out[0, 4] = along_slope * x[2] - aside_slope * x[3]
    out[1, 4] = aside_slope * x[2] + along_slope * x[3]
    out[2, 4] = -period * (s * x[2] + c * x[3])
    out[3, 4] = period * (c * x[2] - s * x[3])


@kernel
def turning_rate(x: FloatArray, _u: FloatArray, _t: float, _period: float, out: FloatArray) -> None:
    """Write the rate of change (5,) of position, velocity and turn rate ``x`` (5,)."""
    out[0], out[1] = x[2], x[3]
    out[2], out[3] = -x[4] * x[3], x[4] * x[2]
    out[4] = 0.0


@kernel
def turning_rate_jacobian(
    x: FloatArray, _u: FloatArray, _t: float, _period: float, out: FloatArray
) -> None:
    """Write the Jacobian (5, 5) of ``turning_rate``."""
    out[:] = 0.0
    out[0, 2] = out[1, 3] = 1.0
    out[2, 3], out[2, 4] = -x[4], -x[3]
    out[3, 2], out[3, 4] = x[4], x[2]
