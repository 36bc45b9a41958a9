"""Moments of noises that should be standard normal and white, and their tests.

A noise is whitened by the covariance that the scenario states. What is left then has the moments of
independent standard normal numbers, whatever the scenario, and runs only add up their sums.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.checks.evidence import Finding
from netkf.checks.laws import find_largest
from netkf.checks.statistics import (
    Interval,
    detectable_shift,
    deviation_interval,
    scale_interval,
)
from netkf.linalg.arrays import FloatArray

VARIANCE_TOLERANCE, MEAN_TOLERANCE, CORRELATION_TOLERANCE = 0.1, 0.1, 0.2
"""Tolerated relative error of a variance, mean in standard deviations, and correlation."""
LEAST = 1e-10
"""Share of the largest variance below which a direction has no noise."""
MIN_COUNT = 20


class NoiseMoments(NamedTuple):
    """Sums over whitened noises z of d entries, some of which may be missing: how often two entries
    were there ``together`` (d, d), sums of z (d,), of z z' (d, d), and of z z' with the z
    before it (d, d), of which there are ``pairs`` (d, d).
    """

    together: FloatArray
    first: FloatArray
    second: FloatArray
    lagged: FloatArray
    pairs: FloatArray


def moments(z: FloatArray) -> NoiseMoments:
    """Return the sums over a series z (S, d), in which missing entries are nan."""
    there = np.isfinite(z).astype(float)
    z = np.where(there > 0.0, z, 0.0)
    return NoiseMoments(
        there.T @ there, z.sum(axis=0), z.T @ z, z[1:].T @ z[:-1], there[1:].T @ there[:-1]
    )


def total(many: NoiseMoments) -> NoiseMoments:
    """Return the sums over all runs, from stacked ones."""
    return NoiseMoments(*(part.sum(axis=0) for part in many))


def whitening_matrix(covariance: FloatArray) -> FloatArray:
    """Return a matrix (d, n) that makes a noise with this covariance white; d is its rank."""
    values, vectors = np.linalg.eigh(covariance)
    used = values > LEAST * max(values[-1], 0.0)
    return np.asarray((vectors[:, used] / np.sqrt(values[used])).T)


def compare_variances(found: NoiseMoments, labels: list[str], level: float, what: str) -> Finding:
    """Test that all entries together, and each of them, have the variance 1."""
    counts, squares = np.diagonal(found.together), np.diagonal(found.second)
    if counts.max() < MIN_COUNT:
        return nothing_to_see(VARIANCE_TOLERANCE)
    whole = scale_interval(float(squares.sum()), float(counts.sum()), level / 2.0)
    intervals = [(deviation_interval(1.0, whole), f"all {what} together")]
    share = level / (2.0 * len(squares))
    for value, count, label in zip(squares.tolist(), counts.tolist(), labels, strict=True):
        if count >= MIN_COUNT:
            intervals.append((deviation_interval(1.0, scale_interval(value, count, share)), label))
    message = f"variances over the stated ones, {counts.sum():,.0f} values,"
    return with_best(intervals, VARIANCE_TOLERANCE, message)


def compare_means(found: NoiseMoments, labels: list[str], level: float) -> Finding:
    """Test that every entry has the mean 0."""
    counts = np.diagonal(found.together)
    if counts.max() < MIN_COUNT:
        return nothing_to_see(MEAN_TOLERANCE)
    share, intervals = level / len(labels), []
    for total_, count, label in zip(found.first.tolist(), counts.tolist(), labels, strict=True):
        if count < MIN_COUNT:
            continue
        # The mean of standard normal numbers is normal, with a variance that is known.
        value, deviation = total_ / count, 1.0 / math.sqrt(count)
        reach = deviation * -float(scipy.special.ndtri(share / 2.0))
        mean = Interval(value, value - reach, value + reach, detectable_shift(deviation, share))
        intervals.append((deviation_interval(0.0, mean), label))
    return find_largest(intervals, MEAN_TOLERANCE, "largest mean in standard deviations")


def compare_correlations(found: NoiseMoments, labels: list[str], level: float) -> Finding:
    """Test that different entries are not correlated, and none with any entry just before."""
    entries = [*_between(found, labels), *_in_time(found, labels)]
    entries = [entry for entry in entries if entry[1] >= MIN_COUNT]
    if not entries:
        return nothing_to_see(CORRELATION_TOLERANCE)
    share, intervals = level / len(entries), []
    for value, count, label in entries:
        intervals.append(
            (deviation_interval(0.0, correlation_interval(value, count, share)), label)
        )
    return find_largest(intervals, CORRELATION_TOLERANCE, "largest correlation")


def correlation_interval(value: float, count: float, level: float) -> Interval:
    """Return an interval for the correlation of two normal numbers of which ``count`` pairs were
    seen, by Fisher's transformation.
    """
    spread = 1.0 / math.sqrt(max(count - 3.0, 1.0))
    centre = math.atanh(min(max(value, -1.0 + 1e-12), 1.0 - 1e-12))
    reach = -spread * float(scipy.special.ndtri(level / 2.0))
    low, high = math.tanh(centre - reach), math.tanh(centre + reach)
    return Interval(value, low, high, math.tanh(detectable_shift(spread, level)))


def _between(found: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, count and label of all pairs of entries."""
    related = _correlations(found, found.second, found.together)
    for i in range(len(labels)):
        for j in range(i):
            yield float(related[i, j]), float(found.together[i, j]), f"{labels[j]} and {labels[i]}"


def _in_time(found: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, count and label of all entries with all entries just before."""
    related = _correlations(found, found.lagged, found.pairs)
    for i, label in enumerate(labels):
        for j, before in enumerate(labels):
            pairs = float(found.pairs[i, j])
            yield float(related[i, j]), pairs, f"{label} and {before} just before"


def _correlations(found: NoiseMoments, products: FloatArray, counts: FloatArray) -> FloatArray:
    """Return correlations (d, d) from sums of products of so many pairs; 0 without any."""
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.sqrt(np.diagonal(found.second) / np.diagonal(found.together))
        return np.asarray(np.nan_to_num(products / counts / np.outer(size, size)))


def with_best(intervals: list[tuple[Interval, str]], tolerance: float, message: str) -> Finding:
    """Return the finding of one interval over everything, the first, and of its parts.

    A part that is off is the finding; else what is known of everything, which is more precise.
    """
    off = [item for item in intervals if item[0].low > 0.0]
    if off:
        return find_largest(intervals, tolerance, message)
    finding = find_largest(intervals[:1], tolerance, message)
    if len(intervals) == 1:
        return finding
    worst, label = max(intervals[1:], key=lambda item: item[0].value)
    text = f"{finding.message}; furthest off {label}: {worst.value:.3g}"
    if math.isfinite(worst.detectable):
        text += f", {worst.detectable:.2g} would have been seen"
    return finding._replace(message=text)


def nothing_to_see(tolerance: float) -> Finding:
    """Return the finding of a row that has too few values to say anything."""
    return Finding((0.0, -math.inf, 0.0), tolerance, "too few values in these runs")
