"""Means and second central moments of many values, merged pairwise.

Leaves are single observations and merging goes by the binary tree over their numbers, so that a
million of them lose no digits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray


class Moments(NamedTuple):
    """Mean and sum of squared deviations of ``size`` values each; size broadcasts over them."""

    size: FloatArray
    mean: FloatArray
    M2: FloatArray

    def standard_error(self) -> FloatArray:
        """Of the mean, like ``mean``; nan where there are fewer than two values."""
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = self.M2 / np.where(self.size > 1.0, self.size - 1.0, np.nan)
            return np.asarray(np.sqrt(variance / self.size))


def single(values: FloatArray, size: FloatArray) -> Moments:
    """One observation of each value where ``size`` is 1, none where it is 0."""
    return Moments(size, np.where(size > 0.0, values, 0.0), np.zeros_like(values))


def merge_moments(a: Moments, b: Moments) -> Moments:
    """Of both samples together (Chan, Golub and LeVeque 1983, (2.1))."""
    size = a.size + b.size
    share = b.size / np.maximum(size, 1.0)
    with np.errstate(invalid="ignore", over="ignore"):
        delta = b.mean - a.mean
        return Moments(size, a.mean + delta * share, a.M2 + b.M2 + delta * delta * (a.size * share))
