"""Normal numbers and bounded integers of numpy's ``Generator(PCG64DXSM)``, drawn in kernels.

``rng.draws`` has the words, uniforms and exponentials, and explains states. Normals come from the
ziggurat of Marsaglia and Tsang (2000) with numpy's 256 layers (``ziggurat_normal.npz``), integers
from Lemire's method (ACM TOMACS 29, 2019) and permutations from masked 32-bit halves of words.
tests/rng compares all of them with numpy.
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
# MANTISSA masks the lower 52 bits of a word; S1 and S9 are shift counts.
MANTISSA, S1, S9 = _U(0x000FFFFFFFFFFFFF), _U(1), _U(9)
# Where numpy's normal ziggurat begins its tail, and the reciprocal of that.
TAIL_START = 3.6541528853610087963519472518
INVERSE_TAIL_START = 0.27366123732975827203338247596
HAS_HALF, KEPT_HALF = 4, 5
"""Columns 4 and 5 of a state, after the four of rng.draws: 1 if half of a word is left over from
the last 32-bit draw, and that half.
"""


class NormalZiggurat(NamedTuple):
    """The 256 layers of the ziggurat under exp(-x^2 / 2), (256,) each.

    height  exp(-x^2 / 2) at the edge of the layer
    width   x at the edge, divided by 2^52
    inside  integers below this are inside the curve without a test
    """

    height: FloatArray
    width: FloatArray
    inside: np.ndarray


@cache
def normal_ziggurat() -> NormalZiggurat:
    """Return the 256 layers of numpy's ziggurat for standard normal numbers, loaded once; "fi",
    "wi" and "ki" are numpy's names of heights, widths and inside limits.
    """
    with np.load(Path(__file__).with_name("ziggurat_normal.npz")) as tables:
        return NormalZiggurat(tables["fi"], tables["wi"], tables["ki"])


@kernel(inlined=True)
def normal_of(
    states: np.ndarray, k: int, high: Any, low: Any, ziggurat: NormalZiggurat
) -> tuple[float, Any, Any]:
    """Return the next standard normal number of stream ``k`` of the ``states`` (K, >= 4) of K
    streams, and the state after it, for a loop that keeps the state (high, low) in registers;
    ``states[k]`` is read and written only for the rare numbers outside the fast path.
    """
    # As in next_normal: 8 bits choose a layer, one the sign, 52 a point across the layer.
    word = scramble(high, low)
    layer = int(word & LAYER)
    size = (word >> S9) & MANTISSA
    if size < ziggurat.inside[layer]:
        x: float = float(size) * ziggurat.width[layer]
        high, low = next_stream_state(high, low, states[k, 2], states[k, 3])
        return -x if (word >> S8) & ONE == ONE else x, high, low
    # The slow path draws the same word again, from the state before it.
    states[k, 0], states[k, 1] = high, low
    x = next_normal(states, k, ziggurat)
    return x, states[k, 0], states[k, 1]


@kernel
def next_normal(states: np.ndarray, k: int, ziggurat: NormalZiggurat) -> float:
    """Return the next standard normal number of stream ``k`` of the ``states`` (K, >= 4) of K
    streams (ziggurat), and step its state.
    """
    while True:
        # 8 bits choose a layer, one the sign, 52 a point across the layer.
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
        if layer == 0:  # the sign bit of the tail is another one than that of the layers
            return _tail(states, k, ((size >> S8) & ONE) == ONE)
        # At the edge of a layer: accept x if a uniform height in the layer is below exp(-x^2 / 2).
        above, height = ziggurat.height[layer - 1], ziggurat.height[layer]
        if (above - height) * next_unit(states, k) + height < math.exp(-0.5 * x * x):
            return x


@kernel
def _tail(states: np.ndarray, k: int, negative: bool) -> float:
    """Return a normal number x with |x| > TAIL_START, ``negative`` or positive, by rejection
    (Marsaglia 1964), from stream ``k`` of the ``states`` (K, >= 4) of K streams.
    """
    # TAIL_START + x, with x exponential of mean 1 / TAIL_START, is accepted with probability
    # exp(-x^2 / 2), by an exponential y of mean 1.
    while True:
        x = -INVERSE_TAIL_START * math.log1p(-next_unit(states, k))
        y = -math.log1p(-next_unit(states, k))
        if y + y > x * x:
            return -(TAIL_START + x) if negative else TAIL_START + x


@kernel
def next_half(states: np.ndarray, k: int) -> Any:
    """Return the next 32 bits of stream ``k`` of the ``states`` (K, 6) of K streams: the lower half
    of a new word, then at the next call its upper half, which the state keeps meanwhile.
    """
    if states[k, HAS_HALF] == ONE:
        states[k, HAS_HALF] = _U(0)
        return states[k, KEPT_HALF]
    word = next_word(states, k)
    states[k, HAS_HALF], states[k, KEPT_HALF] = ONE, word >> S32
    return word & HALF


@kernel
def next_integer(states: np.ndarray, k: int, count: int) -> Any:
    """Return the next integer of stream ``k`` of the ``states`` (K, 6) of K streams, uniform on 0
    .. ``count`` - 1.

    ``count`` is at most 2^32 - 1. Lemire's method: of count times 32 random bits the upper half is
    the result; products whose lower half is below 2^32 mod count are rejected, so that all results
    are equally likely.
    """
    if count <= 1:
        return np.int64(0)
    bound = _U(count)
    product = next_half(states, k) * bound
    # The threshold is below ``bound``: the division is rarely needed.
    if (product & HALF) < bound:
        threshold = ((HALF - bound) + ONE) % bound
        while (product & HALF) < threshold:
            product = next_half(states, k) * bound
    return np.int64(product >> S32)


@kernel
def shuffle(states: np.ndarray, k: int, order: np.ndarray, count: int) -> None:
    """Write a random permutation of 0 .. count - 1 into ``order`` (>= count,) by Fisher-Yates, from
    stream ``k`` of the ``states`` (K, 6) of K streams, which it steps.

    It equals ``Generator.permutation(count)``.
    """
    for i in range(count):
        order[i] = i
    # The smallest 2^b - 1 that is at least ``count``; the loop below shrinks it with i.
    mask = ONE
    while mask < _U(count):
        mask = (mask << ONE) | ONE
    for i in range(count - 1, 0, -1):
        while (mask >> ONE) >= _U(i):  # mask: the smallest 2^b - 1 that is at least i
            mask >>= ONE
        # j uniform on 0 .. i: draw b bits until they are at most i.
        bits = next_half(states, k) & mask
        while bits > _U(i):
            bits = next_half(states, k) & mask
        j = np.int64(bits)
        order[i], order[j] = order[j], order[i]
