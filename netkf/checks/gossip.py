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
    growth_intervals,
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
"""Number of last readings of a pair from which its bound is computed."""
UNKNOWN = 1e9
"""Standard deviation of each state that stands for an unknown state."""
FAR_START = 30.0
"""Factor on the roots of P(0) in a second start, whose covariance is about 1000 times larger."""
MIN_TOKENS = 100
"""Number of chains that start at one node below which their law is not compared."""
BOUND_TOLERANCE = 1e-8  # of P, relative: rounding of a long product
PROBABILITY_TOLERANCE = 0.05  # of a probability: smaller errors change no conclusion


@dataclass(frozen=True, eq=False)
class GossipSummary(ReplicaSummary):
    """Adds values at the K slots and at the last one; ``replayed`` is the recursion G (10) along
    the swaps of the run.

    bounds    : (K, N, n, n) covariances from the last WINDOW readings of each pair alone
    tokens    : (N, n, n) covariance of each token at the last slot; arbitrary if pairs were copied
    moves     : number of slots, from slot 1 on, in which j handed its pair to i, for each (i, j) of
                :func:`_pairs_to_count`
    slots     : number of slots counted in ``moves``
    """

    bounds: FloatArray
    tokens: FloatArray
    moves: np.ndarray
    slots: int


def _summarise(scenario: Scenario, run: Run) -> GossipSummary:
    """Return the summary of a run at K slots and N sampled nodes: exact errors, and P (K, N, n, n)
    replayed along the paths of tokens.
    """
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
    """Return the indices i and j, (K,) each, of the K pairs of nodes whose moves are counted: all
    pairs, or in a large network the ends of links, in both directions.
    """
    if len(sampled_indices(scenario)) == len(scenario.nodes):
        i, j = np.nonzero(~np.eye(len(scenario.nodes), dtype=bool))
        return i, j
    index = scenario.topology.index
    ends = [(index[a], index[b]) for a, b in scenario.topology.directions]
    i, j = np.array(ends, dtype=np.int64).reshape(-1, 2).T
    return i, j


def _count_moves(scenario: Scenario, sources: np.ndarray) -> np.ndarray:
    """Return the number (K,) of slots in which j handed its pair to i, for each of the K pairs
    (i, j) that are counted; ``sources`` (slots, N) is the node whose pair each node used in each
    slot.
    """
    size = len(scenario.nodes)
    codes, counts = np.unique(np.arange(size) * size + sources, return_counts=True)
    i, j = _pairs_to_count(scenario)
    if not len(codes):
        return np.zeros(len(i), dtype=int)
    positions = np.minimum(np.searchsorted(codes, i * size + j), len(codes) - 1)
    return np.where(codes[positions] == i * size + j, counts[positions], 0)


class ChainSamples(NamedTuple):
    """S simulations of the switched chain of G (20): a pair whose node is a Markov chain with
    transition matrix Abar, and whose covariance that node's reading updates.

    P         : (K, S, n, n) covariances at the K slots
    restarted : (S, n, n) covariances at the last slot from a start about 1000 times larger
    positions : (S, slots) node of each chain in each slot
    """

    P: FloatArray
    restarted: FloatArray
    positions: np.ndarray


@dataclass(frozen=True)
class GossipSamples(RunSamples):
    """Adds samples of the switched chain, the reference for the laws of the runs."""

    @cached_property
    def matching(self) -> FloatArray:
        """Mean matching Abar (N, N), with the losses of the channel."""
        return effective_matching(self.scenario)

    @cached_property
    def reference(self) -> ChainSamples:
        """Samples of the switched chain of G (20)."""
        cls: Any = type(self)
        chains: ChainSamples = kept_reference(cls, self.scenario, self.seed)
        return chains

    def draw_reference(self) -> ChainSamples:
        """Return the samples of :attr:`reference`, drawn from a stream of their own."""
        slots = list(check_slots(self.scenario))
        return self._draw_paths("switched chain", slots, reference_count(self.scenario, 1))

    def _draw_paths(self, purpose: str, slots: list[int], count: int) -> ChainSamples:
        """Return S = ``count`` chains, with their covariances (K, S, n, n) after K numbers of
        ``slots``; ``purpose`` names the random stream that they are drawn from.
        """
        starts, random = initial_roots(self.scenario), Streams(self.seed).generator(purpose)
        positions = _draw_chains(self.matching, slots[-1], count, random)
        table, start_roots = gossip_modes(self.scenario), starts[positions[:, 0]]
        larger_roots = FAR_START * start_roots + np.eye(start_roots.shape[-1])
        restarted = table.covariances(larger_roots, positions, slots[-1:])[0]
        return ChainSamples(table.covariances(start_roots, positions, slots), restarted, positions)

    def later(self, slots: int) -> ChainSamples:
        """Return a few samples after half of ``slots`` and after all of them."""
        return self._draw_paths("later chain", [slots // 2, slots], MIN_CHAINS // 4)


def _draw_chains(
    matching: FloatArray, slots: int, count: int, random: np.random.Generator
) -> np.ndarray:
    """Return positions (count, slots) of stationary Markov chains with transition matrix
    ``matching`` (N, N), by inversion of its cumulative rows.
    """
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
    """Check P <= bound, the covariance from the last WINDOW readings of the pair, G Lemma 14.

    No interval is estimated, so that ``level`` is not used.
    """
    P, bound = samples.runs.P, samples.runs.bounds
    size = np.trace(bound, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        gap = np.where(np.isfinite(P), bound - P, -np.inf)
        finite = np.isfinite(gap).all(axis=(-1, -2))
    shortfall = np.full(finite.shape, np.inf)
    shortfall[finite] = np.maximum(-np.linalg.eigvalsh(gap[finite])[..., 0], 0.0)
    detected = size < UNKNOWN
    largest = f"{size[detected].max():.4g}" if detected.any() else "none"
    message = (
        f"in {detected.mean():.0%} of all cases the last {WINDOW} readings detect the state; "
        f"largest trace of the bounds that they give: {largest}"
    )
    # The root of the bound is computed from one of size UNKNOWN, whose rounding errors it inherits.
    terms = np.maximum(UNKNOWN * np.sqrt(size), samples.largest_terms(P))
    limits = size, terms, BOUND_TOLERANCE
    finding = compare_identities(shortfall, *limits, message)
    return with_departure(finding, samples, shortfall, limits)


def _tokens_move(samples: GossipSamples, level: float) -> Finding:
    """Test the null hypothesis that j hands its pair to i with probability Abar_ij, independently
    in each slot: then the numbers of moves are binomial.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
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
    """Compare the law of P at a random sensor with that of the switched chain, G (67).

    The sensor is drawn anew for each run and slot, so that each run gives one independent value.
    The interval of the finding misses the truth with at most the probability ``level``.
    """
    random = Streams(samples.seed).generator("random sensor")
    runs, nodes = np.arange(samples.count), len(samples.scenario.nodes)
    picks = random.integers(nodes, size=(len(check_slots(samples.scenario)), samples.count))
    pairs = [
        Pair(f"slot {slot}", samples.runs.P[runs, k, picks[k]], samples.reference.P[k])
        for k, slot in enumerate(check_slots(samples.scenario))
    ]
    return compare_laws(pairs, level, samples.first_trace)


def _each_sensor(samples: GossipSamples, level: float) -> Finding:
    """Compare law(Phat_n(t)) with law(Ptilde(t) given ptilde(t - 1) = n), from G (19).

    The interval of the finding misses the truth with at most the probability ``level``.
    """
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
    """Compare P(tr P_n >= x) at all sensors n with the switched chain, at every time and for all x.

    Its mean over the sensors equals that of the chain, G (67), which gives (28) and (29) in the
    limit; hence it exceeds N times that of the chain at no sensor, (27). Both comparisons use bands
    around empirical distribution functions (:func:`band_width`). The interval of the finding misses
    the truth with at most the probability ``level``.
    """
    traces = np.trace(samples.runs.P, axis1=-2, axis2=-1)
    expected = np.trace(samples.reference.P, axis1=-2, axis2=-1)
    N, band_level = traces.shape[2], level / (2 * traces.shape[1])
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
    """Return the shares (K,) of a sample ``values`` (S,) that are at least each of the ``points``
    (K,).
    """
    below = np.searchsorted(np.sort(round_digits(values)), points, "left")
    return np.asarray(1.0 - below / len(values))


def _check_tokens(samples: GossipSamples, level: float) -> Finding:
    """Compare the law of each token at the end with that of the stationary switched chain.

    Chains that start where the token does have the exact law at this time; their distance from the
    stationary one tells whether the horizon is long enough. The interval of the finding misses the
    truth with at most the probability ``level``.
    """
    last, pairs = len(check_slots(samples.scenario)) - 1, []
    chain, origin = samples.reference.P[last], samples.reference.positions[:, 0]
    for i, node in enumerate(samples.nodes):
        token_covariances = samples.runs.tokens[:, i]
        pairs.append(Pair(f"token {node}", token_covariances, chain, chain[origin == i]))
    finding = compare_laws(pairs, level, samples.first_trace)
    if not finding.early:
        return finding
    return with_horizon(samples, finding, _token_memory, LAW_TOLERANCE)


def _check_initial_condition(samples: GossipSamples, level: float) -> Finding:
    """Compare the law at each sensor at the end with that of chains at this sensor that started
    with a covariance about 1000 times larger.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    P, restarted, positions = samples.reference
    pairs = []
    for i, node in enumerate(samples.nodes):
        here = positions[:, -1] == i
        pairs.append(Pair(f"node {node}", samples.runs.P[:, -1, i], restarted[here], P[-1, here]))
    finding = compare_laws(pairs, level, samples.first_trace)
    return (
        with_horizon(samples, finding, _start_memory, LAW_TOLERANCE) if finding.early else finding
    )


def _check_bounded(samples: GossipSamples, level: float) -> Finding:
    """Compare the growth of the law of P at each sensor with that of the chains at this sensor.

    The interval of the finding misses the truth with at most the probability ``level``.
    """
    runs, (chain, _, positions) = samples.runs.P, samples.reference
    half = check_slots(samples.scenario)[-2]
    pairs, expected = [], []
    for i, node in enumerate(samples.nodes):
        pairs.append(Pair(f"node {node}", runs[:, -2, i], runs[:, -1, i]))
        at_half, at_end = positions[:, half - 1] == i, positions[:, -1] == i
        expected.append((chain[-2, at_half], chain[-1, at_end]))
    finding = compare_growth(pairs, expected, level)
    return with_horizon(samples, finding, _growth_of, LAW_TOLERANCE) if finding.early else finding


def _growth_of(chain: ChainSamples) -> float:
    """Return the growth of the law of the chain between the last two numbers of slots."""
    return max(interval.value for interval in growth_intervals(chain.P[-2], chain.P[-1], 0.5))


def _start_memory(chain: ChainSamples) -> float:
    """Return the distance between the laws of the chain at the last slot from the two starts."""
    return float(diagonal_distances(chain.P[-1], chain.restarted).max())


def _token_memory(chain: ChainSamples) -> float:
    """Return the largest distance between the law of chains that start at one node and that of all
    chains, at the last slot; nan if all nodes have fewer than MIN_TOKENS chains.
    """
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
        """Return the samples that the tests take, from stacked summaries of the runs of
        ``seed``.
        """
        return GossipSamples(scenario, stacked, seed)

    def assumptions(self, scenario: Scenario) -> list[Assumption]:
        """Return the assumptions of the tests beyond those of G."""
        try:
            effective_matching(scenario)
            is_known, evidence = (
                True,
                "drawn afresh in each slot, and lost with a known probability",
            )
        except TheoryError as error:
            is_known, evidence = False, str(error)
        return [
            Assumption("slots are independent and Abar is known", "G II-A", is_known, evidence),
            exact_start(scenario),
            few_errors(scenario),
            all_sampled(scenario),
        ]

    def promises(self, scenario: Scenario) -> tuple[Promise, ...]:
        """Return the promises about a scenario."""
        return PROMISES


CHECKS = GossipChecks()
