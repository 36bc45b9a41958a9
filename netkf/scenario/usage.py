"""Counts of the rows of recorded tables that a run uses, and of messages that no table lists."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from netkf.network.clocks import RecordedClock
from netkf.network.graphs import Link
from netkf.network.matchings import RecordedSlots
from netkf.network.recorded import RecordedDelay, RecordedLoss
from netkf.plants.recorded import RecordedSensor
from netkf.plants.sampling import RecordedSampling
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.records import count_state_rows, exchange_slots, sensed_slots

Use = dict[str, Any]
"""The use of one table: ``path``, ``rows``, ``unused`` and, for losses and delays, ``beyond`` and
``after``; see ``record_usage``.
"""
OUTCOMES = {
    "deliver": "were delivered",
    "lose": "were lost",
    "repeat": "followed the record from its start again",
}
"""What happened to messages that a table of losses does not list, by its ``after``."""
NO_DELAY = "took no time unless lost"
"""What happened to messages that a table of delays with ``after`` "deliver" does not list."""


def record_usage(scenario: DerivedScenario, sent: Mapping[Link, int] | None) -> dict[str, Use]:
    """Return the use of each table by a run to the horizon, by key path of its component.

    ``sent`` counts the messages of each directed link, lost ones included; None leaves out the
    tables of losses and delays, whose use differs from run to run. Each entry has ``path``, the
    name of the file, ``rows``, the number of its rows, and ``unused``, how many of them the run did
    not use; those of losses and delays also have ``beyond``, the number of messages that the table
    does not list, and ``after``, what the scenario says about these.

    Several sensors may name one table: its entry has the key of the first one, and a row is used
    if any of them uses it.
    """
    uses = {"network.activation": _find_activation_use(scenario)}
    channel = scenario.network.channel
    for key, component in (("loss", channel.loss), ("delay", channel.delay)):
        if sent is not None and isinstance(component, RecordedLoss | RecordedDelay):
            counts = component.table.use(sent)
            use = _make_use(component.path.name, counts.rows, counts.unused)
            use |= {"beyond": counts.beyond, "after": component.after}
            uses[f"network.channel.{key}"] = use
    uses |= _find_sensor_uses(scenario)
    state_rows = count_state_rows(scenario)
    if state_rows is not None:
        path, rows, used = state_rows
        uses["plant"] = _make_use(path, rows, rows - used)
    return {key: use for key, use in uses.items() if use is not None}


def usage_notes(usage: Mapping[str, Use]) -> tuple[str, ...]:
    """Return a line for each table with unused rows, and for each with messages not listed, from
    the result of ``record_usage``: notes below the summary of a run.
    """
    notes = []
    for key, use in usage.items():
        if use["unused"]:
            was = "row was" if use["rows"] == 1 else "rows were"
            notes.append(f"{key}: {use['unused']} of {use['rows']} {was} not used ({use['path']})")
        if use.get("beyond"):
            count, outcome = use["beyond"], OUTCOMES.get(use["after"], "were refused")
            if key.endswith("delay") and use["after"] == "deliver":
                outcome = NO_DELAY
            subject = "message is" if count == 1 else "messages are"
            outcome = outcome.replace("were", "was", 1) if count == 1 else outcome
            notes.append(f"{key}: {count} {subject} not listed and {outcome} ({use['path']})")
    return tuple(notes)


def _make_use(path: str, rows: int, unused: int) -> Use:
    """Return the use of the table in the file ``path``: its number of ``rows``, and of those
    ``unused``.
    """
    return {"path": path, "rows": rows, "unused": unused}


def _find_activation_use(scenario: DerivedScenario) -> Use | None:
    """Return the use of the table of a recorded activation, None for other activations."""
    activation, talks = scenario.network.activation, scenario.filter.algorithm.talks
    if isinstance(activation, RecordedClock):
        row_times = activation.rows
        used = int((row_times < scenario.horizon).sum()) if talks else 0
        return _make_use(activation.path.name, len(row_times), len(row_times) - used)
    if isinstance(activation, RecordedSlots):
        slots = exchange_slots(scenario) if talks else range(0)
        counts = {key: len(activation.pairs(*key)) for key in activation.recorded}
        unused = sum(count for (slot, _, _), count in counts.items() if slot not in slots)
        return _make_use(activation.path.name, sum(counts.values()), unused)
    return None


def _find_sensor_uses(scenario: DerivedScenario) -> dict[str, Use]:
    """Return the uses of tables of sampling times and of readings, by key path.

    Sensors with the same file share one entry.
    """
    nodes: dict[tuple[str, Any], set[int]] = {}
    components: dict[tuple[str, Any], tuple[str, RecordedSampling | RecordedSensor]] = {}
    for k, sensor in enumerate(scenario.sensors):
        component: RecordedSampling | RecordedSensor
        if isinstance(sensor, RecordedSensor):
            key, component = f"sensors[{k}]", sensor
        elif isinstance(sampling := getattr(sensor, "sampling", None), RecordedSampling):
            key, component = f"sensors[{k}].sampling", sampling
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
    scenario: DerivedScenario, component: RecordedSampling | RecordedSensor, nodes: set[int]
) -> Use:
    """Return the use of a table of sampling times or readings by the sensors of ``nodes``."""
    if isinstance(component, RecordedSensor):
        rows = component.row_times
    else:
        rows = [
            (node, t) for node in component.listed for t in component.recorded_times(node).tolist()
        ]
    times = np.array([t for node, t in rows if node in nodes])
    if scenario.slotted:
        slots = np.round(times / scenario.slot_plant.period)
        used = int(np.isin(slots, list(sensed_slots(scenario))).sum())
    else:
        used = int((times < scenario.horizon).sum())
    return _make_use(component.path.name, len(rows), len(rows) - used)
