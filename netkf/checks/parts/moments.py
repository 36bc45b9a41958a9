"""Moments of noises that should be standard normal and white, and their tests.

Noises are whitened by the covariance that the scenario states. The results then have the moments of
independent standard normal numbers, whatever the scenario, so that sums over runs can be added.
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
"""Number of cells of equal probability, and tolerated error of the share of numbers in a cell."""
MIN_VARIANCE_SHARE = 1e-10
"""Share of the largest variance below which a direction has no noise."""
FURTHER, PARTS = 3, 4
"""Number of lags (2, 3, ...) of the autocorrelation of each entry, and of equal parts of a series
in which the pooled variance is tested.
"""
MIN_RUNS = 10
"""Runs from whose spread an interval is computed."""
MIN_EVENTS = 20
"""Events (losses, ticks), or runs with one, from which their sample variance is used."""
MIN_COUNT, MIN_COUNT_OF_ANY_LAW = 20, 200
"""Values from which means and variances are tested, and variances of numbers of an unknown law."""


class NoiseMoments(NamedTuple):
    """Sums over a series of whitened noises z_t (d,), some entries of which may be missing.

    together : (d, d) number of t at which entries i and j are both present
    first    : (d,) sums of z_i
    second   : (d, d) sums of z_i z_j
    lagged   : (d, d) sums of z_i(t) z_j(t - 1)
    pairs    : (d, d) number of terms of ``lagged``
    cells    : (CELLS, d) numbers of z_i in cells of equal probability under the normal law
    fourth   : (d,) sums of z_i^4
    squares  : (3, d, d) sums of z_i^2 over the terms of ``second``, of z_i(t)^2 over those of
               ``lagged``, and of z_j(t - 1)^2 over these
    further  : (FURTHER, 4, d) for lags k = 2, 3, ...: number of terms, and sums of
               z_i(t) z_i(t - k), of z_i(t)^2 and of z_i(t - k)^2
    sizes    : (5, d) with the rank r = P(|normal| <= |z_i|): number of neighbouring pairs, and
               sums over them of r(t), r(t - 1), r(t)^2 and r(t) r(t - 1)
    variance : (PARTS, 2) number and sum of squares of all entries in each part of the series
    states   : (4, n, d) of the products of z_i with the n states it is added to, in one run: their
               number, their sum, the square of that sum, and 1 if there are any
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
    """Return the sums from which variances, means, correlations and the law of a series of whitened
    noises z (S, d) are tested; missing entries are nan. Sums of several runs can be added.

    ``states`` (S, n, d) are the states, in units of their root mean square, to which each noise was
    added, or which the sensor read; 0 where none is known.
    """
    present = np.isfinite(z)
    # Missing entries are 0, so that they add nothing to sums of products, and have the weight 0.
    weight = present.astype(float)
    z = np.where(present, z, 0.0)
    rank = np.where(present, 2.0 * scipy.special.ndtr(np.abs(z)) - 1.0, 0.0)
    square = z**2
    # For each lag k the fields of ``further``: number of pairs, and products and squares over them.
    lagged_terms = [
        [
            weight[k:] * weight[:-k],
            z[k:] * z[:-k],
            square[k:] * weight[:-k],
            weight[k:] * square[:-k],
        ]
        for k in range(2, FURTHER + 2)
    ]
    parts = zip(np.array_split(weight, PARTS), np.array_split(z, PARTS), strict=True)
    known_states = np.zeros((len(z), 0, z.shape[1])) if states is None else np.nan_to_num(states)
    state_counts, state_products = (
        (weight[:, None] * (known_states != 0.0)).sum(axis=0),
        (z[:, None] * known_states).sum(axis=0),
    )
    return NoiseMoments(
        together=weight.T @ weight,
        first=z.sum(axis=0),
        second=z.T @ z,
        lagged=z[1:].T @ z[:-1],
        pairs=weight[1:].T @ weight[:-1],
        cells=count_cells(scipy.special.ndtr(z), present),
        fourth=(z**4).sum(axis=0),
        squares=np.array(
            [square.T @ weight, square[1:].T @ weight[:-1], weight[1:].T @ square[:-1]]
        ),
        further=np.array([[sums.sum(axis=0) for sums in lag] for lag in lagged_terms]),
        sizes=np.array(
            [
                (weight[1:] * weight[:-1]).sum(axis=0),
                (rank[1:] * weight[:-1]).sum(axis=0),
                (weight[1:] * rank[:-1]).sum(axis=0),
                (rank[1:] ** 2 * weight[:-1]).sum(axis=0),
                (rank[1:] * rank[:-1]).sum(axis=0),
            ]
        ),
        variance=np.array([[weights.sum(), (values**2).sum()] for weights, values in parts]),
        states=np.array([state_counts, state_products, state_products**2, state_counts > 0.0]),
    )


def count_cells(u: FloatArray, present: np.ndarray) -> FloatArray:
    """Return the histogram (CELLS, d) of each column of u (S, d), numbers in [0, 1], with CELLS
    equal cells; only those in the mask ``present`` (S, d) count.
    """
    # The cell of each number, coded together with its column.
    index = np.minimum((CELLS * u).astype(np.int64), CELLS - 1) * u.shape[1] + np.arange(u.shape[1])
    counts = np.bincount(index[present], minlength=CELLS * u.shape[1])
    return counts.reshape(CELLS, u.shape[1]).astype(float)


def total(stacked: NoiseMoments) -> NoiseMoments:
    """Return the sums over all runs from sums with a first axis over the runs."""
    return NoiseMoments(*(part.sum(axis=0) for part in stacked))


def whitening_matrix(covariance: FloatArray) -> FloatArray:
    """Return W (d, n) with W C W' = I for a ``covariance`` C (n, n) of numerical rank d."""
    values, vectors = np.linalg.eigh(covariance)
    varying = values > MIN_VARIANCE_SHARE * max(values[-1], 0.0)
    return np.asarray((vectors[:, varying] / np.sqrt(values[varying])).T)


def compare_variances(
    sums: NoiseMoments, labels: list[str], level: float, noun: str, gaussian: bool = True
) -> Finding:
    """Test the null hypothesis that every entry of a whitened noise, given by its ``sums`` over all
    runs, has variance 1: all entries pooled, all in each part of a run, and one by one, with level
    / 3 for each of the three.

    Sums of squares of Gaussian numbers are chi-square. Otherwise (``gaussian`` false) the degrees
    of freedom of the chi-square law are those that match the variance of the sum, from the sample
    kurtosis. ``noun`` names the entries in messages.
    """
    counts, squares = np.diagonal(sums.together), np.diagonal(sums.second)
    min_count = MIN_COUNT if gaussian else MIN_COUNT_OF_ANY_LAW
    if counts.max() < min_count:
        return nothing_to_see(VARIANCE_TOLERANCE)

    def interval(square: float, fourth: float, count: float, level_part: float) -> Interval:
        """Return the interval of a variance relative to the stated one, at level ``level_part``,
        from the sums of ``count`` squares (``square``) and fourth powers (``fourth``).
        """
        # The relative variance of a sum of squares is (kurtosis - 1) / count, that of chi-square
        # with f degrees of freedom 2 / f: hence f = 2 count / (kurtosis - 1), kurtosis - 1 being
        # 2 + excess. A sample excess below 0 counts as 0, which widens the interval.
        excess = 0.0 if gaussian else count * fourth / square**2 - 3.0
        freedom = 2.0 * count / max(2.0 + excess, 2.0)
        scale = scale_interval(freedom * square / count, freedom, level_part)
        return deviation_interval(1.0, scale)

    totals = float(squares.sum()), float(sums.fourth.sum()), float(counts.sum())
    intervals = [(interval(*totals, level / 3.0), f"all {noun} together")]
    for k, (count, square) in enumerate(sums.variance.tolist()):
        if count >= min_count:
            # Each part is too short for a fourth moment: it gets the kurtosis of the whole series.
            fourth = totals[1] * count / totals[2] * (square / count * totals[2] / totals[0]) ** 2
            label = f"all {noun} in part {k + 1} of {PARTS} of a run"
            intervals.append((interval(square, fourth, count, level / (3.0 * PARTS)), label))
    single_level = level / (3.0 * len(squares))
    for k, label in enumerate(labels):
        if counts[k] >= MIN_COUNT:
            entry_sums = float(squares[k]), float(sums.fourth[k]), float(counts[k])
            intervals.append((interval(*entry_sums, single_level), label))
    message = f"variances over the stated ones, {counts.sum():,.0f} values,"
    return with_best(intervals, VARIANCE_TOLERANCE, message)


def compare_means(sums: NoiseMoments, labels: list[str], level: float) -> Finding:
    """Test the null hypothesis that every entry of a whitened noise, given by its ``sums`` over all
    runs, has mean 0 and is uncorrelated with the state to which it is added.

    The mean of ``count`` entries of variance 1 is taken to be normal with variance 1 / count. Means
    and correlations with states get half of the ``level`` each, if states are known. ``labels``
    name the entries of the noise in messages.
    """
    counts = np.diagonal(sums.together)
    if counts.max() < MIN_COUNT:
        return nothing_to_see(MEAN_TOLERANCE)
    states = _with_states(sums, labels, level / 2.0)
    single_level, intervals = level / ((2.0 if states else 1.0) * len(labels)), []
    for entry_sum, count, label in zip(sums.first.tolist(), counts.tolist(), labels, strict=True):
        if count < MIN_COUNT:
            continue
        value, deviation = entry_sum / count, 1.0 / math.sqrt(count)
        reach = deviation * -float(scipy.special.ndtri(single_level / 2.0))
        mean = Interval(
            value, value - reach, value + reach, detectable_shift(deviation, single_level)
        )
        intervals.append((deviation_interval(0.0, mean), label))
    message = "largest mean in standard deviations"
    message += ", or correlation with a state," if states else ""
    return find_largest([*intervals, *states], MEAN_TOLERANCE, message)


def _with_states(sums: NoiseMoments, labels: list[str], level: float) -> list[tuple[Interval, str]]:
    """Return labelled intervals for the correlations of the entries of a whitened noise with the
    states they are added to, from the ``sums`` over all runs.

    States within a run are correlated, so that the independent values are the sums of the products
    over each run; their mean under the null hypothesis is 0, which makes the sum of their squares
    an estimate of the variance. The probability that any of them misses the truth is at most
    ``level``.
    """
    # (n, d) each: number of products, their sum, sum over runs of squared sums, number of runs.
    counts, products, squares, runs = sums.states
    comparable = np.argwhere((runs >= MIN_RUNS) & (squares > 0.0)).tolist()
    intervals = []
    for j, i in comparable:
        count, spread = float(counts[j, i]), math.sqrt(squares[j, i])
        correlation = student_interval(
            float(products[j, i]) / count, spread / count, int(runs[j, i]), level / len(comparable)
        )
        intervals.append((deviation_interval(0.0, correlation), f"{labels[i]} and state {j}"))
    return intervals


def compare_correlations(sums: NoiseMoments, labels: list[str], level: float) -> Finding:
    """Test the null hypothesis that a whitened noise is white, from its ``sums`` over all runs.

    Under it there are no correlations between entries, with any entry one step before, of an entry
    with itself 2 to FURTHER + 1 steps before, and of |entry| with itself one step before (which
    would show a varying variance). All comparisons share the ``level`` (Bonferroni). ``labels``
    name the entries in messages.
    """
    # Each is (correlation, number of pairs, label).
    correlations = [*_between(sums, labels), *_in_time(sums, labels), *_in_size(sums, labels)]
    correlations = [entry for entry in correlations if entry[1] >= MIN_COUNT]
    if not correlations:
        return nothing_to_see(CORRELATION_TOLERANCE)
    single_level, intervals = level / len(correlations), []
    for value, count, label in correlations:
        intervals.append(
            (deviation_interval(0.0, correlation_interval(value, count, single_level)), label)
        )
    return find_largest(intervals, CORRELATION_TOLERANCE, "largest correlation")


def compare_cells(cells: FloatArray, labels: list[str], level: float, noun: str) -> Finding:
    """Test the null hypothesis that numbers are uniform in [0, 1), from their counts in ``cells``
    (CELLS, d), equal parts of [0, 1): of all d columns together, and of each column, with half of
    the level each. The numbers are gaps, delays or noises, transformed by the distribution function
    that they should have.

    Cells have equal probability, so that a count is binomial with probability 1 / CELLS (interval
    of Clopper and Pearson). ``noun`` names the numbers in the message.
    """
    counts = cells.sum(axis=0)
    if counts.sum() < 10 * CELLS:
        return nothing_to_see(SHARE_TOLERANCE)
    intervals = [
        (_cell_interval(count, counts.sum(), level / (2.0 * CELLS)), f"all, {_cell_label(k)}")
        for k, count in enumerate(cells.sum(axis=1).tolist())
    ]
    single_level = level / (2.0 * CELLS * len(labels))
    for column, label in enumerate(labels if len(labels) > 1 else ()):
        if counts[column] >= 10 * CELLS:
            for k, count in enumerate(cells[:, column].tolist()):
                distance = _cell_interval(count, counts[column], single_level)
                intervals.append((distance, f"{label}, {_cell_label(k)}"))
    message = f"{counts.sum():,.0f} {noun}, largest difference of a share from 1/{CELLS}"
    return with_best(intervals, SHARE_TOLERANCE, message, overall_count=CELLS)


def compare_shares(cells: FloatArray, level: float, noun: str) -> Finding:
    """Test the null hypothesis that waiting times have their stated law, from how many are in each
    of CELLS ``cells`` of equal probability and how many could be, (CELLS, 2).

    Cells which few runs can show are left out. ``noun`` names the waiting times in the message. The
    interval of the finding misses the truth with at most the probability ``level``.
    """
    visible = [k for k, trials in enumerate(cells[:, 1].tolist()) if trials >= 10 * CELLS]
    if not visible:
        return nothing_to_see(SHARE_TOLERANCE)
    intervals = [
        (_cell_interval(float(cells[k, 0]), cells[k, 1], level / len(visible)), _cell_label(k))
        for k in visible
    ]
    message = f"{cells[0, 1]:,.0f} {noun}, largest difference of a share from 1/{CELLS}"
    if len(visible) < CELLS:
        message += f" (runs are too short to show ranks above {(visible[-1] + 1) / CELLS:.2f})"
    return find_largest(intervals, SHARE_TOLERANCE, message)


def _cell_interval(count: float, total: float, level: float) -> Interval:
    """Return the interval of the distance between a cell's share of the numbers in [0, 1),
    ``count`` out of ``total``, and its probability 1 / CELLS.

    The interval misses the truth with at most the probability ``level``.
    """
    return deviation_interval(1.0 / CELLS, probability_interval(int(count), int(total), level))


def _cell_label(k: int) -> str:
    """Return the range of ranks of cell ``k``, from 0 to CELLS - 1, as text."""
    return f"rank {k / CELLS:.2f} to {(k + 1) / CELLS:.2f}"


def correlation_interval(value: float, count: float, level: float) -> Interval:
    """Return an interval for the correlation of two normal variables by Fisher's transformation:
    atanh of the estimate ``value`` from ``count`` pairs has the variance 1 / (count - 3).

    The interval misses the truth with at most the probability ``level``.
    """
    spread = 1.0 / math.sqrt(max(count - 3.0, 1.0))
    reach = -spread * float(scipy.special.ndtri(level / 2.0))

    def limits(value: float, factor: float) -> tuple[float, float]:
        """Return the limits for another correlation and ``factor`` times the samples."""
        centre = math.atanh(min(max(value, -1.0 + 1e-12), 1.0 - 1e-12))
        wide = reach / math.sqrt(factor)
        return math.tanh(centre - wide), math.tanh(centre + wide)

    detectable = math.tanh(detectable_shift(spread, level))
    return Interval(value, *limits(value, 1.0), detectable, again=limits)


def _between(sums: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, number of terms and label of all pairs of entries of a noise at the same
    time, from its ``sums`` over all runs.
    """
    # The squares of both factors are summed over the same terms as the products.
    correlations = _correlations(sums.second, sums.squares[0], sums.squares[0].T)
    for i in range(len(labels)):
        for j in range(i):
            yield (
                float(correlations[i, j]),
                float(sums.together[i, j]),
                f"{labels[j]} and {labels[i]}",
            )


def _in_time(sums: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, number of terms and label of all entries of a noise with all entries one
    step before, from its ``sums`` over all runs.
    """
    # The squares of both factors are summed over the same pairs as the products.
    correlations = _correlations(sums.lagged, sums.squares[1], sums.squares[2])
    for i, label in enumerate(labels):
        for j, earlier_label in enumerate(labels):
            pairs = float(sums.pairs[i, j])
            yield float(correlations[i, j]), pairs, f"{label} and {earlier_label} just before"


def _in_size(sums: NoiseMoments, labels: list[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, number of terms and label of each entry of a noise with itself 2 to
    FURTHER + 1 steps before, and of the rank of |entry| (its probability under the normal law) with
    that one step before, from the ``sums`` over all runs.
    """
    # (FURTHER, d) each: number of terms, and sums of products and of squares over these terms.
    count, *lag_sums = np.moveaxis(sums.further, 1, 0)
    correlations = _correlations(*lag_sums)
    for i, label in enumerate(labels):
        for k in range(FURTHER):
            yield (
                float(correlations[k, i]),
                float(count[k, i]),
                f"{label} and itself {k + 2} before",
            )
        pairs, rank_sum, earlier_sum, square_sum, product_sum = sums.sizes[:, i].tolist()
        spread = pairs * square_sum - rank_sum**2
        if pairs >= MIN_COUNT_OF_ANY_LAW and spread > 0.0:
            value = (pairs * product_sum - rank_sum * earlier_sum) / spread
            yield float(value), pairs, f"the size of {label} and of that just before"


def _correlations(
    products: FloatArray, first_squares: FloatArray, second_squares: FloatArray
) -> FloatArray:
    """Return correlations from sums of products and of squares over the same pairs, three arrays of
    one shape, which is that of the result; 0 without pairs.

    With squares summed over other terms than the products, |correlation| could exceed 1.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.nan_to_num(products / np.sqrt(first_squares * second_squares)))


def with_best(
    intervals: list[tuple[Interval, str]], tolerance: float, message: str, overall_count: int = 1
) -> Finding:
    """Return the finding of labelled intervals for deviations that should be 0.

    The first ``overall_count`` ones are over all values, the others over parts of them. If any
    deviation is significant the finding is the most significant one; otherwise it is that of all
    values, which is more precise, and the message adds the largest deviation of a part.
    """
    finding = find_largest(intervals[:overall_count], tolerance, message)
    # An interval of a deviation that excludes 0 is significant.
    if any(distance.low > 0.0 for distance, _ in intervals):
        everything = finding.detectable
        return find_largest(intervals, tolerance, message)._replace(detectable=everything)
    if len(intervals) == overall_count:
        return finding
    largest, label = max(intervals[overall_count:], key=lambda item: item[0].value)
    text = f"{finding.message}; furthest off {label}: {largest.value:.3g}"
    if math.isfinite(largest.detectable):
        text += f", {largest.detectable:.2g} would have been seen"
    return finding._replace(message=text)


def nothing_to_see(tolerance: float) -> Finding:
    """Return the finding of a row that has too few values to say anything."""
    return Finding((0.0, -math.inf, 0.0), tolerance, "too few values in these runs")
