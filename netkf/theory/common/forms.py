"""Jointly Gaussian numbers as linear forms of independent standard normal inputs.

Each number is a row of coefficients, one column for each input, so that the joint covariance of
rows T is ``T T'``: it is positive semidefinite, and the difference of two nearly equal numbers
keeps its digits. Once there are many columns, an orthogonal matrix from the right reduces them to
as many as there are rows, which leaves ``T T'`` as it is.
"""

from __future__ import annotations

from typing import cast

import numpy as np

from netkf.linalg.arrays import FloatArray, IntArray

MEAN, NOISE = range(2)
"""The first column holds means; inputs begin with column NOISE."""
SPARE = 64
"""Least number of columns beyond the number of rows between two reductions."""


class Forms:
    """A table of forms: row r is the number ``table[r, :used]``.

    ``frozen`` columns are not rotated any more: forms that a caller has stored depend on them only.
    """

    def __init__(self, rows: int) -> None:
        """Make room for some ``rows``; there are more when they are taken."""
        self.table: FloatArray = np.zeros((max(rows, 1), NOISE + SPARE))
        self.used = self.frozen = NOISE
        self._live = np.zeros(len(self.table), dtype=bool)
        self._free = list(range(len(self.table)))[::-1]

    def take(self, count: int) -> IntArray:
        """Return ``count`` free rows (count,), which are zero."""
        while len(self._free) < count:
            rows = len(self.table)
            self.table = np.concatenate([self.table, np.zeros_like(self.table)])
            self._live = np.concatenate([self._live, np.zeros_like(self._live)])
            self._free = [*range(2 * rows - 1, rows - 1, -1), *self._free]
        taken = np.array([self._free.pop() for _ in range(count)], dtype=np.int64)
        self.table[taken, : self.used] = 0.0
        self._live[taken] = True
        return taken

    def give(self, rows: IntArray) -> None:
        """Give back ``rows`` (k,) that are not used any more."""
        self._live[rows] = False
        self._free += rows.tolist()

    def inputs(self, count: int) -> int:
        """Add ``count`` inputs; return the column of the first, valid until the next call."""
        if self.used + count > self.table.shape[1]:
            self._reduce(count)
        first = self.used
        self.used += count
        self.table[:, first : self.used] = 0.0
        return first

    def freeze(self, forms: FloatArray) -> FloatArray:
        """Return ``forms`` (k, used) in columns that later reductions leave alone."""
        frozen = self._reduce(0, forms)
        self.frozen = min(self.used, self.frozen + len(forms))
        return frozen[:, : self.frozen]

    def _reduce(self, count: int, first: FloatArray | None = None) -> FloatArray:
        """Replace inputs that are not frozen by few, and return ``first`` (k, used) in these."""
        rows, frozen = np.flatnonzero(self._live), self.frozen
        given = np.zeros((0, self.used)) if first is None else first
        old = np.concatenate([given, self.table[rows, : self.used]])
        inputs = old[:, frozen:]
        if first is not None or len(old) < inputs.shape[1]:
            # inputs' = Q R, so inputs inputs' = R' R.
            inputs = cast(FloatArray, np.linalg.qr(inputs.T, mode="r")).T
        used = frozen + inputs.shape[1]
        # A reduction costs as much as many products with the table: it waits for as many columns.
        width = max(frozen + len(rows), used) + count + max(SPARE, len(rows))
        new = np.zeros((len(old), used))
        new[:, :frozen], new[:, frozen:] = old[:, :frozen], inputs
        self.table = np.zeros((len(self.table), width))
        self.table[rows, :used] = new[len(given) :]
        self.used = used
        return new[: len(given)]
