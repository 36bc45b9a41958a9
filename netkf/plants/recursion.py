"""x[k+1] = F x[k] + w[k] for many steps at once."""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import product


class Recursion:
    """The powers of one ``F`` (n, n), which all paths share."""

    def __init__(self, F: FloatArray) -> None:
        self.F, self._powers = F, F[None]

    def states(self, start: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the states (B, blocks L + 1, n) of B paths from ``start`` (B, n) on, each step of
        which adds its noise (B, blocks, L, n).

        Block by block, so that no path is rounded as its neighbours happen to be.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # perhaps beyond the horizon
            to_later = self._to_later(noise.shape[2])
            summed = np.isfinite(to_later[-1]).all()
            return (_in_sums if summed else _one_by_one)(start, noise, to_later)

    def _to_later(self, count: int) -> FloatArray:
        """Return ``F^1 .. F^count`` (count, n, n)."""
        found = self._powers
        while len(found) < count:
            found = np.concatenate([found, product(found, found[-1])])
        self._powers = found
        return found[:count]


def _one_by_one(start: FloatArray, noise: FloatArray, to_later: FloatArray) -> FloatArray:
    """Compute the states step by step.

    Powers of F may overflow although no state does.
    """
    count, _, _, n = noise.shape
    x = [start[:, None]]
    for w in np.moveaxis(noise.reshape(count, -1, 1, n), 1, 0):
        x.append(product(x[-1], to_later[0].T) + w)
    return np.concatenate(x, axis=1)


def _in_sums(start: FloatArray, noise: FloatArray, to_later: FloatArray) -> FloatArray:
    """Return the states (count, steps + 1, n) of ``x <- F x + noise`` by prefix sums within blocks:
    few products of large matrices instead of one small product a step.
    """
    count, blocks, length, n = noise.shape
    x = np.empty((count, blocks * length + 1, n))
    x[:, 0] = start
    added, far = noise.copy(), 1
    while far < length:  # what the last 1, 2, 4 ... steps added
        added[:, :, far:] += product(added[:, :, :-far], to_later[far - 1].T)
        far *= 2
    starts = np.empty((count, blocks + 1, 1, n))
    starts[:, 0, 0] = start
    for k in range(blocks):
        starts[:, k + 1] = product(starts[:, k], to_later[-1].T) + added[:, k, -1:]
    moved = product(starts[:, :-1], to_later.reshape(-1, n).T)
    x[:, 1:] = (moved.reshape(added.shape) + added).reshape(count, -1, n)
    return x
