"""Tests of draws (:mod:`netkf.laws`) at the level of a checker, and of noise against its law.

A checker makes at most ``FAMILIES`` families of tests. Each family gets the same share of the
significance level ``LEVEL``, divided among its tests: a correct class fails once in a million.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.laws.intervals import LawComparison
from netkf.laws.noise import (
    PARTS,
    compare_entries,
    compare_means,
    compare_sides,
    compare_variances,
    compare_with,
    component_labels,
    is_visible,
    whiten,
)
from netkf.linalg.arrays import FloatArray
from netkf.testing.watching import demand, fail

LEVEL, FAMILIES = 1e-6, 200
LAGS = (2, 3, 7)
"""Steps apart, beside 1, at which correlations in time are tested."""
CERTAIN = 1e-6
"""Noise in directions without any, relative to what it is added to, that counts as rounding."""
MIN_VALUES = 1000
"""Smallest number of values whose mean is close enough to normal so far in its tails."""


def family_level() -> float:
    """Return the level of one family of tests."""
    return LEVEL / FAMILIES


def demand_agreement(comparison: LawComparison, where: str, rule: str, remedy: str = "") -> None:
    """Raise AssertionError ``where: rule; got ...; remedy`` if draws differ from their law."""
    if comparison.worst is not None:
        found, label = comparison.worst
        spread = 0.5 * (found.high - found.low)
        got = f"{found.seen:.4g} (+- {spread:.2g}) instead of {found.expected:.4g}, {label}"
        fail(where, rule, f"{comparison.text} {got}", remedy)


class NoiseLabels(NamedTuple):
    """Texts for messages about noise.

    where : name of the method that draws it, such as "MySensor.samples"
    noise : description, such as "the noise y - H x"
    field : name of the field that states its covariance, such as "R"
    """

    where: str
    noise: str
    field: str


def check_white(e: FloatArray, labels: NoiseLabels) -> None:
    """Check that ``e`` (R, K, q), of R runs at K times, is standard white noise: mean 0 and
    covariance 1 in every part of a run, and no correlation in time, or between components or runs.
    """
    if len(e) > 1:
        # First, because with equal runs (from a fixed seed) all other standard errors are wrong.
        check_uncorrelated(e[:-1], e[1:], labels, "of two runs with different streams")
    _check_moments(e, labels, "")
    length = e.shape[1] // PARTS
    for part in range(PARTS if length else 0):
        quarter = e[:, part * length : (part + 1) * length]
        _check_moments(quarter, labels, f" in quarter {part + 1} of a run")
    lags = [lag for lag in LAGS if lag < e.shape[1]]
    for lag in (1, *lags) if e.shape[1] > 1 else ():
        check_uncorrelated(e[:, :-lag], e[:, lag:], labels, f"{lag} steps apart")


def _check_moments(e: FloatArray, labels: NoiseLabels, when: str) -> None:
    if e.shape[0] * e.shape[1] < MIN_VALUES:
        return
    where, names, level = labels.where, component_labels(e), family_level()
    rule = f"{labels.noise} must have the mean 0{when}"
    demand_agreement(compare_means(e, names, level), where, rule)
    rule = f"{labels.noise} must have the covariance that {labels.field} states{when}"
    demand_agreement(compare_variances(e, names, level, "components", gaussian=False), where, rule)
    demand_agreement(compare_entries(e, names, level), where, rule)


def check_uncorrelated(one: FloatArray, other: FloatArray, labels: NoiseLabels, apart: str) -> None:
    """Check that unit noises (..., q) and (..., r), ``apart`` somehow, are uncorrelated."""
    if one[..., 0].size < MIN_VALUES:
        return
    rule = f"{labels.noise} must be uncorrelated with {labels.noise} {apart}"
    names = component_labels(one), component_labels(other)
    demand_agreement(compare_with(one, other, *names, family_level()), labels.where, rule)


def check_independent(e: FloatArray, others: FloatArray, labels: NoiseLabels, name: str) -> None:
    """Check that mean and variance of unit noise e (N, q) are the same above and below the medians
    of ``others`` (N, r), values before the noise is drawn, which messages call ``name``.
    """
    rule = f"{labels.noise} must not depend on {name}"
    for comparison in compare_sides(e, others, family_level()) if len(e) >= MIN_VALUES else ():
        demand_agreement(comparison, labels.where, rule)


def whitened(
    noise: FloatArray, S: FloatArray, sizes: FloatArray, where: str, rule: str, remedy: str = ""
) -> FloatArray:
    """Return ``noise`` (..., q) of covariance ``S`` as standard white noise (..., r). Raises
    AssertionError unless it is 0, relative to ``sizes`` (q,), where S has next to no noise.
    """
    factor, null_space = whiten(S)
    visible = is_visible(factor, sizes)
    certain = np.concatenate([null_space, factor[~visible]])
    limits = CERTAIN * np.maximum(np.abs(certain) @ sizes, np.finfo(float).tiny)
    error = CERTAIN * float((np.abs(noise @ certain.T) / limits).max(initial=0.0))
    demand(error <= CERTAIN, where, rule, f"{error:.3g} of its size left over", remedy)
    return np.asarray(noise @ factor[visible].T)
