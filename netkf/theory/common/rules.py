"""What each filter does with readings and messages, as moves of stacked errors.

A rule is told what happens in its order: ``sense`` at the samples of an instant, ``send`` when
messages leave, ``arrive`` when they are there.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Hashable, Sequence
from typing import NamedTuple

from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observed import Observed
from netkf.theory.common.stacked_errors import Errors, Part


class Sent(NamedTuple):
    """One message, named by places of nodes; ``arrives`` is nan where it never does."""

    sender: int
    receiver: int
    number: int
    time: float
    arrives: float

    @property
    def late(self) -> bool:
        """Whether it takes time."""
        return self.arrives > self.time


class Rule:
    """The base class is that of filters that do not talk.

    ``times`` are instants at which more happens than samples and messages that arrive.
    """

    def __init__(self, scenario: Scenario, errors: Errors, times: Collection[float] = ()) -> None:
        self.scenario, self.errors, self.times = scenario, errors, times

    def sense(self, time: float, seen: Observed) -> None:
        """Readings of this instant, by host."""
        columns = self.errors.readings(seen)
        for host, one in seen.items():
            self.errors.update(host, one, columns[host])

    def send(self, messages: Sequence[Sent]) -> None:
        """Messages leave that will arrive."""

    def arrive(self, time: float, messages: Sequence[Sent]) -> None:
        """All messages of this instant; what took no time left just now."""

    def exchange(self, slot: int, phase: int, messages: Sequence[Sent]) -> None:
        """What arrived in time in exchange number ``phase`` of a slot."""
        self.arrive(slot, messages)

    def passed(self, gap: float, columns: slice | None, noise: FloatArray | None) -> None:
        """Time has passed; without increments the plant's noise is ``noise`` (n, k) times the
        inputs in ``columns``.
        """


class Estimates(Rule):
    """Filters whose messages are the sender's estimate, predicted to its arrival."""

    def send(self, messages: Sequence[Sent]) -> None:
        """What takes time is copied."""
        for message in messages:
            if message.late:
                self.errors.copy(message.sender, message, None)

    def arrive(self, time: float, messages: Sequence[Sent]) -> None:
        """Of several messages of one sender the newest counts."""
        inboxes: dict[int, dict[int, Sent]] = {}
        for message in sorted(messages, key=lambda m: (m.sender, m.time, m.number)):
            inboxes.setdefault(message.receiver, {})[message.sender] = message
        changes: dict[Hashable, tuple[FloatArray, Sequence[Part]]] = {
            receiver: self._used(receiver, list(inbox.values()))
            for receiver, inbox in inboxes.items()
        }
        self.errors.combine(changes)
        self.errors.drop([message for message in messages if message.late])

    def _used(
        self, receiver: int, inbox: list[Sent]
    ) -> tuple[FloatArray, list[tuple[Hashable, FloatArray]]]:
        sources: list[Hashable] = [receiver]
        sources += [message if message.late else message.sender for message in inbox]
        nodes, scenario = self.scenario.nodes, self.scenario
        weights = [scenario.weight(nodes[receiver], nodes[m.sender]) for m in inbox]
        roots = [self.errors.roots[source] for source in sources]
        root, matrices = self.combined(nodes[receiver], weights, roots)
        return root, list(zip(sources, matrices, strict=True))

    @abstractmethod
    def combined(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """The new root, and the matrix of the own error and of each that was heard."""
