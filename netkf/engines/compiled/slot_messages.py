"""Messages in slots, compiled: draw the matchings and losses, write or count their events.

Every link draws from streams of its own, so that messages of many slots and runs are drawn before
any estimate is computed. Dimensions: B blocks of L runs side by side (``linalg.lanes``; R <= B L
runs), S slots, E steps of a slot's exchanges, W directed links, N nodes, at most A pairs. Their
indices are b, q (lane), r, s, e, w.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.core.instants import snapped
from netkf.engines.compiled.outcomes import ChannelStreams, delivery_probability_of, next_link_state
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import Lanes, load_flags, select, spread, store
from netkf.network.matchings import PROTOCOLS
from netkf.rng.draws import next_unit
from netkf.rng.numbers import next_integer, shuffle
from netkf.trace.schema import ABSORB, DELIVER, LOST, ROUND, SEND, SENSE, STOP, SWAP, TICK

ONE_EDGE, NODE_WAKEUP, MAXIMAL, UNIFORM_MAXIMAL, INDEPENDENT = range(len(PROTOCOLS))
NAN = np.nan


class Matchings(NamedTuple):
    """The matching protocol of a network, and the random streams that R runs draw from.

    protocol : index in PROTOCOLS, -1: all links exchange
    probability : parameter ``lazy`` or ``p`` of the protocol
    states : states (R, WIDTH) of the random streams
    first, members : (K + 1,) and (M,), list k of links is ``members[first[k]:first[k + 1]]``; for
                     node-wakeup the links of node k in the order of its peers, for uniform-maximal
                     matching k
    order, busy : scratch, an entry for each link and for each node (N,)
    """

    protocol: int
    probability: float
    states: np.ndarray
    first: np.ndarray
    members: np.ndarray
    order: np.ndarray
    busy: np.ndarray


class SlotChannels(NamedTuple):
    """The links of R runs, of S streams each, and the last numbers drawn for them.

    channels : losses of the directed links, and their random streams
    uniform : (R S,), the last uniform number of each stream, -1 at first
    ends : (links, 2), indices of nodes; direction 2 l goes from the first to the second
    talks : (E, W), 1 if the sender of a direction has something to send in a step
    begin : (S, E), when steps begin, in seconds; (0, 0) where losses do not depend on it
    per_link : directions of a link, 1 or 2
    """

    channels: ChannelStreams
    uniform: FloatArray
    ends: np.ndarray
    talks: np.ndarray
    begin: FloatArray
    per_link: int


@kernel
def draw_matching(matchings: Matchings, ends: np.ndarray, r: int, active: np.ndarray) -> int:
    """Draw one matching of run ``r``: write the indices of its links into ``active`` (A,), in their
    order, and return how many there are; ``ends`` (links, 2).
    """
    count, states = len(ends), matchings.states
    first, members = matchings.first, matchings.members
    if count == 0:
        return 0
    # The order of the draws is that of Matching.draw: it decides which numbers a protocol takes.
    if matchings.protocol == ONE_EDGE:
        lazy = next_unit(states, r) < matchings.probability
        active[0] = next_integer(states, r, count)
        return 0 if lazy else 1
    if matchings.protocol == NODE_WAKEUP:
        node = next_integer(states, r, len(matchings.busy))
        uniform = next_unit(states, r)
        peers = first[node + 1] - first[node]
        # An isolated node takes both numbers too: what follows in the stream does not depend on it.
        if peers == 0:
            return 0
        active[0] = members[first[node] + int(uniform * peers)]
        return 1
    if matchings.protocol == UNIFORM_MAXIMAL:
        matching = next_integer(states, r, len(first) - 1)
        for k in range(first[matching], first[matching + 1]):
            active[k - first[matching]] = members[k]
        return int(first[matching + 1] - first[matching])
    return _free_links(matchings, ends, r, active)


@kernel
def _free_links(matchings: Matchings, ends: np.ndarray, r: int, active: np.ndarray) -> int:
    """Draw a matching of links whose ends are free into ``active`` (A,)."""
    count, pairs, states = len(ends), 0, matchings.states
    order, busy = matchings.order, matchings.busy
    for h in range(len(busy)):
        busy[h] = 0
    if matchings.protocol == MAXIMAL:
        # A random order of links, taken greedily: a maximal matching.
        shuffle(states, r, order, count)
        for k in range(count):
            i, j = ends[order[k], 0], ends[order[k], 1]
            # Without a branch: its outcome is random, so the processor would mispredict it. If the
            # link is not free, the entry behind the last pair is written again with its own value.
            free = (busy[i] | busy[j]) ^ 1
            # A full matching has no entry behind it, hence the minimum.
            index = min(pairs, len(active) - 1)
            active[index] += free * (order[k] - active[index])
            busy[i], busy[j] = (busy[i] | free, busy[j] | free)
            pairs += free
        return pairs
    # INDEPENDENT: ``order`` is 1 for links that are drawn, ``busy`` counts those at each node.
    for k in range(count):
        order[k] = 1 if next_unit(states, r) < matchings.probability else 0
        busy[ends[k, 0]] += order[k]
        busy[ends[k, 1]] += order[k]
    # A link that meets no other is the only one at both of its ends.
    for k in range(count):
        if order[k] == 1 and busy[ends[k, 0]] == 1 and busy[ends[k, 1]] == 1:
            active[pairs] = k
            pairs += 1
    return pairs


@kernel
def draw_pairs(
    matchings: Matchings,
    ends: np.ndarray,
    exchanged: np.ndarray,
    active: np.ndarray,
    pair_count: np.ndarray,
) -> None:
    """Draw the matchings of R runs in the slots that are ``exchanged`` (S,): the indices of their
    links into ``active`` (R, S, E, A), and how many there are into ``pair_count`` (R, S, E).
    """
    for r in range(len(active)):
        for s in range(active.shape[1]):
            for e in range(active.shape[2] if exchanged[s] else 0):
                pair_count[r, s, e] = draw_matching(matchings, ends, r, active[r, s, e])


@kernel
def draw_messages(
    lanes: Lanes,
    links: SlotChannels,
    exchanged: np.ndarray,
    fresh: np.ndarray,
    messages: SlotMessages,
    runs: int,
) -> None:
    """Draw which messages arrive in the slots that are ``exchanged`` (S,), into ``messages``, given
    the pairs of matchings. Links draw losses anew in the steps that are ``fresh`` (E,).
    """
    up, matched = messages.up, len(messages.pair_count) > 0
    for b in range(up.shape[0]):
        for s in range(up.shape[1]):
            for e in range(up.shape[2] if exchanged[s] else 0):
                arrived, now = up[b, s, e], links.begin[s, e] if len(links.begin) > 0 else 0.0
                for r in range(b * len(lanes), min((b + 1) * len(lanes), runs)):
                    for a in range(messages.pair_count[r, s, e] if matched else len(links.ends)):
                        link = messages.active[r, s, e, a] if matched else a
                        draw_link(links, r, link, fresh[e], e, now, arrived, r - b * len(lanes))


@kernel
def draw_by_link(
    lanes: Lanes,
    links: SlotChannels,
    exchanged: np.ndarray,
    fresh: np.ndarray,
    up: np.ndarray,
    units: FloatArray,
    runs: int,
) -> None:
    """Draw as ``draw_messages``, in a half to a quarter of the time, link by link: all links send,
    with delivery probabilities that stay, and fresh draws in slots. ``units`` is scratch.
    """
    channels, steps = links.channels, up.shape[2]
    slots = len(units) // steps
    for first in range(0, up.shape[1], slots):
        stop, count = min(first + slots, up.shape[1]), 0
        for s in range(first, stop):
            for e in range(steps):
                count += exchanged[s] and fresh[e]
        for r in range(runs):
            b, q, last = r // len(lanes), r % len(lanes), -1
            for w in range(len(channels.source)):
                k = r * channels.per_run + channels.source[w]
                # Directions that share a stream are neighbours, and share its draws.
                if k != last:
                    for j in range(count):
                        units[j] = next_unit(channels.loss, k)
                last, i, delivery = k, -1, channels.delivery[0, w]
                for s in range(first, stop):
                    for e in range(steps if exchanged[s] else 0):
                        i += fresh[e]
                        if links.talks[e, w] == 1:
                            up[b, s, e, w, q] = units[i] < delivery


@kernel
def draw_link(
    links: SlotChannels, r: int, link: int, fresh: bool, e: int, t: float, up: np.ndarray, q: int
) -> None:
    """Draw which messages of one activation of ``link`` arrive in step ``e`` of run ``r``, which
    begins at ``t`` seconds, into lane ``q`` of ``up`` (W, L). Others than ``fresh`` ones stay.
    """
    channels, uniform, last = links.channels, links.uniform, -1
    for w in range(link * links.per_link, (link + 1) * links.per_link):
        k = r * channels.per_run + channels.source[w]
        # With one stream for a link both directions use its draw; below 0: not drawn yet.
        if k != last and len(channels.loss) > 0 and (fresh or uniform[k] < 0.0):
            uniform[k] = next_unit(channels.loss, k)
            # The channel state (Gilbert-Elliott) takes one step for each activation.
            if len(channels.state) > 0:
                next_link_state(channels, k)
        last = k
        if links.talks[e, w] == 1:
            up[w, q] = uniform[k] < delivery_probability_of(
                channels, r, w, max(channels.bad[k], 0), t
            )


@kernel
def draw_uniforms(
    lanes: Lanes, states: np.ndarray, sent: np.ndarray, uniform: FloatArray, runs: int
) -> None:
    """Draw a uniform number for each node that is asked for a message, where ``sent`` is 1: into
    ``uniform``, both (B, S, E, N, L), in the order of steps, from ``states`` (R N, WIDTH).
    """
    for r in range(runs):
        b, q = r // len(lanes), r % len(lanes)
        for s in range(sent.shape[1]):
            for e in range(sent.shape[2]):
                for h in range(sent.shape[3]):
                    if sent[b, s, e, h, q] == 1:
                        uniform[b, s, e, h, q] = next_unit(states, r * sent.shape[3] + h)


class Stages(NamedTuple):
    """The K stages of a slot in order: readings, and steps of exchanges.

    step : (K,), number of the exchange step in the slot, -1 where sensors are read
    phase : (K,), number of the exchange that the step belongs to, -1 where sensors are read
    end : (K,), seconds after the slot begins
    stopping : step in which nodes may permanently freeze their network estimate, -1: none
    per_second : ticks of the time grid in a second (core.instants)
    """

    step: np.ndarray
    phase: np.ndarray
    end: FloatArray
    stopping: int
    per_second: float


class SlotTimes(NamedTuple):
    """When S slots begin and what happens in them.

    first, start : number of the first slot, and the times (S,) in seconds at which slots begin
    recorded, sensed, exchanged : (S,), whether events are recorded, sensors are read and nodes
                                  exchange
    sample : (S,), index of the slot's sample among those of the block or run, -1: none
    predicts : whether filters predict, so that they are sampled at the beginning of a slot
    """

    first: int
    start: FloatArray
    recorded: np.ndarray
    sensed: np.ndarray
    exchanged: np.ndarray
    sample: np.ndarray
    predicts: bool


class SlotLinks(NamedTuple):
    """W directed links by receiver: those to filter h are ``first[h]`` to ``first[h + 1]`` - 1.

    first : (H + 1,)
    sender : index (W,) of the sending filter
    direction : index (W,) in the axis W of ``up``
    weight : (W,) that the receiver gives to the sender
    """

    first: np.ndarray
    sender: np.ndarray
    direction: np.ndarray
    weight: FloatArray


class TracedNodes(NamedTuple):
    """Nodes and incoming links, for the kernels that write or count events.

    nodes, sensing : ids of all nodes (N,) and of those with sensors
    links : directed links by receiver
    sent : number of messages so far (W,)
    stopped : slot in which each node stopped (B, N, L)
    """

    nodes: np.ndarray
    sensing: np.ndarray
    links: SlotLinks
    sent: np.ndarray
    stopped: np.ndarray


class EventRows(NamedTuple):
    """Columns (K,) of a run's events (trace.schema); ``before_sample`` (T,): rows before each."""

    t: FloatArray
    kind: np.ndarray
    node: np.ndarray
    peer: np.ndarray
    message: np.ndarray
    phase: np.ndarray
    age: FloatArray
    before_sample: np.ndarray


class SlotMessages(NamedTuple):
    """Messages of S slots with E steps each, in R runs side by side in B blocks of L lanes.

    up : (B, S, E, W, L), 1 where a message arrives on directed link w
    active, pair_count : indices of the paired links (R, S, E, A) and their number (R, S, E); empty
                         for broadcasts
    sent : (B, S, E, N, L), 1 where a node sends; empty where every node sends that is asked
    """

    up: np.ndarray
    active: np.ndarray
    pair_count: np.ndarray
    sent: np.ndarray


class Tracing(NamedTuple):
    """What the rows of the first run are made of, and where they go. ``pairwise``: nodes swap with
    a peer, instead of absorbing broadcasts.
    """

    stages: Stages
    times: SlotTimes
    links: SlotChannels
    nodes: TracedNodes
    messages: SlotMessages
    rows: EventRows
    pairwise: bool


class SlotStage(NamedTuple):
    """One stage of one slot, in which events happen.

    slot, s : number of the slot, and its index among the S slots
    step, phase : as in Stages
    t : time of its events, seconds
    """

    slot: int
    s: int
    step: int
    phase: int
    t: float


@kernel
def write_row(
    rows: EventRows, stage: SlotStage, kind: int, node: int, peer: int, message: int, age: float,
    row: int,
) -> int:  # fmt: skip
    """Write one event of a ``stage`` into row number ``row``; return the number of the next row.
    ``node`` and ``peer`` are ids, ``message`` a number on its link (-1: none).
    """
    rows.t[row], rows.kind[row], rows.node[row], rows.peer[row] = stage.t, kind, node, peer
    rows.message[row], rows.phase[row], rows.age[row] = message, stage.phase, age
    return row + 1


@kernel
def make_rows(trace: Tracing, first: int, stop: int) -> int:
    """Write the events of the first run in the slots with indices ``first`` to ``stop`` - 1, in the
    order of time; return their number. Messages are numbered on, from ``trace.nodes.sent``.
    """
    row, times = 0, trace.times
    for s in range(first, stop):
        # Filters that predict are sampled before anything happens in the slot.
        if times.predicts and times.sample[s] >= 0:
            trace.rows.before_sample[times.sample[s]] = row
        # At the horizon nothing is recorded but the sample.
        if times.recorded[s]:
            row = _slot_rows(trace, s, row)
        if not times.predicts and times.sample[s] >= 0:
            trace.rows.before_sample[times.sample[s]] = row
    return row


@kernel
def _slot_rows(trace: Tracing, s: int, row: int) -> int:
    stages, times = trace.stages, trace.times
    now = times.start[s]
    for k in range(len(stages.step)):
        stage = SlotStage(times.first + s, s, stages.step[k], stages.phase[k], now)
        # Step -1: sensors are read. The row of a "sense" has no peer, message or age.
        if stage.step < 0:
            if times.sensed[s]:
                for node in trace.nodes.sensing:
                    row = write_row(trace.rows, stage, SENSE, node, -1, -1, NAN, row)
        elif times.exchanged[s]:
            row = _write_sends(trace, stage, row)
            # Absorptions happen at the end of the step, when its inboxes close.
            now = snapped(times.start[s] + stages.end[k], stages.per_second)
            closing = SlotStage(stage.slot, s, stage.step, stage.phase, now)
            row = _write_step_end(trace, closing, row)
    return row


@kernel
def _write_sends(trace: Tracing, stage: SlotStage, row: int) -> int:
    messages, ends, nodes = trace.messages, trace.links.ends, trace.nodes.nodes
    # A "round" has no node, peer, message or age.
    if not trace.pairwise:
        row = write_row(trace.rows, stage, ROUND, -1, -1, -1, NAN, row)
    links = messages.pair_count[0, stage.s, stage.step] if trace.pairwise else len(ends)
    for a in range(links):
        link = messages.active[0, stage.s, stage.step, a] if trace.pairwise else a
        if trace.pairwise:
            i, j = nodes[ends[link, 0]], nodes[ends[link, 1]]
            row = write_row(trace.rows, stage, TICK, i, j, -1, NAN, row)
        row = _link_rows(trace, stage, link, row)
    return row


@kernel
def _link_rows(trace: Tracing, stage: SlotStage, link: int, row: int) -> int:
    links, messages, nodes, rows = trace.links, trace.messages, trace.nodes, trace.rows
    for end in range(links.per_link):
        w, i, j = link * links.per_link + end, links.ends[link, end], links.ends[link, 1 - end]
        if not is_sent(links, messages, 0, stage.s, stage.step, w, i):
            continue
        # Messages of a direction are numbered from 0, lost ones included.
        number, sender, receiver = nodes.sent[w], nodes.nodes[i], nodes.nodes[j]
        nodes.sent[w] = number + 1
        row = write_row(rows, stage, SEND, sender, receiver, number, NAN, row)
        if messages.up[0, stage.s, stage.step, w, 0] == 1:
            row = write_row(rows, stage, DELIVER, receiver, sender, number, 0.0, row)
        else:
            row = write_row(rows, stage, LOST, sender, receiver, number, NAN, row)
    return row


@kernel
def is_sent(
    links: SlotChannels, messages: SlotMessages, r: int, s: int, e: int, w: int, sender: int
) -> bool:
    """Return True if an active direction ``w`` carries a message of ``sender`` (index), which may
    have nothing to send, or decide to send nothing.
    """
    sent = messages.sent
    lanes = messages.up.shape[4]
    decided = len(sent) > 0 and sent[r // lanes, s, e, sender, r % lanes] == 0
    return bool(links.talks[e, w] == 1 and not decided)


@kernel
def _write_step_end(trace: Tracing, stage: SlotStage, row: int) -> int:
    """Write who absorbs, swaps or stops; return the number of the next row."""
    nodes, rows, up = trace.nodes, trace.rows, trace.messages.up[0, stage.s, stage.step]
    for i in range(len(nodes.nodes)):
        node, has_received = nodes.nodes[i], False
        for k in range(nodes.links.first[i], nodes.links.first[i + 1]):
            w = nodes.links.direction[k]
            if up[w, 0] == 1:
                has_received = True
                if trace.pairwise:
                    # The message of this step is the last one that was numbered.
                    peer, number = nodes.nodes[nodes.links.sender[k]], nodes.sent[w] - 1
                    row = write_row(rows, stage, SWAP, node, peer, number, 0.0, row)
        if has_received and not trace.pairwise:
            row = write_row(rows, stage, ABSORB, node, -1, -1, 0.0, row)
        # A node that stops in this slot does so after it absorbed.
        if stage.step == trace.stages.stopping and nodes.stopped[0, i, 0] == stage.slot:
            row = write_row(rows, stage, STOP, node, -1, -1, NAN, row)
    return row


@kernel
def count_sends(
    links: SlotChannels, messages: SlotMessages, counted: np.ndarray, sends: np.ndarray
) -> None:
    """Add the messages that each run sends in the slots that are ``counted`` to ``sends`` (R,)."""
    paired = len(messages.pair_count) > 0
    for r in range(len(sends)):
        for s in range(len(counted)):
            for e in range(messages.up.shape[2] if counted[s] else 0):
                for a in range(messages.pair_count[r, s, e] if paired else len(links.ends)):
                    link = messages.active[r, s, e, a] if paired else a
                    for end in range(links.per_link):
                        w, sender = link * links.per_link + end, links.ends[link, end]
                        sends[r] += is_sent(links, messages, r, s, e, w, sender)


@kernel
def mark_senders(
    links: SlotChannels, messages: SlotMessages, exchanged: np.ndarray, runs: int, says: np.ndarray
) -> None:
    """Set ``says`` (B, S, E, N, L) to 1 for nodes with links in ``exchanged`` (S,) slots."""
    paired, lanes = len(messages.pair_count) > 0, says.shape[4]
    for r in range(runs):
        for s in range(len(exchanged)):
            for e in range(says.shape[2] if exchanged[s] else 0):
                for a in range(messages.pair_count[r, s, e] if paired else len(links.ends)):
                    link = messages.active[r, s, e, a] if paired else a
                    for end in range(links.per_link):
                        if links.talks[e, link * links.per_link + end] == 1:
                            says[r // lanes, s, e, links.ends[link, end], r % lanes] = 1


@kernel
def count_arrivals(
    lanes: Lanes, links: SlotLinks, up: np.ndarray, counted: np.ndarray, counts: FloatArray
) -> None:
    """Write the numbers of messages that arrive in the slots that are ``counted`` (S,), and of
    nodes that receive any in a step, into ``counts`` (B, 2, L).
    """
    for b in range(up.shape[0]):
        arrived = receiving = spread(lanes, 0.0)
        for s in range(up.shape[1]):
            for e in range(up.shape[2] if counted[s] else 0):
                for i in range(len(links.first) - 1):
                    received = spread(lanes, 0.0)
                    for k in range(links.first[i], links.first[i + 1]):
                        flags = load_flags(lanes, up, b, s, e, links.direction[k])
                        received += select(flags, 1.0, 0.0)
                    arrived += received
                    receiving += select(received > 0.0, 1.0, 0.0)
        store(lanes, counts, b, 0, arrived)
        store(lanes, counts, b, 1, receiving)
