"""Simulated time is a whole number of ticks, so that equal instants are equal numbers.

Instants that are equal on paper differ by rounding in floating point: 0.1 + 0.2 is not 0.3. A
scenario therefore has a :class:`TimeGrid`, and every instant is kept as float64 seconds in
*canonical form*: ``rint(t * per_second) / per_second``, the float64 nearest to a whole number of
ticks. For a decimal time that is the number as one writes it, 0.3.

Why that is exact: a grid has at most 1e15 ticks up to the horizon. A time that was computed by a
few operations, as phase + k period or sent + delay, is off by about 3e-16 of itself, a third of a
tick, so that ``rint`` finds the tick that is meant. Product and quotient round once each, and the
float64 nearest to k ticks differs from that of any other k: ``==``, ``<`` and sorting of canonical
times compare integers. A difference of two canonical times is a whole number of ticks up to
rounding, and canonical once it is snapped itself. So whatever makes an instant snaps it once, an
instant is never a sum of steps, and a duration that is compared is snapped before.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel

MAX_TICKS = 1e15
"""Largest number of ticks up to the horizon, see above."""
MAX_GIVEN_TICKS = 1.5 * MAX_TICKS
"""The same of a resolution that is given: times are off by less than half a tick."""
FINEST, COARSEST = -22, 0
"""Exponents of ten of the resolutions: float64 holds 10^22, and a tick is at most a second."""
MAX_REFINE = 10_000
"""Ticks in a resolution; more would leave too few decimals."""
MAX_DENOMINATOR = 100_000
"""Of rational numbers that are recognised by their value."""
SHORT = 15  # significant digits of decimal numbers that are taken as they are written
CLOSE = 1e-15  # relative; a number so computed differs from what is meant by a few roundings


@kernel(inlined=True)
def snapped(t: float, per_second: float) -> float:
    """Return ``t`` (seconds) in canonical form, for kernels; see the module."""
    return float(np.rint(t * per_second) / per_second)


@dataclass(frozen=True)
class TimeGrid:
    """The ticks that instants are whole numbers of.

    resolution  a power of ten, seconds, at most 1
    refine      into how many ticks it is divided, for constants such as 1/12 s, of which no power
                of ten is a multiple
    """

    resolution: float = 1e-12
    refine: int = 1

    @cached_property
    def per_second(self) -> float:
        """Ticks in a second, an integer."""
        return float(10 ** -round(math.log10(self.resolution)) * self.refine)

    def as_table(self) -> dict[str, Any]:
        """Return the keys of ``[time]`` that say the grid: ``refine`` only where it is not 1."""
        more = {} if self.refine == 1 else {"refine": self.refine}
        return {"resolution": self.resolution, **more}

    def snap(self, times: np.ndarray) -> FloatArray:
        """Return ``times`` (any shape), seconds, in canonical form."""
        return np.asarray(np.rint(times * self.per_second) / self.per_second, dtype=np.float64)

    def instant(self, time: float) -> float:
        """Return one ``time`` in seconds, or a duration, in canonical form."""
        ticks = time * self.per_second
        return round(ticks) / self.per_second if math.isfinite(ticks) else time

    def before(self, horizon: float, times: np.ndarray) -> FloatArray:
        """Return the instants among ``times`` (K,) before ``horizon`` (s), in canonical form."""
        instants = self.snap(times)
        return np.asarray(instants[instants < horizon])

    def holds(self, time: Fraction) -> bool:
        """Return True if a time in seconds is a whole number of ticks."""
        return (time * int(self.per_second)).denominator == 1


STANDARD = TimeGrid()
"""The grid of parts that belong to no scenario."""


def as_fraction(value: float) -> Fraction | None:
    """Return the rational number that a finite ``value`` stands for: a short decimal number as it
    is written, else the fraction of small numbers that it is up to rounding; None if neither.
    """
    text = repr(float(value))
    decimal = Fraction(text)
    if len(text.partition("e")[0].replace(".", "").strip("-0")) <= SHORT:
        return decimal
    fraction = decimal.limit_denominator(MAX_DENOMINATOR)
    return fraction if abs(fraction - decimal) <= CLOSE * abs(decimal) else None


def as_written(value: float) -> float:
    """Return the float64 nearest to the rational number that ``value`` stands for, or ``value``."""
    fraction = as_fraction(value) if math.isfinite(value) else None
    return value if fraction is None else float(fraction)


class OnGrid:
    """A part of a scenario that makes instants itself, on the grid of its scenario."""

    time_grid: ClassVar[TimeGrid] = STANDARD
    grid_values: ClassVar[tuple[str, ...]] = ()
    """Names of cached values that depend on the grid."""

    def on_grid(self, grid: TimeGrid) -> Self:
        """Return this part with its instants on the ``grid``; itself if they are."""
        if self.time_grid == grid:
            return self
        part = copy.copy(self)
        for name in self.grid_values:
            part.__dict__.pop(name, None)
        object.__setattr__(part, "time_grid", grid)
        return part
