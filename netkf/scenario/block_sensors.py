"""Sensors of blocks: each as the sensors of the stacked state that stand for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError, errors_under, suggest_nearest
from netkf.core.places import Place
from netkf.core.printable import list_some
from netkf.core.repeated_rows import first_rows
from netkf.network.graphs import Topology
from netkf.plants.blocks import Layout
from netkf.plants.nonlinear import PositionedSensor
from netkf.plants.recorded import RecordedSensor
from netkf.plants.relative import RelativePositionSensor, RelativeSensor

STACKED = "_is_stacked"
"""The attribute of sensors that read the stacked state: the declared sensors they come from."""
RELATIVE = (RelativeSensor, RelativePositionSensor)


def require_no_blocks(sensors: Sequence[Any]) -> None:
    """Raise ScenarioError for a sensor of blocks where there are none."""
    for k, sensor in enumerate(sensors):
        if isinstance(sensor, RELATIVE):
            rule, remedy = "means nothing without [[plants]]", "give nodes blocks of their own"
            raise ScenarioError(f"[{k}].kind", rule, None, remedy)
        if getattr(sensor, "of", None) is not None:
            rule, remedy = "means nothing without [[plants]]", "leave it out"
            raise ScenarioError(f"[{k}].of", rule, sensor.of, remedy)


def stacked_sensors(
    sensors: Sequence[Any], layout: Layout, topology: Topology
) -> tuple[tuple[Any, ...], tuple[int, ...]]:
    """Return the sensors of the stacked state, and the index of the entry that each comes from;
    raises ScenarioError for a block that a node does not have, and for shapes that do not fit.
    """
    stacked, entries = [], []
    for k, sensor in enumerate(sensors):
        with errors_under(f"[{k}]"):
            for one in _of_blocks(sensor, layout, topology):
                if one is not sensor:
                    object.__setattr__(one, STACKED, sensors)
                    object.__setattr__(one, "held_out", sensor.held_out)
                    object.__setattr__(one, "fault", sensor.fault)
                stacked.append(one)
                entries.append(k)
    return tuple(stacked), tuple(entries)


def support_of(sensor: Any, n: int) -> np.ndarray:
    """Return the entries (k,) of a state of ``n`` that readings of a sensor depend on."""
    if not sensor.linear:
        anchors = (sensor.record.anchors if sensor.record is not None else ()) or sensor.nodes
        return np.unique(np.concatenate([sensor.support(n, one) for one in anchors]))
    matrices = [*getattr(sensor, "_pairs", {}).values()]
    if not matrices and not hasattr(sensor, "C"):
        matrices = [sensor.matrix_of(n)]
    if not matrices or (sensor.record is not None and sensor.record.regressors):
        return np.arange(n)
    return np.flatnonzero(np.concatenate(matrices).any(axis=0))


def unheard_notes(scenario: Any) -> tuple[str, ...]:
    """Return a line for each sensor of pairs with readings that nobody uses: neither the reader nor
    who hears it estimates the other block.
    """
    needs, notes = scenario.node_filter.needs, []
    if scenario.node_filter.timing.pooled or needs.coupled or not scenario.plants:
        return ()
    topology, estimated = scenario.topology, scenario.estimated
    for k, sensor in enumerate(scenario.declared_sensors):
        pairs = _pairs(sensor, scenario.layout, topology) if isinstance(sensor, RELATIVE) else ()
        unheard = []
        for own, other in pairs:
            users = own.node, *topology.receivers(own.node)
            if not any(other in estimated[topology.index[node]] for node in users):
                unheard.append(f"node {own.node} of {other.node}")
        if unheard:
            rule = "nobody who hears the reader estimates the block of the other"
            notes.append(f"sensors[{k}]: readings by {list_some(unheard, 3)} are not used: {rule}")
    return tuple(notes)


CHOICES = ("all", "own", "own+neighbours", "shared")


def estimated_blocks(
    estimates: str | tuple[str, ...], layout: Layout, topology: Topology
) -> tuple[tuple[Place, ...], ...]:
    """Return the blocks that each node estimates; raises ScenarioError for a node without any."""
    blocks = []
    for node in topology.nodes:
        if estimates == "all":
            own: tuple[Place, ...] = layout.places
        elif estimates == "shared":
            own = layout.shared
        elif estimates == "own":
            own = layout.owned(node)
        elif estimates == "own+neighbours":
            linked = {*topology.senders(node), *topology.receivers(node)}
            own = tuple(p for one in (node, *sorted(linked)) for p in layout.owned(one))
        else:
            names = (estimates,) if isinstance(estimates, str) else estimates
            if isinstance(estimates, str) and estimates not in layout.names:
                rule = 'must be "all", "own", "own+neighbours", "shared", or names of [[plants]]'
                listed = ", ".join(f'"{name}"' for name in layout.names)
                remedy = (
                    f"{suggest_nearest(estimates, (*CHOICES, *layout.names))}names are {listed}"
                )
                raise ScenarioError("", rule, estimates, remedy)
            # Of the blocks of these names those that the node has.
            own = tuple(
                layout.require(name, node)
                for name in dict.fromkeys(names)
                if name not in layout.names or layout.find(name, node) is not None
            )
        named = layout.find(str(estimates), node) if estimates in CHOICES[1:] else None
        if named is not None and own != (named,):
            rule = "is a word for other blocks than the one of that name"
            raise ScenarioError("", rule, estimates, f'write ["{estimates}"], or name it otherwise')
        if not own:
            rule = f"must give every node a block, and node {node} has none"
            raise ScenarioError("", rule, estimates, "give it one in [[plants]], or choose others")
        blocks.append(own)
    return tuple(blocks)


def _of_blocks(sensor: Any, layout: Layout, topology: Topology) -> Iterator[Any]:
    if isinstance(sensor, RELATIVE):
        pairs = list(_pairs(sensor, layout, topology))
        if not pairs:
            rule = "must be others to read: no reader has a link to another node with its block"
            remedy = "add links, name another block in of, or write to = [[reader, other], ...]"
            raise ScenarioError("to", rule, sensor.to, remedy)
        yield from sensor.lowered(layout, pairs)
        return
    name = _name_of(sensor, layout)
    if name is None:
        yield sensor
        return
    nodes: dict[Place, list[int]] = {}
    for node in sensor.nodes:
        with errors_under("of"):
            whose = f"node {node}"
            if sensor.record is not None and node in sensor.record.nodes:
                whose += f" of {sensor.record.columns.where(sensor.record.nodes.index(node))}"
            nodes.setdefault(layout.require(name, node, whose), []).append(node)
    for place, readers in nodes.items():
        yield _for_block(sensor, place, tuple(readers), layout)


def _name_of(sensor: Any, layout: Layout) -> str | None:
    name = getattr(sensor, "of", None)
    if name is not None:
        return str(name)
    H = getattr(sensor, "H", None)
    whole = H is not None and H.shape[1] == layout.n
    if whole or not hasattr(type(sensor), "of"):
        return None
    if len(layout.names) > 1:
        listed = ", ".join(f'"{one}"' for one in layout.names)
        remedy = f"write of = ..., one of {listed}"
        raise ScenarioError("of", "is missing, and there are several [[plants]]", None, remedy)
    return layout.names[0]


def _for_block(sensor: Any, place: Place, nodes: tuple[int, ...], layout: Layout) -> Any:
    """Return a sensor of a block as one of the stacked state, on ``nodes`` alone."""
    if isinstance(sensor, PositionedSensor):
        if max(sensor.states) >= place.n:
            rule = f"must be components of block {place.name!r}, which has {place.n}"
            raise ScenarioError("states", rule, list(sensor.states), "they count from 0")
        sensor.check_state(place.n)
        states = tuple(place.first + s for s in sensor.states)
        heading = None if sensor.heading is None else place.first + sensor.heading
        positions = sensor.positions
        if not isinstance(positions, str) and sensor.places == sensor.nodes:
            positions = positions[[sensor.nodes.index(node) for node in nodes]]
        own = {"nodes": nodes, "states": states, "heading": heading, "positions": positions}
        return dataclasses.replace(sensor, of=None, **own)  # type: ignore[arg-type]
    if isinstance(sensor, RecordedSensor) and sensor.record.regressors:
        rule, remedy = "cannot have columns phi for a block", "write H, or one plant for all"
        raise ScenarioError("path", rule, sensor.path.name, remedy)
    H = sensor.H
    if H.shape[1] != place.n:
        rule = f"must have {place.n} columns, because block {place.name!r} has {place.n} components"
        raise ScenarioError("H", rule, H, "correct it")
    return dataclasses.replace(sensor, nodes=nodes, H=layout.embed([(place, H)]), of=None)


def _pairs(sensor: Any, layout: Layout, topology: Topology) -> Iterator[tuple[Place, Place]]:
    """Yield the blocks of the pairs that a relative sensor reads, that of the reader first."""
    name = sensor.of
    owned = dict.fromkeys(place.name for place in layout.places if place.node is not None)
    listed = ", ".join(f'"{one}"' for one in owned)
    if name is None:
        if len(owned) != 1:
            remedy = f"write of = ..., one of {listed}" if owned else "give [[plants]] nodes"
            raise ScenarioError("of", "is missing, the block that is read", None, remedy)
        name = next(iter(owned))
    if name not in owned:
        remedy = f"{suggest_nearest(name, owned)}names are {listed}" if owned else "give it nodes"
        raise ScenarioError("of", "must be the name of [[plants]] with nodes", name, remedy)
    owners = {p.node: p for p in layout.places if p.name == name and p.node is not None}
    nodes = sensor.nodes or () if sensor.record is None else ()
    if len(set(nodes)) < len(nodes):
        remedy = "write a second [[sensors]] entry for a second sensor"
        raise ScenarioError("nodes", "must name each node once", list(nodes), remedy)
    for k, node in enumerate(nodes):
        _require_owner(f"nodes[{k}]", "", node, name, owners)
    seen = set()
    for key, where, reader, other in _targets(sensor, topology, list(owners)):
        for node in (reader, other):
            _require_owner(key, where, node, name, owners)
        if reader == other:
            raise ScenarioError(key, f"{where}must be two nodes", reader, "correct the pair")
        if (reader, other) in seen:
            raise ScenarioError(key, "must be another pair", [reader, other], "list it once")
        seen.add((reader, other))
        yield owners[reader], owners[other]


def _require_owner(key: str, where: str, node: int, name: str, owners: Mapping[int, Place]) -> None:
    if node not in owners:
        rule = f"{where}must be nodes with a block {name!r} of their own"
        remedy = f"nodes with it are {', '.join(map(str, owners))}"
        raise ScenarioError(key, rule, node, remedy)


def _targets(
    sensor: Any, topology: Topology, owners: Sequence[int]
) -> Iterator[tuple[str, str, int, int]]:
    """Yield the key that names a pair, the line of a table that does, and the pair."""
    if sensor.record is not None:
        table = sensor.record
        pairs = zip(table.nodes, table.columns.integers("to"), strict=True)
        for (i, j), row in first_rows(table.columns, pairs).items():
            if i in sensor.nodes:
                yield "path", f"{table.columns.where(row)}: ", i, j
        return
    if not isinstance(sensor.to, str):
        for k, (i, j) in enumerate(sensor.to):
            if sensor.nodes is not None and i not in sensor.nodes:
                rule = "must begin with one of the nodes of this sensor"
                raise ScenarioError(f"to[{k}]", rule, i, "add it to nodes, or leave nodes out")
            yield f"to[{k}]", "", i, j
        return
    linked: dict[int, set[int]] = {}
    for i, j in topology.links:
        linked.setdefault(i, set()).add(j)
        linked.setdefault(j, set()).add(i)
    for i in owners if sensor.nodes is None else sensor.nodes:
        yield from (("to", "", i, j) for j in sorted(linked.get(i, set()) & set(owners)))
