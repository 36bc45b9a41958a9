"""The verbs of an affine filter of kernels on estimates and readings of several columns.

Given the covariances each verb is an affine map of estimates, readings and payloads. Its values at
zero and at unit vectors give the map, which then takes all columns at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, PairReading, Reading
from netkf.linalg.arrays import FloatArray
from netkf.theory.common.forms import MEAN


class ColumnState(NamedTuple):
    """Estimates ``xhat`` (n, C), the state ``inner`` of the filter, in which estimates mean
    nothing, and the values (p, C) of the readings of pairs of this instant.
    """

    xhat: FloatArray
    inner: Any
    pairs: tuple[FloatArray, ...] = ()


class KernelColumns:
    """The verbs of ``algorithm``, a filter whose payloads have one estimate, ``xhat``."""

    def __init__(self, algorithm: Filter) -> None:
        self._algorithm, self.timing = algorithm, algorithm.timing

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: Any) -> ColumnState:
        """Return the state at time 0 from ``mean`` (n, C)."""
        inner = self._algorithm.init(model.moving, np.zeros(len(mean)), cov, node)
        return ColumnState(mean, inner)

    def predict(self, state: ColumnState, gap: float) -> ColumnState:
        """Return the state ``gap`` seconds later."""

        def predicted(x: FloatArray) -> Any:
            return self._algorithm.predict(state.inner._replace(xhat=x), gap)

        return ColumnState(*_mapped(predicted, [state.xhat]))

    def update(self, state: ColumnState, reading: Reading) -> ColumnState:
        """Return the state after a reading with y (p, C)."""
        still = tuple(_pair(pair, np.zeros(len(pair.y))) for pair in reading.pairs)

        def updated(x: FloatArray, y: FloatArray) -> Any:
            given = reading._replace(y=y, pairs=still)
            return self._algorithm.update(state.inner._replace(xhat=x), given)

        mapped = _mapped(updated, [state.xhat, reading.y])
        return ColumnState(*mapped, tuple(pair.y for pair in reading.pairs))

    def emit(self, state: ColumnState, exchange: Exchange) -> tuple[ColumnState, Any]:
        """Return the state after sending, and the payload: the state before, and what it says."""
        inner, payload = self._algorithm.emit(state.inner, exchange)
        return state._replace(inner=inner), ColumnState(state.xhat, payload, state.pairs)

    def absorb(
        self, state: ColumnState, messages: Sequence[Message], exchange: Exchange
    ) -> ColumnState:
        """Return the state after all messages of this instant."""
        told = [message.payload for message in messages]
        inputs = [state.xhat, *(one.xhat for one in told), *(y for one in told for y in one.pairs)]

        def absorbed(x: FloatArray, *values: FloatArray) -> Any:
            heard, pairs = [], iter(values[len(told) :])
            for message, xhat in zip(messages, values, strict=False):
                payload = message.payload.inner._replace(xhat=xhat)
                if message.payload.pairs:
                    own = tuple(_pair(p, next(pairs)) for p in payload.reading.pairs)
                    payload.reading = payload.reading._replace(pairs=own)
                heard.append(message._replace(payload=payload))
            return self._algorithm.absorb(state.inner._replace(xhat=x), heard, exchange)

        return ColumnState(*_mapped(absorbed, inputs), state.pairs)

    def estimate(self, state: ColumnState) -> tuple[FloatArray, FloatArray | None]:
        """Return the estimates (n, C), and P (n, n)."""
        return state.xhat, self._algorithm.estimate(state.inner)[1]


def _pair(pair: PairReading, y: FloatArray) -> PairReading:
    """Return a reading of a pair with other values (p,)."""
    matrix: Any = pair.H
    return pair._replace(y=y, H=matrix._replace(y=y))


def _mapped(verb: Callable[..., Any], inputs: Sequence[FloatArray]) -> tuple[FloatArray, Any]:
    """Return the estimates (n, C) after a verb on ``inputs`` (k, C), and the inner state."""
    sizes = np.cumsum([len(part) for part in inputs])
    inner = verb(*np.split(np.zeros(sizes[-1]), sizes[:-1]))
    base = np.array(inner.xhat)
    unit = [verb(*np.split(e, sizes[:-1])).xhat - base for e in np.eye(sizes[-1])]
    xhat = np.stack(unit, axis=1) @ np.concatenate(list(inputs))
    xhat[:, MEAN] += base
    return xhat, inner
