"""What became of the messages and the nodes of one run: matrices of delivery and of shared fate,
losses over time, when nodes were down; and counts of messages and transmissions: a broadcast sends
several messages in one transmission.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.lives import lifetimes
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.messages import DELIVERED, UNDER_WAY
from netkf.trace.recorder import Sink
from netkf.trace.schema import SEND, TRANSMIT


class Downtime(NamedTuple):
    """A node (id) is down from ``begin`` to ``end`` (seconds, inf: to the end of the run), since it
    made an event of this ``kind``; "" if it was down from the beginning.
    """

    node: int
    begin: float
    end: float
    kind: str


def downtimes(scenario: Scenario, seed: int, replica: int) -> list[Downtime]:
    """Return when the nodes of a run are down, ordered by node and time."""
    found = []
    for node, life in sorted(lifetimes(scenario, Streams(seed, replica)).items()):
        begin, kind = (math.nan, "") if life.up else (0.0, "")
        for change in life.changes:
            if change.up:
                found.append(Downtime(node, begin, change.time, kind))
                begin = math.nan
            else:
                begin, kind = change.time, change.kind
        if not math.isnan(begin):
            found.append(Downtime(node, begin, math.inf, kind))
    return found


class Outcomes(NamedTuple):
    """The M messages of a run with an outcome: index of ``sender`` and ``receiver`` (M,), ``sent``
    (M,) in seconds, ``phase`` (M,), and ``heard`` (M,) bool.
    """

    sender: np.ndarray
    receiver: np.ndarray
    sent: FloatArray
    phase: np.ndarray
    heard: np.ndarray


def outcomes_of(messages: np.ndarray, nodes: Sequence[int]) -> Outcomes:
    """Return those of the MESSAGE rows (M,) that were heard, lost or late."""
    messages = messages[messages["outcome"] != UNDER_WAY]
    return Outcomes(
        sender=np.searchsorted(nodes, messages["sender"]),
        receiver=np.searchsorted(nodes, messages["receiver"]),
        sent=messages["sent"],
        phase=messages["phase"],
        heard=messages["outcome"] == DELIVERED,
    )


def delivery_matrix(outcomes: Outcomes, size: int) -> FloatArray:
    """Return the share heard of messages from i to j, (N, N), nan where none was sent."""
    code = outcomes.sender * size + outcomes.receiver
    sent, heard = (
        np.bincount(code, weights, size * size).reshape(size, size)
        for weights in (np.ones(len(code)), outcomes.heard)
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(heard / sent)


def fate_matrix(outcomes: Outcomes, size: int) -> FloatArray:
    """Return the correlation of outcomes of hearers i and j of a broadcast, (N, N), about the means
    of links; nan on the diagonal and where unknown.
    """
    gap = outcomes.heard - delivery_matrix(outcomes, size)[outcomes.sender, outcomes.receiver]
    order = np.lexsort((outcomes.receiver, outcomes.phase, outcomes.sent, outcomes.sender))
    sender, sent, phase = (a[order] for a in (outcomes.sender, outcomes.sent, outcomes.phase))
    again = (np.diff(sender) == 0) & (np.diff(sent) == 0) & (np.diff(phase) == 0)
    # Messages that no other node could hear are most of a network of links, and say nothing here.
    shared = np.append(False, again) | np.append(again, False) if len(order) else again
    number = np.cumsum(np.append(0, ~again))[: len(order)]
    broadcast, row = np.unique(number[shared], return_inverse=True)
    gaps = np.zeros((len(broadcast), size))
    is_hearer = np.zeros_like(gaps)
    gaps[row, outcomes.receiver[order][shared]] = gap[order][shared]
    is_hearer[row, outcomes.receiver[order][shared]] = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        # Sums over the broadcasts that both may hear.
        squares = (gaps**2).T @ is_hearer
        correlation = (gaps.T @ gaps) / np.sqrt(squares * squares.T)
    fates = np.where(is_hearer.T @ is_hearer > 0.0, correlation, math.nan)
    np.fill_diagonal(fates, math.nan)
    return fates


def loss_windows(
    outcomes: Outcomes, size: int, edges: FloatArray
) -> tuple[list[tuple[int, int]], FloatArray]:
    """Return links that sent, and shares lost (L, B) between ``edges`` (B + 1,) s, or nan."""
    codes, link = np.unique(outcomes.sender * size + outcomes.receiver, return_inverse=True)
    bins = np.clip(np.searchsorted(edges, outcomes.sent, side="right") - 1, 0, len(edges) - 2)
    cell, count = link * (len(edges) - 1) + bins, len(codes) * (len(edges) - 1)
    sent, lost = (np.bincount(cell, w, count) for w in (np.ones(len(cell)), ~outcomes.heard))
    links = [divmod(code, size) for code in codes.tolist()]
    with np.errstate(invalid="ignore"):
        return links, (lost / sent).reshape(len(codes), -1)


MAX_BLOCKS = 8
"""Blocks of pairs that are kept before they are merged."""


class PairCounter:
    """Counts how often each pair of whole numbers has occurred."""

    def __init__(self) -> None:
        self._blocks: list[tuple[np.ndarray, ...]] = []

    def add(self, first: np.ndarray, second: np.ndarray) -> None:
        """Count the pairs of ``first`` (K,) and ``second`` (K,)."""
        if not len(first):
            return
        self._blocks.append(count_pairs(first, second))
        # What is merged doubles from one time to the next, so that each pair is merged seldom.
        lengths = [len(block[0]) for block in self._blocks]
        if len(lengths) > MAX_BLOCKS and 2 * lengths[0] < sum(lengths):
            self._merge()

    def counts(self) -> dict[tuple[int, int], int]:
        """Return the number of occurrences of each pair, sorted."""
        if not self._blocks:
            return {}
        self._merge()
        first, second, counts = (column.tolist() for column in self._blocks[0])
        return dict(zip(zip(first, second, strict=True), counts, strict=True))

    @property
    def total(self) -> int:
        """Number of occurrences of all pairs."""
        return sum(int(block[2].sum()) for block in self._blocks)

    def _merge(self) -> None:
        first, second, counts = map(np.concatenate, zip(*self._blocks, strict=True))
        order = np.lexsort((second, first))
        first, second = first[order], second[order]
        new = (first[1:] != first[:-1]) | (second[1:] != second[:-1])
        at = np.flatnonzero(np.append(True, new))
        self._blocks = [(first[at], second[at], np.add.reduceat(counts[order], at))]


class Transmissions:
    """Counts the messages and the transmissions of each node in blocks of EVENT rows.

    In continuous time a broadcast has a ``transmit`` row; without such rows every message is a
    transmission by itself. In slots all messages of a node in one step of an exchange are one
    transmission. All are counted by node and phase, which is -1 under clocks.
    """

    def __init__(self) -> None:
        self._messages, self._broadcasts, self._slots = (PairCounter() for _ in range(3))
        # The last (time, phase) of the rows counted so far, and the nodes that sent in it.
        self._step: tuple[float, int] = (np.nan, -1)
        self._senders = np.zeros(0, dtype=np.int64)

    def add(self, rows: np.ndarray) -> None:
        """Count the next block ``rows`` (E,) of EVENT rows, in the order of the run."""
        is_send, is_transmit = (rows["kind"] == kind for kind in (SEND, TRANSMIT))
        node, t, phase = (rows[name][is_send] for name in ("node", "t", "phase"))
        self._messages.add(node, phase)
        self._broadcasts.add(rows["node"][is_transmit], rows["phase"][is_transmit])
        in_slots = phase >= 0
        self._add_slot_messages(node[in_slots], t[in_slots], phase[in_slots])

    def _add_slot_messages(self, node: np.ndarray, t: np.ndarray, phase: np.ndarray) -> None:
        """Count the transmissions of ``send`` rows of slots, of which these are columns (K,)."""
        if not len(node):
            return
        begins = np.append(True, (t[1:] != t[:-1]) | (phase[1:] != phase[:-1]))
        step = np.cumsum(begins) - 1
        phases = phase[begins]
        # Each pair of step and sender once.
        step, node, _ = count_pairs(step, node)
        # The first step may have begun in the block before.
        seen = self._senders if (float(t[0]), int(phase[0])) == self._step else node[:0]
        repeated = (step == 0) & np.isin(node, seen)
        self._slots.add(node[~repeated], phases[step[~repeated]])
        self._senders = np.append(node[step == step[-1]], seen if not step[-1] else node[:0])
        self._step = float(t[-1]), int(phase[-1])

    def sent(self, nodes: Sequence[int]) -> list[int]:
        """Return the number of messages of each of ``nodes``."""
        return _sums(nodes, self._messages.counts())

    def transmissions(self, nodes: Sequence[int]) -> list[int]:
        """Return the number of transmissions of each of ``nodes``."""
        return _sums(nodes, self._transmissions)

    def by_phase(self, nodes: Sequence[int]) -> Iterator[tuple[int, list[int]]]:
        """Yield each exchange of the slot, -1 under clocks, and the transmissions of ``nodes``."""
        counts = self._transmissions
        for phase in sorted({phase for _, phase in counts}):
            yield phase, [counts.get((node, phase), 0) for node in nodes]

    @property
    def _transmissions(self) -> dict[tuple[int, int], int]:
        under_clocks = self._broadcasts if self._broadcasts.total else self._messages
        counts = {pair: count for pair, count in under_clocks.counts().items() if pair[1] < 0}
        return self._slots.counts() | counts


def _sums(nodes: Sequence[int], counts: Mapping[tuple[int, int], int]) -> list[int]:
    sums: Counter[int] = Counter()
    for (node, _), count in counts.items():
        sums[node] += count
    return [sums[node] for node in nodes]


class SentPerLink(Sink):
    """Counts the messages that were sent over each directed link, lost ones included."""

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.sent = PairCounter()

    def events(self, rows: np.ndarray) -> None:
        """Count the messages in a block ``rows`` (E,) of EVENT rows, in ``sent``."""
        is_send = rows["kind"] == SEND
        self.sent.add(rows["node"][is_send], rows["peer"][is_send])

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Ignore samples; only events are counted."""


def count_pairs(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the P distinct pairs of ``first`` and ``second``, sorted, and their counts (P,)."""
    if not len(first):
        return first, second, first
    (least, low), span = (first.min(), second.min()), int(np.ptp(second)) + 1
    if int(np.ptp(first)) >= 2**62 // span:
        pairs, counts = np.unique(np.column_stack([first, second]), axis=0, return_counts=True)
        return pairs[:, 0], pairs[:, 1], counts
    # One number a pair, unless ids are too large: pairs take a hundred times as long to sort.
    codes = (first - least) * span + (second - low)
    if int(np.ptp(first)) * span <= len(codes):
        counts = np.bincount(codes)
        codes = np.flatnonzero(counts)
        counts = counts[codes]
    else:
        # Rows of events are nearly in order, which stable sorting uses: np.unique takes thrice as
        # long.
        codes = np.sort(codes, kind="stable")
        begins = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
        counts = np.diff(np.append(begins, len(codes)))
        codes = codes[begins]
    return codes // span + least, codes % span + low, counts
