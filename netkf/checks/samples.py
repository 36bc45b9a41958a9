"""What was seen of many runs, and tests that several papers share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from netkf.checks.evidence import Finding, identity, left_out, rounded_away
from netkf.checks.laws import NEES, Pair, chi_squared, not_growing
from netkf.checks.mode_sequences import look_at, watched_nodes
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario

ROUNDING = 1e-7


def times(scenario: Scenario) -> list[float]:
    """Where promises look, in seconds: the slots of ``look_at``, or an eighth, a quarter, half and
    all of the horizon.
    """
    if scenario.slotted:
        return [round(scenario.slot_plant.period * slot, 12) for slot in look_at(scenario)]
    return [scenario.horizon * share for share in (0.125, 0.25, 0.5, 1.0)]


@dataclass(frozen=True)
class Seen:
    """Witnesses of many runs: each field of ``runs`` is stacked, replicas first."""

    scenario: Scenario
    runs: Any
    seed: int = 0

    @property
    def count(self) -> int:
        """Number of runs."""
        return len(self.runs.P)

    @property
    def nodes(self) -> list[int]:
        """Ids of the W nodes whose samples were kept."""
        return watched_nodes(self.scenario)

    @property
    def moments(self) -> list[str]:
        """Words for each of the K times."""
        if self.scenario.slotted:
            return [f"slot {slot}" for slot in look_at(self.scenario)]
        return [f"{t:g} s" for t in times(self.scenario)]

    @property
    def places(self) -> list[str]:
        """Words for each of the (K, N) places, time by time."""
        return [f"{t}, node {node}" for t in self.moments for node in self.nodes]


def replay(seen: Seen, level: float) -> Finding:
    """Every covariance is what the equations make of its run's events; runs whose equations were
    not carried out are nan in ``replayed``.
    """
    kept = ~np.isnan(seen.runs.replayed).all(axis=(1, 2, 3, 4))
    P, expected = seen.runs.P[kept], seen.runs.replayed[kept]
    apart = relative(P, expected).max(axis=(-1, -2))
    run, time, node = np.unravel_index(int(np.argmax(apart)), apart.shape)
    place = seen.places[int(time) * len(seen.nodes) + int(node)]
    words = (
        f"{apart.size:,} covariances replayed from the events of their runs; the worst in run "
        f"{np.flatnonzero(kept)[run]} at {place}"
    )
    return identity(float(apart.max()), ROUNDING, words)


def relative(P: FloatArray, expected: FloatArray) -> FloatArray:
    """Differences over the largest entry of each expected matrix; what is not finite differs."""
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.nan_to_num(np.abs(P - expected) / size, nan=np.inf))


def bounded(seen: Seen, level: float) -> Finding:
    """The end against half of the time."""
    P = seen.runs.P
    nodes = enumerate(seen.nodes)
    return not_growing([Pair(f"node {node}", P[:, -2, i], P[:, -1, i]) for i, node in nodes], level)


def nees_is_chi_squared(seen: Seen, level: float) -> Finding:
    """Given the exchanges, errors are Gaussian with covariance P at every node and time."""
    n, nees = seen.scenario.plant.n, seen.runs.nees.reshape(seen.count, -1)
    if np.isnan(seen.runs.e).all():
        return rounded_away(NEES)
    found = chi_squared(nees / n, [n * len(nees)] * nees.shape[1], seen.places, level, "NEES")
    return found._replace(words=found.words + left_out(seen))
