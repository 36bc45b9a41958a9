"""Rules by which filters use readings and messages, applied to stacked errors.

The replay calls a rule for each event in the order of the run: ``sense`` for the samples of an
instant, ``send`` when messages leave, ``arrive`` when they arrive.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Hashable, Iterable, Sequence
from typing import ClassVar, NamedTuple

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import EstimatorObservations
from netkf.theory.common.stacked_errors import StackedErrors, Term


class SentMessage(NamedTuple):
    """One message between nodes given by their indices.

    ``number`` counts the messages of its link; ``time`` and ``arrives`` are seconds
    (the slot, in runs in slots), and ``arrives`` is nan for a lost message.
    """

    sender: int
    receiver: int
    number: int
    time: float
    arrives: float

    @property
    def late(self) -> bool:
        """True if the message arrives after the instant at which it was sent."""
        return self.arrives > self.time


class ErrorRule:
    """Rule of filters that use their own readings only; rules of other filters derive from it.

    ``times`` are the instants (seconds) of events other than samples and arrivals.
    ``takes_messages`` is False if ``exchange`` ignores its messages, which then need not be built.
    """

    takes_messages: ClassVar[bool] = True

    def __init__(
        self, scenario: Scenario, errors: StackedErrors, times: Collection[float] = ()
    ) -> None:
        """Take the stacked ``errors`` of the scenario's nodes, which the rule changes, and
        ``times``.
        """
        self.scenario, self.errors, self.times = scenario, errors, times

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update the errors and roots of P of each estimator by its readings at ``time``
        (seconds, or the slot); called by the replay at every time of samples, messages or
        ``times``, before ``send`` and ``arrive``.
        """
        columns = self.errors.reading_noises(observations)
        for estimator, observation in observations.items():
            self.errors.update(estimator, observation, columns[estimator])

    def send(self, messages: Sequence[SentMessage]) -> None:
        """Record messages that leave at this instant and will arrive."""

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Use all messages that arrive at ``time`` (seconds, or the slot); those without delay also
        left at it. Filters without messages ignore them.
        """

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Use the messages that arrived in time in exchange number ``phase`` of a slot."""
        self.arrive(slot, messages)

    def elapse(self, gap: float, columns: slice | None, noise: FloatArray | None) -> None:
        """Predict quantities other than estimates over ``gap`` seconds.

        ``noise`` (n, k) times the inputs in ``columns`` is the plant's noise over the gap. Both are
        None if a sensor senses increments, or if the gap is 0.
        """


class EstimateExchangeRule(ErrorRule):
    """Filters that send their estimate, which the receiver predicts to the time of arrival."""

    def send(self, messages: Sequence[SentMessage]) -> None:
        """Copy the sender's present error and root of P for each message that arrives later; the
        replay predicts the copies until then.
        """
        for message in messages:
            if message.late:
                self.errors.copy(message.sender, message, None)

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Combine the estimate of each receiver with the newest message of each sender; changes
        errors and roots of P of the receivers, and drops the copies that late messages carried.
        """
        inboxes: dict[int, dict[int, SentMessage]] = {}
        # Messages of one sender can overtake each other: the last one sent counts.
        for message in sorted(messages, key=lambda m: (m.sender, m.time, m.number)):
            inboxes.setdefault(message.receiver, {})[message.sender] = message
        changes: dict[Hashable, tuple[FloatArray, Sequence[Term]]] = {
            receiver: self._combine_inbox(receiver, list(inbox.values()))
            for receiver, inbox in inboxes.items()
        }
        # All at once: a message carries the sender's estimate from before this instant's resets.
        self.errors.combine(changes)
        self.errors.drop([message for message in messages if message.late])

    def _combine_inbox(
        self, receiver: int, inbox: list[SentMessage]
    ) -> tuple[FloatArray, list[tuple[Hashable, FloatArray]]]:
        """Return the new root (n, n) of P of the node with index ``receiver``, and the terms of its
        new error: for its own estimate and for each message of the ``inbox`` a name and a factor
        (n, n).
        """
        # An instantaneous message needs no copy: its content is the sender's present estimate.
        sources: list[Hashable] = [receiver]
        sources += [message if message.late else message.sender for message in inbox]
        nodes, scenario = self.scenario.nodes, self.scenario
        weights = [scenario.weight(nodes[receiver], nodes[m.sender]) for m in inbox]
        roots = [self.errors.roots[source] for source in sources]
        root, factors = self.combine(nodes[receiver], weights, roots)
        return root, list(zip(sources, factors, strict=True))

    @abstractmethod
    def combine(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, Iterable[FloatArray]]:
        """Return how the filter combines a node's estimate with messages, called for every receiver
        at every arrival: the root (n, n) of the new P, and factors (n, n); the new error is the sum
        of the errors, each multiplied by its factor.

        ``roots`` (n, n) of P are those of the node's estimate and of the k messages, in this order,
        which is also that of the factors; ``weights`` (k) are those of the messages.
        """
