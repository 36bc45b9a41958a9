"""Checks of recorded states, readings and exchanges, and the slots that use them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.network.matchings import RecordedSlots
from netkf.plants.recorded import RecordedDiffusion, RecordedPlant, RecordedSensor
from netkf.plants.truth import TOLERANCE
from netkf.rng.streams import Streams
from netkf.scenario.derived import DerivedScenario
from netkf.scenario.sampling import all_sample_times, sample_times


def check_records(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if a table does not fit or lacks a row that a run needs."""
    for k, sensor in enumerate(scenario.sensors):
        key = f"sensors[{k}]"
        if isinstance(sensor, RecordedSensor):
            _check_readings(scenario, key, sensor)
        elif not scenario.plant.truth_known:
            raise ScenarioError(
                f"{key}.kind",
                "must be recorded where the plant's state is unknown",
                None,
                'write kind = "recorded" and path = "readings.csv"',
            )
    plant = scenario.plant
    if isinstance(plant, RecordedPlant):
        _check_under("plant", lambda: plant.demand(sorted(_state_slots(scenario))))
    if scenario.slotted and scenario.filter.algorithm.talks:
        _check_exchanges(scenario)


def _check_under(key: str, check: Callable[[], None]) -> None:
    """Call a check; errors that it raises get ``key`` in front of their own."""
    try:
        check()
    except ScenarioError as error:
        raise error.under(key) from None


def _check_readings(scenario: DerivedScenario, key: str, sensor: RecordedSensor) -> None:
    """Raise ScenarioError if recorded readings do not fit nodes or slots."""
    for node in sensor.listed:
        if node not in scenario.topology.index:
            rule = f"{sensor.path.name} names a node that the graph does not have"
            raise ScenarioError(f"{key}.path", rule, node, "correct the row or the graph")
    if scenario.slotted:
        _check_under(key, lambda: sensor.demand(scenario.slot_plant.period))


def sensed_slots(scenario: DerivedScenario) -> range:
    """Return the slots in which a run hands readings to its filters."""
    plant, algorithm = scenario.slot_plant, scenario.node_filter
    end = max(int(scenario.horizon / plant.period) - 1, 0)
    while not plant.over(end, scenario.horizon):
        end += 1
    if algorithm.predicts:
        return range(end)
    return range(1, end + (end in scenario.sampled_slots))


def _check_exchanges(scenario: DerivedScenario) -> None:
    """Raise ScenarioError if recorded exchanges do not fit the steps of the filter."""
    activation, algorithm = scenario.network.activation, scenario.node_filter
    if not isinstance(activation, RecordedSlots) or activation.matching:
        return
    phases = (algorithm.schedule or ()).count("exchange")
    for slot, phase, step in activation.recorded:
        steps = algorithm.exchange_steps(phase) if phase < phases else 0
        if step >= steps:
            limits = " and ".join(
                f"{algorithm.exchange_steps(k)} in phase {k}" for k in range(phases)
            )
            raise ScenarioError(
                "network.activation.path",
                f"{activation.path.name}: the filter has no such step, only {limits}",
                f"slot {slot}, phase {phase}, step {step}",
                "phases and steps count from 0; correct the row",
            )


def exchange_slots(scenario: DerivedScenario) -> range:
    """Return the slots in which nodes exchange."""
    return range(scenario.node_filter.first_slot, sensed_slots(scenario).stop)


def used_states(scenario: DerivedScenario) -> tuple[str, int, int] | None:
    """Return (file, rows, used rows) of recorded states; None if states are not recorded."""
    plant = scenario.plant
    if isinstance(plant, RecordedDiffusion):
        return plant.path.name, len(plant.table[0]), _used_rows(scenario, plant)
    if not isinstance(plant, RecordedPlant):
        return None
    return plant.path.name, len(plant.table), len(_state_slots(scenario) & plant.table.keys())


def _used_rows(scenario: DerivedScenario, plant: RecordedDiffusion) -> int:
    """Count the rows at probe times, and at random sensors' sample times, in replica 0."""
    times = [scenario.times]
    if any(sensor.is_random for sensor in scenario.sensors):
        times.append(all_sample_times(sample_times(scenario, Streams(scenario.seed))))
    asked, rows = np.unique(np.concatenate(times)), plant.table[0]
    near = np.searchsorted(asked, rows - TOLERANCE)
    return int(
        (asked[np.minimum(near, len(asked) - 1)] <= rows + TOLERANCE)[near < len(asked)].sum()
    )


def _state_slots(scenario: DerivedScenario) -> set[int]:
    """Return the slots in which a run needs the state."""
    drawn = any(sensor.is_random for sensor in scenario.sensors)
    return {*scenario.sampled_slots, *(sensed_slots(scenario) if drawn else ())}


def record_notes(scenario: DerivedScenario) -> tuple[str, ...]:
    """Return a line if recorded exchanges are in slots without exchanges."""
    activation = scenario.network.activation
    if not isinstance(activation, RecordedSlots) or not scenario.slotted:
        return ()
    used = exchange_slots(scenario)
    unused = sorted({slot for slot, _, _ in activation.recorded} - set(used))
    if not unused:
        return ()
    listed = ", ".join(map(str, unused[:3])) + (", ..." if len(unused) > 3 else "")
    return (
        f"{activation.path.name}: rows of slot {listed} are not used; there are exchanges in slots "
        f"{used.start} to {used.stop - 1}",
    )
