"""Jointly Gaussian vectors, each stored as a linear form of independent standard normal inputs.

With ``T`` (rows, inputs) the matrix of the stacked forms, the joint covariance is ``T T'``. It is
positive semidefinite, and the difference of two nearly equal vectors keeps its digits. T has a
column for each input; once there are many, an orthogonal matrix from the right reduces them to as
many as there are rows, which leaves T T' unchanged. Columns of forms that a caller has stored
(:meth:`GaussianStack.freeze`) are frozen: they are not rotated again.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence

import numpy as np

from netkf.linalg.arrays import FloatArray, IntArray
from netkf.theory.numerics.roots import ErrorTable, mixed_form

SPARE_INPUTS = 192  # columns kept beyond the number of rows between two reductions


class GaussianStack:
    """Named Gaussian vectors of n entries; a name is any hashable value.

    table    : (vectors, n, width) the forms, which kernels modify
    matrices : (vectors, n, n) a matrix that belongs to each vector, such as a root of P
    used     : number of columns in use
    """

    def __init__(self, n: int) -> None:
        """Make an empty stack of vectors of n entries."""
        self._n = n
        self._index: dict[Hashable, int] = {}
        self._free: list[int] = []
        self._frozen = 0
        self.used = 0
        self.table: FloatArray = np.zeros((0, n, SPARE_INPUTS))
        self.matrices: FloatArray = np.zeros((0, n, n))

    def __contains__(self, name: Hashable) -> bool:
        return name in self._index

    @property
    def names(self) -> tuple[Hashable, ...]:
        """Names of the vectors, in the order in which they were added."""
        return tuple(self._index)

    @property
    def arrays(self) -> ErrorTable:
        """The present arrays for kernels; valid until vectors or inputs are added."""
        return ErrorTable(self.table, self.matrices, self.used)

    def index(self, name: Hashable) -> int:
        """Return the index of a vector in the tables."""
        return self._index[name]

    def indices(self, names: Iterable[Hashable]) -> IntArray:
        """Return the indices (K,) of K vectors."""
        return np.array([self._index[name] for name in names], dtype=np.int64)

    def inputs(self, count: int) -> slice:
        """Add ``count`` inputs, standard normal numbers independent of all before, and return their
        columns in the forms (coefficients of the inputs) of all vectors.

        The columns are valid until the next call.
        """
        if self.used + count > self.table.shape[2]:
            self._reduce(self._index, count)
        columns = slice(self.used, self.used + count)
        self.used += count
        return columns

    def freeze(self, names: Sequence[Hashable]) -> FloatArray:
        """Return the forms (K, n, inputs) of K vectors and freeze their inputs.

        The vectors depend on these inputs only, which keep their columns in all later forms. So the
        joint covariance with later vectors can be computed from the stored forms.
        """
        first = set(names)
        others = [name for name in self._index if name not in first]
        self._reduce([*names, *others], 0)
        # After the triangularisation the first rows are zero beyond as many columns as rows.
        self._frozen = min(self.used, self._frozen + len(names) * self._n)
        return self.table[self.indices(names), :, : self._frozen]

    def _reduce(self, names: Iterable[Hashable], count: int) -> None:
        """Replace free columns of T by at most as many as rows, with space for ``count`` more."""
        # Joint covariances T T' stay; the new columns are lower triangular in the order of
        # ``names``.
        rows = self.indices(names)
        stacked = self.table[rows, :, self._frozen : self.used].reshape(len(rows) * self._n, -1)
        # Only T T' matters, so that T may be multiplied by any orthogonal matrix from the right:
        # T' = Q R, so T T' = R' R, and R' replaces T and has no more columns than rows.
        stacked = np.asarray(np.linalg.qr(stacked.T, mode="r")).T
        frozen, used = self._frozen, self._frozen + stacked.shape[1]
        width = frozen + len(self.table) * self._n + count + SPARE_INPUTS
        table = np.zeros((len(self.table), self._n, max(width, used + count + SPARE_INPUTS)))
        table[rows, :, :frozen] = self.table[rows, :, :frozen]
        table[rows, :, frozen:used] = stacked.reshape(len(rows), self._n, -1)
        self.table, self.used = table, used

    def form(self, name: Hashable) -> FloatArray:
        """Return a copy (n, inputs) of the form of one vector."""
        return self.table[self._index[name], :, : self.used].copy()

    def forms(self, names: Sequence[Hashable]) -> FloatArray:
        """Return a copy (K, n, inputs) of the forms of K vectors."""
        return self.table[[self._index[name] for name in names], :, : self.used]

    def put(self, name: Hashable, form: FloatArray) -> None:
        """Add or overwrite a vector; inputs newer than ``form`` (n, inputs) get zero columns."""
        index = self._index_for(name)
        self.table[index, :, : form.shape[1]] = form
        # The index may hold columns of an earlier vector.
        self.table[index, :, form.shape[1] : self.used] = 0.0

    def _index_for(self, name: Hashable) -> int:
        """Return the index of a name, a free one if it is new."""
        index = self._index.get(name)
        if index is None:
            index = self._index[name] = self._free.pop() if self._free else self._grow()
        return index

    def put_all(self, forms: Mapping[Hashable, FloatArray]) -> None:
        """Add or overwrite several vectors by their forms (n, inputs), given by name; inputs newer
        than a form get zero columns.
        """
        for name, form in forms.items():
            self.put(name, form)

    def add(self, name: Hashable, columns: slice, matrix: FloatArray) -> None:
        """Add ``matrix`` (n, k) times the inputs in ``columns`` to a vector."""
        self.table[self._index[name], :, columns] += matrix

    def mix(self, sources: Sequence[Hashable], factors: FloatArray) -> FloatArray:
        """Return the form (n, inputs) of ``sum_k W_k e_k`` for the K vectors ``sources`` and
        ``factors`` W (K, n, n).
        """
        return mixed_form(self.table, self.indices(sources), factors, self.used)

    def copy(self, name: Hashable, new: Hashable) -> None:
        """Copy a vector and its matrix to another name."""
        target = self._index_for(new)
        source = self._index[name]
        self.table[target, :, : self.used] = self.table[source, :, : self.used]
        self.matrices[target] = self.matrices[source]

    def drop(self, names: Iterable[Hashable]) -> None:
        """Remove vectors; their storage is reused."""
        for name in names:
            index = self._index.pop(name)
            # The next vector stored here must not inherit any columns.
            self.table[index, :, : self.used] = 0.0
            self._free.append(index)

    def rename(self, name: Hashable, new: Hashable) -> None:
        """Store the vector ``name`` under the name ``new``, which it overwrites."""
        if new in self._index:
            self.drop([new])
        self._index[new] = self._index.pop(name)

    def covariance(self, names: Sequence[Hashable]) -> FloatArray:
        """Return the joint covariance (K n, K n) of K vectors."""
        stacked = self.forms(names).reshape(len(names) * self._n, -1)
        return np.asarray(stacked @ stacked.T)

    def _grow(self) -> int:
        """Double the storage, at least to 4 vectors, and return a free index."""
        count = len(self.table)
        added = max(4, 2 * count) - count
        self.table, self.matrices = (
            np.concatenate([part, np.zeros((added, *part.shape[1:]))])
            for part in (self.table, self.matrices)
        )
        self._free = list(range(count + added - 1, count, -1))
        return count
