"""Simulated time: a SimPy environment with an explicit order of simultaneous events."""

from __future__ import annotations

from collections.abc import Callable, Generator
from heapq import heappush
from typing import Any

import simpy

from netkf.engines.base import Rank

Process = Generator[simpy.Event, Any, None]


class Timeline(simpy.Environment):
    """SimPy with absolute times and an explicit order of simultaneous events.

    ``processes`` counts the processes that were started.
    """

    def __init__(self) -> None:
        super().__init__()
        self.processes = 0
        self._failure: BaseException | None = None  # of a process

    def start(self, process: Generator[simpy.Event, Any, Any]) -> None:
        """Start a process; the order in which processes start does not matter."""
        self.processes += 1
        self.process(self._watched(process))

    def _watched(self, process: Process) -> Process:
        try:
            return (yield from process)
        except BaseException as error:
            self._failure = error
            raise

    def run(self, until: Any = None) -> Any:
        """Run as SimPy does; raises what a process raised, which SimPy copies by ``args`` alone."""
        try:
            return super().run(until)
        except BaseException:
            if self._failure is not None:
                raise self._failure from None
            raise

    def at(self, time: float, rank: Rank | int, entity: int) -> simpy.Event:
        """Return an event at ``time`` (seconds), before those of higher (rank, entity): a
        simpy.Timeout with an absolute time, since ``now + (time - now)`` may differ in the last
        bit, and an explicit priority.
        """
        event = simpy.Event(self)
        # An event with a value counts as triggered: SimPy calls its callbacks when its time comes.
        event._ok, event._value = True, None
        queue: list[Any] = self._queue  # simpy annotates its priorities as two constants
        # The priority is (rank, entity) as one integer; 48 bits hold any entity. The event number
        # is unique, so that events themselves are never compared.
        heappush(queue, (time, rank << 48 | entity, next(self._eid), event))
        return event

    def call_at(
        self, time: float, rank: Rank | int, entity: int, callback: Callable[[simpy.Event], None]
    ) -> None:
        """Make an event, as ``at``, that calls ``callback``."""
        event = self.at(time, rank, entity)
        # An event that is not processed yet has a list of callbacks.
        assert event.callbacks is not None
        event.callbacks.append(callback)

    @property
    def events(self) -> int:
        """Number of events that SimPy has processed so far."""
        # All events created, less those still in the queue. next() would advance SimPy's counter,
        # so read it from its repr.
        return int(repr(self._eid)[len("count(") : -1]) - len(self._queue)
