"""The time grid of a scenario, chosen from its horizon and the times in its fields."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

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
from netkf.linalg.spectra import eigenvalues
from netkf.network.clocks import Poisson
from netkf.network.lives import RecordedLife
from netkf.network.matchings import SlotActivation
from netkf.network.recorded import RecordedDelay
from netkf.plants.diffusion import Diffusion
from netkf.scenario.stamps import recorded_ticks

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
