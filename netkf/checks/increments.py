"""Innovations of increments: readings of a continuous sensor over an interval minus predictions.

Over ``[a, b]`` of length g a node with ``dy = H x ds + dv``, cov(dv) = R ds, reads y = int dy. From
its estimate at a it predicts ``H z``, where z is the integral of the predicted state over the
interval. The innovation ``y - H z`` has the covariance ``S = H Z H' + R g``, where Z is the
covariance of the integral of the prediction error e: de = A e ds + dw with cov(e(a)) = P(a).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from netkf.algorithms.filter import Filter, Increments, NodeInfo, Reading, interval_rule
from netkf.algorithms.traits import Analysis, Timing
from netkf.linalg.arrays import FloatArray, square_root
from netkf.theory.numerics.prediction import LinearSDE

if TYPE_CHECKING:
    _Filter = Filter
else:
    # The recorded filter is the next base class, see record_increments.
    _Filter = object


class WhitenedInnovation(NamedTuple):
    """The whitened innovation of the increments of one interval.

    end      : end of the interval, seconds
    node     : node that read it; -1 for a pooled filter, which reads all sensors
    whitened : (p,) innovation times the inverse Cholesky factor of its covariance
    """

    end: float
    node: int
    whitened: FloatArray


class TimedState(NamedTuple):
    """The state of a filter, ``inner``, with what a whitened innovation needs besides.

    node  : node of the state; -1 for a pooled filter, which reads all sensors
    time  : present time of the state, seconds
    start : estimate (n,) and P (n, n), or None, before the last prediction
    """

    inner: Any
    node: int
    time: float
    start: tuple[FloatArray, FloatArray | None]


class ExpectedIncrements:
    """Predictions of increments under one ``model`` with A, Q, H and R, for intervals of any
    length.
    """

    def __init__(self, model: Any) -> None:
        """Take A and Q (n, n), H (p, n) and R (p, p) of ``model``."""
        n = len(model.A)
        self._n, self._H, self._R = n, model.H, model.R
        # The joint equation of (x, z): dx = A x ds + dw and dz = x ds.
        A = np.block([[model.A, np.zeros((n, n))], [np.eye(n), np.zeros((n, n))]])
        B = np.concatenate([square_root(model.Q), np.zeros((n, n))])
        self._equation = LinearSDE(A, B)

    def whitened_innovation(
        self, xhat: FloatArray, P: FloatArray, y: FloatArray, gap: float
    ) -> FloatArray:
        """Return the innovation y - H E[z] (p,) of increments y = int dy (p,) over ``gap`` seconds,
        times the inverse Cholesky factor of its covariance S; z is the integral of the state.

        ``xhat`` (n,) and ``P`` (n, n) are the estimate at the start of the interval.
        """
        n, H = self._n, self._H
        # Transition of (x, z) over the gap, and a square root of its noise covariance.
        F, root = self._equation.discretise(gap)
        J = F[n:, :n]  # integral of exp(A s) over the gap, so that E[z] = J xhat
        S = H @ (J @ P @ J.T + root[n:] @ root[n:].T) @ H.T + self._R * gap
        return np.asarray(np.linalg.solve(np.linalg.cholesky(S), y - H @ J @ xhat))


def _expected_increments_of_models() -> Callable[[Any], ExpectedIncrements]:
    """Return a function from a node's model to its ExpectedIncrements, set up once each."""
    cache: dict[int, tuple[Any, ExpectedIncrements]] = {}

    def expected_increments(model: Any) -> ExpectedIncrements:
        """Return the predictions of ``model``, the same object for the same model."""
        # The entry refers to the model, so that its id is not reused for another one.
        if id(model) not in cache:
            cache[id(model)] = model, ExpectedIncrements(model)
        return cache[id(model)][1]

    return expected_increments


class _IncrementRecorder(_Filter):
    """The methods of a filter on TimedState: they unwrap the state, call the method of the next
    base class, that of the recorded filter, and wrap again.

    Arguments and results are those of :class:`netkf.Filter`, with TimedState for states: times and
    gaps in seconds, ``mean`` and ``offset`` (n,), ``cov`` (n, n). ``record_increments`` sets the
    attributes.
    """

    _intervals: list[WhitenedInnovation]
    _expected_increments: Callable[[Any], ExpectedIncrements]

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> TimedState:
        """Return the state at time 0 with the estimate ``mean`` (n,), ``cov`` (n, n)."""
        inner = super().init(model, mean, cov, node)
        return TimedState(inner, -1 if self.timing.pooled else node.node, 0.0, (mean, None))

    def predict(self, state: TimedState, gap: float) -> TimedState:
        """Return the state predicted over ``gap`` seconds, with the estimate before it."""
        start = super().estimate(state.inner)
        return TimedState(super().predict(state.inner, gap), state.node, state.time + gap, start)

    def update(self, state: TimedState, reading: Increments | Reading) -> TimedState:
        """Update as the filter does; append the whitened innovations of increments first."""
        xhat, P = state.start
        if isinstance(reading, Increments) and P is not None and np.isfinite(P).all():
            # The first half of the moments is the integral of dy.
            y = reading.moments[: len(reading.moments) // 2]
            expected = self._expected_increments(state.inner.model)
            whitened = expected.whitened_innovation(xhat, P, y, reading.gap)
            self._intervals.append(WhitenedInnovation(state.time, state.node, whitened))
        return state._replace(inner=super().update(state.inner, reading))

    def emit(self, state: TimedState, exchange: Any) -> tuple[TimedState, Any]:
        """Return the state and the payload of its message, as the filter does."""
        inner, payload = super().emit(state.inner, exchange)
        return state._replace(inner=inner), payload

    def absorb(self, state: TimedState, messages: Sequence[Any], exchange: Any) -> TimedState:
        """Return the state after ``messages``, as the filter does."""
        inner = super().absorb(state.inner, messages, exchange)
        return state._replace(inner=inner)

    def estimate(self, state: TimedState) -> tuple[FloatArray, FloatArray | None]:
        """Return xhat (n,) and P (n, n) or None, as the filter does."""
        return super().estimate(state.inner)

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return a state or a payload with the estimate moved by ``offset`` (n,)."""
        if not isinstance(state, TimedState):
            return super().shift(state, offset)
        return state._replace(inner=super().shift(state.inner, offset))

    @property
    def timing(self) -> Timing:
        """That of the filter, whose states are inside."""
        rule = interval_rule(cast(Filter, super()))
        return replace(super().timing, interval=lambda state: rule(state.inner))

    @property
    def analysis(self) -> Analysis:
        """That of the filter, whose states are inside."""
        given = super().analysis
        return replace(
            given,
            conserved=lambda state: given.conserved(state.inner),
            stopped=lambda state: given.stopped(state.inner),
        )


def record_increments(algorithm: Filter, intervals: list[WhitenedInnovation]) -> Filter:
    """Return a filter with the estimates of ``algorithm`` that also appends, for each interval of
    continuous readings, the innovation times the inverse Cholesky factor of its covariance to
    ``intervals``; a replay of a run with it gives the innovations of the run.

    Its states are TimedState, which wrap those of ``algorithm``.
    """
    base = type(algorithm)
    # Errors name the class by its name, and the module says whether it is a user's class.
    cls: Any = type(base.__name__, (_IncrementRecorder, base), {"__module__": base.__module__})
    # Copied instead of constructed: its parameters have been checked already.
    recording: Any = object.__new__(cls)
    recording.__dict__.update(
        algorithm.__dict__,
        _intervals=intervals,
        _expected_increments=_expected_increments_of_models(),
    )
    return recording  # type: ignore[no-any-return]
