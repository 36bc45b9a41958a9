"""Sensors whose observation row is itself random: y = phi' x + v with a regressor phi of its own.

The regressor is truth: it is drawn from a stream of its own, whatever the network does, and travels
with the reading as known data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from netkf.core.arrays import FloatArray, frozen, square_root
from netkf.core.fields import covariance, definite_covariance, matrix, setting, square, vector
from netkf.plants.linear import Blocks, SlotReadings
from netkf.plants.sensors import Sensor


@dataclass(frozen=True, eq=False)
class RegressorSensor(Sensor):
    """``y_k = phi_k' x_k + v_k``, cov(v) = R, with ``phi_k = C s_k``, D (1) and section VI.

    ``s_0 = start`` and ``s_k = A s_{k-1} + B xi_k``, cov(xi) = ``xi_cov``, independent of all else
    and from node to node. ``A`` (m, m), ``B`` (m, q), ``C`` (n, m), ``start`` (m,),
    ``xi_cov`` (q, q), ``R`` (1, 1).
    """

    A: FloatArray = setting(square)
    B: FloatArray = setting(matrix)
    C: FloatArray = setting(matrix)
    start: FloatArray = setting(vector)
    xi_cov: FloatArray = setting(covariance)
    R: FloatArray = setting(definite_covariance)

    @property
    def varying(self) -> bool:
        """True."""
        return True

    @property
    def H(self) -> FloatArray:
        """(1, n): the row of slot 0."""
        return frozen((self.C @ self.start)[None])

    def slot_path(
        self, node: int, period: float, generator: Callable[[str], np.random.Generator]
    ) -> RegressorReadings:
        """From the streams "noise" and "regressor"."""
        return RegressorReadings(self, generator("noise"), generator("regressor"))


class RegressorReadings(SlotReadings):
    """The readings of one regressor sensor on one node, one a slot."""

    def __init__(
        self,
        sensor: RegressorSensor,
        random: np.random.Generator,
        driving: np.random.Generator,
    ) -> None:
        super().__init__(sensor.H, sensor.R, random)
        self._sensor, self._s, self._at = sensor, sensor.start, 0
        self._drive = sensor.B @ square_root(sensor.xi_cov)
        self._xi = Blocks(driving, len(sensor.xi_cov))

    def matrix(self, slot: int) -> FloatArray:
        """``phi_k'`` (1, n) of a slot not before the last one asked for."""
        while self._at < slot:
            self._s = self._sensor.A @ self._s + self._drive @ self._xi.draw()
            self._at += 1
        return np.asarray((self._sensor.C @ self._s)[None])

    def matrices(self, slots: Sequence[int]) -> FloatArray:
        """Their ``matrix`` (S, 1, n)."""
        driven = (self._xi.draws(slots[-1] - self._at)[:, None] @ self._drive.T)[:, 0]
        states, A = [self._s], self._sensor.A
        for push in driven:
            states.append(A @ states[-1] + push)
        made = np.stack(states)[np.array(slots) - self._at]
        self._s, self._at = states[-1], slots[-1]
        return np.asarray(made[:, None] @ self._sensor.C.T)
