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
from netkf.linalg.arrays import FloatArray, IntArray
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


_NOTHING = np.array([-1]), np.array([np.nan])
"""Numbers and values of a link of which nothing is listed."""


@dataclass(frozen=True)
class MessageTable:
    """A value for each listed message of each directed link (sender, receiver): ``values[link]``
    are the numbers (K,) of its messages, counted from 0, in order, and the values (K,) of these.

    ``row_keys``: (sender, receiver, number) of each row of ``columns``, which may repeat.
    """

    columns: Columns
    values: Mapping[Link, tuple[IntArray, FloatArray]]
    row_keys: Sequence[tuple[int, int, int]]

    @property
    def source(self) -> SourceFile:
        """The file of the table."""
        return self.columns.source

    def value(self, link: Link, message: Any, after: str) -> Any:
        """Return the value of a message on ``link``, or of messages (K,), nan if it is not listed:
        with ``after`` "repeat" the table starts again, "refuse" raises ScenarioError at "path".
        """
        numbers, values = self.values.get(link, _NOTHING)
        if after == "repeat" and link in self.values:
            message = message % (numbers[-1] + 1)
        place = np.minimum(np.searchsorted(numbers, message), len(numbers) - 1)
        listed = numbers[place] == message
        if after == "refuse" and not np.all(listed):
            raise ScenarioError(
                "path",
                f"{self.source.name} must list every message that is sent, "
                'because after = "refuse"',
                f"message {np.extract(~listed, message)[0]} from node {link[0]} to node {link[1]}",
                "add the row, shorten the horizon or change after",
            )
        return np.where(listed, values[place], np.nan)[()]

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
    listed, rows = np.array([*first], dtype=np.int64).reshape(-1, 3), [*first.values()]
    order = np.lexsort(listed.T[::-1])
    listed, given = listed[order], table[column][rows][order]
    begins = 1 + np.flatnonzero(np.diff(listed[:, :2], axis=0).any(axis=1))
    parts = zip(np.split(listed, begins), np.split(given, begins), strict=True)
    values = {(int(k[0, 0]), int(k[0, 1])): (k[:, 2], part) for k, part in parts if len(k)}
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

    vectorised = True

    @cached_property
    def table(self) -> MessageTable:
        """The table, with 1 for each message that is delivered and 0 for the others."""
        rule = "delivered must be 0 or 1, one value a message"
        return read_messages(self.path, "delivered", rule, lambda value: value in (0.0, 1.0))

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return 1 where the table says that the message ``sent`` arrives, or each of K (K,)."""
        value = _value_at("network.channel.loss", self.table, sent, self.after)
        return np.where(np.isnan(value), 0.0 if self.after == "lose" else 1.0, value)[()]

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

    vectorised = True

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
        return np.concatenate([np.empty(0), *(s for _, s in self.table.values.values())])

    @property
    def longest(self) -> float:
        """The largest recorded delay in seconds."""
        return float(np.max(self.rows, initial=0.0))

    def message_delay(self, sent: Transmission, drawn: Any) -> Any:
        """Return the recorded seconds that the message ``sent`` takes, or each of K (K,)."""
        value = _value_at("network.channel.delay", self.table, sent, self.after)
        return np.where(np.isnan(value) & (self.after != "lose"), 0.0, value)[()]


def _value_at(key: str, table: MessageTable, sent: Transmission, after: str) -> Any:
    # Asked for during a run, so the error must carry the whole path of its key.
    with errors_under(key):
        return table.value(sent.link, sent.number, after)
