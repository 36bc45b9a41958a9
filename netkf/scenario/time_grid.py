"""The table ``[time]``, which says what stamps of recorded tables mean, and the time grid of a
scenario, chosen from its horizon and the times in its fields.
"""

from __future__ import annotations

import dataclasses
import datetime
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from netkf.core import fields
from netkf.core.errors import ScenarioError
from netkf.core.fields import Component
from netkf.core.instants import (
    CLOSE,
    COARSEST,
    FINEST,
    MAX_GIVEN_TICKS,
    MAX_REFINE,
    MAX_TICKS,
    TimeGrid,
    as_fraction,
)
from netkf.core.laws import Lattice
from netkf.core.stamps import UNITS, TimeBase
from netkf.linalg.arrays import FloatArray
from netkf.linalg.spectra import eigenvalues
from netkf.network.clocks import Poisson, RecordedClock
from netkf.network.contacts import Contacts
from netkf.network.lives import RecordedLife
from netkf.network.matchings import SlotActivation
from netkf.network.recorded import RecordedDelay
from netkf.plants.diffusion import Diffusion
from netkf.plants.inputs import RecordedInput
from netkf.plants.sampling import RecordedSampling

LISTED = 64  # of a list of probe times, or of a table, how many are looked at
DECIMALS = 9  # times of tables that have no more decimals are not looked at
FAR = 1e3  # a tick is far below a time of so many ticks


class TimeConstant(NamedTuple):
    """A time of a scenario: key path, seconds, and the rational that it stands for, if known."""

    key: str
    seconds: float
    exact: Fraction | None


def choose_grid(scenario: Any) -> TimeGrid:
    """Return the grid of instants of a scenario: the finest power of ten that leaves MAX_TICKS to
    the horizon, or ``[time] resolution``, divided where times of the scenario are no decimal
    numbers, so that sums of them are whole numbers of ticks.
    """
    automatic, given = _choose_automatically(scenario), scenario.time.resolution
    return automatic if given is None else TimeGrid(given, automatic.refine)


def _choose_automatically(scenario: Any) -> TimeGrid:
    refine, horizon = scenario.time.refine or 1, Fraction(scenario.horizon)
    # Not of probes, which no instant depends on, nor of the horizon: what is recorded, and for how
    # long, must not change a run.
    constants = (c for c in _time_constants(scenario) if c.key not in ("horizon", "probe"))
    exact = itertools.chain((c.exact for c in constants), _added_times(scenario))
    for time in () if scenario.time.refine else exact:
        finer = math.lcm(refine, _odd_part(time))
        # Of many odd denominators the first ones count; the others leave a note.
        if finer <= min(MAX_REFINE, MAX_TICKS / horizon):
            refine = finer
    for exponent in range(FINEST, COARSEST + 1):
        ticks = 10**-exponent * refine
        if horizon * ticks <= MAX_TICKS and int(float(ticks)) == ticks:
            return TimeGrid(float(f"1e{exponent}"), refine)
    return TimeGrid(10.0**COARSEST)


def _added_times(scenario: Any) -> Iterator[Fraction | None]:
    """Yield times that instants are sums of, beside fields, if all of them are rational."""
    network = scenario.network
    if network.radio is not None and network.radio.bits_per_second is not None:
        rate = as_fraction(network.radio.bits_per_second)
        yield None if rate is None else 1 / rate
    yield from (as_fraction(c.offset) for c in network.clocks if isinstance(c.offset, float))
    for times in itertools.chain(
        () if scenario.slotted else recorded_ticks(scenario),
        (life.rows for life in network.lives if isinstance(life, RecordedLife)),
        [network.channel.delay.rows] if isinstance(network.channel.delay, RecordedDelay) else (),
    ):
        odd = times[np.abs(times - times.round(DECIMALS)) > CLOSE * np.abs(times)]
        exact = [as_fraction(time) for time in np.unique(odd)[:LISTED].tolist()]
        yield from () if None in exact else exact


def _odd_part(exact: Fraction | None) -> int:
    """Return the part of the denominator of a time that no power of ten is divisible by."""
    part = 1 if exact is None else exact.denominator
    for prime in (2, 5):
        while part % prime == 0:
            part //= prime
    return part


def _time_constants(scenario: Any) -> Iterator[TimeConstant]:
    yield _constant("horizon", scenario.horizon)
    probe = scenario.probe
    listed = probe[:LISTED].tolist() if isinstance(probe, np.ndarray) else [probe]
    yield from (_constant("probe", time) for time in listed)
    network = scenario.network
    for key, part in (
        ("plant", scenario.plant),
        *((scenario.sensor_key(k), sensor) for k, sensor in enumerate(scenario.sensors)),
        ("network.activation", network.activation),
        ("network.channel.delay", network.channel.delay),
        *((f"network.lives[{k}]", life) for k, life in enumerate(network.lives)),
        ("filter", scenario.filter.algorithm),
    ):
        yield from _times_of(key, part)
    if network.channel.delay.fixed is not None:
        yield _constant("network.channel.delay", network.channel.delay.fixed)
    yield from _step_lengths(scenario)


def _constant(key: str, seconds: float) -> TimeConstant:
    return TimeConstant(key, seconds, as_fraction(seconds) if math.isfinite(seconds) else None)


def _times_of(key: str, part: Any) -> Iterator[TimeConstant]:
    if not isinstance(part, Component):
        return
    for field in dataclasses.fields(part):
        value, rule = getattr(part, field.name), field.metadata.get("rule")
        if isinstance(value, Component):
            yield from _times_of(f"{key}.{field.name}", value)
        elif isinstance(value, tuple) and value and isinstance(value[0], Component):
            for k, item in enumerate(value):
                yield from _times_of(f"{key}.{field.name}[{k}]", item)
        elif isinstance(value, float) and rule is not None and rule.of_time:
            yield _constant(f"{key}.{part._written_keys.get(field.name, field.name)}", value)
    gaps = getattr(part, "gaps", None)
    if isinstance(gaps, Lattice):
        yield _constant(key, gaps.period)


def _step_lengths(scenario: Any) -> Iterator[TimeConstant]:
    activation, node_filter = scenario.network.activation, scenario.node_filter
    if not (
        scenario.slotted and isinstance(activation, SlotActivation) and node_filter.timing.talks
    ):
        return
    length = scenario.phase_length
    exact = as_fraction(length)
    for phase in range(node_filter.timing.exchanges):
        steps = node_filter.timing.steps(phase)
        if steps:
            share = None if exact is None else exact / steps
            yield TimeConstant("network.activation.phase", length / steps, share)


def snap_limits(part: Any, grid: TimeGrid) -> Any:
    """Return a part whose times, which ages or instants are compared with, are on the ``grid``."""
    if not isinstance(part, Component):
        return part
    times = {
        field.name: getattr(part, field.name)
        for field in dataclasses.fields(part)
        if field.init and field.metadata.get("rule") and field.metadata["rule"].of_time
    }
    changed = {
        name: grid.instant(value)
        for name, value in times.items()
        if isinstance(value, float) and 0.0 < grid.instant(value) != value
    }
    return dataclasses.replace(part, **changed) if changed else part


def check_grid(scenario: Any) -> None:
    """Raise ScenarioError if the resolution fits no horizon or time, or a time is too short."""
    grid, given = scenario.time_grid, scenario.time.resolution
    least = _choose_automatically(scenario).resolution
    if given is not None and scenario.horizon * grid.per_second > MAX_GIVEN_TICKS:
        raise ScenarioError(
            "time.resolution",
            f"must leave at most {MAX_GIVEN_TICKS:g} ticks to the horizon {scenario.horizon:.15g}",
            given,
            f"give at least {least:g}, or leave it out",
        )
    is_coarse = given is not None and given > least
    for key, seconds, exact in _time_constants(scenario):
        # Up to rounding where a time is not known.
        rounding = abs(grid.instant(seconds) - seconds)
        is_held = rounding <= 1e-15 * seconds if exact is None else grid.holds(exact)
        if is_coarse and not is_held:
            rule = f"must be a multiple of the resolution {given:g} of [time]"
            remedy = f"give a finer resolution, at least {least:g}, or leave it out"
            raise ScenarioError(key, rule, seconds, remedy)
        if seconds > 0.0 and rounding * FAR > seconds:
            rule = f"must be far above {grid.resolution:g} s, the finest resolution of time that "
            rule += f"leaves {MAX_TICKS:g} ticks to the horizon {scenario.horizon:.15g}"
            raise ScenarioError(key, rule, seconds, "lengthen it or shorten the horizon")


def grid_notes(scenario: Any) -> tuple[str, ...]:
    """Return lines on rounded times, and on a resolution not far below gaps and time constants."""
    grid, notes = scenario.time_grid, []
    tick = 1.0 / grid.per_second
    rounded = [
        constant
        for constant in _time_constants(scenario)
        if constant.key not in ("horizon", "probe")
        and constant.exact is not None
        and not grid.holds(constant.exact)
    ]
    if rounded:
        key, seconds, _ = rounded[0]
        more = f", and {len(rounded) - 1} more" if len(rounded) > 1 else ""
        notes.append(
            f"time: {key} = {seconds!r} is no whole number of ticks of {tick:g} s{more}: instants "
            "that are sums of it may be a tick apart"
        )
    key, shortest = min(_short_times(scenario), key=lambda pair: pair[1])
    if shortest < FAR * tick:
        notes.append(
            f"time: instants are whole multiples of {tick:g} s, which is not far below {key} "
            f"{shortest:.3g} s: it is rounded"
        )
    return tuple(notes)


def _short_times(scenario: Any) -> Iterator[tuple[str, float]]:
    yield from ((key, value) for key, value, _ in _time_constants(scenario) if value > 0.0)
    clocks = [getattr(sensor, "sampling", None) for sensor in scenario.sensors]
    for clock in (scenario.network.activation, *clocks):
        if isinstance(clock, Poisson):
            rates = [rate for rate in (clock.rate, *(e[-1] for e in clock.rates)) if rate]
            yield "the mean gap of a clock,", 1.0 / max(rates, default=1e-15)
    if isinstance(scenario.plant, Diffusion):
        fastest = max(float(np.abs(eigenvalues(piece.A)).max()) for piece in scenario.plant.pieces)
        if fastest > 0.0:
            yield "the shortest time constant of the plant,", 1.0 / fastest


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
