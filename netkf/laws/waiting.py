"""Waiting times (gaps between ticks, delays of messages) that the end of a run cuts off.

The distribution function of a law maps waiting times to ranks, which are uniform in [0, 1] whatever
the law, so that those of all clocks, links and runs can be counted in the same few cells.

A waiting time is looked at only if it begins so early that the run shows whether it exceeds a
``cut``; one that does, or is still unfinished at the end, is of unknown length beyond the cut. So
the shares of waiting times below the cut are those of the stated law itself, not of what the end of
the run leaves of it. Whether one is looked at depends on the past only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import scipy

from netkf.core.laws import WaitingLaw
from netkf.laws.intervals import (
    NO_COMPARISON,
    Interval,
    LawComparison,
    correlation_interval,
    deviation_interval,
    probability_interval,
)
from netkf.linalg.arrays import FloatArray

CELLS = 16
"""Number of cells of equal probability."""
MIN_SEEN = 10 * CELLS
"""Values, or pairs of them, from which laws and correlations of ranks are tested."""


class Ranks(NamedTuple):
    """Waiting times as numbers that are uniform in [0, 1] under the stated law.

    rank  : (K,) P(waiting time <= this one); nan if it is not looked at
    known : (K,) number of the CELLS equal parts of [0, 1], from the lowest on, that a run can show;
            a rank beyond them is only known to be so
    """

    rank: FloatArray
    known: np.ndarray

    @property
    def is_beyond(self) -> np.ndarray:
        """Mask (K,) of the ranks that are only known to lie beyond the ``known`` parts."""
        return np.asarray(CELLS * self.rank >= self.known)


def censored_ranks(
    law: WaitingLaw, begin: FloatArray, duration: FloatArray, horizon: FloatArray | float
) -> Ranks:
    """Return the ranks of K waiting times, which ``begin`` (K,) and last a ``duration`` (K,), inf
    for those unfinished at the ``horizon``, under their ``law``.
    """
    # A cut of at most half of the run leaves waiting times to look at.
    known = np.floor(CELLS * law.cdf(np.broadcast_to(0.5 * horizon, begin.shape)) + 1e-9)
    known = np.clip(known, 0.0, CELLS - 1.0)
    cut = law.quantile(np.arange(CELLS) / CELLS)[np.nan_to_num(known).astype(np.int64)]
    short = duration <= cut
    rank = np.where(short, law.cdf(np.where(short, duration, 0.0)), 1.0)
    # Rounding must not move a rank over the cut.
    rank = np.where(short, np.minimum(rank, known / CELLS - 1e-12), rank)
    return Ranks(np.where((known > 0.0) & (begin < horizon - cut), rank, np.nan), known)


def count_ranks(ranks: Ranks) -> FloatArray:
    """Return how many ranks are, and could be, in each of CELLS parts of [0, 1], (CELLS, 2)."""
    looked_at = np.isfinite(ranks.rank)
    rank, known = ranks.rank[looked_at], ranks.known[looked_at].astype(np.int64)
    cells = np.minimum((CELLS * rank).astype(np.int64), CELLS - 1)
    # With all parts but the last known, a rank beyond them is in the last.
    seen = (cells < known) | (known >= CELLS - 1)
    hits = np.bincount(cells[seen], minlength=CELLS)
    visible = np.bincount(np.where(known >= CELLS - 1, CELLS, known), minlength=CELLS + 1)
    trials = visible[::-1].cumsum()[::-1][1:]
    return np.stack([hits, trials], axis=1).astype(np.float64)


def fill_in(ranks: Ranks) -> FloatArray:
    """Return the ranks (K,), with the mean of what is beyond the known parts where they are."""
    beyond = 0.5 * (ranks.known / CELLS + 1.0)
    return np.asarray(np.where(ranks.is_beyond, beyond, ranks.rank))


def correlate_neighbours(ranks: Ranks, first: np.ndarray) -> FloatArray:
    """Return sums (3,) over neighbouring ranks u, v as normal numbers: of u v, of (u^2 + v^2) / 2,
    and 1.

    Pairs with nan, or with the ``first`` (K,) of a series, are left out; a rank beyond the known
    parts counts as the mean of what is beyond.
    """
    limits = np.clip(np.arange(CELLS + 1) / CELLS, 1e-12, 1.0 - 1e-12)
    density = np.exp(-0.5 * scipy.special.ndtri(limits) ** 2) / math.sqrt(2.0 * math.pi)
    means = density / (1.0 - limits)
    seen = scipy.special.ndtri(np.clip(ranks.rank, 1e-12, 1.0 - 1e-12))
    normal = np.where(ranks.is_beyond, means[np.nan_to_num(ranks.known).astype(np.int64)], seen)
    pairs = ~first[1:] & np.isfinite(normal[1:]) & np.isfinite(normal[:-1])
    u, v = normal[1:][pairs], normal[:-1][pairs]
    return np.array([u @ v, 0.5 * (u @ u + v @ v), float(len(u))])


def neighbour_correlation(products: FloatArray, level: float) -> Interval | None:
    """Return the interval of the correlation of neighbours, None for few pairs."""
    total, squares, pairs = products.sum(axis=0)
    if pairs < MIN_SEEN:
        return None
    return correlation_interval(float(total / squares), pairs, level)


def compare_shares(cells: FloatArray, level: float, noun: str) -> LawComparison:
    """Compare waiting times with their law: how many are in cells of equal probability, and could
    be, (CELLS, 2), without cells that few runs can show.
    """
    visible = [k for k, trials in enumerate(cells[:, 1].tolist()) if trials >= MIN_SEEN]
    if not visible:
        return NO_COMPARISON
    distances = [
        (cell_interval(cells[k, 0], cells[k, 1], level / len(visible)), cell_label(k))
        for k in visible
    ]
    text = f"{cells[0, 1]:,.0f} {noun}, largest difference of a share from 1/{CELLS}"
    if len(visible) < CELLS:
        text += f" (runs are too short to show ranks above {(visible[-1] + 1) / CELLS:.2f})"
    return LawComparison(distances, text)


def cell_interval(count: float, total: float, level: float) -> Interval:
    """Return the interval of the distance between a cell's share and its probability."""
    return deviation_interval(1.0 / CELLS, probability_interval(int(count), int(total), level))


def cell_label(k: int) -> str:
    """Return the range of ranks of cell ``k``, from 0 to CELLS - 1, as text."""
    return f"rank {k / CELLS:.2f} to {(k + 1) / CELLS:.2f}"
