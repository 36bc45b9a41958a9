"""A clock that ticks only while links are in contact, by a table of intervals."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.random import Generator

from netkf.core.clock import Entity
from netkf.core.csv_files import Columns, read_columns
from netkf.core.errors import ScenarioError, errors_under
from netkf.core.fields import SourceFile, field, instance_of, source_file
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock, Periodic, Poisson, Renewal
from netkf.network.graphs import Topology, demand_links

INNER = (Poisson, Renewal, Periodic)
"""The clocks that links may have while they are in contact."""
NUMBER_TOLERANCE = 1e-6
"""Share of a period by which rounding may move a tick, when its number is found from its time."""


@dataclass(frozen=True, eq=False)
class Contacts(LinkClock):
    """The ticks of ``clock`` that lie in the intervals of a table ``from,until,node,peer``, both
    ends included: a link, or with ``at`` "directions" a direction from node to peer, ticks inside
    its intervals only. Overlapping intervals are one.

    The clock of a link runs all the time and its ticks outside are left out, so that its phase and
    its random numbers do not depend on the intervals.
    """

    path: SourceFile = field(source_file)
    clock: LinkClock = field(instance_of(*INNER))

    grid_values: ClassVar[tuple[str, ...]] = ("_intervals",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.at == "nodes":
            rule = "must be links or directions: contacts have two ends"
            raise ScenarioError("at", rule, self.at, 'write at = "links" or "directions"')
        if type(self.clock) not in INNER:
            rule = "must be a poisson, renewal or periodic clock"
            raise ScenarioError("clock.kind", rule, type(self.clock).__name__, "choose one of them")
        if self.clock.at != self.at:
            object.__setattr__(self, "clock", dataclasses.replace(self.clock, at=self.at))
        _ = self._intervals  # a mistake in the file is found on construction

    @cached_property
    def _table(self) -> Columns:
        table = read_columns(self.path, ("from", "until", "node", "peer"))
        wrong = np.flatnonzero(table["until"] < table["from"])
        if wrong.size:
            row = int(wrong[0])
            rule = f"{table.where(row)}: until must not be before from"
            interval = [float(table["from"][row]), float(table["until"][row])]
            raise ScenarioError("path", rule, interval, "correct the row")
        return table

    @cached_property
    def row_keys(self) -> list[tuple[Entity, float, float]]:
        """The link or direction, beginning and end (s) of each row, in the order of the table."""
        table = self._table
        pairs: Iterable[Entity] = zip(*map(table.integers, ("node", "peer")), strict=True)
        if self.at == "links":
            pairs = ((min(pair), max(pair)) for pair in pairs)
        return list(zip(pairs, table["from"].tolist(), table["until"].tolist(), strict=True))

    @cached_property
    def _intervals(self) -> dict[Entity, tuple[FloatArray, FloatArray]]:
        """Beginnings and ends (K,) in seconds of the contacts of each link, joined on overlap."""
        intervals: dict[Entity, tuple[list[float], list[float]]] = {}
        for pair, begin, end in sorted(set(self.row_keys)):
            begins, ends = intervals.setdefault(pair, ([], []))
            if ends and begin <= ends[-1]:
                ends[-1] = max(ends[-1], end)
            else:
                begins.append(begin)
                ends.append(end)
        snap = self.time_grid.snap
        return {pair: (snap(np.array(b)), snap(np.array(e))) for pair, (b, e) in intervals.items()}

    @cached_property
    def overlapping(self) -> int:
        """Number of different rows that overlap another row of their link for some time."""
        rows, count = sorted(set(self.row_keys)), 0
        latest: dict[Entity, float] = {}
        for pair, begin, end in rows:
            count += begin < latest.get(pair, -math.inf)
            latest[pair] = max(end, latest.get(pair, -math.inf))
        return count

    def origin(self, entity: Entity, random: Callable[[], Generator]) -> float:
        """Return the phase of ``clock`` in seconds, drawn by ``random()`` if it is random."""
        return self.clock.origin(entity, random)

    def mean_rate(self, entity: Entity) -> float:
        """Return 0 for a link without a contact, else nan: the rate changes with time."""
        return math.nan if entity in self._intervals else 0.0

    def in_contact(self, entity: Entity, times: FloatArray) -> np.ndarray:
        """Return flags (K,): whether a link is in contact at ``times`` (K,) in seconds."""
        begins, ends = self._intervals.get(entity, (np.empty(0), np.empty(0)))
        times = self.time_grid.snap(times)
        last = np.searchsorted(begins, times, side="right") - 1
        inside = np.zeros(len(times), dtype=bool)
        begun = last >= 0
        inside[begun] = times[begun] <= ends[last[begun]]
        return inside

    def time_in_contact(self, entity: Entity, times: FloatArray) -> FloatArray:
        """Return how long (K,) a link has been in contact until ``times`` (K,), in seconds."""
        begins, ends = self._intervals.get(entity, (np.empty(0), np.empty(0)))
        begins, ends = np.maximum(begins, 0.0), np.maximum(ends, 0.0)
        lengths = np.clip(times[:, None] - begins, 0.0, ends - begins)
        return np.asarray(lengths.sum(axis=1))

    def distance(self, entity: Entity, times: FloatArray) -> float:
        """Return the largest distance (s) of ``times`` from contacts of a link, or inf."""
        begins, ends = self._intervals.get(entity, (np.empty(0), np.empty(0)))
        off = np.maximum(begins - times[:, None], times[:, None] - ends)
        return float(np.maximum(off.min(axis=1, initial=math.inf), 0.0).max(initial=0.0))

    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return the next ``count`` ticks (<= count,) of ``entity`` in seconds."""
        if entity not in self._intervals or math.isinf(now):
            return np.empty(0)
        end, number = float(self._intervals[entity][1][-1]), self._next_number(origin, now)
        ticks: list[float] = []
        # As many as are wanted still: so the last one that is drawn is the last one returned.
        while len(ticks) < count:
            drawn = self.clock.ticks(entity, origin, number, now, random, count - len(ticks))
            number, now = number + len(drawn), float(drawn[-1])
            ticks += drawn[self.in_contact(entity, drawn)].tolist()
            if now > end:
                return np.array([*ticks, math.inf])
        return np.array(ticks)

    def _next_number(self, origin: float, now: float) -> int:
        clock = self.clock
        if now == 0.0:
            return 0
        if isinstance(clock, Renewal) and clock.distribution == "constant":
            return math.floor(now * clock.mean_rate(()) + NUMBER_TOLERANCE)
        if isinstance(clock, Periodic):
            # Tick 0 is at the origin, or one period later if that is time 0.
            passed = math.floor((now - origin) / clock.period + NUMBER_TOLERANCE)
            return passed + (origin != 0.0)
        return 0

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless every pair of the table is a link, and the clock fits."""
        demand_links(self._table, topology, "node", "peer")
        with errors_under("clock"):
            self.clock.check(topology)

    def notes(self, topology: Topology) -> tuple[str, ...]:
        """Return lines on rows that overlap, and on links that have no contact."""
        notes: list[str] = []
        name = self.path.name
        if self.overlapping:
            notes.append(
                f"network.activation: {self.overlapping} of {len(self.row_keys)} rows overlap "
                f"another interval of the same {self.at[:-1]} and are joined with it ({name})"
            )
        entities = self.entities(topology)
        without = sum(entity not in self._intervals for entity in entities)
        if without:
            notes.append(
                f"network.activation: {without} of {len(entities)} {self.at} without any contact, "
                f"which never tick ({name})"
            )
        return tuple(notes)
