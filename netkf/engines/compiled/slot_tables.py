"""Messages in slots as tables, of many slots at a time, for channels and activations that kernels
cannot draw: a user's own losses and delays, outcomes that hearers share, messages that take time,
recorded exchanges, nodes that move or are down.

Messages do not depend on estimates, unless nodes may be silent: then tables are one slot long, and
the filters' kernel decides step by step who sends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from netkf.engines.compiled.drawn_ahead import DrawnAhead, numbers_of
from netkf.engines.compiled.life_tables import life_table
from netkf.engines.compiled.outcomes import delivery_table, message_delays, sampler_of
from netkf.engines.compiled.per_scenario import once_per_scenario
from netkf.engines.compiled.slot_messages import Matchings, draw_pairs
from netkf.engines.compiled.slot_setup import SlotSetup, slot_setup
from netkf.engines.compiled.slot_steps import StepTimes, slot_restarts
from netkf.engines.reach import Reach
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.channels import broadcasts_of, conditions_of
from netkf.network.delays import delay_depends_on_message
from netkf.network.losses import GilbertElliott, Transmission, identical_per_link
from netkf.network.matchings import Broadcast, Matching, used_links
from netkf.network.radio import Airtime
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.recorder import NAN
from netkf.trace.schema import (
    ABSORB,
    DELIVER,
    EVENT,
    KINDS,
    LATE,
    LINK,
    LOST,
    ROUND,
    SEND,
    SENSE,
    STOP,
    SWAP,
    TICK,
)

COLUMNS = ("t", "kind", "node", "peer", "message", "phase", "age")
Decide = Callable[[int, np.ndarray], np.ndarray]
AHEAD = 256
"""Rows of random numbers that are drawn ahead for each link where tables are one slot long."""


class UnorderedRows(NamedTuple):
    """K rows of events of one kind, before they are in order. A number is the same in all rows.

    part : (K,), in which part of the block they are, see ``SlotTables``
    t, kind, node, peer, message, phase, age : the columns of EVENT
    group, place, number : (K,), their order in a part at the same time
    """

    part: IntArray
    t: Any
    kind: Any
    node: Any
    peer: Any = -1
    message: Any = -1
    phase: Any = -1
    age: Any = NAN
    group: Any = 0
    place: Any = 0
    number: Any = 0


class Uses(NamedTuple):
    """The D directed links that are used in a block of slots, in the order of time.

    slot, step, place : (D,), index of the slot in the block, step of its exchanges, and the link's
        number among those of the step
    w : (D,), the directed link
    up : (D,) bool, whether recorded exchanges say that it is up
    near : (D,) bool, whether its ends are near enough to hear each other
    distance : (D,), of its ends, where losses follow it and nodes move
    uniform, bad, delay : (D,), what was drawn: a uniform number, the state (1: bad), seconds
    """

    slot: IntArray
    step: IntArray
    place: IntArray
    w: IntArray
    up: np.ndarray
    near: np.ndarray
    distance: FloatArray
    uniform: FloatArray
    bad: FloatArray
    delay: FloatArray


class Messages(NamedTuple):
    """K messages, (K,) each.

    slot, step, place, w : as in Uses
    number : on its directed link
    sent, arrival, closes : times in seconds; nan if it is lost when it is sent; when the inbox
        closes
    outcome : the kind of event with which it ends, -1 if that is not recorded
    absorbed : bool, that it is in the inbox when that closes
    """

    slot: IntArray
    step: IntArray
    place: IntArray
    w: IntArray
    number: IntArray
    sent: FloatArray
    arrival: FloatArray
    closes: FloatArray
    outcome: IntArray
    absorbed: np.ndarray


Rows = TypeVar("Rows", UnorderedRows, Uses, Messages)


def _chosen(rows: Rows, chosen: np.ndarray) -> Rows:
    """Return the ``chosen`` (K,) ones of K rows."""
    if chosen.all():
        return rows
    columns: Iterable[Any] = rows
    return type(rows)(*(c[chosen] if isinstance(c, np.ndarray) else c for c in columns))


NO_MESSAGES = Messages(*(np.zeros(0, dtype=np.int64),) * 5, *(np.zeros(0),) * 3,
                       np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool))  # fmt: skip


class SlotTables:
    """Makes the messages and events of one run, a block of slots at a time.

    A slot has parts, in this order: the arrivals until it begins, the links that a first sample
    looks at, three for each stage (a reading, or a step of an exchange: who sends, who hears until
    the step ends, who absorbs), and the links that a last sample looks at.

    awake : (S, E, N) flags: nodes that may send, in the slots just made; empty without lives
    speaks : (S, E, N) flags: nodes with links to send on, where messages are of few bits
    """

    def __init__(self, scenario: Scenario, streams: Streams, setup: SlotSetup) -> None:
        self._scenario, self._setup, self._timing = scenario, setup, scenario.node_filter.timing
        self._grid, self._channel = scenario.time_grid, scenario.network.channel
        self._ids = np.array(scenario.nodes, dtype=np.int64)
        index = scenario.topology.index
        ends = [(index[i], index[j]) for i, j in setup.directions]
        self._sender, self._receiver = np.array(ends, dtype=np.int64).reshape(-1, 2).T
        self._phase = np.array(setup.phases, dtype=np.int64)
        self._stage_of_step = np.flatnonzero(setup.stages.step >= 0)
        self._parts = 3 + 3 * len(setup.stages.step)
        self.lives, self._lives_passed = life_table(scenario, streams), 0
        # How many changes are recorded.
        self._changes = int(np.searchsorted(self.lives.t, scenario.horizon))
        self._counts = np.bincount(self.lives.kind[: self._changes], minlength=len(KINDS))
        self.restarts = slot_restarts(scenario, self.lives)
        self._links: list[tuple[int, Any]] = []
        self._part = 0
        self._reach: Reach | None = None
        if scenario.links_move:
            self._reach = Reach(scenario, scenario.slot_truth(streams), self._append_link)
        self._begin_pairs(streams)
        self._begin_channel(streams)
        self._sent_so_far = np.zeros(len(setup.directions), dtype=np.int64)
        self._under_way = NO_MESSAGES
        self._uses: Uses | None = None
        self.awake = self.speaks = np.zeros((0,) * 3, dtype=np.uint8)

    def _append_link(self, row: Any) -> None:
        if self._part >= 0:
            self._links.append((self._part, row))
            self._counts[LINK] += 1

    def _begin_pairs(self, streams: Streams) -> None:
        setup, activation = self._setup, self._scenario.network.activation
        self._matchings: Matchings | None = None
        self._random: np.random.Generator | None = None
        if type(activation) is Matching:
            self._matchings = setup.matchings(streams.states("matching", [()]))
        elif type(activation) is not Broadcast:
            self._random = streams.generator("matching")

    def _begin_channel(self, streams: Streams) -> None:
        scenario, setup, channel = self._scenario, self._setup, self._channel
        conditions = conditions_of(channel.loss, streams, scenario.horizon)
        self._first, self._delivery = _first_messages(scenario)
        if conditions is not None:
            self._first = [sent._replace(conditions=conditions) for sent in self._first]
        self._radio = scenario.network.radio
        self._airtime = Airtime(scenario, streams) if self._radio else None
        self._follows = self._reach is not None and channel.loss.follows_distance
        samplers = [sampler_of(channel, streams, ends) for ends in setup.senders.sources]
        ahead = AHEAD if setup.decides else 0
        # Links that hold their draws have the last one, of all that they made.
        self._draws = DrawnAhead(lambda k, count: samplers[k].draws(count), 3, len(samplers), ahead)
        self._drawn = np.zeros(len(setup.ends), dtype=np.int64)
        self._shared: DrawnAhead | None = None
        if (broadcasts := broadcasts_of(scenario, streams)) is not None:

            def of_senders(h: int, count: int) -> Sequence[FloatArray]:
                uniform, bad = broadcasts.draws(scenario.nodes[h], count)
                return uniform, np.full(count, np.nan) if bad is None else bad

            self._shared = DrawnAhead(of_senders, 2, len(scenario.nodes), ahead)
            self._shared_drawn = np.zeros(len(scenario.nodes), dtype=np.int64)

    def asked(self, times: StepTimes) -> np.ndarray:
        """Return (E, N) flags: nodes asked for a message in each step of a slot at ``times``."""
        setup, uses = self._setup, self._begin_block(times)
        asked = np.zeros((len(setup.fresh), len(setup.nodes)), dtype=np.uint8)
        if self._timing.pairwise:
            for end in (self._sender, self._receiver):
                asked[uses.step[uses.near], end[uses.w[uses.near]]] = 1
        elif times.exchanged[0]:
            # Broadcasts use all links.
            asked[:, setup.ends.ravel()] = 1
        if setup.quantise is not None:
            # The filters are asked before the messages are made, and need to know who speaks.
            self._find_senders(times, uses)
        return np.asarray(asked * ~self._down(times)[0])

    def following(self, times: StepTimes, decide: Decide | None = None) -> np.ndarray:
        """Make the messages of the next slots, with these ``times``; return (S, E, W) which are
        absorbed. If nodes may be silent it is one slot: ``decide(step, up)`` returns who sends,
        (N,), given ``up`` (E, W) of the steps before.
        """
        setup, uses = self._setup, self._uses or self._begin_block(times)
        up = np.zeros((len(times.start), len(setup.fresh), len(setup.directions)), dtype=np.uint8)
        sends = self._find_senders(times, uses)
        if decide is None:
            messages = self._send(times, _chosen(uses, sends), up)
        else:
            parts = [NO_MESSAGES]
            for step in range(len(setup.fresh) if times.exchanged[0] else 0):
                sent = decide(step, up[0])
                chosen = sends & (uses.step == step) & (sent[self._sender[uses.w]] != 0)
                parts.append(self._send(times, _chosen(uses, chosen), up))
            messages = Messages(*map(np.concatenate, zip(*parts, strict=True)))
        self._starts = self._rows_of_steps(times, uses)
        self._uses, self._times, self._messages = None, times, messages
        self._count()
        return up

    def _begin_block(self, times: StepTimes) -> Uses:
        """Find which links are used in the next slots, with their random numbers."""
        slot, step, place, link, ups = self._used_links(times)
        each, senders = self._setup.directions_per_link, self._setup.senders
        # A link is drawn for even if nobody sends, so that the network does not depend on filters.
        number = numbers_of(link, self._setup.fresh[step], self._drawn)
        slot, step, place, number = (np.repeat(c, each) for c in (slot, step, place, number))
        w = (link[:, None] * each + np.arange(each)).ravel()
        draws = self._draws.rows(senders.source[w], number)
        uses = Uses(
            slot, step, place, w, ups, np.ones(len(w), dtype=bool), np.full(len(w), NAN), *draws
        )
        if self._shared is not None:
            self._share(uses, len(times.start))
        self._links = []
        if self._reach is not None:
            self._look(times, uses)
        self._uses = uses
        return uses

    def _share(self, uses: Uses, count: int) -> None:
        """Write what all hearers of a broadcast share into what was drawn for the ``uses``."""
        _, step, sender, back = self._transmissions(uses, count)
        numbers = numbers_of(sender, self._setup.fresh[step], self._shared_drawn)
        assert self._shared is not None
        shared = self._shared.rows(sender, numbers)[:, back]
        for own, common in zip((uses.uniform, uses.bad), shared, strict=True):
            known = ~np.isnan(common)
            own[known] = common[known]

    def _transmissions(self, uses: Uses, count: int) -> tuple[IntArray, ...]:
        """Return slot, step and sender (K,) of transmissions, and which (D,) each use has."""
        steps, nodes = len(self._setup.fresh), len(self._ids)
        key = (uses.slot * steps + uses.step) * nodes + self._sender[uses.w]
        is_sent = np.zeros(count * steps * nodes, dtype=bool)
        is_sent[key] = True
        moment, sender = np.divmod(np.flatnonzero(is_sent), nodes)
        slot, step = np.divmod(moment, max(steps, 1))
        return slot, step, sender, (np.cumsum(is_sent) - 1)[key]

    def _used_links(self, times: StepTimes) -> tuple[IntArray, IntArray, IntArray, IntArray, Any]:
        """Return slot, step, place in it and link (U,) of each use, and the links up (D,)."""
        setup = self._setup
        steps, links = len(setup.fresh), len(setup.ends)
        count, each = len(times.start), setup.directions_per_link
        if self._matchings is not None:
            shape = 1, count, steps
            pairs = np.zeros(shape, dtype=np.int64)
            active = np.zeros((*shape, setup.max_pairs), dtype=np.int64)
            if links:
                draw_pairs(self._matchings, setup.ends, times.exchanged, active, pairs)
            slot, step, place = np.nonzero(np.arange(setup.max_pairs) < pairs[0, ..., None])
            link = active[0, slot, step, place]
            return slot, step, place, link, np.ones(len(link) * each, dtype=bool)
        if self._random is None:
            slot, step, link = np.nonzero(
                np.broadcast_to(times.exchanged[:, None, None], (count, steps, links))
            )
            return slot, step, link, link, np.ones(len(link) * each, dtype=bool)
        return self._listed_links(times)

    def _listed_links(self, times: StepTimes) -> tuple[IntArray, IntArray, IntArray, IntArray, Any]:
        setup, scenario = self._setup, self._scenario
        index = {link: k for k, link in enumerate(scenario.topology.links)}
        rows: list[tuple[int, int, int, int]] = []
        ups: list[bool] = []
        assert self._random is not None
        for s in np.flatnonzero(times.exchanged).tolist():
            repeats = dict.fromkeys(setup.phases, 0)
            for e, phase in enumerate(setup.phases):
                key = times.first + s, phase, repeats[phase]
                repeats[phase] += 1
                pairs, up = used_links(
                    scenario.network.activation,
                    scenario.topology,
                    self._random,
                    key,
                    self._timing.pairwise,
                )
                rows += [(s, e, place, index[pair]) for place, pair in enumerate(pairs)]
                for pair in pairs:
                    # Both directions of a link are up, or none.
                    ups += [up is None or pair in up] * setup.directions_per_link
        columns = np.array(rows, dtype=np.int64).reshape(-1, 4).T
        return (*columns, np.array(ups, dtype=bool))

    def _look(self, times: StepTimes, uses: Uses) -> None:
        """Find which ends of the links that are used are near each other."""
        reach, setup, horizon = self._reach, self._setup, self._scenario.horizon
        assert reach is not None
        count, each, links = len(times.start), setup.directions_per_link, setup.ends
        first = np.searchsorted(uses.slot, np.arange(count + 1))
        sampled = np.isin(times.first + np.arange(count), setup.samples)
        ends = self._ids[links].tolist()
        for s in range(count):
            reach.slot, part = times.first + s, s * self._parts
            self._part = part + 1
            now = float(times.start[s])
            if sampled[s] and self._timing.predicts and now < horizon:
                reach.look_at_all(reach.slot, now)
            for d in range(first[s], first[s + 1], each):
                step = int(uses.step[d])
                self._part = self._part_of(s, step) if times.recorded[s] else -1
                pair = ends[uses.w[d] // each]
                now = float(times.begin[s, step])
                uses.near[d : d + each] = reach.connects(pair[0], pair[1], now)
                if self._follows:
                    uses.distance[d : d + each] = reach.distance(pair[0], pair[1], now)
            self._part = part + self._parts - 1
            now = float(times.of_stage(setup, len(setup.stages.step))[s])
            if sampled[s] and not self._timing.predicts and now < horizon:
                reach.look_at_all(reach.slot, now)

    def _part_of(self, slot: Any, step: Any) -> Any:
        """Return the part of a block in which nodes send, in a step of a slot."""
        return slot * self._parts + 2 + 3 * self._stage_of_step[step]

    def _down(self, times: StepTimes) -> np.ndarray:
        """Return (S, E, N) bool: who is down when a step begins in which nodes exchange."""
        down = self.lives.is_down(np.arange(len(self._ids)), times.begin[..., None])
        return np.asarray(down & times.exchanged[:, None, None])

    def _find_senders(self, times: StepTimes, uses: Uses) -> np.ndarray:
        """Return which of the uses (D,) carry a message, unless nodes decide to be silent."""
        setup, sender = self._setup, self._sender[uses.w]
        sends = uses.near & (setup.talks[uses.step, uses.w] == 1)
        self.awake = np.zeros((0,) * 3, dtype=np.uint8)
        if self._scenario.network.lives:
            down = self._down(times)
            self.awake = (~down).astype(np.uint8)
            sends &= ~down[uses.slot, uses.step, sender]
        if setup.may_miss:
            sends &= ~setup.unread(times.first, len(times.start))[uses.slot, uses.step, sender]
        if setup.quantise is not None:
            self.speaks = np.zeros((*times.begin.shape, len(setup.nodes)), dtype=np.uint8)
            self.speaks[uses.slot[sends], uses.step[sends], sender[sends]] = 1
        return np.asarray(sends)

    def _send(self, times: StepTimes, uses: Uses, up: np.ndarray) -> Messages:
        """Send a message over each of the uses (K,); ``up`` (S, E, W) says which arrive in time."""
        w = uses.w
        number = numbers_of(w, np.ones(len(w), dtype=bool), self._sent_so_far)
        begin, closes = times.begin[uses.slot, uses.step], times.end[uses.slot, uses.step]
        delay = self._grid.snap(self._delays(uses, number, begin) + self._waits(uses, times))
        arrival, receiver = self._grid.snap(begin + delay), self._receiver[w]
        lost, absorbed = np.isnan(delay), arrival <= closes
        # What arrives before the horizon is recorded, and what comes in time in a recorded slot.
        is_recorded = (arrival < self._scenario.horizon) & (arrival > begin)
        is_recorded |= times.recorded[uses.slot] & ~(arrival > closes)
        outcome = np.where(absorbed, DELIVER, LATE)
        if self._scenario.network.lives:
            lost |= self.lives.is_down(receiver, arrival)
            # Who goes down before the inbox closes has lost what arrived.
            kept = self.lives.passed(receiver, arrival) == self.lives.passed(receiver, closes)
            absorbed &= kept & ~lost
        here = slice(None) if absorbed.all() else absorbed
        up[uses.slot[here], uses.step[here], w[here]] = 1
        outcome = np.where(is_recorded, np.where(lost, LOST, outcome), -1)
        return Messages(*uses[:4], number, begin, arrival, closes, outcome, absorbed)

    def _delays(self, uses: Uses, number: IntArray, begin: FloatArray) -> FloatArray:
        """Return the seconds (K,) that messages take, nan if lost."""
        uniform, bad, drawn = uses.uniform, uses.bad, uses.delay
        if self._delivery is not None:
            arrives = uniform < self._delivery[(bad == 1.0).astype(np.int64), uses.w]
            return np.where(arrives & uses.up, drawn, NAN)
        delays, phase = np.full(len(number), NAN), self._phase[uses.step]
        # Messages of another phase may have another size.
        phases = 1 + int(phase.max(initial=0)) if self._radio is not None else 1
        key = uses.w * phases + (phase if phases > 1 else 0)
        order = np.argsort(key, kind="stable")
        cuts = np.searchsorted(key[order], np.arange(len(self._first) * phases + 1))
        for k in np.flatnonzero(np.diff(cuts)).tolist():
            w, of_phase = divmod(k, phases)
            one = order[cuts[k] : cuts[k + 1]]
            one = one[uses.up[one]]
            sent = self._first[w]._replace(number=number[one], time=begin[one], bad=bad[one] == 1.0)
            if self._follows:
                sent = sent._replace(distance=uses.distance[one])
            if of_phase and self._radio is not None:
                size = self._scenario.message_size(sent.link[0], of_phase)
                sent = sent._replace(size=size, frames=self._radio.frames(size))
            delays[one] = message_delays(self._channel, sent, uniform[one], drawn[one])
        return np.where(delays >= 0.0, delays, NAN)

    def _waits(self, uses: Uses, times: StepTimes) -> Any:
        """Return the seconds (K,) until radios have sent the last bit, nan if it is dropped."""
        if self._airtime is None:
            return 0.0
        slot, step, sender, back = self._transmissions(uses, len(times.start))
        begin, phase, waits = times.begin[slot, step], self._phase[step], np.zeros(len(slot))
        for h in np.unique(sender).tolist():
            own, node = sender == h, int(self._ids[h])
            sizes = [self._scenario.message_size(node, k) for k in phase[own].tolist()]
            waits[own] = self._airtime.waits(node, sizes, begin[own])
        return waits[back]

    def _count(self) -> None:
        """Count the events of a block, of messages when they are sent."""
        counts, messages = self._counts, self._messages
        for rows in self._starts:
            counts[rows.kind] += len(rows.part)
        recorded, outcome = self._times.recorded[messages.slot], messages.outcome
        counts += np.bincount(outcome[outcome >= 0], minlength=len(KINDS))
        counts[SEND] += int(recorded.sum())
        absorbed = messages.absorbed & recorded
        if self._timing.pairwise:
            counts[SWAP] += int(absorbed.sum())
        else:
            hears = np.zeros(self._times.begin.size * len(self._ids), dtype=bool)
            hears[self._hearings(messages)[absorbed]] = True
            counts[ABSORB] += int(np.count_nonzero(hears))

    def take_counts(self) -> IntArray:
        """Return how many events of each kind (KINDS,) came since this was asked for last, but for
        what filters decide: that they refuse a reading, and stop.
        """
        counts = self._counts.copy()
        self._counts[:] = 0
        return counts

    def _hearings(self, messages: Messages) -> IntArray:
        """Return a number (K,) that messages with one receiver share in a step of a slot."""
        step = messages.slot * len(self._setup.fresh) + messages.step
        return np.asarray(step * len(self._ids) + self._receiver[messages.w])

    def _rows_of(self, times: StepTimes, messages: Messages) -> list[UnorderedRows]:
        """Return the rows of the messages of a block, and of what happens meanwhile."""
        kept = _chosen(messages, times.recorded[messages.slot])
        part, sender, receiver = self._part_of(kept.slot, kept.step), *self._ends_of(kept)
        # Rows of a message in the order of the pairs, forth before back.
        order = 3 * (kept.w % self._setup.directions_per_link)
        sends = UnorderedRows(
            part, kept.sent, SEND, sender, receiver, kept.number, self._phase[kept.step],
            group=2, place=kept.place, number=order,
        )  # fmt: skip
        ended = ~(kept.arrival > kept.sent)
        at_once = self._rows_of_outcomes(
            _chosen(kept, ended), part[ended], 2, kept.place[ended], order[ended] + 1
        )
        links = [
            UnorderedRows(np.array([part]), t, kind, i, j, is_up, place=k)
            for k, (part, (t, kind, i, j, is_up, *_)) in enumerate(self._links)
        ]
        rows = self._rows_of_ends(kept, part + 2)
        return [sends, at_once, rows, *self._rows_between(times, messages), *links]

    def _ends_of(self, messages: Messages) -> tuple[IntArray, IntArray]:
        """Return the ids of the senders and receivers, (K,) each."""
        return self._ids[self._sender[messages.w]], self._ids[self._receiver[messages.w]]

    def _rows_of_outcomes(self, ended: Messages, part: IntArray, *order: Any) -> UnorderedRows:
        sender, receiver = self._ends_of(ended)
        lost, never = ended.outcome == LOST, np.isnan(ended.arrival)
        age = self._grid.snap(ended.arrival - ended.sent)
        return UnorderedRows(
            part, np.where(never, ended.sent, ended.arrival), ended.outcome,
            np.where(lost, sender, receiver), np.where(lost, receiver, sender), ended.number,
            self._phase[ended.step], np.where(lost, NAN, age), *order,
        )  # fmt: skip

    def _rows_of_steps(self, times: StepTimes, uses: Uses) -> list[UnorderedRows]:
        """Return the rows of readings, and those with which the steps of exchanges begin."""
        setup, rows = self._setup, []
        reads = times.recorded & (
            (times.first + np.arange(len(times.start)) > 0) | self._timing.predicts
        )
        for stage in np.flatnonzero(setup.stages.step < 0).tolist():
            now = times.of_stage(setup, stage)
            sensing = np.array([self._scenario.topology.index[i] for i in setup.sensing], dtype=int)
            there = reads[:, None] & ~self.lives.is_down(sensing, now[:, None])
            slot, place = np.nonzero(there)
            part = slot * self._parts + 2 + 3 * stage
            rows.append(UnorderedRows(part, now[slot], SENSE, setup.sensing[place], place=place))
        if not self._timing.pairwise:
            acts = np.broadcast_to((times.exchanged & times.recorded)[:, None], times.begin.shape)
            slot, step = np.nonzero(acts)
            part, t = self._part_of(slot, step), times.begin[slot, step]
            rows.append(UnorderedRows(part, t, ROUND, -1, phase=self._phase[step], group=1))
            return rows
        used = _chosen(uses, times.recorded[uses.slot] & (uses.w % setup.directions_per_link == 0))
        t, ends = times.begin[used.slot, used.step], (self._sender[used.w], self._receiver[used.w])
        i, j = (self._ids[end] for end in ends)
        part, phase = self._part_of(used.slot, used.step), self._phase[used.step]
        both_down = np.logical_and(*(self.lives.is_down(end, t) for end in ends))
        ticks = UnorderedRows(
            part, t, TICK, i, j, phase=phase, group=2, place=used.place, number=-1
        )
        rows.append(_chosen(ticks, ~both_down))
        return rows

    def _rows_of_ends(self, kept: Messages, part: IntArray) -> UnorderedRows:
        """Return the rows with which steps end, given the messages of those that are recorded."""
        used = kept.absorbed
        here, part = _chosen(kept, used), part[used]
        node, age = self._receiver[here.w], self._grid.snap(here.arrival - here.sent)
        if self._timing.pairwise:
            peer = self._ids[self._sender[here.w]]
            return UnorderedRows(
                part, here.closes, SWAP, self._ids[node], peer, here.number,
                self._phase[here.step], age, place=self._ids[node], number=peer,
            )  # fmt: skip
        # All that a node absorbs in a step is one row, with the age of the oldest.
        key, first, back = np.unique(self._hearings(here), return_index=True, return_inverse=True)
        oldest = np.zeros(len(key))
        np.maximum.at(oldest, back, age)
        return UnorderedRows(
            part[first], here.closes[first], ABSORB, self._ids[node[first]],
            phase=self._phase[here.step[first]], age=oldest, place=self._ids[node[first]],
        )  # fmt: skip

    def _rows_between(
        self, times: StepTimes, messages: Messages
    ) -> tuple[UnorderedRows, UnorderedRows]:
        """Return rows of slow messages and of lives until the block ends; keep later ones."""
        until, part = self._ends_of_parts(times)
        new = _chosen(messages, (messages.arrival > messages.sent) & (messages.outcome >= 0))
        under_way = Messages(*map(np.concatenate, zip(self._under_way, new, strict=True)))
        at = np.searchsorted(until, under_way.arrival)
        self._under_way = _chosen(under_way, at == len(until))
        here, part_of = _chosen(under_way, at < len(until)), part[at[at < len(until)]]
        ended = self._rows_of_outcomes(here, part_of, 1, here.w, here.number)
        lives, first = self.lives, self._lives_passed
        self._lives_passed = int(np.searchsorted(lives.t[: self._changes], until[-1], "right"))
        span = slice(first, self._lives_passed)
        changes = UnorderedRows(
            part[np.searchsorted(until, lives.t[span])], lives.t[span], lives.kind[span],
            self._ids[lives.node[span]], place=lives.node[span],
        )  # fmt: skip
        return ended, changes

    def _ends_of_parts(self, times: StepTimes) -> tuple[FloatArray, IntArray]:
        """Return when the parts end in which messages arrive, and which parts these are, (P,)."""
        count, steps = times.begin.shape
        slots = np.arange(count)[:, None]
        until = np.column_stack([times.start, times.end])
        part = np.concatenate(
            [slots * self._parts, self._part_of(slots, np.arange(steps)) + 1], axis=1
        )
        there = np.repeat(times.exchanged[:, None], 1 + steps, axis=1)
        there[:, 0] = True
        # After the last slot come the messages that are still under way.
        more = times.first + count == self._setup.slots
        return (
            np.append(until[there], [math.inf] * more),
            np.append(part[there], [count * self._parts] * more),
        )

    def events(self, sampled: IntArray, stopped: IntArray) -> tuple[np.ndarray, IntArray]:
        """Return the events of the slots just made as EVENT rows (K,), and the number of rows
        before the samples of slots ``sampled``, (T,). ``stopped`` (N,): the slot where nodes stop.
        """
        groups = [*self._starts, *self._rows_of(self._times, self._messages)]
        if self._setup.stages.stopping >= 0:
            groups = [*groups, self._stops(stopped - self._times.first, self._times)]
        columns = [[np.broadcast_to(c, len(rows.part)) for c in rows] for rows in groups]
        part, t, *of_event, group, place, number = map(np.concatenate, zip(*columns, strict=True))
        order = np.lexsort((number, place, group, t, part))
        table = np.empty(len(order), dtype=EVENT)
        table["t"] = t[order]
        for name, column in zip(COLUMNS[1:], of_event, strict=True):
            table[name] = column[order]
        last = 1 if self._timing.predicts else self._parts - 1
        return table, np.searchsorted(part[order], sampled * self._parts + last, side="right")

    def _stops(self, slot: IntArray, times: StepTimes) -> UnorderedRows:
        """Return the rows of nodes that stop in these slots (N,) of the block."""
        # A node stops by permanently freezing its network estimate, after it absorbed.
        node = np.flatnonzero((slot >= 0) & (slot < len(times.start)))
        node = node[(times.exchanged & times.recorded)[slot[node]]]
        slot, step = slot[node], self._setup.stages.stopping
        part, closes = self._part_of(slot, step) + 2, times.end[slot, step]
        phase, ids = self._phase[step], self._ids[node]
        return UnorderedRows(
            part, closes, STOP, ids, phase=phase, place=ids, number=np.iinfo(int).max
        )


@once_per_scenario
def _first_messages(scenario: Scenario) -> tuple[list[Transmission], FloatArray | None]:
    """Return the first message of each directed link, and fixed deliveries (2, W)."""
    channel, directions = scenario.network.channel, slot_setup(scenario).directions
    first = [scenario.transmission(ends) for ends in directions]
    one_law = identical_per_link(channel.loss) or type(channel.loss) is GilbertElliott
    moves = scenario.links_move and channel.loss.follows_distance
    one_law &= scenario.network.radio is None
    if not one_law or moves or channel.channels or delay_depends_on_message(channel.delay):
        return first, None
    return first, delivery_table(scenario, channel.loss, directions)
