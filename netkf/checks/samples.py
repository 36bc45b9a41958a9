"""Samples of many runs at the times and nodes where promises are checked, and shared tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.evidence import (
    Assumption,
    Finding,
    allowed_deviation,
    compare_identities,
    find_unknown,
    largest_terms,
)
from netkf.checks.laws import Pair, compare_growth, compare_laws
from netkf.linalg.arrays import ArrayLike, FloatArray, IntArray, in_units, row_units
from netkf.scenario.records import nodes_with_law
from netkf.scenario.scenario import Scenario

HORIZON_SHARES = (0.125, 0.25, 0.5, 1.0)
"""Times, as shares of the horizon, at which promises are checked in continuous time."""
POOLED_ERRORS, MAX_POOLED = 192, 24
"""Largest number of errors (nodes times states times sample times) of a run that are whitened
together, and largest number of sample times. Many times of one run tell as much about a covariance
as many runs.
"""
MAX_NODES = 60
"""Largest network of which the samples of all nodes are kept."""
MIN_SAMPLED, MAX_SAMPLED = 20, 50
"""Number of nodes that are sampled in a larger network."""
MAX_ENTRIES = 6400
"""Entries of the covariances that are kept of one sample of a larger network."""


def check_slots(scenario: Scenario) -> tuple[int, ...]:
    """Return the slots at which promises are checked: 2, 5, half of the horizon, its last one."""
    period = scenario.slot_plant.period
    # 1e-9: a horizon of a whole number of periods keeps its last slot despite rounding.
    last = max(1, int(np.floor(scenario.horizon / period + 1e-9)))
    if scenario.slotted and not scenario.node_filter.timing.predicts:
        last = max(1, int(np.ceil(scenario.horizon / period - 1e-9)) - 1)
    return tuple(sorted({min(2, last), min(5, last), max(1, last // 2), last}))


def check_times(scenario: Scenario) -> list[float]:
    """Return the times (s) at which promises are checked: of slots, or shares of the horizon."""
    if scenario.slotted:
        return [scenario.slot_plant.slot_time(slot) for slot in check_slots(scenario)]
    return [scenario.time_grid.instant(scenario.horizon * share) for share in HORIZON_SHARES]


def errors_at_once(scenario: Scenario) -> int:
    """Return the number of scalar errors of all filters at one time."""
    pooled = scenario.filter.algorithm.timing.pooled and scenario.views is None
    return (1 if pooled else len(scenario.nodes)) * scenario.width


def probe_times(scenario: Scenario) -> list[float]:
    """Return the times (s) at which runs are sampled: :func:`check_times`, and further ones for
    tests that pool errors of all times (POOLED_ERRORS, MAX_POOLED).
    """
    checked = check_times(scenario)
    count = min(MAX_POOLED, POOLED_ERRORS // errors_at_once(scenario))
    even = scenario.time_grid.snap(np.linspace(0.0, checked[-1], max(count, 0) + 1)[1:]).tolist()
    if scenario.slotted:
        plant = scenario.slot_plant
        even = [plant.slot_time(max(1, round(time / plant.period))) for time in even]
    # The further times are thinned evenly: with the checked ones there are ``count``.
    others = sorted(set(even) - set(checked))
    spare = min(max(count - len(checked), 0), len(others))
    chosen = np.linspace(0, len(others) - 1, spare).round().astype(int).tolist()
    return sorted({*checked, *(others[k] for k in chosen)})


def checked_samples(scenario: Scenario, times: FloatArray) -> IntArray:
    """Return the indices (K,) in the sample ``times`` (T,) at which promises are checked."""
    targets = np.array(check_times(scenario))
    return np.asarray(np.argmin(np.abs(times[None] - targets[:, None]), axis=1), dtype=np.int64)


def sampled_indices(scenario: Scenario) -> IntArray:
    """Return the nodes (W,) whose samples are kept: all with a known law, or spaced ones."""
    chosen, n = np.flatnonzero(nodes_with_law(scenario)), scenario.width
    if len(chosen) <= MAX_NODES:
        return chosen
    count = int(np.clip(MAX_ENTRIES // n**2, MIN_SAMPLED, MAX_SAMPLED))
    return chosen[np.round(np.linspace(0, len(chosen) - 1, count)).astype(np.int64)]


def sampled_nodes(scenario: Scenario) -> list[int]:
    """Return the ids of the nodes whose samples are kept."""
    return [scenario.nodes[k] for k in sampled_indices(scenario).tolist()]


def sampling_note(scenario: Scenario) -> str:
    """Return a text on the nodes of a large network whose samples are not kept; or empty."""
    count, nodes = len(sampled_indices(scenario)), len(scenario.nodes)
    if count == nodes:
        return ""
    return (
        f"looked at {count} of {nodes:,} nodes, evenly chosen: samples of all are kept in networks "
        f"of at most {MAX_NODES} nodes"
    )


def all_sampled(scenario: Scenario) -> Assumption:
    """Return the assumption that samples of all nodes are kept, as promises about all need."""
    note = sampling_note(scenario)
    evidence = note or "samples of all nodes are kept"
    return Assumption("every node is watched", "netkf", not note, evidence)


class CovarianceUnits(NamedTuple):
    """Units in which the largest variance of each state is 1, so that a covariance that is wrong in
    a small state is not lost beside a large one.

    of_states : (n,), of the states of the plant
    of_nodes  : (N, n'), of the states that each node of the network estimates, 1 beyond these
    """

    of_states: FloatArray
    of_nodes: FloatArray


def covariance_units(scenario: Scenario, nodes: IntArray, P: FloatArray) -> CovarianceUnits:
    """Return the units of states whose covariances at ``nodes`` (W,) were P (..., W, n', n')."""
    variances = np.diagonal(P, axis1=-2, axis2=-1)
    variances = np.where(np.isfinite(variances), variances, 0.0)
    variances = variances.reshape(-1, *variances.shape[-2:]).max(axis=0, initial=0.0)
    largest, of_nodes = np.zeros(scenario.plant.n), np.ones((len(scenario.nodes), scenario.width))
    for k, row in zip(nodes.tolist(), variances, strict=True):
        own = largest[scenario.view(k)]
        largest[scenario.view(k)] = np.maximum(own, row[: len(own)])
    of_states = row_units(largest)
    for k in range(len(of_nodes)):
        own = of_states[scenario.view(k)]
        of_nodes[k, : len(own)] = own
    return CovarianceUnits(of_states, of_nodes)


def first_covariances(scenario: Scenario) -> FloatArray:
    """Return P(0) (N, n, n) of all nodes of the network, in their order; 0 beyond their states."""
    P = np.zeros((len(scenario.nodes), scenario.width, scenario.width))
    for k, node in enumerate(scenario.nodes):
        cov = scenario.initial_estimate(node)[1]
        pooled, n = scenario.node_filter.timing.pooled, scenario.sizes[k]
        view = scenario.view(k) if pooled else slice(n)
        P[k, :n, :n] = cov[view][:, view]
    return P


def rounded_terms(scenario: Scenario, P: FloatArray, units: CovarianceUnits) -> FloatArray:
    """Return the sizes (R, K, N), in ``units``, of terms whose roundings remain in ``P``, which is
    in ``units`` too.
    """
    # Without blocks all nodes estimate the same states, with the information of all sensors.
    infos = scenario.node_infos[: 1 if scenario.views is None else None]
    informations = [
        in_units(info.information, 1.0 / units.of_states[scenario.view(k)])
        for k, info in enumerate(infos)
    ]
    first = in_units(first_covariances(scenario), units.of_nodes)
    return largest_terms(P, first, max(float(np.linalg.norm(G, 2)) for G in informations))


REPLAY_TOLERANCE = 1e-7  # of P, relative: two ways to compute it differ by roundings only


class ReplicaSummary(SimpleNamespace):
    """The statistics of one run at K times and N sampled nodes.

    P, e       : (K, N, n, n), (K, N, n) covariances, and errors: nan where rounding blurs them
    nees       : (K, N) normalised estimation error squared, e' P^-1 e
    replayed   : (K, N, n, n) P by the equations of the filter, from the events of the run
    mean, Sigma : (K, N, n), (K, N, n, n) mean and covariance of the errors given the events
    whole      : (K, 2) squared norm of the errors of all nodes, whitened by their joint covariance
                 given the events, and its degrees of freedom
    joint      : (2,) the same for the errors of all sample times, also those between the K ones
    quadratic  : (1 + S,) the sum of the NEES of all nodes and sample times, and its S weights: it
                 is, given the events, a sum of squares of standard normal numbers times these
    bias       : (n, n + 1) information matrix of a constant bias of all errors, and the information
                 vector (that matrix times the estimate of the bias)

    Fields after ``nees`` are nan for a run that is not replayed. Papers add fields of their own.
    """


def stack_summaries(summaries: Sequence[ReplicaSummary]) -> ReplicaSummary:
    """Return one summary whose fields have a first axis over the replicas."""
    names = vars(summaries[0])
    return ReplicaSummary(**{name: np.array([vars(s)[name] for s in summaries]) for name in names})


@dataclass(frozen=True)
class RunSamples:
    """The stacked summaries ``runs`` of many replicas of a scenario; tests take one of these."""

    scenario: Scenario
    runs: Any
    seed: int = 0

    @property
    def count(self) -> int:
        """Number of runs R."""
        return len(self.runs.P)

    @property
    def nodes(self) -> list[int]:
        """Ids of the N sampled nodes."""
        return sampled_nodes(self.scenario)

    @cached_property
    def units(self) -> CovarianceUnits:
        """The units in which covariances are compared."""
        return covariance_units(self.scenario, sampled_indices(self.scenario), self.runs.P)

    def in_units(self, P: FloatArray) -> FloatArray:
        """Return covariances P (..., N, n, n) of the sampled nodes in ``units``."""
        return in_units(P, self.units.of_nodes[sampled_indices(self.scenario)])

    @property
    def first_trace(self) -> float:
        """The largest trace of P(0), in ``units``."""
        first = in_units(first_covariances(self.scenario), self.units.of_nodes)
        return float(np.trace(first, axis1=-2, axis2=-1).max())

    def largest_terms(self, P: FloatArray) -> FloatArray:
        """Return the sizes (R, K, N), in ``units``, of terms whose roundings remain in ``P``."""
        return rounded_terms(self.scenario, self.in_units(P), self.units)

    def compare_laws(self, pairs: Sequence[Pair], level: float) -> Finding:
        """Test in ``units`` that pairs of covariances of all states have one law each."""
        units = self.units.of_states
        scaled = [
            pair._replace(
                first=in_units(pair.first, units),
                second=in_units(pair.second, units),
                expected=None if pair.expected is None else in_units(pair.expected, units),
            )
            for pair in pairs
        ]
        return compare_laws(scaled, level, self.first_trace)

    @property
    def time_labels(self) -> list[str]:
        """Labels of the K times."""
        if self.scenario.slotted:
            return [f"slot {slot}" for slot in check_slots(self.scenario)]
        return [f"{t:g} s" for t in check_times(self.scenario)]

    @property
    def point_labels(self) -> list[str]:
        """Labels of the K N points (time, node), time by time."""
        return [f"{t}, node {node}" for t in self.time_labels for node in self.nodes]

    @property
    def blurred_note(self) -> str:
        """Text on the times at which rounding blurs some errors, or empty."""
        lost = np.isnan(self.runs.e).any(axis=(0, 2, 3))
        times = ", ".join(t for t, is_lost in zip(self.time_labels, lost, strict=True) if is_lost)
        return f"; errors that rounding blurs are left out ({times})" if times else ""


def check_replay(samples: RunSamples, level: float) -> Finding:
    """Compare P of the runs with ``runs.replayed``, by the equations; unknown ones are left out."""
    replayed = np.isfinite(samples.runs.replayed).any(axis=(1, 2, 3, 4))
    P, expected = samples.runs.P[replayed], samples.runs.replayed[replayed]
    if not len(P):
        return find_unknown("no run could be replayed")
    unknown = ~np.isfinite(expected).all(axis=(-1, -2), keepdims=True)
    P, replay = np.where(unknown, 0.0, P), np.where(unknown, 0.0, expected)
    P, expected = samples.in_units(P), samples.in_units(replay)
    with np.errstate(invalid="ignore"):
        gap = np.abs(P - expected).max(axis=(-1, -2))
    differences = relative_difference(P, expected).max(axis=(-1, -2))
    run, time, node = np.unravel_index(int(np.argmax(differences)), differences.shape)
    label = samples.point_labels[int(time) * len(samples.nodes) + int(node)]
    message = (
        f"{gap.size:,} covariances replayed from the events of their runs; the worst in run "
        f"{np.flatnonzero(replayed)[run]} at {label}"
    )
    limits = np.abs(expected).max(axis=(-1, -2)), samples.largest_terms(replay), REPLAY_TOLERANCE
    return compare_points(samples, gap, limits, message, replicas=np.flatnonzero(replayed))


def compare_points(
    samples: RunSamples,
    gap: FloatArray,
    limits: tuple[FloatArray, ArrayLike, float],
    message: str,
    replicas: IntArray | None = None,
) -> Finding:
    """Return the finding on covariances that should equal others up to rounding, with the first
    run, time and node that depart: absolute deviations ``gap`` (R, K', N) at the last K' times,
    ``limits`` of :func:`allowed_deviation`, and ``replicas`` (R,), the numbers of the runs.
    """
    finding = compare_identities(gap, *limits, message)
    wrong = ~(gap <= allowed_deviation(*limits))
    if not wrong.any():
        return finding
    # argwhere is in row-major order: the earliest time of all runs, and there the first run, node.
    time, run, node = np.argwhere(np.swapaxes(wrong, 0, 1))[0].tolist()
    replica = run if replicas is None else int(replicas[run])
    time += len(samples.time_labels) - wrong.shape[1]  # among all checked times
    label = samples.point_labels[time * len(samples.nodes) + node]
    text = f"{finding.message}; first seen to depart in run {replica} at {label}"
    return finding._replace(message=text, replica=replica)


def relative_difference(P: FloatArray, expected: FloatArray) -> FloatArray:
    """Return |P - expected| over the largest entry of each matrix (..., n, n); inf for nan."""
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.abs(P - expected)
        relative = np.where(gap == 0.0, 0.0, gap / size)
        return np.asarray(np.nan_to_num(relative, nan=np.inf))


def check_growth(samples: RunSamples, level: float) -> Finding:
    """Test that P does not grow more in the second half than its replay (``compare_growth``)."""
    P, replayed = samples.runs.P, samples.runs.replayed
    # Only some runs are replayed, the entries of the others are nan.
    replays = replayed[~np.isnan(replayed).all(axis=(1, 2, 3, 4))]
    pairs, expected = [], []
    # The last two checked times are half of the horizon and its end.
    for i, node in enumerate(samples.nodes):
        pairs.append(Pair(f"node {node}", P[:, -2, i], P[:, -1, i]))
        expected.append((replays[:, -2, i], replays[:, -1, i]) if len(replays) else None)
    return compare_growth(pairs, expected, level)
