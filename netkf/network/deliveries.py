"""Channels of replays, in which chosen messages of a run are delivered whatever was drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.fields import field, instance_of
from netkf.network.delays import Delay
from netkf.network.graphs import Link, Topology
from netkf.network.losses import Loss, Transmission


class MessageKey(NamedTuple):
    """The identity of a message: its directed link and its number on that link,
    from 0.
    """

    sender: int
    receiver: int
    number: int


Chosen = frozenset[MessageKey]


class Deliveries:
    """The messages that are delivered in the next replay of a run whatever was drawn: ``chosen``,
    all if None. Those in ``without_delay`` take no time.
    """

    def __init__(self) -> None:
        self.chosen: Chosen | None = frozenset()
        self.without_delay: Chosen = frozenset()


@dataclass(frozen=True, eq=False)
class DeliveringLoss(Loss):
    """The loss model ``given`` of the run, except that the messages of ``deliveries`` arrive.

    All but the chosen messages have the same draws and outcomes as in the run.
    """

    independent = False

    given: Loss = field(instance_of(Loss))
    # A mutable object, set before each replay: one scenario with its cached tables serves all.
    deliveries: Deliveries = field(instance_of(Deliveries))

    @property
    def deterministic(self) -> bool:
        """The value of the model ``given``, so that the same numbers are drawn."""
        return self.given.deterministic

    @property
    def stateful(self) -> bool:
        """The value of the model ``given``, so that the same numbers are drawn."""
        return self.given.stateful

    @property
    def follows_distance(self) -> bool:
        """The value of the model ``given``."""
        return self.given.follows_distance

    def conditions(self, random: np.random.Generator, horizon: float) -> Any:
        """Return the conditions of the run by the model ``given``."""
        return self.given.conditions(random, horizon)

    @property
    def fate_share(self) -> float:
        """The value of the model ``given``, so that the same numbers are drawn."""
        return self.given.fate_share

    @property
    def state_of(self) -> str:
        """The value of the model ``given``, so that the same numbers are drawn."""
        return self.given.state_of

    def next_state(self, link: Link, bad: bool | None, random: np.random.Generator) -> bool:
        """Return the next state of the channel, True if it is bad, by the model ``given``."""
        return self.given.next_state(link, bad, random)

    def delivery_probability(self, sent: Transmission) -> float:
        """Return 1 for messages that the replay delivers, else the given probability."""
        chosen = self.deliveries.chosen
        if chosen is None or (*sent.link, sent.number) in chosen:
            return 1.0
        return float(self.given.delivery_probability(sent))

    def mean_delivery(self, sent: Transmission) -> float:
        """Return nan: this is one outcome, not a law."""
        return math.nan

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the model ``given`` does not fit the graph."""
        self.given.check(topology)


@dataclass(frozen=True, eq=False)
class DelayUnlessWaived(Delay):
    """The delay model ``given`` of the run, except that the messages in
    ``deliveries.without_delay`` take no time.
    """

    given: Delay = field(instance_of(Delay))
    deliveries: Deliveries = field(instance_of(Deliveries))

    def draw(self, random: np.random.Generator) -> float:
        """Return a draw of the model ``given``."""
        return self.given.draw(random)

    @property
    def fixed(self) -> float | None:
        """The value of the model ``given``."""
        return self.given.fixed

    @property
    def longest(self) -> float:
        """The value of the model ``given``."""
        return self.given.longest

    @property
    def is_random(self) -> bool:
        """The value of the model ``given``, so that the same numbers are drawn."""
        return self.given.is_random

    def message_delay(self, sent: Transmission, drawn: float) -> float:
        """Return the delay in seconds: 0 for a message in ``deliveries.without_delay``."""
        chosen, key = self.deliveries.chosen, (*sent.link, sent.number)
        if key in self.deliveries.without_delay:
            return 0.0
        seconds = self.given.message_delay(sent, drawn)
        delivered = chosen is None or key in chosen
        return 0.0 if delivered and math.isnan(seconds) else seconds

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError if the model ``given`` does not fit the graph."""
        self.given.check(topology)
