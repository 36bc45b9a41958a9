"""Means and second central moments of many observations, merged pairwise.

Single observations are the leaves of a binary tree over their numbers, along which moments are
merged, so that the rounding error of a million observations stays small.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel


class Moments(NamedTuple):
    """Mean and sum of squared deviations M2 of S times C quantities, in rows and columns.

    size     : (S,) the number of observations of all quantities of a row
    mean, M2 : (S, C)
    """

    size: FloatArray
    mean: FloatArray
    M2: FloatArray

    def standard_error(self) -> FloatArray:
        """Return the standard error of the mean (S, C); nan where there are fewer than
        two values.
        """
        size = self.size[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = self.M2 / np.where(size > 1.0, size - 1.0, np.nan)
            return np.asarray(np.sqrt(variance / size))


def moments_of(values: FloatArray, size: FloatArray) -> Moments:
    """Return the number (S,), mean (S, C) and M2 (S, C), the sum of squared deviations, of R
    observations ``values`` (R, S, C), each of S rows of C quantities.

    Neighbours are merged pairwise, in a binary tree over R. ``size`` (R, S) is 1 where an
    observation exists and 0 where it does not. Both arrays are overwritten.
    """
    _, rows, columns = values.shape
    mean, M2 = np.empty((rows, columns)), np.empty((rows, columns))
    merge_leaves(size, values, np.empty((len(values), 1, columns)), mean, M2)
    # Merged in place: row 0 now holds the number of all observations. Copied, so that the result
    # does not keep ``size`` in memory.
    return Moments(size[0].copy(), mean, M2)


def merge_moments(a: Moments, b: Moments) -> Moments:
    """Return the moments of the observations of ``a`` and ``b`` together; both have S rows and C
    columns.
    """
    size, mean, M2 = (np.stack(pair) for pair in zip(a, b, strict=True))
    merge_two(size, mean, M2)
    return Moments(size[0], mean[0], M2[0])


@kernel(inlined=True)
def merge_pair(
    size: FloatArray, mean: FloatArray, M2: FloatArray, a: int, b: int, s: int, t: int
) -> None:
    """Merge the size, mean and M2 (sum of squared deviations) of entry ``b`` into those of entry
    ``a`` in place (Chan, Golub and LeVeque 1983, (2.1)).

    Of R entries with S rows of C quantities only row ``s`` is merged: of ``size`` (R, S), of
    ``mean`` (R, S, C), and as row ``t`` of ``M2`` (R, S', C), which may hold fewer rows.
    """
    total = size[a, s] + size[b, s]
    share = size[b, s] / max(total, 1.0)
    weight = size[a, s] * share
    for c in range(mean.shape[2]):
        # mean <- mean_a + (mean_b - mean_a) size_b / size,
        # M2 <- M2_a + M2_b + (mean_b - mean_a)^2 size_a size_b / size
        delta = mean[b, s, c] - mean[a, s, c]
        mean[a, s, c] += delta * share
        M2[a, t, c] += M2[b, t, c] + delta * delta * weight
    size[a, s] = total


@kernel
def merge_two(size: FloatArray, mean: FloatArray, M2: FloatArray) -> None:
    """Merge two moments into the first in place: size (2, S), mean and M2 (2, S, C), for S rows of
    C quantities.
    """
    for s in range(mean.shape[1]):
        merge_pair(size, mean, M2, 0, 1, s, s)


@kernel
def merge_leaves(
    size: FloatArray, values: FloatArray, work: FloatArray, mean: FloatArray, M2: FloatArray
) -> None:
    """Write ``mean`` and ``M2`` (S, C), the sum of squared deviations, of R observations ``values``
    (R, S, C), merged pairwise in a binary tree over R.

    S counts rows and C the quantities of a row. ``size`` (R, S), 1 where an observation exists and
    else 0, and ``values`` are overwritten; ``work`` (R, 1, C) is scratch.
    """
    # Row by row, so that the values of a row are still in the cache when they are merged again.
    for s in range(values.shape[1]):
        merge_row(size, values, work, s)
        for c in range(values.shape[2]):
            mean[s, c] = values[0, s, c]
            M2[s, c] = work[0, 0, c]


@kernel
def merge_row(size: FloatArray, values: FloatArray, work: FloatArray, s: int) -> None:
    """Merge row ``s`` of R observations pairwise in a binary tree, in place: the mean ends in
    ``values[0, s]``, M2 (the sum of squared deviations) in ``work[0, 0]``.

    ``size`` (R, S) is 1 where an observation exists, else 0, and becomes the number merged;
    ``values`` (R, S, C) are the observations, ``work`` (R, 1, C) is scratch.
    """
    runs = len(values)
    # A single observation has M2 = 0.
    for r in range(runs):
        for c in range(values.shape[2]):
            work[r, 0, c] = 0.0
    # Level by level of the binary tree: a pair is ``stride`` observations apart.
    stride = 1
    while stride < runs:
        for a in range(0, runs - stride, 2 * stride):
            merge_pair(size, values, work, a, a + stride, s, 0)
        stride *= 2
