"""Messages: what becomes of one between being sent and being received."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Protocol

import numpy as np
import simpy

from netkf.core.streams import Streams
from netkf.engines.base import Rank
from netkf.engines.processes.timeline import Timeline
from netkf.network.channels import Fates, checked_chance
from netkf.network.graphs import Link
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

SEND, DELIVER, LOST, LATE = (CODES[kind] for kind in ("send", "deliver", "lost", "late"))


DOWN = (math.inf, False, 0.0)
"""The fate of a message on a link that is down."""


class Receiver(Protocol):
    """What takes messages at the end of a wire."""

    def accepts(self, payload: Any) -> bool:
        """Whether the message is in time."""

    def receive(
        self, time: float, peer: int, number: int, weight: float, payload: Any, age: float
    ) -> None:
        """Take message ``number`` of ``peer``."""


class Direction:
    """One direction of a link: who receives, what decides the fate, how many messages so far."""

    def __init__(
        self, scenario: Scenario, link: Link, entity: int, receiver: Receiver, fates: Fates
    ) -> None:
        self.link, self.entity, self.fates, self.receiver = link, entity, fates, receiver
        self.measured = scenario.measured(link)
        self.weight = scenario.weight(link[1], link[0])
        self.messages = 0


class Wire:
    """Both directions of one link, or the one that it has where the graph is directed."""

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        timeline: Timeline,
        recorder: Recorder,
        receivers: dict[int, Any],
        link: Link,
        entity: int,
    ) -> None:
        channel, (i, j) = scenario.network.channel, link
        self._loss, self._shared = channel.loss, channel.symmetric
        self._timeline, self._recorder = timeline, recorder
        self._horizon = scenario.horizon
        self._until = scenario.ends
        self._kept: list[tuple[float, bool, float]] = []
        forth = Fates(channel, partial(stream, streams, (i, j)))
        self._ways = [Direction(scenario, (i, j), 2 * entity, receivers[j], forth)]
        if not scenario.topology.directed:
            # Symmetric: the messages of one activation share one draw.
            back = forth if self._shared else Fates(channel, partial(stream, streams, (j, i)))
            self._ways.append(Direction(scenario, (j, i), 2 * entity + 1, receivers[i], back))

    def exchange(
        self,
        now: float,
        payloads: tuple[Any, Any],
        phase: int = -1,
        up: bool = True,
        fresh: bool = True,
    ) -> None:
        """Send one message each way that there is, of the payloads of both ends; all are lost where
        the link is not ``up``. Unless they are ``fresh`` the fates are those of the last time.

        None is not sent, but its fate is drawn all the same.
        """
        if fresh or not self._kept:
            first, *others = self._ways
            fate = first.fates.draw()
            self._kept = [fate, *(fate if self._shared else way.fates.draw() for way in others)]
        for way, payload, fate in zip(self._ways, payloads, self._kept, strict=False):
            self._send(now, way, payload, fate if up else DOWN, phase)

    def _send(
        self, now: float, way: Direction, payload: Any, fate: tuple[float, bool, float], phase: int
    ) -> None:
        if payload is None:
            return
        (sender, receiver), number, append = way.link, way.messages, self._recorder.append
        way.messages = number + 1
        append((now, SEND, sender, receiver, number, phase, NAN))
        luck, bad, delay = fate
        if luck >= checked_chance(self._loss, way.link, number, bad, way.measured):
            append((now, LOST, sender, receiver, number, phase, NAN))
            return
        if delay == 0.0:
            append((now, DELIVER, receiver, sender, number, phase, 0.0))
            way.receiver.receive(now, sender, number, way.weight, payload, 0.0)
            return
        arrival = now + delay
        if arrival < self._until:
            event = self._timeline.at(arrival, Rank.DELIVER, way.entity)
            assert event.callbacks is not None
            event.callbacks.append(partial(self._arrive, way, number, payload, now, phase))

    def _arrive(
        self,
        way: Direction,
        number: int,
        payload: Any,
        sent: float,
        phase: int,
        event: simpy.Event,
    ) -> None:
        now, (sender, receiver) = self._timeline.now, way.link
        in_time = way.receiver.accepts(payload)
        kind = DELIVER if in_time else LATE
        if now < self._horizon:
            self._recorder.append((now, kind, receiver, sender, number, phase, now - sent))
        if in_time:
            way.receiver.receive(now, sender, number, way.weight, payload, now - sent)


def stream(streams: Streams, ends: Link, purpose: str) -> np.random.Generator:
    """The stream of a link or of one direction of it."""
    return streams.generator(purpose, *ends)
