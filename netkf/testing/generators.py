"""Random generators that record their calls."""

from __future__ import annotations

from typing import Any

import numpy as np

from netkf.rng.streams import Streams

Calls = list[tuple[str, int]]
"""Calls of a generator: method and number of values drawn."""


class RecordingGenerator(np.random.Generator):
    """A random generator that records each call of its methods in ``calls``."""

    def __init__(self, seed: int, *entity: int) -> None:
        super().__init__(Streams(seed).generator("testing", *entity).bit_generator)
        self.calls: Calls = []

    def __getattribute__(self, name: str) -> Any:
        """Return an attribute; calls of methods that draw are appended to ``calls``."""
        attribute = super().__getattribute__(name)
        if name.startswith("_") or name in ("calls", "take_calls", "bit_generator"):
            return attribute

        def draw(*arguments: Any, **keywords: Any) -> Any:
            values = attribute(*arguments, **keywords)
            self.calls.append((name, int(np.size(values))))
            return values

        return draw

    def take_calls(self) -> Calls:
        """Return the recorded calls and forget them."""
        calls, self.calls = self.calls, []
        return calls


def describe_calls(calls: Calls) -> str:
    """Return calls as text, such as "2 x normal", or "nothing"."""
    return ", ".join(f"{count} x {name}" for name, count in calls) or "nothing"
