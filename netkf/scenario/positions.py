"""Where the nodes of a scenario are, and when that must be known."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from netkf.core.clock import generate_ticks
from netkf.core.csv_files import read_columns
from netkf.core.errors import ScenarioError, errors_under
from netkf.core.printable import NamedNode
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.clocks import LinkClock
from netkf.network.node_clocks import node_time, owner_of
from netkf.network.positions import Positions, PositionTable, read_positions
from netkf.rng.streams import Streams

PLACE = "add position = [...] to the [[plants]] of these nodes, or network.positions"


def placed_nodes(scenario: Any) -> list[int | str]:
    """Return nodes, by id or name, whose place plants or ``network.positions`` say."""
    listed = [
        node
        for block in scenario.plants
        for node in (block.nodes or () if block.position is not None else ())
    ]
    source = scenario.network.positions
    if source is not None:
        with errors_under("network.positions"):
            ids = read_columns(source, ("node",), new_nodes=True).integers("node")
        # Numbers below 0 stand for names.
        names = {code: name for name, code in source.unknown.items()}
        listed += [names.get(node, node) for node in ids]
    return list(dict.fromkeys(str(n) if isinstance(n, NamedNode) else n for n in listed))


def table_of_positions(scenario: Any) -> PositionTable | None:
    """Return the table ``network.positions``, or None; raises ScenarioError for a mistake."""
    source = scenario.network.positions
    if source is None:
        return None
    try:
        table = read_positions(source, scenario.topology, scenario.time_grid)
    except ScenarioError as error:
        raise ScenarioError("network.positions", error.rule, error.value, error.remedy) from None
    moved = _entries_of_nodes(scenario)
    twice = [node for node in table.rows if node in moved]
    missing = [node for node in scenario.nodes if node not in table.rows and node not in moved]
    if twice:
        rule = f"{source.name} must leave out nodes whose place is part of the state"
        remedy = "delete their rows, or position of their [[plants]]"
        raise ScenarioError("network.positions", rule, twice, remedy)
    if missing:
        rule = f"{source.name} must place every node"
        raise ScenarioError("network.positions", rule, missing, "add their rows")
    return table


def positions_of(scenario: Any) -> Positions:
    """Return where nodes are: by plants, else by ``network.positions``, else by the graph."""
    entries, table = _entries_of_nodes(scenario), scenario.position_table
    points = scenario.topology.positions if table is None else table.points
    fixed = {k: xy for k, xy in (points or {}).items() if k not in entries}
    sizes = {len(one) for one in entries.values()} | ({2} if fixed else set())
    if len(sizes) > 1:
        k = next(k for k, block in enumerate(scenario.plants) if block.position is not None)
        rule = "must be as many coordinates as other nodes have"
        given = scenario.plants[k].position
        raise ScenarioError(f"plants[{k}].position", rule, list(given), "give all two, say")
    return Positions(fixed, table, entries)


def _entries_of_nodes(scenario: Any) -> dict[int, IntArray]:
    """Return which entries of the stacked state are the coordinates of each node that says so."""
    entries: dict[int, IntArray] = {}
    for k, block in enumerate(scenario.plants):
        with errors_under(f"plants[{k}]"):
            block.check_position()
        for node in block.nodes or () if block.position is not None else ():
            if node in entries:
                rule = f"must not place node {node} again"
                given = list(block.position)
                raise ScenarioError(f"plants[{k}].position", rule, given, "leave one of them out")
            first = scenario.layout.find(block.name, node).first
            entries[node] = first + np.array(block.position, dtype=np.int64)
    return entries


def check_positions(scenario: Any, on_grid: bool) -> None:
    """Raise ScenarioError unless it is known where nodes are, if messages depend on it."""
    loss, positions = scenario.network.channel.loss, scenario.positions
    if not loss.follows_distance and scenario.topology.radius is None:
        return
    key = "network.channel.loss" if loss.follows_distance else "network.graph"
    missing = [node for node in scenario.nodes if not positions.has(node)]
    if missing:
        rule = "needs the distances of nodes, and it is not known where these are"
        raise ScenarioError(key, rule, missing, PLACE)
    if on_grid and positions.of_state:
        k = next(k for k, block in enumerate(scenario.plants) if block.position is not None)
        rule = "cannot say who hears whom where sensors give increments, only where they sample"
        remedy = 'write sampling = { kind = "periodic", period = ... } in all [[sensors]]'
        given = list(scenario.plants[k].position)
        raise ScenarioError(f"plants[{k}].position", rule, given, remedy)


def tick_times(scenario: Any, streams: Streams) -> FloatArray:
    """Return the instants (K,) of ticks of a clock in a run; of samples if these trigger."""
    clock = scenario.network.activation
    entities = clock.entities(scenario.topology) if isinstance(clock, LinkClock) else ()
    instants = [np.empty(0), *(ticks_of(scenario, streams, entity) for entity in entities)]
    return np.asarray(
        scenario.time_grid.before(scenario.horizon, np.unique(np.concatenate(instants)))
    )


def ticks_of(scenario: Any, streams: Streams, entity: tuple[int, ...]) -> FloatArray:
    """Return the instants (K,), in seconds, at which the clock of an ``entity`` ticks."""
    clock = scenario.network.activation
    phase = partial(streams.generator, "phase", *entity)
    random = streams.generator("clock", *entity)
    own = node_time(scenario, streams, owner_of(clock, entity))
    ahead = own.ahead(clock)
    until = own.until(scenario.horizon, ahead)
    return own.instants(generate_ticks(clock, entity, phase, random, until), ahead)
