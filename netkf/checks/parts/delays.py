"""The delays of messages in the events of runs, against the law that the scenario states."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.checks.evidence import Finding, Promise, find_identity
from netkf.checks.laws import find_largest
from netkf.checks.parts.events import direction_indices, in_direction, shares_draws
from netkf.checks.parts.moments import (
    CELLS,
    MIN_COUNT,
    compare_cells,
    correlation_interval,
    count_cells,
)
from netkf.checks.parts.sources import stated_part
from netkf.checks.parts.ticks import correlate_neighbours
from netkf.checks.statistics import Interval, detectable_shift, deviation_interval
from netkf.linalg.arrays import FloatArray
from netkf.network.channels import ExponentialDelay, LognormalDelay, UniformDelay
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

FIXED_TOLERANCE = 1e-9
"""Seconds, for each second of the run, by which rounding may move an arrival."""
MEAN_TOLERANCE = 0.05
"""Tolerated error of the mean rank of the delays of a direction."""


class DelayCounts(NamedTuple):
    """Delays of one run as uniform numbers: how many fall into each of the ``cells`` (CELLS, 1),
    ``products`` (3,) of neighbouring ones as in TickCounts, and of D directions their number and
    the sum of what they are above 1/2, ``sums`` (2, D); ``off`` () seconds by which a delay is
    furthest from a stated constant.
    """

    cells: FloatArray
    products: FloatArray
    sums: FloatArray
    off: FloatArray


@lru_cache(maxsize=8)
def stated_delay(scenario: Scenario) -> Any:
    """Return the built-in delay that the scenario's delay is, or derives from."""
    return stated_part(scenario.network.channel.delay, "delay")


def delay_law(delay: Any, seconds: FloatArray) -> FloatArray | None:
    """Return the probability that a delay is at most ``seconds`` (K,); None without a law that is
    known and has a density.
    """
    seconds = np.maximum(seconds, 0.0)
    # By exact type: a class with statements of its own has a law of its own.
    if type(delay) is ExponentialDelay:
        return np.asarray(-np.expm1(-seconds / delay.mean))
    if type(delay) is UniformDelay and delay.high > delay.low:
        return np.clip((seconds - delay.low) / (delay.high - delay.low), 0.0, 1.0)
    if type(delay) is LognormalDelay and delay.sigma > 0.0:
        with np.errstate(divide="ignore"):
            z = np.log(seconds / delay.mean) / delay.sigma + 0.5 * delay.sigma
        return np.asarray(scipy.special.ndtr(z))
    return None


def count_delays(scenario: Scenario, run: Run) -> DelayCounts | None:
    """Return the counts of a run; None without links or a stated law of the delays.

    A message is seen if it arrives before the run ends. Of those sent at one time this is a matter
    of their own delay alone, so that the delay of one that was seen has the stated law up to the
    end of the run.
    """
    delay, indices = stated_delay(scenario), direction_indices(scenario)
    rows = run.log[np.isin(run.log["kind"], (CODES["deliver"], CODES["late"]))]
    if not indices:
        return None
    ages, fixed = rows["age"], delay.fixed
    if fixed is not None:
        off = np.abs(ages - fixed).max(initial=0.0)
        none = np.zeros((CELLS, 1)), np.zeros(3), np.zeros((2, len(indices)))
        return DelayCounts(*none, np.array(off))
    law = delay_law(delay, ages)
    if law is None:
        return None
    # The receiver of a message comes first in the row of its arrival.
    which = in_direction(rows["peer"], rows["node"], indices)
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = delay_law(delay, scenario.horizon - (rows["t"] - ages))
        assert whole is not None
        uniform = np.clip(law / whole, 0.0, 1.0)
    # Where both directions of a link share their draws, one stands for both.
    known = np.isfinite(uniform) & ~shares_draws(scenario)[which]
    order = np.lexsort((rows["message"][known], which[known]))
    u, which = uniform[known][order], which[known][order]
    first = np.ones(len(u), dtype=bool)
    first[1:] = which[1:] != which[:-1]
    sums = [np.bincount(which, weights, len(indices)) for weights in (np.ones(len(u)), u - 0.5)]
    cells = count_cells(u[:, None], np.ones((len(u), 1), dtype=bool))
    return DelayCounts(cells, correlate_neighbours(u, first), np.array(sums), np.array(0.0))


def _check_fixed(samples: Any, level: float) -> Finding:
    """Compare all delays with the constant that they should be."""
    off, horizon = float(samples.delays.off.max()), samples.scenario.horizon
    return find_identity(off / horizon, FIXED_TOLERANCE, "delays in units of the length of a run")


def _check_law(samples: Any, level: float) -> Finding:
    """Compare delays with their law, cell by cell, of each direction by their mean rank, and with
    those of the message before.
    """
    counts = samples.delays
    found = compare_cells(counts.cells.sum(axis=0), ["all"], level / 3.0, "delays")
    number, excess = counts.sums.sum(axis=0)
    used = np.flatnonzero(number >= MIN_COUNT)
    intervals: list[tuple[Interval, str]] = []
    for k in used.tolist():
        sender, receiver = samples.scenario.topology.directions[k]
        # The mean of numbers that are uniform has the variance 1 / (12 N).
        reach = detectable_shift(1.0 / np.sqrt(12.0 * number[k]), level / (3.0 * len(used)))
        apart = _mean_interval(excess[k] / number[k], number[k], level / (3.0 * len(used)))
        intervals.append((apart._replace(detectable=reach), f"from {sender} to {receiver}"))
    products = counts.products.sum(axis=0)
    if products[2] >= 10 * CELLS:
        related = correlation_interval(float(products[0] / products[1]), products[2], level / 3.0)
        intervals.append((deviation_interval(0.0, related), "neighbouring ones, their correlation"))
    if found.margin[2] < 0.0 or not any(apart.low > 0.0 for apart, _ in intervals):
        return found
    return find_largest(intervals, MEAN_TOLERANCE, "largest difference of a mean rank from 1/2")


def _mean_interval(mean: float, count: float, level: float) -> Interval:
    """Return an interval for how far the mean of ``count`` uniform numbers is from 1/2."""
    reach = -float(scipy.special.ndtri(level / 2.0)) / np.sqrt(12.0 * count)
    return deviation_interval(0.5, Interval(0.5 + mean, 0.5 + mean - reach, 0.5 + mean + reach))


FIXED = Promise(
    "messages take the time of the scenario", "the scenario", (), _check_fixed, exact=True
)
LAW = Promise(
    "delays of messages have the law of the scenario, independent of each other",
    "the scenario",
    (),
    _check_law,
)


def delay_promises(samples: Any) -> list[Promise]:
    """Return the promise about delays that have a stated law and were seen in the runs."""
    if samples.delays is None or not samples.fates.sent.any():
        return []
    return [LAW if stated_delay(samples.scenario).fixed is None else FIXED]
