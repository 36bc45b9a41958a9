"""True states from tables: of plants, and of blocks each of whose nodes has rows of its own.

A row ``t,x0,x1,...`` is the state at one time. With a column ``node`` it is that of the block of
this node, and each of ``[[plants]]`` with nodes takes its own rows.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from netkf.core.csv_files import Columns, read_columns
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile, field, one_of, source_file
from netkf.core.repeated_rows import RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray
from netkf.plants.dynamics import headings_of
from netkf.plants.plant import Plant
from netkf.plants.readings import slot_number
from netkf.plants.truth import TOLERANCE, RecordedTruth, demand_states

INTERPOLATIONS = ("linear", "hold")
"""What recorded states are between the rows of their table."""
TURN = 2.0 * math.pi


class StateTable:
    """The states of the rows of a table, as a plant takes them, of whose states ``headings`` are
    angles: these count whole turns on, from the one that is nearest to the plant's mean at 0.
    """

    def __init__(self, plant: RecordedStates, columns: Columns) -> None:
        self.columns = columns
        self._mean, self._headings = plant.start_mean, plant.headings
        self._interpolate, self._n = plant.interpolate, plant.n
        names = [f"x{k}" for k in range(plant.n)]
        self._states = np.stack([columns[name] for name in names], axis=1)

    @cached_property
    def truth(self) -> RecordedTruth:
        """The true state as engines read it; raises ScenarioError for two states at one time."""
        first = self._first(self.row_keys(None), "there may be one row a time, or equal ones")
        times, states = self._ordered([first[key] for key in range(len(first))])
        return RecordedTruth(times, states, self._n, self._interpolate)

    def slots(self, period: float) -> SlotStates:
        """Return the states (n,) by number of the slot of ``period`` seconds; raises ScenarioError
        for a mistake in the file.
        """
        if self._interpolate is not None:
            return InterpolatedStates(self.truth, period)
        first = self._first(self.row_keys(period), "there may be one row a slot, or equal ones")
        numbers = sorted(slot for slot in first if slot >= 0)
        _, states = self._ordered([first[slot] for slot in numbers])
        return dict(zip(numbers, states, strict=True))

    def _first(self, keys: list[int], rule: str) -> dict[int, int]:
        return first_rows(self.columns, keys, self._states.tolist(), rule)

    def _ordered(self, rows: list[int]) -> tuple[FloatArray, FloatArray]:
        """Return times (K,) and states (K, n) of ``rows``, with headings that count whole turns."""
        times, states = self.columns["t"][rows], self._states[rows]
        for entry in self._headings if len(rows) else ():
            states[:, entry] = np.unwrap(states[:, entry])
            start = states[int(np.argmin(np.abs(times))), entry]
            states[:, entry] += TURN * np.round((self._mean[entry] - start) / TURN)
        return times, states

    def row_keys(self, period: float | None) -> list[int]:
        """Return the subject of each row, in the order of the table: its slot of ``period`` seconds
        or, with None or if states are interpolated, its place among the times of the table.
        """
        if period is None or self._interpolate is not None:
            times = self.columns["t"]
            order = np.argsort(times, kind="stable")
            keys = np.zeros(len(order), dtype=np.int64)
            keys[order[1:]] = np.cumsum(np.diff(times[order]) > TOLERANCE)
            return [int(key) for key in keys]
        columns = self.columns
        columns.refuse_early(np.flatnonzero(columns["t"] < 0.0), "t must be at least 0")
        return [slot_number(columns, row, period) for row in range(len(columns.lines))]

    def use(self, needed: Iterable[float], period: float | None) -> RowUse:
        """Return the use of the rows that say the states at the ``needed`` times in seconds, or in
        the needed slots of ``period`` seconds.
        """
        if period is not None and self._interpolate is None:
            used = {int(slot) for slot in needed}
        else:
            times = (time if period is None else time * period for time in needed)
            used = {key for time in times for key in self.truth.rows_at(time)}
        return count_rows(self.columns.source.name, self.row_keys(period), used.__contains__)

    def require_times(self, times: FloatArray, what: str) -> None:
        """Raise ScenarioError if a state is missing at ``times`` (K,), for the use ``what``."""
        demand_states(self.columns.source, self.truth, times, what)

    def require_slots(self, slots: Iterable[int], period: float) -> None:
        """Raise ScenarioError if the table has no state for one of the ``slots`` (numbers)."""
        states = self.slots(period)
        missing = next((slot for slot in slots if slot not in states), None)
        if missing is not None:
            remedy = "add the row or shorten the horizon"
            if self._interpolate is None:
                remedy = 'add the row, or write interpolate = "linear" or "hold"'
            time = f"slot {missing}, t = {missing * period:g}"
            rule = f"{self.columns.source.name} has no state for {time}"
            raise ScenarioError("path", rule, None, remedy)


class StackedStates:
    """The states of several blocks together, each from its own table."""

    def __init__(self, tables: Sequence[StateTable]) -> None:
        self._tables = tables

    @cached_property
    def truth(self) -> RecordedTruth:
        """The true state as engines read it."""
        return StackedTruth([table.truth for table in self._tables])

    def slots(self, period: float) -> SlotStates:
        """Return the states (n,) by number of the slot of ``period`` seconds."""
        return StackedSlots([table.slots(period) for table in self._tables])


class StackedTruth(RecordedTruth):
    """The states of several truths, one after the other; known where all of them are."""

    def __init__(self, parts: Sequence[RecordedTruth]) -> None:
        self._parts = parts
        times = np.unique(np.concatenate([part.times for part in parts]))
        n = sum(part.n for part in parts)
        super().__init__(times, np.empty((0, n)), n)

    def rows_at(self, time: float) -> tuple[int, ...]:
        """Return (0,) if all states are known at ``time`` (seconds), else nothing."""
        return (0,) if all(part.rows_at(time) for part in self._parts) else ()

    def local(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds); nan where it is unknown."""
        return np.concatenate([part.local(time) for part in self._parts])

    absolute = local


class InterpolatedStates:
    """The states of slots of ``period`` seconds in the ``truth`` of a table with rows at any
    times.
    """

    def __init__(self, truth: RecordedTruth, period: float) -> None:
        self._truth, self._period = truth, period

    def __contains__(self, slot: int) -> bool:
        return bool(self._truth.rows_at(slot * self._period))

    def get(self, slot: int, otherwise: FloatArray) -> FloatArray:
        """Return the state (n,) of a slot, ``otherwise`` (n,) if it is unknown."""
        return self._truth.local(slot * self._period) if slot in self else otherwise


class StackedSlots:
    """The states of slots of several tables, one after the other; known where all of them are."""

    def __init__(self, parts: Sequence[Any]) -> None:
        self._parts = parts

    def __contains__(self, slot: int) -> bool:
        return all(slot in part for part in self._parts)

    def get(self, slot: int, otherwise: FloatArray) -> FloatArray:
        """Return the state (n,) of a slot, ``otherwise`` (n,) if it is unknown."""
        if slot not in self:
            return otherwise
        return np.concatenate([part.get(slot, otherwise) for part in self._parts])


SlotStates = dict[int, FloatArray] | InterpolatedStates | StackedSlots
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


state_file = dataclasses.replace(
    source_file,
    convert=lambda value: value if isinstance(value, StackedStates) else source_file.convert(value),
)
"""A file of states, or the states of several."""


@dataclass(frozen=True, eq=False)
class RecordedStates(Plant):
    """A plant whose states are drawn or, with a ``path``, those of a table ``t,x0,x1,...``, t in
    seconds: then the plant is what filters assume. With ``interpolate`` states are known between
    rows too, "linear" or "hold", that of the last row. Rows of a column ``node`` are those of the
    blocks of nodes.
    """

    path: SourceFile | StackedStates | None = field(state_file, default=None)
    interpolate: str | None = field(one_of(*INTERPOLATIONS), default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is None and self.interpolate is not None:
            rule = "means nothing without path"
            raise ScenarioError("interpolate", rule, self.interpolate, "leave it out")
        if isinstance(self.path, SourceFile) and "node" not in self._columns:
            self._read_states()  # a mistake in the file is found on construction

    def read(self) -> None:
        """Raise ScenarioError for a mistake in its tables."""
        super().read()
        self._read_states()

    def _read_states(self) -> None:
        if self.record is not None:
            period = getattr(self, "period", None)
            _ = self.record.truth if period is None else self.record.slots(period)

    @property
    def headings(self) -> tuple[int, ...]:
        """Which states are angles, that tables may count from anywhere."""
        return headings_of(getattr(self, "f", None))

    @property
    def is_random(self) -> bool:  # type: ignore[override]
        """True if runs draw the states, False if they are recorded."""
        return self.path is None

    @cached_property
    def _columns(self) -> Columns:
        assert isinstance(self.path, SourceFile)
        names = [f"x{k}" for k in range(self.n)]
        return read_columns(self.path, ("t", *names), ("node",))

    @cached_property
    def record(self) -> Any:
        """The states, a StateTable or StackedStates; None if they are drawn."""
        if not isinstance(self.path, SourceFile):
            return self.path
        return StateTable(self, self._columns.of_node(self.node))

    @property
    def recorded_truth(self) -> RecordedTruth:
        """The recorded states as engines read them in continuous time."""
        truth: RecordedTruth = self.record.truth
        return truth
