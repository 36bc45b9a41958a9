"""The radio of a node: how long it sends a message, in how many frames, and what that costs."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.core.fields import Component, field, integer, number, one_of, positive
from netkf.linalg.arrays import FloatArray
from netkf.network.lives import lifetimes

MAX_BYTES = 1_000_000_000


@dataclass(frozen=True, eq=False)
class Radio(Component):
    """What it takes to send a message of many numbers.

    bits_per_second   a transmission takes its bits over this rate, and arrives, after the delay of
                      the channel, when its last bit is sent; infinite by default. A node sends one
                      transmission at a time; a broadcast is one
    queue             "wait": one that finds the radio busy waits until it is free; "drop": it is
                      lost
    frame_bytes       longer messages are sent as several frames, all of which must arrive: with k
                      frames a message arrives with the k-th power of its probability
    bytes_per_number  of the numbers in a message
    """

    bits_per_second: float | None = field(positive, default=None)
    queue: str = field(one_of("wait", "drop"), default="wait")
    frame_bytes: int | None = field(integer(1, MAX_BYTES), default=None)
    bytes_per_number: int = field(integer(1, MAX_BYTES), default=8)

    def seconds(self, size: float) -> float:
        """Return how long a message of ``size`` bytes is sent."""
        return 0.0 if self.bits_per_second is None else 8.0 * size / self.bits_per_second

    def frames(self, size: float) -> int:
        """Return the number of frames of a message of ``size`` bytes."""
        return 1 if self.frame_bytes is None else max(1, math.ceil(size / self.frame_bytes))


@dataclass(frozen=True, eq=False)
class Energy(Component):
    """What a node spends on sending; summaries then have ``joules``.

    joules_per_packet  of each transmission, or of each frame of a longer one, see network.radio; a
                       broadcast is one transmission
    joules_per_byte    of each byte of it, added to that
    """

    joules_per_packet: float = field(number(low=0.0), default=0.0)
    joules_per_byte: float = field(number(low=0.0), default=0.0)


class Airtime:
    """When radios send in one run; what a node sends or has waiting as it goes down is lost."""

    def __init__(self, scenario: Any, streams: Any) -> None:
        self.radio: Radio = scenario.network.radio
        self._instant = scenario.time_grid.instant
        # When nodes go up and down; one that is down sends nothing.
        self._changes = {
            node: [*(change.time for change in life.changes), math.inf]
            for node, life in lifetimes(scenario, streams).items()
        }
        self._free: dict[int, float] = {}
        # The end of the present transmission of each node, nan if it is lost.
        self._end: dict[int, float] = {}

    def begin(self, sender: int) -> None:
        """Let a node begin another transmission, if it sends anything."""
        self._end.pop(sender, None)

    def end(self, sender: int, size: float, now: float) -> float:
        """Return when the last bit of ``size`` bytes of ``sender`` is sent; nan if it never is."""
        if sender not in self._end:
            free = self._free.get(sender, 0.0)
            changes = self._changes.get(sender, [math.inf])
            down = changes[bisect_right(changes, now)]
            if free > now and self.radio.queue == "drop":
                self._end[sender] = math.nan
            else:
                end = self._instant(max(now, free) + self.radio.seconds(size))
                self._free[sender] = min(end, down)
                self._end[sender] = math.nan if end > down else end
        return self._end[sender]

    def waits(self, sender: int, sizes: Iterable[float], times: FloatArray) -> FloatArray:
        """Return the seconds until the last bits of K transmissions of ``sender`` are sent, one
        after the other at ``times`` (K,) of so many bytes; nan if they never are.
        """
        ends = []
        for size, now in zip(sizes, times.tolist(), strict=True):
            self.begin(sender)
            ends.append(self.end(sender, size, now))
        return np.asarray(np.array(ends) - times)
