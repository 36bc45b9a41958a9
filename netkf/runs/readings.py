"""The readings that sensors took in one run, and errors of predictions of those held out."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.plants.readings import covariance_of
from netkf.rng.streams import Streams
from netkf.runs.files import require_run
from netkf.runs.outcomes import downtimes
from netkf.runs.simulate import simulate
from netkf.scenario.model import PlacedSensor
from netkf.scenario.sampling import times_of_sensor
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run

MAX_SLOTS = 5000
"""Slots of a run, evenly spread, of which drawn readings are judged."""


class SensorReading(NamedTuple):
    """A reading y (p,) of node ``node`` (id), counted as filters count states: without the response
    to an input that they know. ``H`` is (p, n), or a function that linearises, and ``R`` (p, p) as
    filters believe it; ``number`` is that of its instant among those of the run, ``rows`` (p,) are
    the components of the sensor that have a value.
    """

    number: int
    node: int
    placed: PlacedSensor
    y: FloatArray
    H: Any
    R: FloatArray
    rows: np.ndarray


class RunReadings(NamedTuple):
    """The instants (K,) of readings in seconds, and these in order of time and node.

    run    : the run with samples at ``times``; None if all readings are recorded and none was asked
             for
    origin : (K, n) the known response to the input there
    """

    times: FloatArray
    readings: list[SensorReading]
    run: Run | None
    origin: FloatArray


def collect_readings(
    scenario: Scenario,
    seed: int,
    replica: int,
    placed: Mapping[int, tuple[PlacedSensor, ...]],
    *,
    simulated: bool = False,
    all_slots: bool = False,
    engine: str = "auto",
) -> RunReadings:
    """Return what the ``placed`` sensors of nodes that are up read in a ``replica`` after time 0;
    ``simulated`` by an ``engine`` too if readings are drawn. Raises ScenarioError and EngineError.
    """
    streams = Streams(seed, replica)
    numbers = {
        (node, one.ordinal): _instants(scenario, streams, node, one, all_slots)
        for node, sensors in placed.items()
        for one in sensors
    }
    plant: Any = scenario.plant
    times_of = {
        key: plant.slot_times(np.array(ks, dtype=np.int64)) if scenario.slotted else ks
        for key, ks in numbers.items()
    }
    times = np.unique(np.concatenate([np.empty(0), *times_of.values()]))
    drawn = any(scenario.sensors[s.entry].is_random for sensors in placed.values() for s in sensors)
    run, states = None, np.zeros((len(times), plant.n))
    if (simulated or drawn) and len(times):
        run = simulate(dataclasses.replace(scenario, probe=times), seed, replica, engine)
        times = times[: len(run.times)]  # a run that diverges ends early
        states = np.nan_to_num(run.x)
    origin = _known_response(scenario, times)
    readings: list[SensorReading] = []
    down = downtimes(scenario, seed, replica)
    for node, sensors in placed.items():
        for one in sensors:
            key = node, one.ordinal
            rows = np.searchsorted(times, times_of[key])
            own = _readings_of(scenario, streams, (node, one), numbers[key], rows, states - origin)
            at = scenario.time_grid.snap(times + _sensing_delay(scenario))
            pauses = [pause for pause in down if pause.node == node]
            readings += (r for r in own if not any(p.begin <= at[r.number] < p.end for p in pauses))
    readings.sort(key=lambda one: one.number)
    return RunReadings(times, readings, run, origin)


def _sensing_delay(scenario: Scenario) -> float:
    """Return the seconds from the beginning of a slot until its reading is used."""
    timing = scenario.node_filter.timing
    before, found, _ = " ".join(timing.schedule or ()).partition("sense")
    delays = scenario.slotted and found and timing.talks
    return before.count("exchange") * scenario.phase_length if delays else 0.0


def _known_response(scenario: Scenario, times: FloatArray) -> FloatArray:
    """Return the response (K, n) to the input that filters know at ``times`` (K,)."""
    believed = scenario.origin_response
    if believed is None:
        return np.zeros((len(times), scenario.plant.n))
    slots = np.round(times / scenario.slot_plant.period).astype(int) if scenario.slotted else times
    return np.asarray(believed.states(slots))


def _readings_of(
    scenario: Scenario,
    streams: Streams,
    sensor: tuple[int, PlacedSensor],
    instants: Any,
    places: np.ndarray,
    states: FloatArray,
) -> Iterator[SensorReading]:
    """Yield readings of a ``sensor`` at ``instants`` (K,), with states in rows ``places`` (K,)."""
    node, one = sensor
    open_path: Any = scenario.slot_path if scenario.slotted else scenario.sample_path
    path = open_path(streams, node, one)
    R = scenario.noise_covariance(one.entry, believed=True)
    for k, (instant, place) in enumerate(zip(instants, places.tolist(), strict=True)):
        if place == len(states):
            break
        at = int(instant) if scenario.slotted else k
        read: Any = path.reading(at, states[place])
        y, H = (read, path.matrix(at)) if scenario.slotted else read
        if len(y):
            rows = _components(scenario, node, one, instant, k, len(y))
            yield SensorReading(place, node, one, y, H, covariance_of(path, at, R), rows)


def _instants(
    scenario: Scenario, streams: Streams, node: int, one: PlacedSensor, all_slots: bool
) -> Any:
    """Return the times (K,) of the samples of a sensor, or the numbers of its slots."""
    if not scenario.slotted:
        return times_of_sensor(scenario, streams, node, one)
    plant, record = scenario.slot_plant, scenario.sensors[one.entry].record
    if record is not None:
        slots = np.array(sorted(record.slots(node, plant.period)), dtype=np.int64)
        return slots[(slots > 0) & (slots * plant.period < scenario.horizon)]
    count = round(scenario.horizon / plant.period)
    slots = np.arange(1, count + (not plant.over(count, scenario.horizon)))
    if len(slots) > MAX_SLOTS and not all_slots:
        slots = slots[np.unique(np.linspace(0, len(slots) - 1, MAX_SLOTS).astype(int))]
    return slots


def values_read(scenario: Scenario, seed: int, replica: int) -> dict[tuple[int, float], list[int]]:
    """Return which of all values that linear sensors of a node give are read, by node and the time
    (s) of a sample or the number of a slot.
    """
    streams, found = Streams(seed, replica), dict[tuple[int, float], list[int]]()
    for node, sensors in scenario.placed_sensors.items():
        first = 0
        for one in sensors:
            p = len(scenario.sensors[one.entry].matrix_of(scenario.plant.n))
            instants = _instants(scenario, streams, node, one, all_slots=True)
            for k, instant in enumerate(instants.tolist()):
                rows = first + _components(scenario, node, one, instant, k, p)
                found.setdefault((node, instant), []).extend(rows.tolist())
            first += p
    return found


def _components(
    scenario: Scenario, node: int, one: PlacedSensor, instant: Any, k: int, p: int
) -> np.ndarray:
    """Return which components (p,) of a sensor the ``p`` values of reading ``k`` are."""
    record = scenario.sensors[one.entry].record
    if record is None:
        return np.arange(p)
    numbers = (
        record.slots(node, scenario.slot_plant.period)[int(instant)] if scenario.slotted else [k]
    )
    return np.nonzero(np.isfinite(record.rows(node).y[numbers]))[1]


@np.errstate(under="ignore")
def held_out_errors(run: Run) -> list[dict[str, Any]]:
    """Return a row for each node of a ``run`` with a sensor that is ``held_out``, of its readings y
    minus H xhat of the node at their instants, after everything that happened until then; in slots
    of the samples. Readings of states that the node does not estimate are left out.

    node          : id
    readings      : number of values, over which the others are means
    mean_square   : squared errors of the predictions
    noise         : R as filters believe it; ``without_noise`` is ``mean_square`` less this
    expected      : diagonal of H P H' + R, what the node claims; nan without P
    nis           : e' (H P H' + R)^-1 e for each value, 1 if P is exact
    bias          : errors

    The run is simulated again. Raises ScenarioError and EngineError.
    """
    return errors_of_replica(require_run(run), run.seed, run.replica)


def errors_of_replica(scenario: Scenario, seed: int, replica: int) -> list[dict[str, Any]]:
    """Return ``held_out_errors`` of a ``replica`` of the runs of ``seed``."""
    got = collect_readings(scenario, seed, replica, scenario.held_out_sensors, simulated=True)
    sums: dict[int, list[FloatArray]] = {}
    for node, e, S, R in _errors(scenario, got) if got.run is not None else ():
        nis = float(e @ np.linalg.solve(S, e)) if np.isfinite(S).all() else math.nan
        terms = [len(e), e @ e, np.trace(R), np.trace(S), nis, e.sum()]
        sums.setdefault(node, []).append(np.array(terms))
    names = ("mean_square", "noise", "expected", "nis", "bias")
    rows: list[dict[str, Any]] = []
    for node in sorted(sums):
        count, *totals = np.sum(sums[node], axis=0).tolist()
        means = {name: total / count for name, total in zip(names, totals, strict=True)}
        less = means["mean_square"] - means["noise"]
        rows.append({"node": node, "readings": int(count), **means, "without_noise": less})
    return rows


def _errors(
    scenario: Scenario, got: RunReadings
) -> Iterator[tuple[int, FloatArray, FloatArray, FloatArray]]:
    """Yield the node of each reading, its error (p,), the covariance that it claims, and R."""
    run: Any = got.run
    for number, node, _, y, H, R, _ in got.readings:
        i = run.nodes.index(node)
        own, view = scenario.is_estimated[i], np.arange(scenario.plant.n)[scenario.view(i)]
        x = np.zeros(scenario.plant.n)
        x[view] = run.xhat[number, i, own] - got.origin[number][view]
        z, J = (y, H) if isinstance(H, np.ndarray) else H(y, x)
        if np.delete(J, view, axis=1).any():
            continue
        P = run.P[number, i][np.ix_(own, own)]
        yield node, z - J @ x, J[:, view] @ P @ J[:, view].T + R, R
