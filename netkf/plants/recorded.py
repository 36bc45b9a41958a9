"""Plants and sensors whose truth or readings come from tables, in both models of time.

The checks of a scenario call the methods ``require_...``, which raise, before a run starts, if the
table lacks a state that the run needs. Readings may be missing: a node whose table has no row for a
slot has no reading in that slot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from netkf.core.csv_files import Columns, read_columns, read_header
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    SourceFile,
    definite_covariance,
    field,
    integer,
    list_of,
    matrix,
    source_file,
)
from netkf.core.repeated_rows import first_rows
from netkf.linalg.arrays import FloatArray, readonly_array
from netkf.plants.diffusion import Diffusion
from netkf.plants.linear import LinearPlant
from netkf.plants.sampling import RecordedSamples
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
        return {slot: states[row] for slot, row in first.items()}

    @cached_property
    def _states(self) -> tuple[Columns, FloatArray]:
        """The columns of the file and the states (K, n) of its rows."""
        return _read_states(self.path, self.n)

    @cached_property
    def row_keys(self) -> list[int]:
        """The slot number of each row, in the order of the table; rows of one slot are equal."""
        times = enumerate(self._states[0]["t"].tolist())
        return [slot_number(self._states[0].where(row), t, self.period) for row, t in times]

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
    """Readings from a table ``t,node,y0,...``, t in seconds: in slots at most one row a slot and
    node, over a diffusion samples ``y = H x + v`` at the node's own times.

    ``H`` (p, n) and ``R`` (p, p) are what the filters take them to be. A table with columns
    ``phi0,...`` (one for each state, p = 1) holds the H of every reading; ``H`` may then be left
    out, and is ignored if it is given. ``nodes`` are by default all that the table lists; rows of
    other nodes may be there for other ``[[sensors]]``, which may have more or fewer components:
    what a row has beyond its own p must be empty, nan or 0.
    """

    is_random: ClassVar[bool] = False

    path: SourceFile = field(source_file)
    H: FloatArray = field(matrix, default=None)
    R: FloatArray = field(definite_covariance)
    nodes: tuple[int, ...] = field(list_of(integer(), "node ids"), default=None)

    def __post_init__(self) -> None:
        """Take nodes and H from the table where they are not given; raise ScenarioError if H is
        missing or the file has a mistake.
        """
        super().__post_init__()
        nodes: tuple[int, ...] | None = self.nodes
        if nodes is None:
            object.__setattr__(self, "nodes", self.listed)
        if not self.nodes:
            raise ScenarioError("path", f"{self.path.name} has no rows", None, "add some")
        # The first row is y, phi0, phi1, ...: its phi' stands for H where one is needed at once.
        if self.varying and any(self._rows.values()):
            row = next(rows[0][1] for rows in self._rows.values() if rows)
            object.__setattr__(self, "H", readonly_array(row[None, 1:]))
        H: FloatArray | None = self.H
        if H is None:
            remedy = "add H = ..., or columns phi0, ... to the table"
            raise ScenarioError("H", "is missing", None, remedy)
        _ = self._rows  # a mistake in the file is found on construction

    @cached_property
    def _regressors(self) -> list[str]:
        """Names of the columns ``phi0, phi1, ...`` that the file has, none if H does not vary."""
        header = read_header(self.path)
        count = sum(_column_number(name, "phi") >= 0 for name in header)
        return [f"phi{k}" for k in range(count)]

    @property
    def varying(self) -> bool:
        """True if the table has columns phi0, ..."""
        return bool(self._regressors)

    @property
    def _outputs(self) -> int:
        """Number p of the values of a reading."""
        H: FloatArray | None = self.H
        return 1 if self.varying or H is None else len(H)

    @cached_property
    def _columns(self) -> Columns:
        """The columns of the table. Entries that have no row in H may be empty."""
        outputs = tuple(f"y{k}" for k in range(self._outputs))
        required = ("t", "node", *outputs, *self._regressors)
        others = tuple(name for name in read_header(self.path) if _column_number(name) >= 0)
        surplus = tuple(name for name in others if name not in outputs)
        return read_columns(self.path, required, surplus, gaps=surplus)

    @cached_property
    def listed(self) -> tuple[int, ...]:
        """Ids of all nodes in the table."""
        return tuple(sorted(set(self._ids)))

    @cached_property
    def row_times(self) -> list[tuple[int, float]]:
        """Node id and time (seconds) of every row, in the order of the file."""
        columns = self._columns
        return list(zip(columns.integers("node"), columns["t"].tolist(), strict=True))

    @property
    def _ids(self) -> list[int]:
        """Node id of each line."""
        return [node for node, _ in self.row_times]

    @cached_property
    def _rows(self) -> dict[int, list[tuple[float, FloatArray]]]:
        """Time in seconds and values (y, then phi) of all rows, by the ids of ``nodes``, in the
        order of the file. Raises ScenarioError for a value that has no row in H.
        """
        columns, p = self._columns, self._outputs
        values = [columns[name] for name in (*(f"y{k}" for k in range(p)), *self._regressors)]
        surplus = [name for name in columns if _column_number(name) >= p]
        rows: dict[int, list[tuple[float, FloatArray]]] = {node: [] for node in self.nodes}
        for k, (node, t) in enumerate(self.row_times):
            if node in rows:
                for name in surplus:
                    if columns[name][k] != 0.0 and not math.isnan(columns[name][k]):
                        rule = f"{columns.where(k)}: {name} has no row in H"
                        remedy = "leave it empty or correct H"
                        raise ScenarioError("path", rule, float(columns[name][k]), remedy)
                rows[node].append((t, np.array([column[k] for column in values])))
        return rows

    def table(self, node: int, period: float) -> Table:
        """Return the readings (p,) of a node (id), or with regressors reading and phi together
        (1 + n,), by number of the slot of ``period`` seconds.

        Raises ScenarioError for a time that is not the start of a slot and for two rows of a slot.
        """
        return index_by_slot(self.path, self._rows[node], period, whose=f" of node {node}")

    def require_slot_times(self, period: float) -> None:
        """Raise ScenarioError if the table does not fit slots of ``period`` seconds."""
        for node in self.nodes:
            self.table(node, period)

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
        times = self.rows(node)[0]
        return times[: int(np.searchsorted(times, horizon))]

    def recorded_times(self, node: int) -> FloatArray:
        """Return the times (K,) in seconds of all rows of ``node`` (id), in the order of the
        table.
        """
        return np.array([t for t, _ in self._rows[node]])

    def rows(self, node: int) -> tuple[FloatArray, FloatArray]:
        """Return the increasing times (K,) in seconds and the readings (K, p) of a node (id); with
        regressors the rows are reading and phi together, (K, 1 + n).

        Raises ScenarioError for a time below 0 and for two rows at one time.
        """
        rows = sorted(self._rows[node], key=lambda row: row[0])
        times = np.array([t for t, _ in rows])
        values = np.array([y for _, y in rows]).reshape(
            len(rows), self._outputs + len(self._regressors)
        )
        if len(times) and times[0] < 0.0:
            rule = f"{self.path.name}: t must be at least 0"
            raise ScenarioError("path", rule, float(times[0]), "correct the row")
        twice = np.flatnonzero(np.diff(times) <= 0.0)
        if twice.size:
            rule = f"{self.path.name}: there may be one row of node {node} a time"
            raise ScenarioError("path", rule, f"two at t = {times[twice[0]]:g}", "remove one")
        return times, values

    def samples(
        self, node: int, generator: Callable[[str], np.random.Generator], horizon: float
    ) -> RecordedSamples:
        """Return the samples of the table's rows of ``node`` (id), also those beyond the
        ``horizon``; nothing is drawn from ``generator``.
        """
        return RecordedSamples(self.H, self.rows(node)[1])

    def slot_path(
        self, node: int, period: float, generator: Callable[[str], np.random.Generator]
    ) -> RecordedReadings:
        """Return the readings of the table's rows of ``node`` (id) in slots of ``period`` seconds;
        nothing is drawn from ``generator``.
        """
        return RecordedReadings(self.H, self.table(node, period))


class RecordedReadings:
    """The readings of one node by slot number, rows of a ``table``: y (p,), then phi (n,) where H
    varies; ``H`` (p, n) for rows without phi.
    """

    def __init__(self, H: FloatArray, table: Table) -> None:
        self._H, self._table = H, table

    def matrix(self, slot: int) -> FloatArray:
        """Return H (p, n) in slot number ``slot``: the recorded phi' if there are regressors, else
        the given H; zeros for a slot without a row.
        """
        row = self._table.get(slot)
        if row is None:
            return np.zeros_like(self._H)
        phi = row[len(self._H) :]
        return phi[None] if phi.size else self._H

    def reading(self, slot: int, x: FloatArray) -> FloatArray:
        """Return the reading (p,) in slot number ``slot``, nan without a row; the state x (n,) is
        not used.
        """
        row = self._table.get(slot)
        return np.full(len(self._H), math.nan) if row is None else row[: len(self._H)]

    def several(self, slots: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings (S, p) and matrices (S, p, n) of S ``slots``; zeros, which carry no
        information, for a slot without a row. The states x (S, n) are not used.
        """
        y, H = np.zeros((len(slots), len(self._H))), np.zeros((len(slots), *self._H.shape))
        for k, slot in enumerate(slots):
            if slot in self._table:
                y[k], H[k] = self.reading(slot, x), self.matrix(slot)
        return y, H


def _column_number(name: str, letter: str = "y") -> int:
    """Return the number in the ``name`` of a column, 3 for "y3" with ``letter`` "y"; -1 for names
    of another form.
    """
    number = name.removeprefix(letter)
    return int(number) if name.startswith(letter) and number.isdecimal() else -1


def index_by_slot(
    source: SourceFile, rows: Iterable[tuple[float, FloatArray]], period: float, whose: str
) -> Table:
    """Return the values of ``rows`` (t, values) by the slot of ``period`` seconds that begins at t.

    Raises ScenarioError for a time that is not the start of a slot and for two rows of a slot, with
    the name of the file ``source`` and ``whose``, the owner of the rows, such as " of node 3".
    """
    table: Table = {}
    for t, values in rows:
        slot = slot_number(source.name, t, period)
        if slot in table:
            rule = f"{source.name}: there may be one row{whose} a slot"
            raise ScenarioError("path", rule, f"two at t = {t:g}", "remove one")
        table[slot] = values
    return table


def slot_number(where: str, t: float, period: float) -> int:
    """Return the number of the slot of ``period`` seconds that begins at ``t``; raises
    ScenarioError, with ``where`` the row is, if none does.
    """
    # Decimal times of a file are multiples of the period up to rounding only.
    slot = round(t / period)
    if slot < 0 or abs(t - slot * period) > 1e-9 * max(period, abs(t)):
        rule = f"{where}: t must be a slot, a multiple of the period {period:g}"
        raise ScenarioError("path", rule, t, "correct the row")
    return slot


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
