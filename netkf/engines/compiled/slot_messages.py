"""Messages in slots, compiled: draw the matchings and losses, write or count their events.

Every link draws from streams of its own, so that messages of many slots and runs are drawn before
any estimate is computed. Dimensions: B blocks of L runs side by side (``linalg.lanes``; R <= B L
runs), S slots, E steps of a slot's exchanges, W directed links, N nodes. Their indices are b, q
(lane), r, s, e, w. ``up`` (B, S, E, W, L) is 1 where a message arrives.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from netkf.core.instants import snapped
from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    Lanes,
    load,
    load_flags,
    select,
    spread,
    store,
    store_flags,
)
from netkf.network.matchings import PROTOCOLS
from netkf.rng.draws import next_unit
from netkf.rng.numbers import next_integer, shuffle
from netkf.trace.schema import CODES

ONE_EDGE, NODE_WAKEUP, MAXIMAL, UNIFORM_MAXIMAL, INDEPENDENT = range(len(PROTOCOLS))
SENSE, TICK, SEND, DELIVER, LOST, ABSORB, SWAP, ROUND, STOP = (
    CODES[kind]
    for kind in ("sense", "tick", "send", "deliver", "lost", "absorb", "swap", "round", "stop")
)
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


class Channels(NamedTuple):
    """Loss model of all links, its random streams, and the last numbers drawn from them.

    K = links x ``streams_per_link``: a symmetric channel has one stream for both directions.

    ends : (links, 2), indices of nodes; direction 2 l goes from the first to the second
    delivery : (2, W), delivery probabilities in the good and the bad state of the link
    loss_streams, state_streams : (B, K, L, WIDTH), random streams of losses and of the chain of
                                  channel states; empty where nothing is drawn
    loss_uniform, state_uniform : (B, K, L), the last uniform numbers drawn from them, -1 at first
    bad : (B, K, L), state of the channel (1: bad), -1 at first
    to_bad, to_good : transition probabilities of the chain
    talks : (E, W), 1 if the sender of a direction has something to send in a step
    directions_per_link, streams_per_link : 1 or 2
    """

    ends: np.ndarray
    delivery: FloatArray
    loss_streams: np.ndarray
    state_streams: np.ndarray
    loss_uniform: FloatArray
    state_uniform: FloatArray
    bad: np.ndarray
    to_bad: float
    to_good: float
    talks: np.ndarray
    directions_per_link: int
    streams_per_link: int


@kernel
def draw_matching(matchings: Matchings, ends: np.ndarray, r: int, active: np.ndarray) -> int:
    """Draw one matching of run ``r``, the set of links that exchange in a step, no two at one node:
    write the indices of its links into ``active`` (A,), which has space for the largest one, in
    their order; return how many. ``ends`` (links, 2) are the indices of the nodes at both ends of
    each link.

    The numbers are those that ``Matching.draw`` takes from the same stream, which advances, so
    that both engines simulate the same run.
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
    """Draw a matching that keeps links whose ends are free into ``active`` (A,)."""
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
            busy[i], busy[j] = (
                busy[i] | free,
                busy[j] | free,
            )
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
def draw_link(
    lanes: Lanes, channels: Channels, b: int, link: int, fresh: bool, up: np.ndarray, s: int, e: int
) -> None:
    """Draw which messages of one activation of ``link`` (index) arrive, in step ``e`` of slot ``s``
    (index in the block of slots), in all L runs of block ``b`` at once, one in each lane; write 1
    or 0 into ``up`` (B, S, E, W, L) for its one or two directed links. A link is ``fresh`` in a
    step that draws losses anew; otherwise it keeps its last draws, which ``channels`` stores.
    Dimensions: B blocks of L runs, S slots of E exchange steps, W directed links. ``lanes`` is a
    tuple of length L.
    """
    uniforms = channels.loss_uniform
    for d in range(channels.directions_per_link):
        # With one stream per link (symmetric) both directions use it.
        k = link * channels.streams_per_link + min(d, channels.streams_per_link - 1)
        # A held link keeps its uniform number; -1 marks a link that has none yet.
        if (
            d < channels.streams_per_link
            and len(channels.loss_streams) > 0
            and (fresh or uniforms[b, k, 0] < 0.0)
        ):
            next_units(lanes, channels.loss_streams[b, k], uniforms[b, k])
            # The channel state (Gilbert-Elliott) takes one step for each activation.
            if len(channels.state_streams) > 0:
                next_units(lanes, channels.state_streams[b, k], channels.state_uniform[b, k])
                for q in range(len(lanes)):
                    channels.bad[b, k, q] = next_state(
                        channels.bad[b, k, q],
                        channels.state_uniform[b, k, q],
                        channels.to_bad,
                        channels.to_good,
                    )
        w = link * channels.directions_per_link + d
        if channels.talks[e, w] == 1:
            uniform = load(lanes, uniforms, b, k)
            # Without channel states one comparison decides for all lanes.
            if len(channels.state_streams) == 0:
                store_flags(lanes, up, b, s, e, w, uniform < channels.delivery[0, w])
                continue
            for q in range(len(lanes)):
                probability = (
                    channels.delivery[1, w]
                    if channels.bad[b, k, q] == 1
                    else channels.delivery[0, w]
                )
                up[b, s, e, w, q] = uniforms[b, k, q] < probability


@kernel
def next_units(lanes: Lanes, states: np.ndarray, units: FloatArray) -> None:
    """Write the next uniform number of each of the streams ``states`` (L, WIDTH) into ``units``
    (L,). ``lanes`` is a tuple of length L.
    """
    for q in range(len(lanes)):
        units[q] = next_unit(states, q)


@kernel
def draw_link_of_lane(
    channels: Channels, b: int, link: int, fresh: bool, up: np.ndarray, s: int, e: int, q: int
) -> None:
    """Draw which messages of one activation of ``link`` (index) arrive, in step ``e`` of slot
    ``s``, in the run of lane ``q`` of block ``b`` alone: matchings pair other links in each run.
    Write 1 or 0 into ``up`` (B, S, E, W, L) for its one or two directed links. A link is ``fresh``
    in a step that draws losses anew; otherwise it keeps its last draws, which ``channels`` stores.
    Dimensions: B blocks of L runs, S slots of E exchange steps, W directed links.
    """
    for d in range(channels.directions_per_link):
        # With one stream per link both directions use its draw; a uniform below 0 is not drawn yet.
        k = link * channels.streams_per_link + min(d, channels.streams_per_link - 1)
        if (
            d < channels.streams_per_link
            and len(channels.loss_streams) > 0
            and (fresh or channels.loss_uniform[b, k, q] < 0.0)
        ):
            channels.loss_uniform[b, k, q] = next_unit(channels.loss_streams[b, k], q)
            if len(channels.state_streams) > 0:
                u = next_unit(channels.state_streams[b, k], q)
                channels.bad[b, k, q] = next_state(
                    channels.bad[b, k, q], u, channels.to_bad, channels.to_good
                )
        w = link * channels.directions_per_link + d
        if channels.talks[e, w] == 1:
            # A channel without states keeps bad = -1.
            probability = (
                channels.delivery[1, w] if channels.bad[b, k, q] == 1 else channels.delivery[0, w]
            )
            up[b, s, e, w, q] = channels.loss_uniform[b, k, q] < probability


@kernel
def next_state(bad: int, u: float, to_bad: float, to_good: float) -> int:
    """Return the next state (1: bad, 0: good) of the two-state Markov channel (Gilbert-Elliott) of
    one link, decided by the uniform number ``u``: a good state turns bad with probability
    ``to_bad``, a bad one good with ``to_good``. The first state, after ``bad`` = -1, has the
    stationary law.
    """
    if bad < 0:
        return 1 if u < to_bad / (to_bad + to_good) else 0
    if bad == 1:
        return 1 if u >= to_good else 0
    return 1 if u < to_bad else 0


@kernel
def draw_broadcasts(
    lanes: Lanes, channels: Channels, exchanged: np.ndarray, fresh: np.ndarray, up: np.ndarray
) -> None:
    """Draw which messages arrive when all nodes broadcast, so that every link is used in every
    step: write 1 into ``up`` (B, S, E, W, L), which holds zeros before. Slots without an exchange,
    where ``exchanged`` (S,) is False, stay 0; links draw losses anew in the steps that are
    ``fresh`` (E,) and keep them in the others. Dimensions: B blocks of L runs, S slots of E
    exchange steps, W directed links. ``lanes`` is a tuple of length L.
    """
    for b in range(up.shape[0]):
        for s in range(up.shape[1]):
            for e in range(up.shape[2] if exchanged[s] else 0):
                for link in range(len(channels.ends)):
                    draw_link(lanes, channels, b, link, fresh[e], up, s, e)


@kernel
def draw_matched(
    lanes: Lanes,
    channels: Channels,
    matchings: Matchings,
    exchanged: np.ndarray,
    fresh: np.ndarray,
    up: np.ndarray,
    active: np.ndarray,
    pair_count: np.ndarray,
) -> None:
    """Draw the matchings of all runs, the pairs of nodes that exchange in each step, and which
    messages on their links arrive: write 1 into ``up`` (B, S, E, W, L), which holds zeros before.
    ``active`` (R, S, E, A) gets the indices of the paired links in order, ``pair_count`` (R, S, E)
    their number. Slots without an exchange, where ``exchanged`` (S,) is False, stay 0; links draw
    losses anew in the steps that are ``fresh`` (E,). Dimensions: B blocks of L runs, R runs in all,
    S slots of E exchange steps, W directed links, at most A pairs. ``lanes`` is a tuple of length
    L.
    """
    for b in range(up.shape[0]):
        for s in range(up.shape[1]):
            for e in range(up.shape[2] if exchanged[s] else 0):
                draw_pairs(lanes, channels, matchings, fresh[e], up, active, pair_count, b, s, e)


@kernel
def draw_pairs(
    lanes: Lanes,
    channels: Channels,
    matchings: Matchings,
    fresh: bool,
    up: np.ndarray,
    active: np.ndarray,
    pair_count: np.ndarray,
    b: int,
    s: int,
    e: int,
) -> None:
    """Draw the matchings (which pairs of nodes exchange) of step ``e`` of slot ``s`` in all L runs
    of block ``b``, and which messages on their links arrive: write these into ``up`` (B, S, E, W,
    L), the paired links into ``active`` (R, S, E, A), and their number into ``pair_count`` (R, S,
    E). ``fresh``: links draw losses anew. Dimensions: B blocks of L runs, R runs in all, S slots of
    E exchange steps, W directed links, at most A pairs. ``lanes`` is a tuple of length L.
    """
    first = b * len(lanes)
    # Run by run: the pairs are different in each. The last block may have fewer runs than lanes.
    for q in range(min(len(lanes), len(pair_count) - first)):
        r = first + q
        pairs = draw_matching(matchings, channels.ends, r, active[r, s, e])
        pair_count[r, s, e] = pairs
        for k in range(pairs):
            draw_link_of_lane(channels, b, active[r, s, e, k], fresh, up, s, e, q)


@kernel
def mark_all_senders(
    lanes: Lanes, channels: Channels, exchanged: np.ndarray, sent: np.ndarray
) -> None:
    """Mark the nodes that broadcasts ask for a message, all nodes with links, in each of the E
    steps of the S slots that are ``exchanged`` (S,): write 1 into ``sent`` (B, S, E, N, L), for N
    nodes in B blocks of L runs. The filters then decide which of them send. ``lanes`` is a tuple of
    length L.
    """
    for b in range(sent.shape[0]):
        for s in range(sent.shape[1]):
            for e in range(sent.shape[2] if exchanged[s] else 0):
                for link in range(len(channels.ends)):
                    for end in range(2):
                        for q in range(len(lanes)):
                            sent[b, s, e, channels.ends[link, end], q] = 1


@kernel
def mark_paired_senders(
    lanes: Lanes, channels: Channels, active: np.ndarray, pair_count: np.ndarray, sent: np.ndarray
) -> None:
    """Mark the nodes that matchings ask for a message, both ends of all paired links: write 1 into
    ``sent`` (B, S, E, N, L). The filters then decide which of them send.

    Dimensions are B blocks of L runs, S slots of E exchange steps, N nodes, at most A pairs.
    ``pair_count`` (R, S, E) is the number of pairs of each of the R <= B L runs, and the first so
    many entries of ``active`` (R, S, E, A) are the indices of their links. ``lanes`` is a tuple of
    length L.
    """
    for r in range(pair_count.shape[0]):
        for s in range(pair_count.shape[1]):
            for e in range(pair_count.shape[2]):
                for a in range(pair_count[r, s, e]):
                    for end in range(2):
                        node = channels.ends[active[r, s, e, a], end]
                        sent[r // len(lanes), s, e, node, r % len(lanes)] = 1


@kernel
def draw_uniforms(states: np.ndarray, sent: np.ndarray, uniform: FloatArray) -> None:
    """Draw a uniform number for each node that is asked for a message (``sent`` is 1), by which
    filters that send at random decide whether to: into ``uniform`` (B, S, E, N, L), in the order of
    steps, from the streams ``states`` (B, N, L, WIDTH), one for each node and run. Dimensions: B
    blocks of L runs, S slots of E exchange steps, N nodes.
    """
    for b in range(sent.shape[0]):
        for s in range(sent.shape[1]):
            for e in range(sent.shape[2]):
                for h in range(sent.shape[3]):
                    for q in range(sent.shape[4]):
                        if sent[b, s, e, h, q] == 1:
                            uniform[b, s, e, h, q] = next_unit(states[b, h], q)


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


class TracedNodes(NamedTuple):
    """Nodes and incoming links, for the kernels that write or count events.

    nodes, sensing : ids of all nodes (N,) and of those with sensors
    first, sender, direction : (N + 1,), (W,) and (W,), directed links by receiver: node h receives
                               from the nodes ``sender[k]`` (index) on the directed links
                               ``direction[k]``, with k from ``first[h]`` to ``first[h + 1]`` - 1
    sent : number of messages so far (W,)
    stopped : slot in which each node stopped (B, N, L)
    """

    nodes: np.ndarray
    sensing: np.ndarray
    first: np.ndarray
    sender: np.ndarray
    direction: np.ndarray
    sent: np.ndarray
    stopped: np.ndarray


class Rows(NamedTuple):
    """Columns (K,) of the event table of one run (trace.schema), and the number of rows before each
    of T samples, ``before_sample`` (T,).
    """

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
    rows: Rows,
    stage: SlotStage,
    kind: int,
    node: int,
    peer: int,
    message: int,
    age: float,
    row: int,
) -> int:
    """Write one event into row number ``row`` of the event table ``rows`` of a run; return the
    number of the next row. ``kind`` is an index in trace.schema.KINDS; the time and phase are those
    of ``stage``, the part of a slot in which it happens; ``node`` and ``peer`` are ids of nodes,
    ``message`` a number on its link (-1: none), ``age`` its seconds under way.
    """
    rows.t[row], rows.kind[row], rows.node[row], rows.peer[row] = stage.t, kind, node, peer
    rows.message[row], rows.phase[row], rows.age[row] = message, stage.phase, age
    return row + 1


@kernel
def make_rows(
    stages: Stages,
    times: SlotTimes,
    channels: Channels,
    traced: TracedNodes,
    messages: SlotMessages,
    pairwise: bool,
    first: int,
    stop: int,
    rows: Rows,
) -> int:
    """Write the events of the first run in the slots with indices ``first`` to ``stop`` - 1 into
    the event table ``rows``, in the order of time; return their number. A slot has ``stages``: a
    reading of sensors and steps of exchanges. Messages are numbered on, by link, from
    ``traced.sent``, which is advanced. ``pairwise``: nodes swap with a peer, instead of absorbing
    broadcasts.
    """
    row = 0
    for s in range(first, stop):
        # Filters that predict are sampled before anything happens in the slot.
        if times.predicts:
            mark_sample(times, s, rows, row)
        # At the horizon nothing is recorded but the sample.
        if times.recorded[s]:
            row = _slot_rows(stages, times, channels, traced, messages, pairwise, rows, s, row)
        if not times.predicts:
            mark_sample(times, s, rows, row)
    return row


@kernel
def mark_sample(times: SlotTimes, s: int, rows: Rows, row: int) -> None:
    """Store ``row``, the number of event rows before the sample of slot ``s`` (index), in
    ``rows.before_sample``, if the slot has a sample: a run that diverges ends with these rows.
    """
    k = times.sample[s]
    if k >= 0:
        rows.before_sample[k] = row


@kernel
def _slot_rows(
    stages: Stages,
    times: SlotTimes,
    channels: Channels,
    traced: TracedNodes,
    messages: SlotMessages,
    pairwise: bool,
    rows: Rows,
    s: int,
    row: int,
) -> int:
    """Write the events of the first run in slot ``s``; return the number of the next row."""
    now = times.start[s]
    for k in range(len(stages.step)):
        stage = SlotStage(times.first + s, s, stages.step[k], stages.phase[k], now)
        # Step -1: sensors are read. The row of a "sense" has no peer, message or age.
        if stage.step < 0:
            if times.sensed[s]:
                for node in traced.sensing:
                    row = write_row(rows, stage, SENSE, node, -1, -1, NAN, row)
        elif times.exchanged[s]:
            row = _write_sends(channels, traced, messages, rows, stage, pairwise, row)
            # Absorptions happen at the end of the step, when its inboxes close.
            now = snapped(times.start[s] + stages.end[k], stages.per_second)
            closing = SlotStage(stage.slot, s, stage.step, stage.phase, now)
            row = _write_step_end(traced, messages, rows, closing, pairwise, stages.stopping, row)
    return row


@kernel
def _write_sends(
    channels: Channels,
    traced: TracedNodes,
    messages: SlotMessages,
    rows: Rows,
    stage: SlotStage,
    pairwise: bool,
    row: int,
) -> int:
    """Write what the first run sends in a step; return the number of the next row."""
    # A "round" has no node, peer, message or age.
    if not pairwise:
        row = write_row(rows, stage, ROUND, -1, -1, -1, NAN, row)
    links = messages.pair_count[0, stage.s, stage.step] if pairwise else len(channels.ends)
    for a in range(links):
        link = messages.active[0, stage.s, stage.step, a] if pairwise else a
        if pairwise:
            i, j = traced.nodes[channels.ends[link, 0]], traced.nodes[channels.ends[link, 1]]
            row = write_row(rows, stage, TICK, i, j, -1, NAN, row)
        row = _link_rows(channels, traced, messages, rows, stage, link, row)
    return row


@kernel
def _link_rows(
    channels: Channels,
    traced: TracedNodes,
    messages: SlotMessages,
    rows: Rows,
    stage: SlotStage,
    link: int,
    row: int,
) -> int:
    """Write what the first run sends on ``link``; return the number of the next row."""
    for end in range(channels.directions_per_link):
        w, i = link * channels.directions_per_link + end, channels.ends[link, end]
        if channels.talks[stage.step, w] == 0 or is_silent(messages, 0, stage, i, 0):
            continue
        # Messages of a direction are numbered from 0, lost ones included.
        number, sender, receiver = (
            traced.sent[w],
            traced.nodes[i],
            traced.nodes[channels.ends[link, 1 - end]],
        )
        traced.sent[w] = number + 1
        row = write_row(rows, stage, SEND, sender, receiver, number, NAN, row)
        if messages.up[0, stage.s, stage.step, w, 0] == 1:
            row = write_row(rows, stage, DELIVER, receiver, sender, number, 0.0, row)
        else:
            row = write_row(rows, stage, LOST, sender, receiver, number, NAN, row)
    return row


@kernel
def is_silent(messages: SlotMessages, b: int, stage: SlotStage, node: int, q: int) -> bool:
    """Return True if the filter of ``node`` (an index) decided to send nothing in the exchange step
    of ``stage``, in lane ``q`` (run) of block ``b``. ``messages.sent`` is empty for filters that
    always send.
    """
    return len(messages.sent) > 0 and messages.sent[b, stage.s, stage.step, node, q] == 0


@kernel
def _write_step_end(
    traced: TracedNodes,
    messages: SlotMessages,
    rows: Rows,
    stage: SlotStage,
    pairwise: bool,
    stopping: int,
    row: int,
) -> int:
    """Write who absorbs, swaps or stops; return the number of the next row."""
    for i in range(len(traced.nodes)):
        has_received = False
        for k in range(traced.first[i], traced.first[i + 1]):
            if messages.up[0, stage.s, stage.step, traced.direction[k], 0] == 1:
                has_received = True
                if pairwise:
                    # The message of this step is the last one that was numbered.
                    peer, number = (
                        traced.nodes[traced.sender[k]],
                        traced.sent[traced.direction[k]] - 1,
                    )
                    row = write_row(rows, stage, SWAP, traced.nodes[i], peer, number, 0.0, row)
        if has_received and not pairwise:
            row = write_row(rows, stage, ABSORB, traced.nodes[i], -1, -1, 0.0, row)
        # A node that stops in this slot does so after it absorbed.
        if stage.step == stopping and traced.stopped[0, i, 0] == stage.slot:
            row = write_row(rows, stage, STOP, traced.nodes[i], -1, -1, NAN, row)
    return row


@kernel
def count_events(
    lanes: Lanes,
    stages: Stages,
    times: SlotTimes,
    channels: Channels,
    traced: TracedNodes,
    messages: SlotMessages,
    pairwise: bool,
    scratch: FloatArray,
    counts: np.ndarray,
) -> None:
    """Add to ``counts`` (R, KINDS) the number of events of each kind in S slots of each of R runs,
    for runs of a batch whose events are not stored: as many as ``make_rows`` would write.
    ``scratch`` (KINDS, L) is for the L runs of a block. ``pairwise``: nodes swap with a peer,
    instead of absorbing broadcasts. ``lanes`` is a tuple of length L.
    """
    for b in range(messages.up.shape[0]):
        for kind in range(len(scratch)):
            store(lanes, scratch, kind, 0.0)
        for s in range(len(times.start)):
            for k in range(len(stages.step) if times.recorded[s] else 0):
                e = stages.step[k]
                if e < 0 and times.sensed[s]:
                    add_count(lanes, scratch, SENSE, 1.0 * len(traced.sensing))
                elif e >= 0 and times.exchanged[s]:
                    stage = SlotStage(times.first + s, s, e, stages.phase[k], 0.0)
                    # The time of the stage, 0.0 here, is not used for counts.
                    count_step(
                        lanes,
                        channels,
                        traced,
                        messages,
                        stage,
                        pairwise,
                        stages.stopping,
                        scratch,
                        counts,
                        b,
                    )
        first = b * len(lanes)
        for q in range(min(len(lanes), len(counts) - first)):
            for kind in range(len(scratch)):
                counts[first + q, kind] += int(scratch[kind, q])


@kernel(inlined=True)
def add_count(lanes: Lanes, scratch: FloatArray, kind: int, number: Any) -> None:
    """Add ``number``, (L,) lanes or one number for all, to the count ``scratch[kind]`` of
    ``scratch`` (KINDS, L). ``lanes`` is a tuple of length L.
    """
    store(lanes, scratch, kind, load(lanes, scratch, kind) + number)


@kernel
def count_step(
    lanes: Lanes,
    channels: Channels,
    traced: TracedNodes,
    messages: SlotMessages,
    stage: SlotStage,
    pairwise: bool,
    stopping: int,
    scratch: FloatArray,
    counts: np.ndarray,
    b: int,
) -> None:
    """Add the events of an exchange step (``stage``) in the L runs of block ``b`` to ``scratch``
    (KINDS, L), lane by lane; but those of nodes that stop, in step number ``stopping``, to
    ``counts`` (R, KINDS) of all R runs. ``pairwise``: nodes swap with a peer,
    instead of absorbing broadcasts. ``lanes`` is a tuple of length L.
    """
    stops = stage.step == stopping
    if pairwise:
        count_matched_pairs(lanes, channels, messages, stage, scratch, counts, b)
    else:
        add_count(lanes, scratch, ROUND, 1.0)
        sent = 0
        for w in range(messages.up.shape[3]):
            sent += channels.talks[stage.step, w]
        add_count(lanes, scratch, SEND, 1.0 * sent)
        add_count(lanes, scratch, LOST, 1.0 * sent)
        if len(messages.sent) > 0:
            count_silent(lanes, channels, messages, stage, scratch, b)
    # LOST was counted as if all were lost: each delivery takes one off.
    absorbed = delivered = spread(lanes, 0.0)
    for i in range(len(traced.nodes)):
        received = spread(lanes, 0.0)
        for k in range(traced.first[i], traced.first[i + 1]):
            up = load_flags(lanes, messages.up, b, stage.s, stage.step, traced.direction[k])
            received += select(up, 1.0, 0.0)
        delivered += received
        absorbed += select(received > 0.0, 1.0, 0.0)
    add_count(lanes, scratch, DELIVER, delivered)
    add_count(lanes, scratch, LOST, -delivered)
    add_count(lanes, scratch, SWAP if pairwise else ABSORB, delivered if pairwise else absorbed)
    if stops:
        count_stops(lanes, traced, stage, counts, b)


@kernel
def count_matched_pairs(
    lanes: Lanes,
    channels: Channels,
    messages: SlotMessages,
    stage: SlotStage,
    scratch: FloatArray,
    counts: np.ndarray,
    b: int,
) -> None:
    """Add the ticks of pairs in the exchange step of ``stage``, and their messages, to the counts
    ``scratch`` (KINDS, L) of the L runs of block ``b``. All messages count as lost for now: the
    caller takes the delivered ones off again. Of ``counts`` (R, KINDS) only the number R of runs is
    used. ``lanes`` is a tuple of length L.
    """
    first = b * len(lanes)
    for r in range(first, min(first + len(lanes), len(counts))):
        pairs, sent = messages.pair_count[r, stage.s, stage.step], 0
        for a in range(pairs):
            link = messages.active[r, stage.s, stage.step, a]
            for direction in range(channels.directions_per_link):
                if not is_silent(messages, b, stage, channels.ends[link, direction], r - first):
                    sent += channels.talks[
                        stage.step, link * channels.directions_per_link + direction
                    ]
        scratch[TICK, r - first] += pairs
        scratch[SEND, r - first] += sent
        scratch[LOST, r - first] += sent


@kernel
def count_silent(
    lanes: Lanes,
    channels: Channels,
    messages: SlotMessages,
    stage: SlotStage,
    scratch: FloatArray,
    b: int,
) -> None:
    """Subtract the messages that silent nodes (whose filters decided not to send) do not send in
    the exchange step of ``stage``, in the L runs of block ``b``, from the counts SEND and LOST of
    ``scratch`` (KINDS, L): the caller has added a message of each direction to both, as if all were
    sent and lost. ``lanes`` is a tuple of length L.
    """
    silent = spread(lanes, 0.0)
    # Directions w, of which link w // directions_per_link has one or two, from its ends.
    for w in range(len(channels.ends) * channels.directions_per_link):
        if channels.talks[stage.step, w] == 1:
            sends = load_flags(
                lanes,
                messages.sent,
                b,
                stage.s,
                stage.step,
                channels.ends[w // channels.directions_per_link, w % channels.directions_per_link],
            )
            silent += select(sends, 0.0, 1.0)
    add_count(lanes, scratch, SEND, -silent)
    add_count(lanes, scratch, LOST, -silent)


@kernel
def count_stops(
    lanes: Lanes, traced: TracedNodes, stage: SlotStage, counts: np.ndarray, b: int
) -> None:
    """Add the nodes that stop, which permanently freeze their network estimate, in the slot of
    ``stage``, in the L runs of block ``b``, to the count STOP of ``counts`` (R, KINDS) of all R
    runs. ``lanes`` is a tuple of length L.
    """
    first = b * len(lanes)
    for r in range(first, min(first + len(lanes), len(counts))):
        for i in range(len(traced.nodes)):
            counts[r, STOP] += traced.stopped[b, i, r - first] == stage.slot
