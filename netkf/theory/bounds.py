"""The bound H(12) over time and in its steady state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.integrate
import scipy.sparse.linalg

from netkf.core.arrays import FloatArray, symmetric
from netkf.core.errors import TheoryError
from netkf.scenario.scenario import Scenario
from netkf.theory.coupled import Coupled, coupled, linear_operator, slope
from netkf.theory.threshold import growth, threshold_factor

TOLERANCE = 1e-10
DEFECT = 1e-7
CHECKED_STEPS = 200
_GAUSS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)


def covariance_bound(scenario: Scenario, times: Any) -> FloatArray:
    """(T, N, n, n): the solution of H(12) at ``times`` (increasing seconds), with the effective
    rates of the channel; for filters that do not talk it is their own covariance.

    By H Theorem 2 it bounds E[P_i(t)]. Integrated with relative tolerance 1e-10 and returned only
    when the defect of the integral equation is below 1e-7. Raises TheoryError where the theorem
    does not apply, and says why.
    """
    moments = np.atleast_1d(np.asarray(times, dtype=np.float64))
    if moments.ndim != 1 or (np.diff(moments) < 0.0).any() or (moments < 0.0).any():
        raise TheoryError("times must be increasing and not negative")
    equations = coupled(scenario)
    P = np.empty((len(moments), *equations.start.shape))
    last, pieces = float(moments[-1]), _Pieces(equations)
    pieces.extend(last)
    for k, t in enumerate(moments):
        P[k] = pieces(float(t))
    return symmetric(P)


class _Pieces:
    """The solution up to some time, one dense output for each stretch of one delay."""

    def __init__(self, equations: Coupled) -> None:
        self._equations = equations
        self._ends: list[float] = [0.0]
        self._outputs: list[Callable[[float], FloatArray]] = []

    def __call__(self, t: float) -> FloatArray:
        start = self._equations.start
        if t <= 0.0:
            return start
        piece = int(np.searchsorted(self._ends, t)) - 1
        return self._outputs[piece](t).reshape(start.shape)

    def extend(self, last: float) -> None:
        """Integrate on to ``last``."""
        delay = self._equations.delay
        while self._ends[-1] < last:
            begin = self._ends[-1]
            end = last if delay == 0.0 else min(last, begin + delay)
            self._integrate(begin, end, self._slope(begin))
            self._ends.append(end)

    def _slope(self, begin: float) -> Callable[[float, FloatArray], FloatArray]:
        equations, shape = self._equations, self._equations.start.shape
        silent = equations._replace(coupling=0.0 * equations.coupling)

        def f(t: float, y: FloatArray) -> FloatArray:
            P = y.reshape(shape)
            if equations.delay == 0.0:
                return slope(equations, P, P).reshape(-1)
            if begin < equations.delay * (1.0 - 1e-12):  # nothing has arrived yet
                return slope(silent, P, P).reshape(-1)
            return slope(equations, P, self(t - equations.delay)).reshape(-1)

        return f

    def _integrate(
        self, begin: float, end: float, f: Callable[[float, FloatArray], FloatArray]
    ) -> None:
        y = self(begin).reshape(-1)
        scale = max(float(np.abs(y).max()), float(np.abs(self._equations.Q).max()), 1e-300)
        with np.errstate(over="ignore", invalid="ignore"):
            solved = scipy.integrate.solve_ivp(
                f,
                (begin, end),
                y,
                method="DOP853",
                dense_output=True,
                rtol=TOLERANCE,
                atol=1e-3 * TOLERANCE * scale,
            )
        if not solved.success:
            raise TheoryError(f"H(12) could not be integrated to {end:g} s: {solved.message}")
        assert solved.sol is not None
        _check_defect(f, solved.sol)
        self._outputs.append(solved.sol)


def _check_defect(f: Callable[[float, FloatArray], FloatArray], output: Any) -> None:
    """Compare the change over steps of the solver with the integral of the slope."""
    times = output.ts
    steps = np.unique(np.linspace(0, len(times) - 2, CHECKED_STEPS).astype(int))
    for k in steps:
        a, b = times[k], times[k + 1]
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        change = output(b) - output(a)
        integral = half * sum(
            w * f(middle + half * z, output(middle + half * z))
            for z, w in zip(_GAUSS, _GAUSS_WEIGHTS, strict=True)
        )
        defect = np.abs(change - integral).max()
        if not defect <= DEFECT * (np.abs(output(b)).max() + np.abs(change).max()):
            raise TheoryError(f"H(12) was integrated with a defect of {defect:.1e} at {a:g} s")


def steady_covariance_bound(scenario: Scenario) -> FloatArray:
    """(N, n, n): the steady state of H(12).

    Newton's method from gains that a linear equation has proved stabilising; returned with a
    relative residual below 1e-9. Raises TheoryError where there is none, with the factor by
    which all link rates would have to grow for one to exist.
    """
    equations = coupled(scenario)
    P = _stabilising(equations)
    if P is None:
        raise TheoryError(_below_threshold(scenario, equations))
    for _ in range(60):
        following = _newton(equations, P)
        change = np.abs(following - P).max()
        P = following
        if change <= 1e-13 * np.abs(P).max():
            break
    residual = np.abs(slope(equations, P, P)).max()
    size = (
        np.abs(equations.Q).max()
        + np.abs(P @ equations.G @ P).max()
        + np.abs(equations.A @ P).max()
    )
    if not residual <= 1e-9 * size:
        raise TheoryError(f"the steady state of H(12) was solved to {residual:.1e} only")
    return P


def _solve(equations: Coupled, P: FloatArray, right: FloatArray) -> FloatArray:
    operator = linear_operator(equations, P @ equations.G)
    solution = scipy.sparse.linalg.spsolve(operator.tocsc(), -right.reshape(-1))
    return symmetric(np.asarray(solution).reshape(P.shape))


def _newton(equations: Coupled, P: FloatArray) -> FloatArray:
    inflow = np.asarray(equations.coupling.sum(axis=1)).reshape(-1, 1, 1) * equations.q
    return _solve(equations, P, equations.Q + P @ equations.G @ P + inflow)


def _stable(equations: Coupled, P: FloatArray) -> bool:
    """Whether the gains of P stabilise H(12) made linear.

    That map X -> op(X) is a generator of positive maps, so it is stable if and only if
    op(X) = -I has a positive definite solution.
    """
    eye = np.broadcast_to(np.eye(P.shape[-1]), P.shape)
    with np.errstate(all="ignore"):
        X = _solve(equations, P, eye)
    return bool(np.isfinite(X).all() and np.linalg.eigvalsh(X)[:, 0].min() > 0.0)


def _stabilising(equations: Coupled) -> FloatArray | None:
    """Covariances whose gains stabilise H(12), found on its own path; None where none exist."""
    without_delay = equations._replace(delay=0.0)
    P = equations.start + equations.Q + 1e-3 * np.eye(len(equations.A))
    fastest = float(np.abs(equations.A).max() + equations.coupling.sum(axis=1).max() + 1e-3)
    stretch, decided = 1.0 / fastest, False
    for _ in range(40):
        if _stable(equations, P):
            return P
        if not decided and stretch * fastest > 16.0:
            if growth(equations, 1.0) >= 0.0:
                return None
            decided = True
        pieces = _Pieces(without_delay._replace(start=P))
        pieces.extend(stretch)
        P, stretch = symmetric(pieces(stretch)), 1.5 * stretch
        if not np.abs(P).max() < 1e100:
            return None
    return None


def _below_threshold(scenario: Scenario, equations: Coupled) -> str:
    factor = threshold_factor(equations)
    if factor is None:
        return "H(12) has no steady state at any rate: the sensors together miss a growing mode"
    activation = scenario.network.activation
    rate = getattr(activation, "rate", None)
    words = f"every link rate must be at least {factor:.6g} times what it is"
    if rate is not None and not getattr(activation, "rates", ()):
        words = f"the rate {rate:g} is below the threshold {factor * rate:.6g}"
    return f"H(12) has no steady state: {words}"
