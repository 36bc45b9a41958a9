"""Link rates: for a steady bound H(12), and for a distance from the limit S (H Theorem 3)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.coupled import CoupledRiccati, coupled_riccati
from netkf.theory.hybrid.limits import limit_covariance
from netkf.theory.hybrid.steady import steady_state, threshold_factor
from netkf.theory.numerics.matrices import as_number

MAX_FACTOR = 1e12  # of all rates: beyond it rounding decides
NO_STEADY_STATE = 1e3  # stands for the logarithm of an infinite distance
FACTOR_TOLERANCE = 1e-10  # of the logarithm of the factor


class LinkRate(NamedTuple):
    """The smallest link rates for a promise.

    factor : by which all rates of the scenario are multiplied
    rate   : that of every link, per second; nan if the links have different rates
    """

    factor: float
    rate: float


def link_rate_threshold(scenario: Scenario) -> LinkRate:
    """Return the link rates from which on H(12), the coupled Riccati equations that bound the mean
    of each filter's P, has a steady state.

    Below them the bound grows without limit although all rates are positive and the graph is
    connected, so that paper H Proposition 4 is false as printed. To 1e-6, or 1e-3 for large
    networks. Raises TheoryError if H(12) does not apply or no rate suffices.
    """
    equations = _require_talk(scenario)
    # A steady state for hardly any messages: every node has one by itself.
    if steady_state(equations.scale_rates(1e-9)) is not None:
        return _with_rate(scenario, 0.0)
    slow = 1.0
    # The search goes upwards, so it starts from rates that are too slow.
    while steady_state(equations.scale_rates(slow)) is not None:
        slow *= 0.1
    factor = threshold_factor(equations.scale_rates(slow))
    if factor is None:
        raise TheoryError("Tanwani's H(12) has no steady state for any link rates")
    return _with_rate(scenario, slow * factor)


def link_rate_for(scenario: Scenario, delta: float) -> LinkRate:
    """Return the smallest link rates for which the steady bound is within ``delta`` of S.

    Paper H Theorem 3 says that there are some: ``max_i |calP_i - S|_F <= delta`` in the steady
    state of H(12), with all rates multiplied by one factor. The distance falls with the rates, in
    the end in proportion to 1/rate; the factor is found to 1e-10. 0 if the nodes have S at any
    rate. Raises TheoryError if H(12) or S do not apply, as with delays, or no rate up to 1e12 times
    the scenario's suffices.
    """
    delta = as_number("delta", delta)
    if not 0.0 < delta < math.inf:
        raise TheoryError(f"delta must be a positive number, got {delta!r}")
    equations, S = _require_talk(scenario), limit_covariance(scenario)
    if equations.delay > 0.0:
        raise TheoryError("S is the limit for links that take no time")
    known: FloatArray | None = None

    def excess(log_factor: float) -> float:
        """Return log(distance / delta) with all link rates times exp(``log_factor``)."""
        nonlocal known
        P = steady_state(equations.scale_rates(math.exp(log_factor)), known)
        if P is None:
            return NO_STEADY_STATE
        known = P
        distance = float(np.linalg.norm(P - S, axis=(1, 2)).max())
        return math.log(max(distance, 1e-300) / delta)

    # An interval low .. high of the logarithm with the root in it: upwards, then downwards.
    step, low, high = math.log(4.0), 0.0, 0.0
    while excess(high) > 0.0:
        low, high = high, high + step
        if high > math.log(MAX_FACTOR):
            raise TheoryError(f"no rates up to {MAX_FACTOR:g} times those given come so close to S")
    while low == high or excess(low) <= 0.0:
        low, high = low - step, low if low != high else high
        if low < -math.log(MAX_FACTOR):
            return _with_rate(scenario, 0.0)
    # It takes 0.3 s to import.
    import scipy.optimize

    root = scipy.optimize.brentq(excess, low, high, xtol=FACTOR_TOLERANCE)
    return _with_rate(scenario, math.exp(float(root)))


def _require_talk(scenario: Scenario) -> CoupledRiccati:
    """Return the equations H(12) of a scenario; raises TheoryError if no message arrives."""
    equations = coupled_riccati(scenario)
    if not equations.coupling.nnz:
        raise TheoryError("no message ever arrives, so that rates of links change nothing")
    return equations


def _with_rate(scenario: Scenario, factor: float) -> LinkRate:
    """Return ``factor`` and its rate (1/s) if all clocks have one rate, else nan."""
    clock = scenario.network.activation
    rate = getattr(clock, "rate", None)
    if rate is None or getattr(clock, "rates", None):
        return LinkRate(factor, math.nan)
    return LinkRate(factor, factor * float(rate))
