"""Comparisons that papers in slots share: laws of covariances, and errors against covariances."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.checks.evidence import Finding, Row
from netkf.checks.statistics import Interval, distance, excess, mean_ratio, off_by
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario

LAW, NEES = 0.2, 0.25
"""Tolerances: distance of distribution functions, relative difference of the mean NEES from n."""
GROWTH = 4.0


class Pair(NamedTuple):
    """Two samples of covariances (S, n, n) and (S', n, n) that should have one law.

    They may depend on each other. ``known`` (n,) is how far apart their laws are known to be,
    because the promise is about later times; it is taken off.
    """

    words: str
    one: FloatArray
    other: FloatArray
    known: FloatArray | None = None


def worst(found: Sequence[tuple[Interval, str]], tolerance: float, words: str) -> Finding:
    """The margin of several distances that should all be 0, each at its share of the level."""
    chosen, place = max(found, key=lambda item: (item[0].low, item[0].value))
    widest = max(interval.high for interval, _ in found)
    text = f"{words} in {len(found)} comparisons, {place}"
    return Finding((-chosen.value, -widest, -chosen.low), tolerance, text)


def same_laws(pairs: Sequence[Pair], level: float) -> Finding:
    """Whether pairs of samples have equal laws, entry by entry of the diagonal: ranks need no
    moments.
    """
    share = level / sum(pair.one.shape[-1] for pair in pairs)
    found = []
    for pair in pairs:
        for k in range(pair.one.shape[-1]):
            apart = distance(pair.one[:, k, k], pair.other[:, k, k], share)
            if pair.known is not None:
                value, low, high = (max(0.0, end - float(pair.known[k])) for end in apart)
                apart = Interval(value, low, high)
            found.append((apart, f"at {pair.words}, entry {k}"))
    early = any(pair.known is not None and pair.known.max() > LAW for pair in pairs)
    return worst(found, LAW, "largest distance of distribution functions")._replace(early=early)


def distances(one: FloatArray, other: FloatArray) -> FloatArray:
    """(n,) largest differences of the distribution functions of the diagonals of two samples."""
    return np.array(
        [distance(one[:, k, k], other[:, k, k], 0.5).value for k in range(one.shape[-1])]
    )


def not_growing(pairs: Sequence[Pair], level: float) -> Finding:
    """Whether the later sample is stochastically at most four times the earlier one."""
    share = level / sum(pair.one.shape[-1] for pair in pairs)
    found = [
        (
            excess(GROWTH * pair.one[:, k, k], pair.other[:, k, k], share),
            f"at {pair.words}, entry {k}",
        )
        for pair in pairs
        for k in range(pair.one.shape[-1])
    ]
    words = f"largest excess of P(P > {GROWTH:g} J) at the end over P(P > J) at half of the time"
    return worst(found, LAW, words)


def chi_squared(
    ratios: FloatArray, freedom: Sequence[float], places: Sequence[str], level: float, words: str
) -> Finding:
    """Whether squares over their degrees of freedom (runs, places) have mean 1; over all runs of a
    place they have ``freedom`` together, and are chi-square exactly.
    """
    kept = np.flatnonzero(np.isfinite(ratios).all(axis=0))
    if not len(kept):
        nan = float("nan")
        return Finding((nan, nan, nan), NEES, f"{words} does not exist: singular or not finite")
    found = []
    for k in kept.tolist():
        total = float(ratios[:, k].mean()) * freedom[k]
        ratio = mean_ratio(total, freedom[k], level / len(kept))
        found.append((off_by(1.0, ratio), f"at {places[k]}"))
    return worst(found, NEES, f"largest relative difference of the mean {words} from its freedom")


def exact_start(scenario: Scenario) -> Row:
    """Whether every filter starts with the mean and the covariance of x(0)."""
    plant = scenario.plant
    off = [
        node
        for node in scenario.nodes
        for mean, cov in [scenario.start(node)]
        if not (np.array_equal(mean, plant.start_mean) and np.array_equal(cov, plant.start_cov))
    ]
    words = "mean and covariance are the plant's"
    if off:
        words = f"node {off[0]}{' and others' if off[1:] else ''}: not the plant's"
    return Row("the filters start with the law of x(0)", "G (10), R (15)", not off, words)
