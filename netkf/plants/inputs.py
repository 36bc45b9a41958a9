"""Inputs u(t) of a plant: constant, a sine, or a table whose rows hold until the next.

An input is *exogenous*: between instants at which it jumps, u is an output of a linear system that
nothing drives. Its response in a linear plant is therefore exact (``response``).
"""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import scipy

from netkf.core.csv_files import Columns, read_columns, read_header
from netkf.core.errors import ScenarioError
from netkf.core.fields import Component, Rule, SourceFile, field, matrix, source_file, vector
from netkf.core.instants import OnGrid
from netkf.core.repeated_rows import first_rows
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.plants.readings import number_of


class Exogenous(NamedTuple):
    """``u(t) = C e^{S (t - a)} z`` from each of J times a on, up to the next; 0 before the first.

    times : (J,), increasing seconds, none below 0
    S, C  : (q, q) in 1/s, and (m, q)
    z     : (J, q)
    """

    times: FloatArray
    S: FloatArray
    C: FloatArray
    z: FloatArray

    def last(self, times: FloatArray) -> np.ndarray:
        """Return the index (K,) of the last a not after each of ``times`` (K,), -1 if none is."""
        return np.asarray(np.searchsorted(self.times, times, side="right") - 1)

    def states(self, times: FloatArray) -> FloatArray:
        """Return ``e^{S (t - a)} z`` (K, q) at each of ``times`` (K,); 0 before the first a."""
        last = self.last(times)
        states = self.z[last]
        if self.S.any():
            gaps = (times - self.times[last])[:, None, None]
            states = (scipy.linalg.expm(gaps * self.S) @ states[:, :, None])[:, :, 0]
        return np.where(last[:, None] >= 0, states, 0.0)


@dataclass(frozen=True, eq=False)
class Input(Component, OnGrid):
    """The contract of inputs u (m,), which drive a plant: ``dx = (A x + G u) dt + B dw``, in slots
    ``x[k+1] = F x[k] + G u[k] + w[k]``, with u[k] at the beginning of the slot. ``G`` is (n, m).
    """

    G: FloatArray | None = field(matrix, default=None)

    grid_values: ClassVar[tuple[str, ...]] = ("exogenous",)

    @property
    @abstractmethod
    def exogenous(self) -> Exogenous:
        """The system whose output is u."""

    @property
    def m(self) -> int:
        """Number of components of u."""
        return len(self.exogenous.C)

    def known_to(self, model: Any) -> FloatArray:
        """Return 1 for each component that filters with the ``model`` know, else 0, (m,)."""
        return np.full(self.m, float(model.input))

    def at(self, time: float) -> FloatArray:
        """Return u (m,) at ``time`` in seconds; where it jumps, the value after it."""
        return np.asarray(self.values(np.array([time]))[0])

    def values(self, times: FloatArray) -> FloatArray:
        """Return u (K, m) at K ``times`` (K,) in seconds; where it jumps, the value after it. To be
        defined by inputs whose S is not 0.
        """
        exogenous = self.exogenous
        last = exogenous.last(times)
        return np.where(last[:, None] >= 0, exogenous.z[last] @ exogenous.C.T, 0.0)


def _convert_entries(value: Any) -> FloatArray:
    is_number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    result: FloatArray = vector.convert([value] if is_number else value)
    return result


_entries = Rule(
    "must be a number, or a list with one for each component of the input",
    _convert_entries,
    "write a or [a, b]",
    {"anyOf": [{"type": "number"}, dict(vector.schema)]},
)


def _convert_frequencies(value: Any) -> FloatArray:
    result = _convert_entries(value)
    if (result < 0.0).any():
        raise ValueError
    return result


_frequencies = Rule(
    f"{_entries.requirement}, none below 0",
    _convert_frequencies,
    "give frequencies in Hz",
    _entries.schema,
)


@dataclass(frozen=True, eq=False)
class ConstantInput(Input):
    """``u(t) = value``, (m,) or a number."""

    value: FloatArray = field(_entries)

    @cached_property
    def exogenous(self) -> Exogenous:
        """The system whose output is u: a number that stays 1."""
        return Exogenous(np.zeros(1), np.zeros((1, 1)), self.value[:, None], np.ones((1, 1)))


@dataclass(frozen=True, eq=False)
class SineInput(Input):
    """``u_j(t) = amplitude_j sin(2 pi frequency_j t + phase_j)``.

    amplitude  (m,), or a number for all components
    frequency  in Hz, (m,) or a number
    phase      in radians, (m,) or a number
    """

    amplitude: FloatArray = field(_entries)
    frequency: FloatArray = field(_frequencies)
    phase: FloatArray = field(_entries, default=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        named = [(name, getattr(self, name)) for name in ("amplitude", "frequency", "phase")]
        m = max(len(value) for _, value in named)
        for name, value in named:
            if len(value) not in (1, m):
                rule = f"must be a number, or have {m} entries as the others"
                raise ScenarioError(name, rule, value, "add or remove some")

    @cached_property
    def components(self) -> np.ndarray:
        """Amplitude, frequency in rad/s and phase in rows, (3, m)."""
        rows = np.broadcast_arrays(self.amplitude, 2.0 * math.pi * self.frequency, self.phase)
        return np.stack(rows)

    @cached_property
    def exogenous(self) -> Exogenous:
        """The system whose output is u: an oscillator (sin, cos) for each component."""
        amplitude, omega, phase = self.components
        blocks = [np.array([[0.0, w], [-w, 0.0]]) for w in omega]
        C = np.asarray(np.kron(np.diag(amplitude), [1.0, 0.0]), dtype=np.float64)
        z = np.stack([np.sin(phase), np.cos(phase)], axis=1).reshape(1, -1)
        return Exogenous(np.zeros(1), block_diagonal(blocks), np.asarray(C), z)

    def values(self, times: FloatArray) -> FloatArray:
        """Return u (K, m) at K ``times`` (K,) in seconds."""
        amplitude, omega, phase = self.components
        return np.asarray(amplitude * np.sin(omega * times[:, None] + phase))


@dataclass(frozen=True, eq=False)
class RecordedInput(Input):
    """u is read from a table ``t,u0,u1,...``: a row holds until the next, and u is 0 before the
    first. With a column ``node`` a row is that of the block of this node.
    """

    path: SourceFile = field(source_file)

    node: ClassVar[int | None] = None
    """The node (id) whose rows count."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if "node" not in self._columns:
            _ = self.exogenous

    def owned_by(self, node: int) -> Self:
        """Return the input of the block of ``node`` (id)."""
        owned = copy.copy(self)
        object.__setattr__(owned, "node", node)
        return owned

    @cached_property
    def _columns(self) -> Columns:
        m = sum(number_of(name, "u") >= 0 for name in read_header(self.path))
        names = [f"u{k}" for k in range(max(m, 1))]
        columns = read_columns(self.path, ("t", *names), ("node",))
        if not len(columns.lines):
            raise ScenarioError("path", f"{self.path.name} has no rows", None, "add some")
        columns.refuse_early(np.flatnonzero(columns["t"] < 0.0), "t must be at least 0")
        return columns

    @cached_property
    def columns(self) -> Columns:
        """The columns of the rows that count."""
        return self._columns.of_node(self.node)

    @property
    def row_keys(self) -> list[float]:
        """The instant of each row that counts, in the order of the table."""
        return [float(t) for t in self.time_grid.snap(self.columns["t"])]

    @cached_property
    def exogenous(self) -> Exogenous:
        """The system whose output is u, which jumps at the rows; raises ScenarioError for two
        values at one time.
        """
        names = [name for name in self.columns if number_of(name, "u") >= 0]
        u = np.stack([self.columns[name] for name in names], axis=1)
        rule = "there may be one row a time, or equal ones"
        first = first_rows(self.columns, self.row_keys, u.tolist(), rule)
        times = np.array(sorted(first))[self._begun :]
        z, m = u[[first[t] for t in times.tolist()]], u.shape[1]
        return Exogenous(np.maximum(times, 0.0), np.zeros((m, m)), np.eye(m), z)

    @property
    def _begun(self) -> int:
        """How many instants of rows lie before the one that holds at 0, of a log with an origin."""
        return max(int(np.sum(np.unique(self.row_keys) <= 0.0)) - 1, 0)

    def used_keys(self, horizon: float, instants: FloatArray | None = None) -> set[float]:
        """Return the ``row_keys`` whose values hold at one of the ``instants`` (K,), by default at
        any time in [0, ``horizon``), in seconds.
        """
        times = np.unique(self.row_keys)
        if instants is None:
            instants = times[self._begun : np.searchsorted(times, horizon)]
        last = np.searchsorted(times, instants, side="right") - 1
        return set(times[last[last >= 0]].tolist())
