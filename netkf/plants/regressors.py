"""Sensors whose observation row is itself random: y = phi' x + v with a regressor phi of its own.

The regressor is part of the truth: it is drawn from a separate stream, so that it does not depend
on the network. Filters are given it with the reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from netkf.core.fields import covariance, definite_covariance, field, matrix, square, vector
from netkf.linalg.arrays import FloatArray, readonly_array
from netkf.linalg.portable import apply, noise_root, product
from netkf.plants.linear import LinearPath, SlotReadings
from netkf.plants.sensors import Sensor
from netkf.rng.streams import Generators


@dataclass(frozen=True, eq=False)
class RegressorSensor(Sensor):
    """``y_k = phi_k' x_k + v_k``, cov(v) = R, with ``phi_k = C s_k``, Xie et al., D (1), VI.

    ``s_0 = start`` and ``s_k = A s_{k-1} + B xi_k``, cov(xi) = ``xi_cov``, independent of all else
    and from node to node. ``A`` (m, m), ``B`` (m, q), ``C`` (n, m), ``start`` (m,),
    ``xi_cov`` (q, q), ``R`` (1, 1).
    """

    A: FloatArray = field(square)
    B: FloatArray = field(matrix)
    C: FloatArray = field(matrix)
    start: FloatArray = field(vector)
    xi_cov: FloatArray = field(covariance)
    R: FloatArray = field(definite_covariance)

    varying = True  # H is drawn for every slot

    @property
    def H(self) -> FloatArray:
        """(1, n): the row of slot 0."""
        return readonly_array(apply(self.C, self.start)[None])

    @cached_property
    def drive(self) -> FloatArray:
        """The matrix B S (m, q) that maps standard normals to ``B xi_k``, with xi_cov = S S'."""
        return product(self.B, noise_root(self.xi_cov))

    def slot_path(self, node: int, period: float, generator: Generators) -> RegressorReadings:
        """Return the readings of the sensor on ``node`` (id) in one run, see Sensor."""
        return RegressorReadings(self, generator("noise"), generator("regressor"))


class RegressorReadings(SlotReadings):
    """The readings of one regressor sensor on one node, one a slot."""

    def __init__(
        self, sensor: RegressorSensor, random: np.random.Generator, driving: np.random.Generator
    ) -> None:
        """Draw the noise of readings from ``random`` and the regressor's state from ``driving``."""
        super().__init__(sensor.H, sensor.R, random)
        self._C, self._s = sensor.C, LinearPath(sensor.A, sensor.drive, sensor.start, driving)

    def matrix(self, slot: int) -> FloatArray:
        """Return H = ``phi_k'`` (1, n) of slot number ``slot``, not before the last one."""
        return apply(self._C, self._s.state(slot))[None]

    def matrices(self, slots: Sequence[int]) -> FloatArray:
        """Return the rows H = ``phi_k'`` (S, 1, n) of S increasing ``slots``."""
        states = np.stack([self._s.state(slot) for slot in slots])
        return product(states[:, None], self._C.T)
