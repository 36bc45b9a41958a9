"""Jointly Gaussian vectors, each stored as a linear form of independent standard normal inputs.

With ``T`` (rows, inputs) the matrix of the stacked forms, the joint covariance is ``T T'``: it
stays positive semidefinite, and a small error keeps its digits where it is the difference of large
ones. T has a column for each input that was drawn; once there are many, an orthogonal matrix
reduces them to as many as there are rows.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np

from netkf.linalg.arrays import FloatArray

SPARE_INPUTS = 192  # columns kept beyond the number of rows between two reductions


class GaussianStack:
    """Named Gaussian vectors of n entries; a name is any hashable value."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._place: dict[Hashable, int] = {}
        self._free: list[int] = []
        self._used = 0
        self._forms: FloatArray = np.zeros((0, n, SPARE_INPUTS))

    def __contains__(self, name: Hashable) -> bool:
        return name in self._place

    @property
    def names(self) -> tuple[Hashable, ...]:
        """Names of the vectors, in the order in which they were added."""
        return tuple(self._place)

    def inputs(self, count: int) -> slice:
        """Add ``count`` inputs, independent of all before, and return their columns.

        The columns are valid until the next call.
        """
        if self._used + count > self._forms.shape[2]:
            self._reduce(count)
        columns = slice(self._used, self._used + count)
        self._used += count
        return columns

    def _reduce(self, count: int) -> None:
        """Rotate the inputs so that few are left, and make space for ``count`` more."""
        # Only T T' matters, so that T may be multiplied by any orthogonal matrix from the right.
        rows = sorted(self._place.values())
        stacked = self._forms[rows, :, : self._used].reshape(len(rows) * self._n, self._used)
        if stacked.shape[1] > stacked.shape[0]:
            # T' = Q R, so T T' = R' R: R' replaces T and has no more columns than rows.
            stacked = np.asarray(np.linalg.qr(stacked.T, mode="r")).T
        self._used = stacked.shape[1]
        width = max(
            self._used + count + SPARE_INPUTS, len(self._forms) * self._n + count + SPARE_INPUTS
        )
        forms = np.zeros((len(self._forms), self._n, width))
        forms[rows, :, : self._used] = stacked.reshape(len(rows), self._n, -1)
        self._forms = forms

    def form(self, name: Hashable) -> FloatArray:
        """Return a copy (n, inputs) of the form of one vector."""
        return self._forms[self._place[name], :, : self._used].copy()

    def forms(self, names: Sequence[Hashable]) -> FloatArray:
        """Return a copy (K, n, inputs) of the forms of K vectors."""
        return self._forms[[self._place[name] for name in names], :, : self._used]

    def put(self, name: Hashable, form: FloatArray) -> None:
        """Add or overwrite a vector; inputs newer than ``form`` (n, inputs) get zero columns."""
        place = self._place.get(name)
        if place is None:
            place = self._place[name] = self._free.pop() if self._free else self._grow()
        self._forms[place, :, : form.shape[1]] = form
        # The place may hold columns of an earlier vector.
        self._forms[place, :, form.shape[1] :] = 0.0

    def put_all(self, forms: Mapping[Hashable, FloatArray]) -> None:
        """Add or overwrite several vectors."""
        for name, form in forms.items():
            self.put(name, form)

    def add(self, name: Hashable, columns: slice, matrix: FloatArray) -> None:
        """Add ``matrix`` (n, k) times the inputs in ``columns`` to a vector."""
        self._forms[self._place[name], :, columns] += matrix

    def drop(self, names: Iterable[Hashable]) -> None:
        """Remove vectors; their storage is reused."""
        for name in names:
            place = self._place.pop(name)
            self._forms[place] = 0.0
            self._free.append(place)

    def rename(self, name: Hashable, other: Hashable) -> None:
        """Store the vector ``name`` under the name ``other``, overwriting what was there."""
        form = self.form(name)
        self.drop([name])
        self.put(other, form)

    def covariance(self, names: Sequence[Hashable]) -> FloatArray:
        """Return the joint covariance (K n, K n) of K vectors."""
        stacked = self.forms(names).reshape(len(names) * self._n, -1)
        return np.asarray(stacked @ stacked.T)

    def _grow(self) -> int:
        """Double the storage and return a free place."""
        count = len(self._forms)
        larger = np.zeros((max(4, 2 * count), *self._forms.shape[1:]))
        larger[:count] = self._forms
        self._forms = larger
        self._free = list(range(len(larger) - 1, count, -1))
        return count
