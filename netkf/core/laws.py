"""The laws that parts state: of gaps between ticks, of delays, of losses that follow each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray


class WaitingLaw(NamedTuple):
    """The law of independent waiting times (gaps between ticks, delays) that have a density.

    cdf      : distribution function, of times (K,) at least 0
    quantile : its inverse, of probabilities (K,)
    spread   : variance over squared mean
    """

    cdf: Callable[[FloatArray], FloatArray]
    quantile: Callable[[FloatArray], FloatArray]
    spread: float


class Lattice(NamedTuple):
    """Ticks at ``first + k period`` seconds, k = 0, 1, ..., each late by a time that is uniform in
    [0, ``jitter``). With ``random_phase`` all ticks of a clock are late by one more time, uniform
    in [0, ``period``).
    """

    period: float
    first: float
    jitter: float = 0.0
    random_phase: bool = False


class Chain(NamedTuple):
    """Losses by a two-state Markov chain that makes one step a message: probabilities of its steps
    from good to bad and back, and of delivery in both states.
    """

    to_bad: float
    to_good: float
    deliver_good: float
    deliver_bad: float

    @property
    def mean_delivery(self) -> float:
        """The fraction of messages that arrive in the long run."""
        good, bad = self.to_good * self.deliver_good, self.to_bad * self.deliver_bad
        return (good + bad) / (self.to_bad + self.to_good)

    @property
    def lost_twice(self) -> float:
        """Probability that two consecutive messages are lost, in the stationary chain."""
        start = np.array([self.to_good, self.to_bad]) / (self.to_bad + self.to_good)
        step = np.array([[1.0 - self.to_bad, self.to_bad], [self.to_good, 1.0 - self.to_good]])
        lost = 1.0 - np.array([self.deliver_good, self.deliver_bad])
        return float((start * lost) @ step @ lost)

    @property
    def memory(self) -> float:
        """The factor by which correlations of losses decay with each message."""
        return 1.0 - self.to_bad - self.to_good


def exponential_law(mean: float = 1.0) -> WaitingLaw:
    """Return the exponential law of a ``mean`` in seconds."""
    return WaitingLaw(lambda t: -np.expm1(-t / mean), lambda p: -mean * np.log1p(-p), 1.0)


EXPONENTIAL = exponential_law()
"""The law of the gaps of a Poisson process, in units of their mean."""


def uniform_law(low: float, high: float) -> WaitingLaw:
    """Return the uniform law between ``low`` and ``high`` seconds, low < high."""
    width = high - low
    return WaitingLaw(
        lambda t: np.clip((t - low) / width, 0.0, 1.0),
        lambda p: np.asarray(low + p * width),
        width**2 / (3.0 * (high + low) ** 2),
    )


def gamma_law(shape: float) -> WaitingLaw:
    """Return the gamma law of a ``shape``, of mean 1."""
    from scipy.special import gammainc, gammaincinv

    return WaitingLaw(
        lambda t: np.asarray(gammainc(shape, shape * t), dtype=np.float64),
        lambda p: np.asarray(gammaincinv(shape, p) / shape, dtype=np.float64),
        1.0 / shape,
    )


def weibull_law(shape: float) -> WaitingLaw:
    """Return the Weibull law of a ``shape``, of mean 1."""
    first, second = (math.gamma(1.0 + k / shape) for k in (1.0, 2.0))
    return WaitingLaw(
        lambda t: -np.expm1(-np.asarray((t * first) ** shape, dtype=np.float64)),
        lambda p: np.asarray((-np.log1p(-p)) ** (1.0 / shape) / first, dtype=np.float64),
        second / first**2 - 1.0,
    )


def lognormal_law(mean: float, sigma: float) -> WaitingLaw:
    """Return the lognormal law of a ``mean`` in seconds, its logarithm of deviation ``sigma``."""
    from scipy.special import ndtr, ndtri

    return WaitingLaw(
        lambda t: ndtr(np.log(np.maximum(t, 1e-300) / mean) / sigma + 0.5 * sigma),
        lambda p: mean * np.exp(sigma * (ndtri(p) - 0.5 * sigma)),
        math.expm1(sigma**2),
    )
