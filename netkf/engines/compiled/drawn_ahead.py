"""Random numbers of many streams, by their place in a stream: drawn when needed, many at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from netkf.linalg.arrays import FloatArray, IntArray
from netkf.linalg.compiling import kernel

DrawRows = Callable[[int, int], Sequence[FloatArray]]


class DrawnAhead:
    """The rows of K ``streams``, of F = ``width`` numbers each. ``draw(k, count)`` returns the next
    rows of stream k, F arrays (count,), of which ``ahead`` more are drawn than are asked for.
    """

    def __init__(self, draw: DrawRows, width: int, streams: int, ahead: int = 0) -> None:
        self._draw, self._ahead = draw, ahead
        # Of each stream the number of the last row that was asked for, the first one that is kept,
        # and the end of those drawn.
        self._last = np.full(streams, -1)
        self._first, self._end = (np.zeros(streams, dtype=np.int64) for _ in range(2))
        self._kept: list[FloatArray | None] = [None] * streams
        self._rows, self._at = np.zeros((width, 0)), self._first

    def rows(self, streams: IntArray, numbers: IntArray) -> FloatArray:
        """Return the rows (F, D) with these ``numbers`` (D,), each from 0 in its stream (D,): those
        of a stream ascending, and not below the last one that was asked for.
        """
        needed = self._last.copy()
        np.maximum.at(needed, streams, numbers)
        if (needed >= self._end).any():
            self._draw_until(needed)
        self._last = needed
        return np.asarray(self._rows[:, (self._at - self._first)[streams] + numbers])

    def _draw_until(self, needed: IntArray) -> None:
        for k in np.flatnonzero(needed >= self._end).tolist():
            count = int(needed[k] - self._end[k]) + 1 + self._ahead
            rows, kept = np.stack(self._draw(k, count)), self._kept[k]
            if kept is not None:
                # A row may be asked for again, and then the last one.
                begin = max(int(self._last[k]), 0)
                rows = np.concatenate([kept[:, begin - self._first[k] :], rows], axis=1)
                self._first[k] = begin
            self._end[k] += count
            self._kept[k] = rows
        drawn = [rows for rows in self._kept if rows is not None]
        lengths = [0 if rows is None else rows.shape[1] for rows in self._kept]
        self._rows = np.concatenate(drawn, axis=1)
        self._at = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)


@kernel
def take_numbers(keys: IntArray, fresh: np.ndarray, taken: IntArray, numbers: IntArray) -> None:
    """Write into ``numbers`` (D,) which number each of D users has in the stream of its key,
    ``keys`` (D,): the next one if it is ``fresh`` (D,) or the first of all, else the last one.
    ``taken`` (K,) are so many numbers of each stream so far.
    """
    for d in range(len(keys)):
        k = keys[d]
        if fresh[d] or taken[k] == 0:
            taken[k] += 1
        numbers[d] = taken[k] - 1


def numbers_of(keys: IntArray, fresh: np.ndarray, taken: IntArray) -> IntArray:
    """Return the numbers (D,) that ``take_numbers`` gives."""
    numbers = np.empty(len(keys), dtype=np.int64)
    take_numbers(np.ascontiguousarray(keys), np.ascontiguousarray(fresh), taken, numbers)
    return numbers
