"""Standard normal numbers of several streams at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.rng.draws import Ziggurat
from netkf.rng.numbers import next_normal, normal_ziggurat


class Normals(Protocol):
    """The contract of K independent streams of standard normal numbers."""

    def draw(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the next numbers (K, *shape) of each of the K streams."""


class GeneratorNormals:
    """The streams of K numpy generators, ``randoms``."""

    def __init__(self, randoms: Sequence[np.random.Generator]) -> None:
        self._randoms = randoms

    def draw(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the next numbers (K, *shape) of each of the K generators."""
        return np.stack([random.standard_normal(shape) for random in self._randoms])


class StreamNormals:
    """Streams ``states`` (K, WIDTH) in compiled code: the same numbers as numpy's generators."""

    def __init__(self, states: np.ndarray) -> None:
        self.states = states

    def draw(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the next numbers (K, *shape) of each of the K streams."""
        out = np.empty((len(self.states), *shape))
        fill_normals_of_all(self.states, normal_ziggurat(), out.reshape(len(out), -1))
        return out


@kernel
def fill_normals_of_all(states: np.ndarray, ziggurat: Ziggurat, out: FloatArray) -> None:
    """Write the next M standard normals of each of ``states`` (K, WIDTH) into ``out`` (K, M)."""
    for k in range(out.shape[0]):
        for m in range(out.shape[1]):
            out[k, m] = next_normal(states, k, ziggurat)
