"""The bound H(12) over time."""

from __future__ import annotations

import bisect
import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.integrate

from netkf.algorithms.kernels.riccati import RiccatiTable, riccati_step, riccati_table
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.hybrid.coupled import Coupled, coupled
from netkf.theory.hybrid.packed import Packed
from netkf.theory.hybrid.taylor import StiffError, followed
from netkf.theory.numerics.updates import Observation

TOLERANCE = 1e-10
DEFECT = 1e-7
CHECKED_STEPS = 200
EXPLICIT_EVALUATIONS = 20_000
OVERFLOW = 1e150
MAX_ROUNDS, SETTLED = 40, 1e-8
PARTS = (1, 40, 400)  # of a stretch that a step is at most one of, try after try
_GAUSS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)


def covariance_bound(scenario: Scenario, times: Any) -> FloatArray:
    """(T, N, n, n): the solution of H(12) at ``times`` (increasing seconds), with the effective
    rates of the channel; for filters that do not talk it is their own covariance.

    By H Theorem 2 it bounds E[P_i(t)], and with sensors that sample by Poisson clocks or at known
    times by docs/poisson_samples.md. Integrated with relative tolerance 1e-10 and returned only
    when the defect is below that (below 1e-7 with a delay or samples, or where precise sensors hear
    of large covariances). Raises TheoryError where the theorem does not apply, and says why.
    """
    moments = np.atleast_1d(np.asarray(times, dtype=np.float64))
    if moments.ndim != 1 or not moments.size or not np.isfinite(moments).all():
        raise TheoryError("times must be a list of finite numbers that is not empty")
    if (np.diff(moments) < 0.0).any() or moments[0] < 0.0:
        raise TheoryError("times must be increasing and not negative")
    equations = coupled(scenario)
    if equations.jumps and moments[-1] > scenario.horizon:
        raise TheoryError("samples at known times are known up to the horizon")
    if not equations.talks and not equations.samples and not equations.jumps:
        P = _uncoupled(equations, moments)
    else:
        packed = Packed(equations)
        P = packed.unpack(_solution(packed, moments))
    if not np.abs(P).max() < OVERFLOW:
        raise TheoryError(f"H(12) grows beyond {OVERFLOW:g} before {moments[-1]:g} s")
    return P


def _solution(packed: Packed, times: FloatArray) -> FloatArray:
    equations = packed.equations
    if equations.delay == 0.0 and not equations.samples and not equations.jumps:
        with contextlib.suppress(StiffError), np.errstate(over="ignore", invalid="ignore"):
            return followed(packed, times, _scale(packed), EXPLICIT_EVALUATIONS, OVERFLOW)
    pieces = _Pieces(packed)
    pieces.extend(float(times[-1]))
    return np.stack([pieces(float(t)) for t in times])


def _scale(packed: Packed) -> float:
    """The size of covariances and of what drives them."""
    sizes = (np.abs(packed.start).max(), np.abs(packed.equations.Q).max())
    return max(*(float(size) for size in sizes), 1e-300)


def _uncoupled(equations: Coupled, times: FloatArray) -> FloatArray:
    """The Riccati flow of each node by itself."""
    P = np.empty((len(times), *equations.start.shape))
    tables: dict[bytes, RiccatiTable] = {}
    nothing = np.zeros(len(equations.A))
    with np.errstate(over="ignore", invalid="ignore"):
        for i, (G, start) in enumerate(zip(equations.G, equations.start, strict=True)):
            key = G.tobytes()
            if key not in tables:
                longest = max(float(times[-1]), 1e-9)
                tables[key] = riccati_table(equations.A, equations.Q, G, longest)
            for k, t in enumerate(times):
                P[k, i] = riccati_step(tables[key], start, nothing, float(t))[0] if t else start
    return P


class _Pieces:
    """The solution up to some time, one dense output for each stretch of one delay."""

    def __init__(self, packed: Packed) -> None:
        self._packed = packed
        equations = packed.equations
        quiet = tuple(s._replace(heard=0.0 * s.heard) for s in equations.samples)
        self._silent = Packed(equations._replace(coupling=0.0 * equations.coupling, samples=quiet))
        self._jumps = _Jumps(packed)
        self._first = packed.start
        self._jumped: dict[float, FloatArray] = {}
        self._ends: list[float] = [0.0]
        self._outputs: list[Callable[[float], FloatArray]] = []

    def __call__(self, t: float) -> FloatArray:
        start = self._packed.start
        if t <= 0.0:
            return start
        if t in self._jumped:
            return self._jumped[t]
        # t may lie a rounding error beyond what is known so far.
        piece = min(int(np.searchsorted(self._ends, t)), len(self._outputs)) - 1
        return self._outputs[piece](t).reshape(start.shape)

    def extend(self, last: float) -> None:
        """Integrate on to ``last``.

        With a delay, stretch after stretch: nothing arrives before the first one is over. A stretch
        is one delay long, over which all that arrives is known, or, where the delay is much
        shorter than the times between messages, half such a time; what arrives from within it is
        then found by iteration (Picard), which gains a factor 2 k in the k-th round. Stretches end
        where the solution jumps and where that arrives.
        """
        delay = self._packed.equations.delay
        inflow = float(self._packed.leaving.max())
        while self._ends[-1] < last:
            begin = self._ends[-1]
            if delay == 0.0:
                end = last
            elif begin < delay:
                end = min(last, delay)
            else:
                end = min(last, begin + max(delay, 0.5 / max(inflow, 1e-300)))
            end = self._jumps.before(begin, end)
            f = self._slope(begin)
            if delay == 0.0 or end - begin <= delay * (1.0 + 1e-12):
                self._append(end, self._integrate(begin, end, f))
            else:
                self._iterate(begin, end, f)
            if self._jumps.happens(end):
                self._first = self._jumped[end] = self._jumps.after(end, self._first)

    def _append(self, end: float, output: Callable[[float], FloatArray]) -> None:
        self._outputs.append(output)
        self._ends.append(end)
        self._first = output(end).reshape(self._packed.start.shape)

    def _iterate(
        self, begin: float, end: float, f: Callable[[float, FloatArray], FloatArray]
    ) -> None:
        first = self._first.reshape(-1)
        places = np.linspace(begin, end, 9)[1:]
        jumped = self._first
        self._append(end, lambda _: first)
        last = np.inf
        for _ in range(MAX_ROUNDS):
            before = np.array([self(t).reshape(-1) for t in places])
            self._first = jumped
            self._outputs[-1] = self._integrate(begin, end, f)
            self._first = self._outputs[-1](end).reshape(jumped.shape)
            after = np.array([self(t).reshape(-1) for t in places])
            change = float(np.abs(after - before).max() / np.abs(after).max())
            # What the steps of the solver change from round to round stays.
            if change <= TOLERANCE or (0.5 * last < change <= SETTLED):
                return
            last = change
        raise TheoryError(f"what arrives late did not settle between {begin:g} and {end:g} s")

    def _slope(self, begin: float) -> Callable[[float, FloatArray], FloatArray]:
        packed, silent, delay = self._packed, self._silent, self._packed.equations.delay

        def f(t: float, y: FloatArray) -> FloatArray:
            Y = y.reshape(packed.start.shape)
            if not np.abs(y).max() < OVERFLOW:
                raise TheoryError(f"H(12) grows beyond {OVERFLOW:g} before {t:g} s")
            if delay == 0.0:
                return packed.slope(Y).reshape(-1)
            if begin < delay * (1.0 - 1e-12):  # nothing has arrived yet
                return silent.slope(Y).reshape(-1)
            return packed.slope(Y, self(t - delay)).reshape(-1)

        return f

    def _integrate(
        self, begin: float, end: float, f: Callable[[float, FloatArray], FloatArray]
    ) -> Callable[[float], FloatArray]:
        refused: TheoryError | None = None
        for parts in PARTS:  # what is wrong between the steps gets better with shorter ones
            most = (end - begin) / parts if parts > 1 else np.inf
            solved = self._solved(begin, end, f, most)
            if not solved.success:
                raise TheoryError(f"H(12) could not be integrated to {end:g} s: {solved.message}")
            assert solved.sol is not None
            try:
                _check_defect(f, solved.sol)
            except TheoryError as error:
                refused = refused or error
                continue
            output: Callable[[float], FloatArray] = solved.sol
            return output
        assert refused is not None
        raise refused

    def _solved(
        self, begin: float, end: float, f: Callable[[float, FloatArray], FloatArray], most: float
    ) -> Any:
        with np.errstate(over="ignore", invalid="ignore"):
            equations = self._packed.equations
            # Without delays and samples only what is stiff comes here.
            if equations.delay > 0.0 or equations.samples or equations.jumps:
                # An explicit stage that overflows is no word about the solution.
                with contextlib.suppress(StiffError, TheoryError):
                    return self._solve(begin, end, _limited(f), method="DOP853", max_step=most)
            # A blind node's large covariance reaches precise sensors: P G is a large rate.
            return self._solve(begin, end, f, method="Radau", jac=self._jacobian, max_step=most)

    def _solve(
        self, begin: float, end: float, f: Callable[[float, FloatArray], FloatArray], **method: Any
    ) -> Any:
        y = self._first.reshape(-1)
        return scipy.integrate.solve_ivp(
            f,
            (begin, end),
            y,
            dense_output=True,
            rtol=TOLERANCE,
            atol=1e-3 * TOLERANCE * _scale(self._packed),
            **method,
        )

    def _jacobian(self, t: float, y: FloatArray) -> Any:
        linear = self._packed.linear(self._packed.unpack(y.reshape(self._packed.start.shape)))
        # With a delay what arrives is known, only what leaves depends on P.
        return linear.matrix(arriving=self._packed.equations.delay == 0.0)


class _Jumps:
    """What happens at known times, and when what was sent then arrives."""

    def __init__(self, packed: Packed) -> None:
        self._packed = packed
        equations = packed.equations
        self._happens = {jump.time: jump for jump in equations.jumps}
        self._arrives: dict[float, tuple[FloatArray, FloatArray]] = {}
        delay = equations.delay
        later = [jump.time + delay for jump in equations.jumps]
        self._times = sorted({*self._happens, *later})

    def before(self, begin: float, end: float) -> float:
        """The first of these times after ``begin``, if it is before ``end``."""
        place = bisect.bisect_right(self._times, begin)
        return min(end, self._times[place]) if place < len(self._times) else end

    def happens(self, time: float) -> bool:
        """Whether anything does."""
        return time in self._happens or time in self._arrives

    def after(self, time: float, Y: FloatArray) -> FloatArray:
        """(N, m) once all of that time has happened: samples, and then what arrives."""
        packed, equations = self._packed, self._packed.equations
        jump = self._happens.get(time)
        if jump is not None:
            P = packed.unpack(Y)
            for node, seen in jump.seen.items():
                P[node] = _sampled(P[node], seen)
            Y = packed.pack(P)
            if jump.sent is not None:
                self._arrives[time + equations.delay] = jump.sent, Y
        arriving = self._arrives.pop(time, None)
        if arriving is None:
            return Y
        weights, sent = arriving
        if equations.delay > 0.0:
            sent = packed.predicted(sent)
        kept = 1.0 - weights.sum(axis=1)
        return np.asarray(kept[:, None] * Y + weights @ sent)


def _sampled(P: FloatArray, seen: Observation) -> FloatArray:
    """``g(P)``, as ``(I - K H) P (I - K H)' + K R K'``."""
    K = np.linalg.solve(seen.H @ P @ seen.H.T + seen.R, seen.H @ P).T
    closed = np.eye(len(P)) - K @ seen.H
    return np.asarray(closed @ P @ closed.T + K @ seen.R @ K.T)


def _limited(
    f: Callable[[float, FloatArray], FloatArray],
) -> Callable[[float, FloatArray], FloatArray]:
    left = EXPLICIT_EVALUATIONS

    def counted(t: float, y: FloatArray) -> FloatArray:
        nonlocal left
        left -= 1
        if left < 0:
            raise StiffError
        return f(t, y)

    return counted


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
