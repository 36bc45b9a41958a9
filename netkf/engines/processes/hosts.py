"""Hosts: what carries one node's filter through time, with its sensors and its inbox."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.algorithms.flow import FlowFilter, FlowModel, Reading, stretch_end
from netkf.core.arrays import FloatArray
from netkf.core.streams import Streams
from netkf.engines.base import LONGER, SHORTEST_SHARE, Rank
from netkf.engines.processes.timeline import Timeline
from netkf.plants.paths import DiffusionPath
from netkf.plants.sensors import LinearSensor, SensorPath
from netkf.scenario.scenario import Placed, Scenario
from netkf.trace.recorder import Recorder
from netkf.trace.schema import CODES

ABSORB = CODES["absorb"]


class Host:
    """One filter: it advances through time, is measured, sends and resets."""

    def __init__(
        self,
        timeline: Timeline,
        recorder: Recorder,
        truth: DiffusionPath,
        algorithm: FlowFilter,
        node: int,
        entity: int,
        model: FlowModel,
        start: tuple[FloatArray, FloatArray],
        sensors: list[SensorPath],
    ) -> None:
        self.node, self.entity = node, entity
        self._timeline, self._recorder, self._truth = timeline, recorder, truth
        self._algorithm, self._sensors = algorithm, sensors
        self._now = 0.0
        self._state = algorithm.init(model, *start)
        self._inbox: dict[int, tuple[float, Any, float]] = {}

    def advance(self, time: float) -> None:
        """Bring the filter to ``time``, with the readings of the stretch in between."""
        algorithm, state, now = self._algorithm, self._state, self._now
        least = SHORTEST_SHARE * (time - now)
        while now < time:
            end = time
            if self._sensors:
                stretch = algorithm.stretch(state)
                if stretch < time - now:
                    end = stretch_end(now, time, max(stretch, least))
                    least *= LONGER
            state = algorithm.flow(state, end - now)
            if self._sensors:
                moments = self._read(now, end)
                state = algorithm.measure(state, Reading(moments, end - now))
            now = end
        self._state, self._now = state, now

    def _read(self, start: float, end: float) -> FloatArray:
        truth = self._truth
        seen = truth.moments(start, end)
        parts = [sensor.moments(truth, seen, start, end) for sensor in self._sensors]
        whole = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return whole.reshape(-1)

    def emit(self, time: float) -> Any:
        """What the node sends at ``time``, from before any reset of that instant."""
        self.advance(time)
        return self._algorithm.emit(self._state)

    def accepts(self, payload: Any) -> bool:
        """True: in continuous time nothing is too late."""
        return True

    def receive(
        self, time: float, peer: int, number: int, weight: float, payload: Any, age: float
    ) -> None:
        """Put a message into the inbox; the newest of several from one peer counts."""
        if not self._inbox:
            event = self._timeline.at(time, Rank.ABSORB, self.entity)
            assert event.callbacks is not None
            event.callbacks.append(self._absorb)
        known = self._inbox.get(peer)
        if known is None or age <= known[2]:
            self._inbox[peer] = (weight, payload, age)

    def _absorb(self, event: Any) -> None:
        time = self._timeline.now
        self.advance(time)
        # In the order of peers, so that the sum does not depend on the order of arrival.
        messages = [self._inbox[peer] for peer in sorted(self._inbox)]
        self._inbox.clear()
        self._state = self._algorithm.absorb(self._state, messages)
        oldest = max(age for _, _, age in messages)
        self._recorder.append((time, ABSORB, self.node, -1, -1, -1, oldest))

    def estimate(self, time: float) -> tuple[FloatArray, FloatArray]:
        """``xhat`` and ``P`` at ``time``."""
        self.advance(time)
        return self._algorithm.estimate(self._state)


def make_hosts(
    scenario: Scenario,
    streams: Streams,
    timeline: Timeline,
    recorder: Recorder,
    truth: DiffusionPath,
) -> dict[int, Host]:
    """The host of every node; where the filter is pooled, all nodes share one."""
    algorithm, nodes = scenario.filter.algorithm, scenario.nodes
    assert isinstance(algorithm, FlowFilter)

    def sensors(node: int) -> list[SensorPath]:
        return [_sensor(scenario, streams, node, p) for p in scenario.placed.get(node, ())]

    if algorithm.pooled:
        every = [path for node in scenario.sensing for path in sensors(node)]
        shared = Host(
            timeline,
            recorder,
            truth,
            algorithm,
            -1,
            0,
            scenario.pooled_model,
            scenario.start(nodes[0]),
            every,
        )
        return dict.fromkeys(nodes, shared)
    return {
        node: Host(
            timeline,
            recorder,
            truth,
            algorithm,
            node,
            entity,
            scenario.models[entity],
            scenario.start(node),
            sensors(node),
        )
        for entity, node in enumerate(nodes)
    }


def _sensor(scenario: Scenario, streams: Streams, node: int, place: Placed) -> SensorPath:
    sensor = scenario.sensors[place.entry]
    assert isinstance(sensor, LinearSensor)
    return sensor.path(
        streams.generator("noise", node, place.ordinal),
        streams.generator("cut", node, place.ordinal),
    )
