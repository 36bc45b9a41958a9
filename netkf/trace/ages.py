"""Age of information: how old the newest reading of each sensing node is at every node."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Struct
from netkf.trace.schema import CODES

SENSE, SEND, DROP, DELIVER, USE, STOP, FORGET = range(1, 8)
"""What an event does to ages; others do nothing."""
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
OF_SENDER = np.isin(np.arange(len(CODES)), [CODES["send"], CODES["lost"]])
"""Kinds of events of a message that are events of its sender; others are of the receiver."""
MAX_DENSE = 1000
"""Nodes up to which links are found in a table of all pairs."""
CAPACITY = 64
"""Messages under way for which there is room at first."""


class AgeState(Struct):
    """What N nodes know of S sources, and the messages under way, of which there may be C.

    newest, since : (N, S) time of the newest reading of each source that a node has, and since when
    area, peak    : (N, S) integral of its age until then, and the largest age before then
    own           : (N,) column of the node, -1 if it is no source
    steady        : (N,) True for sources that read continuously
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
    own: np.ndarray
    steady: np.ndarray
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
        self._nodes, self._tells_all, self._read_at = np.array(nodes), tells_all, read_at
        self._forgetful = np.isin(self._nodes, forgetful)
        ends = np.searchsorted(self._nodes, np.array(links, dtype=np.int64).reshape(-1, 2))
        self._links = ends[:, 0] * len(nodes) + ends[:, 1]
        self._link: np.ndarray | None = None
        if len(nodes) <= MAX_DENSE:
            self._link = np.zeros(len(nodes) ** 2, dtype=np.int64)
            self._link[self._links] = np.arange(len(links))
        shape = len(nodes), len(sources)
        own = np.full(len(nodes), -1)
        own[np.searchsorted(self._nodes, sources)] = np.arange(len(sources))
        self._columns: dict[str, Any] = dict(
            zip(("newest", "since", "area", "peak"), np.zeros((4, *shape)), strict=True)
        )
        self._columns |= {
            "own": own,
            "steady": np.isin(self._nodes, steady),
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
        kept = np.flatnonzero(ACTIONS[rows["kind"]])
        # Column by column: copies of whole rows take longer.
        kind, ids, peers, t, number, phase = (
            rows[name][kept] for name in ("kind", "node", "peer", "t", "message", "phase")
        )
        action, time = ACTIONS[kind], t
        node, peer = self._index(ids), self._index(peers)
        # A message has a link, other events have none.
        of_sender = OF_SENDER[kind]
        code = np.where(of_sender, node, peer) * len(self._nodes)
        code += np.where(of_sender, peer, node)
        link = np.searchsorted(self._links, code) if self._link is None else self._link[code]
        sensed = np.flatnonzero(action == SENSE)
        time[sensed] = self._read_at(ids[sensed], t[sensed])
        action[sensed[np.isnan(time[sensed])]] = 0
        action[(action == STOP) & self._forgetful[node]] = FORGET
        tells_all = np.ones(len(phase), dtype=bool)
        for one in range(int(phase.min(initial=0)), int(phase.max(initial=0)) + 1):
            if not self._tells_all(one):
                tells_all[phase == one] = False
        columns = action, time, node, link, number, tells_all
        done = 0
        while done < len(kept):
            done = follow(self._state, *columns, done)
            if done < len(kept):
                self._grow(len(self._columns["number"]))

    def _index(self, ids: np.ndarray) -> np.ndarray:
        """Return the indices (K,) of nodes, of -1 any."""
        if int(self._nodes[-1]) == len(self._nodes) - 1 and self._nodes[0] == 0:
            return np.asarray(np.maximum(ids, 0))
        return np.asarray(np.searchsorted(self._nodes, ids))

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
def follow(
    s: AgeState,
    action: np.ndarray,
    time: FloatArray,
    node: np.ndarray,
    link: np.ndarray,
    number: np.ndarray,
    tells_all: np.ndarray,
    first: int,
) -> int:
    """Follow K events from number ``first`` on; return how many are done, fewer than K where there
    is no room for a message.
    """
    for e in range(first, len(action)):
        i, t = node[e], time[e]
        if action[e] == SEND:
            if s.free[-1] == 0:
                return e
            s.free[-1] -= 1
            k = s.free[s.free[-1]]
            s.number[k], s.sender[k] = number[e], i
            s.following[k], s.under_way[link[e]] = s.under_way[link[e]], k
            fill_message(s, i, k, t, tells_all[e])
        elif action[e] == DROP or action[e] == DELIVER:
            k = find_message(s, link[e], number[e])
            if k >= 0 and action[e] == DROP:
                replace_message(s, k)
            elif k >= 0:
                s.following[k], s.inbox[i] = s.inbox[i], k
        elif action[e] == USE:
            use_waiting(s, i, t)
        elif action[e] == SENSE:
            renew(s, i, s.own[i], t, t)
        elif action[e] == STOP or action[e] == FORGET:
            # What a node had heard and not used when it went down is lost.
            clear(s, i)
            for c in range(s.newest.shape[1] if action[e] == FORGET else 0):
                renew(s, i, c, 0.0, t)
    return len(action)
