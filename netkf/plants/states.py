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
from typing import Any, ClassVar

import numpy as np

from netkf.core.csv_files import Columns, read_columns
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile, field, one_of, source_file
from netkf.core.repeated_rows import RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray
from netkf.plants.dynamics import MOTIONS
from netkf.plants.plant import Plant
from netkf.plants.readings import slot_number
from netkf.plants.truth import TOLERANCE, RecordedTruth, WithoutFrames, demand_states

INTERPOLATIONS = ("linear", "hold")
"""What recorded states are between the rows of their table."""
TURN = 2.0 * math.pi


class StateTable:
    """The states of the rows of a table, as a plant takes them, of whose states ``headings`` are
    angles: these count whole turns on, from the one that is nearest to the plant's mean at 0.

    With a ``period`` of slots in seconds rows are those of slots, unless states are interpolated.
    """

    def __init__(self, plant: RecordedStates, columns: Columns) -> None:
        self.columns = columns
        self._mean, self._headings = plant.start_mean, plant.headings
        self._interpolate, self._n = plant.interpolate, plant.n
        slots = None if plant.interpolate else getattr(plant, "period", None)
        self._period: float | None = slots
        names = [f"x{k}" for k in range(plant.n)]
        self._states = np.stack([columns[name] for name in names], axis=1)

    @cached_property
    def truth(self) -> RecordedTruth:
        """The true state as engines read it; raises ScenarioError for two at one time or slot."""
        what = "time" if self._period is None else "slot"
        rule = f"there may be one row a {what}, or equal ones"
        first = first_rows(self.columns, self.row_keys, self._states.tolist(), rule)
        keys = sorted(first) if self._period is None else sorted(k for k in first if k >= 0)
        rows = [first[key] for key in keys]
        times, states = self.columns["t"][rows], self._states[rows]
        if self._period is not None:
            times = self._period * np.array(keys, dtype=np.float64)
        for entry in self._headings if rows else ():
            states[:, entry] = np.unwrap(states[:, entry])
            start = states[int(np.argmin(np.abs(times))), entry]
            states[:, entry] += TURN * np.round((self._mean[entry] - start) / TURN)
        return RecordedTruth(times, states, self._n, self._interpolate)

    @property
    def row_keys(self) -> list[int]:
        """The subject of each row, in order: its slot, or its place among the table's times."""
        columns = self.columns
        if self._period is None:
            order = np.argsort(columns["t"], kind="stable")
            keys = np.zeros(len(order), dtype=np.int64)
            keys[order[1:]] = np.cumsum(np.diff(columns["t"][order]) > TOLERANCE)
            return [int(key) for key in keys]
        columns.refuse_early(np.flatnonzero(columns["t"] < 0.0), "t must be at least 0")
        return [slot_number(columns, row, self._period) for row in range(len(columns.lines))]

    def use(self, times: Iterable[float]) -> RowUse:
        """Return the use of the rows that say the states at the ``times`` in seconds."""
        rows = {row for time in times for row in self.truth.rows_at(time)}
        if self._period is not None:
            rows = {round(float(self.truth.times[row]) / self._period) for row in rows}
        return count_rows(self.columns.source.name, self.row_keys, rows.__contains__)

    def require_times(self, times: FloatArray, what: str) -> None:
        """Raise ScenarioError if a state is missing at ``times`` (K,), for the use ``what``."""
        demand_states(self.columns.source, self.truth, times, what)


class StackedTruth(RecordedTruth):
    """The states of several truths, one after the other; 0 where there is no row or no table."""

    def __init__(self, parts: Sequence[RecordedTruth | None], sizes: Sequence[int]) -> None:
        self._parts = [
            RecordedTruth(np.empty(0), np.empty((0, n)), n) if part is None else part
            for part, n in zip(parts, sizes, strict=True)
        ]
        times = np.unique(np.concatenate([part.times for part in self._parts]))
        super().__init__(times, np.empty((0, sum(sizes))), sum(sizes))

    def local(self, time: float) -> FloatArray:
        """Return x (n,) at ``time`` (seconds)."""
        # What lacks a row then is read by nobody.
        return np.asarray(np.nan_to_num(np.concatenate([p.local(time) for p in self._parts])))

    absolute = local


class StackedStates:
    """The states of several blocks, each by its plant: from a table, drawn, or unknown.

    drawn, unknown : masks (n,) of entries
    """

    def __init__(self, plants: Sequence[Any]) -> None:
        sizes = [plant.n for plant in plants]
        self.drawn = np.repeat([plant.is_random for plant in plants], sizes)
        self.unknown = np.repeat([not plant.truth_known for plant in plants], sizes)
        tables = [plant.record for plant in plants]
        self.truth = StackedTruth([table and table.truth for table in tables], sizes)


class PartlyDrawnTruth(RecordedTruth):
    """The states of a plant whose blocks are drawn, recorded or unknown: those of a ``truth`` that
    was drawn for all of it, with the others in place. Instants are seconds, or slots of ``period``
    seconds; coordinates begin at the response ``believed``.
    """

    def __init__(
        self, truth: Any, states: StackedStates, believed: Any, period: float | None
    ) -> None:
        super().__init__(np.empty(0), np.empty((0, len(states.drawn))), len(states.drawn))
        self._truth, self._given, self._drawn = truth, states.truth, states.drawn
        self._believed, self._period = believed, period

    def absolute(self, time: Any) -> FloatArray:
        """Return x (n,) at ``time``."""
        given = self._given.local(time if self._period is None else time * self._period)
        return np.where(self._drawn, self._truth.absolute(time), given)

    state = absolute

    def local(self, time: Any) -> FloatArray:
        """Return x (n,) at ``time``, in the coordinates of the filters."""
        given = self.absolute(time)
        if self._believed is not None:
            given = given - self._believed.states(np.array([time]))[0]
        return np.where(self._drawn, self._truth.local(time), given)


class RecordedPath(WithoutFrames):
    """The states of slots of ``period`` seconds in a recorded ``truth``."""

    def __init__(self, truth: RecordedTruth, period: float) -> None:
        self._truth, self._period = truth, period

    def state(self, slot: int) -> FloatArray:
        """Return the state (n,) in slot number ``slot``; nan where it is unknown."""
        return self._truth.local(slot * self._period)

    local = absolute = state


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

    unknown: ClassVar[bool] = False
    """True if there are no states but those that filters assume."""

    path: SourceFile | StackedStates | None = field(state_file, default=None)
    interpolate: str | None = field(one_of(*INTERPOLATIONS), default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is None and self.interpolate is not None:
            rule = "means nothing without path"
            raise ScenarioError("interpolate", rule, self.interpolate, "leave it out")
        if self.path is not None and self.unknown:
            rule = "means nothing where the state is unknown"
            raise ScenarioError("path", rule, None, 'leave it out, or write kind = "recorded"')
        if isinstance(self.path, SourceFile) and "node" not in self._columns:
            _ = self.recorded_truth  # a mistake in the file is found on construction

    def read(self) -> None:
        """Raise ScenarioError for a mistake in its tables."""
        super().read()
        if self.record is not None:
            _ = self.recorded_truth

    @property
    def headings(self) -> tuple[int, ...]:
        """States that are angles, which tables count from anywhere: a motion's, or a class's."""
        f = getattr(self, "f", None)
        if isinstance(f, str):
            return MOTIONS[f].headings
        return tuple(getattr(getattr(f, "part", None), "headings", ()))

    @property
    def is_random(self) -> bool:  # type: ignore[override]
        """True if runs draw all states, False if some are recorded or unknown."""
        return self.path is None and not self.unknown

    @property
    def truth_known(self) -> bool:  # type: ignore[override]
        """True if some states are known, so that errors can be computed."""
        path = self.path
        return not (path.unknown.all() if isinstance(path, StackedStates) else self.unknown)

    @property
    def draws(self) -> bool:
        """True if runs draw states of it, as those of some of its blocks."""
        return (
            bool(self.path.drawn.any()) if isinstance(self.path, StackedStates) else self.is_random
        )

    @cached_property
    def _columns(self) -> Columns:
        assert isinstance(self.path, SourceFile)
        names = [f"x{k}" for k in range(self.n)]
        return read_columns(self.path, ("t", *names), ("node",))

    @cached_property
    def record(self) -> Any:
        """The states, a StateTable or StackedStates; None if they are drawn or unknown."""
        if not isinstance(self.path, SourceFile):
            return self.path
        return StateTable(self, self._columns.of_node(self.node))
