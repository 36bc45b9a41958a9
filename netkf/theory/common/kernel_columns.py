"""The verbs of an affine filter of kernels on estimates and readings of several columns.

Given the covariances each verb is an affine map of estimates, readings and payloads. Its values at
zero and at unit vectors give the map, which then takes all columns at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from netkf.algorithms.filter import Exchange, Filter, Message, PairReading, Reading
from netkf.algorithms.single import Payload
from netkf.linalg.arrays import FloatArray
from netkf.theory.common.forms import MEAN


class ColumnState(NamedTuple):
    """The ``means`` (k, C) by name of a filter's state or payload, this ``inner`` one, in which
    they mean nothing, and the values ``read`` (p, C) of the reading of this instant: of the
    whitened one, and of each pair. Of means that are no vectors k counts all entries.
    """

    means: dict[str, FloatArray]
    inner: Any
    read: tuple[FloatArray, ...] = ()

    @property
    def inputs(self) -> list[FloatArray]:
        """All columns that a verb depends on."""
        return [*self.means.values(), *self.read]


class KernelColumns:
    """The verbs of ``algorithm``, a filter of kernels."""

    def __init__(self, algorithm: Filter) -> None:
        self._algorithm, self.timing = algorithm, algorithm.timing
        assert algorithm.kernels is not None
        self._names = algorithm.kernels.means

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: Any) -> ColumnState:
        """Return the state at time 0 from ``mean`` (n, C)."""

        def begun(x: FloatArray) -> Any:
            return self._algorithm.init(model.moving, x, cov, node)

        return ColumnState(*self._mapped(begun, [mean]))

    def predict(self, state: ColumnState, gap: float) -> ColumnState:
        """Return the state ``gap`` seconds later."""

        def predicted(*x: FloatArray) -> Any:
            return self._algorithm.predict(_given(state, iter(x)), gap)

        return ColumnState(*self._mapped(predicted, state.inputs))

    def update(self, state: ColumnState, reading: Reading) -> ColumnState:
        """Return the state after a reading with y (p, C)."""
        of_pairs = [pair.y for pair in reading.pairs]

        def updated(y: FloatArray, *x: FloatArray) -> Any:
            values = iter(x)
            pairs = tuple(_pair(pair, next(values)) for pair in reading.pairs)
            given = reading._replace(y=y, pairs=pairs)
            return self._algorithm.update(_given(state, values), given)

        means, inner = self._mapped(updated, [reading.y, *of_pairs, *state.inputs])
        y = reading.y
        if len(y):
            y = np.linalg.solve(np.linalg.cholesky(reading.R), y)
        read = (y, *of_pairs)
        return ColumnState(means, inner, read if inner.reading is not None else ())

    def emit(self, state: ColumnState, exchange: Exchange) -> tuple[ColumnState, Any]:
        """Return the state after sending, and the payload, None if nothing is sent."""

        def sent(*x: FloatArray) -> list[Any]:
            both = self._algorithm.emit(_given(state, iter(x)), exchange)
            return [one for one in both if one is not None]

        parts = [ColumnState(*one, state.read) for one in self._all_mapped(sent, state.inputs)]
        return parts[0], parts[1] if len(parts) > 1 else None

    def absorb(
        self, state: ColumnState, messages: Sequence[Message], exchange: Exchange
    ) -> ColumnState:
        """Return the state after all messages of this instant."""
        receiver = state.inner.run.info.node
        told = [_message_to(receiver, message.payload) for message in messages]
        inputs = [y for one in (state, *told) for y in one.inputs]

        def absorbed(*values: FloatArray) -> Any:
            given = iter(values)
            own = _given(state, given)
            payloads = [_given(one, given) for one in told]
            heard = [m._replace(payload=p) for m, p in zip(messages, payloads, strict=True)]
            return self._algorithm.absorb(own, heard, exchange)

        return ColumnState(*self._mapped(absorbed, inputs), state.read)

    def estimate(self, state: ColumnState) -> tuple[FloatArray, FloatArray | None]:
        """Return the estimates (n, C), and P (n, n)."""
        return state.means["xhat"], self._algorithm.estimate(state.inner)[1]

    def _mapped(
        self, verb: Callable[..., Any], inputs: Sequence[FloatArray]
    ) -> tuple[dict[str, FloatArray], Any]:
        """Return the means (k, C) after a verb on ``inputs`` (k, C), and the inner state."""
        return self._all_mapped(lambda *x: [verb(*x)], inputs)[0]

    def _all_mapped(
        self, verb: Callable[..., list[Any]], inputs: Sequence[FloatArray]
    ) -> list[tuple[dict[str, FloatArray], Any]]:
        """Return ``_mapped`` of each of the states and payloads that a verb returns."""
        ends, columns = np.cumsum([len(part) for part in inputs]), np.concatenate(list(inputs))
        # What is 0 needs no column of the map.
        used = np.flatnonzero(columns.any(axis=1))

        def called(x: FloatArray) -> list[Any]:
            return verb(*np.split(x, ends[:-1]))

        units, found = [called(e) for e in np.eye(ends[-1])[used]], []
        for k, inner in enumerate(called(np.zeros(ends[-1]))):
            made = {}
            for name in (name for name in self._names if name in inner._fields):
                zero = _mean(inner, name).ravel()
                unit = np.array([_mean(one[k], name).ravel() - zero for one in units])
                made[name] = unit.reshape(len(used), len(zero)).T @ columns[used]
                made[name][:, MEAN] += zero
            found.append((made, inner))
        return found


def _mean(inner: Any, name: str) -> FloatArray:
    """Return what the means of a state or payload are, of all messages of that."""
    return np.array(inner.fields[name] if isinstance(inner, Payload) else getattr(inner, name))


def _given(state: ColumnState, values: Iterator[FloatArray]) -> Any:
    """Return the inner state, or payload, with the next ``values`` as means and readings."""
    given, inner = {name: next(values) for name in state.means}, state.inner
    arrays = {name: x.reshape(_mean(inner, name).shape) for name, x in given.items()}
    if isinstance(inner, Payload):
        inner = inner.with_fields({**inner.fields, **arrays})
    else:
        inner = inner._replace(**arrays)
    if state.read:
        y = next(values)
        own = tuple(_pair(pair, next(values)) for pair in inner.reading.pairs)
        inner.reading = inner.reading._replace(y=y, pairs=own)
    return inner


def _message_to(receiver: int, told: ColumnState) -> ColumnState:
    """Return a payload of several messages without those that are for others."""
    inner = told.inner.message_to(receiver)
    count = len(next(iter(told.inner.fields.values())))
    k = told.inner.number_to(receiver)
    means = {name: x.reshape(count, -1, x.shape[1])[k] for name, x in told.means.items()}
    return told._replace(means=means, inner=inner)


def _pair(pair: PairReading, y: FloatArray) -> PairReading:
    """Return a reading of a pair with other values (p,)."""
    matrix: Any = pair.H
    return pair._replace(y=y, H=matrix._replace(y=y))
