"""Random numbers of many streams in kernels: words, uniforms and exponentials.

The numbers are, bit for bit, those of numpy's ``Generator(Philox)``. A network of 1e5 links has as
many streams, and to make a numpy generator for each takes longer than to draw from it; here each is
a row of 64-bit words (``rng.streams``). Exponentials come from the ziggurat of Marsaglia and Tsang
(2000) with numpy's tables (``ziggurat_constants.h``, BSD-3-Clause), stored in ``ziggurat.npz``.

Arrays ``states`` (K, WIDTH) are the states of K streams, which drawing advances, modulo 2^64.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from netkf.linalg.arrays import FloatArray
from netkf.linalg.compiling import kernel
from netkf.linalg.words import high_word
from netkf.rng.streams import BLOCK_WORDS, BUFFER, USED

_U = np.uint64
# Multipliers and Weyl constants of Philox4x64, see Random123 and numpy/random/src/philox.
FIRST, SECOND = _U(0xD2E7470EE14C6C93), _U(0xCA5A826395121157)
WEYL_FIRST, WEYL_SECOND = _U(0x9E3779B97F4A7C15), _U(0xBB67AE8584CAA73B)
ROUNDS = 10
# LAYER masks the 8 bits that choose a layer of the ziggurat; S3, S8, S11 are shift counts.
ONE, LAYER, S3, S8, S11 = _U(1), _U(0xFF), _U(3), _U(8), _U(11)
FULL = _U(BLOCK_WORDS)
TO_UNIT = 2.0**-53  # spacing of numpy's uniform numbers
EXPONENTIAL_TAIL = 7.69711747013104972  # where numpy's exponential ziggurat begins its tail


class Ziggurat(NamedTuple):
    """The 256 layers of a ziggurat under a curve, exp(-x) or exp(-x^2 / 2), (256,) each.

    height  of the curve at the edge of the layer
    width   x at the edge, divided by 2^53, or 2^52 under exp(-x^2 / 2)
    inside  integers below this are inside the curve without a test
    """

    height: FloatArray
    width: FloatArray
    inside: np.ndarray


@cache
def ziggurat() -> Ziggurat:
    """Return the tables of numpy's ziggurat for exponential numbers of mean 1, loaded once; "fe",
    "we" and "ke" are numpy's names of heights, widths and inside limits.
    """
    with np.load(Path(__file__).with_name("ziggurat.npz")) as tables:
        return Ziggurat(tables["fe"], tables["we"], tables["ke"])


@kernel(inlined=True)
def philox(a: Any, b: Any, c: Any, d: Any, key: Any, other: Any) -> tuple[Any, Any, Any, Any]:
    """Return the four words that Philox4x64-10 makes of the counter (a, b, c, d), lowest word
    first, under the key (key, other); all are 64-bit words.
    """
    for _ in range(ROUNDS):
        high, low = high_word(FIRST, a), FIRST * a
        a, b, c, d = high_word(SECOND, c) ^ b ^ key, SECOND * c, high ^ d ^ other, low
        key, other = key + WEYL_FIRST, other + WEYL_SECOND
    return a, b, c, d


@kernel
def refill(states: np.ndarray, k: int) -> None:
    """Compute the next block of four words of stream ``k`` of the ``states`` (K, WIDTH)."""
    # The other words of the counter name the stream: no run draws 2^64 blocks.
    states[k, 0] += ONE
    a, b, c, d = states[k, 0], states[k, 1], states[k, 2], states[k, 3]
    key, other = states[k, 4], states[k, 5]
    states[k, 6], states[k, 7], states[k, 8], states[k, 9] = philox(a, b, c, d, key, other)


@kernel(inlined=True)
def next_word(states: np.ndarray, k: int) -> Any:
    """Return the next 64-bit word of stream ``k`` of the ``states`` (K, WIDTH)."""
    used = states[k, USED]
    if used == FULL:
        refill(states, k)
        used = _U(0)
    states[k, USED] = used + ONE
    return states[k, BUFFER + int(used)]


@kernel
def next_unit(states: np.ndarray, k: int) -> float:
    """Return the next number of stream ``k`` of the ``states`` (K, WIDTH), uniform on [0, 1)."""
    # The upper 53 bits: as many as a float64 holds exactly.
    return float(next_word(states, k) >> S11) * TO_UNIT


@kernel
def next_exponential(states: np.ndarray, k: int, ziggurat: Ziggurat) -> float:
    """Return the next number of stream ``k`` from the exponential law of mean 1 (ziggurat)."""
    while True:
        # 8 bits choose a layer, 53 bits a point across it.
        word = next_word(states, k) >> S3
        layer = int(word & LAYER)
        word >>= S8
        x: float = float(word) * ziggurat.width[layer]
        if word < ziggurat.inside[layer]:
            return x
        # The tail of an exponential law is the same law, shifted.
        if layer == 0:
            return EXPONENTIAL_TAIL - math.log1p(-next_unit(states, k))
        # At the edge of a layer: accept x if a uniform height in the layer is below exp(-x).
        above, height = ziggurat.height[layer - 1], ziggurat.height[layer]
        if (above - height) * next_unit(states, k) + height < math.exp(-x):
            return x


@kernel
def fill_units(states: np.ndarray, out: FloatArray) -> None:
    """Write the next uniform number of each of ``states`` (K, WIDTH) into ``out`` (K,)."""
    for k in range(len(out)):
        out[k] = next_unit(states, k)
