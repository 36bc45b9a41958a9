"""The messages of R runs in slots: drawn by kernels for many slots at a time, or made by numpy, a
run at a time (slot_tables), where channels or clocks are a user's own, messages take time, or nodes
move or are down.
"""

from __future__ import annotations

import numpy as np

from netkf.engines.compiled.outcomes import channel_streams, demand_probabilities
from netkf.engines.compiled.slot_messages import (
    SlotChannels,
    SlotMessages,
    SlotTimes,
    draw_by_link,
    draw_messages,
    draw_pairs,
    draw_uniforms,
    mark_senders,
)
from netkf.engines.compiled.slot_setup import SlotSetup
from netkf.engines.compiled.slot_steps import StepTimes, step_times
from netkf.engines.compiled.slot_tables import Decide, SlotTables
from netkf.linalg.arrays import FloatArray
from netkf.linalg.lanes import LANES, MANY, blocks_of
from netkf.network.deliveries import Deliveries
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario

CACHED = 1 << 18  # bytes of the processor's cache for arrival bits


class SlotTransmissions:
    """The messages of R runs of one scenario, of some slots after the other.

    tables : of each run, where kernels cannot draw the messages, else empty
    channels : what kernels draw outcomes with
    sent : (W,), messages of each directed link in the first run so far; ``SlotEvents`` counts them
    """

    def __init__(self, scenario: Scenario, setup: SlotSetup, streams: Streams) -> None:
        self._scenario, self._setup, self._runs = scenario, setup, streams.runs
        self._blocks = blocks_of(streams.runs)
        self.sent = np.zeros(len(setup.directions), dtype=np.int64)
        self.tables: list[SlotTables] = []
        if not setup.is_drawn:
            self.tables = [SlotTables(scenario, one, setup) for one in streams.per_replica]
        self._calls_law = setup.is_drawn and setup.law_in_kernels
        first = [self._scenario.transmission(w) for w in setup.directions if self._calls_law]
        channels = channel_streams(
            setup.channel, streams, setup.senders, setup.delivery, first=first
        )
        # -1: nothing drawn yet.
        uniform = np.full(len(channels.bad), -1.0)
        self.channels = SlotChannels(
            channels, uniform, setup.ends, setup.talks, np.zeros((0, 0)), setup.directions_per_link
        )
        # Draws of all links, anew in each slot, with probabilities that stay, may be made link by
        # link: in as many slots as have arrival bits in the processor's cache.
        self._units: FloatArray | None = None
        keeps = len(channels.state) or self._calls_law or not setup.fresh[:1].any()
        if len(channels.loss) and setup.matching.protocol < 0 and not keeps:
            steps, bits = len(setup.fresh), len(setup.fresh) * len(setup.directions) * LANES
            self._units = np.empty(steps * max(1, CACHED // bits))
        if setup.algorithm.timing.randomised:
            self._triggers = streams.states("trigger", [(node,) for node in setup.nodes.tolist()])
        self._matchings = setup.matchings(streams.states("matching", [()]))

    def restarts(self, slot: int) -> list[int]:
        """Return the indices of the nodes that begin again before a ``slot``."""
        return self.tables[0].restarts.get(slot, []) if self.tables else []

    def count_slots(self, first: int, max_events: int) -> int:
        """Return for how many slots from number ``first`` on messages can be made at once."""
        setup = self._setup
        if self.tables and setup.decides:
            # The filters decide who sends before the messages are made.
            return 1
        count = min(setup.block_slots(self._runs, max_events), setup.slots - first)
        if not (self.tables and setup.forgets):
            return count
        # Nodes begin again before the first slot of a block.
        return min([count, *(slot - first for slot in self.tables[0].restarts if slot > first)])

    def messages(self, times: SlotTimes) -> SlotMessages:
        """Make the messages of the next slots; of those that filters decide on only who is asked
        (``decided``).
        """
        setup, tables = self._setup, self.tables
        if not tables:
            return self._draw_messages(times)
        steps = self._step_times(times)
        if setup.decides:
            asked = tables[0].asked(steps)[None]
            up = np.zeros((*asked.shape[:2], len(setup.directions)), dtype=np.uint8)
            return _pack_messages([up], [asked])
        arrived = [one.following(steps) for one in tables]
        return _pack_messages(arrived, [one.awake for one in tables])

    def decided(self, times: SlotTimes, decide: Decide) -> np.ndarray:
        """Return (E, W) which messages of a slot arrive, if ``decide`` says step by step who sends
        them.
        """
        return self.tables[0].following(self._step_times(times), decide)

    def _step_times(self, times: SlotTimes) -> StepTimes:
        return step_times(self._scenario, self._setup, times.first, len(times.start))

    def _draw_messages(self, times: SlotTimes) -> SlotMessages:
        setup = self._setup
        shape, pairs = (len(times.start), len(setup.fresh)), setup.max_pairs
        decided = setup.decides or setup.may_miss
        # Without matchings the arrays of pairs stay empty.
        matched = self._runs if setup.matching.protocol >= 0 else 0
        messages = SlotMessages(
            up=np.zeros((self._blocks, *shape, len(setup.directions), LANES), dtype=np.uint8),
            active=np.empty((matched, *shape, pairs), dtype=np.int64),
            pair_count=np.zeros((matched, *shape), dtype=np.int64),
            # Empty if every node sends that is asked.
            sent=np.zeros(
                (self._blocks, *shape, len(setup.nodes), LANES) if decided else (0,) * 5,
                dtype=np.uint8,
            ),
        )
        if not len(setup.directions):
            return messages
        if matched:
            draw_pairs(
                self._matchings, setup.ends, times.exchanged, messages.active, messages.pair_count
            )
        channels = self.channels
        if self._calls_law:
            begin = np.ascontiguousarray(self._step_times(times).begin)
            channels = channels._replace(begin=begin)
        if self._units is not None:
            up, fresh = messages.up, setup.fresh
            draw_by_link(MANY, channels, times.exchanged, fresh, up, self._units, self._runs)
        else:
            draw_messages(MANY, channels, times.exchanged, setup.fresh, messages, self._runs)
        demand_probabilities(setup.channel.loss, channels.channels, setup.directions)
        if decided:
            self._mark_senders(messages, times.exchanged)
        # No chosen messages at all: the run as it was.
        if setup.deliveries is not None and setup.deliveries.chosen != frozenset():
            self._deliver_chosen(setup.deliveries, times, messages)
        return messages

    def _mark_senders(self, messages: SlotMessages, exchanged: np.ndarray) -> None:
        """Write 1 into ``messages.sent`` for the nodes that are asked for a message."""
        ends = self._setup.ends
        if not len(messages.pair_count):
            linked = np.isin(np.arange(len(self._setup.nodes)), ends)
            messages.sent[:, exchanged] = linked[:, None]
            return
        pairs = np.arange(self._setup.max_pairs) < messages.pair_count[..., None]
        r, s, e, a = (index[:, None] for index in np.nonzero(pairs))
        nodes = ends[messages.active[r[:, 0], s[:, 0], e[:, 0], a[:, 0]]]
        messages.sent[r // LANES, s, e, nodes, r % LANES] = 1

    def _deliver_chosen(
        self, deliveries: Deliveries, times: SlotTimes, messages: SlotMessages
    ) -> None:
        """Write 1 into ``messages.up`` for the messages that a replay delivers anyway."""
        setup, each = self._setup, self._setup.directions_per_link
        # (S, E, W): in which steps each directed link carries a message.
        is_sent = np.zeros(messages.up.shape[1:4], dtype=bool)
        is_sent[times.exchanged] = setup.talks
        if len(messages.active):
            is_active = np.zeros((*is_sent.shape[:2], len(setup.ends)), dtype=bool)
            for step in np.ndindex(*is_sent.shape[:2]):
                pairs = messages.active[(0, *step)][: messages.pair_count[(0, *step)]]
                is_active[(*step, pairs)] = True
            is_sent &= np.repeat(is_active, each, axis=2)
        if deliveries.chosen is None:
            messages.up[0, ..., 0][is_sent] = 1
            return
        for sender, receiver, number in deliveries.chosen:
            w = setup.index_of_direction[sender, receiver]
            # The messages of this direction in the block, in order, by slot and step.
            sent_slots, sent_steps = np.nonzero(is_sent[:, :, w])
            # Messages are numbered from the beginning of the run: ``sent`` came in earlier blocks.
            k = number - int(self.sent[w])
            if 0 <= k < len(sent_slots):
                messages.up[0, sent_slots[k], sent_steps[k], w, 0] = 1

    def missed_readings(self, times: SlotTimes, messages: SlotMessages) -> np.ndarray:
        """Return (S, E, N) bool: nodes without a reading to send; drop their messages."""
        setup, count = self._setup, len(times.start)
        if not setup.may_miss:
            return np.zeros((count, len(setup.fresh), len(setup.nodes)), dtype=bool)
        unread = setup.unread(times.first, count)
        senders = setup.ends[:, : setup.directions_per_link].reshape(-1)
        messages.up[:, unread[:, :, senders]] = 0
        return unread

    def senders(self, times: SlotTimes, messages: SlotMessages, unread: np.ndarray) -> np.ndarray:
        """Return (B, S, E, N, L) 1 where nodes have links to send on; empty if all is exact."""
        if self._scenario.network.quantise is None:
            # Five dimensions, as kernels are compiled for.
            return np.zeros((0,) * 5, dtype=np.uint8)
        speaks = np.zeros((self._blocks, *unread.shape, LANES), dtype=np.uint8)
        for r, tables in enumerate(self.tables):
            speaks[r // LANES, ..., r % LANES] = tables.speaks
        if not self.tables:
            mark_senders(self.channels, messages, times.exchanged, self._runs, speaks)
            speaks[:, unread] = 0
        return speaks

    def uniforms(self, sent: np.ndarray) -> FloatArray:
        """Return uniform numbers (B, S, E, N, L) for decisions; empty if none is needed."""
        if not self._setup.algorithm.timing.randomised or not self._setup.decides:
            # Five dimensions, as kernels are compiled for.
            return np.zeros((0,) * 5)
        uniform = np.zeros(sent.shape)
        draw_uniforms(MANY, self._triggers, sent, uniform, self._runs)
        return uniform


def _pack_messages(up: list[np.ndarray], sent: list[np.ndarray]) -> SlotMessages:
    """Return the messages of runs as those of lanes."""
    lane_arrays = []
    for of_runs in (up, sent):
        blocks = blocks_of(len(of_runs)) if len(of_runs[0]) else 0
        lanes = np.zeros((blocks, *of_runs[0].shape, LANES), dtype=np.uint8)
        for r, values in enumerate(of_runs if blocks else ()):
            lanes[r // LANES, ..., r % LANES] = values
        lane_arrays.append(lanes)
    # The arrays of matched pairs stay empty: only kernels that draw messages use them.
    active, pairs = (np.zeros((0,) * d, dtype=np.int64) for d in (4, 3))
    return SlotMessages(up=lane_arrays[0], active=active, pair_count=pairs, sent=lane_arrays[1])
