"""Age of information: how old the newest reading of each sensing node is at every node."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.small import count_until
from netkf.linalg.structs import Struct
from netkf.trace.schema import CODES

NOTHING, SENSE, SEND, DROP, DELIVER, USE, STOP = range(7)
"""What an event does to ages."""
ACTIONS = np.zeros(len(CODES), dtype=np.int64)
for _kind, _action in (
    ("sense", SENSE),
    ("send", SEND),
    ("lost", DROP),
    ("late", DROP),
    ("deliver", DELIVER),
    ("absorb", USE),
    ("swap", USE),
    ("crash", STOP),
    ("leave", STOP),
):
    ACTIONS[CODES[_kind]] = _action
MAX_DENSE, MAX_ID = 1000, 4000
"""Nodes up to which links are found in a table of all pairs, and ids up to which nodes are."""
OF_SENDER = (CODES["send"], CODES["lost"])
"""Kinds of events of a message that are events of its sender; others are of the receiver."""
CAPACITY = 64
"""Messages under way for which there is room at first."""


class AgeState(Struct):
    """What N nodes know of S sources, and the messages under way, of which there may be C.

    newest, since : (N, S) time of the newest reading of each source that a node has, and since when
    area, peak    : (N, S) integral of its age until then, and the largest age before then
    nodes, links  : (N,) ids and (D,) codes of directed links, sender N + receiver, sorted
    place, link   : place in nodes of each id, and in links of each code; empty if there are many
    own           : (N,) column of the node, -1 if it is no source
    steady        : (N,) True for sources that read continuously
    forgetful     : (N,) True for nodes that know nothing after they were down
    held          : (C, S) what messages tell; number, sender, following (C,): of which of its link,
                    of which node, and the next one in a list
    under_way     : (D,) first message in the list of each directed link
    inbox         : (N,) first message in the list of those that wait at a node
    free          : (C + 1,) numbers of messages that are free, how many of them last
    swaps         : True if nodes replace what they know by what a message tells
    """

    newest: FloatArray
    since: FloatArray
    area: FloatArray
    peak: FloatArray
    nodes: np.ndarray
    links: np.ndarray
    place: np.ndarray
    link: np.ndarray
    own: np.ndarray
    steady: np.ndarray
    forgetful: np.ndarray
    held: FloatArray
    number: np.ndarray
    sender: np.ndarray
    following: np.ndarray
    under_way: np.ndarray
    inbox: np.ndarray
    free: np.ndarray
    swaps: int


class Ages:
    """The age of information of nodes, from the events of one run.

    The age of ``source`` at a node is the time since its newest reading was taken of which the node
    can know: messages tell all that their sender knew when it sent them, or its own reading only,
    and a node knows it once it has used the message. Before anything has come it is the time since
    0.

    nodes, sources, links : ids in increasing order; directed links (sender, receiver), sorted
    steady    : the sources that read continuously
    forgetful : nodes that know nothing after they were down
    swaps     : a message replaces what its receiver knew, of several the newest of the last sender
    tells_all : ``tells_all(phase)``, False for messages that tell the sender's own reading only
    read_at   : ``read_at(node, times)``, when the readings used at ``times`` (K,) were taken, nan
                where there was none; ``node`` (K,) are ids
    """

    def __init__(
        self,
        nodes: Sequence[int],
        sources: Sequence[int],
        links: Sequence[tuple[int, int]],
        steady: Sequence[int],
        forgetful: Sequence[int],
        swaps: bool,
        tells_all: Callable[[int], bool],
        read_at: Callable[[np.ndarray, FloatArray], FloatArray],
    ) -> None:
        self._tells_all, self._read_at = tells_all, read_at
        ids = np.array(nodes)
        ends = np.searchsorted(ids, np.array(links, dtype=np.int64).reshape(-1, 2))
        codes = ends[:, 0] * len(nodes) + ends[:, 1]
        place = link = np.empty(0, dtype=np.int64)
        if 0 <= nodes[0] <= nodes[-1] <= MAX_ID:
            place = np.zeros(nodes[-1] + 1, dtype=np.int64)
            place[ids] = np.arange(len(nodes))
        if len(nodes) <= MAX_DENSE:
            link = np.zeros(len(nodes) ** 2, dtype=np.int64)
            link[codes] = np.arange(len(codes))
        shape = len(nodes), len(sources)
        own = np.full(len(nodes), -1)
        own[np.searchsorted(ids, sources)] = np.arange(len(sources))
        self._columns: dict[str, Any] = dict(
            zip(("newest", "since", "area", "peak"), np.zeros((4, *shape)), strict=True)
        )
        self._columns |= {
            "nodes": ids,
            "links": codes,
            "place": place,
            "link": link,
            "own": own,
            "steady": np.isin(ids, steady),
            "forgetful": np.isin(ids, forgetful),
            "held": np.empty((0, len(sources))),
            **dict.fromkeys(("number", "sender", "following"), np.empty(0, dtype=np.int64)),
            "under_way": np.full(len(links), -1),
            "inbox": np.full(len(nodes), -1),
            "free": np.zeros(1, dtype=np.int64),
            "swaps": int(swaps),
        }
        self._grow(CAPACITY)

    def _grow(self, count: int) -> None:
        """Make room for ``count`` more messages under way."""
        columns = self._columns
        first = len(columns["number"])
        for name in ("held", "number", "sender", "following"):
            old = columns[name]
            columns[name] = np.concatenate([old, np.zeros((count, *old.shape[1:]), old.dtype)])
        # None of the others is free, or they would do.
        columns["free"] = np.zeros(first + count + 1, dtype=np.int64)
        columns["free"][:count] = np.arange(first, first + count)
        columns["free"][-1] = count
        self._state = AgeState(**columns)

    def add(self, rows: np.ndarray) -> None:
        """Follow the next block of EVENT ``rows`` (K,)."""
        times, phases = rows["t"].copy(), int(rows["phase"].max(initial=0)) + 1
        sensed = np.flatnonzero(rows["kind"] == CODES["sense"])
        times[sensed] = self._read_at(rows["node"][sensed], times[sensed])
        tells_all = np.array([self._tells_all(phase) for phase in range(-1, phases)])
        done = 0
        while done < len(rows):
            done = follow(self._state, rows, times, tells_all, done)
            if done < len(rows):
                self._grow(len(self._columns["number"]))

    def finish(self, end: float) -> tuple[FloatArray, FloatArray]:
        """Return the mean from 0 to ``end`` seconds and the largest value (N, S) of the age of each
        source at each node, nan of a node at itself.
        """
        s = self._state
        area = s.area + (end - s.since) * (0.5 * (end + s.since) - s.newest)
        peak = np.maximum(s.peak, end - s.newest)
        for ages in (area, peak):
            ages[s.own >= 0, s.own[s.own >= 0]] = np.nan
        return area / end if end > 0.0 else np.full_like(area, np.nan), peak


@kernel
def renew(s: AgeState, i: int, c: int, value: float, t: float) -> None:
    """Let ``value`` be the newest reading of source ``c`` at node ``i`` from ``t`` on."""
    old, since = s.newest[i, c], s.since[i, c]
    s.area[i, c] += (t - since) * (0.5 * (t + since) - old)
    s.peak[i, c] = max(s.peak[i, c], t - old)
    s.newest[i, c], s.since[i, c] = value, t


@kernel
def find_message(s: AgeState, link: int, number: int) -> int:
    """Return the message of this ``number`` from the list of a ``link``, -1 if there is none."""
    before, k = -1, s.under_way[link]
    while k >= 0 and s.number[k] != number:
        before, k = k, s.following[k]
    if k >= 0:
        if before < 0:
            s.under_way[link] = s.following[k]
        else:
            s.following[before] = s.following[k]
    return int(k)


@kernel
def replace_message(s: AgeState, k: int) -> None:
    """Make room for another message in the place of message ``k``."""
    s.free[s.free[-1]] = k
    s.free[-1] += 1


@kernel
def fill_message(s: AgeState, i: int, k: int, t: float, tells_all: bool) -> None:
    """Let message ``k`` hold what node ``i`` knows at ``t``, or of its own reading only."""
    own = s.own[i]
    for c in range(s.newest.shape[1]):
        s.held[k, c] = s.newest[i, c] if tells_all else -1.0
    if own >= 0:
        s.held[k, own] = t if s.steady[i] else s.newest[i, own]


@kernel
def clear(s: AgeState, i: int) -> None:
    """Let no message wait for node ``i``."""
    k = s.inbox[i]
    while k >= 0:
        replace_message(s, k)
        k = s.following[k]
    s.inbox[i] = -1


@kernel
def use_waiting(s: AgeState, i: int, t: float) -> None:
    """Let node ``i`` use the messages that wait for it: all, or in a swap the newest one of the
    last sender, which replaces all that it knows.
    """
    k, chosen = s.inbox[i], -1
    while k >= 0:
        if chosen < 0 or (s.sender[k], s.number[k]) > (s.sender[chosen], s.number[chosen]):
            chosen = k
        k = s.following[k]
    k = s.inbox[i]
    while k >= 0:
        for c in range(s.newest.shape[1]):
            if (s.swaps and k == chosen) or (not s.swaps and s.held[k, c] > s.newest[i, c]):
                renew(s, i, c, s.held[k, c], t)
        k = s.following[k]
    clear(s, i)


@kernel
def find(table: np.ndarray, values: np.ndarray, value: int) -> int:
    """Return the place of a value in sorted ``values``, by a ``table`` of places unless empty."""
    if len(table) > 0:
        return int(table[value])
    return count_until(values, value) - 1


@kernel
def follow_message(s: AgeState, row: Any, i: int, t: float, tells_all: np.ndarray) -> bool:
    """Follow what happens at node ``i`` to a message; return False where there is no room for it.
    ``row`` is an EVENT; the others are as in ``follow``.
    """
    kind = row["kind"]
    j = find(s.place, s.nodes, row["peer"])
    # What is sent or lost is an event of the sender, what comes one of the receiver.
    code = i * len(s.nodes) + j if kind in OF_SENDER else j * len(s.nodes) + i
    link = find(s.link, s.links, code)
    if ACTIONS[kind] == SEND:
        if s.free[-1] == 0:
            return False
        s.free[-1] -= 1
        k = s.free[s.free[-1]]
        s.number[k], s.sender[k] = row["message"], i
        s.following[k], s.under_way[link] = s.under_way[link], k
        fill_message(s, i, k, t, tells_all[row["phase"] + 1])
        return True
    k = find_message(s, link, row["message"])
    if k >= 0 and ACTIONS[kind] == DROP:
        replace_message(s, k)
    elif k >= 0:
        s.following[k], s.inbox[i] = s.inbox[i], k
    return True


@kernel
def follow(
    s: AgeState, rows: np.ndarray, times: FloatArray, tells_all: np.ndarray, first: int
) -> int:
    """Follow K EVENT ``rows`` from number ``first`` on; return how many are done, fewer than K
    where there is no room for a message. times (K,): when a reading was taken, nan where there was
    none, else the time of the event; tells_all: by phase + 1.
    """
    for e in range(first, len(rows)):
        row, t = rows[e], times[e]
        action = ACTIONS[row["kind"]]
        if action == NOTHING:
            continue
        i = find(s.place, s.nodes, row["node"])
        if SEND <= action <= DELIVER:
            if not follow_message(s, row, i, t, tells_all):
                return e
        elif action == USE:
            use_waiting(s, i, t)
        elif action == SENSE and not math.isnan(t):
            renew(s, i, s.own[i], t, t)
        elif action == STOP:
            # What a node had heard and not used when it went down is lost.
            clear(s, i)
            for c in range(s.newest.shape[1] if s.forgetful[i] else 0):
                renew(s, i, c, 0.0, t)
    return len(rows)
