"""Simulated time: a SimPy environment in which every event has its place in the order."""

from __future__ import annotations

from collections.abc import Callable, Generator
from heapq import heappush
from typing import Any

import simpy

from netkf.engines.base import Rank


class Timeline(simpy.Environment):
    """SimPy with absolute times and an explicit order of simultaneous events.

    ``processes`` counts the processes that were started.
    """

    def __init__(self) -> None:
        super().__init__()
        self.processes = 0

    def start(self, process: Generator[simpy.Event, Any, Any]) -> None:
        """Let a process begin; in what order processes are started makes no difference."""
        self.processes += 1
        self.process(process)

    def at(self, time: float, rank: Rank | int, entity: int) -> simpy.Event:
        """Return an event that happens at ``time``, before those of higher (rank, entity).

        ``Environment.timeout`` would add a delay to the present time, and ``now + (time - now)`` is
        not ``time`` in the last bit: recorded times would not come back, lattices would not meet.
        This is what simpy.Timeout does, with the time itself and an explicit priority.
        """
        event = simpy.Event(self)
        # An event that has its value is triggered: SimPy calls its callbacks when it comes up.
        event._ok, event._value = True, None
        queue: list[Any] = self._queue  # simpy annotates its priorities as two constants
        # Rank before entity in one integer: 48 bits hold any entity. The event number only breaks
        # ties.
        heappush(queue, (time, rank << 48 | entity, next(self._eid), event))
        return event

    def call_at(
        self, time: float, rank: Rank | int, entity: int, callback: Callable[[simpy.Event], None]
    ) -> None:
        """Make an event at ``time`` that calls ``callback``."""
        event = self.at(time, rank, entity)
        # An event that is not processed yet has a list of callbacks.
        assert event.callbacks is not None
        event.callbacks.append(callback)

    @property
    def events(self) -> int:
        """How many events SimPy has processed so far."""
        # Its counter of events cannot be read without moving it; each one that is left waits.
        return int(repr(self._eid)[len("count(") : -1]) - len(self._queue)
