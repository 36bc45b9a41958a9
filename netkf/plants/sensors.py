"""Sensors: the contract, the fixed linear one, and its readings in continuous time.

The noise of a sensor is drawn on the sensing grid, the times k h of the plant's sensing period h,
from the sensor's own stream, as its two moments over each step, ``int dv`` (*plain*) and
``int P_1 dv`` (*tilted*) with the Legendre polynomial P_1, -1 .. 1 over the step. At an
event of the node inside a step, such as a tick or a message, the step is cut: the moments of the
first part are drawn from their exact law given those of the whole, from a second stream, and the
moments of the remaining part follow. So noise on the grid does not depend on the network.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from netkf.core.clock import Clock, generate_ticks
from netkf.core.fields import (
    Component,
    boolean,
    definite_covariance,
    field,
    instance_of,
    list_of,
    matrix,
    node_id,
    text,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, Lanes, load, root_of, spread, store
from netkf.linalg.portable import cholesky
from netkf.linalg.structs import Size
from netkf.plants.faults import Fault
from netkf.plants.linear import Blocks, Readings, SlotReadings
from netkf.plants.paths import DiffusionPath
from netkf.plants.readings import ReadingTable
from netkf.plants.sampling import DrawnSamples, Samples, sampling
from netkf.rng.streams import Generators

ROOT_3 = math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Sensor(Component):
    """The contract of sensors: each of ``nodes`` has one, with independent noise; ``fault`` says
    when and how it is bad, which filters do not know.
    """

    _values = MappingProxyType(dict.fromkeys(("is_random", "linear", "varying"), boolean))

    is_random: ClassVar[bool] = True
    """True if runs draw the readings from H and R; else H and R are what filters assume of readings
    that are recorded.
    """

    nodes: tuple[int, ...] = field(list_of(node_id(), "node ids"))
    fault: Fault | None = field(instance_of(Fault), default=None)
    held_out: bool = field(boolean, default=False)
    """Filters do not see its readings, with which their estimates are compared."""

    linear: ClassVar[bool] = True
    """Whether readings are linear in the state."""

    @property
    def varying(self) -> bool:
        """True if H, R or the values that are there differ from reading to reading."""
        return False

    @property
    def record(self) -> ReadingTable | None:
        """The table of its readings; None if they are drawn, or are a user's own."""
        return None

    def matrix_of(self, n: int) -> FloatArray:
        """Return H (p, n) of the first reading, for a state of n components; the filters' models
        are made with it before a run.
        """
        H: FloatArray = self.H  # type: ignore[attr-defined]
        return H

    @abstractmethod
    def slot_path(self, node: int, period: float, generator: Generators) -> Readings:
        """Return the readings of the sensor on ``node`` (id) in one run, in slots of ``period``
        seconds. The engine calls this once for each sensor and run, over a plant in slots.

        ``generator`` returns the random stream of that sensor for a purpose, a short text.
        """

    def sample_times(
        self, node: int, ordinal: int, generator: Generators, horizon: float
    ) -> FloatArray:
        """Return the times (K,) in seconds, below the ``horizon``, at which the sensor on ``node``
        samples; ``ordinal`` is its number among the sensors of that node and ``generator`` returns
        its random stream for a purpose. Called once for each sampling sensor and run.

        By default they are the ticks of a clock ``sampling``, and there are none without one.
        """
        clock = getattr(self, "sampling", None)
        if not isinstance(clock, Clock):
            return np.empty(0)
        phase, random = partial(generator, "sampling phase"), generator("sampling")
        return generate_ticks(clock, (node, ordinal), phase, random, horizon, "sampling")

    def samples(self, node: int, generator: Generators, horizon: float) -> Samples:
        """Return the samples of the sensor on ``node`` (id) at its ``sample_times`` below the
        ``horizon`` (seconds) in one run; ``generator`` returns the random stream of that sensor for
        a purpose. To be defined by sensors that have sample times.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class LinearSensor(Sensor):
    """A sensor that is linear in the state. In slots it reads ``y = H x + v``, cov(v) = R, in every
    slot. In continuous time it reads increments ``dy = H x dt + dv``, cov(dv) = R dt, Tanwani,
    H (3). With a clock as ``sampling`` it reads ``y = H x + v`` in continuous time at every tick.

    ``H`` (p, n), ``R`` (p, p). With ``[[plants]]``, ``of`` names the block that H multiplies: the
    node's own, or one that all share.
    """

    H: FloatArray = field(matrix)
    R: FloatArray = field(definite_covariance)
    sampling: Clock | None = field(sampling, default=None)
    of: str | None = field(text, default=None)

    def samples(self, node: int, generator: Generators, horizon: float) -> DrawnSamples:
        """Return the samples of the sensor on ``node`` (id) in one run, see Sensor."""
        return DrawnSamples(self.H, self.R, generator("noise"))

    def path(self, random: np.random.Generator, cutting: np.random.Generator) -> SensorPath:
        """Return the increments of one run: ``random`` draws noise on the grid, ``cutting`` inside
        it.
        """
        return SensorPath(self.H, self.R, random, cutting)

    def slot_path(self, node: int, period: float, generator: Generators) -> SlotReadings:
        """Return the readings of the sensor on ``node`` (id) in slots, see Sensor."""
        return SlotReadings(self.H, self.R, generator("noise"))


class SensorPath:
    """The increments dy = H x dt + dv that one sensor on one node reads in one run, by intervals
    that must be asked for in order of time, without gaps.
    """

    def __init__(
        self, H: FloatArray, R: FloatArray, random: np.random.Generator, cuts: np.random.Generator
    ) -> None:
        self.H = H
        # The noise is drawn with unit intensity and multiplied by the Cholesky factor of R.
        self._root = cholesky(R)
        self._cutting = cuts
        # Normals of the steps, and the end of the present one.
        self._normals, self._end = Blocks(random, 2 * len(R)), 0.0
        # Noise moments of the part of the present step that has not been read yet.
        self._unread = np.zeros((2, len(R)))

    def moments(
        self, truth: DiffusionPath, x_moments: FloatArray, start: float, end: float
    ) -> FloatArray:
        """Return the two moments (2, p) of dy over [start, end] seconds, inside the step that
        ``truth`` was last asked for; ``start`` is the last ``end``. ``x_moments`` (2, n).
        """
        step_end = truth.step_end()
        # A new step: the previous one has been read to its end.
        if step_end != self._end:
            normals = self._normals.draw().reshape(self._unread.shape)
            self._unread, self._end = step_noise(normals, truth.period), step_end
        if end < step_end:
            # Normals for cuts come from a second stream, so that the noise on the grid does not
            # depend on the times of events.
            normals = self._cutting.standard_normal(self._unread.shape)
            length = step_end - start
            noise, self._unread = cut(self._unread, normals, (end - start) / length, length)
        else:
            noise = self._unread
        return reading(x_moments, self.H, noise, self._root)


def step_noise(normals: FloatArray, period: float) -> FloatArray:
    """Return the two moments (..., 2, p) of unit white noise over ``period`` seconds, its integrals
    with the Legendre polynomials P_0 and P_1, from standard ``normals`` (..., 2, p): independent,
    with variances g and g / 3 for g = ``period``.
    """
    return np.asarray(normals * np.sqrt(np.array([[period], [period / 3.0]])))


def reading(x: FloatArray, H: FloatArray, noise: FloatArray, root: FloatArray) -> FloatArray:
    """Return the two moments (2, p) of dy = H x dt + root dw over an interval, from those of x,
    ``x`` (2, n), and of unit white noise, ``noise`` (2, p); ``root`` (p, p).
    """
    out = np.empty(2 * len(H))
    fill_reading(ONE, H[0], out, 0, len(H), x, H[None], noise, root[None], 0)
    return out.reshape(2, len(H))


@kernel(inlined=True, fused=True)
def fill_reading(
    lanes: Lanes,
    size: Size,
    out: FloatArray,
    row: int,
    rows: int,
    x_moments: FloatArray,
    H: FloatArray,
    noise: FloatArray,
    root: FloatArray,
    s: int,
) -> None:
    """Write the two moments of dy of sensor ``s``, which has ``rows`` rows, in L lanes into ``out``
    (2 q, L), where the sensors of one filter have q rows together: the first from ``row`` on, the
    second q later. ``x_moments`` (2, n, L), ``noise`` (2, p, L); H (S, p, n, L), root (S, p, p, L).
    """
    # First moments of the rows of all sensors come before the second ones, as filters expect.
    half = len(out) // 2
    # moment_m(dy) = H moment_m(x) + root moment_m(noise)
    for m in range(2):
        for i in range(rows):
            total = spread(lanes, 0.0)
            for j in range(len(size)):
                total += load(lanes, H, s, i, j) * load(lanes, x_moments, m, j)
            for j in range(i + 1):
                total += load(lanes, root, s, i, j) * load(lanes, noise, m, j)
            store(lanes, out, m * half + row + i, total)


def cut(
    whole: FloatArray, normals: FloatArray, u: float, length: float
) -> tuple[FloatArray, FloatArray]:
    """Return the noise moments (2, p) of the first part of an interval, a share ``u`` of its
    ``length`` in seconds, and of the rest, drawn with ``normals`` (2, p) given ``whole`` (2, p).
    """
    first, remaining = np.empty(whole.shape), whole.copy()
    divide(ONE, first, remaining, normals, u, length)
    return first, remaining


@kernel(inlined=True)
def divide(
    lanes: Lanes, first: FloatArray, rest: FloatArray, normals: FloatArray, u: Any, length: Any
) -> None:
    """Divide the two moments ``rest`` (2, p, L) of white noise over ``length`` seconds, in L lanes:
    those of the first part, a share ``u``, are written to ``first`` (2, p, L), those of the
    remaining part replace ``rest``. ``normals`` (2, p, L) are standard normal. The four moments of
    the parts are independent, with variances g and g / 3 for a part of g seconds; they are drawn
    from their exact law given the whole, without cancellation where a part is short.
    """
    # Parts with the shares u and w and the moments m_0, m_1 and r_0, r_1, and the whole:
    #   whole = m_0 + r_0,    tilted = u m_1 - w m_0 + w r_1 + u r_0
    # since P_1 of the whole is -w + u P_1 on the first part and u + w P_1 on the rest.
    w = 1.0 - u
    # v = 1 - 3 u w = u^3 + w^3, at least 1 / 4 for u in [0, 1]: the divisions below are safe.
    variance = 1.0 - 3.0 * u * w
    root, size = root_of(variance), root_of(u * w * length)
    size_first, size_slope = size * root, size / root
    size_other = size_slope / ROOT_3
    for k in range(rest.shape[1]):
        # Given whole and tilted, m_0 has the mean u whole - 3 u w tilted and the variance
        # u w length v (``early``); r_0 is what is left of ``whole``.
        whole, tilted = load(lanes, rest, 0, k), load(lanes, rest, 1, k)
        # Then u m_1 + w r_1 is known, v tilted + early, of which u^2 / v and w^2 / v are the means
        # of m_1 and r_1: ``slope`` is early / v. The noise left to them is (w, -u) other.
        normal = load(lanes, normals, 0, k)
        early, slope = size_first * normal, size_slope * normal
        other = size_other * load(lanes, normals, 1, k)
        store(lanes, first, 0, k, u * whole - 3.0 * u * w * tilted + early)
        store(lanes, first, 1, k, u * u * (tilted + slope) + w * other)
        store(lanes, rest, 0, k, w * whole + 3.0 * u * w * tilted - early)
        store(lanes, rest, 1, k, w * w * (tilted + slope) - u * other)
