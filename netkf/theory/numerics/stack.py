"""Jointly Gaussian vectors, each written as a linear form of independent standard normal inputs.

The covariance of the stacked vectors is ``T T'`` with T (rows, inputs), so it stays positive
semidefinite and a small error keeps its digits where it began as a large one. T has as many columns
as inputs that were drawn; once they are many an orthogonal matrix takes most of them away.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np

from netkf.linalg.arrays import FloatArray

ROOM = 192  # inputs kept beyond as many as there are rows before they are reduced


class Stack:
    """Named vectors of n entries; names are any hashable values."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._place: dict[Hashable, int] = {}
        self._free: list[int] = []
        self._used = 0
        self._forms: FloatArray = np.zeros((0, n, ROOM))

    def __contains__(self, name: Hashable) -> bool:
        return name in self._place

    @property
    def names(self) -> tuple[Hashable, ...]:
        """In the order in which they came."""
        return tuple(self._place)

    def inputs(self, count: int) -> slice:
        """The columns of ``count`` new inputs, independent of all before. They stay where they are
        until the next call.
        """
        if self._used + count > self._forms.shape[2]:
            self._reduce(count)
        columns = slice(self._used, self._used + count)
        self._used += count
        return columns

    def _reduce(self, count: int) -> None:
        rows = sorted(self._place.values())
        whole = self._forms[rows, :, : self._used].reshape(len(rows) * self._n, self._used)
        if whole.shape[1] > whole.shape[0]:
            whole = np.asarray(np.linalg.qr(whole.T, mode="r")).T
        self._used = whole.shape[1]
        room = max(self._used + count + ROOM, len(self._forms) * self._n + count + ROOM)
        forms = np.zeros((len(self._forms), self._n, room))
        forms[rows, :, : self._used] = whole.reshape(len(rows), self._n, -1)
        self._forms = forms

    def form(self, name: Hashable) -> FloatArray:
        """(n, inputs) of one vector, as a copy."""
        return self._forms[self._place[name], :, : self._used].copy()

    def forms(self, names: Sequence[Hashable]) -> FloatArray:
        """(K, n, inputs), as a copy."""
        return self._forms[[self._place[name] for name in names], :, : self._used]

    def put(self, name: Hashable, form: FloatArray) -> None:
        """Set a vector, which may be new; inputs that came after ``form`` was read do not enter."""
        place = self._place.get(name)
        if place is None:
            place = self._place[name] = self._free.pop() if self._free else self._more()
        self._forms[place, :, : form.shape[1]] = form
        self._forms[place, :, form.shape[1] :] = 0.0

    def put_all(self, forms: Mapping[Hashable, FloatArray]) -> None:
        """Set several vectors."""
        for name, form in forms.items():
            self.put(name, form)

    def add(self, name: Hashable, columns: slice, matrix: FloatArray) -> None:
        """Add ``matrix`` (n, k) times the inputs in ``columns``."""
        self._forms[self._place[name], :, columns] += matrix

    def drop(self, names: Iterable[Hashable]) -> None:
        """Forget vectors."""
        for name in names:
            place = self._place.pop(name)
            self._forms[place] = 0.0
            self._free.append(place)

    def rename(self, name: Hashable, other: Hashable) -> None:
        """``name`` takes the place of ``other``, which is forgotten."""
        form = self.form(name)
        self.drop([name])
        self.put(other, form)

    def covariance(self, names: Sequence[Hashable]) -> FloatArray:
        """(K n, K n) of the vectors together."""
        whole = self.forms(names).reshape(len(names) * self._n, -1)
        return np.asarray(whole @ whole.T)

    def _more(self) -> int:
        count = len(self._forms)
        bigger = np.zeros((max(4, 2 * count), *self._forms.shape[1:]))
        bigger[:count] = self._forms
        self._forms = bigger
        self._free = list(range(len(bigger) - 1, count, -1))
        return count
