"""Losses and delays read from tables, message by message."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from netkf.core.csv_files import read_columns, whole
from netkf.core.errors import ScenarioError
from netkf.core.fields import SourceFile, choice, field, source_file
from netkf.network.channels import Delay, Loss
from netkf.network.graphs import Link, Topology, demand_links

AFTER = ("deliver", "lose", "repeat", "refuse")
"""What may happen to a message that a record does not list."""

_after = choice(*AFTER)


class MessageUse(NamedTuple):
    """How a record of messages and the messages of a run meet: ``rows`` in the table, ``unused``
    rows, and messages ``beyond`` the record.
    """

    rows: int
    unused: int
    beyond: int


@dataclass(frozen=True)
class MessageTable:
    """One value for each listed message of each directed link."""

    source: SourceFile
    values: Mapping[Link, Mapping[int, float]]

    @cached_property
    def _lengths(self) -> dict[Link, int]:
        return {link: 1 + max(listed) for link, listed in self.values.items()}

    def value(self, link: Link, message: int, after: str) -> float | None:
        """The value of a message; None if the record does not list it.

        With ``after`` "repeat" the table of the link starts again after its largest number. With
        "refuse" raises ScenarioError at "path" for a message that is not listed.
        """
        listed = self.values.get(link, {})
        if after == "repeat" and listed:
            message %= self._lengths[link]
        value = listed.get(message)
        if value is None and after == "refuse":
            raise ScenarioError(
                "path",
                f"{self.source.name} must list every message that is sent, "
                'because after = "refuse"',
                f"message {message} from node {link[0]} to node {link[1]}",
                "add the row, shorten the horizon or change after",
            )
        return value

    def use(self, sent: Mapping[Link, int]) -> MessageUse:
        """What ``sent`` messages of each directed link, numbered from 0, use of the table."""
        rows = sum(map(len, self.values.values()))
        used = sum(
            number < count for link, count in sent.items() for number in self.values.get(link, ())
        )
        return MessageUse(rows, rows - used, sum(sent.values()) - used)


def read_messages(
    source: SourceFile, column: str, words: str, allowed: Callable[[float], bool]
) -> MessageTable:
    """The table of a file ``sender,receiver,message,COLUMN`` whose values are ``allowed``; a
    message may be listed again with the same value.
    """
    names = ("sender", "receiver", "message")
    table = read_columns(source, (*names, column))
    keys = zip(*(whole(source, name, table[name]) for name in names), strict=True)
    values: dict[Link, dict[int, float]] = {}
    for (sender, receiver, message), value in zip(keys, table[column].tolist(), strict=True):
        listed = values.setdefault((sender, receiver), {})
        if not allowed(value) or listed.setdefault(message, value) != value:
            shown = int(value) if value.is_integer() else value
            row = [sender, receiver, message, shown]
            raise ScenarioError("path", f"{source.name}: {words}", row, "mend the row")
    return MessageTable(source, values)


@dataclass(frozen=True, eq=False)
class RecordedLoss(Loss):
    """Outcomes read from a table ``sender,receiver,message,delivered`` (0 or 1, messages of a
    directed link counted from 0). ``after`` says what becomes of a message that is not listed.
    """

    path: SourceFile = field(source_file)
    after: str = field(_after, default="deliver")

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.table  # a bad file is refused now

    @cached_property
    def table(self) -> MessageTable:
        """1 for each listed message that is delivered, else 0."""
        words = "delivered must be 0 or 1, one value a message"
        return read_messages(self.path, "delivered", words, lambda value: value in (0.0, 1.0))

    @property
    def deterministic(self) -> bool:
        """True."""
        return True

    def delivery_probability(
        self, link: Link, message: int, bad: bool, table_probability: float
    ) -> float:
        """0 or 1."""
        value = _at("network.channel.loss", self.table, link, message, self.after)
        if value is None:
            return 0.0 if self.after == "lose" else 1.0
        return value

    def mean_delivery(self, link: Link, table_probability: float) -> float:
        """Not known beforehand."""
        return math.nan

    @property
    def independent(self) -> bool:
        """A record is one outcome, not a law."""
        return False

    def check(self, topology: Topology) -> None:
        """Every recorded pair is a link."""
        demand_links(self.path, self.table.values, topology)


@dataclass(frozen=True, eq=False)
class RecordedDelay(Delay):
    """Delays read from a table ``sender,receiver,message,seconds`` (messages of a directed link
    counted from 0). ``after`` says what becomes of a message that is not listed; one that is
    delivered takes no time.
    """

    path: SourceFile = field(source_file)
    after: str = field(_after, default="deliver")

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.table  # a bad file is refused now

    @cached_property
    def table(self) -> MessageTable:
        """Seconds of each listed message."""
        words = "seconds must be at least 0, one value a message"
        return read_messages(self.path, "seconds", words, lambda value: value >= 0.0)

    def draw(self, random: np.random.Generator) -> float:
        """0; nothing is drawn."""
        return 0.0

    @property
    def is_random(self) -> bool:
        """False."""
        return False

    @property
    def longest(self) -> float:
        """The largest recorded delay."""
        listed = [value for link in self.table.values.values() for value in link.values()]
        return max(listed, default=0.0)

    def message_delay(self, link: Link, message: int, drawn: float) -> float:
        """The recorded seconds."""
        value = _at("network.channel.delay", self.table, link, message, self.after)
        if value is None:
            return math.nan if self.after == "lose" else 0.0
        return value

    def check(self, topology: Topology) -> None:
        """Every recorded pair is a link."""
        demand_links(self.path, self.table.values, topology)


def _at(key: str, table: MessageTable, link: Link, message: int, after: str) -> float | None:
    # Asked for during a run, so the error must carry the whole path of its key.
    try:
        return table.value(link, message, after)
    except ScenarioError as error:
        raise error.under(key) from None
