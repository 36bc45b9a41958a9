"""Channels of replays, in which chosen messages of a run are delivered whatever was drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from netkf.core.fields import field, instance_of
from netkf.linalg.arrays import FloatArray
from netkf.network.delays import Delay
from netkf.network.graphs import Link, Topology
from netkf.network.losses import Loss, Transmission, delivery_probabilities
from netkf.network.scheduled import Hopping


class MessageKey(NamedTuple):
    """The identity of a message: its directed link and its number there, from 0."""

    sender: int
    receiver: int
    number: int


Chosen = frozenset[MessageKey]


class Deliveries:
    """The messages that are delivered in the next replay of a run whatever was drawn: ``chosen``,
    all if None. Those in ``without_delay`` take no time.
    """

    def __init__(self) -> None:
        self.choose(frozenset())
        self._given: dict[tuple[Link, int, int, float], FloatArray] = {}

    def choose(self, chosen: Chosen | None, without_delay: Chosen = frozenset()) -> None:
        """Deliver these messages in the next replay."""
        self.chosen, self.without_delay = chosen, without_delay
        self._numbers: dict[Link, list[int]] = {}
        for sender, receiver, message in chosen or ():
            self._numbers.setdefault((sender, receiver), []).append(message)

    def given(self, loss: Loss, sent: Transmission, hops: Hopping | None = None) -> FloatArray:
        """Return the delivery probabilities (K,) of ``sent``, the same in each replay."""
        # A message has another time if a node that decides was silent before.
        number, time = (sent.number[0], sent.time[0]) if len(sent.number) else (0, 0.0)
        key = sent.link, int(number), len(sent.number), float(time)
        if key not in self._given:
            values = delivery_probabilities(loss, sent)
            self._given[key] = values if hops is None else values * hops.delivery(sent)
        return self._given[key]

    def are_chosen(self, link: Link, numbers: np.ndarray) -> np.ndarray:
        """Return (K,) bool: which messages of a directed link, of these ``numbers``, are chosen."""
        if self.chosen is None:
            return np.ones(len(numbers), dtype=bool)
        # Sorted, and beyond all numbers in the end: quicker than np.isin of so few.
        chosen = np.array([*sorted(self._numbers.get(link, ())), np.iinfo(np.int64).max])
        return np.asarray(chosen[np.searchsorted(chosen, numbers)] == numbers)


def _of_given(name: str) -> Any:
    """Return a property with the value of the model ``given``."""
    return property(lambda self: getattr(self.given, name), doc="The value of the model ``given``.")


@dataclass(frozen=True, eq=False)
class DeliveringLoss(Loss):
    """The loss model ``given`` of the run, and that of the ``channels`` over which its messages
    hop, except that the messages of ``deliveries`` arrive.

    All but the chosen messages have the same draws and outcomes as in the run.
    """

    independent = False
    vectorised = True

    given: Loss = field(instance_of(Loss))
    # A mutable object, set before each replay: one scenario with its cached tables serves all.
    deliveries: Deliveries = field(instance_of(Deliveries))
    channels: Hopping | None = field(instance_of(Hopping), default=None)

    stateful = _of_given("stateful")
    follows_distance = _of_given("follows_distance")
    fate_share = _of_given("fate_share")
    state_of = _of_given("state_of")

    @property
    def deterministic(self) -> bool:
        """True if outcomes need no random number, as in the run."""
        return self.given.deterministic and self.channels is None

    def conditions(self, random: np.random.Generator, horizon: float) -> Any:
        """Return the conditions of the run by the model ``given``."""
        return self.given.conditions(random, horizon)

    def next_state(self, link: Link, bad: bool | None, random: np.random.Generator) -> bool:
        """Return the next state of the channel, True if it is bad, by the model ``given``."""
        return self.given.next_state(link, bad, random)

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return 1 for messages that the replay delivers, else the given probability."""
        chosen = self.deliveries.chosen
        if np.ndim(sent.number) == 0:
            if chosen is None or (*sent.link, sent.number) in chosen:
                return 1.0
            given = self.given.delivery_probability(sent)
            return given if self.channels is None else given * self.channels.delivery(sent)
        values = self.deliveries.given(self.given, sent, self.channels).copy()
        values[self.deliveries.are_chosen(sent.link, sent.number)] = 1.0
        return values

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

    fixed = _of_given("fixed")
    longest = _of_given("longest")
    is_random = _of_given("is_random")

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
