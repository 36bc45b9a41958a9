"""Check that a link clock keeps its contract."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.network.clocks import LinkClock
from netkf.network.graphs import Link
from netkf.testing.generators import RecordingGenerator
from netkf.testing.watching import Watched, demand, made

BLOCKS = ((600,), (1,) * 600, (7, 64, 1, 256, 272))
CHAINS, LENGTH = 200, 400
SURE = 5.0
DRIFT = 5e-3


def check_clock(clock: Any, /, link: Link = (0, 1), **settings: Any) -> None:
    """Check a link clock, or a class with its ``settings``, on one link.

    Times are finite, above 0 and increasing; blocks of any size give the same times to the last
    bit; nothing but the given generator is used; ``mean_rate`` agrees with 80,000 simulated ticks;
    gaps are independent and exponential where the clock says that it is ``memoryless``; a clock
    that stopped stays stopped. Raises AssertionError with one line.
    """
    watched = Watched(made(clock, (LinkClock,), settings))
    watched.pickled()
    _origin(watched, link)
    whole = _ticks(watched, link, BLOCKS[0])
    _increasing(watched, whole)
    again = _ticks(watched, link, BLOCKS[0])
    demand(
        np.array_equal(whole, again),
        f"{watched.name}.ticks",
        "must use no generator but the one it is given",
        "other times from an equal generator",
    )
    for blocks in BLOCKS[1:]:
        parts = _ticks(watched, link, blocks)
        if not np.array_equal(whole, parts):
            k = _first_difference(whole, parts)
            shown = [f"{t[k]:.17g}" if k < len(t) else "nothing" for t in (whole, parts)]
            demand(
                False,
                f"{watched.name}.ticks",
                "must not depend on the size of the blocks",
                f"{shown[0]} as tick {k} of one block and {shown[1]} in blocks of {blocks[0]}, ...",
                "add gaps up one by one from now, one draw a tick",
            )
    if len(whole) == sum(BLOCKS[0]):
        _rates(watched, link)
    watched.finish()


def _origin(watched: Watched, link: Link) -> None:
    first, other = (
        watched.call("origin", link, lambda: RecordingGenerator(8), repeatable=False)
        for _ in range(2)
    )
    where = f"{watched.name}.origin"
    number = isinstance(first, (int, float, np.floating)) and math.isfinite(first)
    demand(number, where, "must be a finite number", first)
    demand(first == other, where, "must use no generator but the one it is given", [first, other])


def _ticks(watched: Watched, link: Link, blocks: tuple[int, ...], *entity: int) -> FloatArray:
    random = RecordingGenerator(9, *entity)
    origin = watched.part.origin(link, lambda: RecordingGenerator(10, *entity))
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


def _increasing(watched: Watched, times: FloatArray) -> None:
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
    shorter = min(len(one), len(other))
    unequal = np.flatnonzero(one[:shorter] != other[:shorter])
    return int(unequal[0]) if unequal.size else shorter


def _rates(watched: Watched, link: Link) -> None:
    part = watched.part
    stated = watched.call("mean_rate", link)
    chains = [_ticks(watched, link, (LENGTH,), k) for k in range(CHAINS)]
    if min(map(len, chains)) < LENGTH:
        return  # it stops by chance: there is no long run
    gaps = np.diff(np.array(chains), prepend=0.0)
    # The first gap may differ: a random phase, or nothing at time 0.
    means = gaps[:, 1:].mean(axis=1)
    found, error = float(means.mean()), float(means.std()) / math.sqrt(CHAINS)
    if not math.isnan(stated):
        demand(stated > 0.0, f"{watched.name}.mean_rate", "must be above 0, or nan", stated)
        off = abs(found - 1.0 / stated) > SURE * error + DRIFT / stated
        demand(
            not off,
            f"{watched.name}.mean_rate",
            "must be the mean ticks per second in the long run, or nan",
            f"{stated:.5g}, and {CHAINS * LENGTH:,} simulated ticks say "
            f"{1.0 / found:.5g} (+- {error / found:.1%})",
        )
    if part.memoryless:
        _exponential(watched, gaps / found)


def _exponential(watched: Watched, gaps: FloatArray) -> None:
    """Check that gaps (chains, length) of mean 1 are independent and exponential.

    The tests are Kolmogorov's at a level of 1e-6 and the correlation of neighbouring gaps.
    """
    where, rule = f"{watched.name}.memoryless", "must be False where ticks are no Poisson process"
    remedy = "return False: theory relies on it"
    values = np.sort(gaps.reshape(-1))
    steps = np.arange(values.size + 1) / values.size
    law = -np.expm1(-values)
    apart = float(max((steps[1:] - law).max(), (law - steps[:-1]).max()))
    demand(
        apart <= 2.7 / math.sqrt(values.size),
        where,
        rule,
        f"gaps at a distance of {apart:.3g} from the exponential law",
        remedy,
    )
    products = ((gaps[:, 1:] - 1.0) * (gaps[:, :-1] - 1.0)).mean(axis=1)
    value, error = float(products.mean()), float(products.std()) / math.sqrt(CHAINS)
    demand(
        abs(value) <= SURE * error,
        where,
        rule,
        f"neighbouring gaps with a correlation of {value:.3g} +- {error:.2g}",
        remedy,
    )
