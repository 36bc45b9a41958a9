"""Losses whose quality changes with time, by a table, and channels that nodes hop over."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from netkf.core.csv_files import Columns, read_columns
from netkf.core.errors import ScenarioError
from netkf.core.fields import (
    Component,
    SourceFile,
    field,
    integer,
    list_of,
    probability,
    source_file,
)
from netkf.core.instants import OnGrid
from netkf.core.repeated_rows import KeyedTable, RowUse, count_rows, first_rows
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Link, Topology, demand_links
from netkf.network.losses import Loss, Transmission


def _read_deliveries(
    source: SourceFile, required: tuple[str, ...], optional: tuple[str, ...] = ()
) -> Columns:
    """Return the columns of a table that has a column ``delivery`` of probabilities."""
    table = read_columns(source, (*required, "delivery"), optional)
    values = table["delivery"]
    wrong = np.flatnonzero(~((values >= 0.0) & (values <= 1.0)))
    if wrong.size:
        row = int(wrong[0])
        rule = f"{table.where(row)}: delivery must be a number from 0 to 1"
        raise ScenarioError("path", rule, float(values[row]), "correct the row")
    return table


@dataclass(frozen=True, eq=False)
class ScheduledLoss(Loss, OnGrid):
    """A message arrives with the probability that a table ``from,until,sender,receiver,delivery``
    gives its direction at the time when it is sent: a row holds from its beginning to before its
    end, and outside all rows ``otherwise`` does.
    """

    vectorised = True
    grid_values = ("_instants",)

    path: SourceFile = field(source_file)
    otherwise: float = field(probability, default=1.0)

    _reads = "_table"

    @cached_property
    def _table(
        self,
    ) -> KeyedTable[Link, tuple[FloatArray, FloatArray], tuple[Link, float, float]]:
        """Times and probabilities (K,) of each link, and the link and times of each row."""
        table = _read_deliveries(self.path, ("from", "until", "sender", "receiver"))
        begins, ends, values = (table[name].tolist() for name in ("from", "until", "delivery"))
        links = list(zip(table.integers("sender"), table.integers("receiver"), strict=True))
        keys = list(zip(links, begins, ends, strict=True))
        rows: dict[Link, list[int]] = {}
        rule = "a direction must have one delivery at a time"
        for (link, _, _), row in first_rows(table, keys, values, rule).items():
            if not ends[row] > begins[row]:
                rule = f"{table.where(row)}: until must be after from"
                raise ScenarioError("path", rule, [begins[row], ends[row]], "correct the row")
            rows.setdefault(link, []).append(row)
        steps = {}
        for link, numbers in rows.items():
            times, probabilities = [-math.inf], [self.otherwise]
            numbers.sort(key=lambda row: begins[row])
            for before, row in zip([None, *numbers], numbers, strict=False):
                if before is not None and begins[row] < ends[before]:
                    rule = f"{table.where(row)}: overlaps the interval of {table.where(before)}"
                    given = [begins[row], ends[row]]
                    raise ScenarioError("path", rule, given, "let each end before the next begins")
                times += [begins[row], ends[row]]
                probabilities += [values[row], self.otherwise]
            steps[link] = np.array(times), np.array(probabilities)
        return KeyedTable(steps, table, keys)

    @cached_property
    def _instants(self) -> dict[Link, FloatArray]:
        """The times (K,) by link on the grid of the scenario, as messages are sent."""
        return {link: self.time_grid.snap(times) for link, (times, _) in self._table.of.items()}

    def use(self, end: float) -> RowUse:
        """Return the use of the rows by a run to ``end`` (s): of those that hold in it."""
        keys = self._table.keys
        return count_rows(self.path.name, keys, lambda key: key[1] < end and key[2] > 0.0)

    def delivery_probability(self, sent: Transmission) -> Any:
        """Return the probability of the direction at the time of sending."""
        if sent.link not in self._table.of:
            return self.otherwise
        times, probabilities = self._instants[sent.link], self._table.of[sent.link][1]
        # Of a row that begins where another ends the last entry counts.
        return probabilities[np.searchsorted(times, sent.time, side="right") - 1]

    @property
    def independent(self) -> bool:
        """True only if no direction changes: then neighbouring messages are not lost alike."""
        return all(np.ptp(values) == 0.0 for _, values in self._table.of.values())

    def mean_delivery(self, sent: Transmission) -> float:
        """Return the probability of a direction if it does not change, else nan."""
        if sent.link not in self._table.of:
            return self.otherwise
        _, probabilities = self._table.of[sent.link]
        return float(probabilities[0]) if np.ptp(probabilities) == 0.0 else math.nan

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless every pair of the table is a link."""
        demand_links(self._table.columns, topology, "sender", "receiver")


@dataclass(frozen=True, eq=False)
class Hopping(Component):
    """The channels (frequencies) over which messages hop, and how well each of them delivers.

    hopping  numbers of channels: message k of a link is sent on ``hopping[k mod len(hopping)]``
    path     a table ``channel,delivery``, or ``channel,sender,receiver,delivery`` for each
             direction: the probability that a message on this channel arrives, if the loss model
             does not lose it
    """

    hopping: tuple[int, ...] = field(list_of(integer(0), "channels"))
    path: SourceFile = field(source_file)

    def __post_init__(self) -> None:
        """Check the fields and read the table; raises ScenarioError for a mistake in either, and
        for a channel that the table does not list.
        """
        super().__post_init__()
        listed = {channel for channel, _ in self._table.of}
        for channel in self.hopping:
            if channel not in listed:
                rule, remedy = f"needs rows of each channel in {self.path.name}", "add its rows"
                raise ScenarioError("hopping", rule, channel, remedy)

    @cached_property
    def _table(self) -> KeyedTable[tuple[int, Link | None], float, tuple[int, Link | None]]:
        """The delivery of each channel and link (None: all)."""
        table = _read_deliveries(self.path, ("channel",), ("sender", "receiver"))
        channels: list[int] = table.integers("channel")
        links: list[Link | None] = [None] * len(channels)
        if "sender" in table or "receiver" in table:
            missing = [name for name in ("sender", "receiver") if name not in table]
            if missing:
                rule = f"{self.path.name} has only one end of the links"
                raise ScenarioError("path", rule, None, f"add a column {missing[0]}")
            links = list(zip(table.integers("sender"), table.integers("receiver"), strict=True))
        keys, values = list(zip(channels, links, strict=True)), table["delivery"].tolist()
        rows = first_rows(table, keys, values, "a channel must have one delivery")
        return KeyedTable({key: values[row] for key, row in rows.items()}, table, keys)

    def use(self, end: float) -> RowUse:
        """Return the use of the rows by a run to ``end`` (s): of channels in use."""
        used = self.hopping if end > 0.0 else ()
        return count_rows(self.path.name, self._table.keys, lambda key: key[0] in used)

    def delivery(self, sent: Transmission) -> Any:
        """Return the probability that the message ``sent`` arrives on its channel."""
        return self.on_hops(sent.link)[np.asarray(sent.number) % len(self.hopping)]

    def mean(self, link: Link) -> float:
        """Return the mean of that probability over the hops, for a directed link."""
        return float(self.on_hops(link).mean())

    def on_hops(self, link: Link) -> FloatArray:
        """Return the probabilities (H,) that a message on each of the hops arrives."""
        deliveries = self._table.of
        key = None if (self.hopping[0], None) in deliveries else link
        return np.array([deliveries[channel, key] for channel in self.hopping])

    def check(self, topology: Topology) -> None:
        """Raise ScenarioError unless every pair of the table is a link, and each link is there."""
        deliveries, table, _ = self._table
        if "sender" not in table:
            return
        demand_links(table, topology, "sender", "receiver")
        for channel, link in itertools.product(self.hopping, topology.directions):
            if (channel, link) not in deliveries:
                rule = f"{self.path.name} must have a row of each direction on each channel"
                got = f"none of {list(link)} on {channel}"
                raise ScenarioError("path", rule, got, "add the row")
