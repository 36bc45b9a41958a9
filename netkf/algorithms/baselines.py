"""The two ends of every comparison: no communication at all, and all of it at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from netkf.algorithms.flow import FlowFilter


@dataclass(frozen=True, eq=False)
class Local(FlowFilter):
    """Every node runs a Kalman-Bucy filter on its own readings and never talks."""

    talks: ClassVar[bool] = False

    def absorb(self, state: Any, messages: Sequence[tuple[float, Any, float]]) -> Any:
        """Nothing arrives; the state stays."""
        return state


@dataclass(frozen=True, eq=False)
class Central(Local):
    """One Kalman-Bucy filter reads all sensors without delay or loss; every node shows it."""

    pooled: ClassVar[bool] = True
