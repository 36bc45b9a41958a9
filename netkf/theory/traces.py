"""Traces of covariances that theory gives to compare those of a run with, and their names.

H(12) and H(13) are equations of paper H on the hybrid filter, see theory/README.md: the bound on
the mean of P over time, and its limit S for fast links.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.runs.labels import covariance_notes
from netkf.runs.summary import PromisedTraces
from netkf.scenario.scenario import Scenario
from netkf.theory.common.requirements import scenario_of_estimates
from netkf.theory.hybrid.bounds import covariance_bound
from netkf.theory.hybrid.coupled import (
    concerns_hybrid_paper,
    has_balanced_rates,
    reason_without_bound,
)
from netkf.theory.hybrid.limits import central_covariance, limit_covariance
from netkf.theory.hybrid.steady import has_steady_state, has_steady_state_near

MAX_BOUND_BYTES, STAGES = 1.5 * 2**30, 30
"""Largest memory of a bound that is computed, and the stages that a step of its solver stores."""
MAX_STEADY_ENTRIES = 100_000
"""Largest number of entries of all covariances for which a run computes the steady state."""


def theory_traces(scenario: Scenario, times: FloatArray) -> PromisedTraces:
    """Return traces at ``times``: bound on P, its limit, a central filter's; or the reason."""
    bound, reached, reason = None, None, ""
    try:
        scenario = scenario_of_estimates(scenario)
    except TheoryError as error:
        notes = tuple(covariance_notes(scenario))
        return PromisedTraces(None, np.nan, np.nan, str(error), limit_label="", notes=notes)
    try:
        if len(times):
            _require_small_bound(scenario, len(times))
            P = covariance_bound(scenario, times)
            bound, reached = np.trace(P, axis1=2, axis2=3), P[-1]
    except TheoryError as error:
        reason = str(error)
    last = scenario.last_piece
    limit, central = (_trace_or_nan(of, last) for of in (limit_covariance, central_covariance))
    remarks = [_steady_note(last, reached)]
    if last is not scenario and np.isfinite([limit, central]).any():
        remarks.append("limits and centralised filter are of the plant after all changes")
    return PromisedTraces(
        bound,
        limit,
        central,
        reason=reason or reason_without_bound(last) or "",
        limit_label=limit_label(last),
        notes=(*filter(None, remarks), *covariance_notes(scenario)),
    )


def _require_small_bound(scenario: Scenario, samples: int) -> None:
    """Raise TheoryError if the bound at so many ``samples`` takes too much memory."""
    if reason_without_bound(scenario):
        return
    n = scenario.plant.n
    # Numbers that computing it stores: at each sample, and for the stages of a step.
    entries = (samples * (1.5 * n * n + n) + STAGES * n * (n + 1)) * len(scenario.nodes)
    if 8.0 * entries > MAX_BOUND_BYTES:
        raise TheoryError(
            f"not computed: Tanwani's H(12) of {len(scenario.nodes):,} nodes, {samples:,} samples, "
            f"takes {8.0 * entries / 2**30:.1f} GiB; sample less often (probe), or call "
            "netkf.theory.covariance_bound"
        )


def _steady_note(scenario: Scenario, reached: FloatArray | None) -> str:
    """Return what to say of the steady state of the bound, of which P (N, n, n) is ``reached``."""
    if scenario.slotted or reason_without_bound(scenario):
        return ""
    if len(scenario.nodes) * scenario.plant.n**2 > MAX_STEADY_ENTRIES:
        size = MAX_STEADY_ENTRIES // scenario.plant.n**2
        return (
            f"whether the bound has a steady state is not looked into beyond {size:,} nodes; see "
            "netkf theory"
        )
    try:
        if reached is None:
            settles = has_steady_state(scenario)
        else:
            settles = has_steady_state_near(scenario, reached)
        if settles:
            return ""
    except TheoryError as error:
        return f"steady state of the bound: {error}"
    if not scenario.filter.algorithm.timing.talks:
        return "at some nodes P has no steady state, it grows without end; see netkf theory"
    return "the bound has no steady state, it grows without end; see netkf theory"


def _trace_or_nan(function: Any, scenario: Scenario) -> float:
    try:
        return float(np.trace(function(scenario)))
    except TheoryError:
        return float("nan")


def limit_label(scenario: Scenario) -> str:
    """Return the name of the limit of the bound for fast links; empty without the paper H."""
    if not concerns_hybrid_paper(scenario):
        return ""
    balanced = has_balanced_rates(scenario)
    name = "limit S of Tanwani's H(13)" if balanced else "weighted limit (not S of Tanwani's H(13))"
    return name + delay_suffix(scenario)


def delay_suffix(scenario: Scenario) -> str:
    """Return text for the name of a limit that assumes no delays; empty without delays."""
    delayed = scenario.filter.algorithm.timing.talks and scenario.network.channel.delay.fixed != 0.0
    return ", if messages took no time" if delayed else ""
