"""Samples of many runs at the times where promises are checked, and tests that papers share."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from netkf.checks.evidence import Finding, find_unknown
from netkf.checks.laws import Pair, compare_growth
from netkf.checks.points import check_slots, check_times, sampled_nodes
from netkf.checks.rounding import allowed_deviation, compare_identities, largest_terms
from netkf.linalg.arrays import ArrayLike, FloatArray, IntArray
from netkf.scenario.scenario import Scenario

REPLAY_TOLERANCE = 1e-7  # of P, relative: two ways to compute it differ by roundings only


@dataclass(frozen=True, eq=False)
class ReplicaSummary:
    """One run reduced to its values at K times and N sampled nodes; nan if it was not replayed.

    P, e       : (K, N, n, n), (K, N, n) covariances and errors, nan if rounding blurs them
    nees       : (K, N) e' P^-1 e
    replayed   : (K, N, n, n) P by the equations of the filter, from the events of the run
    mean, Sigma : (K, N, n), (K, N, n, n) mean and covariance of the errors given the events
    whole      : (K, 2) squared errors of all nodes together, whitened by their covariance given the
                 events, and their degrees of freedom
    joint      : (2,) the same of all times together, also those between the K ones
    quadratic  : (1 + S,) the NEES of all of them together, and its S weights: given the events it
                 is a sum of squares of standard normal numbers with these weights
    bias       : (n, n + 1) information on a constant bias of all errors, and that information times
                 its estimate

    Papers add fields of their own. Summaries of R runs are stacked: every field gets a first axis
    of length R
    """

    P: FloatArray
    e: FloatArray
    nees: FloatArray
    replayed: FloatArray
    mean: FloatArray
    Sigma: FloatArray
    whole: FloatArray
    joint: FloatArray
    quadratic: FloatArray
    bias: FloatArray


Summary = TypeVar("Summary", bound=ReplicaSummary)


def stack_summaries(summaries: Sequence[Summary]) -> Summary:
    """Return one summary whose fields have a first axis over the replicas."""
    names = [field.name for field in dataclasses.fields(summaries[0])]
    columns = {name: np.array([getattr(one, name) for one in summaries]) for name in names}
    return type(summaries[0])(**columns)


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

    @property
    def first_covariances(self) -> FloatArray:
        """P(0) (N', n, n) of all N' nodes of the network."""
        return np.array([self.scenario.start(node)[1] for node in self.scenario.nodes])

    @property
    def first_trace(self) -> float:
        """The largest trace of P(0)."""
        return float(np.trace(self.first_covariances, axis1=-2, axis2=-1).max())

    def largest_terms(self, P: FloatArray) -> FloatArray:
        """Return the sizes (R, K, N) of the largest terms from which covariances P (R, K, N, n, n)
        were computed: their roundings remain in P.
        """
        information = float(np.linalg.norm(self.scenario.node_infos[0].information, 2))
        return largest_terms(P, self.first_covariances, information)

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
        times = ", ".join(t for t, some in zip(self.time_labels, lost, strict=True) if some)
        return f"; errors that rounding blurs are left out ({times})" if times else ""


def check_replay(samples: RunSamples, level: float) -> Finding:
    """Compare every covariance with the one that the equations give for the events of its run."""
    replayed = ~np.isnan(samples.runs.replayed).all(axis=(1, 2, 3, 4))
    P, expected = samples.runs.P[replayed], samples.runs.replayed[replayed]
    if not len(P):
        return find_unknown("no run could be replayed")
    with np.errstate(invalid="ignore"):
        gap = np.abs(P - expected).max(axis=(-1, -2))
        size = np.abs(expected).max(axis=(-1, -2))
    off = relative_difference(P, expected).max(axis=(-1, -2))
    run, time, node = np.unravel_index(int(np.argmax(off)), off.shape)
    label = samples.point_labels[int(time) * len(samples.nodes) + int(node)]
    message = (
        f"{gap.size:,} covariances replayed from the events of their runs; the worst in run "
        f"{np.flatnonzero(replayed)[run]} at {label}"
    )
    limits = size, samples.largest_terms(expected), REPLAY_TOLERANCE
    found = compare_identities(gap, *limits, message)
    return with_departure(found, samples, gap, limits, np.flatnonzero(replayed))


def with_departure(
    finding: Finding,
    samples: RunSamples,
    gap: FloatArray,
    limits: tuple[FloatArray, ArrayLike, float],
    replicas: IntArray | None = None,
) -> Finding:
    """Return the finding on deviations ``gap`` (R, K', N) with the run, time and node at which they
    first exceed what rounding explains; ``limits`` are those of ``allowed_deviation``.

    The K' times are the last ones of those that are looked at, and the R runs are ``replicas``, by
    default the first ones.
    """
    wrong = ~(gap <= allowed_deviation(*limits))
    if not wrong.any():
        return finding
    # The earliest time of all runs, and there the first run and node.
    time, run, node = np.argwhere(np.swapaxes(wrong, 0, 1))[0].tolist()
    replica = run if replicas is None else int(replicas[run])
    time += len(samples.time_labels) - wrong.shape[1]
    label = samples.point_labels[time * len(samples.nodes) + node]
    text = f"{finding.message}; first seen to depart in run {replica} at {label}"
    return finding._replace(message=text, replica=replica)


def relative_difference(P: FloatArray, expected: FloatArray) -> FloatArray:
    """Return |P - expected| over the largest entry of each expected matrix; inf if not finite."""
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.abs(P - expected)
        share = np.where(gap == 0.0, 0.0, gap / size)
        return np.asarray(np.nan_to_num(share, nan=np.inf))


def check_growth(samples: RunSamples, level: float) -> Finding:
    """Compare the growth of the law of P from half of the horizon to its end with that of P by the
    equations, along the events of the same runs.
    """
    P, replayed = samples.runs.P, samples.runs.replayed
    known = replayed[~np.isnan(replayed).all(axis=(1, 2, 3, 4))]
    pairs, expected = [], []
    for i, node in enumerate(samples.nodes):
        pairs.append(Pair(f"node {node}", P[:, -2, i], P[:, -1, i]))
        expected.append((known[:, -2, i], known[:, -1, i]) if len(known) else None)
    return compare_growth(pairs, expected, level)
