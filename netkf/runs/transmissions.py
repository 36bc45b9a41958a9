"""Counts of messages and transmissions: a broadcast sends several messages in one transmission."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
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

    ``sent`` has the number of messages of each node; transmissions are counted by node and phase,
    which is -1 under clocks.
    """

    def __init__(self) -> None:
        self.sent: Counter[int] = Counter()
        self._broadcasts: Counter[tuple[int, int]] = Counter()
        self._slot_transmissions: Counter[tuple[int, int]] = Counter()
        self._clock_messages: Counter[tuple[int, int]] = Counter()
        # The last (time, phase) of the rows counted so far, and the nodes that sent in it.
        self._step: tuple[float, int] = (np.nan, -1)
        self._senders: set[int] = set()
        self._phases: set[int] = set()

    def add(self, rows: np.ndarray) -> None:
        """Count the next block ``rows`` (E,) of EVENT rows, in the order of the run."""
        is_send = rows["kind"] == SEND
        node, t, phase = (rows[name][is_send] for name in ("node", "t", "phase"))
        for sender, count in zip(
            *(a.tolist() for a in np.unique(node, return_counts=True)), strict=True
        ):
            self.sent[sender] += count
        _add_counts(self._broadcasts, rows["node"][rows["kind"] == TRANSMIT])
        in_slots = phase >= 0
        _add_counts(self._clock_messages, node[~in_slots])
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
        seen = self._senders if (float(t[0]), int(phase[0])) == self._step else set()
        repeated = [sender in seen for sender in node[step == 0].tolist()]
        once = np.delete(np.arange(len(node)), np.flatnonzero(repeated))
        _add_counts(self._slot_transmissions, node[once], phases[step[once]])
        self._phases.update(phases.tolist())
        self._senders = {*node[step == step[-1]].tolist(), *(seen if not step[-1] else ())}
        self._step = float(t[-1]), int(phase[-1])

    def count_for(self, node: int) -> int:
        """Return the number of transmissions of a node."""
        return sum(counter[node, phase] for phase, counter in self._counters)

    def by_phase(self, nodes: Sequence[int]) -> Iterator[tuple[int, list[int]]]:
        """Yield each exchange of the slot, -1 under clocks, and the transmissions of ``nodes``."""
        for phase, counter in self._counters:
            yield phase, [counter[node, phase] for node in nodes]

    @property
    def total(self) -> int:
        """Number of transmissions of all nodes."""
        return self._slot_transmissions.total() + self._clock_transmissions.total()

    @property
    def _counters(self) -> list[tuple[int, Counter[tuple[int, int]]]]:
        in_slots = [(phase, self._slot_transmissions) for phase in sorted(self._phases)]
        return [*in_slots, (-1, self._clock_transmissions)]

    @property
    def _clock_transmissions(self) -> Counter[tuple[int, int]]:
        return self._broadcasts or self._clock_messages


class SentPerLink(Sink):
    """Counts the messages that were sent over each directed link, lost ones included."""

    thread_safe: ClassVar[bool] = True

    def __init__(self) -> None:
        self.sent: Counter[Link] = Counter()

    def events(self, rows: np.ndarray) -> None:
        """Count the messages in a block ``rows`` (E,) of EVENT rows, in ``sent``."""
        is_send = rows["kind"] == SEND
        pairs = count_pairs(rows["node"][is_send], rows["peer"][is_send])
        for i, j, count in zip(*(column.tolist() for column in pairs), strict=True):
            self.sent[i, j] += count

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
    codes, counts = np.unique((first - least) * span + (second - low), return_counts=True)
    return codes // span + least, codes % span + low, counts


def _add_counts(
    counter: Counter[tuple[int, int]], nodes: np.ndarray, phases: np.ndarray | None = None
) -> None:
    """Add to ``counter``, in place, how often each pair of ``nodes`` and ``phases`` (K,) occurs."""
    phases = np.full(len(nodes), -1) if phases is None else phases
    for node, phase, count in zip(*(a.tolist() for a in count_pairs(nodes, phases)), strict=True):
        counter[node, phase] += count
