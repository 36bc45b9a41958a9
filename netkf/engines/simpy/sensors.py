"""Sensors in continuous time: each sampled one is a process, as is each node with increments."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import simpy

from netkf.engines.base import Rank
from netkf.engines.simpy.nodes import ClockedNode
from netkf.engines.simpy.timeline import Timeline
from netkf.plants.sensors import LinearSensor, SensorPath
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

SENSE = CODES["sense"]
Process = Generator[simpy.Event, Any, None]


def sensor_processes(
    scenario: Scenario,
    streams: Streams,
    timeline: Timeline,
    recorder: Recorder,
    truth: Any,
    nodes: dict[int, ClockedNode],
) -> list[Process]:
    """All processes that read the truth."""
    index = scenario.topology.index
    processes = [
        _increments(scenario, timeline, recorder, truth, nodes[node], node, index[node])
        for node in scenario.increment_sensors
    ]
    times, entity = scenario.sample_times(streams), 0
    for node, placed in scenario.sampled_sensors.items():
        for place in placed:
            path = scenario.sample_path(streams, node, place)
            R = scenario.noise(place.entry, believed=True)
            instants = times[node, place.ordinal]
            arguments = (timeline, truth, nodes[node], node, entity, instants, path, R)
            processes.append(_sampling(*arguments))
            entity += 1
    return processes


def _increments(
    scenario: Scenario,
    timeline: Timeline,
    recorder: Recorder,
    truth: Any,
    carrier: ClockedNode,
    node: int,
    entity: int,
) -> Process:
    """Wake the node at each point of the sensing grid, where it uses the increments so far."""
    k = 1
    while (time := truth.grid(k)) < scenario.horizon:
        yield timeline.at(time, Rank.SENSE, entity)
        recorder.append((time, SENSE, node, -1, -1, -1, NAN))
        carrier.predict_to(time)
        k += 1


def _sampling(
    timeline: Timeline,
    truth: Any,
    carrier: ClockedNode,
    node: int,
    entity: int,
    instants: Any,
    path: Any,
    R: Any,
) -> Process:
    """One sensor: read the truth at its instants."""
    for k, time in enumerate(instants.tolist()):
        yield timeline.at(time, Rank.SENSE, entity)
        y, H = path.reading(k, truth.local(time))
        carrier.sample(node, y, H, R)


def increment_sensors(
    scenario: Scenario, streams: Streams, placed: list[tuple[int, PlacedSensor]]
) -> list[SensorPath]:
    """The readings of these increment sensors in one run."""
    paths = []
    for node, place in placed:
        sensor = scenario.sensors[place.entry]
        assert isinstance(sensor, LinearSensor)
        noise, cutting = (streams.generator(p, node, place.ordinal) for p in ("noise", "cut"))
        paths.append(sensor.path(noise, cutting))
    return paths
