"""Sensors of a pair of nodes: what one of them reads of the other's block relative to its own.

They mean something with ``[[plants]]`` only. A scenario replaces each by ordinary sensors of the
stacked state, one for each pair, or one for each node where readings are recorded
(``scenario.block_sensors``).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from netkf.core.clock import Clock
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    SourceFile,
    definite_covariance,
    either,
    field,
    has_depth,
    list_of,
    matrix,
    node_id,
    one_of,
    source_file,
    text,
    tuple_of,
)
from netkf.core.places import Place
from netkf.linalg.arrays import FloatArray
from netkf.plants.blocks import Layout
from netkf.plants.nonlinear import (
    BearingSensor,
    NonlinearSensor,
    PositionedSensor,
    RangeBearingSensor,
    RangeSensor,
)
from netkf.plants.readings import ReadingTable, take_from_record
from netkf.plants.recorded import RecordedSensor
from netkf.plants.sampling import sampling
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.rng.streams import Generators

NEIGHBOURS = "neighbours"
_pair = tuple_of(node_id(), node_id(), description="a pair of node ids")
_targets = either(one_of(NEIGHBOURS), list_of(_pair, "pairs of node ids"), has_depth(1))


@dataclass(frozen=True, eq=False)
class RelativeSensor(Sensor):
    """``y = H (x_j - x_i) + v``, cov(v) = R: node i reads the block of node j relative to its own,
    in every slot, or whenever the clock ``sampling`` ticks.

    H      (p, n) of the block; by default it reads all components
    R      (p, p)
    of     the name of the block, which both nodes own
    to     which nodes are read: "neighbours" in the graph, the default, or pairs
           [[reader, other], ...]
    nodes  the nodes that read; by default all that own the block, or all that pairs name first
    path   a table ``t,node,to,y0,...`` of recorded readings, as that of a recorded sensor; ``to``
           and the clock then come from it
    """

    R: FloatArray = field(definite_covariance, default=None)
    H: FloatArray | None = field(matrix, default=None)
    of: str | None = field(text, default=None)
    to: str | tuple[tuple[int, int], ...] = field(_targets, default=NEIGHBOURS)
    nodes: tuple[int, ...] = field(list_of(node_id(), "node ids"), default=None)
    sampling: Clock | None = field(sampling, default=None)
    path: SourceFile | None = field(source_file, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_relative(self)

    @property
    def is_random(self) -> bool:  # type: ignore[override]
        """True if runs draw the readings, False if they are recorded."""
        return self.path is None

    @cached_property
    def record(self) -> ReadingTable | None:
        """The table of its readings; None if they are drawn."""
        if self.path is None:
            return None
        given: FloatArray | None = self.R
        p = len(self.H) if self.H is not None else len(given) if given is not None else 1
        return ReadingTable(self.path, p, given, linear=False)

    def matrix_of(self, n: int) -> FloatArray:
        """Return H (p, n) of a block of n components."""
        return np.eye(n) if self.H is None else self.H

    def slot_path(self, node: int, period: float, generator: Generators) -> Any:
        """Raise TypeError: scenarios replace the sensor before a run."""
        raise TypeError("a relative sensor reads blocks of [[plants]]")

    def of_pair(self, own: Place, other: Place) -> FloatArray:
        """Return the matrix (p, n) of the two blocks, ``own`` first."""
        H = self.matrix_of(own.n)
        if H.shape[1] != own.n or other.n != own.n:
            rule = f"must have {own.n} columns, because block {own.name!r} has {own.n} components"
            raise ScenarioError("H", rule, H, "correct it")
        if self.R.shape != (len(H), len(H)):
            rule = f"must be {len(H)} x {len(H)}, because H has {len(H)} rows"
            raise ScenarioError("R", rule, self.R, "correct it")
        return H

    def lowered(
        self, layout: Layout, pairs: Sequence[tuple[Place, Place]]
    ) -> list[LinearSensor | RecordedSensor]:
        """Return the sensors of the stacked state that stand for it, of ``pairs`` of blocks, that
        of the reader first.
        """
        matrices = {
            (own.node, other.node): layout.embed([(own, -H), (other, H)])
            for own, other in pairs
            if own.node is not None and other.node is not None
            for H in [self.of_pair(own, other)]
        }
        if self.record is None:
            return [
                LinearSensor(nodes=(own,), H=H, R=self.R, sampling=self.sampling)
                for (own, _), H in matrices.items()
            ]
        readers = dict.fromkeys(own for own, _ in matrices)
        return [
            RecordedSensor.of_pairs(
                self, own, {other: H for (i, other), H in matrices.items() if i == own}
            )
            for own in readers
        ]


def check_relative(sensor: Any) -> None:
    """Raise ScenarioError where keys of a relative sensor exclude each other or are missing."""
    if sensor.record is None:
        if sensor.R is None:
            raise ScenarioError("R", "is missing", None, "add R = ...")
        return
    for name, default in (("sampling", None), ("to", NEIGHBOURS)):
        if getattr(sensor, name) != default:
            rule = "means nothing with path: the table says it"
            raise ScenarioError(name, rule, None, "leave it out")
    if not sensor.record.has_anchors:
        rule = f"{sensor.path.name} must have a column to, the node that is read"
        raise ScenarioError("path", rule, None, "add it")
    take_from_record(sensor, sensor.record)
    for node in sensor.nodes:
        sensor.record.rows(node)  # a mistake in the file is found on construction


@dataclass(frozen=True, eq=False)
class RelativePositionSensor(PositionedSensor):
    """A sensor of the position in another node's block relative to that in the node's own.

    of       the name of the block, which both nodes own
    to       which nodes are read: "neighbours" in the graph, the default, or pairs
             [[reader, other], ...]
    nodes    the nodes that read; by default all that own the block, or all that pairs name first
    states   which components of the block are the position
    heading  the component of the own block from which directions are measured, if there is one
    path     a table ``t,node,to,y0,...`` of recorded readings
    """

    to: str | tuple[tuple[int, int], ...] = field(_targets, default=NEIGHBOURS)

    _others: ClassVar[Mapping[int, tuple[int, ...]] | None] = None

    def __post_init__(self) -> None:
        NonlinearSensor.__post_init__(self)
        if not isinstance(self.positions, str):
            rule, remedy = "mean nothing for relative readings", "leave them out"
            raise ScenarioError("positions", rule, None, remedy)
        check_relative(self)

    def lowered(
        self, layout: Layout, pairs: Sequence[tuple[Place, Place]]
    ) -> list[RelativePositionSensor]:
        """Return the stacked state's sensors that stand for it, of ``pairs``, the reader first."""
        self.check_block(pairs[0][0].n)
        places: dict[int | None, list[tuple[Place, Place]]] = {}
        for own, other in pairs:
            places.setdefault(own.node, []).append((own, other))
        groups = [[pair] for pair in pairs] if self.record is None else list(places.values())
        return [self._of_pairs(group) for group in groups]

    def check_block(self, n: int) -> None:
        """Raise ScenarioError if states, heading or R do not fit a block of ``n`` components."""
        whole = copy.copy(self)
        object.__setattr__(whole, "nodes", self.nodes or (0,))
        object.__setattr__(whole, "positions", np.zeros((len(whole.places), len(self.states))))
        PositionedSensor.check_state(whole, n)

    def _of_pairs(self, group: list[tuple[Place, Place]]) -> RelativePositionSensor:
        own, sensor = group[0][0], copy.copy(self)
        values = {
            "nodes": (own.node,),
            "states": tuple(own.first + s for s in self.states),
            "heading": None if self.heading is None else own.first + self.heading,
            "_others": {
                other.node: tuple(other.first + s for s in self.states) for _, other in group
            },
        }
        for name, value in values.items():
            object.__setattr__(sensor, name, value)
        return sensor

    def check_state(self, n: int) -> None:
        """Accept the state: ``check_block`` has been called."""

    def located(self, positions: Any) -> RelativePositionSensor:
        """Return the sensor: it needs no positions."""
        return self

    def other_states(self, node: int) -> tuple[int, ...]:
        """Return which components of the stacked state are the position of the other, whose id is
        ``node`` where readings are recorded.
        """
        others = self._others
        assert others is not None
        return others[node] if node in others else next(iter(others.values()))

    def support(self, n: int, node: int) -> np.ndarray:
        """Return the entries (k,) of the state of both blocks that readings depend on."""
        return np.union1d(super().support(n, node), self.other_states(node))

    def offset(self, x: FloatArray, node: int) -> FloatArray:
        """Return the other's position (d,) relative to the own one in the stacked state x (n,);
        ``node`` is the id of the other where readings are recorded.
        """
        return np.asarray(x[list(self.other_states(node))] - x[list(self.states)])

    def offset_gradient(self, n: int, node: int) -> FloatArray:
        """Return the derivative (d, n) of ``offset`` by a stacked state of ``n`` components."""
        gradient, eye = np.zeros((len(self.states), n)), np.eye(len(self.states))
        gradient[:, list(self.states)] = -eye
        gradient[:, list(self.other_states(node))] = eye
        return gradient


@dataclass(frozen=True, eq=False)
class RelativeRangeSensor(RelativePositionSensor, RangeSensor):
    """``y = |p_j - p_i| + v``: the distance of node j from node i, in 2 or 3 dimensions."""


@dataclass(frozen=True, eq=False)
class RelativeBearingSensor(RelativePositionSensor, BearingSensor):
    """The direction of node j from node i in radians, from the heading of i if it has one."""


@dataclass(frozen=True, eq=False)
class RelativeRangeBearingSensor(RelativePositionSensor, RangeBearingSensor):
    """The distance and the direction of node j from node i; ``R`` (2, 2)."""
