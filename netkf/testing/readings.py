"""Readers: one interface to the readings of a sensor in slots, at sample times, or as
increments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.parts.noises import Pieces, read_pieces
from netkf.linalg.arrays import FloatArray
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.rng.streams import Streams
from netkf.testing.watching import demand, demand_array, guard_user_code

PERIOD, HORIZON = 1.0, 1e6  # seconds of a slot, and of a run: readings end before
STEP = 0.1  # seconds of a step of increments
CUTS: tuple[tuple[float, ...], ...] = ((), (0.3,), (0.2, 0.65), (0.9,))
"""Shares of a step at which increments are cut; steps take these entries in turn."""


class ReadingSeries(NamedTuple):
    """Readings y (K, p) with their matrices H (K, p, n)."""

    y: FloatArray
    H: FloatArray


class SensorReader:
    """Reads a sensor in slots, or the ``samples`` that it takes of a diffusion. ``name`` is that of
    the user's class.

    A path, which a method of the sensor returns, gives the readings of one node in one run. ``p``
    is the number of rows of a reading, ``n`` that of states.
    """

    def __init__(self, sensor: Any, name: str, method: str = "slot_path") -> None:
        """Take the ``sensor``, with a matrix H (p, n), and the name of its class."""
        self.sensor, self.where, self.samples = sensor, f"{name}.{method}", method == "samples"
        self.p, self.n = len(sensor.R), sensor.H.shape[1]

    def make_path(self, streams: Streams, node: int) -> Any:
        """Return the path of a node in one run, made with the run's random ``streams``."""
        generator = generators(streams, node)
        with guard_user_code(self.where):
            if self.samples:
                return self.sensor.samples(node, generator, HORIZON)
            return self.sensor.slot_path(node, PERIOD, generator)

    def read_several(self, path: Any, ks: Sequence[int], x: FloatArray) -> ReadingSeries:
        """Return y (K, p) and H (K, p, n) of readings ``ks`` at ``x`` (K, n), in one call."""
        with guard_user_code(self.where):
            y, H = path.several(ks, x)
        y = demand_array(self.where, "y of several", y, (len(ks), self.p))
        return ReadingSeries(y, demand_array(self.where, "H of several", H, (*y.shape, self.n)))

    def read_one(self, path: Any, k: int, x: FloatArray) -> ReadingSeries:
        """Return reading number ``k`` at the state ``x`` (n,) as a series of one reading."""
        with guard_user_code(self.where):
            # In the order in which engines call them.
            y, H = path.reading(k, x) if self.samples else (path.reading(k, x), path.matrix(k))
        y = demand_array(self.where, "a reading", y, (self.p,))
        return ReadingSeries(y[None], demand_array(self.where, "H", H, (self.p, self.n))[None])


def generators(streams: Streams, node: int) -> Callable[[str], np.random.Generator]:
    """Return the function from purposes to random generators of the first sensor of a node."""
    return lambda purpose: streams.generator(purpose, node, 0)


def make_reader(sensor: Sensor, name: str) -> SensorReader:
    """Return the reader of samples, or else of readings in slots."""
    has_clock = getattr(sensor, "sampling", None) is not None
    overrides_samples = type(sensor).samples not in (Sensor.samples, LinearSensor.samples)
    samples = has_clock or (overrides_samples and not sensor.varying)
    return SensorReader(sensor, name, "samples" if samples else "slot_path")


class IncrementReader(SensorReader):
    """Reads the increments of a sensor of a constant state, over steps that may be cut."""

    def __init__(self, sensor: Any, name: str) -> None:
        super().__init__(sensor, name, "path")

    def read(self, streams: Streams, node: int, x: FloatArray, steps: int, cut: bool) -> Pieces:
        """Return increments over ``steps`` at a constant ``x`` (n,), each ``cut`` or not."""
        generator, still = generators(streams, node), np.stack([x, np.zeros_like(x)])
        with guard_user_code(self.where):
            path = self.sensor.path(generator("noise"), generator("cut"))
            pieces = read_pieces(path, STEP, steps, CUTS if cut else CUTS[:1], lambda g: g * still)
        shape = (len(pieces.step), 2, self.p)
        return pieces._replace(moments=demand_array(self.where, "moments", pieces.moments, shape))


def combine(pieces: Pieces) -> FloatArray:
    """Return the moments (S, 2, p) of increments over whole steps."""
    total = np.zeros((int(pieces.step[-1]) + 1, *pieces.moments.shape[1:]))
    for moments, _, (start, end), k in zip(*pieces, strict=True):
        # On a piece, P_1 of the step is its value in the middle of the piece plus the share of the
        # piece times P_1 of the piece.
        middle = ((start - k * STEP) - ((k + 1) * STEP - end)) / STEP
        total[k, 0] += moments[0]
        total[k, 1] += middle * moments[0] + (end - start) / STEP * moments[1]
    return total


def demand_matrices(sensor: Any, name: str) -> None:
    """Raise AssertionError unless H (p, n) and R (p, p) of a sensor have these shapes."""
    for field in ("H", "R"):
        matrix = getattr(sensor, field, None)
        is_matrix = isinstance(matrix, np.ndarray) and matrix.ndim == 2
        demand(is_matrix, f"{name}.{field}", "must be a matrix: filters are told it")
    H, R = sensor.H, sensor.R
    rule = f"must have the shape {(len(H), len(H))}, one row for each of H"
    demand(R.shape == (len(H), len(H)), f"{name}.R", rule, str(R.shape))
