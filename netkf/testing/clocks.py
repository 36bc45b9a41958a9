"""Check that a link clock keeps its contract."""

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
    ticks_on_lattice,
)
from netkf.core.clock import ClockPosition, Entity
from netkf.core.errors import ScenarioError
from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Complete, Link
from netkf.rng.streams import Streams
from netkf.testing.generators import RecordingGenerator
from netkf.testing.noise import FAMILIES, LEVEL, largest_deviation
from netkf.testing.watching import Watched, demand, make_part, user_code

BLOCKS = ((600,), (1,) * 600, (7, 64, 1, 256, 272))
CHAINS, LENGTH = 800, 100
MAX_ENTITIES = 12
TOGETHER = 40
DRIFT = 2e-3
"""Share of the rate by which a long run of ticks may differ: its first gap may be another one."""


def check_clock(clock: Any, /, link: Link | None = None, **settings: Any) -> None:
    """Check a link clock, or a class with its ``settings``, on every link (direction, node) of a
    complete graph of 4 nodes that has a rate, at most 12, or on one ``link`` (i, j) only.

    Exactly: times are finite, above 0 and increasing; blocks of any size, and ticks of other links
    in between, give the same times to the last bit; nothing but the given generator is used, and
    that is where clocks of equal links draw other times; a clock that stopped stays stopped.

    By 80,000 ticks of all links together, with probability 0.9, where gaps vary by c times their
    mean (c = 1 for a Poisson process): a rate that differs from ``mean_rate`` by 2.6 c + 0.2 %, and
    at one of N links by sqrt(N) times as much (6 links: 7.5 %); where ``mean_rate`` is nan, a rate
    of one link that differs from the others by as much. Where the clock says that it is
    ``memoryless``: gaps at a distance of 0.013 from the exponential law, and a correlation of 0.03
    of neighbouring gaps or of equal gaps of two links. A class that derives from Renewal or
    Periodic, and states no rate of its own, is held to their law as much. A sound class fails once
    in a million checks.

    Raises AssertionError with one line: the method, the rule, the value got, what to do.
    """
    check_made_clock(make_part(clock, (LinkClock,), settings), link, 0)


def check_made_clock(part: Any, link: Link | None, seed: int) -> None:
    """Run ``check_clock`` on an object, with streams of the given seed."""
    watched = Watched(part)
    watched.pickle_copy()
    entities = _all_entities(part) if link is None else (link,)
    for entity in entities[:1] if link is None else entities:
        _check_entity(watched, entity)
    _check_apart(watched, entities)
    if len(_read_ticks(watched, entities[0], BLOCKS[0])) == sum(BLOCKS[0]):
        _rates(watched, entities, seed)
    watched.finish()


def _all_entities(part: Any) -> tuple[Entity, ...]:
    """Return the entities of a small network that have a clock of their own."""
    found = tuple(part.entities(Complete(nodes=4).build(seed=0)))[:MAX_ENTITIES]
    try:
        part.check(Complete(nodes=4).build(seed=0))
    except ScenarioError:
        # It names links of another network, or has a rate for some of its links only.
        found = tuple(e for e in found if not math.isnan(part.mean_rate(e))) or found[:1]
        found = found or ((0, 1),)
    return found or ((0, 1),)


def _check_entity(watched: Watched, link: Entity) -> None:
    """Check the ticks of one entity: increasing, repeatable, whatever the blocks."""
    _check_origin(watched, link)
    whole = _read_ticks(watched, link, BLOCKS[0])
    _check_increasing(watched, whole)
    again = _read_ticks(watched, link, BLOCKS[0])
    demand(
        np.array_equal(whole, again),
        f"{watched.name}.ticks",
        "must use no generator but the one it is given",
        "other times from an equal generator",
    )
    for blocks in BLOCKS[1:]:
        parts = _read_ticks(watched, link, blocks)
        if not np.array_equal(whole, parts):
            k = _first_difference(whole, parts)
            texts = [f"{t[k]:.17g}" if k < len(t) else "nothing" for t in (whole, parts)]
            demand(
                False,
                f"{watched.name}.ticks",
                "must not depend on the size of the blocks",
                f"{texts[0]} as tick {k} of one block and {texts[1]} in blocks of {blocks[0]}, ...",
                "add gaps up one by one from now, one draw a tick",
            )


def _check_apart(watched: Watched, entities: tuple[Entity, ...]) -> None:
    """Check that ticks of a link are the same whichever other links tick in between."""
    part, where = watched.part, f"{watched.name}.ticks"
    alone = {}
    with user_code(where):
        for k, entity in enumerate(entities):
            random = RecordingGenerator(11, k)
            position = ClockPosition(_draw_phase(part, entity, k))
            alone[entity] = [tick for _, tick in _iterate_ticks(part, entity, position, random)]
        randoms = [RecordingGenerator(11, k) for k in range(len(entities))]
        # The same streams again, with the ticks of all entities drawn in turn.
        running = [
            _iterate_ticks(part, entity, ClockPosition(_draw_phase(part, entity, k)), randoms[k])
            for k, entity in enumerate(entities)
        ]
        between: dict[Entity, list[float]] = {entity: [] for entity in entities}
        for _ in range(TOGETHER):
            for entity, ticks in zip(entities, running, strict=True):
                between[entity].extend(tick for _, tick in [next(ticks, (0, math.nan))])
    for entity in entities:
        got = [tick for tick in between[entity] if not math.isnan(tick)]
        same = got == alone[entity]
        rule = "ticks of a link must not depend on those of others"
        text = f"other times of {list(entity)} when other links tick in between"
        demand(same, where, rule, text, "use the generator given, and no memory of earlier calls")


def _draw_phase(part: Any, entity: Entity, k: int) -> float:
    """Return the origin that a clock draws from stream ``k``."""
    return float(part.origin(entity, lambda: RecordingGenerator(12, k)))


def _iterate_ticks(
    part: Any, entity: Entity, position: ClockPosition, random: np.random.Generator
) -> Iterator[tuple[int, float]]:
    """Yield the first ticks of an entity with their numbers, one by one."""
    for _ in range(TOGETHER):
        block = part.ticks(entity, *position, random, 1)
        if not len(block):
            return
        tick = float(block[0])
        yield position.number, tick
        position = position._replace(number=position.number + 1, now=tick)


def _check_origin(watched: Watched, link: Entity) -> None:
    """Check that the origin is a finite number that depends on its generator only."""
    first, other = (
        watched.call("origin", link, lambda: RecordingGenerator(8), repeatable=False)
        for _ in range(2)
    )
    where = f"{watched.name}.origin"
    number = isinstance(first, (int, float, np.floating)) and math.isfinite(first)
    demand(number, where, "must be a finite number", first)
    demand(first == other, where, "must use no generator but the one it is given", [first, other])


def _read_ticks(watched: Watched, link: Entity, blocks: tuple[int, ...]) -> FloatArray:
    """Return the ticks of an entity, asked for in blocks, after checks of their form."""
    random = RecordingGenerator(9)
    origin = watched.part.origin(link, lambda: RecordingGenerator(10))
    where, now, stopped = f"{watched.name}.ticks", 0.0, False
    times: list[FloatArray] = []
    for count in blocks:
        index = sum(len(block) for block in times)
        found = watched.call("ticks", link, origin, index, now, random, count, repeatable=False)
        block = np.asarray(found)
        vector = block.ndim == 1 and block.dtype == np.float64
        demand(vector, where, "must be a vector of float64", f"{block.dtype} {block.shape}")
        demand(len(block) <= count, where, f"must be at most {count} times", len(block))
        demand(
            not (stopped and len(block)),
            where,
            "an empty block means stopped for good",
            f"{len(block)} more ticks after it",
        )
        stopped = not len(block)
        times.append(block)
        now = float(block[-1]) if len(block) else now
    return np.concatenate(times)


def _check_increasing(watched: Watched, times: FloatArray) -> None:
    """Check that ticks are finite, positive and increasing."""
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
    """Return the first index at which two lists of times differ."""
    shorter = min(len(one), len(other))
    unequal = np.flatnonzero(one[:shorter] != other[:shorter])
    return int(unequal[0]) if unequal.size else shorter


def _rates(watched: Watched, entities: tuple[Entity, ...], seed: int) -> None:
    """Check the gaps of all entities, each by itself and all together."""
    part, runs = watched.part, max(2, CHAINS // len(entities))
    stated = np.array([watched.call("mean_rate", entity) for entity in entities])
    low = np.flatnonzero(stated <= 0.0)
    where = f"{watched.name}.mean_rate"
    demand(not low.size, where, "must be above 0, or nan", stated[low[:1]].tolist())
    chains = []
    with user_code(f"{watched.name}.ticks"):
        for k, entity in enumerate(entities):
            chains += [_read_chain(part, entity, seed, r, k) for r in range(runs)]
    if min(map(len, chains)) < LENGTH:
        return  # it stops by chance: there is no long run
    times = np.array(chains)
    gaps = np.diff(times, prepend=0.0).reshape(len(entities), runs, LENGTH)
    _check_drawn(watched, entities, gaps)
    _check_rates(watched, entities, gaps, stated)
    if part.memoryless:
        found = gaps[:, :, 1:].mean(axis=(1, 2))
        known = np.where(np.isnan(stated), found, 1.0 / stated)
        _check_exponential(watched, entities, gaps / known[:, None, None])
    else:
        _check_stated_law(watched, gaps, times)


def _check_stated_law(watched: Watched, gaps: FloatArray, times: FloatArray) -> None:
    """Check gaps (E, runs, length), or the ``times`` (E runs, length) of ticks on a lattice,
    against the built-in clock from which a class derives without a mean rate of its own.
    """
    stated, where = stated_part(watched.part, "activation"), f"{watched.name}.ticks"
    known = f"{type(stated).__name__}, from which it derives"
    remedy = "define mean_rate and memoryless too if it differs by design"
    if ticks_on_lattice(stated):
        number = np.tile(np.arange(times.shape[1]), len(times))
        ticks = TickSample(
            times.ravel(), number, np.full(number.shape, times.shape[1]), number == 0
        )
        off = distance_from_lattice(stated, ticks)
        text = f"{off:.3g} s beside one of them"
        demand(off <= 1e-9 * times.max(), where, f"must tick at the times of {known}", text, remedy)
    uniform = gap_law(stated, gaps.reshape(-1)).reshape(gaps.shape)
    if np.isfinite(uniform).all():
        _check_uniform(uniform, where, f"gaps must have the law of {known}", remedy)


def _read_chain(part: Any, entity: Entity, seed: int, run: int, k: int) -> FloatArray:
    """Return the first ticks of an entity in a run."""
    random = Streams(seed, run).generator("testing", k)
    origin = part.origin(entity, lambda: Streams(seed, run).generator("phase", k))
    return np.asarray(part.ticks(entity, origin, 0, 0.0, random, LENGTH))


def _check_drawn(watched: Watched, entities: tuple[Entity, ...], gaps: FloatArray) -> None:
    """Check that the gaps of two runs, and of two links, differ if gaps vary at all."""
    varies = gaps.std(axis=2).min() > 1e-9 * gaps.mean()
    rule = "must draw from the generator given"
    if varies and watched.part.memoryless:
        same = np.array_equal(gaps[:, 0], gaps[:, 1])
        demand(not same, f"{watched.name}.ticks", rule, "equal times from two generators")
    for a in range(1, len(entities) if varies and watched.part.memoryless else 0):
        same = np.array_equal(gaps[a] / gaps[a].mean(), gaps[0] / gaps[0].mean())
        text = f"equal times of {list(entities[0])} and {list(entities[a])} from two generators"
        demand(not same, f"{watched.name}.ticks", rule, text)


def _check_rates(
    watched: Watched, entities: tuple[Entity, ...], gaps: FloatArray, stated: FloatArray
) -> None:
    """Check mean gaps against the stated rates, or against each other where none is stated.

    The first gap may differ: a random phase, or nothing at time 0.
    """
    where, rule = f"{watched.name}.mean_rate", "must be the mean ticks per second in the long run"
    known = ~np.isnan(stated)
    means = gaps[:, :, 1:].mean(axis=2)
    wanted = np.where(known, 1.0 / np.where(known, stated, 1.0), np.median(means.mean(axis=1)))
    relative = means / wanted[:, None] - 1.0
    groups: list[tuple[str, FloatArray, bool]] = [("all links", relative[known].reshape(-1), True)]
    groups += [(f"{list(e)}", relative[k], bool(known[k])) for k, e in enumerate(entities)]
    for name, values, is_known in groups:
        if not len(values) or (not is_known and len(entities) < 2):
            continue
        error = float(values.std(ddof=1)) / math.sqrt(len(values))
        # Student's quantile: the error is estimated from a few runs.
        limit = float(stdtrit(len(values) - 1, 1.0 - 0.5 * LEVEL / (FAMILIES * len(groups))))
        off = float(values.mean())
        if abs(off) > limit * error + DRIFT:
            text = f"{1.0 + off:.4g} (+- {error:.2g}) of the mean gap that it states"
            if not is_known:
                text = f"{1.0 + off:.4g} (+- {error:.2g}) of the mean gap of other links"
            remedy = "" if is_known else "define mean_rate if links differ by design"
            demand(False, where, rule, f"{text}, over {name}", remedy)


def _check_exponential(watched: Watched, entities: tuple[Entity, ...], gaps: FloatArray) -> None:
    """Check that gaps (E, runs, length) of mean 1 are independent and exponential.

    The tests are Kolmogorov's and the correlations of neighbouring gaps and of links.
    """
    where, rule = f"{watched.name}.memoryless", "must be False where ticks are no Poisson process"
    remedy = "return False: theory relies on it"
    unit = _check_uniform(-np.expm1(-gaps), where, rule, remedy)
    for a, one in enumerate(entities):
        for b, other in enumerate(entities[:a]):
            found = largest_deviation((unit[a] * unit[b]).reshape(-1, 1))
            if found is not None:
                text = f"a correlation of {found.mean:.3g} of {list(other)} and {list(one)}"
                rule = "ticks of links with streams of their own must be independent"
                demand(False, f"{watched.name}.ticks", rule, text, "use the generator given")


def _check_uniform(uniform: FloatArray, where: str, rule: str, remedy: str) -> FloatArray:
    """Check that gaps, as numbers (E, runs, length) in [0, 1], are uniform and neighbouring ones
    uncorrelated; return them with mean 0 and variance 1.
    """
    values = np.sort(uniform.reshape(-1))
    steps = np.arange(values.size + 1) / values.size
    apart = float(max((steps[1:] - values).max(), (values - steps[:-1]).max()))
    # P(sqrt(N) D > x) <= 2 exp(-2 x^2), Massart 1990.
    limit = math.sqrt(0.5 * math.log(2.0 * FAMILIES / LEVEL) / values.size)
    text = f"gaps at a distance of {apart:.3g} from the law"
    demand(apart <= limit, where, rule, text, remedy)
    # Of uniform numbers, so that long gaps do not hide the others.
    unit = np.asarray(math.sqrt(12.0) * (uniform - 0.5))
    pairs = (unit[:, :, 1:] * unit[:, :, :-1]).reshape(-1, 1)
    if (found := largest_deviation(pairs)) is not None:
        text = f"neighbouring gaps with a correlation of {found.mean:.3g} +- {found.error:.2g}"
        demand(False, where, rule, text, remedy)
    return unit
