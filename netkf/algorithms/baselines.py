"""The two baselines of every comparison: no communication, and all readings at one place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from netkf.algorithms.filter import Exchange, Filter, Message
from netkf.algorithms.registry import built_in


@built_in("local")
@dataclass(frozen=True, eq=False)
class Local(Filter):
    """Every node runs a Kalman(-Bucy) filter on its own readings and never talks; samples in slots
    are filtered.
    """

    combination: ClassVar[str] = "none"
    schedule: ClassVar[tuple[str, ...]] = ("predict", "sense")
    clocks: ClassVar[tuple[str, ...]] = ()
    talks: ClassVar[bool] = False

    def absorb(self, state: Any, messages: Sequence[Message], exchange: Exchange) -> Any:
        """Return the state: nothing arrives."""
        return state

    shift = Filter.shift  # affine


@built_in("central")
@dataclass(frozen=True, eq=False)
class Central(Local):
    """One Kalman(-Bucy) filter reads all sensors without delay or loss; every node shows it."""

    pooled: ClassVar[bool] = True
