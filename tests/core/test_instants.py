"""The grid of time against exact rational arithmetic."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netkf.core.instants import MAX_DENOMINATOR, TimeGrid, as_fraction, as_written, snapped

GRIDS = [TimeGrid(1e-12), TimeGrid(1e-12, 3), TimeGrid(1e-9, 7), TimeGrid(1.0), TimeGrid(1e-22)]


@pytest.mark.parametrize("grid", GRIDS)
@given(ticks=st.integers(0, 10**15))
def test_canonical_times_are_the_floats_nearest_to_whole_ticks(grid, ticks):
    exact = Fraction(ticks, int(grid.per_second))
    time = float(exact)  # correctly rounded
    assert grid.instant(time) == time
    for near in (math.nextafter(time, 0.0), math.nextafter(time, math.inf)):
        assert grid.instant(near) == time
    assert grid.snap(np.array([time])).tolist() == [time]
    assert float(Fraction(ticks + 1, int(grid.per_second))) > time


@given(st.integers(1, 500), st.integers(1, 200), st.integers(0, 10**6), st.sampled_from([3, 7, 12]))
def test_periods_and_delays_of_whole_ticks_meet(numerator, number, delay, denominator):
    """Tick k of a period plus a delay is the instant of that rational number, 1000 s at most."""
    grid = TimeGrid(1e-11, denominator)
    period, late = Fraction(numerator, 100 * denominator), Fraction(delay, 10**6 * denominator)
    sent = grid.instant(number * float(period))
    arrival = grid.instant(sent + float(late))
    assert sent == float(number * period)
    assert grid.snap(np.array([number]) * float(period)).tolist() == [sent]
    assert arrival == float(number * period + late)
    assert grid.instant(arrival - sent) == float(late)


def test_decimals_are_as_one_writes_them():
    grid = TimeGrid(1e-12)
    assert grid.snap(0.1 * np.arange(7)).tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    assert grid.instant(0.1 + 0.2) == 0.3
    assert [snapped(0.1 * k, grid.per_second) for k in range(4)] == [0.0, 0.1, 0.2, 0.3]
    assert grid.instant(math.inf) == snapped(math.inf, grid.per_second) == math.inf
    assert math.isnan(grid.instant(math.nan))
    assert grid.before(0.3, np.array([0.1 + 0.1, 0.1 + 0.2 - 1e-16, 0.1 + 0.2])).tolist() == [0.2]


@pytest.mark.parametrize(
    ("value", "fraction"),
    [
        (0.1, Fraction(1, 10)),
        (0.1 + 0.2, Fraction(3, 10)),
        (1 / 12, Fraction(1, 12)),
        (0.1 / 60, Fraction(1, 600)),
        (100 * (1 / 12), Fraction(25, 3)),
        (0.3 * 40, 12),
        (1e-9, Fraction(1, 10**9)),
        (3.14159265358979, Fraction(314159265358979, 10**14)),
        (math.tau, None),
        (0.0, 0),
        (1e15, 10**15),
    ],
)
def test_rational_numbers_are_recognised(value, fraction):
    assert as_fraction(value) == fraction
    assert as_written(value) == (value if fraction is None else float(fraction))


def test_few_random_numbers_are_taken_for_rational_ones():
    random = np.random.default_rng(1)
    found = [as_fraction(x) for x in random.random(2000).tolist()]
    assert not [f for f in found if f is not None and f.denominator <= MAX_DENOMINATOR]
