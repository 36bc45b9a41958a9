"""Switched Riccati recursions: which readings updated a covariance in each slot of a run.

A mode is a set of readings that can update a covariance in one slot. The covariance of a gossip
filter is updated by the nodes that its pair (estimate, covariance) visits, that of an intermittent
filter by the readings that arrive. Both are sequences of modes, which
:func:`netkf.algorithms.kernels.chains.move_roots` applies to a start covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.chains import ReadingModes, move_roots, reading_modes
from netkf.checks.evidence import Finding
from netkf.checks.laws import (
    LAW_TOLERANCE,
    Pair,
    compare_growth,
    diagonal_distances,
    growth_intervals,
)
from netkf.checks.samples import MAX_NODES, RunSamples, check_slots, sampled_nodes
from netkf.linalg.arrays import FloatArray, block_diagonal, row_units, square_root
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import rows_of

MAX_CHAINS, MIN_CHAINS = 20_000, 4_000
"""Limits on the number of simulated chains of a reference sample."""
MAX_OPERATIONS = 1e10
"""Floating-point operations that a reference sample may take, about a few seconds."""
FAR_START = 30.0
"""Factor on the roots of P(0) in a second start, whose covariance is about 1000 times larger."""


class ModeTable(NamedTuple):
    """The plant of a scenario's filters, ``F`` and ``root_Q`` (n, n) with Q = root_Q root_Q', and
    their modes: sets of readings that can update a covariance in one slot. Covariances P are
    represented by roots S (n, n) with P = S S'.
    """

    F: FloatArray
    root_Q: FloatArray
    modes: ReadingModes

    def apply(self, roots: FloatArray, sequences: np.ndarray) -> FloatArray:
        """Return the roots (K, n, n) from ``roots`` after the modes ``sequences`` (K, T)."""
        return move_roots(roots, sequences, self.F, self.root_Q, self.modes)

    def covariances(
        self, roots: FloatArray, sequences: np.ndarray, lengths: list[int]
    ) -> FloatArray:
        """Return covariances (L, K, n, n) of K filters after each of ``lengths`` slots, from
        ``roots`` by the modes ``sequences`` (K, T).
        """
        results, applied = [], 0
        for length in lengths:
            # From the last length on: the roots are those after ``applied`` slots.
            roots, applied = self.apply(roots, sequences[:, applied:length]), length
            results.append(roots @ np.swapaxes(roots, -1, -2))
        return np.array(results)


def reference_count(scenario: Scenario, laws: int) -> int:
    """Return the number of covariances by which each of ``laws`` laws is represented."""
    step = (3 * scenario.plant.n) ** 3  # operations for one update of one covariance
    budget = MAX_OPERATIONS if len(scenario.nodes) <= MAX_NODES else 0.1 * MAX_OPERATIONS
    affordable = budget / (laws * check_slots(scenario)[-1] * step)
    return int(np.clip(affordable, MIN_CHAINS, MAX_CHAINS))


class Reference(NamedTuple):
    """S simulated covariances of L laws, whose laws those of the runs should have: one for each
    sampled node, or that of a chain of which each sampled node has the draws at it.

    P         : (L, K, S, n, n) covariances at K numbers of slots
    restarted : (L, S, n, n) covariances at the last one from a start about 1000 times larger
    averages  : (L, S') averages of 1 / (1 + tr P) over the slots, of the first S'
    at_node   : (K, S) index of the node at which a chain had its last reading, or None
    first     : (S,) index of the node at which it began
    """

    P: FloatArray
    restarted: FloatArray
    averages: FloatArray = np.empty(0)
    at_node: np.ndarray | None = None
    first: np.ndarray = np.empty(0, dtype=int)

    def at(self, k: int, i: int) -> FloatArray:
        """Return the covariances (S, n, n) at the k-th number of slots and the i-th node."""
        return self._of_node(self.P[:, k], k, i)

    def _of_node(self, values: FloatArray, k: int, i: int) -> FloatArray:
        return np.asarray(values[i] if self.at_node is None else values[0, self.at_node[k] == i])

    def growth(self) -> float:
        """Return the largest growth of the law of P between the last two numbers of slots."""
        return max(growth_of(P[-2], P[-1]) for P in self.P)

    def memory(self) -> float:
        """Return the largest distance at the end of the laws from P(0) and a far larger start."""
        pairs = zip(self.P, self.restarted, strict=True)
        return max(float(diagonal_distances(P[-1], restarted).max()) for P, restarted in pairs)


@dataclass(frozen=True)
class SwitchedReference(RunSamples):
    """Adds simulated covariances to compare P of runs with; derived classes draw them."""

    @property
    def reference(self) -> Reference:
        """Covariances for all looks at the runs of a seed."""
        cls: Any = type(self)
        return _cached_reference(cls, self.scenario, self.seed)

    def draw_reference(self) -> Reference:
        """Return the covariances at the checked slots; it needs no runs."""
        raise NotImplementedError

    def later(self, slots: int) -> Reference:
        """Return a few covariances after half of ``slots`` and after all of them."""
        raise NotImplementedError

    def with_horizon(self, finding: Finding, distance: Callable[[Reference], float]) -> Finding:
        """Return a finding whose limit is not reached with the horizon (s) at which it would be;
        ``distance`` tells how far the law of a reference is from its limit.
        """
        if not finding.early:
            return finding
        slots = slots_until(
            lambda count: distance(self.later(count)),
            check_slots(self.scenario)[-1],
            self.scenario.plant.n,
            LAW_TOLERANCE,
        )
        return finding._replace(horizon=slots * self.scenario.slot_plant.period)


@lru_cache(maxsize=1)
def _cached_reference(samples: type[SwitchedReference], scenario: Scenario, seed: int) -> Reference:
    return samples(scenario, None, seed).draw_reference()


def check_law(samples: SwitchedReference, level: float) -> Finding:
    """Compare the law of P at each node and slot with that of the reference there."""
    pairs = [
        Pair(f"slot {slot}, node {node}", samples.runs.P[:, k, i], samples.reference.at(k, i))
        for k, slot in enumerate(check_slots(samples.scenario))
        for i, node in enumerate(samples.nodes)
    ]
    return samples.compare_laws(pairs, level)


def check_bounded(samples: SwitchedReference, level: float) -> Finding:
    """Test that P stays stochastically bounded."""
    P, last = samples.runs.P, len(check_slots(samples.scenario)) - 1
    nodes = list(enumerate(samples.nodes))
    pairs = [Pair(f"node {node}", P[:, -2, i], P[:, -1, i]) for i, node in nodes]
    expected = [[samples.reference.at(k, i) for k in (last - 1, last)] for i, _ in nodes]
    finding = compare_growth(pairs, [(half, end) for half, end in expected], level)
    return samples.with_horizon(finding, lambda reference: reference.growth())


def check_start(samples: SwitchedReference, level: float) -> Finding:
    """Compare the law of P at the end with that from a far larger start."""
    reference, last = samples.reference, len(check_slots(samples.scenario)) - 1
    pairs = [
        Pair(
            f"node {node}",
            samples.runs.P[:, -1, i],
            reference._of_node(reference.restarted, -1, i),
            reference.at(last, i),
        )
        for i, node in enumerate(samples.nodes)
    ]
    finding = samples.compare_laws(pairs, level)
    return samples.with_horizon(finding, lambda reference: reference.memory())


def growth_of(earlier: FloatArray, later: FloatArray) -> float:
    """Return the largest growth of an entry between two samples of covariances (S, n, n)."""
    # Only the value of each interval is used, for which the level does not matter.
    return max(interval.value for interval in growth_intervals(earlier, later, level=0.5))


def far_roots(roots: FloatArray) -> FloatArray:
    """Return roots (..., n, n) of starts far larger than ``roots``, even where P(0) = 0."""
    units = row_units(np.square(roots).sum(axis=-1))
    return np.asarray(FAR_START * roots + np.eye(units.shape[-1]) * units[..., None])


def slots_until(distance: Callable[[int], float], slots: int, n: int, tolerance: float) -> float:
    """Return slots with ``distance`` at most ``tolerance`` / 2, doubled; nan if it takes long."""
    operations, count = 0.0, slots
    while True:
        count *= 2
        # About (3 n)^3 operations for each covariance and slot.
        operations += 0.25 * MIN_CHAINS * count * (3 * n) ** 3
        if operations > 0.1 * MAX_OPERATIONS:
            return math.nan
        if distance(count) <= 0.5 * tolerance:
            return float(count)


def initial_roots(scenario: Scenario) -> FloatArray:
    """Return the roots (N, n, n) of P(0) of all nodes."""
    return np.array([square_root(scenario.initial_estimate(node)[1]) for node in scenario.nodes])


class TokenHistory(NamedTuple):
    """The history of the pairs (estimate, covariance) that the N nodes hold at the start of a slot.

    origin : (N,) index of the node at which the pair started
    path   : (N, slot) indices of the nodes whose readings updated it in slots 0, 1, ...
    """

    origin: np.ndarray
    path: np.ndarray


def pair_sources(scenario: Scenario, run: Run, slots: int) -> np.ndarray:
    """Return the index (slots, N) of the node whose pair each node used in each slot of gossip."""
    index = scenario.topology.index  # index of each node id
    sources = np.tile(np.arange(len(index)), (slots, 1))
    swaps = rows_of(run.log, "swap")
    slot = scenario.slot_plant.slots_of(swaps["t"])
    in_time = slot < slots
    nodes, peers = (np.array([index[k] for k in swaps[name].tolist()]) for name in ("node", "peer"))
    if in_time.any():
        sources[slot[in_time], nodes[in_time]] = peers[in_time]
    return sources


def trace_tokens(sources: np.ndarray, slot: int) -> TokenHistory:
    """Return where the pairs of the N nodes at the start of a ``slot`` began, and were since."""
    path = np.empty((sources.shape[1], slot), dtype=int)
    # Backwards in time: the node that held, in slot t, the pair that node k holds at the end.
    holder = np.arange(sources.shape[1])
    for t in range(slot - 1, -1, -1):
        path[:, t] = holder  # swaps come first: the reading of slot t is that of the new holder
        holder = sources[t, holder]
    return TokenHistory(holder, path)


def token_positions(sources: np.ndarray, slot: int) -> np.ndarray | None:
    """Return where each token took its last reading (N,), paper G (13); None for copied pairs."""
    origin = trace_tokens(sources, slot).origin
    if len(set(origin.tolist())) < len(origin):
        return None
    positions = np.empty_like(origin)
    positions[origin] = np.arange(len(origin))
    return positions


def gossip_modes(scenario: Scenario) -> ModeTable:
    """Return the table in which mode k is the reading of the k-th node, paper G (11)."""
    F, Q = scenario.slot_belief
    readings = [(model.H, model.R) for model in scenario.slot_models]
    return ModeTable(F, square_root(Q), reading_modes(readings, len(F)))


def sensing_neighbours(scenario: Scenario) -> dict[int, tuple[int, ...]]:
    """Return the nodes with sensors that each node may hear, in order."""
    sensing, topology = set(scenario.sensing_nodes), scenario.topology
    return {i: tuple(k for k in topology.senders(i) if k in sensing) for i in topology.nodes}


def intermittent_modes(scenario: Scenario, sets: list[tuple[int, ...]]) -> ModeTable:
    """Return the table in which mode m is all readings of the nodes ``sets[m]``, R (17)."""
    F, Q = scenario.slot_belief
    index = scenario.topology.index
    readings = []
    for nodes in sets:
        models = [scenario.slot_models[index[node]] for node in nodes]
        H = np.concatenate([np.empty((0, len(F))), *(model.H for model in models)])
        readings.append((H, block_diagonal([model.R for model in models])))
    return ModeTable(F, square_root(Q), reading_modes(readings, len(F)))


def find_arrivals(scenario: Scenario, run: Run | None, slots: int) -> tuple[ModeTable, np.ndarray]:
    """Return the readings that W sampled nodes used in the first ``slots``, all without a run, as
    indices (W, slots) of the modes of a table.
    """
    arrived: dict[tuple[int, int], list[int]] = {}
    if run is not None:
        delivered = rows_of(run.log, "deliver")
        # A reading belongs to the slot in which it was sent, not to that of its arrival.
        slot = scenario.slot_plant.slots_of(delivered["t"] - np.nan_to_num(delivered["age"]))
        columns = (slot.tolist(), delivered["node"].tolist(), delivered["peer"].tolist())
        for t, node, peer in zip(*columns, strict=True):
            arrived.setdefault((node, t), []).append(peer)
    neighbours, modes = sensing_neighbours(scenario), dict[tuple[int, ...], int]()
    sampled = sampled_nodes(scenario)
    sequences = np.empty((len(sampled), slots), dtype=int)
    for k, node in enumerate(sampled):
        own_reading = (node,) if node in scenario.placed_sensors else ()
        for t in range(slots):
            heard = neighbours[node] if run is None else arrived.get((node, t), ())
            sequences[k, t] = modes.setdefault(tuple(sorted((*own_reading, *heard))), len(modes))
    return intermittent_modes(scenario, list(modes)), sequences
