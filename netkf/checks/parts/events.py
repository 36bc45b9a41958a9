"""Counts of the ticks, messages and pairs in the events of one run."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.core.clock import Entity
from netkf.network.clocks import LinkClock, OnReadings
from netkf.network.matchings import Matching
from netkf.scenario.scenario import Scenario
from netkf.trace.run import Run
from netkf.trace.schema import CODES

CELLS = 16
"""Cells of equal probability into which the gaps of clocks are sorted."""
WINDOWS, MAX_WINDOWED = 8, 200
"""Windows of a run in which ticks and losses are counted, up to so many clocks or directions."""


class TickCounts(NamedTuple):
    """Of E clocks: ``ticks`` (W, E) in the windows of one run; how many gaps fall into each of the
    ``cells`` (CELLS,); ``products`` (3,): sums of u u' and of u^2 over neighbouring gaps, and their
    number, where u is a gap as a standard normal number.
    """

    ticks: np.ndarray
    cells: np.ndarray
    products: np.ndarray


class FateCounts(NamedTuple):
    """Of D directions: messages ``sent`` and ``lost`` (W, D) in the windows of one run;
    ``repeated`` (D,) losses of a message and of the one before it, and ``both`` (D,) losses of a
    message and of the one with the same number in the other direction.
    """

    sent: np.ndarray
    lost: np.ndarray
    repeated: np.ndarray
    both: np.ndarray


class PairCounts(NamedTuple):
    """Of L links: slots in which they were ``paired`` (L,) and also in the slot before,
    ``repeated`` (L,), and the number of ``slots`` ().
    """

    paired: np.ndarray
    repeated: np.ndarray
    slots: np.ndarray


@lru_cache(maxsize=8)
def clock_entities(scenario: Scenario) -> tuple[Entity, ...]:
    """Return the entities that have a clock, in order; empty where no clock is drawn."""
    clock = scenario.network.activation
    if not isinstance(clock, LinkClock) or isinstance(clock, OnReadings):
        return ()
    return clock.entities(scenario.topology) if scenario.filter.algorithm.talks else ()


def count_ticks(scenario: Scenario, run: Run) -> TickCounts | None:
    """Return the counts of a run; None without clocks."""
    entities = clock_entities(scenario)
    if not entities:
        return None
    clock = scenario.network.activation
    assert isinstance(clock, LinkClock)
    place = {entity: k for k, entity in enumerate(entities)}
    rows = run.log[run.log["kind"] == CODES["tick"]]
    columns = ("node",) if clock.at == "nodes" else ("node", "peer")
    ids = zip(*(rows[name].tolist() for name in columns), strict=True)
    ordered = clock.at == "links"
    which = np.array([place[tuple(sorted(e)) if ordered else e] for e in ids], dtype=np.int64)
    count = _by_window(scenario, rows["t"], which, len(entities))
    return TickCounts(count, *_sort_gaps(rows["t"], which, count.sum(axis=0), scenario.horizon))


def _by_window(scenario: Scenario, times: np.ndarray, which: np.ndarray, size: int) -> np.ndarray:
    """Return how often each of ``size`` places occurs in each of the windows, (W, size).

    Windows are equal parts of the run. Counts of different windows are independent as those of
    different runs are, so that correlations between places show in fewer runs.
    """
    windows = WINDOWS if size <= MAX_WINDOWED else 1
    place = np.minimum((times * (windows / scenario.horizon)).astype(np.int64), windows - 1)
    counts = np.bincount(place * size + which, minlength=windows * size)
    return counts.reshape(windows, size)


def _sort_gaps(
    times: np.ndarray, which: np.ndarray, count: np.ndarray, horizon: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return in which cells the gaps of all clocks lie, and the products of neighbours.

    Runs that end hide long gaps. Given how many ticks a Poisson clock has in a run, they lie there
    like independent uniform times: with m of them still to come in the rest of the run, a gap is
    longer than a share v of that rest with probability (1 - v)^m. That makes each gap a uniform
    number, independent of those before it.
    """
    order = np.lexsort((times, which))
    t, e = times[order], which[order]
    first = np.ones(len(t), dtype=bool)
    first[1:] = e[1:] != e[:-1]
    before = np.where(first, 0.0, np.concatenate([[0.0], t[:-1]])[: len(t)])
    starts = np.concatenate([[0], np.cumsum(count)])[e]
    left = count[e] - (np.arange(len(t)) - starts)
    uniform = -np.expm1(left * np.log1p(-(t - before) / (horizon - before)))
    cells = np.bincount(np.minimum((CELLS * uniform).astype(int), CELLS - 1), minlength=CELLS)
    normal = scipy.special.ndtri(np.clip(uniform, 1e-12, 1.0 - 1e-12))
    pairs = ~first[1:]
    u, v = normal[1:][pairs], normal[:-1][pairs]
    return cells, np.array([u @ v, 0.5 * (u @ u + v @ v), float(len(u))])


@lru_cache(maxsize=8)
def _direction_places(scenario: Scenario) -> dict[tuple[int, int], int]:
    return {direction: k for k, direction in enumerate(scenario.topology.directions)}


def count_fates(scenario: Scenario, run: Run) -> FateCounts | None:
    """Return the counts of a run; None if nothing is sent."""
    places, log = _direction_places(scenario), run.log
    sends, losses = (log[log["kind"] == CODES[kind]] for kind in ("send", "lost"))
    if not len(sends) or not places:
        return None
    size = len(places)
    lost_at = _by_direction(losses, places)
    sent = _by_window(scenario, sends["t"], _by_direction(sends, places), size)
    lost = _by_window(scenario, losses["t"], lost_at, size)
    number = losses["message"]
    # One number for each message, with a gap after the last of each direction.
    width = int(sends["message"].max()) + 2
    keys = lost_at * width + number
    after = np.isin(keys - 1, keys) & (number > 0)
    back = reversed_directions(scenario)[lost_at]
    both = np.isin(back * width + number, keys) & (back >= 0)
    return FateCounts(
        sent,
        lost,
        np.bincount(lost_at[after], minlength=size),
        np.bincount(lost_at[both], minlength=size),
    )


def _by_direction(rows: np.ndarray, places: dict[tuple[int, int], int]) -> np.ndarray:
    """Return the place of the direction of each row, in which the sender comes first."""
    ids = zip(rows["node"].tolist(), rows["peer"].tolist(), strict=True)
    return np.array([places[direction] for direction in ids], dtype=np.int64)


@lru_cache(maxsize=8)
def reversed_directions(scenario: Scenario) -> np.ndarray:
    """Return the place of the other direction of each, -1 without one."""
    places = _direction_places(scenario)
    return np.array([places.get((j, i), -1) for i, j in places], dtype=np.int64)


def count_pairs(scenario: Scenario, run: Run) -> PairCounts | None:
    """Return the counts of a run; None without drawn matchings."""
    if not isinstance(scenario.network.activation, Matching):
        return None
    links = {link: k for k, link in enumerate(scenario.topology.links)}
    rows = run.log[run.log["kind"] == CODES["tick"]]
    slots = scenario.slot_plant.slots_of(rows["t"])
    ids = zip(rows["node"].tolist(), rows["peer"].tolist(), strict=True)
    which = np.array([links[min(e), max(e)] for e in ids], dtype=np.int64)
    count = np.bincount(which, minlength=len(links))
    keys = slots * len(links) + which
    again = np.isin(keys - len(links), keys)
    first = scenario.hosted.first_slot
    total = int(np.ceil(scenario.horizon / scenario.slot_plant.period - 1e-9)) - first
    return PairCounts(
        count, np.bincount(which[again], minlength=len(links)), np.array(float(total))
    )
