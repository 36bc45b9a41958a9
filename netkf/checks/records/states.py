"""The samples of one run held against the plant, the start and the record, and on both engines."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy

from netkf.algorithms.registry import own_attributes
from netkf.checks.evidence import EPS, OPERATIONS, allowed_deviation
from netkf.checks.parts.noises import pieces_between
from netkf.checks.samples import covariance_units, rounded_terms
from netkf.linalg.arrays import FloatArray, in_units, row_units
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run, first_difference, states_of_nodes
from netkf.trace.schema import CODES, rows_of

TRUTH_TOLERANCE, START_TOLERANCE = 1e-8, 1e-9
"""Tolerated differences of states from those drawn again, relative to the largest state so far, and
of starting estimates and covariances, relative to their largest entry.
"""
METROPOLIS = "metropolis"
"""The value of ``filter.weights`` for weights that depend on the numbers of links."""
ROUNDINGS = 1e4
"""Relative errors EPS of a state from which others grow as the plant does."""
COINCIDENT = 4
"""Events of each kind at whose instants samples are taken besides."""
SUM_ROUNDINGS = 64.0
"""The same of x - xhat, from the sizes of x and xhat."""


def sample_fault(scenario: Scenario, run: Run, seed: int, replica: int) -> str:
    """Return one line about the first fault of the samples of a run; empty without one."""
    if (run.seed, run.replica, run.nodes) != (seed, replica, scenario.nodes):
        return f"run {run.replica} of seed {run.seed} stands for run {replica} of seed {seed}"
    return (
        _status_fault(scenario, run)
        or (_truth_fault(scenario, run) if run.truth_known else "")
        or (_error_fault(scenario, run) if run.truth_known else "")
    )


def _status_fault(scenario: Scenario, run: Run) -> str:
    diverged = rows_of(run.log, "diverged")
    if (run.status == "diverged") != bool(len(diverged)):
        return f"status {run.status} with {len(diverged)} events that say diverged"
    if run.status == "complete" and not np.isfinite(run.xhat[:, scenario.is_estimated]).all():
        return "status complete with estimates that are not finite"
    expected = scenario.times if run.status == "complete" else scenario.times[: len(run.times)]
    if not np.array_equal(run.times, expected):
        return f"{len(run.times):,} samples, not those at the {len(expected):,} times asked for"
    return ""


def _truth_fault(scenario: Scenario, run: Run) -> str:
    expected, allowed = drawn_states(scenario, run.seed, run.replica, run.times)
    gap = np.where(scenario.unknown, 0.0, np.nan_to_num(np.abs(run.x - expected), nan=np.inf))
    wrong = gap > allowed
    if not wrong.any():
        return ""
    k, i = np.argwhere(wrong)[0].tolist()
    return (
        f"x[{i}] at {run.times[k]:g} s is {gap[k, i]:.3g} away from the state that the plant "
        f"draws, rounding explains {allowed[k, i]:.1e}"
    )


def _units_and_sizes(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return units (n,) of states x (T, n) in which they are at most 1, and their sizes (T,)."""
    sizes = np.nan_to_num(np.abs(x), posinf=np.finfo(float).max)
    largest = sizes.max(axis=0, initial=0.0)
    units = np.where(largest > 0.0, largest, 1.0)
    return units, (sizes / units).max(axis=1, initial=0.0)


def drawn_states(
    scenario: Scenario, seed: int, replica: int, times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the states (T, n) drawn again at ``times``, and differences (T, n) by rounding."""
    streams, truth = Streams(seed, replica), None
    moments: list[Any]
    if scenario.slotted:
        truth = scenario.slot_truth(streams, frames=False)
        moments = [int(slot) for slot in scenario.sampled_slots[: len(times)]]
    else:
        truth, moments = scenario.continuous_truth(streams, frames=False), times.tolist()
    x = np.array([truth.absolute(moment) for moment in moments]).reshape(-1, scenario.plant.n)
    units, sizes = _units_and_sizes(x)
    # Roundings of a state grow as the plant does, also in directions in which the state does not.
    plant: Any = scenario.plant
    allowed = TRUTH_TOLERANCE * np.maximum.accumulate(sizes)
    if not plant.linear:
        # How far roundings grow is unknown: kernels and Python draw the same numbers.
        return x, 1e3 * allowed[:, None] * units
    changes = plant.change_slots if scenario.slotted else plant.changes.tolist()
    for k in range(1, len(x)):
        step = np.eye(scenario.plant.n)
        with np.errstate(all="ignore"):
            for piece, gap in pieces_between(plant, changes, moments[k - 1], moments[k]):
                if scenario.slotted:
                    step = np.linalg.matrix_power(piece.F, gap) @ step
                else:
                    step = scipy.linalg.expm(piece.A * gap) @ step
            step = step * units / units[:, None]
            growth = float(np.linalg.norm(step, 2)) if np.isfinite(step).all() else np.inf
        allowed[k] = max(allowed[k], growth * (allowed[k - 1] + ROUNDINGS * EPS * sizes[k - 1]))
    return x, allowed[:, None] * units


def _error_fault(scenario: Scenario, run: Run) -> str:
    x = states_of_nodes(run.x, len(run.nodes), run.xhat.shape[2], scenario.views)
    units, size = _units_and_sizes(run.x)
    units = states_of_nodes(units[None], len(run.nodes), run.xhat.shape[2], scenario.views)
    with np.errstate(over="ignore", invalid="ignore"):
        gap = np.where(scenario.is_estimated, np.abs(x - run.xhat - run.error) / units, 0.0)
        sizes = np.where(scenario.is_estimated, np.abs(run.xhat) / units, 0.0)
        allowed = SUM_ROUNDINGS * EPS * (size[:, None] + sizes.max(axis=2))
        wrong = gap.max(axis=2, initial=0.0) > allowed + 1e-300
    if not wrong.any():
        return ""
    k, i = np.argwhere(wrong)[0].tolist()
    return f"the error of node {run.nodes[i]} at {run.times[k]:g} s is not x - xhat"


def with_start(scenario: Scenario, horizon: float, log: np.ndarray | None = None) -> Scenario:
    """Return the scenario cut at ``horizon``, with samples at 0 and before events of ``log``."""
    times = [np.zeros(1), scenario.times]
    if not scenario.slotted and log is not None and scenario.is_random:
        for kind in ("absorb", "tick", "sense"):
            instants = log["t"][(log["kind"] == CODES[kind]) & (log["t"] < horizon)]
            times.append(instants[:: max(1, len(instants) // COINCIDENT)][:COINCIDENT])
    probe = np.unique(np.concatenate(times))
    return dataclasses.replace(scenario, horizon=horizon, probe=probe[probe <= horizon])


def weight_fault(scenario: Scenario) -> str:
    """Return one line about the first link whose weight is not that of [filter]; or empty."""
    weights, index = getattr(scenario.filter.algorithm, "weights", None), scenario.topology.index
    senders = scenario.topology.senders
    for sender, receiver in scenario.topology.directions:
        if isinstance(weights, np.ndarray):
            expected = float(weights[index[sender], index[receiver]])
        elif weights == METROPOLIS:
            expected = 1.0 / (1.0 + max(len(senders(sender)), len(senders(receiver))))
        else:
            return ""
        seen = scenario.weight(receiver, sender)
        if not abs(seen - expected) <= START_TOLERANCE:
            return f"node {receiver} gives node {sender} the weight {seen:.6g}, not {expected:.6g}"
    return ""


def start_fault(scenario: Scenario, run: Run) -> str:
    """Return one line about the first wrong estimate, covariance or weight at time 0; or empty."""
    plant, start = scenario.plant, scenario.filter
    for k, node in enumerate(scenario.nodes):
        view = np.arange(plant.n)[scenario.view(k)]
        square, size, units = np.ix_(view, view), len(view), np.ones(len(view))
        for name, given, default, entries, seen in (
            ("covariance", start.cov, plant.start_cov, square, run.P[0, k, :size, :size]),
            ("estimate", start.mean, plant.start_mean, view, run.xhat[0, k, :size]),
        ):
            value = given[k] if isinstance(given, tuple) else given
            expected = np.asarray(default if value is None else value)[entries]
            if np.isnan(seen).all():  # a filter without covariances
                continue
            if name == "covariance":
                units = row_units(np.diagonal(expected))
            unit = units if name == "estimate" else np.outer(units, units)
            gap = np.abs(seen - expected) / unit
            if not gap.max() <= START_TOLERANCE * (np.abs(expected) / unit).max():
                off = (gap * unit).flat[np.argmax(gap)]
                return f"the {name} of node {node} at time 0 is {off:.3g} off that of [filter]"
    return "" if own_attributes(scenario.filter.algorithm) else weight_fault(scenario)


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
            times = gap[k, i] / allowed[k, i] if allowed[k, i] > 0.0 else np.inf
            return (
                f"{name} of node {run.nodes[i]} at {run.times[k]:g} s differs by {times:.2g} times "
                "what rounding explains"
            )
    return ""


def _gaps(scenario: Scenario, run: Run, twin: Run) -> list[tuple[str, FloatArray, FloatArray]]:
    """Return names of values, the differences (T, N) of two runs, and what rounding explains."""
    # Errors of unknown states are nan in both, as are states that a node does not estimate.
    unknown = np.isnan(twin.error) & np.isnan(run.error) & np.isfinite(twin.xhat)
    error, run_error = (np.where(unknown, 0.0, one.error) for one in (twin, run))
    missing = np.isnan(twin.xhat)
    outside = missing & np.isnan(run.xhat) & ~missing.all(axis=2, keepdims=True)
    of_P = outside[..., :, None] | outside[..., None, :]
    twin_P = np.where(of_P, 0.0, twin.P)
    given = np.asarray(np.isfinite(twin_P).all(axis=(2, 3)))
    P = np.where(given[..., None, None], twin_P, 0.0)
    units = covariance_units(scenario, np.arange(len(scenario.nodes)), P)
    P = in_units(P, units.of_nodes)
    size = np.abs(P).max(axis=(2, 3), initial=0.0)
    terms = rounded_terms(scenario, P[None], units)[0]
    with np.errstate(over="ignore", invalid="ignore"):
        gaps = in_units(np.where(of_P, 0.0, np.abs(run.P - twin.P)), units.of_nodes)
        covariance = np.where(given, gaps.max(axis=(2, 3), initial=0.0), 0.0)
        estimate, state = (
            (np.where(outside, 0.0, np.abs(one - other)) / units.of_nodes).max(axis=2, initial=0.0)
            for one, other in ((run_error, error), (run.xhat, twin.xhat))
        )
    # An estimate inherits the relative rounding of the largest covariance so far, by which its
    # gains were computed, and those of the errors and states that it comes from.
    deviation = np.sqrt(np.trace(P, axis1=2, axis2=3))
    errors = np.where(outside, 0.0, np.abs(error)) / units.of_nodes
    errors = np.maximum.accumulate(errors.max(axis=(1, 2), initial=0.0))[:, None]
    states = np.nan_to_num(np.abs(twin.x)) / units.of_states
    states = np.maximum.accumulate(states.max(axis=1, initial=0.0))[:, None]
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
