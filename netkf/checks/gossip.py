"""Promises of G about the gossip filter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from netkf.checks.equations import error_promises
from netkf.checks.evidence import Assumption, Finding, Promise
from netkf.checks.exact import check_nees, summarise_exactly
from netkf.checks.laws import (
    FIXED_READINGS,
    LAW_TOLERANCE,
    Pair,
    diagonal_distances,
    find_largest,
    fixed_readings,
)
from netkf.checks.mode_sequences import (
    MIN_CHAINS,
    Reference,
    SwitchedReference,
    check_bounded,
    check_law,
    check_start,
    far_roots,
    gossip_modes,
    initial_roots,
    pair_sources,
    reference_count,
    token_positions,
    trace_tokens,
)
from netkf.checks.paper import PaperChecks, usual_assumptions
from netkf.checks.samples import (
    ReplicaSummary,
    all_sampled,
    check_replay,
    check_slots,
    compare_points,
    sampled_indices,
)
from netkf.checks.statistics import band_around, band_width, round_digits
from netkf.core.errors import TheoryError
from netkf.laws.intervals import deviation_interval, probability_interval
from netkf.linalg.arrays import FloatArray, IntArray, row_units
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.gossip.matchings import effective_matching
from netkf.trace.run import Run

WINDOW = 40
"""Number of last readings that updated a pair (estimate, covariance) from which the bound on its
covariance is computed.
"""
UNKNOWN = 1e9
"""Deviation that stands for an unknown state, in units of the largest one of its estimates."""
MIN_TOKENS = 100
"""Number of chains that start at one node below which their law is not compared."""
BOUND_TOLERANCE = 1e-8  # of P, relative: rounding of a long product
PROBABILITY_TOLERANCE = 0.05  # of a probability: smaller errors change no conclusion


def _summarise(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return the summary of a run, with the recursion of the gossip paper, G (10), in it."""
    # Of K slots, N sampled nodes and the M pairs of _pairs_to_count, along the swaps of the run:
    # bounds (K, N, n, n)  covariances that the last WINDOW readings of each node's pair give alone,
    #                      from an unknown state on: upper bounds on P
    # tokens (N, n, n)     covariance at the last slot of the pair that started at each node;
    #                      arbitrary if pairs were copied, not swapped
    # moves (M,)           number of slots, from slot 1 on, in which j handed its pair to i
    slots, summary = list(check_slots(scenario)), summarise_exactly(scenario, run)
    sources = pair_sources(scenario, run, slots[-1])
    summary.moves = _count_moves(scenario, sources[1 : slots[-1]])
    summary.slots = slots[-1] - 1
    if not fixed_readings(scenario).holds:
        summary.bounds = np.full(summary.P.shape, np.nan)
        summary.tokens = summary.bounds[0]
        return summary
    table = gossip_modes(scenario)
    # Square roots of P(0), (N', n, n) for all N' nodes.
    starts, sampled = initial_roots(scenario), sampled_indices(scenario)
    variances = np.nan_to_num(np.diagonal(run.P, axis1=-2, axis2=-1), posinf=0.0).max(axis=(0, 1))
    units = row_units(np.maximum(variances, np.square(starts).sum(axis=-1).max(axis=0)))
    replayed, bounds = [], []
    for slot in slots:
        # Where the pairs that the nodes hold now started, and the nodes that they were at since.
        history = trace_tokens(sources, slot)
        origin, path = history.origin[sampled], history.path[sampled]
        replayed.append(table.covariances(starts[origin], path, [slot])[0])
        # The bound: the same recursion over the last readings only, from an unknown state on.
        recent = path[:, -WINDOW:]
        unknown = np.repeat(UNKNOWN * np.diag(units)[None], len(recent), axis=0)
        bounds.append(table.covariances(unknown, recent, [recent.shape[1]])[0])
    # The node that holds each token at the end; any node if pairs were copied, since then the
    # replay differs from P and the covariances of tokens mean nothing.
    positions = token_positions(sources, slots[-1])
    holders = np.full(len(starts), -1) if positions is None else positions
    summary.replayed, summary.bounds = np.array(replayed), np.array(bounds)
    summary.tokens = run.P[-1, holders[sampled]]
    return summary


def _pairs_to_count(scenario: Scenario) -> tuple[IntArray, IntArray]:
    """Return the indices (M,) of pairs of nodes whose moves are counted: all, or links."""
    if len(sampled_indices(scenario)) == len(scenario.nodes):
        i, j = np.nonzero(~np.eye(len(scenario.nodes), dtype=bool))
        return i, j
    i, j = scenario.topology.direction_ends.T
    return i, j


def _count_moves(scenario: Scenario, sources: np.ndarray) -> np.ndarray:
    """Return the number (M,) of slots in which j handed its pair to i."""
    # The move of a pair from j to i is coded as the number i N + j.
    size = len(scenario.nodes)
    codes, counts = np.unique(np.arange(size) * size + sources, return_counts=True)
    i, j = _pairs_to_count(scenario)
    if not len(codes):
        return np.zeros(len(i), dtype=int)
    positions = np.minimum(np.searchsorted(codes, i * size + j), len(codes) - 1)
    return np.where(codes[positions] == i * size + j, counts[positions], 0)


@dataclass(frozen=True)
class GossipSamples(SwitchedReference):
    """Adds simulations of the switched chain of paper G (20): the node that holds one pair
    (estimate, covariance) is a Markov chain with transition matrix Abar (the mean matching: entry
    (i, j) is the probability that i gets j's pair in a slot), and then uses that node's reading.
    """

    @cached_property
    def matching(self) -> FloatArray:
        """Abar (N, N): the probability that i gets j's pair in a slot, with losses."""
        return effective_matching(self.scenario)

    def draw_reference(self) -> Reference:
        """Return chains at the checked slots: one law, that of one which wanders over all nodes."""
        slots = list(check_slots(self.scenario))
        return self._draw_paths("switched chain", slots, reference_count(self.scenario, laws=1))

    def later(self, slots: int) -> Reference:
        """Return a few chains after half of ``slots`` and after all of them."""
        return self._draw_paths("later chain", [slots // 2, slots], MIN_CHAINS // 4)

    def _draw_paths(self, purpose: str, slots: list[int], count: int) -> Reference:
        # Square roots of P(0) (N, n, n), which the recursions work with.
        starts, random = initial_roots(self.scenario), Streams(self.seed).generator(purpose)
        positions = _draw_chains(self.matching, slots[-1], count, random)
        table, start_roots = gossip_modes(self.scenario), starts[positions[:, 0]]
        restarted = table.covariances(far_roots(start_roots), positions, slots[-1:])[0]
        P = table.covariances(start_roots, positions, slots)
        last = positions[:, np.array(slots) - 1].T
        return Reference(P[None], restarted[None], at_node=last, first=positions[:, 0])


def _draw_chains(
    matching: FloatArray, slots: int, count: int, random: np.random.Generator
) -> np.ndarray:
    """Return the node indices (count, slots) of ``count`` stationary Markov chains in each slot."""
    cumulative = np.cumsum(matching, axis=1)
    positions = np.empty((count, slots), dtype=int)
    # Abar is doubly stochastic, so the uniform law is stationary.
    positions[:, 0] = random.integers(len(matching), size=count)
    for t in range(1, slots):
        uniforms = random.random(count)[:, None]
        next_node = (uniforms >= cumulative[positions[:, t - 1]]).sum(axis=1)
        positions[:, t] = np.minimum(next_node, len(matching) - 1)
    return positions


def _walks_bound(samples: GossipSamples, level: float) -> Finding:
    """Check that no P of the runs (R, K, N, n, n) exceeds its bound, paper G Lemma 14."""
    P, bound = samples.in_units(samples.runs.P), samples.in_units(samples.runs.bounds)
    size = np.trace(bound, axis1=-2, axis2=-1)
    # A covariance that is not finite exceeds every bound.
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(P), bound - P, -np.inf)
        finite = np.isfinite(gap).all(axis=(-1, -2))
    shortfall = np.full(finite.shape, np.inf)
    shortfall[finite] = np.maximum(-np.linalg.eigvalsh(gap[finite])[..., 0], 0.0)
    detected = size < UNKNOWN  # far below UNKNOWN^2, the variance of an unknown state
    traces = np.trace(samples.runs.bounds, axis1=-2, axis2=-1)
    largest = f"{traces[detected].max():.4g}" if detected.any() else "none"
    message = (
        f"in {detected.mean():.0%} of all cases the last {WINDOW} readings detect the state; "
        f"largest trace of the bounds that they give: {largest}"
    )
    # The root of the bound is computed from one of size UNKNOWN, whose rounding errors it inherits.
    terms = np.maximum(UNKNOWN * np.sqrt(size), samples.largest_terms(samples.runs.P))
    # Size of the values, of the terms whose rounding errors they inherit, and relative tolerance.
    limits = size, terms, BOUND_TOLERANCE
    return compare_points(samples, shortfall, limits, message)


def _move(samples: GossipSamples, level: float) -> Finding:
    i, j = _pairs_to_count(samples.scenario)
    trials, totals = int(np.sum(samples.runs.slots)), samples.runs.moves.sum(axis=0)
    nodes = samples.scenario.nodes
    intervals = []
    for a, b, total in zip(i.tolist(), j.tolist(), totals, strict=True):
        probability = probability_interval(int(total), trials, level / len(i))
        distance = deviation_interval(samples.matching[a, b], probability)
        intervals.append((distance, f"from node {nodes[b]} to {nodes[a]}"))
    message = f"largest difference from Abar over {trials:,} slots"
    return find_largest(intervals, PROBABILITY_TOLERANCE, message)


def _random_sensor(samples: GossipSamples, level: float) -> Finding:
    """Compare the law of P at a random node with that of the switched chain, G (67)."""
    random = Streams(samples.seed).generator("random sensor")
    runs, nodes = np.arange(samples.count), len(samples.scenario.nodes)
    picks = random.integers(nodes, size=(len(check_slots(samples.scenario)), samples.count))
    pairs = [
        Pair(f"slot {slot}", samples.runs.P[runs, k, picks[k]], samples.reference.P[0, k])
        for k, slot in enumerate(check_slots(samples.scenario))
    ]
    return samples.compare_laws(pairs, level)


def _sensors_together(samples: GossipSamples, level: float) -> Finding:
    """Compare P(tr P_n >= x) of all nodes with that of the switched chain, for all x."""
    traces = np.trace(samples.runs.P, axis1=-2, axis2=-1)
    expected = np.trace(samples.reference.P[0], axis1=-2, axis2=-1)
    N, band_level = traces.shape[2], level / (2 * traces.shape[1])
    # Half widths of the bands around the law at one node and around that of the chain.
    widths = band_width(len(traces), band_level / N), band_width(expected.shape[1], band_level)
    intervals = []
    for k, slot in enumerate(check_slots(samples.scenario)):
        points = round_digits(np.concatenate([traces[:, k].ravel(), expected[k]]))
        law = _share_from(expected[k], points)
        shares = np.array([_share_from(traces[:, k, i], points) for i in range(N)])
        mean_distance = float(np.abs(shares.mean(axis=0) - law).max())
        largest_excess = float(np.maximum(shares / N - law, 0.0).max())
        for value, width, name in (
            (mean_distance, sum(widths), "all sensors together"),
            (largest_excess, widths[0] / N + widths[1], "one sensor's over N"),
        ):
            intervals.append((band_around(value, width), f"at slot {slot}, {name}"))
    return find_largest(intervals, LAW_TOLERANCE, "largest excess of P(tr P_n >= x)")


def _share_from(values: FloatArray, points: FloatArray) -> FloatArray:
    """Return for each of ``points`` (V,) the share of ``values`` (S,) at least as large."""
    below = np.searchsorted(np.sort(round_digits(values)), points, "left")
    return np.asarray(1.0 - below / len(values))


def _token_memory(chains: Reference) -> float:
    """Return the largest distance of the law of chains from one node to that of all."""
    last, origin = chains.P[0, -1], chains.first
    starts = [start for start in np.unique(origin) if (origin == start).sum() >= MIN_TOKENS]
    distances = (float(diagonal_distances(last[origin == k], last).max()) for k in starts)
    return max(distances, default=math.nan)


def _check_tokens(samples: GossipSamples, level: float) -> Finding:
    last, pairs = len(check_slots(samples.scenario)) - 1, []
    chain, origin = samples.reference.P[0, last], samples.reference.first
    for i, node in enumerate(samples.nodes):
        pairs.append(Pair(f"token {node}", samples.runs.tokens[:, i], chain, chain[origin == i]))
    return samples.with_horizon(samples.compare_laws(pairs, level), _token_memory)


# What promises need: parts of names or sources in the table of assumptions, see ``Promise.needs``.
CHAIN = ("every exchange is a swap", "slots are independent")
LAWS = (*CHAIN, "every node is watched", FIXED_READINGS)
STABLE = (*CHAIN, "G C.1", "G S.1", "G D.1", FIXED_READINGS)
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
        ("G D.1", FIXED_READINGS),
        _walks_bound,
        exact=True,
    ),
    Promise(
        "tokens are Markov chains with transition matrix Abar", "G Proposition 6", CHAIN, _move
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
        check_law,
    ),
    Promise(
        "every token has the same law in the end", "G Theorem 10 [ii], (25)", ERGODIC, _check_tokens
    ),
    Promise(
        "covariances are stochastically bounded: their laws do not grow any more",
        "G Theorem 10 [iii], (26)",
        STABLE,
        check_bounded,
    ),
    Promise("the law in the end does not depend on the start", "G Theorem 8", ERGODIC, check_start),
    *error_promises("G (8), (10), derived", by="swaps and readings give them"),
    Promise(
        "errors are as large as P says: the mean NEES is n",
        "G (9)",
        ("the filters know", "the filters start"),
        check_nees,
    ),
)


def _assumptions(scenario: Scenario) -> list[Assumption]:
    is_known, evidence = True, "drawn afresh in each slot, and lost with a known probability"
    try:
        effective_matching(scenario)
    except TheoryError as error:
        is_known, evidence = False, str(error)
    return [
        Assumption("slots are independent and Abar is known", "G II-A", is_known, evidence),
        *usual_assumptions(scenario),
        fixed_readings(scenario),
        all_sampled(scenario),
    ]


CHECKS = PaperChecks(lambda _: PROMISES, _assumptions, _summarise, GossipSamples, slots_only=True)
