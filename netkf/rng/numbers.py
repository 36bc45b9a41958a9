"""Normal and gamma numbers and bounded integers of numpy's ``Generator(Philox)``, in kernels.

``rng.draws`` has the words, uniforms and exponentials, ``rng.streams`` explains states. Normals
come from the ziggurat of Marsaglia and Tsang (2000) with numpy's 256 layers
(``ziggurat_normal.npz``), gamma numbers from their transformed normals (ACM TOMS 26, 2000) or, of
shapes below 1, from exponentials (Ahrens and Dieter 1974), integers from Lemire's method (ACM
TOMACS 29, 2019) and permutations from masked 32-bit halves of words, all tested against numpy.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.structs import Size
from netkf.rng.draws import LAYER, ONE, S8, Ziggurat, next_exponential, next_unit, next_word, philox
from netkf.rng.streams import BLOCK_WORDS, HALF

_U = np.uint64
# MANTISSA masks the lower 52 bits of a word, LOWER its lower half; S1 and S32 are shift counts.
MANTISSA, LOWER, S1, S32 = _U(0x000FFFFFFFFFFFFF), _U(0xFFFFFFFF), _U(1), _U(32)
# Where numpy's normal ziggurat begins its tail, and the reciprocal of that.
TAIL_START = 3.6541528853610087963519472518
INVERSE_TAIL_START = 0.27366123732975827203338247596
HAS_HALF = _U(1 << 32)  # added to the half of a word that a state keeps


@cache
def normal_ziggurat() -> Ziggurat:
    """Return the 256 layers of numpy's ziggurat for standard normal numbers, loaded once; "fi",
    "wi" and "ki" are numpy's names of heights, widths and inside limits.
    """
    with np.load(Path(__file__).with_name("ziggurat_normal.npz")) as tables:
        return Ziggurat(tables["fi"], tables["wi"], tables["ki"])


@kernel(inlined=True)
def layer_normal(word: Any, ziggurat: Ziggurat) -> tuple[float, int, Any, bool]:
    """Return the normal number x that a 64-bit ``word`` makes, its layer and its integer across the
    layer, and whether it is inside the curve; else x is not accepted without a test.
    """
    # 8 bits choose a layer, one the sign, 52 a point across the layer.
    layer, rest = int(word & LAYER), word >> S8
    size = (rest >> S1) & MANTISSA
    # A product and not a branch, half of which would be predicted wrongly.
    sign = 1.0 - 2.0 * float(rest & ONE)
    return sign * (float(size) * ziggurat.width[layer]), layer, size, size < ziggurat.inside[layer]


@kernel
def next_normal(states: np.ndarray, k: int, ziggurat: Ziggurat) -> float:
    """Return the next standard normal number of stream ``k`` of the ``states`` (K, WIDTH)."""
    while True:
        x, layer, size, is_inside = layer_normal(next_word(states, k), ziggurat)
        if is_inside:
            return float(x)
        if layer == 0:  # the sign bit of the tail is another one than that of the layers
            return _tail(states, k, ((size >> S8) & ONE) == ONE)
        # At the edge of a layer: accept x if a uniform height in the layer is below exp(-x^2 / 2).
        above, height = ziggurat.height[layer - 1], ziggurat.height[layer]
        if (above - height) * next_unit(states, k) + height < math.exp(-0.5 * x * x):
            return float(x)


@kernel
def next_gamma(
    states: np.ndarray, k: int, shape: float, exponential: Ziggurat, normal: Ziggurat
) -> float:
    """Return stream ``k``'s next number from the gamma law of ``shape`` > 0 and scale 1."""
    if shape == 1.0:
        return float(next_exponential(states, k, exponential))
    while shape < 1.0:
        u, v = next_unit(states, k), next_exponential(states, k, exponential)
        if u <= 1.0 - shape:
            x = math.pow(u, 1.0 / shape)
            if x <= v:
                return x
        else:
            y = -math.log((1.0 - u) / shape)
            x = math.pow(1.0 - shape + shape * y, 1.0 / shape)
            if x <= v + y:
                return x
    b = shape - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * b)
    while True:
        x = next_normal(states, k, normal)
        v = 1.0 + c * x
        if v <= 0.0:
            continue
        v, u = v * v * v, next_unit(states, k)
        # A lower bound of what the last line compares with: no logarithm in 98 of 100 draws.
        if u < 1.0 - 0.0331 * (x * x) * (x * x):
            return b * v
        if u == 0.0 or math.log(u) < 0.5 * x * x + b * (1.0 - v + math.log(v)):
            return b * v


@kernel(inlined=True)
def first_normals(
    size: Size, states: np.ndarray, k: int, ziggurat: Ziggurat, out: FloatArray, begin: int
) -> None:
    """Write the first n standard normals of stream ``k``, of which nothing was drawn (its words 0
    and USED are 0 and BLOCK_WORDS), into ``out`` from ``begin`` on; ``size`` has the length n.
    """
    is_done = len(size) <= BLOCK_WORDS
    if is_done:
        # One block, word by word, without the memory of a stream.
        names, keys = (states[k, 1], states[k, 2], states[k, 3]), (states[k, 4], states[k, 5])
        words = philox(ONE, names[0], names[1], names[2], keys[0], keys[1])
        for i in range(len(size)):
            x, _, _, is_inside = layer_normal(words[i], ziggurat)
            out[begin + i], is_done = x, is_done and is_inside
    if not is_done:
        for i in range(len(size)):
            out[begin + i] = next_normal(states, k, ziggurat)


@kernel
def _tail(states: np.ndarray, k: int, negative: bool) -> float:
    """Return a normal number beyond TAIL_START by rejection (Marsaglia 1964)."""
    # TAIL_START + x, with x exponential of mean 1 / TAIL_START, is accepted with probability
    # exp(-x^2 / 2), by an exponential y of mean 1.
    while True:
        x = -INVERSE_TAIL_START * math.log1p(-next_unit(states, k))
        y = -math.log1p(-next_unit(states, k))
        if y + y > x * x:
            return -(TAIL_START + x) if negative else TAIL_START + x


@kernel
def next_half(states: np.ndarray, k: int) -> Any:
    """Return the next 32 bits of stream ``k`` of the ``states`` (K, WIDTH): the lower half
    of a new word, then at the next call its upper half, which the state keeps meanwhile.
    """
    kept = states[k, HALF]
    if kept >= HAS_HALF:
        states[k, HALF] = _U(0)
        return kept & LOWER
    word = next_word(states, k)
    states[k, HALF] = HAS_HALF + (word >> S32)
    return word & LOWER


@kernel
def next_integer(states: np.ndarray, k: int, count: int) -> Any:
    """Return the next integer of stream ``k`` of the ``states`` (K, WIDTH), uniform on 0
    .. ``count`` - 1.

    ``count`` is at most 2^32 - 1. Lemire's method: of count times 32 random bits the upper half is
    the result; products whose lower half is below 2^32 mod count are rejected: all are likely.
    """
    if count <= 1:
        return np.int64(0)
    bound = _U(count)
    product = next_half(states, k) * bound
    # The threshold is below ``bound``: the division is rarely needed.
    if (product & LOWER) < bound:
        threshold = ((LOWER - bound) + ONE) % bound
        while (product & LOWER) < threshold:
            product = next_half(states, k) * bound
    return np.int64(product >> S32)


@kernel
def shuffle(states: np.ndarray, k: int, order: np.ndarray, count: int) -> None:
    """Write a random permutation of 0 .. count - 1 into ``order`` (>= count,) by Fisher-Yates, from
    stream ``k`` of the ``states`` (K, WIDTH), which it steps.

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
