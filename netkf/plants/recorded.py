"""Plants and sensors whose truth or readings come from tables, in both models of time.

The checks of a scenario call methods ``require_...`` of states (``states``), which raise, before a
run starts, if the table lacks one that the run needs. Readings may be missing: a node whose table
has no row for a slot has no reading in that slot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    SourceFile,
    definite_covariance,
    field,
    list_of,
    matrix,
    node_id,
    source_file,
    text,
)
from netkf.linalg.arrays import FloatArray, readonly_array
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.readings import (
    Matrix,
    ReadingTable,
    RecordedReadings,
    RecordedSamples,
    take_from_record,
)
from netkf.plants.sensors import Sensor
from netkf.plants.states import RecordedStates, state_file
from netkf.rng.streams import Generators


@dataclass(frozen=True, eq=False)
class UnknownPlant(LinearPlant):
    """A plant in slots with unknown state.

    ``F``, ``Q``, ``mean`` and ``cov`` are the filters' model of it.
    """

    is_random: ClassVar[bool] = False
    truth_known: ClassVar[bool] = False


@dataclass(frozen=True, eq=False)
class RecordedPlant(RecordedStates, LinearPlant):
    """The state is read from a table ``t,x0,x1,...``, one row a slot, t in seconds; ``F``, ``Q``,
    ``mean`` and ``cov`` are the filters' model of it.

    With ``interpolate`` rows have any times, and the state of a slot is that at its start, between
    two rows "linear", or the earlier one ("hold").
    """

    path: SourceFile = field(state_file)


@dataclass(frozen=True, eq=False)
class UnknownDiffusion(Diffusion):
    """A plant in continuous time with unknown state; ``A``, ``B``, ``mean`` and ``cov`` are the
    filters' model of it.
    """

    is_random: ClassVar[bool] = False
    truth_known: ClassVar[bool] = False


@dataclass(frozen=True, eq=False)
class RecordedDiffusion(RecordedStates, Diffusion):
    """The state is read from a table ``t,x0,x1,...``, t in seconds, and exists at its rows only, or
    with ``interpolate`` between them too: "linear", or the last one ("hold"); ``A``, ``B``,
    ``mean`` and ``cov`` are the filters' model of it.
    """

    path: SourceFile = field(state_file)  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class RecordedSensor(Sensor):
    """Readings from a table ``t,node,y0,...``: in slots those of slots, over a diffusion samples
    ``y = H x + v`` at the node's own times. Rows of one node at one time are used together; values
    that are empty or nan are missing, and their rows of H and R with them.

    ``H`` (p, n) and ``R`` (p, p) are what the filters take them to be. With columns ``R0, ...``
    (the diagonal) or ``R00, R01, ...`` (the upper triangle) rows bring their own noise, and ``R``
    may be left out; where all noises of a row are empty, ``R`` counts. A table with columns
    ``phi0,...`` (one for each state, p = 1) holds the H of every reading; ``H`` may then be left
    out, and is ignored if it is given. ``nodes`` are by default all that the table lists; rows of
    other nodes may be there for other ``[[sensors]]``, which may have more or fewer components:
    what a row has beyond its own p must be empty, nan or 0. With ``[[plants]]``, ``of`` names the
    block that H multiplies.
    """

    is_random: ClassVar[bool] = False
    _pairs: ClassVar[Mapping[int, FloatArray]] = MappingProxyType({})

    path: SourceFile = field(source_file)
    H: FloatArray = field(matrix, default=None)
    R: FloatArray = field(definite_covariance, default=None)
    nodes: tuple[int, ...] = field(list_of(node_id(), "node ids"), default=None)
    of: str | None = field(text, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        take_from_record(self, self.record)
        record, H = self.record, self.H
        for node in self.nodes:
            rows = record.rows(node)  # a mistake in the file is found on construction
            # The first phi' stands for H where one is needed at once.
            if record.regressors and len(rows.t) and H is self.H:
                object.__setattr__(self, "H", readonly_array(rows.phi[:1]))
        given: FloatArray | None = self.H
        if given is None and record.regressors:
            # No rows, or names of nodes that are not known yet.
            given = readonly_array(np.zeros((1, record.regressors)))
            object.__setattr__(self, "H", given)
        if given is None:
            remedy = "add H = ..., or columns phi0, ... to the table"
            raise ScenarioError("H", "is missing", None, remedy)

    @classmethod
    def of_pairs(cls, sensor: Any, node: int, matrices: Mapping[int, FloatArray]) -> RecordedSensor:
        """Return the sensor of ``node`` (id) whose rows, those of the table of a relative
        ``sensor``, have the H (p, n) of ``matrices`` for the node in their column ``to``.
        """
        new = object.__new__(cls)
        H = next(iter(matrices.values()))
        values = {"path": sensor.path, "H": H, "R": sensor.R, "nodes": (node,), "of": None}
        for name, value in (*values.items(), ("_pairs", matrices), ("record", sensor.record)):
            object.__setattr__(new, name, value)
        return new

    @cached_property
    def record(self) -> ReadingTable:
        """The table of the readings."""
        given: tuple[FloatArray | None, FloatArray | None] = self.H, self.R
        H, R = given
        return ReadingTable(self.path, 1 if H is None else len(H), R, linear=True)

    @property
    def varying(self) -> bool:
        """True if the table has columns phi0, ... or R0, ..., or if values are missing."""
        is_uniform = (self.record.rows(node).is_uniform for node in self.nodes)
        has_own_H = bool(self.record.regressors) or len(self._pairs) > 1
        return has_own_H or not all(is_uniform)

    def _matrix_function(self, node: int) -> Matrix:
        """Return the function that gives H (p', n) of the values of row k of ``node``."""
        rows = self.record.rows(node)
        if self._pairs:
            return lambda k, present: self._pairs[int(rows.anchors[k])][present]
        phi = rows.phi if self.record.regressors else None
        return lambda k, present: self.H[present] if phi is None else phi[k : k + 1]

    def sample_times(
        self, node: int, ordinal: int, generator: Generators, horizon: float
    ) -> FloatArray:
        """Return the times (K,) in seconds, below the ``horizon``, of the rows of ``node`` (id)."""
        return self.record.times(node, horizon)

    def samples(self, node: int, generator: Generators, horizon: float) -> RecordedSamples:
        """Return the samples of the table's rows of ``node`` (id); nothing is drawn."""
        return RecordedSamples(self.record.rows(node), self._matrix_function(node))

    def slot_path(self, node: int, period: float, generator: Generators) -> RecordedReadings:
        """Return the readings of the table's rows of ``node`` (id) in slots; nothing is drawn."""
        record = self.record
        rows, slots, n = record.rows(node), record.slots(node, period), self.H.shape[1]
        return RecordedReadings(rows, slots, self._matrix_function(node), n)
