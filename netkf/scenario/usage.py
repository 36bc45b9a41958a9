"""Counts of the rows of recorded tables that a run uses, and of messages that no table lists."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from netkf.core.repeated_rows import RowUse, count_rows
from netkf.network.clocks import RecordedClock
from netkf.network.contacts import Contacts
from netkf.network.graphs import Link
from netkf.network.lives import RecordedLife
from netkf.network.losses import GilbertElliott
from netkf.network.matchings import RecordedSlots
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.network.scheduled import ScheduledLoss
from netkf.plants.readings import ReadingTable
from netkf.plants.sampling import RecordedSampling
from netkf.scenario import records
from netkf.scenario.derived import DerivedScenario

Used = Callable[[Any], bool]
Use = dict[str, Any]
"""The use of one table: ``path``, ``rows``, ``used``, ``merged``, ``unused``, and for losses and
delays ``beyond`` and ``after``; see ``record_usage``.
"""
OUTCOMES = {
    "deliver": "were delivered",
    "lose": "were lost",
    "repeat": "followed the record from its start again",
}
"""What happened to messages that a table of losses does not list, by its ``after``; with "refuse"
no run ends that needed one: delays of lost messages are not needed.
"""
NO_DELAY = "took no time unless lost"
"""What happened to messages that a table of delays with ``after`` "deliver" does not list."""


def record_usage(scenario: DerivedScenario, sent: Mapping[Link, int] | None) -> dict[str, Use]:
    """Return the use of each table by a run to the horizon, by the first key that names it.

    ``sent`` counts the messages of each directed link, lost ones included; None leaves out the
    tables of losses and delays. Each entry has ``path`` and ``rows``, the sum of ``used``,
    ``merged`` (with rows that they repeat) and ``unused``. Those of losses and delays have
    ``beyond``, messages that are not listed, and ``after``, what becomes of these.
    Tables of graphs and positions have entries only if rows repeat others or are unused.
    """
    uses = {
        f"network.graph{key}": _make_use(use)
        for key, use in scenario.topology.tables.items()
        if use.used < use.rows
    }
    if scenario.position_table is not None:
        uses["network.positions"] = _make_use(scenario.position_table.use(scenario.horizon))
    if activation := _activation_table(scenario):
        uses["network.activation"] = _make_use(count_rows(*activation[1:]))
    channel = scenario.network.channel
    uses |= {key: _make_use(use) for key, (_, use) in _find_law_uses(scenario).items()}
    for key, component in (("loss", channel.loss), ("delay", channel.delay)):
        if sent is not None and isinstance(component, RecordedLoss | RecordedDelay):
            rows, beyond = component.table.use(sent)
            more = {"beyond": beyond, "after": component.after}
            uses[f"network.channel.{key}"] = _make_use(rows) | more
    uses |= {key: _make_use(use) for key, use in _find_sensor_uses(scenario).items()}
    plant_uses = records.count_state_rows(scenario) | records.count_input_rows(scenario)
    return uses | {key: _make_use(use) for key, use in plant_uses.items()}


def usage_notes(usage: Mapping[str, Use]) -> tuple[str, ...]:
    """Return a line for each table with unused rows or messages not listed."""
    notes = []
    for key, use in usage.items():
        if use["unused"]:
            was = "row was" if use["rows"] == 1 else "rows were"
            notes.append(f"{key}: {use['unused']} of {use['rows']} {was} not used ({use['path']})")
        if use.get("beyond") and use["after"] in OUTCOMES:
            count, outcome = use["beyond"], OUTCOMES[use["after"]]
            if key.endswith("delay") and use["after"] == "deliver":
                outcome = NO_DELAY
            subject = "message is" if count == 1 else "messages are"
            outcome = outcome.replace("were", "was", 1) if count == 1 else outcome
            notes.append(f"{key}: {count} {subject} not listed and {outcome} ({use['path']})")
    return tuple(notes)


def unused_notes(scenario: DerivedScenario, without_states: bool = False) -> tuple[str, ...]:
    """Return a line for each table with rows that no run uses, but losses and delays."""
    usage = record_usage(scenario, sent=None)
    for key in records.count_state_rows(scenario) if without_states else ():
        del usage[key]
    return usage_notes(usage)


def repeat_notes(scenario: DerivedScenario) -> tuple[str, ...]:
    """Return a line for each table with rows that repeat others and are merged with them."""
    channel = scenario.network.channel
    # By key path: what rows repeat, the name of the file, and a key of each row.
    tables: dict[str, tuple[str, str, Sequence[Any]]] = {}
    if activation := _activation_table(scenario):
        tables["network.activation"] = activation[:3]
    for key, component in (("loss", channel.loss), ("delay", channel.delay)):
        if isinstance(component, RecordedLoss | RecordedDelay):
            table = component.table
            tables[f"network.channel.{key}"] = "message", table.source.name, table.row_keys
    for k, sensor in enumerate(scenario.sensors):
        clock = getattr(sensor, "sampling", None)
        if isinstance(clock, RecordedSampling):
            key = f"{scenario.sensor_key(k)}.sampling"
            tables[key] = "node and time", clock.path.name, _instants(scenario, clock.row_times)
    positions = scenario.position_table
    if positions is not None:
        what = "node and time" if positions.timed else "node"
        tables["network.positions"] = what, positions.path, positions.row_keys
    uses = [
        (f"network.graph{key}", "node" if key else "link", use)
        for key, use in scenario.topology.tables.items()
    ]
    uses += [(key, "time", use) for key, use in records.count_plant_rows(scenario).items()]
    uses += [(key, what, use) for key, (what, use) in _find_law_uses(scenario).items()]
    for key, (what, path, keys) in tables.items():
        uses.append((key, what, count_rows(path, keys, lambda _: True)))
    # A table that several sensors name is told once.
    merged = {(what, use): key for key, what, use in reversed(uses) if use.merged}
    return tuple(
        f"{key}: {use.merged} of {use.rows} rows repeat the {what} of an earlier row and are "
        f"merged with it ({use.path})"
        for (what, use), key in reversed(merged.items())
    )


def _instants(
    scenario: DerivedScenario, rows: Sequence[tuple[Any, float]], start: float = 0.0
) -> list[tuple[Any, float, bool]]:
    """Return whose each of ``rows`` is, its instant in the run, and if its time is after start."""
    # A row without any value has no time.
    times = scenario.time_grid.snap(np.nan_to_num(np.array([t for _, t in rows])))
    return [(who, at, t > start) for (who, t), at in zip(rows, times.tolist(), strict=True)]


def _make_use(use: RowUse) -> Use:
    return {**use._asdict(), "unused": use.unused}


def _activation_table(scenario: DerivedScenario) -> tuple[str, str, Sequence[Any], Used] | None:
    """Return what rows of recorded ticks repeat, their file, their keys, and which are used."""
    activation, talks = scenario.network.activation, scenario.filter.algorithm.timing.talks
    end = scenario.horizon if talks else 0.0
    if isinstance(activation, RecordedClock):
        what, keys = f"{activation.at.removesuffix('s')} and time", activation.row_keys
        ticks = _instants(scenario, keys)
        return what, activation.path.name, ticks, lambda key: key[2] and key[1] < end
    if isinstance(activation, Contacts):
        what, rows = f"{activation.at.removesuffix('s')} and interval", activation.row_keys
        return what, activation.path.name, rows, lambda key: key[1] < end and key[2] > 0.0
    if isinstance(activation, RecordedSlots):
        slots, path = records.exchange_slots(scenario) if talks else range(0), activation.path.name
        return "slot and link", path, activation.row_keys, lambda key: key[0] in slots
    return None


def _find_law_uses(scenario: DerivedScenario) -> dict[str, tuple[str, RowUse]]:
    """Return what rows repeat, and their use, for tables of lives and of laws of losses, by key."""
    network, end = scenario.network, scenario.end_time
    uses = {
        f"network.lives[{k}]": ("node and time", life.use(end))
        for k, life in enumerate(network.lives)
        if isinstance(life, RecordedLife)
    }
    end = end if scenario.filter.algorithm.timing.talks else 0.0
    loss, hopping = network.channel.loss, network.channel.channels
    if isinstance(loss, ScheduledLoss):
        uses["network.channel.loss"] = "link and interval", loss.use(end)
    elif isinstance(loss, GilbertElliott) and loss.path is not None:
        uses["network.channel.loss"] = "link", loss.use(end)
    if hopping is not None:
        uses["network.channel.channels"] = "channel", hopping.use(end)
    return uses


def _find_sensor_uses(scenario: DerivedScenario) -> dict[str, RowUse]:
    nodes: dict[tuple[str, Any], set[int]] = {}
    components: dict[tuple[str, Any], tuple[str, RecordedSampling | ReadingTable]] = {}
    for k, sensor in enumerate(scenario.sensors):
        component: RecordedSampling | ReadingTable
        if sensor.record is not None:
            key, component = scenario.sensor_key(k), sensor.record
        elif isinstance(sampling := getattr(sensor, "sampling", None), RecordedSampling):
            key, component = f"{scenario.sensor_key(k)}.sampling", sampling
        else:
            continue
        table = (type(component).__name__, component.path)
        components.setdefault(table, (key, component))
        nodes.setdefault(table, set()).update(sensor.nodes)
    return {
        key: _find_row_use(scenario, component, nodes[table])
        for table, (key, component) in components.items()
    }


def _find_row_use(
    scenario: DerivedScenario, component: RecordedSampling | ReadingTable, nodes: set[int]
) -> RowUse:
    rows, horizon = component.row_times, scenario.horizon
    # Rows of a sampling that tell a node twice to sample at one time are one sample; readings are
    # told apart by their row.
    is_reading = isinstance(component, ReadingTable)
    if scenario.slotted:
        slots, period = records.sensed_slots(scenario), scenario.slot_plant.period
        return count_rows(
            component.path.name,
            [(node, t, row) for row, (node, t) in enumerate(rows)],
            # A row without any value has no time.
            lambda key: key[0] in nodes and key[1] >= 0.0 and round(key[1] / period) in slots,
        )
    # A sampling clock ticks after time 0 only.
    instants = _instants(scenario, rows, -math.ulp(0.0) if is_reading else 0.0)
    keys = [(*key, row if is_reading else 0) for row, key in enumerate(instants)]
    return count_rows(
        component.path.name, keys, lambda key: key[0] in nodes and key[2] and key[1] < horizon
    )
