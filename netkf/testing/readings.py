"""The readings of a sensor in slots, at sample times and as increments, under one form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.plants.diffusion import Diffusion
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.rng.streams import Streams
from netkf.testing.watching import attempt, demand, demand_array, user_code

# Seconds; no clock that is checked ticks up to this horizon.
PERIOD, HORIZON = 1.0, 1e6
STEP = 0.1  # seconds of an increment
CUTS: tuple[tuple[float, ...], ...] = ((), (0.3,), (0.2, 0.65), (0.9,))
"""Shares of a step at which increments are cut, step after step."""


class ReadingSeries(NamedTuple):
    """Readings y (K, p) with their matrices H (K, p, n)."""

    y: FloatArray
    H: FloatArray


class SensorReader:
    """Makes readings of a sensor; ``method`` of its class makes the path of one run."""

    method = "slot_path"

    def __init__(self, sensor: Any, name: str) -> None:
        self.sensor, self.where = sensor, f"{name}.{self.method}"
        self.p, self.n = len(sensor.R), sensor.H.shape[1]

    def path(self, streams: Streams, node: int) -> Any:
        """Make the path of one run."""

        def generator(purpose: str) -> np.random.Generator:
            """Return the random generator of a purpose."""
            return streams.generator(purpose, node, 0)

        return attempt(self.where, self._make_path, node, generator)

    def _make_path(self, node: int, generator: Callable[[str], np.random.Generator]) -> Any:
        """Return the path of the sensor's readings."""
        return self.sensor.slot_path(node, PERIOD, generator)

    def several(self, path: Any, ks: Sequence[int], x: FloatArray) -> ReadingSeries:
        """Read a path at increasing numbers ``ks``, with states x (K, n), in one call."""
        y, H = attempt(self.where, path.several, ks, x)
        y = demand_array(self.where, "y of several", y, (len(ks), self.p))
        return ReadingSeries(
            y, demand_array(self.where, "H of several", H, (len(ks), self.p, self.n))
        )

    def one(self, path: Any, k: int, x: FloatArray) -> ReadingSeries:
        """Read a path once, with state x (n,): y (1, p) and H (1, p, n)."""
        with user_code(self.where):
            y, H = self._read_one(path, k, x)
        y = demand_array(self.where, "a reading", y, (self.p,))
        return ReadingSeries(y[None], demand_array(self.where, "H", H, (self.p, self.n))[None])

    def _read_one(self, path: Any, k: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return reading ``k`` (p,) at the state x (n,), and its H (p, n)."""
        # As the engines do: first the reading, then its matrix.
        return path.reading(k, x), path.matrix(k)


class SampleReader(SensorReader):
    """Samples of a sensor over a diffusion."""

    method = "samples"

    def _make_path(self, node: int, generator: Callable[[str], np.random.Generator]) -> Any:
        """Return the path of the sensor's samples."""
        return self.sensor.samples(node, generator, HORIZON)

    def _read_one(self, path: Any, k: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sample ``k`` (p,) at the state x (n,), and its H (p, n)."""
        y, H = path.reading(k, x)
        return y, H


def readers(sensor: Sensor, name: str) -> list[SensorReader]:
    """Return the readers of the kinds of readings that a class gives."""
    sampled = getattr(sensor, "sampling", None) is not None
    own = type(sensor).samples not in (Sensor.samples, LinearSensor.samples)
    if sampled or (own and not sensor.varying):
        return [SampleReader(sensor, name)]
    return [SensorReader(sensor, name)]


def gives_increments(sensor: Sensor) -> bool:
    """Return True for a sensor whose increments are integrated in continuous time."""
    return isinstance(sensor, LinearSensor) and sensor.sampling is None


class Pieces(NamedTuple):
    """Increments of the pieces of steps: ``moments`` (K, 2, p), the ``spans`` (K, 2) in seconds
    from start to end, and whose ``step`` (K,) each is.
    """

    moments: FloatArray
    spans: FloatArray
    step: np.ndarray


class IncrementReader:
    """Increments of a sensor of a constant state, over steps that are cut or whole."""

    def __init__(self, sensor: Any, name: str) -> None:
        self.sensor, self.where = sensor, f"{name}.path"
        self.p, self.n = len(sensor.R), sensor.H.shape[1]

    def pieces(self, streams: Streams, node: int, x: FloatArray, steps: int, cut: bool) -> Pieces:
        """Return the pieces of ``steps`` steps with state x (n,)."""
        with user_code(self.where):
            return self._read_pieces(streams, node, x, steps, cut)

    def _read_pieces(
        self, streams: Streams, node: int, x: FloatArray, steps: int, cut: bool
    ) -> Pieces:
        """Return the moments of the increments at a constant state, with steps whole or cut."""
        plant = Diffusion(
            mean=x, A=np.zeros((self.n, self.n)), B=np.zeros((self.n, 1)), sensing_period=STEP
        )
        own, probing = (streams.generator(purpose, node, 0) for purpose in ("plant", "probe"))
        truth = plant.path(own, probing, np.empty(0))
        noise, cutting = (streams.generator(purpose, node, 0) for purpose in ("noise", "cut"))
        path = self.sensor.path(noise, cutting)
        found, spans, whose = [], [], []
        for k in range(steps):
            first, last = truth.grid(k), truth.grid(k + 1)
            shares = CUTS[k % len(CUTS)] if cut else ()
            times = [first, *(first + share * (last - first) for share in shares), last]
            for start, end in pairwise(times):
                x_moments = truth.moments(start, end)
                moments = path.moments(truth, x_moments, start, end)
                found.append(demand_array(self.where, "moments", moments, (2, self.p)))
                spans.append((start, end))
                whose.append(k)
        return Pieces(np.array(found), np.array(spans), np.array(whose))

    def whole(self, pieces: Pieces) -> FloatArray:
        """Return the moments (S, 2, p) of whole steps from those of their pieces."""
        total = np.zeros((int(pieces.step[-1]) + 1, 2, self.p))
        for part, (start, end), k in zip(*pieces, strict=True):
            first, last = k * STEP, (k + 1) * STEP
            # P_1 of the whole step on this part of it: moved by its middle, scaled by its share.
            middle = ((start - first) - (last - end)) / STEP
            total[k, 0] += part[0]
            total[k, 1] += middle * part[0] + (end - start) / STEP * part[1]
        return total


def demand_matrices(sensor: Any, name: str) -> None:
    """Check that H (p, n) and R (p, p) of a sensor fit each other."""
    for field in ("H", "R"):
        known = isinstance(getattr(sensor, field, None), np.ndarray)
        rule = "must be a matrix: filters are told it"
        demand(known and getattr(sensor, field).ndim == 2, f"{name}.{field}", rule)
    H, R = sensor.H, sensor.R
    square = R.shape == (len(H), len(H))
    rule = f"must have the shape {(len(H), len(H))}, one row for each of H"
    demand(square, f"{name}.R", rule, str(R.shape))
