"""What P promises of the push-sum filter, held against runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.core.arrays import FloatArray
from netkf.core.errors import TheoryError
from netkf.experiments.checking.evidence import Finding, Promise, Row, identity
from netkf.experiments.checking.exact import stand_in
from netkf.experiments.checking.laws import exact_start, worst
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
from netkf.trace.run import Run
from netkf.trace.schema import CODES

ROUNDING, MASS, CLOSE = 1e-8, 1e-9, 0.01
SQUARE, BIAS = 0.3, 0.2  # tolerances: relative mean square, squared bias
HEAVY = 0.885  # mean-square radius from which the sample mean has no variance worth the name
MOST_CERTIFIED = 20


class Witness(NamedTuple):
    """What one run says at K slots.

    P, e     : (K, N, n, n), (K, N, n) covariances and errors
    replayed : (K, N, n, n) what steps 2, 3 and (7) make of the links that were up
    drift    : (2,) relative drift of the totals of weight and number
    """

    P: FloatArray
    e: FloatArray
    replayed: FloatArray
    drift: FloatArray


def witness(scenario: Scenario, run: Run) -> Witness:
    """Reduce a run whose samples are those of ``look_at``."""
    drift = np.array([(total - exact) / exact for exact, total in run.sums.values()])
    if not len(drift):
        drift = np.full(2, np.nan)
    replayed = _replayed(scenario, run, look_at(scenario))
    return Witness(run.P, run.x[:, None] - run.xhat, replayed, drift)


def _replayed(scenario: Scenario, run: Run, slots: tuple[int, ...]) -> FloatArray:
    """Steps 2, 3 and P (7) written plainly, with the corrected update of the mass."""
    index, models = scenario.topology.index, scenario.slot_models
    n, size = scenario.plant.n, len(index)
    F, Q = scenario.slot_belief
    nu = np.array([scenario.topology.degrees[node] + 1 for node in scenario.nodes])
    information = np.array([m.H.T @ np.linalg.solve(m.R, m.H) for m in models])
    z = np.concatenate([np.zeros((size, 1)), np.ones((size, 1)), information.reshape(size, -1)], 1)
    z[index[stand_in(scenario).filter.algorithm.leader], 0] = 1.0  # type: ignore[union-attr]
    P = np.array([scenario.start(node)[1] for node in scenario.nodes])
    up = _arrived(scenario, run, slots[-1])
    found = []
    for slot in range(1, slots[-1] + 1):
        received = up[slot]
        kept = nu - received.sum(axis=1)
        z = (kept / nu)[:, None] * z + received @ (z / nu[:, None])
        heard = z[:, 0] > 0.0
        weight = np.where(heard, z[:, 0], 1.0)
        G = np.where(
            heard[:, None, None], z[:, 2:].reshape(size, n, n) / weight[:, None, None], information
        )
        ahead = F @ P @ F.T + Q
        P = np.linalg.solve(np.eye(n) + ahead @ G, ahead)
        P = 0.5 * (P + np.swapaxes(P, -1, -2))
        if slot in slots:
            found.append(P)
    return np.array(found)


def _arrived(scenario: Scenario, run: Run, slots: int) -> np.ndarray:
    """(slots + 1, N, N): whether the mass that j sent reached i in time."""
    index, size = scenario.topology.index, len(scenario.nodes)
    rows = run.log[(run.log["kind"] == CODES["deliver"]) & (run.log["phase"] == 0)]
    slot = slots_of(scenario, rows["t"] - rows["age"])
    up = np.zeros((slots + 1, size, size))
    columns = slot.tolist(), rows["node"].tolist(), rows["peer"].tolist()
    for t, node, peer in zip(*columns, strict=True):
        if t <= slots:
            up[t, index[node], index[peer]] = 1.0
    return up


@dataclass(frozen=True)
class Seen:
    """Witnesses of many runs, stacked, with what they are held against."""

    scenario: Scenario
    runs: Witness
    seed: int = 0

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


def conserved(seen: Seen, level: float) -> Finding:
    """The totals at the end against 1 and N."""
    drift = float(np.nan_to_num(np.abs(seen.runs.drift), nan=np.inf).max())
    words = f"drift of the totals of weight and number in {len(seen.runs.P)} runs"
    return identity(drift, MASS, words)


def replay(seen: Seen, level: float) -> Finding:
    """Every covariance is what the links that were up make of the start."""
    P, expected = seen.runs.P, seen.runs.replayed
    size = np.abs(expected).max(axis=(-1, -2), keepdims=True)
    apart = np.nan_to_num(np.abs(P - expected) / size, nan=np.inf).max()
    words = f"{size.size:,} covariances replayed from the links of their runs"
    return identity(float(apart), ROUNDING, words)


def settled(seen: Seen, level: float) -> Finding:
    """P of every node comes to P_inf."""
    limit = push_sum_limits(stand_in(seen.scenario)).P
    apart = np.abs(seen.runs.P - limit).max(axis=(0, 2, 3, 4)) / np.abs(limit).max()
    last, half = (float(np.nan_to_num(value, nan=np.inf)) for value in (apart[-1], apart[-2]))
    margin = CLOSE - last
    moving = margin < 0.0 and last < 0.5 * half
    words = f"largest relative distance {half:.1e} at half of the time and {last:.1e} at the end"
    return Finding((margin, margin if not moving else -1.0, 0.0 if moving else margin), 0.0, words)


def unbiased(seen: Seen, level: float) -> Finding:
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


def mean_square(seen: Seen, level: float) -> Finding:
    """The mean square of the whitened errors at the end is 1 on average over directions."""
    nodes, n = seen.scenario.nodes, seen.scenario.plant.n
    found = []
    for i, node in enumerate(nodes):
        ratio = mean_of((seen.whitened[:, i] ** 2).sum(axis=1) / n, level / len(nodes))
        ends = sorted((abs(ratio.low - 1.0), abs(ratio.high - 1.0)))
        least = 0.0 if ratio.low <= 1.0 <= ratio.high else ends[0]
        found.append((Interval(abs(ratio.value - 1.0), least, ends[1]), f"at node {node}"))
    return worst(found, SQUARE, "largest relative difference of mean squares from the exact ones")


def certified(seen: Seen, level: float) -> Finding:
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
