"""The table ``[time]``: what the stamps of recorded tables mean."""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from netkf.core import fields
from netkf.core.instants import COARSEST, FINEST, MAX_REFINE
from netkf.core.stamps import UNITS, TimeBase
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import RecordedClock
from netkf.network.contacts import Contacts
from netkf.plants.inputs import RecordedInput
from netkf.plants.sampling import RecordedSampling

LATE = 100.0  # seconds; records that begin earlier need no note


def _convert_origin(value: Any) -> int | float | str:
    if isinstance(value, bool):
        raise TypeError
    if isinstance(value, datetime.datetime | datetime.date):
        value = value.isoformat()
    if isinstance(value, int | np.integer):
        value = int(value)
    elif isinstance(value, float | np.floating):
        value = float(value)
    elif not isinstance(value, str) or len(value) > 100:
        raise TypeError
    if abs(_origin_seconds(value)) > fields.MAX_SECONDS:
        raise ValueError
    result: int | float | str = value
    return result


def _origin_seconds(value: int | float | str) -> Decimal:
    return TimeBase().exact(value if isinstance(value, str) else repr(value))


_origin = fields.Rule(
    "must be a number of seconds or an ISO 8601 time",
    _convert_origin,
    'write the stamp of simulated 0, such as 1248275404.5 or "2009-07-22T15:10:04.5Z"',
    {"type": ["number", "string"]},
)


def _convert_resolution(value: Any) -> float:
    seconds: float = fields.positive.convert(value)
    exponent = round(math.log10(seconds))
    if seconds != float(f"1e{exponent}") or not FINEST <= exponent <= COARSEST:
        raise ValueError
    return seconds


_resolution = fields.Rule(
    "must be a power of ten of at most 1 second",
    _convert_resolution,
    "write 1e-6, say, or leave it out",
    {"type": "number", "exclusiveMinimum": 0, "maximum": 1},
)


@dataclass(frozen=True, eq=False)
class Time(fields.Component):
    """What the stamps of recorded tables mean, those in columns t, from and until.

    origin  the stamp of simulated 0: seconds, or an ISO 8601 time (UTC where it names no zone);
            stamps of all tables count from it. Default 0, which ISO 8601 stamps take for 1970
    unit    unit of stamps that are numbers: "s", "ms", "us" or "ns"
    resolution  every instant is a whole multiple of it, a power of ten in seconds; by default the
                finest that leaves at most 1e15 of them to the horizon
    refine  into how many ticks the resolution is divided, so that times which are no decimal
            numbers, such as 1/12, are whole numbers of ticks; by default as many as these need
    """

    origin: int | float | str | None = fields.field(_origin, default=None)
    unit: str = fields.field(fields.one_of(*UNITS), default="s")
    resolution: float | None = fields.field(_resolution, default=None)
    refine: int | None = fields.field(fields.integer(low=1, high=MAX_REFINE), default=None)

    @property
    def stamps(self) -> TimeBase:
        """The unit and the origin as tables are read with."""
        return TimeBase(
            self.unit, Decimal(0) if self.origin is None else _origin_seconds(self.origin)
        )


def restamp(part: Any, stamps: TimeBase) -> Any:
    """Return a component whose tables are read with these ``stamps``; raises ScenarioError."""

    def change(_: Any, __: Any, value: Any) -> Any:
        if isinstance(value, fields.SourceFile):
            return value if value.stamps == stamps else dataclasses.replace(value, stamps=stamps)
        return fields.rebuild(value, change)

    return fields.rebuild(part, change)


def stamp_notes(scenario: Any) -> tuple[str, ...]:
    """Return a line if all records begin long after 0, or [time] origin leaves none in the run."""
    times = [t for t in _recorded_times(scenario) if t.size]
    if not times:
        return ()
    first, last = (float(pick(np.concatenate(times))) for pick in (np.min, np.max))
    if scenario.time.origin is not None:
        if first < scenario.horizon and last >= 0.0:
            return ()
        where = f"end before 0, at t = {last!r}"
        if last >= 0.0:
            where = f"begin after the horizon, at t = {first!r}"
        return (f"all records {where}: check [time] origin, in seconds whatever the unit is",)
    if first < max(LATE, 10.0 * (last - first), 0.5 * scenario.horizon):
        return ()
    return (
        f"all records begin long after 0, the first at t = {first!r}: the run begins at 0, "
        f"with mean and cov of that time. If it should begin with the records, write [time] origin "
        f"= {math.floor(first)}, and count horizon and probe from there",
    )


def recorded_ticks(scenario: Any) -> Iterator[FloatArray]:
    """Yield the times (K,) in seconds of the rows of each table of readings, samples or ticks."""
    for sensor in scenario.sensors:
        if sensor.record is not None:
            yield sensor.record.columns["t"]
        clock = getattr(sensor, "sampling", None)
        if isinstance(clock, RecordedSampling):
            yield np.array([t for _, t in clock.row_times])
    if isinstance(scenario.network.activation, RecordedClock):
        yield scenario.network.activation.rows
    if isinstance(scenario.network.activation, Contacts):
        yield np.array([t for _, *ends in scenario.network.activation.row_keys for t in ends])


def _recorded_times(scenario: Any) -> Iterator[FloatArray]:
    yield from recorded_ticks(scenario)
    positions = scenario.position_table
    if positions is not None and positions.timed:
        yield np.array([t for _, t in positions.row_keys])
    for _, plant in scenario.all_plants:
        if plant.record is not None:
            yield plant.record.columns["t"]
        if isinstance(plant.input, RecordedInput):
            yield np.array(plant.input.row_keys)
