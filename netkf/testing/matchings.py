"""``check_matching``: checks of the draws of a matching against what the class states."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.laws.losses import PairCounts, compare_coincidences, compare_matchings
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Cycle, Edges, Grid, Link, Star, Topology
from netkf.network.matchings import Broadcast, Matching, RecordedSlots, SlotActivation
from netkf.rng.streams import Streams
from netkf.testing.noise import demand_agreement, family_level
from netkf.testing.watching import (
    OTHER_GENERATOR,
    WatchedPart,
    checker,
    demand,
    demand_array,
    demand_kind,
    fail,
    guard_user_code,
    make_part,
)

# With 20,000 slots the error of frequencies is half a percent; repeatability needs fewer slots.
SLOTS, REPEATED_SLOTS, RUN, MAX_LAG = 20_000, 200, 50, 3  # RUN: slots that count as one run


@checker
def check_matching(matching: Any, /, topology: Topology | None = None, **settings: Any) -> None:
    """Check a slot activation, or a class with its ``settings``.

    It is checked on a cycle of 6 nodes, a star of 5, a complete graph of 4 and a grid of 2 x 3, as
    far as its ``check`` accepts them, or on ``topology``.

    Exact checks: pairs are links (i, j) of the network with i < j, and no node is in two of them;
    ``mean`` is symmetric, not negative, has rows that sum to 1 and is zero where there is no link;
    equal generators give equal matchings, and no other generator is used; another generator gives
    other matchings if they vary; nothing is stored in the object, which survives pickle.

    Statistical checks find these errors with probability 0.9, for every link, from 20,000 slots of
    each network: a pair frequency p that differs from ``mean`` by 7.7 sqrt(p (1 - p) / 20,000)
    (0.021 at p = 1 / 6); a mean number of pairs that is off by 0.05 of its standard deviation;
    if ``mean`` raises ScenarioError, a frequency that differs as much from those of the other links
    of a cycle, star or complete graph; a correlation of 0.07 of any two links 1, 2 or 3 slots
    apart. A ``mean`` that differs between equivalent links is accepted. Of recorded matchings only
    the form is checked, and broadcasts draw nothing. A correct class fails once in a million
    checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(matching, (SlotActivation,), settings)
    demand_kind("topology", topology, Topology)
    _check_matching(part, topology, 0)


def _check_matching(part: Any, topology: Topology | None, seed: int) -> None:
    watched = WatchedPart(part)
    copy = watched.pickle_copy()
    ids = (1, 4, 5, 9)
    graphs = (
        Cycle(nodes=6),
        Star(nodes=5),
        Edges(edges=tuple(combinations(ids, 2))),
        Grid(rows=2, columns=3),
    )
    networks = [graph.build(seed=0) for graph in graphs] if topology is None else [topology]
    accepted = [network for network in networks if _accepts_graph(part, network, watched.name)]
    if isinstance(part, RecordedSlots):
        for slot, phase, step in part.recorded if part.matching else ():
            _demand_matching(f"{watched.name}.pairs", part.pairs(slot, phase, step), slot)
        return
    demand(accepted, f"{watched.name}.check", "must accept one of the networks", "none accepted")
    if isinstance(part, Broadcast):
        return
    rule = "must be derived from Matching, RecordedSlots or Broadcast"
    remedy = "derive it from netkf.parts.Matching and define draw and mean"
    demand(isinstance(part, Matching), watched.name, rule, remedy=remedy)
    for network in accepted:
        with watched.guard("draw"):
            _check_network(watched, copy, network, seed)


def _accepts_graph(part: Any, topology: Topology, name: str) -> bool:
    with guard_user_code(f"{name}.check"):
        try:
            part.check(topology)
        except ScenarioError:
            return False
    return True


def _check_network(watched: WatchedPart, copy: Any, topology: Topology, seed: int) -> None:
    part, where = watched.part, f"{watched.name}.draw"
    first = watched.call("draw", topology, _make_generator(seed, 0), repeatable=False)
    demand(isinstance(first, list), where, "must return a list of pairs", first)
    is_paired = _draw_matchings(part, topology, where, _make_generator(seed, 0), SLOTS)
    for text, drawer in (("at the second call", part), ("of a pickled object", copy)):
        generator = _make_generator(seed, 0)
        repeated = _draw_matchings(drawer, topology, where, generator, REPEATED_SLOTS)
        for slot in np.flatnonzero((repeated != is_paired[:REPEATED_SLOTS]).any(axis=1))[:1]:
            rule, got = "must draw the same from equal generators", f"other pairs in slot {slot}"
            fail(where, rule, f"{got} {text}", "use only the generator given")
    mean = _stated_mean(watched, topology)
    _check_frequencies(watched, topology, is_paired, mean)
    if is_paired.any(axis=0).any() and (is_paired[0] != is_paired).any():
        others = _draw_matchings(part, topology, where, _make_generator(seed, 1), SLOTS // 10)
        is_same, got = np.array_equal(others, is_paired[: len(others)]), "equal pairs from two"
        demand(not is_same, where, OTHER_GENERATOR, f"{got} generators")


def _make_generator(seed: int, run: int) -> np.random.Generator:
    return Streams(seed, run).generator("matching")


def _draw_matchings(
    part: Any, topology: Topology, where: str, random: np.random.Generator, slots: int
) -> np.ndarray:
    """Draw the matchings of ``slots`` slots and return a mask (slots, L) of the paired links."""
    index = {link: k for k, link in enumerate(topology.links)}
    is_paired = np.zeros((slots, len(index)), dtype=bool)
    # Indices of the links of each matching: most are drawn many times, and checked once.
    checked: dict[tuple[tuple[int, ...], ...], list[int]] = {}
    for slot in range(slots):
        pairs = part.draw(topology, random)
        key = tuple(map(tuple, pairs))
        if key not in checked:
            _demand_matching(where, pairs, slot)
            for pair in pairs:
                is_link = tuple(pair) in index
                demand(is_link, where, "must pair the ends of links (i, j) with i < j", list(pair))
            checked[key] = [index[pair] for pair in key]
        is_paired[slot, checked[key]] = True
    return is_paired


def _demand_matching(where: str, pairs: list[Link], slot: int) -> None:
    nodes = [node for pair in pairs for node in pair]
    if len(set(nodes)) < len(nodes):
        fail(where, "must have every node in one pair at most", f"{list(pairs)} in slot {slot}")


def _stated_mean(watched: WatchedPart, topology: Topology) -> FloatArray | None:
    """Return the probabilities (L,) that ``mean`` of the class states for the links."""
    where, size = f"{watched.name}.mean", len(topology.nodes)
    try:
        mean = watched.part.mean(topology)
    except ScenarioError:
        return None  # such as for too many links
    mean = demand_array(where, "it", mean, (size, size))
    demand((mean >= -1e-12).all(), where, "must not be negative", float(mean.min()))
    demand(np.allclose(mean, mean.T, atol=1e-9), where, "must be symmetric")
    sums = mean.sum(axis=1)
    worst = float(sums[np.abs(sums - 1.0).argmax()])
    demand(abs(worst - 1.0) <= 1e-9, where, "rows must sum to 1", f"{worst:.6g}")
    (i, j), without_links = topology.ends.T, mean.copy()
    without_links[i, j] = without_links[j, i] = 0.0
    np.fill_diagonal(without_links, 0.0)
    largest = float(without_links.max())
    demand(not without_links.any(), where, "must be 0 for pairs that are no link", largest)
    return np.asarray(mean[i, j])


def _check_frequencies(
    watched: WatchedPart, topology: Topology, is_paired: np.ndarray, mean: FloatArray | None
) -> None:
    where, links, runs = f"{watched.name}.draw", topology.links, len(is_paired) // RUN
    graph = f"on {len(topology.nodes)} nodes and {len(links)} links"
    rule = "must pair links as often as mean says"
    if mean is None and _is_edge_transitive(topology):
        mean, rule = np.full(len(links), is_paired.mean()), "must not prefer one of equal links"
    slots = is_paired[: runs * RUN].reshape(runs, RUN, -1)
    if mean is not None:
        again = (slots[:, 1:] & slots[:, :-1]).sum(axis=1)
        counts = PairCounts(slots.sum(axis=1), again, np.full(runs, float(RUN)))
        found = compare_matchings(mean, counts, links, family_level())
        demand_agreement(found._replace(text=f"{graph}, {found.text}"), where, rule)
    labels, lags = [f"link {list(link)}" for link in links], range(1, MAX_LAG + 1)
    comparison = compare_coincidences(is_paired[None], lags, labels, family_level())
    remedy = "remember nothing, and draw from the generator given"
    demand_agreement(comparison, where, "matchings of slots must be independent", remedy)


def _is_edge_transitive(topology: Topology) -> bool:
    """Return True for cycles, complete graphs and stars, whose links are equal by symmetry."""
    count, degrees = len(topology.nodes), sorted(topology.degrees.values())
    if len(topology.components) > 1 or count < 2:
        return False
    is_cycle = degrees == [2] * count
    is_complete = len(topology.links) == count * (count - 1) // 2
    is_star = degrees == [*[1] * (count - 1), count - 1]
    return is_cycle or is_complete or is_star
