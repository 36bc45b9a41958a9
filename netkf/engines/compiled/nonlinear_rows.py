"""Which rows of the readings of a scenario are not linear, as kernels take them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.algorithms.kernels.maps import spread_of
from netkf.algorithms.kernels.nonlinear_rows import (
    BEARING,
    CUSTOM,
    OF_CUSTOM,
    RANGE,
    NonlinearRows,
    linear_rows,
)
from netkf.linalg.arrays import FloatArray
from netkf.linalg.vector_functions import VectorFunction
from netkf.plants.nonlinear import (
    NonlinearSensor,
    PositionedSensor,
    difference_of,
    jacobian_of,
    reading_of,
)
from netkf.plants.relative import RelativePositionSensor


class NonlinearSetup:
    """The nonlinear rows of a scenario with H filters of at most p rows, of the states ``entries``
    (H or 1, n) of the plant, -1 beyond those that a filter estimates.
    """

    def __init__(self, filters: int, p: int, entries: np.ndarray) -> None:
        self._shape, self._entries = (filters, p), entries
        self.kind = np.zeros((filters, p), dtype=np.int64)
        self.states = np.zeros((filters, p, 3), dtype=np.int64)
        self.dimensions, self.relative, self.length = (
            np.zeros((filters, p), dtype=np.int64) for _ in range(3)
        )
        self.heading = np.full((filters, p), -1)
        self.addresses = np.zeros((filters, p, 3), dtype=np.int64)
        # Whether readings are drawn, and the constant covariances of their noise.
        self.drawn = np.zeros((filters, p), dtype=np.uint8)
        self.R = np.zeros((1, filters, p, p))
        self.functions: list[VectorFunction] = []

    def add(self, sensor: Any, h: int, row: int, R: FloatArray) -> None:
        """Add a reading of a sensor with R (p', p') to filter ``h``, from ``row`` on."""
        rows = slice(row, row + len(R))
        self.R[0, h, rows, rows] = R
        self.drawn[h, rows] = sensor.record is None
        if has_known_h(sensor):
            turned = row + len(R) - sensor.turns
            self.kind[h, row:turned], self.kind[h, turned : rows.stop] = RANGE, BEARING
            self.dimensions[h, rows] = len(sensor.states)
            self.states[h, rows, : len(sensor.states)] = self._state_indices(h, sensor.states)
            self.relative[h, rows] = isinstance(sensor, RelativePositionSensor)
            if sensor.heading is not None:
                self.heading[h, rows] = self._state_indices(h, [sensor.heading])
            return
        self.kind[h, row], self.kind[h, row + 1 : rows.stop] = CUSTOM, OF_CUSTOM
        self.length[h, row] = p = len(R)
        functions = _functions_of(sensor, p, self._of(h), 1 + self._entries.max())
        self.functions += functions
        self.addresses[h, row] = [function.address for function in functions]

    def _of(self, h: int) -> np.ndarray:
        entries: np.ndarray = self._entries[min(h, len(self._entries) - 1)]
        return entries

    def _state_indices(self, h: int, states: Sequence[int]) -> np.ndarray:
        """Return which of the states of filter ``h`` these states of the plant are."""
        return np.array([np.flatnonzero(self._of(h) == state)[0] for state in states])

    def reference(self, sensor: Any, place: int, h: int) -> FloatArray:
        """Return what the readings of a sensor are measured from at a ``place`` (id), as rows of H
        say it (n,): coordinates, numbers of states, or for a user's sensor the id.
        """
        made = np.zeros(self._entries.shape[1])
        if not has_known_h(sensor):
            made[0] = place
        elif isinstance(sensor, RelativePositionSensor):
            others = self._state_indices(h, sensor.other_states(place))
            made[: len(others)] = others
        else:
            positions = np.asarray(sensor.positions, dtype=np.float64)
            made[: positions.shape[1]] = positions[sensor.places.index(place)]
        return made

    def raise_error(self) -> None:
        """Raise the error of a user's sensor, if a call has failed."""
        for function in self.functions:
            function.raise_error()

    def tables(self, method: str, active: int) -> NonlinearRows:
        """Return the rows for kernels and ``active`` runs; ``method``: how filters linearise."""
        rows = linear_rows(*self._shape, self._entries)
        points = [spread_of(method, n) for n in rows.count.tolist()]
        for name in ("kind", "states", "dimensions", "relative", "heading", "length"):
            setattr(rows, name, getattr(self, name))
        rows.functions, rows.R, rows.active = self.addresses, self.R.copy(), active
        rows.distance = np.array([spread.distance for spread in points])
        rows.weight = np.array([spread.weight for spread in points])
        rows.center = points[0].center if points else 0.0
        return rows


def has_known_h(sensor: NonlinearSensor) -> bool:
    """Return True if kernels know what a sensor reads."""
    base: Any = PositionedSensor
    if isinstance(sensor, RelativePositionSensor):
        base = RelativePositionSensor
    methods = ("h", "jacobian", "difference", "offset", "offset_gradient")
    return isinstance(sensor, base) and all(
        getattr(type(sensor), name) is getattr(base, name) for name in methods
    )


def _functions_of(
    sensor: NonlinearSensor, p: int, entries: np.ndarray, states: int
) -> list[VectorFunction]:
    """Return a user's h, Jacobian and difference, of ``entries`` (n,); t is the id of a node."""
    n, is_own = len(entries), entries >= 0

    def whole(x: FloatArray) -> FloatArray:
        state = np.zeros(states)
        state[entries[is_own]] = x[is_own]
        return state

    def h(x: FloatArray, _: FloatArray, node: float) -> Any:
        return reading_of(sensor, whole(x), int(node))

    def jacobian(x: FloatArray, _: FloatArray, node: float) -> Any:
        J = jacobian_of(sensor, whole(x), int(node))
        own = np.zeros((len(J), n))
        own[:, is_own] = J[:, entries[is_own]]
        return own

    def difference(y: FloatArray, expected: FloatArray, _: float) -> Any:
        return difference_of(sensor, y, expected)

    shapes = ((n,), (0,), (p,)), ((n,), (0,), (p, n)), ((p,), (p,), (p,))
    functions = zip((h, jacobian, difference), shapes, strict=True)
    return [VectorFunction(function, shape, is_kernel=False) for function, shape in functions]
