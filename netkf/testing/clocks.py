"""``check_clock``: checks of a link clock against its contract."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.special import ndtri

from netkf.core.clock import ClockPosition, Entity, generate_ticks
from netkf.core.errors import ScenarioError
from netkf.core.laws import EXPONENTIAL, Lattice
from netkf.laws.intervals import Comparison, deviation_interval
from netkf.laws.noise import compare_correlations
from netkf.laws.stating import stated_law, stated_part
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
from netkf.network.graphs import Complete, Link
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator
from netkf.testing.noise import demand_agreement, family_level
from netkf.testing.watching import WatchedPart, demand, fail, guard_user_code, make_part

BLOCKS = ((600,), (1,) * 600, (7, 64, 1, 256, 272))
"""Ways to ask for 600 ticks: the number of ticks in each block."""
CHAINS, LENGTH, GAPS = 800, 100, 75
"""Simulated runs of all entities together, mean number of ticks in a run, and gaps of each run
between which correlations are tested.
"""
MAX_ENTITIES = 12  # links, directions or nodes whose clocks are checked
INTERLEAVED_TICKS = 40
"""Ticks of each entity that are compared alone and with ticks of other entities in between."""


REMEDY = "use the generator given"
STATE_IT = "define mean_rate and memoryless too if it differs by design"


def check_clock(clock: Any, /, link: Link | None = None, **settings: Any) -> None:
    """Check a link clock, or a class with its ``settings``.

    It is checked on the links (directions, nodes) of a complete graph of 4 nodes that have a rate,
    at most 12 of them, or on one ``link`` (i, j) only.

    Exact checks: times are finite, above 0 and increasing; they are the same to the last bit in
    blocks of any size and with ticks of other links in between; only the given generator is used,
    and two generators give different times; a clock that stopped stays stopped.

    Statistical checks find these errors with probability 0.9. From 80,000 ticks of all links
    together: of Poisson clocks a rate that differs from ``mean_rate`` by 2.8 %, of others, with
    gaps of a standard deviation of c times their mean, by 2.6 c + 1 %, and the rate of one of N
    links that differs by sqrt(N) times as much (6 links: 7.5 %); if ``mean_rate`` is nan, a rate of
    one link that differs from the others by as much. A class that states that it is
    ``memoryless``, or its law by ``gaps``, or derives from Renewal or Periodic and states nothing
    of its own, is compared with that law: a sixteenth of it that has 0.007 more or fewer gaps, and
    a correlation of 0.03 of neighbouring ones; of memoryless clocks a correlation of 0.08 of the
    gaps of two links. A correct class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    _check_clock(make_part(clock, (LinkClock,), settings), link, 0)


def _check_clock(part: Any, link: Link | None, seed: int) -> None:
    watched = WatchedPart(part)
    watched.pickle_copy()
    entities = _all_entities(part) if link is None else (link,)
    for entity in entities[:1] if link is None else entities:
        _check_entity(watched, entity)
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
    _check_origin(watched, entity)
    in_one_block = _read_ticks(watched, entity, BLOCKS[0])
    _check_increasing(watched, in_one_block)
    repeated = _read_ticks(watched, entity, BLOCKS[0])
    rule = "must use no generator but the one it is given"
    got = "other times from an equal generator"
    demand(np.array_equal(in_one_block, repeated), f"{watched.name}.ticks", rule, got)
    for blocks in BLOCKS[1:]:
        in_blocks = _read_ticks(watched, entity, blocks)
        if not np.array_equal(in_one_block, in_blocks):
            pairs = zip(in_one_block, in_blocks, strict=False)
            shorter = min(len(in_one_block), len(in_blocks))
            k = next((k for k, (one, other) in enumerate(pairs) if one != other), shorter)
            texts = [f"{t[k]:.17g}" if k < len(t) else "nothing" for t in (in_one_block, in_blocks)]
            fail(
                f"{watched.name}.ticks",
                "must not depend on the size of the blocks",
                f"{texts[0]} as tick {k} of one block and {texts[1]} in blocks of {blocks[0]}, ...",
                "add gaps up one by one from now, one draw a tick",
            )


def _check_interleaved(watched: WatchedPart, entities: tuple[Entity, ...]) -> None:
    part, where = watched.part, f"{watched.name}.ticks"
    with guard_user_code(where):
        alone = [list(_iterate_ticks(part, entity, k)) for k, entity in enumerate(entities)]
        # The same streams again, with the ticks of all entities drawn in turn.
        iterators = [_iterate_ticks(part, entity, k) for k, entity in enumerate(entities)]
        interleaved: list[list[float]] = [[] for _ in entities]
        for _ in range(INTERLEAVED_TICKS):
            for ticks, iterator in zip(interleaved, iterators, strict=True):
                tick = next(iterator, None)
                if tick is not None:
                    ticks.append(tick)
    for k, entity in enumerate(entities):
        rule = "ticks of a link must not depend on those of others"
        got = f"other times of {list(entity)} when other links tick in between"
        remedy = "use the generator given, and no memory of earlier calls"
        demand(interleaved[k] == alone[k], where, rule, got, remedy)


def _iterate_ticks(part: Any, entity: Entity, stream: int) -> Iterator[float]:
    random = RecordingGenerator(11, stream)
    position = ClockPosition(float(part.origin(entity, lambda: RecordingGenerator(12, stream))))
    for _ in range(INTERLEAVED_TICKS):
        block = part.ticks(entity, *position, random, 1)
        if not len(block):
            return
        tick = float(block[0])
        yield tick
        position = position._replace(number=position.number + 1, now=tick)


def _check_origin(watched: WatchedPart, entity: Entity) -> None:
    first, second = (
        watched.call("origin", entity, lambda: RecordingGenerator(8), repeatable=False)
        for _ in range(2)
    )
    where = f"{watched.name}.origin"
    is_number = isinstance(first, (int, float, np.floating)) and math.isfinite(first)
    demand(is_number, where, "must be a finite number", first)
    demand(first == second, where, "must use no generator but the one it is given", [first, second])


def _read_ticks(watched: WatchedPart, entity: Entity, blocks: tuple[int, ...]) -> FloatArray:
    random = RecordingGenerator(9)
    origin = watched.part.origin(entity, lambda: RecordingGenerator(10))
    where, now, has_stopped = f"{watched.name}.ticks", 0.0, False
    times: list[FloatArray] = []
    for count in blocks:
        index = sum(len(block) for block in times)
        block = np.asarray(
            watched.call("ticks", entity, origin, index, now, random, count, repeatable=False)
        )
        is_vector = block.ndim == 1 and block.dtype == np.float64
        demand(is_vector, where, "must be a vector of float64", f"{block.dtype} {block.shape}")
        demand(len(block) <= count, where, f"must be at most {count} times", len(block))
        rule = "an empty block means stopped for good"
        demand(not (has_stopped and len(block)), where, rule, f"{len(block)} more ticks after it")
        has_stopped = not len(block)
        times.append(block)
        now = float(block[-1]) if len(block) else now
    return np.concatenate(times)


def _check_increasing(watched: WatchedPart, times: FloatArray) -> None:
    where = f"{watched.name}.ticks"
    rule, remedy = "must be finite", "return fewer times when the clock stops"
    demand(np.isfinite(times).all(), where, rule, "nan or inf", remedy)
    gaps = np.diff(times, prepend=0.0)
    k = int(np.argmin(gaps)) if len(gaps) else 0
    demand(
        not len(gaps) or gaps[k] > 0.0,
        where,
        "times must be above 0 and increase",
        f"tick {k} at {times[k] if len(times) else 0.0:g} s, {gaps[k] if len(gaps) else 0.0:g} s "
        "after the one before",
    )


def _check_laws(watched: WatchedPart, entities: tuple[Entity, ...], seed: int) -> None:
    part, runs = watched.part, max(2, CHAINS // len(entities))
    rates = np.array([watched.call("mean_rate", entity) for entity in entities])
    wrong, where = rates[rates <= 0.0], f"{watched.name}.mean_rate"
    demand(not wrong.size, where, "must be above 0, or nan", wrong[:1].tolist())
    with guard_user_code(f"{watched.name}.ticks"):
        horizon = LENGTH / float(np.nanmedian(rates)) if not np.isnan(rates).all() else 0.0
        if not horizon:
            horizon = float(_read_ticks(watched, entities[0], (LENGTH,))[-1])

        def draw(run: int, k: int, entity: Entity) -> FloatArray:
            streams = Streams(seed, run)
            phase = lambda: streams.generator("phase", k)  # noqa: E731
            return generate_ticks(part, entity, phase, streams.generator("testing", k), horizon)

        times = [[draw(run, *item) for item in enumerate(entities)] for run in range(runs)]
    # Clocks without a stated rate are compared with the median of all.
    found = np.median(np.mean([[len(ticks) for ticks in one] for one in times], axis=0)) / horizon
    law = stated_law(part, "activation")
    labels = tuple(str(list(entity)) for entity in entities)
    group = ClockGroup(
        entities, np.where(np.isnan(rates), found, rates), (law,) * len(entities), labels
    )
    counts = _stack([_count(group, one, horizon) for one in times])
    if part.memoryless:
        _check_generators_used(watched, entities, times)
    _check_rates(watched, group, counts, np.isnan(rates), horizon)
    _check_gaps(watched, group, counts, times, horizon)
    if law is EXPONENTIAL:
        where, rule = f"{watched.name}.ticks", "ticks of links must be independent"
        demand_agreement(
            compare_clocks(group, counts.ticks, horizon, family_level()), where, rule, REMEDY
        )
        demand_agreement(_compare_gaps_of_links(group, times), where, rule, REMEDY)


def _count(group: ClockGroup, times: list[FloatArray], horizon: float) -> TickCounts:
    owners = np.repeat(np.arange(len(times)), [len(ticks) for ticks in times])
    return count_ticks(group, np.concatenate(times), owners, horizon)


def _stack(counts: list[TickCounts]) -> TickCounts:
    return TickCounts(*(np.array(column) for column in zip(*counts, strict=True)))


def _check_generators_used(
    watched: WatchedPart, entities: tuple[Entity, ...], times: list[list[FloatArray]]
) -> None:
    where, rule = f"{watched.name}.ticks", "must draw from the generator given"
    first, *others = times[0]
    count = min(len(first), len(times[1][0]))
    is_same = np.array_equal(first[:count], times[1][0][:count])
    demand(not is_same, where, rule, "equal times from two generators")
    for entity, ticks in zip(entities[1:], others, strict=True):
        count = min(len(first), len(ticks), GAPS)
        is_same = np.array_equal(first[:count] / first[0], ticks[:count] / ticks[0])
        text = f"equal times of {list(entities[0])} and {list(entity)} from two generators"
        demand(not is_same, where, rule, text)


def _check_rates(
    watched: WatchedPart, group: ClockGroup, counts: TickCounts, unknown: np.ndarray, horizon: float
) -> None:
    where, rule = f"{watched.name}.mean_rate", "must be the mean ticks per second in the long run"
    ticks, distances = counts.ticks.sum(axis=1), []
    slack = slack_of_start(group, ticks)
    if not unknown.any():
        total = float(slack.sum())
        distances = rates_of_all(group, counts.ticks, total, horizon, 0.5 * family_level())
    if not unknown.any() or len(unknown) > 1:
        singles = rates_of_each(group, ticks, slack, horizon, 0.5 * family_level())
        distances += list(zip(singles, group.labels, strict=True))
    text = "ticks over the stated number"
    remedy = "define mean_rate if links differ by design" if unknown.any() else ""
    demand_agreement(Comparison(distances, text), where, rule, remedy)


def _check_gaps(
    watched: WatchedPart,
    group: ClockGroup,
    counts: TickCounts,
    times: list[list[FloatArray]],
    horizon: float,
) -> None:
    law, part, where = group.gaps[0], watched.part, f"{watched.name}.ticks"
    stated = stated_part(part, "activation")
    derives = type(stated) is not type(part)
    parent = f"{type(stated).__name__}, from which it derives" if derives else "its `gaps`"
    rule, remedy = f"gaps must have the law of {parent}", STATE_IT
    if part.memoryless:
        where, remedy = f"{watched.name}.memoryless", "return False: theory relies on it"
        rule = "must be False where ticks are no Poisson process"
    if isinstance(law, Lattice):
        off, rule = float(counts.off.max()), f"must have the law of {parent}"
        beside = f"{off:.3g} s beside one of them"
        demand(off <= 1e-9 * horizon, where, f"must tick at the times of {parent}", beside, remedy)
        first = _stack([_count(group, [ticks[:1] for ticks in one], horizon) for one in times])
        demand_agreement(compare_gaps(first, family_level())[0], where, rule, remedy)
    shares, correlation = compare_gaps(counts, family_level())
    demand_agreement(shares, where, rule, remedy)
    if correlation is not None:
        distance = deviation_interval(0.0, correlation)
        comparison = Comparison([(distance, "neighbouring gaps")], "largest correlation")
        demand_agreement(comparison, where, rule, remedy)


def _compare_gaps_of_links(group: ClockGroup, times: list[list[FloatArray]]) -> Comparison:
    """Compare correlations between the first GAPS gaps of Poisson clocks, made normal, with 0."""
    z = np.full((len(times), GAPS, len(group.rates)), np.nan)
    for run, one in enumerate(times):
        for k, ticks in enumerate(one):
            gaps = np.diff(ticks[:GAPS], prepend=0.0)
            z[run, : len(gaps), k] = ndtri(-np.expm1(-np.maximum(gaps * group.rates[k], 1e-12)))
    return compare_correlations(np.minimum(z, 7.0), group.labels, family_level(), lags=())
