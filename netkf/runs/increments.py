"""Innovations of increments: what the readings of an interval are beyond what was expected.

Over ``[a, b]`` of length g a node with ``dy = H x ds + dv``, cov(dv) = R ds, reads y = int dy. From
its estimate at a it expects ``H z``, where z is the integral of its prediction, so that the
innovation ``y - H z`` has the covariance ``S = H Z H' + R g`` with Z that of the integral of the
predicted error: dz = e ds and de = A e ds + dw, which begins at P(a).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Filter, Increments, NodeInfo, Reading
from netkf.linalg.arrays import FloatArray, square_root
from netkf.theory.numerics.prediction import LinearSDE


class WhitenedInnovation(NamedTuple):
    """An interval of increments: its ``end`` (seconds), the ``node`` (-1 for a filter of all
    sensors), and the innovation (p,) times the inverse root of its covariance.
    """

    end: float
    node: int
    whitened: FloatArray


class Noted(NamedTuple):
    """The state of a filter with the node and the time (seconds) that it belongs to, and the
    estimate and P of the ``start`` of the interval that has just passed.
    """

    inner: Any
    node: int
    time: float
    start: tuple[FloatArray, FloatArray | None]


class Expectations:
    """Increments that are expected under one model, and their covariances."""

    def __init__(self, model: Any) -> None:
        n = len(model.A)
        self._n, self._H, self._R = n, model.H, model.R
        # (x, z) with dx = A x ds + dw and dz = x ds.
        A = np.block([[model.A, np.zeros((n, n))], [np.eye(n), np.zeros((n, n))]])
        B = np.concatenate([square_root(model.Q), np.zeros((n, n))])
        self._equation = LinearSDE(A, B)

    def innovation(self, xhat: FloatArray, P: FloatArray, y: FloatArray, gap: float) -> FloatArray:
        """Return the innovation (p,) of increments y (p,) times the inverse root of S."""
        n, H = self._n, self._H
        F, root = self._equation.discretise(gap)
        J = F[n:, :n]
        S = H @ (J @ P @ J.T + root[n:] @ root[n:].T) @ H.T + self._R * gap
        return np.asarray(np.linalg.solve(np.linalg.cholesky(S), y - H @ J @ xhat))


def record_increments(algorithm: Filter, intervals: list[WhitenedInnovation]) -> Filter:
    """Return a filter with the same estimates that appends the whitened innovation of each
    measured increment to ``intervals``.

    Its states are those of ``algorithm`` with their node and time.
    """
    known: dict[int, tuple[Any, Expectations]] = {}

    def expectations(model: Any) -> Expectations:
        """Return the expectations of a model, computed once."""
        # A reference to the model keeps its id from being used by another model.
        if id(model) not in known:
            known[id(model)] = model, Expectations(model)
        return known[id(model)][1]

    base: Any = type(algorithm)

    class Noting(base):  # type: ignore[misc]
        """The filter on states that know their node and time."""

        def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Noted:
            noted_node = -1 if base.pooled else node.node
            return Noted(base.init(self, model, mean, cov, node), noted_node, 0.0, (mean, None))

        def predict(self, state: Noted, gap: float) -> Noted:
            start = base.estimate(self, state.inner)
            inner = base.predict(self, state.inner, gap)
            return Noted(inner, state.node, state.time + gap, start)

        def update(self, state: Noted, reading: Increments | Reading) -> Noted:
            xhat, P = state.start
            if isinstance(reading, Increments) and P is not None and np.isfinite(P).all():
                y = reading.moments[: len(reading.moments) // 2]
                found = expectations(state.inner.model).innovation(xhat, P, y, reading.gap)
                intervals.append(WhitenedInnovation(state.time, state.node, found))
            return state._replace(inner=base.update(self, state.inner, reading))

        def emit(self, state: Noted, exchange: Any) -> tuple[Noted, Any]:
            inner, payload = base.emit(self, state.inner, exchange)
            return state._replace(inner=inner), payload

        def absorb(self, state: Noted, messages: Sequence[Any], exchange: Any) -> Noted:
            return state._replace(inner=base.absorb(self, state.inner, messages, exchange))

        def estimate(self, state: Noted) -> tuple[FloatArray, FloatArray | None]:
            found: tuple[FloatArray, FloatArray | None] = base.estimate(self, state.inner)
            return found

        def shift(self, state: Noted, offset: FloatArray) -> Noted:
            return state._replace(inner=base.shift(self, state.inner, offset))

        def max_measurement_interval(self, state: Noted) -> float:
            return float(base.max_measurement_interval(self, state.inner))

        def stopped(self, state: Noted) -> bool:
            return bool(base.stopped(self, state.inner))

        def conserved(self, state: Noted) -> Any:
            return base.conserved(self, state.inner)

    Noting.__name__, Noting.__module__ = base.__name__, base.__module__
    made: Any = object.__new__(Noting)
    made.__dict__.update(algorithm.__dict__)
    return made  # type: ignore[no-any-return]
