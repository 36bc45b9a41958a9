"""Channels: a loss and a delay model together, and the sampling of both for one link."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.fields import Component, boolean, field, instance_of
from netkf.linalg.arrays import FloatArray
from netkf.network.delays import Delay, NoDelay, checked_delay, draw_delays
from netkf.network.losses import (
    Loss,
    NoLoss,
    Transmission,
    checked_delivery_probability,
    has_conditions,
)
from netkf.rng.streams import Streams


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


def conditions_of(loss: Loss, streams: Streams, horizon: float) -> Any:
    """Return the conditions that the loss draws for the run of ``streams``, if it does."""
    if not has_conditions(loss):
        return None
    return loss.conditions(streams.generator("conditions"), horizon)


def transit_time(channel: Channel, sent: Transmission, draw: ChannelDraw) -> float:
    """Return the seconds that the message ``sent`` takes to arrive, decided by the random numbers
    ``draw``.

    The result is nan if the message is lost. Raises ScenarioError for a delivery probability
    outside [0, 1] and for a negative delay.
    """
    if draw.uniform >= checked_delivery_probability(channel.loss, sent):
        return math.nan
    return checked_delay(channel.delay, sent, draw.delay)
