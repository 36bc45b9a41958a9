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

    In continuous time a broadcast has a ``transmit`` row; without such rows every message is a
    transmission by itself. In slots all messages of a node in one step of an exchange are one
    transmission.

    ``sent`` has the number of messages of each node.
    """

    def __init__(self) -> None:
        self.sent: Counter[int] = Counter()
        self._broadcasts: Counter[int] = Counter()
        self._slot_transmissions: Counter[int] = Counter()
        self._clock_messages: Counter[int] = Counter()
        # The last (time, phase) of the rows counted so far, and the nodes that sent in it.
        self._step: tuple[float, int] = (np.nan, -1)
        self._senders: set[int] = set()

    def add(self, rows: np.ndarray) -> None:
        """Count the next block ``rows`` (E,) of EVENT rows; blocks must come in the order of the
        run.
        """
        sends = rows[rows["kind"] == SEND]
        _add_counts(self.sent, sends["node"])
        _add_counts(self._broadcasts, rows["node"][rows["kind"] == TRANSMIT])
        in_slots = sends["phase"] >= 0
        _add_counts(self._clock_messages, sends["node"][~in_slots])
        self._add_slot_messages(sends[in_slots])

    def _add_slot_messages(self, sends: np.ndarray) -> None:
        """Count the transmissions in ``sends`` (K,), the ``send`` rows of slots."""
        if not len(sends):
            return
        t, phase = sends["t"], sends["phase"]
        step = np.cumsum(np.append(False, (t[1:] != t[:-1]) | (phase[1:] != phase[:-1])))
        # Each pair of step and sender once.
        order = np.lexsort((sends["node"], step))
        step, node = step[order], sends["node"][order]
        is_new = np.append(True, (step[1:] != step[:-1]) | (node[1:] != node[:-1]))
        step, node = step[is_new], node[is_new]
        # The first step may have begun in the block before.
        seen = self._senders if (float(t[0]), int(phase[0])) == self._step else set()
        repeated = [sender in seen for sender in node[step == 0].tolist()]
        _add_counts(self._slot_transmissions, np.delete(node, np.flatnonzero(repeated)))
        self._senders = {*node[step == step[-1]].tolist(), *(seen if not step[-1] else ())}
        self._step = float(t[-1]), int(phase[-1])

    def count_for(self, node: int) -> int:
        """Return the number of transmissions of a node."""
        return self._slot_transmissions[node] + self._clock_transmissions[node]

    @property
    def total(self) -> int:
        """Number of transmissions of all nodes."""
        return self._slot_transmissions.total() + self._clock_transmissions.total()

    @property
    def _clock_transmissions(self) -> Counter[int]:
        return self._broadcasts if self._broadcasts else self._clock_messages


class SentPerLink(Sink):
    """Counts the messages that were sent over each directed link, lost ones included."""

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.sent: Counter[Link] = Counter()

    def events(self, rows: np.ndarray) -> None:
        """Count the messages in a block ``rows`` (E,) of EVENT rows, in ``sent``."""
        sends = rows[rows["kind"] == SEND]
        ends = np.column_stack([sends["node"], sends["peer"]])
        pairs, counts = np.unique(ends, axis=0, return_counts=True)
        for (i, j), count in zip(pairs.tolist(), counts.tolist(), strict=True):
            self.sent[i, j] += count

    def states(
        self, t: FloatArray, x: FloatArray, xhat: FloatArray, P: FloatArray, error: FloatArray
    ) -> None:
        """Ignore samples; only events are counted."""


def _add_counts(counter: Counter[int], nodes: np.ndarray) -> None:
    """Add to ``counter``, in place, how often each node id occurs in ``nodes`` (K,)."""
    distinct, counts = np.unique(nodes, return_counts=True)
    for node, count in zip(distinct.tolist(), counts.tolist(), strict=True):
        counter[node] += count
