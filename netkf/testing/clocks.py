"""``check_clock`` and ``check_matching``: draws against the contract of a class."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from itertools import combinations, zip_longest
from typing import Any

import numpy as np
from scipy.special import ndtri

from netkf.core.clock import ClockPosition, Entity, generate_ticks
from netkf.core.errors import ScenarioError
from netkf.core.laws import EXPONENTIAL, Lattice
from netkf.laws import stack_runs
from netkf.laws.intervals import LawComparison
from netkf.laws.losses import PairCounts, compare_coincidences, compare_matchings
from netkf.laws.noise import compare_correlations
from netkf.laws.stating import stated_law, stating_class
from netkf.laws.ticks import (
    ClockGroup,
    TickCounts,
    compare_clocks,
    compare_gaps,
    count_ticks,
    rates_of_all,
    rates_of_each,
    slack_of_start,
)
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Complete, Cycle, Edges, Grid, Link, Star, Topology
from netkf.network.matchings import Broadcast, Matching, RecordedSlots, SlotActivation
from netkf.rng.streams import Streams
from netkf.testing.noise import demand_agreement, family_level
from netkf.testing.watching import (
    OTHER_GENERATOR,
    RecordingGenerator,
    WatchedPart,
    checker,
    demand,
    demand_array,
    demand_kind,
    demand_vector,
    fail,
    guard_user_code,
    is_number,
    make_part,
)

BLOCKS = ((600,), (1,) * 600, (7, 64, 1, 256, 272))
"""Ways to ask for 600 ticks: the number of ticks in each block."""
CHAINS, LENGTH, GAPS = 800, 100, 75
"""Simulated runs of all entities together, mean number of ticks in a run, and gaps of each run
between which correlations are tested.
"""
MAX_ENTITIES = 12  # links, directions or nodes whose clocks are checked
INTERLEAVED_TICKS = 40
"""Ticks of each entity that are compared alone and with ticks of other entities in between."""


STATE_IT = "define mean_rate and memoryless too if it differs by design"


@checker
def check_clock(clock: Any, /, link: Link | None = None, **settings: Any) -> None:
    """Check a link clock, or a class with its ``settings``.

    It is checked on the links (directions, nodes) of a complete graph of 4 nodes that have a rate,
    at most 12 of them, or on one ``link`` (i, j) only.

    Exact checks: times are finite, above 0 and increasing; they are the same to the last bit in
    blocks of any size and with ticks of other links in between; only the given generator is used,
    and two generators give different times; a clock that stopped stays stopped.

    Statistical checks find these errors with probability 0.9. From 80,000 ticks of all links
    together: of Poisson clocks a rate that differs from ``mean_rate`` by 2.8 %, of others, with
    gaps of a standard deviation of c times their mean, by 2.6 c + 1 % (by more if ``gaps`` is not
    stated and c is above 0.7 or ticks come in groups), and the rate of one of N links that differs
    by sqrt(N) times as much (6 links: 7.5 %); if ``mean_rate`` is nan, a rate of one link that
    differs from the others by as much. A class that states that it is
    ``memoryless``, or its law by ``gaps``, or derives from Renewal or Periodic and states nothing
    of its own, is compared with that law: a sixteenth of it that has 0.007 more or fewer gaps, and
    a correlation of 0.03 of neighbouring ones; of memoryless clocks a correlation of 0.08 of the
    gaps of two links. A correct class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    part = make_part(clock, (LinkClock,), settings)
    demand_kind("link", link, tuple)
    ids = () if link is None else link
    demand(
        all(isinstance(i, (int, np.integer)) for i in ids), "link", "must be a pair of ids", link
    )
    _check_clock(part, link, 0)


def _check_clock(part: Any, link: Link | None, seed: int) -> None:
    watched = WatchedPart(part)
    watched.pickle_copy()
    entities = _all_entities(part) if link is None else (link,)
    _check_entity(watched, entities[0])
    _check_interleaved(watched, entities)
    # Rates and laws need a clock that does not stop.
    if len(_read_ticks(watched, entities[0], BLOCKS[0])) == sum(BLOCKS[0]):
        _check_laws(watched, entities, seed)
    watched.finish()


def _all_entities(part: Any) -> tuple[Entity, ...]:
    """Return the entities of a complete graph of 4 nodes with a rate, or the link (0, 1)."""
    topology = Complete(nodes=4).build(seed=0)
    entities = tuple(part.entities(topology))[:MAX_ENTITIES]
    try:
        part.check(topology)
    except ScenarioError:
        # It names links of another network, or has a rate for some of its links only.
        with_rate = tuple(e for e in entities if not math.isnan(part.mean_rate(e)))
        entities = with_rate or entities[:1]
    return entities or ((0, 1),)


def _check_entity(watched: WatchedPart, entity: Entity) -> None:
    call = partial(watched.call, "origin", entity, repeatable=False)
    origin = watched.repeat("origin", lambda random: call(lambda: random))
    is_finite = is_number(origin) and math.isfinite(origin)
    watched.demand("origin", is_finite, "must be a finite number", origin)
    read = partial(_read_ticks, watched, entity)
    one = watched.repeat("ticks", lambda random: read(BLOCKS[0], random))
    rule, remedy = "must be finite", "return fewer times when the clock stops"
    watched.demand("ticks", np.isfinite(one).all(), rule, "nan or inf", remedy)
    for k in np.flatnonzero(np.diff(one, prepend=0.0) <= 0.0)[:1].tolist():
        gap = one[k] - (one[k - 1] if k else 0.0)
        got = f"tick {k} at {one[k]:g} s, {gap:g} s after the one before"
        watched.demand("ticks", False, "times must be above 0 and increase", got)
    rule = "must not depend on the size of the blocks"
    for blocks in BLOCKS[1:]:
        other = read(blocks)
        differ = one[: len(other)] != other[: len(one)]
        k = int(np.argmax(differ)) if differ.any() else len(differ)
        texts = [f"{t[k]:.17g}" if k < len(t) else "nothing" for t in (one, other)]
        got = f"{texts[0]} as tick {k} of one block and {texts[1]} in blocks of {blocks[0]}, ..."
        remedy = "add gaps up one by one from now, one draw a tick"
        watched.demand("ticks", np.array_equal(one, other), rule, got, remedy)


def _check_interleaved(watched: WatchedPart, entities: tuple[Entity, ...]) -> None:
    with guard_user_code(f"{watched.name}.ticks"):
        iterate = partial(_iterate_ticks, watched.part)
        alone = [list(iterate(entity, k)) for k, entity in enumerate(entities)]
        # The same streams again, with the ticks of all entities drawn in turn.
        turns = zip_longest(*(iterate(entity, k) for k, entity in enumerate(entities)))
        interleaved = [[t for t in ticks if t is not None] for ticks in zip(*turns, strict=True)]
    rule = "ticks of a link must not depend on those of others"
    for entity, one, other in zip(entities, alone, interleaved, strict=False):
        got = f"other times of {list(entity)} when other links tick in between"
        remedy = "use the generator given, and no memory of earlier calls"
        watched.demand("ticks", one == other, rule, got, remedy)


def _iterate_ticks(part: Any, entity: Entity, stream: int) -> Iterator[float]:
    random = RecordingGenerator(11, stream)
    position = ClockPosition(float(part.origin(entity, lambda: RecordingGenerator(12, stream))))
    for number in range(INTERLEAVED_TICKS):
        block = part.ticks(entity, *position, random, 1)
        if not len(block):
            return
        position = position._replace(number=number + 1, now=float(block[0]))
        yield position.now


def _read_ticks(
    watched: WatchedPart,
    entity: Entity,
    blocks: tuple[int, ...],
    random: np.random.Generator | None = None,
) -> FloatArray:
    random = random or RecordingGenerator(5)
    origin = watched.part.origin(entity, lambda: RecordingGenerator(10))
    times, has_stopped = np.empty(0), False
    for count in blocks:
        now = float(times[-1]) if len(times) else 0.0
        place = entity, origin, len(times), now, random, count
        block = watched.call("ticks", *place, repeatable=False)
        block = demand_vector(f"{watched.name}.ticks", block)
        rule = f"must be at most {count} times"
        watched.demand("ticks", len(block) <= count, rule, len(block))
        rule, got = "an empty block means stopped for good", f"{len(block)} more ticks after it"
        watched.demand("ticks", not (has_stopped and len(block)), rule, got)
        has_stopped = not len(block)
        times = np.concatenate([times, block])
    return times


def _check_laws(watched: WatchedPart, entities: tuple[Entity, ...], seed: int) -> None:
    part, runs = watched.part, max(2, CHAINS // len(entities))
    rates = np.array([watched.call("mean_rate", entity) for entity in entities])
    wrong, unknown = rates[rates <= 0.0], np.isnan(rates)
    watched.demand("mean_rate", not wrong.size, "must be above 0, or nan", wrong[:1].tolist())
    with guard_user_code(f"{watched.name}.ticks"):
        if unknown.all():
            horizon = float(_read_ticks(watched, entities[0], (LENGTH,))[-1])
        else:
            horizon = LENGTH / float(np.nanmedian(rates))

        def draw(run: int, k: int, entity: Entity) -> FloatArray:
            streams = Streams(seed, run)
            phase, random = partial(streams.generator, "phase", k), streams.generator("testing", k)
            return generate_ticks(part, entity, phase, random, horizon)

        times = [[draw(run, *item) for item in enumerate(entities)] for run in range(runs)]
    # Clocks without a stated rate are compared with the median of all.
    found = np.median(np.mean([[len(ticks) for ticks in one] for one in times], axis=0)) / horizon
    law, labels = stated_law(part, "activation"), tuple(str(list(entity)) for entity in entities)
    rates = np.where(unknown, found, rates)
    group = ClockGroup(entities, rates, (law,) * len(entities), labels)
    counts = _count(group, times, horizon)
    if part.memoryless:
        _check_generators_used(watched, entities, times)
    _check_rates(watched, group, counts, unknown, horizon)
    _check_gaps(watched, group, counts, times, horizon)
    if law is EXPONENTIAL:
        where, rule = f"{watched.name}.ticks", "ticks of links must be independent"
        apart = compare_clocks(group, counts.ticks, horizon, family_level())
        for comparison in (apart, _compare_gaps_of_links(group, times)):
            demand_agreement(comparison, where, rule, "use the generator given")


def _count(group: ClockGroup, times: list[list[FloatArray]], horizon: float) -> TickCounts:
    """Return counts of the ``times`` of all clocks in each of R runs."""
    clocks, counts = np.arange(len(group.entities)), []
    for one in times:
        owners = np.repeat(clocks, [len(ticks) for ticks in one])
        counts.append(count_ticks(group, np.concatenate(one), owners, horizon))
    return stack_runs(counts)


def _check_generators_used(
    watched: WatchedPart, entities: tuple[Entity, ...], times: list[list[FloatArray]]
) -> None:
    first, *others = times[0]
    others_of = {f"{list(e)}": ticks for e, ticks in zip(entities[1:], others, strict=True)}
    for name, ticks in {"another run": times[1][0], **others_of}.items():
        count = min(len(first), len(ticks), GAPS)
        # Of other rates, in units of their first gaps.
        is_same = np.array_equal(first[:count] / first[0], ticks[:count] / ticks[0])
        got = f"equal times of {list(entities[0])} and {name} from two generators"
        watched.demand("ticks", not is_same, OTHER_GENERATOR, got)


def _check_rates(
    watched: WatchedPart, group: ClockGroup, counts: TickCounts, unknown: np.ndarray, horizon: float
) -> None:
    ticks, distances, level = counts.ticks.sum(axis=1), [], 0.5 * family_level()
    slack = slack_of_start(group, ticks, counts.path)
    if not unknown.any():
        distances = rates_of_all(group, counts.ticks, float(slack.sum()), horizon, level)
    if not unknown.any() or len(unknown) > 1:
        singles = rates_of_each(group, ticks, slack, horizon, level)
        distances += list(zip(singles, group.labels, strict=True))
    rule = "must be the mean ticks per second in the long run"
    remedy = "define mean_rate if links differ by design" if unknown.any() else ""
    comparison = LawComparison(distances, "ticks over the stated number")
    demand_agreement(comparison, f"{watched.name}.mean_rate", rule, remedy)


def _check_gaps(
    watched: WatchedPart,
    group: ClockGroup,
    counts: TickCounts,
    times: list[list[FloatArray]],
    horizon: float,
) -> None:
    law, part, where = group.gaps[0], watched.part, f"{watched.name}.ticks"
    parent = stating_class(part, "activation", "gaps")
    rule, remedy = f"gaps must have the law of {parent}", STATE_IT
    if part.memoryless:
        where, remedy = f"{watched.name}.memoryless", "return False: theory relies on it"
        rule = "must be False where ticks are no Poisson process"
    if isinstance(law, Lattice):
        off, at_times = float(counts.off.max()), f"must tick at the times of {parent}"
        beside = f"{off:.3g} s beside one of them"
        watched.demand("ticks", off <= 1e-9 * horizon, at_times, beside, remedy)
        rule = f"must have the law of {parent}"
        first = _count(group, [[ticks[:1] for ticks in one] for one in times], horizon)
        demand_agreement(compare_gaps(first, family_level())[0], where, rule, remedy)
    for comparison in compare_gaps(counts, family_level()):
        demand_agreement(comparison, where, rule, remedy)


def _compare_gaps_of_links(group: ClockGroup, times: list[list[FloatArray]]) -> LawComparison:
    """Compare correlations between the first GAPS gaps of Poisson clocks, made normal, with 0."""
    z = np.full((len(times), GAPS, len(group.rates)), np.nan)
    for run, one in enumerate(times):
        for k, ticks in enumerate(one):
            gaps = np.diff(ticks[:GAPS], prepend=0.0)
            z[run, : len(gaps), k] = ndtri(-np.expm1(-np.maximum(gaps * group.rates[k], 1e-12)))
    return compare_correlations(np.minimum(z, 7.0), group.labels, family_level(), lags=())


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
    _check_frequencies(watched, topology, is_paired, _stated_mean(watched, topology))
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
