"""Readings of pairs as the SimPy engine makes them (``filter.PairReading``), for kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from netkf.algorithms.blocks import block_numbers
from netkf.algorithms.kernels.nonlinear_rows import linear_rows
from netkf.algorithms.kernels.pairs import IN_PYTHON, Pairs, empty_pairs
from netkf.linalg.arrays import FloatArray, enlarged
from netkf.linalg.vector_functions import VectorFunction


class PythonPairs:
    """The readings of pairs that the messages to a node with this NodeInfo and n states bring."""

    def __init__(self, info: Any, n: int) -> None:
        heard = [sum(place.n for place in places) for places in info.heard]
        self._own, self._numbers = max(n, *heard, 1), block_numbers([info])
        seen = [place for places in (info.blocks, *info.heard) for place in places]
        self._states, self._sizes = n, {place.key: place.n for place in seen}
        self._n = self._own + max(self._sizes.values(), default=1)
        self._found: list[tuple[Any, int]] = []
        self._functions: dict[int, VectorFunction] = {}

    def none(self) -> Pairs:
        """Return no readings."""
        return self._room(0, 1, [0, 0])

    @property
    def columns(self) -> int:
        """The most states that a reading is of."""
        return int(self._own)

    def _room(self, count: int, p: int, first: Sequence[int]) -> Pairs:
        rows = linear_rows(count, p, np.full((1, self._n), -1))
        rows.matrix = np.zeros((p, 1 + self._n))
        return empty_pairs(rows, self._own, np.array(first, dtype=np.int64))

    def take(self, readings: Sequence[Any], senders: Sequence[Any]) -> tuple[Pairs, list[Any]]:
        """Return the pairs of ``readings`` (``single.Whitened``), brought by the payloads
        ``senders`` but for the first, and readings with the values of pairs at the end of y.
        """
        self._found, rows, first, extended = [], [], [0], []
        sizes = [self._states, *(len(payload.sender.run.struct.size) for payload in senders)]
        # Readings of ``update`` come without senders.
        for reading, states in zip(readings, sizes, strict=True):
            y = reading.y
            for pair in reading.pairs:
                self._found.append((pair, states))
                rows.append(len(y))
                y = np.concatenate([y, pair.y])
            first.append(len(rows))
            extended.append(reading._replace(y=y))
        p = max((len(pair.y) for pair, _ in self._found), default=1)
        pairs = self._room(len(rows), p, first)
        for k, (pair, _) in enumerate(self._found):
            pairs.row[k], pairs.length[k] = rows[k], len(pair.y)
            pairs.block[0, k] = self._numbers.get(pair.other, -1)
            pairs.rows.kind[k, 0] = IN_PYTHON
            pairs.rows.functions[k, 0, 0] = self._function(p).address
            pairs.rows.R[0, k] = enlarged(pair.R, p, p)
        return pairs, extended

    def _function(self, p: int) -> VectorFunction:
        """Return the function of both estimates and a number of ``_found`` that gives z and J."""

        def linearised(x: FloatArray, _: FloatArray, number: float) -> FloatArray:
            (pair, states), own = self._found[int(number)], self._own
            size = self._sizes[pair.other]
            z, H, H_other = pair.H(x[:states], x[own : own + size])
            made = np.zeros((p, 1 + self._n))
            made[: len(z), 0], made[: len(z), 1 : 1 + states] = z, H
            made[: len(z), 1 + own : 1 + own + H_other.shape[1]] = H_other
            return made

        if p not in self._functions:
            shapes = (self._n,), (p,), (p, 1 + self._n)
            self._functions[p] = VectorFunction(linearised, shapes, is_kernel=False)
        return self._functions[p]

    def raise_error(self) -> None:
        """Raise the error of what linearises a reading, if a call has failed."""
        for function in self._functions.values():
            function.raise_error()
