"""Messages in slots, compiled: which nodes exchange, what arrives, and the events of all that.

Every link draws from streams of its own, so that messages of many slots and runs are drawn before
any estimate is computed. ``up`` (B, S, E, W, L) holds 1 where a message arrives on a direction in
one of the E steps of a slot's exchanges, in B blocks of L runs side by side (``linalg.lanes``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

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
from netkf.rng.draws import next_unit, next_unit_of_lane, next_units
from netkf.rng.numbers import next_integer, shuffle
from netkf.trace.schema import CODES

ONE_EDGE, NODE_WAKEUP, MAXIMAL, UNIFORM_MAXIMAL, INDEPENDENT = range(len(PROTOCOLS))
SENSE, TICK, SEND, DELIVER, LOST, ABSORB, SWAP, ROUND, STOP = (
    CODES[kind]
    for kind in ("sense", "tick", "send", "deliver", "lost", "absorb", "swap", "round", "stop")
)
NAN = np.nan


class Matchings(NamedTuple):
    """How pairs are drawn.

    protocol : index in PROTOCOLS, -1: all links exchange
    probability : lazy or p
    states : random streams (R, 6)
    first, members : for node-wakeup the links of each node in the order of its peers, for
                     uniform-maximal the links of each matching
    order, busy : (L,) and (N,), scratch
    """

    protocol: int
    probability: float
    states: np.ndarray
    first: np.ndarray
    members: np.ndarray
    order: np.ndarray
    busy: np.ndarray


class Channels(NamedTuple):
    """Properties and draws of messages on L links with so many directions each (``ends`` (L, 2) are
    indices of nodes; direction 2 l goes from the first to the second).

    ``delivery`` (2, W): probability of a direction in the good and the bad state of its link.
    Streams ``states`` and ``state_draws`` (B, K, 4, L) of K links or directions, empty where
    nothing is drawn; the last uniform numbers ``drawn`` and ``state_drawn`` and state ``bad`` (B,
    K, L; -1 at first) of each; probabilities ``to_bad``, ``to_good``. ``talks`` (E, W): whether the
    sender has something to send in a step. A link has
    ``directions_per_link`` (1 or 2) and so many ``streams`` of its own.
    """

    ends: np.ndarray
    delivery: FloatArray
    states: np.ndarray
    state_draws: np.ndarray
    drawn: FloatArray
    state_drawn: FloatArray
    bad: np.ndarray
    to_bad: float
    to_good: float
    talks: np.ndarray
    directions_per_link: int
    streams: int


@kernel
def draw_matching(m: Matchings, ends: np.ndarray, r: int, active: np.ndarray) -> int:
    """Write the links of one matching of run ``r`` into ``active`` in their order; return how many.

    The numbers are those that ``Matching.draw`` takes from the same stream.
    """
    count = len(ends)
    if count == 0:
        return 0
    # The order of the draws is that of Matching.draw: it decides which numbers a protocol takes.
    if m.protocol == ONE_EDGE:
        lazy = next_unit(m.states, r) < m.probability
        active[0] = next_integer(m.states, r, count)
        return 0 if lazy else 1
    if m.protocol == NODE_WAKEUP:
        node = next_integer(m.states, r, len(m.busy))
        share = next_unit(m.states, r)
        peers = m.first[node + 1] - m.first[node]
        # Both numbers are drawn before this, so that isolated nodes take as many as others.
        if peers == 0:
            return 0
        active[0] = m.members[m.first[node] + int(share * peers)]
        return 1
    if m.protocol == UNIFORM_MAXIMAL:
        which = next_integer(m.states, r, len(m.first) - 1)
        for k in range(m.first[which], m.first[which + 1]):
            active[k - m.first[which]] = m.members[k]
        return int(m.first[which + 1] - m.first[which])
    return _free_links(m, ends, r, active)


@kernel
def _free_links(m: Matchings, ends: np.ndarray, r: int, active: np.ndarray) -> int:
    """Move the links of a matching of run ``r`` to the front of ``active`` and return their number.

    Maximal matchings take links in random order if both ends are free; of independent links those
    that meet no other are kept.
    """
    count, found = len(ends), 0
    for h in range(len(m.busy)):
        m.busy[h] = 0
    if m.protocol == MAXIMAL:
        # A random order of links, taken greedily: a maximal matching.
        shuffle(m.states, r, m.order, count)
        for k in range(count):
            i, j = ends[m.order[k], 0], ends[m.order[k], 1]
            # Without a branch, which nobody could predict.
            free = (m.busy[i] | m.busy[j]) ^ 1
            index = min(found, len(active) - 1)
            active[index] += free * (m.order[k] - active[index])
            m.busy[i], m.busy[j] = m.busy[i] | free, m.busy[j] | free
            found += free
        return found
    # Independent: each link wakes with the probability, and busy counts its ends.
    for k in range(count):
        m.order[k] = 1 if next_unit(m.states, r) < m.probability else 0
        m.busy[ends[k, 0]] += m.order[k]
        m.busy[ends[k, 1]] += m.order[k]
    # A link that meets no other is the only one at both of its ends.
    for k in range(count):
        if m.order[k] == 1 and m.busy[ends[k, 0]] == 1 and m.busy[ends[k, 1]] == 1:
            active[found] = k
            found += 1
    return found


@kernel
def draw_link(
    lanes: Lanes, c: Channels, b: int, link: int, fresh: bool, up: np.ndarray, s: int, e: int
) -> None:
    """Decide about the messages of one activation of a link in all runs of a block, in step ``e``
    of slot ``s`` of ``up``; links that are not ``fresh`` keep their last numbers.
    """
    for d in range(c.directions_per_link):
        # With one stream per link (symmetric) both directions use it.
        k = link * c.streams + min(d, c.streams - 1)
        # Held links keep their number; -1 marks one that has none yet.
        if d < c.streams and len(c.states) > 0 and (fresh or c.drawn[b, k, 0] < 0.0):
            next_units(lanes, c.states, b, k, c.drawn)
            # A chain of states takes one step for each activation.
            if len(c.state_draws) > 0:
                next_units(lanes, c.state_draws, b, k, c.state_drawn)
                for q in range(len(lanes)):
                    c.bad[b, k, q] = next_state(
                        c.bad[b, k, q], c.state_drawn[b, k, q], c.to_bad, c.to_good
                    )
        w = link * c.directions_per_link + d
        if c.talks[e, w] == 1:
            number = load(lanes, c.drawn, b, k)
            if len(c.state_draws) == 0:
                store_flags(lanes, up, b, s, e, w, number < c.delivery[0, w])
                continue
            for q in range(len(lanes)):
                probability = c.delivery[1, w] if c.bad[b, k, q] == 1 else c.delivery[0, w]
                up[b, s, e, w, q] = c.drawn[b, k, q] < probability


@kernel
def draw_link_of_lane(
    c: Channels, b: int, link: int, fresh: bool, up: np.ndarray, s: int, e: int, q: int
) -> None:
    """Draw one link for the run of lane ``q`` alone, as ``draw_link`` does for all lanes."""
    for d in range(c.directions_per_link):
        k = link * c.streams + min(d, c.streams - 1)
        if d < c.streams and len(c.states) > 0 and (fresh or c.drawn[b, k, q] < 0.0):
            c.drawn[b, k, q] = next_unit_of_lane(c.states, b, k, q)
            if len(c.state_draws) > 0:
                u = next_unit_of_lane(c.state_draws, b, k, q)
                c.bad[b, k, q] = next_state(c.bad[b, k, q], u, c.to_bad, c.to_good)
        w = link * c.directions_per_link + d
        if c.talks[e, w] == 1:
            # A channel without a state has -1 there.
            probability = c.delivery[1, w] if c.bad[b, k, q] == 1 else c.delivery[0, w]
            up[b, s, e, w, q] = c.drawn[b, k, q] < probability


@kernel
def next_state(bad: int, u: float, to_bad: float, to_good: float) -> int:
    """Return the next state of the Gilbert-Elliott chain by the uniform number ``u``; the first
    one, after ``bad`` < 0, has the stationary law.
    """
    if bad < 0:
        return 1 if u < to_bad / (to_bad + to_good) else 0
    if bad == 1:
        return 1 if u >= to_good else 0
    return 1 if u < to_bad else 0


@kernel
def draw_broadcasts(
    lanes: Lanes, c: Channels, exchanged: np.ndarray, fresh: np.ndarray, up: np.ndarray
) -> None:
    """Fill ``up`` (B, S, E, W, L), zeros before, in the slots that are ``exchanged`` (S,), where
    every link is used in every step; links draw anew in steps that are ``fresh`` (E,).
    """
    for b in range(up.shape[0]):
        for s in range(up.shape[1]):
            for e in range(up.shape[2] if exchanged[s] else 0):
                for link in range(len(c.ends)):
                    draw_link(lanes, c, b, link, fresh[e], up, s, e)


@kernel
def draw_matched(
    lanes: Lanes,
    c: Channels,
    m: Matchings,
    exchanged: np.ndarray,
    fresh: np.ndarray,
    up: np.ndarray,
    active: np.ndarray,
    count: np.ndarray,
) -> None:
    """Draw the messages of matchings, as ``draw_broadcasts`` does for all links: ``active`` (R, S,
    E, A) gets the paired links in their order and ``count`` (R, S, E) their number.
    """
    for b in range(up.shape[0]):
        for s in range(up.shape[1]):
            for e in range(up.shape[2] if exchanged[s] else 0):
                draw_pairs(lanes, c, m, fresh[e], up, active, count, b, s, e)


@kernel
def draw_pairs(
    lanes: Lanes,
    c: Channels,
    m: Matchings,
    fresh: bool,
    up: np.ndarray,
    active: np.ndarray,
    count: np.ndarray,
    b: int,
    s: int,
    e: int,
) -> None:
    """Draw the matchings of a step in all runs of a block, and their messages."""
    first = b * len(lanes)
    for q in range(min(len(lanes), len(count) - first)):
        r = first + q
        found = draw_matching(m, c.ends, r, active[r, s, e])
        count[r, s, e] = found
        for k in range(found):
            draw_link_of_lane(c, b, active[r, s, e, k], fresh, up, s, e, q)


@kernel
def ask_all(lanes: Lanes, c: Channels, exchanged: np.ndarray, sent: np.ndarray) -> None:
    """Write 1 into ``sent`` (B, S, E, N, L) for all nodes with links where they exchange."""
    for b in range(sent.shape[0]):
        for s in range(sent.shape[1]):
            for e in range(sent.shape[2] if exchanged[s] else 0):
                for link in range(len(c.ends)):
                    for end in range(2):
                        for q in range(len(lanes)):
                            sent[b, s, e, c.ends[link, end], q] = 1


@kernel
def ask_pairs(
    lanes: Lanes, c: Channels, active: np.ndarray, count: np.ndarray, sent: np.ndarray
) -> None:
    """Mark the nodes that are asked for a message, as ``ask_all`` does, for matchings: the ends of
    the first ``count`` links of ``active``, see Drawn.
    """
    for r in range(count.shape[0]):
        for s in range(count.shape[1]):
            for e in range(count.shape[2]):
                for a in range(count[r, s, e]):
                    for end in range(2):
                        node = c.ends[active[r, s, e, a], end]
                        sent[r // len(lanes), s, e, node, r % len(lanes)] = 1


@kernel
def draw_uniforms(states: np.ndarray, sent: np.ndarray, uniform: FloatArray) -> None:
    """Write the next number of each node that is asked into ``uniform`` (B, S, E, N, L), in the
    order of steps, from the streams ``states`` (B, N, 4, L).
    """
    for b in range(sent.shape[0]):
        for s in range(sent.shape[1]):
            for e in range(sent.shape[2]):
                for h in range(sent.shape[3]):
                    for q in range(sent.shape[4]):
                        if sent[b, s, e, h, q] == 1:
                            uniform[b, s, e, h, q] = next_unit_of_lane(states, b, h, q)


class Stages(NamedTuple):
    """What happens in a slot, K stages in order.

    step : (K,), step of an exchange, -1 where nodes read
    phase : (K,)
    end : (K,), seconds after the slot begins
    stopping : step in which nodes may stop for good, -1: none
    """

    step: np.ndarray
    phase: np.ndarray
    end: FloatArray
    stopping: int


class SlotTimes(NamedTuple):
    """When S slots begin and what happens in them.

    first, start : number of the first slot, and the times (S,)
    noted, sensed, exchanged : (S,), whether events are recorded, nodes read, nodes exchange
    sample : (S,), index of the sample, -1: none
    predicts : whether samples come first in a slot
    """

    first: int
    start: FloatArray
    noted: np.ndarray
    sensed: np.ndarray
    exchanged: np.ndarray
    sample: np.ndarray
    predicts: bool


class Hearing(NamedTuple):
    """Nodes and links of a recorded run.

    nodes, sensing : ids of all nodes (N,) and of those with sensors
    first, sender, direction : directions by receiver, see ``SlotLinks``
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
    """Columns of the events of one run, and how many there are at each sample (T,)."""

    t: FloatArray
    kind: np.ndarray
    node: np.ndarray
    peer: np.ndarray
    message: np.ndarray
    phase: np.ndarray
    age: FloatArray
    at_sample: np.ndarray


class Drawn(NamedTuple):
    """Messages of S slots with E steps each.

    up : (B, S, E, W, L), whether a message arrives
    active, pairs : paired links (R, S, E, A) and their number (R, S, E)
    sent : who sends (B, S, E, N, L), empty where filters do not decide that
    """

    up: np.ndarray
    active: np.ndarray
    pairs: np.ndarray
    sent: np.ndarray


class Moment(NamedTuple):
    """The circumstances of events.

    slot, s : number of the slot, and its index in the block
    step, phase : of the exchange, -1 where nodes read
    t : seconds
    """

    slot: int
    s: int
    step: int
    phase: int
    t: float


@kernel
def write_row(
    rows: Rows, m: Moment, kind: int, node: int, peer: int, message: int, age: float, at: int
) -> int:
    """Write one event into row ``at``; return the next row."""
    rows.t[at], rows.kind[at], rows.node[at], rows.peer[at] = m.t, kind, node, peer
    rows.message[at], rows.phase[at], rows.age[at] = message, m.phase, age
    return at + 1


@kernel
def make_rows(
    stages: Stages,
    times: SlotTimes,
    c: Channels,
    h: Hearing,
    d: Drawn,
    pairwise: bool,
    first: int,
    stop: int,
    rows: Rows,
) -> int:
    """Write the events of the first run in the slots from index ``first`` up to ``stop`` in their
    order; return how many there are.
    """
    at = 0
    for s in range(first, stop):
        # Filters that predict are sampled before anything happens in the slot.
        if times.predicts:
            mark_sample(times, s, rows, at)
        # At the horizon nothing is recorded but the sample.
        if times.noted[s]:
            at = _slot_rows(stages, times, c, h, d, pairwise, rows, s, at)
        if not times.predicts:
            mark_sample(times, s, rows, at)
    return at


@kernel
def mark_sample(times: SlotTimes, s: int, rows: Rows, at: int) -> None:
    """Keep how many rows come before the sample of a slot, if it has one."""
    k = times.sample[s]
    if k >= 0:
        rows.at_sample[k] = at


@kernel
def _slot_rows(
    stages: Stages,
    times: SlotTimes,
    c: Channels,
    h: Hearing,
    d: Drawn,
    pairwise: bool,
    rows: Rows,
    s: int,
    at: int,
) -> int:
    """Write the events of one slot; return the row."""
    now = times.start[s]
    for k in range(len(stages.step)):
        m = Moment(times.first + s, s, stages.step[k], stages.phase[k], now)
        if m.step < 0:
            if times.sensed[s]:
                for node in h.sensing:
                    at = write_row(rows, m, SENSE, node, -1, -1, NAN, at)
        elif times.exchanged[s]:
            at = _write_sends(c, h, d, rows, m, pairwise, at)
            # Absorptions happen at the end of the step, when its inboxes close.
            now = times.start[s] + stages.end[k]
            closing = Moment(m.slot, s, m.step, m.phase, now)
            at = _write_step_end(h, d, rows, closing, pairwise, stages.stopping, at)
    return at


@kernel
def _write_sends(
    c: Channels, h: Hearing, d: Drawn, rows: Rows, m: Moment, pairwise: bool, at: int
) -> int:
    """Write the messages sent in a step, after the tick of each pair or one round; return the next
    row.
    """
    if not pairwise:
        at = write_row(rows, m, ROUND, -1, -1, -1, NAN, at)
    links = d.pairs[0, m.s, m.step] if pairwise else len(c.ends)
    for a in range(links):
        link = d.active[0, m.s, m.step, a] if pairwise else a
        if pairwise:
            i, j = h.nodes[c.ends[link, 0]], h.nodes[c.ends[link, 1]]
            at = write_row(rows, m, TICK, i, j, -1, NAN, at)
        at = _link_rows(c, h, d, rows, m, link, at)
    return at


@kernel
def _link_rows(c: Channels, h: Hearing, d: Drawn, rows: Rows, m: Moment, link: int, at: int) -> int:
    """Write the messages sent on a link, each followed by its arrival or loss; return the row."""
    for end in range(c.directions_per_link):
        w, i = link * c.directions_per_link + end, c.ends[link, end]
        if c.talks[m.step, w] == 0 or is_silent(d, 0, m, i, 0):
            continue
        # Messages of a direction are numbered from 0, lost ones included.
        number, sender, receiver = h.sent[w], h.nodes[i], h.nodes[c.ends[link, 1 - end]]
        h.sent[w] = number + 1
        at = write_row(rows, m, SEND, sender, receiver, number, NAN, at)
        if d.up[0, m.s, m.step, w, 0] == 1:
            at = write_row(rows, m, DELIVER, receiver, sender, number, 0.0, at)
        else:
            at = write_row(rows, m, LOST, sender, receiver, number, NAN, at)
    return at


@kernel
def is_silent(d: Drawn, b: int, m: Moment, node: int, q: int) -> bool:
    """Return True if the node of an index sends nothing in a step, in the run of a lane."""
    return len(d.sent) > 0 and d.sent[b, m.s, m.step, node, q] == 0


@kernel
def _write_step_end(
    h: Hearing, d: Drawn, rows: Rows, m: Moment, pairwise: bool, stopping: int, at: int
) -> int:
    """Write who absorbs when a step ends, and who stops learning; return the row."""
    for i in range(len(h.nodes)):
        heard = False
        for k in range(h.first[i], h.first[i + 1]):
            if d.up[0, m.s, m.step, h.direction[k], 0] == 1:
                heard = True
                if pairwise:
                    # The message of this step is the last one that was numbered.
                    peer, number = h.nodes[h.sender[k]], h.sent[h.direction[k]] - 1
                    at = write_row(rows, m, SWAP, h.nodes[i], peer, number, 0.0, at)
        if heard and not pairwise:
            at = write_row(rows, m, ABSORB, h.nodes[i], -1, -1, 0.0, at)
        # A node that stops in this slot does so after it absorbed.
        if m.step == stopping and h.stopped[0, i, 0] == m.slot:
            at = write_row(rows, m, STOP, h.nodes[i], -1, -1, NAN, at)
    return at


@kernel
def count_events(
    lanes: Lanes,
    stages: Stages,
    times: SlotTimes,
    c: Channels,
    h: Hearing,
    d: Drawn,
    pairwise: bool,
    scratch: FloatArray,
    counts: np.ndarray,
) -> None:
    """Add the events of R runs by kind to ``counts`` (R, KINDS), as ``make_rows`` would write them;
    ``scratch`` (KINDS, L).
    """
    for b in range(d.up.shape[0]):
        for kind in range(len(scratch)):
            store(lanes, scratch, kind, 0.0)
        for s in range(len(times.start)):
            for k in range(len(stages.step) if times.noted[s] else 0):
                e = stages.step[k]
                if e < 0 and times.sensed[s]:
                    add_count(lanes, scratch, SENSE, 1.0 * len(h.sensing))
                elif e >= 0 and times.exchanged[s]:
                    m = Moment(times.first + s, s, e, stages.phase[k], 0.0)
                    count_step(lanes, c, h, d, m, pairwise, stages.stopping, scratch, counts, b)
        first = b * len(lanes)
        for q in range(min(len(lanes), len(counts) - first)):
            for kind in range(len(scratch)):
                counts[first + q, kind] += int(scratch[kind, q])


@kernel(inlined=True)
def add_count(lanes: Lanes, scratch: FloatArray, kind: int, number: Any) -> None:
    """Add ``number`` events of a kind in each lane."""
    store(lanes, scratch, kind, load(lanes, scratch, kind) + number)


@kernel
def count_step(
    lanes: Lanes,
    c: Channels,
    h: Hearing,
    d: Drawn,
    m: Moment,
    pairwise: bool,
    stopping: int,
    scratch: FloatArray,
    counts: np.ndarray,
    b: int,
) -> None:
    """Count the events of one step of an exchange in the runs of a block."""
    stops = m.step == stopping
    if pairwise:
        count_matched_pairs(lanes, c, d, m, scratch, counts, b)
    else:
        add_count(lanes, scratch, ROUND, 1.0)
        sent = 0
        for w in range(d.up.shape[3]):
            sent += c.talks[m.step, w]
        add_count(lanes, scratch, SEND, 1.0 * sent)
        add_count(lanes, scratch, LOST, 1.0 * sent)
        if len(d.sent) > 0:
            count_silent(lanes, c, d, m, scratch, b)
    # Each message that arrives is one that was not lost.
    absorbed = came = spread(lanes, 0.0)
    for i in range(len(h.nodes)):
        heard = spread(lanes, 0.0)
        for k in range(h.first[i], h.first[i + 1]):
            up = load_flags(lanes, d.up, b, m.s, m.step, h.direction[k])
            heard += select(up, 1.0, 0.0)
        came += heard
        absorbed += select(heard > 0.0, 1.0, 0.0)
    add_count(lanes, scratch, DELIVER, came)
    add_count(lanes, scratch, LOST, -came)
    add_count(lanes, scratch, SWAP if pairwise else ABSORB, came if pairwise else absorbed)
    if stops:
        count_stops(lanes, h, m, counts, b)


@kernel
def count_matched_pairs(
    lanes: Lanes,
    c: Channels,
    d: Drawn,
    m: Moment,
    scratch: FloatArray,
    counts: np.ndarray,
    b: int,
) -> None:
    """Count the pairs of a step in the runs of a block, and their messages."""
    first = b * len(lanes)
    for r in range(first, min(first + len(lanes), len(counts))):
        pairs, sent = d.pairs[r, m.s, m.step], 0
        for a in range(pairs):
            link = d.active[r, m.s, m.step, a]
            for direction in range(c.directions_per_link):
                if not is_silent(d, b, m, c.ends[link, direction], r - first):
                    sent += c.talks[m.step, link * c.directions_per_link + direction]
        scratch[TICK, r - first] += pairs
        scratch[SEND, r - first] += sent
        scratch[LOST, r - first] += sent


@kernel
def count_silent(
    lanes: Lanes, c: Channels, d: Drawn, m: Moment, scratch: FloatArray, b: int
) -> None:
    """Take off the messages that nodes do not send."""
    silent = spread(lanes, 0.0)
    for w in range(len(c.ends) * c.directions_per_link):
        if c.talks[m.step, w] == 1:
            sends = load_flags(
                lanes,
                d.sent,
                b,
                m.s,
                m.step,
                c.ends[w // c.directions_per_link, w % c.directions_per_link],
            )
            silent += select(sends, 0.0, 1.0)
    add_count(lanes, scratch, SEND, -silent)
    add_count(lanes, scratch, LOST, -silent)


@kernel
def count_stops(lanes: Lanes, h: Hearing, m: Moment, counts: np.ndarray, b: int) -> None:
    """Count the nodes that stop in a slot."""
    first = b * len(lanes)
    for r in range(first, min(first + len(lanes), len(counts))):
        for i in range(len(h.nodes)):
            counts[r, STOP] += h.stopped[b, i, r - first] == m.slot
