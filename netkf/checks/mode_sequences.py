"""Switched Riccati recursions: which readings updated a covariance in each slot of a run.

A mode is a set of readings that can update a covariance in one slot. The covariance of a gossip
filter is updated by the nodes that its pair (estimate, covariance) visits, that of an intermittent
filter by the readings that arrive. Both are sequences of modes, which
:func:`netkf.algorithms.kernels.chains.move_roots` applies to a start covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.chains import ReadingModes, move_roots, reading_modes
from netkf.checks.evidence import Finding
from netkf.checks.points import MAX_NODES, check_slots, sampled_nodes
from netkf.linalg.arrays import FloatArray, block_diagonal, square_root
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

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
        """Return the roots (K, n, n) of K covariances after the modes ``sequences`` (K, T), one
        mode for each of T slots, from ``roots`` (K, n, n) on.
        """
        return move_roots(roots, sequences, self.F, self.root_Q, self.modes)

    def covariances(
        self, roots: FloatArray, sequences: np.ndarray, lengths: list[int]
    ) -> FloatArray:
        """Return the covariances (L, K, n, n) of K filters after each of L increasing numbers of
        slots, ``lengths``, from the roots of their start covariances, ``roots`` (K, n, n).

        A row of ``sequences`` (K, T) has the index of the mode (set of readings) that updates one
        filter in each slot.
        """
        results, applied = [], 0
        for length in lengths:
            # From the last length on: the roots are those after ``applied`` slots.
            roots, applied = self.apply(roots, sequences[:, applied:length]), length
            results.append(roots @ np.swapaxes(roots, -1, -2))
        return np.array(results)


def reference_count(scenario: Scenario, laws: int) -> int:
    """Return the number of simulated covariances by which each of ``laws`` probability
    distributions is represented when those of the runs are compared with it: fewer for more
    distributions, larger plants and networks.
    """
    step = (3 * scenario.plant.n) ** 3  # operations for one update of one covariance
    budget = MAX_OPERATIONS if len(scenario.nodes) <= MAX_NODES else 0.1 * MAX_OPERATIONS
    affordable = budget / (laws * check_slots(scenario)[-1] * step)
    return int(np.clip(affordable, MIN_CHAINS, MAX_CHAINS))


@lru_cache(maxsize=1)
def kept_reference(samples: type[Any], scenario: Scenario, seed: int) -> Any:
    """Return the simulated covariances that those of the runs are compared with; cached, so that
    all looks at runs of one seed share them.

    ``samples`` is a subclass of RunSamples, whose ``draw_reference`` needs no runs (None).
    """
    return samples(scenario, None, seed).draw_reference()


def with_horizon(
    samples: Any, finding: Finding, distance: Callable[[Any], float], tolerance: float
) -> Finding:
    """Return a finding that the limit of a law is not reached, with the horizon in seconds added at
    which it would be; nan if that cannot be computed in a few seconds.

    ``samples.later(slots)`` simulates a few covariances for a number of slots; ``distance`` is a
    function of its result and returns how far their law is from its limit, which is to become half
    of ``tolerance``.
    """
    scenario = samples.scenario
    slots = slots_until(
        lambda count: distance(samples.later(count)),
        check_slots(scenario)[-1],
        scenario.plant.n,
        tolerance,
    )
    return finding._replace(horizon=slots * scenario.slot_plant.period)


def slots_until(distance: Callable[[int], float], slots: int, n: int, tolerance: float) -> float:
    """Return a number of slots after which ``distance``, a function of such a number, is at most
    half of ``tolerance``.

    The number is doubled from ``slots`` on. Each call of ``distance`` simulates about MIN_CHAINS /
    4 covariances (n, n) for so many slots; nan if that would take too long.
    """
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
    """Return the index (slots, N) of the node whose pair (estimate, covariance) each of the N nodes
    used in each of the first ``slots`` slots, from the swaps in the log of a run of a gossip
    filter; a node that swapped with nobody used its own.
    """
    index = scenario.topology.index  # index of each node id
    sources = np.tile(np.arange(len(index)), (slots, 1))
    swaps = run.log[run.log["kind"] == CODES["swap"]]
    slot = scenario.slot_plant.slots_of(swaps["t"])
    in_time = slot < slots
    nodes, peers = (np.array([index[k] for k in swaps[name].tolist()]) for name in ("node", "peer"))
    if in_time.any():
        sources[slot[in_time], nodes[in_time]] = peers[in_time]
    return sources


def trace_tokens(sources: np.ndarray, slot: int) -> TokenHistory:
    """Return the history of the pairs (estimate, covariance) that the N nodes of a gossip filter
    hold at the start of a ``slot``: the node where each started (N,), and the node that held it in
    each slot before (N, slot).

    ``sources`` (slots, N) is the index of the node whose pair each node used in each slot, from
    :func:`pair_sources`.
    """
    path = np.empty((sources.shape[1], slot), dtype=int)
    # Backwards in time: the node that held, in slot t, the pair that node k holds at the end.
    holder = np.arange(sources.shape[1])
    for t in range(slot - 1, -1, -1):
        path[:, t] = holder  # swaps come first: the reading of slot t is that of the new holder
        holder = sources[t, holder]
    return TokenHistory(holder, path)


def token_positions(sources: np.ndarray, slot: int) -> np.ndarray | None:
    """Return the index (N,) of the node where each token took its last reading, in slot - 1: token
    n is the pair (estimate, covariance) that started at node n, p_n(slot - 1) of paper G (13).

    ``sources`` (slots, N) is the index of the node whose pair each node used in each slot. None if
    pairs were copied, so that the tokens at the nodes are no permutation of those at the start.
    """
    origin = trace_tokens(sources, slot).origin
    if len(set(origin.tolist())) < len(origin):
        return None
    positions = np.empty_like(origin)
    positions[origin] = np.arange(len(origin))
    return positions


def gossip_modes(scenario: Scenario) -> ModeTable:
    """Return the table of the readings that can update a covariance of a gossip filter in one slot:
    mode k is the reading of the k-th node, paper G (11).
    """
    F, Q = scenario.slot_belief
    readings = [(model.H, model.R) for model in scenario.slot_models]
    return ModeTable(F, square_root(Q), reading_modes(readings, len(F)))


class Arrivals(NamedTuple):
    """The readings that W sampled nodes used in each slot.

    ``sequences`` (W, slots) are indices of modes; mode m is the readings of the nodes ``sets[m]``.
    """

    table: ModeTable
    sequences: np.ndarray
    sets: list[tuple[int, ...]]


def sensing_neighbours(scenario: Scenario) -> dict[int, tuple[int, ...]]:
    """Return the nodes with sensors that each node may hear, in order."""
    sensing, topology = set(scenario.sensing_nodes), scenario.topology
    return {
        node: tuple(k for k in topology.senders(node) if k in sensing) for node in topology.nodes
    }


def intermittent_modes(scenario: Scenario, sets: list[tuple[int, ...]]) -> ModeTable:
    """Return the table of the sets of readings that can update a covariance in one slot under
    intermittent observations: mode m is all readings of the nodes (ids) ``sets[m]``, with their
    stacked H (p, n) and block diagonal noise covariance (p, p), equation 17 of that paper.
    """
    F, Q = scenario.slot_belief
    index = scenario.topology.index
    readings = []
    for nodes in sets:
        models = [scenario.slot_models[index[node]] for node in nodes]
        H = np.concatenate([np.empty((0, len(F))), *(model.H for model in models)])
        readings.append((H, block_diagonal([model.R for model in models])))
    return ModeTable(F, square_root(Q), reading_modes(readings, len(F)))


def find_arrivals(scenario: Scenario, run: Run, slots: int) -> Arrivals:
    """Return the readings that W sampled nodes used in the first ``slots`` slots of a run: in each
    slot a node's own and those that the trace says were delivered to it. Each set of readings that
    occurs is one mode, and ``sequences`` (W, slots) has the index of the mode of each node and
    slot.
    """
    delivered = run.log[run.log["kind"] == CODES["deliver"]]
    # A reading belongs to the slot in which it was sent, not to that of its arrival.
    slot = scenario.slot_plant.slots_of(delivered["t"] - np.nan_to_num(delivered["age"]))
    arrived: dict[tuple[int, int], list[int]] = {}
    columns = (slot.tolist(), delivered["node"].tolist(), delivered["peer"].tolist())
    for t, node, peer in zip(*columns, strict=True):
        arrived.setdefault((node, t), []).append(peer)
    modes: dict[tuple[int, ...], int] = {}
    sampled = sampled_nodes(scenario)
    sequences = np.empty((len(sampled), slots), dtype=int)
    for k, node in enumerate(sampled):
        own_reading = (node,) if node in scenario.placed_sensors else ()
        for t in range(slots):
            nodes = tuple(sorted((*own_reading, *arrived.get((node, t), ()))))
            sequences[k, t] = modes.setdefault(nodes, len(modes))
    return Arrivals(intermittent_modes(scenario, list(modes)), sequences, list(modes))


def all_arrivals(scenario: Scenario, slots: int) -> Arrivals:
    """Return the readings that W sampled nodes would use in each of ``slots`` slots if none were
    lost, which gives the smallest covariances. Each set of readings is one mode, and ``sequences``
    (W, slots) has the index of the mode of each node and slot.
    """
    neighbours = sensing_neighbours(scenario)
    modes: dict[tuple[int, ...], int] = {}
    sampled = sampled_nodes(scenario)
    sequences = np.empty((len(sampled), slots), dtype=int)
    for k, node in enumerate(sampled):
        own_reading = (node,) if node in scenario.placed_sensors else ()
        nodes = tuple(sorted((*own_reading, *neighbours[node])))
        sequences[k] = modes.setdefault(nodes, len(modes))
    return Arrivals(intermittent_modes(scenario, list(modes)), sequences, list(modes))
