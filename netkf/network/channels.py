"""Channels: loss and delay models, and the sampling of both for one link."""

from __future__ import annotations

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    Rule,
    boolean,
    field,
    instance_of,
    matrix,
    number,
    of_time,
    one_of,
    positive,
    probability,
)
from netkf.core.laws import Chain, WaitingLaw, exponential_law, lognormal_law, uniform_law
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Link, Topology


@dataclass(frozen=True, eq=False)
class Loss(Component):
    """The contract of a loss model.

    For each activation the engine draws one uniform number; a message is delivered when that is
    below its ``delivery_probability``. Both directions share the number when the channel is
    symmetric.
    """

    _called_if = MappingProxyType({"next_state": "stateful", "at_distance": "follows_distance"})

    @abstractmethod
    def delivery_probability(
        self, link: Link, message: int, bad: bool, table_probability: float
    ) -> float:
        """Return the probability that message number ``message`` from link[0] reaches link[1].

        ``bad``: the link is in the bad one of its two states, in which losses come in bursts.
        ``table_probability`` is the entry of the graph's table for that direction, 1 without one;
        of a loss that follows the distance, what ``at_distance`` says when the message is sent.
        """
        raise NotImplementedError

    def at_distance(self, distance: float) -> float:
        """Return the delivery probability of a message between nodes at this ``distance``."""
        return 1.0

    @property
    def follows_distance(self) -> bool:
        """True if ``at_distance`` gives the ``table_probability`` of each message."""
        return False

    def next_state(self, bad: bool | None, random: np.random.Generator) -> bool:
        """Return True if the link is in its bad state at the next activation.

        ``bad`` is its state at the last activation, None at the first.
        """
        return False

    @property
    def deterministic(self) -> bool:
        """True if every delivery probability is 0 or 1, so that nothing is drawn."""
        return False

    @property
    def stateful(self) -> bool:
        """True if ``next_state`` draws."""
        return False

    def mean_delivery(self, link: Link, table_probability: float) -> float:
        """Return the fraction of messages from link[0] to link[1] that arrive in the long run, for
        theory and summaries; nan if it is unknown before a run. ``table_probability`` is the entry
        of the graph's table for that direction. By default the delivery probability of message 0 in
        the good state: override it if others differ.
        """
        return self.delivery_probability(link, 0, False, table_probability)

    @property
    def independent(self) -> bool:
        """True if the outcomes of different activations are independent."""
        return True

    @property
    def chain(self) -> Chain | None:
        """The chain of two states by which losses follow each other, if there is one."""
        return None

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the fields do not fit the graph."""


@dataclass(frozen=True, eq=False)
class NoLoss(Loss):
    """Every message arrives."""

    deterministic = True

    def delivery_probability(
        self, link: Link, message: int, bad: bool, table_probability: float
    ) -> float:
        """Return 1, for any message in any state of the link."""
        return 1.0


@dataclass(frozen=True, eq=False)
class Bernoulli(Loss):
    """A message arrives with probability ``delivery``."""

    delivery: float = field(probability)

    def delivery_probability(
        self, link: Link, message: int, bad: bool, table_probability: float
    ) -> float:
        """Return ``delivery``, for any message in any state of the link."""
        return self.delivery


@dataclass(frozen=True, eq=False)
class PerLink(Loss):
    """A message arrives with the delivery probability that the graph's table gives its link."""

    def delivery_probability(
        self, link: Link, message: int, bad: bool, table_probability: float
    ) -> float:
        """Return ``table_probability``, for any message in any state of the link."""
        return table_probability

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless the graph has a table of probabilities."""
        if topology.delivery is None:
            raise ScenarioError(
                "kind",
                "per-link needs a graph with delivery probabilities",
                "per-link",
                'use graph = { kind = "csv" } with a column delivery_probability',
            )


@dataclass(frozen=True, eq=False)
class Logistic(Component):
    """The delivery probability ``1 / (1 + exp((d - half) / width))`` at the distance d: one half at
    ``half``, and 0.73 and 0.27 a ``width`` before and after it.
    """

    kind: str = field(one_of("logistic"))
    half: float = field(number(low=0.0))
    width: float = field(positive)

    def at(self, distance: float) -> float:
        """Return the delivery probability at a ``distance``."""
        # At exp(700) the probability is below 1e-300.
        return 1.0 / (1.0 + math.exp(min((distance - self.half) / self.width, 700.0)))


def _convert_delivery(value: Any) -> Logistic | FloatArray:
    if isinstance(value, Logistic):
        return value
    if isinstance(value, Mapping):
        for key in (f.name for f in dataclasses.fields(Logistic)):
            if key not in value:
                raise ScenarioError(key, "is missing", None, f"add {key} = ...")
        for key in value.keys() - {"kind", "half", "width"}:
            remedy = "keys are kind, half, width"
            raise ScenarioError(str(key), "is not a key here", value[key], remedy)
        return Logistic(**value)
    table: FloatArray = matrix.convert(value)
    distances, probabilities = table.T  # of two columns, else a ValueError
    if distances[0] < 0.0 or (np.diff(distances) <= 0.0).any():
        raise ScenarioError("", "must have increasing distances from 0", value, "sort the rows")
    if ((probabilities < 0.0) | (probabilities > 1.0)).any():
        raise ScenarioError("", "must have probabilities from 0 to 1", value, "correct them")
    return table


_delivery = Rule(
    "must be a table [[distance, probability], ...] or a logistic function",
    _convert_delivery,
    'write delivery = { kind = "logistic", half = ..., width = ... }',
    {
        "anyOf": [
            {
                "type": "object",
                "properties": {
                    "kind": {"const": "logistic"},
                    "half": {"type": "number", "minimum": 0},
                    "width": {"type": "number", "exclusiveMinimum": 0},
                },
                "required": ["kind", "half", "width"],
                "additionalProperties": False,
            },
            dict(matrix.schema),
        ]
    },
)


@dataclass(frozen=True, eq=False)
class DistanceLoss(Loss):
    """A message arrives with a probability that depends on how far its ends are apart when it is
    sent.

    delivery  { kind = "logistic", half = ..., width = ... }: 1 / (1 + exp((d - half) / width)) at
              the distance d; or a table [[d, p], ...], linear between its rows and constant before
              the first and after the last
    """

    follows_distance = True

    delivery: Logistic | FloatArray = field(_delivery)

    def at_distance(self, distance: float) -> float:
        """Return the delivery probability of a message between nodes at this ``distance``."""
        if isinstance(self.delivery, Logistic):
            return self.delivery.at(distance)
        return float(np.interp(distance, *self.delivery.T))

    def delivery_probability(
        self, link: Link, message: int, bad: bool, table_probability: float
    ) -> float:
        """Return ``table_probability``, which is that of the distance."""
        return table_probability


@dataclass(frozen=True, eq=False)
class GilbertElliott(Loss):
    """A two-state Markov chain that makes one step per activation.

    Give either ``to_bad``, ``to_good``, ``deliver_good`` (default 1) and ``deliver_bad`` (default
    0), or ``mean_loss`` and ``mean_burst`` (activations) for a chain that loses every message in
    its bad state.
    """

    stateful = True

    to_bad: float | None = field(probability, default=None)
    to_good: float | None = field(number(above=0.0, high=1.0), default=None)
    deliver_good: float | None = field(probability, default=None)
    deliver_bad: float | None = field(probability, default=None)
    mean_loss: float | None = field(number(low=0.0, below=1.0), default=None)
    mean_burst: float | None = field(number(low=1.0), default=None)

    def __post_init__(self) -> None:
        """Check the fields; raises ScenarioError unless one of the two forms is given, and
        possible.
        """
        super().__post_init__()
        # One of two forms, each with two required fields: transition probabilities, or means.
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
        # The means imply to_bad = mean_loss / (1 - mean_loss) / mean_burst, which may exceed 1.
        if self.transitions[0] > 1.0:
            raise ScenarioError(
                "mean_burst",
                "is too short for that mean_loss",
                self.mean_burst,
                "lengthen the bursts or lower the loss",
            )

    @property
    def transitions(self) -> tuple[float, float]:
        """The probabilities that an activation turns a good state bad, and a bad one good."""
        if self.mean_loss is not None and self.mean_burst is not None:
            to_good = 1.0 / self.mean_burst
            return to_good * self.mean_loss / (1.0 - self.mean_loss), to_good
        assert self.to_bad is not None
        assert self.to_good is not None
        return self.to_bad, self.to_good

    def next_state(self, bad: bool | None, random: np.random.Generator) -> bool:
        """Return True if the chain is in its bad state after a step from ``bad``."""
        to_bad, to_good = self.transitions
        u = random.random()
        if bad is None:
            return bool(u < to_bad / (to_bad + to_good))
        return bool(u >= to_good if bad else u < to_bad)

    def delivery_probability(
        self, link: Link, message: int, bad: bool, table_probability: float
    ) -> float:
        """Return the delivery probability of any message in the ``bad`` or good state."""
        if bad:
            return 0.0 if self.deliver_bad is None else self.deliver_bad
        return 1.0 if self.deliver_good is None else self.deliver_good

    def mean_delivery(self, link: Link, table_probability: float) -> float:
        """Return the mean delivery probability under the stationary law of the two states."""
        to_bad, to_good = self.transitions
        bad = to_bad / (to_bad + to_good)
        # Of both states, in proportion to their probabilities; message and table do not matter.
        return bad * self.delivery_probability(link, 0, True, 1.0) + (
            1.0 - bad
        ) * self.delivery_probability(link, 0, False, 1.0)

    @property
    def independent(self) -> bool:
        """True only if the next state does not depend on the present one."""
        # Then both rows of the transition matrix are equal.
        return sum(self.transitions) == 1.0

    @property
    def chain(self) -> Chain:
        """The chain of the two states of a link."""
        delivery = (self.delivery_probability((0, 1), 0, bad, 1.0) for bad in (False, True))
        return Chain(*self.transitions, *delivery)


@dataclass(frozen=True, eq=False)
class Delay(Component):
    """The contract of a delay model."""

    _called_if = MappingProxyType({"draw": "is_random"})

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

    def message_delay(self, link: Link, message: int, drawn: float) -> float:
        """Return the seconds that message number ``message`` takes from link[0] to link[1].

        The result is not negative, and nan if the message is lost. ``drawn`` is the result of
        ``draw`` if delays are random, else ``fixed`` or 0.
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
        """Check the fields; raises ScenarioError if ``high`` is below ``low``."""
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


@dataclass(frozen=True, eq=False)
class Channel(Component):
    """The loss and the delay model of all messages.

    loss       which messages are lost
    delay      how long the others take
    symmetric  both messages of an activation share one fate; false: each direction has its own

    If symmetric, the two messages of one activation share one draw of each model: with equal
    probabilities both arrive or none, and both take the same random delay. Otherwise each direction
    has draws of its own. A link of a directed graph is a single direction.
    """

    loss: Loss = field(instance_of(Loss), default=NoLoss())
    delay: Delay = field(instance_of(Delay), default=NoDelay())
    symmetric: bool = field(boolean, default=True)


class ChannelDraw(NamedTuple):
    """The random numbers of one activation of a link or direction.

    ``uniform`` lies in [0, 1), ``bad`` is the state of the link and ``delay`` is in seconds.
    """

    uniform: float
    bad: bool
    delay: float


class ChannelSampler:
    """Draws the outcomes of one link (symmetric channel) or direction, activation by activation.

    ``generator`` makes the streams "loss", "weather" and "delay" of that link or direction; it is
    called only for the streams that the channel draws from.
    """

    def __init__(self, channel: Channel, generator: Callable[[str], np.random.Generator]) -> None:
        """Make the random streams that the channel draws from, by ``generator(purpose)``, one for
        each purpose, so that losses, channel states and delays do not depend on each other's number
        of draws.
        """
        self._loss, self._delay = channel.loss, channel.delay
        self._fixed_delay = channel.delay.fixed or 0.0
        self._bad: bool | None = None
        streams = {purpose: generator(purpose) for purpose in stream_purposes(channel)}
        self._loss_random = streams.get("loss")
        self._state_random = streams.get("weather")
        self._delay_random = streams.get("delay")

    def draw(self) -> ChannelDraw:
        """Return the random numbers of the next activation of the link, which decide whether and
        when its messages arrive; a delay that is not random is the fixed one or 0.
        """
        uniform, bad, delay = 0.0, False, self._fixed_delay
        if self._loss_random is not None:
            uniform = float(self._loss_random.random())
        if self._state_random is not None:
            self._bad = bad = self._loss.next_state(self._bad, self._state_random)
        if self._delay_random is not None:
            delay = self._delay.draw(self._delay_random)
        return ChannelDraw(uniform, bad, delay)

    def draws(self, count: int) -> tuple[FloatArray, np.ndarray, FloatArray]:
        """Return the numbers of the next ``count`` activations: uniform numbers, states (True: bad)
        and delays in seconds, (count,) each.

        They equal the results of ``count`` calls of ``draw``.
        """
        uniform, bad = np.zeros(count), np.zeros(count, dtype=bool)
        if self._loss_random is not None:
            uniform = self._loss_random.random(count)
        if self._state_random is not None:
            for k in range(count):
                self._bad = bad[k] = self._loss.next_state(self._bad, self._state_random)
        if self._delay_random is None:
            return uniform, bad, np.full(count, self._fixed_delay)
        return uniform, bad, draw_delays(self._delay, self._delay_random, count)


def stream_purposes(channel: Channel) -> tuple[str, ...]:
    """Return the purposes of the random streams that a ChannelSampler of this channel asks for."""
    purposes: list[str] = []
    if not channel.loss.deterministic:
        purposes.append("loss")
    if channel.loss.stateful:
        purposes.append("weather")
    if channel.delay.is_random:
        purposes.append("delay")
    return tuple(purposes)


def draw_delays(delay: Delay, random: np.random.Generator, count: int) -> FloatArray:
    """Return delays (count,) in seconds, equal to those of ``count`` calls of ``delay.draw``, but
    drawn at once where the law is a built-in one.
    """
    # By exact type: a subclass may override draw.
    if type(delay) is ExponentialDelay:
        return delay.mean * random.standard_exponential(count)
    if type(delay) is UniformDelay:
        return delay.low + (delay.high - delay.low) * random.random(count)
    return np.array([delay.draw(random) for _ in range(count)])


def identical_per_link(loss: Loss) -> bool:
    """Return True if all messages of a directed link have the same delivery probability, as long as
    nodes stay where they are.
    """
    # By exact type: a subclass may override delivery_probability.
    return type(loss) in (NoLoss, Bernoulli, PerLink, DistanceLoss)


def delivery_probabilities(
    loss: Loss, link: Link, first: int, bad: np.ndarray, table_probability: float
) -> FloatArray:
    """Return the delivery probabilities (K,) of the messages numbered ``first``, ``first + 1``, ...
    of a directed ``link`` (sender, receiver), by the loss model, which may be a user's own.

    ``bad`` (K,) holds the state of the link at each; ``table_probability`` is the entry of the
    graph's table for that direction. Raises ScenarioError for a value outside [0, 1].
    """
    if identical_per_link(loss):
        return np.full(len(bad), loss.delivery_probability(link, first, False, table_probability))
    return np.array(
        [
            checked_delivery_probability(loss, link, first + k, b, table_probability)
            for k, b in enumerate(bad.tolist())
        ]
    )


def checked_delivery_probability(
    loss: Loss, link: Link, message: int, bad: bool, table_probability: float
) -> float:
    """Return the probability that message number ``message`` on ``link`` (sender, receiver) arrives
    if the link is in the state ``bad``; raises ScenarioError if the loss model gives one outside
    [0, 1]. ``table_probability`` is the entry of the graph's table.
    """
    value = loss.delivery_probability(link, message, bad, table_probability)
    if not 0.0 <= value <= 1.0:
        rule = (
            f"{type(loss).__name__}: the delivery probability of message {message} on link "
            f"{list(link)} must be in [0, 1]"
        )
        remedy = "correct delivery_probability of the class"
        raise ScenarioError("network.channel.loss", rule, value, remedy)
    return value


def delay_depends_on_message(delay: Delay) -> bool:
    """Return True if the class overrides ``message_delay``, so that delays may depend on the
    message.
    """
    return type(delay).message_delay is not Delay.message_delay


def checked_delay(delay: Delay, link: Link, message: int, drawn: float) -> float:
    """Return the seconds that message number ``message`` on ``link`` (sender, receiver) takes, nan
    if it is lost, from the delay ``drawn`` for it; raises ScenarioError if the delay model gives a
    negative one.
    """
    seconds = delay.message_delay(link, message, drawn)
    if seconds < 0.0:
        rule = (
            f"{type(delay).__name__}: the delay of message {message} on link {list(link)} must "
            "not be negative"
        )
        remedy = "correct message_delay of the class"
        raise ScenarioError("network.channel.delay", rule, seconds, remedy)
    return seconds


def transit_time(
    channel: Channel, link: Link, message: int, draw: ChannelDraw, table_probability: float
) -> float:
    """Return the seconds that message number ``message`` on ``link`` (sender, receiver) takes to
    arrive, decided by the random numbers ``draw``; ``table_probability`` is the entry of the
    graph's table.

    The result is nan if the message is lost. Raises ScenarioError for a delivery probability
    outside [0, 1] and for a negative delay.
    """
    loss, bad = channel.loss, draw.bad
    if draw.uniform >= checked_delivery_probability(loss, link, message, bad, table_probability):
        return math.nan
    return checked_delay(channel.delay, link, message, draw.delay)
