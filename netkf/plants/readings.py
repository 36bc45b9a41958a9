"""Tables of readings: rows of many nodes and times, some of them partial, some with their own R.

A row ``t,node,y0,...`` is one reading. Values may be missing: then their rows of H and R are not
there. Columns ``R0, ...`` (the diagonal) or ``R00, R01, ...`` (the upper triangle) are the noise of
the row itself, columns ``phi0, ...`` its row of H, and a column ``to`` names the anchor that a
nonlinear sensor measures from. Several rows of one node at one time are used together.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.core.contracts import is_netkf_class
from netkf.core.csv_files import Columns, read_columns, read_header
from netkf.core.errors import ScenarioError
from netkf.core.fields import MAX_MAGNITUDE, SourceFile
from netkf.linalg.arrays import FloatArray, block_diagonal, is_definite, readonly_array
from netkf.linalg.portable import cholesky, solve_lower

_NOISE_COLUMN = re.compile(r"R\d*")
"""Names that only columns of noises may have."""
Matrix = Callable[[int, np.ndarray], Any]
"""Returns the H (p', n) of row k of a node for the p' values that are there, flags (p,), or a
function that linearises them.
"""


class NodeRows(NamedTuple):
    """The K readings of one node, in order of time; rows of one time in the order of the file.

    t, rows : (K,), seconds, and the indices of the rows in the table
    y : (K, p), nan where a value is missing
    phi : (K, n), rows of H of the readings; n is 0 without such columns
    R : (K, p, p), nan where the sensor's R counts; (0, p, p) if it counts everywhere
    anchors : (K,), the ids of anchors, -1 without such a column
    """

    t: FloatArray
    rows: np.ndarray
    y: FloatArray
    phi: FloatArray
    R: FloatArray
    anchors: np.ndarray

    def covariance(self, k: int, R: FloatArray) -> FloatArray:
        """Return the covariance (p', p') of reading k: its own, else from R (p, p)."""
        present = np.flatnonzero(np.isfinite(self.y[k]))
        own = self.R[k] if len(self.R) else R
        chosen = np.ix_(present, present)
        return own[chosen] if np.isfinite(own[chosen]).all() else R[chosen]

    @property
    def is_uniform(self) -> bool:
        """True if all readings are whole and have the noise of the sensor."""
        return not len(self.R) and bool(np.isfinite(self.y).all())


class ReadingTable:
    """A table of readings of p values each. ``regressors`` is the number n of columns phi, 0
    without any, ``has_anchors`` tells of a column ``to``, ``has_noise`` of rows' own R.

    Mistakes in the file raise ScenarioError, at the latest when ``rows`` is called.
    """

    def __init__(self, path: SourceFile, p: int, R: FloatArray | None, linear: bool) -> None:
        """Take a file of readings of ``p`` values each (1 if it has columns phi), with the noise
        covariance ``R`` (p, p) where rows bring none. A ``linear`` sensor may have columns phi, a
        nonlinear one a column ``to``. Raises ScenarioError if it is no table.
        """
        header = read_header(path)
        self.path, self._R = path, R
        self.regressors = sum(linear and number_of(name, "phi") >= 0 for name in header)
        self.p = p = 1 if self.regressors else p
        self.has_anchors = not linear and "to" in header
        triangle = {f"R{i}{j}": (i, j) for i in range(p) for j in range(i, p)}
        diagonal = {f"R{i}": (i, i) for i in range(p)}
        # R00 is no name of the diagonal: it tells which of the two forms the table has.
        own = triangle if "R00" in header else diagonal if "R0" in header else {}
        self._noise: dict[str, tuple[int, int]] = own
        self.has_noise = bool(own)
        foreign = [name for name in header if _NOISE_COLUMN.fullmatch(name) and name not in own]
        if foreign:
            forms = f"{', '.join(diagonal)} or {', '.join(triangle)}"
            rule = f"{path.name} must give the noise of its rows as {forms}, not both"
            remedy = "write columns of one of the two forms, and rename others"
            raise ScenarioError("path", rule, foreign[0], remedy)
        self._surplus = [name for name in header if number_of(name) >= p]
        self._rows: dict[int, NodeRows] = {}
        self._slots: dict[tuple[int, float], dict[int, list[int]]] = {}

    @cached_property
    def columns(self) -> Columns:
        """The columns of the table; values and their noises may be missing."""
        values = [f"y{k}" for k in range(self.p)]
        others = [f"phi{k}" for k in range(self.regressors)]
        others += ["to"] if self.has_anchors else []
        required = ("t", "node", *values, *others, *self._noise)
        gaps = {*values, *self._noise, *self._surplus}
        columns = read_columns(self.path, required, tuple(self._surplus), gaps)
        for name in ("node", "to")[: 1 + self.has_anchors]:
            columns.integers(name)  # a mistake is found now
        return columns

    @cached_property
    def nodes(self) -> list[int]:
        """The node id of each row."""
        return self.columns.integers("node")

    @cached_property
    def listed(self) -> tuple[int, ...]:
        """The ids of all nodes in the table."""
        return tuple(sorted(set(self.nodes)))

    @cached_property
    def anchors(self) -> tuple[int, ...]:
        """The ids of all anchors in the table."""
        return tuple(sorted(set(self.columns.integers("to")))) if self.has_anchors else ()

    @cached_property
    def present(self) -> np.ndarray:
        """Flags (K, p) of the values that are there, of all rows."""
        return np.isfinite(self._stack([f"y{k}" for k in range(self.p)]))

    def _stack(self, names: Sequence[str]) -> FloatArray:
        columns = [self.columns[name] for name in names]
        return np.stack(columns, axis=1) if columns else np.empty((len(self.columns.lines), 0))

    @cached_property
    def _covariances(self) -> FloatArray:
        """The noise covariance (K, p, p) of each row itself, nan where the sensor's counts."""
        K, p = len(self.columns.lines), self.p
        if not self.has_noise:
            return np.empty((0, p, p))
        is_diagonal = "R00" not in self._noise
        R = np.zeros((K, p, p)) if is_diagonal else np.full((K, p, p), np.nan)
        for name, (i, j) in self._noise.items():
            R[:, i, j] = R[:, j, i] = self.columns[name]
        needed = self.present[:, :, None] & self.present[:, None, :]
        if is_diagonal:
            needed &= np.eye(p, dtype=bool)
        missing, given = needed & np.isnan(R), needed & np.isfinite(R)
        without = missing.any(axis=(1, 2)) & ~given.any(axis=(1, 2)) & (self._R is not None)
        for k in np.flatnonzero(missing.any(axis=(1, 2)) & ~without).tolist():
            i, j = np.argwhere(missing[k])[0].tolist()
            name = next(name for name, p in self._noise.items() if p == (min(i, j), max(i, j)))
            rule = f"{self.columns.where(k)}: {name} is missing, and y{i} has a value"
            remedy = "write it" if i == j else "write it, 0 where two values do not correlate"
            raise ScenarioError("path", rule, None, remedy)
        R[without] = np.nan
        self._require_definite(R, ~without & self.present.any(axis=1))
        return R

    def _require_definite(self, R: FloatArray, checked: np.ndarray) -> None:
        """Raise ScenarioError, with the line, where an R is not positive definite."""
        # In place of missing values stand independent ones of a middle size, which decide nothing.
        both = self.present[:, :, None] & self.present[:, None, :]
        whole = np.where(both, R, 0.0)[checked]
        present = self.present[checked]
        sizes = np.abs(np.einsum("kii->ki", whole)).sum(axis=1) / present.sum(axis=1)
        k, i = np.nonzero(~present)
        whole[k, i, i] = sizes[k]
        smallest = np.diagonal(whole, axis1=1, axis2=2).min(axis=1)
        wrong = np.flatnonzero(~(is_definite(whole) & (smallest > 1.0 / MAX_MAGNITUDE)))
        if wrong.size:
            row = int(np.flatnonzero(checked)[wrong[0]])
            there = np.flatnonzero(self.present[row])
            rule = f"{self.columns.where(row)}: the noise R of the row must be positive definite"
            value = R[row][np.ix_(there, there)]
            raise ScenarioError("path", rule, value, "variances are positive; correct the row")

    def first_covariance(self) -> FloatArray | None:
        """Return the noise covariance (p, p) of the first row that brings a whole one, or None."""
        whole = np.flatnonzero(np.isfinite(self._covariances).all(axis=(1, 2)))
        return readonly_array(self._covariances[whole[0]]) if whole.size else None

    def rows(self, node: int) -> NodeRows:
        """Return the readings of ``node`` (id) that have any value, sorted by time.

        Raises ScenarioError for a value that has no row in H, and for a time below 0.
        """
        if node not in self._rows:
            self._rows[node] = self._make_rows(node)
        return self._rows[node]

    def _make_rows(self, node: int) -> NodeRows:
        columns, own = self.columns, self.columns["node"] == node
        for name in self._surplus:
            entries = columns[name]
            wrong = np.flatnonzero(own & np.isfinite(entries) & (entries != 0.0))
            if wrong.size:
                rule = f"{columns.where(wrong[0])}: {name} has no row in H"
                value = str(entries[wrong[0]])
                raise ScenarioError("path", rule, value, "give H and R a row for it")
        columns.refuse_early(np.flatnonzero(own & (columns["t"] < 0.0)), "t must be at least 0")
        # A stamp may lie before the origin by its rounding.
        begun = columns["t"] >= -columns.half_digits
        rows = np.flatnonzero(own & begun & self.present.any(axis=1))
        rows = rows[np.argsort(columns["t"][rows], kind="stable")]
        anchors = np.array(columns.integers("to"))[rows] if self.has_anchors else None
        R = self._covariances
        return NodeRows(
            t=np.maximum(columns["t"][rows], 0.0),
            rows=rows,
            y=self._stack([f"y{k}" for k in range(self.p)])[rows],
            phi=self._stack([f"phi{k}" for k in range(self.regressors)])[rows],
            R=R[rows] if len(R) else R,
            anchors=np.full(len(rows), -1) if anchors is None else anchors,
        )

    def slots(self, node: int, period: float) -> dict[int, list[int]]:
        """Return the readings k of ``node`` (id) by number of the slot of ``period`` seconds.

        Raises ScenarioError for a time that is not the start of a slot.
        """
        if (node, period) not in self._slots:
            slots: dict[int, list[int]] = {}
            for k, row in enumerate(self.rows(node).rows.tolist()):
                slots.setdefault(slot_number(self.columns, row, period), []).append(k)
            self._slots[node, period] = slots
        return self._slots[node, period]

    def times(self, node: int, horizon: float) -> FloatArray:
        """Return the times (K,) in seconds, below the ``horizon``, of the rows of ``node``."""
        t = self.rows(node).t
        return t[: int(np.searchsorted(t, horizon))]

    @cached_property
    def row_times(self) -> list[tuple[int, float]]:
        """Node id and time (seconds) of every row, in file order; nan without a value."""
        t, half_digits = self.columns["t"], self.columns.half_digits
        times = np.where((t < 0.0) & (t >= -half_digits), 0.0, t)
        times[~self.present.any(axis=1)] = np.nan
        return list(zip(self.nodes, times.tolist(), strict=True))


def number_of(name: str, letter: str = "y") -> int:
    """Return the number in the ``name`` of a column, 3 for "y3"; -1 for other names."""
    number = name.removeprefix(letter)
    return int(number) if name.startswith(letter) and number.isdecimal() else -1


def slot_number(columns: Columns, row: int, period: float) -> int:
    """Return the number of the slot of ``period`` seconds that begins at the time of a ``row``
    (index), up to half of the last digit of its stamp where that tells slots apart.

    Raises ScenarioError, with the line, if none does.
    """
    t, half_digit = float(columns["t"][row]), float(columns.half_digits[row])
    slot = round(t / period)
    off = t - slot * period
    # Decimal stamps are multiples of most periods up to their last digit only, and times up to
    # rounding.
    tolerance = 1e-9 * max(period, abs(t))
    if half_digit < 0.5 * period:
        tolerance += half_digit
    if abs(off) > tolerance:
        raise ScenarioError(
            "path",
            f"{columns.where(row)}: t must be a slot, a multiple of the period {period!r}, up to "
            "half of its last digit",
            f"{t!r}, {abs(off):.3g} s {'after' if off > 0.0 else 'before'} slot {slot}",
            "write stamps with more digits, correct plant.period or [time] origin, or choose a "
            "plant in continuous time",
        )
    return slot


class RecordedSamples:
    """One node's readings in continuous time, one sample each, of n states with H ``matrix``."""

    def __init__(self, rows: NodeRows, matrix: Matrix) -> None:
        self._rows, self._matrix, self._is_uniform = rows, matrix, rows.is_uniform

    def reading(self, k: int, x: FloatArray) -> tuple[FloatArray, Any]:
        """Return ``y`` (p',) and ``H`` (p', n), or a function, of the values of sample ``k``."""
        present = np.isfinite(self._rows.y[k])
        return self._rows.y[k][present], self._matrix(k, present)

    def covariance(self, k: int, R: FloatArray) -> FloatArray:
        """Return the noise covariance (p', p') of sample number ``k`` of a sensor with R (p, p)."""
        return self._rows.covariance(k, R)

    def several(self, ks: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``y`` (S, p) and ``H`` (S, p, n) of samples ``ks``; zeros for missing values."""
        rows, p = self._rows, self._rows.y.shape[1]
        if self._is_uniform and rows.phi.shape[1]:
            return rows.y[list(ks)], rows.phi[list(ks), None]
        # The H of all, unless rows are about others.
        if self._is_uniform and len(set(rows.anchors.tolist())) < 2:
            H_of_all = self._matrix(0, np.ones(p, dtype=bool))
            return rows.y[list(ks)], np.broadcast_to(H_of_all, (len(ks), *H_of_all.shape))
        y, H = np.zeros((len(ks), p)), []
        for index, k in enumerate(ks):
            values, matrix = self.reading(k, x)
            y[index, : len(values)] = values
            H.append(
                np.concatenate([matrix, np.zeros((y.shape[1] - len(values), matrix.shape[1]))])
            )
        return y, np.array(H)


class RecordedReadings:
    """The readings of one node in slots: ``slots`` has the rows k of each; ``matrix`` gives the H
    of a row, of n states (0: a function that linearises it). Rows of a slot are one reading.
    """

    def __init__(self, rows: NodeRows, slots: dict[int, list[int]], matrix: Matrix, n: int) -> None:
        self._rows, self._slots, self._matrix, self._n = rows, slots, matrix, n
        # Of each row, once they are asked for.
        self._whitened: list[tuple[FloatArray, FloatArray]] | None = None

    def matrix(self, slot: int) -> Any:
        """Return H (p', n) of the values of a slot, or a function that linearises them."""
        parts = [self._matrix(k, np.isfinite(self._rows.y[k])) for k in self._slots.get(slot, ())]
        if not self._n:
            return Stacked(parts)
        return np.concatenate([np.zeros((0, self._n)), *parts])

    def reading(self, slot: int, x: FloatArray) -> FloatArray:
        """Return the p' values (p',) in slot number ``slot``; the state x (n,) is not used."""
        y = self._rows.y[self._slots.get(slot, [])].reshape(-1)
        return y[np.isfinite(y)]

    def readings_at(self, slot: int, R: FloatArray) -> Iterator[tuple[FloatArray, int, FloatArray]]:
        """Yield of each row of a slot the values (p,), nan where they are missing, the id of the
        anchor, -1 for the node itself, and the noise covariance (p, p), from that of the sensor, R.
        """
        for k in self._slots.get(slot, ()):
            y, whole = self._rows.y[k], R.copy()
            present = np.flatnonzero(np.isfinite(y))
            whole[np.ix_(present, present)] = self._rows.covariance(k, R)
            yield y, int(self._rows.anchors[k]), whole

    def parts(
        self, slot: int, x: FloatArray, R: FloatArray
    ) -> Iterator[tuple[FloatArray, Any, FloatArray]]:
        """Yield the values (p',) of each row of a slot, their H or a function, and covariance."""
        for k in self._slots.get(slot, ()):
            present = np.isfinite(self._rows.y[k])
            covariance = self._rows.covariance(k, R)
            yield self._rows.y[k][present], self._matrix(k, present), covariance

    def covariance(self, slot: int, R: FloatArray) -> FloatArray:
        """Return the noise covariance (p', p') in slot number ``slot``, from R (p, p)."""
        return block_diagonal([self._rows.covariance(k, R) for k in self._slots.get(slot, ())])

    def several(self, slots: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings (S, p) and matrices (S, p, n) of ``slots``; zeros for missing values."""
        p = max([self._rows.y.shape[1], *(len(self.reading(slot, x)) for slot in slots)])
        y, H = np.zeros((len(slots), p)), np.zeros((len(slots), p, self._n))
        for index, slot in enumerate(slots):
            values = self.reading(slot, x)
            y[index, : len(values)], H[index, : len(values)] = values, self.matrix(slot)
        return y, H

    def whitened(self, slots: list[int], R: FloatArray, p: int) -> tuple[FloatArray, FloatArray]:
        """Return readings (S, p) and matrices (S, p, n) of S ``slots``, multiplied by the inverse
        Cholesky factor of their noise covariance, where a sensor has R; zeros for what is missing,
        at the end of each row of the table: gates look at each by itself.
        """
        if self._whitened is None:
            self._whitened = self._whiten(R)
        y, H = np.zeros((len(slots), p)), np.zeros((len(slots), p, self._n))
        for index, slot in enumerate(slots):
            row = 0
            for k in self._slots.get(slot, ()):
                values, matrix = self._whitened[k]
                y[index, row : row + len(values)] = values
                H[index, row : row + len(values)] = matrix
                row += self._rows.y.shape[1]
        return y, H

    def _whiten(self, R: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return each row, y (p',) and H (p', n), times the inverse root of its covariance."""
        rows, pairs = self._rows, []
        uniform = cholesky(R) if rows.is_uniform else None
        for k, y in enumerate(rows.y):
            present = np.isfinite(y)
            root = cholesky(rows.covariance(k, R)) if uniform is None else uniform
            values = solve_lower(root, y[present][:, None])[:, 0]
            pairs.append((values, solve_lower(root, self._matrix(k, present))))
        return pairs


class Stacked:
    """A function that linearises several readings, each by its own function of ``parts``."""

    def __init__(self, parts: Sequence[Any]) -> None:
        self.parts = parts

    def __call__(self, y: FloatArray, xhat: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the readings ``y`` (p,) linearised at the estimate ``xhat`` (n,), and H (p, n)."""
        pairs = [(y[:0], np.zeros((0, len(xhat))))]
        pairs += [part(y[rows], xhat) for part, rows in self._rows()]
        return np.concatenate([z for z, _ in pairs]), np.concatenate([H for _, H in pairs])

    def value(self, x: FloatArray) -> FloatArray:
        """Return the readings (p,) without noise at the state x (n,)."""
        return np.concatenate([np.zeros(0), *(part.value(x) for part in self.parts)])

    def difference(self, y: FloatArray, expected: FloatArray) -> FloatArray:
        """Return the innovations (p,) of readings y (p,) minus the ``expected`` ones (p,)."""
        parts = (part.difference(y[rows], expected[rows]) for part, rows in self._rows())
        return np.concatenate([np.zeros(0), *parts])

    @property
    def size(self) -> int:
        """The number p of values."""
        return sum(part.size for part in self.parts)

    def _rows(self) -> Iterator[tuple[Any, slice]]:
        """Yield each part, and its values among all."""
        first = 0
        for part in self.parts:
            yield part, slice(first, first + part.size)
            first += part.size


def take_from_record(sensor: Any, record: ReadingTable) -> None:
    """Give a ``sensor`` nodes and R of its table where it has none; may raise ScenarioError."""
    if sensor.nodes is None:
        object.__setattr__(sensor, "nodes", record.listed)
    if not sensor.nodes:
        raise ScenarioError("path", f"{record.path.name} has no rows", None, "add some")
    if sensor.R is None:
        object.__setattr__(sensor, "R", record.first_covariance())
    if sensor.R is None:
        raise ScenarioError("R", "is missing", None, "add R = ..., or columns R0, ... to the table")


def covariance_of(path: Any, k: int, R: FloatArray) -> FloatArray:
    """Return the covariance of reading number ``k``: its own, or the R (p, p) of the sensor."""
    covariance = getattr(path, "covariance", None)
    return R if covariance is None else np.asarray(covariance(k, R))


def readings_of(
    path: Any, slot: int, x: FloatArray, R: FloatArray
) -> Iterator[tuple[FloatArray, Any, FloatArray]]:
    """Yield y (p,), H (p, n) or a function, and the noise covariance (p, p) of each reading of a
    ``slot``, at the state x (n,), of a sensor with R (p, p): a table may have several.
    """
    if hasattr(path, "parts"):
        yield from path.parts(slot, x, R)
    else:
        y, H = own_reading(path, path.reading(slot, x), path.matrix(slot), x)
        yield y, H, covariance_of(path, slot, R)[: len(y), : len(y)]


def read_many(path: Any, numbers: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return readings (S, p) and H (S, p, n) of ``numbers`` (S,), increasing, at x (S, n)."""
    if hasattr(path, "several"):
        y, H = path.several(numbers, x)
        return y, H
    # What a user's class must have: ``reading`` of a sample gives y and H, in a slot y alone.
    pairs: list[Any] = [(path.reading(k, state), k) for k, state in zip(numbers, x, strict=True)]
    if hasattr(path, "matrix"):
        pairs = [(y, path.matrix(k)) for y, k in pairs]
    else:
        pairs = [pair for pair, _ in pairs]
    rows = [own_reading(path, y, H, state)[0] for (y, H), state in zip(pairs, x, strict=True)]
    if any(len(y) != len(H) for y, (_, H) in zip(rows, pairs, strict=True)):
        rule = f"{type(path).__name__}.reading gives no values at times, which only SimPy takes"
        raise ScenarioError("sensors", rule, None, 'use engine="simpy"')
    return np.array(rows), np.array([H for _, H in pairs])


def own_reading(path: Any, y: Any, H: Any, x: FloatArray) -> tuple[FloatArray, Any]:
    """Return y (p,) that a ``path`` read at x (n,), and H (p, n) or a function: of no values no
    rows, whatever H is. Raises ScenarioError where that of a user's class is no reading.
    """
    cls = type(getattr(path, "_path", path))
    if is_netkf_class(cls):
        return y, H
    given = np.asarray(y)
    is_right = given.dtype.kind in "fiu" and given.ndim == 1
    is_right = is_right and (callable(H) or len(given) in (0, len(H)))
    # Of a state that has left the numbers nobody can know the reading.
    if not is_right or (np.isfinite(x).all() and not np.isfinite(given).all()):
        rule = f"{cls.__name__}.reading must give finite numbers, one for each row of H, or none"
        raise ScenarioError("sensors", rule, y, "correct the class")
    return given.astype(np.float64, copy=False), H if len(given) or callable(H) else H[:0]
