"""Comparisons of distributions that several papers share: covariances, and errors against them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.checks.evidence import Assumption, Finding
from netkf.checks.statistics import (
    Interval,
    deviation_interval,
    law_distance,
    law_excess,
    scale_interval,
)
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario

LAW_TOLERANCE, NEES_TOLERANCE = 0.2, 0.25
"""Tolerated distance of distribution functions, and relative difference of the mean NEES from n."""
GROWTH = 4.0
"""Factor by which a covariance may still be larger at the end than at half of the horizon."""


class Pair(NamedTuple):
    """Two samples of covariances (S, n, n) and (S', n, n) that should have one law.

    They may depend on each other. ``known`` (n,) is the distance of their laws that is known
    beforehand, since the promise is about later times; it is subtracted.
    """

    label: str
    one: FloatArray
    other: FloatArray
    known: FloatArray | None = None


def find_largest(
    distances: Sequence[tuple[Interval, str]], tolerance: float, message: str
) -> Finding:
    """Return the finding on distances that should all be 0, each with a label and an interval at
    its share of the level.
    """
    chosen, label = max(distances, key=lambda item: (item[0].low, item[0].value))
    widest = max(interval.high for interval, _ in distances)
    text = f"{message} in {len(distances)} comparisons, {label}"
    return Finding((-chosen.value, -widest, -chosen.low), tolerance, text)


def compare_laws(pairs: Sequence[Pair], level: float) -> Finding:
    """Compare the laws of pairs of samples, entry by entry of the diagonal: ranks need no moments
    of the covariances.
    """
    share = level / sum(pair.one.shape[-1] for pair in pairs)
    found = []
    for pair in pairs:
        for k in range(pair.one.shape[-1]):
            apart = law_distance(pair.one[:, k, k], pair.other[:, k, k], share)
            if pair.known is not None:
                value, low, high = (max(0.0, end - float(pair.known[k])) for end in apart)
                apart = Interval(value, low, high)
            found.append((apart, f"at {pair.label}, entry {k}"))
    early = any(pair.known is not None and pair.known.max() > LAW_TOLERANCE for pair in pairs)
    message = "largest distance of distribution functions"
    return find_largest(found, LAW_TOLERANCE, message)._replace(early=early)


def diagonal_distances(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the largest differences (n,) between the empirical distribution functions of the
    diagonals of two samples (S, n, n) and (S', n, n).
    """
    return np.array(
        [law_distance(one[:, k, k], other[:, k, k], 0.5).value for k in range(one.shape[-1])]
    )


def compare_growth(pairs: Sequence[Pair], level: float) -> Finding:
    """Test that the later sample of each pair is stochastically at most GROWTH times the earlier
    one.
    """
    share = level / sum(pair.one.shape[-1] for pair in pairs)
    found = [
        (
            law_excess(GROWTH * pair.one[:, k, k], pair.other[:, k, k], share),
            f"at {pair.label}, entry {k}",
        )
        for pair in pairs
        for k in range(pair.one.shape[-1])
    ]
    message = f"largest excess of P(P > {GROWTH:g} J) at the end over P(P > J) at half of the time"
    return find_largest(found, LAW_TOLERANCE, message)


def compare_chi_square(
    ratios: FloatArray, freedom: Sequence[float], labels: Sequence[str], level: float, name: str
) -> Finding:
    """Test that squares over their degrees of freedom (R, K) have mean 1.

    The squares of column k, all runs together, are chi-square with ``freedom[k]`` degrees.
    """
    kept = np.flatnonzero(np.isfinite(ratios).all(axis=0))
    if not len(kept):
        message = f"{name} does not exist: singular or not finite"
        return Finding((math.nan,) * 3, NEES_TOLERANCE, message)
    found = []
    for k in kept.tolist():
        total = float(ratios[:, k].mean()) * freedom[k]
        ratio = scale_interval(total, freedom[k], level / len(kept))
        found.append((deviation_interval(1.0, ratio), f"at {labels[k]}"))
    message = f"largest relative difference of the mean {name} from its freedom"
    return find_largest(found, NEES_TOLERANCE, message)


def exact_start(scenario: Scenario) -> Assumption:
    """Return the assumption that every filter starts with the mean and the covariance of x(0)."""
    plant = scenario.plant
    off = [
        node
        for node in scenario.nodes
        for mean, cov in [scenario.start(node)]
        if not (np.array_equal(mean, plant.start_mean) and np.array_equal(cov, plant.start_cov))
    ]
    evidence = "mean and covariance are the plant's"
    if off:
        evidence = f"node {off[0]}{' and others' if off[1:] else ''}: not the plant's"
    return Assumption("the filters start with the law of x(0)", "G (10), R (15)", not off, evidence)
