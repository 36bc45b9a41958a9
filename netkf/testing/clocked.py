"""Trials of a filter in continuous time, where clocks decide when nodes transmit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from netkf.algorithms.filter import Exchange, Increments, Message, interval_rule
from netkf.algorithms.kernels.gains import longest_interval
from netkf.algorithms.models import FlowModel
from netkf.linalg.arrays import FloatArray
from netkf.testing.estimates import check_estimate
from netkf.testing.systems import System
from netkf.testing.trials import Trial
from netkf.testing.watching import WatchedPart, call_user_function, demand

HORIZON = 4.0  # seconds: longer than all rounds of a trial
# Pairs of gaps in seconds: below, about and above the time scale of the system.
GAPS = ((1e-3, 0.02), (0.3, 0.5), (1.0, 2.0))
# Relative: above the rounding error of any method for the Riccati equation.
COMPOSITION_TOLERANCE = 1e-6
# The truth is shifted late, when messages of all kinds are in flight.
ROUNDS, SHIFT_ROUND = 6, 4
MAX_SAMPLE_GAP, MAX_INCREMENT_GAP = 0.5, 0.05  # seconds of a round
SAMPLE_PROBABILITY = 0.8  # of a node in a round: below 1, to have rounds without a sample
# Gauss-Legendre quadrature, exact to rounding for e^{A s} within one gap.
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(12)


class MessageInFlight(NamedTuple):
    """A message that was sent at time ``sent`` (seconds) and arrives in round ``arrival``."""

    arrival: int
    sender: int
    receiver: int
    payload: Any
    sent: float


class ClockTrial(Trial):
    """A trial of ROUNDS rounds, in each of which time passes, sensors read and two nodes transmit.

    In odd rounds messages may be lost or delayed. ``clock`` is the kind of clock by which nodes
    transmit (see algorithms.filter.CLOCKS; None without messages); sensors give ``increments`` or
    samples.
    """

    def __init__(
        self,
        watched: WatchedPart,
        system: System,
        shift: FloatArray | None,
        clock: str | None,
        increments: bool,
    ) -> None:
        """Start a trial of the ``system``."""
        self._clock, self._increments = clock, increments
        # The drift per second in continuous time; a :class:`System` states slots of one second.
        self._A = system.M - np.eye(len(system.M))
        # Seconds since the start, and the number of messages sent, which decides which are lost.
        self._time, self._count = 0.0, 0
        self._in_flight: list[MessageInFlight] = []
        super().__init__(watched, system, shift)

    @classmethod
    def make_per_sensor_kind(
        cls, watched: WatchedPart, system: System, shift: FloatArray | None, clock: str | None
    ) -> Iterator[ClockTrial]:
        """Yield a trial with sensors that take samples and one with sensors of increments, each if
        the filter supports it.

        ``clock`` is the kind of clock by which nodes transmit, None without messages; ``shift``
        (n,) moves the truth on the way, None does not.
        """
        part = watched.part
        yield cls(watched, system, shift, clock, increments=False)
        if not part.needs.samples and clock != "readings":
            yield cls(watched, system, shift, clock, increments=True)

    def model(self, has_sensor: bool) -> FlowModel:
        """Return the model of a node; H (p, n) and R (p, p) are those of its sensor if it has one
        (``has_sensor``) that gives increments, else p = 0.
        """
        H, R = self.matrices(has_sensor and self._increments)
        interval = min(0.1, longest_interval(self._A, self.system.Q, H, R))
        return FlowModel(self._A, self.system.Q, H, R, HORIZON, interval)

    def run(self) -> None:
        """Run all rounds: time passes, sensors read, and nodes exchange messages; before that check
        that predictions over two gaps compose, in the trial of one clock only.
        """
        if self._clock in (None, *self.part.timing.clocks[:1]):
            for node in self.nodes:
                self._check_composition(node)
        for k in range(ROUNDS):
            self._pass_time(shift=k == SHIFT_ROUND)
            if self.part.timing.talks:
                self._exchange(k, reliable=k % 2 == 0)
            self.record_end()

    def _check_composition(self, node: int) -> None:
        watched, state = self.watched, self.states[node]
        for first, second in GAPS:
            in_one_step = watched.call("predict", state, first + second)
            in_two_steps = watched.call("predict", watched.call("predict", state, first), second)
            estimates = [
                check_estimate(watched, predicted, len(self._A), "predict")
                for predicted in (in_one_step, in_two_steps)
            ]
            for name, one, other in zip(("xhat", "P"), *estimates, strict=True):
                if one is not None and other is not None:
                    self._compare_predictions(name, one, other, first, second)
        if self._increments and len(self.models[node].H):
            where = f"{watched.name}.timing.interval"
            seconds = call_user_function(where, interval_rule(watched.part), state)
            demand(seconds > 0.0, where, "must be above 0 seconds", seconds)

    def _compare_predictions(
        self, name: str, one_step: FloatArray, two_steps: FloatArray, first: float, second: float
    ) -> None:
        difference = float(np.abs(one_step - two_steps).max())
        size = max(float(np.abs(one_step).max()), float(np.abs(two_steps).max()), 1e-300)
        demand(
            difference <= COMPOSITION_TOLERANCE * size,
            f"{self.watched.name}.predict",
            "must compose over gaps, predict(a + b) = predict(b) after predict(a)",
            f"{name} that differs by {difference / size:.2g} of its size at a = {first:g} and "
            f"b = {second:g} s",
            "solve over the gap exactly, as state.model.predict does, and keep no count of calls",
        )

    def _pass_time(self, shift: bool) -> None:
        max_gap = MAX_SAMPLE_GAP
        if self._increments:
            max_gap = min(MAX_INCREMENT_GAP, *(model.interval for model in self.models))
        gap = max_gap * self.random.uniform(0.5, 1.0)
        start, self.offset = self.offset, scipy.linalg.expm(gap * self._A) @ self.offset
        self._time += gap
        sensing = [node for node in self.nodes if node != 1 and len(self.system.H)]
        for node in self.nodes:
            has_increments = self._increments and node in sensing
            self.step(node, "predict", gap, records=not has_increments)
            if has_increments:
                self.step(node, "update", Increments(self._moments(start, gap), gap))
        if shift:
            self.shift_truth()
        if not self._increments:
            for node in sensing:
                if self.random.random() < SAMPLE_PROBABILITY:
                    self.step(node, "update", self.sample(node, self._time))

    def _moments(self, start: FloatArray, gap: float) -> FloatArray:
        """Return the two moments (2 p,) of increments of a truth that is shifted."""
        noise = self.random.normal(size=2 * len(self.system.H)) * np.sqrt(gap)
        # Integrals of H e^{A s} start over s, weighted with the Legendre polynomials 1 and z.
        effect = np.zeros((2, len(self.system.H)))
        for z, weight in zip(POINTS, WEIGHTS, strict=True):
            y = self.system.H @ scipy.linalg.expm(0.5 * gap * (1.0 + z) * self._A) @ start
            effect += 0.5 * gap * weight * np.outer([1.0, z], y)
        return np.asarray(noise + effect.reshape(-1))

    def shift_truth(self) -> None:
        """Shift the truth, the states of all nodes, and the messages in flight: these by the shift
        that the truth would have had when they were sent.
        """
        if self._shift is None:
            return
        super().shift_truth()
        for k, message in enumerate(self._in_flight):
            earlier = scipy.linalg.expm((message.sent - self._time) * self._A) @ self.offset
            payload = self.watched.call("shift", message.payload, earlier)
            self._in_flight[k] = message._replace(payload=payload)

    def _exchange(self, k: int, reliable: bool) -> None:
        is_conserved = reliable and not self._in_flight
        before = self.conserved_sums() if is_conserved else {}
        payloads = [
            (node, receivers, self.emit(node, Exchange(time=self._time, receivers=receivers)))
            for node, receivers in self._choose_transmissions(k)
        ]
        for sender, receivers, payload in payloads:
            if payload is None:
                continue
            for receiver in receivers:
                self._count += 1
                if reliable or self._count % 3:
                    arrival = k if reliable or self._count % 2 else k + 1
                    message = MessageInFlight(arrival, sender, receiver, payload, self._time)
                    self._in_flight.append(message)
        self._absorb_arrivals(k)
        if is_conserved:
            self.check_conserved(before, "none")

    def _choose_transmissions(self, k: int) -> list[tuple[int, tuple[int, ...]]]:
        a, b = sorted({k % len(self.nodes), (k + 1) % len(self.nodes)})
        if self._clock == "links":
            return [(a, (b,)), (b, (a,))]
        if self._clock == "directions":
            return [(a, (b,))] if k % 2 else [(b, (a,))]
        return [(node, tuple(peer for peer in self.nodes if peer != node)) for node in (a, b)]

    def _absorb_arrivals(self, k: int) -> None:
        arrivals = [message for message in self._in_flight if message.arrival <= k]
        self._in_flight = [message for message in self._in_flight if message.arrival > k]
        for node in self.nodes:
            accepted = [self._accept(message) for message in arrivals if message.receiver == node]
            messages = sorted((m for m in accepted if m is not None), key=lambda m: m.sender)
            if self.part.timing.newest_only:
                # The last entry of a sender stays: its message with the smallest age.
                newest = {m.sender: m for m in sorted(messages, key=lambda m: -m.age)}
                messages = [newest[sender] for sender in sorted(newest)]
            if messages:
                self.absorb(node, messages, Exchange(time=self._time))

    def _accept(self, arrival: MessageInFlight) -> Message | None:
        age = self._time - arrival.sent
        accepts = age <= self.part.timing.max_age
        weight = float(self.weights[arrival.sender, arrival.receiver])
        return Message(arrival.sender, weight, arrival.payload, age) if accepts else None
