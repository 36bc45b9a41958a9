"""Trials of a filter in continuous time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from netkf.algorithms.adapters import FlowAdapter
from netkf.algorithms.filter import Exchange, Increments, Message
from netkf.algorithms.kernels.gains import longest_interval
from netkf.algorithms.models import FlowModel
from netkf.linalg.arrays import FloatArray
from netkf.testing.estimates import check_estimate
from netkf.testing.systems import System
from netkf.testing.trials import Trial
from netkf.testing.watching import Watched, demand

HORIZON = 4.0  # seconds: longer than all rounds together
# Seconds: below, about and above the time scale of the system.
GAPS = ((1e-3, 0.02), (0.3, 0.5), (1.0, 2.0))
COMPOSES = 1e-6  # relative: above the rounding of any way to solve the Riccati equation
# The truth is shifted late, when messages of all kinds are under way.
ROUNDS, SHIFTED = 6, 4
MAX_SAMPLE_GAP, MAX_INCREMENT_GAP = 0.5, 0.05
SAMPLED = 0.8  # probability that a node samples: some rounds go without
# More than enough for e^{A s} within one gap.
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(12)


class Flying(NamedTuple):
    """A message that takes time: ``lands`` is the round in which it arrives."""

    lands: int
    sender: int
    receiver: int
    payload: Any
    sent: float


class ClockTrial(Trial):
    """Some rounds in which time passes, sensors read and nodes transmit; in odd rounds messages are
    lost or take time.
    """

    def __init__(
        self,
        watched: Watched,
        system: System,
        shift: FloatArray | None,
        clock: str | None,
        increments: bool,
    ) -> None:
        self._clock, self._increments = clock, increments
        self._A = system.M - np.eye(len(system.M))
        self._time, self._count = 0.0, 0
        self._flying: list[Flying] = []
        super().__init__(watched, system, shift)

    @classmethod
    def each_reading(
        cls, watched: Watched, system: System, shift: FloatArray | None, clock: str | None
    ) -> Iterator[ClockTrial]:
        """Yield a trial with samples and one with increments, if the filter takes them."""
        part = watched.part
        if not isinstance(part, FlowAdapter):
            yield cls(watched, system, shift, clock, increments=False)
        if not part.needs_samples and clock != "readings":
            yield cls(watched, system, shift, clock, increments=True)

    def model(self, sees: bool) -> FlowModel:
        """Return the model of a node, with the matrices of increment sensors only."""
        H, R = self.matrices(sees and self._increments)
        interval = min(0.1, longest_interval(self._A, self.system.Q, H, R))
        return FlowModel(self._A, self.system.Q, H, R, HORIZON, interval)

    def run(self) -> None:
        """Carry out round after round."""
        if self._clock in (None, *self.part.clocks[:1]):
            for node in self.nodes:
                self._check_composes(node)
        for k in range(ROUNDS):
            self._pass_time(shift=k == SHIFTED)
            if self.part.talks:
                self._exchange(k, quiet=k % 2 == 0)
            self.end()

    def _check_composes(self, node: int) -> None:
        """Check that predictions over two gaps give that over their sum."""
        watched, state = self.watched, self.states[node]
        for first, second in GAPS:
            whole = watched.call("predict", state, first + second)
            parts = watched.call("predict", watched.call("predict", state, first), second)
            pairs = [check_estimate(watched, s, len(self._A), "predict") for s in (whole, parts)]
            for name, one, other in zip(("xhat", "P"), *pairs, strict=True):
                if one is not None and other is not None:
                    self._compare(name, one, other, first, second)
        if self._increments and len(self.models[node].H):
            method = "max_measurement_interval"
            seconds = watched.call(method, state)
            where = f"{watched.name}.{watched.defined_name(method)}"
            demand(seconds > 0.0, where, "must be above 0 seconds", seconds)

    def _compare(
        self, name: str, one: FloatArray, other: FloatArray, first: float, second: float
    ) -> None:
        """Check that two predictions are equal up to rounding."""
        apart = float(np.abs(one - other).max())
        size = max(float(np.abs(one).max()), float(np.abs(other).max()), 1e-300)
        method = self.watched.defined_name("predict")
        demand(
            apart <= COMPOSES * size,
            f"{self.watched.name}.{method}",
            f"must compose over gaps, {method}(a + b) = {method}(b) after {method}(a)",
            f"{name} that differs by {apart / size:.2g} of its size at a = {first:g} and "
            f"b = {second:g} s",
            "solve over the gap exactly, as state.model.predict does, and keep no count of calls",
        )

    def _pass_time(self, shift: bool) -> None:
        """Let time pass: the truth may be shifted, and sensors are sampled."""
        longest = MAX_SAMPLE_GAP
        if self._increments:
            longest = min(MAX_INCREMENT_GAP, *(model.interval for model in self.models))
        gap = longest * self.random.uniform(0.5, 1.0)
        start, self.offset = self.offset, scipy.linalg.expm(gap * self._A) @ self.offset
        self._time += gap
        sensing = [node for node in self.nodes if node != 1 and len(self.system.H)]
        for node in self.nodes:
            read = self._increments and node in sensing
            self.step(node, "predict", gap, checks=not read)
            if read:
                self.step(node, "update", Increments(self._moments(start, gap), gap))
        if shift:
            self.shift()
        if not self._increments:
            for node in sensing:
                if self.random.random() < SAMPLED:
                    self.step(node, "update", self.sample(node, self._time))

    def _moments(self, start: FloatArray, gap: float) -> FloatArray:
        """Return moments (2 p,) of noise, plus the effect of a truth that is shifted by ``start``
        (n,) at first.
        """
        noise = self.random.normal(size=2 * len(self.system.H)) * np.sqrt(gap)
        added = np.zeros((2, len(self.system.H)))
        for z, weight in zip(POINTS, WEIGHTS, strict=True):
            effect = self.system.H @ scipy.linalg.expm(0.5 * gap * (1.0 + z) * self._A) @ start
            added += 0.5 * gap * weight * np.outer([1.0, z], effect)
        return np.asarray(noise + added.reshape(-1))

    def shift(self) -> None:
        """Shift the messages under way by the shift of the truth when they were sent."""
        if self._shift is None:
            return
        super().shift()
        for k, flying in enumerate(self._flying):
            earlier = scipy.linalg.expm((flying.sent - self._time) * self._A) @ self.offset
            payload = self.watched.call("shift_payload", flying.payload, earlier)
            self._flying[k] = flying._replace(payload=payload)

    def _exchange(self, k: int, quiet: bool) -> None:
        """Let the nodes of round ``k`` send, and all messages of this round arrive."""
        nothing_in_flight = quiet and not self._flying
        before = self.sums() if nothing_in_flight else {}
        payloads = [
            (node, receivers, self.emit(node, Exchange(time=self._time, receivers=receivers)))
            for node, receivers in self._choose_transmissions(k)
        ]
        for sender, receivers, payload in payloads:
            if payload is None:
                continue
            for receiver in receivers:
                self._count += 1
                if quiet or self._count % 3:
                    lands = k if quiet or self._count % 2 else k + 1
                    self._flying.append(Flying(lands, sender, receiver, payload, self._time))
        self._absorb(k)
        if nothing_in_flight:
            self.compare(before, "none")

    def _choose_transmissions(self, k: int) -> list[tuple[int, tuple[int, ...]]]:
        """Return the senders of a round, each with its receivers; two nodes send at once."""
        one, other = sorted({k % len(self.nodes), (k + 1) % len(self.nodes)})
        if self._clock == "links":
            return [(one, (other,)), (other, (one,))]
        if self._clock == "directions":
            return [(one, (other,))] if k % 2 else [(other, (one,))]
        return [(node, tuple(peer for peer in self.nodes if peer != node)) for node in (one, other)]

    def _absorb(self, k: int) -> None:
        """Let every node absorb all messages that have arrived by now."""
        landed = [flying for flying in self._flying if flying.lands <= k]
        self._flying = [flying for flying in self._flying if flying.lands > k]
        for node in self.nodes:
            inbox = [m for m in map(self._accept, landed) if m is not None and m[0] == node]
            messages = [message for _, message in sorted(inbox, key=lambda m: m[1].sender)]
            if self.part.newest_only:
                newest = {m.sender: m for m in sorted(messages, key=lambda m: -m.age)}
                messages = [newest[sender] for sender in sorted(newest)]
            if messages:
                self.absorb(node, messages, Exchange(time=self._time))

    def _accept(self, flying: Flying) -> tuple[int, Message] | None:
        """Return the receiver and the message, or None if the filter refuses its age."""
        age = self._time - flying.sent
        accepted = self.watched.call("accepts", flying.payload, age)
        truth = accepted is True or accepted is False
        demand(truth, f"{self.watched.name}.accepts", "must be True or False", accepted)
        weight = float(self.weights[flying.sender, flying.receiver])
        message = Message(flying.sender, weight, flying.payload, age)
        return (flying.receiver, message) if accepted else None
