"""The bound H(12) over time: explicit, implicit and piecewise integration, all checked.

H(12), equation (12) of the paper H on the hybrid filter, are coupled Riccati equations of the
covariances of N nodes (theory/hybrid/coupled.py). Their solution bounds the mean of the filters'
random covariances from above. It is packed here: of each covariance (n, n) only the
m = n (n + 1) / 2 entries of the upper triangle.
"""

from __future__ import annotations

import bisect
import contextlib
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.kernels.riccati import RiccatiFlow, flow_covariance, move_covariances
from netkf.core.errors import TheoryError
from netkf.linalg.arrays import FloatArray
from netkf.scenario.scenario import Scenario
from netkf.theory.common.observations import joseph_update
from netkf.theory.hybrid.coupled import CoupledRiccati, at_nodes, coupled_riccati
from netkf.theory.hybrid.packed import PackedRiccati
from netkf.theory.numerics.matrices import as_times

TOLERANCE = 1e-10  # relative, of the solver
ORDER = 28  # of Taylor series: few steps, each still far from where powers overflow
TERM_TOLERANCE, SERIES_TOLERANCE = 1e-12, 1e-10  # of last terms and defect, relative
FLOOR = 1e-13  # times the scale of the problem: absolute error that is always allowed
DEFECT_TOLERANCE = 1e-7  # relative, of the finished solution
MAX_CHECKED_STEPS = 200  # steps of a piece whose defect is computed
MAX_EXPLICIT_EVALUATIONS = 20_000  # of the slope, or Taylor coefficients; more mean stiffness
OVERFLOW = 1e150  # entry of P from which the solution is given up
MIN_STEP = 1e-6  # in spans: shorter ones mean stiffness
MAX_ROUNDS, ROUND_TOLERANCE = 40, 1e-8  # of Picard iteration
ROUNDING = 4e-16  # of the largest entry of all nodes: what arrives at a node is rounded to that
GROWTH = 10.0  # factor by which a solution may grow before tolerances are chosen anew
PARTS = (1, 40, 400)  # try after try, a step of the solver lasts at most a piece over this number
Slope = Callable[[float, FloatArray], FloatArray]
"""dy/dt of the flat packed solution y, from t (seconds) and y."""

_ORDERS = np.arange(ORDER + 1)
_BINOMIAL = np.array([[math.comb(j, k) for j in range(ORDER + 1)] for k in range(ORDER + 1)], float)
# Exact for polynomials of degree 9.
_GAUSS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)


def covariance_bound(scenario: Scenario, times: Any) -> FloatArray:
    """Return the upper bound (T, N, n, n) on the mean covariances E[P_i(t)] of N nodes at T
    ``times`` (seconds, increasing): the solution of the coupled Riccati equations H(12).

    The rates are the effective ones of the channel; for filters that do not communicate, and do
    not sample at random, the solution is their own covariance. That it is a bound is paper H
    Theorem 2, and docs/poisson_samples.md for sensors that sample by Poisson clocks or at known
    times. Integrated with relative tolerance 1e-10 and returned only if the defect is below that
    (below 1e-7 with a delay or samples, or where H(12) is stiff). Raises TheoryError, with the
    reason, if the theorem does not apply.
    """
    instants = as_times(times)
    if len(scenario.plant.changes):
        return _bound_over_pieces(scenario, instants)
    equations = coupled_riccati(scenario)
    if equations.jumps and instants[-1] > scenario.horizon:
        raise TheoryError("samples at known times are known up to the horizon")
    if not equations.talks and not equations.samples:
        P = _solve_uncoupled(equations, instants)
    else:
        packed = PackedRiccati(equations)
        P = packed.unpack(_solve_coupled(packed, instants))
    if not np.abs(P).max() < OVERFLOW:
        raise TheoryError(f"Tanwani's H(12) grows beyond {OVERFLOW:g} before {instants[-1]:g} s")
    return at_nodes(scenario, P)


def _bound_over_pieces(scenario: Scenario, times: FloatArray) -> FloatArray:
    edges, bounds = [0.0, *scenario.plant.changes.tolist(), math.inf], []
    cov: tuple[FloatArray, ...] | FloatArray | None = None
    for k, (start, end) in enumerate(itertools.pairwise(edges)):
        piece = scenario.piece(k, cov)
        equations = coupled_riccati(piece)
        if equations.talks and equations.delay > 0.0:
            raise TheoryError(
                "Tanwani's H(12) with delays is not known across changes of the plant, where "
                "messages are under way"
            )
        if equations.jumps:
            raise TheoryError(
                "Tanwani's H(12) with samples at known times is not known across changes of the "
                "plant"
            )
        inside = times[(times >= start) & (times < end)] - start
        last = [end - start] if end <= times[-1] else []
        moments = np.concatenate([inside, last])
        if not moments.size:
            break
        bound = covariance_bound(piece, moments)
        bounds.append(bound[: len(inside)])
        cov = bound[-1, 0] if piece.node_filter.timing.pooled else tuple(bound[-1])
    return np.concatenate(bounds)


def _solve_coupled(packed: PackedRiccati, times: FloatArray) -> FloatArray:
    """Return the packed bound (T, N, m) of H(12) at ``times``, m = n (n + 1) / 2."""
    equations = packed.equations
    if equations.delay == 0.0 and not equations.samples and not equations.jumps:
        with contextlib.suppress(StiffError), np.errstate(over="ignore", invalid="ignore"):
            return _solve_by_taylor_series(packed, times)
    solution = _PiecewiseSolution(packed)
    solution.extend(float(times[-1]))
    return np.stack([solution(float(t)) for t in times])


def _solve_by_taylor_series(packed: PackedRiccati, times: FloatArray) -> FloatArray:
    """Return the packed bound (T, N, m) without delays and samples; StiffError if it takes long."""
    bound = np.empty((len(times), *packed.start.shape))
    count = int(np.searchsorted(times, 0.0, side="right"))
    bound[:count] = packed.start
    for step in _taylor_steps(packed, packed.start, 0.0, float(times[-1])):
        until = int(np.searchsorted(times, step.end, side="right"))
        bound[count:until] = step.at(times[count:until])
        count = until
    return bound


class _TaylorStep(NamedTuple):
    """A step of a solution by Taylor series.

    start, end : seconds
    span       : seconds that are 1 in the polynomials
    series     : (ORDER + 1, N, m) coefficients, from ``start``
    """

    start: float
    end: float
    span: float
    series: FloatArray

    def at(self, times: FloatArray) -> FloatArray:
        """Return the packed solution (T, N, m) at ``times`` (T,), seconds."""
        powers = ((times - self.start) / self.span)[:, None] ** _ORDERS
        return np.tensordot(powers, self.series, 1)

    def moved(self, start: float, span: float) -> FloatArray:
        """Return the coefficients of the same polynomials from ``start`` in ``span`` seconds."""
        x, scale = (start - self.start) / self.span, span / self.span
        powers = x ** np.maximum(_ORDERS - _ORDERS[:, None], 0) * scale ** _ORDERS[:, None]
        return np.tensordot(_BINOMIAL * powers, self.series, 1)


class _TaylorSeries:
    """A solution over successive steps by Taylor series; as a function, flat (N m,) at a time."""

    def __init__(self, steps: Iterator[_TaylorStep]) -> None:
        self._steps = list(steps)
        self._ends = [step.end for step in self._steps]

    def step_at(self, t: float) -> _TaylorStep:
        """Return the step at ``t`` (seconds); the last one also after its end."""
        return self._steps[min(bisect.bisect_right(self._ends, t), len(self._steps) - 1)]

    def __call__(self, t: float) -> FloatArray:
        return self.step_at(t).at(np.array([t])).reshape(-1)


def _taylor_steps(
    packed: PackedRiccati,
    Y: FloatArray,
    now: float,
    last: float,
    sent: Callable[[float], _TaylorStep] | None = None,
) -> Iterator[_TaylorStep]:
    """Yield the steps from ``Y`` (N, m) at ``now`` to ``last``, in seconds; StiffError if they get
    too many. ``sent`` returns the step of the solution a delay before a time, as if it were now.
    """
    # The right-hand side is quadratic, so that a coefficient of any order costs about one
    # evaluation (Moore 1966; Barton, Willers and Zahar 1971).
    scale, evaluations = _covariance_scale(packed), 0

    def late(t: float) -> FloatArray | None:
        return None if sent is None else sent(t).at(np.array([t]))[0]

    # Time is measured in spans, over which the solution changes by about its own size.
    slope = float(np.abs(packed.slope(Y, late(now))).max())
    span = float(np.abs(Y).max() + scale) / max(slope, 1e-300)
    while now < last:
        evaluations += ORDER
        span = min(span, last - now)
        arriving = None if sent is None else sent(now).moved(now, span)
        series = packed.series(Y, span, ORDER, arriving)
        shares = (np.abs(series[-2:]).max(axis=2) / (np.abs(Y).max(axis=1) + FLOOR * scale)).max(1)
        lengths = (TERM_TOLERANCE / np.maximum(shares, 1e-300)) ** (1.0 / _ORDERS[-2:])
        step = min(float(lengths.min()), (last - now) / span)
        while True:  # until the polynomial satisfies the equation at the end
            if evaluations > MAX_EXPLICIT_EVALUATIONS or not step > MIN_STEP:
                raise StiffError
            end = last if step * span >= last - now else now + step * span
            Y = np.tensordot(step**_ORDERS, series, 1)
            derivative = np.tensordot(_ORDERS[1:] * step ** _ORDERS[:-1], series[1:], 1)
            defect = step * np.abs(derivative - span * packed.slope(Y, late(end))).max(axis=1)
            if (defect <= SERIES_TOLERANCE * (np.abs(Y).max(axis=1) + FLOOR * scale)).all():
                break
            step *= 0.7
        if not np.abs(Y).max() < OVERFLOW:
            raise TheoryError(f"Tanwani's H(12) grows beyond {OVERFLOW:g} before {end:g} s")
        yield _TaylorStep(now, end, span, series)
        now, span = end, step * span


def _covariance_scale(packed: PackedRiccati) -> float:
    """Return the largest entry of the first covariances and Q, for which entries count as 0."""
    sizes = (np.abs(packed.start).max(), np.abs(packed.equations.Q).max())
    return max(*(float(size) for size in sizes), 1e-300)


def _solve_uncoupled(equations: CoupledRiccati, times: FloatArray) -> FloatArray:
    """Return P (T, N, n, n) at ``times``, after the samples there, of nodes that receive nothing
    and sample at known times if at all.
    """
    P = np.empty((len(times), *equations.start.shape))
    jumps = {jump.time: jump.observations for jump in equations.jumps if jump.time <= times[-1]}
    instants = np.union1d(times, list(jumps)).tolist()
    # Nodes with equal sensors move together, and over equal gaps alike.
    groups: dict[bytes, list[int]] = {}
    for i, G in enumerate(equations.G):
        groups.setdefault(G.tobytes(), []).append(i)
    for nodes in groups.values():
        flows: dict[float, RiccatiFlow] = {}
        now, present = 0.0, equations.start[nodes]
        for t in instants:
            gap = t - now
            if gap not in flows:
                flows[gap] = flow_covariance(equations.A, equations.Q, equations.G[nodes[0]], gap)
            now, present = t, move_covariances(flows[gap], present)
            observations = jumps.get(t, {})
            for k, node in enumerate(nodes if observations else ()):
                if node in observations:
                    present[k] = joseph_update(present[k], observations[node])
            P[np.searchsorted(times, t, "left") : np.searchsorted(times, t, "right"), nodes] = (
                present
            )
    return P


class StiffError(Exception):
    """Raised when an implicit method is cheaper."""


class _PiecewiseSolution:
    """The packed solution Y(t) (N, m) of H(12) up to the time that ``extend`` has reached.

    _outputs            : the solution over each piece, as a function of time that returns N m
    _piece_ends         : the time 0 and the ends of the pieces, seconds
    _start_value        : (N, m) the solution where the next piece begins
    _values_after_jumps : by time, the solution (N, m) just after it jumps
    _without_arrivals   : the equations until the first message has taken the delay
    _by_series          : whether Taylor series have solved every piece so far
    """

    def __init__(self, packed: PackedRiccati) -> None:
        """Begin at time 0 with the start of the equations ``packed``; nothing is integrated yet."""
        self._packed = packed
        equations = packed.equations
        # Until the first message has taken the delay, nodes lose nothing and receive nothing.
        quiet = tuple(s._replace(heard=0.0 * s.heard) for s in equations.samples)
        silent = equations._replace(coupling=0.0 * equations.coupling, samples=quiet)
        self._without_arrivals = PackedRiccati(silent)
        self._jumps = _SampleJumps(packed)
        # Rates of samples are no polynomials. Without jumps series have found the equations stiff.
        self._by_series = not equations.samples and (equations.delay > 0.0 or bool(equations.jumps))
        self._start_value = packed.start
        self._values_after_jumps: dict[float, FloatArray] = {}
        self._piece_ends: list[float] = [0.0]
        self._outputs: list[Callable[[float], FloatArray]] = []

    def __call__(self, t: float) -> FloatArray:
        """Return the packed solution (N, m) at time ``t`` (seconds)."""
        start = self._packed.start
        if t <= 0.0:
            return start
        if t in self._values_after_jumps:
            return self._values_after_jumps[t]
        # t may exceed the last end by a rounding error.
        return self._outputs[self._piece_at(t)](t).reshape(start.shape)

    def _piece_at(self, t: float) -> int:
        return min(int(np.searchsorted(self._piece_ends, t)), len(self._outputs)) - 1

    def extend(self, last: float) -> None:
        """Integrate H(12) up to time ``last`` (seconds), and append the pieces of its solution."""
        # With a delay, covariances of one delay ago enter: a piece is one delay long, so that all
        # that arrives in it is known. If the delay is much shorter than the time between messages,
        # a piece is half that time long, and Picard iteration finds its arrivals: with h its length
        # and c their rate the error after k rounds falls like (c h)^k / k!, c h = 1/2. Pieces end
        # at jumps.
        delay = self._packed.equations.delay
        while self._piece_ends[-1] < last:
            begin = self._piece_ends[-1]
            end = self._jumps.before(begin, self._piece_end(begin, last))
            slope = self._slope(begin)
            if delay == 0.0 or end - begin <= delay * (1.0 + 1e-12):
                output, end = self._integrate(begin, end, slope, math.inf if delay else GROWTH)
                if not end > begin:
                    raise TheoryError(f"Tanwani's H(12) could not be integrated beyond {begin:g} s")
                self._append(end, output)
            else:
                self._iterate(begin, end, slope)
            if end in self._jumps:
                self._start_value = self._values_after_jumps[end] = self._jumps.apply(
                    end, self._start_value
                )

    def _piece_end(self, begin: float, last: float) -> float:
        """Return the latest end of the piece from ``begin``, at most ``last``, in seconds."""
        delay = self._packed.equations.delay
        if delay == 0.0:
            return last
        if begin < delay:
            return min(last, delay)
        # The largest sum of the coefficients c_ij of a node: rates of arrivals (1/s) times weights.
        inflow = float(self._packed.leaving.max())
        return min(last, begin + max(delay, 0.5 / max(inflow, 1e-300)))

    def _append(self, end: float, output: Callable[[float], FloatArray]) -> None:
        self._outputs.append(output)
        self._piece_ends.append(end)
        self._start_value = output(end).reshape(self._packed.start.shape)

    def _iterate(self, begin: float, end: float, slope: Slope) -> None:
        """Append a piece longer than the delay by Picard iteration; raises TheoryError."""
        start = self._start_value
        probes = np.linspace(begin, end, 9)[1:]
        self._append(end, lambda _: start.reshape(-1))  # first guess: constant
        last_change = np.inf
        for _ in range(MAX_ROUNDS):
            old_values = np.array([self(t).reshape(-1) for t in probes])
            self._start_value = start
            self._outputs[-1], _ = self._integrate(begin, end, slope)
            self._start_value = self._outputs[-1](end).reshape(start.shape)
            values = np.array([self(t).reshape(-1) for t in probes])
            change = float(np.abs(values - old_values).max() / np.abs(values).max())
            # The solver's choice of steps differs between rounds, which leaves a small change.
            if change <= TOLERANCE or (0.5 * last_change < change <= ROUND_TOLERANCE):
                return
            last_change = change
        raise TheoryError(f"late arrivals did not converge between {begin:g} and {end:g} s")

    def _slope(self, begin: float) -> Slope:
        """Return the right-hand side of H(12) for a piece from ``begin`` (seconds)."""
        packed, silent, delay = self._packed, self._without_arrivals, self._packed.equations.delay

        def slope(t: float, y: FloatArray) -> FloatArray:
            """Return dy/dt (N m,) of the packed covariances ``y`` (N m,) at ``t`` (seconds)."""
            Y = y.reshape(packed.start.shape)
            if not np.abs(y).max() < OVERFLOW:
                raise TheoryError(f"Tanwani's H(12) grows beyond {OVERFLOW:g} before {t:g} s")
            if delay == 0.0:
                return packed.slope(Y).reshape(-1)
            if begin < delay * (1.0 - 1e-12):  # nothing has arrived yet
                return silent.slope(Y).reshape(-1)
            return packed.slope(Y, self(t - delay)).reshape(-1)

        return slope

    def _integrate(
        self, begin: float, end: float, slope: Slope, growth: float = math.inf
    ) -> tuple[Callable[[float], FloatArray], float]:
        """Return the solution from ``begin`` and its last time: ``end``, or at ``growth``."""
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                return self._expand(begin, end), end
        except StiffError:
            self._by_series = False
        first_error: TheoryError | None = None
        for step_count in PARTS:  # shorter steps reduce the error of the dense output between them
            max_step = (end - begin) / step_count if step_count > 1 else np.inf
            result = self._integrate_piece(begin, end, slope, max_step, growth)
            if not result.success:
                raise TheoryError(
                    f"Tanwani's H(12) could not be integrated to {end:g} s: {result.message}"
                )
            assert result.sol is not None
            try:
                ends = result.sol.ts
                for k in np.unique(np.linspace(0, len(ends) - 2, MAX_CHECKED_STEPS).astype(int)):
                    _check_step(slope, result.sol, ends[k], ends[k + 1])
            except TheoryError as error:
                first_error = first_error or error
                continue
            output: Callable[[float], FloatArray] = result.sol
            return output, float(result.t[-1])
        assert first_error is not None
        raise first_error

    def _expand(self, begin: float, end: float) -> _TaylorSeries:
        """Return the solution from ``begin`` to ``end`` by Taylor series; raises StiffError."""
        delay, inside = self._packed.equations.delay, 1e-9 * (end - begin)
        if not self._by_series or 0.0 < delay * (1.0 + 1e-12) < end - begin:
            raise StiffError

        def sent(t: float) -> _TaylorStep:
            # What was sent at a jump is that before it at the end of a piece, else that after it.
            past = min(max(t, begin + inside), end - inside) - delay
            output = self._outputs[self._piece_at(past)]
            assert isinstance(output, _TaylorSeries)
            step = output.step_at(past)
            return step._replace(start=step.start + delay, end=step.end + delay)

        if delay == 0.0:
            steps = _taylor_steps(self._packed, self._start_value, begin, end)
        elif begin < delay * (1.0 - 1e-12):  # nothing has arrived yet
            steps = _taylor_steps(self._without_arrivals, self._start_value, begin, end)
        else:
            steps = _taylor_steps(self._packed, self._start_value, begin, end, sent)
        return _TaylorSeries(steps)

    def _integrate_piece(
        self, begin: float, end: float, slope: Slope, max_step: float, growth: float
    ) -> Any:
        """Return solve_ivp's result: explicit unless stiff, then implicit until ``growth``."""
        equations = self._packed.equations
        with np.errstate(over="ignore", invalid="ignore"):
            # Without delays and samples Taylor series have found the equations stiff before.
            if equations.delay > 0.0 or equations.samples or equations.jumps:
                # An explicit stage that overflows says nothing about the solution itself.
                with contextlib.suppress(StiffError, TheoryError):
                    limited = _limit_evaluations(slope)
                    return self._solve(begin, end, limited, method="DOP853", max_step=max_step)
            # A large covariance that reaches a node with precise sensors decays at the rate P G.
            return self._solve(
                begin,
                end,
                slope,
                method="Radau",
                jac=self._jacobian,
                max_step=max_step,
                events=_growth_event(growth * float(self._entry_sizes().max())),
            )

    def _solve(self, begin: float, end: float, slope: Slope, **method: Any) -> Any:
        """Return solve_ivp's result for a piece with the options ``method``."""
        # It takes 0.4 s to import.
        import scipy.integrate

        return scipy.integrate.solve_ivp(
            slope,
            (begin, end),
            self._start_value.reshape(-1),
            dense_output=True,
            rtol=TOLERANCE,
            atol=self._absolute_tolerance(begin),
            **method,
        )

    def _absolute_tolerance(self, begin: float) -> FloatArray:
        """Return the absolute tolerance (N m,) of a piece; raises TheoryError."""
        # Beside a node that nobody can follow, one with precise sensors has a covariance of the
        # order of the root of the other's, whose inflow is rounded: asked for more, steps get ever
        # smaller.
        sizes = self._entry_sizes()
        rounding = ROUNDING * sizes.max()
        if rounding > DEFECT_TOLERANCE * sizes.min():
            raise TheoryError(
                f"Tanwani's H(12) cannot be integrated beyond {begin:.3g} s: covariances of two "
                f"nodes differ by a factor of {sizes.max() / sizes.min():.1g}, and rounding hides "
                "the smaller one"
            )
        tolerance = 1e-3 * TOLERANCE * sizes + rounding
        return np.repeat(tolerance, self._start_value.shape[1])

    def _entry_sizes(self) -> FloatArray:
        """Return the size (N,) of the covariance of each node, also where it begins at 0."""
        return np.asarray(
            np.maximum(np.abs(self._start_value).max(axis=1), _covariance_scale(self._packed))
        )

    def _jacobian(self, t: float, y: FloatArray) -> Any:
        """Return the sparse Jacobian (N m, N m), per second, at the packed ``y`` (N m,)."""
        linear = self._packed.linear(self._packed.unpack(y.reshape(self._packed.start.shape)))
        # With a delay the arrivals are known from earlier pieces and do not depend on y.
        return linear.matrix(arriving=self._packed.equations.delay == 0.0)


def _growth_event(limit: float) -> Callable[[float, FloatArray], float]:
    """Return an event of solve_ivp where the largest entry exceeds ``limit``."""

    def margin(_: float, y: FloatArray) -> float:
        return limit - float(np.abs(y).max()) if math.isfinite(limit) else 1.0

    margin.terminal = True  # type: ignore[attr-defined]
    return margin


class _SampleJumps:
    """Jumps of the solution: samples at known times, and the arrivals of messages sent at them."""

    def __init__(self, packed: PackedRiccati) -> None:
        self._packed = packed
        equations = packed.equations
        self._samples = {jump.time: jump for jump in equations.jumps}
        self._arrivals: dict[float, tuple[FloatArray, FloatArray]] = {}
        delay = equations.delay
        later = [jump.time + delay for jump in equations.jumps]
        self._times = sorted({*self._samples, *later})

    def before(self, begin: float, end: float) -> float:
        """Return the first jump (seconds) after ``begin``, or ``end`` if that is earlier."""
        index = bisect.bisect_right(self._times, begin)
        return min(end, self._times[index]) if index < len(self._times) else end

    def __contains__(self, time: float) -> bool:
        return time in self._samples or time in self._arrivals

    def apply(self, time: float, Y: FloatArray) -> FloatArray:
        """Return the packed bound Y (N, m) just after samples or their messages at ``time``."""
        packed, equations = self._packed, self._packed.equations
        jump = self._samples.get(time)
        if jump is not None:
            P = packed.unpack(Y)
            for node, observation in jump.observations.items():
                P[node] = joseph_update(P[node], observation)
            Y = packed.pack(P)
            if jump.weights is not None:
                self._arrivals[time + equations.delay] = jump.weights, Y
        arriving = self._arrivals.pop(time, None)
        if arriving is None:
            return Y
        weights, sent = arriving
        if equations.delay > 0.0:
            sent = packed.predict(sent)
        # H (9) in the mean: P_i <- (1 - sum_j w_ij) P_i + sum_j w_ij P_j.
        own_weight = 1.0 - weights.sum(axis=1)
        return np.asarray(own_weight[:, None] * Y + weights @ sent)


def _limit_evaluations(slope: Slope) -> Slope:
    """Return ``slope`` as a function that raises StiffError after too many calls."""
    evaluations_left = MAX_EXPLICIT_EVALUATIONS

    def limited(t: float, y: FloatArray) -> FloatArray:
        nonlocal evaluations_left
        evaluations_left -= 1
        if evaluations_left < 0:
            raise StiffError
        return slope(t, y)

    return limited


def _check_step(slope: Slope, output: Callable[[float], FloatArray], a: float, b: float) -> None:
    """Compare the change from a to b with the integral of ``slope``; raises TheoryError."""
    # By five Gauss-Legendre nodes.
    middle, half = 0.5 * (a + b), 0.5 * (b - a)
    change = output(b) - output(a)
    integral = half * sum(
        w * slope(middle + half * z, output(middle + half * z))
        for z, w in zip(_GAUSS, _GAUSS_WEIGHTS, strict=True)
    )
    defect = np.abs(change - integral).max()
    if not defect <= DEFECT_TOLERANCE * (np.abs(output(b)).max() + np.abs(change).max()):
        raise TheoryError(
            f"Tanwani's H(12) was integrated with a defect of {defect:.1e} at {a:g} s"
        )
