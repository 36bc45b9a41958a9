"""What R promises of the filter with intermittent observations, held against runs."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from netkf.checks.evidence import Finding, Promise, Row, identity
from netkf.checks.exact import as_computed, exact, within_reach
from netkf.checks.laws import (
    Pair,
    distances,
    exact_start,
    same_laws,
    worst,
)
from netkf.checks.mode_sequences import (
    arrivals,
    everything,
    intermittent_book,
    look_at,
    peers_of,
    reference_size,
    start_roots,
    watched_nodes,
    watched_places,
)
from netkf.checks.samples import Seen, bounded, nees_is_chi_squared, replay
from netkf.checks.statistics import (
    chi_square,
    distance_to,
    off_by,
    share,
)
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.rng.streams import Streams
from netkf.scenario.scenario import Scenario
from netkf.theory.intermittent.riccati import steady_covariance
from netkf.theory.intermittent.scalar_law import ScalarLaw, scalar_law
from netkf.trace.run import Run
from netkf.trace.schema import CODES

SLOTS_ONLY = True
"""Whether the paper speaks about slots alone; under clocks those of ``clocked`` are checked."""

FAR = 30.0  # factor of the other start's root
ROUNDING = 1e-8
SHARE, LAW = 0.05, 0.2  # tolerances: of probabilities, of distances of laws
CELLS = 12


class Witness(NamedTuple):
    """What one run says; K slots are looked at, D directions can carry readings.

    P, nees  : (K, N, n, n), (K, N) at the slots
    e, Sigma, whole : as in :class:`Exact`
    replayed : (K, N, n, n) what R (15)-(18) makes of the run's arrivals
    restarted: (N, n, n) the same at the last slot from another start
    in_support: (N, n, n) the same at the last slot from P* of each node
    sent, got: (D,) readings sent and delivered in time
    """

    P: FloatArray
    nees: FloatArray
    e: FloatArray
    Sigma: FloatArray
    whole: FloatArray
    replayed: FloatArray
    restarted: FloatArray
    in_support: FloatArray
    sent: np.ndarray
    got: np.ndarray


def directions(scenario: Scenario) -> list[tuple[int, int]]:
    """(sender, receiver) of all that can carry readings."""
    peers = peers_of(scenario)
    return [(peer, node) for node in scenario.nodes for peer in peers[node]]


@lru_cache(maxsize=8)
def least_roots(scenario: Scenario) -> FloatArray:
    """(W, n, n) roots of P* of each watched node, with all readings that can reach it; nan where it
    has none.
    """
    full, n = everything(scenario, 1), scenario.plant.n
    F, Q = scenario.slot_belief
    roots = np.full((len(full.words), n, n), np.nan)
    for k, letter in enumerate(full.words[:, 0].tolist()):
        p = int(full.book.letters.rows[letter])
        H, root = full.book.letters.H[letter, :p], full.book.letters.root_R[letter, :p, :p]
        try:
            roots[k] = np.linalg.cholesky(steady_covariance(F, Q, H, root @ root.T))
        except (TheoryError, np.linalg.LinAlgError):
            continue
    return roots


def witness(scenario: Scenario, run: Run) -> Witness:
    """Reduce a run whose samples are those of ``look_at``."""
    slots = list(look_at(scenario))
    seen = arrivals(scenario, run, slots[-1])
    starts = start_roots(scenario)[watched_places(scenario)]
    replayed = seen.book.along(starts, seen.words, slots)
    far = FAR * starts + np.eye(scenario.plant.n)
    restarted = seen.book.along(far, seen.words, slots[-1:])[0]
    in_support = seen.book.along(least_roots(scenario), seen.words, slots[-1:])[0]
    counts = {
        kind: _count(scenario, run, kind, "node" if kind == "send" else "peer", slots[-1])
        for kind in ("send", "deliver")
    }
    errors = exact(scenario, run)
    return Witness(
        errors.P,
        errors.nees,
        errors.e,
        errors.Sigma,
        errors.whole,
        replayed,
        restarted,
        in_support,
        counts["send"],
        counts["deliver"],
    )


def _count(scenario: Scenario, run: Run, kind: str, sender: str, slots: int) -> np.ndarray:
    receiver = "peer" if sender == "node" else "node"
    rows = run.log[run.log["kind"] == CODES[kind]]
    rows = rows[scenario.slot_plant.slots_of(rows["t"]) < slots]
    counts = Counter(zip(rows[sender].tolist(), rows[receiver].tolist(), strict=True))
    return np.array([counts[pair] for pair in directions(scenario)], dtype=int)


class Reference(NamedTuple):
    """S filters of each node with arrivals drawn by the stated probabilities: ``P`` (N, K, S, n, n)
    and at the last slot from another start ``restarted`` (N, S, n, n).
    """

    P: FloatArray
    restarted: FloatArray


@dataclass(frozen=True)
class Observed(Seen):
    """Witnesses of many runs, stacked, with what they are held against."""

    @cached_property
    def reference(self) -> Reference:
        """Independent arrivals, R (12)."""
        scenario, slots = self.scenario, list(look_at(self.scenario))
        starts, peers = start_roots(scenario), peers_of(scenario)
        found, again = [], []
        watched = watched_places(scenario).tolist()
        samples = reference_size(scenario, len(watched))
        for k in watched:
            node = scenario.nodes[k]
            random = Streams(self.seed).generator("arrivals", node)
            own = (node,) if node in scenario.placed else ()
            chances = np.array([delivered(scenario, (peer, node)) for peer in peers[node]])
            came = random.random((samples, slots[-1], len(chances))) < chances
            codes = came @ (1 << np.arange(len(chances)))
            used, words = np.unique(codes, return_inverse=True)
            sets = [
                (*own, *(peer for bit, peer in enumerate(peers[node]) if code >> bit & 1))
                for code in used.tolist()
            ]
            book = intermittent_book(scenario, sets)
            words = words.reshape(codes.shape)
            first = np.repeat(starts[k : k + 1], samples, axis=0)
            found.append(book.along(first, words, slots))
            far = FAR * first + np.eye(first.shape[-1])
            again.append(book.along(far, words, slots[-1:])[0])
        return Reference(np.array(found), np.array(again))


def delivered(scenario: Scenario, direction: tuple[int, int]) -> float:
    """Probability that a reading arrives in time; raises TheoryError where that is not known."""
    channel = scenario.network.channel
    if not channel.loss.independent:
        raise TheoryError("losses come in bursts or recorded")
    delay = channel.delay.fixed
    if delay is None:
        raise TheoryError("random delays make some readings late")
    chance = channel.loss.mean_delivery(direction, scenario.table_probability(direction))
    return chance if delay <= scenario.phase_length else 0.0


def rows(scenario: Scenario) -> list[Row]:
    """What the tests need beyond the paper's own assumptions."""
    try:
        known, words = True, "a known probability for each direction"
        for direction in directions(scenario):
            delivered(scenario, direction)
    except TheoryError as error:
        known, words = False, str(error)
    if type(scenario.network.activation).__name__ != "Broadcast":
        known, words = False, "links are up as recorded"
    return [
        Row("readings arrive independently, as often as stated", "R (12)", known, words),
        exact_start(scenario),
        within_reach(scenario),
    ]


def above_least(seen: Observed, level: float) -> Finding:
    """No path is below the one on which every reading arrives; that one converges to P*."""
    slots = list(look_at(seen.scenario))
    full = everything(seen.scenario, slots[-1])
    starts = start_roots(seen.scenario)[watched_places(seen.scenario)]
    least = full.book.along(starts, full.words, slots)
    size = np.trace(seen.runs.P, axis1=-2, axis2=-1)
    with np.errstate(invalid="ignore"):
        gap = np.linalg.eigvalsh(np.nan_to_num(seen.runs.P - least, nan=-np.inf, posinf=-1e300))
    below = float(np.max(-gap[..., 0] / size))
    words = f"{size.size:,} covariances against the path without losses"
    return identity(max(0.0, below), ROUNDING, words)


def in_support(seen: Observed, level: float) -> Finding:
    """At the end P is the point of the support that its own arrivals spell, up to what the word has
    not yet forgotten of the start.
    """
    P, point, other = seen.runs.P[:, -1], seen.runs.in_support, seen.runs.restarted
    kept = np.isfinite(point).all(axis=(0, -1, -2))
    size = np.trace(point, axis1=-2, axis2=-1)
    spread = np.abs(other - point).max(axis=(-1, -2)) / size
    apart = np.abs(P - point).max(axis=(-1, -2)) / size
    settled = (spread < 1e-6) & kept
    largest = float(apart[settled].max()) if settled.any() else 0.0
    words = (
        f"{settled.mean():.0%} of the covariances at the end have forgotten their start and are "
        "points of the support"
    )
    return identity(largest, 1e-6, words)


def arriving(seen: Observed, level: float) -> Finding:
    """Slots are independent, so counts of arrivals are binomial."""
    pairs = directions(seen.scenario)
    sent, got = seen.runs.sent.sum(axis=0), seen.runs.got.sum(axis=0)
    found = [
        (
            off_by(
                delivered(seen.scenario, pair), share(int(got[k]), int(sent[k]), level / len(pairs))
            ),
            f"from node {pair[0]} to {pair[1]}",
        )
        for k, pair in enumerate(pairs)
    ]
    return worst(found, SHARE, f"largest difference in {int(sent.sum()):,} messages")


def law(seen: Observed, level: float) -> Finding:
    """Each node at each time against filters with independent arrivals."""
    pairs = [
        Pair(f"slot {slot}, node {node}", seen.runs.P[:, k, i], seen.reference.P[i, k])
        for k, slot in enumerate(look_at(seen.scenario))
        for i, node in enumerate(seen.nodes)
    ]
    return same_laws(pairs, level)


def forgotten(seen: Observed, level: float) -> Finding:
    """The runs against their own arrivals from a start a thousand times larger."""
    P, restarted = seen.reference
    pairs = [
        Pair(
            f"node {node}",
            seen.runs.P[:, -1, i],
            seen.runs.restarted[:, i],
            distances(P[i, -1], restarted[i]),
        )
        for i, node in enumerate(seen.nodes)
    ]
    return same_laws(pairs, level)


def listeners(scenario: Scenario) -> dict[int, ScalarLaw]:
    """Exact laws of the watched nodes (by their number among these) of a scalar scenario whose only
    reading comes over one link.
    """
    laws, everyone = {}, peers_of(scenario)
    for k, node in enumerate(watched_nodes(scenario)):
        peers = everyone[node]
        if scenario.plant.n != 1 or node in scenario.placed or len(peers) != 1:
            continue
        model = scenario.slot_models[scenario.topology.index[peers[0]]]
        F, Q = scenario.slot_belief
        try:
            chance = delivered(scenario, (peers[0], node))
            laws[k] = scalar_law(F, Q, model.H, model.R, chance)
        except TheoryError:
            continue
    return laws


def cells(seen: Observed, level: float) -> Finding:
    """Counts of P between the holes of the support; an outage of k slots has g (1 - g)^k."""
    laws, found = listeners(seen.scenario), []
    for k, known in laws.items():
        edges = outage_edges(known)
        seen_cells = np.searchsorted(edges, seen.runs.P[:, -1, k, 0, 0])
        counts = np.bincount(seen_cells, minlength=CELLS + 1)
        g = known.delivery
        chances = np.append(g * (1.0 - g) ** np.arange(CELLS), (1.0 - g) ** CELLS)
        p, used = chi_square(counts, chances)
        found.append((p, used, counts, chances, seen.nodes[k]))
    p, used, counts, chances, node = min(found, key=lambda item: item[0])
    off = [
        off_by(chance, share(int(count), int(counts.sum()), level / len(chances)))
        for count, chance in zip(counts, chances, strict=True)
    ]
    largest, widest = max(o.value for o in off), max(o.high for o in off)
    low = -largest if p < level / len(laws) else 0.0
    words = f"chi-square of {used} cells between holes at node {node}: p = {p:.3g}"
    return Finding((-largest, -widest, low), SHARE * 2, words)


def outage_edges(law: ScalarLaw) -> FloatArray:
    """(CELLS,) the middles of the holes above outages of 0, 1, 2, ... slots."""
    edge = np.array(0.5 * sum(law.hole))
    edges = []
    for _ in range(CELLS):
        edges.append(float(edge))
        edge = law.without(edge)
    return np.array(edges)


def scalar(seen: Observed, level: float) -> Finding:
    """P at the end against the exact distribution function."""
    laws = listeners(seen.scenario)
    found = [
        (
            distance_to(known.cdf, seen.runs.P[:, -1, k, 0, 0], level / len(laws)),
            f"at node {seen.nodes[k]}",
        )
        for k, known in laws.items()
    ]
    return worst(found, LAW, "distance from the exact distribution function")


FRESH, KNOWN = ("readings arrive independently",), ("the filters know", "the filters start")
LIMIT = (*FRESH, "stabilisable", "positive definite", "detectable at every node", "(12), Theorem 9")
PROMISES = (
    Promise(
        "P(t+1) = f(P(t)) with the readings that arrived", "R (15)-(18)", (), replay, exact=True
    ),
    Promise(
        "P is at least what it is without losses, which converges to P*",
        "R Theorem 10, mu({P >= P*}) = 1",
        (),
        above_least,
        exact=True,
    ),
    Promise(
        "in the end P is a point of the support",
        "R Theorem 10",
        ("stabilisable", "positive definite", "detectable at every node"),
        in_support,
        exact=True,
    ),
    Promise("readings arrive with the stated probability", "R (12)", FRESH, arriving),
    Promise("the law of P is that of independent arrivals, at every time", "R (18)", FRESH, law),
    Promise(
        "P is stochastically bounded: its law does not grow any more",
        "R Proposition 8, Theorem 9 [i]",
        LIMIT,
        bounded,
    ),
    Promise("the law in the end does not depend on the start", "R Theorem 9 [i]", LIMIT, forgotten),
    Promise(
        "errors have the covariance that the readings give them",
        "R (15)-(18), derived",
        ("the filters start", "exact errors are within reach"),
        as_computed,
    ),
    Promise(
        "errors are as large as P says: the mean NEES is n", "R (15)", KNOWN, nees_is_chi_squared
    ),
)
SCALAR = (
    Promise(
        "between the holes of the support lies g (1 - g)^k of the mass",
        "R Proposition 24, derived",
        LIMIT,
        cells,
    ),
    Promise("the law of P is the exact one", "R Theorem 9, derived", LIMIT, scalar),
)


def promises(scenario: Scenario) -> tuple[Promise, ...]:
    """Those of the scenario; more where the exact law is known."""
    return PROMISES + (SCALAR if listeners(scenario) else ())
