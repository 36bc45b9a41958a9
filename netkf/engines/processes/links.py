"""Link clocks and channels: activations, messages, losses and delays."""

from __future__ import annotations

from collections.abc import Generator
from functools import partial
from typing import Any

import simpy

from netkf.core.streams import Streams
from netkf.engines.base import Rank
from netkf.engines.processes.hosts import Host
from netkf.engines.processes.timeline import Timeline
from netkf.network.channels import Fates
from netkf.network.graphs import Link
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

TICK, SEND, DELIVER, LOST = (CODES[kind] for kind in ("tick", "send", "deliver", "lost"))
FIRST_BLOCK, LONGEST_BLOCK = 8, 1024


class Direction:
    """One direction of a link: who sends, what decides the fate, how many messages so far."""

    def __init__(
        self, scenario: Scenario, link: Link, entity: int, hosts: dict[int, Host], fates: Fates
    ) -> None:
        self.link, self.entity, self.fates = link, entity, fates
        self.sender, self.receiver = hosts[link[0]], hosts[link[1]]
        self.measured = scenario.measured(link)
        self.weight = scenario.weight(link[1], link[0])
        self.messages = 0


class LinkProcess:
    """One link: its clock, and what an activation of it does."""

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        timeline: Timeline,
        recorder: Recorder,
        hosts: dict[int, Host],
        link: Link,
        entity: int,
    ) -> None:
        network, (i, j) = scenario.network, link
        assert network.activation is not None
        self._clock, self._loss = network.activation, network.channel.loss
        self._timeline, self._recorder = timeline, recorder
        self._link, self._entity, self._horizon = link, entity, scenario.horizon
        self._random = streams.generator("clock", i, j)
        self._origin = self._clock.origin(link, partial(_stream, streams, link, "phase"))
        self._shared = network.channel.symmetric
        forth = Fates(network.channel, partial(_stream, streams, (i, j)))
        # Symmetric: the messages of one activation share one draw.
        back = forth if self._shared else Fates(network.channel, partial(_stream, streams, (j, i)))
        self._ways = (
            Direction(scenario, (i, j), 2 * entity, hosts, forth),
            Direction(scenario, (j, i), 2 * entity + 1, hosts, back),
        )

    def ticking(self) -> Generator[simpy.Event, Any, None]:
        """The process: wait for a tick, activate, and so on until the horizon."""
        now, index, count = 0.0, 0, FIRST_BLOCK
        while True:
            times = self._clock.ticks(
                self._link, self._origin, index, now, self._random, count
            ).tolist()
            for now in times:
                if now >= self._horizon:
                    return
                yield self._timeline.at(now, Rank.TICK, self._entity)
                self._activate(now)
            if not times:
                return
            self._recorder.flush_if_full()
            index += len(times)
            count = min(2 * count, LONGEST_BLOCK)

    def _activate(self, now: float) -> None:
        i, j = self._link
        self._recorder.append((now, TICK, i, j, -1, -1, NAN))
        forth, back = self._ways
        # Both ends snapshot what they send; inboxes are absorbed later in this instant.
        payloads = forth.sender.emit(now), back.sender.emit(now)
        fate = forth.fates.draw()
        self._send(now, forth, payloads[0], fate)
        self._send(now, back, payloads[1], fate if self._shared else back.fates.draw())

    def _send(
        self, now: float, way: Direction, payload: Any, fate: tuple[float, bool, float]
    ) -> None:
        (sender, receiver), number, append = way.link, way.messages, self._recorder.append
        way.messages = number + 1
        append((now, SEND, sender, receiver, number, -1, NAN))
        luck, bad, delay = fate
        if luck >= self._loss.chance(way.link, number, bad, way.measured):
            append((now, LOST, sender, receiver, number, -1, NAN))
            return
        if delay == 0.0:
            append((now, DELIVER, receiver, sender, number, -1, 0.0))
            way.receiver.receive(now, sender, way.weight, payload, 0.0)
            return
        arrival = now + delay
        if arrival < self._horizon:
            event = self._timeline.at(arrival, Rank.DELIVER, way.entity)
            assert event.callbacks is not None
            event.callbacks.append(partial(self._deliver, way, number, payload, now))

    def _deliver(
        self, way: Direction, number: int, payload: Any, sent: float, event: simpy.Event
    ) -> None:
        now, (sender, receiver) = self._timeline.now, way.link
        self._recorder.append((now, DELIVER, receiver, sender, number, -1, now - sent))
        way.receiver.receive(now, sender, way.weight, payload, now - sent)


def _stream(streams: Streams, ends: Link, purpose: str) -> Any:
    return streams.generator(purpose, *ends)
