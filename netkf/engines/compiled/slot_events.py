"""Messages in slots, made one by one in Python, for channels and activations that kernels cannot
draw: a user's own losses and delays, messages that take time, recorded exchanges, and nodes that
move.

Messages do not depend on estimates, unless nodes may be silent: then a block is one slot long, and
the filters' kernel decides who sends.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np

from netkf.engines.compiled.life_tables import LifeTable, life_table
from netkf.engines.compiled.slot_messages import (
    ABSORB,
    DELIVER,
    LOST,
    ROUND,
    SEND,
    SENSE,
    STOP,
    SWAP,
    TICK,
)
from netkf.engines.compiled.slot_setup import SlotSetup
from netkf.engines.reach import Reach
from netkf.network.channels import (
    ChannelDraw,
    ChannelSampler,
    broadcasts_of,
    conditions_of,
    senders_of_pairs,
    transit_time,
)
from netkf.network.graphs import Link
from netkf.network.losses import Transmission
from netkf.network.matchings import used_links
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN
from netkf.trace.schema import CODES, EVENT

LATE = CODES["late"]
Row = tuple[float, int, int, int, int, int, float]
Decide = Callable[[int, np.ndarray], np.ndarray]


class Direction:
    """A directed link: its ends and index, its number of messages so far, and what is known of the
    first.
    """

    def __init__(self, first: Transmission, index: int) -> None:
        self.ends, self.index, self.messages, self.first = first.link, index, 0, first


class Step(NamedTuple):
    """One step of an exchange: its ``slot``, the number of the ``step`` in the slot, the ``phase``
    and the step ``repeat`` of that phase, and its times in seconds.
    """

    slot: int
    step: int
    phase: int
    repeat: int
    begin: float
    end: float


class StepEnd(NamedTuple):
    """The end of a step after which nodes may stop: its slot, time, and number of absorb rows."""

    slot: int
    end: float
    rows: int


def steps_of(scenario: Scenario, setup: SlotSetup, slot: int) -> Iterator[Step]:
    """Yield the steps of the exchanges of a slot."""
    timing, repeats = scenario.node_filter.timing, [0, 0]
    # At the horizon filters that predict are only sampled.
    acts = slot < setup.last or not timing.predicts
    if not (acts and timing.talks and slot >= timing.first_exchange):
        return
    start = now = scenario.slot_plant.slot_time(slot)
    for step, phase, end in zip(*(c.tolist() for c in setup.stages[:3]), strict=True):
        if step >= 0:
            until = scenario.time_grid.instant(start + end)
            exchange_step = Step(slot, step, phase, repeats[phase], now, until)
            now, repeats[phase] = exchange_step.end, repeats[phase] + 1
            yield exchange_step


def absent(
    scenario: Scenario, setup: SlotSetup, lives: LifeTable, first: int, count: int
) -> np.ndarray:
    """Return (S, N) bool: nodes that are down when the others read, in ``count`` slots from
    ``first`` on.
    """
    times = np.array([_reading_time(scenario, setup, k) for k in range(first, first + count)])
    return np.column_stack([lives.is_down(h, times) for h in range(len(setup.nodes))])


def _reading_time(scenario: Scenario, setup: SlotSetup, slot: int) -> float:
    steps, now = steps_of(scenario, setup, slot), scenario.slot_plant.slot_time(slot)
    for step in setup.stages.step.tolist():
        if step < 0:
            break
        for exchange_step in islice(steps, 1):
            now = exchange_step.end
    return now


def slot_restarts(scenario: Scenario, lives: LifeTable) -> dict[int, list[int]]:
    """Return by slot the indices of the nodes that begin again when it begins."""
    found: dict[int, list[int]] = {}
    slots = scenario.slot_plant.slots_of(lives.t[lives.restarts])
    for slot, h in zip(slots.tolist(), lives.node[lives.restarts].tolist(), strict=True):
        found.setdefault(slot, []).append(h)
    return found


class SlotEvents:
    """Makes the messages and events of one run, slot after slot."""

    def __init__(self, scenario: Scenario, streams: Streams, setup: SlotSetup) -> None:
        self._scenario, self._setup, self._timing = scenario, setup, scenario.node_filter.timing
        self._instant = scenario.time_grid.instant
        self._reach: Reach | None = None
        if scenario.links_move:
            self._reach = Reach(scenario, scenario.slot_truth(streams), self._append_row)
        self._follows_distance = scenario.network.channel.loss.follows_distance
        self.lives, self._life_at = life_table(scenario, streams), 0
        self._down = {scenario.nodes[h] for h in np.flatnonzero(self.lives.down).tolist()}
        self.restarts = slot_restarts(scenario, self.lives)
        self._random = streams.generator("matching")
        each, channel = setup.directions_per_link, scenario.network.channel
        conditions = conditions_of(channel.loss, streams, scenario.horizon)
        self._directions = [
            Direction(scenario.transmission(ends)._replace(conditions=conditions), k)
            for k, ends in enumerate(setup.directions)
        ]
        # Directions of a link are neighbours; a directed graph has one of them. With a symmetric
        # channel only the first has streams.
        self._by_link = {
            one.ends: self._directions[k : k + each]
            for k, one in enumerate(self._directions)
            if k % each == 0
        }
        self._samplers = {
            link: [
                ChannelSampler(channel, one.ends, partial(_stream, streams, one.ends))
                for one in (both[:1] if channel.symmetric else both)
            ]
            for link, both in self._by_link.items()
        }
        self._broadcasts = broadcasts_of(scenario, streams)
        # The last draws of each link, for steps in which links keep them.
        self._last: dict[Link, list[ChannelDraw]] = {}
        # A heap by (arrival, index of the direction, order); then direction, number, time of
        # sending, phase and exchange of each message.
        self._in_flight: list[tuple[float, int, int, Direction, int, float, int, int]] = []
        self._slot, self._order, self._exchanges, self._open = 0, 0, 0, -1
        self._recording = True
        # By receiver and sender: number and age of the message.
        self._inbox: dict[int, dict[int, tuple[int, float]]] = {}
        self._rows: list[Row | StepEnd | None] = []
        self._awake: list[np.ndarray] = []
        self._decide: Decide | None = None
        self._sent: np.ndarray | None = None
        self._unread = np.zeros((0, 0), dtype=bool)
        # Pairs of exchanges that were drawn by asked(), before the messages of the slot.
        self._chosen_pairs: list[tuple[list[Link], set[Link] | None]] = []

    def asked(self) -> np.ndarray:
        """Return (E, N) flags: nodes that are asked for a message in each step of the next slot."""
        setup, index = self._setup, self._scenario.topology.index
        asked = np.zeros((len(setup.fresh), len(setup.nodes)), dtype=np.uint8)
        for step in steps_of(self._scenario, setup, self._slot):
            self._chosen_pairs.append(self._choose_pairs(step))
            # Links of the matching just drawn; broadcasts use all links.
            links = list(self._by_link)
            if self._timing.pairwise:
                links = [k for k in self._chosen_pairs[-1][0] if self._is_up(k, step)]
            asked[step.step, [index[node] for link in links for node in link]] = 1
            now = np.array([step.begin])
            for h in np.flatnonzero(asked[step.step]).tolist():
                asked[step.step, h] = not self.lives.is_down(h, now)[0]
        return asked

    def following(self, max_events: int, decide: Decide | None) -> tuple[int, np.ndarray]:
        """Make the messages and events of the next slots, up to about ``max_events`` events; return
        the number of slots S and ``up`` (1, S, E, W). If nodes may be silent it is one slot:
        ``decide(step, up)`` returns who sends, (N,), given ``up`` (E, W) of the steps before.
        """
        setup, arrivals = self._setup, []
        self._rows, self._decide, self._awake = [], decide, []
        while self._slot < setup.slots:
            arrivals.append(self._one_slot())
            self._slot += 1
            begins_again = self._slot in self.restarts
            if decide is not None or len(self._rows) >= max_events or begins_again:
                break
        # After the last slot deliver the messages that are still under way.
        if self._slot == setup.slots:
            self._recording = True
            self._deliver(math.inf)
        return len(arrivals), np.stack(arrivals)[None]

    @property
    def awake(self) -> np.ndarray:
        """(S, E, N) flags: nodes that may send, in the slots just made; empty without lives."""
        has_lives = bool(self._scenario.network.lives)
        return np.array(self._awake if has_lives else np.zeros((0,) * 3), dtype=np.uint8)

    def _one_slot(self) -> np.ndarray:
        setup, timing, slot = self._setup, self._timing, self._slot
        up = np.zeros((len(setup.fresh), len(self._directions)), dtype=np.uint8)
        self._awake.append(np.ones((len(setup.fresh), len(setup.nodes)), dtype=np.uint8))
        if setup.may_miss:
            self._unread = setup.unread(slot, 1)[0]
        start = self._scenario.slot_plant.slot_time(slot)
        sampled = bool(np.isin(slot, setup.samples))
        # First deliver messages that arrive until the slot begins.
        self._deliver(start)
        # Filters that predict are sampled at the beginning of the slot, the others at its end.
        # None among the rows marks the sample.
        if sampled and timing.predicts:
            self._sample(start)
        # At the horizon only the sample matters: no events.
        self._recording = slot < setup.last
        if self._recording or not timing.predicts:
            start = self._make_stage_events(slot, up)
        self._recording = True
        if sampled and not timing.predicts:
            self._sample(start)
        return up

    def _sample(self, now: float) -> None:
        if self._reach is not None and now < self._scenario.horizon:
            self._reach.look_at_all(self._slot, now)
        self._rows.append(None)

    def _make_stage_events(self, slot: int, up: np.ndarray) -> float:
        """Make the events of a slot; return when its last stage happens, in seconds."""
        steps = steps_of(self._scenario, self._setup, slot)
        now = self._scenario.slot_plant.slot_time(slot)
        for step in self._setup.stages.step.tolist():
            if step < 0:
                # Slot 0 of a filter that does not predict has no reading: its sample is the initial
                # state.
                if slot > 0 or self._timing.predicts:
                    for node in self._scenario.sensing_nodes:
                        if node not in self._down:
                            self._append_row((now, SENSE, node, -1, -1, -1, NAN))
                continue
            for exchange_step in islice(steps, 1):
                now = exchange_step.end
                # A message is in time if its exchange is still open.
                self._exchanges += 1
                self._open = self._exchanges
                if self._decide is not None:
                    self._sent = self._decide(step, up)
                down = [self._scenario.topology.index[node] for node in self._down]
                self._awake[-1][step, down] = 0
                self._send_all(exchange_step)
                self._deliver(exchange_step.end)
                self._end_step(exchange_step, up[step])
        return now

    def rows(self, stopped: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the events of the slots just made as EVENT rows (K,), and the number of rows
        before each sample, (T,). ``stopped`` (N,): the slot in which each node stops.
        """
        rows: list[Row] = []
        before = []
        for row in self._rows:
            if row is None:
                before.append(len(rows))
            # A node stops by permanently freezing its network estimate. The kernel has decided
            # about that only after these rows were made: insert the stop rows here, by node.
            elif isinstance(row, StepEnd):
                stops: list[Row] = [
                    (
                        row.end,
                        STOP,
                        self._scenario.nodes[k],
                        -1,
                        -1,
                        self._setup.phases[self._setup.stages.stopping],
                        NAN,
                    )
                    for k in np.flatnonzero(stopped == row.slot).tolist()
                ]
                first = len(rows) - row.rows
                # Stable sort by node: an absorption of a node comes before its stop.
                rows[first:] = sorted([*rows[first:], *stops], key=lambda one: one[2])
            else:
                rows.append(row)
        return np.array(rows, dtype=EVENT), np.array(before, dtype=np.int64)

    def _append_row(self, row: Row) -> None:
        if self._recording:
            self._rows.append(row)

    def _send_all(self, step: Step) -> None:
        broadcast, now, phase = not self._timing.pairwise, step.begin, step.phase
        pairs, up = self._chosen_pairs.pop(0) if self._chosen_pairs else self._choose_pairs(step)
        connected = set(pairs)
        if self._reach is not None:
            self._reach.slot = step.slot
            connected = {pair for pair in pairs if self._reach.connects(*pair, now)}
        if broadcast:
            self._append_row((now, ROUND, -1, -1, -1, phase, NAN))
        if self._broadcasts is not None:
            senders = senders_of_pairs(pairs, self._scenario.topology.directed)
            self._broadcasts.begin(senders, bool(self._setup.fresh[step.step]))
        for i, j in pairs:
            if not broadcast and not self._down.issuperset((i, j)):
                self._append_row((now, TICK, i, j, -1, phase, NAN))
            both = self._by_link[i, j]
            if self._setup.fresh[step.step] or (i, j) not in self._last:
                # Draw even if a node sends nothing, so that the network does not depend on the
                # filter.
                drawn = [sampler.draw() for sampler in self._samplers[i, j]]
                # Both directions take the one draw of a symmetric channel.
                self._last[i, j] = drawn if len(drawn) == len(both) else drawn * 2
            # A recorded link that is down loses its messages, whatever was drawn.
            is_up = up is None or (i, j) in up
            if (i, j) not in connected:
                continue
            for direction, draw in zip(both, self._last[i, j], strict=True):
                if self._setup.talks[step.step, direction.index] and not self._is_silent(
                    direction, step
                ):
                    self._send(step, direction, draw if is_up else None)

    def _is_up(self, link: Link, step: Step) -> bool:
        if self._reach is None:
            return True
        self._reach.slot = step.slot
        return self._reach.is_up(*link, step.begin)

    def _choose_pairs(self, step: Step) -> tuple[list[Link], set[Link] | None]:
        return used_links(
            self._scenario.network.activation,
            self._scenario.topology,
            self._random,
            (step.slot, step.phase, step.repeat),
            self._timing.pairwise,
        )

    def _is_silent(self, direction: Direction, step: Step) -> bool:
        if direction.ends[0] in self._down:
            return True
        node = self._scenario.topology.index[direction.ends[0]]
        if self._sent is not None and not self._sent[node]:
            return True
        return bool(self._setup.may_miss and self._unread[step.step, node])

    def _send(self, step: Step, direction: Direction, draw: ChannelDraw | None) -> None:
        """Send one message; it is lost if ``draw`` says so or is None, its link being down."""
        (sender, receiver), number, now = direction.ends, direction.messages, step.begin
        direction.messages = number + 1
        self._append_row((now, SEND, sender, receiver, number, step.phase, NAN))
        channel, delay = self._scenario.network.channel, math.nan
        if draw is not None:
            if self._broadcasts is not None:
                draw = self._broadcasts.over(sender, draw)
            sent = direction.first._replace(number=number, time=now, bad=draw.bad)
            if self._follows_distance and self._reach is not None:
                sent = sent._replace(distance=self._reach.distance(*direction.ends, now))
            delay = self._instant(transit_time(channel, sent, draw))
        if math.isnan(delay) or (delay == 0.0 and receiver in self._down):
            self._append_row((now, LOST, sender, receiver, number, step.phase, NAN))
        elif delay == 0.0:
            self._append_row((now, DELIVER, receiver, sender, number, step.phase, 0.0))
            # The inbox holds one message of each sender, the last to arrive.
            self._inbox.setdefault(receiver, {})[sender] = (number, 0.0)
        # A message that would arrive after the end leaves no event.
        elif (arrival := self._instant(now + delay)) < self._scenario.end_time:
            self._order += 1
            # Order in the heap: time, directed link, order of sending.
            entry = (
                arrival,
                direction.index,
                self._order,
                direction,
                number,
                now,
                step.phase,
                self._open,
            )
            heapq.heappush(self._in_flight, entry)

    def _deliver(self, until: float) -> None:
        while self._in_flight and self._in_flight[0][0] <= until:
            self._pass_lives(self._in_flight[0][0])
            now, _, _, direction, number, sent, phase, exchange = heapq.heappop(self._in_flight)
            (sender, receiver), in_time = direction.ends, exchange == self._open
            age, is_lost = self._instant(now - sent), receiver in self._down
            # After the horizon nothing is recorded; the last exchange may still be finished.
            if now < self._scenario.horizon and is_lost:
                self._append_row((now, LOST, sender, receiver, number, phase, NAN))
            elif now < self._scenario.horizon:
                kind = DELIVER if in_time else LATE
                self._append_row((now, kind, receiver, sender, number, phase, age))
            if in_time and not is_lost:
                self._inbox.setdefault(receiver, {})[sender] = (number, age)
        self._pass_lives(until)

    def _pass_lives(self, until: float) -> None:
        """Let nodes go up and down until a time."""
        lives = self.lives
        while self._life_at < len(lives.t) and lives.t[self._life_at] <= until:
            k, self._life_at = self._life_at, self._life_at + 1
            node = self._scenario.nodes[lives.node[k]]
            now = float(lives.t[k])
            if now < self._scenario.horizon:
                self._append_row((now, int(lives.kind[k]), node, -1, -1, -1, NAN))
            self._down ^= {node}
            self._inbox.pop(node, None)

    def _end_step(self, step: Step, up: np.ndarray) -> None:
        count = len(self._rows)
        # By receiver and sender, the order of the kernels and of SimPy.
        for node in sorted(self._inbox):
            arrived = self._inbox[node]
            for peer in sorted(arrived):
                number, age = arrived[peer]
                up[self._setup.index_of_direction[peer, node]] = 1
                if self._timing.pairwise:
                    self._append_row((step.end, SWAP, node, peer, number, step.phase, age))
            if not self._timing.pairwise:
                oldest = max(age for _, age in arrived.values())
                self._append_row((step.end, ABSORB, node, -1, -1, step.phase, oldest))
        # Mark the place for stop rows, which ``rows`` inserts once the kernel has decided on them.
        if step.step == self._setup.stages.stopping and self._recording:
            self._rows.append(StepEnd(step.slot, step.end, len(self._rows) - count))
        self._inbox.clear()
        # From now on messages of this exchange are late.
        self._open = -1


def _stream(streams: Streams, ends: Link, purpose: str) -> np.random.Generator:
    return streams.generator(purpose, *ends)
