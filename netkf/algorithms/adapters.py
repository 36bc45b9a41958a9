"""Adapters from the deprecated contracts ``FlowFilter`` and ``SlotFilter`` to ``Filter``.

User classes that derive from ``FlowFilter`` (continuous time) or ``SlotFilter`` (slots) keep
working, each in the model of time that it was written for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from netkf.algorithms.filter import (
    CLOCKS,
    Exchange,
    Filter,
    Increments,
    Message,
    NodeInfo,
    Reading,
)
from netkf.algorithms.flow import FlowFilter
from netkf.algorithms.slot import Role, SlotFilter
from netkf.linalg.arrays import FloatArray

AnyFilter = Filter | FlowFilter | SlotFilter


def adapt(algorithm: AnyFilter) -> Filter:
    """Return ``algorithm`` as a filter of today's contract: wrapped in an adapter if it keeps a
    deprecated one.
    """
    if isinstance(algorithm, FlowFilter):
        return FlowAdapter(algorithm)
    if isinstance(algorithm, SlotFilter):
        return SlotAdapter(algorithm)
    return algorithm


class _Adapter(Filter):
    """A filter that calls the methods of ``inner``, a filter of a deprecated contract, and copies
    its class variables.
    """

    def __init__(self, inner: Any) -> None:
        """Wrap ``inner``, a FlowFilter or SlotFilter."""
        # Filters are frozen dataclasses, in which a plain assignment raises an error.
        for name in ("talks", "pooled", "inverts"):
            object.__setattr__(self, name, getattr(inner, name))
        object.__setattr__(self, "inner", inner)

    inner: Any

    def estimate(self, state: Any) -> tuple[FloatArray, FloatArray | None]:
        """Return ``xhat`` (n,) and ``P`` (n, n) of the wrapped filter; P is None if it has none."""
        xhat, P = self.inner.estimate(state)
        return xhat, P

    def weight(self, degree: int, peer_degree: int) -> float:
        """Return the weight that the wrapped filter gives to a message, at a node with ``degree``
        links from one with ``peer_degree``.
        """
        return float(self.inner.weight(degree, peer_degree))

    def largest_degree(self) -> float:
        """Return the largest number of neighbours that a node may have by the wrapped filter."""
        return float(self.inner.largest_degree())


class FlowAdapter(_Adapter):
    """Runs a ``FlowFilter`` in continuous time: with increments and messages, but no samples."""

    schedule = None
    clocks = CLOCKS[:-1]  # all but "readings": there are no samples after which to transmit

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Return the wrapped filter's state at time 0 from ``mean`` (n,) and ``cov`` (n, n); flow
        filters are not told about the ``node``.
        """
        return self.inner.init(model, mean, cov)

    def predict(self, state: Any, gap: float) -> Any:
        """Return the wrapped filter's state ``gap`` seconds later, by its method ``flow``."""
        return self.inner.flow(state, gap)

    def update(self, state: Any, reading: Any) -> Any:
        """Return the state after the increments of the last gap, by the method ``measure``; a
        sample is a TypeError.
        """
        if not isinstance(reading, Increments):
            raise TypeError("a FlowFilter takes increments only; derive from netkf.parts.Filter")
        return self.inner.measure(state, reading)

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """Return the state, unchanged, and the payload that the wrapped filter's ``emit`` makes of
        it.
        """
        return state, self.inner.emit(state)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Return the state after all messages of an instant: calls the wrapped filter's ``absorb``
        with (weight, payload, age) of each.
        """
        # Deprecated filters are not told the sender.
        return self.inner.absorb(state, [(m.weight, m.payload, m.age) for m in messages])

    def max_measurement_interval(self, state: Any) -> float:
        """Return the seconds of increments that may be used at once, by the wrapped filter's
        ``stretch``.
        """
        return float(self.inner.stretch(state))


class SlotAdapter(_Adapter):
    """Runs a ``SlotFilter`` in slots. Its ``sense`` includes the prediction to the next slot, so
    that the schedule has no phase "predict".
    """

    clocks = ()

    def __init__(self, inner: SlotFilter) -> None:
        """Wrap ``inner``, with its ``programme`` as the schedule of a slot."""
        super().__init__(inner)
        object.__setattr__(self, "schedule", tuple(inner.programme))
        for name in ("first_slot", "predicts", "pairwise", "one_way"):
            object.__setattr__(self, name, getattr(inner, name))

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Return the state at slot 0 from ``mean`` (n,) and ``cov`` (n, n), by the wrapped filter's
        ``init`` and then its ``place``, which is told what the node knows of the network.
        """
        role = Role(node.node, node.degree, node.nodes, node.information, node.own_weight)
        return self.inner.place(self.inner.init(model, mean, cov), role)

    def update(self, state: Any, reading: Reading) -> Any:
        """Return the state after the reading of the slot and the prediction to the next one, by the
        wrapped filter's ``sense``.
        """
        return self.inner.sense(state, reading)

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """Return the state, unchanged, and the payload of the wrapped filter's ``emit`` for this
        exchange.
        """
        return state, self.inner.emit(state, exchange.phase)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Return the state after all messages of a step: calls the wrapped filter's ``absorb`` with
        (weight, payload, age) of each.
        """
        # Deprecated filters are not told the sender.
        contents = [(m.weight, m.payload, m.age) for m in messages]
        return self.inner.absorb(state, exchange.phase, contents)

    def steps(self, phase: int) -> int:
        """Return how often the wrapped filter repeats exchange number ``phase`` of a slot."""
        return int(self.inner.steps(phase))

    def redraws_links(self, phase: int, step: int) -> bool:
        """Return True if links draw anew whether messages arrive in repetition ``step`` of exchange
        number ``phase``, by the wrapped filter's ``redraws``.
        """
        return bool(self.inner.redraws(phase, step))

    def stopped(self, state: Any) -> bool:
        """Return True once the wrapped filter has permanently frozen what it computes of the whole
        network by exchanges.
        """
        return bool(self.inner.stopped(state))

    def conserved(self, state: Any) -> Mapping[str, float | Sequence[float]]:
        """Return the wrapped filter's quantities by name, each a number or the terms of a sum,
        whose sums over all nodes no exchange should change.
        """
        conserved: dict[str, float] = self.inner.conserved(state)
        return conserved

    @property
    def pair_weights(self) -> FloatArray | None:
        """The wrapped filter's matrix (N, N) of weights, entry [l, i] for messages from node l to
        node i, or None if its method ``weight`` gives them.
        """
        weights: FloatArray | None = self.inner.pair_weights
        return weights
