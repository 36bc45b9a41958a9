"""Promises of R about the filter with intermittent observations."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from netkf.algorithms.kernels.chains import trace_paths
from netkf.checks.equations import error_promises
from netkf.checks.evidence import COMPUTED, Assumption, Finding, Promise, compare_identities
from netkf.checks.exact import check_nees, summarise_exactly
from netkf.checks.laws import FIXED_READINGS, LAW_TOLERANCE, find_largest, fixed_readings
from netkf.checks.mode_sequences import (
    FAR_START,
    MIN_CHAINS,
    ModeTable,
    Reference,
    SwitchedReference,
    check_bounded,
    check_law,
    check_start,
    far_roots,
    find_arrivals,
    initial_roots,
    intermittent_modes,
    reference_count,
    sensing_neighbours,
)
from netkf.checks.paper import PaperChecks, usual_assumptions
from netkf.checks.samples import (
    ReplicaSummary,
    check_replay,
    check_slots,
    compare_points,
    first_covariances,
    sampled_indices,
    sampled_nodes,
)
from netkf.checks.statistics import distance_to_law, law_distance, pearson_test
from netkf.core.errors import TheoryError
from netkf.laws.intervals import deviation_interval, probability_interval
from netkf.linalg.arrays import FloatArray, row_units
from netkf.linalg.spectra import contracts, growth_factor
from netkf.network.matchings import Broadcast
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.common.random_links import arrival_of
from netkf.theory.intermittent.averages import mean_covariance_bounds
from netkf.theory.intermittent.riccati import steady_covariance
from netkf.theory.intermittent.scalar_law import ScalarLaw, scalar_law
from netkf.trace.run import Run
from netkf.trace.schema import rows_of

BOUND_TOLERANCE, SUPPORT_TOLERANCE = 1e-8, 1e-6
"""Relative to tr P: shortfall below the path without losses that rounding may cause in any case;
and the same for the distance from a point of the support, and the spread that counts as vanished.
"""
PROBABILITY_TOLERANCE = 0.05
"""Tolerated error of the share of readings that arrive; twice that in cells of a scalar law."""
MAX_PATHS = 2000
"""Number of reference paths whose averages over the slots are compared with those of the runs."""
CELLS = 12
"""Number of cells between holes of the scalar law; all longer outages form one further cell."""
Direction = tuple[int, int]


def _heard_directions(scenario: Scenario) -> list[Direction]:
    """Return (sender, receiver) of all D directed links that can carry readings."""
    senders = sensing_neighbours(scenario)
    return [(sender, node) for node in scenario.nodes for sender in senders[node]]


@lru_cache(maxsize=8)
def _least_roots(scenario: Scenario) -> FloatArray:
    """Return for each sampled node the Cholesky root (n, n) of P*, nan without one."""
    # Without losses all slots are alike: one slot has the readings of each node.
    table, sequences = find_arrivals(scenario, None, slots=1)
    (F, Q), n, modes = scenario.slot_belief, scenario.plant.n, table.modes
    roots = np.full((len(sequences), n, n), np.nan)
    for k, mode in enumerate(sequences[:, 0].tolist()):
        p = int(modes.rows[mode])
        try:
            # Whitened rows have noise of variance 1.
            roots[k] = np.linalg.cholesky(steady_covariance(F, Q, modes.H[mode, :p], np.eye(p)))
        except (TheoryError, np.linalg.LinAlgError):
            continue
    return roots


def _summarise(scenario: Scenario, run: Run) -> ReplicaSummary:
    """Return the summary of a run, with the recursion R (15)-(18) of the readings that arrived."""
    # Of N sampled nodes and the D directed links that can carry readings, with the same readings:
    # in_support (N, n, n) P from the start P*, the steady covariance of a node that gets all
    #                      readings: a point of the support of the invariant law, R Theorem 10
    # spread (N, n, n)     the difference between P from a very large start and P from 0;
    #                      the recursion is monotone: any other start ends between these two
    # averages (N,)        averages of u / (u + tr P), u = tr Q, over the second half of the slots
    # sent, arrived (D,)   readings sent and delivered in time
    slots, summary = list(check_slots(scenario)), summarise_exactly(scenario, run)
    last = slots[-1:]
    summary.sent = _count_messages(scenario, run, "send", slots[-1])
    summary.arrived = _count_messages(scenario, run, "deliver", slots[-1])
    if not fixed_readings(scenario).holds:
        summary.in_support = np.full(summary.P[-1].shape, np.nan)
        summary.spread, summary.averages = summary.in_support, summary.in_support[:, 0, 0]
        return summary
    table, sequences = find_arrivals(scenario, run, slots[-1])
    # Roots of the covariances at the start, (W, n, n) each.
    starts = initial_roots(scenario)[sampled_indices(scenario)]
    steady_roots = _least_roots(scenario)
    larger_roots = _roots_above(starts, np.nan_to_num(steady_roots))
    from_above = table.covariances(larger_roots, sequences, last)[0]
    from_zero = table.covariances(np.zeros(starts.shape), sequences, last)[0]
    summary.replayed = table.covariances(starts, sequences, slots)
    summary.in_support = table.covariances(steady_roots, sequences, last)[0]
    summary.spread = from_above - from_zero
    summary.averages = _path_averages(table, starts, sequences)
    return summary


def _roots_above(*roots: FloatArray) -> FloatArray:
    """Return roots (W, n, n) of a start covariance far above all of the given ones."""
    total = sum(root @ np.swapaxes(root, -1, -2) for root in roots)
    units = row_units(np.diagonal(total, axis1=-2, axis2=-1))
    above = FAR_START**2 * total + np.eye(units.shape[-1]) * np.square(units)[..., None]
    return np.asarray(np.linalg.cholesky(above), dtype=np.float64)


def _count_messages(scenario: Scenario, run: Run, kind: str, slots: int) -> np.ndarray:
    """Return how many readings have events of a ``kind`` on each direction in the first slots."""
    # In the log a message is sent by the node of its row, but delivered to it.
    sender, receiver = ("node", "peer") if kind == "send" else ("peer", "node")
    rows = rows_of(run.log, kind)
    rows = rows[scenario.slot_plant.slots_of(rows["t"]) < slots]
    counts = Counter(zip(rows[sender].tolist(), rows[receiver].tolist(), strict=True))
    return np.array([counts[pair] for pair in _heard_directions(scenario)], dtype=int)


def _path_averages(table: ModeTable, roots: FloatArray, sequences: np.ndarray) -> FloatArray:
    """Return for each of K filters the average of ``u / (u + tr P)`` over half of the slots; u is
    tr Q, or that of the start if Q is 0.
    """
    first, averages = sequences.shape[1] // 2, []
    for root, all_slots in zip(roots, trace_paths(roots, sequences, *table), strict=True):
        path = all_slots[first:]  # (slots, n, n) roots S with P = S S', so tr P is their square sum
        unit = float((table.root_Q**2).sum() or (root**2).sum() or 1.0)
        averages.append(float((unit / (unit + np.einsum("tab,tab->t", path, path))).mean()))
    return np.array(averages)


@dataclass(frozen=True)
class IntermittentSamples(SwitchedReference):
    """Adds simulated covariances of each node, to which readings arrive independently, with the
    delivery probabilities that the scenario states, paper R (12).
    """

    def draw_reference(self) -> Reference:
        """Return covariances at the checked slots, drawn from random streams of their own."""
        count = reference_count(self.scenario, laws=len(self.nodes))
        return self._draw_arrivals("arrivals", list(check_slots(self.scenario)), count, MAX_PATHS)

    def later(self, slots: int) -> Reference:
        """Return a few covariances after half of ``slots`` and all of them, without averages."""
        halves, samples = [slots // 2, slots], MIN_CHAINS // 4
        return self._draw_arrivals("later arrivals", halves, samples, paths=0)

    def _draw_arrivals(self, purpose: str, slots: list[int], samples: int, paths: int) -> Reference:
        sampled = sampled_indices(self.scenario).tolist()
        per_node = [self._draw_node(purpose, k, slots, samples, paths) for k in sampled]
        return Reference(*(np.array(values) for values in zip(*per_node, strict=True)))

    def _draw_node(
        self, purpose: str, k: int, slots: list[int], samples: int, paths: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        scenario = self.scenario
        node = scenario.nodes[k]
        senders = sensing_neighbours(scenario)[node]
        random = Streams(self.seed).generator(purpose, node)
        probabilities = np.array([_delivery_probability(scenario, (j, node)) for j in senders])
        arrived = random.random((samples, slots[-1], len(senders))) < probabilities
        # A set of readings is coded as a bit mask over the senders. Only sets that occur become
        # modes, since there may be 2^len(senders).
        codes = arrived @ (1 << np.arange(len(senders)))
        occurring, sequences = np.unique(codes, return_inverse=True)
        own_reading = (node,) if node in scenario.placed_sensors else ()
        sets = [
            (*own_reading, *(sender for bit, sender in enumerate(senders) if code >> bit & 1))
            for code in occurring.tolist()
        ]
        table, sequences = intermittent_modes(scenario, sets), sequences.reshape(codes.shape)
        start_roots = np.repeat(initial_roots(scenario)[k : k + 1], samples, axis=0)
        restarted = table.covariances(far_roots(start_roots), sequences, slots[-1:])[0]
        averages = _path_averages(table, start_roots[:paths], sequences[:paths])
        return table.covariances(start_roots, sequences, slots), restarted, averages


def _delivery_probability(scenario: Scenario, direction: Direction) -> float:
    if not scenario.network.channel.independent:
        raise TheoryError("losses come in bursts or recorded")
    return arrival_of(scenario, direction)


def _above_least(samples: IntermittentSamples, level: float) -> Finding:
    slots = list(check_slots(samples.scenario))
    table, sequences = find_arrivals(samples.scenario, None, slots[-1])
    starts = initial_roots(samples.scenario)[sampled_indices(samples.scenario)]
    without_loss = table.covariances(starts, sequences, slots)
    P, least = samples.in_units(samples.runs.P), samples.in_units(without_loss)
    size = np.trace(P, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        gap = np.linalg.eigvalsh(np.nan_to_num(P - least, nan=-np.inf, posinf=-1e300))
    shortfall = np.maximum(-gap[..., 0], 0.0)
    message = f"{size.size:,} covariances against the path without losses"
    # Size of the values, of the terms whose rounding errors they inherit, and relative tolerance.
    limits = np.nan_to_num(size), samples.largest_terms(samples.runs.P), BOUND_TOLERANCE
    return compare_points(samples, shortfall, limits, message)


def _in_support(samples: IntermittentSamples, level: float) -> Finding:
    """Compare P at the end with the point of its support that the readings lead to."""
    P, point, spread = (
        samples.in_units(part)
        for part in (samples.runs.P[:, -1], samples.runs.in_support, samples.runs.spread)
    )
    spread = np.trace(spread, axis1=-2, axis2=-1)
    finite = np.isfinite(point).all(axis=(0, -1, -2))  # nodes for which P* exists
    size = np.trace(point, axis1=-2, axis2=-1)[:, finite]
    converged = spread[:, finite] < SUPPORT_TOLERANCE * size
    message = (
        f"{converged.sum() / max(1, spread.size):.0%} of the covariances at the end have forgotten "
        "their start and are points of the support"
    )
    gap = np.maximum(np.abs(P - point).max(axis=(-1, -2)) - np.maximum(spread, 0.0), 0.0)[:, finite]
    steady_roots = np.nan_to_num(_least_roots(samples.scenario))
    starts = initial_roots(samples.scenario)[sampled_indices(samples.scenario)]
    # Rounding errors are those of the very large start: its trace is the square sum of its root.
    above = _roots_above(starts, steady_roots)
    terms = np.trace(samples.in_units(above @ np.swapaxes(above, 1, 2)), axis1=1, axis2=2)[finite]
    # Size of the values, of the terms whose rounding errors they inherit, and relative tolerance.
    limits = size, terms, SUPPORT_TOLERANCE
    finding = compare_identities(gap, *limits, message)
    if converged.any() or finding.margin[0] < 0.0:
        return finding
    end = samples.scenario.horizon
    # The spread has shrunk from about FAR_START^2 times the size of P, at a rate that is taken to
    # be constant; the horizon grows by the ratio of the wanted to the reached logarithms.
    with np.errstate(divide="ignore", invalid="ignore"):
        log_decay = (
            np.log(FAR_START**2 / np.median(spread[:, finite] / size)) if finite.any() else 0.0
        )
    decay_factor = (
        math.log(FAR_START**2 / SUPPORT_TOLERANCE) / log_decay if log_decay > 0.0 else math.inf
    )
    # 20 % more, in case the decay slows down.
    return finding._replace(early=True, horizon=1.2 * decay_factor * end)


def _check_arrival_counts(samples: IntermittentSamples, level: float) -> Finding:
    pairs = _heard_directions(samples.scenario)  # (sender, receiver) of each directed link
    sent, arrived = samples.runs.sent.sum(axis=0), samples.runs.arrived.sum(axis=0)
    intervals = []
    for k, pair in enumerate(pairs):
        probability = probability_interval(int(arrived[k]), int(sent[k]), level / len(pairs))
        deviation = deviation_interval(_delivery_probability(samples.scenario, pair), probability)
        intervals.append((deviation, f"from node {pair[0]} to {pair[1]}"))
    message = f"largest difference in {int(sent.sum()):,} messages"
    return find_largest(intervals, PROBABILITY_TOLERANCE, message)


def _averages_of_paths(samples: IntermittentSamples, level: float) -> Finding:
    averages, expected = samples.runs.averages, samples.reference.averages
    intervals = [
        (law_distance(averages[:, i], expected[i], level / len(samples.nodes)), f"at node {node}")
        for i, node in enumerate(samples.nodes)
    ]
    message = (
        f"averages of 1/(1 + tr P / tr Q) over one path: {averages.mean():.4g} +- "
        f"{averages.std(axis=0).mean():.2g} in the runs, {expected.mean():.4g} +- "
        f"{expected.std(axis=1).mean():.2g} by the stated law; distance of their laws"
    )
    return find_largest(intervals, LAW_TOLERANCE, message)


def _outage_factors(scenario: Scenario) -> dict[int, float]:
    """Return, by node without a sensor, the factor (1 - g) alpha^2 of slots without readings."""
    factors, neighbours = {}, sensing_neighbours(scenario)
    alpha = growth_factor(scenario.slot_belief[0])
    for node in sampled_nodes(scenario):
        if node in scenario.placed_sensors:
            continue
        try:
            missed = [1.0 - _delivery_probability(scenario, (j, node)) for j in neighbours[node]]
        except TheoryError:
            continue
        factors[node] = float(np.prod(missed)) * alpha**2
    return factors


def _mean_diverges(samples: IntermittentSamples, level: float) -> Finding:
    scenario, factors = samples.scenario, _outage_factors(samples.scenario)
    node = max(factors, key=lambda k: factors[k])
    F, Q = scenario.slot_belief
    alpha = growth_factor(F)
    slots = check_slots(scenario)[-1]
    # The lower bound counts only the slots without a reading, so it needs no H. The outage factor
    # is (1 - g) alpha^2, with g the probability that a reading arrives.
    H = np.zeros((0, len(F)))
    # It is 0 without a neighbour that has a sensor; the bounds need a probability above that.
    g = max(1.0 - factors[node] / alpha**2, np.finfo(np.float64).tiny)
    start = scenario.initial_estimate(node)[1]
    lower = mean_covariance_bounds(F, Q, H, H[:, :0], g, 2 * slots, start).lower
    traces = np.trace(lower, axis1=1, axis2=2)
    median = np.median(np.trace(samples.runs.P[:, -1, samples.nodes.index(node)], axis1=1, axis2=2))
    message = (
        f"computed, not simulated: at node {node} outages alone multiply mean squares by "
        f"{factors[node]:.4g} a slot; E[tr P] is at least {traces[slots]:.3g} at the end and "
        f"{traces[-1]:.3g} at twice the horizon, while the median of the runs is {median:.3g}"
    )
    margin = float(np.log(traces[-1] / traces[slots]))
    return Finding((margin, margin, margin), 0.0, message)


def _scalar_laws(scenario: Scenario) -> dict[int, ScalarLaw]:
    laws, neighbours = {}, sensing_neighbours(scenario)
    if not fixed_readings(scenario).holds:
        return {}
    for k, node in enumerate(sampled_nodes(scenario)):
        peers = neighbours[node]
        if scenario.plant.n != 1 or node in scenario.placed_sensors or len(peers) != 1:
            continue
        model = scenario.slot_models[scenario.topology.index[peers[0]]]
        F, Q = scenario.slot_belief
        try:
            delivery = _delivery_probability(scenario, (peers[0], node))
            laws[k] = scalar_law(F, Q, model.H, model.R, delivery)
        except TheoryError:
            continue
    return laws


def _outage_counts(samples: IntermittentSamples, level: float) -> Finding:
    laws, intervals, tests = _scalar_laws(samples.scenario), [], []
    single_level = level / (len(laws) * (CELLS + 1))
    for k, law in laws.items():
        edges = _outage_edges(law)
        # The cell of each run: the number of slots without a reading at its end, at most CELLS.
        cells = np.searchsorted(edges, samples.runs.P[:, -1, k, 0, 0])
        counts = np.bincount(cells, minlength=CELLS + 1)
        # The differences of the distribution function at the edges are the cells' probabilities.
        below = np.concatenate([[0.0], _law_at_end(samples, k, law)(edges), [1.0]])
        for cell, probability in enumerate(np.diff(below).tolist()):
            interval = probability_interval(int(counts[cell]), int(counts.sum()), single_level)
            label = f"{cell} slots without a reading, node {samples.nodes[k]}"
            intervals.append((deviation_interval(probability, interval), label))
        p, cell_count = pearson_test(counts, np.diff(below))
        tests.append(f"chi-square of {cell_count} cells at node {samples.nodes[k]}: p = {p:.3g}")
    message = f"{'; '.join(tests[:3])}; largest difference of a share from its probability"
    return find_largest(intervals, PROBABILITY_TOLERANCE * 2, message)


def _law_at_end(
    samples: IntermittentSamples, k: int, law: ScalarLaw
) -> Callable[[FloatArray], FloatArray]:
    node = int(sampled_indices(samples.scenario)[k])
    start = float(first_covariances(samples.scenario)[node, 0, 0])
    return partial(law.cdf_after, slots=check_slots(samples.scenario)[-1], start=start)


def _outage_edges(law: ScalarLaw) -> FloatArray:
    """Return points (CELLS,) that separate a scalar P by the length of the last outage."""
    edge = np.array(0.5 * sum(law.hole))
    edges = []
    # A slot without a reading maps each such interval (hole) to the next.
    for _ in range(CELLS):
        edges.append(float(edge))
        edge = law.without(edge)
    return np.array(edges)


def _scalar_law_exact(samples: IntermittentSamples, level: float) -> Finding:
    laws = _scalar_laws(samples.scenario)
    intervals = []
    for k, law in laws.items():
        cdf, P = _law_at_end(samples, k, law), samples.runs.P[:, -1, k, 0, 0]
        distance = distance_to_law(cdf, P, level / len(laws))
        intervals.append((distance, f"at node {samples.nodes[k]}"))
    return find_largest(intervals, LAW_TOLERANCE, "distance from the exact distribution function")


# What promises need: parts of names or sources in the table of assumptions, see ``Promise.needs``.
FRESH, KNOWN = ("readings arrive independently",), ("the filters know", "the filters start")
FIXED = (*FRESH, FIXED_READINGS)
LIMIT = (*FIXED, "stabilisable", "positive definite", "detectable at every node", "(12), Theorem 9")
PROMISES = (
    Promise(
        "P(t+1) = f(P(t)) with the readings that arrived",
        "R (15)-(18)",
        (),
        check_replay,
        exact=True,
    ),
    Promise(
        "P is at least what it is without losses, which converges to P*",
        "R Theorem 10, mu({P >= P*}) = 1",
        (FIXED_READINGS,),
        _above_least,
        exact=True,
    ),
    Promise(
        "in the end P is a point of the support",
        "R Theorem 10",
        (FIXED_READINGS, "stabilisable", "positive definite", "detectable at every node"),
        _in_support,
        exact=True,
    ),
    Promise("readings arrive with the stated probability", "R (12)", FRESH, _check_arrival_counts),
    Promise(
        "the law of P is that of independent arrivals, at every time", "R (18)", FIXED, check_law
    ),
    Promise(
        "P is stochastically bounded: its law does not grow any more",
        "R Proposition 8, Theorem 9 [i]",
        LIMIT,
        check_bounded,
    ),
    Promise(
        "the law in the end does not depend on the start", "R Theorem 9 [i]", LIMIT, check_start
    ),
    Promise(
        "averages over one path are those of the law of independent arrivals",
        "R Proposition 25, (140)",
        FIXED,
        _averages_of_paths,
    ),
    *error_promises("R (15)-(18), derived", by="the readings give them"),
    Promise("errors are as large as P says: the mean NEES is n", "R (14)", KNOWN, check_nees),
)
SCALAR = (
    Promise(
        "between the holes of the support lies g (1 - g)^k of the mass",
        "R Proposition 24, derived",
        LIMIT,
        _outage_counts,
    ),
    Promise("the law of P is the exact one", "R Theorem 9, derived", LIMIT, _scalar_law_exact),
)


DIVERGES = Promise(
    "E[P] grows without bound, below the critical probability", "R (29), (31)", FRESH,
    _mean_diverges, exact=True, group=COMPUTED,
)  # fmt: skip


def _assumptions(scenario: Scenario) -> list[Assumption]:
    try:
        is_known, evidence = True, "a known probability for each direction"
        for direction in _heard_directions(scenario):
            _delivery_probability(scenario, direction)
    except TheoryError as error:
        is_known, evidence = False, str(error)
    if not isinstance(scenario.network.activation, Broadcast):
        is_known, evidence = False, "links are up as recorded"
    stated = "readings arrive independently, as often as stated"
    return [
        Assumption(stated, "R (12)", is_known, evidence),
        *usual_assumptions(scenario),
        fixed_readings(scenario),
    ]


def _promises(scenario: Scenario) -> tuple[Promise, ...]:
    grows = not contracts(max(_outage_factors(scenario).values(), default=0.0))
    divergence = (DIVERGES,) if grows else ()
    return PROMISES + divergence + (SCALAR if _scalar_laws(scenario) else ())


CHECKS = PaperChecks(_promises, _assumptions, _summarise, IntermittentSamples, slots_only=True)
