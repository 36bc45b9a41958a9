"""Counts of messages and transmissions: a broadcast sends several messages in one transmission."""

from __future__ import annotations

from collections import Counter
from typing import ClassVar

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Link
from netkf.trace.recorder import Sink
from netkf.trace.schema import CODES, KINDS

SEND = CODES["send"]
TRANSMIT = KINDS.index("transmit")


class Transmissions:
    """Counts the messages and the transmissions of each node in blocks of EVENT rows.

    Under clocks a broadcast has a ``transmit`` row; without such rows every message is a
    transmission of its own. In slots all messages of a node in one step of an exchange are one
    transmission.
    """

    def __init__(self) -> None:
        self.sent: Counter[int] = Counter()
        self._broadcasts: Counter[int] = Counter()
        self._in_slots: Counter[int] = Counter()
        self._under_clocks: Counter[int] = Counter()
        self._step: tuple[float, int] = (np.nan, -1)
        self._senders: set[int] = set()

    def add(self, rows: np.ndarray) -> None:
        """Count the next block of EVENT rows; blocks come in the order of the run."""
        sends = rows[rows["kind"] == SEND]
        _add_counts(self.sent, sends["node"])
        _add_counts(self._broadcasts, rows["node"][rows["kind"] == TRANSMIT])
        in_slots = sends["phase"] >= 0
        _add_counts(self._under_clocks, sends["node"][~in_slots])
        self._add_slots(sends[in_slots])

    def _add_slots(self, sends: np.ndarray) -> None:
        """Count senders of each step; a step that continues from the last block is counted once."""
        if not len(sends):
            return
        t, phase = sends["t"], sends["phase"]
        begins = np.flatnonzero((t[1:] != t[:-1]) | (phase[1:] != phase[:-1])) + 1
        ends = [0, *begins.tolist(), len(sends)]
        first, last = sends["node"][: ends[1]], sends["node"][ends[-2] :]
        if (float(t[0]), int(phase[0])) != self._step:
            self._senders = set()
        distinct = set(first.tolist())
        self._in_slots.update(distinct - self._senders)
        step = np.zeros(len(sends), dtype=np.int64)
        step[begins] = 1
        nodes, index = np.unique(sends["node"], return_inverse=True)
        pairs = np.unique(np.cumsum(step) * len(nodes) + index)  # (step, sender), once each
        _add_counts(self._in_slots, nodes[pairs[pairs >= len(nodes)] % len(nodes)])
        single = len(ends) == 2
        self._senders = self._senders | distinct if single else set(last.tolist())
        self._step = float(t[-1]), int(phase[-1])

    def of(self, node: int) -> int:
        """Return the number of transmissions of a node."""
        clocks = self._broadcasts if self._broadcasts else self._under_clocks
        return self._in_slots[node] + clocks[node]

    @property
    def total(self) -> int:
        """Number of transmissions of all nodes."""
        clocks = self._broadcasts if self._broadcasts else self._under_clocks
        return self._in_slots.total() + clocks.total()


class SentPerLink(Sink):
    """Counts the messages that were sent over each directed link, lost ones included."""

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.sent: Counter[Link] = Counter()

    def events(self, rows: np.ndarray) -> None:
        """Count the messages of a block of EVENT rows."""
        sends = rows[rows["kind"] == SEND]
        ends = np.column_stack([sends["node"], sends["peer"]])
        pairs, counts = np.unique(ends, axis=0, return_counts=True)
        for (i, j), count in zip(pairs.tolist(), counts.tolist(), strict=True):
            self.sent[i, j] += count

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Ignore samples."""


def _add_counts(counter: Counter[int], nodes: np.ndarray) -> None:
    """Add how often each node occurs."""
    found, counts = np.unique(nodes, return_counts=True)
    for node, count in zip(found.tolist(), counts.tolist(), strict=True):
        counter[node] += count
