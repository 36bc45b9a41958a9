"""Link clocks as processes whose ticks reach compiled filters in blocks.

What a tick does is a matter of microseconds once it is compiled, and a call from Python for each
would cost more. So the clocks of all links run, and ticks and fates are handed on between two
wake-ups; readings, arrivals, resets and samples follow from them in the compiled replay.
"""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np
import simpy

from netkf.core.streams import Streams
from netkf.engines.base import Rank
from netkf.engines.compiled.schedule import LinkDraws, Window
from netkf.engines.processes.timeline import Timeline
from netkf.scenario.scenario import Scenario

TOGETHER = 1 << 14  # ticks between two wake-ups


class TickingLinks:
    """All link clocks of a run; ``following`` lets them go on until a block is full."""

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        self._timeline = Timeline()
        self._t: list[float] = []
        self._link: list[int] = []
        self._delay: list[list[float]] = []
        self._draws = LinkDraws(scenario, streams)
        for k in range(self._draws.count):
            self._timeline.process(self._ticking(k))

    def _ticking(self, link: int) -> Generator[simpy.Event, object, None]:
        at, rank, draws = self._timeline.at, Rank.TICK, self._draws
        while draws.last[link] < math.inf:
            times, _, delays = draws.more(np.array([link]))
            for now, delay in zip(times.tolist(), delays.tolist(), strict=True):
                yield at(now, rank, link)
                self._t.append(now)
                self._link.append(link)
                self._delay.append(delay)

    def following(self) -> Window:
        """Ticks before ``end``; those of one instant are never apart."""
        step, peek, t = self._timeline.step, self._timeline.peek, self._t
        t.clear()
        self._link.clear()
        self._delay.clear()
        while len(t) < TOGETHER and peek() < math.inf:
            step()
        while t and peek() == t[-1]:
            step()
        return Window(
            peek(),
            np.array(t, dtype=np.float64),
            np.array(self._link, dtype=np.int64),
            np.array(self._delay, dtype=np.float64).reshape(-1, 2),
        )
