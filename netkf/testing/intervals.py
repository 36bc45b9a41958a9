"""``check_intervals``: intervals of comparisons and searches miss as often as they say.

Their values are replaced by ones whose law is known: normal ones, for which Student's intervals
are exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.studies.filter_values import FilterValues, estimate_quantities
from netkf.studies.metrics import RunMetrics
from netkf.studies.targets import Target, quantity_by_simulation
from netkf.testing.noise import FAMILIES, LEVEL
from netkf.testing.watching import demand

TRIALS, RUNS = 6_000, 5
"""Intervals of each quantity, and runs behind one: few, so that the number of runs matters."""
MISS = 0.1
"""Probability with which each interval misses."""
BEFORE, AFTER, SPREAD = 20.0, 21.0, 1.0
"""True means of two filters, and the standard deviation of a run: the square root of a mean, which
is linear only nearly, is so within the error of the check.
"""


class Misses(NamedTuple):
    """How often the intervals of a quantity end below the truth, and how often they begin above."""

    below: int
    above: int


def check_intervals() -> None:
    """Check the intervals of ``netkf.compare_filters`` (differences of RMS errors, of the worst
    instants and of NEES / n) and of ``netkf.size`` (RMS errors and traces) on a known law: of 6,000
    intervals a tenth misses, half of these on either side.

    Intervals that miss on one side 2 percentage points too often or too rarely are found with
    probability 0.9. Raises AssertionError with one line: the quantity, how often it misses and how
    often it should.
    """
    # A binomial count is within this many standard deviations of its mean.
    reach = -float(scipy.special.ndtri(0.5 * LEVEL / FAMILIES))
    allowed = reach * float(np.sqrt(TRIALS * 0.5 * MISS * (1.0 - 0.5 * MISS)))
    for name, misses in {**_compared(), **_searched()}.items():
        for side, count in misses._asdict().items():
            demand(
                abs(count - 0.5 * MISS * TRIALS) <= allowed,
                name,
                f"intervals must end {side} the truth with probability {0.5 * MISS:g}",
                f"{count / TRIALS:.3g} in {TRIALS:,} intervals",
                "look at Student's quantile and the standard error",
            )


def _draw(random: np.random.Generator, mean: float) -> FloatArray:
    """Return RUNS values (RUNS,) of a known ``mean``."""
    return mean + SPREAD * random.standard_normal(RUNS)


def _count(intervals: list[tuple[float, float]], truth: float) -> Misses:
    """Return how often the ``intervals`` miss the ``truth`` on either side."""
    low, high = np.array(intervals).T
    return Misses(int((high < truth).sum()), int((low > truth).sum()))


def _compared() -> dict[str, Misses]:
    """Return the misses of the paired differences of two filters, by quantity."""
    random = Streams(0).generator("testing")
    found: dict[str, list[tuple[float, float]]] = {}
    for _ in range(TRIALS):
        values = []
        for mean in (BEFORE, AFTER):
            square, worst, nees = (_draw(random, mean) for _ in range(3))
            values.append(FilterValues(square, worst, nees, np.zeros(RUNS, dtype=bool)))
        for name, quantity in estimate_quantities(values[1], values[0], 1, MISS).items():
            found.setdefault(name, []).append((quantity.low, quantity.high))
    truths = {"rms_error": AFTER**0.5 - BEFORE**0.5}
    return {
        f"compare_filters {name}": _count(intervals, truths.get(name, AFTER - BEFORE))
        for name, intervals in found.items()
    }


def _searched() -> dict[str, Misses]:
    """Return the misses of the quantities of a search for a parameter, by quantity."""
    random, nothing = Streams(1).generator("testing"), np.zeros((RUNS, 1))
    truths = {"mean_rms": BEFORE**0.5, "mean_trace": BEFORE}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in truths}
    for _ in range(TRIALS):
        square, trace = (_draw(random, BEFORE)[:, None] for _ in range(2))
        metrics = RunMetrics(square, trace, np.zeros((RUNS, 5)), nothing, nothing + np.inf)
        for name, intervals in found.items():
            estimate = quantity_by_simulation(metrics, Target(name, 1.0), MISS, None)
            intervals.append((estimate.low, estimate.high))
    return {f"size {name}": _count(found[name], truth) for name, truth in truths.items()}
