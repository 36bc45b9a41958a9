"""Tests of noise against the law it should have, at a level that a checker can afford.

A checker makes at most ``FAMILIES`` families of tests. Each family spends the same share of
``LEVEL``, divided among its tests, so that a sound class is accused once in a million checks.
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
PARTS = 4
NEGLIGIBLE = 1e-8
"""Share of a standard deviation that counts as rounding."""
MIN_VALUES = 1000
"""Values below which the normal law of a mean cannot be relied on so far out."""


class Deviation(NamedTuple):
    """The mean in a family that lies furthest from zero, its standard error, and its position."""

    mean: float
    error: float
    position: tuple[int, ...]


def standard_errors(count: int) -> float:
    """Return the standard errors beyond which one of ``count`` tests of a family fails."""
    return float(-ndtri(0.5 * LEVEL / (FAMILIES * max(count, 1))))


def largest_deviation(values: FloatArray, fewest: int = MIN_VALUES) -> Deviation | None:
    """Return the mean of ``values`` (N, ...) over the first axis that is significantly not zero,
    the most significant one, or None (always with less than ``fewest`` values). Values must be
    uncorrelated along the first axis.
    """
    count = len(values)
    if count < fewest or not values[0].size:
        return None
    mean = np.asarray(values.mean(axis=0))
    error = np.asarray(values.std(axis=0)) / math.sqrt(count)
    limit = standard_errors(mean.size)
    beyond = np.abs(mean) / (limit * error + NEGLIGIBLE)
    for k in np.argsort(-beyond, axis=None):
        position = np.unravel_index(int(k), beyond.shape)
        if beyond[position] <= 1.0:
            return None
        chosen = values.reshape(count, -1)[:, int(k)]
        if _is_certain(chosen, float(mean[position]), float(error[position]), limit):
            return Deviation(
                float(mean[position]), float(error[position]), tuple(map(int, position))
            )
    return None


def _is_certain(values: FloatArray, mean: float, error: float, limit: float) -> bool:
    """Return True if a mean is beyond ``limit`` standard errors for skewed values, too.

    A studentised mean of skewed values has one long tail; it is corrected to second order by the
    transformation of P. Hall, "On the removal of skewness by transformation", 1992.
    """
    if error <= NEGLIGIBLE * abs(mean):
        return True
    t, root = mean / error, math.sqrt(len(values))
    skewness = float(((values - mean) ** 3).mean()) / (error * root) ** 3 / root
    normal = t + skewness * t**2 / 3.0 + skewness**2 * t**3 / 27.0 + skewness / 6.0
    return abs(normal) > limit


class Whitening(NamedTuple):
    """Factors of a covariance S (n, n): ``free`` (r, n) makes noise of it standard white noise of r
    components, ``certain`` (n - r, n) are the unit directions in which S has no noise.
    """

    free: FloatArray
    certain: FloatArray


def whitening(S: FloatArray) -> Whitening:
    """Return the factors of a covariance, which may be singular."""
    values, vectors = np.linalg.eigh(symmetric(S))
    used = values > 1e-12 * max(float(values[-1]), np.finfo(float).tiny)
    return Whitening((vectors[:, used] / np.sqrt(values[used])).T, vectors[:, ~used].T)


class Stated(NamedTuple):
    """Words about noise: the method that makes it, the noise itself, the field that states it."""

    where: str
    noise: str
    field: str


def check_white(e: FloatArray, stated: Stated) -> None:
    """Check that whitened noise e (R, K, q) of R runs at K times has mean 0 and covariance 1 in
    every part of a run, that no component at one time is correlated with one at another, and that
    runs are uncorrelated. Raises AssertionError for the most significant deviation of a family.
    """
    if len(e) > 1:
        # Runs have streams of their own: equal ones show a fixed seed, and no other
        # test could trust its standard errors.
        check_uncorrelated(e[:-1], e[1:], stated, "of two runs with different streams")
    _check_moments(e, stated, "")
    length = e.shape[1] // PARTS
    for part in range(PARTS if length else 0):
        some = e[:, part * length : (part + 1) * length]
        _check_moments(some, stated, f" in quarter {part + 1} of a run")
    for lag in LAGS:
        if lag < e.shape[1]:
            check_uncorrelated(e[:, :-lag], e[:, lag:], stated, f"{lag} steps apart")


def _check_moments(e: FloatArray, stated: Stated, when: str) -> None:
    """Check mean and covariance of whitened noise ``e`` (..., q)."""
    q = e.shape[-1]
    flat = e.reshape(-1, q)
    if (found := largest_deviation(flat)) is not None:
        text = f"a mean of {found.mean:.3g} standard deviations (+- {found.error:.2g})"
        rule = f"{stated.noise} must have the mean 0"
        fail(stated.where, rule, f"{text} in component {found.position[0]}{when}")
    products = flat[:, :, None] * flat[:, None, :] - np.eye(q)
    if (found := largest_deviation(products)) is not None:
        i, j = found.position
        size = f"{1.0 + found.mean:.4g} of the stated variance (+- {found.error:.2g})"
        if i != j:
            size = f"a correlation of {found.mean:.3g} (+- {found.error:.2g})"
        rule = f"{stated.noise} must have the covariance that {stated.field} states"
        fail(stated.where, rule, f"{size} in {_components(i, j)} once whitened{when}")


def _components(i: int, j: int) -> str:
    """Return one or two components as text."""
    return f"component {i}" if i == j else f"components {i} and {j}"


def check_uncorrelated(one: FloatArray, other: FloatArray, stated: Stated, apart: str) -> None:
    """Check that unit noises (..., q) and (..., r), paired along all but the last axis, are
    uncorrelated; ``apart`` says where the two come from.
    """
    pairs = one.reshape(-1, one.shape[-1])[:, :, None] * other.reshape(-1, other.shape[-1])[:, None]
    found = largest_deviation(pairs)
    if found is not None:
        i, j = found.position
        rule = f"{stated.noise} must be uncorrelated with {stated.noise} {apart}"
        text = f"a correlation of {found.mean:.3g} (+- {found.error:.2g})"
        fail(stated.where, rule, f"{text} of components {i} and {j}")


def check_unrelated(e: FloatArray, known: FloatArray, stated: Stated, what: str) -> None:
    """Check that neither the mean nor the size of unit noise e (N, q) depends on ``known`` (N, r),
    which is fixed before the noise is drawn and called ``what``.
    """
    spread = known.std(axis=0)
    moves = spread > NEGLIGIBLE * (1.0 + np.abs(known).max(axis=0, initial=0.0))
    sides = np.sign(known[:, moves] - np.median(known[:, moves], axis=0))
    for power, values in (("mean", e), ("variance", e**2 - 1.0)):
        found = largest_deviation(values[:, :, None] * sides[:, None, :])
        if found is not None:
            rule = f"{stated.noise} must not depend on {what}"
            size = f"{2.0 * found.mean:.3g} (+- {2.0 * found.error:.2g})"
            text = (
                f"another {power} of component {found.position[0]}, by {size} in units of its own"
            )
            fail(
                stated.where,
                rule,
                f"{text}, where component {found.position[1]} is above its median",
            )


def log_level(count: int) -> float:
    """Return minus the logarithm of the level of each of ``count`` two-sided tests of a family."""
    return math.log(2.0 * FAMILIES * max(count, 1) / LEVEL)


def divergence(found: FloatArray, stated: FloatArray) -> FloatArray:
    """Return the Kullback-Leibler divergence of frequencies from probabilities: a frequency of N
    trials lies so far off with a probability of at most ``exp(-N divergence)`` (Chernoff).
    """
    total = np.zeros(np.broadcast(found, stated).shape)
    for f, p in ((found, stated), (1.0 - found, 1.0 - stated)):
        with np.errstate(divide="ignore", invalid="ignore"):
            total += np.where(f > 0.0, f * np.log(f / np.maximum(p, 0.0)), 0.0)
    return np.where(np.isnan(total), math.inf, total)
