"""Promises of G about the gossip filter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from netkf.checks.evidence import Assumption, Finding, Promise
from netkf.checks.exact import (
    check_bias,
    check_error_covariance,
    check_nees,
    few_errors,
    summarise_exactly,
)
from netkf.checks.laws import (
    LAW_TOLERANCE,
    Pair,
    compare_growth,
    compare_laws,
    diagonal_distances,
    exact_start,
    find_largest,
    growth,
)
from netkf.checks.mode_sequences import (
    MIN_CHAINS,
    gossip_modes,
    initial_roots,
    kept_reference,
    pair_sources,
    reference_count,
    token_positions,
    trace_tokens,
    with_horizon,
)
from netkf.checks.paper import PaperChecks
from netkf.checks.points import all_sampled, check_slots, sampled_indices
from netkf.checks.rounding import compare_identities
from netkf.checks.samples import ReplicaSummary, RunSamples, check_replay, with_departure
from netkf.checks.statistics import (
    band_around,
    band_width,
    deviation_interval,
    probability_interval,
    round_digits,
)
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, IntArray
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.gossip.matchings import effective_matching
from netkf.trace.run import Run

WINDOW = 40
"""Last readings of a pair from which its bound is computed."""
UNKNOWN = 1e9
"""Root of a covariance that is above all others: nothing is known of the state."""
FAR_START = 30.0
"""Factor of the roots of P(0) in the other start, about a thousand times the covariance."""
MIN_TOKENS = 100
"""Chains that start at one node below which their law is not compared."""
BOUND_TOLERANCE = 1e-8  # of P, relative: roundings of a long product
PROBABILITY_TOLERANCE = 0.05  # of a probability: smaller errors change no conclusion


@dataclass(frozen=True, eq=False)
class GossipSummary(ReplicaSummary):
    """Adds values at the K slots and at the last one; ``replayed`` is what G (10) makes of the
    swaps.

    bounds    : (K, N, n, n) bounds by the last readings of each pair, for any state before them
    tokens    : (N, n, n) covariance of each token at the last slot; arbitrary if pairs were copied
    moves     : number of slots, from slot 1 on, in which j handed its pair to i, for each pair of
                ``_pairs_to_count``
    slots     : number of slots counted in ``moves``
    """

    bounds: FloatArray
    tokens: FloatArray
    moves: np.ndarray
    slots: int


def _summarise(scenario: Scenario, run: Run) -> GossipSummary:
    """Return the summary of a run: exact errors, and P replayed along the paths of tokens."""
    slots = list(check_slots(scenario))
    sources, table = pair_sources(scenario, run, slots[-1]), gossip_modes(scenario)
    starts, n, sampled = initial_roots(scenario), scenario.plant.n, sampled_indices(scenario)
    replayed, bounds = [], []
    for slot in slots:
        history = trace_tokens(sources, slot)
        origin, path = history.origin[sampled], history.path[sampled]
        replayed.append(table.covariances(starts[origin], path, [slot])[0])
        recent = path[:, -WINDOW:]
        unknown = np.repeat(UNKNOWN * np.eye(n)[None], len(recent), axis=0)
        bounds.append(table.covariances(unknown, recent, [recent.shape[1]])[0])
    positions = token_positions(sources, slots[-1])
    holders = np.full(len(starts), -1) if positions is None else positions
    exact = vars(summarise_exactly(scenario, run)) | {"replayed": np.array(replayed)}
    return GossipSummary(
        **exact,
        bounds=np.array(bounds),
        tokens=run.P[-1, holders[sampled]],
        moves=_count_moves(scenario, sources[1 : slots[-1]]),
        slots=slots[-1] - 1,
    )


def _pairs_to_count(scenario: Scenario) -> tuple[IntArray, IntArray]:
    """Return the indices i and j of the pairs of nodes whose moves are counted: all pairs, or in a
    large network the ends of links, in both directions.
    """
    if len(sampled_indices(scenario)) == len(scenario.nodes):
        i, j = np.nonzero(~np.eye(len(scenario.nodes), dtype=bool))
        return i, j
    index = scenario.topology.index
    ends = [(index[a], index[b]) for a, b in scenario.topology.directions]
    i, j = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    return i, j


def _count_moves(scenario: Scenario, sources: np.ndarray) -> np.ndarray:
    """Return the number of slots (rows of ``sources``) in which j handed its pair to i."""
    size = len(scenario.nodes)
    codes, counts = np.unique(np.arange(size) * size + sources, return_counts=True)
    i, j = _pairs_to_count(scenario)
    if not len(codes):
        return np.zeros(len(i), dtype=int)
    found = np.minimum(np.searchsorted(codes, i * size + j), len(codes) - 1)
    return np.where(codes[found] == i * size + j, counts[found], 0)


class ChainSamples(NamedTuple):
    """S switched chains of G (20).

    P         : (K, S, n, n) covariances at the K slots
    restarted : (S, n, n) covariances at the last slot from another start
    positions : (S, slots) node of each chain in each slot
    """

    P: FloatArray
    restarted: FloatArray
    positions: np.ndarray


@dataclass(frozen=True)
class GossipSamples(RunSamples):
    """Adds samples of the switched chain, with which the laws of the runs are compared."""

    @cached_property
    def matching(self) -> FloatArray:
        """Abar (N, N) with the losses of the channel."""
        return effective_matching(self.scenario)

    @cached_property
    def reference(self) -> ChainSamples:
        """Samples of the switched chain of G (20)."""
        cls: Any = type(self)
        found: ChainSamples = kept_reference(cls, self.scenario, self.seed)
        return found

    def draw_reference(self) -> ChainSamples:
        """Return new samples of the switched chain, which do not depend on the runs."""
        slots = list(check_slots(self.scenario))
        return self._draw_paths("switched chain", slots, reference_count(self.scenario, 1))

    def _draw_paths(self, purpose: str, slots: list[int], count: int) -> ChainSamples:
        """Return samples of the chain after the given numbers of slots."""
        starts, random = initial_roots(self.scenario), Streams(self.seed).generator(purpose)
        positions = _draw_chains(self.matching, slots[-1], count, random)
        table, first = gossip_modes(self.scenario), starts[positions[:, 0]]
        far = FAR_START * first + np.eye(first.shape[-1])
        restarted = table.covariances(far, positions, slots[-1:])[0]
        return ChainSamples(table.covariances(first, positions, slots), restarted, positions)

    def later(self, slots: int) -> ChainSamples:
        """Return a few samples after half of ``slots`` and after all of them."""
        return self._draw_paths("later chain", [slots // 2, slots], MIN_CHAINS // 4)


def _draw_chains(
    matching: FloatArray, slots: int, count: int, random: np.random.Generator
) -> np.ndarray:
    """Return positions (count, slots) of stationary Markov chains with transition matrix Abar."""
    rows = np.cumsum(matching, axis=1)
    positions = np.empty((count, slots), dtype=int)
    # Abar is doubly stochastic, so the uniform law is stationary.
    positions[:, 0] = random.integers(len(matching), size=count)
    for t in range(1, slots):
        draws = random.random(count)[:, None]
        after = (draws >= rows[positions[:, t - 1]]).sum(axis=1)
        positions[:, t] = np.minimum(after, len(matching) - 1)
    return positions


def _walks_bound(samples: GossipSamples, level: float) -> Finding:
    """Compare P with its bound by the last readings of the pair, G Lemma 14."""
    P, bound = samples.runs.P, samples.runs.bounds
    size = np.trace(bound, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(P), bound - P, -np.inf)
        finite = np.isfinite(gap).all(axis=(-1, -2))
    below = np.full(finite.shape, np.inf)
    below[finite] = np.maximum(-np.linalg.eigvalsh(gap[finite])[..., 0], 0.0)
    detected = size < UNKNOWN
    largest = f"{size[detected].max():.4g}" if detected.any() else "none"
    message = (
        f"in {detected.mean():.0%} of all cases the last {WINDOW} readings detect the state; "
        f"largest trace of the bounds that they give: {largest}"
    )
    # The root of the bound is computed from one of size UNKNOWN, and has the roundings of that.
    terms = np.maximum(UNKNOWN * np.sqrt(size), samples.largest_terms(P))
    limits = size, terms, BOUND_TOLERANCE
    found = compare_identities(below, *limits, message)
    return with_departure(found, samples, below, limits)


def _tokens_move(samples: GossipSamples, level: float) -> Finding:
    """Compare counts of moves with Abar; slots are independent, so counts are binomial."""
    i, j = _pairs_to_count(samples.scenario)
    trials, totals = int(np.sum(samples.runs.slots)), samples.runs.moves.sum(axis=0)
    nodes = samples.scenario.nodes
    found = []
    for a, b, total in zip(i.tolist(), j.tolist(), totals, strict=True):
        moved = probability_interval(int(total), trials, level / len(i))
        deviation = deviation_interval(samples.matching[a, b], moved)
        found.append((deviation, f"from node {nodes[b]} to {nodes[a]}"))
    message = f"largest difference from Abar over {trials:,} slots"
    return find_largest(found, PROBABILITY_TOLERANCE, message)


def _random_sensor(samples: GossipSamples, level: float) -> Finding:
    """Compare a sensor of each run, drawn for each slot, with the switched chain, G (67)."""
    random = Streams(samples.seed).generator("random sensor")
    runs, nodes = np.arange(samples.count), len(samples.scenario.nodes)
    picks = random.integers(nodes, size=(len(check_slots(samples.scenario)), samples.count))
    pairs = [
        Pair(f"slot {slot}", samples.runs.P[runs, k, picks[k]], samples.reference.P[k])
        for k, slot in enumerate(check_slots(samples.scenario))
    ]
    return compare_laws(pairs, level, samples.first_trace)


def _each_sensor(samples: GossipSamples, level: float) -> Finding:
    """Compare law(Phat_n(t)) with law(Ptilde(t) given ptilde(t - 1) = n), from G (19)."""
    P, _, positions = samples.reference
    pairs = [
        Pair(
            f"slot {slot}, node {node}", samples.runs.P[:, k, i], P[k, positions[:, slot - 1] == i]
        )
        for k, slot in enumerate(check_slots(samples.scenario))
        for i, node in enumerate(samples.nodes)
    ]
    return compare_laws(pairs, level, samples.first_trace)


def _sensors_together(samples: GossipSamples, level: float) -> Finding:
    """Compare P(tr P_n >= x) at all sensors with the switched chain, at every time and for all x.

    Their mean over the sensors is that of the chain, G (67), which gives (28) and (29) in the
    limit; so none exceeds N times that of the chain, (27).
    """
    traces = np.trace(samples.runs.P, axis1=-2, axis2=-1)
    expected = np.trace(samples.reference.P, axis1=-2, axis2=-1)
    N, share = traces.shape[2], level / (2 * traces.shape[1])
    widths = band_width(len(traces), share / N), band_width(expected.shape[1], share)
    found = []
    for k, slot in enumerate(check_slots(samples.scenario)):
        points = round_digits(np.concatenate([traces[:, k].ravel(), expected[k]]))
        law = _share_from(expected[k], points)
        each = np.array([_share_from(traces[:, k, i], points) for i in range(N)])
        together = float(np.abs(each.mean(axis=0) - law).max())
        most = float(np.maximum(each / N - law, 0.0).max())
        for value, width, name in (
            (together, sum(widths), "all sensors together"),
            (most, widths[0] / N + widths[1], "one sensor's over N"),
        ):
            found.append((band_around(value, width), f"at slot {slot}, {name}"))
    return find_largest(found, LAW_TOLERANCE, "largest excess of P(tr P_n >= x)")


def _share_from(values: FloatArray, points: FloatArray) -> FloatArray:
    """Return the shares of a sample (S,) that are at least each of the points (K,)."""
    below = np.searchsorted(np.sort(round_digits(values)), points, "left")
    return np.asarray(1.0 - below / len(values))


def _check_tokens(samples: GossipSamples, level: float) -> Finding:
    """Compare each token at the end with the stationary switched chain, and to see if the horizon
    is too short with the chain that starts where the token does.
    """
    last, pairs = len(check_slots(samples.scenario)) - 1, []
    everywhere, origin = samples.reference.P[last], samples.reference.positions[:, 0]
    for i, node in enumerate(samples.nodes):
        own = samples.runs.tokens[:, i]
        pairs.append(Pair(f"token {node}", own, everywhere, everywhere[origin == i]))
    found = compare_laws(pairs, level, samples.first_trace)
    return with_horizon(samples, found, _token_memory, LAW_TOLERANCE) if found.early else found


def _check_initial_condition(samples: GossipSamples, level: float) -> Finding:
    """Compare each sensor at the end with the chain that is there and started a thousand times
    larger.
    """
    P, restarted, positions = samples.reference
    pairs = []
    for i, node in enumerate(samples.nodes):
        here = positions[:, -1] == i
        pairs.append(Pair(f"node {node}", samples.runs.P[:, -1, i], restarted[here], P[-1, here]))
    found = compare_laws(pairs, level, samples.first_trace)
    return with_horizon(samples, found, _start_memory, LAW_TOLERANCE) if found.early else found


def _check_bounded(samples: GossipSamples, level: float) -> Finding:
    """Compare the growth of the law of P at each sensor with that of the chain that is there."""
    runs, (drawn, _, positions) = samples.runs.P, samples.reference
    half = check_slots(samples.scenario)[-2]
    pairs, expected = [], []
    for i, node in enumerate(samples.nodes):
        pairs.append(Pair(f"node {node}", runs[:, -2, i], runs[:, -1, i]))
        before, after = positions[:, half - 1] == i, positions[:, -1] == i
        expected.append((drawn[-2, before], drawn[-1, after]))
    found = compare_growth(pairs, expected, level)
    return with_horizon(samples, found, _growth_of, LAW_TOLERANCE) if found.early else found


def _growth_of(chain: ChainSamples) -> float:
    """Return the growth of the law at a random sensor."""
    return max(interval.value for interval in growth(chain.P[-2], chain.P[-1], 0.5))


def _start_memory(chain: ChainSamples) -> float:
    """Return the distance of the law at a random sensor from that of another start."""
    return float(diagonal_distances(chain.P[-1], chain.restarted).max())


def _token_memory(chain: ChainSamples) -> float:
    """Return the largest distance of the law of a token from that of all."""
    last, origin = chain.P[-1], chain.positions[:, 0]
    starts = [start for start in np.unique(origin) if (origin == start).sum() >= MIN_TOKENS]
    return max(
        (float(diagonal_distances(last[origin == k], last).max()) for k in starts), default=math.nan
    )


CHAIN = ("every exchange is a swap", "slots are independent")
LAWS = (*CHAIN, "every node is watched")
STABLE = (*CHAIN, "G C.1", "G S.1", "G D.1")
ERGODIC = (*LAWS, "G C.1", "G S.1", "G D.1")
PROMISES = (
    Promise(
        "pairs are swapped first and updated after: P_n(t+1) = f_{p_n(t)}(P_n(t))",
        "G (10), (19), Proposition 7",
        (),
        check_replay,
        exact=True,
    ),
    Promise(
        "a walk that detects bounds the covariance that passes through it",
        "G Lemma 14",
        ("G D.1",),
        _walks_bound,
        exact=True,
    ),
    Promise(
        "tokens are Markov chains with transition matrix Abar",
        "G Proposition 6",
        CHAIN,
        _tokens_move,
    ),
    Promise(
        "a random sensor has the law of the switched chain, at every time",
        "G (67), Theorems 8 and 10 [i], Remark 9",
        LAWS,
        _random_sensor,
    ),
    Promise(
        "no sensor has more than N times the law of the switched chain, and all together have it",
        "G (27), (28), (29)",
        LAWS,
        _sensors_together,
    ),
    Promise(
        "each sensor has the law of the switched chain that is there",
        "derived from G (19)",
        LAWS,
        _each_sensor,
    ),
    Promise(
        "every token has the same law in the end",
        "G Theorem 10 [ii], (25)",
        ERGODIC,
        _check_tokens,
    ),
    Promise(
        "covariances are stochastically bounded: their laws do not grow any more",
        "G Theorem 10 [iii], (26)",
        STABLE,
        _check_bounded,
    ),
    Promise(
        "the law in the end does not depend on the start",
        "G Theorem 8",
        ERGODIC,
        _check_initial_condition,
    ),
    Promise(
        "errors have the covariance that swaps and readings give them",
        "G (8), (10), derived",
        ("exact errors are within reach",),
        check_error_covariance,
    ),
    Promise(
        "errors have no bias that the equations do not give them",
        "G (8), (10), derived",
        ("exact errors are within reach",),
        check_bias,
    ),
    Promise(
        "errors are as large as P says: the mean NEES is n",
        "G (9)",
        ("the filters know", "the filters start"),
        check_nees,
    ),
)


class GossipChecks(PaperChecks):
    """Promises of G, Propositions 6, 7, Theorems 8, 10."""

    summary_type = GossipSummary

    slots_only = True

    def summarise(self, scenario: Scenario, run: Run) -> GossipSummary:
        """Return the summary of a run whose samples are at ``check_slots``."""
        return _summarise(scenario, run)

    def collect(self, scenario: Scenario, stacked: Any, seed: int) -> GossipSamples:
        """Return the samples that the tests take, from stacked summaries."""
        return GossipSamples(scenario, stacked, seed)

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests beyond those of G."""
        try:
            effective_matching(scenario)
            known, why = True, "drawn afresh in each slot, and lost with a known probability"
        except TheoryError as error:
            known, why = False, str(error)
        return [
            Assumption("slots are independent and Abar is known", "G II-A", known, why),
            exact_start(scenario),
            few_errors(scenario),
            all_sampled(scenario),
        ]

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return PROMISES


CHECKS = GossipChecks()
