"""Loss models: which messages are lost."""

from __future__ import annotations

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    Rule,
    field,
    matrix,
    number,
    one_of,
    positive,
    probability,
)
from netkf.core.laws import Chain
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
