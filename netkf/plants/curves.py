"""Plants in continuous time that need not be linear, dx = f(x, u(t), t) dt + B dw.

The truth is drawn by the method SRA1 of Roessler (2010, SIAM J. Numer. Anal. 48): with step h it is
of order 1.5 in the path and 2 in law. Steps begin at multiples of ``step`` and where the input or B
jumps, so that states there depend on the plant and the seed alone; noise inside a step is drawn
given that of the step, for samples first and then for probes.
"""

from __future__ import annotations

import bisect
import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from netkf.core.fields import boolean, field, matrix, seconds
from netkf.linalg.arrays import FloatArray, readonly_array
from netkf.linalg.portable import apply
from netkf.plants.changes import RateChange, matrices_of_pieces, schedule_of
from netkf.plants.inputs import SineInput
from netkf.plants.linear import Blocks
from netkf.plants.maps import NonlinearStates
from netkf.plants.sensors import cut, step_noise
from netkf.plants.truth import WithoutFrames

InputTables = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class NonlinearDiffusion(NonlinearStates):
    """``dx = f(x, u(t), t) dt + B dw``.

    f     "unicycle" (x, y, heading, with speed and turn rate as input), "coordinated-turn" (x, y,
          vx, vy, turn rate, without input), or "module:Class", the rate of change
    B     (n, q); ``schedule`` has others from some times on
    step  seconds: the truth is integrated in steps of this length, by a method of order 1.5 in the
          path, and filters integrate mean and covariance in steps that are no longer, by one of
          order 4

    Headings are not wrapped: they count whole turns. With a ``path`` the states are recorded, and
    with ``unknown`` there are none but those that filters assume.
    """

    B: FloatArray = field(matrix)
    step: float = field(seconds)
    schedule: tuple[RateChange, ...] = field(schedule_of(RateChange), default=())
    unknown: bool = field(boolean, default=False)  # type: ignore[misc]

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.B)

    @property
    def Q(self) -> FloatArray:
        """The covariance B B' (n, n) of the noise over a second, at first."""
        return readonly_array(self.B @ self.B.T)

    @property
    def noises(self) -> list[FloatArray]:
        """The covariances ``B B'`` (n, n) before the first of ``schedule_times`` and after each."""
        return [np.asarray(B @ B.T) for B in self._drives[1]]

    @cached_property
    def _drives(self) -> tuple[list[float], list[FloatArray]]:
        """Times of ``schedule``, and B before the first and after each."""
        pieces = matrices_of_pieces({"B": self.B}, self.schedule)
        return self.schedule_times.tolist(), [piece["B"] for piece in pieces]

    @cached_property
    def tables_of_input(self) -> InputTables:
        """The input: times (J,) of its jumps and values (J, m) from each on, and amplitudes, rad/s
        and phases (3, m) of the components that are sines, nan of others.
        """
        if self.input is None:
            return np.zeros(0), np.zeros((0, 0)), np.zeros((3, 0))
        inputs = getattr(self.input, "inputs", (self.input,))
        steps = [u for u in inputs if not isinstance(u, SineInput)]
        # All begin at 0: to a clock that is behind there is no input before.
        times = np.unique(np.concatenate([np.zeros(1), *(u.exogenous.times for u in steps)]))
        values = np.concatenate([u.values(times) for u in inputs], axis=1)
        sines = [
            u.components if isinstance(u, SineInput) else np.full((3, u.m), np.nan) for u in inputs
        ]
        return times, values, np.concatenate(sines, axis=1)

    def curve(
        self,
        random: np.random.Generator,
        sampled: tuple[FloatArray, np.random.Generator],
        probes: tuple[FloatArray, np.random.Generator],
    ) -> CurvePath:
        """Return the true states of one run at the times (K,) in ``sampled`` and ``probes``, each
        with the stream of the noise inside steps.
        """
        start = self.start_mean + apply(self.start_root, random.standard_normal(self.n))
        return CurvePath(self, start, random, sampled, probes)

    def ends(self, end: float) -> FloatArray:
        """Return the ends (K,) of the steps from 0 on, up to the first not before ``end``."""
        count = int(end / self.step) + 2
        even = self.time_grid.snap(self.step * np.arange(1, count + 1))
        jumps = np.union1d(self.tables_of_input[0], self.schedule_times)
        ends = np.union1d(even, jumps[(jumps > 0.0) & (jumps < even[-1])])
        return np.asarray(ends[: int(np.searchsorted(ends, end)) + 1])

    def move(self, x: FloatArray, time: float, length: float, noise: FloatArray) -> FloatArray:
        """Return the state (n,) ``length`` seconds after ``x`` (n,); ``noise`` (2, q) are the
        integrals of dw and, tilted, of P_1 dw over it (``sensors``).
        """
        times, drives = self._drives
        f, g = self.functions[0], drives[bisect.bisect_right(times, time)]
        # The integral of w(s) - w(time) over the step is h / 2 (dw - tilted).
        dw, area = noise[0], 0.5 * length * (noise[0] - noise[1])
        slope = f(x, self._u(time), time, 0.0)
        stage = x + 0.75 * length * slope + apply(g, 1.5 / length * area)
        later = time + 0.75 * length
        return np.asarray(
            x + length / 3.0 * (slope + 2.0 * f(stage, self._u(later), later, 0.0)) + apply(g, dw)
        )

    def _u(self, time: float) -> FloatArray:
        return np.zeros(0) if self.input is None else self.input.at(time)


class CurvePath(WithoutFrames):
    """The states of one run at some times from ``start`` (n,) on; ``NonlinearDiffusion.curve``."""

    def __init__(
        self,
        plant: NonlinearDiffusion,
        start: FloatArray,
        random: np.random.Generator,
        sampled: tuple[FloatArray, np.random.Generator],
        probes: tuple[FloatArray, np.random.Generator],
    ) -> None:
        self._plant, self._streams = plant, (sampled[1], probes[1])
        only_probes = np.setdiff1d(probes[0], sampled[0])
        self._times = np.union1d(sampled[0], only_probes)
        self._states: dict[float, FloatArray] = {0.0: start}
        end = float(self._times[-1]) if len(self._times) else 0.0
        normals, x = Blocks(random, 2 * plant.B.shape[1]), start
        # States that grow without bounds end the run as diverged.
        with np.errstate(over="ignore", invalid="ignore"):
            for begin, stop in itertools.pairwise([0.0, *plant.ends(end).tolist()]):
                noise = step_noise(normals.draw().reshape(2, -1), stop - begin)
                inner = [t[(t > begin) & (t < stop)] for t in (sampled[0], only_probes)]
                if any(map(len, inner)):
                    self._cut(x, (begin, stop), noise, inner)
                x = self._states[stop] = plant.move(x, begin, stop - begin, noise)

    def _cut(
        self, x: FloatArray, ends: tuple[float, float], noise: FloatArray, inner: list[FloatArray]
    ) -> None:
        """Write the states at the times inside a step, in which x (n,) moves with the ``noise``."""
        pieces = self._divide(ends, noise, inner[0].tolist(), self._streams[0])
        for begin, stop, own in pieces:
            within = inner[1][(inner[1] > begin) & (inner[1] < stop)].tolist()
            at_probe = x
            for first, last, part in self._divide((begin, stop), own, within, self._streams[1]):
                if last < stop:
                    at_probe = self._plant.move(at_probe, first, last - first, part)
                    self._states[last] = at_probe
            x = self._plant.move(x, begin, stop - begin, own)
            if stop < ends[1]:
                self._states[stop] = x

    def _divide(
        self,
        ends: tuple[float, float],
        noise: FloatArray,
        times: list[float],
        random: np.random.Generator,
    ) -> list[tuple[float, float, FloatArray]]:
        """Return begin, end and noise of the pieces of an interval that is cut at ``times``."""
        pieces, (begin, stop) = [], ends
        for time in times:
            share = (time - begin) / (stop - begin)
            first, noise = cut(noise, random.standard_normal(noise.shape), share, stop - begin)
            pieces.append((begin, time, first))
            begin = time
        return [*pieces, (begin, stop, noise)]

    def absolute(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds), a sample or probe time or the end of a step."""
        return self._states[time]

    local = absolute

    def states(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return local and absolute states (K, n), which are equal, at ``times`` (K,)."""
        x = np.array([self._states[t] for t in times.tolist()]).reshape(-1, self._plant.n)
        return x, x
