"""The base of filters that run as another one, which their settings choose."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from netkf.algorithms.filter import Exchange, Filter, Message, NodeInfo
from netkf.linalg.arrays import FloatArray

FORWARDED = (
    "schedule", "clocks", "predicts", "first_slot", "pairwise", "one_way", "inverts", "talks",
    "pooled", "needs_samples", "newest_only", "fixed_sensors", "every_reading", "common_start",
    "ways_between_all", "reads_what_it_sends", "inverts_under_clocks", "randomised",
    "needs_network", "paper", "combination", "P_by_design", "slot_kernel", "unrolled",
    "shift_payload", "accepts", "max_measurement_interval", "steps", "exchange_steps",
    "redraws_links", "sends_in_slots", "payload_numbers", "slot_stopping", "decides_in_slots",
    "moves_estimates", "carried_estimates", "slot_arrays", "slot_gains", "stopped", "conserved",
    "weight", "pair_weights", "check_scenario", "scenario_notes", "largest_degree",
)  # fmt: skip
"""Attributes of ``Filter`` that a Delegate reads from the wrapped filter. Methods that take a state
are not here: Delegate defines them.
"""


def forwarded(name: str) -> property:
    """Return a property with the value of the attribute ``name`` of the wrapped filter."""
    return property(lambda self: getattr(self.wrapped, name))


@dataclass(frozen=True, eq=False)
class Delegate(Filter):
    """A filter that does nothing itself: states, methods and class variables are those of
    ``wrapped``, which a derived class makes from its settings.
    """

    @property
    @abstractmethod
    def wrapped(self) -> Filter:
        """The filter that runs in place of this one."""

    def init(self, model: Any, mean: FloatArray, cov: FloatArray, node: NodeInfo) -> Any:
        """Return the wrapped filter's state at time 0 from ``mean`` (n,) and ``cov`` (n, n)."""
        return self.wrapped.init(model, mean, cov, node)

    def predict(self, state: Any, gap: float) -> Any:
        """Return the wrapped filter's state ``gap`` seconds later."""
        return self.wrapped.predict(state, gap)

    def update(self, state: Any, reading: Any) -> Any:
        """Return the wrapped filter's state after a reading (``Reading`` or ``Increments``)."""
        return self.wrapped.update(state, reading)

    def emit(self, state: Any, exchange: Exchange) -> tuple[Any, Any]:
        """Return the wrapped filter's state after sending, and the payload, or None for none."""
        return self.wrapped.emit(state, exchange)

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Return the wrapped filter's state after all messages of an instant."""
        return self.wrapped.absorb(state, messages, exchange)

    def estimate(self, state: Any) -> tuple[FloatArray, FloatArray | None]:
        """Return ``xhat`` (n,) and ``P`` (n, n) now; P is None if the wrapped filter has none."""
        return self.wrapped.estimate(state)

    def shift(self, state: Any, offset: FloatArray) -> Any:
        """Return the wrapped filter's state with ``offset`` (n,) added to the estimate, for a move
        of the origin.
        """
        return self.wrapped.shift(state, offset)


# Defaults of Filter would hide the wrapped filter's attributes: a property replaces each of them.
for _name in set(FORWARDED) - vars(Delegate).keys():
    setattr(Delegate, _name, forwarded(_name))
