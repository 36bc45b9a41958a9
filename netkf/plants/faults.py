"""Sensors that go bad: stuck, biased, drifting, with outliers. Filters do not know it."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError, quote
from netkf.core.fields import (
    Component,
    either,
    field,
    has_depth,
    list_of,
    node_id,
    number,
    of_time,
    positive,
    probability,
    vector,
)
from netkf.linalg.arrays import FloatArray
from netkf.plants.readings import read_many

Course = Callable[[float, FloatArray], FloatArray]
"""What a bad sensor gives at a time in seconds in place of the healthy reading y (p,)."""

_size = either(number(), vector, has_depth(1))


@dataclass(frozen=True, eq=False)
class Fault(Component):
    """The contract of faults: what a sensor gives in place of its readings in a time.

    since  seconds from which on it is bad
    until  seconds until which it is, both ends included; to the end of the run by default
    nodes  those of the sensor's nodes whose sensor is bad; all by default
    """

    since: float = field(of_time(number(low=0.0)), default=0.0)
    until: float | None = field(of_time(positive), default=None)
    nodes: tuple[int, ...] | None = field(list_of(node_id(), "node ids"), default=None)

    @abstractmethod
    def begin(self, random: np.random.Generator) -> Course:
        """Return what the sensor of one node gives in one run: a function of the time in seconds
        and the healthy reading y (p,), called for each reading of a bad time, in the order of time.
        ``random`` is a stream of that sensor.
        """

    def bias(self, time: float) -> float | FloatArray | None:
        """Return by how much a reading at ``time`` is off, None if that is not known before."""
        return None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.until is not None and self.until < self.since:
            raise ScenarioError("until", "must not be before since", self.until, "correct one")

    def holds(self, time: float) -> bool:
        """Return True if the sensor is bad at a ``time`` in seconds."""
        return self.since <= time <= (math.inf if self.until is None else self.until)


@dataclass(frozen=True, eq=False)
class Stuck(Fault):
    """A sensor gives one ``value`` (p,) whatever the state is: by default its first reading of the
    bad time.
    """

    value: FloatArray | None = field(vector, default=None)

    def begin(self, random: np.random.Generator) -> Course:
        """Return the value, or the first reading."""
        held: list[FloatArray] = [] if self.value is None else [self.value]

        def give(_: float, y: FloatArray) -> FloatArray:
            if not held:
                held.append(np.array(y))
            return held[0]

        return give


@dataclass(frozen=True, eq=False)
class Biased(Fault):
    """A sensor gives its reading plus a ``size``, one number or one for each value."""

    size: float | FloatArray = field(_size)

    def bias(self, time: float) -> float | FloatArray:
        """Return the size."""
        return self.size

    def begin(self, random: np.random.Generator) -> Course:
        """Return the sum."""
        return lambda time, y: y + self.bias(time)


@dataclass(frozen=True, eq=False)
class Drifting(Fault):
    """A sensor gives its reading plus ``rate`` times the seconds since it went bad; one number or
    one for each value.
    """

    rate: float | FloatArray = field(_size)

    def bias(self, time: float) -> float | FloatArray:
        """Return how far it has drifted at ``time``."""
        return self.rate * (time - self.since)

    def begin(self, random: np.random.Generator) -> Course:
        """Return the sum."""
        return lambda time, y: y + self.bias(time)


@dataclass(frozen=True, eq=False)
class Outliers(Fault):
    """With a ``probability`` a sensor gives its reading plus normal noise of deviation ``sigma`` in
    each value.
    """

    probability: float = field(probability)
    sigma: float = field(positive)

    def begin(self, random: np.random.Generator) -> Course:
        """Return readings of which some are off."""

        def give(_: float, y: FloatArray) -> FloatArray:
            # Drawn for all, so that one reading does not depend on others.
            off, noise = random.random() < self.probability, random.standard_normal(len(y))
            return y + self.sigma * noise if off else y

        return give


class FaultyReadings:
    """The readings of a bad sensor, in slots or in continuous time, from those of a ``path`` of a
    healthy one; ``when(k)`` is the time in seconds of reading number k.
    """

    def __init__(
        self, path: Any, fault: Fault, random: np.random.Generator, when: Callable[[int], float]
    ) -> None:
        self._path, self._fault, self._when = path, fault, when
        self._give = fault.begin(random)

    def __getattr__(self, name: str) -> Any:
        """Return what a fault does not change: matrices, and noises that readings bring."""
        return getattr(self.__dict__["_path"], name)

    def given(self, k: int, y: FloatArray) -> FloatArray:
        """Return what the sensor gives in place of its healthy reading number ``k``, y (p,)."""
        time = self._when(k)
        if not self._fault.holds(time):
            return y
        given = self._give(time, y)
        result = np.asarray(given)
        is_right = result.dtype.kind in "fiu" and result.shape == y.shape
        # A state that has left the numbers has no reading that could be healthy.
        if not is_right or (np.isfinite(y).all() and not np.isfinite(result).all()):
            rule = (
                f"what {type(self._fault).__name__}.begin returns must give finite numbers of the "
            )
            rule += f"shape {y.shape}, not {quote(given)}, at {time:g} s"
            raise ScenarioError("sensors.fault", rule)
        return result.astype(np.float64, copy=False)

    def reading(self, k: int, x: FloatArray) -> Any:
        """Return the reading number ``k``, see ``Readings`` and ``Samples``."""
        healthy = self._path.reading(k, x)
        if isinstance(healthy, tuple):
            return self.given(k, healthy[0]), healthy[1]
        return self.given(k, healthy)

    def several(self, numbers: Sequence[int], x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return readings (S, p) and H (S, p, n) of increasing ``numbers`` with x (S, n)."""
        y, H = read_many(self._path, numbers, x)
        given = [self.given(k, one) for k, one in zip(numbers, y, strict=True)]
        return np.array(given).reshape(y.shape), H
