"""Noises that should be standard and white, once whitened by the covariance that a part states.

Noises z (R, S, d) are those of R runs, S times and d entries, nan where one is missing. All
intervals of a comparison hold together at its ``level``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from netkf.laws.intervals import (
    NO_COMPARISON,
    Interval,
    LawComparison,
    correlation_interval,
    deviation_interval,
    normal_interval,
    scale_interval,
    student_interval,
)
from netkf.laws.losses import MIN_COUNT, MIN_RUNS
from netkf.laws.ticks import CELLS, MIN_SEEN, cell_interval, cell_label
from netkf.linalg.arrays import FloatArray, symmetric

MIN_VARIANCE_SHARE = 1e-10
"""Share of the largest variance below which a direction has no noise."""
VISIBLE = 1e-5
"""Largest rounding error of noise, in standard deviations, that leaves it visible."""
LAGS, PARTS = (2, 3, 4), 4
"""Lags of the autocorrelation of each entry beside 1, and equal parts of a series in which the
pooled variance is tested.
"""
NEGLIGIBLE = 1e-8
"""Share of a standard deviation that counts as rounding."""
MIN_COUNT_OF_ANY_LAW = 200
"""Values from which variances of numbers of an unknown law are tested."""


class NoiseDraws(NamedTuple):
    """Whitened noises of one run; of R runs with a first axis of that length.

    z      : (S, d)
    states : (2, n, d) number and sum of the products of each entry with the n states to which it is
             added, in units of their root mean squares
    """

    z: FloatArray
    states: FloatArray


def noise_draws(z: FloatArray, states: FloatArray) -> NoiseDraws:
    """Return the draws of a run from noises ``z`` (S, d) added to ``states``, 0 if unknown."""
    known = (states != 0.0) & np.isfinite(z)[:, None]
    products = np.where(known, states, 0.0) * np.nan_to_num(z)[:, None]
    return NoiseDraws(z, np.array([known.sum(axis=0), products.sum(axis=0)]))


class Whitening(NamedTuple):
    """Factors of a covariance S (n, n) of rank r.

    factor     : (r, n), W with W S W' = 1: it turns noise of covariance S into standard white noise
    null_space : (n - r, n), rows that are orthonormal in units of S: directions without noise
    """

    factor: FloatArray
    null_space: FloatArray


def whiten(S: FloatArray, share: float = 1e-12) -> Whitening:
    """Return whitening factors of ``S``, in units of rows, without directions below ``share``."""
    sizes = np.diagonal(S)
    units = np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
    values, vectors = np.linalg.eigh(symmetric(S) / units[:, None] / units)
    positive = values > share * max(float(values[-1]), np.finfo(float).tiny)
    factor = (vectors[:, positive] / np.sqrt(values[positive])).T / units
    return Whitening(np.asarray(factor), vectors[:, ~positive].T / units)


def is_visible(factor: FloatArray, sizes: FloatArray) -> NDArray[np.bool_]:
    """Return a mask (..., r) of the rows of a whitening ``factor`` (..., r, n) that leave noise of
    differences of numbers of ``sizes`` (..., n), and not mostly rounding; True for rows of nan.
    """
    rounding = (np.abs(factor) @ sizes[..., None])[..., 0] * np.finfo(float).eps
    return np.asarray(~(rounding >= VISIBLE))


def transition_law(A: FloatArray, B: FloatArray, gap: float) -> tuple[FloatArray, FloatArray]:
    """Return e^{A g} and the covariance of the noise (Van Loan, 1978) over ``gap`` seconds."""
    n = len(A)
    E = scipy.linalg.expm(np.block([[-A, B @ B.T], [np.zeros((n, n)), A.T]]) * gap)
    W = E[n:, n:].T @ E[:n, n:]
    return E[n:, n:].T, 0.5 * (W + W.T)


def moment_law(A: FloatArray, B: FloatArray, gap: float) -> tuple[FloatArray, FloatArray]:
    """Return response (3 n, n) and noise covariance (3 n, 3 n) of the state of dx = A x dt + B dw
    after ``gap`` seconds and of its moments, the integrals of x and of x times the Legendre P_1.
    """
    n, zero, eye = len(A), np.zeros_like(A), np.eye(len(A))
    # x, I = int x ds and J = int I ds: int s x ds = g I - J.
    chain = np.block([[A, zero, zero], [eye, zero, zero], [zero, eye, zero]])
    Phi, S = transition_law(chain, np.concatenate([B, np.zeros((2 * n, B.shape[1]))]), gap)
    # int (2 s / g - 1) x ds = I - 2 J / g.
    T = np.block([[eye, zero, zero], [zero, eye, zero], [zero, eye, -2.0 / gap * eye]])
    return (T @ Phi)[:, :n], T @ S @ T.T


def compare_variances(
    z: FloatArray, labels: Sequence[str], level: float, noun: str, gaussian: bool = True
) -> LawComparison:
    """Compare the variances of noises with 1: of all entries, in each part of a run, and one by
    one, with a third of ``level`` for each. Sums of squares are chi-square; unless ``gaussian``
    with the degrees of freedom that match their variance, from the sample kurtosis.
    """
    counts, squares = np.isfinite(z).sum(axis=(0, 1)), np.nan_to_num(z) ** 2
    min_count = MIN_COUNT if gaussian else MIN_COUNT_OF_ANY_LAW
    if counts.max(initial=0) < min_count:
        return NO_COMPARISON

    def distance(square: float, kurtosis: float, count: float, part: float) -> Interval:
        # The relative variance of a sum of squares is (kurtosis - 1) / count, that of chi-square
        # with f degrees of freedom 2 / f: hence f = 2 count / (kurtosis - 1). A sample kurtosis
        # below 3 counts as 3, which widens the interval.
        freedom = count if gaussian else 2.0 * count / max(kurtosis - 1.0, 2.0)
        return deviation_interval(1.0, scale_interval(freedom * square / count, freedom, part))

    def kurtosis(squares: FloatArray, count: float) -> float:
        return count * float((squares**2).sum()) / max(float(squares.sum()) ** 2, 1e-300)

    number, pooled = float(counts.sum()), kurtosis(squares, float(counts.sum()))
    whole = distance(float(squares.sum()), pooled, number, level / 3.0)
    distances = [(whole, f"all {noun} together")]
    # Rows behind the last value of all runs belong to no part.
    length = int(np.flatnonzero(np.isfinite(z).any(axis=(0, 2)))[-1]) + 1
    for k, part in enumerate(np.array_split(np.arange(length), PARTS)):
        count = float(np.isfinite(z[:, part]).sum())
        if count >= min_count:
            # Each part is too short for a fourth moment: it has that of the whole series.
            found = distance(float(squares[:, part].sum()), pooled, count, level / (3.0 * PARTS))
            distances.append((found, f"all {noun} in part {k + 1} of {PARTS} of a run"))
    for k, label in enumerate(labels):
        if counts[k] >= MIN_COUNT:
            count, entry = float(counts[k]), squares[..., k]
            found = distance(
                float(entry.sum()), kurtosis(entry, count), count, level / (3.0 * len(labels))
            )
            distances.append((found, label))
    text = f"variances over the stated ones, {counts.sum():,.0f} values,"
    return LawComparison(distances, text, overall=1)


def compare_means(
    z: FloatArray, labels: Sequence[str], level: float, states: FloatArray | None = None
) -> LawComparison:
    """Compare the means of noises with 0, and their correlations with the ``states`` (R, 2, n, d)
    to which they are added, with half of ``level`` each; means of ``count`` entries have variance 1
    / count.
    """
    counts = np.isfinite(z).sum(axis=(0, 1))
    if counts.max(initial=0) < MIN_COUNT:
        return NO_COMPARISON
    with_states = [] if states is None else _with_states(states, labels, level / 2.0)
    single, distances = level / ((2.0 if with_states else 1.0) * len(labels)), []
    for value, count, label in zip(np.nan_to_num(z).sum(axis=(0, 1)), counts, labels, strict=True):
        if count < MIN_COUNT:
            continue
        interval = normal_interval(float(value / count), 1.0 / math.sqrt(count), single)
        distances.append((deviation_interval(0.0, interval), label))
    text = "largest mean in standard deviations"
    text += ", or correlation with a state," if with_states else ""
    return LawComparison([*distances, *with_states], text)


def _with_states(x: FloatArray, labels: Sequence[str], level: float) -> list[tuple[Interval, str]]:
    counts, products = x.sum(axis=0)
    squares, runs = (x[:, 1] ** 2).sum(axis=0), (x[:, 0] > 0.0).sum(axis=0)
    comparable = np.argwhere((runs >= MIN_RUNS) & (squares > 0.0)).tolist()
    distances = []
    for j, i in comparable:
        count, spread = float(counts[j, i]), math.sqrt(squares[j, i])
        correlation = student_interval(
            float(products[j, i]) / count, spread / count, int(runs[j, i]), level / len(comparable)
        )
        distances.append((deviation_interval(0.0, correlation), f"{labels[i]} and state {j}"))
    return distances


def compare_correlations(
    z: FloatArray, labels: Sequence[str], level: float, lags: Sequence[int] = LAGS
) -> LawComparison:
    """Compare noises with white ones: no correlations between entries, with any entry one step
    before, of an entry with itself ``lags`` steps before, and of the size of an entry with that one
    step before (which would show a varying variance). All comparisons share the ``level``.
    """
    return _compare_found(
        [*_between(z, labels), *_in_time(z, labels), *_in_size(z, labels, lags)], level
    )


def compare_entries(z: FloatArray, labels: Sequence[str], level: float) -> LawComparison:
    """Compare the correlations between entries of noises at the same time with 0."""
    return _compare_found(list(_between(z, labels)), level)


def compare_with(
    z: FloatArray, other: FloatArray, labels: Sequence[str], others: Sequence[str], level: float
) -> LawComparison:
    """Compare the correlations of noises with other numbers (R, S, e) of the same times, which must
    have mean 0 and are named ``others``, with 0.
    """
    value, count = correlate(z, other)
    names = [(i, j) for i in range(len(labels)) for j in range(len(others))]
    found = [(value[i, j], count[i, j], f"{labels[i]} and {others[j]}") for i, j in names]
    return _compare_found(found, level)


def _compare_found(found: list[tuple[float, float, str]], level: float) -> LawComparison:
    enough = [entry for entry in found if entry[1] >= MIN_COUNT]
    distances = [
        (deviation_interval(0.0, correlation_interval(value, count, level / len(enough))), label)
        for value, count, label in enough
    ]
    return LawComparison(distances, "largest correlation") if distances else NO_COMPARISON


def compare_cells(u: FloatArray, labels: Sequence[str], level: float, noun: str) -> LawComparison:
    """Compare numbers u (R, S, d), which should be uniform in [0, 1), by how many are in each of
    CELLS equal parts: of all d columns together, and of each, with half of ``level`` each.
    """
    present = np.isfinite(u)
    # The cell of each number, coded together with its column.
    index = np.minimum((CELLS * np.nan_to_num(u)).astype(np.int64), CELLS - 1) * u.shape[-1]
    index += np.arange(u.shape[-1])
    cells = np.bincount(index[present], minlength=CELLS * u.shape[-1]).reshape(CELLS, -1)
    counts = cells.sum(axis=0)
    if counts.sum() < MIN_SEEN:
        return NO_COMPARISON
    distances = [
        (cell_interval(count, counts.sum(), level / (2.0 * CELLS)), f"all, {cell_label(k)}")
        for k, count in enumerate(cells.sum(axis=1).tolist())
    ]
    for column, label in enumerate(labels if len(labels) > 1 else ()):
        if counts[column] >= MIN_SEEN:
            for k, count in enumerate(cells[:, column].tolist()):
                found = cell_interval(count, counts[column], level / (2.0 * CELLS * len(labels)))
                distances.append((found, f"{label}, {cell_label(k)}"))
    text = f"{counts.sum():,.0f} {noun}, largest difference of a share from 1/{CELLS}"
    return LawComparison(distances, text, overall=CELLS)


def compare_sides(e: FloatArray, others: FloatArray, level: float) -> Iterator[LawComparison]:
    """Compare mean and variance of noise ``e`` (N, q) where each of the numbers ``others`` (N, r)
    is above its median with those where it is below: noise that does not depend on them has none.
    """
    varies = others.std(axis=0) > NEGLIGIBLE * np.abs(others).max(axis=0, initial=0.0)
    sides = np.sign(others[:, varies] - np.median(others[:, varies], axis=0))
    labels = [f"that component {k} is above its median" for k in np.flatnonzero(varies)]
    for moment, values in (("mean", e), ("variance", e**2 - (e**2).mean(axis=0))):
        found = compare_with(values, sides, component_labels(e), labels, level)
        yield found._replace(text=f"its {moment}: correlation")


def component_labels(e: FloatArray) -> list[str]:
    """Return "component 0", "component 1", ... for the entries of the last axis."""
    return [f"component {k}" for k in range(e.shape[-1])]


def correlate(one: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the correlations (d, e) of the entries of ``one`` (..., d) and ``other`` (..., e) of
    mean 0, nan where they are missing, and the numbers of pairs of which they are; 0 without pairs.
    """
    pairs = math.prod(one.shape[:-1])
    a, b = (part.reshape(pairs, part.shape[-1]) for part in (one, other))
    there, here = np.isfinite(a).astype(float), np.isfinite(b).astype(float)
    a, b = np.nan_to_num(a), np.nan_to_num(b)
    # The squares of both factors are summed over the same pairs as the products: with those of
    # other terms |correlation| could exceed 1.
    with np.errstate(invalid="ignore", divide="ignore"):
        value = np.nan_to_num(a.T @ b / np.sqrt(((a**2).T @ here) * (there.T @ b**2)))
    return np.asarray(value), there.T @ here


def _between(z: FloatArray, labels: Sequence[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, number of terms and label of all pairs of entries at the same time."""
    value, count = correlate(z, z)
    for i in range(len(labels)):
        for j in range(i):
            yield float(value[i, j]), float(count[i, j]), f"{labels[j]} and {labels[i]}"


def _in_time(z: FloatArray, labels: Sequence[str]) -> Iterator[tuple[float, float, str]]:
    """Yield correlation, number of terms and label of all entries with all one step before."""
    value, count = correlate(z[:, 1:], z[:, :-1])
    for i, label in enumerate(labels):
        for j, earlier in enumerate(labels):
            yield float(value[i, j]), float(count[i, j]), f"{label} and {earlier} just before"


def _in_size(
    z: FloatArray, labels: Sequence[str], lags: Sequence[int]
) -> Iterator[tuple[float, float, str]]:
    """Yield the same of each entry with itself before, and of its size with that before."""
    for lag in lags:
        value, count = (np.diagonal(part) for part in correlate(z[:, lag:], z[:, :-lag]))
        for k, label in enumerate(labels):
            yield float(value[k]), float(count[k]), f"{label} and itself {lag} before"
    rank = 2.0 * scipy.special.ndtr(np.abs(z)) - 1.0
    with np.errstate(invalid="ignore"):
        rank -= np.nansum(rank, axis=(0, 1)) / np.isfinite(rank).sum(axis=(0, 1))
    value, count = (np.diagonal(part) for part in correlate(rank[:, 1:], rank[:, :-1]))
    for k, label in enumerate(labels):
        if count[k] >= MIN_COUNT_OF_ANY_LAW:
            yield float(value[k]), float(count[k]), f"the size of {label} and of that just before"
