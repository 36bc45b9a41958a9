"""What an explanation says about a node at an instant, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

from netkf.network.deliveries import MessageKey
from netkf.studies.message_sets import SmallestSet

GOOD_ENOUGH = 0.05
"""By default a set is good enough if it brings the trace of P as close as that, relatively, to the
one of the run in which every message came.
"""


@dataclass(frozen=True)
class Missing:
    """A message that was sent but not used: its ``outcome`` (of OUTCOMES), and when it was ``sent``
    and ``arrived`` (seconds, nan if it did not).
    """

    key: MessageKey
    outcome: str
    sent: float
    arrived: float

    def __str__(self) -> str:
        sender, receiver, count = self.key
        return f"{sender} -> {receiver} number {count} ({self.outcome}, sent at {self.sent:.6g} s)"


@dataclass(frozen=True)
class InformationSource:
    """What had reached the node from one other, ``node``. Times are in seconds, nan if unknown.

    neighbour       it can send to the node directly
    heard, arrived  when the last message from it that was used was sent, and arrived
    unheard         messages from it that were sent since then and not used
    known           the last moment whose knowledge can have reached the node, over any way
    reading         its newest reading whose information can have reached the node
    route           the nodes on the way of that, this one first
    with_more       its newest reading that could have come with at most 1, 2, .. more messages
    without_losses  its newest reading that could have come if every message had
    missing         the fewest messages that had to come for a newer reading, of up to MAX_MISSING
    """

    node: int
    sensor: bool
    neighbour: bool
    heard: float
    arrived: float
    unheard: int
    known: float
    reading: float
    route: tuple[int, ...]
    with_more: tuple[float, ...]
    without_losses: float
    missing: tuple[Missing, ...]


@dataclass(frozen=True)
class WhatIf:
    """A replay in which ``messages`` came, or all where that is None: the trace of P at the node,
    and the length of its error (nan without a known truth).
    """

    label: str
    messages: tuple[MessageKey, ...] | None
    trace: float
    error: float


@dataclass(frozen=True, eq=False, repr=False)
class Explanation:
    """Why ``node`` knew at ``at`` seconds what it knew, in one run of a scenario.

    ``trace`` is that of its covariance P and ``error`` the length of its error. ``sources`` tells
    what had reached it from whom, ``what_ifs`` what P would have been in replays, the run as it was
    first, and ``smallest`` which messages would have sufficed (None if the filter gives no P).
    """

    scenario: str
    node: int
    at: float
    seed: int
    replica: int
    sources: tuple[InformationSource, ...]
    what_ifs: tuple[WhatIf, ...]
    smallest: SmallestSet | None
    missing: dict[MessageKey, Missing] = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def trace(self) -> float:
        """The trace of P at the node."""
        return self.what_ifs[0].trace

    @property
    def error(self) -> float:
        """The length of x - xhat at the node, nan without a known truth."""
        return self.what_ifs[0].error
