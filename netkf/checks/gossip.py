"""What G promises of the gossip filter, held against runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from netkf.checks.evidence import Finding, Promise, Row, identity
from netkf.checks.exact import all_watched, as_computed, exact, within_reach
from netkf.checks.laws import (
    Pair,
    distances,
    exact_start,
    same_laws,
    worst,
)
from netkf.checks.mode_sequences import (
    gossip_book,
    handed_over,
    lineage,
    look_at,
    reference_size,
    start_roots,
    token_places,
    watched_places,
)
from netkf.checks.samples import Seen, bounded, nees_is_chi_squared, replay
from netkf.checks.statistics import off_by, share
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.gossip.matchings import effective_matching
from netkf.trace.run import Run

SLOTS_ONLY = True
"""Whether the paper speaks about slots alone; under clocks those of ``clocked`` are checked."""

WINDOW = 40
HUGE = 1e9  # root of a covariance that every other one is below
FAR = 30.0  # factor of the other start's root
ROUNDING = 1e-8
SHARE = 0.05  # tolerance of probabilities


class Witness(NamedTuple):
    """What one run says; K slots are looked at.

    P, nees  : (K, N, n, n), (K, N) at the slots
    e, Sigma, whole : as in :class:`Exact`
    replayed : (K, N, n, n) what G (10) makes of the run's swaps
    restarted: (N, n, n) the same at the last slot from another start
    bounds   : (K, N, n, n) what the last readings of each pair allow, whatever was before
    tokens   : (N, n, n) the pair of each token at the last slot; anything where pairs were copied
    pairs    : number of slots in which j handed its pair to i, from slot 1 on, for all ``handing``
    slots    : their number
    """

    P: FloatArray
    nees: FloatArray
    e: FloatArray
    Sigma: FloatArray
    whole: FloatArray
    replayed: FloatArray
    restarted: FloatArray
    bounds: FloatArray
    tokens: FloatArray
    pairs: np.ndarray
    slots: int


def witness(scenario: Scenario, run: Run) -> Witness:
    """Reduce a run whose samples are those of ``look_at``."""
    slots = list(look_at(scenario))
    came, book = handed_over(scenario, run, slots[-1]), gossip_book(scenario)
    starts, n, watched = start_roots(scenario), scenario.plant.n, watched_places(scenario)
    replayed, bounds = [], []
    for slot in slots:
        line = lineage(came, slot)
        origin, path = line.origin[watched], line.path[watched]
        replayed.append(book.along(starts[origin], path, [slot])[0])
        recent = path[:, -WINDOW:]
        everything = np.repeat(HUGE * np.eye(n)[None], len(recent), axis=0)
        bounds.append(book.along(everything, recent, [recent.shape[1]])[0])
    token = token_places(came, slots[-1])
    held = np.full(len(starts), -1) if token is None else token
    restarted = book.along(FAR * starts[origin] + np.eye(n), path, [slots[-1]])[0]
    seen = exact(scenario, run)
    return Witness(
        seen.P,
        seen.nees,
        seen.e,
        seen.Sigma,
        seen.whole,
        np.array(replayed),
        restarted,
        np.array(bounds),
        run.P[-1, held[watched]],
        _handed(scenario, came[1 : slots[-1]]),
        slots[-1] - 1,
    )


def handing(scenario: Scenario) -> tuple[IntArray, IntArray]:
    """Places i and j of the pairs whose swaps are counted: all in a network without unwatched
    nodes, else the ends of links, in both directions.
    """
    if len(watched_places(scenario)) == len(scenario.nodes):
        i, j = np.nonzero(~np.eye(len(scenario.nodes), dtype=bool))
        return i, j
    index = scenario.topology.index
    ends = [(index[a], index[b]) for a, b in scenario.topology.directions]
    i, j = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    return i, j


def _handed(scenario: Scenario, came: np.ndarray) -> np.ndarray:
    """Counts of the slots (rows of ``came``) in which j handed its pair to i."""
    size = len(scenario.nodes)
    codes, counts = np.unique(np.arange(size) * size + came, return_counts=True)
    i, j = handing(scenario)
    if not len(codes):
        return np.zeros(len(i), dtype=int)
    place = np.minimum(np.searchsorted(codes, i * size + j), len(codes) - 1)
    return np.where(codes[place] == i * size + j, counts[place], 0)


class Reference(NamedTuple):
    """S switched chains: ``P`` (K, S, n, n), at the last slot from another start ``restarted``
    (S, n, n), ``places`` (S, slots).
    """

    P: FloatArray
    restarted: FloatArray
    places: np.ndarray


@dataclass(frozen=True)
class Observed(Seen):
    """Witnesses of many runs, stacked, with what they are held against."""

    @cached_property
    def matching(self) -> FloatArray:
        """(N, N) Abar with the losses of the channel."""
        return effective_matching(self.scenario)

    @cached_property
    def reference(self) -> Reference:
        """The switched chain of G (20)."""
        slots, starts = list(look_at(self.scenario)), start_roots(self.scenario)
        random = Streams(self.seed).generator("switched chain")
        places = switched_chain(self.matching, slots[-1], reference_size(self.scenario, 1), random)
        book, first = gossip_book(self.scenario), starts[places[:, 0]]
        restarted = book.along(FAR * first + np.eye(first.shape[-1]), places, slots[-1:])[0]
        return Reference(book.along(first, places, slots), restarted, places)


def switched_chain(
    mean: FloatArray, slots: int, samples: int, random: np.random.Generator
) -> np.ndarray:
    """(samples, slots) places of stationary Markov chains with transition matrix Abar, G (20)."""
    rows = np.cumsum(mean, axis=1)
    places = np.empty((samples, slots), dtype=int)
    places[:, 0] = random.integers(len(mean), size=samples)
    for t in range(1, slots):
        luck = random.random(samples)[:, None]
        places[:, t] = np.minimum((luck >= rows[places[:, t - 1]]).sum(axis=1), len(mean) - 1)
    return places


def rows(scenario: Scenario) -> list[Row]:
    """What the tests need beyond the paper's own assumptions."""
    try:
        effective_matching(scenario)
        known, words = True, "drawn afresh in each slot, and lost with a known probability"
    except TheoryError as error:
        known, words = False, str(error)
    return [
        Row("slots are independent and Abar is known", "G II-A", known, words),
        exact_start(scenario),
        within_reach(scenario),
        all_watched(scenario),
    ]


def walks(seen: Observed, level: float) -> Finding:
    """The last readings of a pair bound it, whatever was before."""
    P, bound = seen.runs.P, seen.runs.bounds
    size = np.trace(bound, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(P), bound - P, -np.inf)
        finite = np.isfinite(gap).all(axis=(-1, -2))
    least = np.full(finite.shape, -np.inf)
    least[finite] = np.linalg.eigvalsh(gap[finite])[..., 0] / size[finite]
    detected = size < HUGE
    largest = f"{size[detected].max():.4g}" if detected.any() else "none"
    words = (
        f"in {detected.mean():.0%} of all cases the last {WINDOW} readings detect the state; "
        f"largest trace of the bounds that they give: {largest}"
    )
    return identity(float(max(0.0, -least.min())), ROUNDING, words)


def pairings(seen: Observed, level: float) -> Finding:
    """Tokens move by the mean matching; slots are independent, so counts are binomial."""
    i, j = handing(seen.scenario)
    trials, totals = int(np.sum(seen.runs.slots)), seen.runs.pairs.sum(axis=0)
    nodes = seen.scenario.nodes
    found = [
        (
            off_by(seen.matching[a, b], share(int(total), trials, level / len(i))),
            f"from node {nodes[b]} to {nodes[a]}",
        )
        for a, b, total in zip(i.tolist(), j.tolist(), totals, strict=True)
    ]
    return worst(found, SHARE, f"largest difference from Abar over {trials:,} slots")


def random_sensor(seen: Observed, level: float) -> Finding:
    """One sensor a run, drawn at random for each slot."""
    random = Streams(seen.seed).generator("random sensor")
    runs, nodes = np.arange(seen.count), len(seen.scenario.nodes)
    picks = random.integers(nodes, size=(len(look_at(seen.scenario)), seen.count))
    pairs = [
        Pair(f"slot {slot}", seen.runs.P[runs, k, picks[k]], seen.reference.P[k])
        for k, slot in enumerate(look_at(seen.scenario))
    ]
    return same_laws(pairs, level)


def each_sensor(seen: Observed, level: float) -> Finding:
    """law(Phat_n(t)) = law(Ptilde(t) given ptilde(t - 1) = n)."""
    P, _, places = seen.reference
    pairs = [
        Pair(f"slot {slot}, node {node}", seen.runs.P[:, k, i], P[k, places[:, slot - 1] == i])
        for k, slot in enumerate(look_at(seen.scenario))
        for i, node in enumerate(seen.nodes)
    ]
    return same_laws(pairs, level)


def tokens(seen: Observed, level: float) -> Finding:
    """Each token at the end against the stationary switched chain, which may not be there yet."""
    last, pairs = len(look_at(seen.scenario)) - 1, []
    everywhere, origin = seen.reference.P[last], seen.reference.places[:, 0]
    for i, node in enumerate(seen.nodes):
        own = seen.runs.tokens[:, i]
        known = distances(everywhere[origin == i], everywhere)
        pairs.append(Pair(f"token {node}", own, everywhere, known))
    return same_laws(pairs, level)


def forgotten(seen: Observed, level: float) -> Finding:
    """The runs against their own swaps from a start a thousand times larger."""
    runs, (P, restarted, places) = seen.runs, seen.reference
    pairs = []
    for i, node in enumerate(seen.nodes):
        here = places[:, -1] == i
        known = distances(P[-1, here], restarted[here])
        pairs.append(Pair(f"node {node}", runs.P[:, -1, i], runs.restarted[:, i], known))
    return same_laws(pairs, level)


CHAIN = ("every exchange is a swap", "slots are independent")
LAWS = (*CHAIN, "every node is watched")
STABLE = (*CHAIN, "G C.1", "G S.1", "G D.1")
ERGODIC = (*LAWS, "G C.1", "G S.1", "G D.1")
PROMISES = (
    Promise(
        "pairs are swapped first and updated after: P_n(t+1) = f_{p_n(t)}(P_n(t))",
        "G (10), (19), Proposition 7",
        (),
        replay,
        exact=True,
    ),
    Promise(
        "a walk that detects bounds the covariance that passes through it",
        "G Lemma 14",
        ("G D.1",),
        walks,
        exact=True,
    ),
    Promise(
        "tokens are Markov chains with transition matrix Abar",
        "G Proposition 6",
        CHAIN,
        pairings,
    ),
    Promise(
        "a random sensor has the law of the switched chain, at every time",
        "G (67), Theorems 8 and 10 [i]",
        LAWS,
        random_sensor,
    ),
    Promise(
        "each sensor has the law of the switched chain that is there",
        "derived from G (19)",
        LAWS,
        each_sensor,
    ),
    Promise(
        "every token has the same law in the end",
        "G Theorem 10 [ii], (25), (28)",
        ERGODIC,
        tokens,
    ),
    Promise(
        "covariances are stochastically bounded: their laws do not grow any more",
        "G Theorem 10 [iii], (26)",
        STABLE,
        bounded,
    ),
    Promise("the law in the end does not depend on the start", "G Theorem 8", ERGODIC, forgotten),
    Promise(
        "errors have the covariance that swaps and readings give them",
        "G (8), (10), derived",
        ("the filters start", "exact errors are within reach"),
        as_computed,
    ),
    Promise(
        "errors are as large as P says: the mean NEES is n",
        "G (9)",
        ("the filters know", "the filters start"),
        nees_is_chi_squared,
    ),
)


def promises(scenario: Scenario) -> tuple[Promise, ...]:
    """Those of the scenario."""
    return PROMISES
