"""Tests of draws against the laws that parts of a scenario state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

Counts = TypeVar("Counts", bound=tuple[Any, ...])


def stack_runs(counts: Sequence[Counts]) -> Counts:
    """Return the ``counts`` of R runs, named tuples of arrays, as one with a first axis R."""
    return type(counts[0])(*(np.array(column) for column in zip(*counts, strict=True)))
