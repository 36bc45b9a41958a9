"""The slot process: runs the programme of a slot filter, phase by phase, on all nodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import numpy as np
import simpy

from netkf.algorithms.slot import Reading, Role, SlotFilter, SlotModel
from netkf.core.arrays import FloatArray
from netkf.core.streams import Streams
from netkf.engines.base import Rank
from netkf.engines.processes.timeline import Timeline
from netkf.engines.processes.wires import Wire
from netkf.network.graphs import Link
from netkf.network.matchings import Matching, RecordedSlots
from netkf.plants.linear import LinearPlant, Readings, Truth
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN, Recorder
from netkf.trace.schema import CODES

SENSE, TICK, ROUND, SWAP, ABSORB, STOP = (
    CODES[kind] for kind in ("sense", "tick", "round", "swap", "absorb", "stop")
)
Sampled = Callable[[float, FloatArray, FloatArray, FloatArray], None]


class Letter(NamedTuple):
    """A payload with the exchange it belongs to."""

    exchange: int
    content: Any


class SlotHost:
    """One node's filter, its sensors and its inbox."""

    def __init__(
        self,
        algorithm: SlotFilter,
        node: int,
        model: SlotModel,
        start: tuple[FloatArray, FloatArray],
        sensors: list[Readings],
        role: Role | None = None,
    ) -> None:
        self.node, self.state = node, algorithm.init(model, *start)
        if role is not None:
            self.state = algorithm.place(self.state, role)
        self._algorithm, self._model, self._sensors = algorithm, model, sensors
        self.stopped = False
        self._open = -1
        self._inbox: dict[int, tuple[int, float, Any, float]] = {}

    def sense(self, slot: int, x: FloatArray) -> None:
        """Take the reading of a slot; without sensors it is empty."""
        model, sensors = self._model, self._sensors
        y = np.concatenate([np.empty(0), *(sensor.reading(slot, x) for sensor in sensors)])
        H = np.concatenate([model.H[:0], *(sensor.matrix(slot) for sensor in sensors)])
        self.state = self._algorithm.sense(self.state, Reading(y, H, model.R))

    def emit(self, exchange: int, phase: int) -> Letter | None:
        """What the node sends in an exchange."""
        content = self._algorithm.emit(self.state, phase)
        return None if content is None else Letter(exchange, content)

    def open(self, exchange: int) -> None:
        """Open the inbox for an exchange."""
        self._open = exchange

    def accepts(self, payload: Letter) -> bool:
        """Whether the inbox of the message's exchange is still open."""
        return payload.exchange == self._open

    def receive(
        self, time: float, peer: int, number: int, weight: float, payload: Letter, age: float
    ) -> None:
        """Keep a message until the inbox closes."""
        self._inbox[peer] = (number, weight, payload.content, age)

    def close(self, phase: int) -> list[tuple[int, int, float]]:
        """Absorb the inbox; returns (peer, message, age) of what was in it."""
        taken = [(peer, *self._inbox[peer]) for peer in sorted(self._inbox)]
        self._inbox.clear()
        self._open = -1
        messages = [(weight, content, age) for _, _, weight, content, age in taken]
        self.state = self._algorithm.absorb(self.state, phase, messages)
        return [(peer, number, age) for peer, number, _, _, age in taken]

    def stops(self) -> bool:
        """Whether the node's filter has stopped since the last time this was asked."""
        if self.stopped or not self._algorithm.stopped(self.state):
            return False
        self.stopped = True
        return True


class SlotProcess:
    """All nodes of one run, slot after slot."""

    def __init__(
        self,
        scenario: Scenario,
        streams: Streams,
        timeline: Timeline,
        recorder: Recorder,
        sampled: Sampled,
    ) -> None:
        algorithm, plant = scenario.filter.algorithm, scenario.plant
        assert isinstance(algorithm, SlotFilter)
        assert isinstance(plant, LinearPlant)
        self._scenario, self._algorithm, self._plant = scenario, algorithm, plant
        self._timeline, self._recorder, self._sampled = timeline, recorder, sampled
        self._truth: Truth = plant.truth(streams.generator("plant"))
        self._hosts = _hosts(scenario, streams, algorithm)
        self._active = list({id(h): h for h in self._hosts.values()}.values())
        self._talking = sorted({node for link in scenario.topology.links for node in link})
        self._matching_random = streams.generator("matching")
        self._wires: dict[Link, Wire] = {}
        if algorithm.talks:
            self._wires = {
                link: Wire(scenario, streams, timeline, recorder, self._hosts, link, k)
                for k, link in enumerate(scenario.topology.links)
            }
        self._exchanges = 0
        self._samples = set(scenario.slots)
        self._sums = self._conserved()

    def running(self) -> Generator[simpy.Event, Any, None]:
        """The process: sample, run the programme, and so on until the horizon."""
        slot, horizon = 0, self._scenario.horizon
        while True:
            start = self._plant.slot_time(slot)
            last = self._plant.over(slot, horizon)
            if last and slot not in self._samples:
                return
            yield self._timeline.at(start, Rank.PROBE, 0)
            if self._algorithm.predicts:
                self._sample(slot, start)
                if last:
                    return
            if last:
                self._recorder.pause()  # the horizon is half open: this slot makes its sample only
            yield from self._programme(slot, start)
            self._recorder.resume()
            if not self._algorithm.predicts:
                self._sample(slot, start)
            if last:
                return
            self._recorder.flush_if_full()
            slot += 1

    def _programme(self, slot: int, start: float) -> Generator[simpy.Event, Any, None]:
        algorithm, phase = self._algorithm, 0
        for kind in algorithm.programme:
            if kind == "sense":
                self._sense(slot)
                continue
            if algorithm.talks and slot >= algorithm.first_slot:
                yield from self._steps(slot, start, phase)
            phase += 1

    def _steps(self, slot: int, start: float, phase: int) -> Generator[simpy.Event, Any, None]:
        length, steps = self._scenario.phase_length, self._algorithm.steps(phase)
        for step in range(steps):
            self._open()
            self._exchange(slot, phase, step)
            closing = start + (phase + (step + 1) / steps) * length
            yield self._timeline.at(closing, Rank.ABSORB, 0)
            self._close(closing, phase)

    def _sense(self, slot: int) -> None:
        if slot == 0 and not self._algorithm.predicts:
            return  # a filtered estimate starts from what is known before any reading
        x, now = self._truth.state(slot), self._timeline.now
        for node in self._scenario.sensing:
            self._recorder.append((now, SENSE, node, -1, -1, -1, NAN))
        for host in self._active:
            host.sense(slot, x)

    def _open(self) -> None:
        self._exchanges += 1
        for host in self._active:
            host.open(self._exchanges)

    def _exchange(self, slot: int, phase: int, step: int) -> None:
        now, activation = self._timeline.now, self._scenario.network.activation
        pairs, up = list(self._scenario.topology.links), None
        broadcast, senders = not self._algorithm.pairwise, self._talking
        if isinstance(activation, Matching):
            pairs = activation.draw(self._scenario.topology, self._matching_random)
        elif isinstance(activation, RecordedSlots):
            listed = activation.pairs(slot, phase, step)
            pairs, up = (pairs, set(listed)) if broadcast else (listed, None)
            if up is not None and not self._scenario.topology.directed:
                up |= {(j, i) for i, j in listed}
        if broadcast:
            self._recorder.append((now, ROUND, -1, -1, -1, phase, NAN))
        else:
            senders = sorted({node for pair in pairs for node in pair})
        letters = {node: self._hosts[node].emit(self._exchanges, phase) for node in senders}
        fresh = self._algorithm.redraws(phase, step)
        for i, j in pairs:
            if not broadcast:
                self._recorder.append((now, TICK, i, j, -1, phase, NAN))
            here = up is None or (i, j) in up
            self._wires[i, j].exchange(now, (letters[i], letters[j]), phase, here, fresh)

    def _close(self, now: float, phase: int) -> None:
        append = self._recorder.append
        for host in self._active:
            taken = host.close(phase)
            if self._algorithm.pairwise:
                for peer, number, age in taken:
                    append((now, SWAP, host.node, peer, number, phase, age))
            elif taken:
                oldest = max(age for _, _, age in taken)
                append((now, ABSORB, host.node, -1, -1, phase, oldest))
            if host.stops():
                append((now, STOP, host.node, -1, -1, phase, NAN))

    def _conserved(self) -> dict[str, float]:
        parts = [self._algorithm.conserved(host.state) for host in self._active]
        return {name: math.fsum(part[name] for part in parts) for name in parts[0]}

    def _sample(self, slot: int, start: float) -> None:
        if slot not in self._samples:
            return
        estimates = {id(host): self._algorithm.estimate(host.state) for host in self._active}
        chosen = [estimates[id(self._hosts[node])] for node in self._scenario.nodes]
        xhat, P = (np.array([pair[k] for pair in chosen]) for k in range(2))
        self._sampled(start, self._truth.state(slot), xhat, P)
        if self._sums:
            now = self._conserved()
            self._recorder.sums = {name: (sum_, now[name]) for name, sum_ in self._sums.items()}


def _hosts(scenario: Scenario, streams: Streams, algorithm: SlotFilter) -> dict[int, SlotHost]:
    def sensors(node: int) -> list[Readings]:
        return [scenario.slot_path(streams, node, place) for place in scenario.placed.get(node, ())]

    nodes = scenario.nodes
    if algorithm.pooled:
        every = [path for node in scenario.sensing for path in sensors(node)]
        model = scenario.pooled_slot_model
        shared = SlotHost(algorithm, -1, model, scenario.start(nodes[0]), every)
        return dict.fromkeys(nodes, shared)
    return {
        role.node: SlotHost(
            algorithm, role.node, model, scenario.start(role.node), sensors(role.node), role
        )
        for role, model in zip(scenario.roles, scenario.slot_models, strict=True)
    }
