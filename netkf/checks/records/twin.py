"""One run on both engines, which should make the same events and states."""

from __future__ import annotations

import numpy as np

from netkf.checks.rounding import EPS, OPERATIONS, allowed_deviation, largest_terms
from netkf.linalg.arrays import FloatArray, enlarged
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run, first_difference

STATE_TOLERANCE = 1e-6
"""Difference of estimates in standard deviations, and of covariances relative to their largest
entry, above which two engines do not compute the same.
"""


def twin_fault(scenario: Scenario, run: Run, twin: Run) -> str:
    """Return one line about the first difference of a ``run`` on two engines; empty without one."""
    difference = first_difference(run, twin)
    if difference is not None:
        return difference
    if run.status != twin.status or not np.array_equal(run.times, twin.times):
        return f"{run.status} after {len(run.times)} samples, {twin.status} after {len(twin.times)}"
    for name, (_, total) in twin.sums.items():
        if not abs(run.sums[name][1] - total) <= STATE_TOLERANCE * abs(total):
            return f"the sum of {name} over all nodes {run.sums[name][1]:.9g}, {total:.9g}"
    for name, gap, allowed in _gaps(scenario, run, twin):
        wrong = ~(gap <= allowed)
        if wrong.any():
            k, i = np.argwhere(wrong)[0].tolist()
            return (
                f"{name} of node {run.nodes[i]} at {run.times[k]:g} s differs by {gap[k, i]:.2e}, "
                f"rounding explains {allowed[k, i]:.0e}"
            )
    return ""


def _gaps(scenario: Scenario, run: Run, twin: Run) -> list[tuple[str, FloatArray, FloatArray]]:
    """Return names of values, the differences (T, N) of two runs, and what rounding explains."""
    covs = [scenario.initial_estimate(node)[1] for node in scenario.nodes]
    rows, columns = np.max([cov.shape for cov in covs], axis=0)
    starts = np.stack([enlarged(cov, rows, columns) for cov in covs])
    # Errors of unknown states are nan in both, as are states that a node does not estimate.
    unknown = np.isnan(twin.error) & np.isnan(run.error) & np.isfinite(twin.xhat)
    error, run_error = (np.where(unknown, 0.0, one.error) for one in (twin, run))
    missing = np.isnan(twin.xhat)
    outside = missing & np.isnan(run.xhat) & ~missing.all(axis=2, keepdims=True)
    of_P = outside[..., :, None] | outside[..., None, :]
    information = float(np.linalg.norm(scenario.node_infos[0].information, 2))
    twin_P = np.where(of_P, 0.0, twin.P)
    given = np.asarray(np.isfinite(twin_P).all(axis=(2, 3)))
    P = np.where(given[..., None, None], twin_P, 0.0)
    size = np.abs(P).max(axis=(2, 3), initial=0.0)
    terms = largest_terms(P[None], starts, information)[0]
    with np.errstate(over="ignore", invalid="ignore"):
        gaps = np.where(of_P, 0.0, np.abs(run.P - twin.P))
        covariance = np.where(given, gaps.max(axis=(2, 3), initial=0.0), 0.0)
        estimate, state = (
            np.where(outside, 0.0, np.abs(one - other)).max(axis=2, initial=0.0)
            for one, other in ((run_error, error), (run.xhat, twin.xhat))
        )
    # An estimate inherits the relative rounding of the largest covariance so far, by which its
    # gains were computed, and those of the errors and states that it comes from.
    deviation = np.sqrt(np.trace(P, axis1=2, axis2=3))
    own = np.where(outside, 0.0, np.abs(error))
    errors = np.maximum.accumulate(own.max(axis=(1, 2), initial=0.0))[:, None]
    states = np.maximum.accumulate(np.nan_to_num(np.abs(twin.x)).max(axis=1, initial=0.0))[:, None]
    spread = np.divide(terms, np.square(deviation), out=np.ones_like(size), where=deviation > 0.0)
    rounding = OPERATIONS * EPS * errors * np.maximum.accumulate(np.maximum(spread, 1.0))
    rounding = rounding + OPERATIONS * EPS * (0.0 if twin.exact_errors else states)
    floor = np.where(given, STATE_TOLERANCE * deviation, STATE_TOLERANCE * errors)
    allowed = np.maximum(floor, rounding)
    return [
        ("the error", estimate, allowed),
        ("the estimate", state, np.maximum(allowed, OPERATIONS * EPS * states)),
        ("P", covariance, allowed_deviation(size, terms, STATE_TOLERANCE)),
    ]
