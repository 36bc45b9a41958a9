"""Clocks: the contract of anything that ticks, and all ticks of one clock up to a horizon."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import Component
from netkf.linalg.arrays import FloatArray

Entity = Any
"""A tuple of ids: those of a link's ends, (node,), or (node, ordinal of its sensor).

Any, so that a subclass may say ``tuple[int, int]`` where it is for links only.
"""

FIRST_BLOCK, LONGEST_BLOCK = 8, 1 << 16


@dataclass(frozen=True, eq=False)
class Clock(Component):
    """The contract of a clock: a stateless maker of increasing tick times, all above 0.

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
        """Times of up to ``count`` ticks from number ``index`` on; tick ``index - 1`` was at
        ``now`` (0.0 before the first). Empty when the clock has stopped for good.

        ``count`` must not show in the values: two blocks are the same ticks as one.
        """

    def origin(self, entity: Entity, random: Callable[[], np.random.Generator]) -> float:
        """The value drawn once for an entity at its start, such as a phase, from ``random()``."""
        return 0.0

    def mean_rate(self, entity: Entity) -> float:
        """Mean ticks per second in the long run; nan if it is not known beforehand."""
        return math.nan

    @property
    def memoryless(self) -> bool:
        """Whether the ticks are a Poisson process."""
        return False


def next_ticks(
    clock: Clock,
    entity: Entity,
    origin: float,
    index: int,
    now: float,
    random: np.random.Generator,
    count: int,
    key: str = "network.activation",
) -> FloatArray:
    """``clock.ticks``, checked; ``key`` names the clock in errors.

    Raises ScenarioError if time does not advance, because the run would never end.
    """
    t = np.asarray(clock.ticks(entity, origin, index, now, random, count), dtype=np.float64)
    if len(t) and not (t[-1] > now and t[0] >= now and (np.diff(t) >= 0.0).all()):
        whose = {1: "node", 2: "link"}.get(len(entity), "entity")
        words = f"{type(clock).__name__}: ticks of {whose} {list(entity)} must increase, "
        raise ScenarioError(
            key, words + f"after {now:g} s", t[:3].tolist(), "mend ticks of the class"
        )
    return t


def all_ticks(
    clock: Clock,
    entity: Entity,
    phase: Callable[[], np.random.Generator],
    random: np.random.Generator,
    horizon: float,
    key: str = "network.activation",
) -> FloatArray:
    """(K,) all ticks of an entity in (0, ``horizon``).

    ``phase`` makes the generator of the origin, and is called only if the clock draws one.
    """
    origin, now, index = clock.origin(entity, phase), 0.0, 0
    found, count = [np.empty(0)], FIRST_BLOCK
    while now < horizon:
        block = next_ticks(clock, entity, origin, index, now, random, count, key)
        if not len(block):
            break
        found.append(block)
        now, index, count = float(block[-1]), index + len(block), min(2 * count, LONGEST_BLOCK)
    times = np.concatenate(found)
    return times[: int(np.searchsorted(times, horizon))]
