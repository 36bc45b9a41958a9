"""Random Riccati recursions as words: which reading was used in which slot, along one run.

A covariance of a gossip filter has passed through the nodes that its pair visited, one of an
intermittent filter through the sets of readings that arrived. Both are words over an alphabet of
Riccati operators; :func:`netkf.algorithms.kernels.chains.advance` carries them out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.algorithms.kernels.chains import Letters, advance, alphabet
from netkf.linalg.arrays import FloatArray, IntArray, block_diagonal, square_root
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

MOST, FEWEST, BUDGET = 20_000, 4_000, 1e10
MAX_NODES, MIN_WATCHED, MAX_WATCHED, MAX_ENTRIES = 60, 20, 50, 6400


class Book(NamedTuple):
    """``F``, ``root_Q`` (n, n) and the letters of a scenario's filters."""

    F: FloatArray
    root_Q: FloatArray
    letters: Letters

    def read(self, roots: FloatArray, words: np.ndarray) -> FloatArray:
        """Roots after words, one a row."""
        return advance(roots, words, self.F, self.root_Q, self.letters)

    def along(self, roots: FloatArray, words: np.ndarray, lengths: list[int]) -> FloatArray:
        """(L, K, n, n) covariances after the first so many letters of each word, increasing."""
        found, done = [], 0
        for length in lengths:
            roots, done = self.read(roots, words[:, done:length]), length
            found.append(roots @ np.swapaxes(roots, -1, -2))
        return np.array(found)


def look_at(scenario: Scenario) -> tuple[int, ...]:
    """Slots to look at: small ones, half of the horizon and its end; a filtered estimate at the
    horizon itself has seen exchanges that are not in the trace.
    """
    period = scenario.slot_plant.period
    last = max(1, int(np.floor(scenario.horizon / period + 1e-9)))
    if scenario.slotted and not scenario.hosted.predicts:
        last = max(1, int(np.ceil(scenario.horizon / period - 1e-9)) - 1)
    return tuple(sorted({min(2, last), min(5, last), max(1, last // 2), last}))


def watched_places(scenario: Scenario) -> IntArray:
    """(W,) places of the nodes whose samples are kept: all nodes of a small network, and in one of
    more than MAX_NODES evenly chosen ones, fewer where covariances are large.
    """
    nodes, n = len(scenario.nodes), scenario.plant.n
    if nodes <= MAX_NODES:
        return np.arange(nodes)
    count = int(np.clip(MAX_ENTRIES // n**2, MIN_WATCHED, MAX_WATCHED))
    return np.round(np.linspace(0, nodes - 1, count)).astype(np.int64)


def watched_nodes(scenario: Scenario) -> list[int]:
    """Ids of the nodes at ``watched_places``."""
    return [scenario.nodes[k] for k in watched_places(scenario).tolist()]


def watched_note(scenario: Scenario) -> str:
    """What is left out of a large network, in words; empty if nothing is."""
    count, nodes = len(watched_places(scenario)), len(scenario.nodes)
    if count == nodes:
        return ""
    return (
        f"looked at {count} of {nodes:,} nodes, evenly chosen: samples of all are kept in networks "
        f"of at most {MAX_NODES} nodes"
    )


def reference_size(scenario: Scenario, laws: int) -> int:
    """Number of chains that stand for a law: fewer where a step costs more."""
    step = (3 * scenario.plant.n) ** 3
    budget = BUDGET if len(scenario.nodes) <= MAX_NODES else 0.1 * BUDGET
    return int(np.clip(budget / (laws * look_at(scenario)[-1] * step), FEWEST, MOST))


def start_roots(scenario: Scenario) -> FloatArray:
    """(N, n, n) roots of P(0) of the nodes."""
    return np.array([square_root(scenario.start(node)[1]) for node in scenario.nodes])


class Lineage(NamedTuple):
    """Where the pair that a node holds at the start of a slot has been.

    ``origin`` (N,): index of the node where it started; ``path`` (N, slot): indices of the nodes
    whose readings it took, in order. ``came`` (slot, N): who handed each node its pair in each slot
    (itself where nobody did).
    """

    origin: np.ndarray
    path: np.ndarray


def handed_over(scenario: Scenario, run: Run, slots: int) -> np.ndarray:
    """(slots, N): index of the node whose pair each node used in each slot, from the swaps."""
    index = scenario.topology.index
    came = np.tile(np.arange(len(index)), (slots, 1))
    swaps = run.log[run.log["kind"] == CODES["swap"]]
    slot = scenario.slot_plant.slots_of(swaps["t"])
    kept = slot < slots
    nodes, peers = (np.array([index[k] for k in swaps[name].tolist()]) for name in ("node", "peer"))
    if kept.any():
        came[slot[kept], nodes[kept]] = peers[kept]
    return came


def lineage(came: np.ndarray, slot: int) -> Lineage:
    """Of the pairs that the nodes hold at the start of a slot."""
    nodes = np.arange(came.shape[1])
    path, place = np.empty((came.shape[1], slot), dtype=int), nodes
    for t in range(slot - 1, -1, -1):
        path[:, t] = place  # the reading of slot t was taken where the pair was after the swap
        place = came[t, place]
    return Lineage(place, path)


def token_places(came: np.ndarray, slot: int) -> np.ndarray | None:
    """(N,) p_n(slot - 1), where token n took its last reading, G (13); None where pairs were copied
    and tokens are no permutation.
    """
    origin = lineage(came, slot).origin
    if len(set(origin.tolist())) < len(origin):
        return None
    places = np.empty_like(origin)
    places[origin] = np.arange(len(origin))
    return places


def gossip_book(scenario: Scenario) -> Book:
    """Letter k is the reading of node k."""
    F, Q = scenario.slot_belief
    readings = [(model.H, model.R) for model in scenario.slot_models]
    return Book(F, square_root(Q), alphabet(readings, len(F)))


class Arrivals(NamedTuple):
    """Which readings each watched node used: ``words`` (W, slots) of letters of ``book``."""

    book: Book
    words: np.ndarray
    sets: list[tuple[int, ...]]


def peers_of(scenario: Scenario) -> dict[int, tuple[int, ...]]:
    """For each node, the neighbours that have readings to send."""
    sensing, near = set(scenario.sensing), dict[int, list[int]]()
    for i, j in scenario.topology.links:
        for sender, receiver in ((i, j), (j, i)):
            if sender in sensing:
                near.setdefault(receiver, []).append(sender)
    return {node: tuple(sorted(near.get(node, ()))) for node in scenario.nodes}


def intermittent_book(scenario: Scenario, sets: list[tuple[int, ...]]) -> Book:
    """Letter m is all readings of the m-th set of nodes together."""
    F, Q = scenario.slot_belief
    index = scenario.topology.index
    readings = []
    for nodes in sets:
        models = [scenario.slot_models[index[node]] for node in nodes]
        H = np.concatenate([np.empty((0, len(F))), *(model.H for model in models)])
        readings.append((H, block_diagonal([model.R for model in models])))
    return Book(F, square_root(Q), alphabet(readings, len(F)))


def arrivals(scenario: Scenario, run: Run, slots: int) -> Arrivals:
    """The readings that were used along a run, from the deliveries in its trace."""
    got = run.log[run.log["kind"] == CODES["deliver"]]
    slot = scenario.slot_plant.slots_of(got["t"] - np.nan_to_num(got["age"]))
    used: dict[tuple[int, int], list[int]] = {}
    for t, node, peer in zip(
        slot.tolist(), got["node"].tolist(), got["peer"].tolist(), strict=True
    ):
        used.setdefault((node, t), []).append(peer)
    sets: dict[tuple[int, ...], int] = {}
    watched = watched_nodes(scenario)
    words = np.empty((len(watched), slots), dtype=int)
    for k, node in enumerate(watched):
        own = (node,) if node in scenario.placed else ()
        for t in range(slots):
            nodes = tuple(sorted((*own, *used.get((node, t), ()))))
            words[k, t] = sets.setdefault(nodes, len(sets))
    return Arrivals(intermittent_book(scenario, list(sets)), words, list(sets))


def everything(scenario: Scenario, slots: int) -> Arrivals:
    """As if every reading had arrived."""
    peers = peers_of(scenario)
    sets: dict[tuple[int, ...], int] = {}
    watched = watched_nodes(scenario)
    words = np.empty((len(watched), slots), dtype=int)
    for k, node in enumerate(watched):
        own = (node,) if node in scenario.placed else ()
        words[k] = sets.setdefault(tuple(sorted((*own, *peers[node]))), len(sets))
    return Arrivals(intermittent_book(scenario, list(sets)), words, list(sets))
