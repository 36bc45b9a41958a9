"""``check_clock``: checks of a link clock against its contract."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.special import stdtrit

from netkf.checks.parts.sources import stated_part
from netkf.checks.parts.ticks import (
    TickSample,
    distance_from_lattice,
    gap_law,
    lattice_ranks,
    ticks_on_lattice,
)
from netkf.core.clock import ClockPosition, Entity
from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Complete, Link
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator
from netkf.testing.noise import FAMILIES, LEVEL, kolmogorov_distance, largest_deviation
from netkf.testing.watching import WatchedPart, demand, fail, guard_user_code, make_part

BLOCKS = ((600,), (1,) * 600, (7, 64, 1, 256, 272))
"""Ways to ask for 600 ticks: the number of ticks in each block."""
CHAINS, LENGTH = 800, 100
"""Simulated runs of all entities together, and ticks in a run."""
MAX_ENTITIES = 12  # links, directions or nodes whose clocks are checked
INTERLEAVED_TICKS = 40
"""Ticks of each entity that are compared alone and with ticks of other entities in between."""
RATE_TOLERANCE = 2e-3
"""Relative difference from the stated mean gap that is allowed besides chance."""


def check_clock(clock: Any, /, link: Link | None = None, **settings: Any) -> None:
    """Check a link clock, or a class with its ``settings``.

    It is checked on the links (directions, nodes) of a complete graph of 4 nodes that have a rate,
    at most 12 of them, or on one ``link`` (i, j) only.

    Exact checks: times are finite, above 0 and increasing; they are the same to the last bit in
    blocks of any size and with ticks of other links in between; only the given generator is used,
    and two generators give different times; a clock that stopped stays stopped.

    Statistical checks find these errors with probability 0.9. From 80,000 ticks of all links
    together, where gaps have a standard deviation of c times their mean (c = 1 for a Poisson
    process): a rate that differs from ``mean_rate`` by 2.6 c + 0.2 %, and the rate of one of N
    links that differs by sqrt(N) times as much (6 links: 7.5 %); if ``mean_rate`` is nan, a rate of
    one link that differs from the others by as much. If the clock states that it is
    ``memoryless``: gaps at a distance of 0.013 from the exponential law, and a correlation of 0.03
    of neighbouring gaps or of the gaps of two links. A class that derives from Renewal or Periodic,
    and states no rate of its own, is compared with the law of its parent as closely. A correct
    class fails once in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    check_clock_object(make_part(clock, (LinkClock,), settings), link, 0)


def check_clock_object(part: Any, link: Link | None, seed: int) -> None:
    """Check a LinkClock ``part``: increasing ticks, repeatable from equal generators, at the stated
    rates and laws, with random streams of ``seed``.

    ``link`` is the only entity to check; None: all entities of a complete graph of 4 nodes. Raises
    AssertionError for the first rule that is broken; ``check_clock`` lists them.
    """
    watched = WatchedPart(part)
    watched.pickle_copy()
    entities = _all_entities(part) if link is None else (link,)
    for entity in entities[:1] if link is None else entities:
        _check_entity(watched, entity)
    _check_interleaved(watched, entities)
    # Rates and laws need a clock that does not stop.
    if len(_read_ticks(watched, entities[0], BLOCKS[0])) == sum(BLOCKS[0]):
        _check_gaps(watched, entities, seed)
    watched.finish()


def _all_entities(part: Any) -> tuple[Entity, ...]:
    """Return the entities (links, directions or nodes) of a complete graph of 4 nodes that have a
    clock, at most MAX_ENTITIES; at least the link (0, 1).
    """
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
    """Check that the ticks of the clock of one ``entity`` (a link, direction or node, by ids)
    increase, are the same from equal generators, and do not depend on how many are asked for at
    once.
    """
    _check_origin(watched, entity)
    in_one_block = _read_ticks(watched, entity, BLOCKS[0])
    _check_increasing(watched, in_one_block)
    repeated = _read_ticks(watched, entity, BLOCKS[0])
    demand(
        np.array_equal(in_one_block, repeated),
        f"{watched.name}.ticks",
        "must use no generator but the one it is given",
        "other times from an equal generator",
    )
    for blocks in BLOCKS[1:]:
        in_blocks = _read_ticks(watched, entity, blocks)
        if not np.array_equal(in_one_block, in_blocks):
            k = _first_difference(in_one_block, in_blocks)
            texts = [f"{t[k]:.17g}" if k < len(t) else "nothing" for t in (in_one_block, in_blocks)]
            fail(
                f"{watched.name}.ticks",
                "must not depend on the size of the blocks",
                f"{texts[0]} as tick {k} of one block and {texts[1]} in blocks of {blocks[0]}, ...",
                "add gaps up one by one from now, one draw a tick",
            )


def _check_interleaved(watched: WatchedPart, entities: tuple[Entity, ...]) -> None:
    """Check that the ticks of the clocks of some ``entities`` (links, directions or nodes, by ids)
    stay the same when the others tick in between.
    """
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
        demand(
            interleaved[k] == alone[k],
            where,
            "ticks of a link must not depend on those of others",
            f"other times of {list(entity)} when other links tick in between",
            "use the generator given, and no memory of earlier calls",
        )


def _iterate_ticks(part: Any, entity: Entity, stream: int) -> Iterator[float]:
    """Yield the first INTERLEAVED_TICKS ticks of an entity in seconds, one call each, drawn from
    the random streams numbered ``stream``.
    """
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
    """Check that the origin (the phase of the clock) is a finite number, and the same from equal
    generators.
    """
    first, second = (
        watched.call("origin", entity, lambda: RecordingGenerator(8), repeatable=False)
        for _ in range(2)
    )
    where = f"{watched.name}.origin"
    is_number = isinstance(first, (int, float, np.floating)) and math.isfinite(first)
    demand(is_number, where, "must be a finite number", first)
    demand(first == second, where, "must use no generator but the one it is given", [first, second])


def _read_ticks(watched: WatchedPart, entity: Entity, blocks: tuple[int, ...]) -> FloatArray:
    """Return the ticks (K,) of the clock of an ``entity`` (a link, direction or node) in seconds,
    asked for in ``blocks`` of these sizes, from a generator with a fixed seed.

    Each block must be a float64 vector of at most its size, and empty after the clock stopped.
    """
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
        demand(
            not (has_stopped and len(block)),
            where,
            "an empty block means stopped for good",
            f"{len(block)} more ticks after it",
        )
        has_stopped = not len(block)
        times.append(block)
        now = float(block[-1]) if len(block) else now
    return np.concatenate(times)


def _check_increasing(watched: WatchedPart, times: FloatArray) -> None:
    """Check that the ticks ``times`` (K,), in seconds, are finite, positive and increasing."""
    where = f"{watched.name}.ticks"
    demand(
        np.isfinite(times).all(),
        where,
        "must be finite",
        "nan or inf",
        "return fewer times when the clock stops",
    )
    gaps = np.diff(times, prepend=0.0)
    k = int(np.argmin(gaps)) if len(gaps) else 0
    demand(
        not len(gaps) or gaps[k] > 0.0,
        where,
        "times must be above 0 and increase",
        f"tick {k} at {times[k] if len(times) else 0.0:g} s, {gaps[k] if len(gaps) else 0.0:g} s "
        "after the one before",
    )


def _first_difference(one: FloatArray, other: FloatArray) -> int:
    """Return the first index at which two arrays of times, ``one`` (K,) and ``other`` (K',),
    differ; the length of the shorter one if it agrees with the longer.
    """
    shorter = min(len(one), len(other))
    unequal = np.flatnonzero(one[:shorter] != other[:shorter])
    return int(unequal[0]) if unequal.size else shorter


def _check_gaps(watched: WatchedPart, entities: tuple[Entity, ...], seed: int) -> None:
    """Check the mean and the law of the gaps between ticks against what the user's clock states,
    from runs of all ``entities`` (links, directions or nodes with a clock) simulated with ``seed``.
    """
    part, runs = watched.part, max(2, CHAINS // len(entities))
    stated = np.array([watched.call("mean_rate", entity) for entity in entities])
    not_positive = stated[stated <= 0.0]
    where = f"{watched.name}.mean_rate"
    demand(not not_positive.size, where, "must be above 0, or nan", not_positive[:1].tolist())
    chains = []
    with guard_user_code(f"{watched.name}.ticks"):
        for k, entity in enumerate(entities):
            chains += [_read_chain(part, entity, seed, r, k) for r in range(runs)]
    if min(map(len, chains)) < LENGTH:
        return  # the clock stopped by chance: there are no gaps of a long run
    times = np.array(chains)
    gaps = np.diff(times, prepend=0.0).reshape(len(entities), runs, LENGTH)
    _check_generators_used(watched, entities, gaps)
    _check_rates(watched, entities, gaps, stated)
    if part.memoryless:
        mean_gaps = np.where(np.isnan(stated), gaps[:, :, 1:].mean(axis=(1, 2)), 1.0 / stated)
        _check_exponential(watched, entities, gaps / mean_gaps[:, None, None])
    else:
        _check_stated_law(watched, gaps, times)


def _check_stated_law(watched: WatchedPart, gaps: FloatArray, times: FloatArray) -> None:
    """Check ``gaps`` (E, runs, length) of E entities, and the ``times`` (E runs, length) of
    periodic ticks, against the law of the built-in clock from which a class derives, unless it
    defines its own ``mean_rate``.
    """
    stated, where = stated_part(watched.part, "activation"), f"{watched.name}.ticks"
    parent = f"{type(stated).__name__}, from which it derives"
    remedy = "define mean_rate and memoryless too if it differs by design"
    if ticks_on_lattice(stated):
        number = np.tile(np.arange(times.shape[1]), len(times))
        ticks = TickSample(
            times.ravel(), number, np.full(number.shape, times.shape[1]), number == 0
        )
        distance = distance_from_lattice(stated, ticks)
        demand(
            distance <= 1e-9 * times.max(),
            where,
            f"must tick at the times of {parent}",
            f"{distance:.3g} s beside one of them",
            remedy,
        )
        _check_phases(lattice_ranks(stated, ticks, math.inf), number == 0, where, parent, remedy)
    uniform = gap_law(stated, gaps.reshape(-1)).reshape(gaps.shape)
    if np.isfinite(uniform).all():
        _check_uniform(uniform, where, f"gaps must have the law of {parent}", remedy)


def _check_phases(
    uniform: FloatArray, is_first: np.ndarray, where: str, parent: str, remedy: str
) -> None:
    """Check that the numbers ``uniform`` (K,) of K ticks, nan for some, which are uniform in [0, 1]
    under the law of a periodic clock, are: those of first ticks (``is_first``, (K,)), which tell
    the phase, and those of others, which tell the jitter.
    """
    for rows, noun in ((is_first, "phases"), (~is_first, "jitter")):
        values = uniform[rows & np.isfinite(uniform)]
        if len(values):
            limit = math.sqrt(0.5 * math.log(2.0 * FAMILIES / LEVEL) / len(values))
            distance = kolmogorov_distance(values)
            text = f"{noun} at a distance of {distance:.3g} from it"
            demand(distance <= limit, where, f"must have the law of {parent}", text, remedy)


def _read_chain(part: Any, entity: Entity, seed: int, run: int, stream: int) -> FloatArray:
    """Return the first LENGTH ticks (LENGTH,) of the clock of an ``entity`` (a link, direction or
    node) in a ``run`` of ``seed``, in seconds, fewer if the clock stops.

    ``stream`` numbers the generators of the entity; entities with different numbers are
    independent.
    """
    random = Streams(seed, run).generator("testing", stream)
    origin = part.origin(entity, lambda: Streams(seed, run).generator("phase", stream))
    # From tick number 0 and time 0 on.
    return np.asarray(part.ticks(entity, origin, 0, 0.0, random, LENGTH))


def _check_generators_used(
    watched: WatchedPart, entities: tuple[Entity, ...], gaps: FloatArray
) -> None:
    """Check that the random ``gaps`` (E, runs, length) of a memoryless clock differ between runs
    and between the E ``entities``, which have different generators.
    """
    varies = gaps.std(axis=2).min() > 1e-9 * gaps.mean()
    if not (varies and watched.part.memoryless):
        return
    where, rule = f"{watched.name}.ticks", "must draw from the generator given"
    is_same = np.array_equal(gaps[:, 0], gaps[:, 1])
    demand(not is_same, where, rule, "equal times from two generators")
    for a in range(1, len(entities)):
        is_same = np.array_equal(gaps[a] / gaps[a].mean(), gaps[0] / gaps[0].mean())
        text = f"equal times of {list(entities[0])} and {list(entities[a])} from two generators"
        demand(not is_same, where, rule, text)


def _check_rates(
    watched: WatchedPart, entities: tuple[Entity, ...], gaps: FloatArray, stated: FloatArray
) -> None:
    """Check the mean of ``gaps`` (E, runs, length) between ticks, in seconds, of the clocks of E
    entities (links, directions or nodes) against their ``stated`` rates (E,) in 1/s; entities with
    nan are compared with the median of all.
    """
    where, rule = f"{watched.name}.mean_rate", "must be the mean ticks per second in the long run"
    is_stated = ~np.isnan(stated)
    # Without the first gap, which may be a random phase.
    means = gaps[:, :, 1:].mean(axis=2)
    expected = np.where(
        is_stated, 1.0 / np.where(is_stated, stated, 1.0), np.median(means.mean(axis=1))
    )
    relative = means / expected[:, None] - 1.0
    # Name, relative deviations of the mean gaps of runs, and whether the rate is stated.
    groups: list[tuple[str, FloatArray, bool]]
    groups = [("all links", relative[is_stated].reshape(-1), True)]
    groups += [(f"{list(e)}", relative[k], bool(is_stated[k])) for k, e in enumerate(entities)]
    for name, deviations, has_rate in groups:
        if not len(deviations) or (not has_rate and len(entities) < 2):
            continue
        error = float(deviations.std(ddof=1)) / math.sqrt(len(deviations))
        # Student's quantile, because the error is estimated from a few runs.
        limit = float(stdtrit(len(deviations) - 1, 1.0 - 0.5 * LEVEL / (FAMILIES * len(groups))))
        mean = float(deviations.mean())
        if abs(mean) > limit * error + RATE_TOLERANCE:
            reference = "that it states" if has_rate else "of other links"
            text = f"{1.0 + mean:.4g} (+- {error:.2g}) of the mean gap {reference}, over {name}"
            remedy = "" if has_rate else "define mean_rate if links differ by design"
            fail(where, rule, text, remedy)


def _check_exponential(
    watched: WatchedPart, entities: tuple[Entity, ...], gaps: FloatArray
) -> None:
    """Check that ``gaps`` (E, runs, length) of E entities, divided by their means, are independent
    and exponential, by Kolmogorov's test and correlations of neighbouring gaps and of entities.
    """
    where, rule = f"{watched.name}.memoryless", "must be False where ticks are no Poisson process"
    remedy = "return False: theory relies on it"
    unit = _check_uniform(-np.expm1(-gaps), where, rule, remedy)
    for a in range(len(entities)):
        for b in range(a):
            deviation = largest_deviation((unit[a] * unit[b]).reshape(-1, 1))
            if deviation is not None:
                pair = f"{list(entities[b])} and {list(entities[a])}"
                fail(
                    f"{watched.name}.ticks",
                    "ticks of links with streams of their own must be independent",
                    f"a correlation of {deviation.mean:.3g} of {pair}",
                    "use the generator given",
                )


def _check_uniform(uniform: FloatArray, where: str, rule: str, remedy: str) -> FloatArray:
    """Check that ``uniform`` (E, runs, length), the values of the stated distribution function at
    the gaps of E entities, is uniform in [0, 1] and that neighbouring gaps are uncorrelated.

    Returns the same numbers scaled to mean 0 and variance 1. Messages say ``where`` the fault is
    (the method), the broken ``rule`` and the ``remedy``.
    """
    distance = kolmogorov_distance(uniform.reshape(-1))
    # P(sqrt(N) D > x) <= 2 exp(-2 x^2), Massart 1990.
    limit = math.sqrt(0.5 * math.log(2.0 * FAMILIES / LEVEL) / uniform.size)
    text = f"gaps at a distance of {distance:.3g} from the law"
    demand(distance <= limit, where, rule, text, remedy)
    # Correlations of these instead of the gaps, of which a few long ones would dominate.
    unit = np.asarray(math.sqrt(12.0) * (uniform - 0.5))
    deviation = largest_deviation((unit[:, :, 1:] * unit[:, :, :-1]).reshape(-1, 1))
    if deviation is not None:
        correlation = f"{deviation.mean:.3g} +- {deviation.error:.2g}"
        fail(where, rule, f"neighbouring gaps with a correlation of {correlation}", remedy)
    return unit
