"""Standard normal numbers of several streams at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.rng.draws import seed_states
from netkf.rng.numbers import NormalZiggurat, normal_of, normal_ziggurat


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
    """K streams with the seed ``words`` (K, 4) of ``Streams.seed_words``, drawn in compiled code.

    They give the same numbers as numpy generators with these seeds.
    """

    def __init__(self, words: np.ndarray) -> None:
        self.states = np.empty(words.shape, dtype=np.uint64)
        seed_states(words, self.states)

    def draw(self, shape: tuple[int, ...]) -> FloatArray:
        """Return the next numbers (K, *shape) of each of the K streams."""
        out = np.empty((len(self.states), *shape))
        fill_normals_of_all(self.states, normal_ziggurat(), out.reshape(len(out), -1))
        return out


@kernel
def fill_normals_of_all(states: np.ndarray, ziggurat: NormalZiggurat, out: FloatArray) -> None:
    """Write the next M standard normal numbers of stream k of the ``states`` (K, >= 4) of K streams
    into ``out[k]``, for all k; ``out`` is (K, M). Steps the states.
    """
    for k in range(out.shape[0]):
        # The state stays in registers during the loop and is stored once.
        high, low = states[k, 0], states[k, 1]
        for m in range(out.shape[1]):
            out[k, m], high, low = normal_of(states, k, high, low, ziggurat)
        states[k, 0], states[k, 1] = high, low
