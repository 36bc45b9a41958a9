"""What each filter does with readings and messages, as moves of stacked errors.

A rule is told what happens in its order: ``sense`` at the samples of an instant, ``send`` when
messages leave, ``arrive`` when they are there.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from netkf.algorithms.covariance_intersection import CovarianceIntersection
from netkf.algorithms.diffusion import DiffusionFilter
from netkf.algorithms.gossip import Gossip
from netkf.algorithms.hybrid import Hybrid
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observed import Observed
from netkf.theory.common.stacked_errors import Errors, Part
from netkf.theory.numerics.moves import convex, intersected


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

    def combined(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """The new root, and the matrix of the own error and of each that was heard."""
        own = 1.0 - sum(weights)
        if isinstance(self.scenario.filter.algorithm, CovarianceIntersection):
            return intersected([own, *weights], roots)
        return convex([own, *weights], roots)


class Swaps(Estimates):
    """G (10): what came last takes the place of the own pair."""

    def combined(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """One matrix is the identity."""
        n, others = self.errors.n, len(roots) - 1
        return roots[-1], [np.zeros((n, n))] * others + [np.eye(n)]


class Diffuses(Estimates):
    """D (8), (9) with the weights of what arrived."""

    def combined(
        self, node: int, weights: list[float], roots: list[FloatArray]
    ) -> tuple[FloatArray, list[FloatArray]]:
        """The shares sum to 1."""
        algorithm = self.scenario.filter.algorithm
        assert isinstance(algorithm, DiffusionFilter)
        own, heard = algorithm.share(self.scenario.own_weights[node], weights)
        return intersected([own, *heard], roots)


class Readings(Rule):
    """R (15)-(18): messages are readings, and the noise of a reading is the same at all who use it.

    A late reading is used as if it had come in time. All arrivals are known here beforehand, so a
    node whose late readings come at T keeps, from the first of their times on, a version of its
    estimate that uses all that will have arrived by T; at T it becomes the node's.
    """

    def __init__(self, scenario: Scenario, errors: Errors, messages: Sequence[Sent]) -> None:
        super().__init__(scenario, errors)
        self._at: dict[tuple[int, float], list[Sent]] = {}
        first: dict[tuple[int, float], float] = {}
        for m in messages:
            self._at.setdefault((m.receiver, m.time), []).append(m)
            if m.late:
                key = (m.receiver, m.arrives)
                first[key] = min(first.get(key, m.time), m.time)
        self._first: dict[tuple[int, float], list[float]] = {}
        for (receiver, arrives), time in sorted(first.items()):
            self._first.setdefault((receiver, time), []).append(arrives)
        self._versions: dict[int, list[float]] = {host: [] for host in range(errors.hosts)}
        self._seen: Observed = {}
        self._columns: Mapping[int, slice] = {}

    def sense(self, time: float, seen: Observed) -> None:
        """Every version takes what it will have."""
        self._seen, self._columns = seen, self.errors.readings(seen)
        for host in range(self.errors.hosts):
            self._branch(host, time)
            self._use(host, [host])
            for until in self._versions[host]:
                heard = self._at.get((host, time), [])
                senders = [m.sender for m in heard if m.arrives <= until]
                self._use(("version", host, until), [host, *senders])

    def _branch(self, host: int, time: float) -> None:
        live = self._versions[host]
        for until in self._first.get((host, time), ()):
            before = [t for t in live if t < until]
            source = ("version", host, max(before)) if before else host
            self.errors.copy(source, ("version", host, until), host)
            live.append(until)
            live.sort()

    def _use(self, name: Hashable, nodes: Sequence[int]) -> None:
        for node in nodes:
            if node in self._seen:
                self.errors.update(name, self._seen[node], self._columns[node])

    def arrive(self, time: float, messages: Sequence[Sent]) -> None:
        """What comes in time is used as it comes."""
        for host in {m.receiver for m in messages}:
            if time in self._versions[host]:
                self._versions[host].remove(time)
                self.errors.replace(("version", host, time), host)
            else:
                self._use(host, [m.sender for m in messages if m.receiver == host])


def estimates_rule(scenario: Scenario, errors: Errors) -> Rule:
    """The rule of a filter whose messages are estimates, or that sends none."""
    algorithm = scenario.filter.algorithm
    if not algorithm.talks:
        return Rule(scenario, errors)
    if isinstance(algorithm, Gossip):
        return Swaps(scenario, errors)
    if isinstance(algorithm, DiffusionFilter):
        return Diffuses(scenario, errors)
    if isinstance(algorithm, Hybrid):
        return Estimates(scenario, errors)
    raise TheoryError(f"no exact error covariance for {type(algorithm).__name__}")
