"""When nodes are up: crashes, duty cycles, and tables of who joins and leaves."""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.core.contracts import is_netkf_class
from netkf.core.csv_files import read_columns
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    SourceFile,
    field,
    list_of,
    node_id,
    number,
    of_time,
    one_of,
    positive,
    source_file,
)
from netkf.core.repeated_rows import KeyedTable, RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Topology, demand_in_graph

UP, DOWN = ("restart", "join"), ("crash", "leave")
"""Kinds of the events with which a node is up, and down."""


class Change(NamedTuple):
    """A node goes up or down at ``time`` (seconds), by an event of this ``kind``."""

    time: float
    kind: str

    @property
    def up(self) -> bool:
        """True if the node is up from now on."""
        return self.kind in UP


@dataclass(frozen=True, eq=False)
class Life(Component):
    """The contract of lives: when each of ``nodes`` is up. A node that is down neither senses,
    ticks, sends nor hears; a message that arrives then is lost.

    memory  kept: a node goes on with the estimate it had; lost: it begins again with the mean and
            the covariance of its filter, in slots when the next one begins
    """

    nodes: tuple[int, ...] = field(list_of(node_id(), "node ids"))
    memory: str = field(one_of("kept", "lost"), default="kept")

    @property
    def _change_rate(self) -> float:
        """Changes of a node in a second, in the mean; 0 where it is not known."""
        return 0.0

    @abstractmethod
    def changes(
        self, node: int, random: Callable[[], np.random.Generator], horizon: float
    ) -> Sequence[Change]:
        """Return the changes of ``node`` after time 0 to the ``horizon`` (seconds) or later, in the
        order of time and up and down in turn; ``random()`` is its stream. If the first one is up,
        also after the horizon, the node is down until then.
        """

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless all nodes are in the graph."""
        demand_in_graph(self.nodes, topology)


@dataclass(frozen=True, eq=False)
class Crashes(Life):
    """A node is up for exponential times of mean ``mean_up`` seconds, and down for ``mean_down``,
    in turn; it is up at first.
    """

    mean_up: float = field(positive)
    mean_down: float = field(positive)

    @property
    def _change_rate(self) -> float:
        return 2.0 / (self.mean_up + self.mean_down)

    def changes(
        self, node: int, random: Callable[[], np.random.Generator], horizon: float
    ) -> Sequence[Change]:
        """Return crashes and restarts in turn."""
        generator, found, now = random(), list[Change](), 0.0
        for mean, kind in itertools.cycle(((self.mean_up, "crash"), (self.mean_down, "restart"))):
            now += mean * float(generator.standard_exponential())
            if now >= horizon:
                return found
            found.append(Change(now, kind))
        raise AssertionError


@dataclass(frozen=True, eq=False)
class DutyCycle(Life):
    """In each ``period`` of seconds a node is up for ``up`` seconds, from ``phase`` on."""

    period: float = field(of_time(positive))
    up: float = field(of_time(positive))
    phase: float = field(of_time(number(low=0.0)), default=0.0)

    @property
    def _change_rate(self) -> float:
        return 2.0 / self.period

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up >= self.period:
            remedy = "shorten it, or leave these nodes out"
            raise ScenarioError("up", "must be below the period", self.up, remedy)

    def changes(
        self, node: int, random: Callable[[], np.random.Generator], horizon: float
    ) -> Sequence[Change]:
        """Return restarts and crashes in turn, at times counted from ``phase``."""
        found, phase = [], math.fmod(self.phase, self.period)
        for k in itertools.count(-2):
            begin = phase + k * self.period
            found += [Change(begin, "restart"), Change(begin + self.up, "crash")]
            if begin >= horizon:
                break
        # A node that is up at time 0 has not gone up in the run.
        return [change for change in found if change.time > 0.0]


@dataclass(frozen=True, eq=False)
class RecordedLife(Life):
    """Changes by a table ``t,node,what`` with what = up, down, join or leave."""

    path: SourceFile = field(source_file)

    _reads = "_table"

    @cached_property
    def _table(self) -> KeyedTable[int, list[Change], tuple[int, float]]:
        """The changes of each node in the order of time; the node and time of each row."""
        kinds = {"up": "restart", "down": "crash", "join": "join", "leave": "leave"}
        table = read_columns(self.path, ("t", "node", "what"), words={"what": tuple(kinds)})
        what = [list(kinds.values())[int(index)] for index in table["what"]]
        keys = list(zip(table.integers("node"), table["t"].tolist(), strict=True))
        rows = first_rows(table, keys, what, "a node must go up or down once at a time")
        found: dict[int, list[Change]] = {}
        for (node, time), row in sorted(rows.items()):
            changes = found.setdefault(node, [])
            changes.append(Change(time, what[row]))
            if len(changes) > 1 and changes[-2].up == changes[-1].up:
                before = rows[node, changes[-2].time]
                state = "up" if changes[-1].up else "down"
                rule = f"{table.where(before, row)}: node {node} is {state} already"
                raise ScenarioError("path", rule, time, "correct the rows of the node")
        return KeyedTable(found, table, keys)

    @property
    def rows(self) -> FloatArray:
        """The times (K,) of all rows in seconds, in the order of the table."""
        return np.array([t for _, t in self._table.keys])

    def use(self, end: float) -> RowUse:
        """Return the use of the rows by a run to ``end`` (s): those after 0, and the one that says
        how a node begins: the last one until then, or the first one if the node goes up by it.
        """
        found, keys = self._table.of, self._table.keys
        first = {
            node: max((change.time for change in changes if change.time <= 0.0), default=0.0)
            for node, changes in found.items()
        }
        ups = {(node, max(0.0, c[0].time)) for node, c in found.items() if c[0].up}
        return count_rows(
            self.path.name, keys, lambda key: first[key[0]] <= key[1] < end or key in ups
        )

    def changes(
        self, node: int, random: Callable[[], np.random.Generator], horizon: float
    ) -> Sequence[Change]:
        """Return the rows of the node; those at time 0 or before say how it begins."""
        listed = self._table.of.get(node, [])
        after = [change for change in listed if change.time > 0.0]
        if listed and not after and not listed[-1].up:
            return [Change(math.inf, "restart")]
        return after

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless all nodes of the table are in the entry."""
        super().check(topology)
        missing = sorted(set(self._table.of) - set(self.nodes))
        if missing:
            rule = f"{self.path.name} has rows of nodes that are not in nodes"
            raise ScenarioError("path", rule, missing, "add them to nodes, or remove the rows")


class Lifetime(NamedTuple):
    """A node's changes in canonical form; ``up`` at first; whether ``memory`` is lost when down."""

    up: bool
    changes: tuple[Change, ...]
    forgets: bool


def lifetimes(scenario: Any, streams: Any) -> dict[int, Lifetime]:
    """Return the lives of a run by the ids of the nodes that have one."""
    found, forgetful = {}, set(scenario.forgetful_nodes)
    for life in scenario.network.lives:
        for node in life.nodes:

            def random(node: int = node) -> np.random.Generator:
                generator: np.random.Generator = streams.generator("life", node)
                return generator

            # The last slot is finished after the horizon, for its sample.
            changes = _stated_changes(life, life.changes(node, random, scenario.end_time))
            up = not changes or not changes[0].up
            instants = [c._replace(time=scenario.time_grid.instant(c.time)) for c in changes]
            forgets = node in forgetful
            if forgets and scenario.slotted:
                instants = _begun_with_slots(instants, scenario.slot_plant)
            kept = tuple(c for c in instants if c.time < scenario.end_time)
            found[node] = Lifetime(up, kept, forgets)
    return found


def _stated_changes(life: Life, given: Any) -> Sequence[Change]:
    """Return the changes ``given`` by a ``life``; raises ScenarioError where a user's are none."""
    if is_netkf_class(type(life)):
        return list(given)
    try:
        found = [Change(float(time), kind) for time, kind in given]
    except (TypeError, ValueError):
        found = [Change(math.nan, "")]
    times, ups = [0.0, *(one.time for one in found)], [one.up for one in found]
    in_order = all(a <= b for a, b in itertools.pairwise(times))
    in_turn = all(a != b for a, b in itertools.pairwise(ups))
    if not (in_order and in_turn and {one.kind for one in found} <= {*UP, *DOWN}):
        rule = (
            f"{type(life).__name__}.changes must return Change(time, kind) in the order of time, "
        )
        remedy = f"kinds are {', '.join((*UP, *DOWN))}"
        raise ScenarioError("network.lives", rule + "up and down in turn", given, remedy)
    return found


def _begun_with_slots(changes: Sequence[Change], plant: Any) -> list[Change]:
    """Let a node that forgets go up when the next slot begins, unless it is down again by then."""
    found: list[Change] = []
    for change in changes:
        if not change.up and found and found[-1].up and change.time <= found[-1].time:
            found.pop()
            continue
        slot = int(change.time / plant.period) if change.time < math.inf else 0
        while change.up and plant.slot_time(slot) < change.time < math.inf:
            slot += 1
        found.append(change._replace(time=plant.slot_time(slot)) if change.up and slot else change)
    return found
