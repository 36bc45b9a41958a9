"""What P promises of the push-sum filter, held against runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.algorithms.push_sum import PushSum
from netkf.core.arrays import FloatArray, block_diagonal
from netkf.core.errors import TheoryError
from netkf.experiments.checking.evidence import Finding, Promise, Row, identity
from netkf.experiments.checking.exact import (
    EXACT,
    as_computed,
    blocks,
    stand_in,
    whitened,
)
from netkf.experiments.checking.laws import exact_start, worst
from netkf.experiments.checking.seen import Seen, relative, replay
from netkf.experiments.checking.statistics import Interval, mean_of
from netkf.experiments.checking.words import look_at, slots_of
from netkf.scenario.scenario import Scenario
from netkf.theory import (
    exact_minimum_gamma,
    minimum_gamma,
    push_sum_error_covariance,
    push_sum_limits,
    push_sum_radius,
)
from netkf.trace.run import Run, errors
from netkf.trace.schema import CODES

MASS, CLOSE = 1e-9, 0.01
SQUARE, BIAS = 0.3, 0.2  # tolerances: relative mean square, squared bias
HEAVY = 0.885  # mean-square radius from which the sample mean has no variance worth the name
MOST_CERTIFIED = 20


class Witness(NamedTuple):
    """What one run says at K slots.

    P, e     : (K, N, n, n), (K, N, n) covariances and errors
    nees     : (K, N) e' P^-1 e
    replayed : (K, N, n, n) what steps 2, 3 and (7) make of the links that were up
    Sigma    : (K, N, n, n) covariance of the errors given the links
    whole    : (K, 2) as in :class:`Exact`
    drift    : (2,) relative drift of the totals of weight and number
    """

    P: FloatArray
    e: FloatArray
    nees: FloatArray
    replayed: FloatArray
    Sigma: FloatArray
    whole: FloatArray
    drift: FloatArray


def witness(scenario: Scenario, run: Run) -> Witness:
    """Reduce a run whose samples are those of ``look_at``."""
    drift = np.array([(total - exact) / exact for exact, total in run.sums.values()])
    if not len(drift):
        drift = np.full(2, np.nan)
    replayed, stacked = _Plain(scenario, run).upto(look_at(scenario))
    e = run.x[:, None] - run.xhat
    _, nees = errors(run.x, run.xhat, run.P)
    return Witness(
        run.P,
        e,
        nees,
        replayed,
        blocks(stacked, *e.shape[1:]),
        whitened(e, stacked, EXACT),
        drift,
    )


class _Plain:
    """P Fig. 1 written plainly, with the corrected update of the mass, along the links of a run:
    P of every node, and the covariance of the errors of all nodes together.
    """

    def __init__(self, scenario: Scenario, run: Run) -> None:
        promised = stand_in(scenario).filter.algorithm
        assert isinstance(promised, PushSum)
        self._scenario, self._filter = scenario, promised
        self._n, self._N = scenario.plant.n, len(scenario.nodes)
        self._models = scenario.slot_models
        self._nu = np.array([scenario.topology.degrees[node] + 1 for node in scenario.nodes])
        self._up = _arrived(scenario, run, promised.gamma)

    def _received(self, slot: int, phase: int, step: int) -> FloatArray:
        """(N, N): 1 where what j sent in a step reached i in time."""
        return self._up.get((slot, phase, step), np.zeros((self._N, self._N)))

    def upto(self, slots: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
        """(K, N, n, n) and (K, N n, N n) at some slots."""
        n, N, scenario = self._n, self._N, self._scenario
        own = np.array([m.H.T @ np.linalg.solve(m.R, m.H) for m in self._models])
        z = np.concatenate([np.zeros((N, 1)), np.ones((N, 1)), own.reshape(N, -1)], axis=1)
        z[scenario.topology.index[self._filter.leader], 0] = 1.0
        P = np.array([scenario.start(node)[1] for node in scenario.nodes])
        Sigma = np.tile(scenario.plant.start_cov, (N, N))
        F, Q = scenario.slot_belief
        found = []
        for slot in range(1, slots[-1] + 1):
            received = self._received(slot, 0, 0)
            shares = z / self._nu[:, None]
            z = (self._nu - received.sum(axis=1))[:, None] * shares + received @ shares
            heard, weight = z[:, 0] > 0.0, np.where(z[:, 0] > 0.0, z[:, 0], 1.0)
            G = np.where(
                heard[:, None, None], z[:, 2:].reshape(N, n, n) / weight[:, None, None], own
            )
            number = np.where(heard, z[:, 1] / weight, 1.0)
            ahead = F @ P @ F.T + Q
            P = np.linalg.solve(np.eye(n) + ahead @ G, ahead)
            P = 0.5 * (P + np.swapaxes(P, -1, -2))
            Sigma = self._averaged(slot, self._sensed(Sigma, P, number))
            if slot in slots:
                found.append((P, Sigma))
        return np.array([P for P, _ in found]), np.array([Sigma for _, Sigma in found])

    def _sensed(self, Sigma: FloatArray, P: FloatArray, number: FloatArray) -> FloatArray:
        """Step 4: x - xhat after the reading of a slot."""
        n, plant, scenario = self._n, self._scenario.slot_plant, self._scenario
        moves, noise = [], []
        for i, model in enumerate(self._models):
            gain = number[i] * P[i] @ np.linalg.solve(model.R, model.H).T
            moves.append(np.eye(n) - gain @ model.H)
            true = scenario.observation(scenario.nodes[i])[1]
            noise.append(gain @ true @ gain.T)
        closed = block_diagonal(moves)
        ahead = np.kron(np.eye(self._N), plant.F)
        moved = ahead @ Sigma @ ahead.T + np.tile(plant.Q, (self._N, self._N))
        return np.asarray(closed @ moved @ closed.T + block_diagonal(noise))

    def _averaged(self, slot: int, Sigma: FloatArray) -> FloatArray:
        """Step 5: gamma averaging steps."""
        for step in range(self._filter.gamma):
            received = self._received(slot, 1, step)
            mixing = (
                np.eye(self._N) + (received - np.diag(received.sum(axis=1))) / self._filter.delta
            )
            whole = np.kron(mixing, np.eye(self._n))
            Sigma = whole @ Sigma @ whole.T
        return Sigma


def _arrived(scenario: Scenario, run: Run, gamma: int) -> dict[tuple[int, int, int], FloatArray]:
    """By slot, phase and step."""
    index, size = scenario.topology.index, len(scenario.nodes)
    rows = run.log[run.log["kind"] == CODES["deliver"]]
    sent = rows["t"] - rows["age"]
    slot, length = slots_of(scenario, sent), scenario.phase_length
    since = sent - slot * scenario.slot_plant.period - rows["phase"] * length
    step = np.where(rows["phase"] == 0, 0, np.round(since / (length / gamma))).astype(int)
    up: dict[tuple[int, int, int], FloatArray] = {}
    columns = (slot, rows["phase"], step, rows["node"], rows["peer"])
    for t, phase, k, node, peer in zip(*(c.tolist() for c in columns), strict=True):
        matrix = up.setdefault((t, phase, k), np.zeros((size, size)))
        matrix[index[node], index[peer]] = 1.0
    return up


@dataclass(frozen=True)
class Observed(Seen):
    """Witnesses of many runs, stacked, with what they are held against."""

    @cached_property
    def whitened(self) -> FloatArray:
        """(runs, N, n) errors at the end, by the exact steady covariance."""
        Sigma = push_sum_error_covariance(stand_in(self.scenario))
        values, vectors = np.linalg.eigh(Sigma)
        roots = vectors / np.sqrt(values)[:, None, :]
        return np.asarray(np.einsum("iab,ria->rib", roots, self.runs.e[:, -1]))


def rows(scenario: Scenario) -> list[Row]:
    """What the tests need beyond the paper's own assumptions."""
    algorithm = stand_in(scenario).filter.algorithm
    plain = algorithm.stop == "never" and not algorithm.asymptotic  # type: ignore[union-attr]
    words = "exchanged for ever" if plain else "gains are frozen or taken from the limit"
    try:
        radius = push_sum_radius(stand_in(scenario))
        light, why = radius <= HEAVY, f"mean-square radius {radius:.4g}, light tails below {HEAVY}"
    except TheoryError as error:
        light, why = False, str(error)
    return [
        Row("mass is exchanged in every slot", "P step 2", plain, words),
        Row("mean squares have a variance", "derived", light, why),
        exact_start(scenario),
    ]


def conserved(seen: Observed, level: float) -> Finding:
    """The totals at the end against 1 and N."""
    drift = float(np.nan_to_num(np.abs(seen.runs.drift), nan=np.inf).max())
    words = f"drift of the totals of weight and number in {len(seen.runs.P)} runs"
    return identity(drift, MASS, words)


def settled(seen: Observed, level: float) -> Finding:
    """P of every node comes to P_inf, once the mass has arrived."""
    limit = push_sum_limits(stand_in(seen.scenario)).P
    last, expected = (
        float(np.nan_to_num(relative(P[:, -1], limit), nan=np.inf).max())
        for P in (seen.runs.P, seen.runs.replayed[~np.isnan(seen.runs.replayed[:, -1, 0, 0, 0])])
    )
    margin = CLOSE - last
    words = f"largest relative distance at the end {last:.1e}"
    return Finding((margin, margin, margin), 0.0, words, early=margin < 0.0 and expected > CLOSE)


def unbiased(seen: Observed, level: float) -> Finding:
    """The mean of the whitened errors at the end is 0 in all directions at once."""
    nodes = seen.scenario.nodes
    found = []
    for i, node in enumerate(nodes):
        e = seen.whitened[:, i]
        # a mean m has outer product m m' with one eigenvalue |m|^2; its sampling error is ~ 1 / R
        mean = e.mean(axis=0)
        error = np.cov(e, rowvar=False).reshape(e.shape[1], -1) / len(e)
        reach = _normal_reach(level / len(nodes), e.shape[1])
        size = float(np.linalg.norm(mean))
        wide = reach * float(np.sqrt(np.linalg.eigvalsh(error)[-1]))
        distance = Interval(size**2, max(0.0, size - wide) ** 2, (size + wide) ** 2)
        found.append((distance, f"at node {node}"))
    return worst(found, BIAS, "largest squared bias, in units of the exact covariance,")


def _normal_reach(level: float, n: int) -> float:
    return float(np.sqrt(2.0 * scipy.special.gammainccinv(n / 2.0, level)))


def mean_square(seen: Observed, level: float) -> Finding:
    """The mean square of the whitened errors at the end is 1 on average over directions."""
    nodes, n = seen.scenario.nodes, seen.scenario.plant.n
    found = []
    for i, node in enumerate(nodes):
        ratio = mean_of((seen.whitened[:, i] ** 2).sum(axis=1) / n, level / len(nodes))
        ends = sorted((abs(ratio.low - 1.0), abs(ratio.high - 1.0)))
        least = 0.0 if ratio.low <= 1.0 <= ratio.high else ends[0]
        found.append((Interval(abs(ratio.value - 1.0), least, ends[1]), f"at node {node}"))
    return worst(found, SQUARE, "largest relative difference of mean squares from the exact ones")


def certified(seen: Observed, level: float) -> Finding:
    """The gamma that Theorem 6 certifies is at least the exact one; by far more than is needed."""
    scenario = stand_in(seen.scenario)
    gamma, needed = minimum_gamma(scenario, "mean-square"), exact_minimum_gamma(scenario)
    margin = float(gamma - needed)
    words = f"computed, not simulated: Theorem 6 certifies gamma {gamma}, {needed} is enough"
    return Finding((margin, margin, margin), 0.0, words)


LAWS = ("P Assumption 2", "P Assumption 1", "P Assumption 3", "no gain is frozen")
PROMISES = (
    Promise(
        "mass is conserved",
        "P Lemma 1, (3)-(5) corrected",
        ("both directions of a link",),
        conserved,
        exact=True,
    ),
    Promise(
        "P follows steps 2 and 3 with the links that were up",
        "P (3)-(7)",
        ("mass is exchanged in every slot",),
        replay,
        exact=True,
    ),
    Promise(
        "errors have the covariance that the steps give them",
        "P (7)-(9), derived",
        ("mass is exchanged in every slot", "the filters know", "the filters start"),
        as_computed,
    ),
    Promise(
        "every node comes to the covariance P_inf",
        "P Lemmas 3, 4, Theorems 1, 2",
        LAWS,
        settled,
        exact=True,
    ),
    Promise(
        "the estimates become unbiased",
        "P Theorem 5, (30)",
        (*LAWS, "P (30)", "mean squares have a variance", "the filters know"),
        unbiased,
    ),
    Promise(
        "mean squares become the exact steady ones",
        "P Theorem 6, Lemma 10, Figs. 4, 5, derived",
        (*LAWS, "P Lemma 10", "mean squares have a variance", "the filters know"),
        mean_square,
    ),
)
CERTIFIED = Promise(
    "the gamma that Theorem 6 certifies keeps mean squares bounded",
    "P Theorem 6, Corollaries 1, 2",
    ("P Assumption 3",),
    certified,
    exact=True,
)


def promises(scenario: Scenario) -> tuple[Promise, ...]:
    """Those of the scenario; a certified gamma where there is one."""
    try:
        minimum_gamma(stand_in(scenario), "mean-square")
        exact_minimum_gamma(stand_in(scenario), most=MOST_CERTIFIED)
    except TheoryError:
        return PROMISES
    return (*PROMISES, CERTIFIED)
