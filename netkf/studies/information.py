"""How information travelled through a run: a backward search over its messages.

The log of a run has the times at which nodes took readings, and messages were sent and used. From a
node at an instant the search follows messages backwards and finds, for every other node, the latest
time up to which its information can have reached the first one. It is one pass over arrays of
messages, from the newest to the oldest.

What a message carries depends on the filter: all information of its sender for filters that combine
estimates; the reading of that instant for filters that send readings; and for filters that swap
states all information of the sender, which replaces that of the receiver.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from netkf.network.deliveries import MessageKey
from netkf.scenario.derived import DerivedScenario
from netkf.trace.messages import DELIVERED, MESSAGE, join_messages
from netkf.trace.schema import ABSORB, CRASH, JOIN, LEAVE, RESTART, SENSE, SWAP

IntArray = np.ndarray
Messages = np.recarray
"""The M messages of a log, FOLLOWED rows (M,) ordered by directed link and number."""
NEVER = -1
OUTCOMES = ("used", "lost", "late", "refused", "under way", "unused")
"""Outcome of a message at the end of a log. Late messages arrived after the exchange of their slot,
refused ones were too old for the filter, unused ones were replaced by another message of the same
instant, or their receiver went down before it used them.
"""
USED, LOST, LATE, REFUSED, UNDER_WAY, UNUSED = range(len(OUTCOMES))
SLEEPS, WAKES = frozenset((CRASH, LEAVE)), frozenset((RESTART, JOIN))
ENDS = (ABSORB, SWAP, CRASH, LEAVE)
"""Kinds of events after which nothing that arrived before waits at a node."""


FOLLOWED = np.dtype([*MESSAGE.descr, ("used_row", "i8")])
"""A MESSAGE whose ``outcome`` is an index of OUTCOMES, and which has ``ended`` if it arrived;
used_row: row of the log at which its receiver used what had arrived, NEVER if it did not in time.
"""


def message_keys(messages: np.ndarray) -> list[MessageKey]:
    """Return the identities of messages."""
    columns = (messages[name].tolist() for name in ("sender", "receiver", "number"))
    return list(map(MessageKey, *columns))


def match_messages(log: IntArray, swaps: bool, slotted: bool) -> Messages:
    """Return the M messages of an EVENT ``log`` (E,) that begins with the run.

    With ``swaps`` a receiver uses of an instant only the message of the sender with the largest id.
    A message with a ``late`` event was too late if the run is ``slotted``, else refused.
    """
    joined = join_messages(log)
    used_row = np.full(len(joined), NEVER)
    arrivals = np.flatnonzero(joined["outcome"] == DELIVERED)
    used_row[arrivals] = _next_use(log, joined["end_row"][arrivals])
    stopped = arrivals[np.isin(log["kind"][used_row[arrivals]], [CRASH, LEAVE])]
    # By outcome in the log: DELIVERED, LOST, LATE, UNDER_WAY.
    outcome = np.array([USED, LOST, LATE if slotted else REFUSED, UNDER_WAY])[joined["outcome"]]
    outcome[stopped] = UNUSED
    outcome[arrivals[used_row[arrivals] == NEVER]] = UNDER_WAY
    used_row[stopped] = NEVER
    if swaps:
        used = np.flatnonzero(outcome == USED)
        # A swap uses the last message of the sender with the largest id.
        order = used[np.lexsort((joined["sent_row"][used], joined["sender"][used], used_row[used]))]
        is_last = np.append(np.diff(used_row[order]) != 0, True)[: len(order)]
        outcome[order[~is_last]] = UNUSED
    messages = np.recarray(len(joined), dtype=FOLLOWED)
    for name in MESSAGE.names or ():
        messages[name] = joined[name]
    messages.outcome, messages.used_row = outcome, used_row
    messages.ended[outcome == LOST] = np.nan
    return messages


def _next_use(log: IntArray, rows: IntArray) -> IntArray:
    """Return the rows (K,) at which nodes use arrivals at ``rows``, or go down; NEVER without."""
    # One sorted search for all nodes: keys order the uses by node, then by row of the log. The
    # result may be a use by the following node, which the last line rejects.
    uses = np.flatnonzero(np.isin(log["kind"], ENDS))
    ids, length = np.unique(log["node"]), len(log) + 1
    keys = np.searchsorted(ids, log["node"][uses]) * length + uses
    order = np.argsort(keys)
    node = np.searchsorted(ids, log["node"][rows])
    position = np.searchsorted(keys[order], node * length + rows)
    next_row = np.append(uses[order], NEVER)[position]
    return np.where((next_row >= 0) & (log["node"][next_row] == log["node"][rows]), next_row, NEVER)


def at_once(messages: Messages, log: IntArray) -> Messages:
    """Return ``messages`` as if unused ones were used when they were sent: ``used_row`` differs.

    When they would have arrived is unknown; so ages found with these are lower bounds.
    """
    # The last row of the instant of sending.
    last = np.searchsorted(log["t"], messages.sent, side="right") - 1
    changed = messages.copy()
    changed.used_row = np.where(messages.outcome == USED, messages.used_row, last)
    return changed


def rows_until(scenario: DerivedScenario, log: IntArray, at: float) -> IntArray:
    """Return the rows of an EVENT ``log`` that influence the sample at ``at`` seconds."""
    if not scenario.slotted:
        return np.asarray(log[: np.searchsorted(log["t"], at, side="right")])
    plant = scenario.slot_plant
    slot = round(at / plant.period)
    # A sample of a predicting filter is before the events of its slot, a filtered one after them.
    end = plant.slot_time(slot if scenario.node_filter.timing.predicts else slot + 1)
    return np.asarray(log[: np.searchsorted(log["t"], end)])


@dataclass(frozen=True, eq=False)
class Flow:
    """The flow of information in a log: a graph of G segments joined by M messages.

    A segment is an interval of rows over which the information of one node accumulates: the whole
    run for filters that combine, from one swap to the next for filters that swap, and one instant
    for the readings that a message carries; nodes that forget begin a new one with each life.

    node, start    : (G,) node and first row of each segment
    origin, target : (M,) segments of the sender and of the receiver of each message
    cost           : (M,) 0 for messages that were used in the run, 1 for others
    last           : segment of each node at the end of the log, by node
    pooled         : one filter has the readings of all nodes
    """

    messages: Messages
    rows: int
    node: IntArray
    start: IntArray
    origin: IntArray
    target: IntArray
    cost: IntArray
    last: dict[int, int]
    pooled: bool = False


def find_flow(
    scenario: DerivedScenario, log: IntArray, messages: Messages, used: IntArray | None = None
) -> Flow:
    """Return the flow of information in an EVENT ``log`` (E,), for ``search_back``.

    ``used`` (M,) marks the messages of cost 0, those used in the original run, of which the log may
    be a replay (default: in this log); others cost 1, which counts the missing ones of a path.
    """
    used = np.asarray(messages.outcome == USED if used is None else used)
    analysis, pooled = scenario.node_filter.analysis, scenario.node_filter.timing.pooled
    nodes = np.array(scenario.nodes)
    # The first rows of segments: of the run, of lives of nodes that forget, and of swaps that took
    # place. A pooled filter is in no node.
    wakes = np.flatnonzero(np.isin(log["kind"], list(WAKES)))
    wakes = wakes[np.isin(log["node"][wakes], [] if pooled else scenario.forgetful_nodes)]
    swapped = np.flatnonzero(used & analysis.swaps)
    node = np.concatenate([nodes, log["node"][wakes], messages.receiver[swapped]])
    start = np.concatenate([np.zeros(len(nodes), np.int64), wakes, messages.used_row[swapped]])
    order = np.lexsort((start, node))
    node, start = node[order], start[order]
    # One sorted key for each segment: its node, then its first row.
    indices, length = np.searchsorted(nodes, node), len(log) + 1
    keys = indices * length + start

    def segment(segment_nodes: IntArray, row: IntArray) -> IntArray:
        sought_keys = np.searchsorted(nodes, segment_nodes) * length + row
        return np.asarray(np.searchsorted(keys, sought_keys, side="right") - 1)

    origin = segment(messages.sender, messages.sent_row)
    target = segment(messages.receiver, np.maximum(messages.used_row, 0))
    last = segment(nodes, np.full(len(nodes), len(log)))
    # Messages that carry the sender's reading and nothing else.
    phases = messages.phase.tolist()
    readings = np.array([not analysis.tells_estimates(phase) for phase in phases], dtype=bool)
    if readings.any():
        # A message that carries only the reading of its instant comes from a segment of its own,
        # which receives no messages. Nodes do not use those of before they began again.
        messages = messages.copy()
        messages.used_row[readings & (messages.sent_row < start[target])] = NEVER
        origin = np.where(readings, len(node) + np.arange(len(messages)), origin)
        node = np.concatenate([node, messages.sender])
        start = np.concatenate([start, np.searchsorted(log["t"], messages.sent, side="left")])
    ends = dict(zip(nodes.tolist(), last.tolist(), strict=True))
    return Flow(messages, len(log), node, start, origin, target, 1 - used, ends, pooled)


@dataclass(frozen=True, eq=False)
class BackwardSearch:
    """The result of a backward search from one node at the end of a log, for budgets b = 0 .. B:
    numbers of messages of cost 1 (not used in the run) that a path may take.

    deadline : (B + 1, G) row before which the information of a segment reaches the node if b
               messages of cost 1 are used; NEVER if it does not
    via      : (B + 1, G) first message on the path from the segment; NEVER at the node itself
    """

    flow: Flow
    deadline: IntArray
    via: IntArray

    def messages_from(self, segment: int, budget: int) -> list[int]:
        """Return the messages (indices) on the path from ``segment`` to the node, in the order of
        sending, if at most ``budget`` of them were not used in the run.
        """
        path: list[int] = []
        while self.via[budget, segment] != NEVER:
            message = int(self.via[budget, segment])
            path.append(message)
            budget -= int(self.flow.cost[message])
            segment = int(self.flow.target[message])
        return path

    def needed(self, messages: IntArray) -> IntArray:
        """Return how many unused messages each of ``messages`` (K,) needs, itself one, or NEVER."""
        # ``deadline`` is the row before which information has to be in a segment to reach the node.
        flow = self.flow
        used, cost = flow.messages.used_row[messages], flow.cost[messages]
        reaches = (used > NEVER) & (used < self.deadline[:, flow.target[messages]])
        count = reaches.argmax(axis=0) + cost
        return np.where(reaches.any(axis=0) & (count < len(self.deadline)), count, NEVER)


def search_back(flow: Flow, node: int, budget: int = 0) -> BackwardSearch:
    """Search from ``node`` (its id) at the end of the log backwards for the information that can
    have reached it, along used messages and at most ``budget`` others.
    """
    segments = len(flow.node)
    deadline = [[NEVER] * segments for _ in range(budget + 1)]
    via = [[NEVER] * segments for _ in range(budget + 1)]
    for layer in deadline:
        # The estimate at the end of the log has all that its segment then has.
        for segment in flow.last.values() if flow.pooled else (flow.last[node],):
            layer[segment] = flow.rows
    usable = np.flatnonzero((flow.messages.used_row != NEVER) & (flow.cost <= budget))
    order = usable[np.argsort(-flow.messages.used_row[usable], kind="stable")]
    columns = (flow.messages.used_row, flow.messages.sent_row, flow.origin, flow.target, flow.cost)
    rows = zip(order.tolist(), *(column[order].tolist() for column in columns), strict=True)
    # In decreasing order of use, one pass suffices: a message that sets a segment's deadline is
    # used after it was sent, hence processed before any message that is used by that deadline.
    for message, used, sent, origin, target, cost in rows:
        for b in range(cost, budget + 1):
            if used < deadline[b - cost][target] and sent > deadline[b][origin]:
                deadline[b][origin], via[b][origin] = sent, message
    return BackwardSearch(flow, np.array(deadline), np.array(via))


class KeptReadings:
    """The times at which the nodes of a log took readings, by row.

    ``log`` (E,) are the EVENT rows that influence a sample at ``at`` seconds.
    """

    def __init__(self, scenario: DerivedScenario, log: IntArray, at: float) -> None:
        self._scenario, self._times, self._at = scenario, log["t"], at
        sensed = np.flatnonzero(log["kind"] == SENSE)
        self._changes: dict[int, list[tuple[int, int]]] = {}
        for row in np.flatnonzero(np.isin(log["kind"], (*SLEEPS, *WAKES))).tolist():
            self._changes.setdefault(int(log["node"][row]), []).append((row, int(log["kind"][row])))
        # Sorted by node: the rows of a node are neighbours, in their order.
        nodes = log["node"][sensed]
        order = np.argsort(nodes, kind="stable")
        sensed, nodes = sensed[order], nodes[order]
        sensing = np.array(list(scenario.sensing_nodes), dtype=nodes.dtype)
        starts, ends = (np.searchsorted(nodes, sensing, side) for side in ("left", "right"))
        self._rows = {
            node: self._with_values(node, sensed[start:end])
            for node, start, end in zip(scenario.sensing_nodes, starts, ends, strict=True)
        }

    def _with_values(self, node: int, rows: IntArray) -> IntArray:
        """Return those of the sense ``rows`` of ``node`` whose recorded sensors have a row."""
        scenario = self._scenario
        sensors = [scenario.sensors[position.entry] for position in scenario.placed_sensors[node]]
        records = [sensor.record for sensor in sensors]
        if not scenario.slotted or None in records:
            return rows
        plant = scenario.slot_plant
        read = [slot for record in records for slot in record.slots(node, plant.period)]
        return rows[np.isin(plant.slots_of(self._times[rows]), read)]

    def newest(self, node: int, start: int, end: int) -> float:
        """Return the time (s) of the newest reading of ``node`` in rows ``start`` to ``end``."""
        if node not in self._rows:
            return np.nan
        if node in self._scenario.increment_sensors:
            # Continuous readings are used up to the event at the end of the rows, or to the crash.
            time = float(self._times[end]) if end < len(self._times) else self._at
            return self._last_up(node, start, end, time)
        rows = self._rows[node]
        k = int(np.searchsorted(rows, end)) - 1
        return self.reading_time(int(rows[k])) if k >= 0 and rows[k] >= start else np.nan

    def _last_up(self, node: int, start: int, end: int, time: float) -> float:
        """Return when ``node`` was up last in rows ``start`` to ``end``, which is at ``time`` s."""
        changes = self._changes.get(node, [])
        k = bisect.bisect_left(changes, (end, 0)) - 1
        if k < 0:
            return np.nan if changes and changes[0][1] in WAKES else time
        row, kind = changes[k]
        if kind in WAKES:
            return time
        return float(self._times[row]) if row >= start else np.nan

    def reading_time(self, row: int) -> float:
        """Return the time (s) at which the reading used at ``row`` was taken."""
        time = float(self._times[row])
        if not self._scenario.slotted:
            return time
        # Readings are taken at the start of a slot. A filter may use them after exchanges of that
        # slot, and the log has the time of use.
        plant = self._scenario.slot_plant
        return plant.slot_time(int(plant.slots_of(np.array([time]))[0]))


class Newest(NamedTuple):
    """The newest information of a node that reached another.

    reading : time in seconds of its newest reading, nan without one
    known   : last time in seconds up to which its information is included, nan if to the end
    segment : index of the segment from which it came
    """

    reading: float
    known: float
    segment: int


def newest_information(
    reach: BackwardSearch, log: IntArray, readings: KeptReadings, budget: int
) -> dict[int, Newest]:
    """Return the newest information of each node that can have reached that of ``reach``."""
    flow, newest = reach.flow, dict[int, Newest]()
    # Information that was in a segment (an interval of rows in which that of one node accumulates)
    # before the row ``deadline`` reaches the node; NEVER if none does.
    deadline = reach.deadline[budget]
    for segment in np.flatnonzero(deadline != NEVER).tolist():
        node, end = int(flow.node[segment]), int(deadline[segment])
        reading = readings.newest(node, int(flow.start[segment]), end)
        known_until = float(log["t"][end]) if end < len(log) else np.nan
        previous = newest.get(node)
        if previous is None or _age_key(reading, known_until) > _age_key(
            previous.reading, previous.known
        ):
            newest[node] = Newest(reading, known_until, segment)
    return newest


def _age_key(reading: float, known: float) -> tuple[float, float]:
    """Sort key, oldest first: time of the newest reading, then time up to which it is known."""
    return -np.inf if np.isnan(reading) else reading, np.inf if np.isnan(known) else known


def route(reach: BackwardSearch, segment: int, budget: int) -> tuple[int, ...]:
    """Return the ids of the nodes on the way of information of ``segment`` to the node."""
    path: Iterable[int] = reach.messages_from(segment, budget)
    return (int(reach.flow.node[segment]), *[int(reach.flow.messages.receiver[m]) for m in path])
