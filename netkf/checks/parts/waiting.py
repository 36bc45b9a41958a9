"""Waiting times (gaps between ticks, delays of messages) that the end of a run cuts off.

A waiting time is looked at only if it begins so early that the run shows whether it exceeds a
``cut``; one that does, or is still unfinished at the end, is of unknown length beyond the cut. So
the shares of waiting times below the cut are those of the stated law itself, not of what the end of
the run leaves of it. Whether one is looked at depends on the past only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.checks.parts.moments import CELLS, correlation_interval
from netkf.checks.statistics import Interval
from netkf.linalg.arrays import FloatArray


class WaitingLaw(NamedTuple):
    """A stated law: distribution function of waiting times in seconds, and its inverse."""

    cdf: Callable[[FloatArray], FloatArray]
    quantile: Callable[[FloatArray], FloatArray]


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


def exponential_law(rate: FloatArray) -> WaitingLaw:
    """Return the law of K exponential waiting times with the rates (K,) in 1/s."""
    return WaitingLaw(lambda t: -np.expm1(-rate * t), lambda p: -np.log1p(-p) / rate)


def uniform_law(low: float, width: float) -> WaitingLaw:
    """Return the law of waiting times that are uniform between ``low`` and ``low + width``."""
    return WaitingLaw(
        lambda t: np.clip((t - low) / width, 0.0, 1.0), lambda p: np.asarray(low + p * width)
    )


def censored_ranks(
    law: WaitingLaw, begin: FloatArray, duration: FloatArray, horizon: float
) -> Ranks:
    """Return the ranks of K waiting times under their ``law``, which ``begin`` (K,) and have the
    ``duration`` (K,) in seconds, inf for those unfinished at the end of the run, the ``horizon``.
    """
    # A cut of at most half of the run leaves waiting times to look at.
    known = np.floor(CELLS * law.cdf(np.full(len(begin), 0.5 * horizon)) + 1e-9)
    known = np.clip(known, 0.0, CELLS - 1.0)
    cut = law.quantile(known / CELLS)
    short = duration <= cut
    rank = np.where(short, law.cdf(np.where(short, duration, 0.0)), 1.0)
    # Rounding must not move a rank over the cut.
    rank = np.where(short, np.minimum(rank, known / CELLS - 1e-12), rank)
    return Ranks(np.where((known > 0.0) & (begin < horizon - cut), rank, np.nan), known)


def count_ranks(ranks: Ranks) -> FloatArray:
    """Return for each of CELLS equal parts of [0, 1] how many ranks are in it, and how many could
    be seen in it, (CELLS, 2).
    """
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


def fill_in_normal(ranks: Ranks) -> FloatArray:
    """Return the ranks (K,), where they are beyond the known parts with the one that as a standard
    normal number has the mean of what is beyond.
    """
    limit = np.clip(ranks.known / CELLS, 1e-12, 1.0 - 1e-12)
    quantile = scipy.special.ndtri(limit)
    density = np.exp(-0.5 * quantile**2) / math.sqrt(2.0 * math.pi)
    beyond = scipy.special.ndtr(density / (1.0 - limit))
    return np.asarray(np.where(ranks.is_beyond, beyond, ranks.rank))


def correlate_neighbours(uniform: np.ndarray, first: np.ndarray) -> FloatArray:
    """Return the sums (3,) from which :func:`correlation_of_neighbours` tests that successive gaps
    (or delays) are independent: over neighbours u, v of a series ``uniform`` (K,) of uniform
    numbers, made normal, those of u v and of (u^2 + v^2) / 2, and their number.

    Numbers that are nan, and the pairs of a number marked as ``first`` (K,) of its clock with the
    one before it, are left out.
    """
    normal = scipy.special.ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12))
    pairs = ~first[1:] & np.isfinite(normal[1:]) & np.isfinite(normal[:-1])
    u, v = normal[1:][pairs], normal[:-1][pairs]
    return np.array([u @ v, 0.5 * (u @ u + v @ v), float(len(u))])


def correlation_of_neighbours(products: FloatArray, level: float) -> Interval | None:
    """Return an interval for the correlation of neighbouring numbers from the ``products`` (R, 3)
    of R runs, see :func:`correlate_neighbours`; None for fewer than 10 CELLS pairs.

    The interval misses the truth with at most the probability ``level``.
    """
    total, squares, pairs = products.sum(axis=0)
    if pairs < 10 * CELLS:
        return None
    return correlation_interval(float(total / squares), pairs, level)
