"""Sampled sensors: their times and samples in one run, and their checks.

A sensor over a diffusion gives increments, or it samples: with a clock of its own (``sampling``),
or at the times of its table (``recorded``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from netkf.core.clock import Clock, stated_rate
from netkf.core.contracts import is_netkf_class
from netkf.core.errors import ScenarioError, errors_under, quote
from netkf.core.places import Place
from netkf.core.printable import list_some
from netkf.linalg.arrays import FloatArray
from netkf.network.node_clocks import node_time
from netkf.plants.nonlinear import NonlinearSensor
from netkf.plants.sampling import RecordedSampling, Samples
from netkf.plants.sensors import LinearSensor, Sensor
from netkf.rng.streams import Generators, Streams
from netkf.scenario.block_sensors import support_of
from netkf.scenario.model import PlacedSensor, ScenarioModel, takes_samples
from netkf.scenario.positions import tick_times
from netkf.scenario.registry import name_of

MAX_SAMPLES = 1e9  # samples of one sensor; more suggest a wrong unit of time


def sample_times(scenario: ScenarioModel, streams: Streams) -> dict[tuple[int, int], FloatArray]:
    """Return sample times (K,) in seconds by sensor (node, ordinal) of a diffusion."""
    return {
        (node, placed_sensor.ordinal): times_of_sensor(scenario, streams, node, placed_sensor)
        for node, placed_sensor in _iterate_sampled_sensors(scenario)
    }


def times_of_sensor(
    scenario: ScenarioModel, streams: Streams, node: int, placed_sensor: PlacedSensor
) -> FloatArray:
    """Return the sample times (K,) in seconds of one sensor of a node, see ``sample_times``."""
    sensor = scenario.sensors[placed_sensor.entry]
    generator = _make_generator(streams, node, placed_sensor)
    own, clock = node_time(scenario, streams, node), getattr(sensor, "sampling", None)
    ahead = own.ahead(clock) if isinstance(clock, Clock) else 0.0
    until = own.until(scenario.horizon, ahead)
    with errors_under(scenario.sensor_key(placed_sensor.entry)):
        times = sensor.sample_times(node, placed_sensor.ordinal, generator, until)
        if not is_netkf_class(type(sensor)):
            times = _checked_times(sensor, times)
    times = scenario.time_grid.before(scenario.horizon, own.instants(times, ahead))
    # Rows of one instant are one sample.
    is_recorded = isinstance(getattr(sensor, "sampling", None), RecordedSampling)
    return np.unique(times) if is_recorded else times


def _checked_times(sensor: Sensor, given: Any) -> FloatArray:
    """Return the times that a user's sensor gives; raises ScenarioError unless they increase."""
    times = np.asarray(given)
    is_vector = times.ndim == 1 and (times.dtype.kind in "fiu" or not len(times))
    if not (is_vector and (np.diff(times, prepend=0.0) >= 0.0).all() and np.isfinite(times).all()):
        name = f"{type(sensor).__name__}.sample_times"
        rule = f"{name} must return times of at least 0 that increase, not {quote(given)}"
        raise ScenarioError("sampling", rule)
    return times.astype(np.float64)


def sample_path(scenario: ScenarioModel, streams: Streams, node: int, one: PlacedSensor) -> Samples:
    """Return the samples of one sensor of a node in one run in continuous time."""
    sensor: Sensor = scenario.located_sensors[one.entry]
    return sensor.samples(node, _make_generator(streams, node, one), scenario.horizon)


def _iterate_sampled_sensors(scenario: ScenarioModel) -> Iterator[tuple[int, PlacedSensor]]:
    for node, placed_sensors in scenario.sampled_sensors.items():
        for placed_sensor in placed_sensors:
            yield node, placed_sensor


def _make_generator(streams: Streams, node: int, placed_sensor: PlacedSensor) -> Generators:
    return lambda purpose: streams.generator(purpose, node, placed_sensor.ordinal)


def sample_rate(scenario: ScenarioModel, node: int) -> float:
    """Return the mean rate of a node's samples; nan if unknown, and for several sensors."""
    placed_sensors = scenario.sampled_sensors.get(node, ())
    if len(placed_sensors) != 1:
        return math.nan if placed_sensors else 0.0
    clock = getattr(scenario.sensors[placed_sensors[0].entry], "sampling", None)
    return math.nan if clock is None else clock.mean_rate((node, 0))


def all_sample_times(times: dict[tuple[int, int], FloatArray]) -> FloatArray:
    """Return the increasing instants (K,) at which any sensor samples."""
    return np.unique(np.concatenate([np.empty(0), *times.values()]))


def uses_grid(scenario: ScenarioModel) -> bool:
    """Return True if states are drawn on a grid: with increments, or without samples."""
    is_drawn = not scenario.slotted and scenario.plant.is_random and scenario.plant.linear
    return is_drawn and (bool(scenario.increment_sensors) or not scenario.sampled_sensors)


def is_drawn_from(scenario: ScenarioModel, sensor: Any, place: Place) -> bool:
    """Return True if readings of a sensor are drawn that depend on the block at a ``place``."""
    entries = support_of(sensor, scenario.plant.n)
    return bool(
        sensor.is_random and np.isin(np.arange(scenario.plant.n)[place.entries], entries).any()
    )


def require_states(
    scenario: ScenarioModel, times: dict[tuple[int, int], FloatArray], streams: Streams
) -> None:
    """Raise ScenarioError if recorded states lack that of a probe, of a drawn sample, or of a tick
    whose links follow the state; ``times`` are sample times by (node, ordinal).
    """
    ticks = tick_times(scenario, streams) if scenario.links_follow_state else np.empty(0)
    for (key, plant), place in zip(scenario.all_plants, scenario.layout.places, strict=True):
        if plant.record is None:
            continue
        with errors_under(key):
            plant.record.require_times(scenario.times, "the probe")
            plant.record.require_times(ticks, "a tick of the network")
            for node, placed_sensor in _iterate_sampled_sensors(scenario):
                if is_drawn_from(scenario, scenario.sensors[placed_sensor.entry], place):
                    needed, use = times[node, placed_sensor.ordinal], f"a sample of node {node}"
                    plant.record.require_times(needed, use)


def check_sampling(scenario: ScenarioModel) -> None:
    """Raise ScenarioError if sampling does not fit plant or graph, or recorded states miss."""
    for k, sensor in enumerate(scenario.sensors):
        key = scenario.sensor_key(k)
        clock = getattr(sensor, "sampling", None)
        if clock is not None:
            _check_clock(scenario, key, sensor, clock)
        elif not (scenario.slotted or takes_samples(sensor) or isinstance(sensor, LinearSensor)):
            kind = "nonlinear" if isinstance(sensor, NonlinearSensor) else "custom"
            rule = f"is missing, and a {kind} sensor takes samples in continuous time"
            remedy = 'write sampling = { kind = "periodic", period = ... }'
            raise ScenarioError(f"{key}.sampling", rule, None, remedy)
        lacks_samples = type(sensor).samples is Sensor.samples
        if not scenario.slotted and takes_samples(sensor) and lacks_samples:
            rule = "must define samples, which a sensor has in continuous time"
            raise ScenarioError(f"{key}.kind", rule, name_of("sensor", sensor), "write the method")
        has_increments = scenario.plant.is_random and scenario.plant.linear
        if not scenario.slotted and not has_increments and not takes_samples(sensor):
            kind = "recorded" if scenario.plant.linear else "nonlinear"
            rule = f"must be a clock, since increments of a {kind} state are unknown"
            remedy = 'write sampling = { kind = "periodic", period = ... }'
            raise ScenarioError(f"{key}.sampling", rule, None, remedy)
    if not scenario.slotted and scenario.plant.record is not None:
        streams = Streams(scenario.seed)
        require_states(scenario, sample_times(scenario, streams), streams)


def _check_clock(scenario: ScenarioModel, key: str, sensor: Sensor, clock: Clock) -> None:
    if scenario.slotted:
        rule = "belongs to plants in continuous time, and this plant is in slots"
        remedy = "leave it out: there is a reading in every slot"
        raise ScenarioError(f"{key}.sampling", rule, None, remedy)
    if isinstance(clock, RecordedSampling):
        for node in clock.listed:
            if node not in scenario.topology.index:
                rule = f"{clock.path.name} names a node that the graph does not have"
                remedy = "correct the row or the graph"
                raise ScenarioError(f"{key}.sampling.path", rule, node, remedy)
    # Sampling clocks are of the same classes as clocks of links; these fields are for links only.
    if getattr(clock, "rates", ()):
        remedy = "give rate, and another [[sensors]] entry for nodes with another one"
        raise ScenarioError(f"{key}.sampling.rates", "belongs to network.activation", None, remedy)
    if getattr(clock, "rate", 0.0) is None and getattr(clock, "rates", None) is not None:
        raise ScenarioError(f"{key}.sampling.rate", "is missing", None, "add rate = ...")
    if getattr(clock, "at", "links") != "links":
        rule = "belongs to network.activation"
        raise ScenarioError(f"{key}.sampling.at", rule, getattr(clock, "at", None), "remove it")
    for node in sensor.nodes:
        count = stated_rate(clock, (node, 0), f"{key}.sampling") * scenario.horizon
        if count > MAX_SAMPLES:
            raise ScenarioError(
                f"{key}.sampling",
                f"must take at most {MAX_SAMPLES:g} samples up to the horizon",
                f"{count:.3g} samples of node {node}",
                "lower the rate or shorten the horizon",
            )


def sampling_notes(scenario: ScenarioModel) -> tuple[str, ...]:
    """Return a line for each recorded sensor whose table has no readings of some of its nodes."""
    notes: list[str] = []
    for sensor in scenario.sensors:
        record = sensor.record
        if record is None:
            continue
        nodes = [node for node in sensor.nodes if not len(record.rows(node).t)]
        if nodes:
            notes.append(f"{record.path.name} has no readings of node {list_some(nodes, 3)}")
    return tuple(notes)
