"""Plants and sensors whose truth or readings come from tables, in both models of time.

The checks of a scenario call the methods ``require_...``, which raise, before a run starts, if the
table lacks a state that the run needs. Readings may be missing: a node whose table has no row for a
slot has no reading in that slot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

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
    source_file,
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
    require_start,
    slot_number,
    take_from_record,
)
from netkf.plants.sensors import Sensor
from netkf.plants.truth import TOLERANCE, RecordedTruth, demand_rows

Table = dict[int, FloatArray]
"""Recorded values by slot."""
NO_TIMES = np.empty(0)


@dataclass(frozen=True, eq=False)
class UnknownPlant(LinearPlant):
    """A plant in slots with unknown state.

    ``F``, ``Q``, ``mean`` and ``cov`` are the filters' model of it.
    """

    is_random: ClassVar[bool] = False
    truth_known: ClassVar[bool] = False

    def truth(self, random: np.random.Generator, frames: bool = False) -> RecordedPath:
        """Return a path of nan (n,) in all slots, without ``frames``; nothing is drawn from
        ``random``.
        """
        return RecordedPath({}, np.full(self.n, math.nan))


@dataclass(frozen=True, eq=False)
class RecordedPlant(LinearPlant):
    """The state is read from a table ``t,x0,x1,...``, one row a slot, t in seconds; ``F``, ``Q``,
    ``mean`` and ``cov`` are the filters' model of it.
    """

    is_random: ClassVar[bool] = False

    path: SourceFile = field(source_file)

    def __post_init__(self) -> None:
        """Check the fields and read the table; raises ScenarioError for a mistake in either."""
        super().__post_init__()
        _ = self.table  # a mistake in the file is found on construction

    @cached_property
    def table(self) -> Table:
        """The states (n,) by slot number; raises ScenarioError for a mistake in the file."""
        table, states = self._states
        rule = "there may be one row a slot, or equal ones"
        first = first_rows(table, self.row_keys, states.tolist(), rule)
        return {slot: states[row] for slot, row in first.items() if slot >= 0}

    @cached_property
    def _states(self) -> tuple[Columns, FloatArray]:
        """The columns of the file and the states (K, n) of its rows."""
        return _read_states(self.path, self.n)

    @cached_property
    def row_keys(self) -> list[int]:
        """The slot number of each row, in the order of the table; rows of one slot are equal."""
        columns = self._states[0]
        require_start(columns, np.arange(len(columns.lines)))
        return [slot_number(columns, row, self.period) for row in range(len(columns.lines))]

    def require_slots(self, slots: Iterable[int]) -> None:
        """Raise ScenarioError if the table has no state for one of the ``slots`` (numbers)."""
        _demand_rows(self.path, self.table, slots, self.period, "state")

    def truth(self, random: np.random.Generator, frames: bool = False) -> RecordedPath:
        """Return the states of the table, nan in slots without a row; nothing is drawn from
        ``random``, and a recorded path has no ``frames``.
        """
        return RecordedPath(self.table, np.full(self.n, math.nan))


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
    """The state is read from a table ``t,x0,x1,...``, t in seconds, and exists at its rows only;
    ``A``, ``B``, ``mean`` and ``cov`` are the filters' model of it.
    """

    is_random: ClassVar[bool] = False

    path: SourceFile = field(source_file)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Check the fields and read the table; raises ScenarioError for a mistake in either."""
        super().__post_init__()
        _ = self.table  # a mistake in the file is found on construction

    @cached_property
    def table(self) -> tuple[FloatArray, FloatArray]:
        """Increasing times (K,) in seconds and states (K, n); raises ScenarioError for two states
        at one time.
        """
        table, states = self._states
        rule = "there may be one row a time, or equal ones"
        first = first_rows(table, self.row_keys, states.tolist(), rule)
        rows = [first[key] for key in range(len(first))]
        return table["t"][rows], states[rows]

    @cached_property
    def _states(self) -> tuple[Columns, FloatArray]:
        """The columns of the file and the states (K, n) of its rows."""
        return _read_states(self.path, self.n)

    @cached_property
    def row_keys(self) -> list[int]:
        """The index of each row's time among all times of the table, in the order of the table;
        rows of one time, up to TOLERANCE seconds, are equal.
        """
        times = self._states[0]["t"]
        order = np.argsort(times, kind="stable")
        keys = np.zeros(len(order), dtype=np.int64)
        keys[order[1:]] = np.cumsum(np.diff(times[order]) > TOLERANCE)
        return [int(key) for key in keys]

    @property
    def recorded_truth(self) -> RecordedTruth:
        """The true state of a run as engines read it: that of the table, nan at other times."""
        return RecordedTruth(*self.table, self.n)

    def require_times(self, times: FloatArray, what: str) -> None:
        """Raise ScenarioError if the table has no state at one of the ``times`` (K,), in seconds.

        ``what`` names the use of the states in the message.
        """
        demand_rows(self.path, self.table[0], times, what)


def _read_states(source: SourceFile, n: int) -> tuple[Columns, FloatArray]:
    """Return the columns of a table ``t,x0,x1,...``, and the states (K, n) of its rows."""
    names = [f"x{k}" for k in range(n)]
    table = read_columns(source, ("t", *names))
    return table, np.stack([table[name] for name in names], axis=1)


class RecordedPath:
    """The truth of a run from a table: states (n,) by slot number, ``otherwise`` (n,) in slots that
    it lacks.
    """

    frame_slots: int | None = None

    def __init__(self, states: Table, otherwise: FloatArray) -> None:
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
    what a row has beyond its own p must be empty, nan or 0.
    """

    is_random: ClassVar[bool] = False

    path: SourceFile = field(source_file)
    H: FloatArray = field(matrix, default=None)
    R: FloatArray = field(definite_covariance, default=None)
    nodes: tuple[int, ...] = field(list_of(node_id(), "node ids"), default=None)

    def __post_init__(self) -> None:
        """Take nodes, H and R from the table where they are not given; raise ScenarioError if H or
        R is missing or the file has a mistake.
        """
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
        return bool(self.record.regressors) or not all(is_uniform)

    def _matrix_function(self, node: int) -> Matrix:
        """Return the function that gives H (p', n) of the values of row k of ``node`` (id) that are
        there.
        """
        rows = self.record.rows(node)
        phi = rows.phi if self.record.regressors else None
        return lambda k, present: self.H[present] if phi is None else phi[k : k + 1]

    def sample_times(
        self,
        node: int,
        ordinal: int,
        generator: Callable[[str], np.random.Generator],
        horizon: float,
    ) -> FloatArray:
        """Return the times (K,) in seconds of the table's rows of ``node`` (id), below the
        ``horizon``, whatever its ``ordinal``; nothing is drawn from ``generator``.
        """
        return self.record.times(node, horizon)

    def samples(
        self, node: int, generator: Callable[[str], np.random.Generator], horizon: float
    ) -> RecordedSamples:
        """Return the samples of the table's rows of ``node`` (id), also those beyond the
        ``horizon``; nothing is drawn from ``generator``.
        """
        return RecordedSamples(self.record.rows(node), self._matrix_function(node))

    def slot_path(
        self, node: int, period: float, generator: Callable[[str], np.random.Generator]
    ) -> RecordedReadings:
        """Return the readings of the table's rows of ``node`` (id) in slots of ``period`` seconds;
        nothing is drawn from ``generator``.
        """
        record = self.record
        rows, slots, n = record.rows(node), record.slots(node, period), self.H.shape[1]
        return RecordedReadings(rows, slots, self._matrix_function(node), n)


def _demand_rows(
    source: SourceFile, table: Table, slots: Iterable[int], period: float, what: str
) -> None:
    """Raise ScenarioError if one of the ``slots`` has no row in ``table``, read from ``source``;
    ``what`` names its content and ``period`` (seconds) turns a slot into a time in the message.
    """
    missing = next((slot for slot in slots if slot not in table), None)
    if missing is not None:
        rule = f"{source.name} has no {what} for slot {missing}, t = {missing * period:g}"
        raise ScenarioError("path", rule, None, "add the row or shorten the horizon")
