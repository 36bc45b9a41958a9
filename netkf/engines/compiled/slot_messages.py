"""Messages in slots, compiled: which nodes exchange, what arrives, and the events of all that.

Every link draws from streams of its own, so that messages of many slots and runs are drawn before
any estimate is computed. ``up`` (R, S, E, W) holds 1 where a message arrives on a direction in one
of the E steps of a slot's exchanges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
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
    """How pairs are drawn: place of the ``protocol`` in PROTOCOLS (-1: all links exchange), its
    ``chance`` (lazy or p), streams ``states`` (R, 6); ``first`` and ``members`` list for
    node-wakeup the links of each node in the order of its peers, for uniform-maximal the links of
    each matching. ``order`` (L,) and ``busy`` (N,) are scratch.
    """

    protocol: int
    chance: float
    states: np.ndarray
    first: np.ndarray
    members: np.ndarray
    order: np.ndarray
    busy: np.ndarray


class Channels(NamedTuple):
    """Properties and draws of messages on L links with so many directions each (``ends`` (L, 2) are
    places of nodes; direction 2 l goes from the first to the second).

    ``delivery`` (2, W): chance of a direction in the good and the bad state of its link. Streams
    ``states`` and ``state_draws`` (R K, 4) of K links or directions, empty where nothing is drawn;
    the last uniform number ``drawn`` (R K,) and state ``bad`` (R K,; -1 at first) of each; chances
    ``to_bad``, ``to_good``. ``talks`` (E, W): whether the sender has something to send in a step.
    A link has so many ``ways`` (directions) and ``streams`` of its own.
    """

    ends: np.ndarray
    delivery: FloatArray
    states: np.ndarray
    state_draws: np.ndarray
    drawn: FloatArray
    bad: np.ndarray
    to_bad: float
    to_good: float
    talks: np.ndarray
    ways: int
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
        lazy = next_unit(m.states, r) < m.chance
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
    """Maximal matchings take links in random order if both ends are free; of independent links
    those that meet no other are kept.
    """
    count, found = len(ends), 0
    for h in range(len(m.busy)):
        m.busy[h] = 0
    if m.protocol == MAXIMAL:
        # A random order of links, taken greedily: a maximal matching.
        shuffle(m.states, r, m.order, count)
        for k in range(count):
            i, j = ends[m.order[k], 0], ends[m.order[k], 1]
            if m.busy[i] == 0 and m.busy[j] == 0:
                m.busy[i] = m.busy[j] = 1
                active[found] = m.order[k]
                found += 1
        return found
    # Independent: each link wakes with the probability, and busy counts its ends.
    for k in range(count):
        m.order[k] = 1 if next_unit(m.states, r) < m.chance else 0
        m.busy[ends[k, 0]] += m.order[k]
        m.busy[ends[k, 1]] += m.order[k]
    # A link that meets no other is the only one at both of its ends.
    for k in range(count):
        if m.order[k] == 1 and m.busy[ends[k, 0]] == 1 and m.busy[ends[k, 1]] == 1:
            active[found] = k
            found += 1
    return found


@kernel
def draw_link(c: Channels, r: int, link: int, fresh: bool, up: np.ndarray, e: int) -> None:
    """Decide about the messages of one activation of a link in step ``e``, into ``up`` (W,); links
    that are not ``fresh`` keep their last numbers.
    """
    for d in range(c.ways):
        # The stream of this direction: with one stream per link (symmetric), both directions use
        # it.
        k = (r * len(c.ends) + link) * c.streams + d
        if d >= c.streams:
            k -= 1
        # Held links keep their number; -1 marks one that has none yet.
        elif len(c.states) > 0 and (fresh or c.drawn[k] < 0.0):
            c.drawn[k] = next_unit(c.states, k)
            # A chain of states takes one step for each activation.
            if len(c.state_draws) > 0:
                c.bad[k] = next_state(c.bad[k], next_unit(c.state_draws, k), c.to_bad, c.to_good)
        w = link * c.ways + d
        # ``bad`` is -1 for channels without a state, whose first row applies.
        arrives = c.drawn[k] < c.delivery[max(c.bad[k], 0), w] and c.talks[e, w] == 1
        up[w] = 1 if arrives else 0


@kernel
def next_state(bad: int, u: float, to_bad: float, to_good: float) -> int:
    """One step of the Gilbert-Elliott chain with the uniform number ``u``; the first is drawn from
    its stationary law (``bad`` < 0).
    """
    if bad < 0:
        return 1 if u < to_bad / (to_bad + to_good) else 0
    if bad == 1:
        return 1 if u >= to_good else 0
    return 1 if u < to_bad else 0


@kernel
def draw_messages(
    c: Channels,
    m: Matchings,
    exchanged: np.ndarray,
    fresh: np.ndarray,
    up: np.ndarray,
    active: np.ndarray,
    count: np.ndarray,
) -> None:
    """Fill ``up`` (R, S, E, W) in the slots that are ``exchanged`` (S,); links draw anew in steps
    that are ``fresh`` (E,). Of matchings, ``active`` (R, S, E, A) are the links in their order and
    ``count`` (R, S, E) is their number.
    """
    for r in range(up.shape[0]):
        for s in range(up.shape[1]):
            if not exchanged[s]:
                continue
            for e in range(up.shape[2]):
                if m.protocol < 0:
                    # Broadcast: every link is used in every step.
                    for link in range(len(c.ends)):
                        draw_link(c, r, link, fresh[e], up[r, s, e], e)
                    continue
                # A matching uses few links: the others must be 0.
                for w in range(up.shape[3]):
                    up[r, s, e, w] = 0
                found = draw_matching(m, c.ends, r, active[r, s, e])
                count[r, s, e] = found
                for k in range(found):
                    draw_link(c, r, active[r, s, e, k], fresh[e], up[r, s, e], e)


class Stages(NamedTuple):
    """What a slot does in its order: the ``step`` of an exchange or -1 where nodes read, its
    ``phase``, and when it ends (seconds after the slot begins), (K,) each; the step in which nodes
    may stop for good (``stopping``, -1: in none).
    """

    step: np.ndarray
    phase: np.ndarray
    end: FloatArray
    stopping: int


class SlotTimes(NamedTuple):
    """Of S slots: number of the first and when each begins (S,); whether events are recorded, nodes
    read, nodes exchange, and which sample it is, or -1 (S, each). ``predicts``: samples come first.
    """

    first: int
    start: FloatArray
    noted: np.ndarray
    sensed: np.ndarray
    exchanged: np.ndarray
    sample: np.ndarray
    predicts: bool


class Hearing(NamedTuple):
    """Ids of all nodes (N,) and of those with sensors; the directions by receiver, as
    algorithms.kernels.slots.SlotLinks has them; the number of messages sent so far (R, W); the slot
    in which each node stopped (R, N), and whether it sends no more then.
    """

    nodes: np.ndarray
    sensing: np.ndarray
    first: np.ndarray
    sender: np.ndarray
    way: np.ndarray
    sent: np.ndarray
    stopped: np.ndarray
    silences: bool


class Rows(NamedTuple):
    """Columns of the events of one run, of no length where they are only counted; how many there
    are at each sample (T,), and of each kind in each run (R, KINDS).
    """

    t: FloatArray
    kind: np.ndarray
    node: np.ndarray
    peer: np.ndarray
    message: np.ndarray
    phase: np.ndarray
    age: FloatArray
    at_sample: np.ndarray
    counts: np.ndarray


class Drawn(NamedTuple):
    """Messages of a block: ``up`` (R, S, E, W), links ``active`` in matchings (R, S, E, A), their
    number ``pairs`` (R, S, E).
    """

    up: np.ndarray
    active: np.ndarray
    pairs: np.ndarray


class Moment(NamedTuple):
    """The circumstances of events: the ``run``, the ``slot`` by number and by place ``s`` in the
    block, ``step`` and ``phase`` of the exchange (-1 where nodes read), the time ``t`` in seconds.
    """

    run: int
    slot: int
    s: int
    step: int
    phase: int
    t: float


@kernel
def note(
    rows: Rows, m: Moment, kind: int, node: int, peer: int, message: int, age: float, at: int
) -> int:
    """Count one event and write it into row ``at``; return the next row."""
    # Counting is cheap and always done; rows are written as long as there is room.
    rows.counts[m.run, kind] += 1
    if at < len(rows.t):
        rows.t[at], rows.kind[at], rows.node[at], rows.peer[at] = m.t, kind, node, peer
        rows.message[at], rows.phase[at], rows.age[at] = message, m.phase, age
    return at + 1


@kernel
def make_rows(
    stages: Stages, times: SlotTimes, c: Channels, h: Hearing, d: Drawn, pairwise: bool, rows: Rows
) -> int:
    """Write the events of these slots in their order; return the number of rows of the last run."""
    at = 0
    for r in range(d.up.shape[0]):
        # Rows are those of the last run: only a single run asks for them.
        at = 0
        for s in range(len(times.start)):
            # Filters that predict are sampled before anything happens in the slot.
            if times.predicts:
                mark_sample(times, s, rows, at)
            # At the horizon nothing is recorded but the sample.
            if times.noted[s]:
                at = _slot_rows(stages, times, c, h, d, pairwise, rows, r, s, at)
            if not times.predicts:
                mark_sample(times, s, rows, at)
    return at


@kernel
def mark_sample(times: SlotTimes, s: int, rows: Rows, at: int) -> None:
    """Keep how many rows come before the sample of a slot, if it has one."""
    k = times.sample[s]
    if k >= 0 and k < len(rows.at_sample):
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
    r: int,
    s: int,
    at: int,
) -> int:
    """Write the events of one slot of run ``r``; return the row."""
    now = times.start[s]
    for k in range(len(stages.step)):
        m = Moment(r, times.first + s, s, stages.step[k], stages.phase[k], now)
        if m.step < 0:
            if times.sensed[s]:
                for node in h.sensing:
                    at = note(rows, m, SENSE, node, -1, -1, NAN, at)
        elif times.exchanged[s]:
            at = _sent(c, h, d, rows, m, pairwise, stages.stopping, at)
            # Absorptions happen at the end of the step, when its inboxes close.
            now = times.start[s] + stages.end[k]
            closing = Moment(r, m.slot, s, m.step, m.phase, now)
            at = _closed(h, d, rows, closing, pairwise, stages.stopping, at)
    return at


@kernel
def _sent(
    c: Channels,
    h: Hearing,
    d: Drawn,
    rows: Rows,
    m: Moment,
    pairwise: bool,
    stopping: int,
    at: int,
) -> int:
    """Write what is sent in a step, after the tick of each pair or one round; return the row."""
    if not pairwise:
        at = note(rows, m, ROUND, -1, -1, -1, NAN, at)
    links = d.pairs[m.run, m.s, m.step] if pairwise else len(c.ends)
    for a in range(links):
        link = d.active[m.run, m.s, m.step, a] if pairwise else a
        if pairwise:
            i, j = h.nodes[c.ends[link, 0]], h.nodes[c.ends[link, 1]]
            at = note(rows, m, TICK, i, j, -1, NAN, at)
        at = _link_rows(c, h, d, rows, m, link, stopping, at)
    return at


@kernel
def _link_rows(
    c: Channels, h: Hearing, d: Drawn, rows: Rows, m: Moment, link: int, stopping: int, at: int
) -> int:
    """Write the messages sent on a link, each followed by its arrival or loss; return the row."""
    for end in range(c.ways):
        w, i = link * c.ways + end, c.ends[link, end]
        # By the paper's rule a node that stopped in an earlier slot sends no more mass.
        gone = h.silences and m.step == stopping and h.stopped[m.run, i] < m.slot
        if c.talks[m.step, w] == 0 or gone:
            continue
        # Messages of a direction are numbered from 0, lost ones included.
        number, sender, receiver = h.sent[m.run, w], h.nodes[i], h.nodes[c.ends[link, 1 - end]]
        h.sent[m.run, w] = number + 1
        at = note(rows, m, SEND, sender, receiver, number, NAN, at)
        if d.up[m.run, m.s, m.step, w] == 1:
            at = note(rows, m, DELIVER, receiver, sender, number, 0.0, at)
        else:
            at = note(rows, m, LOST, sender, receiver, number, NAN, at)
    return at


@kernel
def _closed(
    h: Hearing, d: Drawn, rows: Rows, m: Moment, pairwise: bool, stopping: int, at: int
) -> int:
    """Write who absorbs when a step ends, and who stops learning; return the row."""
    for i in range(len(h.nodes)):
        heard = False
        for k in range(h.first[i], h.first[i + 1]):
            if d.up[m.run, m.s, m.step, h.way[k]] == 1:
                heard = True
                if pairwise:
                    # The message of this step is the last one that was numbered.
                    peer, number = h.nodes[h.sender[k]], h.sent[m.run, h.way[k]] - 1
                    at = note(rows, m, SWAP, h.nodes[i], peer, number, 0.0, at)
        if heard and not pairwise:
            at = note(rows, m, ABSORB, h.nodes[i], -1, -1, 0.0, at)
        # A node that stops in this slot does so after it absorbed.
        if m.step == stopping and h.stopped[m.run, i] == m.slot:
            at = note(rows, m, STOP, h.nodes[i], -1, -1, NAN, at)
    return at
