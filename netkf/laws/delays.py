"""Delays of messages against the law that they state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.core.laws import WaitingLaw
from netkf.laws.intervals import Interval, LawComparison, deviation_interval, normal_interval
from netkf.laws.losses import MIN_COUNT, direction_label
from netkf.laws.waiting import (
    CELLS,
    censored_ranks,
    compare_shares,
    correlate_neighbours,
    count_ranks,
    fill_in,
    neighbour_correlation,
)
from netkf.linalg.arrays import FloatArray, IntArray


class DelayCounts(NamedTuple):
    """Delays of the messages of one run over D directions (directed links), by their ranks u,
    uniform in [0, 1] under the stated law; of R runs with a first axis of that length.

    cells    : (CELLS, 2) numbers of u in equal parts of [0, 1], and of those looked at
    products : (3,) sums over neighbouring delays of a direction (:func:`correlate_neighbours`)
    sums     : (2, D) of each direction the number of delays and the sum of u - 1/2; (2, 0) if all
               should be constant
    off      : () largest distance in seconds of a delay from a stated constant
    """

    cells: FloatArray
    products: FloatArray
    sums: FloatArray
    off: FloatArray


def count_fixed(ages: FloatArray, fixed: float) -> DelayCounts:
    """Return the distance of ``ages`` (K,) in seconds from a ``fixed`` delay, as counts."""
    largest_error = np.abs(ages - fixed).max(initial=0.0)
    return DelayCounts(np.zeros((CELLS, 2)), np.zeros(3), np.zeros((2, 0)), np.array(largest_error))


def count_delays(
    law: WaitingLaw,
    sent: FloatArray,
    ages: FloatArray,
    directions: IntArray,
    size: int,
    horizon: float,
) -> DelayCounts:
    """Return the counts of K messages, in order of direction and number, ``sent`` (K,) and taking
    ``ages`` (K,) seconds, inf where under way at the ``horizon``.
    """
    ranks = censored_ranks(law, sent, ages, horizon)
    # The first message of each direction has no neighbour before it.
    first = np.ones(len(sent), dtype=bool)
    first[1:] = directions[1:] != directions[:-1]
    seen, centred = np.isfinite(ranks.rank), fill_in(ranks) - 0.5
    sums = [np.bincount(directions[seen], w[seen], size) for w in (np.ones(len(sent)), centred)]
    products = correlate_neighbours(ranks, first)
    return DelayCounts(count_ranks(ranks), products, np.array(sums), np.array(0.0))


def compare_delays(
    counts: DelayCounts, links: Sequence[tuple[int, int]], level: float
) -> tuple[LawComparison, LawComparison]:
    """Compare delays of R runs with their law: of all (the first comparison), the mean rank of each
    direction, with their ``links``, and neighbours; each of the three gets a third of ``level``.
    """
    law = compare_shares(counts.cells.sum(axis=0), level / 3.0, "delays")
    number, excess = counts.sums.sum(axis=0)
    frequent = np.flatnonzero(number >= MIN_COUNT)
    distances: list[tuple[Interval, str]] = []
    for k in frequent.tolist():
        single = level / (3.0 * len(frequent))
        # The mean of numbers that are uniform has the variance 1 / (12 N), and is nearly normal.
        mean, deviation = 0.5 + excess[k] / number[k], 1.0 / np.sqrt(12.0 * number[k])
        interval = normal_interval(mean, deviation, single)
        distances.append((deviation_interval(0.5, interval), direction_label(links[k])))
    correlation = neighbour_correlation(counts.products, level / 3.0)
    if correlation is not None:
        label = "neighbouring ones, their correlation"
        distances.append((deviation_interval(0.0, correlation), label))
    return law, LawComparison(distances, "largest difference of a mean rank from 1/2")
