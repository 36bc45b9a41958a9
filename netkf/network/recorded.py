"""Losses and delays read from a table with a row for each message."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from netkf.core.csv_files import Columns, read_columns
from netkf.core.errors import ScenarioError, errors_under
from netkf.core.fields import Component, SourceFile, field, one_of, source_file
from netkf.core.repeated_rows import RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray
from netkf.network.delays import Delay
from netkf.network.graphs import Link, Topology, demand_links
from netkf.network.losses import Loss, Transmission

AFTER = ("deliver", "lose", "repeat", "refuse")
"""The treatments of a message that the table does not list."""

_after = one_of(*AFTER)
COUNTER_REMEDY = (
    "correct one of the two rows; messages of a link are counted on from 0, so if a counter of the "
    "log wraps, add its length after each wrap"
)


@dataclass(frozen=True)
class MessageTable:
    """A value for each listed message of each directed link: ``values[link][number]``, with
    messages of a link (sender, receiver) numbered from 0.

    ``row_keys`` has the (sender, receiver, number) of each row of ``columns``: rows may repeat a
    message and its value.
    """

    columns: Columns
    values: Mapping[Link, Mapping[int, float]]
    row_keys: Sequence[tuple[int, int, int]]

    @property
    def source(self) -> SourceFile:
        """The file of the table."""
        return self.columns.source

    @cached_property
    def _lengths(self) -> dict[Link, int]:
        return {link: 1 + max(listed) for link, listed in self.values.items()}

    def value(self, link: Link, message: int, after: str) -> float | None:
        """Return the value of a message on ``link``, None if it is not listed: with ``after``
        "repeat" the table starts again, with "refuse" ScenarioError is raised at "path".
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

    def use(self, sent: Mapping[Link, int]) -> tuple[RowUse, int]:
        """Return the use of rows by ``sent`` messages, and how many are not listed."""
        use = count_rows(
            self.source.name, self.row_keys, lambda key: key[2] < sent.get((key[0], key[1]), 0)
        )
        return use, sum(sent.values()) - use.used


def read_messages(
    source: SourceFile, column: str, rule: str, allowed: Callable[[float], bool]
) -> MessageTable:
    """Read recorded losses or delays ``sender,receiver,message,COLUMN``. Raises ScenarioError with
    ``rule`` for a value that is not ``allowed``, and for two values of a message.
    """
    names = ("sender", "receiver", "message")
    table = read_columns(source, (*names, column))
    keys, entries = list(zip(*map(table.integers, names), strict=True)), table[column].tolist()
    for row, entry in enumerate(entries):
        if not allowed(entry):
            printed = [*keys[row], int(entry) if entry.is_integer() else entry]
            raise ScenarioError("path", f"{table.where(row)}: {rule}", printed, "correct the row")
    first = first_rows(table, keys, entries, rule, COUNTER_REMEDY)
    values: dict[Link, dict[int, float]] = {}
    for (sender, receiver, message), row in first.items():
        values.setdefault((sender, receiver), {})[message] = entries[row]
    return MessageTable(table, values, keys)


@dataclass(frozen=True, eq=False)
class _Recorded(Component):
    """Outcomes of messages from the table at ``path``."""

    path: SourceFile = field(source_file)
    after: str = field(_after, default="deliver")

    table: ClassVar[Any]

    _reads = "table"

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless every recorded pair is a link."""
        demand_links(self.table.columns, topology, "sender", "receiver")


@dataclass(frozen=True, eq=False)
class RecordedLoss(_Recorded, Loss):
    """Outcomes read from a table ``sender,receiver,message,delivered`` (0 or 1).

    Messages of a directed link are counted from 0; ``after`` is the treatment of a message that is
    not listed.
    """

    independent = False

    deterministic = True

    @cached_property
    def table(self) -> MessageTable:
        """The table, with 1 for each message that is delivered and 0 for the others."""
        rule = "delivered must be 0 or 1, one value a message"
        return read_messages(self.path, "delivered", rule, lambda value: value in (0.0, 1.0))

    def delivery_probability(self, sent: Transmission) -> float:
        """Return 1 if the table says that the message ``sent`` arrives."""
        value = _value_at("network.channel.loss", self.table, sent, self.after)
        if value is None:
            return 0.0 if self.after == "lose" else 1.0
        return value

    def mean_delivery(self, sent: Transmission) -> float:
        """Return nan: the fraction is unknown before a run."""
        return math.nan


@dataclass(frozen=True, eq=False)
class RecordedDelay(_Recorded, Delay):
    """Delays read from a table ``sender,receiver,message,seconds``.

    Messages of a directed link are counted from 0; ``after`` is the treatment of a message that is
    not listed. If it is delivered, it takes no time.
    """

    is_random = False

    @cached_property
    def table(self) -> MessageTable:
        """The table of the seconds of each message."""
        rule = "seconds must be at least 0, one value a message"
        return read_messages(self.path, "seconds", rule, lambda value: value >= 0.0)

    def draw(self, random: np.random.Generator) -> float:
        """Return 0; nothing is drawn."""
        return 0.0

    @property
    def rows(self) -> FloatArray:
        """The delays (K,) of all listed messages in seconds."""
        return np.array([value for link in self.table.values.values() for value in link.values()])

    @property
    def longest(self) -> float:
        """The largest recorded delay in seconds."""
        return float(np.max(self.rows, initial=0.0))

    def message_delay(self, sent: Transmission, drawn: float) -> float:
        """Return the recorded seconds that the message ``sent`` takes."""
        value = _value_at("network.channel.delay", self.table, sent, self.after)
        if value is None:
            return math.nan if self.after == "lose" else 0.0
        return value


def _value_at(key: str, table: MessageTable, sent: Transmission, after: str) -> float | None:
    # Asked for during a run, so the error must carry the whole path of its key.
    with errors_under(key):
        return table.value(sent.link, sent.number, after)
