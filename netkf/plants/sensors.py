"""Sensors: the contract, the fixed linear one, and its readings in continuous time.

The noise of a sensor is drawn on the sensing grid from the sensor's own stream, as its two moments
over each step. When the network wakes a node inside a step, the step is cut: the two moments of
the first part are drawn given those of the whole (exactly, from a second stream), and the rest
keeps what is left. The noise on the grid therefore never depends on the network.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from netkf.core.clock import Clock, generate_ticks
from netkf.core.fields import (
    Component,
    definite_covariance,
    field,
    integer,
    matrix,
    several,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import ONE, Lanes, load, root_of, spread, store
from netkf.linalg.portable import cholesky
from netkf.linalg.structs import Size
from netkf.plants.linear import Readings, SlotReadings
from netkf.plants.paths import BLOCK, DiffusionPath
from netkf.plants.sampling import DrawnSamples, Samples, sampling

ROOT_3 = math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Sensor(Component):
    """The contract: each of ``nodes`` has such a sensor, with noise of its own."""

    is_random: ClassVar[bool] = True
    """Whether runs draw the readings from H and R; else those are what the filters believe."""

    nodes: tuple[int, ...] = field(several(integer(), "node ids"))

    linear: ClassVar[bool] = True
    """Whether readings are linear in the state."""

    @property
    def varying(self) -> bool:
        """True if H differs from reading to reading."""
        return False

    def matrix_of(self, n: int) -> FloatArray:
        """Return H (p, n) of the first reading, for a state of n components."""
        H: FloatArray = self.H  # type: ignore[attr-defined]
        return H

    @abstractmethod
    def slot_path(
        self, node: int, period: float, generator: Callable[[str], np.random.Generator]
    ) -> Readings:
        """Return the readings of one of the nodes in one run, in slots of ``period`` seconds;
        ``generator`` makes the streams of that sensor by purpose.
        """

    def sample_times(
        self,
        node: int,
        ordinal: int,
        generator: Callable[[str], np.random.Generator],
        horizon: float,
    ) -> FloatArray:
        """Return the times (K,) in continuous time at which one of the nodes samples, below the
        ``horizon``; sensors in slots and of increments have none.
        """
        # None by default: only sensors with a clock sample.
        return np.empty(0)

    def samples(
        self, node: int, generator: Callable[[str], np.random.Generator], horizon: float
    ) -> Samples:
        """Return the samples of one of the nodes at these times in one run."""
        raise NotImplementedError


def sampling_ticks(
    clock: Clock,
    entity: tuple[int, int],
    generator: Callable[[str], np.random.Generator],
    horizon: float,
) -> FloatArray:
    """Return the times (K,) at which a sensor (node, number on it) samples, from the streams
    "sampling" and "sampling phase".
    """
    phase = partial(generator, "sampling phase")
    return generate_ticks(clock, entity, phase, generator("sampling"), horizon, "sampling")


@dataclass(frozen=True, eq=False)
class LinearSensor(Sensor):
    """In continuous time ``dy = H x dt + dv``, cov(dv) = R dt, H (3), or with a clock as
    ``sampling`` ``y = H x + v``, cov(v) = R, whenever it ticks; in slots the latter in every slot.

    ``H`` (p, n), ``R`` (p, p).
    """

    H: FloatArray = field(matrix)
    R: FloatArray = field(definite_covariance)
    sampling: Clock | None = field(sampling, default=None)

    def sample_times(
        self,
        node: int,
        ordinal: int,
        generator: Callable[[str], np.random.Generator],
        horizon: float,
    ) -> FloatArray:
        """Return the sample times (K,), drawn from the streams "sampling" and "sampling phase"."""
        # Only sensors with a clock are asked.
        assert self.sampling is not None
        return sampling_ticks(self.sampling, (node, ordinal), generator, horizon)

    def samples(
        self, node: int, generator: Callable[[str], np.random.Generator], horizon: float
    ) -> DrawnSamples:
        """Return samples with noise from the stream "noise"."""
        return DrawnSamples(self.H, self.R, generator("noise"))

    def path(self, random: np.random.Generator, cutting: np.random.Generator) -> SensorPath:
        """Return the readings of one of the nodes in one run in continuous time."""
        return SensorPath(self.H, self.R, random, cutting)

    def slot_path(
        self, node: int, period: float, generator: Callable[[str], np.random.Generator]
    ) -> SlotReadings:
        """Return readings with noise from the stream "noise"."""
        return SlotReadings(self.H, self.R, generator("noise"))


class SensorPath:
    """Readings of one sensor on one node, asked for in order of time."""

    def __init__(
        self,
        H: FloatArray,
        R: FloatArray,
        random: np.random.Generator,
        cutting: np.random.Generator,
    ) -> None:
        self.H = H
        # Cholesky factor of R: the noise is drawn with unit intensity and multiplied by it.
        self._root = cholesky(R)
        self._random, self._cutting = random, cutting
        self._drawn = np.empty((0, 2, len(R)))
        self._used = 0
        self._end = 0.0
        # The noise of the present step that has not been read yet.
        self._rest = np.zeros((2, len(R)))

    def moments(
        self, truth: DiffusionPath, x_moments: FloatArray, start: float, end: float
    ) -> FloatArray:
        """Return moments (2, p) of dy over ``[start, end]`` inside the truth's present step, where
        x has the moments ``x_moments``; ``start`` is where the last call ended.
        """
        last = truth.step_end()
        # A new step: what was left of the one before has been read to its end.
        if last != self._end:
            self._rest, self._end = self._draw(truth.period), last
        if end < last:
            # Normals for cuts come from a second stream, so that the noise on the grid is the same
            # whoever wakes whom.
            normals = self._cutting.standard_normal(self._rest.shape)
            length = last - start
            noise, self._rest = cut(self._rest, normals, (end - start) / length, length)
        else:
            noise = self._rest
        return reading(x_moments, self.H, noise, self._root)

    def _draw(self, period: float) -> FloatArray:
        """Return the noise moments (2, p) of the next step of ``period`` seconds."""
        # Blocks of normals: one call for many steps.
        if self._used == len(self._drawn):
            self._drawn = self._random.standard_normal((BLOCK, *self._drawn.shape[1:]))
            self._used = 0
        normals = self._drawn[self._used]
        self._used += 1
        return step_noise(normals, period)


def step_noise(normals: FloatArray, period: float) -> FloatArray:
    """Return moments (..., 2, p) of unit white noise over ``period`` seconds: independent, with
    variances g and g / 3.
    """
    return np.asarray(normals * np.sqrt(np.array([[period], [period / 3.0]])))


def reading(
    x_moments: FloatArray, H: FloatArray, noise: FloatArray, root: FloatArray
) -> FloatArray:
    """Return moments (2, p) of dy from those of x (2, n) and of unit white noise (2, p)."""
    out = np.empty(2 * len(H))
    fill_reading(ONE, H[0], out, 0, len(H), x_moments, H[None], noise, root[None], 0)
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
    """Write the moments of dy of sensor ``s``, ``rows`` of each, from those of x, ``x_moments``
    (2, n, L), and of unit white noise (2, p, L): the first ones from ``out[row]`` on and the second
    ones half of ``out`` (q, L) later. H is (S, p, n, L), root (S, p, p, L) and lower triangular.
    """
    half = len(out) // 2
    # Both moments are linear: dy = H x dt + dv, moment by moment.
    for m in range(2):
        for i in range(rows):
            total = spread(lanes, 0.0)
            for j in range(len(size)):
                total += load(lanes, H, s, i, j) * load(lanes, x_moments, m, j)
            for j in range(i + 1):
                total += load(lanes, root, s, i, j) * load(lanes, noise, m, j)
            store(lanes, out, m * half + row + i, total)


def cut(
    rest: FloatArray, normals: FloatArray, u: float, length: float
) -> tuple[FloatArray, FloatArray]:
    """Return moments (2, p) of the first share ``u`` of an interval of ``length`` seconds and of
    what is left, given those of the whole, from standard ``normals`` (2, p).
    """
    # Copies, so that callers keep their arrays.
    first, left = np.empty(rest.shape), rest.copy()
    divide(ONE, first, left, normals, u, length)
    return first, left


@kernel(inlined=True)
def divide(
    lanes: Lanes, first: FloatArray, rest: FloatArray, normals: FloatArray, u: Any, length: Any
) -> None:
    """Divide the moments ``rest`` (2, p, L) of an interval of ``length`` seconds into those of its
    first part, a share ``u`` of the length, which are written to ``first`` (2, p, L), and those of
    the remaining part, which stay in ``rest``. ``normals`` (2, p, L) are standard normal.

    Exact conditional law of four independent moments (variances g, g/3 on each part) given their
    two sums; written so that nothing cancels when a part is short.
    """
    w = 1.0 - u
    # At least 1 / 4 for every u in [0, 1], so that the divisions below are safe.
    variance = 1.0 - 3.0 * u * w
    root, size = root_of(variance), root_of(u * w * length)
    size_first, size_slope = size * root, size / root
    size_other = size_slope / ROOT_3
    for k in range(rest.shape[1]):
        # Given the sums the first moment has the mean u whole - 3 u w tilted; the rest gets the
        # same noise with the other sign.
        whole, tilted = load(lanes, rest, 0, k), load(lanes, rest, 1, k)
        # The noise of the first moment also tilts both parts: one normal for both.
        normal = load(lanes, normals, 0, k)
        early, slope = size_first * normal, size_slope * normal
        other = size_other * load(lanes, normals, 1, k)
        store(lanes, first, 0, k, u * whole - 3.0 * u * w * tilted + early)
        store(lanes, first, 1, k, u * u * (tilted + slope) + w * other)
        # Subtracted from the rest: both parts add up to the whole.
        store(lanes, rest, 0, k, w * whole + 3.0 * u * w * tilted - early)
        store(lanes, rest, 1, k, w * w * (tilted + slope) - u * other)
