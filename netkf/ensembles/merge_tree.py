"""The binary tree over replicas, by which results of many runs are merged.

Node (level, k) holds the replicas from k 2^level to (k + 1) 2^level - 1. Every result is merged
along this tree, so that its bits do not depend on the size of blocks, on the workers, or on the
order of completion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

Merge = Callable[[Any, Any], Any]


class MergeTree:
    """Merges results of blocks, added in any order, with neighbours as soon as both are there."""

    def __init__(self, merge: Merge) -> None:
        self._merge = merge
        self._waiting: dict[tuple[int, int], Any] = {}

    def add(self, k: int, value: Any, level: int = 0) -> None:
        """Add the result ``value`` of node (level, k), which covers the blocks k 2^level to (k + 1)
        2^level - 1.

        Nodes must not overlap; the last may have fewer replicas. Level 0 may stand for blocks of
        any one size.
        """
        while (level, k ^ 1) in self._waiting:
            neighbour = self._waiting.pop((level, k ^ 1))
            value = self._merge(neighbour, value) if k & 1 else self._merge(value, neighbour)
            level, k = level + 1, k >> 1
        self._waiting[level, k] = value

    def nodes(self) -> list[tuple[int, int, Any]]:
        """Return the nodes (level, k, value) that wait for a neighbour, in order."""
        nodes = sorted(self._waiting, key=lambda node: node[1] << node[0])
        return [(level, k, self._waiting[level, k]) for level, k in nodes]

    def result(self) -> Any:
        """Return the merged result of all nodes that were added; nodes at the end that wait for a
        neighbour, which does not come, are merged from right to left.
        """
        values = [value for _, _, value in self.nodes()]
        total = values.pop()
        while values:
            total = self._merge(values.pop(), total)
        return total


def aligned_pieces(first: int, stop: int) -> Iterator[tuple[int, int]]:
    """Yield the largest nodes (level, k) that cover the leaves ``first`` .. ``stop - 1``."""
    while first < stop:
        level = (stop - first).bit_length() - 1
        # A node may begin only at a multiple of its size.
        if first:
            level = min(level, (first & -first).bit_length() - 1)
        yield level, first >> level
        first += 1 << level
