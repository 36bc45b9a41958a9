"""Readings of an instant as theory uses them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray, block_diagonal


class Observation(NamedTuple):
    """Readings at one instant.

    H    : (p, n)
    R    : (p, p) noise covariance that the filter assumes
    root : (p, p) a square root of the true noise covariance
    """

    H: FloatArray
    R: FloatArray
    root: FloatArray


def stack_observations(observations: list[Observation], n: int) -> Observation:
    """Join ``observations`` of a state (n,) with independent noises into one: H (p, n) stacked, R
    and root (p, p) block diagonal, for p readings together.
    """
    if len(observations) == 1:
        return observations[0]
    H = np.concatenate([np.zeros((0, n)), *(observation.H for observation in observations)])
    R, root = (block_diagonal([observation[k] for observation in observations]) for k in (1, 2))
    return Observation(H, R, root)
