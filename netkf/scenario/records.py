"""Checks of tables of recorded states, readings and exchanges, and the rows that a run uses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from netkf.core.csv_files import Columns
from netkf.core.errors import ScenarioError, errors_under
from netkf.core.fields import SourceFile
from netkf.core.places import Place
from netkf.core.printable import list_some
from netkf.core.repeated_rows import RowUse, add_uses, count_rows
from netkf.linalg.arrays import FloatArray
from netkf.network.contacts import Contacts
from netkf.network.matchings import RecordedSlots
from netkf.plants.inputs import RecordedInput
from netkf.plants.sensors import Sensor
from netkf.rng.streams import Streams
from netkf.scenario.block_sensors import support_of
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.sampling import all_sample_times, is_drawn_from, sample_times


def blocks_without_law(scenario: DerivedScenario) -> dict[Place, str]:
    """Return why errors of blocks have no known law: recorded or unknown states or readings."""
    reasons, n = {}, scenario.plant.n
    drawn = np.full(n, scenario.plant.draws)
    if not scenario.plant.is_random and scenario.plant.draws:
        drawn = scenario.plant.record.drawn
    read = [support_of(sensor, n) for sensor in scenario.sensors if not sensor.is_random]
    recorded = np.zeros(n, dtype=bool)
    recorded[np.concatenate([np.zeros(0, dtype=int), *read])] = True
    for place in scenario.layout.places:
        if scenario.unknown[place.entries].any():
            reasons[place] = "unknown"
        elif not drawn[place.entries].all():
            reasons[place] = "recorded"
        elif recorded[place.entries].any():
            reasons[place] = "with recorded readings"
    return reasons


def unjudged_line(scenario: DerivedScenario) -> str:
    """Return which blocks have errors without a known law and why, or an empty text."""
    reasons = blocks_without_law(scenario).items()
    return ", ".join(f"{place.label or 'the state'} is {why}" for place, why in reasons)


def nodes_with_law(scenario: DerivedScenario) -> np.ndarray:
    """Return a mask (N,) of nodes that neither estimate, read nor hear of what has no law."""
    lost = blocks_without_law(scenario)
    known = np.full(len(scenario.nodes), not lost)
    if not lost or scenario.node_filter.timing.pooled:
        return known
    without = np.zeros(scenario.plant.n, dtype=bool)
    for place in lost:
        without[place.entries] = True
    for k, node in enumerate(scenario.nodes):
        seen = [scenario.support(sensor) for sensor in scenario.placed_sensors.get(node, ())]
        known[k] = not any(without[part].any() for part in (scenario.view(k), *seen))
    index, changed = scenario.topology.index, scenario.node_filter.timing.talks
    while changed:
        before = known.sum()
        for sender, receiver in scenario.topology.directions:
            known[index[receiver]] &= known[index[sender]]
        changed = bool(known.sum() < before)
    return known


def check_records(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if a recorded table does not fit the scenario or lacks a needed row."""
    for k, sensor in enumerate(scenario.sensors):
        key = scenario.sensor_key(k)
        if sensor.record is not None:
            _check_readings(scenario, key, sensor)
        elif scenario.unknown[support_of(sensor, scenario.plant.n)].any() or (
            not scenario.plant.truth_known
        ):
            rule = "must be recorded where the plant's state is unknown"
            remedy = 'write kind = "recorded" and path = "readings.csv"'
            raise ScenarioError(f"{key}.kind", rule, None, remedy)
    for (key, plant), place in zip(scenario.all_plants, scenario.layout.places, strict=True):
        if scenario.links_follow_state and scenario.unknown[place.entries].any():
            rule = "must be drawn or recorded, since links follow positions"
            raise ScenarioError(f"{key}.kind", rule, "unknown", "leave kind out, or add path")
        slotted = scenario.slotted and plant.record is not None
        for slot in sorted(_state_slots(scenario, place)) if slotted else ():
            with errors_under(key):
                plant.record.require_times(np.array([slot * plant.period]), f"slot {slot}")
    if scenario.slotted and scenario.filter.algorithm.timing.talks:
        _check_exchanges(scenario)


def _check_readings(scenario: DerivedScenario, key: str, sensor: Sensor) -> None:
    record = sensor.record
    assert record is not None
    # Anchors at given positions need not be nodes.
    anchors = record.anchors if isinstance(getattr(sensor, "positions", None), str) else ()
    for name, ids, listed in (
        ("node", record.nodes, record.listed),
        ("to", record.columns.integers("to") if anchors else [], anchors),
    ):
        for node in listed:
            if node not in scenario.topology.index:
                where = f"in column {name} of line {record.columns.lines[ids.index(node)]}"
                rule = f"{record.path.name} names a node that the graph does not have, {where}"
                raise ScenarioError(f"{key}.path", rule, node, "correct the row or the graph")
    if scenario.slotted:
        with errors_under(key):
            for node in sensor.nodes:
                record.slots(node, scenario.slot_plant.period)


def sensed_slots(scenario: DerivedScenario) -> range:
    """Return the slots whose readings filters get: before the horizon if they predict; else from 1
    on, at the horizon only if its state is sampled.
    """
    plant = scenario.slot_plant
    # The first slot at or after the horizon; the quotient may be off by rounding.
    end = max(int(scenario.horizon / plant.period) - 1, 0)
    while not plant.over(end, scenario.horizon):
        end += 1
    if scenario.node_filter.timing.predicts:
        return range(end)
    return range(1, end + (end in scenario.sampled_slots))


def _check_exchanges(scenario: DerivedScenario) -> None:
    activation, node_filter = scenario.network.activation, scenario.node_filter
    if not isinstance(activation, RecordedSlots) or activation.matching:
        return
    # The schedule lists the phases of a slot; ``recorded`` counts only the exchanges among them.
    phases = node_filter.timing.exchanges
    for slot, phase, step in activation.recorded:
        steps = node_filter.timing.steps(phase) if phase < phases else 0
        if step >= steps:
            limits = " and ".join(
                f"{node_filter.timing.steps(k)} in phase {k}" for k in range(phases)
            )
            raise ScenarioError(
                "network.activation.path",
                f"{activation.path.name}: the filter has no such step, only {limits}",
                f"slot {slot}, phase {phase}, step {step}",
                "phases and steps count from 0; correct the row",
            )


def exchange_slots(scenario: DerivedScenario) -> range:
    """Return the slots with exchanges: from the filter's first to the last with readings."""
    return range(scenario.node_filter.timing.first_exchange, sensed_slots(scenario).stop)


def count_state_rows(scenario: DerivedScenario) -> dict[str, RowUse]:
    """Return the use of the rows of recorded states by key path."""
    if scenario.plant.record is None:
        return {}
    return _sum_by_key(
        (key, plant.record.columns, plant.record.use(_state_times(scenario, place).tolist()))
        for (key, plant), place in zip(scenario.all_plants, scenario.layout.places, strict=True)
        if plant.record is not None
    )


def count_input_rows(scenario: DerivedScenario) -> dict[str, RowUse]:
    """Return the use of the rows of recorded inputs by key path."""
    horizon, starts = scenario.horizon, None
    if scenario.slotted:
        # In slots u counts at their beginnings only.
        period = scenario.slot_plant.period
        starts = scenario.time_grid.before(horizon, period * np.arange(int(horizon / period) + 2))
    return _sum_by_key(
        (
            key,
            u.columns,
            count_rows(u.path.name, u.row_keys, u.used_keys(horizon, starts).__contains__),
        )
        for key, u in _recorded_inputs(scenario)
    )


def count_plant_rows(scenario: DerivedScenario) -> dict[str, RowUse]:
    """Return the use of the rows of recorded states and inputs if all are used, by key path."""
    tables = [
        (key, plant.record.columns, plant.record.row_keys)
        for key, plant in scenario.all_plants
        if plant.record is not None
    ]
    tables += [(key, u.columns, u.row_keys) for key, u in _recorded_inputs(scenario)]
    return _sum_by_key(
        (key, columns, count_rows(columns.source.name, keys, lambda _: True))
        for key, columns, keys in tables
    )


def _recorded_inputs(scenario: Any) -> Iterator[tuple[str, RecordedInput]]:
    for key, plant in scenario.all_plants:
        if isinstance(plant.input, RecordedInput):
            yield f"{key}.input", plant.input.on_grid(scenario.time_grid)


def _sum_by_key(uses: Iterable[tuple[str, Columns, RowUse]]) -> dict[str, RowUse]:
    """Return the use of tables by the keys that name them; rows of nodes that no block belongs to
    are unused under the first key.
    """
    by_key: dict[str, list[RowUse]] = {}
    parts: dict[SourceFile, list[tuple[str, Columns]]] = {}
    for key, columns, use in uses:
        by_key.setdefault(key, []).append(use)
        parts.setdefault(columns.source, []).append((key, columns))
    for source, owners in parts.items():
        key, columns = owners[0]
        taken = np.unique(np.concatenate([own.lines for _, own in owners]))
        by_key[key].append(RowUse(source.name, columns.file_rows - len(taken), 0, 0))
    return {key: add_uses(parts) for key, parts in by_key.items()}


def _state_times(scenario: DerivedScenario, place: Place) -> FloatArray:
    """Return the times (K,) in seconds at which replica 0 needs recorded states of a block."""
    if scenario.slotted:
        return scenario.slot_plant.period * np.array(sorted(_state_slots(scenario, place)))
    times = [scenario.times]
    if any(is_drawn_from(scenario, sensor, place) for sensor in scenario.sensors):
        times.append(all_sample_times(sample_times(scenario, Streams(scenario.seed))))
    return np.unique(np.concatenate(times))


def _state_slots(scenario: DerivedScenario, place: Place) -> set[int]:
    slots = {*scenario.sampled_slots}
    if any(is_drawn_from(scenario, sensor, place) for sensor in scenario.sensors):
        slots.update(sensed_slots(scenario))
    return slots.union(exchange_slots(scenario)) if scenario.links_follow_state else slots


def record_notes(scenario: DerivedScenario) -> tuple[str, ...]:
    """Return lines on exchanges in slots without any, and on contacts that overlap or miss."""
    activation = scenario.network.activation
    if isinstance(activation, Contacts):
        return activation.notes(scenario.topology)
    if not isinstance(activation, RecordedSlots) or not scenario.slotted:
        return ()
    used_slots = exchange_slots(scenario)
    unused_slots = sorted({slot for slot, _, _ in activation.recorded} - set(used_slots))
    if not unused_slots:
        return ()
    return (
        f"{activation.path.name}: rows of slot {list_some(unused_slots, 3)} are not used; there "
        f"are exchanges in slots {used_slots.start} to {used_slots.stop - 1}",
    )
