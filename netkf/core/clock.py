"""The contract of clocks, and all ticks of one clock up to a horizon."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from netkf.core.errors import ScenarioError, quote
from netkf.core.fields import Component, boolean, number, stated
from netkf.core.laws import EXPONENTIAL, Lattice, WaitingLaw
from netkf.linalg.arrays import FloatArray

Entity = Any
"""The owner of a clock: (sender, receiver) of a link, (node,), or (node, ordinal of its sensor).

Any, so that a subclass for links only may declare ``tuple[int, int]``.
"""

# Ticks that are drawn at once: the number doubles from block to block, so that few are drawn in
# vain for slow clocks, and a block takes at most 0.5 MiB.
FIRST_BLOCK, MAX_BLOCK = 8, 1 << 16


@dataclass(frozen=True, eq=False)
class Clock(Component):
    """The contract of a clock: a stateless generator of increasing tick times in seconds, all > 0.

    The caller owns the random generator of each entity, so that the ticks of an entity depend on
    nothing but its own stream.
    """

    _values = MappingProxyType(
        {"memoryless": boolean, "gaps": stated(WaitingLaw, Lattice, optional=True)}
    )

    @abstractmethod
    def ticks(
        self, entity: Entity, origin: float, index: int, now: float, random: Generator, count: int
    ) -> FloatArray:
        """Return the times (<= count,) in seconds of the next ticks of ``entity``, at most
        ``count``, from number ``index`` on, drawn from ``random``.

        Tick ``index - 1`` was at ``now`` seconds (0.0 before the first); ``origin`` is the value of
        :meth:`origin`. The result is empty if the clock has stopped for good. The times must not
        depend on ``count``: two short blocks are the same ticks as a long one.
        """

    def origin(self, entity: Entity, random: Callable[[], Generator]) -> float:
        """Return a number that is drawn once per entity from ``random()``, such as a phase.

        It is passed to every call of :meth:`ticks`; 0 if the clock needs none.
        """
        return 0.0

    def mean_rate(self, entity: Entity) -> float:
        """Return the mean ticks per second in the long run; nan if unknown before a run."""
        return math.nan

    @property
    def memoryless(self) -> bool:
        """True if the ticks are a Poisson process."""
        return False

    @property
    def gaps(self) -> WaitingLaw | Lattice | None:
        """The law of the gaps between ticks in units of their mean, 1 / ``mean_rate``; the lattice
        on which ticks lie; None if neither is known before a run.
        """
        return EXPONENTIAL if self.memoryless else None


class ClockPosition(NamedTuple):
    """The position of one entity's clock in a run, as :meth:`Clock.ticks` needs it.

    origin : the value of ``Clock.origin`` for the entity
    number : number of the next tick, from 0
    now : time of the last tick in seconds, 0 before the first
    """

    origin: float
    number: int = 0
    now: float = 0.0


def stated_rate(clock: Clock, entity: Entity, key: str) -> float:
    """Return ``clock.mean_rate``; ScenarioError at ``key`` unless it is at least 0 or nan."""
    rate: Any = clock.mean_rate(entity)
    if not (isinstance(rate, float) and (rate >= 0.0 or math.isnan(rate))):
        rate = number(low=0.0)(f"{key}.{type(clock).__name__}.mean_rate", rate)
    return float(rate)


def next_ticks(
    clock: Clock,
    entity: Entity,
    position: ClockPosition,
    random: Generator,
    count: int,
    key: str = "network.activation",
) -> FloatArray:
    """Return the times (K,) of the next ticks of the clock of ``entity`` in seconds, K <=
    ``count``, drawn from ``random`` and checked; ``position`` says how far the clock has got.

    Raises ScenarioError at ``key`` if time does not advance: the run would never end.
    """
    now = position.now
    given = clock.ticks(entity, *position, random, count)
    times = np.asarray(given)
    if times.ndim != 1 or (len(times) and times.dtype.kind not in "fiu"):
        rule = f"{type(clock).__name__}.ticks must return a vector of times, not {quote(given)}"
        raise ScenarioError(key, rule)
    times = times.astype(np.float64, copy=False)
    if len(times) and not (times[-1] > now and times[0] >= now and (np.diff(times) >= 0.0).all()):
        owner = {1: "node", 2: "link"}.get(len(entity), "entity")
        rule = f"{type(clock).__name__}: ticks of {owner} {list(entity)} must increase, "
        raise ScenarioError(
            key, rule + f"after {now:g} s", times[:3].tolist(), "correct ticks of the class"
        )
    return times


def generate_ticks(
    clock: Clock,
    entity: Entity,
    make_origin_random: Callable[[], Generator],
    random: Generator,
    horizon: float,
    key: str = "network.activation",
) -> FloatArray:
    """Return the times (K,) in seconds of all ticks of an entity in (0, ``horizon``).

    ``random`` draws the ticks. ``make_origin_random`` returns the generator of ``clock.origin``; it
    is called only if the clock draws one. Raises ScenarioError at ``key``, see ``next_ticks``.
    """
    position = ClockPosition(clock.origin(entity, make_origin_random))
    # All at once if the clock has a rate: each call has a fixed cost.
    expected = 1.1 * clock.mean_rate(entity) * horizon
    blocks = [np.empty(0)]
    count = FIRST_BLOCK if math.isnan(expected) else int(min(expected + FIRST_BLOCK, MAX_BLOCK))
    while position.now < horizon:
        block = next_ticks(clock, entity, position, random, count, key)
        if not len(block):
            break
        blocks.append(block)
        position = position._replace(number=position.number + len(block), now=float(block[-1]))
        count = min(2 * count, MAX_BLOCK)
    times = np.concatenate(blocks)
    return times[: int(np.searchsorted(times, horizon))]
