"""Means and second central moments of many values, merged pairwise.

Leaves are single observations and merging goes by the binary tree over their numbers, so that a
million of them lose no digits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel


class Moments(NamedTuple):
    """Mean and sum of squared deviations of ``size`` values each.

    ``mean`` and ``M2`` (S, C) have one ``size`` (S,) for each row.
    """

    size: FloatArray
    mean: FloatArray
    M2: FloatArray

    def standard_error(self) -> FloatArray:
        """Standard error of the mean (S, C); nan where there are fewer than two values."""
        size = self.size[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = self.M2 / np.where(size > 1.0, size - 1.0, np.nan)
            return np.asarray(np.sqrt(variance / size))


def moments_of(values: FloatArray, size: FloatArray) -> Moments:
    """Moments of R observations (R, S, C), merged in the binary tree over them; ``size`` (R, S) is
    1 where an observation exists and 0 where it does not. Both arrays are overwritten.
    """
    M2 = np.zeros_like(values)
    merge_in_place(size, values, M2)
    return Moments(size[0].copy(), values[0].copy(), M2[0].copy())


def merge_moments(a: Moments, b: Moments) -> Moments:
    """Moments of both samples together."""
    size, mean, M2 = (np.stack(pair) for pair in zip(a, b, strict=True))
    merge_in_place(size, mean, M2)
    return Moments(size[0], mean[0], M2[0])


@kernel
def merge_in_place(size: FloatArray, mean: FloatArray, M2: FloatArray) -> None:
    """Merge R moments, size (R, S), mean and M2 (R, S, C), in the binary tree over R; the result is
    the first of each, the others are overwritten (Chan, Golub and LeVeque 1983, (2.1)).
    """
    runs, rows, columns = mean.shape
    stride = 1
    while stride < runs:
        for a in range(0, runs - stride, 2 * stride):
            b = a + stride
            for s in range(rows):
                total = size[a, s] + size[b, s]
                share = size[b, s] / max(total, 1.0)
                weight = size[a, s] * share
                for c in range(columns):
                    # mean <- mean_a + (mean_b - mean_a) size_b / size,
                    # M2 <- M2_a + M2_b + (mean_b - mean_a)^2 size_a size_b / size
                    delta = mean[b, s, c] - mean[a, s, c]
                    mean[a, s, c] += delta * share
                    M2[a, s, c] += M2[b, s, c] + delta * delta * weight
                size[a, s] = total
        stride *= 2
