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
    """One message between nodes given by their indices; ``arrives`` is nan for a lost one."""

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

    ``times`` are instants (seconds) of events other than samples and arrivals. In slots,
    ``takes_messages`` says that ``exchange`` looks at the messages that it is given.
    """

    takes_messages: ClassVar[bool] = True

    def __init__(
        self, scenario: Scenario, errors: StackedErrors, times: Collection[float] = ()
    ) -> None:
        self.scenario, self.errors, self.times = scenario, errors, times

    def sense(self, time: float, observations: EstimatorObservations) -> None:
        """Update each estimator by its readings of this instant."""
        columns = self.errors.reading_noises(observations)
        for estimator, observation in observations.items():
            self.errors.update(estimator, observation, columns[estimator])

    def send(self, messages: Sequence[SentMessage]) -> None:
        """Record messages that leave at this instant and will arrive."""

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Use all messages that arrive at this instant; instantaneous ones were sent just now."""

    def exchange(self, slot: int, phase: int, messages: Sequence[SentMessage]) -> None:
        """Use the messages that arrived in time in exchange number ``phase`` of a slot."""
        self.arrive(slot, messages)

    def elapse(self, gap: float, columns: slice | None, noise: FloatArray | None) -> None:
        """Advance quantities other than estimates by ``gap`` seconds.

        Without increments the plant's noise is ``noise`` (n, k) times the inputs in ``columns``.
        """


class EstimateExchangeRule(ErrorRule):
    """Filters that send their estimate, which the receiver predicts to the time of arrival."""

    def send(self, messages: Sequence[SentMessage]) -> None:
        """Copy the sender's estimate for each message that takes time."""
        for message in messages:
            if message.late:
                self.errors.copy(message.sender, message, None)

    def arrive(self, time: float, messages: Sequence[SentMessage]) -> None:
        """Combine each receiver's estimate with the newest message of each sender."""
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
        """Return the new root (n, n) of a receiver, and the factor of each error that enters."""
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
        """Return the new root (n, n) and the factor (n, n) of each error.

        ``roots``: the node's own first, then those of the messages, which have ``weights``.
        """
