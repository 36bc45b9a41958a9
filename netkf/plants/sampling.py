"""Samples of sensors of a plant in continuous time, and recorded sampling times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.random import Generator

from netkf.core.clock import Clock, Entity
from netkf.core.csv_files import read_columns
from netkf.core.fields import Rule, SourceFile, field, source_file
from netkf.linalg.arrays import FloatArray
from netkf.plants.linear import SlotReadings


class Samples(Protocol):
    """The samples of one sensor on one node in one run, numbered k = 0, 1, ... in order of time.

    For a nonlinear sensor a function that linearises the reading takes the place of H.
    """

    def reading(self, k: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``y`` (p,) and ``H`` (p, n) of sample ``k``, not decreasing, at x (n,)."""

    def several(self, ks: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``y`` (S, p) and ``H`` (S, p, n) of samples ``ks``, increasing, at x (S, n)."""


class DrawnSamples:
    """Samples ``y = H x + v``, cov(v) = R, with H (p, n) and R (p, p), of a linear sensor; v is the
    Cholesky factor of R times the next p standard normals of ``random``.
    """

    def __init__(self, H: FloatArray, R: FloatArray, random: Generator) -> None:
        self._readings = SlotReadings(H, R, random)

    def reading(self, k: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``y`` (p,) and ``H`` (p, n) of sample number ``k``, see Samples."""
        return self._readings.reading(k, x), self._readings.matrix(k)

    def several(self, ks: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``y`` (S, p) and ``H`` (S, p, n) of the S samples ``ks``, see Samples."""
        return self._readings.several(ks, x)


@dataclass(frozen=True, eq=False)
class RecordedSampling(Clock):
    """Samples at the times of a table ``t,node`` (seconds, above 0); several rows of a node at one
    time are one sample.
    """

    path: SourceFile = field(source_file)

    _reads = "_times"

    @cached_property
    def row_times(self) -> list[tuple[int, float]]:
        """Node id and time (seconds) of every row, in the order of the file."""
        table = read_columns(self.path, ("t", "node"))
        nodes = table.integers("node")
        early = np.flatnonzero(table["t"] <= 0.0)
        table.refuse_early(early, "t must be above 0, the first sample comes after the start")
        return list(zip(nodes, table["t"].tolist(), strict=True))

    @cached_property
    def _times(self) -> dict[int, FloatArray]:
        """Increasing sampling times (K,) in seconds, by node id."""
        times: dict[int, list[float]] = {}
        for node, t in self.row_times:
            if t > 0.0:
                times.setdefault(node, []).append(t)
        return {node: np.unique(times[node]) for node in sorted(times)}

    @property
    def listed(self) -> tuple[int, ...]:
        """Ids of all nodes in the table."""
        return tuple(sorted({node for node, _ in self.row_times}))

    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return up to ``count`` recorded times of the node ``entity[0]``, from number ``index``
        on.
        """
        return self._times.get(entity[0], np.empty(0))[index : index + count]


def _sampling(value: object) -> Clock | None:
    """Return the clock of a sensor, None for "continuous", or raise ScenarioError."""
    if isinstance(value, str) and value == "continuous":
        return None
    if not isinstance(value, Clock):
        raise TypeError
    return value


sampling = Rule(
    'must be "continuous" or a clock',
    _sampling,
    'write sampling = { kind = "periodic", period = ... }',
)
