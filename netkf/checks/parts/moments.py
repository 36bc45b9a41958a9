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
    probability_interval,
    scale_interval,
    student_interval,
)
from netkf.linalg.arrays import FloatArray

VARIANCE_TOLERANCE, MEAN_TOLERANCE, CORRELATION_TOLERANCE = 0.1, 0.1, 0.2
"""Tolerated relative error of a variance, mean in standard deviations, and correlation."""
CELLS, SHARE_TOLERANCE = 16, 0.02
"""Cells of equal probability into which numbers of a known law are sorted, and the tolerated error
of the share of one.
"""
MIN_VARIANCE_SHARE = 1e-10
"""Share of the largest variance below which a direction has no noise."""
FURTHER, PARTS = 3, 4
"""Lags beyond the first at which each entry is compared with itself, and parts of a series in which
all variances together are.
"""
MIN_RUNS = 10
"""Runs from whose spread an interval is computed."""
MIN_COUNT, MIN_COUNT_OF_ANY_LAW = 20, 200
"""Numbers from which means and variances are judged; of the latter if the law is not known."""


class NoiseMoments(NamedTuple):
    """Sums over whitened noises z of d entries, some of which may be missing: how often two entries
    were there ``together`` (d, d), sums of z (d,), of z z' (d, d), and of z z' with the z
    before it (d, d), of which there are ``pairs`` (d, d); how many of each lie in the ``cells``
    (CELLS, d), which standard normal numbers fill evenly; and sums of z^4, ``fourth`` (d,).

    squares  : (3, d, d) sums of z_i^2 where z_j was there too; of z_i^2 where z_j was there before;
        and of that z_j^2
    further  : (FURTHER, 4, d) number and sum of products of each entry with itself two and more
        noises before, and of the squares of both
    sizes    : (5, d) number of pairs of neighbours, and sums over them of r, of the r before, of
        r^2 and of their products, r the rank of |z| among those of standard normal numbers
    variance : (PARTS, 2) number and sum of z^2 of all entries in each part of the series
    states   : (4, n, d) products of z with n numbers that tell the state which a noise is added to:
        how many there are, their sum in a run, its square, and 1 for the run if there are any
    """

    together: FloatArray
    first: FloatArray
    second: FloatArray
    lagged: FloatArray
    pairs: FloatArray
    cells: FloatArray
    fourth: FloatArray
    squares: FloatArray
    further: FloatArray
    sizes: FloatArray
    variance: FloatArray
    states: FloatArray


def moments(z: FloatArray, states: FloatArray | None = None) -> NoiseMoments:
    """Return the sums over a series z (S, d), in which missing entries are nan, and with numbers
    ``states`` (S, n, d) that tell the state to which each was added.
    """
    known = np.isfinite(z)
    there = known.astype(float)
    z = np.where(known, z, 0.0)
    rank = np.where(known, 2.0 * scipy.special.ndtr(np.abs(z)) - 1.0, 0.0)
    square = z**2
    later = [
        [
            there[k:] * there[:-k],
            z[k:] * z[:-k],
            square[k:] * there[:-k],
            there[k:] * square[:-k],
        ]
        for k in range(2, FURTHER + 2)
    ]
    parts = zip(np.array_split(there, PARTS), np.array_split(z, PARTS), strict=True)
    known_states = np.zeros((len(z), 0, z.shape[1])) if states is None else np.nan_to_num(states)
    number, added = (
        (there[:, None] * (known_states != 0.0)).sum(axis=0),
        (z[:, None] * known_states).sum(axis=0),
    )
    return NoiseMoments(
        there.T @ there,
        z.sum(axis=0),
        z.T @ z,
        z[1:].T @ z[:-1],
        there[1:].T @ there[:-1],
        count_cells(scipy.special.ndtr(z), known),
        (z**4).sum(axis=0),
        np.array([square.T @ there, square[1:].T @ there[:-1], there[1:].T @ square[:-1]]),
        np.array([[sums.sum(axis=0) for sums in lag] for lag in later]),
        np.array(
            [
                (there[1:] * there[:-1]).sum(axis=0),
                (rank[1:] * there[:-1]).sum(axis=0),
                (there[1:] * rank[:-1]).sum(axis=0),
                (rank[1:] ** 2 * there[:-1]).sum(axis=0),
                (rank[1:] * rank[:-1]).sum(axis=0),
            ]
        ),
        np.array([[number.sum(), (part**2).sum()] for number, part in parts]),
        np.array([number, added, added**2, number > 0.0]),
    )


def count_cells(u: FloatArray, known: np.ndarray) -> FloatArray:
    """Return how many of the ``known`` numbers u (S, d) in [0, 1] lie in each cell, (CELLS, d)."""
    index = np.minimum((CELLS * u).astype(np.int64), CELLS - 1) * u.shape[1] + np.arange(u.shape[1])
    counts = np.bincount(index[known], minlength=CELLS * u.shape[1])
    return counts.reshape(CELLS, u.shape[1]).astype(float)


def total(many: NoiseMoments) -> NoiseMoments:
    """Return the sums over all runs, from stacked ones."""
    return NoiseMoments(*(part.sum(axis=0) for part in many))


def whitening_matrix(covariance: FloatArray) -> FloatArray:
    """Return a matrix (d, n) that makes a noise with this covariance white; d is its rank."""
    values, vectors = np.linalg.eigh(covariance)
    used = values > MIN_VARIANCE_SHARE * max(values[-1], 0.0)
    return np.asarray((vectors[:, used] / np.sqrt(values[used])).T)


def compare_variances(
    found: NoiseMoments, labels: list[str], level: float, what: str, gaussian: bool = True
) -> Finding:
    """Test that all entries together, and each of them, have the variance 1; numbers that need not
    be Gaussian are judged by their own fourth moment.
    """
    counts, squares = np.diagonal(found.together), np.diagonal(found.second)
    least = MIN_COUNT if gaussian else MIN_COUNT_OF_ANY_LAW
    if counts.max() < least:
        return nothing_to_see(VARIANCE_TOLERANCE)

    def interval(square: float, fourth: float, count: float, part: float) -> Interval:
        """Return the interval of a variance relative to the stated one, at level ``part``."""
        # The freedom of a chi-square variable whose variance is that of the sum of squares.
        excess = 0.0 if gaussian else count * fourth / square**2 - 3.0
        freedom = 2.0 * count / max(2.0 + excess, 2.0)
        scale = scale_interval(freedom * square / count, freedom, part)
        return deviation_interval(1.0, scale)

    sums = float(squares.sum()), float(found.fourth.sum()), float(counts.sum())
    intervals = [(interval(*sums, level / 3.0), f"all {what} together")]
    for k, (count, square) in enumerate(found.variance.tolist()):
        if count >= least:
            # The fourth moment is that of all parts.
            part = square, sums[1] * count / sums[2] * (square / count * sums[2] / sums[0]) ** 2
            label = f"all {what} in part {k + 1} of {PARTS} of a run"
            intervals.append((interval(*part, count, level / (3.0 * PARTS)), label))
    share = level / (3.0 * len(squares))
    for k, label in enumerate(labels):
        if counts[k] >= MIN_COUNT:
            one = float(squares[k]), float(found.fourth[k]), float(counts[k])
            intervals.append((interval(*one, share), label))
    message = f"variances over the stated ones, {counts.sum():,.0f} values,"
    return with_best(intervals, VARIANCE_TOLERANCE, message)


def compare_means(found: NoiseMoments, labels: list[str], level: float) -> Finding:
    """Test that every entry has the mean 0, whatever the state is: none is correlated with it."""
    counts = np.diagonal(found.together)
    if counts.max() < MIN_COUNT:
        return nothing_to_see(MEAN_TOLERANCE)
    states = _with_states(found, labels, level / 2.0)
    share, intervals = level / ((2.0 if states else 1.0) * len(labels)), []
    for total_, count, label in zip(found.first.tolist(), counts.tolist(), labels, strict=True):
        if count < MIN_COUNT:
            continue
        # The mean of standard normal numbers is normal, with a variance that is known.
        value, deviation = total_ / count, 1.0 / math.sqrt(count)
        reach = deviation * -float(scipy.special.ndtri(share / 2.0))
        mean = Interval(value, value - reach, value + reach, detectable_shift(deviation, share))
        intervals.append((deviation_interval(0.0, mean), label))
    message = "largest mean in standard deviations"
    message += ", or correlation with a state," if states else ""
    return find_largest([*intervals, *states], MEAN_TOLERANCE, message)


def _with_states(
    found: NoiseMoments, labels: list[str], level: float
) -> list[tuple[Interval, str]]:
    """Return correlations and labels of all entries with the states that they are added to.

    States of one run may be much alike, so that runs are what is independent.
    """
    counts, sums, squares, runs = found.states
    used = np.argwhere((runs >= MIN_RUNS) & (squares > 0.0)).tolist()
    intervals = []
    for j, i in used:
        count, spread = float(counts[j, i]), math.sqrt(squares[j, i])
        related = student_interval(
            float(sums[j, i]) / count, spread / count, int(runs[j, i]), level / len(used)
        )
        intervals.append((deviation_interval(0.0, related), f"{labels[i]} and state {j}"))
    return intervals


def compare_correlations(found: NoiseMoments, labels: list[str], level: float) -> Finding:
    """Test that different entries are not correlated, none with any entry just before, nor with
    itself before that, and that large ones do not follow large or small ones.
    """
    entries = [*_between(found, labels), *_in_time(found, labels), *_in_size(found, labels)]
    entries = [entry for entry in entries if entry[1] >= MIN_COUNT]
    if not entries:
        return nothing_to_see(CORRELATION_TOLERANCE)
    share, intervals = level / len(entries), []
    for value, count, label in entries:
        intervals.append(
            (deviation_interval(0.0, correlation_interval(value, count, share)), label)
        )
    return find_largest(intervals, CORRELATION_TOLERANCE, "largest correlation")


def compare_cells(cells: FloatArray, labels: list[str], level: float, what: str) -> Finding:
    """Test that numbers counted in ``cells`` (CELLS, d) fill all cells evenly, those of all columns
    together and each column.
    """
    counts = cells.sum(axis=0)
    if counts.sum() < 10 * CELLS:
        return nothing_to_see(SHARE_TOLERANCE)
    intervals = [
        (_cell_interval(count, counts.sum(), level / (2.0 * CELLS)), f"all, {_cell_label(k)}")
        for k, count in enumerate(cells.sum(axis=1).tolist())
    ]
    share = level / (2.0 * CELLS * len(labels))
    for column, label in enumerate(labels if len(labels) > 1 else ()):
        if counts[column] >= 10 * CELLS:
            for k, count in enumerate(cells[:, column].tolist()):
                apart = _cell_interval(count, counts[column], share)
                intervals.append((apart, f"{label}, {_cell_label(k)}"))
    message = f"{counts.sum():,.0f} {what}, largest difference of a share from 1/{CELLS}"
    return with_best(intervals, SHARE_TOLERANCE, message, CELLS)


def _cell_interval(count: float, total: float, level: float) -> Interval:
    """Return the interval of the distance between a cell's share of ranks and 1 / CELLS."""
    return deviation_interval(1.0 / CELLS, probability_interval(int(count), int(total), level))


def _cell_label(k: int) -> str:
    """Return the range of ranks of a cell as text."""
    return f"rank {k / CELLS:.2f} to {(k + 1) / CELLS:.2f}"


def correlation_interval(value: float, count: float, level: float) -> Interval:
    """Return an interval for the correlation of two normal numbers of which ``count`` pairs were
    seen, by Fisher's transformation.
    """
    spread = 1.0 / math.sqrt(max(count - 3.0, 1.0))
    reach = -spread * float(scipy.special.ndtri(level / 2.0))

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return both ends for another correlation and ``factor`` times the samples."""
        centre = math.atanh(min(max(value, -1.0 + 1e-12), 1.0 - 1e-12))
        wide = reach / math.sqrt(factor)
        return math.tanh(centre - wide), math.tanh(centre + wide)

    detectable = math.tanh(detectable_shift(spread, level))
    return Interval(value, *limits(value, 1.0), detectable, again=limits)


def _between(found: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, count and label of all pairs of entries."""
    related = _correlations(found.second, found.squares[0], found.squares[0].T)
    for i in range(len(labels)):
        for j in range(i):
            yield float(related[i, j]), float(found.together[i, j]), f"{labels[j]} and {labels[i]}"


def _in_time(found: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, count and label of all entries with all entries just before."""
    related = _correlations(found.lagged, *found.squares[1:])
    for i, label in enumerate(labels):
        for j, before in enumerate(labels):
            pairs = float(found.pairs[i, j])
            yield float(related[i, j]), pairs, f"{label} and {before} just before"


def _in_size(found: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, count and label of each entry with itself some noises before, and of its
    size with that just before.
    """
    count, *sums = np.moveaxis(found.further, 1, 0)
    related = _correlations(*sums)
    for i, label in enumerate(labels):
        for k in range(FURTHER):
            yield float(related[k, i]), float(count[k, i]), f"{label} and itself {k + 2} before"
        pairs, after, before, square_, products = found.sizes[:, i].tolist()
        spread = pairs * square_ - after**2
        if pairs >= MIN_COUNT_OF_ANY_LAW and spread > 0.0:
            value = (pairs * products - after * before) / spread
            yield float(value), pairs, f"the size of {label} and of that just before"


def _correlations(products: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """Return correlations from the sums of products and of the squares of ``one`` and ``other``
    over the same pairs; 0 without pairs.
    """
    # Squares of other noises do not count: with them |correlation| could exceed 1.
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.nan_to_num(products / np.sqrt(one * other)))


def with_best(
    intervals: list[tuple[Interval, str]], tolerance: float, message: str, whole: int = 1
) -> Finding:
    """Return the finding of intervals over everything, the ``whole`` first ones, and of its parts.

    A part that is off is the finding; else what is known of everything, which is more precise.
    """
    finding = find_largest(intervals[:whole], tolerance, message)
    if any(apart.low > 0.0 for apart, _ in intervals):
        everything = finding.detectable
        return find_largest(intervals, tolerance, message)._replace(detectable=everything)
    if len(intervals) == whole:
        return finding
    worst, label = max(intervals[whole:], key=lambda item: item[0].value)
    text = f"{finding.message}; furthest off {label}: {worst.value:.3g}"
    if math.isfinite(worst.detectable):
        text += f", {worst.detectable:.2g} would have been seen"
    return finding._replace(message=text)


def nothing_to_see(tolerance: float) -> Finding:
    """Return the finding of a row that has too few values to say anything."""
    return Finding((0.0, -math.inf, 0.0), tolerance, "too few values in these runs")
