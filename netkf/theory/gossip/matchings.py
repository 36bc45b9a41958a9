"""Matchings in the mean and walks that detect: what G asks of a network before it promises."""

from __future__ import annotations

from collections import deque

import networkx
import numpy as np

from netkf.core.errors import ScenarioError, TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.network.matchings import Matching, RecordedSlots
from netkf.scenario.scenario import Scenario

LONGEST_WALK = 40
MAX_PLACES = 20_000


def mean_matching(scenario: Scenario) -> FloatArray:
    """(N, N) exact Abar of the scenario's matching, G section II: entry (i, j) is the probability
    that i and j are paired in a slot, the diagonal that of staying alone.

    For recorded matchings, their frequencies in the slots of the scenario from 1 on. Raises
    TheoryError where there is no matching or no exact mean.
    """
    activation, topology = scenario.network.activation, scenario.topology
    if isinstance(activation, Matching):
        try:
            return activation.mean(topology)
        except ScenarioError as error:
            raise TheoryError(str(error)) from None
    if isinstance(activation, RecordedSlots) and activation.matching:
        return _recorded_mean(scenario, activation)
    raise TheoryError("the scenario has no matching")


def effective_matching(scenario: Scenario) -> FloatArray:
    """(N, N) mean of the swaps that happen: Abar with the losses of the channel.

    Raises TheoryError where slots are not independent of each other, where swaps can become copies,
    or where messages may be late.
    """
    activation, channel = scenario.network.activation, scenario.network.channel
    if not isinstance(activation, Matching):
        raise TheoryError("the matching is recorded, not drawn")
    loss, delay = channel.loss, channel.delay.fixed
    if not loss.independent:
        raise TheoryError("losses come in bursts or recorded")
    if delay is None or delay > scenario.phase_length:
        raise TheoryError("messages may be late")
    mean, index = mean_matching(scenario), scenario.topology.index
    for i, j in scenario.topology.links:
        forth, back = (
            loss.mean_delivery(d, scenario.table_probability(d)) for d in ((i, j), (j, i))
        )
        if forth != back or not (channel.symmetric or forth == 1.0):
            raise TheoryError("a swap may become a copy")
        a, b = index[i], index[j]
        mean[a, b] = mean[b, a] = forth * mean[a, b]
    mean[np.diag_indices(len(mean))] = 0.0
    mean[np.diag_indices(len(mean))] = 1.0 - mean.sum(axis=1)
    return mean


def _recorded_mean(scenario: Scenario, activation: RecordedSlots) -> FloatArray:
    period, index = scenario.slot_plant.period, scenario.topology.index
    slots = range(1, max(2, int(np.ceil(scenario.horizon / period - 1e-9))))
    mean = np.zeros((len(index), len(index)))
    for slot in slots:
        for i, j in activation.pairs(slot, 0):
            mean[index[i], index[j]] += 1.0 / len(slots)
            mean[index[j], index[i]] += 1.0 / len(slots)
    mean[np.diag_indices(len(mean))] = 1.0 - mean.sum(axis=1)
    return mean


def primitive(matrix: FloatArray) -> tuple[bool, bool, int]:
    """Whether a nonnegative matrix is irreducible, whether it is aperiodic too, and its period.

    Decided on the graph of its positive entries, not on powers: the period is the greatest common
    divisor of the lengths of its cycles.
    """
    graph = networkx.from_numpy_array((matrix > 1e-15).astype(int), create_using=networkx.DiGraph)
    if not networkx.is_strongly_connected(graph):
        return False, False, 0
    levels = networkx.single_source_shortest_path_length(graph, 0)
    period = 0
    for i, j in graph.edges:
        period = int(np.gcd(period, levels[i] + 1 - levels[j]))
    return True, period == 1, period


def detecting_walk(scenario: Scenario) -> list[int] | None:
    """Nodes (n_0, ..., n_l) of a walk on the graph of Abar whose Gramian ``sum_k (F^k)' C' C F^k``,
    C of node n_k, is invertible (G assumption D.1, weak detectability), or None.

    The shortest one, up to 40 steps. It need not visit all nodes. D.1 is an observability
    condition: sufficient, not necessary (a stable mode that nobody sees does no harm).
    """
    mean, nodes = mean_matching(scenario), scenario.nodes
    F, _ = scenario.slot_belief
    n = len(F)
    rows = [scenario.observation(node)[0] for node in scenario.nodes]
    neighbours = [np.flatnonzero(mean[i] > 1e-15).tolist() for i in range(len(nodes))]
    size = max(float(np.linalg.norm(F, 2)), 1e-300)
    step = F / size  # a positive factor a step changes no rank
    start = np.zeros((0, n))
    queue = deque((i, _space(start, rows[i]), [nodes[i]], step) for i in range(len(nodes)))
    seen: set[tuple[int, int, bytes]] = set()
    while queue:
        place, space, walk, power = queue.popleft()
        if len(space) == n:
            return walk
        key = (place, len(walk), np.round(space.T @ space, 8).tobytes())
        if key in seen or len(seen) > MAX_PLACES or len(walk) > LONGEST_WALK:
            continue
        seen.add(key)
        for following in neighbours[place]:
            wider = _space(space, rows[following] @ power)
            queue.append((following, wider, [*walk, nodes[following]], power @ step))
    return None


def _space(known: FloatArray, rows: FloatArray) -> FloatArray:
    """Orthonormal basis (rows) of what known and new rows span."""
    size = np.abs(rows).max(initial=0.0)
    if size == 0.0:
        return known
    _, values, vectors = np.linalg.svd(np.concatenate([known, rows / size]))
    return np.asarray(vectors[: int((values > 1e-9).sum())])
