"""Intervals of comparisons and searches miss as often as they say, and each wrong one is found.

Their values are replaced by ones whose law is known: normal ones, for which Student's intervals
are exact. Intervals that miss on one side 2 percentage points too often or too rarely are found
with probability 0.9.
"""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.special

from netkf.laws.intervals import interval_of_squares, student_interval
from netkf.studies import metrics, targets
from netkf.studies.metrics import FilterValues, RunMetrics, estimate_quantities
from netkf.studies.targets import Target, quantity_by_simulation

TRIALS, RUNS = 6_000, 5
"""Intervals of each quantity, and runs behind one: few, so that the number of runs matters."""
MISS, LEVEL = 0.1, 5e-9
"""Probability with which each interval misses, and that of a false alarm."""
BEFORE, AFTER, SPREAD = 20.0, 21.0, 1.0
"""True means of two filters, and the standard deviation of a run: the square root of a mean, which
is linear only nearly, is so within the error of the test.
"""


class Misses(NamedTuple):
    """How often the intervals of a quantity end below the truth, and how often they begin above."""

    below: int
    above: int


def wrong_sides(trials=TRIALS):
    """The quantities and sides on which intervals miss too often or too rarely."""
    # A binomial count is within this many standard deviations of its mean.
    reach = -float(scipy.special.ndtri(0.5 * LEVEL))
    allowed = reach * float(np.sqrt(trials * 0.5 * MISS * (1.0 - 0.5 * MISS)))
    return [
        (name, side)
        for name, misses in {**compared(trials), **searched(trials)}.items()
        for side, count in misses._asdict().items()
        if abs(count - 0.5 * MISS * trials) > allowed
    ]


def drawn(random, mean):
    return mean + SPREAD * random.standard_normal(RUNS)


def count(intervals, truth):
    low, high = np.array(intervals).T
    return Misses(int((high < truth).sum()), int((low > truth).sum()))


def compared(trials):
    """Paired differences of two filters, by quantity."""
    random = np.random.default_rng(0)
    found = {}
    for _ in range(trials):
        values = []
        for mean in (BEFORE, AFTER):
            square, worst, nees = (drawn(random, mean) for _ in range(3))
            diverged = np.zeros(RUNS, dtype=bool)
            values.append(FilterValues(square, nees, worst[:, None], diverged))
        names = ("worst_instant",)
        for name, quantity in estimate_quantities(values[1], values[0], 1, names, MISS).items():
            found.setdefault(name, []).append((quantity.low, quantity.high))
    truths = {"rms_error": AFTER**0.5 - BEFORE**0.5}
    return {
        f"compare_filters {name}": count(intervals, truths.get(name, AFTER - BEFORE))
        for name, intervals in found.items()
    }


def searched(trials):
    """Quantities of a search for a parameter."""
    random, nothing = np.random.default_rng(1), np.zeros((RUNS, 1))
    truths = {"mean_rms": BEFORE**0.5, "mean_trace": BEFORE}
    found = {name: [] for name in truths}
    for _ in range(trials):
        square, trace = (drawn(random, BEFORE)[:, None] for _ in range(2))
        of_runs = RunMetrics(square, trace, np.zeros((RUNS, 5)), nothing, nothing + np.inf)
        for name, intervals in found.items():
            estimate = quantity_by_simulation(of_runs, Target(name, 1.0), MISS, None)
            intervals.append((estimate.low, estimate.high))
    return {f"size {name}": count(found[name], truth) for name, truth in truths.items()}


@pytest.mark.slow
def test_intervals_of_comparisons_and_searches_miss_as_often_as_they_say():
    assert wrong_sides() == []


def normal_quantile(freedom, probability):
    return scipy.special.ndtri(probability)


class OneSided:
    """Takes all of the level on each side."""

    @staticmethod
    def stdtrit(freedom, probability):
        return scipy.special.stdtrit(freedom, 2.0 * probability - 1.0)


class Normal:
    """Ignores how few runs there are."""

    stdtrit = staticmethod(normal_quantile)


class Scipy:
    """A module whose special functions are others."""

    def __init__(self, special):
        self.special = special


@pytest.mark.one_in(4)
@pytest.mark.parametrize("special", [OneSided, Normal])
@pytest.mark.parametrize(("module", "name"), [(metrics, "compare_filters"), (targets, "size")])
def test_a_wrong_quantile_is_found(module, name, special, monkeypatch):
    monkeypatch.setattr(module, "scipy", Scipy(special))
    assert {found.split()[0] for found, _ in wrong_sides(1500)} == {name}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("freedom", [1, 3, 20])
def test_few_runs_of_skewed_nees_accuse_nobody(freedom):
    """NEES of ten runs, each a mean of so many squares, of eighteen blocks judged at 99 %."""
    random, level, wrong = np.random.default_rng(4), 0.01 / 18, 0
    values = random.chisquare(freedom, size=(36_000, 10)) / freedom
    for one in values:
        low, high = interval_of_squares(one, level)
        wrong += not low <= 1.0 <= high
    # A bound on the mean of 20 wrong rows, plus three deviations; Student's has up to 900.
    assert wrong <= 1.5 * level * len(values) + 14
    found = sum(
        not low <= 1.0 <= high
        for low, high in (interval_of_squares(3.0 * one, level) for one in values[:200])
    )
    assert found >= {1: 0, 3: 10, 20: 180}[freedom]


def test_the_interval_of_squares_tends_to_students():
    values = np.random.default_rng(1).chisquare(40, size=2000) / 40
    low, high = interval_of_squares(values, 0.01)
    deviation = float(values.std(ddof=1)) / np.sqrt(len(values))
    other = student_interval(float(values.mean()), deviation, len(values), 0.01)
    np.testing.assert_allclose([low, high], [other.low, other.high], atol=0.05 * deviation * 40)
    assert interval_of_squares(np.zeros(10), 0.01) == (0.0, np.inf)
