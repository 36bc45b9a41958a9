"""Results that ``netkf theory`` prints for the push-sum filter: P section 4, exact mean squares."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.limits import central_covariance
from netkf.theory.push_sum.broadcasts import leader_agreement
from netkf.theory.push_sum.certified_gamma import (
    MAX_SEARCHED,
    corollary_2,
    exact_minimum_gamma,
    minimum_gamma,
    searches_gamma,
)
from netkf.theory.push_sum.disconnection import disconnection_probability
from netkf.theory.push_sum.limits import consensus_gain_bound, push_sum_limits
from netkf.theory.push_sum.mean_square import push_sum_error_covariance, push_sum_radius

MAX_STEPS = 20  # largest gamma in the search for the exact smallest one
MAX_LEADER_SLOTS, AGREEMENT = 200, 0.99  # slots of an election; probability that it is over


def slot_promises(scenario: Scenario) -> dict[str, Any]:
    """Return the results of P by name, each ``{"value", "reason"}``, one of them None."""

    def cut() -> list[float]:
        probability = disconnection_probability(scenario)
        return [probability.low, probability.high]

    functions: dict[str, Callable[[], Any]] = {
        "limit_trace": lambda: float(np.trace(push_sum_limits(scenario).P)),
        "central_trace": lambda: float(np.trace(central_covariance(scenario))),
        "error_traces": lambda: np.trace(
            push_sum_error_covariance(scenario), axis1=1, axis2=2
        ).tolist(),
        "radius": lambda: push_sum_radius(scenario),
        "laplacian_radius": lambda: consensus_gain_bound(scenario).radius,
        "exact_minimum_gamma": lambda: _exact_gamma(scenario),
        "minimum_gamma_mean": lambda: minimum_gamma(scenario, "mean"),
        "minimum_gamma_mean_square": lambda: minimum_gamma(scenario, "mean-square"),
        "corollary_2": lambda: corollary_2(scenario)._asdict(),
        "leader_slots": lambda: _leader_slots(scenario),
        "disconnection_probability": cut,
    }
    return {name: _value_or_reason(function) for name, function in functions.items()}


def _exact_gamma(scenario: Scenario) -> int:
    """Return the least gamma with stable mean squares; raises TheoryError if it takes long."""
    if not searches_gamma(scenario):
        raise TheoryError(
            f"not looked for: the nodes have more than {MAX_SEARCHED} states together; "
            "netkf.theory.exact_minimum_gamma looks for it however long it takes"
        )
    return exact_minimum_gamma(scenario, most=MAX_STEPS)


def _leader_slots(scenario: Scenario) -> int:
    """Return the slots until all know the leader with probability AGREEMENT; TheoryError."""
    undecided = leader_agreement(scenario, MAX_LEADER_SLOTS) < AGREEMENT
    if undecided.all():
        raise TheoryError(f"not within {MAX_LEADER_SLOTS} slots")
    return int(undecided.sum())


def _value_or_reason(function: Callable[[], Any]) -> dict[str, Any]:
    try:
        return {"value": function(), "reason": None}
    except TheoryError as error:
        return {"value": None, "reason": str(error)}


def slot_lines(results: dict[str, Any], number: Callable[[Any], str]) -> list[str]:
    """Return the ``results`` as lines for a terminal; ``number`` formats a value."""

    def text(name: str, make: Callable[[Any], str] = number) -> str:
        """Return the value ``name`` as text by ``make``, or the reason why there is none."""
        value = results[name]
        return value["reason"] or make(value["value"])

    def errors(traces: list[float]) -> str:
        # The central trace is None where the central filter has no steady covariance.
        mean, central = float(np.mean(traces)), results["central_trace"]["value"]
        ratio = f", {mean / central:.4g} times the central one" if central else ""
        return f"mean {number(mean)}, from {number(min(traces))} to {number(max(traces))}{ratio}"

    def interval(ends: list[float]) -> str:
        low, high = ends
        return number(low) if low == high else f"{number(low)} .. {number(high)} (simulated)"

    def corollary(results: dict[str, float]) -> str:
        verdict = "too few" if results["gamma"] < results["needed"] else "enough"
        return f"{results['gamma']}, where rho(A_R) is {number(results['radius'])}: {verdict}"

    return [
        f"trace of P_inf, what every node takes its covariance to be: {text('limit_trace')}",
        f"trace of the central filter's covariance: {text('central_trace')}",
        f"trace of the steady error covariance, exact: {text('error_traces', errors)}",
        f"mean-square radius, exact: {text('radius')}",
        f"smallest gamma with a radius below 1: {text('exact_minimum_gamma', str)}",
        f"smallest gamma by P Theorem 5 (mean): {text('minimum_gamma_mean', str)}",
        f"smallest gamma by P Theorem 6 (mean square): {text('minimum_gamma_mean_square', str)}",
        f"smallest gamma with P (44), Corollary 2: {text('corollary_2', corollary)}",
        f"slots until all nodes know a leader with probability {AGREEMENT:g}, P Remark 3: "
        f"{text('leader_slots', str)}",
        f"rho(L): {text('laplacian_radius')}",
        f"disconnection probability: {text('disconnection_probability', interval)}",
    ]
