"""Comparisons of distributions that several papers share: covariances, and errors against them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from netkf.checks.evidence import EPS, OPERATIONS, Assumption, Finding, find_unknown
from netkf.checks.statistics import law_distance, law_excess
from netkf.laws.intervals import Interval, LawComparison, deviation_interval, scale_interval
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario

LAW_TOLERANCE, NEES_TOLERANCE = 0.25, 0.3
"""Tolerated distance of distribution functions, and relative difference of the mean NEES from n."""
FIXED_READINGS = "H is the same in every slot"
"""Name of the assumption of tests that know a reading's H without the run."""
GROWTH = 4.0
"""Factor by which a covariance may still be larger at the end than at half of the horizon."""


class Pair(NamedTuple):
    """Two samples of covariances (S, n, n) and (S', n, n) that should have the same law.

    They may depend on each other. If the promise is about a limit, ``second`` is a sample of the
    limit law, and ``expected`` (S'', n, n) one of the law of ``first`` at its own time. Then only a
    difference between ``first`` and ``expected`` breaks the promise; the distance of ``expected``
    from ``second`` tells whether the limit is reached.
    """

    label: str
    first: FloatArray
    second: FloatArray
    expected: FloatArray | None = None


def find_largest(
    distances: Sequence[tuple[Interval, str]], tolerance: float, message: str
) -> Finding:
    """Return the finding on pairs (interval of a distance, label) of distances that should be 0 up
    to ``tolerance``: the one with the largest lower limit. The caller shares the level among them.
    Those that are nan are left out; undecided if all are.
    """
    known = [item for item in distances if not np.isnan(item[0][:3]).any()]
    if not known:
        return find_unknown(f"not judged, no comparison gives a number: {message}", tolerance)
    if len(known) < len(distances):
        message = (
            f"{message} (left out, because they are not numbers: {len(distances) - len(known)})"
        )
    distances = known
    chosen, label = max(distances, key=lambda item: (item[0].low, item[0].value))
    widest = max(interval.high for interval, _ in distances)
    detectable = max(interval.detectable for interval, _ in distances)
    number = "1 comparison" if len(distances) == 1 else f"{len(distances)} comparisons"
    text = f"{message} in {number}, {label}"
    # The margin (value, low, high) is minus the distance, so that its limits change places.
    margin = -chosen.value, -widest, -chosen.low
    finding = Finding(margin, tolerance, text, detectable=detectable)

    def forecast(factor: float) -> float:
        """Return the expected upper end of the largest distance with ``factor`` times the runs."""
        return max(interval.expected_high(factor) for interval, _ in distances)

    return finding._replace(seen=chosen.seen, expected=chosen.expected, forecast=forecast)


def find(comparison: LawComparison, tolerance: float) -> Finding:
    """Return the finding of a ``comparison`` with stated laws: the most significant distance."""
    distances, text, overall = comparison
    if not distances:
        return Finding((0.0, -np.inf, 0.0), tolerance, text)
    finding = find_largest(distances[: overall or None], tolerance, text)
    if comparison.worst is not None:
        return find_largest(distances, tolerance, text)._replace(detectable=finding.detectable)
    if len(distances) == overall or not overall:
        return finding
    largest, label = max(distances[overall:], key=lambda item: item[0].value)
    text = f"{finding.message}; furthest off {label}: {largest.value:.3g}"
    if np.isfinite(largest.detectable):
        text += f", {largest.detectable:.2g} is detectable"
    return finding._replace(message=text)


EVERYTHING = "all times, nodes and runs together"
POOLED_TOLERANCE = 0.1
"""Tolerated relative difference where everything is pooled."""


def pool(
    single: Finding, pooled: Interval, what: str, tolerance: float = POOLED_TOLERANCE
) -> Finding:
    """Return the finding of comparisons one by one, ``single``, and of all together, ``pooled``,
    which is far narrower and decides unless only a single one is significant.
    """
    # The upper end of a margin below 0: the single comparison breaks the promise. A pooled value of
    # nan (nothing could be pooled) leaves the single comparisons too.
    single_decides = single.margin[2] < 0.0 and not pooled.low > 0.0
    if single_decides or not pooled.value >= 0.0:
        return single
    # The margin (value, low, high) is minus the distance, so that its limits change places.
    margin = -pooled.value, -pooled.high, -pooled.low
    text = f"{what}; one by one: {single.message}: {max(0.0, -single.margin[0]):.3g}"
    return single._replace(
        margin=margin, tolerance=tolerance, message=text, seen=pooled.seen,
        expected=pooled.expected, detectable=pooled.detectable, forecast=pooled.expected_high,
    )  # fmt: skip


def compare_laws(pairs: Sequence[Pair], level: float, start: float) -> Finding:
    """Test that samples of each pair have one law within LAW_TOLERANCE: Kolmogorov-Smirnov by
    diagonal entry; ``early`` before a limit is reached. P keeps roundings of ``start``, its trace.
    """
    single_level, early = level / sum(pair.first.shape[-1] for pair in pairs), False
    intervals = []
    for pair in pairs:
        for k in range(pair.first.shape[-1]):
            first, second = pair.first[:, k, k], pair.second[:, k, k]
            size = float(np.median(np.trace(pair.first, axis1=-2, axis2=-1)))
            blur = OPERATIONS * EPS * max(start, size)  # rounding of entries of P
            if pair.expected is None:
                distance = law_distance(first, second, single_level, blur)
            else:
                # Only a difference from the expected law breaks the promise, and the distance from
                # the limit is reported. The row is early if the expected law is not yet there.
                expected = pair.expected[:, k, k]
                low = law_distance(first, expected, single_level / 2.0, blur).low
                distance = law_distance(first, second, single_level / 2.0, blur)
                distance = distance._replace(low=low, high=max(distance.high, low))
                # Only the value is used, for which the level does not matter.
                early |= law_distance(expected, second, level=0.5).value > LAW_TOLERANCE
            intervals.append((distance, f"at {pair.label}, entry {k}"))
    finding = find_largest(intervals, LAW_TOLERANCE, "largest distance of distribution functions")
    differs = any(distance.low > 0.0 for distance, _ in intervals)
    return finding._replace(early=early and not differs)


def diagonal_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the distances (n,) between the laws of the diagonals of two samples (S, n, n)."""
    # Only the value of each interval is used, for which the level does not matter.
    return np.array(
        [
            law_distance(first[:, k, k], second[:, k, k], level=0.5).value
            for k in range(first.shape[-1])
        ]
    )


def growth_intervals(earlier: FloatArray, later: FloatArray, level: float) -> list[Interval]:
    """Return intervals for the growth of each diagonal entry between two samples (S, n, n): the
    largest P(later > GROWTH x) - P(earlier > x).
    """
    return [
        law_excess(GROWTH * earlier[:, k, k], later[:, k, k], level)
        for k in range(earlier.shape[-1])
    ]


def compare_growth(
    pairs: Sequence[Pair], expected: Sequence[tuple[FloatArray, FloatArray] | None], level: float
) -> Finding:
    """Test that covariances stay stochastically bounded: ``second`` of a pair is at most GROWTH
    times ``first``, at half of the horizon. Only growth faster than that ``expected`` breaks it.
    """
    single_level, early = 0.5 * level / sum(pair.first.shape[-1] for pair in pairs), False
    intervals = []
    for pair, laws in zip(pairs, expected, strict=True):
        growths = growth_intervals(pair.first, pair.second, single_level)
        expected_growths = None if laws is None else growth_intervals(*laws, single_level)
        for k, growth in enumerate(growths):
            if expected_growths is None:
                # Without an expectation growth breaks nothing, but leaves the row undecided.
                low = 0.0
                early |= growth.low > LAW_TOLERANCE
            else:
                low = max(0.0, growth.low - expected_growths[k].high)
                early |= expected_growths[k].value > LAW_TOLERANCE
            intervals.append((growth._replace(low=low), f"at {pair.label}, entry {k}"))
    message = f"largest excess of P(P > {GROWTH:g} J) at the end over P(P > J) at half of the time"
    finding = find_largest(intervals, LAW_TOLERANCE, message)
    differs = any(interval.low > 0.0 for interval, _ in intervals)
    return finding._replace(early=early and not differs)


def compare_chi_square(
    ratios: FloatArray, freedom: Sequence[float], labels: Sequence[str], level: float, name: str
) -> Finding:
    """Test that squares over their degrees of freedom, ``ratios`` (R, K), have mean 1: sums of
    columns are chi-square with ``freedom[k]`` degrees, without those that are not finite.
    """
    finite = np.flatnonzero(np.isfinite(ratios).all(axis=0))
    if not len(finite):
        return find_unknown(f"{name} does not exist: singular or not finite", NEES_TOLERANCE)
    intervals = []
    for k in finite.tolist():
        # freedom[k] is that of all runs: the sum of squares is the mean ratio times it.
        total = float(ratios[:, k].mean()) * freedom[k]
        ratio = scale_interval(total, freedom[k], level / len(finite))
        intervals.append((deviation_interval(1.0, ratio), f"at {labels[k]}"))
    message = f"largest relative difference of the mean {name} from its freedom"
    return find_largest(intervals, NEES_TOLERANCE, message)


def fixed_readings(scenario: Scenario) -> Assumption:
    """Return the assumption, a row, that H is the same in every slot, as laws of P need."""
    holds = not any(sensor.varying for sensor in scenario.sensors)
    evidence = "as the scenario gives it" if holds else "a sensor's H differs from slot to slot"
    return Assumption(FIXED_READINGS, "G II-B, R (16)", holds, evidence)


def exact_start(scenario: Scenario) -> Assumption:
    """Return the assumption, a row, that filters start with the mean and covariance of x(0)."""
    different = scenario.other_starts
    evidence = "mean and covariance are the plant's"
    if different:
        evidence = f"node {different[0]}{' and others' if different[1:] else ''}: not the plant's"
    return Assumption(
        "the filters start with the law of x(0)", "G (10), R (15)", not different, evidence
    )
