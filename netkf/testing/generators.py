"""Random generators that record their calls."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.rng.streams import Streams

Calls = list[tuple[str, int]]


class RecordingGenerator(np.random.Generator):
    """A generator that lists the draws made from it: method and number of values."""

    def __init__(self, seed: int, *entity: int) -> None:
        super().__init__(Streams(seed).generator("testing", *entity).bit_generator)
        self.calls: Calls = []

    def __getattribute__(self, name: str) -> Any:
        found = super().__getattribute__(name)
        if name.startswith("_") or name in ("calls", "take_calls", "bit_generator"):
            return found

        def drawing(*arguments: Any, **named: Any) -> Any:
            """Draw, and record method and number of values."""
            values = found(*arguments, **named)
            self.calls.append((name, int(np.size(values))))
            return values

        return drawing

    def take_calls(self) -> Calls:
        """Return the draws since the last call."""
        calls, self.calls = self.calls, []
        return calls


def describe_calls(calls: Calls) -> str:
    """Return a text that lists calls of a generator."""
    return ", ".join(f"{count} x {name}" for name, count in calls) or "nothing"
