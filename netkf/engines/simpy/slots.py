"""Scenarios in slots: all nodes follow one schedule of predictions, readings and exchanges.

Each node is a process that follows the schedule of the filter; one process, the slot clock, lets
nodes, or pairs, transmit at once. Those that read sensors and take samples are in ``engine``.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, PairReading, Reading
from netkf.algorithms.models import ChangingSlotModel
from netkf.engines.base import Rank
from netkf.engines.simpy.nodes import Envelope, Node, distinct
from netkf.engines.simpy.timeline import Process, Timeline
from netkf.engines.simpy.transmission import LinkExchange, Transmitter
from netkf.linalg.arrays import FloatArray, block_diagonal
from netkf.network.channels import senders_of_pairs
from netkf.network.matchings import used_links
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import ABSORB, ROUND, STOP, SWAP, TICK

FIRST_RANK = Rank.PROBE + 1
"""The stages of a slot come after arrivals of the same instant; their ranks follow the schedule."""


class Stage(NamedTuple):
    """One stage of a slot: "predict", "read" (sensors), "update", "send" or "absorb".

    It happens at ``time`` seconds with ``rank``, in exchange ``phase`` and ``step`` of the slot;
    ``number`` counts all exchanges of the run.
    """

    kind: str
    time: float
    rank: int
    phase: int = -1
    step: int = -1
    number: int = -1


class SlotSchedule:
    """Computes the stages of every slot from the schedule of the filter."""

    def __init__(self, scenario: Scenario) -> None:
        self._timing, self._plant = scenario.node_filter.timing, scenario.slot_plant
        self.horizon, self._instant = scenario.horizon, scenario.time_grid.instant
        phases = self._timing.schedule or ()
        # Steps of each exchange; none if the filter does not talk.
        self._exchanges = [
            self._timing.steps(k) if self._timing.talks else 0
            for k in range(phases.count("exchange"))
        ]
        # Exchanges without steps take no time.
        self._length = scenario.phase_length if any(self._exchanges) else 0.0
        self._samples = frozenset(scenario.sampled_slots)
        self._cache: dict[int, list[Stage]] = {}

    def over(self, slot: int) -> bool:
        """Return True if a slot begins at or after the horizon: it only records its sample."""
        return self._plant.over(slot, self.horizon)

    def sampled(self, slot: int) -> bool:
        """Return True if the states of a slot are recorded."""
        return slot in self._samples

    def runs(self, slot: int) -> bool:
        """Return True if a slot has stages; at the horizon only if its sample needs them."""
        return not self.over(slot) or (self.sampled(slot) and not self._timing.predicts)

    def start(self, slot: int) -> float:
        """Return the time in seconds at which a slot begins."""
        return self._plant.slot_time(slot)

    def stages(self, slot: int) -> list[Stage]:
        """Return the stages of a slot in their order; the result is cached for all processes."""
        if slot not in self._cache:
            # All processes are in this slot or the one before.
            self._cache.pop(slot - 2, None)
            self._cache[slot] = list(self._stages_of(slot))
        return self._cache[slot]

    def end(self, slot: int) -> tuple[float, int]:
        """Return a time in seconds and a rank after all stages of a slot."""
        stages = self.stages(slot)
        return (stages[-1].time, stages[-1].rank + 1) if stages else (self.start(slot), FIRST_RANK)

    def _stages_of(self, slot: int) -> Generator[Stage, None, None]:
        timing, start = self._timing, self.start(slot)
        now, rank, phase = start, FIRST_RANK + 1, 0
        # In slot 0 a filter that does not predict uses no reading: its sample is the initial state.
        is_initial = slot == 0 and not timing.predicts
        talks = timing.talks and slot >= timing.first_exchange
        # Exchanges begin at the filter's first slot, and their numbers at 0 there.
        number = (slot - timing.first_exchange) * sum(self._exchanges)
        for kind in timing.schedule or ():
            if kind == "exchange":
                # Steps share the phase equally; their ends are counted from the start of the slot.
                steps = self._exchanges[phase]
                for step in range(steps if talks else 0):
                    yield Stage("send", now, rank, phase, step, number)
                    share = phase + (step + 1) / steps
                    now = self._instant(start + share * self._length)
                    # Absorption has the next rank: a step may take no time, and then only ranks
                    # order it.
                    yield Stage("absorb", now, rank + 1, phase, step, number)
                    rank, number = rank + 2, number + 1
                phase += 1
            elif not is_initial and kind == "sense":
                yield Stage("read", now, rank)
                yield Stage("update", now, rank + 1)
                rank += 2
            elif not is_initial:
                yield Stage("predict", now, rank)
                rank += 1


class SlotNode(Node):
    """A node in slots, whose inbox is open for one exchange at a time."""

    def __init__(
        self,
        recorder: Recorder,
        schedule: SlotSchedule,
        period: float,
        streams: Streams,
        **arguments: Any,
    ) -> None:
        super().__init__(**arguments)
        # Only randomised filters draw from this stream.
        randomised = self._timing.randomised
        self._uniforms = streams.generator("trigger", self.node) if randomised else None
        self._recorder, self._schedule, self._period = recorder, schedule, period
        # -1: no exchange is open, and every message is late.
        self._open = -1
        self._stopped, self._has_stopped = False, self.algorithm.analysis.stopped
        # The slot that the estimate is of.
        self._slot = 0
        self._samples: list[tuple[int, FloatArray, Any, FloatArray]] = []
        self._pairs: list[PairReading] = []

    def run_process(self, timeline: Timeline) -> Process:
        """Follow the schedule, slot after slot, as a SimPy process."""
        slot = 0
        # Readers and the slot clock follow the same stages; ranks order the processes.
        while self._schedule.runs(slot):
            for stage in self._schedule.stages(slot):
                # Other processes do the reading and sending.
                if stage.kind not in ("read", "send"):
                    yield timeline.at(stage.time, stage.rank, self.entity)
                    self._perform(stage, slot)
            slot += 1

    @property
    def estimates_at(self) -> int:
        """The slot that the estimate is of."""
        return self._slot

    def restart(self, time: float, fresh: Callable[[float], tuple[FloatArray, FloatArray]]) -> None:
        """Begin again with the estimate ``fresh(slot)`` of the present slot."""
        super().restart(self._slot, fresh)
        self._stopped = False

    def _perform(self, stage: Stage, slot: int) -> None:
        self._follow(slot)
        if stage.kind == "predict":
            self._slot = slot + self._timing.predicts
            # A filtered estimate is of the slot before.
            self._predict(self._schedule.start(slot - (not self._timing.predicts)), self._period)
        elif stage.kind == "update":
            self._update(stage.time)
        else:
            self._close(stage, slot)

    def _follow(self, slot: int) -> None:
        """Let a model that changes go to the piece of the slot from which it predicts."""
        if isinstance(self.moving_model, ChangingSlotModel):
            self.moving_model.move_to(slot if self._timing.predicts else slot - 1)

    def read(self, node: int, y: FloatArray, H: Any, R: FloatArray) -> None:
        """Store the reading y (p,) of a sensor of ``node`` (id) with its H (p, n), or the function
        that linearises it, and R (p, p), until the update of this slot.
        """
        if self.view is not None:
            if not len(y):
                return
            for part in self.view.readings(y, H, R):
                if isinstance(part, PairReading):
                    self._pairs.append(part)
                else:
                    self._samples.append((node, *part))
            return
        self._samples.append((node, y, H, R))

    def _update(self, time: float) -> None:
        samples = self.linearise(self.gated(self._samples, time, self._recorder))
        # Empty arrays first, so that nodes without sensors concatenate too.
        y = np.concatenate([np.empty(0), *(y for y, *_ in samples)])
        H = np.concatenate([np.empty((0, self.width)), *(H for _, H, _ in samples)])
        R = block_diagonal([R for *_, R in samples])
        present = np.isfinite(y)
        # Rows without a value are left out of y, H and R alike.
        if not present.all():
            y, H, R = y[present], H[present], R[np.ix_(present, present)]
        pairs, self._samples, self._pairs = tuple(self._pairs), [], []
        self.state = self.algorithm.update(self.state, Reading(y, H, R, time, pairs))

    def emit(self, exchange: Exchange) -> Any:
        """Return the payload that the node sends in an exchange."""
        self._follow(exchange.slot)
        if self._uniforms is not None:
            exchange = exchange._replace(uniform=float(self._uniforms.random()))
        self.state, payload = self.algorithm.emit(self.state, exchange)
        return payload

    def open(self, number: int) -> None:
        """Open the inbox for the exchange with this ``number`` within the run."""
        self._open = number

    def in_time(self, envelope: Envelope) -> bool:
        """Return True if the inbox is still open for the exchange of the message."""
        # A message carries the number of its exchange: in a later one it is late.
        return envelope.exchange == self._open

    def receive(self, envelope: Envelope) -> None:
        """Put a message into the inbox, to be absorbed when it closes."""
        self.put(envelope)

    def _close(self, stage: Stage, slot: int) -> None:
        append, now, phase = self._recorder.append, stage.time, stage.phase
        exchange = Exchange(now, phase, stage.step, slot)
        envelopes, messages = self.take_messages(exchange, now, self._recorder)
        # From now on a message of this exchange is late.
        self._open = -1
        self.state = self.algorithm.absorb(self.state, messages, exchange)
        # A swap records each message; other filters absorb all of them in one event.
        if self._timing.pairwise:
            for envelope in envelopes:
                peer, number, age = envelope.sender, envelope.number, envelope.age
                append((now, SWAP, self.node, peer, number, phase, age))
        elif messages:
            oldest = max(message.age for message in messages)
            append((now, ABSORB, self.node, -1, -1, phase, oldest))
        # Recorded once, when it becomes true.
        if not self._stopped and self._has_stopped(self.state):
            self._stopped = True
            append((now, STOP, self.node, -1, -1, phase, NAN))


class SlotClock:
    """The clock that all nodes share: it lets them transmit in every exchange of a slot."""

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        recorder: Recorder,
        schedule: SlotSchedule,
        transmitter: Transmitter,
        nodes: dict[int, SlotNode],
    ) -> None:
        self._scenario, self._recorder, self._schedule = scenario, recorder, schedule
        self._nodes, self._timing = nodes, scenario.node_filter.timing
        # A pooled filter appears once.
        self._distinct = distinct(nodes)
        self._matching_random = streams.generator("matching")
        links = scenario.topology.links if scenario.node_filter.timing.talks else ()
        self._transmitter = transmitter
        # Nodes without links are never asked for a message.
        self._talking = sorted({node for link in links for node in link})
        self._links = {
            link: LinkExchange(scenario, transmitter, nodes, link, k)
            for k, link in enumerate(links)
        }

    def run_process(self, timeline: Timeline) -> Process:
        """Let the nodes exchange messages at every "send" stage of every slot: a SimPy process."""
        slot = 0
        while self._schedule.runs(slot):
            for stage in self._schedule.stages(slot):
                if stage.kind == "send":
                    yield timeline.at(stage.time, stage.rank, 0)
                    self._exchange(stage, slot)
            slot += 1

    def _exchange(self, stage: Stage, slot: int) -> None:
        now, phase, broadcast = stage.time, stage.phase, not self._timing.pairwise
        # All inboxes open before any node sends: a message without delay arrives at once.
        for node in self._distinct:
            node.open(stage.number)
        pairs, up = used_links(
            self._scenario.network.activation,
            self._scenario.topology,
            self._matching_random,
            (slot, phase, stage.step),
            self._timing.pairwise,
        )
        if self._transmitter.reach is not None:
            self._transmitter.reach.slot = slot
        connected = {pair for pair in pairs if self._transmitter.connects(*pair)}
        senders = self._talking
        if broadcast:
            self._recorder.append((now, ROUND, -1, -1, -1, phase, NAN))
        else:
            senders = sorted({node for pair in connected for node in pair})
        exchange = Exchange(now, phase, stage.step, slot)
        # All payloads are computed before any message arrives: the order of nodes does not matter.
        awake = self._transmitter.up
        payloads = {i: self._nodes[i].emit(exchange) if awake(i) else None for i in senders}
        # Held links keep their outcome for all steps of an exchange.
        fresh = self._timing.redraws(phase, stage.step)
        self._transmitter.begin(senders_of_pairs(pairs, self._scenario.topology.directed), fresh)
        for i, j in pairs:
            if not broadcast and awake(i, j):
                self._recorder.append((now, TICK, i, j, -1, phase, NAN))
            # A recorded link that is down loses its messages, but its channel draws all the same.
            is_up = up is None or (i, j) in up
            # Nothing is sent between nodes that are out of range.
            both = (payloads[i], payloads[j]) if (i, j) in connected else (None, None)
            self._links[i, j].exchange(
                both, phase=phase, exchange=stage.number, up=is_up, fresh=fresh
            )
