"""The use that a run makes of the tables of its scenario."""

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
from netkf.plants.sensors import LinearSensor
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.records import count_state_rows, exchange_slots, sensed_slots

Use = dict[str, Any]
OUTCOMES = {
    "deliver": "were delivered",
    "lose": "were lost",
    "repeat": "followed the record from its start again",
}
"""The treatment of messages beyond a record, by its ``after``."""
NO_DELAY = "took no time unless lost"
"""The treatment of messages beyond a record of delays with ``after`` "deliver"."""


def record_usage(scenario: DerivedScenario, sent: Mapping[Link, int] | None) -> dict[str, Use]:
    """Return the use of each table by a run to the horizon, by key path of its component.

    ``sent`` counts the messages of each directed link, lost ones included; None leaves out the
    tables of messages, whose use differs from run to run. Each entry has ``path``,
    ``rows`` of the table and how many of them were ``unused``; those of losses and delays also have
    ``beyond``, the messages that the table does not list, and ``after``. Of a table that several
    sensors name a row is used if one of them uses it; the first one names the entry.
    """
    found = {"network.activation": _activation(scenario)}
    channel = scenario.network.channel
    for key, part in (("loss", channel.loss), ("delay", channel.delay)):
        if sent is not None and isinstance(part, RecordedLoss | RecordedDelay):
            use = part.table.use(sent)
            beyond = {"beyond": use.beyond, "after": part.after}
            found[f"network.channel.{key}"] = _use(part.path.name, use.rows, use.unused) | beyond
    found |= _sensors(scenario)
    states = count_state_rows(scenario)
    if states is not None:
        path, rows, used = states
        found["plant"] = _use(path, rows, rows - used)
    return {key: use for key, use in found.items() if use is not None}


def usage_notes(usage: Mapping[str, Use]) -> tuple[str, ...]:
    """Return a line for each table with unused rows, or with messages beyond it."""
    notes = []
    for key, use in usage.items():
        if use["unused"]:
            was = "row was" if use["rows"] == 1 else "rows were"
            notes.append(f"{key}: {use['unused']} of {use['rows']} {was} not used ({use['path']})")
        if use.get("beyond"):
            count, outcome = use["beyond"], OUTCOMES.get(use["after"], "were refused")
            if key.endswith("delay") and use["after"] == "deliver":
                outcome = NO_DELAY
            what = "message is" if count == 1 else "messages are"
            outcome = outcome.replace("were", "was", 1) if count == 1 else outcome
            notes.append(f"{key}: {count} {what} not listed and {outcome} ({use['path']})")
    return tuple(notes)


def _use(path: str, rows: int, unused: int) -> Use:
    """Return the use of a recorded file: its rows, and those that no run uses."""
    return {"path": path, "rows": rows, "unused": unused}


def _activation(scenario: DerivedScenario) -> Use | None:
    """Return the use of a recorded activation, None for others."""
    activation, talks = scenario.network.activation, scenario.filter.algorithm.talks
    if isinstance(activation, RecordedClock):
        rows = activation.rows
        used = int((rows < scenario.horizon).sum()) if talks else 0
        return _use(activation.path.name, len(rows), len(rows) - used)
    if isinstance(activation, RecordedSlots):
        slots = exchange_slots(scenario) if talks else range(0)
        counts = {key: len(activation.pairs(*key)) for key in activation.recorded}
        unused = sum(count for (slot, _, _), count in counts.items() if slot not in slots)
        return _use(activation.path.name, sum(counts.values()), unused)
    return None


def _sensors(scenario: DerivedScenario) -> dict[str, Use]:
    """Return the use of sampling times and readings; tables are told apart by their files."""
    nodes: dict[tuple[str, Any], set[int]] = {}
    parts: dict[tuple[str, Any], tuple[str, RecordedSampling | RecordedSensor]] = {}
    for k, sensor in enumerate(scenario.sensors):
        part: RecordedSampling | RecordedSensor
        if isinstance(sensor, RecordedSensor):
            key, part = f"sensors[{k}]", sensor
        elif isinstance(sensor, LinearSensor) and isinstance(sensor.sampling, RecordedSampling):
            key, part = f"sensors[{k}].sampling", sensor.sampling
        else:
            continue
        table = (type(part).__name__, part.path)
        parts.setdefault(table, (key, part))
        nodes.setdefault(table, set()).update(sensor.nodes)
    return {key: _times(scenario, part, nodes[table]) for table, (key, part) in parts.items()}


def _times(
    scenario: DerivedScenario, part: RecordedSampling | RecordedSensor, nodes: set[int]
) -> Use:
    """Return the use of recorded sampling times or readings of some nodes."""
    if isinstance(part, RecordedSensor):
        listed = part.row_times
    else:
        listed = [(node, t) for node in part.listed for t in part.recorded_times(node).tolist()]
    times = np.array([t for node, t in listed if node in nodes])
    if scenario.slotted:
        slots = np.round(times / scenario.slot_plant.period)
        used = int(np.isin(slots, list(sensed_slots(scenario))).sum())
    else:
        used = int((times < scenario.horizon).sum())
    return _use(part.path.name, len(listed), len(listed) - used)
