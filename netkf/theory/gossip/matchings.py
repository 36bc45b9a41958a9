"""Mean matchings and detecting walks, the two conditions of G on a network."""

from __future__ import annotations

from collections import deque

import numpy as np

from netkf.core.errors import ScenarioError, TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.network.matchings import Matching, RecordedSlots
from netkf.scenario.scenario import Scenario
from netkf.theory.common.random_links import delivery_of

MAX_WALK = 40  # steps of a walk
MAX_VISITED = 20_000  # states of the search for a walk


def mean_matching(scenario: Scenario) -> FloatArray:
    """Return the exact mean Abar (N, N) of the scenario's matching, G section II.

    Entry (i, j) is the probability that i and j are paired in a slot, entry (i, i) that i stays
    alone. For recorded matchings, the frequencies in the slots of the scenario from 1 on. Raises
    TheoryError if there is no matching or no exact mean.
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
    """Return Abar (N, N) with losses; TheoryError for dependent slots, copies and late messages."""
    activation, channel = scenario.network.activation, scenario.network.channel
    if not isinstance(activation, Matching):
        raise TheoryError("the matching is recorded, not drawn")
    delay = channel.delay.fixed
    if not channel.independent:
        raise TheoryError("losses come in bursts or recorded")
    if delay is None or delay > scenario.phase_length:
        raise TheoryError("messages may be late")
    # The losses must not depend on the matching: then probabilities multiply.
    mean, index = mean_matching(scenario), scenario.topology.index
    for i, j in scenario.topology.links:
        forth, back = (delivery_of(scenario, d) for d in ((i, j), (j, i)))
        if forth != back or not (channel.symmetric or forth == 1.0):
            raise TheoryError("a swap may become a copy")
        a, b = index[i], index[j]
        mean[a, b] = mean[b, a] = forth * mean[a, b]
    # A lost swap leaves both nodes alone, so that the diagonal takes the missing probability.
    mean[np.diag_indices(len(mean))] = 0.0
    mean[np.diag_indices(len(mean))] = 1.0 - mean.sum(axis=1)
    return mean


def mean_swaps(scenario: Scenario) -> FloatArray:
    """Return Abar (N, N) with the losses if these are known, else of the matching alone."""
    try:
        return effective_matching(scenario)
    except TheoryError:
        return mean_matching(scenario)


def _recorded_mean(scenario: Scenario, activation: RecordedSlots) -> FloatArray:
    """Return the mean (N, N) of the recorded exchange matrices, each row of which sums to 1."""
    period, index = scenario.slot_plant.period, scenario.topology.index
    # Slot 0 holds the start: the first exchange is in slot 1.
    slots = range(1, max(2, int(np.ceil(scenario.horizon / period - 1e-9))))
    mean = np.zeros((len(index), len(index)))
    for slot in slots:
        for i, j in activation.pairs(slot, 0):
            mean[index[i], index[j]] += 1.0 / len(slots)
            mean[index[j], index[i]] += 1.0 / len(slots)
    mean[np.diag_indices(len(mean))] = 1.0 - mean.sum(axis=1)
    return mean


def period_of(matrix: FloatArray) -> int:
    """Return the period of a nonnegative ``matrix``, 1 if it is aperiodic; 0 if it is reducible."""
    import networkx

    graph = networkx.from_numpy_array((matrix > 1e-15).astype(int), create_using=networkx.DiGraph)
    if not networkx.is_strongly_connected(graph):
        return 0
    # With d(i) the distance of i from node 0, the length of a cycle is the sum of
    # d(i) + 1 - d(j) over its edges (i, j): the gcd of these terms is the period.
    levels = networkx.single_source_shortest_path_length(graph, 0)
    period = 0
    for i, j in graph.edges:
        period = int(np.gcd(period, levels[i] + 1 - levels[j]))
    return period


def detecting_walk(scenario: Scenario) -> list[int] | None:
    """Return the nodes (n_0, ..., n_l) of the shortest detecting walk of up to 40 steps, or None.

    It is a walk on the graph of Abar with an invertible Gramian ``sum_k (F^k)' C' C F^k``, C of
    node n_k (G assumption D.1, weak detectability). It need not visit all nodes. D.1 is sufficient,
    not necessary: a stable mode need not be observed. Abar is that of the swaps that succeed: where
    all messages of a link are lost no walk uses it, and where some are, nodes may stay alone.
    """
    mean, nodes = mean_swaps(scenario), scenario.nodes
    F, _ = scenario.slot_belief
    n = len(F)
    rows = [scenario.observation_matrices(node)[0] for node in scenario.nodes]
    neighbours = [np.flatnonzero(mean[i] > 1e-15).tolist() for i in range(len(nodes))]
    size = max(float(np.linalg.norm(F, 2)), 1e-300)
    step = F / size  # a positive factor changes no rank and avoids overflow of the powers
    start = np.zeros((0, n))
    # Breadth first over (node, subspace observed so far), so that the first walk found is shortest.
    queue = deque((i, _extend_basis(start, rows[i]), [nodes[i]], step) for i in range(len(nodes)))
    visited: set[tuple[int, int, bytes]] = set()
    while queue:
        index, space, walk, power = queue.popleft()
        if len(space) == n:
            return walk
        key = (index, len(walk), np.round(space.T @ space, 8).tobytes())
        if key in visited or len(visited) > MAX_VISITED or len(walk) > MAX_WALK:
            continue
        visited.add(key)
        for following in neighbours[index]:
            wider = _extend_basis(space, rows[following] @ power)
            queue.append((following, wider, [*walk, nodes[following]], power @ step))
    return None


def _extend_basis(basis: FloatArray, rows: FloatArray) -> FloatArray:
    size = np.abs(rows).max(initial=0.0)
    if size == 0.0:
        return basis
    # Scaled rows, so that the threshold for the rank does not depend on units.
    _, values, vectors = np.linalg.svd(np.concatenate([basis, rows / size]))
    return np.asarray(vectors[: int((values > 1e-9).sum())])
