"""Normal numbers and bounded integers of numpy's ``Generator(PCG64DXSM)``, drawn in kernels.

``rng.draws`` holds the words and the uniform and exponential numbers. Normals come from the
ziggurat of Marsaglia and Tsang (2000) with numpy's 256 layers (``ziggurat_normal.npz``), integers
from Lemire's method (ACM TOMACS 29, 2019) and orders from masked halves of words. tests/rng
compares all of them with numpy.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.rng.draws import (
    HALF,
    LAYER,
    ONE,
    S8,
    S32,
    next_stream_state,
    next_unit,
    next_word,
    scramble,
)

_U = np.uint64
MANTISSA, S1, S9 = _U(0x000FFFFFFFFFFFFF), _U(1), _U(9)
TAIL_START = 3.6541528853610087963519472518
INVERSE_TAIL_START = 0.27366123732975827203338247596
HAS_HALF, KEPT_HALF = 4, 5
"""Columns of a row of states, after the four of rng.draws: whether half a word is kept, and it."""


class NormalZiggurat(NamedTuple):
    """256 layers under exp(-x^2 / 2): heights, widths / 2^52, integers that are surely inside."""

    height: FloatArray
    width: FloatArray
    inside: np.ndarray


@cache
def normal_ziggurat() -> NormalZiggurat:
    """Return the layers that numpy uses."""
    with np.load(Path(__file__).with_name("ziggurat_normal.npz")) as kept:
        return NormalZiggurat(kept["fi"], kept["wi"], kept["ki"])


@kernel(inlined=True)
def normal_of(
    states: np.ndarray, k: int, high: Any, low: Any, ziggurat: NormalZiggurat
) -> tuple[float, Any, Any]:
    """Return ``next_normal`` of stream ``k``, whose state is in registers; return the state after
    it too, see ``exponential_of``.
    """
    word = scramble(high, low)
    layer = int(word & LAYER)
    size = (word >> S9) & MANTISSA
    if size < ziggurat.inside[layer]:
        x: float = float(size) * ziggurat.width[layer]
        high, low = next_stream_state(high, low, states[k, 2], states[k, 3])
        return -x if (word >> S8) & ONE == ONE else x, high, low
    states[k, 0], states[k, 1] = high, low
    x = next_normal(states, k, ziggurat)
    return x, states[k, 0], states[k, 1]


@kernel
def next_normal(states: np.ndarray, k: int, ziggurat: NormalZiggurat) -> float:
    """Return the next standard normal number of stream ``k`` of states (K, >= 4)."""
    while True:
        word = next_word(states, k)
        layer = int(word & LAYER)
        word >>= S8
        negative = (word & ONE) == ONE
        size = (word >> S1) & MANTISSA
        x: float = float(size) * ziggurat.width[layer]
        if negative:
            x = -x
        if size < ziggurat.inside[layer]:
            return x
        if layer == 0:
            return _tail(states, k, ((size >> S8) & ONE) == ONE)
        above, height = ziggurat.height[layer - 1], ziggurat.height[layer]
        if (above - height) * next_unit(states, k) + height < math.exp(-0.5 * x * x):
            return x


@kernel
def _tail(states: np.ndarray, k: int, negative: bool) -> float:
    """Return a number beyond the lowest layer (Marsaglia 1964)."""
    while True:
        x = -INVERSE_TAIL_START * math.log1p(-next_unit(states, k))
        y = -math.log1p(-next_unit(states, k))
        if y + y > x * x:
            return -(TAIL_START + x) if negative else TAIL_START + x


@kernel
def next_half(states: np.ndarray, k: int) -> Any:
    """Return the next 32 bits of stream ``k`` of states (K, 6): the lower half of a word, then the
    upper half.
    """
    if states[k, HAS_HALF] == ONE:
        states[k, HAS_HALF] = _U(0)
        return states[k, KEPT_HALF]
    word = next_word(states, k)
    states[k, HAS_HALF], states[k, KEPT_HALF] = ONE, word >> S32
    return word & HALF


@kernel
def next_integer(states: np.ndarray, k: int, count: int) -> Any:
    """Return the next integer of stream ``k`` of states (K, 6), uniform from 0 to ``count`` - 1 <
    2^32.
    """
    if count <= 1:
        return np.int64(0)
    excluded = _U(count)
    product = next_half(states, k) * excluded
    if (product & HALF) < excluded:
        least = ((HALF - excluded) + ONE) % excluded
        while (product & HALF) < least:
            product = next_half(states, k) * excluded
    return np.int64(product >> S32)


@kernel
def shuffle(states: np.ndarray, k: int, order: np.ndarray, count: int) -> None:
    """Write a random order of 0 .. count - 1 into ``order``: ``Generator.permutation(count)``."""
    for i in range(count):
        order[i] = i
    mask = ONE
    while mask < _U(count):
        mask = (mask << ONE) | ONE
    for i in range(count - 1, 0, -1):
        while (mask >> ONE) >= _U(i):  # the smallest 2^b - 1 that is at least i
            mask >>= ONE
        drawn = next_half(states, k) & mask
        while drawn > _U(i):
            drawn = next_half(states, k) & mask
        j = np.int64(drawn)
        order[i], order[j] = order[j], order[i]
