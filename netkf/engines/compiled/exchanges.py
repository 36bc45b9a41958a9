"""Slots made beforehand: what the nodes of a slot filter do, and which messages reach whom.

What happens in a slot depends on clocks, matchings and channels alone, so that the events of many
slots are made first and the estimates follow.
"""

from __future__ import annotations

import heapq
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from netkf.algorithms.intermittent import Intermittent
from netkf.algorithms.push_sum import MASS, PushSum
from netkf.engines.compiled.masses import stopping
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import ChannelSampler, checked_delay, checked_delivery_probability
from netkf.network.graphs import Link
from netkf.network.matchings import Matching, RecordedSlots
from netkf.plants.transitions import frame_slots
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN
from netkf.trace.schema import CODES, EVENT

SENSE, TICK, SEND, DELIVER, LOST, LATE, ABSORB, SWAP, ROUND, STOP = (
    CODES[kind]
    for kind in (
        *("sense", "tick", "send", "deliver", "lost"),
        *("late", "absorb", "swap", "round", "stop"),
    )
)
SENSING, EXCHANGING, SAMPLING, REBASING = range(4)
FATES = 64  # drawn at once
MOST_ROWS = 1 << 15
Row = tuple[float, int, int, int, int, int, float]


class Slots(NamedTuple):
    """Some slots: what is done, in order, and the rows of the events.

    kind (K,), ``number`` (K,): which of the slots here, exchange or sample it is; messages of an
    exchange from ``first`` (K,) to ``after`` (K,): receiver, sender (M,) places in ``nodes``, in
    their order, and weight (M,). ``slots`` are the numbers of the slots here, ``samples`` the
    (slot, time, rows before it) of the samples, ``rows`` are EVENT rows.
    """

    kind: np.ndarray
    number: np.ndarray
    first: np.ndarray
    after: np.ndarray
    receiver: np.ndarray
    sender: np.ndarray
    weight: FloatArray
    slots: list[int]
    samples: list[tuple[int, float, int]]
    rows: np.ndarray


class Way:
    """One direction of a link: its messages so far and their fates."""

    def __init__(self, scenario: Scenario, streams: Streams, link: Link, entity: int) -> None:
        self.link, self.entity, self.messages = link, entity, 0
        self.table_probability = scenario.table_probability(link)
        self.weight = scenario.weight(link[1], link[0])
        self._fates = ChannelSampler(scenario.network.channel, partial(_stream, streams, link))

    def fates(self) -> Iterator[tuple[float, bool, float]]:
        """The fates of its activations, one after the other."""
        while True:
            luck, bad, delay = self._fates.draws(FATES)
            yield from zip(luck.tolist(), bad.tolist(), delay.tolist(), strict=True)


class Programme(ABC):
    """Goes through the slots of one run: what is ``_done``, in order, for the ``_slots`` here."""

    def __init__(self, scenario: Scenario) -> None:
        algorithm = scenario.hosted
        self._scenario, self._algorithm = scenario, algorithm
        self._length = scenario.phase_length if algorithm.talks else 0.0
        self._samples = set(scenario.slots)
        exact = scenario.exact_errors
        self._frame = frame_slots(scenario.slot_plant.F) if exact else None
        self._slot, self._over, self._noted = 0, False, True
        self._begin()

    def _begin(self) -> None:
        self._done: list[list[int]] = []
        self._slots: list[int] = []
        self._sampled: list[tuple[int, float, int]] = []

    @abstractmethod
    def _arrivals(self, until: float) -> None:
        """What arrives by then."""

    @abstractmethod
    def _sense(self, now: float) -> None:
        """Every node takes its reading."""

    @abstractmethod
    def _exchange(self, now: float, end: float, slot: int, phase: int, step: int) -> None:
        """One step of an exchange, from its beginning to its end."""

    @abstractmethod
    def _reached(self) -> int:
        """How far the rows of the events are at a sample."""

    def _one_slot(self) -> bool:
        """Make one slot; True when nothing comes after it."""
        scenario, algorithm, slot = self._scenario, self._algorithm, self._slot
        start = scenario.slot_plant.slot_time(slot)
        last = scenario.slot_plant.over(slot, scenario.horizon)
        if last and slot not in self._samples:
            return True
        self._arrivals(start)
        self._slots.append(slot)
        if algorithm.predicts:
            self._sample(slot, start)
        if not (last and algorithm.predicts):
            self._noted = not last  # the horizon is half open: this slot makes its sample only
            self._phases(slot, start)
            self._noted = True
            if not algorithm.predicts:
                self._sample(slot, start)
        self._slot += 1
        return last

    def _phases(self, slot: int, start: float) -> None:
        algorithm, phase, now = self._algorithm, 0, start
        for kind in algorithm.schedule or ():
            if kind == "predict":  # the kernels predict where they sense
                continue
            if kind == "sense":
                if slot > 0 or algorithm.predicts:
                    # Else a filtered estimate starts from what is known before any reading.
                    self._sense(now)
                    self._done.append([SENSING, len(self._slots) - 1, 0, 0])
                continue
            if algorithm.talks and slot >= algorithm.first_slot:
                steps = algorithm.steps(phase)
                for step in range(steps):
                    end = start + (phase + (step + 1) / steps) * self._length
                    self._exchange(now, end, slot, phase, step)
                    now = end
            phase += 1

    def _sample(self, slot: int, start: float) -> None:
        if slot in self._samples:
            self._sampled.append((slot, start, self._reached()))
            self._done.append([SAMPLING, len(self._sampled) - 1, 0, 0])
        if self._frame and slot and slot % self._frame == 0:
            self._done.append([REBASING, len(self._slots) - 1, 0, 0])


class Exchanges(Programme):
    """Makes the slots of one run, as SlotProcess of the processes does, without the estimates; only
    the mass of push-sum is looked at, where nodes may stop.
    """

    def __init__(self, scenario: Scenario, streams: Streams) -> None:
        super().__init__(scenario)
        self._loss, self._shared = scenario.network.channel.loss, scenario.network.channel.symmetric
        self._index = scenario.topology.index
        self._random = streams.generator("matching")
        self._silent = silent(scenario)
        self._stopping = stopping(scenario)
        self._ways: dict[Link, list[Way]] = {}
        self._fates: dict[Link, list[Iterator[tuple[float, bool, float]]]] = {}
        self._last: dict[Link, list[tuple[float, bool, float]]] = {}
        if self._algorithm.talks:
            for k, (i, j) in enumerate(scenario.topology.links):
                self._connect(streams, (i, j), k)
        self._open, self._exchanges, self._order = -1, 0, 0
        self._mail: list[tuple[float, int, int, Way, int, float, int, int]] = []
        self._inbox: dict[int, dict[int, tuple[int, float, float]]] = {}

    def _connect(self, streams: Streams, link: Link, k: int) -> None:
        scenario, (i, j) = self._scenario, link
        ways = [Way(scenario, streams, (i, j), 2 * k)]
        if not scenario.topology.directed:
            ways.append(Way(scenario, streams, (j, i), 2 * k + 1))
        self._ways[link] = ways
        own = ways[:1] if self._shared else ways
        self._fates[link] = [way.fates() for way in own]

    def following(self) -> Slots | None:
        """The next slots; None when all is done."""
        if self._over:
            return None
        self._begin()
        self._rows: list[Row] = []
        self._messages: list[tuple[int, int, float]] = []
        while not self._over and len(self._rows) + len(self._messages) < MOST_ROWS:
            self._over = self._one_slot()
        if self._over:
            self._arrivals(np.inf)
        kind, number, first, after = np.array(self._done, dtype=np.int64).reshape(-1, 4).T.copy()
        places = np.array([m[:2] for m in self._messages], dtype=np.int64).reshape(-1, 2).T.copy()
        weight = np.array([m[2] for m in self._messages], dtype=np.float64)
        return Slots(
            kind, number, first, after, places[0], places[1], weight,
            self._slots, self._sampled, np.array(self._rows, dtype=EVENT),
        )  # fmt: skip

    def _note(self, row: Row) -> None:
        if self._noted:
            self._rows.append(row)

    def _sense(self, now: float) -> None:
        for node in self._scenario.sensing:
            self._note((now, SENSE, node, -1, -1, -1, NAN))

    def _reached(self) -> int:
        return len(self._rows)

    def _exchange(self, now: float, end: float, slot: int, phase: int, step: int) -> None:
        self._exchanges += 1
        self._open = self._exchanges
        self._send_all(now, slot, phase, step)
        self._arrivals(end)
        self._close(end, phase)

    def _send_all(self, now: float, slot: int, phase: int, step: int) -> None:
        activation, topology = self._scenario.network.activation, self._scenario.topology
        pairs, up = list(topology.links), None
        broadcast = not self._algorithm.pairwise
        if isinstance(activation, Matching):
            pairs = activation.draw(topology, self._random)
        elif isinstance(activation, RecordedSlots):
            listed = activation.pairs(slot, phase, step)
            pairs, up = (pairs, set(listed)) if broadcast else (listed, None)
            if up is not None and not topology.directed:
                up |= {(j, i) for i, j in listed}
        if broadcast:
            self._note((now, ROUND, -1, -1, -1, phase, NAN))
        fresh = self._algorithm.redraws_links(phase, step)
        for i, j in pairs:
            if not broadcast:
                self._note((now, TICK, i, j, -1, phase, NAN))
            if fresh or (i, j) not in self._last:
                drawn = [next(fates) for fates in self._fates[i, j]]
                self._last[i, j] = drawn * (1 if len(drawn) == len(self._ways[i, j]) else 2)
            here = up is None or (i, j) in up
            for way, fate in zip(self._ways[i, j], self._last[i, j], strict=False):
                if (way.link[0], phase) not in self._silent:
                    self._send(now, way, fate if here else None, phase)

    def _send(
        self, now: float, way: Way, fate: tuple[float, bool, float] | None, phase: int
    ) -> None:
        (sender, receiver), number = way.link, way.messages
        way.messages = number + 1
        self._note((now, SEND, sender, receiver, number, phase, NAN))
        link, measured = way.link, way.table_probability
        if fate is None or fate[0] >= checked_delivery_probability(
            self._loss, link, number, fate[1], measured
        ):
            self._note((now, LOST, sender, receiver, number, phase, NAN))
            return
        delay = checked_delay(self._scenario.network.channel.delay, link, number, fate[2])
        if math.isnan(delay):
            self._note((now, LOST, sender, receiver, number, phase, NAN))
            return
        arrival = now + delay
        if delay == 0.0:
            self._note((now, DELIVER, receiver, sender, number, phase, 0.0))
            self._inbox.setdefault(receiver, {})[sender] = (number, way.weight, 0.0)
        elif arrival < self._scenario.ends:
            self._order += 1
            mail = (arrival, way.entity, self._order, way, number, now, phase, self._open)
            heapq.heappush(self._mail, mail)

    def _arrivals(self, until: float) -> None:
        while self._mail and self._mail[0][0] <= until:
            now, _, _, way, number, sent, phase, exchange = heapq.heappop(self._mail)
            (sender, receiver), in_time = way.link, exchange == self._open
            if now < self._scenario.horizon:
                kind = DELIVER if in_time else LATE
                self._note((now, kind, receiver, sender, number, phase, now - sent))
            if in_time:
                self._inbox.setdefault(receiver, {})[sender] = (number, way.weight, now - sent)

    def _close(self, now: float, phase: int) -> None:
        first = len(self._messages)
        rows: list[tuple[int, Row]] = []
        for node in sorted(self._inbox):
            taken = self._inbox[node]
            here = self._index[node]
            for peer in sorted(taken):
                number, weight, age = taken[peer]
                self._messages.append((here, self._index[peer], weight))
                if self._algorithm.pairwise:
                    rows.append((here, (now, SWAP, node, peer, number, phase, age)))
            if not self._algorithm.pairwise:
                oldest = max(age for _, _, age in taken.values())
                rows.append((here, (now, ABSORB, node, -1, -1, phase, oldest)))
        if self._stopping is not None and phase == MASS:
            rows += self._stops(now, first)
            rows.sort(key=itemgetter(0))
        for _, row in rows:
            self._note(row)
        self._inbox.clear()
        self._open = -1
        self._done.append([EXCHANGING, phase, first, len(self._messages)])

    def _stops(self, now: float, first: int) -> list[tuple[int, Row]]:
        """The rows of the nodes that stop with the exchange of messages from ``first`` on."""
        assert self._stopping is not None
        places = self._stopping.exchange(self._messages[first:])
        nodes = [self._scenario.nodes[here] for here in places]
        if self._stopping.silences:
            self._silent |= {(node, MASS) for node in nodes}
        return [
            (here, (now, STOP, node, -1, -1, MASS, NAN))
            for here, node in zip(places, nodes, strict=True)
        ]


def silent(scenario: Scenario) -> set[tuple[int, int]]:
    """The (node, phase) in which a node has nothing to send from the beginning."""
    algorithm = scenario.filter.algorithm
    if isinstance(algorithm, PushSum) and algorithm.asymptotic:
        return {(node, MASS) for node in scenario.nodes}
    if isinstance(algorithm, Intermittent):
        return {(node, 0) for node in scenario.nodes if node not in scenario.placed}
    return set()


def _stream(streams: Streams, ends: Link, purpose: str) -> np.random.Generator:
    return streams.generator(purpose, *ends)
