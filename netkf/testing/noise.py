"""Statistical tests of noise against its stated law.

A checker makes at most ``FAMILIES`` families of tests. Each family gets the same share of the
significance level ``LEVEL``, divided equally among its tests (Bonferroni), so that a correct class
fails once in a million checks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from netkf.linalg.arrays import FloatArray, symmetric
from netkf.testing.watching import fail

LEVEL, FAMILIES = 1e-6, 200
LAGS = (1, 2, 3, 7)
"""Steps apart at which correlations in time are tested."""
PARTS = 4
"""Parts of a run that are tested separately."""
NEGLIGIBLE = 1e-8
"""Share of a standard deviation that counts as rounding."""
MIN_VALUES = 1000
"""Smallest number of values whose mean is close enough to normal so far in its tails."""


class Deviation(NamedTuple):
    """The most significant mean of a family of tests, its standard error, and its indices."""

    mean: float
    error: float
    position: tuple[int, ...]


def critical_value(count: int) -> float:
    """Return the number of standard errors beyond which one of ``count`` two-sided tests fails, so
    that all of them together (a family) fail by chance with the probability LEVEL / FAMILIES.
    """
    return float(-ndtri(0.5 * LEVEL / (FAMILIES * max(count, 1))))


def largest_deviation(values: FloatArray, min_values: int = MIN_VALUES) -> Deviation | None:
    """Return the most significant of the means of ``values`` (N, ...) over the first axis that
    differ significantly from zero; None if none does or N is less than ``min_values``.

    The means are one family of tests, which together err with the probability LEVEL / FAMILIES.
    Values must be uncorrelated along the first axis.
    """
    count = len(values)
    if count < min_values or not values[0].size:
        return None
    mean = np.asarray(values.mean(axis=0))
    error = np.asarray(values.std(axis=0)) / math.sqrt(count)
    limit = critical_value(mean.size)
    excess = np.abs(mean) / (limit * error + NEGLIGIBLE)
    for k in np.argsort(-excess, axis=None):
        position = np.unravel_index(int(k), excess.shape)
        if excess[position] <= 1.0:
            return None
        column = values.reshape(count, -1)[:, int(k)]
        if _is_significant_if_skewed(column, float(mean[position]), float(error[position]), limit):
            return Deviation(
                float(mean[position]), float(error[position]), tuple(map(int, position))
            )
    return None


def _is_significant_if_skewed(values: FloatArray, mean: float, error: float, limit: float) -> bool:
    """Return True if the ``mean`` of ``values`` (N,) exceeds ``limit`` standard errors after a
    correction for skewness.

    ``error`` is its standard error. A studentised mean of skewed values has one long tail. It is
    corrected to second order by the transformation of P. Hall, "On the removal of skewness by
    transformation", 1992.
    """
    if error <= NEGLIGIBLE * abs(mean):
        return True
    t, root = mean / error, math.sqrt(len(values))
    # The sample skewness over sqrt(N), as all terms of the transformation have it.
    skewness = float(((values - mean) ** 3).mean()) / (error * root) ** 3 / root
    corrected = t + skewness * t**2 / 3.0 + skewness**2 * t**3 / 27.0 + skewness / 6.0
    return abs(corrected) > limit


class Whitening(NamedTuple):
    """Factors of a covariance S (n, n) of rank r.

    factor     : (r, n), W with W S W' = 1: it turns noise of covariance S into standard white noise
    null_space : (n - r, n), orthonormal rows: the directions in which S has no noise
    """

    factor: FloatArray
    null_space: FloatArray


def compute_whitening(S: FloatArray) -> Whitening:
    """Return the whitening factors of a covariance ``S`` (n, n), which may be singular."""
    values, vectors = np.linalg.eigh(symmetric(S))
    positive = values > 1e-12 * max(float(values[-1]), np.finfo(float).tiny)
    factor = (vectors[:, positive] / np.sqrt(values[positive])).T
    return Whitening(factor, vectors[:, ~positive].T)


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
    """Check that ``e`` (R, K, q), noise with q components of R runs at K times, is standard white
    noise.

    In every part of a run its mean must be 0 and its covariance 1; components at different times,
    and runs, must be uncorrelated. Raises AssertionError for the most significant deviation of the
    first family of tests that fails.
    """
    if len(e) > 1:
        # First, because with equal runs (from a fixed seed) all other standard errors are wrong.
        check_uncorrelated(e[:-1], e[1:], labels, "of two runs with different streams")
    _check_moments(e, labels, "")
    length = e.shape[1] // PARTS
    for part in range(PARTS if length else 0):
        quarter = e[:, part * length : (part + 1) * length]
        _check_moments(quarter, labels, f" in quarter {part + 1} of a run")
    for lag in LAGS:
        if lag < e.shape[1]:
            check_uncorrelated(e[:, :-lag], e[:, lag:], labels, f"{lag} steps apart")


def _check_moments(e: FloatArray, labels: NoiseLabels, when: str) -> None:
    """Check that whitened noise ``e`` (..., q) has mean 0 and covariance 1, over all axes but the
    last; ``when`` ends messages.
    """
    q = e.shape[-1]
    flat = e.reshape(-1, q)
    deviation = largest_deviation(flat)
    if deviation is not None:
        text = f"a mean of {deviation.mean:.3g} standard deviations (+- {deviation.error:.2g})"
        rule = f"{labels.noise} must have the mean 0"
        fail(labels.where, rule, f"{text} in component {deviation.position[0]}{when}")
    products = flat[:, :, None] * flat[:, None, :] - np.eye(q)
    deviation = largest_deviation(products)
    if deviation is not None:
        i, j = deviation.position
        size = f"{1.0 + deviation.mean:.4g} of the stated variance (+- {deviation.error:.2g})"
        if i != j:
            size = f"a correlation of {deviation.mean:.3g} (+- {deviation.error:.2g})"
        rule = f"{labels.noise} must have the covariance that {labels.field} states"
        fail(labels.where, rule, f"{size} in {_name_components(i, j)} once whitened{when}")


def _name_components(i: int, j: int) -> str:
    """Return "component i", or "components i and j" if they differ."""
    return f"component {i}" if i == j else f"components {i} and {j}"


def check_uncorrelated(one: FloatArray, other: FloatArray, labels: NoiseLabels, apart: str) -> None:
    """Check that unit noises ``one`` (..., q) and ``other`` (..., r), paired along all but the last
    axis, are uncorrelated; ``labels`` and ``apart`` say in messages which noises they are and how
    they are related.
    """
    first, second = one.reshape(-1, one.shape[-1]), other.reshape(-1, other.shape[-1])
    deviation = largest_deviation(first[:, :, None] * second[:, None])
    if deviation is not None:
        i, j = deviation.position
        rule = f"{labels.noise} must be uncorrelated with {labels.noise} {apart}"
        text = f"a correlation of {deviation.mean:.3g} (+- {deviation.error:.2g})"
        fail(labels.where, rule, f"{text} of components {i} and {j}")


def check_independent(
    e: FloatArray, covariates: FloatArray, labels: NoiseLabels, name: str
) -> None:
    """Check that mean and variance of unit noise e (N, q) do not depend on ``covariates`` (N, r).

    These are values before the noise is drawn, which messages call ``name``. Noise is compared
    where a covariate is above its median and where it is below.
    """
    deviations = covariates.std(axis=0)
    varies = deviations > NEGLIGIBLE * (1.0 + np.abs(covariates).max(axis=0, initial=0.0))
    sides = np.sign(covariates[:, varies] - np.median(covariates[:, varies], axis=0))
    for moment, values in (("mean", e), ("variance", e**2 - 1.0)):
        deviation = largest_deviation(values[:, :, None] * sides[:, None, :])
        if deviation is not None:
            component, covariate = deviation.position
            size = f"{2.0 * deviation.mean:.3g} (+- {2.0 * deviation.error:.2g})"
            fail(
                labels.where,
                f"{labels.noise} must not depend on {name}",
                f"another {moment} of component {component}, by {size} in units of its own, "
                f"where component {covariate} is above its median",
            )


def minus_log_level(count: int) -> float:
    """Return ``-log(level)`` for the significance level of each of ``count`` two-sided tests that
    together (a family) fail by chance with the probability LEVEL / FAMILIES; for bounds of the form
    P(deviation) <= 2 exp(-exponent).
    """
    return math.log(2.0 * FAMILIES * max(count, 1) / LEVEL)


def kolmogorov_distance(values: FloatArray) -> float:
    """Return the largest difference between the distribution function of ``values`` (N,) and that
    of the uniform law on [0, 1].
    """
    ordered = np.sort(values)
    steps = np.arange(ordered.size + 1) / ordered.size
    return float(max((steps[1:] - ordered).max(), (ordered - steps[:-1]).max()))


def divergence(frequencies: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Return the Kullback-Leibler divergence of each of ``frequencies`` from its probability; both
    broadcast to one shape, which is that of the result.

    A frequency in N trials deviates so much to one side with a probability of at most
    ``exp(-N divergence)`` (Chernoff's bound).
    """
    total = np.zeros(np.broadcast(frequencies, probabilities).shape)
    for f, p in ((frequencies, probabilities), (1.0 - frequencies, 1.0 - probabilities)):
        with np.errstate(divide="ignore", invalid="ignore"):
            total += np.where(f > 0.0, f * np.log(f / np.maximum(p, 0.0)), 0.0)
    return np.where(np.isnan(total), math.inf, total)
