"""Filters of the two former contracts, made into filters of the present one.

Classes of users that derive from ``FlowFilter`` (continuous time) or ``SlotFilter`` (slots) go on
working; they run in the one kind of time that they were written for.
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


def adapted(algorithm: AnyFilter) -> Filter:
    """The filter itself, or one of the present contract that calls it."""
    if isinstance(algorithm, FlowFilter):
        return FlowAdapter(algorithm)
    if isinstance(algorithm, SlotFilter):
        return SlotAdapter(algorithm)
    return algorithm


class _Adapter(Filter):
    """What both have in common. Attributes of the class are those of the filter it calls."""

    def __init__(self, inner: Any) -> None:
        for name in ("talks", "pooled", "inverts"):
            object.__setattr__(self, name, getattr(inner, name))
        object.__setattr__(self, "inner", inner)

    inner: Any

    def estimate(self, state: Any) -> tuple[FloatArray, FloatArray | None]:
        """As the filter says it."""
        xhat, P = self.inner.estimate(state)
        return xhat, P

    def weight(self, degree: int, peer_degree: int) -> float:
        """As the filter says it."""
        return float(self.inner.weight(degree, peer_degree))

    def largest_degree(self) -> float:
        """As the filter says it."""
        return float(self.inner.largest_degree())


class FlowAdapter(_Adapter):
    """A flow filter: increments and messages over clocks; it knows no samples."""

    schedule = None
    clocks = CLOCKS[:-1]  # all but after samples

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Its state at time 0."""
        return self.inner.init(model, mean, cov)

    def predict(self, state: Any, gap: float) -> Any:
        """``flow``."""
        return self.inner.flow(state, gap)

    def update(self, state: Any, reading: Any) -> Any:
        """``measure``."""
        if not isinstance(reading, Increments):
            raise TypeError("a FlowFilter takes increments only; derive from netkf.parts.Filter")
        return self.inner.measure(state, reading)

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """``emit``, which leaves the state as it is."""
        return state, self.inner.emit(state)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """``absorb`` of (weight, payload, age)."""
        return self.inner.absorb(state, [tuple(message[1:]) for message in messages])

    def max_measurement_interval(self, state: Any) -> float:
        """``stretch``."""
        return float(self.inner.stretch(state))


class SlotAdapter(_Adapter):
    """A slot filter; its ``sense`` predicts as it likes."""

    clocks = ()

    def __init__(self, inner: SlotFilter) -> None:
        super().__init__(inner)
        object.__setattr__(self, "schedule", tuple(inner.programme))
        for name in ("first_slot", "predicts", "pairwise", "one_way"):
            object.__setattr__(self, name, getattr(inner, name))

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """``init`` and ``place``."""
        role = Role(node.node, node.degree, node.nodes, node.information, node.own_weight)
        return self.inner.place(self.inner.init(model, mean, cov), role)

    def update(self, state: Any, reading: Reading) -> Any:
        """``sense``."""
        return self.inner.sense(state, reading)

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """``emit``, which leaves the state as it is."""
        return state, self.inner.emit(state, exchange.phase)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """``absorb`` of (weight, payload, age)."""
        return self.inner.absorb(state, exchange.phase, [tuple(m[1:]) for m in messages])

    def steps(self, phase: int) -> int:
        """As the filter says it."""
        return int(self.inner.steps(phase))

    def redraws_links(self, phase: int, step: int) -> bool:
        """``redraws``."""
        return bool(self.inner.redraws(phase, step))

    def stopped(self, state: Any) -> bool:
        """As the filter says it."""
        return bool(self.inner.stopped(state))

    def conserved(self, state: Any) -> Mapping[str, float | Sequence[float]]:
        """As the filter says it."""
        conserved: dict[str, float] = self.inner.conserved(state)
        return conserved

    @property
    def pair_weights(self) -> FloatArray | None:
        """As the filter says it."""
        weights: FloatArray | None = self.inner.pair_weights
        return weights
