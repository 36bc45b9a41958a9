"""The diffusion plant dx = A x dt + B dw and the path it takes in one run.

The path is drawn exactly on the sensing grid ``t_k = k h``: each step gives ``x(t_{k+1})`` and the
two moments of x over the step (core/legendre), all from one stream and whatever the network does.
Between grid points, filters that are woken by the network need part of a step. There the path is
the response to the state at the grid point plus the cubic that agrees with the step's end and with
its two moments; what that leaves out of a reading is of third order in h and less than 1e-4 h^3 of
the noise intensity. Where a state is to be *shown* off the grid, the step is cut there beforehand:
state and moments are drawn from their exact law given the step, from a second stream.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from netkf.core.arrays import FloatArray, square_root
from netkf.core.compiling import compilable
from netkf.core.fields import matrix, positive, setting, square
from netkf.core.legendre import forward_coefficients
from netkf.core.small import applied, polynomial, product
from netkf.plants.plant import Plant

BLOCK = 64  # steps drawn at once
LONGEST_STEP = 8.0
MOST_SPLITS = 256  # kept laws of a state shown inside a step
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
_THREE, _THREE_WEIGHTS = np.polynomial.legendre.leggauss(3)
_THREE_MOMENTS = np.stack([_THREE_WEIGHTS, _THREE_WEIGHTS * _THREE])


@dataclass(frozen=True, eq=False)
class Diffusion(Plant):
    """``dx = A x dt + B dw``, H (1), with x(0) Gaussian of ``mean`` and ``cov``.

    ``A`` (n, n), ``B`` (n, m); ``sensing_period`` is the step h of the sensors in seconds.
    """

    A: FloatArray = setting(square)
    B: FloatArray = setting(matrix)
    sensing_period: float | None = setting(positive, default=None)

    @property
    def n(self) -> int:
        """Dimension of the state."""
        return len(self.A)

    @cached_property
    def Q(self) -> FloatArray:
        """``B B'`` (n, n)."""
        return np.asarray(self.B @ self.B.T)

    @cached_property
    def laws(self) -> Laws:
        """What all paths of this plant share."""
        return Laws({}, {})

    @property
    def longest_period(self) -> float:
        """Seconds; the longest sensing period for which the path is exact."""
        norm = float(np.abs(self.A).sum(axis=0).max())
        return LONGEST_STEP / norm if norm > 0.0 else math.inf

    def path(
        self, random: np.random.Generator, probing: np.random.Generator, shown: FloatArray
    ) -> DiffusionPath:
        """A path of its own that can be asked for its state on the sensing grid and at the times
        ``shown`` (increasing); ``probing`` is used only for those off the grid.
        """
        return DiffusionPath(self, random, probing, shown)


class Laws(NamedTuple):
    """``spread`` of the noise of a step of the sensing grid by its length, and gain and spread of a
    state shown inside a step by (length, left); filled as they are asked for.
    """

    spread: dict[float, FloatArray]
    split: dict[tuple[float, float], tuple[FloatArray, FloatArray]]


def default_sensing_period(
    plant: Diffusion, informations: list[FloatArray], longest: float
) -> float:
    """The sensing period for which the errors' covariance is within 1e-3 of the exact one.

    ``informations`` are the matrices H' R^-1 H of the nodes that sense, ``longest`` what their
    filters can use at once (algorithms/gains). The period is a fraction
    of the fastest time constant of the plant and of a node's own filter (a large
    covariance asks for nothing shorter, see FlowFilter.stretch), rounded down to 1, 2 or 5 times a
    power of ten. It depends on nothing else, so that filters and networks meet the same truth.
    """
    fastest = float(np.abs(np.linalg.eigvals(plant.A)).max())
    for G in informations:
        M = np.block([[-plant.A.T, G], [plant.Q, plant.A]])
        fastest = max(fastest, float(np.abs(np.linalg.eigvals(M)).max()))
    wanted = min(0.5 / fastest if fastest > 0.0 else 1.0, longest, plant.longest_period)
    power = 10.0 ** math.floor(math.log10(wanted))
    digit = next(d for d in (5.0, 2.0, 1.0) if d * power <= wanted * (1.0 + 1e-9))
    return float(f"{digit * power:.12g}")


class Step(NamedTuple):
    """One stretch of the path: times, states at its ends, (2, n) moments and the cubic's (4, n)
    Legendre coefficients of what noise added.
    """

    start: float
    end: float
    x_start: FloatArray
    x_end: FloatArray
    moments: FloatArray
    cubic: FloatArray


class DiffusionPath:
    """The path of one run, produced step by step as time passes."""

    def __init__(
        self,
        plant: Diffusion,
        random: np.random.Generator,
        probing: np.random.Generator,
        shown: FloatArray,
    ) -> None:
        assert plant.sensing_period is not None
        self.period = plant.sensing_period
        self._A, self._B, self._n = plant.A, plant.B, plant.n
        self._random, self._probing, self._shown = random, probing, shown
        self._series = _response_series(plant.A, self.period)
        self._laws = plant.laws
        self._response = self.responses(self.period)
        spread = self._laws.spread.get(self.period)
        if spread is None:
            spread = self._laws.spread[self.period] = _factor(self._noise(self.period))
        self._spread = spread
        self._normals = np.empty((0, 3 * self._n))
        self._used = 0
        start = plant.start_mean + square_root(plant.start_cov) @ random.standard_normal(self._n)
        self._index = -1
        self._steps = [Step(0.0, 0.0, start, start, np.zeros((2, self._n)), np.zeros((4, self._n)))]

    def grid(self, k: int) -> float:
        """Time of the k-th point of the sensing grid, rounded so that lattices of other periods
        meet it.
        """
        return float(round(k * self.period, 12))

    def responses(self, gap: float) -> FloatArray:
        """(3, n, n): what a state adds to the state ``gap`` later and to the two moments."""
        return np.asarray(polynomial(self._series, gap).reshape(3, self._n, self._n))

    def _noise(self, gap: float) -> FloatArray:
        """(3 n, 20 m): responses of the end and the moments to noise at the quadrature nodes."""
        columns = [
            self._impulse(gap, 0.0, gap, s) * np.sqrt(w * gap)
            for s, w in zip(_NODES * gap, _WEIGHTS, strict=True)
        ]
        return np.concatenate(columns, axis=1)

    def _impulse(self, gap: float, start: float, end: float, s: float) -> FloatArray:
        """(3 n, m): what dw at time s adds to x(end) and to the moments over [start, end] of
        length ``gap``.
        """
        if s >= end:
            return np.zeros((3 * self._n, self._B.shape[1]))
        since = max(s, start)
        entry = self.responses(since - s)[0] @ self._B
        rest = end - since
        to_end, plain, tilted = self.responses(rest)
        share = rest / gap  # P_1 of the whole interval is (1 - share) + share P_1 of the rest
        return np.asarray(
            np.concatenate([to_end, plain, (1.0 - share) * plain + share * tilted]) @ entry
        )

    def _next_step(self) -> None:
        n = self._n
        if self._used == len(self._normals):
            self._normals, self._used = self._random.standard_normal((BLOCK, 3 * n)), 0
        before = self._steps[-1]
        noise = (self._spread @ self._normals[self._used]).reshape(3, n)
        self._used += 1
        self._index += 1
        values = self._response @ before.x_end + noise
        start, end = self.grid(self._index), self.grid(self._index + 1)
        cubic = _cubic(self.period, noise[0], noise[1:])
        self._steps = [Step(start, end, before.x_end, values[0], values[1:], cubic)]
        first, last = np.searchsorted(self._shown, [start, end], side="right")
        for time in self._shown[first:last].tolist():
            if time < end:
                self._split(self._steps.pop(), time)

    def following(self) -> tuple[Step, ...]:
        """The next step of the sensing grid, cut at the times shown inside it."""
        self._next_step()
        return tuple(self._steps)

    @property
    def series(self) -> FloatArray:
        """(terms, 3 n n) power series of the responses in the gap."""
        return self._series

    def _at(self, time: float) -> Step:
        while self._steps[-1].end < time:
            self._next_step()
        return next(step for step in self._steps if time <= step.end)

    def step_end(self) -> float:
        """Where the sensing step that was last asked for ends."""
        return self._steps[-1].end

    def moments(self, start: float, end: float) -> FloatArray:
        """(2, n) moments of x over ``[start, end]``, which lies inside one sensing step; ``end``
        never decreases from call to call.
        """
        step = self._at(end)
        return seen(self._series, step, start, end)

    def state(self, time: float) -> FloatArray:
        """x(time) on the sensing grid or at a time shown, not before the last one asked for."""
        step = self._at(time)
        assert time == step.end, f"{time} is neither on the sensing grid nor among the times shown"
        return step.x_end

    def _conditional(self, length: float, left: float) -> tuple[FloatArray, FloatArray]:
        """Gain (3 n, 3 n) and root of the law of state and moments at ``left`` given those of a
        whole step of ``length``.
        """
        n = self._n
        places = np.concatenate([_NODES * left, left + _NODES * (length - left)])
        weights = np.concatenate([_WEIGHTS * left, _WEIGHTS * (length - left)])
        columns = [
            np.concatenate([self._impulse(length, 0, length, s), self._impulse(left, 0, left, s)])
            * np.sqrt(w)
            for s, w in zip(places, weights, strict=True)
        ]
        factor = np.concatenate(columns, axis=1)
        C = factor @ factor.T
        known, asked, cross = C[: 3 * n, : 3 * n], C[3 * n :, 3 * n :], C[3 * n :, : 3 * n]
        gain = cross @ np.linalg.pinv(known, rcond=1e-13, hermitian=True)
        return gain, square_root(asked - gain @ cross.T)

    def _split(self, step: Step, time: float) -> None:
        """Draw the path at ``time`` given the whole step, and put two steps in its place."""
        n, length, left = self._n, step.end - step.start, time - step.start
        key = round(length, 12), round(left, 12)
        law = self._laws.split.get(key)
        if law is None:
            if len(self._laws.split) >= MOST_SPLITS:
                self._laws.split.clear()
            law = self._laws.split[key] = self._conditional(length, left)
        gain, spread = law
        residual = np.concatenate([step.x_end, *step.moments]) - (
            self.responses(length) @ step.x_start
        ).reshape(-1)
        noise = gain @ residual + spread @ self._probing.standard_normal(3 * n)
        values = (self.responses(left) @ step.x_start).reshape(-1) + noise
        x, first = values[:n], values[n:].reshape(2, n)
        share = left / length
        # Moments of the rest: the whole's P_1 is (share - 1) + share P_1 on the left part and
        # share + (1 - share) P_1 on the right one.
        plain = step.moments[0] - first[0]
        tilted = step.moments[1] - (share - 1.0) * first[0] - share * first[1] - share * plain
        second = np.stack([plain, tilted / (1.0 - share)])
        rest = self.responses(length - left) @ x
        later = np.concatenate([step.x_end[None], second]) - rest
        noise = noise.reshape(3, n)
        self._steps += [
            Step(step.start, time, step.x_start, x, first, _cubic(left, noise[0], noise[1:])),
            Step(time, step.end, x, step.x_end, second, _cubic(length - left, later[0], later[1:])),
        ]


def _response_series(A: FloatArray, longest: float) -> FloatArray:
    """(terms, 3 n n): power series in the gap of ``exp(A g)`` and of its two moments."""
    n, size = len(A), float(np.abs(A).sum(axis=0).max()) * longest
    terms, last = 1, 1.0
    while last > 1e-18 or terms < 8:
        last *= size / terms
        terms += 1
    exponential = [np.eye(n)]
    for k in range(1, terms):
        exponential.append(exponential[-1] @ A / k)
    powers = np.stack(exponential)
    series = np.zeros((terms + 1, 3, n, n))
    series[:-1, 0] = powers
    series[1:, 1:] = np.einsum("jk,kab->kjab", forward_coefficients(terms), powers)
    return series.reshape(terms + 1, -1)


def _factor(noise: FloatArray) -> FloatArray:
    """A square lower triangular S with ``S S' = noise noise'``, accurate where that is singular."""
    R = np.linalg.qr(noise.T, mode="r")
    size = len(noise)
    square = np.zeros((size, size))
    square[: len(R)] = R
    signs = np.where(np.diag(square) < 0.0, -1.0, 1.0)
    return np.asarray((signs[:, None] * square).T)


def _cubic(length: float, end: FloatArray, moments: FloatArray) -> FloatArray:
    """(4, n) Legendre coefficients of the cubic on [0, 1] that starts at 0, ends at ``end`` and
    has these moments.
    """
    mean, slope = moments[0] / length, 3.0 * moments[1] / length
    return np.stack([mean, slope, 0.5 * end - mean, 0.5 * end - slope])


@compilable
def _legendre(u: FloatArray) -> FloatArray:
    values = np.empty((len(u), 4))
    for k in range(len(u)):
        z = 2.0 * u[k] - 1.0
        values[k, 0], values[k, 1] = 1.0, z
        values[k, 2], values[k, 3] = 1.5 * z * z - 0.5, (2.5 * z * z - 1.5) * z
    return values


@compilable
def seen(series: FloatArray, step: Step, start: float, end: float) -> FloatArray:
    """(2, n) moments of x over ``[start, end]`` inside a step; ``series`` is of the responses."""
    n = len(step.x_start)
    if start == step.start and end == step.end:
        return step.moments
    length, gap = step.end - step.start, end - start
    places = (start + 0.5 * gap * (1.0 + _THREE) - step.start) / length
    noise = product(_legendre(places), step.cubic)
    from_noise = 0.5 * gap * product(_THREE_MOMENTS, noise)
    x = step.x_start
    if start > step.start:
        x = applied(polynomial(series, start - step.start)[: n * n].reshape(n, n), x)
    response = polynomial(series, gap)[n * n :].reshape(2 * n, n)
    return applied(response, x).reshape(2, n) + from_noise
