"""The steady state of H(12), and how fast links must tick for it to exist.

A steady state exists if and only if some gains make the linear part of H(12) stable (for a
controllable plant). Gains are looked for along H(12) itself, by implicit steps whose length grows
while gains keep stabilising the shifted problem: where a steady state exists they come to gains
that need no shift, which one linear equation proves; where none exists the steps stay shorter than
the time in which H(12) grows, and P grows past every bound.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import scipy.sparse.linalg

from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.coupled import Coupled, coupled
from netkf.theory.hybrid.linearised import solved
from netkf.theory.hybrid.packed import Packed
from netkf.theory.hybrid.samples import transmits_at_samples

GROWN = 1e9  # a covariance that many times the first is taken to grow for ever
RESIDUAL = 1e-9
MOST_STEPS = 400
LARGEST_FACTOR = 1e6
POWER_STEPS = 60
NEWTON_STEPS = 12
MOST_FACTORED = 3000  # nodes of any network whose coupling is factored
SHOWN = 12
FEW_UNKNOWNS = 400


def steady_covariance_bound(scenario: Scenario) -> FloatArray:
    """(N, n, n): the steady state of H(12).

    Newton's method from gains that a linear equation has proved stabilising; returned with a
    relative residual below 1e-9. Raises TheoryError where there is none, with the threshold that
    the link rates would have to reach for one to exist.
    """
    equations = coupled(scenario)
    P = steady_state(equations)
    if P is None:
        raise TheoryError(_no_steady_state(scenario, equations))
    return P


def has_steady_state(scenario: Scenario) -> bool:
    """Whether H(12) has a steady state; raises TheoryError where H(12) does not apply."""
    return steady_state(coupled(scenario)) is not None


def steady_by_node(scenario: Scenario) -> FloatArray:
    """(N, n, n): for filters that do not talk, each node's own steady covariance, nan where it has
    none.
    """
    equations = coupled(scenario)
    if equations.talks:
        raise TheoryError("the nodes hear each other: their steady state is one for all")
    every = [steady_state(equations.restrict(i)) for i in range(len(equations.G))]
    nothing = np.full_like(equations.A, np.nan)
    return np.stack([nothing if P is None else P[0] for P in every])


def steady_state(equations: Coupled) -> FloatArray | None:
    """(N, n, n), None where there is none; raises TheoryError where readings come at known times:
    the bound then comes to a cycle.
    """
    if equations.jumps:
        raise TheoryError("samples at known times lead to a cycle, not to a steady state")
    packed = Packed(equations)
    P = _stabilising(packed)
    if P is None:
        return None
    for _ in range(60):
        following = _newton(packed, P)
        change = np.abs(following - P).max()
        P = following
        if change <= 1e-13 * np.abs(P).max():
            break
    Y = packed.pack(P)
    residual = np.abs(packed.slope(Y, Y)).max()
    sizes = [np.abs(x).max() for x in (equations.Q, P @ equations.G @ P, equations.A @ P)]
    if not residual <= RESIDUAL * sum(sizes):
        raise TheoryError(
            f"the steady state of H(12) was solved to {residual:.1e} only: "
            "some mode is neither driven by noise nor damped"
        )
    return P


def _newton(packed: Packed, P: FloatArray) -> FloatArray:
    return packed.unpack(solved(packed, P, packed.driven(P)))


def _stable(packed: Packed, P: FloatArray) -> bool:
    """Whether the gains of P stabilise H(12) made linear.

    That map X -> op(X) is a generator of positive maps, so it is stable if and only if
    op(X) = -I has a positive definite solution.
    """
    right = packed.pack(np.broadcast_to(np.eye(P.shape[-1]), P.shape))
    X = packed.unpack(solved(packed, P, right))
    return bool(np.isfinite(X).all() and np.linalg.eigvalsh(X)[:, 0].min() > 0.0)


def _stabilising(packed: Packed, first: FloatArray | None = None) -> FloatArray | None:
    """Covariances whose gains stabilise H(12), looked for from ``first`` (N, n, n) on; None where
    none were found.
    """
    equations, n = packed.equations, len(packed.equations.A)
    size = max(float(np.abs(x).max()) for x in (equations.Q, equations.start, [[1e-12]]))
    P = equations.start + equations.Q + 1e-3 * size * np.eye(n) if first is None else first
    sampling = sum(float(group.rate.max(initial=0.0)) for group in equations.samples)
    leaving = float(packed.leaving.max()) + sampling
    drift = float(np.abs(equations.A).max()) + 1e-9
    step = 0.1 / (drift + leaving) if first is None else 1.0 / drift
    for _ in range(MOST_STEPS):
        if _stable(packed, P):
            return P
        shift = equations.A - 0.5 / step * np.eye(n)
        implicit = packed.shifted(shift, equations.Q + P / step)
        if not _stable(implicit, P):
            step *= 0.5
            continue
        for _ in range(3):
            P = _newton(implicit, P)
        if not np.abs(P).max() < GROWN * size:
            return None
        step *= 1.5
    return None


def _no_steady_state(scenario: Scenario, equations: Coupled) -> str:
    if not equations.talks:
        missing = np.isnan(steady_by_node(scenario)[:, 0, 0])
        alone = [str(node) for node, no in zip(scenario.nodes, missing, strict=True) if no]
        listed = ", ".join(alone[:SHOWN]) + (", ..." if len(alone) > SHOWN else "")
        talks = scenario.filter.algorithm.talks
        why = "no message ever arrives" if talks else "the filter does not talk"
        several = "s" if len(alone) > 1 else ""
        return f"{why}, and the covariance of node{several} {listed} alone has no steady state"
    activation = scenario.network.activation
    if transmits_at_samples(scenario):
        return "H(12) has no steady state: nodes that sample more often would transmit more often"
    factor = threshold_factor(equations)
    if factor is None:
        return "H(12) has no steady state, and faster links do not give it one"
    rate = getattr(activation, "rate", None)
    what = {"nodes": "node", "directions": "direction"}.get(getattr(activation, "at", ""), "link")
    words = f"every {what} rate must be at least {factor:.5g} times what it is"
    if rate is not None and not getattr(activation, "rates", ()):
        words = f"the rate {rate:g} is below the threshold {factor * rate:.5g}"
    return f"H(12) has no steady state: {words}"


def threshold_factor(equations: Coupled) -> float | None:
    """The factor on all link rates from which on H(12) has a steady state, by bisection between a
    factor that has none and one that has (to 1e-6, or 1e-3 for large networks); None where no
    factor up to 1e6 helps.
    """
    low = _necessary_factor(equations)
    if low is None:
        return None
    low, high = max(1.0, low), max(2.0, 1.25 * low)
    while (P := _steady_at(equations, high, None)) is None:
        low, high = high, 2.0 * high
        if high > LARGEST_FACTOR:
            return None
    fine = 1e-6 if equations.start.size <= FEW_UNKNOWNS else 1e-3
    known, guesses = [(high, 1.0 / float(np.abs(P).max()))], 0
    while high / low > 1.0 + fine:
        factor = float(np.sqrt(low * high))
        if len(known) > 1 and guesses < 2:
            factor, guesses = _guess(known, low, high, fine), guesses + 1
        else:
            guesses = 0
        # The covariances for faster links are close to those that are looked for.
        following = _steady_at(equations, factor, P)
        if following is None:
            low = factor
        else:
            high, P = factor, following
            known.append((high, 1.0 / float(np.abs(P).max())))
    return high


def _steady_at(equations: Coupled, factor: float, first: FloatArray | None) -> FloatArray | None:
    """(N, n, n): the steady state with links that tick so many times as often, to a few digits;
    None where there is none.
    """
    packed = Packed(equations.faster(factor))
    P = _stabilising(packed, first)
    for _ in range(NEWTON_STEPS if P is not None else 0):
        before, P = P, _newton(packed, P)
        if np.abs(P - before).max() <= 1e-4 * np.abs(P).max():
            break
    return P


def _guess(known: list[tuple[float, float]], low: float, high: float, fine: float) -> float:
    """A factor beside the one at which covariances become infinite: in the end their inverse falls
    linearly to 0.
    """
    (f, inverse), (g, following) = known[-2:]
    place = g - following * (f - g) / (inverse - following) if inverse != following else high
    above = place * (1.0 + 0.4 * fine)
    # From two points above, the guess lies above too: the next one is as far below it.
    factor = above if above < 0.5 * (place + high) else 2.0 * place - high
    return factor if low < factor < high else float(np.sqrt(low * high))


def _necessary_factor(equations: Coupled) -> float | None:
    """A factor on all link rates at or below which H(12) has no steady state; None where no factor
    gives it one.

    Nodes without sensors grow at least as if all others had no error: by the largest eigenvalue of
    their own coupling and 2 a, a the growth rate of the plant's fastest mode.
    """
    if not equations.coupling.nnz:
        return None
    growth = 2.0 * float(np.linalg.eigvals(equations.A).real.max())
    blind = np.abs(equations.G).max(axis=(1, 2)) == 0.0
    for group in equations.samples:
        blind[group.nodes] = False
    if growth <= 0.0 or not blind.any() or any(group.heard.nnz for group in equations.samples):
        return 0.0
    if not Packed(equations).eliminates_cheaply and blind.sum() > MOST_FACTORED:
        return 0.0
    leaving = np.asarray(equations.coupling.sum(axis=1)).reshape(-1)[blind]
    inner = scipy.sparse.csc_array(equations.coupling[blind][:, blind])
    arriving = inner * float(np.exp(growth * equations.delay))
    longest = _longest_lag(scipy.sparse.csc_array(scipy.sparse.diags_array(leaving) - arriving))
    return None if longest is None else growth * longest


def _longest_lag(M: scipy.sparse.csc_array) -> float | None:
    """A lower bound on the largest eigenvalue of ``M^-1``, None where M (of off-diagonal entries at
    most 0) is no nonsingular M-matrix, so that some eigenvalue of M is at most 0.

    The least share by which the power method still grows an entry is below the eigenvalue (Collatz
    and Wielandt); parts of the network that do not touch have eigenvalues of their own.
    """
    try:
        factors = scipy.sparse.linalg.splu(M)
    except RuntimeError:  # exactly singular
        return None
    _, part = scipy.sparse.csgraph.connected_components(M, directed=False)
    x = np.ones(M.shape[0])
    lag = 0.0
    for _ in range(POWER_STEPS):
        y = factors.solve(x)
        if not (np.isfinite(y).all() and y.min() > 0.0):
            return None
        least = np.full(part.max() + 1, np.inf)
        np.minimum.at(least, part, y / x)
        lag = max(lag, float(least.max()))
        x = y / y.max()
        if x.min() < 1e-200:
            break
    return lag
