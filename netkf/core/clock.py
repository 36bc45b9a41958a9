"""The contract of clocks, and all ticks of one clock up to a horizon."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import Component
from netkf.linalg.arrays import FloatArray

Entity = Any
"""A tuple of ids: those of a link's ends, (node,), or (node, ordinal of its sensor).

Any, so that a subclass may say ``tuple[int, int]`` where it is for links only.
"""

# Ticks drawn at once, doubling: few for slow clocks, and never more than some MiB.
FIRST_BLOCK, MAX_BLOCK = 8, 1 << 16


@dataclass(frozen=True, eq=False)
class Clock(Component):
    """The contract of a clock: a stateless generator of increasing tick times, all above 0.

    The caller owns the generator of each entity, so that the ticks of an entity depend on nothing
    but its own stream.
    """

    @abstractmethod
    def ticks(
        self,
        entity: Entity,
        origin: float,
        index: int,
        now: float,
        random: np.random.Generator,
        count: int,
    ) -> FloatArray:
        """Return times of up to ``count`` ticks from number ``index`` on; tick ``index - 1`` was at
        ``now`` (0.0 before the first). Empty when the clock has stopped for good.

        ``count`` must not show in the values: two blocks are the same ticks as one.
        """

    def origin(self, entity: Entity, random: Callable[[], np.random.Generator]) -> float:
        """Return a value drawn once per entity from ``random()``, such as a phase; 0 for none."""
        return 0.0

    def mean_rate(self, entity: Entity) -> float:
        """Return the mean ticks per second in the long run; nan if unknown before a run."""
        return math.nan

    @property
    def memoryless(self) -> bool:
        """True if the ticks are a Poisson process."""
        return False


class ClockPosition(NamedTuple):
    """The position of one entity's clock: the next tick has ``number``, after ``now``."""

    origin: float
    number: int = 0
    now: float = 0.0


def next_ticks(
    clock: Clock,
    entity: Entity,
    position: ClockPosition,
    random: np.random.Generator,
    count: int,
    key: str = "network.activation",
) -> FloatArray:
    """Return the times of ``clock.ticks``, checked; ``key`` names the clock in errors.

    Raises ScenarioError if time does not advance, because the run would never end.
    """
    now = position.now
    t = np.asarray(clock.ticks(entity, *position, random, count), dtype=np.float64)
    if len(t) and not (t[-1] > now and t[0] >= now and (np.diff(t) >= 0.0).all()):
        whose = {1: "node", 2: "link"}.get(len(entity), "entity")
        rule = f"{type(clock).__name__}: ticks of {whose} {list(entity)} must increase, "
        raise ScenarioError(
            key, rule + f"after {now:g} s", t[:3].tolist(), "correct ticks of the class"
        )
    return t


def generate_ticks(
    clock: Clock,
    entity: Entity,
    phase: Callable[[], np.random.Generator],
    random: np.random.Generator,
    horizon: float,
    key: str = "network.activation",
) -> FloatArray:
    """Return all ticks (K,) of an entity in (0, ``horizon``), in seconds.

    ``phase`` makes the generator of the origin, and is called only if the clock draws one.
    """
    position = ClockPosition(clock.origin(entity, phase))
    found, count = [np.empty(0)], FIRST_BLOCK
    while position.now < horizon:
        block = next_ticks(clock, entity, position, random, count, key)
        if not len(block):
            break
        found.append(block)
        number = position.number + len(block)
        position = position._replace(number=number, now=float(block[-1]))
        count = min(2 * count, MAX_BLOCK)
    times = np.concatenate(found)
    return times[: int(np.searchsorted(times, horizon))]
