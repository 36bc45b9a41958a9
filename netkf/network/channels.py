"""Channels: whether a message is lost and, if not, how long it takes."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Part,
    boolean,
    instance,
    number,
    positive,
    probability,
    setting,
)
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Link, Topology


@dataclass(frozen=True, eq=False)
class Loss(Part):
    """The contract of a loss model.

    For each activation the engine draws one uniform number; a message is delivered when that is
    below ``chance``. Both directions share the number when the channel is symmetric.
    """

    @abstractmethod
    def chance(self, link: Link, message: int, bad: bool, measured: float) -> float:
        """Probability that message number ``message`` from link[0] reaches link[1];
        ``measured`` is what the graph's table says of that direction (1 where it says nothing).
        """

    def weather(self, bad: bool | None, random: np.random.Generator) -> bool:
        """Whether the link is in its bad state at the next activation (None: at the first)."""
        return False

    @property
    def certain(self) -> bool:
        """Whether every chance is 0 or 1 and nothing is drawn."""
        return False

    @property
    def changing(self) -> bool:
        """Whether ``weather`` draws."""
        return False

    def mean_delivery(self, link: Link, measured: float) -> float:
        """Delivered fraction in the long run; nan where it is not known beforehand."""
        return self.chance(link, 0, False, measured)

    @property
    def independent(self) -> bool:
        """Whether the fates of different activations are independent."""
        return True

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError where the settings do not fit the graph."""


@dataclass(frozen=True, eq=False)
class NoLoss(Loss):
    """Every message arrives."""

    @property
    def certain(self) -> bool:
        """True."""
        return True

    def chance(self, link: Link, message: int, bad: bool, measured: float) -> float:
        """1."""
        return 1.0


@dataclass(frozen=True, eq=False)
class Bernoulli(Loss):
    """A message arrives with probability ``delivery``."""

    delivery: float = setting(probability)

    def chance(self, link: Link, message: int, bad: bool, measured: float) -> float:
        """``delivery``."""
        return self.delivery


@dataclass(frozen=True, eq=False)
class PerLink(Loss):
    """A message arrives with the delivery probability that the graph's table gives its link."""

    def chance(self, link: Link, message: int, bad: bool, measured: float) -> float:
        """``measured``."""
        return measured

    def check(self, topology: Topology) -> None:
        """The graph has probabilities."""
        if topology.delivery is None:
            raise ScenarioError(
                "kind",
                "per-link needs a graph with delivery probabilities",
                "per-link",
                'use graph = { kind = "csv" } with a column delivery_probability',
            )


@dataclass(frozen=True, eq=False)
class GilbertElliott(Loss):
    """A two-state chain, one step an activation.

    Either ``to_bad``, ``to_good``, ``deliver_good`` (default 1) and ``deliver_bad`` (default 0),
    or ``mean_loss`` and ``mean_burst`` (activations) for a chain that loses all in its bad state.
    """

    to_bad: float | None = setting(probability, default=None)
    to_good: float | None = setting(number(above=0.0, high=1.0), default=None)
    deliver_good: float | None = setting(probability, default=None)
    deliver_bad: float | None = setting(probability, default=None)
    mean_loss: float | None = setting(number(low=0.0, below=1.0), default=None)
    mean_burst: float | None = setting(number(low=1.0), default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        chain = {name: getattr(self, name) for name in ("to_bad", "to_good")}
        means = {name: getattr(self, name) for name in ("mean_loss", "mean_burst")}
        if any(value is not None for value in means.values()):
            extra = {**chain, "deliver_good": self.deliver_good, "deliver_bad": self.deliver_bad}
            for name, value in extra.items():
                if value is not None:
                    raise ScenarioError(
                        name,
                        "cannot stand beside mean_loss and mean_burst",
                        value,
                        "keep one of the two forms",
                    )
            chain = means
        for name, value in chain.items():
            if value is None:
                raise ScenarioError(
                    name, "is missing", None, "give to_bad and to_good, or mean_loss and mean_burst"
                )
        if self._steps[0] > 1.0:
            raise ScenarioError(
                "mean_burst",
                "is too short for that mean_loss",
                self.mean_burst,
                "lengthen the bursts or lower the loss",
            )

    @property
    def _steps(self) -> tuple[float, float]:
        if self.mean_loss is not None and self.mean_burst is not None:
            to_good = 1.0 / self.mean_burst
            return to_good * self.mean_loss / (1.0 - self.mean_loss), to_good
        assert self.to_bad is not None
        assert self.to_good is not None
        return self.to_bad, self.to_good

    @property
    def changing(self) -> bool:
        """True."""
        return True

    def weather(self, bad: bool | None, random: np.random.Generator) -> bool:
        """One step of the chain; the first state is stationary."""
        to_bad, to_good = self._steps
        u = random.random()
        if bad is None:
            return bool(u < to_bad / (to_bad + to_good))
        return bool(u >= to_good if bad else u < to_bad)

    def chance(self, link: Link, message: int, bad: bool, measured: float) -> float:
        """Delivery probability of the state."""
        if bad:
            return 0.0 if self.deliver_bad is None else self.deliver_bad
        return 1.0 if self.deliver_good is None else self.deliver_good

    def mean_delivery(self, link: Link, measured: float) -> float:
        """Under the stationary law."""
        to_bad, to_good = self._steps
        bad = to_bad / (to_bad + to_good)
        return bad * self.chance(link, 0, True, 1.0) + (1.0 - bad) * self.chance(
            link, 0, False, 1.0
        )

    @property
    def independent(self) -> bool:
        """Only when the chain forgets its state in one step."""
        return sum(self._steps) == 1.0


@dataclass(frozen=True, eq=False)
class Delay(Part):
    """The contract of a delay model."""

    @abstractmethod
    def draw(self, random: np.random.Generator) -> float:
        """Seconds, not negative; once per activation, and only if ``drawn``."""

    @property
    def fixed(self) -> float | None:
        """The delay where it is always the same, else None."""
        return None

    @property
    def longest(self) -> float:
        """The longest delay there can be, seconds; inf if there is no bound."""
        return math.inf if self.fixed is None else self.fixed

    @property
    def drawn(self) -> bool:
        """Whether ``draw`` is called."""
        return self.fixed is None

    def message_delay(self, link: Link, message: int, drawn: float) -> float:
        """Seconds that message number ``message`` takes from link[0] to link[1], not negative; nan
        if it is lost. ``drawn`` is what ``draw`` gave, or ``fixed``, or else 0.
        """
        return drawn

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the settings do not fit the graph."""


@dataclass(frozen=True, eq=False)
class NoDelay(Delay):
    """A message arrives when it is sent."""

    def draw(self, random: np.random.Generator) -> float:
        """0."""
        return 0.0

    @property
    def fixed(self) -> float | None:
        """0."""
        return 0.0


@dataclass(frozen=True, eq=False)
class ConstantDelay(Delay):
    """``seconds`` for every message."""

    seconds: float = setting(number(low=0.0))

    def draw(self, random: np.random.Generator) -> float:
        """``seconds``."""
        return self.seconds

    @property
    def fixed(self) -> float | None:
        """``seconds``."""
        return self.seconds


@dataclass(frozen=True, eq=False)
class ExponentialDelay(Delay):
    """Exponential with the given ``mean`` in seconds."""

    mean: float = setting(positive)

    def draw(self, random: np.random.Generator) -> float:
        """One draw."""
        return self.mean * random.standard_exponential()


@dataclass(frozen=True, eq=False)
class UniformDelay(Delay):
    """Uniform between ``low`` and ``high`` seconds."""

    low: float = setting(number(low=0.0))
    high: float = setting(number(low=0.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.high < self.low:
            raise ScenarioError("high", "must be at least low", self.high, "swap the two")

    @property
    def longest(self) -> float:
        """``high``."""
        return self.high

    def draw(self, random: np.random.Generator) -> float:
        """One draw."""
        return self.low + (self.high - self.low) * random.random()


@dataclass(frozen=True, eq=False)
class LognormalDelay(Delay):
    """Lognormal with ``mean`` seconds; ``sigma`` is the standard deviation of its logarithm."""

    mean: float = setting(positive)
    sigma: float = setting(number(low=0.0))

    def draw(self, random: np.random.Generator) -> float:
        """One draw."""
        return self.mean * math.exp(self.sigma * (random.standard_normal() - 0.5 * self.sigma))


@dataclass(frozen=True, eq=False)
class Channel(Part):
    """Loss and delay of every message.

    ``symmetric``: the two messages of one activation share one draw of each, so that with equal
    probabilities both arrive or none; else each direction has its own. In a directed graph every
    link is one direction and has its own.
    """

    loss: Loss = setting(instance(Loss), default=NoLoss())
    delay: Delay = setting(instance(Delay), default=NoDelay())
    symmetric: bool = setting(boolean, default=True)


class Fates:
    """What one link (symmetric) or one direction of it draws, activation after activation.

    ``generator`` makes the streams "loss", "weather" and "delay" of that link or direction; those
    that are not needed are not made.
    """

    def __init__(self, channel: Channel, generator: Callable[[str], np.random.Generator]) -> None:
        self._loss, self._delay = channel.loss, channel.delay
        self._fixed = channel.delay.fixed or 0.0
        self._bad: bool | None = None
        made = {purpose: generator(purpose) for purpose in needed(channel)}
        self._luck, self._sky = made.get("loss"), made.get("weather")
        self._post = made.get("delay")

    def draw(self) -> tuple[float, bool, float]:
        """A uniform number, whether the link is in its bad state, and a delay in seconds (0 if
        none is drawn).
        """
        luck, bad, delay = 0.0, False, self._fixed
        if self._luck is not None:
            luck = float(self._luck.random())
        if self._sky is not None:
            self._bad = bad = self._loss.weather(self._bad, self._sky)
        if self._post is not None:
            delay = self._delay.draw(self._post)
        return luck, bad, delay

    def draws(self, count: int) -> tuple[FloatArray, np.ndarray, FloatArray]:
        """The next ``count`` draws at once, (count,) each; the same numbers."""
        luck, bad = np.zeros(count), np.zeros(count, dtype=bool)
        if self._luck is not None:
            luck = self._luck.random(count)
        if self._sky is not None:
            for k in range(count):
                self._bad = bad[k] = self._loss.weather(self._bad, self._sky)
        if self._post is None:
            return luck, bad, np.full(count, self._fixed)
        return luck, bad, delays(self._delay, self._post, count)


def needed(channel: Channel) -> tuple[str, ...]:
    """The purposes for which Fates asks for a stream."""
    asked: list[str] = []
    if not channel.loss.certain:
        asked.append("loss")
    if channel.loss.changing:
        asked.append("weather")
    if channel.delay.drawn:
        asked.append("delay")
    return tuple(asked)


def delays(delay: Delay, random: np.random.Generator, count: int) -> FloatArray:
    """(count,) seconds, the same as that many calls of ``delay.draw``."""
    # By exact type: a class derived from one of these may draw in its own way.
    if type(delay) is ExponentialDelay:
        return delay.mean * random.standard_exponential(count)
    if type(delay) is UniformDelay:
        return delay.low + (delay.high - delay.low) * random.random(count)
    return np.array([delay.draw(random) for _ in range(count)])


def alike(loss: Loss) -> bool:
    """Whether all messages of a link have one chance; by exact type, since a class derived from
    one of these may have its own way.
    """
    return type(loss) in (NoLoss, Bernoulli, PerLink)


def chances(loss: Loss, link: Link, first: int, bad: np.ndarray, measured: float) -> FloatArray:
    """(count,) ``loss.chance`` of the messages from number ``first`` on, ``bad`` (count,)."""
    if alike(loss):
        return np.full(len(bad), loss.chance(link, first, False, measured))
    return np.array(
        [checked_chance(loss, link, first + k, b, measured) for k, b in enumerate(bad.tolist())]
    )


def checked_chance(loss: Loss, link: Link, message: int, bad: bool, measured: float) -> float:
    """``loss.chance``; raises ScenarioError where it is no probability."""
    chance = loss.chance(link, message, bad, measured)
    if not 0.0 <= chance <= 1.0:
        words = f"{type(loss).__name__}: the chance of message {message} on link {list(link)} must"
        remedy = "mend chance of the class"
        raise ScenarioError("network.channel.loss", f"{words} be in [0, 1]", chance, remedy)
    return chance


def by_message(delay: Delay) -> bool:
    """Whether delays depend on the message, so that ``message_delay`` must be asked."""
    return type(delay).message_delay is not Delay.message_delay


def checked_delay(delay: Delay, link: Link, message: int, drawn: float) -> float:
    """``delay.message_delay``; raises ScenarioError if it is negative."""
    seconds = delay.message_delay(link, message, drawn)
    if seconds < 0.0:
        words = f"{type(delay).__name__}: the delay of message {message} on link {list(link)} must"
        remedy = "mend message_delay of the class"
        raise ScenarioError("network.channel.delay", f"{words} not be negative", seconds, remedy)
    return seconds


def outcome(
    channel: Channel,
    link: Link,
    message: int,
    draw: tuple[float, bool, float],
    measured: float,
) -> float:
    """Seconds after which message number ``message`` of a directed link arrives, nan if it is
    lost; ``draw`` is that of Fates. Raises ScenarioError for chances and delays that are none.
    """
    luck, bad, delay = draw
    if luck >= checked_chance(channel.loss, link, message, bad, measured):
        return math.nan
    return checked_delay(channel.delay, link, message, delay)
