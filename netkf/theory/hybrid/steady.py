"""The steady state of H(12), and the least link rates for which it exists.

H(12) is the system of coupled Riccati equations whose solution P_i bounds the mean of the random
covariance of each filter i in continuous time.

A steady state exists if and only if some gains make the linearisation of H(12) stable (for a
controllable plant). The search for such gains follows H(12) itself by implicit steps, whose length
grows as long as the gains stabilise the shifted problem. If a steady state exists, the steps reach
gains that need no shift, which one linear equation proves; if none exists, the steps stay shorter
than the time in which H(12) grows, and P exceeds every bound.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import scipy

from netkf.core.errors import TheoryError
from netkf.core.printable import list_some
from netkf.linalg.arrays import FloatArray
from netkf.linalg.spectra import growth_rate
from netkf.network.spectra import connected_parts
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.coupled import CoupledRiccati, at_nodes, coupled_riccati
from netkf.theory.hybrid.dense import FullMatrix
from netkf.theory.hybrid.linearised import is_stable, solve_map
from netkf.theory.hybrid.packed import PackedRiccati
from netkf.theory.hybrid.samples import transmits_at_samples
from netkf.theory.numerics.matrices import undetectable_mode

MAX_GROWTH = 1e9  # of P relative to its start, beyond which it is taken to grow without bound
RESIDUAL = 1e-9  # of H(12), relative to its terms: a fixed point up to rounding
MAX_STEPS = 400  # implicit steps of the search for gains, those that are rejected included
MAX_FACTOR = 1e6  # largest factor on the link rates that the search for the threshold tries
NEWTON_TOLERANCE = 1e-7  # of a change of P, relative to the slope that it has to undo
POWER_STEPS = 60  # of the power method, each of which gives a valid bound
IMPLICIT_STEPS = 3  # of Newton's method for an implicit step of H(12)
MAX_FACTORED = 3000  # nodes of a network without small cuts up to which its coupling is factored
MAX_LISTED = 12  # nodes that a message names
FEW_UNKNOWNS = 400  # up to which the threshold is found to 1e-6


def steady_covariance_bound(scenario: Scenario) -> FloatArray:
    """Return the steady bound (N, n, n) on the mean of each filter's P: the steady state of the
    coupled Riccati equations H(12) of the hybrid paper, with a relative residual below 1e-9.

    Newton's method from gains that a linear equation has proved stabilising. Raises TheoryError if
    there is none, with the threshold that the link rates would have to reach, and if H(12) does not
    apply.
    """
    P = _steady_state_of(scenario)
    if P is None:
        raise TheoryError(_no_steady_state(scenario, coupled_riccati(scenario)))
    return at_nodes(scenario, P).copy()


def has_steady_state(scenario: Scenario) -> bool:
    """Return True if H(12) has a steady state; raises TheoryError if H(12) does not apply."""
    return _steady_state_of(scenario) is not None


def has_steady_state_near(scenario: Scenario, P: FloatArray) -> bool:
    """Return the same, in fewer steps if P (N, n, n) is near it, such as the bound at some time."""
    # The search takes covariances that are positive definite.
    first = P + 1e-6 * np.abs(P).max() * np.eye(P.shape[-1])
    equations = coupled_riccati(scenario)
    return steady_state(equations, first[: len(equations.G)]) is not None


@lru_cache(maxsize=8)
def _steady_state_of(scenario: Scenario) -> FloatArray | None:
    """Return the steady state (N, n, n) of H(12), or None; cached; raises TheoryError."""
    return steady_state(coupled_riccati(scenario))


def has_stabilising_gains(scenario: Scenario) -> bool:
    """Return True if some gains stabilise H(12), in half the time of :func:`has_steady_state`,
    which also finds plants with a mode that is neither driven nor damped. Raises TheoryError.
    """
    equations, _ = coupled_riccati(scenario).in_natural_units()
    _require_no_cycle(equations)
    return _stabilising_covariances(PackedRiccati(equations), None) is not None


def steady_by_node(scenario: Scenario) -> FloatArray:
    """Return the steady covariance (N, n, n) of nodes that hear nothing; nan without one."""
    equations = coupled_riccati(scenario)
    if equations.talks:
        raise TheoryError("the nodes hear each other: their steady state is one for all")
    states = [steady_state(equations.restrict(i)) for i in range(len(equations.G))]
    no_state = np.full_like(equations.A, np.nan)
    return at_nodes(scenario, np.stack([no_state if P is None else P[0] for P in states]))


def steady_state(equations: CoupledRiccati, first: FloatArray | None = None) -> FloatArray | None:
    """Return the steady state (N, n, n) of H(12), or None; TheoryError for a cycle."""
    _require_no_cycle(equations)
    equations, units = equations.in_natural_units()
    unit = np.outer(units, units)
    packed = PackedRiccati(equations)
    P = _stabilising_covariances(packed, None if first is None else first / unit)
    if P is None:
        return None
    # Newton's method converges monotonically from stabilising gains, quadratically in the end,
    # until rounding moves P to and fro.
    previous = np.inf
    for _ in range(60):
        following = _newton(packed, P)
        size = float(np.abs(following).max())
        change = float(np.abs(following - P).max()) / size if size else 0.0
        P = following
        if change <= 1e-13 or (change <= 1e-9 and change >= 0.5 * previous):
            break
        previous = change
    Y = packed.pack(P)
    residual = np.abs(packed.slope(Y, Y)).max()
    sizes = [np.abs(x).max() for x in (equations.Q, P @ equations.G @ P, equations.A @ P)]
    # Newton's method stalls if a mode is neither driven nor damped.
    if not residual <= RESIDUAL * sum(sizes):
        raise TheoryError(
            f"the steady state of Tanwani's H(12) was solved to {residual:.1e} only: "
            "some mode is neither driven by noise nor damped"
        )
    return P * unit


def _require_no_cycle(equations: CoupledRiccati) -> None:
    if equations.jumps:
        raise TheoryError("samples at known times lead to a cycle, not to a steady state")


def _stabilising_covariances(packed: PackedRiccati, first: FloatArray | None) -> FloatArray | None:
    """Return covariances (N, n, n) whose gains stabilise H(12), or None."""
    equations = packed.equations
    if equations.coupling.nnz:
        # A necessary rate is cheap to compute; where the links are slower no search can succeed.
        margin = _necessary_factor(equations)
        if margin is None or margin > 1.0 + 1e-9:
            return None
    return _find_stabilising(packed, first)


def _newton(packed: PackedRiccati, P: FloatArray) -> FloatArray:
    """Return one step (N, n, n) of Newton's method (Kleinman), solved for the change of P."""
    Y = packed.pack(P)
    change = solve_map(packed.linear(P), packed.slope(Y, Y), NEWTON_TOLERANCE)
    return packed.unpack(Y + change)


def _find_stabilising(packed: PackedRiccati, first: FloatArray | None = None) -> FloatArray | None:
    """Return covariances (N, n, n) whose gains stabilise H(12), by implicit steps, or None."""
    equations, n = packed.equations, len(packed.equations.A)
    # A mode that is hidden and neither grows nor decays ends in steps so long that it looks damped.
    if undetectable_mode(equations.A, equations.information) is not None:
        return None
    size = max(float(np.abs(x).max()) for x in (equations.Q, equations.start, [[1e-12]]))
    # The multiple of I makes P positive definite where start and Q are singular.
    P = equations.start + equations.Q + 1e-3 * size * np.eye(n) if first is None else first
    limit = max(MAX_GROWTH * size, 10.0 * float(np.abs(P).max()))
    sampling = sum(float(group.rate.max(initial=0.0)) for group in equations.samples)
    leaving = float(packed.leaving.max()) + sampling
    drift = float(np.abs(equations.A).max()) + 1e-9  # 1/s, above 0
    # Seconds: short against all rates from the start, long from a state that is nearly steady.
    step = 0.1 / (drift + leaving) if first is None else 1.0 / drift
    for _ in range(MAX_STEPS):
        if is_stable(packed.linear(P)):
            return P
        # One implicit step of dP/dt = H12(P): 0 = H12(P+) + (P - P+) / step, which is the steady
        # equation with A - I / (2 step) for A and Q + P / step for Q. A step that fails is halved.
        shift = equations.A - 0.5 / step * np.eye(n)
        following = _implicit_step(packed.shift(shift, equations.Q + P / step), P)
        if following is None:
            step *= 0.5
            continue
        P = following
        if not np.abs(P).max() < limit:
            return None
        step *= 3.0
    return None


def _implicit_step(implicit: PackedRiccati, P: FloatArray) -> FloatArray | None:
    """Return covariances (N, n, n) after an implicit Euler step; None if it is too long."""
    # ``implicit`` are the equations of the step. Q + P / step is positive definite, so the gains
    # of P stabilise them if and only if their fixed point is positive definite too.
    for _ in range(IMPLICIT_STEPS):
        previous, P = P, _newton(implicit, P)
        if not (np.isfinite(P).all() and np.linalg.eigvalsh(P)[:, 0].min() > 0.0):
            return None
        if np.abs(P - previous).max() <= 0.1 * np.abs(P).max():
            break
    return P


def _no_steady_state(scenario: Scenario, equations: CoupledRiccati) -> str:
    if not equations.talks:
        unsteady = np.isnan(steady_by_node(scenario)[:, 0, 0])
        unsteady_nodes = [node for node, no in zip(scenario.nodes, unsteady, strict=True) if no]
        listed = list_some(unsteady_nodes, MAX_LISTED)
        talks = scenario.filter.algorithm.timing.talks
        reason = "no message ever arrives" if talks else "the filter does not talk"
        plural = "s" if len(unsteady_nodes) > 1 else ""
        return f"{reason}, and the covariance of node{plural} {listed} alone has no steady state"
    activation = scenario.network.activation
    if transmits_at_samples(scenario):
        return "Tanwani's H(12) has no steady state: nodes that sample more also transmit more"
    factor = threshold_factor(equations)
    if factor is None:
        return "Tanwani's H(12) has no steady state, and faster links do not give it one"
    rate = getattr(activation, "rate", None)
    entity = {"nodes": "node", "directions": "direction"}.get(getattr(activation, "at", ""), "link")
    remedy = f"every {entity} rate must be at least {factor:.5g} times what it is"
    if rate is not None and not getattr(activation, "rates", ()):
        remedy = f"the rate {rate:g} is below the threshold {factor * rate:.5g}"
    return f"Tanwani's H(12) has no steady state: {remedy}"


def threshold_factor(equations: CoupledRiccati) -> float | None:
    """Return the least factor on link rates with a steady state of H(12); None above 1e6."""
    equations, _ = equations.in_natural_units()

    def stabilised(factor: float, first: FloatArray | None) -> FloatArray | None:
        return _find_stabilising(PackedRiccati(equations.scale_rates(factor)), first)

    low = _necessary_factor(equations)
    if low is None:
        return None
    low, high = max(1.0, low), max(2.0, 2.5 * low)
    while (P := stabilised(high, None)) is None:
        low, high = high, 4.0 * high
        if high > MAX_FACTOR:
            return None
    fine = 1e-6 if equations.start.size <= FEW_UNKNOWNS else 1e-3
    while high / low > 1.0 + fine:
        factor = math.sqrt(low * high)
        # Covariances grow as links get slower; gains that are too large still stabilise.
        following = stabilised(factor, 4.0 * P)
        if following is None:
            low = factor
        else:
            high, P = factor, following
    return high


def _necessary_factor(equations: CoupledRiccati) -> float | None:
    """Return a factor at or below which H(12) has no steady state; None if none helps."""
    # Covariances of nodes without sensors grow at least as if all others had no error.
    if not equations.coupling.nnz:
        return None
    # Without readings P grows like exp(2 a t) in the direction of the fastest mode.
    growth = 2.0 * growth_rate(equations.A)
    unobserved = np.abs(equations.G).max(axis=(1, 2)) == 0.0
    for group in equations.samples:
        unobserved[group.nodes] = False
    if growth <= 0.0 or not unobserved.any() or any(group.heard.nnz for group in equations.samples):
        return 0.0
    few = unobserved.sum() <= MAX_FACTORED
    factored = few or PackedRiccati(equations).eliminates_cheaply
    leaving = np.asarray(equations.coupling.sum(axis=1)).reshape(-1)[unobserved]
    inner = equations.coupling[unobserved][:, unobserved]
    arriving = inner * float(np.exp(growth * equations.delay))
    if isinstance(arriving, FullMatrix):
        M: Any = np.diag(leaving) - arriving.toarray()
    else:
        M = scipy.sparse.csc_array(scipy.sparse.diags_array(leaving) - arriving)
    longest = _longest_lag(M, factored)
    return None if longest is None else growth * longest


def _longest_lag(M: Any, factored: bool) -> float | None:
    """Return a lower bound on the largest eigenvalue of M^-1 (seconds); None unless M-matrix."""
    # By Collatz and Wielandt: for any y > 0 the least y_i / (M y)_i of a part is below it. Steps of
    # the power method make it large, also if they are solved roughly.
    try:
        if isinstance(M, np.ndarray):
            inverse: Any = np.linalg.inv(M).dot
        else:
            inverse = scipy.sparse.linalg.splu(M).solve if factored else None
    except (RuntimeError, np.linalg.LinAlgError):  # exactly singular
        return None
    _, part = connected_parts(M, "weak")
    x, lag, previous = np.ones(M.shape[0]), 0.0, -1.0
    for _ in range(POWER_STEPS):
        if inverse is not None:
            y = inverse(x)
        else:
            y, _ = scipy.sparse.linalg.bicgstab(M, x, lag * x, rtol=1e-8)
        if not (np.isfinite(y).all() and y.min() > 0.0):
            return None if factored else lag
        smallest_ratio = np.full(part.max() + 1, np.inf)
        np.minimum.at(smallest_ratio, part, y / np.maximum(M @ y, 1e-15 * M.diagonal() * y))
        previous, lag = lag, max(lag, float(smallest_ratio.max()))
        x = y / y.max()
        if x.min() < 1e-200 or lag - previous <= 1e-12 * lag:
            break
    return lag
