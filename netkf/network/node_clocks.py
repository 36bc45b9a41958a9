"""Clocks of nodes that are wrong: offset and drift."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.clock import Clock
from netkf.core.fields import Component, Rule, SourceFile, field, list_of, node_id, number
from netkf.core.instants import TimeGrid
from netkf.core.laws import Lattice
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.network.contacts import Contacts
from netkf.network.graphs import Topology, demand_in_graph

MAX_OFFSET, MAX_DRIFT, MAX_SIGMA = 1e6, 0.5, 0.1
"""Largest offset (seconds) and drift (relative), and standard deviation of a drift that is drawn:
a clock never stops or runs backwards.
"""


@dataclass(frozen=True, eq=False)
class Drawn(Component):
    """A number that is drawn for each node from a normal law of mean 0 and deviation ``sigma``."""

    sigma: float = field(number(low=0.0, high=MAX_OFFSET))


def _number_or_drawn(largest: float, largest_sigma: float) -> Rule:
    one, sigma = number(low=-largest, high=largest), number(low=0.0, high=largest_sigma)

    def convert(value: Any) -> float | Drawn:
        if isinstance(value, Mapping) and set(value) == {"sigma"}:
            value = Drawn(sigma=sigma("sigma", value["sigma"]))
        if isinstance(value, Drawn):
            sigma("sigma", value.sigma)
            return value
        converted: float = one.convert(value)
        return converted

    table = {"type": "object", "properties": {"sigma": dict(sigma.schema)}, "required": ["sigma"]}
    return Rule(
        f"{one.requirement}, or a table with sigma",
        convert,
        "write a number, or { sigma = ... }",
        {"anyOf": [dict(one.schema), {**table, "additionalProperties": False}]},
    )


@dataclass(frozen=True, eq=False)
class NodeClock(Component):
    """The clocks of ``nodes``: at time t such a clock shows ``offset + (1 + drift) t`` seconds.

    offset  seconds that it shows at time 0
    drift   seconds that it gains in a second
            Both are a number, or { sigma = ... }: drawn for each node, normal, of mean 0
    """

    nodes: tuple[int, ...] = field(list_of(node_id(), "node ids"))
    offset: float | Drawn = field(_number_or_drawn(MAX_OFFSET, MAX_OFFSET), default=0.0)
    drift: float | Drawn = field(_number_or_drawn(MAX_DRIFT, MAX_SIGMA), default=0.0)

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless all nodes are in the graph."""
        demand_in_graph(self.nodes, topology)


class NodeTime(NamedTuple):
    """A node's clock in one run: it shows ``offset + pace t`` at t (s), on the ``grid``."""

    grid: TimeGrid
    offset: float = 0.0
    pace: float = 1.0

    def shows(self, time: float) -> float:
        """Return what the clock shows at ``time``, both in seconds."""
        return self.grid.instant(self.offset + self.pace * time)

    def time_of(self, shown: Any) -> Any:
        """Return the time at which the clock shows ``shown``, or times (K,), both in seconds."""
        return (shown - self.offset) / self.pace

    def ahead(self, clock: Clock) -> float:
        """Return how far ticks of a ``clock`` are ahead at time 0 (s): rows of a table and lattices
        are in local time, others count gaps from 0 on.
        """
        if isinstance(getattr(clock, "path", None), SourceFile):
            return -self.offset
        if isinstance(clock.gaps, Lattice):
            period = clock.gaps.period
            return float(np.floor(self.offset / period)) * period - self.offset
        return 0.0

    def until(self, time: float, ahead: float) -> float:
        """Return up to when ticks are drawn, in seconds of their law, that come before ``time``."""
        return self.pace * time - ahead

    def instants(self, ticks: FloatArray, ahead: float) -> FloatArray:
        """Return instants of ``ticks`` (K,), in s of their law, without those before the start.

        What the clock shows is snapped first: all that it does at one reading is one instant.
        """
        shown = self.grid.snap(ticks + (ahead + self.offset))
        times = self.grid.snap((shown - self.offset) / self.pace)
        # A row of a table may be at 0; others come after it.
        return times[times > 0.0] if ahead < 0.0 else times


def node_time(scenario: Any, streams: Any, node: int) -> NodeTime:
    """Return the clock of a node (id) in one run; a right one without ``network.clocks``."""
    grid = scenario.time_grid
    for entry in scenario.network.clocks:
        if node in entry.nodes:
            offset, drift = (
                value.sigma * float(streams.generator(f"clock {name}", node).standard_normal())
                if isinstance(value, Drawn)
                else value
                for name, value in (("offset", entry.offset), ("drift", entry.drift))
            )
            return NodeTime(grid, offset, 1.0 + drift)
    return NodeTime(grid)


def node_times(scenario: Any, streams: Any) -> dict[int, NodeTime]:
    """Return the clocks of all nodes by id; {} without ``network.clocks``."""
    nodes = scenario.nodes if scenario.network.clocks else ()
    return {node: node_time(scenario, streams, node) for node in nodes}


def owner_of(clock: LinkClock, entity: tuple[int, ...]) -> int:
    """Return whose clock ``entity`` ticks by, -1 without: a link has two ends, contacts none."""
    return -1 if clock.at == "links" or isinstance(clock, Contacts) else entity[0]
