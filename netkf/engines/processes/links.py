"""Link clocks: each link is a process that ticks and lets both ends exchange."""

from __future__ import annotations

from collections.abc import Generator
from functools import partial
from typing import Any

import simpy

from netkf.core.clock import next_ticks
from netkf.core.streams import Streams
from netkf.engines.base import Rank
from netkf.engines.processes.hosts import Host
from netkf.engines.processes.timeline import Timeline
from netkf.engines.processes.wires import Wire, stream
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Link
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

TICK = CODES["tick"]
FIRST_BLOCK, LONGEST_BLOCK = 8, 1024


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
        clock = scenario.network.activation
        assert isinstance(clock, LinkClock)
        self._clock, self._link, self._entity = clock, link, entity
        self._timeline, self._recorder = timeline, recorder
        self._horizon = scenario.horizon
        self._random = streams.generator("clock", *link)
        self._origin = clock.origin(link, partial(stream, streams, link, "phase"))
        self._ends = hosts[link[0]], hosts[link[1]]
        self._wire = Wire(scenario, streams, timeline, recorder, hosts, link, entity)

    def ticking(self) -> Generator[simpy.Event, Any, None]:
        """The process: wait for a tick, activate, and so on until the horizon."""
        now, index, count = 0.0, 0, FIRST_BLOCK
        while True:
            times = next_ticks(
                self._clock, self._link, self._origin, index, now, self._random, count
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
        one, other = self._ends
        # Both ends snapshot what they send; inboxes are absorbed later in this instant.
        self._wire.exchange(now, (one.emit(now), other.emit(now)))
