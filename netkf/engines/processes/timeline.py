"""Simulated time: a SimPy environment in which every event has its place in the order."""

from __future__ import annotations

from heapq import heappush
from typing import Any

import simpy

from netkf.engines.base import Rank


class Timeline(simpy.Environment):
    """SimPy with absolute times and an explicit order of simultaneous events."""

    def at(self, time: float, rank: Rank, entity: int) -> simpy.Event:
        """An event that happens at ``time``, before those of higher (rank, entity).

        ``Environment.timeout`` would add a delay to the present time, and ``now + (time - now)`` is
        not ``time`` in the last bit: recorded times would not come back, lattices would not meet.
        This is what simpy.Timeout does, with the time itself and an explicit priority.
        """
        event = simpy.Event(self)
        event._ok, event._value = True, None
        queue: list[Any] = self._queue  # simpy annotates its priorities as two constants
        heappush(queue, (time, rank << 48 | entity, next(self._eid), event))
        return event
