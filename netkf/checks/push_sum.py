"""What P promises of the push-sum filter, held against runs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.special

from netkf.checks.evidence import Finding, Promise, Row, identity, rounded_away
from netkf.checks.exact import as_computed, exact, stand_in, within_reach
from netkf.checks.laws import exact_start, worst
from netkf.checks.mode_sequences import watched_places
from netkf.checks.samples import Seen, relative, replay
from netkf.checks.statistics import Interval, mean_of, off_by
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory import (
    exact_minimum_gamma,
    minimum_gamma,
    push_sum_error_covariance,
    push_sum_limits,
    push_sum_radius,
)
from netkf.theory.push_sum.certified_gamma import searches_gamma
from netkf.trace.run import Run

SLOTS_ONLY = True
"""Whether the paper speaks about slots alone; under clocks those of ``clocked`` are checked."""

MASS, CLOSE = 1e-9, 0.01
SQUARE, BIAS = 0.3, 0.2  # tolerances: relative mean square, squared bias
HEAVY = 0.885  # mean-square radius from which the sample mean has no variance worth the name
MOST_CERTIFIED = 20


class Witness(NamedTuple):
    """What one run says at K slots: as :class:`Exact`, and ``drift`` (2,), the relative drift of
    the totals of weight and number.
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
    return Witness(*exact(scenario, run), drift if len(drift) else np.full(2, np.nan))


@dataclass(frozen=True)
class Observed(Seen):
    """Witnesses of many runs, stacked, with what they are held against."""

    @cached_property
    def whitened(self) -> FloatArray:
        """(runs, N, n) errors at the end, by the exact steady covariance."""
        Sigma = push_sum_error_covariance(stand_in(self.scenario))
        values, vectors = np.linalg.eigh(Sigma)
        roots = vectors / np.sqrt(values)[:, None, :]
        kept = roots[watched_places(self.scenario)]
        return np.asarray(np.einsum("iab,ria->rib", kept, self.runs.e[:, -1]))


def rows(scenario: Scenario) -> list[Row]:
    """What the tests need beyond the paper's own assumptions."""
    algorithm = stand_in(scenario).filter.algorithm
    plain = algorithm.stop == "never" and not algorithm.asymptotic  # type: ignore[union-attr]
    words = "exchanged for ever" if plain else "gains are frozen or taken from the limit"
    plant = scenario.slot_plant
    if not np.array_equal(scenario.slot_belief[0], plant.F):
        plain, words = False, "exchanged, but the filters' F is not the plant's"
    if any(sensor.varying for sensor in scenario.sensors):
        plain, words = False, "exchanged, but H differs from slot to slot"
    try:
        radius = push_sum_radius(stand_in(scenario))
        light, why = radius <= HEAVY, f"mean-square radius {radius:.4g}, light tails below {HEAVY}"
    except TheoryError as error:
        light, why = False, str(error)
    return [
        Row("mass is exchanged in every slot", "P step 2", plain, words),
        Row("mean squares have a variance", "derived", light, why),
        exact_start(scenario),
        within_reach(scenario),
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
    nodes = seen.nodes
    if not np.isfinite(seen.whitened).all():
        return rounded_away(BIAS)
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
    nodes, n = seen.nodes, seen.scenario.plant.n
    if not np.isfinite(seen.whitened).all():
        return rounded_away(SQUARE)
    found = []
    for i, node in enumerate(nodes):
        ratio = mean_of((seen.whitened[:, i] ** 2).sum(axis=1) / n, level / len(nodes))
        found.append((off_by(1.0, ratio), f"at node {node}"))
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
        ("mass is exchanged in every slot", "exact errors are within reach"),
        replay,
        exact=True,
    ),
    Promise(
        "errors have the covariance that the steps give them",
        "P (7)-(9), derived",
        (
            "mass is exchanged in every slot",
            "the filters know",
            "the filters start",
            "exact errors are within reach",
        ),
        as_computed,
    ),
    Promise(
        "every node comes to the covariance P_inf",
        "P Lemmas 3, 4, Theorems 1, 2",
        (*LAWS, "mass is exchanged in every slot", "exact errors are within reach"),
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
    if not searches_gamma(stand_in(scenario)):
        return PROMISES
    try:
        minimum_gamma(stand_in(scenario), "mean-square")
        exact_minimum_gamma(stand_in(scenario), most=MOST_CERTIFIED)
    except TheoryError:
        return PROMISES
    return (*PROMISES, CERTIFIED)
