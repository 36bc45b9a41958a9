"""Delay models: how long messages take."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    Rule,
    boolean,
    either,
    field,
    number,
    of_time,
    positive,
    stated,
)
from netkf.core.laws import WaitingLaw, exponential_law, lognormal_law, uniform_law
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Topology
from netkf.network.losses import Transmission, each_message, is_vectorised

_SECONDS = number(low=0.0)


_NONE, _FOREVER = Rule("must be None", lambda value: value), Rule("must be inf", float)


def _is_infinite(value: object) -> bool:
    return isinstance(value, float) and value == math.inf


@dataclass(frozen=True, eq=False)
class Delay(Component):
    """The contract of a delay model."""

    _called_if = MappingProxyType({"draw": "is_random"})
    _values = MappingProxyType(
        {
            "fixed": either(_SECONDS, _NONE, lambda value: value is None),
            "longest": either(_SECONDS, _FOREVER, _is_infinite),
            "is_random": boolean,
            "vectorised": boolean,
            "law": stated(WaitingLaw, optional=True),
        }
    )

    vectorised: ClassVar[bool] = False
    """True if ``message_delay`` takes many messages of a link at once."""

    @abstractmethod
    def draw(self, random: np.random.Generator) -> float:
        """Draw a delay in seconds, not negative; called once per activation if ``is_random``."""

    @property
    def fixed(self) -> float | None:
        """The delay in seconds if it is constant, else None."""
        return None

    @property
    def longest(self) -> float:
        """The largest possible delay in seconds; inf if there is no bound."""
        return math.inf if self.fixed is None else self.fixed

    @property
    def is_random(self) -> bool:
        """True if ``draw`` is called."""
        return self.fixed is None

    @property
    def law(self) -> WaitingLaw | None:
        """The law of the delays of independent messages in seconds; None if it is constant, or
        unknown before a run.
        """
        return None

    def message_delay(self, sent: Transmission, drawn: Any) -> Any:
        """Return the seconds that the message ``sent`` takes.

        The result is not negative, and nan if the message is lost. ``drawn`` is the result of
        ``draw`` if delays are random, else ``fixed`` or 0. Where the class is ``vectorised``
        ``sent`` may be many messages of a link, and the result an array.
        """
        return drawn

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the fields do not fit the graph."""


@dataclass(frozen=True, eq=False)
class NoDelay(Delay):
    """A message arrives when it is sent."""

    fixed = 0.0

    def draw(self, random: np.random.Generator) -> float:
        """Return 0."""
        return 0.0


@dataclass(frozen=True, eq=False)
class ConstantDelay(Delay):
    """A delay of ``seconds`` for every message."""

    seconds: float = field(of_time(number(low=0.0)))

    def draw(self, random: np.random.Generator) -> float:
        """Return ``seconds``."""
        return self.seconds

    @property
    def fixed(self) -> float | None:
        """The field ``seconds``."""
        return self.seconds


@dataclass(frozen=True, eq=False)
class ExponentialDelay(Delay):
    """Exponential delays with the given ``mean`` in seconds."""

    mean: float = field(positive)

    @property
    def law(self) -> WaitingLaw:
        """The exponential law of that mean."""
        return exponential_law(self.mean)

    def draw(self, random: np.random.Generator) -> float:
        """Draw a delay in seconds."""
        return self.mean * random.standard_exponential()


@dataclass(frozen=True, eq=False)
class UniformDelay(Delay):
    """Delays that are uniform between ``low`` and ``high`` seconds."""

    low: float = field(of_time(number(low=0.0)))
    high: float = field(of_time(number(low=0.0)))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.high < self.low:
            raise ScenarioError("high", "must be at least low", self.high, "swap the two")

    @property
    def longest(self) -> float:
        """The field ``high``, in seconds."""
        return self.high

    @property
    def law(self) -> WaitingLaw | None:
        """The uniform law, None if both ends are equal."""
        return uniform_law(self.low, self.high) if self.high > self.low else None

    def draw(self, random: np.random.Generator) -> float:
        """Draw a delay in seconds."""
        return self.low + (self.high - self.low) * random.random()


@dataclass(frozen=True, eq=False)
class LognormalDelay(Delay):
    """Lognormal delays of ``mean`` seconds; their logarithm has standard deviation ``sigma``."""

    mean: float = field(positive)
    sigma: float = field(number(low=0.0))

    @property
    def law(self) -> WaitingLaw | None:
        """The lognormal law, None without spread."""
        return lognormal_law(self.mean, self.sigma) if self.sigma > 0.0 else None

    def draw(self, random: np.random.Generator) -> float:
        """Draw a delay in seconds."""
        return self.mean * math.exp(self.sigma * (random.standard_normal() - 0.5 * self.sigma))


def draw_delays(delay: Delay, random: np.random.Generator, count: int) -> FloatArray:
    """Return delays (count,) in seconds, as of ``delay.draw``, at once for a built-in law."""
    # By exact type: a subclass may override draw.
    if type(delay) is ExponentialDelay:
        return delay.mean * random.standard_exponential(count)
    if type(delay) is UniformDelay:
        return delay.low + (delay.high - delay.low) * random.random(count)
    return np.array([draw_delay(delay, random) for _ in range(count)])


def draw_delay(delay: Delay, random: np.random.Generator) -> float:
    """Return ``delay.draw`` in seconds; raises ScenarioError unless it is finite and at least 0."""
    seconds: Any = delay.draw(random)
    if not (isinstance(seconds, float) and 0.0 <= seconds < math.inf):
        seconds = _SECONDS(f"network.channel.delay.{type(delay).__name__}.draw", seconds)
    return float(seconds)


def delay_depends_on_message(delay: Delay) -> bool:
    """Return True if the class overrides ``message_delay``."""
    return type(delay).message_delay is not Delay.message_delay


def checked_delays(delay: Delay, sent: Transmission, drawn: FloatArray) -> FloatArray:
    """Return the seconds (K,) that K messages ``sent`` on a link take; see ``checked_delay``."""
    if is_vectorised(delay, "message_delay"):
        seconds = np.asarray(delay.message_delay(sent, drawn), dtype=np.float64)
        if seconds.shape == drawn.shape and not ((seconds < 0.0) | np.isinf(seconds)).any():
            return seconds
    ones = zip(each_message(sent), drawn.tolist(), strict=True)
    return np.array([checked_delay(delay, *one) for one in ones])


def checked_delay(delay: Delay, sent: Transmission, drawn: float) -> float:
    """Return the seconds that ``sent`` takes, nan if lost; raises ScenarioError."""
    seconds: Any = delay.message_delay(sent, drawn)
    if not isinstance(seconds, float):  # a float32 would make times of its precision
        name = f"{type(delay).__name__}.message_delay"
        seconds = number()(f"network.channel.delay.{name}", seconds)
    if seconds < 0.0 or math.isinf(seconds):
        rule = (
            f"{type(delay).__name__}: the delay of message {sent.number} on link "
            f"{list(sent.link)} must be finite and not negative"
        )
        remedy = "correct message_delay of the class"
        raise ScenarioError("network.channel.delay", rule, seconds, remedy)
    return float(seconds)
