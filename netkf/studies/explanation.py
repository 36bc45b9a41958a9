"""The explanation of the estimate of a node at an instant, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

from netkf.network.deliveries import MessageKey
from netkf.studies.message_sets import SmallestSet

GOOD_ENOUGH = 0.05
"""By default a set of messages suffices if it brings the trace of P to at most 1 + GOOD_ENOUGH
times that of the run with every message delivered.
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
    """The information of one ``node``, the source, that had reached the node asked about. Times are
    in seconds, nan if unknown.

    sensor          the source has a sensor
    neighbour       the source can send to the node asked about directly
    heard, arrived  when the last used message from the source was sent, and when it arrived
    unheard         number of messages from the source sent since then and not used
    known           last time up to which information of the source can have arrived, on any path
    reading         time of its newest reading whose information can have arrived
    route           ids of the nodes on the path of its newest information, the source first
    with_more       times of its newest reading with at most 1, 2, ... missing messages delivered
    without_losses  time of its newest reading with every message delivered
    missing         the fewest missing messages that would have brought a newer reading; empty if
                    there is none, or if more would be needed than the search allowed
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
    """A replay with the missing ``messages`` delivered, or all messages for None: the trace of P at
    the node, and the length of its error (nan without a known truth).
    """

    label: str
    messages: tuple[MessageKey, ...] | None
    trace: float
    error: float


@dataclass(frozen=True, eq=False, repr=False)
class Explanation:
    """The explanation of the estimate of ``node`` at ``at`` seconds in one run of a scenario.

    ``trace`` is that of its covariance P and ``error`` the length of its error. ``sources`` has the
    information that had reached it from each node, ``what_ifs`` P and error in replays, the run as
    it was first, and ``smallest`` the smallest set of missing messages that would have sufficed
    (None if the filter gives no P). ``missing`` has all messages that were not used, by their
    identity, and ``notes`` sentences on the limits of the replays.
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
