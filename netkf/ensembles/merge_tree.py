"""The binary tree over replicas, by which results of many runs are merged.

Node (level, k) holds replicas k 2^level up to (k + 1) 2^level. Every result is merged along this
tree, so that its bits do not depend on the size of blocks, on who did which, or on the order in
which they came back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

Merge = Callable[[Any, Any], Any]


class MergeTree:
    """Takes the results of blocks in any order and merges neighbours as soon as both are there, so
    that about as many wait as the logarithm of all.
    """

    def __init__(self, merge: Merge) -> None:
        self._merge = merge
        self._waiting: dict[tuple[int, int], Any] = {}

    def add(self, k: int, value: Any, level: int = 0) -> None:
        """Take the result of node (level, k); the last one may be of fewer replicas. Nodes do not
        overlap, and level 0 may stand for blocks of any one size.
        """
        while (level, k ^ 1) in self._waiting:
            other = self._waiting.pop((level, k ^ 1))
            value = self._merge(other, value) if k & 1 else self._merge(value, other)
            level, k = level + 1, k >> 1
        self._waiting[level, k] = value

    def result(self) -> Any:
        """Return the result of all; those at the end that have no neighbour join from right to
        left.
        """
        values = [value for _, value in sorted(self._waiting.items(), key=_first)]
        whole = values.pop()
        while values:
            whole = self._merge(values.pop(), whole)
        return whole


def _first(item: tuple[tuple[int, int], Any]) -> int:
    """Return the index of the first block in a node of the tree."""
    (level, k), _ = item
    return k << level


def aligned_pieces(first: int, stop: int) -> Iterator[tuple[int, int]]:
    """Yield the largest nodes (level, k) that cover the leaves ``first`` .. ``stop - 1``."""
    while first < stop:
        level = (stop - first).bit_length() - 1
        if first:
            level = min(level, (first & -first).bit_length() - 1)
        yield level, first >> level
        first += 1 << level
