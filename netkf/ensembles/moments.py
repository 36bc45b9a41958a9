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
        """Return the standard error of the mean (S, C); nan of fewer than two values."""
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
    M2 = np.empty_like(values)
    merge_leaves(size, _in_columns(values), _in_columns(M2))
    # Copied, so that the result does not keep the arrays in memory.
    return Moments(size[0].copy(), values[0].copy(), M2[0].copy())


def _in_columns(values: FloatArray) -> FloatArray:
    """Return ``values`` (R, S, C) in the form (R, 1, S C) of nodes."""
    return values.reshape(len(values), 1, -1)


def merge_moments(a: Moments, b: Moments) -> Moments:
    """Return the moments of the observations of ``a`` and ``b`` (S rows, C columns) together."""
    size, mean, M2 = (np.array(pair) for pair in zip(a, b, strict=True))
    join_nodes(size, _in_columns(mean), _in_columns(M2), 2, 1)
    return Moments(size[0], mean[0], M2[0])


@kernel
def join_nodes(size: FloatArray, mean: FloatArray, M2: FloatArray, depth: int, number: int) -> int:
    """Merge the last two of ``depth`` nodes of a binary tree that wait for a neighbour, in place,
    once for each trailing 1 in the binary form of ``number``; return how many nodes wait now.

    After leaf 0, 1, 2, ... each trailing 1 of its number says that two neighbouring nodes are
    complete (Chan, Golub and LeVeque 1983, (2.1)). Nodes have size (D, S), and C columns of mean
    and M2, the sum of squared deviations, (D, C, S F) of F quantities that share a size.
    """
    rows = size.shape[1]
    together = mean.shape[2] // rows
    while number & 1 and depth > 1:
        a, b = depth - 2, depth - 1
        alike = True
        for s in range(rows):
            alike = alike and size[a, s] == size[a, 0] and size[b, s] == size[b, 0]
        if alike:
            # All columns as one.
            flat = mean[a].reshape(-1), M2[a].reshape(-1), mean[b].reshape(-1), M2[b].reshape(-1)
            merge_pair(size[a, 0], size[b, 0], *flat)
        else:
            for s in range(rows):
                part = slice(s * together, (s + 1) * together)
                for c in range(mean.shape[1]):
                    merge_pair(
                        size[a, s],
                        size[b, s],
                        mean[a, c, part],
                        M2[a, c, part],
                        mean[b, c, part],
                        M2[b, c, part],
                    )
        for s in range(rows):
            size[a, s] += size[b, s]
        depth, number = depth - 1, number >> 1
    return depth


@kernel(inlined=True)
def merge_pair(
    size: float,
    other_size: float,
    mean: FloatArray,
    M2: FloatArray,
    other: FloatArray,
    other_M2: FloatArray,
) -> None:
    """Merge the ``other`` moments (Q,) of as many observations into mean and M2 (Q,) in place."""
    share = other_size / max(size + other_size, 1.0)
    weight = size * share
    for c in range(len(mean)):
        # mean <- mean_a + (mean_b - mean_a) size_b / size,
        # M2 <- M2_a + M2_b + (mean_b - mean_a)^2 size_a size_b / size
        delta = other[c] - mean[c]
        mean[c] += delta * share
        M2[c] += other_M2[c] + delta * delta * weight


@kernel
def merge_leaves(size: FloatArray, values: FloatArray, M2: FloatArray) -> None:
    """Merge R observations, ``values`` (R, 1, S C) with ``size`` (R, S), into the first, in a
    binary tree over R; ``M2`` (R, 1, S C) is overwritten.
    """
    depth = 0
    for r in range(len(values)):
        for s in range(size.shape[1]):
            size[depth, s] = size[r, s]
        for c in range(values.shape[2]):
            values[depth, 0, c], M2[depth, 0, c] = values[r, 0, c], 0.0
        depth = join_nodes(size, values, M2, depth + 1, r)
    join_nodes(size, values, M2, depth, (1 << depth) - 1)
