"""The recursion x[k+1] = F x[k] + w[k] for many steps at once."""

from __future__ import annotations

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.portable import product


class Recursion:
    """The recursion ``x[k+1] = F x[k] + w[k]`` of one F (n, n), with cached powers of F."""

    def __init__(self, F: FloatArray) -> None:
        self.F, self._powers = F, F[None]

    def states(self, start: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the states (B, K L + 1, n) of B paths from ``start`` (B, n) on.

        ``noise`` (B, K, L, n) are the w of K blocks of L steps. Paths and blocks are multiplied
        separately: a path has the same bits whatever the others are.
        """
        # States beyond the horizon may overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            powers = self._powers_to(noise.shape[2])
            # Powers of F may overflow although no state does.
            states = _states_by_sums if np.isfinite(powers[-1]).all() else _states_by_steps
            return states(start, noise, powers)

    def _powers_to(self, count: int) -> FloatArray:
        """Return ``F^1 .. F^count`` (count, n, n)."""
        powers = self._powers
        while len(powers) < count:
            powers = np.concatenate([powers, product(powers, powers[-1])])
        self._powers = powers
        return powers[:count]


def _states_by_steps(start: FloatArray, noise: FloatArray, powers: FloatArray) -> FloatArray:
    """Return B paths (B, K L + 1, n) of ``x[k+1] = F x[k] + w[k]``, step by step."""
    count, _, _, n = noise.shape
    x = [start[:, None]]
    for w in np.moveaxis(noise.reshape(count, -1, 1, n), 1, 0):
        x.append(product(x[-1], powers[0].T) + w)
    return np.concatenate(x, axis=1)


def _states_by_sums(start: FloatArray, noise: FloatArray, powers: FloatArray) -> FloatArray:
    """Return B paths (B, K L + 1, n) of ``x[k+1] = F x[k] + w[k]`` by prefix sums."""
    count, blocks, length, n = noise.shape
    x = np.empty((count, blocks * length + 1, n))
    x[:, 0] = start
    # response[k] = sum_{j <= k} F^(k-j) w[j] within a block: after a pass it sums the last
    # 2, 4, 8 ... steps, response[k] += F^offset response[k - offset].
    response, offset = noise.copy(), 1
    while offset < length:
        response[:, :, offset:] += product(response[:, :, :-offset], powers[offset - 1].T)
        offset *= 2
    # starts[k+1] = F^L starts[k] + response at the end of block k
    starts = np.empty((count, blocks + 1, 1, n))
    starts[:, 0, 0] = start
    for k in range(blocks):
        starts[:, k + 1] = product(starts[:, k], powers[-1].T) + response[:, k, -1:]
    # x = F^j (start of the block) + response
    from_start = product(starts[:, :-1], powers.reshape(-1, n).T)
    x[:, 1:] = (from_start.reshape(response.shape) + response).reshape(count, -1, n)
    return x
