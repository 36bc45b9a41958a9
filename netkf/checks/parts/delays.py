"""The delays of messages in the events of runs, against the law that the scenario states."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy.special

from netkf.checks.evidence import DELAYS, Finding, Promise, find_identity
from netkf.checks.laws import find_largest
from netkf.checks.parts.events import direction_indices, in_direction, shares_draws
from netkf.checks.parts.moments import (
    CELLS,
    MIN_COUNT,
    compare_shares,
)
from netkf.checks.parts.sources import stated_part
from netkf.checks.parts.waiting import (
    WaitingLaw,
    censored_ranks,
    correlate_neighbours,
    correlation_of_neighbours,
    count_ranks,
    exponential_law,
    fill_in,
    fill_in_normal,
    uniform_law,
)
from netkf.checks.statistics import Interval, detectable_shift, deviation_interval
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.network.channels import ExponentialDelay, LognormalDelay, UniformDelay
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

FIXED_TOLERANCE = 1e-9
"""Seconds, for each second of the run, by which rounding may move an arrival."""
MEAN_TOLERANCE = 0.05
"""Tolerated error of the mean rank of the delays of a direction."""


class DelayCounts(NamedTuple):
    """Delays of the messages of one run over D directions (directed links), as numbers u that are
    uniform in [0, 1] under the stated law: P(delay <= this one).

    cells    : (CELLS, 2) numbers of u in equal parts of [0, 1], and of those looked at
    products : (3,) sums over neighbouring delays of a direction, as in TickCounts
    sums     : (2, D) of each direction the number of delays and the sum of u - 1/2
    off      : () largest distance in seconds of a delay from a stated constant
    """

    cells: FloatArray
    products: FloatArray
    sums: FloatArray
    off: FloatArray


@lru_cache(maxsize=8)
def stated_delay(scenario: Scenario) -> Any:
    """Return the delay that states the law of the scenario's delay: its own, or for a user's class
    that states none an object of the built-in class that it derives from.
    """
    return stated_part(scenario.network.channel.delay, "delay")


def law_of_delay(delay: Any) -> WaitingLaw | None:
    """Return the law that ``delay`` states; None if it is unknown or has no density."""
    # By exact type: a class with statements of its own has a law of its own.
    if type(delay) is ExponentialDelay and delay.mean > 0.0:
        return exponential_law(np.array(1.0 / delay.mean))
    if type(delay) is UniformDelay and delay.high > delay.low:
        return uniform_law(delay.low, delay.high - delay.low)
    if type(delay) is LognormalDelay and delay.sigma > 0.0:
        mean, sigma = delay.mean, delay.sigma
        return WaitingLaw(
            lambda t: scipy.special.ndtr(
                np.log(np.maximum(t, 1e-300) / mean) / sigma + 0.5 * sigma
            ),
            lambda p: mean * np.exp(sigma * (scipy.special.ndtri(p) - 0.5 * sigma)),
        )
    return None


def delay_law(delay: Any, seconds: FloatArray) -> FloatArray | None:
    """Return P(delay <= ``seconds``) (K,) under the law that ``delay`` states; None if the law is
    unknown or has no density.
    """
    law = law_of_delay(delay)
    return None if law is None else np.asarray(law.cdf(np.maximum(seconds, 0.0)))


def count_delays(scenario: Scenario, run: Run) -> DelayCounts | None:
    """Return counts and sums by which the delays of the messages of a run are compared with their
    stated law, over D directions (directed links); None without links or a stated law.

    Messages that have not arrived when the run ends take longer than that.
    """
    delay, indices = stated_delay(scenario), direction_indices(scenario)
    rows = run.log[np.isin(run.log["kind"], (CODES["deliver"], CODES["late"]))]
    if not indices:
        return None
    ages, fixed = rows["age"], delay.fixed
    if fixed is not None:
        largest_error = np.abs(ages - fixed).max(initial=0.0)
        zeros = np.zeros((CELLS, 2)), np.zeros(3), np.zeros((2, len(indices)))
        return DelayCounts(*zeros, np.array(largest_error))
    law = law_of_delay(delay)
    if law is None:
        return None
    sent, directions, ages = _follow_messages(scenario, run, rows)
    ranks = censored_ranks(law, sent, ages, scenario.horizon)
    # The first message of each direction has no neighbour before it.
    first = np.ones(len(sent), dtype=bool)
    first[1:] = directions[1:] != directions[:-1]
    looked_at, centred = np.isfinite(ranks.rank), fill_in(ranks) - 0.5
    sums = [
        np.bincount(directions[looked_at], weights[looked_at], len(indices))
        for weights in (np.ones(len(sent)), centred)
    ]
    products = correlate_neighbours(fill_in_normal(ranks), first)
    return DelayCounts(count_ranks(ranks), products, np.array(sums), np.array(0.0))


def _follow_messages(
    scenario: Scenario, run: Run, arrivals: np.ndarray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return for each of the K messages of a run that are not lost the time (K,) of sending, the
    index (K,) of its direction, and the seconds (K,) that it takes: inf if it is under way when the
    run ends. They are in order of direction and number; ``arrivals`` are the rows of the log.

    Where both directions of a link share their draws, one stands for both.
    """
    indices, log = direction_indices(scenario), run.log
    sends, losses = (log[log["kind"] == CODES[kind]] for kind in ("send", "lost"))
    width = int(sends["message"].max(initial=0)) + 1

    def keys(rows: np.ndarray, sender: str, receiver: str) -> IntArray:
        """Return one integer for each message: its direction, and its number in that."""
        codes: IntArray = in_direction(rows[sender], rows[receiver], indices) * width
        return codes + np.asarray(rows["message"], dtype=np.int64)

    sent = keys(sends, "node", "peer")
    # The receiver of a message comes first in the row of its arrival.
    arrived = keys(arrivals, "peer", "node")
    followed = ~np.isin(sent, keys(losses, "node", "peer"))
    followed &= ~shares_draws(scenario)[sent // width]
    order = np.argsort(sent[followed], kind="stable")
    sent, times = sent[followed][order], sends["t"][followed][order]
    ages = np.full(len(sent), np.inf)
    position = np.searchsorted(sent, arrived)
    position[position == len(sent)] = 0
    known = sent[position] == arrived if len(sent) else np.zeros(len(arrived), dtype=bool)
    ages[position[known]] = arrivals["age"][known]
    return times, sent // width, ages


def _check_fixed(samples: Any, level: float) -> Finding:
    """Compare all delays with the stated constant.

    No interval is estimated, so that ``level`` is not used.
    """
    largest_error, horizon = float(samples.delays.off.max()), samples.scenario.horizon
    return find_identity(
        largest_error / horizon, FIXED_TOLERANCE, "delays in units of the length of a run"
    )


def _check_law(samples: Any, level: float) -> Finding:
    """Test the null hypothesis that delays follow their stated law and are independent.

    Under it P(delay <= the one seen) is uniform in [0, 1] (:class:`DelayCounts`): these numbers
    fill the cells evenly, have the mean 1/2 in each direction (directed link), and are not
    correlated with those of the message before; each of the three tests gets a third of the level.
    """
    counts = samples.delays
    finding = compare_shares(counts.cells.sum(axis=0), level / 3.0, "delays")
    number, excess = counts.sums.sum(axis=0)
    frequent = np.flatnonzero(number >= MIN_COUNT)
    intervals: list[tuple[Interval, str]] = []
    for k in frequent.tolist():
        sender, receiver = samples.scenario.topology.directions[k]
        # The mean of numbers that are uniform has the variance 1 / (12 N).
        detectable = detectable_shift(
            1.0 / np.sqrt(12.0 * number[k]), level / (3.0 * len(frequent))
        )
        distance = _mean_interval(excess[k] / number[k], number[k], level / (3.0 * len(frequent)))
        intervals.append((distance._replace(detectable=detectable), f"from {sender} to {receiver}"))
    correlation = correlation_of_neighbours(counts.products, level / 3.0)
    if correlation is not None:
        intervals.append(
            (deviation_interval(0.0, correlation), "neighbouring ones, their correlation")
        )
    # The law of all delays is reported if it is wrong, or if no direction is significantly off.
    if finding.margin[2] < 0.0 or not any(distance.low > 0.0 for distance, _ in intervals):
        return finding
    return find_largest(intervals, MEAN_TOLERANCE, "largest difference of a mean rank from 1/2")


def _mean_interval(mean: float, count: float, level: float) -> Interval:
    """Return an interval for |E u - 1/2| of ``count`` uniform numbers u in [0, 1] (normal limits);
    ``mean`` is that of u - 1/2.

    The interval misses the truth with at most the probability ``level``.
    """
    reach = -float(scipy.special.ndtri(level / 2.0)) / np.sqrt(12.0 * count)
    return deviation_interval(0.5, Interval(0.5 + mean, 0.5 + mean - reach, 0.5 + mean + reach))


FIXED = Promise(
    "messages take the time of the scenario",
    "the scenario",
    (),
    _check_fixed,
    exact=True,
    group=DELAYS,
)
LAW = Promise(
    "delays of messages have the law of the scenario, independent of each other",
    "the scenario",
    (),
    _check_law,
    group=DELAYS,
)


def delay_promises(samples: Any) -> list[Promise]:
    """Return the promise about delays, if they have a stated law and messages were sent."""
    if samples.delays is None or not samples.fates.sent.any():
        return []
    return [LAW if stated_delay(samples.scenario).fixed is None else FIXED]
