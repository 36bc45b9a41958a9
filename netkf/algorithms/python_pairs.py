"""Readings of pairs as the SimPy engine makes them (``filter.PairReading``), for kernels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np

from netkf.algorithms.blocks import block_numbers
from netkf.algorithms.kernels.nonlinear_rows import NonlinearRows, linear_rows
from netkf.algorithms.kernels.pairs import IN_PYTHON, Pairs, empty_pairs
from netkf.linalg.arrays import FloatArray, enlarged
from netkf.linalg.vector_functions import VectorFunction

Kept = Mapping[int, tuple[Any, int]]
"""Readings of pairs by number, each with how many states its node has."""
NOTHING_KEPT: Kept = MappingProxyType({})


def linear_part(pair: Any) -> tuple[FloatArray, FloatArray] | None:
    """Return H (p, n) and H_other (p, n') of a reading of a pair; None if it is not linear."""
    return getattr(pair.H, "linear", None)


class PythonPairs:
    """The readings of pairs that the messages to a node with this NodeInfo and n states bring."""

    def __init__(self, info: Any, n: int) -> None:
        heard = [sum(place.n for place in places) for places in info.heard]
        self._own, self._numbers = max(n, *heard, 1), block_numbers([info])
        seen = [place for places in (info.blocks, *info.heard) for place in places]
        self._states, self._info = n, info
        self._sizes = {place.key: place.n for place in seen}
        self._n = self._own + max(self._sizes.values(), default=1)
        self._found: list[tuple[Any, int]] = []
        self._kept: Kept = {}
        self._functions: dict[tuple[int, bool], VectorFunction] = {}

    def none(self) -> Pairs:
        """Return no readings."""
        return self._room(0, 1, [0, 0])

    @property
    def columns(self) -> int:
        """The most states that a reading is of."""
        return int(self._n)

    def _rows(self, count: int, p: int) -> NonlinearRows:
        rows = linear_rows(count, p, np.full((1, self._n), -1))
        rows.matrix = np.zeros((p, 1 + self._n))
        return rows

    def _room(self, count: int, p: int, first: Sequence[int]) -> Pairs:
        begins, known = np.array(first, dtype=np.int64), self._known
        return empty_pairs(self._rows(count, p), self._own, begins, known, self._nothing)

    @cached_property
    def _known(self) -> NonlinearRows:
        """The rows of all readings that are kept, which Python linearises."""
        p = int(self._info.most_pairs[1])
        rows = self._rows(1, p)
        rows.kind[0, 0] = IN_PYTHON
        rows.functions[0, 0, 0] = self._function(p, kept=True).address
        return rows

    @cached_property
    def _nothing(self) -> FloatArray:
        return np.zeros((1, 1, self._n, 1))

    def know(self, *kept: Kept) -> None:
        """Let kernels linearise these readings."""
        self._kept = {number: one for part in kept for number, one in part.items()}

    def keep(self, kept: Kept, numbers: Sequence[int]) -> Kept:
        """Return those ``kept`` and those of the last ``take`` own ones that are numbered there."""
        first = self._first_number(kept)
        taken = {first + k * self._info.nodes: one for k, one in enumerate(self._found)}
        return {number: one for number, one in {**kept, **taken}.items() if number in numbers}

    def _first_number(self, kept: Kept) -> int:
        """Return a number that no reading has that is ``kept``, nor one of another node."""
        nodes, place = int(self._info.nodes), int(self._info.place)
        return (max((number // nodes for number in kept), default=0) + 1) * nodes + place

    def take(
        self, readings: Sequence[Any], senders: Sequence[Any], kept: Kept
    ) -> tuple[Pairs, list[Any]]:
        """Return the pairs of ``readings`` (``single.Whitened``), brought by the payloads
        ``senders`` but for the first, and readings with those of pairs behind; some are ``kept``.
        """
        self._found, rows, first, extended = [], [], [0], []
        sizes = [self._states, *(len(payload.sender.run.struct.size) for payload in senders)]
        # Readings of ``update`` come without senders.
        for reading, states in zip(readings, sizes, strict=True):
            p = len(reading.y)
            for pair in reading.pairs:
                self._found.append((pair, states))
                rows.append(p)
                p += len(pair.y)
            first.append(len(rows))
            extended.append(self._extended(reading, p))
        p = max((len(pair.y) for pair, _ in self._found), default=1)
        pairs = self._room(len(rows), p, first)
        step, number = self._info.nodes, self._first_number(kept)
        for k, (pair, _) in enumerate(self._found):
            pairs.row[k], pairs.length[k] = rows[k], len(pair.y)
            pairs.block[0, k] = self._numbers.get(pair.other, -1)
            pairs.sensor[k], pairs.number[k] = 0, number + k * step
            pairs.rows.R[0, k] = enlarged(pair.R, p, p)
            if linear_part(pair) is None:
                pairs.rows.kind[k, 0] = IN_PYTHON
                pairs.rows.functions[k, 0, 0] = self._function(p).address
        return pairs, extended

    def _extended(self, reading: Any, count: int) -> Any:
        """Return a reading of ``count`` rows, with those of linear pairs behind its own."""
        if not reading.pairs:
            return reading
        y, H, row = np.zeros(count), np.zeros((count, self._n)), len(reading.y)
        y[:row], H[:row, : reading.H.shape[1]] = reading.y, reading.H
        for pair in reading.pairs:
            rows = slice(row, row + len(pair.y))
            y[rows], row = pair.y, rows.stop
            if (parts := linear_part(pair)) is not None:
                for part, begin in zip(parts, (0, self._own), strict=True):
                    end = min(begin + part.shape[1], self._n)
                    H[rows, begin:end] = part[:, : end - begin]
        return reading._replace(y=y, H=H, rows=len(reading.y))

    def _function(self, p: int, kept: bool = False) -> VectorFunction:
        """Return the function of both estimates and the number of a reading that is ``kept``, or of
        ``_found``, that gives z and J.
        """

        def linearised(x: FloatArray, _: FloatArray, number: float) -> FloatArray:
            pair, states = self._kept[int(number)] if kept else self._found[int(number)]
            own = self._own
            z, H, H_other = pair.H(x[:states], x[own : own + self._sizes[pair.other]])
            made = np.zeros((p, 1 + self._n))
            made[: len(z), 0], made[: len(z), 1 : 1 + states] = z, H
            made[: len(z), 1 + own : 1 + own + H_other.shape[1]] = H_other
            return made

        if (p, kept) not in self._functions:
            shapes = (self._n,), (p,), (p, 1 + self._n)
            self._functions[p, kept] = VectorFunction(linearised, shapes, is_kernel=False)
        return self._functions[p, kept]

    def raise_error(self) -> None:
        """Raise the error of what linearises a reading, if a call has failed."""
        for function in self._functions.values():
            function.raise_error()
