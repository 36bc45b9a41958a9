"""Nonlinear sensors: range, bearing, both, or a user's own h(x) with its Jacobian.

A reading is ``y = h(x) + v``, cov(v) = R. Filters linearise it at their own estimate xbar of that
instant, as the extended Kalman filter does: they are given ``y - h(xbar) + J xbar`` and J, so that
their innovation ``y - h(xbar)`` is the true one, and any filter can use any sensor.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from netkf.core.clock import Clock
from netkf.core.contracts import is_netkf_class
from netkf.core.errors import ScenarioError, quote
from netkf.core.fields import (
    SourceFile,
    definite_covariance,
    either,
    field,
    has_depth,
    integer,
    list_of,
    matrix,
    node_id,
    one_of,
    source_file,
    text,
)
from netkf.linalg.arrays import FloatArray
from netkf.plants.linear import SlotReadings
from netkf.plants.readings import (
    Matrix,
    ReadingTable,
    RecordedReadings,
    RecordedSamples,
    take_from_record,
)
from netkf.plants.sampling import DrawnSamples, Samples, sampling
from netkf.plants.sensors import Sensor
from netkf.rng.streams import Generators

GRAPH = "graph"


class Linearised:
    """A function that linearises the readings of a sensor at one of its nodes. Filters are given it
    in the place of H, for calls with a reading and an estimate; ``present`` (p,) flags values.
    """

    def __init__(
        self, sensor: NonlinearSensor, node: int, present: np.ndarray | None = None
    ) -> None:
        self._sensor, self._node = sensor, node
        self._present = np.ones(len(sensor.R), dtype=bool) if present is None else present

    @property
    def size(self) -> int:
        """The number p of values of a reading."""
        return int(self._present.sum())

    def support(self, n: int) -> np.ndarray:
        """Return the entries (k,) of a state of ``n`` that the reading depends on."""
        entries: np.ndarray = self._sensor.support(n, self._node)
        return entries

    def __call__(self, y: FloatArray, xhat: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the reading ``y`` (p,) of a sensor linearised at the estimate ``xhat`` (n,):
        ``y - h(xhat) + J xhat`` (p,) and the Jacobian J (p, n), a linear filter's reading and H.
        """
        J = jacobian_of(self._sensor, xhat, self._node)[self._present]
        return self.difference(y, self.value(xhat)) + J @ xhat, J

    def value(self, x: FloatArray) -> FloatArray:
        """Return the reading (p,) without noise at the state x (n,)."""
        return np.asarray(reading_of(self._sensor, x, self._node)[self._present])

    def difference(self, y: FloatArray, expected: FloatArray) -> FloatArray:
        """Return the innovation (p,): a reading y (p,) minus the ``expected`` one (p,)."""
        both = np.zeros((2, len(self._present)))
        both[:, self._present] = y, expected
        return np.asarray(difference_of(self._sensor, *both)[self._present])


def linearise_by_points(
    h: Any, y: FloatArray, xhat: FloatArray, root: FloatArray, points: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a reading y (p,), its H (p, n) and a covariance (p, p) to add to that of its noise,
    with which the Kalman update is that of the sigma points: statistical linearisation of h at
    ``xhat`` (n,) and the lower triangular ``root`` (n, n) of P. ``h`` is a Linearised or
    Stacked; ``points`` = (distance, weight, center) are a ``kernels.maps.Spread``.
    """
    distance, weight, center = points
    middle = h.value(xhat)
    above, below = (
        np.stack([h.difference(h.value(xhat + step), middle) for step in steps])
        for steps in (distance * root.T, -distance * root.T)
    )
    # Relative to the reading at xhat. G is the covariance of reading and state times S^-T.
    mean = weight * (above + below).sum(axis=0)
    G = weight * distance * (above - below).T
    # H = G S^-1; columns of the root that are 0 say nothing.
    H = G.copy()
    for j in range(len(xhat) - 1, -1, -1):
        H[:, j] = (G[:, j] - H[:, j + 1 :] @ root[j + 1 :, j]) / (root[j, j] or np.inf)
    # P_yy - H P H': what is even in the deviations, while H P H' = G G' has all that is odd.
    even = above + below - 2.0 * mean
    extra = 0.5 * weight * even.T @ even + center * np.outer(mean, mean)
    return h.difference(y, middle + mean) + H @ xhat, H, extra


@dataclass(frozen=True, eq=False)
class NonlinearSensor(Sensor):
    """The contract of nonlinear sensors, ``y = h(x) + v``, cov(v) = R (p, p), in every slot or, in
    continuous time, whenever the clock ``sampling`` ticks.

    With a ``path`` the readings are recorded: a table ``t,node,y0,...``, which may repeat times,
    leave values empty and bring its own noise, as that of a recorded linear sensor. A column ``to``
    names the anchor that a row is measured from, by its id; else that is the node itself.

    A class defines ``h`` and ``jacobian``, and ``difference`` where readings are angles. Before a
    run the scenario calls ``located`` and ``check_state``.
    """

    R: FloatArray = field(definite_covariance)
    sampling: Clock | None = field(sampling, default=None)
    path: SourceFile | None = field(source_file, default=None)

    linear: ClassVar[bool] = False
    varying = True  # the Jacobian depends on the estimate

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.record is None:
            return
        if self.sampling is not None:
            rule = "means nothing with path: samples are at the times of the table"
            raise ScenarioError("sampling", rule, None, "leave it out")
        take_from_record(self, self.record)
        for node in self.nodes:
            self.record.rows(node)  # a mistake in the file is found on construction

    @cached_property
    def record(self) -> ReadingTable | None:
        """The table of its readings; None if they are drawn."""
        if self.path is None:
            return None
        given: FloatArray | None = self.R
        return ReadingTable(self.path, self._count(given), given, linear=False)

    def _count(self, R: FloatArray | None) -> int:
        return 0 if R is None else len(R)

    @property
    def is_random(self) -> bool:  # type: ignore[override]
        """True if runs draw the readings, False if they are recorded."""
        return self.path is None

    @property
    def places(self) -> tuple[int, ...]:
        """The ids of what readings are measured from: the anchors of the table, else ``nodes``."""
        return self.record.anchors if self.record and self.record.has_anchors else self.nodes

    @abstractmethod
    def h(self, x: FloatArray, node: int) -> FloatArray:
        """Return the reading (p,) without noise on ``node`` (id) when the state is x (n,)."""

    @abstractmethod
    def jacobian(self, x: FloatArray, node: int) -> FloatArray:
        """Return the Jacobian (p, n) of ``h`` at the state x (n,), on ``node`` (id)."""

    def difference(self, y: FloatArray, expected: FloatArray) -> FloatArray:
        """Return the innovation (p,): a reading y (p,) minus the ``expected`` one (p,)."""
        return y - expected

    def check_state(self, n: int) -> None:
        """Raise ScenarioError if the sensor cannot read a state of n components."""

    def support(self, n: int, node: int) -> np.ndarray:
        """Return the entries (k,) of a state of ``n`` that readings on ``node`` (id) depend on: by
        default all.
        """
        return np.arange(n)

    def located(self, positions: dict[int, tuple[float, float]] | None) -> NonlinearSensor:
        """Return the sensor with its nodes at the ``positions`` of the graph, coordinates by node
        id (None: it has none), if the sensor uses them.
        """
        return self

    def matrix_of(self, n: int) -> FloatArray:
        """Return zeros (p, n): H is unknown before there is an estimate."""
        return np.zeros((len(self.R), n))

    def slot_path(self, node: int, period: float, generator: Generators) -> Any:
        """Return the readings of the sensor on ``node`` (id) in one run, see Sensor."""
        if self.record is None:
            return NonlinearReadings(self, node, generator("noise"))
        slots = self.record.slots(node, period)
        return RecordedReadings(self.record.rows(node), slots, self._row_functions(node), 0)

    def _row_functions(self, node: int) -> Matrix:
        """Return what linearises the values that are there in row k of the table of ``node``."""
        assert self.record is not None
        anchors, has_anchors = self.record.rows(node).anchors, self.record.has_anchors
        return lambda k, present: Linearised(
            self, int(anchors[k]) if has_anchors else node, present
        )

    def sample_times(
        self, node: int, ordinal: int, generator: Generators, horizon: float
    ) -> FloatArray:
        """Return the times (K,) of its table, or of the ticks of ``sampling``, see Sensor."""
        if self.record is not None:
            return self.record.times(node, horizon)
        return super().sample_times(node, ordinal, generator, horizon)

    def samples(self, node: int, generator: Generators, horizon: float) -> Samples:
        """Return the samples of the sensor on ``node`` (id) in one run, see Sensor."""
        if self.record is not None:
            return RecordedSamples(self.record.rows(node), self._row_functions(node))
        return NonlinearSamples(self, node, generator("noise"))


def reading_of(sensor: NonlinearSensor, x: FloatArray, node: int) -> FloatArray:
    """Return h(x) (p,) on ``node`` (id); raises ValueError for other results of a user's class."""
    return _result_of(sensor, "h", (len(sensor.R),), x, node)


def jacobian_of(sensor: NonlinearSensor, x: FloatArray, node: int) -> FloatArray:
    """Return the Jacobian (p, n) of h at x (n,), see ``reading_of``."""
    return _result_of(sensor, "jacobian", (len(sensor.R), len(x)), x, node)


def _result_of(
    sensor: NonlinearSensor, method: str, shape: tuple[int, ...], x: FloatArray, node: int
) -> FloatArray:
    if is_netkf_class(type(sensor)):
        return np.asarray(getattr(sensor, method)(x, node), dtype=np.float64)
    given = getattr(sensor, method)(x.copy(), node)
    # Of a state that has left the numbers nobody can know the reading.
    return _numbers_of(given, method, shape, bool(np.isfinite(x).all()), f"at x = {quote(x)}")


def difference_of(sensor: NonlinearSensor, y: FloatArray, expected: FloatArray) -> FloatArray:
    """Return the innovation (p,) of a reading y (p,), nan where one of both is, see
    ``reading_of``.
    """
    if is_netkf_class(type(sensor)):
        return np.asarray(sensor.difference(y, expected))
    known = np.isfinite(y) & np.isfinite(expected)
    y, expected = np.where(known, y, 0.0), np.where(known, expected, 0.0)
    given, where = sensor.difference(y.copy(), expected.copy()), f"of {quote(y)}, {quote(expected)}"
    return np.where(known, _numbers_of(given, "difference", y.shape, True, where), np.nan)


def _numbers_of(
    given: Any, method: str, shape: tuple[int, ...], is_finite: bool, where: str
) -> FloatArray:
    result = np.asarray(given)
    is_right = result.dtype.kind in "fiu" and result.shape == shape
    if not is_right or (is_finite and not np.isfinite(result).all()):
        rule = f"{method} must return finite numbers of the shape {shape}, not {quote(given)}"
        raise ValueError(f"{rule}, {where}")
    return result.astype(np.float64)


class NonlinearReadings(SlotReadings):
    """The readings of a nonlinear sensor at one node (id), one a slot, with noise from ``random``.

    ``matrix`` returns the function that linearises a reading instead of a matrix.
    """

    def __init__(self, sensor: NonlinearSensor, node: int, random: np.random.Generator) -> None:
        super().__init__(np.zeros((len(sensor.R), 0)), sensor.R, random)
        self._sensor, self._node = sensor, node

    def matrix(self, slot: int) -> Any:
        """Return the function that linearises a reading at an estimate, in every ``slot``."""
        return Linearised(self._sensor, self._node)

    def reading(self, slot: int, x: FloatArray) -> FloatArray:
        """Return the reading ``h(x) + v`` (p,) of slot number ``slot``, see Readings."""
        noise = self.noise(slot)
        return reading_of(self._sensor, x, self._node) + noise


class NonlinearSamples(DrawnSamples):
    """The samples of a nonlinear sensor at one node (id) in continuous time, with noise from
    ``random``; a function that linearises the reading takes the place of H.
    """

    def __init__(self, sensor: NonlinearSensor, node: int, random: np.random.Generator) -> None:
        self._readings = NonlinearReadings(sensor, node, random)

    def several(self, ks: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Raise TypeError: without an estimate there is no H of samples ``ks``."""
        raise TypeError("readings of nonlinear sensors have no H before an estimate")


@dataclass(frozen=True, eq=False)
class PositionedSensor(NonlinearSensor):
    """A sensor of the position of a target relative to its node, in 2 or 3 dimensions.

    positions  the coordinates of ``nodes``, in their order: rows (x, y) or (x, y, z); "graph", the
               default, takes those of the graph. Of a table with a column ``to`` the coordinates of
               all its anchors, in the order of their ids
    states     which components of the state are the target's position
    heading    the component of the state that is the target's heading, if it is the target that
               looks at the place, and directions are measured from its heading
    of         with [[plants]], the block that ``states`` and ``heading`` count in
    """

    nodes: tuple[int, ...] = field(list_of(node_id(), "node ids"), default=None)
    R: FloatArray = field(definite_covariance, default=None)
    positions: str | FloatArray = field(either(one_of(GRAPH), matrix, has_depth(1)), default=GRAPH)
    states: tuple[int, ...] = field(list_of(integer(low=0), "numbers of states"), default=(0, 1))
    heading: int | None = field(integer(low=0), default=None)
    of: str | None = field(text, default=None)

    rows: ClassVar[int] = 0
    """Number p of the values of a reading, distance and angle, which subclasses set."""
    turns: ClassVar[bool] = False
    """Whether the last of these values is an angle."""

    def __post_init__(self) -> None:
        if self.path is None:
            for name in ("nodes", "R"):
                if getattr(self, name) is None:
                    raise ScenarioError(name, "is missing", None, f"add {name} = ...")
        super().__post_init__()

    def _count(self, R: FloatArray | None) -> int:
        return self.rows

    def located(self, positions: dict[int, tuple[float, float]] | None) -> NonlinearSensor:
        """Return the sensor with its nodes at ``positions``; raises ScenarioError for None."""
        if not isinstance(self.positions, str):
            return self
        if positions is None:
            raise ScenarioError(
                "positions",
                "are missing, and this graph has none",
                None,
                "write positions = [[x, y], ...], one for each of nodes",
            )
        # Nodes that the graph does not have are refused by name when the sensors are placed.
        nowhere = (0.0, 0.0)
        return replace(self, positions=np.array([positions.get(k, nowhere) for k in self.places]))

    def check_state(self, n: int) -> None:
        """Raise ScenarioError if positions, states or R do not fit a state of ``n`` components."""
        if max(self.states) >= n or len(set(self.states)) < len(self.states):
            rule = f"must be different components of a state of {n}, counted from 0"
            raise ScenarioError("states", rule, list(self.states), "name those of the position")
        if self.heading is not None and (self.heading >= n or not self.turns):
            rule = f"must be a component of a state of {n}, and means nothing without directions"
            raise ScenarioError("heading", rule, self.heading, "correct it, or leave it out")
        if self.heading in self.states:
            rule = "must be another component of the state than those of the position"
            raise ScenarioError("heading", rule, self.heading, "correct it, or leave it out")
        dimensions = (2, 3) if self.rows == 1 and not self.turns else (2,)
        if len(self.states) not in dimensions:
            rule = f"must be {' or '.join(map(str, dimensions))} for this sensor"
            raise ScenarioError("states", rule, list(self.states), "name those of the position")
        shape = np.shape(self.positions)
        places, which = self.places, "of nodes"
        if self.record is not None and self.record.has_anchors:
            which = f"anchor in {self.record.path.name}: {', '.join(map(str, places))}"
        if not isinstance(self.positions, str) and shape != (len(places), len(self.states)):
            rule = f"must be {len(places)} rows of {len(self.states)}, one for each {which}"
            remedy = "add or remove some"
            if self.record is not None and not self.record.has_anchors:
                remedy += f", or name what was seen in a column to of {self.record.path.name}"
            raise ScenarioError("positions", rule, f"{shape[0]} x {shape[1]}", remedy)
        if self.R.shape != (self.rows, self.rows):
            rule = f"must be {self.rows} x {self.rows}"
            raise ScenarioError("R", rule, self.R, "correct the shape")

    def support(self, n: int, node: int) -> np.ndarray:
        """Return the entries (k,) of the state that readings depend on: position and heading."""
        return np.unique([*self.states, *(() if self.heading is None else (self.heading,))])

    def offset(self, x: FloatArray, node: int) -> FloatArray:
        """Return the position (d,) of the target in the state x (n,) relative to ``node`` (id);
        with a ``heading``, that of the node relative to the target.
        """
        positions = np.asarray(self.positions, dtype=np.float64)
        d = x[list(self.states)] - positions[self.places.index(node)]
        return np.asarray(d if self.heading is None else -d)

    def offset_gradient(self, n: int, node: int) -> FloatArray:
        """Return the derivative (d, n) of ``offset`` by a state of ``n`` components."""
        gradient = np.zeros((len(self.states), n))
        gradient[:, list(self.states)] = np.eye(len(self.states))
        return gradient if self.heading is None else -gradient

    def h(self, x: FloatArray, node: int) -> FloatArray:
        """Return length or angle (radians, in (-pi, pi], or from the heading) or both (p,) of the
        ``offset`` in the state x (n,) on ``node`` (id).
        """
        d = self.offset(x, node)
        angle = [math.atan2(d[1], d[0])] if self.turns else []
        reading = np.array([math.hypot(*d)] * (self.rows - self.turns) + angle)
        if self.heading is not None:
            reading[-1] -= x[self.heading]
        return reading

    def jacobian(self, x: FloatArray, node: int) -> FloatArray:
        """Return the Jacobian (p, n) at the state x (n,), on ``node`` (id): the unit vector
        ``d / |d|`` along the offset d, and ``[-d_2, d_1] / |d|^2``, or one of them, times the
        derivative of the offset; 0 where d is 0, and in the columns of other components.
        """
        d, jacobian = self.offset(x, node), np.zeros((self.rows, len(x)))
        length = math.hypot(*d)
        if length > 0.0:
            angle = [np.array([-d[1], d[0]]) / length / length] if self.turns else []
            rows = [d / length] * (self.rows - self.turns) + angle
            jacobian[:] = np.array(rows) @ self.offset_gradient(len(x), node)
        if self.heading is not None:
            jacobian[-1, self.heading] -= 1.0
        return jacobian

    def difference(self, y: FloatArray, expected: FloatArray) -> FloatArray:
        """Return ``y - expected`` (p,), with an angle wrapped to [-pi, pi)."""
        innovation = y - expected
        if self.turns:
            innovation[-1] = (innovation[-1] + math.pi) % (2.0 * math.pi) - math.pi
        return innovation


@dataclass(frozen=True, eq=False)
class RangeSensor(PositionedSensor):
    """``y = |p - q| + v``: the distance of a target at p from the node at q, in 2 or 3 dimensions.

    At distance 0, where h has no derivative, the Jacobian is 0: the reading has no effect.
    """

    rows: ClassVar[int] = 1


@dataclass(frozen=True, eq=False)
class BearingSensor(PositionedSensor):
    """``y = atan2(p_2 - q_2, p_1 - q_1) + v`` in radians: the direction from the node at q to a
    target at p. Innovations are wrapped to [-pi, pi).
    """

    rows: ClassVar[int] = 1
    turns: ClassVar[bool] = True


@dataclass(frozen=True, eq=False)
class RangeBearingSensor(PositionedSensor):
    """The distance and the direction of a target from a node; ``R`` (2, 2)."""

    rows: ClassVar[int] = 2
    turns: ClassVar[bool] = True
