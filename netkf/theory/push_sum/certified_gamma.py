"""The number of averaging steps that the push-sum filter needs: certified by P and exact.

P Theorems 5 and 6 bound error dynamics by small matrices of norms. Their constant c_B must be at
least ``max_i |A_i'|_P``; the one printed in paper P (37) can be smaller (its |A| lacks a
transpose), so the larger of the two is used here. Corollary 2 does not follow from Theorem 5 and is
not used.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray, is_definite
from netkf.linalg.spectra import contracts, growth_factor
from netkf.scenario.scenario import Scenario
from netkf.theory.numerics.matrices import as_integer
from netkf.theory.push_sum.averaging import Averaging
from netkf.theory.push_sum.disconnection import disconnection_probability
from netkf.theory.push_sum.estimation_steps import estimation_steps
from netkf.theory.push_sum.limits import consensus_gain_bound
from netkf.theory.push_sum.mean_square import mean_radius, radius

Moment = Literal["mean", "mean-square"]
MAX_STEPS = 10**7  # no network could exchange so often in a slot
MAX_EXACT = 1000  # default limit of the search for the exact gamma
MAX_SEARCHED = 120  # states of all nodes, beyond which a search over gamma takes minutes


class GammaConstants(NamedTuple):
    """The constants of P Theorems 5 and 6.

    contraction   : least lambda with A_C P_inf A_C' <= lambda P_inf, paper P (34)
    printed, sharp: c_B of paper P (37), and max_i |A_i'|_P that it stands for
    mean          : theta of the link probability, paper P (54)
    mean_square   : theta of the disconnection probability, paper P (59)
    """

    contraction: float
    printed: float
    sharp: float
    mean: float
    mean_square: float


def gamma_constants(scenario: Scenario) -> GammaConstants:
    """Return the constants of P Theorems 5 and 6 of the push-sum paper, which certify that with
    gamma averaging steps in a slot the mean errors vanish, and mean squares stay bounded.

    Raises TheoryError if a condition of the theorems fails: delta at or below rho(L), a singular
    P_inf, links held over the steps or failing in one direction.
    """
    return _bound_constants(scenario)


@lru_cache(maxsize=8)
def _bound_constants(scenario: Scenario) -> GammaConstants:
    steps = estimation_steps(scenario)
    law, P, N = steps.averaging, steps.limits.P, steps.limits.N
    _require_conditions(scenario, law, P)
    F, G = scenario.slot_belief[0], steps.limits.G
    size = float(np.linalg.norm(P, 2))
    # The mean of all A_i = (I - K_i H_i) F is (I - P_inf G) F, the error dynamics of the central
    # filter, P (34).
    central = steps.closed.mean(axis=0)
    # P (54) as printed: half of 2 (1 - cos(pi / N)), the algebraic connectivity of the path, which
    # is the least of all connected graphs.
    gap = (1.0 - np.cos(np.pi / N)) / law.delta
    theta = 1.0 - float(law.hears.min(initial=1.0)) * gap
    up = {
        (scenario.nodes[i], scenario.nodes[j]): float(p)
        for (i, j), p in zip(law.links, law.both, strict=True)
    }
    cut = disconnection_probability(scenario.topology, up).high
    return GammaConstants(
        contraction=_weighted_norm(central.T, P) ** 2,
        printed=(1.0 + N * size * _weighted_norm(G, P)) * _weighted_norm(F, P),
        sharp=max(_weighted_norm(closed.T, P) for closed in steps.closed),
        mean=theta,
        # P (59): a step contracts by theta if the network is connected.
        mean_square=(1.0 - cut) * theta**2 + cut,
    )


def _require_conditions(scenario: Scenario, law: Averaging, P: FloatArray) -> None:
    laplacian_radius = consensus_gain_bound(scenario).radius
    if not law.delta > laplacian_radius:
        raise TheoryError(
            f"P Theorems 5 and 6 need delta above rho(L) = {laplacian_radius:.6g}, "
            f"it is {law.delta:g}"
        )
    if law.held:
        raise TheoryError('P Theorems 5 and 6 need links = "fresh", a draw for each step')
    if not np.array_equal(law.hears.min(axis=1), law.both):
        raise TheoryError("P Theorems 5 and 6 need failures of both directions together")
    if not is_definite(P):
        raise TheoryError("P_inf is singular, so the norms of P (35) do not exist")


def _weighted_norm(A: FloatArray, P: FloatArray) -> float:
    """Return |A|_P = sup_z sqrt(z' A' P A z / z' P z), P (35), for A (n, n) and P > 0."""
    # The largest generalised eigenvalue of (A' P A, P).
    return float(np.sqrt(scipy.linalg.eigh(A.T @ P @ A, P, eigvals_only=True)[-1]))


def minimum_gamma(scenario: Scenario, moment: Moment = "mean", sharp: bool = False) -> int:
    """Return the smallest gamma (number of averaging steps in a slot) that Theorem 5 or 6 of the
    push-sum paper certifies; the scenario's own is ignored.

    Theorem 5 for ``moment`` "mean" (asymptotically unbiased), Theorem 6 for "mean-square"
    (bounded). c_B is that printed in paper P (37), or ``max_i |A_i'|_P`` if that is larger;
    ``sharp`` uses the latter alone. The result is far from necessary: see ``exact_minimum_gamma``.
    Raises TheoryError if no gamma is certified.
    """
    constants = gamma_constants(scenario)
    bound = constants.sharp if sharp else max(constants.printed, constants.sharp)
    test = {"mean": theorem_5, "mean-square": theorem_6}[_check_moment(moment)]

    def certified(gamma: int) -> bool:
        return test(constants, bound, gamma) < 1.0

    return _least_certified(certified, constants)


class CorollaryTwo(NamedTuple):
    """What paper P Corollary 2 says of a scenario, and what paper P Theorem 5 says.

    gamma  : smallest one with paper P (44), with the same c_B as ``minimum_gamma``
    radius : rho(A_R(gamma)) of paper P (36); the corollary says that it is below 1
    needed : smallest gamma with rho(A_R) < 1, that of paper P Theorem 5
    """

    gamma: int
    radius: float
    needed: int


def corollary_2(scenario: Scenario, sharp: bool = False) -> CorollaryTwo:
    """Return gamma of P (44), Corollary 2 of the push-sum paper, beside that of P Theorem 5, from
    which the corollary does not follow.

    With ``a = sqrt(lambda)`` and ``t = theta^gamma``, rho(A_R) < 1 means
    ``t < (1 - a) / (c_B (1 - a + c_B))``; paper P (44), ``t < ((1 - a) / c_B)^2``, is weaker where
    ``(1 - a)^2 > a c_B``. lambda, theta and c_B are ``contraction``, ``mean`` and the larger of
    ``printed`` and ``sharp`` of ``gamma_constants``; with ``sharp`` c_B is the latter. Raises
    TheoryError if a condition of the theorem fails or no gamma is certified.
    """
    constants = gamma_constants(scenario)
    bound = constants.sharp if sharp else max(constants.printed, constants.sharp)
    limit = ((1.0 - constants.contraction**0.5) / bound) ** 2
    gamma = _least_certified(lambda gamma: constants.mean**gamma < limit, constants)
    needed = _least_certified(lambda gamma: theorem_5(constants, bound, gamma) < 1.0, constants)
    return CorollaryTwo(gamma, theorem_5(constants, bound, gamma), needed)


def _check_moment(moment: str) -> Moment:
    if str(moment) not in ("mean", "mean-square"):
        raise TheoryError(f'moment must be "mean" or "mean-square", got {moment!r}')
    return "mean" if moment == "mean" else "mean-square"


def _least_certified(certified: Callable[[int], bool], constants: GammaConstants) -> int:
    """Return the smallest certified gamma, by bisection; raises TheoryError beyond MAX_STEPS."""
    high = 1
    while not certified(high):
        high *= 2
        if high > MAX_STEPS:
            raise TheoryError(
                f"no gamma up to {MAX_STEPS:,} is certified: lambda {constants.contraction:.6g}, "
                f"theta {constants.mean:.6g} and {constants.mean_square:.6g} must lie below 1"
            )
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if certified(middle) else (middle, high)
    return high


def theorem_5(constants: GammaConstants, bound: float, gamma: int) -> float:
    """Return rho(A_R(gamma)) of paper P (36) with c_B = ``bound``; below 1 it certifies gamma."""
    # Rows: the mean of all nodes, and the disagreement, which gamma steps reduce by theta^gamma.
    contracted = constants.mean**gamma * bound
    return growth_factor(np.array([[constants.contraction**0.5, contracted], [bound, contracted]]))


def theorem_6(constants: GammaConstants, bound: float, gamma: int) -> float:
    """Return rho(A_S(gamma)) of paper P (45), c_B = ``bound``; below 1 it certifies gamma."""
    root, factor = constants.contraction**0.5, bound * constants.mean**gamma
    # Norms of second moments: of the mean of all nodes, of the mean with the disagreement (twice),
    # and of the disagreement.
    rows = [
        [root * root, bound * root, bound * root, bound * bound],
        [factor * size for size in (root, root, bound, bound)],
        [factor * size for size in (root, bound, root, bound)],
        [bound * bound * constants.mean_square**gamma] * 4,
    ]
    return growth_factor(np.array(rows))


def searches_gamma(scenario: Scenario) -> bool:
    """Return True if the network is small enough to search for the exact smallest gamma."""
    return len(scenario.nodes) * scenario.plant.n <= MAX_SEARCHED


def exact_minimum_gamma(
    scenario: Scenario, moment: Moment = "mean-square", most: int = MAX_EXACT
) -> int:
    """Return the smallest gamma (number of averaging steps in a slot) with which the errors' mean,
    or mean square (``moment``), is stable: the exact spectral radius of its dynamics is below 1.

    The radius is ``push_sum_radius`` for "mean-square"; the scenario's own gamma is ignored. Raises
    TheoryError if there is none up to ``most``.
    """
    steps, measure = estimation_steps(scenario), mean_radius
    if _check_moment(moment) == "mean-square":
        measure = radius
    for gamma in range(1, as_integer("most", most, 1) + 1):
        if contracts(measure(steps.with_gamma(gamma))):
            return gamma
    raise TheoryError(f"no gamma up to {most} has a {moment} radius below 1")
