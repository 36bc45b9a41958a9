"""Plants and sensors whose truth or readings come from tables, in both models of time.

The checks of a scenario call the methods ``require_...``, which raise, before a run starts, if the
table lacks a state that the run needs. Readings may be missing: a node whose table has no row for a
slot has no reading in that slot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from netkf.core.csv_files import Columns, read_columns
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    SourceFile,
    definite_covariance,
    field,
    list_of,
    matrix,
    node_id,
    one_of,
    source_file,
    text,
)
from netkf.core.repeated_rows import first_rows
from netkf.linalg.arrays import FloatArray, readonly_array
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.readings import (
    Matrix,
    ReadingTable,
    RecordedReadings,
    RecordedSamples,
    slot_number,
    take_from_record,
)
from netkf.plants.sensors import Sensor
from netkf.plants.truth import TOLERANCE, RecordedTruth, demand_states

INTERPOLATIONS = ("linear", "hold")
"""What recorded states are between the rows of their table."""
NO_TIMES = np.empty(0)


@dataclass(frozen=True, eq=False)
class UnknownPlant(LinearPlant):
    """A plant in slots with unknown state.

    ``F``, ``Q``, ``mean`` and ``cov`` are the filters' model of it.
    """

    is_random: ClassVar[bool] = False
    truth_known: ClassVar[bool] = False

    def truth(self, random: np.random.Generator, frames: bool = False) -> RecordedPath:
        """Return a path of nan (n,) in all slots; nothing is drawn from ``random``."""
        return RecordedPath({}, np.full(self.n, math.nan))


@dataclass(frozen=True, eq=False)
class RecordedPlant(LinearPlant):
    """The state is read from a table ``t,x0,x1,...``, one row a slot, t in seconds; ``F``, ``Q``,
    ``mean`` and ``cov`` are the filters' model of it.

    With ``interpolate`` rows have any times, and the state of a slot is that at its start, between
    two rows "linear", or the earlier one ("hold").
    """

    is_random: ClassVar[bool] = False

    path: SourceFile = field(source_file)
    interpolate: str | None = field(one_of(*INTERPOLATIONS), default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.table  # a mistake in the file is found on construction

    @cached_property
    def table(self) -> SlotStates:
        """The states (n,) by slot number; raises ScenarioError for a mistake in the file."""
        if self.interpolate is not None:
            truth = _recorded_truth(*self._states, self.n, self.interpolate)
            return InterpolatedStates(truth, self.period)
        columns, states = self._states
        rule = "there may be one row a slot, or equal ones"
        first = first_rows(columns, self._slots, states.tolist(), rule)
        return {slot: states[row] for slot, row in first.items() if slot >= 0}

    @cached_property
    def _states(self) -> tuple[Columns, FloatArray]:
        return _read_states(self.path, self.n)

    @cached_property
    def _slots(self) -> list[int]:
        """The slot number of each row, in the order of the table; rows of one slot are equal."""
        columns = self._states[0]
        columns.refuse_early(np.flatnonzero(columns["t"] < 0.0), "t must be at least 0")
        return [slot_number(columns, row, self.period) for row in range(len(columns.lines))]

    @property
    def row_times(self) -> FloatArray:
        """The times (K,) of all rows in seconds, in the order of the table."""
        return self._states[0]["t"]

    @property
    def row_keys(self) -> list[int]:
        """The subject of each row, in the order of the table: its slot or, with ``interpolate``,
        its place among the times of the table.
        """
        return self._slots if self.interpolate is None else _time_keys(self.row_times)

    def used_keys(self, slots: Iterable[int]) -> set[int]:
        """Return the ``row_keys`` of the rows that say the states of these ``slots``."""
        if not isinstance(self.table, InterpolatedStates):
            return set(slots)
        return {key for slot in slots for key in self.table.rows_at(slot)}

    def require_slots(self, slots: Iterable[int]) -> None:
        """Raise ScenarioError if the table has no state for one of the ``slots`` (numbers)."""
        missing = next((slot for slot in slots if slot not in self.table), None)
        if missing is not None:
            time = f"slot {missing}, t = {missing * self.period:g}"
            remedy = "add the row or shorten the horizon"
            if self.interpolate is None:
                remedy = 'add the row, or write interpolate = "linear" or "hold"'
            rule = f"{self.path.name} has no state for {time}"
            raise ScenarioError("path", rule, None, remedy)

    def truth(self, random: np.random.Generator, frames: bool = False) -> RecordedPath:
        """Return the states of the table, nan in slots without one; ``random`` is not used."""
        return RecordedPath(self.table, np.full(self.n, math.nan))


class InterpolatedStates:
    """The states of slots of ``period`` seconds in the ``truth`` of a table with rows at any
    times.
    """

    def __init__(self, truth: RecordedTruth, period: float) -> None:
        self._truth, self._period = truth, period

    def rows_at(self, slot: int) -> tuple[int, ...]:
        """Return the indices of the times of the table that say the state of a slot."""
        return self._truth.rows_at(slot * self._period)

    def __contains__(self, slot: int) -> bool:
        return bool(self.rows_at(slot))

    def get(self, slot: int, otherwise: FloatArray) -> FloatArray:
        """Return the state (n,) of a slot, ``otherwise`` (n,) if it is unknown."""
        return self._truth.local(slot * self._period) if slot in self else otherwise


@dataclass(frozen=True, eq=False)
class UnknownDiffusion(Diffusion):
    """A plant in continuous time with unknown state; ``A``, ``B``, ``mean`` and ``cov`` are the
    filters' model of it.
    """

    is_random: ClassVar[bool] = False
    truth_known: ClassVar[bool] = False

    @property
    def recorded_truth(self) -> RecordedTruth:
        """The true state of a run as engines read it: nan at all times."""
        return RecordedTruth(NO_TIMES, np.empty((0, self.n)), self.n)

    def require_times(self, times: FloatArray, what: str) -> None:
        """Accept any ``times`` (K,) and any use ``what``: no state is known, so none is missing."""


@dataclass(frozen=True, eq=False)
class RecordedDiffusion(Diffusion):
    """The state is read from a table ``t,x0,x1,...``, t in seconds, and exists at its rows only, or
    with ``interpolate`` between them too: "linear", or the last one ("hold"); ``A``, ``B``,
    ``mean`` and ``cov`` are the filters' model of it.
    """

    is_random: ClassVar[bool] = False

    path: SourceFile = field(source_file)  # type: ignore[assignment]
    interpolate: str | None = field(one_of(*INTERPOLATIONS), default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.recorded_truth  # a mistake in the file is found on construction

    @cached_property
    def recorded_truth(self) -> RecordedTruth:
        """The true state as engines read it; raises ScenarioError for two states at one time."""
        return _recorded_truth(*self._states, self.n, self.interpolate)

    @cached_property
    def _states(self) -> tuple[Columns, FloatArray]:
        return _read_states(self.path, self.n)

    @property
    def row_times(self) -> FloatArray:
        """The times (K,) of all rows in seconds, in the order of the table."""
        return self._states[0]["t"]

    @property
    def row_keys(self) -> list[int]:
        """The place of each row's time among all times of the table, in the order of the table."""
        return _time_keys(self.row_times)

    def used_keys(self, times: FloatArray) -> set[int]:
        """Return the ``row_keys`` of the rows that say the states at ``times`` (K,) in seconds."""
        return {key for time in times.tolist() for key in self.recorded_truth.rows_at(time)}

    def require_times(self, times: FloatArray, what: str) -> None:
        """Raise ScenarioError if a state is missing at ``times`` (K,), for the use ``what``."""
        demand_states(self.path, self.recorded_truth, times, what)


def _time_keys(times: FloatArray) -> list[int]:
    """Return the index of each time among all that differ by more than TOLERANCE."""
    order = np.argsort(times, kind="stable")
    keys = np.zeros(len(order), dtype=np.int64)
    keys[order[1:]] = np.cumsum(np.diff(times[order]) > TOLERANCE)
    return [int(key) for key in keys]


def _recorded_truth(
    columns: Columns, states: FloatArray, n: int, interpolate: str | None
) -> RecordedTruth:
    """Return the truth of a table with ``states`` (K, n) at the times "t" of its ``columns``."""
    rule = "there may be one row a time, or equal ones"
    first = first_rows(columns, _time_keys(columns["t"]), states.tolist(), rule)
    rows = [first[key] for key in range(len(first))]
    return RecordedTruth(columns["t"][rows], states[rows], n, interpolate)


def _read_states(source: SourceFile, n: int) -> tuple[Columns, FloatArray]:
    """Return the columns of a table ``t,x0,x1,...``, and the states (K, n) of its rows."""
    names = [f"x{k}" for k in range(n)]
    table = read_columns(source, ("t", *names))
    return table, np.stack([table[name] for name in names], axis=1)


SlotStates = dict[int, FloatArray] | InterpolatedStates
"""Recorded states by slot."""


class RecordedPath:
    """The truth of a run from a table: states (n,) by slot number, ``otherwise`` (n,) in slots that
    it lacks.
    """

    frame_slots: int | None = None

    def __init__(self, states: SlotStates, otherwise: FloatArray) -> None:
        self._states, self._otherwise = states, otherwise

    def state(self, slot: int) -> FloatArray:
        """Return the state (n,) in slot number ``slot``."""
        return self._states.get(slot, self._otherwise)

    local = absolute = state

    def rebase(self, slot: int) -> FloatArray:
        """Raise IndexError: a recorded path has no frames, so that none begins at ``slot``."""
        raise IndexError(slot)


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
        self,
        node: int,
        ordinal: int,
        generator: Callable[[str], np.random.Generator],
        horizon: float,
    ) -> FloatArray:
        """Return the times (K,) in seconds, below the ``horizon``, of the rows of ``node`` (id)."""
        return self.record.times(node, horizon)

    def samples(
        self, node: int, generator: Callable[[str], np.random.Generator], horizon: float
    ) -> RecordedSamples:
        """Return the samples of the table's rows of ``node`` (id); nothing is drawn."""
        return RecordedSamples(self.record.rows(node), self._matrix_function(node))

    def slot_path(
        self, node: int, period: float, generator: Callable[[str], np.random.Generator]
    ) -> RecordedReadings:
        """Return the readings of the table's rows of ``node`` (id) in slots; nothing is drawn."""
        record = self.record
        rows, slots, n = record.rows(node), record.slots(node, period), self.H.shape[1]
        return RecordedReadings(rows, slots, self._matrix_function(node), n)
