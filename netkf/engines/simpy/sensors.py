"""Sensors in continuous time: a process per sampled sensor and per node with increments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from netkf.engines.base import Rank
from netkf.engines.simpy.nodes import ClockedNode
from netkf.engines.simpy.timeline import Process, Timeline
from netkf.linalg.arrays import FloatArray
from netkf.plants.readings import covariance_of, own_reading
from netkf.plants.sampling import Samples
from netkf.plants.sensors import LinearSensor, SensorPath
from netkf.rng.streams import Streams
from netkf.scenario.model import PlacedSensor
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import SENSE


def sensor_processes(
    scenario: Scenario,
    streams: Streams,
    timeline: Timeline,
    recorder: Recorder,
    truth: Any,
    nodes: dict[int, ClockedNode],
    up: Callable[[int], bool],
) -> list[Process]:
    """Return a process for each node with increment sensors and for each sampled sensor, which a
    node reads while it is ``up(node)``.
    """
    processes = [
        # One process for all increment sensors of a node: they are read at the same times.
        _increment_process(scenario, timeline, recorder, truth, nodes[node], node, up)
        for node in scenario.increment_sensors
    ]
    times, entity = scenario.sample_times(streams), 0
    for node, placed in scenario.sampled_sensors.items():
        for placed_sensor in placed:
            samples = scenario.sample_path(streams, node, placed_sensor)
            # The filters' R, which may differ from that of the readings.
            R = scenario.noise_covariance(placed_sensor.entry, believed=True)
            sensor = SamplingProcess(node, entity, times[node, placed_sensor.ordinal], samples, R)
            processes.append(sensor.run(timeline, truth, nodes[node], up))
            # Entities number sampled sensors over all nodes: they order samples of one instant.
            entity += 1
    return processes


def _increment_process(
    scenario: Scenario,
    timeline: Timeline,
    recorder: Recorder,
    truth: Any,
    carrier: ClockedNode,
    node: int,
    up: Callable[[int], bool],
) -> Process:
    # From grid point 1 on, since increments need an interval.
    k = 1
    # Half open: the horizon is excluded.
    while (time := truth.grid(k)) < scenario.horizon:
        yield timeline.at(time, Rank.SENSE, scenario.topology.index[node])
        if up(node):
            recorder.append((time, SENSE, node, -1, -1, -1, NAN))
        # predict_to() uses the increments up to now.
        carrier.predict_to(time)
        k += 1


@dataclass(frozen=True)
class SamplingProcess:
    """One sampled sensor of ``node`` (id) in one run: its times (K,) in seconds, its readings and
    the R (p, p) that the filters believe. ``entity`` orders samples of one instant.
    """

    node: int
    entity: int
    times: FloatArray
    samples: Samples
    R: FloatArray

    def run(
        self, timeline: Timeline, truth: Any, receiver: ClockedNode, up: Callable[[int], bool]
    ) -> Process:
        """Read the ``truth`` at the sample times, for ``receiver`` while the node is ``up``."""
        for k, time in enumerate(self.times.tolist()):
            yield timeline.at(time, Rank.SENSE, self.entity)
            # Relative to the moving origin, like the estimates.
            x = truth.local(time)
            y, H = self.samples.reading(k, x)
            y, H = own_reading(self.samples, y, H, x)
            if up(self.node):
                R = covariance_of(self.samples, k, self.R)
                receiver.sample(self.node, y, H, R[: len(y), : len(y)])


def increment_sensors(
    scenario: Scenario, streams: Streams, placed: list[tuple[int, PlacedSensor]]
) -> list[SensorPath]:
    """Return the readings of the increment sensors ``placed`` (node, sensor) in one run."""
    paths = []
    for node, one in placed:
        sensor = scenario.sensors[one.entry]
        assert isinstance(sensor, LinearSensor)
        # Noise on the grid and the division of steps have separate streams, so that the noise on
        # the grid does not depend on the network.
        noise, division = (streams.generator(p, node, one.ordinal) for p in ("noise", "cut"))
        paths.append(sensor.path(noise, division))
    return paths
