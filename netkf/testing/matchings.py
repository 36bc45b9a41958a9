"""Check that a matching draws what it states."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.network.graphs import Link, Topology
from netkf.network.matchings import Broadcast, Matching, RecordedSlots, SlotActivation
from netkf.rng.streams import Streams
from netkf.testing.noise import divergence, largest_deviation, log_level
from netkf.testing.topologies import edge_transitive, small_networks
from netkf.testing.watching import Watched, demand, demand_array, fail, make_part, user_code

# Frequencies then have an error of half a percent; repeats need few slots.
SLOTS, SHORT, LAGS = 20_000, 200, 3


def check_matching(matching: Any, /, topology: Topology | None = None, **settings: Any) -> None:
    """Check a slot activation, or a class with its ``settings``, on a cycle of 6 nodes, a star of
    5, a complete graph of 4, a grid of 2 x 3 (those that its ``check`` accepts), or ``topology``.

    Exactly: pairs are links (i, j) of the network with i < j, no node is in two of them; ``mean``
    is symmetric, not negative, has rows that sum to 1 and is zero where there is no link; equal
    generators give equal matchings, and no other generator is used; another generator gives others
    if ``mean`` says that they vary; nothing is remembered in the object; it survives pickle.

    In 20,000 slots of each network, with probability 0.9 for every link: a pair frequency p that
    differs from ``mean`` by 7.7 sqrt(p (1 - p) / 20,000) (.021 at p = 1 / 6), a mean number of
    pairs that is off by 0.05 of its standard deviation; where ``mean`` is
    not known, one that differs from that of the other links of a cycle, star or complete graph by
    as much; a correlation of 0.07 of any two links 1, 2 or 3 slots apart. A class whose ``mean``
    itself gives equal links different values is believed. Recorded matchings are looked at for
    their form; broadcasts have nothing to draw. A sound class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(matching, (SlotActivation,), settings)
    check_made_matching(part, topology, 0)


def check_made_matching(part: Any, topology: Topology | None, seed: int) -> None:
    """Run ``check_matching`` on an object, with streams of the given seed."""
    watched = Watched(part)
    copy = watched.pickle_copy()
    networks = small_networks() if topology is None else (topology,)
    fitting = [network for network in networks if _accepts_graph(part, network, watched.name)]
    if isinstance(part, RecordedSlots):
        _check_recorded(part, watched.name)
        return
    demand(fitting, f"{watched.name}.check", "must accept one of the networks", "none accepted")
    if isinstance(part, Broadcast):
        return
    drawn = isinstance(part, Matching)
    text = "netkf.parts.Matching and define draw and mean"
    rule = "must be derived from Matching, RecordedSlots or Broadcast"
    demand(drawn, watched.name, rule, None, f"derive it from {text}")
    before = watched.attributes()
    for network in fitting:
        with user_code(f"{watched.name}.draw"):
            _check_network(watched, copy, network, seed)
    watched.demand_unchanged(before)


def _accepts_graph(part: Any, topology: Topology, name: str) -> bool:
    """Return True if the matching accepts this graph."""
    with user_code(f"{name}.check"):
        try:
            part.check(topology)
        except ScenarioError:
            return False
    return True


def _check_recorded(part: RecordedSlots, name: str) -> None:
    """Check that no node is in two pairs of one slot of a table of matchings."""
    if part.matching:
        for slot, phase, step in part.recorded:
            _demand_matching(f"{name}.pairs", part.pairs(slot, phase, step), slot)


def _check_network(watched: Watched, copy: Any, topology: Topology, seed: int) -> None:
    """Check the draws on one graph: form, frequencies, independence of slots."""
    part, where = watched.part, f"{watched.name}.draw"
    first = watched.call("draw", topology, _make_random(seed, 0), repeatable=False)
    demand(isinstance(first, list), where, "must return a list of pairs", first)
    drawn = _draw_matchings(part, topology, where, _make_random(seed, 0), SLOTS)
    for text, other in (("at the second call", part), ("of a pickled object", copy)):
        again = _draw_matchings(other, topology, where, _make_random(seed, 0), SHORT)
        rule = "must draw the same from equal generators"
        differs = np.flatnonzero((again != drawn[:SHORT]).any(axis=1))
        got = f"other pairs in slot {differs[0]} {text}" if differs.size else None
        demand(not differs.size, where, rule, got, "use only the generator given")
    mean = _stated_mean(watched, topology)
    _check_frequencies(watched, topology, drawn, mean)
    _check_slots_independent(where, topology, drawn)
    if drawn.any(axis=0).any() and (drawn[0] != drawn).any():
        other = _draw_matchings(part, topology, where, _make_random(seed, 1), SLOTS // 10)
        same = np.array_equal(other, drawn[: len(other)])
        rule = "must draw from the generator given"
        demand(not same, where, rule, "the same pairs from two different generators")


def _make_random(seed: int, run: int) -> np.random.Generator:
    """Return the random generator of a run."""
    return Streams(seed, run).generator("matching")


def _draw_matchings(
    part: Any, topology: Topology, where: str, random: np.random.Generator, slots: int
) -> np.ndarray:
    """Return which links (slots, L) are in the matching of each slot."""
    index = {link: k for k, link in enumerate(topology.links)}
    found = np.zeros((slots, len(index)), dtype=bool)
    # Most matchings are drawn many times, and each is looked at once.
    seen: dict[tuple[tuple[int, ...], ...], list[int]] = {}
    for slot in range(slots):
        pairs = part.draw(topology, random)
        key = tuple(map(tuple, pairs))
        if key not in seen:
            _demand_matching(where, pairs, slot)
            for pair in pairs:
                known = tuple(pair) in index
                demand(known, where, "must pair the ends of links (i, j) with i < j", list(pair))
            seen[key] = [index[pair] for pair in key]
        for k in seen[key]:
            found[slot, k] = True
    return found


def _demand_matching(where: str, pairs: list[Link], slot: int) -> None:
    """Check that no node is in two pairs."""
    nodes = [node for pair in pairs for node in pair]
    if len(set(nodes)) < len(nodes):
        fail(where, "must have every node in one pair at most", f"{list(pairs)} in slot {slot}")


def _stated_mean(watched: Watched, topology: Topology) -> FloatArray | None:
    """Return the probabilities (L,) of the links by ``mean``, None where it is not known."""
    where, size = f"{watched.name}.mean", len(topology.nodes)
    try:
        mean = watched.part.mean(topology)
    except ScenarioError:
        return None  # too many links
    mean = demand_array(where, "it", mean, (size, size))
    demand((mean >= -1e-12).all(), where, "must not be negative", float(mean.min()))
    demand(np.allclose(mean, mean.T, atol=1e-9), where, "must be symmetric")
    sums = mean.sum(axis=1)
    worst = float(sums[np.abs(sums - 1.0).argmax()])
    demand(abs(worst - 1.0) <= 1e-9, where, "rows must sum to 1", f"{worst:.6g}")
    ends = np.array([[topology.index[node] for node in link] for link in topology.links])
    rest = mean.copy()
    rest[ends[:, 0], ends[:, 1]] = rest[ends[:, 1], ends[:, 0]] = 0.0
    np.fill_diagonal(rest, 0.0)
    demand(not rest.any(), where, "must be 0 for pairs that are no link", float(rest.max()))
    return np.asarray(mean[ends[:, 0], ends[:, 1]])


def _check_frequencies(
    watched: Watched, topology: Topology, drawn: np.ndarray, mean: FloatArray | None
) -> None:
    """Check how often links are paired, against the stated mean if there is one."""
    found, slots = drawn.mean(axis=0), len(drawn)
    if mean is None:
        if not edge_transitive(topology):
            return
        mean = np.full(len(found), found.mean())
        rule = "must not prefer one of equal links"
    else:
        rule = "must pair links as often as mean says"
        count = largest_deviation(drawn.sum(axis=1)[:, None] - mean.sum())
        if count is not None:
            text = f"{count.mean + mean.sum():.4g} (+- {count.error:.2g}) pairs a slot"
            fail(f"{watched.name}.draw", rule, f"{text} instead of {mean.sum():.4g}")
    unlikely = slots * divergence(found, mean) > log_level(len(found))
    if unlikely.any():
        k = int(np.argmax(unlikely * np.abs(found - mean)))
        text = f"{found[k]:.4g} for link {list(topology.links[k])} in {slots:,} slots"
        graph = f"on {len(topology.nodes)} nodes and {len(topology.links)} links"
        fail(f"{watched.name}.draw", rule, f"{text} instead of {mean[k]:.4g}, {graph}")


def _check_slots_independent(where: str, topology: Topology, drawn: np.ndarray) -> None:
    """Check that matchings of different slots are independent."""
    p, slots = drawn.mean(axis=0), len(drawn)
    expected = p[:, None] * p
    for lag in range(1, LAGS + 1):
        both = drawn[:-lag].T.astype(float) @ drawn[lag:] / (slots - lag)
        unlikely = (slots - lag) * divergence(both, expected) > log_level(both.size)
        if not unlikely.any():
            continue
        index = np.unravel_index(int(np.argmax(unlikely * np.abs(both - expected))), both.shape)
        one, other = (list(topology.links[k]) for k in index)
        text = f"link {one} and then {other} in {both[index]:.4g} of slots"
        rule = f"matchings of slots that are {lag} apart must be independent"
        remedy = "remember nothing, and draw from the generator given"
        fail(where, rule, f"{text} instead of {expected[index]:.4g}", remedy)
